"""The paper's refinement: basis blocks and coefficients by alternating least squares.

The cameras and the subspaces are fixed. For each subspace k the cost

    sum_i ||M_ik - alpha_ik M_0^i E_k||_F^2

is minimised over alpha and the 3x3 matrix E (Brandt et al. 2018, section 3.5). With the
best alpha put in, that is to maximise

    f(E) = sum_i <M_ik, M_0^i E>^2 / ||M_0^i E||^2

The paper alternates between alpha and ``E = A^-1 R``, with ``A = sum_i alpha_i^2 M_0^iT
M_0^i`` and ``R = sum_i alpha_i M_0^iT M_ik``. Here a Newton step is tried first, which
converges in few steps. Where it does not raise f the alternation step is taken, which
never lowers it.
"""

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from isa_nrsfm._paper.block_structure import MotionProducts, packed_inner, unpack
from isa_nrsfm._paper.options import PAPER_OPTIONS, PaperOptions


class Refinement(NamedTuple):
    """
    Result of the alternating refinement.

    Attributes
    ----------
    E : ndarray of shape (n_blocks, 3, 3)
        Blocks of unit norm, of arbitrary sign: ``M_ik ~ alpha_ik M_0^i E_k``. The zero
        matrix for a subspace without motion.
    energy : ndarray of shape (n_blocks,)
        ``sum_i ||alpha_ik M_0^i E_k||^2``.
    n_iter : int
        Number of steps of the subspace that took most.
    converged : bool
        Whether all subspaces have converged.
    """

    E: NDArray
    energy: NDArray
    n_iter: int
    converged: bool


class _State(NamedTuple):
    """An iterate E of unit norm, the best coefficients for it, and sums over frames."""

    E: NDArray  # (3, 3)
    energy: float  # f(E)
    alpha: NDArray  # (n_frames,)
    q: NDArray  # ||M_0^i E||^2, (n_frames,)
    A: NDArray  # (3, 3), as above
    R: NDArray  # (3, 3), as above


def refine_alternating(
    products: MotionProducts,
    starts: NDArray,
    *,
    max_iter: int,
    tol: float,
    options: PaperOptions = PAPER_OPTIONS,
) -> Refinement:
    """
    Return the blocks that explain most of the motion, each from several starts.

    Parameters
    ----------
    products : MotionProducts
        Products of the frames after ISA; consecutive signals form a subspace.
    starts : ndarray of shape (n_blocks, n_starts, 3, 3)
        Where to start each block. The best one after a few alternations is used.
    max_iter : int
        The most steps of a block.
    tol : float
        Convergence tolerance: a block has converged when a Newton step promises to
        raise its energy by less than this share.
    options : PaperOptions
        How many trial steps there are, and how long a Newton step may be.

    Returns
    -------
    Refinement
        The blocks.
    """
    n_blocks = len(starts)
    E = np.zeros((n_blocks, 3, 3))
    energy = np.zeros(n_blocks)
    n_iter = np.ones(n_blocks, dtype=int)
    converged = np.ones(n_blocks, dtype=bool)
    for k, P in enumerate(products.blocks()):
        best = _best_start(P, products.rigid, starts[k], options.n_trial_steps)
        if best is not None:
            E[k], energy[k], n_iter[k], converged[k] = _maximise(
                P, products.rigid, best, max_iter, tol, options.largest_gain
            )
    return Refinement(E, energy, int(n_iter.max()), bool(converged.all()))


def _best_start(
    P: NDArray, rigid: NDArray, starts: NDArray, n_steps: int
) -> NDArray | None:
    """
    Return the iterate (3, 3) of largest energy after some alternations from each start.

    None if all energies are zero. P is (n_frames, 9), `rigid` (n_frames, 6) as in
    `MotionProducts`, starts are (n_starts, 3, 3).
    """
    norms = np.linalg.norm(starts, axis=(1, 2), keepdims=True)
    E = (starts / np.where(norms > 0, norms, 1.0))[norms.ravel() > 0]
    if not len(E) or not P.any():
        return None
    for _ in range(n_steps):
        _, _, alpha = _coefficients(P, rigid, E)
        A, R = unpack((alpha**2).T @ rigid), (alpha.T @ P).reshape(-1, 3, 3)
        E = np.linalg.pinv(A, hermitian=True) @ R
        norm = np.linalg.norm(E, axis=(1, 2), keepdims=True)
        E = np.divide(E, norm, where=norm > 0, out=np.zeros_like(E))
    a, _, alpha = _coefficients(P, rigid, E)
    energy = np.sum(alpha * a, axis=0)
    best = np.argmax(energy)
    return E[best] if energy[best] > 0 else None


def _coefficients(
    P: NDArray, rigid: NDArray, E: NDArray
) -> tuple[NDArray, NDArray, NDArray]:
    """Return ``<M_ik, M_0^i E>``, ``||M_0^i E||^2`` and their ratio alpha.

    Each is (n_frames, n), for matrices E (n, 3, 3).
    """
    a, q = P @ E.reshape(-1, 9).T, packed_inner(rigid, E @ E.swapaxes(1, 2))
    return a, q, np.divide(a, q, where=q > 0, out=np.zeros_like(a))


def _maximise(
    P: NDArray,
    rigid: NDArray,
    E: NDArray,
    max_iter: int,
    tol: float,
    largest_gain: float,
) -> tuple[NDArray, float, int, bool]:
    """Return a local maximum of f from the start E: E, f, n_iter and converged."""
    state = _state(P, rigid, E)
    for n_iter in range(1, max_iter + 1):
        plain, newton, gain = _steps(P, rigid, state, largest_gain)
        converged = gain <= tol * state.energy
        tried = _state(P, rigid, state.E + newton)
        if not tried.energy > state.energy:
            tried = _state(P, rigid, state.E + plain)
        if not tried.energy > state.energy:  # at the maximum, up to rounding
            return state.E, state.energy, n_iter, True
        state = tried
        if converged:
            return state.E, state.energy, n_iter, True
    return state.E, state.energy, max_iter, False


def _state(P: NDArray, rigid: NDArray, E: NDArray) -> _State:
    """Return the state at the matrix E (3, 3), divided by its norm."""
    E = E / np.linalg.norm(E)
    a, q, alpha = (each[:, 0] for each in _coefficients(P, rigid, E[None]))
    A, R = unpack(alpha**2 @ rigid), (alpha @ P).reshape(3, 3)
    return _State(E, float(alpha @ a), alpha, q, A, R)


def _steps(
    P: NDArray, rigid: NDArray, state: _State, largest_gain: float
) -> tuple[NDArray, NDArray, float]:
    """
    Return the alternation step, the Newton step and its predicted gain of energy.

    Steps are (3, 3). Half the gradient of f is ``R - A E``. Half the negative Hessian
    is ``A (x) I - S``, with ``S = sum_i w_i w_i^T / q_i`` and ``w_i = vec(M_0^iT M_ik -
    2 alpha_i M_0^iT M_0^i E)``. In coordinates where A is the identity the alternation
    step is the gradient. There the Newton step is longer by ``1 / |1 - s|`` along an
    eigenvector of S with eigenvalue s.
    """
    E, _, alpha, q, A, R = state
    # A^(-1/2), and the gradient in the coordinates where A is the identity.
    values, axes = np.linalg.eigh(A)
    inside = values > np.finfo(float).eps * 3 * values[-1]
    root = np.where(inside, 1.0 / np.sqrt(np.where(inside, values, 1.0)), 0.0)
    whitening = (axes * root) @ axes.T
    gradient = whitening @ (R - A @ E)

    # The w_i (n_frames, 9).
    Q_E = np.empty((len(alpha), 3, 3))  # M_0^iT M_0^i E
    for column in range(3):
        Q_E[:, :, column] = rigid @ _symmetric_times(E[:, column])
    w = P - 2.0 * alpha[:, None] * Q_E.reshape(-1, 9)
    weighted = np.divide(w, q[:, None], where=q[:, None] > 0, out=np.zeros_like(w))
    # S in these coordinates. f does not depend on the scale of E: the direction of E is
    # projected out.
    on_vec = np.kron(whitening, np.eye(3))
    radial = (whitening @ A @ E).ravel()
    projection = np.eye(9) - np.outer(radial, radial) / (radial @ radial)
    coordinates = on_vec @ projection
    curvature, modes = np.linalg.eigh(coordinates.T @ (w.T @ weighted) @ coordinates)
    # The Newton step along each eigenvector.
    factors = 1.0 / np.maximum(np.abs(1.0 - curvature), 1.0 / largest_gain)
    slopes = modes.T @ gradient.ravel()
    newton = (modes @ (factors * slopes)).reshape(3, 3)
    return whitening @ gradient, whitening @ newton, float(factors @ slopes**2)


def _symmetric_times(v: NDArray) -> NDArray:
    """Return T (6, 3) with ``q @ T = Q v``, for v (3,) and q a packed symmetric Q."""
    x, y, z = v
    return np.array(
        [[x, 0, 0], [0, y, 0], [0, 0, z], [y, x, 0], [z, 0, x], [0, z, y]], dtype=float
    )
