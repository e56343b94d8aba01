"""The code in the pages runs, and the pages name what there is."""

import os
import re
import shlex
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
from isa_nrsfm.cli._options import build_parser
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
    assert [*readme] == ["faces", "drink", "pickup", "yoga", "shark", "flag"]
    sets = "ICT-68", "drink", "pickup", "yoga", "Shark", "flag"
    columns = [next(filter(re.compile(name).match, printed)) for name in sets]
    methods = ["rigid mean shape", "BMM", "Kong-Lucey"]
    methods += ["ISA2, paper's refinement", "ISA, weak perspective"]
    expected = printed.loc[methods, columns].map(lambda cell: float(cell.split()[0]))
    found = readme.map(lambda cell: float(cell.strip("*")))
    np.testing.assert_allclose(found, 100 * expected, rtol=1e-12)


def test_the_paper_cites_its_references_and_prints_what_commands_wrote():
    paper = text("docs/paper/paper.md").split("---", 2)[2]
    assert 750 <= len(paper.split()) <= 1750
    keys = re.findall(r"^@\w+\{(\w+),", text("docs/paper/paper.bib"), re.MULTILINE)
    assert sorted(set(re.findall(r"@(\w+\d{4})", paper))) == sorted(keys)
    pictures = re.findall(r"\]\((\S+\.png)\)", paper)
    assert len(pictures) == 2
    assert [p for p in pictures if not (ROOT / "docs/paper" / p).is_file()] == []
    rows = re.findall(r"\| ([\d.]+) \| ([\d.]+) \| `python -m benchmarks (\w+)`", paper)
    assert len(rows) == 6
    for *figures, page in rows:
        written = text(f"docs/benchmarks/{page}.md")
        assert [f for f in figures if f"| {f} " not in written] == [], page


@pytest.mark.usefixtures("tables")
def test_the_readme_runs():
    names = run("README.md")
    assert names["model"].alpha_.shape == (36, names["auto"].n_components_)
    assert repr(names["faces"]) == "Landmarks(36 frames of 68 points, format='table')"


@pytest.mark.usefixtures("tables")
def test_getting_started_runs():
    names = run("docs/getting_started.md")
    assert list(pd.read_csv("alpha.csv"))[2:4] == ["seconds", "alpha_1"]
    seen = names["points"].to_numpy()[0].reshape(-1, 2)
    np.testing.assert_allclose(names["row"], seen, atol=10)
    assert Path("shapes.png").stat().st_size
    assert Path("rows.png").stat().st_size


@pytest.mark.slow
@pytest.mark.usefixtures("tables")
def test_the_page_of_questions_runs():
    names = run("docs/questions.md")
    table = names["found"].to_frame()
    assert list(table) == ["eta_squared", "p_value"]
    assert table["eta_squared"].max() > 0.5
    assert names["relative"].shape == names["at_rest"].shape == (400, 4)
    assert names["scores"].mean() > 0.9
    # Ordered frames have dynamics, shuffled ones do not.
    assert len(names["smooth"].time_scales) == 4
    assert len(names["shuffled"].time_scales) == 0
    expected = names["model"].transform(names["X"][names["order"]])
    np.testing.assert_allclose(names["shuffled"].alpha, expected, atol=1e-10)
    assert np.median(names["poses"].yaw_std) < 1
    lips = names["shapes_mm"][:, 62] - names["shapes_mm"][:, 66]
    for mouth in (90 * names["mouth"][:, 0], np.linalg.norm(lips, axis=1)):
        np.testing.assert_allclose(names["mouth_mm"][:, 0], mouth, rtol=1e-10)
    assert Path("time.png").stat().st_size
    assert Path("gestures.png").stat().st_size


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
    assert len(options) > 8
    assert len(commands) > 4
    assert main([*fit, "faces.csv", "--output", "out"]) == 0
    written = {code for code in codes if code.count(".") == 1 and " " not in code}
    tables = {f"{name}.csv" for name in ("alpha", "cameras", "shapes")}
    assert written == {"viewer.html", "shapes.npz"} | tables
    assert written <= set(os.listdir("out"))
    for code in runs:
        table = "openface.csv" if "confidence" in code else "faces.csv"
        output = ["--output", "again", "--force"]
        assert main([*fit, table, *shlex.split(code), *output]) == 0, code
        if "--group person" in code:
            assert "alpha_1_within" in pd.read_csv("again/alpha.csv")
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
    *("export", "formats", "index", "large_tables", "skeletons"),
    *("conventions", "two_studies", "depth", "perspective"),  # slow
)
# Objects of other programs and of clusters, in test_io_formats.py and test_dask.py.
OF_OTHERS = ("from_movement", "dask")
# Names that the pages have imported elsewhere.
IMPORTED = AffineNRSfM, GridSearchCV, BasisShapeDisplay, write_viewer, canonical_pose


@pytest.fixture(scope="module")
def fitted():
    """Return a table of faces, and models of faces, bodies and mice."""
    faces = make_face_tracks(24, random_state=0)
    models = [AffineNRSfM(3, camera="weak_perspective", random_state=0).fit(faces.data)]
    for n_points in (17, 7):
        options = {"camera": "weak_perspective", "random_state": 0}
        scene = make_nonrigid_tracks(30, n_points, 1, **options)
        models.append(AffineNRSfM(1, **options).fit(scene.data))
    return faces, *models


@pytest.mark.usefixtures("tables")
@pytest.mark.parametrize("page", slow_after(5, REFERENCE))
def test_code_of_reference_pages_runs(page, fitted):
    faces, model, bodies, mice = fitted
    Path("landmarks").mkdir()
    for name in ("landmarks/0.npy", "landmarks/1.npy", "new.npy"):
        np.save(name, faces.data)
    save_model(model, "model.npz")
    columns = [f"{axis}{j}" for j in range(68) for axis in "xy"]
    names = {"sklearn": sklearn} | {each.__name__: each for each in IMPORTED}
    names |= {"X": faces.data, "stream": faces.data[:2], "weights": np.ones((24, 68))}
    names |= {"points": pd.DataFrame(faces.data, columns=columns), "model": model}
    names |= {"new_points": names["points"][:20]}
    names |= {"expressions": ["a", "b"] * 12, "shape": bodies.mean_shape_}
    others = {"coco-17": bodies, "mouse.html": mice}
    with sklearn.config_context():
        for code in blocks(f"docs/{page}.md"):
            if any(word in code for word in OF_OTHERS):
                continue
            for word, other in others.items():
                if word in code:
                    names["model"] = other
            exec(compile(code, page, "exec"), names)
            if page == "skeletons":
                names["model"] = clone(model)
    if page == "depth":
        # As the page says
        assert names["model"].depth_uncertainty_ == pytest.approx(0.006, abs=0.001)
        assert names["depth_std"].shape == (200, 68)


def test_commands_in_the_pages_have_their_options():
    pages = [*(ROOT / "docs").rglob("*.md"), *examples(), ROOT / "README.md"]
    commands = []
    for page in pages:
        lines = re.sub(r"\\\n#?", " ", text(page)).splitlines()
        found = [re.match(r"(?:#? {4})?(isa-nrsfm [^`#]+)", line) for line in lines]
        commands += [match[1] for match in found if match is not None]
    assert len(commands) > 20
    for command in commands:
        # Capitals stand for what users write.
        words = shlex.split(command.replace(" K ", " 3 "))
        assert build_parser().parse_args(words[1:]).command, command


def examples():
    """Return the pages of the gallery."""
    return sorted((ROOT / "docs/examples").rglob("*.py"))


test_refusals = refusals_of("docs", globals())
