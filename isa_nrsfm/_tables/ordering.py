"""Orders of frames that stay the same when the rows of a table are permuted."""

import numpy as np
from numpy.typing import NDArray

from isa_nrsfm._linalg.small_matrices import energies
from isa_nrsfm._tables.blocks import FrameBlocks


def order_by_halves(rows: FrameBlocks) -> NDArray:
    """Return an order of frames (n_frames,) that stays the same when they are permuted.

    Frames (n_frames, ...) are sorted by the share of their energy in the first half of
    their entries: for rows (2, n_points) the share of x. NaN counts as zero.
    """
    return np.argsort(rows.joined(_first_half), kind="stable")


def _first_half(rows: NDArray) -> NDArray:
    """Return the share (n_frames,) of the energy in the first half of each row."""
    flat = rows.reshape(len(rows), -1)
    if np.isnan(flat.sum()):
        flat = np.where(np.isnan(flat), 0.0, flat)
    half, rest = (energies(part) for part in np.array_split(flat, 2, axis=1))
    energy = half + rest
    return np.divide(half, energy, where=energy > 0, out=np.zeros_like(energy))


def spread(order: NDArray, n: int) -> NDArray:
    """Return n entries of an order (n_frames,) at equal distances, ends included."""
    return order[np.linspace(0, len(order) - 1, n).round().astype(int)]


def representative_frames(rows: FrameBlocks, most: int) -> NDArray:
    """
    Return indices of about `most` frames of rows (I, 2, J), for the model of a table.

    They are spread evenly over `order_by_halves`, independent of the order of the
    table. For each point that few of them show, frames that show it are added.
    """
    if rows.n_frames <= most:
        return np.arange(rows.n_frames)
    order = order_by_halves(rows)
    chosen = np.zeros(len(order), dtype=bool)
    chosen[spread(order, most)] = True
    fewest = min(200, most // 5)
    shown = sum(rows.map(lambda b, kept: (~np.isnan(b[kept, 0])).sum(axis=0), chosen))
    for point in np.flatnonzero(shown < fewest).tolist():
        shows = rows.joined(lambda block, j=point: ~np.isnan(block[:, 0, j]))
        showing = order[shows[order]]
        chosen[spread(showing, min(fewest, len(showing)))] = True
    return np.flatnonzero(chosen)
