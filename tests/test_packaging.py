"""What users get: types, and an import that brings nothing they did not ask for."""

import subprocess
import sys
from importlib import resources

import pytest

FOUND_AT_IMPORT = """
import sys, sklearn.decomposition
before = set(sys.modules)
from isa_nrsfm import AffineNRSfM
print(*(set(sys.modules) - before))
"""
OWN_PARTS = ("baselines", "calibration", "cli", "datasets", "io", "metrics", "plotting")


@pytest.mark.subprocess
def test_estimator_brings_only_what_every_fit_needs():
    command = [sys.executable, "-W", "error", "-c", FOUND_AT_IMPORT]
    done = subprocess.run(command, capture_output=True, text=True, check=True)
    modules = set(done.stdout.split())
    packages = {module.partition(".")[0] for module in modules}
    packages -= {*sys.stdlib_module_names, "isa_nrsfm"}
    assert packages <= {"numpy", "scipy", "sklearn", "joblib", "threadpoolctl"}
    assert "isa_nrsfm" in modules
    assert not modules & {f"isa_nrsfm.{part}" for part in OWN_PARTS}


def test_package_says_that_it_has_types():
    assert resources.files("isa_nrsfm").joinpath("py.typed").is_file()
