"""Strategies of independent subspace analysis: what all have to do, then each of them.

A new strategy in `isa_nrsfm.isa` is tested here without further changes.
"""

import re
import warnings

import numpy as np
import pandas as pd
import pytest
from groupings import GROUPINGS, energy_inside
from joblib import parallel_config
from layers import may_not_converge, start_may_not_converge
from made_once import made_once
from numpy.testing import assert_allclose, assert_array_equal
from refusals import refusals_of, refused, warned
from scenes import random_rotation, spherical_sources
from sklearn.base import clone
from sklearn.exceptions import ConvergenceWarning
from sklearn.utils.estimator_checks import (
    check_param_validation,
    parametrize_with_checks,
)

from isa_nrsfm import AffineNRSfM, FastISA, PooledFastICA, isa as strategies
from isa_nrsfm.datasets import make_nonrigid_tracks
from isa_nrsfm.io import load_model, save_model
from isa_nrsfm.metrics import subspace_distance

KINDS = [getattr(strategies, name) for name in strategies.__all__]
KINDS = [kind for kind in KINDS if hasattr(kind, "fit")]
STRATEGIES = [kind(n_init=2, random_state=0) for kind in KINDS]
ALL_STRATEGIES = pytest.mark.parametrize("isa", STRATEGIES, ids=lambda isa: str(isa))


@pytest.fixture
def signals():
    mixing = np.random.default_rng(1).normal(size=(6, 6))
    return spherical_sources(0, 500, 2) @ mixing.T + 3.0


@ALL_STRATEGIES
class TestStrategies:
    def test_sources_are_white_projections(self, isa, signals):
        isa.fit(signals)
        sources = isa.transform(signals)
        assert_allclose(isa.mean_, signals.mean(axis=0))
        assert_allclose(sources, (signals - isa.mean_) @ isa.components_.T)
        assert_allclose(sources.mean(axis=0), 0, atol=1e-12)
        assert_allclose(sources.T @ sources / 500, np.eye(6), atol=1e-11)
        assert_allclose(isa.fit_transform(signals), sources)

    def test_numbers_and_names(self, isa, signals):
        names = [f"s{i}" for i in range(6)]
        isa.fit(pd.DataFrame(signals, columns=names))
        assert (isa.n_features_in_, list(isa.feature_names_in_)) == (6, names)
        prefix = type(isa).__name__.lower()
        assert list(isa.get_feature_names_out()) == [f"{prefix}{i}" for i in range(6)]

    def test_signals_and_arguments_that_are_refused(self, isa, signals):
        message = "number of signals must be a multiple of subspace_size=3; got "
        refused(message + "n_features=5", isa.fit, signals[:, :5])
        refused("minimum of 3 is required", isa.fit, signals[:, :2])
        refused("weights", isa.fit, signals, weights=np.ones(500), error=TypeError)
        signals[:, 5] = signals[:, 0] - signals[:, 1]
        refused(r"6 linearly independent .* got rank 5", isa.fit, signals)
        few = np.random.default_rng(0).normal(size=(6, 6))
        refused("got rank 5 in n_samples=6 samples", isa.fit, few)

    def test_not_converged(self, isa):
        message = f"{type(isa).__name__} did not converge in max_iter=1 steps.*max_iter"
        one_step = clone(isa).set_params(max_iter=1)
        few = spherical_sources(0, 68, 9)
        warned(message, one_step.fit, few, category=ConvergenceWarning)

    @pytest.mark.parametrize(("size", "n"), [(1, 3), (2, 3), (3, 3), (3, 1)])
    def test_any_size_and_number_of_subspaces_is_found(self, isa, size, n):
        sources = spherical_sources(0, 3000, n, size)
        A = random_rotation(0, n * size)
        found = clone(isa).set_params(subspace_size=size).fit(sources @ A.T)
        assert subspace_distance(found.components_, A.T, size) < 0.08

    @may_not_converge
    def test_seeds(self, isa):
        few = spherical_sources(0, 68, 4)
        seeds = 0, 0, np.random.RandomState(0), 3
        models = (clone(isa).set_params(random_state=seed) for seed in seeds)
        first, same, generator, other = (each.fit(few).components_ for each in models)
        assert_array_equal(same, first)
        assert_array_equal(generator, first)
        assert np.abs(other - first).max() > 1e-3

    @pytest.mark.parametrize("unit", [1e-9, 1e9])
    def test_units_offset_and_order_of_samples(self, isa, signals, unit, rng):
        first = clone(isa).fit(signals).components_
        other = isa.fit(unit * (rng.permutation(signals) + 1.0)).components_
        assert_allclose(unit * other, first, atol=1e-8)

    @may_not_converge
    def test_is_saved_with_a_model(self, isa, signals, tmp_path):
        table = make_nonrigid_tracks(40, 20, 2, noise=0.01, random_state=0).data
        model = AffineNRSfM(2, isa=isa, refinement=None, random_state=0).fit(table)
        save_model(model, tmp_path / "model.npz")
        loaded = load_model(tmp_path / "model.npz").isa_
        assert type(loaded) is type(isa)
        assert loaded.get_params() == model.isa_.get_params()
        assert_array_equal(loaded.transform(signals), model.isa_.transform(signals))


@pytest.mark.parametrize("kind", KINDS)
def test_bad_values_of_parameters(kind):
    check_param_validation(kind.__name__, kind())


# With subspaces of one signal any number of columns will do, so no check may fail that
# feeds linearly independent signals. Many checks feed normal data, on which independent
# components do not converge.
@may_not_converge
@parametrize_with_checks(
    [kind(subspace_size=1, n_init=2) for kind in KINDS],
    expected_failed_checks=lambda estimator: {
        "check_array_api_input": "feeds signals that depend on each other"
    },
)
def test_scikit_learn_checks(estimator, check):
    check(estimator)


# --- FastISA: recovery, optimality, what the result may not depend on ----------------


def mixed(seed, n_samples=3000, n_subspaces=4, size=3):
    """Return signals of independent spherical sources, and the true unmixing."""
    sources = spherical_sources(seed, n_samples, n_subspaces, size)
    A = random_rotation(seed, n_subspaces * size)
    return sources @ A.T, A.T


# Signals of the size of landmark data: 68 points, 9 subspaces
FEW = mixed(0, 68, 9)[0]


class TestOptimality:
    def test_relative_gradient_vanishes(self):
        signals, _ = mixed(0, n_subspaces=3)
        isa = FastISA(n_init=1, tol=1e-13, random_state=0).fit(signals)
        Y = isa.transform(signals).T
        u = np.repeat(np.sum(Y.reshape(3, 3, -1) ** 2, axis=1), 3, axis=0)
        G = -0.5 / np.sqrt(u + 0.1) * Y @ Y.T / 3000
        assert np.linalg.norm(G - G.T) < 1e-5 * np.linalg.norm(G)

    @pytest.mark.parametrize("kind", [FastISA, PooledFastICA])
    def test_likelihood_is_that_of_the_sources(self, kind):
        signals = spherical_sources(0, 300, 3)
        isa = kind(n_init=4, random_state=0).fit(signals)
        u = np.sum(isa.transform(signals).reshape(300, 3, 3) ** 2, axis=2)
        expected = -np.sqrt(u + 0.1).mean(axis=0).sum()
        found = isa.log_likelihood_ if kind is FastISA else isa.criteria_.max()
        assert_allclose(found, expected)

    def test_starts_that_agree_are_enough(self):
        signals, _ = mixed(0, n_subspaces=3)
        isa = FastISA(n_init=30, random_state=0).fit(signals)
        assert len(isa.log_likelihoods_) == len(isa.n_iters_) == 3


class TestInvariances:
    @may_not_converge
    def test_threads_change_no_bit(self):
        isa = FastISA(n_init=24, tol=1e-2, random_state=0)  # the last batches at once
        one = clone(isa).fit(FEW)
        assert len(one.log_likelihoods_) == 24
        with parallel_config(backend="threading", n_jobs=3):
            three = isa.fit(FEW)
        assert_array_equal(three.components_, one.components_)
        assert_array_equal(three.log_likelihoods_, one.log_likelihoods_)

    @may_not_converge
    def test_fewer_starts_are_the_first_of_more_and_the_likeliest_is_kept(self):
        given = {"tol": 1e-2, "random_state": 0}
        one, nine, ten = (FastISA(n_init=n, **given).fit(FEW) for n in (1, 9, 10))
        for isa, n in ((one, 1), (nine, 9), (ten, 10)):
            assert_array_equal(isa.log_likelihoods_, ten.log_likelihoods_[:n])
            assert_array_equal(isa.n_iters_, ten.n_iters_[:n])
            best = isa.log_likelihoods_.argmax()
            found = isa.log_likelihood_, isa.n_iter_
            assert found == (isa.log_likelihoods_[best], isa.n_iters_[best])
        assert np.ptp(ten.log_likelihoods_) > 1e-3

    def test_general_mixing_leaves_the_subspaces(self, rng):
        signals, A = mixed(0, n_subspaces=3)[0], rng.normal(size=(9, 9))
        isa = FastISA(n_init=1, tol=1e-10, random_state=0)
        first, other = clone(isa).fit(signals), isa.fit(signals @ A.T)
        distance = subspace_distance(other.components_ @ A, first.components_)
        assert distance < 1e-4
        assert_allclose(other.log_likelihood_, first.log_likelihood_, atol=1e-8)


def test_verbose_prints_a_line_for_each_batch(capsys):
    isa = FastISA(n_init=10, tol=1e-2, random_state=0, verbose=1).fit(FEW)
    lines = capsys.readouterr().out.splitlines()
    # It ends early if the best starts agree.
    counts = [int(re.match(r"\[FastISA\] (\d+)/10 starts, ", x)[1]) for x in lines]
    assert counts == sorted(set(counts))
    assert counts[-1] <= 10
    assert lines[-1].endswith(f" starts, best {isa.log_likelihood_:.6g}")


# --- PooledFastICA: pooling by covariance and likelihood, criteria, recovery ---------


IN_ORDER = np.arange(9) // 3


def share_inside(isa, covariance):
    """Return the share of the energy of a covariance in the blocks of subspaces."""
    pooled = isa.components_ @ covariance @ isa.components_.T
    return energy_inside(pooled, IN_ORDER) / np.sum(pooled**2)


@made_once
def planted_signals():
    """Signals, unmixing, and a covariance with three blocks of sources in it."""
    rng, A = np.random.default_rng(0), random_rotation(0, 9)
    signals = rng.laplace(size=(2000, 9)) / np.sqrt(2) @ A.T
    groups = rng.permutation(9).reshape(3, 3)
    C = 0.01 * np.eye(9)
    for group in groups:
        root = rng.normal(size=(3, 3))
        C[np.ix_(group, group)] += root @ root.T
    return signals, A.T[groups.ravel()], A @ C @ A.T


def test_covariance_in_general_coordinates():
    # Signals and covariance change together.
    signals, unmixing, C = planted_signals()
    A = np.random.default_rng(1).normal(size=(9, 9))
    isa = PooledFastICA(n_init=2, random_state=0)
    isa.fit(signals @ A.T, covariance=A @ C @ A.T)
    assert subspace_distance(isa.components_ @ A, unmixing) < 0.1
    assert_allclose(isa.criteria_.max(), share_inside(isa, A @ C @ A.T))


def pooled(factor=1.0):
    """Return the analysis of planted signals, for a multiple of their covariance."""
    signals, _, C = planted_signals()
    return PooledFastICA(n_init=2, random_state=0).fit(signals, covariance=factor * C)


@start_may_not_converge
@pytest.mark.parametrize("seed", range(2))
def test_likeliest_of_all_groupings(seed):
    # So few samples that no grouping stands out.
    signals = np.random.default_rng(seed).laplace(size=(40, 9))
    isa = PooledFastICA(n_init=1, random_state=seed).fit(signals)
    square = isa.transform(signals) ** 2

    def likelihood(z):
        u = np.stack([square[:, z == k].sum(axis=1) for k in range(3)])
        return -np.sqrt(u + 0.1).mean(axis=1).sum()

    assert_allclose(likelihood(IN_ORDER), max(map(likelihood, GROUPINGS)))


def test_runs_that_are_not_kept_do_not_warn():
    # Only the run that is kept has to converge.
    signals = spherical_sources(3, 68, 3)
    isa = PooledFastICA(n_init=10, max_iter=60, random_state=0)
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        isa.fit(signals)
    assert bool(caught) == (isa.n_iter_ == 60)


class TestCriterion:
    @may_not_converge
    @pytest.mark.parametrize("sign", [1.0, -1.0])
    def test_run_with_the_largest_sum_is_kept(self, sign):
        signals = spherical_sources(0, 68, 3)
        target = np.random.default_rng(1).normal(size=9)

        def criterion(candidates):
            return sign * np.max(np.abs(candidates @ target), axis=1)

        def value(isa):
            return criterion(isa.components_.reshape(3, 3, 9)).sum()

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

    def test_the_criterion_decides_over_the_covariance(self):
        # The covariance pools one way, the criterion asks for another.
        signals, unmixing, C = planted_signals()
        wanted = unmixing[[0, 3, 6, 1, 4, 7, 2, 5, 8]].reshape(3, 3, 9)

        def criterion(candidates):
            inside = np.einsum("ncj,kdj->nkcd", candidates, wanted)
            return np.max(np.sum(inside**2, axis=(2, 3)), axis=1)

        isa = PooledFastICA(n_init=1, random_state=0)
        isa.fit(signals, covariance=C, criterion=criterion)
        assert subspace_distance(isa.components_, wanted.reshape(9, 9)) < 0.1


test_refusals = refusals_of("isa_contract", globals())
