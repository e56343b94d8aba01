"""Most probable calibrated camera of frames and their coefficients, by Newton's method.

For each frame by itself, given shapes and noise variance s2, this minimises minus two
log marginal likelihoods of its camera, the coefficients being integrated out ::

    F(M) = f(M) / s2 + log det(I + H / s2),  f(M) = min_a ||W - M S(a)||^2 + s2 |a|^2,

over scaled rotations ``M(w, l) = exp(l) M exp(hat(w))`` or, where scales are known,
over rotations. The gradient is that of `coefficient_posterior`'s moments, as in
expectation maximisation, ``dF/dM = 2 G / s2`` with ``G = M A - sum_k c_k P_k^T`` and
``A = sum_kl E_kl B_k B_l^T``. The Hessian is, divided by 2 / s2 and along the tangents
D_c of a camera ::

    tr(D_c A D_d^T) + <G, D_cd> - sum_kl <D_c, F_k> Q_kl <D_d, F_l>,

with ``F_k = M (B_k S^T + S B_k^T) - P_k^T``, ``Q = (H + s2 I)^-1`` and the second
derivative D_cd of the camera: exact but for the logarithm of the determinant, of which
A has a bound. Where it is not positive definite, or a step would raise F, a multiple of
``tr(D_c A D_d^T)`` is added.
"""

from typing import NamedTuple, Self

import numpy as np
from numpy.typing import NDArray

from isa_nrsfm._frames.camera_models import (
    CalibratedCameras,
    nearest_calibrated,
    tangent_curvature,
)
from isa_nrsfm._frames.coefficients import (
    CoefficientPosterior,
    coefficient_posterior,
)
from isa_nrsfm._frames.point_sums import FLAT, FrameSums
from isa_nrsfm._frames.search import MAX_STEPS, FoundFrames
from isa_nrsfm._linalg.packed_symmetric import (
    COLUMNS,
    ROWS,
    inverse3,
    invert_positive,
    solve_positive,
    unpack3,
    unpacked,
)

# The least noise variance, as a share of the energy of a frame.
RIDGE = 1e-13
# A frame has converged when a Newton step gains less than this share of its energy.
TOLERANCE = 1e-12
# The objective may rise by this share of the energy: rounding errors.
ROUNDING = 1e-13
# Objectives that differ by less than this share of the energy are equal.
EQUAL = 1e-10
# The damping that a failing step raises, the factors of a failing and of a good step,
# the value below which there is none, and that with which a step does not move.
FIRST_DAMPING = 0.1
RAISED, EASED = 8.0, 0.1
SMALLEST_DAMPING = 1e-3
LARGEST_DAMPING = 1e8
# A search that has so many times as far to go as a step promises leads nowhere better.
PROMISED = 10.0
ROUGH_STEPS = 3
REVERSED_STEPS = 6


class CalibratedSearch:
    """
    The search for scaled rotations that see given shapes.

    Parameters
    ----------
    shapes : ndarray of shape (n_components + 1, 3, n_points)
        Mean shape and basis shapes, rows centred.
    scaled : bool
        Whether cameras have a scale of their own (weak perspective) or the scale one
        (orthographic).

    Attributes
    ----------
    shapes : ndarray of shape (n_components + 1, 3, n_points)
        The shapes, turned to the principal axes of the mean shape.
    """

    first_steps = MAX_STEPS  # frames that have converged do not take part

    def __init__(self, shapes: NDArray, scaled: bool):
        self._models = CalibratedCameras(scaled)
        axes, size, _ = np.linalg.svd(shapes[0], full_matrices=False)
        self._axes = axes
        self.shapes = np.ascontiguousarray(axes.T @ shapes)
        self.shapes[0, size <= FLAT * size[0]] = 0.0

    def cameras(self, motion: NDArray) -> NDArray:
        """Return cameras (n_frames, 2, 3) for the shapes as they were given."""
        return motion @ self._axes.T

    def fit(
        self,
        products: FrameSums,
        variance: NDArray,
        n_points: float,
        initial: NDArray,
        max_steps: int,
    ) -> FoundFrames:
        """
        Return the minima that frames reach from given coefficients.

        Parameters
        ----------
        products : FrameSums
            Sums of the frames for `shapes`.
        variance : ndarray of shape (n_frames,)
            Noise variances.
        n_points : float
            Not used.
        initial : ndarray of shape (n_components, n_frames)
            Coefficients to start from: with the calibrated cameras that are nearest to
            the affine ones which see these shapes best.
        max_steps : int
            The most steps.

        Returns
        -------
        FoundFrames
            The minima.
        """
        problem = _problem(products, variance, self._models)
        motion = _first_cameras(problem, initial)
        motion, converged = _descend(problem, motion, max_steps)
        motion, better, reached = _better_reversed(problem, motion, max_steps)
        converged[better] = reached[better]
        return _found(problem, motion, converged)

    def reversed_cameras(
        self, products: FrameSums, noise: float, motion: NDArray
    ) -> tuple[NDArray, NDArray]:
        """
        Return the cameras that frames reach from reversed ones, where they are better.

        Parameters
        ----------
        products : FrameSums
            Sums of the frames for `shapes`.
        noise : float
            Noise variance.
        motion : ndarray of shape (n_frames, 2, 3)
            Cameras that see the shapes as they were given.

        Returns
        -------
        motion : ndarray of shape (n_frames, 2, 3)
            The better cameras.
        better : ndarray of bool, shape (n_frames,)
            Which of them are new.
        """
        turned = np.ascontiguousarray((motion @ self._axes).transpose(1, 2, 0))
        problem = _problem(products, np.full(len(motion), noise), self._models)
        # Cameras may not be at their minimum yet: that of both sides is compared.
        turned, _ = _descend(problem, turned, REVERSED_STEPS)
        other, better, _ = _better_reversed(problem, turned, REVERSED_STEPS)
        motion = motion.copy()
        motion[better] = self.cameras(other[:, :, better].transpose(2, 0, 1))
        return motion, better

    def rough_cameras(
        self, products: FrameSums, variance: NDArray, n_points: float
    ) -> NDArray:
        """Return cameras (2, 3, n_frames) by a few steps from coefficients of zero."""
        problem = _problem(products, variance, self._models)
        zero = np.zeros((len(self.shapes) - 1, len(variance)))
        motion = _first_cameras(problem, zero)
        return _descend(problem, motion, ROUGH_STEPS)[0]


class _Problem(NamedTuple):
    """What the search for n frames needs."""

    products: FrameSums
    noise: NDArray  # s2, not zero (n,)
    cameras: CalibratedCameras

    def take(self, frames: NDArray) -> Self:
        """Return the problem of some of the frames."""
        products = self.products.take(frames)
        return type(self)(products, self.noise[frames], self.cameras)


def _problem(
    products: FrameSums, variance: NDArray, cameras: CalibratedCameras
) -> _Problem:
    """Return the problem, with a noise that is not zero."""
    noise = np.maximum(variance, RIDGE * products.energy)
    noise = np.where(noise > 0, noise, 1.0)
    return _Problem(products, noise, cameras)


def _first_cameras(problem: _Problem, alpha: NDArray) -> NDArray:
    """Return calibrated cameras next to the affine ones that see given shapes best."""
    products = problem.products
    c = np.concatenate([np.ones((1, alpha.shape[1])), alpha])
    seen = np.einsum("ki,kari->rai", c, products.cross)  # W S^T
    T = products.gram.products(c)
    inverse = inverse3(0.5 * np.einsum("ki,kpi->pi", c, _packed3(T)))
    affine = np.einsum("rbi,bai->rai", seen, inverse).transpose(2, 0, 1)
    starts = [nearest_calibrated(affine), _completed(affine)]
    if not problem.cameras.scaled:
        starts = [(rows, np.ones(len(rows))) for rows, _ in starts]
    first, other = (
        np.ascontiguousarray((scales[:, None, None] * rows).transpose(1, 2, 0))
        for rows, scales in starts
    )
    values = [_value(problem, _posterior(problem, each)) for each in (first, other)]
    return np.where(values[1] < values[0], other, first)


def _completed(affine: NDArray) -> tuple[NDArray, NDArray]:
    """
    Return orthonormal rows, and scales, by what is seen of the two widest axes.

    Of thin objects the third column of an affine camera is not determined. The first
    two, ``A = U diag(s_1, s_2) V^T``, are those of a scaled rotation whose third column
    is ``sqrt(s_1^2 - s_2^2) u_2``.
    """
    U, values, Vt = np.linalg.svd(affine[:, :, :2])
    scale = np.where(values[:, 0] > 0, values[:, 0], 1.0)
    cosine = values[:, 1] / scale
    sine = np.sqrt(np.maximum(1.0 - cosine**2, 0.0))
    depth = sine[:, None] * U[:, :, 1]
    sign = np.where(np.einsum("ir,ir->i", depth, affine[:, :, 2]) < 0, -1.0, 1.0)
    block = (U * np.stack([np.ones_like(cosine), cosine], axis=1)[:, None]) @ Vt
    return np.concatenate([block, (sign[:, None] * depth)[..., None]], axis=2), scale


def _reversed(motion: NDArray) -> NDArray:
    """
    Return cameras (2, 3, n) that see the mean shape reversed in depth.

    The images of a flat object are the same after a reflection at its plane, and so are
    orthographic images of any object and of its mirror image (Necker reversal). The
    plane is that across the thinnest axis of the mean shape, the last one.
    """
    return motion * np.array([1.0, 1.0, -1.0])[:, None]


def _better_reversed(
    problem: _Problem, motion: NDArray, max_steps: int
) -> tuple[NDArray, NDArray, NDArray]:
    """Return the better ones of cameras and the reversed ones' minima, and which."""
    value = _value(problem, _posterior(problem, motion))
    limit = value - EQUAL * (problem.products.energy + problem.noise)
    other, converged = _descend(problem, _reversed(motion), max_steps, limit)
    better = _value(problem, _posterior(problem, other)) < limit
    return np.where(better, other, motion), better, converged


def _packed3(full: NDArray) -> NDArray:
    """Return symmetric matrices (..., 3, 3, n) packed."""
    pairs = zip(ROWS, COLUMNS, strict=True)
    return np.stack([full[..., a, b, :] for a, b in pairs], axis=-2)


class _State(NamedTuple):
    """The objective at some cameras of n frames, and its derivatives."""

    motion: NDArray  # (2, 3, n)
    value: NDArray  # s2 F (n,)
    slope: NDArray  # minus half of its gradient along the tangents (p, n)
    known: NDArray  # tr(D_c A D_d^T), packed (n_pairs, n)
    hessian: NDArray  # half the Hessian, packed (n_pairs, n)

    def take(self, frames: NDArray) -> Self:
        """Return the state of some of the frames."""
        return type(self)(*(each[..., frames] for each in self))

    def put(self, frames: NDArray, other: Self) -> None:
        """Set the state of some of the frames."""
        for each, given in zip(self, other, strict=True):
            each[..., frames] = given


def _value(problem: _Problem, posterior: CoefficientPosterior) -> NDArray:
    """Return the objective F times s2."""
    return posterior.objective + problem.noise * posterior.log_determinant


def _posterior(problem: _Problem, motion: NDArray) -> CoefficientPosterior:
    """Return the posterior of the coefficients."""
    return coefficient_posterior(problem.products, motion, problem.noise)


def _coupling(
    problem: _Problem, motion: NDArray, posterior: CoefficientPosterior
) -> NDArray:
    """Return ``<D_c, F_k>`` (p, K, n)."""
    products = problem.products
    T = products.gram.products(posterior.c)[1:]
    F = np.einsum("rbi,kbai->krai", motion, T)
    F -= products.cross[1:].swapaxes(1, 2)
    D = problem.cameras.tangents(motion)
    return np.einsum("crai,krai->cki", D, F)


def _curvature(
    motion: NDArray, A: NDArray, G: NDArray, gradient: NDArray
) -> tuple[NDArray, NDArray]:
    """Return ``tr(D_c A D_d^T)`` and ``<G, D_cd>``, packed; the gradient: <G, D_c>."""
    turns, across, scale = tangent_curvature(motion, A)
    # D_cd = (e_c m_d + e_d m_c) / 2 - m d_cd for rotations, row by row.
    mixed = np.einsum("rai,rbi->abi", G, motion)
    trace = np.einsum("aai->i", mixed)
    bent = 0.5 * (mixed + mixed.swapaxes(0, 1)) - trace * np.eye(3)[:, :, None]
    xx, yy, zz, xy, xz, yz = turns
    if len(gradient) == 3:  # no scales
        first = np.stack([xx, xy, xz, yy, yz, zz])
        second = np.stack(
            [bent[0, 0], bent[0, 1], bent[0, 2], bent[1, 1], bent[1, 2], bent[2, 2]]
        )
        return first, second
    first = np.stack([xx, xy, xz, across[0], yy, yz, across[1], zz, across[2], scale])
    second = np.stack(
        [
            bent[0, 0], bent[0, 1], bent[0, 2], gradient[0],
            bent[1, 1], bent[1, 2], gradient[1],
            bent[2, 2], gradient[2],
            trace,
        ]
    )  # fmt: skip
    return first, second


def _evaluate(problem: _Problem, motion: NDArray) -> _State:
    """Return the objective and its derivatives, as in the head of this module."""
    return _state(problem, motion, _posterior(problem, motion))


def _state(
    problem: _Problem, motion: NDArray, posterior: CoefficientPosterior
) -> _State:
    """Return the objective and its derivatives where the posterior is known."""
    noise, cameras = problem.noise, problem.cameras
    A = problem.products.gram.moments(posterior.second_moments(noise))
    G = np.einsum("rbi,bai->rai", motion, unpack3(A))
    G -= np.einsum("ki,kari->rai", posterior.c, problem.products.cross)
    gradient = cameras.gradient(motion, G)
    known, bent = _curvature(motion, A, G, gradient)
    Q = -unpacked(posterior.inverse)[1:, 1:]
    coupling = _coupling(problem, motion, posterior)
    through = np.einsum("kli,cli->cki", Q, coupling)
    hessian = known + bent
    rows, columns = np.triu_indices(cameras.n_parameters)
    hessian -= np.einsum("pki,pki->pi", through[rows], coupling[columns])
    value = _value(problem, posterior)
    return _State(motion, value, -gradient, known, hessian)


def _descend(
    problem: _Problem, motion: NDArray, max_steps: int, limit: NDArray | None = None
) -> tuple[NDArray, NDArray]:
    """
    Return the minima reached from cameras, and whether they are reached.

    Frames whose objective will not fall below their limit, by what a step promises, are
    left where they are.
    """
    found, converged = motion.copy(), np.zeros(motion.shape[2], dtype=bool)
    running, damping = np.arange(motion.shape[2]), np.zeros(motion.shape[2])
    limit = np.full(len(running), np.inf) if limit is None else limit
    state = _evaluate(problem, motion)
    for _ in range(max_steps):
        step, damping = _newton_step(state, damping)
        step = problem.cameras.limited(step)
        energy = problem.products.energy + problem.noise
        gain = np.einsum("ci,ci->i", state.slope, step)
        small = (damping == 0) & (gain <= TOLERANCE * energy)
        leaving = small | (damping >= LARGEST_DAMPING)
        leaving |= state.value - PROMISED * gain > limit
        if leaving.any():
            last = problem.cameras.moved(state.motion, np.where(small, step, 0.0))
            found[:, :, running[leaving]] = last[:, :, leaving]
            converged[running[leaving]] = small[leaving]
            left = np.flatnonzero(~leaving)
            if not len(left):
                return found, converged
            running, damping, step = running[left], damping[left], step[:, left]
            limit = limit[left]
            problem, state = problem.take(left), state.take(left)
            energy = energy[left]
        trial = _evaluate(problem, problem.cameras.moved(state.motion, step))
        worse = np.flatnonzero(~(trial.value <= state.value + ROUNDING * energy))
        eased = EASED * damping
        eased[eased < SMALLEST_DAMPING] = 0.0
        if len(worse):
            eased[worse] = np.maximum(RAISED * damping[worse], FIRST_DAMPING)
            trial.put(worse, state.take(worse))
        state, damping = trial, eased
    found[:, :, running] = state.motion
    return found, converged


def _newton_step(state: _State, damping: NDArray) -> tuple[NDArray, NDArray]:
    """Return damped Newton steps, and the damping, raised where it has to be."""
    damping = damping.copy()
    step, positive = solve_positive(state.hessian + damping * state.known, state.slope)
    failing = np.flatnonzero(~positive)
    while len(failing):
        damping[failing] = np.maximum(RAISED * damping[failing], FIRST_DAMPING)
        part = state.take(failing)
        matrix = part.hessian + damping[failing] * part.known
        step[:, failing], positive = solve_positive(matrix, part.slope)
        failing = failing[~positive & (damping[failing] < LARGEST_DAMPING)]
    return step, damping


def _found(problem: _Problem, motion: NDArray, converged: NDArray) -> FoundFrames:
    """Return what follows from the cameras of frames."""
    noise = problem.noise
    posterior = _posterior(problem, motion)
    state = _state(problem, motion, posterior)
    # The covariance of the coefficients, the camera being unknown: s2 times the inverse
    # of H + s2 I - C^T X^-1 C is s2 (Q + Q C^T Y^-1 C Q), Y the Hessian by the camera.
    Q = -unpacked(posterior.inverse)[1:, 1:]
    through = np.einsum("kli,cli->kci", Q, _coupling(problem, motion, posterior))
    inverse, _, positive = invert_positive(state.hessian)
    bad = np.flatnonzero(~positive)
    if len(bad):
        inverse[:, bad] = invert_positive(state.known[:, bad])[0]
    inverse = unpacked(inverse)
    covariance = Q + np.einsum("kci,cdi,ldi->kli", through, inverse, through)
    rows, columns = np.triu_indices(len(Q))
    return FoundFrames(
        motion,
        posterior.alpha,
        noise * covariance[rows, columns],
        posterior.objective,
        np.maximum(posterior.residual(noise), 0.0),
        converged,
    )
