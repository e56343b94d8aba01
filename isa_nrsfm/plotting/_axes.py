"""Axes, colours and marks that the figures have in common."""

from typing import Any

import numpy as np
from numpy.typing import NDArray

# Vermilion, blue and black of the palette of Okabe and Ito, which people with any kind
# of colour vision can distinguish; grey for comparison.
PLUS_COLOUR = "#D55E00"
MINUS_COLOUR = "#0072B2"
OBSERVED_COLOUR = "black"
MEAN_COLOUR = "0.55"
# Bluish green and reddish purple of the same palette, for the sides of a body.
LEFT_COLOUR = "#009E73"
RIGHT_COLOUR = "#CC79A7"


def check_axes(ax: Any, n_axes: int, content: str) -> NDArray:
    """Return the given axes as a flat array of the wanted length, or raise."""
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
    if 0 < value < 1e-3:
        return f"{value:.1e} %"
    if 0 < value < 100:
        value = float(f"{value:.1e}")  # round first: 9.96 becomes 10
    exponent = int(np.floor(np.log10(value))) if value > 0 else 1
    return f"{value:.{max(1 - exponent, 0)}f} %"


def wrap_title(title: str, axes: NDArray) -> str:
    """Break a title in small print if it is wider than the axes below it."""
    import textwrap

    from matplotlib.font_manager import FontProperties

    size = FontProperties(size="small").get_size_in_points() / 72  # inches
    # Letters of the default font are 0.5 to 0.6 times as wide as it is high.
    letters = max(int(row_width(axes) / (0.6 * size)), 8)
    if len(title) <= letters:
        return title
    lines = title.replace(" (", "\n(").splitlines()
    return "\n".join(textwrap.fill(line, letters) for line in lines)


def row_width(axes: NDArray) -> float:
    """Return the width in inches from the first of the axes to the last one."""
    first, last = axes[0], axes[-1]
    figure = first.figure
    specs = [ax.get_subplotspec() for ax in (first, last)]
    if figure.get_layout_engine() is None or None in specs:
        left, right = first.get_position().x0, last.get_position().x1
        share = right - left
    else:  # not laid out yet: use the ratios of the columns
        grid = specs[0].get_gridspec()
        ratios = np.asarray(grid.get_width_ratios(), dtype=float)
        columns = slice(specs[0].colspan.start, specs[-1].colspan.stop)
        share = 0.97 * ratios[columns].sum() / ratios.sum()
    # If the axes are not side by side, use the width of the first one.
    if share <= 0:
        share = first.get_position().width
    return share * figure.bbox.width / figure.dpi
