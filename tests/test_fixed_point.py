"""The fixed-point iteration: one step by plain loops, convergence, optimality."""

import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal
from scenes import random_rotation, spherical_sources
from scipy.linalg import polar

from isa_nrsfm.isa import SqrtDensity
from isa_nrsfm.isa._base import whiten
from isa_nrsfm.isa._fixed_point import (
    fixed_point_step,
    iterate,
    log_likelihood,
    orthogonalise,
    subspace_change,
    subspace_energies,
)

DENSITY = SqrtDensity()


def white_signals(seed, n_samples=400, n_subspaces=2, size=3):
    sources = spherical_sources(seed, n_samples, n_subspaces, size)
    return whiten(sources - sources.mean(axis=0))[0]


def starts(seed, n_batch, n_signals):
    rng = np.random.default_rng(seed)
    return orthogonalise(rng.normal(size=(n_batch, n_signals, n_signals)))


def published_step(W, Z, size):
    """Return one step of FastISA, row by row."""
    new = np.empty_like(W)
    for i in range(len(W)):
        block = slice(i // size * size, i // size * size + size)
        u = np.sum((W[block] @ Z) ** 2, axis=0)
        g = -0.5 * (u + 0.1) ** -0.5
        dg = 0.25 * (u + 0.1) ** -1.5
        y = W[i] @ Z
        new[i] = (Z * (y * g)).mean(axis=1) - np.mean(g + 2 * y**2 * dg) * W[i]
    return polar(new)[0]


class TestOrthogonalise:
    def test_is_the_polar_factor(self):
        W = np.random.default_rng(0).normal(size=(4, 6, 6))
        Q = orthogonalise(W)
        for w, q in zip(W, Q, strict=True):
            assert_allclose(q, polar(w)[0], atol=1e-12)
            assert_allclose(q @ q.T, np.eye(6), atol=1e-13)

    @pytest.mark.parametrize("unit", [1e-9, 1.0, 1e9])
    def test_leaves_orthogonal_matrices(self, unit):
        Q = np.array([random_rotation(seed, 6) for seed in range(3)])
        assert_allclose(orthogonalise(unit * Q), Q, atol=1e-14)

    @pytest.mark.parametrize("smallest", [1e-1, 1e-3, 1e-5, 1e-7, 1e-12])
    def test_nearly_singular_matrices(self, smallest):
        U, V = random_rotation(0, 6), random_rotation(1, 6)
        S = np.array([3.0, 2.0, 1.0, 1.0, 0.5, smallest])
        Q = orthogonalise(np.array([(U * S) @ V, np.eye(6)]))
        # The error of the last direction grows with the condition number.
        assert_allclose(Q[0], U @ V, atol=1e-14 / smallest)
        assert_allclose(Q[0] @ Q[0].T, np.eye(6), atol=1e-13)
        assert_allclose(Q[1], np.eye(6), atol=1e-14)

    def test_singular_matrices(self):
        W = np.array([np.diag([1.0, 1.0, 0.0]), np.zeros((3, 3)), np.eye(3)])
        Q = orthogonalise(W)
        assert_allclose(Q @ Q.swapaxes(1, 2), [np.eye(3)] * 3, atol=1e-14)
        assert_allclose(Q[2], np.eye(3), atol=1e-14)


class TestObjective:
    @pytest.mark.parametrize("size", [1, 2, 3, 6])
    def test_energies_by_plain_loops(self, size):
        Y = np.random.default_rng(0).normal(size=(4, 6, 11))
        energies = subspace_energies(Y, size)
        assert energies.shape == (4, 6 // size, 11)
        for k in range(6 // size):
            part = Y[:, k * size : (k + 1) * size]
            assert_allclose(energies[:, k], np.sum(part**2, axis=1))

    @pytest.mark.parametrize("size", [1, 2, 3])
    def test_log_likelihood_by_plain_loops(self, size):
        Z, W = white_signals(0), starts(0, 3, 6)
        values = log_likelihood(W, Z, size, DENSITY)
        for w, value in zip(W, values, strict=True):
            u = ((w @ Z) ** 2).reshape(-1, size, Z.shape[1]).sum(axis=1)
            assert_allclose(value, -np.sqrt(u + 0.1).mean(axis=1).sum())


class TestStep:
    @pytest.mark.parametrize("size", [1, 2, 3])
    def test_by_plain_loops(self, size):
        Z, W = white_signals(0), starts(0, 4, 6)
        new = fixed_point_step(W, Z, size, DENSITY)
        for w, step in zip(W, new, strict=True):
            assert_allclose(step, published_step(w, Z, size), atol=1e-11)

    def test_shorter_steps_turn_less(self):
        Z, W = white_signals(0), starts(0, 4, 6)
        lengths = 1.0, 0.5, 0.25, 1 / 16
        steps = (fixed_point_step(W, Z, 3, DENSITY, length) for length in lengths)
        angles = [np.sqrt(subspace_change(W, step, 3)) for step in steps]
        assert np.all(np.diff(angles, axis=0) < 0)

    def test_length_for_each_start(self):
        Z, W = white_signals(0), starts(0, 2, 6)
        both = fixed_point_step(W, Z, 3, DENSITY, np.array([1.0, 0.25]))
        assert_array_equal(both[:1], fixed_point_step(W[:1], Z, 3, DENSITY, 1.0))
        assert_array_equal(both[1:], fixed_point_step(W[1:], Z, 3, DENSITY, 0.25))

    def test_shorter_steps_have_the_same_fixed_points(self):
        Z = white_signals(0)
        first, ends = starts(0, 1, 6), {"max_iter": 2000, "tol": 1e-14}
        W, _, converged = iterate(first, Z, 3, DENSITY, **ends)
        assert converged.all()
        for length in (1.0, 0.5, 1 / 16):
            new = fixed_point_step(W, Z, 3, DENSITY, length)
            assert subspace_change(W, new, 3).max() < 1e-13


class TestChange:
    def test_is_the_distance_of_projectors(self):
        W, V = starts(0, 5, 6), starts(1, 5, 6)
        for size in (1, 2, 3):
            expected = []
            for w, v in zip(W, V, strict=True):
                a, b = w.reshape(-1, size, 6), v.reshape(-1, size, 6)
                difference = a.swapaxes(1, 2) @ a - b.swapaxes(1, 2) @ b
                expected.append(np.max(np.sum(difference**2, axis=(1, 2))) / 2 / size)
            assert_allclose(subspace_change(W, V, size), expected)


class TestIterate:
    @pytest.mark.parametrize("size", [1, 2, 3])
    @pytest.mark.parametrize("seed", range(3))
    def test_relative_gradient_vanishes(self, size, seed):
        Z = white_signals(seed, 5000, 6 // size, size)
        first = orthogonalise(np.eye(6) + 0.2 * starts(seed, 1, 6))
        W, _, converged = iterate(first, Z, size, DENSITY, max_iter=500, tol=1e-13)
        assert converged.all()
        Y = W[0] @ Z
        u = np.repeat(subspace_energies(Y, size), size, axis=0)
        G = DENSITY.derivatives(u)[0] * Y @ Y.T / Z.shape[1]
        assert np.linalg.norm(G - G.T) < 1e-5 * np.linalg.norm(G)

    def test_result_is_orthogonal_and_the_start_stays_as_it_is(self):
        Z, first = white_signals(0), starts(0, 3, 6)
        before = first.copy()
        W, _, _ = iterate(first, Z, 3, DENSITY, max_iter=50, tol=1e-6)
        assert_array_equal(first, before)
        assert_allclose(W @ W.swapaxes(1, 2), np.eye(6)[None].repeat(3, 0), atol=1e-12)

    def test_steps_and_convergence_are_counted(self):
        Z, first = white_signals(0), starts(0, 4, 6)
        _, n_iter, converged = iterate(first, Z, 3, DENSITY, max_iter=3, tol=1e-12)
        assert_array_equal(n_iter, 3)
        assert not converged.any()
        W, n_iter, converged = iterate(first, Z, 3, DENSITY, max_iter=2000, tol=1e-8)
        assert converged.all()
        assert np.all((n_iter > 1) & (n_iter < 2000))
        new = fixed_point_step(W, Z, 3, DENSITY)
        assert subspace_change(W, new, 3).max() < 2e-8  # steps were shorter

    def test_one_subspace_has_converged_at_once(self):
        Z = white_signals(0, n_subspaces=1)
        first, ends = starts(0, 3, 3), {"max_iter": 100, "tol": 1e-4}
        _, n_iter, converged = iterate(first, Z, 3, DENSITY, **ends)
        assert_array_equal(n_iter, 1)
        assert converged.all()
