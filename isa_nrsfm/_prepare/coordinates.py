"""Coordinates that are no places in an image: codes of missing points, shares."""

from collections.abc import Hashable
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from isa_nrsfm._compat.caller import warn_caller
from isa_nrsfm._tables.blocks import FrameBlocks

# All of these: docs/benchmarks/README.md, "Thresholds".
# Rows of a fit, and points, that are compared at most.
MOST_ROWS, MOST_PLACES = 1000, 1_000_000
# Points of a lower confidence are seldom where they are said to be.
UNSURE = 0.6
# Largest part of the coordinates of shares that are beyond all borders but one.
FEW = 0.05
# Least part of the points of shares that are in the image.
LEAST = 0.2
# Largest median of centred coordinates.
CENTRED = 0.03
# Attribute of a DataFrame of points of which `read_landmarks` has warned.
TOLD = "warned of coordinates"


class CoordinateWarning(UserWarning):
    """Coordinates are probably codes of missing points, or shares of an image."""


def warn_of_rows(rows: FrameBlocks, camera: str, attrs: dict[Hashable, Any]) -> None:
    """Warn of some rows of a table, evenly spread; not of shares if cameras are affine.

    These absorb the stretch of shares. The attributes of a DataFrame may have `TOLD`.
    """
    if attrs.get(TOLD):
        return
    few = np.arange(0, rows.n_frames, -(-rows.n_frames // MOST_ROWS) or 1)
    tracks = rows.take(few).mT
    warn_of_codes(tracks, "rows" if len(few) == rows.n_frames else "rows of a sample")
    if camera != "affine":
        warn_of_shares(tracks)


def warn_of_places(
    tracks: NDArray, confidence: ArrayLike | None = None, format: str = "table"
) -> bool:
    """Warn of codes in tracks (n_frames, n_points, 2), and of shares; of sure points.

    Trackers place points that they do not see beyond the image. Return whether there
    are any.
    """
    have_codes = warn_of_codes(tracks)
    unsure = np.asarray(confidence, dtype=float)[..., None] < UNSURE
    if unsure.any():
        tracks = np.where(unsure, np.nan, tracks)
    return warn_of_shares(tracks, format) or have_codes


def warn_of_codes(tracks: NDArray, rows: str = "rows") -> bool:
    """Warn, and return True, if tracks may have missing points, such as (0, 0).

    Codes such as -1 may be shifted or scaled: they are the same pair of numbers. Other
    points are at the same place, exactly and in three frames, only by chance. Then the
    point has other places as often, or others are further out. The origin of the
    coordinates is one point in all frames, and others are around it.
    """
    places = np.ascontiguousarray(tracks, dtype=float).view(complex)[..., 0]
    known = np.flatnonzero(~np.isnan(places))
    shown = places.ravel()[known[:: -(-len(known) // MOST_PLACES) or 1]]
    shown += 0  # -0.0 + 0.0 is 0.0
    found, warned = {0j}, False
    for some in (shown, shown[shown.real == shown.imag]):
        if len(some):
            values, counts = np.unique(some, return_counts=True)
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
            option = f"--missing-value {number}" if place else "--zeros-missing"
            way = (
                f"with isa_nrsfm.io.landmark_table(table, missing={number}) (command "
                f"line: {option})"
            )
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
    known = tracks[~np.isnan(tracks)]
    inside = np.mean((known >= 0) & (known <= 1))
    reader = "mediapipe" if format == "table" else format
    way = (
        f": isa_nrsfm.io.read_landmarks with format={reader!r} and "
        f"image_size=(WIDTH, HEIGHT) does it (command line: --format {reader} "
        "--image-size WIDTHxHEIGHT)"
    )
    if reader not in ("mediapipe", "yolo"):
        way = (
            f". In Python: points = landmarks.points * ([WIDTH, HEIGHT] * "
            f"{tracks.shape[1]}), and isa_nrsfm.io.write_table(points, 'new.csv')"
        )
    warn_caller(
        f"{100 * inside:.3g} % of the coordinates are between 0 and 1 (all between "
        f"{known.min():.2g} and {known.max():.2g}), like shares of the width and "
        "height of an image. Such shares stretch the shapes, which changes their "
        "proportions and rotations. If they have another unit, such as metres, ignore "
        "this. If these are shares, multiply x by the width and y by the height of the "
        f"image{way}",
        CoordinateWarning,
    )
    return True


def are_shares(tracks: NDArray) -> bool:
    """Return whether tracks (n_frames, n_points, 2) look like shares of an image.

    Positions in an image are apart in both directions. Trackers also place points
    that it cuts off, such as the legs of a body at a desk, beyond one of its borders;
    centred coordinates are beyond several. In frames, columns or a table scaled to
    [0, 1], a few coordinates are exactly 0 and 1; in aligned ones, a point is at 0.
    Points at (0, 0) are missing.
    """
    x, y = np.moveaxis(tracks, 2, 0)
    seen = ~(np.isnan(x) | np.isnan(y)) & ((x != 0) | (y != 0))
    if not seen.any():
        return False
    sides = [[(c < 0) & seen, (c > 1) & seen] for c in (x, y)]
    beyond = np.sum(sides, axis=(2, 3)) / seen.sum()  # of two borders, in x and y
    if beyond.sum() - beyond.max() > 2 * FEW:
        return False
    # Half of the points of a centred body are on either side.
    centred = any(abs(np.median(c[seen])) < CENTRED for c in (x, y))
    inside = ((tracks >= 0) & (tracks <= 1)).all(axis=2) & seen
    zero, one = (((tracks == end).any(axis=2) & seen) for end in (0, 1))
    ends, few = (zero.sum(), one.sum()), 4 + seen.sum() / 1000
    scaled = [np.mean(zero.any(axis) & one.any(axis)) > 0.5 for axis in (0, 1)]
    aligned = (
        zero.all(axis=0).any() or any(scaled) or (0 < min(ends) and sum(ends) < few)
    )
    if centred or aligned or inside.sum() < LEAST * seen.sum():
        return False
    return bool(np.ptp(tracks[inside], axis=0).min() > 0.1)
