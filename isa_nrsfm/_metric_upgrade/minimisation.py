"""The metric of space in which cameras are most nearly scaled rotations.

The sum of squares of the residuals of `orthonormality` is minimised by damped
Gauss-Newton steps along geodesics, ``Q <- Q exp(E_0 / 2)``. After any step ``Q Q^T`` is
positive definite. So a minimum is found even where the linear equations for the entries
of G (`metric_quadric`) have an indefinite solution. Where the residuals are large,
Gauss-Newton steps converge slowly: ``J^T J`` lacks the second-order part of the
Hessian. That part is estimated from changes of the gradient, as in quasi-Newton
methods.
"""

import numpy as np
from numpy.typing import NDArray

from isa_nrsfm._linalg.rounding import OF_PRODUCTS, OF_RANKS
from isa_nrsfm._metric_upgrade.quadric import mean_gram, symmetric_power, unit_cameras
from isa_nrsfm._metric_upgrade.residuals import (
    Block,
    CameraModel,
    MetricFit,
    fit_at,
    frame_blocks,
    strain_basis,
)

# Bound on the ratio of stretches of a metric to start from, in the space in which the
# cameras see all directions alike. Nearly singular metrics are near saddle points.
STRETCH_OF_START = 3.0
MAX_STEPS = 200
# Convergence tolerance: the largest entry of a step.
SHORTEST_STEP = 1e-9
# Damping relative to the diagonal of the curvature: the first value, the factors after
# a step that succeeds and one that fails, and the largest value.
FIRST_DAMPING = 1e-3
EASED, STIFFENED = 0.2, 5.0
LARGEST_DAMPING = 1e10
# A step changes the logarithm of the metric of any frame by at most about this.
LONGEST_STEP = 2.0
# The rank-one update is skipped if its direction has a smaller cosine with the step:
# its denominator is then too near to zero.
LEAST_ALONG = 1e-8


def safe_start(motion: NDArray, G: NDArray, camera: CameraModel) -> NDArray:
    """
    Return a metric to start from, near to a given one.

    Parameters
    ----------
    motion : ndarray of shape (n_frames, 2, 3)
        Cameras, finite, which together see three directions of space.
    G : ndarray of shape (3, 3)
        A symmetric matrix, positive definite or not: the linear solution.
    camera : {"orthographic", "weak_perspective"}
        Only orthographic cameras determine the scale of G.

    Returns
    -------
    ndarray of shape (3, 3)
        Q of a positive definite metric. In the space in which the mean of ``M_i^T M_i``
        is the identity, it has the axes of the given one, and its stretches differ by
        at most the factor `STRETCH_OF_START`.
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
    Q: NDArray,
    camera: CameraModel,
    alpha: NDArray | None = None,
    ridge: float = 0.0,
    max_steps: int = MAX_STEPS,
) -> MetricFit:
    """
    Minimise the squared residuals of `orthonormality`, from a start without strains.

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
        Ridge: the regularisation weight of the squared norm of the strains.
    max_steps : int, default=200
        Largest number of steps.

    Returns
    -------
    MetricFit
        A minimum of ``sum_i |residuals_i|^2 + ridge * sum_k ||E_k||_F^2``.
    """
    if alpha is None:
        alpha = np.zeros((len(motion), 0))
    blocks = frame_blocks(motion, alpha)
    start = fit_at(blocks, Q, np.zeros((alpha.shape[1], 3, 3)), camera)
    return refine_fit(blocks, start, camera, ridge, max_steps=max_steps)


def refine_fit(
    blocks: list[Block],
    fit: MetricFit,
    camera: CameraModel,
    ridge: float,
    shortest_step: float = SHORTEST_STEP,
    max_steps: int = MAX_STEPS,
) -> MetricFit:
    """
    Minimise the squared residuals of `orthonormality`, from any fit.

    Parameters
    ----------
    blocks : list of tuple of ndarray
        Of `frame_blocks`.
    fit : MetricFit
        The start, of `fit_at` for these blocks.
    camera, ridge
        As of `refine_metric`.
    shortest_step : float
        Convergence tolerance: the largest entry of a step.
    max_steps : int, default=200
        Largest number of steps.

    Returns
    -------
    MetricFit
        As of `refine_metric`.
    """
    basis = strain_basis(camera)
    size = len(basis)
    # The unknowns of a step are coordinates in this basis: those of E_0, which is zero
    # at each iterate, and those of the strains E_k, in `numbers`. `ridges` is the
    # diagonal of the ridge. `second_order` estimates what J^T J lacks of the Hessian.
    # `reach` bounds the change of the metric of a frame by one entry of a step.
    numbers = np.einsum("kab,nab->kn", fit.strain, basis)
    ridges = np.repeat([0.0, ridge], [size, numbers.size])
    reach = 1.0 + max(np.abs(alpha).sum(axis=0).max(initial=0) for _, alpha in blocks)
    value = fit.cost + ridge * float(np.sum(numbers**2))
    damping = FIRST_DAMPING
    second_order = np.zeros_like(fit.curvature)
    gram = sum(np.einsum("pan,pbn->ab", M, M) for M, _ in blocks)
    for _ in range(max_steps):
        # Damped step, shortened to LONGEST_STEP.
        curvature = fit.curvature + second_order + np.diag(ridges)
        gradient = fit.gradient + ridges * np.append(np.zeros(size), numbers)
        scale = np.maximum(curvature.diagonal(), 1e-12 * curvature.diagonal().max())
        step = -np.linalg.lstsq(curvature + np.diag(damping * scale), gradient)[0]
        step *= min(1.0, LONGEST_STEP / max(reach * np.abs(step).max(), 1e-300))
        # The cost there.
        change = np.tensordot(step[:size], basis, 1)
        changed = numbers + step[size:].reshape(numbers.shape)
        new_Q = fit.Q @ exponential(change / 2)
        new = fit_at(blocks, new_Q, np.tensordot(changed, basis, 1), camera)
        new_value = new.cost + ridge * float(np.sum(changed**2))
        # Accept the step, or drop the estimated part of the Hessian, or damp more.
        better = new_value <= value * (1 + OF_PRODUCTS)
        if better and _shows_depth(gram, new_Q):
            second_order = _updated_second_order(second_order, step, fit, new, ridges)
            value, numbers, fit = new_value, changed, new
            damping *= EASED
        elif second_order.any():
            second_order = np.zeros_like(second_order)
        else:
            damping *= STIFFENED
        if np.abs(step).max() < shortest_step or damping > LARGEST_DAMPING:
            break
    return fit


def _updated_second_order(
    second_order: NDArray,
    step: NDArray,
    old: MetricFit,
    new: MetricFit,
    ridges: NDArray,
) -> NDArray:
    """
    Return the estimate of what ``J^T J`` lacks of the Hessian, updated after a step.

    This is the symmetric rank-one update (SR1; Nocedal, Wright, "Numerical
    optimization", 2006, chapter 6.2), after which the Hessian explains the change of
    the gradient. As in Dennis, Gay, Welsch ("An adaptive nonlinear least-squares
    algorithm", ACM Transactions on Mathematical Software 7, 1981), only the part beyond
    ``J^T J`` is updated. Zeros are returned where the Hessian would not be positive
    definite.

    Matrices are (n_unknowns, n_unknowns), the step and ridges are (n_unknowns,).
    """
    rest = new.gradient - old.gradient - (new.curvature + second_order) @ step
    along = rest @ step
    if abs(along) > LEAST_ALONG * np.linalg.norm(rest) * np.linalg.norm(step):
        second_order = second_order + np.outer(rest, rest) / along
    whole = new.curvature + second_order + np.diag(ridges)
    return (
        second_order
        if np.linalg.eigvalsh(whole)[0] > 0
        else np.zeros_like(second_order)
    )


def _shows_depth(gram: NDArray, Q: NDArray) -> bool:
    """Return whether cameras of a Gram matrix see three directions in a metric.

    Noisy cameras that hardly turn fit the better, the deeper space becomes.
    """
    values = np.linalg.eigvalsh(Q.T @ gram @ Q)
    return bool(values[0] > OF_RANKS * values[-1])


def exponential(matrices: NDArray) -> NDArray:
    """Return the exponentials of symmetric matrices (..., 3, 3)."""
    values, axes = np.linalg.eigh(matrices)
    return (axes * np.exp(values)[..., None, :]) @ np.swapaxes(axes, -1, -2)
