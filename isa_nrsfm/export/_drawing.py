"""Choice of the drawn parts of a shape: triangles, edges or only points."""

from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.spatial import Delaunay, QhullError

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
