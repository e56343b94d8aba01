"""The frame in which shapes are looked at.

A factorisation into affine cameras and shapes is known up to one 3x3 affinity of
space. Drawn as they are, the shapes look squashed and sheared. The functions here find
the affinity under which the cameras are as nearly as possible scaled orthographic
(weak perspective) ones, and turn the shapes until they face the mean camera. Shapes of
calibrated cameras have true proportions as they are, and are only turned.
"""

from typing import Any

import numpy as np
from numpy.typing import NDArray

from isa_nrsfm._frames.camera import DEGENERATE_MEAN
from isa_nrsfm._metric_upgrade.quadric import (
    mean_gram,
    metric_quadric,
    symmetric_power,
    unit_cameras,
)
from isa_nrsfm._tables.column_names import names_of_points
from isa_nrsfm.plotting._edges import choose_layout
from isa_nrsfm.skeletons import Skeleton


def front_axes(cameras: NDArray, reference: NDArray, spread: NDArray) -> NDArray:
    """
    Return the directions of space that the front view shows to the right and down.

    Parameters
    ----------
    cameras : ndarray of shape (n_frames, 2, 3)
        Cameras of unit norm.
    reference : ndarray of shape (2, 3)
        The camera that sees the front view.
    spread : ndarray of shape (3, 3)
        Covariance of the points of the object.

    Returns
    -------
    ndarray of shape (2, 3)
        The pair of orthonormal rows that is nearest to the reference camera. Cameras
        that go round the object have no common view, but see the axis they turn about
        in one direction of the image: it stays in that direction then, and the object
        is turned to where it looks broadest.
    """
    left, shared, right = np.linalg.svd(cameras.mean(axis=0), full_matrices=False)
    row = np.sqrt(np.mean(np.sum(cameras**2, axis=(1, 2))) / 2)
    if not shared[1] < DEGENERATE_MEAN * row <= shared[0]:
        left, _, right = np.linalg.svd(reference, full_matrices=False)
        return left @ right
    across = np.eye(3) - np.outer(right[0], right[0])
    broadest = np.linalg.eigh(across @ spread @ across)[1][:, -1]
    axis, turned = np.outer(left[:, 0], right[0]), np.outer(left[:, 1], broadest)
    return axis + turned * (1 if np.sum(turned * reference) >= 0 else -1)


def view_of(estimator: Any) -> NDArray:
    """
    Return the transform of the space of a fitted model into the viewing frame.

    Parameters
    ----------
    estimator : AffineNRSfM
        A fitted model that has kept its frames.

    Returns
    -------
    ndarray of shape (3, 3)
        That of `viewing_transform`, or with calibrated cameras `euclidean_axes` times
        the median scale of the cameras.
    """
    if not hasattr(estimator, "rotations_"):
        return viewing_transform(estimator.motion_, estimator.reference_motion_)
    scales = np.asarray(estimator.scales_)
    return np.nanmedian(scales) * euclidean_axes(estimator)


def layout_of(estimator: Any, edges: Any = "auto") -> Skeleton | None:
    """Return the layout of a fitted model's points, where it is given or recognised."""
    shape = estimator.mean_shape_ @ view_of(estimator).T
    return choose_layout(edges, shape, names_of_points(estimator))


def euclidean_axes(estimator: Any) -> NDArray:
    """
    Return the axes of the viewing frame of a model with calibrated cameras.

    Parameters
    ----------
    estimator : AffineNRSfM
        A fitted model with calibrated cameras that has kept its frames.

    Returns
    -------
    ndarray of shape (3, 3)
        A rotation T: ``shape @ T.T`` is seen from the front.
    """
    shape = estimator.mean_shape_
    axes = front_axes(
        unit_cameras(np.asarray(estimator.motion_)),
        estimator.reference_motion_,
        shape.T @ shape / len(shape),
    )
    return np.vstack([axes, np.cross(*axes)])


def viewing_transform(motion: NDArray, reference_motion: NDArray) -> NDArray:
    """
    Find the transform of space into the frame in which shapes are looked at.

    In that frame the cameras are as nearly as possible scaled rows of a rotation
    (`metric_quadric`; where it finds nothing, the mean of ``M_i^T M_i`` over the unit
    cameras is made isotropic instead). The x and y axes are those of the reference
    camera's image (`front_axes`): x points right, and y down where the image's y does.
    The third axis keeps the handedness of the given coordinates. A camera of median
    size has rows of length one, so that shapes are in the units of the image.

    Parameters
    ----------
    motion : ndarray of shape (n_frames, 2, 3)
        The affine cameras, in coordinates in which the mean shape is white.
    reference_motion : ndarray of shape (2, 3)
        The camera that sees the front view.

    Returns
    -------
    ndarray of shape (3, 3)
        The transform T with non-negative determinant: ``shape @ T.T`` is a shape in
        the viewing frame. If the cameras are weak-perspective ones of some shape, that
        is this shape up to scale, a rotation and its mirror image.
    """
    G = metric_quadric(motion)
    if G is None:
        metric = symmetric_power(mean_gram(unit_cameras(motion)), 0.5)
    else:
        metric = symmetric_power(G, -0.5)
    from_metric = np.linalg.pinv(metric)
    axes = front_axes(
        unit_cameras(motion @ from_metric),
        reference_motion @ from_metric,
        metric @ metric.T,
    )
    transform = np.vstack([axes, np.cross(*axes)]) @ metric
    size = np.linalg.norm(motion @ np.linalg.pinv(transform), axis=(1, 2)) / np.sqrt(2)
    return transform * np.median(size[np.isfinite(size) & (size > 0)])
