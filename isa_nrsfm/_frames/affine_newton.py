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
camera held: f falls, as the camera that is best for the new coefficients is better
still. The others are Newton steps (`damped_newton`), damped by ``H + s2 I``.
"""

from typing import NamedTuple, Self

import numpy as np
from numpy.typing import NDArray

from isa_nrsfm._frames.damped_newton import State, descend, newton_step
from isa_nrsfm._frames.options import FRAME_OPTIONS, Damping, FrameOptions
from isa_nrsfm._frames.point_sums import (
    TWICE,
    FrameGram,
    FrameSums,
    ShapeProducts,
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
from isa_nrsfm._linalg.vectors import frames_first, in_lanes, of_frames

# Ridge of ``A = S S^T``, as a share of the second moment of the shapes, and lower bound
# of s2, as a share of the energy of the frame. They keep the result finite for
# degenerate shapes, and are too small to change it for others.
RIDGE = 1e-13
# Half the multiplicity of the entries of packed symmetric 3x3 matrices.
HALVED = 0.5 * TWICE[:, None]


class AffineSearch:
    """
    The search for affine cameras and coefficients of frames, for given shapes.

    Parameters
    ----------
    shapes : ndarray of shape (n_components + 1, 3, n_points)
        Mean shape and basis shapes, rows centred.
    options : FrameOptions
        What steers the search.

    Attributes
    ----------
    shared : ShapeProducts
        The shapes in the space of `whitened`, where the search takes place.
    options : FrameOptions
        What steers the search.
    first_steps : int
        As of `FrameOptions`.
    """

    def __init__(self, shapes: NDArray, options: FrameOptions = FRAME_OPTIONS):
        self.options, self.first_steps = options, options.first_steps
        white, self._space = whitened(np.ascontiguousarray(shapes))
        self.shared = ShapeProducts(white)

    def cameras(self, motion: NDArray) -> NDArray:
        """Return cameras (n_frames, 2, 3) of the search for the original shapes."""
        return motion @ self._space

    def turns(self, covariance: NDArray) -> NDArray:
        """Return the covariances, which are NaN: affine cameras have no rotation."""
        return covariance

    def fit(
        self,
        products: FrameSums,
        variance: NDArray,
        n_points: float,
        initial: NDArray,
        max_steps: int,
        covariances: bool = True,
    ) -> FoundFrames:
        """
        Return the minima that frames reach from given coefficients.

        Parameters
        ----------
        products : FrameSums
            Sums of the frames for the shapes in `shared`.
        variance : ndarray of shape (n_frames,)
            Noise variances.
        n_points : float
            Number of points of a frame.
        initial : ndarray of shape (n_frames, n_components)
            Coefficients to start from.
        max_steps : int
            The most steps.
        covariances : bool, default=True
            Whether covariances are wanted.

        Returns
        -------
        FoundFrames
            The minima.
        """
        problem = affine_problem(products, variance, n_points, self.options)
        state = problem.evaluate(_first_step(problem, initial.T))
        alpha, converged = descend(problem, state, max_steps - 1)
        _, _, half, camera = _eliminated(problem, with_one(alpha))
        prior = problem.ridge * np.einsum("ki,ki->i", alpha, alpha)
        n = len(prior)
        objective = np.maximum(products.energy - _explained(problem, alpha, half), 0.0)
        return FoundFrames(
            _motion(camera),
            alpha.T,
            _covariance(problem, alpha) if covariances else np.empty((n, 0, 0)),
            np.full((n, 3, 3), np.nan),
            objective,
            np.maximum(objective - prior, 0.0),
            converged,
        )

    def rough_cameras(
        self, products: FrameSums, variance: NDArray, n_points: float
    ) -> NDArray:
        """Return cameras (n_frames, 2, 3) by two steps from coefficients of zero."""
        problem = affine_problem(products, variance, n_points, self.options)
        zero = np.zeros((self.shared.n_components, len(variance)))
        alpha = _first_step(problem, zero)
        step, _ = problem.step(problem.evaluate(alpha), np.zeros(len(variance)))
        return _motion(_eliminated(problem, with_one(alpha + step))[-1])


def _motion(camera: NDArray) -> NDArray:
    """Return cameras (n, 2, 3) from ``M^T`` (3, 2, n)."""
    return frames_first(camera.swapaxes(0, 1))


class AffineProblem(NamedTuple):
    """
    The objectives of n frames as functions of their coefficients (K, n).

    Attributes
    ----------
    cross : ndarray of shape (n_shapes, 3, 2, n)
        P_k, for shapes that are white.
    gram : SharedGram or FrameGram
        Gram matrices of these shapes.
    energy : ndarray of shape (n,)
        ``||W||^2``.
    ridge : ndarray of shape (n,)
        s2, not zero.
    precision : ndarray of shape (6, n)
        Ridge of A, packed.
    options : FrameOptions
        What steers the search.
    """

    cross: NDArray
    gram: SharedGram | FrameGram
    energy: NDArray
    ridge: NDArray
    precision: NDArray
    options: FrameOptions

    @property
    def damping(self) -> Damping:
        """How steps are damped."""
        return self.options.affine

    def take(self, frames: NDArray) -> Self:
        """Return the problem of some of the frames."""
        return self._replace(
            cross=of_frames(self.cross, frames),
            gram=self.gram.take(frames),
            energy=self.energy[frames],
            ridge=self.ridge[frames],
            precision=of_frames(self.precision, frames),
        )

    def evaluate(self, alpha: NDArray) -> State:
        """Return ``f(a) - ||W||^2`` and its derivatives at alpha (K, n)."""
        c = with_one(alpha)
        T, R, half, camera = _eliminated(self, c)
        held, slope = _held(self, c, T, camera)
        # F_k^T, then R F_k^T for the Schur complement
        F = self.gram.images(c, T, camera)
        F -= self.cross[1:]
        F = np.einsum("abi,kbri->kari", R, F).reshape(len(alpha), 6, len(self.ridge))
        value = -_explained(self, alpha, half)
        return State(alpha, value, slope, held, held - packed_gram(F))

    def step(self, state: State, damping: NDArray) -> tuple[NDArray, NDArray]:
        """
        Return damped Newton steps (K, n), and the damping (n,).

        Where the damped matrix is not positive definite, the step is that off a saddle
        point.
        """
        step, positive = newton_step(state, damping)
        failing = in_lanes(np.flatnonzero(~positive))
        if len(failing):
            damping[failing] = np.maximum(damping[failing], self.options.saddle)
            step[:, failing] = _step_off_saddle(state.take(failing), damping[failing])
        return step, damping

    def moved(self, alpha: NDArray, step: NDArray) -> NDArray:
        """Return coefficients after steps."""
        return alpha + step


def affine_problem(
    products: FrameSums,
    variance: NDArray,
    n_points: float,
    options: FrameOptions = FRAME_OPTIONS,
) -> AffineProblem:
    """
    Return the objectives of frames, with ridges.

    Parameters
    ----------
    products : FrameSums
        Sums of the frames for shapes in the space of `whitened`.
    variance : ndarray of shape (n_frames,)
        Noise variances.
    n_points : float
        Number of points of a frame.
    options : FrameOptions
        What steers the search.

    Returns
    -------
    AffineProblem
        The objectives.
    """
    energy, weight = products.energy, products.weight
    ridge = np.maximum(variance, RIDGE * energy)
    # A frame of zero energy: alpha is zero for any ridge.
    ridge = np.where(ridge > 0, ridge, 1.0)
    precision = np.zeros((6, len(ridge)))
    # A ridge on the diagonal: the shapes are white.
    precision[:3] = RIDGE * weight / n_points
    cross, gram = products.cross, products.gram
    return AffineProblem(cross, gram, energy, ridge, precision, options)


def _eliminated(
    problem: AffineProblem, c: NDArray
) -> tuple[NDArray, NDArray, NDArray, NDArray]:
    """
    Eliminate the cameras for coefficients c (n_shapes, n).

    Returned are ``B_k S^T + S B_k^T`` (n_shapes, 6, n), packed, R (3, 3, n) with ``R^T
    R = A^-1``, ``R Y^T`` (3, 2, n) and the cameras ``M^T = A^-1 Y^T`` (3, 2, n).
    """
    T = problem.gram.products(c)
    A = np.einsum("ki,kpi->pi", 0.5 * c, T)
    A += problem.precision
    R = inverse_factor3(A)
    Y = np.einsum("ki,kari->ari", c, problem.cross)
    half = np.einsum("abi,bri->ari", R, Y)
    return T, R, half, np.einsum("bai,bri->ari", R, half)


def _explained(problem: AffineProblem, alpha: NDArray, half: NDArray) -> NDArray:
    """Return ``||W||^2 - f(a) = ||R Y^T||^2 - s2 |a|^2`` (n,), with half ``R Y^T``."""
    explained = np.einsum("ari,ari->i", half, half)
    explained -= problem.ridge * np.einsum("ki,ki->i", alpha, alpha)
    return explained


def _held(
    problem: AffineProblem, c: NDArray, T: NDArray, camera: NDArray
) -> tuple[NDArray, NDArray]:
    """
    Return ``H + s2 I`` (n_pairs, n), packed, and minus half the gradient (K, n).

    T and the cameras are those of `_eliminated` for coefficients c (n_shapes, n).
    """
    # H + s2 I, from M^T M
    images = np.einsum("cri,cri->ci", camera[ROWS, :], camera[COLUMNS, :])
    held = problem.gram.energies(images)[len(c) :]
    held[diagonal_of(held)] += problem.ridge
    # sum_l H_kl c_l = <B_k S^T + S B_k^T, M^T M> / 2
    images *= HALVED
    slope = np.einsum("kari,ari->ki", problem.cross[1:], camera)
    slope -= np.einsum("kpi,pi->ki", T[1:], images)
    slope -= problem.ridge * c[1:]
    return held, slope


def _first_step(problem: AffineProblem, alpha: NDArray) -> NDArray:
    """Return coefficients (K, n) after a step from alpha with the cameras held."""
    c = with_one(alpha)
    T, _, _, camera = _eliminated(problem, c)
    return alpha + solve_positive(*_held(problem, c, T, camera))[0]


def _step_off_saddle(state: State, damping: NDArray) -> NDArray:
    """
    Return steps for frames whose Hessian is not positive definite.

    In coordinates where ``H + s2 I`` is the identity, the step along each principal
    axis of the Hessian is ``slope / (|curvature| + damping)``: downhill, also where the
    curvature is negative (the saddle-free Newton method of Dauphin et al., "Identifying
    and attacking the saddle point problem in high-dimensional non-convex optimization",
    2014).
    """
    held, schur = (
        frames_first(unpacked(each)) for each in (state.definite, state.hessian)
    )
    size, axes = np.linalg.eigh(held)
    size = np.maximum(size, SMALLEST_PIVOT * size[:, -1:])
    whitening = axes / np.sqrt(size)[:, None]
    curvature, modes = np.linalg.eigh(whitening.swapaxes(1, 2) @ schur @ whitening)
    axes = whitening @ modes
    along = np.einsum("nab,an->nb", axes, state.slope)
    along /= np.abs(curvature) + damping[:, None]
    return np.einsum("nab,nb->an", axes, along)


def _covariance(problem: AffineProblem, alpha: NDArray) -> NDArray:
    """
    Return s2 times the inverse of the Schur complement at alpha (K, n): (n, K, K).

    It is positive definite at a minimum that the frame determines. Elsewhere a multiple
    of ``H + s2 I`` is added that is large enough, and below the largest damping.
    """
    state, most = problem.evaluate(alpha), problem.damping.largest
    inverse, _, positive = invert_positive(state.hessian)
    failing = in_lanes(np.flatnonzero(~positive))
    damping = 1.0
    while len(failing) and damping < most:
        part = state.take(failing)
        matrix = part.hessian + damping * part.definite
        inverse[..., failing], _, positive = invert_positive(matrix)
        failing = in_lanes(np.unique(failing[~positive]))
        damping *= 10.0
    inverse *= problem.ridge
    return frames_first(unpacked(inverse))
