"""Tables of landmarks and the tracks in them, in either layout of the columns.

A *table* has one row a frame and two columns a point, shape ``(n_frames,
2 * n_points)``. *Tracks* are the same numbers as ``(n_frames, n_points, 2)``. A point
that is not seen in a frame is NaN.
"""

from typing import Literal

import numpy as np
from numpy.typing import NDArray

from isa_nrsfm._tables.visibility import centred_frames, refuse_one_place

# Columns are x0, y0, x1, y1, ... or x0, x1, ..., y0, y1, ...
Layout = Literal["interleaved", "planar"]
LAYOUTS: tuple[Layout, ...] = ("interleaved", "planar")


def table_to_tracks(X: NDArray, layout: Layout = "interleaved") -> NDArray:
    """Return the tracks (n_frames, n_points, 2) of a table."""
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
    """Return tracks as a table, the inverse of `table_to_tracks`."""
    n_frames, n_points, _ = tracks.shape
    if layout == "planar":
        tracks = tracks.transpose(0, 2, 1)
    return tracks.reshape(n_frames, 2 * n_points)


def centred_tracks(tracks: NDArray) -> tuple[NDArray, NDArray]:
    """Return tracks (I, J, 2) centred over their visible points, and centroids."""
    centred, report = centred_frames(tracks)
    refuse_one_place(report, tracks.shape[1])
    return centred, report.translation


def weighting_sizes(centred: NDArray, scale_frames: bool) -> NDArray:
    """Return the sizes (I,) by which centred tracks (I, J, 2) are divided.

    The RMS of the visible coordinates of each frame, or of all if not `scale_frames`.
    """
    known = ~np.isnan(centred)
    seen = np.where(known, centred, 0.0)
    square = np.einsum("ijc,ijc->i", seen, seen) / known.sum(axis=(1, 2))
    return np.sqrt(square if scale_frames else np.full_like(square, square.mean()))


def measurement_matrix(centred: NDArray) -> NDArray:
    """Return W (2 * n_frames, n_points): for each frame the row of x, then of y."""
    return np.ascontiguousarray(centred.transpose(0, 2, 1)).reshape(
        -1, centred.shape[1]
    )
