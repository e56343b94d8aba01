"""The forms of a table of landmarks, and the visible points of its frames.

A *table* has one row per frame and two columns per point, shape ``(n_frames,
2 * n_points)``, in either layout of the columns. `open_table` turns it into *rows*
``(n_frames, 2, n_points)``, the form of all stages: a point that is not seen in a
frame has NaN in both. *Tracks* ``(n_frames, n_points, 2)`` are the form of public
results.
"""

from typing import Literal, NamedTuple, get_args

import numpy as np
from numpy.typing import NDArray

from isa_nrsfm._compat.caller import warn_caller

# Columns are x0, y0, x1, y1, ... or x0, x1, ..., y0, y1, ...
Layout = Literal["interleaved", "planar"]
LAYOUTS: tuple[Layout, ...] = get_args(Layout)
# Least number of visible points of a frame. Each point gives two equations; an affine
# camera with its translation has eight unknowns. Coefficients need no further points:
# the prior determines them where the points do not.
FEWEST_POINTS = 4


def table_to_tracks(X: NDArray, layout: Layout = "interleaved") -> NDArray:
    """Return the tracks (n_frames, n_points, 2) of a table."""
    n_frames, n_columns = X.shape
    refuse_odd(n_columns, layout)
    if layout == "planar":
        return X.reshape(n_frames, 2, n_columns // 2).transpose(0, 2, 1)
    return X.reshape(n_frames, n_columns // 2, 2)


def refuse_odd(n_columns: int, layout: Layout) -> None:
    """Refuse a number of columns that is odd."""
    if n_columns % 2:
        three = f". If points have x, y and a third number, give {two_of(3, layout)}"
        raise ValueError(
            "X must have two columns per point (x and y), an even number; "
            f"got n_features={n_columns}{three * (n_columns % 3 == 0)}"
        )


def two_of(n_numbers: int, layout: Layout) -> str:
    """Return what makes a table X of the first two numbers of points."""
    shape, two = (
        ("-1, {}", "..., :2") if layout == "interleaved" else ("{}, -1", ":, :2")
    )
    shape = shape.format(n_numbers)
    return f"np.asarray(X).reshape(len(X), {shape})[{two}].reshape(len(X), -1)"


def tracks_to_table(tracks: NDArray, layout: Layout = "interleaved") -> NDArray:
    """Return tracks as a table, the inverse of `table_to_tracks`."""
    n_frames, n_points, _ = tracks.shape
    if layout == "planar":
        tracks = tracks.transpose(0, 2, 1)
    return tracks.reshape(n_frames, 2 * n_points)


def table_to_rows(X: NDArray, layout: Layout) -> NDArray:
    """Return the rows (n_frames, 2, n_points) of a table, contiguous."""
    return np.ascontiguousarray(table_to_tracks(X, layout).transpose(0, 2, 1))


def without_half_points(rows: NDArray) -> tuple[NDArray, NDArray, NDArray]:
    """Hide points with one coordinate; return rows (I, 2, J), counts, first ones."""
    x, y = np.isnan(rows).swapaxes(0, 1)
    half = x != y
    if half.any():
        rows = np.where(half[:, None], rows.dtype.type(np.nan), rows)
    return rows, half.sum(axis=1), half.argmax(axis=1)


def warn_of_half_points(
    n_half: NDArray, first: NDArray, layout: Layout, names: NDArray | None
) -> None:
    """Warn of points with one coordinate, as found by `without_half_points`."""
    if not n_half.any():
        return
    row = int((n_half > 0).argmax())
    warn_caller(
        f"in {np.count_nonzero(n_half)} of {len(n_half)} rows points have only one of "
        f"their two coordinates ({n_half.sum()} in all; first: "
        f"{describe_point(int(first[row]), layout, names)} in row {row}). They count "
        "as missing"
    )


def clean_rows(rows: NDArray, layout: Layout, names: NDArray | None) -> NDArray:
    """Return rows (I, 2, J) without points that have one coordinate; warn of them."""
    rows, n_half, first = without_half_points(rows)
    warn_of_half_points(n_half, first, layout, names)
    return rows


def describe_point(point: int, layout: Layout, names: NDArray | None) -> str:
    """Return the number of a point, with the names of its columns where known."""
    if names is None:
        return f"point {point}"
    x, y = table_to_tracks(np.asarray(names)[None], layout)[0, point]
    return f"point {point} ({x}, {y})"


class FrameReport(NamedTuple):
    """Place, size and visible points of frames.

    translation (I, 2): centroids of the visible points, NaN for frames without any.
    size (I,): RMS of the centred coordinates, zero for frames without any.
    n_seen (I,): number of visible points.
    in_one_place (I,): whether all visible points are equal, up to rounding.
    on_line (I,): whether points are missing and the others on one line.
    """

    translation: NDArray
    size: NDArray
    n_seen: NDArray
    in_one_place: NDArray
    on_line: NDArray

    @property
    def usable(self) -> NDArray:
        """Return a mask of frames (n_frames,) with enough points for a camera.

        They have four points or more, not all in one place. If some points are missing,
        the others must not be on a line. A complete frame on a line is a flat object
        seen edge on. With missing points it may be a line of the object, which can turn
        around it.
        """
        enough = self.n_seen >= FEWEST_POINTS
        return enough & ~self.in_one_place & ~self.on_line


def seen_points(rows: NDArray) -> NDArray:
    """Return which points (I, J) of rows (I, 2, J) are seen."""
    return ~np.isnan(rows[:, 0])


def of_all_rows(values: NDArray, shown: NDArray) -> NDArray:
    """Expand values of shown rows to all rows, NaN for the others."""
    if shown.all():
        return values
    all_rows = np.full((len(shown), *values.shape[1:]), np.nan, values.dtype)
    all_rows[shown] = values
    return all_rows


def centred_frames(rows: NDArray) -> tuple[NDArray, FrameReport]:
    """Return rows (I, 2, J) centred over their visible points in double precision."""
    # Coordinates are equal up to four units in the last place of the largest one.
    eps = 4 * np.finfo(rows.dtype).eps
    seen = seen_points(rows)
    n_seen, hidden = seen.sum(axis=1), None if seen.all() else ~seen[:, None]
    centred = np.array(rows, dtype=float, order="C")
    if hidden is not None:
        np.copyto(centred, 0.0, where=hidden)
    translation = np.full((len(rows), 2), np.nan)
    total, shown = centred.sum(axis=2), n_seen[:, None] > 0
    np.divide(total, n_seen[:, None], where=shown, out=translation)
    centred -= translation[:, :, None]
    if hidden is not None:
        np.copyto(centred, 0.0, where=hidden)
    x, y = centred.swapaxes(0, 1)
    xx, yy = np.vecdot(x, x), np.vecdot(y, y)
    square, place = xx + yy, np.linalg.norm(translation, axis=1)
    in_one_place = (n_seen > 0) & (square <= n_seen * (eps * place) ** 2)
    on_line = np.zeros(len(rows), dtype=bool)
    if hidden is not None:
        # Twice the square of the distances from the principal axis, roughly
        off = square - np.hypot(xx - yy, 2.0 * np.vecdot(x, y))
        near = off <= 4 * n_seen * (eps * place) ** 2 + 1e-6 * square
        some = near & ~seen.all(axis=1)
        on_line[some] = _collinear(centred[some], place[some], n_seen[some], eps)
        np.copyto(centred, np.nan, where=hidden)
    size = np.sqrt(square / (2 * np.maximum(n_seen, 1)))
    return centred, FrameReport(translation, size, n_seen, in_one_place, on_line)


def _collinear(
    centred: NDArray, place: NDArray, n_seen: NDArray, eps: float
) -> NDArray:
    """Return a mask of centred rows (n, 2, J) with visible points on one line."""
    x, y = centred[:, 0], centred[:, 1]
    # Fit the angle of the principal axis. Eigenvalues of the 2x2 second moment would
    # square the distances from it, and lose half of their digits.
    angle = 0.5 * np.arctan2(2.0 * np.vecdot(x, y), np.vecdot(x, x) - np.vecdot(y, y))
    across = np.cos(angle)[:, None] * y - np.sin(angle)[:, None] * x
    rounding = eps * (place + np.abs(centred).max(axis=(1, 2)))
    thin = np.vecdot(across, across) <= n_seen * rounding**2
    return np.asarray(thin & (n_seen > 0))


def check_frames(report: FrameReport, n_points: int) -> None:
    """Raise an error if frames with points do not determine a camera."""
    n_seen, n_frames = report.n_seen, len(report.n_seen)
    few = (n_seen > 0) & (n_seen < min(FEWEST_POINTS, n_points))
    if few.any():
        row = few.argmax()
        raise ValueError(
            f"fewer than {FEWEST_POINTS} points are visible in {few.sum()} of "
            f"{n_frames} frames (first: row {row}, with {n_seen[row]}), too few to "
            "determine a camera. Leave out these rows"
        )
    line = report.on_line & ~report.in_one_place
    if line.any():
        raise ValueError(
            f"points are missing in {line.sum()} of {n_frames} frames (first: row "
            f"{line.argmax()}) and the others lie on one line, which does not "
            "determine a camera. Leave out these rows"
        )
    refuse_one_place(report, n_points)


def refuse_one_place(report: FrameReport, n_points: int) -> None:
    """Raise an error if all visible points of a frame are in one place."""
    one = report.in_one_place
    if one.any():
        which = "seen points" if (report.n_seen[one] < n_points).any() else "points"
        raise ValueError(
            f"all {which} are equal in {one.sum()} of {len(one)} frames (first: row "
            f"{one.argmax()}), so that they show no shape. Leave out these rows"
        )


def weighted_sizes(rows: NDArray, weights: NDArray) -> NDArray:
    """Return the weighted sizes (I,) of rows (I, 2, J) with weights (I, J).

    Weights of missing points are zero. If all of the weight is in one place, sizes are
    not weighted.
    """
    centred, report = centred_frames(rows)
    rows, shares = np.nan_to_num(centred), weights / weights.sum(axis=1)[:, None]
    place = np.vecdot(rows, shares[:, None])
    off = np.where(weights[:, None] > 0, rows - place[..., None], 0.0)
    square = np.vecdot(shares, (off**2).sum(axis=1)) / 2
    enough = square > (4 * np.finfo(float).eps * report.size) ** 2
    return np.where(enough, np.sqrt(square), report.size)
