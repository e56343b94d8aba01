"""Steps of independent subspace analysis: fixed point, gains of swaps."""

import numpy as np
import pytest
from groupings import energy_inside
from numpy.testing import assert_allclose, assert_array_equal
from scenes import random_rotation, spherical_sources
from scipy.linalg import polar

from isa_nrsfm.isa import SqrtDensity
from isa_nrsfm.isa._base import whiten
from isa_nrsfm.isa._steps import (
    covariance_gains,
    fixed_point_step,
    iterate,
    likelihood_gains,
    orthogonalise,
    subspace_change,
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


class TestStep:
    @pytest.mark.parametrize("size", [1, 2, 3])
    def test_by_plain_loops(self, size):
        Z, W = white_signals(0), starts(0, 4, 6)
        new = fixed_point_step(W, Z, size, DENSITY)
        for w, step in zip(W, new, strict=True):
            assert_allclose(step, published_step(w, Z, size), atol=1e-11)

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


DENSITY = SqrtDensity()


def likelihood(signals, assignment):
    groups = (signals[assignment == k] for k in range(assignment.max() + 1))
    return sum(np.mean(DENSITY.log_density(np.sum(s**2, axis=0))) for s in groups)


def random_covariance(seed, n=9, dof=12):
    A = np.random.default_rng(seed).normal(size=(n, dof))
    return A @ A.T


def random_assignments(seed, n, n_signals=9, size=3):
    rng = np.random.default_rng(seed)
    return [rng.permutation(np.arange(n_signals) // size) for _ in range(n)]


class TestGains:
    """The gain of every swap, against the difference of the objective."""

    def check(self, gains, objective, assignment):
        gain, size = gains(assignment)
        assert_allclose(gain, gain.T)
        assert size > 0
        now = objective(assignment)
        for a in range(len(assignment)):
            for b in range(len(assignment)):
                if assignment[a] != assignment[b]:
                    swapped = assignment.copy()
                    swapped[[a, b]] = swapped[[b, a]]
                    difference = objective(swapped) - now
                    assert_allclose(gain[a, b], difference, atol=1e-12 * size)

    @pytest.mark.parametrize("seed", range(3))
    @pytest.mark.parametrize("size", [1, 2, 3, 4])
    def test_covariance(self, seed, size):
        C = random_covariance(seed, 12)
        for assignment in random_assignments(seed, 3, 12, size):
            gains = covariance_gains(C)
            self.check(gains, lambda z: energy_inside(C, z) / 2, assignment)

    @pytest.mark.parametrize("seed", range(3))
    @pytest.mark.parametrize("size", [1, 2, 3, 4])
    def test_likelihood(self, seed, size):
        signals = spherical_sources(seed, 60, 4).T
        gains = likelihood_gains(signals, DENSITY)
        # The same function for several assignments: what it remembers is not stale.
        for assignment in random_assignments(seed, 3, 12, size):
            self.check(gains, lambda z: likelihood(signals, z), assignment)
