"""The command line, run in this process and as an installed program."""

import json
import os
import pty
import re
import runpy
import shutil
import signal
import subprocess
import sys
import time
import warnings
from argparse import Namespace
from pathlib import Path

import numpy as np
import pandas as pd
import pytest
from layers import slow_after
from sklearn.model_selection import cross_val_score

from isa_nrsfm import AffineNRSfM, __version__
from isa_nrsfm._compat.whole_files import files_together
from isa_nrsfm.cli import _commands, main
from isa_nrsfm.cli._demo import run_demo
from isa_nrsfm.cli._parser import build_parser
from isa_nrsfm.datasets import make_face_tracks
from isa_nrsfm.io import load_model, save_model
from isa_nrsfm.metrics import inverse_snr
from isa_nrsfm.plotting import ModeCovarianceDisplay

N_FRAMES, N_COMPONENTS = 60, 2
QUICK = ["--n-components", str(N_COMPONENTS), "--isa", "fast", "--n-init", "2"]
PROGRAM = str(Path(sys.executable).with_name("isa-nrsfm"))
FIT_FILES = {
    "alpha.csv",
    "cameras.csv",
    "shapes.npz",
    "viewer.html",
    "model.npz",
    "report.html",
    "report.json",
}
FIGURES = {"basis_shapes.png", "mode_covariance.png", "reprojection.png"}
PNG = b"\x89PNG\r\n\x1a\n"


@pytest.fixture(scope="module")
def faces():
    """Return a table of faces with a name for each row."""
    bunch = make_face_tracks(N_FRAMES, n_components=N_COMPONENTS, random_state=0)
    frame = pd.DataFrame(bunch.data, columns=bunch.feature_names)
    frame.insert(
        0, "name", [f"{'ir' if i % 10 == 9 else 'i'}{i:03d}" for i in range(60)]
    )
    frame["code"] = [f"{i:04d}" for i in range(N_FRAMES)]
    return frame


@pytest.fixture(scope="module")
def table(faces, tmp_path_factory):
    """Return the path of the table as a csv file."""
    path = tmp_path_factory.mktemp("table") / "faces.csv"
    faces.to_csv(path, index=False)
    return path


@pytest.fixture(scope="module")
def fitted(table, tmp_path_factory):
    """Return the folder of a fit without figures."""
    folder = tmp_path_factory.mktemp("fit") / "results"
    options = ["--output", str(folder), "--no-figures", *QUICK]
    assert main(["fit", str(table), *options]) == 0
    return folder


@pytest.fixture
def fails(run):
    """Return a function that runs a command that fails and returns its message."""

    def message(*argv):
        code, out, err = run(*argv)
        assert code == 1
        assert out == ""
        last = err.splitlines()[-1]
        assert last.startswith("isa-nrsfm: error: ")
        assert "Traceback" not in err
        return last

    return message


def test_fit_writes_what_it_says(run, table, faces, tmp_path):
    folder = tmp_path / "new" / "results"
    since = time.perf_counter()
    code, out, err = run("fit", table, "--output", folder, *QUICK)
    assert (code, err) == (0, "")
    assert {path.name for path in folder.iterdir()} == FIT_FILES | FIGURES
    for name in FIGURES:
        assert (folder / name).read_bytes().startswith(PNG)
        assert name in out
    assert out.startswith("2 basis shapes fitted to 60 frames of 68 points\n")
    assert str(table) in out
    assert all(len(line) <= 120 for line in out.splitlines())

    report = json.loads((folder / "report.json").read_text())
    assert report["table"]["n_rows"] == report["table"]["n_frames"] == N_FRAMES
    assert report["table"]["rows_left_out"] == []
    assert report["table"]["columns"] == "x_#,y_#"
    assert report["model"]["parameters"]["isa__n_init"] == 2
    assert report["versions"]["isa_nrsfm"] == __version__
    assert report["warnings"] == []
    assert set(report["files"]) == (FIT_FILES | FIGURES) - {"report.json"}
    seconds = report["seconds"]
    assert set(seconds) == {"read", "fit", "write", "figures"}
    whole = f"{sum(seconds.values()):.1f} seconds, {seconds['fit']:.1f} of them for the"
    assert whole in out
    assert sum(seconds.values()) == pytest.approx(time.perf_counter() - since, abs=0.5)
    assert report["table"]["n_missing_points"] == 0
    assert "missing" not in out
    assert "choice" not in report
    assert sum(row["energy_share"] for row in report["model"]["alpha"]) == (
        pytest.approx(1)
    )


def test_tables_written_are_those_of_the_model(fitted, faces):
    model = load_model(fitted / "model.npz")
    X = faces[model.feature_names_in_]
    alpha = pd.read_csv(fitted / "alpha.csv", dtype={"code": str})
    assert list(alpha) == ["row", "name", "code", "alpha_1", "alpha_2"]
    assert list(alpha["row"]) == list(range(N_FRAMES))
    assert list(alpha["name"]) == list(faces["name"])
    assert list(alpha["code"]) == list(faces["code"])
    np.testing.assert_allclose(alpha[["alpha_1", "alpha_2"]], model.alpha_, rtol=1e-12)

    cameras = pd.read_csv(fitted / "cameras.csv")
    numbers = "row m00 m01 m02 m10 m11 m12 tx ty inverse_snr yaw pitch roll scale"
    assert " ".join(cameras) == numbers
    arrays = np.load(fitted / "shapes.npz", allow_pickle=False)
    assert list(arrays["component_names"]) == ["alpha_1", "alpha_2"]
    assert list(arrays["point_names"]) == [str(j) for j in range(68)]
    shapes = arrays["mean_shape"] + np.tensordot(
        alpha[["alpha_1", "alpha_2"]].to_numpy(), arrays["basis"], 1
    )
    motion = cameras.iloc[:, 1:7].to_numpy().reshape(-1, 2, 3)
    images = shapes @ motion.swapaxes(1, 2) + cameras[["tx", "ty"]].to_numpy()[:, None]
    np.testing.assert_allclose(
        images.reshape(len(X), -1), model.reproject(X), rtol=1e-9
    )

    report = json.loads((fitted / "report.json").read_text())
    assert report["model"]["inverse_snr"] == pytest.approx(model.inverse_snr_)
    assert report["model"]["held_out_error"] == pytest.approx(-model.score(X))
    assert report["model"]["noise_variance"] == pytest.approx(model.noise_variance_)
    off = np.linalg.norm((images - X.to_numpy().reshape(images.shape)), axis=2)
    assert report["model"]["rms_point_error"] == pytest.approx(np.sqrt(np.mean(off**2)))


def test_model_does_not_depend_on_the_terminal_and_the_figures(fitted, faces):
    model = load_model(fitted / "model.npz")
    assert model.verbose == 0
    again = AffineNRSfM(**model.get_params(deep=False)).fit(
        faces[model.feature_names_in_]
    )
    np.testing.assert_array_equal(again.alpha_, model.alpha_)


def test_options_reach_the_estimator(run, table, tmp_path):
    options = "--isa fast --n-init 3 --block-recovery eigen --refinement none "
    options += "--independence none --no-scale-frames --random-state 7 --n-jobs 1 "
    options += "--no-figures -k 1"
    code, _, _ = run("fit", table, "-o", tmp_path, *options.split())
    assert code == 0
    model = load_model(tmp_path / "model.npz")
    assert type(model.isa).__name__ == "FastISA"
    assert (model.isa.n_init, model.n_components, model.random_state) == (3, 1, 7)
    assert (model.block_recovery, model.refinement) == ("eigen", None)
    assert (model.scale_frames, model.n_jobs) == (False, 1)
    assert (model.independence, model.loss) == (None, "linear")
    options = "--independence coefficients --loss huber --no-figures -k 1"
    code, out, _ = run("fit", table, "-o", tmp_path, *options.split())
    assert code == 0
    assert " (outliers count in full)\n" in out
    model = load_model(tmp_path / "model.npz")
    assert (model.refinement, model.loss) == ("joint", "huber")
    assert model.independence == "coefficients"


def test_defaults_are_those_of_the_estimator(run, table, tmp_path):
    assert run("fit", table, "-o", tmp_path, "--no-figures")[0] == 0
    model = load_model(tmp_path / "model.npz")
    assert model.get_params() == AffineNRSfM(random_state=0).get_params()


@pytest.mark.parametrize("camera", slow_after(1, ["orthographic", "weak_perspective"]))
def test_calibrated_cameras(run, tmp_path, camera):
    faces = make_face_tracks(
        80, n_components=2, camera=camera, noise=0.01, random_state=0
    )
    X = pd.DataFrame(faces.data, columns=faces.feature_names)
    path, folder = tmp_path / "faces.csv", tmp_path / "results"
    X.to_csv(path, index=False)
    code, out, err = run("fit", path, "-o", folder, "--camera", camera, "-k", "auto")
    assert (code, err) == (0, "")
    assert all(len(line) <= 120 for line in out.splitlines())
    assert "Choice     K = 2: what the table determines\n" in out
    assert f"Cameras    {camera.replace('_', '-')}: shapes have true proportions" in out
    assert "calibrated cameras explain the table as well as affine ones" in out

    model = load_model(folder / "model.npz")
    assert (model.n_components, model.camera, len(model.basis_)) == ("auto", camera, 2)
    report = json.loads((folder / "report.json").read_text())["model"]
    assert (report["n_components"], report["camera"]) == (2, camera)
    assert report["camera_noise_ratio"] == pytest.approx(model.camera_noise_ratio_)
    meaning = model.diagnostics().camera_meaning
    assert report["camera_meaning"] == meaning
    scaled = camera == "weak_perspective"
    assert report["frames_scaled"] == scaled
    noise = np.sqrt(model.noise_variance_)
    if scaled:
        assert f"noise {100 * noise:.3g} % of the frame's size" in out
    else:
        assert f"noise {noise:.3g} in the units of the table" in out
        off = np.std(faces.data - faces.clean.reshape(80, -1))
        assert noise == pytest.approx(off, rel=0.05)
    fitted = np.asarray(model.reproject(X))
    expected = inverse_snr(X, fitted, scale_frames=scaled)
    assert report["inverse_snr"] == pytest.approx(expected, rel=1e-6)

    # The images of cameras.csv and shapes.npz are scaled rotations of true shapes.
    cameras = pd.read_csv(folder / "cameras.csv")
    M = cameras[[f"m{i}{j}" for i in range(2) for j in range(3)]].to_numpy()
    M = M.reshape(-1, 2, 3)
    grams = M @ M.transpose(0, 2, 1)
    scales = model.scales_[:, None, None] ** 2
    np.testing.assert_allclose(grams, scales * np.eye(2), atol=1e-6 * scales.max())
    page = (folder / "viewer.html").read_text(encoding="utf-8")
    assert f"{camera.replace('_', '-')} cameras" in page

    output = tmp_path / "alpha.csv"
    options = ["--output", output, "--std"]
    code, out, _ = run("transform", folder / "model.npz", path, *options)
    assert code == 0
    report_snr = f"inverse SNR {100 * expected:.3g} %"
    assert report_snr in out
    alpha = pd.read_csv(output)
    np.testing.assert_allclose(alpha["alpha_1"], model.alpha_[:, 0], atol=1e-4)


def test_auto_is_for_the_joint_refinement(fails, table, tmp_path):
    options = ["-o", tmp_path, "-k", "auto", "--refinement", "none"]
    message = fails("fit", table, *options)
    assert "--n-components auto needs --refinement joint" in message


def test_what_the_table_hardly_determines_is_said(run, table, tmp_path, monkeypatch):
    diagnose = AffineNRSfM.diagnostics

    def diagnostics(self, X):
        warnings.warn("the table says little", stacklevel=2)
        return diagnose(self, X)

    monkeypatch.setattr(AffineNRSfM, "diagnostics", diagnostics)
    code, _, err = run("fit", table, "-o", tmp_path, "--no-figures")
    assert code == 0
    assert "warning: the table says little" in err
    report = json.loads((tmp_path / "report.json").read_text())
    assert "the table says little" in report["warnings"]


def test_outliers_and_pose_are_reported(run, tmp_path):
    scene = make_face_tracks(80, n_components=1, noise=0.01, random_state=0)
    table = pd.DataFrame(scene.data, columns=scene.feature_names)
    for row in range(8, 16):
        table.loc[row, f"x_{4 * row}"] += 300.0
    table["name"] = np.where(np.arange(80) < 5, "skip", "keep")
    table.to_csv(tmp_path / "faces.csv", index=False)
    fit = ["fit", tmp_path / "faces.csv", "-o", tmp_path, "--no-figures", "-k", 1]
    code, out, err = run(*fit, "--skip-rows", "name=skip")
    assert code == 0
    (said,) = re.findall("warning: (the table has outliers: .*): they bend", err)
    assert said in " ".join(out.split())
    assert "--loss cauchy" in err
    assert re.search(
        r"alpha_1 .* \d+ %\n +pose: variance that yaw, pitch and roll", out
    )
    model = json.loads((tmp_path / "report.json").read_text())["model"]
    # The basis shape bends to some of the eight. Rows are those of the table.
    largest = [
        (each["row"], int(each["point"])) for each in model["outliers"]["largest"]
    ]
    assert 4 <= len(largest) == model["outliers"]["n_points"]
    assert {row for row, _ in largest} < {*range(8, 16)}
    assert all(point == 4 * row for row, point in largest[:4])
    assert model["alpha"][0]["pose_share"] < 0.3
    assert model["alpha"][0]["effective_frames"] > 1
    code, out, err = run(*fit, "--loss", "cauchy")
    assert code == 0
    assert "outliers" not in err


def test_rows_with_missing_points_are_fitted(run, faces, tmp_path):
    faces = faces.copy()
    faces.loc[3, ["x_5", "y_5"]] = 0.0
    faces.loc[9, ["x_5", "y_5"]] = 0.0  # an ir row
    faces.loc[[4, 11], ["x_7", "y_7"]] = np.nan
    faces.loc[12, "y_8"] = np.nan
    path = tmp_path / "faces.csv"
    faces.to_csv(path, index=False)
    code, out, err = run(
        "fit", path, "-o", tmp_path, "--skip-rows", "name=^ir", "--zeros-missing",
        *QUICK,
    )  # fmt: skip
    assert code == 0
    # The row is that of the table, however many are skipped before.
    assert err == (
        "isa-nrsfm: warning: 1 point(s) in 1 row(s) have only one of their two "
        "coordinates and count as missing; the first is point 8 (x_8, y_8) in row 12\n"
    )
    assert " 6 left out: name matches '^ir'\n" in out
    assert "54 used\n" in out
    assert " 4 points (0.109 %) are missing in 4 of these rows\n" in out
    for name in FIGURES:
        assert (tmp_path / name).read_bytes().startswith(PNG)
    report = json.loads((tmp_path / "report.json").read_text())
    assert report["table"]["n_missing_points"] == 4
    assert report["table"]["n_frames_with_missing_points"] == 4
    assert report["model"]["rank_floor"] is None
    landmarks = [f"{axis}_{j}" for j in range(68) for axis in "xy"]
    X = faces.loc[~faces["name"].str.startswith("ir"), landmarks].copy()
    X.loc[3, ["x_5", "y_5"]] = np.nan
    X.loc[12, "x_8"] = np.nan
    model = load_model(tmp_path / "model.npz")
    again = AffineNRSfM(**model.get_params(deep=False)).fit(X)
    alpha = pd.read_csv(tmp_path / "alpha.csv")
    assert list(alpha["row"]) == list(X.index)
    np.testing.assert_allclose(alpha[["alpha_1", "alpha_2"]], again.alpha_, atol=1e-9)
    off = (again.reproject(X) - X).to_numpy()
    assert report["model"]["rms_point_error"] == pytest.approx(
        np.sqrt(2 * np.nanmean(off**2))
    )


def test_rows_that_cannot_be_fitted_are_counted_and_empty(run, faces, tmp_path):
    faces = faces.copy()
    landmarks = [f"{axis}_{j}" for j in range(68) for axis in "xy"]
    faces.loc[[4, 9], landmarks] = np.nan  # 9 is an ir row
    faces.loc[5, landmarks[6:]] = np.nan
    faces.loc[20, landmarks] = 31.0
    faces.loc[21, landmarks] = np.nan
    faces.loc[21, landmarks[:12]] = np.repeat(np.arange(6.0), 2)
    path = tmp_path / "faces.csv"
    faces.to_csv(path, index=False)
    code, out, err = run(
        "fit", path, "-o", tmp_path, "--skip-rows", "name=^ir",
        "--skip-rows", "code = 1$|^nothing", "--no-figures", "--std", *QUICK,
    )  # fmt: skip
    assert (code, err) == (0, "")
    for line in (
        "60 rows",
        " 6 left out: name matches '^ir'",
        " 1 left out: all points missing",
        " 1 left out: fewer than 4 points",
        " 1 left out: all points in one place",
        " 1 left out: points on one line, others missing",
        "50 used",
    ):
        assert f" {line}\n" in out
    report = json.loads((tmp_path / "report.json").read_text())
    assert [rows["first_rows"] for rows in report["table"]["rows_left_out"]] == [
        [9, 19, 29, 39, 49, 59],
        [4],
        [5],
        [20],
        [21],
    ]
    kept = [i for i in range(N_FRAMES) if i % 10 != 9]
    for name in ("alpha.csv", "cameras.csv"):
        written = pd.read_csv(tmp_path / name)
        assert list(written["row"]) == kept
        results = written.iloc[:, -4:]
        empty = written["row"].isin([4, 5, 20, 21])
        assert results[empty].isna().all(axis=None)
        assert results[~empty].notna().all(axis=None)
    alpha = pd.read_csv(tmp_path / "alpha.csv")
    assert list(alpha["name"]) == list(faces["name"][kept])
    # transform says the same of these rows, and gives the same numbers.
    output = tmp_path / "again.csv"
    code, out, _ = run(
        "transform", tmp_path / "model.npz", path, "-o", output, "--std",
        "--skip-rows", "name=^ir",
    )  # fmt: skip
    assert code == 0
    assert " 1 without coefficients: points on one line, others missing\n" in out
    again = pd.read_csv(output)
    assert list(again) == list(alpha)
    np.testing.assert_allclose(
        again.filter(like="alpha"), alpha.filter(like="alpha"), atol=1e-7
    )


def test_standard_deviations_are_written_where_they_are_known(
    run, fails, table, fitted, tmp_path
):
    output = tmp_path / "alpha.csv"
    model = load_model(fitted / "model.npz")
    code, out, _ = run("transform", fitted / "model.npz", table, "-o", output)
    assert code == 0
    assert "std" not in " ".join(pd.read_csv(output))
    run("transform", fitted / "model.npz", table, "-o", output, "--std")
    written = pd.read_csv(output)
    assert list(written)[-2:] == ["alpha_1_std", "alpha_2_std"]
    np.testing.assert_allclose(written.iloc[:, -2:], model.alpha_std_, rtol=1e-6)
    assert (written.iloc[:, -2:] > 0).all(axis=None)

    # A model without the frames of its fit knows them, too.
    bare = AffineNRSfM(**(model.get_params(deep=False) | {"keep_frames": False}))
    bare.fit(pd.read_csv(table)[list(model.feature_names_in_)])
    save_model(bare, tmp_path / "bare.npz")
    code, _, _ = run("transform", tmp_path / "bare.npz", table, "-o", output, "--std")
    assert code == 0
    again = pd.read_csv(output).iloc[:, -2:]
    np.testing.assert_allclose(again, model.alpha_std_, rtol=1e-6)

    folder = tmp_path / "results"
    options = ["--no-figures", "--refinement", "none", *QUICK]
    message = fails("fit", table, "-o", folder, "--std", *options)
    assert "--std: only --refinement joint knows" in message
    assert not folder.exists()
    code, out, _ = run("fit", table, "-o", folder, *options)
    assert code == 0
    assert "noise" not in out
    message = fails("transform", folder / "model.npz", table, "-o", output, "--std")
    assert "was fitted with refinement=None" in message


@pytest.mark.slow
def test_number_of_basis_shapes_is_chosen_by_held_out_points(
    run, fails, table, fitted, faces, tmp_path
):
    options = ["--isa", "fast", "--n-init", "2", "--no-figures"]
    code, out, err = run("fit", table, "-o", tmp_path, "-k", "1,2-3", *options)
    assert code == 0
    # What is known of each number is told at once.
    told = [line for line in err.splitlines() if "held-out error" in line]
    assert [line.split(":")[0].split("=")[1] for line in told] == list("123")
    choice = json.loads((tmp_path / "report.json").read_text())["choice"]
    assert choice["n_components"] == [1, 2, 3]
    assert choice["chosen"] == N_COMPONENTS
    assert out.startswith("2 basis shapes fitted to")
    lines = out.splitlines()
    start = next(i for i, line in enumerate(lines) if line.startswith("Choice"))
    assert [line.split()[0] for line in lines[start + 1 : start + 4]] == list("123")
    assert [line.endswith("the least") for line in lines[start + 1 : start + 4]] == [
        False,
        True,
        False,
    ]
    assert "larger K" not in out
    # The fit is the one of this K alone; the scores are nearly those of scikit-learn.
    assert (tmp_path / "alpha.csv").read_bytes() == (fitted / "alpha.csv").read_bytes()
    model = load_model(tmp_path / "model.npz").set_params(n_components=1)
    X = faces[model.feature_names_in_]
    assert choice["held_out_error_of_parts"][0] == pytest.approx(
        -cross_val_score(model, X, cv=3), rel=0.01
    )
    assert choice["held_out_error"] == pytest.approx(
        np.mean(choice["held_out_error_of_parts"], axis=1)
    )
    code, out, _ = run("fit", table, "-o", tmp_path, "-k", "1-2", *options)
    assert "larger K may be better: this is the largest that was tried" in out
    assert "to try K = 3-5, too, would take about" in out

    folder = ["-o", tmp_path / "none", *options]
    assert "at least 94 points" in fails("fit", table, *folder, "-k", "1-30")
    few = ["--skip-rows", "code=[1-9].$"]  # ten rows, six or seven in a fit
    message = fails("fit", table, *folder, *few, "-k", "1-3")
    assert "of cv fits 6 frames, enough for --n-components 1 at most" in message


def test_points_at_zero_are_pointed_out(run, faces, tmp_path):
    faces = faces.copy()
    faces.loc[[3, 9], ["x_5", "y_5"]] = 0.0
    faces.to_csv(tmp_path / "faces.csv", index=False)
    code, _, err = run(
        "fit", tmp_path / "faces.csv", "-o", tmp_path, "--no-figures", *QUICK
    )
    assert code == 0
    zeros, few = (
        line.removeprefix("isa-nrsfm: warning: ") for line in err.strip().split("\n")
    )
    assert zeros == (
        "2 points in 2 rows are at exactly (0, 0); if that marks missing points, use "
        "--zeros-missing"
    )
    assert re.search(r"a handful of the 60 frames decide alpha_1 \(.* row [39]\)", few)
    report = json.loads((tmp_path / "report.json").read_text())
    assert report["warnings"] == [zeros, few]


def test_transform_gives_each_row_its_coefficients(run, fitted, faces, tmp_path):
    model = load_model(fitted / "model.npz")
    landmarks = list(model.feature_names_in_)
    new = faces.iloc[::-1].reset_index(drop=True)
    new.loc[2, ["x_3", "y_3"]] = np.nan
    new["alpha_1"] = "mine"
    shuffled = new[[*landmarks[1::2], "alpha_1", "name", *landmarks[0::2]]]
    path, output = tmp_path / "new.parquet", tmp_path / "new-alpha.csv"
    shuffled.to_parquet(path)
    code, out, err = run(
        "transform", fitted / "model.npz", path, "-o", output,
        "--skip-rows", "name=^ir",
    )  # fmt: skip
    assert code == 0
    assert err == (
        "isa-nrsfm: warning: the table has columns named like results, which are "
        "called alpha_1_ (not alpha_1)\n"
    )
    assert out.startswith("2 coefficients of 54 frames\n")
    assert " 6 left out: name matches '^ir'" in out
    assert " 1 points (0.0272 %) are missing in 1 of these rows\n" in out
    assert out.endswith("54 rows\n")
    alpha = pd.read_csv(output)
    assert list(alpha) == ["row", "alpha_1", "name", "alpha_1_", "alpha_2"]
    assert list(alpha["name"]) == [n for n in new["name"] if not n.startswith("ir")]
    assert list(new["name"][alpha["row"]]) == list(alpha["name"])
    complete = alpha["row"] != 2
    X = new[landmarks].iloc[alpha["row"]]
    np.testing.assert_allclose(
        alpha[["alpha_1_", "alpha_2"]], model.transform(X), atol=1e-9
    )
    held_out = float(out.partition("held-out error ")[2].partition(" %")[0])
    assert held_out == pytest.approx(-100 * model.score(X), rel=5e-3)
    snr = inverse_snr(X, model.reproject(X), scale_frames=True)
    shown = float(out.partition("inverse SNR ")[2].partition(" %")[0])
    assert shown == pytest.approx(100 * snr, rel=5e-3)
    rows = N_FRAMES - 1 - alpha["row"][complete]
    np.testing.assert_allclose(
        alpha.loc[complete, ["alpha_1_", "alpha_2"]], model.alpha_[rows], atol=1e-9
    )


def test_transform_of_no_usable_row_is_empty(run, fitted, faces, tmp_path):
    path, output = tmp_path / "new.csv", tmp_path / "alpha.tsv"
    coordinates = {name: "" for name in faces if name[:2] in ("x_", "y_")}
    faces.assign(**coordinates).to_csv(path, index=False)
    code, out, _ = run("transform", fitted / "model.npz", path, "-o", output)
    assert code == 0
    assert "60 without coefficients: all points missing" in out
    assert "no frame was fitted" in out
    assert out.endswith("60 rows\n")
    assert pd.read_csv(output, sep="\t")["alpha_2"].isna().all()
    code, out, _ = run(
        "transform", fitted / "model.npz", path, "-o", output, "--skip-rows", "name=i"
    )
    assert code == 0
    assert out.endswith(" 0 rows\n")


@pytest.mark.parametrize("layout", ["interleaved", "planar"])
@pytest.mark.parametrize("named", [True, False])
def test_transform_follows_the_layout_of_the_model(
    run, faces, table, tmp_path, layout, named
):
    names = [f"{axis}_{j}" for j in range(68) for axis in "xy"]
    if layout == "planar":
        names = names[0::2] + names[1::2]
    X = faces[names].rename(columns=lambda name: f" {name}")
    model = AffineNRSfM(2, layout=layout, random_state=0)
    model.fit(X if named else X.to_numpy())
    save_model(model, tmp_path / "model.npz")
    code, _, err = run(
        "transform", tmp_path / "model.npz", table, "-o", tmp_path / "alpha.csv"
    )
    assert (code, err) == (0, "")
    alpha = pd.read_csv(tmp_path / "alpha.csv")[["alpha_1", "alpha_2"]]
    np.testing.assert_allclose(alpha, model.alpha_, atol=1e-9)


def test_transform_names_the_difference_between_points(fails, fitted, faces, tmp_path):
    model, path = fitted / "model.npz", tmp_path / "new.csv"
    output = ["-o", tmp_path / "alpha.csv"]
    faces.drop(columns=["x_3", "y_3"]).to_csv(path, index=False)
    message = fails("transform", model, path, *output)
    assert (
        "not those of the model: 2 columns are only in the model (x_3, y_3)" in message
    )
    renamed = faces.rename(columns=lambda name: name.replace("_", ""))
    renamed.to_csv(path, index=False)
    message = fails("transform", model, path, *output)
    assert "136 columns are only in the model (x_0, y_0, x_1, y_1, ...)" in message
    assert "136 columns are only in the table (x0, y0, x1, y1, ...)" in message
    assert "136 columns" in fails(
        "transform", model, path, *output, "--columns", "x#,y#"
    )
    faces.assign(x_68=1.0, y_68=1.0).to_csv(path, index=False)
    message = fails("transform", model, path, *output, "--columns", "x_#,y_#")
    assert "2 columns are only in the table (x_68, y_68)" in message


@pytest.mark.filterwarnings("ignore::sklearn.exceptions.ConvergenceWarning")
def test_transform_of_a_model_without_names_counts_points(fails, faces, tmp_path):
    X = faces.drop(columns=["name", "code"]).to_numpy()[:, :40]
    save_model(AffineNRSfM(1, random_state=0).fit(X), tmp_path / "model.npz")
    faces.to_csv(tmp_path / "new.csv", index=False)
    message = fails(
        "transform", tmp_path / "model.npz", tmp_path / "new.csv",
        "-o", tmp_path / "alpha.csv",
    )  # fmt: skip
    assert "the model has 20 points, the table has 68 (x_#,y_#)" in message


def test_columns_choose_among_several_sets(run, fails, faces, tmp_path):
    landmarks = [name for name in faces if name[:2] in ("x_", "y_")]
    eyes = faces[landmarks].add_prefix("eye_")
    path = tmp_path / "faces.csv"
    pd.concat([faces, eyes], axis=1).to_csv(path, index=False)
    message = fails("fit", path, "-o", tmp_path / "results")
    assert "more than one set of landmark columns: 'x_#,y_#' (68 points: " in message
    assert "'eye_x_#,eye_y_#' (68 points: eye_x_0 to eye_x_67)" in message
    assert not (tmp_path / "results").exists()
    code, out, _ = run(
        "fit", path, "-o", tmp_path, "--columns", "eye_x_#,eye_y_#", "--no-figures",
        *QUICK,
    )  # fmt: skip
    assert code == 0
    assert "eye_x_0, eye_y_0, eye_x_1, eye_y_1, ..., eye_x_67, eye_y_67" in out
    assert "coordinates not used: x_#,y_# (68)" in out


def test_named_index_of_a_parquet_file_is_a_column(run, faces, tmp_path):
    path = tmp_path / "faces.parquet"
    faces.set_index("name").to_parquet(path)
    options = ["--skip-rows", "name=^ir", "--no-figures", *QUICK]
    code, _, err = run("fit", path, "-o", tmp_path, *options)
    assert (code, err) == (0, "")
    alpha = pd.read_csv(tmp_path / "alpha.csv")
    assert list(alpha)[:3] == ["row", "name", "code"]
    assert list(alpha["name"]) == list(faces["name"][alpha["row"]])
    assert len(alpha) == 54
    # An index without a name, such as the numbers of chosen rows, is none.
    faces[5:].to_parquet(path)
    code, _, err = run("fit", path, "-o", tmp_path, *options)
    assert (code, err) == (0, "")
    assert list(pd.read_csv(tmp_path / "alpha.csv"))[:3] == ["row", "name", "code"]


def test_x_and_y_may_differ_in_case(run, faces, fitted, tmp_path):
    path = tmp_path / "faces.csv"
    faces.rename(columns=lambda name: name.replace("x_", "X_")).to_csv(
        path, index=False
    )
    code, _, err = run(
        "fit", path, "-o", tmp_path, "--columns", "X_#,y_#", "--no-figures", *QUICK
    )
    assert (code, err) == (0, "")
    written = (tmp_path / "alpha.csv").read_bytes()
    assert written == (fitted / "alpha.csv").read_bytes()


def test_bad_tables_are_refused_in_one_line(fails, run, table, faces, tmp_path):
    folder = ["-o", tmp_path / "results", "--no-figures"]
    absent = tmp_path / "absent.csv"
    assert f"{absent}: No such file" in fails("fit", absent, *folder)
    (tmp_path / "folder.csv").mkdir()
    message = fails("fit", tmp_path / "folder.csv", *folder)
    assert "folder.csv is of no known format. Expected pts" in message
    (tmp_path / "ragged.csv").write_text("x0,y0\n1\n")
    assert "line 2" in fails("fit", tmp_path / "ragged.csv", *folder)
    (tmp_path / "other.csv").write_text("a,b\n1,2\n")
    assert "no landmark columns" in fails("fit", tmp_path / "other.csv", *folder)
    faces.assign(x_3="?").to_csv(tmp_path / "text.csv", index=False)
    assert "'x_3' should hold" in fails("fit", tmp_path / "text.csv", *folder)
    assert "no column matches 'u#'" in fails(
        "fit", table, *folder, "--columns", "u#,v#"
    )
    message = fails("fit", table, *folder, "--skip-rows", "nam=^i")
    assert "no column 'nam'; its columns are name, x_0, y_0" in message
    message = fails("fit", table, *folder, "--skip-rows", "name=^i")
    assert "no row of" in message
    assert "60 left out (name matches '^i')" in message
    assert "at least 94 points" in fails("fit", table, *folder, "-k", "30")
    message = fails(
        "fit", table, *folder, "-k", "3", "--skip-rows", "code=[1-9].$|[4-9]$"
    )
    assert "at least 8 frames" in message


def test_bad_models_are_refused_in_one_line(fails, table, fitted, tmp_path):
    output = ["-o", tmp_path / "alpha.csv"]
    absent = tmp_path / "absent.npz"
    assert f"{absent}: No such file" in fails("transform", absent, table, *output)
    assert "is not a model file" in fails("transform", table, table, *output)
    message = fails("transform", fitted / "model.npz", table, "-o", tmp_path / "a.txt")
    assert "a.txt: a table is a .csv, .tsv or .parquet file" in message


def test_outputs_that_cannot_be_written_are_refused(
    fails, run, table, fitted, faces, tmp_path
):
    message = fails("fit", table, "-o", table, *QUICK)
    assert "File exists" in message or "Not a directory" in message
    message = fails("fit", table, "-o", table / "results", *QUICK)
    assert "Not a directory" in message
    message = fails(
        "transform", fitted / "model.npz", table, "-o", tmp_path / "no/a.csv"
    )
    assert "no" in message
    copy = tmp_path / "alpha.csv"
    faces.to_csv(copy, index=False)
    for argv in (
        ("fit", copy, "-o", tmp_path, *QUICK),
        ("transform", fitted / "model.npz", copy, "-o", copy),
    ):
        assert "would be overwritten by the results" in fails(*argv)
    pd.testing.assert_frame_equal(pd.read_csv(copy, dtype={"code": str}), faces)


def test_old_figures_are_pointed_out(run, table, tmp_path):
    (tmp_path / "basis_shapes.png").write_bytes(PNG)
    _, _, err = run("fit", table, "-o", tmp_path, "--no-figures", *QUICK)
    assert err.startswith("isa-nrsfm: warning: ")
    assert "figures of an earlier run: basis_shapes.png" in err
    assert (tmp_path / "basis_shapes.png").read_bytes() == PNG


@pytest.mark.parametrize("exists", [True, False])
def test_a_figure_that_fails_costs_no_results(run, fitted, table, tmp_path, exists):
    folder = tmp_path / "results"
    if exists:
        shutil.copytree(fitted, folder)
        (folder / "mode_covariance.png").write_bytes(PNG)
    seen = []

    def fail(*_args, **_keywords):
        seen.extend(sorted(path.name for path in folder.iterdir() if path.is_file()))
        raise np.linalg.LinAlgError("no axes")

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(ModeCovarianceDisplay, "from_estimator", fail)
        code, out, err = run("fit", table, "-o", folder, *QUICK)
    warning = "mode_covariance.png was not drawn: no axes"
    assert (code, err) == (0, f"isa-nrsfm: warning: {warning}\n")
    # All results were there, and only they, when figures began.
    assert set(seen) == FIT_FILES
    left = FIT_FILES | FIGURES - {"mode_covariance.png"}
    assert {path.name for path in folder.iterdir()} == left
    assert "mode_covariance" not in out
    report = json.loads((folder / "report.json").read_text())
    assert set(report["files"]) == set(report["sha256"]) == left - {"report.json"}
    assert report["warnings"] == [warning]
    assert warning in (folder / "report.html").read_text()


def test_figures_are_not_written_to_another_run(fails, fitted, table, tmp_path):
    def write_another_run(*_args, **_keywords):
        shutil.copytree(fitted, tmp_path, dirs_exist_ok=True)
        return draw(*_args, **_keywords)

    draw = files_together
    steps = iter([draw, write_another_run])
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(
            _commands, "files_together", lambda *a, **kw: next(steps)(*a, **kw)
        )
        message = fails("fit", table, "-o", tmp_path, *QUICK, "--random-state", "3")
    assert "another run has written to" in message
    for name in FIT_FILES:
        assert (tmp_path / name).read_bytes() == (fitted / name).read_bytes()


def test_missing_libraries_are_named_before_the_fit(
    fails, table, tmp_path, monkeypatch
):
    monkeypatch.setitem(sys.modules, "matplotlib", None)
    message = fails("fit", table, "-o", tmp_path / "results", *QUICK)
    assert 'pip install "isa-nrsfm[plot]"' in message
    assert not (tmp_path / "results").exists()


@pytest.mark.parametrize(
    "argv",
    [
        [],
        ["fit"],
        ["fit", "t.csv"],
        ["fit", "t.csv", "-o", "d", "-k", "0"],
        ["fit", "t.csv", "-o", "d", "-k", "two"],
        ["fit", "t.csv", "-o", "d", "-k", "3-1"],
        ["fit", "t.csv", "-o", "d", "-k", "1-"],
        ["fit", "t.csv", "-o", "d", "-k", "1-1000"],
        ["fit", "t.csv", "-o", ""],
        ["fit", "", "-o", "d"],
        ["demo", "-o", " "],
        ["transform", "m.npz", "t.csv", "-o", ""],
        ["fit", "t.csv", "-o", "d", "--loss", "none"],
        ["fit", "t.csv", "-o", "d", "--isa", "slow"],
        ["fit", "t.csv", "-o", "d", "--random-state", "-1"],
        ["fit", "t.csv", "-o", "d", "--skip-rows", "name"],
        ["fit", "t.csv", "-o", "d", "--skip-rows", "name=["],
        ["fit", "t.csv", "--out", "d"],
        ["transform", "m.npz", "t.csv"],
    ],
)
def test_wrong_usage_ends_with_code_2(argv, capsys):
    with pytest.raises(SystemExit) as error:
        main(argv)
    assert error.value.code == 2
    assert "usage: isa-nrsfm" in capsys.readouterr().err


@pytest.mark.parametrize("numbers", ["-1", "1-", "-", "2,-3", "1.5"])
def test_wrong_numbers_of_shapes_are_said_as_they_came(numbers, capsys):
    with pytest.raises(SystemExit):
        main(["fit", "t.csv", "-o", "d", "-k", numbers])
    wrong = numbers.split(",")[-1]
    assert capsys.readouterr().err.endswith(f"got {wrong!r}\n")


@pytest.mark.parametrize("argv", [["--version"], ["--help"], ["fit", "--help"]])
def test_version_and_help(argv, capsys):
    with pytest.raises(SystemExit) as error:
        main(argv)
    assert error.value.code == 0
    out = capsys.readouterr().out
    assert (f"isa-nrsfm {__version__}\n" == out) == (argv == ["--version"])
    assert ("example" in out) == (argv != ["--version"])


def test_interruption_ends_with_code_130(run, table, tmp_path, monkeypatch):
    def interrupt(*_args, **_keywords):
        raise KeyboardInterrupt

    monkeypatch.setattr(AffineNRSfM, "fit", interrupt)
    code, out, err = run("fit", table, "-o", tmp_path, "--no-figures")
    assert (code, out, err) == (130, "", "isa-nrsfm: interrupted\n")


def test_warnings_are_shown_once_and_in_one_line(run, table, tmp_path, monkeypatch):
    import warnings

    fit = AffineNRSfM.fit

    def warn_and_fit(self, X, y=None):
        for _ in range(2):
            warnings.warn("a\n  long warning", UserWarning, stacklevel=1)
        warnings.warn("for developers", DeprecationWarning, stacklevel=1)
        return fit(self, X, y)

    monkeypatch.setattr(AffineNRSfM, "fit", warn_and_fit)
    code, _, err = run("fit", table, "-o", tmp_path, "--no-figures", *QUICK)
    assert (code, err) == (0, "isa-nrsfm: warning: a long warning\n")


def test_messages_name_options(run, fails, table, tmp_path, monkeypatch):
    message = fails("fit", table, "-o", tmp_path, "-k", "40", "--no-figures")
    assert "--n-components 40 needs at least 124 points" in message
    assert "the largest possible --n-components is 21" in message

    fit = AffineNRSfM.fit

    def warn_and_fit(self, X, y=None):
        said = "got camera='affine'; n_components=2 of a/camera=1.csv, layout='planar'"
        warnings.warn(said, UserWarning, stacklevel=1)
        return fit(self, X, y)

    monkeypatch.setattr(AffineNRSfM, "fit", warn_and_fit)
    _, _, err = run("fit", table, "-o", tmp_path, "--no-figures", *QUICK)
    said = "got --camera affine; --n-components 2 of a/camera=1.csv, layout='planar'"
    assert err == f"isa-nrsfm: warning: {said}\n"


@pytest.mark.slow
def test_demo_writes_a_table_and_finds_its_faces(run, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    # All numbers that the demo tries would take long.
    started = Namespace(since=time.perf_counter())
    args, warned = build_parser().parse_args(["demo", "--no-figures"], started), []
    out = run_demo(args, warned, tried="3-4")
    assert warned == []
    folder = tmp_path / "isa-nrsfm-demo"
    assert {path.name for path in folder.iterdir()} == FIT_FILES | {"tracks.csv"}
    report = json.loads((folder / "report.json").read_text())
    truth = report["truth"]
    assert [row["name"] for row in truth["basis"]][:2] == ["jaw open", "smile"]
    assert truth["shape_error"] < 0.3 * truth["mean_shape_error"]
    assert all(row["similarity"] > 0.9 for row in truth["basis"])
    assert all(row["correlation"] > 0.9 for row in truth["basis"])
    assert report["choice"]["chosen"] == len(truth["basis"]) == 3
    tracks = pd.read_csv(folder / "tracks.csv")
    assert list(tracks)[:3] == ["frame", "x_0", "y_0"]
    command = out[out.index("isa-nrsfm fit") :].split()[1:]
    before = (folder / "alpha.csv").read_bytes()
    assert build_parser().parse_args(command).n_components == (3, 4)
    command[command.index("3-4")] = "3"
    assert run(*command)[0] == 0
    assert (folder / "alpha.csv").read_bytes() == before


@pytest.mark.slow
def test_table_as_it_is_distributed(run, data_path, tmp_path):
    table = data_path("raw/muct76-opencv.csv")
    code, out, err = run(
        "fit", table, "--skip-rows", "name=^ir", "--zeros-missing", "-k", "2",
        "--n-init", "1", "--no-figures", "-o", tmp_path,
    )  # fmt: skip
    assert code == 0
    # Faces of this table are turned, and their jaw is the visible outline.
    (warned,) = err.splitlines()
    assert "the pose predicts" in warned
    assert "15 points of xm2vts-68 follow the visible outline" in warned
    assert "3755 left out: name matches '^ir'" in out
    assert "3755 used" in out
    assert "2544 points (0.996 %) are missing in 840 of these rows" in out
    alpha = pd.read_csv(tmp_path / "alpha.csv")
    source = pd.read_csv(table)
    assert len(alpha) == 3755
    assert alpha["alpha_2"].notna().all()
    assert list(alpha["name"]) == list(source["name"][alpha["row"]])


def test_program_reports_on_standard_output_only(table, tmp_path, capfd):
    # The program itself is started in the two tests of the terminal and its signals.
    argv = ["fit", str(table), "-o", str(tmp_path), "--no-figures", *QUICK]
    assert main(argv) == 0
    out, err = capfd.readouterr()
    assert err == ""
    assert out.startswith("2 basis shapes fitted to")


@pytest.mark.subprocess
def test_progress_is_shown_on_a_terminal(table, tmp_path):
    reading, writing = pty.openpty()
    done = subprocess.run(
        [PROGRAM, "fit", str(table), "-o", str(tmp_path), "--no-figures", *QUICK],
        stdout=subprocess.PIPE,
        stderr=writing,
        text=True,
        check=True,
    )
    os.close(writing)
    progress = os.read(reading, 100_000).decode()
    os.close(reading)
    assert "factorisation" in progress
    assert "factorisation" not in done.stdout
    assert done.stdout.startswith("2 basis shapes fitted to")
    assert load_model(tmp_path / "model.npz").verbose == 0


def test_package_runs_as_a_module(monkeypatch, capsys):
    monkeypatch.setattr(sys, "argv", ["isa_nrsfm", "--version"])
    with pytest.raises(SystemExit) as end:
        runpy.run_module("isa_nrsfm", run_name="__main__")
    assert end.value.code == 0
    assert capsys.readouterr().out == f"isa-nrsfm {__version__}\n"


def test_reader_that_goes_away_is_no_error(fitted, table, tmp_path, monkeypatch, capfd):
    reading, writing = os.pipe()
    os.close(reading)
    with os.fdopen(writing, "w") as stdout:
        monkeypatch.setattr(sys, "stdout", stdout)
        argv = ["transform", fitted / "model.npz", table, "-o", tmp_path / "a.csv"]
        assert main([str(word) for word in argv]) == 141
    assert capfd.readouterr() == ("", "")


@pytest.mark.subprocess
@pytest.mark.usefixtures("interruptible")
def test_signal_of_the_keyboard_stops_the_program(table, tmp_path):
    folder = tmp_path / "results"
    started = subprocess.Popen(
        [PROGRAM, "fit", str(table), "-o", str(folder), "--isa=fast", "--n-init=99999"],
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
    )
    deadline = time.monotonic() + 60
    while not folder.exists() and started.poll() is None:
        assert time.monotonic() < deadline
        time.sleep(0.05)
    time.sleep(0.5)
    started.send_signal(signal.SIGINT)
    out, err = started.communicate(timeout=60)
    assert (started.returncode, out) == (130, "")
    assert err.endswith("isa-nrsfm: interrupted\n")
    assert "Traceback" not in err
