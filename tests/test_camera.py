"""Affine cameras: least squares, mean view, reference camera."""

import numpy as np
import pytest
from numpy.testing import assert_allclose
from scenes import permute_frames, random_rotation, rotate_frames

from isa_nrsfm._frames.camera_models import mean_view, reference_camera, rigid_cameras


def centred_shape(rng, n_points=15, flat=0):
    shape = rng.normal(size=(n_points, 3))
    shape[:, 3 - flat :] = 0
    return shape - shape.mean(axis=0)


class TestRigidCameras:
    def test_exact_images(self, rng):
        B = centred_shape(rng)
        M = rng.normal(size=(6, 2, 3))
        W = (M @ B.T).reshape(12, -1)
        assert_allclose(rigid_cameras(W, B), M, atol=1e-13)

    def test_residual_is_orthogonal_to_the_shape(self, rng):
        B = centred_shape(rng)
        W = rng.normal(size=(12, 15))
        residual = W - rigid_cameras(W, B).reshape(12, 3) @ B.T
        assert_allclose(residual @ B, 0, atol=1e-12)

    @pytest.mark.parametrize("flat", [1, 2])
    def test_flat_shape_has_the_cameras_of_least_norm(self, rng, flat):
        R = random_rotation(1)
        B = centred_shape(rng, flat=flat)
        M = rng.normal(size=(6, 2, 3))
        W = (M @ B.T).reshape(12, -1)
        cameras = rigid_cameras(W, B @ R)
        assert_allclose(cameras @ R.T @ B.T, M @ B.T, atol=1e-12)
        assert_allclose((cameras @ R.T)[:, :, 3 - flat :], 0, atol=1e-12)

    @pytest.mark.parametrize("unit", [1e-9, 1e9])
    def test_units(self, rng, unit):
        B, W = centred_shape(rng), rng.normal(size=(12, 15))
        expected = rigid_cameras(W, B)
        assert_allclose(rigid_cameras(unit * W, B), unit * expected, rtol=1e-10)
        assert_allclose(rigid_cameras(W, unit * B), expected / unit, rtol=1e-10)

    def test_affinity_of_the_shape_and_rotation_of_images(self, rng):
        B, W = centred_shape(rng), rng.normal(size=(12, 15))
        expected = rigid_cameras(W, B)
        A = rng.normal(size=(3, 3))
        changed = expected @ np.linalg.inv(A)
        assert_allclose(rigid_cameras(W, B @ A.T), changed, atol=1e-12)
        turned = rigid_cameras(rotate_frames(W, 1), B).reshape(12, 3)
        assert_allclose(turned, rotate_frames(expected.reshape(12, 3), 1), atol=1e-13)

    def test_frames_are_separate(self, rng):
        B, W = centred_shape(rng), rng.normal(size=(12, 15))
        permuted, order = permute_frames(W, 1)
        expected = rigid_cameras(W, B)
        assert_allclose(rigid_cameras(permuted, B), expected[order], atol=1e-14)
        assert_allclose(rigid_cameras(W[:2], B), expected[:1], atol=1e-14)


class TestMeanView:
    def test_is_the_mean(self, rng):
        motion = np.eye(2, 3) + 0.1 * rng.normal(size=(20, 2, 3))
        assert_allclose(mean_view(motion), motion.mean(axis=0))

    @pytest.mark.parametrize("unit", [1e-9, 1.0, 1e9])
    def test_uniform_rotations_have_none(self, unit):
        motion = np.array([random_rotation(seed)[:2] for seed in range(400)])
        assert mean_view(unit * motion) is None

    @pytest.mark.parametrize("unit", [1e-9, 1.0, 1e9])
    def test_in_plane_rotations_have_none(self, unit):
        angle = np.arange(8) * np.pi / 4
        motion = np.zeros((8, 2, 3))
        motion[:, 0, 0] = motion[:, 1, 1] = np.cos(angle)
        motion[:, 0, 1], motion[:, 1, 0] = -np.sin(angle), np.sin(angle)
        assert mean_view(unit * motion) is None

    @pytest.mark.parametrize("unit", [1e-9, 1.0, 1e9])
    def test_where_the_limit_is(self, unit):
        # Mirrored y in a share p of the frames: the mean of y is 1 - 2 p.
        for p, none in ((0.38, False), (0.42, True)):
            motion = np.tile(np.eye(2, 3), (100, 1, 1))
            motion[: round(100 * p), 1, 1] = -1
            assert (mean_view(unit * motion) is None) == none

    def test_does_not_depend_on_the_axes_of_space_or_image(self, rng):
        motion = np.eye(2, 3) + 0.3 * rng.normal(size=(20, 2, 3))
        R, Q = random_rotation(1), random_rotation(2, 2)
        view = mean_view(motion)
        assert_allclose(mean_view(Q @ motion @ R), Q @ view @ R, atol=1e-14)


class TestReferenceCamera:
    def test_common_view(self, rng):
        motion = np.eye(2, 3) + 0.1 * rng.normal(size=(20, 2, 3))
        sizes = rng.uniform(1, 3, 20)
        expected = motion.mean(axis=0) * np.sqrt(np.mean(sizes**2))
        assert_allclose(reference_camera(motion, sizes), expected)

    def test_no_common_view(self):
        motion = np.array([random_rotation(seed)[:2] for seed in range(400)])
        motion = motion * [3.0, 2.0, 1.0]
        camera = reference_camera(motion, np.full(400, 5.0))
        # The image of a unit vector along an axis has the mean square length 2/3.
        expected = 5 * np.sqrt(2 / 3) * np.array([[3.0, 0, 0], [0, 2.0, 0]])
        assert_allclose(camera, expected, rtol=0.1, atol=1e-12)

    def test_sizes_are_those_of_the_table(self):
        # Cameras divided by the size of their frame, sizes given apart: the view of
        # a table in other units is the same view in other units.
        motion = np.array([random_rotation(seed)[:2] for seed in range(50)])
        sizes = np.random.default_rng(0).uniform(1, 3, 50)
        camera = reference_camera(motion, sizes)
        assert_allclose(reference_camera(motion, 1e9 * sizes), 1e9 * camera)
