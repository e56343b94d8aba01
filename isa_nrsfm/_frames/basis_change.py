"""A change of the basis that shapes and coefficients are given in."""

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray


class FrameMap(NamedTuple):
    """
    Takes cameras and coefficients of frames to other shapes that fit equally well.

    Attributes
    ----------
    mixing : ndarray of shape (n_components + 1, n_components + 1)
        Takes ``(1, alpha)`` to ``scale * (1, new alpha)``. The scale, different for
        each frame, goes to its camera.
    space : ndarray of shape (3, 3)
        Affinity of space, ``new shape = shape @ space.T``.
    """

    mixing: NDArray
    space: NDArray

    @classmethod
    def identity(cls, n_components: int) -> "FrameMap":
        """Return the map that leaves everything as it is."""
        return cls(np.eye(n_components + 1), np.eye(3))

    def apply(
        self, motion: NDArray, alpha: NDArray, covariance: NDArray | None
    ) -> tuple[NDArray, NDArray, NDArray]:
        """
        Return cameras, coefficients and their standard deviations for the new shapes.

        Parameters
        ----------
        motion : ndarray of shape (n_frames, 2, 3)
            Cameras.
        alpha : ndarray of shape (n_frames, n_components)
            Coefficients.
        covariance : ndarray of shape (n_frames, n_components, n_components) or None
            Their covariances; None where they are not known.

        Returns
        -------
        motion : ndarray of shape (n_frames, 2, 3)
            New cameras.
        alpha : ndarray of shape (n_frames, n_components)
            New coefficients.
        deviation : ndarray of shape (n_frames, n_components)
            Their standard deviations, to first order. NaN without covariances.
        """
        new, deviation, scale = self.coefficients(alpha, covariance)
        cameras = scale[:, None, None] * (motion @ np.linalg.inv(self.space))
        return cameras, new, deviation

    def coefficients(
        self, alpha: NDArray, covariance: NDArray | None
    ) -> tuple[NDArray, NDArray, NDArray]:
        """
        Return coefficients, their standard deviations and the scales of the cameras.

        Parameters
        ----------
        alpha, covariance
            As of `apply`.

        Returns
        -------
        alpha : ndarray of shape (n_frames, n_components)
            New coefficients.
        deviation : ndarray of shape (n_frames, n_components)
            Their standard deviations, to first order. NaN without covariances.
        scale : ndarray of shape (n_frames,)
            Factors of the cameras.
        """
        mixed = self.mixing[:, 0] + alpha @ self.mixing[:, 1:].T
        scale = mixed[:, 0]
        new = mixed[:, 1:] / scale[:, None]
        if covariance is None:
            return new, np.full_like(new, np.nan), scale
        # d new / d alpha, times scale
        slope = self.mixing[1:, 1:] - new[:, :, None] * self.mixing[0, 1:]
        variance = np.vecdot(slope @ covariance, slope)
        return new, np.sqrt(variance) / np.abs(scale)[:, None], scale
