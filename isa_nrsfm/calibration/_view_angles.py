"""Rotations as yaw, pitch and roll."""

from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.spatial.transform import Rotation


class ViewAngles(NamedTuple):
    """
    Angles of objects in degrees; NaN where a rotation is NaN.

    Attributes
    ----------
    yaw : ndarray of shape (n_frames,)
        From -180 to 180; positive where the object is turned to the viewer's right.
    pitch : ndarray of shape (n_frames,)
        From -90 to 90; positive where it looks up.
    roll : ndarray of shape (n_frames,)
        From -180 to 180; positive where it is turned clockwise in the image.
    """

    yaw: NDArray
    pitch: NDArray
    roll: NDArray


def view_angles(rotations: ArrayLike) -> ViewAngles:
    """
    Return yaw, pitch and roll of rotations.

    Parameters
    ----------
    rotations : array-like of shape (n_frames, 3, 3)
        Rotations R of a space in which x points to the viewer's right, y down and z
        away from the viewer, as in `canonical_pose`. The rows of R are the axes of the
        image: a frontal object has the identity. NaN for frames without one.

    Returns
    -------
    ViewAngles
        Named tuple of yaw, pitch and roll (n_frames,), such that ``R = Z(roll)
        X(-pitch) Y(-yaw)`` with rotations Z, X and Y about the three axes. All three
        are zero for a frontal, upright object.

    Raises
    ------
    ValueError
        If the array is not of this shape, or a matrix is no rotation.

    Notes
    -----
    An object that looks straight up or down (pitch 90 or -90) has no unique yaw: yaw
    and roll then describe the same rotation.

    Examples
    --------
    >>> import numpy as np
    >>> from isa_nrsfm.calibration import view_angles
    >>> to_the_right = [[0.0, 0.0, -1.0], [0.0, 1.0, 0.0], [1.0, 0.0, 0.0]]
    >>> angles = view_angles([np.eye(3), to_the_right])
    >>> angles.yaw
    array([ 0., 90.])
    """
    R = np.asarray(rotations, dtype=np.float64)
    if R.ndim != 3 or R.shape[1:] != (3, 3):
        raise ValueError(
            f"rotations must be of the shape (n_frames, 3, 3); got {R.shape}"
        )
    known = np.isfinite(R).all(axis=(1, 2))
    off = np.abs(R[known] @ R[known].swapaxes(1, 2) - np.eye(3)).max(initial=0.0)
    if off > 1e-3:
        raise ValueError(
            "rotations must be orthogonal matrices R without a scale; R R^T differs "
            f"from the identity by up to {off:.2g}"
        )
    angles = np.full((3, len(R)), np.nan)
    if known.any():
        turns = Rotation.from_matrix(R[known]).as_euler("ZXY", degrees=True)
        angles[:, known] = turns[:, ::-1].T * [[-1], [-1], [1]] + 0.0  # no minus zeros
    return ViewAngles(*angles)


def angle_deviations(angles: ViewAngles, covariance: ArrayLike) -> ViewAngles:
    """
    Return the standard deviations of yaw, pitch and roll.

    Parameters
    ----------
    angles : ViewAngles
        The angles of rotations R.
    covariance : array-like of shape (n_frames, 3, 3)
        Covariances, in radians squared, of the rotation vectors w of the errors, ``R
        exp(hat(w))``. The vectors w are in the axes of the object. See
        `AffineNRSfM.rotation_covariance`, rotated to these axes.

    Returns
    -------
    ViewAngles
        Standard deviations in degrees, to first order. They are infinite or very large
        where the object looks straight up or down, as yaw and roll have no meaning
        there.

    Notes
    -----
    With ``R = Z(roll) X(x) Y(y)``, x = -pitch and y = -yaw, the rotation vector of
    small changes is ``w = Y^T X^T e_z d(roll) + Y^T e_x dx + e_y dy``.

    Examples
    --------
    >>> import numpy as np
    >>> from isa_nrsfm.calibration import angle_deviations, view_angles
    >>> frontal = view_angles([np.eye(3)])
    >>> np.round(angle_deviations(frontal, [np.diag([0.01, 0.04, 0.0])]), 1)
    array([[11.5],
           [ 5.7],
           [ 0. ]])
    """
    C = np.asarray(covariance, dtype=np.float64)
    deviations = np.full((3, len(C)), np.nan)
    known = np.isfinite(angles.yaw) & np.isfinite(C).all(axis=(1, 2))
    if known.any():
        Y = Rotation.from_euler("y", -angles.yaw[known, None], degrees=True)
        X = Rotation.from_euler("x", -angles.pitch[known, None], degrees=True)
        along_x, along_z = Y.as_matrix()[:, 0], (X * Y).as_matrix()[:, 2]
        along_y = np.broadcast_to([0.0, 1.0, 0.0], along_x.shape)
        # w = slope (dy, dx, d roll)
        slope = np.stack([along_y, along_x, along_z], axis=2)
        inverse = np.linalg.pinv(slope)
        variance = np.einsum("nab,nbc,nac->an", inverse, C[known], inverse)
        deviations[:, known] = np.degrees(np.sqrt(variance))
    return ViewAngles(*deviations)
