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
    """Return what to draw of a shape, or None for points alone.

    Parameters
    ----------
    edges : "auto", str, Skeleton, None or array-like of shape (n_edges, 2)
        "auto" is the layout that `find_skeleton` recognises; other texts are names of
        layouts. Pairs of points become a skeleton of their own.
    shape : ndarray of shape (n_points, 2) or (n_points, 3)
        The points to be joined, in a frame with meaningful distances.
    names : tuple of str, default=None
        Names of the points.
    """
    if edges is None:
        return None
    if isinstance(edges, str):
        if edges == "auto":
            return find_skeleton(len(shape), names, shape=shape)
        if edges not in SKELETONS:
            raise ValueError(
                f'edges must be "auto", None, an array of pairs of points, a Skeleton '
                f"or the name of one ({', '.join(SKELETONS)}); got {edges!r}"
            )
        edges = SKELETONS[edges]
    if isinstance(edges, Skeleton):
        if edges.n_points != len(shape):
            raise ValueError(
                f"the skeleton {edges.name!r} has {edges.n_points} points, the shape "
                f"{len(shape)}"
            )
        return edges
    pairs = checked_links(edges, len(shape)).tolist()
    return Skeleton("edges", "other", len(shape), tuple(map(tuple, pairs)), "the user")


def choose_layout(
    edges: Any, shape: NDArray, names: tuple[str, ...] | None
) -> Skeleton | None:
    """Return the layout of the points of a shape, whatever is drawn of it.

    Parameters
    ----------
    edges : "auto", str, Skeleton, None or array-like
        A layout or its name; everything else is recognised.
    shape : ndarray of shape (n_points, 3)
        The points, in a frame with meaningful distances.
    names : tuple of str or None
        Names of the points.
    """
    told = isinstance(edges, str | Skeleton)
    return choose_skeleton(edges if told else "auto", shape, names)


def checked_links(
    edges: Any, n_points: int, *, triangles: bool = False
) -> NDArray[np.intp]:
    """Return pairs of points, or triangles where these may be, or raise."""
    links = np.asarray(edges)
    widths = (2, 3) if triangles else (2,)
    if links.ndim != 2 or links.shape[1] not in widths or links.dtype.kind not in "iu":
        other = ", or (n_triangles, 3)" if triangles else ""
        raise ValueError(
            "edges must be integers of shape (n_edges, 2), a pair of points an "
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
    """Return where y is zero: "upper" if it points down in the image, else "lower".

    Parameters
    ----------
    origin : {"auto", "upper", "lower"}
        "auto" is "lower" where a face or a body would stand on its head otherwise.
        Hands are held in any direction and do not tell.
    shape : ndarray of shape (n_points, 2) or (n_points, 3)
        The points, with the image's x and y in the first two columns.
    layout : Skeleton or None
        The layout of the points.
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
    """Return the orthogonal matrix that makes a shape stand upright and face us.

    Parameters
    ----------
    shape : ndarray of shape (n_points, 3)
        The shape as the mean camera sees it: x points right, y along the image's y.
    layout : Skeleton or None
        The layout of its points. Without one that tells what is up, the shape stays.
    origin : {"upper", "lower"}
        Where y is zero. The y of the turned shape has the same direction.
    """
    if layout is None or not layout.up:
        return np.eye(3)
    over = UPSIDE_DOWN if origin == "lower" else np.eye(3)
    return over @ canonical_pose(shape @ over, scheme=layout).rotation @ over
