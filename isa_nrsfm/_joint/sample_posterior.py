"""The fit of each frame of the table, block by block, after the joint fit."""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from isa_nrsfm._frames.camera_models import CAMERAS, distances, stacked_motion
from isa_nrsfm._frames.models import Decomposition, PosteriorFrames
from isa_nrsfm._frames.search import FramePosterior
from isa_nrsfm._joint.frames import JointFrames
from isa_nrsfm._tables.blocks import FrameBlocks

# With a robust loss, points with residuals above this threshold, in standard deviations
# of a coordinate, are left out. Without outliers this is one point in 3,000.
OUTLYING = 4.0
# Directions of the coefficients with a lower reliability are not supported by the
# table. Pure noise has reliability zero.
LEAST_RELIABILITY = 0.1


def inlying_rows(
    model: PosteriorFrames, rows: NDArray, weights: NDArray | None = None
) -> tuple[NDArray, FramePosterior]:
    """Return frames (n, 2, J) of size one with outliers as NaN, and their fit."""
    fit = model.posterior(rows, covariances=False, weights=weights)
    if model.loss != "linear":
        off = distances(rows, model.shapes, *fit[:3])
        outlying = off > OUTLYING * np.sqrt(model.noise_variance)
        rows = np.where(outlying[:, None], np.nan, rows)
    return rows, fit


def posterior_blocks(
    model: PosteriorFrames, frames: JointFrames, rows: FrameBlocks
) -> FrameBlocks:
    """Return the fits of all frames in blocks of FramePosterior, before the gauge."""
    if model.loss != "linear":
        return rows.derive(model.posterior)
    shapes = frames.coordinates(model.shapes)
    return frames.blocks.derive(replace(model, shapes=shapes).prepared_posterior)


def posterior_moments(posteriors: FrameBlocks) -> tuple[NDArray, NDArray, NDArray]:
    """Return cameras, coefficients, and their mean covariance (n_components, ...)."""
    parts = posteriors.map(lambda fit: (fit.motion, fit.alpha, fit.covariance.sum(0)))
    motion, alpha, covariance = zip(*parts, strict=True)
    total = np.sum(covariance, axis=0) / posteriors.n_frames
    return np.concatenate(motion), np.concatenate(alpha), total


def shape_uncertainty(
    motion: NDArray,
    alpha: NDArray,
    covariance: NDArray,
    share: NDArray,
    slices: Sequence[slice],
) -> NDArray:
    """Return the covariance of a point of the shapes for noise of variance one.

    The inverse of ``sum_i share_i E_i (x) M_i^T M_i``, with the second moments E_i of
    (1, alpha) and the mean weight of the points of frame i, zero for missing ones. The
    sum is over slices of frames.
    """
    seen = np.einsum("i,ira,irb->ab", share, motion, motion, optimize=True)
    information = np.kron(np.pad(covariance, ((1, 0), (1, 0))), seen)
    for frames in slices:
        X = stacked_motion(motion[frames], alpha[frames])
        information += X.T @ (np.repeat(share[frames], 2)[:, None] * X)
    return np.linalg.pinv(information, hermitian=True)


def shown_frames(
    posterior: FramePosterior,
    sizes: NDArray,
    n_seen: NDArray,
    weight: NDArray,
    frames: PosteriorFrames,
    uncertainty: NDArray,
) -> tuple[Decomposition, NDArray, float]:
    """Return fits in the gauge, and the effect of their noise on their coefficients.

    The noise of frame i changes the shapes by ``N^-1 X_i^T``, ``X_i = (1, alpha_i) (x)
    M_i``. This shifts the coefficients of the frame by ``w_i s2_i Sigma_i / s2 tr(M_i
    (N^-1 X_i^T)_k)`` on average, with the sum w_i of the weights of its points. The
    second result (K, K) is the sum over the frames of ``alpha_i`` times that shift
    times s2, the third the sum of s2_i.
    """
    motion, alpha = posterior.motion, posterior.alpha
    X = stacked_motion(motion, alpha).reshape(len(alpha), 2, -1)
    Z = X @ uncertainty
    # Degrees of freedom of the residual, without the parameters of the shapes
    leverage = np.einsum("irp,irp->i", X, Z)
    n_pose = 2 + CAMERAS[frames.camera].n_parameters
    mean = weight / n_seen
    freedom = np.maximum(n_seen * (2.0 - mean * leverage) - n_pose, 1.0)
    noise = posterior.objective / mean / freedom
    own = np.einsum("ira,irka->ik", motion, Z.reshape(*Z.shape[:2], -1, 3))[:, 1:]
    shift = np.einsum("i,ikl,il->ik", weight * noise, posterior.covariance, own)
    return frames.shown(posterior, sizes), alpha.T @ shift, float(noise.sum())


def reliabilities(
    alpha: NDArray, covariance: NDArray, moments: NDArray, noise: float
) -> NDArray:
    """
    Return the shares of the variance of coefficients that are signal.

    These are squared correlations (K,) of the coefficients alpha (I, K) with the true
    ones, along uncorrelated directions, decreasing. The covariance is the mean
    posterior one; moments and noise are sums over the blocks of `shown_frames`.

    With known shapes they are the eigenvalues of ``(S + C)^-1 S``, with S the second
    moment of the coefficients and C the mean covariance: ``S + C`` is the whole
    variance. Estimated shapes follow the noise. A shape of ``gamma`` numbers a frame
    raises the variance along it from ``1 + l`` to ``y = (1 + l) (1 + gamma / l)`` noise
    variances, and noise alone to ``(1 + sqrt(gamma))^2``. The squared correlation is
    ``(l^2 - gamma) / (l (l + 1))`` (Benaych-Georges, Nadakuditi, "The singular values
    and vectors of low rank perturbations of large rectangular random matrices", 2012).
    Here ``y = 1 / (1 - share)``; gamma is y times the share of S that is chance.
    """
    known = alpha / np.sqrt(len(alpha))  # known.T @ known is S
    variance, axes = np.linalg.eigh(known.T @ known + covariance)
    kept = variance > 1e-14 * variance[-1]  # others are rounding errors
    white = axes[:, kept] / np.sqrt(variance[kept])
    # Squared singular values are the eigenvalues, with less rounding error.
    _, deviations, turn = np.linalg.svd(known @ white, full_matrices=False)
    own = white @ turn.T
    share = deviations**2
    left = np.einsum("kd,kl,ld->d", own, covariance, own)  # 1 / y
    caused = np.einsum("kd,kl,ld->d", own, moments, own) / (noise or 1.0)
    # The factor is a margin for chance. With it all reliabilities are zero on tables of
    # rigid objects (60 to 1,000 frames, 68 to 478 points, one to four basis shapes).
    # Without it some are 0.9 (``python -m benchmarks.recovery rigid``).
    gamma = 1.5 * np.maximum(caused, 0.0)  # gamma share / y
    gamma = np.divide(gamma, share, where=share > 0, out=np.ones_like(share))
    rest = share - gamma
    real = (rest > 0) & (rest**2 > 4 * gamma * left)
    rest, gamma, left = rest[real], gamma[real], left[real]
    signal = (rest + np.sqrt(rest**2 - 4 * gamma * left)) / 2  # l / y
    correlation = (signal**2 - gamma * left) / (signal * (signal + left))
    shares = np.zeros(len(kept))
    shares[: len(signal)] = np.sort(correlation)[::-1]
    return shares
