"""The joint fit of tables with many points, along few directions.

The shapes of greatest likelihood are linear combinations of the rows of the measurement
matrix. Complete frames with many points are given by their products with directions. At
first these are the directions of the factorisation. One step of expectation
maximisation in all points then gives shapes that may leave their span. The directions
that it needs are added, and the fit goes on, until such a step gains nothing.

Frames with missing points are filled in for that. The result is a start for steps with
the points that are seen.
"""

from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray

from isa_nrsfm._frames.projection import stacked_motion
from isa_nrsfm._joint.frames import JointFrames
from isa_nrsfm._joint.options import JOINT_OPTIONS, ManyPointOptions
from isa_nrsfm._joint.problem import JointProblem
from isa_nrsfm._joint.quasi_newton import JointResult, regular
from isa_nrsfm._linalg.rounding import OF_DIFFERENCES
from isa_nrsfm._paper.factors import Factorisation
from isa_nrsfm._tables.blocks import FrameBlocks


def has_many_points(
    n_points: int,
    n_shapes: int,
    options: ManyPointOptions = JOINT_OPTIONS.many_points,
) -> bool:
    """Return whether complete frames are to be given by directions."""
    return n_points > max(options.wide * 3 * n_shapes, options.least_points)


def leading_directions(factors: Factorisation) -> NDArray:
    """
    Return orthonormal directions (n_directions, n_points) that span the right factors.

    Their rows, of the rigid shape and of the signals, are orthogonal. Some can be zero.
    """
    shapes = np.concatenate([factors.rigid_shape, factors.signals])
    shapes = shapes[shapes.any(axis=1)]
    return shapes / np.linalg.norm(shapes, axis=1, keepdims=True)


def in_all_points(
    result: JointResult,
    problem: JointProblem,
    rows: FrameBlocks,
    refined: Callable[..., JointResult],
) -> tuple[JointResult, JointProblem]:
    """
    Continue a refinement along some directions until it is one in all points.

    Parameters
    ----------
    result : JointResult
        The refinement along the directions of the problem.
    problem : JointProblem
        The problem.
    rows : FrameBlocks
        Blocks of complete frames (n_frames, 2, n_points).
    refined : callable
        Refines a state of a problem.

    Returns
    -------
    result : JointResult
        The refinement, along directions to which no other need be added.
    problem : JointProblem
        The problem along these directions.
    """
    for _ in range(problem.options.many_points.widenings):
        # No directions without steps to use them: the shapes are given by the old ones.
        n_left = problem.steps.max_iter - (len(result.history) - 1)
        if not n_left:
            break
        state = result.state
        before = problem.frames.points(state.shapes)
        # Expectation maximisation in all points: solve curvature B = sum_i X_i^T W_i.
        passed = problem.likelihood(*state)
        curvature = regular(passed.shape_curvature)[0]
        right = sum(rows.map(_right_side, state.motion, passed.alpha))
        right = right.reshape(len(curvature), -1)
        after = np.linalg.solve(curvature, right)
        # Predicted gain of the objective
        change = after - before.reshape(after.shape)
        gain = float(np.vdot(change, curvature @ change)) / state.noise
        if gain < problem.steps.tol * problem.n_frames:
            break
        # Directions that span the shapes before and after that step
        both = np.concatenate([after, before.reshape(after.shape)])
        _, size, directions = np.linalg.svd(both, full_matrices=False)
        directions = directions[size > OF_DIFFERENCES * size[0]]
        frames = JointFrames.from_directions(rows, directions)
        problem = problem.with_frames(frames)
        # Further refinement, with the steps that are left
        shapes = frames.coordinates(after.reshape(before.shape))
        further = refined(problem, state._replace(shapes=shapes), max_iter=n_left)
        # One history: the first value of the further one repeats the last.
        history = np.concatenate([result.history, further.history[1:]])
        result = further._replace(history=history)
    return result, problem


def _right_side(rows: NDArray, motion: NDArray, alpha: NDArray) -> NDArray:
    """
    Return ``sum_i X_i^T W_i`` of a block, ``X_i = c_i^T (x) M_i``.

    The arrays are rows (n_frames, 2, n_points), motion (n_frames, 2, 3) and alpha
    (n_frames, n_components).
    """
    return stacked_motion(motion, alpha).T @ rows.reshape(2 * len(rows), -1)
