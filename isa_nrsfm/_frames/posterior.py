"""Camera, position and coefficients of single frames, for given shapes and noise.

Blocks of frames start from zero coefficients, badly fitted frames again from others.
"""

import numpy as np
from numpy.typing import NDArray

from isa_nrsfm._frames.affine_newton import AffineSearch
from isa_nrsfm._frames.calibrated_newton import CalibratedSearch
from isa_nrsfm._frames.point_sums import (
    FrameTracks,
    determines_camera,
    frame_sums,
    frame_tracks,
)
from isa_nrsfm._frames.search import MAX_STEPS, FramePosterior, FrameSearch
from isa_nrsfm._linalg.vectors import in_lanes
from isa_nrsfm._tables.tracks import seen_points

# Objectives that differ by less than this share are equal.
EQUAL = 1e-10


def frame_search(camera: str, shapes: NDArray) -> FrameSearch:
    """Return the search of a camera model for centred shapes with alpha ~ N(0, I)."""
    if camera == "affine":
        return AffineSearch(shapes)
    return CalibratedSearch(shapes, camera == "weak_perspective")


def fit_tracks(
    tracks: NDArray,
    search: FrameSearch,
    noise: NDArray | float,
    *,
    weights: NDArray | None = None,
    initial: NDArray | None = None,
    starts: NDArray | None = None,
    covariances: bool = True,
) -> FramePosterior:
    """Fit tracks (I, J, 2), NaN where a point is missing, as `fit_frames` does.

    The noise variance is at least 1e-13 of the energy. Weights (I, J) are 1 by default.
    """
    tracks = np.asarray(tracks)
    n_frames = len(tracks)
    noise = np.broadcast_to(np.asarray(noise, dtype=float), (n_frames,))
    weights = np.where(seen_points(tracks), 1.0 if weights is None else weights, 0.0)
    complete = (weights == 1.0).all(axis=1)
    fits = FramePosterior.unknown(n_frames, search.shared.n_components, covariances)
    # Complete frames share one Gram matrix.
    for chosen in np.flatnonzero(complete), np.flatnonzero(~complete):
        if len(chosen):
            frames = in_lanes(chosen)
            own = None if complete[frames[0]] else weights[frames]
            whole = len(chosen) == len(frames) == n_frames
            part = tracks if whole else tracks[frames]
            fit = fit_frames(
                frame_tracks(part, own),
                search,
                noise[frames],
                initial=None if initial is None else initial[frames],
                starts=starts,
                covariances=covariances,
            )
            fits.put(frames, fit)
    return fits


def fit_frames(
    frames: FrameTracks,
    search: FrameSearch,
    noise: NDArray | float,
    *,
    initial: NDArray | None = None,
    starts: NDArray | None = None,
    covariances: bool = True,
    rough: bool = False,
) -> FramePosterior:
    """Return the most probable camera, position and coefficients of each frame.

    Shapes of the search are by points (centred) or directions, as the frames. `initial`
    (I, K) is by default zero. Frames whose fit is much worse than the noise explains
    start again from each of `starts` (n_starts, K). `rough` ends after a few steps.

    Frames are independent, and NaN where points do not determine a camera. If only the
    mean shape is flat, zero can be a saddle point: further starts help.
    """
    n_frames, n_components = len(frames.weight), search.shared.n_components
    noise = np.broadcast_to(np.asarray(noise, dtype=float), (n_frames,))
    # Enough frames to be worth the calls, few enough for the cache
    length = 2048 if frames.weights is None else 1024

    def fit(chosen: NDArray, initial: NDArray, max_steps: int) -> FramePosterior:
        """Return the minima that some frames reach from coefficients (n_chosen, K)."""
        fits = FramePosterior.unknown(len(chosen), n_components, covariances)
        for first in range(0, len(chosen), length):
            block = in_lanes(np.arange(first, min(first + length, len(chosen))))
            products = frame_sums(frames.take(chosen[block]), search.shared)
            if frames.weights is not None:
                determined = determines_camera(products, search.shared.shapes[0])
                if not determined.all():
                    usable = in_lanes(np.flatnonzero(determined))
                    block, products = block[usable], products.take(usable)
            given = products, noise[chosen[block]], initial[block], max_steps
            fits.put(block, search.fit(*given, covariances, rough))
        return fits

    every = np.arange(n_frames)
    initial = np.zeros((n_frames, n_components)) if initial is None else initial
    if rough:
        return fit(every, initial, search.rough_steps)
    # First round, block by block
    fits = fit(every, initial, search.first_steps)
    # Second round: the few frames that have not converged, collected from all blocks
    slow = np.flatnonzero(~fits.converged & np.isfinite(fits.objective))
    if len(slow):
        fits.put(slow, fit(slow, fits.alpha[slow], MAX_STEPS))
    # Further starts for frames that are explained badly, all starts at once. At the
    # minimum, f / s2 is the squared Mahalanobis distance of a frame from the model: it
    # is chi-squared distributed, with two degrees of freedom for each point less the
    # eight of camera and position. Three times its expectation may be another minimum.
    freedom = np.maximum(2.0 * frames.weight - 8.0, 1.0)
    poor = np.flatnonzero(fits.objective > 3.0 * noise * freedom)
    if starts is not None and len(starts) and len(poor):
        number = np.repeat(np.arange(len(starts)), len(poor))
        others = fit(np.tile(poor, len(starts)), starts[number], MAX_STEPS)
        # Of equal minima the first one is kept.
        objective = others.objective.reshape(len(starts), -1)
        best = np.argmax(objective <= (1 + EQUAL) * objective.min(axis=0), axis=0)
        best = best * len(poor) + np.arange(len(poor))
        gain = fits.objective[poor] - others.objective[best]
        better = gain > EQUAL * fits.objective[poor]
        fits.put(poor[better], others.take(best[better]))
    return fits


def spread_starts(alpha: NDArray, n_starts: int) -> NDArray:
    """Return at most n_starts rows of alpha (n, K) by farthest point sampling."""
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
