"""Choice of the drawn parts of a shape: triangles, edges or only points."""

from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from isa_nrsfm.skeletons import Skeleton
from isa_nrsfm.skeletons._recognition import checked_links

# "auto" or the name of a layout, the layout, pairs of points, or triangles.
Links = ArrayLike | Skeleton | str | None


def choose_drawing(
    edges: Any, layout: Skeleton | None, n_points: int
) -> tuple[NDArray[np.intp], NDArray[np.intp]]:
    """Return pairs of points or triangles to draw, and the side (n_points,) of points.

    `edges` takes precedence over the layout.
    """
    links, sides = np.empty((0, 2), np.intp), np.zeros(n_points, dtype=np.intp)
    if edges is not None and layout is not None:
        links, sides = layout.edges, layout.sides
    if edges is not None and not isinstance(edges, str | Skeleton):
        links = checked_links("edges", edges, n_points, triangles=True)
    return links, sides


def edges_of(links: NDArray[np.intp]) -> NDArray[np.intp]:
    """Return pairs of points as they are, and the sides of triangles, once."""
    if links.shape[1] == 2:
        return links
    sides = links[:, [[0, 1], [1, 2], [2, 0]]].reshape(-1, 2)
    return np.unique(np.sort(sides, axis=1), axis=0)
