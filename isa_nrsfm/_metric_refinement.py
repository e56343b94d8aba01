"""The metric of space in which cameras are most nearly scaled rotations.

A metric is a symmetric positive definite 3x3 matrix ``G = Q Q^T``: the rows of the
camera M_i are orthogonal and of equal length in it where ``M_i Q = s_i R_i``, the first
two rows of a scaled rotation. It may change with the deformation of the object, as
``G_i = Q exp(sum_k alpha_ik E_k) Q^T`` with symmetric strains E_k.

What is left of orthonormality is minimised by damped Gauss-Newton steps along
geodesics, ``Q <- Q exp(E_0 / 2)``. Any step leads to a metric, so that a minimum is
found also where the linear equations for the entries of G (`metric_quadric`) have an
indefinite solution. The derivative of the exponential is that of Daleckii and Krein
(Higham, "Functions of matrices", 2008, theorem 3.11).
"""

from typing import Literal, NamedTuple

import numpy as np
from numpy.typing import NDArray

from isa_nrsfm._metric import mean_gram, symmetric_power, unit_cameras

CameraModel = Literal["orthographic", "weak_perspective"]
CAMERA_MODELS = ("orthographic", "weak_perspective")

# Metrics that are nearly singular are saddle points. A start is one that stretches no
# direction, relative to another one that the cameras see as well, by more than this.
STRETCH_OF_START = 3.0
MAX_STEPS = 200
# It has converged when no entry of a step, a change of a logarithm, is larger.
SHORTEST_STEP = 1e-9
# Damping relative to the diagonal: the first, how it falls and rises, and the largest.
FIRST_DAMPING = 1e-3
EASED, STIFFENED = 0.2, 5.0
LARGEST_DAMPING = 1e10
# A step changes the logarithm of the metric of a frame by no more than about this.
LONGEST_STEP = 2.0
# Logarithms that are nearer to each other than this have the same exponential.
EQUAL_STRETCHES = 1e-6


class MetricFit(NamedTuple):
    """
    A metric of least squares.

    Attributes
    ----------
    Q : ndarray of shape (3, 3)
        Of the metric of frames without deformation.
    strain : ndarray of shape (n_components, 3, 3)
        E_k, symmetric and without trace.
    residuals : ndarray of shape (n_frames, n)
        As of `orthonormality`.
    slopes : ndarray of shape (n_frames, n, n_numbers * (n_components + 1))
        Their derivatives by the numbers of E_0 and of the E_k, the coefficients of
        `strain_basis`.
    """

    Q: NDArray
    strain: NDArray
    residuals: NDArray
    slopes: NDArray

    @property
    def cost(self) -> float:
        """Sum of the squared residuals."""
        return float(np.sum(self.residuals**2))

    @property
    def residual(self) -> float:
        """Root mean square over the frames of the norm of the residuals."""
        return float(np.sqrt(self.cost / len(self.residuals)))

    @property
    def condition_number(self) -> float:
        """Condition number of the residuals as functions of the common metric."""
        size = self.slopes.shape[2] // (len(self.strain) + 1)
        slopes = self.slopes[:, :, :size].reshape(-1, size)
        if len(slopes) < size:
            return np.inf
        values = np.linalg.svd(slopes, compute_uv=False)
        return float(values[0] / values[-1]) if values[-1] > 0 else np.inf


def strain_basis(camera: CameraModel) -> NDArray:
    """
    Return an orthonormal basis of the strains that cameras tell from none.

    Parameters
    ----------
    camera : {"orthographic", "weak_perspective"}
        With a scale of its own for each frame no strain has a trace.

    Returns
    -------
    ndarray of shape (n_numbers, 3, 3)
        Six symmetric matrices, or five without trace.
    """
    basis = np.zeros((6, 3, 3))
    diagonal = np.array([[1, -1, 0], [1, 1, -2], [1, 1, 1]]) / np.sqrt([[2], [6], [3]])
    basis[[[0], [1], [5]], [0, 1, 2], [0, 1, 2]] = diagonal
    first, second = [0, 0, 1], [1, 2, 2]
    basis[[2, 3, 4], first, second] = basis[[2, 3, 4], second, first] = np.sqrt(0.5)
    return basis if camera == "orthographic" else basis[:5]


def orthonormality(gram: NDArray, camera: CameraModel) -> NDArray:
    """
    Return how far the rows of cameras are from those of rotations.

    Parameters
    ----------
    gram : ndarray of shape (n_frames, 2, 2)
        ``M_i G M_i^T``, the products of the rows in the metric.
    camera : {"orthographic", "weak_perspective"}
        Whether the rows should be those of a rotation or of a scaled rotation.

    Returns
    -------
    ndarray of shape (n_frames, 3) or (n_frames, 2)
        ``(xx - 1, sqrt(2) xy, yy - 1)``, of the norm ``||M_i G M_i^T - I||_F``, for
        orthographic cameras, and ``(xx - yy, 2 xy) / (xx + yy)``, of the norm ``(s1^2 -
        s2^2) / (s1^2 + s2^2)`` with s1, s2 the singular values of ``M_i Q``, for
        weak-perspective ones: neither roll nor scale of a frame changes that.
    """
    xx, xy, yy = gram[:, 0, 0], gram[:, 0, 1], gram[:, 1, 1]
    if camera == "orthographic":
        return np.stack([xx - 1, np.sqrt(2) * xy, yy - 1], axis=1)
    return np.stack([xx - yy, 2 * xy], axis=1) / (xx + yy)[:, None]


def safe_start(motion: NDArray, Q: NDArray, camera: CameraModel) -> NDArray:
    """
    Return a metric to start from, near to a given one.

    Parameters
    ----------
    motion : ndarray of shape (n_frames, 2, 3)
        Cameras, finite, which together see three directions of space.
    Q : ndarray of shape (3, 3)
        A symmetric matrix, positive definite or not: the linear solution for G.
    camera : {"orthographic", "weak_perspective"}
        Orthographic cameras say how large G is.

    Returns
    -------
    ndarray of shape (3, 3)
        Of a metric that has the same axes, in the space in which the cameras see all
        directions alike, but is stretched by at most `STRETCH_OF_START` there.
    """
    counted = motion if camera == "orthographic" else unit_cameras(motion)
    root = symmetric_power(mean_gram(counted), 0.5)
    values, axes = np.linalg.eigh(root @ Q @ root)
    values = np.maximum(values, values[-1] / STRETCH_OF_START**2)
    # The mean of tr(M_i G M_i^T) is that of two rows of unit length.
    values *= 2 / values.sum()
    return np.linalg.solve(root, axes * np.sqrt(values))


def refine_metric(
    motion: NDArray,
    Q: NDArray,
    camera: CameraModel,
    alpha: NDArray | None = None,
    strain: NDArray | None = None,
    ridge: float = 0.0,
) -> MetricFit:
    """
    Minimise what is left of orthonormality from a start.

    Parameters
    ----------
    motion : ndarray of shape (n_frames, 2, 3)
        Cameras, finite and not zero.
    Q : ndarray of shape (3, 3)
        Of the metric to start from, as of `safe_start`.
    camera : {"orthographic", "weak_perspective"}
        What the cameras should be.
    alpha : ndarray of shape (n_frames, n_components), optional
        Coefficients of the strains; by default there are none.
    strain : ndarray of shape (n_components, 3, 3), optional
        Strains to start from, by default zeros.
    ridge : float, default=0.0
        Price of the squared norm of the strains.

    Returns
    -------
    MetricFit
        A minimum of ``sum_i |residuals_i|^2 + ridge * sum_k ||E_k||_F^2``.
    """
    alpha = np.zeros((len(motion), 0)) if alpha is None else alpha
    basis = strain_basis(camera)
    size, n_components = len(basis), alpha.shape[1]
    numbers = np.zeros((n_components, size))
    if strain is not None:
        numbers = np.einsum("kab,nab->kn", strain, basis)
    prices = np.repeat([0.0, ridge], [size, size * n_components])
    reach = 1.0 + np.abs(alpha).sum(axis=1).max(initial=0.0)

    def reached(Q: NDArray, numbers: NDArray) -> tuple[float, MetricFit]:
        strain = np.tensordot(numbers, basis, 1)
        fit = MetricFit(Q, strain, *_linearised(motion @ Q, strain, alpha, camera))
        return fit.cost + ridge * float(np.sum(numbers**2)), fit

    value, fit = reached(Q, numbers)
    damping = FIRST_DAMPING
    for _ in range(MAX_STEPS):
        slopes = fit.slopes.reshape(-1, len(prices))
        curvature = slopes.T @ slopes + np.diag(prices)
        gradient = slopes.T @ fit.residuals.ravel()
        gradient[size:] += ridge * numbers.ravel()
        scale = np.maximum(curvature.diagonal(), 1e-12 * curvature.diagonal().max())
        step = -np.linalg.lstsq(curvature + np.diag(damping * scale), gradient)[0]
        step *= min(1.0, LONGEST_STEP / max(reach * np.abs(step).max(), 1e-300))
        change = np.tensordot(step[:size], basis, 1)
        changed = numbers + step[size:].reshape(numbers.shape)
        new_value, new = reached(fit.Q @ exponential(change / 2), changed)
        if new_value <= value:
            value, numbers, fit = new_value, changed, new
            damping *= EASED
        else:
            damping *= STIFFENED
        if np.abs(step).max() < SHORTEST_STEP or damping > LARGEST_DAMPING:
            break
    return fit


def _linearised(
    motion: NDArray, strain: NDArray, alpha: NDArray, camera: CameraModel
) -> tuple[NDArray, NDArray]:
    """Return residuals of cameras ``M Q`` and derivatives by the numbers of strains."""
    basis = strain_basis(camera)
    stretch, axes = np.linalg.eigh(np.tensordot(alpha, strain, 1))
    grown = np.exp(stretch)
    seen = motion @ axes
    turned = seen.transpose(0, 2, 1)
    gram = (seen * grown[:, None]) @ turned
    residuals = orthonormality(gram, camera)
    along = axes.transpose(0, 2, 1)[:, None] @ basis @ axes[:, None]

    def derivative(factors: NDArray) -> NDArray:
        change = seen[:, None] @ (factors[:, None] * along) @ turned[:, None]
        xx, xy, yy = change[..., 0, 0], change[..., 0, 1], change[..., 1, 1]
        if camera == "orthographic":
            return np.stack([xx, np.sqrt(2) * xy, yy], axis=1)
        grows = (xx + yy)[:, None]
        rest = np.stack([xx - yy, 2 * xy], axis=1) - residuals[:, :, None] * grows
        return rest / np.trace(gram, axis1=1, axis2=2)[:, None, None]

    # exp(E_0 / 2) exp(E) exp(E_0 / 2) changes by the mean of E_0 exp(E), exp(E) E_0.
    mean = (grown[:, :, None] + grown[:, None]) / 2
    parts = [derivative(mean)]
    if alpha.shape[1]:
        gap = stretch[:, :, None] - stretch[:, None]
        close = np.abs(gap) < EQUAL_STRETCHES
        rise = grown[:, :, None] - grown[:, None]
        divided = np.where(close, mean, rise / np.where(close, 1.0, gap))
        by_strain = derivative(divided)
        parts += [by_strain * column[:, None, None] for column in alpha.T]
    return residuals, np.concatenate(parts, axis=2)


def exponential(matrices: NDArray) -> NDArray:
    """Return the exponentials of symmetric matrices (..., 3, 3)."""
    values, axes = np.linalg.eigh(matrices)
    return (axes * np.exp(values)[..., None, :]) @ np.swapaxes(axes, -1, -2)
