"""The parts of a shape that are drawn: triangles, edges or only points."""

from typing import Any, NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.spatial import Delaunay, QhullError

from isa_nrsfm.skeletons import Skeleton
from isa_nrsfm.skeletons._recognition import checked_links
from isa_nrsfm.skeletons._skeleton import LEFT, MIDDLE, RIGHT, sides_of_edges

# "auto" or the name of a layout, the layout, pairs of points, or triangles.
Links = ArrayLike | Skeleton | str | None


class Drawing(NamedTuple):
    """Pairs of points or triangles to draw, and the side (n_points,) of each point."""

    links: NDArray[np.intp]
    sides: NDArray[np.intp]

    @property
    def edges(self) -> NDArray[np.intp]:
        """Return pairs of points: those given, or the sides of triangles, once."""
        if self.links.shape[1] == 2:
            return self.links
        sides = self.links[:, [[0, 1], [1, 2], [2, 0]]].reshape(-1, 2)
        return np.unique(np.sort(sides, axis=1), axis=0)

    @property
    def edges_of_sides(self) -> list[NDArray[np.intp]]:
        """Return the pairs of points in the middle, on the left and on the right."""
        edges = self.edges
        of_edges = sides_of_edges(self.sides, edges)
        return [edges[of_edges == side] for side in (MIDDLE, LEFT, RIGHT)]


def choose_drawing(edges: Any, layout: Skeleton | None, n_points: int) -> Drawing:
    """Return the lines or triangles of `edges`, otherwise those of the layout."""
    links = np.empty((0, 2), dtype=np.intp)
    sides = np.zeros(n_points, dtype=np.intp)
    if edges is None:
        return Drawing(links, sides)
    if not isinstance(edges, str | Skeleton):
        links = checked_links("edges", edges, n_points, triangles=True)
    elif layout is not None:
        links = layout.edges
    return Drawing(links, sides if layout is None else layout.sides)


def frontal_triangles(shape: NDArray) -> NDArray[np.intp]:
    """Return the Delaunay triangles (n, 3) of the front view of a shape (n_points, 3).

    Counter-clockwise for the viewer: x points right, y up and z to the viewer.
    """
    try:
        corners = Delaunay(shape[:, :2]).simplices.astype(np.intp)
    except QhullError as error:
        raise ValueError(
            "the points are on one line in the front view and have no triangles there; "
            "set edges, or edges=None to draw only points"
        ) from error
    a, b, c = shape[corners, :2].transpose(1, 0, 2)
    area = np.linalg.det(np.stack([b - a, c - a], axis=1))
    corners[area < 0] = corners[area < 0][:, ::-1]
    return corners


def vertex_normals(shape: NDArray, triangles: NDArray[np.intp]) -> NDArray:
    """Return unit normals (n_points, 3) of the points of a mesh, weighted with areas.

    Points without triangles have normals towards the viewer, (0, 0, 1).
    """
    a, b, c = shape[triangles].transpose(1, 0, 2)
    faces = np.cross(b - a, c - a)
    normals = np.zeros_like(shape)
    for corner in triangles.T:
        np.add.at(normals, corner, faces)
    sizes = np.linalg.norm(normals, axis=1)
    alone = sizes <= np.finfo(float).tiny
    normals[alone], sizes[alone] = [0.0, 0.0, 1.0], 1.0
    return normals / sizes[:, None]
