"""What users install: its files, its version, and the packages that it needs."""

import re
import subprocess
import sys
import tarfile
import tomllib
from importlib import metadata
from pathlib import Path
from zipfile import ZipFile

import pytest
import yaml
from packaging.requirements import Requirement

from isa_nrsfm import __version__

ROOT = Path(__file__).resolve().parents[1]
PROJECT = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))
CORE = {"numpy", "scipy", "scikit-learn", "joblib"}
# Files of the package that are no Python code.
DATA = "py.typed analysis/texts.toml cli/options.toml cli/report.html"
DATA += " datasets/face_model.csv datasets/face_prior.npz datasets/figures.toml"
DATA += " datasets/sources.toml export/scene.gltf export/viewer.html export/viewer.js"
DATA += " io/formats.toml io/keypoints.toml io/model_file.toml skeletons/layouts.toml"
DATA += " skeletons/words.toml"
DATA = {f"isa_nrsfm/{name}" for name in DATA.split()}
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
for refinement in (None, "joint"):
    model = AffineNRSfM(1, refinement=refinement, max_iter=3, random_state=0).fit(X)
    assert model.transform(X[:3]).shape == (3, 1)
    assert model._repr_html_()
"""


def lowest_versions(requirements):
    """Return the lowest version of each required package."""
    pairs = map(Requirement, requirements)
    return {each.name: str(each.specifier).removeprefix(">=") for each in pairs}


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
def test_wheel_has_the_package_and_its_licence(tmp_path, monkeypatch):
    with ZipFile(built("wheel", tmp_path, monkeypatch)) as wheel:
        sizes = {each.filename: each.file_size for each in wheel.infolist()}
    about = f"isa_nrsfm-{__version__}.dist-info"
    assert {f"{about}/licenses/LICENSE", f"{about}/entry_points.txt"} <= set(sizes)
    package = {name for name in sizes if not name.startswith(about)}
    code = {str(file.relative_to(ROOT)) for file in ROOT.glob("isa_nrsfm/**/*.py")}
    assert package == DATA | code
    assert max(sizes.values()) < 100_000


@pytest.mark.slow
def test_sdist_has_code_tests_and_pages_without_large_data(tmp_path, monkeypatch):
    with tarfile.open(built("sdist", tmp_path, monkeypatch)) as sdist:
        sizes = {each.name.partition("/")[2]: each.size for each in sdist}
    assert DATA <= set(sizes)
    files = "CHANGELOG.md CITATION.cff LICENSE README.md pyproject.toml noxfile.py"
    files += " tests/conftest.py docs/conf.py benchmarks/__main__.py"
    tables = {str(file.relative_to(ROOT)) for file in ROOT.glob("tests/data/*")}
    tables.add("tests/refusals.txt")  # the calls of all refusals
    assert set(files.split()) | tables <= set(sizes)
    tests = {name: size for name, size in sizes.items() if name.startswith("tests/")}
    assert max(size for name, size in tests.items() if name not in tables) < 100_000
    assert max(sizes.values()) < 500_000


def test_version_is_the_same_everywhere():
    assert PROJECT["tool"]["hatch"]["version"]["path"] == "isa_nrsfm/__init__.py"
    citation = yaml.safe_load((ROOT / "CITATION.cff").read_text(encoding="utf-8"))
    assert citation["version"] == __version__
    changes = (ROOT / "CHANGELOG.md").read_text(encoding="utf-8")
    headings = r"^## \[(.+)\] - (?:\d{4}-\d\d-\d\d|unreleased)$"
    versions = re.findall(headings, changes, re.MULTILINE)
    assert versions[0] == __version__
    assert re.findall(r"^\[(\d.+)\]: .*/v\1$", changes, re.MULTILINE) == versions


def test_the_recipe_has_the_bounds_and_the_version_of_the_package():
    file = ROOT / ".github" / "conda-forge" / "recipe.yaml"
    if not file.exists():
        pytest.skip("the sdist has no recipe")
    recipe = yaml.safe_load(file.read_text(encoding="utf-8"))
    assert recipe["context"]["version"] == __version__
    python = ">=" + recipe["context"]["python_min"]
    assert python == PROJECT["project"]["requires-python"]
    run = recipe["requirements"]["run"][1:]
    assert [each.replace(" ", "") for each in run] == PROJECT["project"]["dependencies"]
    extras = PROJECT["project"]["optional-dependencies"]
    bounds = lowest_versions(sum(extras.values(), PROJECT["build-system"]["requires"]))
    optional = recipe["requirements"]["run_constraints"]
    for requirement in [recipe["requirements"]["host"][-1], *optional]:
        name, bound = requirement.replace("-base", "").split(" >=")
        assert bounds[name] == bound, name
