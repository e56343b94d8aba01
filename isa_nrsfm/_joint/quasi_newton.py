"""Joint refinement: cameras, shapes and noise of greatest marginal likelihood.

Cameras M_i, shapes B_0, ..., B_K and the noise variance are moved together by a limited
memory quasi-Newton method (Nocedal, Wright, "Numerical optimization", 2006, section
7.2). Its first metric is the curvature that expectation maximisation would use, so that
a step without memory is a step of that, and it is brought up to date at each step.
Tables without noise, where it is slow, are taken over by Gauss-Newton steps once the
noise is small enough to tell.
"""

from collections import deque
from collections.abc import Callable
from functools import cached_property
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from isa_nrsfm._frames.camera_models import CameraModel
from isa_nrsfm._joint.likelihood import MarginalLikelihood
from isa_nrsfm._joint.noise_free import fit_without_noise

# Steps whose curvature is remembered, of tables with so many frames that these would be
# more numbers than that at least so many.
MEMORY = 20
MEMORY_NUMBERS = 2**25
LEAST_MEMORY = 3
# The noise variance is at least this share of the mean square of the tracks: tables
# without noise are fitted, too.
NOISE_FLOOR = 1e-11
# With less than this share Gauss-Newton steps are tried, and once more each time that
# the noise has fallen to a part of that.
EXACT = 1e-7
CLOSER = 0.1
# The logarithm of the noise variance changes by at most so much in a step.
LARGEST_NOISE_STEP = 1.5
# A step has to gain this share of what the slope promises.
SUFFICIENT_DECREASE = 1e-4
# A step shorter than this finds nothing but rounding errors.
SHORTEST_STEP = 1e-8
# The sum of squares in the objective is precise to this share of that of the tracks.
ROUNDING = 1e-15
# Ridge, relative to the mean diagonal, for shapes that the table does not determine.
RIDGE = 1e-12


class JointState(NamedTuple):
    """
    Unknowns of the joint refinement.

    Attributes
    ----------
    shapes : ndarray of shape (n_shapes, 3, n_points)
        B_0, ..., B_K.
    motion : ndarray of shape (2, 3, n_frames)
        Cameras, frames last.
    noise : float
        Variance of the noise of a coordinate.
    """

    shapes: NDArray
    motion: NDArray
    noise: float


class JointResult(NamedTuple):
    """
    Result of the joint refinement.

    Attributes
    ----------
    state : JointState
        Where it ended.
    history : ndarray of shape (n_iter + 1,)
        The objective at the start and after each step; it never rises.
    gradient_norm : float
        Norm of the gradient at the end in the metric of the curvature, relative to the
        number of coordinates: about the gain of the objective per coordinate that is
        still possible, under the root.
    converged : bool
        Whether it stopped by itself.
    residual : float
        Mean square of what the shapes with the means of the coefficients leave.
    left : float
        The noise variance, or the residual where that is more.
    """

    state: JointState
    history: NDArray
    gradient_norm: float
    converged: bool
    residual: float
    left: float


def refine_joint(
    likelihood: MarginalLikelihood,
    start: JointState,
    cameras: CameraModel,
    *,
    least_noise: float = NOISE_FLOOR,
    max_iter: int,
    tol: float,
    on_step: Callable[[], None] | None = None,
) -> JointResult:
    """
    Minimise the objective of `MarginalLikelihood`.

    Parameters
    ----------
    likelihood : MarginalLikelihood
        The objective.
    start : JointState
        Where to start.
    max_iter : int
        The most steps.
    tol : float
        It has converged when two steps one after the other each lower the objective,
        minus twice the log likelihood, by less than tol for each frame.
    on_step : callable, optional
        Called before each step.

    Returns
    -------
    JointResult
        The result.
    """
    floor = least_noise * likelihood.square / likelihood.n_seen
    start = start._replace(noise=max(start.noise, floor))
    point = _Iterate(likelihood, cameras, start, floor)
    remembered = min(MEMORY_NUMBERS // (2 * point.gradient.size), MEMORY)
    memory: deque[tuple[NDArray, NDArray, float]] = deque(
        maxlen=max(remembered, LEAST_MEMORY)
    )
    history = [point.value]
    small_steps, exact = 0, EXACT * likelihood.square / likelihood.n_seen
    if not cameras.n_parameters:
        exact = 0.0
    while len(history) <= max_iter and small_steps < 2:
        if on_step is not None:
            on_step()
        if point.left < exact:
            reached = _without_noise(likelihood, point, floor)
            # Once is enough. Where it leads nowhere it may from closer by.
            exact = 0.0 if reached else CLOSER * point.left
            if reached:
                memory.clear()
                point = reached
                history.append(point.value)
                continue
        step = -_inverse_hessian_product(point, memory)
        if not point.gradient @ step < 0:
            memory.clear()
            step = -point.precondition(point.gradient)
        reached, moved = _line_search(likelihood, point, step, floor)
        if reached is None:
            if not memory:  # not even downhill: rounding errors are left
                small_steps = 2
            memory.clear()
            continue
        _remember(memory, moved, reached.gradient - point.gradient)
        gain = point.value - reached.value
        rounding = ROUNDING * likelihood.square / reached.state.noise
        small = gain < max(tol * likelihood.n_frames, rounding)
        small_steps = small_steps + 1 if small else 0
        point = reached
        history.append(point.value)
    memory.clear()
    slope = point.gradient @ point.precondition(point.gradient)
    return JointResult(
        point.state,
        np.array(history),
        float(np.sqrt(max(slope, 0.0) / likelihood.n_seen)),
        small_steps >= 2 and bool(np.isfinite(point.value)),
        point.residual,
        point.left,
    )


def _remember(
    memory: deque[tuple[NDArray, NDArray, float]], moved: NDArray, change: NDArray
) -> None:
    """Remember the curvature along a step, if it is positive."""
    curvature = float(moved @ change)
    if curvature > 1e-10 * np.linalg.norm(moved) * np.linalg.norm(change):
        memory.append((moved, change, curvature))


def _without_noise(
    likelihood: MarginalLikelihood, point: "_Iterate", floor: float
) -> "_Iterate | None":
    """Return where Gauss-Newton steps lead to, None if it is no better."""
    shapes, motion, _ = point.state
    if not np.isfinite(point.value):
        return None
    alpha = likelihood.coefficients(*point.state).T
    found = fit_without_noise(
        likelihood.frames, shapes, motion, alpha, likelihood.penalty, point.cameras
    )
    if found is None:
        return None
    left = likelihood(*found, floor).residual / likelihood.n_seen
    if left > point.left:
        return None
    state = JointState(*found, max(left, floor))
    reached = _Iterate(likelihood, point.cameras, state, floor)
    return reached if reached.value < point.value else None


class _Iterate:
    """A state with the objective, its gradient and its curvature there."""

    def __init__(
        self,
        likelihood: MarginalLikelihood,
        cameras: CameraModel,
        state: JointState,
        floor: float,
    ):
        passed = likelihood(*state)
        self.state, self.cameras = state, cameras
        self.n_seen = likelihood.n_seen
        self.value = passed.value
        self.residual = passed.residual / likelihood.n_seen
        # What the noise says, or the residual where it says more.
        self.left = max(state.noise, self.residual)
        at_floor = state.noise <= floor * (1 + 1e-6)
        self.gradient = _stacked(
            passed.shape_gradient,
            cameras.gradient(state.motion, passed.motion_gradient),
            # Noise that is least already does not fall.
            min(passed.noise_gradient, 0.0 if at_floor else np.inf),
        )
        self.curvature = passed.shape_curvature, passed.motion_curvature

    @cached_property
    def metric(self) -> tuple[NDArray, NDArray]:
        """Inverses of the curvatures by the shapes and by the cameras."""
        by_shapes, by_motion = self.curvature
        inverse = self.cameras.inverse_curvature(self.state.motion, by_motion)
        return np.linalg.inv(regular(by_shapes)), inverse

    def precondition(self, vector: NDArray) -> NDArray:
        """Return a vector times the inverse of the curvature."""
        half = self.state.noise / 2
        shapes, motion, noise = self.split(vector)
        by_shapes, by_motion = self.metric
        stacked = shapes.reshape(-1, shapes.shape[-1])
        if len(by_shapes) == 1:
            stacked = by_shapes[0] @ stacked
        else:
            stacked = (by_shapes @ stacked.T[:, :, None])[:, :, 0].T
        motion = self.cameras.product(by_motion, motion)
        return _stacked(half * stacked, half * motion, noise / self.n_seen)

    def split(self, vector: NDArray) -> tuple[NDArray, NDArray, float]:
        """Return the parts of a vector, shapes, cameras and noise."""
        first = self.state.shapes.size
        return (
            vector[:first].reshape(self.state.shapes.shape),
            vector[first:-1].reshape(
                self.cameras.n_parameters, self.state.motion.shape[-1]
            ),
            vector[-1],
        )

    def moved(self, step: NDArray, floor: float) -> JointState:
        """Return the state after a step."""
        shapes, motion, noise = self.split(step)
        return JointState(
            self.state.shapes + shapes,
            self.cameras.moved(self.state.motion, motion),
            max(self.state.noise * np.exp(noise), floor),
        )


def regular(curvature: NDArray) -> NDArray:
    """Return curvatures (n, m, m) of shapes with a trace of a ridge."""
    size = curvature.shape[-1]
    # Points that no frame shows have no curvature, and no gradient either.
    ridge = RIDGE * np.trace(curvature, axis1=1, axis2=2).mean() / size or 1.0
    return curvature + ridge * np.eye(size)


def _stacked(shapes: NDArray, motion: NDArray, noise: float) -> NDArray:
    """Return the three parts of the unknowns as one vector."""
    return np.concatenate([shapes.ravel(), motion.ravel(), [noise]])


def _inverse_hessian_product(
    point: _Iterate, memory: deque[tuple[NDArray, NDArray, float]]
) -> NDArray:
    """Return the gradient times the inverse Hessian of the remembered steps."""
    vector = point.gradient.copy()
    weights = []
    for moved, change, curvature in reversed(memory):
        weight = moved @ vector / curvature
        vector -= weight * change
        weights.append(weight)
    vector = point.precondition(vector)
    for (moved, change, curvature), weight in zip(
        memory, reversed(weights), strict=True
    ):
        vector += (weight - change @ vector / curvature) * moved
    return vector


def _line_search(
    likelihood: MarginalLikelihood, point: _Iterate, step: NDArray, floor: float
) -> tuple[_Iterate | None, NDArray]:
    """Return the first point along a step that is low enough, and the way to it."""
    slope = point.gradient @ step
    length = min(
        1.0,
        LARGEST_NOISE_STEP / max(abs(step[-1]), 1e-300),
        point.cameras.largest_length(point.split(step)[1]),
    )
    while length > SHORTEST_STEP:
        moved = length * step
        state = point.moved(moved, floor)
        reached = _Iterate(likelihood, point.cameras, state, floor)
        if reached.value <= point.value + SUFFICIENT_DECREASE * length * slope:
            moved[-1] = np.log(reached.state.noise / point.state.noise)
            return reached, moved
        # The minimum of the parabola through what is known, kept within bounds.
        excess = reached.value - point.value - length * slope
        length *= min(max(-length * slope / (2 * excess), 0.1), 0.5)
    return None, step
