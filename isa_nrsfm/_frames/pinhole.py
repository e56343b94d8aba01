"""Perspective cameras: images that weak-perspective cameras would show.

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

from isa_nrsfm._frames.camera_models import full_rotations
from isa_nrsfm._prepare.robust import spatial_median
from isa_nrsfm._tables.blocks import FrameBlocks
from isa_nrsfm._tables.tracks import centred_frames


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
            shown = np.isfinite(middle[:, 0])
            middle[shown] = spatial_median(rows[shown])
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
        far = f / place[:, 2:]
        R = far[..., None] * scales[:, None, None] * (turns.mT @ R)[:, :2]
        return R, far * place[:, :2] + self.centre[:, 0]

    def positions(self, motion: NDArray, translation: NDArray) -> NDArray:
        """Return the shapes' origins (n, 3) in the axes of the real camera."""
        _, scales = full_rotations(motion)
        f = np.full(len(motion), self.focal_length)
        place = np.column_stack([translation - self.centre[:, 0], f])
        return place / scales[:, None]


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


def zoomed_table(table: FrameBlocks, shares: NDArray, centre: Any) -> FrameBlocks:
    """Return the rows (n, 2, J) that cameras with the mean focal length would show."""
    middle = np.reshape(centre, (2, 1))
    return table.derive(lambda r, share: zoomed(r, share[..., None], middle), shares)
