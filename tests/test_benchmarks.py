"""The benchmarks: each command starts, and what they measure is measured right."""

import json
import re
import runpy
from contextlib import nullcontext, redirect_stderr, suppress
from io import StringIO

import numpy as np
import pandas as pd
import pytest
from isolated import measured_square
from layers import may_not_converge, slow_after
from project import ROOT
from refusals import refusals_of
from scenes import random_rotation

import benchmarks.__main__ as command
from benchmarks import _fits, _paper, questions, real
from benchmarks._methods import METHODS, Found
from benchmarks._results import cell, read, section_of  # noqa: F401  in refusals.txt
from benchmarks._run import rounded, run_isolated
from benchmarks._sets import SETS, Table
from isa_nrsfm.datasets import make_nonrigid_tracks
from isa_nrsfm.metrics import inverse_snr, mean_shape_error_3d

# Tables of few points: that FastICA does not converge makes no difference here.
pytestmark = may_not_converge

COMMANDS = [
    path.stem
    for path in sorted((ROOT / "benchmarks").glob("[a-z]*.py"))
    if "__main__" in path.read_text(encoding="utf-8")
]


OK = pd.DataFrame({"status": "ok", "message": "", "error": [0.1, 0.3, 0.2]})
LATE = pd.DataFrame({"status": ["over time"], "message": "over 60 s"})
WRONG = pd.DataFrame({"status": ["error"], "message": "ValueError: no"})
ENDS = [(-1, "over time", "over 0.5 s"), ("a", "error", "TypeError: '<' not supported")]


@pytest.mark.slow
@pytest.mark.subprocess
@pytest.mark.parametrize(("x", "status", "message"), ENDS)
def test_runs_in_a_process_of_their_own_end(x, status, message):
    record = run_isolated(measured_square, {"x": x}, time_limit=0.5)
    assert (record["status"], record["values"], record["seconds"]) == (status, {}, None)
    assert record["message"].startswith(message)


@pytest.fixture(scope="module")
def tracks():
    options = {"camera": "orthographic", "noise": 0.01, "random_state": 0}
    return make_nonrigid_tracks(40, 30, 2, **options)


@pytest.mark.parametrize("name", ["drink", "synthetic"])
def test_true_shapes_and_cameras_have_no_error(tracks, name):
    third = np.cross(tracks.motion[:, 0], tracks.motion[:, 1])[:, None]
    rotations = np.concatenate([tracks.motion, third], axis=1)
    # In another orientation of space, mirrored, and of another size.
    mirror = np.diag([1.0, 1.0, -1.0])
    turn, affinity = random_rotation(1) @ mirror, np.triu(np.ones((3, 3)))
    shapes = {"affine": tracks.shapes @ affinity, "euclidean": tracks.shapes @ turn / 2}
    cameras = {"rotations": mirror @ rotations @ turn, "scales": np.full(40, 2.0)}
    found = Found(tracks.data, **shapes, **cameras)
    errors = _fits.errors_3d(SETS[name], tracks.shapes @ rotations.mT, found)
    assert set(errors) == {"sequence_error", "frame_error"}
    np.testing.assert_allclose(list(errors.values()), 0.0, atol=1e-10)


@pytest.mark.parametrize("method", slow_after(4, METHODS))
def test_what_methods_find_explains_the_table(tracks, method):
    kind = METHODS[method]
    model = kind.make(SETS["synthetic"], 2, 0).fit(tracks.data)
    found = kind.found(model, tracks.data)
    # Frames that orthographic cameras see are not scaled.
    scaled = getattr(model, "camera", "affine") != "orthographic"
    error = inverse_snr(tracks.data, found.X, scale_frames=scaled)
    known = getattr(model, "inverse_snr_", error)
    np.testing.assert_allclose(error, known, rtol=1e-6)
    assert error < 0.2
    if found.euclidean is None:
        return
    # Euclidean shapes in their cameras are the same images.
    if method != "rigid":  # whose cameras are affine
        table = found.in_camera()[:, :, :2].reshape(len(found.X), -1)
        assert inverse_snr(found.X, table, scale_frames=True) < 1e-10
    eye = found.rotations @ found.rotations.mT
    np.testing.assert_allclose(eye, np.broadcast_to(np.eye(3), eye.shape), atol=1e-8)


def test_errors_of_shapes_leave_out_their_rotations_and_a_mirror_image(rng):
    truth = rng.normal(size=(5, 20, 3))
    turned = np.stack([S @ random_rotation(i, 3) for i, S in enumerate(truth)])
    mirrored = turned * [1.0, 1.0, -1.0] + 3.0
    assert questions.turned_error(mirrored, truth) == pytest.approx(0.0, abs=1e-12)
    # Not of single frames.
    mirrored[0] *= [1.0, 1.0, -1.0]
    assert questions.turned_error(mirrored, truth) > 0.02
    shapes = [(i + 1) * truth[0] @ random_rotation(i, 3) + i for i in range(4)]
    common = [real.common_shape(shapes)]
    error = mean_shape_error_3d(truth[:1], common, convention="frame")
    assert error == pytest.approx(0.0, abs=1e-12)


@pytest.mark.slow
@pytest.mark.subprocess
def test_command_measures_writes_and_rewrites(tmp_path, capsys):
    chosen = ["truth", "--sets", "synthetic", "--methods", "rigid"]
    output = ["--output", str(tmp_path)]
    command.main([*chosen, "--repeats", "1", "--jobs", "2", *output])
    assert "[1/1] truth synthetic" in capsys.readouterr().out
    path = tmp_path / "truth.md"
    page = path.read_text(encoding="utf-8")
    assert "| rigid mean shape | " in page
    assert "time_limit 600" in page
    stored = json.loads((tmp_path / "results.json").read_text(encoding="utf-8"))
    assert {r["method"] for r in stored["records"]} == {"rigid"}
    path.unlink()
    command.main(["--tables-only", *output])
    assert path.read_text(encoding="utf-8") == page
    assert [*tmp_path.glob("*.md")] == [path]


@pytest.mark.slow
def test_stored_results_give_every_page():
    folder = ROOT / "docs" / "benchmarks"
    stored = read(folder / "results.json")
    for name, section in command.SECTIONS.items():
        assert {*section.sets, *section.other_sets} <= set(SETS)
        page = section.page(section_of(stored, name))
        assert page.strip() in (folder / f"{name}.md").read_text(encoding="utf-8")
        assert page.count("\n| ") > 3


CHOICES = [("starts", "isa1", 2), ("recoveries", "isa2", "irls")]


@pytest.mark.parametrize(("part", "method", "choice"), CHOICES)
def test_choices_of_the_paper_are_measured(part, method, choice, tracks, monkeypatch):
    monkeypatch.setattr(_paper, "load", lambda name: Table(tracks.data))
    run = {"name": "flag", "method": method, "seed": 0, "part": part}
    values = _paper.measure_paper(nullcontext, **run, choice=choice)
    assert 0 < values["floor"] < 100 * values["inverse_snr"] < 20
    assert json.dumps({name: rounded(value) for name, value in values.items()})


@pytest.mark.parametrize("name", COMMANDS)
def test_commands_have_help(name, monkeypatch, capsys):
    monkeypatch.setattr("sys.argv", [name, "--help"])
    with pytest.raises(SystemExit) as end:
        runpy.run_path(str(ROOT / "benchmarks" / f"{name}.py"), run_name="__main__")
    assert end.value.code == 0
    assert "--help" in capsys.readouterr().out


def test_absent_sets_are_skipped_by_name(tmp_path, monkeypatch, capsys):
    monkeypatch.setenv("ISA_NRSFM_DATA", str(nowhere := tmp_path / "nowhere"))
    command.main(["reprojection", "--output", str(tmp_path)])
    printed = capsys.readouterr().out.splitlines()[0]
    start = re.escape(f"{nowhere} (ISA_NRSFM_DATA) has no ")
    assert re.fullmatch(f"reprojection: .*{start}.* Measured: nothing", printed)
    for name in ("shark_torresani", "flag_mocap_30x250", "faces_wild_68_combined"):
        assert f"{name}.npz" in printed
    assert not list(tmp_path.glob("*.md"))


def chosen(words):
    """Raise the message of wrong usage."""
    with redirect_stderr(StringIO()) as err, suppress(SystemExit):
        command.main(words.split())
    raise ValueError(err.getvalue())


test_refusals = refusals_of("benchmarks", globals())
