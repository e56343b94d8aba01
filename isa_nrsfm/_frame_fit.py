"""Camera and coefficients of single frames for given shapes.

Each frame is fitted by itself: the result of a frame does not depend on the others.
"""

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from isa_nrsfm._camera import rigid_cameras
from isa_nrsfm._tracks import measurement_matrix

# A basis shape whose image has less than this share of the energy that the camera could
# show of it is seen end on: its image is rounding errors.
UNSEEN = 1e-28


class FrameFit(NamedTuple):
    """
    Cameras, positions and coefficients of frames.

    Attributes
    ----------
    motion : ndarray of shape (n_frames, 2, 3)
        Cameras, in the units of the table per unit of the shapes.
    translation : ndarray of shape (n_frames, 2)
        Image of the origin, which is the centroid of the points.
    alpha : ndarray of shape (n_frames, n_components)
        Coefficients of the basis shapes.
    """

    motion: NDArray
    translation: NDArray
    alpha: NDArray


def fit_frames(
    centred: NDArray, translation: NDArray, mean_shape: NDArray, basis: NDArray
) -> FrameFit:
    """
    Return the camera of the rigid fit and the coefficients of least squares.

    Parameters
    ----------
    centred : ndarray of shape (n_frames, n_points, 2)
        Tracks, centred over the points.
    translation : ndarray of shape (n_frames, 2)
        The centroids.
    mean_shape : ndarray of shape (n_points, 3)
        Centred.
    basis : ndarray of shape (n_components, n_points, 3)
        Centred basis shapes, orthogonal to each other and to the mean shape as the
        paper's are: ``B_k B_l^T = 0`` (3x3) for different k and l. The least squares
        then separate.

    Returns
    -------
    FrameFit
        ``alpha_ik = <W_i, M_i B_k> / ||M_i B_k||^2``, or zero where camera i does not
        see basis shape k at all.
    """
    W = measurement_matrix(centred)
    motion = rigid_cameras(W, mean_shape)
    n_components, n_points, _ = basis.shape
    stacked = basis.transpose(1, 0, 2).reshape(n_points, -1)
    P = (W @ stacked).reshape(len(centred), 2, n_components, 3)
    seen = np.einsum("irkc,irc->ik", P, motion)
    # ||M_i B_k|| = ||M_i R_k^T|| with B_k = Q R: squaring B_k would cost precision.
    R = np.linalg.qr(basis, mode="r")
    images = np.einsum("irc,kdc->ikrd", motion, R, optimize=True)
    energy = np.einsum("ikrd,ikrd->ik", images, images)
    largest = np.einsum("irc,irc,kdc,kdc->ik", motion, motion, R, R, optimize=True)
    visible = energy > UNSEEN * largest
    alpha = np.divide(seen, energy, where=visible, out=np.zeros_like(seen))
    return FrameFit(motion, translation, alpha)


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
