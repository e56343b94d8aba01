"""From affine to Euclidean space: metrics, cameras, poses, shapes of estimators."""

from itertools import combinations

import numpy as np
import pytest
from cameras import affinity, lorentz_cameras, rotations, weak_perspective
from made_once import made_once
from numpy.testing import assert_allclose, assert_array_equal
from refusals import refusals_of, warned
from scenes import measurements, random_rotation
from scipy.linalg import expm
from scipy.optimize import approx_fprime, minimize
from scipy.spatial.transform import Rotation

from isa_nrsfm import AffineNRSfM
from isa_nrsfm.calibration import (
    angle_deviations,
    canonical_pose,
    deformation_metric,
    euclidean_frames,
    euclidean_shapes,  # noqa: F401  in refusals.txt
    metric_upgrade,
    orthonormal_cameras,
    view_angles,
)
from isa_nrsfm.datasets import make_face_tracks, make_nonrigid_tracks
from isa_nrsfm.metrics import mean_shape_error_3d

CAMERAS = ["orthographic", "weak_perspective"]
both_cameras = pytest.mark.parametrize("camera", CAMERAS)
MIRROR = np.diag([1.0, 1.0, -1.0])


def scene(seed, camera, n_frames=20, spread=None, stretch=(0.2, 1.0, 3.0)):
    """Return affine cameras, their rotations and scales, and the affinity of space."""
    rng = np.random.default_rng(seed)
    turns = Rotation.random(n_frames, random_state=seed).as_matrix()
    if spread is not None:
        turns = rotations(rng, n_frames, spread)
    scales = np.full(n_frames, 1.7)
    if camera == "weak_perspective":
        scales = rng.uniform(0.2, 5, n_frames)
    space = affinity(rng, *stretch)
    motion = scales[:, None, None] * turns[:, :2] @ space
    return motion, turns, scales, space


def assert_rotations(R):
    assert_allclose(R @ R.mT - np.eye(3), 0, atol=1e-12)
    assert_allclose(np.linalg.det(R), 1)


def frame_error(truth, shapes, scale=None):
    return mean_shape_error_3d(truth, shapes, convention="frame", scale=scale)


@both_cameras
class TestMetricUpgrade:
    @pytest.mark.parametrize("stretch", [(1, 1, 1), (1, 1, 300)])
    def test_exact_cameras(self, camera, stretch):
        motion, turns, scales, affinity = scene(0, camera, stretch=stretch)
        # Frames without a camera are left out.
        whole = np.full((23, 2, 3), np.nan)
        whole[0], whole[1:21] = 0.0, motion
        upgrade = metric_upgrade(whole, camera)
        found = upgrade.rotations[1:21], upgrade.scales[1:21]
        for part in (upgrade.rotations, upgrade.scales):
            assert np.isnan(part[[0, 21, 22]]).all()
        size = np.sqrt(np.mean(scales**2))
        # What is left of the affinity is an orthogonal matrix and the unit of length.
        rest = size * affinity @ upgrade.Q
        assert_allclose(rest @ rest.T, np.eye(3), atol=1e-8)
        sign = np.diag([1.0, 1.0, np.linalg.det(rest)])
        assert_allclose(found[0], sign @ turns @ rest, atol=1e-8)
        assert_allclose(found[1], scales / size, rtol=1e-8)
        assert upgrade.residual < 1e-8
        seen = found[1][:, None, None] * found[0][:, :2]
        assert_allclose(motion @ upgrade.Q, seen, atol=1e-8 * np.abs(seen).max())


def noisy_cameras(rng, n_frames=30):
    return weak_perspective(rng, n_frames) + 0.3 * rng.standard_normal((n_frames, 2, 3))


def cost(Q, motion, camera):
    """Return the sum of the squared residuals, by their definitions."""
    s1, s2 = np.linalg.svd(motion @ Q, compute_uv=False).T
    if camera == "orthographic":
        return np.sum((s1**2 - 1) ** 2 + (s2**2 - 1) ** 2)
    return np.sum(((s1**2 - s2**2) / (s1**2 + s2**2)) ** 2)


@both_cameras
def test_the_residual_is_the_least_of_all_metrics(camera):
    rng = np.random.default_rng(1)
    motion = noisy_cameras(rng) @ affinity(rng)
    upgrade = metric_upgrade(motion, camera)
    # Of all scales of an orthographic metric, that of the scales one is returned.
    scales = np.linspace(0.7, 1.4, 2001) if camera == "orthographic" else [1.0]
    costs = [cost(scale * upgrade.Q, motion, camera) for scale in scales]
    least, Q = min(costs), scales[np.argmin(costs)] * upgrade.Q
    assert_allclose(Q, Q.T, atol=1e-14)
    assert np.linalg.eigvalsh(Q)[0] > 0
    assert_rotations(upgrade.rotations)
    assert np.sqrt(np.mean(upgrade.scales**2)) == pytest.approx(1, rel=1e-9)
    assert camera == "weak_perspective" or (upgrade.scales == 1).all()
    # The rotations are the nearest ones.
    inner = upgrade.rotations[:, :2] @ (motion @ upgrade.Q).mT
    assert_allclose(inner, inner.mT, atol=1e-12)
    assert least > 0.1
    assert upgrade.residual == pytest.approx(np.sqrt(least / 30), rel=1e-5)
    for size in (1e-2, 1e-1):
        steps = size * rng.standard_normal((20, 3, 3))
        assert all(cost(Q @ (np.eye(3) + E), motion, camera) > least for E in steps)


@pytest.mark.filterwarnings("ignore:the cameras hardly determine")
def test_the_least_residual_where_the_linear_solution_is_indefinite():
    rng = np.random.default_rng(47)
    motion = rotations(rng, 6, 0.4)[:, :2] + 0.5 * rng.standard_normal((6, 2, 3))

    def value(entries):
        return cost(entries.reshape(3, 3), motion, "weak_perspective")

    least = min(minimize(value, rng.standard_normal(9)).fun for _ in range(6))
    assert 6 * metric_upgrade(motion).residual ** 2 <= least * (1 + 1e-6)


@both_cameras
def test_condition_number_grows_as_rotations_shrink(camera):
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


def test_no_scaled_rotations_in_any_metric(rng):
    upgrade = warned("condition number", metric_upgrade, lorentz_cameras(rng))
    assert upgrade.residual > 0.1
    assert np.isfinite(upgrade.rotations).all()


def strained_scene(seed, n_frames=40, n_components=2, size=0.2, noise=0.0):
    """Return cameras whose metric changes with the coefficients, and its truth."""
    rng = np.random.default_rng(seed)
    turns = Rotation.random(n_frames, random_state=seed).as_matrix()
    scales = rng.uniform(0.5, 2, n_frames)
    alpha = rng.standard_normal((n_frames, n_components))
    root = size * rng.standard_normal((n_components, 3, 3))
    strain = root + root.mT
    strain -= np.trace(strain, axis1=1, axis2=2)[:, None, None] / 3 * np.eye(3)
    Q = affinity(rng)
    Q = Q @ Q.T
    Q_i = np.array([Q @ expm(np.tensordot(a, strain, 1) / 2) for a in alpha])
    motion = scales[:, None, None] * turns[:, :2] @ np.linalg.inv(Q_i)
    motion += noise * rng.standard_normal(motion.shape)
    return motion, alpha, Q, strain


class TestDeformationMetric:
    def test_many_frames_may_have_any_order(self):
        motion, alpha, *_ = strained_scene(0, 2100, 1, noise=0.01)
        one, other = (
            deformation_metric(motion[::step], alpha[::step]) for step in (1, -1)
        )
        assert_allclose(other.strain, one.strain, atol=1e-8)

    def test_exact_cameras(self):
        motion, alpha, Q, strain = strained_scene(0)
        # Two frames without a camera are left out.
        motion = np.concatenate([motion, np.full((2, 2, 3), np.nan)])
        metric = deformation_metric(motion, np.pad(alpha, [(0, 2), (0, 0)]))
        assert_allclose(metric.Q / np.trace(metric.Q), Q / np.trace(Q), atol=1e-8)
        assert_allclose(metric.strain, strain, atol=1e-7)
        assert metric.residual < 1e-8

    def test_noise_of_the_cameras_makes_no_strain(self):
        # Without a price the strains would be about noise / sqrt(frames) in size.
        motion, _, _, affinity = scene(1, "weak_perspective", n_frames=60)
        rng = np.random.default_rng(1)
        size = np.linalg.norm(motion, axis=(1, 2))[:, None, None]
        motion += 0.1 * size * rng.standard_normal(motion.shape) @ affinity
        metric = deformation_metric(motion, rng.standard_normal((60, 10)))
        assert metric.residual > 0.9 * metric_upgrade(motion).residual
        assert np.sqrt(np.mean(metric.strain**2)) < 0.01


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

    def test_exact_cameras_show_the_shapes_in_their_metrics(self, fitted):
        *_, mean, basis = fitted
        motion, alpha, Q, strain = strained_scene(0, size=0.1)
        metric = deformation_metric(motion, alpha)
        shapes = euclidean_frames(metric, motion, alpha, mean, basis).shapes
        affine = mean + np.tensordot(alpha, basis, 1)
        space = [Q @ expm(np.tensordot(a, strain, 1) / 2) for a in alpha]
        assert frame_error(affine @ np.linalg.inv(space).mT, shapes) < 1e-7

    def test_images_are_those_of_the_affine_cameras(self, fitted):
        metric, motion, alpha, mean, basis = fitted
        frames = euclidean_frames(*fitted)
        rows = frames.scales[:, None, None] * frames.rotations[:, :2]
        affine = mean + np.tensordot(alpha, basis, 1)
        assert_allclose(frames.shapes @ rows.mT, affine @ motion.mT, atol=1e-12)
        assert_rotations(frames.rotations)
        # The shapes are turned to the mean shape.
        inner = (
            frames.shapes.mT @ (mean - mean.mean(axis=0)) @ np.linalg.inv(metric.Q).T
        )
        assert_allclose(inner, inner.mT, atol=1e-12)

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
            depth = frames.rotations[:, 2:].mT
            seen = np.linalg.norm(frames.shapes @ depth, axis=(1, 2))
            least, largest = np.linalg.svd(common, compute_uv=False)[[2, 0]]
            assert (seen > np.exp(-0.5) * least * (1 - 1e-9)).all()
            assert (seen < np.exp(0.5) * largest * (1 + 1e-9)).all()


def test_models_with_calibrated_cameras_have_a_metric():
    table = make_face_tracks(60, n_components=2, random_state=0).data
    options = {"camera": "weak_perspective", "refinement": None, "random_state": 0}
    model = AffineNRSfM(2, **options).fit(table)
    metric = deformation_metric(model.motion_, model.alpha_)
    scale = np.trace(metric.Q) / 3
    assert_allclose(metric.Q, scale * np.eye(3), atol=1e-6 * scale)
    assert_allclose(metric.strain, 0.0, atol=1e-6)
    assert metric.residual < 1e-10
    fit = model.motion_, model.alpha_, model.mean_shape_, model.basis_
    frames = euclidean_frames(metric, *fit)
    assert frame_error(model.shapes(model.alpha_), frames.shapes) < 1e-6


def deforming_scene(noise=0.0):
    """Return the left singular vectors times singular values, and true cameras."""
    options = {"camera": "orthographic", "noise": noise, "random_state": 0}
    truth = make_nonrigid_tracks(60, 40, 2, **options)
    W = measurements(truth.tracks, scale_frames=False)
    U, S, _ = np.linalg.svd(W, full_matrices=False)
    return U[:, :9] * S[:9], truth.motion


def cost_of(cameras):
    return np.mean(np.sum((cameras @ cameras.mT - np.eye(2)) ** 2, axis=(1, 2)))


class TestOrthonormalCameras:
    def test_are_found(self):
        P, cameras = deforming_scene()
        found = orthonormal_cameras(P)
        assert cost_of(found.cameras) < 1e-17
        # Without the orientation of space; the cost is of fourth order in some
        # directions.
        got, true = (each.reshape(-1, 3) for each in (found.cameras, cameras))
        assert_allclose(got @ got.T, true @ true.T, atol=2e-4)

    @pytest.mark.parametrize("noise_variance", [0.0, 1e-2])
    def test_is_a_minimum(self, noise_variance, rng):
        P, _ = deforming_scene(noise=0.02)
        found = orthonormal_cameras(P, noise_variance)
        assert_allclose(found.cameras.reshape(-1, 3), P @ found.mixing, atol=1e-10)
        if noise_variance == 0.0:
            assert found.cost == pytest.approx(cost_of(found.cameras))

        def cost(Q):
            price = 4 * noise_variance * np.sum(Q**2)
            return cost_of((P @ Q.reshape(-1, 3)).reshape(-1, 2, 3)) + price

        Q = found.mixing.ravel()
        least = cost(Q)
        assert np.abs(approx_fprime(Q, cost, 1e-7)).max() < 1e-5 * np.abs(P).max()
        sizes = np.abs(Q).max() * np.repeat([1e-3, 1e-2, 1e-1], 20)
        steps = (size * rng.normal(size=Q.shape) for size in sizes)
        assert all(cost(Q + step) > least for step in steps)

    def test_local_minimum_is_left(self, load_data):
        # From the first three columns alone the cost ends at 2e-4 and above.
        W = measurements(load_data("akhter_yoga")["W2d"], scale_frames=False)
        U = np.linalg.svd(W, full_matrices=False)[0]
        assert orthonormal_cameras(U[:, :6]).cost < 0.005
        assert orthonormal_cameras(U[:, :30]).cost < 3e-6


# The directions of `face`, by points: nose, chin, brow, eyes and ears.
LEFT_RIGHT, UP, FRONT = [[36, 45], [0, 16]], [[8, 27]], [[0, 30], [16, 30]]
POINTS = {"left_right": LEFT_RIGHT, "up": UP, "front": FRONT}


@made_once
def upright_face():
    """A face that looks at the viewer: x points right, y down, z away from it."""
    return make_face_tracks(n_frames=2, random_state=0).neutral_shape


class TestPoses:
    @pytest.mark.parametrize("mirror", [np.eye(3), MIRROR], ids=["same", "mirrored"])
    @pytest.mark.parametrize("options", [POINTS, {"scheme": "ibug-68"}])
    def test_turned_and_mirrored_shapes_agree(self, mirror, options):
        face, turn = upright_face(), random_rotation(0)
        given = face @ mirror @ turn.T
        pose = canonical_pose(given, **options)
        assert_allclose(pose.shape, canonical_pose(face, **options).shape, atol=1e-10)
        # The face is symmetric, and stands upright.
        assert_allclose(pose.rotation @ turn @ mirror, np.eye(3), atol=0.03)
        assert_allclose(pose.rotation[0], turn[:, 0], atol=1e-10)
        assert_allclose(pose.shape, given @ pose.rotation.T, atol=1e-10)
        assert np.linalg.det(pose.rotation) == pytest.approx(np.linalg.det(mirror))
        assert pose.mirrored == (mirror is MIRROR)

    def test_x_comes_before_y_and_y_before_z(self, rng):
        points = rng.standard_normal((5, 3))
        ways = {"left_right": points[1] - points[0]}
        ways |= {"up": np.array([1.0, 2.0, 0.5]), "front": np.array([0.0, 0.1, 1.0])}
        given = ways | {"left_right": [[0, 1]]}
        for names in (*combinations(ways, 2), tuple(ways)):
            R = canonical_pose(points, **{name: given[name] for name in names}).rotation
            seen = {name: R @ ways[name] for name in names}
            exact = np.array([0, -1, 0] if names[0] == "up" else [1, 0, 0])
            size = np.linalg.norm(ways[names[0]])
            assert_allclose(seen[names[0]], size * exact, atol=1e-12)
            if "up" in names:
                assert seen["up"][1] < 0
                assert seen["up"][2] == pytest.approx(0, abs=1e-12)
            assert "front" not in names or seen["front"][2] < 0


def test_nearest_principal_axes(rng):
    points = rng.standard_normal((200, 3)) * [1.0, 3.0, 2.0]
    turn = Rotation.from_rotvec(0.2 * rng.standard_normal(3)).as_matrix()
    upright = canonical_pose(points)
    pose = canonical_pose(points @ turn.T + 4.0)
    assert_allclose(pose.rotation @ turn, upright.rotation, atol=1e-9)
    assert np.linalg.det(pose.rotation) == pytest.approx(1)
    scatter = np.cov(pose.shape.T)
    assert_allclose(scatter, np.diag(np.diag(scatter)), atol=1e-8 * scatter.max())
    assert_array_equal(np.argsort(np.diag(scatter)), [0, 2, 1])
    assert not pose.mirrored


def rotation(yaw, pitch, roll):
    """Return a rotation from its definition, right-handed turns about three axes."""
    turns = (("z", roll), ("x", -pitch), ("y", -yaw))
    z, x, y = (Rotation.from_euler(*turn, degrees=True) for turn in turns)
    return (z * x * y).as_matrix()


def test_angles_of_their_definition(rng):
    wanted = rng.uniform([-180, -90, -180], [180, 90, 180], (50, 3))
    found = view_angles([rotation(*each) for each in wanted])
    assert_allclose(np.transpose(found), wanted, atol=1e-9)


def test_deviations_of_angles_are_those_of_random_small_turns(rng):
    R = Rotation.from_euler("ZXY", [20, -35, 50], degrees=True)
    root = 0.003 * rng.normal(size=(3, 3))
    turns = Rotation.from_rotvec(rng.normal(size=(20000, 3)) @ root.T)
    expected = np.std(np.array(view_angles((R * turns).as_matrix())), axis=1)
    found = angle_deviations(view_angles([R.as_matrix()]), [root @ root.T])
    assert_allclose(np.ravel(found), expected, rtol=0.03)


def test_exact_tables_give_exact_shapes():
    # Without noise, in cameras of one scale.
    options = {"camera": "orthographic", "amplitude": 0.2, "noise": 0}
    tracks = make_nonrigid_tracks(80, 40, 2, **options, random_state=0)
    model = AffineNRSfM(n_components=2, random_state=0).fit(tracks.data)
    weak = model.reconstruct(tracks.data, camera="weak_perspective")
    assert frame_error(tracks.shapes, weak) < 1e-4
    # Images with the unit of the shapes say how large they are, too.
    size = np.linalg.svd(tracks.motion, compute_uv=False)[0, 0]
    shapes = model.reconstruct(tracks.data, camera="orthographic") / size
    assert frame_error(tracks.shapes, shapes, scale=False) < 1e-4
    assert frame_error(tracks.shapes, model.reconstruct(tracks.data)) > 0.05


def test_reconstructed_shapes_are_those_of_the_calibration():
    options = {"n_components": 2, "camera": "orthographic", "random_state": 0}
    table = make_face_tracks(60, **options).data
    model = AffineNRSfM(2, refinement=None, random_state=0).fit(table)
    motion, translation, alpha, _ = model.decompose(table)
    metric = deformation_metric(model.motion_, model.alpha_)
    shapes = model.mean_shape_, model.basis_
    frames = euclidean_frames(metric, motion, alpha, *shapes)
    weak = model.reconstruct(table, camera="weak_perspective")
    assert_allclose(weak, frames.shapes)
    ortho = model.reconstruct(table, camera="orthographic")
    assert_allclose(ortho, frames.scales[:, None, None] * frames.shapes)
    # Cameras without scale see the orthographic shapes as the model does.
    images = ortho @ frames.rotations[:, :2].mT + translation[:, None]
    assert_allclose(images.reshape(table.shape), model.reproject(table), atol=1e-8)


test_refusals = refusals_of("calibration", globals())
