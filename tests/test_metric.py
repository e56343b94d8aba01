"""The metric of space that affine cameras show, and how far they are from one."""

import numpy as np
import pytest
from cameras import affinity, lorentz_cameras, rotations, weak_perspective
from numpy.testing import assert_allclose
from refusals import refused

from isa_nrsfm._metric_upgrade.quadric import (
    LARGEST_STRETCH,
    mean_gram,
    metric_quadric,
    symmetric_power,
    unit_cameras,
)


def noisy_cameras(rng, n_frames=30):
    return weak_perspective(rng, n_frames) + 0.3 * rng.standard_normal((n_frames, 2, 3))


def residuals(Q, motion):
    unit = motion / np.linalg.norm(motion, axis=(1, 2), keepdims=True)
    B = unit @ Q @ unit.transpose(0, 2, 1)
    return np.stack([B[:, 0, 0] - B[:, 1, 1], 2 * B[:, 0, 1]])


def least_squares_metric(motion):
    """Return Q of least residuals and mean scale one, by its Lagrange equations."""
    basis = [np.zeros((3, 3)) for _ in range(6)]
    for Q, (a, b) in zip(basis, zip(*np.triu_indices(3), strict=True), strict=True):
        Q[a, b] = Q[b, a] = 1.0
    A = np.array([residuals(Q, motion).ravel() for Q in basis]).T
    t = np.array([mean_scale(Q, motion) for Q in basis])
    equations = np.block([[A.T @ A, t[:, None]], [t, 0.0]])
    unknowns = np.linalg.solve(equations, np.eye(7)[6])[:6]
    return np.tensordot(unknowns, basis, 1)


def mean_scale(Q, motion):
    unit = motion / np.linalg.norm(motion, axis=(1, 2), keepdims=True)
    return np.trace(np.mean(unit @ Q @ unit.transpose(0, 2, 1), axis=0))


class TestMetricQuadric:
    @pytest.mark.parametrize("n_frames", [3, 30])
    def test_of_weak_perspective_cameras_is_the_metric(self, n_frames, rng):
        A = affinity(rng)
        Q = metric_quadric(weak_perspective(rng, n_frames) @ np.linalg.inv(A))
        expected = A @ A.T
        assert_allclose(Q / np.trace(Q), expected / np.trace(expected), atol=1e-9)

    def test_is_the_least_squares_solution(self):
        rng = np.random.default_rng(3)
        motion = noisy_cameras(rng)
        Q = metric_quadric(motion)
        assert_allclose(Q, least_squares_metric(motion), atol=1e-9)
        assert mean_scale(Q, motion) == pytest.approx(1)
        least = np.sum(residuals(Q, motion) ** 2)
        assert least > 1e-3
        for _ in range(50):
            step = rng.standard_normal((3, 3))
            other = Q + 1e-2 * np.linalg.norm(Q) * (step + step.T)
            other /= mean_scale(other, motion)
            assert np.sum(residuals(other, motion) ** 2) > least

    def test_little_depth_is_not_taken_for_none(self):
        # Faces that hardly turn: a solution that keeps the norm of Q constant, not the
        # size of the cameras, would let depth vanish.
        rng = np.random.default_rng(5)
        cameras = rotations(rng, 2000, spread=0.1)[:, :2]
        noise = 0.02 * rng.standard_normal(cameras.shape) * [1, 1, 0.1]
        eigenvalues = np.linalg.eigvalsh(metric_quadric(cameras + noise))
        assert_allclose(eigenvalues, eigenvalues.mean(), rtol=0.3)

    def test_cameras_that_say_nothing_about_depth_have_none(self):
        rng = np.random.default_rng(6)
        same = np.repeat(rng.standard_normal((1, 2, 3)), 10, axis=0)
        assert metric_quadric(same) is None
        assert metric_quadric(weak_perspective(rng, 2)) is None
        flat = rng.standard_normal((10, 2, 3)) * [1.0, 1.0, 0.0]
        assert metric_quadric(flat @ affinity(rng)) is None

    def test_indefinite_solutions_are_refused(self):
        assert metric_quadric(lorentz_cameras(np.random.default_rng(7))) is None

    def test_extreme_stretches_are_refused(self):
        motion = weak_perspective(np.random.default_rng(8))
        largest = LARGEST_STRETCH
        for stretch, found in ((0.9 * largest, True), (2 * largest, False)):
            Q = metric_quadric(motion @ np.diag([1, 1, stretch]))
            assert (Q is not None) == found

    def test_leaves_out_frames_without_camera(self):
        motion = noisy_cameras(np.random.default_rng(9))
        nothing = [np.full((1, 2, 3), value) for value in (np.nan, 0.0)]
        more = np.concatenate([motion, *nothing])
        assert_allclose(metric_quadric(more), metric_quadric(motion))


class TestParts:
    def test_unit_cameras(self, rng):
        motion = rng.standard_normal((5, 2, 3))
        motion[1], motion[3, 0, 2] = 0.0, np.nan
        unit = unit_cameras(motion)
        assert_allclose(np.linalg.norm(unit, axis=(1, 2)), 1)
        for got, given in zip(unit, motion[[0, 2, 4]], strict=True):
            assert_allclose(got * np.linalg.norm(given), given)
        refused("none among the 2 cameras", unit_cameras, motion[[1, 3]])

    def test_mean_gram(self):
        motion = np.random.default_rng(0).standard_normal((5, 2, 3))
        expected = np.mean([M.T @ M for M in motion], axis=0)
        assert_allclose(mean_gram(motion), expected)

    @pytest.mark.parametrize("power", [0.5, -0.5, -1.0])
    def test_symmetric_power(self, power):
        root = np.random.default_rng(0).standard_normal((3, 3))
        matrix = root @ root.T
        got = symmetric_power(matrix, power)
        assert_allclose(got, got.T)
        found = np.linalg.matrix_power(got, 2 if abs(power) == 0.5 else 1)
        assert_allclose(found, matrix if power > 0 else np.linalg.inv(matrix))
