"""Euclidean shapes from AffineNRSfM: what is known of the cameras is used."""

import numpy as np
import pytest
from layers import slow_after
from numpy.testing import assert_allclose, assert_array_equal
from refusals import refused
from scipy.spatial.transform import Rotation
from sklearn.base import clone
from sklearn.exceptions import NotFittedError

from isa_nrsfm import AffineNRSfM
from isa_nrsfm._tables.tracks import tracks_to_table
from isa_nrsfm.calibration import (
    deformation_metric,
    euclidean_frames,
    euclidean_shapes,
    metric_upgrade,
)
from isa_nrsfm.datasets import make_face_tracks, make_nonrigid_tracks
from isa_nrsfm.metrics import mean_shape_error_3d

CAMERAS = ["orthographic", "weak_perspective"]
both_cameras = pytest.mark.parametrize("camera", CAMERAS)


@pytest.fixture(scope="module")
def faces():
    return make_face_tracks(n_frames=300, camera="orthographic", random_state=0)


@pytest.fixture(scope="module")
def model(faces):
    return AffineNRSfM(n_components=4, random_state=0).fit(faces.data)


def frame_error(truth, shapes, scale=None):
    return mean_shape_error_3d(truth, shapes, convention="frame", scale=scale)


@pytest.fixture(scope="module")
def exact():
    """Shapes without noise in cameras of one scale."""
    options = {"camera": "orthographic", "amplitude": 0.2, "noise": 0}
    tracks = make_nonrigid_tracks(80, 40, 2, **options, random_state=0)
    return tracks, AffineNRSfM(n_components=2, random_state=0).fit(tracks.data)


class TestTruth:
    def test_exact_tables_give_exact_shapes(self, exact):
        tracks, model = exact
        weak = model.reconstruct(tracks.data, camera="weak_perspective")
        assert frame_error(tracks.shapes, weak) < 1e-4
        # Images with the unit of the shapes say how large they are, too.
        size = np.linalg.svd(tracks.motion, compute_uv=False)[0, 0]
        shapes = model.reconstruct(tracks.data, camera="orthographic") / size
        assert frame_error(tracks.shapes, shapes, scale=False) < 1e-4
        assert frame_error(tracks.shapes, model.reconstruct(tracks.data)) > 0.05

    def test_noisy_faces(self, faces, model):
        weak = model.reconstruct(faces.data, camera="weak_perspective")
        assert frame_error(faces.shapes, weak) < 0.012
        ortho = model.reconstruct(faces.data, camera="orthographic")
        # Two pixels a millimetre.
        assert frame_error(faces.shapes, ortho / 2, scale=False) < 0.012
        assert mean_shape_error_3d(faces.shapes, ortho / 2) < 0.05

    def test_photos_of_different_resolution(self):
        faces = make_face_tracks(n_frames=300, random_state=1)
        model = AffineNRSfM(n_components=4, random_state=0).fit(faces.data)
        shapes = model.reconstruct(faces.data, camera="weak_perspective")
        assert frame_error(faces.shapes, shapes) < 0.012

    @pytest.mark.parametrize(
        ("name", "n_components", "errors"),
        [
            # With one metric for all frames: 0.044, 0.090; 0.061, 0.185; 0.101, 0.222;
            # 0.111, 0.376.
            ("ict_bu3dfe_like_68", 9, (0.032, 0.073)),
            *slow_after(
                0,
                [
                    ("akhter_drink", 3, (0.019, 0.097)),
                    ("akhter_pickup", 3, (0.040, 0.125)),
                    ("akhter_yoga", 4, (0.068, 0.245)),
                ],
                together=True,
            ),
        ],
    )
    def test_true_shapes(self, load_data, name, n_components, errors):
        data = load_data(name)
        table = data["W2d"].reshape(len(data["W2d"]), -1)
        model = AffineNRSfM(n_components=n_components, random_state=0).fit(table)
        shapes = model.reconstruct(table, camera="orthographic")
        upgrade = metric_upgrade(model.motion_)
        plain = euclidean_shapes(model.reconstruct(table), upgrade.Q)
        plain *= upgrade.scales[:, None, None]
        for convention, bound in zip(("frame", "sequence"), errors, strict=True):
            found, before = (
                mean_shape_error_3d(data["S3d"], X, convention=convention)
                for X in (shapes, plain)
            )
            assert found < bound
            assert found < 0.85 * before


class TestContract:
    def test_affine_shapes_by_default(self, faces, model):
        expected = model.mean_shape_ + np.tensordot(model.alpha_, model.basis_, 1)
        assert_allclose(model.reconstruct(faces.data), expected, atol=1e-8)
        shapes = model.reconstruct(faces.data)
        assert_array_equal(model.reconstruct(faces.data, camera=None), shapes)

    def test_shapes_are_those_of_the_calibration(self, faces, model):
        motion, translation, alpha, _ = model.decompose(faces.data)
        metric = deformation_metric(model.motion_, model.alpha_)
        shapes = model.mean_shape_, model.basis_
        frames = euclidean_frames(metric, motion, alpha, *shapes)
        weak = model.reconstruct(faces.data, camera="weak_perspective")
        assert_allclose(weak, frames.shapes)
        ortho = model.reconstruct(faces.data, camera="orthographic")
        assert_allclose(ortho, frames.scales[:, None, None] * frames.shapes)
        # Cameras without scale see the orthographic shapes as the model does.
        images = ortho @ frames.rotations[:, :2].transpose(0, 2, 1)
        images += translation[:, None]
        table = tracks_to_table(images, "interleaved")
        assert_allclose(table, model.reproject(faces.data), atol=1e-8)

    @both_cameras
    def test_new_frames_do_not_depend_on_each_other(self, model, camera):
        new = make_face_tracks(n_frames=20, camera="orthographic", random_state=5)
        shapes = model.reconstruct(new.data, camera=camera)
        assert frame_error(new.shapes, shapes) < 0.03
        some = model.reconstruct(new.data[7:9], camera=camera)
        assert_allclose(some, shapes[7:9], rtol=1e-6)

    @pytest.mark.parametrize("refinement", ["joint", "alternating", None])
    def test_every_refinement(self, faces, refinement):
        model = AffineNRSfM(n_components=2, refinement=refinement, random_state=0)
        model.fit(faces.data)
        for camera in CAMERAS:
            shapes = model.reconstruct(faces.data, camera=camera)
            assert frame_error(faces.shapes, shapes) < 0.08

    def test_refuses_other_cameras(self, faces, model):
        message = r"camera must be None or one of .*'weak_perspective'.* got 'affine'"
        refused(message, model.reconstruct, faces.data, camera="affine")
        with pytest.raises(NotFittedError):
            AffineNRSfM().reconstruct(faces.data, camera="orthographic")

    def test_warns_where_cameras_hardly_turn(self, rng):
        options = {"camera": "orthographic", "amplitude": 0.1, "noise": 0}
        tracks = make_nonrigid_tracks(100, 40, 1, **options, random_state=0)
        motion = np.eye(2, 3) + np.zeros((100, 1, 1))
        motion[:, :, 2] = 0.02 * rng.standard_normal((100, 2))
        table = (tracks.shapes @ motion.transpose(0, 2, 1)).reshape(100, -1)
        # The joint refinement takes long where cameras hardly turn.
        model = AffineNRSfM(n_components=1, refinement="alternating", random_state=0)
        model.fit(table)
        with pytest.warns(UserWarning, match="hardly determine the metric"):
            model.reconstruct(table, camera="weak_perspective")

    @pytest.mark.parametrize("seed", [11, 17])
    def test_noisy_cameras_that_hardly_turn(self, seed):
        # The deeper space is, the better it fits the noise of such cameras.
        rng = np.random.default_rng(seed)
        angles = rng.uniform(-3, 3, (60, 3))
        cameras = Rotation.from_euler("yxz", angles, degrees=True).as_matrix()[:, :2]
        cameras = cameras + rng.normal(0, 0.02, cameras.shape)
        alpha = rng.normal(size=(60, 3))
        with pytest.warns(UserWarning, match="hardly determine the metric"):
            metric = deformation_metric(cameras, alpha)
        # The cameras themselves see the depth with 0.04 of the other directions.
        assert np.linalg.cond(metric.Q) < 1e5 / 0.04
        mean, basis = rng.normal(size=(9, 3)), rng.normal(size=(3, 9, 3))
        frames = euclidean_frames(metric, cameras, alpha, mean, basis)
        assert np.isfinite(frames.shapes).all()

    def test_refuses_cameras_that_see_two_directions(self, faces, model):
        flat = clone(model).fit(faces.data)
        flat.motion_[:, :, 2] = 0
        with pytest.raises(ValueError, match=r"three directions of space; .* see 2"):
            flat.reconstruct(faces.data, camera="weak_perspective")
