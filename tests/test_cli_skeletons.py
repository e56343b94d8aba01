"""What joins the points in the results of commands: --edges and --skeleton."""

import base64

import numpy as np
import pandas as pd
import pytest
from exported_files import Read, content_of
from fit_runs import JOINT, Results, ran
from landmark_files import saved
from refusals import refusals_of

from isa_nrsfm import datasets, plotting
from isa_nrsfm.export import frame_poses
from isa_nrsfm.skeletons import get_skeleton

QUICK = "--n-components 1 --refinement none --isa fast --n-init 1".split()
UNDRAWN = [*QUICK, "--no-figures"]
NUMBERED = [f"j{j:02d}.{axis}" for j in range(17) for axis in "xy"]


def write(scene, path, names=None):
    """Write a scene as a table, whose points have numbers or names."""
    columns = names or scene.feature_names
    return saved(path, pd.DataFrame(scene.data.round(3), columns=columns))


def edges_of(path):
    """Return the edges of a page as a set of pairs, and the sides of its points."""
    content = content_of(path)
    pairs = np.frombuffer(base64.b64decode(content["edges"]), "<u4").reshape(-1, 2)
    return {tuple(pair) for pair in pairs.tolist()}, content["sides"]


def pairs_of(name):
    return {tuple(edge) for edge in get_skeleton(name).edges.tolist()}


@pytest.fixture(scope="module")
def bodies():
    return datasets.make_body_tracks(60, noise=0.002, random_state=0)


@pytest.fixture(scope="module")
def table(bodies, tmp_path_factory):
    return write(bodies, tmp_path_factory.mktemp("bodies") / "bodies.csv", NUMBERED)


@pytest.fixture(scope="module")
def bodies_fit(table, tmp_path_factory):
    """Return the results of a fit of bodies whose points are numbered."""
    folder = tmp_path_factory.mktemp("fit")
    assert ran("fit", table, "-o", folder, *UNDRAWN)[0] == 0
    return Results(folder)


def test_layouts_are_recognised_by_order_or_names(fits, bodies, bodies_fit, tmp_path):
    path = write(datasets.make_hand_tracks(24, random_state=0), tmp_path / "hands.csv")
    found = fits(path, *UNDRAWN)
    assert "(hand-21)" in found.out
    assert found.report["model"]["skeleton"] == "hand-21"
    assert edges_of(tmp_path / "viewer.html") == (pairs_of("hand-21"), [])
    # Bodies of 17 points are not guessed: 16 lines join them.
    viewer = bodies_fit.folder / "viewer.html"
    pairs, sides = edges_of(viewer)
    assert (len(pairs), sides) == (16, [])
    assert "joined by a minimal spanning tree" in content_of(viewer)["about"]
    assert bodies_fit.report["model"]["skeleton"] is None
    names = [f"{name}_{axis}" for name in bodies.point_names for axis in "xy"]
    fits(write(bodies, tmp_path / "bodies.csv", names), *UNDRAWN)
    expected = pairs_of("coco-17"), get_skeleton("coco-17").sides.tolist()
    assert edges_of(tmp_path / "viewer.html") == expected


def test_fit_takes_a_skeleton_for_all_that_it_draws(fits, table, tmp_path, monkeypatch):
    drawn = []

    def note(display, *_, **__):
        drawn.append(display.skeleton.name)
        raise ValueError("not drawn")

    for display in (plotting.BasisShapeDisplay, plotting.ReprojectionDisplay):
        monkeypatch.setattr(display, "plot", note)
    fits(table, "--skeleton", "coco-17", *QUICK)
    assert drawn == ["coco-17", "coco-17"]
    assert edges_of(tmp_path / "viewer.html")[0] == pairs_of("coco-17")


def test_edges_of_a_file(fits, succeeds, table, bodies_fit, tmp_path):
    own, config = tmp_path / "edges.csv", tmp_path / "config.yaml"
    own.write_text("5,7\n7,j09\n")  # numbers of points, or names
    advice = "--edges FILE or --skeleton LAYOUT"  # without any
    assert advice in bodies_fit.page
    assert advice not in fits(table, *UNDRAWN, "--edges", own).page
    assert edges_of(tmp_path / "viewer.html")[0] == {(5, 7), (7, 9)}

    def drawn(*options):
        export = ["export", bodies_fit.path, "-o", tmp_path / "a.html", "--force"]
        succeeds(*export, *options)
        return edges_of(tmp_path / "a.html")[0]

    assert drawn("--edges", "none") == set()
    assert drawn("--edges", own) == {(5, 7), (7, 9)}
    config.write_text("skeleton:\n- [j05, j07]\n- [j06, j08]\n")
    assert drawn("--skeleton", config) == {(5, 7), (6, 8)}
    export = ["export", bodies_fit.path, "-o", tmp_path / "a.glb"]
    succeeds(*export, "--skeleton", "coco-17")
    assert Read(tmp_path / "a.glb").mesh["extras"]["lines"] == "coco-17"


def test_transform_writes_a_page(fails, transforms, table, bodies_fit, tmp_path):
    page, skeleton = tmp_path / "new.html", ["--skeleton", "coco-17"]
    _, out, _ = transforms(bodies_fit.path, table, *skeleton, "--viewer", page)
    assert str(page) in out
    assert edges_of(page)[0] == pairs_of("coco-17")
    assert len(content_of(page)["rows"]) == 60
    output = ["-o", tmp_path / "a.csv"]
    message = fails("transform", bodies_fit.path, table, *output, *skeleton)
    assert "--edges, --skeleton and --origin need --viewer" in message


def test_where_y_is_zero_is_said(fits, transforms, succeeds, tmp_path):
    # Points without a known layout, which nothing else says to be upside down.
    options = {"camera": "weak_perspective", "random_state": 0}
    scene = datasets.make_nonrigid_tracks(24, 10, 1, **options)
    path = write(scene, tmp_path / "points.csv")
    options = ["-k", "1", "--std", *JOINT]
    lower = ["--origin", "lower", "--viewer", tmp_path / "new.html"]
    fit = fits(path, *options, *lower[:2])
    exported = {name: tmp_path / f"{name}.html" for name in ("upper", "lower")}
    for name, page in exported.items():
        succeeds("export", fit.path, "-o", page, "--origin", name)
    transforms(fit.path, path, *lower, "--std")
    pages = [tmp_path / "viewer.html", lower[-1], *exported.values()]
    fitted, new, upper, shapes = map(content_of, pages)
    assert fitted["shapes"] == shapes["shapes"] == new["shapes"]
    assert fitted["shapes"] != upper["shapes"]
    # Error bars are those that are asked for.
    assert fitted["deviations"] == new["deviations"] != ""
    assert upper["deviations"] == ""
    yaw = {name: frame_poses(fit.model, origin=name).yaw for name in exported}
    np.testing.assert_allclose(fit.cameras["yaw"], yaw["lower"], atol=1e-6)
    assert not np.allclose(fit.cameras["yaw"], yaw["upper"], atol=1)


@pytest.fixture(scope="module")
def faces(tmp_path_factory):
    scene = datasets.make_face_tracks(30, n_components=1, noise=0.01, random_state=0)
    return write(scene, tmp_path_factory.mktemp("faces") / "faces.csv")


def test_inner_points_are_fitted_and_drawn(fits, transforms, faces, tmp_path):
    found = fits(faces, "--points", "inner", *UNDRAWN)
    assert "30 frames of 51 points" in found.out
    assert "coordinates not used: --points inner (17)" in found.page
    assert "(ibug-51)" in found.out
    assert edges_of(tmp_path / "viewer.html")[0] == pairs_of("ibug-51")
    assert found.model.feature_names_in_.tolist()[:2] == ["x_17", "y_17"]
    assert found.alpha.columns.tolist() == ["row", "alpha_1"]
    # The table with all points has these points.
    page = tmp_path / "v.html"
    for columns in ([], ["--columns", "x_#,y_#"]):
        again, *_ = transforms(found.path, faces, *columns, "--viewer", page)
        np.testing.assert_allclose(again["alpha_1"], found.alpha["alpha_1"], atol=1e-9)
        assert edges_of(page)[0] == pairs_of("ibug-51")


def test_points_are_named(fits, faces, tmp_path):
    kept = [30, *range(36, 68)]
    found = fits(faces, "--points", "36-47, 30,48-67,30", *UNDRAWN)
    names = found.model.feature_names_in_
    assert names[::2].tolist() == [f"x_{j}" for j in kept]
    expected = get_skeleton("ibug-68").subset(kept).edges.tolist()
    assert edges_of(tmp_path / "viewer.html")[0] == {*map(tuple, expected)}


def written_bodies(folder, names=None):
    bodies = datasets.make_body_tracks(20, random_state=0)
    return write(bodies, folder / "bodies.csv", names)


test_refusals = refusals_of("cli_skeletons", globals())
