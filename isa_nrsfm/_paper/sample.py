"""Which frames of a large table the first stages work on.

The stages of the paper and the first steps of the joint refinement only make a start
for the steps that follow. A sample of the frames makes one as good. It is spread evenly
from the most to the least rigid frame, so that the order of the frames does not matter.
"""

from functools import partial
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from isa_nrsfm._tables.blocks import FrameBlocks
from isa_nrsfm._tables.ordering import spread

# Frames of the first sample. Each further sample is GROWTH times larger, up to about
# MOST_SAMPLED frames. The last steps take all frames.
SAMPLE_FRAMES = 600
GROWTH = 4
MOST_SAMPLED = 40_000
# Tables with fewer coordinates than this are taken whole.
SMALL_TABLE = 150_000
# A direction whose singular value is below this share of the largest counts as flat.
FLAT = 1e-10


class Sample(NamedTuple):
    """
    Frames for the first stages.

    Attributes
    ----------
    W : ndarray of shape (2 * n_chosen, n_points)
        Their measurement matrix, completed where points are missing.
    parts : list of ndarray of int
        Indices of frames, increasing. The first array has the frames of W, the others
        the larger and larger samples of the steps that follow. Empty where W has all
        frames.
    """

    W: NDArray
    parts: list[NDArray]


def sample_frames(rows: FrameBlocks, n_points: int, rigid_shape: NDArray) -> Sample:
    """
    Return frames for the first stages.

    Parameters
    ----------
    rows : FrameBlocks
        Blocks of complete frames (n_frames, 2, n_points).
    n_points : int
        Number of points.
    rigid_shape : ndarray of shape (3, n_points)
        Shape of the rigid factorisation.

    Returns
    -------
    Sample
        The frames.
    """
    n_frames = rows.n_frames
    parts: list[NDArray] = []
    if 2 * n_frames * n_points >= SMALL_TABLE and n_frames > SAMPLE_FRAMES:
        energy = partial(rigid_energy, shape=rigid_shape)
        order = np.argsort(rows.joined(energy), kind="stable")
        n = SAMPLE_FRAMES
        while not parts or n < min(n_frames / 2, MOST_SAMPLED):
            parts.append(np.sort(spread(order, n)))
            n *= GROWTH
    W = rows.take(parts[0]) if parts else rows.whole()
    W = W.reshape(-1, n_points).astype(np.float64, copy=False)
    return Sample(W, parts)


def rigid_energy(rows: NDArray, shape: NDArray) -> NDArray:
    """
    Return for each frame the energy of its residual after the fit of a rigid shape.

    Parameters
    ----------
    rows : ndarray of shape (n_frames, 2, n_points)
        Complete frames.
    shape : ndarray of shape (3, n_points)
        The shape.

    Returns
    -------
    ndarray of shape (n_frames,)
        ``min_M ||W_i - M shape||_F^2``, with the rounding errors of ``||W_i||_F^2``.
    """
    axes, size, _ = np.linalg.svd(shape.T, full_matrices=False)
    axes = axes[:, size > FLAT * size[0]]
    flat = rows.reshape(len(rows), -1)
    seen = (rows.reshape(-1, rows.shape[-1]) @ axes).reshape(len(rows), -1)
    return np.maximum(np.vecdot(flat, flat) - np.vecdot(seen, seen), 0.0)
