"""Rigid and non-rigid factorisation of the measurement matrix by one SVD.

The rigid part is the factorisation of Tomasi and Kanade (1992); the non-rigid part
is what the next 3K singular triplets hold (Brandt et al. 2018, section 3).
"""

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import null_space

from isa_nrsfm._linalg.rounding import OF_RANKS
from isa_nrsfm._linalg.vectors import orientations
from isa_nrsfm._paper.svd import Triplets, leading_triplets


class Factorisation(NamedTuple):
    """
    Rigid and non-rigid part of a measurement matrix W.

    ``W ~ M_0 B_0 + M' B'``, the best approximation of rank 3K + 3.

    Attributes
    ----------
    rigid_motion : ndarray of shape (2 * n_frames, 3)
        M_0, two rows a frame; its columns are orthogonal.
    rigid_shape : ndarray of shape (3, n_points)
        B_0, centred and white: ``B_0 B_0^T = n_points I``. Rows are zero where W has a
        rank below 3.
    motion : ndarray of shape (2 * n_frames, n_signals)
        M', by decreasing column norm.
    signals : ndarray of shape (n_signals, n_points)
        B', centred and white, orthogonal to B_0. `n_signals` is 3K, or less where W has
        a lower rank: the least multiple of three with room for all singular values
        above rounding errors.
    singular_values : ndarray of shape (3K + 3,)
        Largest singular values of W, decreasing; fewer if W does not have as many.
    rest : float
        Energy of W that is left: the sum of the squares of its other singular values.
    """

    rigid_motion: NDArray
    rigid_shape: NDArray
    motion: NDArray
    signals: NDArray
    singular_values: NDArray
    rest: float


def factorise(
    W: NDArray,
    n_components: int,
    precision: float = 0.0,
    triplets: Triplets | None = None,
) -> Factorisation:
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
    triplets : Triplets, optional
        The 3K + 3 leading triplets of a larger matrix, of which W has some of the
        frames. By default those of W are computed.

    Returns
    -------
    Factorisation
        The factors. With triplets of a larger matrix, its factors for these frames.
    """
    n_points = W.shape[1]
    root = np.sqrt(n_points)
    if triplets is None:
        triplets = leading_triplets(W, 3 * n_components + 3)
    S, Vt, rest = triplets
    # Rows of Vt above rounding errors, centred, their signs fixed.
    null = max(OF_RANKS, precision) * S[0]
    rank = int(np.sum(S > null))
    Vt = Vt[:rank] - Vt[:rank].mean(axis=1, keepdims=True)
    Vt *= orientations(Vt)[:, None]

    # The first three are the rigid shape, the next ones the signals.
    B_0 = np.zeros((3, n_points))
    B_0[: min(rank, 3)] = root * Vt[:3]
    B = _completed(Vt, 3 * max(1, -(-(rank - 3) // 3))) * root
    M = W @ B.T / n_points
    M[:, max(rank - 3, 0) :] = 0.0
    return Factorisation(W @ B_0.T / n_points, B_0, M, B, S, rest)


def _completed(Vt: NDArray, n_signals: int) -> NDArray:
    """Return rows 3 onwards of Vt (rank, n_points), completed to n_signals rows.

    The rows that are added are centred, orthonormal, and orthogonal to Vt.
    """
    rows = Vt[3:]
    n_missing = n_signals - len(rows)
    if n_missing:
        ones = np.ones((1, Vt.shape[1]))
        rows = np.vstack([rows, null_space(np.vstack([ones, Vt])).T[:n_missing]])
    return rows
