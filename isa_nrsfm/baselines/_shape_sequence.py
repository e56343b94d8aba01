"""Sequences of cameras and shapes: signs of frames and principal components.

With one shape for each frame the sign of a frame is undetermined: the camera -R_i sees
-S_i as R_i sees S_i.
"""

import numpy as np
from numpy.typing import NDArray

from isa_nrsfm._linalg.small_matrices import orientations


def shape_signs(shapes: NDArray) -> NDArray:
    """Return signs z_i of shapes (n_frames, n_points, 3) that make them similar.

    Each z_i S_i has a non-negative inner product with ``sum_i z_i S_i``, from the first
    left singular vector.
    """
    rows = shapes.reshape(len(shapes), -1)
    tall = len(rows) > rows.shape[1]
    first = np.linalg.eigh(rows.T @ rows if tall else rows @ rows.T)[1][:, -1]
    signs = _sign(rows @ first if tall else first)
    for _ in range(100):  # each round increases the sum, a few are enough
        changed = _sign(rows @ (signs @ rows))
        if (changed == signs).all():
            break
        signs = changed
    return signs


def camera_signs(cameras: NDArray) -> NDArray:
    """Return signs of cameras (n_frames, 2, 3) that turn them least between frames."""
    agreement = np.einsum("irc,irc->i", cameras[1:], cameras[:-1])
    return np.cumprod(np.concatenate([[1.0], _sign(agreement)]))


def _sign(values: NDArray) -> NDArray:
    """Return 1.0 or -1.0 for each value."""
    return np.where(values < 0, -1.0, 1.0)


def principal_shapes(
    shapes: NDArray, n_components: int
) -> tuple[NDArray, NDArray, NDArray]:
    """Return mean, principal components and coefficients of shapes.

    The components (K, J, 3) are orthogonal, decreasing, one standard deviation each.
    The coefficients (I, K) are white, with non-negative skewness. Zero without
    variation.
    """
    mean_shape = shapes.mean(axis=0)
    rest = (shapes - mean_shape).reshape(len(shapes), -1)
    U, S, Vt = np.linalg.svd(rest, full_matrices=False)
    U, S, Vt = U[:, :n_components], S[:n_components], Vt[:n_components]
    root = np.sqrt(len(shapes))
    # Smaller deformations are rounding errors.
    moving = S > 1e-12 * root * np.linalg.norm(mean_shape)
    signs = np.where(moving, orientations(U.T), 0.0)
    basis = (signs * S / root)[:, None] * Vt
    return mean_shape, basis.reshape(-1, *mean_shape.shape), root * signs * U
