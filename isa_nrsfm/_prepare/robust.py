"""Robust losses: points far from the model count less.

Iteratively reweighted least squares (Holland, Welsch, "Robust regression using
iteratively reweighted least-squares", 1977), until fit and weights agree.
"""

from collections.abc import Callable
from functools import partial

import numpy as np
from numpy.typing import NDArray

from isa_nrsfm._linalg.rounding import OF_DISTANCES
from isa_nrsfm._linalg.small_matrices import centred
from isa_nrsfm._tables.blocks import FrameBlocks, representative_frames
from isa_nrsfm._tables.tracks import seen_points

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


def robust_square(square: NDArray, noise: float) -> NDArray:
    """Return squared distances as the loss "cauchy" has them, for a noise."""
    limit = noise * TUNING["cauchy"] ** 2
    return np.asarray(limit * np.log1p(square / limit))


def median_noise(distance: NDArray) -> float:
    """Return the noise of a coordinate from the median of distances (n,)."""
    return float(np.median(distance) / MEDIAN_DISTANCE)


def distant_points(rows: NDArray) -> NDArray:
    """Return a mask (I, J) of points of rows (I, 2, J) far from their frame."""
    distance, sizes = _spread(rows)
    return distance > DISTANT * sizes[:, None]


def robust_sizes(rows: NDArray) -> NDArray:
    """Return sizes (I,) of rows (I, 2, J), robust against outliers.

    The root of half the median squared distance of the visible points from their
    `spatial_median`. If half of them coincide, the RMS.
    """
    return _spread(rows)[1]


def robustly_centred(rows: NDArray) -> tuple[NDArray, NDArray]:
    """Return rows (I, 2, J) as doubles minus their spatial medians, and these."""
    rows = rows.astype(np.float64, copy=False)
    middle = spatial_median(rows)
    return rows - middle[..., None], middle


def _spread(rows: NDArray) -> tuple[NDArray, NDArray]:
    """Return distances (I, J) of points from their spatial median, and sizes (I,)."""
    square = np.sum((rows - spatial_median(rows)[..., None]) ** 2, axis=1)
    median, upper = (np.nanquantile(square, q, axis=1) for q in (0.5, 0.75))
    # If half of the points coincide the median is rounding error: take the mean.
    mean = np.nanmean(square, axis=1)
    size = np.sqrt(np.where(median > OF_DISTANCES * upper, median, mean) / 2)
    return np.sqrt(square), size


def spatial_median(rows: NDArray) -> NDArray:
    """Return spatial medians (I, 2) of rows (I, 2, J), of least sum of distances.

    A fixed number of steps of Weiszfeld (1937), from the mean of the `_nearest_half`.
    Unlike the medians of x and y it does not depend on the axes of the image.
    """
    seen = seen_points(rows)
    # Points (I, J, 2) in memory: x and y are summed in the order of the points.
    points = np.nan_to_num(np.ascontiguousarray(rows.transpose(0, 2, 1)))
    half: NDArray = seen * 1.0
    for _ in range(5):
        half, distance, _ = _nearest_half(points, half, seen)
    # Subtract the innermost point: equal points then differ by exactly zero.
    innermost = distance.argmin(axis=1)[:, None, None]
    origin = np.take_along_axis(points, innermost, axis=1)
    points = np.where(seen[..., None], points - origin, 0.0)
    weights, distance, median = _nearest_half(points, half, seen)
    # If half of the points coincide, their place is the median.
    least = np.where(median > 0, OF_DISTANCES * median, 1.0)
    counted = np.where(median > 0, seen, distance <= median)
    for _ in range(40):
        middle, distance = _weighted_middle(points, weights)
        weights = counted / np.maximum(distance, least)
    return origin[:, 0] + middle


def _nearest_half(
    points: NDArray, weights: NDArray, seen: NDArray
) -> tuple[NDArray, NDArray, NDArray]:
    """Return weights (I, J) of the half of points (I, J, 2) nearest to their mean.

    Also returns distances (I, J) from that mean, and the largest of the half (I, 1).
    """
    _, distance = _weighted_middle(points, weights)
    distance = np.where(seen, distance, np.inf)
    last = (seen.sum(axis=1, keepdims=True) - 1) // 2
    median = np.take_along_axis(np.sort(distance, axis=1), last, axis=1)
    return (distance <= median) * 1.0, distance, median


def _weighted_middle(points: NDArray, weights: NDArray) -> tuple[NDArray, NDArray]:
    """Return weighted means (I, 2) of points (I, J, 2), and distances (I, J)."""
    share = weights / weights.sum(axis=1, keepdims=True)
    middle = np.einsum("ij,ijc->ic", share, points)
    return middle, np.linalg.norm(points - middle[:, None], axis=2)


def gross_outliers(rows: FrameBlocks, model_frames: int) -> NDArray:
    """Return a mask (I, J) of the points of rows (I, 2, J) far from any rigid object.

    Their residual of a rigid factorisation of the other points is many times the
    typical one of the table and of the point. Frames with many such points have no
    outliers.
    """
    some = representative_frames(rows, model_frames)
    hidden, axes, limit = _rigid_object(rows.take(some))
    if len(some) < rows.n_frames:
        hidden = rows.joined(partial(_far_points, axes=axes, limit=limit))
    return rows.joined(_unless_many, hidden)


def _rigid_object(rows: NDArray) -> tuple[NDArray, NDArray, NDArray]:
    """Factorise frames (I, 2, J) into a rigid object, without outliers.

    Returns a mask of hidden points (I, J), orthonormal axes (J, 3), and the threshold
    of the distance of each point (J,). Factorisation and hiding alternate.
    """
    target, hidden = _start_of_hiding(rows)
    seen = seen_points(target)
    shown = np.asarray(seen.any(axis=0))
    filled = np.where(hidden[:, None], 0.0, target)
    for _ in range(100):
        # Rigid factorisation, rank 3, of the filled rows
        W = centred(filled).reshape(-1, rows.shape[2])
        axes = np.linalg.eigh(W.T @ W)[1][:, -3:]
        rigid = _rigid_part(target, ~hidden, axes)
        # Typical distances, of the table and of each point
        distance = np.linalg.norm(target - rigid, axis=1)
        typical = max(median_noise(distance[seen]), OF_DISTANCES)
        of_point = np.zeros(rows.shape[2])  # of points in no frame, too
        of_point[shown] = np.nanmedian(distance[:, shown], axis=0) / MEDIAN_DISTANCE
        limit = 4.5 * np.maximum(typical, of_point)
        # Hide points that are too far, and fill them in
        previous, hidden = hidden, ~(distance <= limit)
        before, filled = filled, np.where(hidden[:, None], rigid, target)
        moved = np.abs(filled - before).max()
        if (hidden == previous).all() and moved <= 0.01 * typical:
            break
    return hidden, axes, limit


def _far_points(rows: NDArray, axes: NDArray, limit: NDArray) -> NDArray:
    """Return a mask of hidden points (n, J) of frames (n, 2, J), for a rigid object."""
    target, hidden = _start_of_hiding(rows)
    for _ in range(100):  # a frame that is settled stays as it is
        rigid = _rigid_part(target, ~hidden, axes)
        previous = hidden
        hidden = ~(np.linalg.norm(target - rigid, axis=1) <= limit)
        if (hidden == previous).all():
            break
    return hidden


def _unless_many(rows: NDArray, hidden: NDArray) -> NDArray:
    """Return the seen ones of hidden points (n, J); none if a frame has too many."""
    seen = seen_points(rows)
    gross = hidden & seen
    few = gross.sum(axis=1) <= 0.4 * seen.sum(axis=1)
    return gross & few[:, None]


def _start_of_hiding(rows: NDArray) -> tuple[NDArray, NDArray]:
    """Return rows (I, 2, J) from their medians, and points (I, J) hidden first."""
    hidden = ~seen_points(rows) | distant_points(rows)
    return rows - spatial_median(rows)[..., None], hidden


def _rigid_part(target: NDArray, kept: NDArray, axes: NDArray) -> NDArray:
    """Return the rigid parts of rows (n, 2, J): axes (J, 3) fitted to kept points."""
    design = np.column_stack([axes, np.full(len(axes), len(axes) ** -0.5)])
    pairs = (design[:, :, None] * design[:, None]).reshape(len(axes), -1)
    moments = (kept.astype(float) @ pairs).reshape(-1, 4, 4)
    inner = np.where(kept[:, None], target, 0.0) @ design
    return np.asarray(inner @ np.linalg.pinv(moments, OF_DISTANCES, True) @ design.T)
