"""The command export, and what a fit writes for other programs."""

import numpy as np
import pandas as pd
import pytest
from export_models import faces
from exported_files import Read, content_of
from fit_runs import MODEL, told
from made_once import made_once
from numpy.testing import assert_array_equal, assert_equal
from refusals import refusals_of

from isa_nrsfm import AffineNRSfM
from isa_nrsfm.export import (
    ShapeArrays,
    point_distribution_model,
    read_pdm,
    write_glb,
    write_viewer,
)
from isa_nrsfm.io import save_model

QUICK = [*"--n-components 1 --isa fast --n-init 2 --no-figures".split()]
NAMES = [f"{axis}{j:02d}" for j in range(68) for axis in "xy"]


@made_once
def named_model():
    table = pd.DataFrame(faces().data[:50], columns=NAMES)
    return AffineNRSfM(2, random_state=0).fit(table)


@pytest.fixture
def export(tmp_path, succeeds):
    """Return a function that exports a model with names: output file and report."""
    save_model(named_model(), tmp_path / MODEL)

    def run(name, *options):
        output = tmp_path / name
        out, err = succeeds("export", tmp_path / MODEL, *options, "--output", output)
        assert err == ""
        return output, " ".join(out.split())

    return run


def test_the_suffix_tells_what_is_written(export, tmp_path):
    model = named_model()
    for write, name in ((write_glb, "face.glb"), (write_viewer, "face.HTML")):
        output, report = export(name)
        write(model, tmp_path / f"expected_{name}")
        assert output.read_bytes() == (tmp_path / f"expected_{name}").read_bytes()
        assert f"{output.stat().st_size} bytes" in report

    output, report = export("pdm.txt")
    assert_equal(read_pdm(output), point_distribution_model(model))
    assert "2 modes of 68 points" in report

    with np.load(export("shapes.npz")[0]) as arrays:
        assert set(arrays) == set(ShapeArrays._fields)
        assert_array_equal(arrays["basis"], model.basis_)


def test_options_reach_what_is_written(export):
    pose = ["--camera", "none", "--origin", "lower", "--mirrored"]
    options = {"camera": None, "origin": "lower", "n_modes": 1}
    expected = point_distribution_model(named_model().mirrored(), **options)
    assert_equal(read_pdm(export("pdm.txt", "--n-modes", 1, *pose)[0]), expected)
    assert len(read_pdm(export("b.txt", "--n-modes", "0.1")[0]).modes) == 1

    output, _ = export("a.glb", "--names", "jaw open, smile", "--edges", "none")
    mesh = Read(output).mesh
    assert mesh["extras"]["targetNames"] == ["jaw open", "smile"]
    assert [each["mode"] for each in mesh["primitives"]] == [0]  # points


def test_edges_are_pairs_of_names_or_numbers_of_points(export, tmp_path):
    for name, text in (("a.glb", "\ufeff00,01\n 01, 02\n\n"), ("b.glb", "0,1\n1,02\n")):
        (tmp_path / "edges.csv").write_text(text, encoding="utf-8")
        read = Read(export(name, "--edges", tmp_path / "edges.csv")[0])
        points, lines = read.mesh["primitives"]
        assert (points["mode"], lines["mode"]) == (0, 1)
        assert read.array(lines["indices"]).tolist() == [0, 1, 1, 2]


def test_the_viewer_of_a_flat_object_has_affine_shapes(fits, tmp_path, rng):
    # Cameras that turn about the viewing direction see two directions of space.
    angle = rng.uniform(0, 2 * np.pi, 40)
    turns = np.array([[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]])
    tracks = rng.standard_normal((20, 2)) @ turns.transpose(2, 1, 0)
    names = [f"{axis}{j}" for j in range(20) for axis in "xy"]
    table = pd.DataFrame(tracks.reshape(40, 40), columns=names)
    table.to_csv(tmp_path / "flat.csv", index=False)
    error = fits(tmp_path / "flat.csv", "--camera", "affine", *QUICK).err
    told = "viewer.html has affine shapes, and cameras.csv has no angles: a metric"
    assert f"warning: {told}" in error
    content = content_of(tmp_path / "viewer.html")
    assert content["about"].startswith("Affine shapes")
    assert content["rotations"] == ""


def exported(folder, name, *options):
    """Raise the message of an export, and write nothing."""
    save_model(named_model(), folder / MODEL)
    try:
        told("export", folder / MODEL, "-o", folder / name, *options)
    finally:
        assert not (folder / name).exists()


test_refusals = refusals_of("export_cli", globals())
