"""Rigid and non-rigid factorisation of the measurement matrix by one SVD.

The rigid part is the factorisation of Tomasi and Kanade (1992). The non-rigid part
consists of the next 3K singular triplets (Brandt et al. 2018, section 3). The matrix of
a large table is read in blocks, and its factors are those of a sample of its frames,
spread evenly from the most to the least rigid one: their order does not matter.
"""

from functools import partial
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import null_space

from isa_nrsfm._linalg.rounding import OF_RANKS
from isa_nrsfm._linalg.small_matrices import energies, orientations
from isa_nrsfm._tables.blocks import FrameBlocks, spread

# Larger matrices, with more rows and more columns, are not factorised as a whole.
DENSE = 1500
# Leading singular values of a matrix (k,), decreasing, their right vectors (k,
# n_columns), and the sum of the other squared values. Fewer if the rank is lower.
Triplets = tuple[NDArray, NDArray, float]


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


def sample_frames(
    rows: FrameBlocks,
    n_points: int,
    rigid_shape: NDArray,
    first: int = 600,
    small_table: int = 150_000,
) -> tuple[NDArray, list[NDArray]]:
    """
    Return the completed measurement matrix of a first sample, and growing samples.

    Rows are blocks of complete frames (n, 2, n_points). The samples are indices; the
    first one has the frames of the matrix. If a table has fewer coordinates than
    `small_table`, the matrix has all frames, and there are no samples.
    """
    n_frames = rows.n_frames
    parts: list[NDArray] = []
    if 2 * n_frames * n_points >= small_table and n_frames > first:
        energy = rows.joined(partial(rigid_energy, shape=rigid_shape))
        order = np.argsort(energy, kind="stable")
        n = first
        while not parts or n < min(n_frames / 2, 40_000):
            parts.append(np.sort(spread(order, n)))
            n *= 4
    W = rows.take(parts[0]) if parts else rows.whole()
    return W.reshape(-1, n_points).astype(np.float64, copy=False), parts


def rigid_energy(rows: NDArray, shape: NDArray) -> NDArray:
    """Return ``min_M ||W_i - M shape||_F^2`` (I,) of rows (I, 2, J)."""
    axes, size, _ = np.linalg.svd(shape.T, full_matrices=False)
    axes = axes[:, size > OF_RANKS * size[0]]
    seen = (rows.reshape(-1, rows.shape[-1]) @ axes).reshape(len(rows), -1)
    return np.maximum(energies(rows) - energies(seen), 0.0)


def leading_triplets(W: NDArray, k: int, dense: int = DENSE) -> Triplets:
    """Return the k leading triplets of a matrix (n_rows, n_columns) in memory."""
    blocks = FrameBlocks.of_blocks([W], [len(W)])
    return block_triplets(blocks, (len(W), W.shape[1]), k, dense)


def block_triplets(
    blocks: FrameBlocks, shape: tuple[int, int], k: int, dense: int = DENSE
) -> Triplets:
    """
    Return the k leading triplets of a matrix in blocks of frames (n, ..., n_columns).

    The right singular vectors of a tall matrix equal those of its triangular factor,
    which is assembled from the factors of the blocks (Demmel, Grigori, Hoemmen, Langou,
    "Communication-optimal parallel and sequential QR and LU factorizations", 2012). For
    a matrix with many rows and columns, four passes of a randomised block Krylov method
    find the leading right subspace (Musco, Musco, "Randomized block Krylov methods for
    stronger and faster approximate singular value decomposition", 2015).
    """
    n_rows, n_columns = shape
    if min(shape) > max(dense, 4 * (k + 10)):
        energy = sum(blocks.map(lambda block: float(energies(block).sum())))
        V = np.random.default_rng(0).standard_normal((n_columns, k + 10))
        krylov = []
        for _ in range(4):
            V = np.linalg.qr(sum(blocks.map(partial(_squared, V=V))))[0]
            krylov.append(V)
        V = np.linalg.qr(np.hstack(krylov))[0]
        _, S, rotation = np.linalg.svd(_triangle(blocks, V.shape[1], V))
        S, Vt = S[:k], rotation[:k] @ V.T
        rest = max(energy - S @ S, 0.0)
    else:
        tall = n_rows > n_columns
        matrix = _triangle(blocks, n_columns) if tall else _matrix(blocks.whole())
        _, S, Vt = np.linalg.svd(matrix, full_matrices=False)
        S, Vt, rest = S[:k], Vt[:k], np.sum(S[k:] ** 2)
    return S, Vt, float(rest)


def _matrix(block: NDArray) -> NDArray:
    """Return the rows (n_rows, n_columns) of a block (n_frames, ..., n_columns)."""
    return block.reshape(-1, block.shape[-1])


def _triangle(blocks: FrameBlocks, width: int, V: NDArray | None = None) -> NDArray:
    """Return the triangular factor (width, width) of W, or of W V with V given."""
    pending: list[NDArray] = []
    for part in blocks.map(partial(_block_triangle, V=V)):
        pending.append(part)
        if sum(map(len, pending)) > 6 * width:
            pending = [np.asarray(np.linalg.qr(np.concatenate(pending), mode="r"))]
    return np.asarray(np.linalg.qr(np.concatenate(pending), mode="r"))


def _block_triangle(block: NDArray, V: NDArray | None) -> NDArray:
    """Return the triangular factor of a block, or the block if it is not tall."""
    matrix = _matrix(block) if V is None else _matrix(block) @ V
    matrix = matrix.astype(np.float64, copy=False)
    tall = len(matrix) > matrix.shape[1]
    return np.asarray(np.linalg.qr(matrix, mode="r")) if tall else matrix


def _squared(block: NDArray, V: NDArray) -> NDArray:
    """Return ``W^T W V`` (n_columns, width) for a block W of the matrix."""
    matrix = _matrix(block)
    return ((matrix @ V.astype(matrix.dtype)).T @ matrix).T.astype(np.float64)
