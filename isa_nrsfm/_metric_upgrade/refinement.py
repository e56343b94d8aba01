"""The metric of space in which cameras are most nearly scaled rotations.

A metric is a symmetric positive definite 3x3 matrix ``G = Q Q^T``: the rows of the
camera M_i are orthogonal and of equal length in it where ``M_i Q = s_i R_i``, the first
two rows of a scaled rotation. It may change with the deformation of the object, as
``G_i = Q exp(sum_k alpha_ik E_k) Q^T`` with symmetric strains E_k.

The sum of squares of the residuals (`orthonormality`) is minimised by damped
Gauss-Newton steps along geodesics, ``Q <- Q exp(E_0 / 2)``, and in the strains. So ``Q
Q^T`` stays positive definite, even if the linear equations (`metric_quadric`) have an
indefinite solution. The derivative of the exponential is that of Daleckii and Krein
(Higham, "Functions of matrices", 2008, theorem 3.11).

The strain of a frame, ``sum_k alpha_ik E_k``, has five or six coordinates in
`strain_basis`. Derivatives with respect to those of E_k are alpha_ik times derivatives
with respect to these. Only the sums ``J^T J`` and ``J^T r`` over the frames are formed.
"""

from collections.abc import Callable
from typing import NamedTuple, TypeVar

import numpy as np
from numpy.typing import NDArray

from isa_nrsfm._linalg.rounding import OF_PRODUCTS, OF_RANKS, OF_STEPS
from isa_nrsfm._linalg.small_matrices import frames_last
from isa_nrsfm._metric_upgrade.quadric import (
    CalibratedCamera,
    mean_gram,
    strain_basis,
    symmetric_power,
    unit_cameras,
)
from isa_nrsfm._tables.blocks import BLOCK_FRAMES

# Bound on the ratio of stretches of a metric to start from, in the space in which the
# cameras see all directions alike. Nearly singular metrics are near saddle points.
STRETCH_OF_START = 3.0

State = TypeVar("State")


class MetricFit(NamedTuple):
    """A metric, with its cost and derivatives.

    Q (3, 3): ``G = Q Q^T`` is the metric of frames without deformation.
    strain (K, 3, 3): E_k, symmetric with trace zero.
    cost: sum of the squared residuals of `orthonormality`.
    curvature: ``J^T J`` with the Jacobian of the residuals in the coordinates of E_0,
    E_1, ... in `strain_basis`.
    gradient: ``J^T r`` with r the residuals.
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
        if values[0] <= OF_PRODUCTS * values[-1]:
            return np.inf
        return float(np.sqrt(values[-1] / values[0]))


def orthonormality(gram: NDArray, camera: CalibratedCamera) -> NDArray:
    """Return residuals (n, n_frames) of the products ``M_i G M_i^T`` (2, 2, n_frames).

    For orthographic cameras ``(xx - 1, sqrt(2) xy, yy - 1)``, with the norm ``||M_i G
    M_i^T - I||_F``. For weak-perspective cameras ``(xx - yy, 2 xy) / (xx + yy)``, with
    the norm ``(s1^2 - s2^2) / (s1^2 + s2^2)``, s1 and s2 being the singular values of
    ``M_i Q``: it does not depend on roll and scale.
    """
    entries = np.tensordot(_patterns(camera), gram, 2)
    if camera == "orthographic":
        return entries - [[1.0], [0.0], [1.0]]
    return entries / (gram[0, 0] + gram[1, 1])


def _patterns(camera: CalibratedCamera) -> NDArray:
    """Return symmetric F_c (n, 2, 2): raw residuals ``<F_c, M_i G M_i^T>``."""
    if camera == "orthographic":
        across = np.array([[0.0, 1.0], [1.0, 0.0]]) / np.sqrt(2)
        return np.stack([np.diag([1.0, 0.0]), across, np.diag([0.0, 1.0])])
    return np.array([[[1.0, 0.0], [0.0, -1.0]], [[0.0, 1.0], [1.0, 0.0]]])


def fit_at(
    motion: NDArray,
    alpha: NDArray,
    Q: NDArray,
    strain: NDArray,
    camera: CalibratedCamera,
) -> MetricFit:
    """Evaluate a metric for cameras (I, 2, 3) and strain coefficients (I, K)."""
    parts = []
    for start in range(0, len(motion), BLOCK_FRAMES):
        part = slice(start, start + BLOCK_FRAMES)
        M, coefficients = frames_last(motion[part]), alpha[part].T
        linearised = _linearised(Q.T @ M, strain, coefficients, camera)
        parts.append(_normal_equations(coefficients, *linearised))
    costs, curvatures, gradients = zip(*parts, strict=True)
    curvature, gradient = np.sum(curvatures, axis=0), np.sum(gradients, axis=0)
    return MetricFit(Q, strain, len(motion), sum(costs), curvature, gradient)


def _linearised(
    MQ: NDArray, strain: NDArray, alpha: NDArray, camera: CalibratedCamera
) -> tuple[NDArray, NDArray, NDArray]:
    """Return residuals (n, I) of cameras ``M_i Q`` (2, 3, I), and two derivatives.

    The derivatives (n_numbers, n, I) are those in the coordinates of E_0 in
    `strain_basis`, and of ``E = sum_k alpha_ik E_k``, with alpha (K, I).
    """
    numbers = strain_basis(camera)
    # M_i Q exp(E) is `grown`, and M_i G_i M_i^T the product of that with M_i Q. The
    # eigenvectors of E are `axes`, and `seen` is M_i Q in these axes.
    grown = MQ
    if len(strain):
        values, vectors = np.linalg.eigh(np.tensordot(alpha.T, strain, 1))
        stretch, axes = values.T, frames_last(vectors)
        seen = np.einsum("abn,pan->pbn", axes, MQ)
        grown = np.einsum("abn,pbn->pan", axes, np.exp(stretch) * seen)
    gram = np.einsum("pan,qan->pqn", grown, MQ)
    residuals = orthonormality(gram, camera)
    # Residual c changes by tr(F_c d(M_i G_i M_i^T)). The weak-perspective residual is a
    # quotient: F_c is (pattern - residual * I) / (xx + yy).
    F = np.broadcast_to(
        _patterns(camera)[..., None], (len(residuals), 2, 2, MQ.shape[-1])
    )
    if camera == "weak_perspective":
        F = F - residuals[:, None, None] * np.eye(2)[:, :, None]
        F /= gram[0, 0] + gram[1, 1]

    # Derivatives in E_0: exp(E_0 / 2) exp(E) exp(E_0 / 2) changes to first order by
    # (E_0 exp(E) + exp(E) E_0) / 2.
    turned = np.einsum("cpqn,qan->cpan", F, MQ)
    by_common = np.einsum("cpan,pbn->abcn", turned, grown)
    slopes = np.tensordot(numbers, by_common, 2)
    if not len(strain):
        return residuals, slopes, slopes
    # Derivatives in E: in its axes, exp(E) changes by dE times, entry by entry, the
    # divided differences of exp at two eigenvalues, which are
    # exp((a + b) / 2) sinh((a - b) / 2) / ((a - b) / 2).
    half_gap = (stretch[:, None] - stretch) / 2
    equal = half_gap == 0
    divided = np.where(equal, 1.0, np.sinh(half_gap) / np.where(equal, 1.0, half_gap))
    root = np.exp(stretch / 2)
    divided *= root[:, None] * root
    turned = np.einsum("cpqn,qan->cpan", F, seen)
    by_own = np.einsum("cpan,pbn->abcn", turned, seen) * divided[:, :, None]
    # Back to the axes of space.
    by_own = np.einsum("xan,abcn->xbcn", axes, by_own)
    by_own = np.einsum("ybn,xbcn->xycn", axes, by_own)
    return residuals, slopes, np.tensordot(numbers, by_own, 2)


def _normal_equations(
    alpha: NDArray, residuals: NDArray, slopes: NDArray, own_slopes: NDArray
) -> tuple[float, NDArray, NDArray]:
    """Return cost, curvature and gradient of `MetricFit` from `_linearised`."""
    n_components, size = len(alpha), len(slopes)
    rows = slopes.reshape(size, -1)
    # Axes (k, a, m, b): coordinate a of E_k and coordinate b of E_m
    curvature = np.empty((1 + n_components, size, 1 + n_components, size))
    curvature[0, :, 0] = rows @ rows.T
    gradient = np.empty((1 + n_components, size))
    gradient[0] = rows @ residuals.ravel()
    if n_components:
        gradient[1:] = alpha @ np.einsum("acn,cn->na", own_slopes, residuals)
        mixed = np.einsum("acn,bcn->abn", slopes, own_slopes) @ alpha.T
        curvature[0, :, 1:] = mixed.transpose(0, 2, 1)
        curvature[1:, :, 0] = mixed.transpose(2, 1, 0)
        products = np.einsum("acn,bcn->abn", own_slopes, own_slopes)
        pairs = (alpha[:, None] * alpha).reshape(n_components**2, -1)
        own = (products @ pairs.T).reshape(size, size, n_components, n_components)
        curvature[1:, :, 1:] = own.transpose(2, 0, 3, 1)
    cost = float(np.vdot(residuals, residuals))
    return cost, curvature.reshape(gradient.size, gradient.size), gradient.ravel()


def levenberg_marquardt(
    evaluated: Callable[[State], tuple[float, NDArray, NDArray]],
    state: State,
    moved: Callable[[State, NDArray], State],
    *,
    max_steps: int,
    shortest_step: float = 0.0,
    least_gain: float = -np.inf,
) -> tuple[State, float]:
    """Minimise a sum of squares; return the last state and its cost.

    `evaluated` returns the cost of a state, ``J^T J`` and ``J^T r``; `moved` the state
    after a step (n_unknowns,). The iteration ends when no entry of a step is larger
    than `shortest_step`, or a step gains less than a share `least_gain` of the cost.
    """
    cost, curvature, gradient = evaluated(state)
    identity = np.eye(len(gradient))
    damping = 1e-3  # relative to the mean curvature
    for _ in range(max_steps):
        # Where the curvature is zero, any damping makes the matrix invertible.
        scale = np.trace(curvature) / len(gradient) or 1.0
        step = -np.linalg.solve(curvature + damping * scale * identity, gradient)
        trial = moved(state, step)
        reached, *derivatives = evaluated(trial)
        ended = np.abs(step).max() < shortest_step or damping > 1e8
        if reached <= cost * (1 + OF_PRODUCTS):
            ended |= cost - reached <= least_gain * cost or reached < OF_STEPS**2
            state, cost, (curvature, gradient) = trial, reached, derivatives
            damping = max(0.1 * damping, 1e-10)
        else:
            damping *= 4.0
        if ended:
            break
    return state, cost


def safe_start(motion: NDArray, G: NDArray, camera: CalibratedCamera) -> NDArray:
    """Return Q of a positive definite metric near to a symmetric G, to start from.

    In coordinates where the mean of ``M_i^T M_i`` is the identity, it has the axes of
    G. Its stretches have ratios of at most `STRETCH_OF_START`. Only orthographic
    cameras fix its scale.
    """
    counted = motion if camera == "orthographic" else unit_cameras(motion)
    root = symmetric_power(mean_gram(counted), 0.5)
    values, axes = np.linalg.eigh(root @ G @ root)
    values = np.maximum(values, values[-1] / STRETCH_OF_START**2)
    # Scale: the mean of tr(M_i G M_i^T) is 2, that of two rows of unit length.
    values *= 2 / values.sum()
    return np.linalg.solve(root, axes * np.sqrt(values))


def refine_metric(
    motion: NDArray,
    alpha: NDArray,
    start: MetricFit,
    camera: CalibratedCamera,
    ridge: float = 0.0,
    shortest_step: float = 1e-9,
) -> MetricFit:
    """Minimise ``sum_i |residuals_i|^2 + ridge * sum_k ||E_k||_F^2`` from a start.

    Cameras (I, 2, 3) are finite and not zero, alpha is (I, K).
    """
    # The unknowns of a step are coordinates in this basis: of E_0, which is zero at
    # each iterate, and of the strains E_k.
    basis = strain_basis(camera)
    size = len(basis)
    ridges = np.repeat([0.0, ridge], [size, size * alpha.shape[1]])
    gram = np.einsum("ira,irb->ab", motion, motion)
    # Bound of the change of the metric of a frame by one entry of a step
    reach = 1.0 + np.abs(alpha).sum(axis=1).max(initial=0.0)

    def evaluated(fit: MetricFit) -> tuple[float, NDArray, NDArray]:
        """Return the objective; infinite where space hardly has depth."""
        values = np.linalg.eigvalsh(fit.Q.T @ gram @ fit.Q)
        deep = values[0] > OF_RANKS * values[-1]
        cost = fit.cost + ridge * float(np.sum(fit.strain**2)) if deep else np.inf
        numbers = np.einsum("kab,nab->kn", fit.strain, basis)
        pull = ridges * np.append(np.zeros(size), numbers)
        return cost, fit.curvature + np.diag(ridges), fit.gradient + pull

    def moved(fit: MetricFit, step: NDArray) -> MetricFit:
        """Return the fit after a step that changes no log metric by more than 2."""
        step = step * min(1.0, 2.0 / max(reach * np.abs(step).max(), 1e-300))
        change, *strains = np.tensordot(step.reshape(-1, size), basis, 1)
        strain = fit.strain + np.reshape(strains, fit.strain.shape)
        return fit_at(motion, alpha, fit.Q @ exponential(change / 2), strain, camera)

    return levenberg_marquardt(
        evaluated, start, moved, max_steps=200, shortest_step=shortest_step
    )[0]


def exponential(matrices: NDArray) -> NDArray:
    """Return the exponentials of symmetric matrices (..., 3, 3)."""
    values, axes = np.linalg.eigh(matrices)
    return (axes * np.exp(values)[..., None, :]) @ np.swapaxes(axes, -1, -2)
