"""Sequences of cameras and shapes: signs and principal components."""

import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal
from scipy.spatial.transform import Rotation

from isa_nrsfm.baselines._shape_sequence import (
    camera_signs,
    principal_shapes,
    shape_signs,
)


def random_signs(seed, n_frames):
    return np.random.default_rng(seed).choice([-1.0, 1.0], n_frames)


def similar_shapes(seed, n_frames, n_points):
    rng = np.random.default_rng(seed)
    mean = rng.normal(size=(n_points, 3))
    return mean + 0.5 * rng.normal(size=(n_frames, n_points, 3))


class TestShapeSigns:
    # More frames than coordinates, and fewer.
    @pytest.mark.parametrize("n_frames", [50, 10])
    def test_are_those_with_which_shapes_are_similar(self, n_frames):
        shapes = similar_shapes(0, n_frames, 8)
        signs = random_signs(1, n_frames)
        found = shape_signs(signs[:, None, None] * shapes)
        assert_array_equal(found, signs * (found[0] * signs[0]))

    def test_none_can_be_changed_for_a_larger_sum(self):
        shapes = np.random.default_rng(0).normal(size=(40, 6, 3))
        signs = shape_signs(shapes)

        def size(signs):
            return np.linalg.norm(np.tensordot(signs, shapes, 1))

        changed = np.where(np.eye(40, dtype=bool), -signs, signs)
        assert size(signs) > size(np.ones(40))
        assert all(size(signs) >= size(other) for other in changed)

    def test_order_of_frames_does_not_matter(self):
        shapes = np.random.default_rng(0).normal(size=(40, 6, 3))
        order = np.random.default_rng(1).permutation(40)
        found, expected = shape_signs(shapes[order]), shape_signs(shapes)[order]
        assert_array_equal(found, expected * (found[0] * expected[0]))


class TestCameraSigns:
    def test_are_those_with_which_the_camera_turns_little(self):
        # A turn of 1.5 rounds, 8 degrees a frame.
        turns = np.outer(np.radians(8.0) * np.arange(70), [0.1, 0.9, 0.3])
        cameras = Rotation.from_rotvec(turns).as_matrix()[:, :2]
        signs = random_signs(0, 70)
        found = camera_signs(signs[:, None, None] * cameras)
        assert_array_equal(found, signs * signs[0])

    def test_one_frame_has_a_sign(self):
        assert_array_equal(camera_signs(np.eye(2, 3)[None]), [1.0])


class TestPrincipalShapes:
    # More frames than coordinates, and fewer.
    @pytest.mark.parametrize("n_frames", [50, 10])
    def test_are_next_to_the_shapes(self, n_frames):
        shapes = similar_shapes(0, n_frames, 8)
        mean, basis, c = principal_shapes(shapes, 3)
        assert_allclose(mean, shapes.mean(axis=0))
        rows = basis.reshape(3, -1)
        assert_allclose(rows @ rows.T, np.diag(np.sum(rows**2, axis=1)), atol=1e-12)
        assert (np.diff(np.sum(rows**2, axis=1)) < 0).all()
        assert_allclose(c.mean(axis=0), 0, atol=1e-12)
        assert_allclose(c.T @ c / n_frames, np.eye(3), atol=1e-12)
        assert (np.sum(c**3, axis=0) > 0).all()
        rest = (shapes - mean).reshape(n_frames, -1)
        left = rest - c @ rows
        beyond = np.linalg.svd(rest, compute_uv=False)[3:]
        assert np.sum(left**2) == pytest.approx(np.sum(beyond**2))

    def test_of_equal_shapes_are_zero(self):
        shapes = np.broadcast_to(similar_shapes(0, 1, 8), (5, 8, 3))
        _, basis, c = principal_shapes(shapes, 2)
        assert_array_equal(basis, 0)
        assert_array_equal(c, 0)
