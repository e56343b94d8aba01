"""The command export, and what a fit writes for other programs."""

import re

import numpy as np
import pandas as pd
import pytest
from export_models import face_model, faces
from exported_files import Read, content_of
from fit_runs import MODEL
from numpy.testing import assert_array_equal, assert_equal

from isa_nrsfm import AffineNRSfM
from isa_nrsfm.cli import main
from isa_nrsfm.export import (
    ShapeArrays,
    point_distribution_model,
    read_pdm,
    write_glb,
    write_viewer,
)
from isa_nrsfm.io import save_model

QUICK = [*"--n-components 1 --isa fast --n-init 2 --no-figures --output".split()]
NAMED = f"named_{MODEL}"
NAMES = [f"{axis}{j:02d}" for j in range(68) for axis in "xy"]


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    """Return a folder with a model, and one with names of points."""
    folder = tmp_path_factory.mktemp("export")
    save_model(face_model(), folder / MODEL)
    named = AffineNRSfM(2, random_state=0)
    named.fit(pd.DataFrame(faces().data[:50], columns=NAMES))
    save_model(named, folder / NAMED)
    return folder


@pytest.fixture
def export(folder, tmp_path, capsys):
    """Return a function that exports a model: output file, report and errors."""

    def run(name, *options, model=NAMED):
        output = tmp_path / name
        options = map(str, options)
        argv = ["export", str(folder / model), *options, "--output", str(output)]
        code = main(argv)
        captured = capsys.readouterr()
        assert code == (1 if captured.err else 0)
        assert output.exists() == (code == 0)
        return output, captured.out, captured.err

    return run


def test_the_suffix_tells_what_is_written(export, tmp_path):
    output, report, _ = export("face.glb", model=MODEL)
    write_glb(face_model(), tmp_path / "expected.glb")
    assert output.read_bytes() == (tmp_path / "expected.glb").read_bytes()
    assert f"{output.stat().st_size} bytes" in " ".join(report.split())

    output, _, _ = export("face.HTML", model=MODEL)
    write_viewer(face_model(), tmp_path / "expected.html")
    assert output.read_text() == (tmp_path / "expected.html").read_text()

    output, report, _ = export("pdm.txt", model=MODEL)
    assert_equal(read_pdm(output), point_distribution_model(face_model()))
    assert "3 modes of 68 points" in " ".join(report.split())

    output, _, _ = export("shapes.npz", model=MODEL)
    with np.load(output) as arrays:
        assert set(arrays) == set(ShapeArrays._fields)
        assert_array_equal(arrays["basis"], face_model().basis_)


def test_options_reach_what_is_written(export):
    pose = ["--camera", "none", "--origin", "lower", "--mirrored"]
    output, _, _ = export("pdm.txt", "--n-modes", "1", *pose, model=MODEL)
    options = {"camera": None, "origin": "lower"}
    mirrored = face_model().mirrored()
    expected = point_distribution_model(mirrored, n_modes=1, **options)
    assert_equal(read_pdm(output), expected)
    assert len(read_pdm(export("b.txt", "--n-modes", "0.1")[0]).modes) == 1

    output, _, _ = export("a.glb", "--names", "jaw open, smile", "--edges", "none")
    assert Read(output).mesh["extras"]["targetNames"] == ["jaw open", "smile"]
    assert len(Read(output).mesh["primitives"]) == 1


def test_edges_are_pairs_of_names_or_numbers_of_points(export, tmp_path):
    path = tmp_path / "edges.csv"
    path.write_text("00,01\n 01, 02\n\n", encoding="utf-8-sig")
    read = Read(export("a.glb", "--edges", path)[0])
    assert read.array(read.primitive(1)["indices"]).tolist() == [0, 1, 1, 2]
    path.write_text("0,1\n1,02\n")
    read = Read(export("c.glb", "--edges", path)[0])
    assert read.array(read.primitive(1)["indices"]).tolist() == [0, 1, 1, 2]


@pytest.mark.parametrize(
    ("text", "message"),
    [
        *(
            (text, r"edges\.csv, line \d: expected the names of two points")
            for text in ("00,99", "00", "00,01\n00,01,02")
        ),
        ("\n", "has no edges; use --edges none to draw only points"),
        ("00,01\n", "cannot be read as a list of edges: its text is not in UTF-8"),
    ],
)
def test_other_edges_are_refused(export, tmp_path, text, message):
    path = tmp_path / "edges.csv"
    path.write_text(text, encoding="utf-16" if "UTF" in message else "utf-8")
    assert re.search(message, export("a.glb", "--edges", path)[2])


@pytest.mark.parametrize(
    ("name", "options", "message"),
    [
        ("a.foo", [], "expected a file with one of the suffixes .html, .htm, .glb"),
        ("a.mat", ["--n-modes", "2"], "--n-modes is an option of pdm; "),
        ("a.txt", ["--edges", "none"], "--edges is an option of viewer and glb; "),
        ("a.glb", ["--names", "jaw"], "names must hold 2 names"),
        ("a.txt", ["--n-modes", "999"], "n_modes must be at most"),
    ],
)
def test_what_does_not_fit_is_refused(export, name, options, message):
    _, _, error = export(name, *options)
    assert message in error


@pytest.mark.parametrize("n_modes", ["0", "-1", "1.5", "many", "inf"])
def test_numbers_of_modes_are_checked(export, n_modes, capsys):
    with pytest.raises(SystemExit) as stop:
        export("a.txt", "--n-modes", n_modes)
    assert stop.value.code == 2
    assert "expected a whole number or a share" in capsys.readouterr().err


def test_inputs_are_not_overwritten(folder, capsys):
    model = folder / "model.txt"
    model.write_bytes((folder / MODEL).read_bytes())
    assert main(["export", str(model), "--output", str(model)]) == 1
    assert "would be overwritten by the results" in capsys.readouterr().err


def test_the_viewer_of_a_flat_object_has_affine_shapes(tmp_path, capsys, rng):
    # Cameras that turn about the viewing direction see two directions of space.
    angle = rng.uniform(0, 2 * np.pi, 40)
    turns = np.array([[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]])
    tracks = rng.standard_normal((20, 2)) @ turns.transpose(2, 1, 0)
    names = [f"{axis}{j}" for j in range(20) for axis in "xy"]
    table = pd.DataFrame(tracks.reshape(40, 40), columns=names)
    table.to_csv(tmp_path / "flat.csv", index=False)
    results = tmp_path / "results"
    options = ["--camera", "affine", *QUICK, str(results)]
    assert main(["fit", str(tmp_path / "flat.csv"), *options]) == 0
    error = capsys.readouterr().err
    told = "viewer.html has affine shapes, and cameras.csv has no angles: a metric"
    assert f"warning: {told}" in error
    content = content_of(results / "viewer.html")
    assert content["about"].startswith("Affine shapes")
    assert content["rotations"] == ""
