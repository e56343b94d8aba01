"""Which frames of a large table the first stages work on.

The stages of the paper and the first steps of the joint refinement only make a start
for the steps that follow. A sample of the frames makes one as good. It is spread evenly
from the most to the least rigid frame, so that the order of the frames does not matter.
"""

from functools import partial
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from isa_nrsfm._linalg.rounding import OF_RANKS
from isa_nrsfm._linalg.vectors import energies
from isa_nrsfm._paper.options import SAMPLE_OPTIONS, SampleOptions
from isa_nrsfm._tables.blocks import FrameBlocks
from isa_nrsfm._tables.ordering import spread


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


def sample_frames(
    rows: FrameBlocks,
    n_points: int,
    rigid_shape: NDArray,
    options: SampleOptions = SAMPLE_OPTIONS,
) -> Sample:
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
    options : SampleOptions
        When and how many frames are taken.

    Returns
    -------
    Sample
        The frames.
    """
    n_frames = rows.n_frames
    parts: list[NDArray] = []
    large = 2 * n_frames * n_points >= options.small_table
    if large and n_frames > options.first:
        energy = partial(rigid_energy, shape=rigid_shape)
        order = np.argsort(rows.joined(energy), kind="stable")
        n = options.first
        while not parts or n < min(n_frames / 2, options.most):
            parts.append(np.sort(spread(order, n)))
            n *= options.growth
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
    axes = axes[:, size > OF_RANKS * size[0]]
    seen = (rows.reshape(-1, rows.shape[-1]) @ axes).reshape(len(rows), -1)
    return np.maximum(energies(rows) - energies(seen), 0.0)
