"""Joint refinement: cameras, shapes and noise of greatest marginal likelihood.

All are moved together by a limited memory quasi-Newton method (Nocedal, Wright,
"Numerical optimization", 2006, section 7.2). Its initial inverse Hessian is the inverse
of the curvature of expectation maximisation at the current iterate. A step without
remembered pairs is thus a generalised step of expectation maximisation.
"""

from collections import deque
from collections.abc import Callable
from functools import cached_property
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from isa_nrsfm._frames.camera_models import CameraModel
from isa_nrsfm._joint.likelihood import MarginalLikelihood
from isa_nrsfm._linalg.rounding import OF_DIFFERENCES, OF_SUMS
from isa_nrsfm._linalg.small_matrices import frames_first, frames_last

# Lower bound of the noise variance, as a share of the mean square of the tracks. It
# keeps the objective finite for tables without noise.
NOISE_FLOOR = 1e-11

# Steps, changes of the gradient, and their inner products.
Memory = deque[tuple[NDArray, NDArray, float]]


class JointState(NamedTuple):
    """Shapes (n_shapes, 3, J), cameras (I, 2, 3) and noise variance of a coordinate."""

    shapes: NDArray
    motion: NDArray
    noise: float


class JointFit(NamedTuple):
    """Result of the joint refinement.

    history (n_iter + 1,): objective at the start and after each step; it never rises.
    gradient_norm: ``sqrt(g^T D g / N)`` at the end, with the gradient g, the inverse D
    of the approximate Hessian and the number N of coordinates. Its square is about half
    to twice the possible further decrease of the objective per coordinate.
    left: the maximum of the noise variance and the mean square residual at the
    posterior means of the coefficients. camera_noise_ratio: noise variance with
    calibrated cameras divided by that with affine ones, for the sample of
    `fit_jointly`. NaN with given starts.
    """

    state: JointState
    history: NDArray
    gradient_norm: float
    converged: bool
    left: float
    camera_noise_ratio: float = np.nan

    @property
    def value(self) -> float:
        """The objective at the end."""
        return float(self.history[-1])


def refine_joint(
    likelihood: MarginalLikelihood,
    start: JointState,
    cameras: CameraModel,
    *,
    least_noise: float = NOISE_FLOOR,
    max_iter: int,
    tol: float,
    on_step: Callable[[], None] | None = None,
) -> JointFit:
    """Minimise the objective of `MarginalLikelihood` from a start.

    `least_noise` is a share of the mean square of the tracks. The iteration ends when
    two consecutive steps each gain less than `tol` times the number of frames.
    """
    floor = least_noise * likelihood.square / likelihood.n_seen
    start = start._replace(noise=max(start.noise, floor))
    iterate = _Iterate(likelihood, cameras, start, floor)
    # At most 20 pairs, fewer if they would exceed 2^25 numbers, but never less than 3
    most = 2**25 // (2 * iterate.gradient.size)
    memory: Memory = deque(maxlen=max(min(most, 20), 3))
    history, small_steps = [iterate.value], 0
    while len(history) <= max_iter and small_steps < 2:
        if on_step is not None:
            on_step()
        # L-BFGS direction, or the preconditioned gradient if L-BFGS does not descend
        direction = -_inverse_hessian_product(iterate, memory)
        if not iterate.gradient @ direction < 0:
            memory.clear()
            direction = -iterate.precondition(iterate.gradient)
        reached, step = _line_search(iterate, direction)
        if reached is None:
            if not memory:  # even the gradient fails: only rounding errors remain
                small_steps = 2
            memory.clear()
            continue
        # Update of the memory, if the curvature along the step is positive
        change = reached.gradient - iterate.gradient
        curvature = float(step @ change)
        if curvature > 1e-10 * np.linalg.norm(step) * np.linalg.norm(change):
            memory.append((step, change, curvature))
        # Convergence test
        gain = iterate.value - reached.value
        rounding = OF_SUMS * likelihood.square / reached.state.noise
        small = gain < max(tol * likelihood.n_frames, rounding)
        small_steps = small_steps + 1 if small else 0
        iterate = reached
        history.append(iterate.value)
    memory.clear()
    slope = iterate.gradient @ iterate.precondition(iterate.gradient)
    return JointFit(
        iterate.state,
        np.array(history),
        float(np.sqrt(max(slope, 0.0) / likelihood.n_seen)),
        small_steps >= 2 and bool(np.isfinite(iterate.value)),
        iterate.left,
    )


class _Iterate:
    """A state with the objective, its gradient and its approximate curvature.

    The unknowns as one vector: shapes, parameters of the cameras, log noise variance.
    """

    def __init__(
        self,
        likelihood: MarginalLikelihood,
        cameras: CameraModel,
        state: JointState,
        floor: float,
    ):
        passed = likelihood(*state)
        self.likelihood, self.cameras = likelihood, cameras
        self.state, self.floor = state, floor
        self.M = frames_last(state.motion)
        self.n_seen = likelihood.n_seen
        self.value = passed.value
        self.left = max(state.noise, passed.residual / likelihood.n_seen)
        at_floor = state.noise <= floor * (1 + 1e-6)
        self.gradient = _stacked(
            passed.shape_gradient,
            cameras.gradient(self.M, passed.motion_gradient),
            # At its lower bound the noise variance may only rise.
            min(passed.noise_gradient, 0.0 if at_floor else np.inf),
        )
        self.curvature = passed.shape_curvature, passed.motion_curvature

    @cached_property
    def metric(self) -> tuple[NDArray, NDArray]:
        """Inverses of the curvatures of the shapes and of the cameras."""
        by_shapes, by_cameras = self.curvature
        inverse = self.cameras.inverse_curvature(self.M, by_cameras)
        return np.linalg.inv(regular(by_shapes)), inverse

    def precondition(self, vector: NDArray) -> NDArray:
        """Return a vector times the inverse of the approximate Hessian.

        The Hessian is block diagonal: ``2 / s2`` times the curvatures of shapes and
        cameras, and N for ``log s2``.
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

    def moved(self, step: NDArray) -> "_Iterate":
        """Return the iterate after a step; the noise variance is at least floor."""
        shapes, steps, noise = self.split(step)
        state = JointState(
            self.state.shapes + shapes,
            frames_first(self.cameras.moved(self.M, steps)),
            max(self.state.noise * np.exp(noise), self.floor),
        )
        return _Iterate(self.likelihood, self.cameras, state, self.floor)


def regular(curvature: NDArray) -> NDArray:
    """Return curvatures (n, m, m) with a small ridge, as they can be singular."""
    size = curvature.shape[-1]
    # Points that are visible in no frame have zero curvature and zero gradient.
    ridge = OF_DIFFERENCES * np.trace(curvature, axis1=1, axis2=2).mean() / size or 1.0
    return curvature + ridge * np.eye(size)


def _stacked(shapes: NDArray, steps: NDArray, noise: float) -> NDArray:
    """Return the three parts of the unknowns as one vector, with steps (p, I)."""
    return np.concatenate([shapes.ravel(), steps.ravel(), [noise]])


def _inverse_hessian_product(iterate: _Iterate, memory: Memory) -> NDArray:
    """Return the L-BFGS inverse Hessian times the gradient (two-loop recursion)."""
    vector = iterate.gradient.copy()
    weights = []
    for step, change, curvature in reversed(memory):
        weights.append(step @ vector / curvature)
        vector -= weights[-1] * change
    vector = iterate.precondition(vector)
    for (step, change, curvature), weight in zip(
        memory, reversed(weights), strict=True
    ):
        vector += (weight - change @ vector / curvature) * step
    return vector


def _line_search(
    iterate: _Iterate, direction: NDArray
) -> tuple[_Iterate | None, NDArray]:
    """Return the first iterate that meets the Armijo condition, or None, and step."""
    slope = iterate.gradient @ direction
    # Largest step length that the parametrisation of noise and cameras allows
    length = min(
        1.0,
        1.5 / max(abs(direction[-1]), 1e-300),
        iterate.cameras.largest_length(iterate.split(direction)[1]),
    )
    while length > 1e-8:
        step = length * direction
        reached = iterate.moved(step)
        if reached.value <= iterate.value + 1e-4 * length * slope:
            # The lower bound may have shortened the change of the noise.
            step[-1] = np.log(reached.state.noise / iterate.state.noise)
            return reached, step
        # Backtracking by quadratic interpolation of both values and the slope
        excess = reached.value - iterate.value - length * slope
        length *= min(max(-length * slope / (2 * excess), 0.1), 0.5)
    return None, direction
