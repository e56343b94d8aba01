"""Rows of a table as sequences in time."""

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray


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


def sequences_of(
    time: NDArray, groups: NDArray | None, max_gap: int
) -> tuple[list[Sequence], float]:
    """
    Return the sequences of a table.

    Parameters
    ----------
    time : ndarray of shape (n_rows,)
        Times of the rows. Within a group they rise from row to row.
    groups : ndarray of int, shape (n_rows,), or None
        Numbers of the groups; None for one. No sequence goes from one to another.
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
    if groups is None:
        groups = np.zeros(len(time), dtype=int)
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
