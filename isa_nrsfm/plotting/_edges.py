"""Which points a figure joins: the two common orders of 68 points of a face."""

from dataclasses import dataclass
from itertools import pairwise
from typing import Any, Literal

import numpy as np
from numpy.typing import ArrayLike, NDArray

N_FACE_POINTS = 68
# Mean edge length above which the points are taken for no face, in units of the root
# mean square distance of the points from their centroid. Mean faces in their own order
# have 0.24 to 0.32, in the other order 0.36 to 0.40; 68 random points about 1.3.
LONGEST_MEAN_EDGE = 0.45

Edges = ArrayLike | Literal["auto"] | None
Origin = Literal["auto", "upper", "lower"]


@dataclass(frozen=True)
class FaceOrder:
    """An order of 68 points of a face: what to join, and which way is up."""

    name: str
    curves: tuple[tuple[int, ...], ...]  # indices of the points along each curve
    brows: tuple[int, ...]
    chin: int

    @property
    def edges(self) -> NDArray[np.intp]:
        """Pairs of points that are neighbours on a curve, shape (n_edges, 2)."""
        return np.array([pair for c in self.curves for pair in pairwise(c)])


def _curve(first: int, last: int, *, closed: bool = False) -> tuple[int, ...]:
    """Return the indices first to last, and first again where the curve is closed."""
    return (*range(first, last + 1), *((first,) if closed else ()))


IBUG = FaceOrder(
    name="iBUG",
    curves=(
        _curve(0, 16),  # jaw
        _curve(17, 21),  # brows
        _curve(22, 26),
        _curve(27, 30),  # bridge of the nose
        _curve(31, 35),  # nostrils
        _curve(36, 41, closed=True),  # eyes
        _curve(42, 47, closed=True),
        _curve(48, 59, closed=True),  # outer and inner lips
        _curve(60, 67, closed=True),
    ),
    brows=(*range(17, 27),),
    chin=8,
)

# Points 31 and 36 are the pupils, 46, 47 and 67 nostrils and tip of the nose, 66 the
# middle of the mouth: drawn, not joined.
XM2VTS = FaceOrder(
    name="XM2VTS",
    curves=(
        _curve(0, 14),  # jaw
        _curve(15, 20, closed=True),  # brows
        _curve(21, 26, closed=True),
        _curve(27, 30, closed=True),  # eyes
        _curve(32, 35, closed=True),
        _curve(37, 45),  # nose
        _curve(48, 59, closed=True),  # outer lips
        (48, *_curve(60, 62), 54),  # inner edge of the lower and of the upper lip
        (54, *_curve(63, 65), 48),
    ),
    brows=(*range(15, 27),),
    chin=7,
)

FACE_ORDERS = (IBUG, XM2VTS)


def mean_edge_length(shape: NDArray, edges: NDArray) -> float:
    """Return the mean length of the edges relative to the size of the shape.

    The size is the root mean square distance of the points from their centroid.
    """
    size = np.sqrt(np.mean(np.sum((shape - shape.mean(axis=0)) ** 2, axis=1)))
    ends = shape[edges]
    lengths = np.linalg.norm(ends[:, 0] - ends[:, 1], axis=1)
    return float(lengths.mean() / size) if size > 0 else np.inf


def recognise_face(shape: NDArray) -> FaceOrder | None:
    """Return the order of 68 points whose edges are shorter; None if both are long.

    Parameters
    ----------
    shape : ndarray of shape (n_points, 2) or (n_points, 3)
        Points in a frame with meaningful distances, as the viewing frame.
    """
    if len(shape) != N_FACE_POINTS:
        return None
    lengths = [mean_edge_length(shape, order.edges) for order in FACE_ORDERS]
    best = int(np.argmin(lengths))
    return FACE_ORDERS[best] if lengths[best] <= LONGEST_MEAN_EDGE else None


def choose_edges(edges: Edges, shape: NDArray) -> NDArray[np.intp] | None:
    """Return the edges to draw as an index array, or None for none.

    Parameters
    ----------
    edges : "auto", None or array-like of shape (n_edges, 2)
        "auto" joins 68 points that `recognise_face` takes for a face.
    shape : ndarray of shape (n_points, 2) or (n_points, 3)
        The points to be joined.
    """
    if edges is None:
        return None
    if isinstance(edges, str):
        if edges != "auto":
            raise ValueError(
                f'edges must be "auto", None or an array of pairs of points; '
                f"got {edges!r}"
            )
        face = recognise_face(shape)
        return None if face is None else face.edges
    return checked_links(edges, len(shape))


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


def choose_origin(origin: Origin, shape: NDArray) -> Literal["upper", "lower"]:
    """Return where y is zero: "upper" if it points down in the image, else "lower".

    Parameters
    ----------
    origin : {"auto", "upper", "lower"}
        "auto" is "lower" where 68 points are recognised as a face whose brows have
        larger y than its chin, else "upper".
    shape : ndarray of shape (n_points, 2) or (n_points, 3)
        The points, with the image's x and y in the first two columns.
    """
    if origin == "auto":
        face = recognise_face(shape)
        if face is None:
            return "upper"
        brows = shape[list(face.brows), 1].mean()
        return "lower" if brows > shape[face.chin, 1] else "upper"
    if origin not in ("upper", "lower"):
        raise ValueError(f'origin must be "auto", "upper" or "lower"; got {origin!r}')
    return origin
