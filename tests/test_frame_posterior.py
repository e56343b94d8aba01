"""The most probable camera, position and coefficients of single frames."""

import numpy as np
import pytest
from frame_parts import camera_and_alpha, fit_posterior, numbers_of
from numpy.testing import assert_allclose, assert_array_equal
from scenes import random_rotation

from isa_nrsfm import AffineNRSfM
from isa_nrsfm._frames.affine_newton import AffineSearch
from isa_nrsfm._frames.point_sums import frame_sums, frame_tracks
from isa_nrsfm._frames.posterior import fit_frames, frame_search, spread_starts
from isa_nrsfm._frames.search import MAX_STEPS
from isa_nrsfm._linalg.packed_symmetric import unpacked

NOISE = 0.02


def random_scene(seed, noise=NOISE, n_frames=30, n_points=20, n_components=3):
    """Return tracks, shapes (n_components + 1, 3, n_points) and what made them."""
    rng = np.random.default_rng(seed)
    shapes = rng.normal(size=(n_components + 1, 3, n_points))
    shapes[1:] *= 0.3
    shapes -= shapes.mean(axis=2, keepdims=True)
    motion = rng.normal(size=(n_frames, 2, 3))
    translation = rng.normal(size=(n_frames, 2))
    alpha = rng.normal(size=(n_frames, n_components))
    tracks = images(shapes, motion, translation, alpha)
    tracks = tracks + noise * rng.normal(size=tracks.shape)
    return tracks, shapes, (motion, translation, alpha)


def images(shapes, motion, translation, alpha):
    """Return the tracks (n_frames, n_points, 2) of a model."""
    frames = shapes[0] + np.tensordot(alpha, shapes[1:], 1)
    return (motion @ frames).swapaxes(1, 2) + translation[:, None]


def cost(tracks, shapes, variance, fits, weights=None):
    """Return f of each frame by its definition."""
    difference = tracks - images(shapes, fits.motion, fits.translation, fits.alpha)
    w = np.ones(tracks.shape[:2]) if weights is None else weights
    squares = np.nansum(w[..., None] * difference**2, axis=(1, 2))
    return squares + variance * np.sum(fits.alpha**2, axis=1)


def energy_of(tracks):
    """Return the largest energy of a frame; rounding errors are relative to it."""
    centred = tracks - np.nanmean(tracks, axis=1, keepdims=True)
    return np.nansum(centred**2, axis=(1, 2)).max()


def with_gaps(tracks, seed, share=0.3):
    """Return a copy with NaN at random points."""
    hidden = np.random.default_rng(seed).random(tracks.shape[:2]) < share
    return np.where(hidden[..., None], np.nan, tracks)


def assert_same_fits(got, expected, atol=1e-9):
    for name in ("motion", "translation", "alpha", "covariance"):
        assert_allclose(getattr(got, name), getattr(expected, name), atol=atol)
    assert_allclose(got.objective, expected.objective, rtol=1e-7, atol=1e-12)


def problem_of(tracks, shapes, variance, weights=None):
    """Return the search for shapes, and the frames as it takes them."""
    search = AffineSearch(shapes)
    products = frame_sums(frame_tracks(tracks, weights), search.shared)
    return search, search.problem(products, np.full(len(tracks), variance))


class TestOptimum:
    @pytest.mark.parametrize("gaps", [False, True])
    def test_exact_tracks(self, gaps):
        tracks, shapes, truth = random_scene(0, noise=0.0)
        given = with_gaps(tracks, 0) if gaps else tracks
        fits = fit_posterior(given, shapes, 0.0)
        for got, true in zip(camera_and_alpha(fits), truth, strict=True):
            assert_allclose(got, true, atol=1e-9)
        assert fits.converged.all()
        assert_allclose(fits.objective, 0, atol=1e-9)

    @pytest.mark.parametrize("gaps", [False, True])
    def test_objective_by_definition_rises_in_every_direction(self, gaps):
        tracks, shapes, _ = random_scene(0)
        if gaps:
            tracks = with_gaps(tracks, 0)
        rng = np.random.default_rng(1)
        fits = fit_posterior(tracks, shapes, NOISE**2)
        least = cost(tracks, shapes, NOISE**2, fits)
        assert_allclose(fits.objective, least, atol=1e-12 * energy_of(tracks))
        for _ in range(20):
            change = [rng.normal(size=each.shape) for each in camera_and_alpha(fits)]
            rises = []
            for size in (-1e-4, 1e-4):
                moved = [
                    x + size * d
                    for x, d in zip(camera_and_alpha(fits), change, strict=True)
                ]
                moved = fits._replace(
                    motion=moved[0], translation=moved[1], alpha=moved[2]
                )
                rises.append(cost(tracks, shapes, NOISE**2, moved) - least)
            # Equal on both sides: the slope is zero, not only small.
            assert (np.array(rises) > 0).all()
            assert_allclose(rises[0], rises[1], rtol=1e-2)

    def test_weights(self):
        tracks, shapes, _ = random_scene(0)
        weights = np.random.default_rng(1).uniform(0, 2, tracks.shape[:2])
        fits = fit_posterior(tracks, shapes, NOISE**2, weights=weights)
        least = cost(tracks, shapes, NOISE**2, fits, weights)
        assert_allclose(fits.objective, least, atol=1e-12 * energy_of(tracks))
        for name in ("motion", "translation", "alpha"):
            for size in (-1e-4, 1e-4):
                moved = fits._replace(**{name: getattr(fits, name) + size})
                assert (cost(tracks, shapes, NOISE**2, moved, weights) > least).all()

    def test_derivatives_by_differences(self):
        tracks, shapes, _ = random_scene(0, n_frames=5)
        weights = np.random.default_rng(1).uniform(0, 2, tracks.shape[:2])
        for w in (None, weights):
            search, problem = problem_of(tracks, shapes, NOISE, w)
            alpha = np.random.default_rng(2).normal(size=(3, 5))
            state = search.evaluate(problem, alpha)
            h = 1e-5
            for k in range(3):
                e = h * np.eye(3)[:, [k]]
                above = search.evaluate(problem, alpha + e)
                below = search.evaluate(problem, alpha - e)
                slope = (below.value - above.value) / (4 * h)
                assert_allclose(state.slope[k], slope, rtol=1e-6, atol=1e-7)
                bend = (below.slope - above.slope) / (2 * h)
                assert_allclose(
                    unpacked(state.hessian)[:, k], bend, rtol=1e-6, atol=1e-6
                )

    def test_no_worse_than_alternation(self):
        tracks, shapes, _ = random_scene(0)
        fits = fit_posterior(tracks, shapes, NOISE**2)
        for i, frame in enumerate(tracks):
            W = (frame - frame.mean(axis=0)).T
            a = np.zeros(3)
            for _ in range(300):
                S = shapes[0] + np.tensordot(a, shapes[1:], 1)
                M = W @ np.linalg.pinv(S)
                seen = (M @ shapes[1:]).reshape(3, -1)
                normal = seen @ seen.T + NOISE**2 * np.eye(3)
                a = np.linalg.solve(normal, seen @ (W - M @ shapes[0]).ravel())
            S = shapes[0] + np.tensordot(a, shapes[1:], 1)
            f = np.sum((W - M @ S) ** 2) + NOISE**2 * a @ a
            assert fits.objective[i] <= f + 1e-12 * np.sum(W**2)

    @pytest.mark.parametrize("gaps", [False, True])
    def test_covariance_is_that_of_all_unknowns_together(self, gaps):
        tracks, shapes, _ = random_scene(0, n_frames=4)
        if gaps:
            tracks = with_gaps(tracks, 0)
        fits = fit_posterior(tracks, shapes, NOISE**2)

        def f(i, x):
            one = fits._replace(
                motion=x[None, :6].reshape(1, 2, 3),
                translation=x[None, 6:8],
                alpha=x[None, 8:],
            )
            return cost(tracks[i : i + 1], shapes, NOISE**2, one)[0]

        h = 1e-3
        for i in range(len(tracks)):
            x = np.concatenate([each[i].ravel() for each in camera_and_alpha(fits)])
            hessian = np.empty((11, 11))
            for p in range(11):
                for q in range(11):
                    a, b = h * np.eye(11)[p], h * np.eye(11)[q]
                    corners = f(i, x + a + b) + f(i, x - a - b)
                    corners -= f(i, x + a - b) + f(i, x - a + b)
                    hessian[p, q] = corners / (4 * h * h)
            # The posterior density is exp(-f / (2 s2)).
            expected = np.linalg.inv(hessian / (2 * NOISE**2))[8:, 8:]
            assert_allclose(fits.covariance[i], expected, rtol=1e-3, atol=1e-7)

    def test_covariance_is_the_scatter_of_the_errors(self):
        tracks, shapes, (_, _, alpha) = random_scene(0, n_frames=4000)
        fits = fit_posterior(tracks, shapes, NOISE**2)
        spread = np.linalg.inv(np.linalg.cholesky(fits.covariance))
        scaled = np.einsum("ikl,il->ik", spread, fits.alpha - alpha)
        # Frames with nearly edge-on cameras are not normal.
        typical = np.median(np.sum(scaled**2, axis=1))
        assert_allclose(typical, 2.366, rtol=0.05)  # median of chi-squared, 3

    def test_strong_prior_and_no_prior(self):
        tracks, shapes, _ = random_scene(0)
        rigid = fit_posterior(tracks, shapes, 1e9)
        assert_allclose(rigid.alpha, 0, atol=1e-4)
        for frame, M in zip(tracks, rigid.motion, strict=True):
            W = (frame - frame.mean(axis=0)).T
            assert_allclose(M, W @ np.linalg.pinv(shapes[0]), atol=1e-4)
        assert np.isfinite(fit_posterior(tracks, shapes, 0.0).alpha).all()


class TestEntries:
    @pytest.mark.parametrize("camera", ["affine", "weak_perspective"])
    @pytest.mark.parametrize("gaps", [False, True])
    def test_prepared_frames_are_fitted_as_tracks_are(self, camera, gaps):
        tracks, shapes, _ = random_scene(0)
        tracks = with_gaps(tracks, 0) if gaps else tracks
        frames = frame_tracks(tracks, np.isfinite(tracks[..., 0]) * 1.0)
        got = fit_frames(frames, frame_search(camera, shapes), NOISE**2)
        expected = fit_posterior(tracks, shapes, NOISE**2, camera)
        assert_same_fits(got, expected)

    @pytest.mark.parametrize("gaps", [False, True])
    def test_rough_cameras_are_near(self, gaps):
        tracks, shapes, _ = random_scene(0)
        tracks = with_gaps(tracks, 0) if gaps else tracks
        frames = frame_tracks(tracks, np.isfinite(tracks[..., 0]) * 1.0)
        rough = fit_frames(frames, AffineSearch(shapes), NOISE**2, rough=True)
        away = rough.motion - fit_posterior(tracks, shapes, NOISE**2).motion
        assert np.median(np.abs(away).max(axis=(1, 2))) < 0.1


class TestInvariance:
    @pytest.mark.parametrize("camera", ["affine", "weak_perspective"])
    def test_fits_are_the_same_without_covariances(self, camera):
        tracks, shapes, _ = random_scene(0)
        tracks[10:] = with_gaps(tracks[10:], 0)
        starts = np.ones((2, len(shapes) - 1))
        expected = fit_posterior(
            tracks, shapes, NOISE**2, camera=camera, starts=starts
        )._asdict()
        got = fit_posterior(
            tracks, shapes, NOISE**2, camera=camera, starts=starts, covariances=False
        )._asdict()
        assert got.pop("covariance").shape == (len(tracks), 0, 0)
        assert np.isnan(got.pop("turn_covariance")).all()
        for name, value in got.items():
            assert_array_equal(value, expected[name])

    def test_frames_are_separate(self):
        tracks, shapes, _ = random_scene(0)
        tracks[10:] = with_gaps(tracks[10:], 0)
        tracks[25, 3:] = np.nan
        together = fit_posterior(tracks, shapes, NOISE**2)
        assert np.isnan(together.alpha[25]).all()
        for i in range(len(tracks)):
            alone = fit_posterior(tracks[i : i + 1], shapes, NOISE**2)
            for got, expected in zip(alone, together, strict=True):
                assert_allclose(got[0], expected[i], rtol=1e-9, atol=1e-11)

    def test_more_frames_than_a_block(self):
        tracks, shapes, _ = random_scene(0, n_frames=20)
        tracks[::2] = with_gaps(tracks[::2], 0)
        expected = fit_posterior(tracks, shapes, NOISE**2)
        often = np.tile(np.arange(20), 205)
        got = fit_posterior(tracks[often], shapes, NOISE**2)
        assert_same_fits(got, expected.take(often), 1e-11)

    def test_memory_order(self):
        tracks, shapes, _ = random_scene(0)
        for given in (tracks, with_gaps(tracks, 0)):
            expected = fit_posterior(given, shapes, NOISE**2)
            got = fit_posterior(
                np.asfortranarray(given), np.asfortranarray(shapes), NOISE**2
            )
            for a, b in zip(got, expected, strict=True):
                assert_array_equal(a, b)

    def test_single_precision_is_not_used_inside(self):
        tracks, shapes, _ = random_scene(0)
        single = tracks.astype(np.float32)
        got = fit_posterior(single, shapes, NOISE**2)
        expected = fit_posterior(single.astype(float), shapes, NOISE**2)
        assert_array_equal(got.alpha, expected.alpha)

    def test_own_gram_matrices_and_the_shared_one(self):
        tracks, shapes, _ = random_scene(0)
        twice = np.full(tracks.shape[:2], 2.0)
        shared = fit_posterior(tracks, shapes, NOISE**2)
        own = fit_posterior(tracks, shapes, 2 * NOISE**2, weights=twice)
        assert_allclose(own.alpha, shared.alpha, atol=1e-11)
        assert_allclose(own.motion, shared.motion, atol=1e-11)
        assert_allclose(own.covariance, shared.covariance, atol=1e-11)
        assert_allclose(own.objective, 2 * shared.objective, rtol=1e-9)

    def test_missing_points_are_points_that_are_not_there(self):
        tracks, shapes, _ = random_scene(0)
        kept = np.arange(20) % 3 > 0
        hidden = np.where(kept[:, None], tracks, np.nan)
        fewer = shapes[:, :, kept]
        centre = fewer.mean(axis=2)
        expected = fit_posterior(tracks[:, kept], fewer - centre[..., None], NOISE**2)
        fits = fit_posterior(hidden, shapes, NOISE**2)
        assert_allclose(fits.alpha, expected.alpha, atol=1e-10)
        assert_allclose(fits.motion, expected.motion, atol=1e-10)
        origin = centre[0] + expected.alpha @ centre[1:]
        moved = np.einsum("irc,ic->ir", expected.motion, origin)
        assert_allclose(fits.translation, expected.translation - moved, atol=1e-10)

    @pytest.mark.parametrize("gaps", [False, True])
    @pytest.mark.parametrize("stretch", [1.0, 1e3])
    def test_affinity_of_space(self, gaps, stretch):
        tracks, shapes, _ = random_scene(0)
        if gaps:
            tracks = with_gaps(tracks, 0)
        A = random_rotation(0) @ np.diag([stretch, 1, 1 / stretch]) @ random_rotation(1)
        expected = fit_posterior(tracks, shapes, NOISE**2)
        fits = fit_posterior(tracks, A @ shapes, NOISE**2)
        assert_allclose(fits.alpha, expected.alpha, atol=1e-9)
        assert_allclose(fits.motion @ A, expected.motion, atol=1e-9)
        assert_allclose(fits.covariance, expected.covariance, atol=1e-9)

    @pytest.mark.parametrize("gaps", [False, True])
    def test_rotation_of_the_coefficients(self, gaps):
        tracks, shapes, _ = random_scene(0)
        if gaps:
            tracks = with_gaps(tracks, 0)
        Q = random_rotation(0)
        mixed = np.concatenate([shapes[:1], np.tensordot(Q, shapes[1:], 1)])
        expected = fit_posterior(tracks, shapes, NOISE**2)
        fits = fit_posterior(tracks, mixed, NOISE**2)
        assert_allclose(fits.alpha @ Q, expected.alpha, atol=1e-9)
        assert_allclose(Q.T @ fits.covariance @ Q, expected.covariance, atol=1e-9)
        assert_allclose(fits.motion, expected.motion, atol=1e-9)

    def test_affinities_of_single_images_of_exact_tracks(self):
        tracks, shapes, (_, _, alpha) = random_scene(0, noise=0.0)
        A = np.random.default_rng(1).normal(size=(len(tracks), 2, 2))
        fits = fit_posterior(with_gaps(tracks, 0) @ A, shapes, 0.0)
        assert_allclose(fits.alpha, alpha, atol=1e-7)

    @pytest.mark.parametrize("gaps", [False, True])
    def test_rotation_and_position_of_single_images(self, gaps):
        tracks, shapes, _ = random_scene(0)
        if gaps:
            tracks = with_gaps(tracks, 0)
        angle = np.random.default_rng(1).uniform(0, 6, len(tracks))
        c, s = np.cos(angle), np.sin(angle)
        R = np.stack([np.stack([c, -s], -1), np.stack([s, c], -1)], 1)
        moved = tracks @ R.swapaxes(1, 2) + 100.0
        expected = fit_posterior(tracks, shapes, NOISE**2)
        fits = fit_posterior(moved, shapes, NOISE**2)
        assert_allclose(fits.alpha, expected.alpha, atol=1e-9)
        assert_allclose(fits.motion, R @ expected.motion, atol=1e-9)

    @pytest.mark.parametrize("unit", [1e-100, 1e-6, 1e6, 1e100])
    def test_units_of_single_images(self, unit):
        tracks, shapes, _ = random_scene(0)
        units = unit ** np.random.default_rng(1).random(len(tracks))
        expected = fit_posterior(tracks, shapes, NOISE**2)
        for given in (tracks, with_gaps(tracks, 0)):
            expected = fit_posterior(given, shapes, NOISE**2)
            scaled = units[:, None, None] * given
            fits = fit_posterior(scaled, shapes, (units * NOISE) ** 2)
            assert_allclose(fits.alpha, expected.alpha, atol=1e-10)
            assert_allclose(fits.covariance, expected.covariance, atol=1e-10)
            motion = fits.motion / units[:, None, None]
            assert_allclose(motion, expected.motion, atol=1e-10)


class TestDegenerate:
    def shapes_of(self, kind, shapes):
        shapes, A = shapes.copy(), np.random.default_rng(5).normal(size=(3, 3))
        if kind == "flat mean shape":
            shapes[0, 2] = 0
        elif kind == "flat":
            shapes[:, 2] = 0
        elif kind == "on a line":
            shapes[:, 1:] = 0
        elif kind == "no mean shape":
            shapes[0] = 0
        elif kind == "no basis shape":
            shapes[2] = 0
        elif kind == "rigid":
            shapes[1:] = 0
        elif kind == "a point":
            shapes[:] = 0
        elif kind == "equal basis shapes":
            shapes[2] = shapes[1]
        elif kind == "basis shape that a camera makes":
            shapes[1] = np.diag([1.0, 2.0, 3.0]) @ shapes[0]
        elif kind == "basis shape that a scale makes":
            shapes[1] = 0.5 * shapes[0]
        elif kind == "huge basis shapes":
            shapes[1:] *= 1e6
        elif kind == "tiny basis shapes":
            shapes[1:] *= 1e-9
        return A @ shapes

    @pytest.mark.parametrize(
        "kind",
        [
            "flat mean shape",
            "flat",
            "on a line",
            "no mean shape",
            "no basis shape",
            "rigid",
            "a point",
            "equal basis shapes",
            "basis shape that a camera makes",
            "basis shape that a scale makes",
            "huge basis shapes",
            "tiny basis shapes",
        ],
    )
    @pytest.mark.parametrize("variance", [0.0, NOISE**2])
    def test_finite_and_no_worse_than_rigid(self, kind, variance):
        tracks, shapes, _ = random_scene(0)
        shapes = self.shapes_of(kind, shapes)
        rigid = fit_posterior(tracks, shapes[:1], 1.0)
        for given in (tracks, with_gaps(tracks, 0)):
            fits = fit_posterior(given, shapes, variance, starts=np.ones((2, 3)))
            for each in numbers_of(fits):
                assert np.isfinite(each).all()
            got = cost(given, shapes, variance, fits)
            rigid = fit_posterior(given, shapes[:1], 1.0)
            before = cost(given, shapes[:1], 1.0, rigid)
            assert (got <= before * (1 + 1e-6)).all()

    def test_flat_shapes_have_cameras_that_are_zero_across(self):
        tracks, shapes, _ = random_scene(0)
        shapes[:, 2] = 0
        R = random_rotation(0)
        fits = fit_posterior(tracks, R @ shapes, NOISE**2)
        assert_allclose(fits.motion @ R[:, 2], 0, atol=1e-12)
        fits = fit_posterior(tracks, (R @ shapes)[:1], NOISE**2)
        assert_allclose(fits.motion @ R[:, 2], 0, atol=1e-12)

    def test_saddle_of_a_flat_shape_that_bends(self):
        # The camera does not see across the flat mean shape, so that neither a bend
        # to one side nor one to the other shows at zero; any small one does.
        rng = np.random.default_rng(0)
        shapes = rng.normal(size=(2, 3, 20))
        shapes[0, 2] = 0.0
        shapes[1, :2] = 0.0
        shapes -= shapes.mean(axis=2, keepdims=True)
        motion, alpha = rng.normal(size=(10, 2, 3)), rng.normal(size=(10, 1))
        tracks = images(shapes, motion, np.zeros((10, 2)), alpha)
        tracks += NOISE * rng.normal(size=tracks.shape)
        zero = fit_posterior(tracks, shapes, NOISE**2)
        for each in numbers_of(zero):
            assert np.isfinite(each).all()

    def test_basis_shape_of_zeros_has_the_prior(self):
        tracks, shapes, _ = random_scene(0)
        padded = np.concatenate([shapes, np.zeros_like(shapes[:1])])
        expected = fit_posterior(tracks, shapes, NOISE**2)
        fits = fit_posterior(tracks, padded, NOISE**2)
        assert_array_equal(fits.alpha[:, 3], 0)
        assert_allclose(fits.covariance[:, 3, 3], 1)
        assert_allclose(fits.alpha[:, :3], expected.alpha, atol=1e-10)

    def test_no_basis_shape_is_the_rigid_fit(self):
        tracks, shapes, _ = random_scene(0)
        fits = fit_posterior(tracks, shapes[:1], NOISE**2)
        assert fits.alpha.shape == (30, 0)
        assert fits.covariance.shape == (30, 0, 0)
        assert fits.converged.all()
        W = (tracks - tracks.mean(axis=1, keepdims=True)).swapaxes(1, 2)
        assert_allclose(fits.motion, W @ np.linalg.pinv(shapes[0]), atol=1e-11)

    def test_frames_that_determine_no_camera(self):
        tracks, shapes, _ = random_scene(0, n_frames=8)
        shapes[0, 0, :6] = 0.3  # six points in a plane
        shapes[0] -= shapes[0].mean(axis=1, keepdims=True)
        tracks[0] = np.nan
        tracks[1, 1:] = np.nan
        tracks[2, 3:] = np.nan
        tracks[3, 6:] = np.nan
        tracks[4, :-4] = np.nan
        tracks[5, ::2, 0] = np.nan
        fits = fit_posterior(tracks, shapes, NOISE**2, starts=np.ones((1, 3)))
        expected = np.arange(8) >= 4
        for each in numbers_of(fits):
            finite = np.isfinite(each.reshape(8, -1))
            assert_array_equal(finite.all(axis=1), expected)
            assert_array_equal(finite.any(axis=1), expected)
        assert_array_equal(fits.converged, expected)

    def test_all_points_of_a_frame_equal(self):
        tracks, shapes, _ = random_scene(0, n_frames=3)
        tracks[1] = tracks[1, 0]
        for variance in (0.0, NOISE**2):
            fits = fit_posterior(tracks, shapes, variance)
            assert_allclose(fits.motion[1], 0, atol=1e-12)
            assert_allclose(fits.alpha[1], 0, atol=1e-12)
            assert_allclose(fits.translation[1], tracks[1, 0])

    def test_no_frames(self):
        _, shapes, _ = random_scene(0)
        fits = fit_posterior(np.zeros((0, 20, 2)), shapes, 1.0)
        assert fits.motion.shape == (0, 2, 3)


@pytest.fixture(scope="module")
def mocap(load_data):
    """Return the tracks of a moving body, and shapes that explain them."""
    return fitted_shapes(load_data("akhter_yoga")["W2d"], 2)


def fitted_shapes(tracks, n_components):
    """Return unit-scaled tracks, shapes, starts and noise variance of a fit to them."""
    model = AffineNRSfM(n_components, random_state=0)
    model.fit(tracks.reshape(len(tracks), -1).astype(float))
    centred = tracks - tracks.mean(axis=1, keepdims=True)
    size = np.sqrt(np.mean(centred**2, axis=(1, 2), keepdims=True))
    frames = model._model.frames
    return centred / size, frames.shapes, frames.starts, frames.noise_variance


class TestStarts:
    def best(self, tracks, shapes, variance):
        """Return the least objectives from twenty random starts."""
        rng = np.random.default_rng(0)
        starts = rng.normal(size=(20, len(shapes) - 1)) * np.repeat([1, 2], 10)[:, None]
        found = [fit_posterior(tracks, shapes, variance).objective]
        for start in starts:
            initial = np.tile(start, (len(tracks), 1))
            fits = fit_posterior(tracks, shapes, variance, initial=initial)
            found.append(fits.objective)
        return np.min(found, axis=0)

    def test_large_motion_needs_them(self, mocap):
        tracks, shapes, starts, variance = mocap
        least = self.best(tracks, shapes, variance)
        zero = fit_posterior(tracks, shapes, variance)
        fits = fit_posterior(tracks, shapes, variance, starts=starts)
        assert (fits.objective <= zero.objective).all()
        assert (zero.objective > 1.1 * least).any()
        assert np.mean(fits.objective <= 1.001 * least) >= 0.995

    @pytest.mark.slow
    @pytest.mark.parametrize("gaps", [0.0, 0.4])
    def test_faces_do_not(self, load_data, gaps):
        tracks = load_data("faces_wild_68_combined")["W2d"][::8]
        tracks, shapes, _, variance = fitted_shapes(tracks, 9)
        tracks = with_gaps(tracks[::2], 0, gaps)
        least = self.best(tracks, shapes, variance)
        fits = fit_posterior(tracks, shapes, variance)
        assert np.mean(fits.objective <= 1.001 * least) >= 0.995
        assert fits.converged.all()

    def test_every_search_ends_in_a_minimum(self, mocap):
        tracks, shapes, _, variance = mocap
        search, problem = problem_of(tracks, shapes, variance)
        rng = np.random.default_rng(0)
        for size in (0.0, 1.0, 3.0):
            start = size * rng.normal(size=(len(shapes) - 1, len(tracks)))
            before = search.evaluate(problem, start)
            found, there = search.descend(problem, before, MAX_STEPS)
            state = search.evaluate(problem, found)
            assert (state.value <= before.value + 1e-12 * problem.energy).all()
            assert there.mean() > 0.995
            assert (np.linalg.eigvalsh(unpacked(state.hessian).T)[there] > 0).all()
            step, _ = state.newton_step(np.zeros(len(tracks)))
            assert np.abs(step[:, there]).max() < 1e-7

    def test_a_start_leads_to_the_minimum_it_is_in(self):
        tracks, shapes, (_, _, alpha) = random_scene(0)
        expected = fit_posterior(tracks, shapes, NOISE**2)
        # From the truth of each frame the search ends in the same place.
        search, problem = problem_of(tracks, shapes, NOISE**2)
        start = search.evaluate(problem, alpha.T.copy())
        found, converged = search.descend(problem, start, MAX_STEPS)
        assert_allclose(found.T, expected.alpha, atol=1e-9)
        assert converged.all()

    def test_frames_that_the_noise_explains_keep_theirs(self):
        tracks, shapes, _ = random_scene(0)
        starts = np.random.default_rng(1).normal(size=(5, 3))
        tracks[3] += 0.5 * np.random.default_rng(2).normal(size=(20, 2))
        # By the chi-squared distribution of their objectives
        poor = fit_posterior(tracks, shapes, NOISE**2).objective > 3 * 32 * NOISE**2
        assert poor[3]
        assert np.sum(poor) <= 2
        expected = fit_posterior(tracks, shapes, NOISE**2)
        fits = fit_posterior(tracks, shapes, NOISE**2, starts=starts)
        assert_same_fits(fits, expected, atol=1e-11)

    def test_minima_of_single_frames_do_not_depend_on_the_others(self, mocap):
        tracks, shapes, starts, variance = mocap
        zero = fit_posterior(tracks, shapes, variance)
        together = fit_posterior(tracks, shapes, variance, starts=starts)
        found = np.flatnonzero(together.objective < zero.objective)[:5]
        assert len(found)
        for i in found:
            alone = fit_posterior(tracks[i : i + 1], shapes, variance, starts=starts)
            assert_allclose(alone.alpha[0], together.alpha[i], atol=1e-8)


class TestSpreadStarts:
    def test_by_hand(self):
        alpha = np.array([[1.0, 0], [0, 4], [0, -3], [3, 0], [np.nan, 9], [0, 3.9]])
        assert_array_equal(spread_starts(alpha, 3), [[0, 4], [0, -3], [3, 0]])

    def test_far_from_each_other_and_from_zero(self):
        alpha = np.random.default_rng(0).normal(size=(500, 3))
        starts = np.concatenate([np.zeros((1, 3)), spread_starts(alpha, 6)])
        between = np.linalg.norm(starts[:, None] - starts, axis=2)
        apart = between[np.triu_indices(7, 1)].min()
        # No row is farther from all of them than they are from each other.
        left = np.linalg.norm(alpha[:, None] - starts, axis=2).min(axis=1)
        assert left.max() <= apart

    def test_order_of_the_frames(self):
        alpha = np.random.default_rng(0).normal(size=(50, 3))
        assert_array_equal(spread_starts(alpha[::-1], 5), spread_starts(alpha, 5))

    def test_fewer_than_wanted(self):
        assert_array_equal(spread_starts(np.array([[1.0], [1.0]]), 4), [[1.0]])
        assert spread_starts(np.zeros((5, 2)), 4).shape == (0, 2)
        assert spread_starts(np.zeros((0, 2)), 4).shape == (0, 2)
        assert spread_starts(np.zeros((5, 0)), 4).shape == (0, 0)
