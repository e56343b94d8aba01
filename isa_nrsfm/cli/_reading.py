"""Read the table of a command: landmarks, layout, columns, times, unusable rows."""

import re
import shlex
import warnings
from argparse import Namespace
from collections.abc import Sequence
from itertools import product
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from isa_nrsfm import AffineNRSfM, _tables, skeletons
from isa_nrsfm._compat import pandas as pd, texts
from isa_nrsfm._compat.caller import warn_caller
from isa_nrsfm._compat.files import errors_of, reading
from isa_nrsfm._compat.texts import FRAME, IMAGE_NAME, first_items
from isa_nrsfm._parameters import FACE_PRIORS, SKELETON_NAMES
from isa_nrsfm._prepare.coordinates import UNSURE, CoordinateWarning, warn_of_places
from isa_nrsfm._tables import FEWEST_POINTS
from isa_nrsfm.cli._options import CONFIGURATIONS, NONE, TIMES, flag_of
from isa_nrsfm.io import FORMATS, _landmark_columns, _tables as io_tables
from isa_nrsfm.io._formats import TABLE, find_format
from isa_nrsfm.io._landmark_columns import LandmarkColumns, find_landmark_columns
from isa_nrsfm.io._landmarks import unsure_points
from isa_nrsfm.io._tables import confidences_in, read_table, tracks_in
from isa_nrsfm.skeletons import SKELETONS, Skeleton, _column_names
from isa_nrsfm.skeletons._column_names import names_of_points, parse_coordinate
from isa_nrsfm.skeletons._recognition import skeleton_in_images

# Options of some formats.
_OF_FORMATS = ("image_size", "columns", "individuals", "row_per_point", "part")
INNER, WITHOUT = "inner", "without:"
# Rows and points that are listed in reports, at most.
MOST_LISTED = 10
# The columns of the size of an image, in pixels, by format.
_SIZES = {"coco": ("width", "height"), "pyfeat": ("FrameWidth", "FrameHeight")}
# Words for an empty cell in the column of a label or a group. "None" is a class, such
# as that of people without glasses.
_MISSING = ("", "na", "n/a", "#n/a", "<na>", "nan", "nat", "null")


class Frames(NamedTuple):
    """The rows of a table as frames.

    ``points`` and ``other`` are the landmarks and the other columns of the rows that
    are not skipped, by the number of the row in the table. ``X`` has the landmarks of
    usable rows, which can be fitted. ``left_out`` has the entries of the report on
    other rows, ``not_used`` the sizes of unused sets of coordinates.
    ``images`` are the numbers of the images that all rows show, under the name of their
    column, if any.
    ``weighting`` has the weights of the points of X as an argument of `fit`, if asked
    for. Labels, groups and times of the usable rows come from `asked_columns`. Labels
    are NaN where they are not known. Those of classes are categories.
    ``principal_point`` is given, or the middle of images of one known size.
    """

    points: "pd.DataFrame"
    X: "pd.DataFrame"
    other: "pd.DataFrame"
    columns: LandmarkColumns
    not_used: dict[str, int]
    left_out: list[dict[str, Any]]
    skeleton: Skeleton | None
    images: "pd.Series"
    weighting: dict[str, Any]
    labels: "Sequence[pd.Series]" = ()
    groups: NDArray | None = None
    times: NDArray | None = None
    time_unit: str = "seconds"
    principal_point: tuple[float, float] | None = None


def read_frames(
    args: Namespace,
    estimator: AffineNRSfM | None = None,
    table: "pd.DataFrame | None" = None,
) -> Frames:
    """Read the table if none is given, and take its frames; those of a model's points.

    The format in the options becomes the one found, and the coordinates of missing
    points become those of all options.
    """
    found = chosen = layout = sure = None
    args.format = _format(args) if table is None else TABLE
    args.missing_value = sorted({*args.missing_value, *[0.0] * args.zeros_missing})
    if args.format != TABLE or (table is None and Path(args.table).is_dir()):
        form, given = FORMATS[args.format], vars(args) | {"missing": args.missing_value}
        options = {name: given[name] for name in form.options if given.get(name)}
        found = form.read(args.table, **options)
        table, layout = pd.concat([found.frames, found.points], axis=1), found.skeleton
        x, y = tuple(found.points)[::2], tuple(found.points)[1::2]
        chosen = LandmarkColumns(f"those of {args.format}", found.point_names, x, y)
        if found.confidence is not None:
            sure = found.confidence.set_axis(x, axis=1)
    elif table is None:
        table = io_tables.individuals_as_rows(read_table(args.table), args.individuals)
        shape = args.columns, args.row_per_point
        table, names = _landmark_columns.frames_of(table, *shape)
        if names is not None:
            chosen = find_landmark_columns(table.columns, names)
    if estimator is not None:
        columns = _columns_of_model(estimator, table, chosen)
    else:
        columns = chosen or find_landmark_columns(table.columns)
    table, sure, not_used = _with_confidences(args, table, columns, sure)
    kept, left_out = _rows_to_keep(args, table)
    if estimator is not None and chosen is not None:
        layout = _part_of_layout(layout, [chosen.x.index(name) for name in columns.x])
    elif args.points is not None:
        layout = _layout(args, table[kept], columns, layout)
        numbers = _kept_points(args.points, columns.points, layout)
        points, x, y = (tuple(each[j] for j in numbers) for each in columns[1:4])
        dropped = [name for name in columns.interleaved if name not in {*x, *y}]
        columns = columns._replace(points=points, x=x, y=y)
        layout = _part_of_layout(layout, numbers)
        table = table.drop(columns=dropped)
        not_used[f"--points {args.points}"] = len(dropped) // 2
    rows, names = np.flatnonzero(kept), columns.interleaved
    titles = [name.strip() for name in names]
    rows_kept = slice(None) if kept.all() else kept  # large tables are not copied
    tracks = tracks_in(table[rows_kept], names, args.missing_value)
    tracks = _tables.of_all_rows(tracks, kept)
    confidence = sure.reindex(columns=list(columns.x)).to_numpy(np.float64)
    if args.min_confidence is not None:
        with errors_of(f"--min-confidence {args.min_confidence:g}"):
            tracks[unsure_points(confidence, args.min_confidence)] = np.nan
    if not args.keep_zeros and (zeros := zeros_far_away(tracks)).any():
        tracks[zeros] = np.nan
        args.missing_value = sorted({*args.missing_value, 0.0})
        warn_caller(
            f"{zeros.sum():,} points at (0, 0), in {zeros.any(axis=1).sum():,} rows, "
            "are missing: other points are elsewhere. --keep-zeros keeps them",
            CoordinateWarning,
        )
    cleaned = _tables.clean_rows(tracks.mT, "interleaved", np.array(titles))[rows_kept]
    tracks, confidence, weighting = cleaned.mT, confidence[rows_kept], {}
    if args.weights is not None:
        tracks[confidence == 0] = np.nan
        if (smallest := np.nanmin(confidence, initial=0.0)) < 0:
            raise ValueError(
                f"--weights: confidences of {args.table} are down to {smallest:g}, and "
                "weights not below 0. Save probabilities, such as numpy.exp of "
                "log-likelihoods"
            )
        if (largest := np.nanmax(confidence, initial=0.0)) > 1:
            confidence = confidence / largest
            warn_caller(f"confidences up to {largest:g} are divided by it, as weights")
        weighting["point_weight"] = np.where(np.isnan(confidence), 1.0, confidence)
    _, report = _tables.centred_frames(cleaned)
    reasons = _reasons(report, None if found is None else found.failed[rows])
    left_out += [_left_out(why, rows[which]) for why, which in reasons.items()]
    usable = slice(None) if report.usable.all() else report.usable
    warn_of_places(tracks[usable], confidence[usable], args.format)
    if args.min_confidence is None and args.weights is None:
        _warn_of_unsure(confidence, ~np.isnan(tracks[..., 0]))
    other = table.drop(columns=names)
    if found is None:
        sets = _landmark_columns.landmark_sets(other.columns)
        if columns.z:
            sets[f"{columns.z[0].strip()}, ... (third coordinate)"] = len(columns.z)
        not_used = sets | not_used
    points = pd.DataFrame(_tables.tracks_to_table(tracks), index=rows, columns=titles)
    return Frames(
        points=points,
        X=points[usable],
        other=other.loc[kept],
        columns=columns,
        not_used=not_used,
        left_out=[out for out in left_out if out["n_rows"]],
        skeleton=layout,
        images=image_numbers(table, vars(args).get("fps")),
        weighting={name: each[report.usable] for name, each in weighting.items()},
        principal_point=_principal_point(args, other),
    )


def _warn_of_unsure(confidence: NDArray, seen: NDArray) -> None:
    """Warn of seen points (n_frames, n_points) of low confidence, if some are sure.

    Other numbers are no probabilities. The advice leaves at least half of the table.
    """
    unsure = seen & (confidence < UNSURE)
    if unsure.any() and UNSURE <= np.nanmax(confidence) <= 1:
        before, after = seen.sum(axis=1), (seen & ~unsure).sum(axis=1)
        left, whole = (np.sum(each >= FEWEST_POINTS) for each in (after, before))
        enough = 2 * after.sum() >= before.sum() and 2 * left >= whole
        way = f"leave them out with --min-confidence {UNSURE:g}"
        warn_caller(
            f"{100 * unsure.sum() / seen.sum():.3g} % of the points have a confidence "
            f"below {UNSURE:g}, and count like all others. If they are wrong, "
            f"{way if enough else 'give them less weight with --weights confidence'}"
        )


def column_named(table: "pd.DataFrame", name: str, option: str) -> "pd.Series":
    """Return a column of a table, without regard to blanks around its name."""
    by_name = {str(each).strip(): each for each in table.columns}
    if name.strip() not in by_name:
        raise ValueError(
            f"{option}: the table has no column {name!r}; its columns are "
            f"{first_items(filter(None, by_name), 8) or 'none'}"
        )
    return table[by_name[name.strip()]]


def cells_of(table: "pd.DataFrame", name: str, option: str) -> "pd.Series":
    """Return a column, missing where its text is empty or a word for missing."""
    column = column_named(table, name, option)
    if column.dtype.kind != "O":  # neither texts nor categories
        return column
    text = column.astype(object).astype(str).str.strip()
    return text.where(column.notna() & ~text.str.lower().isin(_MISSING))


def as_fitted(estimator: AffineNRSfM, points: "pd.DataFrame") -> Any:
    """Return a table of landmarks with the columns that the model was fitted to."""
    fitted = getattr(estimator, "feature_names_in_", None)
    if fitted is None:
        tracks = points.to_numpy().reshape(len(points), len(estimator.mean_shape_), 2)
        return _tables.tracks_to_table(tracks, estimator.layout)
    in_order = points[[str(name).strip() for name in fitted]]
    return in_order.set_axis(list(fitted), axis=1)


def _format(args: Namespace) -> str:
    """Return the format of the table, and refuse options of another one."""
    found: str = args.format
    if found == "auto":
        found = TABLE if args.columns is not None else find_format(args.table)
    near = args.command == "fit" and args.camera not in ("affine", "orthographic")
    known = (*FORMATS[found].options, *["image_size"] * near)
    for name in _OF_FORMATS:
        if getattr(args, name) is not None and name not in known:
            having = [each for each in FORMATS.values() if name in each.options]
            suffix = Path(args.table).suffix.lower()
            having = [each for each in having if suffix in each.suffixes] or having
            needed = f"--format {' or '.join(each.name for each in having)}"
            has = f"{args.table} has format {found}"
            raise ValueError(f"{flag_of(name)} needs {needed}; {has}")
    return found


def _principal_point(
    args: Namespace, other: "pd.DataFrame"
) -> tuple[float, float] | None:
    """Return the point on the axis of the camera, or the middle of the images."""
    if args.principal_point is not None:
        return tuple(args.principal_point)
    names = [*_SIZES.get(args.format, ("image_width", "image_height"))]
    size = args.image_size
    if size is None and {*names} <= {*other}:
        sizes = other[names].apply(pd.to_numeric, errors="coerce").drop_duplicates()
        if len(sizes) == 1 and (sizes > 0).all(axis=None):
            size = sizes.to_numpy()[0]
    return None if size is None else (float(size[0]) / 2, float(size[1]) / 2)


def _with_confidences(
    args: Namespace,
    table: "pd.DataFrame",
    columns: LandmarkColumns,
    known: "pd.DataFrame | None",
) -> tuple["pd.DataFrame", "pd.DataFrame", dict[str, int]]:
    """Take confidences out of a table; those of other formats are known.

    Returns the table, the confidences by the names of x, if there are any, and those of
    a plain table that are not used.
    """
    option = "--weights" * (args.weights is not None)
    option = option if args.min_confidence is None else "--min-confidence"
    names = []
    if known is None:
        known = confidences_in(table, columns.x, columns.y, strict=bool(option))
        names = [*known]
        known = known.set_axis([*columns.x][: len(names)], axis=1)
    if not known.empty and known.min(axis=None) == known.max(axis=None):
        if option:
            raise ValueError(
                f"{option}: all confidences of {args.table} are "
                f"{known.max(axis=None):g}: they do not tell points apart"
            )
        known = known[[]]
    if known.empty and option:
        raise ValueError(
            f"{option}: {args.table} ({args.format}) has no confidences of all points. "
            "Their columns need the names of the x columns, with one of the words "
            f"{', '.join(_landmark_columns.CONFIDENCES)} for x, such as nose_conf "
            "beside nose_x"
        )
    not_used = {f"{names[0].strip()}, ... (confidences)": len(names)} if names else {}
    return table.drop(columns=names), known, {} if option else not_used


def _rows_to_keep(
    args: Namespace, table: "pd.DataFrame"
) -> tuple[NDArray, list[dict[str, Any]]]:
    """Return which rows no rule skips, and the rows that each rule skips."""
    kept = np.ones(len(table), dtype=bool)
    skipped = []
    for column, expression in args.skip_rows:
        cells = column_named(table, column, "--skip-rows")
        texts = cells.astype(object).where(cells.notna(), "").astype(str)
        matches = kept & texts.map(expression.search).notna().to_numpy()
        reason = f"{column} matches {expression.pattern!r}"
        skipped.append(_left_out(reason, np.flatnonzero(matches), True))
        kept &= ~matches
    return kept, skipped


def _left_out(reason: str, rows: NDArray, skipped: bool = False) -> dict[str, Any]:
    """Return the entry of the report on rows that are left out."""
    entry = {"reason": reason, "skipped_on_request": skipped, "n_rows": len(rows)}
    return entry | {"first_rows": rows[:MOST_LISTED]}


def _reasons(report: _tables.FrameReport, failed: NDArray | None) -> dict[str, NDArray]:
    """Return reasons why frames cannot be fitted, and the frames of each."""
    nothing, few = report.n_seen == 0, report.n_seen < FEWEST_POINTS
    in_one_place = report.in_one_place & ~few
    reasons = {"all points missing": nothing}
    if failed is not None:
        reasons = {"tracking failed": failed}
        reasons["all points missing or uncertain"] = nothing & ~failed
    return reasons | {
        f"fewer than {FEWEST_POINTS} points": few & ~nothing,
        "all points in one place": in_one_place,
        "points on one line, others missing": ~(report.usable | few | in_one_place),
    }


def _columns_of_model(
    estimator: AffineNRSfM, table: "pd.DataFrame", chosen: LandmarkColumns | None
) -> LandmarkColumns:
    """Return the columns of a model's points; chosen are the landmarks, if known."""
    fitted = getattr(estimator, "feature_names_in_", None)
    if fitted is None:
        found = chosen or find_landmark_columns(table.columns)
        n_points = len(estimator.mean_shape_)
        if len(found.points) != n_points:
            has = f"{len(found.points)} ({found.pattern})"
            raise ValueError(f"the model has {n_points} points, the table has {has}")
        return found
    stripped = np.array([[str(name).strip() for name in fitted]])
    names = _tables.table_to_tracks(stripped, estimator.layout).ravel().tolist()
    in_table = {str(name).strip(): name for name in table.columns}
    present = list(in_table)
    coordinates = [name for name in present if parse_coordinate(name) is not None]
    if chosen is not None:
        present = coordinates = [name.strip() for name in chosen.interleaved]
    absent = [name for name in names if name not in present]
    surplus = [name for name in coordinates if name not in names]
    # Points after those of the model are of another layout. Others were left out of it.
    first = {*coordinates[: len(names)]}
    if absent or (surplus and chosen is not None and first == {*names}):
        differences = [
            f"{len(some)} columns are only in the {where} ({first_items(some)})"
            for some, where in ((absent, "model"), (surplus, "table"))
            if some
        ]
        text = "; ".join(differences)
        if who := _column_names.individuals_with(table.columns, names[::2]):
            option = f"--individuals {shlex.quote(','.join(who))}"
            text += f". Individuals in one row: {option}"
        raise ValueError(f"the table does not have the points of the model: {text}")
    columns = [in_table[name] for name in names]
    x, y = tuple(columns[::2]), tuple(columns[1::2])
    return LandmarkColumns("those of the model", names_of_points(estimator), x, y)


def _layout(
    args: Namespace,
    table: "pd.DataFrame",
    columns: LandmarkColumns,
    stored: Skeleton | None,
) -> Skeleton | None:
    """Return the layout of all points of a table: given, stored, or recognised."""
    if args.skeleton is not None:
        given = _given_layout(args.skeleton, columns.points)
        return given if given.n_points == len(columns.points) else None
    if stored is not None:
        return stored
    tracks = tracks_in(table, columns.interleaved, args.missing_value)
    return skeleton_in_images(tracks, columns.points)


def zeros_far_away(tracks: NDArray) -> NDArray:
    """Return which points (n_frames, n_points) at (0, 0) are missing.

    They are there exactly, in at least three frames, and all other points are to one
    side of (0, 0) in x and in y, or farther away than they are spread (root mean square
    distance from their centroid).
    """
    zeros = (tracks == 0).all(axis=2)
    # The origin of the coordinates is one point in all frames.
    zeros &= (~zeros & ~np.isnan(tracks[..., 0])).any(axis=0)
    if zeros.any(axis=1).sum() > 2:
        others = tracks[~zeros]
        beyond = (np.nanmin(others, axis=0) > 0) | (np.nanmax(others, axis=0) < 0)
        spread = np.sqrt(np.nanvar(others, axis=0).sum())
        if beyond.all() or np.nanmin(np.linalg.norm(others, axis=1)) > spread:
            return zeros
    return np.zeros_like(zeros)


def face_layout(args: Namespace, frames: Frames) -> str | None:
    """Return the name of the layout of a table, if there is a face prior of it."""
    layout, columns = frames.skeleton, frames.columns
    if layout is None:
        table = frames.X.set_axis(columns.interleaved, axis=1)
        layout = _layout(args, table, columns, None)
    return layout.name if layout is not None and layout.name in FACE_PRIORS else None


def _given_layout(skeleton: str, names: Sequence[str]) -> Skeleton:
    """Return the layout that --skeleton names, or that its configuration has."""
    if Path(skeleton).suffix.lower() in CONFIGURATIONS:
        return skeletons.read_skeleton(skeleton, names)
    return skeletons.get_skeleton(skeleton)


def _part_of_layout(layout: Skeleton | None, points: Sequence[int]) -> Skeleton | None:
    """Return the layout of some of its points, a known one if there is one."""
    if layout is None or {*points} == {*range(layout.n_points)}:
        return layout
    part = layout.subset(points)
    layouts = (s for s in SKELETONS.values() if s.n_points == part.n_points)
    return next((s for s in layouts if s.curves == part.curves), part)


def _kept_points(
    text: str, names: Sequence[str], layout: Skeleton | None
) -> Sequence[int]:
    """Return the numbers of the points that --points keeps, in their order."""
    if text == INNER:
        if layout is None or not layout.contour:
            layouts = ", ".join(s.name for s in SKELETONS.values() if s.contour)
            found = "in no known layout" if layout is None else f"of {layout.name}"
            raise ValueError(
                "--points inner leaves out the visible outline of a face, but the "
                f"{len(names)} points are {found}: name the points to keep, or give "
                f"--skeleton ({layouts})"
            )
        return layout.inner.tolist()
    numbers = _column_names.point_places(names)
    parts = map(str.strip, text.removeprefix(WITHOUT).split(","))
    named = {j for part in parts for j in _range(part, numbers, names)}
    if text.startswith(WITHOUT):
        named = {*range(len(names))} - named
    return sorted(named)


def _range(part: str, numbers: dict[str, int], names: Sequence[str]) -> range:
    """Return the points of a name, a number, or two with a hyphen between them."""
    places = [i for i, letter in enumerate(part) if letter == "-"]
    for ends in [(part, part), *((part[:i], part[i + 1 :]) for i in places)]:
        first, last = (numbers.get(end.strip(), -1) for end in ends)
        if 0 <= first <= last:
            return range(first, last + 1)
    raise ValueError(
        f"--points: there are no points {part!r}; the {len(names)} points are "
        f"{', '.join(names[:4])}, ...; write inner, or names and ranges such as "
        "17-67 or without:0-16"
    )


def drawing_options(args: Namespace) -> list[str]:
    """Return the options of drawing that are given, as words of a command line."""
    given = {f"--{name}": vars(args)[name] for name in ("edges", "skeleton", "origin")}
    return [word for pair in given.items() if pair[1] is not None for word in pair]


def drawing_files(args: Namespace) -> list[str]:
    """Return the files that the options of drawing name."""
    named = [args.edges, args.skeleton]
    return [each for each in named if each not in (None, NONE, *SKELETON_NAMES)]


def drawing(
    args: Namespace, names: Sequence[str], stored: Skeleton | None
) -> dict[str, Any]:
    """Return the options of displays: lines to draw, where y is zero.

    The lines are those of an option, or of the skeleton stored in the table.
    """
    edges: Any = "auto"
    if args.edges == NONE:
        edges = None
    elif args.edges is not None:
        edges = _read_edges(args.edges, names, numbered=args.points is None)
    # With --points, --skeleton is the layout of all points, and `stored` of the rest.
    elif args.skeleton is not None and (args.points is None or stored is None):
        edges = _given_layout(args.skeleton, names)
        if edges.n_points != len(names):
            numbers = f"{edges.n_points} points, the table {len(names)}"
            raise ValueError(f"--skeleton {args.skeleton} has {numbers}")
    elif stored is not None:
        named = stored.point_names is not None and sorted(stored.point_names)
        edges = stored.reordered(names) if named == sorted(names) else stored
    return {"edges": edges, "origin": args.origin or "auto"}


def _read_edges(path: str, names: Sequence[str], numbered: bool) -> NDArray:
    """Read pairs of points (n_edges, 2), by name or also by number."""
    with reading(path, "a list of edges"):
        lines = Path(path).read_text(encoding="utf-8-sig").splitlines()
    edges: list[list[int]] = []
    places = _column_names.point_places(names)
    numbers = places if numbered else {name: places[name] for name in names}
    for number, line in enumerate(lines, 1):
        if not line.strip():
            continue
        edges.append([numbers.get(name.strip(), -1) for name in line.split(",")])
        if len(edges[-1]) != 2 or -1 in edges[-1]:
            raise ValueError(
                f"{path}, line {number}: expected the names of two points with "
                f"a comma between them, such as {', '.join(names[:2])} (without "
                f"--points also their numbers from zero); got {line!r}"
            )
    if not edges:
        raise ValueError(f"{path} has no edges; use --edges none to draw only points")
    return np.array(edges)


# Times of frames: numbers, dates and durations, each in one reading for all rows.
_MINUTES, _ALL_THREE, _HOURS = _DURATIONS = ("%M:%S", "%H:%M:%S", "%H:%M")
_DURATION = r"^(?:(\d+):(?=[0-5]?\d:))?(\d+):([0-5]\d(?:\.\d+)?)$"
_DAYS = [date.format(sign) for date, sign in product(TIMES["dates"], "/-. ")]
_OF_DAY = TIMES["of_day"]
# The ways in which dates and durations are usually written.
_FORMATS = ["ISO8601", *_DAYS, *map(" ".join, product(_DAYS, _OF_DAY))]
_FORMATS += [*_OF_DAY[3:], _MINUTES, _HOURS]
_ZONE = r".*:\d\d.*(?:Z|[+-]\d\d:?\d*)"


def read_times(column: "pd.Series", format: str | None) -> tuple[NDArray, str]:
    """Return times as numbers, dates, or durations in seconds, and their unit.

    All cells are read in one format, which is given, or the only one that reads all.
    """
    if column.dtype.kind == "m":
        return np.asarray(column.dt.total_seconds()), "seconds"
    if column.dtype.kind == "M":
        return np.asarray(_read(column, None)), "seconds"
    cells = column.dropna().astype(str)
    numbers = as_numbers(cells)
    if format is None and numbers.notna().all():
        of_frames = re.fullmatch(FRAME, str(column.name).strip(), re.IGNORECASE)
        unit = "frames" if of_frames else f"in the unit of the column {column.name}"
        return np.asarray(numbers.reindex(column.index), dtype=float), unit
    zoned = cells.str.fullmatch(_ZONE)
    if zoned.any() and not zoned.all():
        raise ValueError(
            f"{zoned.sum()} of {len(cells)} frames have a time zone, such as Z or "
            f"+01:00, and others have none (first: {_cell(cells, ~zoned)})"
        )
    likely = [each for each in _FORMATS if _read(cells.iloc[:1], each).notna().all()]
    readings = {each: _read(cells, each) for each in ([format] if format else likely)}
    whole = {each: read for each, read in readings.items() if read.notna().all()}
    if not whole:  # the format that reads most rows before it fails
        unread = [read.isna() for read in readings.values()]
        wrong = max(unread, key=lambda each: each.argmax(), default=cells.notna())
        expected = f"times written as {format}" if format else "numbers or dates"
        raise ValueError(
            f"expected {expected}, written alike in all frames; {wrong.sum()} of "
            f"{len(column)} are not (first: {_cell(cells, wrong)}). Name how they are "
            "written with --time-format, such as %d.%m.%Y, or use numbers"
        )
    chosen, first = next(iter(whole.items()))
    if others := [name for name, read in whole.items() if not read.equals(first)]:
        row = (whole[others[0]] != first).idxmax()
        times = {name: _shown(whole[name][row]) for name in (chosen, *others)}
        listed = [f"{time} (--time-format '{name}')" for name, time in times.items()]
        raise ValueError(
            f"{cells[row]!r} in row {row} can be {' or '.join(listed)}, and no other "
            "row decides it: choose one with --time-format"
        )
    return np.asarray(first.reindex(column.index)), "seconds"


def as_numbers(cells: "pd.Series") -> "pd.Series":
    """Return the numbers in cells, also with decimal commas; NaN in other cells."""
    with warnings.catch_warnings(action="ignore"):  # of commas
        written = io_tables.with_points(cells.to_frame("cells"), ["cells"])["cells"]
    return pd.to_numeric(written, errors="coerce")


def image_numbers(table: "pd.DataFrame", fps: float | None = None) -> "pd.Series":
    """Return the number of the image of each row, under the name of its column.

    It is the number of the frame, that in the name of the image, or that of the image
    among all. Otherwise rows count. Warn if times by fps leave out those in names.
    """
    for expression, name in product((FRAME, IMAGE_NAME, texts.IMAGE), table.columns):
        if not re.fullmatch(expression, str(name).strip(), re.IGNORECASE):
            continue
        numbers: Any = pd.to_numeric(table[name], errors="coerce")
        if expression == IMAGE_NAME:  # not of videos with many rows each
            several = name == "file" and table[name].duplicated().any()
            is_name = numbers.isna().all() and not several
            names = [*map(str, table[name])]
            numbers = texts.frame_numbers(names) if is_name else None
            if fps and is_name and texts.have_times(names):
                warn_caller(
                    f"--fps: the names of images in the column {name} have times "
                    f"(first: {names[0]}) instead of numbers of frames. Images count "
                    "as successive frames, in their order. For these times use --time "
                    f"{name} with a --time-format, such as %Y-%m-%d_%H-%M-%S.png, or "
                    "a column frame of numbers"
                )
        elif expression == texts.IMAGE:
            numbers = pd.factorize(table[name])[0]
        if numbers is not None and np.isfinite(numbers).all():
            return pd.Series(numbers, dtype=float, name=str(name).strip())
    return pd.Series(range(len(table)))


def video_times(numbers: "pd.Series", groups: NDArray | None) -> NDArray:
    """Return the numbers of images, which must be a sequence within each group.

    Numbers without a name are those of rows, which must follow one another.
    """
    found = pd.DataFrame({"image": numbers, "group": 0 if groups is None else groups})
    again, name = found.duplicated(), numbers.name
    if again.any():
        raise ValueError(
            f"--fps: {again.sum()} of {len(again)} frames show the same image as an "
            f"earlier row (column {name}, first: row {again.idxmax()}): the table has "
            "several faces or videos. Name the column that tells them apart with "
            "--group, or leave the others out with --skip-rows"
        )
    steps = found.groupby("group")["image"].diff()
    if name is None and steps.median() > 1:
        raise ValueError(
            "--fps counts the rows of the table, but most rows that follow one another "
            f"are {steps.median():g} rows apart: the table seems to have several rows "
            "an image. Add a column frame with the number of the frame, or use --time"
        )
    return np.asarray(numbers)


def _read(cells: "pd.Series", format: str | None) -> "pd.Series":
    """Return the dates or seconds of a format, missing where cells are not written so.

    Without a format they are dates already. Minutes and seconds may have hours before
    them in some rows.
    """
    if format not in _DURATIONS:
        dates = pd.to_datetime(cells, format=format, errors="coerce", utc=True)
        return dates.dt.tz_localize(None)
    parts = cells.str.extract(_DURATION).astype(float)
    seconds = 3600 * parts[0].fillna(0.0) + 60 * parts[1] + parts[2]
    if format == _MINUTES:
        return seconds
    if format == _ALL_THREE:
        return seconds.where(parts[0].notna())
    of_day = parts[0].isna() & (parts[1] < 24) & ~cells.str.contains(".", regex=False)
    return (60 * seconds).where(of_day)


def _shown(time: object) -> str:
    """Return a date, or seconds, as they are read by people."""
    if isinstance(time, float):
        return f"{time:g} s"
    return str(time).removesuffix(" 00:00:00")


def _cell(cells: "pd.Series", which: "pd.Series") -> str:
    """Name the first of some cells."""
    return f"row {which.idxmax()}, {cells[which].iloc[0]!r}"
