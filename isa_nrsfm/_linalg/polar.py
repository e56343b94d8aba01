"""Polar factors: the orthonormal rows that are nearest to those of a matrix."""

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray


class Polar(NamedTuple):
    """
    Polar decompositions ``A = P O`` of matrices.

    Attributes
    ----------
    rows : ndarray of shape (n, m, d)
        O, the matrices with orthonormal rows that are nearest to A.
    values : ndarray of shape (n, m)
        Singular values of A, the eigenvalues of P.
    axes : ndarray of shape (n, m, m)
        Eigenvectors of P, in the columns.
    """

    rows: NDArray
    values: NDArray
    axes: NDArray


def polar(matrices: NDArray) -> Polar:
    """
    Return the polar decompositions of matrices.

    Parameters
    ----------
    matrices : ndarray of shape (..., m, d)
        Matrices A with ``m <= d``.

    Returns
    -------
    Polar
        With ``A = axes diag(values) axes^T rows``.
    """
    U, values, Vt = np.linalg.svd(matrices, full_matrices=False)
    return Polar(U @ Vt, values, U)
