"""The most probable camera, position and coefficients of frames, by Newton's method."""

from typing import NamedTuple

import numpy as np
import pytest
import scenes
from frame_parts import (
    assert_same_fits,
    camera_and_alpha,
    fit_posterior,
    numbers_of,
)
from layers import slow_after
from numpy.testing import assert_allclose, assert_array_equal
from scenes import images, random_rotation, random_scene, with_gaps

from isa_nrsfm import AffineNRSfM
from isa_nrsfm._frames.camera_models import CAMERAS
from isa_nrsfm._frames.models import spread_starts
from isa_nrsfm._frames.point_sums import frame_sums, frame_tracks
from isa_nrsfm._frames.search import MAX_STEPS, FrameSearch, State, scale_of
from isa_nrsfm._linalg.small_matrices import LANES, unpacked
from isa_nrsfm._tables.blocks import block_slices

AS_USERS = ["few_frames", "widths"]
NOISE = 0.02
CAMERA = pytest.mark.parametrize(
    "camera", ["affine", "weak_perspective", "orthographic"]
)
GAPS = pytest.mark.parametrize("gaps", [False, True])


def scene_of(camera, gaps=False, noise=NOISE, n_frames=20):
    """Return a scene of three basis shapes, maybe with missing points."""
    options = {"noise": noise, "camera": camera, "deformation": 0.2}
    scene = random_scene(0, n_frames, extent=(1.0, 0.8, 0.6), **options)
    return scene._replace(tracks=with_gaps(scene.tracks)) if gaps else scene


def fitted(scene, camera, noise=NOISE**2, **given):
    return fit_posterior(scene.tracks, scene.shapes, noise, camera, **given)


@GAPS
@CAMERA
class TestExact:
    def test_truth_is_found(self, camera, gaps):
        scene = scene_of(camera, gaps, noise=0.0)
        fits = fitted(scene, camera, 0.0)
        for got, true in zip(
            camera_and_alpha(fits), camera_and_alpha(scene), strict=True
        ):
            assert_allclose(got, true, atol=1e-8)
        assert fits.converged.all()
        assert_allclose(fits.objective, 0, atol=1e-9)

    def test_position_is_that_of_least_squares(self, camera, gaps):
        scene = scene_of(camera, gaps)
        rest = scene.tracks - images(
            scene.shapes, *camera_and_alpha(fitted(scene, camera))
        )
        assert_allclose(np.nanmean(rest, axis=1), 0.0, atol=1e-12)

    def test_prepared_and_rough_frames(self, camera, gaps):
        scene = scene_of(camera, gaps)
        frames = frame_tracks(
            scene.tracks.transpose(0, 2, 1), np.isfinite(scene.tracks[..., 0]) * 1.0
        )
        search = FrameSearch(scene.shapes, CAMERAS[camera])
        expected = fitted(scene, camera)
        assert_same_fits(search.fit(frames, NOISE**2), expected, 1e-8)
        rough = search.fit(frames, NOISE**2, rough=True)
        away = np.abs(rough.motion - expected.motion).max(axis=(1, 2))
        assert np.median(away) < 0.1


@CAMERA
class TestInvariance:
    def test_frames_are_separate(self, camera):
        scene = scene_of(camera)
        scene.tracks[10:] = with_gaps(scene.tracks[10:])
        scene.tracks[15, 3:] = np.nan
        noise = np.geomspace(1e-6, 1.0, 20)
        together = fitted(scene, camera, noise)
        assert np.isnan(together.alpha[15]).all()
        for i in range(20):
            one = scene._replace(tracks=scene.tracks[i : i + 1])
            alone = fitted(one, camera, noise[i])
            for got, expected in zip(alone, together, strict=True):
                assert_allclose(got[0], expected[i], rtol=1e-8, atol=1e-9)

    def test_more_frames_than_a_block(self, camera):
        scene = scene_of(camera, n_frames=8)
        scene.tracks[::2] = with_gaps(scene.tracks[::2])
        often = np.tile(np.arange(8), 520)
        got = fitted(scene._replace(tracks=scene.tracks[often]), camera)
        assert_same_fits(got, fitted(scene, camera).take(often), 1e-10)

    def test_fits_are_the_same_without_covariances(self, camera):
        scene = scene_of(camera)
        scene.tracks[10:] = with_gaps(scene.tracks[10:])
        starts = np.ones((2, 3))
        expected = fitted(scene, camera, starts=starts)._asdict()
        got = fitted(scene, camera, starts=starts, covariances=False)._asdict()
        assert got.pop("covariance").shape == (20, 0, 0)
        assert np.isnan(got.pop("turn_covariance")).all()
        for name, value in got.items():
            assert_array_equal(value, expected[name])

    @GAPS
    @pytest.mark.parametrize("unit", [1e-100, 1e100])
    def test_units(self, camera, gaps, unit):
        # Of single images, or of the whole table and the shapes
        scene = scene_of(camera, gaps)
        units, shapes = unit ** np.random.default_rng(1).random(20), scene.shapes
        if camera == "orthographic":
            units, shapes = np.full(20, unit), unit * shapes
        tracks = units[:, None, None] * scene.tracks
        expected = fitted(scene, camera)
        got = fitted(
            scene._replace(tracks=tracks, shapes=shapes), camera, (units * NOISE) ** 2
        )
        scale = 1.0 if camera == "orthographic" else units[:, None, None]
        assert_allclose(got.motion / scale, expected.motion, atol=1e-9)
        assert_allclose(got.alpha, expected.alpha, atol=1e-9)
        assert_allclose(got.covariance, expected.covariance, atol=1e-9)


# What is done to shapes (4, 3, n_points), in place
KINDS = {
    "flat mean shape": lambda B: B[0, 2].fill(0),
    "flat": lambda B: B[:, 2].fill(0),
    "on a line": lambda B: B[:, 1:].fill(0),
    "no mean shape": lambda B: B[0].fill(0),
    "no basis shape": lambda B: B[2].fill(0),
    "rigid": lambda B: B[1:].fill(0),
    "a point": lambda B: B.fill(0),
    "equal basis shapes": lambda B: np.copyto(B[2], B[1]),
    "basis shape that a camera makes": lambda B: np.copyto(
        B[1], np.diag([1.0, 2.0, 3.0]) @ B[0]
    ),
    "basis shape that a scale makes": lambda B: np.copyto(B[1], 0.5 * B[0]),
    "basis shape that a turn makes": lambda B: np.copyto(
        B[1], np.array([[0, -0.2, 0], [0.2, 0, 0], [0, 0, 0]]) @ B[0]
    ),
    "huge basis shapes": lambda B: np.multiply(B[1:], 1e6, out=B[1:]),
    "tiny basis shapes": lambda B: np.multiply(B[1:], 1e-9, out=B[1:]),
}


@CAMERA
class TestDegenerate:
    @pytest.mark.parametrize("kind", KINDS)
    @pytest.mark.parametrize("variance", slow_after(1, [0.0, NOISE**2]))
    def test_stays_finite_and_no_worse_than_rigid(self, camera, kind, variance):
        scene = scene_of(camera)
        shapes = scene.shapes.copy()
        KINDS[kind](shapes)
        shapes = random_rotation(5) @ shapes
        scene.tracks[10:] = with_gaps(scene.tracks[10:])
        starts = np.ones((2, 3))
        fits = fit_posterior(scene.tracks, shapes, variance, camera, starts=starts)
        for each in numbers_of(fits):
            assert np.isfinite(each).all()
        variances = np.diagonal(fits.covariance, axis1=1, axis2=2)
        assert (variances >= 0).all()
        if camera == "affine":
            rigid = fit_posterior(scene.tracks, shapes[:1], 1.0)
            assert (fits.objective <= rigid.objective * (1 + 1e-6)).all()

    def test_no_basis_shape_is_the_rigid_fit(self, camera):
        scene = scene_of(camera)
        fits = fitted(scene._replace(shapes=scene.shapes[:1]), camera)
        assert fits.alpha.shape == (20, 0)
        assert fits.covariance.shape == (20, 0, 0)
        assert fits.converged.all()
        if camera == "affine":
            W = scene.centred.swapaxes(1, 2)
            expected = W @ np.linalg.pinv(scene.shapes[0])
            assert_allclose(fits.motion, expected, atol=1e-11)

    def test_basis_shape_of_zeros_has_the_prior(self, camera):
        scene = scene_of(camera)
        padded = np.concatenate([scene.shapes, np.zeros_like(scene.shapes[:1])])
        expected = fitted(scene, camera)
        fits = fitted(scene._replace(shapes=padded), camera)
        assert_array_equal(fits.alpha[:, 3], 0.0)
        assert_allclose(fits.covariance[:, 3, 3], 1.0)
        assert_allclose(fits.alpha[:, :3], expected.alpha, atol=1e-8)

    def test_frames_that_determine_no_camera(self, camera):
        scene = scene_of(camera, n_frames=8)
        scene.shapes[0, 0, :6] = 0.3  # six points in a plane
        scene.shapes[0] -= scene.shapes[0].mean(axis=1, keepdims=True)
        tracks = scene.tracks
        tracks[0] = np.nan
        tracks[1, 1:] = np.nan
        tracks[2, 3:] = np.nan
        tracks[3, 6:] = np.nan
        tracks[4, :-4] = np.nan
        tracks[5, ::2, 0] = np.nan
        fits = fitted(scene, camera, starts=np.ones((1, 3)))
        expected = np.arange(8) >= 4
        for each in numbers_of(fits):
            finite = np.isfinite(each.reshape(8, -1))
            assert_array_equal(finite.all(axis=1), expected)
            assert_array_equal(finite.any(axis=1), expected)
        assert not fits.converged[~expected].any()

    @pytest.mark.parametrize("variance", [0.0, NOISE**2])
    def test_all_points_of_a_frame_equal(self, camera, variance):
        scene = scene_of(camera, n_frames=3)
        scene.tracks[1] = scene.tracks[1, 0]
        fits = fitted(scene, camera, variance)
        for each in numbers_of(fits):
            assert np.isfinite(each).all()
        # The centroids are what it shows.
        rest = scene.tracks - images(scene.shapes, *camera_and_alpha(fits))
        assert_allclose(rest.mean(axis=1), 0.0, atol=1e-12)
        if camera == "affine":
            assert_allclose(fits.motion[1], 0, atol=1e-12)
            assert_allclose(fits.alpha[1], 0, atol=1e-12)

    def test_no_frames(self, camera):
        scene = scene_of(camera)
        fits = fitted(scene._replace(tracks=np.zeros((0, 20, 2))), camera)
        assert fits.motion.shape == (0, 2, 3)


@pytest.mark.parametrize(
    ("n", "length"), [(0, 5), (1, 5), (2, 1), (11, 5), (12, 11), (13, 12), (13, 40)]
)
def test_no_block_of_several_has_one_frame(n, length):
    slices = block_slices(n, length)
    assert [i for part in slices for i in range(n)[part]] == list(range(n))
    lengths = [part.stop - part.start for part in slices]
    assert all(1 < each <= length + 1 for each in lengths[-1:] if n > 1)
    assert lengths[:-1] == [length] * (len(slices) - 1)


def noisy_scene(seed, noise=NOISE, n_frames=30):
    """Return tracks, shapes (n_components + 1, 3, n_points) and what made them."""
    scene = scenes.random_scene(seed, n_frames, noise=noise)
    return scene.tracks, scene.shapes, camera_and_alpha(scene)


def problem_of(tracks, shapes, variance, weights=None):
    """Return the search for shapes, and the frames as it takes them."""
    search = FrameSearch(shapes, CAMERAS["affine"])
    products = frame_sums(
        frame_tracks(tracks.transpose(0, 2, 1), weights), search.shared
    )
    return search, search.problem(products, np.full(len(tracks), variance))


class TestSpecial:
    def test_flat_shapes_have_cameras_that_are_zero_across(self):
        tracks, shapes, _ = noisy_scene(0)
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

    def test_every_search_ends_in_a_minimum(self, mocap):
        tracks, shapes, _, variance = mocap
        search, problem = problem_of(tracks, shapes, variance)
        rng = np.random.default_rng(0)
        for size in (0.0, 1.0, 3.0):
            alpha = size * rng.normal(size=(len(shapes) - 1, len(tracks)))
            before = search.evaluate(problem, search.start(problem, alpha))
            found, there = search.descend(problem, before, MAX_STEPS)
            state = search.evaluate(problem, found)
            assert (state.value <= before.value + 1e-12 * scale_of(problem)).all()
            assert there.mean() > 0.995
            assert (np.linalg.eigvalsh(unpacked(state.hessian).T)[there] > 0).all()
            step, _ = search.step(state, np.zeros(len(tracks)))
            assert np.abs(step[:, there]).max() < 1e-7

    def test_frames_that_the_noise_explains_keep_theirs(self):
        tracks, shapes, _ = noisy_scene(0)
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


class Frames(NamedTuple):
    a: np.ndarray
    energy: np.ndarray


class Wells(FrameSearch):
    """The functions ``x^4 / 4 - a x^2 / 2`` of frames, with minima ``+- sqrt(a)``."""

    def __init__(self, a, energy=1.0):
        a = np.array(a, dtype=float)
        self.problem = Frames(a, np.full_like(a, energy)), np.zeros_like(a)
        self.tried = []  # numbers of frames
        self.model = CAMERAS["affine"]  # steps are added

    def value(self, x, a):
        return x[0] ** 4 / 4 - a * x[0] ** 2 / 2

    def evaluate(self, problem, x):
        self.tried.append(x.shape[1])
        a = problem[0].a
        slope, hessian, value = a * x - x**3, 3 * x**2 - a, self.value(x, a)
        return State(x, value, slope / 2, np.ones_like(x), hessian / 2)


def ended(wells, start, max_steps=60, known=None):
    start = wells.evaluate(wells.problem, np.array([start], dtype=float))
    found, converged = wells.descend(wells.problem, start, max_steps, known)
    return found[0], converged


class TestMinima:
    def test_steps_that_raise_the_value_are_refused(self):
        # The Newton step from here, x = 0.6, is beyond the other minimum and higher.
        problem = Wells([1.0])
        state = problem.evaluate(problem.problem, np.array([[0.6]]))
        step, _ = problem.step(state, np.zeros(1))
        assert problem.value(state.position + step, 1.0) > state.value
        found, converged = ended(problem, [0.6])
        assert_allclose(np.abs(found), 1.0, rtol=1e-7)
        assert converged.all()
        assert_array_equal(ended(problem, [0.6], 1)[0], [0.6])


class TestEnds:
    def test_frames_that_have_ended_are_not_evaluated(self):
        # Those that are left are filled up to a multiple of LANES.
        problem = Wells([1.0] * 3 * LANES)
        ended(problem, np.repeat([1.0, 1.0 + 1e-3, 20.0], LANES))
        assert problem.tried[:2] == [3 * LANES, 2 * LANES]
        assert problem.tried == sorted(problem.tried, reverse=True)
        assert problem.tried[-1] == LANES

    def test_tolerance_is_a_share_of_the_energy(self):
        exact, _ = ended(Wells([1.0]), [3.0])
        rough, _ = ended(Wells([1.0], energy=1e10), [3.0])
        assert 1e-9 < abs(rough[0] - 1.0) < 0.1
        assert abs(exact[0] - 1.0) < 1e-12

    def test_search_is_given_up_where_the_known_minimum_is_out_of_reach(self):
        # The minimum of both is -1/4.
        known = np.zeros((1, 2)), np.array([-10.0, -0.2]), np.zeros(2)
        found, converged = ended(Wells([1.0, 1.0]), [1.1, 1.1], known=known)
        assert_array_equal(converged, [False, True])
        assert found[0] == 1.1
        assert_allclose(found[1], 1.0, rtol=1e-7)

    def test_search_is_given_up_in_the_well_of_the_known_minimum(self):
        known = np.ones((1, 2)), np.full(2, -0.3), np.array([0.2, 0.01])
        found, converged = ended(Wells([1.0, 1.0]), [1.5, 1.5], 3, known)
        steps = [ended(Wells([1.0]), [1.5], n)[0][0] for n in range(4)]
        first = next(x for x in steps if abs(x - 1.0) < 0.2)
        assert found[0] == first
        assert abs(found[1] - 1.0) < abs(found[0] - 1.0)
        assert not converged[0]

    def test_largest_damping_ends_the_search(self):
        # A value that is always higher than at the start: no step is taken.
        class Walls(Wells):
            def value(self, x, a):
                return np.where(x[0] == 0.5, 0.0, 1.0)

        problem = Walls([1.0])
        found, converged = ended(problem, [0.5], 1000)
        assert_array_equal(found, [0.5])
        assert not converged.any()
        assert len(problem.tried) < 30
