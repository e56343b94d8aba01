import numpy as np
import pytest
from export_models import N_FRAMES, calibrated_model, face_model, faces
from numpy.testing import assert_allclose, assert_array_equal
from refusals import refused
from scipy.spatial.transform import Rotation

from isa_nrsfm.export import frame_poses, point_distances

EYES, MOUTH = (36, 45), (48, 54)


@pytest.fixture(scope="module", params=["weak_perspective", "affine"])
def fitted(request):
    """Return faces with their true rotations, and a model of them."""
    return faces(), face_model() if request.param == "affine" else calibrated_model()


def rotations_of(poses):
    """Return rotations from angles, by their definition."""
    angles = np.stack([poses.roll, -poses.pitch, -poses.yaw], axis=1)
    return Rotation.from_euler("ZXY", angles, degrees=True)


class TestFramePoses:
    def test_true_up_to_a_common_rotation(self, fitted):
        truth, model = fitted
        found = rotations_of(frame_poses(model, truth.data))
        true = Rotation.from_euler("yxz", truth.angles, degrees=True)
        common = (found.inv() * true).mean()
        off = np.degrees((found * common * true.inv()).magnitude())
        assert np.median(off) < 2
        # Upright and frontal, as the makers of the faces have it
        assert np.degrees(common.magnitude()) < 5

    def test_deviations_are_those_of_the_errors(self, fitted):
        truth, model = fitted
        if model.camera == "affine":
            assert np.isnan(frame_poses(model, truth.data).yaw_std).all()
            return
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

    def test_of_the_fitted_table(self, fitted):
        truth, model = fitted
        expected = frame_poses(model, truth.data)[:4]
        assert_allclose(frame_poses(model)[:4], expected, atol=1e-4)
        assert np.isnan(frame_poses(model).yaw_std).all()

    def test_of_fitted_frames(self, fitted):
        truth, model = fitted
        X = truth.data[:20]
        frames = model.decompose(X)
        assert_array_equal(frame_poses(model, frames)[:4], frame_poses(model, X)[:4])
        assert np.isnan(frame_poses(model, frames).yaw_std).all()
        found, pair = point_distances(model, [MOUTH], frames, unit=EYES), [MOUTH]
        assert_array_equal(found, point_distances(model, pair, X, unit=EYES))


class TestPointDistances:
    def test_true_in_units_of_the_eyes(self, fitted):
        truth, model = fitted
        found = point_distances(model, [MOUTH, EYES])
        true = np.linalg.norm(truth.shapes[:, 48] - truth.shapes[:, 54], axis=1)
        mean = truth.shapes.mean(axis=0)
        true /= np.linalg.norm(mean[36] - mean[45])
        assert np.corrcoef(found[:, 0], true)[0, 1] > 0.98
        assert_allclose(found[:, 0].mean(), true.mean(), rtol=0.03)
        assert found[:, 1].mean() == pytest.approx(1.0, abs=0.01)

    def test_units(self, fitted):
        truth, model = fitted
        eyes = point_distances(model, [MOUTH])
        mouth = point_distances(model, [MOUTH], unit=MOUTH, length=50.0)
        ratio = mouth / eyes
        assert_allclose(ratio, ratio[0, 0])
        assert mouth.mean() == pytest.approx(50.0, rel=0.01)
        again = point_distances(model, [MOUTH], truth.data)
        assert_allclose(again, eyes, atol=2e-3)

    def test_a_pair_alone_is_no_list_of_pairs(self, fitted):
        refused(r"\[\(62, 66\)\].* got 48 instead", point_distances, fitted[1], MOUTH)


def test_uncertainty_needs_calibrated_cameras(fitted):
    truth, model = fitted
    if model.camera == "affine":
        message = "needs a model with calibrated cameras; .* Fit with camera='weak_"
        refused(message, model.rotation_covariance, truth.data)
    else:
        covariance = model.rotation_covariance(truth.data)
        assert covariance.shape == (N_FRAMES, 3, 3)
        assert (np.linalg.eigvalsh(covariance) > 0).all()
