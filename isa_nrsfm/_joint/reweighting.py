"""The joint fit with a robust loss, by iteratively reweighted least squares."""

from collections.abc import Callable
from functools import partial
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from isa_nrsfm._frames.camera_models import CameraModel
from isa_nrsfm._frames.projection import compose, project
from isa_nrsfm._joint.frames import JointFrames, WeightedRows
from isa_nrsfm._joint.problem import JointProblem
from isa_nrsfm._joint.quasi_newton import JointResult, JointState, regular
from isa_nrsfm._linalg.rounding import OF_DISTANCES
from isa_nrsfm._linalg.vectors import frames_last
from isa_nrsfm._prepare.robust import frame_weights, median_noise, robust_sizes
from isa_nrsfm._tables.blocks import FrameBlocks
from isa_nrsfm._tables.ordering import representative_frames
from isa_nrsfm._tables.visibility import seen_points

# Numbers of an array of derivatives that is made at a time: 32 MB.
BLOCK_NUMBERS = 2**22


class _Weights(NamedTuple):
    """Weights of points as a function of a frame and its fit."""

    shapes: NDArray  # (n_components + 1, 3, n_points)
    loss: str
    deviation: float  # standard deviation of a coordinate

    def of(
        self,
        rows: NDArray,
        motion: NDArray,
        alpha: NDArray,
        position: NDArray,
        sizes: NDArray,
    ) -> WeightedRows:
        """Return frames (n, 2, J) with the weights of their residuals."""
        distance = _distances(rows, motion, alpha, position, self.shapes)
        weights = frame_weights(self.loss, distance, self.deviation, sizes)
        return WeightedRows(rows, weights)

    def change(self, before: WeightedRows, *fit: NDArray) -> float:
        """Return the largest difference from the weights of before."""
        return float(np.abs(self.of(before.rows, *fit).weights - before.weights).max())


def reweighted(
    problem: JointProblem,
    rows: FrameBlocks,
    left_out: NDArray,
    result: JointResult,
    loss: str,
    cameras: CameraModel,
    refined: Callable[[JointProblem, JointState], JointResult],
) -> tuple[JointResult, float]:
    """
    Iterate refinement and weights until the weights agree with the residuals.

    Parameters
    ----------
    problem : JointProblem
        The problem, with the weights of `result`.
    rows : FrameBlocks
        Blocks of frames (n_frames, 2, n_points), NaN where a point is missing.
    left_out : ndarray of bool, shape (n_frames, n_points)
        Points that have not counted so far. All others that are seen had weight one.
    result : JointResult
        The refinement.
    loss : {"huber", "cauchy"}
        The loss.
    cameras : CameraModel
        How the cameras may move.
    refined : callable
        Refines a state of a problem.

    Returns
    -------
    result : JointResult
        The refinement.
    noise_variance : float
        Variance of a coordinate, from the median of the residuals, corrected for the
        degrees of freedom that camera, position and coefficients of each frame take.
    """
    options = problem.options.reweighting
    sizes = rows.joined(_sizes)
    weighted = rows.derive(WeightedRows.without, left_out)
    sample = representative_frames(
        rows, left_out.shape[1], options.model_frames, options.fewest_shown
    )
    sampled = rows.take(sample)
    weights = WeightedRows.without(sampled, left_out[sample]).weights
    for _ in range(options.rounds):
        # Positions, and the noise of a coordinate
        shapes, motion, _ = result.state
        alpha = problem.coefficients(result.state)
        position = weighted.joined(partial(_positions, shapes=shapes), motion, alpha)
        distance = _distances(
            sampled, motion[sample], alpha[sample], position[sample], shapes
        )
        distance /= _residual_deviations(
            motion[sample], alpha[sample], shapes, weights, result.state.noise, cameras
        )
        noise = median_noise(distance[np.isfinite(distance)])
        deviation = max(noise, OF_DISTANCES)
        # Weights from the residuals, and convergence test
        new, fit = _Weights(shapes, loss, deviation), (motion, alpha, position, sizes)
        change = max(weighted.map(new.change, *fit))
        if change < options.settled:
            break
        # Refinement with the new weights
        weighted = rows.derive(new.of, *fit)
        weights = new.of(sampled, *(each[sample] for each in fit)).weights
        problem = problem.with_frames(JointFrames.from_weighted(weighted))
        result = refined(problem, result.state)
    return result, deviation**2


def _residual_deviations(
    motion: NDArray,
    alpha: NDArray,
    shapes: NDArray,
    weights: NDArray,
    noise: float,
    cameras: CameraModel,
) -> NDArray:
    """
    Return the standard deviations (n, J) of residuals over that of the noise.

    Camera, position and coefficients of a frame follow its noise. With the derivatives
    A of the image by these and weights W, residuals are ``(I - A (A^T W A + P)^-1 A^T
    W)`` times the noise, where the prior P is the noise variance for each coefficient.
    The arrays are motion (n, 2, 3), alpha (n, K), shapes (K + 1, 3, J), weights (n, J).
    """
    (n_frames, n_points), (_, n_components) = weights.shape, alpha.shape
    n_pose = 2 + cameras.n_parameters
    deviations = np.empty(weights.shape)
    length = max(BLOCK_NUMBERS // (2 * n_points * (n_pose + n_components)), 1)
    for first in range(0, n_frames, length):
        part = slice(first, first + length)
        M, w = motion[part], weights[part, None, None]
        frames = shapes[0] + np.tensordot(alpha[part], shapes[1:], 1)
        moved = np.moveaxis(cameras.tangents(frames_last(M)), 3, 0) @ frames[:, None]
        positions = np.zeros((len(M), 2, 2, n_points))
        positions[:, [0, 1], [0, 1]] = 1.0
        A = np.concatenate([moved, positions, M[:, None] @ shapes[1:]], axis=1)
        flat = A.reshape(*A.shape[:2], -1)
        weighed = (A * w).reshape(flat.shape)
        gram = weighed @ flat.swapaxes(1, 2)
        coefficients = np.arange(n_pose, A.shape[1])
        gram[:, coefficients, coefficients] += noise
        Z = np.linalg.solve(regular(gram), flat)
        spread = np.einsum("ipx,ipx->ix", Z, weighed @ weighed.swapaxes(1, 2) @ Z)
        leverage = np.einsum("ipx,ipx->ix", weighed, Z)
        square = (1.0 - 2.0 * leverage + spread).reshape(-1, 2, n_points).mean(axis=1)
        deviations[part] = np.sqrt(np.maximum(square, OF_DISTANCES))
    return deviations


def _sizes(rows: NDArray) -> NDArray:
    """Return the robust sizes (n,) of frames (n, 2, J)."""
    return robust_sizes(rows.transpose(0, 2, 1))


def _residuals(
    rows: NDArray, motion: NDArray, alpha: NDArray, shapes: NDArray
) -> NDArray:
    """Return what a model without positions leaves of frames: (n, J, 2).

    Frames are (n, 2, J), cameras (n, 2, 3), coefficients (n, K), shapes (K + 1, 3, J).
    Points that are missing leave zero.
    """
    tracks = rows.transpose(0, 2, 1)
    stacked = shapes.transpose(0, 2, 1)
    model = project(compose(stacked[0], stacked[1:], alpha), motion, np.zeros(2))
    return np.where(seen_points(tracks)[..., None], tracks - model, 0.0)


def _positions(
    block: WeightedRows, motion: NDArray, alpha: NDArray, shapes: NDArray
) -> NDArray:
    """Return the positions (n, 2) of frames, the weighted means of residuals."""
    rest = _residuals(block.rows, motion, alpha, shapes)
    total = block.weights.sum(axis=1, keepdims=True)  # zero where no point counts
    position = np.einsum("ij,ijc->ic", block.weights, rest)
    return position / np.where(total > 0, total, 1.0)


def _distances(
    rows: NDArray, motion: NDArray, alpha: NDArray, position: NDArray, shapes: NDArray
) -> NDArray:
    """Return distances (n, J) of points from the model, infinite for missing ones."""
    rest = _residuals(rows, motion, alpha, shapes) - position[:, None]
    seen = seen_points(rows.transpose(0, 2, 1))
    return np.where(seen, np.linalg.norm(rest, axis=2), np.inf)
