"""Calibrated cameras to start the joint fit from, and the shapes that they see."""

from types import SimpleNamespace
from typing import NamedTuple

import numpy as np
import pytest
from frame_parts import assert_calibrated
from numpy.testing import assert_allclose, assert_array_equal
from numpy.typing import NDArray

from isa_nrsfm._frames.camera_models import CAMERAS, AffineCameras, nearest_calibrated
from isa_nrsfm._frames.models import FrameMap, PosteriorFrames
from isa_nrsfm._joint.fit import Start, _calibrated_fit, _continued_fit, _first_fit
from isa_nrsfm._joint.frames import JointFrames
from isa_nrsfm._joint.problem import FactorisedTable, JointProblem, JointSettings
from isa_nrsfm._joint.quasi_newton import JointState
from isa_nrsfm._joint.starts import (
    HELD_STEPS,
    affine_start,
    best_starts,
    extended_shapes,
    lifted_shapes,
    likely_basis,
    mixed_cameras,
    rigid_start,
)
from isa_nrsfm._paper.factors import Factorisation, factorise
from isa_nrsfm._paper.sample import Sample
from isa_nrsfm._selection.path import extended
from isa_nrsfm._tables.blocks import FrameBlocks
from isa_nrsfm.datasets import make_nonrigid_tracks

N_POINTS = 40
BOTH = pytest.mark.parametrize("camera", ["weak_perspective", "orthographic"])


class Scene(NamedTuple):
    rows: NDArray  # (n_frames, 2, n_points), centred
    motion: NDArray  # (n_frames, 2, 3)
    shapes: NDArray  # (n_components + 1, 3, n_points)

    @property
    def W(self):
        return self.rows.reshape(-1, self.rows.shape[2])

    @property
    def factors(self) -> Factorisation:
        return factorise(self.W, 2)

    @property
    def scales(self):
        return np.linalg.norm(self.motion, axis=(1, 2)) / np.sqrt(2)


def random_scene(camera="orthographic", seed=0, n_frames=60, n_components=2, **options):
    options |= {"camera": camera, "random_state": seed}
    truth = make_nonrigid_tracks(n_frames, N_POINTS, n_components, **options)
    tracks = truth.tracks - truth.tracks.mean(axis=1, keepdims=True)
    shapes = np.concatenate([truth.mean_shape[None], truth.basis])
    rows = np.ascontiguousarray(tracks.transpose(0, 2, 1))
    return Scene(rows, truth.motion, shapes.transpose(0, 2, 1))


def camera_error(motion, truth):
    """Return the largest error of cameras up to a rotation or reflection of space."""
    U, _, Vt = np.linalg.svd(motion.reshape(-1, 3).T @ truth.reshape(-1, 3))
    return np.abs(motion @ (U @ Vt) - truth).max()


class TestRigidStart:
    @BOTH
    def test_of_a_rigid_object_is_the_truth(self, camera):
        scene = random_scene(camera, n_components=0)
        factors = scene.factors
        paper = np.concatenate([factors.rigid_shape[None], np.zeros((2, 3, N_POINTS))])
        scaled = camera == "weak_perspective"
        motion, shapes = rigid_start(factors, paper, scaled)
        assert_calibrated(motion, camera)
        size = np.sqrt(np.mean(scene.scales**2)) if scaled else 1.0
        assert camera_error(size * motion, scene.motion) < 1e-8
        assert_allclose(motion @ shapes[0], scene.rows, atol=1e-8)

    @BOTH
    def test_images_of_all_shapes_are_those_of_the_nearest_affine_cameras(self, camera):
        # The metric changes neither what rigid cameras see, nor the unit of what the
        # calibrated ones see on average.
        scene = random_scene(camera, amplitude=0.4)
        factors = scene.factors
        paper = np.random.default_rng(1).normal(size=(3, 3, N_POINTS))
        scaled = camera == "weak_perspective"
        motion, shapes = rigid_start(factors, paper, scaled)
        assert_calibrated(motion, camera)
        # All shapes change alike: one Q.
        Q = np.linalg.lstsq(shapes[0].T, paper[0].T)[0].T
        assert_allclose(Q @ shapes, paper, atol=1e-10)
        rows, sizes = nearest_calibrated(factors.rigid_motion.reshape(-1, 2, 3) @ Q)
        if scaled:
            assert_allclose(motion, sizes[:, None, None] * rows, atol=1e-10)
        else:
            assert_allclose(motion, rows, atol=1e-10)
            assert sizes.mean() == pytest.approx(1.0)


class TestMixedCameras:
    @pytest.mark.parametrize("seed", range(4))
    def test_exact_cameras_are_among_them(self, seed):
        scene = random_scene(seed=seed)
        found = list(mixed_cameras(scene.rows, None, np.arange(60)))
        errors = [camera_error(motion, scene.motion) for motion in found]
        rigid = rigid_start(scene.factors, scene.shapes, False)[0]
        # The cost is of fourth order in some directions.
        assert min(errors) < 1e-4
        assert camera_error(rigid, scene.motion) > 0.05

    def test_known_scales_give_exact_cameras_of_weak_perspective(self):
        scene = random_scene("weak_perspective")
        found = mixed_cameras(scene.rows, scene.scales, np.arange(60))
        assert min(camera_error(motion, scene.motion) for motion in found) < 1e-4

    def test_of_some_frames_give_those_of_all(self):
        scene = random_scene()
        found = list(mixed_cameras(scene.rows, None, np.arange(0, 60, 2)))
        assert all(motion.shape == (60, 2, 3) for motion in found)
        assert min(camera_error(motion, scene.motion) for motion in found) < 1e-4

    @BOTH
    def test_are_calibrated(self, camera):
        scene = random_scene(camera, noise=0.05)
        scales = scene.scales if camera == "weak_perspective" else None
        found = list(mixed_cameras(scene.rows, scales, np.arange(60)))
        # Of up to 6, 9, 12, 18, 24 and 36 columns of the 39 there are.
        assert len(found) == 6
        for motion in found:
            assert_calibrated(motion, camera)

    @pytest.mark.parametrize(("n_points", "expected"), [(5, 1), (8, 2), (15, 3)])
    def test_no_wider_than_the_table(self, n_points, expected):
        rows = random_scene(noise=0.05).rows[..., :n_points]
        rows = rows - rows.mean(axis=2, keepdims=True)
        found = list(mixed_cameras(rows, None, np.arange(60)))
        assert len(found) == expected


class TestLiftedShapes:
    @BOTH
    def test_mean_shape_is_that_of_least_squares(self, camera):
        scene = random_scene(camera)
        mean = lifted_shapes(scene.rows, scene.motion, 2)[0]
        stacked = scene.motion.reshape(-1, 3)
        expected = np.linalg.lstsq(stacked, scene.W)[0]
        assert_allclose(mean, expected, atol=1e-12)

    @BOTH
    @pytest.mark.parametrize("n_frames", [60, 200])
    def test_basis_shapes_are_principal_directions(self, camera, n_frames):
        # With more frames than coordinates, and with fewer.
        scene = random_scene(camera, n_frames=n_frames)
        shapes = lifted_shapes(scene.rows, scene.motion, 3)
        pairs = zip(scene.rows, scene.motion, strict=True)
        lifted = [(np.linalg.pinv(M) @ (W - M @ shapes[0])).ravel() for W, M in pairs]
        _, S, Vt = np.linalg.svd(np.array(lifted), full_matrices=False)
        flat = shapes[1:].reshape(3, -1)
        assert_allclose(np.linalg.norm(flat, axis=1), S[:3] / np.sqrt(n_frames))
        cosines = flat @ Vt[:3].T / np.linalg.norm(flat, axis=1)[:, None]
        assert_allclose(np.abs(cosines), np.eye(3), atol=1e-6)

    def test_zeros_where_there_are_not_as_many(self):
        scene = random_scene(n_frames=4)
        shapes = lifted_shapes(scene.rows, scene.motion, 6)
        assert shapes.shape == (7, 3, N_POINTS)
        assert_array_equal(shapes[5:], 0.0)
        assert np.isfinite(shapes).all()

    def test_cameras_of_zero(self):
        scene = random_scene("weak_perspective")
        scene.motion[3] = 0.0
        assert np.isfinite(lifted_shapes(scene.rows, scene.motion, 2)).all()


def problem_of(scene, thorough=True):
    rows = FrameBlocks.of_array(scene.rows, 64)
    frames = JointFrames.from_points(rows, True)
    settings = JointSettings("orthographic", "linear", 1000, 0.01)
    return JointProblem(frames, settings, thorough)


def paper_shapes(factors):
    """Return the rigid shape and the first triples of signals."""
    triples = factors.signals.reshape(-1, 3, N_POINTS)[:2]
    return np.concatenate([factors.rigid_shape[None], triples])


def started(scene, camera, problem=None):
    """Return the starts."""
    factors = scene.factors
    problem = problem or problem_of(scene)
    paper = paper_shapes(factors)
    table = FactorisedTable(*[None] * 5, Sample(scene.W, []), factors)
    return best_starts(problem, table, paper, CAMERAS[camera])


class TestBestStarts:
    @BOTH
    @pytest.mark.parametrize("noise", [0.0, 0.02])
    def test_best_is_likelier_than_each_start(self, camera, noise):
        scene = random_scene(camera, amplitude=0.4, noise=noise)
        problem = problem_of(scene)
        states = started(scene, camera, problem)
        for state in states:
            assert_calibrated(state.motion, camera)
        value = min(problem.likelihood(*state).value for state in states)
        scaled = camera == "weak_perspective"
        rigid, _ = rigid_start(scene.factors, scene.shapes, scaled)
        scales = np.linalg.norm(rigid, axis=(1, 2)) / np.sqrt(2)
        candidates = [rigid]
        mixed = mixed_cameras(scene.rows, scales if scaled else None, np.arange(60))
        candidates += list(mixed)[:2]
        least_noise = problem.settings.options.least_noise
        for motion in candidates:
            shapes = lifted_shapes(scene.rows, motion, 2)
            noise_variance = 0.1 * np.mean((scene.rows - motion @ shapes[0]) ** 2)
            noise_variance = max(noise_variance, least_noise * problem.mean_square)
            start = JointState(shapes, motion, noise_variance)
            held = problem.refined(start, AffineCameras(held=True), max_iter=HELD_STEPS)
            assert value < held.history[-1]

    @pytest.mark.parametrize("seed", range(2))
    def test_has_nearly_the_true_cameras_where_the_rigid_ones_are_wrong(self, seed):
        scene = random_scene(seed=seed, amplitude=0.6)
        rigid, _ = rigid_start(scene.factors, scene.shapes, False)
        assert camera_error(rigid, scene.motion) > 0.3
        motion = started(scene, "orthographic")[0].motion
        assert camera_error(motion, scene.motion) < 0.05

    @pytest.mark.parametrize(("thorough", "n_starts"), [(False, 1), (True, 3)])
    def test_of_many_frames_has_cameras_of_all(self, thorough, n_starts):
        # The comparison is of some of them.
        scene = random_scene(n_frames=450, noise=0.01)
        problem = problem_of(scene, thorough)
        states = started(scene, "orthographic", problem)
        assert len(states) == n_starts
        for state in states:
            assert state.motion.shape == (450, 2, 3)
            assert_calibrated(state.motion, "orthographic")
            assert camera_error(state.motion, scene.motion) < 0.2


class TestAffineStart:
    def test_is_the_rigid_fit(self):
        scene = random_scene(noise=0.02)
        paper = paper_shapes(scene.factors)
        state = affine_start(problem_of(scene), scene.W, paper)
        assert_array_equal(state.shapes[0], paper[0])
        left = 0.0
        for i, W in enumerate(scene.rows):
            M = W @ np.linalg.pinv(paper[0])
            assert_allclose(state.motion[i], M, atol=1e-12)
            left += np.sum((W - M @ paper[0]) ** 2)
        assert state.noise == pytest.approx(0.1 * left / scene.rows.size)

    def test_noise_is_not_below_the_floor(self):
        scene = random_scene(amplitude=0.0)
        problem = problem_of(scene)
        state = affine_start(problem, scene.W, paper_shapes(scene.factors))
        floor = problem.settings.options.least_noise * np.mean(scene.rows**2)
        assert state.noise == pytest.approx(floor)

    def test_basis_shapes_are_one_deviation_of_their_coefficients(self):
        scene = random_scene(noise=0.02)
        paper = paper_shapes(scene.factors)
        state = affine_start(problem_of(scene), scene.W, paper)
        for before, after in zip(paper[1:], state.shapes[1:], strict=True):
            images = state.motion @ before
            norms = np.sum(images**2, axis=(1, 2))
            alpha = np.sum(images * scene.rows, axis=(1, 2)) / norms
            assert_allclose(after, np.std(alpha) * before, rtol=1e-10)

    def test_basis_shapes_that_no_camera_sees_are_zero(self):
        scene = random_scene()
        paper = paper_shapes(scene.factors)
        paper[2] = 0.0
        state = affine_start(problem_of(scene), scene.W, paper)
        assert_array_equal(state.shapes[2], 0.0)
        assert np.isfinite(state.shapes).all()


def random_frames(seed=0, n_frames=40, n_points=30, n_components=2):
    """Return shapes, cameras and coefficients."""
    rng = np.random.default_rng(seed)
    shapes = rng.normal(size=(n_components + 1, 3, n_points))
    shapes[1:] *= 0.3
    motion = rng.normal(size=(n_frames, 2, 3))
    return shapes, motion, rng.normal(size=(n_frames, n_components))


class TestLikelyBasis:
    @pytest.mark.parametrize("penalty", [0.0, 0.5, 300.0])
    def test_no_other_basis_is_likelier(self, penalty):
        truth, motion, true_alpha = random_frames()
        shapes = likely_basis(truth, motion, true_alpha, penalty)
        frames = truth[0] + np.tensordot(true_alpha, truth[1:], 1)

        def objective(shift, mixing):
            # alpha of these shapes from the true ones: S = B_0 + alpha B.
            basis = np.tensordot(mixing, shapes[1:], 1).reshape(2, -1)
            mean = shapes[0] + np.tensordot(shift, shapes[1:], 1)
            alpha = (frames - mean).reshape(40, -1) @ np.linalg.pinv(basis)
            seen = np.einsum("ira,kaj->ikrj", motion, basis.reshape(2, 3, -1))
            gram = np.einsum("ikrj,ilrj->ikl", seen, seen)
            value = np.linalg.slogdet(gram)[1].sum() + np.sum(alpha**2)
            return value + penalty * np.trace(gram, axis1=1, axis2=2).sum()

        least = objective(np.zeros(2), np.eye(2))
        rng = np.random.default_rng(6)
        for _ in range(10):
            step = 0.01 * rng.normal(size=2), np.eye(2) + 0.01 * rng.normal(size=(2, 2))
            assert objective(*step) > least

    def test_coefficients_that_are_all_zero(self):
        truth, motion, alpha = random_frames()
        shapes = likely_basis(truth, motion, 0 * alpha, 0.0)
        assert_allclose(shapes[0], truth[0])
        assert np.isfinite(shapes).all()


@pytest.mark.parametrize("n_frames", [150, 300])
def test_more_basis_shapes_come_from_residuals_of_some_frames(n_frames):
    shapes, motion, alpha = random_frames(n_frames=n_frames, n_components=3)
    shapes -= shapes.mean(axis=2, keepdims=True)
    rows = motion @ (shapes[0] + np.tensordot(alpha, shapes[1:], 1))
    moved = rows + np.random.default_rng(1).normal(size=(n_frames, 2, 1))
    still = np.zeros((0, 1)), "linear", FrameMap.identity(1)
    frames = PosteriorFrames(shapes[:2], 1e-3, *still)
    table = SimpleNamespace(rows=FrameBlocks.of_array(moved, 64))
    start = extended(frames, table, 3)
    assert start.noise_variance == 1e-3
    few = np.linspace(0, n_frames - 1, min(n_frames, 200)).round().astype(int)
    fit = frames.posterior(rows[few])
    centred = rows[few] - fit.translation[:, :, None]
    expected = extended_shapes(centred, shapes[:2], fit.motion, fit.alpha, 2)
    assert start.shapes.shape == (4, 3, 30)
    # The signs of principal components are free.
    sign = np.sign(np.einsum("kaj,kaj->k", start.shapes, expected))[:, None, None]
    assert_array_equal(start.shapes[:2], shapes[:2])
    assert_allclose(sign * start.shapes, expected, atol=1e-6)


def test_the_better_given_start_is_taken_whatever_the_order():
    # A basis shape of zero stays zero: from there the fit cannot catch up.
    scene = random_scene(noise=0.02)
    good = Start(scene.shapes, 1e-3)
    poor = Start(scene.shapes * np.array([1, 1, 0])[:, None, None], 1e-3)
    several = [good], [good, poor], [poor, good]
    ends = [_continued_fit(problem_of(scene), each)[0].value for each in several]
    assert_allclose(ends[1:], ends[0], rtol=1e-4)


def test_the_likeliest_fit_of_the_starts_counts():
    scene = random_scene(amplitude=0.6, noise=0.02)
    problem, factors = problem_of(scene), scene.factors
    camera, states = CAMERAS["orthographic"], started(scene, "orthographic", problem)
    ends = [_calibrated_fit(problem, state, camera).value for state in states]
    table = FactorisedTable(*[None] * 5, Sample(scene.W, []), factors)
    fit, _ = _first_fit(problem, table, paper_shapes(factors))
    assert max(ends) > min(ends)
    assert fit.value == min(ends)
