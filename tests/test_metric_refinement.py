"""The metric in which cameras are most nearly scaled rotations, by Gauss-Newton."""

import numpy as np
import pytest
from numpy.testing import assert_allclose
from scipy.linalg import expm
from scipy.optimize import minimize
from scipy.spatial.transform import Rotation

from isa_nrsfm._linalg.small_matrices import frames_last
from isa_nrsfm._metric_upgrade.quadric import metric_quadric, strain_basis
from isa_nrsfm._metric_upgrade.refinement import (
    STRETCH_OF_START,
    MetricFit,
    _linearised,
    _normal_equations,
    exponential,
    fit_at,
    orthonormality,
    refine_metric,
    safe_start,
)
from isa_nrsfm._parameters.choices import CALIBRATED_CAMERAS
from isa_nrsfm._tables.blocks import BLOCK_FRAMES

both_cameras = pytest.mark.parametrize("camera", CALIBRATED_CAMERAS)


def axes_and_stretch(rng, *stretch):
    left, right = (np.linalg.qr(rng.standard_normal((3, 3)))[0] for _ in "ab")
    return left @ np.diag(stretch) @ right


def exact_cameras(seed, camera, n_frames=20, spread=None):
    """Return Euclidean cameras in affine coordinates, and these coordinates."""
    rng = np.random.default_rng(seed)
    turns = Rotation.random(n_frames, random_state=seed)
    if spread is not None:
        turns = Rotation.from_rotvec(spread * rng.standard_normal((n_frames, 3)))
    scales = np.ones(n_frames)
    if camera == "weak_perspective":
        scales = rng.uniform(0.2, 5, n_frames)
    affinity = axes_and_stretch(rng, 0.2, 1, 3)
    return scales[:, None, None] * turns.as_matrix()[:, :2] @ affinity, affinity


def noisy_cameras(seed, camera, n_frames=30):
    motion, _ = exact_cameras(seed, camera, n_frames, spread=0.7)
    return motion + 0.3 * np.random.default_rng(seed).standard_normal(motion.shape)


def bad_start(seed):
    """A metric that stretches some direction a thousand times more than another."""
    root = axes_and_stretch(np.random.default_rng(seed), 1e-3, 0.03, 1.0)
    return root @ root.T


def objective(motion, Q, camera, alpha, strain, ridge):
    turned = [Q @ expm(np.tensordot(a, strain, 1)) @ Q.T for a in alpha]
    gram = motion @ np.array(turned) @ motion.transpose(0, 2, 1)
    rest = orthonormality(frames_last(gram), camera)
    return np.sum(rest**2) + ridge * np.sum(strain**2)


class TestParts:
    @both_cameras
    def test_basis_of_strains_is_orthonormal(self, camera):
        basis = strain_basis(camera)
        flat = basis.reshape(len(basis), 9)
        assert_allclose(flat @ flat.T, np.eye(len(basis)), atol=1e-15)
        assert_allclose(basis, basis.transpose(0, 2, 1))
        assert len(basis) == (6 if camera == "orthographic" else 5)
        assert_allclose(np.trace(basis[:5], axis1=1, axis2=2), 0, atol=1e-15)

    def test_norms_of_the_residuals(self):
        cameras = np.random.default_rng(0).standard_normal((6, 2, 3))
        gram = cameras @ cameras.transpose(0, 2, 1)
        last = frames_last(gram)
        s1, s2 = np.linalg.svd(cameras, compute_uv=False).T
        weak = np.linalg.norm(orthonormality(last, "weak_perspective"), axis=0)
        assert_allclose(weak, (s1**2 - s2**2) / (s1**2 + s2**2))
        ortho = np.linalg.norm(orthonormality(last, "orthographic"), axis=0)
        assert_allclose(ortho, np.linalg.norm(gram - np.eye(2), axis=(1, 2)))

    @both_cameras
    def test_derivatives_by_central_differences(self, camera, rng):
        motion, alpha = rng.standard_normal((4, 2, 3)), rng.standard_normal((2, 4))
        basis = strain_basis(camera)
        numbers = 0.3 * rng.standard_normal((2, len(basis)))
        numbers[1, 3:] = 0.0

        def at(step):
            first, rest = step[: len(basis)], step[len(basis) :].reshape(numbers.shape)
            moved = motion @ expm(np.tensordot(first, basis, 1) / 2)
            strain = np.tensordot(numbers + rest, basis, 1)
            return _linearised(frames_last(moved), strain, alpha, camera)

        residuals, slopes, own_slopes = at(np.zeros(3 * len(basis)))
        by_strains = [own_slopes * coefficients for coefficients in alpha]
        slopes = np.concatenate([slopes, *by_strains])
        for slope, unit in zip(slopes, 1e-6 * np.eye(3 * len(basis)), strict=True):
            change = (at(unit)[0] - at(-unit)[0]) / 2e-6
            assert_allclose(slope, change, atol=1e-7)

        # The sums over frames are those of all derivatives.
        strain = np.tensordot(numbers, basis, 1)
        parts = _linearised(frames_last(motion), strain, alpha, camera)
        cost, curvature, gradient = _normal_equations(alpha, *parts)
        flat = slopes.reshape(len(slopes), -1)
        assert cost == pytest.approx(np.sum(residuals**2))
        assert_allclose(curvature, flat @ flat.T, atol=1e-12)
        assert_allclose(gradient, flat @ residuals.ravel(), atol=1e-12)

    def test_derivative_where_there_is_no_strain(self):
        # Equal eigenvalues, whose divided difference is a derivative.
        cameras = np.random.default_rng(0).standard_normal((2, 3, 4))
        still = np.zeros((1, 3, 3)), np.ones((1, 4))
        _, slopes, own_slopes = _linearised(cameras, *still, "weak_perspective")
        assert_allclose(slopes, own_slopes)

    @both_cameras
    def test_blocks_of_frames_add_up(self, camera, rng):
        n = BLOCK_FRAMES + 10
        motion, alpha = rng.standard_normal((n, 2, 3)), rng.standard_normal((n, 2))
        strain = 0.1 * strain_basis(camera)[:2]
        whole = fit_at(motion, alpha, np.eye(3), strain, camera)
        turned = fit_at(motion[::-1], alpha[::-1], np.eye(3), strain, camera)
        assert whole.n_frames == turned.n_frames == n
        assert whole.cost == pytest.approx(turned.cost, rel=1e-12)
        scale = np.abs(whole.curvature).max()
        assert_allclose(whole.curvature, turned.curvature, atol=1e-12 * scale)
        assert_allclose(whole.gradient, turned.gradient, atol=1e-12 * scale)
        parts = slice(BLOCK_FRAMES), slice(BLOCK_FRAMES, None)
        frames = ((motion[part], alpha[part]) for part in parts)
        first, rest = (fit_at(*each, np.eye(3), strain, camera) for each in frames)
        assert whole.cost == pytest.approx(first.cost + rest.cost, rel=1e-12)
        both = first.curvature + rest.curvature, first.gradient + rest.gradient
        assert_allclose(whole.curvature, both[0], atol=1e-12 * scale)
        assert_allclose(whole.gradient, both[1], atol=1e-12 * scale)

    def test_exponential(self):
        roots = np.random.default_rng(0).standard_normal((4, 3, 3))
        symmetric = roots + roots.transpose(0, 2, 1)
        expected = [expm(matrix) for matrix in symmetric]
        assert_allclose(exponential(symmetric), expected, rtol=1e-9)

    @both_cameras
    def test_start_is_not_nearly_singular(self, camera):
        motion, _ = exact_cameras(0, camera)
        counted = motion / np.linalg.norm(motion, axis=(1, 2), keepdims=True)
        if camera == "orthographic":
            counted = motion
        Q = safe_start(motion, np.diag([1.0, -1.0, 1e-5]), camera)
        gram = counted @ Q @ Q.T @ counted.transpose(0, 2, 1)
        assert_allclose(np.mean(np.trace(gram, axis1=1, axis2=2)), 2)
        rows = (counted @ Q).reshape(-1, 3)
        stretch = np.linalg.svd(rows, compute_uv=False)
        assert stretch[0] / stretch[-1] <= STRETCH_OF_START * (1 + 1e-9)


def refined(motion, Q, camera, alpha=None, ridge=0.0):
    """Return the minimum that a metric without strains leads to."""
    alpha = np.zeros((len(motion), 0)) if alpha is None else alpha
    start = fit_at(motion, alpha, Q, np.zeros((alpha.shape[1], 3, 3)), camera)
    return refine_metric(motion, alpha, start, camera, ridge)


class TestRefineMetric:
    @both_cameras
    @pytest.mark.parametrize("seed", range(10))
    @pytest.mark.parametrize("spread", [None, 0.3, 0.05])
    def test_exact_cameras_from_a_bad_start(self, seed, camera, spread):
        motion, affinity = exact_cameras(seed, camera, spread=spread)
        fit = refined(motion, safe_start(motion, bad_start(seed), camera), camera)
        metric = affinity @ fit.Q @ fit.Q.T @ affinity.T
        assert_allclose(metric * 3 / np.trace(metric), np.eye(3), atol=1e-8)
        assert fit.cost < 1e-20

    @both_cameras
    def test_result_does_not_depend_on_the_start(self, camera):
        motion = noisy_cameras(0, camera)
        many = (safe_start(motion, bad_start(s), camera) for s in range(10))
        costs = [refined(motion, start, camera).cost for start in many]
        assert costs[0] > 0.1
        assert_allclose(costs, costs[0], rtol=1e-10)

    @both_cameras
    @pytest.mark.parametrize("ridge", [0.0, 0.5])
    def test_is_a_minimum(self, camera, ridge):
        rng = np.random.default_rng(1)
        motion, alpha = noisy_cameras(1, camera), rng.standard_normal((30, 2))
        start = safe_start(motion, np.eye(3), camera)
        fit = refined(motion, start, camera, alpha, ridge=ridge)
        here = fit.cost + ridge * np.sum(fit.strain**2)
        args = (camera, alpha, fit.strain, ridge)
        assert objective(motion, fit.Q, *args) == pytest.approx(here, rel=1e-9)
        basis = strain_basis(camera)
        gradient = fit.gradient.copy()
        own = ridge * np.einsum("kab,nab->kn", fit.strain, basis).ravel()
        gradient[len(basis) :] += own
        assert_allclose(gradient, 0, atol=1e-6)
        # In any direction the objective rises.
        for step in rng.standard_normal((10, 3, len(basis))):
            change = 1e-3 * np.tensordot(step, basis, 1)
            moved = fit.Q @ expm(change[0] / 2)
            moved_args = (camera, alpha, fit.strain + change[1:], ridge)
            assert objective(motion, moved, *moved_args) > here

    def test_going_on_from_a_rough_fit_ends_at_the_minimum(self):
        rng = np.random.default_rng(4)
        motion, alpha = noisy_cameras(4, "weak_perspective"), rng.random((30, 1))
        whole = refined(motion, np.eye(3), "weak_perspective", alpha, 0.5)
        camera = "weak_perspective"
        start = fit_at(motion, alpha, np.eye(3), np.zeros((1, 3, 3)), camera)
        rough = refine_metric(motion, alpha, start, camera, 0.5, shortest_step=1e-2)
        fine = refine_metric(motion, alpha, rough, camera, 0.5)
        assert np.abs(rough.strain - whole.strain).max() > 1e-7
        assert_allclose(fine.strain, whole.strain, atol=1e-8)
        assert fine.cost == pytest.approx(whole.cost, rel=1e-9)

    def test_orthographic_minimum_is_that_of_the_linear_equations(self):
        # Where their solution is positive definite, as it is here.
        motion, affinity = exact_cameras(2, "orthographic")
        motion += 0.1 * np.random.default_rng(2).standard_normal(motion.shape)
        m1, m2 = np.moveaxis(motion, 1, 0)
        pairs = [(m1, m1), (m2, m2), (m1, m2), (m2, m1)]
        equations = [np.einsum("ia,ib->iab", a, b).reshape(-1, 9) for a, b in pairs]
        linear = np.linalg.lstsq(np.vstack(equations), np.repeat([1.0, 0.0], 40))[0]
        start = np.linalg.inv(affinity)
        fit = refined(motion, start, "orthographic")
        assert fit.cost > 0.1
        assert_allclose((fit.Q @ fit.Q.T).ravel(), linear, rtol=1e-7)

    @pytest.mark.parametrize(("n", "noise", "seed"), [(6, 0.5, 47), (8, 0.3, 52)])
    def test_indefinite_linear_solution(self, n, noise, seed):
        rng = np.random.default_rng(seed)
        spread = 0.4 if n == 6 else 0.3
        turns = Rotation.from_rotvec(spread * rng.standard_normal((n, 3))).as_matrix()
        motion = turns[:, :2] + noise * rng.standard_normal((n, 2, 3))
        assert metric_quadric(motion) is None
        camera = "weak_perspective"
        fit = refined(motion, safe_start(motion, np.eye(3), camera), camera)

        def cost(entries):
            root = entries.reshape(3, 3)
            gram = motion @ root @ root.T @ motion.transpose(0, 2, 1)
            return np.sum(orthonormality(frames_last(gram), camera) ** 2)

        found = [minimize(cost, rng.standard_normal(9)).fun for _ in range(20)]
        assert fit.cost <= min(found) * (1 + 1e-6)

    def test_condition_number(self):
        camera = "weak_perspective"
        turns = Rotation.random(3000, random_state=0).as_matrix()[:, :2]
        fit = refined(turns, np.eye(3), camera)
        assert fit.condition_number == pytest.approx(1, abs=0.1)
        assert refined(turns[:2], np.eye(3), camera).condition_number == np.inf

    @pytest.mark.parametrize("unit", [1e-20, 1.0, 1e20])
    def test_condition_number_of_any_unit(self, unit):
        curvature = np.diag([1.0, 2.0, 3.0, 4.0, 9.0, *[1e3] * 5])
        still = np.eye(3), np.zeros((1, 3, 3))
        fit = MetricFit(*still, 4, 0.0, unit * curvature, np.zeros(10))
        assert fit.condition_number == pytest.approx(3.0)
        curvature[0, 0] = 1e-17
        assert fit._replace(curvature=unit * curvature).condition_number == np.inf
