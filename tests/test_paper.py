"""The paper's pipeline as a whole: identities, invariances, degenerate tables."""

from typing import NamedTuple

import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal
from scenes import random_rotation, spherical_sources
from sklearn.base import BaseEstimator

from isa_nrsfm import FastISA, PooledFastICA
from isa_nrsfm._frames.camera_models import rigid_cameras
from isa_nrsfm._paper.factors import factorise, leading_triplets
from isa_nrsfm._paper.pipeline import run_paper_pipeline
from isa_nrsfm._parameters.choices import BLOCK_RECOVERIES

OPTIONS = {"block_recovery": "generalized_eigen", "max_iter": 500, "tol": 1e-12}


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
    found = run_paper_pipeline(factorise(W, K), K, isa, report=report, **options)
    shapes, *others = found
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
    signals = spherical_sources(seed, n_points, K)
    rows = np.hstack([rng.normal(size=(n_points, 3)), signals])
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
        values, _, rest = leading_triplets(W, 6)
        assert rest < 1e-25 * np.sum(values**2)

        # The same shapes, up to one affinity and the scale of the basis shape.
        A = np.linalg.lstsq(result.mean_shape, shapes[0].T)[0]
        assert_allclose(result.mean_shape @ A, shapes[0].T, atol=1e-10)
        B, truth = (result.basis[0] @ A).ravel(), shapes[1].T.ravel()
        cosine = B @ truth / np.linalg.norm(B) / np.linalg.norm(truth)
        assert_allclose(abs(cosine), 1, atol=1e-12)

    @pytest.mark.parametrize(
        "isa",
        [FastISA(n_init=3, random_state=0), PooledFastICA(n_init=3, random_state=0)],
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

    def test_blocks_of_the_mode_covariance_belong_to_the_basis(self, faces):
        result = run(faces, 3)
        f = factorise(faces, 3)
        for k, B in enumerate(result.basis):
            # An orthonormal basis of the space of the shape's three coordinates.
            Q = np.linalg.svd(B, full_matrices=False)[0]
            motion = f.motion @ f.signals @ Q / np.sqrt(40)
            block = result.mode_covariance[3 * k : 3 * k + 3, 3 * k : 3 * k + 3]
            expected = np.linalg.eigvalsh(motion.T @ motion * 40 / 120)
            assert_allclose(expected, np.linalg.eigvalsh(block), rtol=1e-6)

    def test_refinement_in_few_steps(self, faces):
        result = run(faces, 3, max_iter=1, tol=0.0)
        assert not result.converged
        assert result.n_iter == 1

    def test_stages_are_reported_in_order(self, faces):
        stages = []
        run(faces, 2, report=stages.append)
        assert stages == ["independent subspaces", "block structure and refinement"]


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

    def test_strategy_that_takes_only_signals(self, faces):
        result = run(faces, 3, Plain())
        f = factorise(faces, 3)
        assert_allclose(result.mode_covariance, f.motion.T @ f.motion / 3, atol=1e-10)
