"""The command line on files of other programs."""

import json

import landmark_files as files
import numpy as np
import pandas as pd
import pytest
from fit_runs import MODEL
from layers import slow_after

from isa_nrsfm.datasets import make_face_tracks, make_nonrigid_tracks

N_FRAMES = 40
LOST, EMPTY = 3, 7
QUICK = "-k 1 --isa fast --n-init 2 --refinement none --no-figures".split()
NODES = [f"node {j}" for j in range(20)]


@pytest.fixture(scope="module")
def tracks():
    """Return tracks by their number of points."""
    table = make_face_tracks(N_FRAMES, n_components=1, random_state=0).data
    found = {68: table}
    for n_points in (20, 478):
        found[n_points] = make_nonrigid_tracks(
            N_FRAMES, n_points, 1, random_state=0
        ).data
    scaled = {}
    for n_points, values in found.items():
        low, high = values.min(), values.max()
        scaled[n_points] = ((values - low) / (high - low) * 400 + 20).reshape(
            N_FRAMES, -1, 2
        )
    return scaled


@pytest.fixture
def lost(tracks):
    """Return 20 points of which frame 7 shows none."""
    with_gap = tracks[20].copy()
    with_gap[EMPTY] = np.nan
    return with_gap


def write_openface(folder, tracks, lost):
    success = np.ones(N_FRAMES, dtype=int)
    success[LOST] = 0
    confidence = np.full(N_FRAMES, 0.9)
    confidence[EMPTY] = 0.2
    path = folder / "faces.csv"
    files.write_openface(path, tracks[68], success=success, confidence=confidence)
    return path, ["--min-confidence", "0.5"], {"AU01_r", "success"}


def write_mediapipe(folder, tracks, lost):
    path = files.write_mesh(folder / "mesh.csv", tracks[478])
    return path, ["--image-size", "640x480"], {"code"}


def write_pts(folder, tracks, lost):
    return files.write_pts(folder / "300W", tracks[68]), [], {"file"}


def write_deeplabcut(folder, tracks, lost):
    frame = files.deeplabcut_frame(lost, bodyparts=NODES)
    return files.write_deeplabcut(folder / "mouse.csv", frame), [], {"frame"}


def write_sleap(folder, tracks, lost):
    pair = np.stack([lost, lost], axis=1)
    pair[20:, 1] = np.nan
    path = files.write_sleap(folder / "fly.analysis.h5", pair, nodes=NODES)
    return path, ["--skip-rows", "individual=^b$"], {"individual", "instance_score"}


@pytest.mark.parametrize(
    "write",
    slow_after(
        3, [write_openface, write_pts, write_sleap, write_mediapipe, write_deeplabcut]
    ),
    ids=lambda write: write.__name__.removeprefix("write_"),
)
def test_files_are_fitted_and_transformed(write, run, tracks, lost, tmp_path):
    path, options, kept = write(tmp_path, tracks, lost)
    folder = tmp_path / "results"
    code, out, err = run("fit", path, "-o", folder, *options, *QUICK)
    assert (code, err) == (0, "")
    table = json.loads((folder / "report.json").read_text())["table"]
    name = write.__name__.removeprefix("write_")
    assert table["format"] == name
    assert f"{path} (" in out
    n_points = len(np.load(folder / "shapes.npz")["mean_shape"])
    assert table["n_points"] == n_points
    alpha = pd.read_csv(folder / "alpha.csv")
    assert kept <= set(alpha)
    assert "x_0" not in alpha
    empty = {"mediapipe": [], "pts": [], "openface": [LOST, EMPTY]}
    missing = np.flatnonzero(alpha["alpha_1"].isna())
    assert list(alpha["frame" if "frame" in alpha else "row"][missing]) == [
        i + (name == "openface") for i in empty.get(name, [EMPTY])
    ]
    if name == "openface":
        assert " 1  left out: tracking failed" in out
        assert " 1  left out: all points missing or uncertain" in out
    elif len(missing):
        assert " 1  left out: tracking failed" in out

    output = tmp_path / "again.csv"
    code, _, err = run("transform", folder / MODEL, path, "-o", output, *options)
    assert (code, err) == (0, "")
    again = pd.read_csv(output)
    assert list(again) == list(alpha)
    np.testing.assert_allclose(again["alpha_1"], alpha["alpha_1"], atol=1e-3)


def test_columns_make_any_file_a_table(run, tracks, tmp_path):
    path, _, _ = write_openface(tmp_path, tracks, None)
    options = ["--columns", "x_#,y_#", "-o", tmp_path / "results", *QUICK]
    code, out, _ = run("fit", path, *options)
    assert code == 0
    assert "fitted to 40 frames" in out


@pytest.mark.parametrize(
    ("write", "options", "message"),
    [
        (
            write_openface,
            "--columns x_#,y_# --format openface",
            "--columns needs --format table; got --format openface",
        ),
        (write_openface, "--image-size 640x480", "--image-size needs --format mediapi"),
        (
            write_openface,
            "--min-confidence 1 --format table",
            "has format table, which has no confidences",
        ),
        (
            write_pts,
            "--min-confidence 0.5",
            "min_confidence is given, but these landmarks (pts)",
        ),
    ],
)
def test_options_without_effect_are_refused(
    run, tracks, tmp_path, write, options, message
):
    path, _, _ = write(tmp_path, tracks, None)
    folder = ["-o", tmp_path / "results", *QUICK]
    code, _, err = run("fit", path, *options.split(), *folder)
    assert code == 1
    assert message in err


def test_a_model_of_other_points_is_refused(run, tracks, lost, tmp_path):
    # Both name their points x_0, y_0, ..., and are not the same points.
    path, options, _ = write_pts(tmp_path, tracks, lost)
    folder = tmp_path / "results"
    assert run("fit", path, "-o", folder, *options, *QUICK)[0] == 0
    mesh, options, _ = write_mediapipe(tmp_path, tracks, lost)
    code, _, err = run(
        "transform", folder / MODEL, mesh, "-o", tmp_path / "a.csv", *options
    )
    assert code == 1
    assert "820 columns are only in the table (x_68, y_68," in err
    openface, _, _ = write_openface(tmp_path, tracks, lost)
    code, out, _ = run("transform", folder / MODEL, openface, "-o", tmp_path / "a.csv")
    assert code == 0
    assert "1  without coefficients: tracking failed" in out
