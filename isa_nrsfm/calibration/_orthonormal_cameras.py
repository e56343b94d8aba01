"""Orthographic cameras: mixtures of columns of a motion factor, orthonormal in rows."""

from functools import partial
from itertools import combinations
from operator import itemgetter
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.linalg import solve_triangular
from sklearn.utils import check_array

from isa_nrsfm._linalg import OF_RANKS, OF_STEPS
from isa_nrsfm.calibration._metric import levenberg_marquardt, normal_equations

# Number of columns that are added at a time: a basis shape has three.
STEP = 3

# Errors of covariance C of the rows r1 and r2 raise the expected cost, to first order,
# by 4 r1 C r1 + 4 r2 C r2 + 2 (r1 C r1 + r2 C r2). On average over all cameras that is
# 4 tr C. C is the noise variance times Q^T Q.
NOISE_PRICE = 4.0


class OrthonormalCameras(NamedTuple):
    """
    Cameras whose rows are as nearly orthonormal as a motion factor allows.

    Attributes
    ----------
    cameras : ndarray of shape (n_frames, 2, 3)
        ``P Q``, nearly orthonormal rows.
    mixing : ndarray of shape (n_columns, 3)
        Q, with zeros for columns of P that are not used.
    cost : float
        Mean over the frames of ``||R_i R_i^T - I||_F^2``, which is ``(|r1|^2 - 1)^2 +
        (|r2|^2 - 1)^2 + 2 (r1 . r2)^2`` with r1 and r2 the rows of a camera.
    """

    cameras: NDArray
    mixing: NDArray
    cost: float


def orthonormal_cameras(
    motion: ArrayLike, noise_variance: float = 0.0, max_iter: int = 2000
) -> OrthonormalCameras:
    """
    Find orthographic cameras that are mixtures of the columns of a motion factor.

    A factorisation ``W ~ P B`` of a measurement matrix is known up to a mixing of the
    columns of P. If an object deforms as a mixture of few shapes, some mixtures ``P Q``
    of three columns are, in each frame, two orthonormal rows: the orthographic cameras.

    Parameters
    ----------
    motion : array-like of shape (2 * n_frames, n_columns)
        P, for each frame the row of x, then of y. At least three columns, by decreasing
        energy, such as left singular vectors of W. Without noise their scales do not
        matter.
    noise_variance : float, default=0.0
        Variance of the errors of the entries of P. It equals the variance for the
        entries of W if P has its left singular vectors times its singular values.
    max_iter : int, default=2000
        Maximum number of steps for each number of columns.

    Returns
    -------
    OrthonormalCameras
        Named tuple of cameras, mixing and cost. The cameras are known up to a rotation
        or reflection of space.

    Raises
    ------
    ValueError
        If P is not of the shape above, has entries that are not finite or fewer than
        three linearly independent columns, or if the variance is negative.

    Notes
    -----
    The cost is minimised for mixtures of the first three columns, then of the first
    six, nine and so on, as long as it falls. Each minimisation starts from the last
    mixture. Because of local minima the first one with more than three columns also
    starts from each triple of its columns. With noise the expected cost is minimised:
    to first order errors of P add ``4 noise_variance ||Q||_F^2`` to it, for cameras
    that see all directions alike. The result does not change when frames are turned in
    their image planes.

    Large deformations are hard to distinguish from rotations: a low cost does not
    imply that the cameras are right.

    References
    ----------
    J. Xiao, J. Chai, T. Kanade, "A closed-form solution to non-rigid shape and motion
    recovery", International Journal of Computer Vision 67, 2006.

    I. Akhter, Y. Sheikh, S. Khan, "In defense of orthonormality constraints for
    nonrigid structure from motion", IEEE Conference on Computer Vision and Pattern
    Recognition, 2009.

    Examples
    --------
    >>> import numpy as np
    >>> from scipy.spatial.transform import Rotation
    >>> from isa_nrsfm.calibration import orthonormal_cameras
    >>> cameras = Rotation.random(20, np.random.default_rng(0)).as_matrix()[:, :2]
    >>> shape = np.random.default_rng(0).normal(size=(3, 9))
    >>> U, S, _ = np.linalg.svd(cameras.reshape(-1, 3) @ shape, full_matrices=False)
    >>> result = orthonormal_cameras(U[:, :3])
    >>> np.allclose(result.cameras @ result.cameras.mT, np.eye(2))
    True
    """
    P = check_array(motion, dtype=np.float64, input_name="motion", ensure_min_samples=2)
    if len(P) % 2:
        raise ValueError(
            f"motion must have two rows per frame, an even number; got {len(P)} rows"
        )
    if not noise_variance >= 0:
        raise ValueError(f"noise_variance must not be negative; got {noise_variance}")
    kept, basis, inverse = _orthonormal_columns(P)
    roots = np.sqrt(NOISE_PRICE * noise_variance) * inverse
    mixing, lowest_cost = np.eye(3), np.inf
    for n in range(3, len(kept) + STEP, STEP):
        columns, penalty = basis[:, :n], roots[:n, :n]
        wider, cost = orthonormal_mixture(columns, mixing, penalty, max_iter)
        if not cost < lowest_cost:
            break
        mixing, lowest_cost = wider, cost
    n = len(mixing)
    cameras = (basis[:, :n] @ mixing).reshape(-1, 2, 3)
    Q = np.zeros((P.shape[1], 3))
    Q[kept[:n]] = inverse[:n, :n] @ mixing
    cost = np.sum(orthonormality_residuals(cameras) ** 2) / len(cameras)
    return OrthonormalCameras(cameras, Q, float(cost))


def _orthonormal_columns(motion: NDArray) -> tuple[NDArray, NDArray, NDArray]:
    """
    Return indices of independent columns, an orthogonal basis of them, and its mixing.

    ``basis = motion[:, kept] @ inverse``, triangular: first columns span the same
    space.
    """
    lengths = np.linalg.norm(motion, axis=0)
    kept = np.flatnonzero(lengths > 0)
    scaled = np.linalg.qr(motion[:, kept] / lengths[kept], mode="r")
    kept = kept[np.abs(np.diagonal(scaled)) > OF_RANKS]
    if len(kept) < 3:
        raise ValueError(
            "motion must have at least three linearly independent columns; "
            f"{len(kept)} of {motion.shape[1]} are"
        )
    basis, triangle = np.linalg.qr(motion[:, kept])
    root = np.sqrt(len(motion) / 3)
    return kept, root * basis, solve_triangular(triangle, root * np.eye(len(kept)))


def orthonormal_mixture(
    basis: NDArray, mixing: NDArray, penalty: NDArray | None = None, max_iter: int = 200
) -> tuple[NDArray, float]:
    """Mix columns such that rows are most nearly orthonormal; return Q (n, 3) and cost.

    The columns (2 I, n) are about as long as columns of cameras. `mixing` (n_before, 3)
    is the start, the best mixture of the first columns. If there are three of these,
    each triple of columns is another start. The cost is the mean over the frames of the
    squared norm of `orthonormality_residuals`, plus a penalty ``||L Q||_F^2``.
    """
    n = basis.shape[1]
    L = np.zeros((0, n)) if penalty is None else penalty

    def evaluated(Q: NDArray) -> tuple[float, NDArray, NDArray]:
        return normal_equations(*_linearised(Q, basis, L))

    def moved(Q: NDArray, step: NDArray) -> NDArray:
        return Q + step.reshape(Q.shape)

    minimised = partial(levenberg_marquardt, evaluated, moved, least_gain=1e-9)
    start = np.vstack([mixing, np.zeros((n - len(mixing), 3))])
    if len(mixing) == 3 < n <= 3 + STEP:
        # The best of about twenty starts after some steps leads to the least cost, or
        # close to it.
        triples = [np.column_stack(triple) for triple in combinations(np.eye(n), 3)]
        rough = [minimised(Q, max_steps=8) for Q in (start, *triples)]
        start, *_ = min(rough, key=itemgetter(1))
    return minimised(start, max_steps=max_iter)[:2]


def orthonormality_residuals(cameras: NDArray) -> NDArray:
    """Return ``|r1|^2 - 1``, ``|r2|^2 - 1``, ``sqrt(2) r1 . r2`` of cameras (n, 2, 3).

    The sum of their squares is ``||R_i R_i^T - I||_F^2``. The result is (3, n).
    """
    r1, r2 = cameras[:, 0], cameras[:, 1]
    across = np.sqrt(2.0) * np.vecdot(r1, r2)
    return np.stack([np.vecdot(r1, r1) - 1.0, np.vecdot(r2, r2) - 1.0, across])


def _linearised(Q: NDArray, basis: NDArray, L: NDArray) -> tuple[NDArray, NDArray]:
    """Return residuals (n,) of Q and their Jacobian (n, 3 * n_columns)."""
    n_frames = len(basis) // 2
    P, R = basis.reshape(n_frames, 2, -1, 1), (basis @ Q).reshape(n_frames, 2, 1, 3)
    p1, p2, r1, r2 = P[:, 0], P[:, 1], R[:, 0], R[:, 1]
    residuals = orthonormality_residuals(R[:, :, 0]).ravel() / np.sqrt(n_frames)
    rows = np.stack([2.0 * p1 * r1, 2.0 * p2 * r2, np.sqrt(2.0) * (p1 * r2 + p2 * r1)])
    rows = rows.reshape(3 * n_frames, -1) / np.sqrt(n_frames)
    residuals = np.concatenate([residuals, (L @ Q).ravel()])
    return residuals, np.concatenate([rows, np.kron(L, np.eye(3))])


def principal_columns(W: NDArray) -> NDArray:
    """Return left singular vectors (2 I, rank) of W, as long as columns of cameras."""
    square, V = np.linalg.eigh(W.T @ W)
    kept = np.flatnonzero(square > OF_STEPS * square[-1])[::-1]
    return W @ (V[:, kept] * np.sqrt(len(W) / 3 / square[kept]))
