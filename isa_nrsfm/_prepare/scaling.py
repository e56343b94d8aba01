"""A table made ready for the fit: checked, each frame centred and of size one."""

from functools import partial
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from isa_nrsfm._compat.caller import warn_caller
from isa_nrsfm._prepare.checks import (
    HalfPoints,
    PointReport,
    check_points,
    check_size,
    without_half_points,
)
from isa_nrsfm._prepare.layout_check import layout_sample, warn_if_other_layout
from isa_nrsfm._prepare.options import OUTLIER_OPTIONS
from isa_nrsfm._prepare.robust import robust_sizes, robustly_centred
from isa_nrsfm._tables.blocks import FrameBlocks
from isa_nrsfm._tables.layout import (
    Layout,
    refuse_odd,
    relative_precision,
    table_to_tracks,
)
from isa_nrsfm._tables.sources import Table
from isa_nrsfm._tables.visibility import (
    FrameReport,
    check_frames,
    check_places,
    report_frames,
    seen_points,
)

# With fewer points matrix products are so small that single precision saves nothing.
MANY_POINTS = 200


class ScaledTable(NamedTuple):
    """
    A table made ready for the fit.

    Attributes
    ----------
    shown : ndarray of bool, shape (n_rows,)
        Which rows of the table show any point. These rows are the frames.
    source : Table
        These rows before centring and scaling.
    rows : FrameBlocks
        Blocks of frames (n_frames, 2, n_points), x above y, without their translation
        and divided by their sizes; NaN where a point is not seen. Single precision
        where the table is large, complete and in single precision.
    sizes : ndarray of shape (n_frames,)
        What the frames were divided by.
    translation : ndarray of shape (n_frames, 2)
        What was subtracted: the centroids of the seen points, or their spatial medians
        with a robust loss.
    n_seen : ndarray of int, shape (n_frames,)
        Number of points that are seen.
    n_points : int
        Number of points.
    precision : float
        As of `relative_precision`.
    dtype : dtype
        Type of the numbers of the given table.
    """

    shown: NDArray
    source: Table
    rows: FrameBlocks
    sizes: NDArray
    translation: NDArray
    n_seen: NDArray
    n_points: int
    precision: float
    dtype: Any

    @property
    def complete(self) -> bool:
        """Whether all points are seen."""
        return bool((self.n_seen == self.n_points).all())

    def of_all_rows(self, values: NDArray) -> NDArray:
        """Return values (n_frames, ...) as (n_rows, ...), NaN for the other rows."""
        if self.shown.all():
            return values
        all_rows = np.full((len(self.shown), *values.shape[1:]), np.nan, values.dtype)
        all_rows[self.shown] = values
        return all_rows

    def part(self, rows: NDArray) -> "ScaledTable":
        """
        Return a part of the table.

        Parameters
        ----------
        rows : ndarray of bool, shape (n_rows,)
            Which rows of the table.

        Returns
        -------
        ScaledTable
            The table of these rows, their frames scaled as they are. Whether they are
            enough for a fit is not checked.
        """
        kept = rows[self.shown]
        return self._replace(
            shown=self.shown[rows],
            source=self.source._replace(blocks=self.source.blocks.subset(kept)),
            rows=self.rows.subset(kept),
            sizes=self.sizes[kept],
            translation=self.translation[kept],
            n_seen=self.n_seen[kept],
        )


def scaled_table(
    table: Table,
    n_components: int,
    *,
    layout: Layout,
    names: NDArray | None,
    scale_frames: bool,
    robust: bool,
) -> ScaledTable:
    """
    Check a table and make it ready for the fit.

    Parameters
    ----------
    table : Table
        The table.
    n_components : int
        K, the number of basis shapes.
    layout : {"interleaved", "planar"}
        Order of the columns.
    names : ndarray of shape (2 * n_points,) or None
        Names of the columns.
    scale_frames : bool
        Whether each frame is divided by its own size, or all by a common one.
    robust : bool
        Whether frames are centred at their `spatial_median` and their sizes are those
        of `robust_sizes`, or at their means and sizes are root mean squares.

    Returns
    -------
    ScaledTable
        The table.

    Raises
    ------
    ValueError
        If the table is too small, or frames or points of it show too little.

    Warns
    -----
    UserWarning
        If points have only one coordinate, if rows without any point are left out, or
        if the columns seem to be in another order.
    """
    blocks, n_columns, dtype = table
    n_points = n_columns // 2
    refuse_odd(n_columns)
    check_size(blocks.n_frames, n_points, n_components)
    found = list(blocks.map(partial(_examine, layout=layout)))
    frames, points, half = zip(*found, strict=True)
    HalfPoints.merged(half, blocks.lengths).warn(layout, names)
    report = FrameReport(*map(np.concatenate, zip(*frames, strict=True)))
    check_frames(report, n_points)
    shown = report.n_seen > 0
    if not shown.all():
        _warn_of_empty(shown)
        check_size(int(shown.sum()), n_points, n_components)
        blocks, report = blocks.subset(shown), report.of_frames(shown)
    check_points(PointReport.merged(points), report.n_seen, n_components, layout, names)
    check_places(report, n_points)
    n_frames = blocks.n_frames
    sampled = np.arange(n_frames)[layout_sample(n_frames, n_columns)]
    warn_if_other_layout(blocks.take(sampled), layout, scale_frames)
    size = np.sqrt(report.square / (2 * report.n_seen))
    translation, largest = report.translation, report.largest
    if robust:
        # A point far off must neither move the others nor cost their digits.
        robust_places = list(blocks.map(partial(_robust_places, layout=layout)))
        translation, size = map(np.concatenate, zip(*robust_places, strict=True))
        reach = OUTLIER_OPTIONS.distant * size
        largest = np.minimum(largest, np.abs(translation).max(axis=1) + reach)
    if not scale_frames:
        size = np.full_like(size, np.sqrt(np.mean(size**2)))
    # Single precision for large complete tables: it saves memory, and time in the SVD.
    single = dtype == np.float32 and n_points >= MANY_POINTS and not robust
    single = single and bool((report.n_seen == n_points).all())
    unit_rows = partial(
        _unit_rows, layout=layout, dtype=np.float32 if single else np.float64
    )
    rows = blocks.derive(unit_rows, translation, size)
    precision = relative_precision(largest, dtype, size)
    return ScaledTable(
        shown,
        table._replace(blocks=blocks),
        rows,
        size,
        translation,
        report.n_seen,
        n_points,
        precision,
        dtype,
    )


def _warn_of_empty(shown: NDArray) -> None:
    """Warn of rows that show no point, or refuse a table without any."""
    if not shown.any():
        raise ValueError(f"X shows no point: all of its {len(shown)} row(s) are NaN")
    empty = ~shown
    warn_caller(
        f"{empty.sum()} of {len(empty)} row(s) show no point and are left out of the "
        f"fit, the first is row {empty.argmax()}",
    )


def _examine(
    rows: NDArray, layout: Layout
) -> tuple[FrameReport, PointReport, HalfPoints]:
    """Return what the checks need of some rows (n_rows, 2 * n_points) of a table."""
    tracks, half = without_half_points(table_to_tracks(rows, layout))
    return report_frames(tracks), PointReport.from_seen(seen_points(tracks)), half


def _robust_places(rows: NDArray, layout: Layout) -> tuple[NDArray, NDArray]:
    """Return medians (n, 2) and robust sizes (n,) of some rows (n, 2 * n_points)."""
    tracks, _ = without_half_points(table_to_tracks(rows, layout))
    centred, middle = robustly_centred(tracks)
    return middle, robust_sizes(centred)


def _unit_rows(
    rows: NDArray, translation: NDArray, sizes: NDArray, layout: Layout, dtype: Any
) -> NDArray:
    """Return rows of a table as frames (n_frames, 2, n_points) of size one, centred.

    Rows are (n_frames, 2 * n_points), translation (n_frames, 2), sizes (n_frames,).
    """
    tracks, _ = without_half_points(table_to_tracks(rows, layout))
    centred = np.array(tracks.transpose(0, 2, 1), dtype=np.float64, order="C")
    centred -= translation[:, :, None]
    centred /= sizes[:, None, None]
    return centred.astype(dtype, copy=False)


def rows_without(rows: NDArray, left_out: NDArray) -> NDArray:
    """
    Return frames without some of their points.

    Parameters
    ----------
    rows : ndarray of shape (n_frames, 2, n_points)
        Frames.
    left_out : ndarray of bool, shape (n_frames, n_points)
        The points.

    Returns
    -------
    ndarray of shape (n_frames, 2, n_points)
        Frames centred over the other points that are seen, NaN elsewhere.
    """
    kept = np.where(left_out[:, None], np.nan, rows)
    return kept - np.nanmean(kept, axis=2, keepdims=True)
