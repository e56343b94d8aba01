"""Orders of frames that stay the same when the rows of a table are permuted."""

import numpy as np
from numpy.typing import NDArray

from isa_nrsfm._linalg.vectors import energies
from isa_nrsfm._tables.blocks import FrameBlocks


def order_by_halves(rows: FrameBlocks) -> NDArray:
    """
    Return an order of frames that stays the same when the frames are permuted.

    Parameters
    ----------
    rows : FrameBlocks
        Blocks of frames (n_frames, ...), NaN where a point is missing.

    Returns
    -------
    ndarray of int, shape (n_frames,)
        Frames sorted by the share of their energy that is in the first half of their
        entries. For rows (2, n_points) of a scaled table that is the share of x.
    """
    return np.argsort(rows.joined(_first_half), kind="stable")


def _first_half(rows: NDArray) -> NDArray:
    """Return the share of the energy that the first half of each row has: (n_frames,).

    Rows are (n_frames, ...). NaN counts as zero.
    """
    flat = rows.reshape(len(rows), -1)
    if np.isnan(flat.sum()):
        flat = np.nan_to_num(flat)
    energy, half = energies(flat), energies(flat[:, : flat.shape[1] // 2])
    return np.divide(half, energy, where=energy > 0, out=np.zeros_like(energy))


def spread(order: NDArray, n: int) -> NDArray:
    """Return n entries of an order (n_frames,) at equal distances, ends included."""
    return order[np.linspace(0, len(order) - 1, n).round().astype(int)]
