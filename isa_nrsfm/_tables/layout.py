"""Tables of landmarks and the tracks in them: the one place that knows a layout.

A *table* has one row a frame and two columns a point, shape ``(n_frames,
2 * n_points)``. *Tracks* are the same numbers as ``(n_frames, n_points, 2)``. A point
that is not seen in a frame is NaN.
"""

from typing import Literal

import numpy as np
from numpy.typing import NDArray

from isa_nrsfm._tables.visibility import (
    CentredFrames,
    refuse_one_place,
    seen_points,
    zero_where_unseen,
)

Layout = Literal["interleaved", "planar"]
LAYOUTS: tuple[Layout, ...] = ("interleaved", "planar")


def table_to_tracks(X: NDArray, layout: Layout = "interleaved") -> NDArray:
    """
    Return the points of a table, one (x, y) pair a point.

    Parameters
    ----------
    X : ndarray of shape (n_frames, 2 * n_points)
        The table.
    layout : {"interleaved", "planar"}
        Columns are x0, y0, x1, y1, ... or x0, x1, ..., y0, y1, ...

    Returns
    -------
    ndarray of shape (n_frames, n_points, 2)
        The tracks.
    """
    n_frames, n_columns = X.shape
    refuse_odd(n_columns)
    if layout == "planar":
        return X.reshape(n_frames, 2, -1).transpose(0, 2, 1)
    return X.reshape(n_frames, -1, 2)


def refuse_odd(n_columns: int) -> None:
    """Refuse a number of columns that is odd."""
    if n_columns % 2:
        raise ValueError(
            "X must have two columns per point (x and y), an even number; "
            f"got n_features={n_columns}"
        )


def tracks_to_table(tracks: NDArray, layout: Layout = "interleaved") -> NDArray:
    """
    Return tracks as a table, the inverse of `table_to_tracks`.

    Parameters
    ----------
    tracks : ndarray of shape (n_frames, n_points, 2)
        The tracks.
    layout : {"interleaved", "planar"}
        Order of the columns.

    Returns
    -------
    ndarray of shape (n_frames, 2 * n_points)
        The table.
    """
    if layout == "planar":
        tracks = tracks.transpose(0, 2, 1)
    return tracks.reshape(len(tracks), -1)


def centred_tracks(tracks: NDArray) -> tuple[NDArray, NDArray]:
    """
    Return tracks centred over the seen points of each frame, in double precision.

    Parameters
    ----------
    tracks : ndarray of shape (n_frames, n_points, 2)
        The tracks, NaN where a point is not seen.

    Returns
    -------
    centred : ndarray of shape (n_frames, n_points, 2)
        Tracks minus centroids, NaN where a point is not seen.
    translation : ndarray of shape (n_frames, 2)
        The centroids of the seen points, NaN for frames without any.

    Raises
    ------
    ValueError
        If all seen points of a frame are equal, up to rounding.
    """
    frames = CentredFrames.of_tracks(tracks)
    refuse_one_place(frames.in_one_place(), frames.n_seen < tracks.shape[1])
    return frames.marked(), frames.translation


def weighting_sizes(centred: NDArray, scale_frames: bool) -> NDArray:
    """
    Return the sizes by which frames are divided before they are compared.

    Parameters
    ----------
    centred : ndarray of shape (n_frames, n_points, 2)
        Centred tracks, NaN where a point is not seen. Each frame shows some.
    scale_frames : bool
        True for a size of its own for each frame, False for one size for all.

    Returns
    -------
    ndarray of shape (n_frames,)
        The root mean square of the seen coordinates of each frame. With one size for
        all it is the root of the mean of these mean squares.
    """
    seen = seen_points(centred)
    centred = zero_where_unseen(centred, seen)
    square = np.einsum("ijc,ijc->i", centred, centred) / (2 * seen.sum(axis=1))
    return np.sqrt(square if scale_frames else np.full_like(square, square.mean()))


def relative_precision(largest: NDArray, dtype: np.dtype, sizes: NDArray) -> float:
    """
    Return the rounding error of the coordinates of a table, relative to its frames.

    Parameters
    ----------
    largest : ndarray of shape (n_frames,)
        Largest magnitude of a coordinate that counts.
    dtype : dtype
        Type of the numbers of the table.
    sizes : ndarray of shape (n_frames,)
        Sizes of the frames.

    Returns
    -------
    float
        Spacing of floating-point numbers at the largest coordinate of a frame, divided
        by the size of the frame: the root mean square over the frames.
    """
    spacing = np.finfo(dtype).eps * largest.astype(np.float64)
    return float(np.sqrt(np.mean((spacing / sizes) ** 2)))


def measurement_matrix(centred: NDArray) -> NDArray:
    """Return W (2 * n_frames, n_points): for each frame the row of x, then of y."""
    return np.ascontiguousarray(centred.transpose(0, 2, 1)).reshape(
        -1, centred.shape[1]
    )
