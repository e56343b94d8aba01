"""Rotations as the three angles in which people tell a pose."""

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
        away from the viewer, as `canonical_pose` has it. The rows of R see the object:
        a frontal object has the identity. NaN for frames without one.

    Returns
    -------
    ViewAngles
        Named tuple of yaw, pitch and roll (n_frames,), such that ``R = Z(roll)
        X(-pitch) Y(-yaw)`` with rotations Z, X and Y about the three axes. All three
        are zero for a frontal, upright object.

    Raises
    ------
    ValueError
        If these are not rotations: orthogonal with determinant one, to 1e-6.

    Notes
    -----
    An object that looks straight up or down (pitch 90 or -90) has no yaw of its own:
    yaw and roll then describe the same turn.

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
    if off > 1e-6 or (np.linalg.det(R[known]) < 0).any():
        raise ValueError(
            "rotations must be orthogonal with determinant 1; the products of their "
            f"rows are off by {off:.1e}, and "
            f"{int(np.sum(np.linalg.det(R[known]) < 0))} are mirror images"
        )
    angles = np.full((3, len(R)), np.nan)
    if known.any():
        euler = Rotation.from_matrix(R[known]).as_euler("ZXY", degrees=True)
        roll, x, y = euler.T
        angles[:, known] = -y + 0.0, -x + 0.0, roll + 0.0  # no minus zeros
    return ViewAngles(*angles)
