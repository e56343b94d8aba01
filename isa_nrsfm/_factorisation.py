"""Rigid and non-rigid factorisation of the measurement matrix by one SVD.

The rigid part is the factorisation of Tomasi and Kanade (1992); the non-rigid part
is what the next 3K singular triplets hold (Brandt et al. 2018, section 3).
"""

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import null_space
from scipy.sparse.linalg import svds

# A direction whose singular value is below this share of the first is null, whatever
# the precision of the table: it has less than 1e-20 of the energy.
NULL_DIRECTION = 1e-10
# Where both sides of W are longer than this only the leading triplets are computed.
DENSE = 1500


class Factorisation(NamedTuple):
    """
    Rigid and non-rigid part of a measurement matrix W.

    ``W ~ M_0 B_0 + M' B'``, the best approximation of rank 3K + 3.

    Attributes
    ----------
    rigid_motion : ndarray of shape (2 * n_frames, 3)
        M_0, two rows a frame; its columns are orthogonal.
    rigid_shape : ndarray of shape (3, n_points)
        B_0, centred and white: ``B_0 B_0^T = n_points I``, but for rows of zeros
        where W has a rank below 3.
    motion : ndarray of shape (2 * n_frames, n_signals)
        M', by decreasing column norm.
    signals : ndarray of shape (n_signals, n_points)
        B', centred and white, orthogonal to B_0. `n_signals` is 3K, or the least
        multiple of three that holds every direction with a singular value above
        rounding errors.
    singular_values : ndarray of shape (3K + 3,)
        Largest singular values of W, decreasing; fewer if W does not have as many.
    rest : float
        Energy of W outside these, the sum of the squares of the others.
    """

    rigid_motion: NDArray
    rigid_shape: NDArray
    motion: NDArray
    signals: NDArray
    singular_values: NDArray
    rest: float


def factorise(W: NDArray, n_components: int, precision: float = 0.0) -> Factorisation:
    """
    Return the rigid and the non-rigid factors of a measurement matrix.

    Parameters
    ----------
    W : ndarray of shape (2 * n_frames, n_points)
        Measurement matrix, rows centred.
    n_components : int
        K, the number of basis shapes.
    precision : float, default=0.0
        Rounding error of the entries of W, relative to their root mean square.

    Returns
    -------
    Factorisation
        The factors.
    """
    n_points = W.shape[1]
    root = np.sqrt(n_points)
    S, Vt, rest = leading_triplets(W, 3 * n_components + 3)
    null = max(NULL_DIRECTION, precision) * S[0]
    rank = int(np.sum(S > null))
    Vt = Vt[:rank] - Vt[:rank].mean(axis=1, keepdims=True)
    Vt *= orientations(Vt)[:, None]

    B_0 = np.zeros((3, n_points))
    B_0[: min(rank, 3)] = root * Vt[:3]
    B = _complete(Vt, 3 * max(1, -(-(rank - 3) // 3))) * root
    M = W @ B.T / n_points
    M[:, max(rank - 3, 0) :] = 0.0
    return Factorisation(W @ B_0.T / n_points, B_0, M, B, S, rest)


def leading_triplets(W: NDArray, k: int) -> tuple[NDArray, NDArray, float]:
    """
    Return the largest singular values of a matrix, and their right vectors.

    Parameters
    ----------
    W : ndarray of shape (n_rows, n_columns)
        The matrix.
    k : int
        How many are wanted.

    Returns
    -------
    values : ndarray of shape (k,)
        Singular values, decreasing; fewer if W does not have as many.
    vectors : ndarray of shape (k, n_columns)
        Their right singular vectors as rows. The left ones are ``W V / S``.
    rest : float
        Energy of W outside these.

    Notes
    -----
    A W that is large both ways is not factorised as a whole: the subspace of its
    leading right vectors comes from the Krylov method of ARPACK (Lehoucq, Sorensen,
    Yang, "ARPACK users' guide", 1998), the triplets from W projected to it, so that
    small singular values are as precise as the others.
    """
    if min(W.shape) > max(DENSE, 4 * k):
        start = np.linalg.norm(W, axis=0)  # the same whatever the order of the frames
        V = svds(W, k, v0=start if len(W) > W.shape[1] else W @ start)[2].T
        _, S, rotation = np.linalg.svd(W @ V, full_matrices=False)
        rest = max(float(np.vdot(W, W) - S @ S), 0.0)
        return S, rotation @ V.T, rest
    # The left singular vectors are W V / S: the triangular factor has S and V.
    R = np.linalg.qr(W, mode="r") if len(W) > W.shape[1] else W
    _, S, Vt = np.linalg.svd(R, full_matrices=False)
    return S[:k], Vt[:k], float(np.sum(S[k:] ** 2))


def orientations(rows: NDArray) -> NDArray:
    """
    Return a sign for each row: that of its third moment.

    The sign does not depend on the order of the entries. Where the third moment
    vanishes the entry of largest magnitude decides, in the order of the entries.

    Parameters
    ----------
    rows : ndarray of shape (n_rows, n_entries)
        Rows, each known up to its sign.

    Returns
    -------
    ndarray of shape (n_rows,)
        1.0 or -1.0.
    """
    largest = np.abs(rows).max(axis=1, keepdims=True)
    scaled = np.divide(rows, largest, out=np.zeros_like(rows), where=largest > 0)
    moment = np.sum(scaled**3, axis=1)
    decisive = np.abs(moment) > 1e-9 * np.sum(np.abs(scaled) ** 3, axis=1)
    extreme = scaled[np.arange(len(rows)), np.abs(scaled).argmax(axis=1)]
    return np.where(np.where(decisive, moment, extreme) < 0, -1.0, 1.0)


def _complete(Vt: NDArray, n_signals: int) -> NDArray:
    """Return the non-rigid rows of Vt, completed by centred orthonormal rows."""
    rows = Vt[3:]
    n_missing = n_signals - len(rows)
    if n_missing:
        ones = np.ones((1, Vt.shape[1]))
        rows = np.vstack([rows, null_space(np.vstack([ones, Vt])).T[:n_missing]])
    return rows
