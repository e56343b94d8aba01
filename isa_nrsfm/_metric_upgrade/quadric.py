"""The metric of space of affine cameras, in which angles and lengths are true.

A factorisation into affine cameras and shapes is known up to one 3x3 affinity of
space. Cameras are scaled orthographic (weak perspective) in some metric of space if
objects are small and pixels square. This determines the metric (Tomasi, Kanade 1992;
Poelman, Kanade, "A paraperspective factorization method for shape and motion recovery",
1997): a symmetric matrix ``G = Q Q^T`` such that ``M Q`` are nearly scaled rotations.
Q is known up to a rotation.
"""

from typing import Literal

import numpy as np
from numpy.typing import NDArray

from isa_nrsfm._linalg.rounding import OF_RANKS

# Bound on the ratio of stretches of space by a root Q of the metric G. It is exceeded
# if the cameras hardly determine the depth, which noise can then stretch without limit.
LARGEST_STRETCH = 20.0

CalibratedCamera = Literal["orthographic", "weak_perspective"]


def unit_cameras(motion: NDArray) -> NDArray:
    """Return the usable cameras, each divided by its Frobenius norm."""
    size = np.linalg.norm(motion, axis=(1, 2))
    usable = np.isfinite(size) & (size > 0)
    if not usable.any():
        raise ValueError(
            "the viewing frame needs at least one finite, non-zero camera; "
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


def strain_basis(camera: CalibratedCamera) -> NDArray:
    """Return an orthonormal basis of the strains that change the residuals.

    Six symmetric matrices for orthographic cameras. Five with trace zero for
    weak-perspective ones, as the trace only changes the scales of the frames.
    """
    basis = np.zeros((6, 3, 3))
    diagonal = np.array([[1, -1, 0], [1, 1, -2], [1, 1, 1]]) / np.sqrt([[2], [6], [3]])
    basis[[[0], [1], [5]], [0, 1, 2], [0, 1, 2]] = diagonal
    first, second = [0, 0, 1], [1, 2, 2]
    basis[[2, 3, 4], first, second] = basis[[2, 3, 4], second, first] = np.sqrt(0.5)
    return basis if camera == "orthographic" else basis[:5]


def conformal_equations(cameras: NDArray) -> NDArray:
    """Return the linear equations of weak-perspective cameras for the metric of space.

    For cameras (I, 2, 3) with rows m1 and m2 these are the coefficients (2 I, 6) of
    ``m1 G m1^T - m2 G m2^T`` and of ``2 m1 G m2^T`` in the coordinates of G in
    `strain_basis`. Rotating a frame in the image mixes the two.
    """
    basis = strain_basis("orthographic")
    (xx, xy), (_, yy) = np.einsum("ira,nab,isb->rsin", cameras, basis, cameras)
    return np.vstack([xx - yy, 2 * xy])


def metric_quadric(motion: NDArray) -> NDArray | None:
    """Find the symmetric G under which cameras (I, 2, 3) are weak-perspective ones.

    The equations of `conformal_equations` are solved by least squares, with the mean of
    ``m1 G m1^T + m2 G m2^T`` fixed to one. With a fixed norm of G, a direction that the
    cameras hardly see would nearly solve them. Returns None if they do not determine G,
    or if G is not safely positive definite.
    """
    cameras = unit_cameras(motion)
    gram = mean_gram(cameras)
    eigenvalues = np.linalg.eigvalsh(gram)
    if eigenvalues[0] <= OF_RANKS * eigenvalues[-1]:
        return None
    # In coordinates where the mean of M_i^T M_i is the identity, the fixed mean is the
    # trace of G. So G is I / 3 plus a matrix of trace zero with five unknowns.
    whitening = symmetric_power(gram, -0.5)
    equations = conformal_equations(cameras @ whitening)
    unknowns, _, _, singular_values = np.linalg.lstsq(
        equations[:, :5], -equations[:, 5] / np.sqrt(3)
    )
    if len(singular_values) < 5 or singular_values[-1] <= 1e-6 * singular_values[0]:
        return None
    G = np.tensordot(unknowns, strain_basis("weak_perspective"), 1) + np.eye(3) / 3
    G = whitening @ G @ whitening
    # Eigenvalues of G are squares of the stretches of space.
    eigenvalues = np.linalg.eigvalsh(G)
    return G if eigenvalues[0] * LARGEST_STRETCH**2 > eigenvalues[-1] else None
