"""The joint fit: from the paper's result to the shapes of greatest likelihood.

1. Starts with calibrated cameras (`starts`). The objective chooses the best of them.
2. The fit of calibrated cameras, shapes and noise from these. While the model may be
   wrong the noise variance has a floor: deformation that the basis shapes do not span
   is not noise, and the fit would explain it by wrong depths and cameras.
3. The fit of affine cameras, from the result of 2 and from the paper's result. The
   lower objective counts. For calibrated cameras it serves for comparison only.
4. The judgement of the model. It is right if it leaves no more than the noise that the
   spectrum tells. Then floor and prior are left out.

Large tables take the first steps on a sample, and the last ones on all frames.
"""

from collections.abc import Callable, Iterable, Sequence
from functools import partial
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from isa_nrsfm._frames.camera_models import CAMERAS, CameraModel
from isa_nrsfm._joint.frames import JointFrames, WeightedRows
from isa_nrsfm._joint.many_points import (
    has_many_points,
    in_all_points,
    leading_directions,
)
from isa_nrsfm._joint.options import JOINT_OPTIONS, JointOptions
from isa_nrsfm._joint.problem import JointProblem, Steps
from isa_nrsfm._joint.quasi_newton import JointResult, JointState
from isa_nrsfm._joint.relevance import relevant_components
from isa_nrsfm._joint.reweighting import reweighted
from isa_nrsfm._joint.starts import affine_start, best_starts, settled, with_prior
from isa_nrsfm._linalg.rounding import OF_DISTANCES
from isa_nrsfm._paper.factors import Factorisation
from isa_nrsfm._paper.sample import Sample
from isa_nrsfm._tables.blocks import FrameBlocks


class Spectrum(NamedTuple):
    """
    What the singular values of a table say of a model with K basis shapes.

    Attributes
    ----------
    noise : float
        Maximum likelihood estimate of the noise variance if the table without noise has
        the rank 3K + 3, as a share of the mean square: the mean of the squared singular
        values beyond (Tipping, Bishop, "Probabilistic principal component analysis",
        1999, eq. 8). Zero if there are none.
    missing : float
        Share of the energy beyond the K + 3 largest singular values. Each basis shape
        takes at least one direction of the row space. For motion capture this is about
        the share of the shapes that the best K basis shapes leave.
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
        Return the spectrum for the 3K + 3 largest singular values and the rest.

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
        # Mean energy of the dimensions beyond, over that of all seen - 1 dimensions
        seen = float(np.mean(n_seen))
        n_others = seen - 1 - (3 * n_components + 3)
        noise = rest_share * (seen - 1) / n_others if n_others > 0 else 0.0
        # Points that were filled in add to the energy of the table, but have no noise.
        noise *= n_points / seen
        energy = np.sum(values**2)
        beyond = np.sum(values[n_components + 3 :] ** 2) / (energy or 1.0)
        return cls(noise, float(rest_share + (1 - rest_share) * beyond))


class Start(NamedTuple):
    """
    Shapes and noise from which a joint fit may start, of a similar table.

    Attributes
    ----------
    shapes : ndarray of shape (n_components + 1, 3, n_points)
        Mean shape, and basis shapes as long as the standard deviation of their
        coefficients.
    noise_variance : float
        Variance of the noise of a coordinate.
    calibrated_first : bool
        Whether affine cameras are preceded by calibrated ones, as they are in the
        search for starts. Has no meaning for calibrated cameras.
    """

    shapes: NDArray
    noise_variance: float
    calibrated_first: bool = False


class JointFit(NamedTuple):
    """
    Result of the joint fit of a table.

    Attributes
    ----------
    shapes : ndarray of shape (n_components + 1, 3, n_points)
        B_0, ..., B_K, centred, scaled and mixed such that alpha ~ N(0, I).
    alpha : ndarray of shape (n_chosen, n_components)
        Posterior means of the coefficients of the frames of the sample.
    noise_variance : float
        Variance of the noise of a coordinate, corrected for the degrees of freedom that
        cameras and shapes take.
    camera_noise_ratio : float
        Noise variance with calibrated cameras divided by that with affine ones, for the
        frames of the sample.
    history : ndarray of shape (n_iter + 1,)
        The objective at the start and after each step of the last refinement.
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


def fit_jointly(
    rows: FrameBlocks,
    completed: FrameBlocks,
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
    starts: Sequence[Start] = (),
    options: JointOptions = JOINT_OPTIONS,
) -> JointFit:
    """
    Run the joint fit: starts, fit of the sample, judgement, fit of all frames.

    Parameters
    ----------
    rows : FrameBlocks
        Blocks of frames (n_frames, 2, n_points), centred and each divided by its size;
        NaN where a point is missing.
    completed : FrameBlocks
        The same frames with missing points, and outliers, filled in.
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
        Points that a robust loss leaves out at first. Its weights decide later how much
        they count. To be given with such a loss.
    loss : {"linear", "huber", "cauchy"}
        How points count that are far from the model.
    max_iter : int
        Largest number of steps.
    tol, on_step
        As in `refine_joint`.
    starts : sequence of Start, default=()
        Where the fit starts, instead of `paper_shapes` and the search for starts.
    options : JointOptions
        The limits of all stages.

    Returns
    -------
    JointFit
        The fit. With `starts` its `camera_noise_ratio` is NaN.
    """
    n_shapes, _, n_points = paper_shapes.shape
    steps = Steps(max_iter, tol, on_step)
    table = rows, completed, n_seen, sample, factors, paper_shapes
    ready = _ready(*table, outliers, loss, steps, options)
    first, problem, cameras = ready.problems[0], ready.problems[-1], CAMERAS[camera]
    # Fit of the sample (of all frames if it is the table), and judgement of the model
    if starts:
        result, ratio, start = _continued_fit(first, starts, camera)
    else:
        result, ratio, start = _first_fit(first, sample, factors, paper_shapes, camera)
    result, least_noise, right = judged(first, result, start, cameras, spectrum)
    refined = partial(_refined, cameras=cameras, least_noise=least_noise)
    problems = ready.problems
    if right:
        problems = [each.with_penalty(0.0) for each in problems]
        problem = problems[-1]
    # For a right model it is safe to go on to a smaller tolerance.
    if right and not sample.parts:
        tol = options.judgement.polish * problem.steps.tol
        result = refined(problem, result.state, tol=tol)
    # Fits of larger samples, and of all frames
    for larger in problems[1:]:
        result = refined(larger, larger.aligned(result.state, camera))
    # Further directions, then the points that are seen, and robust weights
    if ready.wide:
        result, problem = in_all_points(result, problem, completed, refined)
    if ready.seen is not None:
        shapes = problem.frames.points(result.state.shapes)
        problem = problem.with_frames(ready.seen)
        result = refined(problem, result.state._replace(shapes=shapes))
    noise, n_pose = result.state.noise, 2 + cameras.n_parameters
    if ready.left_out is not None:
        weighted = partial(reweighted, cameras=cameras, refined=refined)
        # This noise variance is corrected for the unknowns of the frames already.
        result, noise = weighted(problem, rows, ready.left_out, result, loss)
        n_pose = 0
    shapes = problem.frames.points(result.state.shapes)
    # Coefficients of the sample, and degrees of freedom of the noise
    state = result.state._replace(shapes=first.frames.coordinates(shapes))
    if sample.parts:
        state = state._replace(motion=state.motion[sample.parts[0]])
    noise *= _freedom_correction(n_seen, n_points, n_shapes, n_pose)
    return JointFit(
        shapes - shapes.mean(axis=2, keepdims=True),
        first.coefficients(state),
        max(noise, OF_DISTANCES**2),
        ratio,
        result.history,
        result.gradient_norm,
        result.converged,
        problem.frames,
    )


def count_components(
    rows: FrameBlocks,
    completed: FrameBlocks,
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
    options: JointOptions = JOINT_OPTIONS,
) -> int:
    """
    Return the number of basis shapes that a table supports.

    Parameters
    ----------
    rows, completed, n_seen, sample, factors, paper_shapes
        As of `fit_jointly`, with more basis shapes than are expected.
    camera, outliers, loss, max_iter, tol, options
        As of `fit_jointly`.

    Returns
    -------
    int
        The number, at least one: the basis shapes of a fit of the sample that are
        relevant.
    """
    steps = Steps(max_iter, tol)
    table = rows, completed, n_seen, sample, factors, paper_shapes
    ready = _ready(*table, outliers, loss, steps, options)
    first = ready.problems[0]
    result, *_ = _first_fit(first, sample, factors, paper_shapes, camera)
    return max(relevant_components(first, result.state, CAMERAS[camera]), 1)


class _Ready(NamedTuple):
    """A table that is ready for the joint fit."""

    problems: list[JointProblem]  # of larger and larger samples, and of all frames
    wide: bool  # whether they are of completed frames, given by directions
    seen: JointFrames | None  # if they do not tell all, frames by seen points
    left_out: NDArray | None  # (n_frames, n_points), outliers; robust losses only


def _ready(
    rows: FrameBlocks,
    completed: FrameBlocks,
    n_seen: NDArray,
    sample: Sample,
    factors: Factorisation,
    paper_shapes: NDArray,
    outliers: NDArray | None,
    loss: str,
    steps: Steps,
    options: JointOptions,
) -> _Ready:
    """Return a table ready for the joint fit."""
    n_shapes, _, n_points = paper_shapes.shape
    n_frames = len(n_seen)
    complete = bool((n_seen == n_points).all())
    left_out = None
    if loss != "linear":
        none = np.zeros((n_frames, n_points), dtype=bool)
        left_out = none if outliers is None else outliers
    # Many points: completed frames, given by directions, before those that are seen
    wide, seen = has_many_points(n_points, n_shapes, options.many_points), None
    if wide:
        frames = JointFrames.from_directions(completed, leading_directions(factors))
        if not complete or left_out is not None:
            seen = _seen_frames(rows, complete, left_out)
    else:
        frames = _seen_frames(rows, complete, left_out)
    small = n_frames <= options.few_frames
    steps = steps._replace(effort=options.small if small else options.large)
    problem = JointProblem(frames, steps, 0.0, options)
    # Penalty of sum_i ||M_i B_k||^2 for the prior of basis shapes in frames of mean
    # square energy / n_numbers. The prior counts once, not for each frame.
    n_numbers, energy = problem.totals
    variance = options.basis_std**2 * energy
    problem = problem.with_penalty(n_numbers / (variance * n_frames))
    by_chance = options.by_chance * frames.coordinates(paper_shapes).size
    problems = [
        problem.part(
            part, tol=max(steps.tol, by_chance / len(part)), effort=options.large
        )
        for part in sample.parts
    ]
    return _Ready([*problems, problem], wide, seen, left_out)


def _seen_frames(
    rows: FrameBlocks, complete: bool, left_out: NDArray | None
) -> JointFrames:
    """Return frames given by the points that are seen and not left out."""
    if left_out is None or not left_out.any():
        return JointFrames.from_points(rows, complete)
    return JointFrames.from_weighted(rows.derive(WeightedRows.without, left_out))


def _first_fit(
    problem: JointProblem,
    sample: Sample,
    factors: Factorisation,
    paper_shapes: NDArray,
    camera: str,
) -> tuple[JointResult, float, JointState]:
    """
    Return the fit of the sample, its `camera_noise_ratio`, and one of its starts.

    A calibrated and an affine fit are made in any case: the ratio needs both.
    """
    # Calibrated cameras, from the best starts
    calibrated = CAMERAS["weak_perspective" if camera == "affine" else camera]
    starts = best_starts(problem, sample.W, factors, paper_shapes, calibrated)
    result = _least(_calibrated_fit(problem, state, calibrated) for state in starts)
    # Affine cameras, from the calibrated fit and from the paper's result
    rigid = affine_start(problem, sample.W, paper_shapes)
    states = [
        problem.aligned(result.state, "affine"),
        settled(problem, rigid, CAMERAS["affine"]),
    ]
    refined = partial(_refined, problem, cameras=CAMERAS["affine"])
    max_iter = problem.steps.max_iter
    if camera != "affine":
        max_iter = min(max_iter, problem.options.compared_steps)
    race_steps = problem.steps.effort.race_steps
    if race_steps is not None:  # only the better one goes on
        first = _least(refined(s, max_iter=min(max_iter, race_steps)) for s in states)
        states = [first.state]
    affine = _least(refined(state, max_iter=max_iter) for state in states)
    ratio = result.left / min(affine.left, result.left)
    if camera == "affine":
        return affine, ratio, rigid
    return result, ratio, starts[0]


def _continued_fit(
    problem: JointProblem, starts: Sequence[Start], camera: str
) -> tuple[JointResult, float, JointState]:
    """
    Return the fit from the best of given starts, NaN, and that start.

    The first start is fitted. Each other one goes on only if it can catch up: it may
    not lack more, after some steps, than the second half of them gained. The second
    number would be the `camera_noise_ratio`, which needs both camera models.
    """
    cameras = CAMERAS[camera]
    n_steps = min(problem.options.starts.catching_up, problem.steps.max_iter)
    fitted = _calibrated_fit if cameras.calibrated else _refined
    fits: list[tuple[JointResult, float, JointState]] = []
    for start in starts:
        state = given = _aligned_start(problem, start, camera)
        if fits:
            tried = _refined(problem, state, cameras, max_iter=n_steps)
            history = tried.history
            gained = history[len(history) // 2] - history[-1]
            least = min(result.history[-1] for result, *_ in fits)
            if history[-1] - least > gained:
                continue
            state = tried.state
        fits.append((fitted(problem, state, cameras), np.nan, given))
    return min(fits, key=lambda found: found[0].history[-1])


def _aligned_start(problem: JointProblem, start: Start, camera: str) -> JointState:
    """Return a given start with cameras, preceded by calibrated ones if it says so."""
    shapes = problem.frames.coordinates(start.shapes)
    state = JointState(shapes, np.empty((0, 2, 3)), start.noise_variance)
    if start.calibrated_first and not CAMERAS[camera].calibrated:
        # As many steps as starts of the search make
        max_iter = min(problem.options.starts.freed_steps, problem.steps.max_iter)
        calibrated = "weak_perspective"
        state = problem.aligned(state, calibrated)
        state = problem.refined(state, CAMERAS[calibrated], max_iter=max_iter).state
    return problem.aligned(state, camera)


def _least(results: Iterable[JointResult]) -> JointResult:
    """Return the refinement with the lowest objective at its end."""
    return min(results, key=lambda result: result.history[-1])


def _calibrated_fit(
    problem: JointProblem,
    state: JointState,
    cameras: CameraModel,
    least_noise: float | None = None,
) -> JointResult:
    """Return the fit of calibrated cameras in which no frame is reversed in depth."""
    result = _refined(problem, state, cameras, least_noise)
    for _ in range(problem.steps.effort.reversals):
        state, n_reversed = problem.reversed_back(result.state, cameras)
        if not n_reversed:
            break
        result = _refined(problem, state, cameras, least_noise)
    return result


def _refined(
    problem: JointProblem,
    state: JointState,
    cameras: CameraModel,
    least_noise: float | None = None,
    **steps: Any,
) -> JointResult:
    """Return the refinement of a state, with a smaller tolerance for small tables."""
    steps = {"tol": problem.steps.tol * problem.steps.effort.polish, **steps}
    return problem.refined(state, cameras, least_noise, **steps)


def judged(
    problem: JointProblem,
    result: JointResult,
    start: JointState,
    cameras: CameraModel,
    spectrum: Spectrum,
) -> tuple[JointResult, float, bool]:
    """
    Return the fit for the judgement of its model, the least noise, and the judgement.

    A model is right if its residual is no larger than the noise that the spectrum
    tells. Then the maximum of the likelihood needs neither floor nor prior, and the fit
    without them is returned (released). Deformation below the floor has vanished from
    the result, so that the released fit is tried from the start of the fit as well.

    A model that is not right has too few basis shapes, and cameras or depths explain
    the deformation that is missing. Calibrated cameras are fitted again, with a floor
    of the noise as high as that deformation. Orthographic ones, which have no scales
    that could explain any of it, only if their noise is at the lower floor.
    """
    options, least_noise = problem.options.judgement, problem.options.least_noise
    n_seen, energy = problem.totals
    mean_square = energy / n_seen
    right_noise = max(options.right * spectrum.noise, options.exact) * mean_square
    at_floor = result.state.noise < (1 + options.slack) * least_noise * mean_square
    # Right: without floor and prior
    if at_floor or result.state.noise < right_noise:
        for state in (result.state, start):
            released = unregularised(problem, state, cameras)
            if released.state.noise < right_noise:
                return released, problem.options.search.noise_floor, True
    # Not right: with a floor as high as the missing deformation
    follows = cameras.scaled or at_floor
    if cameras.calibrated and follows and spectrum.noise > 0:
        missing = options.cut_off * spectrum.missing
        least_noise = np.clip(missing, least_noise, options.most_noise)
        result = _calibrated_fit(problem, result.state, cameras, least_noise)
    return result, least_noise, False


def unregularised(
    problem: JointProblem, state: JointState, cameras: CameraModel
) -> JointResult:
    """Return the fit without prior and floor. It ends when the noise hardly falls."""
    problem = problem.with_penalty(0.0)
    state = with_prior(problem, state)
    options, floor = problem.options.judgement, problem.options.search.noise_floor
    steps = min(options.released_steps, problem.steps.max_iter)
    for _ in range(problem.steps.max_iter // steps):
        before = state.noise
        result = _refined(problem, state, cameras, floor, max_iter=steps)
        state = result.state
        if state.noise > options.falling * before:
            break
        if cameras.calibrated:
            state, _ = problem.reversed_back(state, cameras)
    return result


def _freedom_correction(
    n_seen: NDArray, n_points: int, n_shapes: int, n_pose: int
) -> float:
    """
    Return the number of seen coordinates N over the residual's degrees of freedom.

    Each frame has n_pose unknowns of camera and position. Coefficients are integrated
    out and do not count. The n centred shapes of J points have
    ``3 n (J - 1)`` unknowns, less the ``n^2 + 8`` of the gauge: n^2 of the mixing with
    the mean shape and nine of the affinity of space, which share one scale. At least
    ``N / 10`` degrees of freedom are assumed.
    """
    n_frames, n_numbers = len(n_seen), 2.0 * n_seen.sum()
    unknowns = n_pose * n_frames + 3 * n_shapes * (n_points - 1) - n_shapes**2 - 8
    return float(n_numbers / max(n_numbers - unknowns, 0.1 * n_numbers))
