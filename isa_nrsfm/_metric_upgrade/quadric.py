"""The metric of space of affine cameras, in which angles and lengths are true.

A factorisation into affine cameras and shapes is known up to one 3x3 affinity of
space. Cameras are scaled orthographic (weak perspective) in some metric of space if
objects are small and pixels square. This determines the metric (Tomasi, Kanade 1992;
Poelman, Kanade, "A paraperspective factorization method for shape and motion recovery",
1997): a symmetric matrix ``G = Q Q^T`` such that ``M Q`` are nearly scaled rotations.
Q is known up to a rotation.
"""

import numpy as np
from numpy.typing import NDArray

from isa_nrsfm._linalg.rounding import OF_RANKS

# Bound on the ratio of stretches of space by a root Q of the metric G. It is exceeded
# where the cameras hardly show the depth, which noise then stretches without limit.
LARGEST_STRETCH = 20.0

# The six unknowns of a symmetric 3x3 matrix are its diagonal, and sqrt(2) times the
# entries above it. Their norm is the Frobenius norm of the matrix.
_ROWS, _COLUMNS = [0, 0, 1], [1, 2, 2]


def unit_cameras(motion: NDArray) -> NDArray:
    """Return the usable cameras, each divided by its Frobenius norm."""
    size = np.linalg.norm(motion, axis=(1, 2))
    usable = np.isfinite(size) & (size > 0)
    if not usable.any():
        raise ValueError(
            "the viewing frame needs at least one finite camera other than zero; "
            f"got none among the {len(motion)} cameras"
        )
    return motion[usable] / size[usable, None, None]


def mean_gram(cameras: NDArray) -> NDArray:
    """Return the mean of M_i^T M_i over the cameras."""
    rows = cameras.reshape(-1, 3)
    return rows.T @ rows / len(cameras)


def symmetric_power(matrix: NDArray, power: float) -> NDArray:
    """Return a power of a symmetric positive semidefinite matrix."""
    eigenvalues, vectors = np.linalg.eigh(matrix)
    return (vectors * np.maximum(eigenvalues, 0) ** power) @ vectors.T


def conformal_equations(cameras: NDArray) -> NDArray:
    """Return the linear equations of weak-perspective cameras for the metric of space.

    For cameras (I, 2, 3) with rows m1 and m2 these are the coefficients (2 I, 6) of
    ``m1 G m1^T - m2 G m2^T`` and of ``2 m1 G m2^T`` in the unknowns of G, see
    `symmetric_matrix`. Roll of a frame turns the two into each other.
    """
    m1, m2 = np.moveaxis(cameras, 1, 0)
    alike = _quadratic_terms(m1, m1) - _quadratic_terms(m2, m2)
    return np.vstack([alike, 2 * _quadratic_terms(m1, m2)])


def _quadratic_terms(a: NDArray, b: NDArray) -> NDArray:
    """Return the coefficients of a G b^T in the six unknowns of G, one row a pair."""
    mixed = a[:, _ROWS] * b[:, _COLUMNS] + a[:, _COLUMNS] * b[:, _ROWS]
    return np.hstack([a * b, mixed / np.sqrt(2)])


def symmetric_matrix(unknowns: NDArray) -> NDArray:
    """Return the symmetric 3x3 matrix of six unknowns."""
    matrix = np.diag(unknowns[:3])
    matrix[_ROWS, _COLUMNS] = matrix[_COLUMNS, _ROWS] = unknowns[3:] / np.sqrt(2)
    return matrix


def metric_quadric(motion: NDArray) -> NDArray | None:
    """Find the symmetric G under which cameras (I, 2, 3) are weak-perspective ones.

    The equations of `conformal_equations` are solved by least squares, with the mean of
    ``m1 G m1^T + m2 G m2^T`` fixed to one. With a fixed norm of G instead, a G along a
    direction that the cameras hardly see would nearly solve them. None if they do not
    determine G, or if it is not safely positive definite.
    """
    cameras = unit_cameras(motion)
    gram = mean_gram(cameras)
    eigenvalues = np.linalg.eigvalsh(gram)
    if eigenvalues[0] <= OF_RANKS * eigenvalues[-1]:
        return None
    # In coordinates where the mean of M_i^T M_i is the identity, the mean that is fixed
    # is the trace of G. So G is I / 3 plus a matrix without trace, of five unknowns.
    whitening = symmetric_power(gram, -0.5)
    equations = conformal_equations(cameras @ whitening)
    trace = np.array([1.0, 1.0, 1.0, 0.0, 0.0, 0.0])
    traceless = np.linalg.svd(trace[None])[2][1:].T
    unknowns, _, _, singular_values = np.linalg.lstsq(
        equations @ traceless, -equations @ trace / 3
    )
    if len(singular_values) < 5 or singular_values[-1] <= 1e-6 * singular_values[0]:
        return None
    G = whitening @ symmetric_matrix(trace / 3 + traceless @ unknowns) @ whitening
    # Eigenvalues of G are squares of the stretches of space.
    eigenvalues = np.linalg.eigvalsh(G)
    return G if eigenvalues[0] * LARGEST_STRETCH**2 > eigenvalues[-1] else None
