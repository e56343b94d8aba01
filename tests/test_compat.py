"""Private names of scikit-learn, and where warnings point to."""

import io
import warnings
from numbers import Integral, Real
from pathlib import Path

import numpy as np
import pandas as pd
import pytest
from numpy.testing import assert_array_equal
from refusals import refused
from sklearn.pipeline import make_pipeline
from sklearn.preprocessing import FunctionTransformer

from isa_nrsfm import AffineNRSfM
from isa_nrsfm._compat.scikit_learn import Interval, number_of_rows, taken_rows
from isa_nrsfm._compat.stored_arrays import array_in
from isa_nrsfm.datasets import make_face_tracks


@pytest.mark.parametrize("value", [True, False])
def test_true_and_false_are_no_numbers(value):
    assert not Interval(Integral, 0, None, closed="left").is_satisfied_by(value)
    assert not Interval(Real, 0, 1, closed="both").is_satisfied_by(value)


def test_rows_of_arrays_and_dataframes():
    X = np.arange(12.0).reshape(6, 2)
    assert number_of_rows(X) == number_of_rows(pd.DataFrame(X)) == 6
    assert_array_equal(taken_rows(pd.DataFrame(X), [1, 4]), X[[1, 4]])


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


class TestStoredArrays:
    def stored(self, array, version=None):
        """Return the bytes of an array in NumPy's format."""
        content = io.BytesIO()
        np.lib.format.write_array(content, array, version, allow_pickle=True)
        return content.getvalue()

    @pytest.mark.parametrize("version", [(1, 0), (2, 0)])
    def test_come_back(self, version):
        array = np.arange(6.0).reshape(2, 3)
        assert_array_equal(array_in(self.stored(array, version)), array)

    def test_of_another_size_are_refused(self):
        content = self.stored(np.arange(6.0))
        for changed, n_bytes in ((content[:-1], 47), (content + b"0", 49)):
            refused(f"48 bytes; got {n_bytes}", array_in, changed)

    def test_of_objects_are_refused_whatever_their_size(self):
        content = self.stored(np.array([None, None]))
        head = content[: content.index(b"\n") + 1]
        for size in (0, 8, 16, 24):
            refused("type object should have 16 bytes", array_in, head + bytes(size))
