import numpy as np
import pytest
from cameras import affinity, lorentz_cameras, weak_perspective
from numpy.testing import assert_allclose
from refusals import refused
from scipy.spatial.transform import Rotation

from isa_nrsfm.plotting._views import viewing_transform


@pytest.mark.parametrize("seed", range(5))
def test_weak_perspective_cameras_give_the_shape_up_to_a_rotation(seed):
    rng = np.random.default_rng(seed)
    A = affinity(rng)
    motion = weak_perspective(rng) @ np.linalg.inv(A)
    T = viewing_transform(motion, motion.mean(axis=0))

    from_truth = T @ A
    scale = np.cbrt(abs(np.linalg.det(from_truth)))
    assert_allclose(from_truth @ from_truth.T / scale**2, np.eye(3), atol=1e-8)
    assert np.linalg.det(T) > 0
    # In the viewing frame the cameras are scaled rows of rotations.
    cameras = motion @ np.linalg.inv(T)
    grams = cameras @ cameras.transpose(0, 2, 1)
    assert_allclose(grams, np.einsum("i,ab->iab", grams[:, 0, 0], np.eye(2)), atol=1e-8)


def test_the_front_view_is_the_reference_camera():
    rng = np.random.default_rng(1)
    A = affinity(rng)
    motion = weak_perspective(rng) @ np.linalg.inv(A)
    for reference in motion[:3]:
        in_view = reference @ np.linalg.inv(viewing_transform(motion, reference))
        assert_allclose(in_view / in_view[0, 0], np.eye(2, 3), atol=1e-8)
        assert in_view[0, 0] > 0


def test_the_scale_is_that_of_the_median_camera():
    scales = [1.0, 2.0, 3.0, 100.0, 3.0]
    motion = weak_perspective(np.random.default_rng(2), 5, scales)
    T = viewing_transform(motion, motion.mean(axis=0))
    assert_allclose(T @ T.T, 9 * np.eye(3), atol=1e-7)


def test_cameras_that_say_nothing_about_depth():
    same = np.repeat(np.random.default_rng(6).standard_normal((1, 2, 3)), 10, axis=0)
    assert np.isfinite(viewing_transform(same, same[0])).all()


def test_without_a_metric_the_mean_camera_is_made_isotropic():
    motion = lorentz_cameras(np.random.default_rng(7))
    T = viewing_transform(motion, motion[0])
    unit = motion / np.linalg.norm(motion, axis=(1, 2), keepdims=True)
    rows = (unit @ np.linalg.inv(T)).reshape(-1, 3)
    second = rows.T @ rows
    assert_allclose(second / second[0, 0], np.eye(3), atol=1e-8)


@pytest.mark.parametrize("seed", range(3))
def test_a_turntable_is_seen_upright_from_its_broad_side(seed):
    rng = np.random.default_rng(seed)
    turns = Rotation.from_euler("y", 2 * np.pi * np.arange(40)[:, None] / 40)
    # Points with y down, broad along a direction between x and z; white coordinates.
    points = rng.standard_normal((50, 3)) * [3, 5, 1]
    points = (points - points.mean(axis=0)) @ Rotation.from_euler("y", 1).as_matrix()
    whiten = np.linalg.inv(np.linalg.cholesky(points.T @ points / 50))
    rotation = np.linalg.qr(rng.standard_normal((3, 3)))[0]
    white = points @ whiten.T @ rotation
    motion = turns.as_matrix()[:, :2] @ np.linalg.inv(whiten) @ rotation
    T = viewing_transform(motion, np.eye(2, 3))

    seen = white @ T.T
    assert_allclose(seen[:, 1], points[:, 1], atol=1e-8)
    assert seen[:, 0].std() > 2 * seen[:, 2].std()
    assert_allclose(seen @ seen.T, points @ points.T, atol=1e-7)
    assert np.linalg.det(T) > 0


def test_frames_without_camera_are_left_out():
    rng = np.random.default_rng(9)
    motion = weak_perspective(rng) @ np.linalg.inv(affinity(rng))
    reference = motion.mean(axis=0)
    more = np.concatenate([motion, np.full((2, 2, 3), np.nan), np.zeros((1, 2, 3))])
    expected = viewing_transform(motion, reference)
    assert_allclose(viewing_transform(more, reference), expected)
    refused("none among the 3 cameras", viewing_transform, more[-3:], reference)
