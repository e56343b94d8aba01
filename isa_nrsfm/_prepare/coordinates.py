"""Detect sentinel values, normalised coordinates, and points of no object.

Columns may have been scaled one by one. Some points stand still while the object moves.
"""

from collections.abc import Callable, Hashable
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from isa_nrsfm._compat.caller import warn_caller
from isa_nrsfm._compat.texts import first_items
from isa_nrsfm._parameters import named
from isa_nrsfm._tables import FrameBlocks
from isa_nrsfm.skeletons._column_names import names_of_points

# All of these: docs/benchmarks/README.md, "Thresholds".
# Rows of a fit, and points, that are compared at most.
MOST_ROWS = 1000
# Confidence below which points are unreliable.
UNSURE = 0.6
# Largest part of the coordinates of shares that are beyond all borders but one.
FEW = 0.05
# Least part of the points of shares that are in the image.
LEAST = 0.2
# Largest median of centred coordinates.
CENTRED = 0.03
# Difference of the spreads of columns scaled one by one, at most: in all rows, relative
# to the movement of points apart from their centroid; in some rows, to the spread.
EQUAL, SIMILAR = 0.03, 0.3
# Largest movement of points that stand still, relative to the others' centroid, which
# moves by at least half of their size.
STILL, LEAST_WAY = 0.05, 0.5
# Attribute of a DataFrame of points of which `read_landmarks` has warned.
TOLD = "warned of coordinates"


class CoordinateWarning(UserWarning):
    """Coordinates are probably sentinel values, or normalised."""


def warn_of_rows(rows: FrameBlocks, model: Any, attrs: dict[Hashable, Any]) -> None:
    """Warn of some rows of a table, evenly spread; not of shares if cameras are affine.

    These absorb the stretch of shares. The attributes of a DataFrame may have `TOLD`.
    The model knows the names of the points.
    """
    sample = np.arange(0, rows.n_frames, -(-rows.n_frames // MOST_ROWS) or 1)
    tracks = rows.take(sample).mT
    if len(still := still_points(tracks)):
        names = names_of_points(model, tracks.shape[1])
        warn_caller(
            f"{len(still)} of {tracks.shape[1]} points stand still while the others "
            f"move through the image: {first_items((names[j] for j in still), 12)}. "
            "They are no part of the object: leave their columns out",
            CoordinateWarning,
        )
    if attrs.get(TOLD):
        return
    if warn_of_scaled_columns(tracks, lambda: rows.whole().mT):
        return
    every = len(sample) == rows.n_frames
    warn_of_codes(tracks, "rows" if every else "rows of a sample")
    if model.camera != "affine":
        warn_of_shares(tracks)


def still_points(tracks: NDArray) -> NDArray:
    """Return the numbers of points that stand still while the others move together.

    Tracks are (n_frames, n_points, 2). Medians: a point may be wrong in some frames.
    The origin of the coordinates is a point of aligned objects.
    """
    tracks = tracks / (np.nanmax(np.abs(tracks), initial=0.0) or 1.0)  # no overflow
    n_seen = np.isfinite(tracks[..., 0]).sum(axis=0)
    if len(tracks) < 10 or n_seen.min(initial=2) < 2:
        return np.arange(0)
    way = np.linalg.norm(tracks - np.nanmedian(tracks, axis=0), axis=2)
    way = np.nanmedian(way, axis=0)
    still = way < STILL * way.max()
    if still.all() or not still.any():
        return np.arange(0)
    centroid = np.nanmean(tracks[:, ~still], axis=1)
    size = np.nanmedian(np.linalg.norm(tracks[:, ~still] - centroid[:, None], axis=2))
    moved = np.nanmedian(np.linalg.norm(centroid - np.nanmedian(centroid, 0), axis=1))
    if moved < LEAST_WAY * size:  # parts of an object that stays in place
        return np.arange(0)
    return np.flatnonzero((way < STILL * moved) & ~(tracks == 0).all(axis=(0, 2)))


def warn_of_places(
    tracks: NDArray, confidence: ArrayLike | None = None, format: str = "table"
) -> bool:
    """Warn of codes in tracks (n_frames, n_points, 2), and of shares; of sure points.

    Trackers place points that they do not see beyond the image. Return whether there
    are any.
    """
    sample = tracks[:: -(-len(tracks) // MOST_ROWS) or 1]
    warned = warn_of_scaled_columns(sample, lambda: tracks) or warn_of_codes(tracks)
    unsure = np.asarray(confidence, dtype=float)[..., None] < UNSURE
    if 0 < unsure.mean() < 0.5:  # scores of some programs are all lower
        tracks = np.where(unsure, np.nan, tracks)
    return warn_of_shares(tracks, format) or warned


def warn_of_scaled_columns(sample: NDArray, every: Callable[[], NDArray]) -> bool:
    """Warn, and return True, if the columns of tracks were scaled one by one.

    All tracks are only read if some of them look like it.
    """
    if not (are_scaled(sample, SIMILAR) and are_scaled(every(), EQUAL, apart=True)):
        return False
    warn_caller(
        "all columns have the same spread, as after z-scores, StandardScaler or "
        "MinMaxScaler. Each column was scaled separately, which stretches each point "
        "in x and y by another factor: shapes will be wrong. Give the coordinates as "
        "they were before, in a pipeline without the scaler",
        CoordinateWarning,
    )
    return True


def are_scaled(tracks: NDArray, tol: float, apart: bool = False) -> bool:
    """Return whether all columns of tracks have the same spread, up to `tol` of it.

    That is the standard deviation with n or n - 1, smallest and largest value, the
    largest magnitude, or median and quartiles. With `apart`, `tol` is relative to the
    movement of points apart from their centroid: columns of an object that moves far
    are alike, as it moves as a whole.
    """
    seen = np.isfinite(tracks).sum(axis=0).min(axis=1) > max(len(tracks) / 2, 9)
    tracks = tracks[:, seen].astype(np.float64)
    largest = np.nanmax(np.abs(tracks), initial=0.0)
    if not largest:
        return False
    tracks /= largest  # squares stay in range
    X = tracks.reshape(len(tracks), -1)
    if apart:
        moves = tracks - np.nanmean(tracks, axis=0)
        n_seen = np.isfinite(moves).sum(axis=1, keepdims=True)
        shifts = moves - np.nansum(moves, axis=1, keepdims=True) / np.maximum(n_seen, 1)
        tol *= np.nanstd(shifts) / (np.nanstd(moves) or 1.0)
    # The one for missing points goes through the columns one by one.
    percentile = np.percentile if np.isfinite(X).all() else np.nanpercentile
    low, first, median, third, high = percentile(X, [0, 25, 50, 75, 100], axis=0)
    spreads = [[np.nanstd(X, axis=0)], [np.nanstd(X, axis=0, ddof=1)]]
    spreads += [[high - low, low], [np.fmax(high, -low)], [third - first, median]]
    ranges = [max(np.ptp(each) for each in spread) for spread in spreads]
    limits = [tol * spread[0].max() for spread in spreads]
    alike = any(r <= limit > 0 for r, limit in zip(ranges, limits, strict=True))
    # Fewer columns are alike by chance.
    return alike and np.unique(X, axis=1).shape[1] >= 6


def warn_of_codes(tracks: NDArray, rows: str = "rows") -> bool:
    """Warn, and return True, if tracks may have missing points, such as (0, 0).

    Codes such as -1 may be shifted or scaled: they are the same pair of numbers. Other
    points are at the same place, exactly and in three frames, only by chance. Then the
    point has other places as often, or others are further out. The origin of the
    coordinates is one point in all frames, and others are around it.
    """
    places = np.ascontiguousarray(tracks, dtype=float).view(complex)[..., 0]
    finite = np.flatnonzero(~np.isnan(places))
    sample = places.ravel()[finite[:: -(-len(finite) // 1_000_000) or 1]]
    sample += 0  # -0.0 + 0.0 is 0.0
    found, warned = {0j}, False
    for subset in (sample, sample[sample.real == sample.imag]):
        if len(subset):
            values, counts = np.unique(subset, return_counts=True)
            found |= {*values[[0, int(counts.argmax()), -1]]}
    for place in sorted(found, key=lambda place: (place.real, place.imag)):
        there = places == place
        counts, n_rows = there.sum(axis=0), there.any(axis=1).sum()
        if n_rows < (3 if place else 1) or np.isnan(tracks[~there]).all():
            continue
        point = counts.argmax()
        other, others = places[~there[:, point], point], tracks[~there]
        often = np.unique(other, return_counts=True, equal_nan=False)[1].max(initial=0)
        xy = np.array([place.real, place.imag])
        beyond = (xy < np.nanmin(others, axis=0)) | (xy > np.nanmax(others, axis=0))
        is_outside = beyond.all()
        is_origin = len(there) > 2 and not is_outside and np.isnan(other).all()
        enough = is_outside or counts[point] > 3 * often
        equal = xy[0] == xy[1]
        alone = not equal and np.count_nonzero(counts) < 2
        if is_origin or alone or (place and not enough):
            continue
        number, way = f"{xy[0]:.15g}", "before coordinates are shifted or scaled"
        if equal:
            way = f"as readers of tables do with {named('missing', float(number))}"
        warn_caller(
            f"in {n_rows} of {len(there)} {rows} points are at exactly ({number}, "
            f"{xy[1]:.15g}) ({there.sum()} in all). If these points are missing, make "
            f"them NaN {way}",
            CoordinateWarning,
        )
        warned = True
    return warned


def warn_of_shares(tracks: NDArray, format: str = "table") -> bool:
    """Warn, and return True, if tracks (n_frames, n_points, 2) look like shares."""
    if not are_shares(tracks):
        return False
    finite = tracks[~np.isnan(tracks)]
    inside = np.mean((finite >= 0) & (finite <= 1))
    reader = "mediapipe" if format == "table" else format
    way = (
        f": read the file with {named('format', reader)} and "
        f"{named('image_size', (1280, 720))}, the width and height of the images"
    )
    if reader not in ("mediapipe", "yolo"):
        way = (
            f". In Python: points = landmarks.points * ([WIDTH, HEIGHT] * "
            f"{tracks.shape[1]}), and isa_nrsfm.io.write_table(points, 'new.csv')"
        )
    warn_caller(
        f"{100 * inside:.3g} % of the coordinates are between 0 and 1 (all between "
        f"{finite.min():.2g} and {finite.max():.2g}), like fractions of the width and "
        "height of an image. Such shares stretch the shapes, which changes their "
        "proportions and rotations. If they have another unit, such as metres, ignore "
        "this. If these are shares, multiply x by the width and y by the height of the "
        f"image{way}",
        CoordinateWarning,
    )
    return True


def are_shares(tracks: NDArray) -> bool:
    """Return whether tracks (n_frames, n_points, 2) look like normalised coordinates.

    Positions in an image are apart in both directions. Trackers also place points
    that it cuts off, such as the legs of a body at a desk, beyond one of its borders;
    centred coordinates are beyond several. In frames, columns or a table scaled to
    [0, 1], a few coordinates are exactly 0 and 1; in aligned ones, a point is at 0.
    Points at (0, 0) are missing.
    """
    x, y = np.moveaxis(tracks, 2, 0)
    visible = ~(np.isnan(x) | np.isnan(y)) & ((x != 0) | (y != 0))
    if not visible.any():
        return False
    sides = [[(c < 0) & visible, (c > 1) & visible] for c in (x, y)]
    beyond = np.sum(sides, axis=(2, 3)) / visible.sum()  # of two borders, in x and y
    if beyond.sum() - beyond.max() > 2 * FEW:
        return False
    # Half of the points of a centred body are on either side.
    centred = any(abs(np.median(c[visible])) < CENTRED for c in (x, y))
    inside = ((tracks >= 0) & (tracks <= 1)).all(axis=2) & visible
    zero, one = (((tracks == end).any(axis=2) & visible) for end in (0, 1))
    ends, tolerance = (zero.sum(), one.sum()), 4 + visible.sum() / 1000
    scaled = [np.mean(zero.any(axis) & one.any(axis)) > 0.5 for axis in (0, 1)]
    few_ends = 0 < min(ends) and sum(ends) < tolerance
    aligned = zero.all(axis=0).any() or any(scaled) or few_ends
    if centred or aligned or inside.sum() < LEAST * visible.sum():
        return False
    return bool(np.ptp(tracks[inside], axis=0).min() > 0.1)
