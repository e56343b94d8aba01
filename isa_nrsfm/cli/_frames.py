"""Take the usable frames out of a table, and account for those left out."""

import warnings
from collections.abc import Sequence
from typing import TYPE_CHECKING, NamedTuple

import numpy as np
from numpy.typing import NDArray

from isa_nrsfm._landmark_names import (
    LandmarkColumns,
    find_landmark_columns,
    landmark_sets,
)
from isa_nrsfm.cli._parser import RowRule
from isa_nrsfm.io import landmark_table

if TYPE_CHECKING:
    import pandas as pd


class LeftOut(NamedTuple):
    """Rows of a table that are not used, why, and whether a rule skips them."""

    reason: str
    rows: NDArray[np.intp]
    skipped: bool


class Frames(NamedTuple):
    """The rows of a table as frames.

    ``points`` and ``other`` are the landmarks and the other columns of the rows that
    no rule skips, with the number of each row in the table as index. ``usable`` tells
    which of them have all their points, and ``left_out`` accounts for all other rows.
    """

    points: "pd.DataFrame"
    other: "pd.DataFrame"
    usable: NDArray[np.bool_]
    columns: LandmarkColumns
    not_used: dict[str, int]
    n_rows: int
    left_out: tuple[LeftOut, ...]


def choose_frames(
    table: "pd.DataFrame",
    *,
    columns: str | Sequence[str] | None,
    rules: Sequence[RowRule],
    zeros_missing: bool,
) -> Frames:
    """Apply the rules for rows, take the landmarks, and look for unusable frames."""
    found = find_landmark_columns(table.columns, columns)
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
    points, other = landmark_table(
        table[kept],
        columns=columns,
        missing="zeros" if zeros_missing else None,
    )
    tracks = points.to_numpy().reshape(len(points), len(found.points), 2)
    rows = np.flatnonzero(kept)
    incomplete = np.isnan(tracks).any(axis=(1, 2))
    collapsed = ~incomplete & _in_one_place(tracks)
    left_out.append(LeftOut("missing points", rows[incomplete], False))
    left_out.append(LeftOut("all points in one place", rows[collapsed], False))
    if not zeros_missing:
        _warn_of_zeros(tracks[~incomplete & ~collapsed])
    return Frames(
        points=points,
        other=other,
        usable=~(incomplete | collapsed),
        columns=found,
        not_used=_sets_not_used(table, found),
        n_rows=len(table),
        left_out=tuple(reason for reason in left_out if len(reason.rows)),
    )


def _matching_rows(table: "pd.DataFrame", rule: RowRule) -> NDArray[np.bool_]:
    """Tell which rows a rule leaves out."""
    by_name = {str(name).strip(): name for name in table.columns}
    if rule.column not in by_name:
        names = [name for name in by_name if name]
        raise ValueError(
            f"--skip-rows: the table has no column {rule.column!r}; its columns are "
            + ", ".join(names[:8])
            + (", ..." if len(names) > 8 else "")
        )
    cells = table[by_name[rule.column]]
    search = rule.expression.search
    return np.array(
        [
            search("" if empty else str(cell)) is not None
            for cell, empty in zip(cells, cells.isna(), strict=True)
        ],
        dtype=bool,
    )


def _in_one_place(tracks: NDArray[np.float64]) -> NDArray[np.bool_]:
    """Tell in which frames all points are equal up to rounding."""
    extent = np.ptp(tracks, axis=1).max(axis=1)
    largest = np.abs(tracks).max(axis=(1, 2))
    return extent <= 8 * np.finfo(float).eps * largest


def _warn_of_zeros(tracks: NDArray[np.float64]) -> None:
    """Warn of points at the origin, which mark missing points in many tables."""
    at_origin = (tracks == 0).all(axis=2)
    if at_origin.any():
        warnings.warn(
            f"{np.count_nonzero(at_origin)} points in "
            f"{np.count_nonzero(at_origin.any(axis=1))} rows are at exactly (0, 0); if "
            "that marks missing points, use --zeros-missing",
            stacklevel=2,
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
