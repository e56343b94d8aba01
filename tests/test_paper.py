"""The paper's pipeline as a whole: identities, invariances, degenerate tables."""

from typing import NamedTuple

import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal
from scenes import (
    measurements,
    permute_frames,
    random_rotation,
    rotate_frames,
    spherical_sources,
)
from sklearn.base import BaseEstimator

from isa_nrsfm import FastISA, PooledFastICA
from isa_nrsfm._frames.camera import rigid_cameras
from isa_nrsfm._paper.factors import factorise
from isa_nrsfm._paper.pipeline import run_paper_pipeline
from isa_nrsfm._paper.svd import leading_triplets
from isa_nrsfm._parameters.choices import BLOCK_RECOVERIES

OPTIONS = {
    "block_recovery": "generalized_eigen",
    "max_iter": 500,
    "tol": 1e-12,
}


class Found(NamedTuple):
    mean_shape: np.ndarray
    basis: np.ndarray
    mode_covariance: np.ndarray
    n_iter: int
    converged: bool


def run(W, K, isa=None, report=lambda stage: None, refinement="alternating", **options):
    isa = PooledFastICA(n_init=3, random_state=0) if isa is None else isa
    options = {**OPTIONS, **options}
    if refinement is None:
        options["max_iter"] = 0
    shapes, *others = run_paper_pipeline(
        factorise(W, K), K, isa, report=report, **options
    )
    return Found(shapes[0].T, shapes[1:].transpose(0, 2, 1), *others)


def inverse_snr(W, result):
    """Return the share of the energy of W that rigid cameras and alpha leave."""
    M = rigid_cameras(W, result.mean_shape)
    residual = W.reshape(len(M), 2, -1) - M @ result.mean_shape.T
    for B in result.basis:
        image = M @ B.T
        energy = np.sum(image**2, axis=(1, 2))
        alpha = np.sum(residual * image, axis=(1, 2))
        alpha = np.divide(alpha, energy, out=np.zeros(len(M)), where=energy > 1e-30)
        residual = residual - alpha[:, None, None] * image
    return np.sum(residual**2) / np.sum(W**2)


def assert_same_basis(basis, other, **tolerance):
    """Compare basis shapes up to order and sign."""
    A, B = basis.reshape(len(basis), -1), other.reshape(len(other), -1)
    inner = A @ B.T
    match = np.abs(inner).argmax(axis=1)
    assert sorted(match) == list(range(len(A)))
    sign = np.sign(inner[np.arange(len(A)), match])
    assert_allclose(sign[:, None] * B[match], A, **tolerance)


def ideal_matrix(seed, K, n_points=400, n_cameras=15):
    """
    Return W for which the paper's assumptions hold exactly, and its shapes.

    Every camera sees all combinations of signs of the coefficients, so that rigid and
    non-rigid motion are orthogonal; the shapes are white and orthogonal, and those of
    the basis independent and heavy-tailed.
    """
    rng = np.random.default_rng(seed)
    rows = np.hstack(
        [rng.normal(size=(n_points, 3)), spherical_sources(seed, n_points, K)]
    )
    rows -= rows.mean(axis=0)
    Z = np.linalg.qr(rows)[0].T * np.sqrt(n_points)
    Z *= np.sign(np.sum(Z * rows.T, axis=1))[:, None]
    shapes = Z.reshape(K + 1, 3, n_points)
    shapes[1:] = rng.normal(size=(K, 3, 3)) @ shapes[1:]

    signs = np.array(np.meshgrid(*[[-1.0, 1.0]] * K)).reshape(K, -1).T
    frames = []
    for camera in rng.normal(size=(n_cameras, 2, 3)):
        sizes = 0.05 * rng.exponential(size=K) + 0.01
        for sign in signs:
            S = shapes[0] + np.tensordot(sign * sizes, shapes[1:], 1)
            frames.append(camera @ S)
    return np.vstack(frames), shapes


@pytest.fixture(scope="module")
def faces():
    """A table of few faces with real-like structure: 2D images of a bending shape."""
    rng = np.random.default_rng(0)
    shape, basis = rng.normal(size=(3, 40)), spherical_sources(0, 40, 3).T
    basis = basis.reshape(3, 3, 40) * np.array([0.3, 0.2, 0.1])[:, None, None]
    frames = [
        random_rotation(i)[:2] @ (shape + np.tensordot(rng.normal(size=3), basis, 1))
        for i in range(60)
    ]
    W = np.vstack(frames)
    W = W + 0.01 * rng.normal(size=W.shape)
    return W - W.mean(axis=1, keepdims=True)


class TestIdealData:
    @pytest.mark.parametrize("seed", range(4))
    @pytest.mark.parametrize("method", BLOCK_RECOVERIES)
    @pytest.mark.parametrize("refinement", ["alternating", None])
    def test_one_basis_shape_is_exact(self, seed, method, refinement):
        # One subspace: nothing is left to statistics.
        W, shapes = ideal_matrix(seed, 1, n_points=30)
        result = run(W, 1, block_recovery=method, refinement=refinement)
        assert inverse_snr(W, result) < 1e-20
        assert leading_triplets(W, 6).rest_share < 1e-25

        # The same shapes, up to one affinity and the scale of the basis shape.
        A = np.linalg.lstsq(result.mean_shape, shapes[0].T)[0]
        assert_allclose(result.mean_shape @ A, shapes[0].T, atol=1e-10)
        B, truth = (result.basis[0] @ A).ravel(), shapes[1].T.ravel()
        cosine = B @ truth / np.linalg.norm(B) / np.linalg.norm(truth)
        assert_allclose(abs(cosine), 1, atol=1e-12)

    @pytest.mark.parametrize(
        "isa",
        [
            FastISA(n_init=3, random_state=0),
            PooledFastICA(n_init=3, random_state=0),
        ],
    )
    def test_three_basis_shapes_are_found_up_to_sampling(self, isa):
        W, shapes = ideal_matrix(0, 3, n_points=2000)
        result = run(W, 3, isa)
        assert inverse_snr(W, result) < 1e-3
        A = np.linalg.lstsq(result.mean_shape, shapes[0].T)[0]
        B = (result.basis @ A).reshape(3, -1)
        truth = shapes[1:].transpose(0, 2, 1).reshape(3, -1)
        B /= np.linalg.norm(B, axis=1)[:, None]
        truth = truth / np.linalg.norm(truth, axis=1)[:, None]
        assert np.abs(truth @ B.T).max(axis=1).min() > 0.97


class TestIdentities:
    @pytest.mark.parametrize("refinement", ["alternating", None])
    def test_shapes_are_centred_and_orthogonal_to_each_other(self, faces, refinement):
        result = run(faces, 3, refinement=refinement)
        assert result.mean_shape.shape == (40, 3)
        assert result.basis.shape == (3, 40, 3)
        shapes = np.concatenate([result.mean_shape[None], result.basis])
        assert_allclose(shapes.mean(axis=1), 0, atol=1e-13)
        for k in range(4):
            for other in range(k):
                assert_allclose(shapes[k].T @ shapes[other], 0, atol=1e-10)

    def test_inverse_snr_between_rank_floor_and_rigid_residual(self, faces):
        result = run(faces, 3)
        S = np.linalg.svd(faces, compute_uv=False)
        rigid = np.sum(S[3:] ** 2) / np.sum(S**2)
        floor = leading_triplets(faces, 12).rest_share
        assert floor < inverse_snr(faces, result) < rigid

    @pytest.mark.parametrize("method", BLOCK_RECOVERIES)
    def test_refinement_never_makes_it_worse(self, faces, method):
        before = run(faces, 3, block_recovery=method, refinement=None)
        after = run(faces, 3, block_recovery=method)
        assert inverse_snr(faces, after) <= inverse_snr(faces, before)
        assert before.n_iter == 1
        assert before.converged
        assert after.converged

    def test_mode_covariance(self, faces):
        # C = (J / 2I) M_ISA^T M_ISA, an orthogonal transform of M'^T M'.
        result = run(faces, 3)
        C = result.mode_covariance
        f = factorise(faces, 3)
        expected = f.motion.T @ f.motion * 40 / 120
        assert_allclose(C, C.T)
        assert_allclose(np.linalg.eigvalsh(C), np.linalg.eigvalsh(expected), rtol=1e-10)
        assert_allclose(np.trace(C) * 120, np.sum(f.motion**2) * 40)

    def test_blocks_of_the_mode_covariance_belong_to_the_basis(self, faces):
        result = run(faces, 3)
        f = factorise(faces, 3)
        for k, B in enumerate(result.basis):
            # An orthonormal basis of the space of the shape's three coordinates.
            Q = np.linalg.svd(B, full_matrices=False)[0]
            motion = f.motion @ f.signals @ Q / np.sqrt(40)
            block = result.mode_covariance[3 * k : 3 * k + 3, 3 * k : 3 * k + 3]
            assert_allclose(
                np.linalg.eigvalsh(motion.T @ motion * 40 / 120),
                np.linalg.eigvalsh(block),
                rtol=1e-6,
            )

    def test_refinement_in_few_steps(self, faces):
        result = run(faces, 3, max_iter=1, tol=0.0)
        assert not result.converged
        assert result.n_iter == 1

    def test_stages_are_reported_in_order(self, faces):
        stages = []
        run(faces, 2, report=stages.append)
        assert stages == [
            "independent subspaces",
            "block structure and refinement",
        ]


class TestInvariances:
    @pytest.mark.filterwarnings("ignore:FastICA did not converge")
    @pytest.mark.parametrize(
        "isa",
        [
            FastISA(n_init=2, random_state=0),
            PooledFastICA(n_init=3, random_state=0),
        ],
    )
    @pytest.mark.parametrize("name", ["akhter_drink", "ict_bu3dfe_like_68"])
    def test_real_tables(self, load_data, isa, name):
        # Many starts do not converge here: the paths to them are chaotic.
        W = measurements(load_data(name)["W2d"][::5])
        points = np.random.default_rng(1).permutation(W.shape[1])
        other_W = rotate_frames(permute_frames(W, 1)[0], 1)[:, points]
        result, other = run(W, 3, isa), run(other_W, 3, isa)
        assert_same_basis(other.basis, result.basis[:, points], atol=1e-6)

    @pytest.mark.parametrize("unit", [1e-9, 1e9])
    def test_units(self, faces, unit):
        result, other = run(faces, 3), run(unit * faces, 3)
        assert_allclose(other.mean_shape, result.mean_shape, atol=1e-9)
        assert_same_basis(other.basis, result.basis, atol=1e-6)
        assert_allclose(
            other.mode_covariance / unit**2, result.mode_covariance, atol=1e-8
        )

    def test_repeated_frames(self, faces):
        result, other = run(faces, 3), run(np.tile(faces, (2, 1)), 3)
        assert_same_basis(other.basis, result.basis, atol=1e-6)
        assert_allclose(other.mode_covariance, result.mode_covariance, atol=1e-8)


class Recorder(BaseEstimator):
    """A strategy that leaves the signals and remembers what it was told."""

    def fit(self, signals, y=None, *, covariance=None, criterion=None):
        self.signals_, self.covariance_ = signals, covariance
        self.criterion_ = criterion
        # Not quite orthogonal, as fitted components may be.
        n = signals.shape[1]
        self.components_ = random_rotation(0, n) + 1e-6 * random_rotation(1, n)
        return self


class Plain(BaseEstimator):
    """A strategy that takes nothing but signals."""

    def fit(self, signals, y=None):
        self.components_ = np.eye(signals.shape[1])
        return self


class TestStrategies:
    def test_white_signals_and_covariance_over_the_images(self, faces):
        isa = Recorder()
        run(faces, 3, isa)
        f = factorise(faces, 3)
        # Rounded and sorted, so that neither rounding errors nor the order of points
        # can lead the strategy elsewhere.
        rounded = np.round(f.signals.T, 5)
        assert_array_equal(isa.signals_, rounded[np.lexsort(rounded.T)])
        assert_allclose(isa.covariance_, f.motion.T @ f.motion * 40 / 120)

    def test_criterion_takes_candidates_for_subspaces(self, faces):
        isa = Recorder()
        run(faces, 3, isa)
        candidates = random_rotation(2, 9).reshape(3, 3, 9)
        values = isa.criterion_(candidates)
        assert values.shape == (3,)
        assert np.all(values > 0)
        turned = random_rotation(3) @ candidates
        assert_allclose(isa.criterion_(turned), values)

    def test_components_are_made_orthogonal(self, faces):
        result = run(faces, 3, Recorder())
        f = factorise(faces, 3)
        assert_allclose(
            np.trace(result.mode_covariance) * 120,
            np.sum(f.motion**2) * 40,
            rtol=1e-13,
        )

    def test_strategy_that_takes_only_signals(self, faces):
        result = run(faces, 3, Plain())
        f = factorise(faces, 3)
        assert_allclose(result.mode_covariance, f.motion.T @ f.motion / 3, atol=1e-10)

    def test_components_of_the_wrong_shape(self, faces):
        class Fewer(Plain):
            def fit(self, signals, y=None):
                self.components_ = np.eye(signals.shape[1])[:6]
                return self

        with pytest.raises(
            ValueError,
            match=r"isa must give components_ of shape \(9, 9\); got \(6, 9\)",
        ):
            run(faces, 3, Fewer())

    def test_fitted_strategy_is_the_one_given(self, faces):
        isa = FastISA(n_init=1, random_state=0)
        run(faces, 3, isa)
        assert isa.components_.shape == (9, 9)


@pytest.mark.filterwarnings("ignore:FastICA did not converge")
class TestDegenerate:
    """Finite results without warnings, which the test run turns into errors."""

    def check(self, W, K, **options):
        result = run(W, K, **options)
        assert result.basis.shape == (K, W.shape[1], 3)
        assert result.mode_covariance.shape == (3 * K, 3 * K)
        for array in (result.mean_shape, result.basis, result.mode_covariance):
            assert np.isfinite(array).all()
        floor = leading_triplets(W, 3 * K + 3).rest_share
        assert inverse_snr(W, result) >= floor - 1e-12
        return result

    @pytest.mark.parametrize("K", [1, 2, 4])
    @pytest.mark.parametrize("method", BLOCK_RECOVERIES)
    @pytest.mark.parametrize("refinement", ["alternating", None])
    def test_pure_rigid_motion(self, K, method, refinement):
        rng = np.random.default_rng(0)
        B = rng.normal(size=(3, 20))
        W = rng.normal(size=(60, 3)) @ (B - B.mean(axis=1, keepdims=True))
        result = self.check(W, K, block_recovery=method, refinement=refinement)
        assert_array_equal(result.basis, 0)
        assert_array_equal(result.mode_covariance, 0)
        assert inverse_snr(W, result) < 1e-25

    @pytest.mark.parametrize("rank", [1, 2])
    def test_flat_and_straight_objects(self, rank):
        rng = np.random.default_rng(0)
        B = rng.normal(size=(rank, 20))
        W = rng.normal(size=(60, rank)) @ (B - B.mean(axis=1, keepdims=True))
        result = self.check(W, 2)
        assert_array_equal(result.basis, 0)
        assert inverse_snr(W, result) < 1e-25

    @pytest.mark.parametrize("method", BLOCK_RECOVERIES)
    def test_flat_object_that_deforms_in_its_plane(self, method):
        rng = np.random.default_rng(0)
        B, D = rng.normal(size=(2, 20)), rng.laplace(size=(2, 20))
        frames = [
            rng.normal(size=(2, 2)) @ (B + 0.1 * a * D) for a in rng.normal(size=30)
        ]
        W = np.vstack(frames)
        self.check(W - W.mean(axis=1, keepdims=True), 1, block_recovery=method)

    @pytest.mark.parametrize("n_extra", range(1, 7))
    def test_more_basis_shapes_than_the_data_have(self, n_extra):
        rng = np.random.default_rng(n_extra)
        B = rng.laplace(size=(3 + n_extra, 30))
        W = rng.normal(size=(80, 3 + n_extra)) @ (B - B.mean(axis=1, keepdims=True))
        result = self.check(W, 4)
        used = -(-n_extra // 3)
        assert_array_equal(result.basis[used:], 0)
        assert np.all(np.abs(result.basis[:used]).max(axis=(1, 2)) > 0)
        assert_array_equal(result.mode_covariance[3 * used :], 0)

    @pytest.mark.parametrize("K", [1, 2, 4])
    @pytest.mark.parametrize("method", BLOCK_RECOVERIES)
    def test_shark(self, load_data, K, method):
        # One subspace of rank two, whatever K.
        W = measurements(load_data("shark_torresani")["W2d"])
        result = self.check(W, K, block_recovery=method)
        assert_array_equal(result.basis[1:], 0)
        assert_allclose(inverse_snr(W, result), 0.00203, atol=2e-5)

    @pytest.mark.parametrize("K", [1, 3])
    def test_shark_without_refinement(self, load_data, K):
        # D is singular, and so is E = D^+, which must not blow up.
        W = measurements(load_data("shark_torresani")["W2d"])
        result = self.check(W, K, refinement=None)
        assert inverse_snr(W, result) < 0.004
        assert np.linalg.matrix_rank(result.basis[0], tol=1e-6) == 2

    def test_as_few_points_and_frames_as_possible(self):
        rng = np.random.default_rng(0)
        W = rng.normal(size=(10, 7))
        self.check(W - W.mean(axis=1, keepdims=True), 1)
