"""The joint refinement: a minimum of the objective, reached and recognised."""

from types import SimpleNamespace

import numpy as np
import pytest
import scenes
from frame_parts import assert_calibrated
from layers import slow_after
from made_once import made_once
from numpy.testing import assert_allclose, assert_array_equal
from scenes import likelihood_of

from isa_nrsfm._frames.camera_models import CAMERAS, AffineCameras
from isa_nrsfm._joint.problem import NOISE_FLOOR, JointState, _line_search, refine_joint
from isa_nrsfm._linalg import centred, frames_first, frames_last, unpack3

DEVIATION = 0.03
AFFINE = CAMERAS["affine"]


def random_scene(noise=DEVIATION, kind="complete", camera="affine", K=2):
    """Return tracks that follow the model, their weights, and the state that made them.

    Tracks (n_frames, n_points, 2) are centred where all points are seen.
    """
    options = {"noise": noise, "kind": kind, "camera": camera, "deformation": 0.25}
    scene = scenes.random_scene(0, 30, 18, K, **options)
    truth = JointState(scene.shapes, scene.motion, max(noise, 1e-3) ** 2)
    tracks = scene.centred if scene.weights is None else scene.tracks
    return SimpleNamespace(tracks=tracks, weights=scene.weights, truth=truth)


def moved(cameras, motion, step):
    """Return cameras (n_frames, 2, 3) after steps (n_parameters, n_frames)."""
    return frames_first(cameras.moved(frames_last(motion), step))


def disturbed(state, seed=1, size=0.1, cameras=AFFINE):
    """Return a state that is some way off, with cameras of the model."""
    rng = np.random.default_rng(seed)
    shapes = centred(state.shapes + size * rng.normal(size=state.shapes.shape))
    step = size * rng.normal(size=(cameras.n_parameters, len(state.motion)))
    return JointState(shapes, moved(cameras, state.motion, step), 5 * state.noise)


def problem_of(camera, penalty=0.0, **options):
    """Return the objective for cameras of a model, and a state to start from."""
    scene = random_scene(camera=camera, **options)
    likelihood = likelihood_of(scene.tracks, scene.weights, penalty)
    return likelihood, disturbed(scene.truth, cameras=CAMERAS[camera])


def scene_and_start(**options):
    """Return a table and a state that is some way off."""
    scene = random_scene(**options)
    return scene, disturbed(scene.truth)


def refined(scene, start=None, *, max_iter=1000, tol=1e-3):
    start = disturbed(scene.truth) if start is None else start
    likelihood = likelihood_of(scene.tracks, scene.weights, 0.0)
    return refine_joint(likelihood, start, AFFINE, max_iter=max_iter, tol=tol)


@made_once
def optimum(kind="complete"):
    """Return a minimum of the objective to many digits, and its table."""
    scene = random_scene(kind=kind)
    return scene, refined(scene, max_iter=5000, tol=1e-10)


def images(scene, result):
    """Return the images of the most probable shapes of the frames, centred."""
    shapes, motion, _ = result.state
    likelihood = likelihood_of(scene.tracks, scene.weights, 0.0)
    alpha = likelihood(*result.state).alpha
    return centred(motion @ (shapes[0] + np.tensordot(alpha, shapes[1:], 1)))


KINDS = pytest.mark.parametrize("kind", ["complete", "missing"])
ONE_KIND = pytest.mark.parametrize("kind", slow_after(1, ["complete", "missing"]))


@pytest.mark.parametrize("max_iter", [0, 4])
def test_max_iter_cuts_the_history_short(max_iter):
    scene = random_scene()
    whole, part = refined(scene), refined(scene, max_iter=max_iter)
    assert not part.converged
    assert_array_equal(part.history, whole.history[: max_iter + 1])


class TestOptimum:
    @ONE_KIND
    @pytest.mark.parametrize("size", slow_after(1, [0.2, 0.0]))
    def test_is_the_same_from_other_starts(self, kind, size):
        scene, expected = optimum(kind)
        start = disturbed(scene.truth, 2, size)
        got = refined(scene, start, tol=1e-7)
        assert got.history[-1] == pytest.approx(expected.history[-1], abs=1e-2)
        assert got.state.noise == pytest.approx(expected.state.noise, rel=1e-3)
        assert_allclose(images(scene, got), images(scene, expected), atol=1e-3)

    def test_memory_saves_steps(self):
        scene, best = optimum()
        with_memory = refined(scene, max_iter=150, tol=0.0).history[-1]
        state = disturbed(scene.truth)
        for _ in range(150):
            without = refined(scene, state, max_iter=1)
            state = without.state
        assert with_memory - best.history[-1] < 0.3 * (
            without.history[-1] - best.history[-1]
        )


class TestTolerance:
    @pytest.mark.parametrize("tol", [1.0, 1e-4])
    def test_is_of_two_steps_one_after_the_other_and_a_frame(self, tol):
        scene = random_scene()
        result = refined(scene, tol=tol)
        small = -np.diff(result.history) < tol * len(scene.tracks)
        assert result.converged
        assert small[-2:].all()
        assert not (small[:-2] & small[1:-1]).any()

    @ONE_KIND
    def test_of_zero_ends_where_rounding_errors_are_left(self, kind):
        scene, best = optimum(kind)
        result = refined(scene, best.state, tol=0.0, max_iter=5000)
        assert result.converged
        assert len(result.history) < 1000
        assert result.gradient_norm < 2e-6
        again = refined(scene, result.state, tol=0.0)
        assert again.converged
        assert len(again.history) < 10


@made_once
def optimum_of(camera, kind="complete"):
    """Return a minimum of the objective with cameras of a model."""
    likelihood, start = problem_of(camera, 1.0, kind=kind, K=1)
    result = refine_joint(likelihood, start, CAMERAS[camera], max_iter=5000, tol=1e-10)
    return likelihood, start, result


EACH = pytest.mark.parametrize("camera", CAMERAS)


@EACH
@KINDS
class TestCameras:
    def test_history_falls_and_cameras_stay_of_their_model(self, camera, kind):
        likelihood, start, result = optimum_of(camera, kind)
        assert result.converged
        assert (np.diff(result.history) < 0).all()
        assert result.history[0] == likelihood(*start).value
        assert result.history[-1] == likelihood(*result.state).value
        if camera != "affine":
            assert_calibrated(result.state.motion, camera, 1e-11)

    def test_objective_rises_in_every_direction(self, camera, kind):
        likelihood, _, result = optimum_of(camera, kind)
        cameras = CAMERAS[camera]
        assert result.gradient_norm < 5e-6
        rng = np.random.default_rng(2)
        shapes, motion, noise = result.state
        for _ in range(10):
            change = rng.normal(size=shapes.shape)
            step = rng.normal(size=(cameras.n_parameters, len(motion)))
            rises = []
            for size in (-1e-3, 1e-3):
                motions = moved(cameras, motion, size * step)
                noises = noise * np.exp(size)
                after = likelihood(shapes + size * change, motions, noises)
                rises.append(after.value - result.history[-1])
            assert min(rises) > 0
            assert_allclose(rises[0], rises[1], rtol=0.1)

    def test_gradient_norm_by_its_definition(self, camera, kind):
        # The gradient in the metric of the curvature, in units of the coordinates.
        cameras, (likelihood, start) = CAMERAS[camera], problem_of(camera, kind=kind)
        result = refine_joint(likelihood, start, cameras, max_iter=3, tol=1e-3)
        passed = likelihood(*result.state)
        noise, motion = result.state.noise, result.state.motion
        square = passed.noise_gradient**2 / likelihood.frames.totals[0]
        for j, g in enumerate(passed.shape_gradient.reshape(9, -1).T):
            N = passed.shape_curvature[j if kind == "missing" else 0]
            square += noise / 2 * g @ np.linalg.solve(N, g)
        D = cameras.tangents(frames_last(motion))
        slope = np.einsum("crai,rai->ci", D, passed.motion_gradient)
        for i, g in enumerate(slope.T):
            A = unpack3(passed.motion_curvature)[..., i]
            curvature = np.einsum("cra,ab,drb->cd", D[..., i], A, D[..., i])
            square += noise / 2 * g @ np.linalg.solve(curvature, g)
        expected = np.sqrt(square / likelihood.frames.totals[0])
        assert result.gradient_norm == pytest.approx(expected, rel=1e-6)

    def test_tables_without_noise_are_fitted_to_the_floor(self, camera, kind):
        cameras = CAMERAS[camera]
        likelihood, start = problem_of(camera, noise=0.0, kind=kind)
        result = refine_joint(likelihood, start, cameras, max_iter=1000, tol=1e-3)
        assert result.converged
        assert (np.diff(result.history) <= 0).all()
        floor = NOISE_FLOOR * np.divide(*likelihood.frames.totals[::-1])
        assert result.state.noise == pytest.approx(floor, rel=1e-6)
        left = 1e-9 if camera == "affine" else 1e-12
        assert likelihood(*result.state).residual < left * likelihood.frames.totals[1]


@KINDS
def test_shapes_and_noise_are_fitted_to_held_cameras(kind):
    scene = random_scene(kind=kind)
    likelihood = likelihood_of(scene.tracks, scene.weights, 1.0)
    start = disturbed(scene.truth)._replace(motion=scene.truth.motion)
    held = AffineCameras(held=True)
    result = refine_joint(likelihood, start, held, max_iter=1000, tol=1e-10)
    assert result.converged
    assert_array_equal(result.state.motion, start.motion)
    assert (np.diff(result.history) < 0).all()
    first, last = likelihood(*start), likelihood(*result.state)
    for name in ("shape_gradient", "noise_gradient"):
        pair = (getattr(each, name) for each in (first, last))
        before, after = (np.abs(gradient).max() for gradient in pair)
        assert after < 1e-5 * before


@pytest.mark.parametrize("camera", CAMERAS)
def test_noise_stays_above_the_least(camera):
    cameras, (likelihood, start) = CAMERAS[camera], problem_of(camera)
    mean_square = np.divide(*likelihood.frames.totals[::-1])
    least = 10 * DEVIATION**2 / mean_square
    options = {"least_noise": least, "max_iter": 1000, "tol": 1e-6}
    result = refine_joint(likelihood, start, cameras, **options)
    assert result.converged
    assert (np.diff(result.history) < 0).all()
    assert result.state.noise == pytest.approx(10 * DEVIATION**2)
    # It would fall further: its slope does not count.
    end = likelihood(*result.state)
    assert end.noise_gradient > 0.1 * likelihood.frames.totals[0]
    assert result.gradient_norm < 1e-3
    assert (
        result.misfit == result.state.noise > end.residual / likelihood.frames.totals[0]
    )


def searched(a, direction):
    """Search along the line ``a t^2 / 2 - t``, with noise whose floor is 1/2."""

    def moved(step):
        return SimpleNamespace(t=step[0], noise=max(np.exp(step[1]), 0.5))

    def at(state):
        return SimpleNamespace(
            state=state,
            value=a * state.t**2 / 2 - state.t,
            gradient=np.array([-1.0, 0.0]),
            cameras=SimpleNamespace(largest_length=lambda steps: np.inf),
            split=lambda step: (None, step[:1], step[1]),
            moved=moved,
        )

    reached, step = _line_search(at(moved(np.zeros(2))), np.array(direction), at)
    return reached.state.t, step


@pytest.mark.parametrize(
    ("a", "expected"), [(1.0, 1.0), (1.99, 1.0), (2.0, 0.5), (4.0, 0.25), (40, 1 / 40)]
)
def test_whole_steps_or_the_minimum_of_the_parabola(a, expected):
    assert_allclose(searched(a, [1.0, 0.0])[1], [expected, 0.0])


def test_noise_changes_by_a_limited_factor_and_not_below_its_floor():
    reached, step = searched(0.5, [1.0, -3.0])
    assert_allclose([reached, *step], [0.5, 0.5, np.log(0.5)])


class TestDegenerate:
    def test_basis_shapes_of_zero_stay_zero(self):
        # A saddle point of the objective: the search does not leave it by itself.
        scene, start = scene_and_start()
        start.shapes[1:] = 0.0
        result = refined(scene, start)
        assert result.converged
        assert_array_equal(result.state.shapes[1:], 0)

    @pytest.mark.parametrize("part", ["shapes", "motion", "noise"])
    @pytest.mark.filterwarnings("ignore::RuntimeWarning")
    def test_ends_where_the_start_is_not_finite(self, part):
        scene, start = scene_and_start()
        if part == "noise":
            start = start._replace(noise=np.nan)
        else:
            getattr(start, part)[3 if part == "motion" else (..., 3)] = np.inf
        assert not refined(scene, start).converged

    def test_point_that_no_frame_shows_stays_where_it_is(self):
        scene, start = scene_and_start(kind="missing")
        scene.weights[:, 3] = 0.0
        result = refined(scene, start)
        assert result.converged
        assert_array_equal(result.state.shapes[..., 3], start.shapes[..., 3])

    def test_cameras_of_zero(self):
        scene, start = scene_and_start()
        start.motion[:] = 0.0
        result = refined(scene, start)
        assert all(np.isfinite(each).all() for each in result.state)
