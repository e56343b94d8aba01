"""Newton's method for cameras and coefficients of many frames at once.

The frame is the last index of all arrays. Steps are damped where the Hessian is not
positive definite or a step has raised the objective of a frame, so that it never rises.
"""

from typing import Any, NamedTuple, Self

import numpy as np
from numpy.typing import NDArray

from isa_nrsfm._frames.point_sums import FrameSums, ShapeProducts
from isa_nrsfm._linalg.packed_symmetric import invert_positive, solve_positive, unpacked
from isa_nrsfm._linalg.rounding import OF_STEPS
from isa_nrsfm._linalg.vectors import frames_first, in_lanes, of_frames

# Largest number of steps of a search.
MAX_STEPS = 60
# With so much damping a step no longer moves, and the search of the frame ends.
LARGEST_DAMPING = 1e8


class FramePosterior(NamedTuple):
    """Fits of frames; NaN for frames whose points do not determine a camera.

    motion (I, 2, 3): cameras, in the units of the tracks per unit of the shapes.
    translation (I, 2): image of the origin of the shapes.
    covariance (I, K, K) or (I, 0, 0): posterior covariance of alpha in the normal
    approximation at the optimum (Laplace), with the uncertainty of camera and position.
    turn_covariance (I, 3, 3): posterior covariance of the rotation vectors w of ``M
    exp(hat(w))``, with the uncertainty of the coefficients. NaN for affine cameras.
    objective (I,): ``sum_j w_ij ||m_ij - M S_j - t||^2 + s2 |a|^2``, to 1e-12 of the
    energy.
    converged (I,): whether the last Newton step was below the convergence tolerance.
    """

    motion: NDArray
    translation: NDArray
    alpha: NDArray
    covariance: NDArray
    turn_covariance: NDArray
    objective: NDArray
    converged: NDArray

    @classmethod
    def unknown(
        cls, n_frames: int, n_components: int, covariances: bool = True
    ) -> Self:
        """Return fits of NaN, to be filled in, with or without covariances."""
        size = n_components if covariances else 0
        shapes = (2, 3), (2,), (n_components,), (size, size), (3, 3), ()
        parts: list[Any] = [np.full((n_frames, *shape), np.nan) for shape in shapes]
        return cls._make([*parts, np.zeros(n_frames, dtype=bool)])

    def take(self, frames: NDArray) -> Self:
        """Return the fits of some of the frames."""
        return type(self)(*(each[frames] for each in self))

    def put(self, frames: NDArray, others: Self) -> None:
        """Set the fits of some of the frames."""
        for each, other in zip(self, others, strict=True):
            each[frames] = other


class FrameProblem(NamedTuple):
    """Frames, given by their sums for the shapes, and their noise variances (n,)."""

    products: FrameSums
    noise: NDArray

    @property
    def energy(self) -> NDArray:
        """``||W||^2 + s2`` (n,): gains and rounding errors are compared with it."""
        return self.products.energy + self.noise

    def take(self, frames: NDArray) -> Self:
        """Return some of the frames."""
        return type(self)(self.products.take(frames), self.noise[frames])


class State(NamedTuple):
    """
    The objectives of frames at some positions, up to constants, and their derivatives.

    position (..., n): coefficients or cameras; slope: minus half the gradient.
    definite (n_pairs, n): a semidefinite part of the Hessian, packed, for damping.
    hessian (n_pairs, n): half the Hessian, packed.
    """

    position: NDArray
    value: NDArray
    slope: NDArray
    definite: NDArray
    hessian: NDArray

    def take(self, frames: NDArray) -> Self:
        """Return the state of some of the frames."""
        return type(self)(*(of_frames(each, frames) for each in self))

    def newton_step(self, damping: NDArray) -> tuple[NDArray, NDArray]:
        """Return damped steps (p, n), and where the matrix is positive definite."""
        matrix = self.hessian
        if damping.any():
            matrix = matrix + damping * self.definite
        return solve_positive(matrix, self.slope)

    def inverse(self) -> NDArray:
        """Return inverse Hessians (p, p, n), where indefinite those of `definite`."""
        inverse, positive = invert_positive(self.hessian)
        bad = in_lanes(np.flatnonzero(~positive))
        if len(bad):
            inverse[:, bad] = invert_positive(self.definite[:, bad])[0]
        return unpacked(inverse)


class FrameSearch:
    """A search for cameras of one model that see given shapes, frame by frame.

    Shapes (K + 1, 3, J), rows centred, are in the coordinates of the search, to which
    `space` (3, 3) maps the original ones. A first round has at most `first_steps`
    steps, block by block. Frames that have not converged are collected from all blocks
    for a second round. Rough cameras take `rough_steps`.
    """

    first_steps = MAX_STEPS
    rough_steps = 3

    def __init__(self, shapes: NDArray, space: NDArray):
        self.shared, self.space = ShapeProducts(shapes), space

    def fit(
        self,
        products: FrameSums,
        variance: NDArray,
        initial: NDArray,
        max_steps: int,
        covariances: bool = True,
        rough: bool = False,
    ) -> FramePosterior:
        """Return the minima that frames reach from coefficients initial (n, K).

        The sums are those for the shapes in `shared`, the noise variances (n,). Rough
        cameras need not be those of the lowest minimum.
        """
        problem = self.problem(products, variance)
        start = self.evaluate(problem, self.start(problem, initial.T))
        position, converged = self.descend(problem, start, max_steps)
        if not rough:
            position = self.improved(problem, position, converged, max_steps)
        M, alpha, objective = self.solution(problem, position)
        motion, n = frames_first(M), len(objective)
        spreads = np.empty((n, 0, 0)), np.full((n, 3, 3), np.nan)
        if covariances:
            covariance, turns = self.covariances(problem, position)
            turns = self.space.T @ frames_first(turns) @ self.space
            spreads = frames_first(covariance), turns
        return FramePosterior(
            motion @ self.space,
            products.positions(motion, alpha.T),
            alpha.T,
            *spreads,
            np.maximum(objective, 0.0),  # less is rounding errors
            converged,
        )

    def problem(self, products: FrameSums, variance: NDArray) -> FrameProblem:
        """Return frames with noise variances (n,) that are not zero."""
        noise = np.maximum(variance, 1e-13 * products.energy)
        return FrameProblem(products, np.where(noise > 0, noise, 1.0))

    def start(self, problem: FrameProblem, alpha: NDArray) -> NDArray:
        """Return where the search starts from coefficients (K, n)."""
        raise NotImplementedError

    def evaluate(self, problem: FrameProblem, position: NDArray) -> State:
        """Return the objectives and their derivatives."""
        raise NotImplementedError

    def solution(
        self, problem: FrameProblem, position: NDArray
    ) -> tuple[NDArray, NDArray, NDArray]:
        """Return cameras (2, 3, n), coefficients (K, n) and objectives (n,)."""
        raise NotImplementedError

    def covariances(
        self, problem: FrameProblem, position: NDArray
    ) -> tuple[NDArray, NDArray]:
        """Return covariances of coefficients (K, K, n) and rotations (3, 3, n)."""
        raise NotImplementedError

    def improved(
        self, problem: FrameProblem, position: NDArray, converged: NDArray, n_steps: int
    ) -> NDArray:
        """Return positions of lower minima, and set whether they have converged."""
        return position

    def moved(self, position: NDArray, step: NDArray) -> NDArray:
        """Return the positions after steps (n_parameters, n)."""
        return position + step

    def limited(self, step: NDArray) -> NDArray:
        """Return steps (n_parameters, n), each shortened to the largest allowed one."""
        return step

    def descend(
        self,
        problem: FrameProblem,
        state: State,
        max_steps: int,
        limit: NDArray | None = None,
    ) -> tuple[NDArray, NDArray]:
        """Minimise the objectives; return iterates (..., n) and convergence (n,).

        A frame is given up where its objective will not fall below its limit (n,).
        """
        n_frames = len(state.value)
        found, converged = state.position.copy(), np.zeros(n_frames, dtype=bool)
        running, damping = np.arange(n_frames), np.zeros(n_frames)
        limit = np.full(n_frames, np.inf) if limit is None else limit
        for n_left in range(max_steps, -1, -1):
            # Next step, and convergence test by the decrease that it predicts.
            # Convergence is quadratic: the step after it would gain far less.
            step, damping = self.step(state, damping)
            gain = np.einsum("pi,pi->i", state.slope, step)
            small = (damping == 0) & (gain <= 1e-12 * problem.energy)
            leaving = small | (damping >= LARGEST_DAMPING)
            leaving |= state.value - 10.0 * gain > limit
            # Frames that have ended leave the problem, converged ones with a last step.
            if leaving.any():
                last = self.moved(state.position, np.where(small, step, 0.0))
                found[..., running[leaving]] = last[..., leaving]
                converged[running[leaving]] = small[leaving]
                if leaving.all():
                    return found, converged
                left = in_lanes(np.flatnonzero(~leaving))
                running, limit, damping = running[left], limit[left], damping[left]
                step, problem = of_frames(step, left), problem.take(left)
                state = state.take(left)
            if not n_left:
                break
            # Trial step, refused where the objective rises. Less damping after a good
            # step, more after a refused one.
            trial = self.evaluate(problem, self.moved(state.position, step))
            highest = state.value + OF_STEPS * problem.energy
            worse = np.flatnonzero(~(trial.value <= highest))
            eased = np.where(damping > 0.01, 0.1 * damping, 0.0)
            if len(worse):
                eased[worse] = raised(damping[worse])
                for new, old in zip(trial, state, strict=True):
                    new[..., worse] = old[..., worse]
            state, damping = trial, eased
        found[..., running] = state.position
        return found, converged

    def step(self, state: State, damping: NDArray) -> tuple[NDArray, NDArray]:
        """Return Newton steps (p, n) and the damping (n,) that makes them definite."""
        damping = damping.copy()
        step, positive = state.newton_step(damping)
        failing = in_lanes(np.flatnonzero(~positive))
        while len(failing):
            damping[failing] = raised(damping[failing])
            part = state.take(failing)
            step[:, failing], positive = part.newton_step(damping[failing])
            still = ~positive & (damping[failing] < LARGEST_DAMPING)
            failing = in_lanes(np.unique(failing[still]))
        return self.limited(step), damping


def raised(damping: NDArray) -> NDArray:
    """Return more damping (n,)."""
    return np.maximum(8.0 * damping, 0.1)
