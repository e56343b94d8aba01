"""Marginal likelihood of cameras and shapes, with the coefficients integrated out.

Coefficients have the prior ``N(0, I)``. Coordinates have noise of variance s2. Write
``c = (1, alpha)`` and ``H_kl = <M B_k, M B_l>`` (k, l >= 1). Then minus twice the log
likelihood of all frames is, up to a constant ::

    N log s2 + sum_i [ min_alpha (||W_i - M_i sum_k c_k B_k||^2 / s2 + ||alpha||^2)
                       + log det(I + H_i / s2) ]

with N the number of coordinates that were seen. The objective adds ``penalty * sum_i tr
H_i``, minus twice the log prior of the basis shapes, and with calibrated cameras the
prior of the extents (`extent_penalty`).

Positions are eliminated by least squares: tracks and shapes are centred over the seen
points of each frame. Without weights the given shapes have to be centred already.

The gradient follows from the first two posterior moments of the coefficients, as in
expectation maximisation (Tipping, Bishop, "Probabilistic principal component analysis",
1999; Bishop, "Pattern recognition and machine learning", 2006, section 12.2).

All terms are sums over blocks of frames. Inside a block the frame is the last index.
Cameras M and their gradient G are (2, 3, n_frames).
"""

from collections.abc import Iterable
from functools import partial
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from isa_nrsfm._frames.point_sums import (
    FrameTracks,
    ShapeProducts,
    camera_gram,
    coefficient_posterior,
    frame_sums,
)
from isa_nrsfm._joint.frames import JointFrames
from isa_nrsfm._linalg.small_matrices import diagonal_of, frames_last, unpack3, unpacked
from isa_nrsfm._tables.blocks import BLOCK_FRAMES

# If one extent is r times both others, the fit must lower the noise variance by 4 % for
# r = 5 and by 12 % for r = 10. Without the penalty, frontal photos of faces give
# needle-like shapes. Weights of 0.015 and 0.02 do not change the errors of faces that
# turn by 6 degrees or more.
EXTENT_WEIGHT = 0.02
# Floor of the squared extents, as a share of their mean. Flat objects stay flat.
FLAT = 1e-3


class LikelihoodTerms(NamedTuple):
    """Objective, derivatives and posterior moments, from one pass over the frames.

    shape_gradient (n_shapes, 3, J): derivative of the value with respect to the shapes.
    noise_gradient: derivative with respect to the logarithm of the noise variance.
    shape_curvature (J or 1, 3 n_shapes, 3 n_shapes): ``sum_i w_ij E_i (x) M_i^T M_i``
    with the posterior second moments E_i of (1, alpha). Times ``2 / s2`` it is the
    Hessian by point j of the shapes, posterior and positions held fixed. One matrix for
    all points if all weights are one.
    residual: sum of squared residuals of the tracks at the posterior means.
    motion_gradient (2, 3, I): derivative with respect to the cameras.
    motion_curvature (6, I): ``sum_kl E_kl B_k B_l^T``, packed: the same for each row.
    alpha (K, I): posterior means of the coefficients.
    """

    value: float
    shape_gradient: NDArray
    noise_gradient: float
    shape_curvature: NDArray
    residual: float
    motion_gradient: NDArray
    motion_curvature: NDArray
    alpha: NDArray


class MarginalLikelihood:
    """The objective and its derivatives, as a sum over blocks of frames.

    penalty: factor of ``sum_i tr H_i``, or one (K,) for each diagonal entry.
    extent_weight: weight of the prior of the extents, for each coordinate.
    n_seen: number N of coordinates that were seen.
    square: weighted energy of the centred tracks.
    """

    def __init__(
        self, frames: JointFrames, penalty: NDArray | float, extent_weight: float = 0.0
    ):
        self.frames, self.penalty, self.extent_weight = frames, penalty, extent_weight
        self.n_frames, (self.n_seen, self.square) = frames.n_frames, frames.totals

    def __call__(
        self, shapes: NDArray, motion: NDArray, noise: float
    ) -> LikelihoodTerms:
        """Return the terms at shapes (n, 3, J), motion (I, 2, 3), noise variance s2."""
        terms = self._sums(shapes, motion, noise)
        # Matrices (n, size, size) from the sums, packed by shapes and by axes
        size, packed = 3 * len(shapes), terms.shape_curvature
        curvature = unpack3(unpacked(packed)).transpose(4, 0, 2, 1, 3)
        curvature = curvature.reshape(-1, size, size)
        columns = shapes.reshape(size, -1).T[:, :, None]
        pulled = (curvature @ columns)[:, :, 0].T.reshape(shapes.shape)
        value = terms.value + self.n_seen * np.log(noise)
        shape_gradient = terms.shape_gradient + (2 / noise) * pulled
        if self.extent_weight:
            weight = self.extent_weight * self.n_seen
            # With one curvature for all points the shapes are centred already.
            penalty, slope = extent_penalty(shapes, centred=len(curvature) == 1)
            value += weight * penalty
            # Points that are visible in no frame stay in place: their curvature is
            # zero.
            seen = curvature.any(axis=(1, 2))
            shape_gradient = shape_gradient + weight * np.where(seen, slope, 0.0)
        return terms._replace(
            value=float(value),
            shape_gradient=shape_gradient,
            noise_gradient=float(terms.noise_gradient + self.n_seen),
            shape_curvature=curvature,
        )

    def coefficients(self, shapes: NDArray, motion: NDArray, noise: float) -> NDArray:
        """Return the posterior means of the coefficients (n_frames, n_components)."""
        return np.ascontiguousarray(self._sums(shapes, motion, noise).alpha.T)

    def _sums(self, shapes: NDArray, motion: NDArray, noise: float) -> LikelihoodTerms:
        """Return the sums over all frames, with the curvature of the shapes packed."""
        # If the noise is tiny, refine the solution of the normal equations by one step.
        tiny_noise = noise * self.n_seen < 1e-7 * self.square
        over_block = partial(
            _block_terms,
            shapes=ShapeProducts(shapes),
            noise=noise,
            penalty=self.penalty,
            tiny_noise=tiny_noise,
        )
        return _joined(self.frames.blocks.map(over_block, motion))


def _joined(parts: Iterable[LikelihoodTerms]) -> LikelihoodTerms:
    """Add the sums of consecutive frames, and concatenate the terms of each frame."""
    remaining, n_sums = iter(parts), 5
    first = next(remaining)
    sums: list[Any] = list(first[:n_sums])
    by_frame = [first[n_sums:]]
    for part in remaining:
        sums = [a + b for a, b in zip(sums, part[:n_sums], strict=True)]
        by_frame.append(part[n_sums:])
    if len(by_frame) == 1:
        return first
    joined = (np.concatenate(each, axis=-1) for each in zip(*by_frame, strict=True))
    return LikelihoodTerms(*sums, *joined)


def _block_terms(
    block: FrameTracks, motion: NDArray, **constants: Any
) -> LikelihoodTerms:
    """Return the terms of a block, summed over pieces whose matrices fit the cache."""
    M = frames_last(motion)
    return _joined(
        _frame_terms(piece, M[:, :, frames], **constants)
        for frames, piece in block.pieces(BLOCK_FRAMES)
    )


def _frame_terms(
    block: FrameTracks,
    M: NDArray,
    shapes: ShapeProducts,
    noise: float,
    penalty: NDArray | float,
    tiny_noise: bool,
) -> LikelihoodTerms:
    """Return the sums over frames, M (2, 3, n_frames), as `MarginalLikelihood._sums`.

    The curvature of the shapes is packed: (n_pairs, 6, n_points or 1).
    """
    n_shapes, _, n_points = shapes.shapes.shape
    products = frame_sums(block, shapes)
    posterior = coefficient_posterior(products, M, noise, refined=tiny_noise)
    c, alpha = posterior.c, posterior.alpha
    value = np.sum(posterior.objective / noise + posterior.log_determinant)
    value += np.sum(penalty * posterior.image_energy.sum(axis=1))
    residual = float(posterior.residual(noise).sum())
    spread = float(posterior.spread(noise).sum())

    # Second moments E of c. The penalty acts as if E_kk were larger by s2 penalty.
    moments = posterior.second_moments(noise)
    moments[diagonal_of(moments)[1:]] += noise * np.reshape(penalty, (-1, 1))
    cameras = camera_gram(M)
    # With respect to the cameras: M A - sum_k c_k P_k^T with A = sum_kl E_kl B_k B_l^T
    motion_curvature = products.gram.moments(moments)
    A = unpack3(motion_curvature)
    G = np.einsum("rbi,bai->rai", M, A)
    G -= np.einsum("ki,kari->rai", c, products.cross)
    # With respect to the shapes: sum_i X_i^T W_i with X_i = c_i^T (x) M_i
    X = (c[:, None, None] * M.swapaxes(0, 1)).reshape(3 * n_shapes, -1)
    shape_gradient = X @ block.deviations.reshape(n_points, -1).T
    if block.weights is None:
        shape_curvature = (moments @ cameras.T)[:, :, None]
    else:
        pairs = (moments[:, None] * cameras).reshape(6 * len(moments), -1)
        shape_curvature = (pairs @ block.weights.T).reshape(-1, 6, n_points)
        # The eliminated position of a frame depends on weighted means of the shapes.
        mixed = np.einsum("kli,lbi->kbi", unpacked(moments), products.shape_centroid)
        means = np.einsum("abi,kbi->kai", unpack3(cameras), mixed)
        shape_gradient += means.reshape(3 * n_shapes, -1) @ block.weights.T
    return LikelihoodTerms(
        value=float(value),
        shape_gradient=(-2 / noise) * shape_gradient.reshape(shapes.shapes.shape),
        noise_gradient=-(residual + spread) / noise,
        shape_curvature=shape_curvature,
        residual=residual,
        motion_gradient=(2 / noise) * G,
        motion_curvature=motion_curvature,
        alpha=alpha,
    )


def extent_penalty(shapes: NDArray, centred: bool = True) -> tuple[float, NDArray]:
    """Compute the penalty of shapes (n, 3, J) and its gradient, for N weight 1.

    If an object hardly turns, its images determine the depth only to second order.
    Depths c times as large with rotations c times smaller give nearly the same images
    (bas-relief ambiguity: Belhumeur, Kriegman, Yuille, 1999). Unmodelled deformation
    then dominates the estimated depth. With the second moments ``G = sum_k B_k B_k^T``
    of all shapes the objective contains, for N coordinates, ::

        N weight (tr G / (3 det(G)^(1/3)) - 1),

    with the ratio of the arithmetic to the geometric mean of the squared extents. The
    penalty is zero for equal extents in all directions, and grows with N like the
    misfit.
    """
    B = shapes if centred else shapes - shapes.mean(axis=2, keepdims=True)
    G = np.einsum("kaj,kbj->ab", B, B)
    mean = np.trace(G) / 3
    if not mean > 0:
        return 0.0, np.zeros_like(B)
    square, axes = np.linalg.eigh(G)
    square = square / mean
    thick = square > FLAT
    square = np.maximum(square, FLAT)
    ratio = 1.0 / np.cbrt(np.prod(square))
    # Derivative of the logarithm of the ratio by G, times the mean extent
    slope = -((axes * (thick / square)) @ axes.T) / 3
    slope += (np.sum(thick) / 9) * np.eye(3)
    gradient = np.tensordot(slope, B, axes=(1, 1)).swapaxes(0, 1)
    return ratio - 1.0, (2.0 * ratio / mean) * gradient
