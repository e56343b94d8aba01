"""scikit-learn's own checks: on its tables, which are too narrow, and on wide ones.

The checks feed tables of 1 to 10 columns, mostly 3. Landmark tables have two columns a
point, and even one basis shape needs seven points: those checks must end in a
ValueError. With their tables widened to landmark tables every check must pass.
"""

import pytest
from estimator_contract import EXTRA_CHECKS, assert_only_narrow_tables_fail
from layers import may_not_converge, slow_after
from sklearn.utils import estimator_checks
from sklearn.utils.estimator_checks import parametrize_with_checks

from isa_nrsfm import AffineNRSfM, AffineNRSfMCV, FastISA

pytestmark = [
    may_not_converge,
    pytest.mark.filterwarnings("ignore:layout=:UserWarning"),  # the tables have none
]

# Checks of what a fit leaves behind, whose outcome depends on the way of fitting.
CHECKS_OF_RESULTS = (
    "check_estimators_pickle check_fit_idempotent "
    "check_methods_sample_order_invariance check_methods_subset_invariance "
    "check_readonly_memmap_input check_transformer_general "
    "check_estimators_dtypes check_transformer_preserve_dtypes"
).split()


def joint():
    """Return an estimator of the joint refinement, of few steps for speed."""
    return AffineNRSfM(1, isa=FastISA(n_init=1), max_iter=3)


def alternating():
    """Return an estimator of the other strategy and refinement."""
    return AffineNRSfM(1, isa=FastISA(n_init=1), refinement="alternating")


def search(refinement):
    """Return a search for K.

    The checks seed an estimator that they are given, but not one inside of it.
    """
    options = {"isa": FastISA(n_init=2), "max_iter": 3, "random_state": 0}
    estimator = AffineNRSfM(refinement=refinement, **options)
    return AffineNRSfMCV((1, 2), estimator=estimator, cv=2)


@parametrize_with_checks([alternating()])
def test_contract_on_landmark_tables(estimator, check, landmark_tables):
    check(estimator)


@pytest.mark.slow
@parametrize_with_checks([search(None)])
def test_contract_of_a_search_on_landmark_tables(estimator, check, landmark_tables):
    check(estimator)


@pytest.mark.parametrize("name", slow_after(3, CHECKS_OF_RESULTS))
def test_results_of_the_joint_refinement(name, landmark_tables):
    getattr(estimator_checks, name)("AffineNRSfM", joint())


# The checks of dataframe output mix tables with and without names.
@pytest.mark.filterwarnings("ignore:X does not have valid feature names:UserWarning")
@pytest.mark.filterwarnings("ignore:X has feature names:UserWarning")
@pytest.mark.parametrize("name", EXTRA_CHECKS)
@pytest.mark.parametrize("searched", slow_after(1, [False, True]))
def test_extra_checks_on_landmark_tables(name, searched, landmark_tables):
    # Names, dataframes and parameters have nothing to do with the way of fitting.
    estimator = search(None) if searched else alternating().set_params(refinement=None)
    getattr(estimator_checks, name)(type(estimator).__name__, estimator)


def test_missing_points_are_allowed():
    # The checks leave NaN alone for estimators that say so.
    all_of_them = joint(), alternating(), search(None)
    assert all(e.__sklearn_tags__().input_tags.allow_nan for e in all_of_them)


@pytest.mark.parametrize("estimator", [AffineNRSfMCV((1,)), AffineNRSfM(1)], ids=str)
def test_checks_fail_because_their_tables_are_refused(estimator):
    assert_only_narrow_tables_fail(estimator)
