"""Affine cameras of rigid shapes, and the common view of many cameras."""

import numpy as np
from numpy.typing import NDArray


def rigid_cameras(W: NDArray, mean_shape: NDArray) -> NDArray:
    """Return least squares affine cameras (n, 2, 3) of W (2 n, J) and a shape (J, 3).

    They are those of least norm where the mean shape is flat.
    """
    return (W @ np.linalg.pinv(mean_shape, rcond=1e-10).T).reshape(-1, 2, 3)


def mean_view(motion: NDArray) -> NDArray | None:
    """Return the mean (2, 3) of cameras (n, 2, 3); None if they have no common view."""
    mean = motion.mean(axis=0)
    smaller = np.linalg.svd(mean, compute_uv=False)[1]
    # Relative to the root mean square of a camera's row
    root_mean_square = np.sqrt(np.mean(np.sum(motion**2, axis=(1, 2))) / 2)
    return mean if smaller > 0.2 * root_mean_square else None


def reference_camera(motion: NDArray, sizes: NDArray) -> NDArray:
    """Return a camera (2, 3) that sees shapes as the table shows them.

    The mean of the cameras (n, 2, 3), divided by the sizes (n,) of their frames, times
    the RMS size. If they have no common view, the view along the third axis, each axis
    scaled by its RMS length in the cameras.
    """
    camera = mean_view(motion)
    if camera is None:
        camera = np.sqrt(np.mean(np.sum(motion**2, axis=1), axis=0)) * np.eye(2, 3)
    return camera * np.sqrt(np.mean(sizes**2))
