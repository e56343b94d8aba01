"""Check the arrays that the measures take."""

import numpy as np
from numpy.typing import ArrayLike, NDArray

from isa_nrsfm._tables.sources import unmasked


def as_finite(name: str, array: ArrayLike) -> NDArray[np.float64]:
    """Return an array of floats; refuse NaN and infinity."""
    values = np.asarray(unmasked(array), dtype=np.float64)
    if not np.isfinite(values).all():
        n_bad = int(np.sum(~np.isfinite(values)))
        raise ValueError(f"{name} must be finite; {n_bad} entries are NaN or infinite")
    return values


def check_same_shape(name_a: str, a: NDArray, name_b: str, b: NDArray) -> None:
    """Refuse arrays of different shapes."""
    if a.shape != b.shape:
        raise ValueError(
            f"{name_a} and {name_b} must be of the same shape; got {a.shape} and "
            f"{b.shape}"
        )
