"""The joint fit: from the paper's result to the shapes of greatest likelihood.

1. Starts with calibrated cameras (`starts`); the objective chooses the best of them.
2. The fit of calibrated cameras, shapes and noise, with a floor of the noise variance.
   Otherwise unmodelled deformation would distort depths and cameras.
3. The fit of affine cameras, from 2 and from the paper's result. The one with the lower
   objective is kept. With calibrated cameras it only serves for comparison.
4. The decision whether K is sufficient. If the noise is at most that of the spectrum,
   the fit is repeated without floor and prior.

For large tables, the first steps use a sample and the last ones all frames.
"""

from collections.abc import Iterable
from dataclasses import replace
from functools import partial
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from isa_nrsfm._frames.camera_models import CAMERAS, CameraModel
from isa_nrsfm._joint.frames import JointFrames, WeightedRows
from isa_nrsfm._joint.problem import FactorisedTable, JointProblem, JointSettings
from isa_nrsfm._joint.quasi_newton import NOISE_FLOOR, JointFit, JointState
from isa_nrsfm._joint.relevance import relevant_components
from isa_nrsfm._joint.reweighting import reweighted
from isa_nrsfm._joint.starts import affine_start, best_starts, settled, with_prior
from isa_nrsfm._linalg.rounding import OF_DISTANCES


class Spectrum(NamedTuple):
    """Noise level and missing energy of a rank-(3K+3) model, from the singular values.

    noise: share of the mean square, the mean of the squared singular values beyond 3K +
    3 (Tipping, Bishop, "Probabilistic principal component analysis", 1999, eq. 8).
    missing: share of the energy beyond the K + 3 largest singular values. For motion
    capture, it is about the share of the shapes outside the best K basis shapes.
    """

    noise: float
    missing: float

    @classmethod
    def of(cls, table: FactorisedTable, n_components: int) -> "Spectrum":
        """Return the spectrum of a table for K basis shapes."""
        rest_share = table.triplets.rest_share
        # Mean energy of the dimensions beyond, over that of all seen - 1 dimensions
        seen = float(np.mean(table.n_seen))
        n_others = seen - 1 - (3 * n_components + 3)
        noise = rest_share * (seen - 1) / n_others if n_others > 0 else 0.0
        # Points that were filled in add to the energy of the table, but have no noise.
        noise *= table.sample.W.shape[1] / seen
        squares = table.triplets.values**2
        beyond = np.sum(squares[n_components + 3 :]) / (np.sum(squares) or 1.0)
        return cls(noise, float(rest_share + (1 - rest_share) * beyond))


def fit_jointly(
    table: FactorisedTable,
    paper_shapes: NDArray,
    settings: JointSettings,
    start: JointState | None = None,
) -> tuple[JointFit, JointFrames, NDArray]:
    """Run the joint fit: starts, fit of the sample, judgement, fit of all frames.

    A fit from a given start uses only its shapes and noise, and of `paper_shapes` (K +
    1, 3, J) only the shape. Returns the fit, the fitted frames, and alpha (n_chosen, K)
    of the sample. Shapes are centred and mixed such that alpha ~ N(0, I). The noise is
    corrected for degrees of freedom.
    """
    problems, seen = _problems(table, paper_shapes, settings)
    first, sampled = problems[0], len(problems) > 1
    camera, cameras = settings.camera, CAMERAS[settings.camera]
    # Fit of the sample (of all frames if it is the table), and judgement of the model
    if start is None:
        fit, start = _first_fit(first, table, paper_shapes)
    else:
        shapes = first.frames.coordinates(start.shapes)
        start = first.aligned(start._replace(shapes=shapes), camera)
        continued = _calibrated_fit if cameras.calibrated else JointProblem.refined
        fit = continued(first, start, cameras)
    ratio = fit.camera_noise_ratio
    spectrum = Spectrum.of(table, len(paper_shapes) - 1)
    fit, least_noise, right = judged(first, fit, start, cameras, spectrum)
    refined = partial(JointProblem.refined, cameras=cameras, least_noise=least_noise)
    if right:
        problems = [replace(each, penalty=0.0) for each in problems]
        if not sampled:  # for a right model a smaller tolerance is safe
            fit = refined(problems[0], fit.state, tol=0.1**2 * settings.tol)
    # Fits of larger samples, and of all frames
    for problem in problems[1:]:
        fit = refined(problem, problem.aligned(fit.state, camera))
    # After completed frames, the points that are seen, and robust weights
    problem = problems[-1]
    if seen is not None:
        shapes = problem.frames.points(fit.state.shapes)
        problem = replace(problem, frames=seen)
        fit = refined(problem, fit.state._replace(shapes=shapes))
    noise, n_pose = fit.state.noise, 2 + cameras.n_parameters
    if table.outliers is not None:
        # This noise variance is corrected for the unknowns of the frames already.
        fit, noise = reweighted(problem, table.rows, table.outliers, fit, refined)
        n_pose = 0
    shapes = problem.frames.points(fit.state.shapes)
    # Coefficients of the sample, and degrees of freedom of the noise
    state = fit.state._replace(shapes=first.frames.coordinates(shapes))
    if sampled:
        state = state._replace(motion=state.motion[table.sample.parts[0]])
    noise *= _freedom_correction(table.n_seen, shapes.shape, n_pose)
    centred = shapes - shapes.mean(axis=2, keepdims=True)
    end = JointState(centred, fit.state.motion, max(noise, OF_DISTANCES**2))
    fit = fit._replace(state=end, camera_noise_ratio=ratio)
    return fit, problem.frames, first.likelihood.coefficients(*state)


def count_components(
    table: FactorisedTable, paper_shapes: NDArray, settings: JointSettings
) -> int:
    """Return the number of basis shapes that a table supports, at least one.

    Arguments as in `fit_jointly`, with more basis shapes than are expected.
    """
    problem = _problems(table, paper_shapes, settings)[0][0]
    fit, _ = _first_fit(problem, table, paper_shapes)
    return max(relevant_components(problem, fit.state, CAMERAS[settings.camera]), 1)


def _problems(
    table: FactorisedTable, paper_shapes: NDArray, settings: JointSettings
) -> tuple[list[JointProblem], JointFrames | None]:
    """Return the problems of growing samples and of all frames.

    With many points, frames are completed and represented by directions. If points are
    missing, left out or weighted, the second result has the frames by their visible
    points.
    """
    n_shapes, _, n_points = paper_shapes.shape
    options, seen = settings.options, None
    complete = bool((table.n_seen == n_points).all())
    if n_points > max(24 * n_shapes, options.many_points):
        directions = np.concatenate([table.factors.rigid_shape, table.factors.signals])
        directions = directions[directions.any(axis=1)] / np.sqrt(n_points)
        frames = JointFrames.from_directions(table.completed, directions)
        if not complete or table.outliers is not None or table.weights is not None:
            seen = _visible_frames(table, complete)
    else:
        frames = _visible_frames(table, complete)
    thorough = frames.n_frames <= options.few_frames
    penalty = frames.basis_penalty(options.basis_std)
    problem = JointProblem(frames, settings, thorough, penalty)
    # By chance, each fitted parameter lowers the objective by about one. Steps on a
    # sample end when they gain less than 3 % of the number of shape parameters.
    chance = 0.03 * frames.coordinates(paper_shapes).size
    problems = [
        problem.part(part, tol=max(settings.tol, chance / len(part)))
        for part in table.sample.parts
    ]
    return [*problems, problem], seen


def _visible_frames(table: FactorisedTable, complete: bool) -> JointFrames:
    """Return the frames by their visible points, without outliers, weighted."""
    if table.weights is not None:
        return JointFrames.from_repeated(table.rows, table.weights)
    if table.outliers is not None and table.outliers.any():
        rows = table.rows.derive(WeightedRows.without, table.outliers)
        return JointFrames.from_weighted(rows)
    return JointFrames.from_points(table.rows, complete)


def _first_fit(
    problem: JointProblem, table: FactorisedTable, paper_shapes: NDArray
) -> tuple[JointFit, JointState]:
    """Return the fit of the sample, with its noise ratio, and one of its starts."""
    # Calibrated cameras, from the best starts
    settings, affine = problem.settings, CAMERAS["affine"]
    camera = settings.camera
    calibrated = CAMERAS["weak_perspective" if camera == "affine" else camera]
    starts = best_starts(problem, table, paper_shapes, calibrated)
    fit = _least(_calibrated_fit(problem, state, calibrated) for state in starts)
    # Affine cameras, from the calibrated fit and from the paper's result
    rigid = affine_start(problem, table.sample.W, paper_shapes)
    states = [problem.aligned(fit.state, "affine"), settled(problem, rigid, affine)]
    max_iter = settings.max_iter
    if camera != "affine":  # only compared
        max_iter = min(max_iter, 60)
    if not problem.thorough:  # only the better one continues
        few = min(max_iter, 5)
        raced = [problem.refined(each, affine, max_iter=few) for each in states]
        states = [_least(raced).state]
    other = _least(problem.refined(s, affine, max_iter=max_iter) for s in states)
    ratio = fit.left / min(other.left, fit.left)
    if camera == "affine":
        return other._replace(camera_noise_ratio=ratio), rigid
    return fit._replace(camera_noise_ratio=ratio), starts[0]


def _least(fits: Iterable[JointFit]) -> JointFit:
    """Return the fit with the lowest objective at its end."""
    return min(fits, key=lambda fit: fit.value)


def _calibrated_fit(
    problem: JointProblem,
    state: JointState,
    cameras: CameraModel,
    least_noise: float | None = None,
) -> JointFit:
    """Return the fit of calibrated cameras in which no frame is reversed in depth."""
    fit = problem.refined(state, cameras, least_noise)
    for _ in range(5 if problem.thorough else 0):
        state, n_reversed = problem.reversed_back(fit.state, cameras)
        if not n_reversed:
            break
        fit = problem.refined(state, cameras, least_noise)
    return fit


def judged(
    problem: JointProblem,
    fit: JointFit,
    start: JointState,
    cameras: CameraModel,
    spectrum: Spectrum,
) -> tuple[JointFit, float, bool]:
    """Decide whether K is sufficient and refit accordingly.

    Returns the fit, its noise floor and the decision. A model is right if its residual
    is at most the noise of the spectrum. Then the fit is repeated without floor and
    prior, from its result and from its start. The result lacks deformation below the
    floor.

    Otherwise there are too few basis shapes, and cameras or depths explain the missing
    deformation. Calibrated cameras are fitted again, with a noise floor as high as that
    deformation; orthographic ones only if their noise is at the lower floor.
    """
    options, mean_square = problem.settings.options, problem.mean_square
    least_noise = options.least_noise
    # A spectrum of only 3K + 3 singular values has no noise.
    right_noise = max(options.right * spectrum.noise, 1e-10) * mean_square
    at_floor = fit.state.noise < (1 + 1e-3) * least_noise * mean_square
    # Right: without floor and prior
    if at_floor or fit.state.noise < right_noise:
        for state in (fit.state, start):
            released = unregularised(problem, state, cameras)
            if released.state.noise < right_noise:
                return released, NOISE_FLOOR, True
    # Not right: with a floor as high as the missing deformation
    follows = cameras.scaled or at_floor
    if cameras.calibrated and follows and spectrum.noise > 0:
        missing = options.cut_off * spectrum.missing
        least_noise = np.clip(missing, least_noise, options.most_noise)
        fit = _calibrated_fit(problem, fit.state, cameras, least_noise)
    return fit, least_noise, False


def unregularised(
    problem: JointProblem, state: JointState, cameras: CameraModel
) -> JointFit:
    """Return the fit without prior and floor. It ends when the noise hardly falls."""
    problem = replace(problem, penalty=0.0)
    state = with_prior(problem, state)
    max_iter = problem.settings.max_iter
    steps = min(60, max_iter)
    for _ in range(max_iter // steps):
        before = state.noise
        fit = problem.refined(state, cameras, NOISE_FLOOR, max_iter=steps)
        state = fit.state
        if state.noise > 0.95 * before:
            break
        if cameras.calibrated:
            state, _ = problem.reversed_back(state, cameras)
    return fit


def _freedom_correction(
    n_seen: NDArray, shape: tuple[int, int, int], n_pose: int
) -> float:
    """Return the number of seen coordinates N over the residual's degrees of freedom.

    Each frame has n_pose unknowns; coefficients are integrated out. The n centred
    shapes have ``3 n (J - 1)`` unknowns, less the ``n^2 + 8`` of the gauge: the mixing
    and the affinity of space, which share one scale. At least ``N / 10`` degrees are
    assumed.
    """
    n_shapes, _, n_points = shape
    n_frames, n_numbers = len(n_seen), 2.0 * n_seen.sum()
    unknowns = n_pose * n_frames + 3 * n_shapes * (n_points - 1) - n_shapes**2 - 8
    return float(n_numbers / max(n_numbers - unknowns, 0.1 * n_numbers))
