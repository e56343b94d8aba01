"""Independent component analysis of vectors, with one mixing of all coordinates.

A sample of a signal is a vector of d coordinates. Independent subspace analysis mixes
all dK coordinates of K signals. Here the same K x K matrix mixes each coordinate: the
freedom that a fit leaves to its basis shapes, with points as samples and d = 3. With d
= 1 it is plain ICA, as for coefficients.
"""

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import expm
from scipy.special import gammaln

from isa_nrsfm._linalg.rounding import OF_RANKS, OF_STEPS
from isa_nrsfm._linalg.small_matrices import orientations
from isa_nrsfm._tables.blocks import spread
from isa_nrsfm.isa._strategies import orthogonalise

# Candidate densities of each signal, by their *tail*: degrees of freedom of Student's
# t, or LIGHT for one with lighter tails than a Gaussian, exp(-c ||y||^4).
LIGHT = 0.0
TAILS = (LIGHT, 16.0, 8.0, 4.0, 2.0)
# Each density is multiplied by a Gaussian of this inverse variance. Otherwise the
# likelihood has no bound where a signal vanishes at a large share of the samples.
TEMPER = 1e-3
# Relative residual of the equations of a Newton step. From 1e-2 to 1e-10 the number of
# steps is the same, and the result to twelve digits.
SOLVED = 1e-4


def shared_mixing(signals: NDArray, n_starts: int = 8) -> NDArray[np.float64]:
    """
    Return the mixing W, the same for all coordinates, that makes signals independent.

    The signals (n_signals, n_samples, size) are whitened, without removing means.
    Several orthogonal starts are improved by a few steps of FastICA for vectors
    (Hyvarinen, "Fast and robust fixed-point algorithms for independent component
    analysis", 1999). Newton steps from the likeliest result then maximise the
    likelihood of independent spherical signals over all invertible W. It is ``sum_k E
    log p_k(||y_k||) + size * log |det W|`` with ``y = W signals``. Each density p_k is
    the likeliest of a few, with heavy or light tails.

    The independent signals have mean square 1 and non-negative skewness, the least
    Gaussian one first. If the signals have a rank r below their number, only the first
    r rows of W give independent signals, the others zeros. The result does not depend
    on the order of the samples, the basis of the signals or a rotation common to all
    samples. If several signals are Gaussian, or if there are too few samples, the
    result is meaningless. One Newton step takes ``O(n_signals^3 n_samples size)``
    operations. Conjugate gradients solve its equations (gradient, Hessian and
    preconditioner: Ablin, Cardoso, Gramfort, "Faster independent component analysis by
    preconditioning with Hessian approximations", 2018).
    """
    signals = np.ascontiguousarray(signals, dtype=np.float64)
    n_signals, _, size = signals.shape
    whitening, null = _whitening(signals.reshape(n_signals, -1))
    if not len(whitening):
        return np.eye(n_signals)
    Z = np.tensordot(whitening, signals, 1)

    # The likeliest of the starts. A few steps lead to a basin of attraction. More would
    # go astray where signals are Gaussian, and magnify rounding errors.
    few = _few_samples(Z)
    ends = _fixed_point(_starts(few, n_starts), few, 8)
    W = max(ends, key=lambda end: _fit_densities(end, few)[0])
    # The maximum of the likelihood, for many samples first that of a part of them
    for samples in [few] if few is Z else [few, Z]:
        W, of_signals = _maximise(W, samples)

    # Scale, sign and order. Of all signals of unit mean square, Gaussian ones are the
    # least likely.
    Y = np.tensordot(W, Z, 1).reshape(len(W), -1)
    scale = np.sqrt(np.mean(Y**2, axis=1))
    order = np.argsort(-(of_signals + size * np.log(scale)), kind="stable")
    W = (W * (orientations(Y) / scale)[:, None])[order]
    return np.vstack([W @ whitening, null])


def independent_coefficients(alpha: NDArray) -> NDArray[np.float64]:
    """Return the mixing W (K, K) that makes coefficients (n_frames, K) independent.

    The columns of ``alpha @ W.T`` have unit variance. With the basis
    ``tensordot(inv(W).T, basis, 1)`` they give the same shapes.
    """
    return shared_mixing((alpha - alpha.mean(axis=0)).T[:, :, None])


def _whitening(rows: NDArray) -> tuple[NDArray, NDArray]:
    """Return mixings to white rows (rank, n), and to rows of zeros (n - rank, n)."""
    # The triangular factor keeps the precision that rows @ rows.T would lose.
    R = np.linalg.qr(rows.T, mode="r") / np.sqrt(rows.shape[1])
    U, S, _ = np.linalg.svd(R.T)
    rank = int(np.sum(S > OF_RANKS * S[0]))
    if rank == 0:
        return np.empty((0, len(rows))), np.eye(len(rows))
    return (U[:, :rank] / S[:rank]).T, U[:, rank:].T / S[0]


def _few_samples(Z: NDArray) -> NDArray:
    """Return some of many samples, spread evenly from the smallest to the largest."""
    if Z.shape[1] <= 3000:
        return Z
    order = np.argsort(np.einsum("kjc,kjc->j", Z, Z), kind="stable")
    return np.ascontiguousarray(Z[:, spread(order, 1500)])


def _starts(Z: NDArray, n_starts: int) -> NDArray:
    """Return orthogonal matrices (n_starts, n_signals, n_signals) to start from.

    ``W Z`` is the same for any orthogonal mixing of the white signals Z (n_signals,
    n_samples, size). The first W has the axes of a fourth-order moment (FOBI, Cardoso
    1989) with bounded weights. The others are random rotations of it.
    """
    n_signals = len(Z)
    energy = np.einsum("kjc,kjc->j", Z, Z)
    weighted = (energy / (energy + energy.mean()))[:, None] * Z
    moment = weighted.reshape(n_signals, -1) @ Z.reshape(n_signals, -1).T
    axes = np.linalg.eigh(moment)[1].T
    # Fix the signs of the axes relative to each other. The weighted mean of each signal
    # is a vector of `size` coordinates. All of them get a positive product with the
    # principal direction of these vectors, which turns with the coordinates.
    side = axes @ weighted.mean(axis=1)
    axes[side @ np.linalg.svd(side)[2][0] < 0] *= -1.0

    rng = np.random.default_rng(0)
    turned = rng.standard_normal((n_starts - 1, n_signals, n_signals)) @ axes
    return np.concatenate([axes[None], orthogonalise(turned)])


def _fixed_point(W: NDArray, Z: NDArray, n_steps: int) -> NDArray:
    """Return W (n_starts, n, n) after some steps of symmetric FastICA for vectors.

    A step is ``w+ = E[sum_c z_c y_c g(u)] - E[size g(u) + 2 u g'(u)] w`` with ``u =
    ||y||^2`` and ``g = F'``, followed by symmetric orthogonalisation.
    """
    n_signals, n_samples, size = Z.shape
    flat, tail = Z.reshape(n_signals, -1), np.array(8.0)  # mild: few local optima
    for _ in range(n_steps):
        Y = (W @ flat).reshape(*W.shape[:2], n_samples, size)
        u = np.einsum("skjc,skjc->skj", Y, Y)
        g, dg = _slopes(u, tail, size)
        curvature = np.mean(size * g + 2.0 * u * dg, axis=-1)
        step = (g[..., None] * Y).reshape(*W.shape[:2], -1) @ flat.T / n_samples
        W = orthogonalise(step - curvature[..., None] * W)
    return W


def _log_density(u: NDArray, tail: NDArray, size: int) -> NDArray:
    """Return the log density F(u) of `TAILS` at squared norms u (..., n_samples)."""
    light = tail == LIGHT
    F = -0.5 * (tail + size) * np.log1p(u / np.where(light, 1.0, tail))
    if light.any():
        F = np.where(light, -0.5 / (size + 2) * u * u, F)
    return F - 0.5 * TEMPER * u


def _slopes(u: NDArray, tail: NDArray, size: int) -> tuple[NDArray, NDArray]:
    """Return F'(u) and F''(u), for u and `tail` as in `_log_density`."""
    light = tail == LIGHT
    nearness = 1.0 / (np.where(light, 1.0, tail) + u)
    g = -0.5 * (tail + size) * nearness
    dg = -g * nearness
    if light.any():
        g = np.where(light, -1.0 / (size + 2) * u, g)
        dg = np.where(light, -1.0 / (size + 2), dg)
    return g - 0.5 * TEMPER, dg


def _log_integral(tail: float, size: int) -> float:
    """Return the logarithm of the integral of ``exp F(||y||^2)`` over all vectors y."""
    # In the logarithm of the radius the trapezoidal rule is accurate to rounding.
    log_radius = np.linspace(-40.0, 8.0, 1001)
    F = _log_density(np.exp(2.0 * log_radius), np.array(tail), size)
    radial = np.exp(F + size * log_radius).sum() * (log_radius[1] - log_radius[0])
    sphere = np.log(2.0) + size / 2 * np.log(np.pi) - gammaln(size / 2)
    return float(sphere + np.log(radial))


def _fit_densities(W: NDArray, Z: NDArray) -> tuple[float, NDArray, NDArray, NDArray]:
    """Return the likelihood of the signals ``y = W z`` with their likeliest densities.

    Also returns for each signal its density, one of `TAILS`, its squared scale, and ``E
    log p_k(||y_k||)``. The likelihood adds ``size * log |det W|`` to the sum of these.
    """
    size = Z.shape[2]
    Y = np.tensordot(W, Z, 1)
    u = np.einsum("kjc,kjc->kj", Y, Y)
    log_variance = np.log(u.mean(axis=1) / size)
    variances, values = [], []
    for tail in TAILS:
        for _ in range(5):
            v = u * np.exp(-log_variance)[:, None]
            g, dg = _slopes(v, np.array(tail), size)
            # Newton step for the scale. The likelihood is largest where
            # E[-2 g(v) v] = size, with v = u / variance.
            excess = -2.0 * np.mean(g * v, axis=1) - size
            slope = 2.0 * np.mean((g + dg * v) * v, axis=1)
            log_variance = log_variance - np.clip(excess / slope, -1.0, 1.0)
        v = u * np.exp(-log_variance)[:, None]
        F = _log_density(v, np.array(tail), size).mean(axis=1)
        variances.append(np.exp(log_variance))
        values.append(F - _log_integral(tail, size) - size / 2 * log_variance)
    best = np.argmax(values, axis=0), np.arange(len(W))
    of_signals = np.array(values)[best]
    total = float(of_signals.sum() + size * np.linalg.slogdet(W)[1])
    return total, np.array(TAILS)[best[0]], np.array(variances)[best], of_signals


def _maximise(W: NDArray, Z: NDArray) -> tuple[NDArray, NDArray]:
    """Alternate mixing and densities to a local maximum; return W and log densities."""
    _, tails, variance, of_signals = _fit_densities(W, Z)
    for _ in range(10):
        before = tails
        W = _newton(W / np.sqrt(variance)[:, None], Z, tails)
        _, tails, variance, of_signals = _fit_densities(W, Z)
        if np.array_equal(tails, before):
            break
    return W, of_signals


def _newton(W: NDArray, Z: NDArray, tails: NDArray) -> NDArray:
    """Maximise the likelihood over W by relative, damped steps ``W <- exp(E) W``."""
    size = Z.shape[2]
    tail = tails[:, None]

    def likelihood(W: NDArray) -> tuple[float, NDArray, NDArray]:
        Y = np.tensordot(W, Z, 1)
        u = np.einsum("kjc,kjc->kj", Y, Y)
        F = _log_density(u, tail, size).mean(axis=1).sum()
        return float(F + size * np.linalg.slogdet(W)[1]), Y, u

    value, Y, u = likelihood(W)
    shift = 0.0  # relative to `size`
    for _ in range(100):
        gradient, blocks = _relative_derivatives(Y, *_slopes(u, tail, size))
        if np.abs(gradient).max() < 1e-11 * size:
            break
        # Raise the shift until a step succeeds. A long step would turn past the next
        # maximum.
        while shift < 1e8:
            E = _ascent(gradient, blocks, shift * size, size)
            if E is not None and np.abs(E).max() < 1.0:
                trial = expm(E) @ W
                raised, Y, u = likelihood(trial)
                armijo = 1e-3 * np.vdot(gradient, E)
                if raised - value > armijo - OF_STEPS * abs(value):
                    break
            shift = max(4.0 * shift, 1e-3)
        else:
            break
        W, value = trial, raised
        shift = shift / 4.0 if shift > 1e-3 else 0.0
    return W


def _relative_derivatives(
    Y: NDArray, g: NDArray, dg: NDArray
) -> tuple[NDArray, NDArray]:
    """Return the gradient G and the blocks H_k of the Hessian in a relative step E.

    To second order ``W <- (I + E) W`` raises the likelihood by ``<G, E> + (sum_k E_k
    H_k E_k^T - size <E, E^T>) / 2``, with the rows E_k of E. With means over the
    samples written as E[],

        G_ka = 2 E[g_k y_k.y_a] + size delta_ka
        H_kab = 2 E[g_k y_a.y_b] + 4 E[g'_k (y_k.y_a) (y_k.y_b)]

    (Ablin, Cardoso and Gramfort 2018, here for vectors). Y is (n, n_samples, size), H
    (n, n, n).
    """
    n_signals, n_samples, size = Y.shape
    Y = np.ascontiguousarray(Y.mT)  # samples last: long rows are fast
    flat = Y.reshape(n_signals, -1)
    gradient = 2.0 / n_samples * (g[:, None] * Y).reshape(n_signals, -1) @ flat.T
    gradient += size * np.eye(n_signals)
    blocks = np.empty((n_signals,) * 3)
    for k in range(n_signals):
        products = np.einsum("acj,cj->aj", Y, Y[k])
        weighted = (g[k] * Y).reshape(n_signals, -1)
        blocks[k] = 2.0 * weighted @ flat.T + 4.0 * (dg[k] * products) @ products.T
    return gradient, blocks / n_samples


def _ascent(
    gradient: NDArray, blocks: NDArray, shift: float, size: int
) -> NDArray | None:
    """Return the step E that maximises the quadratic model less ``shift ||E||^2 / 2``.

    None if conjugate gradients find a direction in which the model has no maximum. The
    preconditioner is the matrix with the diagonals of the blocks, definite or not at
    all.
    """
    one = np.eye(len(blocks))
    blocks = shift * one - blocks
    # Entries E_ka and E_ak are coupled.
    coupling = size * (1.0 - one)
    diagonal = np.einsum("kaa->ka", blocks) + size * one
    determinant = diagonal * diagonal.T - coupling**2
    if min(diagonal.min(), determinant.min()) <= 0:
        return None
    E, residual = np.zeros_like(gradient), gradient
    direction, least = np.zeros_like(gradient), SOLVED**2 * np.vdot(gradient, gradient)
    product = 1.0
    for _ in range(gradient.size):
        step = (diagonal.T * residual - coupling * residual.T) / determinant
        product, before = np.vdot(residual, step), product
        direction = step + product / before * direction
        change = np.einsum("kab,kb->ka", blocks, direction) + size * direction.T
        curvature = np.vdot(direction, change)
        if curvature <= 0:
            return None
        E = E + product / curvature * direction
        residual = residual - product / curvature * change
        if np.vdot(residual, residual) <= least:
            break
    return E
