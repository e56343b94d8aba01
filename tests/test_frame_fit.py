"""Camera and coefficients of single frames."""

import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal
from scenes import random_rotation

from isa_nrsfm._frame_fit import compose, fit_frames, project
from isa_nrsfm._tracks import centred_tracks, measurement_matrix


def orthogonal_shapes(seed, n_components=2, n_points=20):
    """Return a mean shape and basis shapes with ``B_k B_l^T = 0``, all centred."""
    rng = np.random.default_rng(seed)
    rows = rng.normal(size=(3 * n_components + 3, n_points))
    rows -= rows.mean(axis=1, keepdims=True)
    white = np.linalg.qr(rows.T)[0].T.reshape(n_components + 1, 3, n_points)
    shapes = rng.normal(size=(n_components + 1, 3, 3)) @ white
    return shapes[0].T, shapes[1:].transpose(0, 2, 1)


def random_fit(seed, noise=0.0, n_frames=12, n_components=2):
    """Return tracks made of shapes, and all that went into them."""
    rng = np.random.default_rng(seed)
    mean_shape, basis = orthogonal_shapes(seed, n_components)
    motion = rng.normal(size=(n_frames, 2, 3))
    translation = rng.normal(size=(n_frames, 2))
    alpha = rng.normal(size=(n_frames, n_components))
    tracks = project(compose(mean_shape, basis, alpha), motion, translation)
    tracks = tracks + noise * rng.normal(size=tracks.shape)
    return tracks, mean_shape, basis, (motion, translation, alpha)


class TestFit:
    def test_exact_tracks(self):
        tracks, mean_shape, basis, truth = random_fit(0)
        fitted = fit_frames(*centred_tracks(tracks), mean_shape, basis)
        for got, true in zip(fitted, truth, strict=True):
            assert_allclose(got, true, atol=1e-11)

    def test_camera_is_the_rigid_fit(self):
        tracks, mean_shape, basis, _ = random_fit(0, noise=0.1)
        centred, translation = centred_tracks(tracks)
        fitted = fit_frames(centred, translation, mean_shape, basis)
        for i, W in enumerate(centred):
            M = np.linalg.lstsq(mean_shape, W)[0].T
            assert_allclose(fitted.motion[i], M, atol=1e-12)
        assert_array_equal(fitted.translation, translation)

    def test_coefficients_are_the_least_squares(self):
        tracks, mean_shape, basis, _ = random_fit(0, noise=0.1)
        centred, translation = centred_tracks(tracks)
        fitted = fit_frames(centred, translation, mean_shape, basis)
        for i, W in enumerate(centred):
            M = fitted.motion[i]
            images = np.stack([(B @ M.T).ravel() for B in basis], axis=1)
            residual = (W - mean_shape @ M.T).ravel()
            alpha = np.linalg.lstsq(images, residual)[0]
            assert_allclose(fitted.alpha[i], alpha, atol=1e-11)

    def test_cost_rises_in_every_direction(self):
        tracks, mean_shape, basis, _ = random_fit(0, noise=0.1)
        centred, translation = centred_tracks(tracks)
        motion, _, alpha = fit_frames(centred, translation, mean_shape, basis)

        def cost(alpha):
            shapes = compose(mean_shape, basis, alpha)
            return np.sum((centred - project(shapes, motion, np.zeros(2))) ** 2)

        least = cost(alpha)
        for k in range(2):
            for step in (-1e-3, 1e-3):
                moved = alpha.copy()
                moved[:, k] += step
                assert cost(moved) > least

    def test_frames_are_separate(self):
        tracks, mean_shape, basis, _ = random_fit(0, noise=0.1)
        centred, translation = centred_tracks(tracks)
        together = fit_frames(centred, translation, mean_shape, basis)
        for i in range(len(tracks)):
            alone = fit_frames(
                centred[i : i + 1], translation[i : i + 1], mean_shape, basis
            )
            for got, expected in zip(alone, together, strict=True):
                assert_allclose(got[0], expected[i], rtol=1e-12, atol=1e-14)

    def test_rotation_of_single_frames_leaves_the_coefficients(self):
        tracks, mean_shape, basis, _ = random_fit(0, noise=0.1)
        angle = np.random.default_rng(1).uniform(0, 6, len(tracks))
        c, s = np.cos(angle), np.sin(angle)
        R = np.stack([np.stack([c, -s], -1), np.stack([s, c], -1)], 1)
        fitted = fit_frames(*centred_tracks(tracks), mean_shape, basis)
        turned = fit_frames(
            *centred_tracks(tracks @ R.transpose(0, 2, 1)), mean_shape, basis
        )
        assert_allclose(turned.alpha, fitted.alpha, atol=1e-11)
        assert_allclose(turned.motion, R @ fitted.motion, atol=1e-12)

    @pytest.mark.parametrize("unit", [1e-9, 1e9])
    def test_units_of_single_frames(self, unit):
        tracks, mean_shape, basis, _ = random_fit(0, noise=0.1)
        fitted = fit_frames(*centred_tracks(tracks), mean_shape, basis)
        scaled = fit_frames(*centred_tracks(unit * tracks), mean_shape, basis)
        assert_allclose(scaled.alpha, fitted.alpha, rtol=1e-9, atol=1e-10)
        assert_allclose(scaled.motion, unit * fitted.motion, rtol=1e-9)

    def test_affinity_of_space_leaves_the_coefficients(self):
        tracks, mean_shape, basis, _ = random_fit(0, noise=0.1)
        A = np.random.default_rng(1).normal(size=(3, 3))
        fitted = fit_frames(*centred_tracks(tracks), mean_shape, basis)
        other = fit_frames(*centred_tracks(tracks), mean_shape @ A.T, basis @ A.T)
        assert_allclose(other.alpha, fitted.alpha, atol=1e-10)
        assert_allclose(other.motion @ A, fitted.motion, atol=1e-11)

    def test_basis_shape_of_zeros(self):
        tracks, mean_shape, basis, _ = random_fit(0, noise=0.1)
        centred, translation = centred_tracks(tracks)
        padded = np.concatenate([basis, np.zeros_like(basis[:1])])
        fitted = fit_frames(centred, translation, mean_shape, padded)
        expected = fit_frames(centred, translation, mean_shape, basis)
        assert_array_equal(fitted.alpha[:, 2], 0)
        assert_allclose(fitted.alpha[:, :2], expected.alpha)

    def test_flat_mean_shape(self):
        tracks, mean_shape, basis, _ = random_fit(0, noise=0.1)
        mean_shape = mean_shape.copy()
        mean_shape[:, 2] = 0
        fitted = fit_frames(*centred_tracks(tracks), mean_shape, basis)
        assert_allclose(fitted.motion[:, :, 2], 0, atol=1e-12)
        assert np.isfinite(fitted.alpha).all()

    @pytest.mark.parametrize("seed", range(4))
    def test_basis_shape_that_no_camera_sees(self, seed):
        # The mean shape is flat, so the cameras do not see along its normal.
        tracks, mean_shape, basis, _ = random_fit(0, noise=0.1)
        mean_shape, basis = mean_shape * [1.0, 1.0, 0.0], basis.copy()
        basis[1] *= [0.0, 0.0, 1.0]
        R = random_rotation(seed)
        fitted = fit_frames(*centred_tracks(tracks), mean_shape @ R, basis @ R)
        assert_array_equal(fitted.alpha[:, 1], 0)


class TestComposeAndProject:
    def test_by_plain_loops(self):
        rng = np.random.default_rng(0)
        mean_shape, basis = rng.normal(size=(7, 3)), rng.normal(size=(2, 7, 3))
        alpha, motion = rng.normal(size=(4, 2)), rng.normal(size=(4, 2, 3))
        translation = rng.normal(size=(4, 2))
        shapes = compose(mean_shape, basis, alpha)
        tracks = project(shapes, motion, translation)
        assert shapes.shape == (4, 7, 3)
        for i in range(4):
            S = mean_shape + alpha[i, 0] * basis[0] + alpha[i, 1] * basis[1]
            assert_allclose(shapes[i], S)
            for j in range(7):
                assert_allclose(tracks[i, j], motion[i] @ S[j] + translation[i])

    def test_one_camera_for_all_frames(self):
        rng = np.random.default_rng(0)
        shapes, motion = rng.normal(size=(4, 7, 3)), rng.normal(size=(2, 3))
        translation = rng.normal(size=2)
        repeated = project(
            shapes, np.tile(motion, (4, 1, 1)), np.tile(translation, (4, 1))
        )
        assert_allclose(project(shapes, motion, translation), repeated)

    def test_measurement_matrix_of_the_model(self):
        tracks, mean_shape, basis, (motion, _, alpha) = random_fit(0)
        W = measurement_matrix(centred_tracks(tracks)[0])
        for i in range(len(tracks)):
            S = mean_shape + np.tensordot(alpha[i], basis, 1)
            assert_allclose(W[2 * i : 2 * i + 2], motion[i] @ S.T, atol=1e-12)
