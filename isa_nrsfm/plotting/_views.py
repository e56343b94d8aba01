"""What figures have in common: axes, colours, pages, and the frame of shapes.

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

from isa_nrsfm._compat.lazy import import_optional
from isa_nrsfm._fitted_model import frames_of
from isa_nrsfm._linalg import polar
from isa_nrsfm.calibration import _metric, canonical_pose
from isa_nrsfm.skeletons import Skeleton, find_skeleton
from isa_nrsfm.skeletons._column_names import checked_names, names_of_points
from isa_nrsfm.skeletons._recognition import checked_links, checked_skeleton

# Vermilion, blue and black of the palette of Okabe and Ito, which people with any kind
# of colour vision can distinguish; grey for comparison.
PLUS_COLOUR = "#D55E00"
MINUS_COLOUR = "#0072B2"
OBSERVED_COLOUR = "black"
MEAN_COLOUR = "0.55"
# Name of the lines between points that have no known layout.
SPANNING_TREE = "minimal spanning tree"
# Bluish green and reddish purple of the same palette, for the sides of a body.
LEFT_COLOUR = "#009E73"
RIGHT_COLOUR = "#CC79A7"


def flat_axes(
    ax: Any, n_axes: int, content: str, n_columns: int = 1, **options: Any
) -> NDArray:
    """Return axes as a flat array, those of a new figure for None, or raise."""
    if ax is None:
        ax = grid(n_axes, n_columns, **options)
    axes = np.atleast_1d(np.asarray(ax, dtype=object)).ravel()
    if len(axes) != n_axes:
        raise ValueError(f"ax must hold {n_axes} axes, {content}; got {len(axes)}")
    return axes


def hide_frame(ax: Any) -> None:
    """Remove ticks and frame, but keep title and labels."""
    ax.set(xticks=[], yticks=[])
    ax.spines[:].set_visible(False)


def is_dense(points: NDArray) -> bool:
    """Return whether there are too many points to draw each with an arrow."""
    return len(points) > 400


def draw_points(ax: Any, points: NDArray, **kw: Any) -> Any:
    """Draw points as a scatter; many of them small, and as pixels in vector files."""
    style: dict[str, Any] = {"s": 6.0, "linewidths": 0}
    if is_dense(points):  # 2,000 square points of area together
        style |= {"s": max(2000 / len(points), 0.15), "rasterized": True}
    return ax.scatter(points[:, 0], points[:, 1], **(style | kw))


def draw_segments(ax: Any, segments: NDArray, **kw: Any) -> Any:
    """Draw segments of shape (n_segments, 2, 2) as one collection of lines."""
    from matplotlib.collections import LineCollection

    style: dict[str, Any] = {"linewidths": 0.8, "capstyle": "round"}
    return ax.add_collection(LineCollection(list(segments), **(style | kw)))


def side_colours(sides: NDArray, middle: str) -> list[str]:
    """Return the colour of each point or edge by its side: 0, 1 left or 2 right."""
    colours = (middle, LEFT_COLOUR, RIGHT_COLOUR)
    return [colours[side] for side in sides]


def percent(fraction: float) -> str:
    """Write a fraction as percent with two digits, three from 100 % on."""
    value = 100.0 * fraction
    if not 0 < value < 99.5:
        return f"{value:.0f} %"
    text = f"{value:.1e}" if value < 1e-3 else f"{value:#.2g}"
    return f"{text.removesuffix('.')} %"


def wrap_title(title: str, axes: NDArray) -> str:
    """Break a title in small print if it is wider than the axes below it."""
    import textwrap

    first, last = axes[0].get_position(), axes[-1].get_position()
    width = (last.x1 - first.x0) * axes[0].figure.get_figwidth()
    letters = max(int(width / 0.06), 8)  # inches of a letter of the default font
    if len(title) <= letters:
        return title
    lines = title.replace(" (", "\n(").splitlines()
    return "\n".join(textwrap.fill(line, letters) for line in lines)


# The two coordinates that the front view and the side view show.
VIEWS = ([0, 1], [2, 1])
# Inches: the width of a page, the heights of a title and of a legend.
PAGE_WIDTH, TITLE_HEIGHT, LEGEND_HEIGHT = 7.2, 0.27, 0.3


def grid(n_axes: int, n_columns: int, **options: Any) -> NDArray[Any]:
    """Return the axes of a new figure with a number of columns."""
    plt = import_optional("matplotlib.pyplot", extra="plot")
    n_rows = -(-n_axes // n_columns)
    options = {"squeeze": False, "layout": "constrained"} | options
    figure, axes = plt.subplots(n_rows, n_columns, **options)
    for unused in axes.ravel()[n_axes:]:
        figure.delaxes(unused)
    return axes.ravel()[:n_axes]


def block_limits(blocks: list[NDArray]) -> tuple[NDArray, NDArray]:
    """Return the limits of space for each block of shapes, and its reduction.

    Blocks are (n_shapes, n_points, 3), the mean shape first. Limits (n_blocks, 3, 2)
    have one scale. Blocks whose extent relative to the first exceeds twice the median
    are drawn smaller, by the factors reduction (n_blocks,).
    """
    low = np.array([block.min(axis=(0, 1)) for block in blocks])
    high = np.array([block.max(axis=(0, 1)) for block in blocks])
    # If all points are equal, keep the limits of the axes apart.
    margin = 0.02 * ((high - low)[0].max() or 1.0)
    low, high = low - margin, high + margin
    extent = high - low
    size = np.max(extent / extent[0], axis=1)
    common = size <= 2 * np.median(size)
    low[common], high[common] = low[common].min(axis=0), high[common].max(axis=0)
    frame = (high - low)[0]
    reduction = np.maximum(np.max((high - low) / frame, axis=1), 1.0)
    centre = (low + high) / 2
    half = frame / 2 * reduction[:, None]
    return np.stack([centre - half, centre + half], axis=-1), reduction


def new_page(n_shapes: int, extent: NDArray, n_columns: int | None) -> NDArray[Any]:
    """Return new axes, two views side by side for each shape of an extent (3,).

    By default the smallest number of columns whose shapes fit a page.
    """
    widths = [float(extent[horizontal]) for horizontal, _ in VIEWS]
    aspect = sum(widths) / extent[1]
    for columns in range(1, n_shapes + 1) if n_columns is None else [n_columns]:
        height, n_rows = PAGE_WIDTH / columns / aspect, -(-n_shapes // columns)
        whole = n_rows * (height + TITLE_HEIGHT) + LEGEND_HEIGHT
        if whole <= 7.6 and height <= 2.8:  # inches
            break
    height = n_rows * (min(height, 2.8) + TITLE_HEIGHT) + LEGEND_HEIGHT
    size, ratios = (PAGE_WIDTH, height), widths * columns
    return grid(2 * n_shapes, 2 * columns, figsize=size, width_ratios=ratios)


def show_view(axis: Any, view: list[int], limits: NDArray, origin: str) -> None:
    """Set the limits (3, 2) of the view of a shape, with y up or down."""
    x, y = limits[view]
    axis.set(xlim=x, ylim=y, aspect=1.0, anchor="N")
    axis.yaxis.set_inverted(origin == "upper")


def add_legend(figure: Any, entries: list[Any], skeleton: Any, **options: Any) -> None:
    """Add a legend below a figure, with sides of a skeleton, or what lines are."""
    from matplotlib.lines import Line2D

    lines: dict[str, str] = {}
    if skeleton is not None and skeleton.left:
        lines = {"left": LEFT_COLOUR, "right": RIGHT_COLOUR}
    elif skeleton is not None and skeleton.name == SPANNING_TREE:
        lines = {f"lines: {SPANNING_TREE}": MEAN_COLOUR}
    drawn = (Line2D([], [], color=c, label=n, linewidth=1.5) for n, c in lines.items())
    entries = [*entries, *drawn]
    style = {"loc": "outside lower center", "frameon": False, "fontsize": "small"}
    figure.legend(handles=entries, ncols=len(entries), **(style | options))


def names_of_shapes(names: Any, n_components: int) -> list[str]:
    """Return the names of basis shapes, by default their numbers from 1."""
    return checked_names("component_names", names, range(1, n_components + 1))


def chosen_numbers(
    values: ArrayLike | None, name: str, most: int, content: str
) -> NDArray[np.intp]:
    """Return a list of numbers from 0 to one below `most`, None for all, or raise."""
    if values is None:
        return np.arange(most)
    numbers = np.asarray(values)
    whole = numbers.ndim == 1 and numbers.size and numbers.dtype.kind in "iu"
    if not whole or np.any((numbers < 0) | (numbers >= most)):
        raise ValueError(
            f"{name} must be a list of {content}, from 0 to {most - 1}; got {values!r}"
        )
    return numbers.astype(np.intp)


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
        axes = polar(reference)[0]
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


def lines_of_model(model: Any, edges: Edges, origin: Origin, shape: NDArray) -> Lines:
    """Return layout, lines and origin of a model with a mean shape (n_points, 3).

    Points without a layout are near each other if they are near in the images.
    """
    points = model.mean_shape_ @ isotropic(np.asarray(model.motion_))
    return choose_lines(edges, origin, shape, names_of_points(model), points)


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
    metric = isotropic(motion) if G is None else _metric.symmetric_power(G, -0.5)
    from_metric = np.linalg.pinv(metric)
    reference, spread = reference_motion @ from_metric, metric @ metric.T
    transform = viewing_rotation(motion @ from_metric, reference, spread) @ metric
    size = np.linalg.norm(motion @ np.linalg.pinv(transform), axis=(1, 2)) / np.sqrt(2)
    return transform * np.median(size[np.isfinite(size) & (size > 0)])


def isotropic(motion: NDArray) -> NDArray:
    """Return the transform (3, 3) of space whose lengths are those in the images."""
    gram = _metric.mean_gram(_metric.unit_cameras(motion))
    return _metric.symmetric_power(gram, 0.5)


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
