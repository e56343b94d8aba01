"""Fixtures shared by all tests."""

import os

os.environ.setdefault("SCIPY_ARRAY_API", "1")  # before scipy is imported
# Before numpy is imported: the tables of the tests are too small for more threads.
os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")

import gc
import signal
from collections import Counter
from pathlib import Path

import matplotlib
import numpy as np
import pandas as pd
import pytest
from estimator_contract import widen
from hypothesis import settings
from layers import LIMITS, QUICK_LIMITS
from sklearn.utils import estimator_checks

from isa_nrsfm import AffineNRSfM

matplotlib.use("Agg")
gc.disable()  # while tests are collected, which stay
AffineNRSfM._limits = LIMITS._replace(**QUICK_LIMITS)

# The same examples each time
settings.register_profile("same", deadline=None, derandomize=True, database=None)
settings.load_profile("same")

NO_DATA = "tables that are no part of this project (docs/benchmarks/README.md, Sets)"


SHIPPED = Path(__file__).parent / "data"


def _data_folder():
    named = os.environ.get("ISA_NRSFM_DATA")
    checkout = Path(__file__).resolve().parents[1]
    return Path(named) if named else checkout.parent / "shared" / "data"


def pytest_collection_finish():
    """Look for garbage from now on, but seldom, and not among the collected tests."""
    gc.freeze()
    gc.set_threshold(20_000, 20, 20)
    gc.enable()


def pytest_terminal_summary(terminalreporter):
    """Say once for each reason how many tests it skipped."""
    skipped = terminalreporter.stats.get("skipped", ())
    texts = (report.longrepr[2] for report in skipped)
    reasons = Counter(text.removeprefix("Skipped: ") for text in texts)
    for reason, number in reasons.items():
        terminalreporter.write_line(f"{number} skipped: {reason}")


@pytest.fixture
def rng():
    """Return a new generator of random numbers, the same for each test."""
    return np.random.default_rng(0)


@pytest.fixture(scope="session")
def data_path():
    """Return a function from a file name to its path; skip where it is absent."""

    def path(name):
        shipped = SHIPPED / name
        file = shipped if shipped.is_file() else _data_folder() / name
        if not file.is_file():
            pytest.skip(f"{NO_DATA}: set ISA_NRSFM_DATA to the folder that has them")
        return file

    return path


@pytest.fixture(scope="session")
def load_data(data_path):
    """Return a function from the name of a data set to its arrays."""

    def load(name):
        with np.load(data_path(f"{name}.npz"), allow_pickle=False) as file:
            arrays = dict(file)
        floats = (n for n, values in arrays.items() if values.dtype.kind == "f")
        return arrays | {name: arrays[name].astype(float) for name in floats}

    return load


@pytest.fixture(scope="module", autouse=True)
def as_users(request):
    """Let joint fits have those limits of users that a module names in AS_USERS."""
    names = getattr(request.module, "AS_USERS", ())
    limits = {name: getattr(LIMITS, name) for name in names}
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(AffineNRSfM, "_limits", AffineNRSfM._limits._replace(**limits))
        yield


@pytest.fixture(autouse=True)
def all_starts(request, as_users, monkeypatch):
    """Let joint fits of slow tests have all starts, as those of users."""
    if request.node.get_closest_marker("slow"):
        monkeypatch.setattr(AffineNRSfM, "_limits", LIMITS)


@pytest.fixture
def interruptible():
    """Let programs that a test starts be interrupted, also where pytest itself is not.

    Shells start what runs in the background without interrupts, and programs inherit
    that.
    """
    before = signal.signal(signal.SIGINT, signal.default_int_handler)
    yield
    signal.signal(signal.SIGINT, before)


@pytest.fixture
def run():
    """Return a function that runs a command: exit code, output and errors."""
    from fit_runs import ran

    return ran


@pytest.fixture
def succeeds(run):
    """Return a function that runs a command that succeeds: its output and errors."""

    def outputs(*argv):
        code, out, err = run(*argv)
        assert code == 0, err
        return out, err

    return outputs


@pytest.fixture
def fits(succeeds, tmp_path):
    """Return a function that fits a table into a folder: its `Results`."""

    def results(table, *options, folder=tmp_path):
        from fit_runs import Results

        return Results(folder, *succeeds("fit", table, "-o", folder, *options))

    return results


@pytest.fixture
def begins():
    """Return a function that reads a table up to its fit: what is told until then."""
    from fit_runs import begun

    return begun


@pytest.fixture
def transforms(succeeds, tmp_path):
    """Return a function that transforms a table: its coefficients, output, errors."""

    def results(model, table, *options):
        path = tmp_path / "transformed.csv"
        out, err = succeeds("transform", model, table, "-o", path, "--force", *options)
        return pd.read_csv(path), out, err

    return results


@pytest.fixture
def fails(run):
    """Return a function that runs a command that fails and returns its message."""

    def message(*argv):
        code, out, err = run(*argv)
        assert (code, out) == (1, "")
        last = err.splitlines()[-1]
        assert last.startswith("isa-nrsfm: error: ")
        assert "Traceback" not in err
        return last

    return message


@pytest.fixture
def landmark_tables(monkeypatch):
    """Widen the tables of scikit-learn's checks to tables of landmarks."""
    # They hand their tables to no function of ours on the way.
    monkeypatch.setattr(estimator_checks, "_enforce_estimator_tags_X", widen)
