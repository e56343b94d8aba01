"""One BLAS thread inside of decorated functions, and as many as before after them."""

import numpy as np
import pytest
from numpy.testing import assert_array_equal
from threadpoolctl import ThreadpoolController, threadpool_limits

from isa_nrsfm import AffineNRSfM
from isa_nrsfm._compat.scikit_learn import one_blas_thread
from isa_nrsfm.datasets import make_nonrigid_tracks


@one_blas_thread
def threads_of_blas(during=lambda: None):
    """Return the numbers of threads after some function has been called."""
    during()
    return numbers_of_threads()


def numbers_of_threads():
    pools = ThreadpoolController().select(user_api="blas").lib_controllers
    return {pool.num_threads for pool in pools}


@pytest.fixture
def two_threads():
    with threadpool_limits(2, user_api="blas"):
        if numbers_of_threads() != {2}:
            pytest.skip("needs a BLAS with threads")
        yield


def fail():
    raise KeyError


@pytest.mark.usefixtures("two_threads")
def test_threads_are_set_back():
    assert threads_of_blas() == {1}
    assert numbers_of_threads() == {2}
    assert threads_of_blas(threads_of_blas) == {1}
    assert numbers_of_threads() == {2}
    with pytest.raises(KeyError):
        threads_of_blas(fail)
    assert numbers_of_threads() == {2}


@pytest.mark.usefixtures("two_threads")
def test_results_are_the_same_to_the_bit():
    X = make_nonrigid_tracks(300, 120, 3, noise=0.02, random_state=0).data
    X[::3, :20] = np.nan
    fits = []
    for number in (1, 2):
        with threadpool_limits(number, user_api="blas"):
            model = AffineNRSfM(3, random_state=0).fit(X)
            fits.append(
                (model.basis_, model.alpha_, model.transform(X), model.score(X))
            )
    for one, two in zip(*fits, strict=True):
        assert_array_equal(one, two)
