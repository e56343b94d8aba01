"""The block matrix method: shapes of least nuclear norm."""

import numpy as np
import pytest
from baseline_scenes import camera_frame, exact_table, mocap_shapes, rotations
from layers import slow_after
from numpy.testing import assert_allclose
from scipy.spatial.transform import Rotation
from sklearn.exceptions import ConvergenceWarning

from isa_nrsfm.baselines import BlockMatrixNRSfM, PseudoInverseNRSfM
from isa_nrsfm.baselines._block_matrix import nuclear_norm_shapes, shrink
from isa_nrsfm.baselines._pseudo_inverse import least_norm_shapes
from isa_nrsfm.metrics import mean_shape_error_3d

PRICE = 0.5
both_iterations = pytest.mark.parametrize("accelerated", [True, False])


@pytest.fixture
def cameras():
    return Rotation.random(20, np.random.default_rng(0)).as_matrix()[:, :2]


@pytest.fixture
def W(cameras):
    """Images of shapes that are mixtures of two, with noise."""
    rng = np.random.default_rng(0)
    shapes = np.tensordot(rng.normal(size=(20, 2)), rng.normal(size=(2, 11, 3)), 1)
    W = cameras @ shapes.swapaxes(1, 2) + 0.05 * rng.normal(size=(20, 2, 11))
    return W.reshape(40, -1)


def objective(W, cameras, shapes, price=PRICE):
    """Return the price of the nuclear norm plus half the squared error."""
    norm = np.linalg.svd(shapes.reshape(len(shapes), -1), compute_uv=False).sum()
    error = W.reshape(len(cameras), 2, -1) - cameras @ shapes.swapaxes(1, 2)
    return price * norm + np.sum(error**2) / 2


def solve(W, cameras, price=PRICE, accelerated=True, max_iter=20_000, tol=1e-11):
    start = least_norm_shapes(W, cameras)
    return nuclear_norm_shapes(
        W,
        cameras,
        price,
        start,
        accelerated=accelerated,
        max_iter=max_iter,
        tol=tol,
    )


class TestShrink:
    # More frames than coordinates, and fewer.
    @pytest.mark.parametrize("n_frames", [30, 10])
    def test_takes_off_singular_values(self, n_frames):
        shapes = np.random.default_rng(0).normal(size=(n_frames, 6, 3))
        rows = shapes.reshape(n_frames, -1)
        U, S, Vt = np.linalg.svd(rows, full_matrices=False)
        amount = S[4]
        expected = (U * np.maximum(S - amount, 0)) @ Vt
        found = shrink(shapes, amount).reshape(n_frames, -1)
        assert_allclose(found, expected, atol=1e-12)
        assert np.linalg.matrix_rank(found) == 4

    def test_of_everything_leaves_nothing(self):
        shapes = np.random.default_rng(0).normal(size=(5, 6, 3))
        assert not shrink(shapes, 1e3).any()
        assert not shrink(0 * shapes, 1.0).any()

    def test_of_nothing_leaves_everything(self):
        shapes = np.random.default_rng(0).normal(size=(5, 6, 3))
        assert_allclose(shrink(shapes, 0.0), shapes, atol=1e-13)


class TestNuclearNormShapes:
    @both_iterations
    @pytest.mark.parametrize("price", [0.05, 2.0])
    def test_are_optimal(self, W, cameras, accelerated, price):
        shapes, _, converged = solve(W, cameras, price, accelerated)
        assert converged
        # Minus the slope of the error is mu times a subgradient of the nuclear norm:
        # U V^T plus something orthogonal to U and V with a spectral norm of at most 1.
        error = W.reshape(20, 2, -1) - cameras @ shapes.swapaxes(1, 2)
        G = (error.swapaxes(1, 2) @ cameras).reshape(20, -1) / price
        U, S, Vt = np.linalg.svd(shapes.reshape(20, -1), full_matrices=False)
        rank = np.sum(S > 1e-6 * S[0])
        assert 0 < rank < 20
        U, Vt = U[:, :rank], Vt[:rank]
        assert_allclose(U.T @ G, Vt, atol=1e-6)
        assert_allclose(G @ Vt.T, U, atol=1e-6)
        rest = G - U @ Vt
        assert np.linalg.norm(rest, 2) < 1 + 1e-6

    def test_objective_falls(self, W, cameras):
        values = [objective(W, cameras, least_norm_shapes(W, cameras))]
        for n in range(1, 30):
            shapes = solve(W, cameras, accelerated=False, max_iter=n, tol=0).shapes
            values.append(objective(W, cameras, shapes))
        assert (np.diff(values) < 0).all()

    def test_both_iterations_end_in_the_same_place(self, W, cameras):
        fast = solve(W, cameras, accelerated=True)
        published = solve(W, cameras, accelerated=False)
        assert_allclose(fast.shapes, published.shapes, atol=1e-6)
        assert fast.n_iter < published.n_iter / 4
        least = objective(W, cameras, fast.shapes)
        for n in (1, 3, 10):
            shapes = solve(W, cameras, max_iter=n, tol=0).shapes
            assert objective(W, cameras, shapes) > least

    def test_too_high_a_price_leaves_nothing(self, W, cameras):
        start = least_norm_shapes(W, cameras)
        largest = np.linalg.norm(start.reshape(20, -1), 2)
        assert not solve(W, cameras, 1.01 * largest).shapes.any()
        assert solve(W, cameras, 0.99 * largest).shapes.any()

    def test_steps_are_counted(self, W, cameras):
        assert solve(W, cameras, max_iter=3, tol=0)[1:] == (3, False)
        found = solve(W, cameras, tol=1e-3)
        assert found.converged
        again = solve(W, cameras, max_iter=found.n_iter, tol=1e-3)
        assert again[1:] == found[1:]
        assert not solve(W, cameras, max_iter=found.n_iter - 1, tol=1e-3).converged

    def test_turning_space_and_signs_of_frames(self, W, cameras):
        shapes = solve(W, cameras, max_iter=50).shapes
        turn = Rotation.random(None, np.random.default_rng(1)).as_matrix()
        turned = solve(W, cameras @ turn.T, max_iter=50).shapes
        assert_allclose(turned, shapes @ turn.T, atol=1e-10)
        signs = np.random.default_rng(0).choice([-1.0, 1.0], (20, 1, 1))
        flipped = solve(W, signs * cameras, max_iter=50).shapes
        assert_allclose(flipped, signs * shapes, atol=1e-10)


class TestEstimator:
    def test_exact_shapes_are_found(self):
        truth = exact_table(0, n_frames=150)
        model = BlockMatrixNRSfM(2, tol=1e-6).fit(truth.data)
        shapes = truth.shapes @ rotations(truth.motion).swapaxes(1, 2)
        assert model.inverse_snr_ < 1e-6
        assert mean_shape_error_3d(shapes, camera_frame(model)) < 2e-3
        # The method finds the shapes without any coordinate system of the cameras, too.
        assert mean_shape_error_3d(truth.shapes, model.shapes_) < 2e-3

    def test_better_than_the_pseudo_inverse(self):
        truth = exact_table(1, noise=0.01)
        shapes = truth.shapes @ rotations(truth.motion).swapaxes(1, 2)
        errors = [
            mean_shape_error_3d(shapes, camera_frame(method(2).fit(truth.data)))
            for method in (BlockMatrixNRSfM, PseudoInverseNRSfM)
        ]
        assert errors[0] < 0.2 * errors[1]

    @both_iterations
    def test_too_few_steps(self, accelerated):
        model = BlockMatrixNRSfM(2, accelerated=accelerated, max_iter=2)
        with pytest.warns(ConvergenceWarning, match="converge in max_iter=2 steps"):
            model.fit(exact_table(0).data)
        assert 18 <= model.n_iter_ <= 36

    def test_default_tolerances_end_in_nearly_the_same_place(self):
        X = exact_table(0, noise=0.02).data
        fast = BlockMatrixNRSfM(2).fit(X)
        published = BlockMatrixNRSfM(2, accelerated=False).fit(X)
        assert fast.n_iter_ < published.n_iter_ / 4
        rest = np.linalg.norm(fast.shapes_ - published.shapes_)
        assert rest < 0.02 * np.linalg.norm(published.shapes_)


def test_shark(load_data):
    data = load_data("shark_torresani")
    model = BlockMatrixNRSfM(1).fit(data["W2d"].reshape(240, -1))
    assert 100 * model.inverse_snr_ == pytest.approx(0.258, rel=0.02)
    error = mean_shape_error_3d(data["S3d"], camera_frame(model))
    assert error == pytest.approx(0.244, rel=0.02)


@pytest.mark.parametrize(
    ("name", "n_components", "inverse_snr", "error"),
    [
        ("akhter_yoga", 9, 0.00532, 0.0342),
        *slow_after(
            0,
            [
                ("akhter_drink", 11, 0.00132, 0.0227),
                ("akhter_pickup", 11, 0.00409, 0.0485),
            ],
            together=True,
        ),
    ],
)
def test_motion_capture(load_data, name, n_components, inverse_snr, error):
    data = load_data(name)
    tracks = data["W2d"]
    model = BlockMatrixNRSfM(n_components).fit(tracks.reshape(len(tracks), -1))
    assert 100 * model.inverse_snr_ < 1.05 * inverse_snr
    found = mean_shape_error_3d(mocap_shapes(data), camera_frame(model))
    assert found < 1.02 * error
