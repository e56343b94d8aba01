"""The joint fit: from the paper's result to the shapes of greatest likelihood.

1. Starts with calibrated cameras (`starts`); the objective chooses the best of them.
   With all directions of a shape, the evidence decides whether deformation explains
   the images better than rotations do.
2. The fit of calibrated cameras, shapes and noise, with a floor of the noise variance.
   Otherwise unmodelled deformation would distort depths and cameras.
3. The fit of affine cameras, from the paper's result and from 2. The one with the lower
   objective is kept. With calibrated cameras it only serves for comparison; if the
   first one explains the table, 1 and 2 are left out.
4. The decision whether K is sufficient: if the residual does not exceed the noise level
   of the spectrum. Then the fit is repeated without floor and prior.

For large tables, the first steps use a sample and the last ones all frames.
"""

from collections.abc import Iterator
from dataclasses import replace
from functools import partial
from operator import itemgetter
from typing import Any

import numpy as np
from numpy.typing import NDArray

from isa_nrsfm._frames.camera_models import (
    CAMERAS,
    CameraModel,
    centred_residuals,
    residuals,
)
from isa_nrsfm._frames.models import (
    LEAST_POINTS,
    FrameModel,
    derivatives,
    spread_starts,
)
from isa_nrsfm._joint import starts
from isa_nrsfm._joint.likelihood import JointFrames, WeightedRows, without
from isa_nrsfm._joint.prior import SETTLED_WIDTH, TOL_SHARE, ShapePrior
from isa_nrsfm._joint.problem import (
    NOISE_FLOOR,
    FactorisedTable,
    JointFit,
    JointProblem,
    JointState,
    regular,
)
from isa_nrsfm._joint.settings import FitSettings
from isa_nrsfm._joint.whole import (
    FAR_FRAMES,
    FEW_DIRECTIONS,
    LEAST_NOISE,
    evidence,
    extended,
    n_directions,
    rival_depths,
    whole_distribution,
)
from isa_nrsfm._linalg import OF_DIFFERENCES, OF_DISTANCES, centred, lengths
from isa_nrsfm._prepare.robust import frame_weights, median_noise, robust_sizes
from isa_nrsfm._tables import FrameBlocks, representative_frames, seen_points

# Numbers of basis shapes of the fits that are compared, first that of the noise ratio:
# docs/benchmarks/README.md, "Thresholds".
FIRST_COMPONENTS = 3, 1, 12
# Those of further fits, from whose cameras the consensus starts, and least weight of
# these: docs/benchmarks/consensus.md.
OTHER_COMPONENTS, LEAST_WEIGHT = (2, 3, 5, 8), 0.01
# Those with which the best fit of an object that bends to both sides starts again:
# docs/depth.md, "How it is estimated".
AGAIN = 3, 5
# Differences of `evidence`, on the same page: starts that are further off are not
# refined; smaller gains of a coordinate are within the error of the noise variance.
HOPELESS, LEAST_GAIN = 5.0, 0.02
# Numbers of groups of similar frames that may be reversed in depth:
# docs/benchmarks/README.md, "Thresholds".
GROUPS = 2, 4
# Largest noise variance of a fit without floor, over the floor, if directions explain
# a table: docs/benchmarks/README.md, "Thresholds".
RELEASED = 0.01
# Largest error variance of a point that others predict, over that of the noise, in
# frames with missing points: docs/benchmarks/README.md, "Thresholds".
LARGEST_SPREAD = 5.0


def fit_jointly(
    table: FactorisedTable,
    paper_shapes: NDArray,
    start: JointState | None,
    settings: FitSettings,
) -> tuple[JointFit, JointFrames, NDArray]:
    """Run the joint fit: starts, fit of the sample, judgement, fit of all frames.

    The shapes and the noise of a given start replace the paper's shapes (K + 1, 3, J).
    Calibrated cameras have all directions of a shape (`whole`). With them and with a
    prior there is no judgement.
    Returns the fit, the fitted frames, and alpha (n_chosen, K) of the sample. Shapes
    are centred and mixed such that alpha ~ N(0, I). The noise is corrected for degrees
    of freedom.
    """
    problems = _problems(table, paper_shapes, settings)
    first = next(problems)
    # Fit of the sample (of all frames if it is the table), and judgement of the model
    of_sample, least_noise, sufficient = _fit_of_sample(
        first, table, paper_shapes, start
    )
    fit, penalty = of_sample, 0.0 if sufficient else first.penalty

    def of_all(larger: JointProblem) -> JointProblem:
        """Return a problem with the priors of the fit of the sample."""
        larger = larger.with_prior(fit.prior)
        return replace(larger, penalty=penalty, widths=fit.widths)

    problem = of_all(first)
    if sufficient and not table.parts:  # a smaller tolerance is safe
        tol = 0.1**2 * settings.tol
        fit = problem.refined(fit.state, least_noise=least_noise, tol=tol)
    # Fits of larger samples, and of all frames; for robust losses see `reweighted`
    further = None
    if table.parts and table.outliers is None:
        further = spread_starts(problem.likelihood(*fit.state).alpha)
    for larger in problems:
        problem = of_all(larger)
        if table.outliers is None:
            state = problem.aligned(fit.state, further)
            fit = problem.refined(state, least_noise=least_noise)
    n_pose = 2 + first.cameras.n_parameters
    if table.compressed and table.outliers is None and not table.every_point:
        # After completed frames, the points that are seen, and weights
        shapes = problem.frames.points(fit.state.shapes)
        problem = replace(problem, frames=_visible_frames(table))
        state = fit.state._replace(shapes=shapes)
        fit = problem.refined(state, least_noise=least_noise)
    noise = fit.state.noise
    if table.outliers is not None:
        # This noise variance is corrected for the unknowns of the frames already.
        problem, fit, noise = reweighted(problem, table, fit, least_noise)
        n_pose = 0
    shapes = problem.frames.points(fit.state.shapes)
    # Coefficients of the sample, and degrees of freedom of the noise
    state = _of_sample(first, table, fit.state._replace(shapes=shapes))
    if fit.widths is None:
        n_seen = table.scaled.n_seen
        noise *= _freedom_correction(n_seen, shapes.shape, n_pose, fit.prior)
    end = JointState(centred(shapes), fit.state.motion, max(noise, OF_DISTANCES**2))
    ratio, rivals = of_sample.camera_noise_ratio, of_sample.rivals
    fit = fit._replace(state=end, camera_noise_ratio=ratio, rivals=rivals)
    return fit, problem.frames, first.likelihood(*state).alpha


def _fit_of_sample(
    problem: JointProblem,
    table: FactorisedTable,
    paper_shapes: NDArray,
    start: JointState | None,
) -> tuple[JointFit, float, bool]:
    """Return the fit of the first sample, its noise floor, and if K is sufficient."""
    settings, all_directions = problem.settings, problem.settings.all_directions
    least_noise = settings.limits.least_noise
    if start is not None:
        fit, start = _continued(problem, table, start)
    elif all_directions:
        fit = _likeliest_fit(problem, table, paper_shapes)
    elif problem.cameras.calibrated:
        fit, start = _first_fit(problem, table, paper_shapes)
    else:
        return _affine_fit(problem, table, paper_shapes)
    ratio, rivals, sufficient = fit.camera_noise_ratio, fit.rivals, False
    if all_directions:
        fit = steadiest(problem, table, fit)
        rivals = fit.rivals
        # More directions, if the table supports all of the first ones
        few = bool(table.parts) or not table.every_point or table.outliers is not None
        n_max = n_directions(problem, paper_shapes.shape[2], few)
        if len(fit.state.shapes) - 1 == FEW_DIRECTIONS < n_max:
            state = extended(problem, fit.state, n_max).state
            fit = whole_distribution(problem, state)
        fit, least_noise = explained(problem, table, fit)
    elif fit.prior is None:
        assert start is not None
        fit, least_noise, sufficient = judged(problem, table, fit, start)
    elif table.outliers is None:  # with them the widths follow the weights
        fit = deepened(problem, widened(problem, fit))
    fit = fit._replace(camera_noise_ratio=ratio, rivals=rivals)
    return fit, least_noise, sufficient


def _continued(
    problem: JointProblem, table: FactorisedTable, start: JointState
) -> tuple[JointFit, JointState]:
    """Return the fit of the sample from a start of all frames, and this start."""
    settings, n_points = problem.settings, start.shapes.shape[2]
    start = _of_sample(problem, table, start)
    if not len(start.motion):
        start = problem.aligned(start)
    # The widths of a prior change its first fit. All directions have another one.
    rough: dict[str, Any] = {"max_iter": 0} if settings.all_directions else {}
    if settings.prior is None:  # a fit without the prior has larger basis shapes
        start = starts.with_prior(problem, start)
    else:
        rough = {"tol": settings.tol / TOL_SHARE}
    fit = problem.unreversed(start, **rough)
    if settings.all_directions:
        fit = extended(problem, fit.state, n_directions(problem, n_points, few=True))
    return fit, start


def _of_sample(
    problem: JointProblem, table: FactorisedTable, state: JointState
) -> JointState:
    """Return a state of all frames as one of the first sample, by its coordinates."""
    shapes, motion, noise = state
    if table.parts and len(motion):
        motion = motion[table.parts[0]]
    return JointState(problem.frames.coordinates(shapes), motion, noise)


def _likeliest_fit(
    problem: JointProblem, table: FactorisedTable, paper_shapes: NDArray
) -> JointFit:
    """Return the fit of few basis shapes from which all directions fit best."""
    n = n_directions(problem, paper_shapes.shape[2], few=True)
    n_max = min(len(paper_shapes) - 1, n)
    n_first, *more = dict.fromkeys(min(k, n_max) for k in FIRST_COMPONENTS)
    more = more if problem.settings.limits.restarts else []
    tol = problem.settings.tol
    fits = [_first_fit(problem, table, paper_shapes[: n_first + 1], tol=tol)[0]]
    for k in more:
        fits.append(_calibrated_fit(problem, table, paper_shapes[: k + 1], tol=tol)[0])
    ends = [extended(problem, fit.state, n) for fit in fits]
    best = min(ends, key=lambda fit: (evidence(problem, fit), _end(fit)))
    # The noise variances of both camera models, each for its degrees of freedom, of few
    # basis shapes: more of them explain what wrong cameras leave.
    size, n_seen = fits[0].state.shapes.shape, table.scaled.n_seen
    correction, affine_correction = (
        _freedom_correction(n_seen, size, 2 + c.n_parameters, None)
        for c in (problem.cameras, CAMERAS["affine"])
    )
    ratio = max(fits[0].camera_noise_ratio * correction / affine_correction, 1.0)
    # With as many steps again, as only the best one is refined further
    return extended(problem, best.state, n)._replace(camera_noise_ratio=ratio)


def other_fits(
    table: FactorisedTable, paper: NDArray, settings: FitSettings, joint: JointFit
) -> list[tuple[float, JointState]]:
    """Return the states of fits from other starts, at the first noise, by points.

    With their weights, the evidence of a frame relative to that of the joint fit, if
    they count. None without all directions. Other arguments as in `fit_jointly`.
    """
    states: list[tuple[float, JointState]] = []
    if not (settings.all_directions and settings.limits.restarts):
        return states
    problem = next(_problems(table, paper, settings))
    n = n_directions(problem, paper.shape[2], few=True)
    state = joint.state._replace(shapes=joint.state.shapes[: n + 1])
    state = _of_sample(problem, table, state)
    best = evidence(problem, extended(problem, state, n))
    for k in dict.fromkeys(min(k, len(paper) - 1, n) for k in OTHER_COMPONENTS):
        fit, _ = _calibrated_fit(problem, table, paper[: k + 1], tol=settings.tol)
        fit = extended(problem, fit.state, n)
        weight = float(np.exp(min(best - evidence(problem, fit), 0.0) / 2.0))
        if weight > LEAST_WEIGHT:
            shapes = centred(problem.frames.points(fit.state.shapes))
            states.append((weight, fit.state._replace(shapes=shapes)))
    return states


def steadiest(
    problem: JointProblem, table: FactorisedTable, first: JointFit
) -> JointFit:
    """Return the fit from one at the first noise, or a more evident one.

    The others start from cameras that turn less: wings that beat look like a bird that
    rolls. The objective counts coefficients, but not rotations, and its minima lead
    there; `evidence` counts both. Further ones start from a flat mean shape, or have
    groups of frames turned back in depth (`reversed_groups`).
    """
    frames = problem.frames
    rows = frames.coordinates(table.W).reshape(frames.n_frames, 2, -1)
    n = min(len(first.state.shapes) - 1, FEW_DIRECTIONS)
    n_first = min(FIRST_COMPONENTS[0], n)
    before = evidence(problem, first)
    fit = whole_distribution(problem, first.state)
    if not (problem.settings.limits.restarts and np.isfinite(before)):  # nothing turns
        return fit
    least_gain = LEAST_GAIN * frames.totals[0] / frames.n_frames
    found, latest = [(evidence(problem, fit) - least_gain, before, fit)], fit

    def expanded(state: JointState) -> JointFit:
        """Return the fit of n directions from a state, first with its own."""
        k = len(state.shapes) - 1
        if k < n:
            state = extended(problem, state, k, max_iter=200, tol=0.2).state
        return extended(problem, state, n)

    def lifted(motion: NDArray, k: int) -> JointState:
        """Return a state of k directions that fit cameras."""
        shapes = starts.lifted_shapes(rows, motion, k)
        return starts.held_fit(problem, rows, motion, shapes).state

    def compare(other: JointFit, margin: float) -> None:
        """Add a fit, if it may be the most evident one."""
        at_first = evidence(problem, other)
        if at_first < before + margin:
            other = whole_distribution(problem, other.state)
            found.append((evidence(problem, other), at_first, other))

    for _ in range(4):
        motion, tried = starts.steadied(latest.state.motion), len(found)
        for k in {n_first, n}:
            compare(expanded(lifted(motion, k)), HOPELESS)
        if len(found) == tried:
            break
        latest = min(found[tried:], key=itemgetter(0))[2]

    best = min(found, key=itemgetter(0))[2]
    if starts.both_sides(best.state):
        motion = starts.flat_cameras(problem, best.state)
        compare(expanded(lifted(motion, n_first)), HOPELESS)
        # Few directions lead out of minima where others explain wrong cameras.
        for k in AGAIN:
            _, before, best = min(found, key=itemgetter(0))
            compare(expanded(lifted(best.state.motion, min(k, n))), 0.0)

    for n_groups in GROUPS:
        _, before, best = min(found, key=itemgetter(0))
        alpha = replace(problem, widths=best.widths).likelihood(*best.state).alpha
        motion = starts.reversed_groups(
            problem, rows, best.state.motion, alpha, n_groups
        )
        if np.any(motion != best.state.motion):
            compare(problem.turned_back(lifted(motion, n), expanded), -least_gain)
    found.sort(key=itemgetter(0))
    best, n_found = found[0][2], len(found)
    rivals = rival_depths(problem, [(value, fit) for value, _, fit in found])
    # A flat object may have relief to both sides. All choices of a side for each frame
    # are equally likely then.
    compare(expanded(starts.unfolded(best.state, n)), HOPELESS)
    for value, _, flat in found[n_found:]:
        sides = [(evidence(problem, best), best), (value - 2.0 * np.log(2.0), flat)]
        rivals += rival_depths(problem, sides)
    return best._replace(rivals=rivals)


def count_components(
    table: FactorisedTable, paper_shapes: NDArray, settings: FitSettings
) -> int:
    """Return the number of basis shapes that a table supports, at least one.

    Arguments as in `fit_jointly`, with more basis shapes than are expected.
    """
    problem = next(_problems(table, paper_shapes, settings))
    first_fit = _first_fit if problem.cameras.calibrated else _affine_fit
    fit, *_ = first_fit(problem, table, paper_shapes)
    widths = whole_distribution(problem, fit.state).widths
    assert widths is not None
    return widths.n_relevant


def _problems(
    table: FactorisedTable, paper_shapes: NDArray, settings: FitSettings
) -> Iterator[JointProblem]:
    """Yield the problems of growing samples, one at a time, and of all frames."""
    limits, frames = settings.limits, table.compressed or _visible_frames(table)
    thorough = frames.n_frames <= limits.few_frames
    penalty = 0.0 if settings.shape_prior else frames.basis_penalty(limits.basis_std)
    problem = JointProblem(frames, settings, thorough, penalty)
    # Each parameter that fits noise only lowers -2 log L by about one. Steps on a
    # sample end when they gain less than 3 % of the number of shape parameters.
    chance = 0.03 * frames.coordinates(paper_shapes).size
    for part in table.parts:
        yield problem.part(part, tol=max(settings.tol, chance / len(part)))
    yield problem


def _visible_frames(table: FactorisedTable) -> JointFrames:
    """Return the frames by their visible points, without outliers, weighted."""
    rows, weights, outliers = table.scaled.rows, table.scaled.weights, table.outliers
    if weights is None and outliers is not None and outliers.any():
        return JointFrames.from_weighted(rows.derive(without, outliers))
    return JointFrames.from_points(rows, table.scaled.complete, weights)


def _first_fit(
    problem: JointProblem, table: FactorisedTable, paper_shapes: NDArray, **limits: Any
) -> tuple[JointFit, JointState]:
    """Return the fit of calibrated cameras, with its noise ratio, and its start."""
    fit, start = _calibrated_fit(problem, table, paper_shapes, **limits)
    max_iter = min(problem.settings.max_iter, 60)  # affine cameras are only compared
    affine = replace(problem, seen_by=CAMERAS["affine"])
    state, _ = _paper_start(affine, table, paper_shapes)
    fits = [affine.refined(s, max_iter=max_iter) for s in (fit.state, state)]
    return _compared(fit, min(fits, key=_end), fit), start


def _affine_fit(
    problem: JointProblem, table: FactorisedTable, paper_shapes: NDArray
) -> tuple[JointFit, float, bool]:
    """Return the judged fit of affine cameras, with its noise ratio, as `judged` does.

    Calibrated starts take most of the time. They are left out if the fit from the
    paper's result explains the table to the noise of its spectrum: then a calibrated
    fit from its cameras serves for comparison.
    """
    weak = replace(problem, seen_by=CAMERAS["weak_perspective"])
    state, rigid = _paper_start(problem, table, paper_shapes)
    fit = problem.refined(state)
    released, least_noise, sufficient = judged(problem, table, fit)
    if sufficient:
        motion, shapes = starts.calibrated_start(fit.state.motion, fit.state.shapes)
        state = fit.state._replace(motion=motion, shapes=shapes)
        calibrated = weak.unreversed(starts.with_prior(weak, state))
        return _compared(calibrated, fit, released), least_noise, True
    calibrated, _ = _calibrated_fit(weak, table, paper_shapes)
    fit = min(fit, problem.refined(calibrated.state), key=_end)
    released, least_noise, sufficient = judged(problem, table, fit, rigid)
    return _compared(calibrated, fit, released), least_noise, sufficient


def _paper_start(
    affine: JointProblem, table: FactorisedTable, paper_shapes: NDArray
) -> tuple[JointState, JointState]:
    """Return the paper's result after some steps of affine cameras, and itself.

    The steps are without the prior: with the large noise of a start it would make basis
    shapes vanish.
    """
    rigid = starts.affine_start(affine, table.W, paper_shapes)
    limits = {"max_iter": starts.FIXED_STEPS, "tol": affine.settings.tol}
    state = replace(affine, penalty=0.0).refined(rigid, **limits).state
    return starts.with_prior(affine, state), rigid


def _compared(calibrated: JointFit, affine: JointFit, fit: JointFit) -> JointFit:
    """Return a fit with the noise ratio of fits with both kinds of cameras."""
    ratio = calibrated.misfit / min(affine.misfit, calibrated.misfit)
    return fit._replace(camera_noise_ratio=ratio)


def _calibrated_fit(
    problem: JointProblem, table: FactorisedTable, paper_shapes: NDArray, **limits: Any
) -> tuple[JointFit, JointState]:
    """Return the fit of calibrated cameras from the best starts, and the best start."""
    states = starts.best_starts(problem, table, paper_shapes)
    return min((problem.unreversed(s, **limits) for s in states), key=_end), states[0]


def _end(fit: JointFit) -> float:
    """Return the objective at the end of a fit."""
    return float(fit.history[-1])


def judged(
    problem: JointProblem, table: FactorisedTable, fit: JointFit, *states: JointState
) -> tuple[JointFit, float, bool]:
    """Decide whether K is sufficient and refit accordingly.

    Returns the fit, its noise floor and the decision. K is sufficient if the residual
    does not exceed the noise level of the spectrum. Then the fit is repeated without
    floor and prior, from its result, or else from the given states. The result lacks
    deformation below the floor.

    Otherwise the fit keeps them: missing deformation would distort cameras and depths.
    """
    limits, mean_square = problem.settings.limits, problem.mean_square
    least_noise = limits.least_noise
    # A spectrum of only 3K + 3 singular values has no noise.
    noise_level = table.noise_level(len(fit.state.shapes) - 1)
    threshold = max(limits.right * noise_level, 1e-10) * mean_square
    at_floor = fit.state.noise < (1 + 1e-3) * least_noise * mean_square
    # Sufficient: without floor and prior
    if at_floor or fit.state.noise < threshold:
        for state in (fit.state, *states):
            released = unregularised(problem, state)
            if released.state.noise < threshold:
                return released, NOISE_FLOOR, True
    return fit, least_noise, False


def explained(
    problem: JointProblem, table: FactorisedTable, fit: JointFit
) -> tuple[JointFit, float]:
    """Return the fit of all directions with their widths, and its noise floor.

    If the relevant directions leave no more than the noise of the spectrum, the fit is
    that of these, without floor. It may leave more: parts that turn may have images of
    low rank, but are no sums of few shapes. Points that were filled in have errors:
    they need room for three directions more (docs/benchmarks/README.md, "Thresholds").
    """
    widths, tol = fit.widths, problem.settings.tol
    assert widths is not None
    n_known = len(widths.variances) + (0 if table.every_point else 3)
    if table.explained_by(n_known, LEAST_NOISE):
        n = widths.n_relevant
        state = fit.state._replace(shapes=fit.state.shapes[: n + 1])
        state = unregularised(problem, state).state
        level = problem.settings.limits.right * table.noise_level(n)
        if state.noise <= max(level, RELEASED * LEAST_NOISE) * problem.mean_square:
            free = replace(problem, penalty=0.0)
            fit = free.refined(state, least_noise=NOISE_FLOOR, tol=tol)
            widths = widths.of_points(widths.n_numbers // 3, n)
            return fit._replace(widths=widths), NOISE_FLOOR
    problem = replace(problem, widths=widths)
    return problem.refined(fit.state, least_noise=LEAST_NOISE, tol=tol), LEAST_NOISE


def unregularised(problem: JointProblem, state: JointState) -> JointFit:
    """Return the fit without prior and floor. It ends when the noise hardly falls."""
    problem = replace(problem, penalty=0.0)
    state = starts.with_prior(problem, state)
    max_iter = problem.settings.max_iter
    steps = min(60, max_iter)
    for _ in range(max_iter // steps):
        before = state.noise
        fit = problem.refined(state, least_noise=NOISE_FLOOR, max_iter=steps)
        state = fit.state
        if state.noise > 0.95 * before:
            break
        if problem.cameras.calibrated:
            state, _ = problem.reversed_back(state)
    return fit


def _freedom_correction(
    n_seen: NDArray, shape: tuple[int, int, int], n_pose: int, prior: ShapePrior | None
) -> float:
    """Return the number of seen coordinates N over the residual's degrees of freedom.

    Each frame has n_pose unknowns; coefficients are integrated out. The n centred
    shapes have ``3 n (J - 1)`` unknowns, less the ``n^2 + 8`` of the gauge: the mixing
    and the affinity of space, which share one scale. At least ``N / 10`` degrees are
    assumed. A prior knows the unknowns of its shapes.
    """
    n_shapes, _, n_points = shape
    n_frames, n_numbers = len(n_seen), 2.0 * n_seen.sum()
    unknowns: float = 3 * n_shapes * (n_points - 1) - n_shapes**2 - 8
    if prior is not None:
        unknowns = prior.n_determined
    freedom = n_numbers - n_pose * n_frames - unknowns
    return float(n_numbers / max(freedom, 0.1 * n_numbers))


def widened(problem: JointProblem, fit: JointFit) -> JointFit:
    """Return the fit with the widths of the prior that follow from the table."""
    for _ in range(20):
        assert fit.prior is not None
        shapes, _, noise = fit.state
        curvature = problem.likelihood(*fit.state).shape_curvature
        before, prior = fit.prior.width, fit.prior.updated(shapes, curvature, noise)
        fit = problem.with_prior(prior).unreversed(fit.state)
        if abs(prior.width - before) < SETTLED_WIDTH * prior.width:
            break
    return fit


def deepened(problem: JointProblem, fit: JointFit) -> JointFit:
    """Return the fit, or that of flatter or deeper objects, if these are likelier.

    As many frames as `FAR_FRAMES` are the evidence.
    """
    prior, n = fit.prior, problem.frames.n_frames / FAR_FRAMES
    assert prior is not None
    found = [(_end(fit) / n + 0.5 * prior.cost, fit)]
    for start, other, _ in starts.other_depths(fit.state, problem.cameras, prior):
        trial = problem.with_prior(other).unreversed(start)
        found.append((_end(trial) / n + 0.5 * other.cost, trial))
    best = min(found, key=itemgetter(0))[1]
    return fit if best is fit else deepened(problem, widened(problem, best))


def reweighted(
    problem: JointProblem, table: FactorisedTable, fit: JointFit, least_noise: float
) -> tuple[JointProblem, JointFit, float]:
    """Iterate refinement and weights until the weights agree with the residuals.

    In the fit of the sample, outliers of the table had weight zero, other points weight
    one. Returns the problem of all frames, the refinement and the noise variance of a
    coordinate, from the median of the residuals, corrected for the degrees of freedom.

    If weights change by 0.5 % at random, the shapes change by about 0.5 % of their
    standard errors (docs/benchmarks/README.md, "Thresholds"). About 2,000 frames
    determine the noise, and nearly the shapes.
    """
    loss = problem.settings.loss
    tol = (1e-2 if problem.thorough else 1.0) * problem.settings.tol
    rows, left_out = table.scaled.rows, table.outliers
    assert left_out is not None
    sample = representative_frames(rows, 2000)
    points = rows.take(sample)
    weights, sizes = without(points, left_out[sample])[1], robust_sizes(points)
    state = fit.state._replace(shapes=problem.frames.points(fit.state.shapes))

    def part(weighted: FrameBlocks) -> JointProblem:
        """Return the problem of frames with weights."""
        return replace(problem, frames=JointFrames.from_weighted(weighted))

    def refined(problem: JointProblem, fit: JointFit, **limits: Any) -> JointFit:
        """Return the refinement of a problem."""
        if fit.prior is not None:
            return widened(problem.with_prior(fit.prior), fit)
        limits |= {"least_noise": least_noise, "tol": tol}
        return problem.refined(fit.state, **limits)

    problem = part(FrameBlocks.of_blocks([(points, weights)], [len(sample)]))
    if table.parts:  # of a sample with other frames
        state = problem.aligned(state)
    else:
        state = state._replace(motion=state.motion[sample])
    fit = fit._replace(state=state)
    for _ in range(20):
        shapes, motion, _ = fit.state
        alpha = problem.likelihood(*fit.state).alpha
        distance = lengths(centred_residuals(points, weights, shapes, motion, alpha))
        # Enough frames for the median of the residuals
        subset = slice(None, None, max(distance.size // 150_000, 1))
        state = fit.state._replace(motion=motion[subset])
        typical = distance[subset] / residual_deviations(
            state, alpha[subset], weights[subset], problem.cameras
        )
        deviation = max(median_noise(typical[np.isfinite(typical)]), OF_DISTANCES)
        before, weights = weights, frame_weights(loss, distance, deviation, sizes)
        if np.mean((weights - before) ** 2) < 2.5e-5:
            break
        problem = part(FrameBlocks.of_blocks([(points, weights)], [len(sample)]))
        fit = refined(problem, fit)
    if fit.prior is not None:
        fit = deepened(problem, fit)
    if len(sample) < rows.n_frames:
        weighted = rows.derive(without, left_out)
        problem = part(weighted)
        fit = fit._replace(state=problem.aligned(fit.state))
        for limits in {"max_iter": 1}, {}:  # one step before the last weights
            shapes, motion, _ = fit.state
            alpha = problem.likelihood(*fit.state).alpha
            new = partial(_weighted, shapes=shapes, loss=loss, deviation=deviation)
            weighted = weighted.derive(new, motion, alpha)
            problem = part(weighted)
            fit = refined(problem, fit, **limits)
    return problem, fit, deviation**2


def residual_deviations(
    state: JointState, alpha: NDArray, weights: NDArray, cameras: CameraModel
) -> NDArray:
    """Return the standard deviations (n, J) of residuals over that of the noise.

    With the derivatives A of the image by camera, position and coefficients and weights
    W, residuals are ``(I - A (A^T W A + P)^-1 A^T W)`` times the noise; the prior P is
    the noise variance for each coefficient.
    """
    deviations = np.empty(weights.shape)
    for part, A, weighed, inverse in own_unknowns(state, alpha, weights, cameras.name):
        Z = inverse @ A
        spread = np.einsum("ipx,ipx->ix", Z, weighed @ weighed.swapaxes(1, 2) @ Z)
        leverage = np.einsum("ipx,ipx->ix", weighed, Z)
        square = (1.0 - 2.0 * leverage + spread).reshape(len(A), 2, -1).mean(axis=1)
        deviations[part] = np.sqrt(np.maximum(square, OF_DISTANCES))
    return deviations


def own_unknowns(
    state: JointState, alpha: NDArray, weights: NDArray, camera: str
) -> Iterator[tuple[slice, NDArray, NDArray, NDArray]]:
    """Yield A (n, p, 2 J), A W and ``(A^T W A + P)^-1`` of slices of frames.

    A, W and P are those of `residual_deviations`.
    """
    shapes, motion, noise = state
    (n_frames, n_points), (_, n_components) = weights.shape, alpha.shape
    # Process frames in slices whose derivatives fit into 1 MB
    length = max(2**17 // (2 * n_points * (8 + n_components)), 1)
    for first in range(0, n_frames, length):
        part = slice(first, first + length)
        moved = derivatives(shapes, motion[part], alpha[part], camera)
        positions = np.zeros((len(moved), 2, 2, n_points))
        positions[:, [0, 1], [0, 1]] = 1.0
        A = np.concatenate([moved, positions], axis=1)
        flat = A.reshape(*A.shape[:2], -1)
        weighed = (A * weights[part, None, None]).reshape(flat.shape)
        gram = weighed @ flat.mT
        gram[:, range(n_components), range(n_components)] += noise
        yield part, flat, weighed, np.linalg.inv(regular(gram))


def left_out_distances(model: FrameModel, rows: NDArray) -> NDArray:
    """Return distances (n, J) of points from fits of the others of their frame.

    rows (n, 2, J): of size one. To first order, ``(I - H_jj)^-1 r_j`` with the residual
    r_j of a point and the hat matrix H of its frame. Directions of the shapes that
    follow a wrong point explain it, but not from the others. NaN if these are fewer
    than `LEAST_POINTS`, or if with missing points they do not predict the point.
    """
    fit, w = model.without_starts.posterior(rows, False), seen_points(rows) * 1.0
    state = JointState(model.shapes, fit.motion, model.noise_variance)
    residual = residuals(rows, model.shapes, *fit[:3])
    distance = np.full(w.shape, np.nan)
    for part, A, weighed, inverse in own_unknowns(state, fit.alpha, w, model.camera):
        Z, Y = (x.reshape(len(x), -1, 2, w.shape[1]) for x in (inverse @ A, weighed))
        left = (1.0 + OF_DIFFERENCES) * np.eye(2) - np.einsum("iprj,ipsj->ijrs", Y, Z)
        spread = np.linalg.inv(left)  # covariance of the errors over that of the noise
        error = np.linalg.norm(spread @ residual[part].mT[..., None], axis=(2, 3))
        mask = np.trace(spread, axis1=2, axis2=3) < 2 * LARGEST_SPREAD
        mask |= w[part].all(axis=1, keepdims=True)
        distance[part] = np.where(mask, error, np.nan)
    enough = w.sum(axis=1, keepdims=True) > LEAST_POINTS
    return np.where((w > 0) & enough, distance, np.nan)


def _weighted(
    block: WeightedRows, *fit: NDArray, shapes: NDArray, loss: str, deviation: float
) -> WeightedRows:
    """Return frames with the weights of their residuals from a fit."""
    distance = lengths(centred_residuals(*block, shapes, *fit))
    sizes = robust_sizes(block[0])
    return block[0], frame_weights(loss, distance, deviation, sizes)
