"""The paper's pipeline as a whole: identities, invariances, degenerate tables."""

import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal
from scenes import measurements, random_rotation, spherical_sources
from sklearn.base import BaseEstimator

from isa_nrsfm import AffineNRSfM, FastISA, PooledFastICA
from isa_nrsfm.datasets import make_nonrigid_tracks

both = pytest.mark.parametrize("refinement", ["alternating", None])


def table_of(W):
    """Return a table with the centred measurement matrix W (2 I, J)."""
    return W.reshape(len(W) // 2, 2, -1).swapaxes(1, 2).reshape(len(W) // 2, -1)


def run(W, K, isa=None, **options):
    """Fit the paper's pipeline, and return the model."""
    options = {"refinement": "alternating", "max_iter": 500, "tol": 1e-12} | options
    options = {"block_recovery": "generalized_eigen", "scale_frames": False} | options
    isa = PooledFastICA(n_init=3, random_state=0) if isa is None else isa
    return AffineNRSfM(K, isa=isa, **options).fit(table_of(W))


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
    options = {"coefficients": "heavy_tailed", "noise": 0.01, "random_state": 0}
    tracks = make_nonrigid_tracks(60, 40, 3, **options).tracks
    return measurements(tracks, scale_frames=False)


def cosines(model, shapes):
    """Return cosines (K, K) of true and found basis shapes, up to one affinity."""
    mean, *basis = shapes.swapaxes(1, 2)
    A = np.linalg.lstsq(model.mean_shape_, mean)[0]
    assert_allclose(model.mean_shape_ @ A, mean, atol=1e-10)
    found, truth = (np.reshape(B, (len(basis), -1)) for B in (model.basis_ @ A, basis))
    sizes = np.outer(np.linalg.norm(truth, axis=1), np.linalg.norm(found, axis=1))
    return np.abs(truth @ found.T) / sizes


class TestIdealData:
    @pytest.mark.parametrize("method", ["irls", "generalized_eigen"])
    @both
    def test_one_basis_shape_is_exact(self, method, refinement):
        # One subspace: nothing is left to statistics.
        W, shapes = ideal_matrix(0, 1, n_points=30)
        model = run(W, 1, block_recovery=method, refinement=refinement)
        assert model.inverse_snr_ < 1e-20
        assert_allclose(cosines(model, shapes), 1, atol=1e-12)

    @pytest.mark.parametrize("strategy", [FastISA, PooledFastICA])
    def test_three_basis_shapes_are_found_up_to_sampling(self, strategy):
        W, shapes = ideal_matrix(0, 3, n_points=1000)
        model = run(W, 3, strategy(n_init=3, random_state=0))
        assert model.inverse_snr_ < 1e-3
        assert cosines(model, shapes).max(axis=1).min() > 0.97


class Recorder(BaseEstimator):
    """A strategy that leaves the signals and remembers what it was told."""

    def fit(self, signals, y=None, *, covariance=None, criterion=None):
        self.signals_, self.covariance_ = signals, covariance
        self.criterion_ = criterion
        # Not quite orthogonal, as fitted components may be.
        n = signals.shape[1]
        self.components_ = random_rotation(0, n) + 1e-6 * random_rotation(1, n)
        return self


class TestStrategies:
    def test_white_signals_and_covariance_over_the_images(self, faces):
        isa = run(faces, 3, Recorder()).isa_
        signals = isa.signals_
        assert_allclose(signals.T @ signals / len(signals), np.eye(9), atol=1e-5)
        assert_allclose(signals.mean(axis=0), 0, atol=1e-5)
        # What three basis shapes explain beyond the rigid shape
        S = np.linalg.svd(faces, compute_uv=False)[3:12]
        energy = S**2 / len(faces) / np.mean(faces**2)
        assert_allclose(isa.covariance_, np.diag(energy), atol=1e-9)
        # Rounded and sorted, so that neither rounding errors nor the order of points
        # can lead the strategy elsewhere.
        assert_array_equal(signals, np.round(signals, 5)[np.lexsort(signals.T)])

    def test_criterion_takes_candidates_for_subspaces(self, faces):
        criterion = run(faces, 3, Recorder()).isa_.criterion_
        candidates = random_rotation(2, 9).reshape(3, 3, 9)
        values = criterion(candidates)
        assert values.shape == (3,)
        assert np.all(values > 0)
        assert_allclose(criterion(random_rotation(3) @ candidates), values)
