"""Images of shapes, and their distances from the visible points of frames."""

from functools import partial

import numpy as np
from numpy.typing import NDArray

from isa_nrsfm._tables.blocks import FrameBlocks


def reprojection_error(
    W: FrameBlocks, shapes: NDArray, motion: NDArray, position: NDArray, alpha: NDArray
) -> float:
    """Return the inverse SNR ``||W - W_hat||_F^2 / ||W||_F^2`` over the visible points.

    Frames of W, blocks (n, 2, J), are below centred. Motion (n, 2, 3), position (n, 2)
    and alpha (n, K) are those of all frames, shapes (K + 1, 3, J).
    """
    energies = W.map(partial(_energies, shapes=shapes), motion, position, alpha)
    noise, signal = np.sum(list(energies), axis=0)
    return float(noise / signal)


def _energies(
    rows: NDArray, motion: NDArray, position: NDArray, alpha: NDArray, shapes: NDArray
) -> tuple[float, float]:
    """Return the energies of the residuals of a block, and of its centred frames."""
    middle = rows.mean(axis=2, keepdims=True, dtype=np.float64)
    if np.isnan(middle).any():
        middle = np.nanmean(rows, axis=2, keepdims=True, dtype=np.float64)
    signal = _sum_of_squares(rows - middle)
    model = stacked_motion(motion, alpha) @ shapes.reshape(-1, shapes.shape[2])
    rest = model.reshape(rows.shape)
    rest += position[:, :, None]
    rest -= rows
    return _sum_of_squares(rest), signal


def _sum_of_squares(values: NDArray) -> float:
    """Return the sum of the squares of all values that are not NaN."""
    total = float(np.vdot(values, values))
    return float(np.nansum(values**2)) if np.isnan(total) else total


def distances(
    rows: NDArray, shapes: NDArray, motion: NDArray, position: NDArray, alpha: NDArray
) -> NDArray:
    """Return distances (n, J) of points (n, 2, J) from a model, NaN if missing."""
    images = motion @ compose(shapes[0], shapes[1:], alpha) + position[..., None]
    return np.linalg.norm(rows - images, axis=1)


def stacked_motion(motion: NDArray, alpha: NDArray) -> NDArray:
    """Return the motion factor ``(1, alpha_i) (x) M_i`` (2 n, 3 K + 3)."""
    c = np.concatenate([np.ones((len(alpha), 1)), alpha], axis=1)
    return np.einsum("ik,irc->irkc", c, motion).reshape(2 * len(alpha), -1)


def compose(mean_shape: NDArray, basis: NDArray, alpha: NDArray) -> NDArray:
    """Return the shapes of frames, ``B_0 + sum_k alpha_ik B_k`` (n, ...)."""
    return mean_shape + np.tensordot(alpha, basis, axes=1)


def project(shapes: NDArray, motion: NDArray, translation: NDArray) -> NDArray:
    """Return images (n, J, 2) of shapes (n, J, 3); motion (n, 2, 3) or (2, 3)."""
    return shapes @ np.swapaxes(motion, -1, -2) + np.expand_dims(translation, -2)
