"""Kinds of labels of frames: classes or numbers."""

from typing import Literal

import numpy as np
from numpy.typing import NDArray
from sklearn.utils.multiclass import type_of_target

Kind = Literal["classes", "number"]


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
    found: Kind = "classes"
    if kind == "number" or (kind == "auto" and type_of_target(y) == "continuous"):
        found = "number"
    if found == "classes" and n_values == len(y):
        raise ValueError(
            f"the {len(y)} labels are all different, so that no class has two frames; "
            "for a measured quantity use kind='number'"
        )
    return found


def refuse_infinite(name: str, labels: NDArray, rows: NDArray) -> None:
    """Refuse infinite numbers; `rows` are the numbers of their rows in the message."""
    infinite = rows[np.isinf(labels)] if labels.dtype.kind == "f" else rows[:0]
    if len(infinite):
        raise ValueError(
            f"{name} must be finite; {len(infinite)} of {len(labels)} labels are "
            f"infinite, the first is in row {infinite[0]}: correct these labels, or "
            "leave their frames out"
        )
