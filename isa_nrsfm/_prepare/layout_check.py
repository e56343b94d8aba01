"""Compare the given layout of a table with the other one, by the numbers in it."""

import numpy as np
from numpy.typing import NDArray

from isa_nrsfm._compat.caller import warn_caller
from isa_nrsfm._linalg.rounding import OF_DIFFERENCES
from isa_nrsfm._prepare.completion import rigid_noise
from isa_nrsfm._prepare.options import LAYOUT_OPTIONS, LayoutOptions
from isa_nrsfm._tables.layout import (
    LAYOUTS,
    Layout,
    measurement_matrix,
    table_to_tracks,
    weighting_sizes,
)
from isa_nrsfm._tables.visibility import FEWEST_POINTS, CentredFrames, seen_points


def layout_sample(
    n_frames: int, n_columns: int, options: LayoutOptions = LAYOUT_OPTIONS
) -> slice:
    """Return evenly spread frames on which the layouts are compared."""
    enough = min(options.frames, options.numbers // n_columns)
    enough = max(enough, options.fewest_frames)
    return slice(None, None, max(-(-n_frames // enough), 1))


def warn_if_other_layout(
    X: NDArray,
    layout: Layout,
    scale_frames: bool,
    options: LayoutOptions = LAYOUT_OPTIONS,
) -> None:
    """
    Warn where a rigid object fits the other layout much better.

    The mean squares that a rigid fit leaves are compared, not their shares of the
    total. The wrong layout mixes x and y, whose offset adds energy that a rigid object
    explains.

    Parameters
    ----------
    X : ndarray of shape (n_frames, 2 * n_points)
        The table, or what `layout_sample` takes of it.
    layout : {"interleaved", "planar"}
        What is said to be the order of its columns.
    scale_frames : bool
        Whether each frame is divided by its own size, or all by a common one.
    options : LayoutOptions
        When the layout looks wrong.

    Warns
    -----
    UserWarning
        If the other layout explains much more.
    """
    if min(len(X), X.shape[1] // 2) < options.fewest_to_tell:
        return
    other = next(name for name in LAYOUTS if name != layout)
    sample = np.ascontiguousarray(
        X[layout_sample(len(X), X.shape[1], options)], dtype=np.float64
    )
    both = [table_to_tracks(sample, name) for name in (layout, other)]
    both = _without_rarely_seen(both)
    if min(min(tracks.shape[:2]) for tracks in both) < options.fewest_to_tell:
        return
    centred = [CentredFrames.of_tracks(tracks).marked() for tracks in both]
    # The size of a frame is the smaller of the two, that of the right layout.
    sizes = np.min([weighting_sizes(c, scale_frames) for c in centred], axis=0)
    sizes = np.where(sizes > 0, sizes, 1.0)
    given, swapped = (_rigid_residual(c, sizes) for c in centred)
    if given > OF_DIFFERENCES and swapped < options.clearly_better * given:
        warn_caller(
            f"layout={other!r} explains the table much better than layout={layout!r}: "
            f"what is not rigid has {swapped / given:.2g} times the energy",
        )


def _without_rarely_seen(both: list[NDArray]) -> list[NDArray]:
    """Return tracks (I, J, 2) of two layouts without sparse points and frames.

    Points that few frames show are left out first, then frames that show few points in
    one of the layouts.
    """
    both = [t[:, seen_points(t).sum(axis=0) >= FEWEST_POINTS] for t in both]
    n_seen = np.min([seen_points(t).sum(axis=1) for t in both], axis=0)
    return [tracks[n_seen >= FEWEST_POINTS] for tracks in both]


def _rigid_residual(centred: NDArray, sizes: NDArray) -> float:
    """Return the mean square residual of a rigid fit of tracks (I, J, 2) over sizes."""
    if not seen_points(centred).all():
        return rigid_noise(centred, sizes)
    W = measurement_matrix(centred / sizes[:, None, None])
    energy = np.linalg.eigvalsh(W.T @ W if len(W) > W.shape[1] else W @ W.T)
    return max(float(energy[:-3].sum()), 0.0) / W.size
