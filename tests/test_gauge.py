"""The canonical space, order, scale and sign."""

import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal
from scenes import random_rotation
from scipy.spatial.transform import Rotation

from isa_nrsfm._frames.camera_models import mean_view
from isa_nrsfm._frames.projection import compose, project
from isa_nrsfm._gauge.canonical import (
    canonical_gauge,
    canonical_rotation,
    canonical_space,
    euclidean_space,
    reorder_blocks,
)


class Scene:
    """A shape with a skewed depth, and cameras that see it from about one side."""

    def __init__(self, seed=0, n_frames=30, spread=0.3, flat=0):
        rng = np.random.default_rng(seed)
        self.mean_shape = rng.exponential(size=(25, 3))
        self.mean_shape[:, 3 - flat :] = 0
        self.mean_shape -= self.mean_shape.mean(axis=0)
        self.basis = rng.normal(size=(3, 25, 3))
        self.basis -= self.basis.mean(axis=1, keepdims=True)
        self.motion = np.eye(2, 3) + spread * rng.normal(size=(n_frames, 2, 3))
        self.alpha = rng.exponential(size=(n_frames, 3)) * [1.0, 5.0, 0.2]
        if flat:
            self.motion[:, :, 3 - flat :] = 0

    def canonical(self):
        A = canonical_space(self.mean_shape, self.motion)
        gauge = canonical_gauge(self.mean_shape, self.basis, self.motion, self.alpha, A)
        return gauge, self.motion @ np.linalg.inv(A)

    def scattered(self):
        """Give each frame a view of its own."""
        rotations = [random_rotation(seed) for seed in range(len(self.motion))]
        self.motion = np.array([R[:2] for R in rotations]) @ np.diag([1.0, 2.0, 3.0])
        return self


def coefficients(scene, gauge):
    """Return alpha for the canonical basis, from the order and the scales."""
    A = canonical_space(scene.mean_shape, scene.motion)
    before = scene.basis[gauge.order] @ A.T
    ratio = np.sum(gauge.basis * before, axis=(1, 2)) / np.sum(before**2, axis=(1, 2))
    assert_allclose(gauge.basis, ratio[:, None, None] * before, atol=1e-10)
    return scene.alpha[:, gauge.order] / ratio


class TestSpace:
    def test_mean_shape_is_white_and_centred(self):
        gauge, _ = Scene().canonical()
        B = gauge.mean_shape
        assert_allclose(B.mean(axis=0), 0, atol=1e-13)
        assert_allclose(B.T @ B / len(B), np.eye(3), atol=1e-13)

    def test_rows_of_the_mean_camera_are_in_the_plane_of_x_and_y(self):
        _, motion = Scene().canonical()
        view = mean_view(motion)
        assert_allclose(view[:, 2], 0, atol=1e-13)
        # As near to the axes as can be: no rotation in the plane brings them nearer.
        assert_allclose(view[0, 1], view[1, 0], atol=1e-13)
        assert np.trace(view[:, :2]) > 0
        assert np.linalg.det(view[:, :2]) > 0

    @pytest.mark.parametrize("seed", range(4))
    def test_depth_is_skewed_to_the_positive_side(self, seed):
        gauge, _ = Scene(seed).canonical()
        assert np.sum(gauge.mean_shape[:, 2] ** 3) > 0

    def test_scattered_views_have_their_principal_axes(self):
        scene = Scene(n_frames=300).scattered()
        gauge, motion = scene.canonical()
        assert mean_view(motion) is None
        B = gauge.mean_shape
        assert_allclose(B.T @ B / len(B), np.eye(3), atol=1e-13)
        second = np.einsum("irc,ird->cd", motion, motion)
        assert_allclose(second, np.diag(np.diag(second)), atol=1e-10 * second.max())
        assert np.all(np.diff(np.diag(second)) < 0)
        assert np.all(np.sum(B**3, axis=0) > 0)

    @pytest.mark.parametrize("scattered", [False, True])
    @pytest.mark.parametrize("mirrored", [False, True])
    def test_any_affinity_before_leads_to_the_same_space(self, scattered, mirrored):
        scene = Scene(n_frames=300)
        if scattered:
            scene.scattered()
        expected, expected_motion = scene.canonical()
        A = np.random.default_rng(1).normal(size=(3, 3))
        A[0] *= np.sign(np.linalg.det(A)) * (-1 if mirrored else 1)
        scene.mean_shape, scene.basis = scene.mean_shape @ A.T, scene.basis @ A.T
        scene.motion = scene.motion @ np.linalg.inv(A)
        gauge, motion = scene.canonical()
        assert_allclose(gauge.mean_shape, expected.mean_shape, atol=1e-10)
        assert_allclose(gauge.basis, expected.basis, atol=1e-8)
        assert_allclose(motion, expected_motion, atol=1e-10)

    @pytest.mark.parametrize("flat", [1, 2])
    @pytest.mark.parametrize("unit", [1e-9, 1.0, 1e9])
    def test_flat_object(self, flat, unit):
        scene = Scene(flat=flat)
        R = random_rotation(4)
        scene.mean_shape, scene.motion = unit * scene.mean_shape @ R, scene.motion @ R
        gauge, motion = scene.canonical()
        B = gauge.mean_shape
        variances = np.sort(np.linalg.eigvalsh(B.T @ B / len(B)))[::-1]
        assert_allclose(variances, [1.0] * (3 - flat) + [0.0] * flat, atol=1e-9)
        images = scene.motion @ scene.mean_shape.T
        assert_allclose(motion @ B.T, images, atol=1e-8 * unit)
        assert np.isfinite(gauge.basis).all()

    @pytest.mark.parametrize("flat", [1, 2])
    def test_flat_directions_get_the_scale_of_the_widest(self, flat):
        scene = Scene(flat=flat)
        A = canonical_space(scene.mean_shape, scene.motion)
        widths = np.linalg.svd(scene.mean_shape, compute_uv=False)[: 3 - flat]
        expected = np.sort(np.append(widths, [widths[0]] * flat))[::-1] / 5
        assert_allclose(1 / np.linalg.svd(A, compute_uv=False)[::-1], expected)


class TestEuclideanSpace:
    """With calibrated cameras space is turned, not stretched."""

    def scene(self, spread=0.3):
        rng = np.random.default_rng(0)
        scene = Scene()
        turns = Rotation.from_rotvec(spread * rng.normal(size=(30, 3))).as_matrix()
        scene.motion = rng.uniform(0.5, 2.0, 30)[:, None, None] * turns[:, :2]
        return scene

    @pytest.mark.parametrize("size", [None, 1.0, 7.0])
    def test_is_a_multiple_of_an_orthogonal_matrix(self, size):
        scene = self.scene()
        A = euclidean_space(scene.mean_shape, scene.motion, size)
        if size is None:
            size = 1 / np.sqrt(np.mean(scene.mean_shape**2))
        assert_allclose(A @ A.T, size**2 * np.eye(3), atol=1e-12 * size**2)
        expected = canonical_rotation(scene.mean_shape, scene.motion)
        assert_allclose(A, size * expected, rtol=1e-12)

    def test_mean_square_of_the_mean_shape_is_one(self):
        scene = self.scene()
        for unit in (1e-9, 1.0, 1e9):
            A = euclidean_space(unit * scene.mean_shape, scene.motion / unit, None)
            shape = unit * scene.mean_shape @ A.T
            assert np.mean(shape**2) == pytest.approx(1.0)

    @pytest.mark.parametrize("spread", [0.3, 3.0])
    def test_any_rotation_before_leads_to_the_same_space(self, spread):
        scene = self.scene(spread)
        A = euclidean_space(scene.mean_shape, scene.motion, None)
        for turn in (random_rotation(1), -random_rotation(2)):
            shape, motion = scene.mean_shape @ turn.T, scene.motion @ turn.T
            B = euclidean_space(shape, motion, None)
            assert_allclose(shape @ B.T, scene.mean_shape @ A.T, atol=1e-11)

    def test_mean_shape_of_zeros(self):
        scene = self.scene()
        A = euclidean_space(0 * scene.mean_shape, scene.motion, None)
        assert_allclose(A @ A.T, np.eye(3), atol=1e-12)


class TestBasis:
    def test_images_stay_as_they_are(self):
        scene = Scene()
        gauge, motion = scene.canonical()
        alpha = coefficients(scene, gauge)
        before = compose(scene.mean_shape, scene.basis, scene.alpha)
        after = compose(gauge.mean_shape, gauge.basis, alpha)
        expected = project(before, scene.motion, np.zeros(2))
        assert_allclose(project(after, motion, np.zeros(2)), expected, atol=1e-10)

    def test_coefficients_have_unit_variance_and_are_skewed_to_the_positive_side(self):
        scene = Scene()
        gauge, _ = scene.canonical()
        alpha = coefficients(scene, gauge)
        assert_allclose(alpha.std(axis=0), 1)
        assert np.all(np.sum(alpha**3, axis=0) > 0)

    def test_ordered_by_energy_in_the_images(self):
        scene = Scene()
        gauge, motion = scene.canonical()
        alpha = coefficients(scene, gauge)
        moved = (motion @ gauge.basis[k].T for k in range(3))
        pairs = zip(alpha.T, moved, strict=True)
        energies = [np.sum((a[:, None, None] * images) ** 2) for a, images in pairs]
        assert_array_equal(np.argsort(energies)[::-1], [0, 1, 2])
        assert sorted(gauge.order) == [0, 1, 2]

    def test_order_signs_and_scales_before_do_not_matter(self):
        scene = Scene()
        expected, _ = scene.canonical()
        factors = np.array([-3.0, 1e-6, 1e6])
        order = np.array([2, 0, 1])
        scene.basis = (factors[:, None, None] * scene.basis)[order]
        scene.alpha = (scene.alpha / factors)[:, order]
        gauge, _ = scene.canonical()
        assert_allclose(gauge.basis, expected.basis, rtol=1e-9, atol=1e-10)
        assert_array_equal(order[gauge.order], expected.order)

    def test_coefficients_that_do_not_vary_have_unit_mean_square(self):
        scene = Scene()
        scene.alpha[:, 1] = -7.0
        gauge, _ = scene.canonical()
        alpha = coefficients(scene, gauge)
        k = int(np.flatnonzero(gauge.order == 1)[0])
        assert_allclose(alpha[:, k], 1)

    @pytest.mark.parametrize(
        ("part", "size"), [("alpha", 0.0), ("basis", 1e-15), ("basis", 1e-6)]
    )
    def test_basis_shape_that_hardly_moves(self, part, size):
        scene = Scene()
        values = scene.alpha.T if part == "alpha" else scene.basis
        values[1] *= size
        gauge, _ = scene.canonical()
        assert gauge.order[2] == 1
        assert np.isfinite(gauge.basis).all()
        # Below rounding errors it is zero.
        assert (np.abs(gauge.basis[2]).max() > 1e-7) == (size == 1e-6)
        assert gauge.basis[2].any() == (size == 1e-6)


class TestReorderBlocks:
    def test_by_hand(self):
        matrix = np.arange(81.0).reshape(9, 9)
        order = np.array([2, 0, 1])
        got = reorder_blocks(matrix, order)
        for a in range(3):
            for b in range(3):
                rows, columns = (np.arange(3) + 3 * order[each] for each in (a, b))
                expected = matrix[np.ix_(rows, columns)]
                assert_array_equal(got[3 * a : 3 * a + 3, 3 * b : 3 * b + 3], expected)
