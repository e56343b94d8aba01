"""Whole fits: by number of frames, points and basis shapes, and of tables."""

from abc import abstractmethod

from benchmarks import _cost
from benchmarks.asv_suite._measured import TABLES, Measured, Table, load
from benchmarks.speed import measured as measurement_matrix
from isa_nrsfm import AffineNRSfM


class Fit(Measured):
    """A fit of a table with the default parameters."""

    @abstractmethod
    def table(self, value):
        """Return the table of a parameter, None where it is absent."""

    def setup(self, value):
        self.given = self.table(value)
        if self.given is None:
            raise NotImplementedError("no file of this table")
        self.W = measurement_matrix(self.given.X, True)
        self.begin()

    def run(self):
        model = AffineNRSfM(self.given.n_components, random_state=0)
        return model.fit(self.given.X)

    def track_affine_shape_error(self, value):
        return self.given.error_3d(self.run().reconstruct(self.given.X))

    def track_inverse_snr(self, value):
        return 100 * self.run().inverse_snr_

    track_affine_shape_error.unit = "share of the size"
    track_inverse_snr.unit = "%"


class OfTables(Fit):
    params = TABLES
    param_names = ("table",)

    def table(self, value):
        return load(value)


class _Swept(Fit):
    """Fits of the tables of the section cost, one setting being varied."""

    base = _cost.SWEEP.base

    def table(self, value):
        setting = self.base | {self.param_names[0]: value}
        return Table.of(_cost.tracks(**setting))


class OverFrames(_Swept):
    param_names = ("n_frames",)
    params = _cost.SWEEP.varied["n_frames"]


class OverPoints(_Swept):
    param_names = ("n_points",)
    params = _cost.SWEEP.varied["n_points"]


class OverComponents(_Swept):
    param_names = ("n_components",)
    params = _cost.SWEEP.varied["n_components"]
