"""The metric of space in which cameras are most nearly scaled rotations.

What is left of orthonormality (`orthonormality`) is minimised by damped Gauss-Newton
steps along geodesics, ``Q <- Q exp(E_0 / 2)``. Any step leads to a metric, so that a
minimum is found also where the linear equations for the entries of G (`metric_quadric`)
have an indefinite solution. Where the residuals are large Gauss-Newton steps approach
it slowly: what they miss of the curvature is learnt from how the gradient changes.
"""

import numpy as np
from numpy.typing import NDArray

from isa_nrsfm._metric_upgrade.quadric import mean_gram, symmetric_power, unit_cameras
from isa_nrsfm._metric_upgrade.residuals import (
    Block,
    CameraModel,
    MetricFit,
    fit_at,
    frame_blocks,
    strain_basis,
)

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
# An update of the curvature whose cosine with the step is smaller is not safe.
LEAST_ALONG = 1e-8
# A share of the cost that is rounding errors.
ROUNDING = 1e-14


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
    ridge: float = 0.0,
) -> MetricFit:
    """
    Minimise what is left of orthonormality from a start without strains.

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
    ridge : float, default=0.0
        Price of the squared norm of the strains.

    Returns
    -------
    MetricFit
        A minimum of ``sum_i |residuals_i|^2 + ridge * sum_k ||E_k||_F^2``.
    """
    if alpha is None:
        alpha = np.zeros((len(motion), 0))
    blocks = frame_blocks(motion, alpha)
    start = fit_at(blocks, Q, np.zeros((alpha.shape[1], 3, 3)), camera)
    return refine_fit(blocks, start, camera, ridge)


def refine_fit(
    blocks: list[Block],
    fit: MetricFit,
    camera: CameraModel,
    ridge: float,
    shortest_step: float = SHORTEST_STEP,
) -> MetricFit:
    """
    Minimise what is left of orthonormality from any fit.

    Parameters
    ----------
    blocks : list of tuple of ndarray
        Of `frame_blocks`.
    fit : MetricFit
        The start, of `fit_at` for these blocks.
    camera, ridge
        As of `refine_metric`.
    shortest_step : float
        The search ends with a step of which no entry is larger.

    Returns
    -------
    MetricFit
        As of `refine_metric`.
    """
    basis = strain_basis(camera)
    size = len(basis)
    numbers = np.einsum("kab,nab->kn", fit.strain, basis)
    prices = np.repeat([0.0, ridge], [size, numbers.size])
    reach = 1.0 + max(np.abs(alpha).sum(axis=0).max(initial=0) for _, alpha in blocks)
    value = fit.cost + ridge * float(np.sum(numbers**2))
    damping = FIRST_DAMPING
    missing = np.zeros_like(fit.curvature)
    for _ in range(MAX_STEPS):
        curvature = fit.curvature + missing + np.diag(prices)
        gradient = fit.gradient + prices * np.append(np.zeros(size), numbers)
        scale = np.maximum(curvature.diagonal(), 1e-12 * curvature.diagonal().max())
        step = -np.linalg.lstsq(curvature + np.diag(damping * scale), gradient)[0]
        step *= min(1.0, LONGEST_STEP / max(reach * np.abs(step).max(), 1e-300))
        change = np.tensordot(step[:size], basis, 1)
        changed = numbers + step[size:].reshape(numbers.shape)
        new_Q = fit.Q @ exponential(change / 2)
        new = fit_at(blocks, new_Q, np.tensordot(changed, basis, 1), camera)
        new_value = new.cost + ridge * float(np.sum(changed**2))
        if new_value <= value * (1 + ROUNDING):
            missing = _missing_curvature(missing, step, fit, new, prices)
            value, numbers, fit = new_value, changed, new
            damping *= EASED
        elif missing.any():
            missing = np.zeros_like(missing)
        else:
            damping *= STIFFENED
        if np.abs(step).max() < shortest_step or damping > LARGEST_DAMPING:
            break
    return fit


def _missing_curvature(
    missing: NDArray, step: NDArray, old: MetricFit, new: MetricFit, prices: NDArray
) -> NDArray:
    """
    Return what ``J^T J`` lacks of the curvature after a step.

    The update of rank one by which the curvature explains the change of the gradient
    (Nocedal, Wright, "Numerical optimization", 2006, chapter 6.2; only of the part that
    is missing: Dennis, Gay, Welsch, "An adaptive nonlinear least-squares algorithm",
    ACM Transactions on Mathematical Software 7, 1981). Zeros are returned where the
    curvature would not be positive.
    """
    rest = new.gradient - old.gradient - (new.curvature + missing) @ step
    along = rest @ step
    if abs(along) > LEAST_ALONG * np.linalg.norm(rest) * np.linalg.norm(step):
        missing = missing + np.outer(rest, rest) / along
    whole = new.curvature + missing + np.diag(prices)
    return missing if np.linalg.eigvalsh(whole)[0] > 0 else np.zeros_like(missing)


def exponential(matrices: NDArray) -> NDArray:
    """Return the exponentials of symmetric matrices (..., 3, 3)."""
    values, axes = np.linalg.eigh(matrices)
    return (axes * np.exp(values)[..., None, :]) @ np.swapaxes(axes, -1, -2)
