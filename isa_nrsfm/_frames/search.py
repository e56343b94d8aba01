"""What a search for the camera and the coefficients of frames finds."""

from typing import NamedTuple, Protocol

from numpy.typing import NDArray

from isa_nrsfm._frames.point_sums import FrameSums

# The most steps of a search.
MAX_STEPS = 60


class FoundFrames(NamedTuple):
    """
    Minima that the search for cameras and coefficients has reached, frames last.

    Attributes
    ----------
    motion : ndarray of shape (2, 3, n_frames)
        Cameras.
    alpha : ndarray of shape (n_components, n_frames)
        Coefficients.
    covariance : ndarray of shape (n_pairs, n_frames)
        Posterior covariance of the coefficients, packed, the camera being unknown.
    objective : ndarray of shape (n_frames,)
        ``||W - M S||^2 + s2 |a|^2``.
    residual : ndarray of shape (n_frames,)
        ``||W - M S||^2``.
    converged : ndarray of bool, shape (n_frames,)
        Whether the search ended in a minimum.
    """

    motion: NDArray
    alpha: NDArray
    covariance: NDArray
    objective: NDArray
    residual: NDArray
    converged: NDArray


class FrameSearch(Protocol):
    """
    A search for the cameras of one model that see given shapes.

    Attributes
    ----------
    shapes : ndarray of shape (n_components + 1, 3, n_points)
        The shapes in the coordinates of the search.
    first_steps : int
        Steps after which frames of all blocks that have not converged are better
        brought together.
    """

    shapes: NDArray
    first_steps: int

    def cameras(self, motion: NDArray) -> NDArray:
        """Return cameras (n_frames, 2, 3) for the shapes as they were given."""

    def fit(
        self,
        products: FrameSums,
        variance: NDArray,
        n_points: float,
        initial: NDArray,
        max_steps: int,
    ) -> FoundFrames:
        """Return the minima that frames reach from given coefficients."""

    def rough_cameras(
        self, products: FrameSums, variance: NDArray, n_points: float
    ) -> NDArray:
        """Return cameras (2, 3, n_frames) that are close to those of a fit."""
