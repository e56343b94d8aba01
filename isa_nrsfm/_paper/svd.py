"""Leading singular triplets of a matrix, in memory or in blocks of frames."""

from functools import partial
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import null_space

from isa_nrsfm._linalg.vectors import energies
from isa_nrsfm._tables.blocks import FrameBlocks, MemoryBlocks
from isa_nrsfm._tables.ordering import order_by_halves, spread

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


def _complete(Vt: NDArray, n_signals: int) -> NDArray:
    """Return the non-rigid rows of Vt, completed by centred orthonormal rows."""
    rows = Vt[3:]
    n_missing = n_signals - len(rows)
    if n_missing:
        ones = np.ones((1, Vt.shape[1]))
        rows = np.vstack([rows, null_space(np.vstack([ones, Vt])).T[:n_missing]])
    return rows
