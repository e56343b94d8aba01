"""The upright space in which shapes are exported, and shapes, frames and names there.

In that space x points right, y down and z away from the viewer, who sees the object
from the front. Its lengths and angles are Euclidean as far as the cameras of the fitted
table determine them. Shapes of calibrated cameras are only rotated.
"""

import os
from collections.abc import Sequence
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
from isa_nrsfm._prepare.scaling import check_frames_kept
from isa_nrsfm.analysis._advice import depth_advice, facts_of
from isa_nrsfm.plotting import _views
from isa_nrsfm.skeletons import Skeleton
from isa_nrsfm.skeletons._column_names import checked_names

Camera = Literal["weak_perspective"] | None


class UprightSpace(NamedTuple):
    """The transform from the space of a model to the upright space.

    ``shape @ transform.T`` is upright; the transform of Euclidean shapes is orthogonal.
    `camera` is None for affine shapes; `metric`, or None, makes shapes of affine
    cameras Euclidean. The diagonal `image_axes` maps the axes of an image to the
    upright ones; `lines` are those to draw, of the layout if it is known.
    """

    camera: str | None
    metric: calibration.DeformationMetric | None
    transform: NDArray
    image_axes: NDArray
    lines: Skeleton | None


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
        warn_caller(depth_advice(facts_of(model)))
    to_metric = np.eye(3)
    if fitted != "affine":
        transform = _views.euclidean_axes(model)
    elif camera is None:
        transform = _views.viewing_transform(model.motion_, model.reference_motion_)
    else:
        metric = calibration.deformation_metric(model.motion_, model.alpha_)
        to_metric = np.linalg.inv(metric.Q)
        transform = _views.viewing_rotation(
            model.motion_ @ metric.Q,
            model.reference_motion_ @ metric.Q,
            to_metric @ to_metric.T,
        )
    shape = model.mean_shape_ @ (transform @ to_metric).T
    image_axes = np.eye(3)
    layout, lines, origin = _views.lines_of_model(model, edges, origin, shape)
    if origin == "lower":
        image_axes[1, 1] = -1
        transform, shape = _views.UPSIDE_DOWN @ transform, shape @ _views.UPSIDE_DOWN
    transform = _views.upright_turn(shape, layout, "upper") @ transform
    # Rotations stay rotations.
    image_axes[2, 2] = image_axes[1, 1] * np.sign(np.linalg.det(transform))
    return UprightSpace(calibrated, metric, transform, image_axes, lines)


def upright_frames(
    space: UprightSpace, model: Any, motion: NDArray, alpha: NDArray
) -> calibration.EuclideanFrames:
    """Return upright Euclidean shapes, rotations and scales of frames.

    NaN for frames without a camera. Rotations lead to the image turned upright.
    """
    if space.metric is None:
        rotations, scales = full_rotations(np.asarray(motion, dtype=np.float64))
        shapes = compose(model.mean_shape_, model.basis_, alpha)
    else:
        shapes, rotations, scales = calibration.euclidean_frames(
            space.metric, motion, alpha, model.mean_shape_, model.basis_
        )
    rotations = space.image_axes @ rotations @ space.transform.T
    return calibration.EuclideanFrames(shapes @ space.transform.T, rotations, scales)


def upright_shapes(space: UprightSpace, model: Any, X: Any) -> NDArray:
    """Return the upright shapes of the frames of `frames_of_table`."""
    return upright_frames(space, model, *frames_of_table(model, X)).shapes


def viewed_shapes(space: UprightSpace, model: Any) -> NDArray[np.float64]:
    """Return the centred mean shape and the basis shapes (K + 1, J, 3) for a viewer.

    They are upright, but y points up and z to the viewer. Euclidean shapes of affine
    cameras are not exactly linear in the coefficients. For these, the result is a least
    squares fit to the frames of the table, in blocks.
    """
    shapes = np.stack([model.mean_shape_, *model.basis_])
    if space.metric is None:
        shapes = shapes @ space.transform.T
    else:
        n_shapes, size = len(shapes), shapes[0].size
        gram, product = (np.zeros((n_shapes, n)) for n in (n_shapes, size))
        for block in gen_batches(len(model.alpha_), max(1, 2**23 // size)):
            motion, alpha = model.motion_[block], model.alpha_[block]
            frames = upright_frames(space, model, motion, alpha).shapes
            finite = np.isfinite(frames).all(axis=(1, 2))
            weights = np.insert(alpha[finite].astype(np.float64), 0, 1.0, axis=1)
            gram += weights.T @ weights
            product += weights.T @ frames[finite].reshape(-1, size)
        # Basis shapes of zeros have coefficients of zero.
        fit = np.linalg.pinv(gram, hermitian=True) @ product
        shapes = fit.reshape(shapes.shape)
    shapes[0] -= shapes[0].mean(axis=0)
    return shapes @ _views.UPSIDE_DOWN


def names_of_components(names: Any, n_components: int) -> list[str]:
    """Return the names of the coefficients, by default alpha_1, alpha_2, ..."""
    default = [f"alpha_{k + 1}" for k in range(n_components)]
    return checked_names("names", names, default)


def point_places(names: Sequence[str]) -> dict[str, int]:
    """Return the numbers of points by their names, or by their numbers."""
    named = {name: j for j, name in enumerate(names)}
    return {str(j): j for j in range(len(names))} | named


def suffix_of(path: str | os.PathLike[str], suffixes: Sequence[str]) -> str:
    """Return the suffix of a path in lower case, which must be one of those given."""
    suffix = Path(path).suffix.lower()
    if suffix not in suffixes:
        raise ValueError(
            f"path must end in {' or '.join(suffixes)}; got {os.fspath(path)}"
        )
    return suffix


def frames_of_table(
    model: Any, X: Any, point_weight: Any = None
) -> tuple[NDArray, NDArray]:
    """Return cameras and coefficients of a table or of frames that are fitted.

    Rotations lead to the axes of the camera, if known. None is the fitted table.
    """
    if X is None:
        alpha = model.alpha_ + removed_part(model, model.motion_)
        return in_camera_axes(model, model.motion_, model.translation_), alpha
    if not isinstance(X, Decomposition):
        X = model.decompose(X, point_weight=point_weight)
    return in_camera_axes(model, X.motion, X.translation), X.alpha
