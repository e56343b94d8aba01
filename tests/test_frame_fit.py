"""Camera and coefficients of single frames, and the certainty of their depths."""

import warnings
from dataclasses import replace

import numpy as np
import pytest
from frame_parts import depth_deviations, depth_errors, fit_posterior
from layers import slow_after
from numpy.testing import assert_allclose, assert_array_equal
from refusals import refusals_of, warned
from scenes import random_scene, with_gaps
from scipy.spatial.transform import Rotation

from benchmarks.depth import seen
from isa_nrsfm import AffineNRSfM
from isa_nrsfm._fitted_model import TableModel, far_points
from isa_nrsfm._frames.camera_models import CAMERAS, distances, full_rotations, project
from isa_nrsfm._frames.models import DepthCertainty, FrameMap, FrameModel
from isa_nrsfm._joint.likelihood import extent_penalty
from isa_nrsfm._joint.uncertainty import (
    N_GROUPS,
    differences,
    inlying_rows,
    neighbours,
    shape_information,
)
from isa_nrsfm._linalg import centred
from isa_nrsfm._parameters import LOSSES
from isa_nrsfm._prepare.robust import WEIGHTS, distant_points
from isa_nrsfm._tables import FrameBlocks
from isa_nrsfm.datasets import make_body_tracks, make_face_tracks
from isa_nrsfm.export import frame_poses, write_viewer
from isa_nrsfm.io import load_model, save_model
from isa_nrsfm.plotting import BasisShapeDisplay

CAMERA = pytest.mark.parametrize("camera", CAMERAS)
GAPS = pytest.mark.parametrize("missing", [0.0, 0.3])
EACH_LOSS = pytest.mark.parametrize("loss", slow_after(1, LOSSES[:0:-1]))


NOISE = 0.05


def posterior_frames(loss="linear"):
    """Return a model of frames, and tracks."""
    scene = random_scene(0, 12, n_components=2, noise=NOISE)
    # Frames with an outlier have several minima: as the estimator does, start from more
    # places than zero.
    starts = np.random.default_rng(0).normal(size=(8, 2))
    given = scene.shapes, NOISE**2, starts, loss, FrameMap.identity(2)
    return FrameModel(*given), scene.tracks


class TestFrameModel:
    @CAMERA
    @GAPS
    def test_fit_is_that_of_frames_of_size_one(self, camera, missing):
        frames, tracks = posterior_frames()
        frames, tracks = replace(frames, camera=camera), with_gaps(tracks, missing)
        sizes = np.linspace(0.5, 200.0, len(tracks))
        rows = (tracks * sizes[:, None, None]).mT
        fitted = frames.fit(rows, sizes, True, None)
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
    @EACH_LOSS
    def test_weights_of_a_robust_loss_agree_with_the_fit(self, loss, missing):
        frames, tracks = posterior_frames(loss)
        tracks = with_gaps(tracks, missing)
        tracks[:, 7] += 2.0
        fitted = frames.posterior(tracks.mT)
        apart = distances(tracks.mT, frames.shapes, *fitted[:3])
        weights = np.nan_to_num(WEIGHTS[loss](apart / NOISE))
        again = fit_posterior(
            tracks, frames.shapes, NOISE**2, weights=weights, initial=fitted.alpha
        )
        # The fit ends when its weights change by less than 1e-4. Entries of cameras can
        # change by more where points are missing.
        apart = distances(tracks.mT, frames.shapes, *again[:3])
        new = np.nan_to_num(WEIGHTS[loss](apart / NOISE))
        assert_allclose(new, weights, rtol=0, atol=1e-4)
        assert_allclose(again.alpha, fitted.alpha, atol=1e-4)

    @EACH_LOSS
    def test_a_point_that_does_not_belong_to_its_frame_is_as_if_missing(self, loss):
        frames, tracks = posterior_frames(loss)
        tracks[:, 7] = np.nan
        expected = frames.posterior(tracks.mT)
        for far in [1e3, 1e8, 1e16, 2e153]:
            tracks[:3, 7] = far
            fitted = frames.posterior(tracks[:3].mT)
            assert_allclose(fitted.alpha, expected.alpha[:3], atol=1e-6)
            assert_allclose(fitted.covariance, expected.covariance[:3], atol=1e-6)

    @EACH_LOSS
    def test_points_far_from_the_others_count_where_these_tell_too_little(self, loss):
        # Three points near each other, and three far: no camera without the far ones.
        frames, tracks = posterior_frames(loss)
        mean_shape = frames.shapes[0].T.copy()
        mean_shape[:6] *= 1e-3
        mean_shape -= mean_shape.mean(axis=0)
        shapes = np.concatenate([mean_shape.T[None], 1e-3 * frames.shapes[1:]])
        seen = np.arange(len(mean_shape)) < 9
        tracks = np.where(seen[:, None], mean_shape[:, :2], np.nan)[None]
        assert distant_points(tracks.mT)[0, 6:9].all()
        fitted = replace(frames, shapes=shapes).posterior(tracks.mT)
        images = project(mean_shape[None], fitted.motion, fitted.translation)
        assert_allclose(images[0, seen], tracks[0, seen], atol=1e-2)


def test_certainty_of_shapes_and_the_leverage_of_frames():
    """Errors of shapes lower the precision of images, more so in frames far out."""
    frames, tracks = posterior_frames()
    frames = replace(frames, camera="weak_perspective")
    sizes = np.linspace(1.0, 2.0, len(tracks))
    rows = (sizes[:, None, None] * tracks).mT
    fit = frames.posterior(tracks.mT)
    leverage, points = 1.0 + np.sum(fit.alpha**2, axis=1), np.linspace(0.0, 1e-2, 20)
    assert np.ptp(leverage) > 1.0
    # Of points
    certainty = DepthCertainty(points=points, leverage=3.0)
    alone = depth_deviations(frames, rows, sizes) ** 2
    found = depth_deviations(replace(frames, certainty=certainty), rows, sizes)
    expected = alone + np.outer(sizes**2 * leverage / 3.0, points)
    assert_allclose(found**2, expected, rtol=1e-9)
    # Of images
    certainty = DepthCertainty(images=(1.5, 0.2))
    found = replace(frames, certainty=certainty).fit(rows, sizes, True, None)
    assert_array_equal(found.alpha, frames.fit(rows, sizes, True, None).alpha)
    precision = np.linalg.inv(fit.covariance) - np.eye(2)
    ratio = 1.5 + 0.2 * leverage[:, None, None]
    expected = np.linalg.inv(precision / ratio + np.eye(2))
    variances = np.diagonal(expected, axis1=1, axis2=2)
    assert_allclose(found.alpha_std**2, variances, rtol=1e-8)


RESIDUAL = 1e-3  # of a point of the fitted frames


def excess(frames, rows):
    """Return squared residuals of frames, over those of the fit, or one."""
    residual = distances(rows, frames.shapes, *frames.posterior(rows)[:3]) ** 2
    return np.maximum(np.nanmean(residual, axis=1) / RESIDUAL, 1.0)


@pytest.mark.parametrize("camera", ["weak_perspective", "orthographic"])
@GAPS
def test_deviations_without_certainty_are_those_of_the_frame(camera, missing):
    frames, tracks = posterior_frames()
    certainty = DepthCertainty(residual=RESIDUAL)
    frames = replace(frames, camera=camera, certainty=certainty)
    tracks = with_gaps(tracks, missing)
    found = depth_deviations(frames, tracks.mT, np.ones(len(tracks)))
    fit = frames.posterior(tracks.mT)
    n_pose = CAMERAS[camera].n_parameters
    prior = np.diag([0.0] * n_pose + [1.0] * 2)
    factors = excess(frames, tracks.mT)
    assert factors.max() > 2
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
        expected = np.sqrt(factors[i] * variances)
        assert_allclose(found[i], expected, rtol=1e-5)


def test_information_on_the_shapes(rng):
    motion, alpha = rng.normal(size=(12, 2, 3)), rng.normal(size=(12, 2))
    share, moments = rng.uniform(0.5, 1.0, 12), np.diag([0.0, 3.0, 2.0])
    information = np.zeros((9, 9))
    for M, c, weight in zip(motion, np.insert(alpha, 0, 1.0, 1), share, strict=True):
        information += weight * np.kron(np.outer(c, c) + moments, M.T @ M)
    given = motion, alpha, moments[1:, 1:], share
    found = shape_information(*given, [slice(0, 5), slice(5, 12)])
    assert_allclose(found, information, rtol=1e-12, atol=1e-12)


def faces_turned_by(degrees, n_frames=30):
    """Return a table of faces whose rotation vectors have this spread, and the truth.

    The truth are points in the axes of the camera, in pixels, and rotations.
    """
    shapes = make_face_tracks(n_frames, random_state=0).shapes
    return seen(shapes[:, ::3], degrees, 0)


def fitted(X, n_components=3, camera="weak_perspective", **options):
    with warnings.catch_warnings():
        warnings.filterwarnings("ignore", "the depth of the shapes is not determined")
        model = AffineNRSfM(n_components, camera=camera, random_state=0, **options)
        return model.fit(X)


def error_of_depths(model, X, points):
    """Return errors of depths, and their size relative to the depths."""
    off = depth_errors(model, X, points[:, :, 2])
    return off, np.linalg.norm(off) / np.linalg.norm(centred(points[:, :, 2]))


@pytest.fixture(scope="module")
def frontal():
    X, *_ = faces_turned_by(1)
    model = AffineNRSfM(3, camera="weak_perspective", random_state=0)
    with pytest.warns(UserWarning, match="AutoNRSfM"):
        return X, model.fit(X)


@pytest.fixture(scope="module")
def turned():
    """Return faces of which the fit does not warn."""
    X, points, rotations = faces_turned_by(20)
    model = AffineNRSfM(3, camera="weak_perspective", random_state=0)
    return X, points, rotations, model.fit(X)


@pytest.mark.parametrize("side", [1.0, -1.0])
def test_differences_of_fits_are_those_in_the_axes_of_the_cameras(side, rng):
    """The object may be turned, and be mirrored in depth."""
    whole, common = Rotation.random(200, rng), Rotation.random(rng=rng)
    w = rng.normal(size=(200, 3)) * [1e-3, 2e-3, 3e-3]
    mirror, z = np.diag([1.0, 1.0, side]), centred(rng.normal(size=(200, 8)))
    rotations = mirror @ (Rotation.from_rotvec(w) * whole * common).as_matrix() @ mirror
    found = differences(rotations, 1.1 * side * z, whole.as_matrix(), z)
    assert_allclose(found[0], 0.01)
    products = w.T @ w / 200
    products[2, :2] = products[:2, 2] = 0.0  # those of mirror images have other signs
    assert_allclose(found[1], products, atol=1e-7)
    assert_allclose(found[2], 0.01 * np.mean(z**2, axis=0))


class TestExtents:
    def test_gradient_by_differences(self, rng):
        shapes = rng.normal(size=(3, 3, 20)) * np.array([3.0, 1.0, 0.2])[:, None]
        step = 1e-6 * rng.normal(size=shapes.shape)
        for shares in (None, np.ones(20), rng.uniform(0, 2, 20)):
            _, gradient = extent_penalty(shapes, shares)
            change = [extent_penalty(shapes + s * step, shares)[0] for s in (1, -1)]
            slope = np.subtract(*change) / 2
            assert_allclose(np.sum(gradient * step), slope, rtol=1e-5)

    def test_by_definition_and_in_all_units_also_of_flat_and_empty_shapes(self):
        a, b, c = 128.0, 2.0, 2.0
        ratio = (a + b + c) ** 2 / (3 * (a * b + b * c + c * a))
        shapes = np.kron(np.diag([8.0, 1.0, 1.0]), [1, -1])[None]
        values = [extent_penalty(unit * shapes)[0] for unit in (1, 7)]
        assert_allclose(values, ratio - 1, rtol=0.1)
        assert_allclose(*values, rtol=1e-12)
        cube = np.array(np.meshgrid([-1, 1], [-1, 1], [-1, 1])).reshape(1, 3, 8)
        for extents in ([1.0, 1.0, 0.0], [0.0, 0.0, 0.0]):
            value, gradient = extent_penalty(cube * np.reshape(extents, (3, 1)))
            assert np.isfinite(value)
            assert_allclose(gradient[:, 2], 0, atol=1e-12)  # flat objects stay flat
        assert_allclose(extent_penalty(1.0 * cube)[0], 0, atol=1e-12)


class TestFrontalFaces:
    def test_are_no_needles_and_uncertain(self, frontal):
        _, model = frontal
        extents = np.linalg.svd(model.mean_shape_, compute_uv=False)
        assert extents[0] < 4 * extents[1]
        assert model.depth_uncertainty_ > 0.2
        found = model.diagnostics()
        assert "isa_nrsfm.AutoNRSfM().fit(X)" in found.messages[0]
        assert found.depth_uncertainty == model.depth_uncertainty_

    def test_angles_and_proportions_are_withheld(self, frontal, tmp_path):
        X, model = frontal
        poses = warned("is not determined", frame_poses, model, X)
        assert np.isnan(poses[:3]).all()
        assert np.isnan(poses[4:]).all()
        assert np.isfinite(poses.scale).all()
        write_viewer(model, tmp_path / "page.html", X=X, camera=None)
        assert "The depth is not determined" in (tmp_path / "page.html").read_text()
        display = BasisShapeDisplay.from_estimator(model)
        for axes in display.axes_[:, 1]:
            assert axes.get_xlabel() == "depth not determined"

    def test_affine_angles_are_withheld_likewise(self, frontal):
        X, _ = frontal
        model = AffineNRSfM(1, refinement=None, random_state=0).fit(X)
        poses = warned("hardly determine the metric", frame_poses, model, X)
        assert np.isnan(poses[:3]).all()


class TestTurnedFaces:
    def test_deviations_of_depths_are_the_errors(self, turned):
        X, points, _, model = turned
        shapes, deviation = model.reconstruct(X, return_std=True)
        assert_allclose(shapes, model.reconstruct(X))
        assert deviation.shape == shapes.shape[:2]
        off, error = error_of_depths(model, X, points)
        assert error / 3 < model.depth_uncertainty_ < 3 * error
        relative = off / (model.scales_[:, None] * deviation)
        assert 0.4 < np.sqrt(np.mean(relative**2)) < 2

    def test_deviations_of_frames_grow_with_their_residual(self, turned, rng):
        X, *_, model = turned
        residual = (X - model.reproject(X)).std(axis=1, keepdims=True)
        spoilt = X + 3 * residual * rng.normal(size=X.shape)
        tables = X[:9], spoilt[:9]
        before, after = (model.reconstruct(x, return_std=True)[1] for x in tables)
        assert 2 < np.median(after / before) < 4

    def test_rows_without_points_have_no_deviations(self, turned):
        X, *_, model = turned
        X = X[:3].copy()
        X[1] = np.nan
        _, deviation = model.reconstruct(X, return_std=True)
        assert np.isnan(deviation).all(axis=1).tolist() == [False, True, False]
        assert np.isnan(model.reconstruct(X[[1, 1]], return_std=True)[1]).all()

    def test_models_keep_their_certainty_in_files(self, turned, tmp_path):
        X, *_, model = turned
        save_model(model, tmp_path / "model.npz")
        loaded = load_model(tmp_path / "model.npz")
        assert loaded.depth_uncertainty_ == model.depth_uncertainty_
        for name in ("rotation_covariance", "transform"):
            assert_allclose(getattr(loaded, name)(X), getattr(model, name)(X))
        found = loaded.reconstruct(X, return_std=True)[1]
        assert_allclose(found, model.reconstruct(X, return_std=True)[1])


def of_consensus(points=None):
    """Return the certainty of a consensus, and errors of points of the joint fit."""
    jackknife = DepthCertainty(total=0.7, deformation=0.04)
    jackknife = jackknife if points is None else jackknife._replace(points=points)
    return jackknife.of_consensus(np.array([0.1, 0.3]), np.array([1.0, 3.0]), 0.5)


def test_certainty_leaves_out_outliers_of_a_robust_loss():
    for loss, left_out in (("cauchy", True), ("linear", False)):
        frames, tracks = posterior_frames(loss)
        rows, outlying = tracks.mT.copy(), np.zeros((12, 2, 20), dtype=bool)
        rows[::4, 0, 3] += 20 * NOISE
        outlying[::4, :, 3] = left_out
        part, *_ = inlying_rows(frames, FrameBlocks.of_array(rows, 5), 12)
        assert_array_equal(part, np.where(outlying, np.nan, rows))


def test_distances_that_noise_and_errors_of_shapes_cause_are_no_misfit(rng):
    frames, _ = posterior_frames()
    frames = replace(frames, certainty=DepthCertainty(images=(1.2, 0.3)))
    shapes = frames.shapes.mT
    model = TableModel(frames, shapes[0], shapes[1:], 2, "planar", None)
    variance = (1.2 + 0.3 * len(frames.shapes)) * NOISE**2
    distance = np.linalg.norm(rng.normal(0, np.sqrt(variance), (2, 20_000)), axis=0)
    assert_allclose(model.misfit(distance), 1, rtol=0.03)
    # A few frames do not make points others.
    distance, other = np.full((9, 5), 0.1), np.full((9, 5), 0.3)
    distance[:3, 0], distance[3], distance[:2, 1:] = np.nan, np.nan, 9.0
    assert far_points(distance, replace(frames, noise_variance=0.0)) == 0
    assert_allclose(far_points(other, replace(frames, noise_variance=0.0)), 0.3)


def test_neighbours_are_groups_of_equal_size(rng):
    centres = 10 * rng.normal(size=(3, N_GROUPS))
    points = np.repeat(centres, 4, axis=1) + rng.normal(size=(3, 4 * N_GROUPS))
    groups = neighbours(points)
    assert_array_equal(groups, np.repeat(groups[::4], 4))
    assert_array_equal(np.unique(groups), range(N_GROUPS))
    assert_array_equal(np.bincount(neighbours(points[:, :17])), [4, 4, 3, 3, 3])


@pytest.mark.slow
def test_orthographic_deviations_of_a_body_that_deforms_further_than_the_model():
    scene = make_body_tracks(150, camera="orthographic", random_state=0)
    X, model = scene.data, fitted(scene.data, 3, "orthographic")
    points = scene.shapes @ full_rotations(scene.motion)[0].mT
    points *= full_rotations(scene.motion)[1][:, None, None]
    off, error = error_of_depths(model, X, points)
    assert error / 2 < model.depth_uncertainty_ < 2 * error
    deviation = model.reconstruct(X, return_std=True)[1] * model.scales_[:, None]
    assert 0.5 < np.sqrt(np.mean((off / deviation) ** 2)) < 2


test_refusals = refusals_of("frame_fit", globals())
