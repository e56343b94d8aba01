"""Depths that are common to overlapping groups of points, by one objective.

The points of group g have coordinates ``Y_gi = R_gi C_gi`` in frame i, up to their
mean, with a rotation R_gi of the group and shapes ``C_gi ~ N(mu_g, Sigma_g)``. The
eigenvalues of Sigma_g are at least the noise variance s2. Depths, and x and y of
missing points, are the same in all groups. They maximise, with R, mu and Sigma, ::

    prod_gi N(R_gi^T Y_gi; mu_g, Sigma_g).

Steps alternate between the probabilistic principal components of each group (Tipping,
Bishop, 1999), and Gauss-Newton steps of rotations and coordinates, one axis of the
coordinates at a time. The rotations are eliminated from these (variable projection:
Golub, Pereyra, 1973): a group that is tilted turns with its depths.
"""

import numpy as np
from numpy.typing import NDArray

from isa_nrsfm._frames.camera_models import rotated, turning
from isa_nrsfm._linalg.small_matrices import (
    COLUMNS,
    ROWS,
    frames_first,
    frames_last,
    inverse3,
    packed_products,
    pair_indices,
    procrustes,
    unpacked,
)

# Frames and points of a group
Indices = tuple[NDArray, NDArray]
# Steps, and the share of the noise floor in the last one (docs/benchmarks/consensus.md)
STEPS, LAST_SHARE = 30, 0.2
# Weight of the first coordinates, or of the joint fit, among the groups. It matters
# for points that no group determines.
WEIGHT_OF_WHOLE = 1e-3


def common_coordinates(
    images: NDArray, first: NDArray, groups: list[Indices], noise: float, floor: float
) -> NDArray:
    """Return coordinates (I, 3, n) of images (I, 2, n), NaN where points are missing.

    They start from the first ones (I, 3, n). Groups are indices of frames and points.
    The noise variance includes its floor, which falls from step to step.
    """
    unknown = np.concatenate([np.isnan(images), np.ones_like(images[:, :1], bool)], 1)
    # From here on the frame is the last index: coordinates (n, 3, I), rotations (3, 3,
    # n_frames).
    unknown, first = unknown.transpose(2, 1, 0), first.transpose(2, 1, 0)
    Y = np.where(unknown, first, 0.0)
    Y[:, :2] += np.nan_to_num(images.transpose(2, 1, 0))
    axes = [axis for axis in range(3) if unknown[:, axis].any()]
    n_points, _, n_frames = Y.shape
    # Zero in frames that do not show the group, which therefore do not count
    rotations = [
        np.isin(np.arange(n_frames), frames) * _aligning(_of_group(Y, points))
        for frames, points in groups
    ]
    # Precisions are packed.
    first_of, second_of = pair_indices(n_points)
    places = unpacked(np.arange(len(first_of)))
    precisions = np.empty((len(axes), len(first_of), n_frames))
    for step in range(STEPS):
        s2 = noise - floor + floor * LAST_SHARE ** (step / (STEPS - 1))
        precisions[:] = 0.0
        precisions[:, np.diagonal(places)] = WEIGHT_OF_WHOLE / s2
        gradient = WEIGHT_OF_WHOLE / s2 * (first - Y)
        turns = []
        for R, (_, points) in zip(rotations, groups, strict=True):
            shapes = np.einsum("jai,abi->jbi", _of_group(Y, points), R)
            precision, slope, pulled, inverse, w = _turns(shapes, s2)
            n = len(points)
            mixed = np.einsum("abi,kjbi->ajki", R, pulled.reshape(3, n, 3, -1))
            turns.append((R, points, w, inverse, mixed))
            # Without the turns, which follow the coordinates
            slope = np.einsum("abi,jbi->jai", R, slope)
            slope -= np.einsum("ajki,ki->jai", mixed, w)
            gradient[points] += slope
            weights = precision.reshape(n, 3, n, 3).transpose(0, 2, 1, 3)
            weights = weights[pair_indices(n)].reshape(-1, 9)
            own_places = places[np.ix_(points, points)][pair_indices(n)]
            for axis, total in zip(axes, precisions, strict=True):
                own = weights @ (R[axis, :, None] * R[axis]).reshape(9, -1)
                following = np.einsum("kli,jli->jki", inverse, mixed[axis])
                own -= packed_products(mixed[axis], following)
                total[own_places] += own
        change = np.zeros_like(Y)
        for axis, total in zip(axes, precisions, strict=True):
            free = unknown[:, axis]
            total[~(free[first_of] & free[second_of])] = 0.0
            total[np.diagonal(places)] += ~free
            slope = np.where(free, gradient[:, axis], 0.0)
            A = frames_first(unpacked(total))
            change[:, axis] = np.linalg.solve(A, slope.T[..., None])[..., 0].T
        Y += change
        for R, points, w, inverse, mixed in turns:
            pull = np.einsum("ajki,jai->ki", mixed, _of_group(change, points))
            R[:] = rotated(R, w - np.einsum("kli,li->ki", inverse, pull))
    return np.ascontiguousarray(Y.transpose(2, 1, 0))


def aligning_rotations(S: NDArray, s2: float) -> NDArray:
    """Return rotations R (I, 3, 3) with likeliest ``R^T S_i ~ N(mu, Sigma)``.

    The shapes S (I, 3, n) are centred, and the noise variance is s2.
    """
    R = np.repeat(np.eye(3)[:, :, None], len(S), axis=2)
    for _ in range(STEPS):
        R = rotated(R, _turns(np.einsum("iaj,abi->jbi", S, R), s2)[-1])
    return frames_first(R)


def _turns(shapes: NDArray, s2: float) -> tuple[NDArray, ...]:
    """Return the terms of Gauss-Newton steps ``exp(hat(w))`` of shapes (n, 3, I).

    The precision (3n, 3n) and slope (n, 3, I) of the shapes, the precision times the
    derivatives of the shapes by w (3, 3n, I), the inverse curvature (3, 3, I), and w
    (3, I).
    """
    precision, slope = _principal(shapes, s2)
    D = turning(shapes).reshape(3, len(precision), -1)
    pulled = precision @ D
    inverse = inverse3(np.einsum("kai,lai->kli", D, pulled)[ROWS, COLUMNS])
    w = np.einsum("kai,ai->ki", D, slope.reshape(len(precision), -1))
    return precision, slope, pulled, inverse, np.einsum("kli,li->ki", inverse, w)


def _principal(shapes: NDArray, s2: float) -> tuple[NDArray, NDArray]:
    """Return the precision of shapes (n, 3, I), and its product with their deviations.

    With eigenvectors U and eigenvalues v above s2 of the covariance, the precision (3n,
    3n) is ``(I - U (1 - s2 / v) U^T) / s2``. The deviations (n, 3, I) are those of the
    mean from the shapes. Shapes of zeros do not count.
    """
    n, shown = len(shapes), shapes.any(axis=(0, 1))
    n_frames = np.count_nonzero(shown)
    mean = shapes.sum(axis=2, keepdims=True) / n_frames
    off = (shown * mean - shapes).reshape(3 * n, -1)
    values, vectors = np.linalg.eigh(off @ off.T / n_frames)
    kept = values > s2
    U = vectors[:, kept]
    centring = (np.eye(n) - 1.0 / n)[:, None, :, None] * np.eye(3)[:, None]
    model = (U * (1.0 - s2 / values[kept])) @ U.T
    precision = (centring.reshape(model.shape) - model) / s2
    return precision, (precision @ off).reshape(shapes.shape)


def _of_group(Y: NDArray, points: NDArray) -> NDArray:
    """Return the centred coordinates (n, 3, I) of the points of a group."""
    own = Y[points]
    return np.asarray(own - own.mean(axis=0))


def _aligning(own: NDArray) -> NDArray:
    """Return rotations (3, 3, n_frames) that align shapes (n, 3, n_frames)."""
    own = own.transpose(2, 1, 0)
    mean = own[0]
    for _ in range(5):
        R = procrustes(own @ mean.T)
        mean = (R.mT @ own).mean(axis=0)
    return frames_last(R)
