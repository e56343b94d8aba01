"""The parts of fits of frames, by their names, and frames as dense algebra."""

from typing import NamedTuple

import numpy as np
from numpy.testing import assert_allclose
from numpy.typing import NDArray

from isa_nrsfm._frames.camera_models import CAMERAS, full_rotations
from isa_nrsfm._frames.search import FrameSearch
from isa_nrsfm._linalg import centred

# What a fitted model has of its shapes, and of each frame.
OF_SHAPES = ("mean_shape_", "basis_", "singular_values_", "mode_covariance_")
OF_FRAMES = ("motion_", "translation_", "alpha_", "alpha_std_")


class Regression(NamedTuple):
    """A frame in a known camera, ``y ~ x_0 + X a``, as dense linear algebra.

    Points and shapes (n, 3, n_seen) are centred, times the roots of their weights.
    """

    y: NDArray
    first: NDArray
    X: NDArray
    shapes: NDArray

    @classmethod
    def of(cls, scene, i, M=None, shapes=None):
        M, points = scene.motion[i] if M is None else M, scene.tracks[i]
        w = np.isfinite(points[:, 0]) * 1.0
        w *= 1.0 if scene.weights is None else scene.weights[i]
        seen = w > 0
        w, points = w[seen], points[seen]
        points = points - w @ points / w.sum()
        shapes = (scene.shapes if shapes is None else shapes)[..., seen]
        shapes = np.sqrt(w) * (shapes - (shapes @ w / w.sum())[..., None])
        columns = (M @ shapes).reshape(len(shapes), -1)
        y = (np.sqrt(w) * points.T).ravel()
        return cls(y, columns[0], columns[1:].T, shapes)

    def precision(self, noise):
        return self.X.T @ self.X + noise * np.eye(self.X.shape[1])

    def mean(self, noise):
        """Return the posterior mean of the coefficients."""
        right = self.X.T @ (self.y - self.first)
        return np.linalg.solve(self.precision(noise), right)

    def square(self, alpha, noise):
        rest = self.y - self.first - self.X @ alpha
        return rest @ rest + noise * alpha @ alpha

    def value(self, noise):
        """Return F: minus two log marginal likelihoods, up to a constant."""
        _, determinant = np.linalg.slogdet(self.precision(noise) / noise)
        return self.square(self.mean(noise), noise) / noise + determinant


def camera_and_alpha(fits):
    """Return motion, translation and coefficients."""
    return fits.motion, fits.translation, fits.alpha


def numbers_of(fits):
    """Return all that is a number for each frame."""
    return (*camera_and_alpha(fits), fits.covariance, fits.objective)


def fit_posterior(tracks, shapes, noise, camera="affine", **given):
    """Return the fit of frames by a new search."""
    return FrameSearch(shapes, CAMERAS[camera]).fit_rows(tracks.mT, noise, **given)


def depth_deviations(frames, *args):
    """Return the standard deviations (n, J) of depths."""
    return np.sqrt(frames.point_covariances(*args)[..., 2, 2])


def depth_errors(model, X, depths):
    """Return centred depths less the true ones, of the better mirror image."""
    rotations, scales = full_rotations(model.decompose(X).motion)
    z = np.vecdot(model.reconstruct(X), rotations[:, 2][:, None])
    z, depths = centred(scales[:, None] * z), centred(depths)
    return np.sign(np.sum(z * depths)) * z - depths


def assert_same_model(got, expected):
    """Compare models of the same table that was read in different ways."""
    single = {"inverse_snr_": 1e-8, "noise_variance_": 1e-8, "rank_floor_": 1e-6}
    for name in (*OF_SHAPES, *OF_FRAMES, *single):
        found, value = (np.asarray(getattr(each, name)) for each in (got, expected))
        atol = single.get(name, 1e-8) * np.abs(value).max()
        assert_allclose(found, value, rtol=0, atol=atol, err_msg=name)


def assert_same_fits(got, expected, atol):
    """Compare fits of frames."""
    for name in ("motion", "translation", "alpha", "covariance"):
        assert_allclose(getattr(got, name), getattr(expected, name), atol=atol)
    assert_allclose(got.objective, expected.objective, rtol=1e-7, atol=1e-12)


def assert_calibrated(motion, camera, atol=1e-12):
    """Check that cameras are scaled rotations, orthographic ones of scale one."""
    gram = motion @ motion.swapaxes(1, 2)
    scale = np.trace(gram, axis1=1, axis2=2)[:, None, None] / 2
    assert_allclose(gram / scale, np.broadcast_to(np.eye(2), gram.shape), atol=atol)
    if camera == "orthographic":
        assert_allclose(scale, 1.0, rtol=atol)
