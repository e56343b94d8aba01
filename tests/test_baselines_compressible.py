"""Compressible structure from motion: each step, and what the steps lead to."""

from typing import NamedTuple

import numpy as np
import pytest
from layers import slow_after
from numpy.testing import assert_allclose, assert_array_equal
from numpy.typing import NDArray
from scenes import random_rotation
from sklearn.base import clone
from sklearn.utils._param_validation import InvalidParameterError
from sklearn.utils.estimator_checks import parametrize_with_checks

from isa_nrsfm._linalg.polar import polar
from isa_nrsfm._metric_upgrade.quadric import LARGEST_STRETCH
from isa_nrsfm.baselines import CompressibleNRSfM
from isa_nrsfm.baselines._block_dictionary import (
    BlockCode,
    block_ksvd,
    code_frames,
    group_sparse_factors,
    shrink_blocks,
    update_atoms,
)
from isa_nrsfm.baselines._compressible import (
    FEWEST_SHARED,
    align_blocks,
    chain_atoms,
    metric_correction,
)


class SparseScene(NamedTuple):
    """Frames ``R_i sum_l c_il X_l``, of mean square norm one."""

    frames: NDArray  # (I, 2, J)
    cameras: NDArray  # (I, 2, 3)
    coefficients: NDArray  # (I, L)
    atoms: NDArray  # (L, 3, J)

    @property
    def shapes(self):
        return np.tensordot(self.coefficients, self.atoms, 1)


def random_cameras(rng, n_frames):
    """Return cameras with orthonormal rows."""
    return polar(rng.normal(size=(n_frames, 2, 3))).rows


def sparse_scene(seed, n_frames=200, n_points=40, n_atoms=4, sparsity=2):
    """Return frames of shapes that are sums of so many random atoms, exactly."""
    rng = np.random.default_rng(seed)
    atoms = rng.normal(size=(n_atoms, 3, n_points))
    atoms -= atoms.mean(axis=2, keepdims=True)
    cameras = random_cameras(rng, n_frames)
    coefficients = np.zeros((n_frames, n_atoms))
    for row in coefficients:
        used = rng.choice(n_atoms, sparsity, replace=False)
        row[used] = rng.uniform(0.5, 1.5, sparsity) * rng.choice([-1, 1], sparsity)
    frames = cameras @ np.tensordot(coefficients, atoms, 1)
    size = np.sqrt(np.mean(np.sum(frames**2, axis=(1, 2))))
    return SparseScene(frames / size, cameras, coefficients, atoms / size)


def orthonormal_atoms(scene):
    """Return atoms with orthonormal rows, and the code that gives the frames."""
    blocks = np.einsum("il,irc->ilrc", scene.coefficients, scene.cameras)
    U, S, atoms = np.linalg.svd(scene.atoms, full_matrices=False)
    blocks = blocks @ (U * S[:, None])
    return atoms, BlockCode(blocks, scene.coefficients != 0)


def images(code, atoms):
    """Return the frames of a code."""
    return np.einsum("ilrc,lcp->irp", code.blocks, atoms)


def as_table(frames):
    """Return frames (I, 2, J) as an interleaved table."""
    return frames.transpose(0, 2, 1).reshape(len(frames), -1)


def image_error(model, X):
    """Return the share of a centred table that the fitted shapes do not show."""
    shown = model.shapes_ @ model.motion_.transpose(0, 2, 1)
    W = X.reshape(shown.shape) - model.translation_[:, None]
    return np.sum((W - shown) ** 2) / np.sum(W**2)


class TestShrinkBlocks:
    def test_minimises_its_cost(self):
        rng = np.random.default_rng(0)
        blocks = rng.normal(size=(50, 2, 3))
        Z = shrink_blocks(blocks, 2.0)

        def cost(Z):
            norms = np.linalg.norm(Z, axis=(1, 2))
            return 2.0 * norms + 0.5 * np.sum((Z - blocks) ** 2, axis=(1, 2))

        assert 0 < np.sum(~Z.any(axis=(1, 2))) < 50
        for size in (1e-3, 0.1, 1.0):
            for _ in range(20):
                other = Z + size * rng.normal(size=Z.shape)
                assert (cost(Z) < cost(other)).all()

    def test_shortens_by_the_threshold(self):
        blocks = np.random.default_rng(1).normal(size=(4, 5, 2, 3))
        norms = np.linalg.norm(blocks, axis=(2, 3))
        Z = shrink_blocks(blocks, 1.5)
        assert_allclose(np.linalg.norm(Z, axis=(2, 3)), np.maximum(norms - 1.5, 0))
        assert_allclose(Z * norms[..., None, None], blocks * _norms(Z)[..., None, None])

    def test_edges(self):
        blocks = np.zeros((3, 2, 3))
        assert_array_equal(shrink_blocks(blocks, 0.5), 0)
        blocks[0, 0, 0] = 0.5
        assert_array_equal(shrink_blocks(blocks, 0.5), 0)
        assert_array_equal(shrink_blocks(blocks, 0.0), blocks)


def _norms(blocks):
    return np.linalg.norm(blocks, axis=(-2, -1))


class TestGroupSparseFactors:
    @pytest.mark.parametrize("seed", range(3))
    def test_stationary_point(self, seed):
        scene = sparse_scene(seed)
        penalty = 0.06
        blocks, atoms = group_sparse_factors(
            scene.frames, 4, penalty, np.random.RandomState(seed)
        )
        norms = _norms(blocks)
        assert 0 < np.sum(norms == 0) < norms.size
        rest = scene.frames - np.einsum("ilrc,lcp->irp", blocks, atoms)
        # Where a block is, the residual pulls as hard as the price; elsewhere, less.
        pull = np.einsum("irp,lcp->ilrc", rest, atoms)
        there = norms > 0
        price = penalty * blocks[there] / norms[there][:, None, None]
        assert_allclose(pull[there], price, atol=0.02 * penalty)
        assert _norms(pull)[~there].max() < 1.02 * penalty
        # Atoms are of norm one, and the residual pulls outwards.
        assert_allclose(np.linalg.norm(atoms, axis=(1, 2)), 1)
        pull = np.einsum("ilrc,irp->lcp", blocks, rest)
        outwards = np.einsum("lcp,lcp->l", pull, atoms)
        assert (outwards > 0).all()
        tangent = pull - outwards[:, None, None] * atoms
        assert np.linalg.norm(tangent) < 1e-2 * np.linalg.norm(pull)

    def test_price_that_no_block_is_worth(self):
        scene = sparse_scene(0, n_frames=30)
        largest = np.linalg.norm(scene.frames, axis=(1, 2)).max()
        blocks, atoms = group_sparse_factors(
            scene.frames, 4, largest, np.random.RandomState(0)
        )
        assert_array_equal(blocks, 0)
        assert np.isfinite(atoms).all()

    def test_higher_price_of_blocks_leaves_fewer(self):
        scene = sparse_scene(0)
        n_blocks = [
            np.count_nonzero(
                _norms(
                    group_sparse_factors(
                        scene.frames, 4, penalty, np.random.RandomState(0)
                    )[0]
                )
            )
            for penalty in (0.01, 0.06, 0.3)
        ]
        assert n_blocks == sorted(n_blocks, reverse=True)
        assert n_blocks[0] > n_blocks[-1]


class TestCodeFrames:
    @pytest.mark.parametrize("sparsity", [1, 2, 3])
    def test_exact_frames(self, sparsity):
        scene = sparse_scene(0, n_points=60, n_atoms=6, sparsity=sparsity)
        atoms, true = orthonormal_atoms(scene)
        code = code_frames(scene.frames, atoms, sparsity, 1e-8)
        # Atoms overlap, and a greedy choice among them may err in rare frames.
        right = (code.active == true.active).all(axis=1)
        assert right.mean() > 0.97
        assert_allclose(code.blocks[right], true.blocks[right], atol=1e-5)

    def test_at_most_so_many_blocks_and_at_least_one(self):
        scene = sparse_scene(0, n_points=60, n_atoms=6, sparsity=3)
        atoms, _ = orthonormal_atoms(scene)
        for ridge in (1e-6, 1e-2, 0.25):
            code = code_frames(scene.frames, atoms, 2, ridge)
            n_active = code.active.sum(axis=1)
            assert n_active.min() >= 1
            assert n_active.max() <= 2
            assert_array_equal(code.active, code.blocks.any(axis=(2, 3)))

    @pytest.mark.parametrize("ridge", [0.001, 0.01])
    def test_share_of_a_block_that_is_left(self, ridge):
        # Two atoms without overlap, of which the second explains the share x.
        rng = np.random.default_rng(0)
        atoms = np.linalg.qr(rng.normal(size=(20, 6)))[0].T.reshape(2, 3, 20)
        cameras = random_cameras(rng, 40) / np.sqrt(2)
        x = np.linspace(0, 0.2, 40)
        coefficients = np.sqrt(np.column_stack([1 - x, x]))
        frames = np.einsum("il,irc,lcp->irp", coefficients, cameras, atoms)
        code = code_frames(frames, atoms, 2, ridge)
        clear = np.abs(x - 4 * ridge) > ridge  # near it the reweighting is slow
        assert_array_equal(code.active[clear, 1], x[clear] > 4 * ridge)
        kept = x > 8 * ridge
        share = (x + np.sqrt(np.maximum(x**2 - 4 * x * ridge, 0))) / 2 - ridge
        assert_allclose(_norms(code.blocks)[kept, 1] ** 2, share[kept], rtol=0.02)

    def test_end_of_the_reweighting(self):
        # Blocks of overlapping atoms: D_l E_i^T = ridge * |W_i|^2 P_il^T / |P_il|^2.
        scene = sparse_scene(3, n_points=60, n_atoms=6)
        atoms, _ = orthonormal_atoms(scene)
        ridge = 1e-4
        code = code_frames(scene.frames, atoms, 2, ridge)
        rest = scene.frames - images(code, atoms)
        pull = np.einsum("irp,lcp->ilrc", rest, atoms)
        energy = np.sum(scene.frames**2, axis=(1, 2))[:, None]
        norms = _norms(code.blocks)
        large = norms**2 > 100 * ridge * energy
        weight = (ridge * energy / np.where(large, norms, 1) ** 2)[large]
        price = weight[:, None, None] * code.blocks[large]
        assert_allclose(pull[large], price, rtol=1e-2, atol=1e-6)

    def test_frames_that_no_atom_explains(self):
        # The first half of the frames has a tenth of its energy in each of two atoms.
        rng = np.random.default_rng(0)
        axes = np.linalg.qr(rng.normal(size=(20, 9)))[0].T.reshape(3, 3, 20)
        shares = np.repeat([[0.1, 0.12, 0.78], [0.5, 0.4, 0.1]], 10, axis=0)
        cameras = random_cameras(rng, 20) / np.sqrt(2)
        frames = np.einsum("il,irc,lcp->irp", np.sqrt(shares), cameras, axes)
        code = code_frames(frames, axes[:2], 2, 0.05)
        assert_array_equal(code.active[:10], [[False, True]] * 10)
        assert_allclose(code.blocks[:10, 1], np.sqrt(0.12) * cameras[:10], atol=1e-12)
        assert_array_equal(code.active[10:], True)

    def test_units_of_frames(self):
        scene = sparse_scene(0)
        atoms, _ = orthonormal_atoms(scene)
        units = np.random.default_rng(0).uniform(1e-6, 1e6, (len(scene.frames), 1, 1))
        code = code_frames(scene.frames, atoms, 2, 0.01)
        other = code_frames(units * scene.frames, atoms, 2, 0.01)
        assert_array_equal(other.active, code.active)
        assert_allclose(other.blocks, units[..., None] * code.blocks, rtol=1e-9)

    def test_each_frame_by_itself(self):
        scene = sparse_scene(0)
        atoms, _ = orthonormal_atoms(scene)
        code = code_frames(scene.frames, atoms, 2, 0.01)
        part = code_frames(scene.frames[50:60], atoms, 2, 0.01)
        assert_allclose(part.blocks, code.blocks[50:60], atol=1e-12)
        batches = code_frames(scene.frames, atoms, 2, 0.01, batch=7)
        assert_array_equal(batches.active, code.active)
        assert_allclose(batches.blocks, code.blocks, atol=1e-12)

    def test_rotation_of_images_and_of_atoms(self):
        scene = sparse_scene(0)
        atoms, _ = orthonormal_atoms(scene)
        code = code_frames(scene.frames, atoms, 2, 0.01)
        roll, turn = random_rotation(0, 2), random_rotation(1)
        rolled = code_frames(roll @ scene.frames, atoms, 2, 0.01)
        assert_allclose(rolled.blocks, roll @ code.blocks, atol=1e-9)
        turned = code_frames(scene.frames, turn @ atoms, 2, 0.01)
        assert_allclose(turned.blocks, code.blocks @ turn.T, atol=1e-9)


class TestUpdateAtoms:
    def disturbed(self, seed=0, **sizes):
        """Return frames, atoms that are not the true ones, and the code of these."""
        scene = sparse_scene(seed, **sizes)
        rng = np.random.default_rng(seed)
        atoms = scene.atoms + 0.1 * rng.normal(size=scene.atoms.shape)
        atoms = np.linalg.svd(atoms, full_matrices=False)[2]
        return scene.frames, atoms, code_frames(scene.frames, atoms, 2, 0.01)

    @pytest.mark.parametrize("seed", range(5))
    def test_residual_falls(self, seed):
        frames, atoms, code = self.disturbed(seed)
        before = np.sum((frames - images(code, atoms)) ** 2)
        atoms, code, residuals = update_atoms(frames, atoms, code)
        assert_allclose(residuals, frames - images(code, atoms), atol=1e-12)
        after = np.sum(residuals**2)
        assert after < 0.5 * before
        # The same atoms and blocks once more: nothing rises.
        again = np.sum(update_atoms(frames, atoms, code)[2] ** 2)
        assert again <= after * (1 + 1e-12)

    def test_rows_are_orthonormal_and_active_blocks_stay(self):
        frames, atoms, code = self.disturbed()
        atoms, new, _ = update_atoms(frames, atoms, code)
        assert_allclose(atoms @ atoms.swapaxes(1, 2), [np.eye(3)] * 4, atol=1e-12)
        assert_array_equal(new.active, code.active)
        assert_array_equal(new.blocks.any(axis=(2, 3)), code.active)

    def test_last_atom_is_the_best_of_rank_three(self):
        frames, atoms, code = self.disturbed()
        atoms, code, residuals = update_atoms(frames, atoms, code)
        users = code.active[:, -1]
        rest = residuals[users] + code.blocks[users, -1] @ atoms[-1]
        values = np.linalg.svd(rest.reshape(-1, rest.shape[2]), compute_uv=False)
        assert_allclose(np.sum(residuals[users] ** 2), np.sum(values[3:] ** 2))

    def test_inputs_are_left_alone(self):
        frames, atoms, code = self.disturbed()
        copies = [a.copy() for a in (frames, atoms, *code)]
        update_atoms(frames, atoms, code)
        for a, copy in zip((frames, atoms, *code), copies, strict=True):
            assert_array_equal(a, copy)

    @pytest.mark.parametrize("n_users", [0, 1, 2])
    def test_atoms_that_few_frames_use(self, n_users):
        frames, atoms, code = self.disturbed()
        blocks, active = (a.copy() for a in code)
        for atom in (1, 2):
            dropped = np.flatnonzero(active[:, atom])[n_users:]
            active[dropped, atom], blocks[dropped, atom] = False, 0.0
        code = BlockCode(blocks, active)
        new, replaced, residuals = update_atoms(frames, atoms, code)
        assert not replaced.active[:, [1, 2]].any()
        assert not replaced.blocks[:, [1, 2]].any()
        assert_allclose(residuals, frames - images(replaced, new), atol=1e-12)
        assert_allclose(new @ new.swapaxes(1, 2), [np.eye(3)] * 4, atol=1e-12)
        # Each has three of the four directions of two frames, not of the same ones.
        inside = np.linalg.norm(frames[:, None] @ new.swapaxes(1, 2), axis=(2, 3))
        share = inside / np.linalg.norm(frames, axis=(1, 2))[:, None]
        assert (share[:, [1, 2]].max(axis=0) > 0.8).all()
        both = new[[1, 2]].reshape(6, -1)
        assert np.linalg.svd(both, compute_uv=False)[-1] > 0.01

        kept, code, residuals = update_atoms(frames, atoms, code, replace=False)
        assert_array_equal(code.active, active)
        assert_allclose(residuals, frames - images(code, kept), atol=1e-12)
        if n_users < 2:
            assert_array_equal(kept[[1, 2]], atoms[[1, 2]])


class TestBlockKSVD:
    def learn(self, scene, atoms, ridge, max_iter=60, sparsity=2):
        return block_ksvd(
            scene.frames, atoms, sparsity, ridge=ridge, max_iter=max_iter, tol=1e-8
        )

    def start(self, scene, seed=0):
        n_atoms = len(scene.atoms)
        random_state = np.random.RandomState(seed)
        return group_sparse_factors(scene.frames, n_atoms, 0.06, random_state)[1]

    @pytest.mark.parametrize("seed", range(4))
    def test_exact_frames_of_one_atom(self, seed):
        scene = sparse_scene(seed, 120, 30, sparsity=1)
        found = self.learn(scene, self.start(scene), 0.01, sparsity=1)
        assert found.residual < 1e-25
        assert found.n_iter < 20

    @pytest.mark.parametrize("seed", slow_after(1, [0, 1]))
    def test_exact_frames_of_two_atoms(self, seed):
        scene = sparse_scene(seed, 300, 50, 5)
        found = self.learn(scene, self.start(scene), 0.01)
        assert found.residual < 1e-3
        # The price biases the blocks; without it the same atoms become exact.
        exact = self.learn(scene, found.atoms, 1e-8)
        assert exact.residual < 1e-9
        assert (exact.code.active.sum(axis=1) == 2).mean() > 0.97
        # Each true atom is one of those found: the same three-dimensional span.
        true, _ = orthonormal_atoms(scene)
        overlap = np.linalg.svd(
            true[:, None] @ exact.atoms.swapaxes(1, 2), compute_uv=False
        )[..., 2]
        assert (np.sum(overlap > 1 - 1e-4, axis=1) == 1).all()

    def test_residual_is_that_of_atoms_and_code(self):
        scene = sparse_scene(0)
        for max_iter in (1, 3):
            found = self.learn(scene, self.start(scene), 0.01, max_iter)
            rest = scene.frames - images(found.code, found.atoms)
            energy = np.sum(scene.frames**2)
            assert found.residual == pytest.approx(np.sum(rest**2) / energy)
            assert found.n_iter == max_iter
            assert found.code.active.any(axis=1).all()

    def test_more_sweeps_lower_the_residual(self):
        scene = sparse_scene(0, 300, 50, 5)
        start = np.random.default_rng(0).normal(size=scene.atoms.shape)
        residuals = [self.learn(scene, start, 0.01, n).residual for n in (1, 4, 16)]
        assert residuals == sorted(residuals, reverse=True)
        assert residuals[-1] < 0.5 * residuals[0]


class TestMetricCorrection:
    def upgraded(self, seed, n_frames, noise=0.0):
        """Return blocks ``c_i R_i A``, A random but stretched by no more than 4."""
        rng = np.random.default_rng(seed)
        scales = (
            rng.uniform(0.5, 2, (n_frames, 1, 1))
            * rng.choice([-1, 1], n_frames)[:, None, None]
        )
        A = random_rotation(seed) * rng.uniform(0.5, 2, 3) @ random_rotation(seed + 1)
        blocks = scales * random_cameras(rng, n_frames) @ A
        return blocks + noise * rng.normal(size=blocks.shape)

    @pytest.mark.parametrize("seed", range(5))
    @pytest.mark.parametrize("n_frames", [3, 50])
    def test_exact_blocks(self, seed, n_frames):
        blocks = self.upgraded(seed, n_frames)
        G = metric_correction(blocks)
        gram = blocks @ G
        gram = gram @ gram.swapaxes(1, 2)
        size = np.trace(gram, axis1=1, axis2=2)[:, None, None] / 2
        assert_allclose(gram, size * np.eye(2), atol=1e-7 * size.max())

    @pytest.mark.parametrize("n_frames", [1, 2])
    def test_few_frames(self, n_frames):
        # Near to cameras already: of the many solutions the nearest is no worse.
        rng = np.random.default_rng(0)
        distortion = np.eye(3) + 0.05 * rng.normal(size=(3, 3))
        blocks = random_cameras(rng, n_frames) @ distortion
        G = metric_correction(blocks)
        gram = (blocks @ G) @ (blocks @ G).swapaxes(1, 2)
        size = np.trace(gram, axis1=1, axis2=2)[:, None, None] / 2
        assert_allclose(gram, size * np.eye(2), atol=1e-9 * size.max())
        assert np.linalg.cond(G) < 1.5

    def test_least_sum_of_squares(self):
        blocks = self.upgraded(0, 100, noise=0.05)
        p1, p2 = blocks[:, 0], blocks[:, 1]

        def cost(Q):
            Q = Q / np.linalg.norm(Q)
            unequal = np.einsum("ic,cd,id->i", p1, Q, p1)
            unequal -= np.einsum("ic,cd,id->i", p2, Q, p2)
            oblique = 2 * np.einsum("ic,cd,id->i", p1, Q, p2)
            return np.sum(unequal**2 + oblique**2)

        G = metric_correction(blocks)
        Q, rng = G @ G.T, np.random.default_rng(1)
        least = cost(Q)
        for size in (1e-4, 1e-2, 1.0):
            for change in rng.normal(size=(50, 3, 3)):
                assert cost(Q + size * np.linalg.norm(Q) * (change + change.T)) > least

    def test_blocks_that_are_no_cameras(self):
        stretch = [
            np.linalg.cond(
                metric_correction(np.random.default_rng(seed).normal(size=(10, 2, 3)))
            )
            for seed in range(20)
        ]
        assert max(stretch) <= LARGEST_STRETCH * (1 + 1e-9)
        assert max(stretch) > LARGEST_STRETCH * (1 - 1e-9)  # some are not definite

    @pytest.mark.parametrize("n_flat", [1, 2, 3])
    def test_flat_atoms(self, n_flat):
        blocks = self.upgraded(0, 30)
        blocks[..., 3 - n_flat :] = 0
        assert np.isfinite(metric_correction(blocks)).all()

    def test_units_and_rotations_of_images(self):
        blocks = self.upgraded(0, 30, noise=0.05)
        G = metric_correction(blocks)
        for other in (1e-6 * blocks, random_rotation(0, 2) @ blocks):
            Q = metric_correction(other)
            assert_allclose(Q @ Q.T, G @ G.T, atol=1e-9)


class TestAlignBlocks:
    @pytest.mark.parametrize("seed", range(10))
    @pytest.mark.parametrize("determinant", [1, -1])
    @pytest.mark.parametrize("n_frames", [2, 30])
    def test_exact_blocks(self, seed, determinant, n_frames):
        rng = np.random.default_rng(seed)
        cameras = random_cameras(rng, n_frames)
        truth = determinant * random_rotation(seed)
        scales = rng.normal(size=(n_frames, 1, 1))
        found = align_blocks(scales * cameras @ truth.T, cameras)
        # Minus the truth is the same with all coefficients of the other sign.
        assert_allclose(found * np.sign(np.sum(found * truth)), truth, atol=1e-7)

    @pytest.mark.parametrize("seed", range(5))
    def test_least_distance(self, seed):
        rng = np.random.default_rng(seed)
        cameras = random_cameras(rng, 40)
        blocks = rng.normal(size=(40, 1, 1)) * cameras @ random_rotation(seed).T
        blocks += 0.3 * rng.normal(size=blocks.shape)

        def agreement(O):  # noqa: E741
            return np.sum(np.einsum("irc,irc->i", blocks @ O, cameras) ** 2)

        found = align_blocks(blocks, cameras)
        assert_allclose(found @ found.T, np.eye(3), atol=1e-12)
        best = agreement(found)
        for other in range(200):
            assert agreement(random_rotation(other)) < best
            assert agreement(-random_rotation(other)) < best
        for size in (1e-3, 1e-2):
            for change in size * rng.normal(size=(20, 3, 3)):
                assert agreement(polar(found + change).rows) < best


class TestChainAtoms:
    def mixed(self, scene, seed=0):
        """Return orthonormal atoms and their code, turned at random."""
        atoms, code = orthonormal_atoms(scene)
        turns = np.stack([random_rotation(seed + k) for k in range(len(atoms))])
        return turns @ atoms, BlockCode(code.blocks @ turns.swapaxes(1, 2), code.active)

    @pytest.mark.parametrize("seed", range(5))
    def test_exact_code(self, seed):
        scene = sparse_scene(seed)
        atoms, code = self.mixed(scene)
        chained = chain_atoms(atoms, code)
        cameras, shapes = chained.cameras, np.tensordot(*chained[1:], 1)
        assert_allclose(cameras @ cameras.swapaxes(1, 2), [np.eye(2)] * 200, atol=1e-9)
        assert_allclose(cameras @ shapes, scene.frames, atol=1e-6)
        assert_array_equal(chained.coefficients != 0, code.active)
        # Up to one orthogonal matrix, and the sign of each frame's camera and shape.
        O = align_blocks(cameras, scene.cameras)  # noqa: E741
        signs = np.sign(np.sum(cameras @ O * scene.cameras, axis=(1, 2)))[:, None, None]
        assert_allclose(signs * cameras @ O, scene.cameras, atol=1e-5)
        assert_allclose(signs * (O.T @ shapes), scene.shapes, atol=1e-5)

    def test_matrices_of_atoms_do_not_matter(self):
        scene = sparse_scene(0)
        rng = np.random.default_rng(0)
        atoms, code = orthonormal_atoms(scene)
        mixing = np.eye(3) + 0.2 * rng.normal(size=(len(atoms), 3, 3))
        blocks = code.blocks @ np.linalg.inv(mixing)
        chained = chain_atoms(mixing @ atoms, BlockCode(blocks, code.active))
        shapes = np.tensordot(*chained[1:], 1)
        assert_allclose(chained.cameras @ shapes, scene.frames, atol=1e-6)

    def test_atoms_without_shared_frames_are_aligned_by_their_shapes(self):
        # One shape, nearly, learnt as three atoms of 20 frames each.
        rng = np.random.default_rng(0)
        shape = rng.normal(size=(3, 30))
        true = shape + 0.01 * rng.normal(size=(3, 3, 30))
        coefficients = np.kron(np.eye(3), np.ones((20, 1)))
        cameras = random_cameras(rng, 60)
        frames = cameras @ np.tensordot(coefficients, true, 1)
        scene = SparseScene(frames, cameras, coefficients, true)
        chained = chain_atoms(*self.mixed(scene))
        O = align_blocks(chained.cameras, cameras)  # noqa: E741
        turned = chained.cameras @ O
        sign = np.sign(np.sum(turned[0] * cameras[0]))
        assert_allclose(sign * turned, cameras, atol=0.05)

    @pytest.mark.parametrize(
        ("n_shared", "by_frames"), [(FEWEST_SHARED - 1, False), (FEWEST_SHARED, True)]
    )
    def test_atoms_that_share_few_frames(self, n_shared, by_frames):
        # Two shapes that do not resemble each other: only shared frames align them.
        scene = sparse_scene(0, 60, 30, 2, 1)
        rng = np.random.default_rng(0)
        coefficients = np.zeros((60, 2))
        coefficients[: 30 + n_shared, 0] = 1.0
        coefficients[30:, 1] = rng.uniform(0.5, 1, 30)
        frames = scene.cameras @ np.tensordot(coefficients, scene.atoms, 1)
        exact = scene._replace(frames=frames, coefficients=coefficients)
        chained = chain_atoms(*self.mixed(exact))
        shown = chained.cameras @ np.tensordot(*chained[1:], 1)
        error = np.linalg.norm(shown - frames) / np.linalg.norm(frames)
        assert (error < 1e-6) == by_frames

    def test_atoms_that_no_frame_uses(self):
        scene = sparse_scene(0)
        atoms, code = self.mixed(scene)
        extended = np.concatenate([atoms[:1], atoms])
        padded = BlockCode(
            np.concatenate([0 * code.blocks[:, :1], code.blocks], axis=1),
            np.concatenate([code.active[:, :1] & False, code.active], axis=1),
        )
        chained, expected = chain_atoms(extended, padded), chain_atoms(atoms, code)
        assert_array_equal(chained.cameras, expected.cameras)
        assert_array_equal(chained.atoms[0], 0)
        assert_array_equal(chained.coefficients[:, 0], 0)
        assert_array_equal(chained.atoms[1:], expected.atoms)


@pytest.fixture(scope="module")
def sparse_table():
    """Return a scene and its table, in pixels and away from the origin."""
    scene = sparse_scene(0, 300, 50, 5)
    return scene, as_table(100 * scene.frames) + np.tile([300.0, 200.0], 50)


@pytest.fixture(scope="module")
def small_table():
    """Return a table for what does not depend on its size."""
    return as_table(100 * sparse_scene(0, 100, 30, 5).frames)


class TestCompressibleNRSfM:
    def test_exact_table(self, sparse_table):
        scene, X = sparse_table
        model = CompressibleNRSfM(4, max_iter=60, tol=1e-8, random_state=0).fit(X)
        assert model.dictionary_residual_ < 1e-3
        assert model.inverse_snr_ < 2e-3
        assert model.inverse_snr_ == pytest.approx(image_error(model, X))
        rows = model.motion_
        assert_allclose(rows @ rows.swapaxes(1, 2), [np.eye(2)] * 300, atol=1e-9)
        assert_allclose(model.translation_, [[300, 200]] * 300)
        assert_allclose(model.shapes_.mean(axis=1), 0, atol=1e-9)
        assert model.n_users_.shape == (5,)
        assert 300 <= model.n_users_.sum() <= 600
        assert 1 <= model.n_iter_ <= 60
        # The shapes in 3D, up to one orthogonal matrix and the signs of frames.
        O = align_blocks(model.motion_, scene.cameras)  # noqa: E741
        signs = np.sign(np.sum(model.motion_ @ O * scene.cameras, axis=(1, 2)))
        shapes = signs[:, None, None] * (model.shapes_ @ O)
        truth = 100 * scene.shapes.transpose(0, 2, 1)
        assert np.linalg.norm(shapes - truth) < 0.05 * np.linalg.norm(truth)

    def test_scales_of_frames(self, small_table):
        X = small_table
        units = np.random.default_rng(0).uniform(0.1, 10, (len(X), 1))
        settings = {"scale_frames": True, "random_state": 0}
        model = CompressibleNRSfM(4, **settings).fit(X)
        scaled = CompressibleNRSfM(4, **settings).fit(units * X)
        assert_allclose(scaled.shapes_, model.shapes_, atol=1e-6)
        assert_allclose(scaled.motion_, units[..., None] * model.motion_, rtol=1e-5)
        assert scaled.inverse_snr_ == pytest.approx(model.inverse_snr_)

    def test_random_state(self, small_table):
        X = small_table
        model = CompressibleNRSfM(4, max_iter=3)
        first, second, other = (
            clone(model).set_params(random_state=seed).fit(X) for seed in (0, 0, 1)
        )
        assert_array_equal(first.shapes_, second.shapes_)
        assert_array_equal(first.motion_, second.motion_)
        assert first.inverse_snr_ == second.inverse_snr_
        assert first.dictionary_residual_ != other.dictionary_residual_

    def test_memory_order_and_layout(self, small_table):
        X = small_table
        model = CompressibleNRSfM(4, max_iter=3, random_state=0).fit(X)
        planar = np.asfortranarray(np.hstack([X[:, ::2], X[:, 1::2]]))
        other = clone(model).set_params(layout="planar").fit(planar)
        assert_array_equal(other.shapes_, model.shapes_)

    def test_number_of_atoms(self, small_table):
        X = small_table
        fitted = CompressibleNRSfM(2, max_iter=1, random_state=0).fit(X)
        named = CompressibleNRSfM(2, n_atoms=3, max_iter=1, random_state=0).fit(X)
        assert_array_equal(fitted.shapes_, named.shapes_)
        many = CompressibleNRSfM(2, n_atoms=8, max_iter=1, random_state=0).fit(X)
        assert many.n_users_.shape == (8,)
        assert many.basis_.shape == (2, 30, 3)

    def test_many_frames(self):
        scene = sparse_scene(0, 1100, 20, 3, 1)  # more than the relaxed problem has
        model = CompressibleNRSfM(2, sparsity=1, random_state=0)
        model.fit(as_table(scene.frames))
        assert model.dictionary_residual_ < 1e-20
        assert model.inverse_snr_ < 1e-12
        assert model.n_users_.sum() == len(scene.frames)

    def test_one_atom_is_a_rigid_shape(self):
        scene = sparse_scene(0, 50, 20, 1, 1)
        model = CompressibleNRSfM(1, n_atoms=1, sparsity=1, random_state=0)
        model.fit(as_table(scene.frames))
        assert model.inverse_snr_ < 1e-12
        assert_array_equal(model.n_users_, [50])
        norms = np.linalg.norm(model.shapes_, axis=(1, 2))
        ratio = norms / np.abs(scene.coefficients[:, 0])
        assert_allclose(ratio, ratio[0], rtol=1e-6)

    @pytest.mark.parametrize("n_atoms", [2, 6])
    @pytest.mark.parametrize("kind", ["rigid", "flat", "line", "repeated"])
    def test_degenerate_tables(self, kind, n_atoms):
        rng = np.random.default_rng(0)
        shape = rng.normal(size=(3, 12))
        cameras = random_cameras(rng, 30)
        if kind == "flat":
            shape[2] = 0
        elif kind == "line":
            shape[1:] = 0
        elif kind == "repeated":
            cameras[:] = cameras[0]
        X = as_table(cameras @ shape)
        model = CompressibleNRSfM(1, n_atoms=n_atoms, random_state=0).fit(X)
        for name in ("shapes_", "motion_", "basis_", "alpha_", "inverse_snr_"):
            assert np.isfinite(getattr(model, name)).all(), name
        assert model.dictionary_residual_ < 1e-3
        if kind == "rigid":
            assert model.inverse_snr_ < 1e-3

    @pytest.mark.parametrize(
        ("settings", "message"),
        [
            ({"n_atoms": 2, "sparsity": 3}, "sparsity=3 must not be .* n_atoms=2"),
            ({"sparsity": 4}, "sparsity=4 must not be .* n_atoms=3"),
            ({"n_atoms": 31}, "n_atoms=31 needs as many frames .* n_samples=30"),
        ],
    )
    def test_impossible_sizes(self, settings, message):
        X = as_table(sparse_scene(0, 30, 20).frames)
        with pytest.raises(ValueError, match=message):
            CompressibleNRSfM(2, **settings).fit(X)

    @pytest.mark.parametrize(
        "settings",
        [
            {"n_atoms": 0},
            {"sparsity": 0},
            {"penalty": -0.1},
            {"ridge": 0.0},
            {"ridge": 0.3},
            {"max_iter": 0},
            {"tol": -1.0},
            {"random_state": "seed"},
        ],
    )
    def test_invalid_parameters(self, settings):
        X = as_table(sparse_scene(0, 30, 20).frames)
        (name,) = settings
        with pytest.raises(InvalidParameterError, match=f"'{name}' parameter"):
            CompressibleNRSfM(2, **settings).fit(X)

    def test_missing_points(self):
        X = as_table(sparse_scene(0, 30, 20).frames)
        X[3, 4:6] = np.nan
        with pytest.raises(ValueError, match=r"takes no missing points .* is row 3"):
            CompressibleNRSfM(2).fit(X)


@pytest.mark.slow
# The tables of the checks have no layout.
@pytest.mark.filterwarnings("ignore:layout=:UserWarning")
@parametrize_with_checks(
    [CompressibleNRSfM(n_components=1, max_iter=2)],  # few steps, for speed
    expected_failed_checks=lambda estimator: {
        "check_estimators_nan_inf": "feeds tables that are not widened"
    },
    xfail_strict=True,
)
def test_contract_on_landmark_tables(estimator, check, landmark_tables):
    check(estimator)


def depth_error(model, truth):
    """Return the 3D error of shapes in camera frames, relative to their size."""
    cameras = model.motion_
    third = np.cross(cameras[:, 0], cameras[:, 1])[:, None]
    space = np.concatenate([cameras, third], axis=1)
    shapes = model.shapes_ @ space.swapaxes(1, 2)
    A = polar(np.einsum("ija,ijb->ab", truth, shapes)).rows
    distance = np.linalg.norm(truth - shapes @ A.T, axis=2).mean()
    return distance / truth.std(axis=1).mean()


@pytest.fixture(scope="module")
def shark(load_data):
    """Return the table and the centred shapes in camera frames."""
    data = load_data("shark_torresani")
    truth = data["S3d"] - data["S3d"].mean(axis=1, keepdims=True)
    return data["W2d"].reshape(len(truth), -1), truth


def by_seeds(X, n_seeds=3, **settings):
    """Return a fit of each of some seeds."""
    return [
        CompressibleNRSfM(1, random_state=seed, **settings).fit(X)
        for seed in range(n_seeds)
    ]


@pytest.fixture(scope="module")
def three_atoms(shark):
    """Return the fits of the shark by three atoms."""
    return by_seeds(shark[0], n_atoms=3)


class TestShark:
    """Shapes of rank two (480 x 91, rank five): no sparse dictionary is unique."""

    def test_one_atom_is_the_rigid_factorisation(self, shark):
        X, truth = shark
        W = X.reshape((*truth.shape[:2], 2)).transpose(0, 2, 1).reshape(480, -1)
        W = W - W.mean(axis=1, keepdims=True)
        energy = np.linalg.svd(W, compute_uv=False) ** 2
        for model in by_seeds(X, n_seeds=2, n_atoms=1, sparsity=1):
            floor = energy[3:].sum() / energy.sum()
            assert model.dictionary_residual_ == pytest.approx(floor)
            # With the released code of the publication: 0.0118.
            assert floor < model.inverse_snr_ < 0.0118
            assert depth_error(model, truth) < 0.25

    def test_three_atoms(self, shark, three_atoms):
        _, truth = shark
        # With the released code 0.27 and 1.3.
        assert max(m.inverse_snr_ for m in three_atoms) < 0.27
        assert max(depth_error(m, truth) for m in three_atoms) < 1.3

    @pytest.mark.slow
    def test_twenty_atoms(self, shark):
        X, truth = shark
        model = CompressibleNRSfM(1, n_atoms=20, random_state=0).fit(X)
        # With the released code 4.24 and 2.6, or more.
        assert model.inverse_snr_ < 1.0
        assert depth_error(model, truth) < 2.6

    @pytest.mark.slow
    def test_ridge_against_atoms_that_cancel(self, shark, three_atoms):
        # Any two atoms span the table: without a price every frame is exact, and the
        # blocks are no cameras.
        X, _ = shark
        without = by_seeds(X, n_atoms=3, ridge=1e-6)
        for model in without:
            assert model.dictionary_residual_ < 1e-6
            assert model.inverse_snr_ > 0.2
        medians = [
            np.median([m.inverse_snr_ for m in models])
            for models in (three_atoms, without)
        ]
        assert medians[0] < 0.5 * medians[1]
