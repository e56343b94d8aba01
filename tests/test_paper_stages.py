"""Stages of the paper: factorisation, samples of frames, blocks, the refinement."""

import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal
from scenes import measurements, random_rotation, structured_motion

from isa_nrsfm._linalg import orientations
from isa_nrsfm._parameters import BLOCK_RECOVERIES
from isa_nrsfm._tables import FrameBlocks, representative_frames, spread
from isa_nrsfm.datasets import make_nonrigid_tracks
from isa_nrsfm.isa._pipeline import (
    block_triplets,
    factorise,
    leading_blocks,
    leading_triplets,
    lifted_blocks,
    lifted_moments,
    motion_products,
    recover_blocks,
    refine_alternating,
    rigid_energy,
    sample_frames,
    structure_energies,
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
def test_factors_are_the_best_approximation_white_and_ordered(size, K):
    W, rank = centred_matrix(0, *size), 3 * K + 3
    U, S, Vt = np.linalg.svd(W, full_matrices=False)
    f = factorise(W, K)
    best = (U[:, :rank] * S[:rank]) @ Vt[:rank]
    assert_allclose(approximation(f), best, atol=1e-12)
    rows = np.vstack([f.rigid_shape, f.signals])
    assert_allclose(rows.mean(axis=1), 0, atol=1e-13)
    assert_allclose(rows @ rows.T / size[1], np.eye(rank), atol=1e-13)
    M = np.hstack([f.rigid_motion, f.motion])
    energy = S[:rank] ** 2 / size[1]
    assert_allclose(M.T @ M, np.diag(energy), rtol=1e-7, atol=1e-12 * energy[0])


@pytest.mark.parametrize(("rank", "K"), [(1, 1), (3, 2), (4, 2), (7, 1), (12, 3)])
def test_only_directions_above_rounding_errors_are_used(rank, K):
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

    expected = np.diag(np.arange(3) < rank)
    assert_allclose(f.rigid_shape @ f.rigid_shape.T / 20, expected, atol=1e-12)
    assert_array_equal(f.rigid_shape[rank:], 0)
    if rank <= 3 * K + 3:
        assert_allclose(approximation(f), W, atol=1e-12)


@pytest.mark.parametrize("unit", [1e-250, 1e250])
def test_orientations_of_opposite_rows_permutations_and_units(unit, rng):
    rows = rng.normal(size=(6, 11))
    signs = orientations(rows)
    assert_array_equal(orientations(-rows), -signs)
    assert_array_equal(orientations(unit * rows), signs)
    assert_array_equal(orientations(rows[:, rng.permutation(11)]), signs)


def test_orientation_is_the_sign_of_the_third_moment_or_of_the_extreme_entry(rng):
    rows = np.array([[2.0, -1.0, -1.0], [-2.0, 1.0, 1.0], [0.0, 0.0, 3.0], 3 * [0.0]])
    assert_array_equal(orientations(rows), [1, -1, 1, 1])
    # Third moments of rounding errors do not decide.
    half = rng.normal(size=(50, 9))
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
    order = np.argsort(energy)
    chosen = spread(order, 40)
    assert (chosen[0], chosen[-1]) == (order[0], order[-1])
    assert_array_equal(sample(W)[1][0], np.sort(chosen))


def test_representative_frames_are_spread_and_show_rare_points():
    # Frames of known shares of x, in no order
    order = np.random.default_rng(0).permutation(300)
    rows = np.ones((300, 2, 4))
    rows[order, 0] = np.linspace(0.1, 2.0, 300)[:, None]
    for unit in (1.0, 2.0**-20):
        blocks = FrameBlocks.of_array(unit * rows, 64)
        assert_array_equal(representative_frames(blocks, 300), np.arange(300))
        chosen = representative_frames(blocks, 50)
        assert_array_equal(chosen, np.sort(spread(order, 50)))
    rows[:, :, 1:3] = np.nan
    rows[order[::7], :, 1] = 1.0  # in 43 frames
    rows[order[3:6], :, 2] = 1.0  # in three frames
    chosen = representative_frames(FrameBlocks.of_array(rows, 64), 50)
    assert (np.diff(chosen) > 0).all()
    assert len(chosen) <= 50 + 10 + 3
    n_seen = np.sum(~np.isnan(rows[chosen, 0]), axis=0)
    assert n_seen[1] >= 10
    assert n_seen[2] == 3


ALL_METHODS = pytest.mark.parametrize("method", BLOCK_RECOVERIES)


def direction(D):
    """Return matrices of unit norm, of a sign that depends only on the direction."""
    flat = D.reshape(len(D), 9) / np.linalg.norm(D, axis=(1, 2))[:, None]
    largest = np.abs(flat).argmax(axis=1)
    signs = np.sign(flat[np.arange(len(flat)), largest])
    return (flat * signs[:, None]).reshape(D.shape)


def block(scene, k):
    """Return M_0 (I, 2, 3) and the motion of subspace k (I, 2, 3)."""
    M_0 = scene.rigid.reshape(-1, 2, 3)
    return M_0, scene.motion.reshape(len(M_0), 2, -1)[:, :, 3 * k : 3 * k + 3]


def explained_share(scene, k, D):
    """Return the share of the energy of M_k D that cameras alpha_i M_0^i explain."""
    M_0, M = block(scene, k)
    moved = M @ D
    inner = np.sum(moved * M_0, axis=(1, 2))
    return np.sum(inner**2 / np.sum(M_0**2, axis=(1, 2))) / np.sum(moved**2)


def published_irls(scene, k, n_frames, n_iter=50):
    """Return D by the published iteration, with a dense least squares each time."""
    M_0, M = block(scene, k)
    columns = np.einsum("irc,de->irecd", M, np.eye(3))
    of_D = columns.reshape(6 * n_frames, 9)  # d(M D) by D, row major
    of_alpha = np.zeros((6 * n_frames, n_frames))
    for i in range(n_frames):
        of_alpha[6 * i : 6 * i + 6, i] = -M_0[i].ravel()
    A = np.hstack([of_D, of_alpha[:, 1:]])
    alpha_1 = 1.0 / 3.0
    for _ in range(n_iter):
        d = np.linalg.lstsq(A, -alpha_1 * of_alpha[:, 0])[0][:9]
        alpha_1 /= np.linalg.norm(d)
    return d.reshape(3, 3)


@ALL_METHODS
class TestAllMethods:
    def test_exact_data(self, method):
        scene = structured_motion(0)
        D = recover_blocks(motion_products(scene.rigid, scene.motion), method)
        assert D.shape == (3, 3, 3)
        assert_allclose(np.linalg.norm(D, axis=(1, 2)), 1)
        assert_allclose(direction(D), direction(np.linalg.inv(scene.E)), atol=1e-8)

    @pytest.mark.parametrize(
        ("part", "zeros"),
        [
            *(("motion", np.s_[:, n:3]) for n in range(3)),  # in fewer directions
            *(("rigid", np.s_[:, n:]) for n in (1, 2)),  # is flat
            ("rigid", np.s_[:6]),  # is not seen, in the first frame among others
            ("rigid", np.s_[:0]),  # has equal frames
        ],
    )
    def test_parts_that_are_zero_and_equal_frames(self, method, part, zeros):
        scene = structured_motion(0, noise=0.3)
        getattr(scene, part)[zeros] = 0
        parts = (np.tile(each, (3, 1)) for each in (scene.rigid, scene.motion))
        D = recover_blocks(motion_products(*parts), method)
        still = np.array([part == "motion" and zeros == np.s_[:, 0:3], False, False])
        assert_array_equal(D[still], 0)
        assert_allclose(np.linalg.norm(D, axis=(1, 2)), ~still)


class TestSingleMethods:
    def test_generalized_eigen_explains_the_largest_share(self, rng):
        scene = structured_motion(0, noise=0.5)
        products = motion_products(scene.rigid, scene.motion)
        D, other = (recover_blocks(products, m) for m in BLOCK_RECOVERIES)
        for k, block in enumerate(D):
            others = [other[k], *rng.normal(size=(50, 3, 3))]
            largest = max(explained_share(scene, k, each) for each in others)
            assert explained_share(scene, k, block) > largest

    def test_irls_is_the_fixed_point_of_the_published_iteration(self):
        scene = structured_motion(0, noise=0.5)
        D = recover_blocks(motion_products(scene.rigid, scene.motion), "irls")
        published = np.array([published_irls(scene, k, 25) for k in range(3)])
        assert_allclose(np.linalg.norm(published, axis=(1, 2)), 1)
        assert_allclose(direction(D), direction(published), atol=1e-9)


def explained(scene, E):
    """Return ``f(E_k) = sum_i <M_i, M_0^i E_k>^2 / ||M_0^i E_k||^2`` of each block."""
    energies = []
    for k, block_of in enumerate(E):
        M_0, M = block(scene, k)
        image = M_0 @ block_of
        square = np.sum(image**2, axis=(1, 2))
        inner = np.sum(M * image, axis=(1, 2))
        energies.append(np.sum(inner[square > 0] ** 2 / square[square > 0]))
    return np.array(energies)


def random_starts(seed, n_blocks=3, n_starts=4):
    return np.random.default_rng(seed).normal(size=(n_blocks, n_starts, 3, 3))


def refined(scene, starts, max_iter=5000, tol=1e-16):
    products = motion_products(scene.rigid, scene.motion)
    return refine_alternating(products, starts, max_iter=max_iter, tol=tol)


@pytest.fixture
def scene():
    return structured_motion(0, n_frames=40, noise=0.3)


class TestRefinement:
    def test_exact_motion_is_recovered(self):
        exact = structured_motion(0)
        E, _, converged = refined(exact, random_starts(0, 3, 8))
        assert converged
        assert_allclose(direction(E), direction(exact.E), atol=1e-8)
        assert explained(exact, E).sum() == pytest.approx(np.sum(exact.motion**2))

    def test_blocks_of_unit_norm_without_gradient(self, scene):
        E, _, _ = refined(scene, random_starts(0))
        assert_allclose(np.linalg.norm(E, axis=(1, 2)), 1)
        energy = explained(scene, E)
        for step in 1e-5 * np.eye(9).reshape(9, 3, 3):
            slopes = explained(scene, E + step) - explained(scene, E - step)
            assert_allclose(slopes / 2e-5, 0, atol=1e-6 * energy.max())

    def test_order_of_subspaces_units_and_starts(self, scene):
        starts, order = random_starts(0), [2, 0, 1]
        expected = direction(refined(scene, starts)[0])
        motion = scene.motion.reshape(-1, 3, 3)[:, order].reshape(-1, 9)
        cases = [(scene._replace(motion=motion), starts[order], expected[order])]
        for of_rigid, of_motion in ((1e-9, 1e9), (1e9, 1e9), (1.0, 1e-9)):
            rigid, motion = of_rigid * scene.rigid, of_motion * scene.motion
            cases.append((scene._replace(rigid=rigid, motion=motion), starts, expected))
        factors = np.array([1e-6, -1.0, 1e6, -7.0])[:, None, None]
        padded = np.concatenate([np.zeros((3, 1, 3, 3)), factors * starts], axis=1)
        cases.append((scene, padded, expected))
        for changed, given, wanted in cases:
            other = direction(refined(changed, given)[0])
            assert_allclose(other, wanted, atol=1e-6)

    def test_subspaces_and_starts_that_explain_nothing(self, scene):
        assert_array_equal(refined(scene, np.zeros((3, 2, 3, 3)))[0], 0)
        scene.motion[:, 3:6] = 0
        E, _, converged = refined(scene, random_starts(0))
        assert converged
        assert_array_equal(E[1], 0)
        assert_allclose(np.linalg.norm(E[[0, 2]], axis=(1, 2)), 1)
        # The motion lies in the first direction, the start in the last.
        scene.motion[:] *= [1.0, 0.0, 0.0] * 3
        starts = np.zeros((3, 1, 3, 3))
        starts[:, 0, :, 2] = 1.0
        assert_array_equal(refined(scene, starts)[0], 0)

    @pytest.mark.parametrize("n", [1, 2])
    def test_fewer_directions(self, scene, n):
        flat = scene._replace(rigid=scene.rigid * (np.arange(3) < n))
        E = refined(flat, random_starts(0))[0]
        assert np.isfinite(E).all()
        assert np.all(explained(flat, E) > 0)
        scene.motion[:, n:3] = 0
        E = refined(scene, random_starts(0))[0]
        assert_allclose(E[0, :, n:], 0, atol=1e-9)
        assert_allclose(np.linalg.norm(E, axis=(1, 2)), 1)


def test_lifted_moments_blocks_and_energies_by_plain_loops():
    scene = structured_motion(0, noise=0.3)
    M_0, subspaces = scene.rigid.reshape(-1, 2, 3), random_rotation(1, 9)
    L = []
    for A, M in zip(M_0, scene.motion.reshape(len(M_0), 2, -1), strict=True):
        ridge = 0.1 * np.trace(A.T @ A)
        L.append(np.linalg.solve(A.T @ A + ridge * np.eye(3), A.T @ M))
    L, subspaces = np.array(L), subspaces.reshape(3, 3, 9)
    moments = lifted_moments(motion_products(scene.rigid, scene.motion))
    assert_allclose(moments, np.einsum("iam,ibn->abmn", L, L), atol=1e-12)
    blocks = lifted_blocks(moments, subspaces)
    E = leading_blocks(moments, subspaces, 3).reshape(3, 3, 9)
    values = np.linalg.eigvalsh(blocks)[:, ::-1]
    for k, vectors in enumerate(E):
        flat = (L @ subspaces[k].T).reshape(-1, 9)
        assert_allclose(blocks[k], flat.T @ flat, atol=1e-12)
        assert_allclose(vectors @ vectors.T, np.eye(3), atol=1e-12)
        expected = values[k, :3, None] * vectors
        assert_allclose(vectors @ blocks[k], expected, atol=1e-10)
    assert_allclose(structure_energies(moments, subspaces), values[:, 0])
