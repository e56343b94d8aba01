"""Each benchmark of the asv suite runs at its smallest parameters."""

import inspect
import json
from functools import cache
from pathlib import Path

import numpy as np
import pytest
from refusals import refused

from benchmarks.asv_suite import _measured, fits, stages

pytestmark = [
    pytest.mark.slow,
    pytest.mark.filterwarnings("ignore::sklearn.exceptions.ConvergenceWarning"),
]

PREFIXES = ("time_", "peakmem_", "track_")


def classes_of(module):
    """Return the classes of a module that asv finds."""
    return [
        kind
        for name, kind in vars(module).items()
        if inspect.isclass(kind)
        and issubclass(kind, _measured.Measured)
        and not (name.startswith("_") or inspect.isabstract(kind))
    ]


def run_each(kind, *parameters):
    """Set up a class, run each of its benchmarks, and return what they track."""
    benchmark = kind()
    benchmark.setup(*parameters)
    benchmark.run = cache(benchmark.run)  # what they all run takes the time
    results = {
        name: getattr(benchmark, name)(*parameters)
        for name in dir(kind)
        if name.startswith(PREFIXES)
    }
    tracked = {name: v for name, v in results.items() if name.startswith("track_")}
    assert all(getattr(kind, name).unit for name in tracked)
    return {name.removeprefix("track_"): value for name, value in tracked.items()}


@pytest.fixture(autouse=True)
def small_tables(monkeypatch):
    small = {"n_frames": 40, "n_points": 20, "n_components": 2}
    monkeypatch.setattr(fits._Swept, "base", small)


@pytest.fixture(scope="module")
def given():
    return {"small": stages.prepared("small"), "absent": None}


@pytest.mark.parametrize("kind", classes_of(stages))
def test_stages(kind, given):
    assert kind.params[0] == "small"
    tracked = run_each(kind, given, "small")
    assert tracked.pop("svds") > 0
    assert all(np.isfinite(value) for value in tracked.values())
    errors = {name: v for name, v in tracked.items() if name != "basis_similarity"}
    assert all(0 < error < 10 for error in errors.values())
    refused(None, kind().setup, given, "absent", error=NotImplementedError)


@pytest.mark.parametrize("kind", classes_of(fits))
def test_fits(kind):
    tracked = run_each(kind, kind.params[0])
    assert tracked["svds"] > 0
    assert 0 < tracked["inverse_snr"] < 1
    assert 0 < tracked["affine_shape_error"] < 0.1


def test_the_configuration_finds_the_suite():
    path = Path(stages.__file__).parents[1] / "asv.conf.json"
    settings = json.loads(path.read_text(encoding="utf-8"))
    assert (path.parent / settings["benchmark_dir"] / "asv_suite").is_dir()
    assert (path.parent / settings["repo"] / "pyproject.toml").is_file()
