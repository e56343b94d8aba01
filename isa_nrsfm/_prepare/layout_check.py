"""The layout that a table has, by its numbers: told where it is not the one given."""

import numpy as np
from numpy.typing import NDArray

from isa_nrsfm._compat.caller import warn_caller
from isa_nrsfm._prepare.completion import rigid_noise
from isa_nrsfm._tables.layout import (
    LAYOUTS,
    Layout,
    measurement_matrix,
    table_to_tracks,
    weighting_sizes,
)
from isa_nrsfm._tables.visibility import FEWEST_POINTS, seen_points

# A warning is due when the other layout leaves less than this share of the energy that
# the given one leaves unexplained. On real tables the right one leaves 0.04 to 0.5.
CLEARLY_BETTER = 0.6
# So many frames, evenly spread, are enough to tell the layouts apart, and fewer of many
# points: so many numbers, but not less than so many frames.
LAYOUT_SAMPLE = 1000
LAYOUT_NUMBERS = 2_000_000
FEWEST_SAMPLE = 100
# Smaller tables, in frames or points, do not tell the layouts apart.
FEWEST_TO_TELL = 10
# A share of unexplained energy below this is rounding errors.
ROUNDING = 1e-12


def layout_sample(n_frames: int, n_columns: int) -> slice:
    """Return which frames, evenly spread, tell the layouts apart."""
    enough = max(min(LAYOUT_SAMPLE, LAYOUT_NUMBERS // n_columns), FEWEST_SAMPLE)
    return slice(None, None, max(-(-n_frames // enough), 1))


def warn_if_other_layout(X: NDArray, layout: Layout, scale_frames: bool) -> None:
    """
    Warn where the columns in the other layout are nearer to a rigid object.

    What no rigid object explains of the table is compared, not its share: in the wrong
    layout the distance between the coordinates x and y adds energy that is explained.

    Parameters
    ----------
    X : ndarray of shape (n_frames, 2 * n_points)
        The table, or what `layout_sample` takes of it.
    layout : {"interleaved", "planar"}
        What is said to be the order of its columns.
    scale_frames : bool
        Whether frames count alike.

    Warns
    -----
    UserWarning
        If the other layout explains much more.
    """
    if min(len(X), X.shape[1] // 2) < FEWEST_TO_TELL:
        return
    other = next(name for name in LAYOUTS if name != layout)
    sample = np.ascontiguousarray(X[layout_sample(*X.shape)], dtype=np.float64)
    both = [table_to_tracks(sample, name) for name in (layout, other)]
    both = _without_rarely_seen(both)
    if min(min(tracks.shape[:2]) for tracks in both) < FEWEST_TO_TELL:
        return
    centred = [tracks - np.nanmean(tracks, axis=1, keepdims=True) for tracks in both]
    # The size of a frame is the smaller of the two, that of the right layout.
    sizes = np.min([weighting_sizes(c, scale_frames) for c in centred], axis=0)
    sizes = np.where(sizes > 0, sizes, 1.0)
    given, swapped = (_rigid_residual(c, sizes) for c in centred)
    if given > ROUNDING and swapped < CLEARLY_BETTER * given:
        warn_caller(
            f"layout={other!r} explains the table much better than layout={layout!r}: "
            f"what is not rigid has {swapped / given:.2g} times the energy",
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
