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


def data_folder():
    """Return the folder named by ISA_NRSFM_DATA, else the one beside the checkout."""
    named = os.environ.get("ISA_NRSFM_DATA")
    checkout = Path(__file__).resolve().parents[1]
    return Path(named) if named else checkout.parent / "shared" / "data"


def load_table(case):
    """Return the complete rows of a data set as a table, or None where it is absent."""
    path = data_folder() / f"{case.file}.npz"
    if not path.is_file():
        print(f"{case.title}: skipped, no {path.name} in the folder ISA_NRSFM_DATA")
        return None
    with np.load(path, allow_pickle=False) as data:
        tracks = data["W2d"]
    complete = ~np.isnan(tracks).any(axis=(1, 2))
    return tracks[complete].reshape(complete.sum(), -1)
