"""Camera and coefficients of single frames."""

from dataclasses import replace

import numpy as np
import pytest
from frame_parts import fit_posterior
from numpy.testing import assert_allclose, assert_array_equal
from scenes import random_rotation, with_gaps

from isa_nrsfm._frames.camera_models import nearest_calibrated
from isa_nrsfm._frames.models import FrameMap, PosteriorFrames, RigidFrames
from isa_nrsfm._frames.projection import compose, distances, project
from isa_nrsfm._parameters.choices import LOSSES
from isa_nrsfm._prepare.robust import WEIGHTS, distant_points
from isa_nrsfm._tables.layout import centred_tracks, measurement_matrix


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


def rigid(tracks, mean_shape, basis):
    """Return the fit of the paper's model of a frame."""
    return RigidFrames(mean_shape, basis).fit(tracks, np.ones(len(tracks)))


def least_squares(mean_shape, basis, points):
    """Return camera, position and coefficients of one frame, the one after the other.

    Camera and position together are a linear least squares fit to the mean shape;
    position and coefficients one to the basis shapes in this camera.
    """
    seen = ~np.isnan(points[:, 0])
    points, mean_shape, basis = points[seen], mean_shape[seen], basis[:, seen]
    with_position = np.column_stack([mean_shape, np.ones(len(points))])
    M = np.linalg.lstsq(with_position, points)[0][:3].T
    design = np.zeros((2 * len(points), len(basis) + 2))
    for k, B in enumerate(basis):
        design[:, k] = (B @ M.T).ravel()
    design[0::2, -2], design[1::2, -1] = 1, 1
    found = np.linalg.lstsq(design, (points - mean_shape @ M.T).ravel())[0]
    return M, found[-2:], found[:-2]


class TestRigidFrames:
    @pytest.mark.parametrize("missing", [0.0, 0.3])
    def test_camera_first_then_coefficients_by_least_squares(self, missing):
        tracks, mean_shape, basis, _ = random_fit(0, noise=0.1)
        tracks = with_gaps(tracks, missing)
        fitted = rigid(tracks, mean_shape, basis)
        for i, points in enumerate(tracks):
            M, t, alpha = least_squares(mean_shape, basis, points)
            assert_allclose(fitted.motion[i], M, atol=1e-12)
            assert_allclose(fitted.translation[i], t, atol=1e-11)
            assert_allclose(fitted.alpha[i], alpha, atol=1e-11)

    def test_some_missing_points_do_not_change_complete_frames(self):
        tracks, mean_shape, basis, _ = random_fit(0, noise=0.1)
        holed = tracks.copy()
        holed[3, 5] = np.nan
        fitted, expected = (rigid(each, mean_shape, basis) for each in (holed, tracks))
        others = np.arange(len(tracks)) != 3
        for got, complete in zip(fitted, expected, strict=True):
            assert_allclose(got[others], complete[others], rtol=1e-13)

    def test_it_knows_no_noise(self):
        tracks, mean_shape, basis, _ = random_fit(0, noise=0.1)
        assert np.isnan(rigid(tracks, mean_shape, basis).alpha_std).all()

    @pytest.mark.parametrize("missing", [0.0, 0.3])
    def test_frames_are_separate(self, missing):
        tracks, mean_shape, basis, _ = random_fit(0, noise=0.1)
        tracks = with_gaps(tracks, missing)
        together = rigid(tracks, mean_shape, basis)
        for i in range(len(tracks)):
            alone = rigid(tracks[i : i + 1], mean_shape, basis)
            for got, expected in zip(alone, together, strict=True):
                assert_allclose(got[0], expected[i], rtol=1e-12, atol=1e-14)

    @pytest.mark.parametrize("unit", [1e-9, 1e9])
    def test_units_of_single_frames(self, unit):
        tracks, mean_shape, basis, _ = random_fit(0, noise=0.1)
        fitted = rigid(tracks, mean_shape, basis)
        scaled = rigid(unit * tracks, mean_shape, basis)
        assert_allclose(scaled.alpha, fitted.alpha, rtol=1e-9, atol=1e-10)
        assert_allclose(scaled.motion, unit * fitted.motion, rtol=1e-9)

    def test_basis_shape_of_zeros(self):
        tracks, mean_shape, basis, _ = random_fit(0, noise=0.1)
        padded = np.concatenate([basis, np.zeros_like(basis[:1])])
        for each in (tracks, with_gaps(tracks, 0.3)):
            fitted = rigid(each, mean_shape, padded)
            expected = rigid(each, mean_shape, basis)
            assert_array_equal(fitted.alpha[:, 2], 0)
            assert_allclose(fitted.alpha[:, :2], expected.alpha)

    def test_flat_mean_shape(self):
        tracks, mean_shape, basis, _ = random_fit(0, noise=0.1)
        mean_shape = mean_shape.copy()
        mean_shape[:, 2] = 0
        fitted = rigid(tracks, mean_shape, basis)
        assert_allclose(fitted.motion[:, :, 2], 0, atol=1e-12)
        assert np.isfinite(fitted.alpha).all()

    @pytest.mark.parametrize("seed", range(4))
    def test_basis_shape_that_no_camera_sees(self, seed):
        # The mean shape is flat, so the cameras do not see along its normal.
        tracks, mean_shape, basis, _ = random_fit(0, noise=0.1)
        mean_shape, basis = mean_shape * [1.0, 1.0, 0.0], basis.copy()
        basis[1] *= [0.0, 0.0, 1.0]
        R = random_rotation(seed)
        fitted = rigid(tracks, mean_shape @ R, basis @ R)
        assert_array_equal(fitted.alpha[:, 1], 0)


CALIBRATED = pytest.mark.parametrize("camera", ["weak_perspective", "orthographic"])


class TestCalibratedRigidFrames:
    @CALIBRATED
    @pytest.mark.parametrize("missing", [0.0, 0.3])
    def test_cameras_are_the_nearest_to_those_of_the_rigid_fit(self, camera, missing):
        tracks, mean_shape, basis, _ = random_fit(0, noise=0.1)
        tracks = with_gaps(tracks, missing)
        affine = rigid(tracks, mean_shape, basis)
        frames = RigidFrames(mean_shape, basis, camera)
        fitted = frames.fit(tracks, np.ones(len(tracks)))
        rows, scales = nearest_calibrated(affine.motion)
        if camera == "weak_perspective":
            rows = scales[:, None, None] * rows
        assert_allclose(fitted.motion, rows, atol=1e-12)

    @CALIBRATED
    @pytest.mark.parametrize("missing", [0.0, 0.3])
    def test_position_and_coefficients_are_those_of_least_squares(
        self, camera, missing
    ):
        tracks, mean_shape, basis, _ = random_fit(0, noise=0.1)
        tracks = with_gaps(tracks, missing)
        frames = RigidFrames(mean_shape, basis, camera)
        fitted = frames.fit(tracks, np.ones(len(tracks)))
        for i, points in enumerate(tracks):
            seen = ~np.isnan(points[:, 0])
            images = basis[:, seen] @ fitted.motion[i].T
            design = np.concatenate([images, *[np.ones((2, seen.sum(), 2))]])
            design[-2:] *= np.eye(2)[:, None]
            rest = points[seen] - mean_shape[seen] @ fitted.motion[i].T
            found = np.linalg.lstsq(design.reshape(len(design), -1).T, rest.ravel())[0]
            assert_allclose(fitted.alpha[i], found[:-2], atol=1e-9)
            assert_allclose(fitted.translation[i], found[-2:], atol=1e-9)

    @CALIBRATED
    def test_rigid_tracks_are_exact(self, camera):
        _, mean_shape, basis, (motion, translation, _) = random_fit(0)
        rows, scales = nearest_calibrated(motion)
        if camera == "weak_perspective":
            rows = scales[:, None, None] * rows
        tracks = project(mean_shape, rows, translation)
        for each in (tracks, with_gaps(tracks, 0.3)):
            fitted = RigidFrames(mean_shape, basis, camera).fit(each, np.ones(12))
            assert_allclose(fitted.motion, rows, atol=1e-11)
            assert_allclose(fitted.translation, translation, atol=1e-11)
            assert_allclose(fitted.alpha, 0.0, atol=1e-10)


class TestMirrored:
    @pytest.mark.parametrize("camera", ["affine", "weak_perspective", "orthographic"])
    def test_rigid_frames_have_the_same_images(self, camera):
        tracks, mean_shape, basis, _ = random_fit(0, noise=0.1)
        model = RigidFrames(mean_shape, basis, camera)
        mirrored = model.mirrored()
        depth = np.array([1.0, 1.0, -1.0])
        assert_array_equal(mirrored.mean_shape, mean_shape * depth)
        assert_array_equal(mirrored.basis, basis * depth)
        one, other = (each.fit(tracks, np.ones(12)) for each in (model, mirrored))
        assert_allclose(other.motion, one.motion * depth, atol=1e-12)
        assert_allclose(other.alpha, one.alpha, atol=1e-10)
        assert_allclose(other.translation, one.translation, atol=1e-12)

    @pytest.mark.parametrize("camera", ["affine", "weak_perspective", "orthographic"])
    def test_posterior_frames_have_mirrored_cameras(self, camera):
        model, tracks = posterior_frames(0)
        model = replace(model, camera=camera)
        one, other = (
            each.fit(tracks, np.ones(12)) for each in (model, model.mirrored())
        )
        assert_allclose(other.motion, one.motion * [1.0, 1.0, -1.0], atol=1e-12)
        assert_array_equal(other.alpha, one.alpha)
        assert_array_equal(other.alpha_std, one.alpha_std)
        assert_array_equal(other.translation, one.translation)


def turns(n):
    """Return rotations of images, (n, 2, 2)."""
    angle = np.random.default_rng(1).uniform(0, 6, n)
    c, s = np.cos(angle), np.sin(angle)
    return np.stack([np.stack([c, -s], -1), np.stack([s, c], -1)], 1)


NOISE = 0.05


def posterior_frames(seed, loss="linear", gauge=None):
    """Return a model of frames, and tracks of frames of size about one."""
    rng = np.random.default_rng(seed)
    mean_shape, basis = orthogonal_shapes(seed)
    mean_shape, basis = np.sqrt(20) * mean_shape, 0.3 * np.sqrt(20) * basis
    motion = np.eye(2, 3) + 0.3 * rng.normal(size=(12, 2, 3))
    shapes = compose(mean_shape, basis, rng.normal(size=(12, 2)))
    tracks = project(shapes, motion, rng.normal(size=(12, 2)))
    tracks = tracks + NOISE * rng.normal(size=tracks.shape)
    shapes = np.concatenate([mean_shape[None], basis]).transpose(0, 2, 1)
    gauge = FrameMap.identity(2) if gauge is None else gauge
    # Frames with an outlier have several minima: as the estimator does, start from more
    # places than zero.
    starts = np.random.default_rng(0).normal(size=(8, 2))
    return PosteriorFrames(shapes, NOISE**2, starts, loss, gauge), tracks


def mixing_gauge():
    """Return a map to other shapes: B_0 with B_k, B_k with B_0, and an affinity."""
    rng = np.random.default_rng(5)
    mixing = np.eye(3) + 0.1 * rng.normal(size=(3, 3))
    return FrameMap(mixing, rng.normal(size=(3, 3)))


class TestPosteriorFrames:
    @pytest.mark.parametrize("missing", [0.0, 0.3])
    def test_fit_is_that_of_frames_of_size_one(self, missing):
        frames, tracks = posterior_frames(0)
        tracks = with_gaps(tracks, missing)
        sizes = np.linspace(0.5, 200.0, len(tracks))
        fitted = frames.fit(tracks * sizes[:, None, None], sizes)
        expected = fit_posterior(tracks, frames.shapes, NOISE**2, starts=frames.starts)
        deviation = np.sqrt(np.einsum("ikk->ik", expected.covariance))
        assert_allclose(fitted.alpha, expected.alpha, atol=1e-9)
        assert_allclose(fitted.alpha_std, deviation, rtol=1e-9)
        scale = sizes[:, None]
        assert_allclose(fitted.translation, expected.translation * scale, rtol=1e-9)
        motion = expected.motion * scale[..., None]
        assert_allclose(fitted.motion, motion, atol=1e-9 * np.abs(motion).max())

    @CALIBRATED
    @pytest.mark.parametrize("missing", [0.0, 0.3])
    def test_calibrated_cameras(self, camera, missing):
        frames, tracks = posterior_frames(0)
        frames, tracks = replace(frames, camera=camera), with_gaps(tracks, missing)
        sizes = np.linspace(0.5, 200.0, len(tracks))
        fitted = frames.fit(tracks * sizes[:, None, None], sizes)
        expected = fit_posterior(
            tracks, frames.shapes, NOISE**2, camera=camera, starts=frames.starts
        )
        assert_allclose(fitted.alpha, expected.alpha, atol=1e-8)
        motion = expected.motion * sizes[:, None, None]
        assert_allclose(fitted.motion, motion, atol=1e-8 * np.abs(motion).max())
        gram = fitted.motion @ fitted.motion.swapaxes(1, 2)
        scale = np.trace(gram, axis1=1, axis2=2)[:, None, None] / 2
        unit = np.broadcast_to(np.eye(2), gram.shape)
        assert_allclose(gram / scale, unit, atol=1e-11)

    def test_images_do_not_depend_on_the_gauge(self):
        frames, tracks = posterior_frames(0)
        gauge = mixing_gauge()
        mean_shape, *basis = frames.shapes.transpose(0, 2, 1)
        # (1, alpha) = G^-1 (1, alpha') up to a factor: the new shapes follow from it.
        inverse = np.linalg.inv(gauge.mixing)
        new = np.einsum("kl,kjc->ljc", inverse, np.stack([mean_shape, *basis]))
        new = new @ gauge.space.T
        one, other = (
            replace(frames, gauge=each).fit(tracks, np.ones(len(tracks)))
            for each in (frames.gauge, gauge)
        )
        images = project(
            compose(mean_shape, np.stack(basis), one.alpha), one.motion, one.translation
        )
        mixed = project(
            compose(new[0], new[1:], other.alpha), other.motion, other.translation
        )
        assert_allclose(mixed, images, atol=1e-10)

    def test_deviations_follow_the_map_of_the_gauge(self):
        # To first order: by a difference quotient of the map along random draws.
        frames, tracks = posterior_frames(0)
        gauge = mixing_gauge()
        posterior = frames.posterior(tracks)
        shown = replace(frames, gauge=gauge).shown(posterior, np.ones(len(tracks)))

        def mapped(alpha):
            one = np.column_stack([np.ones(len(alpha)), alpha]) @ gauge.mixing.T
            return one[:, 1:] / one[:, :1]

        assert_allclose(shown.alpha, mapped(posterior.alpha), rtol=1e-12)
        step = 1e-6
        slope = np.stack(
            [
                (mapped(posterior.alpha + e) - mapped(posterior.alpha - e)) / (2 * step)
                for e in step * np.eye(2)
            ],
            axis=2,
        )
        covariance = slope @ posterior.covariance @ slope.transpose(0, 2, 1)
        expected = np.sqrt(np.einsum("ikk->ik", covariance))
        assert_allclose(shown.alpha_std, expected, rtol=1e-7)

    @pytest.mark.parametrize("missing", [0.0, 0.3])
    @pytest.mark.parametrize("loss", LOSSES[1:])
    def test_weights_of_a_robust_loss_agree_with_the_fit(self, loss, missing):
        frames, tracks = posterior_frames(0, loss)
        tracks = with_gaps(tracks, missing)
        tracks[:, 7] += 2.0
        fitted = frames.posterior(tracks)
        apart = distances(tracks, frames.shapes, *fitted[:3])
        weights = np.nan_to_num(WEIGHTS[loss](apart / NOISE))
        again = fit_posterior(
            tracks, frames.shapes, NOISE**2, weights=weights, initial=fitted.alpha
        )
        assert_allclose(again.alpha, fitted.alpha, atol=1e-4)
        assert_allclose(again.motion, fitted.motion, atol=1e-4)

    @pytest.mark.parametrize("point", [0, 7, 12])
    @pytest.mark.parametrize("size", [2.0, 20.0])
    @pytest.mark.parametrize("loss", LOSSES[1:])
    def test_robust_loss_is_not_drawn_to_an_outlier(self, loss, size, point):
        frames, tracks = posterior_frames(0)
        expected = frames.posterior(tracks)
        deviation = np.sqrt(np.einsum("ikk->ik", expected.covariance))
        tracks[:, point] += size
        drawn = frames.posterior(tracks).alpha - expected.alpha
        robust = replace(frames, loss=loss).posterior(tracks).alpha - expected.alpha
        assert np.median(np.abs(drawn / deviation)) > 3
        assert np.abs(robust / deviation).max() < 2

    @pytest.mark.parametrize("loss", LOSSES[1:])
    def test_a_point_that_does_not_belong_to_its_frame_is_as_if_missing(self, loss):
        frames, tracks = posterior_frames(0, loss)
        tracks[:, 7] = np.nan
        expected = frames.posterior(tracks)
        for far in [1e3, 1e8, 1e16, 1e140]:
            tracks[:, 7] = far
            fitted = frames.posterior(tracks)
            assert_allclose(fitted.alpha, expected.alpha, atol=1e-6)
            assert_allclose(fitted.covariance, expected.covariance, atol=1e-6)

    @pytest.mark.parametrize("noise", [1e-12, 1e-24])
    @pytest.mark.parametrize("loss", LOSSES[1:])
    def test_weights_of_a_wrong_model_leave_a_camera(self, loss, noise):
        frames, _ = posterior_frames(0, loss)
        frames = replace(frames, noise_variance=noise)
        n_points = frames.shapes.shape[2]
        tracks = np.random.default_rng(0).normal(size=(200, n_points, 2))
        for part in frames.posterior(tracks)[:4]:
            assert np.isfinite(part).all()

    @pytest.mark.parametrize("loss", LOSSES[1:])
    def test_points_far_from_the_others_count_where_these_tell_too_little(self, loss):
        # Three points near each other, and three far: no camera without the far ones.
        frames, tracks = posterior_frames(0, loss)
        mean_shape = frames.shapes[0].T.copy()
        mean_shape[:6] *= 1e-3
        mean_shape -= mean_shape.mean(axis=0)
        shapes = np.concatenate([mean_shape.T[None], 1e-3 * frames.shapes[1:]])
        seen = np.arange(len(mean_shape)) < 9
        tracks = np.where(seen[:, None], mean_shape[:, :2], np.nan)[None]
        assert distant_points(tracks)[0, 6:9].all()
        fitted = replace(frames, shapes=shapes).posterior(tracks)
        images = project(mean_shape[None], fitted.motion, fitted.translation)
        assert_allclose(images[0, seen], tracks[0, seen], atol=1e-2)

    @pytest.mark.parametrize("loss", LOSSES)
    def test_frames_are_separate(self, loss):
        frames, tracks = posterior_frames(0, loss)
        tracks = with_gaps(tracks, 0.2)
        tracks[2, :3] += 2.0
        sizes = np.linspace(1, 2, len(tracks))
        together = frames.fit(tracks, sizes)
        for i in range(len(tracks)):
            alone = frames.fit(tracks[i : i + 1], sizes[i : i + 1])
            for got, expected in zip(alone, together, strict=True):
                assert_allclose(got[0], expected[i], rtol=1e-9, atol=1e-11)

    @pytest.mark.parametrize("loss", LOSSES)
    def test_frames_that_show_too_little_are_nan(self, loss):
        frames, tracks = posterior_frames(0, loss)
        tracks[4, 1:] = np.nan
        tracks[6, 3:] = np.nan
        fitted = frames.fit(tracks, np.ones(len(tracks)))
        few = np.isin(np.arange(len(tracks)), [4, 6])
        for part in fitted:
            flat = part.reshape(len(tracks), -1)
            assert np.isnan(flat[few]).all()
            assert np.isfinite(flat[~few]).all()


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
