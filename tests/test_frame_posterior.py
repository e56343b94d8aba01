"""The most probable camera, position and coefficients of single frames."""

import numpy as np
import pytest
import scenes
from frame_parts import assert_same_fits, camera_and_alpha, fit_posterior
from numpy.testing import assert_allclose, assert_array_equal
from scenes import images, random_rotation, with_gaps

from isa_nrsfm import AffineNRSfM
from isa_nrsfm._frames.models import spread_starts
from isa_nrsfm._frames.newton import AffineSearch
from isa_nrsfm._frames.point_sums import frame_sums, frame_tracks
from isa_nrsfm._frames.search import MAX_STEPS
from isa_nrsfm._linalg.small_matrices import unpacked

NOISE = 0.02


def random_scene(seed, noise=NOISE, n_frames=30):
    """Return tracks, shapes (n_components + 1, 3, n_points) and what made them."""
    scene = scenes.random_scene(seed, n_frames, noise=noise)
    return scene.tracks, scene.shapes, camera_and_alpha(scene)


def cost(tracks, shapes, variance, fits):
    """Return f of each frame by its definition."""
    difference = tracks - images(shapes, fits.motion, fits.translation, fits.alpha)
    squares = np.nansum(difference**2, axis=(1, 2))
    return squares + variance * np.sum(fits.alpha**2, axis=1)


def energy_of(tracks):
    """Return the largest energy of a frame; rounding errors are relative to it."""
    centred = tracks - np.nanmean(tracks, axis=1, keepdims=True)
    return np.nansum(centred**2, axis=(1, 2)).max()


def problem_of(tracks, shapes, variance, weights=None):
    """Return the search for shapes, and the frames as it takes them."""
    search = AffineSearch(shapes)
    products = frame_sums(
        frame_tracks(tracks.transpose(0, 2, 1), weights), search.shared
    )
    return search, search.problem(products, np.full(len(tracks), variance))


class TestOptimum:
    @pytest.mark.parametrize("gaps", [False, True])
    def test_objective_by_definition_rises_in_every_direction(self, gaps):
        tracks, shapes, _ = random_scene(0)
        if gaps:
            tracks = with_gaps(tracks)
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

    @pytest.mark.parametrize("gaps", [False, True])
    def test_covariance_is_that_of_all_unknowns_together(self, gaps):
        tracks, shapes, _ = random_scene(0, n_frames=4)
        if gaps:
            tracks = with_gaps(tracks)
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


class TestSpecial:
    @pytest.mark.parametrize("n_frames", [30, 32])
    def test_complete_frames_among_others(self, n_frames):
        tracks, shapes, _ = random_scene(0, n_frames=32)
        tracks[::7] = with_gaps(tracks[::7], 0)
        expected = fit_posterior(tracks[:23], shapes, NOISE**2)
        fits = fit_posterior(tracks[:n_frames], shapes, NOISE**2)
        assert_array_equal(fits.motion[:23], expected.motion)

    def test_flat_shapes_have_cameras_that_are_zero_across(self):
        tracks, shapes, _ = random_scene(0)
        shapes[:, 2] = 0
        R = random_rotation(0)
        fits = fit_posterior(tracks, R @ shapes, NOISE**2)
        assert_allclose(fits.motion @ R[:, 2], 0, atol=1e-12)
        fits = fit_posterior(tracks, (R @ shapes)[:1], NOISE**2)
        assert_allclose(fits.motion @ R[:, 2], 0, atol=1e-12)


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
        tracks = with_gaps(tracks[::2], gaps)
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
            step, _ = search.step(state, np.zeros(len(tracks)))
            assert np.abs(step[:, there]).max() < 1e-7

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


class TestSpreadStarts:
    def test_by_hand(self):
        alpha = np.array([[1.0, 0], [0, 4], [0, -3], [3, 0], [np.nan, 9], [0, 3.9]])
        assert_array_equal(spread_starts(alpha, 3), [[0, 4], [0, -3], [3, 0]])

    def test_order_of_the_frames(self):
        alpha = np.random.default_rng(0).normal(size=(50, 3))
        assert_array_equal(spread_starts(alpha[::-1], 5), spread_starts(alpha, 5))

    def test_fewer_than_wanted(self):
        assert_array_equal(spread_starts(np.array([[1.0], [1.0]]), 4), [[1.0]])
        assert spread_starts(np.zeros((5, 2)), 4).shape == (0, 2)
        assert spread_starts(np.zeros((0, 2)), 4).shape == (0, 2)
        assert spread_starts(np.zeros((5, 0)), 4).shape == (0, 0)
