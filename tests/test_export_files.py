"""Exported files: glTF, arrays of shapes, and what is refused before any is written."""

import copy
from functools import partial

import numpy as np
import pandas as pd
import pytest
from export_models import (
    N_COMPONENTS,
    N_FRAMES,
    blob_model,
    calibrated_model,
    face_model,
    faces,
)
from exported_files import TYPES, Read, content_of, numbers
from numpy.testing import assert_allclose, assert_array_equal
from refusals import refused
from scipy.io import loadmat
from scipy.spatial import ConvexHull
from sklearn.decomposition import PCA
from sklearn.exceptions import NotFittedError

from isa_nrsfm import AffineNRSfM, FastISA
from isa_nrsfm.export import (
    ShapeArrays,
    frame_poses,
    point_distances,
    point_distribution_model,
    shape_arrays,
    write_glb,
    write_pdm,
    write_shapes,
    write_viewer,
)

pytestmark = pytest.mark.filterwarnings("ignore::sklearn.exceptions.ConvergenceWarning")


@pytest.fixture
def written(tmp_path):
    """Return a function that writes a model and reads the file."""

    def write(model, **options):
        path = tmp_path / "model.glb"
        write_glb(model, path, **options)
        return Read(path)

    return write


def normals_of(points, corners):
    """Return the sums of the normals of the triangles of each point, of length one."""
    a, b, c = points[corners].transpose(1, 0, 2)
    normals = np.zeros_like(points)
    for corner in corners.T:
        np.add.at(normals, corner, np.cross(b - a, c - a))
    return normals / np.linalg.norm(normals, axis=1, keepdims=True)


@pytest.mark.parametrize("make", [face_model, calibrated_model])
def test_weights_are_coefficients(written, make, tmp_path):
    model = make()
    read = written(model)
    surface = read.primitive(4)
    mean = read.array(surface["attributes"]["POSITION"])
    basis = [read.array(target["POSITION"]) for target in surface["targets"]]
    assert read.mesh["weights"] == [0.0] * N_COMPONENTS
    assert read.mesh["extras"]["factor"] > 0
    # The shapes of the page in a unit of its own: y up and z to the viewer.
    write_viewer(model, tmp_path / "a.html")
    expected = numbers(content_of(tmp_path / "a.html")["shapes"]).reshape(-1, 68, 3)
    expected = expected / np.ptp(expected[0], axis=0).max()
    assert_allclose([mean, *basis], expected, atol=1e-6)
    assert mean[8, 1] < mean[27, 1]
    assert mean[30, 2] > mean[0, 2]


def test_names_and_bounds_are_exact(written):
    names = ["jaw", "smile \u2013 wide", "brows"]
    assert written(face_model(), names=names).mesh["extras"]["targetNames"] == names
    read = written(face_model())
    extras = read.mesh["extras"]
    assert extras["targetNames"] == ["alpha_1", "alpha_2", "alpha_3"]
    assert extras["pointNames"] == [str(j) for j in range(68)]
    primitive = read.primitive(4)
    for part in (primitive["attributes"], *primitive["targets"]):
        accessor = read.document["accessors"][part["POSITION"]]
        points = read.array(part["POSITION"])
        assert_array_equal(accessor["min"], points.min(axis=0))
        assert_array_equal(accessor["max"], points.max(axis=0))


def test_the_surface_covers_the_front_view_with_normals_that_follow(written):
    read = written(face_model())
    surface = read.primitive(4)
    corners = read.array(surface["indices"]).reshape(-1, 3).astype(int)
    mean = read.array(surface["attributes"]["POSITION"]).astype(float)
    a, b, c = mean[corners, :2].transpose(1, 0, 2)
    areas = np.linalg.det(np.stack([b - a, c - a], axis=1)) / 2
    assert areas.min() > 0
    assert areas.sum() == pytest.approx(ConvexHull(mean[:, :2]).volume)
    normals = read.array(surface["attributes"]["NORMAL"])
    assert_allclose(normals, normals_of(mean, corners), atol=1e-4)
    for target in surface["targets"]:
        expected = normals_of(mean + read.array(target["POSITION"]), corners)
        assert_allclose(normals + read.array(target["NORMAL"]), expected, atol=1e-4)


def test_points_on_a_line_have_no_triangles(written):
    model = copy.copy(blob_model())
    model.mean_shape_ = np.outer(np.arange(20.0), [1, 1, 0])
    refused("on one line in the front view", written, model, camera=None)


def test_the_animation_swings_each_basis_shape_in_turn(written):
    read = written(face_model())
    (animation,) = read.document["animations"]
    (sampler,), (channel,) = animation["samplers"], animation["channels"]
    assert channel["target"] == {"node": 0, "path": "weights"}
    times = read.array(sampler["input"])
    accessor = read.document["accessors"][sampler["input"]]
    assert accessor["min"] == [0.0]
    assert accessor["max"] == [times[-1]]
    assert np.all(np.diff(times) > 0)
    weights = read.array(sampler["output"]).reshape(len(times), N_COMPONENTS)
    assert_array_equal(weights[[0, -1]], 0)
    assert np.all(np.count_nonzero(weights, axis=1) <= 1)
    assert_allclose(weights.max(axis=0), 2)
    assert_allclose(weights.min(axis=0), -2)
    firsts = np.argmax(weights != 0, axis=0)
    assert np.all(np.diff(firsts) > 0)


def test_edges_are_lines_triangles_surfaces_and_none_is_points(written):
    edges = [[0, 1], [1, 2], [5, 9]]
    read = written(face_model(), edges=edges)
    points, *lines = read.mesh["primitives"]
    assert [p["mode"] for p in (points, *lines)] == [0, 1, 1]
    drawn = [read.array(p["indices"]).reshape(-1, 2).tolist() for p in lines]
    # From side to side in the middle, and those of the right side of the face.
    assert drawn == [[[5, 9]], [[0, 1], [1, 2]]]
    names = [read.document["materials"][p["material"]]["name"] for p in lines]
    assert names == ["points and edges", "right"]
    alone = written(face_model(), edges=None).mesh["primitives"]
    assert [p["mode"] for p in alone] == [0]
    read = written(face_model(), edges=[[0, 36, 31], [2, 1, 0]])
    surface = read.primitive(4)
    assert read.array(surface["indices"]).tolist() == [0, 36, 31, 2, 1, 0]
    # Points without triangles look at the viewer.
    normals = read.array(surface["attributes"]["NORMAL"])
    assert_array_equal(normals[50:], np.tile([0.0, 0.0, 1.0], (18, 1)))


def test_indices_are_as_small_as_can_be(written, rng):
    model = AffineNRSfM(1, isa=FastISA(n_init=1), refinement=None, random_state=0)
    model.fit(rng.standard_normal((9, 2 * 65536)))
    for last, dtype in ((65534, "<u2"), (65535, "<u4")):
        read = written(model, edges=[[0, last]], camera=None)
        accessor = read.document["accessors"][read.primitive(1)["indices"]]
        assert TYPES[accessor["componentType"]] == dtype


QUICK = {"isa": FastISA(n_init=1), "refinement": None, "random_state": 0}


def test_arrays_are_the_attributes_of_the_model():
    model = face_model()
    arrays = shape_arrays(model)
    for name, array in arrays._asdict().items():
        if not name.endswith("names"):
            assert_array_equal(array, getattr(model, f"{name}_"))
    assert list(arrays.component_names) == ["alpha_1", "alpha_2", "alpha_3"]
    assert list(arrays.point_names[:3]) == ["0", "1", "2"]


@pytest.mark.parametrize("layout", ["interleaved", "planar"])
def test_points_are_named_as_the_columns(layout):
    names = [f"{axis}_p{j}" for j in range(68) for axis in "xy"]
    table = pd.DataFrame(faces().data, columns=names)
    if layout == "planar":
        table = table[names[::2] + names[1::2]]
    model = AffineNRSfM(1, layout=layout, **QUICK).fit(table)
    named = [str(name) for name in shape_arrays(model).point_names]
    assert named == [f"p{j}" for j in range(68)]


def test_columns_that_are_no_coordinates_name_points_in_full():
    table = pd.DataFrame(faces().data, columns=[f"column {i}" for i in range(136)])
    model = AffineNRSfM(1, **QUICK).fit(table)
    assert shape_arrays(model).point_names[1] == "column 2"


def test_models_without_frames_have_arrays_of_no_frames():
    model = AffineNRSfM(2, keep_frames=False, **QUICK).fit(faces().data[:40])
    arrays = shape_arrays(model)
    shapes = arrays.alpha.shape, arrays.motion.shape, arrays.translation.shape
    assert shapes == ((0, 2), (0, 2, 3), (0, 2))


@pytest.mark.parametrize("suffix", [".npz", ".mat"])
def test_files_have_all_arrays(tmp_path, suffix):
    path = tmp_path / f"shapes{suffix}"
    write_shapes(face_model(), str(path))
    expected = shape_arrays(face_model())._asdict()
    if suffix == ".npz":
        with np.load(path, allow_pickle=False) as arrays:
            read = dict(arrays)
    else:
        read = loadmat(path, squeeze_me=True, chars_as_strings=True)
        read = {name: read[name] for name in ShapeArrays._fields}
    assert set(read) == set(expected)
    for name, array in expected.items():
        assert_array_equal(read[name], array)


def test_names_are_cell_arrays_in_matlab(tmp_path):
    path = tmp_path / "shapes.mat"
    write_shapes(face_model(), path)
    names = loadmat(path)["component_names"]
    assert names.dtype == object
    assert names.shape == (N_COMPONENTS, 1)


distances = partial(point_distances, pairs=[(48, 54)])
POINTS, SHAPES = "must name points 0 to 67; got 0 to", r"\(n_pairs, 2\).*\(n_triangles"
CASES = [
    (write_glb, {"edges": [[0, 68]]}, f"{POINTS} 68"),
    (write_glb, {"edges": [[0, 1, 70]]}, f"{POINTS} 70"),
    (write_glb, {"edges": [[0, 1, 2, 3]]}, SHAPES),
    (write_glb, {"edges": [[0.5, 1, 2]]}, SHAPES),
    (write_glb, {"names": ["one"]}, "names must hold 3 names; got 1"),
    (write_glb, {"camera": "perspective"}, "camera must be"),
    (write_viewer, {"labels": ["a"]}, "labels must hold 150 labels, one per row; got"),
    (write_viewer, {"labels": range(N_FRAMES)}, "at most 30 different .* got 150"),
    (write_viewer, {"n_frames": -1}, "n_frames must be a whole number .*; got -1"),
    (write_viewer, {"n_frames": 2.5}, "n_frames must be a whole number .*; got 2.5"),
    (write_viewer, {"names": ["jaw"]}, "names must hold 3 names"),
    (write_viewer, {"edges": [[0, 99]]}, POINTS),
    (write_viewer, {"depth_std": np.ones(68)}, "depth_std needs a model with calibr"),
    (write_viewer, {"origin": "left"}, "origin must be"),
    (frame_poses, {"camera": None}, "angles need calibrated cameras"),
    (distances, {"camera": None}, "distances need calibrated cameras"),
    (distances, {"pairs": [(1, 99)]}, "no point 99; the 68 points"),
    (distances, {"pairs": [(1, 1)]}, "two different points"),
    (distances, {"length": 0.0}, "length must be a positive number; got 0"),
    *(
        (
            point_distribution_model,
            {"n_modes": each},
            "n_modes.* must be an int in the range",
        )
        for each in (0, -1, 1.0, 1.5, 0.0, np.nan, True, "all")
    ),
]


@pytest.mark.parametrize(("function", "options", "message"), CASES)
def test_bad_options(tmp_path, function, options, message):
    suffix = {write_glb: ".glb", write_viewer: ".html"}.get(function)
    path = [] if suffix is None else [tmp_path / f"model{suffix}"]
    refused(message, function, face_model(), *path, **options)
    assert not any(tmp_path.iterdir())


@pytest.mark.parametrize(
    ("depth_std", "message"),
    [
        (np.ones(67), r"depth_std must have shape \(150, 68\) or \(68,\); got \(67,\)"),
        (np.ones((149, 68)), r"must have shape .*; got \(149, 68\)"),
        (np.full(68, -0.5), "must not be negative; its least value is -0.5"),
        (np.full(68, np.inf), "depth_std contains infinity"),
        ("wide", "could not convert string to float"),
    ],
)
def test_bad_deviations(tmp_path, depth_std, message):
    with pytest.raises(ValueError, match=message):
        write_viewer(calibrated_model(), tmp_path / "a.html", depth_std=depth_std)
    assert not any(tmp_path.iterdir())


@pytest.mark.parametrize(
    ("write", "suffixes"),
    [
        (write_glb, ".glb"),
        (write_viewer, ".html or .htm"),
        (write_shapes, ".npz or .mat"),
        (write_pdm, ".txt or .mat or .npz"),
    ],
)
def test_other_suffixes(tmp_path, write, suffixes):
    model = face_model()
    if write is write_pdm:
        model = point_distribution_model(model)
    with pytest.raises(ValueError, match=f"path must end in {suffixes}; got .*a.csv"):
        write(model, tmp_path / "a.csv")


def test_models_that_have_no_frames_of_their_own():
    refused("model should be an AffineNRSfM; got PCA", frame_poses, PCA())
    refused(None, frame_poses, AffineNRSfM(), error=NotFittedError)
    with pytest.raises(ValueError, match='camera must be "weak_perspective" or None'):
        frame_poses(blob_model(), camera="orthographic")
    table = faces().data[:40]
    without = AffineNRSfM(1, refinement=None, random_state=0, keep_frames=False)
    refused("exporting shapes needs the cameras", frame_poses, without.fit(table))
