"""The joint fit with a robust loss, by iteratively reweighted least squares."""

from collections.abc import Callable
from dataclasses import replace
from functools import partial

import numpy as np
from numpy.typing import NDArray

from isa_nrsfm._frames.camera_models import CameraModel, compose, distances
from isa_nrsfm._joint.frames import JointFrames, WeightedRows, without
from isa_nrsfm._joint.problem import JointProblem
from isa_nrsfm._joint.quasi_newton import JointFit, regular
from isa_nrsfm._linalg.rounding import OF_DISTANCES
from isa_nrsfm._linalg.small_matrices import frames_last
from isa_nrsfm._prepare.robust import frame_weights, median_noise, robust_sizes
from isa_nrsfm._tables.blocks import FrameBlocks
from isa_nrsfm._tables.ordering import representative_frames


def reweighted(
    problem: JointProblem,
    rows: FrameBlocks,
    left_out: NDArray,
    fit: JointFit,
    least_noise: float,
) -> tuple[JointFit, float]:
    """Iterate refinement and weights until the weights agree with the residuals.

    In `fit`, points `left_out` (I, J) had weight zero, the others weight one. Returns
    the refinement and the noise variance of a coordinate, from the median of the
    residuals, corrected for the degrees of freedom.
    """
    cameras, loss = problem.cameras, problem.settings.loss
    sizes = rows.joined(robust_sizes)
    weighted = rows.derive(without, left_out)
    # Estimate the noise from the residuals of at most about 2,000 frames.
    few = representative_frames(rows, 2000)
    few_rows = rows.take(few)
    weights = without(few_rows, left_out[few])[1]
    for _ in range(20):
        shapes, motion, variance = fit.state
        alpha = problem.likelihood.coefficients(*fit.state)
        position = weighted.joined(partial(_positions, shapes=shapes), motion, alpha)
        model = motion, position, alpha, sizes
        M, t, a, few_sizes = (part[few] for part in model)
        distance = distances(few_rows, shapes, M, t, a)
        distance /= residual_deviations(M, a, shapes, weights, variance, cameras)
        deviation = max(median_noise(distance[np.isfinite(distance)]), OF_DISTANCES)
        # Weights from the residuals, and convergence test
        new = partial(_weighted, shapes=shapes, loss=loss, deviation=deviation)
        change = max(weighted.map(partial(_change, new=new), *model))
        if change < 1e-2:
            break
        # Refinement with the new weights
        weighted = rows.derive(new, *model)
        weights = new(few_rows, M, t, a, few_sizes)[1]
        problem = replace(problem, frames=JointFrames.from_weighted(weighted))
        fit = problem.refined(fit.state, least_noise=least_noise)
    return fit, deviation**2


def residual_deviations(
    motion: NDArray,
    alpha: NDArray,
    shapes: NDArray,
    weights: NDArray,
    noise: float,
    cameras: CameraModel,
) -> NDArray:
    """Return the standard deviations (n, J) of residuals over that of the noise.

    With the derivatives A of the image by camera, position and coefficients and weights
    W, residuals are ``(I - A (A^T W A + P)^-1 A^T W)`` times the noise; the prior P is
    the noise variance for each coefficient.
    """
    (n_frames, n_points), (_, n_components) = weights.shape, alpha.shape
    n_pose = 2 + cameras.n_parameters
    deviations = np.empty(weights.shape)
    # Process frames in slices whose derivatives fit into 32 MB
    length = max(2**22 // (2 * n_points * (n_pose + n_components)), 1)
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


def _positions(
    block: WeightedRows, motion: NDArray, alpha: NDArray, shapes: NDArray
) -> NDArray:
    """Return the positions (n, 2) of frames, the weighted means of residuals."""
    rows, weights = block
    stacked = shapes.mT
    model = compose(stacked[0], stacked[1:], alpha) @ motion.mT
    rest = np.nan_to_num(rows.mT - model)
    total = weights.sum(axis=1, keepdims=True)  # zero where no point counts
    position = np.einsum("ij,ijc->ic", weights, rest)
    return position / np.where(total > 0, total, 1.0)


def _weighted(
    rows: NDArray, *fit: NDArray, shapes: NDArray, loss: str, deviation: float
) -> WeightedRows:
    """Return frames (n, 2, J) with the weights of their residuals from a fit."""
    *model, sizes = fit
    distance = distances(rows, shapes, *model)
    return rows, frame_weights(loss, distance, deviation, sizes)


def _change(
    before: WeightedRows, *fit: NDArray, new: Callable[..., WeightedRows]
) -> float:
    """Return the largest change of the weights."""
    rows, weights = before
    return float(np.abs(new(rows, *fit)[1] - weights).max())
