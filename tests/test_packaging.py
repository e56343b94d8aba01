"""What users install: its files, its version, and the packages that it needs."""

import re
import subprocess
import sys
import tarfile
import tomllib
from importlib import metadata
from zipfile import ZipFile

import pytest
import yaml
from packaging.requirements import Requirement
from project import ROOT, text

from isa_nrsfm import __version__


def files(pattern):
    """Return the names of files of the project."""
    return {str(file.relative_to(ROOT)) for file in ROOT.glob(pattern)}


PROJECT = tomllib.loads(text("pyproject.toml"))
CORE = {"numpy", "scipy", "scikit-learn", "joblib"}
# Code of the package and other files, of which none is compiled
PACKAGE = {name for name in files("isa_nrsfm/**/*.*") if not name.endswith(".pyc")}
FIT_OF_AN_ARRAY = """
import sys

class Blocked:
    def find_spec(name, path=None, target=None):
        if name.partition(".")[0] in {blocked}:
            raise ModuleNotFoundError(name, name=name)

sys.meta_path.insert(0, Blocked)
import importlib, pkgutil, warnings
import isa_nrsfm
for module in pkgutil.walk_packages(isa_nrsfm.__path__, "isa_nrsfm."):
    if not module.name.endswith("__main__"):
        importlib.import_module(module.name)

import numpy as np
from isa_nrsfm import AffineNRSfM

warnings.simplefilter("ignore")
X = np.random.default_rng(0).normal(size=(20, 16))
model = AffineNRSfM(1, max_iter=3, random_state=0).fit(X)
assert model.transform(X[:3]).shape == (3, 1)
assert model._repr_html_()
"""


def lowest_versions(requirements):
    """Return the lowest version of each required package."""
    needed = map(Requirement, requirements)
    return {each.name: str(each.specifier).removeprefix(">=") for each in needed}


def installed_besides(packages):
    """Return the top modules of all packages that these do not require."""
    found, left = set(), set(packages)
    while left:
        package = left.pop()
        found.add(package)
        required = map(Requirement, metadata.requires(package) or ())
        left |= {each.name for each in required if not each.marker} - found
    tops = metadata.packages_distributions()
    return {top for top, names in tops.items() if not found & {*map(str.lower, names)}}


def built(kind, folder, monkeypatch):
    """Return the path of a new wheel or sdist."""
    from hatchling import build

    monkeypatch.chdir(ROOT)
    return folder / getattr(build, f"build_{kind}")(str(folder))


@pytest.mark.slow
@pytest.mark.subprocess
def test_arrays_are_fitted_with_the_core_dependencies_alone():
    """All modules can be imported with them, too."""
    assert {*lowest_versions(PROJECT["project"]["dependencies"])} == CORE
    blocked = installed_besides(CORE) - {"isa_nrsfm"}
    assert {"pandas", "matplotlib", "yaml", "pytest"} <= blocked
    code = FIT_OF_AN_ARRAY.format(blocked=blocked)
    program = [sys.executable, "-W", "error", "-c", code]
    done = subprocess.run(program, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr


@pytest.mark.slow
def test_wheel_and_sdist_have_all_files_and_no_large_data(tmp_path, monkeypatch):
    with ZipFile(built("wheel", tmp_path, monkeypatch)) as wheel:
        sizes = {each.filename: each.file_size for each in wheel.infolist()}
    about = f"isa_nrsfm-{__version__}.dist-info"
    assert {f"{about}/licenses/LICENSE", f"{about}/entry_points.txt"} <= set(sizes)
    assert {name for name in sizes if not name.startswith(about)} == PACKAGE
    assert max(sizes.values()) < 100_000

    with tarfile.open(built("sdist", tmp_path, monkeypatch)) as sdist:
        sizes = {each.name.partition("/")[2]: each.size for each in sdist}
    others = "CHANGELOG.md CITATION.cff LICENSE README.md pyproject.toml noxfile.py"
    others += " tests/conftest.py docs/conf.py benchmarks/__main__.py"
    # The calls of all refusals are large, too.
    tables = files("tests/data/*") | {"tests/refusals.txt"}
    assert PACKAGE | tables | {*others.split()} <= set(sizes)
    small = {name for name in sizes if name.startswith("tests/")} - tables
    assert max(sizes[name] for name in small) < 100_000
    assert max(sizes.values()) < 500_000


def test_version_is_the_same_everywhere():
    assert PROJECT["tool"]["hatch"]["version"]["path"] == "isa_nrsfm/__init__.py"
    assert yaml.safe_load(text("CITATION.cff"))["version"] == __version__
    changes = text("CHANGELOG.md")
    headings = r"^## \[(.+)\] - (?:\d{4}-\d\d-\d\d|unreleased)$"
    versions = re.findall(headings, changes, re.MULTILINE)
    assert versions[0] == __version__
    assert re.findall(r"^\[(\d.+)\]: .*/v\1$", changes, re.MULTILINE) == versions


def test_the_recipe_has_the_bounds_and_the_version_of_the_package():
    if not (ROOT / ".github").exists():
        pytest.skip("the sdist has no recipe")
    recipe = yaml.safe_load(text(".github/conda-forge/recipe.yaml"))
    context, needed = recipe["context"], recipe["requirements"]
    project = PROJECT["project"]
    assert context["version"] == __version__
    assert ">=" + context["python_min"] == project["requires-python"]
    run = [each.replace(" ", "") for each in needed["run"][1:]]
    assert run == project["dependencies"]
    extras = project["optional-dependencies"].values()
    bounds = lowest_versions(sum(extras, PROJECT["build-system"]["requires"]))
    for requirement in [needed["host"][-1], *needed["run_constraints"]]:
        name, bound = requirement.replace("-base", "").split(" >=")
        assert bounds[name] == bound, name
