"""Orthographic camera and coefficients of single frames for given shapes.

Each frame is fitted by itself: the result of a frame does not depend on the others.
"""

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from isa_nrsfm._frames.camera import rigid_cameras
from isa_nrsfm._frames.projection import compose
from isa_nrsfm._linalg.polar import polar
from isa_nrsfm._linalg.rounding import OF_SUMS
from isa_nrsfm._tables.layout import measurement_matrix

MAX_STEPS = 200
# Damping of the first step, relative to the curvature, and the most of it.
FIRST_DAMPING, LARGEST_DAMPING = 1e-3, 1e9

# Turns about x, y and z to first order: CROSS[a] @ s is the cross product of axis a
# and s.
CROSS = np.array(
    [
        [[0.0, 0.0, 0.0], [0.0, 0.0, -1.0], [0.0, 1.0, 0.0]],
        [[0.0, 0.0, 1.0], [0.0, 0.0, 0.0], [-1.0, 0.0, 0.0]],
        [[0.0, -1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, 0.0]],
    ]
)


class OrthographicFrames(NamedTuple):
    """
    A model of frames: camera with orthonormal rows, coefficients drawn from N(0, I).

    Attributes
    ----------
    mean_shape : ndarray of shape (n_points, 3)
        Centred.
    basis : ndarray of shape (n_components, n_points, 3)
        Centred.
    noise_variance : float
        Variance of a coordinate, above zero; it says how much the prior counts.
    """

    mean_shape: NDArray
    basis: NDArray
    noise_variance: float

    def fit(self, centred: NDArray, batch: int = 2000) -> tuple[NDArray, NDArray]:
        """
        Return camera and coefficients of frames.

        Parameters
        ----------
        centred : ndarray of shape (n_frames, n_points, 2)
            Centred tracks W_i^T, in the unit of the shapes.
        batch : int, default=2000
            Frames that are fitted at a time, so that their equations need little
            memory.

        Returns
        -------
        cameras : ndarray of shape (n_frames, 2, 3)
            R_i, with orthonormal rows.
        alpha : ndarray of shape (n_frames, n_components)
            Together they minimise ``||W_i - R_i (B_0 + sum_k alpha_ik B_k)||_F^2 +
            noise_variance * ||alpha_i||^2``, by damped Newton steps from the two
            cameras of `tilted_cameras` and coefficients of zero.
        """
        n_shapes, n_points = len(self.basis) + 1, len(self.mean_shape)
        stacked = np.concatenate([self.mean_shape[None], self.basis])
        # What the shapes do not span of the tracks is the same for all parameters.
        Q, R = np.linalg.qr(stacked.transpose(1, 0, 2).reshape(n_points, -1))
        shapes = np.ascontiguousarray(R.T).reshape(n_shapes, 3, -1)
        cameras = np.empty((len(centred), 2, 3))
        alpha = np.empty((len(centred), n_shapes - 1))
        for first in range(0, len(centred), batch):
            part = slice(first, first + batch)
            W = measurement_matrix(centred[part])
            images = (W @ Q).reshape(len(W) // 2, 2, -1)
            first_fit, second_fit = (
                _fit(images, shapes, self.noise_variance, start)
                for start in tilted_cameras(W, self.mean_shape)
            )
            better = (second_fit[2] < first_fit[2])[:, None]
            cameras[part] = np.where(better[..., None], second_fit[0], first_fit[0])
            alpha[part] = np.where(better, second_fit[1], first_fit[1])
        return cameras, alpha


def tilted_cameras(W: NDArray, mean_shape: NDArray) -> tuple[NDArray, NDArray]:
    """
    Return two orthographic cameras for each frame that see its mean shape about right.

    Parameters
    ----------
    W : ndarray of shape (2 * n_frames, n_points)
        Measurement matrix, rows centred.
    mean_shape : ndarray of shape (n_points, 3)
        Centred.

    Returns
    -------
    first, second : ndarray of shape (n_frames, 2, 3)
        Cameras with orthonormal rows. In the plane in which the mean shape extends most
        they are the affine camera of the rigid fit, as far as it is possible. That
        leaves two tilts of this plane, which differ by a reflection in it.
    """
    axes = np.linalg.svd(mean_shape, full_matrices=False)[2]
    plane = rigid_cameras(W, mean_shape @ axes.T)[:, :, :2]
    U, S, Vt = np.linalg.svd(plane)
    # Rows that are orthonormal in space have singular values one and at most one here.
    cosine = np.minimum(S[:, 1], 1.0)
    S = np.stack([np.ones_like(cosine), cosine], axis=1)
    across = np.sqrt(1.0 - cosine**2)[:, None] * U[:, :, 1]
    plane = (U * S[:, None]) @ Vt
    first, second = (np.dstack([plane, sign * across]) @ axes for sign in (1.0, -1.0))
    return first, second


def _fit(
    images: NDArray, shapes: NDArray, ridge: float, cameras: NDArray
) -> tuple[NDArray, NDArray, NDArray]:
    """Return cameras, coefficients and costs of frames, from given cameras."""
    n_frames, n_components = len(images), len(shapes) - 1
    cameras, alpha = cameras.copy(), np.zeros((n_frames, n_components))
    energy = np.einsum("ird,ird->i", images, images)
    cost = _cost(images, shapes, ridge, cameras, alpha)
    damping = np.full(n_frames, FIRST_DAMPING)
    active = np.arange(n_frames)
    for _ in range(MAX_STEPS):
        X, R, a = images[active], cameras[active], alpha[active]
        g, H, scale = _quadratic_model(X, shapes, ridge, R, a)
        rounding = OF_SUMS * energy[active]
        scale = damping[active, None] * scale + rounding[:, None]
        np.einsum("ijj->ij", H)[...] += scale
        step = np.linalg.solve(H, g[..., None])[..., 0]
        turned = R @ Rotation.from_rotvec(step[:, :3]).as_matrix()
        moved = a + step[:, 3:]
        new, gain = _cost(X, shapes, ridge, turned, moved), np.vecdot(step, g)
        # Where the curvature is indefinite a step may lead up.
        better = (new <= cost[active] + rounding) & (gain >= 0)
        taken = active[better]
        cameras[taken], alpha[taken] = turned[better], moved[better]
        cost[taken] = new[better]
        damping[active] *= np.where(better, 0.1, 10.0)
        done = better & (gain <= rounding)
        active = active[~done & (damping[active] < LARGEST_DAMPING)]
        if not len(active):
            break
    return polar(cameras).rows, alpha, cost


def _cost(
    images: NDArray, shapes: NDArray, ridge: float, cameras: NDArray, alpha: NDArray
) -> NDArray:
    """Return what is minimised for each frame."""
    rest = images - cameras @ compose(shapes[0], shapes[1:], alpha)
    return np.einsum("ird,ird->i", rest, rest) + ridge * np.vecdot(alpha, alpha)


def _quadratic_model(
    images: NDArray, shapes: NDArray, ridge: float, cameras: NDArray, alpha: NDArray
) -> tuple[NDArray, NDArray, NDArray]:
    """
    Return half of what describes the cost around given cameras and coefficients.

    The unknowns are the vector w of ``R_i expm([w]_x)`` and the coefficients.

    Returns
    -------
    slope : ndarray of shape (n_frames, 3 + n_components)
        Minus the derivatives.
    curvature : ndarray of shape (n_frames, 3 + n_components, 3 + n_components)
        The second derivatives.
    scale : ndarray of shape (n_frames, 3 + n_components)
        The diagonal of the curvature without what the residuals add; not negative.
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
