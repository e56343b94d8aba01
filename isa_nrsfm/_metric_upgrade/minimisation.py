"""The metric of space in which cameras are most nearly scaled rotations.

The sum of squares of the residuals of `orthonormality` is minimised by damped
Gauss-Newton steps along geodesics, ``Q <- Q exp(E_0 / 2)``. After any step ``Q Q^T`` is
positive definite. So a minimum is found even where the linear equations for the entries
of G (`metric_quadric`) have an indefinite solution.
"""

from collections.abc import Callable
from typing import TypeVar

import numpy as np
from numpy.typing import NDArray

from isa_nrsfm._linalg.rounding import OF_PRODUCTS, OF_RANKS, OF_STEPS
from isa_nrsfm._metric_upgrade.quadric import mean_gram, symmetric_power, unit_cameras
from isa_nrsfm._metric_upgrade.residuals import (
    CameraModel,
    MetricFit,
    fit_at,
    strain_basis,
)

# Bound on the ratio of stretches of a metric to start from, in the space in which the
# cameras see all directions alike. Nearly singular metrics are near saddle points.
STRETCH_OF_START = 3.0

State = TypeVar("State")


def levenberg_marquardt(
    evaluated: Callable[[State], tuple[float, NDArray, NDArray]],
    state: State,
    moved: Callable[[State, NDArray], State],
    *,
    max_steps: int,
    shortest_step: float = 0.0,
    least_gain: float = -np.inf,
) -> tuple[State, float]:
    """
    Minimise a sum of squares.

    Parameters
    ----------
    evaluated : callable
        Returns the cost of a state, ``J^T J`` and ``J^T r`` with the residuals r and
        their derivatives J.
    state : object
        The first iterate.
    moved : callable
        Returns the state after a step (n_unknowns,).
    max_steps : int
        Largest number of steps.
    shortest_step, least_gain : float
        The iteration ends when no entry of a step is larger, or when a step gains less
        than this share of the cost.

    Returns
    -------
    state : object
        The last iterate.
    cost : float
        Its cost.
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


def safe_start(motion: NDArray, G: NDArray, camera: CameraModel) -> NDArray:
    """
    Return Q of a positive definite metric near to a symmetric G, to start from.

    In the space in which the mean of ``M_i^T M_i`` is the identity, it has the axes of
    G, and its stretches differ by at most the factor `STRETCH_OF_START`. Only
    orthographic cameras determine the scale of G.
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
    camera: CameraModel,
    ridge: float = 0.0,
    shortest_step: float = 1e-9,
) -> MetricFit:
    """
    Minimise ``sum_i |residuals_i|^2 + ridge * sum_k ||E_k||_F^2``.

    Parameters
    ----------
    motion : ndarray of shape (n_frames, 2, 3)
        Cameras, finite and not zero.
    alpha : ndarray of shape (n_frames, n_components)
        Coefficients of the strains.
    start : MetricFit
        The first iterate, of `fit_at` for these frames.
    camera : {"orthographic", "weak_perspective"}
        Model of the cameras.
    ridge : float, default=0.0
        Regularisation weight of the squared norm of the strains.
    shortest_step : float
        Convergence tolerance: the largest entry of a step.

    Returns
    -------
    MetricFit
        A minimum.
    """
    # The unknowns of a step are coordinates in this basis: those of E_0, which is zero
    # at each iterate, and those of the strains E_k.
    basis = strain_basis(camera)
    size = len(basis)
    ridges = np.repeat([0.0, ridge], [size, size * alpha.shape[1]])
    gram = np.einsum("ira,irb->ab", motion, motion)
    # Bound of the change of the metric of a frame by one entry of a step
    reach = 1.0 + np.abs(alpha).sum(axis=1).max(initial=0.0)

    def evaluated(fit: MetricFit) -> tuple[float, NDArray, NDArray]:
        """Return the objective; infinite where space hardly has depth.

        Noisy cameras that hardly turn fit the better, the deeper space becomes.
        """
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
