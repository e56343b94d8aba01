"""Alternating refinement: optimality, monotone energies, degenerate blocks."""

from typing import NamedTuple

import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal
from scenes import measurements, structured_motion

from isa_nrsfm._paper.alternating import _step, refine_alternating
from isa_nrsfm._paper.block_structure import motion_products, recover_blocks
from isa_nrsfm._paper.factors import factorise


def frames(rigid, motion):
    """Return M_0 (I, 2, 3) and M (I, 2, n_signals)."""
    return rigid.reshape(-1, 2, 3), motion.reshape(len(rigid) // 2, 2, -1)


def explained(M_0, M, E):
    """Return ``f(E) = sum_i <M_i, M_0^i E>^2 / ||M_0^i E||^2``."""
    image = M_0 @ E
    return np.sum(np.sum(M * image, axis=(1, 2)) ** 2 / np.sum(image**2, axis=(1, 2)))


def alternate(M_0, M, E, n_steps):
    """Return E and the energies of plain alternating least squares."""
    energies = [explained(M_0, M, E)]
    for _ in range(n_steps):
        image = M_0 @ E
        alpha = np.sum(M * image, axis=(1, 2)) / np.sum(image**2, axis=(1, 2))
        A = (alpha[:, None, None] * M_0).reshape(-1, 3)
        E = np.linalg.lstsq(A, M.reshape(-1, 3))[0]
        energies.append(explained(M_0, M, E))
    return E, np.array(energies)


def gradient(M_0, M, E):
    """Return R - A E, half the gradient of f."""
    image = M_0 @ E
    alpha = np.sum(M * image, axis=(1, 2)) / np.sum(image**2, axis=(1, 2))
    R = np.einsum("i,ira,irb->ab", alpha, M_0, M)
    A = np.einsum("i,ira,irb->ab", alpha**2, M_0, M_0)
    return R - A @ E, np.linalg.norm(R)


def differences(function, E, step):
    """Return central finite differences of a function of a 3x3 matrix."""
    columns = []
    for direction in step * np.eye(9).reshape(9, 3, 3):
        columns.append((function(E + direction) - function(E - direction)) / (2 * step))
    return np.stack(columns, axis=-1)


def random_starts(seed, n_blocks, n_starts=1):
    return np.random.default_rng(seed).normal(size=(n_blocks, n_starts, 3, 3))


class Refined(NamedTuple):
    E: np.ndarray
    energy: np.ndarray
    n_iter: int
    converged: bool


def refine_products(products, starts, max_iter=200, tol=1e-10):
    found = refine_alternating(products, starts, max_iter=max_iter, tol=tol)
    return Refined(*found)


def refine(rigid, motion, starts, max_iter=5000, tol=1e-16):
    return refine_products(motion_products(rigid, motion), starts, max_iter, tol)


def same_up_to_sign(A, B, **tolerance):
    sign = np.sign(np.sum(A * B, axis=(1, 2)))[:, None, None]
    assert_allclose(sign * A, B, **tolerance)


@pytest.fixture(scope="module")
def scene():
    return structured_motion(0, n_frames=40, noise=0.3)


@pytest.fixture(scope="module")
def result(scene):
    return refine(scene.rigid, scene.motion, random_starts(0, 3, 4))


class TestOptimum:
    @pytest.mark.parametrize("seed", range(5))
    def test_exact_motion_is_recovered(self, seed):
        exact = structured_motion(seed)
        starts = random_starts(seed, 3, 8)
        result = refine(exact.rigid, exact.motion, starts)
        assert result.converged
        norm = np.linalg.norm(exact.E, axis=(1, 2), keepdims=True)
        same_up_to_sign(result.E, exact.E / norm, atol=1e-8)
        assert_allclose(result.energy.sum(), np.sum(exact.motion**2), rtol=1e-13)

        M_0, M = frames(exact.rigid, exact.motion)
        for k in range(3):
            image = M_0 @ result.E[k]
            inner = np.sum(image * M[:, :, 3 * k : 3 * k + 3], axis=(1, 2))
            ratio = inner / np.sum(image**2, axis=(1, 2)) / exact.alpha[:, k]
            assert_allclose(ratio, ratio[0], rtol=1e-6)

    def test_unit_norm_the_energy_they_say_and_no_gradient(self, scene, result):
        M_0, M = frames(scene.rigid, scene.motion)
        assert_allclose(np.linalg.norm(result.E, axis=(1, 2)), 1)
        for k in range(3):
            part = M[:, :, 3 * k : 3 * k + 3]
            energy = explained(M_0, part, result.E[k])
            assert_allclose(result.energy[k], energy, rtol=1e-13)
            half, size = gradient(M_0, part, result.E[k])
            assert np.linalg.norm(half) < 1e-6 * size
            slopes = differences(lambda E: explained(M_0, part, E), result.E[k], 1e-5)  # noqa: B023
            assert_allclose(slopes, 0, atol=1e-6 * result.energy[k])

    def test_best_of_the_starts_is_taken(self, scene):
        starts = random_starts(0, 3, 12)
        together = refine(scene.rigid, scene.motion, starts)
        alone = (starts[:, s : s + 1] for s in range(12))
        single = [refine(scene.rigid, scene.motion, start).energy for start in alone]
        # Trial steps are few, so the best start may be missed, but not by much.
        assert np.all(together.energy >= 0.99 * np.max(single, axis=0))
        assert np.all(together.energy >= np.median(single, axis=0) * (1 - 1e-9))

    def test_energies_rise_with_every_step(self, scene):
        starts = random_starts(3, 3)
        steps = (refine(scene.rigid, scene.motion, starts, n) for n in range(1, 15))
        energies = np.array([step.energy for step in steps])
        assert np.all(np.diff(energies, axis=0) >= -1e-13 * energies[-1])
        assert np.all(energies[-1] > energies[0])

    def test_few_steps_do_not_converge(self, scene):
        result = refine(scene.rigid, scene.motion, random_starts(3, 3), max_iter=1)
        assert not result.converged
        assert result.n_iter == 1

    def test_tolerance_is_kept(self, scene):
        starts = random_starts(3, 3, 4)
        best = refine(scene.rigid, scene.motion, starts)
        for tol in (1e-3, 1e-6, 1e-10):
            result = refine(scene.rigid, scene.motion, starts, tol=tol)
            assert result.converged
            assert result.n_iter <= best.n_iter
            assert np.all(result.energy >= best.energy * (1 - 5 * tol))


def test_a_step_is_that_of_alternating_least_squares(scene):
    products = motion_products(scene.rigid, scene.motion)
    M_0, M = frames(scene.rigid, scene.motion)
    starts = random_starts(1, 1, 5)[0]
    energy, after = _step(products.blocks()[0], products.rigid, starts)
    for start, f, E in zip(starts, energy, after, strict=True):
        expected, energies = alternate(M_0, M[:, :, :3], start, 1)
        assert_allclose(f, energies[0])
        assert_allclose(E, expected / np.linalg.norm(expected), atol=1e-12)


class TestInvariances:
    def test_order_of_subspaces(self, scene, result):
        order = [2, 0, 1]
        motion = scene.motion.reshape(-1, 3, 3)[:, order].reshape(-1, 9)
        other = refine(scene.rigid, motion, random_starts(0, 3, 4)[order])
        same_up_to_sign(other.E, result.E[order], atol=1e-6)

    @pytest.mark.parametrize("unit", [1e-9, 1e9])
    def test_units(self, scene, result, unit):
        for of_rigid, of_motion in ((unit, unit), (1.0, unit), (unit, 1.0)):
            rigid, motion = of_rigid * scene.rigid, of_motion * scene.motion
            other = refine(rigid, motion, random_starts(0, 3, 4))
            same_up_to_sign(other.E, result.E, atol=1e-6)
            assert_allclose(other.energy / of_motion**2, result.energy)

    def test_scale_and_sign_of_the_starts(self, scene, result):
        factors = np.array([1e-6, -1.0, 1e6, -7.0])[:, None, None]
        other = refine(scene.rigid, scene.motion, factors * random_starts(0, 3, 4))
        same_up_to_sign(other.E, result.E, atol=1e-6)


class TestDegenerate:
    def test_subspace_without_motion(self, scene, result):
        motion = scene.motion.copy()
        motion[:, 3:6] = 0
        found = refine(scene.rigid, motion, random_starts(0, 3, 4))
        assert found.converged
        assert_array_equal(found.E[1], 0)
        assert found.energy[1] == 0
        assert_allclose(found.energy[[0, 2]], result.energy[[0, 2]])

    def test_zero_starts_are_passed_over(self, scene, result):
        starts = random_starts(0, 3, 4)
        padded = np.concatenate([np.zeros((3, 1, 3, 3)), starts], axis=1)
        found = refine(scene.rigid, scene.motion, padded)
        assert_allclose(found.energy, result.energy)

    def test_only_zero_starts(self, scene):
        result = refine(scene.rigid, scene.motion, np.zeros((3, 2, 3, 3)))
        assert_array_equal(result.E, 0)

    def test_start_that_explains_nothing(self, scene):
        # The motion lies in the first direction, the start in the last.
        motion = scene.motion * ([1.0, 0.0, 0.0] * 3)
        starts = np.zeros((3, 1, 3, 3))
        starts[:, 0, :, 2] = 1.0
        result = refine(scene.rigid, motion, starts)
        assert np.isfinite(result.E).all()
        assert_array_equal(result.energy, 0)

    @pytest.mark.parametrize("n_moving", [1, 2])
    def test_subspace_that_moves_in_fewer_directions(self, scene, n_moving):
        motion = scene.motion.copy()
        motion[:, n_moving:3] = 0
        result = refine(scene.rigid, motion, random_starts(0, 3, 4))
        assert_allclose(result.E[0, :, n_moving:], 0, atol=1e-9)
        assert_allclose(np.linalg.norm(result.E, axis=(1, 2)), 1)

    @pytest.mark.parametrize("n_flat", [1, 2])
    def test_flat_rigid_object(self, scene, n_flat):
        rigid = scene.rigid.copy()
        rigid[:, 3 - n_flat :] = 0
        result = refine(rigid, scene.motion, random_starts(0, 3, 4))
        assert np.isfinite(result.E).all()
        assert np.all(result.energy > 0)

    def test_frames_that_do_not_see_the_rigid_object(self, scene):
        rigid = scene.rigid.copy()
        rigid[:8] = 0
        result = refine(rigid, scene.motion, random_starts(0, 3, 4))
        without = refine(rigid[8:], scene.motion[8:], random_starts(0, 3, 4))
        assert_allclose(result.energy, without.energy)

    def test_shark_reaches_the_best_of_random_starts(self, load_data):
        f = factorise(measurements(load_data("shark_torresani")["W2d"], False), 1)
        products = motion_products(f.rigid_motion, f.motion)
        D = recover_blocks(products, "generalized_eigen")
        start = np.linalg.pinv(D, rcond=1e-9)[:, None]
        result = refine_products(products, start)
        best = refine(f.rigid_motion, f.motion, random_starts(0, 1, 30)).energy
        assert_allclose(result.energy, best, rtol=1e-6)
        assert_allclose(result.E[0, :, 2], 0, atol=1e-9)

        total = np.sum(measurements(load_data("shark_torresani")["W2d"], False) ** 2)
        inverse_snr = (np.sum(f.motion**2) - result.energy.sum()) * 91 / total
        assert_allclose(inverse_snr, 0.00160, atol=1e-5)
