"""The number of basis shapes that a table determines."""

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
from numpy.testing import assert_allclose
from scenes import random_scene, with_gaps

from isa_nrsfm._frames.camera_models import CAMERAS
from isa_nrsfm._joint.frames import JointFrames
from isa_nrsfm._joint.likelihood import MarginalLikelihood
from isa_nrsfm._joint.problem import JointProblem, JointSettings
from isa_nrsfm._joint.quasi_newton import JointState
from isa_nrsfm._joint.relevance import relevant_components
from isa_nrsfm._tables.blocks import FrameBlocks

AFFINE = CAMERAS["affine"]
NOISE = 0.05
N_POINTS = 12


def random_problem(kind="complete", n_frames=30, **options):
    """Return the problem of a random table, and a state with its shapes and cameras."""
    scene = random_scene(0, n_frames, N_POINTS, noise=NOISE, **options)
    complete, tracks, shapes = kind != "missing", scene.centred, scene.shapes
    if not complete:
        tracks = with_gaps(tracks, 0.2)
    rows = FrameBlocks.of_array(tracks.transpose(0, 2, 1), 64)
    frames = JointFrames.from_points(rows, complete)
    if kind == "directions":
        directions = np.linalg.svd(shapes.reshape(-1, N_POINTS))[2][: N_POINTS - 1]
        frames = JointFrames.from_directions(rows, directions)
        shapes = frames.coordinates(shapes)
    settings = JointSettings("affine", "linear", 100, 1e-3)
    problem = JointProblem(frames, settings, penalty=0.02)
    return problem, JointState(shapes, scene.motion, NOISE**2)


def counted(problem, state, threshold=None):
    """Return the number of relevant shapes, by another threshold of shares."""
    settings = problem.settings
    if threshold is not None:
        options = settings.options._replace(determined=threshold)
        settings = settings._replace(options=options)
    return relevant_components(replace(problem, settings=settings), state, AFFINE)


def mean_images(state):
    """Return the mean over frames of the products <M B_k, M B_l>."""
    images = [(M @ state.shapes[1:]).reshape(3, -1) for M in state.motion]
    return np.mean([image @ image.T for image in images], axis=0)


def shares_and_variances(problem, state, penalty):
    """Return g_k and v_k after a round from prior variances 1 / (n_frames penalty)."""
    curvature = MarginalLikelihood(problem.frames, penalty)(*state).shape_curvature
    C = np.mean([M.T @ M for M in state.motion], axis=0)
    traces = np.zeros(3)
    for j in range(N_POINTS):
        covariance = NOISE**2 * np.linalg.inv(curvature[j % len(curvature)])
        for k in range(3):
            of_shape = slice(3 * k + 3, 3 * k + 6)
            traces[k] += np.trace(C @ covariance[of_shape, of_shape])
    v = 1 / (len(state.motion) * penalty)
    g = 1 - traces / (3 * N_POINTS * v)
    return g, np.diag(mean_images(state)) / (3 * N_POINTS * g)


class TestRelevantComponents:
    @pytest.mark.parametrize("kind", ["complete", "missing", "directions"])
    def test_rounds_by_their_definition(self, kind, monkeypatch):
        problem, state = random_problem(kind)
        rounds = []

        def held(problem, state, cameras, **options):
            rounds.append((problem.penalty, state))
            return SimpleNamespace(state=state)

        monkeypatch.setattr(JointProblem, "refined", held)
        counted(problem, state)
        assert_allclose(rounds[0][0], np.full(3, problem.penalty))
        assert len(rounds) == 3
        prices = [penalty for penalty, _ in rounds[1:]] + [None]
        for (penalty, reached), following in zip(rounds, prices, strict=True):
            # Another basis of the same shapes, whose images are orthogonal
            assert_allclose(reached.shapes[0], state.shapes[0])
            before = np.linalg.pinv(state.shapes[1:].reshape(3, -1))
            mixing = reached.shapes[1:].reshape(3, -1) @ before
            assert_allclose(mixing @ mixing.T, np.eye(3), atol=1e-10)
            energies = np.linalg.eigvalsh(mean_images(state))[::-1]
            assert_allclose(mean_images(reached), np.diag(energies), atol=1e-9)
            shares, variances = shares_and_variances(problem, reached, penalty)
            if following is not None:
                expected = 1 / (variances * len(state.motion))
                assert_allclose(following, expected, rtol=1e-6)
        for n, threshold in enumerate(np.sort(shares)[::-1]):
            assert 0.0 < threshold < 1.0
            assert counted(problem, state, threshold + 1e-6) == n
            assert counted(problem, state, threshold - 1e-6) == n + 1

    def test_true_shapes_are_and_those_of_noise_are_not(self):
        problem, state = random_problem(n_frames=60, n_components=2)
        spare = 0.05 * np.random.default_rng(1).normal(size=(2, 3, N_POINTS))
        spare -= spare.mean(axis=2, keepdims=True)
        shapes = np.concatenate([state.shapes, spare])
        assert counted(problem, state._replace(shapes=shapes)) == 2

    def test_of_a_rigid_object(self):
        problem, state = random_problem()
        rigid = np.array([1.0, 0.0, 0.0, 0.0])[:, None, None]
        assert counted(problem, state._replace(shapes=rigid * state.shapes)) == 0
