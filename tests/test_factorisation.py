"""Rigid and non-rigid factorisation: identities, invariances, missing rank."""

import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal
from scenes import measurements

from isa_nrsfm._linalg.small_matrices import orientations
from isa_nrsfm._paper import svd
from isa_nrsfm._paper.factors import factorise
from isa_nrsfm._paper.svd import block_triplets, leading_triplets
from isa_nrsfm._tables.blocks import FrameBlocks

SIZES = [(40, 25), (15, 60)]  # frames, points: W is tall, W is wide


def centred_matrix(seed, n_frames, n_points):
    rng = np.random.default_rng(seed)
    W = rng.exponential(size=(2 * n_frames, n_points))
    W = W @ np.diag(rng.exponential(size=n_points))
    return W - W.mean(axis=1, keepdims=True)


def low_rank(seed, rank, n_frames=30, n_points=20):
    """Return a centred matrix of a given rank with different singular values."""
    rng = np.random.default_rng(seed)
    shape = rng.exponential(size=(rank, n_points))
    shape -= shape.mean(axis=1, keepdims=True)
    return rng.normal(size=(2 * n_frames, rank)) @ shape


def approximation(f):
    return f.rigid_motion @ f.rigid_shape + f.motion @ f.signals


@pytest.mark.parametrize("size", SIZES)
@pytest.mark.parametrize("K", [1, 3])
class TestIdentities:
    def test_best_approximation_of_rank_3K_plus_3(self, size, K):
        W = centred_matrix(0, *size)
        U, S, Vt = np.linalg.svd(W, full_matrices=False)
        rank = 3 * K + 3
        best = (U[:, :rank] * S[:rank]) @ Vt[:rank]
        assert_allclose(approximation(factorise(W, K)), best, atol=1e-12)

    def test_shape_and_signals_are_centred_and_white_together(self, size, K):
        f = factorise(centred_matrix(0, *size), K)
        rows = np.vstack([f.rigid_shape, f.signals])
        assert_allclose(rows.mean(axis=1), 0, atol=1e-13)
        assert_allclose(rows @ rows.T / size[1], np.eye(3 * K + 3), atol=1e-13)

    def test_motion_columns_are_orthogonal_and_ordered(self, size, K):
        W = centred_matrix(0, *size)
        f = factorise(W, K)
        M = np.hstack([f.rigid_motion, f.motion])
        gram = M.T @ M
        norms = np.sqrt(np.diag(gram) * size[1])
        assert_allclose(gram, np.diag(np.diag(gram)), atol=1e-12 * gram.max())
        assert_allclose(norms, np.linalg.svd(W, compute_uv=False)[: 3 * K + 3])

    def test_singular_values(self, size, K):
        W = centred_matrix(0, *size)
        k = 3 * K + 3
        f = leading_triplets(W, k)
        S = np.linalg.svd(W, compute_uv=False)
        assert_allclose(f.values, S[:k], atol=1e-12 * S[0])
        assert_allclose(f.rest, np.sum(S[k:] ** 2), atol=1e-14 * np.sum(S**2))

    @pytest.mark.parametrize("unit", [1e-9, 1e9])
    def test_units(self, size, K, unit):
        W = centred_matrix(0, *size)
        f, g = factorise(W, K), factorise(unit * W, K)
        assert_allclose(g.rigid_shape, f.rigid_shape, atol=1e-11)
        assert_allclose(g.signals, f.signals, atol=1e-10)
        assert_allclose(g.motion / unit, f.motion, atol=1e-11)


class TestMissingRank:
    @pytest.mark.parametrize("rank", range(1, 13))
    @pytest.mark.parametrize("K", [1, 2, 3])
    def test_only_directions_above_rounding_errors_are_used(self, rank, K):
        W = low_rank(rank, rank)
        f = factorise(W, K)
        used = min(rank, 3 * K + 3)
        n_signals = 3 * max(1, -(-(used - 3) // 3))
        assert f.signals.shape == (n_signals, 20)
        assert f.motion.shape == (60, n_signals)

        # The motion of what is added is exactly zero, the signals stay white.
        assert_array_equal(f.motion[:, max(used - 3, 0) :], 0)
        assert np.all(np.linalg.norm(f.motion[:, : max(used - 3, 0)], axis=0) > 0)
        assert_allclose(f.signals.mean(axis=1), 0, atol=1e-13)
        assert_allclose(f.signals @ f.signals.T / 20, np.eye(n_signals), atol=1e-12)
        assert_allclose(f.rigid_shape @ f.signals.T, 0, atol=1e-11)

        expected = np.diag(np.repeat([1.0, 0.0], [min(rank, 3), max(3 - rank, 0)]))
        assert_allclose(f.rigid_shape @ f.rigid_shape.T / 20, expected, atol=1e-12)
        assert_array_equal(f.rigid_shape[rank:], 0)
        if rank <= 3 * K + 3:
            assert_allclose(approximation(f), W, atol=1e-12)

    @pytest.mark.parametrize("rank", range(1, 7))
    def test_as_few_points_as_possible(self, rank):
        f = factorise(low_rank(rank, rank, n_points=7), 1)
        assert_allclose(f.signals @ f.signals.T / 7, np.eye(3), atol=1e-12)
        assert_allclose(f.signals.mean(axis=1), 0, atol=1e-13)

    def test_weak_directions_stay_centred(self):
        # Rounding errors of the centring, 1e-16, are 1e-7 of a direction of 1e-9.
        W = 1e3 * low_rank(0, 3) + 1e-6 * low_rank(1, 3)
        f = factorise(W, 1)
        S = leading_triplets(W, 6).values
        assert 1e-10 < S[5] / S[0] < 1e-8
        assert np.linalg.norm(f.motion[:, 2]) > 0
        assert_allclose(f.signals.mean(axis=1), 0, atol=1e-13)

    @pytest.mark.parametrize(("K", "n_signals"), [(1, 3), (2, 3), (4, 3)])
    def test_shark_has_two_non_rigid_directions(self, load_data, K, n_signals):
        W = measurements(load_data("shark_torresani")["W2d"])
        f = factorise(W, K)
        assert f.signals.shape == (n_signals, 91)
        assert np.linalg.norm(f.motion[:, 1]) > 1e-3
        assert_array_equal(f.motion[:, 2], 0)
        assert_allclose(f.signals.mean(axis=1), 0, atol=1e-13)
        assert_allclose(f.signals @ f.signals.T / 91, np.eye(3), atol=1e-12)
        assert_allclose(approximation(f), W, atol=1e-12)


class TestOrientations:
    def test_sign_of_the_third_moment(self):
        rows = np.array([[2.0, -1.0, -1.0], [-2.0, 1.0, 1.0], [0.0, 0.0, 3.0]])
        assert_array_equal(orientations(rows), [1, -1, 1])

    @pytest.mark.parametrize("seed", range(5))
    @pytest.mark.parametrize("unit", [1e-250, 1e-9, 1e9, 1e250])
    def test_opposite_rows_permutations_and_units(self, seed, unit):
        rng = np.random.default_rng(seed)
        rows = rng.normal(size=(6, 11))
        signs = orientations(rows)
        assert_array_equal(orientations(-rows), -signs)
        assert_array_equal(orientations(unit * rows), signs)
        assert_array_equal(orientations(rows[:, rng.permutation(11)]), signs)
        assert_array_equal(orientations(signs[:, None] * rows), 1)

    def test_rows_without_third_moment(self):
        rows = np.array([[1.0, -3.0, 3.0, -1.0], [3.0, 1.0, -1.0, -3.0]])
        assert_array_equal(orientations(rows), [-1, 1])
        assert_array_equal(orientations(-rows), [1, -1])

    @pytest.mark.parametrize("seed", range(10))
    def test_third_moments_of_rounding_errors_do_not_decide(self, seed):
        half = np.random.default_rng(seed).normal(size=(5, 9))
        rows = np.hstack([half, -half[:, ::-1]])
        extreme = rows[np.arange(5), np.abs(rows).argmax(axis=1)]
        assert_array_equal(orientations(rows), np.sign(extreme))

    def test_zero_rows(self):
        assert_array_equal(orientations(np.zeros((2, 5))), 1)


KRYLOV = 30  # matrices with more rows and columns count as large


def by_krylov(W, n_components):
    """Return the factors of a matrix that counts as large."""
    triplets = leading_triplets(W, 3 * n_components + 3, KRYLOV)
    return factorise(W, n_components, triplets=triplets)


class TestLargeBothWays:
    @pytest.mark.parametrize("size", [(60, 70), (25, 90)])
    @pytest.mark.parametrize("noise", [1e-2, 1e-6])
    def test_the_leading_triplets_are_those_of_the_whole(self, size, noise):
        W = low_rank(0, 8, *size) + noise * centred_matrix(1, *size)
        expected = factorise(W, 2).rigid_shape
        assert_allclose(by_krylov(W, 2).rigid_shape, expected, atol=1e-6)
        whole, leading = leading_triplets(W, 9), leading_triplets(W, 9, KRYLOV)
        # Energies converge as the squares of the directions.
        kept, got = np.sum(whole.values**2), np.sum(leading.values**2)
        assert abs(got - kept) < 1e-6 * whole.rest + 1e-14 * kept
        assert_allclose(leading.rest, whole.rest, rtol=1e-6, atol=1e-14 * kept)
        assert_allclose(leading.values, whole.values, rtol=1e-3)

    @pytest.mark.parametrize(
        ("first", "ratio", "most"), [(1, 0.95, 3), (1, 0.97, 4), (1e3, 0.97, 4)]
    )
    def test_few_passes_where_energies_are_alike(self, first, ratio, most, monkeypatch):
        passes, squared = [], svd._squared

        def counted(block, V):
            passes.append(V.shape)
            return squared(block, V)

        monkeypatch.setattr(svd, "_squared", counted)
        U, V = np.linalg.qr(np.random.default_rng(0).normal(size=(2, 150, 150)))[0]
        values = ratio ** np.arange(150)
        values[:5] *= first
        found = leading_triplets((U * values) @ V.T, 9, KRYLOV)
        rest = np.sum(values[9:] ** 2)
        assert abs(found.rest - rest) < 1e-6 * rest
        assert len(passes) <= most

    @pytest.mark.parametrize("unit", [2.0**-30, 2.0**30])
    def test_units(self, unit):
        W = low_rank(0, 8, 60, 70) + 1e-2 * centred_matrix(1, 60, 70)
        expected, found = (leading_triplets(each, 9, KRYLOV) for each in (W, unit * W))
        assert_allclose(found.values, unit * expected.values, rtol=1e-12)
        assert_allclose(found.rest, unit**2 * expected.rest, rtol=1e-9)

    @pytest.mark.parametrize("block_frames", [1, 7, 60])
    @pytest.mark.parametrize("size", [(60, 70), (40, 25), (60, 8)])
    def test_blocks_make_no_difference(self, size, block_frames):
        W = low_rank(0, 8, *size) + 1e-2 * centred_matrix(1, *size)
        frames = W.reshape(len(W) // 2, 2, -1)
        expected = leading_triplets(W, 5, KRYLOV)
        blocks = FrameBlocks.of_array(frames, block_frames)
        found = block_triplets(blocks, W.shape, 5, KRYLOV)
        assert_allclose(found.values, expected.values, rtol=1e-7)
        assert_allclose(found.rest, expected.rest, rtol=1e-6)
        signs = np.sign(np.vecdot(found.vectors, expected.vectors))
        assert_allclose(found.vectors * signs[:, None], expected.vectors, atol=1e-3)

    def test_null_directions_are_left_out(self):
        W = low_rank(0, 5, 60, 70)
        S, f = leading_triplets(W, 9, KRYLOV).values, by_krylov(W, 2)
        assert (S[5:] < 1e-12 * S[0]).all()
        assert_allclose(f.signals @ f.signals.T / 70, np.eye(3), atol=1e-12)
