"""The joint fit with a robust loss, by iteratively reweighted least squares."""

from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray

from isa_nrsfm._frames.projection import compose, project
from isa_nrsfm._joint.frames import JointFrames
from isa_nrsfm._joint.problem import JointProblem
from isa_nrsfm._joint.quasi_newton import JointResult, JointState
from isa_nrsfm._linalg.rounding import OF_DISTANCES
from isa_nrsfm._prepare.robust import frame_weights, median_noise, robust_sizes
from isa_nrsfm._tables.blocks import FrameBlocks
from isa_nrsfm._tables.visibility import seen_points


def reweighted(
    problem: JointProblem,
    rows: FrameBlocks,
    used: NDArray,
    result: JointResult,
    loss: str,
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
    used : ndarray of bool, shape (n_frames, n_points)
        Points that have counted so far.
    result : JointResult
        The refinement.
    loss : {"huber", "cauchy"}
        The loss.
    refined : callable
        Refines a state of a problem.

    Returns
    -------
    result : JointResult
        The refinement.
    noise_variance : float
        Variance of a coordinate, from the median of the residuals.
    """
    tracks = rows.whole().transpose(0, 2, 1)
    seen, sizes = seen_points(tracks), robust_sizes(tracks)
    counted, weights = used * 1.0, np.zeros(seen.shape)
    options = problem.options.reweighting
    for _ in range(options.rounds):
        # Residuals of the seen points
        shapes, motion, _ = result.state
        stacked = shapes.transpose(0, 2, 1)
        alpha = problem.coefficients(result.state)
        model = project(compose(stacked[0], stacked[1:], alpha), motion, np.zeros(2))
        rest = np.where(seen[..., None], tracks - model, 0.0)
        # less the weighted mean of each frame, its position
        position = np.einsum("ij,ijc->ic", counted, rest)
        total = counted.sum(axis=1, keepdims=True)  # zero where no point counts
        rest -= (position / np.where(total > 0, total, 1.0))[:, None]
        distance = np.linalg.norm(rest, axis=2)
        # Weights from the residuals, and convergence test
        deviation = max(median_noise(distance[seen]), OF_DISTANCES)
        distance = np.where(seen, distance, np.inf)
        previous, weights = weights, frame_weights(loss, distance, deviation, sizes)
        if np.abs(weights - previous).max() < options.settled:
            break
        # Refinement with the new weights
        problem = problem.with_frames(JointFrames.from_points(rows, False, weights))
        counted = weights
        result = refined(problem, result.state)
    return result, deviation**2
