import copy

import numpy as np
import pytest
from export_models import N_COMPONENTS, blob_model, calibrated_model, face_model
from exported_files import TYPES, Read, content_of, numbers
from numpy.testing import assert_allclose, assert_array_equal
from refusals import refused
from scipy.spatial import ConvexHull

from isa_nrsfm import AffineNRSfM, FastISA
from isa_nrsfm.export import write_glb, write_viewer


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
