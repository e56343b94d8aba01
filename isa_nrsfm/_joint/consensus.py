"""Consensus of fits of overlapping groups of neighbouring points.

K basis shapes of all points are a poor prior of a body, whose limbs move by themselves.
Neighbouring points have a simpler model, with rotations of their own:

1. Each point and the points nearest to it are a group, in three sizes.
2. Each larger group is fitted by itself, from the cameras of the joint fit and of fits
   from other starts. Their errors differ, and their mean has smaller ones.
3. The depths z of a frame minimise ``sum_g ||P (z_g - d_g)||^2`` over the groups g,
   with the depths d_g of the fit of a group. P subtracts the mean.
4. All groups are fitted together from there, with depths that are common to all
   (`common_coordinates`).
5. The depths are a mean of these and of the joint fit, weighted by the errors of hidden
   points. The mean and the principal components of the shapes are the new model.

The mean squared difference of the depths of a point in its groups from the result
estimates its squared error: docs/benchmarks/consensus.md.

**Common depths.** The points of group g have coordinates ``Y_gi = R_gi C_gi`` in frame
i, up to their mean, with a rotation R_gi of the group and shapes ``C_gi ~ N(mu_g,
Sigma_g)``. The eigenvalues of Sigma_g are at least the noise variance s2. Depths, and x
and y of missing points, are the same in all groups. They maximise, with R, mu and
Sigma, ::

    prod_gi N(R_gi^T Y_gi; mu_g, Sigma_g).

Steps alternate between the probabilistic principal components of each group (Tipping,
Bishop, 1999), and Gauss-Newton steps of rotations and coordinates, one axis of the
coordinates at a time. The rotations are eliminated from these (variable projection:
Golub, Pereyra, 1973): a group that is tilted turns with its depths.
"""

from collections.abc import Callable, Iterator
from dataclasses import replace
from functools import partial
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.distance import cdist
from sklearn.utils.parallel import Parallel, delayed

from isa_nrsfm._compat.scikit_learn import one_blas_thread
from isa_nrsfm._frames import camera_models
from isa_nrsfm._frames.models import NOT_ESTIMATED, FrameModel
from isa_nrsfm._joint.likelihood import JointFrames, MarginalLikelihood
from isa_nrsfm._joint.problem import JointFit, JointState, refine_joint
from isa_nrsfm._joint.settings import FitSettings
from isa_nrsfm._joint.starts import lifted_shapes, likely_basis
from isa_nrsfm._joint.uncertainty import depth_certainty, inlying_rows
from isa_nrsfm._linalg import (
    COLUMNS,
    OF_DISTANCES,
    ROWS,
    centred,
    frames_first,
    frames_last,
    inverse3,
    packed_products,
    pair_indices,
    procrustes,
    unpacked,
)
from isa_nrsfm._prepare.scaling import ScaledTable
from isa_nrsfm._tables import FEWEST_POINTS, spread

# Frames and points of a group
Indices = tuple[NDArray, NDArray]
# Steps, and the share of the noise floor in the last one (docs/benchmarks/consensus.md)
STEPS, LAST_SHARE = 30, 0.2
# Weight of the first coordinates, or of the joint fit, among the groups. It matters
# for points that no group determines.
WEIGHT_OF_WHOLE = 1e-3


def common_coordinates(
    images: NDArray, first: NDArray, groups: list[Indices], noise: float, floor: float
) -> NDArray:
    """Return coordinates (I, 3, n) of images (I, 2, n), NaN where points are missing.

    They start from the first ones (I, 3, n). Groups are indices of frames and points.
    The noise variance includes its floor, which falls from step to step.
    """
    unknown = np.concatenate([np.isnan(images), np.ones_like(images[:, :1], bool)], 1)
    # From here on the frame is the last index: coordinates (n, 3, I), rotations (3, 3,
    # n_frames).
    unknown, first = unknown.transpose(2, 1, 0), first.transpose(2, 1, 0)
    Y = np.where(unknown, first, 0.0)
    Y[:, :2] += np.nan_to_num(images.transpose(2, 1, 0))
    axes = [axis for axis in range(3) if unknown[:, axis].any()]
    n_points, _, n_frames = Y.shape
    # Zero in frames that do not show the group, which therefore do not count
    rotations = [
        np.isin(np.arange(n_frames), frames) * _aligning(_of_group(Y, points))
        for frames, points in groups
    ]
    # Precisions are packed.
    first_of, second_of = pair_indices(n_points)
    places = unpacked(np.arange(len(first_of)))
    precisions = np.empty((len(axes), len(first_of), n_frames))
    for step in range(STEPS):
        s2 = noise - floor + floor * LAST_SHARE ** (step / (STEPS - 1))
        precisions[:] = 0.0
        precisions[:, np.diagonal(places)] = WEIGHT_OF_WHOLE / s2
        gradient = WEIGHT_OF_WHOLE / s2 * (first - Y)
        turns = []
        for R, (_, points) in zip(rotations, groups, strict=True):
            shapes = np.einsum("jai,abi->jbi", _of_group(Y, points), R)
            precision, slope, pulled, inverse, w = _turns(shapes, s2)
            n = len(points)
            mixed = np.einsum("abi,kjbi->ajki", R, pulled.reshape(3, n, 3, -1))
            turns.append((R, points, w, inverse, mixed))
            # Without the turns, which follow the coordinates
            slope = np.einsum("abi,jbi->jai", R, slope)
            slope -= np.einsum("ajki,ki->jai", mixed, w)
            gradient[points] += slope
            weights = precision.reshape(n, 3, n, 3).transpose(0, 2, 1, 3)
            weights = weights[pair_indices(n)].reshape(-1, 9)
            own_places = places[np.ix_(points, points)][pair_indices(n)]
            for axis, total in zip(axes, precisions, strict=True):
                group_precision = weights @ (R[axis, :, None] * R[axis]).reshape(9, -1)
                following = np.einsum("kli,jli->jki", inverse, mixed[axis])
                group_precision -= packed_products(mixed[axis], following)
                total[own_places] += group_precision
        change = np.zeros_like(Y)
        for axis, total in zip(axes, precisions, strict=True):
            free = unknown[:, axis]
            total[~(free[first_of] & free[second_of])] = 0.0
            total[np.diagonal(places)] += ~free
            slope = np.where(free, gradient[:, axis], 0.0)
            A = frames_first(unpacked(total))
            change[:, axis] = np.linalg.solve(A, slope.T[..., None])[..., 0].T
        Y += change
        for R, points, w, inverse, mixed in turns:
            pull = np.einsum("ajki,jai->ki", mixed, _of_group(change, points))
            R[:] = camera_models.rotated(R, w - np.einsum("kli,li->ki", inverse, pull))
    return np.ascontiguousarray(Y.transpose(2, 1, 0))


def aligning_rotations(S: NDArray, s2: float) -> NDArray:
    """Return rotations R (I, 3, 3) with likeliest ``R^T S_i ~ N(mu, Sigma)``.

    The shapes S (I, 3, n) are centred, and the noise variance is s2.
    """
    R = np.repeat(np.eye(3)[:, :, None], len(S), axis=2)
    for _ in range(STEPS):
        R = camera_models.rotated(R, _turns(np.einsum("iaj,abi->jbi", S, R), s2)[-1])
    return frames_first(R)


def _turns(shapes: NDArray, s2: float) -> tuple[NDArray, ...]:
    """Return the terms of Gauss-Newton steps ``exp(hat(w))`` of shapes (n, 3, I).

    The precision (3n, 3n) and slope (n, 3, I) of the shapes, the precision times the
    derivatives of the shapes by w (3, 3n, I), the inverse curvature (3, 3, I), and w
    (3, I).
    """
    precision, slope = _principal(shapes, s2)
    D = camera_models.turning(shapes).reshape(3, len(precision), -1)
    pulled = precision @ D
    inverse = inverse3(np.einsum("kai,lai->kli", D, pulled)[ROWS, COLUMNS])
    w = np.einsum("kai,ai->ki", D, slope.reshape(len(precision), -1))
    return precision, slope, pulled, inverse, np.einsum("kli,li->ki", inverse, w)


def _principal(shapes: NDArray, s2: float) -> tuple[NDArray, NDArray]:
    """Return the precision of shapes (n, 3, I), and its product with their deviations.

    With eigenvectors U and eigenvalues v above s2 of the covariance, the precision (3n,
    3n) is ``(I - U (1 - s2 / v) U^T) / s2``. The deviations (n, 3, I) are those of the
    mean from the shapes. Shapes of zeros do not count.
    """
    n, mask = len(shapes), shapes.any(axis=(0, 1))
    n_frames = np.count_nonzero(mask)
    mean = shapes.sum(axis=2, keepdims=True) / n_frames
    deviations = (mask * mean - shapes).reshape(3 * n, -1)
    values, vectors = np.linalg.eigh(deviations @ deviations.T / n_frames)
    kept = values > s2
    U = vectors[:, kept]
    centring = (np.eye(n) - 1.0 / n)[:, None, :, None] * np.eye(3)[:, None]
    model = (U * (1.0 - s2 / values[kept])) @ U.T
    precision = (centring.reshape(model.shape) - model) / s2
    return precision, (precision @ deviations).reshape(shapes.shape)


def _of_group(Y: NDArray, points: NDArray) -> NDArray:
    """Return the centred coordinates (n, 3, I) of the points of a group."""
    coordinates = Y[points]
    return np.asarray(coordinates - coordinates.mean(axis=0))


def _aligning(shapes: NDArray) -> NDArray:
    """Return rotations (3, 3, n_frames) that align shapes (n, 3, n_frames)."""
    shapes = shapes.transpose(2, 1, 0)
    mean = shapes[0]
    for _ in range(5):
        R = procrustes(shapes @ mean.T)
        mean = (R.mT @ shapes).mean(axis=0)
    return frames_last(R)


# docs/benchmarks/consensus.md has the errors with other values of these constants.
# Numbers of points of the groups without and with a fit of their own, and the largest
# share of all points. Groups that share nearly all points agree, however large their
# error. Groups have as many basis shapes as the joint fit.
SMALLEST, SIZES, LARGEST_SHARE = 6, (12, 30), 0.75
# Groups that contain a point, on average, of each size
COVER = 4
# Weight of the mean distance of two points beside its standard deviation, in the
# choice of neighbours: of two rigidly connected points the near one comes first.
NEARNESS = 0.15
# Floor of the noise variance of the groups, as a share of that of the joint fit
FLOOR_SHARE = 0.2
# Steps without the prior of the basis shapes, and most steps after them
FREE_STEPS, MOST_STEPS = 30, 300
# Largest numbers of frames and of points of the groups
MOST_FRAMES, MOST_POINTS = 500, 100
# Frames whose points are hidden
HIDDEN_FRAMES = 60
# Mean square that free numbers of components leave, as a share of the noise variance
LEFT = 0.01
# Largest number of basis shapes of first fits, and of the consensus
MOST_FIRST, MOST_COMPONENTS = 12, 60


class Scene(NamedTuple):
    """Some frames and points of a table, and their joint fit, in the axes of cameras.

    rows (I, 2, n): frames, NaN where a point is missing. first (I, 3, n): coordinates
    of the joint fit, depth last. motion (I, 2, 3): its cameras. price: penalty of the
    prior of basis shapes, times the number of frames. floor: floor of the noise.
    """

    rows: NDArray
    first: NDArray
    motion: NDArray
    price: float
    floor: float


class Group(NamedTuple):
    """Fit of a group of points, in the axes of the cameras.

    points (n,), frames (n_frames,): indices. coordinates (n_frames, 3, n): x, y and
    depth. start: index of the fit whose cameras it started from. weight: number of the
    points that have this group as neighbours, times the weight of that fit.
    """

    points: NDArray
    weight: float
    frames: NDArray
    coordinates: NDArray
    noise: float
    start: int = 0

    def differences(self, depths: NDArray) -> NDArray:
        """Return differences (n_frames, n) from depths (I, J), up to their means."""
        own_depths = depths[np.ix_(self.frames, self.points)]
        return centred(self.coordinates[:, 2] - own_depths)


def consensus(
    model: FrameModel,
    table: ScaledTable,
    settings: FitSettings,
    joint: JointFit,
    others: Callable[[], list[tuple[float, JointState]]],
) -> FrameModel:
    """Fit groups of neighbouring points, and return the model that merges them.

    The given model is a joint fit of the table with calibrated cameras, and others()
    are fits from other starts, with their weights. The result has all principal
    components that exceed the noise. The errors of the depths of the joint fit are
    estimated, if wanted and not known, while other processes fit groups.
    """
    part, fit, _ = inlying_rows(model, table.rows, MOST_FRAMES)
    # Shapes of the joint fit, in the axes of the object and of the cameras
    shapes = camera_models.compose(model.shapes[0], model.shapes[1:], fit.alpha)
    rotations, scales = camera_models.full_rotations(fit.motion)
    first = scales[:, None, None] * rotations @ shapes
    first[:, :2] += fit.translation[:, :, None]
    # Groups of some of the points
    n_points, limits = part.shape[2], settings.limits
    chosen = spread(np.arange(n_points), MOST_POINTS)
    mean_square = float(np.nanmean(part**2))
    price = 1.0 / (limits.basis_std**2 * mean_square)
    floor = FLOOR_SHARE * limits.least_noise * mean_square
    scene = Scene(part[:, :, chosen], first[:, :, chosen], fit.motion, price, floor)
    noise, certainty = model.noise_variance, model.certainty
    begun: Any = (), ()
    distances = neighbour_distances(shapes[:, :, chosen])
    # Groups, with their floor, cannot improve the fit of a table without noise. Fits of
    # other tables end at this floor or above it, up to rounding.
    if noise > 0.5 * scene.floor:
        n_components = min(len(model.shapes) - 1, MOST_FIRST)
        starts = [(1.0, fit.motion)]
        starts += [(share, seen_by(model, state, part)) for share, state in others()]
        begun = group_fits(scene, starts, distances, n_components, settings)
    if settings.errors and certainty is NOT_ESTIMATED:
        certainty = depth_certainty(model, table, joint, settings)
    groups = []
    for (points, weight, start), result in zip(*begun, strict=True):
        if settings.on_step is not None:
            settings.on_step()
        if result is not None:
            groups.append(Group(points, weight, *result)._replace(start=start))
    n_max = min(3 * n_points - 7, MOST_COMPONENTS)

    def modelled(S: NDArray, noise: float) -> FrameModel:
        """Return the model of shapes (I, 3, J): their principal components."""
        found, alpha, remainder = principal_shapes(S, n_max, LEFT * noise)
        return model.with_shapes(found, noise + remainder, alpha)

    if not groups:
        return replace(modelled(shapes, noise), certainty=certainty)
    noise = max(float(np.mean([group.noise for group in groups])), scene.floor)
    share = 1.0 - scene.floor / noise
    groups = weighted(scene, groups)
    joined = together(scene, groups, distances, scales, noise)
    noise -= (1.0 - LAST_SHARE) * scene.floor
    weights = interpolation(model.shapes[0], chosen)
    left_out = np.setdiff1d(np.arange(n_points), chosen)
    image_changes = (1.0 - share) * np.nan_to_num(part - first[:, :2])

    def merged(joined: NDArray) -> FrameModel:
        """Return the model of coordinates (I, 3, n) in the axes of the cameras."""
        change = (joined - scene.first) @ weights
        change[:, :2, left_out] = image_changes[:, :, left_out]
        S = shapes + rotations.mT @ centred(change) / scales[:, None, None]
        R = aligning_rotations(centred(S[:, :, chosen]), noise)
        return modelled(R.mT @ S, noise)

    # The joint fit has a share of the depths.
    sample = spread(np.arange(len(part)), HIDDEN_FRAMES)
    result = merged(joined)
    joint_share = share_of_first(model, result, part[sample])
    joined[:, 2] += joint_share * (centred(scene.first[:, 2]) - centred(joined[:, 2]))
    depths = centred(joined[:, 2] @ weights)
    squares = disagreements(groups, joined[:, 2])
    # Groups start from one fit and share a part of its errors.
    nearer = squares.sum() / disagreements(groups, scene.first[:, 2]).sum()
    squares, depths = squares @ weights, np.mean(depths**2, axis=0)
    certainty = certainty.of_consensus(squares, depths, min(nearer, 1.0))
    result = merged(joined) if joint_share else result
    return replace(result, certainty=certainty)


def share_of_first(first: FrameModel, second: FrameModel, rows: NDArray) -> float:
    """Return the share of the first of two models in the mean of both, at most a half.

    Half the share with which their mean predicts hidden points of rows (n, 2, J) best
    (stacked regressions: Breiman, 1996), by least squares.
    """
    one, other = hidden_residuals(first, rows), hidden_residuals(second, rows)
    change = other - one
    square = np.nansum(change**2)
    best = np.nansum(other * change) / square if square > 0 else 0.0
    return float(0.5 * np.clip(best, 0.0, 1.0))


def hidden_residuals(model: FrameModel, rows: NDArray) -> NDArray:
    """Return residuals (n, 2, J) of points from fits of their frames without them.

    Every fifth point of rows (n, 2, J) is left out at a time.
    """
    errors = np.full(rows.shape, np.nan)
    for first in range(5):
        hidden = np.arange(rows.shape[2]) % 5 == first
        fit = model.posterior_without(rows, hidden)
        residual = camera_models.residuals(rows, model.shapes, *fit[:3])
        errors[:, :, hidden] = residual[:, :, hidden]
    return errors


def together(
    scene: Scene, groups: list[Group], distances: NDArray, scales: NDArray, noise: float
) -> NDArray:
    """Return coordinates (I, 3, n) of all groups together, also of the smallest ones.

    Camera scales are (I,); the noise variance includes its floor.
    """
    merged = merge(scene, groups, 1.0 - scene.floor / noise)
    pairs = [(g.frames, g.points) for g in groups if g.start == 0]
    for points, _ in neighbourhoods(distances, SMALLEST):
        frames = frames_showing(scene.rows[:, :, points])
        if len(frames):
            pairs.append((frames, points))
    # All frames have the mean scale of the cameras.
    unit = (scales / scales.mean())[:, None, None]
    common = unit * common_coordinates(
        scene.rows / unit, merged / unit, pairs, noise, scene.floor
    )
    free = np.isnan(scene.rows)
    merged[:, :2][free], merged[:, 2] = common[:, :2][free], common[:, 2]
    return merged


def disagreements(groups: list[Group], depths: NDArray) -> NDArray:
    """Return mean squared differences (n,) of the groups from the depths (I, n)."""
    squares, weight = np.zeros((2, depths.shape[1]))
    for group in groups:
        difference = group.differences(depths)
        squares[group.points] += group.weight * np.sum(difference**2, axis=0)
        weight[group.points] += group.weight * len(difference)
    # Points of no fitted group have the mean error of the others.
    mean = squares.sum() / weight.sum()
    return np.divide(squares, weight, out=np.full_like(weight, mean), where=weight > 0)


def seen_by(model: FrameModel, state: JointState, rows: NDArray) -> NDArray:
    """Return the cameras (I, 2, 3) with which a fit from another start sees rows."""
    none = np.empty((0, len(state.shapes) - 1))
    other = model.with_shapes(state.shapes, state.noise, none)
    return other.posterior(rows, covariances=False).motion


def group_fits(
    scene: Scene,
    starts: list[tuple[float, NDArray]],
    distances: NDArray,
    n_components: int,
    settings: FitSettings,
) -> tuple[list[tuple[NDArray, float, int]], Iterator[Any]]:
    """Begin to fit all groups from each start, a weight and cameras (I, 2, 3).

    Returns the points, weight and index of the start of each, and the fits to come.
    """
    largest = max(LARGEST_SHARE * len(distances), SIZES[0])
    sizes = [size for size in SIZES if size <= largest]
    tasks = [
        (points, count * share, start)
        for size in sizes
        for points, count in neighbourhoods(distances, size)
        for start, (share, _) in enumerate(starts)
    ]
    # What other processes need: no other fits
    quiet = settings._replace(on_step=None, start=None, placed=None, known=None)
    # In the order of memory that pickled arrays have, else rounding errors differ.
    parts = (
        scene._replace(
            rows=scene.rows.take(points, 2),
            first=scene.first.take(points, 2),
            motion=starts[start][1],
        )
        for points, _, start in tasks
    )
    run = Parallel(n_jobs=settings.n_jobs, return_as="generator")
    return tasks, run(delayed(group_fit)(part, n_components, quiet) for part in parts)


def neighbour_distances(shapes: NDArray) -> NDArray:
    """Return the distances (J, J) by which neighbours are chosen, for shapes (I, 3, J).

    The standard deviation over the frames of the distance of two points, plus a share
    of its mean.
    """
    distances = np.array([cdist(shape.T, shape.T) for shape in shapes])
    return distances.std(axis=0) + NEARNESS * distances.mean(axis=0)


def neighbourhoods(distances: NDArray, size: int) -> list[tuple[NDArray, int]]:
    """Return the different groups of points and their neighbours, and how often.

    The points are the first ones by farthest point sampling, and all points that are in
    none of their groups.
    """
    n_points = len(distances)
    nearest = np.sort(np.argsort(distances, axis=1, kind="stable")[:, :size], axis=1)
    n_first = min(-(-COVER * n_points // size), n_points)
    centres = [int(np.argmin(distances.sum(axis=1)))]
    covered = np.zeros(n_points, dtype=bool)
    while len(centres) < n_first or not covered.all():
        covered[nearest[centres[-1]]] = True
        if len(centres) == n_points:
            break
        left = distances[:, centres].min(axis=1)
        if len(centres) >= n_first:
            left = np.where(covered, -1.0, left)
        centres.append(int(np.argmax(left)))
    groups, counts = np.unique(nearest[centres], axis=0, return_counts=True)
    return list(zip(groups, counts.tolist(), strict=True))


@one_blas_thread()
def group_fit(
    scene: Scene, n_components: int, settings: FitSettings
) -> tuple[NDArray, NDArray, float] | None:
    """Return frames, coordinates and noise of a group; None if too few frames show it.

    In all frames with at least four visible points the group has its own rotation.
    """
    frames = frames_showing(scene.rows)
    if len(frames) <= n_components:
        return None
    seen, motion = np.isfinite(scene.rows[frames, 0]), scene.motion[frames]
    tracks, first = scene.rows[frames], scene.first[frames]
    # Start: shapes that fit the cameras, missing points as in the joint fit
    rows = centred(np.where(seen[:, None], tracks, first[:, :2]))
    shapes = centred(lifted_shapes(rows, motion, n_components))
    noise = max(0.1 * float(np.mean((rows - motion @ shapes[0]) ** 2)), scene.floor)
    start = JointState(shapes, motion, noise)
    # Fixed cameras, without the prior, which would make basis shapes vanish
    part = JointFrames.of_rows(tracks)
    free, (n_seen, square) = MarginalLikelihood(part), part.totals
    least_noise, tol = scene.floor * n_seen / square, 0.3 * settings.tol
    refined = partial(refine_joint, least_noise=least_noise, tol=tol)
    held = camera_models.AffineCameras(held=True)
    start = refined(free, start, held, max_iter=FREE_STEPS).state
    # With the prior, and a rotation of the group in each frame
    penalty = scene.price / len(frames)
    likelihood, alpha = MarginalLikelihood(part, penalty), free(*start).alpha
    shapes = likely_basis(start.shapes, motion, alpha, penalty)
    start, cameras = start._replace(shapes=shapes), camera_models.CAMERAS
    orthographic, max_iter = cameras["orthographic"], min(settings.max_iter, MOST_STEPS)
    state = refined(likelihood, start, orthographic, max_iter=max_iter).state
    alpha = likelihood(*state).alpha
    rotations, scales = camera_models.full_rotations(state.motion)
    turned = scales[:, None, None] * rotations
    S = turned @ camera_models.compose(state.shapes[0], state.shapes[1:], alpha)
    # Positions from the visible points, and the mirror image nearest to the joint fit
    sums = np.where(seen[:, None], tracks - S[:, :2], 0.0).sum(axis=2)
    S[:, :2] += (sums / seen.sum(axis=1)[:, None])[:, :, None]
    if np.sum(centred(first[:, 2]) * S[:, 2]) < 0:
        S[:, 2] *= -1.0
    return frames, S, state.noise


def frames_showing(rows: NDArray) -> NDArray:
    """Return the frames of rows (I, 2, n) with at least four visible points."""
    return np.flatnonzero(np.isfinite(rows[:, 0]).sum(axis=1) >= FEWEST_POINTS)


def weighted(scene: Scene, groups: list[Group]) -> list[Group]:
    """Return groups weighted by the inverse mean square disagreement of their kind.

    Each group disagrees with the merge of the groups of its size. Those of the same
    size and start are of one kind.
    """
    rounding = OF_DISTANCES**2 * float(np.mean(scene.first**2))
    weighted_groups = []
    for size in sorted({len(group.points) for group in groups}):
        same = [group for group in groups if len(group.points) == size]
        merged = merge(scene, same)[:, 2]
        for start in sorted({group.start for group in same}):
            kind = [group for group in same if group.start == start]
            squares = [np.mean(group.differences(merged) ** 2) for group in kind]
            square = np.average(squares, weights=[group.weight for group in kind])
            factor = 1.0 / (size * (square + rounding))
            weighted_groups += [g._replace(weight=factor * g.weight) for g in kind]
    return weighted_groups


def merge(scene: Scene, groups: list[Group], share: float = 0.0) -> NDArray:
    """Merge the coordinates of the groups into those of all points (I, 3, n).

    Depths are found by least squares, each group up to its mean. x and y are taken from
    the images, less a share of the residual; for missing points, from the groups.
    """
    n_frames, _, n_points = scene.first.shape
    # The joint fit is a further group of small weight.
    small = WEIGHT_OF_WHOLE * min((group.weight for group in groups), default=1.0)
    A = small * (np.eye(n_points) - 1.0 / n_points) + small / n_points
    A = np.tile(A, (n_frames, 1, 1))
    b = small * centred(scene.first[:, 2])
    weight, total = np.full(b.shape, small), small * scene.first[:, :2]
    for group in groups:
        frames, points = group.frames, group.points
        n, at = len(points), np.ix_(frames, points)
        A[np.ix_(frames, points, points)] += group.weight * (np.eye(n) - 1.0 / n)
        b[at] += group.weight * centred(group.coordinates[:, 2])
        weight[at] += group.weight
        images = group.weight * group.coordinates[:, :2]
        total[np.ix_(frames, np.arange(2), points)] += images
    fitted = total / weight[:, None]
    images = np.where(np.isfinite(scene.rows), scene.rows, fitted)
    depths = np.linalg.solve(A, b[:, :, None])
    images = images + share * (fitted - images)
    return np.concatenate([images, depths.mT], axis=1)


def interpolation(mean_shape: NDArray, chosen: NDArray) -> NDArray:
    """Return weights (n_chosen, J) of changes of chosen points, for all points (3, J).

    The three nearest chosen points count by their inverse squared distances.
    """
    distance = cdist(mean_shape[:, chosen].T, mean_shape.T)
    third = np.sort(distance, axis=0)[min(2, len(chosen) - 1)]
    distance = np.maximum(distance, 1e-9 * third.max())
    weights = np.where(distance <= third, distance**-2.0, 0.0)
    weights[:, chosen] = np.eye(len(chosen))
    return np.asarray(weights / weights.sum(axis=0))


def principal_shapes(
    S: NDArray, most: int, noise: float = 0.0
) -> tuple[NDArray, NDArray, float]:
    """Return mean and principal components (K + 1, 3, J) of shapes (I, 3, J).

    At most `most` components, and no more than leave a mean square of `noise`. Also
    returns the coefficients (I, K), of variance one, and the mean square that is left.
    """
    mean_shape = S.mean(axis=0)
    flat = (S - mean_shape).reshape(len(S), -1)
    U, values, Vt = np.linalg.svd(flat, full_matrices=False)
    energy = values**2 / flat.size
    left = np.append(np.cumsum(energy[::-1])[::-1], 0.0)
    enough = int(np.argmax(left <= noise)) if noise > 0 else most
    n_components = min(max(enough, 1), most)
    # Components beyond the rank are zero.
    n, root = min(n_components, len(values)), np.sqrt(len(S))
    beyond = 0, n_components - n
    basis = np.pad(values[:n, None] * Vt[:n] / root, (beyond, (0, 0)))
    alpha = np.pad(root * U[:, :n], ((0, 0), beyond))
    basis = basis.reshape(-1, *mean_shape.shape)
    return np.concatenate([mean_shape[None], basis]), alpha, float(left[n])
