"""Gauss-Newton steps on the reprojection residual, for tables without noise."""

from typing import NamedTuple

import numpy as np
import pytest
from layers import slow_after
from numpy.testing import assert_allclose, assert_array_equal
from numpy.typing import NDArray

from isa_nrsfm import AffineNRSfM
from isa_nrsfm._frames.camera_models import CAMERAS, nearest_calibrated
from isa_nrsfm._frames.point_sums import frame_tracks
from isa_nrsfm._joint import noise_free as module
from isa_nrsfm._joint.likely_basis import likely_basis
from isa_nrsfm._joint.noise_free import (
    FramesAndShapes,
    complete_frames,
    compressed,
    fit_without_noise,
    frame_tangents,
    minimise,
    motion_rows,
    normal_equations,
)
from isa_nrsfm._joint.options import JOINT_OPTIONS
from isa_nrsfm._linalg.vectors import frames_first, frames_last
from isa_nrsfm._tables.blocks import MemoryBlocks
from isa_nrsfm.datasets import make_face_tracks, make_nonrigid_tracks
from isa_nrsfm.metrics import affine_shape_error

EACH = pytest.mark.parametrize("camera", CAMERAS)
AFFINE = CAMERAS["affine"]


def in_blocks(parts):
    """Return frames as the joint refinement has them."""
    lengths = [len(part.weight) for part in parts]
    return MemoryBlocks(parts, lengths)


class Scene(NamedTuple):
    tracks: NDArray  # (n_frames, n_points, 2), centred
    shapes: NDArray  # (n_shapes, 3, n_points)
    motion: NDArray  # (n_frames, 2, 3)
    alpha: NDArray  # (n_frames, n_components)

    def frame_shapes(self, shapes, alpha):
        """Return the shapes of all frames (n_frames, n_points, 3)."""
        frames = shapes[0] + np.tensordot(alpha, shapes[1:], 1)
        return frames.swapaxes(1, 2)


def random_scene(
    seed=0, n_frames=40, n_points=30, n_components=2, noise=0.0, camera="affine"
):
    """Return a table that follows the model, and what made it."""
    rng = np.random.default_rng(seed)
    shapes = rng.normal(size=(n_components + 1, 3, n_points))
    shapes[1:] *= 0.3
    shapes -= shapes.mean(axis=2, keepdims=True)
    motion = rng.normal(size=(n_frames, 2, 3))
    if camera != "affine":
        motion, scales = nearest_calibrated(motion)
        if camera == "weak_perspective":
            motion = scales[:, None, None] * motion
    alpha = rng.normal(size=(n_frames, n_components))
    frames = shapes[0] + np.tensordot(alpha, shapes[1:], 1)
    tracks = (motion @ frames).swapaxes(1, 2)
    tracks += noise * rng.normal(size=tracks.shape)
    return Scene(tracks - tracks.mean(axis=1, keepdims=True), shapes, motion, alpha)


def moved(cameras, motion, step):
    """Return cameras (n_frames, 2, 3) after steps (n_parameters, n_frames)."""
    return frames_first(cameras.moved(frames_last(motion), step))


def in_row_space(scene, size=0.0, seed=1, camera="affine"):
    """Return tracks in a basis of their row space, and a state some way off."""
    rng = np.random.default_rng(seed)
    b = scene.shapes.reshape(-1, scene.shapes.shape[2])
    rows, V = compressed(scene.tracks.swapaxes(1, 2), b)
    exact = b @ V, scene.motion, scene.alpha
    shapes, motion, alpha = (
        part + size * rng.normal(size=part.shape) for part in exact
    )
    if camera != "affine":
        cameras = CAMERAS[camera]
        step = size * rng.normal(size=(cameras.n_parameters, len(motion)))
        step[3:] /= max(size, 1.0)  # of the logarithms of the scales
        motion = moved(cameras, scene.motion, step)
    return rows, FramesAndShapes(shapes, motion, alpha)


def images(state):
    return motion_rows(state.motion, state.alpha) @ state.shapes


def square(rows, state):
    return float(np.sum((rows - images(state)) ** 2))


def assert_of_model(motion, camera):
    """Check that cameras (n_frames, 2, 3) are those of a model."""
    if camera == "affine":
        return
    gram = motion @ motion.swapaxes(1, 2)
    scale = np.trace(gram, axis1=1, axis2=2)[:, None, None] / 2
    assert_allclose(gram / scale, np.broadcast_to(np.eye(2), gram.shape), atol=1e-11)
    if camera == "orthographic":
        assert_allclose(scale, 1.0, rtol=1e-11)


def with_gaps(tracks, share, seed=2):
    """Return tracks with random points that are missing, and the weights."""
    weights = 1.0 * (np.random.default_rng(seed).random(tracks.shape[:2]) >= share)
    return np.where(weights[..., None] > 0, tracks, np.nan), weights


class TestEquations:
    @EACH
    def test_tangents_are_the_derivatives_by_cameras_and_coefficients(self, camera):
        _, state = in_row_space(random_scene(camera=camera), size=0.1, camera=camera)
        cameras = CAMERAS[camera]
        tangents = frame_tangents(state, cameras)
        n, h = cameras.n_parameters, 1e-5
        assert tangents.shape[2] == n + 2
        for column in range(n + 2):
            change = 0.0
            for sign in (1, -1):
                step, alpha = np.zeros((n, len(state.motion))), state.alpha.copy()
                if column < n:
                    step[column] = sign * h
                else:
                    alpha[:, column - n] += sign * h
                motion = moved(cameras, state.motion, step)
                other = FramesAndShapes(state.shapes, motion, alpha)
                change = change + sign * images(other).reshape(len(alpha), -1)
            assert_allclose(change / (2 * h), tangents[:, :, column], atol=1e-8)

    @EACH
    def test_they_are_those_of_all_unknowns_with_the_frames_eliminated(self, camera):
        scene = random_scene(n_frames=15, camera=camera)
        rows, state = in_row_space(scene, size=0.1, camera=camera)
        cameras = CAMERAS[camera]
        frames = module._Frames.at(rows, state, cameras)
        system = normal_equations(frames, state)
        X = motion_rows(state.motion, state.alpha)
        n_directions = rows.shape[2]
        matrix, right = 0.0, 0.0
        for x, tangent, rest in zip(
            X, frame_tangents(state, cameras), rows - images(state), strict=True
        ):
            by_shapes = np.kron(x, np.eye(n_directions))
            off = np.eye(len(tangent)) - tangent @ np.linalg.pinv(tangent)
            matrix = matrix + by_shapes.T @ off @ by_shapes
            right = right + by_shapes.T @ off @ rest.ravel()
        scaling = np.kron(np.linalg.inv(system.root), np.eye(n_directions))
        assert_allclose(system.matrix, scaling.T @ matrix @ scaling, atol=1e-10)
        assert_allclose(system.slope.ravel(), scaling.T @ right, atol=1e-10)

    @EACH
    @pytest.mark.parametrize("n_components", [1, 2, 4])
    def test_nothing_but_the_basis_is_free(self, n_components, camera):
        scene = random_scene(n_components=n_components, camera=camera)
        rows, state = in_row_space(scene)
        frames = module._Frames.at(rows, state, CAMERAS[camera])
        values = np.linalg.eigvalsh(normal_equations(frames, state).matrix)
        n_free = {
            # A 3x3 affinity and a mixing of all shapes, which share one scale.
            "affine": (n_components + 1) ** 2 + 8,
            # A rotation instead.
            "weak_perspective": (n_components + 1) ** 2 + 3,
            # Nor does a scale of a frame absorb parts along the mean shape.
            "orthographic": (n_components + 1) * n_components + 3,
        }[camera]
        assert_allclose(values[:n_free], 0.0, atol=1e-10)
        assert values[n_free] > 1e-4
        assert values[-1] < 1 + 1e-10


class TestMinimise:
    @EACH
    @pytest.mark.parametrize("seed", range(3))
    def test_exact_tables_are_fitted_to_rounding_errors(self, seed, camera):
        scene = random_scene(seed, camera=camera)
        rows, start = in_row_space(scene, size=0.05, camera=camera)
        end = minimise(rows, start, CAMERAS[camera])
        assert_of_model(end.motion, camera)
        assert square(rows, start) > 1e-4 * np.vdot(rows, rows)
        assert square(rows, end) < 1e-28 * np.vdot(rows, rows)

    @EACH
    def test_the_first_order_conditions_hold_where_there_is_noise(self, camera):
        scene = random_scene(noise=1e-3, camera=camera)
        rows, start = in_row_space(scene, size=0.02, camera=camera)
        end = minimise(rows, start, CAMERAS[camera])
        frames = module._Frames.at(rows, end, CAMERAS[camera])
        rest = np.sqrt(square(rows, end))
        along = np.einsum("ipt,ip->it", frames.tangent, frames.rest)
        assert np.abs(along).max() < 1e-3 * rest
        assert np.abs(normal_equations(frames, end).slope).max() < 1e-3 * rest

    @EACH
    @pytest.mark.parametrize("size", [0.1, 1.0, 10.0])
    def test_it_never_ends_above_the_start(self, size, camera):
        scene = random_scene(noise=0.1, camera=camera)
        rows, start = in_row_space(scene, size=size, camera=camera)
        end = minimise(rows, start, CAMERAS[camera])
        assert square(rows, end) < square(rows, start)
        assert_of_model(end.motion, camera)

    def test_steps_go_along_with_the_basis(self):
        few = JOINT_OPTIONS.noise_free._replace(max_steps=3)
        rows, start = in_row_space(random_scene(noise=0.01), size=0.1)
        rng = np.random.default_rng(5)
        space = np.eye(3) + 0.3 * rng.normal(size=(3, 3))
        mixing = np.eye(2) + 0.3 * rng.normal(size=(2, 2))
        shift = rng.normal(size=2)
        b = start.shapes.reshape(3, 3, -1)
        b = np.concatenate(
            [[b[0] - np.tensordot(shift, b[1:], 1)], np.tensordot(mixing, b[1:], 1)]
        )
        turned = FramesAndShapes(
            (np.linalg.inv(space) @ b).reshape(9, -1),
            start.motion @ space,
            (start.alpha + shift) @ np.linalg.inv(mixing),
        )
        assert_allclose(images(turned), images(start), atol=1e-12)
        expected = images(minimise(rows, start, AFFINE, few))
        assert np.abs(expected - images(start)).max() > 0.1
        assert_allclose(
            images(minimise(rows, turned, AFFINE, few)), expected, atol=1e-8
        )


class TestRowSpace:
    def test_it_holds_all_of_an_exact_table(self):
        scene = random_scene()
        W = scene.tracks.swapaxes(1, 2)
        rng = np.random.default_rng(3)
        near = scene.shapes + 1e-3 * rng.normal(size=scene.shapes.shape)
        rows, V = compressed(W, near.reshape(9, -1))
        assert_allclose(V.T @ V, np.eye(9), atol=1e-12)
        assert_allclose(rows @ V.T, W, atol=1e-12)

    def test_missing_points_are_found(self):
        scene = random_scene()
        tracks, weights = with_gaps(scene.tracks, 0.2)
        blocks = in_blocks([frame_tracks(tracks, weights)])
        rng = np.random.default_rng(3)
        near = scene.shapes + 1e-3 * rng.normal(size=scene.shapes.shape)
        W, frames = complete_frames(blocks, near.reshape(9, -1), 1000)
        assert len(frames) > 30
        assert_allclose(W, scene.tracks.swapaxes(1, 2)[frames], atol=1e-11)

    def test_points_that_no_frame_shows(self):
        scene = random_scene()
        weights = np.ones(scene.tracks.shape[:2])
        weights[:, 5] = 0.0
        weights[3, 9:12] = 0.0
        blocks = in_blocks([frame_tracks(scene.tracks, weights)])
        W, frames = complete_frames(blocks, scene.shapes.reshape(9, -1), 1000)
        assert_array_equal(frames, np.arange(40))
        assert np.isfinite(W).all()
        # The others are those of the scene, but for where their centre is.
        error = np.delete(W - scene.tracks.swapaxes(1, 2), 5, axis=2)
        assert_allclose(error - error[..., :1], 0, atol=1e-9)

    def test_frames_that_do_not_tell_their_missing_points_are_left_out(self):
        scene = random_scene()
        weights = np.ones(scene.tracks.shape[:2])
        weights[[3, 17], 9:] = 0.0
        blocks = in_blocks([frame_tracks(scene.tracks, weights)])
        _, frames = complete_frames(blocks, scene.shapes.reshape(9, -1), 1000)
        assert_array_equal(frames, np.setdiff1d(np.arange(40), [3, 17]))

    def test_few_frames_are_spread_over_all_blocks(self):
        scene = random_scene()
        parts = np.split(scene.tracks, [10, 25])
        blocks = in_blocks([frame_tracks(part) for part in parts])
        W, frames = complete_frames(blocks, scene.shapes.reshape(9, -1), 12)
        assert_array_equal(frames, [0, 4, 9, 10, 14, 17, 20, 24, 25, 29, 32, 35, 39])
        assert_allclose(W, scene.tracks.swapaxes(1, 2)[frames], atol=1e-13)

    def test_points_of_small_weight_count_as_missing(self):
        scene = random_scene()
        weights = np.random.default_rng(4).choice([0.1, 0.6, 1.0], (40, 30))
        weights[:, :12] = 1.0
        tracks = np.where(weights[..., None] > 0.5, scene.tracks, 7.0)
        blocks = in_blocks([frame_tracks(tracks, weights)])
        W, frames = complete_frames(blocks, scene.shapes.reshape(9, -1), 1000)
        assert_allclose(W, scene.tracks.swapaxes(1, 2)[frames], atol=1e-10)


class TestWholeTable:
    @EACH
    @pytest.mark.parametrize("gaps", [0.0, 0.2])
    @pytest.mark.parametrize("n_components", [1, 3])
    def test_images_of_all_frames_are_exact(self, gaps, n_components, camera):
        scene = random_scene(n_components=n_components, camera=camera)
        tracks, weights = with_gaps(scene.tracks, gaps)
        parts = slice(0, 15), slice(15, 40)
        blocks = in_blocks(
            [frame_tracks(tracks[p], weights[p] if gaps else None) for p in parts]
        )
        rng = np.random.default_rng(3)
        near = [
            part + 0.01 * rng.normal(size=part.shape)
            for part in (scene.shapes, scene.motion, scene.alpha)
        ]
        near[0] -= near[0].mean(axis=2, keepdims=True)
        if camera != "affine":
            step = 0.01 * rng.normal(size=(CAMERAS[camera].n_parameters, 40))
            near[1] = moved(CAMERAS[camera], scene.motion, step)
        copies = [part.copy() for part in near]
        shapes, motion = fit_without_noise(blocks, *near, 0.0, CAMERAS[camera])
        assert_of_model(motion, camera)
        for part, copy in zip(near, copies, strict=True):
            assert_array_equal(part, copy)
        # What the cameras leave open are the coefficients.
        for camera, frame in zip(motion, scene.tracks, strict=True):
            seen = (camera @ shapes).reshape(n_components + 1, -1)
            rest = frame.T.ravel() - seen[0]
            alpha = np.linalg.lstsq(seen[1:].T, rest, rcond=None)[0]
            assert_allclose(alpha @ seen[1:], rest, atol=1e-7)

    def test_a_step_that_would_take_too_long_is_not_made(self):
        scene = random_scene()
        cost = 9**4 * 8  # of a frame, with nine rows of shapes
        blocks = in_blocks([frame_tracks(scene.tracks)])
        for n_frames, enough in ((8, False), (9, True)):
            limits = JOINT_OPTIONS.noise_free._replace(step_cost=cost * n_frames)
            found = fit_without_noise(blocks, *scene[1:], 0.0, AFFINE, limits)
            assert (found is not None) == enough

    def test_nor_where_no_frame_tells_its_missing_points(self):
        scene = random_scene()
        order = np.random.default_rng(4).random(scene.tracks.shape[:2]).argsort(axis=1)
        weights = 1.0 * (order < 9)
        blocks = in_blocks([frame_tracks(scene.tracks, weights)])
        assert fit_without_noise(blocks, *scene[1:], 0.0, AFFINE) is None

    @pytest.mark.parametrize("penalty", [0.0, 0.5, 300.0])
    def test_no_other_basis_is_likelier(self, penalty):
        scene = random_scene()
        shapes = likely_basis(*scene[1:], penalty)

        def objective(shift, mixing):
            # alpha of these shapes from the true ones: S = B_0 + alpha B.
            basis = np.tensordot(mixing, shapes[1:], 1).reshape(2, -1)
            mean = shapes[0] + np.tensordot(shift, shapes[1:], 1)
            frames = scene.frame_shapes(scene.shapes, scene.alpha).swapaxes(1, 2)
            alpha = (frames - mean).reshape(40, -1) @ np.linalg.pinv(basis)
            seen = np.einsum("ira,kaj->ikrj", scene.motion, basis.reshape(2, 3, -1))
            gram = np.einsum("ikrj,ilrj->ikl", seen, seen)
            value = np.linalg.slogdet(gram)[1].sum() + np.sum(alpha**2)
            return value + penalty * np.trace(gram, axis1=1, axis2=2).sum()

        least = objective(np.zeros(2), np.eye(2))
        rng = np.random.default_rng(6)
        for _ in range(10):
            step = 0.01 * rng.normal(size=2), np.eye(2) + 0.01 * rng.normal(size=(2, 2))
            assert objective(*step) > least

    def test_coefficients_that_are_all_zero(self):
        scene = random_scene()
        shapes = likely_basis(scene.shapes, scene.motion, 0 * scene.alpha, 0.0)
        assert_allclose(shapes[0], scene.shapes[0])
        assert np.isfinite(shapes).all()


class TestEstimator:
    @pytest.mark.parametrize("n_components", [2, 4])
    def test_few_faces(self, n_components):
        faces = make_face_tracks(
            60, n_components=n_components, noise=0.0, random_state=0
        )
        model = AffineNRSfM(n_components, random_state=0).fit(faces.data)
        assert model.inverse_snr_ < 1e-18
        error = affine_shape_error(faces.shapes, model.reconstruct(faces.data))
        assert error < 1e-9

    @pytest.mark.parametrize("seed", slow_after(1, range(2)))
    @pytest.mark.parametrize("missing", [0.0, 0.15])
    def test_exact_tables_with_and_without_gaps(self, seed, missing):
        truth = make_nonrigid_tracks(
            80, 30, 2 + seed, noise=0.0, missing=missing, random_state=seed
        )
        model = AffineNRSfM(2 + seed, random_state=0).fit(truth.data)
        assert model.inverse_snr_ < 1e-18
        error = affine_shape_error(truth.shapes, model.reconstruct(truth.data))
        assert error < 1e-9
        assert_allclose(model.transform(truth.data), model.alpha_, atol=1e-10)
