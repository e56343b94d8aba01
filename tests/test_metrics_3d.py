"""Errors of 3D shapes up to rotations, in the conventions of the literature."""

import numpy as np
import pytest
from numpy.testing import assert_allclose
from refusals import refused
from scipy.optimize import minimize
from scipy.spatial.transform import Rotation

from isa_nrsfm.metrics import affine_shape_error, mean_shape_error_3d


@pytest.fixture
def pair(rng):
    """True shapes, and others that resemble them."""
    truth = rng.standard_normal((6, 15, 3)) + 4.0
    return truth, truth + 0.3 * rng.standard_normal(truth.shape)


def centred(shapes):
    return shapes - shapes.mean(axis=1, keepdims=True)


class TestDefinitions:
    def test_sequence_by_hand(self):
        # A square in the plane, of standard deviations 1, 1, 0, and one of its corners
        # moved: the centroid follows by a quarter.
        S = np.array([[[1.0, 1, 0], [1, -1, 0], [-1, 1, 0], [-1, -1, 0]]])
        assert mean_shape_error_3d(S, S) < 1e-15
        # Moved along z, which no rotation of this symmetric kind undoes; all corners
        # are a quarter too high or too low after the best one, of angle zero.
        X = S + 0.1 * np.array([[[0.0, 0, 1], [0, 0, -1], [0, 0, -1], [0, 0, 1]]])
        assert mean_shape_error_3d(S, X) == pytest.approx(0.1 / (2 / 3))

    def test_frame_by_hand(self):
        S = np.array([[[1.0, 1, 0], [1, -1, 0], [-1, 1, 0], [-1, -1, 0]]])
        X = S + 0.1 * np.array([[[0.0, 0, 1], [0, 0, -1], [0, 0, -1], [0, 0, 1]]])
        found = mean_shape_error_3d(S, X, convention="frame", scale=False)
        assert found == pytest.approx(0.2 / np.sqrt(8))
        # The best scale c = |S|^2 / |X|^2 leaves the sine of the angle to the truth.
        found = mean_shape_error_3d(S, X, convention="frame")
        assert found == pytest.approx(np.sqrt(1 - 8 / 8.04))

    def test_as_written_in_the_docstring(self, pair):
        truth, shapes = map(centred, pair)
        turn, _ = self.procrustes(truth.reshape(-1, 3), shapes.reshape(-1, 3))
        pairs = zip(np.concatenate(truth), np.concatenate(shapes), strict=True)
        distance = [np.linalg.norm(s - turn @ x) for s, x in pairs]
        sigma = np.mean([S.std(axis=0) for S in truth])
        expected = np.mean(distance) / sigma
        assert mean_shape_error_3d(*pair) == pytest.approx(expected, rel=1e-9)

        expected = []
        for S, X in zip(truth, shapes, strict=True):
            turn, c = self.procrustes(S, X)
            expected.append(np.linalg.norm(S - c * X @ turn.T) / np.linalg.norm(S))
        found = mean_shape_error_3d(*pair, convention="frame")
        assert found == pytest.approx(np.mean(expected), rel=1e-9)

    def test_camera_by_hand(self):
        flat = np.array([[1.0, 1, 0], [1, -1, 0], [-1, 1, 0], [-1, -1, 0]])
        twist = np.array([[0.0, 0, 1], [0, 0, -1], [0, 0, -1], [0, 0, 1]])
        S = np.stack([flat, flat + twist])
        X = S + 0.1 * twist
        found = mean_shape_error_3d(S, X, convention="camera")
        assert found == pytest.approx(np.mean([0.2 / np.sqrt(8), 0.2 / np.sqrt(12)]))
        # One mirror image for all frames: the first frame alone would not choose it.
        mirrored = mean_shape_error_3d(S, X * [1, 1, -1], convention="camera")
        assert mirrored == pytest.approx(found)
        scaled = mean_shape_error_3d(S, 5 * X, convention="camera", scale=True)
        c = np.vdot(S, X) / np.vdot(X, X)
        rest = np.linalg.norm(S - c * X, axis=(1, 2)) / np.sqrt([8, 12])
        assert scaled == pytest.approx(rest.mean())

    @staticmethod
    def procrustes(S, X):
        """Return the best rotation and scale, by numerical minimisation."""

        def cost(x):
            R = Rotation.from_rotvec(x[:3]).as_matrix()
            return np.sum((S - x[3] * X @ R.T) ** 2)

        with_scale = minimize(cost, [0, 0, 0, 1.0], tol=1e-14).x
        without = minimize(lambda x: cost([*x, 1.0]), np.zeros(3), tol=1e-14).x
        assert_allclose(with_scale[:3], without, atol=1e-5)
        return Rotation.from_rotvec(without).as_matrix(), with_scale[3]


class TestDegenerateInput:
    @pytest.mark.parametrize("nothing", [0.0, 0.1])
    def test_shapes_of_one_point(self, pair, nothing):
        truth, _ = pair
        shapes = np.full_like(truth, nothing)
        found = mean_shape_error_3d(truth, shapes, convention="frame")
        assert found == pytest.approx(1)
        distance = np.linalg.norm(centred(truth), axis=2).mean()
        expected = distance / truth.std(axis=1).mean()
        assert mean_shape_error_3d(truth, shapes) == pytest.approx(expected)
        assert 1.3 < expected < 1.8

    @pytest.mark.parametrize("measure", [mean_shape_error_3d, affine_shape_error])
    @pytest.mark.parametrize(
        ("S", "X", "message"),
        [
            (np.ones((2, 4, 2)), np.ones((2, 4, 2)), r"S must be .*got \(2, 4, 2\)"),
            (np.ones((4, 3)), np.ones((4, 3)), r"S must be of .* got \(4, 3\)"),
            (np.ones((0, 5, 3)), np.ones((0, 5, 3)), r"got \(0, 5, 3\)"),
            (np.ones((1, 3, 3)), np.ones((1, 4, 3)), r"S and X .*\(1, 3, 3\) and \(1,"),
            (np.eye(3)[None], np.full((1, 3, 3), np.nan), "X must be finite; 9 entr"),
            (np.full((1, 3, 3), np.inf), np.eye(3)[None], "S must be finite; 9 entr"),
            (
                np.full((2, 3, 3), 0.1),
                np.ones((2, 3, 3)),
                r"of S whose.*: 2 of 2 \(first: 0",
            ),
        ],
    )
    def test_refusals(self, measure, S, X, message):
        refused(message, measure, S, X)

    def test_other_conventions(self, pair):
        with pytest.raises(ValueError, match=r"one of .* got 'mpjpe'"):
            mean_shape_error_3d(*pair, convention="mpjpe")


def test_of_a_published_estimate(load_data):
    # The trajectory-space estimate of Akhter et al. that comes with their data.
    data = load_data("akhter_drink")
    error = mean_shape_error_3d(data["S3d"], data["S3d_akhter_estimate"])
    assert error == pytest.approx(0.0249, abs=1e-4)
