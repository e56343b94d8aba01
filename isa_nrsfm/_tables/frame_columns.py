"""Columns with one entry for each frame, such as labels, groups and times."""

from typing import Any

import numpy as np
from numpy.typing import NDArray
from sklearn.utils import check_array, column_or_1d


def checked_column(name: str, values: Any, n_frames: int) -> NDArray:
    """
    Return a column with one known entry for each frame.

    Parameters
    ----------
    name : str
        What it is called in messages.
    values : array-like of shape (n_frames,)
        Numbers or names.
    n_frames : int
        Number of frames.

    Returns
    -------
    ndarray of shape (n_frames,)
        Numbers, or names as str.

    Raises
    ------
    ValueError
        If the length differs, or an entry is missing (None, NaN or NA).
    """
    column = np.asarray(column_or_1d(values))
    if len(column) != n_frames:
        raise ValueError(
            f"{name} must have one entry for each of the {n_frames} frames; "
            f"got {len(column)}"
        )
    missing = np.flatnonzero([_is_missing(each) for each in column])
    if len(missing):
        raise ValueError(
            f"{name} must be known for all frames; it is missing in {len(missing)} of "
            f"{n_frames}, the first is row {missing[0]}"
        )
    if column.dtype != object:
        return column
    if all(isinstance(each, int | float | np.number) for each in column):
        return column.astype(float)
    return column.astype(str)


def _is_missing(value: Any) -> bool:
    """Tell whether an entry of a column is None, NaN, NaT or NA."""
    try:
        return value is None or not bool(value == value)
    except TypeError:  # pandas.NA is neither true nor false
        return True


def group_numbers(groups: Any, n_frames: int) -> NDArray | None:
    """Return numbers of groups from zero (n_frames,), None for None."""
    if groups is None:
        return None
    names = checked_column("groups", groups, n_frames)
    return np.asarray(np.unique(names, return_inverse=True)[1])


def checked_times(time: Any, n_rows: int) -> NDArray:
    """
    Return the times of rows.

    Parameters
    ----------
    time : array-like of shape (n_rows,) or None
        Times; None for rows in order, one step apart.
    n_rows : int
        Number of rows.

    Returns
    -------
    ndarray of shape (n_rows,)
        The times.

    Raises
    ------
    ValueError
        If there is not one finite number for each row.
    """
    if time is None:
        return np.arange(n_rows, dtype=float)
    return _numbers(checked_column("time", time, n_rows))


def _numbers(time: NDArray) -> NDArray:
    """Return times as numbers: dates and durations in seconds."""
    if time.dtype.kind in "mM":
        return np.asarray((time - time.min()) / np.timedelta64(1, "s"))
    return check_array(time, dtype=np.float64, ensure_2d=False, input_name="time")
