"""Affine cameras of rigid shapes, and the common view of many cameras."""

import numpy as np
from numpy.typing import NDArray

# Cameras have a common view if the smaller singular value of their mean is at least
# this share of the root mean square of a camera's row.
DEGENERATE_MEAN = 0.2


def rigid_cameras(W: NDArray, mean_shape: NDArray) -> NDArray:
    """
    Return for each frame the affine camera that best sees the mean shape.

    Parameters
    ----------
    W : ndarray of shape (2 * n_frames, n_points)
        Measurement matrix, rows centred.
    mean_shape : ndarray of shape (n_points, 3)
        Centred.

    Returns
    -------
    ndarray of shape (n_frames, 2, 3)
        Cameras M_i that minimise ``||W_i - M_i B_0||_F``; those of least norm where
        the mean shape is flat.
    """
    return (W @ np.linalg.pinv(mean_shape, rcond=1e-10).T).reshape(-1, 2, 3)


def mean_view(motion: NDArray) -> NDArray | None:
    """
    Return the mean camera, or None where the cameras have no common view.

    Parameters
    ----------
    motion : ndarray of shape (n_frames, 2, 3)
        Cameras.

    Returns
    -------
    ndarray of shape (2, 3) or None
        The mean, unless its smaller singular value is below 0.2 of the root mean
        square of a camera's row.
    """
    mean = motion.mean(axis=0)
    smaller = np.linalg.svd(mean, compute_uv=False)[1]
    root_mean_square = np.sqrt(np.mean(np.sum(motion**2, axis=(1, 2))) / 2)
    return mean if smaller > DEGENERATE_MEAN * root_mean_square else None


def reference_camera(motion: NDArray, sizes: NDArray) -> NDArray:
    """
    Return a camera that sees shapes as the table shows them.

    Parameters
    ----------
    motion : ndarray of shape (n_frames, 2, 3)
        Cameras in the canonical space, each divided by the size of its frame.
    sizes : ndarray of shape (n_frames,)
        Sizes of the frames.

    Returns
    -------
    ndarray of shape (2, 3)
        The mean camera times the root mean square size of the frames. If the cameras
        have no common view, the view along the third axis of the canonical space takes
        its place, each axis scaled by its root mean square length in the cameras.
    """
    camera = mean_view(motion)
    if camera is None:
        camera = np.sqrt(np.mean(np.sum(motion**2, axis=1), axis=0)) * np.eye(2, 3)
    return camera * np.sqrt(np.mean(sizes**2))
