"""The marginal likelihood of cameras, shapes and noise, and its derivatives."""

import numpy as np
import pytest
import scenes
from frame_parts import Regression
from numpy.testing import assert_allclose
from scenes import likelihood_of, shape_prior
from scipy.linalg import block_diag

from isa_nrsfm._joint.likelihood import EXTENT_WEIGHT

NOISE = 0.05
PENALTY = 7.0


class Scene(scenes.Scene):
    """A table, and shapes and cameras that are near it, but not at the optimum."""

    def at(self, penalty=0.0, noise=NOISE, prior=None, precisions=None, **options):
        """Return the objective and its derivatives, frames first."""
        likelihood = likelihood_of(self.tracks, self.weights, penalty, **options)
        likelihood = likelihood._replace(prior=prior, precisions=precisions)
        terms = likelihood(self.shapes, self.motion, noise)
        gradient = terms.motion_gradient.transpose(2, 0, 1)
        return terms._replace(motion_gradient=gradient)


def random_scene(kind, n_components=3):
    """Return a scene: "complete", "weighted", or "missing", NaN at some points."""
    return Scene(*scenes.random_scene(0, 11, 9, n_components, noise=0.2, kind=kind))


def frames_of(scene):
    """Return the frames by dense linear algebra."""
    return [Regression.of(scene, i) for i in range(len(scene.tracks))]


def second_moments(frame, noise, penalty):
    """Return E of a frame with what the penalty adds to it."""
    c = np.concatenate([[1.0], frame.mean(noise)])
    E = np.outer(c, c)
    E[1:, 1:] += noise * np.linalg.inv(frame.precision(noise))
    E[1:, 1:] += noise * np.eye(len(c) - 1) * penalty
    return E


@pytest.fixture(params=["complete", "weighted", "missing"])
def scene(request):
    """Return a scene of each kind."""
    return random_scene(request.param)


def with_few_basis_shapes(scene):
    """Return a scene, without its basis shapes, and with basis shapes of zero."""
    zeros = scene.shapes * np.eye(len(scene.shapes))[0][:, None, None]
    return scene, *(scene._replace(shapes=each) for each in (scene.shapes[:1], zeros))


PENALTIES = pytest.mark.parametrize("penalty", [0.0, np.array([0.5, 2.0, 7.0])])


def precisions():
    """Return positive definite matrices, one for each basis shape."""
    roots = np.random.default_rng(3).normal(size=(3, 3, 4))
    return roots @ roots.mT


class TestValue:
    def test_is_minus_two_log_of_the_normal_density_of_the_frames(self, scene):
        # All coordinates of a frame at once: N(M B_0, s2 + sum_k M B_k (M B_k)^T).
        for each in with_few_basis_shapes(scene):
            expected = 0.0
            for frame in frames_of(each):
                y = frame.y - frame.first
                covariance = NOISE * np.eye(len(y)) + frame.X @ frame.X.T
                expected += np.linalg.slogdet(covariance)[1]
                expected += y @ np.linalg.solve(covariance, y)
            assert each.at().value == pytest.approx(expected, rel=1e-12)

    @PENALTIES
    def test_penalty_and_precisions_add_energies_of_basis_shapes(self, scene, penalty):
        energies = sum(np.sum(frame.X**2, axis=0) for frame in frames_of(scene))
        pairs = zip(precisions(), scene.shapes[1:], strict=True)
        squares = sum(np.trace(B.T @ P @ B) for P, B in pairs)
        added = scene.at(penalty, precisions=precisions()).value - scene.at().value
        expected = np.sum(penalty * energies) + squares
        assert added == pytest.approx(expected, rel=1e-12)

    def test_coefficients_and_residual(self, scene):
        for each in with_few_basis_shapes(scene):
            passed, residual = each.at(PENALTY), 0.0
            for frame, alpha in zip(frames_of(each), passed.alpha, strict=True):
                assert_allclose(alpha, frame.mean(NOISE), rtol=1e-10, atol=1e-12)
                residual += frame.square(frame.mean(NOISE), 0.0)
            assert passed.residual == pytest.approx(residual, rel=1e-11)

    def test_coefficients_are_precise_where_the_noise_is_tiny(self, scene):
        scene.shapes[2] = scene.shapes[1] + 1e-4 * scene.shapes[2]
        tracks = scenes.images(*scene[1:5])
        scene, left = scene._replace(tracks=tracks), 0.0
        alphas = scene.at(noise=1e-14).alpha
        for frame, alpha in zip(frames_of(scene), alphas, strict=True):
            rest = frame.y - frame.first - frame.X @ alpha
            left += np.sum((frame.X.T @ rest - 1e-14 * alpha) ** 2)
        assert np.sqrt(left) < 2e-13


@PENALTIES
@pytest.mark.parametrize("kind", ["plain", "prior", "precisions"])
def test_gradients_are_slopes_of_the_value(scene, penalty, kind):
    of_kind = {"prior": shape_prior(scene), "precisions": precisions()}
    given = {kind: of_kind[kind]} if kind in of_kind else {}
    found, rng = scene.at(penalty, **given), np.random.default_rng(1)
    gradients = found.shape_gradient, found.motion_gradient, found.noise_gradient
    for name, gradient in zip(("shapes", "motion", "noise"), gradients, strict=True):
        for _ in range(5):
            change, values = rng.normal(size=np.shape(gradient)), []
            for step in (1e-5, -1e-5):
                if name == "noise":
                    other = scene.at(penalty, NOISE * np.exp(step * change), **given)
                else:
                    moved = getattr(scene, name) + step * change
                    other = scene._replace(**{name: moved}).at(penalty, **given)
                values.append(other.value)
            slope = np.subtract(*values) / 2e-5
            assert slope == pytest.approx(np.vdot(gradient, change), rel=1e-6)


@PENALTIES
def test_curvatures_by_dense_matrices(scene, penalty):
    passed, n_points = scene.at(penalty, precisions=precisions()), scene.shapes.shape[2]
    prior = NOISE * block_diag(np.zeros((3, 3)), *precisions())
    expected = np.tile(prior, (n_points, 1, 1))
    weights = 1.0 if scene.weights is None else scene.weights
    weights = np.broadcast_to(weights, scene.tracks.shape[:2])
    for i, (frame, M) in enumerate(zip(frames_of(scene), scene.motion, strict=True)):
        E = second_moments(frame, NOISE, penalty)
        expected += weights[i][:, None, None] * np.kron(E, M.T @ M)
        A = np.einsum("kl,kaj,lbj->ab", E, frame.shapes, frame.shapes)
        found = passed.motion_curvature[:, i]
        assert_allclose(found, A[np.triu_indices(3)], rtol=1e-10, atol=1e-12)
    found = passed.shape_curvature
    assert found.shape[0] == (1 if scene.weights is None else n_points)
    assert_allclose(np.broadcast_to(found, expected.shape), expected, rtol=1e-10)


def assert_same(got, expected):
    """Assert that two passes agree up to rounding."""
    for name, one, other in zip(got._fields, got, expected, strict=True):
        scale = np.abs(other).max()
        assert_allclose(one, other, rtol=1e-9, atol=1e-11 * scale, err_msg=name)


def test_size_of_blocks_makes_no_difference(scene):
    assert_same(scene.at(PENALTY, block_frames=4), scene.at(PENALTY))


@pytest.mark.parametrize("hidden", [np.nan, 1e6])
def test_weights_of_zero_leave_a_point_out(hidden):
    # Whatever the table holds there.
    scene = random_scene("weighted")
    weights, tracks = scene.weights.copy(), scene.tracks.copy()
    weights[:, 2], tracks[:, 2] = 0.0, hidden
    kept = np.arange(weights.shape[1]) != 2
    got = scene._replace(weights=weights, tracks=tracks).at(PENALTY)
    tracks, weights = scene.tracks[:, kept], scene.weights[:, kept]
    shapes = scene.shapes[:, :, kept]
    fewer = scene._replace(tracks=tracks, weights=weights, shapes=shapes)
    expected = fewer.at(PENALTY)
    assert_allclose(got.shape_gradient[:, :, 2], 0, atol=1e-12)
    assert_allclose(got.shape_curvature[2], 0, atol=1e-12)
    slopes, curvature = got.shape_gradient[:, :, kept], got.shape_curvature[kept]
    got = got._replace(shape_gradient=slopes, shape_curvature=curvature)
    assert_same(got, expected)


# What is done to a scene, in place
DEGENERATE = {
    "basis": lambda scene: scene.shapes[1:].fill(0),
    "cameras": lambda scene: scene.motion[3].fill(0),
    "shapes": lambda scene: scene.shapes[:, 2].fill(0),
    "equal": lambda scene: np.copyto(scene.shapes[2], scene.shapes[1]),
}


@pytest.mark.parametrize("part", DEGENERATE)
def test_values_of_degenerate_scenes_are_finite(scene, part):
    DEGENERATE[part](scene)
    for each in scene.at(PENALTY):
        assert np.isfinite(each).all()


@pytest.mark.parametrize("n_seen", [0, 1])
def test_points_count_for_the_extents_if_a_frame_shows_them(n_seen):
    scene = random_scene("missing")
    scene.tracks[:, 5], scene.tracks[:n_seen, 5] = np.nan, 0.0
    scene.weights[:, 5], scene.weights[:n_seen, 5] = 0.0, 0.5
    likelihood, rises = likelihood_of(scene.tracks, scene.weights, 0.0), []
    moved = scene.shapes + 10.0 * (np.arange(9) == 5)
    for weight in (0.0, EXTENT_WEIGHT):
        objective = likelihood._replace(extent_weight=weight)
        pair = (objective(x, scene.motion, NOISE).value for x in (scene.shapes, moved))
        rises.append(np.subtract(*pair))
    assert (rises[0] != rises[1]) == bool(n_seen)
