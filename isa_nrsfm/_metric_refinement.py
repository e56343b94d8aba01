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
from isa_nrsfm._small_matrices import COLUMNS, ROWS, eigh3

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
# A share of the largest curvature that is rounding errors.
ROUNDING = 1e-14
# Frames taken at a time, for which all that a step needs stays in the cache.
BLOCK_FRAMES = 1024


class MetricFit(NamedTuple):
    """
    A metric of least squares.

    Attributes
    ----------
    Q : ndarray of shape (3, 3)
        Of the metric of frames without deformation.
    strain : ndarray of shape (n_components, 3, 3)
        E_k, symmetric and without trace.
    n_frames : int
        Number of cameras.
    cost : float
        Sum of the squared residuals, those of `orthonormality`.
    curvature : ndarray of shape (n_unknowns, n_unknowns)
        ``J^T J`` with J the derivatives of the residuals by the numbers of E_0, E_1,
        ..., the coefficients of `strain_basis`, in this order.
    gradient : ndarray of shape (n_unknowns,)
        ``J^T r`` with r the residuals.
    """

    Q: NDArray
    strain: NDArray
    n_frames: int
    cost: float
    curvature: NDArray
    gradient: NDArray

    @property
    def residual(self) -> float:
        """Root mean square over the frames of the norm of the residuals."""
        return float(np.sqrt(self.cost / self.n_frames))

    @property
    def condition_number(self) -> float:
        """Condition number of the residuals as functions of the common metric."""
        size = len(self.gradient) // (len(self.strain) + 1)
        values = np.linalg.eigvalsh(self.curvature[:size, :size])
        if values[0] <= ROUNDING * values[-1]:
            return np.inf
        return float(np.sqrt(values[-1] / values[0]))


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
    gram : ndarray of shape (2, 2, n_frames)
        ``M_i G M_i^T``, the products of the rows in the metric, the frame last.
    camera : {"orthographic", "weak_perspective"}
        Whether the rows should be those of a rotation or of a scaled rotation.

    Returns
    -------
    ndarray of shape (3, n_frames) or (2, n_frames)
        ``(xx - 1, sqrt(2) xy, yy - 1)``, of the norm ``||M_i G M_i^T - I||_F``, for
        orthographic cameras, and ``(xx - yy, 2 xy) / (xx + yy)``, of the norm ``(s1^2 -
        s2^2) / (s1^2 + s2^2)`` with s1, s2 the singular values of ``M_i Q``, for
        weak-perspective ones: neither roll nor scale of a frame changes that.
    """
    entries = np.tensordot(_patterns(camera), gram, 2)
    if camera == "orthographic":
        return entries - [[1.0], [0.0], [1.0]]
    return entries / (gram[0, 0] + gram[1, 1])


def _patterns(camera: CameraModel) -> NDArray:
    """Return the symmetric matrices whose products with a Gram matrix count."""
    if camera == "orthographic":
        across = np.array([[0.0, 1.0], [1.0, 0.0]]) / np.sqrt(2)
        return np.stack([np.diag([1.0, 0.0]), across, np.diag([0.0, 1.0])])
    return np.array([[[1.0, 0.0], [0.0, -1.0]], [[0.0, 1.0], [1.0, 0.0]]])


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
    shortest_step: float = SHORTEST_STEP,
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
    shortest_step : float
        No entry of the last step is larger.

    Returns
    -------
    MetricFit
        A minimum of ``sum_i |residuals_i|^2 + ridge * sum_k ||E_k||_F^2``.
    """
    if alpha is None:
        alpha = np.zeros((len(motion), 0))
    blocks = [
        (motion[start : start + BLOCK_FRAMES], alpha[start : start + BLOCK_FRAMES])
        for start in range(0, len(motion), BLOCK_FRAMES)
    ]
    blocks = [
        (np.ascontiguousarray(cameras.transpose(1, 2, 0)), np.ascontiguousarray(own.T))
        for cameras, own in blocks
    ]
    basis = strain_basis(camera)
    size, n_components = len(basis), alpha.shape[1]
    numbers = np.zeros((n_components, size))
    if strain is not None:
        numbers = np.einsum("kab,nab->kn", strain, basis)
    prices = np.repeat([0.0, ridge], [size, size * n_components])
    reach = 1.0 + np.abs(alpha).sum(axis=1).max(initial=0.0)

    def reached(Q: NDArray, numbers: NDArray) -> tuple[float, MetricFit]:
        strain = np.tensordot(numbers, basis, 1)
        parts = [
            _normal_equations(alpha, *_linearised(Q.T @ cameras, strain, alpha, camera))
            for cameras, alpha in blocks
        ]
        cost, curvature, gradient = (sum(part) for part in zip(*parts, strict=True))
        fit = MetricFit(Q, strain, len(motion), cost, curvature, gradient)
        return cost + ridge * float(np.sum(numbers**2)), fit

    value, fit = reached(Q, numbers)
    damping = FIRST_DAMPING
    for _ in range(MAX_STEPS):
        curvature = fit.curvature + np.diag(prices)
        gradient = fit.gradient + prices * np.append(np.zeros(size), numbers)
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
        if np.abs(step).max() < shortest_step or damping > LARGEST_DAMPING:
            break
    return fit


def _linearised(
    cameras: NDArray, strain: NDArray, alpha: NDArray, camera: CameraModel
) -> tuple[NDArray, NDArray, NDArray]:
    """
    Return residuals of cameras and their derivatives.

    Parameters
    ----------
    cameras : ndarray of shape (2, 3, n_frames)
        ``M_i Q``, the frame last.
    strain : ndarray of shape (n_components, 3, 3)
        E_k.
    alpha : ndarray of shape (n_components, n_frames)
        Coefficients.
    camera : {"orthographic", "weak_perspective"}
        What the cameras should be.

    Returns
    -------
    residuals : ndarray of shape (n, n_frames)
        As of `orthonormality`.
    slopes : ndarray of shape (n_numbers, n, n_frames)
        Derivatives by the numbers of E_0.
    own_slopes : ndarray of shape (n_numbers, n, n_frames)
        Derivatives by the numbers of the strain ``sum_k alpha_ik E_k`` of the frame:
        those by the numbers of E_k are alpha_ik times as large.
    """
    numbers = strain_basis(camera)
    grown = cameras
    if len(strain):
        stretch, axes = eigh3(strain[:, ROWS, COLUMNS].T @ alpha)
        seen = np.einsum("abn,pan->pbn", axes, cameras)
        grown = np.einsum("abn,pbn->pan", axes, np.exp(stretch) * seen)
    gram = np.einsum("pan,qan->pqn", grown, cameras)
    residuals = orthonormality(gram, camera)
    # Residual c changes by tr(F_c d(M_i G_i M_i^T)).
    F = np.broadcast_to(
        _patterns(camera)[..., None], (len(residuals), 2, 2, cameras.shape[-1])
    )
    if camera == "weak_perspective":
        F = F - residuals[:, None, None] * np.eye(2)[:, :, None]
        F /= gram[0, 0] + gram[1, 1]

    # exp(E_0 / 2) exp(E) exp(E_0 / 2) changes by the mean of E_0 exp(E), exp(E) E_0.
    turned = np.einsum("cpqn,qan->cpan", F, cameras)
    by_common = np.einsum("cpan,pbn->abcn", turned, grown)
    slopes = np.tensordot(numbers, by_common, 2)
    if not len(strain):
        return residuals, slopes, slopes
    # In the axes of the strain exp(E) changes by divided differences of exp times dE.
    half_gap = (stretch[:, None] - stretch) / 2
    equal = half_gap == 0
    divided = np.where(equal, 1.0, np.sinh(half_gap) / np.where(equal, 1.0, half_gap))
    root = np.exp(stretch / 2)
    divided *= root[:, None] * root
    turned = np.einsum("cpqn,qan->cpan", F, seen)
    by_own = np.einsum("cpan,pbn->abcn", turned, seen) * divided[:, :, None]
    by_own = np.einsum("xan,abcn->xbcn", axes, by_own)
    by_own = np.einsum("ybn,xbcn->xycn", axes, by_own)
    return residuals, slopes, np.tensordot(numbers, by_own, 2)


def _normal_equations(
    alpha: NDArray, residuals: NDArray, slopes: NDArray, own_slopes: NDArray
) -> tuple[float, NDArray, NDArray]:
    """Return cost, curvature and gradient, as in `MetricFit`, of `_linearised`."""
    n_components, size = len(alpha), len(slopes)
    rows = slopes.reshape(size, -1)
    curvature = np.empty((1 + n_components, size, 1 + n_components, size))
    curvature[0, :, 0] = rows @ rows.T
    gradient = np.empty((1 + n_components, size))
    gradient[0] = rows @ residuals.ravel()
    if n_components:
        gradient[1:] = alpha @ np.einsum("acn,cn->na", own_slopes, residuals)
        mixed = np.einsum("acn,bcn->abn", slopes, own_slopes) @ alpha.T
        curvature[0, :, 1:] = mixed.transpose(0, 2, 1)
        curvature[1:, :, 0] = mixed.transpose(2, 1, 0)
        # Sums over the frames of products of two numbers and of two coefficients.
        (a, b), numbers = _pairs(size)
        (k, m), components = _pairs(n_components)
        products = np.einsum("pcn,pcn->pn", own_slopes[a], own_slopes[b])
        sums = products @ (alpha[k] * alpha[m]).T
        curvature[1:, :, 1:] = sums[numbers[:, None], components[:, None, :, None]]
    cost = float(np.vdot(residuals, residuals))
    return cost, curvature.reshape(gradient.size, gradient.size), gradient.ravel()


def _pairs(n: int) -> tuple[tuple[NDArray, NDArray], NDArray]:
    """Return the pairs (a, b) with a <= b < n, and a table of where each of them is."""
    a, b = np.triu_indices(n)
    where = np.empty((n, n), dtype=int)
    where[a, b] = where[b, a] = np.arange(len(a))
    return (a, b), where


def exponential(matrices: NDArray) -> NDArray:
    """Return the exponentials of symmetric matrices (..., 3, 3)."""
    values, axes = np.linalg.eigh(matrices)
    return (axes * np.exp(values)[..., None, :]) @ np.swapaxes(axes, -1, -2)
