"""Turn a shape upright and frontal; rotations as yaw, pitch and roll."""

from typing import Any, NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.optimize import linear_sum_assignment
from scipy.spatial.transform import Rotation

from isa_nrsfm.skeletons import Skeleton
from isa_nrsfm.skeletons._recognition import checked_links, checked_skeleton

# What determines the x, y and z axes: the last two are opposite to their axes.
DIRECTIONS = ("left_right", "up", "front")


class CanonicalPose(NamedTuple):
    """
    A shape that stands upright and faces the viewer.

    Attributes
    ----------
    shape : ndarray of shape (n_points, 3)
        ``given shape @ rotation.T``: x points to the right of the viewer, y down and z
        away from the viewer, who looks along z.
    rotation : ndarray of shape (3, 3)
        An orthogonal matrix, with determinant -1 if the shape is mirrored and +1
        otherwise. Transform other arrays in the same space by it: basis shapes like the
        shape, and cameras M to ``M @ rotation.T``.
    mirrored : bool
        Whether the shape is the mirror image of the given one.
    """

    shape: NDArray
    rotation: NDArray
    mirrored: bool


def canonical_pose(
    shape: ArrayLike,
    *,
    left_right: ArrayLike | None = None,
    up: ArrayLike | None = None,
    front: ArrayLike | None = None,
    scheme: Skeleton | str | None = None,
) -> CanonicalPose:
    """
    Turn a shape upright and frontal, as in a passport photo.

    If directions are given by points of the object, the pose does not depend on the
    cameras. Shapes must have true angles. Apply `euclidean_shapes` first to shapes of
    affine cameras.

    Parameters
    ----------
    shape : array-like of shape (n_points, 3)
        The shape, such as a mean shape in Euclidean coordinates.
    left_right : array-like of int, shape (n_pairs, 2), default=None
        Pairs of points: the first is on the left for the viewer, the second on the
        right. The right eye of a person comes before the left one. The x axis is the
        principal axis of their differences.
    up : array-like, default=None
        A direction (3,) in the coordinates of the shape, or pairs of points (n_pairs,
        2), the lower one first. The mean difference of pairs is the direction. In an
        upright shape it is opposite to the y axis and orthogonal to x.
    front : array-like, default=None
        Direction from the object to the viewer: a direction (3,), or pairs of points
        (n_pairs, 2), the one behind first. If `left_right` and `up` are given, it
        selects the mirror image: if it points away from the viewer, the sign of the
        depth is changed.
    scheme : Skeleton or str, default=None
        The layout of the points, or its name in `isa_nrsfm.skeletons.SKELETONS`. It
        defines the directions that are not given. For ``"ibug-68"``: all symmetric
        points as `left_right`, from the chin to the root of the nose as `up`, and from
        the ends of the jaw to the tip of the nose as `front`. Hands define only `up`:
        the side that faces the viewer stays the same.

    Returns
    -------
    CanonicalPose
        Named tuple of the shape, the rotation and whether it is a mirror image.

    Raises
    ------
    ValueError
        If only one of the three directions is given, if two are parallel or one is
        zero, or if points do not exist. If the scheme is unknown, has another number of
        points or defines no pose. If `shape` does not have the shape above or is not
        finite.

    Notes
    -----
    Two of the three directions determine the rotation, with x before y before z where
    they are not orthogonal. If none is given, each axis becomes the nearest principal
    axis of the points. A shape that is upright up to some tens of degrees stays
    upright.

    Affine cameras do not distinguish a shape from its mirror image in depth. The shape
    is mirrored only if all three directions are given and contradict each other. They
    also do so if left and right are confused in the pairs of points.

    Examples
    --------
    >>> import numpy as np
    >>> from isa_nrsfm.calibration import canonical_pose
    >>> from isa_nrsfm.datasets import make_face_tracks
    >>> face = make_face_tracks(n_frames=2, random_state=0).neutral_shape
    >>> quarter = np.array([[0.0, 0.0, 1.0], [0.0, 1.0, 0.0], [-1.0, 0.0, 0.0]])
    >>> pose = canonical_pose(face @ quarter.T, scheme="ibug-68")
    >>> bool(np.abs(pose.shape - face).max() < 2.5), pose.mirrored  # of 168 mm
    (True, False)
    """
    points = np.asarray(shape, dtype=np.float64)
    if points.ndim != 2 or points.shape[1] != 3 or not np.isfinite(points).all():
        raise ValueError(
            "shape must be of the shape (n_points, 3) and finite; got the shape "
            f"{points.shape} with {np.sum(~np.isfinite(points))} entries that are not"
        )
    given: dict[str, Any] = {"left_right": left_right, "up": up, "front": front}
    if scheme is not None:
        layout = checked_skeleton(scheme, len(points))
        if not layout.up:
            raise ValueError(f"scheme={layout.name!r} does not define which way is up")
        for name in DIRECTIONS:
            if given[name] is None and len(getattr(layout, name)):
                given[name] = getattr(layout, name)
        if given["left_right"] is None and given["front"] is None:
            given["front"] = (0.0, 0.0, -1.0)  # to the viewer
    axes = {n: _axis(n, points, d) for n, d in given.items() if d is not None}
    if len(axes) == 1:
        raise ValueError(
            "two of left_right, up and front determine the pose; only one is given"
        )
    rotation = _frame(axes) if axes else _principal_axes(points)
    mirrored = len(axes) == 3 and bool(rotation[2] @ axes["front"] < 0)
    if mirrored:
        rotation[2] *= -1
    return CanonicalPose(points @ rotation.T, rotation, mirrored)


def _frame(axes: dict[str, Any]) -> NDArray:
    """Return the rotation whose rows are the first two axes that are known."""
    (first, second), pair = [*axes][:2], [*axes.values()][:2]
    sine = np.linalg.norm(np.cross(*pair))
    if sine < 1e-6:
        raise ValueError(
            f"{first} and {second} must not be parallel; the sine of their angle is "
            f"{sine:.1e}"
        )
    # An infinite weight: the first axis becomes the coordinate axis, exactly.
    rows = np.eye(3)[[DIRECTIONS.index(first), DIRECTIONS.index(second)]]
    return Rotation.align_vectors(rows, pair, weights=[np.inf, 1])[0].as_matrix()


def _principal_axes(points: NDArray) -> NDArray:
    """Return the principal axes as a rotation, each nearest to its coordinate axis."""
    centred = points - points.mean(axis=0)
    axes = np.linalg.eigh(centred.T @ centred)[1].T
    chosen, places = linear_sum_assignment(np.abs(axes), maximize=True)
    rotation = np.zeros((3, 3))
    rotation[places] = axes[chosen]
    rotation[rotation.diagonal() < 0] *= -1
    if np.linalg.det(rotation) < 0:
        rotation[np.argmin(rotation.diagonal())] *= -1
    return rotation


def _axis(name: str, points: NDArray, given: Any) -> NDArray:
    """Return the unit vector that becomes the x, y or z axis, of a direction.

    It is given itself or by pairs of points: to the right, up or to the front.
    """
    if name == "left_right":
        difference = _differences(name, points, given)
        axis = np.linalg.svd(difference, full_matrices=False)[2][0]
        along = axis @ difference.sum(axis=0)
        if not along:
            raise ValueError("the pairs of left_right have no direction in common")
        return axis * np.sign(along)
    vector = np.asarray(given)
    if vector.shape == (3,):
        vector = vector.astype(np.float64)
    elif vector.ndim == 2:
        vector = _differences(name, points, given).mean(axis=0)
    else:
        raise ValueError(
            f"{name} must be a direction of shape (3,) or pairs of points of shape "
            f"(n_pairs, 2); got the shape {vector.shape}"
        )
    size = np.linalg.norm(vector)
    if not 0 < size < np.inf:
        raise ValueError(f"{name} must be a direction other than zero; got {vector}")
    return -vector / size


def _differences(name: str, points: NDArray, pairs: ArrayLike) -> NDArray:
    """Return the differences (n_pairs, 3) of the points of pairs."""
    index = checked_links(name, pairs, len(points))
    if not index.size:
        raise ValueError(f"{name} must name a pair of points; got none")
    return points[index[:, 1]] - points[index[:, 0]]


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
    mask = np.isfinite(R).all(axis=(1, 2))
    error = np.abs(R[mask] @ R[mask].swapaxes(1, 2) - np.eye(3)).max(initial=0.0)
    if error > 1e-3:
        raise ValueError(
            "rotations must be orthogonal matrices R without a scale; R R^T differs "
            f"from the identity by up to {error:.2g}"
        )
    angles = np.full((3, len(R)), np.nan)
    if mask.any():
        turns = Rotation.from_matrix(R[mask]).as_euler("ZXY", degrees=True)
        angles[:, mask] = turns[:, ::-1].T * [[-1], [-1], [1]] + 0.0  # no minus zeros
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
    mask = np.isfinite(angles.yaw) & np.isfinite(C).all(axis=(1, 2))
    if mask.any():
        Y = Rotation.from_euler("y", -angles.yaw[mask, None], degrees=True)
        X = Rotation.from_euler("x", -angles.pitch[mask, None], degrees=True)
        along_x, along_z = Y.as_matrix()[:, 0], (X * Y).as_matrix()[:, 2]
        along_y = np.broadcast_to([0.0, 1.0, 0.0], along_x.shape)
        # w = slope (dy, dx, d roll)
        slope = np.stack([along_y, along_x, along_z], axis=2)
        inverse = np.linalg.pinv(slope)
        variance = np.einsum("nab,nbc,nac->an", inverse, C[mask], inverse)
        deviations[:, mask] = np.degrees(np.sqrt(variance))
    return ViewAngles(*deviations)
