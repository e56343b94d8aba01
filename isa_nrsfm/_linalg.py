"""Algebra of many small matrices, symmetric ones packed, and of rows of numbers.

The index of a packed matrix is the last one: each operation is one pass over long rows
of numbers, faster than a call of LAPACK for each matrix of up to `SMALL` rows. The k (k
+ 1) / 2 entries of a matrix are packed by rows from the diagonal on; those of 3x3
matrices of space are xx, xy, xz, yy, yz, zz.

Pivots that are not positive are left out: their rows and columns count as zero, so that
results are finite for any matrix.
"""

import math
from functools import cache
from itertools import accumulate, pairwise, repeat
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.linalg.lapack import dposv, dpotri

# Limits of rounding errors, in double precision. Each is relative to the numbers that a
# result was computed from. It exceeds the unit roundoff 1.1e-16 by the observed loss of
# its kind of operations. None is critical: if all are halved, or doubled, ``python -m
# benchmarks.accuracy tables`` prints the same digits.

# Sums of squares, and numbers compared with them: a few units of the last place.
OF_SUMS = 1e-15
# Products and decompositions of matrices.
OF_PRODUCTS = 1e-14
# Results of several such steps, as Schur complements and normalised differences.
OF_STEPS = 1e-13
# Remainders of large numbers that cancel.
OF_DIFFERENCES = 1e-12
# Singular values and eigenvalues of directions beyond the rank of a matrix, relative to
# the largest.
OF_RANKS = 1e-10
# Square roots of such remainders, such as distances.
OF_DISTANCES = 1e-9

# Row and column of the packed entries of a 3x3 matrix, and the diagonal.
ROWS, COLUMNS = np.triu_indices(3)
DIAGONAL = [0, 3, 5]

# Number of rows up to which elimination is as fast as LAPACK:
# docs/benchmarks/README.md, "Thresholds".
SMALL = 30


def unpack3(packed: NDArray) -> NDArray:
    """Return packed symmetric matrices (..., 6, n) as (..., 3, 3, n)."""
    return packed.take(_places(3), -2)


def inverse3(packed: NDArray) -> NDArray:
    """Return the inverses (3, 3, n) of positive semidefinite matrices (6, n).

    Generalised inverses of singular ones have zeros for dependent coordinates.
    """
    a, d, e, b, f, c = packed
    # R = L^-1 of the Cholesky factor L, zero where a pivot is rounding error
    R = np.zeros((3, 3, packed.shape[-1]))
    R[0, 0] = x = 1.0 / np.sqrt(np.where(a > 0, a, np.inf))
    xy, xz = d * x, e * x  # the first column of L
    left = b - xy * xy
    R[1, 1] = y = 1.0 / np.sqrt(np.where(left > OF_STEPS * b, left, np.inf))
    yz = (f - xz * xy) * y
    left = c - xz * xz - yz * yz
    R[2, 2] = z = 1.0 / np.sqrt(np.where(left > OF_STEPS * c, left, np.inf))
    R[1, 0] = -xy * x * y
    R[2, 0] = -(xz * x + yz * R[1, 0]) * z
    R[2, 1] = -yz * y * z
    return np.einsum("can,cbn->abn", R, R)


@cache
def pair_indices(k: int) -> tuple[NDArray, NDArray]:
    """Return row and column of the entries of packed symmetric k x k matrices."""
    return np.triu_indices(k)


@cache
def _places(k: int) -> NDArray:
    """Return the places (k, k) of entries in packed symmetric k x k matrices."""
    first, second = pair_indices(k)
    places = np.empty((k, k), dtype=int)
    places[first, second] = places[second, first] = np.arange(len(first))
    return places


def packed_rows(packed: NDArray) -> list[NDArray]:
    """Return views of the rows of packed matrices, each from the diagonal on."""
    lengths = range(math.isqrt(2 * len(packed)), 0, -1)
    ends = accumulate(lengths, initial=0)
    return [packed[start:end] for start, end in pairwise(ends)]


def unpacked(packed: NDArray) -> NDArray:
    """Return packed symmetric matrices (n_pairs, ...) as (k, k, ...)."""
    return packed.take(_places(math.isqrt(2 * len(packed))), 0)


def diagonal_of(packed: NDArray) -> NDArray:
    """Return the indices (k,) of the diagonal in packed matrices (n_pairs, ...)."""
    return _places(math.isqrt(2 * len(packed))).diagonal()


def packed_products(A: NDArray, B: NDArray) -> NDArray:
    """Return symmetric products ``A B^T`` of matrices (k, m, n), packed."""
    k, _, n = A.shape
    packed = np.empty((k * (k + 1) // 2, n))
    for i, row in enumerate(packed_rows(packed)):
        np.einsum("lmn,mn->ln", A[i:], B[i], out=row)
    return packed


def solve_positive(A: NDArray, b: NDArray) -> tuple[NDArray, NDArray]:
    """
    Solve ``A x = b`` for packed A (n_pairs, n) and b (k, n); return x and definiteness.

    x is zero for unknowns that are left out; A is definite (n,) if all pivots are
    positive.
    """
    k, n = b.shape
    floors, positive = OF_STEPS * A[diagonal_of(A)], np.ones(n, dtype=bool)
    # D L and, in the last column, L^-T b, for A = L^T D L with L unit upper triangular
    rows, inverses = np.empty((k, k + 1, n)), np.empty((k, n))
    for i, row in enumerate(packed_rows(A)):
        tail = rows[i, i:]
        tail[:-1], tail[-1] = row, b[i]
        if i:
            # The sum over all rows before at once: one pass over the numbers.
            tail -= np.einsum("jn,jcn->cn", rows[:i, i] * inverses[:i], rows[:i, i:])
        inverses[i] = _inverse_pivot(tail[0], floors[i], positive)
    # Back substitution, column by column
    x = rows[:, k].copy()
    for i in range(k - 1, -1, -1):
        x[i] *= inverses[i]
        x[:i] -= rows[:i, i] * x[i]
    return x, positive


def invert_positive(A: NDArray) -> tuple[NDArray, NDArray]:
    """Return inverses of packed matrices, and which are positive definite (n,)."""
    swept = A.copy()
    _, positive = sweep(swept)
    return -swept, positive


def sweep(packed: NDArray, first: int = 0) -> tuple[NDArray, NDArray]:
    """Sweep rows of packed symmetric matrices (n_pairs, n), in place.

    If A holds the rows from `first` on, ``[[C, G^T], [G, A]]`` becomes
    ``[[C - G^T A^-1 G, G^T A^-1], [A^-1 G, -A^-1]]`` (Goodnight, "A tutorial on the
    SWEEP operator", The American Statistician 33, 1979). For one matrix S that is not
    packed this is ::

        for i in range(first, len(S)):
            column, pivot = S[:, i].copy(), S[i, i]
            S -= np.outer(column, column) / pivot
            S[i] = S[:, i] = column / pivot
            S[i, i] = -1.0 / pivot

    Returns ``log det A`` (n,) of the positive pivots, and whether all pivots are
    positive (n,).
    """
    k = math.isqrt(2 * len(packed))
    return (_swept if k - first > SMALL else _eliminated)(packed, first)


def _swept(packed: NDArray, first: int) -> tuple[NDArray, NDArray]:
    """Sweep each matrix by its Cholesky factor, or by `_eliminated` without one."""
    places = _places(math.isqrt(2 * len(packed)))
    across, block = places[:first, first:], places[first:, first:]
    G, upper = packed[across], pair_indices(len(block))
    # Copies of the last frame (`padded`) are solved once.
    last = np.append(True, (packed != packed[:, -1:]).any(axis=0)).nonzero()[0][-1]
    lanes, frames = np.minimum(np.arange(packed.shape[1]), last), packed[:, : last + 1]
    A, X = (np.moveaxis(frames[rows], 2, 0).copy() for rows in (block, across))
    failed = [dposv(a.T, x.T, 1, 1, 1)[2] for a, x in zip(A, X, strict=True)]
    pivots = A.diagonal(axis1=1, axis2=2).T[:, lanes] ** 2
    floors = OF_STEPS * packed[np.diag(block)]
    positive = (np.array(failed)[lanes] == 0) & (pivots > floors).all(axis=0)
    failures = np.flatnonzero(~positive)
    left, X = packed.take(failures, -1), np.moveaxis(X, 0, 2)[..., lanes]
    for a in A:
        dpotri(a.T, 1, 1)
    packed[block[upper]], packed[across] = -A[:, *upper].T[:, lanes], X
    packed[places[:first, :first]] -= np.einsum("rcn,scn->rsn", G, X)
    log_determinant = np.log(np.where(positive, pivots, 1.0)).sum(axis=0)
    if len(failures):
        log_determinant[failures], positive[failures] = _eliminated(left, first)
        packed[:, failures] = left
    return log_determinant, positive


def _eliminated(packed: NDArray, first: int) -> tuple[NDArray, NDArray]:
    """Sweep rows of all matrices, one after the other."""
    rows, n = packed_rows(packed), packed.shape[1]
    k = len(rows)
    places, (first_of, second_of) = _places(k), pair_indices(k)
    floors = OF_STEPS * packed[diagonal_of(packed)]
    inverses = np.empty((k - first, n))
    positive = np.ones(n, dtype=bool)
    product, factor = np.empty((2, *packed.shape))  # new ones cost more than calls
    for i in range(first, k):
        inverse = _inverse_pivot(rows[i][0], floors[i], positive)
        inverses[i - first] = inverse
        column = packed.take(places[i], 0)
        scaled = column * inverse
        scaled.take(second_of, 0, out=product, mode="clip")
        product *= column.take(first_of, 0, out=factor, mode="clip")
        packed -= product
        packed[places[i]] = scaled
        np.negative(inverse, out=rows[i][0])
    # With where=... NumPy rounds differently next to entries that are left out.
    return -np.log(np.where(inverses > 0, inverses, 1.0)).sum(axis=0), positive


def _inverse_pivot(pivot: NDArray, floor: NDArray, positive: NDArray) -> NDArray:
    """Return inverse pivots (n,), zero where left out; clear `positive` there.

    Pivots below the floor, relative to the entry before elimination, are rounding
    errors.
    """
    kept = pivot > floor
    if np.count_nonzero(kept) == len(kept):
        return 1.0 / pivot
    positive &= kept
    return kept / np.where(kept, pivot, 1.0)


def energies(rows: NDArray) -> NDArray[np.float64]:
    """Return the sums of the squares of arrays (n_frames, ...), in double precision."""
    flat = rows.reshape(len(rows), -1).astype(np.float64, copy=False)
    return np.vecdot(flat, flat)


def lengths(rows: NDArray) -> NDArray:
    """Return the lengths (n, J) of vectors (n, 2, J), faster than by a norm."""
    return np.sqrt(rows[:, 0] ** 2 + rows[:, 1] ** 2)


# BLAS and einsum round the sums of the last frames differently if the number of frames
# is not a multiple of this.
LANES = 16


def padded(frames: NDArray) -> NDArray:
    """Return indices of frames (n,), the last one repeated up to a multiple of `LANES`.

    The results of a frame are then the same in any batch, to the last bit. Copies of a
    frame may be written to the same place.
    """
    return np.concatenate([frames, np.repeat(frames[-1:], -len(frames) % LANES)])


def centred(values: NDArray) -> NDArray:
    """Return values (..., n), such as depths or shapes, without their mean."""
    return values - values.mean(axis=-1, keepdims=True)


def of_frames(values: Any, frames: NDArray | slice) -> Any:
    """Return some frames of an array (..., n), or of each part of a tuple.

    The frames stay the last axis in memory. None stays None.
    """
    if isinstance(values, tuple):
        return getattr(values, "_make", tuple)(map(of_frames, values, repeat(frames)))
    if not isinstance(values, np.ndarray):
        return values if values is None else values.of_frames(frames)
    return values[..., frames] if isinstance(frames, slice) else values.take(frames, -1)


def frames_last(motion: NDArray) -> NDArray:
    """Return matrices (n, a, b) as (a, b, n), with long rows over the frames."""
    return np.ascontiguousarray(motion.transpose(1, 2, 0))


def frames_first(M: NDArray) -> NDArray:
    """Return a view (n, a, b) of matrices (a, b, n)."""
    return M.transpose(2, 0, 1)


def orientations(rows: NDArray) -> NDArray:
    """Return the sign of the third moment, or largest entry, of rows (n, m)."""
    largest = np.abs(rows).max(axis=1, keepdims=True)
    scaled = np.divide(rows, largest, out=np.zeros_like(rows), where=largest > 0)
    moment = np.sum(scaled**3, axis=1)
    decisive = np.abs(moment) > 1e-9 * np.sum(np.abs(scaled) ** 3, axis=1)
    extreme = scaled[np.arange(len(rows)), np.abs(scaled).argmax(axis=1)]
    return np.where(np.where(decisive, moment, extreme) < 0, -1.0, 1.0)


def polar(matrices: NDArray) -> tuple[NDArray, NDArray, NDArray]:
    """Return polar decompositions ``A = P O`` of matrices (..., m, d), ``m <= d``.

    O (..., m, d) are the nearest orthonormal rows. Also returns the eigenvalues (...,
    m) of P, the singular values of A, and its eigenvectors (..., m, m) in columns.
    """
    U, values, Vt = np.linalg.svd(matrices, full_matrices=False)
    return U @ Vt, values, U


def procrustes(matrices: NDArray) -> NDArray:
    """Return the rotations R that maximise ``tr(R^T A)`` for matrices A (..., 3, 3)."""
    U, _, Vt = np.linalg.svd(matrices)
    U[..., 2] *= np.linalg.det(U @ Vt)[..., None]
    return np.asarray(U @ Vt)
