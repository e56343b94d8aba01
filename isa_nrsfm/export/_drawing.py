"""What is drawn of a shape: triangles, edges or points alone."""

from typing import Any, NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.spatial import Delaunay, QhullError

from isa_nrsfm.plotting._edges import checked_links
from isa_nrsfm.skeletons import Skeleton
from isa_nrsfm.skeletons._skeleton import LEFT, MIDDLE, RIGHT, sides_of_edges

# "auto" or the name of a layout, the layout, pairs of points, or triangles.
Links = ArrayLike | Skeleton | str | None


class Drawing(NamedTuple):
    """
    What is drawn of a shape, and on which side.

    Attributes
    ----------
    links : ndarray of shape (n_edges, 2) or (n_triangles, 3)
        Pairs of points, or triangles; none where points are drawn alone.
    sides : ndarray of shape (n_points,)
        The side of each point, 0 in the middle, 1 left, 2 right.
    """

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
    """
    Return what to draw of a shape.

    Parameters
    ----------
    edges : "auto", str, Skeleton, None or array-like
        Pairs of points (n_edges, 2) or triangles (n_triangles, 3); None for points
        alone; for everything else what the layout joins.
    layout : Skeleton or None
        The layout of the points, where it is known.
    n_points : int
        Number of points.
    """
    links = np.empty((0, 2), dtype=np.intp)
    sides = np.zeros(n_points, dtype=np.intp)
    if edges is None:
        return Drawing(links, sides)
    if not isinstance(edges, str | Skeleton):
        links = checked_links(edges, n_points, triangles=True)
    elif layout is not None:
        links = layout.edges
    return Drawing(links, sides if layout is None else layout.sides)


def frontal_triangles(shape: NDArray) -> NDArray[np.intp]:
    """
    Return the Delaunay triangles of the front view of a shape.

    Parameters
    ----------
    shape : ndarray of shape (n_points, 3)
        A shape whose x points right, y up and z to the viewer.

    Returns
    -------
    ndarray of shape (n_triangles, 3)
        Triangles, counter-clockwise for the viewer.

    Raises
    ------
    ValueError
        If the points are on one line in the front view.
    """
    try:
        corners = Delaunay(shape[:, :2]).simplices.astype(np.intp)
    except QhullError as error:
        raise ValueError(
            "the points are on one line in the front view and have no triangles there; "
            "say by edges what to draw, or None for points alone"
        ) from error
    a, b, c = shape[corners, :2].transpose(1, 0, 2)
    area = np.linalg.det(np.stack([b - a, c - a], axis=1))
    corners[area < 0] = corners[area < 0][:, ::-1]
    return corners


def vertex_normals(shape: NDArray, triangles: NDArray[np.intp]) -> NDArray:
    """
    Return unit normals of the points of a mesh.

    Parameters
    ----------
    shape : ndarray of shape (n_points, 3)
        The points.
    triangles : ndarray of shape (n_triangles, 3)
        Triangles, counter-clockwise as seen from outside.

    Returns
    -------
    ndarray of shape (n_points, 3)
        Normals of the triangles round a point, weighted with their areas; towards the
        viewer, (0, 0, 1), for points without any.
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
