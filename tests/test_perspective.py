"""Perspective cameras: tests by definition of geometry, fit and methods."""

from types import SimpleNamespace

import numpy as np
import pytest
from layers import Quick, slow_after, with_limits
from numpy.testing import assert_allclose, assert_array_equal
from refusals import refusals_of, refused, warned
from scenes import with_gaps
from scipy.spatial.transform import Rotation
from sklearn import config_context

from isa_nrsfm import AffineNRSfM
from isa_nrsfm.export import frame_points, frame_poses
from isa_nrsfm.io import load_model, save_model
from isa_nrsfm.metrics import mean_shape_error_3d

F, CENTRE = 1000.0, (640.0, 360.0)
PERSPECTIVE = {"camera": "perspective", "focal_length": F, "principal_point": CENTRE}
PERSPECTIVE |= {"random_state": 0}
WEAK = "The fit is that of weak-perspective cameras"
AllStarts = with_limits(error_steps=3)


def scene(
    seed=0,
    n_frames=40,
    yaw=25.0,
    distance=4.0,
    noise=0.0,
    spread=0.25,
    n_points=16,
    deformation=0.12,
):
    """Return images X of shapes S, of radius one with two basis shapes, and cameras."""
    rng = np.random.RandomState(seed)
    mean_shape = rng.standard_normal((n_points, 3)) * (0.6, 0.7, 0.5)
    basis = deformation * rng.standard_normal((2, n_points, 3))
    alpha = rng.standard_normal((n_frames, 2))
    S = mean_shape + np.tensordot(alpha, basis, 1)
    S -= S.mean(axis=1, keepdims=True)
    angles = rng.uniform(-1, 1, (n_frames, 3)) * (yaw, 0.6 * yaw, 0.5 * yaw)
    R = Rotation.from_euler("yxz", angles, degrees=True).as_matrix()
    z = distance * rng.uniform(0.85, 1.15, n_frames)
    xy = rng.uniform(-1, 1, (n_frames, 2)) * (spread, 0.6 * spread)
    T = np.column_stack([xy * z[:, None], z])
    X = S @ R.mT + T[:, None]
    w = F * X[..., :2] / X[..., 2:] + CENTRE
    size = np.sqrt(np.mean((w - w.mean(axis=1, keepdims=True)) ** 2))
    w += noise * size * rng.standard_normal(w.shape)
    X = w.reshape(n_frames, -1)
    return SimpleNamespace(X=X, S=S, R=R, T=T, noise=noise * size)


def fitted(X, kind=AffineNRSfM, **params):
    """Return a fit with perspective cameras."""
    return kind(**PERSPECTIVE | {"n_components": 2} | params).fit(X)


def frame_error(shapes, truth):
    """Return the mean error of shapes after a rotation and a scale for each frame.

    The mirror image is infinitely wrong.
    """
    turn, *_ = np.linalg.lstsq(shapes.reshape(-1, 3), truth.reshape(-1, 3))
    error = mean_shape_error_3d(truth, shapes, convention="frame")
    return error if np.linalg.det(turn) > 0 else np.inf


@pytest.fixture(scope="module")
def noisy():
    """A table with noise, its truth and its fit."""
    table = scene(n_frames=30, noise=0.005)
    table.model = fitted(table.X)
    return table


@pytest.mark.slow
@pytest.mark.parametrize(("seed", "size"), [(0, (25, 12)), (19, (40, 16))])
def test_without_noise_the_fit_is_exact(seed, size):
    n_frames, n_points = size
    s = scene(seed, n_frames, 40.0, 2.4 * (2.5 + 0.25 * seed), n_points=n_points)
    model = fitted(s.X, tol=1e-3)
    assert frame_error(model.reconstruct(s.X), s.S) < 1e-4
    turned = model.rotations_.mT @ s.R
    assert np.abs(turned - turned[0]).max() < 2e-3


def test_frames(noisy, tmp_path):
    X, S, T, noise, model = noisy.X, noisy.S, noisy.T, noisy.noise, noisy.model
    assert frame_error(model.reconstruct(X), S) < 0.01
    assert_array_equal(model.transform(X), model.alpha_)
    rest = model.reproject(X) - X
    assert 0.7 * noise < np.sqrt(np.mean(rest**2)) < noise
    images = model.inverse_transform(model.alpha_, model.motion_, model.translation_)
    assert_allclose(images, model.reproject(X))
    # Distances and directions, up to the unit of the shapes
    distance, true = (np.linalg.norm(v, axis=1) for v in (model.positions_, T))
    assert np.std(distance / true) < 0.03 * np.mean(distance / true)
    ray = np.vecdot(model.positions_, T) / distance / true
    assert ray.min() > 1.0 - 1e-5
    assert model.score(X) > -3e-4
    shapes, std = model.reconstruct(X, return_std=True)
    assert_allclose(shapes, model.reconstruct(X), atol=1e-3 * np.abs(shapes).max())
    assert 0.0 < std.min() < std.max() < 0.5
    assert model.diagnostics(X).outlier_share == 0.0
    deviations = np.sqrt(np.trace(model.rotation_covariance(X), axis1=1, axis2=2))
    assert 0.001 < deviations.mean() < 0.05
    motion = model.smooth(X).decomposition.motion
    assert_allclose(motion, model.motion_, rtol=0, atol=0.05 * motion.max())
    save_model(model, tmp_path / "model.npz")
    loaded = load_model(tmp_path / "model.npz")
    assert_array_equal(loaded.transform(X), model.alpha_)
    assert_array_equal(loaded.positions_, model.positions_)
    assert loaded.camera_ == "perspective"


@pytest.mark.slow
def test_perspective_decides_the_mirror_image(noisy):
    X, S, model = noisy.X, noisy.S, noisy.model
    assert model.mirror_certainty_ > 0.9
    assert frame_error(model.reconstruct(X), S) < 0.01
    refused("decides between the two mirror images", model.mirrored)


def same_model(model, other, rows=slice(None), tol=2e-3, turn=None):
    """Assert that fits have equal coefficients, and rotations but for a common one."""
    alpha = model.alpha_[rows]
    signs = np.sign(np.sum(alpha * other.alpha_, axis=0))
    assert_allclose(other.alpha_ * signs, alpha, atol=tol)
    R = model.rotations_[rows] if turn is None else turn @ model.rotations_[rows]
    common = other.rotations_.mT @ R
    assert_allclose(common, np.tile(common[0], (len(common), 1, 1)), atol=tol)


@pytest.mark.slow
def test_units_order_memory_maps_blocks_and_threads(noisy, tmp_path):
    X, model = noisy.X, fitted(noisy.X, AllStarts)
    order = np.random.RandomState(0).permutation(len(X))
    np.save(tmp_path / "X.npy", 10 * X[order])
    mapped = np.load(tmp_path / "X.npy", mmap_mode="r")
    options = {"focal_length": 10 * F, "principal_point": (6400, 3600)}
    with config_context(working_memory=0.1):
        other = fitted(mapped, AllStarts, n_jobs=2, **options)
    same_model(model, other, order)
    place, position = model.translation_[order], model.positions_[order]
    assert_allclose(other.translation_, 10 * place, rtol=1e-3)
    # Coordinates near the axis of the camera: errors are relative to the distance.
    assert_allclose(other.positions_, position, rtol=1e-3, atol=2e-4)


@pytest.mark.slow
def test_a_camera_that_turns_about_its_centre_and_flipped_images(noisy):
    X, model = noisy.X, noisy.model
    Q = Rotation.from_euler("xyz", (4, -6, 10), degrees=True).as_matrix()
    rays = np.pad((X.reshape(len(X), -1, 2) - CENTRE) / F, ((0, 0), (0, 0), (0, 1)))
    rays[..., 2] = 1.0
    turned = rays @ Q.T
    images = (turned[..., :2] / turned[..., 2:]).reshape(X.shape)
    other = fitted(images, focal_length=1.0, principal_point=(0, 0))
    same_model(model, other, tol=5e-3, turn=Q)
    # Images flipped left-right show an object that is flipped left-right
    tracks = X.reshape(len(X), -1, 2) * (-1, 1) + (2 * CENTRE[0], 0)
    other = fitted(tracks.reshape(X.shape))
    flipped = other.reconstruct(tracks.reshape(X.shape))
    assert frame_error(flipped * (-1, 1, 1), noisy.S) < 0.01


@pytest.mark.slow
def test_focal_length_is_estimated_where_points_are_missing(noisy):
    holes = with_gaps(noisy.X, 0.15)
    model = fitted(holes, focal_length=None)
    assert abs(model.focal_length_ / F - 1) < 0.03
    assert abs(model.focal_length_ - F) < 3 * model.focal_length_std_ < 0.1 * F
    assert frame_error(model.reconstruct(holes), noisy.S) < 0.012
    assert np.isfinite(model.reproject(holes)).all()
    assert_array_equal(model.transform(holes), model.alpha_)


def test_focal_length_is_estimated_within_its_deviation():
    X = scene(1, 12, 40.0, n_points=10, deformation=0.01).X
    model = fitted(X, Quick, focal_length=None, n_components=1, tol=1.0)
    assert abs(model.focal_length_ - F) < 3 * model.focal_length_std_ < 0.1 * F


@pytest.mark.parametrize(
    ("kind", "tol"), slow_after(1, [("far", 0.02), ("noisy", 2e-3)])
)
def test_focal_lengths_of_frames(request, kind, tol):
    table = request.getfixturevalue(kind)
    X, f = table.X, F * np.linspace(0.8, 1.25, len(table.X))
    tracks = X.reshape(len(X), -1, 2) - CENTRE
    zoomed = (tracks * (f / F)[:, None, None] + CENTRE).reshape(X.shape)
    lens = WEAK_LENS if kind == "far" else {}
    other = fitted(zoomed, **lens | {"focal_length": f})
    assert_array_equal(other.focal_length_, f)
    same_model(table.model, other, tol=tol)
    assert_allclose(other.reproject(zoomed), zoomed, atol=6.0)
    refused("one for each of the 5 rows", other.transform, zoomed[:5])


@pytest.mark.slow
def test_tables_without_perspective_say_so():
    s = scene(n_frames=25, noise=0.005)
    X, S, R = s.X, s.S, s.R
    flat = 100 * (S @ R[:, :2].mT)
    flat += np.random.RandomState(1).uniform(-300, 300, (len(X), 1, 2)) + CENTRE
    flat += 0.3 * np.random.RandomState(2).standard_normal(flat.shape)
    flat = flat.reshape(X.shape)
    model = warned("no perspective was found", fitted, flat, focal_length=None)
    assert np.isinf(model.focal_length_)
    assert np.isnan(model.positions_).all()
    shapes = model.reconstruct(flat)
    assert min(frame_error(shapes * (1, 1, z), S) for z in (-1, 1)) < 0.02


@pytest.mark.slow
@pytest.mark.parametrize("refinement", ["joint", "consensus"])
def test_bodies_that_turn_round(refinement):
    s = scene(1, 60, 180.0, 5.0, 0.002, n_points=14, deformation=0.3)
    model = fitted(s.X, refinement=refinement)
    assert model.camera_ == "perspective"
    given = {"camera": "weak_perspective", "refinement": refinement}
    weak = fitted(s.X, **given)
    ours, theirs = (each.reconstruct(s.X) for each in (model, weak))
    assert frame_error(ours, s.S) < 0.003
    error = min(frame_error(theirs * (1, 1, z), s.S) for z in (-1, 1))
    assert 0.05 < error < 2 * weak.depth_uncertainty_


@pytest.mark.slow
def test_perspective_that_held_out_points_do_not_prefer_is_not_taken():
    s = scene(distance=200.0, noise=0.02)
    given = {"focal_length": 0.1 * F}
    model = warned(WEAK, fitted, s.X, **given)
    weak = fitted(s.X, camera="weak_perspective", **given)
    assert model.camera_ == "weak_perspective"
    for name in ("alpha_", "motion_", "rotations_", "positions_"):
        assert_array_equal(getattr(model, name), getattr(weak, name))


WEAK_LENS = {"camera": "weak_perspective", "focal_length": F}


@pytest.fixture(scope="module")
def far():
    """A table of distant objects at the sides of images, and its fit."""
    table = scene(n_frames=16, distance=60.0, noise=0.002, spread=0.4)
    table.model = fitted(table.X, **WEAK_LENS)
    return table


def test_axes_of_the_camera(far):
    X, R, model = far.X, far.R, far.model
    none = {"focal_length": None, "principal_point": None}
    plain = fitted(X, **WEAK_LENS | none)
    assert_array_equal(model.alpha_, plain.alpha_)
    assert_array_equal(model.transform(X), plain.transform(X))
    assert_array_equal(model.reproject(X), plain.reproject(X))

    def spread_of(rotations):
        """Return the least RMS distance of turns to a common one, in degrees."""
        turns = Rotation.from_matrix(rotations.mT @ R)
        return np.degrees(
            np.sqrt(np.mean((turns.mean().inv() * turns).magnitude() ** 2))
        )

    by_ray, ours = (
        min(spread_of(each.rotations_) for each in (kind, kind.mirrored()))
        for kind in (plain, model)
    )
    assert ours < 0.3 * by_ray > 3.0
    assert (model.focal_length_, model.focal_length_std_) == (F, 0.0)
    # Positions, up to the unit
    ratio = model.positions_ / far.T
    assert_allclose(ratio, ratio[0, 2], rtol=0.1)


@pytest.mark.parametrize("mirrored", [False, True])
def test_results_in_the_axes_of_the_camera(far, mirrored, tmp_path):
    X, model = far.X, far.model.mirrored() if mirrored else far.model
    shapes, turned = model.reconstruct(X), model.reconstruct(X, axes="camera")
    R, scales = model.rotations_, model.scales_[:, None, None]
    assert_allclose(turned @ R, shapes, atol=1e-12)
    assert_allclose(np.linalg.det(R), 1.0)
    both = model.reconstruct(X, axes="camera", return_std=True)
    assert_allclose(both[0], turned, atol=1e-12)
    points = frame_points(model, X)
    z = points.position[..., 2] - points.position[..., 2].mean(axis=1, keepdims=True)
    centred = turned[..., 2] - turned[..., 2].mean(axis=1, keepdims=True)
    assert_allclose(z, scales[..., 0] * centred, atol=1e-9)
    assert_allclose(points.position_std[..., 2], scales[..., 0] * both[1])
    fit = model.decompose(X)
    same = model.shapes(fit.alpha) @ R.mT
    assert_allclose(model.reconstruct(fit, axes="camera"), same, atol=1e-12)
    poses = frame_poses(model, X)
    assert_allclose(frame_poses(model).yaw, poses.yaw)
    save_model(model, tmp_path / "model.npz")
    loaded = load_model(tmp_path / "model.npz")
    assert_array_equal(loaded.reconstruct(X, axes="camera"), turned)
    assert_array_equal(frame_poses(loaded, X).pitch, poses.pitch)


test_refusals = refusals_of("perspective", globals())
