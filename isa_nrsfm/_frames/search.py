"""Most probable camera, position and coefficients of frames, for given shapes.

Shapes and noise variance s2 are given. For each frame by itself, this minimises minus
twice the log marginal likelihood of its camera, with the coefficients integrated out ::

    F(M) = f(M) / s2 + log det(I + H / s2),  f(M) = min_a ||W - M S(a)||^2 + s2 |a|^2,

over affine cameras, scaled rotations ``M(w, l) = exp(l) M exp(hat(w))`` or, where
scales are known, rotations. With the posterior moments c and E of
`coefficient_posterior` the gradient is, as in expectation maximisation, ``dF/dM = 2 G /
s2``, ``G = M A - sum_k c_k P_k^T``, ``A = sum_kl E_kl B_k B_l^T``. Along the tangents
D_c of a camera, ``s2 / 2`` times the Hessian is ::

    tr(D_c A D_d^T) + <G, D_cd> - sum_kl <D_c, F_k> Q_kl <D_d, F_l>,

with ``F_k = M (B_k S^T + S B_k^T) - P_k^T``, ``Q = (H + s2 I)^-1`` and the second
derivative D_cd of the camera. This is exact except for the log determinant: its second
derivative is replaced by the bound that A contains.

Newton's method works on many frames at once, the frame as the last index of all arrays.
Steps are damped by ``tr(D_c A D_d^T)`` if the Hessian is not positive definite or a
step has raised the objective of a frame. So the objective never rises. The search
starts from zero coefficients. Badly fitted frames start again from others.

Cameras and coefficients are fitted to shapes ``B_k`` (3, J). The fit depends on frame i
only through sums over its points: its energy, the products ``P_ik`` of its points with
the shapes, and the Gram matrices ``G_i,kl`` of the shapes over its points ::

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
from isa_nrsfm._frames.camera_models import CAMERAS, CameraModel, nearest_calibrated
from isa_nrsfm._linalg import (
    COLUMNS,
    DIAGONAL,
    LANES,
    OF_STEPS,
    ROWS,
    diagonal_of,
    frames_first,
    frames_last,
    inverse3,
    invert_positive,
    of_frames,
    packed_products,
    packed_rows,
    padded,
    pair_indices,
    solve_positive,
    sweep,
    unpack3,
    unpacked,
)
from isa_nrsfm._tables import BLOCK_FRAMES, seen_points

# Multiplicity of the entries of packed symmetric 3x3 matrices in ``<S, Q>``: those off
# the diagonal count twice.
TWICE = np.array([1.0, 2.0, 2.0, 1.0, 2.0, 1.0])
# Numbers that fit the cache: docs/benchmarks/README.md, "Thresholds".
IN_CACHE = 2**18
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
        if self.pairs.ndim == 2:
            return (self._multiplicity * self.pairs).T @ C
        return self._times(self.pairs.swapaxes(0, 1), self._multiplicity * C)

    def energies(self, Q: NDArray) -> NDArray:
        """Return ``H_kl = <G_kl, Q>`` (n_pairs, n), packed; Q (6, n) is packed."""
        return self._times(self.pairs, TWICE[:, None] * Q)

    def of_frames(self, frames: NDArray) -> Self:
        """Return the Gram matrices of some of the frames."""
        if self.pairs.ndim == 2:
            return self
        return type(self)(self.pairs.take(frames, -1))


def n_together(n_shapes: int) -> int:
    """Return a number of frames whose packed matrices of coefficients fit the cache."""
    n_pairs = n_shapes * (n_shapes + 1) // 2
    return max(min(IN_CACHE // n_pairs, BLOCK_FRAMES), LANES)


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

    def pieces(self, n_shapes: int) -> Iterator[tuple[slice, Self]]:
        """Yield slices of at most `n_together` consecutive frames, and these frames."""
        total, length = len(self.weight), n_together(n_shapes)
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
    return np.einsum("rpi,rpi->pi", M.take(ROWS, 1), M.take(COLUMNS, 1))


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
    columns: Any = zip(*parts, strict=True)
    join = partial(np.concatenate, axis=-1)
    return FrameTracks._make(None if c[0] is None else join(c) for c in columns)


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


# Frames, given by their sums for the shapes, and their noise variances (n,)
FrameProblem = tuple[FrameSums, Any]


class CoefficientPosterior(NamedTuple):
    """Posterior of the coefficients of frames for cameras M (2, 3, I).

    c (n_shapes, I): one, and the posterior means of the coefficients. inverse (n_pairs,
    I): minus Q, packed; its row and column of the mean shape are void. objective (I,):
    ``min_a ||W - M S(a)||^2 + s2 |a|^2``. log_determinant (I,): ``log det(I + H /
    s2)``. image_energy (K, I): ``H_kk``, the energy of the images of the basis shapes.
    """

    problem: FrameProblem
    M: NDArray
    c: NDArray
    inverse: NDArray
    objective: NDArray
    log_determinant: NDArray
    image_energy: NDArray

    @property
    def alpha(self) -> NDArray:
        """Means of the coefficients (n_components, n_frames)."""
        return self.c[1:]

    @property
    def value(self) -> NDArray:
        """``s2 F`` (I,)."""
        return self.objective + self.problem[1] * self.log_determinant

    @property
    def residual(self) -> NDArray:
        """``||W - M S||^2`` (I,) at the means."""
        alpha, noise = self.alpha, self.problem[1]
        return self.objective - noise * np.einsum("ki,ki->i", alpha, alpha)

    @property
    def spread(self) -> NDArray:
        """``tr(H s2 Q) = s2 (K - s2 tr Q)`` (I,), the image's posterior variance."""
        diagonal, noise = diagonal_of(self.inverse)[1:], self.problem[1]
        return noise * (len(diagonal) + noise * self.inverse[diagonal].sum(axis=0))

    def covaried(self, vectors: NDArray) -> NDArray:
        """Return ``sum_l Q_kl v_l`` of vectors (K, p, I)."""
        negative = unpacked(self.inverse[len(self.c) :])
        return -np.einsum("kli,lpi->kpi", negative, vectors)

    def second_moments(self) -> NDArray:
        """Return ``E = c c^T + diag(0, s2 Q)``, packed (n_pairs, n_frames)."""
        n_shapes = len(self.c)
        moments, other = (self.c.take(side, 0) for side in pair_indices(n_shapes))
        moments *= other
        moments[n_shapes:] -= self.problem[1] * self.inverse[n_shapes:]
        return moments

    def by_cameras(self, moments: NDArray) -> tuple[NDArray, NDArray]:
        """Return A, packed (6, n), and G (2, 3, n), for packed second moments E."""
        products = self.problem[0]
        A = products.gram.moments(moments)
        G = np.einsum("rbi,bai->rai", self.M, unpack3(A))
        return A, G - np.einsum("ki,kari->rai", self.c, products.cross)


def coefficient_posterior(
    problem: FrameProblem, M: NDArray, *, refined: bool = False
) -> CoefficientPosterior:
    """Return the posterior of the coefficients of frames for cameras M (2, 3, n).

    If `refined`, a step of iterative refinement keeps rounding errors small where they
    are divided by a tiny noise variance.
    """
    products, noise = problem
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
    moments = with_one(alpha), H, objective, log_determinant, image_energy
    return CoefficientPosterior(problem, M, *moments)


def _product(packed: NDArray, vectors: NDArray) -> NDArray:
    """Return the products of packed symmetric matrices with vectors (k, n)."""
    return np.einsum("kli,li->ki", unpacked(packed), vectors)


# Largest number of steps of a search.
MAX_STEPS = 60
# The search of a frame ends at this damping: its steps no longer move it.
LARGEST_DAMPING = 1e8
# Objectives with a smaller relative difference are equal.
EQUAL = 1e-10
# Maps cameras, in the axes of the mean shape, to their depth reversals. Reflecting a
# flat object at its plane does not change its images. The thinner an
# object is, the less its images change (Necker reversal).
REVERSED = np.array([1.0, 1.0, -1.0])[:, None]
# A search from a reversed camera that comes nearer than this share of its first
# distance returns to where it came from: docs/benchmarks/README.md, "Thresholds".
SAME_WELL = 0.1
# The reversed camera is not tried if the objective rises by more than this multiple of
# itself on the way there: docs/benchmarks/README.md, "Thresholds".
LARGE_RISE = 20.0


class FramePosterior(NamedTuple):
    """Fits of frames; NaN for frames whose points do not determine a camera.

    motion (I, 2, 3): cameras, in the units of the tracks per unit of the shapes.
    translation (I, 2): image of the origin of the shapes.
    covariance (I, K, K) or (I, 0, 0): posterior covariance of alpha in the normal
    approximation at the optimum (Laplace), with the uncertainty of camera and position.
    turn_covariance (I, 3, 3): posterior covariance of the rotation vectors w of ``M
    exp(hat(w))``, with the uncertainty of the coefficients. NaN for affine cameras.
    objective (I,): ``sum_j w_ij ||m_ij - M S_j - t||^2 + s2 |a|^2``, to 1e-12 of the
    energy.
    """

    motion: NDArray
    translation: NDArray
    alpha: NDArray
    covariance: NDArray
    turn_covariance: NDArray
    objective: NDArray

    @classmethod
    def unknown(
        cls, n_frames: int, n_components: int, covariances: bool = True
    ) -> Self:
        """Return fits of NaN, to be filled in, with or without covariances."""
        size = n_components if covariances else 0
        shapes = (2, 3), (2,), (n_components,), (size, size), (3, 3), ()
        return cls._make(np.full((n_frames, *shape), np.nan) for shape in shapes)

    def take(self, frames: NDArray) -> Self:
        """Return the fits of some of the frames."""
        return type(self)(*(part[frames] for part in self))

    def put(self, frames: NDArray, others: Self) -> None:
        """Set the fits of some of the frames."""
        for part, other in zip(self, others, strict=True):
            part[frames] = other


def scale_of(problem: FrameProblem) -> NDArray:
    """Return ``||W||^2 + s2`` (n,), the scale of gains and rounding errors."""
    products, noise = problem
    return products.energy + noise


class State(NamedTuple):
    """
    The objectives of frames at some positions, up to constants, and their derivatives.

    position (..., n): coefficients or cameras; slope: minus half the gradient.
    definite (n_pairs, n): a semidefinite part of the Hessian, packed, for damping.
    hessian (n_pairs, n): half the Hessian, packed.
    """

    position: NDArray
    value: NDArray
    slope: NDArray
    definite: NDArray
    hessian: NDArray

    def inverse(self) -> NDArray:
        """Return inverse Hessians (p, p, n), or of `definite` where indefinite."""
        inverse, positive = invert_positive(self.hessian)
        bad = padded(np.flatnonzero(~positive))
        if len(bad):
            inverse[:, bad] = invert_positive(self.definite[:, bad])[0]
        return unpacked(inverse)


# Minima below which lower ones are searched: positions (..., n), values (n,) to fall
# below, and distances (n,) from the positions within which a search is in the same well
Minima = tuple[NDArray, NDArray, NDArray]


class FrameSearch:
    """A search for cameras of one model that see given shapes, frame by frame.

    Shapes (K + 1, 3, J) are centred, with coefficients that are drawn from N(0, I). The
    search has its own coordinates, to which `space` (3, 3) maps the original ones: the
    principal axes of the mean shape, the thinnest one last. With affine cameras the
    shapes are white.
    """

    def __init__(self, shapes: NDArray, model: CameraModel):
        self.model = model
        if model.calibrated:
            axes, size, _ = np.linalg.svd(shapes[0], full_matrices=False)
            shapes, self.space = axes.T @ shapes, axes.T
            shapes[0, size <= FLAT * size[0]] = 0.0
        else:
            shapes, self.space = whitened(np.ascontiguousarray(shapes))
        self.shared = ShapeProducts(shapes)

    def fit_rows(
        self,
        rows: NDArray,
        noise: NDArray | float,
        *,
        weights: NDArray | None = None,
        initial: NDArray | None = None,
        starts: NDArray | None = None,
        covariances: bool = True,
    ) -> FramePosterior:
        """Fit rows (I, 2, J), NaN where a point is missing, as `fit` does.

        The noise variance is at least 1e-13 of the energy. Weights (I, J) are 1 by
        default.
        """
        n_frames, n_components = len(rows), len(self.shared.shapes) - 1
        noise = np.broadcast_to(np.asarray(noise, dtype=float), (n_frames,))
        weights = np.where(seen_points(rows), 1.0 if weights is None else weights, 0.0)
        complete = (weights == 1.0).all(axis=1)
        fits = FramePosterior.unknown(n_frames, n_components, covariances)
        fit = partial(self.fit, starts=starts, covariances=covariances)
        # Complete frames share one Gram matrix.
        for chosen in np.flatnonzero(complete), np.flatnonzero(~complete):
            if len(chosen):
                frames = padded(chosen)
                frame_weights = None if complete[frames[0]] else weights[frames]
                first = None if initial is None else initial[frames]
                tracks = frame_tracks(rows[frames], frame_weights)
                fits.put(frames, fit(tracks, noise[frames], initial=first))
        return fits

    def fit(
        self,
        frames: FrameTracks,
        noise: NDArray | float,
        *,
        initial: NDArray | None = None,
        starts: NDArray | None = None,
        covariances: bool = True,
    ) -> FramePosterior:
        """Return the most probable camera, position and coefficients of each frame.

        The shapes are by points or directions, as the frames. `initial` (I, K) is zero
        by default. If the residuals of a frame are much larger than the noise, it
        starts again from each of `starts` (n_starts, K).

        Frames are independent. They are NaN if their points do not determine a camera.
        If only the mean shape is flat, zero can be a saddle point: further starts help.
        """
        n_frames, n_components = len(frames.weight), len(self.shared.shapes) - 1
        noise = np.broadcast_to(np.asarray(noise, dtype=float), (n_frames,))
        length = n_together(n_components + 1)

        def searched(chosen: NDArray, initial: NDArray) -> FramePosterior:
            """Return the fits that frames reach from coefficients (n_chosen, K)."""
            fits = FramePosterior.unknown(len(chosen), n_components, covariances)
            for first in range(0, len(chosen), length):
                block = padded(np.arange(first, min(first + length, len(chosen))))
                products = frame_sums(of_frames(frames, chosen[block]), self.shared)
                if frames.weights is not None:
                    determined = determines_camera(products, self.shared.shapes[0])
                    if not determined.all():
                        usable = padded(np.flatnonzero(determined))
                        block, products = block[usable], of_frames(products, usable)
                problem = self.problem(products, noise[chosen[block]])
                start = self.start(problem, initial[block].T)
                M = self.descend(problem, start, MAX_STEPS)
                posterior = self._unreversed(problem, M)
                covariance, turns = fits.covariance[block], fits.turn_covariance[block]
                if covariances:
                    covariance, turns = map(frames_first, self._covariances(posterior))
                    turns = self.space.T @ turns @ self.space
                motion, alpha = frames_first(posterior.M), posterior.alpha.T
                places = products.positions(motion, alpha)
                kept = covariance, turns, posterior.objective
                fit = FramePosterior(motion @ self.space, places, alpha, *kept)
                fits.put(block, fit)
            return fits

        initial = np.zeros((n_frames, n_components)) if initial is None else initial
        fits = searched(np.arange(n_frames), initial)
        # Further starts for frames with large residuals, all starts at once. At the
        # minimum, f / s2 is the squared Mahalanobis distance of a frame from the model.
        # It is chi-squared distributed, with two degrees of freedom per point minus the
        # eight of camera and position. The threshold is three times its expectation.
        limit = 3.0 * noise * np.maximum(2.0 * frames.weight - 8.0, 1.0)
        poor = np.flatnonzero(fits.objective > limit)
        if starts is None or not len(starts) or not len(poor):
            return fits
        initial = np.repeat(starts, len(poor), axis=0)
        restarts = searched(np.tile(poor, len(starts)), initial)
        # Of equal minima, keep the first.
        objective = restarts.objective.reshape(len(starts), -1)
        best = np.argmax(objective <= (1 + EQUAL) * objective.min(axis=0), axis=0)
        best = best * len(poor) + np.arange(len(poor))
        gain = fits.objective[poor] - restarts.objective[best]
        better = gain > EQUAL * fits.objective[poor]
        fits.put(poor[better], restarts.take(best[better]))
        return fits

    def problem(self, products: FrameSums, variance: NDArray) -> FrameProblem:
        """Return frames with noise variances (n,) that are not zero."""
        noise = np.maximum(variance, 1e-13 * products.energy)
        return products, np.where(noise > 0, noise, 1.0)

    def reversed_cameras(
        self, problem: FrameProblem, motion: NDArray
    ) -> tuple[NDArray, NDArray]:
        """Return the better of cameras (n, 2, 3) and reversed ones, and their mask."""
        M = frames_last(motion @ self.space.T)
        # The cameras may not be at their minimum yet: compare minima with minima. With
        # 3, 6 and 12 steps 22, 7 and 1 % of reversed frames of motion capture remain.
        n_steps = 6
        M = self.descend(problem, self.evaluate(problem, M), n_steps)
        # Shapes that are not fitted yet can explain a reversed frame well: try all.
        posterior, every = coefficient_posterior(problem, M), np.arange(len(motion))
        M, better = self._better_reversed(posterior, every, n_steps)
        motion = motion.copy()
        motion[better] = frames_first(M[:, :, better]) @ self.space
        return motion, better

    def reversals(
        self, problem: FrameProblem, motion: NDArray
    ) -> tuple[NDArray, NDArray, NDArray]:
        """Return the minima from cameras and from reversed ones: (n, 2, 2, 3).

        The second result (n, 2, K) is alpha there, the third one (n,) the rise of -2
        log L from the first to the second minimum.
        """
        M = frames_last(motion @ self.space.T)
        starts = (self.evaluate(problem, start) for start in (M, M * REVERSED))
        ends = [self.descend(problem, start, 30) for start in starts]
        here, there = (coefficient_posterior(problem, end) for end in ends)
        motion = np.stack([frames_first(end) @ self.space for end in ends], axis=1)
        alpha = np.stack([here.alpha.T, there.alpha.T], axis=1)
        return motion, alpha, (there.value - here.value) / problem[1]

    def start(self, problem: FrameProblem, alpha: NDArray) -> State:
        """Return the state at cameras near the affine ones for alpha (K, n).

        If calibrated, the better of the nearest and the `_completed` camera is taken.
        """
        M = affine_cameras(problem[0], with_one(alpha))
        if not self.model.calibrated:
            return self.evaluate(problem, M)
        starts = calibrated_starts(self.model, M)
        first, second = (coefficient_posterior(problem, M) for M in starts)
        lower = second.value < first.value
        parts = zip(first[1:], second[1:], strict=True)
        chosen = (np.where(lower, other, each) for each, other in parts)
        return self._derivatives(CoefficientPosterior(problem, *chosen))[0]

    def evaluate(self, problem: FrameProblem, position: NDArray) -> State:
        """Return ``s2 F`` and its derivatives at M (2, 3, n)."""
        return self._derivatives(coefficient_posterior(problem, position))[0]

    def _derivatives(self, posterior: CoefficientPosterior) -> tuple[State, NDArray]:
        """Return the state at M (2, 3, n), and ``Q C`` (K, p, n), C = <D_c, F_k>."""
        M = posterior.M
        A, G = posterior.by_cameras(posterior.second_moments())
        gradient, definite = self.model.gradient(M, G), self.model.curvature(M, A)
        # The coefficients follow: - sum_kl <D_c, F_k> Q_kl <D_d, F_l>
        coupling = self.model.gradient(M, _changes(posterior))
        through = posterior.covaried(coupling)
        hessian = definite + self.model.second(M, G, gradient)
        hessian -= packed_products(through.swapaxes(0, 1), coupling.swapaxes(0, 1))
        return State(M, posterior.value, -gradient, definite, hessian), through

    def _unreversed(self, problem: FrameProblem, M: NDArray) -> CoefficientPosterior:
        """Return the posterior for cameras (2, 3, n), or for lower reversed minima."""
        posterior = coefficient_posterior(problem, M)
        if not self.model.calibrated:
            return posterior
        tried = np.flatnonzero(~(_rise(posterior) > LARGE_RISE * posterior.value))
        M, better = self._better_reversed(posterior, tried, MAX_STEPS)
        return coefficient_posterior(problem, M) if better.any() else posterior

    def _covariances(self, posterior: CoefficientPosterior) -> tuple[NDArray, NDArray]:
        """Return the covariances of coefficients (K, K, n) and of rotations (3, 3, n).

        They come from the inverse joint Hessian ``s2 (Q + Q C^T Y^-1 C Q)``. C is the
        coupling, Y the Hessian by the camera with the coefficients eliminated.
        """
        noise = posterior.problem[1]
        state, through = self._derivatives(posterior)
        inverse = state.inverse()
        widened = np.einsum("kci,cdi->kdi", through, inverse)
        covariance = np.einsum("kdi,ldi->kli", widened, through)
        covariance -= unpacked(posterior.inverse[len(posterior.c) :])
        covariance = 0.5 * (covariance + covariance.swapaxes(0, 1))
        turns = noise * inverse[:3, :3] if self.model.calibrated else np.nan
        return noise * covariance, np.broadcast_to(turns, (3, 3, len(noise)))

    def _better_reversed(
        self, posterior: CoefficientPosterior, tried: NDArray, max_steps: int
    ) -> tuple[NDArray, NDArray]:
        """Return cameras (2, 3, n), or minima from reversed ones where these are lower.

        The indices of those to reverse are `tried`. Also returns a mask (n,) of
        replaced cameras.
        """
        problem, M, value = posterior.problem, posterior.M, posterior.value
        limit = value - 1e-10 * scale_of(problem)
        cameras, better = M.copy(), np.zeros(len(value), dtype=bool)
        tried = padded(tried)
        if len(tried):
            problem, M, limit = of_frames((problem, M, limit), tried)
            start = self.evaluate(problem, M * REVERSED)
            # The reversed camera and M differ in the third column.
            radius = SAME_WELL * 2.0 * np.hypot(M[0, 2], M[1, 2])
            other = self.descend(problem, start, max_steps, (M, limit, radius))
            better[tried] = lower = coefficient_posterior(problem, other).value < limit
            cameras[..., tried] = np.where(lower, other, M)
        return cameras, better

    def descend(
        self,
        problem: FrameProblem,
        state: State,
        max_steps: int,
        minima: Minima | None = None,
    ) -> NDArray:
        """Minimise the objectives; return iterates (..., n).

        Gives up a frame that is not expected to end below its known minimum.
        """
        n_frames, ends = len(state.value), state.position.copy()
        running, damping = np.arange(n_frames), np.zeros(n_frames)
        for n_left in range(max_steps, -1, -1):
            # Next step, and convergence test by its predicted decrease. Convergence is
            # quadratic: the step after it would gain far less.
            step, damping = self.step(state, damping)
            gain = np.einsum("pi,pi->i", state.slope, step)
            small = (damping == 0) & (gain <= 1e-12 * scale_of(problem))
            leaving = small | (damping >= LARGEST_DAMPING)
            if minima is not None:
                minimum, value, radius = minima
                square = (state.position - minimum).reshape(-1, len(gain)) ** 2
                near = square.sum(axis=0) < radius**2
                leaving |= near | (state.value - 10.0 * gain > value)
            # Remove frames that have ended; converged ones take a last step.
            if leaving.any():
                last = self.model.moved(state.position, np.where(small, step, 0.0))
                ends[..., running[leaving]] = last[..., leaving]
                if leaving.all():
                    return ends
                left = padded(np.flatnonzero(~leaving))
                problem, state, step, running, damping, minima = of_frames(
                    (problem, state, step, running, damping, minima), left
                )
            if not n_left:
                break
            # Trial step, refused where the objective rises. Less damping after a good
            # step, more after a refused one.
            trial = self.evaluate(problem, self.model.moved(state.position, step))
            highest = state.value + OF_STEPS * scale_of(problem)
            worse = np.flatnonzero(~(trial.value <= highest))
            eased = np.where(damping > 0.01, 0.1 * damping, 0.0)
            if len(worse):
                eased[worse] = raised(damping[worse])
                for new, old in zip(trial, state, strict=True):
                    new[..., worse] = old[..., worse]
            state, damping = trial, eased
        ends[..., running] = state.position
        return ends

    def step(self, state: State, damping: NDArray) -> tuple[NDArray, NDArray]:
        """Return Newton steps (p, n) and the damping (n,) that makes them definite."""
        matrix, damping = state.hessian, damping.copy()
        if damping.any():
            matrix = matrix + damping * state.definite
        step, positive = solve_positive(matrix, state.slope)
        failing = padded(np.flatnonzero(~positive))
        while len(failing):
            damping[failing] = raised(damping[failing])
            part = of_frames(state, failing)
            matrix = part.hessian + damping[failing] * part.definite
            step[:, failing], positive = solve_positive(matrix, part.slope)
            still = ~positive & (damping[failing] < LARGEST_DAMPING)
            failing = padded(np.unique(failing[still]))
        return self.model.limited(step), damping


def calibrated_starts(model: CameraModel, M: NDArray) -> list[NDArray]:
    """Return the nearest and the `_completed` cameras of affine cameras M (2, 3, n)."""
    rows, scales = nearest_calibrated(frames_first(M))
    starts = (frames_last(rows), scales), _completed(M)
    return [scale * rows if model.scaled else rows for rows, scale in starts]


def _completed(M: NDArray) -> tuple[NDArray, NDArray]:
    """Return orthonormal rows and scales from the first two columns of affine cameras.

    The third column of cameras (2, 3, n) belongs to the thinnest axis. For thin objects
    it is not determined. The first two, N, have singular values s_1 and s_2. In a
    scaled rotation of scale s_1 the third, z, has ``z z^T = s_1^2 I - N N^T``, and
    here the sign of the affine camera.
    """
    N, third = M[:, :2], M[:, 2]
    (p, r), q = (N**2).sum(axis=1), (N[0] * N[1]).sum(axis=0)
    half = 0.5 * (p - r)
    height = np.hypot(half, q)
    scale = np.sqrt(0.5 * (p + r) + height)
    scale = np.where(scale > 0, scale, 1.0)
    # The larger entry of z, and the other one from their product -q, without cancelling
    large = np.sqrt(height + np.abs(half))
    small = np.divide(-q, large, where=large > 0, out=np.zeros_like(q))
    z = np.where(half > 0, (small, large), (large, small)) / scale
    z = np.where((z * third).sum(axis=0) < 0, -z, z)
    N = np.where(p + r > 0, N / scale, np.eye(2)[..., None])
    return np.concatenate([N, z[:, None]], axis=1), scale


def _rise(posterior: CoefficientPosterior) -> NDArray:
    """Return the least rise (n,) of the objective on the way to the reversed camera.

    A reversal turns the third column z of M (2, 3, n) over. On the way ``<z', z> = 0``.
    The objective of affine cameras is there higher by at least ``|z|^2 / <e, Y^-1 e>``,
    ``e = (0, 0, z) / |z|``, in the quadratic approximation with half the Hessian Y.
    This neglects the gradient at M, and Y bounds the log determinant from above.
    """
    M, K, n = posterior.M, len(posterior.alpha), posterior.M.shape[2]
    F = _changes(posterior).reshape(K, 6, n)
    A = posterior.problem[0].gram.moments(posterior.second_moments())
    Y = CAMERAS["affine"].curvature(M, A)
    Y -= packed_products(posterior.covaried(F).swapaxes(0, 1), F.swapaxes(0, 1))
    z = (M * (REVERSED < 0)).reshape(6, n)
    square = np.einsum("pi,pi->i", z, z)
    e = z / np.sqrt(np.where(square > 0, square, 1.0))
    steps, definite = solve_positive(Y, e)
    definite &= square > 0
    variance = np.where(definite, np.einsum("pi,pi->i", e, steps), 1.0)
    return np.where(definite, square / variance, 0.0)


def _changes(posterior: CoefficientPosterior) -> NDArray:
    """Return ``F_k`` (K, 2, 3, n) of the basis shapes for the cameras."""
    products = posterior.problem[0]
    changes = unpack3(products.gram.products(posterior.c)[1:])
    F = np.einsum("rbi,kbai->krai", posterior.M, changes)
    F -= products.cross[1:].swapaxes(1, 2)
    return F


def raised(damping: NDArray) -> NDArray:
    """Return increased damping (n,)."""
    return np.maximum(8.0 * damping, 0.1)
