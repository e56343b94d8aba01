"""Tables of landmarks and the tracks in them: the one place that knows a layout.

A *table* has one row a frame and two columns a point, shape ``(n_frames,
2 * n_points)``. *Tracks* are the same numbers as ``(n_frames, n_points, 2)``. A point
that is not seen in a frame is NaN.
"""

import warnings
from typing import Literal

import numpy as np
from numpy.typing import NDArray
from scipy.sparse.csgraph import connected_components

from isa_nrsfm._completion import rigid_noise
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
# Points that a frame must show: each gives two equations, an affine camera has eight
# unknowns. The coefficients need no more, their prior determines what is left.
FEWEST_POINTS = 4
# Coordinates that differ by so many units in the last place of the largest are equal.
EQUAL = 4


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


def seen_points(tracks: NDArray) -> NDArray:
    """
    Tell which points are seen.

    Parameters
    ----------
    tracks : ndarray of shape (n_frames, n_points, 2)
        The tracks.

    Returns
    -------
    ndarray of bool, shape (n_frames, n_points)
        Whether both coordinates are there.
    """
    missing = np.isnan(tracks)
    return ~(missing[..., 0] | missing[..., 1])


def clean_tracks(
    tracks: NDArray, layout: Layout = "interleaved", names: NDArray | None = None
) -> NDArray:
    """
    Return tracks in which the two coordinates of a point are missing together.

    Parameters
    ----------
    tracks : ndarray of shape (n_frames, n_points, 2)
        The tracks, NaN where a coordinate is missing.
    layout : {"interleaved", "planar"}
        Order of the columns of the table.
    names : ndarray of shape (2 * n_points,), optional
        Names of the columns.

    Returns
    -------
    ndarray of shape (n_frames, n_points, 2)
        The tracks themselves, or a copy where points of which one coordinate is
        missing have lost the other, too.

    Warns
    -----
    UserWarning
        If there are such points.
    """
    missing = np.isnan(tracks)
    half = missing[..., 0] != missing[..., 1]
    if not half.any():
        return tracks
    row, point = np.argwhere(half)[0]
    warnings.warn(
        f"{half.sum()} point(s) in {half.any(axis=1).sum()} row(s) have only one of "
        "their two coordinates and count as missing; the first is "
        f"{_describe_point(point, layout, names)} in row {row}",
        stacklevel=4,
    )
    return np.where(half[..., None], tracks.dtype.type(np.nan), tracks)


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
    centred, translation, seen = _centre(tracks)
    coincide = _coincide(centred, translation, seen, tracks.dtype)
    if coincide.any():
        which = "points" if seen[coincide].all() else "seen points"
        raise ValueError(
            f"each frame must have at least two different points; all {which} are "
            f"equal in {coincide.sum()} frame(s), the first is row {coincide.argmax()}"
        )
    if not seen.all():
        centred[~seen] = np.nan
    return centred, translation


def frames_in_one_place(tracks: NDArray) -> NDArray:
    """
    Tell in which frames all seen points are equal.

    Parameters
    ----------
    tracks : ndarray of shape (n_frames, n_points, 2)
        The tracks, NaN where a point is not seen.

    Returns
    -------
    ndarray of bool, shape (n_frames,)
        Whether the root mean square distance of the seen points from their centroid is
        within rounding errors of its coordinates; False for frames without any point.
    """
    return _coincide(*_centre(tracks), tracks.dtype)


def usable_frames(tracks: NDArray) -> NDArray:
    """
    Tell which frames show enough to determine their camera.

    Parameters
    ----------
    tracks : ndarray of shape (n_frames, n_points, 2)
        The tracks, NaN where a point is not seen.

    Returns
    -------
    ndarray of bool, shape (n_frames,)
        Whether a frame shows at least four points that are not all in one place and,
        if some are missing, not all on one line. A complete frame may show its points
        on a line: that is a flat object seen edge on. Where only some points are seen,
        it is rather that they lie on a line of the object, which leaves the camera
        free to turn around it.
    """
    centred, translation, seen = _centre(tracks)
    enough = seen.sum(axis=1) >= FEWEST_POINTS
    coincide = _coincide(centred, translation, seen, tracks.dtype)
    return enough & ~coincide & ~_collinear(centred, translation, seen, tracks.dtype)


def weighting_sizes(centred: NDArray, scale_frames: bool) -> NDArray:
    """
    Return the sizes by which frames are divided before they are compared.

    Parameters
    ----------
    centred : ndarray of shape (n_frames, n_points, 2)
        Centred tracks, NaN where a point is not seen. Each frame shows some.
    scale_frames : bool
        Whether each frame counts alike.

    Returns
    -------
    ndarray of shape (n_frames,)
        The root mean square of the seen coordinates of each frame, or the root of the
        mean of these squares for all.
    """
    seen = seen_points(centred)
    centred = _zero_where_unseen(centred, seen)
    square = np.einsum("ijc,ijc->i", centred, centred) / (2 * seen.sum(axis=1))
    return np.sqrt(square if scale_frames else np.full_like(square, square.mean()))


def relative_precision(tracks: NDArray, sizes: NDArray) -> float:
    """
    Return how precisely the numbers of a table say where the points are.

    Parameters
    ----------
    tracks : ndarray of shape (n_frames, n_points, 2)
        The tracks as they came, in single or double precision, NaN where a point is
        not seen.
    sizes : ndarray of shape (n_frames,)
        Sizes of the frames.

    Returns
    -------
    float
        Spacing of the largest coordinate of a frame relative to its size, root mean
        square over the frames.
    """
    largest = np.abs(_zero_where_unseen(tracks, seen_points(tracks))).max(axis=(1, 2))
    spacing = np.finfo(tracks.dtype).eps * largest
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


def check_frames(tracks: NDArray) -> None:
    """
    Refuse tracks with frames that do not show enough to determine their camera.

    Parameters
    ----------
    tracks : ndarray of shape (n_frames, n_points, 2)
        The tracks, NaN where a point is not seen.

    Raises
    ------
    ValueError
        If a frame shows fewer than four points, or has missing points and shows the
        others on one line (see `usable_frames`). Those with all points in one place
        are left to `centred_tracks`.
    """
    centred, translation, seen = _centre(tracks)
    if seen.all():
        return
    n_seen = seen.sum(axis=1)
    few = n_seen < FEWEST_POINTS
    if few.any():
        row = few.argmax()
        raise ValueError(
            f"each frame must show at least {FEWEST_POINTS} points to determine its "
            f"camera; {few.sum()} of {len(tracks)} frame(s) show fewer (the others are "
            f"NaN), the first is row {row} with {n_seen[row]} point(s): leave such "
            "rows out"
        )
    line = _collinear(centred, translation, seen, tracks.dtype)
    line &= ~_coincide(centred, translation, seen, tracks.dtype)
    if line.any():
        raise ValueError(
            "the points that a frame shows must not all lie on one line where others "
            f"are missing (NaN); they do in {line.sum()} of {len(tracks)} frame(s), "
            f"the first is row {line.argmax()}: leave such rows out"
        )


def check_points(
    tracks: NDArray,
    n_components: int,
    layout: Layout = "interleaved",
    names: NDArray | None = None,
) -> None:
    """
    Refuse tracks whose seen points do not determine the shapes.

    A point has 3 (K + 1) unknowns and two equations in each frame that shows it. A
    frame that shows n points has 2 n equations, of which 8 + K go into its camera and
    its coefficients. These are counts: that they suffice does not mean that the shapes
    are well determined.

    Parameters
    ----------
    tracks : ndarray of shape (n_frames, n_points, 2)
        The tracks, NaN where a point is not seen.
    n_components : int
        K, the number of basis shapes.
    layout : {"interleaved", "planar"}
        Order of the columns of the table.
    names : ndarray of shape (2 * n_points,), optional
        Names of the columns.

    Raises
    ------
    ValueError
        If a point is seen in too few frames, if too few points are seen in all, or if
        the points fall into groups that no frame shows together.
    """
    seen = seen_points(tracks)
    if seen.all():
        return
    n_shapes = n_components + 1
    n_frames, least = seen.sum(axis=0), -(-3 * n_shapes // 2)
    few = n_frames < least
    if few.any():
        point = few.argmax()
        raise ValueError(
            f"n_components={n_components} needs every point in at least {least} "
            f"frames; {few.sum()} of {len(few)} point(s) are seen in fewer, the first "
            f"is {_describe_point(point, layout, names)}, seen in {n_frames[point]}"
        )
    equations = np.maximum(2 * seen.sum(axis=1) - 8 - n_components, 0).sum()
    unknowns = 3 * n_shapes * (len(few) - 1) - n_shapes**2 - 8
    if equations < unknowns:
        raise ValueError(
            f"too few points are seen for n_components={n_components}: beyond cameras "
            f"and coefficients they give {equations} equations, but the shapes have "
            f"{unknowns} unknowns; take fewer basis shapes or leave out points that "
            "are rarely seen"
        )
    counts = seen.astype(np.float64)
    n_groups, group = connected_components(counts.T @ counts, directed=False)
    if n_groups > 1:
        apart = (group != group[0]).argmax()
        raise ValueError(
            f"the points fall into {n_groups} groups, and no frame shows points of "
            f"two of them; {_describe_point(apart, layout, names)} is the first that "
            f"is never seen with {_describe_point(0, layout, names)} or others of its "
            "group"
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
    both = [table_to_tracks(sample, name) for name in (layout, other)]
    both = _without_rarely_seen(both)
    if min(min(tracks.shape[:2]) for tracks in both) < FEWEST_TO_TELL:
        return
    centred = []
    for tracks in both:
        rows, _, seen = _centre(tracks)
        centred.append(np.where(seen[..., None], rows, np.nan))
    # The size of a frame is the smaller of the two, that of the right layout.
    sizes = np.min([weighting_sizes(c, scale_frames) for c in centred], axis=0)
    sizes = np.where(sizes > 0, sizes, 1.0)
    given, swapped = (_rigid_residual(c, sizes) for c in centred)
    if given > ROUNDING and swapped < CLEARLY_BETTER * given:
        warnings.warn(
            f"layout={other!r} explains the table much better than layout={layout!r}: "
            f"what is not rigid has {swapped / given:.2g} times the energy",
            stacklevel=4,
        )


def _without_rarely_seen(both: list[NDArray]) -> list[NDArray]:
    """Return the tracks of two layouts without points, then frames, rarely seen."""
    both = [t[:, seen_points(t).sum(axis=0) >= FEWEST_POINTS] for t in both]
    n_seen = np.min([seen_points(t).sum(axis=1) for t in both], axis=0)
    return [tracks[n_seen >= FEWEST_POINTS] for tracks in both]


def _rigid_residual(centred: NDArray, sizes: NDArray) -> float:
    """Return the mean square that no rigid object explains of tracks over sizes."""
    if not seen_points(centred).all():
        return rigid_noise(centred, sizes)
    W = measurement_matrix(centred / sizes[:, None, None])
    energy = np.linalg.eigvalsh(W.T @ W if len(W) > W.shape[1] else W @ W.T)
    return max(float(energy[:-3].sum()), 0.0) / W.size


def _zero_where_unseen(tracks: NDArray, seen: NDArray) -> NDArray:
    """Return tracks with zeros where points are not seen."""
    if seen.all():
        return tracks
    return np.where(seen[..., None], tracks, tracks.dtype.type(0))


def _centre(tracks: NDArray) -> tuple[NDArray, NDArray, NDArray]:
    """Return centred tracks, zero where not seen, centroids and the mask of seen."""
    # The same memory order, so that sums are the same to the last bit.
    tracks = np.ascontiguousarray(tracks, dtype=np.float64)
    seen = seen_points(tracks)
    n_seen = seen.sum(axis=1)[:, None]
    filled = _zero_where_unseen(tracks, seen)
    translation = np.full((len(tracks), 2), np.nan)
    total = np.einsum("ijc->ic", filled)
    np.divide(total, n_seen, where=n_seen > 0, out=translation)
    return _zero_where_unseen(tracks - translation[:, None], seen), translation, seen


def _coincide(
    centred: NDArray, translation: NDArray, seen: NDArray, dtype: np.dtype
) -> NDArray:
    """Tell in which frames all seen points are equal, up to rounding."""
    n_seen = seen.sum(axis=1)
    square = np.einsum("ijc,ijc->i", centred, centred)
    rounding = EQUAL * np.finfo(dtype).eps * np.linalg.norm(translation, axis=1)
    return (n_seen > 0) & (square <= n_seen * rounding**2)


def _collinear(
    centred: NDArray, translation: NDArray, seen: NDArray, dtype: np.dtype
) -> NDArray:
    """Tell which frames miss points and show the others on a line, up to rounding."""
    on_line = np.asarray(~seen.all(axis=1))
    centred, translation = centred[on_line], translation[on_line]
    n_seen = seen[on_line].sum(axis=1)
    x, y = centred[..., 0], centred[..., 1]
    # The angle of the principal axis; what is left across it is not squared before.
    angle = 0.5 * np.arctan2(2.0 * np.vecdot(x, y), np.vecdot(x, x) - np.vecdot(y, y))
    across = np.cos(angle)[:, None] * y - np.sin(angle)[:, None] * x
    extent = np.linalg.norm(translation, axis=1) + np.abs(centred).max(axis=(1, 2))
    rounding = EQUAL * np.finfo(dtype).eps * extent
    thin = np.vecdot(across, across) <= n_seen * rounding**2
    on_line[on_line] = thin & (n_seen > 0)
    return on_line


def _describe_point(point: int, layout: Layout, names: NDArray | None) -> str:
    """Return the number of a point, with the names of its columns where known."""
    if names is None:
        return f"point {point}"
    x, y = table_to_tracks(np.asarray(names)[None], layout)[0, point]
    return f"point {point} ({x}, {y})"
