"""Take the usable frames out of a table, and account for those left out."""

from collections.abc import Sequence
from typing import TYPE_CHECKING, NamedTuple

import numpy as np
from numpy.typing import NDArray

from isa_nrsfm._compat.caller import warn_caller
from isa_nrsfm._compat.optional import import_optional
from isa_nrsfm._prepare.checks import clean_tracks
from isa_nrsfm._tables.landmark_columns import LandmarkColumns, landmark_sets
from isa_nrsfm._tables.visibility import (
    FEWEST_POINTS,
    report_frames,
    seen_points,
    usable_frames,
)
from isa_nrsfm.cli._parser import RowRule
from isa_nrsfm.io._tables import as_numbers
from isa_nrsfm.skeletons import Skeleton

if TYPE_CHECKING:
    import pandas as pd


class LeftOut(NamedTuple):
    """Rows of a table that are not fitted, why, and whether a rule skips them."""

    reason: str
    rows: NDArray[np.intp]
    skipped: bool


class Frames(NamedTuple):
    """The rows of a table as frames.

    ``points`` and ``other`` are the landmarks and the other columns of the rows that
    no rule skips, with the number of each row in the table as index. ``usable`` tells
    which of them show enough points to be fitted, and ``left_out`` accounts for all
    other rows. ``seen`` tells which points each of the former shows. ``skeleton`` is
    what the file of the table says of what joins them.
    """

    points: "pd.DataFrame"
    other: "pd.DataFrame"
    usable: NDArray[np.bool_]
    seen: NDArray[np.bool_]
    columns: LandmarkColumns
    not_used: dict[str, int]
    n_rows: int
    left_out: tuple[LeftOut, ...]
    skeleton: Skeleton | None = None


def choose_frames(
    table: "pd.DataFrame",
    columns: LandmarkColumns,
    *,
    rules: Sequence[RowRule],
    zeros_missing: bool,
    failed: NDArray[np.bool_] | None = None,
) -> Frames:
    """Apply the rules for rows, take the landmarks, and look for unusable frames.

    ``failed`` tells in which rows of the table tracking failed, where that is known.
    """
    pd = import_optional("pandas", extra="io")
    kept = np.ones(len(table), dtype=bool)
    left_out = []
    for rule in rules:
        matches = kept & _matching_rows(table, rule)
        left_out.append(
            LeftOut(
                f"{rule.column} matches {rule.expression.pattern!r}",
                np.flatnonzero(matches),
                skipped=True,
            )
        )
        kept &= ~matches
    rows = np.flatnonzero(kept)
    names = columns.interleaved
    stripped = [name.strip() for name in names]
    cells = table.loc[kept, names]
    # Messages about a row name its number in the table, so all rows are there.
    tracks = np.full((len(table), len(columns.points), 2), np.nan)
    tracks[rows] = np.stack(
        [as_numbers(cells[name]) for name in names], axis=1
    ).reshape(-1, len(columns.points), 2)
    if zeros_missing:
        tracks[(tracks == 0).all(axis=2)] = np.nan
    tracks = clean_tracks(tracks, names=np.array(stripped))[rows]
    usable = usable_frames(tracks)
    left_out += [
        LeftOut(reason, rows[which], skipped=False)
        for reason, which in _reasons(
            tracks, usable, None if failed is None else failed[rows]
        )
    ]
    if not zeros_missing:
        _warn_of_zeros(tracks[usable])
    return Frames(
        points=pd.DataFrame(
            tracks.reshape(len(rows), len(names)), index=rows, columns=stripped
        ),
        other=table.loc[kept].drop(columns=names),
        usable=usable,
        seen=seen_points(tracks)[usable],
        columns=columns,
        not_used=_sets_not_used(table, columns),
        n_rows=len(table),
        left_out=tuple(out for out in left_out if len(out.rows)),
    )


def _reasons(
    tracks: NDArray[np.float64],
    usable: NDArray[np.bool_],
    failed: NDArray[np.bool_] | None,
) -> list[tuple[str, NDArray[np.bool_]]]:
    """Tell in which frames what is the matter, each with one reason."""
    report = report_frames(tracks)
    n_seen = report.n_seen
    few = n_seen < FEWEST_POINTS
    in_one_place = report.in_one_place & ~few
    none: list[tuple[str, NDArray[np.bool_]]] = [("all points missing", n_seen == 0)]
    if failed is not None:
        none = [
            ("tracking failed", failed),
            ("all points missing or unsure", (n_seen == 0) & ~failed),
        ]
    return [
        *none,
        (f"fewer than {FEWEST_POINTS} points", few & (n_seen > 0)),
        ("all points in one place", in_one_place),
        ("points on one line, others missing", ~usable & ~few & ~in_one_place),
    ]


def _matching_rows(table: "pd.DataFrame", rule: RowRule) -> NDArray[np.bool_]:
    """Tell which rows a rule leaves out."""
    cells = column_named(table, rule.column, "--skip-rows")
    search = rule.expression.search
    return np.array(
        [
            search("" if empty else str(cell)) is not None
            for cell, empty in zip(cells, cells.isna(), strict=True)
        ],
        dtype=bool,
    )


def column_named(table: "pd.DataFrame", name: str, option: str) -> "pd.Series":
    """Return a column of a table, whatever blanks are around its name."""
    by_name = {str(each).strip(): each for each in table.columns}
    if name.strip() not in by_name:
        names = [each for each in by_name if each]
        raise ValueError(
            f"{option}: the table has no column {name!r}; its columns are "
            + ", ".join(names[:8])
            + (", ..." if len(names) > 8 else "")
        )
    return table[by_name[name.strip()]]


def _warn_of_zeros(tracks: NDArray[np.float64]) -> None:
    """Warn of points at the origin, which mark missing points in many tables."""
    at_origin = (tracks == 0).all(axis=2)
    if at_origin.any():
        warn_caller(
            f"{np.count_nonzero(at_origin)} points in "
            f"{np.count_nonzero(at_origin.any(axis=1))} rows are at exactly (0, 0); if "
            "that marks missing points, use --zeros-missing",
        )


def _sets_not_used(table: "pd.DataFrame", found: LandmarkColumns) -> dict[str, int]:
    """Return the coordinate columns that are not used: patterns and numbers of points.

    Sets that have points in common with those used are not listed.
    """
    chosen = {*found.x, *found.y}
    rest = [name for name in table.columns if name not in chosen]
    not_used = landmark_sets(rest)
    if found.z:
        not_used[f"{found.z[0].strip()}, ... (third coordinate)"] = len(found.z)
    return not_used
