"""Camera models, and the search for calibrated cameras by Newton's method."""

from typing import NamedTuple

import numpy as np
import pytest
import scenes
from frame_parts import assert_calibrated, fit_posterior
from layers import slow_after
from numpy.testing import assert_allclose, assert_array_equal
from numpy.typing import NDArray
from scenes import random_rotation, with_gaps
from scipy.optimize import minimize
from scipy.spatial.transform import Rotation

from isa_nrsfm._frames.camera_models import (
    CAMERAS,
    full_rotations,
    mean_view,
    nearest_calibrated,
    rotated,
)
from isa_nrsfm._frames.point_sums import coefficient_posterior, frame_sums, frame_tracks
from isa_nrsfm._frames.search import (
    LARGE_RISE,
    REVERSED,
    FrameSearch,
    _rise,
    calibrated_starts,
)
from isa_nrsfm._linalg.small_matrices import (
    COLUMNS,
    ROWS,
    frames_first,
    frames_last,
    unpacked,
)

N = 7
CALIBRATED = pytest.mark.parametrize("name", ["weak_perspective", "orthographic"])
EACH = pytest.mark.parametrize("name", CAMERAS)


def random_cameras(seed=0, name="weak_perspective", n=N):
    """Return cameras (2, 3, n) of a model."""
    rng = np.random.default_rng(seed)
    if name == "affine":
        return rng.normal(size=(2, 3, n))
    rows = Rotation.random(n, rng).as_matrix()[:, :2]
    if name == "weak_perspective":
        rows = rng.uniform(0.3, 3.0, n)[:, None, None] * rows
    return frames_last(rows)


def random_curvatures(seed=1, n=N):
    """Return positive definite matrices (n, 3, 3), and packed ones (6, n)."""
    factors = np.random.default_rng(seed).normal(size=(n, 3, 4))
    full = factors @ factors.swapaxes(1, 2)
    return full, full[:, ROWS, COLUMNS].T


def tangents(cameras, M, h=1e-5):
    """Return the derivatives D_c (p, 2, 3, n) of cameras by their parameters."""
    found = []
    for c in range(cameras.n_parameters):
        step = np.zeros((cameras.n_parameters, M.shape[2]))
        step[c] = h
        change = cameras.moved(M, step) - cameras.moved(M, -step)
        found.append(change / (2 * h))
    return np.array(found)


def curvature_along(D, A):
    """Return ``tr(D_c A D_d^T)`` (n, p, p) by a loop over frames."""
    return np.array(
        [np.einsum("cra,ab,drb->cd", D[..., i], A[i], D[..., i]) for i in range(N)]
    )


@pytest.mark.parametrize("size", [0.0, 1e-4, 10.0])
def test_turns_are_exponentials(size):
    M = random_cameras(name="affine")
    turns = size * np.random.default_rng(3).normal(size=(3, N))
    moved = rotated(M, turns)
    for i in range(N):
        R = Rotation.from_rotvec(turns[:, i]).as_matrix()
        assert_allclose(moved[..., i], M[..., i] @ R, atol=1e-14)


class TestTangents:
    @EACH
    def test_tangents(self, name):
        M, cameras = random_cameras(name=name), CAMERAS[name]
        assert_allclose(cameras.tangents(M), tangents(cameras, M), atol=1e-8)

    @EACH
    def test_gradient_is_that_along_the_tangents(self, name):
        M, cameras = random_cameras(name=name), CAMERAS[name]
        G = np.random.default_rng(2).normal(size=(2, 3, N))
        expected = np.einsum("crai,rai->ci", tangents(cameras, M), G)
        assert_allclose(cameras.gradient(M, G), expected, atol=1e-8)

    @CALIBRATED
    def test_curvature(self, name):
        # The cameras need not be scaled rotations for it.
        M, (A, packed) = random_cameras(name="affine"), random_curvatures()
        found = CAMERAS[name].curvature(M, packed)
        expected = curvature_along(tangents(CAMERAS[name], M), A)
        assert_allclose(unpacked(found).T, expected, rtol=1e-8, atol=1e-8)


@CALIBRATED
class TestInverseCurvature:
    def test_is_that_along_the_tangents(self, name):
        M, (A, packed) = random_cameras(name=name), random_curvatures()
        cameras = CAMERAS[name]
        expected = curvature_along(tangents(cameras, M), A)
        inverse = cameras.inverse_curvature(M, packed)
        for i in range(N):
            found = inverse[..., i]
            assert_allclose(found, found.T, rtol=1e-12)
            assert_allclose(found, np.linalg.inv(expected[i]), rtol=1e-5, atol=1e-8)

    @pytest.mark.parametrize("rank", [0, 1, 2])
    def test_shapes_that_are_flat(self, name, rank):
        factors = np.random.default_rng(1).normal(size=(N, 3, rank))
        A = factors @ factors.swapaxes(1, 2)
        packed = A[:, ROWS, COLUMNS].T
        M, cameras = random_cameras(name=name), CAMERAS[name]
        inverse = cameras.inverse_curvature(M, packed)
        assert np.isfinite(inverse).all()
        # A step along it never goes uphill.
        for found in inverse.T:
            least = np.linalg.eigvalsh(found)[0]
            assert least >= -1e-6 * np.abs(found).max()

    def test_cameras_of_zero(self, name):
        M, cameras = np.zeros((2, 3, N)), CAMERAS[name]
        inverse = cameras.inverse_curvature(M, random_curvatures()[1])
        assert np.isfinite(inverse).all()


class TestLargestLength:
    @CALIBRATED
    def test_no_camera_turns_by_more_than_a_radian(self, name):
        cameras = CAMERAS[name]
        step = np.random.default_rng(2).normal(size=(cameras.n_parameters, N))
        turned = cameras.largest_length(step) * np.linalg.norm(step[:3], axis=0)
        assert turned.max() == pytest.approx(1.0)

    @CALIBRATED
    def test_scales_count_by_their_logarithm(self, name):
        cameras = CAMERAS[name]
        step = np.zeros((cameras.n_parameters, N))
        step[3:] = 100.0
        expected = 0.01 if cameras.scaled else np.inf
        assert cameras.largest_length(step) == pytest.approx(expected)


class TestNearestCalibrated:
    def test_is_nearest(self):
        rng = np.random.default_rng(0)
        motion = rng.normal(size=(N, 2, 3))
        rows, scales = nearest_calibrated(motion)
        identity = np.broadcast_to(np.eye(2), (N, 2, 2))
        assert_allclose(rows @ rows.swapaxes(1, 2), identity, atol=1e-14)
        least = np.sum((motion - rows) ** 2, axis=(1, 2))
        scaled = np.sum((motion - scales[:, None, None] * rows) ** 2, axis=(1, 2))
        for size in (1e-3, 0.1, 3.0):
            for _ in range(10):
                turns = size * rng.normal(size=(3, N))
                other = frames_first(rotated(frames_last(rows), turns))
                rest = motion - other
                assert (np.sum(rest**2, axis=(1, 2)) > least).all()
                factor = scales * np.exp(size * rng.normal(size=N))
                rest = motion - factor[:, None, None] * other
                assert (np.sum(rest**2, axis=(1, 2)) > scaled).all()

    def test_cameras_of_zero_have_orthonormal_rows_and_no_scale(self):
        rows, scales = nearest_calibrated(np.zeros((1, 2, 3)))
        assert_allclose(rows @ rows.swapaxes(1, 2), [np.eye(2)], atol=1e-14)
        assert_array_equal(scales, [0.0])


class TestFullRotations:
    def test_are_rotations_with_the_rows_of_the_cameras(self):
        motion = frames_first(random_cameras())
        rotations, scales = full_rotations(motion)
        assert_allclose(scales[:, None, None] * rotations[:, :2], motion, atol=1e-14)
        identity = np.broadcast_to(np.eye(3), (N, 3, 3))
        assert_allclose(
            rotations @ rotations.swapaxes(1, 2), identity, rtol=1e-13, atol=1e-13
        )
        assert_allclose(np.linalg.det(rotations), 1.0)
        assert (scales > 0).all()

    def test_frames_without_camera_are_nan(self):
        motion = frames_first(random_cameras()).copy()
        motion[2] = np.nan
        rotations, scales = full_rotations(motion)
        missing = np.arange(N) == 2
        assert_array_equal(np.isnan(rotations).all(axis=(1, 2)), missing)
        assert_array_equal(np.isnan(rotations).any(axis=(1, 2)), missing)
        assert_array_equal(np.isnan(scales), missing)


class TestMeanView:
    @pytest.mark.parametrize("unit", [1e-9, 1e9])
    def test_where_the_limit_is(self, unit):
        # Mirrored y in a share p of the frames: the mean of y is 1 - 2 p.
        for p, none in ((0.38, False), (0.42, True)):
            motion = np.tile(np.eye(2, 3), (100, 1, 1))
            motion[: round(100 * p), 1, 1] = -1
            assert (mean_view(unit * motion) is None) == none

    def test_does_not_depend_on_the_axes_of_space_or_image(self, rng):
        motion = np.eye(2, 3) + 0.3 * rng.normal(size=(20, 2, 3))
        R, Q = random_rotation(1), random_rotation(2, 2)
        view = mean_view(motion)
        assert_allclose(mean_view(Q @ motion @ R), Q @ view @ R, atol=1e-14)


NOISE = 0.02
BOTH = pytest.mark.parametrize("camera", ["weak_perspective", "orthographic"])
GAPS = pytest.mark.parametrize("gaps", [False, True])


def random_scene(camera, gaps=False, noise=NOISE, n_frames=20, depth=1.0):
    """Return a scene of three basis shapes, maybe with missing points."""
    options = {"noise": noise, "camera": camera, "deformation": 0.2}
    options["extent"] = (1.0, 0.8, 0.6 * depth)
    scene = scenes.random_scene(0, n_frames, **options)
    return scene._replace(tracks=with_gaps(scene.tracks)) if gaps else scene


class Regression(NamedTuple):
    """A frame in a known camera, ``y ~ x_0 + X a``, as dense linear algebra."""

    y: NDArray
    first: NDArray
    X: NDArray

    @classmethod
    def of(cls, points, shapes, M):
        seen = np.isfinite(points[:, 0])
        points, shapes = points[seen], shapes[..., seen]
        moved = shapes - shapes.mean(axis=2, keepdims=True)
        columns = (M @ moved).reshape(len(shapes), -1)
        y = (points - points.mean(axis=0)).T.ravel()
        return cls(y, columns[0], columns[1:].T)

    def precision(self, noise):
        return self.X.T @ self.X + noise * np.eye(self.X.shape[1])

    def mean(self, noise):
        """Return the posterior mean of the coefficients."""
        right = self.X.T @ (self.y - self.first)
        return np.linalg.solve(self.precision(noise), right)

    def square(self, alpha, noise):
        rest = self.y - self.first - self.X @ alpha
        return rest @ rest + noise * alpha @ alpha

    def value(self, noise):
        """Return F: minus two log marginal likelihoods, up to a constant."""
        _, determinant = np.linalg.slogdet(self.precision(noise) / noise)
        return self.square(self.mean(noise), noise) / noise + determinant


def moved(M, step):
    """Return a camera after a rotation vector and, maybe, the log of a scale."""
    turned = M @ Rotation.from_rotvec(step[:3]).as_matrix()
    return np.exp(step[3:].sum()) * turned


def value(scene, i, M, noise=NOISE**2):
    return Regression.of(scene.tracks[i], scene.shapes, M).value(noise)


def fitted(scene, camera, noise=NOISE**2, **options):
    return fit_posterior(scene.tracks, scene.shapes, noise, camera=camera, **options)


def problem_of(scene, camera, noise):
    """Return the search, its frames, and cameras in its coordinates."""
    search = FrameSearch(scene.shapes, CAMERAS[camera])
    seen = np.isfinite(scene.tracks[..., 0])
    weights = None if seen.all() else 1.0 * seen
    products = frame_sums(
        frame_tracks(scene.tracks.transpose(0, 2, 1), weights), search.shared
    )
    problem = search.problem(products, np.full(len(scene.tracks), noise))
    return search, problem, frames_last(scene.motion @ search.space.T)


@BOTH
@GAPS
class TestMinimum:
    @pytest.mark.parametrize("depth", slow_after(1, [0.1, 1.0]))
    def test_is_no_higher_than_from_many_other_starts(self, camera, gaps, depth):
        scene = random_scene(camera, gaps, noise=0.1, n_frames=2, depth=depth)
        noise = 0.1**2
        fits = fitted(scene, camera, noise)
        n = CAMERAS[camera].n_parameters
        rng = np.random.default_rng(1)
        for i, M in enumerate(fits.motion):
            scale = np.linalg.norm(M) / np.sqrt(2)
            found = value(scene, i, M, noise)
            ends = []
            for _ in range(3):
                start = scale * Rotation.random(None, rng).as_matrix()[:2]
                result = minimize(
                    lambda step, i=i, start=start: value(
                        scene, i, moved(start, step), noise
                    ),
                    np.zeros(n),
                )
                ends.append(result.fun)
            assert found <= min(ends) + 1e-6
            assert min(ends) == pytest.approx(found, abs=1e-5)

    def test_objective_rises_in_every_direction(self, camera, gaps):
        scene = random_scene(camera, gaps)
        fits = fitted(scene, camera)
        assert fits.converged.all()
        assert_calibrated(fits.motion, camera)
        rng = np.random.default_rng(1)
        for i, M in enumerate(fits.motion):
            least = value(scene, i, M)
            for _ in range(5):
                step = 1e-4 * rng.normal(size=CAMERAS[camera].n_parameters)
                rises = [value(scene, i, moved(M, s * step)) - least for s in (1, -1)]
                assert min(rises) > 0
                # Equal on both sides: the slope is zero, not only small.
                assert_allclose(rises[0], rises[1], rtol=1e-2)

    def test_coefficients_are_the_posterior_mean(self, camera, gaps):
        scene = random_scene(camera, gaps)
        fits = fitted(scene, camera)
        for i, M in enumerate(fits.motion):
            frame = Regression.of(scene.tracks[i], scene.shapes, M)
            assert_allclose(fits.alpha[i], frame.mean(NOISE**2), rtol=1e-9, atol=1e-12)
            square = frame.square(fits.alpha[i], NOISE**2)
            assert fits.objective[i] == pytest.approx(square, rel=1e-9)


@BOTH
class TestDerivatives:
    """Away from the minimum, where the gradient is not zero."""

    H = 1e-5

    @staticmethod
    def disturbed(M, cameras, size=0.1):
        rng = np.random.default_rng(1)
        step = size * rng.normal(size=(cameras.n_parameters, M.shape[2]))
        return cameras.moved(M, step)

    def states(self, search, problem, M):
        """Yield the states above and below along each tangent."""
        n = search.model.n_parameters
        for c in range(n):
            step = np.zeros((n, M.shape[2]))
            step[c] = self.H
            yield tuple(
                search.evaluate(problem, search.model.moved(M, sign * step))
                for sign in (1, -1)
            )

    @GAPS
    def test_value_by_dense_algebra(self, camera, gaps):
        scene = random_scene(camera, gaps)
        search, problem, M = problem_of(scene, camera, NOISE**2)
        got = search.evaluate(problem, M).value
        expected = [value(scene, i, each) for i, each in enumerate(scene.motion)]
        assert_allclose(got, NOISE**2 * np.array(expected), rtol=1e-9)

    @GAPS
    @pytest.mark.parametrize("noise", [1e-4, 10.0])
    def test_slope_by_differences(self, camera, gaps, noise):
        search, problem, M = problem_of(random_scene(camera, gaps), camera, noise)
        M = self.disturbed(M, CAMERAS[camera])
        slope = search.evaluate(problem, M).slope
        for c, (above, below) in enumerate(self.states(search, problem, M)):
            expected = -(above.value - below.value) / (4 * self.H)
            assert_allclose(slope[c], expected, rtol=1e-6, atol=1e-6)

    def numerical_hessian(self, search, problem, M):
        """Return half the Hessian of s2 F (p, p, n), by differences of the slope."""
        rows = [
            (below.slope - above.slope) / (2 * self.H)
            for above, below in self.states(search, problem, M)
        ]
        # Differences of the slope along tangents that turn along: what is not
        # symmetric is the commutator of two rotations.
        hessian = np.array(rows)
        return 0.5 * (hessian + hessian.swapaxes(0, 1))

    @GAPS
    def test_hessian_is_exact_but_for_the_determinant(self, camera, gaps):
        # What is left falls like the noise.
        scene = random_scene(camera, gaps)
        errors = []
        for noise in (1e-2, 1e-3, 1e-4):
            search, problem, M = problem_of(scene, camera, noise)
            M = self.disturbed(M, CAMERAS[camera], 0.03)
            got = unpacked(search.evaluate(problem, M).hessian)
            expected = self.numerical_hessian(search, problem, M)
            size = np.abs(expected).max(axis=(0, 1))
            errors.append((np.abs(got - expected).max(axis=(0, 1)) / size).max())
        assert errors[0] < 0.1
        assert errors[1] < 0.15 * errors[0]
        assert errors[2] < 0.15 * errors[1]

    @pytest.mark.parametrize("noise", [1e-3, 0.1, 10.0])
    def test_hessian_of_the_determinant_is_a_bound(self, camera, noise):
        search, problem, M = problem_of(random_scene(camera), camera, noise)
        M = self.disturbed(M, CAMERAS[camera])
        got = unpacked(search.evaluate(problem, M).hessian)
        excess = got - self.numerical_hessian(search, problem, M)
        assert (np.linalg.eigvalsh(frames_first(excess))[:, 0] > -1e-5).all()
        assert np.abs(excess).max() > 1e-5


@EACH
@GAPS
def test_covariance_is_that_of_camera_and_coefficients_together(name, gaps):
    deviation = 2e-3
    scene = random_scene(name, gaps, noise=deviation, n_frames=4)
    noise, n = deviation**2, CAMERAS[name].n_parameters
    fits = fitted(scene, name, noise)

    def f(i, x):
        M = CAMERAS[name].moved(fits.motion[i, ..., None], x[:n, None])[..., 0]
        frame = Regression.of(scene.tracks[i], scene.shapes, M)
        return frame.square(fits.alpha[i] + x[n:], noise)

    h = 1e-3
    for i in range(4):
        hessian = np.empty((n + 3, n + 3))
        for p, q in np.ndindex(hessian.shape):
            a, b = h * np.eye(n + 3)[p], h * np.eye(n + 3)[q]
            corners = f(i, a + b) + f(i, -a - b) - f(i, a - b) - f(i, b - a)
            hessian[p, q] = corners / (4 * h * h)
        # The posterior density is exp(-f / (2 s2)).
        expected = np.linalg.inv(hessian / (2 * noise))[n:, n:]
        size = np.abs(expected).max()
        assert_allclose(fits.covariance[i], expected, atol=1e-3 * size)


@BOTH
class TestReversal:
    """Of a nearly flat object, whose reversed images are nearly the same."""

    def scene(self, camera, deviation=0.01):
        return random_scene(camera, noise=deviation, depth=0.1, n_frames=40)

    def reversed(self, scene):
        """Return cameras reflected at the plane of the mean shape."""
        axes = np.linalg.svd(scene.shapes[0], full_matrices=False)[0]
        return scene.motion @ axes @ np.diag([1.0, 1.0, -1.0]) @ axes.T

    def search(self, scene, camera, noise, motion):
        search = FrameSearch(scene.shapes, CAMERAS[camera])
        products = frame_sums(
            frame_tracks(scene.tracks.transpose(0, 2, 1)), search.shared
        )
        problem = search.problem(products, np.full(len(motion), noise))
        return search.reversed_cameras(problem, motion)

    def test_cameras_that_start_reversed_are_turned_back(self, camera):
        scene = self.scene(camera)
        found, better = self.search(scene, camera, 1e-4, self.reversed(scene))
        expected = fitted(scene, camera, 1e-4).motion
        assert better.mean() > 0.9
        # A few steps lead there, not all of them to the minimum.
        away = np.abs(found - expected).max(axis=(1, 2))[better]
        assert away.max() < 0.2
        assert np.median(away) < 1e-4
        assert_calibrated(found, camera)

    def test_reversals_are_tried_over_a_large_rise(self, camera):
        # In a joint fit cameras can be in high minima, where the bound does not hold.
        scene = scenes.random_scene(
            n_frames=1500,
            noise=0.01,
            camera=camera,
            deformation=0.4,
            extent=(1.0, 0.8, 0.3),
        )
        search, problem, M = problem_of(scene, camera, 1e-4)
        M = M * REVERSED
        _, better = self.search(scene, camera, 1e-4, frames_first(M) @ search.space)
        M, _ = search.descend(problem, search.evaluate(problem, M), 6)
        posterior = coefficient_posterior(problem[0], M, problem[1])
        value = search.evaluate(problem, M).value
        steep = _rise(problem, M, posterior) > LARGE_RISE * value
        assert (better & steep).sum() >= 3

    def test_cameras_at_the_minimum_stay(self, camera):
        scene = self.scene(camera)
        expected = fitted(scene, camera, 1e-4).motion
        found, better = self.search(scene, camera, 1e-4, expected)
        assert not better.any()
        assert_array_equal(found, expected)

    def test_fit_takes_the_better_of_the_two(self, camera):
        # The depth of the object is that of the noise: the start can be reversed.
        scene = self.scene(camera, deviation=0.05)
        noise = 0.05**2
        fits = fitted(scene, camera, noise)
        turned = scene._replace(motion=fits.motion)
        n = CAMERAS[camera].n_parameters
        for i, start in enumerate(self.reversed(turned)[:10]):
            end = minimize(
                lambda step, i=i, start=start: value(
                    scene, i, moved(start, step), noise
                ),
                np.zeros(n),
            )
            assert value(scene, i, fits.motion[i], noise) <= end.fun + 1e-6

    def test_rise_on_the_way_is_that_of_the_quadratic_approximation(self, camera):
        scene = random_scene(camera, noise=0.0, n_frames=3)
        search, problem, M = problem_of(scene, camera, 1e-9)
        posterior = coefficient_posterior(problem[0], M, problem[1])
        shapes, h = search.shared.shapes, 1e-3

        def f(i, change):
            changed = M[..., i] + change.reshape(2, 3)
            frame = Regression.of(scene.tracks[i], shapes, changed)
            return frame.square(frame.mean(1e-9), 1e-9)

        for i, rise in enumerate(_rise(problem, M, posterior)):
            Y = np.empty((6, 6))
            for p, q in np.ndindex(6, 6):
                a, b = h * np.eye(6)[p], h * np.eye(6)[q]
                corners = f(i, a + b) + f(i, -a - b) - f(i, a - b) - f(i, b - a)
                Y[p, q] = corners / (8 * h * h)
            z = (M[..., i] * [0, 0, 1]).ravel()
            assert_allclose(rise, (z @ z) ** 2 / (z @ np.linalg.solve(Y, z)), rtol=1e-3)

    def test_solid_objects_are_not_reversed(self, camera, monkeypatch):
        scene = random_scene(camera)
        search, problem, M = problem_of(scene, camera, NOISE**2)
        monkeypatch.setattr(search, "evaluate", None)  # no search from reversed cameras
        converged = np.ones(len(scene.tracks), dtype=bool)
        assert_array_equal(search.solution(problem, M, converged, 10)[0], M)


def test_completed_starts_are_scaled_rotations_with_the_first_two_columns(rng):
    """Also of equal singular values, of one, of none, and of axes in the columns."""
    M = rng.standard_normal((2, 3, 40)) * 10.0 ** rng.uniform(-3, 3, 40)
    M[:, :2, :4] = 0.0
    M[:, :2, 0] = np.eye(2)
    M[0, 0, 1] = M[1, 1, 2] = M[0, 1, 3] = 2.0
    M[:, :2, 4] = 0.0
    affine = M.copy()
    completed = calibrated_starts(CAMERAS["weak_perspective"], M)[1]
    assert_array_equal(M, affine)
    size = np.linalg.norm(M[:, :2], axis=(0, 1), ord=2)
    size[4] = 1.0
    products = (
        np.einsum("rci,sci->irs", completed, completed) / size[:, None, None] ** 2
    )
    assert_allclose(products, np.broadcast_to(np.eye(2), products.shape), atol=1e-12)
    some = np.arange(40) != 4
    assert_allclose(completed[:, :2, some] / size[some], M[:, :2, some] / size[some])
    assert (np.einsum("ri,ri->i", completed[:, 2], M[:, 2]) >= 0).all()
