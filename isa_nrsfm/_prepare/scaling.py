"""A table made ready for the fit: checked, each frame centred and of size one."""

import contextlib
from collections.abc import Hashable, Iterator, Sequence
from functools import partial
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray
from sklearn.utils import check_array
from sklearn.utils.validation import validate_data

from isa_nrsfm import _tables as tables
from isa_nrsfm._compat.caller import warn_caller
from isa_nrsfm._compat.scikit_learn import one_blas_thread
from isa_nrsfm._linalg import OF_DIFFERENCES
from isa_nrsfm._parameters import named
from isa_nrsfm._prepare.completion import completion_model
from isa_nrsfm._prepare.robust import DISTANT, robust_sizes, robustly_centred
from isa_nrsfm._tables import FrameBlocks, FrameReport, Layout, seen_points, unmasked
from isa_nrsfm.skeletons._column_names import names_layout, parse_coordinate

# With fewer frames or points than this the layouts are not compared.
FEWEST_COMPARED = 10
ONLY_POINTS = (
    "Give only the columns of points: isa_nrsfm.io.landmark_table(X).points has them"
)


def check_table(X: Any, layout: Layout) -> None:
    """Raise if X is no table of two dimensions, or has columns that are no points.

    Names of several levels, as DeepLabCut has them, are read as one.
    """
    shape: tuple[int, ...] = getattr(X, "shape", ())
    if not shape and hasattr(X, "points"):
        raise TypeError(
            f"X must be a table; give the points of {type(X).__name__}: X.points"
        )
    if isinstance(X, list | tuple):
        shape = np.shape(X)
    if len(shape) > 2:
        order = ".swapaxes(1, 2)" * ((layout == "planar") != (shape[-1] > 5))
        two = "" if 2 in shape[1:] else "[..., :2]" if shape[-1] < 6 else "[:, :2]"
        way = f": give np.asarray(X){two}{order}.reshape(len(X), -1)"
        raise ValueError(
            "X must be a table with one row per frame and two columns per point; got "
            f"the shape {shape}{way * (len(shape) == 3 and 1 < min(shape[1:]) < 6)}"
        )
    names = getattr(X, "columns", None)
    if names is not None:
        names = ["_".join(map(str, n)) if isinstance(n, tuple) else n for n in names]
        check_names(names, layout)


def validated_table(estimator: Any, X: Any, layout: Layout, reset: bool) -> NDArray:
    """Return a table as an array of numbers, checked by scikit-learn and by name."""
    check_table(X, layout)
    minimum = dict.fromkeys(("ensure_min_samples", "ensure_min_features"), 1 + reset)
    checks = tables.CHECKS | minimum
    try:
        X = validate_data(estimator, unmasked(X), reset=reset, **checks)
    except ValueError as error:
        if "could not convert" in str(error):
            raise ValueError(f"X has texts: {error}. {ONLY_POINTS}") from error
        raise
    return tables.checked_range(np.asarray(X))


def check_names(names: Sequence[Hashable], layout: Layout) -> None:
    """Raise an error if column names contradict the layout or are not of points."""
    said = names_layout(names)
    if said in (None, layout):
        return
    others = [str(n) for n in names if (c := parse_coordinate(n)) is None or c[0] > 1]
    if others:
        raise ValueError(
            f"{len(others)} of the {len(names)} columns are not named as the x or y of "
            f"a point (first: {others[0]!r}). {ONLY_POINTS}"
        )
    examples = ", ".join(map(str, names[:4]))
    order: str = said
    if said == "other":
        way = "isa_nrsfm.io.landmark_table(X).points has them interleaved"
        order = f"neither interleaved nor planar; {way}"
    raise ValueError(
        f"layout={layout!r} contradicts the column names ({examples}, ...), "
        f"whose order is {order}"
    )


def largest_n_components(n_points: int, camera: str | None = None) -> int:
    """Return the largest K that n_points points allow.

    The factorisation needs 3K + 3 directions in centred points. The joint fit with
    calibrated cameras needs it for a start only, with fewer basis shapes. A frame has
    2J - 2 centred coordinates, at most four unknowns of its camera and K coefficients;
    one coordinate has to be left for the noise. `camera` is None without a joint fit.
    """
    largest = (n_points - 1) // 3 - 1
    calibrated = camera not in (None, "affine")
    return 2 * n_points - 7 if calibrated and largest > 0 else largest


def smallest_n_frames(n_components: int, n_points: int) -> int:
    """Return the least number of frames that determines the shapes."""
    K = n_components
    # However many the points, W = M B leaves an invertible matrix between its factors:
    # 9 (K + 1)^2 unknowns, less the (K + 1)^2 + 8 of the gauge. A frame has 6 (K + 1)
    # entries of M, but 6 numbers of its camera and K coefficients: 5K equations. So
    # 5K I >= 8 (K + 1)^2 - 8 = 8K (K + 2), rounded up.
    smallest = -(-8 * (K + 2) // 5)
    if K <= largest_n_components(n_points):
        return smallest
    # Calibrated cameras: 3 (K + 1) (J - 1) unknowns of the shapes, less the K (K + 1) +
    # 3 of mixing, shift and rotation; a frame has 2J - 6 - K equations.
    unknowns = 3 * (K + 1) * (n_points - 1) - K * (K + 1) - 3
    return max(smallest, -(-unknowns // (2 * n_points - 6 - K)))


def most_components(n_frames: int, n_points: int, camera: str | None = None) -> int:
    """Return the largest K that a table of this size determines, zero if none."""
    numbers = range(1, largest_n_components(n_points, camera) + 1)
    enough = (k for k in numbers if n_frames >= smallest_n_frames(k, n_points))
    return max(enough, default=0)


def check_size(
    n_frames: int, n_points: int, n_components: int, camera: str | None = None
) -> None:
    """Refuse a table that is too small for the number of basis shapes."""
    largest = largest_n_components(n_points, camera)
    if n_components > largest:
        possible = f"at least 7 points are needed for {named('n_components', 1)}"
        if largest > 0:
            possible = f"the largest possible {named('n_components')} is {largest}"
        if largest > 0 and camera == "affine":
            n_max = largest_n_components(n_points, "weak_perspective")
            possible += (
                f" with affine cameras, and {n_max} with calibrated ones "
                f"({named('camera', 'weak_perspective')})"
            )
        of_affine = camera in (None, "affine")
        needed = 3 * n_components + 4 if of_affine else max(n_components // 2 + 4, 7)
        raise ValueError(
            f"{named('n_components', n_components)} needs at least {needed} points, "
            f"the table has {n_points}; {possible}"
        )
    smallest = smallest_n_frames(n_components, n_points)
    if n_frames < smallest:
        possible = ""
        if n_max := most_components(n_frames, n_points, camera):
            possible = f"; the largest possible {named('n_components')} is {n_max}"
        raise ValueError(
            f"{named('n_components', n_components)} needs at least {smallest} frames "
            f"(rows), the table has n_samples={n_frames}{possible}"
        )


def check_points(
    visible: NDArray, n_points: int, n_components: int, *columns: Any
) -> None:
    """Refuse tables whose visible points do not determine the shapes.

    `visible` (I, J) is packed, eight points in a byte. `columns` are the arguments of
    `describe_point`: their layout and names. The numbers of equations and
    unknowns are compared, a necessary condition. A point has 3 (K + 1) unknowns, and
    two equations per frame that shows it. A frame of n points has 2 n equations, and 8
    + K unknowns of its own.
    """
    if (visible == np.packbits(np.ones(n_points, dtype=bool))).all():
        return

    def name(point: Any) -> str:
        return tables.describe_point(int(point), *columns)

    patterns, counts = np.unique(visible, axis=0, return_counts=True)
    seen = np.unpackbits(patterns, axis=1, count=n_points).astype(bool)
    n_frames, n_shapes = counts @ seen, n_components + 1
    minimum = -(-3 * n_shapes // 2)
    rare_points = n_frames < minimum
    if rare_points.any():
        point = int(rare_points.argmax())
        raise ValueError(
            f"{named('n_components', n_components)} needs every point in at least "
            f"{minimum} frames; fewer show {rare_points.sum()} of {n_points} points "
            f"(first: {name(point)}, in {n_frames[point]} of {counts.sum()} "
            "frames). Leave out these points, or take fewer basis shapes"
        )
    equations = counts @ np.maximum(2 * seen.sum(axis=1) - 8 - n_components, 0)
    unknowns = 3 * n_shapes * (n_points - 1) - n_shapes**2 - 8
    if equations < unknowns:
        raise ValueError(
            f"too few points are visible for {named('n_components', n_components)}: "
            f"they determine {equations} numbers of the shapes, which have {unknowns}. "
            "Take fewer basis shapes, or leave out points that are rarely visible"
        )
    # Points seen together take the least number of their frames, until none changes.
    before, group = np.array(-1), np.arange(n_points)
    while (group != before).any():
        minimum = np.where(seen, group, n_points).min(axis=1, keepdims=True)
        before, group = group, np.where(seen, minimum, n_points).min(axis=0)
    if (n_groups := len(np.unique(group))) > 1:
        raise ValueError(
            f"the points fall into {n_groups} groups that no frame shows "
            "together, so that they cannot be joined to one object (first: "
            f"{name(group.argmax())} is never visible with {name(0)} and its group). "
            "Add frames that show points of both, or fit each group separately"
        )


def check_arrangement(
    rows: FrameBlocks, n_points: int, layout: Layout, scale_frames: bool, named: bool
) -> None:
    """Warn if an object with one basis shape fits the other layout much better.

    Raise if it fits points of three or four numbers, unless columns are named. Compares
    mean squares, not shares of the total energy. The wrong order mixes x and y, and a
    rigid object explains the energy of their offset. Without a basis shape, legs that
    walk, seen from two sides, fit the wrong layout better.
    """
    if min(rows.n_frames, n_points) < FEWEST_COMPARED:
        return
    # Some frames, evenly spread
    enough = max(min(1000, 1_000_000 // n_points), 100)
    sample = rows.take(np.arange(0, rows.n_frames, -(-rows.n_frames // enough)))
    X = tables.tracks_to_table(sample.transpose(0, 2, 1), layout)
    other = next(name for name in tables.LAYOUTS if name != layout)
    swapped = tables.table_to_rows(X, other)
    rigid = _noise_ratio(sample, swapped, scale_frames, 3)
    for n in [] if named else [3, 4]:
        if X.shape[1] % n == 0:
            parts = X.reshape(len(X), n, -1)
            if layout == "interleaved":
                parts = X.reshape(len(X), -1, n).transpose(0, 2, 1)
            certain = 0.1 if n == 3 else _visibility(parts)
            ratio = _noise_ratio(sample, parts[:, :2], scale_frames, 3)
            # docs/benchmarks/README.md, "Thresholds"
            if certain > 0.5 or (certain > 0.05 and ratio < min(0.65, rigid)):
                raise ValueError(
                    f"X seems to have {n} numbers for each point (x, y, z, or a "
                    f"visibility); x and y are needed. Give {tables.two_of(n, layout)}"
                )
    # On real tables the right layout leaves 0.05 to 0.61 of the energy of the wrong
    # one, and the wrong one at least 0.72 of that of the right one.
    with_basis = _noise_ratio(sample, swapped, scale_frames, 6)
    if with_basis < 0.65:
        warn_caller(
            f"layout={other!r} explains the table much better than layout={layout!r}: "
            f"what one basis shape leaves has {with_basis:.2g} times the energy"
        )


def _visibility(parts: NDArray) -> float:
    """Return how certainly the fourth of four numbers (I, 4, J) are visibilities.

    They are from 0 to 1, some above 0.5: the share of the others that are not. 1 if
    all are equal.
    """
    values, fourth = parts[:, :3], parts[:, 3]
    if not (np.isnan(fourth) | ((fourth >= 0) & (fourth <= 1))).all():
        return 0.0
    smallest, largest = np.nanmin(fourth), np.nanmax(fourth)
    if smallest < largest < 0.5:  # y of points in a row
        return 0.0
    return 1.0 if smallest == largest else float(np.mean((values < 0) | (values > 1)))


def _noise_ratio(rows: NDArray, other: NDArray, scale_frames: bool, rank: int) -> float:
    """Return the noise of other rows over that of given ones; inf for small tables."""
    both = [rows, tables.without_half_points(other)[0]]
    # Points that few frames show are left out first, then frames that show few points
    # in one of the orders.
    both = [r[:, :, seen_points(r).sum(axis=0) >= tables.FEWEST_POINTS] for r in both]
    n_seen = np.min([seen_points(r).sum(axis=1) for r in both], axis=0)
    both = [r[n_seen >= tables.FEWEST_POINTS] for r in both]
    if min(min(len(r), r.shape[2]) for r in both) < FEWEST_COMPARED:
        return np.inf
    # Low rank explains any table with hardly more numbers than it has unknowns.
    for r in both:
        if 2 * seen_points(r).sum() < 1.5 * rank * (2 * len(r) + r.shape[2] - rank):
            return np.inf
    centred, reports = zip(*map(tables.centred_frames, both), strict=True)
    # The size of a frame is the smaller of both orders, that of the right one.
    sizes = np.min([report.size for report in reports], axis=0)
    if not scale_frames:
        squares = [np.mean(report.size**2) for report in reports]
        sizes = np.full_like(sizes, np.sqrt(min(squares)))
    sizes = np.where(sizes > 0, sizes, 1.0)
    noise, swapped = (_residual(part / sizes[:, None, None], rank) for part in centred)
    return swapped / noise if noise > OF_DIFFERENCES else np.inf


def _residual(rows: NDArray, rank: int) -> float:
    """Return the noise variance of centred rows (I, 2, J) beyond some rank."""
    if np.isfinite(rows).all():
        W = rows.reshape(-1, rows.shape[2])
        energy = np.linalg.eigvalsh(W.T @ W if len(W) > W.shape[1] else W @ W.T)
        remaining = 1.0 - rank / (W.shape[1] - 1)  # of the dimensions
        return max(float(energy[:-rank].sum()), 0.0) / W.size / remaining
    return completion_model(rows, rank=rank)[1]


def checked(name: str, values: Any, *allowed: tuple[int, ...]) -> NDArray:
    """Return values as a finite array of the first of the allowed shapes, or raise."""
    checks: Any = {"input_name": name, "ensure_2d": False, "allow_nd": True}
    array = check_array(unmasked(values), dtype=tables.CHECKS["dtype"], **checks)
    if array.shape not in allowed:
        expected = " or ".join(map(str, allowed))
        raise ValueError(f"{name} must have shape {expected}; got {array.shape}")
    return np.broadcast_to(array, allowed[0])


def check_camera(model: Any) -> None:
    """Refuse a focal length without an axis, or perspective cameras without one."""
    camera, centre, f = model.camera, model.principal_point, model.focal_length
    if camera != "perspective" and (f is None) != (centre is None):
        raise ValueError(
            "focal_length and principal_point belong together: give both or none; got "
            f"focal_length={f!r}, principal_point={centre!r}"
        )
    if centre is None and camera != "perspective":
        return
    numbers = np.asarray(centre, dtype=float)
    if numbers.shape != (2,) or not np.isfinite(numbers).all():
        raise ValueError(
            f"camera={camera!r} needs principal_point=(x, y), the point of the image "
            "on the axis of the camera. If nothing else is known, give half of the "
            "image's width and height in pixels, such as (640, 360); normalised "
            "coordinates have focal_length=1, principal_point=(0, 0); got "
            f"principal_point={centre!r}"
        )


@contextlib.contextmanager
def undetermined(camera: str) -> Iterator[None]:
    """Raise an error of tables that determine no shapes in place of those of LAPACK."""
    try:
        yield
    except np.linalg.LinAlgError as error:
        raise ValueError(
            f"the table does not determine shapes with {named('camera', camera)}: its "
            "frames differ too little, or their points are on few lines. Add frames "
            f"that show the object from other sides, or set {named('camera', 'affine')}"
        ) from error


def check_frames_kept(estimator: Any, what: str) -> None:
    """Raise an error if the frames of the fit are needed and were not kept."""
    if not hasattr(estimator, "motion_"):
        raise ValueError(
            f"{what} needs the cameras and coefficients of the fitted table, which "
            "were not kept. Fit again with keep_frames=True. The face prior has no "
            "frames: fit a table with it"
        )


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


@one_blas_thread()
def scaled_table(
    blocks: FrameBlocks, weights: NDArray | None, n_components: int, settings: Any
) -> ScaledTable:
    """Check an opened table for K basis shapes; centre and scale its frames.

    With a robust loss that is robust. Weights (n_rows, J) are zero where points are
    missing, None where all are one. The settings are `FitSettings`. With a prior the
    table need not determine shapes.
    """
    layout, names, scale_frames = settings.layout, settings.names, settings.scale_frames
    robust, determines = settings.loss != "linear", settings.prior is None
    # Without the joint fit, basis shapes are those of the factorisation.
    camera = settings.camera if settings.joint else None
    n_points, dtype = blocks.empty.shape[2], blocks.empty.dtype
    if determines:
        check_size(blocks.n_frames, n_points, n_components, camera)
    examined = blocks.joined(partial(_examine, robust=robust))
    n_half, first, visible, largest, *parts = examined
    if n_half.any():
        tables.warn_of_half_points(n_half, first, layout, names)
        blocks = blocks.derive(lambda rows: tables.without_half_points(rows)[0])
    report = FrameReport(*parts)
    tables.check_frames(report, n_points)
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
        visible, largest, *parts = (part[usable] for part in (visible, largest, *parts))
        weights = None if weights is None else weights[usable]
    if determines:
        check_points(visible, n_points, n_components, layout, names)
        if weights is not None:
            check_weights(weights, n_components, camera)
    named = names is not None and names_layout(names) == layout
    check_arrangement(blocks, n_points, layout, scale_frames, named)
    translation, size, n_seen, *_ = parts
    if weights is not None:
        size = blocks.joined(tables.weighted_sizes, weights)
    if robust:
        # Outliers must not reduce the precision of other points.
        largest = np.minimum(largest, np.abs(translation).max(axis=1) + DISTANT * size)
    if not scale_frames:
        size = np.full_like(size, np.sqrt(np.mean(size**2)))
    # Large complete tables in single precision stay so: it saves memory, and time in
    # the SVD. With fewer points matrix products are so small that it saves nothing.
    complete = bool((n_seen == n_points).all())
    single = dtype == np.float32 and n_points >= 200 and complete and not robust
    working = np.float32 if single else np.float64

    def unit_rows(rows: NDArray, middle: NDArray, size: NDArray) -> NDArray:
        unit = (rows - middle[:, :, None]) / size[:, None, None]
        return unit.astype(working, copy=False)

    spacing = np.finfo(dtype).eps * largest.astype(np.float64)
    precision = float(np.sqrt(np.mean((spacing / size) ** 2)))
    unit = None if scale_frames else float(size[0])
    rows = blocks.derive(unit_rows, translation, size, kept=False)
    frames = usable, blocks, rows, size, translation, n_seen, n_points
    return ScaledTable(*frames, unit, precision, dtype, weights)


def _examine(rows: NDArray, robust: bool) -> tuple[NDArray, ...]:
    """Return half points, visible points, magnitudes, reports of rows (n, 2, J)."""
    rows, *half = tables.without_half_points(rows)
    _, report = tables.centred_frames(rows)
    usable = report.n_seen > 0
    if robust and usable.any():
        # Outliers must not shift the other points.
        centred, report.translation[usable] = robustly_centred(rows[usable])
        report.size[usable] = robust_sizes(centred)
    largest = np.fmax.reduce(np.abs(rows), axis=(1, 2), initial=0.0)
    return *half, np.packbits(seen_points(rows), axis=1), largest, *report


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
    checks: Any = {"input_name": "point_weight", "ensure_min_samples": 0}
    weights = check_array(unmasked(point_weight), dtype=float, order="C", **checks)
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
