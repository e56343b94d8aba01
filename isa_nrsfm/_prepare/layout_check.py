"""Compare the given layout of a table with the other one, by the numbers in it."""

import numpy as np
from numpy.typing import NDArray

from isa_nrsfm._compat.caller import warn_caller
from isa_nrsfm._linalg.rounding import OF_DIFFERENCES
from isa_nrsfm._prepare.completion import completion_model
from isa_nrsfm._tables.blocks import FrameBlocks
from isa_nrsfm._tables.tracks import (
    FEWEST_POINTS,
    LAYOUTS,
    Layout,
    centred_frames,
    seen_points,
    table_to_tracks,
)

# With fewer frames or points than this the layouts are not compared.
FEWEST_COMPARED = 10


def warn_if_other_layout(
    rows: FrameBlocks, n_columns: int, layout: Layout, scale_frames: bool
) -> None:
    """Warn if a rigid object fits the other column layout much better.

    Compares mean squares, not shares of the total: the wrong layout mixes x and y,
    whose offset adds energy that a rigid object explains.
    """
    if min(rows.n_frames, n_columns // 2) < FEWEST_COMPARED:
        return
    # Some frames, evenly spread
    enough = max(min(1000, 2_000_000 // n_columns), 100)
    sample = rows.take(np.arange(0, rows.n_frames, -(-rows.n_frames // enough)))
    other = next(name for name in LAYOUTS if name != layout)
    both = [table_to_tracks(sample, name) for name in (layout, other)]
    # Points that few frames show are left out first, then frames that show few points
    # in one of the layouts.
    both = [t[:, seen_points(t).sum(axis=0) >= FEWEST_POINTS] for t in both]
    n_seen = np.min([seen_points(t).sum(axis=1) for t in both], axis=0)
    both = [tracks[n_seen >= FEWEST_POINTS] for tracks in both]
    if min(min(tracks.shape[:2]) for tracks in both) < FEWEST_COMPARED:
        return
    centred, reports = zip(*map(centred_frames, both), strict=True)
    # The size of a frame is the smaller of the two, that of the right layout.
    sizes = np.min([report.size for report in reports], axis=0)
    if not scale_frames:
        squares = [np.mean(report.size**2) for report in reports]
        sizes = np.full_like(sizes, np.sqrt(min(squares)))
    sizes = np.where(sizes > 0, sizes, 1.0)
    given, swapped = (_rigid_noise(tracks, sizes) for tracks in centred)
    # On real tables the right layout leaves 0.04 to 0.5 of the energy of the other.
    if given > OF_DIFFERENCES and swapped < 0.6 * given:
        warn_caller(
            f"layout={other!r} explains the table much better than layout={layout!r}: "
            f"what is not rigid has {swapped / given:.2g} times the energy",
        )


def _rigid_noise(centred: NDArray, sizes: NDArray) -> float:
    """Return the noise variance of tracks (I, J, 2) over sizes, as a rigid object."""
    rows = (centred / sizes[:, None, None]).transpose(0, 2, 1)
    if np.isfinite(rows).all():
        W = rows.reshape(-1, rows.shape[2])
        energy = np.linalg.eigvalsh(W.T @ W if len(W) > W.shape[1] else W @ W.T)
        return max(float(energy[:-3].sum()), 0.0) / W.size
    return completion_model(np.ascontiguousarray(rows), rank=3).noise
