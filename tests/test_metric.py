"""The metric of space that affine cameras show, and how far they are from one."""

import numpy as np
import pytest
from cameras import affinity, lorentz_cameras, rotations, weak_perspective
from numpy.testing import assert_allclose
from refusals import refused
from scipy.optimize import minimize
from scipy.spatial.transform import Rotation

from isa_nrsfm.calibration import deformation_metric, metric_upgrade
from isa_nrsfm.calibration._metric import (
    LARGEST_STRETCH,
    metric_quadric,
    strain_basis,
    unit_cameras,
)

both_cameras = pytest.mark.parametrize("camera", ["orthographic", "weak_perspective"])
few_cameras = pytest.mark.filterwarnings("ignore:the cameras hardly determine")


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


def cost(Q, motion, camera):
    """Return the sum of the squared residuals, by their definitions."""
    s1, s2 = np.linalg.svd(motion @ Q, compute_uv=False).T
    if camera == "orthographic":
        return np.sum((s1**2 - 1) ** 2 + (s2**2 - 1) ** 2)
    return np.sum(((s1**2 - s2**2) / (s1**2 + s2**2)) ** 2)


class TestLeastResidual:
    """`metric_upgrade` minimises the residuals over all metrics of space."""

    @both_cameras
    def test_is_a_minimum(self, camera):
        rng = np.random.default_rng(1)
        motion = noisy_cameras(rng) @ affinity(rng)
        upgrade = metric_upgrade(motion, camera)
        # Of all scales of an orthographic metric, that of the scales one is returned.
        scales = np.linspace(0.7, 1.4, 2001) if camera == "orthographic" else [1.0]
        Q = min(
            (scale * upgrade.Q for scale in scales),
            key=lambda Q: cost(Q, motion, camera),
        )
        least = cost(Q, motion, camera)
        assert least > 0.1
        assert upgrade.residual == pytest.approx(np.sqrt(least / 30), rel=1e-5)
        for size in (1e-2, 1e-1):
            steps = size * rng.standard_normal((20, 3, 3))
            assert all(cost(Q @ (np.eye(3) + E), motion, camera) > least for E in steps)

    @few_cameras
    @pytest.mark.parametrize(("n", "noise", "seed"), [(6, 0.5, 47), (8, 0.3, 52)])
    def test_where_the_linear_solution_is_indefinite(self, n, noise, seed):
        rng = np.random.default_rng(seed)
        spread = 0.4 if n == 6 else 0.3
        turns = Rotation.from_rotvec(spread * rng.standard_normal((n, 3))).as_matrix()
        motion = turns[:, :2] + noise * rng.standard_normal((n, 2, 3))
        assert metric_quadric(motion) is None

        def value(entries):
            return cost(entries.reshape(3, 3), motion, "weak_perspective")

        least = min(minimize(value, rng.standard_normal(9)).fun for _ in range(20))
        assert n * metric_upgrade(motion).residual ** 2 <= least * (1 + 1e-6)

    def test_orthographic_one_is_that_of_the_linear_equations(self):
        # Where their solution is positive definite, as it is here.
        rng = np.random.default_rng(2)
        motion = noisy_cameras(rng) / np.sqrt(1.5) @ affinity(rng)
        m1, m2 = np.moveaxis(motion, 1, 0)
        pairs = [(m1, m1), (m2, m2), (m1, m2), (m2, m1)]
        equations = [np.einsum("ia,ib->iab", a, b).reshape(-1, 9) for a, b in pairs]
        linear = np.linalg.lstsq(np.vstack(equations), np.repeat([1.0, 0.0], 60))[0]
        metric = np.linalg.matrix_power(metric_upgrade(motion, "orthographic").Q, 2)
        linear = linear.reshape(3, 3)
        assert_allclose(metric / np.trace(metric), linear / np.trace(linear), atol=1e-7)

    @both_cameras
    def test_many_frames_are_worked_on_in_blocks(self, camera):
        rng = np.random.default_rng(3)
        motion, alpha = noisy_cameras(rng), rng.standard_normal((30, 2))
        many, copies = np.tile(motion, (70, 1, 1)), np.tile(alpha, (70, 1))
        few, whole = metric_upgrade(motion, camera), metric_upgrade(many, camera)
        assert_allclose(whole.Q, few.Q, atol=1e-8)
        assert whole.residual == pytest.approx(few.residual, rel=1e-9)
        assert_allclose(
            deformation_metric(many[::-1], copies[::-1]).strain,
            deformation_metric(many, copies).strain,
            atol=1e-8,
        )

    @few_cameras
    def test_condition_number(self):
        turns = Rotation.random(3000, random_state=0).as_matrix()[:, :2]
        assert metric_upgrade(turns).condition_number == pytest.approx(1, abs=0.1)
        for unit in (1e-20, 1e20):
            condition = metric_upgrade(unit * turns).condition_number
            assert condition == pytest.approx(1, abs=0.1)
        assert metric_upgrade(turns[:2]).condition_number == np.inf


@both_cameras
def test_basis_of_strains_is_orthonormal(camera):
    basis = strain_basis(camera)
    flat = basis.reshape(len(basis), 9)
    assert_allclose(flat @ flat.T, np.eye(len(basis)), atol=1e-15)
    assert_allclose(basis, basis.transpose(0, 2, 1))
    assert len(basis) == (6 if camera == "orthographic" else 5)
    assert_allclose(np.trace(basis[:5], axis1=1, axis2=2), 0, atol=1e-15)


def test_unit_cameras(rng):
    motion = rng.standard_normal((5, 2, 3))
    motion[1], motion[3, 0, 2] = 0.0, np.nan
    unit = unit_cameras(motion)
    assert_allclose(np.linalg.norm(unit, axis=(1, 2)), 1)
    for got, given in zip(unit, motion[[0, 2, 4]], strict=True):
        assert_allclose(got * np.linalg.norm(given), given)
    refused("none among the 2 cameras", unit_cameras, motion[[1, 3]])
