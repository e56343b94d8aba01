"""The joint fit of a table: cameras, samples, robust losses, noise."""

import warnings
from types import SimpleNamespace

import numpy as np
import pytest
from layers import QUICK_LIMITS, Quick, may_not_converge, slow_after, with_limits
from made_once import made_once
from numpy.testing import assert_allclose
from scenes import random_scene, table_of, with_gaps, with_outliers

from benchmarks.depth import depth_error, seen
from isa_nrsfm import AffineNRSfM
from isa_nrsfm._frames.camera_models import CAMERAS
from isa_nrsfm._joint.fit import residual_deviations
from isa_nrsfm._joint.problem import FactorisedTable, JointState
from isa_nrsfm._joint.uncertainty import SIGNS
from isa_nrsfm._parameters import LOSSES
from isa_nrsfm.datasets import make_body_tracks, make_nonrigid_tracks
from isa_nrsfm.metrics import affine_shape_error, mean_shape_error_3d

DEVIATION = 0.03
# Relative error of shapes of tables without noise. The floor of the noise, 1e-11 of the
# mean square, is 3e-6 of the size of a frame.
EXACT = 5e-6

SEEN_BY = ["weak_perspective", "affine", "orthographic"]
EACH = pytest.mark.parametrize("camera", slow_after(1, SEEN_BY))
KINDS = pytest.mark.parametrize(
    ("camera", "gaps"), slow_after(1, [*zip(SEEN_BY, [True, False, True], strict=True)])
)
# Errors of depths are tested in test_frame_fit.py. The first steps are made on few
# frames, as of large tables.
SampledNRSfM = with_limits(**QUICK_LIMITS, small_table=1000, sample=40)


def noisy(tracks, deviation, seed=0, unit=False):
    """
    Return tracks with noise that is the same for all frames, each of size one.

    With `unit` frames are divided by their root mean square size, all by the same.
    """
    tracks = tracks - tracks.mean(axis=1, keepdims=True)
    tracks /= np.sqrt(np.mean(tracks**2, axis=None if unit else (1, 2), keepdims=True))
    return tracks + deviation * np.random.default_rng(seed).normal(size=tracks.shape)


def random_table(camera="weak_perspective", seed=0, deviation=DEVIATION, **options):
    """Return tracks of cameras of a model, and the true shapes of the frames."""
    options = {"n_frames": 40, "n_points": 24, "n_components": 2} | options
    truth = make_nonrigid_tracks(camera=camera, random_state=seed, **options)
    unit = camera == "orthographic"
    return noisy(truth.clean, deviation, seed, unit), truth.shapes


def fitted(tracks, n_components=2, kind=AffineNRSfM, **params):
    return kind(n_components, random_state=0, **params).fit(table_of(tracks))


def error_of(model, tracks, truth):
    return affine_shape_error(truth, model.reconstruct(table_of(tracks)))


@made_once
def fit_of(camera, gaps=False, deviation=DEVIATION):
    """Return tracks of a camera model, the true shapes, and the fit."""
    tracks, truth = random_table(camera, deviation=deviation)
    tracks = with_gaps(tracks, 0.1) if gaps else tracks
    return tracks, truth, fitted(tracks, camera=camera)


@may_not_converge
def test_steps_that_end_before_further_directions():
    tracks, _ = random_table(n_frames=8, n_points=250)
    model = fitted(tracks, max_iter=5)
    assert model.basis_.shape == (2, 250, 3)
    assert np.isfinite(model.basis_).all()


@pytest.mark.parametrize(("n_components", "n_points"), [(1, 20), (2, 20), (1, 7)])
def test_noise_level_of_the_spectrum(n_components, n_points):
    # Rows of points that are centred have one singular value less.
    squares = np.random.default_rng(0).exponential(size=n_points - 1)
    squares, rank = np.sort(squares)[::-1], 3 * n_components + 3
    kept, rest = np.sqrt(squares[:rank]), squares[rank:].sum()
    scaled, W = SimpleNamespace(n_seen=np.full(30, n_points)), np.empty((60, n_points))
    table = FactorisedTable(scaled, None, None, kept, rest, W, [], None)
    others = squares[rank:].mean() / squares.mean() if n_points > 7 else 0.0
    assert table.noise_level(n_components) == pytest.approx(others)


class TestCameras:
    """Tables of each camera model, fitted with it."""

    @KINDS
    def test_without_noise_shapes_are_exact(self, camera, gaps):
        tracks, truth, model = fit_of(camera, gaps, 0.0)
        assert error_of(model, tracks, truth) < EXACT
        assert model.inverse_snr_ < EXACT**2
        assert model.noise_variance_ < 1e-9
        assert_allclose(model.transform(table_of(tracks)), model.alpha_, atol=1e-10)

    @KINDS
    def test_noise_is_true_within_the_error_of_sampling(self, camera, gaps):
        tracks, _, model = fit_of(camera, gaps)
        freedom = np.isfinite(tracks).sum() - 3 * 3 * 23
        freedom -= (2 + CAMERAS[camera].n_parameters) * 40
        size = np.mean(np.nanmean(tracks**2, axis=(1, 2)))
        variance = DEVIATION**2 / (1.0 if camera == "orthographic" else size)
        deviation = np.sqrt(2 / freedom)
        assert abs(model.noise_variance_ / variance - 1) < 3.5 * deviation

    def test_no_frame_stays_reversed(self):
        # Of a thin object reversed cameras are nearly as good.
        camera = "weak_perspective"
        truth = make_nonrigid_tracks(30, 24, 2, camera=camera, random_state=0)
        frames = truth.shapes * [1.0, 1.0, 0.3]
        tracks = noisy(frames @ truth.motion.swapaxes(1, 2), 0.01, unit=True)
        model = fitted(tracks, camera=camera)
        shapes = model.reconstruct(table_of(tracks))
        assert mean_shape_error_3d(frames, shapes, convention="frame") < 0.02


class TestNoiseVariance:
    # The median is less precise, and the fit bends towards the inner half, with
    # "cauchy" most of all.
    @pytest.mark.parametrize(
        ("loss", "sizes", "largest"),
        slow_after(1, [("huber", (100, 30, 2), 0.15), ("cauchy", (300, 8, 1), 0.2)]),
    )
    def test_with_a_robust_loss(self, loss, sizes, largest):
        names = "n_frames", "n_points", "n_components"
        tracks, _ = random_table("orthographic", **dict(zip(names, sizes, strict=True)))
        model = fitted(tracks, sizes[2], loss=loss, scale_frames=False)
        assert abs(model.noise_variance_ / DEVIATION**2 - 1) < largest

    def test_of_images_is_that_of_residuals_for_each_free_number(self):
        tracks, _ = random_table("affine", n_frames=12, n_points=30, n_components=4)
        frames = fitted(tracks, 4)._model.frames
        free = 720 - (8 + 4) * 12 - 3 * 5 * 29
        found = frames.noise_variance * frames.certainty.images[0]
        assert_allclose(found, 360 * frames.certainty.residual / free, rtol=0.15)

    def test_of_tables_with_few_numbers_stays_finite(self):
        # Nearly as many unknowns as numbers: at least a tenth of these counts as free.
        tracks, _ = random_table(n_frames=8, n_points=13, n_components=3)
        model = fitted(tracks, 3, camera="weak_perspective")
        assert np.isfinite(model.basis_).all()
        assert 0 < model.noise_variance_ < 1


class TestLargeTables:
    @pytest.mark.slow
    @pytest.mark.parametrize("camera", SEEN_BY)
    def test_end_where_small_ones_do(self, camera):
        seen_by = camera if camera == "orthographic" else "weak_perspective"
        tracks, truth = random_table(seen_by, n_frames=200, n_points=40)
        tracks = with_gaps(tracks, 0.1)
        options = {"tol": 1e-3, "camera": camera}
        sampled = fitted(tracks, kind=SampledNRSfM, **options)
        whole = fitted(tracks, **options)
        assert sampled.noise_variance_ == pytest.approx(whole.noise_variance_, rel=0.01)
        gap = sampled.objective_history_[-1] - whole.objective_history_[-1]
        if camera == "affine":  # others have numbers of directions of their own
            assert abs(gap) < len(tracks)
        assert error_of(sampled, tracks, truth) < 0.02

    @pytest.mark.slow
    def test_bodies_that_the_sample_does_not_have(self):
        """No frame at a wrong minimum bends the shapes: depth errors were 0.27."""
        kind = with_limits(**QUICK_LIMITS, small_table=1000, sample=150)
        X, points, _ = seen(make_body_tracks(1200, random_state=0).shapes, 40, 0)
        model = kind(9, camera="weak_perspective", random_state=0).fit(X)
        assert depth_error(model, X, points)[1] < 0.11

    def test_robust_losses_weigh_all_frames(self):
        tracks, _ = random_table(n_frames=100, n_points=14, n_components=1)
        models = [fitted(tracks, 1, k, loss="cauchy") for k in (SampledNRSfM, Quick)]
        assert_allclose(*(m.noise_variance_ for m in models), rtol=0.02)
        assert_allclose(*(m.mean_shape_ for m in models), rtol=0, atol=0.02)

    # In so few rows, the point may look like an outlier.
    @pytest.mark.filterwarnings("ignore:the table has outliers")
    def test_points_that_the_sample_does_not_show(self):
        tracks, _ = random_table(n_frames=100)
        tracks[8:, 5] = np.nan
        assert np.isfinite(fitted(tracks, kind=SampledNRSfM).basis_).all()


class TestRobustLoss:
    @pytest.mark.parametrize("camera", CAMERAS)
    def test_deviations_of_residuals_by_dense_matrices(self, camera):
        # I - A (A^T W A + P)^-1 A^T W, with A by differences.
        variance, step, model = 0.3, 1e-6, CAMERAS[camera]
        scene = random_scene(camera=camera, kind="missing", n_frames=5)
        n_pose = model.n_parameters + 2
        unknowns = np.eye(n_pose + scene.alpha.shape[1])
        prior = np.diag(np.arange(len(unknowns)) >= n_pose) * variance
        expected = np.empty(scene.weights.shape)
        for i, weights in enumerate(scene.weights):

            def image(change, i=i):
                turn, t, a = np.split(change, [model.n_parameters, n_pose])
                M = model.moved(scene.motion[i, ..., None], turn[:, None])[..., 0]
                a = scene.alpha[i] + a
                shape = scene.shapes[0] + np.tensordot(a, scene.shapes[1:], 1)
                return (M @ shape + t[:, None]).ravel()

            A = np.stack([image(step * e) - image(-step * e) for e in unknowns], 1)
            A, W = A / (2 * step), np.diag(np.tile(weights, 2))
            left = np.eye(len(A)) - A @ np.linalg.solve(A.T @ W @ A + prior, A.T @ W)
            square = np.sum(left**2, axis=1).reshape(2, -1)
            expected[i] = np.sqrt(square.mean(axis=0))
        state = JointState(scene.shapes, scene.motion, variance)
        got = residual_deviations(state, scene.alpha, scene.weights, model)
        assert_allclose(got, expected, rtol=1e-6)

    @pytest.mark.parametrize("loss", slow_after(1, LOSSES[:0:-1]))
    def test_tables_without_noise(self, loss):
        tracks, truth = random_table(deviation=0.0)
        moved = with_outliers(tracks, 2.0, seed=5)
        assert error_of(fitted(moved, loss=loss), tracks, truth) < 1e-3


def test_halves_differ_like_independent_tables():
    # All parts differ alike, but for their sum, and about as two tables of this size.
    pairs = [a - b for i, a in enumerate(SIGNS) for b in SIGNS[:i]]
    square = np.einsum("pi,pj->ij", pairs, pairs) / len(pairs)
    assert_allclose(square, 2 * 8 / 7 * (np.eye(15) - 1 / 15), atol=1e-12)


class TestDegenerate:
    @pytest.mark.parametrize(
        ("camera", "deviation"),
        slow_after(1, [("weak_perspective", 0.0), ("orthographic", DEVIATION)]),
    )
    def test_flat_objects_seen_by_calibrated_cameras(self, camera, deviation):
        truth = make_nonrigid_tracks(20, 20, 2, camera=camera, random_state=0)
        flat = truth.shapes * [1.0, 1.0, 0.0]
        tracks = noisy(flat @ truth.motion.swapaxes(1, 2), deviation, unit=True)
        with warnings.catch_warnings(action="ignore"):  # each frame may be reversed
            model = fitted(tracks, camera=camera)
        if not deviation:  # about 2 of reversed frames, at most 2 of shapes with sides
            assert 1.0 < model.depth_uncertainty_ < 1.02 * 2
        assert np.isfinite(model.alpha_).all()
        assert model.inverse_snr_ < max(1.5 * deviation**2, 1e-7)

    @EACH
    def test_rigid_objects(self, camera):
        tracks, truth = random_table(camera, deviation=0.0, n_components=0)
        model = fitted(tracks, 2, camera=camera)
        assert error_of(model, tracks, truth) < 1e-4
        # Also of frames that look different, which start again
        other = random_table(camera, seed=1, n_frames=5)[0]
        assert model.transform(table_of(other)).shape == (5, 2)
