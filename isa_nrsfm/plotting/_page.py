"""The pages of figures: grids of axes, and shapes in two views."""

from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from isa_nrsfm._compat.optional import import_optional
from isa_nrsfm.plotting._axes import LEFT_COLOUR, RIGHT_COLOUR

# The two coordinates that the front view and the side view show.
VIEWS = ([0, 1], [2, 1])
# Inches: the width of a page, the heights of a title and of a legend.
PAGE_WIDTH, TITLE_HEIGHT, LEGEND_HEIGHT = 7.2, 0.27, 0.3


def grid(n_axes: int, n_columns: int, **options: Any) -> NDArray[Any]:
    """Return the axes of a new figure with a number of columns."""
    plt = import_optional("matplotlib.pyplot", extra="plot")
    n_rows = -(-n_axes // n_columns)
    figure, axes = plt.subplots(
        n_rows, n_columns, squeeze=False, layout="constrained", **options
    )
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


def choose_n_columns(n_shapes: int, aspect: float) -> int:
    """Return the smallest number of columns of shapes of an aspect that fits a page."""
    for n_columns in range(1, n_shapes):
        height = PAGE_WIDTH / n_columns / aspect
        n_rows = -(-n_shapes // n_columns)
        whole = n_rows * (height + TITLE_HEIGHT) + LEGEND_HEIGHT
        if whole <= 7.6 and height <= 2.8:  # inches
            return n_columns
    return n_shapes


def new_page(n_shapes: int, extent: NDArray, n_columns: int | None) -> NDArray[Any]:
    """Return new axes, two views side by side for each shape of an extent (3,)."""
    widths = [float(extent[horizontal]) for horizontal, _ in VIEWS]
    aspect = sum(widths) / extent[1]
    if n_columns is None:
        n_columns = choose_n_columns(n_shapes, aspect)
    height = min(PAGE_WIDTH / n_columns / aspect, 2.8) + TITLE_HEIGHT
    n_rows = -(-n_shapes // n_columns)
    return grid(
        2 * n_shapes,
        2 * n_columns,
        figsize=(PAGE_WIDTH, n_rows * height + LEGEND_HEIGHT),
        width_ratios=widths * n_columns,
    )


def show_view(axis: Any, view: list[int], limits: NDArray, origin: str) -> None:
    """Set the limits (3, 2) of the view of a shape, with y up or down."""
    x, y = limits[view]
    axis.set(xlim=x, ylim=y, aspect=1.0, anchor="N")
    axis.yaxis.set_inverted(origin == "upper")


def add_legend(figure: Any, entries: list[Any], skeleton: Any, **options: Any) -> None:
    """Add a legend below a figure, with the sides of a skeleton if it has any."""
    from matplotlib.lines import Line2D

    if skeleton is not None and skeleton.left:
        sides = (("left", LEFT_COLOUR), ("right", RIGHT_COLOUR))
        entries = entries + [
            Line2D([], [], color=colour, label=side, linewidth=1.5)
            for side, colour in sides
        ]
    style = {"loc": "outside lower center", "frameon": False, "fontsize": "small"}
    figure.legend(handles=entries, ncols=len(entries), **(style | options))


def chosen_numbers(
    values: ArrayLike, name: str, most: int, content: str
) -> NDArray[np.intp]:
    """Return a list of numbers from 0 to one below `most`, or raise."""
    numbers = np.asarray(values)
    if (
        numbers.ndim != 1
        or not numbers.size
        or numbers.dtype.kind not in "iu"
        or np.any((numbers < 0) | (numbers >= most))
    ):
        raise ValueError(
            f"{name} must be a list of {content}, from 0 to {most - 1}; got {values!r}"
        )
    return numbers.astype(np.intp)
