"""The steps of the baselines, by the mathematics that each of them promises."""

from typing import NamedTuple

import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal, assert_equal
from numpy.typing import NDArray
from scenes import measurements, random_cameras, random_rotation
from scipy.spatial.transform import Rotation

from isa_nrsfm._linalg.small_matrices import polar
from isa_nrsfm.baselines import CompressibleNRSfM
from isa_nrsfm.baselines._block_dictionary import (
    code_frames,
    group_sparse_factors,
    update_atoms,
)
from isa_nrsfm.baselines._block_matrix import nuclear_norm_shapes
from isa_nrsfm.baselines._compressible import (
    FEWEST_SHARED,
    align_blocks,
    chain_atoms,
    metric_correction,
)
from isa_nrsfm.baselines._pseudo_inverse import (
    least_norm_shapes,
    orthographic_cameras,
    truncate_rank,
)
from isa_nrsfm.baselines._shape_sequence import camera_signs, shape_signs
from isa_nrsfm.datasets import make_nonrigid_tracks

rng_of = np.random.default_rng
# More frames than coordinates, and fewer.
tall_and_wide = pytest.mark.parametrize("n_frames", [50, 10])


class TestShapeSequences:
    @tall_and_wide
    def test_signs_make_shapes_similar(self, n_frames, rng):
        shapes = rng.normal(size=(8, 3)) + 0.5 * rng.normal(size=(n_frames, 8, 3))
        signs, order = rng.choice([-1.0, 1.0], n_frames), rng.permutation(n_frames)
        found = shape_signs(signs[:, None, None] * shapes)
        assert_array_equal(found, signs * (found[0] * signs[0]))
        # Each shape agrees with the sum of all, and frames have no order.
        noise = rng.normal(size=(n_frames, 6, 3))
        signs = shape_signs(noise)
        total = np.tensordot(signs, noise, 1)
        assert np.linalg.norm(total) > np.linalg.norm(noise.sum(axis=0))
        assert (signs * np.tensordot(noise, total, 2) >= 0).all()
        other = shape_signs(noise[order])
        assert_array_equal(other, signs[order] * (other[0] * signs[order[0]]))

    def test_signs_make_the_camera_turn_little(self):
        # A turn of 1.5 rounds, 8 degrees a frame.
        turns = np.outer(np.radians(8.0) * np.arange(70), [0.1, 0.9, 0.3])
        cameras = Rotation.from_rotvec(turns).as_matrix()[:, :2]
        signs = rng_of(0).choice([-1.0, 1.0], 70)
        found = camera_signs(signs[:, None, None] * cameras)
        assert_array_equal(found, signs * signs[0])
        assert_array_equal(camera_signs(cameras[:1]), [1.0])


class TestFirstShapes:
    cameras = random_cameras(rng_of(0), 12)
    W = rng_of(0).normal(size=(24, 9))

    def images(self, shapes):
        return (self.cameras @ shapes.swapaxes(1, 2)).reshape(24, -1)

    def test_least_norm(self):
        shapes = least_norm_shapes(self.W, self.cameras)
        assert_allclose(self.images(shapes), self.W, atol=1e-14)
        R = np.zeros((24, 36))
        for i, camera in enumerate(self.cameras):
            R[2 * i : 2 * i + 2, 3 * i : 3 * i + 3] = camera
        expected = (np.linalg.pinv(R) @ self.W).reshape(12, 3, -1).swapaxes(1, 2)
        assert_allclose(shapes, expected, atol=1e-14)

    def test_nearest_of_a_rank(self):
        shapes = rng_of(0).normal(size=(8, 5, 3))
        nearest = truncate_rank(shapes, 3)
        assert np.linalg.matrix_rank(nearest.reshape(8, -1)) == 3
        beyond = np.linalg.svd(shapes.reshape(8, -1), compute_uv=False)[3:]
        assert np.sum((shapes - nearest) ** 2) == pytest.approx(np.sum(beyond**2))
        signs = rng_of(0).choice([-1.0, 1.0], (8, 1, 1))
        assert_allclose(truncate_rank(signs * shapes, 3), signs * nearest)

    def test_cameras_of_an_exact_table(self):
        truth = make_nonrigid_tracks(60, 30, 2, camera="orthographic", random_state=0)
        found = orthographic_cameras(measurements(truth.tracks, False), 3)
        rows, expected = found.reshape(-1, 3), truth.motion.reshape(-1, 3)
        assert_allclose(rows @ rows.T, expected @ expected.T, atol=2e-4)
        gram = found @ found.swapaxes(1, 2)
        assert_allclose(gram - np.eye(2), 0, atol=1e-14)


class TestNuclearNorm:
    cameras = random_cameras(rng_of(0), 20)

    @pytest.fixture
    def W(self):
        """Images of shapes that are mixtures of two, with noise."""
        rng = rng_of(0)
        shapes = np.tensordot(rng.normal(size=(20, 2)), rng.normal(size=(2, 11, 3)), 1)
        W = self.cameras @ shapes.swapaxes(1, 2) + 0.05 * rng.normal(size=(20, 2, 11))
        return W.reshape(40, -1)

    def solve(self, W, price=0.5, max_iter=20_000, tol=1e-11, cameras=None, **options):
        cameras = self.cameras if cameras is None else cameras
        start = least_norm_shapes(W, cameras)
        options |= {"max_iter": max_iter, "tol": tol}
        return nuclear_norm_shapes(W, cameras, price, start, **options)

    def errors(self, W, shapes):
        return W.reshape(20, 2, -1) - self.cameras @ shapes.swapaxes(1, 2)

    @pytest.mark.parametrize("accelerated", [True, False])
    @pytest.mark.parametrize("price", [0.05, 2.0])
    def test_optimality(self, W, accelerated, price):
        shapes, _, converged = self.solve(W, price, accelerated=accelerated)
        assert converged
        # Minus the slope of the error is mu times a subgradient of the nuclear norm:
        # U V^T plus something orthogonal to U and V with a spectral norm of at most 1.
        error = self.errors(W, shapes)
        G = (error.swapaxes(1, 2) @ self.cameras).reshape(20, -1) / price
        U, S, Vt = np.linalg.svd(shapes.reshape(20, -1), full_matrices=False)
        rank = np.sum(S > 1e-6 * S[0])
        assert 0 < rank < 20
        U, Vt = U[:, :rank], Vt[:rank]
        assert_allclose(U.T @ G, Vt, atol=1e-6)
        assert_allclose(G @ Vt.T, U, atol=1e-6)
        assert np.linalg.norm(G - U @ Vt, 2) < 1 + 1e-6

    def test_steps(self, W):
        values = []
        for n in range(1, 30):
            shapes = self.solve(W, accelerated=False, max_iter=n, tol=0)[0]
            norm = np.linalg.svd(shapes.reshape(20, -1), compute_uv=False).sum()
            values.append(0.5 * norm + np.sum(self.errors(W, shapes) ** 2) / 2)
        assert (np.diff(values) < 0).all()
        fast, published = (self.solve(W, accelerated=a) for a in (True, False))
        assert_allclose(fast[0], published[0], atol=1e-6)
        assert fast[1] < published[1] / 4
        assert self.solve(W, max_iter=3, tol=0)[1:] == (3, False)
        _, n_iter, converged = self.solve(W, tol=1e-3)
        assert converged
        assert self.solve(W, max_iter=n_iter, tol=1e-3)[1:] == (n_iter, True)
        assert not self.solve(W, max_iter=n_iter - 1, tol=1e-3)[2]


class SparseScene(NamedTuple):
    """Frames ``R_i sum_l c_il X_l``, of mean square norm one."""

    frames: NDArray  # (I, 2, J)
    cameras: NDArray  # (I, 2, 3)
    coefficients: NDArray  # (I, L)
    atoms: NDArray  # (L, 3, J)

    @property
    def shapes(self):
        return np.tensordot(self.coefficients, self.atoms, 1)


def sparse_scene(seed, n_frames=200, n_points=40, n_atoms=4, sparsity=2):
    """Return frames of shapes that are sums of so many random atoms, exactly."""
    rng = rng_of(seed)
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


def true_code(scene, seed=None):
    """Return orthonormal atoms, turned at random with a seed, blocks and active."""
    blocks = np.einsum("il,irc->ilrc", scene.coefficients, scene.cameras)
    U, S, atoms = np.linalg.svd(scene.atoms, full_matrices=False)
    turns = np.array([np.eye(3)] * len(atoms))
    if seed is not None:
        turns = np.stack([random_rotation(seed + k) for k in range(len(atoms))])
    blocks = blocks @ (U * S[:, None]) @ turns.swapaxes(1, 2)
    return turns @ atoms, blocks, scene.coefficients != 0


def images(blocks, atoms):
    """Return the frames of a code."""
    return np.einsum("ilrc,lcp->irp", blocks, atoms)


def norms(blocks):
    return np.linalg.norm(blocks, axis=(-2, -1))


class TestBlockDictionary:
    @pytest.mark.parametrize("seed", [1, 2])
    def test_relaxed_problem_is_solved(self, seed):
        frames, penalty = sparse_scene(seed).frames, 0.06
        random_state = np.random.RandomState(0)
        blocks, atoms = group_sparse_factors(frames, 4, penalty, random_state)
        there = norms(blocks) > 0
        assert 0 < np.sum(~there) < there.size
        rest = frames - images(blocks, atoms)
        # Where a block is, the residual pulls as hard as the price; elsewhere, less.
        pull = np.einsum("irp,lcp->ilrc", rest, atoms)
        price = penalty * blocks[there] / norms(blocks)[there][:, None, None]
        assert_allclose(pull[there], price, atol=0.02 * penalty)
        assert norms(pull)[~there].max() < 1.02 * penalty
        # Atoms are of norm one, and the residual pulls outwards.
        assert_allclose(norms(atoms), 1)
        pull = np.einsum("ilrc,irp->lcp", blocks, rest)
        outwards = np.einsum("lcp,lcp->l", pull, atoms)
        assert (outwards > 0).all()
        tangent = pull - outwards[:, None, None] * atoms
        assert np.linalg.norm(tangent) < 1e-2 * np.linalg.norm(pull)
        # No block is worth a higher price.
        few = frames[:30]
        blocks, atoms = group_sparse_factors(few, 4, norms(few).max(), random_state)
        assert not blocks.any()
        assert np.isfinite(atoms).all()

    @pytest.mark.parametrize("sparsity", [1, 3])
    def test_code_of_exact_frames(self, sparsity):
        scene = sparse_scene(0, n_points=60, n_atoms=6, sparsity=sparsity)
        atoms, true, used = true_code(scene)
        blocks, active = code_frames(scene.frames, atoms, sparsity, 1e-8)
        # Atoms overlap, and a greedy choice among them may err in rare frames.
        right = (active == used).all(axis=1)
        assert right.mean() > 0.97
        assert_allclose(blocks[right], true[right], atol=1e-5)
        for ridge in (1e-6, 1e-2, 0.25):
            blocks, active = code_frames(scene.frames, atoms, 2, ridge)
            assert set(active.sum(axis=1)) <= {1, 2}
            assert_array_equal(active, blocks.any(axis=(2, 3)))

    @pytest.mark.parametrize("ridge", [0.001, 0.01])
    def test_share_of_a_block_that_is_left(self, ridge, rng):
        # Two atoms without overlap, of which the second explains the share x.
        atoms = np.linalg.qr(rng.normal(size=(20, 6)))[0].T.reshape(2, 3, 20)
        cameras = random_cameras(rng, 40) / np.sqrt(2)
        x = np.linspace(0, 0.2, 40)
        coefficients = np.sqrt(np.column_stack([1 - x, x]))
        frames = np.einsum("il,irc,lcp->irp", coefficients, cameras, atoms)
        blocks, active = code_frames(frames, atoms, 2, ridge)
        clear = np.abs(x - 4 * ridge) > ridge  # near it the reweighting is slow
        assert_array_equal(active[clear, 1], x[clear] > 4 * ridge)
        kept = x > 8 * ridge
        share = (x + np.sqrt(np.maximum(x**2 - 4 * x * ridge, 0))) / 2 - ridge
        assert_allclose(norms(blocks)[kept, 1] ** 2, share[kept], rtol=0.02)

    def test_units_rotations_and_batches_of_frames(self):
        frames = sparse_scene(0).frames
        atoms, *_ = true_code(sparse_scene(0))
        blocks, active = code_frames(frames, atoms, 2, 0.01)
        units = rng_of(0).uniform(1e-6, 1e6, (len(frames), 1, 1))
        roll, turn = random_rotation(0, 2), random_rotation(1)
        for (found, used), expected in (
            (code_frames(units * frames, atoms, 2, 0.01), units[..., None] * blocks),
            (code_frames(frames, atoms, 2, 0.01, batch=7), blocks),
            (code_frames(roll @ frames, atoms, 2, 0.01), roll @ blocks),
            (code_frames(frames, turn @ atoms, 2, 0.01), blocks @ turn.T),
        ):
            assert_array_equal(used, active)
            assert_allclose(found, expected, atol=1e-9 * np.abs(expected).max())

    def disturbed(self, seed=0):
        """Return frames, atoms that are not the true ones, and their code."""
        scene = sparse_scene(seed)
        atoms = scene.atoms + 0.1 * rng_of(seed).normal(size=scene.atoms.shape)
        atoms = np.linalg.svd(atoms, full_matrices=False)[2]
        return scene.frames, atoms, *code_frames(scene.frames, atoms, 2, 0.01)

    @pytest.mark.parametrize("seed", range(3))
    def test_updates_of_atoms_lower_the_residual(self, seed):
        given = self.disturbed(seed)
        frames, atoms, blocks, active = (part.copy() for part in given)
        new, coded, used, residuals = update_atoms(*given)
        assert_equal(given, (frames, atoms, blocks, active))
        assert_allclose(residuals, frames - images(coded, new), atol=1e-12)
        before = np.sum((frames - images(blocks, atoms)) ** 2)
        assert np.sum(residuals**2) < 0.5 * before
        assert_allclose(new @ new.swapaxes(1, 2), [np.eye(3)] * 4, atol=1e-12)
        assert_array_equal(used, active)
        assert_array_equal(coded.any(axis=(2, 3)), active)
        # The last atom is the best of rank three, and nothing rises once more.
        rest = residuals[used[:, -1]] + coded[used[:, -1], -1] @ new[-1]
        values = np.linalg.svd(rest.reshape(-1, rest.shape[2]), compute_uv=False)
        assert_allclose(np.sum(residuals[used[:, -1]] ** 2), np.sum(values[3:] ** 2))
        again = update_atoms(frames, new, coded, used)[3]
        assert np.sum(again**2) <= np.sum(residuals**2) * (1 + 1e-12)

    @pytest.mark.parametrize("n_users", [0, 1, 2])
    def test_atoms_that_few_frames_use(self, n_users):
        frames, atoms, blocks, active = self.disturbed(1)
        for atom in (1, 2):
            dropped = np.flatnonzero(active[:, atom])[n_users:]
            active[dropped, atom], blocks[dropped, atom] = False, 0.0
        new, coded, used, residuals = update_atoms(frames, atoms, blocks, active)
        assert not used[:, [1, 2]].any()
        assert not coded[:, [1, 2]].any()
        assert_allclose(residuals, frames - images(coded, new), atol=1e-12)
        # Each has three of the four directions of two frames, not of the same ones.
        inside = norms(frames[:, None] @ new.swapaxes(1, 2))
        share = inside / norms(frames)[:, None]
        assert (share[:, [1, 2]].max(axis=0) > 0.8).all()
        both = new[[1, 2]].reshape(6, -1)
        assert np.linalg.svd(both, compute_uv=False)[-1] > 0.01
        kept, _, used, _ = update_atoms(frames, atoms, blocks, active, replace=False)
        assert_array_equal(used, active)
        if n_users < 2:
            assert_array_equal(kept[[1, 2]], atoms[[1, 2]])


class TestMetricCorrection:
    def distorted(self, seed, n_frames, noise=0.0):
        """Return blocks ``c_i R_i A``, A random but stretched by no more than 4."""
        rng = rng_of(seed)
        signs = rng.choice([-1, 1], (n_frames, 1, 1))
        scales = signs * rng.uniform(0.5, 2, (n_frames, 1, 1))
        A = random_rotation(seed) * rng.uniform(0.5, 2, 3) @ random_rotation(seed + 1)
        blocks = scales * random_cameras(rng, n_frames) @ A
        return blocks + noise * rng.normal(size=blocks.shape)

    @pytest.mark.parametrize("seed", range(3))
    @pytest.mark.parametrize("n_frames", [1, 2, 3, 50])
    def test_exact_blocks(self, seed, n_frames):
        blocks = self.distorted(seed, n_frames)
        if n_frames < 3:
            # Near to cameras already: of the many solutions the nearest is no worse.
            rng = rng_of(seed)
            distortion = np.eye(3) + 0.05 * rng.normal(size=(3, 3))
            blocks = random_cameras(rng, n_frames) @ distortion
        G = metric_correction(blocks)
        gram = (blocks @ G) @ (blocks @ G).swapaxes(1, 2)
        size = np.trace(gram, axis1=1, axis2=2)[:, None, None] / 2
        assert_allclose(gram, size * np.eye(2), atol=1e-7 * size.max())
        assert n_frames >= 3 or np.linalg.cond(G) < 1.5

    def test_least_sum_of_squares(self):
        blocks = self.distorted(0, 100, noise=0.05)
        p1, p2 = blocks[:, 0], blocks[:, 1]

        def cost(Q):
            Q = Q / np.linalg.norm(Q)
            unequal = np.vecdot(p1 @ Q, p1) - np.vecdot(p2 @ Q, p2)
            return np.sum(unequal**2 + 4 * np.vecdot(p1 @ Q, p2) ** 2)

        G = metric_correction(blocks)
        Q, rng = G @ G.T, rng_of(1)
        for size in (1e-4, 1e-2, 1.0):
            for change in rng.normal(size=(50, 3, 3)):
                other = Q + size * np.linalg.norm(Q) * (change + change.T)
                assert cost(other) > cost(Q)
        for same in (1e-6 * blocks, random_rotation(0, 2) @ blocks):
            G = metric_correction(same)
            assert_allclose(G @ G.T, Q, atol=1e-9)


class TestAlignment:
    @pytest.mark.parametrize("seed", range(4))
    @pytest.mark.parametrize("determinant", [1, -1])
    @pytest.mark.parametrize("n_frames", [2, 30])
    def test_exact_blocks(self, seed, determinant, n_frames):
        rng = rng_of(seed)
        cameras = random_cameras(rng, n_frames)
        truth = determinant * random_rotation(seed)
        scales = rng.normal(size=(n_frames, 1, 1))
        found = align_blocks(scales * cameras @ truth.T, cameras)
        # Minus the truth is the same with all coefficients of the other sign.
        assert_allclose(found * np.sign(np.sum(found * truth)), truth, atol=1e-7)

    def test_least_distance(self, rng):
        cameras = random_cameras(rng, 40)
        blocks = rng.normal(size=(40, 1, 1)) * cameras @ random_rotation(0).T
        blocks += 0.3 * rng.normal(size=blocks.shape)

        def agreement(O):  # noqa: E741
            return np.sum(np.einsum("irc,irc->i", blocks @ O, cameras) ** 2)

        found = align_blocks(blocks, cameras)
        assert_allclose(found @ found.T, np.eye(3), atol=1e-12)
        others = [sign * random_rotation(k) for k in range(200) for sign in (1, -1)]
        near = (found + size * rng.normal(size=(20, 3, 3)) for size in (1e-3, 1e-2))
        others += [polar(each)[0] for each in np.concatenate([*near])]
        assert max(map(agreement, others)) < agreement(found)

    @pytest.mark.parametrize("seed", range(3))
    def test_chain_of_exact_atoms(self, seed):
        scene = sparse_scene(seed)
        atoms, blocks, active = true_code(scene, seed=0)
        cameras, coefficients, shapes = chain_atoms(atoms, blocks, active)
        shapes = np.tensordot(coefficients, shapes, 1)
        assert_allclose(cameras @ cameras.swapaxes(1, 2), [np.eye(2)] * 200, atol=1e-9)
        assert_allclose(cameras @ shapes, scene.frames, atol=1e-6)
        assert_array_equal(coefficients != 0, active)
        # Up to one orthogonal matrix, and the sign of each frame's camera and shape.
        O = align_blocks(cameras, scene.cameras)  # noqa: E741
        signs = np.sign(np.sum(cameras @ O * scene.cameras, axis=(1, 2)))[:, None, None]
        assert_allclose(signs * cameras @ O, scene.cameras, atol=1e-5)
        assert_allclose(signs * (O.T @ shapes), scene.shapes, atol=1e-5)
        # The matrix of an atom and an atom without frames make no difference.
        mixing = np.eye(3) + 0.2 * rng_of(0).normal(size=(4, 3, 3))
        mixed = chain_atoms(mixing @ atoms, blocks @ np.linalg.inv(mixing), active)
        shown = mixed[0] @ np.tensordot(*mixed[1:], 1)
        assert_allclose(shown, scene.frames, atol=1e-6)
        blocks = np.concatenate([0 * blocks[:, :1], blocks], axis=1)
        active = np.pad(active, ((0, 0), (1, 0)))
        padded = chain_atoms(np.concatenate([atoms[:1], atoms]), blocks, active)
        assert_array_equal(padded[0], cameras)
        assert not padded[1][:, 0].any()
        assert not padded[2][0].any()

    def test_atoms_without_shared_frames_are_aligned_by_their_shapes(self, rng):
        # One shape, nearly, learnt as three atoms of 20 frames each.
        true = rng.normal(size=(3, 30)) + 0.01 * rng.normal(size=(3, 3, 30))
        coefficients = np.kron(np.eye(3), np.ones((20, 1)))
        cameras = random_cameras(rng, 60)
        frames = cameras @ np.tensordot(coefficients, true, 1)
        scene = SparseScene(frames, cameras, coefficients, true)
        found, *_ = chain_atoms(*true_code(scene, seed=0))
        turned = found @ align_blocks(found, cameras)
        sign = np.sign(np.sum(turned[0] * cameras[0]))
        assert_allclose(sign * turned, cameras, atol=0.05)

    @pytest.mark.parametrize("missing", [0, 1])
    def test_atoms_that_share_few_frames(self, missing):
        # Two shapes that do not resemble each other: only shared frames align them.
        scene = sparse_scene(0, 60, 30, 2, 1)
        coefficients = np.zeros((60, 2))
        coefficients[: 30 + FEWEST_SHARED - missing, 0] = 1.0
        coefficients[30:, 1] = rng_of(0).uniform(0.5, 1, 30)
        frames = scene.cameras @ np.tensordot(coefficients, scene.atoms, 1)
        exact = scene._replace(frames=frames, coefficients=coefficients)
        cameras, *code = chain_atoms(*true_code(exact, seed=0))
        shown = cameras @ np.tensordot(*code, 1)
        error = np.linalg.norm(shown - frames) / np.linalg.norm(frames)
        assert (error > 1e-6) == missing


class TestSparseTables:
    def table(self, scene):
        return scene.frames.transpose(0, 2, 1).reshape(len(scene.frames), -1)

    def test_exact_table(self):
        # In pixels and away from the origin
        scene = sparse_scene(0, 300, 50, 5)
        X = 100 * self.table(scene) + np.tile([300.0, 200.0], 50)
        model = CompressibleNRSfM(4, max_iter=60, tol=1e-8, random_state=0).fit(X)
        assert model.dictionary_residual_ < 1e-3
        assert model.inverse_snr_ < 2e-3
        O = align_blocks(model.motion_, scene.cameras)  # noqa: E741
        signs = np.sign(np.sum(model.motion_ @ O * scene.cameras, axis=(1, 2)))
        shapes = signs[:, None, None] * (model.shapes_ @ O)
        truth = 100 * scene.shapes.transpose(0, 2, 1)
        assert np.linalg.norm(shapes - truth) < 0.05 * np.linalg.norm(truth)

    # More frames than the relaxed problem has, and a rigid shape.
    @pytest.mark.parametrize("size", [(1100, 20, 3), (50, 20, 1)])
    def test_one_atom_a_frame(self, size):
        scene = sparse_scene(0, *size, sparsity=1)
        model = CompressibleNRSfM(2, n_atoms=size[2], sparsity=1, random_state=0)
        model.fit(self.table(scene))
        assert model.dictionary_residual_ < 1e-12
        assert model.inverse_snr_ < 1e-12
        assert model.n_users_.sum() == size[0]
        if size[2] == 1:
            ratio = norms(model.shapes_) / np.abs(scene.coefficients[:, 0])
            assert_allclose(ratio, ratio[0], rtol=1e-6)
