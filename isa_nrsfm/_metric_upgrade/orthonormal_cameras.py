"""Mixtures of the columns of a motion factor whose rows are orthonormal: cameras."""

from itertools import combinations
from operator import itemgetter

import numpy as np
from numpy.typing import NDArray

from isa_nrsfm._linalg.rounding import OF_STEPS
from isa_nrsfm._metric_upgrade.metric import (
    levenberg_marquardt,
    normal_equations,
)

# Number of columns that are added at a time: a basis shape has three.
STEP = 3


def orthonormal_mixture(
    basis: NDArray, mixing: NDArray, penalty: NDArray | None = None, max_iter: int = 200
) -> tuple[NDArray, float]:
    """Mix columns such that rows are most nearly orthonormal; return Q (n, 3) and cost.

    The columns (2 I, n) are about as long as columns of cameras. `mixing` (n_before, 3)
    is the start, the best mixture of the first columns. If there are three of these,
    each triple of columns is another start. The cost is the mean over the frames of the
    squared norm of `orthonormality_residuals`, plus a penalty ``||L Q||_F^2``.
    """
    n = basis.shape[1]
    L = np.zeros((0, n)) if penalty is None else penalty

    def evaluated(Q: NDArray) -> tuple[float, NDArray, NDArray]:
        return normal_equations(*_linearised(Q, basis, L))

    def minimised(Q: NDArray, max_steps: int) -> tuple[NDArray, float, NDArray]:
        return levenberg_marquardt(
            evaluated,
            Q,
            lambda Q, step: Q + step.reshape(Q.shape),
            max_steps=max_steps,
            least_gain=1e-9,
        )

    start = np.vstack([mixing, np.zeros((n - len(mixing), 3))])
    if len(mixing) == 3 < n <= 3 + STEP:
        # The best of about twenty starts after some steps leads to the least cost, or
        # close to it.
        triples = [np.column_stack(triple) for triple in combinations(np.eye(n), 3)]
        rough = [minimised(Q, 8) for Q in (start, *triples)]
        start, *_ = min(rough, key=itemgetter(1))
    return minimised(start, max_iter)[:2]


def orthonormality_residuals(cameras: NDArray) -> NDArray:
    """Return ``|r1|^2 - 1``, ``|r2|^2 - 1``, ``sqrt(2) r1 . r2`` of cameras (n, 2, 3).

    The sum of their squares is ``||R_i R_i^T - I||_F^2``. The result is (3, n).
    """
    r1, r2 = cameras[:, 0], cameras[:, 1]
    across = np.sqrt(2.0) * np.vecdot(r1, r2)
    return np.stack([np.vecdot(r1, r1) - 1.0, np.vecdot(r2, r2) - 1.0, across])


def _linearised(Q: NDArray, basis: NDArray, L: NDArray) -> tuple[NDArray, NDArray]:
    """Return residuals (n,) of Q and their Jacobian (n, 3 * n_columns)."""
    n_frames = len(basis) // 2
    P, R = basis.reshape(n_frames, 2, -1, 1), (basis @ Q).reshape(n_frames, 2, 1, 3)
    p1, p2, r1, r2 = P[:, 0], P[:, 1], R[:, 0], R[:, 1]
    residuals = orthonormality_residuals(R[:, :, 0]).ravel() / np.sqrt(n_frames)
    rows = np.stack([2.0 * p1 * r1, 2.0 * p2 * r2, np.sqrt(2.0) * (p1 * r2 + p2 * r1)])
    rows = rows.reshape(3 * n_frames, -1) / np.sqrt(n_frames)
    return (
        np.concatenate([residuals, (L @ Q).ravel()]),
        np.concatenate([rows, np.kron(L, np.eye(3))]),
    )


def principal_columns(W: NDArray) -> NDArray:
    """Return left singular vectors (2 I, rank) of W, as long as columns of cameras."""
    square, V = np.linalg.eigh(W.T @ W)
    kept = np.flatnonzero(square > OF_STEPS * square[-1])[::-1]
    return W @ (V[:, kept] * np.sqrt(len(W) / 3 / square[kept]))
