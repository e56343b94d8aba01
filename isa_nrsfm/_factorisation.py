"""Rigid and non-rigid factorisation of the measurement matrix by one SVD.

The rigid part is the factorisation of Tomasi and Kanade (1992); the non-rigid part
is what the next 3K singular triplets hold (Brandt et al. 2018, section 3).
"""

from functools import partial
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import null_space

from isa_nrsfm._frame_blocks import FrameBlocks, MemoryBlocks
from isa_nrsfm._sampling import order_by_halves, spread
from isa_nrsfm._tracks import energies

# A direction whose singular value is below this share of the first is null, whatever
# the precision of the table: it has less than 1e-20 of the energy.
NULL_DIRECTION = 1e-10
# Where both sides of W are longer than this only the leading triplets are computed.
DENSE = 1500
# Directions beyond those that are wanted that the search for them follows, the most
# passes over the matrix, and the gain of one, relative to what is left, that ends it.
OVERSAMPLING = 10
MOST_PASSES = 12
CONVERGED = 1e-6
# What is left counts as at least this share of the energy: rounding errors.
ROUNDING = 1e-14
# So many times its width is stacked before a triangular factor is made of it.
STACKED = 6


class Triplets(NamedTuple):
    """
    Leading singular values of a matrix, and their right vectors.

    Attributes
    ----------
    values : ndarray of shape (k,)
        Singular values, decreasing; fewer if the matrix does not have as many.
    vectors : ndarray of shape (k, n_columns)
        Their right singular vectors as rows. The left ones are ``W V / S``.
    rest : float
        Energy of the matrix outside these.
    """

    values: NDArray
    vectors: NDArray
    rest: float

    @property
    def rest_share(self) -> float:
        """Share of the energy that is outside these."""
        return float(self.rest / (np.sum(self.values**2) + self.rest))


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
        The 3K + 3 leading triplets of a matrix of which W holds some of the frames, by
        default of W.

    Returns
    -------
    Factorisation
        The factors; of the larger matrix those that belong to these frames.
    """
    n_points = W.shape[1]
    root = np.sqrt(n_points)
    if triplets is None:
        triplets = leading_triplets(W, 3 * n_components + 3)
    S, Vt, rest = triplets
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


def leading_triplets(W: NDArray, k: int) -> Triplets:
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
    Triplets
        As of `block_triplets`.
    """
    return block_triplets(MemoryBlocks([W], [len(W)]), (len(W), W.shape[1]), k)


def block_triplets(blocks: FrameBlocks, shape: tuple[int, int], k: int) -> Triplets:
    """
    Return the largest singular values of a matrix in blocks, and their right vectors.

    Parameters
    ----------
    blocks : FrameBlocks
        Blocks of the matrix (n_frames, ..., n_columns), each frame some of its rows.
    shape : tuple of int
        Numbers of its rows and columns.
    k : int
        How many are wanted.

    Returns
    -------
    Triplets
        The triplets.

    Notes
    -----
    The right singular vectors of a tall matrix are those of its triangular factor,
    which is put together from those of the blocks (Demmel, Grigori, Hoemmen, Langou,
    "Communication-optimal parallel and sequential QR and LU factorizations", 2012).

    A matrix that is large both ways is not factorised as a whole: the subspace of its
    leading right vectors comes from a block Krylov method (Golub, Van Loan, "Matrix
    computations", 2013, section 10.3.6), the triplets from the matrix projected to it,
    so that small singular values are as precise as the others.
    """
    n_rows, n_columns = shape
    if min(shape) > max(DENSE, 4 * k):
        V = _leading_subspace(blocks, n_columns, k)
        energy = sum(blocks.map(_energy))
        _, S, rotation = np.linalg.svd(_triangle(blocks, k, V), full_matrices=False)
        rest = max(float(energy - S @ S), 0.0)
        return Triplets(S, rotation @ V.T, rest)
    if n_rows > n_columns:
        matrix = _triangle(blocks, n_columns)
    else:
        matrix = blocks.whole().reshape(-1, n_columns)
    _, S, Vt = np.linalg.svd(matrix, full_matrices=False)
    return Triplets(S[:k], Vt[:k], float(np.sum(S[k:] ** 2)))


def _matrix(block: NDArray) -> NDArray:
    """Return the rows of a block."""
    return block.reshape(-1, block.shape[-1])


def _energy(block: NDArray) -> float:
    """Return the sum of the squares of a block."""
    return float(energies(block).sum())


def _triangle(blocks: FrameBlocks, width: int, V: NDArray | None = None) -> NDArray:
    """Return the triangular factor of a tall matrix, or of its product with V."""
    pending: list[NDArray] = []
    for part in blocks.map(partial(_block_triangle, V=V)):
        pending.append(part)
        if sum(map(len, pending)) > STACKED * width:
            pending = [_qr_factor(np.concatenate(pending))]
    return _qr_factor(np.concatenate(pending))


def _qr_factor(matrix: NDArray) -> NDArray:
    """Return the triangular factor of a matrix."""
    return np.asarray(np.linalg.qr(matrix, mode="r"))


def _block_triangle(block: NDArray, V: NDArray | None) -> NDArray:
    """Return the triangular factor of a block, or the block if it is not tall."""
    matrix = _matrix(block)
    if V is not None:
        matrix = matrix @ V
    matrix = matrix.astype(np.float64, copy=False)
    return _qr_factor(matrix) if len(matrix) > matrix.shape[1] else matrix


def _leading_subspace(blocks: FrameBlocks, n_columns: int, k: int) -> NDArray:
    """
    Return an orthonormal basis (n_columns, k) of the leading right singular vectors.

    It starts from those of some of the rows, and ends when another pass over the matrix
    would add less than 1e-6 of what is left to the energy that is found: what it adds
    shrinks from pass to pass, faster and faster.
    """
    width = k + OVERSAMPLING
    n_frames = blocks.n_frames
    some = spread(order_by_halves(blocks), min(n_frames, 4 * width))
    sample = _matrix(blocks.take(np.sort(some))).astype(np.float64)
    last = np.linalg.qr(sample.T @ np.linalg.svd(sample @ sample.T)[0][:, :width])[0]
    basis, products = last, np.zeros((n_columns, 0))
    energy = sum(blocks.map(_energy))
    found, gains = 0.0, []
    for _ in range(MOST_PASSES):
        products = np.hstack([products, sum(blocks.map(partial(_squared, V=last)))])
        gram = basis.T @ products
        values, axes = np.linalg.eigh(0.5 * (gram + gram.T))
        before, found = found, float(values[-k:].sum())
        little = CONVERGED * max(energy - found, ROUNDING * energy)
        gains.append(max(found - before, little))
        following = gains[-1]
        if len(gains) > 2:  # the first gain is from nothing
            following *= min(gains[-1] / gains[-2], 1.0)
        if following <= little or basis.shape[1] + width > n_columns:
            break
        last = products[:, -width:]
        for _ in range(2):  # twice is enough
            last = np.linalg.qr(last - basis @ (basis.T @ last))[0]
        basis = np.hstack([basis, last])
    return basis[:, : len(axes)] @ axes[:, -k:]


def _squared(block: NDArray, V: NDArray) -> NDArray:
    """Return the product of a block's transpose, the block and V."""
    matrix = _matrix(block)
    return (matrix.T @ (matrix @ V.astype(matrix.dtype))).astype(np.float64)


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
