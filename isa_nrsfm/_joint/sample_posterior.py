"""The fit of each frame of the table, block by block, after the joint fit."""

from dataclasses import replace
from functools import partial

import numpy as np
from numpy.typing import NDArray

from isa_nrsfm._frames.models import PosteriorFrames
from isa_nrsfm._frames.posterior import FramePosterior
from isa_nrsfm._joint.frames import JointFrames
from isa_nrsfm._tables.blocks import FrameBlocks


def posterior_blocks(
    model: PosteriorFrames, frames: JointFrames, rows: FrameBlocks
) -> FrameBlocks:
    """
    Return the fits of all frames of a table, before the gauge.

    Parameters
    ----------
    model : PosteriorFrames
        The model of a frame.
    frames : JointFrames
        The frames in the form that the joint refinement used.
    rows : FrameBlocks
        The frames themselves (n_frames, 2, n_points), NaN where a point is missing.

    Returns
    -------
    FrameBlocks
        Blocks of FramePosterior.
    """
    if model.loss != "linear":
        return rows.derive(partial(_row_posterior, model=model))
    shapes = frames.coordinates(model.shapes)
    return frames.blocks.derive(replace(model, shapes=shapes).prepared_posterior)


def _row_posterior(rows: NDArray, model: PosteriorFrames) -> FramePosterior:
    """Return the fit of scaled frames (n_frames, 2, n_points)."""
    return model.posterior(rows.transpose(0, 2, 1))


def posterior_moments(posteriors: FrameBlocks) -> tuple[NDArray, NDArray, NDArray]:
    """
    Return cameras, coefficients and mean covariance of the fits of frames.

    Parameters
    ----------
    posteriors : FrameBlocks
        Blocks of FramePosterior.

    Returns
    -------
    motion : ndarray of shape (n_frames, 2, 3)
        Cameras.
    alpha : ndarray of shape (n_frames, n_components)
        Coefficients.
    covariance : ndarray of shape (n_components, n_components)
        Posterior covariance of the coefficients, mean over the frames.
    """
    motion, alpha, covariance = zip(*posteriors.map(_moments), strict=True)
    total = np.sum(covariance, axis=0) / posteriors.n_frames
    return np.concatenate(motion), np.concatenate(alpha), total


def _moments(posterior: FramePosterior) -> tuple[NDArray, NDArray, NDArray]:
    """Return cameras, coefficients and the sum of their covariances of a block."""
    return posterior.motion, posterior.alpha, posterior.covariance.sum(axis=0)
