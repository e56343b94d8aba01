"""Rows of a table as sequences in time."""

from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray
from sklearn.utils import check_array, column_or_1d


class Sequence(NamedTuple):
    """
    Rows that follow each other.

    Attributes
    ----------
    rows : ndarray of int, shape (n_rows,)
        Their numbers in the table, in order of time.
    steps : ndarray of int, shape (n_rows,)
        The step of time at which each was taken, from zero. Steps without a row are
        gaps.
    """

    rows: NDArray
    steps: NDArray


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
    time = np.asarray(column_or_1d(time))
    if len(time) != n_rows:
        raise ValueError(
            f"time must have one number for each of the {n_rows} rows; got {len(time)}"
        )
    missing = np.flatnonzero(~np.isfinite(_numbers(time)))
    if len(missing):
        raise ValueError(
            f"time must be known for all rows; it is missing in {len(missing)} of "
            f"{n_rows}, the first is row {missing[0]}"
        )
    return _numbers(time)


def _numbers(time: NDArray) -> NDArray:
    """Return times as numbers: dates and durations in seconds."""
    if time.dtype.kind in "mM":
        numbers = (time - time.min()) / np.timedelta64(1, "s")
        return np.where(np.isnat(time), np.nan, numbers)
    return check_array(
        time,
        dtype=np.float64,
        ensure_2d=False,
        ensure_all_finite=False,
        input_name="time",
    )


def checked_groups(groups: Any, n_rows: int) -> NDArray:
    """
    Return for each row the number of its group.

    Parameters
    ----------
    groups : array-like of shape (n_rows,) or None
        Names or numbers of groups, such as people or videos; None for one group.
    n_rows : int
        Number of rows.

    Returns
    -------
    ndarray of int, shape (n_rows,)
        Numbers from zero, in the order of the sorted names.

    Raises
    ------
    ValueError
        If there is not one group for each row, or a group is missing.
    """
    if groups is None:
        return np.zeros(n_rows, dtype=int)
    groups = np.asarray(column_or_1d(groups))
    if len(groups) != n_rows:
        raise ValueError(
            f"groups must have one entry for each of the {n_rows} rows; "
            f"got {len(groups)}"
        )
    missing = np.array([each is None or each != each for each in groups], dtype=bool)
    if missing.any():
        raise ValueError(
            f"groups must be known for all rows; {missing.sum()} of {n_rows} are "
            f"missing, the first is row {np.argmax(missing)}"
        )
    if groups.dtype == object:
        groups = groups.astype(str)
    return np.unique(groups, return_inverse=True)[1]


def sequences_of(
    time: NDArray, groups: NDArray, max_gap: int
) -> tuple[list[Sequence], float]:
    """
    Return the sequences of a table.

    Parameters
    ----------
    time : ndarray of shape (n_rows,)
        Times of the rows. Within a group they rise from row to row.
    groups : ndarray of int, shape (n_rows,)
        Numbers of the groups. No sequence goes from one to another.
    max_gap : int
        After a gap of more steps a new sequence begins.

    Returns
    -------
    sequences : list of Sequence
        The sequences, group by group.
    unit : float
        The time of a step: the median time between rows.

    Raises
    ------
    ValueError
        If times do not rise, or no group has two rows.
    """
    rows_of = [np.flatnonzero(groups == group) for group in range(groups.max() + 1)]
    for rows in rows_of:
        falling = np.flatnonzero(np.diff(time[rows]) <= 0)
        if len(falling):
            first, second = rows[falling[0]], rows[falling[0] + 1]
            raise ValueError(
                f"times must rise from row to row of a group; row {second} has "
                f"{time[second]:g} after {time[first]:g} of row {first}"
            )
    differences = np.concatenate([np.diff(time[rows]) for rows in rows_of])
    if not len(differences):
        raise ValueError("no group has two rows, so that there is no sequence")
    unit = float(np.median(differences))
    found = []
    for rows in rows_of:
        lengths = np.maximum(np.rint(np.diff(time[rows]) / unit), 1)
        cuts = np.flatnonzero(lengths > max_gap) + 1
        steps = np.concatenate(
            [[0], np.cumsum(np.where(lengths > max_gap, 0, lengths))]
        )
        for part in np.split(np.arange(len(rows)), cuts):
            own = (steps[part] - steps[part[0]]).astype(int)
            found.append(Sequence(rows[part], own))
    return found, unit
