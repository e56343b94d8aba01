"""Uncertainty of depths and rotations of calibrated cameras.

A frame has the unknowns q: rotation vector, logarithm of the scale, coefficients. Their
tangent T_i of the image and Z_i of the depths give the covariance of the depths ::

    Z_i (T_i^T T_i / v + diag(0, I))^-1 Z_i^T.

The variance v of the misfit is not that of a coordinate. Deformation that K basis
shapes leave is common to many points, and what looks like a rotation of the frame is
taken for one. How much of it, is seen in the directions that affine cameras could
explain in addition: v is the mean square of the residual along these.

The depth of all shapes has an uncertainty of its own, which ends in all frames alike:

- the scale c of the depth. Its information is that of the residual of ``dS / d log c``
  after the fit of q; the prior of the extents pulls at it where that is small; and the
  error of the rotations, as a share of their spread, acts as errors in variables do;
- the depths of single points of the shapes, which only turned frames show;
- the deformation that the basis shapes leave, which has a depth, too.
"""

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from isa_nrsfm._frames.camera_models import full_rotations

# The shapes follow a change of the scale of the depth, so that its information is
# smaller than with known shapes. Measured on faces with 3 to 9 basis shapes that turn
# by 2 to 10 degrees, where the true scale is known.
SHAPES_FOLLOW = 4.0
# Standard deviation of the logarithm of the ratio of depth and width under the prior.
PRIOR_DEVIATION = 0.7
# With a larger relative standard deviation of their scale, depths are not determined.
# Faces of known shape that turn by 10 degrees have 0.05 (error of the depths 0.13), by
# 6 degrees 0.2 to 0.4 (0.25), by 4 degrees 0.5 to 1 (0.7).
LARGEST_SCALE = 0.15
TINY = np.finfo(float).tiny
# Frames from which the uncertainty of the shapes is estimated.
MOST_FRAMES = 200


class DepthCertainty(NamedTuple):
    """
    Uncertainty of a fit with calibrated cameras, for frames of size one.

    Attributes
    ----------
    misfit : float
        Variance v of the residual along changes of the camera, as a share of the noise
        variance of the model.
    scale : float
        Relative standard deviation of the scale of all depths.
    points : float
        Variance of the depth of a point, by the shapes.
    turns : ndarray of shape (n_components, 3, n_components, 3) or None
        Covariance of the rotation vectors w_k that the basis shapes ``B_k + w_k x B_0``
        contain.
    total : float
        Root mean square error of the depths of all frames that is to be expected,
        relative to their root mean square.
    """

    misfit: float = 1.0
    scale: float = np.nan
    points: float = np.nan
    total: float = np.nan
    turns: NDArray | None = None

    @property
    def determined(self) -> bool:
        """Whether the table determines depths; also if that was not measured."""
        return not self.scale > LARGEST_SCALE

    @property
    def advice(self) -> str:
        """Reason and way out for depths that are not determined."""
        return (
            "the depth of the shapes is not determined: its scale has a standard "
            f"deviation of {100 * self.scale:.0f} %, because the objects turn too "
            "little in these images for the noise and deformation that the model "
            "leaves. Fit a table in which they turn, and transform this one with that "
            'model; or take affine shapes (camera="affine"). See "How sure is the '
            'depth?" in the documentation'
        )


NOT_MEASURED = DepthCertainty()


class _Frame(NamedTuple):
    """Unknowns of a frame: p for the camera, then K coefficients."""

    image: NDArray  # T (2 * n_points, p + K), rows of unseen points zero
    depth: NDArray  # Z (n_points, p + K), centred over the seen points
    z: NDArray  # (n_points,), the depths, centred likewise
    shape: NDArray  # (3, n_points), likewise
    seen_by: NDArray  # (2, 3), the camera
    seen: NDArray  # (n_points,)


def _frame(
    shapes: NDArray, R: NDArray, scale: float, alpha: NDArray, seen: NDArray, free: bool
) -> _Frame:
    """Compute the tangents of a frame: R (3, 3), seen (n_points,)."""
    shapes = shapes - shapes[:, :, seen].mean(axis=2, keepdims=True)
    shape = shapes[0] + np.tensordot(alpha, shapes[1:], 1)
    turned = [np.cross(axis, shape, axisb=0, axisc=0) for axis in np.eye(3)]
    moved = np.stack([*turned, *([shape] if free else []), *shapes[1:]])
    changes = scale * R @ moved  # (p + K, 3, n_points)
    image = np.where(seen, changes[:, :2], 0.0).reshape(len(moved), -1).T
    z = scale * R[2] @ shape
    return _Frame(image, changes[:, 2].T, z, shape, scale * R[:2], seen)


def _covariance(frame: _Frame, variance: float, n_components: int) -> NDArray:
    """Compute the posterior covariance of the unknowns (p + K, p + K) of a frame."""
    precision = frame.image.T @ frame.image / variance
    last = np.arange(len(precision))[len(precision) - n_components :]
    precision[last, last] += 1.0
    return np.linalg.pinv(precision, hermitian=True)


def depth_deviations(
    shapes: NDArray,
    motion: NDArray,
    alpha: NDArray,
    seen: NDArray,
    noise: float,
    certainty: DepthCertainty,
    free: bool,
) -> NDArray:
    """
    Compute the standard deviations of the depths of the points of frames.

    Parameters
    ----------
    shapes : ndarray of shape (n_components + 1, 3, n_points)
        Shapes with coefficients that are drawn from N(0, I).
    motion : ndarray of shape (n_frames, 2, 3)
        Calibrated cameras, NaN where a frame has none.
    alpha : ndarray of shape (n_frames, n_components)
        Coefficients.
    seen : ndarray of bool, shape (n_frames, n_points)
        Visible points.
    noise : float
        Noise variance of the model.
    certainty : DepthCertainty
        Of the model.
    free : bool
        Whether the scales of the cameras are unknown.

    Returns
    -------
    ndarray of shape (n_frames, n_points)
        In the units of the frames, whose size is one.
    """
    deviations = np.full(seen.shape, np.nan)
    rotations, scales = full_rotations(motion)
    for i in np.flatnonzero(np.isfinite(scales)):
        frame = _frame(shapes, rotations[i], scales[i], alpha[i], seen[i], free)
        covariance = _covariance(frame, certainty.misfit * noise, len(alpha[i]))
        own = np.einsum("jp,pq,jq->j", frame.depth, covariance, frame.depth)
        common = certainty.points + (certainty.scale * frame.z) ** 2
        deviations[i] = np.sqrt(own + common)
    return deviations


def depth_certainty(
    shapes: NDArray,
    motion: NDArray,
    alpha: NDArray,
    rows: NDArray,
    noise: float,
    *,
    n_frames: int,
    extent_weight: float,
    basis_std: float,
    least_misfit: float,
    free: bool,
) -> DepthCertainty:
    """
    Estimate the uncertainty of a fit from some of its frames.

    Parameters
    ----------
    shapes, motion, alpha, noise, free
        As in `depth_deviations`.
    rows : ndarray of shape (n_chosen, 2, n_points)
        The chosen frames, divided by their sizes; NaN where a point is missing.
    n_frames : int
        Number of all frames of the fit.
    extent_weight : float
        Weight of the prior of the extents, for each coordinate.
    basis_std : float
        Standard deviation of the images of basis shapes under their prior.
    least_misfit : float
        Lower bound of v. Basis shapes can follow the images of motion capture to a
        smaller residual than their depths deserve.

    Returns
    -------
    DepthCertainty
        NaN if fewer than two frames are given.
    """
    if len(rows) < 2:
        return DepthCertainty()
    rotations, scales = full_rotations(motion)
    seen = np.isfinite(rows).all(axis=1)
    frames = [
        _frame(shapes, *each, free)
        for each in zip(rotations, scales, alpha, seen, strict=True)
    ]
    variance, residual = _misfit(frames, rows, alpha.shape[1])
    variance = max(variance, least_misfit)
    prior = extent_weight * 2 * seen.sum() / len(rows) * 4 / 9
    scale, own = _scale(
        frames, rotations, alpha, variance, residual, prior=prior, n_frames=n_frames
    )
    turns = _turns(frames, shapes[0], alpha, n_frames / variance, basis_std)
    # Depths of the points of all shapes, and of the deformation that is missing
    moments = np.insert(alpha**2, 0, 1.0, axis=1)
    size = np.mean(scales**2)
    shown = np.mean(
        _spread(rotations)[:, None] * scales[:, None] ** 2 * moments, axis=0
    )
    by_shapes = variance * size / n_frames
    by_shapes *= np.sum(moments.mean(axis=0) / np.maximum(shown, TINY))
    points = float(by_shapes + residual * (1.0 - residual / variance))
    depth = np.mean([np.mean(frame.z**2) for frame in frames])
    relative = (own + points) / max(depth, TINY)
    total = float(np.sqrt(relative + scale**2))
    return DepthCertainty(variance / noise, scale, points, total, turns)


def _misfit(
    frames: list[_Frame], rows: NDArray, n_components: int
) -> tuple[float, float]:
    """Estimate the variance of residuals along changes of the camera, and of all."""
    square = along = freedom = 0.0
    for frame, row in zip(frames, rows, strict=True):
        n_camera = frame.image.shape[1] - n_components
        n_further = 6 - n_camera
        centred = row - np.nanmean(row, axis=1, keepdims=True)
        rest = np.where(frame.seen, centred - frame.seen_by @ frame.shape, 0.0).ravel()
        affine = np.kron(np.eye(2), np.where(frame.seen, frame.shape, 0.0).T)
        affine = _unexplained(frame, affine)
        further = np.linalg.svd(affine, full_matrices=False)[0][:, :n_further]
        along += float(np.sum((further.T @ rest) ** 2)) / n_further
        square += float(rest @ rest)
        freedom += max(2 * frame.seen.sum() - 2 - frame.image.shape[1], 1)
    size = np.mean([np.sum(frame.seen_by**2) / 2 for frame in frames])
    residual = max(square / freedom, float(np.finfo(float).eps * size))
    return max(along / len(frames), residual), residual


def _unexplained(frame: _Frame, change: NDArray) -> NDArray:
    """Project changes (2 * n_points, m) of the image off the unknowns of a frame."""
    tangent = np.linalg.qr(frame.image)[0]
    return change - tangent @ (tangent.T @ change)


def _turns(
    frames: list[_Frame],
    mean_shape: NDArray,
    alpha: NDArray,
    weight: float,
    basis_std: float,
) -> NDArray:
    """Compute the covariance (K, 3, K, 3) of w_k in shapes ``B_k + w_k x B_0``."""
    n_chosen, K = alpha.shape
    turned = np.stack([np.cross(e, mean_shape, axisb=0, axisc=0) for e in np.eye(3)])
    precision, images = np.zeros((3 * K, 3 * K)), np.zeros((3, 3))
    for frame, coefficients in zip(frames, alpha, strict=True):
        change = np.where(frame.seen, frame.seen_by @ turned, 0.0).reshape(3, -1).T
        images += change.T @ change
        change = _unexplained(frame, change)
        precision += np.kron(np.outer(coefficients, coefficients), change.T @ change)
    # The prior of the basis shapes: the deviation of their images is basis_std
    precision = weight * precision + np.kron(np.eye(K), images / basis_std**2)
    covariance = np.linalg.pinv(precision / n_chosen, hermitian=True)
    return np.asarray(covariance).reshape(K, 3, K, 3)


def _scale(
    frames: list[_Frame],
    rotations: NDArray,
    alpha: NDArray,
    variance: float,
    residual: float,
    *,
    prior: float,
    n_frames: int,
) -> tuple[float, float]:
    """
    Estimate the relative standard deviation of the scale of the depth.

    Also returned is the mean variance of a depth by the unknowns of its frame.
    """
    axis = _mean_view(rotations)[2]
    own_share = _unpredicted(rotations[:, :2] @ axis, alpha)
    own, turn, information = np.zeros((3, len(frames)))
    for i, (frame, R) in enumerate(zip(frames, rotations, strict=True)):
        covariance = _covariance(frame, variance, alpha.shape[1])
        own[i] = np.einsum("jp,pq,jq->j", frame.depth, covariance, frame.depth).mean()
        error = covariance[:3, :3]
        turn[i] = np.trace(error) - R[2] @ error @ R[2]
        stretched = np.outer(axis, axis @ frame.shape)
        change = np.where(frame.seen, frame.seen_by @ stretched, 0.0).ravel()
        pulled = frame.image.T @ change
        information[i] = change @ change - pulled @ covariance @ pulled / variance
    shown = max(float(information.mean()), 0.0) * own_share / SHAPES_FOLLOW
    spread = max(float(_spread(rotations).mean()) * own_share, TINY)
    log_scale = np.sqrt(
        variance / max(n_frames * shown, TINY)
        + (turn.mean() / spread) ** 2
        + (PRIOR_DEVIATION * prior / (shown / residual + prior)) ** 2
    )
    # At most three deviations of the prior
    return float(np.expm1(min(log_scale, 3 * PRIOR_DEVIATION))), float(own.mean())


def _mean_view(rotations: NDArray) -> NDArray:
    """Compute the rotation (3, 3) that is nearest to all rotations (n, 3, 3)."""
    U, _, Vt = np.linalg.svd(rotations.mean(axis=0))
    return np.asarray(U @ np.diag([1.0, 1.0, np.linalg.det(U @ Vt)]) @ Vt)


def _spread(rotations: NDArray) -> NDArray:
    """Compute squared sines (n,) of the angles between views and the mean view."""
    return np.asarray(
        np.sum((rotations[:, :2] @ _mean_view(rotations)[2]) ** 2, axis=1)
    )


def tilts(rotations: NDArray, mean: NDArray) -> NDArray:
    """
    Compute the rotation vectors of frames out of the plane of the mean view.

    Parameters
    ----------
    rotations : ndarray of shape (n_frames, 3, 3)
        Rotations; NaN where a frame has none.
    mean : ndarray of shape (3, 3)
        Rotation of the mean view.

    Returns
    -------
    ndarray of shape (n_frames, 3)
        Rotation vectors in radians, in the axes of the shapes, without their part along
        the viewing direction. NaN where a frame has no rotation.
    """
    vectors = np.full((len(rotations), 3), np.nan)
    known = np.isfinite(rotations).all(axis=(1, 2))
    if known.any():
        vectors[known] = Rotation.from_matrix(mean.T @ rotations[known]).as_rotvec()
    return vectors - (vectors @ mean[2])[:, None] * mean[2]


def _unpredicted(tilts: NDArray, alpha: NDArray) -> float:
    """Compute the share of the variance of tilts (n, 2) that alpha (n, K) leaves."""
    n_frames, K = alpha.shape
    if n_frames < K + 3:
        return 1.0
    centred = tilts - tilts.mean(axis=0)
    known = np.column_stack([np.ones(n_frames), alpha])
    rest = centred - known @ np.linalg.lstsq(known, centred)[0]
    total = np.sum(centred**2)
    if not total > 0:
        return 1.0
    share = np.sum(rest**2) / total * (n_frames - 1) / (n_frames - K - 1)
    return float(np.clip(share, np.finfo(float).eps, 1.0))
