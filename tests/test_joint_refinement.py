"""The joint refinement: a minimum of the objective, reached and recognised."""

import numpy as np
import pytest
from frame_parts import assert_calibrated
from made_once import made_once
from numpy.testing import assert_allclose, assert_array_equal
from scenes import likelihood_of, random_scene

from isa_nrsfm._frames.camera_models import CAMERAS, AffineCameras
from isa_nrsfm._joint.problem import NOISE_FLOOR, JointState, refine_joint
from isa_nrsfm._linalg import centred, frames_first, frames_last, unpack3

DEVIATION = 0.03


def moved(cameras, motion, step):
    """Return cameras (n_frames, 2, 3) after steps (n_parameters, n_frames)."""
    return frames_first(cameras.moved(frames_last(motion), step))


def problem_of(
    camera="affine",
    kind="complete",
    *,
    penalty=0.0,
    noise=DEVIATION,
    n_components=2,
    seed=1,
    size=0.1,
):
    """Return the objective for tracks of a model, and a state that is some way off.

    Where all points are seen the tracks are centred.
    """
    options = {"noise": noise, "kind": kind, "camera": camera, "deformation": 0.25}
    scene, cameras = random_scene(0, 24, 14, n_components, **options), CAMERAS[camera]
    tracks = scene.centred if scene.weights is None else scene.tracks
    rng = np.random.default_rng(seed)
    shapes = centred(scene.shapes + size * rng.normal(size=scene.shapes.shape))
    step = size * rng.normal(size=(cameras.n_parameters, len(scene.motion)))
    motion = moved(cameras, scene.motion, step)
    start = JointState(shapes, motion, 5 * max(noise, 1e-3) ** 2)
    return likelihood_of(tracks, scene.weights, penalty), start


def refined(likelihood, start, camera="affine", *, max_iter=1000, tol=1e-3, **options):
    cameras = CAMERAS[camera]
    options |= {"max_iter": max_iter, "tol": tol}
    return refine_joint(likelihood, start, cameras, **options)


@made_once
def optimum(camera="affine", kind="complete", penalty=0.0, n_components=2):
    """Return an objective, a start, and the minimum to many digits."""
    given = {"penalty": penalty, "n_components": n_components}
    likelihood, start = problem_of(camera, kind, **given)
    best = refined(likelihood, start, camera, max_iter=5000, tol=1e-10)
    return likelihood, start, best


def images(likelihood, state):
    """Return the images of the most probable shapes of the frames, centred."""
    shapes, motion, _ = state
    alpha = likelihood(*state).alpha
    return centred(motion @ (shapes[0] + np.tensordot(alpha, shapes[1:], 1)))


KINDS = pytest.mark.parametrize("kind", ["complete", "missing"])


def test_optimum_is_the_same_from_other_starts():
    likelihood, _, expected = optimum()
    _, start = problem_of(seed=2, size=0.2)
    got = refined(likelihood, start, tol=1e-7)
    assert got.history[-1] == pytest.approx(expected.history[-1], abs=1e-2)
    assert got.state.noise == pytest.approx(expected.state.noise, rel=1e-3)
    pair = (images(likelihood, each.state) for each in (got, expected))
    assert_allclose(*pair, atol=1e-3)


def test_tolerance_is_of_two_steps_one_after_the_other_and_a_frame():
    (likelihood, start), tol = problem_of(), 1e-2
    whole = refined(likelihood, start, tol=tol)
    small = -np.diff(whole.history) < tol * len(start.motion)
    assert whole.converged
    assert small[-2:].all()
    assert not (small[:-2] & small[1:-1]).any()
    for max_iter in (0, 4):
        part = refined(likelihood, start, tol=tol, max_iter=max_iter)
        assert not part.converged
        assert_array_equal(part.history, whole.history[: max_iter + 1])


def test_tolerance_of_zero_ends_where_rounding_errors_are_left():
    likelihood, _, best = optimum()
    result = refined(likelihood, best.state, tol=0.0, max_iter=5000)
    assert result.converged
    assert len(result.history) < 1000
    assert result.gradient_norm < 2e-6
    again = refined(likelihood, result.state, tol=0.0)
    assert again.converged
    assert len(again.history) < 10


@pytest.mark.parametrize(
    ("camera", "kind"),
    [
        ("affine", "missing"),
        ("weak_perspective", "complete"),
        ("orthographic", "missing"),
    ],
)
class TestCameras:
    def test_objective_falls_and_rises_in_every_direction(self, camera, kind):
        likelihood, start, result = optimum(camera, kind, 1.0, 1)
        assert result.converged
        assert result.gradient_norm < 5e-6
        assert (np.diff(result.history) < 0).all()
        assert result.history[0] == likelihood(*start).value
        assert result.history[-1] == likelihood(*result.state).value
        if camera != "affine":
            assert_calibrated(result.state.motion, camera, 1e-11)
        cameras, rng = CAMERAS[camera], np.random.default_rng(2)
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
        cameras, (likelihood, start) = CAMERAS[camera], problem_of(camera, kind)
        result = refined(likelihood, start, camera, max_iter=3)
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
        likelihood, start = problem_of(camera, kind, noise=0.0)
        result = refined(likelihood, start, camera)
        assert result.converged
        assert (np.diff(result.history) <= 0).all()
        floor = NOISE_FLOOR * np.divide(*likelihood.frames.totals[::-1])
        assert result.state.noise == pytest.approx(floor, rel=1e-6)
        left = 1e-9 if camera == "affine" else 1e-12
        assert likelihood(*result.state).residual < left * likelihood.frames.totals[1]


@KINDS
def test_shapes_and_noise_are_fitted_to_held_cameras(kind):
    likelihood, start = problem_of(kind=kind, penalty=1.0)
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


def test_noise_stays_above_the_least():
    camera = "weak_perspective"
    likelihood, start = problem_of(camera)
    least = 10 * DEVIATION**2 / np.divide(*likelihood.frames.totals[::-1])
    result = refined(likelihood, start, camera, tol=1e-6, least_noise=least)
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


class TestDegenerate:
    def test_basis_shapes_of_zero_stay_zero(self):
        # A saddle point of the objective: the search does not leave it by itself.
        likelihood, start = problem_of()
        start.shapes[1:] = 0.0
        result = refined(likelihood, start)
        assert result.converged
        assert_array_equal(result.state.shapes[1:], 0)

    @pytest.mark.parametrize("part", ["shapes", "motion", "noise"])
    @pytest.mark.filterwarnings("ignore::RuntimeWarning")
    def test_ends_where_the_start_is_not_finite(self, part):
        likelihood, start = problem_of()
        if part == "noise":
            start = start._replace(noise=np.nan)
        else:
            getattr(start, part)[3 if part == "motion" else (..., 3)] = np.inf
        assert not refined(likelihood, start).converged

    def test_cameras_of_zero(self):
        likelihood, start = problem_of()
        start.motion[:] = 0.0
        result = refined(likelihood, start, max_iter=50)
        assert all(np.isfinite(each).all() for each in result.state)
