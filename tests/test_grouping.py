"""Greedy grouping: gains, local optimality, comparison with all groupings."""

from itertools import combinations

import numpy as np
import pytest
from groupings import GROUPINGS, energy_inside
from numpy.testing import assert_allclose, assert_array_equal
from scenes import spherical_sources

from isa_nrsfm.isa import SqrtDensity
from isa_nrsfm.isa._grouping import (
    covariance_gains,
    likelihood_gains,
    swap_until_best,
    value_gains,
)

DENSITY = SqrtDensity()


def likelihood(signals, assignment):
    groups = (signals[assignment == k] for k in range(assignment.max() + 1))
    return sum(np.mean(DENSITY.log_density(np.sum(s**2, axis=0))) for s in groups)


def random_covariance(seed, n=9, dof=12):
    A = np.random.default_rng(seed).normal(size=(n, dof))
    return A @ A.T


def planted_covariance(seed):
    """Return a covariance with three blocks, a little of everything, and the blocks."""
    rng = np.random.default_rng(seed)
    assignment = rng.permutation(np.arange(9) // 3)
    covariance = 0.1 * random_covariance(seed)
    for k in range(3):
        members = np.flatnonzero(assignment == k)
        A = rng.normal(size=(3, 4)) * 5
        covariance[np.ix_(members, members)] += A @ A.T
    return covariance, assignment


def random_assignments(seed, n, n_signals=9, size=3):
    rng = np.random.default_rng(seed)
    return [rng.permutation(np.arange(n_signals) // size) for _ in range(n)]


def together(assignment):
    return assignment[:, None] == assignment


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

    def test_any_value_of_groups(self):
        weights = np.random.default_rng(0).normal(size=(9, 9))

        def value(groups):
            return weights[groups].sum(axis=1).max(axis=1)

        def objective(assignment):
            groups = [np.flatnonzero(assignment == k) for k in range(3)]
            return value(np.array(groups)).sum()

        gains = value_gains(value, 9)
        for assignment in random_assignments(0, 4):
            self.check(gains, objective, assignment)


class TestSwaps:
    @pytest.mark.parametrize("seed", range(5))
    def test_no_swap_improves_the_result(self, seed):
        C = random_covariance(seed)
        for first in random_assignments(seed, 4):
            before = first.copy()
            pooled = swap_until_best(first, covariance_gains(C))
            assert_array_equal(first, before)
            assert_array_equal(np.bincount(pooled), [3, 3, 3])
            best = energy_inside(C, pooled)
            assert best >= energy_inside(C, first)
            for a, b in combinations(range(9), 2):
                swapped = pooled.copy()
                swapped[[a, b]] = swapped[[b, a]]
                assert energy_inside(C, swapped) <= best * (1 + 1e-12)

    def test_nothing_to_gain_leaves_the_assignment(self):
        for C in (np.zeros((9, 9)), np.ones((9, 9)), np.eye(9)):
            for first in random_assignments(0, 3):
                assert_array_equal(swap_until_best(first, covariance_gains(C)), first)


class TestAgainstAllGroupings:
    @pytest.mark.parametrize("seed", range(8))
    def test_planted_blocks_are_found_from_any_start(self, seed):
        C, truth = planted_covariance(seed)
        for first in random_assignments(seed, 3):
            pooled = swap_until_best(first, covariance_gains(C))
            assert_array_equal(together(pooled), together(truth))
        best = max(energy_inside(C, z) for z in GROUPINGS)
        assert_allclose(energy_inside(C, truth), best)

    @pytest.mark.parametrize("seed", range(3))
    def test_likelihood_finds_the_true_subspaces(self, seed):
        sources = spherical_sources(seed, 1000, 3).T
        order = np.random.default_rng(seed).permutation(9)
        truth = (np.arange(9) // 3)[order]
        gains = likelihood_gains(sources[order], DENSITY)
        for first in random_assignments(seed, 3):
            assert_array_equal(together(swap_until_best(first, gains)), together(truth))
        values = [likelihood(sources[order], z) for z in GROUPINGS]
        assert_allclose(likelihood(sources[order], truth), max(values))
