"""A sample of the frames of a large table, for the first stages.

A sample is spread evenly from the most to the least rigid frame, so that the order of
the frames does not matter.
"""

from functools import partial
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from isa_nrsfm._linalg.rounding import OF_RANKS
from isa_nrsfm._linalg.small_matrices import energies
from isa_nrsfm._tables.blocks import FrameBlocks
from isa_nrsfm._tables.ordering import spread


class Sample(NamedTuple):
    """Completed measurement matrix W of a first sample, and indices of growing ones.

    The first of `parts` has the frames of W. It is empty if W has all frames.
    """

    W: NDArray
    parts: list[NDArray]


def sample_frames(
    rows: FrameBlocks,
    n_points: int,
    rigid_shape: NDArray,
    first: int = 600,
    small_table: int = 150_000,
) -> Sample:
    """
    Return frames for the first stages, from blocks of complete ones (n, 2, n_points).

    If a table has fewer coordinates than `small_table`, all frames are returned.
    """
    n_frames = rows.n_frames
    parts: list[NDArray] = []
    if 2 * n_frames * n_points >= small_table and n_frames > first:
        energy = rows.joined(partial(rigid_energy, shape=rigid_shape))
        order = np.argsort(energy, kind="stable")
        n = first
        while not parts or n < min(n_frames / 2, 40_000):
            parts.append(np.sort(spread(order, n)))
            n *= 4
    W = rows.take(parts[0]) if parts else rows.whole()
    return Sample(W.reshape(-1, n_points).astype(np.float64, copy=False), parts)


def rigid_energy(rows: NDArray, shape: NDArray) -> NDArray:
    """Return ``min_M ||W_i - M shape||_F^2`` (I,) of rows (I, 2, J)."""
    axes, size, _ = np.linalg.svd(shape.T, full_matrices=False)
    axes = axes[:, size > OF_RANKS * size[0]]
    seen = (rows.reshape(-1, rows.shape[-1]) @ axes).reshape(len(rows), -1)
    return np.maximum(energies(rows) - energies(seen), 0.0)
