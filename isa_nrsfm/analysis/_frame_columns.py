"""Columns with one entry for each frame, such as labels, groups and times."""

import contextlib
import tomllib
from datetime import UTC
from pathlib import Path
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray
from sklearn.utils import check_array, column_or_1d
from sklearn.utils.multiclass import type_of_target

from isa_nrsfm._parameters import named

Kind = Literal["classes", "number"]
TEXTS = tomllib.loads(Path(__file__).with_name("texts.toml").read_text("utf-8"))


def checked_column(name: str, values: Any, n_frames: int) -> NDArray:
    """Return a column (n_frames,) of numbers, or names as str, without gaps."""
    column = np.asarray(column_or_1d(values))
    if len(column) != n_frames:
        raise ValueError(
            f"{name} must have one entry for each of the {n_frames} frames; "
            f"got {len(column)}"
        )
    missing = np.flatnonzero([is_missing(each) for each in column])
    if len(missing):
        raise ValueError(
            f"{name} must be known for all frames; it is missing in {len(missing)} of "
            f"{n_frames} (first: row {missing[0]})"
        )
    if column.dtype != object:
        return column
    if all(isinstance(each, int | float | np.number) for each in column):
        return column.astype(float)
    return column.astype(str)


def checked_std(alpha_std: Any, alpha: NDArray) -> NDArray:
    """Return the standard deviations of coefficients, which have their shape."""
    deviations = np.asarray(alpha_std, float)
    if deviations.shape != alpha.shape:
        raise ValueError(
            f"alpha_std must have the shape {alpha.shape} of alpha; got "
            f"{deviations.shape}"
        )
    return deviations


def is_missing(value: Any) -> bool:
    """Return whether an entry of a column is None, NaN, NaT or NA."""
    try:
        return value is None or not bool(value == value)
    except TypeError:  # pandas.NA is neither true nor false
        return True


def kind_of(y: NDArray, kind: str) -> Kind:
    """Return whether labels (n_frames,) are classes or numbers; refuse unusable ones.

    "auto" takes names, truth values and whole numbers for classes, as scikit-learn
    does.
    """
    if kind not in ("auto", "classes", "number"):
        raise ValueError(f"kind must be 'auto', 'classes' or 'number'; got {kind!r}")
    n_values = len(np.unique(y))
    if n_values == 1:
        raise ValueError(f"all {len(y)} labels are {y[0]}: there is nothing to compare")
    if kind == "number" and y.dtype.kind not in "biuf":
        raise ValueError(f"labels must be numbers; got {str(y[0])!r}")
    if kind == "number" or (kind == "auto" and type_of_target(y) == "continuous"):
        return "number"
    if n_values == len(y):
        raise ValueError(
            f"the {len(y)} labels are all different, so that no class has two frames; "
            f"for a measured quantity use {named('kind', 'number')}"
        )
    return "classes"


def refuse_infinite(name: str, labels: NDArray, rows: NDArray) -> None:
    """Refuse infinite numbers; `rows` are the numbers of their rows in the message."""
    infinite = rows[np.isinf(labels)] if labels.dtype.kind == "f" else rows[:0]
    if len(infinite):
        raise ValueError(
            f"{name} must be finite; {len(infinite)} of {len(labels)} labels are "
            f"infinite, the first is in row {infinite[0]}: correct these labels, or "
            "leave their frames out"
        )


def group_names(groups: Any, n_frames: int) -> NDArray:
    """Return the group of each frame (n_frames,), zero for None."""
    if groups is None:
        return np.zeros(n_frames, dtype=int)
    return checked_column("groups", groups, n_frames)


def group_numbers(groups: Any, n_frames: int) -> NDArray:
    """Return numbers of groups from zero (n_frames,), one group for None."""
    return np.unique(group_names(groups, n_frames), return_inverse=True)[1]


def checked_times(time: Any, n_rows: int) -> NDArray:
    """Return finite times of rows (n_rows,) in seconds; row numbers for None."""
    if time is None:
        return np.arange(n_rows, dtype=float)
    with contextlib.suppress(AttributeError, TypeError, StopIteration):  # no dates
        # In UTC: differences within a time zone ignore the change to summer time.
        times = [t.astimezone(UTC) if getattr(t, "tzinfo", 0) else t for t in time]
        first = next(each for each in times if each == each)
        time = [(each - first).total_seconds() for each in times]
    time = checked_column("time", time, n_rows)
    if time.dtype.kind in "mM":
        return np.asarray((time - time.min()) / np.timedelta64(1, "s"))
    return check_array(time, dtype=np.float64, ensure_2d=False, input_name="time")


def unit_columns(values: NDArray) -> NDArray:
    """Return columns (n, k), centred and of norm one; zero where constant."""
    values = values - values.mean(axis=0)
    size = np.linalg.norm(values, axis=0)
    return np.asarray(values / np.where(size > 0, size, 1.0))


def runs_between_gaps(time: NDArray) -> NDArray | None:
    """Return the number of the run of each frame, None if times have no gaps.

    Times (n_rows,) are in any order. Runs of less than ten frames on average, such as
    photos, are none.
    """
    order = np.argsort(time, kind="stable")
    steps = np.diff(time[order])
    gaps = steps[steps > 0]
    if not len(gaps):
        return None
    runs = np.append(0, np.cumsum(steps > 1.5 * np.median(gaps)))
    numbers = np.empty(len(time), dtype=int)
    numbers[order] = runs
    return numbers if 0 < runs[-1] < len(time) / 10 else None


def sequences_of(
    time: NDArray, groups: NDArray, max_gap: int
) -> tuple[list[tuple[NDArray, NDArray]], float]:
    """Return the rows and steps of each sequence, and the time of a step (the median).

    A gap of more than max_gap steps begins a new sequence. Refuses times that do not
    rise within groups, and groups that have only one row each.
    """
    order = np.argsort(groups, kind="stable")
    apart, together = np.diff(time[order]), np.diff(groups[order]) == 0
    falling = np.flatnonzero(together & (apart <= 0))
    if len(falling):
        first, second = order[falling[0] : falling[0] + 2]
        raise ValueError(
            f"times must increase within a group; row {second} has "
            f"{time[second]:g} after {time[first]:g} of row {first}"
        )
    if not together.any():
        raise ValueError("no group has two rows, so that there is no sequence")
    unit = float(np.median(apart[together]))
    lengths = np.maximum(np.rint(apart / unit), 1).astype(int)
    steps = np.cumsum(np.append(0, lengths))
    starts = np.flatnonzero(~together | (lengths > max_gap)) + 1
    parts = zip(np.split(order, starts), np.split(steps, starts), strict=True)
    return [(rows, places - places[0]) for rows, places in parts], unit
