"""Leading singular triplets of a matrix, in memory or in blocks of frames."""

from functools import partial
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from isa_nrsfm._linalg.rounding import OF_PRODUCTS
from isa_nrsfm._linalg.vectors import energies
from isa_nrsfm._paper.options import SVD_OPTIONS, SvdOptions
from isa_nrsfm._tables.blocks import FrameBlocks, MemoryBlocks
from isa_nrsfm._tables.ordering import order_by_halves, spread


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
        Energy of the matrix that is left, the sum of its other squared singular values.
    """

    values: NDArray
    vectors: NDArray
    rest: float

    @property
    def rest_share(self) -> float:
        """Share of the energy that is outside these."""
        return float(self.rest / (np.sum(self.values**2) + self.rest))


def leading_triplets(W: NDArray, k: int, options: SvdOptions = SVD_OPTIONS) -> Triplets:
    """
    Return the largest singular values of a matrix, and their right vectors.

    Parameters
    ----------
    W : ndarray of shape (n_rows, n_columns)
        The matrix.
    k : int
        How many are wanted.
    options : SvdOptions
        How they are found.

    Returns
    -------
    Triplets
        As of `block_triplets`.
    """
    return block_triplets(MemoryBlocks([W], [len(W)]), (len(W), W.shape[1]), k, options)


def block_triplets(
    blocks: FrameBlocks,
    shape: tuple[int, int],
    k: int,
    options: SvdOptions = SVD_OPTIONS,
) -> Triplets:
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
    options : SvdOptions
        How they are found.

    Returns
    -------
    Triplets
        The triplets.

    Notes
    -----
    The right singular vectors of a tall matrix are those of its triangular factor,
    which is put together from those of the blocks (Demmel, Grigori, Hoemmen, Langou,
    "Communication-optimal parallel and sequential QR and LU factorizations", 2012).

    Of a matrix with many rows and many columns, the subspace of the leading right
    vectors comes from a block Krylov method (Golub, Van Loan, "Matrix computations",
    2013, section 10.3.6). The triplets are those of the matrix projected to it. They
    do not come from ``W^T W``, so small singular values keep their precision.
    """
    n_rows, n_columns = shape
    if min(shape) > max(options.dense, 4 * k):
        energy = sum(blocks.map(_energy))
        V = _leading_subspace(blocks, n_columns, k, energy, options)
        projected = _triangle(blocks, k, options.stacked, V)
        _, S, rotation = np.linalg.svd(projected, full_matrices=False)
        rest = max(float(energy - S @ S), 0.0)
        return Triplets(S, rotation @ V.T, rest)
    if n_rows > n_columns:
        matrix = _triangle(blocks, n_columns, options.stacked)
    else:
        matrix = blocks.whole().reshape(-1, n_columns)
    _, S, Vt = np.linalg.svd(matrix, full_matrices=False)
    return Triplets(S[:k], Vt[:k], float(np.sum(S[k:] ** 2)))


def _matrix(block: NDArray) -> NDArray:
    """Return the rows (n_rows, n_columns) of a block (n_frames, ..., n_columns)."""
    return block.reshape(-1, block.shape[-1])


def _energy(block: NDArray) -> float:
    """Return the sum of the squares of a block."""
    return float(energies(block).sum())


def _triangle(
    blocks: FrameBlocks, width: int, stacked: int, V: NDArray | None = None
) -> NDArray:
    """Return the triangular factor of a tall matrix W, or of W V with V given.

    `width` is the number of columns of W or W V, and V is (n_columns, width).
    """
    pending: list[NDArray] = []
    for part in blocks.map(partial(_block_triangle, V=V)):
        pending.append(part)
        if sum(map(len, pending)) > stacked * width:
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


def _leading_subspace(
    blocks: FrameBlocks, n_columns: int, k: int, energy: float, options: SvdOptions
) -> NDArray:
    """
    Return an orthonormal basis (n_columns, k) of the leading right singular vectors.

    A block Krylov method: each pass adds the block ``W^T W V`` to the basis, V being
    the last block. The first block is the leading subspace of some of the rows.

    The energy in the subspace grows with each pass, and the gains shrink by larger and
    larger factors. So the last two gains predict the next one, from above. The method
    ends when the predicted gain is below 1e-6 of the energy that is left.
    """
    # First block: the leading subspace of a sample of frames.
    width = k + options.oversampling
    n_frames = blocks.n_frames
    some = spread(order_by_halves(blocks), min(n_frames, 4 * width))
    sample = _matrix(blocks.take(np.sort(some))).astype(np.float64)
    last = np.linalg.qr(sample.T @ np.linalg.svd(sample @ sample.T)[0][:, :width])[0]
    basis, products = last, np.zeros((n_columns, 0))
    found, gains = 0.0, []
    for _ in range(options.most_passes):
        # One pass over the matrix. Ritz values and vectors of W^T W in the basis.
        products = np.hstack([products, sum(blocks.map(partial(_squared, V=last)))])
        gram = basis.T @ products
        values, axes = np.linalg.eigh(0.5 * (gram + gram.T))
        # Predict the gain of the next pass.
        before, found = found, float(values[-k:].sum())
        least_gain = options.converged * max(energy - found, OF_PRODUCTS * energy)
        gains.append(max(found - before, least_gain))
        next_gain = gains[-1]
        if len(gains) > 2:  # the first gain is the whole energy found
            next_gain *= min(gains[-1] / gains[-2], 1.0)
        if next_gain <= least_gain or basis.shape[1] + width > n_columns:
            break
        # The next block, orthogonalised against the basis. Rounding asks for two
        # rounds.
        last = products[:, -width:]
        for _ in range(2):
            last = np.linalg.qr(last - basis @ (basis.T @ last))[0]
        basis = np.hstack([basis, last])
    return basis[:, : len(axes)] @ axes[:, -k:]


def _squared(block: NDArray, V: NDArray) -> NDArray:
    """Return ``W^T W V`` (n_columns, width) for a block W of the matrix."""
    matrix = _matrix(block)
    return (matrix.T @ (matrix @ V.astype(matrix.dtype))).astype(np.float64)
