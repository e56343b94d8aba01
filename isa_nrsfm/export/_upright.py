"""The upright space in which shapes are exported: shapes, head poses and distances.

In that space x points right, y down and z away from the viewer, who sees the object
from the front. Its lengths and angles are Euclidean as far as the cameras of the fitted
table determine them. Shapes of calibrated cameras are only rotated.
"""

import os
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any, Literal, NamedTuple

import numpy as np
from numpy.typing import NDArray
from sklearn.utils import gen_batches
from sklearn.utils.validation import check_is_fitted

from isa_nrsfm import calibration
from isa_nrsfm._compat.caller import warn_caller
from isa_nrsfm._estimator import check_class
from isa_nrsfm._fitted_model import frames_of, in_camera_axes, removed_part
from isa_nrsfm._frames.camera_models import compose, full_rotations
from isa_nrsfm._frames.models import Decomposition
from isa_nrsfm._parameters import JOINT_REFINEMENTS
from isa_nrsfm._prepare.scaling import check_frames_kept
from isa_nrsfm.analysis._advice import Facts, depth_advice
from isa_nrsfm.calibration._metric_upgrade import LARGEST_CONDITION
from isa_nrsfm.plotting import _views
from isa_nrsfm.skeletons import Skeleton
from isa_nrsfm.skeletons._column_names import names_of_points, point_places

Camera = Literal["weak_perspective"] | None


class UprightSpace(NamedTuple):
    """A model, and the transform from its space to the upright space.

    ``shape @ transform.T`` is upright; the transform of Euclidean shapes is orthogonal.
    `camera` is None for affine shapes; `metric`, or None, makes shapes of affine
    cameras Euclidean. The diagonal `image_axes` maps the axes of an image to the
    upright ones; `lines` are those to draw, of the layout if it is known.
    """

    model: Any
    camera: str | None
    metric: calibration.DeformationMetric | None
    transform: NDArray
    image_axes: NDArray
    lines: Skeleton | None

    def decompose(self, X: Any, point_weight: Any = None) -> tuple[NDArray, NDArray]:
        """Return cameras and coefficients of a table or of frames that are fitted.

        Rotations lead to the axes of the camera, if known. None is the fitted table.
        """
        model = self.model
        if X is None:
            alpha = model.alpha_ + removed_part(model, model.motion_)
            return in_camera_axes(model, model.motion_, model.translation_), alpha
        if not isinstance(X, Decomposition):
            X = model.decompose(X, point_weight=point_weight)
        return in_camera_axes(model, X.motion, X.translation), X.alpha

    def frames(self, motion: NDArray, alpha: NDArray) -> calibration.EuclideanFrames:
        """Return upright Euclidean shapes, rotations and scales of frames.

        NaN for frames without a camera. Rotations lead to the image turned upright.
        """
        if self.metric is None:
            rotations, scales = full_rotations(np.asarray(motion, dtype=np.float64))
            shapes = compose(self.model.mean_shape_, self.model.basis_, alpha)
        else:
            shapes, rotations, scales = calibration.euclidean_frames(
                self.metric, motion, alpha, self.model.mean_shape_, self.model.basis_
            )
        rotations = self.image_axes @ rotations @ self.transform.T
        return calibration.EuclideanFrames(shapes @ self.transform.T, rotations, scales)

    def shapes(self, X: Any) -> NDArray:
        """Return the upright shapes of the frames of `decompose`."""
        return self.frames(*self.decompose(X)).shapes

    def viewed_shapes(self) -> NDArray[np.float64]:
        """Return the centred mean shape and the basis shapes (K + 1, J, 3) to look at.

        They are upright, but y points up and z to the viewer. Euclidean shapes of
        affine cameras are not exactly linear in the coefficients. For these, the result
        is a least squares fit to the frames of the table, in blocks.
        """
        model = self.model
        shapes = np.stack([model.mean_shape_, *model.basis_])
        if self.metric is None:
            shapes = shapes @ self.transform.T
        else:
            n_shapes, size = len(shapes), shapes[0].size
            gram, product = (np.zeros((n_shapes, n)) for n in (n_shapes, size))
            for block in gen_batches(len(model.alpha_), max(1, 2**23 // size)):
                motion, alpha = model.motion_[block], model.alpha_[block]
                frames = self.frames(motion, alpha).shapes
                finite = np.isfinite(frames).all(axis=(1, 2))
                weights = np.insert(alpha[finite].astype(np.float64), 0, 1.0, axis=1)
                gram += weights.T @ weights
                product += weights.T @ frames[finite].reshape(-1, size)
            # Basis shapes of zeros have coefficients of zero.
            fit = np.linalg.pinv(gram, hermitian=True) @ product
            shapes = fit.reshape(shapes.shape)
        shapes[0] -= shapes[0].mean(axis=0)
        return shapes @ _views.UPSIDE_DOWN

    def poses(self, X: Any, point_weight: Any = None) -> "FramePoses":
        """Return the poses of frames."""
        motion, alpha = self.decompose(X, point_weight)
        shaped = alpha[:0] if self.metric is None else alpha  # no shapes are needed
        _, rotations, scales = self.frames(motion, shaped)
        # The fitted table must determine the depth.
        determined = frames_of(self.model).certainty.determined
        if self.metric is not None:
            determined = self.metric.condition_number <= LARGEST_CONDITION
        if not determined:
            rotations = np.full_like(rotations, np.nan)
        angles = calibration.view_angles(rotations)
        deviations = np.full((3, len(scales)), np.nan)
        joint = self.metric is None and self.model.refinement in JOINT_REFINEMENTS
        if joint and not (X is None or isinstance(X, Decomposition)):
            covariance = self.model.rotation_covariance(X, point_weight=point_weight)
            turned = self.transform @ covariance @ self.transform.T
            deviations = np.array(calibration.angle_deviations(angles, turned))
        return FramePoses(*angles, np.asarray(scales), *deviations)


def upright_space(
    model: Any, camera: Camera, origin: _views.Origin, edges: Any = "auto"
) -> UprightSpace:
    """Find the upright space of a fitted model, or raise.

    Faces and bodies of known layouts stand upright, look at the viewer and have noses
    and toes in front; hands stand upright. Other shapes are turned to the view of the
    mean camera. With affine cameras and `camera` None the space is that of the figures.
    With calibrated cameras None only omits the warning of uncertain depths.
    """
    check_class(model, "model")
    check_is_fitted(model)
    if camera not in ("weak_perspective", None):
        raise ValueError(f'camera must be "weak_perspective" or None; got {camera!r}')
    check_frames_kept(model, "exporting shapes")
    fitted, metric = model.camera_, None
    calibrated: str | None = camera if fitted == "affine" else fitted
    if camera is not None and not frames_of(model).certainty.determined:
        warn_caller(depth_advice(Facts(model)))
    to_metric = np.eye(3)
    if fitted != "affine":
        transform = _views.euclidean_axes(model)
    elif camera is None:
        transform = _views.viewing_transform(model.motion_, model.reference_motion_)
    else:
        metric = calibration.deformation_metric(model.motion_, model.alpha_)
        to_metric = np.linalg.inv(metric.Q)
        views = model.motion_ @ metric.Q, model.reference_motion_ @ metric.Q
        transform = _views.viewing_rotation(*views, to_metric @ to_metric.T)
    shape = model.mean_shape_ @ (transform @ to_metric).T
    layout, lines, origin = _views.lines_of_model(model, edges, origin, shape)
    over = _views.UPSIDE_DOWN if origin == "lower" else np.eye(3)
    transform = over @ _views.upright_turn(shape, layout, origin) @ transform
    # Rotations stay rotations.
    image_axes = over * [1.0, 1.0, np.sign(np.linalg.det(transform))]
    return UprightSpace(model, calibrated, metric, transform, image_axes, lines)


def suffix_of(path: str | os.PathLike[str], suffixes: Sequence[str]) -> str:
    """Return the suffix of a path in lower case, which must be one of those given."""
    suffix = Path(path).suffix.lower()
    if suffix not in suffixes:
        raise ValueError(
            f"path must end in {' or '.join(suffixes)}; got {os.fspath(path)}"
        )
    return suffix


# The outer corners of the eyes, of the 68 points of a face.
EYES = (36, 45)


class FramePoses(NamedTuple):
    """
    Poses of frames; NaN where a frame has no camera.

    Attributes
    ----------
    yaw : ndarray of shape (n_frames,)
        In degrees, defined by `isa_nrsfm.calibration.view_angles`: zero for
        a frontal, upright object. Positive where it is turned to the viewer's right.
    pitch : ndarray of shape (n_frames,)
        In degrees; positive where it looks up.
    roll : ndarray of shape (n_frames,)
        In degrees; positive where it is turned clockwise in the image.
    scale : ndarray of shape (n_frames,)
        Pixels, or units of the table, per unit of the shapes.
    yaw_std : ndarray of shape (n_frames,)
        Posterior standard deviation of yaw in degrees. NaN if `X` is no table, and for
        models with affine cameras, which have no rotations.
    pitch_std : ndarray of shape (n_frames,)
        That of pitch.
    roll_std : ndarray of shape (n_frames,)
        That of roll.
    """

    yaw: NDArray
    pitch: NDArray
    roll: NDArray
    scale: NDArray
    yaw_std: NDArray
    pitch_std: NDArray
    roll_std: NDArray


def frame_poses(
    model: Any,
    X: Any = None,
    *,
    point_weight: Any = None,
    camera: Camera = "weak_perspective",
    edges: Any = "auto",
    origin: _views.Origin = "auto",
) -> FramePoses:
    """
    Return yaw, pitch and roll of the object in each frame.

    If the layout of the points is known (`isa_nrsfm.skeletons`), angles are relative to
    an upright, frontal object. Otherwise they are relative to the view of the mean
    camera.

    Parameters
    ----------
    model : AffineNRSfM
        A fitted model that has kept its frames.
    X : array-like of shape (n_frames, 2 * n_points), or Decomposition, default=None
        A table with the points of the fitted one, or the result of ``model.decompose``,
        whose frames are not fitted again. By default the fitted table.
    point_weight : array-like of shape (n_frames, n_points), default=None
        Weights of the points of a table X, as in ``model.fit``.
    camera : {"weak_perspective"}, default="weak_perspective"
        Camera model for a model with affine cameras. Calibrated cameras have their own.
    edges : "auto", str, Skeleton or None, default="auto"
        The layout of the points or its name; otherwise it is recognised.
    origin : {"auto", "upper", "lower"}, default="auto"
        Where y is zero in the table: above, as in images, or below.

    Returns
    -------
    FramePoses
        Named tuple of yaw, pitch, roll, scale and standard deviations (n_frames,).

    Raises
    ------
    ValueError
        If the model has kept no frames, if `camera` is None, or if the cameras see
        fewer than three directions of space.

    Warns
    -----
    UserWarning
        If the fitted table does not determine the depth. The angles are then NaN.

    Examples
    --------
    >>> from isa_nrsfm import AffineNRSfM
    >>> from isa_nrsfm.datasets import make_face_tracks
    >>> from isa_nrsfm.export import frame_poses
    >>> options = {"camera": "weak_perspective", "random_state": 0}
    >>> faces = make_face_tracks(40, n_components=1, **options)
    >>> model = AffineNRSfM(1, **options)
    >>> frame_poses(model.fit(faces.data)).yaw.shape
    (40,)
    """
    pose = pose_function(model, camera=camera, edges=edges, origin=origin)
    return pose(X, point_weight)


def pose_function(
    model: Any,
    *,
    camera: Camera = "weak_perspective",
    edges: Any = "auto",
    origin: _views.Origin = "auto",
) -> Callable[..., FramePoses]:
    """
    Return a function that computes the poses of frames of a model.

    The upright space of the model is computed once, for many calls with few frames.

    Parameters
    ----------
    model : AffineNRSfM
        A fitted model that has kept its frames.
    camera : {"weak_perspective"}, default="weak_perspective"
        As in `frame_poses`.
    edges : "auto", str, Skeleton or None, default="auto"
        As in `frame_poses`.
    origin : {"auto", "upper", "lower"}, default="auto"
        As in `frame_poses`.

    Returns
    -------
    callable
        Function of `X`, a table or the result of ``model.decompose``, or None for the
        fitted table, and optionally of `point_weight`. It returns `FramePoses`.

    Raises
    ------
    ValueError
        For the reasons given in `frame_poses`.

    Examples
    --------
    >>> from isa_nrsfm import AffineNRSfM
    >>> from isa_nrsfm.datasets import make_face_tracks
    >>> from isa_nrsfm.export import pose_function
    >>> options = {"camera": "weak_perspective", "random_state": 0}
    >>> faces = make_face_tracks(20, n_components=1, **options)
    >>> model = AffineNRSfM(1, **options)
    >>> poses = pose_function(model.fit(faces.data))
    >>> for row in faces.data[:2]:
    ...     frame = model.decompose(row[None])
    ...     shape, pose = model.reconstruct(frame), poses(frame)
    >>> shape.shape, pose.yaw.shape
    ((1, 68, 3), (1,))
    """
    if camera is None:
        raise ValueError("angles need calibrated cameras; got camera=None")
    return upright_space(model, camera, origin, edges).poses


def point_distances(
    model: Any,
    pairs: Sequence[tuple[Any, Any]],
    X: Any = None,
    *,
    unit: tuple[Any, Any] | None = None,
    length: float = 1.0,
    camera: Camera = "weak_perspective",
) -> NDArray:
    """
    Return Euclidean distances of points in the shape of each frame.

    Parameters
    ----------
    model : AffineNRSfM
        A fitted model that has kept its frames.
    pairs : sequence of (int or str, int or str)
        Pairs of points, by their numbers from zero or by the names of their columns.
    X : array-like of shape (n_frames, 2 * n_points), or Decomposition, default=None
        A table with the points of the fitted one, or the result of ``model.decompose``,
        whose frames are not fitted again. By default the fitted table.
    unit : (int or str, int or str), default=None
        Two points whose distance in the mean shape is `length`. By default the outer
        corners of the eyes, if the points are the 68 of a face in the order of iBUG.
    length : float, default=1.0
        Their distance, for instance 90 for millimetres.
    camera : {"weak_perspective"}, default="weak_perspective"
        Camera model for a model with affine cameras.

    Returns
    -------
    ndarray of shape (n_frames, n_pairs)
        Distances in units of `length`; NaN where a frame has no shape.

    Raises
    ------
    ValueError
        If `pairs` is a single pair, if there is no such point, if `length` is not
        positive, if `unit` is not given and the points are not those of a face, or for
        the reasons given in `frame_poses`.

    Examples
    --------
    >>> from isa_nrsfm import AffineNRSfM
    >>> from isa_nrsfm.datasets import make_face_tracks
    >>> from isa_nrsfm.export import point_distances
    >>> options = {"camera": "weak_perspective", "random_state": 0}
    >>> faces = make_face_tracks(20, n_components=1, **options)
    >>> model = AffineNRSfM(1, **options)
    >>> model = model.fit(faces.data)
    >>> point_distances(model, [(48, 54), (62, 66)]).shape  # of the mouth
    (20, 2)
    """
    if camera is None:
        raise ValueError("distances need calibrated cameras; got camera=None")
    if not 0 < length < np.inf:
        raise ValueError(f"length must be a positive number; got {length}")
    space = upright_space(model, camera, "auto")
    names = names_of_points(model)
    first, second = np.array([point_numbers(pair, names) for pair in pairs]).T
    if unit is None and getattr(space.lines, "name", None) != "ibug-68":
        raise ValueError("unit must name two points, as these are not the 68 of a face")
    unit = EYES if unit is None else unit
    a, b = point_numbers(unit, names)
    shapes = space.shapes(X)
    mean = np.nanmean(shapes, axis=0)
    size = np.linalg.norm(mean[a] - mean[b])
    if not size > 0:
        raise ValueError(f"the points {unit} of unit are in one place")
    return np.linalg.norm(shapes[:, first] - shapes[:, second], axis=2) * length / size


def point_numbers(pair: Sequence[Any], names: Sequence[str]) -> tuple[int, int]:
    """Return the numbers of two different points, given by number or name."""
    if np.ndim(pair) == 0:
        raise ValueError(
            "expected pairs of points, such as [(62, 66)] for the distance of points "
            f"62 and 66; got {pair!r} instead of a pair"
        )
    places = point_places(names)
    for each in pair:
        if str(each) not in places:
            raise ValueError(
                f"there is no point {each!r}; the {len(names)} points are "
                f"{', '.join(list(names)[:4])}, ..."
            )
    found = [places[str(each)] for each in pair]
    if len(found) != 2 or found[0] == found[1]:
        raise ValueError(f"expected two different points; got {tuple(pair)}")
    return found[0], found[1]
