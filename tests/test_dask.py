"""Tables on a cluster of dask: workers that are lost, what comes back, joblib."""

import os
import signal

import numpy as np
import pytest
from frame_parts import assert_same_model
from layers import with_limits
from scenes import with_gaps

from isa_nrsfm.datasets import make_nonrigid_tracks

dask, array = pytest.importorskip("dask"), pytest.importorskip("dask.array")
distributed = pytest.importorskip("distributed")
cloudpickle = pytest.importorskip("cloudpickle")

K = 2
FRAMES = (70, 150, 0, 80)


def table():
    return make_nonrigid_tracks(300, 20, K, noise=0.01, random_state=0).data


@pytest.fixture(scope="module")
def cluster():
    options = {"n_workers": 2, "threads_per_worker": 1, "dashboard_address": ":0"}
    with distributed.LocalCluster(**options) as cluster:
        with distributed.Client(cluster):
            yield cluster


# The first steps are taken on few frames, as of large tables.
SampledNRSfM = with_limits(small_table=1000, sample=40, restarts=False)


@pytest.mark.slow
@pytest.mark.cluster
def test_fit_is_that_in_memory(cluster, monkeypatch):
    """A worker that is killed does not change the result."""
    X, compute, maps = with_gaps(table(), 0.1), dask.compute, []

    def compute_and_kill(*tasks):
        maps.append(len(tasks))
        if len(maps) == 20:
            first = next(iter(cluster.workers.values()))
            os.kill(first.pid, signal.SIGKILL)
        return compute(*tasks)

    monkeypatch.setattr(dask, "compute", compute_and_kill)
    blocks = array.from_array(X, chunks=(FRAMES, 40))
    model = SampledNRSfM(K, random_state=0).fit(blocks)
    assert len(maps) > 20
    assert_same_model(model, SampledNRSfM(K, random_state=0).fit(X))


def test_nothing_as_large_as_the_table_comes_back(monkeypatch):
    """Tasks are pickled, as they are for workers."""
    compute, largest = dask.compute, []

    def measured(*tasks):
        found = compute(*cloudpickle.loads(cloudpickle.dumps(tasks)))
        largest.append(size_of(found))
        return found

    monkeypatch.setattr(dask, "compute", measured)
    X = np.tile(table(), (4, 1))
    blocks = array.from_array(X, chunks=(400, 40))
    SampledNRSfM(K, random_state=0, max_iter=5, tol=1e3).fit(blocks)
    # Cameras, their gradients and curvatures, coefficients: 24 numbers a frame.
    assert max(largest) < 0.7 * X.size


def size_of(found):
    """Return how many numbers arrays in tuples and lists have."""
    if isinstance(found, tuple | list):
        return sum(map(size_of, found))
    return np.size(found)
