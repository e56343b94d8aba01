"""Block-sparse dictionary learning: frames as sums of few atoms of three rows each.

A frame W_i (2 x J) is ``sum_l P_il D_l`` with 2x3 blocks P_il of which at most s are
non-zero, and atoms D_l (3 x J). Both are found by block K-SVD from the solution of a
relaxed problem (Kong, Lucey, "Prior-less compressible structure from motion", 2016;
Aharon, Elad, Bruckstein, "K-SVD", 2006). Everything is invariant to rotations of the
space of the J points: the frames may be given in any orthonormal basis of it.

Shapes of arrays: frames (n_frames, 2, n_points), atoms (n_atoms, 3, n_points), blocks
(n_frames, n_atoms, 2, 3), zero where not active, active (n_frames, n_atoms).
"""

import numpy as np
from numpy.typing import NDArray

# Growth of the penalty in each step; with 1.02 the end is far from stationary.
GROWTH = 1.001


def shrink_blocks(blocks: NDArray, threshold: float) -> NDArray:
    """Return the minimisers Z of ``threshold * ||Z||_F + ||Z - P||_F^2 / 2``."""
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
    """Solve the relaxed problem: return blocks, and atoms with ``||D_l||_F <= 1``.

    They nearly minimise ``sum_i (||W_i - sum_l P_il D_l||_F^2 / 2 + penalty sum_l
    ||P_il||_F)``, for frames of mean square norm one, by the alternating direction
    method of multipliers. Of more than `most_frames` frames a random subset is used.
    """
    if len(frames) > most_frames:
        frames = frames[random_state.permutation(len(frames))[:most_frames]]
    n_points = frames.shape[2]
    W = frames.reshape(-1, n_points)
    D = random_state.standard_normal((3 * n_atoms, n_points))
    D = D_copy = _within_unit_norm(D * n_points, n_atoms)
    P_copy = W @ np.linalg.pinv(D)
    P_dual, D_dual = np.zeros_like(P_copy), np.zeros_like(D)
    rho, eye = 1.0, np.eye(3 * n_atoms)
    for _ in range(1000):
        P_last, D_last = P_copy, D_copy
        right = W @ D_copy.T + rho * (P_copy - P_dual)
        P = np.linalg.solve(D_copy @ D_copy.T + rho * eye, right.T).T
        blocks = shrink_blocks(_split(P + P_dual), penalty / rho)
        P_copy = blocks.transpose(0, 2, 1, 3).reshape(P.shape)
        right = P_copy.T @ W + rho * (D_copy - D_dual)
        D = np.linalg.solve(P_copy.T @ P_copy + rho * eye, right)
        D_copy = _within_unit_norm(D + D_dual, n_atoms)
        changes = (P - P_copy, D - D_copy, P_copy - P_last, D_copy - D_last)
        if max(np.abs(change).max() for change in changes) < 1e-6:
            break
        # The multipliers are rho times these, and stay the same when rho grows.
        P_dual = (P_dual + changes[0]) / GROWTH
        D_dual = (D_dual + changes[1]) / GROWTH
        rho *= GROWTH
    return _split(P_copy), D_copy.reshape(n_atoms, 3, n_points)


def _split(motion: NDArray) -> NDArray:
    """Return the motion (2 * n_frames, 3 * n_atoms) as blocks."""
    return motion.reshape(len(motion) // 2, 2, -1, 3).transpose(0, 2, 1, 3)


def _within_unit_norm(rows: NDArray, n_atoms: int) -> NDArray:
    """Return atoms (3 * n_atoms, n_points), the norms limited to one."""
    atoms = rows.reshape(n_atoms, -1)
    norms = np.linalg.norm(atoms, axis=1, keepdims=True)
    return (atoms / np.maximum(norms, 1.0)).reshape(rows.shape)


def code_frames(
    frames: NDArray, atoms: NDArray, sparsity: int, ridge: float, batch: int = 1000
) -> tuple[NDArray, NDArray]:
    """Find at most `sparsity` blocks for each frame by reweighted ridge regression.

    Alternately ``||W_i - sum_l P_il D_l||_F^2 + ridge * ||W_i||_F^2 sum_l ||P_il||_F^2
    / w_il^2`` is minimised, where w_il is the previous norm of P_il, and the largest
    blocks are selected, ever fewer (Gorodnitsky, Rao, "Sparse signal reconstruction
    from limited data using FOCUSS", 1997). A block that alone explains a share x of the
    frame ends with the share ``(x + sqrt(x^2 - 4 x ridge)) / 2 - ridge``, or zero if x
    is below four times `ridge`. A frame without blocks gets that of its best atom.
    Atoms have orthonormal rows, frames are non-zero. Returns blocks and a mask of
    active ones.
    """
    n_frames, n_atoms = len(frames), len(atoms)
    rows = atoms.reshape(3 * n_atoms, -1)
    gram = (rows @ rows.T).reshape(n_atoms, 3, n_atoms, 3).transpose(0, 2, 1, 3)
    blocks = np.zeros((n_frames, n_atoms, 2, 3))
    active = np.zeros((n_frames, n_atoms), dtype=bool)
    for first in range(0, n_frames, batch):
        part = slice(first, first + batch)
        norms = np.linalg.norm(frames[part], axis=(1, 2))[:, None, None]
        right = (frames[part] / norms) @ rows.T
        right = right.reshape(-1, 2, n_atoms, 3).transpose(0, 2, 3, 1)
        found, chosen, kept = _reweighted_ridge(gram, right, sparsity, ridge)
        np.put_along_axis(active[part], chosen, kept, 1)
        found = found * (norms[..., None] * kept[..., None, None])
        np.put_along_axis(blocks[part], chosen[..., None, None], found, 1)

        lost = np.flatnonzero(~kept.any(axis=1))
        best = np.linalg.norm(right[lost], axis=(2, 3)).argmax(axis=1)
        active[first + lost, best] = True
        blocks[first + lost, best] = right[lost, best].transpose(0, 2, 1) * norms[lost]
    return blocks, active


def _reweighted_ridge(
    gram: NDArray, right: NDArray, sparsity: int, ridge: float
) -> tuple[NDArray, NDArray, NDArray]:
    """Return blocks of frames of norm one, their atoms, and which of them are active.

    From ``D_l D_m^T`` (n_atoms, n_atoms, 3, 3) and ``D_l W_i^T`` (n_frames, n_atoms, 3,
    2). With ``P_il = w_il Z_il`` the equations ``(w G w + ridge) Z = w D W^T`` stay
    well conditioned when weights vanish.
    """
    n_frames, size = right.shape[:2]
    chosen = np.tile(np.arange(size), (n_frames, 1))
    weights = np.ones((n_frames, size))
    n_left = 12  # reweightings of the blocks that are kept
    while n_left:
        products = gram[chosen[:, :, None], chosen[:, None, :]]
        products = products * (weights[:, :, None] * weights[:, None])[..., None, None]
        equations = products.swapaxes(2, 3).reshape(n_frames, 3 * size, 3 * size)
        np.einsum("ijj->ij", equations)[...] += ridge
        weighted = (right * weights[..., None, None]).reshape(n_frames, 3 * size, 2)
        Z = np.linalg.solve(equations, weighted).reshape(right.shape)
        blocks = Z * weights[..., None, None]
        weights = np.linalg.norm(blocks, axis=(2, 3))
        if size <= sparsity:
            n_left -= 1
            continue
        size = max(sparsity, int(0.7 * size))
        kept = np.sort(np.argsort(-weights, axis=1, kind="stable")[:, :size], axis=1)
        chosen = np.take_along_axis(chosen, kept, axis=1)
        weights = np.take_along_axis(weights, kept, axis=1)
        right = np.take_along_axis(right, kept[..., None, None], 1)
    # At convergence the norm of a block is ridge over that of its product with the
    # residual, which is less than one: a smaller block is vanishing.
    return blocks.transpose(0, 1, 3, 2), chosen, weights > ridge


def update_atoms(
    frames: NDArray,
    atoms: NDArray,
    blocks: NDArray,
    active: NDArray,
    replace: bool = True,
) -> tuple[NDArray, NDArray, NDArray, NDArray]:
    """Fit each atom and its blocks in turn to the residual of the others.

    Returns atoms, blocks, active, and residuals. An atom becomes the orthonormal rows
    of the best approximation of rank three; the sum of squared residuals never
    increases. With `replace`, an atom of fewer than three frames becomes the three main
    directions of the two frames with the largest residuals, and is inactive.
    """
    atoms, blocks, active = atoms.copy(), blocks.copy(), active.copy()
    residuals = frames - np.einsum("ilrc,lcp->irp", blocks, atoms, optimize=True)
    n_replaced = 0
    for atom in range(len(atoms)):
        users = np.flatnonzero(active[:, atom])
        rest = residuals[users] + blocks[users, atom] @ atoms[atom]
        # An atom and its metric need three frames.
        if replace and len(users) < 3:
            active[users, atom], blocks[users, atom] = False, 0.0
            residuals[users] = rest
            worst = np.argsort(-np.sum(residuals**2, axis=(1, 2)), kind="stable")
            pair = np.take(worst, 2 * n_replaced + np.arange(2), mode="wrap")
            atoms[atom] = _main_directions(frames[pair])
            n_replaced += 1
            continue
        if 2 * len(users) >= 3:
            atoms[atom] = _main_directions(rest)
        blocks[users, atom] = rest @ atoms[atom].T
        residuals[users] = rest - blocks[users, atom] @ atoms[atom]
    return atoms, blocks, active, residuals


def _main_directions(frames: NDArray) -> NDArray:
    """Return the first three right singular vectors of frames, three rows or more."""
    rows = frames.reshape(-1, frames.shape[2])
    triangle = np.linalg.qr(rows, mode="r") if len(rows) > rows.shape[1] else rows
    return np.linalg.svd(triangle, full_matrices=False)[2][:3]


def block_ksvd(
    frames: NDArray,
    atoms: NDArray,
    sparsity: int,
    ridge: float,
    max_iter: int,
    tol: float,
) -> tuple[NDArray, NDArray, NDArray, float, int]:
    """Learn a dictionary by which each frame is a sum of at most `sparsity` blocks.

    A sweep codes the frames, then updates the atoms. Sweeps end one after the relative
    change of the residual falls to `tol`; in the last one no atom is replaced. Returns
    atoms, blocks, active, the residual share of the energy, and the number of sweeps.
    """
    atoms = np.linalg.svd(atoms, full_matrices=False)[2]
    energy = float(np.sum(frames**2))
    residual, settled = np.inf, False
    for n_iter in range(1, max_iter + 1):
        last = settled or n_iter == max_iter
        blocks, active = code_frames(frames, atoms, sparsity, ridge)
        atoms, blocks, active, residuals = update_atoms(
            frames, atoms, blocks, active, replace=not last
        )
        before, residual = residual, float(np.sum(residuals**2)) / energy
        if last:
            break
        settled = abs(before - residual) <= tol * residual
    return atoms, blocks, active, residual, n_iter
