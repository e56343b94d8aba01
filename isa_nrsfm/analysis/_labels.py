"""Labels and groups of frames, checked."""

from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray
from sklearn.utils import column_or_1d
from sklearn.utils.multiclass import type_of_target

Kind = Literal["classes", "number"]


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


def kind_of(y: NDArray, kind: str) -> Kind:
    """
    Return whether labels are classes or numbers.

    Parameters
    ----------
    y : ndarray of shape (n_frames,)
        Labels.
    kind : {"auto", "classes", "number"}
        "auto" takes names, truth values and whole numbers for classes, as scikit-learn
        does.

    Returns
    -------
    {"classes", "number"}
        The kind.

    Raises
    ------
    ValueError
        If all labels are equal, if classes are all different, or if names shall be
        numbers.
    """
    if kind not in ("auto", "classes", "number"):
        raise ValueError(f"kind must be 'auto', 'classes' or 'number'; got {kind!r}")
    n_values = len(np.unique(y))
    if n_values == 1:
        raise ValueError(f"all {len(y)} labels are {y[0]}: there is nothing to compare")
    if kind == "number" and y.dtype.kind not in "biuf":
        raise ValueError(f"labels that are numbers are expected; got {str(y[0])!r}")
    found: Kind = "classes"
    if kind == "number" or (kind == "auto" and type_of_target(y) == "continuous"):
        found = "number"
    if found == "classes" and n_values == len(y):
        raise ValueError(
            f"the {len(y)} labels are all different, so that no class has two frames; "
            "for a measure of something say kind='number'"
        )
    return found


def group_numbers(groups: Any, n_frames: int) -> NDArray | None:
    """Return numbers of groups from zero (n_frames,), None for None."""
    if groups is None:
        return None
    found = np.unique(checked_column("groups", groups, n_frames), return_inverse=True)[
        1
    ]
    return np.asarray(found)
