"""The joint fit as an optimisation problem, and the method that solves it.

Cameras, shapes and noise are moved together by a limited memory quasi-Newton method
(Nocedal, Wright, "Numerical optimization", 2006, section 7.2). Its initial inverse
Hessian is the inverse of the curvature of expectation maximisation at the current
iterate. A step without remembered pairs is thus a generalised step of expectation
maximisation.
"""

from collections import deque
from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import partial
from itertools import chain
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.special import expit

from isa_nrsfm._compat.lazy import cached_property
from isa_nrsfm._frames.camera_models import CAMERAS, CameraModel, line_of_sight
from isa_nrsfm._frames.search import FrameSearch, FrameTracks, frame_sums
from isa_nrsfm._joint.likelihood import EXTENT_WEIGHT, JointFrames, MarginalLikelihood
from isa_nrsfm._joint.prior import ShapePrior
from isa_nrsfm._joint.settings import FitSettings
from isa_nrsfm._linalg import (
    OF_DIFFERENCES,
    OF_SUMS,
    centred,
    frames_first,
    frames_last,
)
from isa_nrsfm._prepare.scaling import ScaledTable
from isa_nrsfm.isa._pipeline import Factorisation

# Lower bound of the noise variance, as a share of the mean square of the tracks. It
# keeps the objective finite for tables without noise.
NOISE_FLOOR = 1e-11

# Least share of the images of a direction that a table determines, if it is relevant:
# docs/benchmarks/README.md, "Thresholds".
RELEVANT = 0.99

# Steps, changes of the gradient, and their inner products.
Memory = deque[tuple[NDArray, NDArray, float]]


class FactorisedTable(NamedTuple):
    """A table that is ready for a fit.

    compressed: its frames with missing points and outliers filled in, by directions, if
    there are many points.
    outliers (I, J): points that a robust loss leaves out at first; None for other
    losses.
    singular_values (3 K + 3,): the largest ones of the completed table, decreasing.
    rest: sum of the squares of the other ones.
    W, parts, factors: matrix of a first sample, growing samples (`sample_frames`), and
    factors of the matrix.
    """

    scaled: ScaledTable
    compressed: JointFrames | None
    outliers: NDArray | None
    singular_values: NDArray
    rest: float
    W: NDArray
    parts: list[NDArray]
    factors: Factorisation

    @property
    def every_point(self) -> bool:
        """Whether all points of all frames count in full."""
        return self.scaled.complete and self.scaled.weights is None

    def rest_share(self, n: int) -> float:
        """Return the share of the energy outside of the n leading singular values."""
        squares = self.singular_values**2
        return float((np.sum(squares[n:]) + self.rest) / (np.sum(squares) + self.rest))

    def noise_level(self, n_components: int) -> float:
        """Return the noise variance of the spectrum as a share of the mean square.

        The mean of the squared singular values beyond 3K + 3 (Tipping, Bishop,
        "Probabilistic principal component analysis", 1999, eq. 8).
        """
        # Mean energy of the dimensions beyond, over that of all seen - 1 dimensions
        seen = float(np.mean(self.scaled.n_seen))
        rank = 3 * n_components + 3
        n_others = seen - 1 - rank
        noise = self.rest_share(rank) * (seen - 1) / n_others if n_others > 0 else 0.0
        # Points that were filled in add to the energy of the table, but have no noise.
        return noise * self.W.shape[1] / seen

    def explained_by(self, n_directions: int, noise: float) -> bool:
        """Return whether directions leave hardly more of the table than some noise.

        False if they would explain any table.
        """
        n_others = np.mean(self.scaled.n_seen) - 1 - (3 * n_directions + 3)
        return n_others > 0 and self.noise_level(n_directions) < 2.0 * noise


class JointState(NamedTuple):
    """Shapes (n_shapes, 3, J), cameras (I, 2, 3) and noise variance of a coordinate."""

    shapes: NDArray
    motion: NDArray
    noise: float

    def depths(self, alpha: NDArray) -> NDArray:
        """Return centred depths (I, J) of frames with coefficients (I, K)."""
        z = np.einsum("ia,kaj->ikj", line_of_sight(self.motion), self.shapes)
        return centred(z[:, 0] + np.einsum("ik,ikj->ij", alpha, z[:, 1:]))


class Widths(NamedTuple):
    """Prior variances of the directions of a shape, as the table determines them.

    variances (D,): v_k of `whole_distribution`. shares (D,): g_k, the shares of the
    numbers of the directions that the table determines. of_images (D,): the same for
    their images. n_numbers: numbers of each.
    """

    variances: NDArray
    shares: NDArray
    of_images: NDArray
    n_numbers: int

    def of_points(self, n_points: int, n_directions: int) -> "Widths":
        """Return the widths of the first directions of some of the points."""
        return Widths._make([*(each[:n_directions] for each in self[:3]), 3 * n_points])

    def padded(self, n_more: int) -> "Widths":
        """Return the widths with further directions, of which nothing is known."""
        variances = np.pad(self.variances, (0, n_more), constant_values=OF_DIFFERENCES)
        shares = [np.pad(each, (0, n_more)) for each in self[1:3]]
        return Widths._make([variances, *shares, self.n_numbers])

    @property
    def n_relevant(self) -> int:
        """Number of directions that the table determines, at least one."""
        return max(int(np.sum(self.of_images > RELEVANT)), 1)

    @property
    def n_determined(self) -> float:
        """Number of coordinates of all shapes that the table determines."""
        return self.n_numbers * (1.0 + float(self.shares.sum()))

    def n_unknowns(self, n_frames: int, camera: str) -> float:
        """Return the number of coordinates that determine cameras and shapes."""
        return (2 + CAMERAS[camera].n_parameters) * n_frames + self.n_determined

    def likelihood(self, frames: JointFrames, camera: str) -> MarginalLikelihood:
        """Return the objective of some frames, without other priors."""
        precisions = np.eye(3) / self.variances[:, None, None]
        unknowns = self.n_unknowns(frames.n_frames, camera)
        return MarginalLikelihood(frames, n_unknowns=unknowns, precisions=precisions)


class JointFit(NamedTuple):
    """Result of the joint refinement.

    history (n_iter + 1,): objective at the start and after each step; it never rises.
    gradient_norm: ``sqrt(g^T D g / N)`` at the end, with the gradient g, the inverse D
    of the approximate Hessian and the number N of coordinates. Its square is about half
    to twice the possible further decrease of the objective per coordinate.
    misfit: the maximum of the noise variance and the mean square residual at the
    posterior means of the coefficients. camera_noise_ratio: noise variance with
    calibrated cameras divided by that with affine ones, for the sample of
    `fit_jointly`. NaN with given starts. prior: with the widths of the fit, if any.
    rivals: `rival_depths` of less evident fits.
    """

    state: JointState
    history: NDArray
    gradient_norm: float
    converged: bool
    misfit: float
    camera_noise_ratio: float = np.nan
    prior: ShapePrior | None = None
    widths: Widths | None = None
    rivals: float = 0.0


@dataclass(frozen=True, eq=False)
class JointProblem:
    """The objective of the joint fit of some frames, and the steps that minimise it.

    thorough: whether many starts are compared, as for small tables.
    penalty: factor of the prior of the basis shapes.
    widths: prior variances of all directions of a shape, in place of the penalty.
    seen_by: camera model, if it is not that of the settings.
    """

    frames: JointFrames
    settings: FitSettings
    thorough: bool = False
    penalty: float = 0.0
    widths: Widths | None = None
    seen_by: CameraModel | None = None

    def part(self, chosen: NDArray, tol: float) -> "JointProblem":
        """Return the problem of a sample of the frames, with another tolerance."""
        frames, settings = self.frames.take(chosen), self.settings._replace(tol=tol)
        return replace(self, frames=frames, settings=settings, thorough=False)

    def with_prior(self, prior: ShapePrior | None) -> "JointProblem":
        """Return the problem with another prior of the shapes."""
        return replace(self, settings=self.settings._replace(shape_prior=prior))

    @property
    def cameras(self) -> CameraModel:
        """The camera model."""
        return self.seen_by or CAMERAS[self.settings.camera]

    @property
    def mean_square(self) -> float:
        """Mean square of the visible coordinates."""
        n_seen, energy = self.frames.totals
        return energy / n_seen

    @cached_property
    def likelihood(self) -> MarginalLikelihood:
        """The objective without the prior of the extents."""
        if self.widths is not None:
            return self.widths.likelihood(self.frames, self.cameras.name)
        prior = self.settings.shape_prior
        return MarginalLikelihood(self.frames, self.penalty, prior=prior)

    @property
    def objective(self) -> MarginalLikelihood:
        """The objective with the prior of the extents, if it is needed."""
        free = self.cameras.name == "affine" or self.settings.shape_prior is not None
        return self.likelihood._replace(extent_weight=0.0 if free else EXTENT_WEIGHT)

    def depths(self, state: JointState) -> NDArray:
        """Return the centred depths (I, J) at the means of the coefficients."""
        alpha = self.likelihood(*state).alpha
        return state._replace(shapes=self.frames.points(state.shapes)).depths(alpha)

    def aligned(self, state: JointState, starts: NDArray | None = None) -> JointState:
        """Return a state with the best cameras of these frames for its centred shapes.

        Shapes would follow frames at a wrong minimum, so frames with large residuals
        start again from each of the coefficients `starts` (n_starts, K).
        """
        shapes, noise = self.frames.centred(state.shapes), state.noise
        search = FrameSearch(shapes, self.cameras)
        fit = partial(search.fit, noise=noise, starts=starts, covariances=False)
        motion = self.frames.blocks.joined(lambda block: fit(block).motion)
        return JointState(shapes, motion, noise)

    def refined(self, state: JointState, **limits: Any) -> JointFit:
        """Refine a state jointly, within the limits of the settings or other ones."""
        settings = self.settings
        options = {
            "least_noise": settings.limits.least_noise,
            "max_iter": settings.max_iter,
            "tol": settings.tol * (0.1 if self.thorough else 1.0),
            "on_step": settings.on_step,
        }
        fit = refine_joint(self.objective, state, self.cameras, **options | limits)
        return fit._replace(widths=self.widths)

    def unreversed(self, state: JointState, **limits: Any) -> JointFit:
        """Refine a state; with calibrated cameras no frame stays reversed in depth."""
        refined: Callable[..., JointFit] = partial(self.refined, **limits)
        calibrated = self.thorough and self.cameras.calibrated
        return self.turned_back(state, refined) if calibrated else refined(state)

    def turned_back(
        self, state: JointState, refined: Callable[[JointState], JointFit]
    ) -> JointFit:
        """Return the fit that is refined until no frame is reversed in depth."""
        fit = refined(state)
        for _ in range(5):
            state, n_reversed = self.reversed_back(fit.state)
            if not n_reversed:
                break
            fit = refined(state)
        return fit

    def reversed_back(self, state: JointState) -> tuple[JointState, int]:
        """Return a state without frames that are reversed in depth, and their number.

        The search for each frame is repeated from its camera reversed in depth. The
        result is used if its objective is lower.
        """
        motion, better = self._searched(FrameSearch.reversed_cameras, state)
        return state._replace(motion=motion), int(better.sum())

    def reversal_errors(self, state: JointState) -> NDArray:
        """Return the squared errors (I,) of the depths by reversals of frames.

        Relative to the mean square of the depths z and those z' at the minimum from the
        reversed camera: ``2 |z - z'|^2 / (|z|^2 + |z'|^2) / (1 + exp(r / 2))``, r the
        rise of -2 log L from the minimum at the given camera.
        """
        motion, alpha, rise = self._searched(FrameSearch.reversals, state)
        z, other = (
            state._replace(motion=motion[:, i]).depths(alpha[:, i]) for i in (0, 1)
        )
        total = np.sum(z**2 + other**2, axis=1)
        square = np.sum((z - other) ** 2, axis=1)
        return 2 * expit(-rise / 2) * square / np.maximum(total, 1e-300)

    def _searched(self, method: Any, state: JointState) -> list[NDArray]:
        """Return the results of a method of the search for all frames."""
        search = FrameSearch(state.shapes, self.cameras)

        def of_block(block: FrameTracks, motion: NDArray) -> list[Any]:
            parts = []
            for frames, piece in block.pieces(len(state.shapes)):
                sums = frame_sums(piece, search.shared)
                problem = search.problem(sums, np.full(len(sums.weight), state.noise))
                parts.append(method(search, problem, motion[frames]))
            return parts

        parts = chain.from_iterable(self.frames.blocks.map(of_block, state.motion))
        return list(map(np.concatenate, zip(*parts, strict=True)))


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
    n_frames, (n_seen, square) = likelihood.frames.n_frames, likelihood.frames.totals
    floor = least_noise * square / n_seen
    start = start._replace(noise=max(start.noise, floor))
    evaluated = partial(_Iterate, likelihood, cameras, floor)
    iterate = evaluated(start)
    # At most 20 pairs, fewer if they would exceed 2^25 numbers, but never less than 3
    n_pairs = 2**25 // (2 * iterate.gradient.size)
    memory: Memory = deque(maxlen=max(min(n_pairs, 20), 3))
    history, small_steps = [iterate.value], 0
    while len(history) <= max_iter and small_steps < 2:
        if on_step is not None:
            on_step()
        # L-BFGS direction, or the preconditioned gradient if L-BFGS does not descend
        direction = -_inverse_hessian_product(iterate, memory)
        if not iterate.gradient @ direction < 0:
            memory.clear()
            direction = -iterate.precondition(iterate.gradient)
        reached, step = _line_search(iterate, direction, evaluated)
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
        rounding = OF_SUMS * square / reached.state.noise
        small_steps = small_steps + 1 if gain < max(tol * n_frames, rounding) else 0
        iterate = reached
        history.append(iterate.value)
    memory.clear()
    slope = iterate.gradient @ iterate.precondition(iterate.gradient)
    norm = float(np.sqrt(max(slope, 0.0) / n_seen))
    converged = small_steps >= 2 and bool(np.isfinite(iterate.value))
    fit = JointFit(iterate.state, np.array(history), norm, converged, iterate.misfit)
    return fit._replace(prior=likelihood.prior)


class _Iterate:
    """A state with the objective, its gradient and its approximate curvature.

    The unknowns as one vector: shapes, parameters of the cameras, log noise variance.
    """

    def __init__(
        self,
        likelihood: MarginalLikelihood,
        cameras: CameraModel,
        floor: float,
        state: JointState,
    ):
        self.cameras, self.floor, self.state = cameras, floor, state
        self.prior = likelihood.prior
        passed = likelihood(*state)
        self.M, noise = frames_last(state.motion), state.noise
        self.n_seen = likelihood.frames.totals[0]
        self.value = passed.value
        self.misfit = max(noise, passed.residual / self.n_seen)
        at_floor = noise <= floor * (1 + 1e-6)
        # At its lower bound the noise variance may only rise.
        by_noise = min(passed.noise_gradient, 0.0 if at_floor else np.inf)
        by_cameras = cameras.gradient(self.M, passed.motion_gradient)
        self.gradient = _stacked(passed.shape_gradient, by_cameras, by_noise)
        self.curvature = passed.shape_curvature, passed.motion_curvature

    @cached_property
    def metric(self) -> tuple[NDArray, NDArray]:
        """Inverses of the curvatures of the shapes and of the cameras."""
        by_shapes, by_cameras = self.curvature
        inverse = self.cameras.inverse_curvature(self.M, by_cameras)
        if self.prior is None:
            return np.linalg.inv(regular(by_shapes)), inverse
        return self.prior.inverse(by_shapes, self.state.noise), inverse

    def precondition(self, vector: NDArray) -> NDArray:
        """Return a vector times the inverse of the approximate Hessian.

        The Hessian is block diagonal: ``2 / s2`` times the curvatures of shapes and
        cameras, and N for ``log s2``.
        """
        half = self.state.noise / 2
        shapes, steps, noise = self.split(vector)
        by_shapes, by_cameras = self.metric
        if self.prior is not None:
            shapes = self.prior.projected(shapes)
        stacked = shapes.reshape(-1, shapes.shape[-1])
        if len(by_shapes) == 1:
            stacked = by_shapes[0] @ stacked
        else:
            stacked = (by_shapes @ stacked.T[:, :, None])[:, :, 0].T
        if self.prior is not None:
            stacked = self.prior.projected(stacked.reshape(shapes.shape))
        rows = steps.reshape(len(steps) // len(by_cameras), *by_cameras.shape[1:])
        steps = np.einsum("abn,rbn->ran", by_cameras, rows)
        return _stacked(half * stacked, half * steps, noise / self.n_seen)

    def split(self, vector: NDArray) -> tuple[NDArray, NDArray, float]:
        """Return shapes (n, 3, J), parameters of cameras (p, I), and log noise."""
        shapes, motion, _ = self.state
        steps = vector[shapes.size : -1].reshape(self.cameras.n_parameters, len(motion))
        return vector[: shapes.size].reshape(shapes.shape), steps, vector[-1]

    def moved(self, step: NDArray) -> JointState:
        """Return the state after a step; the noise variance is at least floor."""
        shapes, steps, noise = self.split(step)
        motion = frames_first(self.cameras.moved(self.M, steps))
        noise = max(self.state.noise * np.exp(noise), self.floor)
        return JointState(self.state.shapes + shapes, motion, noise)


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
    for step, change, curvature in memory:
        vector += (weights.pop() - change @ vector / curvature) * step
    return vector


def _line_search(
    iterate: _Iterate, direction: NDArray, evaluated: Callable[[JointState], _Iterate]
) -> tuple[_Iterate | None, NDArray]:
    """Return the first iterate that meets the Armijo condition, or None, and step."""
    slope = iterate.gradient @ direction
    # Largest step length that the parametrisation of noise and cameras allows
    of_noise = 1.5 / max(abs(direction[-1]), 1e-300)
    of_cameras = iterate.cameras.largest_length(iterate.split(direction)[1])
    length = min(1.0, of_noise, of_cameras)
    while length > 1e-8:
        step = length * direction
        reached = evaluated(iterate.moved(step))
        if reached.value <= iterate.value + 1e-4 * length * slope:
            # The lower bound may have shortened the change of the noise.
            step[-1] = np.log(reached.state.noise / iterate.state.noise)
            return reached, step
        # Backtracking by quadratic interpolation of both values and the slope
        excess = reached.value - iterate.value - length * slope
        length *= min(max(-length * slope / (2 * excess), 0.1), 0.5)
    return None, direction
