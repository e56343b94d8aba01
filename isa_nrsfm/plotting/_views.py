"""The frame in which shapes are looked at.

A factorisation into affine cameras and shapes is known up to one 3x3 affinity of
space. Drawn as they are, the shapes look squashed and sheared. The functions here find
the affinity under which the cameras are as nearly as possible scaled orthographic
(weak perspective) ones, and turn the shapes until they face the mean camera.
"""

import numpy as np
from numpy.typing import NDArray

from isa_nrsfm._camera import DEGENERATE_MEAN

# The smallest eigenvalue, relative to the largest, down to which a symmetric matrix is
# taken for positive definite.
SMALLEST_EIGENVALUE = 1e-10
# Five unknowns are determined while the smallest singular value of their equations is
# above this share of the largest one.
SMALLEST_SINGULAR_VALUE = 1e-6
# The upgrade is trusted while no axis of space is stretched, relative to another one,
# by more than this: a depth that cameras hardly show is stretched without limit.
LARGEST_STRETCH = 20.0

# Unknowns of a symmetric 3x3 matrix: its diagonal, and sqrt(2) times the entries above
# it, so that the norm of the six is the Frobenius norm of the matrix.
_ROWS, _COLUMNS = [0, 0, 1], [1, 2, 2]


def _unit_cameras(motion: NDArray) -> NDArray:
    """Return the usable cameras, each divided by its Frobenius norm."""
    size = np.linalg.norm(motion, axis=(1, 2))
    usable = np.isfinite(size) & (size > 0)
    if not usable.any():
        raise ValueError(
            "the viewing frame needs at least one finite camera other than zero; "
            f"got none among the {len(motion)} cameras"
        )
    return motion[usable] / size[usable, None, None]


def _mean_square(cameras: NDArray) -> NDArray:
    """Return the mean of M_i^T M_i over the cameras."""
    rows = cameras.reshape(-1, 3)
    return rows.T @ rows / len(cameras)


def _symmetric_power(matrix: NDArray, power: float) -> NDArray:
    """Return a power of a symmetric positive semidefinite matrix."""
    eigenvalues, vectors = np.linalg.eigh(matrix)
    return (vectors * np.maximum(eigenvalues, 0) ** power) @ vectors.T


def _quadratic_terms(a: NDArray, b: NDArray) -> NDArray:
    """Return the coefficients of a Q b^T in the six unknowns of Q, one row a pair."""
    mixed = a[:, _ROWS] * b[:, _COLUMNS] + a[:, _COLUMNS] * b[:, _ROWS]
    return np.hstack([a * b, mixed / np.sqrt(2)])


def _symmetric_matrix(unknowns: NDArray) -> NDArray:
    """Return the symmetric 3x3 matrix of six unknowns."""
    matrix = np.diag(unknowns[:3])
    matrix[_ROWS, _COLUMNS] = matrix[_COLUMNS, _ROWS] = unknowns[3:] / np.sqrt(2)
    return matrix


def metric_quadric(motion: NDArray) -> NDArray | None:
    """
    Find the symmetric Q under which the cameras are weak-perspective ones.

    The rows m1 and m2 of each camera, divided by its norm, should satisfy
    ``m1 Q m1^T = m2 Q m2^T`` and ``m1 Q m2^T = 0``: homogeneous linear equations in
    six unknowns, solved by least squares. They are weighted such that turning a frame
    in its image plane changes nothing. What is kept constant, to exclude Q = 0, is the
    mean of ``m1 Q m1^T + m2 Q m2^T``, so that a depth which the cameras show little of
    does not pass for a solution.

    Parameters
    ----------
    motion : ndarray of shape (n_frames, 2, 3)
        The affine cameras.

    Returns
    -------
    ndarray of shape (3, 3) or None
        Q, positive definite, the mean of ``m1 Q m1^T + m2 Q m2^T`` being one. None
        where the equations do not determine it, and where it is not safely positive
        definite.
    """
    cameras = _unit_cameras(motion)
    mean_square = _mean_square(cameras)
    eigenvalues = np.linalg.eigvalsh(mean_square)
    if eigenvalues[0] <= SMALLEST_EIGENVALUE * eigenvalues[-1]:
        return None
    # In coordinates in which the mean of M_i^T M_i is the identity the mean to be kept
    # is the trace of Q: the identity over three plus five unknowns without trace.
    whitening = _symmetric_power(mean_square, -0.5)
    m1, m2 = np.moveaxis(cameras @ whitening, 1, 0)
    equations = np.vstack(
        [
            _quadratic_terms(m1, m1) - _quadratic_terms(m2, m2),
            2 * _quadratic_terms(m1, m2),
        ]
    )
    trace = np.array([1.0, 1.0, 1.0, 0.0, 0.0, 0.0])
    traceless = np.linalg.svd(trace[None])[2][1:].T
    unknowns, _, _, singular_values = np.linalg.lstsq(
        equations @ traceless, -equations @ trace / 3
    )
    if (
        len(singular_values) < 5
        or singular_values[-1] <= SMALLEST_SINGULAR_VALUE * singular_values[0]
    ):
        return None
    Q = whitening @ _symmetric_matrix(trace / 3 + traceless @ unknowns) @ whitening
    eigenvalues = np.linalg.eigvalsh(Q)
    # Q is stretched as the square of space.
    if eigenvalues[0] * LARGEST_STRETCH**2 <= eigenvalues[-1]:
        return None
    return Q


def front_axes(cameras: NDArray, reference: NDArray, spread: NDArray) -> NDArray:
    """
    Return the directions of space that the front view shows to the right and down.

    Parameters
    ----------
    cameras : ndarray of shape (n_frames, 2, 3)
        Cameras of unit norm.
    reference : ndarray of shape (2, 3)
        The camera that sees the front view.
    spread : ndarray of shape (3, 3)
        Covariance of the points of the object.

    Returns
    -------
    ndarray of shape (2, 3)
        The pair of orthonormal rows that is nearest to the reference camera. Cameras
        that go round the object have no common view, but see the axis they turn about
        in one direction of the image: it stays in that direction then, and the object
        is turned to where it looks broadest.
    """
    left, shared, right = np.linalg.svd(cameras.mean(axis=0), full_matrices=False)
    row = np.sqrt(np.mean(np.sum(cameras**2, axis=(1, 2))) / 2)
    if not shared[1] < DEGENERATE_MEAN * row <= shared[0]:
        left, _, right = np.linalg.svd(reference, full_matrices=False)
        return left @ right
    across = np.eye(3) - np.outer(right[0], right[0])
    broadest = np.linalg.eigh(across @ spread @ across)[1][:, -1]
    axis, turned = np.outer(left[:, 0], right[0]), np.outer(left[:, 1], broadest)
    return axis + turned * (1 if np.sum(turned * reference) >= 0 else -1)


def viewing_transform(motion: NDArray, reference_motion: NDArray) -> NDArray:
    """
    Find the transform of space into the frame in which shapes are looked at.

    In that frame the cameras are as nearly as possible scaled rows of a rotation
    (`metric_quadric`; where it finds nothing, the mean of ``M_i^T M_i`` over the unit
    cameras is made isotropic instead). The x and y axes are those of the reference
    camera's image (`front_axes`): x points right, and y down where the image's y does.
    The third axis keeps the handedness of the given coordinates. A camera of median
    size has rows of length one, so that shapes are in the units of the image.

    Parameters
    ----------
    motion : ndarray of shape (n_frames, 2, 3)
        The affine cameras, in coordinates in which the mean shape is white.
    reference_motion : ndarray of shape (2, 3)
        The camera that sees the front view.

    Returns
    -------
    ndarray of shape (3, 3)
        The transform T with non-negative determinant: ``shape @ T.T`` is a shape in
        the viewing frame. If the cameras are weak-perspective ones of some shape, that
        is this shape up to scale, a rotation and its mirror image.
    """
    Q = metric_quadric(motion)
    if Q is None:
        metric = _symmetric_power(_mean_square(_unit_cameras(motion)), 0.5)
    else:
        metric = _symmetric_power(Q, -0.5)
    from_metric = np.linalg.pinv(metric)
    axes = front_axes(
        _unit_cameras(motion @ from_metric),
        reference_motion @ from_metric,
        metric @ metric.T,
    )
    transform = np.vstack([axes, np.cross(*axes)]) @ metric
    size = np.linalg.norm(motion @ np.linalg.pinv(transform), axis=(1, 2)) / np.sqrt(2)
    return transform * np.median(size[np.isfinite(size) & (size > 0)])
