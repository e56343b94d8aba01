"""Orthographic cameras in the motion factor of a table."""

import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal
from refusals import refused
from scenes import measurements
from scipy.optimize import approx_fprime
from scipy.spatial.transform import Rotation

from isa_nrsfm.calibration import orthonormal_cameras
from isa_nrsfm.datasets import make_nonrigid_tracks

N_COMPONENTS = 2


def scene(seed, noise=0.0, n_frames=60):
    """Return the left singular vectors times singular values, and true cameras."""
    options = {"camera": "orthographic", "noise": noise, "random_state": seed}
    truth = make_nonrigid_tracks(n_frames, 40, N_COMPONENTS, **options)
    W = measurements(truth.tracks, scale_frames=False)
    U, S, _ = np.linalg.svd(W, full_matrices=False)
    n = 3 * N_COMPONENTS + 3
    return U[:, :n] * S[:n], truth.motion


def gram(cameras):
    """Return what does not depend on the orientation of space."""
    rows = cameras.reshape(-1, 3)
    return rows @ rows.T


def cost_of(cameras):
    return np.mean([np.sum((R @ R.T - np.eye(2)) ** 2) for R in cameras])


class TestExactCameras:
    @pytest.mark.parametrize("seed", range(4))
    def test_are_found(self, seed):
        P, cameras = scene(seed)
        found = orthonormal_cameras(P)
        assert found.cost < 1e-17
        rows = found.cameras @ found.cameras.transpose(0, 2, 1)
        assert_allclose(rows, np.broadcast_to(np.eye(2), rows.shape), atol=1e-8)
        # The cost is of fourth order in some directions.
        assert_allclose(gram(found.cameras), gram(cameras), atol=2e-4)

    def test_of_a_rigid_object_are_in_three_columns(self):
        cameras = Rotation.random(20, np.random.default_rng(0)).as_matrix()[:, :2]
        mixing = np.random.default_rng(0).normal(size=(3, 3))
        found = orthonormal_cameras(cameras.reshape(-1, 3) @ mixing)
        assert_allclose(gram(found.cameras), gram(cameras), atol=1e-8)


class TestResult:
    def test_identities(self):
        P, _ = scene(0, noise=0.02)
        found = orthonormal_cameras(P)
        assert_allclose(found.cameras.reshape(-1, 3), P @ found.mixing, atol=1e-10)
        assert found.cost == pytest.approx(cost_of(found.cameras))

    @pytest.mark.parametrize("noise_variance", [0.0, 1e-2])
    def test_is_a_minimum(self, noise_variance, rng):
        P, _ = scene(0, noise=0.02)
        found = orthonormal_cameras(P, noise_variance)

        def cost(Q):
            price = 4 * noise_variance * np.sum(Q**2)
            return cost_of((P @ Q.reshape(-1, 3)).reshape(-1, 2, 3)) + price

        Q = found.mixing.ravel()
        least = cost(Q)
        assert np.abs(approx_fprime(Q, cost, 1e-7)).max() < 1e-5 * np.abs(P).max()
        sizes = np.abs(Q).max() * np.repeat([1e-3, 1e-2, 1e-1], 20)
        steps = (size * rng.normal(size=Q.shape) for size in sizes)
        assert all(cost(Q + step) > least for step in steps)

    def test_more_columns_never_cost_more(self):
        P, _ = scene(0, noise=0.05)
        costs = [orthonormal_cameras(P[:, :n]).cost for n in range(3, P.shape[1] + 1)]
        assert (np.diff(costs) <= 1e-12).all()
        assert costs[-1] < 0.1 * costs[0]

    def test_scales_and_triangular_mixtures_of_columns_do_not_matter(self, rng):
        P, _ = scene(1, noise=0.01)
        expected = orthonormal_cameras(P)
        upper = np.triu(rng.normal(size=(P.shape[1],) * 2), 1) + np.eye(P.shape[1])
        for mixing in (upper, np.diag(10.0 ** rng.integers(-9, 9, P.shape[1]))):
            found = orthonormal_cameras(P @ mixing)
            assert_allclose(gram(found.cameras), gram(expected.cameras), atol=1e-6)

    def test_local_minimum_is_left(self, load_data):
        # From the first three columns alone the cost ends at 2e-4 and above.
        W = measurements(load_data("akhter_yoga")["W2d"], scale_frames=False)
        U = np.linalg.svd(W, full_matrices=False)[0]
        assert orthonormal_cameras(U[:, :6]).cost < 0.005
        assert orthonormal_cameras(U[:, :30]).cost < 3e-6


class TestNoise:
    def test_price_is_what_noise_costs(self, rng):
        # As the minimum above has it.
        cameras = Rotation.random(3000, np.random.default_rng(0)).as_matrix()[:, :2]
        Q = rng.normal(size=(5, 3))
        P = cameras.reshape(-1, 3) @ np.linalg.pinv(Q)
        deviation = 1e-3
        noisy = (P + deviation * rng.normal(size=P.shape) for _ in range(20))
        costs = [cost_of((each @ Q).reshape(cameras.shape)) for each in noisy]
        expected = 4 * deviation**2 * np.sum(Q**2)
        assert np.mean(costs) == pytest.approx(expected, rel=0.03)

    def test_more_of_it_means_smaller_mixtures(self):
        P, _ = scene(0, noise=0.02)
        found = [orthonormal_cameras(P, v) for v in (0.0, 1e-3, 1e-1, 10.0)]
        assert (np.diff([np.linalg.norm(f.mixing) for f in found]) < 0).all()
        assert (np.diff([f.cost for f in found]) > 0).all()


class TestColumns:
    def test_dependent_ones_are_left_out(self):
        P, _ = scene(0, noise=0.02)
        expected = orthonormal_cameras(P)
        more = np.insert(P, [2, 5], np.stack([P[:, 0], 0 * P[:, 0]], axis=1), axis=1)
        found = orthonormal_cameras(more)
        assert_array_equal(found.mixing[[2, 6]], 0)
        assert_allclose(found.cameras, expected.cameras, atol=1e-6)

    @pytest.mark.parametrize(
        ("columns", "message"),
        [
            (np.eye(10, 2)[:, [0, 1, 0, 1]], "three linearly independent columns; 2"),
            (np.ones((5, 3)), "two rows per frame, an even number; got 5"),
            (np.full((6, 3), np.nan), "motion contains NaN"),
        ],
    )
    def test_are_refused(self, columns, message):
        refused(message, orthonormal_cameras, columns)

    def test_variance_is_not_negative(self):
        refused("must not be negative; got -1", orthonormal_cameras, scene(0)[0], -1.0)
