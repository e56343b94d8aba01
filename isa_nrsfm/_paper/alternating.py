"""The paper's refinement: basis blocks and coefficients by alternating least squares.

The cameras and the subspaces are fixed. For each subspace k the cost

    sum_i ||M_ik - alpha_ik M_0^i E_k||_F^2

is minimised over alpha and the 3x3 matrix E (Brandt et al. 2018, section 3.5). With the
optimal alpha, this is equivalent to maximising the explained energy

    f(E) = sum_i <M_ik, M_0^i E>^2 / ||M_0^i E||^2

A step takes the best alpha for E, then ``E = A^-1 R`` with ``A = sum_i alpha_i^2 M_0^iT
M_0^i`` and ``R = sum_i alpha_i M_0^iT M_ik``. It never lowers f.
"""

import numpy as np
from numpy.typing import NDArray

from isa_nrsfm._paper.block_structure import MotionProducts


def refine_alternating(
    products: MotionProducts, starts: NDArray, *, max_iter: int, tol: float
) -> tuple[NDArray, NDArray, int, bool]:
    """Return the blocks that explain most of the motion, each from several starts.

    From the starts (n_blocks, n_starts, 3, 3), the best one after six steps is used. A
    block has converged when a step gains less than `tol` of its energy.

    Returns the blocks E (n_blocks, 3, 3) of unit norm and arbitrary sign, ``M_ik ~
    alpha_ik M_0^i E_k``, zero for a subspace without motion; their energies ``sum_i
    ||alpha_ik M_0^i E_k||^2`` (n_blocks,); the largest number of steps; and
    convergence.
    """
    E, energy = np.zeros((len(starts), 3, 3)), np.zeros(len(starts))
    n_iter, converged = 1, True
    for k, P in enumerate(products.blocks()):
        tried = starts[k]
        for _ in range(6):
            _, tried = _step(P, products.rigid, tried)
        energies, after = _step(P, products.rigid, tried)
        best = np.argmax(energies)
        energy[k], after = energies[best], after[best : best + 1]
        if not energy[k] > 0:
            continue
        for n_steps in range(1, max_iter + 1):
            n_iter = max(n_iter, n_steps)
            E[k], before = after[0], energy[k]
            (energy[k],), after = _step(P, products.rigid, after)
            if energy[k] - before <= tol * energy[k]:
                break
        else:
            converged = False
    return E, energy, n_iter, converged


def _step(P: NDArray, rigid: NDArray, E: NDArray) -> tuple[NDArray, NDArray]:
    """Return energies (n,) of E (n, 3, 3), and E after a step, of unit norm."""
    inner = P @ E.reshape(-1, 9).T  # <M_ik, M_0^i E>
    square = rigid @ (E @ E.swapaxes(1, 2)).reshape(-1, 9).T  # ||M_0^i E||^2
    alpha = np.divide(inner, square, where=square > 0, out=np.zeros_like(inner))
    A, R = (alpha**2).T @ rigid, alpha.T @ P
    after = np.linalg.pinv(A.reshape(-1, 3, 3), hermitian=True) @ R.reshape(-1, 3, 3)
    norm = np.linalg.norm(after, axis=(1, 2), keepdims=True)
    return np.sum(alpha * inner, axis=0), after / np.where(norm > 0, norm, 1.0)
