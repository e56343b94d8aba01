"""
Fit tables in two processes for minutes while workers are killed, and look for harm.

Run ``python -m benchmarks.load [--minutes N] [--tables N]``. One process fits dask
arrays on a cluster of two workers, the other runs restarts and the choice of K with
``n_jobs=2`` on joblib's loky. In each a worker is killed every minute. Every result is
compared with that of the same table in memory, with one job and nothing killed. The
last lines say whether memory, file handles and threads of the two processes stay as
they are.

With loky a worker that dies ends the call with ``TerminatedWorkerError``, as joblib has
it. The call is made again, which has to give the same result.
"""

import argparse
import gc
import multiprocessing
import os
import signal
import sys
import threading
import time
import warnings
from concurrent.futures import ProcessPoolExecutor
from contextlib import contextmanager, suppress
from functools import partial
from typing import NamedTuple

import dask.array
import distributed
import numpy as np
import psutil
from distributed.deploy.subprocess import SubprocessCluster
from joblib.externals.loky import get_reusable_executor
from joblib.externals.loky.process_executor import TerminatedWorkerError

from isa_nrsfm import AffineNRSfM, AffineNRSfMCV, FastISA
from isa_nrsfm.datasets import make_nonrigid_tracks

# Largest difference from the undisturbed result, over the largest number of it.
EQUAL = 1e-8
# Largest resident memory of the last tenth of the tables, over that of the first. With
# 200 tables in ten minutes that is a minute each. In the first ones, libraries import
# and keep what they need.
FLAT = 1.05
ATTRIBUTES = ("mean_shape_", "basis_", "alpha_", "motion_")
MEGABYTE = 1e6
MINUTE = 60.0


class Load(NamedTuple):
    """
    What became of a process under load.

    Attributes
    ----------
    seconds : float
        How long it took.
    n_killed : int
        Workers that were killed.
    n_ended : int
        Calls that a dead worker ended, and that were made again.
    differences : list of float
        For each table the difference from the undisturbed result.
    memory : list of float
        Resident megabytes after each table.
    handles, threads : tuple of int
        How many there are before the load, and after it.
    """

    seconds: float
    n_killed: int
    n_ended: int
    differences: list
    memory: list
    handles: tuple
    threads: tuple

    @property
    def resident(self):
        """Largest resident megabytes of each tenth of the tables."""
        tenths = np.array_split(self.memory, min(10, len(self.memory)))
        return [tenth.max() for tenth in tenths]

    @property
    def growth(self):
        """Largest resident memory of the last tenth over that of the first."""
        return self.resident[-1] / self.resident[0]

    @property
    def harm(self):
        """What is not as it should be, a list of texts."""
        harm = {
            "results differ": not np.max(self.differences) <= EQUAL,
            "memory grows": self.growth > FLAT,
            "file handles are left": self.handles[1] > self.handles[0],
            "threads are left": self.threads[1] > self.threads[0],
        }
        return [text for text, found in harm.items() if found]


def drawn_table(rng):
    """Return a table of a random size, of which every other one misses points."""
    n_frames, n_points = int(rng.integers(40, 200)), int(rng.integers(10, 30))
    seed = int(rng.integers(2**31))
    tracks = make_nonrigid_tracks(n_frames, n_points, 1, noise=0.02, random_state=seed)
    X = tracks.data
    if rng.random() < 0.5:
        hidden = rng.random((n_frames, n_points)) < 0.03
        X[np.repeat(hidden, 2, axis=1)] = np.nan
    return X


def results(model, X):
    """Return what a fitted model says of a table, as a dict of arrays."""
    found = {name: np.asarray(getattr(model, name)) for name in ATTRIBUTES}
    return found | {"transform": np.asarray(model.transform(X))}


def difference(found, expected):
    """Return the largest difference of two results, over the largest number of each."""
    return max(
        float(np.abs(found[name] - value).max() / np.abs(value).max())
        for name, value in expected.items()
    )


def fit_with_dask(X, disturbed):
    """Return the results of a table, as a dask array or in memory."""
    if disturbed:
        X = dask.array.from_array(X, chunks=(len(X) // 2 + 1, X.shape[1]))
    return results(AffineNRSfM(1, random_state=0).fit(X), X)


def fit_with_loky(X, disturbed):
    """Return the results of a table, with two jobs or one."""
    n_jobs = 2 if disturbed else 1
    if np.isnan(X).any():
        one = AffineNRSfM(random_state=0)
        search = AffineNRSfMCV([1, 2], estimator=one, cv=2, n_jobs=n_jobs)
        return results(search.fit(X).best_estimator_, X)
    isa = FastISA(n_init=40, n_jobs=n_jobs)  # more than one batch of restarts
    return results(AffineNRSfM(1, isa=isa, random_state=0).fit(X), X)


@contextmanager
def dask_workers():
    """Start two workers of dask; yield a function that lists their process numbers."""
    # The scheduler keeps books of all it has done: it has a process of its own.
    options = {"n_workers": 2, "threads_per_worker": 1, "dashboard_address": None}
    with SubprocessCluster(**options) as cluster, distributed.Client(cluster) as client:

        def running():
            # One that has not yet begun to work is not started anew when it dies.
            n_ready = len(client.scheduler_info()["workers"])
            return descendants("spawn_main") if n_ready == options["n_workers"] else []

        client.wait_for_workers(options["n_workers"])
        yield running


@contextmanager
def loky_workers():
    """Stop the workers of loky at the end; yield a function that lists them."""
    try:
        yield partial(descendants, "popen_loky")
    finally:
        get_reusable_executor().shutdown(wait=True)


def descendants(text):
    """Return the numbers of the processes below this one with a text in their call."""
    found = []
    for child in psutil.Process().children(recursive=True):
        with suppress(psutil.NoSuchProcess):
            if text in str(child.cmdline()):
                found.append(child.pid)
    return found


BACKENDS = {
    "dask": (dask_workers, fit_with_dask),
    "loky": (loky_workers, fit_with_loky),
}


@contextmanager
def killing(workers, pause, done):
    """
    Kill a worker after each pause; yield the list of those that were killed.

    No more than one is killed for each thing that is done: what is begun again may
    take longer than the pause.
    """
    killed, stop = [], threading.Event()

    def kill():
        n_done = -1
        while not stop.wait(pause):
            if len(done) == n_done:
                continue
            for pid in workers()[:1]:
                with suppress(ProcessLookupError):
                    os.kill(pid, signal.SIGKILL)
                    killed.append(pid)
                    n_done = len(done)

    thread = threading.Thread(target=kill)
    thread.start()
    try:
        yield killed
    finally:
        stop.set()
        thread.join()


def resources():
    """Return how many file handles and threads this process has."""
    gc.collect()
    process = psutil.Process()
    return process.num_fds(), process.num_threads()


def settled(before, patience=10.0):
    """Return `resources` once none is more than before, or after some seconds."""
    end = time.monotonic() + patience
    while True:
        now = resources()
        if all(np.less_equal(now, before)) or time.monotonic() > end:
            return now
        time.sleep(0.2)


def under_load(backend, seconds, n_tables=1, pause=MINUTE):
    """
    Fit tables until the time is over and there are as many as asked for.

    Parameters
    ----------
    backend : {"dask", "loky"}
        Whose workers are killed.
    seconds : float
        The least time.
    n_tables : int, default=1
        The least number of tables.
    pause : float, default=60
        Seconds between two workers that are killed.

    Returns
    -------
    Load
        What became of it.
    """
    started, fitted = BACKENDS[backend]
    rng = np.random.default_rng(0)

    def undisturbed():
        with started():
            fitted(drawn_table(rng), True)

    undisturbed()  # what is imported stays
    before, n_ended = resources(), 0
    differences, memory, passed = [], [], 0.0
    with started() as workers, killing(workers, pause, memory) as killed:
        start = time.monotonic()
        while passed < seconds or len(memory) < n_tables:
            X, found = drawn_table(rng), None
            while found is None:
                try:
                    found = fitted(X, True)
                except TerminatedWorkerError:
                    n_ended += 1
            differences.append(difference(found, fitted(X, False)))
            gc.collect()
            passed = time.monotonic() - start
            memory.append(psutil.Process().memory_info().rss / MEGABYTE)
    # joblib keeps a pipe of an executor that is broken until it has made the next one.
    undisturbed()
    handles, threads = zip(before, settled(before), strict=True)
    return Load(passed, len(killed), n_ended, differences, memory, handles, threads)


def described(backend, load):
    """Return what became of a process, as some lines of text."""
    resident = " ".join(f"{megabytes:.0f}" for megabytes in load.resident)
    return (
        f"{backend}: {len(load.memory)} tables in {load.seconds / MINUTE:.1f} minutes, "
        f"{load.n_killed} workers killed, {load.n_ended} calls made again\n"
        f"  largest difference {np.max(load.differences):.1e}\n"
        f"  resident MB, at most, in each tenth of the tables: {resident}\n"
        f"  the last over the first {load.growth:.3f}\n"
        f"  file handles before and after {load.handles}, threads {load.threads}\n"
        f"  {', '.join(load.harm) or 'no harm'}"
    )


def main():
    """Run both processes, print what became of them, and return an exit code."""
    parser = argparse.ArgumentParser(description=__doc__.strip().splitlines()[0])
    parser.add_argument(
        "--minutes", type=float, default=10.0, help="at least (default %(default)s)"
    )
    parser.add_argument(
        "--tables", type=int, default=200, help="each, at least (default %(default)s)"
    )
    args = parser.parse_args()
    least = (MINUTE * args.minutes, args.tables)
    spawn = multiprocessing.get_context("spawn")
    options = {"initializer": warnings.simplefilter, "initargs": ("ignore",)}
    with ProcessPoolExecutor(len(BACKENDS), spawn, **options) as executor:
        runs = {name: executor.submit(under_load, name, *least) for name in BACKENDS}
        loads = {name: run.result() for name, run in runs.items()}
    for name, load in loads.items():
        print(described(name, load))
    return int(any(load.harm for load in loads.values()))


if __name__ == "__main__":
    sys.exit(main())
