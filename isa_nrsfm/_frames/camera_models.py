"""Camera models: the 2x3 matrices that they allow, and steps between these.

A camera M_i is a free 2x3 matrix (affine), the first two rows of a rotation times a
scale (weak perspective), or such rows with a known scale (orthographic). Other modules
treat cameras alike: they compute the derivative ``G_i = dF/dM_i`` of an objective F and
its curvature ``A_i`` by the rows of M_i. A model transforms both to its parameters.

A step of a calibrated camera is a rotation vector w and a change l of the logarithm of
its scale ::

    M(w, l) = exp(l) M exp(hat(w)),   hat(w) v = w x v.

Its tangents are the derivatives by w, ``D_c = M hat(e_c)`` for c = x, y, z, and by l,
``D_4 = M``. With the rows m_r of M and G_r of G the gradient is ``sum_r G_r x m_r`` by
w and ``<M, G>`` by l. The curvature is ``tr(D_c A D_d^T)``. The frame is the last
index of all arrays of models: M and G are (2, 3, n_frames), steps (n_parameters,
n_frames).

A pinhole camera with focal length f and principal point c shows a point X of its axes
at ``w = f (X_1, X_2) / X_3 + c``. Two steps make such images weak-perspective:

1. A virtual camera is turned about the centre of the camera until the middle of the
   object is on its axis. With the smallest rotation H that does so, and ``q = H ((w -
   c) / f, 1)``, it shows ``y = f (q_1, q_2) / q_3``, for points at any depth.
2. With scale s, rotation R and position t of a weak-perspective camera, and the depth
   ``z = s r_3 . S`` of a point S, ``y (1 + z / f) = s R_12 S + t`` (POSIT: DeMenthon,
   Davis, "Model-based object pose in 25 lines of code", 1995).

The rotation of the real camera is ``H^T R``, and ``T = H^T (t, f) / s`` the position of
the shapes' origin in its axes. Public cameras (n, 2, 3) and translations (n, 2) are
those of the weak-perspective camera with the same rotation and position: ``s_i = f /
T_3``, ``t_i = s_i T_12 + c``.
"""

from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from isa_nrsfm import _linalg as linalg
from isa_nrsfm._prepare.robust import spatial_median
from isa_nrsfm._tables import centred_frames

# Largest rotation of a camera in one step, in radians, and largest change of the
# logarithm of its scale.
LARGEST_TURN = 1.0
# Places of the entries of a packed symmetric 6x6 matrix
_PLACES = linalg.unpacked(np.arange(21))


class AffineCameras:
    """Free 2x3 matrices; the parameters are their entries, row by row.

    name: the value of the parameter `camera`, or held.
    n_parameters: length of a step of one camera; zero for cameras that are held.
    calibrated: whether cameras are scaled rotations.
    scaled: whether each camera has a scale of its own.
    """

    calibrated = False
    scaled = True

    def __init__(self, held: bool = False):
        self.name = "held" if held else "affine"
        self.n_parameters = 0 if held else 6

    def moved(self, M: NDArray, step: NDArray) -> NDArray:
        """Return cameras (2, 3, n) after steps (p, n)."""
        return M + step.reshape(M.shape) if self.n_parameters else M

    def steps_between(self, first: NDArray, second: NDArray) -> NDArray:
        """Return the steps (n, p) that move cameras (n, 2, 3) to others."""
        return (second - first).reshape(-1, 6)[:, : self.n_parameters]

    def tangents(self, M: NDArray) -> NDArray:
        """Return the derivatives (p, 2, 3, n) of cameras."""
        entries = np.eye(6)[: self.n_parameters].reshape(-1, 2, 3, 1)
        return np.broadcast_to(entries, (len(entries), *M.shape))

    def gradient(self, M: NDArray, G: NDArray) -> NDArray:
        """Return dF/dparameters (..., p, n) from G = dF/dM (..., 2, 3, n)."""
        return G.reshape(*G.shape[:-3], 6, G.shape[-1])[..., : self.n_parameters, :]

    def curvature(self, M: NDArray, A: NDArray) -> NDArray:
        """Return ``tr(D_c A D_d^T)`` along the tangents, packed, as A (6, n) is."""
        packed = np.zeros((21, A.shape[-1]))
        for row in slice(3), slice(3, 6):
            packed[_PLACES[row, row][linalg.ROWS, linalg.COLUMNS]] = A
        return packed

    def second(self, M: NDArray, G: NDArray, gradient: NDArray) -> NDArray:
        """Return ``<G, D_cd>`` with the second derivatives D_cd: zero."""
        return np.zeros(1)

    def inverse_curvature(self, M: NDArray, curvature: NDArray) -> NDArray:
        """Return inverses (3, 3, n) of curvatures (6, n), the same for each row."""
        return linalg.inverse3(curvature)

    def largest_length(self, step: NDArray) -> float:
        """Return the largest step length, one for all cameras, along a direction."""
        return np.inf

    def limited(self, step: NDArray) -> NDArray:
        """Return steps, which have no largest length."""
        return step

    def nearest(self, motion: NDArray) -> NDArray:
        """Return the cameras of this model that are nearest to any (n, 2, 3)."""
        return motion


class CalibratedCameras:
    """Rotations times a scale, which is fitted if `scaled`, and fixed otherwise."""

    calibrated = True

    def __init__(self, scaled: bool):
        self.scaled = scaled
        self.name = "weak_perspective" if scaled else "orthographic"
        self.n_parameters = 4 if scaled else 3

    def moved(self, M: NDArray, step: NDArray) -> NDArray:
        """Return cameras (2, 3, n) after steps w (3, n), or w and l (4, n)."""
        turned = rotated(M, step[:3])
        return np.exp(step[3]) * turned if self.scaled else turned

    def steps_between(self, first: NDArray, second: NDArray) -> NDArray:
        """Return the steps (n, p) that move cameras (n, 2, 3) to others."""
        (R_1, s_1), (R_2, s_2) = map(full_rotations, (first, second))
        turns = Rotation.from_matrix(R_1.swapaxes(1, 2) @ R_2).as_rotvec()
        return np.column_stack([turns, np.log(s_2 / s_1)])[:, : self.n_parameters]

    def tangents(self, M: NDArray) -> NDArray:
        """Return ``M hat(e_c)``, and M itself where there are scales."""
        turned = turning(M)
        return np.concatenate([turned, M[None]]) if self.scaled else turned

    def gradient(self, M: NDArray, G: NDArray) -> NDArray:
        """Return the derivative by the tangents (..., p, n)."""
        return np.einsum("crai,...rai->...ci", self.tangents(M), G)

    def curvature(self, M: NDArray, A: NDArray) -> NDArray:
        """Return ``tr(D_c A D_d^T)``, along the tangents, packed, as A (6, n) is."""
        D = self.tangents(M)
        DA = np.einsum("crai,abi->crbi", D, linalg.unpack3(A))
        shape = self.n_parameters, 6, M.shape[-1]
        return linalg.packed_products(DA.reshape(shape), D.reshape(shape))

    def second(self, M: NDArray, G: NDArray, gradient: NDArray) -> NDArray:
        """Return ``<G, D_cd>`` with the second derivatives D_cd, packed.

        Of two rotations, row by row, ``D_cd = (e_c m_d + e_d m_c) / 2 - m d_cd``. With
        the scale ``D_c4 = D_c``, ``D_44 = M``.
        """
        mixed = np.einsum("rai,rbi->abi", G, M)
        second = np.empty((len(gradient), *gradient.shape))
        second[:3, :3] = 0.5 * (mixed + mixed.swapaxes(0, 1))
        second[:3, :3] -= np.einsum("aai->i", mixed) * np.eye(3)[:, :, None]
        second[3:], second[:, 3:] = gradient, gradient[:, None]
        return np.asarray(second[linalg.pair_indices(len(gradient))])

    def inverse_curvature(self, M: NDArray, curvature: NDArray) -> NDArray:
        """Return inverses (p, p, n) of curvatures (6, n) of each row.

        A scale without curvature does not move.
        """
        C = linalg.unpacked(self.curvature(M, curvature))
        turns = C[linalg.ROWS, linalg.COLUMNS]
        turns[linalg.DIAGONAL] += 1e-9 * turns[linalg.DIAGONAL].mean(axis=0)
        inverse = linalg.inverse3(turns)
        if not self.scaled:
            return inverse
        # By the Schur complement d - c^T B^-1 c in [[B, c], [c^T, d]]
        across, scale = C[:3, 3], C[3, 3]
        turn = np.einsum("abn,bn->an", inverse, across)
        pivot = np.maximum(scale - np.einsum("an,an->n", across, turn), 1e-9 * scale)
        inverse_pivot = np.divide(1.0, pivot, where=pivot > 0, out=np.zeros_like(pivot))
        C[:3, :3] = inverse + inverse_pivot * turn[:, None] * turn
        C[:3, 3] = C[3, :3] = -inverse_pivot * turn
        C[3, 3] = inverse_pivot
        return C

    def largest_length(self, step: NDArray) -> float:
        """Return the step length at which a camera moves by the largest turn."""
        size = self._sizes(step).max(initial=0.0)
        return LARGEST_TURN / size if size > 0 else np.inf

    def limited(self, step: NDArray) -> NDArray:
        """Return steps that move no camera by more than the largest turn."""
        return step * (LARGEST_TURN / np.maximum(self._sizes(step), LARGEST_TURN))

    def nearest(self, motion: NDArray) -> NDArray:
        """Return the cameras of this model that are nearest to any (n, 2, 3)."""
        rows, scales = nearest_calibrated(motion)
        return scales[:, None, None] * rows if self.scaled else rows

    def _sizes(self, step: NDArray) -> NDArray:
        """Return the angles of steps, or the changes of log scale where larger."""
        angle = np.sqrt(np.einsum("a...,a...->...", step[:3], step[:3]))
        return np.maximum(angle, np.abs(step[3])) if self.scaled else angle


CameraModel = AffineCameras | CalibratedCameras
_MODELS = AffineCameras(), CalibratedCameras(True), CalibratedCameras(False)
CAMERAS: dict[str, CameraModel] = {model.name: model for model in _MODELS}


def turning(M: NDArray) -> NDArray:
    """Return ``M hat(e_c)`` (3, 2, 3, ...), whose rows are ``m x e_c``."""
    x, y, z = M[:, 0], M[:, 1], M[:, 2]
    D = np.zeros((3, *M.shape))
    D[0, :, 1], D[1, :, 0] = z, -z
    D[0, :, 2], D[2, :, 0] = -y, y
    D[1, :, 2], D[2, :, 1] = x, -x
    return D


def rotated(M: NDArray, turns: NDArray) -> NDArray:
    """Return cameras (2, 3, ...) times rotations w (3, ...), ``M exp(hat(w))``.

    Rows are ``m cos t + (m x w) sin(t) / t + w (w . m) (1 - cos t) / t^2``, t = |w|.
    """
    angle = np.sqrt(np.einsum("a...,a...->...", turns, turns))
    along = np.einsum("ra...,a...->r...", M, turns)[:, None]
    # sin(t) / t and (1 - cos(t)) / t^2 = 2 (sin(t/2) / t)^2, also for t = 0.
    first = np.sinc(angle / np.pi)
    second = 0.5 * np.sinc(angle / (2 * np.pi)) ** 2
    across = np.einsum("cra...,c...->ra...", turning(M), turns)
    return np.cos(angle) * M + first * across + second * along * turns


def nearest_calibrated(motion: NDArray) -> tuple[NDArray, NDArray]:
    """Return the orthonormal rows (n, 2, 3) nearest to cameras, and scales (n,).

    The root of ``G = M M^T`` with determinant d^2 is ``(G + d I) / t``, where ``t^2 =
    tr(G) + 2 d``. If rows are nearly parallel, an SVD keeps all digits.
    """
    size = np.linalg.norm(motion, axis=(1, 2))
    x, y = (motion / np.where(size > 0, size, 1.0)[:, None, None]).transpose(1, 0, 2)
    d = np.linalg.norm(np.cross(x, y), axis=1)
    p, q, r = np.vecdot(x, x) + d, np.vecdot(x, y), np.vecdot(y, y) + d
    t, flat = np.sqrt(1.0 + 2.0 * d), ~(d > 0.1)
    divisor = np.where(flat, 1.0, d * t)
    p, q, r = (np.stack([p, q, r]) / divisor)[..., None]
    rows, scales = np.stack([r * x - q * y, p * y - q * x], axis=1), 0.5 * t * size
    if flat.any():
        rows[flat], values, _ = linalg.polar(motion[flat])
        scales[flat] = values.mean(axis=1)
    return rows, scales


def full_rotations(motion: NDArray) -> tuple[NDArray, NDArray]:
    """Return rotations (n, 3, 3) and scales (n,) of cameras (n, 2, 3); NaN stays."""
    dtype = motion.dtype
    motion = motion.astype(np.float64)  # squares may leave the range of float32
    scales = np.sqrt(np.einsum("irc,irc->i", motion, motion) / 2)
    size = np.where(scales > 0, scales, 1.0)
    rows = motion / size[:, None, None]
    depth = np.cross(rows[:, 0], rows[:, 1])
    rotations = np.concatenate([rows, depth[:, None]], axis=1)
    return rotations.astype(dtype), scales.astype(dtype)


def rigid_cameras(W: NDArray, mean_shape: NDArray) -> NDArray:
    """Return affine cameras (n, 2, 3) by least squares, for W (2 n, J), a shape (J, 3).

    If the mean shape is flat, they are the solutions of least norm.
    """
    return (W @ np.linalg.pinv(mean_shape, rcond=1e-10).T).reshape(-1, 2, 3)


def mean_view(motion: NDArray) -> NDArray | None:
    """Return the mean (2, 3) of cameras (n, 2, 3); None if they have no common view."""
    mean = motion.mean(axis=0)
    smaller = np.linalg.svd(mean, compute_uv=False)[1]
    # Relative to the root mean square of a camera's row
    root_mean_square = np.sqrt(np.mean(np.sum(motion**2, axis=(1, 2))) / 2)
    return mean if smaller > 0.2 * root_mean_square else None


def distances(rows: NDArray, *fit: NDArray) -> NDArray:
    """Return distances (n, J) of points (n, 2, J) from a fit, NaN if missing."""
    return linalg.lengths(residuals(rows, *fit))


def residuals(
    rows: NDArray, shapes: NDArray, motion: NDArray, position: NDArray, alpha: NDArray
) -> NDArray:
    """Return points (n, 2, J) minus their images."""
    model = stacked_motion(motion, alpha) @ shapes.reshape(-1, shapes.shape[2])
    return rows - model.reshape(rows.shape) - position[..., None]


def centred_residuals(
    rows: NDArray, weights: NDArray, shapes: NDArray, motion: NDArray, alpha: NDArray
) -> NDArray:
    """Return `residuals` of weighted mean zero; weights (n, J), zero if missing."""
    residual = residuals(rows, shapes, motion, np.zeros((1, 2)), alpha)
    total = weights.sum(axis=1)[:, None]  # zero where no point counts
    position = np.einsum("ij,icj->ic", weights, np.nan_to_num(residual))
    residual -= (position / np.where(total > 0, total, 1.0))[..., None]
    return residual


def stacked_motion(motion: NDArray, alpha: NDArray) -> NDArray:
    """Return the motion factor ``(1, alpha_i) (x) M_i`` (2 n, 3 K + 3)."""
    c = np.concatenate([np.ones((len(alpha), 1)), alpha], axis=1)
    return np.einsum("ik,irc->irkc", c, motion).reshape(-1, 3 * c.shape[1])


def line_of_sight(motion: NDArray) -> NDArray:
    """Return ``s r_3`` (n, 3) of cameras (n, 2, 3): products with points are depths."""
    R, scales = full_rotations(motion)
    return scales[:, None] * R[:, 2]


def compose(mean_shape: NDArray, basis: NDArray, alpha: NDArray) -> NDArray:
    """Return the shapes of frames, ``B_0 + sum_k alpha_ik B_k`` (n, ...)."""
    return mean_shape + np.tensordot(alpha, basis, axes=1)


def project(shapes: NDArray, motion: NDArray, translation: NDArray) -> NDArray:
    """Return images (n, J, 2) of shapes (n, J, 3); motion (n, 2, 3) or (2, 3)."""
    return shapes @ np.swapaxes(motion, -1, -2) + np.expand_dims(translation, -2)


def pose_effect(motion: NDArray, alpha: NDArray) -> NDArray:
    """Return the regression (3, K) of coefficients (n, K) on `_yaw_terms`.

    Predictions have mean zero over the frames.
    """
    mask = np.isfinite(alpha).all(axis=1)
    terms = _yaw_terms(motion[mask])
    effect = np.linalg.lstsq(terms.T, alpha[mask])[0]
    effect[0] -= effect.T @ terms.mean(axis=1)
    return np.asarray(effect)


def pose_part(motion: NDArray, effect: NDArray) -> NDArray:
    """Return the coefficients (n, K) that cameras (n, 2, 3) predict."""
    part = (_yaw_terms(motion)[..., None] * effect[:, None]).sum(axis=0)
    return part.astype(motion.dtype, copy=False)


def _yaw_terms(motion: NDArray) -> NDArray:
    """Return 1, s and s^2 (3, n) of cameras (n, 2, 3), with s the sine of the yaw.

    It is the part of the line of sight along x: of objects that are seen from above,
    the yaw jumps, and s does not.
    """
    s = full_rotations(motion)[0][:, 2, 0]
    return np.stack([np.ones_like(s), s, s**2])


class Pinhole(NamedTuple):
    """A perspective camera, in units of the table.

    robust: whether the middle of the points of a frame is their median, or their mean.
    near: whether depths of points are taken into account, or only virtual cameras.
    """

    focal_length: float
    principal_point: tuple[float, float]
    robust: bool = False
    near: bool = True

    @property
    def centre(self) -> NDArray:
        """The principal point (2, 1)."""
        return np.reshape(self.principal_point, (2, 1))

    def turns(self, rows: NDArray) -> NDArray:
        """Return rotations H (n, 3, 3) of virtual cameras.

        Their axes go through the middles of the points.
        """
        rows = rows.astype(np.float64, copy=False)
        middle = centred_frames(rows)[1].translation
        if self.robust:
            mask = np.isfinite(middle[:, 0])
            middle[mask] = spatial_median(rows[mask])
        return turns_to(self.rays(middle[..., None])[..., 0])

    def virtual(self, rows: NDArray) -> NDArray:
        """Return images (n, 2, J) of virtual cameras."""
        q = self.turns(rows) @ self.rays(rows)
        return self.focal_length * q[:, :2] / q[:, 2:]

    def rays(self, rows: NDArray) -> NDArray:
        """Return the rays (n, 3, J) of image points, with third coordinate one."""
        v = (rows - self.centre) / self.focal_length
        return np.concatenate([v, np.ones_like(v[:, :1])], axis=1)

    def straight(self, images: NDArray, depths: NDArray) -> NDArray:
        """Return weak-perspective images (n, 2, J), for depths (n, J)."""
        return images * (1.0 + depths / self.focal_length)[:, None]

    def projected(
        self, shapes: NDArray, motion: NDArray, translation: NDArray
    ) -> NDArray:
        """Return images (n, J, 2) of shapes (n, J, 3), with cameras as `real` has them.

        Unless `near`, all points have the distance of the origin.
        """
        R, _ = full_rotations(motion)
        place = self.positions(motion, translation)
        turned = shapes @ R.mT
        if not self.near:
            sight = place / np.linalg.norm(place, axis=1, keepdims=True)
            turned = turned - turned @ (sight[..., None] * sight[:, None])
        X = turned + place[:, None]
        return self.focal_length * X[..., :2] / X[..., 2:] + self.centre[:, 0]

    def real(
        self, rows: NDArray, motion: NDArray, translation: NDArray
    ) -> tuple[NDArray, NDArray]:
        """Return cameras and translations of the real camera, from virtual ones."""
        f, turns = self.focal_length, self.turns(rows)
        R, scales = full_rotations(motion)
        place = np.column_stack([translation, np.full(len(translation), f)])
        place = (turns.mT @ place[..., None])[..., 0]  # s T
        ratio = f / place[:, 2:]
        R = ratio[..., None] * scales[:, None, None] * (turns.mT @ R)[:, :2]
        return R, ratio * place[:, :2] + self.centre[:, 0]

    def positions(self, motion: NDArray, translation: NDArray) -> NDArray:
        """Return the shapes' origins (n, 3) in the axes of the real camera."""
        _, scales = full_rotations(motion)
        f = np.full(len(motion), self.focal_length)
        return np.column_stack([translation - self.centre[:, 0], f]) / scales[:, None]


def pinhole_of(focal_length: Any, point: Any, *kind: bool) -> Pinhole:
    """Return the camera with one or several focal lengths and a principal point."""
    x, y = map(float, point)
    return Pinhole(common(focal_length), (x, y), *kind)


def turns_to(rays: NDArray) -> NDArray:
    """Return the smallest rotations (n, 3, 3) of rays (n, 3) to the third axis."""
    axis = np.eye(3)[2]
    rays = rays / np.linalg.norm(rays, axis=1, keepdims=True)
    sums = (rays + axis)[:, None]
    H = np.eye(3) - sums.mT @ sums / (1.0 + rays[:, 2, None, None])
    return H + 2.0 * axis[:, None] * rays[:, None]


def common(focal_length: Any) -> float:
    """Return a focal length, or the geometric mean of several."""
    if not np.ndim(focal_length):
        return float(focal_length)
    return float(np.exp(np.mean(np.log(focal_length))))


def focal_shares(focal_length: Any, n_frames: int) -> tuple[NDArray, ...]:
    """Return the mean of focal lengths over those of frames (n, 1); none for one."""
    if not np.ndim(focal_length):
        return ()
    focal = np.asarray(focal_length, dtype=float)
    if focal.shape != (n_frames,) or not (focal > 0).all():
        raise ValueError(
            "focal_length must be one positive number, or one for each of the "
            f"{n_frames} rows of the table; got shape {focal.shape}. For tables of "
            "other lengths fit (x - x0) / f, (y - y0) / f with focal_length=1, "
            "principal_point=(0, 0)"
        )
    return (np.asarray(common(focal) / focal[:, None]),)


def zoomed(rows: NDArray, share: NDArray, centre: NDArray) -> NDArray:
    """Return coordinates with their distances from a centre times a share."""
    return ((rows - centre) * share + centre).astype(rows.dtype)
