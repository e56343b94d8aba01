"""From affine to Euclidean space: metric upgrades of rigid and of deforming shapes."""

import numpy as np
import pytest
from cameras import lorentz_cameras
from layers import slow_after
from numpy.testing import assert_allclose
from refusals import refused, warned
from scenes import face_model, faces
from scipy.linalg import expm
from scipy.spatial.transform import Rotation

from isa_nrsfm.calibration import (
    deformation_metric,
    euclidean_frames,
    euclidean_shapes,
    metric_upgrade,
)
from isa_nrsfm.metrics import mean_shape_error_3d

CAMERAS = ["orthographic", "weak_perspective"]
both_cameras = pytest.mark.parametrize("camera", CAMERAS)
MIRROR = np.diag([1.0, 1.0, -1.0])


def affinity_of(rng, *stretch):
    left, right = (np.linalg.qr(rng.standard_normal((3, 3)))[0] for _ in "ab")
    return left @ np.diag(stretch) @ right


def scene(seed, camera, n_frames=20, spread=None, stretch=(0.2, 1.0, 3.0)):
    """Return affine cameras, their rotations and scales, and the affinity of space."""
    rng = np.random.default_rng(seed)
    turns = Rotation.random(n_frames, random_state=seed).as_matrix()
    if spread is not None:
        vectors = spread * rng.standard_normal((n_frames, 3))
        turns = Rotation.from_rotvec(vectors).as_matrix()
    scales = np.full(n_frames, 1.7)
    if camera == "weak_perspective":
        scales = rng.uniform(0.2, 5, n_frames)
    affinity = affinity_of(rng, *stretch)
    motion = scales[:, None, None] * turns[:, :2] @ affinity
    return motion, turns, scales, affinity


class TestMetricUpgrade:
    @both_cameras
    @pytest.mark.parametrize("seed", range(5))
    @pytest.mark.parametrize("stretch", [(1, 1, 1), (0.2, 1, 3), (1, 1, 300)])
    def test_exact_cameras(self, camera, seed, stretch):
        motion, turns, scales, affinity = scene(seed, camera, stretch=stretch)
        upgrade = metric_upgrade(motion, camera)
        size = np.sqrt(np.mean(scales**2))
        # What is left of the affinity is an orthogonal matrix and the unit of length.
        rest = size * affinity @ upgrade.Q
        assert_allclose(rest @ rest.T, np.eye(3), atol=1e-8)
        sign = np.diag([1.0, 1.0, np.linalg.det(rest)])
        assert_allclose(upgrade.rotations, sign @ turns @ rest, atol=1e-8)
        assert_allclose(upgrade.scales, scales / size, rtol=1e-8)
        assert upgrade.residual < 1e-8
        seen = upgrade.scales[:, None, None] * upgrade.rotations[:, :2]
        assert_allclose(motion @ upgrade.Q, seen, atol=1e-8 * np.abs(seen).max())

    @both_cameras
    def test_which_of_the_equivalent_matrices(self, camera):
        motion, *_ = scene(1, camera)
        motion += 0.1 * np.random.default_rng(1).standard_normal(motion.shape)
        upgrade = metric_upgrade(motion, camera)
        assert_allclose(upgrade.Q, upgrade.Q.T, atol=1e-14)
        assert np.linalg.eigvalsh(upgrade.Q)[0] > 0
        R = upgrade.rotations
        assert_allclose(R @ R.transpose(0, 2, 1) - np.eye(3), 0, atol=1e-12)
        assert_allclose(np.linalg.det(R), 1)
        assert np.sqrt(np.mean(upgrade.scales**2)) == pytest.approx(1, rel=1e-9)
        # The rotation is the nearest one.
        inner = R[:, :2] @ (motion @ upgrade.Q).transpose(0, 2, 1)
        assert_allclose(inner, inner.transpose(0, 2, 1), atol=1e-12)
        if camera == "orthographic":
            assert (upgrade.scales == 1).all()

    @both_cameras
    def test_mirror_image_fits_as_well(self, camera):
        motion, *_ = scene(2, camera)
        motion += 0.1 * np.random.default_rng(2).standard_normal(motion.shape)
        upgrade = metric_upgrade(motion, camera)
        other = upgrade.mirrored()
        assert np.linalg.det(upgrade.Q) > 0 > np.linalg.det(other.Q)
        assert_allclose(np.linalg.det(other.rotations), 1)
        pair = upgrade, other
        images = (u.scales[:, None, None] * u.rotations[:, :2] for u in pair)
        rest = (motion @ u.Q - image for u, image in zip(pair, images, strict=True))
        distance = [np.linalg.norm(each) for each in rest]
        assert distance[0] == pytest.approx(distance[1], rel=1e-12)
        shape = np.random.default_rng(0).standard_normal((9, 3))
        expected = euclidean_shapes(shape, upgrade.Q) @ MIRROR
        assert_allclose(euclidean_shapes(shape, other.Q), expected)
        again = other.mirrored()
        assert_allclose(again.Q, upgrade.Q)
        assert_allclose(again.rotations, upgrade.rotations)

    @both_cameras
    def test_residual(self, camera):
        motion, *_ = scene(3, camera)
        motion += 0.1 * np.random.default_rng(3).standard_normal(motion.shape)
        upgrade = metric_upgrade(motion, camera)
        s1, s2 = np.linalg.svd(motion @ upgrade.Q, compute_uv=False).T
        if camera == "weak_perspective":
            norms = (s1**2 - s2**2) / (s1**2 + s2**2)
            expected = np.sqrt(np.mean(norms**2))
        else:
            # The scale that fits the products of the rows best.
            g = np.sum(s1**2 + s2**2) / np.sum(s1**4 + s2**4)
            expected = np.sqrt(np.mean((g * s1**2 - 1) ** 2 + (g * s2**2 - 1) ** 2))
        assert upgrade.residual == pytest.approx(expected, rel=1e-6)

    @both_cameras
    def test_leaves_out_frames_without_camera(self, camera):
        motion, *_ = scene(7, camera)
        whole = np.full((23, 2, 3), np.nan)
        whole[1:21], whole[22] = motion, 0.0
        one, two = metric_upgrade(motion, camera), metric_upgrade(whole, camera)
        assert_allclose(two.Q, one.Q, rtol=1e-12)
        for parts in ("rotations", "scales"):
            found = getattr(two, parts)
            assert_allclose(found[1:21], getattr(one, parts), rtol=1e-12)
            assert np.isnan(found[[0, 21, 22]]).all()


class TestDegenerateCameras:
    @both_cameras
    def test_condition_number_grows_as_rotations_shrink(self, camera):
        # As the square of the inverse angle.
        conditions = []
        for angle in (0.2, 0.02, 0.002):
            motion, *_ = scene(0, camera, n_frames=200, spread=angle, stretch=(1, 1, 1))
            if angle > 0.1:
                upgrade = metric_upgrade(motion, camera)
            else:
                upgrade = warned("condition number is", metric_upgrade, motion, camera)
            conditions.append(upgrade.condition_number)
        assert conditions[0] < 50 < 500 < conditions[1]
        assert conditions[2] / conditions[1] == pytest.approx(100, rel=0.05)

    @both_cameras
    def test_two_cameras_are_not_enough(self, camera):
        motion, *_ = scene(1, camera, n_frames=2)
        upgrade = warned("hardly determine", metric_upgrade, motion, camera)
        assert upgrade.condition_number > 1e6
        assert np.isfinite(upgrade.Q).all()

    def test_no_scaled_rotations_in_any_metric(self, rng):
        upgrade = warned("condition number", metric_upgrade, lorentz_cameras(rng))
        assert upgrade.residual > 0.1
        assert np.isfinite(upgrade.rotations).all()

    @pytest.mark.parametrize(
        ("motion", "camera", "message"),
        [
            (np.ones((4, 3, 3)), "orthographic", r"2, 3\); got \(4, 3, 3\)"),
            (np.ones((0, 2, 3)), "orthographic", r"2, 3\); got \(0, 2, 3\)"),
            (np.full((4, 2, 3), np.inf), "orthographic", "infinite; 24 entries"),
            (np.zeros((4, 2, 3)), "orthographic", "the 0 usable cameras see 0"),
            (np.ones((4, 2, 3)), "weak_perspective", "the 4 usable cameras see 1"),
            (np.ones((4, 2, 3)), "perspective", "must be one of .*'perspective'"),
        ],
    )
    def test_refuses(self, motion, camera, message):
        refused(message, metric_upgrade, motion, camera)


class TestEuclideanShapes:
    def test_images_stay_what_they_are(self, rng):
        motion, *_ = scene(0, "weak_perspective")
        mean, basis = rng.standard_normal((9, 3)), rng.standard_normal((2, 9, 3))
        Q = metric_upgrade(motion).Q
        for shapes in (mean, basis):
            upgraded = euclidean_shapes(shapes, Q)
            assert upgraded.shape == shapes.shape
            images = [shapes @ M.T for M in motion]
            assert_allclose([upgraded @ (M @ Q).T for M in motion], images, atol=1e-9)

    @pytest.mark.parametrize(
        ("shapes", "Q", "message"),
        [
            (np.ones((4, 2)), np.eye(3), r"n_points, 3\); got \(4, 2\)"),
            (np.ones(3), np.eye(3), r"n_points, 3\); got \(3,\)"),
            (np.ones((4, 3)), np.eye(2), r"not singular; got \(2, 2\)"),
            (np.ones((4, 3)), np.ones((3, 3)), "not singular; got a singular one"),
        ],
    )
    def test_refuses(self, shapes, Q, message):
        refused(message, euclidean_shapes, shapes, Q)


def strained_scene(seed, n_frames=40, n_components=2, size=0.2, noise=0.0):
    """Return cameras whose metric changes with the coefficients, and its truth."""
    rng = np.random.default_rng(seed)
    turns = Rotation.random(n_frames, random_state=seed).as_matrix()
    scales = rng.uniform(0.5, 2, n_frames)
    alpha = rng.standard_normal((n_frames, n_components))
    root = size * rng.standard_normal((n_components, 3, 3))
    strain = root + root.transpose(0, 2, 1)
    strain -= np.trace(strain, axis1=1, axis2=2)[:, None, None] / 3 * np.eye(3)
    Q = affinity_of(rng, 0.5, 1, 2)
    Q = Q @ Q.T
    Q_i = np.array([Q @ expm(np.tensordot(a, strain, 1) / 2) for a in alpha])
    motion = scales[:, None, None] * turns[:, :2] @ np.linalg.inv(Q_i)
    motion += noise * rng.standard_normal(motion.shape)
    return motion, alpha, Q, strain, scales, Q_i


class TestDeformationMetric:
    @pytest.mark.parametrize("seed", range(5))
    def test_exact_cameras(self, seed):
        motion, alpha, Q, strain, *_ = strained_scene(seed)
        metric = deformation_metric(motion, alpha)
        assert_allclose(metric.Q / np.trace(metric.Q), Q / np.trace(Q), atol=1e-8)
        assert_allclose(metric.strain, strain, atol=1e-7)
        assert metric.residual < 1e-8

    def test_without_strain_it_is_the_metric_upgrade(self):
        motion, *_ = scene(0, "weak_perspective")
        alpha = np.random.default_rng(0).standard_normal((20, 3))
        metric, upgrade = deformation_metric(motion, alpha), metric_upgrade(motion)
        assert_allclose(metric.Q, upgrade.Q, rtol=1e-7)
        assert_allclose(metric.strain, 0, atol=1e-7)
        assert metric.condition_number == pytest.approx(upgrade.condition_number)

    def test_noise_of_the_cameras_makes_no_strain(self):
        # Without a price the strains would be about noise / sqrt(frames) in size.
        motion, _, _, affinity = scene(1, "weak_perspective", n_frames=60)
        rng = np.random.default_rng(1)
        size = np.linalg.norm(motion, axis=(1, 2))[:, None, None]
        motion += 0.1 * size * rng.standard_normal(motion.shape) @ affinity
        metric = deformation_metric(motion, rng.standard_normal((60, 10)))
        assert metric.residual > 0.9 * metric_upgrade(motion).residual
        assert np.sqrt(np.mean(metric.strain**2)) < 0.01

    def test_noise_does_not_hide_the_strain(self):
        motion, alpha, _, strain, *_ = strained_scene(2, n_frames=400, noise=0.02)
        assert_allclose(deformation_metric(motion, alpha).strain, strain, atol=0.03)

    def test_leaves_out_frames_without_camera(self):
        motion, alpha, *_ = strained_scene(6)
        more = np.concatenate([motion, np.full((2, 2, 3), np.nan)])
        with_nan = np.concatenate([alpha, np.full((2, 2), np.nan)])
        one, two = deformation_metric(motion, alpha), deformation_metric(more, with_nan)
        for a, b in zip(one, two, strict=True):
            assert_allclose(a, b, rtol=1e-12)

    def test_refuses(self):
        motion, alpha, *_ = strained_scene(0)
        message = r"\(40, n_components\).*got \(39, 2\)"
        refused(message, deformation_metric, motion, alpha[:-1])


class TestEuclideanFrames:
    @pytest.fixture
    def fitted(self):
        """A metric, cameras, coefficients, mean and basis shapes that fit no better."""
        motion, alpha, *_ = strained_scene(0, noise=0.05)
        rng = np.random.default_rng(1)
        mean, basis = rng.standard_normal((9, 3)), 0.2 * rng.standard_normal((2, 9, 3))
        metric = deformation_metric(motion, alpha)
        assert metric.residual > 0.01
        return metric, motion, alpha, mean, basis

    def test_images_are_those_of_the_affine_cameras(self, fitted):
        _, motion, alpha, mean, basis = fitted
        frames = euclidean_frames(*fitted)
        affine = mean + np.tensordot(alpha, basis, 1)
        rows = frames.rotations[:, :2].transpose(0, 2, 1)
        images = frames.scales[:, None, None] * (frames.shapes @ rows)
        assert_allclose(images, affine @ motion.transpose(0, 2, 1), atol=1e-12)
        R = frames.rotations
        assert_allclose(R @ R.transpose(0, 2, 1) - np.eye(3), 0, atol=1e-12)
        assert_allclose(np.linalg.det(R), 1)

    def test_shapes_are_turned_to_the_mean_shape(self, fitted):
        # By an orthogonal Procrustes problem: the inner product is symmetric, and
        # positive definite but for the mirror image.
        metric, _, _, mean, _ = fitted
        frames = euclidean_frames(*fitted)
        target = mean @ np.linalg.inv(metric.Q).T
        inner = frames.shapes.transpose(0, 2, 1) @ (target - target.mean(axis=0))
        assert_allclose(inner, inner.transpose(0, 2, 1), atol=1e-10)
        values = np.linalg.eigvalsh(inner)
        assert (values[:, 1:] > 0).all()
        assert (values[:, 0] + values[:, 1] > 0).all()

    def test_exact_cameras_give_the_shapes_in_their_metric(self):
        motion, alpha, _, _, scales, Q_i = strained_scene(1, size=0.1)
        rng = np.random.default_rng(1)
        mean, basis = rng.standard_normal((9, 3)), 0.2 * rng.standard_normal((2, 9, 3))
        metric = deformation_metric(motion, alpha)
        frames = euclidean_frames(metric, motion, alpha, mean, basis)
        affine = mean + np.tensordot(alpha, basis, 1)
        true = affine @ np.linalg.inv(Q_i).transpose(0, 2, 1)
        assert mean_shape_error_3d(true, frames.shapes, convention="frame") < 1e-7
        unit = scales / np.sqrt(np.mean(scales**2))
        assert_allclose(frames.scales / unit, frames.scales[0] / unit[0], rtol=1e-7)

    def test_frames_without_camera_are_nan(self, fitted):
        metric, motion, alpha, mean, basis = fitted
        motion, alpha = motion.copy(), alpha.copy()
        motion[2], alpha[2], motion[5] = np.nan, np.nan, 0.0
        frames = euclidean_frames(metric, motion, alpha, mean, basis)
        for part in frames:
            bad = np.isnan(part.reshape(40, -1))
            assert bad[[2, 5]].all()
            assert not np.delete(bad, [2, 5], axis=0).any()

    def test_unusual_coefficients_do_not_stretch_space_without_limit(self, fitted):
        # Shapes that are the mean shape, whatever the coefficients: what is left of
        # the strain is seen in directions across the image, where no camera mends it.
        metric, motion, alpha, mean, basis = fitted
        for factor in (10.0, 1000.0):
            frames = euclidean_frames(metric, motion, factor * alpha, mean, 0 * basis)
            common = mean @ np.linalg.inv(metric.Q).T
            depth = frames.rotations[:, 2:].transpose(0, 2, 1)
            seen = np.linalg.norm(frames.shapes @ depth, axis=(1, 2))
            least, largest = np.linalg.svd(common, compute_uv=False)[[2, 0]]
            assert (seen > np.exp(-0.5) * least * (1 - 1e-9)).all()
            assert (seen < np.exp(0.5) * largest * (1 + 1e-9)).all()

    @pytest.mark.parametrize(
        ("index", "value", "message"),
        [
            (1, np.ones((4, 2)), r"motion .* \(n_frames, 2, 3\); got \(4, 2\)"),
            (2, np.ones((40, 3)), r"alpha .* \(40, 2\).*got \(40, 3\)"),
            (3, np.ones((9, 2)), r"mean_shape .* got \(9, 2\)"),
            (4, np.ones((2, 8, 3)), r"basis .* \(2, 9, 3\).*got \(2, 8, 3\)"),
        ],
    )
    def test_refuses(self, fitted, index, value, message):
        arguments = list(fitted)
        arguments[index] = value
        refused(message, euclidean_frames, *arguments)


@pytest.mark.parametrize("camera", slow_after(1, CAMERAS[::-1]))
def test_models_with_calibrated_cameras_have_a_metric(camera, recwarn):
    model = face_model(camera=camera)
    metric = deformation_metric(model.motion_, model.alpha_)
    scale = np.trace(metric.Q) / 3
    assert_allclose(metric.Q, scale * np.eye(3), atol=1e-6 * scale)
    assert_allclose(metric.strain, 0.0, atol=1e-6)
    assert metric.residual < 1e-10
    assert len(recwarn) == 0
    fit = model.motion_, model.alpha_, model.mean_shape_, model.basis_
    frames = euclidean_frames(metric, *fit)
    shapes = model.reconstruct(faces().data)
    assert mean_shape_error_3d(shapes, frames.shapes, convention="frame") < 1e-6
