"""FastISA: recovery, optimality, what the result may not depend on."""

import warnings

import numpy as np
import pytest
from joblib import parallel_config
from numpy.testing import assert_allclose, assert_array_equal
from refusals import refused, warned
from scenes import random_rotation, spherical_sources
from scipy.optimize import approx_fprime, check_grad
from sklearn.exceptions import ConvergenceWarning

from isa_nrsfm import FastISA
from isa_nrsfm.isa import SqrtDensity
from isa_nrsfm.metrics import subspace_distance


def mixed(seed, n_samples=3000, n_subspaces=4, size=3):
    """Return signals of independent spherical sources, and the true unmixing."""
    sources = spherical_sources(seed, n_samples, n_subspaces, size)
    A = random_rotation(seed, n_subspaces * size)
    return sources @ A.T, A.T


def few_samples(seed=0):
    """Return signals of the size of landmark data: 68 points, 9 subspaces."""
    return mixed(seed, 68, 9)[0]


class CauchyDensity:
    """Another density: ``F(u) = -log(1 + u)``."""

    def log_density(self, energy):
        return -np.log1p(energy)

    def derivatives(self, energy):
        root = 1.0 / (1.0 + energy)
        return -root, root**2


class TestRecovery:
    def test_another_density(self):
        signals, unmixing = mixed(0)
        isa = FastISA(n_init=2, density=CauchyDensity(), random_state=0).fit(signals)
        assert subspace_distance(isa.components_, unmixing) < 0.06


class TestOptimality:
    def test_relative_gradient_vanishes(self):
        signals, _ = mixed(0, 3000, n_subspaces=3)
        isa = FastISA(n_init=1, tol=1e-13, random_state=0).fit(signals)
        Y = isa.transform(signals).T
        u = np.repeat(np.sum(Y.reshape(3, 3, -1) ** 2, axis=1), 3, axis=0)
        G = -0.5 / np.sqrt(u + 0.1) * Y @ Y.T / 3000
        assert np.linalg.norm(G - G.T) < 1e-5 * np.linalg.norm(G)

    def test_likelihood_is_that_of_the_sources(self):
        signals = few_samples()
        isa = FastISA(n_init=4, random_state=0).fit(signals)
        u = np.sum(isa.transform(signals).reshape(68, 9, 3) ** 2, axis=2)
        expected = -np.sqrt(u + 0.1).mean(axis=0).sum()
        assert_allclose(isa.log_likelihood_, expected)

    def test_largest_likelihood_is_kept(self):
        isa = FastISA(n_init=12, random_state=0).fit(few_samples())
        assert isa.log_likelihoods_.shape == isa.n_iters_.shape == (12,)
        assert np.ptp(isa.log_likelihoods_) > 1e-3
        best = isa.log_likelihoods_.argmax()
        assert isa.log_likelihood_ == isa.log_likelihoods_[best]
        assert isa.n_iter_ == isa.n_iters_[best]


class TestInvariances:
    @pytest.mark.slow
    def test_n_jobs_change_no_bit(self):
        signals = few_samples()
        kwargs = {"n_init": 18, "random_state": 0}
        one, two = (FastISA(**kwargs, n_jobs=n).fit(signals) for n in (1, 2))
        assert_array_equal(two.components_, one.components_)
        assert_array_equal(two.log_likelihoods_, one.log_likelihoods_)
        assert_array_equal(two.n_iters_, one.n_iters_)

    def test_threads_change_no_bit(self):
        signals, _ = mixed(0, 500)
        one = FastISA(n_init=17, random_state=0).fit(signals)
        with parallel_config(backend="threading", n_jobs=3):
            three = FastISA(n_init=17, random_state=0).fit(signals)
        assert_array_equal(three.components_, one.components_)
        assert_array_equal(three.log_likelihoods_, one.log_likelihoods_)

    @pytest.mark.parametrize("n_init", [1, 8, 9])
    def test_fewer_starts_are_the_first_of_more(self, n_init):
        signals = few_samples()
        more = FastISA(n_init=10, random_state=0).fit(signals)
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", ConvergenceWarning)
            fewer = FastISA(n_init=n_init, random_state=0).fit(signals)
        assert_array_equal(fewer.log_likelihoods_, more.log_likelihoods_[:n_init])
        assert_array_equal(fewer.n_iters_, more.n_iters_[:n_init])

    def test_general_mixing_leaves_the_subspaces(self):
        signals, _ = mixed(0, n_subspaces=3)
        A = np.random.default_rng(1).normal(size=(9, 9))
        first = FastISA(n_init=1, tol=1e-10, random_state=0).fit(signals)
        other = FastISA(n_init=1, tol=1e-10, random_state=0).fit(signals @ A.T)
        distance = subspace_distance(other.components_ @ A, first.components_)
        assert distance < 1e-4
        assert_allclose(other.log_likelihood_, first.log_likelihood_, atol=1e-8)


class TestEdges:
    def test_one_signal(self):
        isa = FastISA(1, n_init=1, random_state=0).fit([[1.0], [2.0], [6.0]])
        assert_allclose(np.abs(isa.transform([[3.0]])), 0, atol=1e-12)

    def test_hardly_more_samples_than_signals(self):
        signals = np.random.default_rng(0).normal(size=(14, 12))
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", ConvergenceWarning)
            isa = FastISA(n_init=2, random_state=0).fit(signals)
        assert np.isfinite(isa.components_).all()

    def test_not_converged(self):
        message = "FastISA did not converge in max_iter=1 steps: its best start still "
        message += "changes. Increase max_iter or tol"
        isa = FastISA(n_init=2, max_iter=1, random_state=0)
        warned(message, isa.fit, few_samples(), category=ConvergenceWarning)
        assert_array_equal(isa.n_iters_, 2)  # one of either iteration

    def test_verbose_prints_a_line_for_each_batch(self, capsys):
        isa = FastISA(n_init=20, random_state=0, verbose=1).fit(few_samples())
        lines = capsys.readouterr().out.splitlines()
        assert len(lines) == 2
        assert lines[-1] == f"[FastISA] 20/20 starts, best {isa.log_likelihood_:.6g}"

    @pytest.mark.parametrize("density", [3, "sqrt", object()])
    def test_something_that_is_no_density(self, density):
        with pytest.raises(ValueError, match="The 'density' parameter of FastISA"):
            FastISA(density=density).fit(few_samples())


ENERGIES = [0.0, 1e-6, 0.1, 1.0, 3.0, 50.0, 1e4]


@pytest.mark.parametrize("eps", [0.01, 0.1, 2.0])
@pytest.mark.parametrize("energy", ENERGIES)
class TestDerivatives:
    def test_first(self, eps, energy):
        density = SqrtDensity(eps=eps)
        error = check_grad(
            lambda u: density.log_density(u)[0],
            lambda u: density.derivatives(u)[0],
            np.array([energy]),
            epsilon=1e-6 * (energy + eps),
        )
        assert error < 1e-5 * abs(density.derivatives(energy)[0])

    def test_second(self, eps, energy):
        density = SqrtDensity(eps=eps)
        step = 1e-6 * (energy + eps)
        numerical = approx_fprime(
            np.array([energy]), lambda u: density.derivatives(u)[0][0], step
        )
        assert_allclose(density.derivatives(energy)[1], numerical[0], rtol=1e-5)


class TestSqrtDensity:
    @pytest.mark.parametrize("eps", [0.0, -0.5, np.nan])
    def test_eps_must_be_positive(self, eps):
        density = SqrtDensity(eps=eps)
        for method in (density.log_density, density.derivatives):
            refused(f"eps must be above zero; got {eps}", method, np.ones(3))
