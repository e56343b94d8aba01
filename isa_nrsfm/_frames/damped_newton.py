"""Newton's method for many frames at once, each with an objective of its own.

The frame is the last index of all arrays. A step is damped where the Hessian is not
positive definite or a step has raised the objective, so that this never rises, up to
rounding. A frame leaves the problem when it has ended: the others go on without it.
"""

from typing import NamedTuple, Protocol, Self

import numpy as np
from numpy.typing import NDArray

from isa_nrsfm._frames.options import Damping, FrameOptions
from isa_nrsfm._linalg.packed_symmetric import solve_positive
from isa_nrsfm._linalg.rounding import OF_STEPS
from isa_nrsfm._linalg.vectors import in_lanes, of_frames


class State(NamedTuple):
    """
    The objectives of frames at some positions, and their derivatives.

    Attributes
    ----------
    position : ndarray of shape (..., n_frames)
        Where they are taken.
    value : ndarray of shape (n_frames,)
        The objectives, up to a constant of each frame.
    slope : ndarray of shape (n_parameters, n_frames)
        Minus half the gradient.
    definite : ndarray of shape (n_pairs, n_frames)
        A positive semidefinite part of the Hessian, packed: steps are damped by it.
    hessian : ndarray of shape (n_pairs, n_frames)
        Half the Hessian, packed.
    """

    position: NDArray
    value: NDArray
    slope: NDArray
    definite: NDArray
    hessian: NDArray

    def take(self, frames: NDArray) -> Self:
        """Return the state of some of the frames."""
        return type(self)(*(of_frames(each, frames) for each in self))

    def put(self, frames: NDArray, other: Self) -> None:
        """Set the state of some of the frames."""
        for each, given in zip(self, other, strict=True):
            each[..., frames] = given


class FrameProblem(Protocol):
    """
    The objectives of frames.

    Attributes
    ----------
    energy : ndarray of shape (n_frames,)
        What gains and rounding errors of the objectives are compared with.
    options : FrameOptions
        When the search of a frame ends.
    damping : Damping
        How steps are damped.
    """

    @property
    def energy(self) -> NDArray:
        """What gains and rounding errors are compared with."""

    @property
    def options(self) -> FrameOptions:
        """When the search of a frame ends."""

    @property
    def damping(self) -> Damping:
        """How steps are damped."""

    def take(self, frames: NDArray) -> Self:
        """Return the problem of some of the frames."""

    def evaluate(self, position: NDArray) -> State:
        """Return the objectives and their derivatives."""

    def step(self, state: State, damping: NDArray) -> tuple[NDArray, NDArray]:
        """Return steps (n_parameters, n_frames), and the damping that they took."""

    def moved(self, position: NDArray, step: NDArray) -> NDArray:
        """Return the positions after steps."""


def newton_step(state: State, damping: NDArray) -> tuple[NDArray, NDArray]:
    """Return damped Newton steps (p, n), and where the matrix is positive definite."""
    matrix = state.hessian
    if damping.any():
        matrix = matrix + damping * state.definite
    return solve_positive(matrix, state.slope)


def descend(
    problem: FrameProblem,
    state: State,
    max_steps: int,
    limit: NDArray | None = None,
) -> tuple[NDArray, NDArray]:
    """
    Minimise the objectives of frames.

    Parameters
    ----------
    problem : FrameProblem
        The objectives.
    state : State
        Where the search starts.
    max_steps : int
        The most steps.
    limit : ndarray of shape (n_frames,), optional
        The search of a frame is given up where the predicted gain says that its
        objective will not fall below its limit.

    Returns
    -------
    position : ndarray of shape (..., n_frames)
        The last iterates.
    converged : ndarray of bool, shape (n_frames,)
        Whether they have converged.
    """
    options, rule, n_frames = problem.options, problem.damping, len(state.value)
    found, converged = state.position.copy(), np.zeros(n_frames, dtype=bool)
    running, damping = np.arange(n_frames), np.zeros(n_frames)
    limit = np.full(n_frames, np.inf) if limit is None else limit
    for n_left in range(max_steps, -1, -1):
        # Next step, and convergence test by the decrease that it predicts
        step, damping = problem.step(state, damping)
        gain = np.einsum("pi,pi->i", state.slope, step)
        small = (damping == 0) & (gain <= options.tolerance * problem.energy)
        leaving = small | (damping >= rule.largest)
        leaving |= state.value - options.promised * gain > limit
        # Frames that have ended leave the problem, converged ones with a last step.
        if leaving.any():
            last = problem.moved(state.position, np.where(small, step, 0.0))
            found[..., running[leaving]] = last[..., leaving]
            converged[running[leaving]] = small[leaving]
            if leaving.all():
                return found, converged
            left = in_lanes(np.flatnonzero(~leaving))
            running, limit = running[left], limit[left]
            damping, step = damping[left], of_frames(step, left)
            problem, state = problem.take(left), state.take(left)
        if not n_left:
            break
        # Trial step, refused where the objective rises. Less damping after a good step,
        # more after a refused one.
        trial = problem.evaluate(problem.moved(state.position, step))
        highest = state.value + OF_STEPS * problem.energy
        worse = np.flatnonzero(~(trial.value <= highest))
        eased = np.where(damping > rule.least, rule.eased * damping, 0.0)
        if len(worse):
            eased[worse] = np.maximum(rule.raised * damping[worse], rule.first)
            trial.put(worse, state.take(worse))
        state, damping = trial, eased
    found[..., running] = state.position
    return found, converged
