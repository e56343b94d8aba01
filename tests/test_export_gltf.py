import numpy as np
import pytest
from export_models import N_COMPONENTS, calibrated_model, face_model
from exported_files import TYPES, Read
from numpy.testing import assert_allclose, assert_array_equal
from refusals import refused

from isa_nrsfm.export import _gltf, write_glb
from isa_nrsfm.export._drawing import (
    choose_drawing,
    edges_of,
    frontal_triangles,
    vertex_normals,
)
from isa_nrsfm.export._upright import upright_basis, upright_space


@pytest.fixture
def written(tmp_path):
    """Return a function that writes a model and reads the file."""

    def write(model, **options):
        path = tmp_path / "model.glb"
        write_glb(model, path, **options)
        return Read(path)

    return write


@pytest.mark.parametrize("make", [face_model, calibrated_model])
def test_weights_are_coefficients(written, make):
    model = make()
    read = written(model)
    surface = read.primitive(4)
    mean = read.array(surface["attributes"]["POSITION"]).astype(float)
    basis = [read.array(t["POSITION"]).astype(float) for t in surface["targets"]]
    assert len(basis) == N_COMPONENTS
    assert read.mesh["weights"] == [0.0] * N_COMPONENTS
    # y up and z to the viewer, in a unit of its own.
    space = upright_space(model, "weak_perspective", "auto", False)
    expected = upright_basis(space, model)
    factor = read.mesh["extras"]["factor"]
    turned = [factor * shape * [1, -1, -1] for shape in expected]
    assert_allclose(mean, turned[0] - turned[0].mean(axis=0), atol=1e-6)
    assert_allclose(basis, turned[1], atol=1e-6)
    assert np.ptp(mean, axis=0).max() == pytest.approx(1)
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


def test_normals_follow_the_morph_targets(written):
    read = written(face_model())
    surface = read.primitive(4)
    corners = read.array(surface["indices"]).reshape(-1, 3).astype(int)
    mean = read.array(surface["attributes"]["POSITION"]).astype(float)
    normals = read.array(surface["attributes"]["NORMAL"])
    assert_allclose(np.linalg.norm(normals, axis=1), 1, atol=1e-6)
    for target in surface["targets"]:
        moved = mean + read.array(target["POSITION"])
        expected = vertex_normals(moved, corners)
        assert_allclose(normals + read.array(target["NORMAL"]), expected, atol=1e-4)


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
    triangles = [[0, 36, 31], [2, 1, 0]]
    read = written(face_model(), edges=triangles)
    assert_array_equal(read.array(read.primitive(4)["indices"]), np.ravel(triangles))
    edges = edges_of(choose_drawing([[0, 1, 2], [2, 1, 3]], None, 4)[0])
    assert edges.tolist() == [[0, 1], [0, 2], [1, 2], [1, 3], [2, 3]]


@pytest.mark.parametrize(("n_points", "dtype"), [(65535, "<u2"), (65536, "<u4")])
def test_indices_are_as_small_as_can_be(n_points, dtype):
    file = _gltf.Binary()
    file.add(np.array([0, n_points - 1]))
    assert TYPES[file.accessors[0]["componentType"]] == dtype


def test_frontal_triangles_cover_the_front_view_and_face_the_viewer(rng):
    square = np.array([[0, 0, 0], [1, 0, 3], [0, 1, 5], [1, 1, 0.0]])
    shape = np.vstack([square, rng.random((30, 3))])
    corners = frontal_triangles(shape)
    a, b, c = shape[corners, :2].transpose(1, 0, 2)
    areas = np.linalg.det(np.stack([b - a, c - a], axis=1)) / 2
    assert areas.min() > 0
    assert areas.sum() == pytest.approx(1)


def test_points_on_a_line_have_no_triangles():
    shape = np.column_stack([np.arange(9.0), np.arange(9.0), np.arange(9.0) ** 2])
    refused("on one line in the front view", frontal_triangles, shape)


def test_normals_of_points_without_triangles_look_at_the_viewer():
    shape = np.array([[0, 0, 0], [1, 0, 0], [0, 1, 0], [5, 5, 5.0]])
    normals = vertex_normals(shape, np.array([[0, 2, 1]]))
    assert_allclose(normals, [[0, 0, -1], [0, 0, -1], [0, 0, -1], [0, 0, 1]])
