"""Camera models: which 2x3 matrices a camera may be, and how to move among them.

A camera M_i of a frame is a free 2x3 matrix (affine), the first two rows of a rotation
times a scale (weak perspective), or such rows with a scale that is known
(orthographic). All other modules treat cameras alike. They compute the derivative
``G_i = dF/dM_i`` of an objective F and its curvature ``A_i`` by the rows of M_i. A
model of cameras transforms both to its own parameters.

A step of a calibrated camera is a rotation vector w and a change l of the logarithm of
its scale ::

    M(w, l) = exp(l) M exp(hat(w)),   hat(w) v = w x v.

Its tangents are the derivatives by w, ``D_c = M hat(e_c)`` for c = x, y, z, and by l,
``D_4 = M``. With the rows m_r of M and G_r of G the gradient is ``sum_r G_r x m_r`` by
w and ``<M, G>`` by l. The curvature is ``tr(D_c A D_d^T)``. The frame is the last
index of all arrays here: M and G are (2, 3, n_frames), steps (n_parameters, n_frames).
"""

from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from isa_nrsfm._frames.options import FRAME_OPTIONS
from isa_nrsfm._linalg.packed_symmetric import COLUMNS, ROWS, inverse3, unpack3
from isa_nrsfm._linalg.polar import polar

# Ridge of the curvature of calibrated cameras, relative to its mean diagonal.
RIDGE = 1e-9


class CameraModel(Protocol):
    """
    What a fit of many frames needs to know of the cameras.

    Attributes
    ----------
    name : str
        The value of the parameter `camera`.
    n_parameters : int
        Number of parameters p of a step of one camera.
    calibrated : bool
        Whether cameras are scaled rotations.
    scaled : bool
        Whether each camera has a scale of its own.
    """

    name: str
    n_parameters: int
    calibrated: bool
    scaled: bool

    def moved(self, M: NDArray, step: NDArray) -> NDArray:
        """Return cameras (2, 3, n) after steps (n_parameters, n)."""

    def tangents(self, M: NDArray) -> NDArray:
        """Return the derivatives (n_parameters, 2, 3, n) of cameras."""

    def gradient(self, M: NDArray, G: NDArray) -> NDArray:
        """Return dF/dparameters (n_parameters, n) from G = dF/dM (2, 3, n)."""

    def inverse_curvature(self, M: NDArray, curvature: NDArray) -> NDArray:
        """Return the inverse curvature that `product` takes, from curvatures (6, n)."""

    def product(self, inverse: NDArray, vector: NDArray) -> NDArray:
        """Return vectors (n_parameters, n) times an inverse curvature."""

    def largest_length(self, step: NDArray) -> float:
        """Return the largest step length, one for all cameras, along a direction."""

    def limited(self, step: NDArray) -> NDArray:
        """Return steps (n_parameters, n), each shortened to the largest allowed one."""


class AffineCameras:
    """Free 2x3 matrices; the parameters are their entries, row by row."""

    name = "affine"
    n_parameters = 6
    calibrated = False
    scaled = True

    def moved(self, M: NDArray, step: NDArray) -> NDArray:
        """Return cameras (2, 3, n) after steps (6, n)."""
        return M + step.reshape(M.shape)

    def tangents(self, M: NDArray) -> NDArray:
        """Return the unit matrices (6, 2, 3, n), each with a single entry one."""
        entries = np.eye(6).reshape(6, 2, 3, 1)
        return np.broadcast_to(entries, (6, *M.shape))

    def gradient(self, M: NDArray, G: NDArray) -> NDArray:
        """Return the derivative by the entries (6, n)."""
        return G.reshape(6, -1)

    def inverse_curvature(self, M: NDArray, curvature: NDArray) -> NDArray:
        """Return the inverse curvature (3, 3, n) by a row, the same for both rows."""
        return inverse3(curvature)

    def product(self, inverse: NDArray, vector: NDArray) -> NDArray:
        """Return vectors (6, n) times the inverse curvature."""
        rows = vector.reshape(2, 3, -1)
        return np.einsum("abn,rbn->ran", inverse, rows).reshape(6, -1)

    def largest_length(self, step: NDArray) -> float:
        """Return infinity: any matrix is a camera."""
        return np.inf

    def limited(self, step: NDArray) -> NDArray:
        """Return the steps: any matrix is a camera."""
        return step


class HeldCameras:
    """Cameras that are held: they have no parameters, and no step moves them."""

    name = "held"
    n_parameters = 0
    calibrated = False
    scaled = False

    def moved(self, M: NDArray, step: NDArray) -> NDArray:
        """Return the cameras."""
        return M

    def tangents(self, M: NDArray) -> NDArray:
        """Return no derivative."""
        return np.zeros((0, *M.shape))

    def gradient(self, M: NDArray, G: NDArray) -> NDArray:
        """Return no derivative."""
        return np.zeros((0, M.shape[-1]))

    def inverse_curvature(self, M: NDArray, curvature: NDArray) -> NDArray:
        """Return no curvature."""
        return np.zeros((0, 0, M.shape[-1]))

    def product(self, inverse: NDArray, vector: NDArray) -> NDArray:
        """Return no step."""
        return vector

    def largest_length(self, step: NDArray) -> float:
        """Return infinity."""
        return np.inf

    def limited(self, step: NDArray) -> NDArray:
        """Return the steps, of no parameters."""
        return step


class CalibratedCameras:
    """
    Rotations times a scale.

    Parameters
    ----------
    scaled : bool
        Whether the scales are unknown (weak perspective); otherwise they stay as they
        are (orthographic).
    largest_turn : float
        As of `FrameOptions`.
    """

    calibrated = True

    def __init__(self, scaled: bool, largest_turn: float = FRAME_OPTIONS.largest_turn):
        self.scaled, self.largest_turn = scaled, largest_turn
        self.name = "weak_perspective" if scaled else "orthographic"
        self.n_parameters = 4 if scaled else 3

    def moved(self, M: NDArray, step: NDArray) -> NDArray:
        """Return cameras (2, 3, n) after steps w (3, n), or w and l (4, n)."""
        turned = rotated(M, step[:3])
        return np.exp(step[3]) * turned if self.scaled else turned

    def tangents(self, M: NDArray) -> NDArray:
        """Return ``M hat(e_c)``, and M itself where there are scales."""
        zero = np.zeros_like(M[:, 0])
        x, y, z = M[:, 0], M[:, 1], M[:, 2]
        rows = [(zero, z, -y), (-z, zero, x), (y, -x, zero)]  # m x e_c
        tangents = [np.stack(row, axis=1) for row in rows]
        return np.stack([*tangents, M] if self.scaled else tangents)

    def gradient(self, M: NDArray, G: NDArray) -> NDArray:
        """Return the derivative by the tangents (n_parameters, n)."""
        gradient = np.empty((self.n_parameters, M.shape[-1]))
        gradient[:3] = _cross(G, M).sum(axis=0)
        if self.scaled:
            gradient[3] = np.einsum("rai,rai->i", M, G)
        return gradient

    def inverse_curvature(self, M: NDArray, curvature: NDArray) -> NDArray:
        """Return the inverses (n_parameters, n_parameters, n) of the curvatures."""
        C, across, scale = tangent_curvature(M, curvature)
        C[:3] += RIDGE * C[:3].mean(axis=0)
        inverse = inverse3(C)
        if not self.scaled:
            return inverse
        # Inverse of [[C, c], [c^T, d]], c across and d scale, by the Schur complement
        # d - c^T C^-1 c. Where it is zero the scale does not move.
        turn = np.einsum("abn,bn->an", inverse, across)
        rest = scale - np.einsum("an,an->n", across, turn)
        rest = np.maximum(rest, RIDGE * scale)
        rest = np.divide(1.0, rest, where=rest > 0, out=np.zeros_like(rest))
        full = np.empty((4, 4, M.shape[-1]))
        full[:3, :3] = inverse + rest * turn[:, None] * turn
        full[:3, 3] = full[3, :3] = -rest * turn
        full[3, 3] = rest
        return full

    def product(self, inverse: NDArray, vector: NDArray) -> NDArray:
        """Return vectors (n_parameters, n) times the inverse curvature."""
        return np.einsum("abn,bn->an", inverse, vector)

    def largest_length(self, step: NDArray) -> float:
        """Return the step length at which a camera moves by the largest turn."""
        size = self._sizes(step).max(initial=0.0)
        return self.largest_turn / size if size > 0 else np.inf

    def limited(self, step: NDArray) -> NDArray:
        """Return steps that move no camera by more than the largest turn."""
        most = self.largest_turn
        return step * (most / np.maximum(self._sizes(step), most))

    def _sizes(self, step: NDArray) -> NDArray:
        """Return the angles of steps, or the logarithms of scales where larger."""
        angle = np.sqrt(np.einsum("an,an->n", step[:3], step[:3]))
        return np.maximum(angle, np.abs(step[3])) if self.scaled else angle


CAMERAS: dict[str, CameraModel] = {
    model.name: model
    for model in (AffineCameras(), CalibratedCameras(True), CalibratedCameras(False))
}


def camera_gram(M: NDArray) -> NDArray:
    """Return ``M^T M`` (6, n_frames) of cameras (2, 3, n_frames), packed."""
    return np.einsum("rpi,rpi->pi", M[:, ROWS], M[:, COLUMNS])


def tangent_curvature(
    M: NDArray, curvature: NDArray
) -> tuple[NDArray, NDArray, NDArray]:
    """
    Return the curvature ``tr(D_c A D_d^T)`` along the tangents of calibrated cameras.

    Parameters
    ----------
    M : ndarray of shape (2, 3, n_frames)
        M.
    curvature : ndarray of shape (6, n_frames)
        A, packed.

    Returns
    -------
    turns : ndarray of shape (6, n_frames)
        The block of rotations, packed: ``sum_r hat(m_r)^T A hat(m_r) = (tr A tr N - tr
        A N) I - tr(A) N - tr(N) A + A N + N A`` with ``N = M^T M``.
    across : ndarray of shape (3, n_frames)
        The column across rotations and logarithm of the scale, ``sum_r A m_r x m_r``.
    scale : ndarray of shape (n_frames,)
        The entry of the logarithm of the scale, ``tr(A N)``.
    """
    N = camera_gram(M)
    full_A, full_N = unpack3(curvature), unpack3(N)
    product = np.einsum("abi,bci->aci", full_A, full_N)
    scale = np.einsum("aai->i", product)
    trace_A, trace_N = curvature[:3].sum(axis=0), N[:3].sum(axis=0)
    turns = product[ROWS, COLUMNS] + product[COLUMNS, ROWS]
    turns -= trace_A * N + trace_N * curvature
    turns[:3] += trace_A * trace_N - scale
    pulled = np.einsum("abi,rbi->rai", full_A, M)
    return turns, _cross(pulled, M).sum(axis=0), scale


def rotated(M: NDArray, turns: NDArray) -> NDArray:
    """
    Return cameras times rotations, ``M exp(hat(w))``.

    Parameters
    ----------
    M : ndarray of shape (2, 3, n_frames)
        M.
    turns : ndarray of shape (3, n_frames)
        Rotation vectors w, in radians.

    Returns
    -------
    ndarray of shape (2, 3, n_frames)
        Rows ``m cos t + (m x w) sin(t) / t + w (w . m) (1 - cos t) / t^2``, t = |w|.
    """
    angle = np.sqrt(np.einsum("an,an->n", turns, turns))
    along = np.einsum("ran,an->rn", M, turns)[:, None]
    # sin(t) / t and (1 - cos(t)) / t^2 = 2 (sin(t/2) / t)^2, also for t = 0.
    first = np.sinc(angle / np.pi)
    second = 0.5 * np.sinc(angle / (2 * np.pi)) ** 2
    moved = np.cos(angle) * M + first * _cross(M, turns[None])
    return moved + second * along * turns


def nearest_calibrated(motion: NDArray) -> tuple[NDArray, NDArray]:
    """
    Return the orthonormal rows nearest to cameras, and their scales.

    Parameters
    ----------
    motion : ndarray of shape (n_frames, 2, 3)
        Cameras.

    Returns
    -------
    rows : ndarray of shape (n_frames, 2, 3)
        Their polar factors.
    scales : ndarray of shape (n_frames,)
        Means of their singular values.
    """
    rows, values, _ = polar(motion)
    return rows, values.mean(axis=1)


def full_rotations(motion: NDArray) -> tuple[NDArray, NDArray]:
    """
    Return rotations (n_frames, 3, 3) and scales of calibrated cameras.

    Parameters
    ----------
    motion : ndarray of shape (n_frames, 2, 3)
        Scaled orthonormal rows; NaN where a frame has no camera.

    Returns
    -------
    rotations : ndarray of shape (n_frames, 3, 3)
        Rotations of determinant one; the first two rows are those of the cameras.
    scales : ndarray of shape (n_frames,)
        Their scales.
    """
    dtype = motion.dtype
    motion = motion.astype(
        np.float64
    )  # squares may leave the range of single precision
    scales = np.sqrt(np.einsum("irc,irc->i", motion, motion) / 2)
    size = np.where(scales > 0, scales, 1.0)
    rows = motion / size[:, None, None]
    (x1, y1, z1), (x2, y2, z2) = rows[:, 0].T, rows[:, 1].T
    depth = [y1 * z2 - z1 * y2, z1 * x2 - x1 * z2, x1 * y2 - y1 * x2]
    rotations = np.concatenate([rows, np.stack(depth, axis=1)[:, None]], axis=1)
    return rotations.astype(dtype), scales.astype(dtype)


def _cross(a: NDArray, b: NDArray) -> NDArray:
    """Return the cross products of vectors (..., 3, n)."""
    return np.stack(
        [
            a[..., 1, :] * b[..., 2, :] - a[..., 2, :] * b[..., 1, :],
            a[..., 2, :] * b[..., 0, :] - a[..., 0, :] * b[..., 2, :],
            a[..., 0, :] * b[..., 1, :] - a[..., 1, :] * b[..., 0, :],
        ],
        axis=-2,
    )
