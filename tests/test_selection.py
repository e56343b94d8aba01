"""AffineNRSfMCV: what is tried, held out and chosen, and how near to a plain search."""

import re
from typing import ClassVar

import numpy as np
import pytest
import sklearn
from layers import may_not_converge
from numpy.testing import assert_allclose, assert_array_equal
from refusals import refusals_of, refused
from sklearn.exceptions import ConvergenceWarning
from sklearn.model_selection import GridSearchCV, LeaveOneGroupOut, cross_val_score
from sklearn.pipeline import make_pipeline
from sklearn.preprocessing import FunctionTransformer

from isa_nrsfm import AffineNRSfM, AffineNRSfMCV, FastISA
from isa_nrsfm.datasets import make_nonrigid_tracks

X = make_nonrigid_tracks(60, 20, 2, noise=0.01, random_state=0).data
PERSON = np.arange(len(X)) % 6


def inner(**parameters):
    return AffineNRSfM(random_state=0, **parameters)


def quick(**parameters):
    """Return a quick estimator, for tests of what a search does with it."""
    return inner(isa=FastISA(n_init=1), **{"refinement": None} | parameters)


@pytest.fixture(scope="module")
def fitted():
    return AffineNRSfMCV(range(1, 4), estimator=inner(), cv=3).fit(X)


def test_the_number_that_made_the_table_is_found(fitted):
    assert fitted.n_components_ == 2
    assert fitted.best_index_ == 1
    assert fitted.best_score_ == fitted.cv_results_["mean_test_score"].max()
    assert fitted.n_splits_ == 3
    assert fitted.refit_time_ > 0


@pytest.mark.slow
def test_results_are_those_of_a_plain_search(fitted):
    grid = {"n_components": [1, 2, 3]}
    plain = GridSearchCV(inner(), grid, cv=3, refit=False).fit(X)
    ours, theirs = fitted.cv_results_, plain.cv_results_
    for name in ("split0_test_score", "split2_test_score", "mean_test_score"):
        assert_allclose(ours[name], theirs[name], rtol=0.01)
    assert_array_equal(ours["param_n_components"], [1, 2, 3])
    assert_array_equal(ours["rank_test_score"], theirs["rank_test_score"])
    assert ours["params"] == theirs["params"]
    # Names and meanings are those of scikit-learn, but for one of the path.
    assert set(ours) - set(theirs) == {"path_fit_time"}
    assert set(theirs) <= set(ours)
    scores = [ours[f"split{i}_test_score"] for i in range(3)]
    assert_allclose(ours["std_test_score"], np.std(scores, axis=0))


def test_the_best_estimator_is_the_fit_of_all_frames(fitted):
    alone, best, rows = inner(n_components=2).fit(X), fitted.best_estimator_, X[:7]
    assert_array_equal(best.alpha_, alone.alpha_)
    assert best.camera_noise_ratio_ == alone.camera_noise_ratio_
    assert best.n_components == 2
    alpha = best.transform(rows)
    assert_array_equal(fitted.transform(rows), alpha)
    assert_array_equal(fitted.inverse_transform(alpha), best.inverse_transform(alpha))
    assert fitted.score(rows) == best.score(rows)
    assert fitted.n_features_in_ == X.shape[1]
    assert_array_equal(fitted.get_feature_names_out(), ["alpha_1", "alpha_2"])


@pytest.mark.slow
def test_neither_order_nor_workers_change_the_result():
    fitted = AffineNRSfMCV((1, 2, 3), estimator=inner(), cv=3).fit(X)
    other = AffineNRSfMCV((3, 1, 2), estimator=inner(), cv=3, n_jobs=2).fit(X)
    for name in ("param_n_components", "split1_test_score"):
        assert_array_equal(other.cv_results_[name], fitted.cv_results_[name])


@pytest.mark.slow
def test_the_number_is_found_with_calibrated_cameras_and_missing_points():
    options = {"camera": "weak_perspective", "noise": 0.01, "missing": 0.1}
    table = make_nonrigid_tracks(60, 25, 2, **options, random_state=0).data
    search = AffineNRSfMCV([1, 2, 3], estimator=inner(camera="weak_perspective"))
    assert search.fit(table).n_components_ == 2


def test_lines_come_while_the_search_runs_and_parameters_stay(capsys):
    estimator, tried = quick(n_components=5), [2, 1]
    AffineNRSfMCV(tried, estimator=estimator, cv=2, verbose=1).fit(X)
    assert tried == [2, 1]
    assert estimator.n_components == 5
    assert not hasattr(estimator, "alpha_")
    lines = capsys.readouterr().out.splitlines()
    names = [f"[AffineNRSfMCV] n_components={k}" for k in (1, 2)]
    assert [line.split(":")[0] for line in lines] == names
    assert all("held-out error" in line and line.endswith(" s") for line in lines)


@pytest.mark.slow
def test_groups_are_routed_through_a_pipeline():
    search = AffineNRSfMCV((1,), estimator=quick(), cv=LeaveOneGroupOut())
    with sklearn.config_context(enable_metadata_routing=True):
        pipeline = make_pipeline(FunctionTransformer(), search)
        pipeline.fit(X, groups=PERSON)
    assert pipeline[-1].n_splits_ == 6


@may_not_converge
def test_metadata_are_routed_to_a_scorer():
    with sklearn.config_context(enable_metadata_routing=True):
        search = AffineNRSfMCV((1, 2), estimator=quick(), scoring=Weighing())
        search.fit(X, weight=np.ones(len(X)))
    # The weights of the held-out rows only
    assert_array_equal(search.cv_results_["split0_test_score"], [19.0, 18.0])


class Weighing(sklearn.utils._metadata_requests._MetadataRequester):
    """A scorer that asks for a weight of each row."""

    __metadata_request__score: ClassVar = {"weight": True}

    def __call__(self, estimator, X, y=None, weight=None):
        return float(np.sum(weight)) - len(estimator.basis_)

    def score(self, X, weight=None):
        """Tell the metadata of the method."""


def searched(select="best", **scores):
    """Return a search with these scores of two parts, by the number of basis shapes."""
    first = X[0, 0]

    def scorer(estimator, X, y=None):
        part = int(np.any(X[:, 0] == first))
        return np.broadcast_to(scores[f"K{len(estimator.basis_)}"], 2)[part]

    estimator = quick()
    options = {"cv": 2, "scoring": scorer, "select": select}
    return AffineNRSfMCV((1, 2, 3), estimator=estimator, **options).fit(X)


# The standard error of the best is 0.0015.
BEST = (-0.0115, -0.0085)


def test_the_largest_number_is_checked_before_any_fit(monkeypatch):
    monkeypatch.delattr(AffineNRSfM, "fit")
    refused("n_components=500", AffineNRSfMCV((1, 500)).fit, X)


@may_not_converge
def test_a_table_of_noise_is_told():
    noise = np.random.default_rng(0).normal(size=(45, 24))
    estimator = quick()
    with pytest.warns(UserWarning, match="better than the centroid"):
        search = AffineNRSfMCV((1, 2), estimator=estimator).fit(noise)
    assert search.best_score_ < -1


def test_only_the_chosen_number_has_a_consensus():
    def scorer(estimator, X, y=None):
        raise ValueError(estimator.refinement)

    estimator = inner(refinement="consensus", camera="weak_perspective")
    search = AffineNRSfMCV((1,), estimator=estimator, cv=2, scoring=scorer)
    refused("joint", search.fit, X[:40, :24])


def test_rows_without_points_are_told_once():
    table = X[:40, :24].copy()
    table[3] = np.nan
    with pytest.warns(match="no point is visible in 1 of 40 rows") as told:
        AffineNRSfMCV((1,), estimator=quick(), cv=2).fit(table)
    assert len(told) == 1


def test_fits_that_do_not_converge_are_counted():
    search = AffineNRSfMCV((1, 2), estimator=inner(max_iter=2), cv=2)
    with pytest.warns(ConvergenceWarning) as told:
        search.fit(X)
    first = str(told[0].message)
    assert re.match(r"not all fits .* of 1, 2 did not. Increase", first)


# Whether FastICA converges for this table depends on the rounding of the BLAS.
@may_not_converge
def test_held_out_rows_are_not_fitted_without_joint_refinement():
    table, estimator = X[:, :20], quick(n_components=1)
    search = AffineNRSfMCV((1,), estimator=estimator, cv=2).fit(table)
    ours = [search.cv_results_[f"split{i}_test_score"][0] for i in range(2)]
    assert_allclose(ours, cross_val_score(estimator, table, cv=2), rtol=1e-9)


test_refusals = refusals_of("selection", globals())
