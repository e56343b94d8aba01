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
DRINK, PICKUP, YOGA, HANDS, ICT, MUCT, FACES = CASES[1:]
SHARK = tuple(Case(f"shark K={K}", "shark_torresani", K, True) for K in range(1, 7))


def data_folder():
    """Return the folder named by ISA_NRSFM_DATA, else the one beside the checkout."""
    named = os.environ.get("ISA_NRSFM_DATA")
    checkout = Path(__file__).resolve().parents[1]
    return Path(named) if named else checkout.parent / "shared" / "data"


def load_arrays(case):
    """Return the arrays of a data set by name, or None where it is absent."""
    path = data_folder() / f"{case.file}.npz"
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
