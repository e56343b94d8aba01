"""Independent signals whose samples are vectors, all coordinates mixed alike.

A sample of a signal is a vector of d coordinates. Independent subspace analysis mixes
all dK coordinates of K signals, by a dK x dK matrix. Here the same K x K matrix mixes
each of the coordinates. This is the freedom that a fit leaves to its basis shapes: the
samples are points, d is 3. With d = 1 it is plain ICA, as for coefficients.
"""

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import cho_factor, cho_solve, expm
from scipy.special import gammaln

from isa_nrsfm._linalg.rounding import OF_RANKS, OF_STEPS
from isa_nrsfm._linalg.vectors import orientations
from isa_nrsfm._tables.ordering import spread
from isa_nrsfm.isa._fixed_point import orthogonalise

# The densities among which each signal chooses, by their *tail*: degrees of freedom of
# Student's t, or LIGHT for one with lighter tails than a Gaussian, exp(-c ||y||^4).
LIGHT = 0.0
TAILS = (LIGHT, 16.0, 8.0, 4.0, 2.0)
# Each density is multiplied by a Gaussian of this inverse variance. Otherwise the
# likelihood has no bound where a signal vanishes at a large share of the samples.
TEMPER = 1e-3

# FastICA makes the starts: its density, with mild tails, has few local optima.
FIRST_TAIL = 8.0


class MixingOptions(NamedTuple):
    """
    How the likeliest mixing is searched for.

    ``python -m benchmarks.sensitivity gauge.mixing`` shows half and twice of each.

    Attributes
    ----------
    fixed_point_steps : int
        Steps of FastICA from each start. A few lead to a basin of attraction. More
        would go astray where signals are Gaussian, and magnify rounding errors.
    same_basin : float
        Two orthogonal matrices are in one basin if each row of one has a row of the
        other with at least this cosine, up to sign.
    n_finalists : int
        Number of basins, the likeliest ones, from which the likelihood is maximised.
    many_samples, first_samples : int
        With more than the first number of samples the likelihood is first maximised on
        the second.
    turns : int
        Alternations of mixing and densities.
    scale_steps : int
        Newton steps for the scale of a density.
    newton_steps : int
        Newton steps for the mixing.
    gradient_tol : float
        Convergence tolerance: the largest entry of the relative gradient, divided by
        `size`.
    longest_step : float
        Largest entry of a step E. A longer one would turn past the next maximum.
    smallest_shift, largest_shift, shift_factor : float
        Levenberg-Marquardt shift of the Hessian, relative to `size`: bounds, and the
        factor by which it rises when a Newton step fails and falls when one succeeds.
    least_gain : float
        A step is accepted if it gains this share of what the gradient predicts
        (Armijo).
    """

    fixed_point_steps: int = 8
    same_basin: float = 0.97
    n_finalists: int = 2
    many_samples: int = 3000
    first_samples: int = 1500
    turns: int = 10
    scale_steps: int = 5
    newton_steps: int = 100
    gradient_tol: float = 1e-11
    longest_step: float = 1.0
    smallest_shift: float = 1e-3
    largest_shift: float = 1e8
    shift_factor: float = 4.0
    least_gain: float = 1e-3


MIXING_OPTIONS = MixingOptions()


# Threads cost more than they give on matrices of this size.
def shared_mixing(
    signals: NDArray,
    *,
    n_starts: int = 8,
    random_state: int = 0,
    options: MixingOptions = MIXING_OPTIONS,
) -> NDArray[np.float64]:
    """
    Return the mixing, the same for all coordinates, that makes signals independent.

    The signals are whitened. From several orthogonal starts, a few steps of FastICA for
    vectors lead to basins of attraction. From the best of these the likelihood of
    independent spherical signals, ``sum_k E log p_k(||y_k||) + size * log |det W|``
    with ``y = W signals``, is maximised over all invertible W by Newton steps. Each
    density p_k is the likeliest of a few, with heavy or light tails.

    Parameters
    ----------
    signals : ndarray of shape (n_signals, n_samples, size)
        Each sample of a signal is a vector of `size` coordinates: basis shapes with
        three coordinates a point, or coefficients with one coordinate a frame. They
        are taken as centred: means are not removed.
    n_starts : int, default=8
        Number of orthogonal starts: a canonical one, and rotations of it.
    random_state : int, default=0
        Draws the rotations.
    options : MixingOptions
        How the mixing is searched for.

    Returns
    -------
    ndarray of shape (n_signals, n_signals)
        W, invertible: ``tensordot(W, signals, 1)`` are the independent signals, each
        with mean square 1 over its ``n_samples * size`` numbers. They are sorted by
        likelihood, the least Gaussian one first. The third moment of each, over all of
        its numbers, is not negative. Where the signals have a rank r below their
        number, only the first r rows give independent signals. The other rows give
        signals of zeros.

    Notes
    -----
    The independent signals do not depend on the order of the samples, on the basis in
    which the signals are given or on a rotation common to all samples, but for
    rounding, order and sign. Where two or more signals are Gaussian, or there are too
    few samples, a mixing is returned that has no further meaning.

    One Newton step takes ``O(n_signals^3 n_samples size + n_signals^6)`` operations.

    References
    ----------
    A. Hyvarinen, "Fast and robust fixed-point algorithms for independent component
    analysis", IEEE Trans. Neural Networks 10(3), 1999.
    P. Ablin, J.-F. Cardoso, A. Gramfort, "Faster independent component analysis by
    preconditioning with Hessian approximations", IEEE Trans. Signal Processing 66(15),
    2018: relative gradient and Hessian, here with vectors and without approximation.
    """
    signals = np.ascontiguousarray(signals, dtype=np.float64)
    n_signals, _, size = signals.shape
    whitening, null = _whitening(signals.reshape(n_signals, -1))
    if not len(whitening):
        return np.eye(n_signals)
    Z = np.tensordot(whitening, signals, 1)

    # Basins of attraction, and the likelihood's maximum in the likeliest of them.
    some = _some_samples(Z, options)
    starts = _starts(some, n_starts, random_state)
    ends = _fixed_point(starts, some, options.fixed_point_steps)
    basins = _distinct(ends, options.same_basin)
    if len(basins) > options.n_finalists:
        likely = [-_fit_densities(W, some, options).total for W in basins]
        basins = [basins[b] for b in np.argsort(likely)[: options.n_finalists]]
    optima = [_maximise(W, some, options) for W in basins]
    W, fit = max(optima, key=lambda optimum: optimum[1].total)
    if some is not Z:
        W, fit = _maximise(W, Z, options)

    # Scale, sign and order. Of all signals of unit mean square, Gaussian ones are the
    # least likely.
    Y = np.tensordot(W, Z, 1).reshape(len(W), -1)
    scale = np.sqrt(np.mean(Y**2, axis=1))
    order = np.argsort(-(fit.of_signals + size * np.log(scale)), kind="stable")
    W = (W * (orientations(Y) / scale)[:, None])[order]
    return np.vstack([W @ whitening, null])


def independent_coefficients(
    alpha: NDArray,
    *,
    n_starts: int = 8,
    random_state: int = 0,
    options: MixingOptions = MIXING_OPTIONS,
) -> NDArray[np.float64]:
    """
    Return the mixing that makes coefficients independent over the frames.

    Parameters
    ----------
    alpha : ndarray of shape (n_frames, n_components)
        Coefficients; their means do not matter.
    n_starts, random_state, options
        As for `shared_mixing`.

    Returns
    -------
    ndarray of shape (n_components, n_components)
        W, invertible: the columns of ``alpha @ W.T`` are independent, with unit
        variance over the frames. Order, sign and linear dependencies as for
        `shared_mixing`, with frames as samples of one coordinate.

    Notes
    -----
    With the basis ``tensordot(inv(W).T, basis, 1)`` the new coefficients give the same
    shapes.
    """
    centred = alpha - alpha.mean(axis=0)
    signals = centred.T[:, :, None]
    return shared_mixing(
        signals, n_starts=n_starts, random_state=random_state, options=options
    )


def _whitening(rows: NDArray) -> tuple[NDArray, NDArray]:
    """
    Return the mixings to uncorrelated rows of mean square 1 and to rows of zeros.

    Parameters
    ----------
    rows : ndarray of shape (n_rows, n)
        Any rows.

    Returns
    -------
    whitening : ndarray of shape (rank, n_rows)
        ``whitening @ rows`` are uncorrelated.
    null : ndarray of shape (n_rows - rank, n_rows)
        ``null @ rows`` vanishes up to rounding; orthogonal to `whitening`.
    """
    # The triangular factor keeps the precision that rows @ rows.T would lose.
    R = np.linalg.qr(rows.T, mode="r") / np.sqrt(rows.shape[1])
    U, S, _ = np.linalg.svd(R.T)
    rank = int(np.sum(S > OF_RANKS * S[0]))
    if rank == 0:
        return np.empty((0, len(rows))), np.eye(len(rows))
    return (U[:, :rank] / S[:rank]).T, U[:, rank:].T / S[0]


def _some_samples(Z: NDArray, options: MixingOptions) -> NDArray:
    """
    Return some of many samples, spread evenly from the smallest to the largest.

    Z is (n_signals, n_samples, size). Neither the order of the samples nor an
    orthogonal mixing of the signals changes which samples are taken.
    """
    if Z.shape[1] <= options.many_samples:
        return Z
    order = np.argsort(np.einsum("kjc,kjc->j", Z, Z), kind="stable")
    return np.ascontiguousarray(Z[:, spread(order, options.first_samples)])


def _starts(Z: NDArray, n_starts: int, random_state: int) -> NDArray:
    """
    Return orthogonal matrices (n_starts, n_signals, n_signals) to start from.

    ``W Z`` is the same for any orthogonal mixing of the white signals Z (n_signals,
    n_samples, size). The first W has the axes of a fourth-order moment (FOBI, Cardoso
    1989) with bounded weights. The others are random rotations of it, from a seed.
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

    rng = np.random.default_rng(random_state)
    turned = rng.standard_normal((n_starts - 1, n_signals, n_signals)) @ axes
    return np.concatenate([axes[None], orthogonalise(turned)])


def _fixed_point(W: NDArray, Z: NDArray, n_steps: int) -> NDArray:
    """
    Return the iterates after some steps of symmetric FastICA for vectors.

    A step is ``w+ = E[sum_c z_c y_c g(u)] - E[size g(u) + 2 u g'(u)] w`` with ``u =
    ||y||^2`` and ``g = F'``, followed by symmetric orthogonalisation. W is (n_starts,
    n_signals, n_signals), orthogonal, and Z (n_signals, n_samples, size), white.
    """
    n_signals, n_samples, size = Z.shape
    flat = Z.reshape(n_signals, -1)
    for _ in range(n_steps):
        Y = (W @ flat).reshape(*W.shape[:2], n_samples, size)
        u = np.einsum("skjc,skjc->skj", Y, Y)
        g, dg = _slopes(u, np.array(FIRST_TAIL), size)
        curvature = np.mean(size * g + 2.0 * u * dg, axis=-1)
        step = (g[..., None] * Y).reshape(*W.shape[:2], -1) @ flat.T / n_samples
        W = orthogonalise(step - curvature[..., None] * W)
    return W


def _distinct(W: NDArray, same_basin: float) -> list[NDArray]:
    """Return one orthogonal matrix of each basin, from W (n_starts, n, n)."""
    kept: list[NDArray] = []
    for candidate in W:
        cosines = [np.abs(candidate @ other.T).max(axis=1).min() for other in kept]
        if max(cosines, default=0.0) < same_basin:
            kept.append(candidate)
    return kept


def _log_density(u: NDArray, tail: NDArray, size: int) -> NDArray:
    """Return F(u), the logarithm of a density of `TAILS` up to a constant.

    u are squared norms (..., n_samples), `tail` is broadcast to them.
    """
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


class DensityFit(NamedTuple):
    """
    The likeliest density of each signal.

    Attributes
    ----------
    tails : ndarray of shape (n_signals,)
        Which of `TAILS`.
    variance : ndarray of shape (n_signals,)
        Squared scale: signal k divided by its scale has the density `tails` names.
    of_signals : ndarray of shape (n_signals,)
        ``E log p_k(||y_k||)`` of the signals y = W z.
    total : float
        The likelihood: their sum plus ``size * log |det W|``.
    """

    tails: NDArray
    variance: NDArray
    of_signals: NDArray
    total: float


def _fit_densities(
    W: NDArray, Z: NDArray, options: MixingOptions = MIXING_OPTIONS
) -> DensityFit:
    """Return the likeliest density and scale of each signal ``W z``.

    W is (n_signals, n_signals), Z is (n_signals, n_samples, size).
    """
    size = Z.shape[2]
    Y = np.tensordot(W, Z, 1)
    u = np.einsum("kjc,kjc->kj", Y, Y)
    log_variance = np.log(u.mean(axis=1) / size)
    variances, values = [], []
    for tail in TAILS:
        for _ in range(options.scale_steps):
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
    return DensityFit(
        np.array(TAILS)[best[0]], np.array(variances)[best], of_signals, total
    )


def _maximise(
    W: NDArray, Z: NDArray, options: MixingOptions
) -> tuple[NDArray, DensityFit]:
    """Return a local maximum of the likelihood near W, by alternating maximisation.

    The mixing and the densities take turns, until the densities stay the same.
    """
    fit = _fit_densities(W, Z, options)
    for _ in range(options.turns):
        W = _newton(W / np.sqrt(fit.variance)[:, None], Z, fit.tails, options)
        before, fit = fit, _fit_densities(W, Z, options)
        if np.array_equal(fit.tails, before.tails):
            break
    return W, fit


def _newton(
    W: NDArray, Z: NDArray, tails: NDArray, options: MixingOptions = MIXING_OPTIONS
) -> NDArray:
    """
    Maximise the likelihood over all mixings W for fixed densities `tails` (n_signals,).

    The Newton steps are relative, ``W <- exp(E) W``, so that long ones keep W
    invertible. Where the Hessian is not negative definite, or a step is too long or
    does not raise the likelihood enough, a multiple of the identity is subtracted from
    the Hessian (Levenberg-Marquardt).
    """
    size = Z.shape[2]
    tail = tails[:, None]

    def likelihood(W: NDArray) -> tuple[float, NDArray, NDArray]:
        Y = np.tensordot(W, Z, 1)
        u = np.einsum("kjc,kjc->kj", Y, Y)
        F = _log_density(u, tail, size).mean(axis=1).sum()
        return float(F + size * np.linalg.slogdet(W)[1]), Y, u

    value, Y, u = likelihood(W)
    shift = 0.0
    for _ in range(options.newton_steps):
        gradient, hessian = _relative_derivatives(Y, *_slopes(u, tail, size))
        if np.abs(gradient).max() < options.gradient_tol * size:
            break
        # Raise the shift until a step succeeds.
        while shift < options.largest_shift:
            E = _ascent(gradient, hessian, shift * size)
            if E is not None and np.abs(E).max() < options.longest_step:
                trial = expm(E) @ W
                raised, Y, u = likelihood(trial)
                least = options.least_gain * np.vdot(gradient, E)
                least -= OF_STEPS * abs(value)
                if raised - value > least:
                    break
            shift = max(options.shift_factor * shift, options.smallest_shift)
        else:
            break
        W, value = trial, raised
        eased = shift > options.smallest_shift
        shift = shift / options.shift_factor if eased else 0.0
    return W


def _relative_derivatives(
    Y: NDArray, g: NDArray, dg: NDArray
) -> tuple[NDArray, NDArray]:
    """
    Return the gradient G and the Hessian H of the likelihood in a relative step E.

    To second order ``W <- (I + E) W`` raises it by ``<G, E> + <E, H E> / 2``. With
    means over the samples written as E[],

        G_ka = 2 E[g_k y_k.y_a] + size delta_ka
        H_ka,kb = 2 E[g_k y_a.y_b] + 4 E[g'_k (y_k.y_a) (y_k.y_b)]

    and ``-size`` is added to ``H_ka,ak`` (Ablin, Cardoso and Gramfort 2018, here for
    vectors). G is (n, n), H (n, n, n, n) for n signals; Y is (n, n_samples, size), g
    and dg are (n, n_samples).
    """
    n_signals, n_samples, size = Y.shape
    Y = np.ascontiguousarray(Y.transpose(0, 2, 1))  # samples last: long rows are fast
    flat = Y.reshape(n_signals, -1)
    gradient = 2.0 / n_samples * (g[:, None] * Y).reshape(n_signals, -1) @ flat.T
    gradient += size * np.eye(n_signals)
    hessian = np.zeros((n_signals,) * 4)
    for k in range(n_signals):
        products = np.einsum("acj,cj->aj", Y, Y[k])
        weighted = (g[k] * Y).reshape(n_signals, -1)
        hessian[k, :, k] = 2.0 * weighted @ flat.T
        hessian[k, :, k] += 4.0 * (dg[k] * products) @ products.T
    hessian /= n_samples
    row, column = np.indices((n_signals, n_signals))
    hessian[row, column, column, row] -= size
    return gradient, hessian


def _ascent(gradient: NDArray, hessian: NDArray, shift: float) -> NDArray | None:
    """Return the step ``E = (shift I - H)^-1 G`` (n_signals, n_signals).

    None if the matrix is not positive definite.
    """
    matrix = shift * np.eye(gradient.size) - hessian.reshape(gradient.size, -1)
    try:
        factor = cho_factor(matrix)
    except np.linalg.LinAlgError:
        return None
    return cho_solve(factor, gradient.ravel()).reshape(gradient.shape)
