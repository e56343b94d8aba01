"""What joins the points in the results of commands: --edges and --skeleton."""

import base64
import json

import numpy as np
import pandas as pd
import pytest
from exported_files import Read, content_of
from fit_runs import MODEL

from isa_nrsfm.cli import main
from isa_nrsfm.datasets import (
    make_body_tracks,
    make_face_tracks,
    make_hand_tracks,
    make_nonrigid_tracks,
)
from isa_nrsfm.export import frame_poses
from isa_nrsfm.io import load_model
from isa_nrsfm.skeletons import get_skeleton

QUICK = [*"--n-components 1 --refinement none --isa fast --n-init 2".split()]


def write(scene, path, names=None):
    """Write a scene as a table, whose points have numbers or names."""
    names = scene.feature_names if names is None else names
    pd.DataFrame(scene.data.round(3), columns=names).to_csv(path, index=False)
    return path


def edges_of(path):
    """Return the edges of a page as a set of pairs, and the sides of its points."""
    content = content_of(path)
    pairs = np.frombuffer(base64.b64decode(content["edges"]), "<u4").reshape(-1, 2)
    return {tuple(pair) for pair in pairs.tolist()}, content["sides"]


def pairs_of(name):
    return {tuple(edge) for edge in get_skeleton(name).edges.tolist()}


@pytest.fixture(scope="module")
def bodies():
    return make_body_tracks(120, noise=0.002, random_state=0)


@pytest.fixture(scope="module")
def table(bodies, tmp_path_factory):
    return write(bodies, tmp_path_factory.mktemp("bodies") / "bodies.csv")


@pytest.fixture(scope="module")
def folder(table, tmp_path_factory):
    """Return the folder of a fit of bodies without names."""
    folder = tmp_path_factory.mktemp("fit")
    assert main(["fit", str(table), "-o", str(folder), "--no-figures", *QUICK]) == 0
    return folder


def test_layouts_are_recognised_by_order_or_names(succeeds, bodies, folder, tmp_path):
    path = write(make_hand_tracks(120, random_state=0), tmp_path / "hands.csv")
    report, _ = succeeds("fit", path, "-o", tmp_path, *QUICK)
    assert "points recognised as hand-21" in report
    stored = json.loads((tmp_path / "report.json").read_text())["model"]["skeleton"]
    assert stored == "hand-21"
    assert edges_of(tmp_path / "viewer.html") == (pairs_of("hand-21"), [])
    # Bodies of 17 points are not guessed.
    assert edges_of(folder / "viewer.html") == (set(), [])
    assert json.loads((folder / "report.json").read_text())["model"]["skeleton"] is None
    names = [f"{name}_{axis}" for name in bodies.point_names for axis in "xy"]
    path = write(bodies, tmp_path / "bodies.csv", names)
    succeeds("fit", path, "-o", tmp_path, "--no-figures", *QUICK)
    sides = get_skeleton("coco-17").sides.tolist()
    assert edges_of(tmp_path / "viewer.html") == (pairs_of("coco-17"), sides)


def test_fit_takes_a_skeleton_for_all_that_it_draws(run, table, tmp_path, monkeypatch):
    drawn = []
    from isa_nrsfm import plotting

    for display in (plotting.BasisShapeDisplay, plotting.ReprojectionDisplay):
        plot = display.plot

        def noted(self, *args, plot=plot, **kw):
            drawn.append(self.skeleton.name)
            return plot(self, *args, **kw)

        monkeypatch.setattr(display, "plot", noted)
    options = ["-o", tmp_path, "--skeleton", "coco-17", *QUICK]
    assert run("fit", table, *options)[0] == 0
    assert drawn == ["coco-17", "coco-17"]
    assert edges_of(tmp_path / "viewer.html")[0] == pairs_of("coco-17")


def test_edges_of_a_file(succeeds, table, folder, tmp_path):
    own = tmp_path / "edges.csv"
    own.write_text("5,7\n7,9\n")
    fit = ["fit", table, "-o", tmp_path / "out", "--no-figures", *QUICK]
    # Without any, the report names the options.
    for options, is_noted in (
        ([], True),
        (["--edges", "none"], False),
        (["--edges", own], False),
    ):
        report, _ = succeeds(*fit, *options)
        assert ("--edges FILE or --skeleton LAYOUT" in report) == is_noted
    assert edges_of(tmp_path / "out/viewer.html")[0] == {(5, 7), (7, 9)}
    # Of triangles the sides are drawn, each once.
    own.write_text("0,1,2\n2,1,3\n")
    succeeds(*fit, "--edges", own)
    sides = {(0, 1), (1, 2), (0, 2), (1, 3), (2, 3)}
    assert edges_of(tmp_path / "out/viewer.html")[0] == sides
    config = tmp_path / "config.yaml"
    config.write_text("skeleton:\n- ['5', '7']\n- ['6', '8']\n")
    succeeds(*fit, "--skeleton", config)
    assert edges_of(tmp_path / "out/viewer.html")[0] == {(5, 7), (6, 8)}
    skeleton = ["--skeleton", "coco-17"]
    export = ["export", folder / MODEL, "-o", tmp_path / "a.glb"]
    succeeds(*export, *skeleton)
    materials = Read(tmp_path / "a.glb").document["materials"]
    assert [m["name"] for m in materials] == ["points and edges", "left", "right"]


def test_transform_writes_a_page(fails, succeeds, table, folder, tmp_path):
    page = tmp_path / "new.html"
    transform = ["transform", folder / MODEL, table]
    transform += ["-o", tmp_path / "alpha.csv", "--skeleton", "coco-17"]
    report, _ = succeeds(*transform, "--viewer", page)
    assert str(page) in report
    assert edges_of(page)[0] == pairs_of("coco-17")
    assert len(content_of(page)["rows"]) == 120
    assert "--edges, --skeleton and --origin need --viewer" in fails(*transform)


def test_where_y_is_zero_is_said(run, tmp_path):
    # Points without a known layout, which nothing else says to be upside down.
    scene = make_nonrigid_tracks(40, 12, 1, camera="weak_perspective", random_state=0)
    path = write(scene, tmp_path / "points.csv")
    fitted, new = tmp_path / "fit", tmp_path / "new.html"
    lower = ["--origin", "lower"]
    options = ["--camera", "weak_perspective", "-k", "1", "--no-figures", "--std"]
    assert run("fit", path, "-o", fitted, *options, *lower)[0] == 0
    model = fitted / MODEL
    exported = {name: tmp_path / f"{name}.html" for name in ("upper", "lower")}
    for name, page in exported.items():
        run("export", model, path, "-o", page, "--origin", name)
    transform = ["transform", model, path, "-o", tmp_path / "a.csv", "--viewer", new]
    run(*transform, *lower, "--std")
    shapes = content_of(fitted / "viewer.html")["shapes"]
    assert shapes == content_of(exported["lower"])["shapes"]
    assert shapes == content_of(new)["shapes"]
    assert shapes != content_of(exported["upper"])["shapes"]
    # Error bars are those that are asked for.
    bars = content_of(fitted / "viewer.html")["deviations"]
    assert bars
    assert bars == content_of(new)["deviations"]
    run(*transform, *lower)
    assert content_of(new)["deviations"] == ""
    cameras, estimator = pd.read_csv(fitted / "cameras.csv"), load_model(model)
    poses = {name: frame_poses(estimator, origin=name) for name in exported}
    np.testing.assert_allclose(cameras["yaw"], poses["lower"].yaw, atol=1e-6)
    assert not np.allclose(cameras["yaw"], poses["upper"].yaw, atol=1)


@pytest.mark.parametrize(
    ("options", "message"),
    [
        (["--skeleton", "hand-21"], "--skeleton hand-21 has 21 points, the table 17"),
        (["--edges", "absent.csv"], "absent.csv: No such file"),
        (["--skeleton", "absent.yaml"], "absent.yaml: No such file"),
    ],
)
def test_what_does_not_fit_is_refused_at_once(fails, table, tmp_path, options, message):
    assert message in fails("fit", table, "-o", tmp_path / "out", *options)
    assert not (tmp_path / "out").exists()


def test_edges_are_numbers_of_named_points(run, fails, bodies, tmp_path):
    names = [f"j{j:02d}.{axis}" for j in range(17) for axis in "xy"]
    table = write(bodies, tmp_path / "named.csv", names)
    edges, out = tmp_path / "edges.csv", tmp_path / "out"
    fit = ["fit", table, "-o", out, "--no-figures", *QUICK, "--edges", edges]
    edges.write_text("5,7\n7,17\n")
    assert "line 2: expected the names of two or three points" in run(*fit)[2]
    edges.write_text("5,7\n7,j09\n")
    # Of some of the points, numbers could be those of the table or of these points.
    message = "such as j05, j06 (without --points also their numbers from zero)"
    assert message in fails(*fit, "--points", "without:0-4")
    assert not out.exists()
    assert run(*fit)[0] == 0
    assert edges_of(out / "viewer.html")[0] == {(5, 7), (7, 9)}


@pytest.fixture(scope="module")
def faces(tmp_path_factory):
    scene = make_face_tracks(60, n_components=1, noise=0.01, random_state=0)
    return write(scene, tmp_path_factory.mktemp("faces") / "faces.csv")


@pytest.mark.parametrize("options", [[], ["--skeleton", "ibug-68"]])
def test_inner_points_are_fitted_and_drawn(succeeds, faces, tmp_path, options):
    inner = ["--points", "inner", *options, "--no-figures"]
    report, _ = succeeds("fit", faces, "-o", tmp_path, *inner, *QUICK)
    assert "60 frames of 51 points" in report
    assert "coordinates not used: --points inner (17)" in report
    assert "points recognised as ibug-51" in report
    assert edges_of(tmp_path / "viewer.html")[0] == pairs_of("ibug-51")
    names = load_model(tmp_path / MODEL).feature_names_in_
    assert names.tolist()[:2] == ["x_17", "y_17"]
    alpha = pd.read_csv(tmp_path / "alpha.csv")
    assert alpha.columns.tolist() == ["row", "alpha_1"]
    # The table with all points has these points.
    for columns in ([], ["--columns", "x_#,y_#"]):
        page = ["--viewer", tmp_path / "v.html"]
        report, _ = succeeds(
            "transform", tmp_path / MODEL, faces, "-o", tmp_path / "a.csv",
            *columns, *page,
        )  # fmt: skip
        found = pd.read_csv(tmp_path / "a.csv")["alpha_1"]
        np.testing.assert_allclose(found, alpha["alpha_1"], atol=1e-9)
        assert edges_of(tmp_path / "v.html")[0] == pairs_of("ibug-51")


@pytest.mark.parametrize(
    ("points", "kept"),
    [("without:0-16", range(17, 68)), ("36-47, 30,48-67,30", [30, *range(36, 68)])],
)
def test_points_are_named(run, faces, tmp_path, points, kept):
    fit = ["fit", faces, "-o", tmp_path, "--no-figures", "--points", points, *QUICK]
    assert run(*fit)[0] == 0
    names = load_model(tmp_path / MODEL).feature_names_in_
    assert names[::2].tolist() == [f"x_{j}" for j in kept]
    expected = get_skeleton("ibug-68").subset(kept).edges.tolist()
    found, _ = edges_of(tmp_path / "viewer.html")
    assert found == {tuple(edge) for edge in expected}


@pytest.mark.parametrize(
    ("given", "points", "message"),
    [
        ("table", "inner", "17 points are in no known layout: name the points"),
        ("table", "3-17", "there are no points '3-17'; the 17 points are 0, 1"),
        ("faces", "nose", "there are no points 'nose'"),
        ("faces", "9-3", "there are no points '9-3'"),
        ("faces", "0-3", "needs at least 7 points, the table has 4"),
    ],
)
def test_points_that_are_none(fails, request, given, tmp_path, points, message):
    options = ["-o", tmp_path / "o", "--points", points, *QUICK]
    assert message in fails("fit", request.getfixturevalue(given), *options)
