"""The fit of each frame after the joint fit, and the errors of both.

Reliability of the coefficients: the share of their variance that is signal.

Errors of a fit with calibrated cameras, by leaving out groups of its points: unmodelled
deformation is correlated between neighbouring points and between frames, and part of it
resembles a rotation. A posterior covariance with independent noise is
therefore too small. The delete-a-group jackknife (Efron and Stein, The Annals of
Statistics, 1981) needs no model of the noise: from fits without each of g groups of
neighbouring points the variance of an estimate t is ::

    (g - 1) / g sum_g (t_g - mean_h t_h)^2.

With a prior, which holds all fits to itself, and for rotations it is t itself in place
of the mean. These fits do not have the prior of the extents, which would hide uncertain
depths.

Random halves show how a fit would change on another table, without new fits. A sum over
the groups of a table changes by ``sum_g h_g x_g`` for the groups with h_g = 1, counted
twice, and without those with h_g = -1. The rows h of a Hadamard matrix are orthogonal:
two of these halves differ as much as two independent tables of the full size (McCarthy,
"Pseudo-replication: half samples", 1969, with balanced half samples).
"""

from collections.abc import Callable, Sequence
from functools import partial
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import hadamard
from scipy.optimize import linear_sum_assignment
from scipy.spatial.distance import cdist
from scipy.spatial.transform import Rotation
from scipy.special import softmax

from isa_nrsfm._frames.camera_models import (
    CAMERAS,
    CameraModel,
    centred_residuals,
    distances,
    full_rotations,
    stacked_motion,
)
from isa_nrsfm._frames.models import (
    NOT_ESTIMATED,
    Decomposition,
    DepthCertainty,
    FrameModel,
    leverages,
)
from isa_nrsfm._frames.search import FramePosterior, FrameSearch
from isa_nrsfm._joint.likelihood import EXTENT_WEIGHT, JointFrames, MarginalLikelihood
from isa_nrsfm._joint.prior import ShapePrior
from isa_nrsfm._joint.problem import JointFit, JointProblem, JointState, refine_joint
from isa_nrsfm._joint.settings import FitSettings
from isa_nrsfm._joint.starts import camera_moments, other_depths, steadied, stretched
from isa_nrsfm._joint.whole import FAR_FRAMES, extended, n_directions, relative_change
from isa_nrsfm._linalg import OF_DISTANCES, centred, lengths
from isa_nrsfm._prepare.robust import frame_weights, robust_sizes
from isa_nrsfm._prepare.scaling import ScaledTable
from isa_nrsfm._tables import (
    FEWEST_POINTS,
    FrameBlocks,
    representative_frames,
    seen_points,
    spread,
)

# With a robust loss, points with residuals above this threshold, in standard deviations
# of a coordinate, are left out: docs/benchmarks/README.md, "Thresholds".
OUTLYING = 4.0
# Directions of the coefficients with a lower reliability are not supported by the
# table. Pure noise has reliability zero.
LEAST_RELIABILITY = 0.1
# Groups have equal size: docs/benchmarks/README.md, "Thresholds".
N_GROUPS = 5
# Convergence tolerance of a fit. A tolerance of 1e-6 changes determined depths by less
# than 2 %; 1e-2 understates the errors of undetermined ones.
TOL = 1e-3
# Largest numbers of frames and points of the fits. With 100 frames one deviation
# changed from 12 to 19 %. Points are assigned to groups in cubic time.
MOST_FRAMES, MOST_POINTS, MOST_DIRECTIONS = 200, 200, 16
# Floor of the noise variance of the fits, as a share of the mean square. Without noise,
# surplus basis shapes leave the depth undetermined, and fits stay near their start.
# Errors were then 30 times the deviation, with this floor 5 times. With a noise of 0.1
# %, the floor changes no deviation by more than a third.
LEAST_NOISE = 1e-6
# Factors of the depths of a fit that turns less, and of one that hardly turns:
# docs/depth.md, "How it is estimated".
DEEPER, FAR = 2.0, 1000.0


# Result of `fitted_frames`.
FrameFits = tuple[FrameBlocks, NDArray, NDArray, NDArray, float]


def inlying_rows(
    model: FrameModel, rows: FrameBlocks, most: int, weights: NDArray | None = None
) -> tuple[NDArray, FramePosterior, NDArray | None]:
    """Return about `most` frames (n, 2, J) of size one with a camera, and their fit.

    Outliers are NaN. Also returns the weights of the points of these frames, if any.
    """
    chosen = representative_frames(rows, most)
    part = np.asarray(rows.take(chosen), dtype=np.float64)
    weights = None if weights is None else weights[chosen]
    fit = model.posterior(part, covariances=False, weights=weights)
    if model.loss != "linear":
        distance = distances(part, model.shapes, *fit[:3])
        outlying = distance > OUTLYING * np.sqrt(model.noise_variance)
        part = np.where(outlying[:, None], np.nan, part)
    mask = np.isfinite(fit.motion).all(axis=(1, 2))
    return part[mask], fit.take(mask), None if weights is None else weights[mask]


def fitted_frames(
    model: FrameModel, frames: JointFrames, rows: FrameBlocks
) -> FrameFits:
    """Return the fits of all frames in blocks of FramePosterior, before the gauge.

    Also returns cameras, coefficients, the mean of their covariances (K, K), and the
    sum of the squared residuals.
    """
    if model.loss == "linear":
        shapes, camera = frames.coordinates(model.shapes), CAMERAS[model.camera]
        search = FrameSearch(shapes, camera)
        fitted = partial(search.fit, noise=model.noise_variance, starts=model.starts)
        posteriors = frames.blocks.derive(fitted)
    else:
        posteriors = rows.derive(model.posterior)
    parts = posteriors.map(
        lambda fit: (fit.motion, fit.alpha, fit.covariance.sum(0), fit.objective.sum())
    )
    M, a, covariance, objective = zip(*parts, strict=True)
    motion, alpha = np.concatenate(M), np.concatenate(a)
    total = np.sum(covariance, axis=0) / posteriors.n_frames
    residual = float(sum(objective) - model.noise_variance * np.sum(alpha**2))
    return posteriors, motion, alpha, total, residual


def shape_information(
    motion: NDArray,
    alpha: NDArray,
    covariance: NDArray,
    share: NDArray,
    slices: Sequence[slice],
) -> NDArray:
    """Return the information on a point of the shapes for noise of variance one.

    It is ``sum_i share_i E_i (x) M_i^T M_i``, with the second moments E_i of (1, alpha)
    and the mean weight of the points of frame i, zero for missing ones. The sum is over
    slices of frames.
    """
    seen = np.einsum("i,ira,irb->ab", share, motion, motion, optimize=True)
    information = np.kron(np.pad(covariance, ((1, 0), (1, 0))), seen)
    for frames in slices:
        X = stacked_motion(motion[frames], alpha[frames])
        information += X.T @ (np.repeat(share[frames], 2)[:, None] * X)
    return information


def frame_certainty(
    frames: FrameModel, fits: FrameFits, n_seen: NDArray, weight: NDArray, n_used: float
) -> DepthCertainty:
    """Return the certainty with that of the residuals of frames.

    n_seen (n,): numbers of seen points. weight (n,): sums of their weights. n_used:
    number of coordinates that determine the shapes. Camera,
    position and coefficients fit a part of the coordinates of a frame. All other
    coordinates determine the shapes, whose errors in an image are
    proportional to the leverage of the frame. The noise variance neglects that the
    coefficients fit noise, too, but not with a robust loss, nor at its floor.
    """
    *_, alpha, covariance, residual = fits
    certainty, mean = frames.certainty, float(leverages(alpha).mean())
    numbers = 2.0 * n_seen.sum()
    n_own = 2 + CAMERAS[frames.camera].n_parameters + np.trace(1 - covariance)
    left = max(numbers - len(alpha) * n_own, 0.1 * numbers)
    noise = frames.noise_variance
    if frames.loss == "linear":
        noise = max(noise, residual / max(left - n_used, 0.1 * numbers))
    ratio, square = noise / frames.noise_variance, residual / weight.sum()
    images = ratio, ratio * n_used / left / mean
    # Of coefficients from the images
    leverage = None if certainty.leverage is None else mean
    return certainty._replace(residual=square, leverage=leverage, images=images)


def shown_frames(
    posterior: FramePosterior, *numbers: NDArray, frames: FrameModel, inverse: NDArray
) -> tuple[Decomposition, NDArray, float]:
    """Return fits in the gauge, and the effect of their noise on their coefficients.

    numbers: sizes of frames (n,), of seen points, and sums of the weights of these.
    inverse (p, p): that of the information on a point of the shapes.

    The noise of frame i changes the shapes by ``N^-1 X_i^T``, ``X_i = (1, alpha_i) (x)
    M_i``. This shifts the coefficients of the frame by ``w_i s2_i Sigma_i / s2 tr(M_i
    (N^-1 X_i^T)_k)`` on average, with the sum w_i of the weights of its points. The
    second result (K, K) is the sum over the frames of ``alpha_i`` times that shift
    times s2, the third the sum of s2_i.
    """
    motion, alpha, (sizes, n_seen, weight) = posterior.motion, posterior.alpha, numbers
    X = stacked_motion(motion, alpha).reshape(len(alpha), 2, -1)
    Z = X @ inverse
    # Degrees of freedom of the residual, without the parameters of the shapes
    leverage = np.einsum("irp,irp->i", X, Z)
    n_pose = 2 + CAMERAS[frames.camera].n_parameters
    mean = weight / n_seen
    freedom = np.maximum(n_seen * (2.0 - mean * leverage) - n_pose, 1.0)
    noise = posterior.objective / mean / freedom
    traces = np.einsum("ira,irka->ik", motion, Z.reshape(*Z.shape[:2], -1, 3))[:, 1:]
    shift = np.einsum("i,ikl,il->ik", weight * noise, posterior.covariance, traces)
    return frames.shown(posterior, sizes), alpha.T @ shift, float(noise.sum())


def reliabilities(
    alpha: NDArray, covariance: NDArray, moments: NDArray, noise: float
) -> NDArray:
    """
    Return the shares of the variance of coefficients that are signal.

    These are squared correlations (K,) of the coefficients alpha (I, K) with the true
    ones, along uncorrelated directions, decreasing. The covariance is the mean
    posterior one; moments and noise are sums over the blocks of `shown_frames`.

    With known shapes they are the eigenvalues of ``(S + C)^-1 S``, with S the second
    moment of the coefficients and C the mean covariance: ``S + C`` is the whole
    variance. Estimated shapes follow the noise. A shape of ``gamma`` numbers a frame
    raises the variance along it from ``1 + l`` to ``y = (1 + l) (1 + gamma / l)`` noise
    variances, and noise alone to ``(1 + sqrt(gamma))^2``. The squared correlation is
    ``(l^2 - gamma) / (l (l + 1))`` (Benaych-Georges, Nadakuditi, "The singular values
    and vectors of low rank perturbations of large rectangular random matrices", 2012).
    Here ``y = 1 / (1 - share)``; gamma is y times the share of S that is chance.
    """
    root = alpha / np.sqrt(len(alpha))  # root.T @ root is S
    variance, axes = np.linalg.eigh(root.T @ root + covariance)
    kept = variance > 1e-14 * variance[-1]  # others are rounding errors
    white = axes[:, kept] / np.sqrt(variance[kept])
    # Squared singular values are the eigenvalues, with less rounding error.
    _, deviations, turn = np.linalg.svd(root @ white, full_matrices=False)
    directions = white @ turn.T
    share = deviations**2
    left = np.einsum("kd,kl,ld->d", directions, covariance, directions)  # 1 / y
    caused = np.einsum("kd,kl,ld->d", directions, moments, directions) / (noise or 1.0)
    # The factor is a margin for chance. With it all reliabilities are zero on tables of
    # rigid objects (60 to 1,000 frames, 68 to 478 points, one to four basis shapes).
    # Without it some are 0.9 (``python -m benchmarks.recovery rigid``).
    gamma = 1.5 * np.maximum(caused, 0.0)  # gamma share / y
    gamma = np.divide(gamma, share, where=share > 0, out=np.ones_like(share))
    excess = share - gamma
    real = (excess > 0) & (excess**2 > 4 * gamma * left)
    excess, gamma, left = excess[real], gamma[real], left[real]
    signal = (excess + np.sqrt(excess**2 - 4 * gamma * left)) / 2  # l / y
    correlation = (signal**2 - gamma * left) / (signal * (signal + left))
    shares = np.zeros(len(kept))
    shares[: len(signal)] = np.sort(correlation)[::-1]
    return shares


def n_reliable(reliability: NDArray) -> int:
    """Return the number of directions of the coefficients that a table supports."""
    return int(np.sum(reliability >= LEAST_RELIABILITY))


def depth_certainty(
    frames: FrameModel, table: ScaledTable, joint: JointFit, settings: FitSettings
) -> DepthCertainty:
    """Estimate the errors of the model of a joint fit from some frames, if enough."""
    limits, widths, prior = settings.limits, joint.widths, settings.shape_prior
    part, fit, w = inlying_rows(frames, table.rows, MOST_FRAMES, table.weights)
    n_points = frames.shapes.shape[2]
    points = np.linspace(0, n_points - 1, min(n_points, MOST_POINTS)).astype(int)
    part, mean_shape = part[:, :, points], frames.shapes[0][:, points]
    groups, seen = neighbours(mean_shape), seen_points(part)
    parts = [groups != group for group in range(N_GROUPS)]
    n_seen = np.min([seen[:, kept].sum(axis=1) for kept in parts], axis=0)
    mask = n_seen >= FEWEST_POINTS
    if mask.sum() < 2:
        return NOT_ESTIMATED
    w = None if w is None else w[np.ix_(mask, points)]
    # Directions are sorted by their size, and as many as these frames determine.
    n_max = MOST_DIRECTIONS if prior is None else len(frames.shapes)
    shapes, motion = frames.shapes[: n_max + 1, :, points], fit.motion[mask]
    tracks, camera = part[mask], CAMERAS[frames.camera]
    prior = None if prior is None else prior.of_points(points)
    extents = EXTENT_WEIGHT if prior is None else 0.0  # a prior limits depths

    def refit(
        kept: NDArray,
        start: JointState | None = None,
        prior: ShapePrior | None = prior,
        **changes: Any,
    ) -> tuple[JointState, NDArray, NDArray, float]:
        """Fit the kept points by a few steps, by default from the fit of all points.

        Returns the state, rotations (I, 3, 3), centred depths (I, n_kept) and the
        objective for each frame, without the prior of the extents. `changes` are those
        of the likelihood.
        """
        counts = None if w is None else w[:, kept]
        part = JointFrames.of_rows(tracks[:, :, kept], counts)
        n_numbers, energy = part.totals
        noise = max(frames.noise_variance, LEAST_NOISE * energy / n_numbers)
        if start is None:
            start = JointState(centred(shapes[:, :, kept]), motion, noise)
        if prior is not None:
            likelihood = MarginalLikelihood(part, prior=prior.of_points(kept))
        elif widths is not None:
            part_widths = widths.of_points(int(kept.sum()), n_max)
            likelihood = part_widths.likelihood(part, frames.camera)
        else:
            likelihood = MarginalLikelihood(part, part.basis_penalty(limits.basis_std))
        likelihood = likelihood._replace(**changes)
        floor = min(noise * n_numbers / energy, limits.least_noise)
        start = start._replace(noise=noise)
        ends: Any = {"least_noise": floor, "max_iter": limits.error_steps, "tol": TOL}
        state = refine_joint(likelihood, start, camera, **ends).state
        terms = likelihood._replace(extent_weight=0.0)(*state)
        rotations, _ = full_rotations(state.motion)
        return state, rotations, state.depths(terms.alpha), terms.value / len(tracks)

    every = np.ones(len(points), dtype=bool)
    whole, rotations, depths, value = refit(every, extent_weight=extents)
    quiet = settings._replace(on_step=None)
    problem = JointProblem(JointFrames.of_rows(tracks, w), quiet)
    deformation = joint.rivals + reversal_error(problem, whole, depths)
    if prior is None:
        free: dict[str, Any] = {}
        if widths is not None:  # a prior of images, in place of that of points
            free = {"precisions": None, "penalty": image_penalty(whole)}
        deformation += turning_error(partial(refit, every, **free), whole, camera)
    else:
        costs, stretches = [0.5 * prior.cost], [0.0]
        for start, other, change in other_depths(whole, camera, prior):
            rise = refit(every, start, prior=other)[-1] - value
            costs.append(0.5 * other.cost + FAR_FRAMES * rise)
            stretches.append(change)
        deformation += float(softmax(-np.array(costs)) @ stretches)
    fits = [refit(kept) for kept in parts]
    centre = depths if prior is not None else mean_depths(parts, fits, depths)
    total, turns, variances = 0.0, np.zeros((3, 3)), np.zeros(len(points))
    for kept, (_, turned, z, _) in zip(parts, fits, strict=True):
        square, turn, squares = differences(turned, z, rotations, centre[:, kept])
        total, turns = total + square, turns + turn
        variances[kept] += squares
    factor = (N_GROUPS - 1) / N_GROUPS
    # Each point is left out of one of the fits: its factor is one.
    variances += deformation * np.mean(depths**2, axis=0)
    nearest = cdist(frames.shapes[0].T, mean_shape.T).argmin(axis=1)
    total = float(np.sqrt(factor * total + deformation))
    return DepthCertainty(total, deformation, factor * turns, variances[nearest])


def turning_error(
    refit: Callable[[JointState], tuple[Any, Any, NDArray, float]],
    state: JointState,
    camera: CameraModel,
) -> float:
    """Return the squared error of depths if cameras turn less and shapes are deeper.

    `refit` fits all points from a state, and returns depths and the objective at last.
    """
    _, _, found, value = refit(state)
    # Some frames may be seen from behind: also from cameras that turn less.
    still = state._replace(motion=steadied(state.motion))
    errors = []
    for start, factor in (state, DEEPER), (state, FAR), (still, FAR):
        _, _, z, end = refit(stretched(start, camera, factor)[0])
        probability = np.exp(-FAR_FRAMES * max(end - value, 0.0))
        errors.append(float(min(relative_change(found, z), 1.0) * probability))
    return max(errors)


def reversal_error(problem: JointProblem, state: JointState, depths: NDArray) -> float:
    """Return the mean squared error of depths (I, J) by frames that may be reversed.

    Relative to their mean square. Shapes keep the frames that they fit on their sides,
    so each fifth of the frames is compared under shapes that fit the others, from the
    mean shape, or from all shapes with a prior.
    """
    shapes, motion, noise = state
    n_folds = min(N_GROUPS, len(motion))
    fold = np.random.RandomState(0).permutation(len(motion)) % n_folds
    known = shapes if problem.settings.shape_prior is not None else shapes[:1]
    total = 0.0
    for number in range(n_folds):
        own, others = np.flatnonzero(fold == number), np.flatnonzero(fold != number)
        part = problem.part(others, problem.settings.tol)
        n = min(len(shapes) - 1, n_directions(part, shapes.shape[2], few=True))
        fit = extended(part, JointState(known, motion[others], noise), n)
        part = problem.part(own, problem.settings.tol)
        errors = part.reversal_errors(fit.state._replace(motion=motion[own]))
        total += float(errors @ np.sum(depths[own] ** 2, axis=1))
    return total / max(np.sum(depths**2), 1e-300)


def mean_depths(
    parts: Sequence[NDArray], fits: Sequence[Any], depths: NDArray
) -> NDArray:
    """Return the mean depths (I, n) of fits of parts of the points, mirrored alike."""
    total, number = np.zeros(depths.shape), np.sum(parts, axis=0)
    for kept, (_, _, z, _) in zip(parts, fits, strict=True):
        whole = depths[:, kept]
        mirror = np.copysign(1.0, np.sum(z * centred(whole)))
        total[:, kept] += mirror * z + whole.mean(axis=1, keepdims=True)
    return total / number


def differences(
    rotations: NDArray, depths: NDArray, whole_rotations: NDArray, whole_depths: NDArray
) -> tuple[float, NDArray, NDArray]:
    """Compute squared differences of a fit of some points from that of all points.

    Relative square of the depths (I, n); mean products of the rotation vectors (3, 3);
    mean squares of the depths (n,).
    """
    z = centred(whole_depths)
    mirror = np.array([1.0, 1.0, np.copysign(1.0, np.sum(depths * z))])
    difference = mirror[2] * depths - z
    # Rotations up to a common rotation of the object
    turned = Rotation.from_matrix(mirror[:, None] * rotations * mirror)
    whole = Rotation.from_matrix(whole_rotations)
    w = (turned * (turned.inv() * whole).mean() * whole.inv()).as_rotvec()
    turns = w.T @ w / len(w)
    turns[2, :2] = turns[:2, 2] = 0.0  # the mirror image has the other sign
    # Without any depths the difference is as large as they are.
    square = np.sum(difference**2) / np.sum(z**2) if z.any() else 1.0
    return float(square), turns, np.mean(difference**2, axis=0)


def image_penalty(state: JointState) -> NDArray:
    """Return factors (K,) of the prior of basis shapes by their images, not depths.

    A prior that limits depths would make those of other explanations less likely.
    """
    C, basis = camera_moments(state.motion), state.shapes[1:]
    energy = np.einsum("ab,kaj,kbj->k", C, basis, basis, optimize=True)
    floor = OF_DISTANCES * max(np.sum(state.shapes[0] ** 2), OF_DISTANCES)
    return basis[0].size / np.maximum(energy, floor) / len(state.motion)


def neighbours(points: NDArray) -> NDArray:
    """Assign points (3, n_points) to groups of equal size around distant points."""
    points = centred(points).T
    centres = [np.argmax(np.sum(points**2, axis=1))]
    while len(centres) < N_GROUPS:
        centres.append(np.argmax(cdist(points, points[centres]).min(axis=1)))
    places = np.sort(np.arange(len(points)) % N_GROUPS)
    squares = cdist(points, points[centres][places], "sqeuclidean")
    return places[linear_sum_assignment(squares)[1]]


# Groups are divided into 15 parts at random, which 15 halves have or have not.
SIGNS = hadamard(16)[1:, 1:]
# Change of converged shapes over that of one step of expectation maximisation:
# docs/stability.md, "How it is estimated".
PER_STEP = 4.0
# Numbers of frames and points by which the gauges of halves are compared.
HALF_FRAMES, HALF_POINTS = 5000, 500


class HalfTables(NamedTuple):
    """Shapes of halves of a table, and frames of it, before the gauge.

    shapes (n_halves, n, 3, J). halves (n_halves, I): whether a half has a frame.
    motion (I, 2, 3), alpha (I, n - 1). kind: further arguments of `independent_gauge`.
    """

    shapes: NDArray
    halves: NDArray
    motion: NDArray
    alpha: NDArray
    kind: tuple[Any, ...]


def half_tables(
    table: ScaledTable,
    model: FrameModel,
    motion: NDArray,
    alpha: NDArray,
    inverse: NDArray,
    groups: NDArray | None,
    kind: tuple[Any, ...],
) -> HalfTables | None:
    """Return the halves of a table; None if it has fewer than four groups.

    inverse (3 n, 3 n): that of the information on a point. groups (n_rows,): numbers.
    """
    units = np.arange(len(alpha))
    if groups is not None:
        units = np.unique(groups[table.shown], return_inverse=True)[1]
    if units.max() < 3:
        return None
    part = (np.random.RandomState(0).permutation(units.max() + 1) % len(SIGNS))[units]
    shapes, n_shapes = model.shapes, len(model.shapes)

    def scores(
        rows: NDArray, part: NDArray, motion: NDArray, alpha: NDArray, *weights: NDArray
    ) -> NDArray:
        """Return ``sum_i X_i^T r_i`` over the frames of each part."""
        seen = seen_points(rows)
        w = weights[0] if weights else seen.astype(float)
        residual = centred_residuals(rows, w, shapes, motion, alpha)
        if model.loss != "linear":
            deviation, sizes = np.sqrt(model.noise_variance), robust_sizes(rows)
            w = seen * frame_weights(model.loss, lengths(residual), deviation, sizes)
        residual = np.nan_to_num(residual) * w[:, None]
        X = stacked_motion(motion, alpha).reshape(*residual.shape[:2], -1)
        chosen = [part == number for number in range(len(SIGNS))]
        parts = ((X[frames], residual[frames]) for frames in chosen)
        return np.stack([np.tensordot(x, r, axes=((0, 1), (0, 1))) for x, r in parts])

    weights = () if table.weights is None else (table.weights,)
    total = sum(table.rows.map(scores, part, motion, alpha, *weights))
    steps = inverse @ np.tensordot(SIGNS, total, 1)
    # Mixtures of the shapes themselves are left to the gauge.
    flat, steps = shapes.reshape(n_shapes, -1), steps.reshape(len(SIGNS), n_shapes, -1)
    steps = PER_STEP * (steps - steps @ np.linalg.pinv(flat) @ flat)
    points = spread(np.arange(shapes.shape[2]), HALF_POINTS)
    moved = (shapes + steps.reshape(-1, *shapes.shape))[..., points]
    frames = spread(np.arange(len(alpha)), HALF_FRAMES)
    halves = SIGNS[:, part[frames]] > 0
    return HalfTables(centred(moved), halves, motion[frames], alpha[frames], kind)
