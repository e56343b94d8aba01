"""The joint fit of a table: cameras, samples, robust losses, noise."""

from functools import cache
from typing import NamedTuple

import numpy as np
import pytest
from frame_parts import fit_posterior
from layers import slow_after
from numpy.testing import assert_allclose
from numpy.typing import NDArray
from scenes import measurements

from isa_nrsfm import AffineNRSfM
from isa_nrsfm._frames.camera_models import CAMERAS
from isa_nrsfm._joint import problem as problem_module
from isa_nrsfm._joint.fit import Spectrum, Start, count_components, fit_jointly
from isa_nrsfm._joint.options import JOINT_OPTIONS
from isa_nrsfm._joint.problem import FactorisedTable, JointSettings
from isa_nrsfm._paper.factors import factorise
from isa_nrsfm._paper.sample import Sample
from isa_nrsfm._paper.svd import Triplets, leading_triplets
from isa_nrsfm._parameters.choices import LOSSES
from isa_nrsfm._prepare.completion import completion_model, filled_in
from isa_nrsfm._tables.blocks import FrameBlocks
from isa_nrsfm.datasets import make_face_tracks, make_nonrigid_tracks
from isa_nrsfm.metrics import affine_shape_error

DEVIATION = 0.03
# Relative error of shapes of tables without noise. The floor of the noise, 1e-11 of the
# mean square, is 3e-6 of the size of a frame.
EXACT = 5e-6


def random_table(
    seed=0, deviation=DEVIATION, n_frames=60, n_points=40, unit=False, **options
):
    """
    Return tracks of frames of size one and the true shapes of the frames.

    The noise is added to the frames of size one, so that its variance is the same for
    all of them. The cameras are weak-perspective ones, with two basis shapes. With
    `unit` frames are divided by their root mean square size, all by the same.
    """
    options = {"n_components": 2, **options}
    truth = make_nonrigid_tracks(n_frames, n_points, random_state=seed, **options)
    tracks = truth.clean - truth.clean.mean(axis=1, keepdims=True)
    tracks /= np.sqrt(np.mean(tracks**2, axis=None if unit else (1, 2), keepdims=True))
    rng = np.random.default_rng(seed)
    tracks += deviation * rng.normal(size=tracks.shape)
    return tracks - tracks.mean(axis=1, keepdims=True), truth.shapes


def with_gaps(tracks, share=0.1):
    """Return tracks with some points missing, centred over the others."""
    hidden = np.random.default_rng(3).random(tracks.shape[:2]) < share
    tracks = np.where(hidden[..., None], np.nan, tracks)
    return tracks - np.nanmean(tracks, axis=1, keepdims=True)


class Fitted(NamedTuple):
    """The numbers of a joint fit."""

    shapes: NDArray
    alpha: NDArray
    noise_variance: float
    history: NDArray
    gradient_norm: float
    converged: bool
    camera_noise_ratio: float


def rows_of(tracks):
    """Return tracks in blocks, as the table's stage does."""
    rows = np.ascontiguousarray(tracks.transpose(0, 2, 1))
    return FrameBlocks.of_array(rows, 64)


def fitted(
    tracks,
    n_components=2,
    *,
    outliers=None,
    paper_shapes=None,
    first=None,
    count=False,
    camera="affine",
    loss="linear",
    starts=(),
    **options,
):
    """
    Return the joint fit, with the first triples of signals for the paper's shapes.

    With `first` the first steps are made on these frames, with `count` the number of
    components is returned.
    """
    used, n_points = tracks, tracks.shape[1]
    if outliers is not None:
        used = np.where(outliers[..., None], np.nan, tracks)
        used = used - np.nanmean(used, axis=1, keepdims=True)
    completed = used.transpose(0, 2, 1)
    if np.isnan(used).any():
        model = completion_model(completed, 3 * n_components + 3)
        completed = filled_in(completed, model)
    completed = completed.transpose(0, 2, 1)
    W = measurements(completed, scale_frames=False)
    triplets = leading_triplets(W, 3 * n_components + 3)
    sample = Sample(W, [])
    if first is not None:
        W = W.reshape(len(tracks), 2, n_points)[first].reshape(-1, n_points)
        sample = Sample(W, [first])
    factors = factorise(sample.W, n_components, triplets=triplets)
    if paper_shapes is None:
        triples = factors.signals.reshape(-1, 3, n_points)
        paper_shapes = np.zeros((n_components + 1, 3, n_points))
        paper_shapes[0] = factors.rigid_shape
        paper_shapes[1 : len(triples) + 1] = 0.1 * triples[:n_components]
    if loss != "linear" and outliers is None:
        outliers = np.zeros(tracks.shape[:2], dtype=bool)
    table = FactorisedTable(
        rows_of(tracks),
        rows_of(completed),
        np.isfinite(tracks[..., 0]).sum(axis=1),
        outliers,
        triplets,
        sample,
        factors,
    )
    settings = JointSettings(camera, loss, **{"max_iter": 2000, "tol": 0.05, **options})
    if count:
        return count_components(table, paper_shapes, settings)
    fit, _, alpha = fit_jointly(table, paper_shapes, settings, starts)
    names = "history", "gradient_norm", "converged", "camera_noise_ratio"
    shapes, _, noise_variance = fit.state
    return Fitted(shapes, alpha, noise_variance, *(getattr(fit, n) for n in names))


def frames_of(result, tracks, camera="affine"):
    """Return the fit of the frames to the fitted shapes, and their shapes."""
    frames = fit_posterior(tracks, result.shapes, result.noise_variance, camera=camera)
    shapes = result.shapes[0] + np.tensordot(frames.alpha, result.shapes[1:], 1)
    return frames, shapes.transpose(0, 2, 1)


def images(result, tracks, camera="affine"):
    """Return the images of the fitted frames."""
    frames, shapes = frames_of(result, tracks, camera)
    return shapes @ frames.motion.swapaxes(1, 2) + frames.translation[:, None]


def factors_of(tracks, n_components=2):
    return factorise(measurements(tracks, scale_frames=False), n_components)


class TestFit:
    @pytest.mark.parametrize("camera", CAMERAS)
    def test_shapes_are_centred_and_coefficients_those_of_the_priors(self, camera):
        # The model is right here: there is no prior of the basis shapes, and the most
        # likely mixing of them has mean_i E[alpha_i alpha_i^T] = I. The prior of the
        # extents of calibrated fits moves the mean a little.
        truth = "orthographic" if camera == "orthographic" else "weak_perspective"
        tracks, _ = random_table(
            n_frames=200, unit=camera == "orthographic", camera=truth
        )
        result = fitted(tracks, tol=1e-4, camera=camera)
        assert_allclose(result.shapes.mean(axis=2), 0, atol=1e-12)
        frames, _ = frames_of(result, tracks, camera)
        moments = result.alpha.T @ result.alpha + frames.covariance.sum(axis=0)
        assert_allclose(moments / 200, np.eye(2), atol=0.03)
        shift = 0.01 if camera == "affine" else 0.02
        assert_allclose(result.alpha.mean(axis=0), 0, atol=shift)
        # They are those of the frames, but for the noise that was taken.
        assert_allclose(result.alpha, frames.alpha, atol=0.03)

    def test_history_has_as_many_steps_as_were_allowed(self):
        result = fitted(random_table()[0], max_iter=3, tol=0.0)
        assert not result.converged
        assert len(result.history) == 4

    def test_steps_that_end_before_further_directions(self):
        tracks, _ = random_table(n_frames=8, n_points=250)
        result = fitted(tracks, max_iter=5)
        assert not result.converged
        assert result.shapes.shape == (3, 3, 250)
        assert np.isfinite(result.shapes).all()

    def test_starts_make_no_difference_where_there_is_one_optimum(self):
        tracks, truth = random_table()
        rng = np.random.default_rng(1)
        paper = 0.3 * rng.normal(size=(3, 3, 40))
        paper -= paper.mean(axis=2, keepdims=True)
        paper[0] = factors_of(tracks).rigid_shape
        results = [fitted(tracks), fitted(tracks, paper_shapes=paper)]
        ends = [result.history[-1] for result in results]
        assert np.ptp(ends) < 0.05 * len(tracks)
        for result in results:
            assert affine_shape_error(truth, frames_of(result, tracks)[1]) < 0.02


class TestGivenStarts:
    """The fit from shapes of a similar table, instead of a search for starts."""

    def steps_and_fit(self, tracks, *starts):
        steps = []
        found = fitted(tracks, starts=starts, on_step=lambda: steps.append(1))
        return len(steps), found

    def test_the_better_one_is_taken_whatever_the_order(self):
        tracks, _ = random_table(seed=1)
        known = fitted(random_table(seed=1, deviation=0.06)[0])
        good = Start(known.shapes, known.noise_variance)
        # A basis shape of zero stays zero: from there the fit cannot catch up.
        rng = np.random.default_rng(0)
        shapes = known.shapes + known.shapes.std() * rng.normal(size=(3, 3, 40))
        shapes -= shapes.mean(axis=2, keepdims=True)
        poor = Start(shapes * np.array([1, 1, 0])[:, None, None], 0.01)
        n_good, alone = self.steps_and_fit(tracks, good)
        n_poor, _ = self.steps_and_fit(tracks, poor)
        for starts in [(good, poor), (poor, good)]:
            _, found = self.steps_and_fit(tracks, *starts)
            assert_allclose(found.history[-1], alone.history[-1], rtol=1e-4)
        # After some steps it is dropped.
        n_both, _ = self.steps_and_fit(tracks, good, poor)
        assert n_both - n_good <= JOINT_OPTIONS.catching_up < n_poor

    def test_calibrated_cameras_go_before_affine_ones(self):
        tracks, _ = random_table(seed=1)
        known = fitted(tracks)
        start = Start(known.shapes, known.noise_variance)
        _, plainly = self.steps_and_fit(tracks, start)
        _, first = self.steps_and_fit(tracks, start._replace(calibrated_first=True))
        assert_allclose(first.history[-1], plainly.history[-1], rtol=1e-4)
        assert first.history[0] > plainly.history[0]


def spectrum_of(squares, n_components, n_points):
    """Return the spectrum of complete frames with these squared singular values."""
    rank = 3 * n_components + 3
    vectors = np.empty((rank, n_points))
    triplets = Triplets(np.sqrt(squares[:rank]), vectors, squares[rank:].sum())
    sample = Sample(vectors, [])
    table = FactorisedTable(
        None, None, np.full(30, n_points), None, triplets, sample, None
    )
    return Spectrum.of(table, n_components)


class TestSpectrum:
    @pytest.mark.parametrize("n_components", [1, 2])
    def test_of_complete_frames(self, n_components):
        # Rows of 20 points that are centred: 19 singular values.
        squares = np.sort(np.random.default_rng(0).exponential(size=19))[::-1]
        found = spectrum_of(squares, n_components, 20)
        others = squares[3 * n_components + 3 :].mean() / squares.mean()
        assert found.noise == pytest.approx(others)
        missing = squares[n_components + 3 :].sum() / squares.sum()
        assert found.missing == pytest.approx(missing)

    def test_without_other_singular_values(self):
        found = spectrum_of(np.ones(6), 1, 7)
        assert found.noise == 0.0
        assert found.missing == pytest.approx(2 / 6)


EACH = pytest.mark.parametrize("camera", slow_after(2, CAMERAS))
CALIBRATED = pytest.mark.parametrize(
    "camera", slow_after(1, ["weak_perspective", "orthographic"])
)
GAPS = pytest.mark.parametrize("gaps", [False, True])
GAPS_ARE_SLOW = pytest.mark.parametrize("gaps", slow_after(1, [False, True]))


def table_of(camera, seed=0, gaps=False, **options):
    """Return a table of a camera model, as `random_table` does."""
    unit = camera == "orthographic"  # one size for all frames
    tracks, truth = random_table(seed, camera=camera, unit=unit, **options)
    return with_gaps(tracks) if gaps else tracks, truth


def similarity_error(truth, shapes, scaled):
    """
    Return how far shapes are from true ones, after one rotation or reflection and unit.

    With `scaled` each frame has a unit of its own.
    """
    truth, shapes = (
        each - each.mean(axis=1, keepdims=True) for each in (truth, shapes)
    )
    size = np.linalg.norm(truth, axis=(1, 2), keepdims=True)
    if scaled:
        shapes = shapes * size / np.linalg.norm(shapes, axis=(1, 2), keepdims=True)
    U, S, Vt = np.linalg.svd(shapes.reshape(-1, 3).T @ truth.reshape(-1, 3))
    nearest = S.sum() / np.sum(shapes**2) * shapes @ (U @ Vt)
    return np.mean(np.linalg.norm(truth - nearest, axis=(1, 2)) / size[:, 0, 0])


class Fit(NamedTuple):
    tracks: NDArray
    truth: NDArray  # (n_frames, n_points, 3)
    result: Fitted


@cache
def fit_of(camera, kind=None, seed=0, gaps=False, deviation=DEVIATION):
    """Return a table of a camera model, by default that of the fit, and its fit."""
    tracks, truth = table_of(kind or camera, seed, gaps, deviation=deviation)
    return Fit(tracks, truth, fitted(tracks, camera=camera))


class TestCameras:
    """Tables of each camera model, fitted with it."""

    @EACH
    @GAPS
    @pytest.mark.parametrize("seed", slow_after(1, range(2)))
    def test_without_noise_shapes_are_exact(self, camera, gaps, seed):
        tracks, truth, result = fit_of(camera, None, seed, gaps, 0.0)
        assert result.converged
        shapes = frames_of(result, tracks, camera)[1]
        assert affine_shape_error(truth, shapes) < EXACT
        mean_square = np.nanmean(tracks**2)
        assert result.noise_variance < 1e-9 * mean_square

    @CALIBRATED
    @pytest.mark.parametrize(("deviation", "largest"), [(0.0, EXACT), (0.01, 0.01)])
    def test_calibrated_cameras_show_true_shapes(self, camera, deviation, largest):
        # Also where the object deforms as much as it is large: the mirror image of
        # space is all that is free.
        tracks, truth = table_of(
            camera, deviation=deviation, amplitude=1.0, n_components=3
        )
        result = fitted(tracks, 3, camera=camera)
        shapes = frames_of(result, tracks, camera)[1]
        assert similarity_error(truth, shapes, camera == "weak_perspective") < largest

    @EACH
    @GAPS
    @pytest.mark.parametrize("seed", slow_after(1, range(2)))
    def test_noise_is_the_true_one_within_the_error_of_sampling(
        self, camera, gaps, seed
    ):
        tracks, _, result = fit_of(camera, None, seed, gaps)
        got, pose = result.noise_variance, 2 + CAMERAS[camera].n_parameters
        freedom = np.isfinite(tracks).sum() - pose * 60 - 3 * 3 * 39
        assert abs(got / DEVIATION**2 - 1) < 3.5 * np.sqrt(2 / freedom)

    @CALIBRATED
    def test_no_frame_stays_reversed(self, camera):
        # Of a thin object reversed cameras are nearly as good.
        truth = make_nonrigid_tracks(60, 40, 2, camera=camera, random_state=0)
        frames = truth.shapes * [1.0, 1.0, 0.3]
        tracks = frames @ truth.motion.swapaxes(1, 2)
        tracks = tracks / np.sqrt(np.mean(tracks**2))
        tracks += 0.01 * np.random.default_rng(0).normal(size=tracks.shape)
        tracks -= tracks.mean(axis=1, keepdims=True)
        result = fitted(tracks, camera=camera)
        shapes = frames_of(result, tracks, camera)[1]
        scaled = camera == "weak_perspective"
        assert similarity_error(frames, shapes, scaled) < 0.02


class TestCameraNoiseRatio:
    @pytest.mark.parametrize("camera", ["affine", "weak_perspective"])
    @pytest.mark.parametrize("kind", ["weak_perspective", "orthographic"])
    @pytest.mark.parametrize("deviation", slow_after(1, [0.01, DEVIATION]))
    def test_is_one_for_calibrated_cameras(self, camera, kind, deviation):
        result = fit_of(camera, kind, 0, False, deviation).result
        assert 1.0 <= result.camera_noise_ratio < 1.1

    @EACH
    def test_is_large_for_affine_cameras(self, camera):
        assert fit_of(camera, "affine").result.camera_noise_ratio > 10


class TestNumberOfComponents:
    @EACH
    @pytest.mark.parametrize("n_components", slow_after(1, [3, 1]))
    def test_is_the_true_one(self, camera, n_components):
        tracks, _ = table_of(
            camera, n_frames=120, deviation=0.02, n_components=n_components
        )
        assert fitted(tracks, 5, camera=camera, count=True) == n_components

    @pytest.mark.parametrize("n_components", [0, 2])
    def test_of_many_points(self, n_components):
        tracks, _ = random_table(
            n_frames=80, n_points=300, deviation=0.02, n_components=n_components
        )
        found = fitted(tracks, 5, camera="weak_perspective", count=True)
        assert found == max(n_components, 1)


class TestNoiseVariance:
    @pytest.mark.parametrize("loss", LOSSES[1:])
    def test_with_a_robust_loss(self, loss):
        tracks, _ = random_table(n_frames=150)
        got = fitted(tracks, loss=loss).noise_variance
        # The median is less precise, and the fit bends towards the inner half.
        assert abs(got / DEVIATION**2 - 1) < 0.15

    def test_with_a_robust_loss_and_many_basis_shapes(self):
        # With "cauchy" the fit bends towards the inner half.
        tracks, _ = random_table(n_frames=150, n_points=30, n_components=5)
        got = fitted(tracks, 5, loss="huber").noise_variance
        assert abs(got / DEVIATION**2 - 1) < 0.1

    @pytest.mark.parametrize("loss", LOSSES[1:])
    def test_with_a_robust_loss_and_few_points(self, loss):
        tracks, _ = random_table(n_frames=300, n_points=8, n_components=1)
        got = fitted(tracks, 1, loss=loss).noise_variance
        assert abs(got / DEVIATION**2 - 1) < 0.2

    def test_of_tables_with_few_numbers_stays_finite(self):
        # Nearly as many unknowns as numbers: at least a tenth of these counts as free.
        tracks, _ = random_table(n_frames=8, n_points=13, n_components=3)
        tracks = with_gaps(tracks, 0.15)
        freedom = np.isfinite(tracks).sum() - 8 * 8 - 3 * 4 * 12 + 4**2 + 8
        assert freedom < 0
        assert 0 < fitted(tracks, 3).noise_variance < 1


class TestLargeTables:
    @EACH
    @GAPS_ARE_SLOW
    def test_end_where_small_ones_do(self, gaps, camera):
        kind = "orthographic" if camera == "orthographic" else "weak_perspective"
        tracks, truth = random_table(
            n_frames=200, camera=kind, unit=camera == "orthographic"
        )
        tracks = with_gaps(tracks) if gaps else tracks
        options = {"tol": 1e-3, "camera": camera}
        sampled = fitted(tracks, first=np.arange(0, 200, 5), **options)
        whole = fitted(tracks, **options)
        assert sampled.converged
        assert sampled.noise_variance == pytest.approx(whole.noise_variance, rel=0.01)
        gap = sampled.history[-1] - whole.history[-1]
        assert abs(gap) < len(tracks)
        assert affine_shape_error(truth, frames_of(sampled, tracks, camera)[1]) < 0.02

    def test_first_steps_are_made_on_a_sample(self, monkeypatch):
        tracks, _ = random_table(n_frames=200)
        sizes = []
        refine = problem_module.refine_joint

        def recorded(likelihood, *args, **options):
            sizes.append(likelihood.n_frames)
            return refine(likelihood, *args, **options)

        monkeypatch.setattr(problem_module, "refine_joint", recorded)
        fitted(tracks, first=np.arange(0, 200, 5))
        assert set(sizes) == {40, 200}
        assert sizes.index(200) == len(sizes) - 1

    def test_points_that_the_sample_does_not_show(self):
        tracks, _ = random_table(n_frames=200)
        tracks[:150, 5] = np.nan
        tracks -= np.nanmean(tracks, axis=1, keepdims=True)
        result = fitted(tracks, first=np.arange(100))
        assert np.isfinite(result.shapes).all()


def spoilt(tracks, share=0.05, size=2.0):
    """Return tracks with points that are anywhere, centred, and which they are."""
    rng = np.random.default_rng(5)
    where = rng.random(tracks.shape[:2]) < share
    tracks = tracks.copy()
    tracks[where] += size * rng.normal(size=(where.sum(), 2))
    return tracks, where


class TestRobustLoss:
    @pytest.mark.parametrize("loss", LOSSES[1:])
    @pytest.mark.parametrize(
        ("share", "size", "known"), [(0.05, 2.0, True), (0.01, 0.8, False)]
    )
    def test_outliers_hardly_matter(self, loss, share, size, known):
        # Where they are left out at first, or are few and near.
        tracks, truth = random_table()
        moved, where = spoilt(tracks, share, size)
        result = fitted(moved, loss=loss, outliers=where if known else None)
        plain = fitted(moved)
        shapes, plain_shapes = (frames_of(each, tracks)[1] for each in (result, plain))
        error = affine_shape_error(truth, shapes)
        assert error < 0.04
        assert error < 0.5 * affine_shape_error(truth, plain_shapes)
        # More of the noise is larger than it would be.
        assert 0.85 < result.noise_variance / DEVIATION**2 < 1.5

    def test_gaps(self):
        tracks, truth = random_table()
        moved, where = spoilt(with_gaps(tracks))
        result = fitted(moved, loss="huber", outliers=where)
        shapes = frames_of(result, with_gaps(tracks))[1]
        assert affine_shape_error(truth, shapes) < 0.04

    def test_a_point_that_is_an_outlier_in_all_frames(self):
        tracks, _ = random_table()
        outliers = np.zeros(tracks.shape[:2], dtype=bool)
        outliers[:, 7] = True
        result = fitted(tracks, loss="huber", outliers=outliers)
        assert np.isfinite(result.shapes).all()

    @pytest.mark.parametrize("loss", LOSSES[1:])
    def test_tables_without_noise(self, loss):
        tracks, truth = random_table(deviation=0.0)
        moved, where = spoilt(tracks)
        result = fitted(moved, loss=loss, outliers=where)
        assert affine_shape_error(truth, frames_of(result, tracks)[1]) < 1e-3


class TestDegenerate:
    @CALIBRATED
    @pytest.mark.parametrize("deviation", [0.0, DEVIATION])
    def test_flat_objects_seen_by_calibrated_cameras(self, camera, deviation):
        truth = make_nonrigid_tracks(60, 40, 2, camera=camera, random_state=0)
        flat = truth.shapes * [1.0, 1.0, 0.0]
        tracks = flat @ truth.motion.swapaxes(1, 2)
        tracks /= np.sqrt(np.mean(tracks**2))
        tracks += deviation * np.random.default_rng(0).normal(size=tracks.shape)
        tracks -= tracks.mean(axis=1, keepdims=True)
        result = fitted(tracks, camera=camera)
        assert np.isfinite(result.shapes).all()
        assert np.isfinite(result.alpha).all()
        rest = images(result, tracks, camera) - tracks
        assert np.mean(rest**2) < max(1.5 * deviation**2, 1e-7)

    @CALIBRATED
    @pytest.mark.parametrize("deviation", [0.0, DEVIATION])
    def test_rigid_objects_seen_by_calibrated_cameras(self, camera, deviation):
        tracks, truth = table_of(camera, deviation=deviation, n_components=0)
        result = fitted(tracks, 2, camera=camera)
        assert np.isfinite(result.alpha).all()
        shapes = frames_of(result, tracks, camera)[1]
        assert affine_shape_error(truth, shapes) < max(3 * deviation, 1e-4)

    @CALIBRATED
    def test_few_frames_seen_by_calibrated_cameras(self, camera):
        tracks, _ = table_of(camera, n_frames=8, n_points=13, n_components=3)
        result = fitted(tracks, 3, camera=camera)
        assert np.isfinite(result.shapes).all()
        assert 0 < result.noise_variance < 1

    def test_more_basis_shapes_than_the_table_has(self):
        tracks, truth = random_table(n_frames=150, n_components=1)
        result = fitted(tracks, 3)
        assert affine_shape_error(truth, frames_of(result, tracks)[1]) < 0.03


class TestEstimatorWithoutNoise:
    @pytest.mark.parametrize("n_components", [2, 4])
    def test_few_faces(self, n_components):
        faces = make_face_tracks(
            60, n_components=n_components, noise=0.0, random_state=0
        )
        model = AffineNRSfM(n_components, random_state=0).fit(faces.data)
        assert model.inverse_snr_ < EXACT**2
        # Faces that hardly turn: depths are determined ten to a hundred times worse.
        error = affine_shape_error(faces.shapes, model.reconstruct(faces.data))
        assert error < 5e-4

    @pytest.mark.parametrize("seed", slow_after(1, range(2)))
    @pytest.mark.parametrize("missing", [0.0, 0.15])
    def test_exact_tables_with_and_without_gaps(self, seed, missing):
        truth = make_nonrigid_tracks(
            80, 30, 2 + seed, noise=0.0, missing=missing, random_state=seed
        )
        model = AffineNRSfM(2 + seed, random_state=0).fit(truth.data)
        assert model.inverse_snr_ < EXACT**2
        error = affine_shape_error(truth.shapes, model.reconstruct(truth.data))
        assert error < EXACT
        assert_allclose(model.transform(truth.data), model.alpha_, atol=1e-10)
