"""Robust losses: points far from the model count less.

Each point has a weight that falls with the distance of the point from the model, in
units of the noise, and is computed anew until fit and weights agree (iteratively
reweighted least squares: Holland, Welsch, "Robust regression using iteratively
reweighted least-squares", 1977).
"""

import numpy as np
from numpy.typing import NDArray

from isa_nrsfm._tables.visibility import seen_points

LOSSES = ("linear", "huber", "cauchy")
# Standard deviations from which a loss leaves the parabola: with these a location in
# the plane is estimated from normal noise with 95 percent of the least squares'
# efficiency.
TUNING = {"huber": 1.5011, "cauchy": 2.5486}
# Median distance of normal noise in the plane, in standard deviations of a coordinate.
MEDIAN_DISTANCE = np.sqrt(2 * np.log(2))
# A point so many sizes of its frame from the median point does not belong to it.
DISTANT = 6.0
# A point so many typical distances from the rigid object is an outlier to begin with.
GROSS = 4.5
GROSS_ROUNDS = 100
# What is filled in for them has settled when it moves less than this share of that.
SETTLED = 1e-2
# In a frame with a larger share of them the frame is unusual, not its points.
LARGEST_SHARE = 0.4
# Distances below this share of the size of a frame are rounding errors.
ROUNDING = 1e-9
# Steps to the point with the least sum of distances.
MEDIAN_STEPS = 20


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


def median_noise(distance: NDArray) -> float:
    """Return the standard deviation of a coordinate, from the median of distances."""
    return float(np.median(distance) / MEDIAN_DISTANCE)


def distant_points(tracks: NDArray) -> NDArray:
    """
    Tell which points are far from all others of their frame.

    Parameters
    ----------
    tracks : ndarray of shape (n_frames, n_points, 2)
        Tracks, NaN where a point is not seen.

    Returns
    -------
    ndarray of bool, shape (n_frames, n_points)
        Points whose distance from the median of their frame is more than six times the
        frame's size (`robust_sizes`).
    """
    square = _squares(tracks)
    return np.sqrt(square) > DISTANT * _sizes(square)[:, None]


def _squares(tracks: NDArray) -> NDArray:
    """Return the squared distances of points from the median of their frame."""
    tracks = np.ascontiguousarray(tracks)  # other strides are rounded otherwise
    return np.sum((tracks - spatial_median(tracks)[:, None]) ** 2, axis=2)


def _sizes(square: NDArray) -> NDArray:
    """Return the sizes of frames that belong to squared distances."""
    median, upper = np.nanquantile(square, [0.5, 0.75], axis=1)
    # Where half of the points are in one place, the median is rounding errors.
    mean = np.nanmean(square, axis=1)
    return np.sqrt(np.where(median > ROUNDING * upper, median, mean) / 2)


def spatial_median(tracks: NDArray) -> NDArray:
    """
    Return the point of each frame with the least sum of distances, nearly.

    Parameters
    ----------
    tracks : ndarray of shape (n_frames, n_points, 2)
        Tracks, NaN where a point is not seen.

    Returns
    -------
    ndarray of shape (n_frames, 2)
        Reweighted means, from the mean on (Weiszfeld 1937): it turns with the image.
    """
    seen = seen_points(tracks)
    points = np.where(seen[..., None], tracks, 0.0)
    weights = seen * 1.0
    for _ in range(MEDIAN_STEPS):
        share = weights / weights.sum(axis=1, keepdims=True)
        middle = np.einsum("ij,ijc->ic", share, points)
        distance = np.linalg.norm(points - middle[:, None], axis=2)
        least = ROUNDING * np.max(seen * distance, axis=1, keepdims=True)
        weights = seen / np.maximum(distance, np.where(least > 0, least, 1.0))
    return middle


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


def gross_outliers(tracks: NDArray) -> NDArray:
    """
    Tell which points are far from any rigid object.

    Parameters
    ----------
    tracks : ndarray of shape (n_frames, n_points, 2)
        Tracks, each frame divided by its size; NaN where a point is not seen.

    Returns
    -------
    ndarray of bool, shape (n_frames, n_points)
        Points whose distance from a rigid factorisation of the others is more than 4.5
        times what is typical of the table and of this point; none in frames with many
        of them.
    """
    seen = seen_points(tracks)
    hidden = ~seen | distant_points(tracks)
    target = tracks - spatial_median(tracks)[:, None]
    filled = np.where(hidden[..., None], 0.0, target)
    for _ in range(GROSS_ROUNDS):
        translation = filled.mean(axis=1, keepdims=True)
        rows = (filled - translation).transpose(0, 2, 1).reshape(-1, tracks.shape[1])
        axes = np.linalg.eigh(rows.T @ rows)[1][:, -3:]
        rigid = (rows @ axes @ axes.T).reshape(len(tracks), 2, -1).transpose(0, 2, 1)
        rigid = rigid + translation
        distance = np.linalg.norm(target - rigid, axis=2)
        typical = max(median_noise(distance[seen]), ROUNDING)
        of_point = np.nanmedian(distance, axis=0) / MEDIAN_DISTANCE
        limit = GROSS * np.maximum(typical, of_point)
        previous, hidden = hidden, ~(distance <= limit)
        moved = np.abs(np.where(hidden[..., None], rigid, target) - filled).max()
        filled = np.where(hidden[..., None], rigid, target)
        if (hidden == previous).all() and moved <= SETTLED * typical:
            break
    gross = hidden & seen
    few = gross.sum(axis=1) <= LARGEST_SHARE * seen.sum(axis=1)
    return gross & few[:, None]
