"""Algebra of many small symmetric matrices, the index of the matrix last.

With the index last each operation is one pass over long rows of numbers. For matrices
of one to fifteen rows that is faster than a call of LAPACK for each.

There are two packings. k x k matrices are packed by rows, each row from the diagonal
on. 3x3 matrices of space, in the functions whose names end in 3, have the diagonal
first: xx, yy, zz, xy, xz, yz.

No function divides by zero. A pivot that is not positive is left out; each docstring
says what that means for the result.
"""

import math

import numpy as np
from numpy.typing import NDArray

# Row and column of the packed entries of a 3x3 matrix, and the way back.
ROWS = (0, 1, 2, 0, 0, 1)
COLUMNS = (0, 1, 2, 1, 2, 2)
UNPACKED = ((0, 3, 4), (3, 1, 5), (4, 5, 2))
# A pivot below this share of its diagonal entry before elimination is rounding error.
SMALLEST_PIVOT = 1e-13


def unpack3(packed: NDArray) -> NDArray:
    """Return packed symmetric matrices (..., 6, n) as (..., 3, 3, n)."""
    return packed[..., UNPACKED, :]


def inverse_factor3(packed: NDArray) -> NDArray:
    """
    Return the inverse of the Cholesky factor of symmetric 3x3 matrices.

    Parameters
    ----------
    packed : ndarray of shape (6, n)
        Positive semidefinite matrices ``A = L L^T``, packed. Their scale does not
        matter, nor do the scales of the coordinates.

    Returns
    -------
    ndarray of shape (3, 3, n)
        ``R = L^-1``, lower triangular: ``R^T R = A^-1``. Where A is singular, up to
        rounding, ``R^T R`` is a generalised inverse (``A R^T R A = A``) with a row and
        a column of zeros for each coordinate that the ones before it determine.
    """
    a, b, c, d, e, f = packed
    R = np.zeros((3, 3, packed.shape[-1]))
    R[0, 0] = x = _inverse_root(a, a)
    xy, xz = d * x, e * x  # the first column of L
    R[1, 1] = y = _inverse_root(b - xy * xy, b)
    yz = (f - xz * xy) * y
    R[2, 2] = z = _inverse_root(c - xz * xz - yz * yz, c)
    R[1, 0] = -xy * x * y
    R[2, 0] = -(xz * x + yz * R[1, 0]) * z
    R[2, 1] = -yz * y * z
    return R


def _inverse_root(pivot: NDArray, diagonal: NDArray) -> NDArray:
    """Return ``pivot^(-1/2)`` (n,), zero where the pivot is rounding error.

    The diagonal (n,) has the entries before elimination.
    """
    kept = pivot > SMALLEST_PIVOT * diagonal
    return kept / np.sqrt(np.where(kept, pivot, 1.0))


def inverse3(packed: NDArray) -> NDArray:
    """
    Return the inverses of symmetric 3x3 matrices.

    Parameters
    ----------
    packed : ndarray of shape (6, n)
        Positive semidefinite matrices, packed.

    Returns
    -------
    ndarray of shape (3, 3, n)
        Their inverses, or the generalised inverses of `inverse_factor3`.
    """
    R = inverse_factor3(packed)
    return np.einsum("can,cbn->abn", R, R)


def eigh3(packed: NDArray) -> tuple[NDArray, NDArray]:
    """
    Return eigenvalues and eigenvectors of symmetric 3x3 matrices.

    Parameters
    ----------
    packed : ndarray of shape (6, n)
        Symmetric matrices A, packed.

    Returns
    -------
    values : ndarray of shape (3, n)
        Eigenvalues, not sorted. The first is the one farthest from the other two.
    axes : ndarray of shape (3, 3, n)
        ``A = axes diag(values) axes^T``, axes orthogonal up to rounding, also where
        eigenvalues are equal.

    Notes
    -----
    The first eigenvalue is the root of the characteristic polynomial that is farthest
    from the other two, by the trigonometric formula (Smith, "Eigenvalues of a symmetric
    3x3 matrix", Communications of the ACM 4, 1961). Being well separated, it has a well
    determined eigenvector. One Jacobi rotation in the plane orthogonal to it gives the
    other two.
    """
    # The first eigenvalue, of the matrix without trace and of norm one.
    mean = packed[:3].mean(axis=0)
    rest = packed.copy()
    rest[:3] -= mean
    a, b, c, d, e, f = rest
    size = np.sqrt((a * a + b * b + c * c) / 6 + (d * d + e * e + f * f) / 3)
    rest /= np.where(size > 0, size, 1.0)
    determinant = a * (b * c - f * f) - d * (d * c - e * f) + e * (d * f - b * e)
    angle = np.arccos(np.minimum(np.abs(determinant) / 2, 1.0)) / 3
    first = np.copysign(2 * np.cos(angle), determinant)

    # Its eigenvector v: the adjugate of the shifted matrix is a positive multiple of
    # v v^T, of which the column with the largest diagonal entry is taken.
    a, b, c = rest[:3] - first
    x, y, z = b * c - f * f, a * c - e * e, a * b - d * d
    xy, xz, yz = e * f - c * d, d * f - b * e, d * e - a * f
    from_x, from_y = (x >= y) & (x >= z), y >= z
    v = np.where(from_x, (x, xy, xz), np.where(from_y, (xy, y, yz), (xz, yz, z)))
    v /= np.sqrt(_dot(v, v))
    # Two axes u and w orthogonal to v (Duff et al., "Building an orthonormal basis,
    # revisited", Journal of Computer Graphics Techniques 6, 2017).
    sign = np.copysign(1.0, v[2])
    share = -1 / (sign + v[2])
    product = v[0] * v[1] * share
    u = np.stack([1 + sign * v[0] ** 2 * share, sign * product, -sign * v[0]])
    w = np.stack([product, sign + v[1] ** 2 * share, -v[1]])

    full = unpack3(rest)
    to_u, to_w = np.einsum("abn,bn->an", full, u), np.einsum("abn,bn->an", full, w)
    uu, uw, ww = _dot(u, to_u), _dot(u, to_w), _dot(w, to_w)
    # Jacobi's rotation, by no more than 45 degrees.
    gap = (ww - uu) / 2
    reach = np.abs(gap) + np.sqrt(gap * gap + uw * uw)
    tangent = np.copysign(1.0, gap) * uw / np.where(reach > 0, reach, 1.0)
    cosine = 1 / np.sqrt(1 + tangent * tangent)
    sine = tangent * cosine
    axes = np.stack([v, cosine * u - sine * w, sine * u + cosine * w], axis=1)
    values = np.stack([first, uu - tangent * uw, ww + tangent * uw])
    return values * size + mean, axes


def _dot(u: NDArray, v: NDArray) -> NDArray:
    """Return the scalar products of vectors (3, n)."""
    return np.einsum("an,an->n", u, v)


def pair_indices(k: int) -> tuple[NDArray, NDArray]:
    """Return row and column of the entries of packed symmetric k x k matrices."""
    rows = np.arange(k)
    first = np.repeat(rows, k - rows)
    # Row j has k - j entries, so row i starts at i k - (0 + 1 + ... + (i - 1)).
    starts = rows * k - rows * (rows - 1) // 2
    return first, np.arange(len(first)) - starts[first] + first


def packed_rows(packed: NDArray) -> list[NDArray]:
    """Return views of the rows of packed matrices, each from the diagonal on."""
    rows, start = [], 0
    for length in range(_size(packed), 0, -1):
        rows.append(packed[start : start + length])
        start += length
    return rows


def unpacked(packed: NDArray) -> NDArray:
    """Return packed symmetric matrices (n_pairs, ...) as (k, k, ...)."""
    k = _size(packed)
    first, second = pair_indices(k)
    full = np.empty((k, k, *packed.shape[1:]))
    full[first, second] = full[second, first] = packed
    return full


def diagonal_of(packed: NDArray) -> NDArray:
    """Return the indices (k,) of the diagonal in packed matrices (n_pairs, ...)."""
    k = _size(packed)
    rows = np.arange(k)
    return rows * (2 * k + 1 - rows) // 2


def packed_gram(rows: NDArray) -> NDArray:
    """Return the products ``A A^T`` of n matrices (k, m, n), packed: (n_pairs, n)."""
    k, _, n = rows.shape
    packed = np.empty((k * (k + 1) // 2, n))
    for i, row in enumerate(packed_rows(packed)):
        np.einsum("lmn,mn->ln", rows[i:], rows[i], out=row)
    return packed


def _size(packed: NDArray) -> int:
    """Return the number of rows of packed matrices."""
    return (math.isqrt(8 * len(packed) + 1) - 1) // 2


def solve_positive(A: NDArray, b: NDArray) -> tuple[NDArray, NDArray]:
    """
    Solve symmetric positive definite systems of equations.

    Parameters
    ----------
    A : ndarray of shape (k * (k + 1) / 2, n)
        Symmetric matrices, packed.
    b : ndarray of shape (k, n)
        Right sides.

    Returns
    -------
    x : ndarray of shape (k, n)
        ``A x = b``. An unknown whose pivot is not positive is zero and its equation
        is left out, so that x is finite for any matrix.
    positive : ndarray of bool, shape (n,)
        Whether all pivots are positive, that is, A is positive definite.
    """
    k = len(b)
    rows, inverses, positive = _eliminated(A, b)
    # Back substitution, column by column.
    x = rows[:, k].copy()
    for i in range(k - 1, -1, -1):
        x[i] *= inverses[i]
        if i:
            x[:i] -= rows[:i, i] * x[i]
    return x, positive


def invert_positive(A: NDArray) -> tuple[NDArray, NDArray, NDArray]:
    """
    Return the inverses of symmetric positive definite matrices.

    Parameters
    ----------
    A : ndarray of shape (k * (k + 1) / 2, n)
        Symmetric matrices, packed.

    Returns
    -------
    inverse : ndarray of shape (k * (k + 1) / 2, n)
        Inverses, packed. A coordinate whose pivot is not positive has a row and a
        column of zeros, so that the result is finite for any matrix.
    log_determinant : ndarray of shape (n,)
        Sum of the logarithms of the positive pivots.
    positive : ndarray of bool, shape (n,)
        Whether all pivots are positive, that is, A is positive definite.
    """
    rows, inverses, positive = _eliminated(A)
    k, n = inverses.shape
    # With where=... NumPy rounds in another way beside those that are left out.
    logarithms = np.log(np.where(inverses > 0, inverses, 1.0))
    # Back substitution for all right sides: ``A^-1 = D^-1 L^-T + (I - L) A^-1``, of
    # which the first term is on and below the diagonal.
    full = np.empty((k, k, n))
    for i in range(k - 1, -1, -1):
        full[i, i] = inverses[i]
        if i < k - 1:
            after = full[i, i + 1 :]
            row = rows[i, i + 1 :] * -inverses[i]
            np.einsum("mn,mjn->jn", row, full[i + 1 :, i + 1 :], out=after)
            full[i + 1 :, i] = after
            full[i, i] += np.einsum("mn,mn->n", row, after)
    return full[pair_indices(k)], -logarithms.sum(axis=0), positive


def _eliminated(
    A: NDArray, b: NDArray | None = None
) -> tuple[NDArray, NDArray, NDArray]:
    """
    Return the factors of ``A = L^T D L``, with L unit upper triangular.

    The matrices A are packed (n_pairs, n), the right sides b (k, n), if there are any.
    Returned are D L (k, k, n), of which only the diagonal and what is above it counts,
    or (k, k + 1, n) with ``L^-T b`` as the last column, the inverses of D (k, n), and
    where all pivots are positive (n,). The inverse of one that is not is zero: its row
    and its column do not count.
    """
    k, n = _size(A), A.shape[1]
    smallest = SMALLEST_PIVOT * A[diagonal_of(A)]
    rows, inverses = np.empty((k, k if b is None else k + 1, n)), np.empty((k, n))
    # Nearly always all pivots are positive, and one look at the end is enough.
    with np.errstate(all="ignore"):
        _eliminate(A, b, rows, inverses)
    pivots = rows.reshape(k * rows.shape[1], n)[:: rows.shape[1] + 1][:k]
    positive = (pivots > smallest).all(axis=0)
    if not positive.all():
        _eliminate(A, b, rows, inverses, smallest)
    return rows, inverses, positive


def _eliminate(
    A: NDArray,
    b: NDArray | None,
    rows: NDArray,
    inverses: NDArray,
    smallest: NDArray | None = None,
) -> None:
    """Set rows and inverses of `_eliminated`.

    With the smallest pivots (k, n) those that are not above them are left out.
    """
    k = len(rows)
    for i, row in enumerate(packed_rows(A)):
        rest = rows[i, i:]
        rest[: k - i] = row
        if b is not None:
            rest[k - i] = b[i]
        if i:
            # The sum over all rows before at once: one pass over the numbers.
            rest -= np.einsum("jn,jcn->cn", rows[:i, i] * inverses[:i], rows[:i, i:])
        if smallest is None:
            np.divide(1.0, rest[0], out=inverses[i])
        else:
            kept = rest[0] > smallest[i]
            inverses[i] = kept / np.where(kept, rest[0], 1.0)


def sweep(packed: NDArray, first: int = 0) -> tuple[NDArray, NDArray]:
    """
    Sweep rows of symmetric matrices, in place.

    For ``[[C, G^T], [G, A]]``, with A the rows from the first to sweep on, that leaves
    ``[[C - G^T A^-1 G, G^T A^-1], [A^-1 G, -A^-1]]`` (Goodnight, "A tutorial on the
    SWEEP operator", The American Statistician 33, 1979).

    Parameters
    ----------
    packed : ndarray of shape (n_pairs, n)
        Symmetric matrices, packed, A positive definite.
    first : int, default=0
        The first row that is swept. All after it are, too.

    Returns
    -------
    log_determinant : ndarray of shape (n,)
        Sum of the logarithms of the positive pivots, ``log det A``.
    positive : ndarray of bool, shape (n,)
        Whether all pivots are positive. Where one is not, its row and its column are
        zero in the end.
    """
    rows = packed_rows(packed)
    k, n = len(rows), packed.shape[1]
    diagonal = [row[0].copy() for row in rows]
    inverses = np.empty((k - first, n))
    positive = np.ones(n, dtype=bool)
    column, scaled, room = np.empty((3, k, n))
    for i in range(first, k):
        inverse = _inverse_pivot(rows[i][0], diagonal[i], positive)
        inverses[i - first] = inverse
        for j in range(i):
            column[j] = rows[j][i - j]
        column[i:] = rows[i]
        np.multiply(column, inverse, out=scaled)
        for j in range(k):
            if j != i:
                rows[j] -= np.multiply(scaled[j:], column[j], out=room[: k - j])
        for j in range(i):
            rows[j][i - j] = scaled[j]
        rows[i][1:] = scaled[i + 1 :]
        np.negative(inverse, out=rows[i][0])
    # With where=... NumPy rounds in another way beside those that are left out.
    logarithms = np.log(np.where(inverses > 0, inverses, 1.0))
    return -logarithms.sum(axis=0), positive


def _inverse_pivot(pivot: NDArray, diagonal: NDArray, positive: NDArray) -> NDArray:
    """Return the inverse pivots (n,), zero for those left out.

    Matrices with a pivot left out become False in `positive` (n,), in place.
    """
    kept = pivot > SMALLEST_PIVOT * diagonal
    if kept.all():
        return 1.0 / pivot
    positive &= kept
    return kept / np.where(kept, pivot, 1.0)
