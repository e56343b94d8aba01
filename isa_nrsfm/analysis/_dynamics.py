"""Coefficients in time: Kalman filter, smoother, expectation maximisation.

The coefficients x_t of the frames of a sequence follow a first-order autoregression ::

    x_t = F x_t-1 + w_t,  w_t ~ N(0, Q),  x_1 ~ N(0, I).

With sequences of several people, ``x_t - u`` follows the autoregression: u is an
intercept of the sequence, drawn from N(0, B). The state of the filter is (x_t, u) then,
and ``x_1 - u`` has the covariance of all ``x_t - u``. So differences between people are
not taken for dynamics.

A frame is observed through its likelihood as a function of x, a normal density with the
precision L_t and the information vector h_t. The posterior of a frame by itself, mean
m_t and covariance C_t, contains the prior N(0, I). The likelihood without it has ``L_t
= C_t^-1 - I`` and ``h_t = C_t^-1 m_t``, and zeros for an unseen frame.

References: Rauch, Tung, Striebel, "Maximum likelihood estimates of linear dynamic
systems", 1965; Shumway, Stoffer, "An approach to time series smoothing and forecasting
using the EM algorithm", 1982; MacKay, "Bayesian interpolation", 1992 (evidence).
"""

from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import block_diag
from scipy.optimize import minimize_scalar

from isa_nrsfm._tables.frame_columns import checked_times, group_numbers

# Least logarithm of the evidence for dynamics over that for none: a Bayes factor of 20,
# "strong" (Kass, Raftery, "Bayes factors", 1995). Motion capture has hundreds, the same
# frames shuffled less than one.
STRONG_EVIDENCE = 3.0


class Observations(NamedTuple):
    """L_t (n_steps, K, K) and h_t (n_steps, K) of the frames of a sequence."""

    precision: NDArray
    information: NDArray


class Dynamics(NamedTuple):
    """F, Q and the covariance of the first state of a sequence, (K, K) each."""

    transition: NDArray
    innovation: NDArray
    first: NDArray


class Smoothed(NamedTuple):
    """Posterior of the coefficients of a sequence, given all of its frames.

    Means (n_steps, K), covariances (n_steps, K, K), those of x_t+1 and x_t (n_steps -
    1, K, K), and the log-likelihood of the frames, up to a constant of each frame.
    """

    mean: NDArray
    covariance: NDArray
    lagged: NDArray
    log_likelihood: float


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
    """Return posterior means and covariances, given all frames of their sequences.

    Means (I, K), NaN for frames without a fit, and covariances (I, K, K) of the frames
    by themselves have the prior N(0, I). If there are no dynamics, they are returned
    unchanged. The time scales (K,) or (0,) are ``-1 / log |l|`` of the eigenvalues l of
    the transition, the longest first, infinite where |l| >= 1.
    """
    times, numbers = checked_times(time, len(mean)), group_numbers(groups, len(mean))
    sequences, unit = sequences_of(times, numbers, max_gap)
    # Differences between groups are not taken for dynamics.
    intercepts = numbers is not None and bool(numbers.any())
    K, size = mean.shape[1], mean.shape[1] * (1 + intercepts)
    precision, information = observations(mean, covariance)
    filled = []
    for rows, steps in sequences:
        n_steps = steps[-1] + 1
        L, h = np.zeros((n_steps, size, size)), np.zeros((n_steps, size))
        L[steps, :K, :K], h[steps, :K] = precision[rows], information[rows]
        filled.append(Observations(L, h))
    dynamics = estimated_dynamics(filled, max_iter, tol, intercepts)
    if dynamics is None:
        return mean, covariance, np.empty(0)
    mean, covariance = mean.copy(), covariance.copy()
    for (rows, steps), each in zip(sequences, filled, strict=True):
        result = smoothed(each, dynamics)
        mean[rows] = result.mean[steps, :K]
        covariance[rows] = result.covariance[steps, :K, :K]
    moduli = np.sort(np.abs(np.linalg.eigvals(dynamics.transition[:K, :K])))[::-1]
    with np.errstate(divide="ignore"):
        scales = np.where(moduli < 1, -unit / np.log(np.minimum(moduli, 1)), np.inf)
    return mean, covariance, scales


def sequences_of(
    time: NDArray, groups: NDArray | None, max_gap: int
) -> tuple[list[tuple[NDArray, NDArray]], float]:
    """Return the rows and steps of each sequence, and the time of a step (the median).

    A gap of more than max_gap steps begins a new sequence. Refuses times that do not
    rise within groups, and groups that have only one row each.
    """
    if groups is None:
        groups = np.zeros(len(time), dtype=int)
    rows_of = [np.flatnonzero(groups == group) for group in range(groups.max() + 1)]
    for rows in rows_of:
        falling = np.flatnonzero(np.diff(time[rows]) <= 0)
        if len(falling):
            first, second = rows[falling[0]], rows[falling[0] + 1]
            raise ValueError(
                f"times must increase within a group; row {second} has "
                f"{time[second]:g} after {time[first]:g} of row {first}"
            )
    differences = np.concatenate([np.diff(time[rows]) for rows in rows_of])
    if not len(differences):
        raise ValueError("no group has two rows, so that there is no sequence")
    unit = float(np.median(differences))
    found = []
    for rows in rows_of:
        lengths = np.maximum(np.rint(np.diff(time[rows]) / unit), 1).astype(int)
        for part in np.split(
            np.arange(len(rows)), np.flatnonzero(lengths > max_gap) + 1
        ):
            steps = np.cumsum(np.append(0, lengths[part[:-1]]))
            found.append((rows[part], steps))
    return found, unit


def observations(mean: NDArray, covariance: NDArray) -> Observations:
    """Return the likelihood of coefficients without the prior N(0, I), zero for NaN."""
    n_frames, K = mean.shape
    precision, information = np.zeros((n_frames, K, K)), np.zeros((n_frames, K))
    known = np.isfinite(mean).all(axis=1)
    inverse = np.linalg.inv(covariance[known])
    # A posterior is no wider than its prior: negative values are rounding errors.
    values, axes = np.linalg.eigh(inverse - np.eye(K))
    scaled = axes * np.maximum(values, 0.0)[:, None]
    precision[known] = scaled @ axes.swapaxes(1, 2)
    information[known] = (inverse @ mean[known][..., None])[..., 0]
    return Observations(precision, information)


def smoothed(observed: Observations, dynamics: Dynamics) -> Smoothed:
    """Return the posterior of a sequence: Kalman filter and smoother."""
    F, Q, first = dynamics
    n_steps, K = observed.information.shape
    predicted = np.zeros((n_steps, K)), np.empty((n_steps, K, K))
    mean, covariance = np.empty((n_steps, K)), np.empty((n_steps, K, K))
    m, P, log_likelihood = np.zeros(K), first, 0.0
    # Filter: prediction, then update in the information form, P <- (P^-1 + L)^-1
    for t, (L, h) in enumerate(zip(*observed, strict=True)):
        if t:
            m, P = F @ m, F @ P @ F.T + Q
        predicted[0][t], predicted[1][t] = m, P
        growth = np.eye(K) + P @ L
        P, off = _symmetric(np.linalg.solve(growth, P)), h - L @ m
        # Integral of exp(h^T x - x^T L x / 2) over the predicted density
        square = m @ (h + off) + off @ P @ off
        log_likelihood += 0.5 * float(square - np.linalg.slogdet(growth)[1])
        m = m + P @ off
        mean[t], covariance[t] = m, P
    # Smoother, from the last frame to the first: gain J = P F^T P_predicted^-1
    lagged = np.empty((max(n_steps - 1, 0), K, K))
    for t in range(n_steps - 2, -1, -1):
        J = np.linalg.solve(predicted[1][t + 1], F @ covariance[t]).T
        mean[t] += J @ (mean[t + 1] - predicted[0][t + 1])
        change = covariance[t + 1] - predicted[1][t + 1]
        covariance[t] = _symmetric(covariance[t] + J @ change @ J.T)
        lagged[t] = covariance[t + 1] @ J.T
    return Smoothed(mean, covariance, lagged, log_likelihood)


def estimated_dynamics(
    sequences: Sequence[Observations], max_iter: int, tol: float, intercepts: bool
) -> Dynamics | None:
    """Estimate the autoregression by expectation maximisation; None without one."""
    K = sequences[0].information.shape[1] // (1 + intercepts)
    options = sequences, max_iter, tol, intercepts
    found = _most_likely(0.5 * np.eye(K), *options)
    if found is None or not intercepts:
        return found
    # Intercepts and a slow autoregression are alike in short sequences.
    still = _most_likely(np.zeros((K, K)), *options)
    assert still is not None
    gain = 0.0
    for each in sequences:
        gain += smoothed(each, found).log_likelihood
        gain -= smoothed(each, still).log_likelihood
    # Akaike's criterion: F has K^2 numbers.
    return found if gain > K**2 + STRONG_EVIDENCE else None


def _most_likely(
    F: NDArray,
    sequences: Sequence[Observations],
    max_iter: int,
    tol: float,
    intercepts: bool,
) -> Dynamics | None:
    """Maximise the likelihood from a transition F (K, K). A zero F stays zero."""
    K = len(F)
    moves, one = F.any(), np.eye(K) / (1 + intercepts)
    # Map from the state to x_t - u, which follows the autoregression
    relative = np.hstack([np.eye(K), -np.eye(K)][: 1 + intercepts])
    moving = Dynamics(F, one - F @ one @ F.T, one)
    dynamics = _joined(moving, one) if intercepts else moving
    before = None
    for _ in range(max_iter):
        # Expectation: second moments of x_t and x_t+1, summed over all pairs
        ends = [smoothed(each, dynamics) for each in sequences]
        moments = np.sum([_pair_moments(each) for each in ends], axis=0)
        early, late, across = relative @ moments @ relative.T
        n_pairs = sum(len(each.lagged) for each in ends)
        # Maximisation: F by regression with a ridge, Q from what is left
        if moves:
            F = _shrunk_regression(across, early, moving.innovation)
            if not F.any():
                return None
        Q = late - F @ across.T - across @ F.T + F @ early @ F.T
        dynamics = moving = Dynamics(F, _symmetric(Q) / n_pairs, moving.first)
        if intercepts:
            moving = moving._replace(first=_symmetric(early + late) / (2 * n_pairs))
            starts = [
                each.covariance[0] + np.outer(*each.mean[[0, 0]]) for each in ends
            ]
            dynamics = _joined(moving, np.mean(starts, axis=0)[K:, K:])
        # Convergence test
        mean = np.concatenate([each.mean for each in ends])
        if before is not None and np.abs(mean - before).max() < tol:
            break
        before = mean
    return dynamics


def _pair_moments(ends: Smoothed) -> NDArray:
    """Return ``sum_t E x_t x_t^T``, the same of x_t+1, and ``sum_t E x_t+1 x_t^T``."""
    mean, covariance, lagged, _ = ends
    moments = covariance + mean[:, :, None] * mean[:, None]
    across = lagged.sum(axis=0) + mean[1:].T @ mean[:-1]
    return np.stack([moments[:-1].sum(axis=0), moments[1:].sum(axis=0), across])


def _joined(moving: Dynamics, between: NDArray) -> Dynamics:
    """Return the dynamics of states (x_t, u); u has the covariance between (K, K)."""
    F, Q, first = moving
    one, zero = np.eye(len(F)), np.zeros_like(F)
    return Dynamics(
        np.block([[F, one - F], [zero, one]]),
        block_diag(Q, zero),
        np.block([[first + between, between], [between, between]]),
    )


def _shrunk_regression(across: NDArray, early: NDArray, Q: NDArray) -> NDArray:
    """
    Return the transition of greatest posterior density, with a ridge from the evidence.

    The rows of ``Q^-1/2 F`` have the prior ``N(0, I / ridge)``. The ridge maximises the
    evidence. If the evidence is hardly greater than for a transition of zero, the
    result is zero. The moments are ``sum_t E x_t+1 x_t^T`` and ``sum_t E x_t x_t^T``.
    """
    K = len(Q)
    values, axes = np.linalg.eigh(early)
    whitened = np.linalg.solve(np.linalg.cholesky(Q), across @ axes)
    energy = np.sum(whitened**2, axis=0)

    def minus_log_evidence(log_ridge: float) -> float:
        ridge = np.exp(log_ridge)
        gain = K * np.log1p(values / ridge) - energy / (values + ridge)
        return float(0.5 * gain.sum())

    # Grid from negligible to dominating ridges, relative to the moments
    grid = np.log(values.max()) + np.linspace(-20.0, 20.0, 81)
    best = min(grid, key=minus_log_evidence)
    if minus_log_evidence(best) > -STRONG_EVIDENCE:
        return np.zeros_like(Q)
    bounds = best - 0.5, best + 0.5
    found = minimize_scalar(minus_log_evidence, bounds=bounds, method="bounded")
    return np.asarray(across @ np.linalg.inv(early + np.exp(found.x) * np.eye(K)))


def _symmetric(matrix: NDArray) -> NDArray:
    """Return the symmetric part of a matrix."""
    return 0.5 * (matrix + matrix.T)
