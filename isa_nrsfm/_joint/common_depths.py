"""Depths that are common to overlapping groups of points, by one objective.

The points of group g have coordinates ``Y_gi = R_gi C_gi`` in frame i, up to their
mean, with a rotation R_gi of the group and shapes ``C_gi ~ N(mu_g, Sigma_g)``. The
eigenvalues of Sigma_g are at least the noise variance s2. Depths, and x and y of
missing points, are the same in all groups. They maximise, with R, mu and Sigma, ::

    prod_gi N(R_gi^T Y_gi; mu_g, Sigma_g).

Steps alternate between the probabilistic principal components of each group (Tipping,
Bishop, 1999), Gauss-Newton steps of the rotations, and the coordinates, one axis at a
time.
"""

import numpy as np
from numpy.typing import NDArray

from isa_nrsfm._frames.camera_models import rotated
from isa_nrsfm._linalg.small_matrices import (
    COLUMNS,
    DIAGONAL,
    ROWS,
    frames_first,
    frames_last,
    inverse3,
    procrustes,
)

# Steps, and the share of the noise floor in the last one. With 60, 100, 150, 300 and
# 600 steps the error of yoga is .0119, .0114, .0110, .0106, .0106. With the share 1
# instead of 0.2, and 60 steps, that of drink is .0063 instead of .0053.
STEPS, LAST_SHARE = 100, 0.2
# Weight of the first coordinates, or of the joint fit, among the groups. It matters
# for points that no group determines. With 1e-2, 1e-3 and 1e-4 the error of yoga is
# .0118, .0116, .0115.
WEIGHT_OF_WHOLE = 1e-3


def common_coordinates(
    images: NDArray,
    first: NDArray,
    groups: list[tuple[NDArray, NDArray]],
    noise: float,
    floor: float,
) -> NDArray:
    """Return coordinates (I, 3, n) of images (I, 2, n), NaN where points are missing.

    They start from the first ones (I, 3, n). Groups are indices of frames and points.
    The noise variance includes its floor, which falls from step to step.
    """
    unknown = np.concatenate([np.isnan(images), np.ones_like(images[:, :1], bool)], 1)
    Y = first.copy()
    Y[:, :2] = np.where(unknown[:, :2], Y[:, :2], images)
    axes = [axis for axis in range(3) if unknown[:, axis].any()]
    rotations = [_aligning(_of_group(Y, *group)) for group in groups]
    # The frame is the last index of the precisions (n, n, I) of an axis.
    n_frames, _, n_points = Y.shape
    precisions = np.empty((len(axes), n_points, n_points, n_frames))
    diagonal = np.arange(n_points)
    for step in range(STEPS):
        s2 = noise - floor + floor * LAST_SHARE ** (step / (STEPS - 1))
        precisions[:] = 0.0
        precisions[:, diagonal, diagonal] = WEIGHT_OF_WHOLE / s2
        gradient = WEIGHT_OF_WHOLE / s2 * (first - Y)
        for R, (frames, points) in zip(rotations, groups, strict=True):
            own = _of_group(Y, frames, points)
            shapes = R.transpose(0, 2, 1) @ own
            fit, shrinking = _principal(shapes, s2)
            slope = R @ (fit - shapes) / s2
            gradient[np.ix_(frames, np.arange(3), points)] += slope
            n = len(points)
            weights = (np.kron(np.eye(3), np.eye(n) - 1.0 / n) - shrinking) / s2
            weights = weights.reshape(3, n, 3, n).transpose(0, 2, 1, 3).reshape(9, n, n)
            block = np.ix_(points, points)
            for axis, precision in zip(axes, precisions, strict=True):
                turn = np.zeros((3, 3, n_frames))
                turn[:, :, frames] = np.einsum("ia,ib->abi", R[:, axis], R[:, axis])
                precision[block] += np.tensordot(weights, turn.reshape(9, -1), (0, 0))
            R[:] = _turned(R, shapes, fit)
        for axis, precision in zip(axes, precisions, strict=True):
            free = unknown[:, axis]
            precision[~(free.T[:, None] & free.T)] = 0.0
            precision[diagonal, diagonal] += ~free.T
            slope = np.where(free, gradient[:, axis], 0.0)
            change = np.linalg.solve(precision.transpose(2, 0, 1), slope[..., None])
            Y[:, axis] += change[..., 0]
    return Y


def _principal(shapes: NDArray, s2: float) -> tuple[NDArray, NDArray]:
    """Return the expectations of shapes (I, 3, n), and ``U (1 - s2 / v) U^T``.

    The matrix (3n, 3n) maps deviations from the mean shape to their expectations. U and
    v are eigenvectors and eigenvalues above s2 of the covariance of the shapes.
    """
    mean = shapes.mean(axis=0)
    off = (shapes - mean).reshape(len(shapes), -1)
    values, vectors = np.linalg.eigh(off.T @ off / len(shapes))
    kept = values > s2
    U = vectors[:, kept]
    shrinking = (U * (1.0 - s2 / values[kept])) @ U.T
    return mean + (off @ shrinking).reshape(shapes.shape), shrinking


def _of_group(Y: NDArray, frames: NDArray, points: NDArray) -> NDArray:
    """Return the centred coordinates (n_frames, 3, n) of a group."""
    own = Y[np.ix_(frames, np.arange(3), points)]
    return np.asarray(own - own.mean(axis=2, keepdims=True))


def _aligning(own: NDArray) -> NDArray:
    """Return rotations (n_frames, 3, 3) that align shapes with their mean."""
    mean = own[0]
    for _ in range(5):
        R = procrustes(own @ mean.T)
        mean = (R.transpose(0, 2, 1) @ own).mean(axis=0)
    return R


def _turned(R: NDArray, shapes: NDArray, fit: NDArray) -> NDArray:
    """Return ``R exp(hat(w))`` by a step that lowers ``||shapes - exp(hat(w)) fit||``.

    The Gauss-Newton step is ``w = (tr(F) I - F)^-1 g``, with ``F = fit fit^T`` and the
    vector g of ``M - M^T`` for ``M = shapes fit^T``.
    """
    M, F = (frames_last(S @ fit.transpose(0, 2, 1)) for S in (shapes, fit))
    curvature = -F[ROWS, COLUMNS]
    curvature[DIAGONAL] += np.trace(F)
    slope = M[[2, 0, 1], [1, 2, 0]] - M[[1, 2, 0], [2, 0, 1]]
    turn = np.einsum("abi,bi->ai", inverse3(curvature), slope)
    return frames_first(rotated(frames_last(R), turn))
