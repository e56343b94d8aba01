"""Block-sparse dictionary learning: frames as sums of few atoms of three rows each.

A frame W_i (2 x J) is ``sum_l P_il D_l`` with 2x3 blocks P_il of which at most s are
not zero, and atoms D_l (3 x J). Both are found by block K-SVD from the solution of a
relaxed problem (Kong, Lucey, "Prior-less compressible structure from motion", 2016;
Aharon, Elad, Bruckstein, "K-SVD", 2006). Everything is invariant to rotations of the
space of the J points: the frames may be given in any orthonormal basis of it.
"""

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

# The penalty for blocks and atoms that differ from their copies: the first, and how it
# grows with each step. With 1.02 the steps end far from where the gradient vanishes.
FIRST_PENALTY, GROWTH = 1.0, 1.001
# The relaxed problem is solved when no entry of blocks or atoms changes, or differs
# from its copy, by more than this.
SETTLED = 1e-6
MAX_RELAXED_STEPS = 1000
# Of the blocks of a frame this share is kept from one reweighting to the next; those
# kept in the end are reweighted so many times.
KEPT = 0.7
LAST_REWEIGHTINGS = 12
# Frames that an atom and its metric need.
FEWEST_FRAMES = 3


class BlockCode(NamedTuple):
    """
    Blocks of frames over a dictionary.

    Attributes
    ----------
    blocks : ndarray of shape (n_frames, n_atoms, 2, 3)
        P_il, zero where not active.
    active : ndarray of bool, shape (n_frames, n_atoms)
        Whether a frame uses an atom; each uses at least one.
    """

    blocks: NDArray
    active: NDArray


class BlockDictionary(NamedTuple):
    """
    Result of block K-SVD.

    Attributes
    ----------
    atoms : ndarray of shape (n_atoms, 3, n_points)
        D_l, orthonormal rows.
    code : BlockCode
        Blocks of the frames.
    residual : float
        ``sum_i ||W_i - sum_l P_il D_l||^2 / sum_i ||W_i||^2``.
    n_iter : int
        Number of sweeps.
    """

    atoms: NDArray
    code: BlockCode
    residual: float
    n_iter: int


def shrink_blocks(blocks: NDArray, threshold: float) -> NDArray:
    """
    Return the blocks shortened by a threshold, those that are not longer as zeros.

    Parameters
    ----------
    blocks : ndarray of shape (..., 2, 3)
        Blocks P.
    threshold : float
        Not negative.

    Returns
    -------
    ndarray of shape (..., 2, 3)
        For each block the minimiser Z of ``threshold * ||Z||_F + ||Z - P||_F^2 / 2``.
    """
    norms = np.linalg.norm(blocks, axis=(-2, -1), keepdims=True)
    rest = np.maximum(norms - threshold, 0.0)
    return blocks * np.divide(rest, norms, out=np.zeros_like(norms), where=norms > 0)


def group_sparse_factors(
    frames: NDArray,
    n_atoms: int,
    penalty: float,
    random_state: np.random.RandomState,
    most_frames: int = 1000,
) -> tuple[NDArray, NDArray]:
    """
    Solve the relaxed problem, in which the norms of the blocks are penalised.

    Parameters
    ----------
    frames : ndarray of shape (n_frames, 2, n_points)
        W_i, of mean square norm one.
    n_atoms : int
        Number of atoms.
    penalty : float
        Price gamma of the norm of a block.
    random_state : RandomState
        Draws the atoms to start from.
    most_frames : int, default=1000
        Of more frames so many are drawn, and the problem is solved for these.

    Returns
    -------
    blocks : ndarray of shape (n_frames, n_atoms, 2, 3)
        P_il.
    atoms : ndarray of shape (n_atoms, 3, n_points)
        D_l with ``||D_l||_F <= 1``. Together they are, nearly, a stationary point of
        ``sum_i (||W_i - sum_l P_il D_l||_F^2 / 2 + gamma sum_l ||P_il||_F)``, by the
        alternating direction method of multipliers with copies of blocks and atoms.
    """
    if len(frames) > most_frames:
        frames = frames[random_state.permutation(len(frames))[:most_frames]]
    n_points = frames.shape[2]
    W = frames.reshape(-1, n_points)
    D = random_state.standard_normal((3 * n_atoms, n_points))
    D = D_copy = _within_unit_norm(D * n_points, n_atoms)
    P_copy = W @ np.linalg.pinv(D)
    P_dual, D_dual = np.zeros_like(P_copy), np.zeros_like(D)
    rho, eye = FIRST_PENALTY, np.eye(3 * n_atoms)
    for _ in range(MAX_RELAXED_STEPS):
        P_last, D_last = P_copy, D_copy
        right = W @ D_copy.T + rho * (P_copy - P_dual)
        P = np.linalg.solve(D_copy @ D_copy.T + rho * eye, right.T).T
        P_copy = _join(shrink_blocks(_split(P + P_dual), penalty / rho))
        right = P_copy.T @ W + rho * (D_copy - D_dual)
        D = np.linalg.solve(P_copy.T @ P_copy + rho * eye, right)
        D_copy = _within_unit_norm(D + D_dual, n_atoms)
        changes = (P - P_copy, D - D_copy, P_copy - P_last, D_copy - D_last)
        if max(np.abs(change).max() for change in changes) < SETTLED:
            break
        # The multipliers are rho times these, and go on as they are when rho grows.
        P_dual = (P_dual + changes[0]) / GROWTH
        D_dual = (D_dual + changes[1]) / GROWTH
        rho *= GROWTH
    return _split(P_copy), D_copy.reshape(n_atoms, 3, n_points)


def _split(motion: NDArray) -> NDArray:
    """Return the motion (2 * n_frames, 3 * n_atoms) as blocks."""
    return motion.reshape(len(motion) // 2, 2, -1, 3).transpose(0, 2, 1, 3)


def _join(blocks: NDArray) -> NDArray:
    """Return blocks as the motion (2 * n_frames, 3 * n_atoms)."""
    return blocks.transpose(0, 2, 1, 3).reshape(2 * len(blocks), -1)


def _within_unit_norm(rows: NDArray, n_atoms: int) -> NDArray:
    """Return atoms (3 * n_atoms, n_points), those longer than one cut to that."""
    atoms = rows.reshape(n_atoms, -1)
    norms = np.linalg.norm(atoms, axis=1, keepdims=True)
    return (atoms / np.maximum(norms, 1.0)).reshape(rows.shape)


def code_frames(
    frames: NDArray, atoms: NDArray, sparsity: int, ridge: float, batch: int = 1000
) -> BlockCode:
    """
    Find a few blocks for each frame by reweighted ridge regression.

    Parameters
    ----------
    frames : ndarray of shape (n_frames, 2, n_points)
        W_i, none of them zero.
    atoms : ndarray of shape (n_atoms, 3, n_points)
        D_l, orthonormal rows.
    sparsity : int
        The most blocks of a frame.
    ridge : float
        Price of a block, as a share of the frame's energy.
    batch : int, default=1000
        Frames that are coded at a time, so that their equations need little memory.

    Returns
    -------
    BlockCode
        In turns the minimisers P_il of ``||W_i - sum_l P_il D_l||_F^2 + ridge *
        ||W_i||_F^2 sum_l ||P_il||_F^2 / w_il^2``, where w_il is the norm that P_il had
        before, and a choice of the largest blocks, ever fewer (Gorodnitsky, Rao,
        "Sparse signal reconstruction from limited data using FOCUSS", 1997). Blocks
        that vanish are not active. A block that alone explains a share x of the frame
        has the share ``(x + sqrt(x^2 - 4 x ridge)) / 2 - ridge`` in the end, and
        vanishes if x is less than four times `ridge`. A frame whose blocks all vanish
        gets that of the one atom that explains most of it, without a price.
    """
    n_frames, n_atoms = len(frames), len(atoms)
    rows = atoms.reshape(3 * n_atoms, -1)
    gram = (rows @ rows.T).reshape(n_atoms, 3, n_atoms, 3).transpose(0, 2, 1, 3)
    code = BlockCode(
        np.zeros((n_frames, n_atoms, 2, 3)), np.zeros((n_frames, n_atoms), dtype=bool)
    )
    for first in range(0, n_frames, batch):
        part = slice(first, first + batch)
        norms = np.linalg.norm(frames[part], axis=(1, 2))[:, None, None]
        right = (frames[part] / norms) @ rows.T
        right = right.reshape(-1, 2, n_atoms, 3).transpose(0, 2, 3, 1)
        blocks, chosen, active = _reweighted_ridge(gram, right, sparsity, ridge)
        np.put_along_axis(code.active[part], chosen, active, 1)
        blocks = blocks * (norms[..., None] * active[..., None, None])
        np.put_along_axis(code.blocks[part], chosen[..., None, None], blocks, 1)

        lost = np.flatnonzero(~active.any(axis=1))
        best = np.linalg.norm(right[lost], axis=(2, 3)).argmax(axis=1)
        code.active[first + lost, best] = True
        blocks = right[lost, best].transpose(0, 2, 1) * norms[lost]
        code.blocks[first + lost, best] = blocks
    return code


def _reweighted_ridge(
    gram: NDArray, right: NDArray, sparsity: int, ridge: float
) -> tuple[NDArray, NDArray, NDArray]:
    """
    Return blocks of frames of norm one, their atoms, and which of them are active.

    `gram` (n_atoms, n_atoms, 3, 3) has the products ``D_l D_m^T``, `right` (n_frames,
    n_atoms, 3, 2) the ``D_l W_i^T``. With ``P_il = w_il Z_il`` the equations stay well
    conditioned when weights vanish: ``(w G w + ridge) Z = w D W^T``.
    """
    n_frames, size = right.shape[:2]
    chosen = np.tile(np.arange(size), (n_frames, 1))
    weights = np.ones((n_frames, size))
    n_left = LAST_REWEIGHTINGS
    while n_left:
        products = gram[chosen[:, :, None], chosen[:, None, :]]
        products = products * (weights[:, :, None] * weights[:, None])[..., None, None]
        equations = products.transpose(0, 1, 3, 2, 4).reshape(
            n_frames, 3 * size, 3 * size
        )
        diagonal = np.arange(3 * size)
        equations[:, diagonal, diagonal] += ridge
        weighted = (right * weights[..., None, None]).reshape(n_frames, 3 * size, 2)
        Z = np.linalg.solve(equations, weighted).reshape(right.shape)
        blocks = Z * weights[..., None, None]
        weights = np.linalg.norm(blocks, axis=(2, 3))
        if size <= sparsity:
            n_left -= 1
            continue
        size = max(sparsity, int(KEPT * size))
        kept = np.sort(np.argsort(-weights, axis=1, kind="stable")[:, :size], axis=1)
        chosen = np.take_along_axis(chosen, kept, axis=1)
        weights = np.take_along_axis(weights, kept, axis=1)
        right = np.take_along_axis(right, kept[..., None, None], 1)
    # At the end of the reweighting the norm of a block is ridge over that of its
    # product with the residual, which is less than one: a smaller one is vanishing.
    return blocks.transpose(0, 1, 3, 2), chosen, weights > ridge


def update_atoms(
    frames: NDArray, atoms: NDArray, code: BlockCode, replace: bool = True
) -> tuple[NDArray, BlockCode, NDArray]:
    """
    Fit the atoms and their blocks, one after the other, to what the others leave.

    Parameters
    ----------
    frames : ndarray of shape (n_frames, 2, n_points)
        W_i.
    atoms : ndarray of shape (n_atoms, 3, n_points)
        D_l, orthonormal rows.
    code : BlockCode
        Blocks of the frames.
    replace : bool, default=True
        Whether an atom that fewer than three frames use is replaced by the three main
        directions of the two frames that are fitted worst, and for now used by none.

    Returns
    -------
    atoms : ndarray of shape (n_atoms, 3, n_points)
        For each atom that is kept the rows, orthonormal, that with its blocks give the
        best approximation of rank three to what the others leave of its frames; the
        sum of squared residuals never rises.
    code : BlockCode
        The blocks, active where they were but for atoms that have been replaced.
    residuals : ndarray of shape (n_frames, 2, n_points)
        What is left of the frames.
    """
    atoms, blocks, active = atoms.copy(), code.blocks.copy(), code.active.copy()
    residuals = frames - np.einsum("ilrc,lcp->irp", blocks, atoms, optimize=True)
    n_replaced = 0
    for atom in range(len(atoms)):
        users = np.flatnonzero(active[:, atom])
        rest = residuals[users] + blocks[users, atom] @ atoms[atom]
        if replace and len(users) < FEWEST_FRAMES:
            active[users, atom], blocks[users, atom] = False, 0.0
            residuals[users] = rest
            atoms[atom] = _worst_directions(frames, residuals, n_replaced)
            n_replaced += 1
            continue
        atoms[atom], blocks[users, atom] = _rank_three(rest, atoms[atom])
        residuals[users] = rest - blocks[users, atom] @ atoms[atom]
    return atoms, BlockCode(blocks, active), residuals


def _rank_three(rest: NDArray, atom: NDArray) -> tuple[NDArray, NDArray]:
    """Return three orthonormal rows and blocks of frames that fit them best."""
    rows = rest.reshape(-1, rest.shape[2])
    if len(rows) >= 3:
        triangle = np.linalg.qr(rows, mode="r") if len(rows) > rows.shape[1] else rows
        atom = np.linalg.svd(triangle, full_matrices=False)[2][:3]
    return atom, rest @ atom.T


def _worst_directions(frames: NDArray, residuals: NDArray, n_before: int) -> NDArray:
    """Return three directions of the two worst fitted frames, after so many pairs."""
    order = np.argsort(-np.sum(residuals**2, axis=(1, 2)), kind="stable")
    pair = np.take(order, [2 * n_before, 2 * n_before + 1], mode="wrap")
    rows = frames[pair].reshape(-1, frames.shape[2])
    return np.linalg.svd(rows, full_matrices=False)[2][:3]


def block_ksvd(
    frames: NDArray,
    atoms: NDArray,
    sparsity: int,
    *,
    ridge: float,
    max_iter: int,
    tol: float,
) -> BlockDictionary:
    """
    Learn a dictionary in which each frame is a sum of a few blocks.

    Parameters
    ----------
    frames : ndarray of shape (n_frames, 2, n_points)
        W_i, none of them zero.
    atoms : ndarray of shape (n_atoms, 3, n_points)
        Atoms to start from.
    sparsity : int
        The most blocks of a frame.
    ridge : float
        Of `code_frames`.
    max_iter : int
        The most sweeps: coding of the frames, then update of the atoms.
    tol : float
        Relative change of the sum of squared residuals in a sweep below which one more
        is made, the last.

    Returns
    -------
    BlockDictionary
        Atoms and blocks after the last sweep, in which no atom is replaced.
    """
    atoms = np.linalg.svd(atoms, full_matrices=False)[2]
    energy = float(np.sum(frames**2))
    residual, settled = np.inf, False
    for n_iter in range(1, max_iter + 1):
        last = settled or n_iter == max_iter
        code = code_frames(frames, atoms, sparsity, ridge)
        atoms, code, residuals = update_atoms(frames, atoms, code, replace=not last)
        before, residual = residual, float(np.sum(residuals**2)) / energy
        if last:
            break
        settled = abs(before - residual) <= tol * residual
    return BlockDictionary(atoms, code, residual, n_iter)
