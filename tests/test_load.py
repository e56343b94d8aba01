"""The benchmark that fits under load: what it calls harm, and a short run."""

import numpy as np
import pytest

pytest.importorskip("distributed", reason="needs the extra dask")

from benchmarks.load import BACKENDS, Load, described, under_load

MEMORY = [90.0, 100.0, *[130.0] * 16, 103.0, 104.0]
FINE = Load(190.0, 3, 1, [0.0, 1e-12], MEMORY, (8, 8), (5, 4))


@pytest.mark.parametrize(
    ("changes", "harm"),
    [
        ({}, []),
        ({"differences": [0.0, 1e-6, 0.0]}, ["results differ"]),
        ({"differences": [0.0, np.nan]}, ["results differ"]),
        ({"memory": [*MEMORY[:-1], 106.0]}, ["memory grows"]),
        ({"handles": (8, 9)}, ["file handles are left"]),
        ({"threads": (5, 6)}, ["threads are left"]),
    ],
)
def test_harm_is_named(changes, harm):
    load = FINE._replace(**changes)
    assert load.harm == harm
    assert (harm or ["no harm"])[0] in described("loky", load)


@pytest.mark.filterwarnings("ignore")  # of fits
@pytest.mark.slow
@pytest.mark.cluster
@pytest.mark.subprocess
@pytest.mark.parametrize("backend", BACKENDS)
def test_workers_that_are_killed_change_nothing(backend):
    load = under_load(backend, seconds=10.0, n_tables=2, pause=3.0)
    assert load.seconds >= 10.0
    assert len(load.memory) >= 2
    assert load.n_killed > 0
    assert max(load.differences) <= 1e-8
    assert load.threads[1] <= load.threads[0]
    assert load.handles[1] <= load.handles[0]
