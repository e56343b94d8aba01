"""One BLAS thread inside of fits and methods, and as many as before after them."""

import signal
import warnings
from concurrent.futures import ThreadPoolExecutor
from contextlib import suppress
from functools import partial
from pathlib import Path
from threading import Barrier

import numpy as np
import pytest
from interrupts import interrupted_after
from layers import may_not_converge
from numpy.testing import assert_equal
from refusals import refused
from sklearn.base import BaseEstimator
from threadpoolctl import ThreadpoolController, threadpool_limits

import isa_nrsfm
from isa_nrsfm import AffineNRSfM, FastISA
from isa_nrsfm.datasets import make_nonrigid_tracks

X = make_nonrigid_tracks(40, 12, 1, noise=0.02, random_state=0).data
OF_THREADS = str(Path(isa_nrsfm.__file__).parent / "_compat" / "scikit_learn.py")


def numbers_of_threads():
    pools = ThreadpoolController().select(user_api="blas").lib_controllers
    return {pool.num_threads for pool in pools}


class During(BaseEstimator):
    """A strategy that calls a function, and notes the numbers of threads after it."""

    def __init__(self, call=lambda: None):
        self.call = call

    def __sklearn_clone__(self):
        return self

    def fit(self, signals):
        self.call()
        self.threads = numbers_of_threads()
        self.components_ = np.eye(signals.shape[1])
        return self


def threads_of_fit(call=lambda: None):
    """Return the numbers of threads in a fit, after it has called a function."""
    model = AffineNRSfM(1, isa=During(call), refinement=None, random_state=0)
    return model.fit(X).isa_.threads


@pytest.fixture(autouse=True)
def two_threads():
    with threadpool_limits(2, user_api="blas"):
        if numbers_of_threads() != {2}:
            pytest.skip("needs a BLAS with threads")
        yield
        assert numbers_of_threads() == {2}


def fail(error=KeyError):
    raise error


def test_threads_are_set_back():
    for call in (lambda: None, threads_of_fit):  # a fit in a fit, too
        assert threads_of_fit(call) == {1}
        assert numbers_of_threads() == {2}
    refused(None, threads_of_fit, fail, error=KeyError)


@pytest.mark.parametrize("first_to_leave", [0, 1])
def test_the_last_thread_to_leave_sets_threads_back(first_to_leave):
    inside, left = Barrier(2), Barrier(2)

    def run(number):
        first = number == first_to_leave
        # Both threads are inside, then one of them.
        waits = [inside.wait] if first else [inside.wait, left.wait]
        found = threads_of_fit(lambda: [wait() for wait in waits])
        if first:
            left.wait()
        return found

    with ThreadPoolExecutor(2) as pool:
        assert [*pool.map(run, range(2))][1 - first_to_leave] == {1}


def test_fits_in_four_threads_leave_the_process_as_it_was():
    def state():
        handlers = [signal.getsignal(number) for number in signal.valid_signals()]
        random = np.random.mtrand._rand.get_state(legacy=False)["state"]
        return handlers, list(warnings.filters), random["key"].tolist(), random["pos"]

    def work(number):
        model = AffineNRSfM(1, random_state=0, max_iter=2).fit(X)
        if number == 2:
            interrupt = partial(fail, KeyboardInterrupt)
            refused(None, threads_of_fit, interrupt, error=KeyboardInterrupt)
        return model.transform(X), model.score(X)

    before = state()
    with warnings.catch_warnings(action="ignore"):
        alone = work(0)
        with ThreadPoolExecutor(4) as pool:
            found = list(pool.map(work, range(4)))
    assert_equal(found, [alone] * 4)
    assert state() == before


@pytest.mark.slow
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


@may_not_converge
@pytest.mark.parametrize("method", ["__enter__", "__exit__"])
def test_an_interrupt_at_any_line_of_the_limit_leaves_no_user(method):
    n_lines, ended, isa = 0, [], FastISA(n_init=1, max_iter=1)
    while not ended:
        n_lines += 1
        interrupt = interrupted_after(n_lines, OF_THREADS, [method])
        with suppress(KeyboardInterrupt), interrupt:
            ended.append(isa.fit(X[:, :3]))
        isa.fit(X[:, :3])  # the next user sets threads back
        assert numbers_of_threads() == {2}
    assert n_lines > 6
