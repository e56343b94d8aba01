"""Rigid and non-rigid factorisation of the measurement matrix by one SVD.

The rigid part is the factorisation of Tomasi and Kanade (1992). The non-rigid part
consists of the next 3K singular triplets (Brandt et al. 2018, section 3).
"""

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import null_space

from isa_nrsfm._linalg.rounding import OF_RANKS
from isa_nrsfm._linalg.small_matrices import orientations
from isa_nrsfm._paper.svd import Triplets, leading_triplets


class Factorisation(NamedTuple):
    """Rigid and non-rigid part of W, ``W ~ M_0 B_0 + M' B'`` of rank 3K + 3.

    rigid_motion (2I, 3): M_0, two rows per frame; columns are orthogonal. rigid_shape
    (3, J): B_0, centred and white: ``B_0 B_0^T = n_points I``. Rows are zero where W
    has a rank below 3. motion (2I, n_signals): M', by decreasing column norm. signals
    (n_signals, J): B', centred and white, orthogonal to B_0. `n_signals` is 3K, or
    where W has a lower rank the least multiple of three above it.
    """

    rigid_motion: NDArray
    rigid_shape: NDArray
    motion: NDArray
    signals: NDArray


def factorise(
    W: NDArray,
    n_components: int,
    precision: float = 0.0,
    triplets: Triplets | None = None,
) -> Factorisation:
    """Return the rigid and the non-rigid factors of centred W (2 * n_frames, n_points).

    `precision` is the rounding error of its entries, relative to their RMS. `triplets`
    are at least the 3K + 3 leading ones of a larger matrix, by default of W.
    """
    n_points = W.shape[1]
    S, Vt, _ = triplets or leading_triplets(W, 3 * n_components + 3)
    # Rows of Vt above rounding errors, centred, their signs fixed.
    rank = int(np.sum(S > max(OF_RANKS, precision) * S[0]))
    rank = min(rank, 3 * n_components + 3)
    Vt = Vt[:rank] - Vt[:rank].mean(axis=1, keepdims=True)
    Vt *= orientations(Vt)[:, None]
    # The first three are the rigid shape, the next ones the signals.
    root = np.sqrt(n_points)
    B_0 = np.zeros((3, n_points))
    B_0[: min(rank, 3)] = root * Vt[:3]
    signals = Vt[3:]
    n_missing = 3 * max(1, -(-(rank - 3) // 3)) - len(signals)
    if n_missing:  # completed by centred, orthonormal rows, orthogonal to Vt
        others = null_space(np.vstack([np.ones((1, n_points)), Vt])).T
        signals = np.vstack([signals, others[:n_missing]])
    B = root * signals
    M = W @ B.T / n_points
    M[:, max(rank - 3, 0) :] = 0.0
    return Factorisation(W @ B_0.T / n_points, B_0, M, B)
