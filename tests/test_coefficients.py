"""The posterior of coefficients in known cameras, against dense linear algebra."""

from typing import NamedTuple

import numpy as np
import pytest
import scenes
from numpy.testing import assert_allclose, assert_array_equal
from numpy.typing import NDArray

from isa_nrsfm._frames.coefficients import coefficient_posterior
from isa_nrsfm._frames.point_sums import (
    ShapeProducts,
    camera_gram,
    frame_sums,
    frame_tracks,
)
from isa_nrsfm._linalg.small_matrices import (
    frames_first,
    frames_last,
    unpack3,
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
    def test_determinant(self, kind):
        scene = random_scene(kind)
        got = scene.posterior().log_determinant
        for i, frame in enumerate(frames_of(scene)):
            _, expected = np.linalg.slogdet(np.eye(3) + frame.X.T @ frame.X / NOISE)
            assert got[i] == pytest.approx(expected, rel=1e-12)

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

    def test_second_moments_leave_the_posterior_as_it_is(self):
        got = random_scene().posterior()
        copies = got.c.copy(), got.inverse.copy()
        first = got.second_moments(NOISE)
        assert_array_equal(got.second_moments(NOISE), first)
        assert_array_equal(got.c, copies[0])
        assert_array_equal(got.inverse, copies[1])


class TestNoise:
    @KINDS
    def test_of_single_frames(self, kind):
        scene = random_scene(kind)
        noises = np.geomspace(1e-3, 10.0, 6)
        together = scene.posterior(noises)
        for i, noise in enumerate(noises):
            alone = scene.posterior(noise)
            for name in ("c", "inverse", "objective", "log_determinant"):
                got, expected = (getattr(p, name) for p in (together, alone))
                assert_allclose(got[..., i], expected[..., i], rtol=1e-12)
            expected = alone.second_moments(noise)[:, i]
            assert_allclose(together.second_moments(noises)[:, i], expected, rtol=1e-12)
            expected = alone.residual(noise)[i]
            assert together.residual(noises)[i] == pytest.approx(expected, rel=1e-12)
            expected = alone.spread(noise)[i]
            assert together.spread(noises)[i] == pytest.approx(expected, rel=1e-12)

    @KINDS
    @pytest.mark.parametrize("refined", [False, True])
    def test_refinement_changes_nothing_but_rounding(self, kind, refined):
        scene = random_scene(kind)
        got, expected = scene.posterior(refined=refined), scene.posterior()
        for one, other in zip(got, expected, strict=True):
            assert_allclose(one, other, rtol=1e-9)

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
    def test_no_basis_shape(self):
        scene = random_scene(n_components=0)
        got = scene.posterior()
        assert got.alpha.shape == (0, 6)
        expected = [frame.objective(np.zeros(0), 0.0) for frame in frames_of(scene)]
        assert_allclose(got.objective, expected, rtol=1e-12)
        assert_allclose(got.log_determinant, 0.0, atol=1e-15)

    @pytest.mark.parametrize("refined", [False, True])
    def test_basis_shapes_of_zeros_have_the_prior(self, refined):
        scene = random_scene()
        scene.shapes[2] = 0.0
        got = scene.posterior(refined=refined)
        assert_array_equal(got.alpha[1], 0.0)
        moments = unpacked(got.second_moments(NOISE))
        assert_allclose(moments[2, 2], 1.0)

    def test_cameras_of_zero_leave_the_prior(self):
        scene = random_scene()
        got = scene._replace(motion=np.zeros((6, 2, 3))).posterior()
        assert_array_equal(got.alpha, 0.0)
        energy = [np.sum(frame.y**2) for frame in frames_of(scene)]
        assert_allclose(got.objective, energy)

    def test_exact_frames_have_no_negative_objective(self):
        scene = random_scene()
        images = (scene.motion @ scene.shapes[0]).swapaxes(1, 2)
        got = scene._replace(tracks=images).posterior(1e-20, refined=True)
        assert (got.objective >= 0).all()
        assert_allclose(got.objective, 0.0, atol=1e-12)


def test_camera_gram():
    M = random_scene().M
    gram = unpack3(camera_gram(M))
    for i, camera in enumerate(frames_first(M)):
        assert_allclose(gram[..., i], camera.T @ camera, rtol=1e-13)
