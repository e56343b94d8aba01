"""Block structure of the motion: 3x3 matrices that map subspaces to the rigid motion.

With the right D_k the motion of subspace k is the rigid motion times a coefficient,
``M_ik D_k ~ alpha_ik M_0^i`` (Brandt et al. 2018, appendix A).
"""

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import eigh

from isa_nrsfm._linalg.rounding import OF_RANKS


class MotionProducts(NamedTuple):
    """Products of the rigid motion M_0^i and the motion M^i of n_signals signals.

    ``M_0^iT M^i`` (I, 3, n_signals), ``M_0^iT M_0^i`` (I, 9), row by row, and ``sum_i
    M^iT M^i`` (n_signals, n_signals).
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

    def rigid_energies(self) -> NDArray:
        """Return ``||M_0^i||^2`` (n_frames,)."""
        return np.asarray(self.rigid[:, ::4].sum(axis=1))


def motion_products(rigid_motion: NDArray, motion: NDArray) -> MotionProducts:
    """Return the products for M_0 (2 n_frames, 3) and M (2 n_frames, n_signals)."""
    M_0 = rigid_motion.reshape(-1, 2, 3)
    transposed = M_0.transpose(0, 2, 1)
    cross = transposed @ motion.reshape(len(M_0), 2, -1)
    return MotionProducts(cross, (transposed @ M_0).reshape(-1, 9), motion.T @ motion)


def recover_blocks(products: MotionProducts, method: str) -> NDArray:
    """
    Return D_k (n_blocks, 3, 3) that maps the motion of subspaces to the rigid motion.

    D_k and alpha_k make ``sum_i ||M_ik D_k - alpha_ik M_0^i||_F^2`` small. With the
    optimal alpha_k, this is a quadratic form in vec(D_k). The methods
    `BLOCK_RECOVERIES` differ in how they exclude ``D_k = 0``. D_k has norm one and
    arbitrary sign, and is zero for a subspace without motion.
    """
    energy = products.rigid_energies()
    blocks = products.blocks()
    D = np.zeros((len(blocks), 3, 3))
    for k, P in enumerate(blocks):
        gram = products.gram[3 * k : 3 * k + 3, 3 * k : 3 * k + 3]
        if not np.trace(gram) > 0:
            continue
        # m_i is M_ik^T M_0^i, row by row: <M_ik D, M_0^i> = m_i . vec(D).
        m = P.reshape(-1, 3, 3).transpose(0, 2, 1).reshape(-1, 9)
        moved = np.kron(gram, np.eye(3))  # sum_i ||M_ik D||^2 as a form in vec(D)
        if method == "eigen":
            # The exact minimiser under ||D|| = 1. It may be a direction in which the
            # subspace hardly moves.
            d = eigh(moved - _explained(m, energy))[1][:, 0]
        elif method == "irls" and m[0].any():
            # As published (appendix A): with alpha of the first frame fixed, D solves a
            # linear least squares problem, and alpha is divided by the norm of D. D is
            # proportional to the fixed alpha, so the iteration ends after one step.
            d = np.linalg.lstsq(moved - _explained(m[1:], energy[1:]), m[0])[0]
        else:
            # The largest share of the motion M_k D that the rigid motion explains,
            # without directions in which the subspace does not move.
            variance, axes = eigh(gram)
            moving = variance > OF_RANKS * variance[-1]
            white = np.kron(axes[:, moving] / np.sqrt(variance[moving]), np.eye(3))
            d = white @ eigh(white.T @ _explained(m, energy) @ white)[1][:, -1]
        D[k] = (d / np.linalg.norm(d)).reshape(3, 3)
    return D


def _explained(m: NDArray, energy: NDArray) -> NDArray:
    """Return (9, 9): ``sum_i <M_ik D, M_0^i>^2 / ||M_0^i||^2`` as a form in vec(D)."""
    weighted = np.divide(m, energy[:, None], where=energy[:, None] > 0, out=0.0 * m)
    return m.T @ weighted


def lifted_moments(products: MotionProducts) -> NDArray:
    """Return second moments ``sum_i L_i[a, m] L_i[b, n]`` (3, 3, n_signals, n_signals).

    ``L_i = (M_0^iT M_0^i + ridge I)^-1 M_0^iT M^i`` lifts the motion of a frame from
    the image to space. If the motion of subspace k is ``alpha_ik M_0^i E_k``, its
    columns of L_i are nearly ``alpha_ik E_k``, and the leading eigenvector of their
    moments E_k.
    """
    n_frames, _, n_signals = products.cross.shape
    energy = products.rigid_energies()
    ridge = 0.1 * np.where(energy > 0, energy, 1.0)
    regular = products.rigid.reshape(-1, 3, 3) + ridge[:, None, None] * np.eye(3)
    L = np.linalg.solve(regular, products.cross).reshape(n_frames, -1)
    return (L.T @ L).reshape(3, n_signals, 3, n_signals).transpose(0, 2, 1, 3)


def lifted_blocks(moments: NDArray, subspaces: NDArray) -> NDArray:
    """Return the lifted moments (n, 9, 9) of subspaces (n, 3, n_signals).

    These are the second moments of the 3x3 matrices ``L_i A_k``, row by row, where the
    columns of A_k are the rows of subspace k.
    """
    rows = subspaces[:, None, None]
    blocks = rows @ moments @ rows.swapaxes(-1, -2)  # (k, a, b, m, n)
    return blocks.transpose(0, 1, 3, 2, 4).reshape(-1, 9, 9)


def structure_energies(moments: NDArray, subspaces: NDArray) -> NDArray:
    """Return the largest eigenvalues (n,) of `lifted_blocks`: energies of blocks."""
    return np.linalg.eigvalsh(lifted_blocks(moments, subspaces))[:, -1]


def leading_blocks(moments: NDArray, subspaces: NDArray, n_leading: int = 2) -> NDArray:
    """Return leading eigenvectors (n, n_leading, 3, 3) of `lifted_blocks`, for E_k."""
    vectors = np.linalg.eigh(lifted_blocks(moments, subspaces))[1]
    leading = vectors[:, :, : -n_leading - 1 : -1].swapaxes(1, 2)
    return leading.reshape(-1, n_leading, 3, 3)
