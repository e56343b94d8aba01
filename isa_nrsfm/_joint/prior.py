"""A fitted model as the prior of the shapes of another table.

The public shapes, mean shape and basis, are N times the shapes B (K + 1, 3, J) of a
fit. Those of the table differ by ``E = N (B - A)`` from those of the model, and -2 log
L has the additional term ::

    sum_k ||E_k||^2 / v_k,

with v_0 = tau^2 for the mean shape and v_k = rho^2 for the basis shapes. The widths tau
and rho follow from the table (MacKay, "Bayesian interpolation", 1992): with the
posterior covariance of E_k, the coefficients' moments held fixed, ::

    g_k = 1 - tr(cov E_k) / (3J v_k),   tau^2 <- ||E_0||^2 / (3J g_0),
                                        rho^2 <- sum_k ||E_k||^2 / (3J sum_k g_k).

Rotation, mirror image, scale and mixing of the shapes are those of the model.
"""

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from isa_nrsfm._frames.camera_models import stacked_motion
from isa_nrsfm._frames.models import FrameMap, PosteriorFrames
from isa_nrsfm._linalg.rounding import OF_DISTANCES
from isa_nrsfm._linalg.small_matrices import centred

# All of these: docs/benchmarks/README.md, "Thresholds".
# Widths of the first fit, in sizes of frames, and rounds that estimate them.
FIRST_WIDTHS, ROUNDS = (0.05, 0.01), 3
# Floor of the noise variance, as a share of the mean square; share of the tolerance.
LEAST_NOISE, TOL_SHARE = 5e-4, 0.1


class ShapePrior(NamedTuple):
    """A normal prior of shapes.

    shapes (K + 1, 3, J): A. gauge: maps frames to the public shapes. fixed: whether the
    basis is that of the model, with rho = 0. depth_error: variance of the depths of
    each public shape of the model. widths: tau and rho. n_determined: number of
    coordinates of the shapes that the table determines.
    """

    shapes: NDArray
    gauge: FrameMap
    fixed: bool
    depth_error: float
    widths: tuple[float, float] = FIRST_WIDTHS
    n_determined: float = 0.0

    @classmethod
    def of_model(
        cls, frames: PosteriorFrames, scale: float, gauge: FrameMap, adapt: str
    ) -> "ShapePrior":
        """Return the prior with a model's shapes times a scale, for a gauge."""
        certainty = frames.certainty
        error = 0.0 if certainty.points is None else np.mean(certainty.points)
        error *= scale**2 / (certainty.leverage or len(frames.shapes))
        return cls(scale * frames.shapes, gauge, adapt == "mean", float(error))

    @property
    def changes(self) -> NDArray:
        """Changes (K + 1, n) of the shapes for those of the n free public shapes."""
        return self.gauge.mixing.T[:, : 1 if self.fixed else None]

    @property
    def along(self) -> NDArray:
        """The changes for each axis, (3 (K + 1), 3n)."""
        return np.kron(self.changes, np.eye(3))

    @property
    def variances(self) -> NDArray:
        """Prior variances (n,) of the free public shapes."""
        widths = np.repeat(self.widths, (1, self.changes.shape[1] - 1))
        return np.maximum(widths, OF_DISTANCES) ** 2

    def of_points(self, kept: NDArray) -> "ShapePrior":
        """Return the prior of some of the points."""
        return self._replace(shapes=centred(self.shapes[:, :, kept]))

    def differences(self, shapes: NDArray) -> tuple[NDArray, NDArray]:
        """Return E (n, 3, J), and the matrix N (n, K + 1) of the free public shapes."""
        N = np.linalg.pinv(self.changes)
        return np.tensordot(N, shapes - self.shapes, 1), N

    def term(self, shapes: NDArray) -> tuple[float, NDArray]:
        """Return the term of -2 log L, and its derivative by the shapes."""
        E, N = self.differences(shapes)
        pulled = E / self.variances[:, None, None]
        return float(np.vdot(E, pulled)), 2.0 * np.tensordot(N.T, pulled, 1)

    def covariance(self, curvature: NDArray, noise: float) -> NDArray:
        """Return the covariance of E (m, 3n, 3n), for curvatures without prior."""
        along, prior = self.along, np.repeat(1.0 / self.variances, 3)
        return np.linalg.inv(along.T @ curvature @ along / noise + np.diag(prior))

    def inverse(self, curvature: NDArray, noise: float) -> NDArray:
        """Return inverses of curvatures (m, 3 (K + 1), 3 (K + 1)) with the prior."""
        along = self.along
        return along @ self.covariance(curvature, noise) @ along.T / noise

    def updated(
        self, shapes: NDArray, curvature: NDArray, noise: float
    ) -> "ShapePrior":
        """Return the prior with the widths that follow from a fit."""
        squares = np.sum(self.differences(shapes)[0] ** 2, axis=(1, 2))
        covariance = self.covariance(curvature, noise).mean(axis=0)
        trace = np.diagonal(covariance).reshape(-1, 3).sum(axis=1)
        numbers = shapes.shape[2] * np.maximum(3.0 - trace / self.variances, 1e-9)
        tau = np.sqrt(squares[0] / numbers[0])
        rho = 0.0 if self.fixed else np.sqrt(squares[1:].sum() / numbers[1:].sum())
        widths, n_determined = (float(tau), float(rho)), float(numbers.sum())
        return self._replace(widths=widths, n_determined=n_determined)

    def depth_errors(
        self, information: NDArray, noise: float, sight: NDArray, alpha: NDArray
    ) -> NDArray:
        """Return error variances (I,) of depths of frames of size one.

        Information (3 (K + 1), 3 (K + 1)) of a point of the shapes, for noise of
        variance one; public lines of sight (I, 3), times the scales, and coefficients.
        Depths of the model have errors; a fixed basis keeps them.
        """
        variances = np.full((len(self.shapes), 3), OF_DISTANCES**2)
        variances[: len(self.variances)] += self.variances[:, None]
        variances[:, 2] += self.depth_error
        along = np.kron(self.gauge.mixing.T, self.gauge.rotation.T)
        known = along.T @ information @ along / noise
        if self.fixed:
            known[3:] = known[:, 3:] = 0.0
        covariance = np.linalg.inv(known + np.diag(1.0 / variances.ravel()))
        size = np.cbrt(abs(np.linalg.det(self.gauge.space)))
        X = size * stacked_motion(sight[:, None], alpha)
        return np.vecdot(X @ covariance, X)
