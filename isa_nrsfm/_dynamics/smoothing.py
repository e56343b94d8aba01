"""Posterior of the coefficients of frames, given all frames of their sequences."""

from typing import Any

import numpy as np
from numpy.typing import NDArray

from isa_nrsfm._dynamics.kalman import (
    Observations,
    estimated_dynamics,
    observations,
    smoothed,
    with_intercept,
)
from isa_nrsfm._dynamics.sequences import Sequence, sequences_of
from isa_nrsfm._tables.frame_columns import checked_times, group_numbers


def smoothed_posterior(
    mean: NDArray,
    covariance: NDArray,
    time: Any,
    groups: Any,
    *,
    max_gap: int,
    max_iter: int,
    tol: float,
) -> tuple[NDArray, NDArray, NDArray]:
    """
    Return the posterior of the coefficients, given all frames of their sequences.

    Parameters
    ----------
    mean : ndarray of shape (n_frames, K)
        Posterior means of the frames by themselves, with the prior N(0, I). NaN for
        frames without a fit.
    covariance : ndarray of shape (n_frames, K, K)
        Posterior covariances.
    time : array-like of shape (n_frames,) or None
        As of `checked_times`.
    groups : array-like of shape (n_frames,) or None
        As of `group_numbers`.
    max_gap : int
        As of `sequences_of`.
    max_iter, tol
        As of `estimated_dynamics`.

    Returns
    -------
    mean : ndarray of shape (n_frames, K)
        Posterior means. Those that came, if the frames show no dynamics.
    covariance : ndarray of shape (n_frames, K, K)
        Posterior covariances.
    time_scales : ndarray of shape (K,) or (0,)
        ``-1 / log |l|`` of the eigenvalues l of the transition, in units of time, the
        longest first; infinite where |l| is one or more. Empty without dynamics.
    """
    times, numbers = checked_times(time, len(mean)), group_numbers(groups, len(mean))
    sequences, unit = sequences_of(times, numbers, max_gap)
    observed = observations(mean, covariance)
    filled = [_with_gaps(each, observed) for each in sequences]
    # Differences between groups are no dynamics.
    intercepts = numbers is not None and bool(numbers.any())
    if intercepts:
        filled = [with_intercept(each) for each in filled]
    dynamics = estimated_dynamics(filled, max_iter, tol, intercepts)
    if dynamics is None:
        return mean, covariance, np.empty(0)
    K = mean.shape[1]
    mean, covariance = mean.copy(), covariance.copy()
    for sequence, each in zip(sequences, filled, strict=True):
        result = smoothed(each, dynamics)
        mean[sequence.rows] = result.mean[sequence.steps, :K]
        covariance[sequence.rows] = result.covariance[sequence.steps, :K, :K]
    size = np.sort(np.abs(np.linalg.eigvals(dynamics.transition[:K, :K])))[::-1]
    scales = np.full(len(size), np.inf)
    resting = (size > 0) & (size < 1)
    scales[resting] = -unit / np.log(size[resting])
    scales[size == 0] = 0.0
    return mean, covariance, scales


def _with_gaps(sequence: Sequence, observed: Observations) -> Observations:
    """Return what the steps of a sequence tell; nothing where there is no row."""
    n_steps, K = sequence.steps[-1] + 1, observed.information.shape[1]
    filled = Observations(np.zeros((n_steps, K, K)), np.zeros((n_steps, K)))
    for whole, part in zip(filled, observed, strict=True):
        whole[sequence.steps] = part[sequence.rows]
    return filled
