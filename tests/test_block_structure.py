"""Block structure and its refinement: optimality, identities, degenerate blocks."""

import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal
from scenes import measurements, random_rotation, structured_motion

from isa_nrsfm._parameters import BLOCK_RECOVERIES
from isa_nrsfm.isa._pipeline import (
    factorise,
    leading_blocks,
    lifted_blocks,
    lifted_moments,
    motion_products,
    recover_blocks,
    refine_alternating,
    structure_energies,
)

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


def test_products_by_definition():
    scene = structured_motion(0, noise=0.3)
    cross, rigid, gram = motion_products(scene.rigid, scene.motion)
    M_0 = scene.rigid.reshape(-1, 2, 3)
    for i, M_i in enumerate(scene.motion.reshape(len(M_0), 2, -1)):
        assert_allclose(cross[i], M_0[i].T @ M_i, atol=1e-13)
        assert_allclose(rigid[i].reshape(3, 3), M_0[i].T @ M_0[i], atol=1e-13)
    assert_allclose(gram, scene.motion.T @ scene.motion, atol=1e-12)


@ALL_METHODS
class TestAllMethods:
    def test_exact_data(self, method):
        scene = structured_motion(0)
        D = recover_blocks(motion_products(scene.rigid, scene.motion), method)
        assert D.shape == (3, 3, 3)
        assert_allclose(np.linalg.norm(D, axis=(1, 2)), 1)
        assert_allclose(direction(D), direction(np.linalg.inv(scene.E)), atol=1e-8)

    @pytest.mark.parametrize("unit", [1e-9, 1e9])
    def test_units(self, method, unit):
        scene = structured_motion(0, noise=0.3)
        D = recover_blocks(motion_products(scene.rigid, scene.motion), method)
        for factors in ((unit, unit), (1.0, unit), (unit, 1.0)):
            rigid, motion = factors[0] * scene.rigid, factors[1] * scene.motion
            products = motion_products(rigid, motion)
            other = recover_blocks(products, method)
            assert_allclose(direction(other), direction(D), atol=1e-7)

    def test_subspace_without_motion(self, method):
        scene = structured_motion(0, noise=0.3)
        motion = scene.motion.copy()
        motion[:, 3:6] = 0
        D = recover_blocks(motion_products(scene.rigid, motion), method)
        assert_array_equal(D[1], 0)
        assert_allclose(np.linalg.norm(D[[0, 2]], axis=(1, 2)), 1)

    @pytest.mark.parametrize(
        ("part", "zeros"),
        [
            *(("motion", np.s_[:, n:3]) for n in (1, 2)),  # moves in fewer directions
            *(("rigid", np.s_[:, n:]) for n in (1, 2)),  # is flat
            ("rigid", np.s_[:6]),  # is not seen, in the first frame among others
        ],
    )
    def test_parts_that_are_zero(self, method, part, zeros):
        scene = structured_motion(0, noise=0.3)
        getattr(scene, part)[zeros] = 0
        D = recover_blocks(motion_products(scene.rigid, scene.motion), method)
        assert np.isfinite(D).all()
        assert_allclose(np.linalg.norm(D, axis=(1, 2)), 1)

    def test_repeated_frames(self, method):
        scene = structured_motion(0, n_frames=12, noise=0.3)
        rigid, motion = np.tile(scene.rigid, (3, 1)), np.tile(scene.motion, (3, 1))
        D = recover_blocks(motion_products(rigid, motion), method)
        assert np.isfinite(D).all()
        if method != "irls":  # which holds one of the three equal frames only
            once = recover_blocks(motion_products(scene.rigid, scene.motion), method)
            assert_allclose(direction(D), direction(once), atol=1e-10)


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

    def test_irls_depends_on_the_first_frame(self):
        scene = structured_motion(0, noise=0.5)
        rigid, motion = np.roll(scene.rigid, 2, axis=0), np.roll(scene.motion, 2, 0)
        D = recover_blocks(motion_products(scene.rigid, scene.motion), "irls")
        rolled = recover_blocks(motion_products(rigid, motion), "irls")
        assert np.abs(direction(rolled) - direction(D)).max() > 1e-3

    def test_irls_where_the_first_frame_says_nothing(self):
        scene = structured_motion(0, noise=0.5)
        motion = scene.motion.copy()
        motion[:2] = 0
        products = motion_products(scene.rigid, motion)
        expected = recover_blocks(products, "generalized_eigen")
        assert_allclose(recover_blocks(products, "irls"), expected)

    def test_generalized_eigen_stays_in_directions_that_move(self):
        scene = structured_motion(0, n_blocks=1, noise=0.5)
        R = random_rotation(3)
        motion = (scene.motion * [1.0, 0.5, 0.0]) @ R
        D = recover_blocks(motion_products(scene.rigid, motion), "generalized_eigen")[0]
        assert_allclose(R[2] @ D, 0, atol=1e-12)

    @pytest.mark.parametrize("scale_frames", [True, False])
    def test_irls_explains_less_of_the_shark(self, load_data, scale_frames):
        # The block has rank two.
        f = factorise(
            measurements(load_data("shark_torresani")["W2d"], scale_frames), 1
        )
        scene = structured_motion(0)._replace(rigid=f.rigid_motion, motion=f.motion)
        products = motion_products(f.rigid_motion, f.motion)
        D = (recover_blocks(products, method) for method in BLOCK_RECOVERIES)
        largest, irls = (explained(scene, np.linalg.pinv(d, rcond=1e-9)) for d in D)
        assert largest > 0.7 * np.sum(f.motion**2)
        assert largest > 2 * irls


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


class TestRefinement:
    @pytest.fixture
    def scene(self):
        return structured_motion(0, n_frames=40, noise=0.3)

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

    def test_best_of_the_starts_is_taken(self, scene):
        starts = random_starts(0, 3, 6)
        together = explained(scene, refined(scene, starts)[0])
        alone = (refined(scene, starts[:, s : s + 1])[0] for s in range(6))
        single = [explained(scene, E) for E in alone]
        # Trial steps are few, so the best start may be missed, but not by much.
        assert np.all(together >= 0.99 * np.max(single, axis=0))
        assert np.all(together >= np.median(single, axis=0) * (1 - 1e-9))

    def test_energies_rise_with_every_step(self, scene):
        fits = [refined(scene, random_starts(3, 3, 1), n) for n in range(1, 15)]
        energies = np.array([explained(scene, E) for E, *_ in fits])
        assert np.all(np.diff(energies, axis=0) >= -1e-13 * energies[-1])
        assert np.all(energies[-1] > energies[0])
        assert fits[0][1:] == (1, False)

    @pytest.mark.parametrize("tol", [1e-3, 1e-10])
    def test_tolerance_is_kept(self, scene, tol):
        best, n_best, _ = refined(scene, random_starts(3))
        E, n_iter, converged = refined(scene, random_starts(3), tol=tol)
        assert converged
        assert n_iter <= n_best
        assert np.all(explained(scene, E) >= explained(scene, best) * (1 - 5 * tol))

    def test_order_of_subspaces_units_and_starts(self, scene):
        starts = random_starts(0)
        expected = direction(refined(scene, starts)[0])
        order = [2, 0, 1]
        motion = scene.motion.reshape(-1, 3, 3)[:, order].reshape(-1, 9)
        other = refined(scene._replace(motion=motion), starts[order])[0]
        assert_allclose(direction(other), expected[order], atol=1e-6)
        for of_rigid, of_motion in ((1e-9, 1e9), (1e9, 1e9), (1.0, 1e-9)):
            rigid, motion = of_rigid * scene.rigid, of_motion * scene.motion
            other = refined(scene._replace(rigid=rigid, motion=motion), starts)[0]
            assert_allclose(direction(other), expected, atol=1e-6)
        factors = np.array([1e-6, -1.0, 1e6, -7.0])[:, None, None]
        padded = np.concatenate([np.zeros((3, 1, 3, 3)), factors * starts], axis=1)
        other = refined(scene, padded)[0]
        assert_allclose(direction(other), expected, atol=1e-6)

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
        flat = structured_motion(0, n_frames=40, noise=0.3)
        flat.rigid[:, n:] = 0
        E = refined(flat, random_starts(0))[0]
        assert np.isfinite(E).all()
        assert np.all(explained(flat, E) > 0)
        scene.motion[:, n:3] = 0
        E = refined(scene, random_starts(0))[0]
        assert_allclose(E[0, :, n:], 0, atol=1e-9)
        assert_allclose(np.linalg.norm(E, axis=(1, 2)), 1)

    def test_frames_that_do_not_see_the_rigid_object(self, scene):
        scene.rigid[:8] = 0
        part = scene._replace(rigid=scene.rigid[8:], motion=scene.motion[8:])
        fits = [refined(each, random_starts(0))[0] for each in (scene, part)]
        assert_allclose(direction(fits[0]), direction(fits[1]), atol=1e-6)


class TestLiftedMotion:
    def lifted(self, rigid, motion):
        """Return L_i (I, 3, n_signals), frame by frame."""
        M_0 = rigid.reshape(-1, 2, 3)
        L = []
        for A, M in zip(M_0, motion.reshape(len(M_0), 2, -1), strict=True):
            ridge = 0.1 * np.trace(A.T @ A)
            L.append(np.linalg.solve(A.T @ A + ridge * np.eye(3), A.T @ M))
        return np.array(L)

    @pytest.fixture
    def scene(self):
        return structured_motion(0, noise=0.3)

    @pytest.fixture
    def moments(self, scene):
        return lifted_moments(motion_products(scene.rigid, scene.motion))

    subspaces = random_rotation(1, 9).reshape(3, 3, 9)

    def test_moments_by_plain_loops(self, scene, moments):
        L = self.lifted(scene.rigid, scene.motion)
        assert_allclose(moments, np.einsum("iam,ibn->abmn", L, L), atol=1e-12)

    def test_blocks_are_moments_of_the_turned_lifted_motion(self, scene, moments):
        L = self.lifted(scene.rigid, scene.motion)
        got = lifted_blocks(moments, self.subspaces)
        for k in range(3):
            flat = (L @ self.subspaces[k].T).reshape(-1, 9)
            assert_allclose(got[k], flat.T @ flat, atol=1e-12)

    def test_leading_blocks_are_eigenvectors_by_decreasing_eigenvalue(self, moments):
        E = leading_blocks(moments, self.subspaces, 3)
        assert E.shape == (3, 3, 3, 3)
        for k, matrix in enumerate(lifted_blocks(moments, self.subspaces)):
            vectors = E[k].reshape(3, 9)
            assert_allclose(vectors @ vectors.T, np.eye(3), atol=1e-12)
            values = np.sort(np.linalg.eigvalsh(matrix))[::-1][:3]
            assert_allclose(vectors @ matrix, values[:, None] * vectors, atol=1e-10)

    def test_energies_are_the_largest_eigenvalues(self, moments):
        E = leading_blocks(moments, self.subspaces, 1).reshape(3, 9)
        blocks = lifted_blocks(moments, self.subspaces)
        expected = np.einsum("ka,kab,kb->k", E, blocks, E)
        assert_allclose(structure_energies(moments, self.subspaces), expected)
