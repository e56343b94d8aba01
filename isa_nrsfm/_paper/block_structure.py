"""Block structure of the motion: 3x3 matrices that take subspaces to the rigid motion.

The motion of subspace k is known up to a 3x3 matrix. With the right D_k it is the rigid
motion times a coefficient, ``M_ik D_k ~ alpha_ik M_0^i`` (Brandt et al. 2018, appendix
A). All functions here need of each frame only the products in `MotionProducts`.
"""

from collections.abc import Callable
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import eigh

from isa_nrsfm._linalg.rounding import OF_RANKS
from isa_nrsfm._paper.options import PAPER_OPTIONS

_PACKED = ([0, 1, 2, 0, 0, 1], [0, 1, 2, 1, 2, 2])
_UNPACKED = np.array([[0, 3, 4], [3, 1, 5], [4, 5, 2]])


class MotionProducts(NamedTuple):
    """
    Products of the rigid motion M_0^i and the motion M^i of n_signals signals.

    Attributes
    ----------
    cross : ndarray of shape (n_frames, 3, n_signals)
        ``M_0^iT M^i``.
    rigid : ndarray of shape (n_frames, 6)
        ``M_0^iT M_0^i``, packed as xx, yy, zz, xy, xz, yz.
    gram : ndarray of shape (n_signals, n_signals)
        ``sum_i M^iT M^i``.
    """

    cross: NDArray
    rigid: NDArray
    gram: NDArray

    def rotated(self, components: NDArray) -> "MotionProducts":
        """Return the products for the motion ``M A`` with ``A^T = components``."""
        cross = self.cross @ components.T
        return MotionProducts(cross, self.rigid, components @ self.gram @ components.T)

    def blocks(self) -> NDArray:
        """Return ``M_0^iT M_ik`` as (n_blocks, n_frames, 9), each matrix row by row."""
        n_frames, _, n_signals = self.cross.shape
        split = self.cross.reshape(n_frames, 3, n_signals // 3, 3)
        return np.ascontiguousarray(split.transpose(2, 0, 1, 3)).reshape(
            -1, n_frames, 9
        )


def motion_products(rigid_motion: NDArray, motion: NDArray) -> MotionProducts:
    """
    Return the products that block structure and refinement need of the frames.

    Parameters
    ----------
    rigid_motion : ndarray of shape (2 * n_frames, 3)
        M_0.
    motion : ndarray of shape (2 * n_frames, n_signals)
        M'.

    Returns
    -------
    MotionProducts
        The products.
    """
    M_0 = rigid_motion.reshape(-1, 2, 3)
    transposed = M_0.transpose(0, 2, 1)
    cross = transposed @ motion.reshape(len(M_0), 2, -1)
    return MotionProducts(cross, pack(transposed @ M_0), motion.T @ motion)


def pack(symmetric: NDArray) -> NDArray:
    """Return symmetric matrices (..., 3, 3) as (..., 6): xx, yy, zz, xy, xz, yz."""
    return symmetric[..., *_PACKED]


def unpack(packed: NDArray) -> NDArray:
    """Return packed symmetric matrices (..., 6) as (..., 3, 3)."""
    return packed[..., _UNPACKED]


def packed_inner(packed: NDArray, symmetric: NDArray) -> NDArray:
    """Return ``<Q, S>`` (n, ...) of packed Q (n, 6) and symmetric S (..., 3, 3)."""
    weights = pack(symmetric) * np.array([1.0, 1.0, 1.0, 2.0, 2.0, 2.0])
    return packed @ weights.T


def recover_blocks(products: MotionProducts, method: str) -> NDArray:
    """
    Return for each subspace the matrix D_k that takes its motion to the rigid motion.

    D_k and alpha_k make ``sum_i ||M_ik D_k - alpha_ik M_0^i||_F^2`` small. The methods
    differ in how they exclude ``D_k = 0``.

    Parameters
    ----------
    products : MotionProducts
        Products of the frames after ISA; consecutive signals form a subspace.
    method : {"generalized_eigen", "eigen", "irls"}
        See `AffineNRSfM`.

    Returns
    -------
    ndarray of shape (n_blocks, 3, 3)
        D_k with ``||D_k||_F = 1``, of arbitrary sign. The zero matrix for a subspace
        without motion.
    """
    solve = _METHODS[method]
    energy = products.rigid[:, :3].sum(axis=1)  # ||M_0^i||^2
    n_blocks = products.cross.shape[2] // 3
    D = np.zeros((n_blocks, 3, 3))
    for k, P in enumerate(products.blocks()):
        block = slice(3 * k, 3 * k + 3)
        gram = products.gram[block, block]
        if np.trace(gram) > 0:
            # m_i is M_ik^T M_0^i, row by row: <M_ik D, M_0^i> = m_i . vec(D).
            m = P.reshape(-1, 3, 3).transpose(0, 2, 1).reshape(-1, 9)
            d = solve(m, energy, gram)
            D[k] = (d / np.linalg.norm(d)).reshape(3, 3)
    return D


def _eigen(m: NDArray, energy: NDArray, gram: NDArray) -> NDArray:
    """
    Return vec(D) (9,) of norm one that minimises the cost.

    With ``alpha_i = <M_ik D, M_0^i> / ||M_0^i||^2`` put in, the cost is a quadratic
    form in vec(D). Its minimiser is the eigenvector of the smallest eigenvalue. That
    may be a direction in which the subspace hardly moves.

    Here and in the other methods m is (n_frames, 9) as in `recover_blocks`, `energy`
    (n_frames,) is ``||M_0^i||^2`` and `gram` (3, 3) is ``sum_i M_ik^T M_ik``.
    """
    cost = np.kron(gram, np.eye(3)) - _explained(m, energy)
    return eigh(cost, subset_by_index=(0, 0))[1][:, 0]


def _generalized_eigen(m: NDArray, energy: NDArray, gram: NDArray) -> NDArray:
    """
    Return vec(D) (9,) for which the rigid motion explains the largest share of M_k D.

    The share is the ratio of ``sum_i <M_ik D, M_0^i>^2 / ||M_0^i||^2`` to ``sum_i
    ||M_ik D||^2``. Directions in which the subspace does not move are left out.
    """
    variance, axes = eigh(gram)
    moving = variance > OF_RANKS * variance[-1]
    whitening = np.kron(axes[:, moving] / np.sqrt(variance[moving]), np.eye(3))
    share = whitening.T @ _explained(m, energy) @ whitening
    return whitening @ eigh(share)[1][:, -1]


def _irls(
    m: NDArray, energy: NDArray, gram: NDArray, max_iter: int = 100, tol: float = 1e-12
) -> NDArray:
    """
    Return vec(D) (9,) by iteratively reweighted least squares, as published.

    A step holds alpha of the first frame, solves the linear least squares for D and the
    other alphas, and divides the held alpha by the norm of D (Brandt et al. 2018,
    appendix A). The solution is proportional to the held alpha. So the iteration ends
    after one rescaling.
    """
    cost = np.kron(gram, np.eye(3)) - _explained(m[1:], energy[1:])
    held = 1.0
    for _ in range(max_iter):
        d = np.linalg.lstsq(cost, held * m[0])[0]
        norm = float(np.linalg.norm(d))
        if norm == 0.0:  # m[0] is zero: the first frame says nothing
            return _generalized_eigen(m, energy, gram)
        held /= norm
        if abs(norm - 1.0) < tol:
            break
    return d


def _explained(m: NDArray, energy: NDArray) -> NDArray:
    """Return (9, 9): ``sum_i <M_ik D, M_0^i>^2 / ||M_0^i||^2`` as a form in vec(D)."""
    weighted = np.divide(m, energy[:, None], where=energy[:, None] > 0, out=0.0 * m)
    return m.T @ weighted


# For each of `BLOCK_RECOVERIES`.
_METHODS: dict[str, Callable[[NDArray, NDArray, NDArray], NDArray]] = {
    "generalized_eigen": _generalized_eigen,
    "eigen": _eigen,
    "irls": _irls,
}


def lifted_moments(
    products: MotionProducts, lift_ridge: float = PAPER_OPTIONS.lift_ridge
) -> NDArray:
    """
    Return the second moments of the lifted motions.

    The motion of a frame is lifted from the image to space by a regularised inverse of
    its rigid camera, ``L_i = (M_0^iT M_0^i + ridge I)^-1 M_0^iT M^i``, a 3 x n_signals
    matrix. If the motion of subspace k is ``alpha_ik M_0^i E_k``, the columns of L_i
    that belong to it are nearly ``alpha_ik E_k``, and the leading eigenvector of their
    second moments is nearly E_k.

    Parameters
    ----------
    products : MotionProducts
        Products of the frames.
    lift_ridge : float
        The ridge, relative to the energy of the camera.

    Returns
    -------
    ndarray of shape (3, 3, n_signals, n_signals)
        ``sum_i L_i[a, m] L_i[b, n]`` at (a, b, m, n).
    """
    n_frames, _, n_signals = products.cross.shape
    energy = products.rigid[:, :3].sum(axis=1)
    ridge = lift_ridge * np.where(energy > 0, energy, 1.0)
    regular = unpack(products.rigid) + ridge[:, None, None] * np.eye(3)
    L = np.linalg.solve(regular, products.cross).reshape(n_frames, -1)
    return (L.T @ L).reshape(3, n_signals, 3, n_signals).transpose(0, 2, 1, 3)


def lifted_blocks(moments: NDArray, subspaces: NDArray) -> NDArray:
    """
    Return the lifted moments of subspaces.

    Parameters
    ----------
    moments : ndarray of shape (3, 3, n_signals, n_signals)
        From `lifted_moments`.
    subspaces : ndarray of shape (n_subspaces, 3, n_signals)
        Orthonormal rows.

    Returns
    -------
    ndarray of shape (n_subspaces, 9, 9)
        Second moments of the 3x3 matrices ``L_i A_k``, row by row, where the columns
        of A_k are the rows of subspace k.
    """
    rows = subspaces[:, None, None]
    blocks = rows @ moments @ rows.swapaxes(-1, -2)  # (k, a, b, m, n)
    return blocks.transpose(0, 1, 3, 2, 4).reshape(-1, 9, 9)


def structure_energies(moments: NDArray, subspaces: NDArray) -> NDArray:
    """
    Return how much of the lifted motion of subspaces has block structure.

    Parameters
    ----------
    moments : ndarray of shape (3, 3, n_signals, n_signals)
        From `lifted_moments`.
    subspaces : ndarray of shape (n_subspaces, 3, n_signals)
        Orthonormal rows.

    Returns
    -------
    ndarray of shape (n_subspaces,)
        Largest eigenvalue of the moments of `lifted_blocks`: the energy that is a
        coefficient times one matrix E_k.
    """
    return np.linalg.eigvalsh(lifted_blocks(moments, subspaces))[:, -1]


def leading_blocks(moments: NDArray, subspaces: NDArray, n_leading: int) -> NDArray:
    """
    Return the leading eigenvectors of the lifted moments of each subspace.

    Parameters
    ----------
    moments : ndarray of shape (3, 3, n_signals, n_signals)
        From `lifted_moments`.
    subspaces : ndarray of shape (n_subspaces, 3, n_signals)
        Orthonormal rows.
    n_leading : int
        How many eigenvectors.

    Returns
    -------
    ndarray of shape (n_subspaces, n_leading, 3, 3)
        Candidates for E_k of unit norm, by decreasing eigenvalue.
    """
    vectors = np.linalg.eigh(lifted_blocks(moments, subspaces))[1]
    leading = vectors[:, :, : -n_leading - 1 : -1].swapaxes(1, 2)
    return leading.reshape(-1, n_leading, 3, 3)
