"""Sequences of cameras and shapes: signs and principal components.

Where each frame has a shape of its own, the sign of a frame is free: the camera -R_i
sees in -S_i what R_i sees in S_i.
"""

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from isa_nrsfm._linalg.vectors import orientations

# Rounds of `shape_signs`; a few are enough, and each raises the sum.
MAX_ROUNDS = 100
# Deformations below this share of the mean shape are rounding errors.
RIGID = 1e-12


class ShapeSequence(NamedTuple):
    """
    What a method finds: a camera and a shape for each frame.

    Attributes
    ----------
    cameras : ndarray of shape (n_frames, 2, 3)
        R_i, with orthonormal rows.
    shapes : ndarray of shape (n_frames, n_points, 3)
        S_i^T, centred; ``W_i ~ R_i S_i``.
    """

    cameras: NDArray
    shapes: NDArray


def shape_signs(shapes: NDArray) -> NDArray:
    """
    Return a sign for each frame such that the shapes resemble each other.

    Parameters
    ----------
    shapes : ndarray of shape (n_frames, n_points, 3)
        Shapes S_i, each known up to its sign.

    Returns
    -------
    ndarray of shape (n_frames,)
        Signs z_i, 1.0 or -1.0, for which no single one can be changed to raise
        ``||sum_i z_i S_i||_F``: from those of the first left singular vector of the
        shapes, in turns with the sum. The order of the frames does not matter.
    """
    rows = shapes.reshape(len(shapes), -1)
    small = rows.T @ rows if len(rows) > rows.shape[1] else rows @ rows.T
    first = np.linalg.eigh(small)[1][:, -1]
    signs = _sign(rows @ first if len(rows) > rows.shape[1] else first)
    for _ in range(MAX_ROUNDS):
        changed = _sign(rows @ (signs @ rows))
        if (changed == signs).all():
            break
        signs = changed
    return signs


def camera_signs(cameras: NDArray) -> NDArray:
    """
    Return a sign for each frame such that the camera turns little between frames.

    Parameters
    ----------
    cameras : ndarray of shape (n_frames, 2, 3)
        Cameras R_i with orthonormal rows, of successive frames, each known up to its
        sign.

    Returns
    -------
    ndarray of shape (n_frames,)
        Signs, 1.0 or -1.0, with which each camera is turned from the one before it by
        the lesser of two angles: with the other sign the camera is turned by 180
        degrees about the line of sight.
    """
    agreement = np.einsum("irc,irc->i", cameras[1:], cameras[:-1])
    return np.cumprod(np.concatenate([[1.0], _sign(agreement)]))


def _sign(values: NDArray) -> NDArray:
    """Return 1.0 or -1.0 for each value."""
    return np.where(values < 0, -1.0, 1.0)


def principal_shapes(
    shapes: NDArray, n_components: int
) -> tuple[NDArray, NDArray, NDArray]:
    """
    Return the mean and the principal components of shapes.

    Parameters
    ----------
    shapes : ndarray of shape (n_frames, n_points, 3)
        Shapes.
    n_components : int
        K, the number of components.

    Returns
    -------
    mean_shape : ndarray of shape (n_points, 3)
        Their mean B_0.
    basis : ndarray of shape (n_components, n_points, 3)
        B_k, orthogonal to each other, by decreasing norm, one standard deviation of
        the coefficients each; zero where there is no variation.
    coefficients : ndarray of shape (n_frames, n_components)
        Of mean zero, uncorrelated, with unit variance and a third moment that is not
        negative; zero where there is no variation. ``B_0 + sum_k coefficients_ik B_k``
        are the shapes of rank K next to the given ones.
    """
    mean_shape = shapes.mean(axis=0)
    rest = (shapes - mean_shape).reshape(len(shapes), -1)
    U, S, Vt = np.linalg.svd(rest, full_matrices=False)
    U, S, Vt = U[:, :n_components], S[:n_components], Vt[:n_components]
    root = np.sqrt(len(shapes))
    moving = S > RIGID * root * np.linalg.norm(mean_shape)
    signs = np.where(moving, orientations(U.T), 0.0)
    basis = (signs * S / root)[:, None] * Vt
    return mean_shape, basis.reshape(-1, *mean_shape.shape), root * signs * U
