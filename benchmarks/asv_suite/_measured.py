"""What is measured of everything in the suite, and the tables of the suite."""

from abc import ABC, abstractmethod
from functools import partial
from typing import Any, NamedTuple

import numpy as np
from threadpoolctl import threadpool_limits

from benchmarks import _sets
from benchmarks._isolated import reset_peak_memory
from benchmarks.speed import paired_ratio
from isa_nrsfm.datasets import make_face_tracks, make_nonrigid_tracks
from isa_nrsfm.metrics import affine_shape_error

SYNTHETIC = {
    "small": partial(make_nonrigid_tracks, 40, 20, 2, noise=0.01, random_state=0),
    "tracks": partial(make_nonrigid_tracks, 300, 68, 3, noise=0.02, random_state=0),
    "faces": partial(make_face_tracks, 400, n_components=4, random_state=0),
}
REAL = ("drink", "ict_68", "faces_wild")
TABLES = (*SYNTHETIC, *REAL)
# Pairs of a run and an SVD, of which the median ratio is taken.
N_PAIRS = 3


class Table(NamedTuple):
    """
    A table, and what is known of it.

    Attributes
    ----------
    X : ndarray of shape (n_frames, 2 * n_points)
        Rows without missing points.
    n_components : int
        K.
    truth : Bunch or `benchmarks._sets.Table`
        Its shapes are the true ones, or None.
    """

    X: np.ndarray
    n_components: int
    truth: Any

    @classmethod
    def of(cls, tracks):
        """Return the table of synthetic tracks."""
        return cls(tracks.data, len(tracks.basis), tracks)

    def error_3d(self, shapes):
        """Return the error of shapes in 3D, NaN where there is no truth."""
        if self.truth.shapes is None:
            return np.nan
        return affine_shape_error(self.truth.shapes, shapes)


def load(name):
    """Return a table, None where its file is absent."""
    if name in SYNTHETIC:
        return Table.of(SYNTHETIC[name]())
    if not _sets.is_present(name):
        return None
    found = _sets.load(name)
    return Table(found.X, _sets.SETS[name].case.n_components, found)


class Measured(ABC):
    """
    Time and memory of `run`, and its ratio to a thin SVD of the table.

    A `setup` sets `W`, the measurement matrix of the table, and calls `begin`.
    """

    timeout = 600

    @abstractmethod
    def run(self):
        """Do what is measured."""

    def begin(self):
        """Have one thread, and forget the memory that the setup took."""
        threadpool_limits(1)
        reset_peak_memory()

    def time_run(self, *parameters):
        self.run()

    def peakmem_run(self, *parameters):
        self.run()

    def track_svds(self, *parameters):
        def svd():
            np.linalg.svd(self.W, full_matrices=False)

        return paired_ratio(self.run, svd, N_PAIRS)[1]

    track_svds.unit = "SVDs"
