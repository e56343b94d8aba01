"""Read the table that a command is given, and take its landmark columns."""

import warnings
from argparse import Namespace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from isa_nrsfm import AffineNRSfM
from isa_nrsfm._compat.optional import import_optional
from isa_nrsfm._tables.landmark_columns import (
    LandmarkColumns,
    find_landmark_columns,
    parse_coordinate,
    point_names,
)
from isa_nrsfm.cli._drawing_options import CONFIGURATIONS
from isa_nrsfm.cli._frames import Frames, choose_frames
from isa_nrsfm.cli._points import kept_points, layout_of_table, part_of_layout
from isa_nrsfm.io import FORMATS, find_format, read_landmarks, read_table
from isa_nrsfm.skeletons import read_skeleton

if TYPE_CHECKING:
    import pandas as pd

    from isa_nrsfm.skeletons import Skeleton

# Points and coordinates in the order of the columns.
_SHAPES = {"interleaved": (-1, 2), "planar": (2, -1)}


def read_frames(args: Namespace, estimator: AffineNRSfM | None = None) -> Frames:
    """Read the table and take its frames, for a model those with its points."""
    args.format = _format(args)
    table, chosen, failed, skeleton = _read(args)
    if estimator is not None:
        columns = _columns_of_model(estimator, table, chosen)
        if chosen is not None and skeleton is not None:
            places = [chosen.x.index(name) for name in columns.x]
            if sorted(places) != list(range(len(chosen.x))):
                skeleton = part_of_layout(skeleton, places)
    else:
        columns = chosen or find_landmark_columns(table.columns)
        if args.points is not None:
            return _some_points(args, table, columns, failed, skeleton)
    frames = taken_frames(args, table, columns, failed)
    return frames._replace(skeleton=skeleton)


def _some_points(
    args: Namespace,
    table: "pd.DataFrame",
    columns: LandmarkColumns,
    failed: NDArray[np.bool_] | None,
    skeleton: "Skeleton | None",
) -> Frames:
    """Take the frames with the points of --points; skeleton is that of all points."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # the points that are kept warn again
        whole = taken_frames(args, table, columns, failed)
    tracks = whole.points[whole.usable].to_numpy().reshape(-1, len(columns.points), 2)
    if args.skeleton is not None and Path(args.skeleton).suffix in CONFIGURATIONS:
        skeleton = read_skeleton(args.skeleton, columns.points)
    layout = layout_of_table(args.skeleton or skeleton, columns.points, tracks)
    kept = kept_points(args.points, columns.points, layout)
    names, x, y = (
        tuple(each[j] for j in kept) for each in (columns.points, columns.x, columns.y)
    )
    some = columns._replace(points=names, x=x, y=y)
    out = [name for name in columns.interleaved if name not in {*x, *y}]
    frames = taken_frames(args, table.drop(columns=out), some, failed)
    not_used = frames.not_used | {f"--points {args.points}": len(out) // 2}
    return frames._replace(skeleton=part_of_layout(layout, kept), not_used=not_used)


def taken_frames(
    args: Namespace,
    table: "pd.DataFrame",
    columns: LandmarkColumns,
    failed: NDArray[np.bool_] | None = None,
) -> Frames:
    """Take the frames out of a table, as the options ask for."""
    frames = choose_frames(
        table,
        columns,
        rules=args.skip_rows,
        zeros_missing=args.zeros_missing,
        failed=failed,
    )
    # A format says itself which of its columns are landmarks.
    return frames if failed is None else frames._replace(not_used={})


def _format(args: Namespace) -> str:
    """Return the format of the table, and refuse options of another one."""
    found = args.format
    if found == "auto":
        found = "table" if args.columns is not None else find_format(args.table)
    if args.columns is not None and found != "table":
        raise ValueError(f"--columns is for --format table; got --format {found}")
    if args.image_size is not None and "image_size" not in FORMATS[found].options:
        raise ValueError(
            f"--image-size is for --format mediapipe; {args.table} is of format {found}"
        )
    if args.min_confidence is not None and found == "table":
        raise ValueError(
            f"--min-confidence: {args.table} is of format table, which has no "
            "confidences"
        )
    return found


def _read(
    args: Namespace,
) -> (
    "tuple[pd.DataFrame, LandmarkColumns | None, NDArray[np.bool_] | None, "
    "Skeleton | None]"
):
    """Return the table, its landmark columns, failed rows and skeleton, where known."""
    if args.format == "table":
        table = read_table(args.table)
        if args.columns is None:
            return table, None, None, None
        return table, find_landmark_columns(table.columns, args.columns), None, None
    pd = import_optional("pandas", extra="io")
    options = {} if args.image_size is None else {"image_size": args.image_size}
    found = read_landmarks(
        args.table, args.format, min_confidence=args.min_confidence, **options
    )
    table = pd.concat([found.frames, found.points], axis=1)
    names = tuple(found.points)
    columns = LandmarkColumns(
        pattern=f"those of {args.format}",
        points=found.point_names,
        x=names[::2],
        y=names[1::2],
        z=(),
        gaps=(),
    )
    return table, columns, found.failed, found.skeleton


def _columns_of_model(
    estimator: AffineNRSfM, table: "pd.DataFrame", chosen: LandmarkColumns | None
) -> LandmarkColumns:
    """Return the columns of the points that a model was fitted to.

    ``chosen`` are the landmarks of the table where more than their names tells them.
    """
    fitted = getattr(estimator, "feature_names_in_", None)
    n_points = len(estimator.mean_shape_)
    if fitted is None:
        found = chosen or find_landmark_columns(table.columns)
        if len(found.points) != n_points:
            raise ValueError(
                f"the model has {n_points} points, the table has {len(found.points)} "
                f"({found.pattern})"
            )
        return found
    tracks = np.array([str(name).strip() for name in fitted]).reshape(
        _SHAPES[estimator.layout]
    )
    x, y = tracks if estimator.layout == "planar" else tracks.T
    wanted = {*x, *y}
    in_table = {str(name).strip(): name for name in table.columns}
    # Columns that are coordinates or, where there are such, the chosen ones.
    candidates = (
        [name for name in table.columns if parse_coordinate(name) is not None]
        if chosen is None
        else chosen.interleaved
    )
    coordinates = {str(name).strip(): name for name in candidates}
    present = in_table if chosen is None else coordinates
    absent = [name for point in zip(x, y, strict=True) for name in point]
    absent = [name for name in absent if name not in present]
    surplus = [name for name in coordinates if name not in wanted]
    # Points after those of the model are of another layout. Others were left out of it.
    first = [str(name).strip() for name in candidates[: len(wanted)]]
    if absent or (surplus and chosen is not None and wanted == {*first}):
        differences = [
            f"{len(names)} columns are only in the {where} ({_shortened(names)})"
            for names, where in ((absent, "model"), (surplus, "table"))
            if names
        ]
        raise ValueError(
            "the points of the table are not those of the model: "
            + "; ".join(differences)
        )
    return LandmarkColumns(
        pattern="those of the model",
        points=point_names(x),
        x=tuple(in_table[name] for name in x),
        y=tuple(in_table[name] for name in y),
        z=(),
        gaps=(),
    )


def as_fitted(estimator: AffineNRSfM, points: "pd.DataFrame") -> Any:
    """Return a table of landmarks with the columns that the model was fitted to."""
    fitted = getattr(estimator, "feature_names_in_", None)
    if fitted is None:
        x_then_y = points.to_numpy().reshape(len(points), -1, 2).swapaxes(1, 2)
        planar = estimator.layout == "planar"
        return x_then_y.reshape(points.shape) if planar else points.to_numpy()
    in_order = points[[str(name).strip() for name in fitted]]
    return in_order.set_axis(list(fitted), axis=1)


def _shortened(names: list[str]) -> str:
    """List the first names."""
    return ", ".join(names[:4]) + (", ..." if len(names) > 4 else "")
