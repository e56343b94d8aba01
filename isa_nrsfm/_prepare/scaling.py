"""A table made ready for the fit: checked, each frame centred and of size one."""

from functools import partial
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray
from sklearn.utils import check_array

from isa_nrsfm._compat.blas_threads import one_blas_thread
from isa_nrsfm._compat.caller import warn_caller
from isa_nrsfm._parameters.naming import named
from isa_nrsfm._prepare.checks import check_arrangement, check_points, check_size
from isa_nrsfm._prepare.robust import DISTANT, robust_sizes, robustly_centred
from isa_nrsfm._tables.blocks import FrameBlocks
from isa_nrsfm._tables.sources import unmasked
from isa_nrsfm._tables.tracks import (
    FrameReport,
    centred_frames,
    check_frames,
    seen_points,
    warn_of_half_points,
    weighted_sizes,
    without_half_points,
)
from isa_nrsfm.skeletons._column_names import names_layout

# Largest weight of a point: sums of weighted squares stay far from overflow.
LARGEST_WEIGHT = 1e30


class ScaledTable(NamedTuple):
    """A table made ready for the fit.

    shown (n_rows,): mask of the rows that show any point, the frames.
    source: their rows before centring and scaling.
    rows: blocks (I, 2, J) of centred frames of size one, NaN where not seen, computed
    at each reading.
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
    def complete(self) -> bool:
        """Whether all points are seen."""
        return bool((self.n_seen == self.n_points).all())


@one_blas_thread
def scaled_table(
    blocks: FrameBlocks, weights: NDArray | None, n_components: int, settings: Any
) -> ScaledTable:
    """Check an opened table for K basis shapes; centre and scale its frames.

    With a robust loss that is robust. Weights (n_rows, J) are zero where points are
    missing, None where all are one. The settings are `FitSettings`. With a prior the
    table need not determine shapes.
    """
    layout, names, scale_frames = settings.layout, settings.names, settings.scale_frames
    robust, camera = settings.loss != "linear", settings.camera
    if not settings.joint:  # basis shapes are those of the factorisation
        camera = None
    determines = settings.prior is None
    n_points, dtype = blocks.empty.shape[2], blocks.empty.dtype
    if determines:
        check_size(blocks.n_frames, n_points, n_components, camera)
    n_half, first, visible, largest, *rest = blocks.joined(
        partial(_examine, robust=robust)
    )
    if n_half.any():
        warn_of_half_points(n_half, first, layout, names)
        blocks = blocks.derive(lambda rows: without_half_points(rows)[0])
    report = FrameReport(*rest)
    check_frames(report, n_points)
    usable = report.n_seen > 0
    if not usable.all():
        if not usable.any():
            raise ValueError(
                f"no point is visible: all {len(usable)} rows of X are NaN. Check how "
                "the table was read"
            )
        warn_caller(
            f"no point is visible in {np.count_nonzero(~usable)} of {len(usable)} rows "
            f"(first: row {usable.argmin()}). They are left out of the fit, and their "
            "results are NaN"
        )
        if determines:
            check_size(int(usable.sum()), n_points, n_components, camera)
        blocks = blocks.subset(usable)
        visible, largest, *rest = (part[usable] for part in (visible, largest, *rest))
        weights = None if weights is None else weights[usable]
    if determines:
        check_points(visible, n_points, n_components, layout, names)
        if weights is not None:
            check_weights(weights, n_components, camera)
    named = names is not None and names_layout(names) == layout
    check_arrangement(blocks, n_points, layout, scale_frames, named)
    translation, size, n_seen, *_ = rest
    if weights is not None:
        size = blocks.joined(weighted_sizes, weights)
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
        usable,
        blocks,
        blocks.derive(unit_rows, translation, size, kept=False),
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
    """Return half points, visible points, magnitudes, reports of rows (n, 2, J)."""
    rows, *half = without_half_points(rows)
    _, report = centred_frames(rows)
    usable = report.n_seen > 0
    if robust and usable.any():
        # Outliers must not shift the other points.
        centred, report.translation[usable] = robustly_centred(rows[usable])
        report.size[usable] = robust_sizes(centred)
    largest = np.fmax.reduce(np.abs(rows), axis=(1, 2), initial=0.0)
    visible = np.packbits(seen_points(rows), axis=1)
    return *half, visible, largest, *report


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


def weighted_rows(
    rows: FrameBlocks, point_weight: Any
) -> tuple[FrameBlocks, tuple[NDArray, ...]]:
    """Return rows (n, 2, J) with NaN for points of weight zero, and the weights (n, J).

    Weights of missing points are zero. There are none if all visible ones are one.
    """
    if not rows.cached:
        raise ValueError(
            f"{named('point_weight')} needs a table in memory, because weights are not "
            "read block by block. Give a NumPy array or a dataframe, or no weights"
        )
    weights = check_array(
        unmasked(point_weight),
        dtype=np.float64,
        order="C",
        input_name="point_weight",
        ensure_min_samples=0,
    )
    shape = rows.n_frames, rows.empty.shape[2]
    if weights.shape != shape:
        raise ValueError(
            f"point_weight must have a row for each frame and a column for each point, "
            f"the shape {shape}; got {weights.shape}"
        )
    wrong = (weights < 0) | (weights > LARGEST_WEIGHT)
    if wrong.any():
        row, point = np.argwhere(wrong)[0]
        raise ValueError(
            f"point_weight must be between 0 and {LARGEST_WEIGHT:g}, because a weight "
            f"is a number of observations; got {weights[row, point]:g} in row {row}, "
            f"point {point}. Give points without information the weight 0"
        )
    nan = rows.empty.dtype.type(np.nan)
    weighted = rows.derive(
        lambda r, w: np.where(w, r, nan), weights[:, None], kept=False
    )
    visible = weighted.joined(seen_points)
    weights = np.where(visible, weights, 0.0)
    # Curvatures of the shapes must exceed rounding errors.
    minimum = 1e-8 * weights.max(axis=1, keepdims=True, initial=0.0)
    weights = np.where(weights > 0, np.maximum(weights, minimum), 0.0)
    return weighted, () if (weights == visible).all() else (weights,)


def check_weights(weights: NDArray, n_components: int, camera: str | None) -> None:
    """Refuse weights (I, J) that are fewer observations than frames have unknowns.

    The unknowns are camera, position and coefficients. Measured for 20 points and K =
    2: the error of the shapes is 0.75 % if the weights of a frame are 49 coordinates,
    0.89 % for 7, and 17 % for 5.
    """
    n_unknowns = n_components + (8 if camera == "affine" else 6)
    mean = float(weights.sum(axis=1).mean())
    if 2.0 * mean < n_unknowns:
        raise ValueError(
            f"the weights of a frame add up to {mean:.3g} observations on average, "
            f"fewer than the {n_unknowns / 2:g} that its camera and {n_components} "
            f"coefficients need. Multiply {named('point_weight')} by a number, so that "
            "points with the least noise have weights of about one"
        )
