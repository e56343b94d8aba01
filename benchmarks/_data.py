"""Find the tables that the benchmarks measure."""

import os
from pathlib import Path
from typing import NamedTuple

import numpy as np


class Case(NamedTuple):
    """A data set and how it is factorised."""

    title: str
    file: str
    n_components: int
    scale_frames: bool


CASES = (
    Case("shark K=1, unscaled", "shark_torresani", 1, False),
    Case("drink K=3", "akhter_drink", 3, True),
    Case("pickup K=3", "akhter_pickup", 3, True),
    Case("yoga K=4", "akhter_yoga", 4, True),
    Case("hands K=3", "hands_kazuhito_21", 3, True),
    Case("ICT-68 K=9", "ict_bu3dfe_like_68", 9, True),
    Case("MUCT-68 K=9", "muct_68", 9, True),
    Case("faces_wild K=9", "faces_wild_68_combined", 9, True),
)
SHARK_UNSCALED, DRINK, PICKUP, YOGA, HANDS, ICT, MUCT, FACES = CASES
SHARK = tuple(Case(f"shark K={K}", "shark_torresani", K, True) for K in range(1, 7))
FLAG = Case("flag K=5, unscaled", "flag_mocap_30x250", 5, False)
DENSE = Case("ICT dense K=8", "ict_bu3dfe_like_basis", 8, True)
EXPRESSIONS = Case("expressions K=9", "expressions_dlib_68", 9, True)
# Frames of dense shapes that are computed at a time.
BLOCK = 100


def data_folder():
    """Return the folder named by ISA_NRSFM_DATA, else the one beside the checkout."""
    named = os.environ.get("ISA_NRSFM_DATA")
    checkout = Path(__file__).resolve().parents[1]
    return Path(named) if named else checkout.parent / "shared" / "data"


def data_path(case):
    """Return the path of a data set, whether it is there or not."""
    return data_folder() / f"{case.file}.npz"


def load_arrays(case):
    """Return the arrays of a data set by name, or None where it is absent."""
    path = data_path(case)
    if not path.is_file():
        print(f"{case.title}: skipped, no {path.name} in the folder ISA_NRSFM_DATA")
        return None
    with np.load(path, allow_pickle=False) as data:
        return dict(data)


def load_table(case, complete=True):
    """Return the rows of a data set as a table, or None where it is absent."""
    arrays = load_arrays(case)
    if arrays is None:
        return None
    tracks = arrays["W2d"]
    if complete:
        tracks = tracks[~np.isnan(tracks).any(axis=(1, 2))]
    return as_table(tracks)


def as_table(tracks):
    """Return tracks (n_frames, n_points, 2) as an interleaved table."""
    return tracks.reshape(len(tracks), -1)


def halves_of(n_rows, seed):
    """Return the row numbers of two random halves of a table."""
    order = np.random.default_rng(seed).permutation(n_rows)
    return order[: n_rows // 2], order[n_rows // 2 :]


def dense_shapes(arrays, frames):
    """Return dense shapes (n_frames, n_points, 3) of some frames from their model."""
    shapes = arrays["mean"].astype(float)
    for name in ("identity", "expression"):
        weights = arrays[f"{name}_coeffs"][frames].astype(float)
        shapes = shapes + np.tensordot(weights, arrays[name].astype(float), 1)
    return shapes


def dense_tracks(arrays):
    """Return the orthographic tracks of dense shapes, a block of frames at a time."""
    n_frames, n_points = len(arrays["R"]), len(arrays["mean"])
    tracks = np.empty((n_frames, n_points, 2))
    for first in range(0, n_frames, BLOCK):
        frames = slice(first, first + BLOCK)
        cameras = arrays["R"][frames, :2].astype(float)
        tracks[frames] = dense_shapes(arrays, frames) @ cameras.transpose(0, 2, 1)
    return tracks
