"""Images of shapes, and how far they are from what frames show."""

from functools import partial
from typing import Any

import numpy as np
from numpy.typing import NDArray

from isa_nrsfm._linalg.vectors import energies
from isa_nrsfm._tables.blocks import FrameBlocks


def reprojection_error(
    rows: FrameBlocks,
    shapes: NDArray,
    motion: NDArray,
    position: NDArray,
    alpha: NDArray,
) -> float:
    """
    Return the inverse SNR of the images of shapes.

    Parameters
    ----------
    rows : FrameBlocks
        Blocks of frames (n_frames, 2, n_points), NaN where a point is missing.
    shapes : ndarray of shape (n_components + 1, 3, n_points)
        Mean shape and basis shapes.
    motion : ndarray of shape (n_frames, 2, 3)
        Cameras.
    position : ndarray of shape (n_frames, 2)
        Images of the origin.
    alpha : ndarray of shape (n_frames, n_components)
        Coefficients.

    Returns
    -------
    float
        ``||W - W_hat||_F^2 / ||W||_F^2`` over the points that are seen, with the images
        W_hat of the shapes, and each frame of W below centred.
    """
    stacked = shapes.reshape(-1, shapes.shape[2])
    found = rows.map(partial(_energies, shapes=stacked), motion, position, alpha)
    noise, signal = np.sum(list(found), axis=0)
    return float(noise / signal)


def _energies(
    rows: NDArray, motion: NDArray, position: NDArray, alpha: NDArray, shapes: NDArray
) -> tuple[float, float]:
    """
    Return the energy of the residuals of frames, and that of the frames.

    The shapes are stacked (3 n_components + 3, n_points), rows (n_frames, 2, n_points).
    """
    images = (stacked_motion(motion, alpha) @ shapes).reshape(rows.shape)
    images += position[:, :, None]
    np.subtract(rows, images, out=images)
    n_seen: Any = rows.shape[2]
    if np.isnan(rows.sum()):
        missing = np.isnan(rows)
        n_seen = rows.shape[2] - missing.sum(axis=2)
        rows, images = np.where(missing, 0.0, (rows, images))
    total = rows.sum(axis=2, dtype=np.float64)
    signal = energies(rows).sum() - (total * total / n_seen).sum()
    return float(energies(images).sum()), float(signal)


def distances(
    tracks: NDArray,
    shapes: NDArray,
    motion: NDArray,
    translation: NDArray,
    alpha: NDArray,
) -> NDArray:
    """
    Return how far the points of frames are from a model of them.

    Parameters
    ----------
    tracks : ndarray of shape (n_frames, n_points, 2)
        Tracks; NaN where a point is missing.
    shapes : ndarray of shape (n_components + 1, 3, n_points)
        Mean shape and basis shapes.
    motion : ndarray of shape (n_frames, 2, 3)
        Cameras.
    translation : ndarray of shape (n_frames, 2)
        Positions.
    alpha : ndarray of shape (n_frames, n_components)
        Coefficients.

    Returns
    -------
    ndarray of shape (n_frames, n_points)
        Distances in the images; NaN where a point is missing.
    """
    stacked = shapes.transpose(0, 2, 1)
    model = project(compose(stacked[0], stacked[1:], alpha), motion, translation)
    return np.linalg.norm(tracks - model, axis=2)


def stacked_motion(motion: NDArray, alpha: NDArray) -> NDArray:
    """
    Return the motion of the mean shape and the basis shapes.

    Parameters
    ----------
    motion : ndarray of shape (n_frames, 2, 3)
        Cameras.
    alpha : ndarray of shape (n_frames, n_components)
        Coefficients.

    Returns
    -------
    ndarray of shape (2 * n_frames, 3 * n_components + 3)
        ``(1, alpha_i) (x) M_i``, whose product with the stacked shapes
        (3 * n_components + 3, n_points) is the measurement matrix.
    """
    c = np.concatenate([np.ones((len(alpha), 1)), alpha], axis=1)
    return np.einsum("ik,irc->irkc", c, motion).reshape(2 * len(alpha), -1)


def compose(mean_shape: NDArray, basis: NDArray, alpha: NDArray) -> NDArray:
    """
    Return the shape of each frame, the mean plus the weighted basis shapes.

    Parameters
    ----------
    mean_shape : ndarray of shape (n_points, 3)
        B_0.
    basis : ndarray of shape (n_components, n_points, 3)
        B_k.
    alpha : ndarray of shape (n_frames, n_components)
        Coefficients.

    Returns
    -------
    ndarray of shape (n_frames, n_points, 3)
        ``B_0 + sum_k alpha_ik B_k``.
    """
    return mean_shape + np.tensordot(alpha, basis, axes=1)


def project(shapes: NDArray, motion: NDArray, translation: NDArray) -> NDArray:
    """
    Return the image of shapes in affine cameras.

    Parameters
    ----------
    shapes : ndarray of shape (n_frames, n_points, 3)
        Shapes.
    motion : ndarray of shape (n_frames, 2, 3) or (2, 3)
        Cameras.
    translation : ndarray of shape (n_frames, 2) or (2,)
        Images of the origin.

    Returns
    -------
    ndarray of shape (n_frames, n_points, 2)
        Tracks.
    """
    return shapes @ np.swapaxes(motion, -1, -2) + np.expand_dims(translation, -2)
