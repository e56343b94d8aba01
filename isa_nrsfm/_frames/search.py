"""What the searches for camera and coefficients of frames have in common."""

from typing import NamedTuple, Protocol

from numpy.typing import NDArray

from isa_nrsfm._frames.options import FrameOptions
from isa_nrsfm._frames.point_sums import FrameSums, ShapeProducts


class FoundFrames(NamedTuple):
    """
    Minima that the search for cameras and coefficients has reached.

    Attributes
    ----------
    motion : ndarray of shape (n_frames, 2, 3)
        Cameras.
    alpha : ndarray of shape (n_frames, n_components)
        Coefficients.
    covariance : ndarray of shape (n_frames, n_components, n_components)
        Posterior covariance of the coefficients. It contains the uncertainty of the
        camera. Of shape (n_frames, 0, 0) where covariances are not wanted.
    turn_covariance : ndarray of shape (n_frames, 3, 3)
        Posterior covariance of the rotation vectors w of ``M exp(hat(w))``, in radians
        squared. NaN for affine cameras, and where covariances are not wanted.
    objective : ndarray of shape (n_frames,)
        ``||W - M S||^2 + s2 |a|^2``.
    residual : ndarray of shape (n_frames,)
        ``||W - M S||^2``.
    converged : ndarray of bool, shape (n_frames,)
        Whether the search has converged.
    """

    motion: NDArray
    alpha: NDArray
    covariance: NDArray
    turn_covariance: NDArray
    objective: NDArray
    residual: NDArray
    converged: NDArray


class FrameSearch(Protocol):
    """
    A search for the cameras of one model that see given shapes.

    Attributes
    ----------
    shared : ShapeProducts
        The shapes (n_components + 1, 3, n_points) in the coordinates of the search,
        and their products.
    options : FrameOptions
        What steers the search.
    first_steps : int
        Largest number of steps of a first round, block by block. Frames that have not
        converged then are collected from all blocks for a second round.
    """

    shared: ShapeProducts
    options: FrameOptions
    first_steps: int

    def cameras(self, motion: NDArray) -> NDArray:
        """Return cameras (n_frames, 2, 3) of the search for the original shapes."""

    def turns(self, covariance: NDArray) -> NDArray:
        """Return covariances of rotation vectors (n, 3, 3) for the original shapes."""

    def fit(
        self,
        products: FrameSums,
        variance: NDArray,
        n_points: float,
        initial: NDArray,
        max_steps: int,
        covariances: bool = True,
    ) -> FoundFrames:
        """
        Return the minima that frames reach from given coefficients.

        The noise variances are (n_frames,), the coefficients initial (n_frames,
        n_components). Covariances may be left out.
        """

    def rough_cameras(
        self, products: FrameSums, variance: NDArray, n_points: float
    ) -> NDArray:
        """Return cameras (n_frames, 2, 3) that are close to those of a fit."""
