"""The joint fit: from the paper's result to the shapes of greatest likelihood.

1. Calibrated cameras to start from (`starts`), the choice of them by the objective.
2. The fit of calibrated cameras, shapes and noise, from the best starts. While the
   model may be wrong the noise has a floor: what a few basis shapes leave of an object
   is not noise, and would be explained by depths and cameras that are not there.
3. For affine cameras, the same with cameras that are free, from there or from the
   paper's result, whichever leads to the lower objective.
4. A model that leaves no more than any table of its rank is right: floor and prior are
   left away.

Large tables take the first steps on a sample, and the last ones on all frames.
"""

from collections.abc import Callable, Iterable
from functools import partial
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from isa_nrsfm._compat.scikit_learn import one_blas_thread
from isa_nrsfm._frames.camera_models import CAMERAS, CameraModel
from isa_nrsfm._joint.frames import JointFrames
from isa_nrsfm._joint.many_points import (
    has_many_points,
    in_all_points,
    leading_directions,
)
from isa_nrsfm._joint.problem import BASIS_STD, LEAST_NOISE, JointProblem, Steps
from isa_nrsfm._joint.quasi_newton import NOISE_FLOOR, JointResult, JointState
from isa_nrsfm._joint.relevance import relevant_components
from isa_nrsfm._joint.reweighting import reweighted
from isa_nrsfm._joint.starts import affine_start, best_starts, settled, with_prior
from isa_nrsfm._paper.factors import Factorisation
from isa_nrsfm._paper.sample import Sample
from isa_nrsfm._prepare.robust import ROUNDING
from isa_nrsfm._tables.blocks import FrameBlocks
from isa_nrsfm._tables.visibility import seen_points

# The steps on a sample end at this share of what its shapes explain by chance alone, a
# unit of the objective for each number, if it is above the tolerance.
BY_CHANCE = 0.03
# Tables of few frames are refined to this share of the tolerance, and to its square
# where the model is right: it costs little.
POLISH = 0.1
FEW_FRAMES = 2000
# A model is right if its noise is at most so many times that of the table's spectrum.
# Artificial tables with the true K or more have 0.8 to 1.0, with fewer 1.3 to 1.8;
# motion capture and cloth, where K cuts a full spectrum off, 1.9 and more (``python -m
# benchmarks.accuracy noise``). Without others than 3K + 3 singular values the noise has
# to be below the second number, a share of the mean square, as in tables without noise.
RIGHT = 1.4
EXACT = 1e-10
# Noise within this share of the least counts as that.
SLACK = 1e-3
# Steps without floor and prior, as long as they lower the noise to this share of it.
RELEASED_STEPS = 60
FALLING = 0.95
# Noise variance for what K basis shapes leave of a table that has more, per share of
# the energy beyond K + 3 singular values (``python -m benchmarks.accuracy noise``).
# It is at most the second number: the spectrum is that of motion that is large, too.
CUT_OFF = 3.0
MOST_NOISE = 5e-4
# Rounds in which frames that are reversed in depth are turned.
REVERSALS = 5
# Steps of the fit that is only compared, and of those of a sample among which one is
# chosen.
COMPARED_STEPS = 60
RACE_STEPS = 5


class Spectrum(NamedTuple):
    """
    What the singular values of a table say of a model with K basis shapes.

    Attributes
    ----------
    noise : float
        Noise variance, a share of the mean square, if the table without noise has the
        rank 3K + 3: the mean of the other squared singular values (Tipping, Bishop,
        "Probabilistic principal component analysis", 1999, eq. 8). Zero where there
        are no others.
    missing : float
        Share of the energy beyond the K + 3 largest singular values. Of motion capture
        that is about what the best K basis shapes leave of the shapes: each takes at
        least one direction of the row space.
    """

    noise: float
    missing: float

    @classmethod
    def from_singular_values(
        cls,
        values: NDArray,
        rest_share: float,
        n_components: int,
        n_points: int,
        n_seen: NDArray,
    ) -> "Spectrum":
        """
        Return what the 3K + 3 largest singular values and the rest say.

        Parameters
        ----------
        values : ndarray
            The largest singular values, 3K + 3 or as many as there are.
        rest_share : float
            Share of the energy beyond them.
        n_components : int
            K.
        n_points : int
            Number of points.
        n_seen : ndarray of int, shape (n_frames,)
            How many points each frame shows; the others were filled in.

        Returns
        -------
        Spectrum
            Of the table.
        """
        seen = float(np.mean(n_seen))
        n_others = seen - 1 - (3 * n_components + 3)
        noise = rest_share * (seen - 1) / n_others if n_others > 0 else 0.0
        noise *= n_points / seen
        energy = np.sum(values**2)
        beyond = np.sum(values[n_components + 3 :] ** 2) / (energy or 1.0)
        return cls(noise, float(rest_share + (1 - rest_share) * beyond))


class JointFit(NamedTuple):
    """
    Result of the joint fit of a table.

    Attributes
    ----------
    shapes : ndarray of shape (n_components + 1, 3, n_points)
        B_0, ..., B_K, centred, in coordinates in which alpha is drawn from N(0, I).
    alpha : ndarray of shape (n_chosen, n_components)
        Means of the coefficients in these coordinates, of the frames of the sample.
    noise_variance : float
        Variance of the noise of a coordinate, for the degrees of freedom that cameras
        and shapes leave.
    camera_noise_ratio : float
        Noise variance with calibrated cameras, divided by that with affine ones, of
        the frames of the sample.
    history : ndarray of shape (n_iter + 1,)
        The objective at the start and after each step, of the last refinement.
    gradient_norm : float
        As in `JointResult`.
    converged : bool
        Whether the refinement has converged.
    frames : JointFrames
        The frames as they were fitted in the end.
    """

    shapes: NDArray
    alpha: NDArray
    noise_variance: float
    camera_noise_ratio: float
    history: NDArray
    gradient_norm: float
    converged: bool
    frames: JointFrames


# The products are of small blocks: more threads would wait for each other.
@one_blas_thread
def fit_jointly(
    rows: FrameBlocks,
    n_seen: NDArray,
    sample: Sample,
    factors: Factorisation,
    paper_shapes: NDArray,
    *,
    spectrum: Spectrum,
    camera: str,
    outliers: NDArray | None = None,
    loss: str,
    max_iter: int,
    tol: float,
    on_step: Callable[[], None] | None = None,
) -> JointFit:
    """
    Start and run the joint fit.

    Parameters
    ----------
    rows : FrameBlocks
        Blocks of frames (n_frames, 2, n_points), centred and each divided by its size;
        NaN where a point is missing.
    n_seen : ndarray of int, shape (n_frames,)
        Number of points that each frame shows.
    sample : Sample
        The frames that the first steps are made on.
    factors : Factorisation
        Of their measurement matrix.
    paper_shapes : ndarray of shape (n_components + 1, 3, n_points)
        Mean shape and basis shapes of the paper's pipeline.
    spectrum : Spectrum
        What the singular values of the table say of its noise.
    camera : {"affine", "weak_perspective", "orthographic"}
        What cameras may be.
    outliers : ndarray of bool, shape (n_frames, n_points), optional
        Points that are left out at first and that a robust loss takes in again; to be
        given with such a loss.
    loss : {"linear", "huber", "cauchy"}
        How points count that are far from the model.
    max_iter : int
        The most steps.
    tol, on_step
        As in `refine_joint`.

    Returns
    -------
    JointFit
        The fit.
    """
    n_shapes, _, n_points = paper_shapes.shape
    steps = Steps(max_iter, tol, on_step)
    ready = _ready(rows, n_seen, sample, factors, paper_shapes, outliers, loss, steps)
    first, problem, cameras = ready.problems[0], ready.problems[-1], CAMERAS[camera]
    result, ratio, start = _first_fit(first, sample, factors, paper_shapes, camera)
    result, least_noise, right = judged(first, result, start, cameras, spectrum)
    refined = partial(_refined, cameras=cameras, least_noise=least_noise)
    problems = ready.problems
    if right:
        problems = [each.with_penalty(0.0) for each in problems]
        problem = problems[-1]
    if right and not sample.parts:  # to the end, now that it is safe
        tol = POLISH**2 * problem.steps.tol
        result = refined(problem, result.state, tol=tol)
    for larger in problems[1:]:
        result = refined(larger, larger.aligned(result.state, camera))
    if ready.wide:
        result, problem = in_all_points(result, problem, rows, refined)
    noise, n_fitted = result.state.noise, 0
    if ready.used is not None:
        # The scale of the noise is that of the residual with the coefficients fitted.
        result, noise = reweighted(problem, rows, ready.used, result, loss, refined)
        n_fitted = n_shapes - 1
    shapes = problem.frames.points(result.state.shapes)
    state = result.state._replace(shapes=first.frames.coordinates(shapes))
    if sample.parts:
        state = state._replace(motion=state.motion[:, :, sample.parts[0]])
    unknowns = (2 + cameras.n_parameters, n_fitted)
    noise *= _freedom_correction(n_seen, n_points, n_shapes, *unknowns)
    return JointFit(
        shapes - shapes.mean(axis=2, keepdims=True),
        first.coefficients(state),
        max(noise, ROUNDING**2),
        ratio,
        result.history,
        result.gradient_norm,
        result.converged,
        problem.frames,
    )


@one_blas_thread
def count_components(
    rows: FrameBlocks,
    n_seen: NDArray,
    sample: Sample,
    factors: Factorisation,
    paper_shapes: NDArray,
    *,
    camera: str,
    outliers: NDArray | None = None,
    loss: str,
    max_iter: int,
    tol: float,
) -> int:
    """
    Return the number of basis shapes that a table supports.

    Parameters
    ----------
    rows, n_seen, sample, factors, paper_shapes
        As of `fit_jointly`, with more basis shapes than are expected.
    camera, outliers, loss, max_iter, tol
        As of `fit_jointly`.

    Returns
    -------
    int
        The number, at least one: the basis shapes of a fit of the sample that are
        relevant.
    """
    steps = Steps(max_iter, tol)
    ready = _ready(rows, n_seen, sample, factors, paper_shapes, outliers, loss, steps)
    first = ready.problems[0]
    result, *_ = _first_fit(first, sample, factors, paper_shapes, camera)
    return max(relevant_components(first, result.state, CAMERAS[camera]), 1)


class _Ready(NamedTuple):
    """A table that is ready for the joint fit."""

    problems: list[JointProblem]  # of the samples and of all frames
    wide: bool  # whether frames are given by directions
    used: NDArray | None  # points that count at first, with a robust loss


def _ready(
    rows: FrameBlocks,
    n_seen: NDArray,
    sample: Sample,
    factors: Factorisation,
    paper_shapes: NDArray,
    outliers: NDArray | None,
    loss: str,
    steps: Steps,
) -> _Ready:
    """Return a table ready for the joint fit."""
    n_shapes, _, n_points = paper_shapes.shape
    n_frames = len(n_seen)
    complete = bool((n_seen == n_points).all())
    wide = complete and loss == "linear" and has_many_points(n_points, n_shapes)
    used = None
    if wide:
        frames = JointFrames.from_directions(rows, leading_directions(factors))
    elif loss == "linear":
        frames = JointFrames.from_points(rows, complete)
    else:
        used = seen_points(rows.whole().transpose(0, 2, 1))
        if outliers is not None:
            used &= ~outliers
        weights = None if used.all() else used * 1.0
        frames = JointFrames.from_points(rows, complete, weights)
    steps = steps._replace(to_the_end=n_frames <= FEW_FRAMES)
    problem = JointProblem(frames, steps, 0.0)
    n_numbers, energy = problem.totals
    problem = problem.with_penalty(n_numbers / (BASIS_STD**2 * energy * n_frames))
    by_chance = BY_CHANCE * frames.coordinates(paper_shapes).size
    problems = [
        problem.part(part, tol=max(steps.tol, by_chance / len(part)), to_the_end=False)
        for part in sample.parts
    ]
    return _Ready([*problems, problem], wide, used)


def _first_fit(
    problem: JointProblem,
    sample: Sample,
    factors: Factorisation,
    paper_shapes: NDArray,
    camera: str,
) -> tuple[JointResult, float, JointState]:
    """Return the fit of the sample, the ratio of noises of `JointFit`, and a start."""
    calibrated = CAMERAS["weak_perspective" if camera == "affine" else camera]
    starts = best_starts(problem, sample.W, factors, paper_shapes, calibrated)
    result = _least(_calibrated_fit(problem, state, calibrated) for state in starts)
    # Free cameras, from there and from the paper's result: the fit itself, or only to
    # be compared.
    rigid = affine_start(problem, sample.W, paper_shapes)
    states = [
        problem.aligned(result.state, "affine"),
        settled(problem, rigid, CAMERAS["affine"]),
    ]
    refined = partial(_refined, problem, cameras=CAMERAS["affine"])
    max_iter = problem.steps.max_iter
    if camera != "affine":
        max_iter = min(max_iter, COMPARED_STEPS)
    if not problem.steps.to_the_end:
        first = _least(refined(s, max_iter=min(max_iter, RACE_STEPS)) for s in states)
        states = [first.state]
    free = _least(refined(state, max_iter=max_iter) for state in states)
    ratio = result.left / min(free.left, result.left)
    if camera == "affine":
        return free, ratio, rigid
    return result, ratio, starts[0]


def _least(results: Iterable[JointResult]) -> JointResult:
    """Return the refinement of the least objective."""
    return min(results, key=lambda result: result.history[-1])


def _calibrated_fit(
    problem: JointProblem,
    state: JointState,
    cameras: CameraModel,
    least_noise: float = LEAST_NOISE,
) -> JointResult:
    """Return the fit of calibrated cameras in which no frame is reversed in depth."""
    result = _refined(problem, state, cameras, least_noise)
    # What is found of a sample is only a start.
    for _ in range(REVERSALS if problem.steps.to_the_end else 0):
        state, n_reversed = problem.reversed_back(result.state, cameras)
        if not n_reversed:
            break
        result = _refined(problem, state, cameras, least_noise)
    return result


def _refined(
    problem: JointProblem,
    state: JointState,
    cameras: CameraModel,
    least_noise: float = LEAST_NOISE,
    **steps: Any,
) -> JointResult:
    """Return a refinement of all frames of a problem."""
    if problem.steps.to_the_end:
        steps = {"tol": problem.steps.tol * POLISH, **steps}
    return problem.refined(state, cameras, least_noise, **steps)


def judged(
    problem: JointProblem,
    result: JointResult,
    start: JointState,
    cameras: CameraModel,
    spectrum: Spectrum,
) -> tuple[JointResult, float, bool]:
    """
    Return the fit of a sample for what its model is: right, or with shapes missing.

    A model is right if it leaves no more than any table of its rank does. Then what is
    left is noise, however little, and greatest likelihood needs neither a floor of the
    noise nor a prior of the basis shapes. If a model that is not right leaves less than
    the floor, something else takes the place of the basis shapes that are missing:
    calibrated cameras are told how much these would explain. Deformations below the
    floor vanish there: they are looked for from the start.

    The least noise and whether the model is right are returned, too.
    """
    n_seen, energy = problem.totals
    mean_square = energy / n_seen
    right = max(RIGHT * spectrum.noise, EXACT) * mean_square
    at_floor = result.state.noise < (1 + SLACK) * LEAST_NOISE * mean_square
    if at_floor or result.state.noise < right:
        for state in (result.state, start):
            free = unregularised(problem, state, cameras)
            if free.state.noise < right:
                return free, NOISE_FLOOR, True
    least_noise = LEAST_NOISE
    if at_floor and cameras.calibrated and spectrum.noise > 0:
        least_noise = np.clip(CUT_OFF * spectrum.missing, LEAST_NOISE, MOST_NOISE)
        result = _calibrated_fit(problem, result.state, cameras, least_noise)
    return result, least_noise, False


def unregularised(
    problem: JointProblem, state: JointState, cameras: CameraModel
) -> JointResult:
    """Return the fit without prior and floor, as long as the noise falls."""
    problem = problem.with_penalty(0.0)
    state = with_prior(problem, state)
    steps = min(RELEASED_STEPS, problem.steps.max_iter)
    for _ in range(problem.steps.max_iter // steps):
        before = state.noise
        result = _refined(problem, state, cameras, NOISE_FLOOR, max_iter=steps)
        state = result.state
        if state.noise > FALLING * before:
            break
        if cameras.calibrated:
            state, _ = problem.reversed_back(state, cameras)
    return result


def _freedom_correction(
    n_seen: NDArray, n_points: int, n_shapes: int, n_pose: int, n_fitted: int
) -> float:
    """
    Return numbers seen divided by the degrees of freedom of the residual.

    Each frame has the unknowns of a camera and a position; the shapes have three each a
    point, but for the affinity and the mixing. Coefficients that have been integrated
    out take none, those that are fitted to a frame take one each. At least a tenth of
    the numbers counts as free.
    """
    n_frames, n_numbers = len(n_seen), 2.0 * n_seen.sum()
    unknowns = (
        (n_pose + n_fitted) * n_frames + 3 * n_shapes * (n_points - 1) - n_shapes**2 - 8
    )
    return float(n_numbers / max(n_numbers - unknowns, 0.1 * n_numbers))
