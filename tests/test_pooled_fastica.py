"""PooledFastICA: pooling by covariance and likelihood, criteria, recovery."""

import warnings

import numpy as np
import pytest
from groupings import GROUPINGS, energy_inside
from numpy.testing import assert_allclose, assert_array_equal
from refusals import refused, warned
from scenes import random_rotation, spherical_sources
from sklearn.exceptions import ConvergenceWarning

from isa_nrsfm import PooledFastICA
from isa_nrsfm.metrics import subspace_distance

IN_ORDER = np.arange(9) // 3


def independent(seed, n_samples=2000, n_signals=9):
    """Return signals of independent sources, and the true unmixing."""
    rng = np.random.default_rng(seed)
    sources = rng.laplace(size=(n_samples, n_signals)) / np.sqrt(2)
    A = random_rotation(seed, n_signals)
    return sources @ A.T, A.T


def pooled_covariance(isa, covariance):
    return isa.components_ @ covariance @ isa.components_.T


@pytest.fixture(scope="module")
def planted():
    """Signals, unmixing, and a covariance with three blocks of sources in it."""
    signals, unmixing = independent(0)
    rng = np.random.default_rng(0)
    groups = rng.permutation(9).reshape(3, 3)
    C = 0.01 * np.eye(9)
    for group in groups:
        A = rng.normal(size=(3, 3))
        C[np.ix_(group, group)] += A @ A.T
    return signals, unmixing[groups.ravel()], unmixing.T @ C @ unmixing


class TestCovariance:
    def test_general_coordinates(self, planted):
        # Signals and covariance change together.
        signals, unmixing, C = planted
        A = np.random.default_rng(1).normal(size=(9, 9))
        isa = PooledFastICA(n_init=2, random_state=0)
        isa.fit(signals @ A.T, covariance=A @ C @ A.T)
        assert subspace_distance(isa.components_ @ A, unmixing) < 0.1
        pooled = pooled_covariance(isa, A @ C @ A.T)
        share = energy_inside(pooled, IN_ORDER) / np.sum(pooled**2)
        assert_allclose(isa.criteria_.max(), share)

    @pytest.mark.parametrize("seed", range(8))
    def test_best_of_all_groupings(self, seed):
        signals, _ = independent(seed, 500)
        A = np.random.default_rng(seed).normal(size=(9, 12))
        C = A @ A.T
        isa = PooledFastICA(n_init=1, random_state=seed).fit(signals, covariance=C)
        pooled = pooled_covariance(isa, C)
        best = max(energy_inside(pooled, z) for z in GROUPINGS)
        assert_allclose(energy_inside(pooled, IN_ORDER), best)

    @pytest.mark.parametrize("unit", [1e-18, 1e18])
    def test_units_of_the_covariance(self, planted, unit):
        signals, _, C = planted
        first = PooledFastICA(n_init=2, random_state=0).fit(signals, covariance=C)
        other = PooledFastICA(n_init=2, random_state=0)
        other.fit(signals, covariance=unit * C)
        assert_array_equal(other.components_, first.components_)
        assert_allclose(other.criteria_, first.criteria_)

    def test_covariance_of_zeros(self, planted):
        isa = PooledFastICA(n_init=2, random_state=0)
        isa.fit(planted[0], covariance=np.zeros((9, 9)))
        assert_allclose(isa.criteria_, 1)

    @pytest.mark.parametrize(
        ("covariance", "message"),
        [
            (np.eye(6), r"covariance must have shape \(9, 9\); got \(6, 6\)"),
            (np.ones(9), "Expected 2D array, got 1D array"),
            (np.eye(9) + 0.1 * np.eye(9, k=1), "covariance must be symmetric"),
            (np.diag([np.nan, *np.ones(8)]), "covariance contains NaN"),
            (np.diag([np.inf, *np.ones(8)]), "covariance contains infinity"),
        ],
    )
    def test_bad_covariances_are_refused(self, planted, covariance, message):
        refused(message, PooledFastICA().fit, planted[0], covariance=covariance)


class TestLikelihood:
    def test_criteria_are_likelihoods(self):
        signals = spherical_sources(0, 300, 3)
        isa = PooledFastICA(n_init=4, random_state=0).fit(signals)
        u = np.sum(isa.transform(signals).reshape(300, 3, 3) ** 2, axis=2)
        expected = -np.sqrt(u + 0.1).mean(axis=0).sum()
        assert_allclose(isa.criteria_.max(), expected)

    @pytest.mark.filterwarnings("ignore:PooledFastICA did not converge")
    @pytest.mark.parametrize("seed", range(8))
    def test_best_of_all_groupings(self, seed):
        # So few samples that no grouping stands out.
        signals = np.random.default_rng(seed).laplace(size=(40, 9))
        isa = PooledFastICA(n_init=1, random_state=seed).fit(signals)
        square = isa.transform(signals) ** 2

        def likelihood(z):
            u = np.stack([square[:, z == k].sum(axis=1) for k in range(3)])
            return -np.sqrt(u + 0.1).mean(axis=1).sum()

        assert_allclose(likelihood(IN_ORDER), max(map(likelihood, GROUPINGS)))


class TestComponents:
    @pytest.mark.parametrize("fun", ["exp", "logcosh", "cube"])
    def test_contrast_functions(self, fun):
        signals, unmixing = independent(0, 5000)
        isa = PooledFastICA(n_init=1, fun=fun, random_state=0).fit(signals)
        assert subspace_distance(isa.components_, unmixing, 1) < 0.2

    def test_unknown_contrast_function(self):
        with pytest.raises(ValueError, match="The 'fun' parameter of PooledFastICA"):
            PooledFastICA(fun="tanh").fit(independent(0)[0])

    def test_not_converged(self):
        message = "PooledFastICA did not converge in max_iter=1 steps in the run .*"
        message += "try another fun or larger n_init or max_iter"
        isa = PooledFastICA(n_init=2, max_iter=1, random_state=0)
        signals = spherical_sources(0, 68, 9)
        warned(message, isa.fit, signals, category=ConvergenceWarning)

    def test_runs_that_are_not_kept_do_not_warn(self):
        # Only the run that is kept has to converge.
        signals = spherical_sources(3, 68, 3)
        isa = PooledFastICA(n_init=10, max_iter=60, random_state=0)
        with warnings.catch_warnings(record=True) as caught:
            warnings.simplefilter("always")
            isa.fit(signals)
        assert bool(caught) == (isa.n_iter_ == 60)


class TestCriterion:
    def test_candidates_are_subspaces_of_different_components(self, planted):
        signals, _, C = planted
        asked = []

        def criterion(candidates):
            asked.append(candidates)
            return np.zeros(len(candidates))

        isa = PooledFastICA(n_init=2, random_state=0)
        isa.fit(signals, covariance=C, criterion=criterion)
        assert {candidates.shape[1:] for candidates in asked} == {(3, 9)}
        rows = np.vstack([candidates.reshape(-1, 9) for candidates in asked])
        # All are rows of the components of the runs: 9 each.
        assert len(np.unique(rows.round(9), axis=0)) == 18
        # A row that comes twice makes no candidate for a subspace.
        assert all((np.linalg.matrix_rank(each) == 3).all() for each in asked)

    def test_no_opinion_leaves_the_first_run_as_pooled(self, planted):
        signals, _, C = planted
        isa = PooledFastICA(n_init=2, random_state=0)
        isa.fit(signals, covariance=C, criterion=lambda c: np.zeros(len(c)))
        alone = PooledFastICA(n_init=1, random_state=0).fit(signals, covariance=C)
        assert_array_equal(isa.criteria_, 0)
        pooled = pooled_covariance(isa, C)
        share = energy_inside(pooled, IN_ORDER) / np.sum(pooled**2)
        assert_allclose(share, alone.criteria_[0])

    @pytest.mark.parametrize("sign", [1.0, -1.0])
    def test_run_with_the_largest_sum_is_kept(self, sign):
        signals = spherical_sources(0, 68, 3)
        target = np.random.default_rng(1).normal(size=9)

        def criterion(candidates):
            return sign * np.max(np.abs(candidates @ target), axis=1)

        def value(isa):
            return criterion(isa.components_.reshape(3, 3, 9)).sum()

        with warnings.catch_warnings():
            warnings.simplefilter("ignore", ConvergenceWarning)
            isa = PooledFastICA(n_init=6, random_state=0)
            isa.fit(signals, criterion=criterion)
        assert np.ptp(isa.criteria_) > 0
        assert value(isa) >= isa.criteria_.max() * (1 - 1e-12 * sign)

        # No two components of different subspaces gain by changing places.
        for a in range(9):
            for b in range(a // 3 * 3 + 3, 9):
                order = np.arange(9)
                order[[a, b]] = b, a
                swapped = isa.components_[order].reshape(3, 3, 9)
                assert criterion(swapped).sum() <= value(isa) + 1e-10

    def test_the_criterion_decides_over_the_covariance(self, planted):
        # The covariance pools one way, the criterion asks for another.
        signals, unmixing, C = planted
        wanted = unmixing[[0, 3, 6, 1, 4, 7, 2, 5, 8]].reshape(3, 3, 9)

        def criterion(candidates):
            inside = np.einsum("ncj,kdj->nkcd", candidates, wanted)
            return np.max(np.sum(inside**2, axis=(2, 3)), axis=1)

        isa = PooledFastICA(n_init=1, random_state=0)
        isa.fit(signals, covariance=C, criterion=criterion)
        assert subspace_distance(isa.components_, wanted.reshape(9, 9)) < 0.1
