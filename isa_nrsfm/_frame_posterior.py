"""Camera, position and coefficients of single frames for given shapes and noise.

For each frame by itself, with weights ``w_ij`` (zero for missing points), shapes ``S(a)
= B_0 + sum_k a_k B_k`` and noise variance s2 this minimises

    f(M, t, a) = sum_j w_ij || m_ij - M S_j(a) - t ||^2 + s2 |a|^2 + tr(M C M^T),

``2 s2`` times minus the log posterior of coefficients with the prior N(0, I) and of a
camera with the precision C. Position and camera are eliminated: with ``A = S S^T + C``
and ``Y = W S^T`` (points and shapes centred over the points that the frame sees) the
camera is ``M = Y A^-1`` and

    f(a) = ||W||^2 - <M, Y> + s2 |a|^2.

With ``P_k = W B_k^T`` and ``H_kl = <M B_k, M B_l>`` half its gradient is ``s2 a_k +
sum_l H_kl c_l - <P_k, M>``, c = (1, a), and half its Hessian is the Schur complement

    H_kl + s2 d_kl - <F_k A^-1, F_l>,  F_k = M (B_k S^T + S B_k^T) - P_k.

The first step from a start is that of alternation, with ``H + s2 I`` alone, the others
are Newton steps. Where the Schur complement is not positive definite, or a step would
raise f, a multiple of ``H + s2 I`` is added: f never rises, up to rounding.
"""

from collections.abc import Iterator
from typing import NamedTuple, Self

import numpy as np
from numpy.typing import NDArray

from isa_nrsfm._frame_products import (
    FrameGram,
    FrameProducts,
    FrameTracks,
    SharedGram,
    determines_camera,
    frame_products,
    frame_tracks,
    whitened,
)
from isa_nrsfm._small_matrices import (
    COLUMNS,
    ROWS,
    SMALLEST_PIVOT,
    diagonal_of,
    inverse_factor3,
    invert_positive,
    packed_gram,
    solve_positive,
    unpacked,
)

# Frames in a block: enough to be worth the calls, few enough for the cache. Frames
# with missing points have a Gram matrix each.
COMPLETE_BLOCK = 2048
WEIGHTED_BLOCK = 512
# Prior precision of cameras, as a share of the second moment of the shapes, and of
# coefficients, as a share of the energy of the frame: they keep the result finite for
# degenerate shapes and are too small to matter to others.
RIDGE = 1e-13
# A frame has converged when a Newton step gains less than this share of its energy;
# the next one would gain about the square.
TOLERANCE = 1e-12
# f may rise by this share of the energy: rounding errors.
ROUNDING = 1e-14
MAX_STEPS = 60
# Steps after which the frames that have not converged are brought together.
FIRST_STEPS = 5
# Objectives that differ by less than this share of them are equal.
EQUAL = 1e-10
# Below the one a step is not damped any more; with the other it does not move.
SMALLEST_DAMPING = 0.05
LARGEST_DAMPING = 1e8
# An objective so many times what the noise explains may be a minimum too high.
SUSPICIOUS = 3.0


class FramePosterior(NamedTuple):
    """
    Fits of frames; NaN for frames whose points do not determine a camera.

    Attributes
    ----------
    motion : ndarray of shape (n_frames, 2, 3)
        Cameras, in the units of the tracks per unit of the shapes.
    translation : ndarray of shape (n_frames, 2)
        Image of the origin of the shapes.
    alpha : ndarray of shape (n_frames, n_components)
        Coefficients.
    covariance : ndarray of shape (n_frames, n_components, n_components)
        Posterior covariance of alpha in the normal approximation at the optimum
        (Laplace), with the uncertainty of camera and position: noise variance times
        the inverse of the Schur complement.
    objective : ndarray of shape (n_frames,)
        f at the optimum, in squared units of the tracks, to 1e-12 of the energy of the
        frame (of its centred tracks).
    residual : ndarray of shape (n_frames,)
        ``sum_j w_ij ||m_ij - M S_j - t||^2``, as precise as that.
    converged : ndarray of bool, shape (n_frames,)
        Whether the search ended in a minimum, by a Newton step too small to matter.
    start : ndarray of int, shape (n_frames,)
        Which of the extra starts led there, -1 for the start from zero. Starts that
        lead nowhere on many frames are not needed for others like them.
    """

    motion: NDArray
    translation: NDArray
    alpha: NDArray
    covariance: NDArray
    objective: NDArray
    residual: NDArray
    converged: NDArray
    start: NDArray


def fit_posterior(
    tracks: NDArray,
    shapes: NDArray,
    noise_variance: NDArray | float,
    *,
    weights: NDArray | None = None,
    initial: NDArray | None = None,
    starts: NDArray | None = None,
    camera_precision: NDArray | None = None,
) -> FramePosterior:
    """
    Return the most probable camera, position and coefficients of each frame.

    Parameters
    ----------
    tracks : ndarray of shape (n_frames, n_points, 2)
        Tracks, in any place; NaN where a point is missing.
    shapes : ndarray of shape (n_components + 1, 3, n_points)
        Mean shape and basis shapes, rows centred, scaled such that alpha ~ N(0, I).
    noise_variance : float or ndarray of shape (n_frames,)
        Variance of a coordinate, in squared units of the tracks. At least 1e-13 of the
        energy of a frame is taken.
    weights : ndarray of shape (n_frames, n_points), optional
        Not negative, zero for missing points; by default 1 for all that are not NaN.
    initial : ndarray of shape (n_frames, n_components), optional
        Coefficients to start from, by default zeros.
    starts : ndarray of shape (n_starts, n_components), optional
        Coefficients to start from besides these, `spread_starts` for instance, for
        frames whose first fit is much worse than the noise explains.
    camera_precision : ndarray of shape (3, 3), optional
        C, symmetric and positive semidefinite, in squared units of the shapes.

    Returns
    -------
    FramePosterior
        The best fit of each frame. It does not depend on the other frames beyond
        rounding errors. Cameras are zero across shapes that are all flat. If only the
        mean shape is, zero can be a saddle point of f: where the search goes from there
        is up to rounding, and a start helps. Frames whose points, those of positive
        weight, leave the mean shape flat along a direction in which it is not (always
        fewer than four points of a solid) do not determine a camera and have NaN.
    """
    tracks = np.asarray(tracks)
    missing = np.isnan(tracks[..., 0]) | np.isnan(tracks[..., 1])
    seen = np.where(missing, 0.0, 1.0 if weights is None else weights)
    return _best_fits(
        _Tracks(tracks, seen),
        shapes,
        noise_variance,
        initial=initial,
        starts=starts,
        camera_precision=camera_precision,
    )


def fit_prepared(
    frames: FrameTracks,
    shapes: NDArray,
    noise_variance: NDArray | float,
    *,
    initial: NDArray | None = None,
    starts: NDArray | None = None,
) -> FramePosterior:
    """
    Return the fits of `fit_posterior` for frames that are ready for products.

    Parameters
    ----------
    frames : FrameTracks
        The frames. They may be given in other coordinates than points: what counts is
        their inner products with the shapes.
    shapes : ndarray of shape (n_components + 1, 3, n_points)
        Mean shape and basis shapes in these coordinates; centred if they are points.
    noise_variance, initial, starts
        As of `fit_posterior`.

    Returns
    -------
    FramePosterior
        The best fit of each frame.
    """
    return _best_fits(
        _Prepared(frames),
        shapes,
        noise_variance,
        initial=initial,
        starts=starts,
    )


def approximate_cameras(
    frames: FrameTracks, shapes: NDArray, noise_variance: float
) -> NDArray:
    """
    Return cameras close to those of `fit_prepared`, by two steps from zero.

    Parameters
    ----------
    frames, shapes, noise_variance
        As of `fit_prepared`; all frames determine a camera.

    Returns
    -------
    ndarray of shape (n_frames, 2, 3)
        Cameras.
    """
    white, space = whitened(np.ascontiguousarray(shapes))
    prepared = _Prepared(frames)
    motion = np.empty((len(frames.weight), 2, 3))
    for block, products in prepared.blocks(white):
        variance = np.full(len(block), noise_variance)
        problem = _problem(products, variance, np.zeros((3, 3)), prepared.n_points)
        state = _evaluate(problem, np.zeros((len(shapes) - 1, len(block))))
        alpha, _ = solve_positive(state.known, state.slope)
        step, _ = _newton_step(_evaluate(problem, alpha), np.zeros(len(block)))
        camera = _eliminated(problem, _with_one(alpha + step))[-1]
        motion[block] = camera.transpose(2, 1, 0)
    return motion @ space


class _Tracks(NamedTuple):
    """Frames that are given by their tracks."""

    tracks: NDArray  # (n_frames, n_points, 2)
    weights: NDArray  # (n_frames, n_points)

    @property
    def n_points(self) -> float:
        """Number of points of a frame."""
        return self.weights.shape[1]

    @property
    def weight(self) -> NDArray:
        """Sum of the weights of each frame."""
        return self.weights.sum(axis=1)

    def take(self, frames: NDArray) -> Self:
        """Return some of the frames."""
        return type(self)(self.tracks[frames], self.weights[frames])

    def blocks(self, shapes: NDArray) -> Iterator[tuple[NDArray, FrameProducts]]:
        """Yield blocks of the frames that determine a camera, and their products."""
        tracks, weights = self
        complete = (weights == 1.0).all(axis=1)
        frames = np.flatnonzero(complete)
        for first in range(0, len(frames), COMPLETE_BLOCK):
            block = frames[first : first + COMPLETE_BLOCK]
            yield block, frame_products(frame_tracks(tracks[block]), shapes)
        frames = np.flatnonzero(~complete)
        for first in range(0, len(frames), WEIGHTED_BLOCK):
            block = frames[first : first + WEIGHTED_BLOCK]
            part = frame_tracks(tracks[block], weights[block])
            yield _determined(block, frame_products(part, shapes), shapes)


class _Prepared(NamedTuple):
    """Frames that are ready for products."""

    frames: FrameTracks

    @property
    def n_points(self) -> float:
        """Number of points of a frame, also where it is given in other coordinates."""
        if self.frames.weights is None:
            return self.frames.weight[0]
        return len(self.frames.weights)

    @property
    def weight(self) -> NDArray:
        """Sum of the weights of each frame."""
        return self.frames.weight

    def take(self, frames: NDArray) -> Self:
        """Return some of the frames."""
        return type(self)(self.frames.take(frames))

    def blocks(self, shapes: NDArray) -> Iterator[tuple[NDArray, FrameProducts]]:
        """Yield blocks of the frames that determine a camera, and their products."""
        complete = self.frames.weights is None
        length = COMPLETE_BLOCK if complete else WEIGHTED_BLOCK
        for first in range(0, len(self.weight), length):
            block = np.arange(first, min(first + length, len(self.weight)))
            part = self.frames.take(slice(first, first + length))
            products = frame_products(part, shapes)
            yield (
                (block, products) if complete else _determined(block, products, shapes)
            )


def _determined(
    frames: NDArray, products: FrameProducts, shapes: NDArray
) -> tuple[NDArray, FrameProducts]:
    """Return those of some frames that determine a camera, and their products."""
    usable = np.flatnonzero(determines_camera(products, shapes[0]))
    return frames[usable], products.take(usable)


def _best_fits(
    frames: _Tracks | _Prepared,
    shapes: NDArray,
    noise_variance: NDArray | float,
    *,
    initial: NDArray | None,
    starts: NDArray | None,
    camera_precision: NDArray | None = None,
) -> FramePosterior:
    """Return the best fits of `fit_posterior`."""
    weight, n_components = frames.weight, len(shapes) - 1
    n_frames = len(weight)
    variance = np.broadcast_to(np.asarray(noise_variance, dtype=float), (n_frames,))
    first = np.zeros((n_frames, n_components)) if initial is None else initial
    extra = np.zeros((0, n_components)) if starts is None else np.asarray(starts)
    white, space = whitened(np.ascontiguousarray(shapes))
    prior = np.zeros((3, 3))
    if camera_precision is not None:
        prior = space @ camera_precision @ space.T

    def fit(chosen: NDArray | None, initial: NDArray, max_steps: int) -> FramePosterior:
        if chosen is None:
            return _fit(frames, variance, initial, white, prior, max_steps)
        part = frames.take(chosen), variance[chosen], initial
        return _fit(*part, white, prior, max_steps)

    fits = fit(None, first, FIRST_STEPS)
    # The few frames that take longer are brought together: short rows are slow.
    slow = np.flatnonzero(~fits.converged & np.isfinite(fits.objective))
    if len(slow):
        _put(fits, slow, fit(slow, fits.alpha[slow], MAX_STEPS))
    poor = np.flatnonzero(_poorly_explained(fits, weight, variance))
    if len(extra) and len(poor):
        number = np.repeat(np.arange(len(extra)), len(poor))
        others = fit(np.tile(poor, len(extra)), extra[number], MAX_STEPS)
        others = others._replace(start=number)
        # Of equal minima the first one is kept.
        objective = others.objective.reshape(len(extra), -1)
        best = np.argmax(objective <= (1 + EQUAL) * objective.min(axis=0), axis=0)
        best = best * len(poor) + np.arange(len(poor))
        gain = fits.objective[poor] - others.objective[best]
        better = gain > EQUAL * fits.objective[poor]
        _put(fits, poor[better], _take(others, best[better]))
    return fits._replace(motion=fits.motion @ space)


def _fit(
    frames: _Tracks | _Prepared,
    variance: NDArray,
    initial: NDArray,
    shapes: NDArray,
    prior: NDArray,
    max_steps: int,
) -> FramePosterior:
    """Return the minima that frames reach from given coefficients, in white space."""
    n_frames, n_components = initial.shape
    fits = FramePosterior(
        motion=np.full((n_frames, 2, 3), np.nan),
        translation=np.full((n_frames, 2), np.nan),
        alpha=np.full((n_frames, n_components), np.nan),
        covariance=np.full((n_frames, n_components, n_components), np.nan),
        objective=np.full(n_frames, np.nan),
        residual=np.full(n_frames, np.nan),
        converged=np.zeros(n_frames, dtype=bool),
        start=np.full(n_frames, -1),
    )
    for block, products in frames.blocks(shapes):
        problem = _problem(products, variance[block], prior, frames.n_points)
        first = np.ascontiguousarray(initial[block].T)
        alpha, converged = _descend(problem, first, max_steps)
        _write(fits, block, products, problem, alpha, converged, prior)
    return fits


def _take(fits: FramePosterior, frames: NDArray) -> FramePosterior:
    """Return the fits of some of the frames."""
    return FramePosterior(*(each[frames] for each in fits))


def _put(fits: FramePosterior, frames: NDArray, others: FramePosterior) -> None:
    """Set the fits of some of the frames."""
    for each, other in zip(fits, others, strict=True):
        each[frames] = other


def spread_starts(alpha: NDArray, n_starts: int) -> NDArray:
    """
    Return coefficients that are far from zero and from each other.

    Parameters
    ----------
    alpha : ndarray of shape (n_frames, n_components)
        Coefficients of many frames; rows with NaN are left out.
    n_starts : int
        How many are wanted.

    Returns
    -------
    ndarray of shape (n_starts, n_components)
        Rows of alpha, fewer if there are not as many different ones, each the one
        farthest from zero and from those before it.
    """
    alpha = alpha[np.isfinite(alpha).all(axis=1)]
    distance = np.einsum("ik,ik->i", alpha, alpha)
    chosen: list[int] = []
    while len(chosen) < n_starts and distance.max(initial=0.0) > 0:
        chosen.append(int(np.argmax(distance)))
        difference = alpha - alpha[chosen[-1]]
        nearest = np.einsum("ik,ik->i", difference, difference)
        distance = np.minimum(distance, nearest)
    return alpha[chosen]


class _Problem(NamedTuple):
    """What the search for n frames needs, shapes in white space."""

    cross: NDArray  # P (n_shapes, 3, 2, n)
    gram: SharedGram | FrameGram
    energy: NDArray  # ||W||^2 (n,)
    ridge: NDArray  # s2, not zero (n,)
    precision: NDArray  # C, packed, not singular (6, n)

    def take(self, frames: NDArray) -> Self:
        """Return the problem of some of the frames."""
        return type(self)(
            self.cross[..., frames],
            self.gram.take(frames),
            self.energy[frames],
            self.ridge[frames],
            self.precision[:, frames],
        )


def _problem(
    products: FrameProducts, variance: NDArray, prior: NDArray, n_points: float
) -> _Problem:
    """Return the problem with its ridges, each relative to the frame."""
    energy, weight = products.energy, products.weight
    ridge = np.maximum(variance, RIDGE * energy)
    # Where all points of a frame are equal any ridge will do: alpha is zero.
    ridge = np.where(ridge > 0, ridge, 1.0)
    precision = np.repeat(prior[ROWS, COLUMNS][:, None], len(ridge), axis=1)
    precision[:3] += RIDGE * weight / n_points
    return _Problem(products.cross, products.gram, energy, ridge, precision)


class _State(NamedTuple):
    """The objective at some coefficients of n frames, and its derivatives."""

    alpha: NDArray  # (K, n)
    camera: NDArray  # M^T (3, 2, n)
    explained: NDArray  # ||W||^2 - f (n,)
    slope: NDArray  # minus half the gradient (K, n)
    known: NDArray  # H + s2 I, half the Hessian if the camera is known, packed
    schur: NDArray  # half the Hessian, packed

    def take(self, frames: NDArray) -> Self:
        """Return the state of some of the frames."""
        return type(self)(*(each[..., frames] for each in self))

    def put(self, frames: NDArray, other: Self) -> None:
        """Set the state of some of the frames."""
        for each, given in zip(self, other, strict=True):
            each[..., frames] = given


def _write(
    fits: FramePosterior,
    frames: NDArray,
    products: FrameProducts,
    problem: _Problem,
    alpha: NDArray,
    converged: NDArray,
    prior: NDArray,
) -> None:
    """Write what follows from the coefficients of some frames to the fits."""
    state = _evaluate(problem, alpha)
    camera = state.camera
    origin = np.einsum("kai,ki->ai", products.shape_centroid, _with_one(alpha))
    fits.motion[frames] = camera.transpose(2, 1, 0)
    fits.translation[frames] = (
        products.centroid - np.einsum("ari,ai->ri", camera, origin)
    ).T
    fits.alpha[frames] = alpha.T
    covariance = unpacked(problem.ridge * _inverse_schur(state))
    fits.covariance[frames] = covariance.transpose(2, 0, 1)
    objective = np.maximum(products.energy - state.explained, 0.0)
    priors = problem.ridge * np.einsum("ki,ki->i", alpha, alpha)
    priors += np.einsum("ab,ari,bri->i", prior, camera, camera)
    fits.objective[frames] = objective
    fits.residual[frames] = np.maximum(objective - priors, 0.0)
    fits.converged[frames] = converged


def _poorly_explained(
    fits: FramePosterior, weight: NDArray, variance: NDArray
) -> NDArray:
    """
    Return whether objectives are much larger than the noise explains.

    Minimised over alpha, f / s2 is the squared Mahalanobis distance of a frame from the
    model. With the true camera and shape it is chi-squared with two degrees of freedom
    a point, less the eight of camera and position.
    """
    freedom = np.maximum(2.0 * weight - 8.0, 1.0)
    return fits.objective > SUSPICIOUS * variance * freedom


def _with_one(alpha: NDArray) -> NDArray:
    """Return ``c = (1, alpha)``."""
    return np.concatenate([np.ones((1, alpha.shape[1])), alpha])


def _eliminated(
    problem: _Problem, c: NDArray
) -> tuple[NDArray, NDArray, NDArray, NDArray]:
    """
    Return what follows from c when the camera is eliminated.

    That is ``B_k S^T + S B_k^T``, the inverse factor R of ``A = (R^T R)^-1``, ``R Y^T``
    and the camera ``M^T = A^-1 Y^T``.
    """
    T = problem.gram.products(c)
    A = 0.5 * np.einsum("ki,kabi->abi", c, T)[ROWS, COLUMNS] + problem.precision
    R = inverse_factor3(A)
    Y = np.einsum("ki,kari->ari", c, problem.cross)
    half = np.einsum("abi,bri->ari", R, Y)
    return T, R, half, np.einsum("bai,bri->ari", R, half)


def _evaluate(problem: _Problem, alpha: NDArray) -> _State:
    """Return the objective and its derivatives, as in the head of this module."""
    P, ridge = problem.cross, problem.ridge
    c = _with_one(alpha)
    T, R, half, camera = _eliminated(problem, c)
    explained = np.einsum("ari,ari->i", half, half)
    explained -= ridge * np.einsum("ki,ki->i", alpha, alpha)

    images = np.einsum("cri,cri->ci", camera[ROWS, :], camera[COLUMNS, :])
    known = problem.gram.energies(images)[len(c) :]
    known[diagonal_of(known)] += ridge
    F = np.einsum("kabi,bri->kari", T[1:], camera)
    F -= P[1:]
    slope = 0.5 * np.einsum("kari,ari->ki", P[1:] - F, camera) - ridge * alpha
    F = np.einsum("abi,kbri->kari", R, F).reshape(len(alpha), 6, len(ridge))
    return _State(alpha, camera, explained, slope, known, known - packed_gram(F))


def _descend(
    problem: _Problem, alpha: NDArray, max_steps: int
) -> tuple[NDArray, NDArray]:
    """Return the minima reached from alpha (K, n), and whether they are reached."""
    found, converged = alpha.copy(), np.zeros(alpha.shape[1], dtype=bool)
    running, damping = np.arange(alpha.shape[1]), np.zeros(alpha.shape[1])
    state = _evaluate(problem, alpha)
    step, _ = solve_positive(state.known, state.slope)
    for _ in range(max_steps):
        energy = problem.energy
        trial = _evaluate(problem, state.alpha + step)
        worse = np.flatnonzero(trial.explained < state.explained - ROUNDING * energy)
        if len(worse):
            trial.put(worse, state.take(worse))
        state = trial
        eased = np.where(damping > SMALLEST_DAMPING, damping / 8.0, 0.0)
        eased[worse] = np.maximum(4.0 * damping[worse], 0.5)

        step, damping = _newton_step(state, eased)
        gain = np.einsum("ki,ki->i", state.slope, step)
        small = (damping == 0) & (gain <= TOLERANCE * energy)
        stuck = damping >= LARGEST_DAMPING
        leaving = small | stuck
        if not leaving.any():
            continue
        step[:, stuck] = 0.0
        done = running[leaving]
        found[:, done] = (state.alpha + step)[:, leaving]
        converged[done] = small[leaving]
        left = np.flatnonzero(~leaving)
        if not len(left):
            return found, converged
        running, damping, step = running[left], damping[left], step[:, left]
        problem, state = problem.take(left), state.take(left)
    found[:, running] = state.alpha
    return found, converged


def _newton_step(state: _State, damping: NDArray) -> tuple[NDArray, NDArray]:
    """Return damped Newton steps, and the damping, raised where it has to be."""
    matrix = state.schur
    if damping.any():
        matrix = matrix + damping * state.known
    step, positive = solve_positive(matrix, state.slope)
    failing = np.flatnonzero(~positive)
    if len(failing):
        damping[failing] = np.maximum(damping[failing], SMALLEST_DAMPING)
        step[:, failing] = _step_off_saddle(state.take(failing), damping[failing])
    return step, damping


def _step_off_saddle(state: _State, damping: NDArray) -> NDArray:
    """
    Return steps for frames whose Hessian is not positive definite.

    In coordinates where ``H + s2 I`` is the identity the gradient is divided by the
    magnitudes of the curvatures, and the damping: downhill along each axis (the
    saddle-free Newton method of Dauphin et al., "Identifying and attacking the saddle
    point problem in high-dimensional non-convex optimization", 2014).
    """
    known, schur = (
        unpacked(each).transpose(2, 0, 1) for each in (state.known, state.schur)
    )
    size, axes = np.linalg.eigh(known)
    size = np.maximum(size, SMALLEST_PIVOT * size[:, -1:])
    whitening = axes / np.sqrt(size)[:, None]
    curvature, modes = np.linalg.eigh(whitening.swapaxes(1, 2) @ schur @ whitening)
    axes = whitening @ modes
    along = np.einsum("nab,an->nb", axes, state.slope)
    along /= np.abs(curvature) + damping[:, None]
    return np.einsum("nab,nb->an", axes, along)


def _inverse_schur(state: _State) -> NDArray:
    """
    Return the inverse of the Schur complement, packed.

    Where it is not positive definite, which it is wherever a frame determines its
    minimum, as much of ``H + s2 I`` is added as makes it so.
    """
    inverse, _, positive = invert_positive(state.schur)
    failing = np.flatnonzero(~positive)
    damping = 1.0
    while len(failing) and damping < LARGEST_DAMPING:
        part = state.take(failing)
        matrix = part.schur + damping * part.known
        inverse[..., failing], _, positive = invert_positive(matrix)
        failing = failing[~positive]
        damping *= 10.0
    return inverse
