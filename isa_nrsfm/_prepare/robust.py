"""Robust losses: points far from the model count less.

They are minimised by iteratively reweighted least squares (Holland, Welsch, "Robust
regression using iteratively reweighted least-squares", 1977). The weight of a point
falls with its distance from the model in units of the noise. Fit and weights alternate
until they agree.
"""

from functools import partial
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from isa_nrsfm._linalg.rounding import OF_DISTANCES
from isa_nrsfm._prepare.options import OUTLIER_OPTIONS, OutlierOptions
from isa_nrsfm._tables.blocks import FrameBlocks
from isa_nrsfm._tables.ordering import representative_frames
from isa_nrsfm._tables.visibility import seen_points

# Tuning constant c of a loss, in standard deviations of a coordinate. With these, the
# estimate of a location in the plane has 95 percent of the efficiency of least squares
# if the noise is normal.
TUNING = {"huber": 1.5011, "cauchy": 2.5486}
# Median distance of normal noise in the plane, in standard deviations of a coordinate.
MEDIAN_DISTANCE = np.sqrt(2 * np.log(2))
# Steps to the middle of the nearest half of the points, and from there to the point
# with the least sum of distances.
HALF_STEPS, MEDIAN_STEPS = 5, 40


def robust_weights(loss: str, distance: NDArray) -> NDArray:
    """
    Return the weights of points for a loss.

    Parameters
    ----------
    loss : {"linear", "huber", "cauchy"}
        The loss.
    distance : ndarray
        Distances of points from the model in standard deviations of a coordinate.

    Returns
    -------
    ndarray
        Weights between 0 and 1: for "huber" c over the distance beyond c, for "cauchy"
        ``1 / (1 + (distance / c)^2)``.
    """
    if loss == "huber":
        return TUNING[loss] / np.maximum(distance, TUNING[loss])
    if loss == "cauchy":
        return 1.0 / (1.0 + (distance / TUNING[loss]) ** 2)
    return np.ones_like(distance)


def frame_weights(
    loss: str,
    distance: NDArray,
    deviation: float,
    sizes: NDArray,
    distant: float = OUTLIER_OPTIONS.distant,
) -> NDArray:
    """
    Return the weights of the points of frames for a loss.

    Parameters
    ----------
    loss : {"huber", "cauchy"}
        The loss.
    distance : ndarray of shape (n_frames, n_points)
        Distances of points from the model; infinite for those that are missing.
    deviation : float
        Standard deviation of a coordinate.
    sizes : ndarray of shape (n_frames,)
        Sizes of the frames, as of `robust_sizes`.
    distant : float
        As of `OutlierOptions`.

    Returns
    -------
    ndarray of shape (n_frames, n_points)
        Those of `robust_weights`; zero for points farther than `distant` sizes of the
        frame from where the model shows them. Such points do not belong to the frame. A
        loss that grows without limit would bend the shapes towards them.
    """
    belongs = distance <= distant * sizes[:, None]
    return np.where(belongs, robust_weights(loss, distance / deviation), 0.0)


def median_noise(distance: NDArray) -> float:
    """Return the noise of a coordinate, as the median of distances (n,) tells it."""
    return float(np.median(distance) / MEDIAN_DISTANCE)


def distant_points(
    tracks: NDArray, distant: float = OUTLIER_OPTIONS.distant
) -> NDArray:
    """
    Tell which points are far from all others of their frame.

    Parameters
    ----------
    tracks : ndarray of shape (n_frames, n_points, 2)
        Tracks, NaN where a point is not seen.
    distant : float
        As of `OutlierOptions`.

    Returns
    -------
    ndarray of bool, shape (n_frames, n_points)
        Points whose distance from the median of their frame is more than so many times
        the frame's size (`robust_sizes`).
    """
    square = _squares(tracks)
    return np.sqrt(square) > distant * _sizes(square)[:, None]


def _squares(tracks: NDArray) -> NDArray:
    """Return squared distances (I, J) of points (I, J, 2) from their frame's median."""
    tracks = np.ascontiguousarray(tracks)  # strides change the order of sums
    return np.sum((tracks - spatial_median(tracks)[:, None]) ** 2, axis=2)


def _sizes(square: NDArray) -> NDArray:
    """Return the sizes (I,) of frames from the squared distances (I, J) of points."""
    median, upper = np.nanquantile(square, [0.5, 0.75], axis=1)
    # If half of the points coincide the median is rounding error: take the mean.
    mean = np.nanmean(square, axis=1)
    return np.sqrt(np.where(median > OF_DISTANCES * upper, median, mean) / 2)


def spatial_median(tracks: NDArray) -> NDArray:
    """
    Return the spatial median of each frame, the point with the least sum of distances.

    Parameters
    ----------
    tracks : ndarray of shape (n_frames, n_points, 2)
        Tracks, NaN where a point is not seen.

    Returns
    -------
    ndarray of shape (n_frames, 2)
        The iterate after a fixed number of steps of Weiszfeld (1937). It starts at the
        mean of the half of the points that is nearest to it: a point at any distance
        costs no digits of the others. Unlike medians of x and y it rotates with the
        image.
    """
    seen = seen_points(tracks)
    points = np.where(seen[..., None], tracks, 0.0)
    half: NDArray = seen * 1.0
    for _ in range(HALF_STEPS):
        half, distance, _ = _nearest_half(points, half, seen)
    # From here on relative to the innermost point: equal points differ by zero.
    innermost = distance.argmin(axis=1)[:, None, None]
    origin = np.take_along_axis(points, innermost, axis=1)
    points = np.where(seen[..., None], points - origin, 0.0)
    weights, distance, median = _nearest_half(points, half, seen)
    # Where half of the points are in one place, that is the median.
    least = np.where(median > 0, OF_DISTANCES * median, 1.0)
    counted = np.where(median > 0, seen, distance <= median)
    for _ in range(MEDIAN_STEPS):
        middle, distance = _weighted_middle(points, weights)
        weights = counted / np.maximum(distance, least)
    return origin[:, 0] + middle


def _nearest_half(
    points: NDArray, weights: NDArray, seen: NDArray
) -> tuple[NDArray, NDArray, NDArray]:
    """Return the half of the points nearest to the weighted mean of each frame.

    The points are (I, J, 2); weights, seen and the half, as weights 0 and 1, are
    (I, J). The distances from the mean (I, J), infinite for points not seen, and those
    of the last of the half (I, 1) come with it.
    """
    _, distance = _weighted_middle(points, weights)
    distance = np.where(seen, distance, np.inf)
    last = (seen.sum(axis=1, keepdims=True) - 1) // 2
    median = np.take_along_axis(np.sort(distance, axis=1), last, axis=1)
    return (distance <= median) * 1.0, distance, median


def _weighted_middle(points: NDArray, weights: NDArray) -> tuple[NDArray, NDArray]:
    """Return weighted means (I, 2) of points (I, J, 2), and distances (I, J) of them.

    The weights are (I, J).
    """
    share = weights / weights.sum(axis=1, keepdims=True)
    middle = np.einsum("ij,ijc->ic", share, points)
    return middle, np.linalg.norm(points - middle[:, None], axis=2)


def robustly_centred(tracks: NDArray) -> tuple[NDArray, NDArray]:
    """
    Return tracks centred at the spatial median of each frame, in double precision.

    Parameters
    ----------
    tracks : ndarray of shape (n_frames, n_points, 2)
        Tracks, NaN where a point is not seen.

    Returns
    -------
    centred : ndarray of shape (n_frames, n_points, 2)
        Tracks minus medians.
    middle : ndarray of shape (n_frames, 2)
        The medians, as of `spatial_median`.
    """
    # The same memory order, so that sums are the same to the last bit.
    tracks = np.ascontiguousarray(tracks, dtype=np.float64)
    middle = spatial_median(tracks)
    return tracks - middle[:, None], middle


def robust_sizes(centred: NDArray) -> NDArray:
    """
    Return sizes of frames that single points hardly change.

    Parameters
    ----------
    centred : ndarray of shape (n_frames, n_points, 2)
        Tracks, NaN where a point is not seen.

    Returns
    -------
    ndarray of shape (n_frames,)
        Root of half the median squared distance of the seen points from their
        `spatial_median`, or the root mean square where half of them are in one place.
    """
    return _sizes(_squares(centred))


class _RigidObject(NamedTuple):
    """A rigid factorisation, and how far from it points may be."""

    axes: NDArray  # (n_points, 3), orthonormal columns
    limit: NDArray  # (n_points,), the largest distance of a point that belongs to it
    settled: float  # the largest change of a filled-in coordinate at the end


def outliers_of_table(
    rows: FrameBlocks, n_points: int, options: OutlierOptions = OUTLIER_OPTIONS
) -> NDArray:
    """
    Tell which points of a table are far from any rigid object.

    Parameters
    ----------
    rows : FrameBlocks
        Blocks of frames (n_frames, 2, n_points), each divided by its size; NaN where a
        point is not seen.
    n_points : int
        Number of points.
    options : OutlierOptions
        Which points are gross outliers.

    Returns
    -------
    ndarray of bool, shape (n_frames, n_points)
        Those of `gross_outliers`. The rigid object of a table with many frames is that
        of some of them.
    """
    if rows.n_frames <= options.model_frames:
        return gross_outliers(rows.whole().transpose(0, 2, 1), options)
    frames = representative_frames(
        rows, n_points, options.model_frames, options.fewest_shown
    )
    chosen = rows.take(frames).transpose(0, 2, 1)
    _, rigid_object = _rigid_search(chosen, options)
    return rows.joined(
        partial(_outliers_of_frames, rigid_object=rigid_object, options=options)
    )


def gross_outliers(
    tracks: NDArray, options: OutlierOptions = OUTLIER_OPTIONS
) -> NDArray:
    """
    Tell which points are far from any rigid object.

    Parameters
    ----------
    tracks : ndarray of shape (n_frames, n_points, 2)
        Tracks, each frame divided by its size; NaN where a point is not seen.
    options : OutlierOptions
        Which points are gross outliers.

    Returns
    -------
    ndarray of bool, shape (n_frames, n_points)
        Points whose distance from a rigid factorisation of the others is many times the
        typical distance, the larger one of the table and of this point. None
        in frames with many such points.
    """
    hidden, _ = _rigid_search(tracks, options)
    return _unless_many(hidden, tracks, options)


def _rigid_search(
    tracks: NDArray, options: OutlierOptions
) -> tuple[NDArray, _RigidObject]:
    """Return which points (I, J) of tracks (I, J, 2) are hidden, and the object.

    Hidden are the points that are not seen, and those far from the object of the
    others. Factorisation and hiding alternate.
    """
    target, hidden = _start_of_hiding(tracks, options)
    seen = seen_points(tracks)
    filled = np.where(hidden[..., None], 0.0, target)
    for _ in range(options.rounds):
        # Rigid factorisation, rank 3, of the filled tracks
        rows = filled - filled.mean(axis=1, keepdims=True)
        rows = rows.transpose(0, 2, 1).reshape(-1, tracks.shape[1])
        axes = np.linalg.eigh(rows.T @ rows)[1][:, -3:]
        rigid = _rigid_part(filled, axes)
        # What is typical, of the table and of each point
        distance = np.linalg.norm(target - rigid, axis=2)
        typical = max(median_noise(distance[seen]), OF_DISTANCES)
        of_point = np.nanmedian(distance, axis=0) / MEDIAN_DISTANCE
        rigid_object = _RigidObject(
            axes,
            options.gross * np.maximum(typical, of_point),
            options.settled * typical,
        )
        # Hide what is too far, and fill hidden points in
        previous, hidden = hidden, ~(distance <= rigid_object.limit)
        before, filled = filled, np.where(hidden[..., None], rigid, target)
        moved = np.abs(filled - before).max()
        if (hidden == previous).all() and moved <= rigid_object.settled:
            break
    return hidden, rigid_object


def _outliers_of_frames(
    rows: NDArray, rigid_object: _RigidObject, options: OutlierOptions
) -> NDArray:
    """Return the gross outliers (n, J) of frames (n, 2, J), for a given object.

    Each frame ends by itself: its result does not depend on the others.
    """
    tracks = rows.transpose(0, 2, 1)
    target, hidden = _start_of_hiding(tracks, options)
    filled = np.where(hidden[..., None], 0.0, target)
    active = np.arange(len(tracks))
    for _ in range(options.rounds):
        rigid = _rigid_part(filled[active], rigid_object.axes)
        distance = np.linalg.norm(target[active] - rigid, axis=2)
        new = ~(distance <= rigid_object.limit)
        changed = (new != hidden[active]).any(axis=1)
        after = np.where(new[..., None], rigid, target[active])
        moved = np.abs(after - filled[active]).max(axis=(1, 2))
        hidden[active], filled[active] = new, after
        active = active[changed | (moved > rigid_object.settled)]
        if not len(active):
            break
    return _unless_many(hidden, tracks, options)


def _start_of_hiding(
    tracks: NDArray, options: OutlierOptions
) -> tuple[NDArray, NDArray]:
    """Return tracks (I, J, 2) from their medians, and the points (I, J) hidden first.

    Hidden are at first the points that are not seen or far from all others.
    """
    hidden = ~seen_points(tracks) | distant_points(tracks, options.distant)
    return tracks - spatial_median(tracks)[:, None], hidden


def _rigid_part(filled: NDArray, axes: NDArray) -> NDArray:
    """Return the rigid part of frames (n, J, 2) without gaps, for axes (J, 3)."""
    translation = filled.mean(axis=1, keepdims=True)
    rows = (filled - translation).transpose(0, 2, 1)
    return (rows @ axes @ axes.T).transpose(0, 2, 1) + translation


def _unless_many(hidden: NDArray, tracks: NDArray, options: OutlierOptions) -> NDArray:
    """Return the seen points among the hidden ones, none of frames with many."""
    seen = seen_points(tracks)
    gross = hidden & seen
    few = gross.sum(axis=1) <= options.largest_share * seen.sum(axis=1)
    return gross & few[:, None]
