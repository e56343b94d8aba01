"""Public names that are imported when they are used, and what nobody waits for.

What is held here is which modules are loaded. How long a start takes is measured by
``python -m benchmarks.speed start``.
"""

import ast
import importlib
import os
import pkgutil
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from refusals import refused

import isa_nrsfm
from isa_nrsfm import AffineNRSfM
from isa_nrsfm.cli import main
from isa_nrsfm.datasets import make_nonrigid_tracks
from isa_nrsfm.io import FORMATS, save_model
from isa_nrsfm.isa import FastISA, PooledFastICA

FOLDERS = [each.name for each in pkgutil.iter_modules(isa_nrsfm.__path__) if each.ispkg]
PACKAGES = ["isa_nrsfm"]
PACKAGES += [f"isa_nrsfm.{name}" for name in FOLDERS if name[0].isalpha()]
# Those that wait until a name is used; the other folders import what they hold.
WAITING = ["isa_nrsfm", "isa_nrsfm.cli", "isa_nrsfm.export", "isa_nrsfm.io"]
HELP = ["--version", "--help", "fit --help", "export --help"]
# All that is slow to import: NumPy is the least of it.
SLOW = {"numpy", "scipy", "sklearn", "pandas", "joblib", "matplotlib"}


def for_type_checkers(package):
    """Return the module from which type checkers take each public name."""
    tree = ast.parse(Path(package.__file__).read_text(encoding="utf-8"))
    return {
        alias.name: node.module
        for block in tree.body
        for node in ast.walk(block)
        if isinstance(node, ast.ImportFrom) and str(node.module).startswith("isa_nrsfm")
        for alias in node.names
        if alias.name != "lazy_names"
    }


def loaded_by(code, **environment):
    """Return the modules that a program has loaded at its end."""
    program = [sys.executable, "-c", f"{code}\nimport sys\nprint(*sys.modules)"]
    environment = {**os.environ, **environment}
    done = subprocess.run(program, capture_output=True, text=True, env=environment)
    assert done.returncode == 0, done.stderr
    return set(done.stdout.splitlines()[-1].split())


def command(*arguments):
    """Return a program that runs the command line as ``python -m isa_nrsfm`` does."""
    return (
        f"import runpy, sys\nsys.argv = {['isa_nrsfm', *map(str, arguments)]}\n"
        "try:\n    runpy.run_module('isa_nrsfm', run_name='__main__')\n"
        "except SystemExit as end:\n    assert not end.code, end.code\n"
    )


@pytest.mark.parametrize("name", PACKAGES)
def test_names_are_those_that_type_checkers_see(name):
    package = importlib.import_module(name)
    seen = for_type_checkers(package)
    assert len({*package.__all__}) == len(package.__all__)
    assert package.__doc__
    # Folders are imported for type checkers, and not listed.
    listed = {public for public, module in seen.items() if module != "isa_nrsfm"}
    assert listed == {*package.__all__} - {"__version__"}
    assert not [public for public in listed if public.startswith("_")]
    assert {*seen, *package.__all__} <= set(dir(package))
    if "__getattr__" in vars(package):
        assert {each for each in dir(package) if each[:2] != "__"} == {*seen}
    for public, module in seen.items():
        expected = getattr(importlib.import_module(module), public)
        assert getattr(package, public) is expected


@pytest.mark.parametrize("name", PACKAGES)
def test_a_name_that_is_misspelt_is_an_error_at_once(name):
    package = importlib.import_module(name)
    with pytest.raises(AttributeError, match=rf"{name}.*'AffineNRSFM'") as error:
        package.AffineNRSFM  # noqa: B018
    assert error.value.name == "AffineNRSFM"
    refused("AffineNRSFM", exec, f"from {name} import AffineNRSFM", error=ImportError)


@pytest.mark.subprocess
def test_imports_and_help_wait_for_nothing():
    imports = [f"import {name}; dir({name})" for name in WAITING]
    programs = [*imports, *(command(*words.split()) for words in HELP)]
    assert not loaded_by("\n".join(programs), EAGER_IMPORT="") & SLOW


@pytest.mark.subprocess
def test_the_estimator_brings_only_what_every_fit_needs():
    code = (
        "import sys, sklearn.decomposition\nbefore = {*sys.modules}\n"
        "from isa_nrsfm import AffineNRSfM\n"
        "modules = {*sys.modules} - before\nimport isa_nrsfm.plotting\n"
        "assert 'matplotlib' not in sys.modules\nprint(*modules)\nsys.exit()"
    )
    modules = loaded_by(code, EAGER_IMPORT="", PYTHONWARNINGS="error")
    packages = {module.partition(".")[0] for module in modules}
    packages -= {*sys.stdlib_module_names, "isa_nrsfm"}
    assert packages <= {"numpy", "scipy", "sklearn", "joblib", "threadpoolctl"}
    parts = "baselines", "cli", "datasets", "io", "metrics", "plotting"
    assert not modules & {f"isa_nrsfm.{part}" for part in parts}


@pytest.mark.subprocess
def test_what_is_not_installed_is_an_error_of_the_import():
    code = "import sys, pytest\nsys.modules['numpy'] = None\n"
    folders = "import isa_nrsfm\nassert isa_nrsfm.io and isa_nrsfm.export\n"
    fails = "with pytest.raises(ModuleNotFoundError, match='numpy'):\n    "
    loaded_by(f"{code}{folders}{fails}isa_nrsfm.AffineNRSfM", EAGER_IMPORT="")
    # At once where that is asked for
    loaded_by(f"{code}{fails}import isa_nrsfm", EAGER_IMPORT="1")


@pytest.mark.subprocess
def test_transform_loads_no_more_than_it_uses(tmp_path):
    X = make_nonrigid_tracks(30, 12, 1, random_state=0).data
    files = tmp_path / "model.npz", tmp_path / "one.npy"
    save_model(AffineNRSfM(1, refinement=None, random_state=0).fit(X), files[0])
    np.save(files[1], X[:1].reshape(1, 12, 2))
    run = command("transform", *files, "-o", tmp_path / "alpha.csv")
    loaded = loaded_by(run, EAGER_IMPORT="")
    assert (tmp_path / "alpha.csv").exists()
    assert "isa_nrsfm._estimator" in loaded
    not_used = "matplotlib scipy.io sklearn.decomposition sklearn.model_selection "
    not_used += "isa_nrsfm.cli._fit isa_nrsfm.export._viewer isa_nrsfm.plotting._views"
    assert not loaded & {*not_used.split()}


def test_the_help_has_the_formats_and_defaults_that_there_are(capsys):
    refused(None, main, ["fit", "--help"], error=SystemExit)
    text = " ".join(capsys.readouterr().out.split())
    assert f"{', '.join(FORMATS).removesuffix(', table')}, or table" in text
    pooled, fast = PooledFastICA().n_init, FastISA().n_init
    assert f"(default: {pooled} of pooled, {fast} of fast)" in text
