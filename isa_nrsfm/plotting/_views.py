"""The frame in which shapes are viewed, its upward direction, and their lines.

Affine cameras and shapes are known up to one 3x3 affinity of space: without a choice,
shapes look squashed and sheared. The viewing affinity makes the cameras as nearly
weak-perspective as possible, and shapes face the mean camera. Shapes of calibrated
cameras are only rotated.
"""

from dataclasses import replace
from typing import Any, Literal

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.sparse.csgraph import minimum_spanning_tree
from scipy.spatial.distance import pdist, squareform

from isa_nrsfm._fitted_model import frames_of
from isa_nrsfm.calibration import _metric, canonical_pose
from isa_nrsfm.plotting._axes import SPANNING_TREE, is_dense
from isa_nrsfm.skeletons import Skeleton, find_skeleton
from isa_nrsfm.skeletons._column_names import names_of_points
from isa_nrsfm.skeletons._recognition import checked_links, checked_skeleton

# A name of a layout or "auto", the layout itself, or pairs of points.
Edges = ArrayLike | Skeleton | str | None
Origin = Literal["auto", "upper", "lower"]
Side = Literal["upper", "lower"]
# The layout of points, the lines to draw, and where y is zero.
Lines = tuple[Skeleton | None, Skeleton | None, Side]

UPSIDE_DOWN = np.diag([1.0, -1.0, -1.0])


def viewing_rotation(cameras: NDArray, reference: NDArray, spread: NDArray) -> NDArray:
    """Return the directions of space (3, 3) that are right, down and away in the view.

    Right and down are nearest to the reference camera (2, 3). If cameras
    (n_frames, 2, 3) go round the object, the direction of their axis in the images is
    kept. The view is then of the broadest side of the object, from the covariance
    `spread` of its points.
    """
    cameras = _metric.unit_cameras(cameras)
    left, shared, right = np.linalg.svd(cameras.mean(axis=0), full_matrices=False)
    row = np.sqrt(np.mean(np.sum(cameras**2, axis=(1, 2))) / 2)
    if shared[1] < 0.2 * row <= shared[0]:  # as in `mean_view`
        across = np.eye(3) - np.outer(right[0], right[0])
        broadest = np.linalg.eigh(across @ spread @ across)[1][:, -1]
        axis, turned = np.outer(left[:, 0], right[0]), np.outer(left[:, 1], broadest)
        axes = axis + turned * (1 if np.sum(turned * reference) >= 0 else -1)
    else:
        left, _, right = np.linalg.svd(reference, full_matrices=False)
        axes = left @ right
    return np.vstack([axes, np.cross(*axes)])


def view_and_layout(
    estimator: Any, edges: Any = "auto", origin: Origin = "auto"
) -> tuple[NDArray, Skeleton | None, Skeleton | None, Side]:
    """Return the view of a fitted model, its layout, the lines to draw, the origin.

    The view is the transform (3, 3) from the space of the model. With calibrated
    cameras it is a rotation times the median scale of the cameras.
    """
    if hasattr(estimator, "rotations_"):
        view = np.nanmedian(np.asarray(estimator.scales_)) * euclidean_axes(estimator)
    else:
        view = viewing_transform(estimator.motion_, estimator.reference_motion_)
    shape = estimator.mean_shape_ @ view.T
    return view, *lines_of_model(estimator, edges, origin, shape)


def lines_of_model(
    estimator: Any, edges: Edges, origin: Origin, shape: NDArray
) -> Lines:
    """Return layout, lines and origin of a model with a mean shape (n_points, 3).

    Points without a layout are near each other if they are near in the images.
    """
    gram = _metric.mean_gram(_metric.unit_cameras(np.asarray(estimator.motion_)))
    points = estimator.mean_shape_ @ _metric.symmetric_power(gram, 0.5)
    return choose_lines(edges, origin, shape, names_of_points(estimator), points)


def depth_note(estimator: Any) -> str:
    """Return the certainty of the depth in a few words; empty if not estimated."""
    certainty = frames_of(estimator).certainty
    if estimator.camera_ == "affine":
        return "depth up to an affinity"
    if not certainty.determined:
        return "depth not determined"
    estimated = np.isfinite(certainty.total)
    return f"depth error {100 * certainty.total:.2g} %" if estimated else ""


def euclidean_axes(estimator: Any) -> NDArray:
    """Return the viewing axes (3, 3) of a model with calibrated cameras."""
    motion, shape = np.asarray(estimator.motion_), estimator.mean_shape_
    spread = shape.T @ shape / len(shape)
    return viewing_rotation(motion, estimator.reference_motion_, spread)


def viewing_transform(motion: NDArray, reference_motion: NDArray) -> NDArray:
    """Return the transform T (3, 3) of affine space into the viewing frame.

    There, ``shape @ T.T``, the cameras (n_frames, 2, 3) are most nearly scaled rows of
    a rotation, and the median camera has rows of length one. If `metric_quadric` finds
    nothing, the mean of ``M_i^T M_i`` over the unit cameras is made isotropic. The x
    and y axes are those of `viewing_rotation`; T has a non-negative determinant.
    """
    G = _metric.metric_quadric(motion)
    if G is None:
        gram = _metric.mean_gram(_metric.unit_cameras(motion))
        metric = _metric.symmetric_power(gram, 0.5)
    else:
        metric = _metric.symmetric_power(G, -0.5)
    from_metric = np.linalg.pinv(metric)
    reference, spread = reference_motion @ from_metric, metric @ metric.T
    transform = viewing_rotation(motion @ from_metric, reference, spread) @ metric
    size = np.linalg.norm(motion @ np.linalg.pinv(transform), axis=(1, 2)) / np.sqrt(2)
    return transform * np.median(size[np.isfinite(size) & (size > 0)])


def choose_lines(
    edges: Edges, origin: Origin, shape: NDArray, names: Any = None, seen: Any = None
) -> Lines:
    """Return layout, lines to draw and origin of a shape (n_points, 2 or 3).

    Points without a layout, unless there are many, are joined by a minimal spanning
    tree of the points `seen`, by default the shape. Without lines only the points are
    drawn.
    """
    named = isinstance(edges, str | Skeleton)
    if named and edges != "auto":
        layout: Skeleton | None = checked_skeleton(edges, len(shape))
    else:
        layout = find_skeleton(len(shape), names, shape=shape)
    lines, pairs = layout, None
    if edges is None:
        lines = None
    elif not named:
        pairs = checked_links("edges", edges, len(shape))
    elif layout is None and not is_dense(shape):
        pairs = spanning_tree(shape if seen is None else seen)
    if pairs is not None:
        name = SPANNING_TREE if named else "edges"
        bare = layout or Skeleton(name, "other", len(shape), (), "the points")
        lines = replace(bare, curves=tuple(map(tuple, pairs.tolist())))
    return layout, lines, choose_origin(origin, shape, layout)


def spanning_tree(points: NDArray) -> NDArray[np.intp]:
    """Return the pairs of points (n_pairs, 2) of the tree with the shortest edges."""
    distances = pdist(points)
    # A distance of zero would be no edge; the same length added to all has no effect.
    lengths = squareform(distances + np.nanmax(distances, initial=0.0))
    return np.transpose(minimum_spanning_tree(lengths).nonzero())


def choose_origin(origin: Origin, shape: NDArray, layout: Skeleton | None) -> Side:
    """Return whether y points down in the image of a shape ("upper") or up ("lower").

    Hands determine nothing.
    """
    if origin == "auto":
        if layout is None or not layout.up or layout.kind == "hand":
            return "upper"
        below, above = shape[np.array(layout.up), 1].mean(axis=0)
        return "lower" if above > below else "upper"
    if origin not in ("upper", "lower"):
        raise ValueError(f'origin must be "auto", "upper" or "lower"; got {origin!r}')
    return origin


def upright_turn(shape: NDArray, layout: Skeleton | None, origin: Side) -> NDArray:
    """Return the orthogonal matrix that makes a shape (n_points, 3) stand upright.

    The y of the turned shape has the same direction. A shape without a layout stays.
    """
    if layout is None or not layout.up:
        return np.eye(3)
    over = UPSIDE_DOWN if origin == "lower" else np.eye(3)
    return over @ canonical_pose(shape @ over, scheme=layout).rotation @ over
