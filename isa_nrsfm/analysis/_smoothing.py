"""Coefficients and cameras in time: Kalman filter, smoother, maximum likelihood.

Each coefficient of a sequence is a Gaussian process of variance one in time, with the
Matern covariance of order 3/2 and a rate l per step of its own ::

    E x_s x_t = (1 + l |s - t|) exp(-l |s - t|).

It is the first entry of the state ``(x, y)``, y the scaled derivative of x, with ::

    (x, y)_t+1 = F (x, y)_t + w_t,  F = exp(-l) [[1 + l, l], [-l, 1 - l]],
    w_t ~ N(0, I - F F^T),  (x, y)_1 ~ N(0, I).

A coefficient is ``x_t + u``. The intercept u of a sequence is drawn from N(0, b), and
the variance of the process is 1 - b: frames by themselves have the prior N(0, I) of the
fit. So differences between people are not taken for dynamics. A single sequence has an
intercept in the alternative without dynamics only.

Parameters of cameras are integrated random walks, ``(w, v)_t+1 = (w + v, v)_t`` plus
noise of the covariance ``q [[1/3, 1/2], [1/2, 1]]``. They are relative to the camera of
each frame alone.

A frame is observed through its likelihood as a function of its coefficients and camera.
Near the fit ``f_t = (alpha_t, 0)`` of the frame by itself, its logarithm at ``f_t + d``
is ``f_t^T d - d^T L_t d / 2``: the gradients of likelihood and prior cancel there. All
rates, b and q maximise the likelihood of the sequences. Its gradient is the expected
gradient of the joint density of states and frames (Fisher's identity).

References: Hartikainen, Sarkka, "Kalman filtering and smoothing solutions to temporal
Gaussian process regression models", 2010; Rauch, Tung, Striebel, "Maximum likelihood
estimates of linear dynamic systems", 1965.
"""

from collections.abc import Callable, Sequence
from functools import partial
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import block_diag
from scipy.optimize import minimize
from scipy.special import expit

from isa_nrsfm._compat.scikit_learn import one_blas_thread
from isa_nrsfm._frames.camera_models import CameraModel
from isa_nrsfm._frames.models import Decomposition, FrameMap, LinearisedFrames
from isa_nrsfm._linalg import frames_first, frames_last
from isa_nrsfm.analysis._frame_columns import checked_times, group_numbers, sequences_of

# Least logarithm of the evidence for dynamics over that for none: a Bayes factor of 20,
# "strong" (Kass, Raftery, "Bayes factors", 1995). Motion capture has hundreds, the same
# frames shuffled less than one.
STRONG_EVIDENCE = 3.0
# Least and largest rates per step. At the largest one, the correlation of neighbouring
# frames is below 0.001. At the least one, the variance of w_t is above rounding errors.
LEAST_RATE, LARGEST_RATE = 1e-3, 10.0
# Prior variance of the camera of the first frame and of its change, in units of their
# mean squares: not informative, and above rounding errors.
UNKNOWN = 1e2
# Logarithm of the rate from which the search starts.
FIRST_RATE = np.log(0.3)
# Covariance of an integrated random walk after one step
WALK = np.array([[1 / 3, 1 / 2], [1 / 2, 1.0]])


# Likelihoods of the frames of a sequence, coefficients first, then cameras: L_t
# (n_steps, p, p) and f_t (n_steps, p), zero for unseen frames, and the changes
# (n_steps, p) of the origin of the parameters from the frame before.
Observations = tuple[NDArray, NDArray, NDArray]


class Dynamics(NamedTuple):
    """Logarithms of rates (K,) and of q (p - K,), log odds of b (K,) or (0,)."""

    rates: NDArray
    walks: NDArray
    shares: NDArray

    @property
    def between(self) -> NDArray:
        """Variances b (K,) of the intercepts, or (0,)."""
        return expit(self.shares)

    def blocks(self) -> NDArray:
        """Return F and the covariances of noise and first states (3, 2, 2, p)."""
        rate, one = np.exp(self.rates), np.eye(2)[:, :, None]
        F = np.array([[1 + rate, rate], [-rate, 1 - rate]]) * np.exp(-rate)
        Q = one - np.einsum("abk,cbk->ack", F, F)
        within = 1.0 - self.between if len(self.shares) else np.ones_like(rate)
        processes = np.stack([F, within * Q, within * one])
        parts = np.array([[[1.0, 1.0], [0.0, 1.0]], WALK, UNKNOWN * np.eye(2)])
        walks = np.repeat(parts[..., None], len(self.walks), axis=3)
        walks[1] *= np.exp(self.walks)
        return np.concatenate([processes, walks], axis=3)

    def matrices(self) -> tuple[NDArray, NDArray, NDArray, NDArray]:
        """Return F, covariances of noise and first states, and the map to parameters.

        States (D,) are x and w (p,), y and v (p,), u (K,) or (0,). The map is (p, D).
        """
        K, n = len(self.shares), len(self.rates) + len(self.walks)
        steady = np.ones(K), np.zeros(K), self.between
        blocks = ([[np.diag(b) for b in row] for row in each] for each in self.blocks())
        pairs = zip(blocks, steady, strict=True)
        F, Q, first = (block_diag(np.block(each), np.diag(r)) for each, r in pairs)
        return F, Q, first, np.hstack([np.eye(n), np.zeros((n, n)), np.eye(n, K)])


class SmoothedCoefficients(NamedTuple):
    """
    Coefficients and cameras of frames, given all frames of their sequence.

    Attributes
    ----------
    alpha : ndarray of shape (n_frames, n_components)
        Posterior means. Without dynamics they are those of `AffineNRSfM.transform`.
        With dynamics, rows with too few visible points are filled in.
    alpha_std : ndarray of shape (n_frames, n_components)
        Posterior standard deviations.
    time_scales : ndarray of shape (n_components,) or (0,)
        Time scales T of directions of the coefficients, the longest first, in the units
        of `time`: the correlation after a time t is ``(1 + t / T) exp(-t / T)``.
        Infinite for 1000 steps or more. Empty if the coefficients show no dynamics.
    decomposition : Decomposition
        Smoothed cameras, positions and coefficients, for `AffineNRSfM.reconstruct` and
        exports. Cameras are filled in, positions are NaN if too few points are visible.
    """

    alpha: NDArray
    alpha_std: NDArray
    time_scales: NDArray
    decomposition: Decomposition


@one_blas_thread()
def smooth(
    alone: LinearisedFrames,
    gauge: FrameMap,
    camera: CameraModel,
    time: Any,
    groups: Any,
    max_gap: int,
    max_iter: int,
    tol: float,
    dtype: Any,
) -> SmoothedCoefficients:
    """Return coefficients and cameras of fits given all frames of their sequences.

    Without dynamics these are the fits. Parameters as of `AffineNRSfM.smooth`, and the
    type of the numbers of the result. Time scales are ``1 / l``, infinite for the least
    rates.
    """
    n_frames = len(alone.alpha)
    numbers = group_numbers(groups, n_frames)
    sequences, unit = sequences_of(checked_times(time, n_frames), numbers, max_gap)
    estimate = partial(
        estimated_dynamics, intercepts=bool(numbers.any()), max_iter=max_iter, tol=tol
    )
    frames, rates = _smoothed_frames(alone, camera, sequences, estimate)
    scales = np.where(rates > LEAST_RATE * (1 + 1e-6), unit / rates, np.inf)
    motion, *coefficients = gauge.apply(frames.motion, frames.alpha, frames.covariance)
    parts = motion, frames.translation, *coefficients
    found = Decomposition(*(part.astype(dtype) for part in parts))
    return SmoothedCoefficients(found.alpha, found.alpha_std, scales, found)


def _smoothed_frames(
    alone: LinearisedFrames,
    camera: CameraModel,
    sequences: Sequence[tuple[NDArray, NDArray]],
    estimate: Callable[..., Dynamics | None],
) -> tuple[LinearisedFrames, NDArray]:
    """Return frames given all frames of their sequences, and the rates, increasing.

    Sequences without a known frame stay as they are. Without dynamics all frames do,
    and there are no rates.
    """
    K, none = alone.alpha.shape[1], np.empty(0)
    fitted = np.isfinite(alone.precision[:, 0, 0])
    if not fitted.any():
        return alone, none
    pairs = (_observations(alone, camera, *each) for each in sequences)
    origins, observed = zip(*pairs, strict=True)
    # Parameters of cameras in units of their changes and deviations
    precision = np.median(np.diagonal(alone.precision[fitted], 0, 1, 2), axis=0)
    square = np.mean(np.concatenate([each[2] for each in observed]) ** 2, axis=0)
    square += np.divide(1.0, precision, where=precision > 0, out=0.0 * precision)
    square[:K], square[square == 0] = 1.0, 1.0
    scale = np.sqrt(square)
    observed = tuple(
        (scale[:, None] * L * scale, fit / scale, change / scale)
        for L, fit, change in observed
    )
    dynamics = estimate(observed, K)
    if dynamics is None:
        return alone, none
    motion, translation, alpha, covariance = map(np.copy, alone[:4])
    for (rows, steps), origin, each in zip(sequences, origins, observed, strict=True):
        if not fitted[rows].any():
            continue
        states, covariances, *_ = smoothed(each, dynamics)
        mean = scale * states[steps]
        alpha[rows], covariance[rows] = mean[:, :K], covariances[steps, :K, :K]
        moved = camera.moved(frames_last(alone.motion[origin]), mean[:, K:].T)
        motion[rows] = frames_first(moved)
        mean[:, :K] -= alone.alpha[rows]
        translation[rows] -= np.einsum("ip,ipr->ir", mean, alone.slope[rows])
        translation[rows[~fitted[rows]]] = np.nan
    frames = LinearisedFrames(motion, translation, alpha, covariance, *alone[4:])
    return frames, np.exp(np.sort(dynamics.rates))


def _observations(
    alone: LinearisedFrames, camera: CameraModel, rows: NDArray, steps: NDArray
) -> tuple[NDArray, Observations]:
    """Return the origin of each row of a sequence, and the likelihoods of its steps.

    The origin is the last known row, before the first one the first one.
    """
    n_steps, (_, n, _), K = steps[-1] + 1, alone.precision.shape, alone.alpha.shape[1]
    precision, fit, change = np.zeros((n_steps, n, n)), *np.zeros((2, n_steps, n))
    fitted = np.isfinite(alone.precision[rows, 0, 0])
    chosen, at = rows[fitted], steps[fitted]
    if len(chosen) > 1:
        motion = alone.motion[chosen]
        change[at[1:], K:] = camera.steps_between(motion[:-1], motion[1:])
    if len(chosen):
        precision[at], fit[at, :K] = alone.precision[chosen], alone.alpha[chosen]
        rows = chosen[np.maximum(np.cumsum(fitted) - 1, 0)]
    return rows, (precision, fit, change)


def smoothed(
    observed: Observations, dynamics: Dynamics
) -> tuple[NDArray, NDArray, float, NDArray]:
    """Return the posterior of a sequence: Kalman filter and smoother.

    Means (n_steps, p), covariances (n_steps, p, p), the log-likelihood of the frames,
    up to a constant of each frame, and moments (4, D, D) of the states z: sums over t
    of ``E z_t+1 z_t+1^T``, ``E z_t+1 z_t^T``, ``E z_t z_t^T``, and ``E z_1 z_1^T``.
    """
    F, Q, first, readout = dynamics.matrices()
    precision, fits, change = observed
    n_steps, n = fits.shape
    mean, covariance = np.empty((n_steps, len(F))), np.empty((n_steps, *F.shape))
    change = change @ np.eye(n, len(F))
    m, P, log_likelihood = np.zeros(len(F)), first, 0.0
    # Filter: prediction, then update by ``P - P H^T (I + L S)^-1 L H P``, S = H P H^T
    for t, (L, fit) in enumerate(zip(precision, fits, strict=True)):
        if t:
            m, P = F @ m - change[t], F @ P @ F.T + Q
        across, far = readout @ P, readout @ m - fit
        growth, off = np.eye(n) + L @ across @ readout.T, fit - L @ far
        solved = np.linalg.solve(growth, np.column_stack([L @ across, off]))
        step = across.T @ solved[:, -1]
        # Integral of the likelihood over the predicted density
        square = far @ (fit + off) + off @ readout @ step
        log_likelihood += 0.5 * float(square - np.linalg.slogdet(growth)[1])
        m, P = m + step, _symmetric(P - across.T @ solved[:, :-1])
        mean[t], covariance[t] = m, P
    # Smoother, from the last frame to the first: gain J = P F^T P_predicted^-1
    late, lagged, early = np.zeros((3, *F.shape))
    for t in range(n_steps - 2, -1, -1):
        across = F @ covariance[t]
        predicted = across @ F.T + Q
        J = np.linalg.solve(predicted, across).T
        following = mean[t + 1] + change[t + 1]
        late += covariance[t + 1] + np.outer(following, following)
        lagged += covariance[t + 1] @ J.T
        mean[t] += J @ (following - F @ mean[t])
        covariance[t] += _symmetric(J @ (covariance[t + 1] - predicted) @ J.T)
        lagged += np.outer(following, mean[t])
        early += covariance[t] + np.outer(mean[t], mean[t])
    first = covariance[0] + np.outer(mean[0], mean[0])
    moments = np.stack([late, lagged, early, first])
    return mean @ readout.T, readout @ covariance @ readout.T, log_likelihood, moments


def estimated_dynamics(
    sequences: Sequence[Observations],
    n_components: int,
    intercepts: bool,
    max_iter: int,
    tol: float,
) -> Dynamics | None:
    """Return the most likely dynamics of sequences; None without strong evidence."""
    n_walks = sequences[0][1].shape[1] - n_components
    found, splits = [], (n_components, n_components + n_walks)

    def minus_log_likelihood(parameters: NDArray) -> tuple[float, NDArray]:
        dynamics = Dynamics(*np.split(parameters, splits))
        ends = (smoothed(each, dynamics) for each in sequences)
        _, _, values, moments = zip(*ends, strict=True)
        n_pairs = sum(len(fit) - 1 for _, fit, _ in sequences)
        total = np.sum(moments, axis=0)
        slope = expected_gradient(dynamics, total, n_pairs, len(sequences))
        return -sum(values), -slope

    search = partial(minimize, minus_log_likelihood, jac=True, method="L-BFGS-B")
    options = {"maxiter": max_iter, "gtol": tol, "ftol": 1e-12}
    # With dynamics, and independent frames with an intercept
    for rate, shares in (LEAST_RATE, intercepts), (LARGEST_RATE, True):
        lower = np.log(rate)
        lengths = n_components, n_walks, n_components * shares
        start = np.repeat([max(lower, FIRST_RATE), 0.0, 0.0], lengths)
        limits = [(lower, np.log(LARGEST_RATE)), (-40.0, 10.0), (-7.0, 7.0)]
        bounds = np.repeat(limits, lengths, axis=0)
        found.append(search(start, bounds=bounds, options=options))
    # Akaike's criterion: one rate for each coefficient
    if found[1].fun - found[0].fun <= n_components + STRONG_EVIDENCE:
        return None
    return Dynamics(*np.split(found[0].x, splits))


def expected_gradient(
    dynamics: Dynamics, moments: NDArray, n_pairs: int, n_sequences: int
) -> NDArray:
    """Return the gradient of the expected log density of states and frames.

    It is the gradient of the log-likelihood (Fisher's identity). The density is a sum
    over coefficients and cameras: central differences of all at once.
    """

    def density(name: str, change: float) -> NDArray:
        near = dynamics._replace(**{name: getattr(dynamics, name) + change})
        return expected_log_density(near, moments, n_pairs, n_sequences)

    def difference(name: str) -> NDArray:
        return (density(name, 1e-4) - density(name, -1e-4)) / 2e-4

    K = len(dynamics.rates)
    shares = difference("shares")[:K] if len(dynamics.shares) else np.empty(0)
    return np.concatenate([difference("rates")[:K], difference("walks")[K:], shares])


def expected_log_density(
    dynamics: Dynamics, moments: NDArray, n_pairs: int, n_sequences: int
) -> NDArray:
    """Return the expected log density (p,) by coefficient and camera parameter."""
    F, Q, first = dynamics.blocks()
    n = F.shape[2]
    states = moments[:, : 2 * n, : 2 * n].reshape(4, 2, n, 2, n)
    late, lagged, early, start = np.einsum("makbk->mabk", states)
    across = np.einsum("abk,cbk->ack", F, lagged)
    noise = late - across - across.swapaxes(0, 1)
    noise += np.einsum("abk,bck,dck->adk", F, early, F)
    density = _log_density(noise, Q, n_pairs) + _log_density(start, first, n_sequences)
    b, square = dynamics.between, np.diagonal(moments[3])[2 * n :]
    density[: len(b)] -= 0.5 * (n_sequences * np.log(b) + square / b)
    return density  # b is empty without intercepts


def _log_density(moments: NDArray, covariance: NDArray, number: int) -> NDArray:
    """Return expected normal log densities (k,), up to constants.

    For the summed second moments (2, 2, k) of a number of samples, and covariances.
    """
    log_determinant = np.linalg.slogdet(covariance.T)[1]
    square = np.einsum("kab,abk->k", np.linalg.inv(covariance.T), moments)
    return np.asarray(-0.5 * (number * log_determinant + square))


def _symmetric(matrix: NDArray) -> NDArray:
    """Return the symmetric part of a matrix."""
    return 0.5 * (matrix + matrix.T)
