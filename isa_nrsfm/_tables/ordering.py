"""Orders of frames that do not depend on the one in which they come."""

import numpy as np
from numpy.typing import NDArray

from isa_nrsfm._linalg.vectors import energies
from isa_nrsfm._tables.blocks import FrameBlocks


def order_by_halves(rows: FrameBlocks) -> NDArray:
    """
    Return an order of frames that does not depend on the one in which they come.

    Parameters
    ----------
    rows : FrameBlocks
        Blocks of frames (n_frames, ...), NaN where a point is missing.

    Returns
    -------
    ndarray of int, shape (n_frames,)
        Frames by the share of their energy that is in their first half, x for instance.
    """
    return np.argsort(rows.joined(_first_half), kind="stable")


def _first_half(rows: NDArray) -> NDArray:
    """Return the share of the energy of frames that is in the first half of them."""
    flat = rows.reshape(len(rows), -1)
    if np.isnan(flat.sum()):
        flat = np.nan_to_num(flat)
    energy, half = energies(flat), energies(flat[:, : flat.shape[1] // 2])
    return np.divide(half, energy, where=energy > 0, out=np.zeros_like(energy))


def spread(order: NDArray, n: int) -> NDArray:
    """Return n of the frames at equal distances in an order."""
    return order[np.linspace(0, len(order) - 1, n).round().astype(int)]
