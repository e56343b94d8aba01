"""Sums over the points of frames, and the posterior of their coefficients."""

from typing import NamedTuple

import numpy as np
import pytest
import scenes
from numpy.testing import assert_allclose, assert_array_equal
from numpy.typing import NDArray

from isa_nrsfm._frames.point_sums import (
    ShapeProducts,
    coefficient_posterior,
    determines_camera,
    frame_sums,
    frame_tracks,
    whitened,
)
from isa_nrsfm._linalg.small_matrices import (
    COLUMNS,
    ROWS,
    frames_last,
    pair_indices,
    unpacked,
)

NOISE = 0.05


class Scene(scenes.Scene):
    """Tracks that the shapes do not explain, and cameras."""

    @property
    def M(self):
        return frames_last(self.motion)

    def posterior(self, noise=NOISE, **options):
        products = frame_sums(
            frame_tracks(self.tracks.transpose(0, 2, 1), self.weights),
            ShapeProducts(self.shapes),
        )
        return coefficient_posterior(products, self.M, noise, **options)


def random_scene(kind="complete", n_components=3):
    return Scene(*scenes.random_scene(0, 6, 11, n_components, noise=1.0, kind=kind))


class Frame(NamedTuple):
    """A frame as a linear regression: ``y ~ x_0 + X a``, noise of variance one."""

    y: NDArray
    first: NDArray
    X: NDArray

    def objective(self, alpha, noise):
        rest = self.y - self.first - self.X @ alpha
        return rest @ rest + noise * alpha @ alpha


def frames_of(scene):
    """Yield the regressions, centred and weighted by the root of the weights."""
    for i, points in enumerate(scene.tracks):
        w = np.ones(len(points)) if scene.weights is None else scene.weights[i]
        seen = w > 0
        points, shapes, w = points[seen], scene.shapes[..., seen], w[seen]
        points = points - w @ points / w.sum()
        shapes = shapes - (shapes @ w / w.sum())[..., None]
        images = np.sqrt(w) * (scene.M[..., i] @ shapes)
        columns = images.reshape(len(shapes), -1)
        yield Frame((np.sqrt(w) * points.T).ravel(), columns[0], columns[1:].T)


KINDS = pytest.mark.parametrize("kind", ["complete", "missing"])


class TestPosterior:
    @KINDS
    def test_mean_and_covariance_by_dense_algebra(self, kind):
        scene = random_scene(kind)
        got = scene.posterior()
        covariance = -NOISE * unpacked(got.inverse)[1:, 1:]
        for i, frame in enumerate(frames_of(scene)):
            precision = frame.X.T @ frame.X / NOISE + np.eye(3)
            right = frame.X.T @ (frame.y - frame.first) / NOISE
            expected = np.linalg.solve(precision, right)
            assert_allclose(got.alpha[:, i], expected, rtol=1e-10)
            assert_allclose(covariance[..., i], np.linalg.inv(precision), rtol=1e-8)
        assert_array_equal(got.c[0], 1.0)
        assert_array_equal(got.c[1:], got.alpha)

    @KINDS
    def test_objective_and_determinant_are_the_marginal_likelihood(self, kind):
        # Of y ~ N(x_0, X X^T + s2 I), by its definition.
        scene = random_scene(kind)
        got = scene.posterior()
        for i, frame in enumerate(frames_of(scene)):
            covariance = frame.X @ frame.X.T + NOISE * np.eye(len(frame.y))
            rest = frame.y - frame.first
            expected = rest @ np.linalg.solve(covariance, rest)
            expected += np.linalg.slogdet(covariance)[1]
            value = got.objective[i] / NOISE + got.log_determinant[i]
            value += len(frame.y) * np.log(NOISE)
            assert value == pytest.approx(expected, rel=1e-12)

    @KINDS
    def test_image_energy(self, kind):
        scene = random_scene(kind)
        expected = [np.sum(frame.X**2, axis=0) for frame in frames_of(scene)]
        assert_allclose(scene.posterior().image_energy.T, expected, rtol=1e-12)

    @KINDS
    def test_residual_is_that_at_the_mean(self, kind):
        scene = random_scene(kind)
        got = scene.posterior()
        expected = [
            frame.objective(alpha, 0.0)
            for frame, alpha in zip(frames_of(scene), got.alpha.T, strict=True)
        ]
        assert_allclose(got.residual(NOISE), expected, rtol=1e-12)

    @KINDS
    def test_spread_is_the_expected_square_of_what_is_uncertain(self, kind):
        scene = random_scene(kind)
        got = scene.posterior()
        covariance = -NOISE * unpacked(got.inverse)[1:, 1:]
        expected = [
            np.trace(frame.X @ covariance[..., i] @ frame.X.T)
            for i, frame in enumerate(frames_of(scene))
        ]
        assert_allclose(got.spread(NOISE), expected, rtol=1e-11)

    @KINDS
    def test_second_moments(self, kind):
        scene = random_scene(kind)
        got = scene.posterior()
        moments = unpacked(got.second_moments(NOISE))
        for i, frame in enumerate(frames_of(scene)):
            c = np.concatenate([[1.0], got.alpha[:, i]])
            expected = np.outer(c, c)
            precision = frame.X.T @ frame.X / NOISE + np.eye(3)
            expected[1:, 1:] += np.linalg.inv(precision)
            assert_allclose(moments[..., i], expected, rtol=1e-10)


class TestNoise:
    @KINDS
    def test_refinement_solves_the_equations_of_a_tiny_noise(self, kind):
        # Basis shapes that are hard to tell from each other, tracks without noise.
        scene = random_scene(kind)
        shapes = scene.shapes.copy()
        shapes[2] = shapes[1] + 1e-4 * shapes[2]
        alpha = np.random.default_rng(1).normal(size=(6, 3))
        frames = shapes[0] + np.tensordot(alpha, shapes[1:], 1)
        tracks = (scene.motion @ frames).swapaxes(1, 2)
        scene = scene._replace(tracks=tracks, shapes=shapes)
        noise = 1e-14

        def left(refined):
            found = scene.posterior(noise, refined=refined).alpha
            rests = [
                frame.X.T @ (frame.y - frame.first - frame.X @ a) - noise * a
                for frame, a in zip(frames_of(scene), found.T, strict=True)
            ]
            return np.linalg.norm(rests)

        assert left(True) < 0.1 * left(False)
        assert left(True) < 1e-12


class TestDegenerate:
    @pytest.mark.parametrize("refined", [False, True])
    def test_basis_shapes_of_zeros_have_the_prior(self, refined):
        scene = random_scene()
        scene.shapes[2] = 0.0
        got = scene.posterior(refined=refined)
        assert_array_equal(got.alpha[1], 0.0)
        moments = unpacked(got.second_moments(NOISE))
        assert_allclose(moments[2, 2], 1.0)


def random_problem(seed, n_frames=6, n_points=11, n_components=2):
    """Return tracks, shapes (n_components + 1, 3, n_points) and weights."""
    rng = np.random.default_rng(seed)
    tracks = rng.normal(size=(n_frames, n_points, 2)) + rng.normal(size=2)
    shapes = rng.normal(size=(n_components + 1, 3, n_points))
    shapes -= shapes.mean(axis=2, keepdims=True)
    weights = rng.uniform(0.1, 2, (n_frames, n_points))
    weights[rng.random(weights.shape) < 0.3] = 0.0
    return tracks, shapes, weights


def plain_gram(shapes, weights):
    """Return G (n, n, 3, 3) of one frame by its definition."""
    mean = (shapes * weights).sum(axis=2) / weights.sum()
    moved = shapes - mean[..., None]
    return np.einsum("kaj,j,lbj->klab", moved, weights, moved)


class TestProducts:
    def test_by_definition(self):
        tracks, shapes, weights = random_problem(0)
        products = frame_sums(
            frame_tracks(tracks.transpose(0, 2, 1), weights), ShapeProducts(shapes)
        )
        first, second = pair_indices(3)
        for i, w in enumerate(weights):
            mean = w @ tracks[i] / w.sum()
            moved = tracks[i] - mean
            G = plain_gram(shapes, w)
            pairs = 0.5 * (G + G.swapaxes(2, 3))[first, second][:, ROWS, COLUMNS]
            P = np.einsum("kaj,j,jr->kar", shapes, w, moved)
            assert_allclose(products.centroid[:, i], mean)
            assert_allclose(products.weight[i], w.sum())
            assert_allclose(products.energy[i], np.sum(w[:, None] * moved**2))
            assert_allclose(products.cross[..., i], P, atol=1e-13)
            assert_allclose(products.shape_centroid[..., i], shapes @ w / w.sum())
            assert_allclose(products.gram.pairs[..., i], pairs, atol=1e-13)


class TestWhitened:
    def test_second_moment_is_the_identity(self):
        _, shapes, _ = random_problem(0)
        white, space = whitened(shapes)
        second = np.einsum("kaj,kbj->ab", white, white)
        assert_allclose(second, np.eye(3), atol=1e-13)
        assert_allclose(white, space @ shapes, atol=1e-13)
        mean = white[0] @ white[0].T
        assert_allclose(mean, np.diag(np.diag(mean)), atol=1e-13)

    @pytest.mark.parametrize("rank", [0, 1, 2])
    def test_flat_shapes(self, rank):
        _, shapes, _ = random_problem(0)
        A = np.random.default_rng(1).normal(size=(3, 3))
        flat = A @ (shapes * (np.arange(3) < rank)[:, None])
        white, space = whitened(flat)
        second = np.einsum("kaj,kbj->ab", white, white)
        assert_allclose(np.sort(np.diag(second))[::-1], np.arange(3) < rank, atol=1e-12)
        assert np.sum(np.abs(space).max(axis=1) > 0) == rank
        # What the white shapes are seen as is what the shapes are seen as.
        assert_allclose(np.linalg.pinv(space) @ white, flat, atol=1e-12)

    def test_flat_mean_shape_is_exactly_flat(self):
        _, shapes, _ = random_problem(0)
        A = np.random.default_rng(1).normal(size=(3, 3))
        shapes[0, 2] = 0.0
        white, _ = whitened(A @ shapes)
        assert_array_equal(white[0, 2], 0)
        assert np.abs(white[1:, 2]).max() > 0.1


class TestDeterminesCamera:
    def answer(self, shapes, weights):
        white, _ = whitened(shapes)
        tracks = np.zeros((*weights.shape, 2))
        products = frame_sums(
            frame_tracks(tracks.transpose(0, 2, 1), weights), ShapeProducts(white)
        )
        return determines_camera(products, white[0])

    def test_number_of_points(self):
        _, shapes, _ = random_problem(0)
        weights = np.tri(12, 11, -1)  # 0 to 11 points
        assert_array_equal(self.answer(shapes, weights), np.arange(12) >= 4)
        shapes[0, 2] = 0.0
        assert_array_equal(self.answer(shapes, weights), np.arange(12) >= 3)
        shapes[0, 1] = 0.0
        assert_array_equal(self.answer(shapes, weights), np.arange(12) >= 2)

    @pytest.mark.parametrize("unit", [1e-8, 1e8])
    def test_units_do_not_matter(self, unit):
        _, shapes, weights = random_problem(0)
        weights = np.concatenate([weights, np.tri(12, 11, -1)])
        expected = self.answer(shapes, weights)
        A = np.diag([1.0, 1e3, 1e-3])
        assert_array_equal(self.answer(unit * shapes, weights), expected)
        assert_array_equal(self.answer(A @ shapes, weights), expected)
        assert_array_equal(self.answer(shapes, unit * weights), expected)

    def test_points_in_a_plane_of_a_solid_do_not(self):
        _, shapes, weights = random_problem(0)
        shapes[0, 0, :6] = 0.5
        shapes[0, 0] -= shapes[0, 0].mean()
        weights[:] = np.arange(11) < 6
        assert not self.answer(shapes, weights).any()
        weights[:, 7] = 1.0
        assert self.answer(shapes, weights).all()
