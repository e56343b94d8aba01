"""Fixtures shared by all tests."""

import os

os.environ.setdefault("SCIPY_ARRAY_API", "1")  # before scipy is imported
# Before numpy is imported: the tables of the tests are too small for more threads.
os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")

from pathlib import Path

import matplotlib
import numpy as np
import pytest

matplotlib.use("Agg")


def _data_folder():
    named = os.environ.get("ISA_NRSFM_DATA")
    checkout = Path(__file__).resolve().parents[1]
    return Path(named) if named else checkout.parent / "shared" / "data"


@pytest.fixture(scope="session")
def data_path():
    """Return a function from a file name to its path; skip where it is absent."""

    def path(name):
        file = _data_folder() / name
        if not file.is_file():
            pytest.skip(f"{name} not found: set ISA_NRSFM_DATA to the folder with it")
        return file

    return path


@pytest.fixture(scope="session")
def load_data(data_path):
    """Return a function from the name of a data set to its arrays."""
    return lambda name: np.load(data_path(f"{name}.npz"), allow_pickle=False)


@pytest.fixture
def run(capsys):
    """Return a function that runs a command: exit code, output and errors."""

    def run_command(*argv):
        from isa_nrsfm.cli import main

        code = main([str(word) for word in argv])
        captured = capsys.readouterr()
        return code, captured.out, captured.err

    return run_command
