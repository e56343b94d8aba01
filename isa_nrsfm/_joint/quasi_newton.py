"""Joint refinement: cameras, shapes and noise of greatest marginal likelihood.

Cameras M_i, shapes B_0, ..., B_K and the noise variance are moved together by a limited
memory quasi-Newton method (Nocedal, Wright, "Numerical optimization", 2006, section
7.2). The initial inverse Hessian of each step is the inverse of the curvature that
expectation maximisation uses, at the current iterate. A step without remembered pairs
is thus a generalised step of expectation maximisation.
"""

from collections import deque
from collections.abc import Callable
from functools import cached_property
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from isa_nrsfm._frames.camera_models import CameraModel
from isa_nrsfm._joint.likelihood import MarginalLikelihood
from isa_nrsfm._joint.options import JOINT_OPTIONS, JointOptions, SearchOptions
from isa_nrsfm._linalg.rounding import OF_DIFFERENCES, OF_SUMS
from isa_nrsfm._linalg.vectors import frames_first, frames_last


class JointState(NamedTuple):
    """
    Unknowns of the joint refinement.

    Attributes
    ----------
    shapes : ndarray of shape (n_shapes, 3, n_points)
        B_0, ..., B_K.
    motion : ndarray of shape (n_frames, 2, 3)
        Cameras.
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
        ``sqrt(g^T D g / N)`` at the end, with the gradient g, the inverse D of the
        approximate Hessian and the number N of coordinates. Its square is, up to a
        factor of about two, the decrease of the objective for each coordinate that is
        still possible.
    converged : bool
        Whether it stopped by the convergence tolerance, not by the number of steps.
    residual : float
        Mean square residual of the shapes with the posterior means of the coefficients.
    left : float
        The larger one of noise variance and residual.
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
    least_noise: float | None = None,
    max_iter: int,
    tol: float,
    on_step: Callable[[], None] | None = None,
    options: JointOptions = JOINT_OPTIONS,
) -> JointResult:
    """
    Minimise the objective of `MarginalLikelihood`.

    Parameters
    ----------
    likelihood : MarginalLikelihood
        The objective.
    start : JointState
        The first iterate.
    cameras : CameraModel
        The cameras that are allowed, and how a step changes them.
    least_noise : float, optional
        Lower bound of the noise variance, as a share of the mean square of the tracks.
        By default the `noise_floor` of the options.
    max_iter : int
        Largest number of steps.
    tol : float
        Convergence tolerance: the iteration ends when two consecutive steps each lower
        the objective by less than tol times the number of frames.
    on_step : callable, optional
        Called before each step.
    options : JointOptions
        How steps are made; only `search` is looked at.

    Returns
    -------
    JointResult
        The result.
    """
    search = options.search
    floor = search.noise_floor if least_noise is None else least_noise
    floor = floor * likelihood.square / likelihood.n_seen
    start = start._replace(noise=max(start.noise, floor))
    iterate = _Iterate(likelihood, cameras, start, floor)
    most = search.memory_numbers // (2 * iterate.gradient.size)
    memory: deque[tuple[NDArray, NDArray, float]] = deque(
        maxlen=max(min(most, search.memory), search.least_memory)
    )
    history = [iterate.value]
    small_steps = 0
    while len(history) <= max_iter and small_steps < 2:
        if on_step is not None:
            on_step()
        # L-BFGS direction, or the preconditioned gradient if that is no descent
        direction = -_inverse_hessian_product(iterate, memory)
        if not iterate.gradient @ direction < 0:
            memory.clear()
            direction = -iterate.precondition(iterate.gradient)
        # Armijo line search
        reached, step = _line_search(likelihood, iterate, direction, floor, search)
        if reached is None:
            if not memory:  # the gradient itself fails: rounding errors are left
                small_steps = 2
            memory.clear()
            continue
        # Update of the memory
        change = reached.gradient - iterate.gradient
        _remember(memory, step, change, search.least_curvature)
        # Convergence test
        gain = iterate.value - reached.value
        rounding = OF_SUMS * likelihood.square / reached.state.noise
        small = gain < max(tol * likelihood.n_frames, rounding)
        small_steps = small_steps + 1 if small else 0
        iterate = reached
        history.append(iterate.value)
    memory.clear()
    slope = iterate.gradient @ iterate.precondition(iterate.gradient)
    return JointResult(
        iterate.state,
        np.array(history),
        float(np.sqrt(max(slope, 0.0) / likelihood.n_seen)),
        small_steps >= 2 and bool(np.isfinite(iterate.value)),
        iterate.residual,
        iterate.left,
    )


def _remember(
    memory: deque[tuple[NDArray, NDArray, float]],
    step: NDArray,
    change: NDArray,
    least_curvature: float,
) -> None:
    """
    Add a pair to the L-BFGS memory, if the curvature along the step is positive.

    Both are vectors of all unknowns: the step ``s`` and the change ``y`` of the
    gradient. The curvature is ``s^T y``; its least value is relative to ``|s| |y|``.
    """
    curvature = float(step @ change)
    size = least_curvature * np.linalg.norm(step) * np.linalg.norm(change)
    if curvature > size:
        memory.append((step, change, curvature))


class _Iterate:
    """
    A state with the objective, its gradient and its approximate curvature there.

    The unknowns as one vector: shapes, parameters of the cameras, and the logarithm of
    the noise variance last.
    """

    def __init__(
        self,
        likelihood: MarginalLikelihood,
        cameras: CameraModel,
        state: JointState,
        floor: float,
    ):
        passed = likelihood(*state)
        self.state, self.cameras = state, cameras
        self.M = frames_last(state.motion)
        self.n_seen = likelihood.n_seen
        self.value = passed.value
        self.residual = passed.residual / likelihood.n_seen
        # The noise variance, or the mean square residual where that is larger.
        self.left = max(state.noise, self.residual)
        at_floor = state.noise <= floor * (1 + 1e-6)
        self.gradient = _stacked(
            passed.shape_gradient,
            cameras.gradient(self.M, frames_last(passed.motion_gradient)),
            # At its lower bound the noise variance may only rise.
            min(passed.noise_gradient, 0.0 if at_floor else np.inf),
        )
        self.curvature = passed.shape_curvature, passed.motion_curvature

    @cached_property
    def metric(self) -> tuple[NDArray, NDArray]:
        """Inverses of the curvatures by the shapes and by the cameras."""
        by_shapes, by_cameras = self.curvature
        inverse = self.cameras.inverse_curvature(self.M, by_cameras)
        return np.linalg.inv(regular(by_shapes)), inverse

    def precondition(self, vector: NDArray) -> NDArray:
        """
        Return a vector times the inverse of the approximate Hessian.

        The Hessian is ``2 / s2`` times the curvature by shapes and cameras, and N, the
        number of coordinates, by ``log s2``. It has no blocks across these three.
        """
        half = self.state.noise / 2
        shapes, steps, noise = self.split(vector)
        by_shapes, by_cameras = self.metric
        stacked = shapes.reshape(-1, shapes.shape[-1])
        if len(by_shapes) == 1:
            stacked = by_shapes[0] @ stacked
        else:
            stacked = (by_shapes @ stacked.T[:, :, None])[:, :, 0].T
        steps = self.cameras.product(by_cameras, steps)
        return _stacked(half * stacked, half * steps, noise / self.n_seen)

    def split(self, vector: NDArray) -> tuple[NDArray, NDArray, float]:
        """Return shapes (n, 3, J), parameters of cameras (p, I), and log noise."""
        first = self.state.shapes.size
        return (
            vector[:first].reshape(self.state.shapes.shape),
            vector[first:-1].reshape(self.cameras.n_parameters, len(self.state.motion)),
            vector[-1],
        )

    def moved(self, step: NDArray, floor: float) -> JointState:
        """Return the state after a step; the noise variance is at least floor."""
        shapes, steps, noise = self.split(step)
        return JointState(
            self.state.shapes + shapes,
            frames_first(self.cameras.moved(self.M, steps)),
            max(self.state.noise * np.exp(noise), floor),
        )


def regular(curvature: NDArray) -> NDArray:
    """
    Return curvatures (n, m, m) by the shapes with a small ridge added.

    They are singular where the table does not determine the shapes.
    """
    size = curvature.shape[-1]
    # Points that no frame shows have no curvature, and no gradient either.
    ridge = OF_DIFFERENCES * np.trace(curvature, axis1=1, axis2=2).mean() / size or 1.0
    return curvature + ridge * np.eye(size)


def _stacked(shapes: NDArray, steps: NDArray, noise: float) -> NDArray:
    """Return the three parts of the unknowns as one vector, with steps (p, I)."""
    return np.concatenate([shapes.ravel(), steps.ravel(), [noise]])


def _inverse_hessian_product(
    iterate: _Iterate, memory: deque[tuple[NDArray, NDArray, float]]
) -> NDArray:
    """Return the L-BFGS inverse Hessian times the gradient (two-loop recursion)."""
    vector = iterate.gradient.copy()
    weights = []
    for step, change, curvature in reversed(memory):
        weight = step @ vector / curvature
        vector -= weight * change
        weights.append(weight)
    vector = iterate.precondition(vector)
    for (step, change, curvature), weight in zip(
        memory, reversed(weights), strict=True
    ):
        vector += (weight - change @ vector / curvature) * step
    return vector


def _line_search(
    likelihood: MarginalLikelihood,
    iterate: _Iterate,
    direction: NDArray,
    floor: float,
    options: SearchOptions,
) -> tuple[_Iterate | None, NDArray]:
    """
    Return the first iterate along a direction that meets the Armijo condition.

    The step that leads there is returned, too. The iterate is None if none is found.
    """
    slope = iterate.gradient @ direction
    # Largest step length that the parametrisation of noise and cameras allows
    length = min(
        1.0,
        options.largest_noise_step / max(abs(direction[-1]), 1e-300),
        iterate.cameras.largest_length(iterate.split(direction)[1]),
    )
    while length > options.shortest_step:
        step = length * direction
        state = iterate.moved(step, floor)
        reached = _Iterate(likelihood, iterate.cameras, state, floor)
        enough = options.sufficient_decrease * length * slope
        if reached.value <= iterate.value + enough:
            # The lower bound may have shortened the change of the noise.
            step[-1] = np.log(reached.state.noise / iterate.state.noise)
            return reached, step
        # Backtracking by quadratic interpolation of both values and the slope
        excess = reached.value - iterate.value - length * slope
        best = -length * slope / (2 * excess)
        length *= min(max(best, options.strongest_cut), options.weakest_cut)
    return None, direction
