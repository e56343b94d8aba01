"""Which points a figure joins, and which way is up in it."""

from typing import Any, Literal

import numpy as np
from numpy.typing import ArrayLike, NDArray

from isa_nrsfm.calibration import canonical_pose
from isa_nrsfm.skeletons import SKELETONS, Skeleton, find_skeleton

# A name of a layout or "auto", the layout itself, or pairs of points.
Edges = ArrayLike | Skeleton | str | None
Origin = Literal["auto", "upper", "lower"]

UPSIDE_DOWN = np.diag([1.0, -1.0, -1.0])


def choose_skeleton(
    edges: Edges, shape: NDArray, names: tuple[str, ...] | None = None
) -> Skeleton | None:
    """Return the lines to draw of a shape (n_points, 2 or 3), None for only points."""
    if edges is None or isinstance(edges, str | Skeleton):
        return None if edges is None else choose_layout(edges, shape, names)
    pairs = checked_links(edges, len(shape)).tolist()
    return Skeleton("edges", "other", len(shape), tuple(map(tuple, pairs)), "the user")


def choose_layout(
    edges: Any, shape: NDArray, names: tuple[str, ...] | None = None
) -> Skeleton | None:
    """Return the layout of points that `edges` is or names, or that is recognised."""
    if isinstance(edges, str) and edges != "auto":
        if edges not in SKELETONS:
            raise ValueError(
                f'edges must be "auto", None, an array of pairs of points, a Skeleton '
                f"or the name of one ({', '.join(SKELETONS)}); got {edges!r}"
            )
        edges = SKELETONS[edges]
    if not isinstance(edges, Skeleton):
        return find_skeleton(len(shape), names, shape=shape)
    if edges.n_points != len(shape):
        raise ValueError(
            f"the skeleton {edges.name!r} has {edges.n_points} points, the shape "
            f"{len(shape)}"
        )
    return edges


def checked_links(
    edges: Any, n_points: int, *, triangles: bool = False
) -> NDArray[np.intp]:
    """Return pairs of points, or triangles if these are allowed, or raise."""
    links = np.asarray(edges)
    widths = (2, 3) if triangles else (2,)
    if links.ndim != 2 or links.shape[1] not in widths or links.dtype.kind not in "iu":
        other = ", or (n_triangles, 3)" * triangles
        raise ValueError(
            "edges must be integers of shape (n_edges, 2), a pair of points per "
            f"edge{other}; got shape {links.shape} and dtype {links.dtype}"
        )
    if links.size and (links.min() < 0 or links.max() >= n_points):
        raise ValueError(
            f"edges must name points 0 to {n_points - 1}; "
            f"got {links.min()} to {links.max()}"
        )
    return links.astype(np.intp)


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
