"""The command line, run in this process and as an installed program."""

import os
import re
import shutil
import sys
import warnings
from functools import cache

import numpy as np
import pandas as pd
import pytest
from exported_files import content_of
from fit_runs import FIGURES, FILES, JOINT, MODEL, Results, ran, told
from landmark_files import saved, saved_scene
from matplotlib.figure import Figure
from numpy.testing import assert_allclose, assert_array_equal
from refusals import refusals_of, refused

from isa_nrsfm import AffineNRSfM, FastISA, __version__
from isa_nrsfm.cli import main
from isa_nrsfm.datasets import make_face_tracks, make_nonrigid_tracks
from isa_nrsfm.io import save_model
from isa_nrsfm.plotting import ModeCovarianceDisplay

N_FRAMES = 60
QUICK = "--n-components 2 --isa fast --n-init 2".split()
UNREFINED = [*QUICK, "--no-figures", "--refinement", "none"]
FACES = {"n_components": 2, "camera": "weak_perspective", "random_state": 0}
LANDMARKS = [f"{axis}_{j}" for j in range(68) for axis in "xy"]
PNG = b"\x89PNG\r\n\x1a\n"
ALPHA = ["alpha_1", "alpha_2"]


@cache
def named_faces():
    """Return a table of faces with a name for each row."""
    bunch = make_face_tracks(N_FRAMES, n_components=2, random_state=0)
    frame = pd.DataFrame(bunch.data, columns=LANDMARKS)
    names = [f"{'ir' if i % 10 == 9 else 'i'}{i:03d}" for i in range(N_FRAMES)]
    frame.insert(0, "name", names)
    return frame.assign(code=[f"{i:04d}" for i in range(N_FRAMES)])


def assert_short(text):
    """Assert that the lines of a text fit on a terminal."""
    assert max(map(len, text.splitlines())) <= 120


@pytest.fixture
def faces():
    """Return a copy of the table of faces."""
    return named_faces().copy()


@pytest.fixture(scope="module")
def table(tmp_path_factory):
    """Return the path of the table as a csv file."""
    return saved(tmp_path_factory.mktemp("table") / "faces.csv", named_faces())


@pytest.fixture(scope="module")
def fitted(table, tmp_path_factory):
    """Return the results of a fit with figures."""
    folder = tmp_path_factory.mktemp("fit") / "new" / "results"
    options = [*QUICK, *JOINT[:-1], "--prior", "none"]
    code, out, err = ran("fit", table, "--output", folder, *options)
    assert code == 0, err
    return Results(folder, out, err)


def test_fit_writes_all_that_its_report_lists(fitted):
    report, listed = fitted.report, FILES | FIGURES
    assert fitted.err == ""
    assert {path.name for path in fitted.folder.iterdir()} == listed
    for name in FIGURES:
        assert (fitted.folder / name).read_bytes().startswith(PNG)
    assert fitted.out.startswith("2 movements in 60 frames of 68 points (ibug-68)\n")
    assert fitted.out.count("\n") <= 15
    assert_short(fitted.out)
    table = {"n_rows": N_FRAMES, "n_frames": N_FRAMES, "columns": "x_#,y_#"}
    assert table.items() <= report["table"].items()
    assert report["warnings"] == []
    assert report["versions"]["isa_nrsfm"] == __version__
    assert set(report["files"]) == listed - {"report.json"}
    shares = [row["energy_share"] for row in report["model"]["alpha"]]
    assert sum(shares) == pytest.approx(1)


def test_files_of_a_fit_are_those_of_its_model(fitted, faces):
    model, alpha, cameras = fitted.model, fitted.alpha, fitted.cameras
    X = faces[LANDMARKS]
    assert model.verbose == 0
    expected = faces[["name", "code"]].assign(alpha_1=0.0, alpha_2=0.0)
    expected.insert(0, "row", range(N_FRAMES))
    expected[ALPHA] = model.alpha_
    pd.testing.assert_frame_equal(alpha, expected, rtol=1e-12)

    numbers = "row m00 m01 m02 m10 m11 m12 tx ty inverse_snr yaw pitch roll scale "
    assert " ".join(cameras) == numbers + "yaw_std pitch_std roll_std"
    arrays = np.load(fitted.folder / "shapes.npz", allow_pickle=False)
    assert list(arrays["component_names"]) == ALPHA
    assert list(arrays["point_names"]) == [str(j) for j in range(68)]
    points = pd.read_csv(fitted.folder / "shapes.csv", index_col="point")
    assert list(map(str, points.index)) == list(arrays["point_names"])
    assert " ".join(points)[:40] == "mean_X mean_Y mean_Z basis_1_X basis_1_Y"
    expected = np.hstack([arrays["mean_shape"], *arrays["basis"]])
    assert_allclose(points, expected, rtol=1e-12)
    shapes = arrays["mean_shape"] + np.tensordot(alpha[ALPHA], arrays["basis"], 1)
    motion = cameras.iloc[:, 1:7].to_numpy().reshape(-1, 2, 3)
    images = shapes @ motion.swapaxes(1, 2) + cameras[["tx", "ty"]].to_numpy()[:, None]
    assert_allclose(images.reshape(len(X), -1), model.reproject(X), rtol=1e-9)

    report = fitted.report["model"]
    assert report["inverse_snr"] == pytest.approx(model.inverse_snr_)
    assert report["held_out_error"] == pytest.approx(-model.score(X))
    noise = np.sqrt(model.noise_variance_)
    assert f"noise in the fit {100 * noise:.3g} % of the frame's size" in fitted.page
    off = np.linalg.norm((images - X.to_numpy().reshape(images.shape)), axis=2)
    assert report["rms_point_error"] == pytest.approx(np.sqrt(np.mean(off**2)))
    pose = [row["pose_share"] for row in report["alpha"]]
    assert pose == pytest.approx(model.diagnostics(X).pose_share)
    # The rows of the largest error and the extreme coefficients are named.
    worst = int(np.sum(off**2, axis=1).argmax())
    assert report["largest_error"]["row"] == worst
    assert f", of row {worst} " in fitted.page
    for name, row in zip(ALPHA, report["alpha"], strict=True):
        for kind in ("min", "max"):
            assert alpha[name][row[f"row_of_{kind}"]] == pytest.approx(row[kind])


def test_options_reach_the_estimator(fails, table, tmp_path, monkeypatch):
    estimators = []

    def stop(model, *_args, **_keywords):
        estimators.append(model)
        raise ValueError("here the fit begins")

    monkeypatch.setattr(AffineNRSfM, "fit", stop)
    options = "-k 1 --isa fast --n-init 3 --block-recovery irls --loss huber "
    options += "--independence coefficients --no-scale-frames --no-hidden-points "
    options += "--random-state 7 --n-jobs 1 --camera affine --no-figures"
    fails("fit", table, "-o", tmp_path, *options.split())
    found, default = estimators[0].get_params(), AffineNRSfM().get_params()
    assert isinstance(found["isa"], FastISA)
    assert found["isa__n_init"] == 3
    isa = {name: found[name] for name in found if name.startswith("isa")}
    given = {"independence": "coefficients", "block_recovery": "irls", "loss": "huber"}
    given |= dict.fromkeys(["scale_frames", "hidden_points"], False)
    given |= {"n_components": 1, "random_state": 7, "n_jobs": 1, "camera": "affine"}
    # The progress is shown.
    assert found == default | isa | given | {"verbose": 2}


@pytest.mark.slow
def test_a_prior_of_another_table(fits, fails, transforms, tmp_path):
    prior, path = AffineNRSfM(**FACES), tmp_path / "prior.npz"
    save_model(prior.fit(make_face_tracks(40, **FACES).data), path)
    scene = make_face_tracks(30, **FACES | {"random_state": 1})
    table, X = saved_scene(tmp_path / "faces.csv", scene), scene.data
    found = fits(table, "--prior", path, *JOINT)
    model, alone = found.model, AffineNRSfM(**FACES, prior=prior)
    assert_array_equal(model.alpha_, alone.fit(X).alpha_)
    assert_array_equal(model.prior.basis_, prior.basis_)
    assert found.report["prior"] == {"name": str(path), "std": [*model.prior_std_]}
    width = f"{100 * model.prior_std_[0]:.2g} % of the size"
    assert f"prior {path}: the mean shape differs by {width}" in found.page
    assert "studies with the same prior can be compared" in found.page
    alpha, *_ = transforms(found.path, table)
    assert_allclose(alpha[ALPHA], model.alpha_, atol=1e-9)
    scene.data += np.random.default_rng(0).normal(size=X.shape[1]) * 0.02 * X.std()
    *_, err = transforms(found.path, saved_scene(tmp_path / "faces.csv", scene))
    assert "Adapt the model to X: AutoNRSfM(model, prior=model).fit(X)" in err
    for options, message in (
        ([found.path], f"{found.path} would be overwritten by the results"),
        ([path, "-k", 3], "n-components must be that of the prior, 2"),
        ([path, "-k", "1-2"], "--prior needs one number of basis shapes"),
    ):
        again = ["fit", table, "-o", tmp_path, "--no-figures", "--prior", *options]
        assert message in fails(*again)


def test_calibrated_cameras(fits, transforms, tmp_path):
    options = {"camera": "orthographic", "noise": 0.01, "random_state": 0}
    scene = make_nonrigid_tracks(20, 14, 1, **options)
    path = saved_scene(tmp_path / "points.csv", scene)
    options = "--camera orthographic -k auto --fps 25 --no-figures --remove-pose"
    found = fits(path, *options.split())
    model, report = found.model, found.report["model"]
    assert found.err == ""
    assert_short(found.out)
    assert (model.n_components, model.camera) == ("auto", "orthographic")
    expected = {"n_components": 1, "camera": "orthographic", "depth": "good"}
    expected |= {"camera_noise_ratio": pytest.approx(model.camera_noise_ratio_)}
    assert report | expected == report
    for text in (
        "orthographic cameras: ",
        "frames 0 to 19 by row: ",
        f"known to {100 * model.depth_uncertainty_:.2g} %;",
        f"noise in the fit {np.sqrt(model.noise_variance_):.3g} in the units",
        "--remove-pose: what yaw predicts was removed",
        report["camera_meaning"][1:],
    ):
        assert text in found.page
    alpha, *_ = transforms(found.path, path)
    assert_allclose(alpha["alpha_1"], model.alpha_[:, 0], atol=1e-4)

    # The images of cameras.csv and shapes.npz are scaled rotations of true shapes.
    M = found.cameras.filter(regex="^m[01][012]$").to_numpy().reshape(-1, 2, 3)
    scales = model.scales_[:, None, None] ** 2
    assert_allclose(M @ M.mT, scales * np.eye(2), atol=1e-6 * scales.max())
    about = content_of(tmp_path / "viewer.html")["about"]
    assert "orthographic cameras" in about


@pytest.mark.slow
def test_perspective_cameras(fits, fails, transforms, tmp_path):
    f, centre = 900.0, (640.0, 360.0)
    near = {"camera": "perspective", "focal_length": f, "distance": 300.0}
    faces = make_face_tracks(20, n_components=1, noise=0.002, **near, random_state=0)
    path = saved_scene(tmp_path / "faces.csv", faces)
    options = "--no-figures -k 1 --length 90 --camera perspective --std".split()
    options += ["--image-size", "1280x720", "--focal-length", f]
    found = fits(path, *options)
    model, cameras = found.model, found.cameras
    assert found.err == ""
    for text in (
        "focal length 900 (given), principal point (640, 360)",
        "positions in cameras.csv: points 36 and 45 of the mean shape are",
        "mirror image in depth: the one for which perspective fits",
    ):
        assert text in found.page
    # The images are those of shapes.npz in the cameras and positions of cameras.csv.
    S = np.tensordot(found.alpha["alpha_1"], model.basis_[0], 0)
    S += np.load(tmp_path / "shapes.npz")["mean_shape"]
    unit = found.report["position_unit"]
    size = np.linalg.norm(model.mean_shape_[36] - model.mean_shape_[45])
    assert unit["per_unit_of_shapes"] * size == pytest.approx(unit["length"]) == 90
    rows = cameras.filter(regex="^m[01][012]$").to_numpy().reshape(-1, 2, 3)
    rows /= cameras["scale"].to_numpy()[:, None, None]
    turns = np.concatenate([rows, np.cross(rows[:, :1], rows[:, 1:])], axis=1)
    places = cameras.filter(like="position_").to_numpy()
    X = S @ turns.mT + places[:, None] / unit["per_unit_of_shapes"]
    again = (f * X[..., :2] / X[..., 2:] + centre).reshape(20, -1)
    assert_allclose(again, model.reproject(pd.read_csv(path)), atol=1e-6)
    ratio = places[:, 2] / faces.positions[:, 2]
    assert_allclose(ratio, np.median(ratio), rtol=0.05)
    written, *_ = transforms(found.path, path, "--std")
    assert_allclose(written["alpha_1"], found.alpha["alpha_1"], atol=0.01)
    message = fails("export", found.path, "-o", tmp_path / "a.glb", "--mirrored")
    assert "decides between the two mirror images" in message


def test_outliers_are_reported(fits, tmp_path):
    scene = make_nonrigid_tracks(30, 24, 1, noise=0.01, random_state=0)
    for row in range(8, 16):
        scene.data[row, 2 * row] += 3.0
    names = np.where(np.arange(30) < 5, "skip", "keep")
    path = saved_scene(tmp_path / "faces.csv", scene, name=names)
    options = ["--skip-rows", "name=skip", "-k", 1, *JOINT, "--camera", "affine"]
    found = fits(path, *options)
    assert "warning: the table has outliers: " in found.err
    assert found.err.endswith("they bend the shapes. Correct them\n")
    outliers = found.report["model"]["outliers"]
    # The shapes bend to some of the eight. Rows are those of the table.
    largest = [(each["row"], int(each["point"])) for each in outliers["largest"]]
    assert 1 <= len(largest) == outliers["n_points"]
    assert {row for row, _ in largest} < {*range(8, 16)}


def test_rows_with_missing_points_are_fitted(fits, faces, tmp_path):
    faces.loc[[3, 9], ["x_5", "y_5"]] = 0.0  # 9 is an ir row
    faces.loc[[4, 11], ["x_7", "y_7"]] = np.nan
    faces.loc[12, "y_8"] = np.nan
    options = ["--skip-rows", "name=^ir", "--zeros-missing", *UNREFINED]
    found = fits(saved(tmp_path / "faces.csv", faces), *options)
    # The row is that of the table, however many are skipped before.
    assert found.err.count("\n") == 1
    assert "point 8 (x_8, y_8) in row 12" in found.err
    out, report = " ".join(found.out.split()), found.report
    assert "left out 6 rows: name matches '^ir'; points at (0, 0) count as" in out
    assert "4 points (0.109 %) are missing in 4 of the others" in out
    expected = {"n_missing_points": 4, "n_frames_with_missing_points": 4}
    assert expected.items() <= report["table"].items()
    X = faces.loc[~faces["name"].str.startswith("ir"), LANDMARKS].copy()
    X.loc[3, ["x_5", "y_5"]] = X.loc[12, ["x_8", "y_8"]] = np.nan
    again = AffineNRSfM(**found.model.get_params(deep=False)).fit(X)
    assert list(found.alpha["row"]) == list(X.index)
    assert_allclose(found.alpha[ALPHA], again.alpha_, atol=1e-9)
    error = np.sqrt(2 * np.nanmean((again.reproject(X) - X).to_numpy() ** 2))
    assert report["model"]["rms_point_error"] == pytest.approx(error)


def test_rows_that_cannot_be_fitted_are_empty(fits, transforms, faces, tmp_path):
    faces.loc[[4, 9], LANDMARKS] = np.nan  # 9 is an ir row
    faces.loc[5, LANDMARKS[6:]] = np.nan
    faces.loc[20, LANDMARKS] = 31.0
    faces.loc[21, LANDMARKS] = np.nan
    faces.loc[21, LANDMARKS[:12]] = np.repeat(np.arange(6.0), 2)
    faces = faces.drop(columns=LANDMARKS[28:])
    path, skipped = saved(tmp_path / "faces.csv", faces), ["--skip-rows", "name=^ir"]
    options = ["--skip-rows", "code = 1$|^nothing", "--std"]
    found = fits(path, *skipped, *options, *JOINT, *QUICK)
    assert found.err == ""
    left_out = found.report["table"]["rows_left_out"]
    assert {each["reason"]: each["first_rows"] for each in left_out} == {
        "name matches '^ir'": [9, 19, 29, 39, 49, 59],
        "all points missing": [4],
        "fewer than 4 points": [5],
        "all points in one place": [20],
        "points on one line, others missing": [21],
    }
    for each in left_out:
        assert f"{each['n_rows']} rows: {each['reason']}" in " ".join(found.out.split())
    kept = [i for i in range(N_FRAMES) if i % 10 != 9]
    for written in (found.alpha, found.cameras):
        assert list(written["row"]) == kept
        known = ~written["row"].isin([4, 5, 20, 21])
        assert (written.iloc[:, -4:].notna().T == known).all(axis=None)
    assert list(found.alpha["name"]) == list(faces["name"][kept])
    # transform leaves out the same rows, and gives the same numbers.
    again, out, _ = transforms(found.path, path, "--std", *skipped)
    assert "1 rows: points on one line, others missing" in " ".join(out.split())
    assert list(again) == list(found.alpha)
    numbers = (each.filter(like="alpha") for each in (again, found.alpha))
    assert_allclose(*numbers, atol=1e-7)
    std = again.filter(like="_std").dropna()
    assert_allclose(std, found.model.alpha_std_, rtol=1e-6)


def test_transform_gives_each_row_its_coefficients(transforms, fitted, faces, tmp_path):
    model, new = fitted.model, faces.iloc[::-1].reset_index(drop=True)
    new.loc[2, ["x_3", "y_3"]] = np.nan
    new["alpha_1"] = "mine"
    path = tmp_path / "new.parquet"
    new[[*LANDMARKS[1::2], "alpha_1", "name", *LANDMARKS[0::2]]].to_parquet(path)
    alpha, out, err = transforms(fitted.path, path, "--skip-rows", "name=^ir")
    assert "columns alpha_1: results of these names have an underscore" in err
    assert out.startswith("2 coefficients of 54 frames\n")
    assert "1 points (0.0272 %) are missing in 1 of the others\n" in out
    assert out.endswith("54 rows\n")
    assert list(alpha) == ["row", "alpha_1", "name", "alpha_1_", "alpha_2"]
    assert list(alpha["name"]) == [n for n in new["name"] if not n.startswith("ir")]
    assert list(new["name"][alpha["row"]]) == list(alpha["name"])
    X, found = new[LANDMARKS].iloc[alpha["row"]], alpha[["alpha_1_", "alpha_2"]]
    assert_allclose(found, model.transform(X), atol=1e-9)
    shown = float(re.search(r"([\d.e-]+) % of left-out", " ".join(out.split()))[1])
    assert shown == pytest.approx(-100 * model.score(X), rel=5e-3)
    complete = alpha["row"] != 2
    rows = N_FRAMES - 1 - alpha["row"][complete]
    assert_allclose(found[complete], model.alpha_[rows], atol=1e-9)


def test_transform_knows_missing_points(fits, transforms, faces, tmp_path):
    faces.loc[[3, 9], ["x_5", "y_5"]] = 0.0
    path = saved(tmp_path / "faces.csv", faces[:24])
    fit = fits(path, *UNREFINED, "--zeros-missing")
    assert fit.report["table"]["missing_values"] == [0]
    alpha, out, err = transforms(fit.path, path)
    assert err == ""
    assert "points at (0, 0) count as missing" in out
    (fit.folder / "report.json").unlink()
    other, out, err = transforms(fit.path, path)
    assert "count as missing" not in out
    # Without the report nothing but a warning is left.
    assert "--missing-value 0" in err
    assert not np.allclose(other["alpha_1"], alpha["alpha_1"])


def test_transform_of_no_usable_row_is_empty(succeeds, fitted, faces, tmp_path):
    path, output = tmp_path / "new.csv", tmp_path / "alpha.tsv"
    faces.assign(**dict.fromkeys(LANDMARKS, "")).to_csv(path, index=False)
    out, _ = succeeds("transform", fitted.path, path, "-o", output)
    assert "60 rows: all points missing" in out
    assert "no frame was fitted" in out
    assert pd.read_csv(output, sep="\t")["alpha_2"].isna().all()


def test_transform_has_the_layout_of_the_model(transforms, table, tmp_path):
    X = named_faces()[[*LANDMARKS[::2], *LANDMARKS[1::2]]]
    model = AffineNRSfM(2, layout="planar", refinement=None, random_state=0)
    save_model(model.fit(X.to_numpy()), tmp_path / MODEL)
    alpha, _, err = transforms(tmp_path / MODEL, table)
    assert err == ""
    assert_allclose(alpha[ALPHA], model.alpha_, atol=1e-9)


def test_a_figure_that_fails_costs_no_results(fits, fitted, table, monkeypatch):
    folder, seen = fitted.folder.with_name("again"), []
    shutil.copytree(fitted.folder, folder)

    def fail(*_args, **_keywords):
        seen.extend(path.name for path in folder.iterdir() if path.is_file())
        raise np.linalg.LinAlgError("no axes")

    monkeypatch.setattr(ModeCovarianceDisplay, "from_estimator", fail)
    monkeypatch.setattr(Figure, "savefig", lambda *_, **__: None)  # takes long
    found = fits(table, *QUICK, "--refinement", "none", folder=folder)
    warning, report = "mode_covariance.png was not drawn: no axes", found.report
    assert found.err == f"isa-nrsfm: warning: {warning}\n"
    # All results were there, and only they, when figures began.
    assert set(seen) == FILES
    left = FILES | FIGURES - {"mode_covariance.png"}
    assert {path.name for path in folder.iterdir()} == left
    assert set(report["files"]) == set(report["sha256"]) == left - {"report.json"}
    assert report["warnings"] == [warning]
    assert "mode_covariance" not in found.out
    assert warning in found.page


def test_missing_libraries_are_named_at_once(fails, table, tmp_path, monkeypatch):
    monkeypatch.setitem(sys.modules, "matplotlib", None)
    message = fails("fit", table, "-o", tmp_path / "results", *QUICK)
    assert 'pip install "isa-nrsfm[plot]"' in message
    assert not (tmp_path / "results").exists()


def test_version_and_help(capsys):
    for command in ("", "fit", "transform", "export", "demo"):
        argv = [*command.split(), "--help"]
        assert refused(None, main, argv, error=SystemExit).code == 0
        assert "example" in capsys.readouterr().out
    assert refused(None, main, ["--version"], error=SystemExit).code == 0
    assert capsys.readouterr().out == f"isa-nrsfm {__version__}\n"


def test_warnings_are_shown_once(fits, table, monkeypatch):
    fit = AffineNRSfM.fit

    def warn_and_fit(self, X, y=None, groups=None):
        for _ in range(2):
            warnings.warn("got a/camera=1.csv;\n  layout='x'", stacklevel=1)
        warnings.warn("for developers", DeprecationWarning, stacklevel=1)
        return fit(self, X, y)

    monkeypatch.setattr(AffineNRSfM, "fit", warn_and_fit)
    found = fits(table, *UNREFINED)
    text = "got a/camera=1.csv; layout='x'"
    assert found.err == f"isa-nrsfm: warning: {text}\n"
    assert found.report["warnings"] == [text]


@pytest.mark.slow
def test_demo_writes_a_table_and_finds_its_faces(succeeds, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    out, err = succeeds("demo", "--no-figures")
    assert "warning" not in err
    demo = Results(tmp_path / "isa-nrsfm-demo")
    assert {path.name for path in demo.folder.iterdir()} == FILES | {"tracks.csv"}
    assert "open     isa-nrsfm-demo/report.html" in out
    assert demo.report["model"]["n_components"] == 3
    error, of_mean = re.search(r"off by (\S+) % .* alone: (\S+) %", out).groups()
    assert float(error) < 0.3 * float(of_mean)
    assert list(pd.read_csv(demo.folder / "tracks.csv"))[:3] == ["frame", "x_0", "y_0"]
    assert re.search("isa-nrsfm fit .*tracks.csv", out)


def test_reader_that_goes_away_is_no_error(fitted, table, tmp_path, monkeypatch, capfd):
    reading, writing = os.pipe()
    os.close(reading)
    with os.fdopen(writing, "w") as stdout:
        monkeypatch.setattr(sys, "stdout", stdout)
        argv = ["transform", fitted.path, table, "-o", tmp_path / "a.csv"]
        assert main([str(word) for word in argv]) == 141
    assert capfd.readouterr() == ("", "")


def about_the_nose(folder, shift):
    """Write faces, shifted but for the nose, which is the origin, also (-0, -0)."""
    faces = named_faces()[LANDMARKS]
    faces -= np.tile(faces[["x_30", "y_30"]].to_numpy(), 68)
    faces.loc[1] *= -1
    return saved(folder / "faces.csv", faces + shift * (faces != 0))


def faces_in(folder, name="faces.csv", **columns):
    """Write a table of faces with some other columns, and return its path."""
    return saved(folder / name, named_faces().assign(**columns))


@cache
def simple_model(named):
    """Return a model of all points, or of the first twenty without names."""
    model = AffineNRSfM(1, refinement=None, random_state=0, isa=FastISA(n_init=1))
    X = named_faces()[LANDMARKS]
    return model.fit(X if named else X.to_numpy()[:, :40])


def model_in(folder, named=True):
    save_model(simple_model(named), folder / MODEL)
    return folder / MODEL


def transformed(folder, faces, *options, named=True):
    """Transform a table of other points than those of a model."""
    path = saved(folder / "new.csv", faces)
    told("transform", model_in(folder, named), path, "-o", folder / "a.csv", *options)


def kept(call, path, *argv):
    """Raise the message of a command, which leaves a file as it is."""
    before = path.read_bytes()
    try:
        call(*argv)
    finally:
        assert path.read_bytes() == before


test_refusals = refusals_of("cli", globals())
