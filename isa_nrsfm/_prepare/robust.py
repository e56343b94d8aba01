"""Robust losses: points far from the model count less.

Iteratively reweighted least squares (Holland, Welsch, "Robust regression using
iteratively reweighted least-squares", 1977), until fit and weights agree.
"""

from collections.abc import Callable
from functools import partial

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import eigh

from isa_nrsfm import _linalg as linalg
from isa_nrsfm._tables import FrameBlocks, representative_frames, seen_points

# Tuning constants c of the losses, in standard deviations of a coordinate. With these,
# the estimate of a location in the plane has 95 percent of the efficiency of least
# squares if the noise is normal.
TUNING = {"huber": 1.5011, "cauchy": 2.5486}
# Weights by loss, functions of distances in standard deviations of a coordinate.
WEIGHTS: dict[str, Callable[[NDArray], NDArray]] = {
    "linear": np.ones_like,
    "huber": lambda distance: TUNING["huber"] / np.maximum(distance, TUNING["huber"]),
    "cauchy": lambda distance: 1.0 / (1.0 + (distance / TUNING["cauchy"]) ** 2),
}
# Median distance of normal noise in the plane, in standard deviations of a coordinate.
MEDIAN_DISTANCE = np.sqrt(2 * np.log(2))
# A point does not belong to its frame if it is farther from the spatial median than
# this many sizes of the frame.
DISTANT = 6.0


def frame_weights(
    loss: str, distance: NDArray, deviation: float, sizes: NDArray
) -> NDArray:
    """Return weights (I, J) in [0, 1] of points at a distance (I, J) from the model.

    Zero beyond `DISTANT` sizes (I,): a loss that grows without limit would bend the
    shapes towards such points.
    """
    belongs = distance <= DISTANT * sizes[:, None]
    near = np.where(belongs, distance, 0.0)  # powers of others could overflow
    return np.where(belongs, WEIGHTS[loss](near / deviation), 0.0)


def median_noise(distance: NDArray) -> float:
    """Return the noise of a coordinate from the median of distances (n,)."""
    return float(np.median(distance) / MEDIAN_DISTANCE)


def lower_medians(distance: NDArray, seen: NDArray) -> NDArray:
    """Return lower medians (I, 1) of distances (I, J) of seen points (I, J).

    Distances of other points are infinite or NaN.
    """
    last = (seen.sum(axis=1, keepdims=True) - 1) // 2
    return np.take_along_axis(np.sort(distance, axis=1), last, axis=1)


def distant_points(rows: NDArray) -> NDArray:
    """Return a mask (I, J) of points far from their frame, `robustly_centred`.

    Missing points are far.
    """
    return ~(linalg.lengths(rows) <= DISTANT * robust_sizes(rows)[:, None])


def robust_sizes(rows: NDArray) -> NDArray:
    """Return sizes (I,) of `robustly_centred` rows, robust against outliers.

    The root of half the median squared distance of the visible points from zero. If
    half of them coincide, the RMS.
    """
    square = np.sort(np.sum(rows**2, axis=1), axis=1)  # missing points are last
    last, frames = seen_points(rows).sum(axis=1) - 1, np.arange(len(rows))
    median = (square[frames, last // 2] + square[frames, (last + 1) // 2]) / 2
    # If half of the points coincide the median is rounding error: take the mean.
    exact = median > linalg.OF_DISTANCES * square[frames, 3 * last // 4]
    return np.sqrt(np.where(exact, median, np.nanmean(square, axis=1)) / 2)


def robustly_centred(rows: NDArray) -> tuple[NDArray, NDArray]:
    """Return rows (I, 2, J) as doubles minus their spatial medians, and these."""
    rows = rows.astype(np.float64, copy=False)
    middle = spatial_median(rows)
    return rows - middle[..., None], middle


def spatial_median(rows: NDArray) -> NDArray:
    """Return spatial medians (I, 2) of rows (I, 2, J), of least sum of distances.

    A fixed number of steps of Weiszfeld (1937), from the mean of the `_nearest_half`,
    1.8 times as long: they converge if the factor is below 2 (Ostresh, "On the
    convergence of a class of iterative methods for solving the Weber location problem",
    1978). Unlike the medians of x and y it does not depend on the axes of the image.
    """
    visible = seen_points(rows)
    points = np.nan_to_num(rows.swapaxes(0, 1))
    half: NDArray = visible * 1.0
    for _ in range(5):
        half, distance, _ = _nearest_half(points, half, visible)
    # Subtract the innermost point: equal points then differ by exactly zero.
    innermost = distance.argmin(axis=1)[None, :, None]
    origin = np.take_along_axis(points, innermost, axis=2)
    points = np.where(visible, points - origin, 0.0)
    weights, distance, median = _nearest_half(points, half, visible)
    # If half of the points coincide, their place is the median.
    floor = np.where(median > 0, linalg.OF_DISTANCES * median, 1.0)
    counted = np.where(median > 0, visible, distance <= median)
    middle = _middles(points, weights)
    for _ in range(20):
        weights = counted / np.maximum(_distances(points, middle), floor)
        middle += 1.8 * (_middles(points, weights) - middle)
    return (origin[..., 0] + middle).T


def _nearest_half(
    points: NDArray, weights: NDArray, seen: NDArray
) -> tuple[NDArray, NDArray, NDArray]:
    """Return weights (I, J) of the half of points (2, I, J) nearest to their mean.

    Also returns distances (I, J) from that mean, and the largest of the half (I, 1).
    """
    distance = _distances(points, _middles(points, weights))
    distance = np.where(seen, distance, np.inf)
    median = lower_medians(distance, seen)
    return (distance <= median) * 1.0, distance, median


def _middles(points: NDArray, weights: NDArray) -> NDArray:
    """Return weighted means (2, I) of points (2, I, J), weights (I, J)."""
    return np.vecdot(points, weights) / weights.sum(axis=1)


def _distances(points: NDArray, middle: NDArray) -> NDArray:
    """Return distances (I, J) of points (2, I, J) from places (2, I)."""
    return linalg.lengths((points - middle[..., None]).swapaxes(0, 1))


def gross_outliers(rows: FrameBlocks, model_frames: int) -> NDArray:
    """Return a mask (I, J) of points far from any rigid object.

    Their residual of a rigid factorisation of the other points of rows (I, 2, J),
    `robustly_centred`, is many times the typical one of the table and of the point.
    Frames with many such points have no outliers.
    """
    sample = representative_frames(rows, model_frames)
    hidden, axes, limit = _rigid_object(rows.take(sample))
    if len(sample) < rows.n_frames:
        hidden = rows.joined(partial(_far_points, axes=axes, limit=limit))
    return rows.joined(_unless_many, hidden)


def _rigid_object(rows: NDArray) -> tuple[NDArray, NDArray, NDArray]:
    """Factorise frames (I, 2, J) into a rigid object, without outliers.

    Returns a mask of hidden points (I, J), orthonormal axes (J, 3), and the threshold
    of the distance of each point (J,). Factorisation and hiding alternate.
    """
    visible, hidden = seen_points(rows), distant_points(rows)
    filled = np.where(hidden[:, None], 0.0, rows)
    for _ in range(100):
        # Rigid factorisation, rank 3, of the filled rows
        W = linalg.centred(filled).reshape(-1, rows.shape[2])
        last = [rows.shape[2] - 3, rows.shape[2] - 1]
        axes = eigh(W.T @ W, subset_by_index=last)[1]
        rigid, distance = _rigid_part(rows, hidden, axes)
        # Typical distances, of the table and of each point
        typical = max(median_noise(distance[visible]), linalg.OF_DISTANCES)
        of_point = lower_medians(distance.T, visible.T)[:, 0] / MEDIAN_DISTANCE
        limit = 4.5 * np.fmax(typical, of_point)  # NaN: points in no frame
        # Hide points that are too far, and fill them in
        previous, hidden = hidden, ~(distance <= limit)
        before, filled = filled, np.where(hidden[:, None], rigid, rows)
        settled = (hidden == previous).all()
        if settled and np.abs(filled - before).max() <= 0.01 * typical:
            break
    return hidden, axes, limit


def _far_points(rows: NDArray, axes: NDArray, limit: NDArray) -> NDArray:
    """Return a mask of hidden points (n, J) of frames (n, 2, J), for a rigid object."""
    hidden, moving = distant_points(rows), np.arange(len(rows))
    for _ in range(100):  # a frame that is settled stays as it is
        previous = hidden[moving]
        hidden[moving] = ~(_rigid_part(rows[moving], previous, axes)[1] <= limit)
        moving = moving[(hidden[moving] != previous).any(axis=1)]
    return hidden


def _unless_many(rows: NDArray, hidden: NDArray) -> NDArray:
    """Return the seen ones of hidden points (n, J); none if a frame has too many."""
    visible = seen_points(rows)
    gross = hidden & visible
    return gross & (gross.sum(axis=1) <= 0.4 * visible.sum(axis=1))[:, None]


def _rigid_part(
    rows: NDArray, hidden: NDArray, axes: NDArray
) -> tuple[NDArray, NDArray]:
    """Return the rigid parts of rows (n, 2, J), and the distances (n, J) from them.

    Axes (J, 3) are fitted to the points that are not hidden.
    """
    design = np.column_stack([axes, np.full(len(axes), len(axes) ** -0.5)])
    first, second = linalg.pair_indices(4)
    moments = (design[:, first] * design[:, second]).T @ ~hidden.T
    inverse = linalg.frames_first(linalg.unpacked(linalg.invert_positive(moments)[0]))
    rigid = np.where(hidden[:, None], 0.0, rows) @ design @ inverse @ design.T
    return rigid, linalg.lengths(rows - rigid)
