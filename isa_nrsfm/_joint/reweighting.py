"""The joint fit with a robust loss, by iteratively reweighted least squares."""

from collections.abc import Callable
from functools import partial
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from isa_nrsfm._frames.projection import compose, project
from isa_nrsfm._joint.frames import JointFrames, WeightedRows
from isa_nrsfm._joint.problem import JointProblem
from isa_nrsfm._joint.quasi_newton import JointResult, JointState
from isa_nrsfm._linalg.rounding import OF_DISTANCES
from isa_nrsfm._prepare.robust import frame_weights, median_noise, robust_sizes
from isa_nrsfm._tables.blocks import FrameBlocks
from isa_nrsfm._tables.ordering import representative_frames
from isa_nrsfm._tables.visibility import seen_points


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
    refined : callable
        Refines a state of a problem.

    Returns
    -------
    result : JointResult
        The refinement.
    noise_variance : float
        Variance of a coordinate, from the median of the residuals.
    """
    options = problem.options.reweighting
    sizes = rows.joined(_sizes)
    weighted = rows.derive(WeightedRows.without, left_out)
    sample = representative_frames(
        rows, left_out.shape[1], options.model_frames, options.fewest_shown
    )
    sampled = rows.take(sample)
    for _ in range(options.rounds):
        # Positions, and the noise of a coordinate
        shapes, motion, _ = result.state
        alpha = problem.coefficients(result.state)
        position = weighted.joined(partial(_positions, shapes=shapes), motion, alpha)
        distance = _distances(
            sampled, motion[sample], alpha[sample], position[sample], shapes
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
        problem = problem.with_frames(JointFrames.from_weighted(weighted))
        result = refined(problem, result.state)
    return result, deviation**2


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
