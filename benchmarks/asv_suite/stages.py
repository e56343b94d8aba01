"""The stages of a fit, and what a fitted model does with frames."""

from functools import partial
from typing import NamedTuple

import numpy as np
from benchmarks.asv_suite._measured import TABLES, Measured, Table, load

from benchmarks.speed import measured as measurement_matrix, with_holes
from isa_nrsfm import AffineNRSfM, FastISA, PooledFastICA
from isa_nrsfm._gauge.independent import independent_gauge
from isa_nrsfm._joint.fit import fit_jointly
from isa_nrsfm._joint.problem import FactorisedTable, JointSettings
from isa_nrsfm._paper.factors import (
    Factorisation,
    factorise,
    leading_triplets,
    sample_frames,
)
from isa_nrsfm._paper.pipeline import (
    PaperResult,
    lifted_moments,
    motion_products,
    recover_blocks,
    refine_alternating,
    run_paper_pipeline,
    structure_energies,
)
from isa_nrsfm._prepare.completion import completion_model, filled_in
from isa_nrsfm._prepare.scaling import scaled_table
from isa_nrsfm._tables.sources import open_table
from isa_nrsfm._tables.tracks import (
    centred_tracks,
    table_to_tracks,
    tracks_to_table,
    weighting_sizes,
)
from isa_nrsfm.metrics import basis_similarity, inverse_snr

# Share of the points that are missing where some are.
MISSING = 0.2


class Given(NamedTuple):
    """
    What the stages of a table are given.

    Attributes
    ----------
    table : Table
        The table.
    W : ndarray of shape (2 * n_frames, n_points)
        Its measurement matrix.
    factors : Factorisation
        Of it.
    isa : PooledFastICA
        Fitted to its signals.
    paper : PaperResult
        What the joint refinement starts from.
    model : AffineNRSfM
        Fitted, its basis being the principal axes of the deformation.
    """

    table: Table
    W: np.ndarray
    factors: Factorisation
    isa: PooledFastICA
    paper: PaperResult
    model: AffineNRSfM


def prepared(name):
    """Return what the stages of a table are given, None where its file is absent."""
    table = load(name)
    if table is None:
        return None
    K, W = table.n_components, measurement_matrix(table.X, True)
    isa = PooledFastICA(n_init=2, random_state=0)
    factors = factorise(W, K)
    paper = run_paper_pipeline(
        factors,
        K,
        isa,
        block_recovery="generalized_eigen",
        max_iter=200,
        tol=1e-5,
        report=lambda stage: None,
    )
    model = AffineNRSfM(K, independence=None, random_state=0).fit(table.X)
    return Given(table, W, factors, isa, paper, model)


def scaled(X, K):
    """Return a table as the stages after the first one take it."""
    return scaled_table(
        open_table(X, "interleaved"),
        K,
        layout="interleaved",
        names=None,
        scale_frames=True,
        robust=False,
    )


class Stage(Measured):
    """A stage of the fit of a table."""

    params = TABLES
    param_names = ("table",)

    def setup_cache(self):
        return {name: prepared(name) for name in TABLES}

    setup_cache.timeout = 600

    def setup(self, cache, table):
        if cache[table] is None:
            raise NotImplementedError("no file of this table")
        given = cache[table]
        self.table, self.W, self.factors, self.isa, self.paper, self.model = given
        self.X, self.K = self.table.X, self.table.n_components
        self.prepare()
        self.begin()

    def prepare(self):
        """Set what else the stage is given."""

    def paper_inverse_snr(self, **parameters):
        """Return the inverse SNR of the paper's pipeline in percent."""
        model = AffineNRSfM(self.K, random_state=0, **parameters)
        return 100 * model.fit(self.X).inverse_snr_


class Checks(Stage):
    """Checks, centring and sizes."""

    def run(self):
        return scaled(self.X, self.K)


class ChecksMissing(Checks):
    def prepare(self):
        self.X = with_holes(self.X, MISSING)


class Completion(Stage):
    def prepare(self):
        tracks = table_to_tracks(with_holes(self.X, MISSING))
        centred, _ = centred_tracks(tracks)
        self.sizes = weighting_sizes(centred, True)[:, None, None]
        self.rows = (centred / self.sizes).transpose(0, 2, 1)

    def run(self):
        return filled_in(self.rows, completion_model(self.rows, 3 * self.K + 3))

    def track_inverse_snr(self, cache, table):
        completed = tracks_to_table(self.sizes * self.run().transpose(0, 2, 1))
        return 100 * inverse_snr(self.X, completed, scale_frames=True)

    track_inverse_snr.unit = "%"


class Factorisation(Stage):
    def run(self):
        return factorise(self.W, self.K)

    def track_inverse_snr(self, cache, table):
        factors = self.run()
        rigid = factors.rigid_motion @ factors.rigid_shape
        rest = self.W - rigid - factors.motion @ factors.signals
        return 100 * np.sum(rest**2) / np.sum(self.W**2)

    track_inverse_snr.unit = "%"


class SubspacesFastISA(Stage):
    def run(self):
        FastISA(random_state=0).fit(self.factors.signals.T)

    def track_inverse_snr(self, cache, table):
        return self.paper_inverse_snr(isa=FastISA(), refinement=None)

    track_inverse_snr.unit = "%"


class SubspacesPooled(Stage):
    def prepare(self):
        factors = self.factors
        products = motion_products(factors.rigid_motion, factors.motion)
        n_rows, n_points = self.W.shape
        self.covariance = products.gram * n_points / n_rows
        self.criterion = partial(structure_energies, lifted_moments(products))

    def run(self):
        PooledFastICA(random_state=0).fit(
            self.factors.signals.T,
            covariance=self.covariance,
            criterion=self.criterion,
        )

    def track_inverse_snr(self, cache, table):
        return self.paper_inverse_snr(isa=PooledFastICA(), refinement=None)

    track_inverse_snr.unit = "%"


class Blocks(Stage):
    """Block structure and the alternating refinement from it."""

    def prepare(self):
        factors = self.factors
        products = motion_products(factors.rigid_motion, factors.motion)
        self.products = products.rotated(self.isa.components_)

    def run(self):
        D = recover_blocks(self.products, "generalized_eigen")
        E = np.linalg.pinv(D, rcond=1e-9)
        refine_alternating(self.products, E[:, None], max_iter=1000, tol=1e-10)

    def track_inverse_snr(self, cache, table):
        return self.paper_inverse_snr(refinement="alternating")

    track_inverse_snr.unit = "%"


class JointRefinement(Stage):
    def prepare(self):
        scaled_rows = scaled(self.X, self.K)
        self.scaled, self.rows = scaled_rows, scaled_rows.rows
        n_points = self.W.shape[1]
        self.sample = sample_frames(self.rows, n_points, self.factors.rigid_shape)
        self.of_sample = factorise(self.sample[0], self.K)

    def run(self):
        table = FactorisedTable(
            self.scaled,
            self.rows,
            None,
            *leading_triplets(self.W, 3 * self.K + 3)[::2],
            *self.sample,
            self.of_sample,
        )
        settings = JointSettings("affine", "linear", max_iter=1000, tol=0.05)
        return fit_jointly(table, self.paper.shapes, settings)

    def track_affine_shape_error(self, cache, table):
        fit, _, alpha = self.run()
        shapes = fit.state.shapes
        shapes = shapes[0] + np.tensordot(alpha, shapes[1:], axes=1)
        return self.table.error_3d(shapes.transpose(0, 2, 1))

    def track_inverse_snr(self, cache, table):
        return 100 * self.model.inverse_snr_

    track_affine_shape_error.unit = "share of the size"
    track_inverse_snr.unit = "%"


class Gauge(Stage):
    """The independent basis."""

    def prepare(self):
        centred, _ = centred_tracks(table_to_tracks(self.X))
        sizes = weighting_sizes(centred, True)
        self.motion = self.model.motion_ / sizes[:, None, None]
        shapes = np.concatenate([self.model.mean_shape_[None], self.model.basis_])
        self.shapes = shapes.transpose(0, 2, 1)

    def run(self):
        return independent_gauge(
            self.shapes, self.motion, self.model.alpha_, independence="shapes"
        )

    def track_basis_similarity(self, cache, table):
        truth = self.table.truth
        if not hasattr(truth, "basis"):
            return np.nan
        gauge, _ = self.run()
        return basis_similarity(
            truth.basis,
            gauge.basis,
            mean_shape_true=truth.mean_shape,
            mean_shape=gauge.mean_shape,
            modulo_mean_shape=True,
        ).min()

    track_basis_similarity.unit = "lowest similarity"


class Frames(Stage):
    """`transform`: camera and coefficients of frames."""

    def prepare(self):
        self.rows = self.X

    def run(self):
        self.model.transform(self.rows)

    def track_affine_shape_error(self, cache, table):
        return self.table.error_3d(self.model.reconstruct(self.rows))

    def track_inverse_snr(self, cache, table):
        found = self.model.reproject(self.rows)
        return 100 * inverse_snr(self.X, found, scale_frames=True)

    track_affine_shape_error.unit = "share of the size"
    track_inverse_snr.unit = "%"


class FramesMissing(Frames):
    def prepare(self):
        self.rows = with_holes(self.X, MISSING)


class SingleFrames(Frames):
    """`transform` of frames one by one, as of a live stream."""

    def run(self):
        for row in self.rows[:100]:
            self.model.transform(row[None])


class SingleFramesMissing(SingleFrames, FramesMissing):
    pass


class Score(Stage):
    def run(self):
        return self.model.score(self.X)

    def track_inverse_snr(self, cache, table):
        return -100 * self.run()

    track_inverse_snr.unit = "%"
