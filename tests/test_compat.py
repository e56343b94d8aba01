"""The fallbacks of private names of scikit-learn, and where warnings point to."""

import subprocess
import sys
import warnings
from numbers import Integral, Real
from pathlib import Path

import numpy as np
import pandas as pd
import pytest
from sklearn.pipeline import make_pipeline
from sklearn.preprocessing import FunctionTransformer

from isa_nrsfm import AffineNRSfM
from isa_nrsfm._compat import plain_checks, scikit_learn
from isa_nrsfm._compat.scikit_learn import is_pandas_na, number_of_rows, taken_rows
from isa_nrsfm.datasets import make_face_tracks

CONSTRAINTS = {
    "number": lambda of: [of.Interval(Integral, 1, None, closed="left")],
    "open": lambda of: [None, of.Interval(Real, 0, None, closed="neither")],
    "share": lambda of: [of.Interval(Real, 0, 1, closed="left")],
    "closed": lambda of: [of.Interval(Real, 1e-12, 0.25, closed="both")],
    "text": lambda of: [of.StrOptions({"a", "b"}), None],
    "methods": lambda of: [None, of.HasMethods(["fit", "get_params"])],
    "flag": lambda of: ["boolean", str],
    "seed": lambda of: ["random_state"],
    "verbose": lambda of: ["verbose"],
}
VALUES = [
    None, True, False, np.True_, -1, 0, 1, 2, 0.0, 0.25, 0.5, 1.0, -0.1, 1e-12, np.inf,
    np.nan, "a", "c", "", [], AffineNRSfM(), np.int64(3), np.float32(0.5),
    np.random.RandomState(0), 2**32,
]  # fmt: skip


def accepts(of, kind, value):
    """Return whether a parameter is accepted by a module's decorator."""

    def function(parameter):
        return True

    decorate = of.validate_params(
        {"parameter": CONSTRAINTS[kind](of)}, prefer_skip_nested_validation=True
    )
    try:
        return decorate(function)(parameter=value)
    except ValueError:
        return False


@pytest.mark.parametrize("kind", CONSTRAINTS)
def test_plain_checks_accept_what_those_of_scikit_learn_accept(kind):
    for value in VALUES:
        expected = accepts(scikit_learn, kind, value)
        assert accepts(plain_checks, kind, value) is expected, value


def test_plain_checks_of_an_estimator():
    class Estimator(AffineNRSfM):
        @plain_checks.fit_context(prefer_skip_nested_validation=True)
        def fit(self, X, y=None):
            return "fitted"

    assert Estimator().fit(None) == "fitted"
    message = "'max_iter' parameter of Estimator must be an int"
    with pytest.raises(ValueError, match=message):
        Estimator(max_iter=0).fit(None)


FALLBACKS = """
import sys
import sklearn.base, sklearn.utils, sklearn.utils.validation
import sklearn.datasets, sklearn.decomposition, sklearn.model_selection
del sklearn.base._fit_context, sklearn.utils._safe_indexing
sys.modules["sklearn.utils._missing"] = None
from isa_nrsfm import AffineNRSfM
from isa_nrsfm._compat import plain_checks, scikit_learn
from isa_nrsfm.datasets import make_face_tracks
assert issubclass(scikit_learn.Interval, plain_checks.Interval)
X = make_face_tracks(n_frames=40, n_components=1, random_state=0).data
model = AffineNRSfM(1, random_state=0).fit(X)
assert (scikit_learn.taken_rows(X, [1, 2]) == X[1:3]).all()
try:
    AffineNRSfM(0).fit(X)
except ValueError as error:
    assert "n_components" in str(error) and "Got 0" in str(error)
else:
    raise AssertionError
"""


def test_without_the_private_names():
    done = subprocess.run(
        [sys.executable, "-c", FALLBACKS], capture_output=True, text=True
    )
    assert done.returncode == 0, done.stderr


def test_rows_of_arrays_and_dataframes():
    X = np.arange(12.0).reshape(6, 2)
    assert number_of_rows(X) == number_of_rows(pd.DataFrame(X)) == 6
    np.testing.assert_array_equal(taken_rows(pd.DataFrame(X), [1, 4]), X[[1, 4]])
    assert is_pandas_na(pd.NA)
    assert not is_pandas_na(None)


def half_missing():
    """Return a table that is warned of: a point has only one of its coordinates."""
    X = make_face_tracks(n_frames=40, n_components=1, random_state=0).data
    X[3, 4] = np.nan
    return X


@pytest.mark.parametrize("n_jobs", [None, 2])
@pytest.mark.parametrize("piped", [False, True])
def test_warnings_point_to_the_line_of_the_user(n_jobs, piped):
    model = AffineNRSfM(1, n_jobs=n_jobs, random_state=0)
    if piped:
        model = make_pipeline(FunctionTransformer(), model)
    X = half_missing()
    for method in (model.fit, model.fit_transform, model.transform, model.score):
        with warnings.catch_warnings(record=True) as caught:
            warnings.simplefilter("always")
            method(X)
        about = [each for each in caught if "only one of" in str(each.message)]
        assert about
        assert {Path(each.filename) for each in about} == {Path(__file__)}
