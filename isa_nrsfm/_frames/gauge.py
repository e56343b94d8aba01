"""The canonical choice among shapes and cameras that fit a table equally well.

An affinity of space (with calibrated cameras a rotation) and the order, scale and sign
of the basis shapes are free. Here they are fixed. The sign of depth is a convention:
images do not distinguish an object from its mirror image, but hidden points may
(`TableModel.mirror_certainty`).

A fit determines the shapes of the frames, up to one affinity of space and one scale a
frame. It does not determine their basis. Three replacements fit equally well. In the
independent basis they are fixed as well:

- B_0 by ``B_0 + sum_k u_k B_k``, fixed by coefficients with mean zero;
- B_k by ``B_k + v_k B_0``, which the scales of the cameras absorb, fixed by basis
  shapes without a part along the mean shape;
- any invertible mixing of the basis shapes, fixed by independence. This is the
  assumption of Brandt, Ackermann, Grasshof (2018), but with one mixing for all three
  coordinates.

`shared_mixing` finds it, by independent component analysis of vectors. A sample of a
signal is a vector of d coordinates. Independent subspace analysis mixes all dK
coordinates of K signals. Here the same K x K matrix mixes each coordinate: the freedom
that a fit leaves to its basis shapes, with points as samples and d = 3. With d = 1 it
is plain ICA, as for coefficients.
"""

from functools import cache
from operator import itemgetter

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import expm
from scipy.special import gammaln

from isa_nrsfm._frames.camera_models import (
    mean_view,
    pose_effect,
    pose_part,
    stacked_motion,
)
from isa_nrsfm._frames.models import FrameMap
from isa_nrsfm._linalg import OF_DIFFERENCES, OF_RANKS, OF_STEPS, orientations, polar
from isa_nrsfm._tables import spread
from isa_nrsfm.isa._strategies import orthogonalise


def canonical_rotation(mean_shape: NDArray, cameras: NDArray) -> NDArray:
    """Return the orthogonal A (3, 3) with which ``S A^T`` and ``M A^T`` are frontal.

    The x and y axes are the orthonormal pair nearest to the rows of the mean camera. If
    cameras (I, 2, 3) have no common view, the axes are the principal ones of ``sum_i
    M_i^T M_i``. The depth of the mean shape (J, 3) has non-negative skewness.
    """
    view = mean_view(cameras)
    if view is None:
        rows = cameras.reshape(-1, 3)
        axes = np.linalg.eigh(rows.T @ rows)[1][:, ::-1].T
        return axes * orientations(axes @ mean_shape.T)[:, None]
    across = polar(view)[0]
    axes = np.vstack([across, np.cross(*across)])
    axes[2] *= orientations(axes[2:] @ mean_shape.T)[0]
    return axes


def canonical_space(mean_shape: NDArray, motion: NDArray) -> NDArray:
    """Return the affinity A (3, 3) of space that makes the mean shape (J, 3) white.

    Shapes become ``B A^T`` and cameras (I, 2, 3) of frames of size one ``M A^-1``. The
    mean of ``b b^T`` over the points is the identity, with zeros along directions in
    which the shape is flat. The rotation is `canonical_rotation`.
    """
    variance, axes = np.linalg.eigh(mean_shape.T @ mean_shape / len(mean_shape))
    inside = variance > 1e-18 * variance[-1]
    # Directions in which the shape is flat get the scale of the widest direction.
    scale = 1.0 / np.sqrt(np.where(inside, variance, variance[-1] or 1.0))
    whitening = (axes * scale) @ axes.T
    white_motion = motion @ np.linalg.inv(whitening)
    return canonical_rotation(mean_shape @ whitening, white_motion) @ whitening


def euclidean_space(
    mean_shape: NDArray, motion: NDArray, size: float | None
) -> NDArray:
    """Return `canonical_rotation` times a size; None makes the shape's RMS one."""
    if size is None:
        size = 1.0 / (np.sqrt(np.mean(mean_shape**2)) or 1.0)
    return size * canonical_rotation(mean_shape, motion)


def canonical_gauge(
    mean_shape: NDArray,
    basis: NDArray,
    motion: NDArray,
    alpha: NDArray,
    space: NDArray,
    n_components: int | None = None,
) -> tuple[NDArray, NDArray, NDArray, NDArray]:
    """Return the canonical shapes among those that fit equally well, in a space (3, 3).

    The basis is sorted by decreasing energy in the images, ``sum_i ||alpha_ik M_i
    B_k||_F^2``, with cameras (I, 2, 3) of frames of size one. Coefficients (I, K) get
    unit variance (mean square where they do not vary) and non-negative skewness. A
    basis shape without motion becomes zero.

    Returns the mean shape (J, 3), the basis (K, J, 3), and for each basis shape its
    index in the given basis and its factor (K,), zero for those without motion.
    """
    energy = image_energies(motion, basis, alpha)
    # The leading n_components stay before the others.
    further = np.arange(len(energy)) >= (n_components or len(energy))
    order = np.lexsort((-energy, further))
    rigid = image_energies(motion, mean_shape[None], np.ones((len(motion), 1)))
    # Basis shapes with less energy are rounding errors.
    moving = energy > OF_RANKS**2 * rigid
    factors = np.where(moving, orientations(alpha.T) * coefficient_sizes(alpha), 0.0)
    scaled = factors[:, None, None] * basis
    return mean_shape @ space.T, scaled[order] @ space.T, order, factors[order]


def coefficient_sizes(alpha: NDArray) -> NDArray:
    """Return standard deviations (K,) of alpha (I, K), or RMS where they are zero."""
    deviation = alpha.std(axis=0)
    constant = deviation <= 1e-12 * np.abs(alpha).max(axis=0)
    return np.where(constant, np.sqrt(np.mean(alpha**2, axis=0)), deviation)


def image_energies(motion: NDArray, basis: NDArray, alpha: NDArray) -> NDArray:
    """Return ``sum_i ||alpha_ik M_i B_k||^2`` (K,) of basis shapes (K, J, 3)."""
    weighted = np.tensordot(alpha**2, motion.mT @ motion, axes=(0, 0))
    return np.einsum("kab,kab->k", weighted, basis.mT @ basis)


def mode_covariance(motion: NDArray, alpha: NDArray) -> NDArray:
    """Return the mode covariance matrix of cameras (I, 2, 3) and coefficients (I, K).

    ``(1 / 2I) sum_i (alpha_i alpha_i^T) (x) (M_i^T M_i)``, of shape (3K, 3K), is the
    covariance over the images of Brandt et al. (2018), section 3.3.
    """
    total = np.zeros((3 * alpha.shape[1],) * 2)
    for start in range(0, len(alpha), 4096):  # blocks limit memory
        part = slice(start, start + 4096)
        blocks = stacked_motion(motion[part], alpha[part])[:, 3:]
        total += blocks.T @ blocks
    return total / (2 * len(alpha))


def independent_gauge(
    shapes: NDArray,
    motion: NDArray,
    alpha: NDArray,
    independence: str | None,
    camera: str = "affine",
    unit: float | None = None,
    n_components: int | None = None,
    remove_pose: bool = False,
) -> tuple[NDArray, NDArray, FrameMap]:
    """Return mean shape and independent basis of a fit, and the map of frames to it.

    Shapes (K + 1, 3, J) are centred. Cameras (I, 2, 3) belong to frames of size one.
    "shapes" makes basis shapes independent over the points, "coefficients" makes
    coefficients independent over the frames. None takes the principal axes. These are
    the mixings of the leading n_components principal axes; further ones follow as they
    are. `unit` is the size in `euclidean_space`. `remove_pose`: the axes are those of
    what calibrated cameras do not predict of the coefficients.
    """
    # The shifts u and v, then the affinity of space.
    shift, motion, alpha = _centred(shapes, motion, alpha, camera)
    shapes = np.tensordot(shift, shapes, 1)
    space = canonical_space(shapes[0].T, motion)
    white = shapes[1:].mT @ space.T
    if camera != "affine":
        space = euclidean_space(shapes[0].T, motion, unit)
    if remove_pose:
        cameras = motion @ np.linalg.inv(space)
        alpha = alpha - pose_part(cameras, pose_effect(cameras, alpha))
    # The mixing of the basis shapes, then their order, scale and signs.
    mixing = np.eye(len(white))
    K = len(white) if n_components is None else n_components
    if independence is None or K < len(white):
        # With calibrated cameras in true proportions: whitened, depths of flat objects
        # would count many times.
        mixing = _principal_axes(shapes[1:].mT @ space.T, alpha)
        white = np.tensordot(mixing, white, 1)
    if independence == "shapes":
        mixing[:K] = shared_mixing(white[:K]) @ mixing[:K]
    elif independence == "coefficients":
        inverse = independent_coefficients((alpha @ np.linalg.inv(mixing))[:, :K])
        mixing[:K] = np.linalg.inv(inverse).T @ mixing[:K]
    basis = np.tensordot(mixing, shapes[1:], 1).mT
    unmixing = np.linalg.inv(mixing).T
    mean_shape, basis, order, factors = canonical_gauge(
        shapes[0].T, basis, motion, alpha @ unmixing.T, space, K
    )
    # Coefficients (1, alpha_i) change by the inverse transpose of the mixing of shapes.
    scale = np.divide(1.0, factors, where=factors != 0, out=np.zeros_like(factors))
    coefficients = np.linalg.inv(shift).T
    coefficients[1:] = scale[:, None] * (unmixing @ coefficients[1:])[order]
    return mean_shape, basis, FrameMap(coefficients, space)


def _centred(
    shapes: NDArray, motion: NDArray, alpha: NDArray, camera: str
) -> tuple[NDArray, NDArray, NDArray]:
    """Return the shifts u and v as a matrix (n, n), the new cameras and coefficients.

    ``B_0 + sum_k u_k B_k`` gives the coefficients mean zero. ``B_k + v_k B_0`` makes
    the basis shapes orthogonal to the mean shape: ``<T B_k, T B_0> = 0`` where T
    whitens B_0, that is ``tr(B_k B_0^+) = 0``. With weak-perspective cameras it is
    ``<B_k, B_0> = 0``. Each shift slightly undoes the other, so they alternate.

    Then ``1 - sum_k v_k alpha_ik`` is the factor of the scale of frame i. v is zero if
    any such factor is not positive or too small, or if the alternation does not
    converge. It is zero for orthographic cameras, whose scale is fixed.
    """
    rank = max(np.linalg.matrix_rank(shapes[0], rtol=OF_RANKS), 1)
    first = total = _mean_shift(alpha)
    moved, scale = alpha - first[0, 1:], np.ones(len(alpha))
    for _ in range(0 if camera == "orthographic" else 200):
        # v, from the current shapes: <B_k, dual> is the part of B_k along B_0.
        current = np.tensordot(total, shapes, 1)
        if camera == "affine":
            dual = np.linalg.pinv(current[0], rcond=OF_RANKS).T / rank
        else:
            dual = current[0] / (np.vdot(current[0], current[0]) or 1.0)
        along = np.eye(len(shapes))
        along[1:, 0] = -np.einsum("kcj,cj->k", current[1:], dual)
        # Scales of the frames absorb it, and coefficients follow.
        factor = 1 - moved @ along[1:, 0]
        if not (factor > 0).all():
            break
        scale = scale * factor
        moved = moved / factor[:, None]
        # u, from the new coefficients.
        mean = _mean_shift(moved)
        moved = moved - mean[0, 1:]
        total = mean @ along @ total
        change = np.abs(mean[0, 1:]) + np.abs(along[1:, 0])
        rounding = OF_DIFFERENCES * max(1.0, np.abs(moved).max())
        if np.max(change, initial=0.0) <= rounding:
            if scale.min() < 0.1 * scale.mean():
                break
            return total, motion * scale[:, None, None], moved
    return first, motion, alpha - first[0, 1:]


def _mean_shift(alpha: NDArray) -> NDArray:
    """Return the mixing (n, n) that adds the mean of alpha (n_frames, n - 1) to B_0."""
    mixing = np.eye(alpha.shape[1] + 1)
    mixing[0, 1:] = alpha.mean(axis=0)
    return mixing


def _principal_axes(basis: NDArray, alpha: NDArray) -> NDArray:
    """Return the mixing (K, K) to uncorrelated coefficients and orthogonal shapes."""
    variance, axes = np.linalg.eigh(alpha.T @ alpha / len(alpha))
    # Constant ones are as large as the others: any other size may be beyond rounding.
    variance[variance <= OF_RANKS**2 * variance[-1]] = max(variance[-1], 0.0) or 1.0
    root = (axes * np.sqrt(variance)) @ axes.T
    flat = root @ basis.reshape(len(basis), -1)
    directions: NDArray = np.linalg.eigh(flat @ flat.T)[1]
    return directions[:, ::-1].T @ root


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
    part = _few_samples(Z)
    ends = _fixed_point(_starts(part, n_starts), part, 8)
    W = max(zip(_fit_densities(ends, part)[0], ends, strict=True), key=itemgetter(0))[1]
    # The maximum of the likelihood, for many samples first that of a part of them
    for samples in [part] if part is Z else [part, Z]:
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


@cache
def _log_integral(tail: float, size: int) -> float:
    """Return the logarithm of the integral of ``exp F(||y||^2)`` over all vectors y."""
    # In the logarithm of the radius the trapezoidal rule is accurate to rounding.
    log_radius = np.linspace(-40.0, 8.0, 1001)
    F = _log_density(np.exp(2.0 * log_radius), np.array(tail), size)
    radial = np.exp(F + size * log_radius).sum() * (log_radius[1] - log_radius[0])
    sphere = np.log(2.0) + size / 2 * np.log(np.pi) - gammaln(size / 2)
    return float(sphere + np.log(radial))


def _fit_densities(W: NDArray, Z: NDArray) -> tuple[NDArray, ...]:
    """Return the likelihood of the signals ``y = W z`` with their likeliest densities.

    Also returns for each signal its density, one of `TAILS`, its squared scale, and ``E
    log p_k(||y_k||)``. The likelihood adds ``size * log |det W|`` to the sum of these.
    W (..., n, n) may be a stack of mixings.
    """
    size = Z.shape[2]
    products = [np.tensordot(mixing, Z, 1) for mixing in W.reshape(-1, *W.shape[-2:])]
    u = np.array([np.einsum("kjc,kjc->kj", Y, Y) for Y in products])
    u = u.reshape(*W.shape[:-1], -1)
    log_variance = np.log(u.mean(axis=-1) / size)
    variances, values = [], []
    for tail in TAILS:
        for _ in range(5):
            v = u * np.exp(-log_variance)[..., None]
            g, dg = _slopes(v, np.array(tail), size)
            # Newton step for the scale. The likelihood is largest where
            # E[-2 g(v) v] = size, with v = u / variance.
            excess = -2.0 * np.mean(g * v, axis=-1) - size
            slope = 2.0 * np.mean((g + dg * v) * v, axis=-1)
            log_variance = log_variance - np.clip(excess / slope, -1.0, 1.0)
        v = u * np.exp(-log_variance)[..., None]
        F = _log_density(v, np.array(tail), size).mean(axis=-1)
        variances.append(np.exp(log_variance))
        values.append(F - _log_integral(tail, size) - size / 2 * log_variance)
    best = np.argmax(values, axis=0)
    of_signals = np.choose(best, values)
    total = of_signals.sum(axis=-1) + size * np.linalg.slogdet(W)[1]
    return total, np.array(TAILS)[best], np.choose(best, variances), of_signals


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
    direction, limit = np.zeros_like(gradient), SOLVED**2 * np.vdot(gradient, gradient)
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
        if np.vdot(residual, residual) <= limit:
            break
    return E
