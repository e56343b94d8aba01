"""Camera models: tangents, curvatures, steps and nearest cameras."""

import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal
from scenes import random_rotation
from scipy.spatial.transform import Rotation

from isa_nrsfm._frames.camera_models import (
    CAMERAS,
    full_rotations,
    mean_view,
    nearest_calibrated,
    rotated,
)
from isa_nrsfm._linalg import (
    COLUMNS,
    ROWS,
    frames_first,
    frames_last,
    unpacked,
)

N = 7
CALIBRATED = pytest.mark.parametrize("name", ["weak_perspective", "orthographic"])
EACH = pytest.mark.parametrize("name", CAMERAS)


def random_cameras(seed=0, name="weak_perspective", n=N):
    """Return cameras (2, 3, n) of a model."""
    rng = np.random.default_rng(seed)
    if name == "affine":
        return rng.normal(size=(2, 3, n))
    rows = Rotation.random(n, rng).as_matrix()[:, :2]
    if name == "weak_perspective":
        rows = rng.uniform(0.3, 3.0, n)[:, None, None] * rows
    return frames_last(rows)


def random_curvatures(seed=1, n=N):
    """Return positive definite matrices (n, 3, 3), and packed ones (6, n)."""
    factors = np.random.default_rng(seed).normal(size=(n, 3, 4))
    full = factors @ factors.swapaxes(1, 2)
    return full, full[:, ROWS, COLUMNS].T


def tangents(cameras, M, h=1e-5):
    """Return the derivatives D_c (p, 2, 3, n) of cameras by their parameters."""
    found = []
    for c in range(cameras.n_parameters):
        step = np.zeros((cameras.n_parameters, M.shape[2]))
        step[c] = h
        change = cameras.moved(M, step) - cameras.moved(M, -step)
        found.append(change / (2 * h))
    return np.array(found)


def curvature_along(D, A):
    """Return ``tr(D_c A D_d^T)`` (n, p, p) by a loop over frames."""
    return np.array(
        [np.einsum("cra,ab,drb->cd", D[..., i], A[i], D[..., i]) for i in range(N)]
    )


@pytest.mark.parametrize("size", [0.0, 1e-4, 10.0])
def test_turns_are_exponentials(size):
    M = random_cameras(name="affine")
    turns = size * np.random.default_rng(3).normal(size=(3, N))
    moved = rotated(M, turns)
    for i in range(N):
        R = Rotation.from_rotvec(turns[:, i]).as_matrix()
        assert_allclose(moved[..., i], M[..., i] @ R, atol=1e-14)


class TestTangents:
    @EACH
    def test_tangents(self, name):
        M, cameras = random_cameras(name=name), CAMERAS[name]
        assert_allclose(cameras.tangents(M), tangents(cameras, M), atol=1e-8)

    @EACH
    def test_gradient_is_that_along_the_tangents(self, name):
        M, cameras = random_cameras(name=name), CAMERAS[name]
        G = np.random.default_rng(2).normal(size=(2, 3, N))
        expected = np.einsum("crai,rai->ci", tangents(cameras, M), G)
        assert_allclose(cameras.gradient(M, G), expected, atol=1e-8)

    @EACH
    def test_curvature(self, name):
        # The cameras need not be scaled rotations for it.
        M, (A, packed) = random_cameras(name="affine"), random_curvatures()
        found = CAMERAS[name].curvature(M, packed)
        expected = curvature_along(tangents(CAMERAS[name], M), A)
        assert_allclose(unpacked(found).T, expected, rtol=1e-8, atol=1e-8)


@CALIBRATED
class TestInverseCurvature:
    def test_is_that_along_the_tangents(self, name):
        M, (A, packed) = random_cameras(name=name), random_curvatures()
        cameras = CAMERAS[name]
        expected = curvature_along(tangents(cameras, M), A)
        inverse = cameras.inverse_curvature(M, packed)
        for i in range(N):
            found = inverse[..., i]
            assert_allclose(found, found.T, rtol=1e-12)
            assert_allclose(found, np.linalg.inv(expected[i]), rtol=1e-5, atol=1e-8)

    @pytest.mark.parametrize("rank", [0, 1, 2])
    def test_shapes_that_are_flat(self, name, rank):
        factors = np.random.default_rng(1).normal(size=(N, 3, rank))
        A = factors @ factors.swapaxes(1, 2)
        packed = A[:, ROWS, COLUMNS].T
        M, cameras = random_cameras(name=name), CAMERAS[name]
        inverse = cameras.inverse_curvature(M, packed)
        assert np.isfinite(inverse).all()
        # A step along it never goes uphill.
        for found in inverse.T:
            least = np.linalg.eigvalsh(found)[0]
            assert least >= -1e-6 * np.abs(found).max()

    def test_cameras_of_zero(self, name):
        M, cameras = np.zeros((2, 3, N)), CAMERAS[name]
        inverse = cameras.inverse_curvature(M, random_curvatures()[1])
        assert np.isfinite(inverse).all()


class TestLargestLength:
    @CALIBRATED
    def test_no_camera_turns_by_more_than_a_radian(self, name):
        cameras = CAMERAS[name]
        step = np.random.default_rng(2).normal(size=(cameras.n_parameters, N))
        turned = cameras.largest_length(step) * np.linalg.norm(step[:3], axis=0)
        assert turned.max() == pytest.approx(1.0)

    @CALIBRATED
    def test_scales_count_by_their_logarithm(self, name):
        cameras = CAMERAS[name]
        step = np.zeros((cameras.n_parameters, N))
        step[3:] = 100.0
        expected = 0.01 if cameras.scaled else np.inf
        assert cameras.largest_length(step) == pytest.approx(expected)


class TestNearestCalibrated:
    def test_is_nearest(self):
        rng = np.random.default_rng(0)
        motion = rng.normal(size=(N, 2, 3))
        rows, scales = nearest_calibrated(motion)
        identity = np.broadcast_to(np.eye(2), (N, 2, 2))
        assert_allclose(rows @ rows.swapaxes(1, 2), identity, atol=1e-14)
        least = np.sum((motion - rows) ** 2, axis=(1, 2))
        scaled = np.sum((motion - scales[:, None, None] * rows) ** 2, axis=(1, 2))
        for size in (1e-3, 0.1, 3.0):
            for _ in range(10):
                turns = size * rng.normal(size=(3, N))
                other = frames_first(rotated(frames_last(rows), turns))
                rest = motion - other
                assert (np.sum(rest**2, axis=(1, 2)) > least).all()
                factor = scales * np.exp(size * rng.normal(size=N))
                rest = motion - factor[:, None, None] * other
                assert (np.sum(rest**2, axis=(1, 2)) > scaled).all()

    def test_cameras_of_zero_have_orthonormal_rows_and_no_scale(self):
        rows, scales = nearest_calibrated(np.zeros((1, 2, 3)))
        assert_allclose(rows @ rows.swapaxes(1, 2), [np.eye(2)], atol=1e-14)
        assert_array_equal(scales, [0.0])


class TestFullRotations:
    def test_are_rotations_with_the_rows_of_the_cameras(self):
        motion = frames_first(random_cameras())
        rotations, scales = full_rotations(motion)
        assert_allclose(scales[:, None, None] * rotations[:, :2], motion, atol=1e-14)
        identity = np.broadcast_to(np.eye(3), (N, 3, 3))
        assert_allclose(
            rotations @ rotations.swapaxes(1, 2), identity, rtol=1e-13, atol=1e-13
        )
        assert_allclose(np.linalg.det(rotations), 1.0)
        assert (scales > 0).all()

    def test_frames_without_camera_are_nan(self):
        motion = frames_first(random_cameras()).copy()
        motion[2] = np.nan
        rotations, scales = full_rotations(motion)
        missing = np.arange(N) == 2
        assert_array_equal(np.isnan(rotations).all(axis=(1, 2)), missing)
        assert_array_equal(np.isnan(rotations).any(axis=(1, 2)), missing)
        assert_array_equal(np.isnan(scales), missing)


class TestMeanView:
    @pytest.mark.parametrize("unit", [1e-9, 1e9])
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
