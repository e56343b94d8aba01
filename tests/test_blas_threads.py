"""One BLAS thread inside of decorated functions, and as many as before after them."""

import signal
import sys
import warnings
from concurrent.futures import ThreadPoolExecutor
from contextlib import suppress
from functools import partial
from threading import Barrier

import numpy as np
import pytest
from interrupts import interrupted_after
from layers import slow_after
from numpy.testing import assert_equal
from refusals import refused
from threadpoolctl import ThreadpoolController, threadpool_limits

from isa_nrsfm import AffineNRSfM
from isa_nrsfm._compat.scikit_learn import one_blas_thread
from isa_nrsfm.datasets import make_nonrigid_tracks


@one_blas_thread()
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


def fail(error=KeyError):
    raise error


@pytest.mark.usefixtures("two_threads")
def test_threads_are_set_back():
    for during in (lambda: None, threads_of_blas):
        assert threads_of_blas(during) == {1}
        assert numbers_of_threads() == {2}
    refused(None, threads_of_blas, fail, error=KeyError)
    assert numbers_of_threads() == {2}


@pytest.mark.usefixtures("two_threads")
@pytest.mark.parametrize("first_to_leave", [0, 1])
def test_the_last_thread_to_leave_sets_threads_back(first_to_leave):
    inside, left = Barrier(2), Barrier(2)
    numbers = []

    @one_blas_thread()
    def leave(first):
        inside.wait()  # both threads are inside
        if first:
            return
        left.wait()
        numbers.append(numbers_of_threads())

    def run(number):
        leave(number == first_to_leave)
        if number == first_to_leave:
            left.wait()

    with ThreadPoolExecutor(2) as pool:
        list(pool.map(run, range(2)))
    assert numbers == [{1}]
    assert numbers_of_threads() == {2}


@pytest.mark.usefixtures("two_threads")
@pytest.mark.parametrize("error", slow_after(1, [KeyboardInterrupt, KeyError]))
def test_fits_in_four_threads_leave_the_process_as_it_was(error):
    X = make_nonrigid_tracks(60, 12, 1, noise=0.02, random_state=0).data

    def state():
        handlers = [signal.getsignal(number) for number in signal.valid_signals()]
        random = np.random.mtrand._rand.get_state(legacy=False)["state"]
        return handlers, list(warnings.filters), random["key"].tolist(), random["pos"]

    def work(number):
        model = AffineNRSfM(1, random_state=0, max_iter=2).fit(X)
        if number == 2:
            refused(None, threads_of_blas, partial(fail, error), error=error)
        return model.transform(X), model.score(X)

    before = state()
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        alone = work(0)
        with ThreadPoolExecutor(4) as pool:
            found = list(pool.map(work, range(4)))
    for results in found:
        assert_equal(results, alone)
    assert numbers_of_threads() == {2}
    assert state() == before


@pytest.mark.slow
@pytest.mark.usefixtures("two_threads")
def test_results_are_the_same_to_the_bit():
    X = make_nonrigid_tracks(300, 120, 3, noise=0.02, random_state=0).data
    X[::3, :20] = np.nan
    fits = []
    for number in (1, 2):
        with threadpool_limits(number, user_api="blas"):
            model = AffineNRSfM(3, random_state=0).fit(X)
            of_table = model.transform(X), model.score(X)
            fits.append((model.basis_, model.alpha_, *of_table))
    assert_equal(*fits)


@pytest.mark.usefixtures("two_threads")
@pytest.mark.parametrize("method", ["__enter__", "__exit__"])
def test_an_interrupt_at_any_line_of_the_limit_leaves_no_user(method):
    file = sys.modules[one_blas_thread.__module__].__file__
    n_lines, ended = 0, []
    while not ended:
        n_lines += 1
        with suppress(KeyboardInterrupt), interrupted_after(n_lines, file, [method]):
            ended.append(threads_of_blas())
        assert threads_of_blas() == {1}
        assert numbers_of_threads() == {2}
    assert n_lines > 6
