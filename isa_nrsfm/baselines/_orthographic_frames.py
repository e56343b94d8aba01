"""Orthographic camera and coefficients of single frames for given shapes.

Each frame is fitted separately, so that its result does not depend on the others.
"""

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from isa_nrsfm._frames.camera import rigid_cameras
from isa_nrsfm._frames.projection import compose
from isa_nrsfm._linalg.rounding import OF_SUMS
from isa_nrsfm._linalg.vectors import polar
from isa_nrsfm._tables.layout import measurement_matrix

# CROSS[a] @ s is the cross product of axis a and s.
CROSS = np.cross(np.eye(3)[:, None], np.eye(3)[None]).swapaxes(1, 2)


def fit_orthographic(
    centred: NDArray,
    mean_shape: NDArray,
    basis: NDArray,
    noise_variance: float,
    batch: int = 2000,
) -> tuple[NDArray, NDArray]:
    """
    Return camera (n_frames, 2, 3) and coefficients (n_frames, n_components) of frames.

    Given are centred tracks W_i^T (n_frames, n_points, 2) and centred shapes. Cameras
    with orthonormal rows and coefficients minimise ``||W_i - R_i (B_0 + sum_k alpha_ik
    B_k)||_F^2 + noise_variance * ||alpha_i||^2``, by damped Newton steps from both
    `tilted_cameras`. Batches of frames limit the memory.
    """
    stacked = np.concatenate([mean_shape[None], basis])
    # The part of the tracks outside of the span of the shapes is constant.
    Q, R = np.linalg.qr(stacked.transpose(1, 0, 2).reshape(len(mean_shape), -1))
    shapes = np.ascontiguousarray(R.T).reshape(len(stacked), 3, -1)
    cameras, alpha = (
        np.empty((len(centred), 2, 3)),
        np.empty((len(centred), len(basis))),
    )
    for first in range(0, len(centred), batch):
        part = slice(first, first + batch)
        W = measurement_matrix(centred[part])
        images = (W @ Q).reshape(len(W) // 2, 2, -1)
        one, other = (
            _descend(images, shapes, noise_variance, start)
            for start in tilted_cameras(W, mean_shape)
        )
        better = (other[2] < one[2])[:, None]
        cameras[part] = np.where(better[..., None], other[0], one[0])
        alpha[part] = np.where(better, other[1], one[1])
    return cameras, alpha


def tilted_cameras(W: NDArray, mean_shape: NDArray) -> tuple[NDArray, NDArray]:
    """
    Return two orthographic cameras for each frame that roughly fit its mean shape.

    In the principal plane of the mean shape they are the affine camera of the rigid
    fit, as far as possible. The two cameras are the two possible tilts of this plane.
    """
    axes = np.linalg.svd(mean_shape, full_matrices=False)[2]
    U, S, Vt = np.linalg.svd(rigid_cameras(W, mean_shape @ axes.T)[:, :, :2])
    # Orthonormal rows in space have singular values one and at most one in a plane.
    cosine = np.minimum(S[:, 1], 1.0)
    S = np.stack([np.ones_like(cosine), cosine], axis=1)
    across = np.sqrt(1.0 - cosine**2)[:, None] * U[:, :, 1]
    plane = (U * S[:, None]) @ Vt
    first, second = (np.dstack([plane, sign * across]) @ axes for sign in (1.0, -1.0))
    return first, second


def _descend(
    images: NDArray, shapes: NDArray, ridge: float, cameras: NDArray
) -> tuple[NDArray, NDArray, NDArray]:
    """Return cameras, coefficients and costs of frames, from given cameras."""
    n_frames, n_components = len(images), len(shapes) - 1
    cameras, alpha = cameras.copy(), np.zeros((n_frames, n_components))
    energy = np.einsum("ird,ird->i", images, images)
    cost = _cost(images, shapes, ridge, cameras, alpha)
    damping = np.full(n_frames, 1e-3)  # relative to the curvature
    active = np.arange(n_frames)
    for _ in range(200):
        X, R, a = images[active], cameras[active], alpha[active]
        g, H, scale = quadratic_model(X, shapes, ridge, R, a)
        rounding = OF_SUMS * energy[active]
        scale = damping[active, None] * scale + rounding[:, None]
        np.einsum("ijj->ij", H)[...] += scale
        step = np.linalg.solve(H, g[..., None])[..., 0]
        turned = R @ Rotation.from_rotvec(step[:, :3]).as_matrix()
        moved = a + step[:, 3:]
        new, gain = _cost(X, shapes, ridge, turned, moved), np.vecdot(step, g)
        # With indefinite curvature a step may lead up.
        better = (new <= cost[active] + rounding) & (gain >= 0)
        taken = active[better]
        cameras[taken], alpha[taken] = turned[better], moved[better]
        cost[taken] = new[better]
        damping[active] *= np.where(better, 0.1, 10.0)
        done = better & (gain <= rounding)
        active = active[~done & (damping[active] < 1e9)]
        if not len(active):
            break
    return polar(cameras)[0], alpha, cost


def _cost(
    images: NDArray, shapes: NDArray, ridge: float, cameras: NDArray, alpha: NDArray
) -> NDArray:
    """Return the cost of each frame."""
    rest = images - cameras @ compose(shapes[0], shapes[1:], alpha)
    return np.einsum("ird,ird->i", rest, rest) + ridge * np.vecdot(alpha, alpha)


def quadratic_model(
    images: NDArray, shapes: NDArray, ridge: float, cameras: NDArray, alpha: NDArray
) -> tuple[NDArray, NDArray, NDArray]:
    """
    Return minus the gradient and the Hessian of half the cost, and a scale of steps.

    The unknowns are w of ``R_i expm([w]_x)`` and the coefficients. The scale is the
    diagonal of the Gauss-Newton matrix, which is non-negative.
    """
    n_frames, n_components = alpha.shape
    composed = compose(shapes[0], shapes[1:], alpha)
    rest = images - cameras @ composed
    turning = (cameras[:, None] @ CROSS) @ composed[:, None]
    bending = cameras[:, None] @ shapes[1:]
    J = np.concatenate([turning, bending], axis=1).reshape(n_frames, -1, rest[0].size)
    g = (J @ rest.reshape(n_frames, -1, 1))[..., 0]
    g[:, 3:] -= ridge * alpha
    H = J @ J.transpose(0, 2, 1)
    bent = np.arange(3, 3 + n_components)
    H[:, bent, bent] += ridge
    scale = np.einsum("ijj->ij", H).copy()
    # <r_i, R_i [a]_x B_k>, and <r_i, R_i [a]_x [b]_x S_i> with [a]_x [b]_x = b a^T - I.
    back = cameras.transpose(0, 2, 1) @ rest
    N = back[:, None] @ shapes[1:].transpose(0, 2, 1)
    mixed = np.einsum("ikcd,acd->iak", N, CROSS, optimize=True)
    H[:, :3, 3:] -= mixed
    H[:, 3:, :3] -= mixed.transpose(0, 2, 1)
    N = back @ composed.transpose(0, 2, 1)
    H[:, :3, :3] -= 0.5 * (N + N.transpose(0, 2, 1))
    H[:, range(3), range(3)] += np.einsum("icc->i", N)[:, None]
    return g, H, scale
