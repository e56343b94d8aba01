"""Most probable camera, position and coefficients of frames, for given shapes.

Newton's method for many frames at once, the frame as the last index of all arrays.
Steps are damped if the Hessian is not positive definite or a step has raised the
objective of a frame. So the objective never rises. The search starts from zero
coefficients. Badly fitted frames start again from others.
"""

from functools import partial
from typing import Any, NamedTuple, Self

import numpy as np
from numpy.typing import NDArray

from isa_nrsfm._frames.camera_models import CameraModel
from isa_nrsfm._frames.point_sums import (
    FrameSums,
    FrameTracks,
    ShapeProducts,
    determines_camera,
    frame_sums,
    frame_tracks,
)
from isa_nrsfm._linalg.rounding import OF_STEPS
from isa_nrsfm._linalg.small_matrices import (
    frames_first,
    invert_positive,
    of_frames,
    padded,
    solve_positive,
    unpacked,
)
from isa_nrsfm._tables.tracks import seen_points

# Largest number of steps of a search.
MAX_STEPS = 60
# The search of a frame ends at this damping: its steps no longer move it.
LARGEST_DAMPING = 1e8
# Objectives with a smaller relative difference are equal.
EQUAL = 1e-10


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
        return type(self)(*(part[frames] for part in self))

    def put(self, frames: NDArray, others: Self) -> None:
        """Set the fits of some of the frames."""
        for part, other in zip(self, others, strict=True):
            part[frames] = other


def largest_objective(n_points: Any, noise: Any) -> Any:
    """Return the objectives beyond which the minimum may not be the lowest one.

    At the minimum, f / s2 is the squared Mahalanobis distance of a frame from the
    model. It is chi-squared distributed, with two degrees of freedom per point minus
    the eight of camera and position. The threshold is three times its expectation.
    """
    return 3.0 * noise * np.maximum(2.0 * n_points - 8.0, 1.0)


# Frames, given by their sums for the shapes, and their noise variances (n,)
FrameProblem = tuple[FrameSums, NDArray]


def scale_of(problem: FrameProblem) -> NDArray:
    """Return ``||W||^2 + s2`` (n,), the scale of gains and rounding errors."""
    products, noise = problem
    return products.energy + noise


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

    def inverse(self) -> NDArray:
        """Return inverse Hessians (p, p, n), or of `definite` where indefinite."""
        inverse, positive = invert_positive(self.hessian)
        bad = padded(np.flatnonzero(~positive))
        if len(bad):
            inverse[:, bad] = invert_positive(self.definite[:, bad])[0]
        return unpacked(inverse)


# Minima below which lower ones are searched: positions (..., n), values (n,) to fall
# below, and distances (n,) from the positions within which a search is in the same well
Minima = tuple[NDArray, NDArray, NDArray]


class FrameSearch:
    """A search for cameras of one model that see given shapes, frame by frame.

    Shapes (K + 1, 3, J), rows centred, are in the coordinates of the search, to which
    `space` (3, 3) maps the original ones. In the first round each block takes at most
    `first_steps` steps. Frames that have not converged are collected from all blocks
    for a second round. Rough cameras take `rough_steps`.
    """

    first_steps = MAX_STEPS
    rough_steps = 3

    def __init__(self, shapes: NDArray, space: NDArray, model: CameraModel):
        self.shared, self.space, self.model = ShapeProducts(shapes), space, model

    def fit_rows(
        self,
        rows: NDArray,
        noise: NDArray | float,
        *,
        weights: NDArray | None = None,
        initial: NDArray | None = None,
        starts: NDArray | None = None,
        covariances: bool = True,
    ) -> FramePosterior:
        """Fit rows (I, 2, J), NaN where a point is missing, as `fit` does.

        The noise variance is at least 1e-13 of the energy. Weights (I, J) are 1 by
        default.
        """
        n_frames, n_components = len(rows), len(self.shared.shapes) - 1
        noise = np.broadcast_to(np.asarray(noise, dtype=float), (n_frames,))
        given = 1.0 if weights is None else weights
        weights = np.where(seen_points(rows), given, 0.0)
        complete = (weights == 1.0).all(axis=1)
        fits = FramePosterior.unknown(n_frames, n_components, covariances)
        # Complete frames share one Gram matrix.
        for chosen in np.flatnonzero(complete), np.flatnonzero(~complete):
            if len(chosen):
                frames = padded(chosen)
                own = None if complete[frames[0]] else weights[frames]
                fit = self.fit(
                    frame_tracks(rows[frames], own),
                    noise[frames],
                    initial=None if initial is None else initial[frames],
                    starts=starts,
                    covariances=covariances,
                )
                fits.put(frames, fit)
        return fits

    def fit(
        self,
        frames: FrameTracks,
        noise: NDArray | float,
        *,
        initial: NDArray | None = None,
        starts: NDArray | None = None,
        covariances: bool = True,
        rough: bool = False,
    ) -> FramePosterior:
        """Return the most probable camera, position and coefficients of each frame.

        The shapes are by points or directions, as the frames. `initial` (I, K) is zero
        by default. If the residuals of a frame are much larger than the noise, it
        starts again from each of `starts` (n_starts, K). `rough`: end after few steps.

        Frames are independent. They are NaN if their points do not determine a camera.
        If only the mean shape is flat, zero can be a saddle point: further starts help.
        """
        n_frames, n_components = len(frames.weight), len(self.shared.shapes) - 1
        noise = np.broadcast_to(np.asarray(noise, dtype=float), (n_frames,))
        fit = partial(self._minima, frames, noise, covariances, rough)
        every = np.arange(n_frames)
        initial = np.zeros((n_frames, n_components)) if initial is None else initial
        if rough:
            return fit(every, initial, self.rough_steps)
        # First round, block by block
        fits = fit(every, initial, self.first_steps)
        # Second round: the few frames that have not converged, from all blocks
        slow = np.flatnonzero(~fits.converged & np.isfinite(fits.objective))
        if len(slow):
            fits.put(slow, fit(slow, fits.alpha[slow], MAX_STEPS))
        # Further starts for badly fitted frames, all starts at once
        poor = np.flatnonzero(fits.objective > largest_objective(frames.weight, noise))
        if starts is not None and len(starts) and len(poor):
            number = np.repeat(np.arange(len(starts)), len(poor))
            others = fit(np.tile(poor, len(starts)), starts[number], MAX_STEPS)
            # Of equal minima, keep the first.
            objective = others.objective.reshape(len(starts), -1)
            best = np.argmax(objective <= (1 + EQUAL) * objective.min(axis=0), axis=0)
            best = best * len(poor) + np.arange(len(poor))
            gain = fits.objective[poor] - others.objective[best]
            better = gain > EQUAL * fits.objective[poor]
            fits.put(poor[better], others.take(best[better]))
        return fits

    def _minima(
        self,
        frames: FrameTracks,
        noise: NDArray,
        covariances: bool,
        rough: bool,
        chosen: NDArray,
        initial: NDArray,
        max_steps: int,
    ) -> FramePosterior:
        """Return the minima that chosen frames reach from coefficients (n_chosen, K).

        Rough cameras may belong to a higher minimum.
        """
        fits = FramePosterior.unknown(len(chosen), initial.shape[1], covariances)
        length = frames.n_together
        for first in range(0, len(chosen), length):
            block = padded(np.arange(first, min(first + length, len(chosen))))
            products = frame_sums(of_frames(frames, chosen[block]), self.shared)
            if frames.weights is not None:
                determined = determines_camera(products, self.shared.shapes[0])
                if not determined.all():
                    usable = padded(np.flatnonzero(determined))
                    block, products = block[usable], of_frames(products, usable)
            problem = self.problem(products, noise[chosen[block]])
            start = self.evaluate(problem, self.start(problem, initial[block].T))
            position, converged = self.descend(problem, start, max_steps)
            M, alpha, objective = self.solution(
                problem, position, converged, 0 if rough else max_steps
            )
            motion = frames_first(M)
            covariance, turns = fits.covariance[block], fits.turn_covariance[block]
            if covariances:
                spreads = self.covariances(problem, M, alpha)
                covariance, turns = map(frames_first, spreads)
                turns = self.space.T @ turns @ self.space
            minima = FramePosterior(
                motion @ self.space,
                products.positions(motion, alpha.T),
                alpha.T,
                covariance,
                turns,
                np.maximum(objective, 0.0),  # less is rounding errors
                converged,
            )
            fits.put(block, minima)
        return fits

    def problem(self, products: FrameSums, variance: NDArray) -> FrameProblem:
        """Return frames with noise variances (n,) that are not zero."""
        noise = np.maximum(variance, 1e-13 * products.energy)
        return products, np.where(noise > 0, noise, 1.0)

    def start(self, problem: FrameProblem, alpha: NDArray) -> NDArray:
        """Return the start of the search for coefficients (K, n)."""
        raise NotImplementedError

    def evaluate(self, problem: FrameProblem, position: NDArray) -> State:
        """Return the objectives and their derivatives."""
        raise NotImplementedError

    def solution(
        self, problem: FrameProblem, position: NDArray, converged: NDArray, n_steps: int
    ) -> tuple[NDArray, NDArray, NDArray]:
        """Return cameras (2, 3, n), coefficients (K, n) and objectives (n,).

        They are replaced by lower minima that are found in n_steps. `converged` is
        updated.
        """
        raise NotImplementedError

    def covariances(
        self, problem: FrameProblem, M: NDArray, alpha: NDArray
    ) -> tuple[NDArray, NDArray]:
        """Return covariances of coefficients (K, K, n) and rotations (3, 3, n)."""
        raise NotImplementedError

    def descend(
        self,
        problem: FrameProblem,
        state: State,
        max_steps: int,
        known: Minima | None = None,
    ) -> tuple[NDArray, NDArray]:
        """Minimise the objectives; return iterates (..., n) and convergence (n,).

        Gives up a frame that is not expected to end below its known minimum.
        """
        n_frames = len(state.value)
        ends, converged = state.position.copy(), np.zeros(n_frames, dtype=bool)
        running, damping = np.arange(n_frames), np.zeros(n_frames)
        for n_left in range(max_steps, -1, -1):
            # Next step, and convergence test by its predicted decrease. Convergence is
            # quadratic: the step after it would gain far less.
            step, damping = self.step(state, damping)
            gain = np.einsum("pi,pi->i", state.slope, step)
            small = (damping == 0) & (gain <= 1e-12 * scale_of(problem))
            leaving = small | (damping >= LARGEST_DAMPING)
            if known is not None:
                leaving |= _hopeless(state, gain, *known)
            # Remove frames that have ended; converged ones take a last step.
            if leaving.any():
                last = self.model.moved(state.position, np.where(small, step, 0.0))
                ends[..., running[leaving]] = last[..., leaving]
                converged[running[leaving]] = small[leaving]
                if leaving.all():
                    return ends, converged
                left = padded(np.flatnonzero(~leaving))
                problem, state, step, running, damping, known = of_frames(
                    (problem, state, step, running, damping, known), left
                )
            if not n_left:
                break
            # Trial step, refused where the objective rises. Less damping after a good
            # step, more after a refused one.
            trial = self.evaluate(problem, self.model.moved(state.position, step))
            highest = state.value + OF_STEPS * scale_of(problem)
            worse = np.flatnonzero(~(trial.value <= highest))
            eased = np.where(damping > 0.01, 0.1 * damping, 0.0)
            if len(worse):
                eased[worse] = raised(damping[worse])
                for new, old in zip(trial, state, strict=True):
                    new[..., worse] = old[..., worse]
            state, damping = trial, eased
        ends[..., running] = state.position
        return ends, converged

    def step(self, state: State, damping: NDArray) -> tuple[NDArray, NDArray]:
        """Return Newton steps (p, n) and the damping (n,) that makes them definite."""
        matrix, damping = state.hessian, damping.copy()
        if damping.any():
            matrix = matrix + damping * state.definite
        step, positive = solve_positive(matrix, state.slope)
        failing = padded(np.flatnonzero(~positive))
        while len(failing):
            damping[failing] = raised(damping[failing])
            part = of_frames(state, failing)
            matrix = part.hessian + damping[failing] * part.definite
            step[:, failing], positive = solve_positive(matrix, part.slope)
            still = ~positive & (damping[failing] < LARGEST_DAMPING)
            failing = padded(np.unique(failing[still]))
        return self.model.limited(step), damping


def _hopeless(
    state: State, gain: NDArray, known: NDArray, value: NDArray, radius: NDArray
) -> NDArray:
    """Return a mask (n,) of searches that are not expected to end below `Minima`."""
    square = (state.position - known) ** 2
    near = square.sum(axis=tuple(range(square.ndim - 1))) < radius**2
    return near | (state.value - 10.0 * gain > value)


def raised(damping: NDArray) -> NDArray:
    """Return increased damping (n,)."""
    return np.maximum(8.0 * damping, 0.1)
