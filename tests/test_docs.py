"""The code in the pages runs, and the pages name what there is."""

import os
import re
import shlex
from functools import cache
from pathlib import Path
from pkgutil import iter_modules

import numpy as np
import pandas as pd
import pytest
import sklearn
from fit_runs import JOINT
from landmark_files import write_openface
from layers import slow_after
from project import ROOT, text
from refusals import refusals_of
from scipy.io import savemat
from sklearn.base import clone
from sklearn.model_selection import GridSearchCV

import isa_nrsfm
from isa_nrsfm import AffineNRSfM
from isa_nrsfm.calibration import canonical_pose
from isa_nrsfm.cli import main
from isa_nrsfm.datasets import make_face_tracks, make_nonrigid_tracks
from isa_nrsfm.export import write_viewer
from isa_nrsfm.io import save_model
from isa_nrsfm.plotting import BasisShapeDisplay
from isa_nrsfm.skeletons import SKELETONS  # noqa: F401  in refusals.txt

pytestmark = pytest.mark.lint

BLOCK = re.compile(r"^```python\n(.*?)^```$", re.DOTALL | re.MULTILINE)


def listed(page, pattern):
    """Return what a page lists in its lines."""
    return re.findall(pattern, text(page), re.MULTILINE)


def blocks(page):
    """Return the Python code of a page, block by block."""
    return BLOCK.findall(text(page))


@pytest.fixture
def tables(tmp_path, monkeypatch):
    """Write faces of three people in two conditions, and go where they are."""
    monkeypatch.chdir(tmp_path)
    faces = make_face_tracks(36, n_components=4, random_state=0)
    people = {"person": np.repeat(["Ada", "Ben", "Cyd"], 12)}
    people |= {"condition": ["before", "after"] * 18}
    people |= {"seconds": np.tile(np.arange(12) / 25, 3)}
    points = pd.DataFrame(faces.data, columns=faces.feature_names)
    frame = pd.DataFrame(people).join(points)
    frame.to_csv("faces.csv", index=False)
    frame[:5].to_csv("new_faces.csv", index=False)
    confidence = np.linspace(0.7, 1, 36)
    write_openface(Path("openface.csv"), faces.tracks, confidence=confidence)


@pytest.fixture
def sequence(tables):
    """Write the tracks of one camera in the orders of MATLAB code; return them."""
    options = {"camera": "orthographic", "noise": 0.001, "missing": 0.0}
    scene = make_nonrigid_tracks(60, 20, 2, **options, random_state=0)
    W = scene.tracks.mT.reshape(120, 20)
    arrays = {"W": W, "P": np.concatenate([W[::2], W[1::2]]), "MD": np.zeros((60, 20))}
    arrays |= {"W3": scene.tracks.transpose(2, 1, 0)}
    savemat("tracks.mat", arrays | {"S": scene.shapes.mT.reshape(180, 20)})
    return scene


LINKS = listed("README.md", r"\]\((?!https?:)([^)#]+)\)")
PAGES = [*(ROOT / "docs").rglob("*.md"), *ROOT.glob("*.md")]
PICTURES = sorted((ROOT / "docs" / "figures").glob("*.png"))
MODULES = {m.name for m in iter_modules(isa_nrsfm.__path__) if m.name != "cli"}


def run(page):
    """Run the code of a page, and return its names."""
    names = {}
    for code in blocks(page):
        exec(compile(code, page, "exec"), names)
    return names


def table_in(page, start, end):
    """Return the table between two texts of a page, by its first column."""
    found = text(page).partition(start)[2].partition(end)[0]
    lines = re.findall(r"^\| [^-].*", found, re.MULTILINE)
    header, *rows = [line.strip("| ").split(" | ") for line in lines]
    return pd.DataFrame(rows, columns=header).set_index("method")


def test_figures_of_the_readme_are_those_of_the_benchmarks():
    readme = table_in("README.md", "## How accurate", "\n## ")
    printed = table_in("docs/benchmarks/truth.md", "convention='frame'", "\n`")
    sets = {"faces": "ICT-68", "shark": "Shark"}
    columns = [sets.get(name, name) for name in readme]
    methods = ["rigid mean shape", "BMM", "Kong-Lucey"]
    methods += ["ISA2, paper's refinement", "ISA, weak perspective"]
    printed.columns = [re.split(r"[ ,]", name)[0] for name in printed]
    expected = printed.loc[methods, columns].map(lambda cell: float(cell.split()[0]))
    found = readme.map(lambda cell: float(cell.strip("*")))
    np.testing.assert_allclose(found, 100 * expected, rtol=1e-12)


PAPER = text("docs/paper/paper.md").split("---", 2)[2]
CITED, KEYS = r"@(\w+\d{4})", r"^@\w+\{(\w+),"
DRAWN = re.findall(r"\]\((\S+\.png)\)", PAPER)
# Two numbers, and the page of benchmarks that has them.
PRINTED = r"\| ([\d.]+) \| ([\d.]+) \| `python -m benchmarks (\w+)`"
PRINTED = re.findall(PRINTED, PAPER)


def lacks(numbers, page):
    """Return the numbers that a page of the benchmarks does not have."""
    return [n for n in numbers if f"| {n} " not in text(f"docs/benchmarks/{page}.md")]


@pytest.mark.usefixtures("tables")
def test_the_readme_runs():
    names = run("README.md")
    assert names["model"].alpha_.shape == (36, names["auto"].n_components_)
    assert repr(names["faces"]) == "Landmarks(36 frames of 68 points, format='table')"


@pytest.mark.slow
@pytest.mark.usefixtures("tables")
@pytest.mark.parametrize("page", ["getting_started", "questions"])
def test_pages_on_whole_studies_run(page):
    assert len(run(f"docs/{page}.md")["model"].basis_) > 0


def codes_of_calls(column):
    """Return the codes in a column of the tables of calls, in their order."""
    lines = text("docs/which_call.md").splitlines()
    rows = [line.split(" | ") for line in lines if line.startswith("| ")]
    return [code for row in rows for code in re.findall(r"`([^`]+)`", row[column])]


@pytest.mark.slow
@pytest.mark.filterwarnings("ignore:no perspective")
@pytest.mark.usefixtures("tables")
def test_python_calls_for_questions_run():
    names = run("docs/which_call.md")
    names["weights"] = names["read_landmarks"]("openface.csv").confidence
    codes = codes_of_calls(1)
    assert len(codes) > 20
    results = {code: eval(code, names) for code in codes}
    assert results["model.reconstruct(points)"].shape == (36, 68, 3)
    assert results["model.transform(new_points)"].shape == (5, 4)
    assert {"pdm.txt", "faces.glb", "faces.mat"} <= set(os.listdir())


@pytest.mark.slow
@pytest.mark.usefixtures("tables")
def test_commands_for_questions_run():
    fit = ["fit", "--n-components", "1", *JOINT]
    codes = dict.fromkeys(codes_of_calls(2))
    options = [code for code in codes if code.startswith("--")]
    alone = ("--camera", "--fps", "--loss", "--min-confidence", "--weights")
    apart = [code for code in options if code.startswith(alone)]
    runs = [" ".join(code for code in options if code not in apart), *apart]
    commands = [code for code in codes if code.startswith("isa-nrsfm ")]
    assert (len(options) > 8, len(commands) > 4) == (True, True)
    assert main([*fit, "faces.csv", "--output", "out"]) == 0
    written = {code for code in codes if code.count(".") == 1 and " " not in code}
    assert {"viewer.html", "shapes.npz", "alpha.csv"} <= written <= {*os.listdir("out")}
    for code in runs:
        table = "openface.csv" if "confidence" in code else "faces.csv"
        output = ["--output", "again", "--force"]
        assert main([*fit, table, *shlex.split(code), *output]) == 0, code
    for code in commands:
        _, command, *words = shlex.split(code)
        assert main([command, *words, *JOINT * (command == "fit")]) == 0, code


def test_tables_and_variables_of_matlab_are_the_same(sequence):
    names = run("docs/migration.md")
    for table in ("X", "X_em", "X_toolbox"):
        np.testing.assert_array_equal(names[table], sequence.data)
    np.testing.assert_array_equal(names["W_again"], names["W"])
    np.testing.assert_array_equal(names["truth"], sequence.shapes)
    model, F, P = names["model"], names["F"], names["P"]
    seen = names["W"] - names["reprojected"]
    assert np.sum(seen**2) < 1e-5 * np.sum(names["W"] ** 2)
    shapes = names["S_bar"] + np.tensordot(names["Z"], names["V"].reshape(2, 3, P), 1)
    np.testing.assert_allclose(shapes.reshape(3 * F, P), names["S"], atol=1e-6)
    np.testing.assert_array_equal(names["R"][2:4], model.motion_[1])


# Of these pages each runs in a test of its own.
WITH_TESTS = ("README", "getting_started", "questions", "which_call", "migration")
REFERENCE = (
    *("export", "formats"),  # others are slow
    *("index", "large_tables", "skeletons", "conventions", "two_studies"),
    *("depth", "perspective"),
)
# Objects of other programs and of clusters, in test_io_formats.py and test_dask.py.
OF_OTHERS = ("from_movement", "dask")
# Names that the pages have imported elsewhere.
IMPORTED = AffineNRSfM, GridSearchCV, BasisShapeDisplay, write_viewer, canonical_pose


CALIBRATED = {"camera": "weak_perspective", "random_state": 0}


@cache
def fitted(n_points):
    """Return a table of faces, bodies or mice, and its model."""
    scene, n_components = make_face_tracks(24, random_state=0), 3
    if n_points != 68:
        scene, n_components = make_nonrigid_tracks(30, n_points, 1, **CALIBRATED), 1
    return scene.data, AffineNRSfM(n_components, **CALIBRATED).fit(scene.data)


@pytest.mark.usefixtures("tables")
@pytest.mark.parametrize("page", slow_after(2, REFERENCE))
def test_code_of_reference_pages_runs(page):
    X, model = fitted(68)
    Path("landmarks").mkdir()
    for name in ("landmarks/0.npy", "landmarks/1.npy", "new.npy"):
        np.save(name, X)
    save_model(model, "model.npz")
    columns = [f"{axis}{j}" for j in range(68) for axis in "xy"]
    names = {"sklearn": sklearn} | {each.__name__: each for each in IMPORTED}
    names |= {"X": X, "stream": X[:2], "weights": np.ones((24, 68)), "model": model}
    names |= {"points": pd.DataFrame(X, columns=columns)}
    names |= {"new_points": names["points"][:20], "expressions": ["a", "b"] * 12}
    if page == "skeletons":
        names["shape"] = fitted(17)[1].mean_shape_
    with sklearn.config_context():
        for code in blocks(f"docs/{page}.md"):
            if any(word in code for word in OF_OTHERS):
                continue
            for word, n_points in {"coco-17": 17, "mouse.html": 7}.items():
                if word in code:
                    names["model"] = fitted(n_points)[1]
            exec(compile(code, page, "exec"), names)
            if page == "skeletons":
                names["model"] = clone(model)
    if page == "depth":
        # As the page says
        assert names["model"].depth_uncertainty_ == pytest.approx(0.006, abs=0.001)
        assert names["depth_std"].shape == (200, 68)


def test_commands_in_the_pages_have_their_options(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)  # where no table is
    pages = [*(ROOT / "docs").rglob("*.md"), *examples(), ROOT / "README.md"]
    commands = []
    for page in pages:
        lines = re.sub(r"\\\n#?", " ", text(page)).splitlines()
        found = [re.match(r"(?:#? {4})?isa-nrsfm ([^`#]+)", line) for line in lines]
        commands += [match[1] for match in found if match is not None]
    assert len(commands) > 20
    for command in commands:
        # Capitals stand for what users write.
        words = shlex.split(command.replace(" K ", " 3 "))
        # Wrong usage ends with SystemExit.
        assert words[0] == "demo" or main(words) == 1, command


def examples():
    """Return the pages of the gallery."""
    return sorted((ROOT / "docs/examples").rglob("*.py"))


test_refusals = refusals_of("docs", globals())
