"""The basis of given shapes that is likeliest: a start, and the end without noise."""

import numpy as np
from numpy.typing import NDArray

from isa_nrsfm._linalg.rounding import OF_PRODUCTS
from isa_nrsfm._linalg.vectors import frames_last


def likely_basis(
    shapes: NDArray, motion: NDArray, alpha: NDArray, penalty: NDArray | float
) -> NDArray:
    """
    Return the same shapes in the basis of greatest marginal likelihood.

    Without noise neither a shift of the mean shape along the basis shapes nor a mixing
    A of these changes the residual: alpha becomes ``A^-1 (alpha - mean)``. Of the
    objective there remains, with n frames and ``H_kl = sum_i <M_i B_k, M_i B_l>``,

        n log det(A A^T) + sum_i ||A^-1 (alpha_i - mean)||^2 + penalty tr(A^T H A).

    First a basis is taken in which the covariance of the coefficients is the identity
    and H is diagonal. There the minimum is the diagonal A with

        a_k^2 = 2 / (1 + sqrt(1 + 4 penalty H_kk / n)).

    Parameters
    ----------
    shapes : ndarray of shape (n_shapes, 3, n_points)
        Mean shape and basis shapes.
    motion : ndarray of shape (n_frames, 2, 3)
        Cameras.
    alpha : ndarray of shape (n_frames, n_components)
        Coefficients.
    penalty : float
        As in `MarginalLikelihood`.

    Returns
    -------
    ndarray of shape (n_shapes, 3, n_points)
        Mean shape and basis shapes.
    """
    M, n_frames = frames_last(motion), len(motion)
    # Coefficients of mean zero
    mean = alpha.mean(axis=0)
    mean_shape = shapes[0] + np.tensordot(mean, shapes[1:], 1)
    # Coefficients of covariance one
    rest = alpha - mean
    covariance = rest.T @ rest / n_frames
    # A ridge, as the covariance can be singular
    covariance += (OF_PRODUCTS * np.trace(covariance) or 1.0) * np.eye(len(mean))
    basis = np.tensordot(np.linalg.cholesky(covariance).T, shapes[1:], 1)
    # Diagonal H / n, and the scales a_k
    cameras = np.einsum("rai,rbi->ab", M, M) / n_frames
    energy, axes = np.linalg.eigh(np.einsum("ab,kaj,lbj->kl", cameras, basis, basis))
    price = penalty * np.maximum(energy, 0.0)
    scale = np.sqrt(2.0 / (1.0 + np.sqrt(1.0 + 4.0 * price)))
    basis = scale[:, None, None] * np.tensordot(axes.T, basis, 1)
    return np.concatenate([mean_shape[None], basis])
