"""Most probable affine camera and coefficients of frames, by Newton's method.

For each frame by itself, with weights ``w_ij`` (zero for missing points), shapes ``S(a)
= B_0 + sum_k a_k B_k`` and noise variance s2 this minimises

    f(M, t, a) = sum_j w_ij || m_ij - M S_j(a) - t ||^2 + s2 |a|^2,

``2 s2`` times minus the log posterior of coefficients with the prior N(0, I). Position
and camera are eliminated: with ``A = S S^T`` and ``Y = W S^T`` (points and shapes
centred over the points that the frame sees) the camera is ``M = Y A^-1`` and

    f(a) = ||W||^2 - <M, Y> + s2 |a|^2.

With ``P_k = W B_k^T`` and ``H_kl = <M B_k, M B_l>`` half its gradient is ``s2 a_k +
sum_l H_kl c_l - <P_k, M>``, c = (1, a), and half its Hessian is the Schur complement

    H_kl + s2 d_kl - <F_k A^-1, F_l>,  F_k = M (B_k S^T + S B_k^T) - P_k.

The first step from a start is that of alternation, with ``H + s2 I`` alone, the others
are Newton steps. Where the Schur complement is not positive definite, or a step would
raise f, a multiple of ``H + s2 I`` is added: f never rises, up to rounding.
"""

from typing import NamedTuple, Self

import numpy as np
from numpy.typing import NDArray

from isa_nrsfm._frames.point_sums import FrameGram, FrameSums, SharedGram, whitened
from isa_nrsfm._frames.search import FoundFrames
from isa_nrsfm._linalg.packed_symmetric import (
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

# Prior precision of cameras, as a share of the second moment of the shapes, and of
# coefficients, as a share of the energy of the frame: they keep the result finite for
# degenerate shapes and are too small to matter to others.
RIDGE = 1e-13
# A frame has converged when a Newton step gains less than this share of its energy;
# the next one would gain about the square.
TOLERANCE = 1e-12
# f may rise by this share of the energy: rounding errors.
ROUNDING = 1e-14
# Below the one a step is not damped any more; with the other it does not move.
SMALLEST_DAMPING = 0.05
LARGEST_DAMPING = 1e8


class AffineSearch:
    """
    The search for affine cameras that see given shapes.

    Parameters
    ----------
    shapes : ndarray of shape (n_components + 1, 3, n_points)
        Mean shape and basis shapes, rows centred.

    Attributes
    ----------
    shapes : ndarray of shape (n_components + 1, 3, n_points)
        The shapes in the space of `whitened`, where the search takes place.
    """

    first_steps = 5

    def __init__(self, shapes: NDArray):
        self.shapes, self._space = whitened(np.ascontiguousarray(shapes))

    def cameras(self, motion: NDArray) -> NDArray:
        """Return cameras (n_frames, 2, 3) for the shapes as they were given."""
        return motion @ self._space

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
            Number of points of a frame.
        initial : ndarray of shape (n_components, n_frames)
            Coefficients to start from.
        max_steps : int
            The most steps.

        Returns
        -------
        FoundFrames
            The minima.
        """
        problem = _problem(products, variance, n_points)
        alpha, converged = _descend(problem, initial, max_steps)
        state = _evaluate(problem, alpha)
        prior = problem.ridge * np.einsum("ki,ki->i", alpha, alpha)
        objective = np.maximum(products.energy - state.explained, 0.0)
        return FoundFrames(
            state.camera.transpose(1, 0, 2),
            alpha,
            problem.ridge * _inverse_schur(state),
            objective,
            np.maximum(objective - prior, 0.0),
            converged,
        )

    def rough_cameras(
        self, products: FrameSums, variance: NDArray, n_points: float
    ) -> NDArray:
        """Return cameras (2, 3, n_frames) by two steps from coefficients of zero."""
        problem = _problem(products, variance, n_points)
        state = _evaluate(problem, np.zeros((len(self.shapes) - 1, len(variance))))
        alpha, _ = solve_positive(state.known, state.slope)
        step, _ = _newton_step(_evaluate(problem, alpha), np.zeros(len(variance)))
        camera = _eliminated(problem, with_one(alpha + step))[-1]
        return camera.transpose(1, 0, 2)


class _Problem(NamedTuple):
    """What the search for n frames needs, shapes in white space."""

    cross: NDArray  # P (n_shapes, 3, 2, n)
    gram: SharedGram | FrameGram
    energy: NDArray  # ||W||^2 (n,)
    ridge: NDArray  # s2, not zero (n,)
    precision: NDArray  # ridge of A, packed (6, n)

    def take(self, frames: NDArray) -> Self:
        """Return the problem of some of the frames."""
        return type(self)(
            self.cross[..., frames],
            self.gram.take(frames),
            self.energy[frames],
            self.ridge[frames],
            self.precision[:, frames],
        )


def _problem(products: FrameSums, variance: NDArray, n_points: float) -> _Problem:
    """Return the problem with its ridges, each relative to the frame."""
    energy, weight = products.energy, products.weight
    ridge = np.maximum(variance, RIDGE * energy)
    # Where all points of a frame are equal any ridge will do: alpha is zero.
    ridge = np.where(ridge > 0, ridge, 1.0)
    precision = np.zeros((6, len(ridge)))
    precision[:3] = RIDGE * weight / n_points
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


def with_one(alpha: NDArray) -> NDArray:
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
    c = with_one(alpha)
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
