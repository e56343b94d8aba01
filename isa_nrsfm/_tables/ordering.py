"""Orders of frames that stay the same when the rows of a table are permuted."""

from functools import partial

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
        flat = np.where(np.isnan(flat), 0.0, flat)
    half, rest = (energies(part) for part in np.array_split(flat, 2, axis=1))
    energy = half + rest
    return np.divide(half, energy, where=energy > 0, out=np.zeros_like(energy))


def spread(order: NDArray, n: int) -> NDArray:
    """Return n entries of an order (n_frames,) at equal distances, ends included."""
    return order[np.linspace(0, len(order) - 1, n).round().astype(int)]


def representative_frames(
    rows: FrameBlocks, n_points: int, most: int, fewest_shown: int
) -> NDArray:
    """
    Return frames from which the model of a large table is found.

    They are spread evenly over the order of `order_by_halves`, so that they do not
    depend on the order of the table. For each point that too few of them show, frames
    that show it are added, spread in the same way.

    Parameters
    ----------
    rows : FrameBlocks
        Blocks of frames (n_frames, 2, n_points), NaN where a point is not seen.
    n_points : int
        Number of points.
    most : int
        Number of frames, before those that are added. A table with no more frames is
        taken whole.
    fewest_shown : int
        Frames are added for each point that fewer show.

    Returns
    -------
    ndarray of int, shape (n_chosen,)
        The frames, in the order of the table.
    """
    if rows.n_frames <= most:
        return np.arange(rows.n_frames)
    order = order_by_halves(rows)
    chosen = np.zeros(len(order), dtype=bool)
    chosen[spread(order, most)] = True
    shown = np.zeros(n_points)
    for block in rows.map(_seen_rows, chosen):
        shown += block.sum(axis=0)
    for point in map(int, np.flatnonzero(shown < fewest_shown)):
        seen = rows.joined(partial(_sees, point=point))
        showing = order[seen[order]]
        chosen[spread(showing, min(fewest_shown, len(showing)))] = True
    return np.flatnonzero(chosen)


def _seen_rows(rows: NDArray, chosen: NDArray) -> NDArray:
    """Return which points (n_chosen, n_points) the chosen frames of a block show."""
    return ~np.isnan(rows[chosen, 0])


def _sees(rows: NDArray, point: int) -> NDArray:
    """Return which frames (n_frames,) of a block show a point."""
    return ~np.isnan(rows[:, 0, point])
