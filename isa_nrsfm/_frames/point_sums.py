"""Sums over the points of each frame: sufficient statistics of a fit of given shapes.

Cameras and coefficients are fitted to shapes ``B_k`` (3, J). The fit depends on frame i
only through its energy, the products ``P_ik`` of its points with the shapes, and the
Gram matrices ``G_i,kl`` of the shapes over its points ::

    P_ik = sum_j w_ij b_kj (m_ij - mean_i)^T,
    G_i,kl = sum_j w_ij (b_kj - mean_ik) (b_lj - mean_il)^T.

Here ``mean_i`` and ``mean_ik`` are the weighted means of the points of the frame and of
shape k. The frame is the last index of all arrays, so that each sum is one matrix
product for all frames.

`coefficient_posterior` is the posterior of the coefficients of frames whose cameras are
known. Let ``c = (1, a)`` with the prior ``a ~ N(0, I)`` and noise of variance s2. The
posterior of a is normal, with ::

    Q = (H + s2 I)^-1,  mean Q (q - h),  covariance s2 Q,

where ``H_kl = <M B_k, M B_l>`` for k, l >= 1, ``h_k = H_k0`` and ``q_k = <P_k^T, M>``
(Bishop, "Pattern recognition and machine learning", 2006, section 12.2). Frames are the
last index of all arrays.
"""

from collections.abc import Iterator
from functools import partial
from typing import Any, NamedTuple, Self

import numpy as np
from numpy.typing import NDArray

from isa_nrsfm._compat.lazy import cached_property
from isa_nrsfm._linalg import (
    COLUMNS,
    DIAGONAL,
    ROWS,
    diagonal_of,
    inverse3,
    of_frames,
    packed_rows,
    pair_indices,
    sweep,
    unpack3,
    unpacked,
)
from isa_nrsfm._tables.blocks import BLOCK_FRAMES

# Multiplicity of the entries of packed symmetric 3x3 matrices in ``<S, Q>``: those off
# the diagonal count twice.
TWICE = np.array([1.0, 2.0, 2.0, 1.0, 2.0, 1.0])
# Shapes are flat along a direction if their extent is below this share of the largest.
FLAT = 1e-10


class Gram:
    """The Gram matrices of shapes: one for all complete frames, or one for each frame.

    pairs (n_pairs, 6) or (n_pairs, 6, I): ``(G_kl + G_kl^T) / 2``, packed. The fit
    depends only on this symmetric part.
    """

    def __init__(self, pairs: NDArray) -> None:
        self.pairs = pairs
        self._index = unpacked(np.arange(len(pairs)))  # (n_shapes, n_shapes)
        # Pairs with k < l count twice.
        self._multiplicity = np.bincount(self._index.ravel())[:, None]
        # Products of matrices (a, b) or (a, b, n) with vectors (b, n)
        of_each = partial(np.einsum, "abi,bi->ai")
        self._times = np.matmul if pairs.ndim == 2 else of_each

    @cached_property
    def _full(self) -> NDArray:
        """``2 G_kl`` (6 n_shapes, n_shapes, ...), rows (k, ab) and columns l."""
        entries = 6 * self._index[:, None] + np.arange(6)[:, None]
        flat = self.pairs.reshape(6 * len(self.pairs), *self.pairs.shape[2:])
        return 2.0 * np.take(flat, entries.reshape(-1, len(entries)), axis=0)

    def products(self, c: NDArray) -> NDArray:
        """Return packed ``B_k S_i^T + S_i B_k^T`` (n_shapes, 6, n), c (n_shapes, n)."""
        return self._times(self._full, c).reshape(len(c), 6, c.shape[1])

    def moments(self, C: NDArray) -> NDArray:
        """Return ``sum_kl C_kl G_kl`` (6, n), packed; C (n_pairs, n) is packed."""
        return self._times(self.pairs.swapaxes(0, 1), self._multiplicity * C)

    def energies(self, Q: NDArray) -> NDArray:
        """Return ``H_kl = <G_kl, Q>`` (n_pairs, n), packed; Q (6, n) is packed."""
        return self._times(self.pairs, TWICE[:, None] * Q)

    def of_frames(self, frames: NDArray) -> Self:
        """Return the Gram matrices of some of the frames."""
        if self.pairs.ndim == 2:
            return self
        return type(self)(of_frames(self.pairs, frames))


class FrameTracks(NamedTuple):
    """Tracks with the frame index last, ready for products with any shapes.

    deviations (J, 2, I): ``w_ij (m_ij - mean_i)``; zero for points that are missing.
    weights (J, I): w_ij; None where all are 1.
    centroid (2, I): ``mean_i``, zero for frames without points.
    weight, energy (I,): ``sum_j w_ij`` and ``sum_j w_ij ||m_ij - mean_i||^2``.
    """

    deviations: NDArray
    weights: NDArray | None
    centroid: NDArray
    weight: NDArray
    energy: NDArray

    @property
    def n_together(self) -> int:
        """Frames to work on at a time; with weights each has a Gram matrix."""
        return BLOCK_FRAMES if self.weights is None else BLOCK_FRAMES // 8

    def pieces(self) -> Iterator[tuple[slice, Self]]:
        """Yield slices of at most `n_together` consecutive frames, and these frames."""
        total, length = len(self.weight), self.n_together
        for start in range(0, total, length):
            frames = slice(start, min(start + length, total))
            yield frames, self if total <= length else of_frames(self, frames)


class FrameSums(NamedTuple):
    """Sums over the points of frames, with weights w_ij.

    cross (n_shapes, 3, 2, I): ``P_ik``; gram: ``G_i,kl``. shape_centroid (n_shapes, 3,
    I): ``mean_ik``, weighted means of points of the shapes. centroid, weight, energy:
    as in `FrameTracks`.
    """

    cross: NDArray
    gram: Gram
    shape_centroid: NDArray
    centroid: NDArray
    weight: NDArray
    energy: NDArray

    def positions(self, motion: NDArray, alpha: NDArray) -> NDArray:
        """Return positions ``mean_i - M_i sum_k c_ik mean_ik`` (n, 2).

        They are the images of the origin of the shapes, by least squares.
        """
        middle = np.einsum("kai,ki->ai", self.shape_centroid, with_one(alpha.T))
        return (self.centroid - np.einsum("ira,ai->ri", motion, middle)).T


def with_one(alpha: NDArray) -> NDArray:
    """Return ``c = (1, alpha)`` (n_components + 1, n) of alpha (n_components, n)."""
    return np.concatenate([np.ones((1, alpha.shape[1])), alpha])


def camera_gram(M: NDArray) -> NDArray:
    """Return ``M^T M`` (6, n_frames) of cameras (2, 3, n_frames), packed."""
    return np.einsum("rpi,rpi->pi", M[:, ROWS], M[:, COLUMNS])


def affine_cameras(products: FrameSums, c: NDArray) -> NDArray:
    """Return affine cameras (2, 3, n) by least squares, coefficients c (n_shapes, n).

    They are ``M = Y A^-1`` with ``A = S S^T`` and ``Y = W S^T``.
    """
    A = np.einsum("ki,kpi->pi", 0.5 * c, products.gram.products(c))
    # A ridge, relative to the moments of all shapes, for finite cameras of flat ones
    moments = products.gram.pairs[diagonal_of(products.gram.pairs)][:, DIAGONAL]
    A[DIAGONAL] += 1e-13 * moments.sum(axis=0).mean(axis=0)
    Y = np.einsum("ki,kari->rai", c, products.cross)
    return np.einsum("rbi,bai->rai", Y, inverse3(A))


def seen_changes(cross: NDArray, T: NDArray, M: NDArray) -> NDArray:
    """Return ``F_k = M T_k - P_k^T`` (K, 2, 3, n) of the basis shapes."""
    F = np.einsum("rbi,kbai->krai", M, unpack3(T[1:]))
    F -= cross[1:].swapaxes(1, 2)
    return F


def frame_tracks(rows: NDArray, weights: NDArray | None = None) -> FrameTracks:
    """Return rows (I, 2, J) with the frame index last, each frame centred.

    Weights (I, J) are non-negative, by default 1. Points of weight zero may be NaN.
    """
    n_frames, _, n_points = rows.shape
    centred = np.array(rows.T, dtype=np.float64, order="C")
    if weights is None:
        centroid = centred.mean(axis=0)
        centred -= centroid
        energy = np.einsum("jri,jri->i", centred, centred)
        weight = np.full(n_frames, float(n_points))
        return FrameTracks(centred, None, centroid, weight, energy)
    # W (n_points, n_frames) has the weights, weight (n_frames,) their sums.
    W = np.array(weights.T, dtype=np.float64, order="C")
    np.copyto(centred, 0.0, where=(W == 0)[:, None])
    weight = W.sum(axis=0)
    centroid = np.einsum("ji,jri->ri", W * _share(weight), centred)
    centred -= centroid
    weighted = centred * W[:, None]
    energy = np.einsum("jri,jri->i", weighted, centred)
    return FrameTracks(weighted, W, centroid, weight, energy)


def joined_frames(parts: list[FrameTracks]) -> FrameTracks:
    """Return frames of several blocks, all with weights or none, as one block."""
    if len(parts) == 1:
        return parts[0]
    joined: list[Any] = []
    for values in zip(*parts, strict=True):
        joined.append(None if values[0] is None else np.concatenate(values, axis=-1))
    return FrameTracks(*joined)


def _share(weight: NDArray) -> NDArray:
    """Return the inverses of sums of weights, zero for frames without points."""
    return np.divide(1.0, weight, where=weight > 0, out=np.zeros_like(weight))


class ShapeProducts:
    """Products of shapes (n_shapes, 3, J), rows centred.

    rows (3 n_shapes, J): the shapes; gram: their Gram matrix over all points.
    """

    def __init__(self, shapes: NDArray):
        self.shapes = np.ascontiguousarray(shapes, dtype=np.float64)
        self.rows = self.shapes.reshape(-1, shapes.shape[-1])
        n = len(shapes)
        products = (self.rows @ self.rows.T).reshape(n, 3, n, 3).swapaxes(1, 2)
        pairs = products[pair_indices(n)]
        pairs = 0.5 * (pairs + pairs.swapaxes(1, 2))
        self.gram = Gram(pairs[:, ROWS, COLUMNS])

    @cached_property
    def pairs(self) -> NDArray:
        """Symmetric parts of ``b_kj b_lj^T`` of each point (6 n_pairs, J)."""
        return _pair_products(self.shapes).reshape(-1, self.rows.shape[1])


def frame_sums(tracks: FrameTracks, shapes: ShapeProducts) -> FrameSums:
    """Return the sums over the points of frames; complete ones share a Gram matrix."""
    deviations, W, centroid, weight, energy = tracks
    n_shapes, _, n_points = shapes.shapes.shape
    rows = shapes.rows
    cross = (rows @ deviations.reshape(n_points, -1)).reshape(n_shapes, 3, 2, -1)
    if W is None:
        means = np.zeros((n_shapes, 3, len(weight)))
        return FrameSums(cross, shapes.gram, means, centroid, weight, energy)
    means = ((rows @ W) * _share(weight)).reshape(n_shapes, 3, -1)
    pairs = (shapes.pairs @ W).reshape(-1, 6, len(weight))
    # G = sum_j w b b^T - weight mean mean^T. As the rows are centred over all points
    # the second term is small: no cancellation.
    pairs -= _pair_products(means * np.sqrt(weight))
    return FrameSums(cross, Gram(pairs), means, centroid, weight, energy)


def _pair_products(rows: NDArray) -> NDArray:
    """Return the symmetric parts of ``x_k x_l^T`` of (n, 3, m) as (n_pairs, 6, m)."""
    n = len(rows)
    products = np.empty((n * (n + 1) // 2, 6, rows.shape[2]))
    first, second = 0.5 * rows[:, ROWS], 0.5 * rows[:, COLUMNS]
    rows_of, columns_of = rows[:, ROWS], rows[:, COLUMNS]
    for k, product in enumerate(packed_rows(products)):
        np.multiply(first[k], columns_of[k:], out=product)
        product += second[k] * rows_of[k:]
    return products


def whitened(shapes: NDArray) -> tuple[NDArray, NDArray]:
    """
    Return shapes (n_shapes, 3, n_points) that are white, and the map T (3, 3) to them.

    ``sum_k T B_k B_k^T T^T``, the second moment of shapes whose coefficients are N(0,
    I), is the identity, with zeros on the diagonal where all shapes are flat. The axes
    are the principal axes of the mean shape. Its rows are zero where it is flat itself.
    """
    across = np.concatenate(list(shapes), axis=1)
    U, size, _ = np.linalg.svd(across, full_matrices=False)
    kept = size > FLAT * size[0]
    space = (kept / np.where(kept, size, 1.0))[:, None] * U.T
    axes, width, _ = np.linalg.svd(space @ shapes[0], full_matrices=False)
    space = axes.T @ space
    white = space @ shapes
    white[0, width <= FLAT] = 0.0
    return white, space


def determines_camera(products: FrameSums, mean_shape: NDArray) -> NDArray:
    """Return a mask (n,) of frames whose points determine a camera.

    They have 1e-10 or more of the variance of the mean shape (3, J) along each of its
    directions. The sums are for `whitened` shapes, with a Gram matrix for each frame.
    """
    variance = np.einsum("aj,aj->a", mean_shape, mean_shape) / mean_shape.shape[1]
    inside = variance > 0
    scale = 1.0 / np.sqrt(variance[inside])
    weight = np.where(products.weight > 0, products.weight, 1.0)
    # Variance over the points of a frame, relative to that over all points
    seen = unpack3(products.gram.pairs[0] / weight)[inside][:, inside]
    cover = np.linalg.eigvalsh((seen.T * scale).swapaxes(1, 2) * scale)
    return (products.weight > 0) & (cover > 1e-10).all(axis=1)


class CoefficientPosterior(NamedTuple):
    """Posterior of the coefficients of frames.

    c (n_shapes, I): one, and the posterior means of the coefficients. inverse (n_pairs,
    I): minus Q, packed; its row and column of the mean shape are void. objective (I,):
    ``min_a ||W - M S(a)||^2 + s2 |a|^2``. log_determinant (I,): ``log det(I + H /
    s2)``. image_energy (K, I): ``H_kk``, the energy of the images of the basis shapes.
    """

    c: NDArray
    inverse: NDArray
    objective: NDArray
    log_determinant: NDArray
    image_energy: NDArray

    @property
    def alpha(self) -> NDArray:
        """Means of the coefficients (n_components, n_frames)."""
        return self.c[1:]

    def residual(self, noise: NDArray | float) -> NDArray:
        """Return ``||W - M S||^2`` at the means."""
        return self.objective - noise * np.einsum("ki,ki->i", self.alpha, self.alpha)

    def spread(self, noise: NDArray | float) -> NDArray:
        """Return ``tr(H s2 Q) = s2 (K - s2 tr Q)``, the image's posterior variance."""
        diagonal = diagonal_of(self.inverse)[1:]
        return noise * (len(diagonal) + noise * self.inverse[diagonal].sum(axis=0))

    def covaried(self, vectors: NDArray) -> NDArray:
        """Return ``sum_l Q_kl v_l`` of vectors (K, p, I)."""
        negative = unpacked(self.inverse[len(self.c) :])
        return -np.einsum("kli,lpi->kpi", negative, vectors)

    def second_moments(self, noise: NDArray | float) -> NDArray:
        """Return ``E = c c^T + diag(0, s2 Q)``, packed (n_pairs, n_frames)."""
        n_shapes = len(self.c)
        moments = np.empty_like(self.inverse)
        moments[:n_shapes] = 0.0
        np.multiply(self.inverse[n_shapes:], -noise, out=moments[n_shapes:])
        for k, row in enumerate(packed_rows(moments)):
            row += self.c[k] * self.c[k:]
        return moments


def coefficient_posterior(
    products: FrameSums, M: NDArray, noise: NDArray | float, *, refined: bool = False
) -> CoefficientPosterior:
    """Return the posterior of the coefficients of frames for cameras M (2, 3, n).

    If `refined`, a step of iterative refinement keeps rounding errors small where they
    are divided by a tiny noise variance.
    """
    H = products.gram.energies(camera_gram(M))
    seen = np.einsum("kari,rai->ki", products.cross, M)
    n_shapes = len(seen)
    diagonal = diagonal_of(H)[1:]
    image_energy = H[diagonal]
    # [[||W - M B_0||^2, (q - h)^T], [q - h, H + s2 I]], packed. The sweep operator
    # replaces it by [[objective, mean^T], [mean, -Q]].
    H[diagonal] += noise
    H[0] += products.energy - 2 * seen[0]
    H[1:n_shapes] = seen[1:] - H[1:n_shapes]
    equations = H.copy() if refined else None
    log_determinant, _ = sweep(H, 1)
    objective, alpha = H[0], H[1:n_shapes]
    if equations is not None:
        # Iterative refinement with the residual of the normal equations
        left = equations[1:n_shapes] - _product(equations[n_shapes:], alpha)
        alpha -= _product(H[n_shapes:], left)
        objective -= np.einsum("ki,ki->i", alpha, left)
    objective = np.maximum(objective, 0.0)  # less is rounding errors
    log_determinant = log_determinant - len(alpha) * np.log(noise)
    c = with_one(alpha)
    return CoefficientPosterior(c, H, objective, log_determinant, image_energy)


def _product(packed: NDArray, vectors: NDArray) -> NDArray:
    """Return the products of packed symmetric matrices with vectors (k, n)."""
    return np.einsum("kli,li->ki", unpacked(packed), vectors)
