"""Error of points that were held out of the fit of their frame.

What a model says of points that it has not seen gets worse when it has too many basis
shapes, unlike its error at the points to which it was fitted.
"""

import numpy as np
from numpy.typing import NDArray

from isa_nrsfm._frame_fit import PosteriorFrames, RigidFrames, compose, project
from isa_nrsfm._tracks import seen_points, usable_frames

# Parts of the points that are held out in turn, and what draws them: always the same.
N_FOLDS = 5
FOLD_SEED = 0


def held_out_energies(
    frames: RigidFrames | PosteriorFrames,
    mean_shape: NDArray,
    basis: NDArray,
    tracks: NDArray,
    sizes: NDArray,
) -> tuple[float, float]:
    """
    Return the energy of the error, and of the signal, of points that are held out.

    The points are divided into five parts, the same for all frames and tables. Each
    part is predicted from the others, frame by frame: camera, position and coefficients
    are fitted without it.

    Parameters
    ----------
    frames : RigidFrames or PosteriorFrames
        The model of a frame.
    mean_shape : ndarray of shape (n_points, 3)
        Mean shape in the gauge of `frames`.
    basis : ndarray of shape (n_components, n_points, 3)
        Basis shapes in the gauge of `frames`.
    tracks : ndarray of shape (n_frames, n_points, 2)
        Tracks, NaN where a point is missing.
    sizes : ndarray of shape (n_frames,)
        Sizes of the frames.

    Returns
    -------
    noise, signal : float
        ``sum ||m - mhat||^2`` and ``sum ||m - centroid_i||^2`` over the points, in
        units of the sizes. Points whose frame is not determined by the others are left
        out.
    """
    n_points = tracks.shape[1]
    folds = np.random.RandomState(FOLD_SEED).permutation(n_points) % N_FOLDS
    seen = seen_points(tracks)
    noise = signal = 0.0
    for fold in range(N_FOLDS):
        held = folds == fold
        visible = np.where(held[:, None], np.nan, tracks)
        usable = np.flatnonzero(usable_frames(visible) & seen[:, held].any(axis=1))
        if not len(usable):
            continue
        fit = frames.fit(visible[usable], sizes[usable])
        shapes = compose(mean_shape[held], basis[:, held], fit.alpha)
        model = project(shapes, fit.motion, fit.translation)
        part = tracks[usable]
        centre = np.nanmean(part, axis=1, keepdims=True)
        weight = sizes[usable, None, None] ** -2.0
        counted = seen[np.ix_(usable, held)] & np.isfinite(model).all(axis=2)
        noise += np.sum((weight * (part[:, held] - model) ** 2)[counted])
        signal += np.sum((weight * (part[:, held] - centre) ** 2)[counted])
    return float(noise), float(signal)
