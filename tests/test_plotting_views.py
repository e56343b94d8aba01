import numpy as np
import pytest
from numpy.testing import assert_allclose
from scipy.spatial.transform import Rotation

from isa_nrsfm.plotting._views import (
    LARGEST_STRETCH,
    metric_quadric,
    viewing_transform,
)


def rotations(rng, n_frames, spread=0.6):
    return Rotation.from_rotvec(spread * rng.standard_normal((n_frames, 3))).as_matrix()


def affinity(rng):
    """A stretch between 1/2 and 2 with any axes and handedness."""
    left, right = (np.linalg.qr(rng.standard_normal((3, 3)))[0] for _ in "ab")
    return left @ np.diag([0.5, 1.0, 2.0]) @ right


def weak_perspective(rng, n_frames=30, scales=None):
    scales = rng.uniform(1, 5, n_frames) if scales is None else scales
    return np.asarray(scales)[:, None, None] * rotations(rng, n_frames)[:, :2]


def residuals(Q, motion):
    unit = motion / np.linalg.norm(motion, axis=(1, 2), keepdims=True)
    B = unit @ Q @ unit.transpose(0, 2, 1)
    return np.stack([B[:, 0, 0] - B[:, 1, 1], 2 * B[:, 0, 1]])


def mean_scale(Q, motion):
    unit = motion / np.linalg.norm(motion, axis=(1, 2), keepdims=True)
    return np.trace(np.mean(unit @ Q @ unit.transpose(0, 2, 1), axis=0))


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


def test_few_cameras_suffice():
    rng = np.random.default_rng(0)
    A = affinity(rng)
    motion = weak_perspective(rng, 3) @ np.linalg.inv(A)
    from_truth = viewing_transform(motion, motion[0]) @ A
    scale = np.cbrt(abs(np.linalg.det(from_truth)))
    assert_allclose(from_truth @ from_truth.T / scale**2, np.eye(3), atol=1e-8)


def test_the_front_view_is_the_reference_camera():
    rng = np.random.default_rng(1)
    A = affinity(rng)
    motion = weak_perspective(rng) @ np.linalg.inv(A)
    for reference in motion[:3]:
        in_view = reference @ np.linalg.inv(viewing_transform(motion, reference))
        assert_allclose(in_view / in_view[0, 0], np.eye(2, 3), atol=1e-8)
        assert in_view[0, 0] > 0


def test_the_scale_is_that_of_the_median_camera():
    rng = np.random.default_rng(2)
    scales = [1.0, 2.0, 3.0, 100.0, 3.0]
    motion = weak_perspective(rng, 5, scales)
    T = viewing_transform(motion, motion.mean(axis=0))
    assert_allclose(T @ T.T, 9 * np.eye(3), atol=1e-7)


def test_the_quadric_is_the_least_squares_solution():
    rng = np.random.default_rng(3)
    motion = weak_perspective(rng) + 0.3 * rng.standard_normal((30, 2, 3))
    Q = metric_quadric(motion)
    assert mean_scale(Q, motion) == pytest.approx(1)
    least = np.sum(residuals(Q, motion) ** 2)
    assert least > 1e-3
    for _ in range(50):
        step = rng.standard_normal((3, 3))
        other = Q + 1e-2 * np.linalg.norm(Q) * (step + step.T)
        other /= mean_scale(other, motion)
        assert np.sum(residuals(other, motion) ** 2) > least


def test_the_quadric_does_not_depend_on_roll_and_scale_of_the_frames():
    rng = np.random.default_rng(4)
    motion = weak_perspective(rng) + 0.3 * rng.standard_normal((30, 2, 3))
    angle = rng.uniform(0, 2 * np.pi, 30)
    roll = np.array([[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]])
    other = rng.uniform(0.1, 10, (30, 1, 1)) * (roll.transpose(2, 0, 1) @ motion)
    assert_allclose(metric_quadric(other), metric_quadric(motion), rtol=1e-9)


def test_little_depth_is_not_taken_for_none():
    # Faces that hardly turn: a solution that keeps the norm of Q constant, not the
    # size of the cameras, would let depth vanish.
    rng = np.random.default_rng(5)
    cameras = rotations(rng, 2000, spread=0.1)[:, :2]
    noise = 0.02 * rng.standard_normal(cameras.shape) * [1, 1, 0.1]
    T = viewing_transform(cameras + noise, cameras.mean(axis=0))
    assert_allclose(np.linalg.svd(T, compute_uv=False), 1, atol=0.2)


def test_cameras_that_say_nothing_about_depth_have_no_quadric():
    rng = np.random.default_rng(6)
    same = np.repeat(rng.standard_normal((1, 2, 3)), 10, axis=0)
    assert metric_quadric(same) is None
    assert metric_quadric(weak_perspective(rng, 2)) is None
    assert np.isfinite(viewing_transform(same, same[0])).all()


def lorentz_cameras(rng, n_frames=30):
    """Rows that are orthonormal in the metric diag(1, 1, -1), which is indefinite."""
    angle = rng.uniform(0, 2 * np.pi, n_frames)
    boost = 0.5 * rng.standard_normal(n_frames)
    turn = Rotation.from_euler("z", angle[:, None]).as_matrix()
    squeeze = np.zeros((n_frames, 3, 3))
    squeeze[:, 0, 0] = squeeze[:, 2, 2] = np.cosh(boost)
    squeeze[:, 0, 2] = squeeze[:, 2, 0] = np.sinh(boost)
    squeeze[:, 1, 1] = 1
    return (squeeze @ turn)[:, :2]


def test_indefinite_solutions_are_refused_and_the_mean_camera_made_isotropic():
    motion = lorentz_cameras(np.random.default_rng(7))
    assert metric_quadric(motion) is None
    T = viewing_transform(motion, motion[0])
    unit = motion / np.linalg.norm(motion, axis=(1, 2), keepdims=True)
    rows = (unit @ np.linalg.inv(T)).reshape(-1, 3)
    second = rows.T @ rows
    assert_allclose(second / second[0, 0], np.eye(3), atol=1e-8)


def test_extreme_stretches_are_refused():
    motion = weak_perspective(np.random.default_rng(8))
    for stretch, found in ((0.9 * LARGEST_STRETCH, True), (2 * LARGEST_STRETCH, False)):
        Q = metric_quadric(motion @ np.diag([1, 1, stretch]))
        assert (Q is not None) == found


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
    assert_allclose(
        viewing_transform(more, reference), viewing_transform(motion, reference)
    )
    with pytest.raises(ValueError, match="none among the 3 cameras"):
        viewing_transform(more[-3:], reference)


def test_true_proportions_of_faces(load_data):
    # Rigid factorisation of images of faces: the affinity is found, not given.
    data = load_data("ict_bu3dfe_like_68")
    W = data["W2d"] - data["W2d"].mean(axis=1, keepdims=True)
    U, s, Vt = np.linalg.svd(
        W.transpose(0, 2, 1).reshape(-1, W.shape[1]), full_matrices=False
    )
    shape = np.sqrt(W.shape[1]) * Vt[:3].T
    motion = (U[:, :3] * s[:3] / np.sqrt(W.shape[1])).reshape(-1, 2, 3)
    seen = shape @ viewing_transform(motion, motion.mean(axis=0)).T
    truth = (data["S3d"] - data["S3d"].mean(axis=1, keepdims=True)).mean(axis=0)
    assert_allclose(
        np.linalg.svd(seen, compute_uv=False),
        np.linalg.svd(truth, compute_uv=False),
        rtol=0.03,
    )
