"""Most probable affine camera and coefficients of frames, by Newton's method.

For each frame by itself, with weights ``w_ij`` (zero for missing points), shapes ``S(a)
= B_0 + sum_k a_k B_k`` and noise variance s2 this minimises

    f(M, t, a) = sum_j w_ij || m_ij - M S_j(a) - t ||^2 + s2 |a|^2,

the negative log posterior times ``2 s2``, where a has the prior N(0, I). Position and
camera are eliminated. With ``A = S S^T`` and ``Y = W S^T``, points and shapes centred
over the points that the frame sees, the camera is ``M = Y A^-1`` and

    f(a) = ||W||^2 - <M, Y> + s2 |a|^2.

Write ``P_k = B_k W^T``, ``H_kl = <M B_k, M B_l>`` and c = (1, a). Half the gradient is
``s2 a_k + sum_l H_kl c_l - <P_k^T, M>``. Half the Hessian is the Schur complement

    H_kl + s2 d_kl - <F_k A^-1, F_l>,  F_k = M (B_k S^T + S B_k^T) - P_k^T.

The first step from a start takes ``H + s2 I`` in its place, half the Hessian with the
camera held. The others are Newton steps. Where the Schur complement is not positive
definite, or a step raised f, it is damped: a multiple of ``H + s2 I`` is added. So f
never rises, up to rounding.
"""

from typing import NamedTuple, Self

import numpy as np
from numpy.typing import NDArray

from isa_nrsfm._frames.point_sums import (
    FrameGram,
    FrameSums,
    SharedGram,
    whitened,
    with_one,
)
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
from isa_nrsfm._linalg.rounding import OF_PRODUCTS
from isa_nrsfm._linalg.vectors import frames_first

# Ridge of ``A = S S^T``, as a share of the second moment of the shapes, and lower bound
# of s2, as a share of the energy of the frame. They keep the result finite for
# degenerate shapes, and are too small to change it for others.
RIDGE = 1e-13
# Convergence tolerance: a frame has converged when a Newton step gains less than this
# share of its energy. Convergence is quadratic: the next step would gain far less.
TOLERANCE = 1e-12
# Damping below SMALLEST_DAMPING is set to zero. With LARGEST_DAMPING a step no longer
# moves, and the search of the frame ends.
SMALLEST_DAMPING = 0.05
LARGEST_DAMPING = 1e8


class AffineSearch:
    """
    The search for affine cameras and coefficients of frames, for given shapes.

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
        """Return cameras (n_frames, 2, 3) of the search for the original shapes."""
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
        initial : ndarray of shape (n_frames, n_components)
            Coefficients to start from.
        max_steps : int
            The most steps.

        Returns
        -------
        FoundFrames
            The minima.
        """
        problem = _problem(products, variance, n_points)
        start = np.ascontiguousarray(initial.T)
        alpha, converged = _descend(problem, start, max_steps)
        state = _evaluate(problem, alpha)
        prior = problem.ridge * np.einsum("ki,ki->i", alpha, alpha)
        objective = np.maximum(products.energy - state.explained, 0.0)
        return FoundFrames(
            _motion(state.camera),
            alpha.T,
            frames_first(unpacked(problem.ridge * _inverse_schur(state))),
            objective,
            np.maximum(objective - prior, 0.0),
            converged,
        )

    def rough_cameras(
        self, products: FrameSums, variance: NDArray, n_points: float
    ) -> NDArray:
        """Return cameras (n_frames, 2, 3) by two steps from coefficients of zero."""
        problem = _problem(products, variance, n_points)
        state = _evaluate(problem, np.zeros((len(self.shapes) - 1, len(variance))))
        # A step with the camera held, then a Newton step
        alpha, _ = solve_positive(state.held, state.slope)
        step, _ = _newton_step(_evaluate(problem, alpha), np.zeros(len(variance)))
        return _motion(_eliminated(problem, with_one(alpha + step))[-1])


def _motion(camera: NDArray) -> NDArray:
    """Return cameras (n, 2, 3) from ``M^T`` (3, 2, n)."""
    return frames_first(camera.swapaxes(0, 1))


class _Problem(NamedTuple):
    """What the search for n frames needs, for `whitened` shapes."""

    cross: NDArray  # P_k (n_shapes, 3, 2, n)
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
    """Return the problem with its ridges. The noise variances are (n_frames,)."""
    energy, weight = products.energy, products.weight
    ridge = np.maximum(variance, RIDGE * energy)
    # A frame of zero energy: alpha is zero for any ridge.
    ridge = np.where(ridge > 0, ridge, 1.0)
    precision = np.zeros((6, len(ridge)))
    # A ridge on the diagonal: the shapes are white.
    precision[:3] = RIDGE * weight / n_points
    return _Problem(products.cross, products.gram, energy, ridge, precision)


class _State(NamedTuple):
    """The objective at some coefficients of n frames, and its derivatives."""

    alpha: NDArray  # (K, n)
    camera: NDArray  # M^T (3, 2, n)
    explained: NDArray  # ||W||^2 - f (n,)
    slope: NDArray  # minus half the gradient of f(a) (K, n)
    held: NDArray  # H + s2 I, half the Hessian with the camera held, packed
    schur: NDArray  # half the Hessian of f(a), packed

    def take(self, frames: NDArray) -> Self:
        """Return the state of some of the frames."""
        return type(self)(*(each[..., frames] for each in self))

    def put(self, frames: NDArray, other: Self) -> None:
        """Set the state of some of the frames."""
        for each, given in zip(self, other, strict=True):
            each[..., frames] = given


def _eliminated(
    problem: _Problem, c: NDArray
) -> tuple[NDArray, NDArray, NDArray, NDArray]:
    """
    Eliminate the cameras for coefficients c (n_shapes, n).

    Returned are ``B_k S^T + S B_k^T`` (n_shapes, 3, 3, n), R (3, 3, n) with ``R^T R =
    A^-1``, ``R Y^T`` (3, 2, n) and the cameras ``M^T = A^-1 Y^T`` (3, 2, n).
    """
    T = problem.gram.products(c)
    A = 0.5 * np.einsum("ki,kabi->abi", c, T)[ROWS, COLUMNS] + problem.precision
    R = inverse_factor3(A)
    Y = np.einsum("ki,kari->ari", c, problem.cross)
    half = np.einsum("abi,bri->ari", R, Y)
    return T, R, half, np.einsum("bai,bri->ari", R, half)


def _evaluate(problem: _Problem, alpha: NDArray) -> _State:
    """Return f(a) and its derivatives at alpha (K, n), see the docstring on top."""
    P, ridge = problem.cross, problem.ridge
    c = with_one(alpha)
    T, R, half, camera = _eliminated(problem, c)
    # ||W||^2 - f = ||R Y^T||^2 - s2 |a|^2
    explained = np.einsum("ari,ari->i", half, half)
    explained -= ridge * np.einsum("ki,ki->i", alpha, alpha)

    # H + s2 I, from M^T M
    images = np.einsum("cri,cri->ci", camera[ROWS, :], camera[COLUMNS, :])
    held = problem.gram.energies(images)[len(c) :]
    held[diagonal_of(held)] += ridge
    # F_k^T, then R F_k^T for the Schur complement
    F = np.einsum("kabi,bri->kari", T[1:], camera)
    F -= P[1:]
    slope = 0.5 * np.einsum("kari,ari->ki", P[1:] - F, camera) - ridge * alpha
    F = np.einsum("abi,kbri->kari", R, F).reshape(len(alpha), 6, len(ridge))
    return _State(alpha, camera, explained, slope, held, held - packed_gram(F))


def _descend(
    problem: _Problem, alpha: NDArray, max_steps: int
) -> tuple[NDArray, NDArray]:
    """Return the last iterates from alpha (K, n), and whether they have converged."""
    found, converged = alpha.copy(), np.zeros(alpha.shape[1], dtype=bool)
    running, damping = np.arange(alpha.shape[1]), np.zeros(alpha.shape[1])
    state = _evaluate(problem, alpha)
    step, _ = solve_positive(state.held, state.slope)
    for _ in range(max_steps):
        # Trial step, refused where f rises
        energy = problem.energy
        trial = _evaluate(problem, state.alpha + step)
        worse = np.flatnonzero(trial.explained < state.explained - OF_PRODUCTS * energy)
        if len(worse):
            trial.put(worse, state.take(worse))
        state = trial
        # Damping: less after a good step, more after a refused one
        eased = np.where(damping > SMALLEST_DAMPING, damping / 8.0, 0.0)
        eased[worse] = np.maximum(4.0 * damping[worse], 0.5)

        # Next step, and convergence test by the decrease that it predicts
        step, damping = _newton_step(state, eased)
        gain = np.einsum("ki,ki->i", state.slope, step)
        small = (damping == 0) & (gain <= TOLERANCE * energy)
        stuck = damping >= LARGEST_DAMPING
        leaving = small | stuck
        if not leaving.any():
            continue
        # Frames that have ended leave the problem, converged ones with a last step.
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
    """
    Return damped Newton steps (K, n), and the damping (n,).

    It is at least SMALLEST_DAMPING where the damped matrix is not positive definite.
    """
    matrix = state.schur
    if damping.any():
        matrix = matrix + damping * state.held
    step, positive = solve_positive(matrix, state.slope)
    failing = np.flatnonzero(~positive)
    if len(failing):
        damping[failing] = np.maximum(damping[failing], SMALLEST_DAMPING)
        step[:, failing] = _step_off_saddle(state.take(failing), damping[failing])
    return step, damping


def _step_off_saddle(state: _State, damping: NDArray) -> NDArray:
    """
    Return steps for frames whose Hessian is not positive definite.

    In coordinates where ``H + s2 I`` is the identity, the step along each principal
    axis of the Hessian is ``slope / (|curvature| + damping)``: downhill, also where the
    curvature is negative (the saddle-free Newton method of Dauphin et al., "Identifying
    and attacking the saddle point problem in high-dimensional non-convex optimization",
    2014).
    """
    held, schur = (frames_first(unpacked(each)) for each in (state.held, state.schur))
    size, axes = np.linalg.eigh(held)
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

    It is positive definite at a minimum that the frame determines. Elsewhere a multiple
    of ``H + s2 I`` is added that is large enough.
    """
    inverse, _, positive = invert_positive(state.schur)
    failing = np.flatnonzero(~positive)
    damping = 1.0
    while len(failing) and damping < LARGEST_DAMPING:
        part = state.take(failing)
        matrix = part.schur + damping * part.held
        inverse[..., failing], _, positive = invert_positive(matrix)
        failing = failing[~positive]
        damping *= 10.0
    return inverse
