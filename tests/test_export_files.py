"""Exported files and poses: glTF, shapes and their distribution, pages, angles."""

import base64
import copy
import hashlib
import re
from functools import partial

import numpy as np
import pandas as pd
import pytest
from export_models import (
    N_COMPONENTS,
    N_FRAMES,
    aligned,
    blob_model,
    calibrated_model,
    face_model,
    faces,
)
from exported_files import Read, content_of, numbers
from layers import may_not_converge, slow_after
from numpy.testing import assert_allclose, assert_array_equal, assert_equal
from refusals import refusals_of, refused, warned
from scipy.io import loadmat
from scipy.spatial import ConvexHull
from scipy.spatial.transform import Rotation

from isa_nrsfm import AffineNRSfM, FastISA
from isa_nrsfm.datasets import make_nonrigid_tracks
from isa_nrsfm.export import (
    PointDistributionModel,
    ShapeArrays,
    frame_poses,
    point_distances,
    point_distribution_model,
    read_pdm,
    shape_arrays,
    write_glb,
    write_pdm,
    write_shapes,
    write_viewer,
)
from isa_nrsfm.skeletons import get_skeleton  # noqa: F401  in refusals.txt

pytestmark = may_not_converge


def shapes_of(data):
    """Return the mean shape and the basis shapes of a page."""
    return numbers(data["shapes"]).reshape(1 + len(data["components"]), -1, 3)


def alpha_of(data):
    """Return the coefficients of the frames of a page."""
    return numbers(data["alpha"]).reshape(-1, N_COMPONENTS)


def page_of(folder, model, **options):
    """Return the data on a page."""
    write_viewer(model, folder / "viewer.html", **options)
    return content_of(folder / "viewer.html")


@pytest.fixture
def page(tmp_path):
    """Return a function that writes a page and returns its data."""
    return partial(page_of, tmp_path)


@pytest.fixture
def scene(tmp_path):
    """Return a function that writes a model as a scene, and reads the file."""

    def write(model, **options):
        write_glb(model, tmp_path / "model.glb", **options)
        return Read(tmp_path / "model.glb")

    return write


JAW = ["jaw", "smile \u2013 wide", "brows"]


@pytest.mark.parametrize(
    ("make", "names"), [(face_model, None), (calibrated_model, JAW)]
)
def test_shapes_have_y_up_in_scenes_and_on_pages(scene, page, make, names):
    data, read = page(make()), scene(make(), names=names)
    shapes = shapes_of(data)
    assert np.linalg.norm(shapes[0], axis=1).max() == pytest.approx(1)
    assert_allclose(shapes[0].mean(axis=0), 0, atol=1e-6)
    assert shapes[0, 8, 1] < shapes[0, 27, 1]
    assert shapes[0, 30, 2] > shapes[0, 0, 2]
    assert len(numbers(data["edges"], "<u4")) > 100
    # In a scene they have a unit of its own, and their weights are coefficients.
    primitive = read.primitive(4)
    parts = [primitive["attributes"], *primitive["targets"]]
    found = np.array([read.array(part["POSITION"]) for part in parts])
    assert_allclose(found, shapes / np.ptp(shapes[0], axis=0).max(), atol=1e-6)
    for part in parts:
        assert {"min", "max"} <= {*read.document["accessors"][part["POSITION"]]}
    assert read.mesh["weights"] == [0.0] * N_COMPONENTS
    extras = read.mesh["extras"]
    assert extras["factor"] > 0
    assert extras["targetNames"] == (names or ["alpha_1", "alpha_2", "alpha_3"])
    assert extras["pointNames"] == data["points"] == [str(j) for j in range(68)]
    assert extras["lines"] == "ibug-68"


def test_the_surface_covers_the_front_view(scene):
    read = scene(face_model())
    surface = read.primitive(4)
    corners = read.array(surface["indices"]).reshape(-1, 3).astype(int)
    mean = read.array(surface["attributes"]["POSITION"]).astype(float)
    a, b, c = mean[corners, :2].transpose(1, 0, 2)
    areas = np.abs(np.linalg.det(np.stack([b - a, c - a], axis=1))) / 2
    assert areas.sum() == pytest.approx(ConvexHull(mean[:, :2]).volume)
    model = copy.copy(blob_model())
    model.mean_shape_ = np.outer(np.arange(20.0), [1, 1, 0])
    refused("on one line in the front view", scene, model, camera=None)


def test_the_animation_swings_each_basis_shape_in_turn(scene):
    read = scene(face_model())
    (animation,) = read.document["animations"]
    (sampler,), (channel,) = animation["samplers"], animation["channels"]
    assert channel["target"] == {"node": 0, "path": "weights"}
    times = read.array(sampler["input"])
    assert {"min", "max"} <= {*read.document["accessors"][sampler["input"]]}
    assert times[0] == 0 < np.diff(times).min()
    weights = read.array(sampler["output"]).reshape(len(times), N_COMPONENTS)
    assert_array_equal(weights[[0, -1]], 0)
    assert np.all(np.count_nonzero(weights, axis=1) <= 1)
    assert_allclose(weights.max(axis=0), 2)
    assert_allclose(weights.min(axis=0), -2)
    firsts = np.argmax(weights != 0, axis=0)
    assert np.all(np.diff(firsts) > 0)


QUICK = {"isa": FastISA(n_init=1), "refinement": None, "random_state": 0}


def arrays_of(columns=None, n_components=1, **options):
    """Return the arrays of a model of faces with names of columns."""
    table = pd.DataFrame(faces().data, columns=columns)
    if options.get("layout") == "planar":
        table = table[[*table][::2] + [*table][1::2]]
    return shape_arrays(AffineNRSfM(n_components, **QUICK, **options).fit(table))


@pytest.mark.parametrize("suffix", [".npz", ".mat"])
def test_files_have_the_attributes_of_the_model(tmp_path, suffix):
    path, model = tmp_path / f"shapes{suffix}", face_model()
    write_shapes(model, str(path))
    if suffix == ".npz":
        with np.load(path, allow_pickle=False) as arrays:
            read = dict(arrays)
    else:
        names = loadmat(path)["component_names"]  # a cell array
        assert (names.dtype, names.shape) == (object, (N_COMPONENTS, 1))
        read = loadmat(path, squeeze_me=True, chars_as_strings=True)
        read = {name: read[name] for name in ShapeArrays._fields}
    assert list(read.pop("component_names")) == ["alpha_1", "alpha_2", "alpha_3"]
    assert list(read.pop("point_names")) == [str(j) for j in range(68)]
    assert set(read) == set(ShapeArrays._fields[:-2])
    for name, array in read.items():
        assert_array_equal(array, getattr(model, f"{name}_"))


# --- pages ---------------------------------------------------------------------------


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


@pytest.mark.parametrize(
    ("camera", "options"), [("affine", {}), ("weak_perspective", {"origin": "lower"})]
)
def test_rotations_show_the_shapes_as_the_images_do(page, camera, options):
    truth, model = faces(), face_model() if camera == "affine" else calibrated_model()
    data = page(model, **options)
    assert "weak-perspective cameras" in data["about"]
    shapes = shapes_of(data).astype(float)
    rotations = numbers(data["rotations"]).reshape(-1, 3, 3)
    assert_allclose(np.linalg.det(rotations), 1.0, atol=1e-5)
    frames = shapes[0] + np.tensordot(alpha_of(data), shapes[1:], 1)
    seen = (frames @ rotations.mT)[:, :, :2] * [1, -1]
    # The page turns the images of y that points up.
    images = truth.clean * [1, -1 if "origin" in options else 1]
    images = images - images.mean(axis=1, keepdims=True)
    seen = seen - seen.mean(axis=1, keepdims=True)
    scale = np.sum(seen * images, axis=(1, 2)) / np.sum(seen**2, axis=(1, 2))
    error = images - scale[:, None, None] * seen
    assert np.sum(error**2) < 1.5e-5 * np.sum(images**2)


def test_mirror_images_and_origins_change_signs(page):
    shapes = shapes_of(page(blob_model()))
    mirrored, lower = page(blob_model().mirrored()), page(blob_model(), origin="lower")
    assert_allclose(shapes_of(mirrored), shapes * [1, 1, -1], atol=1e-6)
    assert_allclose(shapes_of(lower), shapes * [1, -1, -1], atol=1e-6)


def test_deviations_have_the_size_of_the_shapes(page):
    model, X = calibrated_model(), faces().data
    shapes, std = model.reconstruct(X, return_std=True)
    data = page(model, X=X, depth_std=std, n_frames=4)
    found = numbers(data["deviations"]).reshape(4, 68)
    size = np.linalg.norm(shapes[0, 0] - shapes[0, 16])
    mean, *basis = shapes_of(data)
    drawn = mean + np.tensordot(alpha_of(data)[0], basis, 1)
    unit = np.linalg.norm(drawn[0] - drawn[16]) / size
    assert_allclose(found, unit * std[[0, 19, 39, 59]], rtol=1e-4)
    assert page(model)["deviations"] == ""
    # One for each point counts for all frames.
    alike = np.insert(np.linspace(0.0, 1.0, 67), 3, np.nan)
    found = numbers(page(model, depth_std=alike, n_frames=9)["deviations"])
    assert_allclose(found, np.tile(unit * alike, 9), rtol=1e-5)


def test_frames_are_those_of_the_fit_or_of_another_table(page):
    model = face_model()
    data = page(model)
    assert_array_equal(alpha_of(data), model.alpha_.astype("f4"))
    assert data["rows"] == [str(i) for i in range(N_FRAMES)]
    assert data["count"] == f"{N_FRAMES} rows."
    assert data["labels"] == data["categories"] == []
    table = pd.DataFrame(faces().data[:6].copy(), index=list("abcdef"))
    table.iloc[2] = np.nan
    data = page(model, X=table.to_numpy(), n_frames=5)
    assert data["rows"] == ["0", "1", "3", "5"]
    count = "5 of 6 rows, evenly spread; 1 of them show too few points."
    assert data["count"] == count
    assert_allclose(alpha_of(data), model.alpha_[[0, 1, 3, 5]], atol=1e-5)
    data = page(model, X=table, labels=list("uvwxyz"))
    assert data["rows"] == list("abdef")
    assert data["labels"] == [0, 1, 3, 4, 5]
    assert page(model, X=table, n_frames=0)["rows"] == []


MIXED = np.array([10, 9.5, "b", None, "a", np.nan, 9.5, 10] * 5, dtype=object)


def test_times_are_seconds_that_rise(page):
    model, half = face_model(), N_FRAMES // 2
    seconds = np.arange(N_FRAMES) / 25 + 100
    seconds[half:] -= seconds[half] - 3  # another video
    found, few, none = (
        numbers(page(model, times=times, n_frames=n_frames)["times"], "<f8")
        for times, n_frames in ((seconds, N_FRAMES), (seconds, 3), (None, 3))
    )
    assert_allclose(found, np.arange(N_FRAMES) / 25, atol=1e-9)
    assert_allclose(few, found[[0, half - 1, -1]], atol=1e-9)
    assert not len(none)


# --- angles and distances ------------------------------------------------------------

EYES, MOUTH = (36, 45), (48, 54)


@pytest.fixture(scope="module", params=["weak_perspective", "affine"])
def fitted(request):
    """Return faces with their true rotations, and a model of them."""
    return faces(), face_model() if request.param == "affine" else calibrated_model()


def rotations_of(poses):
    """Return rotations from angles, by their definition."""
    angles = np.stack([poses.roll, -poses.pitch, -poses.yaw], axis=1)
    return Rotation.from_euler("ZXY", angles, degrees=True)


def test_poses_are_true_up_to_a_common_rotation(fitted):
    truth, model = fitted
    found = rotations_of(frame_poses(model, truth.data))
    true = Rotation.from_euler("yxz", truth.angles, degrees=True)
    common = (found.inv() * true).mean()
    off = np.degrees((found * common * true.inv()).magnitude())
    assert np.median(off) < 2
    # Upright and frontal, as the makers of the faces have it
    assert np.degrees(common.magnitude()) < 5


def test_deviations_of_poses_are_those_of_the_errors():
    assert np.isnan(frame_poses(face_model(), faces().data[:5]).yaw_std).all()
    model = calibrated_model()
    # Frames of the model itself, with its noise
    clean = model.inverse_transform(model.alpha_, model.motion_, model.translation_)
    clean = clean.reshape(N_FRAMES, 68, 2)
    sizes = (clean - clean.mean(axis=1, keepdims=True)).std(axis=(1, 2))
    noise = np.sqrt(model.noise_variance_) * sizes[:, None, None]
    noisy = clean + noise * np.random.default_rng(0).normal(size=clean.shape)
    wanted = frame_poses(model)
    found = frame_poses(model, noisy.reshape(N_FRAMES, -1))
    for name in ("yaw", "pitch", "roll"):
        off = getattr(found, name) - getattr(wanted, name)
        ratio = np.sqrt(np.mean((off / getattr(found, f"{name}_std")) ** 2))
        # Deviations contain the uncertainty of the shapes, which is none here.
        assert ratio < 1.25


def test_frames_that_are_fitted_have_the_poses_and_distances_of_their_table(fitted):
    truth, model = fitted
    X = truth.data[:20]
    frames, expected = model.decompose(X), frame_poses(model, X)[:4]
    again, poses = frame_poses(model, frames), frame_poses(model)
    assert_array_equal(again[:4], expected)
    assert_allclose([part[:20] for part in poses[:4]], expected, atol=1e-4)
    assert np.isnan([*again.yaw_std, *poses.yaw_std]).all()
    again, expected = (point_distances(model, [MOUTH], part) for part in (frames, X))
    assert_array_equal(again, expected)


def test_distances_are_true_in_units_of_the_eyes_or_others(fitted):
    truth, model = fitted
    found = point_distances(model, [MOUTH, EYES])
    mouth, eyes = found.T
    true = np.linalg.norm(truth.shapes[:, 48] - truth.shapes[:, 54], axis=1)
    mean = truth.shapes.mean(axis=0)
    true /= np.linalg.norm(mean[36] - mean[45])
    assert np.corrcoef(mouth, true)[0, 1] > 0.98
    assert_allclose(mouth.mean(), true.mean(), rtol=0.03)
    assert eyes.mean() == pytest.approx(1.0, abs=0.01)
    assert_allclose(point_distances(model, [MOUTH, EYES], truth.data), found, atol=2e-3)
    other = point_distances(model, [MOUTH], unit=MOUTH, length=50.0)[:, 0]
    assert_allclose(other / mouth, other[0] / mouth[0])
    assert other.mean() == pytest.approx(50.0, rel=0.01)


# --- point distribution models -------------------------------------------------------


def on_tangent_space(shapes, mean):
    """Return shapes aligned to a mean, their differences from it orthogonal to it."""
    shapes = aligned(shapes, mean)
    scales = np.sum(mean**2) / np.sum(shapes * mean, axis=(1, 2))
    return scales[:, None, None] * shapes


def share_left(pdm, shapes):
    """Return the share of the variance of shapes that their principal axes leave."""
    drift = (on_tangent_space(shapes, pdm.mean) - pdm.mean).reshape(len(shapes), -1)
    modes = pdm.modes.reshape(len(pdm.modes), -1)
    assert_allclose(modes @ modes.T, np.eye(len(modes)), atol=1e-12)
    assert all(mode[np.abs(mode).argmax()] > 0 for mode in modes)
    assert_allclose(pdm.mean.mean(axis=0), 0, atol=1e-9)
    # The variances of the scores are the eigenvalues.
    scores = drift @ modes.T
    assert_allclose(np.mean(scores**2, axis=0), pdm.eigenvalues, rtol=1e-6)
    values = np.linalg.svd(drift, compute_uv=False)[: len(modes)]
    assert_allclose(values**2 / len(drift), pdm.eigenvalues, rtol=1e-6)
    assert_allclose(np.mean(scores, axis=0), 0, atol=1e-6)
    return np.sum((drift - scores @ modes) ** 2) / np.sum(drift**2)


def read_as_openface_does(path):
    """Read a text as PDM::Read of OpenFace: after comments, sizes, type and numbers."""
    lines = path.read_text().splitlines()
    words = iter(" ".join(line for line in lines if not line.startswith("#")).split())
    matrices = []
    for _ in range(3):
        n_rows, n_columns, kind = (int(next(words)) for _ in range(3))
        assert kind == 6  # CV_64FC1, doubles
        numbers = [float(next(words)) for _ in range(n_rows * n_columns)]
        matrices.append(np.reshape(numbers, (n_rows, n_columns)))
    assert not [*words]
    return matrices


@pytest.fixture(scope="module")
def pdm():
    return point_distribution_model(face_model())


def test_euclidean_shapes_of_the_frames_are_reproduced(pdm):
    assert len(pdm.modes) == N_COMPONENTS
    assert_true_mean(pdm, faces())
    shapes = face_model().reconstruct(faces().data, camera="weak_perspective")
    assert share_left(pdm, shapes) < 0.03
    whole = point_distribution_model(face_model(), n_modes=0.9999)
    assert share_left(whole, shapes) < 1.01e-4
    # More frames than coordinates
    X = make_nonrigid_tracks(60, 12, 2, noise=0.02, random_state=0).data
    model = AffineNRSfM(2, **QUICK).fit(X)
    shapes = model.reconstruct(X, camera="weak_perspective")
    found = point_distribution_model(model, n_modes=0.999)
    assert share_left(found, shapes) < 1.01e-3


def assert_true_mean(pdm, truth):
    """Check the proportions, and the pose but for a few degrees of pitch."""
    error = aligned(pdm.mean, truth.mean_shape) - truth.mean_shape
    assert np.linalg.norm(error) < 0.01 * np.linalg.norm(truth.mean_shape)
    cosines = np.sum(pdm.mean * truth.mean_shape, axis=0)
    sizes = (np.linalg.norm(shape, axis=0) for shape in (pdm.mean, truth.mean_shape))
    assert (cosines / np.prod([*sizes], axis=0)).min() > 0.99


@pytest.mark.parametrize("camera", slow_after(1, ["weak_perspective", "orthographic"]))
def test_models_with_calibrated_cameras_give_the_true_shapes(camera, recwarn):
    truth, model = faces(camera), calibrated_model(camera)
    pdm = point_distribution_model(model)
    again = point_distribution_model(model, camera=None)
    assert_equal(pdm, again)
    assert_true_mean(pdm, truth)
    # Of the coefficients that are reported
    assert share_left(pdm, model.shapes(model.alpha_)) < 0.02
    if camera == "orthographic":
        unit = np.linalg.norm(truth.motion[0, 0])  # pixels a millimetre
        size = unit * np.linalg.norm(truth.mean_shape)
        assert np.linalg.norm(pdm.mean) == pytest.approx(size, rel=0.01)
    assert len(recwarn) == 0


def test_rows_without_points_are_left_out():
    table = faces().data[:60].copy()
    model = AffineNRSfM(1, **QUICK).fit(table[:40])
    table[40:] = np.nan
    with_empty = warned("no point is visible", AffineNRSfM(1, **QUICK).fit, table)
    found, expected = map(point_distribution_model, (with_empty, model))
    for one, other in zip(found, expected, strict=True):
        assert_allclose(one, other, rtol=1e-9, atol=1e-9)


def test_a_share_of_the_variance_takes_as_few_modes_as_have_it():
    model = face_model()
    everything = point_distribution_model(model, n_modes=0.999999).eigenvalues
    share = np.cumsum(everything) / everything.sum()
    for n_modes in (1, 2, 3):
        between = float(share[n_modes - 1] - 1e-6)
        found = point_distribution_model(model, n_modes=between)
        assert len(found.modes) == n_modes
        assert_equal(found, point_distribution_model(model, n_modes=n_modes))


def test_files_have_the_same_numbers(pdm, tmp_path):
    for suffix in (".txt", ".mat", ".npz"):
        write_pdm(pdm, tmp_path / f"pdm{suffix}")
    assert_equal(read_pdm(str(tmp_path / "pdm.txt")), pdm)
    with np.load(tmp_path / "pdm.npz") as arrays:
        assert_equal(PointDistributionModel(**arrays), pdm)
    # As OpenFace reads the text, and as its MATLAB code has them: all x, then all y,
    # then all z; a shape is mean + components * scores.
    of_matlab = loadmat(tmp_path / "pdm.mat")
    mean, components, variances = read_as_openface_does(tmp_path / "pdm.txt")
    assert_array_equal(of_matlab["M"], mean)
    assert_array_equal(of_matlab["V"], components)
    assert_array_equal(of_matlab["E"], variances.T)
    assert mean.shape == (204, 1)
    assert_array_equal(variances, pdm.eigenvalues[None])
    scores = np.array([1.0, -2.0, 0.5])
    shape = (mean[:, 0] + components @ scores).reshape(3, 68).T
    assert_allclose(shape, pdm.mean + np.tensordot(scores, pdm.modes, 1))


# Rows that end in blanks, carriage returns, more matrices at the end.
OF_OTHERS = (
    "# mean\r\n6\r\n1\r\n6\r\n1 \r\n2 \r\n3 \r\n4 \r\n5 \r\n6 \r\n"
    "# modes\r\n6\r\n1\r\n6\r\n" + "0.5 \r\n" * 6 + "# variances\r\n1\r\n1\r\n6\r\n"
    "7 \r\n# of expressions\r\n1\r\n1\r\n6\r\n9\r\n"
)
test_refusals = refusals_of("export_files", globals())
