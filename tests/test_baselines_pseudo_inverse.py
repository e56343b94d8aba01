"""The pseudo-inverse method: cameras, shapes of least norm, low rank."""

import numpy as np
import pytest
from baseline_scenes import camera_frame, exact_table, mocap_shapes
from layers import slow_after
from numpy.testing import assert_allclose
from scenes import measurements
from scipy.spatial.transform import Rotation

from isa_nrsfm.baselines import PseudoInverseNRSfM
from isa_nrsfm.baselines._pseudo_inverse import (
    least_norm_shapes,
    orthographic_cameras,
    truncate_rank,
)
from isa_nrsfm.metrics import mean_shape_error_3d

N_FRAMES, N_POINTS = 12, 9


@pytest.fixture
def cameras():
    return Rotation.random(N_FRAMES, np.random.default_rng(0)).as_matrix()[:, :2]


@pytest.fixture
def W():
    W = np.random.default_rng(0).normal(size=(2 * N_FRAMES, N_POINTS))
    return W - W.mean(axis=1, keepdims=True)


def images(shapes, cameras):
    return (cameras @ shapes.swapaxes(1, 2)).reshape(2 * len(cameras), -1)


class TestLeastNormShapes:
    def test_show_the_images(self, W, cameras):
        shapes = least_norm_shapes(W, cameras)
        assert_allclose(images(shapes, cameras), W, atol=1e-14)

    def test_are_those_of_the_pseudo_inverse_of_all_cameras(self, W, cameras):
        R = np.zeros((2 * N_FRAMES, 3 * N_FRAMES))
        for i, camera in enumerate(cameras):
            R[2 * i : 2 * i + 2, 3 * i : 3 * i + 3] = camera
        expected = (np.linalg.pinv(R) @ W).reshape(N_FRAMES, 3, -1).swapaxes(1, 2)
        assert_allclose(least_norm_shapes(W, cameras), expected, atol=1e-14)

    def test_any_others_that_show_the_images_are_larger(self, W, cameras):
        shapes = least_norm_shapes(W, cameras)
        depth = np.cross(cameras[:, 0], cameras[:, 1])
        rng = np.random.default_rng(1)
        others = shapes + rng.normal(size=(N_FRAMES, N_POINTS, 1)) * depth[:, None]
        assert_allclose(images(others, cameras), W, atol=1e-13)
        assert np.linalg.norm(others) > np.linalg.norm(shapes)
        # What is added is orthogonal to them.
        assert_allclose(np.sum(shapes * (others - shapes)), 0, atol=1e-12)


class TestTruncateRank:
    def test_leaves_what_singular_values_say(self):
        shapes = np.random.default_rng(0).normal(size=(8, 5, 3))
        nearest = truncate_rank(shapes, 3)
        rows = nearest.reshape(8, -1)
        assert np.linalg.matrix_rank(rows) == 3
        beyond = np.linalg.svd(shapes.reshape(8, -1), compute_uv=False)[3:]
        assert np.sum((shapes - nearest) ** 2) == pytest.approx(np.sum(beyond**2))

    def test_does_not_depend_on_signs_of_frames(self):
        rng = np.random.default_rng(0)
        shapes = rng.normal(size=(8, 5, 3))
        signs = rng.choice([-1.0, 1.0], (8, 1, 1))
        assert_allclose(
            truncate_rank(signs * shapes, 3), signs * truncate_rank(shapes, 3)
        )


class TestOrthographicCameras:
    def test_of_an_exact_table(self):
        truth = exact_table(0)
        found = orthographic_cameras(measurements(truth.tracks, False), 3)
        rows = found.reshape(-1, 3)
        expected = truth.motion.reshape(-1, 3)
        assert_allclose(rows @ rows.T, expected @ expected.T, atol=2e-4)
        identity = np.broadcast_to(np.eye(2), (len(found), 2, 2))
        assert_allclose(found @ found.swapaxes(1, 2), identity, atol=1e-14)

    def test_need_three_directions(self):
        W = measurements(exact_table(0).tracks, False)
        flat = W[:, :2] @ np.random.default_rng(0).normal(size=(2, 30))
        with pytest.raises(ValueError, match=r"rank three or more.*has rank 2"):
            orthographic_cameras(flat - flat.mean(axis=1, keepdims=True), 3)


def test_cameras_that_see_everything_leave_depth_too_small():
    # Each frame gives two of three coordinates, so that a third of the size is lost.
    truth = exact_table(1, n_components=1, amplitude=0.01, n_frames=400)
    model = PseudoInverseNRSfM(1).fit(truth.data)
    size = np.linalg.norm(model.mean_shape_)
    assert size == pytest.approx(2 / 3 * np.linalg.norm(truth.mean_shape), rel=0.03)


def test_shark(load_data):
    data = load_data("shark_torresani")
    model = PseudoInverseNRSfM(1).fit(data["W2d"].reshape(240, -1))
    assert 100 * model.inverse_snr_ == pytest.approx(3.714, rel=0.001)
    error = mean_shape_error_3d(data["S3d"], camera_frame(model))
    assert error == pytest.approx(0.901, rel=0.02)


@pytest.mark.parametrize(
    ("name", "n_components", "inverse_snr", "error"),
    [
        ("akhter_yoga", 9, 0.0504, 0.611),
        *slow_after(
            0,
            [
                ("akhter_drink", 11, 0.00690, 0.446),
                ("akhter_pickup", 11, 0.0267, 0.547),
            ],
            together=True,
        ),
    ],
)
def test_motion_capture(load_data, name, n_components, inverse_snr, error):
    data = load_data(name)
    tracks = data["W2d"]
    model = PseudoInverseNRSfM(n_components).fit(tracks.reshape(len(tracks), -1))
    assert 100 * model.inverse_snr_ == pytest.approx(inverse_snr, rel=0.05)
    found = mean_shape_error_3d(mocap_shapes(data), camera_frame(model))
    assert found == pytest.approx(error, rel=0.02)
