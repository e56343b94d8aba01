"""Camera and coefficients of single frames."""

from dataclasses import replace

import numpy as np
import pytest
from frame_parts import fit_posterior
from numpy.testing import assert_allclose, assert_array_equal
from scenes import random_rotation, with_gaps
from scipy.spatial.transform import Rotation

from isa_nrsfm._frames.camera_models import CAMERAS, compose, distances, project
from isa_nrsfm._frames.models import (
    DepthCertainty,
    FrameMap,
    PosteriorFrames,
    RigidFrames,
)
from isa_nrsfm._joint.likelihood import JointFrames
from isa_nrsfm._joint.uncertainty import (
    fitted_frames,
    inlying_rows,
    shape_uncertainty,
    shown_frames,
)
from isa_nrsfm._parameters.choices import LOSSES
from isa_nrsfm._prepare.robust import WEIGHTS, distant_points
from isa_nrsfm._tables.blocks import FrameBlocks


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


def rigid(tracks, mean_shape, basis, camera="affine"):
    """Return the fit of the paper's model of a frame."""
    rows = tracks.transpose(0, 2, 1)
    return RigidFrames(mean_shape, basis, camera).fit(rows, np.ones(len(rows)))


CAMERA = pytest.mark.parametrize("camera", CAMERAS)
GAPS = pytest.mark.parametrize("missing", [0.0, 0.3])


def least_squares(mean_shape, basis, points, camera):
    """Return camera, position and coefficients of one frame, the one after the other.

    Camera and position together are a linear least squares fit to the mean shape;
    position and coefficients one to the basis shapes in the nearest camera.
    """
    seen = ~np.isnan(points[:, 0])
    points, mean_shape, basis = points[seen], mean_shape[seen], basis[:, seen]
    with_position = np.column_stack([mean_shape, np.ones(len(points))])
    M = np.linalg.lstsq(with_position, points)[0][:3].T
    if camera != "affine":
        U, S, Vt = np.linalg.svd(M, full_matrices=False)
        M = (S.mean() if camera == "weak_perspective" else 1.0) * U @ Vt
    design = np.zeros((2 * len(points), len(basis) + 2))
    for k, B in enumerate(basis):
        design[:, k] = (B @ M.T).ravel()
    design[0::2, -2], design[1::2, -1] = 1, 1
    found = np.linalg.lstsq(design, (points - mean_shape @ M.T).ravel())[0]
    return M, found[-2:], found[:-2]


class TestRigidFrames:
    @CAMERA
    @GAPS
    def test_camera_first_then_coefficients_by_least_squares(self, camera, missing):
        tracks, mean_shape, basis, _ = random_fit(0, noise=0.1)
        tracks = with_gaps(tracks, missing)
        fitted = rigid(tracks, mean_shape, basis, camera)
        for i, points in enumerate(tracks):
            M, t, alpha = least_squares(mean_shape, basis, points, camera)
            assert_allclose(fitted.motion[i], M, atol=1e-12)
            assert_allclose(fitted.translation[i], t, atol=1e-11)
            assert_allclose(fitted.alpha[i], alpha, atol=1e-10)

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


NOISE = 0.05


def posterior_frames(seed, loss="linear"):
    """Return a model of frames, and tracks of frames of size about one."""
    rng = np.random.default_rng(seed)
    mean_shape, basis = orthogonal_shapes(seed)
    mean_shape, basis = np.sqrt(20) * mean_shape, 0.3 * np.sqrt(20) * basis
    motion = np.eye(2, 3) + 0.3 * rng.normal(size=(12, 2, 3))
    shapes = compose(mean_shape, basis, rng.normal(size=(12, 2)))
    tracks = project(shapes, motion, rng.normal(size=(12, 2)))
    tracks = tracks + NOISE * rng.normal(size=tracks.shape)
    shapes = np.concatenate([mean_shape[None], basis]).transpose(0, 2, 1)
    # Frames with an outlier have several minima: as the estimator does, start from more
    # places than zero.
    starts = np.random.default_rng(0).normal(size=(8, 2))
    return PosteriorFrames(shapes, NOISE**2, starts, loss, FrameMap.identity(2)), tracks


class TestPosteriorFrames:
    @CAMERA
    @GAPS
    def test_fit_is_that_of_frames_of_size_one(self, camera, missing):
        frames, tracks = posterior_frames(0)
        frames, tracks = replace(frames, camera=camera), with_gaps(tracks, missing)
        sizes = np.linspace(0.5, 200.0, len(tracks))
        fitted = frames.fit((tracks * sizes[:, None, None]).transpose(0, 2, 1), sizes)
        expected = fit_posterior(
            tracks, frames.shapes, NOISE**2, camera=camera, starts=frames.starts
        )
        deviation = np.sqrt(np.einsum("ikk->ik", expected.covariance))
        assert_allclose(fitted.alpha, expected.alpha, atol=1e-8)
        assert_allclose(fitted.alpha_std, deviation, rtol=1e-8)
        scale = sizes[:, None]
        assert_allclose(fitted.translation, expected.translation * scale, rtol=1e-8)
        motion = expected.motion * scale[..., None]
        assert_allclose(fitted.motion, motion, atol=1e-8 * np.abs(motion).max())

    @GAPS
    @pytest.mark.parametrize("loss", LOSSES[1:])
    def test_weights_of_a_robust_loss_agree_with_the_fit(self, loss, missing):
        frames, tracks = posterior_frames(0, loss)
        tracks = with_gaps(tracks, missing)
        tracks[:, 7] += 2.0
        fitted = frames.posterior(tracks.transpose(0, 2, 1))
        apart = distances(tracks.transpose(0, 2, 1), frames.shapes, *fitted[:3])
        weights = np.nan_to_num(WEIGHTS[loss](apart / NOISE))
        again = fit_posterior(
            tracks, frames.shapes, NOISE**2, weights=weights, initial=fitted.alpha
        )
        # The fit ends when its weights change by less than 1e-4. Entries of cameras can
        # change by more where points are missing.
        apart = distances(tracks.transpose(0, 2, 1), frames.shapes, *again[:3])
        new = np.nan_to_num(WEIGHTS[loss](apart / NOISE))
        assert_allclose(new, weights, rtol=0, atol=1e-4)
        assert_allclose(again.alpha, fitted.alpha, atol=1e-4)

    @pytest.mark.parametrize(("size", "point"), [(2.0, 0), (20.0, 7)])
    @pytest.mark.parametrize("loss", LOSSES[1:])
    def test_robust_loss_is_not_drawn_to_an_outlier(self, loss, size, point):
        frames, tracks = posterior_frames(0)
        expected = frames.posterior(tracks.transpose(0, 2, 1))
        deviation = np.sqrt(np.einsum("ikk->ik", expected.covariance))
        tracks[:, point] += size
        drawn = frames.posterior(tracks.transpose(0, 2, 1)).alpha - expected.alpha
        robust = (
            replace(frames, loss=loss).posterior(tracks.transpose(0, 2, 1)).alpha
            - expected.alpha
        )
        assert np.median(np.abs(drawn / deviation)) > 3
        assert np.abs(robust / deviation).max() < 2

    @pytest.mark.parametrize("loss", LOSSES[1:])
    def test_a_point_that_does_not_belong_to_its_frame_is_as_if_missing(self, loss):
        frames, tracks = posterior_frames(0, loss)
        tracks[:, 7] = np.nan
        expected = frames.posterior(tracks.transpose(0, 2, 1))
        for far in [1e3, 1e8, 1e16, 1e140]:
            tracks[:, 7] = far
            fitted = frames.posterior(tracks.transpose(0, 2, 1))
            assert_allclose(fitted.alpha, expected.alpha, atol=1e-6)
            assert_allclose(fitted.covariance, expected.covariance, atol=1e-6)

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
        assert distant_points(tracks.transpose(0, 2, 1))[0, 6:9].all()
        fitted = replace(frames, shapes=shapes).posterior(tracks.transpose(0, 2, 1))
        images = project(mean_shape[None], fitted.motion, fitted.translation)
        assert_allclose(images[0, seen], tracks[0, seen], atol=1e-2)


class TestDepthDeviations:
    @pytest.mark.parametrize("camera", ["weak_perspective", "orthographic"])
    @GAPS
    def test_without_certainty_are_those_of_the_frame(self, camera, missing):
        frames, tracks = posterior_frames(0)
        frames, tracks = replace(frames, camera=camera), with_gaps(tracks, missing)
        found = frames.depth_deviations(tracks.transpose(0, 2, 1), np.ones(len(tracks)))
        fit = frames.posterior(tracks.transpose(0, 2, 1))
        n_pose = CAMERAS[camera].n_parameters
        prior = np.diag([0.0] * n_pose + [1.0] * 2)
        for i, M in enumerate(fit.motion):
            seen = np.isfinite(tracks[i]).all(axis=1)
            scale = np.linalg.norm(M) / np.sqrt(2)
            R = np.vstack([M, np.cross(*M) / scale])

            def points(step, i=i, R=R, seen=seen):
                turned = Rotation.from_rotvec(step[:3]).as_matrix()
                weights = np.append(1.0, fit.alpha[i] + step[n_pose:])
                points = R @ turned @ np.tensordot(weights, frames.shapes, 1)
                points = points - points[:, seen].mean(axis=1, keepdims=True)
                return np.exp(step[3:n_pose].sum()) * points

            steps = 1e-5 * np.eye(n_pose + 2)
            D = np.array([points(step) - points(-step) for step in steps]) / 2e-5
            T = D[:, :2, seen].reshape(len(D), -1)
            covariance = np.linalg.inv(T @ T.T / NOISE**2 + prior)
            variances = np.diag(D[:, 2].T @ covariance @ D[:, 2])
            assert_allclose(found[i], np.sqrt(variances), rtol=1e-5)

    def test_variances_of_points_and_of_the_frame_add_up(self):
        frames, tracks = posterior_frames(0)
        frames = replace(frames, camera="weak_perspective")
        sizes = np.linspace(1.0, 2.0, len(tracks))
        tracks = sizes[:, None, None] * tracks
        alone = frames.depth_deviations(tracks.transpose(0, 2, 1), sizes)
        points = np.linspace(0.0, 1e-2, tracks.shape[1])
        frames = replace(frames, certainty=DepthCertainty(points=points))
        expected = alone**2 + sizes[:, None] ** 2 * points
        found = frames.depth_deviations(tracks.transpose(0, 2, 1), sizes)
        assert_allclose(found**2, expected, rtol=1e-9)

    def test_variances_of_points_grow_with_the_leverage_of_the_frame(self):
        frames, tracks = posterior_frames(0)
        frames, sizes = replace(frames, camera="weak_perspective"), np.ones(len(tracks))
        alone = frames.depth_deviations(tracks.transpose(0, 2, 1), sizes)
        certainty = DepthCertainty(points=np.linspace(0.0, 1e-2, 20), leverage=3.0)
        frames = replace(frames, certainty=certainty)
        alpha = frames.posterior(tracks.transpose(0, 2, 1)).alpha
        leverage = 1.0 + np.sum(alpha**2, axis=1)
        expected = alone**2 + np.outer(leverage / 3.0, certainty.points)
        found = frames.depth_deviations(tracks.transpose(0, 2, 1), sizes)
        assert_allclose(found**2, expected, rtol=1e-9)
        assert np.ptp(leverage) > 1.0


def posteriors(camera):
    """Return random fits of frames, their model, and the covariance of a point."""
    rng = np.random.default_rng(0)
    frames, tracks = posterior_frames(0)
    frames = replace(frames, camera=camera)
    root = rng.normal(size=(9, 12))
    # Leverages differ between frames and are far from zero.
    return frames.posterior(tracks.transpose(0, 2, 1)), frames, 5e-3 * root @ root.T


def rows_of(tracks):
    """Return tracks as centred rows, in blocks of five frames."""
    rows = (tracks - tracks.mean(axis=1, keepdims=True)).transpose(0, 2, 1)
    return rows, FrameBlocks.of_array(rows, 5)


class TestSamplePosterior:
    @pytest.mark.parametrize(
        ("loss", "compressed"), [("linear", False), ("linear", True), ("huber", False)]
    )
    def test_blocks_have_the_fits_of_their_frames(self, loss, compressed):
        model, tracks = posterior_frames(0, loss)
        rows, blocks = rows_of(tracks)
        frames = JointFrames.from_points(blocks, True)
        if compressed:
            directions = np.linalg.svd(model.shapes.reshape(9, -1))[2][:9]
            frames = JointFrames.from_directions(blocks, directions)
        expected = model.posterior(rows)
        _, motion, alpha, covariance = fitted_frames(model, frames, blocks)
        assert_allclose(motion, expected.motion, atol=1e-7)
        assert_allclose(alpha, expected.alpha, atol=1e-7)
        assert_allclose(covariance, expected.covariance.mean(axis=0), rtol=1e-6)

    def test_outliers_are_points_beyond_four_deviations(self):
        model, tracks = posterior_frames(0, "huber")
        tracks[np.arange(12), np.arange(12), 0] += NOISE * np.linspace(1.0, 8.0, 12)
        rows, _ = rows_of(tracks)
        cleaned, found = inlying_rows(model, rows)
        expected = model.posterior(rows)
        assert_array_equal(found.alpha, expected.alpha)
        far = distances(rows, model.shapes, *expected[:3])
        outlying = far > 4 * NOISE
        assert 2 < outlying.sum() < 12
        for row in range(2):
            assert_array_equal(np.isnan(cleaned[:, row]), outlying)
        assert_array_equal(cleaned[~np.isnan(cleaned)], rows[~np.isnan(cleaned)])
        assert_array_equal(inlying_rows(replace(model, loss="linear"), rows)[0], rows)

    def test_uncertainty_of_the_shapes_is_the_inverse_of_their_information(self):
        rng = np.random.default_rng(0)
        motion, alpha = rng.normal(size=(12, 2, 3)), rng.normal(size=(12, 2))
        root, share = rng.normal(size=(2, 2)), rng.uniform(0.5, 1.0, 12)
        information = np.zeros((9, 9))
        for M, a, weight in zip(motion, alpha, share, strict=True):
            c = np.append(1.0, a)
            moments = np.outer(c, c)
            moments[1:, 1:] += root @ root.T
            information += weight * np.kron(moments, M.T @ M)
        found = shape_uncertainty(
            motion, alpha, root @ root.T, share, [slice(0, 5), slice(5, 12)]
        )
        assert_allclose(found, np.linalg.inv(information), atol=1e-10)

    @CAMERA
    def test_effect_of_the_noise_of_a_frame_on_its_coefficients(self, camera):
        posterior, frames, uncertainty = posteriors(camera)
        n_pose = {"affine": 8, "weak_perspective": 6, "orthographic": 5}[camera]
        n_seen = np.arange(9, 21)
        moments, noises = np.zeros((2, 2)), []
        for i, (M, a) in enumerate(zip(posterior.motion, posterior.alpha, strict=True)):
            X = np.kron(np.append(1.0, a), M)
            used = np.trace(X @ uncertainty @ X.T)
            assert 0.05 < used < 1.9
            freedom = n_seen[i] * (2 - used) - n_pose
            noises.append(posterior.objective[i] / max(freedom, 1.0))
            change = (uncertainty @ X.T).reshape(3, 3, 2)[1:]
            own = np.trace(M @ change, axis1=1, axis2=2)
            shift = n_seen[i] * noises[i] * posterior.covariance[i] @ own
            moments += np.outer(a, shift)
        sizes = np.ones(12)
        _, found, total = shown_frames(
            posterior, sizes, n_seen, n_seen, frames, uncertainty
        )
        assert_allclose(found, moments, rtol=1e-9)
        assert_allclose(total, sum(noises), rtol=1e-9)
