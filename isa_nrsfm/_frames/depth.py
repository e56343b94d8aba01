"""Uncertainty of the depths, rotations and coefficients of calibrated cameras."""

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from isa_nrsfm._frames.camera_models import full_rotations

# Rotations whose standard deviation is a larger share of their spread are not
# determined. Faces of known shape that turn by 10 degrees have 0.2 to 0.3, by 4 degrees
# 0.9 to 1.3; bodies that turn by 20 degrees 0.5, by 10 degrees 1.
LARGEST_SHARE = 0.55


class DepthCertainty(NamedTuple):
    """
    Jackknife estimates of the errors of a fit with calibrated cameras.

    Attributes
    ----------
    total : float
        Root mean square error of the depths, relative to their root mean square.
    turning : float
        Root mean square rotation of the cameras out of the image plane, in radians,
        from their mean, without the part that the coefficients predict: it cannot be
        told from deformation.
    turns : ndarray of shape (3, 3) or None
        Covariance of the rotation vectors, in radians squared, in the camera's axes.
    points : ndarray of shape (n_points,) or None
        Variance of the depths of the points, for frames of size one.
    """

    total: float = np.nan
    turning: float = np.nan
    turns: NDArray | None = None
    points: NDArray | None = None

    @property
    def turning_deviation(self) -> float:
        """Standard deviation of the rotations out of the image plane, in radians."""
        return (
            np.nan if self.turns is None else float(self.turns[:2, :2].trace() ** 0.5)
        )

    @property
    def determined(self) -> bool:
        """Whether the table determines depths and rotations; True if not estimated."""
        return not self.turning_deviation > LARGEST_SHARE * self.turning

    @property
    def advice(self) -> str:
        """Reason and remedy for depths that are not determined."""
        turning, deviation = np.degrees([self.turning, self.turning_deviation])
        return (
            "the depth of the shapes is not determined: independently of their "
            f"deformation the objects turn by {turning:.2g} degrees (root mean square) "
            "out of the image plane, and these rotations have a standard deviation of "
            f"{deviation:.2g} degrees. Fit a table in which the objects turn further, "
            "and transform this one with that model; or use affine cameras "
            '(camera="affine"). See "How reliable is the depth?" in the documentation'
        )


NOT_ESTIMATED = DepthCertainty()


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
    Compute the standard deviations of the depths of the points of frames of size one.

    The variance of a depth is that of the jackknife plus that of its frame,
    ``Z (T^T T / s2 + diag(0, I))^-1 Z^T``. T and Z are the derivatives of image and
    depths by rotation vector, logarithm of the scale (if free) and coefficients.

    shapes (n_components + 1, 3, n_points), motion (n_frames, 2, 3), NaN where a frame
    has no camera, alpha (n_frames, n_components), seen (n_frames, n_points).
    """
    deviations = np.full(seen.shape, np.nan)
    rotations, scales = full_rotations(motion)
    prior = np.diag([0.0] * (3 + free) + [1.0] * alpha.shape[1])
    for i in np.flatnonzero(np.isfinite(scales)):
        centred = shapes - shapes[:, :, seen[i]].mean(axis=2, keepdims=True)
        shape = centred[0] + np.tensordot(alpha[i], centred[1:], 1)
        turned = [np.cross(axis, shape, axisb=0, axisc=0) for axis in np.eye(3)]
        changes = np.stack([*turned, *([shape] if free else []), *centred[1:]])
        changes = scales[i] * rotations[i] @ changes
        T = changes[:, :2, seen[i]].reshape(len(changes), -1)
        covariance = np.linalg.pinv(T @ T.T / noise + prior, hermitian=True)
        Z = changes[:, 2]
        deviations[i] = np.einsum("pj,pq,qj->j", Z, covariance, Z)
    points = 0.0 if certainty.points is None else certainty.points
    return np.sqrt(deviations + points)
