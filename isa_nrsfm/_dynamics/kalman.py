"""Dynamics of coefficients: Kalman filter, smoother, expectation maximisation.

The coefficients x_t of the frames of a sequence follow a first-order autoregression ::

    x_t = F x_t-1 + w_t,  w_t ~ N(0, Q),  x_1 ~ N(0, I).

With sequences of several people, ``x_t - u`` follows the autoregression: u is an
intercept of the sequence, drawn from N(0, B). The state of the filter is (x_t, u) then,
and ``x_1 - u`` has the covariance of all ``x_t - u``. So differences between people are
no dynamics.

A frame is observed through its likelihood as a function of x, a normal density with
the precision L_t and the information vector h_t. The posterior of a frame by itself,
mean m_t and covariance C_t, contains the prior N(0, I). Without it there remain ``L_t =
C_t^-1 - I`` and ``h_t = C_t^-1 m_t``: where a prediction takes the place of the prior,
nothing counts twice. A frame that nobody saw has ``L_t = 0, h_t = 0``.

References: Rauch, Tung, Striebel, "Maximum likelihood estimates of linear dynamic
systems", 1965; Shumway, Stoffer, "An approach to time series smoothing and forecasting
using the EM algorithm", 1982; MacKay, "Bayesian interpolation", 1992 (evidence).
"""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import block_diag
from scipy.optimize import minimize_scalar

# Least logarithm of the evidence for dynamics over that for none: a Bayes factor of 20,
# "strong" (Kass, Raftery, "Bayes factors", 1995). Motion capture has hundreds, the same
# frames shuffled less than one.
STRONG_EVIDENCE = 3.0


class Observations(NamedTuple):
    """
    What the frames of one sequence tell of their coefficients, in order of time.

    Attributes
    ----------
    precision : ndarray of shape (n_steps, K, K)
        L_t.
    information : ndarray of shape (n_steps, K)
        h_t.
    """

    precision: NDArray
    information: NDArray


class Dynamics(NamedTuple):
    """
    A first-order autoregression.

    Attributes
    ----------
    transition : ndarray of shape (K, K)
        F.
    innovation : ndarray of shape (K, K)
        Q.
    first : ndarray of shape (K, K)
        Covariance of the first state of a sequence.
    """

    transition: NDArray
    innovation: NDArray
    first: NDArray


class Smoothed(NamedTuple):
    """
    Posterior of the coefficients of a sequence, given all of its frames.

    Attributes
    ----------
    mean : ndarray of shape (n_steps, K)
        Posterior means.
    covariance : ndarray of shape (n_steps, K, K)
        Posterior covariances.
    lagged : ndarray of shape (n_steps - 1, K, K)
        Posterior covariances of x_t+1 and x_t.
    log_likelihood : ndarray of shape (n_steps,)
        Logarithms of the likelihoods of the frames given those before, up to constants
        of the frames.
    """

    mean: NDArray
    covariance: NDArray
    lagged: NDArray
    log_likelihood: NDArray


def observations(mean: NDArray, covariance: NDArray) -> Observations:
    """
    Return what frames tell of their coefficients without the prior N(0, I).

    Parameters
    ----------
    mean : ndarray of shape (n_frames, K)
        Posterior means of the frames by themselves; NaN for frames without a fit.
    covariance : ndarray of shape (n_frames, K, K)
        Posterior covariances.

    Returns
    -------
    Observations
        The frames; those without a fit tell nothing.
    """
    n_frames, K = mean.shape
    precision, information = np.zeros((n_frames, K, K)), np.zeros((n_frames, K))
    known = np.isfinite(mean).all(axis=1)
    inverse = np.linalg.inv(covariance[known])
    # A posterior is no wider than its prior: less than zero are rounding errors.
    values, axes = np.linalg.eigh(inverse - np.eye(K))
    axes_of = axes.swapaxes(1, 2)
    precision[known] = (axes * np.maximum(values, 0.0)[:, None]) @ axes_of
    information[known] = (inverse @ mean[known][..., None])[..., 0]
    return Observations(precision, information)


def smoothed(observed: Observations, dynamics: Dynamics) -> Smoothed:
    """
    Return the posterior of a sequence: Kalman filter and Rauch-Tung-Striebel smoother.

    Parameters
    ----------
    observed : Observations
        The sequence.
    dynamics : Dynamics
        F and Q.

    Returns
    -------
    Smoothed
        Means, covariances and lag-one covariances.
    """
    F, Q, first = dynamics
    n_steps, K = observed.information.shape
    predicted = np.zeros((n_steps, K)), np.empty((n_steps, K, K))
    mean, covariance = np.empty((n_steps, K)), np.empty((n_steps, K, K))
    m, P = np.zeros(K), first
    growth, square = np.empty((n_steps, K, K)), np.empty(n_steps)
    # Filter: prediction, then update in the information form, P <- (P^-1 + L)^-1
    for t in range(n_steps):
        if t:
            m, P = F @ m, F @ P @ F.T + Q
        predicted[0][t], predicted[1][t] = m, P
        L, h = observed.precision[t], observed.information[t]
        growth[t] = np.eye(K) + P @ L
        P, off = _symmetric(np.linalg.solve(growth[t], P)), h - L @ m
        square[t] = m @ (h + off) + off @ P @ off
        m = m + P @ off
        mean[t], covariance[t] = m, P
    # Integrals of exp(h^T x - x^T L x / 2) over the predicted densities
    log_likelihood = 0.5 * (square - np.linalg.slogdet(growth)[1])
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
    """
    Estimate the autoregression of sequences by expectation maximisation.

    Parameters
    ----------
    sequences : sequence of Observations
        Sequences that follow the same autoregression, `with_intercept` or all without.
    max_iter : int
        Largest number of iterations.
    tol : float
        The iteration ends when no posterior mean changes by more than this.
    intercepts : bool
        Whether the states of the sequences are (x_t, u).

    Returns
    -------
    Dynamics or None
        The autoregression of the states. None if the sequences show no dynamics
        (`_shrunk_regression`).
    """
    K = sequences[0].information.shape[1] // (1 + intercepts)
    options = sequences, max_iter, tol, intercepts
    found = _most_likely(0.5 * np.eye(K), *options)
    if found is None or not intercepts:
        return found
    # Intercepts and a slow autoregression are alike in short sequences.
    still = _most_likely(np.zeros((K, K)), *options)
    assert still is not None
    # Frame by frame: their constants are large where noise is small.
    gains = [
        smoothed(each, found).log_likelihood - smoothed(each, still).log_likelihood
        for each in sequences
    ]
    # Akaike's criterion: F has K^2 numbers.
    enough = np.concatenate(gains).sum() > K**2 + STRONG_EVIDENCE
    return found if enough else None


def _most_likely(
    F: NDArray,
    sequences: Sequence[Observations],
    max_iter: int,
    tol: float,
    intercepts: bool,
) -> Dynamics | None:
    """Maximise the likelihood from a transition F (K, K), which stays if it is zero."""
    K = len(F)
    moves, one = F.any(), np.eye(K) / (1 + intercepts)
    # From the state to what follows the autoregression, x_t - u
    relative = np.hstack([np.eye(K), -np.eye(K)][: 1 + intercepts])
    moving, between = Dynamics(F, one - F @ one @ F.T, one), one
    dynamics = _joined(moving, between) if intercepts else moving
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
            starts = [_second_moments(each)[0, K:, K:] for each in ends]
            dynamics = _joined(moving, np.mean(starts, axis=0))
        # Convergence test
        mean = np.concatenate([each.mean for each in ends])
        if before is not None and np.abs(mean - before).max() < tol:
            break
        before = mean
    return dynamics


def with_intercept(observed: Observations) -> Observations:
    """
    Return the observations of states (x_t, u), of which frames show x_t.

    Parameters
    ----------
    observed : Observations
        Observations of K coefficients.

    Returns
    -------
    Observations
        Those of 2 K numbers.
    """
    precision, information = observed
    more = (0, information.shape[1])
    none = (0, 0)
    return Observations(
        np.pad(precision, (none, more, more)), np.pad(information, (none, more))
    )


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
    evidence, a sum over the eigenvectors of the moments. Where that is hardly greater
    than the evidence for zero the transition is zero: there are no dynamics.

    Parameters
    ----------
    across : ndarray of shape (K, K)
        ``sum_t E x_t+1 x_t^T``.
    early : ndarray of shape (K, K)
        ``sum_t E x_t x_t^T``.
    Q : ndarray of shape (K, K)
        Covariance of the innovations.

    Returns
    -------
    ndarray of shape (K, K)
        F.
    """
    K = len(Q)
    values, axes = np.linalg.eigh(early)
    whitened = np.linalg.solve(np.linalg.cholesky(Q), across @ axes)
    energy = np.sum(whitened**2, axis=0)

    def minus_log_evidence(log_ridge: float) -> float:
        ridge = np.exp(log_ridge)
        gain = K * np.log1p(values / ridge) - energy / (values + ridge)
        return float(0.5 * gain.sum())

    # One minimum between ridges that are nothing and everything beside the moments
    middle = np.log(values.max())
    grid = middle + np.linspace(-20.0, 20.0, 81)
    best = int(np.argmin([minus_log_evidence(each) for each in grid]))
    if minus_log_evidence(grid[best]) > -STRONG_EVIDENCE:
        return np.zeros_like(Q)
    width = grid[1] - grid[0]
    found = minimize_scalar(
        minus_log_evidence,
        bounds=(grid[best] - width, grid[best] + width),
        method="bounded",
    )
    return np.asarray(across @ np.linalg.inv(early + np.exp(found.x) * np.eye(K)))


def _second_moments(ends: Smoothed) -> NDArray:
    """Return ``E x_t x_t^T`` (n_steps, K, K)."""
    return np.asarray(ends.covariance + ends.mean[:, :, None] * ends.mean[:, None])


def _pair_moments(ends: Smoothed) -> NDArray:
    """Return ``sum_t E x_t x_t^T``, the same of x_t+1, and ``sum_t E x_t+1 x_t^T``."""
    moments, mean = _second_moments(ends), ends.mean
    across = ends.lagged.sum(axis=0) + mean[1:].T @ mean[:-1]
    return np.stack([moments[:-1].sum(axis=0), moments[1:].sum(axis=0), across])


def _symmetric(matrix: NDArray) -> NDArray:
    """Return the symmetric part of a matrix."""
    return 0.5 * (matrix + matrix.T)
