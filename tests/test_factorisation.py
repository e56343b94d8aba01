"""Factorisation and samples of frames: identities, invariances, missing rank."""

import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal
from scenes import measurements, permute_frames

from isa_nrsfm._linalg import orientations
from isa_nrsfm._tables import FrameBlocks, representative_frames, spread
from isa_nrsfm.datasets import make_nonrigid_tracks
from isa_nrsfm.isa._pipeline import (
    block_triplets,
    factorise,
    leading_triplets,
    rigid_energy,
    sample_frames,
)

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
        values, _, rest = leading_triplets(W, k)
        S = np.linalg.svd(W, compute_uv=False)
        assert_allclose(values, S[:k], atol=1e-12 * S[0])
        assert_allclose(rest, np.sum(S[k:] ** 2), atol=1e-14 * np.sum(S**2))

    @pytest.mark.parametrize("unit", [1e-9, 1e9])
    def test_units(self, size, K, unit):
        W = centred_matrix(0, *size)
        f, g = factorise(W, K), factorise(unit * W, K)
        assert_allclose(g.rigid_shape, f.rigid_shape, atol=1e-11)
        assert_allclose(g.signals, f.signals, atol=1e-10)
        assert_allclose(g.motion / unit, f.motion, atol=1e-11)


class TestMissingRank:
    @pytest.mark.parametrize(
        ("rank", "K"), [(1, 1), (3, 2), (4, 2), (7, 1), (8, 2), (12, 3)]
    )
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

    def test_as_few_points_as_possible(self):
        f = factorise(low_rank(4, 4, n_points=7), 1)
        assert_allclose(f.signals @ f.signals.T / 7, np.eye(3), atol=1e-12)
        assert_allclose(f.signals.mean(axis=1), 0, atol=1e-13)

    def test_weak_directions_stay_centred(self):
        # Rounding errors of the centring, 1e-16, are 1e-7 of a direction of 1e-9.
        W = 1e3 * low_rank(0, 3) + 1e-6 * low_rank(1, 3)
        f = factorise(W, 1)
        S = leading_triplets(W, 6)[0]
        assert 1e-10 < S[5] / S[0] < 1e-8
        assert np.linalg.norm(f.motion[:, 2]) > 0
        assert_allclose(f.signals.mean(axis=1), 0, atol=1e-13)


class TestOrientations:
    @pytest.mark.parametrize("unit", [1e-250, 1e250])
    def test_opposite_rows_permutations_and_units(self, unit, rng):
        rows = rng.normal(size=(6, 11))
        signs = orientations(rows)
        assert_array_equal(orientations(-rows), -signs)
        assert_array_equal(orientations(unit * rows), signs)
        assert_array_equal(orientations(rows[:, rng.permutation(11)]), signs)
        assert_array_equal(orientations(signs[:, None] * rows), 1)

    def test_sign_of_the_third_moment_or_of_the_extreme_entry(self):
        rows = np.array([[2.0, -1.0, -1.0], [-2.0, 1.0, 1.0], [0.0, 0.0, 3.0]])
        assert_array_equal(orientations(rows), [1, -1, 1])
        assert_array_equal(orientations(np.zeros((2, 5))), 1)
        # Third moments of rounding errors do not decide.
        half = np.random.default_rng(0).normal(size=(50, 9))
        rows = np.hstack([half, -half[:, ::-1]])
        extreme = rows[np.arange(50), np.abs(rows).argmax(axis=1)]
        assert_array_equal(orientations(rows), np.sign(extreme))


LARGE = 30  # matrices with more rows and columns count as large


class TestLargeBothWays:
    @pytest.mark.parametrize("noise", [1e-2, 1e-6])
    def test_the_leading_triplets_are_those_of_the_whole(self, noise):
        W = low_rank(0, 8, 60, 90) + noise * centred_matrix(1, 60, 90)
        whole, leading = leading_triplets(W, 9), leading_triplets(W, 9, LARGE)
        factors = [factorise(W, 2, triplets=each) for each in (whole, leading)]
        shapes = [each.rigid_shape for each in factors]
        assert_allclose(shapes[1], shapes[0], atol=1e-6)
        # Energies converge as the squares of the directions.
        kept, got = np.sum(whole[0] ** 2), np.sum(leading[0] ** 2)
        assert abs(got - kept) < 1e-6 * whole[2] + 1e-14 * kept
        assert_allclose(leading[2], whole[2], rtol=1e-6, atol=1e-14 * kept)
        assert_allclose(leading[0], whole[0], rtol=1e-3)

    @pytest.mark.parametrize("first", [1, 1e3])
    def test_energies_that_are_alike(self, first):
        U, V = np.linalg.qr(np.random.default_rng(0).normal(size=(2, 150, 150)))[0]
        values = 0.97 ** np.arange(150)
        values[:5] *= first
        rest = np.sum(values[9:] ** 2)
        found = leading_triplets((U * values) @ V.T, 9, LARGE)[2]
        assert found == pytest.approx(rest, rel=1e-6)

    @pytest.mark.parametrize(
        ("size", "block_frames"), [((60, 70), 7), ((40, 25), 1), ((60, 8), 60)]
    )
    def test_blocks_make_no_difference(self, size, block_frames):
        W = low_rank(0, 8, *size) + 1e-2 * centred_matrix(1, *size)
        frames = W.reshape(len(W) // 2, 2, -1)
        values, vectors, rest = leading_triplets(W, 5, LARGE)
        blocks = FrameBlocks.of_array(frames, block_frames)
        found = block_triplets(blocks, W.shape, 5, LARGE)
        assert_allclose(found[0], values, rtol=1e-7)
        assert_allclose(found[2], rest, rtol=1e-6)
        signs = np.sign(np.vecdot(found[1], vectors))
        assert_allclose(found[1] * signs[:, None], vectors, atol=1e-3)

    def test_null_directions_are_left_out(self):
        W = low_rank(0, 5, 60, 90)
        triplets = leading_triplets(W, 9, LARGE)
        assert (triplets[0][5:] < 1e-12 * triplets[0][0]).all()
        signals = factorise(W, 2, triplets=triplets).signals
        assert_allclose(signals @ signals.T / 90, np.eye(3), atol=1e-12)


FEW = {"small_table": 1000, "first": 40}


def matrix(n_frames, n_points=20):
    tracks = make_nonrigid_tracks(n_frames, n_points, 2, noise=0.02, random_state=0)
    return measurements(tracks.data.reshape(n_frames, n_points, 2))


def sample(W, block_frames=64, **options):
    rows = FrameBlocks.of_array(W.reshape(len(W) // 2, 2, -1), block_frames)
    shape = factorise(W, 2).rigid_shape
    return sample_frames(rows, W.shape[1], shape, **{**FEW, **options})


def test_samples_grow_to_half_of_the_frames():
    for n_frames, sizes in ((40, []), (41, [40]), (321, [40, 160]), (700, [40, 160])):
        W = matrix(n_frames)
        of_first, parts = sample(W)
        assert [len(part) for part in parts] == sizes
        assert all((np.diff(part) > 0).all() for part in parts)
        rows = W.reshape(n_frames, 2, -1)[parts[0]] if parts else W
        assert_array_equal(of_first, rows.reshape(len(of_first), -1))
    whole, parts = sample(W, small_table=150_000)
    assert parts == []
    assert_array_equal(whole, W)


def test_frames_are_spread_from_the_most_to_the_least_rigid_one():
    W = matrix(100)
    factors = factorise(W, 2)
    rest = W - factors.rigid_motion @ factors.rigid_shape
    energy = np.sum(rest.reshape(100, -1) ** 2, axis=1)
    found = rigid_energy(W.reshape(100, 2, -1), factors.rigid_shape)
    assert_allclose(found, energy)
    chosen = spread(np.argsort(energy), 21)
    assert len(set(chosen)) == 21
    assert (np.diff(energy[chosen]) > 0).all()
    assert energy[chosen[0]] == energy.min()
    assert energy[chosen[-1]] == energy.max()
    assert_array_equal(sample(W)[1][0], np.sort(spread(np.argsort(energy), 40)))


def test_the_same_frames_in_any_order_and_blocks():
    W = matrix(100)
    permuted, order = permute_frames(W, 1)
    expected = sample(W)[1][0]
    assert_array_equal(np.sort(order[sample(permuted, 7)[1][0]]), expected)


class TestRepresentativeFrames:
    def rows(self):
        """Return frames of known shares of x, in no order, and that order."""
        order = np.random.default_rng(0).permutation(300)
        rows = np.ones((300, 2, 4))
        rows[order, 0] = np.linspace(0.1, 2.0, 300)[:, None]
        return rows, order

    def test_are_spread_over_the_shares_of_x(self):
        rows, order = self.rows()
        found = representative_frames(FrameBlocks.of_array(rows, 64), 50)
        assert_array_equal(found, np.sort(spread(order, 50)))

    def test_show_rare_points_as_often_as_they_can(self):
        rows, order = self.rows()
        rows[:, :, 1:3] = np.nan
        rows[order[::7], :, 1] = 1.0  # in 43 frames, and in 5 of those that are spread
        rows[order[3:6], :, 2] = 1.0  # in three frames
        blocks = FrameBlocks.of_array(rows, 64)
        # The order of the shares has changed little: compare by it.
        halves = np.nansum(rows[:, 0] ** 2, axis=1) / np.nansum(rows**2, axis=(1, 2))
        order = np.argsort(halves, kind="stable")
        chosen = set(spread(order, 50).tolist())
        for point, n in ((1, 10), (2, 3)):
            seen = ~np.isnan(rows[order, 0, point])
            assert sum(not np.isnan(rows[i, 0, point]) for i in chosen) < n
            chosen |= set(spread(order[seen], n).tolist())
        assert_array_equal(representative_frames(blocks, 50), sorted(chosen))

    def test_of_few_frames_are_all(self):
        rows = FrameBlocks.of_array(self.rows()[0], 64)
        assert_array_equal(representative_frames(rows, 300), np.arange(300))
