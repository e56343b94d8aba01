"""Tables of landmarks and the tracks in them: the one place that knows a layout.

A *table* has one row a frame and two columns a point, shape ``(n_frames,
2 * n_points)``. *Tracks* are the same numbers as ``(n_frames, n_points, 2)``.
"""

import warnings
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from isa_nrsfm._landmark_names import names_layout

Layout = Literal["interleaved", "planar"]
LAYOUTS: tuple[Layout, ...] = ("interleaved", "planar")
# A warning is due when the other layout leaves less than this share of the energy that
# the given one leaves unexplained. On real tables the right one leaves 0.04 to 0.5.
CLEARLY_BETTER = 0.6
# So many frames, evenly spread, are enough to tell the layouts apart.
LAYOUT_SAMPLE = 1000
# Smaller tables, in frames or points, do not tell the layouts apart.
FEWEST_TO_TELL = 10
# A share of unexplained energy below this is rounding errors.
ROUNDING = 1e-12


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
    if n_columns % 2:
        raise ValueError(
            "X must have two columns per point (x and y), an even number; "
            f"got n_features={n_columns}"
        )
    if layout == "planar":
        return X.reshape(n_frames, 2, -1).transpose(0, 2, 1)
    return X.reshape(n_frames, -1, 2)


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
    Return tracks centred over the points of each frame, in double precision.

    Parameters
    ----------
    tracks : ndarray of shape (n_frames, n_points, 2)
        The tracks.

    Returns
    -------
    centred : ndarray of shape (n_frames, n_points, 2)
        Tracks minus centroids.
    translation : ndarray of shape (n_frames, 2)
        The centroids.

    Raises
    ------
    ValueError
        If all points of a frame are equal, up to rounding.
    """
    eps = np.finfo(tracks.dtype).eps
    # The same memory order, so that sums are the same to the last bit.
    tracks = np.ascontiguousarray(tracks, dtype=np.float64)
    translation = np.einsum("ijc->ic", tracks) / tracks.shape[1]
    centred = tracks - translation[:, None]
    square = np.einsum("ijc,ijc->i", centred, centred)
    rounding = 4 * eps * np.linalg.norm(translation, axis=1)
    equal = np.flatnonzero(square <= tracks.shape[1] * rounding**2)
    if len(equal):
        raise ValueError(
            "each frame must have at least two different points; all points are equal "
            f"in {len(equal)} frame(s), the first is row {equal[0]}"
        )
    return centred, translation


def weighting_sizes(centred: NDArray, scale_frames: bool) -> NDArray:
    """
    Return the sizes by which frames are divided before they are compared.

    Parameters
    ----------
    centred : ndarray of shape (n_frames, n_points, 2)
        Centred tracks.
    scale_frames : bool
        Whether each frame counts alike.

    Returns
    -------
    ndarray of shape (n_frames,)
        The root mean square of the 2J coordinates of each frame, or of all.
    """
    square = np.einsum("ijc,ijc->i", centred, centred) / centred[0].size
    return np.sqrt(square if scale_frames else np.full_like(square, square.mean()))


def relative_precision(tracks: NDArray, sizes: NDArray) -> float:
    """
    Return how precisely the numbers of a table say where the points are.

    Parameters
    ----------
    tracks : ndarray of shape (n_frames, n_points, 2)
        The tracks as they came, in single or double precision.
    sizes : ndarray of shape (n_frames,)
        Sizes of the frames.

    Returns
    -------
    float
        Spacing of the largest coordinate of a frame relative to its size, root mean
        square over the frames.
    """
    spacing = np.finfo(tracks.dtype).eps * np.abs(tracks).max(axis=(1, 2))
    return float(np.sqrt(np.mean((spacing.astype(np.float64) / sizes) ** 2)))


def measurement_matrix(centred: NDArray) -> NDArray:
    """Return W (2 * n_frames, n_points): for each frame the row of x, then of y."""
    return np.ascontiguousarray(centred.transpose(0, 2, 1)).reshape(
        -1, centred.shape[1]
    )


def largest_n_components(n_points: int) -> int:
    """Return the largest K with 3K + 3 directions in n_points centred points."""
    return (n_points - 1) // 3 - 1


def smallest_n_frames(n_components: int) -> int:
    """Return the least number of frames that determines the affine factorisation."""
    # Each frame has 2J numbers and K + 8 unknowns; the shapes 3J (K + 1); the gauge
    # has (K + 1)^2 + 8. More points stop helping: 2I >= 3K + 3 and the cameras
    # overdetermine the 3x3 blocks only from here on.
    return -(-8 * (n_components + 2) // 5)


def check_complete(X: NDArray) -> None:
    """Refuse a table with missing values."""
    rows = np.flatnonzero(np.isnan(X).any(axis=1))
    if len(rows):
        raise ValueError(
            "complete rows are needed; points are missing (NaN) in "
            f"{len(rows)} of {len(X)} row(s), the first is row {rows[0]}"
        )


def check_size(n_frames: int, n_points: int, n_components: int) -> None:
    """Refuse a table that is too small for the number of basis shapes."""
    largest = largest_n_components(n_points)
    if n_components > largest:
        possible = (
            f"with {n_points} points the largest possible n_components is {largest}"
            if largest > 0
            else "at least 7 points are needed for n_components=1"
        )
        raise ValueError(
            f"n_components={n_components} needs at least {3 * n_components + 4} "
            f"points, X has {n_points}; {possible}"
        )
    smallest = smallest_n_frames(n_components)
    if n_frames < smallest:
        raise ValueError(
            f"n_components={n_components} needs at least {smallest} frames (rows), "
            f"X has n_samples={n_frames}"
        )


def check_names(names: NDArray | None, layout: Layout) -> None:
    """Refuse column names that say another layout than the one given."""
    said = None if names is None else names_layout(list(names))
    if said not in (None, layout):
        shown = ", ".join(map(str, names[:4]))  # type: ignore[index]
        order = said if said in LAYOUTS else "neither interleaved nor planar"
        raise ValueError(
            f"layout={layout!r} contradicts the column names ({shown}, ...), "
            f"whose order is {order}"
        )


def warn_if_other_layout(X: NDArray, layout: Layout, scale_frames: bool) -> None:
    """
    Warn where the columns in the other layout are nearer to a rigid object.

    What no rigid object explains of the table is compared, not its share: in the wrong
    layout the distance between the coordinates x and y adds energy that is explained.
    """
    if min(len(X), X.shape[1] // 2) < FEWEST_TO_TELL:
        return
    other = next(name for name in LAYOUTS if name != layout)
    sample = np.ascontiguousarray(X[:: -(-len(X) // LAYOUT_SAMPLE)], dtype=np.float64)
    centred = []
    for name in (layout, other):
        tracks = table_to_tracks(sample, name)
        centred.append(tracks - tracks.mean(axis=1, keepdims=True))
    # The size of a frame is the smaller of the two, that of the right layout.
    sizes = np.min([weighting_sizes(c, scale_frames) for c in centred], axis=0)
    sizes = np.where(sizes > 0, sizes, 1.0)[:, None, None]
    given, swapped = (_rigid_residual(measurement_matrix(c / sizes)) for c in centred)
    if given > ROUNDING * sample.size and swapped < CLEARLY_BETTER * given:
        warnings.warn(
            f"layout={other!r} explains the table much better than layout={layout!r}: "
            f"what is not rigid has {swapped / given:.2g} times the energy",
            stacklevel=4,
        )


def _rigid_residual(W: NDArray) -> float:
    """Return the energy that three singular directions leave of W."""
    energy = np.linalg.eigvalsh(W.T @ W if len(W) > W.shape[1] else W @ W.T)
    return max(float(energy[:-3].sum()), 0.0)
