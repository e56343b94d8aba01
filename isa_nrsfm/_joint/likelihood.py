"""Marginal likelihood of cameras and shapes, with the coefficients integrated out.

The coefficients of a frame are drawn from ``N(0, I)``. Every coordinate has noise of
variance s2. Write ``c = (1, alpha)`` and ``H_kl = <M B_k, M B_l>`` (k, l >= 1). Then
minus twice the log likelihood of all frames is, up to a constant ::

    N log s2 + sum_i [ min_alpha (||W_i - M_i sum_k c_k B_k||^2 / s2 + ||alpha||^2)
                       + log det(I + H_i / s2) ]

with N the number of coordinates that were seen. The objective is that plus ``penalty
* sum_i tr H_i``, minus twice the log prior of the basis shapes: it penalises what they
move in the images. Calibrated cameras add the prior of the extents of the shapes
(`extents`). So the objective is minus twice a log posterior.

Positions are eliminated by least squares: tracks and shapes are centred over the seen
points of each frame. Without weights all frames see all points, and the shapes that are
passed have to be centred already.

The gradient follows from the first two posterior moments of the coefficients, as in
expectation maximisation (Tipping, Bishop, "Probabilistic principal component analysis",
1999; Bishop, "Pattern recognition and machine learning", 2006, section 12.2).

All terms are sums over blocks of frames: how the frames are split makes no difference
but for rounding. The pass over a block works with the frame as the last index of all
arrays, with cameras M and the gradient G by them (2, 3, n_frames).
"""

from collections.abc import Callable
from functools import partial
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from isa_nrsfm._frames.camera_models import camera_gram
from isa_nrsfm._frames.coefficients import coefficient_posterior
from isa_nrsfm._frames.point_sums import (
    FrameTracks,
    ShapeProducts,
    frame_sums,
    frame_tracks,
)
from isa_nrsfm._joint.extents import extent_penalty
from isa_nrsfm._linalg.packed_symmetric import diagonal_of, unpack3, unpacked
from isa_nrsfm._linalg.vectors import frames_first, frames_last
from isa_nrsfm._tables.blocks import FrameBlocks

# Frames that are worked on at a time, so that their small matrices stay in the cache.
BLOCK_FRAMES = 2048
# With a noise variance below this share of the mean square of the tracks, the normal
# equations of the coefficients get one step of iterative refinement.
TINY_NOISE = 1e-7


class LikelihoodTerms(NamedTuple):
    """
    The objective, its derivatives and posterior moments, from one pass over the frames.

    Attributes
    ----------
    value : float
        The objective.
    shape_gradient : ndarray of shape (n_shapes, 3, n_points)
        Its derivative by the shapes.
    motion_gradient : ndarray of shape (n_frames, 2, 3)
        Its derivative by the cameras.
    noise_gradient : float
        Its derivative by the logarithm of the noise variance.
    shape_curvature : ndarray of shape (n_points or 1, 3 * n_shapes, 3 * n_shapes)
        ``sum_i w_ij E_i (x) M_i^T M_i`` with the posterior second moments E_i of
        (1, alpha). Times ``2 / s2`` it is the Hessian by point j of the shapes, with
        the posterior and the positions held fixed. One matrix stands for all points
        where all weights are one.
    motion_curvature : ndarray of shape (6, n_frames)
        ``sum_kl E_kl B_k B_l^T``, packed: the same for each row of the cameras.
    alpha : ndarray of shape (n_frames, n_components)
        Posterior means of the coefficients.
    residual : float
        Sum of squared residuals of the tracks at these means.
    """

    value: float
    shape_gradient: NDArray
    motion_gradient: NDArray
    noise_gradient: float
    shape_curvature: NDArray
    motion_curvature: NDArray
    alpha: NDArray
    residual: float


def likelihood_of(
    tracks: NDArray,
    weights: NDArray | None,
    penalty: NDArray | float,
    block_frames: int = BLOCK_FRAMES,
) -> "MarginalLikelihood":
    """
    Return the objective for tracks in memory.

    Parameters
    ----------
    tracks, weights
        As of `frame_tracks`.
    penalty : float
        As of `MarginalLikelihood`.
    block_frames : int, default=2048
        Frames of a block.

    Returns
    -------
    MarginalLikelihood
        The objective.
    """
    pieces = frame_tracks(tracks, weights).pieces(block_frames)
    blocks = [block for _, block in pieces]
    lengths = [len(block.weight) for block in blocks]
    return MarginalLikelihood(FrameBlocks.of_blocks(blocks, lengths), penalty)


class MarginalLikelihood:
    """
    The objective and its derivatives, as a sum over blocks of frames.

    Parameters
    ----------
    frames : FrameBlocks
        Blocks of FrameTracks. All of them have weights, or none has.
    penalty : float or ndarray of shape (n_components,)
        Regularisation weight: factor of ``sum_i tr H_i``, or one factor for the
        diagonal entry of each basis shape.
    known : tuple of float, optional
        What `totals` returns for these blocks, if it has been computed already.
    extent_weight : float, default=0.0
        Weight of the prior of the extents, for each coordinate.

    Attributes
    ----------
    n_frames : int
        Number of frames.
    n_seen : float
        Number of coordinates that were seen, N.
    square : float
        Weighted energy of the centred tracks.
    """

    def __init__(
        self,
        frames: FrameBlocks,
        penalty: NDArray | float,
        known: tuple[float, float] | None = None,
        extent_weight: float = 0.0,
    ):
        self.frames, self.extent_weight = frames, extent_weight
        self.n_frames = frames.n_frames
        self.penalty = penalty
        self.n_seen, self.square = totals(frames) if known is None else known

    def __call__(
        self, shapes: NDArray, motion: NDArray, noise: float
    ) -> LikelihoodTerms:
        """
        Return the objective, its gradient and an approximate curvature.

        Parameters
        ----------
        shapes : ndarray of shape (n_shapes, 3, n_points)
            B_0, ..., B_K.
        motion : ndarray of shape (n_frames, 2, 3)
            M_i.
        noise : float
            s2.

        Returns
        -------
        LikelihoodTerms
            The sums over the frames.
        """
        n_shapes = len(shapes)
        over_block = self._over_block(shapes, noise)
        alpha = np.empty((n_shapes - 1, self.n_frames)).T
        motion_gradient = frames_first(np.empty((2, 3, self.n_frames)))
        motion_curvature = np.empty((6, self.n_frames))
        sums: Any = (0.0,) * 5
        passes = self.frames.map(over_block, motion)
        for frames, part in zip(self.frames.slices, passes, strict=True):
            alpha[frames] = part.alpha
            motion_gradient[frames] = part.motion_gradient
            motion_curvature[:, frames] = part.motion_curvature
            sums = [a + b for a, b in zip(sums, _sums(part), strict=True)]
        value, shape_gradient, noise_gradient, packed, residual = sums
        curvature = kronecker_matrices(packed, n_shapes)
        # What is common to all frames: 2 / s2 curvature B, N log s2 and its derivative.
        rows = shapes.reshape(3 * n_shapes, -1).T[:, :, None]
        pulled = (curvature @ rows)[:, :, 0].T.reshape(shapes.shape)
        shape_gradient = shape_gradient + (2 / noise) * pulled
        value += self.n_seen * np.log(noise)
        if self.extent_weight:
            weight = self.extent_weight * self.n_seen
            # With one curvature for all points the shapes are centred already.
            penalty, slope = extent_penalty(shapes, centred=len(curvature) == 1)
            value += weight * penalty
            shape_gradient = shape_gradient + weight * slope
        return LikelihoodTerms(
            float(value),
            shape_gradient,
            motion_gradient,
            float(noise_gradient + self.n_seen),
            curvature,
            motion_curvature,
            alpha,
            float(residual),
        )

    def coefficients(self, shapes: NDArray, motion: NDArray, noise: float) -> NDArray:
        """
        Return the posterior means of the coefficients.

        Parameters
        ----------
        shapes, motion, noise
            As of a call.

        Returns
        -------
        ndarray of shape (n_frames, n_components)
            The means.
        """
        alpha = np.empty((self.n_frames, len(shapes) - 1))
        passes = self.frames.map(self._over_block(shapes, noise), motion)
        for frames, part in zip(self.frames.slices, passes, strict=True):
            alpha[frames] = part.alpha
        return alpha

    def _over_block(
        self, shapes: NDArray, noise: float
    ) -> Callable[..., LikelihoodTerms]:
        """Return the function of a block and its cameras that computes the terms."""
        return partial(
            _block_terms,
            shapes=ShapeProducts(shapes),
            noise=noise,
            penalty=self.penalty,
            tiny_noise=noise * self.n_seen < TINY_NOISE * self.square,
        )


def totals(frames: FrameBlocks) -> tuple[float, float]:
    """
    Return the number of coordinates that frames show, and their energy.

    Parameters
    ----------
    frames : FrameBlocks
        Blocks of FrameTracks.

    Returns
    -------
    n_seen : float
        Number of coordinates with a positive weight.
    square : float
        Weighted energy of the centred tracks.
    """
    n_seen, square = np.sum(list(frames.map(_totals)), axis=0)
    return float(n_seen), float(square)


def _totals(block: FrameTracks) -> tuple[float, float]:
    """Return the number of coordinates that a block shows, and its energy."""
    points = (
        block.weight.sum() if block.weights is None else np.count_nonzero(block.weights)
    )
    return 2.0 * points, block.energy.sum()


def _sums(part: LikelihoodTerms) -> tuple[float, NDArray, float, NDArray, float]:
    """Return those terms that are sums over the frames."""
    return (
        part.value,
        part.shape_gradient,
        part.noise_gradient,
        part.shape_curvature,
        part.residual,
    )


def _block_terms(
    block: FrameTracks,
    motion: NDArray,
    shapes: ShapeProducts,
    noise: float,
    penalty: NDArray | float,
    tiny_noise: bool,
) -> LikelihoodTerms:
    """Return the terms of a block, summed over pieces whose matrices fit the cache."""
    M = frames_last(motion)
    parts = [
        _frame_terms(piece, shapes, M[:, :, frames], noise, penalty, tiny_noise)
        for frames, piece in block.pieces(BLOCK_FRAMES)
    ]
    if len(parts) == 1:
        return parts[0]
    sums: Any = (sum(part) for part in zip(*map(_sums, parts), strict=True))
    value, shape_gradient, noise_gradient, shape_curvature, residual = sums
    return LikelihoodTerms(
        value,
        shape_gradient,
        np.concatenate([part.motion_gradient for part in parts]),
        noise_gradient,
        shape_curvature,
        np.concatenate([part.motion_curvature for part in parts], axis=-1),
        np.concatenate([part.alpha for part in parts]),
        residual,
    )


def _frame_terms(
    block: FrameTracks,
    shapes: ShapeProducts,
    M: NDArray,
    noise: float,
    penalty: NDArray | float,
    tiny_noise: bool,
) -> LikelihoodTerms:
    """
    Return the terms of frames of one block, M (2, 3, n_frames).

    Left out is what the caller adds for all frames at once: ``N log s2``, and the term
    ``2 / s2 curvature B`` of the gradient by the shapes. The curvature by the shapes is
    packed: (n_pairs, 6, n_points or 1).
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
    # By the cameras: M A - sum_k c_k P_k^T with A = sum_kl E_kl B_k B_l^T
    motion_curvature = products.gram.moments(moments)
    A = unpack3(motion_curvature)
    G = np.einsum("rbi,bai->rai", M, A)
    G -= np.einsum("ki,kari->rai", c, products.cross)
    # By the shapes: sum_i X_i^T W_i with X_i = c_i^T (x) M_i
    X = (c[:, None, None] * M.swapaxes(0, 1)).reshape(3 * n_shapes, -1)
    shape_gradient = X @ block.weighted.reshape(n_points, -1).T
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
        float(value),
        (-2 / noise) * shape_gradient.reshape(shapes.shapes.shape),
        frames_first((2 / noise) * G),
        -(residual + spread) / noise,
        shape_curvature,
        motion_curvature,
        alpha.T,
        residual,
    )


def kronecker_matrices(packed: NDArray, n_shapes: int) -> NDArray:
    """
    Return the matrices (n, 3 n_shapes, 3 n_shapes) of packed curvatures.

    They come as (n_pairs, 6, n), packed over pairs of shapes and pairs of axes.
    """
    size = 3 * n_shapes
    return unpack3(unpacked(packed)).transpose(4, 0, 2, 1, 3).reshape(-1, size, size)
