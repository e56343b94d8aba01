"""Camera, position and coefficients of single frames, for given shapes and noise.

Each frame is fitted by itself, in blocks of frames, by the search for its model of the
camera. The search starts from coefficients of zero. Frames whose objective is much
larger than the noise explains start again from other coefficients.
"""

from collections.abc import Callable, Iterator
from functools import partial
from typing import NamedTuple, Self

import numpy as np
from numpy.typing import NDArray

from isa_nrsfm._frames.affine_newton import AffineSearch
from isa_nrsfm._frames.calibrated_newton import CalibratedSearch
from isa_nrsfm._frames.options import FRAME_OPTIONS, FrameOptions
from isa_nrsfm._frames.point_sums import (
    FrameSums,
    FrameTracks,
    ShapeProducts,
    determines_camera,
    frame_sums,
    frame_tracks,
)
from isa_nrsfm._frames.search import FrameSearch
from isa_nrsfm._linalg.vectors import in_lanes
from isa_nrsfm._tables.visibility import seen_points

SEARCHES: dict[str, Callable[..., FrameSearch]] = {
    "affine": AffineSearch,
    "weak_perspective": partial(CalibratedSearch, scaled=True),
    "orthographic": partial(CalibratedSearch, scaled=False),
}


class FramePosterior(NamedTuple):
    """
    Fits of frames; NaN for frames whose points do not determine a camera.

    Attributes
    ----------
    motion : ndarray of shape (n_frames, 2, 3)
        Cameras, in the units of the tracks per unit of the shapes.
    translation : ndarray of shape (n_frames, 2)
        Image of the origin of the shapes.
    alpha : ndarray of shape (n_frames, n_components)
        Coefficients.
    covariance : ndarray of shape (n_frames, n_components, n_components)
        Posterior covariance of alpha in the normal approximation at the optimum
        (Laplace), with the uncertainty of camera and position: noise variance times
        the inverse of the Schur complement. Of shape (n_frames, 0, 0) where covariances
        are not wanted.
    turn_covariance : ndarray of shape (n_frames, 3, 3)
        As of `FoundFrames`, with the uncertainty of the coefficients.
    objective : ndarray of shape (n_frames,)
        ``sum_j w_ij ||m_ij - M S_j - t||^2 + s2 |a|^2`` at the optimum, in squared
        units of the tracks. Its error is below 1e-12 of the energy of the centred
        frame.
    residual : ndarray of shape (n_frames,)
        ``sum_j w_ij ||m_ij - M S_j - t||^2``, with the same error.
    converged : ndarray of bool, shape (n_frames,)
        Whether the last Newton step was below the convergence tolerance.
    start : ndarray of int, shape (n_frames,)
        Number of the extra start that led to the fit, -1 for the first start. A start
        that no frame of many needs can be left out for others like them.
    """

    motion: NDArray
    translation: NDArray
    alpha: NDArray
    covariance: NDArray
    turn_covariance: NDArray
    objective: NDArray
    residual: NDArray
    converged: NDArray
    start: NDArray

    @classmethod
    def unknown(
        cls, n_frames: int, n_components: int, covariances: bool = True
    ) -> Self:
        """Return fits of NaN, to be filled in, with or without covariances."""
        size = n_components if covariances else 0
        return cls(
            motion=np.full((n_frames, 2, 3), np.nan),
            translation=np.full((n_frames, 2), np.nan),
            alpha=np.full((n_frames, n_components), np.nan),
            covariance=np.full((n_frames, size, size), np.nan),
            turn_covariance=np.full((n_frames, 3, 3), np.nan),
            objective=np.full(n_frames, np.nan),
            residual=np.full(n_frames, np.nan),
            converged=np.zeros(n_frames, dtype=bool),
            start=np.full(n_frames, -1),
        )

    def take(self, frames: NDArray) -> Self:
        """Return the fits of some of the frames."""
        return type(self)(*(each[frames] for each in self))

    def put(self, frames: NDArray, others: Self) -> None:
        """Set the fits of some of the frames."""
        for each, other in zip(self, others, strict=True):
            each[frames] = other


def fit_posterior(
    tracks: NDArray,
    shapes: NDArray,
    noise_variance: NDArray | float,
    *,
    camera: str = "affine",
    weights: NDArray | None = None,
    initial: NDArray | None = None,
    starts: NDArray | None = None,
    covariances: bool = True,
    options: FrameOptions = FRAME_OPTIONS,
) -> FramePosterior:
    """
    Return the most probable camera, position and coefficients of each frame.

    Parameters
    ----------
    tracks : ndarray of shape (n_frames, n_points, 2)
        Tracks, in any place; NaN where a point is missing.
    shapes : ndarray of shape (n_components + 1, 3, n_points)
        Mean shape and basis shapes, rows centred, scaled such that alpha ~ N(0, I).
    noise_variance : float or ndarray of shape (n_frames,)
        Variance of a coordinate, in squared units of the tracks. At least 1e-13 of the
        energy of a frame is taken.
    camera : {"affine", "weak_perspective", "orthographic"}, default="affine"
        Model of the cameras. Orthographic ones have the scale one.
    weights : ndarray of shape (n_frames, n_points), optional
        Not negative, zero for missing points; by default 1 for all that are not NaN.
    initial : ndarray of shape (n_frames, n_components), optional
        Coefficients to start from, by default zeros.
    starts : ndarray of shape (n_starts, n_components), optional
        Coefficients to start from besides these, `spread_starts` for instance, for
        frames whose first fit is much worse than the noise explains.
    covariances : bool, default=True
        Whether covariances are wanted. The rest of the fit is the same without them.
    options : FrameOptions
        What steers the search.

    Returns
    -------
    FramePosterior
        The best fit of each frame. It does not depend on the other frames beyond
        rounding errors. It is NaN for frames whose points of positive weight do not
        determine a camera (`determines_camera`), such as fewer than four points of a
        solid.

    Notes
    -----
    Along a direction in which all shapes are flat, affine cameras are zero. If only the
    mean shape is flat, coefficients of zero can be a saddle point of the objective:
    rounding decides where the search goes from there, and further starts help.
    """
    return fit_tracks(
        tracks,
        SEARCHES[camera](shapes, options=options),
        noise_variance,
        weights=weights,
        initial=initial,
        starts=starts,
        covariances=covariances,
    )


def fit_tracks(
    tracks: NDArray,
    search: FrameSearch,
    noise_variance: NDArray | float,
    *,
    weights: NDArray | None = None,
    initial: NDArray | None = None,
    starts: NDArray | None = None,
    covariances: bool = True,
) -> FramePosterior:
    """
    Return the fits of `fit_posterior` by a search that is there already.

    Parameters
    ----------
    tracks, noise_variance, weights, initial, starts, covariances
        As of `fit_posterior`.
    search : FrameSearch
        The search for the shapes, one of `SEARCHES`. What it computes of the shapes
        serves all tables.

    Returns
    -------
    FramePosterior
        The best fit of each frame.
    """
    tracks = np.asarray(tracks)
    seen = seen_points(tracks)
    if weights is not None or not seen.all():
        weights = np.where(seen, 1.0 if weights is None else weights, 0.0)
    return _best_fits(
        _Tracks(tracks, weights),
        search,
        noise_variance,
        initial=initial,
        starts=starts,
        covariances=covariances,
    )


def fit_prepared(
    frames: FrameTracks,
    search: FrameSearch,
    noise_variance: NDArray | float,
    *,
    initial: NDArray | None = None,
    starts: NDArray | None = None,
) -> FramePosterior:
    """
    Return the fits of `fit_tracks` for frames that are ready for products.

    Parameters
    ----------
    frames : FrameTracks
        The frames, by their points or by their products with directions.
    search : FrameSearch
        The search for the shapes, by points (centred) or directions as the frames.
    noise_variance, initial, starts
        As of `fit_posterior`.

    Returns
    -------
    FramePosterior
        The best fit of each frame.
    """
    return _best_fits(
        _Prepared(frames),
        search,
        noise_variance,
        initial=initial,
        starts=starts,
    )


def approximate_cameras(
    frames: FrameTracks,
    shapes: NDArray,
    noise_variance: float,
    *,
    camera: str = "affine",
    options: FrameOptions = FRAME_OPTIONS,
) -> NDArray:
    """
    Return cameras close to those of `fit_prepared`, by a few steps from zero.

    Parameters
    ----------
    shapes, noise_variance, camera, options
        As of `fit_posterior`.
    frames : FrameTracks
        As of `fit_prepared`; all frames determine a camera.

    Returns
    -------
    ndarray of shape (n_frames, 2, 3)
        Cameras.
    """
    prepared = _Prepared(frames)
    search = SEARCHES[camera](shapes, options=options)
    motion = np.empty((len(frames.weight), 2, 3))
    for block, products in prepared.blocks(search):
        variance = np.full(len(block), noise_variance)
        motion[block] = search.rough_cameras(products, variance, prepared.n_points)
    return search.cameras(motion)


class _Tracks(NamedTuple):
    """Frames that are given by their tracks."""

    tracks: NDArray  # (n_frames, n_points, 2)
    weights: NDArray | None  # (n_frames, n_points), None where all are 1

    @property
    def n_points(self) -> float:
        """Number of points of a frame."""
        return self.tracks.shape[1]

    @property
    def weight(self) -> NDArray:
        """Sum of the weights of each frame."""
        if self.weights is None:
            return np.full(len(self.tracks), float(self.n_points))
        return self.weights.sum(axis=1)

    def take(self, frames: NDArray) -> Self:
        """Return some of the frames."""
        weights = None if self.weights is None else self.weights[frames]
        return self._replace(tracks=self.tracks[frames], weights=weights)

    def blocks(self, search: FrameSearch) -> Iterator[tuple[NDArray, FrameSums]]:
        """
        Yield the numbers of frames that determine a camera, and their sums.

        Complete frames come first: they share one Gram matrix.
        """
        tracks, weights = self
        options, shared = search.options, search.shared
        complete = np.ones(len(tracks), dtype=bool)
        if weights is not None:
            complete = (weights == 1.0).all(axis=1)
        frames = np.flatnonzero(complete)
        for first in range(0, len(frames), options.complete_block):
            block = in_lanes(frames[first : first + options.complete_block])
            yield block, frame_sums(frame_tracks(tracks[block]), shared)
        if weights is None:
            return
        frames = np.flatnonzero(~complete)
        for first in range(0, len(frames), options.weighted_block):
            block = in_lanes(frames[first : first + options.weighted_block])
            part = frame_tracks(tracks[block], weights[block])
            yield _determined(block, frame_sums(part, shared), shared)


class _Prepared(NamedTuple):
    """Frames that are ready for products."""

    frames: FrameTracks

    @property
    def n_points(self) -> float:
        """Number of points of a frame, also if it is given by directions."""
        if self.frames.weights is None:
            return self.frames.weight[0]
        return len(self.frames.weights)

    @property
    def weight(self) -> NDArray:
        """Sum of the weights of each frame."""
        return self.frames.weight

    def take(self, frames: NDArray) -> Self:
        """Return some of the frames."""
        return self._replace(frames=self.frames.take(frames))

    def blocks(self, search: FrameSearch) -> Iterator[tuple[NDArray, FrameSums]]:
        """Yield the numbers of frames that determine a camera, and their sums."""
        complete = self.frames.weights is None
        options, shared = search.options, search.shared
        length = options.complete_block if complete else options.weighted_block
        for first in range(0, len(self.weight), length):
            last = min(first + length, len(self.weight))
            block = in_lanes(np.arange(first, last))
            products = frame_sums(self.frames.take(block), shared)
            yield (
                (block, products) if complete else _determined(block, products, shared)
            )


def _determined(
    frames: NDArray, products: FrameSums, shared: ShapeProducts
) -> tuple[NDArray, FrameSums]:
    """Return those of the frames (n,) that determine a camera, and their sums."""
    determined = determines_camera(products, shared.shapes[0])
    if determined.all():
        return frames, products
    usable = in_lanes(np.flatnonzero(determined))
    return frames[usable], products.take(usable)


def _best_fits(
    frames: _Tracks | _Prepared,
    search: FrameSearch,
    noise_variance: NDArray | float,
    *,
    initial: NDArray | None,
    starts: NDArray | None,
    covariances: bool = True,
) -> FramePosterior:
    """
    Return the best fit of each frame over all starts, as of `fit_posterior`.

    The arrays initial and starts are (n_frames, K) and (n_starts, K).
    """
    weight, n_components = frames.weight, search.shared.n_components
    options = search.options
    n_frames = len(weight)
    variance = np.broadcast_to(np.asarray(noise_variance, dtype=float), (n_frames,))
    first = np.zeros((n_frames, n_components)) if initial is None else initial
    extra = np.zeros((0, n_components)) if starts is None else np.asarray(starts)

    def fit(chosen: NDArray, initial: NDArray, max_steps: int) -> FramePosterior:
        # All frames need no copy.
        every = len(chosen) == n_frames and (chosen == np.arange(n_frames)).all()
        part = frames if every else frames.take(chosen)
        return _fit(part, search, variance[chosen], initial, max_steps, covariances)

    # First round, block by block
    fits = fit(np.arange(n_frames), first, search.first_steps)
    # Second round: the few frames that have not converged, collected from all blocks
    slow = np.flatnonzero(~fits.converged & np.isfinite(fits.objective))
    if len(slow):
        fits.put(slow, fit(slow, fits.alpha[slow], options.max_steps))
    # Further starts for frames that are explained badly, all starts at once
    poor = np.flatnonzero(_poorly_explained(fits, weight, variance, options))
    if len(extra) and len(poor):
        number = np.repeat(np.arange(len(extra)), len(poor))
        others = fit(np.tile(poor, len(extra)), extra[number], options.max_steps)
        others = others._replace(start=number)
        # Of equal minima the first one is kept.
        objective = others.objective.reshape(len(extra), -1)
        best = np.argmax(
            objective <= (1 + options.equal) * objective.min(axis=0), axis=0
        )
        best = best * len(poor) + np.arange(len(poor))
        gain = fits.objective[poor] - others.objective[best]
        better = gain > options.equal * fits.objective[poor]
        fits.put(poor[better], others.take(best[better]))
    return fits._replace(
        motion=search.cameras(fits.motion),
        turn_covariance=search.turns(fits.turn_covariance),
    )


def _fit(
    frames: _Tracks | _Prepared,
    search: FrameSearch,
    variance: NDArray,
    initial: NDArray,
    max_steps: int,
    covariances: bool,
) -> FramePosterior:
    """Return the minima that frames reach from coefficients initial (n_frames, K)."""
    n_frames, n_components = initial.shape
    fits = FramePosterior.unknown(n_frames, n_components, covariances)
    for block, products in frames.blocks(search):
        found = search.fit(
            products,
            variance[block],
            frames.n_points,
            initial[block],
            max_steps,
            covariances,
        )
        fits.motion[block] = found.motion
        fits.translation[block] = products.positions(found.motion, found.alpha)
        fits.alpha[block] = found.alpha
        fits.covariance[block] = found.covariance
        fits.turn_covariance[block] = found.turn_covariance
        fits.objective[block] = found.objective
        fits.residual[block] = found.residual
        fits.converged[block] = found.converged
    return fits


def _poorly_explained(
    fits: FramePosterior, weight: NDArray, variance: NDArray, options: FrameOptions
) -> NDArray:
    """
    Return whether objectives are much larger than the noise explains.

    At the minimum over alpha, ``f / s2`` is the squared Mahalanobis distance of a frame
    from the model. It is chi-squared distributed, with two degrees of freedom for each
    point less the eight of camera and position.
    """
    freedom = np.maximum(2.0 * weight - 8.0, 1.0)
    return fits.objective > options.suspicious * variance * freedom


def spread_starts(alpha: NDArray, n_starts: int) -> NDArray:
    """
    Return coefficients far from zero and from each other (farthest point sampling).

    Parameters
    ----------
    alpha : ndarray of shape (n_frames, n_components)
        Coefficients of many frames; rows with NaN are left out.
    n_starts : int
        How many are wanted.

    Returns
    -------
    ndarray of shape (n_starts, n_components)
        Rows of alpha, fewer if there are not as many different ones, each the one
        farthest from zero and from those before it.
    """
    alpha = alpha[np.isfinite(alpha).all(axis=1)]
    # Squared distance from zero and from the rows chosen so far
    distance = np.einsum("ik,ik->i", alpha, alpha)
    chosen: list[int] = []
    while len(chosen) < n_starts and distance.max(initial=0.0) > 0:
        chosen.append(int(np.argmax(distance)))
        difference = alpha - alpha[chosen[-1]]
        nearest = np.einsum("ik,ik->i", difference, difference)
        distance = np.minimum(distance, nearest)
    return alpha[chosen]
