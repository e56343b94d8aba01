"""Lines between points and the upward direction of a figure."""

from typing import Any, Literal

import numpy as np
from numpy.typing import ArrayLike, NDArray

from isa_nrsfm.calibration import canonical_pose
from isa_nrsfm.skeletons import Skeleton, find_skeleton
from isa_nrsfm.skeletons._recognition import checked_links, checked_skeleton

# A name of a layout or "auto", the layout itself, or pairs of points.
Edges = ArrayLike | Skeleton | str | None
Origin = Literal["auto", "upper", "lower"]

UPSIDE_DOWN = np.diag([1.0, -1.0, -1.0])


def choose_lines(
    edges: Edges, origin: Origin, shape: NDArray, names: tuple[str, ...] | None = None
) -> tuple[Skeleton | None, Skeleton | None, Literal["upper", "lower"]]:
    """Return layout, lines to draw and origin of a shape (n_points, 2 or 3).

    Without lines only the points are drawn.
    """
    layout = choose_layout(edges, shape, names)
    lines = None if edges is None else layout
    if edges is not None and not isinstance(edges, str | Skeleton):
        pairs = checked_links("edges", edges, len(shape)).tolist()
        curves = tuple(map(tuple, pairs))
        lines = Skeleton("edges", "other", len(shape), curves, "the user")
    return layout, lines, choose_origin(origin, shape, layout)


def choose_layout(
    edges: Any, shape: NDArray, names: tuple[str, ...] | None = None
) -> Skeleton | None:
    """Return the layout of points given by `edges`, or the recognised one."""
    if isinstance(edges, Skeleton) or (isinstance(edges, str) and edges != "auto"):
        return checked_skeleton(edges, len(shape))
    return find_skeleton(len(shape), names, shape=shape)


def choose_origin(
    origin: Origin, shape: NDArray, layout: Skeleton | None
) -> Literal["upper", "lower"]:
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


def upright_turn(
    shape: NDArray, layout: Skeleton | None, origin: Literal["upper", "lower"]
) -> NDArray:
    """Return the orthogonal matrix that makes a shape (n_points, 3) stand upright.

    The y of the turned shape has the same direction. A shape without a layout stays.
    """
    if layout is None or not layout.up:
        return np.eye(3)
    over = UPSIDE_DOWN if origin == "lower" else np.eye(3)
    return over @ canonical_pose(shape @ over, scheme=layout).rotation @ over
