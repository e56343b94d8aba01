"""A table made ready for the fit: checked, each frame centred and of size one."""

from functools import partial
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from isa_nrsfm._compat.caller import warn_caller
from isa_nrsfm._prepare.checks import (
    check_points,
    check_size,
    visible_points,
    warn_if_other_layout,
)
from isa_nrsfm._prepare.point_weights import check_weights
from isa_nrsfm._prepare.robust import DISTANT, robust_sizes, robustly_centred
from isa_nrsfm._tables.blocks import FrameBlocks
from isa_nrsfm._tables.tracks import (
    FrameReport,
    Layout,
    centred_frames,
    check_frames,
    weighted_sizes,
)


class ScaledTable(NamedTuple):
    """A table made ready for the fit.

    shown (n_rows,): mask of the rows that show any point, the frames.
    source: their rows before centring and scaling.
    rows: blocks (I, 2, J) of centred frames of size one, NaN where not seen.
    sizes, n_seen (I,): divisors of the frames, and their numbers of visible points.
    translation (I, 2): centroids of visible points, or medians with a robust loss.
    unit: the common size of all frames, None if each has its own.
    precision: rounding error of the coordinates of the table, relative to its frames.
    dtype: number type of the given table.
    weights (I, J): numbers of observations of the points, zero where not seen; None
    where each has one.
    """

    shown: NDArray
    source: FrameBlocks
    rows: FrameBlocks
    sizes: NDArray
    translation: NDArray
    n_seen: NDArray
    n_points: int
    unit: float | None
    precision: float
    dtype: Any
    weights: NDArray | None = None

    @property
    def n_observations(self) -> NDArray:
        """Numbers of observations (I,) of the frames."""
        return self.n_seen if self.weights is None else self.weights.sum(axis=1)

    @property
    def complete(self) -> bool:
        """Whether all points are seen."""
        return bool((self.n_seen == self.n_points).all())


def scaled_table(
    blocks: FrameBlocks,
    n_components: int,
    *,
    layout: Layout,
    names: NDArray | None,
    scale_frames: bool,
    robust: bool,
    camera: str | None = None,
    weights: NDArray | None = None,
) -> ScaledTable:
    """Check an opened table, centre and scale its frames, robustly if `robust`.

    Weights (n_rows, J) are zero where points are missing, None where all are one.
    """
    n_points, dtype = blocks.empty.shape[2], blocks.empty.dtype
    check_size(blocks.n_frames, n_points, n_components, camera)
    examined = blocks.map(partial(_examine, robust=robust))
    visible, largest, *rest = map(np.concatenate, zip(*examined, strict=True))
    report = FrameReport(*rest)
    check_frames(report, n_points)
    shown = report.n_seen > 0
    if not shown.all():
        if not shown.any():
            raise ValueError(
                f"no point is visible: all {len(shown)} rows of X are NaN. Check how "
                "the table was read"
            )
        warn_caller(
            f"no point is visible in {np.count_nonzero(~shown)} of {len(shown)} rows "
            f"(first: row {shown.argmin()}). They are left out of the fit, and their "
            "results are NaN"
        )
        check_size(int(shown.sum()), n_points, n_components, camera)
        blocks, report = blocks.subset(shown), report.of_frames(shown)
        visible, largest = visible[shown], largest[shown]
        weights = None if weights is None else weights[shown]
    check_points(visible, n_points, n_components, layout, names)
    if weights is not None:
        check_weights(weights, n_components, camera)
    warn_if_other_layout(blocks, n_points, layout, scale_frames)
    translation, size, n_seen = report[:3]
    if weights is not None:
        size = blocks.joined(_weighted_sizes, weights)
    if robust:
        # Outliers must not reduce the precision of other points.
        reach = np.abs(translation).max(axis=1) + DISTANT * size
        largest = np.minimum(largest, reach)
    if not scale_frames:
        size = np.full_like(size, np.sqrt(np.mean(size**2)))
    # Large complete tables in single precision stay so: it saves memory, and time in
    # the SVD. With fewer points matrix products are so small that it saves nothing.
    complete = bool((n_seen == n_points).all())
    single = dtype == np.float32 and n_points >= 200 and complete and not robust
    unit_rows = partial(_unit_rows, dtype=np.float32 if single else np.float64)
    spacing = np.finfo(dtype).eps * largest.astype(np.float64)
    return ScaledTable(
        shown,
        blocks,
        blocks.derive(unit_rows, translation, size),
        size,
        translation,
        n_seen,
        n_points,
        None if scale_frames else float(size[0]),
        float(np.sqrt(np.mean((spacing / size) ** 2))),
        dtype,
        weights,
    )


def _examine(rows: NDArray, robust: bool) -> tuple[NDArray, ...]:
    """Return visible points, magnitudes and reports of rows (n, 2, J)."""
    _, report = centred_frames(rows)
    shown = report.n_seen > 0
    if robust and shown.any():
        # Outliers must not shift the other points.
        centred, report.translation[shown] = robustly_centred(rows[shown])
        report.size[shown] = robust_sizes(centred)
    largest = np.fmax.reduce(np.abs(rows), axis=(1, 2), initial=0.0)
    return visible_points(rows), largest, *report


def _weighted_sizes(rows: NDArray, weights: NDArray) -> NDArray:
    """Return the sizes (n,) of rows (n, 2, J) with weights (n, J)."""
    centred, report = centred_frames(rows)
    return weighted_sizes(centred, weights, report.size)


def _unit_rows(
    rows: NDArray, translation: NDArray, sizes: NDArray, dtype: Any
) -> NDArray:
    """Return rows (n, 2, J) centred and of size one."""
    unit = (rows - translation[:, :, None]) / sizes[:, None, None]
    return unit.astype(dtype, copy=False)


def rows_without(rows: NDArray, left_out: NDArray) -> NDArray:
    """Return frames (n, 2, J) without points (n, J), centred over the others."""
    kept = np.where(left_out[:, None], np.nan, rows)
    return kept - np.nanmean(kept, axis=2, keepdims=True)
