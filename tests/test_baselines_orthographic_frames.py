"""Orthographic camera and coefficients of single frames for given shapes."""

import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal
from scenes import random_rotation
from scipy.optimize import approx_fprime
from scipy.spatial.transform import Rotation

from isa_nrsfm._frames.projection import compose
from isa_nrsfm.baselines import _orthographic_frames
from isa_nrsfm.baselines._orthographic_frames import OrthographicFrames

N_COMPONENTS, N_POINTS, N_FRAMES = 3, 20, 15


def model(noise_variance=1e-12, depth=1.0):
    rng = np.random.default_rng(0)
    shapes = rng.normal(size=(N_COMPONENTS + 1, N_POINTS, 3)) * [1.0, 1.0, depth]
    shapes -= shapes.mean(axis=1, keepdims=True)
    return OrthographicFrames(shapes[0], 0.15 * shapes[1:], noise_variance)


def frames(given, noise=0.0, n_frames=N_FRAMES):
    """Return tracks of random frames, with their cameras and coefficients."""
    rng = np.random.default_rng(1)
    cameras = Rotation.random(n_frames, rng).as_matrix()[:, :2]
    alpha = rng.normal(size=(n_frames, N_COMPONENTS))
    tracks = compose(given.mean_shape, given.basis, alpha) @ cameras.swapaxes(1, 2)
    tracks += noise * rng.normal(size=tracks.shape)
    return tracks - tracks.mean(axis=1, keepdims=True), cameras, alpha


def cost(given, track, camera, alpha):
    """Return the cost of a frame, by its definition."""
    rest = track - compose(given.mean_shape, given.basis, alpha) @ camera.T
    return np.sum(rest**2) + given.noise_variance * np.sum(alpha**2)


def turned(camera, vector):
    return camera @ Rotation.from_rotvec(vector).as_matrix()


def test_exact_frames_are_found():
    given = model()
    tracks, cameras, alpha = frames(given, n_frames=200)
    found = given.fit(tracks)
    assert_allclose(found[0], cameras, atol=1e-7)
    assert_allclose(found[1], alpha, atol=1e-6)


def test_rows_are_orthonormal():
    given = model(0.1)
    R, _ = given.fit(frames(given, 0.5)[0])
    identity = np.broadcast_to(np.eye(2), (N_FRAMES, 2, 2))
    assert_allclose(R @ R.swapaxes(1, 2), identity, atol=1e-14)


@pytest.mark.parametrize("noise", [0.01, 0.3])
def test_is_a_minimum(noise):
    given = model(noise**2)
    tracks = frames(given, noise)[0]
    rng = np.random.default_rng(2)
    for track, R, a in zip(tracks, *given.fit(tracks), strict=True):

        def of(x, track=track, R=R, a=a):
            return cost(given, track, turned(R, x[:3]), a + x[3:])

        origin = np.zeros(3 + N_COMPONENTS)
        slope = approx_fprime(origin, of, 1e-6)
        assert_allclose(slope, 0, atol=2e-4)
        for size in (1e-3, 1e-2, 1e-1):
            assert of(size * rng.normal(size=origin.shape)) > of(origin)


def test_quadratic_model():
    given = model(0.3)
    rng = np.random.default_rng(2)
    track = frames(given, 0.5, 1)[0][0]
    R = Rotation.random(None, rng).as_matrix()[:2]
    a = rng.normal(size=N_COMPONENTS)
    shapes = np.concatenate([given.mean_shape[None], given.basis]).swapaxes(1, 2)
    slope, curvature, scale = _orthographic_frames._quadratic_model(
        track.T[None], shapes, given.noise_variance, R[None], a[None]
    )

    def of(x):
        return cost(given, track, turned(R, x[:3]), a + x[3:]) / 2

    n, step = 3 + N_COMPONENTS, 1e-4
    unit = step * np.eye(n)
    gradient = [(of(e) - of(-e)) / (2 * step) for e in unit]
    hessian = [
        [(of(e + f) - of(e - f) - of(f - e) + of(-e - f)) / (4 * step**2) for f in unit]
        for e in unit
    ]
    assert_allclose(slope[0], -np.array(gradient), rtol=1e-6)
    assert_allclose(curvature[0], hessian, atol=1e-5)
    assert (scale > 0).all()


def test_frames_do_not_depend_on_each_other():
    given = model(0.01)
    tracks = frames(given, 0.1)[0]
    whole = given.fit(tracks)
    single = [given.fit(tracks[i : i + 1]) for i in range(N_FRAMES)]
    for part, together, in_batches in zip(
        zip(*single, strict=True), whole, given.fit(tracks, batch=4), strict=True
    ):
        assert_allclose(np.concatenate(part), together, atol=1e-7)
        assert_allclose(in_batches, together, atol=1e-7)


def test_turning_an_image_turns_its_camera():
    given = model(0.01)
    tracks = frames(given, 0.1)[0]
    R, alpha = given.fit(tracks)
    turn = random_rotation(0, 2)
    found = given.fit(tracks @ turn.T)
    assert_allclose(found[0], turn @ R, atol=1e-7)
    assert_allclose(found[1], alpha, atol=1e-6)


def test_turning_space_turns_cameras():
    given = model(0.01)
    tracks = frames(given, 0.1)[0]
    R, alpha = given.fit(tracks)
    turn = np.diag([1.0, 1.0, -1.0]) @ random_rotation(0)
    found = OrthographicFrames(
        given.mean_shape @ turn.T, given.basis @ turn.T, given.noise_variance
    ).fit(tracks)
    assert_allclose(found[0], R @ turn.T, atol=1e-7)
    assert_allclose(found[1], alpha, atol=1e-6)


def test_the_prior_counts_by_the_noise():
    given = model()
    tracks = frames(given, 0.1)[0]
    sizes = [
        np.linalg.norm(given._replace(noise_variance=v).fit(tracks)[1])
        for v in (1e-6, 1.0, 1e2, 1e6)
    ]
    assert (np.diff(sizes) < 0).all()
    assert sizes[-1] < 1e-3


class TestDegenerate:
    def test_no_deformation(self):
        given = model()
        given = given._replace(basis=0 * given.basis)
        tracks, cameras, _ = frames(given)
        R, alpha = given.fit(tracks)
        assert_allclose(R, cameras, atol=1e-7)
        assert_array_equal(alpha, 0)

    def test_flat_object(self):
        # It and its image in the mirror of its plane look the same.
        given = model(depth=0.0)
        given = given._replace(basis=0 * given.basis)
        tracks, cameras, _ = frames(given)
        R, _ = given.fit(tracks)
        assert_allclose(R[:, :, :2], cameras[:, :, :2], atol=1e-6)
        depth = R[:, :, 2] * np.sign(np.vecdot(R[:, :, 2], cameras[:, :, 2]))[:, None]
        assert_allclose(depth, cameras[:, :, 2], atol=1e-6)

    def test_points_on_a_line(self):
        given = model(0.01)
        line = np.outer(given.mean_shape[:, 0], [1.0, 0.0])[None]
        R, alpha = given.fit(line)
        assert_allclose(R @ R.swapaxes(1, 2), np.eye(2)[None], atol=1e-14)
        assert np.isfinite(alpha).all()

    def test_no_frames(self):
        R, alpha = model().fit(np.empty((0, N_POINTS, 2)))
        assert R.shape == (0, 2, 3)
        assert alpha.shape == (0, N_COMPONENTS)
