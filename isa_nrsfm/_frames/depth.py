"""Uncertainty of the depths, rotations and coefficients of calibrated cameras."""

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

# Rotations are not determined if their standard deviation is a larger share of their
# spread. This share is 0.2 to 0.3 for faces of known shape that turn by 10 degrees, 0.9
# to 1.3 by 4 degrees; 0.5 for bodies that turn by 20 degrees, 1 by 10 degrees. Depth
# errors above this share are warned of as well: they are at most 0.47 where rotations
# are determined (mean of ten tables, ``python -m benchmarks.depth``).
LARGEST_SHARE = 0.55
# RMS turning out of the image plane, if all sides of a half sphere are seen as often.
HALF_SPHERE = np.sqrt(np.pi - 2)


class DepthCertainty(NamedTuple):
    """
    Jackknife estimates of the errors of a fit with calibrated cameras.

    Attributes
    ----------
    total : float
        RMS error of the depths, relative to their RMS.
    turning : float
        RMS rotation of the cameras out of the image plane from their mean, in radians.
        The part that the coefficients predict is left out, because it cannot be
        distinguished from deformation.
    turns : ndarray of shape (3, 3) or None
        Covariance of the rotation vectors, in radians squared, in the camera's axes.
    points : ndarray of shape (n_points,) or None
        Mean variance of the depths of the points, for frames of size one.
    leverage : float or None
        Mean of 1 + |alpha|^2 of the frames, if variances are proportional to it, as for
        equal errors of all shapes. None if all frames have the mean variance.
    """

    total: float = np.nan
    turning: float = np.nan
    turns: NDArray | None = None
    points: NDArray | None = None
    leverage: float | None = None

    @property
    def turning_deviation(self) -> float:
        """Standard deviation of the rotations out of the image plane, in radians."""
        turns = self.turns
        return np.nan if turns is None else float(turns[:2, :2].trace() ** 0.5)

    @property
    def determined(self) -> bool:
        """Whether the table determines depths and rotations; True if not estimated."""
        return not self.turning_deviation > LARGEST_SHARE * self.turning

    def variances(self, alpha: NDArray) -> NDArray:
        """Return variances of depths (n, n_points) of frames of size one."""
        points = np.zeros(1) if self.points is None else self.points
        if self.leverage is None:
            return np.tile(points, (len(alpha), 1))
        return np.outer(leverages(alpha) / self.leverage, points)

    @property
    def advice(self) -> str:
        """Reason and remedy for depths that are not determined."""
        turning, deviation = np.degrees([self.turning, self.turning_deviation])
        other = (
            "fit a table in which the objects turn further, and transform this one "
            "with that model"
        )
        if self.turning > HALF_SPHERE:
            other = (
                "make sure that x and y have the same unit, unlike shares of the width "
                "and height of an image"
            )
        return (
            "the depth of the shapes is not determined: apart from their deformation "
            f"the objects turn by {turning:.2g} degrees (root mean square) out of the "
            "image plane, and these rotations have a standard deviation of "
            f"{deviation:.2g} degrees. Use affine cameras for this table "
            f'(camera="affine"), or {other}. See "How reliable is the depth?" in the '
            "documentation"
        )


def leverages(alpha: NDArray) -> NDArray:
    """Return 1 + |alpha|^2 of frames (n, K)."""
    return np.asarray(1.0 + np.vecdot(alpha, alpha))


NOT_ESTIMATED = DepthCertainty()
