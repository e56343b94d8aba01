import io
from zipfile import ZipFile

import numpy as np
import pytest
from export_models import N_COMPONENTS, aligned, calibrated_model, face_model, faces
from numpy.testing import assert_allclose, assert_array_equal, assert_equal
from refusals import refused, warned
from scipy.io import loadmat, savemat

from isa_nrsfm import AffineNRSfM, FastISA
from isa_nrsfm.datasets import make_nonrigid_tracks
from isa_nrsfm.export import (
    PointDistributionModel,
    point_distribution_model,
    read_pdm,
    write_pdm,
)


def scores_of(pdm, shapes):
    """Return the scores of shapes that are aligned to the mean."""
    flat = (shapes - pdm.mean).reshape(len(shapes), -1)
    return flat @ pdm.modes.reshape(len(pdm.modes), -1).T


def on_tangent_space(shapes, mean):
    """Return shapes aligned to a mean, their differences from it orthogonal to it."""
    shapes = aligned(shapes, mean)
    scales = np.sum(mean**2) / np.sum(shapes * mean, axis=(1, 2))
    return scales[:, None, None] * shapes


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


def test_modes_are_orthonormal_and_sorted(pdm):
    flat = pdm.modes.reshape(len(pdm.modes), -1)
    assert len(flat) == N_COMPONENTS
    assert_allclose(flat @ flat.T, np.eye(N_COMPONENTS), atol=1e-12)
    assert np.all(np.diff(pdm.eigenvalues) < 0)
    assert_allclose(pdm.mean.mean(axis=0), 0, atol=1e-9)
    largest = np.abs(flat).argmax(axis=1)
    assert np.all(flat[np.arange(N_COMPONENTS), largest] > 0)


@pytest.mark.parametrize("y_up", [False, True])
@pytest.mark.parametrize("camera", ["weak_perspective", None])
@pytest.mark.parametrize("make", [face_model, calibrated_model])
def test_faces_stand_upright_and_look_at_the_viewer(make, camera, y_up):
    model = face_model(y_up=y_up) if make is face_model else make()
    mean = point_distribution_model(model, camera=camera).mean
    ear, nose, other_ear, brow, chin = mean[[0, 30, 16, 19, 8]]
    assert brow[1] < nose[1] < chin[1]  # y points down
    assert ear[0] < nose[0] < other_ear[0]
    assert nose[2] < min(ear[2], other_ear[2])  # z points away


def test_more_frames_than_coordinates(rng):
    X = make_nonrigid_tracks(60, 12, 2, noise=0.02, random_state=0).data
    model = AffineNRSfM(2, isa=FastISA(n_init=1), refinement=None, random_state=0)
    found = point_distribution_model(model.fit(X), n_modes=0.999)
    shapes = on_tangent_space(model.reconstruct(X, camera="weak_perspective"), found[0])
    flat = (shapes - found.mean).reshape(60, -1)
    values = np.linalg.svd(flat, compute_uv=False)[: len(found.modes)]
    assert_allclose(found.eigenvalues, values**2 / 60, rtol=1e-6)


def test_euclidean_shapes_of_the_frames_are_reproduced(pdm):
    assert_true_mean(pdm, faces())
    shapes = face_model().reconstruct(faces().data, camera="weak_perspective")
    shapes = on_tangent_space(shapes, pdm.mean)
    spread = np.sum((shapes - pdm.mean) ** 2)
    errors = []
    for model in (pdm, point_distribution_model(face_model(), n_modes=0.9999)):
        scores = scores_of(model, shapes)
        rebuilt = model.mean + np.tensordot(scores, model.modes, 1)
        errors.append(np.sum((shapes - rebuilt) ** 2) / spread)
        assert_allclose(np.mean(scores**2, axis=0), model.eigenvalues, rtol=1e-6)
        assert_allclose(np.mean(scores, axis=0), 0, atol=1e-6)
    assert errors[0] < 0.03
    assert errors[1] < 1.01e-4


def assert_true_mean(pdm, truth):
    """Check the proportions, and the pose but for a few degrees of pitch."""
    error = aligned(pdm.mean, truth.mean_shape) - truth.mean_shape
    assert np.linalg.norm(error) < 0.01 * np.linalg.norm(truth.mean_shape)
    cosines = np.sum(pdm.mean * truth.mean_shape, axis=0)
    sizes = (np.linalg.norm(shape, axis=0) for shape in (pdm.mean, truth.mean_shape))
    assert (cosines / np.prod([*sizes], axis=0)).min() > 0.99


@pytest.mark.parametrize("camera", ["weak_perspective", "orthographic"])
def test_models_with_calibrated_cameras_give_the_true_shapes(camera, recwarn):
    truth, model = faces(camera=camera), calibrated_model(camera)
    pdm = point_distribution_model(model)
    again = point_distribution_model(model, camera=None)
    assert_equal(pdm, again)
    assert_true_mean(pdm, truth)
    shapes = on_tangent_space(model.reconstruct(truth.data), pdm.mean)
    scores = scores_of(pdm, shapes)
    assert_allclose(np.mean(scores**2, axis=0), pdm.eigenvalues, rtol=1e-6)
    rest = shapes - pdm.mean - np.tensordot(scores, pdm.modes, 1)
    assert np.sum(rest**2) < 0.02 * np.sum((shapes - pdm.mean) ** 2)
    if camera == "orthographic":
        unit = np.linalg.norm(truth.motion[0, 0])  # pixels a millimetre
        size = unit * np.linalg.norm(truth.mean_shape)
        assert np.linalg.norm(pdm.mean) == pytest.approx(size, rel=0.01)
    assert len(recwarn) == 0


def test_affine_shapes_have_as_many_modes_as_basis_shapes():
    model = face_model()
    pdm = point_distribution_model(model, camera=None, n_modes=0.999999)
    assert len(pdm.modes) == N_COMPONENTS
    message, options = "at most 3, the number of principal", {"camera": None}
    refused(message, point_distribution_model, model, n_modes=4, **options)


def test_rows_without_points_are_left_out():
    table = faces().data[:60].copy()
    options = {"isa": FastISA(n_init=1), "refinement": None, "random_state": 0}
    model = AffineNRSfM(1, **options).fit(table[:40])
    table[40:] = np.nan
    with_empty = warned("no point is visible", AffineNRSfM(1, **options).fit, table)
    found, expected = map(point_distribution_model, (with_empty, model))
    for one, other in zip(found, expected, strict=True):
        assert_allclose(one, other, rtol=1e-9, atol=1e-9)


def test_a_share_of_the_variance_takes_as_few_modes_as_have_it(pdm):
    model = face_model()
    everything = point_distribution_model(model, n_modes=0.999999).eigenvalues
    share = np.cumsum(everything) / everything.sum()
    for n_modes in (1, 2, 3):
        between = share[n_modes - 1] - 1e-6
        found = point_distribution_model(model, n_modes=float(between))
        assert len(found.modes) == n_modes
        exact = point_distribution_model(model, n_modes=n_modes)
        assert_equal(found, exact)


def test_another_unit_of_length(pdm):
    scaled = pdm.scaled(2.5)
    assert_allclose(scaled.mean, 2.5 * pdm.mean)
    assert_allclose(scaled.eigenvalues, 6.25 * pdm.eigenvalues)
    assert scaled.modes is pdm.modes


@pytest.mark.parametrize("suffix", [".txt", ".mat", ".npz"])
def test_files_give_the_same_numbers_again(pdm, tmp_path, suffix):
    path = tmp_path / f"pdm{suffix}"
    write_pdm(pdm, path)
    assert_equal(read_pdm(str(path)), pdm)
    if suffix == ".mat":  # as MATLAB code of OpenFace has them
        shapes = {name: loadmat(path)[name].shape for name in "MVE"}
        m = N_COMPONENTS
        assert shapes == {"M": (204, 1), "V": (204, m), "E": (m, 1)}
        assert_array_equal(loadmat(path)["M"][68:136, 0], pdm.mean[:, 1])


def test_openface_reads_the_text(pdm, tmp_path):
    path = tmp_path / "pdm.txt"
    write_pdm(pdm, path)
    mean, components, variances = read_as_openface_does(path)
    assert mean.shape == (204, 1)
    assert components.shape == (204, N_COMPONENTS)
    assert variances.shape == (1, N_COMPONENTS)
    # All x, then all y, then all z; a shape is mean + components * scores.
    scores = np.array([1.0, -2.0, 0.5])
    shape = (mean[:, 0] + components @ scores).reshape(3, 68).T
    assert_allclose(shape, pdm.mean + np.tensordot(scores, pdm.modes, 1))
    assert_array_equal(variances[0], pdm.eigenvalues)


def test_texts_as_others_write_them_are_read(tmp_path):
    # Rows that end in blanks, carriage returns, more matrices at the end.
    text = (
        "# mean\r\n6\r\n1\r\n6\r\n1 \r\n2 \r\n3 \r\n4 \r\n5 \r\n6 \r\n"
        "# modes\r\n6\r\n1\r\n6\r\n" + "0.5 \r\n" * 6 + "# variances\r\n1\r\n1\r\n6\r\n"
        "7 \r\n# of expressions\r\n1\r\n1\r\n6\r\n9\r\n"
    )
    path = tmp_path / "other.txt"
    path.write_bytes(text.encode())
    pdm = read_pdm(path)
    assert_array_equal(pdm.mean, [[1, 3, 5], [2, 4, 6]])
    assert_array_equal(pdm.modes, np.full((1, 2, 3), 0.5))
    assert_array_equal(pdm.eigenvalues, [7])


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("", "as a point distribution model: where there should be the mean"),
        ("# mean\n3 1 6 1 2\n", "where there should be the mean"),
        ("3 1 6 1 2 3 3 1 6 1 one 1 1 1 6 1", "there should be the principal comp"),
        ("3 1 6 1 2 3 3 1 6 1 1 1 1 2 6 1 1", r"should have a mean of 3n numbers"),
    ],
    ids=["empty", "short", "no number", "misfit"],
)
def test_other_texts_are_refused(tmp_path, text, message):
    path = tmp_path / "other.txt"
    path.write_text(text)
    refused(message, read_pdm, path)


def test_other_files_are_refused(pdm, tmp_path):
    refused(r"\.txt or \.mat or \.npz; got", read_pdm, tmp_path / "pdm.csv")
    np.savez(tmp_path / "a.npz", mean=pdm.mean)
    refused("has no modes, eigenvalues", read_pdm, tmp_path / "a.npz")
    savemat(tmp_path / "a.mat", {"M": pdm.mean})
    refused("has no V, E", read_pdm, tmp_path / "a.mat")
    misfit = PointDistributionModel(pdm.mean, pdm.modes, pdm.eigenvalues[1:])
    refused("eigenvalues", write_pdm, misfit, tmp_path / "a.txt")
    assert not (tmp_path / "a.txt").exists()


def stored(array, version=None):
    """Return the bytes of an array in NumPy's format."""
    content = io.BytesIO()
    np.lib.format.write_array(content, array, version, allow_pickle=True)
    return content.getvalue()


def test_arrays_have_the_size_of_their_file(tmp_path):
    path, mean = tmp_path / "a.npz", stored(np.arange(6.0).reshape(2, 3), (2, 0))
    objects = stored(np.array([None, None]))
    head = objects[: objects.index(b"\n") + 1]

    def read(mean):
        with ZipFile(path, "w") as file:
            file.writestr("mean.npy", mean)
            file.writestr("modes.npy", stored(np.ones((1, 2, 3)), (1, 0)))
            file.writestr("eigenvalues.npy", stored(np.ones(1)))
        return read_pdm(path).mean

    assert_array_equal(read(mean), [[0, 1, 2], [3, 4, 5]])
    for changed, n_bytes in ((mean[:-1], 47), (mean + b"0", 49)):
        refused(f"48 bytes; got {n_bytes}", read, changed)
    for size in (0, 8, 16, 24):
        refused("type object should have 16 bytes", read, head + bytes(size))
