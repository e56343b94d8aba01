"""What is drawn of a shape: triangles, edges or points alone."""

from typing import Any, Literal

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.spatial import Delaunay, QhullError

from isa_nrsfm.plotting._edges import checked_links, choose_edges

# Pairs of points, or triangles.
Links = ArrayLike | Literal["auto"] | None


def choose_links(edges: Any, shape: NDArray) -> NDArray[np.intp] | None:
    """
    Return the edges or the triangles to draw as an index array, or None for neither.

    Parameters
    ----------
    edges : "auto", None or array-like of shape (n_edges, 2) or (n_triangles, 3)
        "auto" joins 68 points that look like a face.
    shape : ndarray of shape (n_points, 3)
        The points to be joined, upright.
    """
    if edges is None or isinstance(edges, str):
        return choose_edges(edges, shape)
    return checked_links(edges, len(shape), triangles=True)


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


def edges_of(links: NDArray[np.intp] | None) -> NDArray[np.intp]:
    """Return pairs of points: those given, or the sides of triangles, each once."""
    if links is None:
        return np.empty((0, 2), dtype=np.intp)
    if links.shape[1] == 2:
        return links
    sides = links[:, [[0, 1], [1, 2], [2, 0]]].reshape(-1, 2)
    return np.unique(np.sort(sides, axis=1), axis=0)


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
