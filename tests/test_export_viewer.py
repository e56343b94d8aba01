import base64
import hashlib
import re

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
from exported_files import content_of, numbers
from numpy.testing import assert_allclose, assert_array_equal

from isa_nrsfm.export import write_viewer
from isa_nrsfm.skeletons import get_skeleton


def shapes_of(data):
    """Return the mean shape and the basis shapes of a page."""
    return numbers(data["shapes"]).reshape(1 + len(data["components"]), -1, 3)


@pytest.fixture
def written(tmp_path):
    """Return a function that writes a page and returns its data."""

    def write(model, **options):
        path = tmp_path / "viewer.html"
        write_viewer(model, path, **options)
        return content_of(path)

    return write


def test_a_page_is_one_file_that_asks_for_nothing(tmp_path):
    path = tmp_path / "viewer.html"
    write_viewer(face_model(), path)
    text = path.read_text(encoding="utf-8")
    assert "http" not in text.replace('http-equiv="Content-Security-Policy"', "")
    assert not re.search(r"\b(src|srcset|action)=|@import|url\(", text)
    script = re.search(r"<script>(.*?)</script>", text, re.DOTALL)[1]
    digest = base64.b64encode(hashlib.sha256(script.encode()).digest()).decode()
    assert f"script-src 'sha256-{digest}';" in text
    assert "default-src 'none';" in text
    assert "{{" not in text.replace(script, "")


def test_shapes_have_y_up_and_size_one(written):
    data = written(face_model())
    shapes = shapes_of(data)
    assert np.linalg.norm(shapes[0], axis=1).max() == pytest.approx(1)
    assert_allclose(shapes[0].mean(axis=0), 0, atol=1e-6)
    assert shapes[0, 8, 1] < shapes[0, 27, 1]
    assert shapes[0, 30, 2] > shapes[0, 0, 2]
    assert len(numbers(data["edges"], "<u4")) > 100
    assert data["points"] == [str(j) for j in range(68)]


def test_frames_are_those_of_the_fit(written):
    model = face_model()
    data = written(model)
    alpha = numbers(data["alpha"]).reshape(-1, N_COMPONENTS)
    assert_array_equal(alpha, model.alpha_.astype("f4"))
    assert data["rows"] == [str(i) for i in range(N_FRAMES)]
    assert data["count"] == f"{N_FRAMES} rows."
    assert data["labels"] == data["categories"] == []


@pytest.mark.parametrize(
    ("camera", "options"),
    [
        *((camera, {}) for camera in ("weak_perspective", "orthographic")),
        ("affine", {}),
        ("affine", {"mirrored": True}),
        ("affine", {"origin": "lower"}),
        ("orthographic", {"origin": "lower", "mirrored": True}),
    ],
)
def test_rotations_show_the_shapes_as_the_images_do(written, camera, options):
    truth, model = faces(noise=0.0), face_model(noise=0.0)
    if camera != "affine":
        truth, model = faces(camera=camera), calibrated_model(camera)
    data = written(model, **options)
    told = "weak_perspective" if camera == "affine" else camera
    assert f"{told.replace('_', '-')} cameras" in data["about"]
    shapes = shapes_of(data).astype(float)
    alpha = numbers(data["alpha"]).reshape(-1, N_COMPONENTS)
    rotations = numbers(data["rotations"]).reshape(-1, 3, 3)
    assert_allclose(np.linalg.det(rotations), 1.0, atol=1e-5)
    frames = shapes[0] + np.tensordot(alpha, shapes[1:], 1)
    seen = (frames @ rotations.transpose(0, 2, 1))[:, :, :2] * [1, -1]
    # The page turns the images of y that points up.
    images = truth.clean * [1, -1 if "origin" in options else 1]
    images = images - images.mean(axis=1, keepdims=True)
    seen = seen - seen.mean(axis=1, keepdims=True)
    scale = np.sum(seen * images, axis=(1, 2)) / np.sum(seen**2, axis=(1, 2))
    error = images - scale[:, None, None] * seen
    assert np.sum(error**2) < 1e-3 * np.sum(images**2)


@pytest.mark.parametrize(
    ("options", "signs"),
    [({"mirrored": True}, [1, 1, -1]), ({"origin": "lower"}, [1, -1, -1])],
)
def test_mirror_images_and_origins_change_signs(written, options, signs):
    shapes, other = shapes_of(written(blob_model())), written(blob_model(), **options)
    assert_allclose(shapes_of(other), shapes * signs, atol=1e-6)


@pytest.mark.parametrize("camera", ["affine", "weak_perspective", "orthographic"])
def test_basis_shapes_are_those_of_the_frames(written, camera):
    # The model's, or the least squares fit to Euclidean shapes of affine cameras.
    model = face_model() if camera == "affine" else calibrated_model(camera)
    shapes = model.mean_shape_[None], model.basis_
    if camera == "affine":
        frames = model.reconstruct(faces().data, camera="weak_perspective")
        weights = np.insert(model.alpha_, 0, 1.0, axis=1)
        best = np.linalg.lstsq(weights, frames.reshape(len(frames), -1))[0]
        shapes = np.split(best.reshape(-1, 68, 3), [1])
    rows = np.concatenate([shapes[0] - shapes[0].mean(axis=1), shapes[1]])
    drawn = shapes_of(written(model))
    inner, expected = (np.tensordot(each, each, [2, 2]) for each in (drawn, rows))
    unit = np.linalg.norm(expected) / np.linalg.norm(inner)
    assert_allclose(unit * inner, expected, atol=1e-4 * expected.max())


def test_deviations_have_the_size_of_the_shapes(written):
    model, X = calibrated_model("orthographic"), faces(camera="orthographic").data
    shapes, std = model.reconstruct(X, return_std=True)
    data = written(model, X=X, depth_std=std, n_frames=4)
    found = numbers(data["deviations"]).reshape(4, 68)
    size = np.linalg.norm(shapes[0, 0] - shapes[0, 16])
    alpha = numbers(data["alpha"]).reshape(4, -1)[0]
    mean, *basis = shapes_of(data)
    drawn = mean + np.tensordot(alpha, basis, 1)
    unit = np.linalg.norm(drawn[0] - drawn[16]) / size
    assert_allclose(found, unit * std[[0, 49, 99, 149]], rtol=1e-4)
    assert written(model)["deviations"] == ""


def test_deviations_of_points_are_those_of_all_frames(written):
    model, deviations = calibrated_model(), np.linspace(0.0, 1.0, 68)
    deviations[3] = np.nan
    data = written(model, depth_std=deviations)
    found = numbers(data["deviations"]).reshape(N_FRAMES, 68)
    assert_allclose(found, np.tile(deviations * found[0, -1], (N_FRAMES, 1)), rtol=1e-5)
    assert np.isnan(found[:, 3]).all()


def test_few_frames_are_spread_over_the_rows(written):
    data = written(face_model(), n_frames=4)
    assert data["rows"] == ["0", "49", "99", "149"]
    assert data["count"] == f"4 of {N_FRAMES} rows, evenly spread."
    assert written(face_model(), n_frames=0)["rows"] == []


def test_other_tables_are_shown_by_their_index(written):
    model = face_model()
    table = pd.DataFrame(faces().data[:6].copy(), index=list("abcdef"))
    table.iloc[2] = np.nan
    data = written(model, X=table.to_numpy(), n_frames=5)
    assert data["rows"] == ["0", "1", "3", "5"]
    count = "5 of 6 rows, evenly spread; 1 of them show too few points."
    assert data["count"] == count
    alpha = numbers(data["alpha"]).reshape(-1, N_COMPONENTS)
    assert_allclose(alpha, model.alpha_[[0, 1, 3, 5]], atol=1e-5)
    data = written(model, X=table, labels=list("uvwxyz"))
    assert data["rows"] == list("abdef")
    assert data["labels"] == [0, 1, 3, 4, 5]
    assert written(model, X=table, n_frames=0)["rows"] == []


def test_labels_are_sorted_numbers_first_and_none_last(written):
    model = blob_model()
    labels = np.array([10, 9.5, "b", None, "a", np.nan, 9.5, 10] * 5, dtype=object)
    data = written(model, labels=labels)
    assert data["categories"] == ["9.5", "10", "a", "b", "(no label)"]
    assert data["labels"][:8] == [1, 0, 3, 4, 2, 4, 0, 1]
    labels = pd.array(["b", None, "a", "b"] * 10, dtype="string")
    data = written(model, labels=labels)
    assert data["categories"] == ["a", "b", "(no label)"]
    assert data["labels"][:4] == [1, 2, 0, 1]


def test_affine_shapes_have_no_poses_and_say_so(written):
    data = written(face_model(), camera=None)
    assert data["rotations"] == ""
    assert data["about"].startswith("Affine shapes: angles and depth are not")


def test_the_sides_of_a_known_layout_are_told(written):
    data = written(face_model())
    assert data["sides"] == get_skeleton("ibug-68").sides.tolist()
    assert written(face_model(), edges=None)["sides"] == []
    data = written(blob_model(), edges=[[0, 1, 2], [2, 1, 3]])
    assert data["sides"] == []
    # The sides of triangles, once
    edges = numbers(data["edges"], "<u4").reshape(-1, 2).tolist()
    assert edges == [[0, 1], [0, 2], [1, 2], [1, 3], [2, 3]]


def test_times_are_seconds_that_rise(written):
    model = face_model()
    n_frames = len(model.alpha_)
    seconds = np.arange(n_frames) / 25 + 100
    seconds[n_frames // 2 :] -= seconds[n_frames // 2] - 3  # another video
    content = written(model, times=seconds, n_frames=n_frames)
    found = numbers(content["times"], "<f8")
    np.testing.assert_allclose(found, np.arange(n_frames) / 25, atol=1e-9)
    assert not len(numbers(written(model)["times"], "<f8"))
    few = numbers(written(model, times=seconds, n_frames=3)["times"], "<f8")
    np.testing.assert_allclose(few, found[[0, (n_frames - 1) // 2, -1]], atol=1e-9)
