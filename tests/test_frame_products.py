"""Sums over the points of frames."""

import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal

from isa_nrsfm._frames.point_sums import (
    ShapeProducts,
    determines_camera,
    frame_sums,
    frame_tracks,
    whitened,
)
from isa_nrsfm._linalg.small_matrices import (
    COLUMNS,
    ROWS,
    of_frames,
    pair_indices,
    unpack3,
    unpacked,
)


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

    def test_positions_are_weighted_means_of_residuals(self):
        tracks, shapes, weights = random_problem(0)
        rng = np.random.default_rng(1)
        motion, alpha = rng.normal(size=(6, 2, 3)), rng.normal(size=(6, 2))
        products = frame_sums(
            frame_tracks(tracks.transpose(0, 2, 1), weights), ShapeProducts(shapes)
        )
        positions = products.positions(motion, alpha)
        for i, w in enumerate(weights):
            shape = shapes[0] + alpha[i, 0] * shapes[1] + alpha[i, 1] * shapes[2]
            rest = tracks[i] - (motion[i] @ shape).T
            assert_allclose(positions[i], w @ rest / w.sum())

    def test_complete_frames_share_a_gram_matrix(self):
        tracks, shapes, weights = random_problem(0)
        shared = frame_sums(
            frame_tracks(tracks.transpose(0, 2, 1)), ShapeProducts(shapes)
        )
        own = frame_sums(
            frame_tracks(tracks.transpose(0, 2, 1), np.ones_like(weights)),
            ShapeProducts(shapes),
        )
        pairs = np.broadcast_to(shared.gram.pairs[..., None], own.gram.pairs.shape)
        assert_allclose(own.gram.pairs, pairs, atol=1e-13)
        for name in ("cross", "shape_centroid", "centroid", "weight", "energy"):
            assert_allclose(getattr(own, name), getattr(shared, name), atol=1e-13)

    def test_points_without_weight_do_not_matter(self):
        tracks, shapes, weights = random_problem(0)
        hidden = np.where(weights[..., None] == 0, np.nan, tracks)
        hidden[0, 0, 0], weights[0, 0] = np.inf, 0.0
        got = frame_sums(
            frame_tracks(hidden.transpose(0, 2, 1), weights), ShapeProducts(shapes)
        )
        tracks[0, 0] = 5.0
        expected = frame_sums(
            frame_tracks(tracks.transpose(0, 2, 1), weights), ShapeProducts(shapes)
        )
        assert_array_equal(got.cross, expected.cross)
        assert_array_equal(got.energy, expected.energy)

    def test_frame_without_points(self):
        tracks, shapes, weights = random_problem(0)
        tracks[1], weights[1] = np.nan, 0.0
        products = frame_sums(
            frame_tracks(tracks.transpose(0, 2, 1), weights), ShapeProducts(shapes)
        )
        for each in (products.cross, products.centroid, products.gram.pairs):
            assert_array_equal(each[..., 1], 0)
            assert np.isfinite(each).all()

    @pytest.mark.parametrize("weighted", [False, True])
    def test_take(self, weighted):
        tracks, shapes, weights = random_problem(0)
        some = np.array([4, 1, 1])
        w = weights if weighted else None
        taken = frame_sums(
            frame_tracks(tracks.transpose(0, 2, 1), w), ShapeProducts(shapes)
        )
        taken = of_frames(taken, some)
        w = weights[some] if weighted else None
        expected = frame_sums(
            frame_tracks(tracks[some].transpose(0, 2, 1), w), ShapeProducts(shapes)
        )
        for got, want in zip(taken, expected, strict=True):
            if isinstance(got, np.ndarray):
                assert_allclose(got, want, rtol=1e-13, atol=1e-14)
        assert_allclose(taken.gram.pairs, expected.gram.pairs, atol=1e-13)


@pytest.mark.parametrize("weighted", [False, True])
class TestGram:
    def gram(self, weighted):
        tracks, shapes, weights = random_problem(3)
        if not weighted:
            weights = np.ones_like(weights)
        given = frame_tracks(tracks.transpose(0, 2, 1), weights if weighted else None)
        plain = np.stack([plain_gram(shapes, w) for w in weights], axis=-1)
        return frame_sums(given, ShapeProducts(shapes)).gram, plain

    def test_products(self, weighted):
        gram, G = self.gram(weighted)
        c = np.random.default_rng(0).normal(size=(3, 6))
        T = np.einsum("klabi,li->kabi", G, c)
        T += T.swapaxes(1, 2)
        assert_allclose(unpack3(gram.products(c)), T, atol=1e-12)

    def test_moments(self, weighted):
        gram, G = self.gram(weighted)
        C = np.random.default_rng(0).normal(size=(3, 3, 6))
        C += C.swapaxes(0, 1)
        expected = np.einsum("kli,klabi->abi", C, G)
        assert_allclose(unpack3(gram.moments(C[pair_indices(3)])), expected, atol=1e-12)

    def test_energies(self, weighted):
        gram, G = self.gram(weighted)
        M = np.random.default_rng(0).normal(size=(2, 3, 6))
        Q = np.einsum("rai,rbi->abi", M, M)
        expected = np.einsum("klabi,abi->kli", G, Q)
        assert_allclose(unpacked(gram.energies(Q[ROWS, COLUMNS])), expected, atol=1e-12)


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

    def test_point_of_a_mean_shape(self):
        _, shapes, weights = random_problem(0)
        shapes[0] = 0.0
        weights[2] = 0.0
        assert_array_equal(self.answer(shapes, weights), weights.any(axis=1))
