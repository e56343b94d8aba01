"""The fixed-point iteration of FastISA on a batch of starts."""

import numpy as np
from numpy.typing import NDArray

from isa_nrsfm.isa._density import SubspaceDensity


def orthogonalise(W: NDArray) -> NDArray:
    """Return the orthogonal matrices ``(W W^T)^(-1/2) W`` nearest to W (n_batch, n, n).

    Eigenvectors of ``W W^T`` take two thirds of the time of an SVD of W. One Newton
    step restores the precision that squaring costs (Higham 2008, chapter 8).
    """
    values, axes = np.linalg.eigh(W @ W.swapaxes(-1, -2))
    poor = values[:, 0] <= 1e-8 * values[:, -1]  # nearly singular
    values[poor] = 1.0
    nearest = (axes / np.sqrt(values)[:, None]) @ (axes.swapaxes(-1, -2) @ W)
    error = nearest @ nearest.swapaxes(-1, -2) - np.eye(W.shape[-1])
    nearest -= 0.5 * error @ nearest
    if poor.any():
        U, _, Vt = np.linalg.svd(W[poor])
        nearest[poor] = U @ Vt
    return nearest


def subspace_energies(Y: NDArray, subspace_size: int) -> NDArray:
    """Return energies (..., n_subspaces, n_samples) of Y (..., n_signals, n_samples).

    Consecutive rows form a subspace.
    """
    *batch, _, n_samples = Y.shape
    return (Y * Y).reshape(*batch, -1, subspace_size, n_samples).sum(axis=-2)


def log_likelihood(
    W: NDArray, Z: NDArray, subspace_size: int, density: SubspaceDensity
) -> NDArray:
    """Return ``sum_k E F(u_k)``, the mean log-likelihood of a sample up to a constant.

    W is (..., n_signals, n_signals), orthogonal, Z (n_signals, n_samples), white.
    """
    u = subspace_energies(W @ Z, subspace_size)
    return density.log_density(u).mean(axis=-1).sum(axis=-1)


def fixed_point_step(
    W: NDArray,
    Z: NDArray,
    subspace_size: int,
    density: SubspaceDensity,
    length: NDArray | float = 1.0,
) -> NDArray:
    """Return W (n_batch, n, n) after one step of FastISA (Hyvarinen and Koster 2006).

    A row w of subspace k, with y = w z, becomes ``E[z y g(u_k)] - E[g(u_k) + 2 y^2
    g'(u_k)] w``. Then W is orthogonalised. If the step length (n_batch,) is below 1.0,
    a multiple of w is added. Each row then turns by about this share of the full step.
    The fixed points are the same.
    """
    n_batch, n_signals, n_samples = len(W), *Z.shape
    Y = (W @ Z).reshape(n_batch, -1, subspace_size, n_samples)
    square = Y * Y
    g, dg = density.derivatives(square.sum(axis=2))
    curvature = g.sum(axis=-1)[..., None] + 2.0 * np.vecdot(square, dg[:, :, None])
    Y *= g[:, :, None]
    step = Y.reshape(n_batch, n_signals, n_samples) @ Z.T
    step -= curvature.reshape(n_batch, n_signals, 1) * W
    kept = np.vecdot(step, W) * (1.0 / np.reshape(length, (-1, 1)) - 1.0)
    step += kept[..., None] * W
    return orthogonalise(step)


def subspace_change(W: NDArray, W_new: NDArray, subspace_size: int) -> NDArray:
    """
    Return the largest change (n_batch,) of a subspace between two orthogonal matrices.

    It is ``||P_k - P_new,k||_F^2 / (2 d)`` with projectors ``P_k = W_k^T W_k``, the
    mean square sine of the d principal angles: rows may rotate inside their subspace.
    """
    shape = (len(W), -1, subspace_size, W.shape[-1])
    cosines = W.reshape(shape) @ W_new.reshape(shape).swapaxes(-1, -2)
    return np.max(1.0 - np.sum(cosines**2, axis=(-1, -2)) / subspace_size, axis=1)


def iterate(
    W: NDArray,
    Z: NDArray,
    subspace_size: int,
    density: SubspaceDensity,
    *,
    max_iter: int,
    tol: float,
) -> tuple[NDArray, NDArray, NDArray]:
    """Repeat `fixed_point_step` on each start until `subspace_change` is below `tol`.

    With few samples the published iteration mostly ends in cycles. If a start cycles,
    its step length is halved. Returns the last iterates (n_batch, n, n), and for each
    start the number of steps and whether it has converged.
    """
    W = W.copy()
    n_iter = np.zeros(len(W), dtype=int)
    converged = np.zeros(len(W), dtype=bool)
    running = np.arange(len(W))
    length = np.ones(len(W))
    least_change = np.full(len(W), np.inf)
    waited = np.zeros(len(W), dtype=int)
    for _ in range(max_iter):
        # A step of each running start. Its change is scaled to a step of length 1.
        lengths = length[running]
        new = fixed_point_step(W[running], Z, subspace_size, density, lengths)
        change = subspace_change(W[running], new, subspace_size) / lengths**2
        W[running] = new
        n_iter[running] += 1

        # Halve the step length of starts whose change has not fallen for ten steps.
        nearer = change < least_change[running]
        least_change[running[nearer]] = change[nearer]
        waited[running] = np.where(nearer, 0, waited[running] + 1)
        cycling = running[waited[running] >= 10]
        length[cycling] = np.maximum(length[cycling] / 2, 1 / 16)
        waited[cycling] = 0

        # Starts that have converged stop.
        still = change < tol
        converged[running[still]] = True
        running = running[~still]
        if not len(running):
            break
    return W, n_iter, converged
