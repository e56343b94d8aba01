"""The paper's pipeline: factorisation, independent subspaces, block structure.

Brandt, Ackermann, Grasshof, "Uncalibrated Non-Rigid Factorisation by Independent
Subspace Analysis" (2018).

Factorisation of the measurement matrix by one SVD: the rigid part is that of Tomasi and
Kanade (1992), the non-rigid part consists of the next 3K singular triplets (section 3).
The matrix of a large table is read in blocks, and its factors are those of a sample of
its frames, spread evenly from the most to the least rigid one: their order does not
matter.

Block structure: with the right 3x3 matrix D_k the motion of subspace k is the rigid
motion times a coefficient, ``M_ik D_k ~ alpha_ik M_0^i`` (appendix A).

Refinement by alternating least squares (section 3.5). The cameras and the subspaces are
fixed. For each subspace k the cost

    sum_i ||M_ik - alpha_ik M_0^i E_k||_F^2

is minimised over alpha and the 3x3 matrix E. With the optimal alpha, this is equivalent
to maximising the explained energy

    f(E) = sum_i <M_ik, M_0^i E>^2 / ||M_0^i E||^2

A step takes the best alpha for E, then ``E = A^-1 R`` with ``A = sum_i alpha_i^2 M_0^iT
M_0^i`` and ``R = sum_i alpha_i M_0^iT M_ik``. It never lowers f.
"""

import warnings
from functools import partial
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import eigh, null_space
from sklearn.exceptions import ConvergenceWarning
from sklearn.utils.validation import has_fit_parameter

from isa_nrsfm._compat.scikit_learn import Progress
from isa_nrsfm._linalg import OF_RANKS, energies, orientations, polar
from isa_nrsfm._tables import FrameBlocks, spread

# Larger matrices, with more rows and more columns, are not factorised as a whole.
DENSE = 1500
# Leading singular values of a matrix (k,), decreasing, their right vectors (k,
# n_columns), and the sum of the other squared values. Fewer if the rank is lower.
Triplets = tuple[NDArray, NDArray, float]


class Factorisation(NamedTuple):
    """Rigid and non-rigid part of W, ``W ~ M_0 B_0 + M' B'`` of rank 3K + 3.

    rigid_motion (2I, 3): M_0, two rows per frame; columns are orthogonal. rigid_shape
    (3, J): B_0, centred and white: ``B_0 B_0^T = n_points I``. Rows are zero where W
    has a rank below 3. motion (2I, n_signals): M', by decreasing column norm. signals
    (n_signals, J): B', centred and white, orthogonal to B_0. `n_signals` is 3K, or
    where W has a lower rank the least multiple of three above it.
    """

    rigid_motion: NDArray
    rigid_shape: NDArray
    motion: NDArray
    signals: NDArray

    @property
    def cameras(self) -> NDArray:
        """Rigid cameras (I, 2, 3)."""
        return self.rigid_motion.reshape(-1, 2, 3)

    def leading(self, n: int) -> "Factorisation":
        """Return the factorisation with at most n signals."""
        return self._replace(motion=self.motion[:, :n], signals=self.signals[:n])


def factorise(
    W: NDArray, K: int, precision: float = 0.0, triplets: Triplets | None = None
) -> Factorisation:
    """Return the rigid and the non-rigid factors of centred W (2 * n_frames, n_points).

    K is the number of basis shapes, `precision` the rounding error of the entries,
    relative to their RMS. `triplets` are at least the 3K + 3 leading ones of a larger
    matrix, by default of W.
    """
    n_points = W.shape[1]
    S, Vt, _ = triplets or leading_triplets(W, 3 * K + 3)
    # Rows of Vt above rounding errors, centred, their signs fixed.
    rank = min(np.sum(S > max(OF_RANKS, precision) * S[0]), 3 * K + 3)
    Vt = Vt[:rank] - Vt[:rank].mean(axis=1, keepdims=True)
    Vt *= orientations(Vt)[:, None]
    # The first three are the rigid shape, the next ones the signals.
    root = np.sqrt(n_points)
    B_0 = np.pad(root * Vt[:3], ((0, max(3 - rank, 0)), (0, 0)))
    signals = Vt[3:]
    n_missing = 3 * max(1, -(-(rank - 3) // 3)) - len(signals)
    if n_missing:  # completed by centred, orthonormal rows, orthogonal to Vt
        completion = null_space(np.vstack([np.ones((1, n_points)), Vt])).T
        signals = np.vstack([signals, completion[:n_missing]])
    B = root * signals
    M = W @ B.T / n_points
    M[:, max(rank - 3, 0) :] = 0.0
    return Factorisation(W @ B_0.T / n_points, B_0, M, B)


def sample_frames(
    rows: FrameBlocks, n_points: int, rigid_shape: NDArray, first: int, small_table: int
) -> tuple[NDArray, list[NDArray]]:
    """
    Return the completed measurement matrix of a first sample, and growing samples.

    Rows are blocks of complete frames (n, 2, n_points). The samples are indices; the
    first one has the frames of the matrix. If a table has fewer coordinates than
    `small_table`, the matrix has all frames, and there are no samples.
    """
    n_frames = rows.n_frames
    parts: list[NDArray] = []
    if 2 * n_frames * n_points >= small_table and n_frames > first:
        energy = rows.joined(partial(rigid_energy, shape=rigid_shape))
        order = np.argsort(energy, kind="stable")
        n = first
        while not parts or n < min(n_frames / 2, 40_000):
            parts.append(np.sort(spread(order, n)))
            n *= 4
    W = rows.take(parts[0]) if parts else rows.whole()
    return W.reshape(-1, n_points).astype(np.float64, copy=False), parts


def rigid_energy(rows: NDArray, shape: NDArray) -> NDArray:
    """Return ``min_M ||W_i - M shape||_F^2`` (I,) of rows (I, 2, J)."""
    axes, size, _ = np.linalg.svd(shape.T, full_matrices=False)
    axes = axes[:, size > OF_RANKS * size[0]]
    seen = (rows.reshape(-1, rows.shape[-1]) @ axes).reshape(len(rows), -1)
    return np.maximum(energies(rows) - energies(seen), 0.0)


def leading_triplets(W: NDArray, k: int, dense: int = DENSE) -> Triplets:
    """Return the k leading triplets of a matrix (n_rows, n_columns) in memory."""
    blocks = FrameBlocks.of_blocks([W], [len(W)])
    return block_triplets(blocks, (len(W), W.shape[1]), k, dense)


def block_triplets(
    blocks: FrameBlocks, shape: tuple[int, int], k: int, dense: int = DENSE
) -> Triplets:
    """
    Return the k leading triplets of a matrix in blocks of frames (n, ..., n_columns).

    The right singular vectors of a tall matrix equal those of its triangular factor,
    which is assembled from the factors of the blocks (Demmel, Grigori, Hoemmen, Langou,
    "Communication-optimal parallel and sequential QR and LU factorizations", 2012). For
    a matrix with many rows and columns, four passes of a randomised block Krylov method
    find the leading right subspace (Musco, Musco, "Randomized block Krylov methods for
    stronger and faster approximate singular value decomposition", 2015).
    """
    n_rows, n_columns = shape
    if min(shape) > max(dense, 4 * (k + 10)):
        energy = sum(blocks.map(lambda block: float(energies(block).sum())))
        V = np.random.default_rng(0).standard_normal((n_columns, k + 10))
        krylov = []
        for _ in range(4):
            V = np.linalg.qr(sum(blocks.map(partial(_squared, V=V))))[0]
            krylov.append(V)
        V = np.linalg.qr(np.hstack(krylov))[0]
        _, S, rotation = np.linalg.svd(_triangle(blocks, V.shape[1], V))
        S, Vt = S[:k], rotation[:k] @ V.T
        residual = max(energy - S @ S, 0.0)
    else:
        tall = n_rows > n_columns
        matrix = _triangle(blocks, n_columns) if tall else _matrix(blocks.whole())
        _, S, Vt = np.linalg.svd(matrix, full_matrices=False)
        S, Vt, residual = S[:k], Vt[:k], np.sum(S[k:] ** 2)
    return S, Vt, float(residual)


def _matrix(block: NDArray) -> NDArray:
    """Return the rows (n_rows, n_columns) of a block (n_frames, ..., n_columns)."""
    return block.reshape(-1, block.shape[-1])


def _triangle(blocks: FrameBlocks, width: int, V: NDArray | None = None) -> NDArray:
    """Return the triangular factor (width, width) of W, or of W V with V given."""
    pending: list[NDArray] = []
    for part in blocks.map(partial(_block_triangle, V=V)):
        pending.append(part)
        if sum(map(len, pending)) > 6 * width:
            pending = [np.asarray(np.linalg.qr(np.concatenate(pending), mode="r"))]
    return np.asarray(np.linalg.qr(np.concatenate(pending), mode="r"))


def _block_triangle(block: NDArray, V: NDArray | None) -> NDArray:
    """Return the triangular factor of a block, or the block if it is not tall."""
    matrix = _matrix(block) if V is None else _matrix(block) @ V
    matrix = matrix.astype(np.float64, copy=False)
    tall = len(matrix) > matrix.shape[1]
    return np.asarray(np.linalg.qr(matrix, mode="r")) if tall else matrix


def _squared(block: NDArray, V: NDArray) -> NDArray:
    """Return ``W^T W V`` (n_columns, width) for a block W of the matrix."""
    matrix = _matrix(block)
    return ((matrix @ V.astype(matrix.dtype)).T @ matrix).T.astype(np.float64)


def run_paper_pipeline(
    factors: Factorisation, n_components: int, isa: Any, settings: Any, report: Progress
) -> tuple[NDArray, NDArray, int, bool]:
    """Fit the strategy `isa`, recover blocks and refine them, by `FitSettings`.

    Returns shapes (K + 1, 3, J): B_0 of the rigid factorisation, and ``B_k = E_k
    B_ISA,k``, zero for subspaces without motion. The mode covariance (3K, 3K) ``(J /
    2I) M_ISA^T M_ISA``, in the order of the basis. The number of steps of the
    refinement, 1 without one, and its convergence.
    """
    n_rows, n_points = len(factors.motion), factors.signals.shape[1]
    products = motion_products(factors.rigid_motion, factors.motion)
    moments, (cross, rigid, gram) = lifted_moments(products), products
    covariance = gram * (n_points / n_rows)
    with warnings.catch_warnings():
        if settings.joint and settings.silent_isa:
            message = "PooledFastICA did not"
            warnings.filterwarnings("ignore", message, ConvergenceWarning)
        components = _independent_subspaces(isa, factors.signals, covariance, moments)
    report("independent subspaces")

    # Block structure, for the motion ``M' A`` with ``A^T = components``. E_k is the
    # inverse of D_k.
    gram = components @ gram @ components.T
    products = cross @ components.T, rigid, gram
    D = recover_blocks(products, settings.block_recovery)
    E = np.linalg.pinv(D, rcond=OF_RANKS)
    n_iter, converged = 1, True
    if settings.refinement:
        # The joint refinement only starts from this result.
        limits = (200, 1e-5) if settings.joint else (settings.max_iter, settings.tol)
        lifted = leading_blocks(moments, components.reshape(len(E), 3, -1))
        plain = np.broadcast_to(np.eye(3), (len(E), 1, 3, 3))
        starts = np.concatenate([E[:, None], lifted, plain], axis=1)
        E, n_iter, converged = refine_alternating(products, starts, *limits)
    report("block structure and refinement")

    # Shapes. Subspaces beyond the rank of W stay zero.
    shapes = np.zeros((n_components + 1, 3, n_points))
    shapes[0] = factors.rigid_shape
    shapes[1 : len(E) + 1] = E @ (components @ factors.signals).reshape(len(E), 3, -1)
    covariance = np.zeros((3 * n_components, 3 * n_components))
    covariance[: 3 * len(E), : 3 * len(E)] = gram * (n_points / n_rows)
    return shapes, covariance, n_iter, converged


def _independent_subspaces(
    isa: Any, signals: NDArray, covariance: NDArray, moments: NDArray
) -> NDArray:
    """Fit a strategy to signals (n_signals, n_points) and return its unmixing matrix.

    If its `fit` has a parameter `covariance`, this is ``C = (J / 2I) M'^T M'``, the
    covariance over the images (Brandt et al. 2018, section 3.3). No mean is subtracted,
    as it would depend on the rotation of single images. A parameter `criterion` is
    `structure_energies`.
    """
    criterion = partial(structure_energies, moments)
    options: dict[str, Any] = {"covariance": covariance, "criterion": criterion}
    accepted = {name: options[name] for name in options if has_fit_parameter(isa, name)}
    # Fixed-point iterations from random starts magnify rounding errors, so that another
    # order of frames or points could lead to another optimum. Five decimals are far
    # coarser than rounding errors, and far finer than the errors of the signals.
    samples = np.round(signals, 5).T
    isa.fit(samples[np.lexsort(samples.T)], **accepted)
    n_signals = len(signals)
    found = getattr(getattr(isa, "components_", None), "shape", ())
    if found != (n_signals, n_signals):
        raise ValueError(
            f"isa must give components_ of shape {(n_signals, n_signals)}; "
            f"got {found or 'none'}"
        )
    # The nearest orthogonal matrix: the signals are white, up to rounding.
    return polar(isa.components_)[0]


# Products of the rigid motion M_0^i and the motion M^i of n_signals signals: ``M_0^iT
# M^i`` (I, 3, n_signals), ``M_0^iT M_0^i`` (I, 9), row by row, and ``sum_i M^iT M^i``
# (n_signals, n_signals)
MotionProducts = tuple[NDArray, NDArray, NDArray]


def motion_products(rigid_motion: NDArray, motion: NDArray) -> MotionProducts:
    """Return the products for M_0 (2 n_frames, 3) and M (2 n_frames, n_signals)."""
    M_0 = rigid_motion.reshape(-1, 2, 3)
    cross = M_0.mT @ motion.reshape(len(M_0), 2, -1)
    return cross, (M_0.mT @ M_0).reshape(-1, 9), motion.T @ motion


def _blocks_of(cross: NDArray) -> NDArray:
    """Return ``M_0^iT M_ik`` as (n_blocks, n_frames, 9), each matrix row by row."""
    n_frames, _, n_signals = cross.shape
    split = cross.reshape(n_frames, 3, n_signals // 3, 3)
    return np.ascontiguousarray(split.transpose(2, 0, 1, 3)).reshape(-1, n_frames, 9)


def recover_blocks(products: MotionProducts, method: str) -> NDArray:
    """
    Return D_k (n_blocks, 3, 3) that maps the motion of subspaces to the rigid motion.

    D_k and alpha_k make ``sum_i ||M_ik D_k - alpha_ik M_0^i||_F^2`` small. With the
    optimal alpha_k, this is a quadratic form in vec(D_k). The methods
    `BLOCK_RECOVERIES` differ in how they exclude ``D_k = 0``. D_k has norm one and
    arbitrary sign, and is zero for a subspace without motion.
    """
    cross, rigid, grams = products
    energy, blocks = rigid[:, ::4].sum(axis=1), _blocks_of(cross)  # ||M_0^i||^2
    D = np.zeros((len(blocks), 3, 3))
    for k, P in enumerate(blocks):
        gram = grams[3 * k : 3 * k + 3, 3 * k : 3 * k + 3]
        if not np.trace(gram) > 0:
            continue
        # m_i is M_ik^T M_0^i, row by row: <M_ik D, M_0^i> = m_i . vec(D).
        m = P.reshape(-1, 3, 3).mT.reshape(-1, 9)
        if method == "irls" and m[0].any():
            # As published (appendix A): with alpha of the first frame fixed, D solves a
            # linear least squares problem, and alpha is divided by the norm of D. D is
            # proportional to the fixed alpha, so the iteration ends after one step.
            moved = np.kron(gram, np.eye(3))  # sum_i ||M_ik D||^2 as a form in vec(D)
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
    cross, rigid, _ = products
    n_frames, _, n_signals = cross.shape
    energy = rigid[:, ::4].sum(axis=1)  # ||M_0^i||^2
    ridge = 0.1 * np.where(energy > 0, energy, 1.0)
    regular = rigid.reshape(-1, 3, 3) + ridge[:, None, None] * np.eye(3)
    L = np.linalg.solve(regular, cross).reshape(n_frames, -1)
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


def refine_alternating(
    products: MotionProducts, starts: NDArray, max_iter: int, tol: float
) -> tuple[NDArray, int, bool]:
    """Return the blocks that explain most of the motion, each from several starts.

    From the starts (n_blocks, n_starts, 3, 3), the best one after six steps is used. A
    block has converged when a step gains less than `tol` of its energy.

    Returns the blocks E (n_blocks, 3, 3) of unit norm and arbitrary sign, ``M_ik ~
    alpha_ik M_0^i E_k``, zero for a subspace without motion; the largest number of
    steps; and convergence.
    """
    E, n_iter, converged = np.zeros((len(starts), 3, 3)), 1, True
    cross, rigid, _ = products
    for k, P in enumerate(_blocks_of(cross)):
        tried = starts[k]
        for _ in range(6):
            _, tried = _step(P, rigid, tried)
        explained, after = _step(P, rigid, tried)
        best = np.argmax(explained)
        energy, after = explained[best], after[best : best + 1]
        if not energy > 0:
            continue
        for n_steps in range(1, max_iter + 1):
            n_iter = max(n_iter, n_steps)
            E[k], before = after[0], energy
            (energy,), after = _step(P, rigid, after)
            if energy - before <= tol * energy:
                break
        else:
            converged = False
    return E, n_iter, converged


def _step(P: NDArray, rigid: NDArray, E: NDArray) -> tuple[NDArray, NDArray]:
    """Return energies (n,) of E (n, 3, 3), and E after a step, of unit norm."""
    inner = P @ E.reshape(-1, 9).T  # <M_ik, M_0^i E>
    square = rigid @ (E @ E.swapaxes(1, 2)).reshape(-1, 9).T  # ||M_0^i E||^2
    alpha = np.divide(inner, square, where=square > 0, out=np.zeros_like(inner))
    A, R = (alpha**2).T @ rigid, alpha.T @ P
    after = np.linalg.pinv(A.reshape(-1, 3, 3), hermitian=True) @ R.reshape(-1, 3, 3)
    norm = np.linalg.norm(after, axis=(1, 2), keepdims=True)
    return np.sum(alpha * inner, axis=0), after / np.where(norm > 0, norm, 1.0)
