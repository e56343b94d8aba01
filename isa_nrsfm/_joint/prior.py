"""A fitted model as the prior of the shapes of another table.

The public shapes are a mean shape and a basis, rows of ``N B`` with the shapes B (K + 1,
3, J) of the fit and a matrix N. Those of the table differ from those A of the model by
``E = N (B - A)``, and -2 log L gets the term ::

    sum_k ||E_k||^2 / v_k,

with v_0 = tau^2 for the mean shape and v_k = rho^2 for the basis shapes. The widths tau
and rho follow from the table (MacKay, "Bayesian interpolation", 1992): with the posterior
covariance of E_k, the coefficients' moments held fixed, ::

    g_k = 1 - tr(cov E_k) / (3J v_k),   tau^2 <- ||E_0||^2 / (3J g_0),
                                        rho^2 <- sum_k ||E_k||^2 / (3J sum_k g_k).

Rotation, mirror image, scale and mixing of the shapes are those of the model.
"""

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from isa_nrsfm._frames.models import FrameMap
from isa_nrsfm._linalg.small_matrices import centred

# Widths of the first fit, in sizes of frames: the last ones do not depend on them.
FIRST_WIDTHS = 0.05, 0.01
# Rounds that estimate the widths. Floor of the noise variance, as a share of the mean
# square: docs/benchmarks/README.md, "Thresholds".
ROUNDS, LEAST_NOISE = 3, 5e-4


class ShapePrior(NamedTuple):
    """A normal prior of shapes.

    shapes (K + 1, 3, J): A. changes (K + 1, n): columns of the inverse of N, for the n
    public shapes that may differ: the mean shape, or all. widths: tau and rho.
    n_determined: number of coordinates of the shapes that the table determines.
    """

    shapes: NDArray
    changes: NDArray
    widths: tuple[float, float] = FIRST_WIDTHS
    n_determined: float = 0.0

    @classmethod
    def of_model(cls, shapes: NDArray, gauge: FrameMap, adapt: str) -> "ShapePrior":
        """Return the prior with a model's shapes, for a gauge of its frames."""
        n_free = 1 if adapt == "mean" else len(shapes)
        return cls(shapes, gauge.mixing.T[:, :n_free])

    @property
    def variances(self) -> NDArray:
        """Prior variances v of the public shapes (n,)."""
        mean_shape, basis = np.square(self.widths)
        return np.r_[mean_shape, np.full(self.changes.shape[1] - 1, basis)]

    @property
    def precision(self) -> NDArray:
        """The matrix Q (K + 1, K + 1) of the term ``sum_kl Q_kl <D_k, D_l>``, D = B - A."""
        public = np.linalg.pinv(self.changes)
        return public.T @ (public / self.variances[:, None])

    def of_points(self, kept: NDArray) -> "ShapePrior":
        """Return the prior of some of the points."""
        return self._replace(shapes=centred(self.shapes[:, :, kept]))

    def term(self, shapes: NDArray) -> tuple[float, NDArray]:
        """Return the term of -2 log L, and its derivative by the shapes."""
        change = shapes - self.shapes
        pulled = np.tensordot(self.precision, change, 1)
        return float(np.vdot(change, pulled)), 2.0 * pulled

    def covariance(self, curvature: NDArray, noise: float) -> NDArray:
        """Return the covariance of E (m, 3n, 3n), for curvatures of B without prior."""
        each_axis = np.kron(self.changes, np.eye(3))
        information = each_axis.T @ curvature @ each_axis / noise
        prior = np.kron(np.diag(1.0 / self.variances), np.eye(3))
        return np.asarray(np.linalg.inv(information + prior))

    def of_shapes(self, covariance: NDArray) -> NDArray:
        """Return the covariance of B (m, 3(K + 1), 3(K + 1)) for that of E."""
        each_axis = np.kron(self.changes, np.eye(3))
        return np.asarray(each_axis @ covariance @ each_axis.T)

    def updated(self, shapes: NDArray, covariance: NDArray) -> "ShapePrior":
        """Return the prior with the widths that follow from a fit."""
        n_points = shapes.shape[2]
        public = np.linalg.pinv(self.changes)
        squares = np.sum(np.tensordot(public, shapes - self.shapes, 1) ** 2, axis=(1, 2))
        n_free = len(squares)
        trace = np.einsum("mkaka->k", covariance.reshape(-1, n_free, 3, n_free, 3))
        trace *= n_points / len(covariance)
        numbers = 3 * n_points * (1.0 - trace / (3 * n_points * self.variances))
        numbers = np.maximum(numbers, 1e-9)
        tau = squares[0] / numbers[0]
        rho = squares[1:].sum() / numbers[1:].sum() if n_free > 1 else 0.0
        widths = float(np.sqrt(tau)), float(np.sqrt(rho))
        return self._replace(widths=widths, n_determined=float(numbers.sum()))
