"""Where the joint fit starts: calibrated cameras, and the shapes that they see.

The cameras of a deforming object are linear combinations of few columns of the motion
factor of its table (Xiao, Chai, Kanade 2006). The cost of such a mixture does not tell
how many columns are needed: it always falls with more. So the rigid cameras are tried
first, then mixtures of more and more columns, until the objective of the fit rises.
"""

from collections.abc import Iterator
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from isa_nrsfm._frames.camera import rigid_cameras
from isa_nrsfm._frames.camera_models import (
    AffineCameras,
    CameraModel,
    nearest_calibrated,
)
from isa_nrsfm._joint.likely_basis import likely_basis
from isa_nrsfm._joint.options import JOINT_OPTIONS, StartOptions
from isa_nrsfm._joint.problem import JointProblem
from isa_nrsfm._joint.quasi_newton import JointState
from isa_nrsfm._metric_upgrade.orthonormal_cameras import (
    orthonormal_mixture,
    principal_columns,
)
from isa_nrsfm._metric_upgrade.rigid import best_metric
from isa_nrsfm._paper.factors import Factorisation
from isa_nrsfm._paper.sample import rigid_energy
from isa_nrsfm._tables.ordering import spread


def rigid_start(
    factors: Factorisation, paper_shapes: NDArray, scaled: bool
) -> tuple[NDArray, NDArray]:
    """
    Return the paper's result with calibrated cameras.

    Parameters
    ----------
    factors : Factorisation
        Of a measurement matrix.
    paper_shapes : ndarray of shape (n_components + 1, 3, n_points)
        Mean shape and basis shapes that the rigid cameras see.
    scaled : bool
        Whether cameras have scales of their own; otherwise all have the scale one.

    Returns
    -------
    motion : ndarray of shape (n_frames, 2, 3)
        The calibrated cameras that are nearest to the rigid ones. They are compared in
        the metric of space in which the rigid cameras are most nearly calibrated.
    shapes : ndarray of shape (n_components + 1, 3, n_points)
        The shapes in that metric.
    """
    Q = best_metric(factors.rigid_motion.reshape(-1, 2, 3))
    rows, sizes = nearest_calibrated(factors.rigid_motion.reshape(-1, 2, 3) @ Q)
    shapes = np.linalg.solve(Q, paper_shapes)
    if scaled:
        return sizes[:, None, None] * rows, shapes
    return rows, sizes.mean() * shapes


def mixed_cameras(
    rows: NDArray,
    scales: NDArray | None,
    chosen: NDArray,
    options: StartOptions = JOINT_OPTIONS.starts,
) -> Iterator[NDArray]:
    """
    Yield calibrated cameras that are mixtures of more and more columns.

    Parameters
    ----------
    rows : ndarray of shape (n_frames, 2, n_points)
        Complete frames, centred.
    scales : ndarray of shape (n_frames,) or None
        Rough scales of the cameras: each frame is divided by its own before the
        mixture. None for cameras of scale one.
    chosen : ndarray of int, shape (n_chosen,)
        Frames from which the mixtures are found.
    options : StartOptions
        Widths and steps of the mixtures.

    Yields
    ------
    ndarray of shape (n_frames, 2, 3)
        Cameras.
    """
    unit = rows
    if scales is not None:  # zero for frames without points that count
        unit = rows / np.where(scales > 0, scales, 1.0)[:, None, None]
    P = principal_columns(unit.reshape(2 * len(unit), -1)).reshape(len(unit), 2, -1)
    if P.shape[2] < 3:
        return
    few = P[chosen].reshape(2 * len(chosen), -1)
    max_iter = options.mixing_steps
    mixing, _ = orthonormal_mixture(few[:, :3], np.eye(3), max_iter=max_iter)
    # Each width starts from the mixture of the one before.
    rank = P.shape[2]
    for n in sorted({min(n, rank) for n in options.widths if n < rank + 3}):
        mixing, _ = orthonormal_mixture(few[:, :n], mixing, max_iter=max_iter)
        found, sizes = nearest_calibrated(P[..., :n] @ mixing)
        yield found if scales is None else (scales * sizes)[:, None, None] * found


def lifted_shapes(rows: NDArray, motion: NDArray, n_components: int) -> NDArray:
    """
    Return shapes that explain what given cameras see.

    Parameters
    ----------
    rows : ndarray of shape (n_frames, 2, n_points)
        Complete frames, centred.
    motion : ndarray of shape (n_frames, 2, 3)
        Scaled rotations.
    n_components : int
        K.

    Returns
    -------
    ndarray of shape (n_components + 1, 3, n_points)
        The mean shape B_0 of least squares, and the first principal components of the
        residuals ``M_i^+ (W_i - M_i B_0)``, lifted to space parallel to the image
        plane. Each is as long as the standard deviation of its coefficient. Zeros if
        there are fewer than K.
    """
    # Mean shape: (sum_i M_i^T M_i) B_0 = sum_i M_i^T W_i
    gram = np.einsum("ira,irb->ab", motion, motion)
    right = np.einsum("ira,irj->aj", motion, rows)
    mean_shape = np.linalg.lstsq(gram, right)[0]
    # Lifted residuals, M^+ = M^T / scale^2
    size = np.einsum("irc,irc->i", motion, motion) / 2
    size = np.where(size > 0, size, 1.0)
    rest = (rows - motion @ mean_shape) / size[:, None, None]
    lifted = (motion.swapaxes(1, 2) @ rest).reshape(len(rows), -1)
    # Principal components
    values, axes = _leading(lifted, n_components)
    basis = np.zeros((n_components, *mean_shape.shape))
    basis[: len(values)] = (values[:, None] * axes).reshape(-1, *mean_shape.shape)
    return np.concatenate([mean_shape[None], basis / np.sqrt(len(rows))])


def _leading(rows: NDArray, n: int) -> tuple[NDArray, NDArray]:
    """Return the n largest singular values of a matrix, and their right vectors."""
    tall = len(rows) > rows.shape[1]
    square, vectors = np.linalg.eigh(rows.T @ rows if tall else rows @ rows.T)
    values = np.sqrt(np.maximum(square[::-1][:n], 0.0))
    vectors = vectors[:, ::-1][:, :n].T
    if not tall:
        vectors = vectors @ rows / np.where(values > 0, values, 1.0)[:, None]
    return values, vectors


def extended_shapes(
    rows: NDArray, shapes: NDArray, motion: NDArray, alpha: NDArray, n_more: int
) -> NDArray:
    """
    Return fitted shapes, and further basis shapes along what they leave.

    Parameters
    ----------
    rows : ndarray of shape (n_frames, 2, n_points)
        Frames, each centred over the points that are seen; NaN for the others.
    shapes : ndarray of shape (n_shapes, 3, n_points)
        Mean shape and basis shapes.
    motion : ndarray of shape (n_frames, 2, 3)
        Fitted cameras.
    alpha : ndarray of shape (n_frames, n_shapes - 1)
        Fitted coefficients.
    n_more : int
        Number of further basis shapes.

    Returns
    -------
    ndarray of shape (n_shapes + n_more, 3, n_points)
        The shapes, and the first principal components of the residuals ``M_i^+ (W_i -
        M_i S_i)``, lifted to space as in `lifted_shapes`.
    """
    model = motion @ (shapes[0] + np.tensordot(alpha, shapes[1:], 1))
    rest = rows - model
    # The position of a frame is that of least squares; what is not seen leaves nothing.
    rest = np.nan_to_num(rest - np.nanmean(rest, axis=2, keepdims=True))
    lifted = (np.linalg.pinv(motion) @ rest).reshape(len(rows), -1)
    values, axes = _leading(lifted, n_more)
    more = np.zeros((n_more, *shapes.shape[1:]))
    more[: len(values)] = (values[:, None] * axes).reshape(-1, *shapes.shape[1:])
    return np.concatenate([shapes, more / np.sqrt(len(rows))])


def affine_start(
    problem: JointProblem, W: NDArray, paper_shapes: NDArray
) -> JointState:
    """
    Return the paper's result, rigid cameras and basis shapes, as a start.

    Parameters
    ----------
    problem : JointProblem
        The frames to be fitted.
    W : ndarray of shape (2 * n_frames, n_points)
        Their measurement matrix, completed where points are missing.
    paper_shapes : ndarray of shape (n_components + 1, 3, n_points)
        Mean shape and basis shapes of the paper's pipeline.

    Returns
    -------
    JointState
        Cameras, noise, and shapes of which each is as long as the standard deviation of
        its coefficient.
    """
    shapes = problem.frames.coordinates(paper_shapes)
    W = problem.frames.coordinates(W)
    rows, motion = W.reshape(problem.n_frames, 2, -1), rigid_cameras(W, shapes[0].T)
    return _first_state(problem, rows, motion, _scaled(rows, motion, shapes))


def settled(
    problem: JointProblem, state: JointState, cameras: CameraModel
) -> JointState:
    """
    Return a start after some steps without the prior of the basis shapes.

    With the large noise of a start the prior would make them vanish.

    Parameters
    ----------
    problem : JointProblem
        The frames to be fitted.
    state : JointState
        The start.
    cameras : CameraModel
        How its cameras may move.

    Returns
    -------
    JointState
        The last iterate, in the basis of greatest posterior density.
    """
    unpenalised = problem.with_penalty(0.0)
    held_steps = problem.options.starts.held_steps
    result = unpenalised.refined(state, cameras, max_iter=held_steps)
    return with_prior(problem, result.state)


def best_starts(
    problem: JointProblem,
    W: NDArray,
    factors: Factorisation,
    paper_shapes: NDArray,
    cameras: CameraModel,
) -> list[JointState]:
    """
    Return the starts of greatest likelihood, the best one first.

    Parameters
    ----------
    problem : JointProblem
        The frames to be fitted.
    W : ndarray of shape (2 * n_frames, n_points)
        Their measurement matrix, completed where points are missing.
    factors : Factorisation
        Of W.
    paper_shapes : ndarray of shape (n_components + 1, 3, n_points)
        Mean shape and basis shapes of the paper's pipeline.
    cameras : CameraModel
        Calibrated cameras.

    Returns
    -------
    list of JointState
        Shapes, cameras of all frames, and noise.
    """
    # Frames that are compared: evenly from the most to the least rigid one
    rows = problem.frames.coordinates(W).reshape(problem.n_frames, 2, -1)
    order = np.argsort(
        rigid_energy(rows, problem.frames.coordinates(factors.rigid_shape))
    )
    options, effort = problem.options.starts, problem.steps.effort
    few = np.sort(spread(order, min(effort.n_compared, len(order))))
    # No prior: with the large noise of a start it would make basis shapes vanish.
    part = problem.part(few, tol=options.compared_tol).with_penalty(0.0)
    # Rigid cameras, with the paper's and with lifted basis shapes
    motion, shapes = rigid_start(
        factors, problem.frames.coordinates(paper_shapes), cameras.scaled
    )
    shapes = _scaled(rows[few], motion[few], shapes)
    n_components = len(shapes) - 1
    trials = [
        _trial(part, rows, motion, few, given)
        for given in (shapes, lifted_shapes(rows[few], motion[few], n_components))
    ]
    # Mixtures of more and more columns, until the objective rises. For small tables
    # all of them, without and with scales: few steps do not show which is the best.
    compared = effort.n_finalists > 1
    scales = np.linalg.norm(motion, axis=(1, 2)) / np.sqrt(2)
    families = [scales] if cameras.scaled else [None]
    if compared and cameras.scaled:
        families.append(None)
    for given_scales in families:
        values: list[float] = []
        for mixed in mixed_cameras(rows, given_scales, few, options):
            given = lifted_shapes(rows[few], mixed[few], n_components)
            trials.append(_trial(part, rows, mixed, few, given))
            values.append(trials[-1].value)
            if not compared and len(values) > 1 and values[-1] > values[-2]:
                break
    # The best ones, with their cameras freed
    trials.sort(key=lambda trial: trial.value)
    freed = [
        _freed(part, trial, few, cameras)
        for trial in (trials if compared else trials[:1])
    ]
    freed.sort(key=lambda trial: trial.value)
    return [with_prior(problem, each.state) for each in freed[: effort.n_finalists]]


class _Trial(NamedTuple):
    """A start after some steps."""

    value: float  # of the objective
    state: JointState  # of the compared frames; of all frames once cameras are freed
    motion: NDArray  # of all frames (n_frames, 2, 3)


def _trial(
    part: JointProblem, rows: NDArray, motion: NDArray, few: NDArray, shapes: NDArray
) -> _Trial:
    """
    Return a start after some steps of the shapes, for the compared frames few.

    The arrays rows (n_frames, 2, n_points) and motion (n_frames, 2, 3) have all frames.
    """
    state = _first_state(part, rows[few], motion[few], shapes)
    held_steps = part.options.starts.held_steps
    result = part.refined(state, AffineCameras(held=True), max_iter=held_steps)
    return _Trial(result.history[-1], result.state, motion)


def _freed(
    part: JointProblem, trial: _Trial, few: NDArray, cameras: CameraModel
) -> _Trial:
    """Make some steps of the shapes and the cameras of the compared frames few."""
    freed_steps = part.options.starts.freed_steps
    result = part.refined(trial.state, cameras, max_iter=freed_steps)
    motion = trial.motion.copy()
    motion[few] = result.state.motion
    state = result.state._replace(motion=motion)
    return _Trial(result.history[-1], state, motion)


def _first_state(
    problem: JointProblem, rows: NDArray, motion: NDArray, shapes: NDArray
) -> JointState:
    """
    Return a state whose noise is a share of the residual of the mean shape.

    The arrays are rows (n_frames, 2, n_points), motion (n_frames, 2, 3) and shapes
    (n_shapes, 3, n_points).
    """
    rest = rows - motion @ shapes[0]
    n_seen, energy = problem.totals
    options = problem.options
    noise = options.starts.first_noise * np.mean(rest**2)
    least_noise = options.least_noise * energy / n_seen
    return JointState(shapes, motion, max(noise, least_noise))


def with_prior(problem: JointProblem, state: JointState) -> JointState:
    """
    Return a state in the basis of greatest posterior density, as of `likely_basis`.

    Parameters
    ----------
    problem : JointProblem
        The frames, and the penalty of their basis shapes.
    state : JointState
        A fit with another penalty.

    Returns
    -------
    JointState
        The state with its basis shapes mixed and scaled.
    """
    shapes, motion, _ = state
    alpha = problem.coefficients(state)
    shapes = likely_basis(shapes, motion, alpha, problem.penalty)
    return state._replace(shapes=shapes)


def _scaled(rows: NDArray, motion: NDArray, shapes: NDArray) -> NDArray:
    """
    Return shapes scaled by the standard deviation of their coefficients.

    The coefficients are least squares, ``<M_i B_k, W_i> / ||M_i B_k||^2``: each by
    itself, as the shapes are orthogonal. rows (n_frames, 2, n_points), motion
    (n_frames, 2, 3), shapes (n_shapes, 3, n_points).
    """
    images = np.einsum("irc,kcj->ikrj", motion, shapes[1:])
    along = np.einsum("ikrj,irj->ik", images, rows)
    energy = np.einsum("ikrj,ikrj->ik", images, images)
    alpha = np.divide(along, energy, where=energy > 0, out=np.zeros_like(along))
    return np.concatenate([shapes[:1], alpha.std(axis=0)[:, None, None] * shapes[1:]])
