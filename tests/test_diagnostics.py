"""What a fit says of itself: reliabilities and information, by their definitions."""

from copy import deepcopy

import numpy as np
import pytest
from numpy.testing import assert_allclose
from scipy.linalg import eigvals

from isa_nrsfm import AffineNRSfM
from isa_nrsfm._diagnostics import reliabilities, weak_information
from isa_nrsfm.datasets import make_face_tracks, make_nonrigid_tracks


def random_coefficients(seed, n_frames=50, n_components=3):
    """Return coefficients and the mean of their covariances."""
    rng = np.random.default_rng(seed)
    alpha = rng.normal(size=(n_frames, n_components)) * [2.0, 1.0, 0.3]
    factor = rng.normal(size=(n_components, n_components))
    return alpha, 0.2 * factor @ factor.T


def of_known_shapes(alpha, covariance):
    """Return the reliabilities for shapes that do not follow any noise."""
    return reliabilities(alpha, covariance, np.zeros(covariance.shape), 1.0)


class TestReliabilities:
    @pytest.mark.parametrize("seed", range(3))
    def test_are_shares_of_the_variance(self, seed):
        alpha, covariance = random_coefficients(seed)
        moment = sum(np.outer(a, a) for a in alpha) / len(alpha)
        expected = np.sort(eigvals(moment, moment + covariance).real)[::-1]
        assert_allclose(of_known_shapes(alpha, covariance), expected, rtol=1e-9)

    def test_more_frames_alike_change_nothing(self):
        alpha, covariance = random_coefficients(0)
        expected = of_known_shapes(alpha, covariance)
        found = of_known_shapes(np.tile(alpha, (7, 1)), covariance)
        assert_allclose(found, expected, rtol=1e-9)

    def test_known_coefficients_are_reliable(self):
        alpha, _ = random_coefficients(0)
        assert_allclose(of_known_shapes(alpha, np.zeros((3, 3))), 1.0, rtol=1e-9)

    def test_directions_without_variance_have_none(self):
        alpha, covariance = random_coefficients(0)
        alpha[:, 1] = 0.0
        covariance[1] = covariance[:, 1] = 0.0
        found = of_known_shapes(alpha, covariance)
        assert found[-1] == 0
        kept = [0, 2]
        expected = of_known_shapes(alpha[:, kept], covariance[np.ix_(kept, kept)])
        assert_allclose(found[:2], expected, rtol=1e-9)

    @pytest.mark.parametrize("gamma", [0.2, 2.0, 20.0])
    def test_are_correlations_with_the_truth(self, gamma):
        # A random matrix of rank one and noise: its left singular vector.
        rng = np.random.default_rng(0)
        n_frames, signal = 300, 10 * np.sqrt(gamma)
        true = rng.normal(size=n_frames)
        noise = rng.normal(size=(n_frames, int(gamma * n_frames)))
        noise[:, 0] += np.sqrt(signal) * true
        left, values, _ = np.linalg.svd(noise, full_matrices=False)
        y = values[0] ** 2 / n_frames
        alpha = np.sqrt(n_frames * (1 - 1 / y)) * left[:, :1]
        moments = np.full((1, 1), gamma / y * (1 - 1 / y) * n_frames)
        found = reliabilities(alpha, np.full((1, 1), 1 / y), moments, float(n_frames))
        correlation = np.corrcoef(true, left[:, 0])[0, 1] ** 2
        # The margin of chance makes it a little smaller.
        assert correlation - 0.05 < found[0] < correlation + 0.02

    @pytest.mark.parametrize(
        ("n_frames", "n_points", "n_components"),
        [(100, 68, 4), (300, 68, 1), (60, 478, 2)],
    )
    @pytest.mark.parametrize("loss", ["linear", "cauchy"])
    def test_noise_of_rigid_objects_has_none(
        self, n_frames, n_points, n_components, loss
    ):
        rigid = make_nonrigid_tracks(
            n_frames, n_points, 0, noise=0.01, random_state=n_frames
        )
        model = AffineNRSfM(n_components, loss=loss, random_state=0).fit(rigid.data)
        assert model.reliability_.max() < 0.1
        with pytest.warns(UserWarning, match="no deformation was found") as told:
            model.diagnostics()
        assert ('loss="cauchy"' in str(told[0].message)) == (loss == "linear")

    @pytest.mark.parametrize("n_points", [68, 400])
    def test_true_shapes_keep_theirs(self, n_points):
        truth = make_nonrigid_tracks(
            100, n_points, 2, noise=0.02, amplitude=0.1, random_state=0
        )
        model = AffineNRSfM(4, random_state=0).fit(truth.data)
        assert (model.reliability_[:2] > 0.98).all()
        assert (model.reliability_[2:] == 0).all()
        with pytest.warns(UserWarning, match="take at most n_components=2"):
            model.diagnostics()


class TestWeakInformation:
    def test_is_what_cameras_and_coefficients_do_not_explain(self):
        # By differences: images are linear in each of the unknowns.
        rng = np.random.default_rng(0)
        n_frames, n_points, n_components = 5, 9, 2
        shapes = rng.normal(size=(n_components + 1, n_points, 3))
        shapes -= shapes.mean(axis=1, keepdims=True)
        motion = rng.normal(size=(n_frames, 2, 3))
        alpha = rng.normal(size=(n_frames, n_components))

        def images(M, t, a, V):
            basis = shapes[1:] + np.stack([shapes[0] @ each.T for each in V])
            return ((shapes[0] + np.tensordot(a, basis, 1)) @ M.T + t).ravel()

        def changes(f, size):
            return np.stack([f(e) - f(np.zeros(size)) for e in np.eye(size)], axis=1)

        still = np.zeros((n_components, 3, 3))
        expected = np.zeros((9 * n_components, 9 * n_components))
        for M, a in zip(motion, alpha, strict=True):
            free = np.hstack(
                [
                    changes(
                        lambda x, M=M, a=a: images(
                            M + x[:6].reshape(2, 3), x[6:8], a, still
                        ),
                        8,
                    ),
                    changes(
                        lambda x, M=M, a=a: images(M, 0.0, a + x, still),
                        n_components,
                    ),
                ]
            )
            strain = changes(
                lambda x, M=M, a=a: images(M, 0.0, a, x.reshape(-1, 3, 3)),
                9 * n_components,
            )
            rest = strain - free @ np.linalg.lstsq(free, strain)[0]
            expected += rest.T @ rest
        found = weak_information(shapes[0], shapes[1:], motion, alpha)
        assert_allclose(found, expected, atol=1e-10 * np.abs(expected).max())


@pytest.fixture(scope="module")
def model():
    """Return a model of faces."""
    faces = make_face_tracks(n_frames=60, n_components=2, random_state=0)
    return AffineNRSfM(2, camera="weak_perspective", random_state=0).fit(faces.data)


class TestFigures:
    def test_amplitude_is_that_of_the_deformations(self, model):
        deformations = np.tensordot(model.alpha_, model.basis_, 1)
        mean_square = np.mean(np.sum(deformations**2, axis=(1, 2)))
        expected = np.sqrt(mean_square / np.sum(model.mean_shape_**2))
        found = model.diagnostics()
        assert_allclose(found.deformation_amplitude, expected, rtol=1e-9)

    def test_cameras_are_those_of_all_frames(self, model):
        sizes = model.diagnostics().camera_singular_values
        assert sizes.shape == (3,)
        assert np.all(np.diff(sizes) <= 0)

    def test_covariance_of_the_mirror_image(self, model):
        depth = np.tile([1.0, 1.0, -1.0], 2)
        expected = model.mode_covariance_ * np.outer(depth, depth)
        mirrored = deepcopy(model).mirror().mode_covariance_
        assert np.abs(np.diff([expected, model.mode_covariance_], axis=0)).max() > 0
        assert_allclose(mirrored, expected, rtol=0, atol=1e-15)
