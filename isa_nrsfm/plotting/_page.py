"""How shapes in two views are laid out on a page."""

from typing import Any

import numpy as np
from numpy.typing import NDArray

from isa_nrsfm._compat.optional import import_optional

# The two coordinates that the front view and the side view show.
VIEWS = ([0, 1], [2, 1])
MARGIN = 0.02  # around the shapes, relative to the largest extent of the mean shape
# A shape that is more than so many times as large as is usual is drawn smaller.
MOST_DRIFT = 2.0

# Inches: the width of a page, the most that the figure and a shape should be high.
PAGE_WIDTH, MOST_HEIGHT, MOST_SHAPE_HEIGHT = 7.2, 7.6, 2.8
TITLE_HEIGHT, LEGEND_HEIGHT = 0.27, 0.3


def block_limits(blocks: list[NDArray]) -> tuple[NDArray, NDArray]:
    """
    Return what part of space to draw each block of shapes in, and how much smaller.

    All blocks are drawn to one scale, except those whose extent, relative to that of
    the first one, is more than twice the median.

    Parameters
    ----------
    blocks : list of n_blocks ndarrays of shape (n_shapes, n_points, 3)
        The shapes that are drawn over each other; the mean shape alone comes first.

    Returns
    -------
    limits : ndarray of shape (n_blocks, 3, 2)
        The least and the largest x, y and z of each block. Their extents have the same
        proportions in all blocks.
    reduction : ndarray of shape (n_blocks,)
        How many times smaller than the others a block is drawn, at least 1.
    """
    low = np.array([block.min(axis=(0, 1)) for block in blocks])
    high = np.array([block.max(axis=(0, 1)) for block in blocks])
    # All points may be equal: axes must not have limits that coincide.
    margin = MARGIN * ((high - low)[0].max() or 1.0)
    low, high = low - margin, high + margin
    extent = high - low
    size = np.max(extent / extent[0], axis=1)
    common = size <= MOST_DRIFT * np.median(size)
    low[common], high[common] = low[common].min(axis=0), high[common].max(axis=0)
    frame = (high - low)[0]
    reduction = np.maximum(np.max((high - low) / frame, axis=1), 1.0)
    centre = (low + high) / 2
    half = frame / 2 * reduction[:, None]
    return np.stack([centre - half, centre + half], axis=-1), reduction


def choose_n_columns(n_shapes: int, aspect: float) -> int:
    """Return the fewest columns of shapes, of that width over height, to fit a page."""
    for n_columns in range(1, n_shapes):
        height = PAGE_WIDTH / n_columns / aspect
        n_rows = -(-n_shapes // n_columns)
        fits = n_rows * (height + TITLE_HEIGHT) + LEGEND_HEIGHT <= MOST_HEIGHT
        if fits and height <= MOST_SHAPE_HEIGHT:
            return n_columns
    return n_shapes


def new_page(n_shapes: int, extent: NDArray, n_columns: int | None) -> NDArray[Any]:
    """Return the axes of a new figure, two views side by side for each shape.

    Parameters
    ----------
    n_shapes : int
        How many shapes are drawn.
    extent : ndarray of shape (3,)
        The extents of x, y and z, in the same proportions for all shapes.
    n_columns : int or None
        How many shapes to draw side by side, None for as few as fit on a page.
    """
    plt = import_optional("matplotlib.pyplot", extra="plot")
    widths = [float(extent[horizontal]) for horizontal, _ in VIEWS]
    aspect = sum(widths) / extent[1]
    if n_columns is None:
        n_columns = choose_n_columns(n_shapes, aspect)
    n_rows = -(-n_shapes // n_columns)
    height = min(PAGE_WIDTH / n_columns / aspect, MOST_SHAPE_HEIGHT) + TITLE_HEIGHT
    figure, axes = plt.subplots(
        n_rows,
        2 * n_columns,
        squeeze=False,
        figsize=(PAGE_WIDTH, n_rows * height + LEGEND_HEIGHT),
        width_ratios=widths * n_columns,
        layout="constrained",
    )
    axes = axes.ravel()
    for unused in axes[2 * n_shapes :]:
        figure.delaxes(unused)
    return axes[: 2 * n_shapes]
