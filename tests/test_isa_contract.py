"""Strategies of independent subspace analysis: what all have to do.

A new strategy in `isa_nrsfm.isa` is tested here without further changes.
"""

import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal
from refusals import refused
from scenes import random_rotation, spherical_sources
from sklearn.base import clone
from sklearn.exceptions import ConvergenceWarning
from sklearn.utils.estimator_checks import parametrize_with_checks

from isa_nrsfm import AffineNRSfM, isa as strategies
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
        pd = pytest.importorskip("pandas")
        names = [f"s{i}" for i in range(6)]
        isa.fit(pd.DataFrame(signals, columns=names))
        assert isa.n_features_in_ == 6
        assert list(isa.feature_names_in_) == names
        prefix = type(isa).__name__.lower()
        assert list(isa.get_feature_names_out()) == [f"{prefix}{i}" for i in range(6)]

    def test_wrong_number_of_signals(self, isa, signals):
        message = "number of signals must be a multiple of subspace_size=3; got "
        refused(message + "n_features=5", isa.fit, signals[:, :5])
        refused("minimum of 3 is required", isa.fit, signals[:, :2])

    def test_dependent_signals(self, isa, signals):
        signals[:, 5] = signals[:, 0] - signals[:, 1]
        refused(r"6 linearly independent .* got rank 5", isa.fit, signals)
        few = np.random.default_rng(0).normal(size=(6, 6))
        refused("got rank 5 in n_samples=6 samples", isa.fit, few)

    def test_not_converged(self, isa):
        isa = clone(isa).set_params(max_iter=1)
        with pytest.warns(ConvergenceWarning, match="did not converge in max_iter=1"):
            isa.fit(spherical_sources(0, 68, 9))

    def test_arguments_that_are_not_known(self, isa, signals):
        refused("weights", isa.fit, signals, weights=np.ones(500), error=TypeError)

    @pytest.mark.parametrize("size", [1, 2, 3, 4])
    def test_any_size_of_subspaces_is_found(self, isa, size):
        sources = spherical_sources(0, 3000, 3, size)
        A = random_rotation(0, 3 * size)
        found = clone(isa).set_params(subspace_size=size).fit(sources @ A.T)
        assert subspace_distance(found.components_, A.T, size) < 0.08

    def test_one_subspace(self, isa):
        sources = spherical_sources(0, 200, 1)
        found = isa.fit(sources)
        assert found.components_.shape == (3, 3)
        covariance = np.cov(found.transform(sources).T, bias=True)
        assert_allclose(covariance, np.eye(3), atol=1e-12)

    @pytest.mark.filterwarnings("ignore::sklearn.exceptions.ConvergenceWarning")
    def test_seeds(self, isa):
        few = spherical_sources(0, 68, 4)
        seeds = 0, 0, np.random.RandomState(0), 3
        models = (clone(isa).set_params(random_state=seed) for seed in seeds)
        first, same, generator, other = (each.fit(few).components_ for each in models)
        assert_array_equal(same, first)
        assert_array_equal(generator, first)
        assert np.abs(other - first).max() > 1e-3

    def test_order_of_samples(self, isa, signals):
        order = np.random.default_rng(0).permutation(len(signals))
        first = clone(isa).fit(signals).components_
        assert_allclose(isa.fit(signals[order]).components_, first, atol=1e-8)

    def test_signals_in_different_units(self, isa, signals):
        sources = isa.fit_transform(signals * [1e3, 1.0, 1.0, 1e-3, 1e-6, 1.0])
        assert_allclose(sources.T @ sources / 500, np.eye(6), atol=1e-11)

    @pytest.mark.parametrize("unit", [1e-9, 1e9])
    def test_units_and_offset(self, isa, signals, unit):
        first = clone(isa).fit(signals).components_
        other = isa.fit(unit * (signals + 1.0)).components_
        assert_allclose(unit * other, first, atol=1e-8)

    @pytest.mark.filterwarnings("ignore::sklearn.exceptions.ConvergenceWarning")
    def test_is_saved_with_a_model(self, isa, tmp_path):
        table = make_nonrigid_tracks(40, 20, 2, noise=0.01, random_state=0).data
        model = AffineNRSfM(2, isa=isa, refinement=None, random_state=0).fit(table)
        save_model(model, tmp_path / "model.npz")
        loaded = load_model(tmp_path / "model.npz").isa_
        assert type(loaded) is type(isa)
        assert loaded.get_params() == model.isa_.get_params()
        signals = np.random.default_rng(0).normal(size=(5, 6))
        assert_array_equal(loaded.transform(signals), model.isa_.transform(signals))


@pytest.mark.parametrize("kind", KINDS)
class TestParameters:
    @pytest.mark.parametrize(
        ("name", "value"),
        [
            ("subspace_size", 0),
            ("subspace_size", 1.5),
            ("n_init", 0),
            ("max_iter", 0),
            ("tol", 0.0),
            ("random_state", "seed"),
        ],
    )
    def test_bad_values(self, kind, signals, name, value):
        refused(f"The '{name}' parameter of", kind(**{name: value}).fit, signals)


# With subspaces of one signal any number of columns will do, so no check may fail that
# feeds linearly independent signals. Many checks feed normal data, on which independent
# components do not converge.
@pytest.mark.filterwarnings("ignore::sklearn.exceptions.ConvergenceWarning")
@parametrize_with_checks(
    [kind(subspace_size=1, n_init=2) for kind in KINDS],
    expected_failed_checks=lambda estimator: {
        "check_array_api_input": "feeds signals that depend on each other"
    },
)
def test_scikit_learn_checks(estimator, check):
    check(estimator)
