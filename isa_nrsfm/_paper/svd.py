"""Leading singular triplets of a matrix, in memory or in blocks of frames."""

from functools import partial
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from isa_nrsfm._linalg.rounding import OF_PRODUCTS
from isa_nrsfm._linalg.small_matrices import energies
from isa_nrsfm._tables.blocks import FrameBlocks
from isa_nrsfm._tables.ordering import order_by_halves, spread

# Larger matrices, with more rows and more columns, are not factorised as a whole.
DENSE = 1500


class Triplets(NamedTuple):
    """Leading singular values of a matrix, decreasing, and their right vectors.

    Fewer values (k,) and vectors (k, n_columns) if the rank is lower; the left ones are
    ``W V / S``. `rest` is the sum of the other squared singular values.
    """

    values: NDArray
    vectors: NDArray
    rest: float

    @property
    def rest_share(self) -> float:
        """Share of the energy outside the leading triplets."""
        return float(self.rest / (np.sum(self.values**2) + self.rest))


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
    a matrix with many rows and columns, a block Krylov method finds the leading right
    subspace (Golub, Van Loan, "Matrix computations", 2013, section 10.3.6). As ``W^T
    W`` is never formed, small singular values keep their precision.
    """
    n_rows, n_columns = shape
    if min(shape) > max(dense, 4 * k):
        energy = sum(blocks.map(lambda block: float(energies(block).sum())))
        V = _leading_subspace(blocks, n_columns, k, energy)
        _, S, rotation = np.linalg.svd(_triangle(blocks, k, V), full_matrices=False)
        return Triplets(S, rotation @ V.T, max(float(energy - S @ S), 0.0))
    if n_rows > n_columns:
        matrix = _triangle(blocks, n_columns)
    else:
        matrix = _matrix(blocks.whole())
    _, S, Vt = np.linalg.svd(matrix, full_matrices=False)
    return Triplets(S[:k], Vt[:k], float(np.sum(S[k:] ** 2)))


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


def _leading_subspace(
    blocks: FrameBlocks, n_columns: int, k: int, energy: float
) -> NDArray:
    """Return an orthonormal basis (n_columns, k) of the leading right singular vectors.

    Each pass of the block Krylov method adds ``W^T W V``, V being the last block. The
    gains of energy shrink by larger and larger factors, so the last two bound the next
    one. The method ends when that bound is below 1e-6 of the energy that is left.
    """
    # First block: the leading subspace of a sample of frames.
    width = k + 10
    some = spread(order_by_halves(blocks), min(blocks.n_frames, 4 * width))
    sample = _matrix(blocks.take(np.sort(some))).astype(np.float64)
    last = np.linalg.qr(sample.T @ np.linalg.svd(sample @ sample.T)[0][:, :width])[0]
    basis, products, found = last, np.zeros((n_columns, 0)), [0.0]
    for _ in range(12):
        # One pass over the matrix. Ritz values and vectors of W^T W in the basis.
        products = np.hstack([products, sum(blocks.map(partial(_squared, V=last)))])
        gram = basis.T @ products
        values, axes = np.linalg.eigh(0.5 * (gram + gram.T))
        # Bound on the next gain; the first gain is the whole energy found.
        found.append(float(values[-k:].sum()))
        least_gain = 1e-6 * max(energy - found[-1], OF_PRODUCTS * energy)
        gains = np.maximum(np.diff(found), least_gain)
        shrinks = min(gains[-1] / gains[-2], 1.0) if len(gains) > 2 else 1.0
        if shrinks * gains[-1] <= least_gain or basis.shape[1] + width > n_columns:
            break
        # The next block, orthogonalised twice against the basis because of rounding.
        last = products[:, -width:]
        for _ in range(2):
            last = np.linalg.qr(last - basis @ (basis.T @ last))[0]
        basis = np.hstack([basis, last])
    return basis[:, : len(axes)] @ axes[:, -k:]


def _squared(block: NDArray, V: NDArray) -> NDArray:
    """Return ``W^T W V`` (n_columns, width) for a block W of the matrix."""
    matrix = _matrix(block)
    return ((matrix @ V.astype(matrix.dtype)).T @ matrix).T.astype(np.float64)
