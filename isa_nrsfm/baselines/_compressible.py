"""Compressible structure from motion: each shape is a sum of a few of many atoms.

Kong, Lucey, "Prior-less compressible structure from motion" (2016). A frame is
``W_i = R_i sum_l c_il X_l``, its blocks ``P_il = c_il R_i`` over a block-sparse
dictionary are known up to one 3x3 matrix for each atom.

The dictionary is learnt by block K-SVD from the solution of a relaxed problem (Aharon,
Elad, Bruckstein, "K-SVD", 2006): a frame (2 x J) is ``sum_l P_il D_l`` with 2x3 blocks
P_il of which at most s are non-zero, and atoms D_l (3 x J). Everything is invariant to
rotations of the space of the J points: the frames may be given in any orthonormal basis
of it.

Shapes of arrays: frames (n_frames, 2, n_points), atoms (n_atoms, 3, n_points), blocks
(n_frames, n_atoms, 2, 3), zero where not active, active (n_frames, n_atoms).
"""

from numbers import Integral, Real
from typing import Any, ClassVar

import numpy as np
from numpy.typing import NDArray
from sklearn.utils import check_random_state, gen_batches

from isa_nrsfm._compat.scikit_learn import Interval
from isa_nrsfm._linalg import OF_RANKS, polar
from isa_nrsfm._tables import Layout
from isa_nrsfm.baselines._low_rank import ShapeSequenceNRSfM
from isa_nrsfm.calibration import _metric

# Growth of the penalty in each step; with 1.02 the end is far from stationary.
GROWTH = 1.001
# Fewest frames by whose cameras an atom is aligned. If few frames are shared, their
# second blocks are small, and the result is often mirrored or wrong.
FEWEST_SHARED = 10


def group_sparse_atoms(
    frames: NDArray, n_atoms: int, penalty: float, random_state: np.random.RandomState
) -> NDArray:
    """Solve the relaxed problem: return atoms with ``||D_l||_F <= 1``.

    With blocks P_il they nearly minimise ``sum_i (||W_i - sum_l P_il D_l||_F^2 / 2 +
    penalty sum_l ||P_il||_F)``, for frames of mean square norm one, by the alternating
    direction method of multipliers. Of more than 1000 frames a random subset is used.
    """
    if len(frames) > 1000:
        frames = frames[random_state.permutation(len(frames))[:1000]]
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
        blocks = (P + P_dual).reshape(-1, 2, n_atoms, 3)
        norms = np.linalg.norm(blocks, axis=(1, 3), keepdims=True)
        # Minimisers Z of ``threshold * ||Z||_F + ||Z - P||_F^2 / 2``
        lengths = np.maximum(norms - penalty / rho, 0.0)
        share = np.divide(lengths, norms, out=np.zeros_like(norms), where=norms > 0)
        P_copy = (blocks * share).reshape(P.shape)
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
    return D_copy.reshape(n_atoms, 3, n_points)


def _within_unit_norm(rows: NDArray, n_atoms: int) -> NDArray:
    """Return atoms (3 * n_atoms, n_points), the norms limited to one."""
    atoms = rows.reshape(n_atoms, -1)
    norms = np.linalg.norm(atoms, axis=1, keepdims=True)
    return (atoms / np.maximum(norms, 1.0)).reshape(rows.shape)


def code_frames(
    frames: NDArray, atoms: NDArray, sparsity: int, ridge: float
) -> NDArray:
    """Find at most `sparsity` blocks for each frame by reweighted ridge regression.

    Alternately ``||W_i - sum_l P_il D_l||_F^2 + ridge * ||W_i||_F^2 sum_l ||P_il||_F^2
    / w_il^2`` is minimised, where w_il is the previous norm of P_il, and the largest
    blocks are selected, ever fewer (Gorodnitsky, Rao, "Sparse signal reconstruction
    from limited data using FOCUSS", 1997). A block that alone explains a share x of the
    frame ends with the share ``(x + sqrt(x^2 - 4 x ridge)) / 2 - ridge``, or zero if x
    is below four times `ridge`. A frame without blocks gets that of its best atom.
    Atoms have orthonormal rows, frames are non-zero. Returns blocks (n_frames, n_atoms,
    2, 3), zero where an atom is not active.
    """
    n_frames, n_atoms = len(frames), len(atoms)
    rows = atoms.reshape(3 * n_atoms, -1)
    gram = (rows @ rows.T).reshape(n_atoms, 3, n_atoms, 3).transpose(0, 2, 1, 3)
    blocks = np.zeros((n_frames, n_atoms, 2, 3))
    for part in gen_batches(n_frames, 1000):
        norms = np.linalg.norm(frames[part], axis=(1, 2))[:, None, None]
        right = (frames[part] / norms) @ rows.T
        right = right.reshape(-1, 2, n_atoms, 3).transpose(0, 2, 3, 1)
        found, chosen = _reweighted_ridge(gram, right, sparsity, ridge)
        found *= norms[..., None]
        np.put_along_axis(blocks[part], chosen[..., None, None], found, 1)

        lost = np.flatnonzero(~found.any(axis=(1, 2, 3)))
        best = np.linalg.norm(right[lost], axis=(2, 3)).argmax(axis=1)
        blocks[part][lost, best] = right[lost, best].transpose(0, 2, 1) * norms[lost]
    return blocks


def _reweighted_ridge(
    gram: NDArray, right: NDArray, sparsity: int, ridge: float
) -> tuple[NDArray, NDArray]:
    """Return blocks of frames of norm one, zero if not active, and their atoms.

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
    active = weights[..., None, None] > ridge
    return np.where(active, blocks, 0.0).transpose(0, 1, 3, 2), chosen


def update_atoms(
    frames: NDArray, atoms: NDArray, blocks: NDArray, replace: bool
) -> tuple[NDArray, NDArray, NDArray]:
    """Fit each atom and its blocks in turn to the residual of the others.

    Returns atoms, blocks and residuals. An atom becomes the orthonormal rows
    of the best approximation of rank three; the sum of squared residuals never
    increases. With `replace`, an atom of fewer than three frames becomes the three main
    directions of the two frames with the largest residuals, and is inactive.
    """
    atoms, blocks = atoms.copy(), blocks.copy()
    residuals = frames - np.einsum("ilrc,lcp->irp", blocks, atoms, optimize=True)
    n_replaced = 0
    for atom in range(len(atoms)):
        users = np.flatnonzero(blocks[:, atom].any(axis=(1, 2)))
        targets = residuals[users] + blocks[users, atom] @ atoms[atom]
        # An atom and its metric need three frames.
        if replace and len(users) < 3:
            blocks[users, atom], residuals[users] = 0.0, targets
            worst = np.argsort(-np.sum(residuals**2, axis=(1, 2)), kind="stable")
            pair = np.take(worst, 2 * n_replaced + np.arange(2), mode="wrap")
            atoms[atom] = _main_directions(frames[pair])
            n_replaced += 1
            continue
        if 2 * len(users) >= 3:
            atoms[atom] = _main_directions(targets)
        blocks[users, atom] = targets @ atoms[atom].T
        residuals[users] = targets - blocks[users, atom] @ atoms[atom]
    return atoms, blocks, residuals


def _main_directions(frames: NDArray) -> NDArray:
    """Return the first three right singular vectors of frames, three rows or more."""
    rows = frames.reshape(-1, frames.shape[2])
    return np.linalg.svd(rows, full_matrices=False)[2][:3]


def metric_correction(blocks: NDArray) -> NDArray:
    """
    Return G (3, 3) that makes blocks P_i (n_frames, 2, 3) scaled orthographic cameras.

    ``Q = G G^T`` is the symmetric matrix of unit norm with the least sum of squares of
    ``p1 Q p1^T - p2 Q p2^T`` and ``2 p1 Q p2^T``, an eigenvector. Of several solutions,
    with fewer than three frames, it is the nearest to the identity. If Q is not
    positive definite, its axes are kept, and stretches differ by a factor of at most
    20.
    """
    equations = _metric.conformal_equations(blocks)
    _, values, vectors = np.linalg.svd(equations, full_matrices=len(equations) < 6)
    n_determined = min(int(np.sum(values > OF_RANKS * values[0])), 5)
    solutions = vectors[n_determined:]
    # The last one is the identity / sqrt(3).
    basis = _metric.strain_basis("orthographic")
    nearest = np.sqrt(3) * solutions[:, 5] @ solutions
    eigenvalues, axes = np.linalg.eigh(np.tensordot(nearest, basis, 1))
    eigenvalues = np.maximum(eigenvalues, eigenvalues[-1] / _metric.LARGEST_STRETCH**2)
    return axes * np.sqrt(eigenvalues)


def align_blocks(blocks: NDArray, cameras: NDArray) -> NDArray:
    """Return the orthogonal O (3, 3) that, with the best c_i, aligns blocks to cameras.

    It minimises ``sum_i ||P_i O - c_i R_i||^2`` by alternation of coefficients and
    orthogonal Procrustes problems, from the unconstrained matrix with the largest
    ``sum_i <P_i O, R_i>^2``.
    """
    products = np.einsum("irc,ird->icd", blocks, cameras).reshape(-1, 9)
    start = np.linalg.eigh(products.T @ products)[1][:, -1]
    O = polar(start.reshape(3, 3))[0]  # noqa: E741
    for _ in range(100):
        before = O
        O = polar((products @ O.ravel() @ products).reshape(3, 3))[0]  # noqa: E741
        if np.abs(O - before).max() < 1e-12:
            break
    return O


def chain_atoms(atoms: NDArray, blocks: NDArray) -> tuple[NDArray, NDArray, NDArray]:
    """Make cameras of the blocks of all atoms, in one orientation of space.

    Returns cameras R_i (I, 2, 3), coefficients c_il (I, n_atoms) and corrected atoms
    X_l (n_atoms, 3, J), zero if unused. The most used atom comes first, then always the
    one that shares most frames with those before it. Blocks become ``P_il G_l``: G_l is
    the `metric_correction` times the orthogonal matrix that aligns them with the
    cameras of shared frames, or, with fewer than ten of these, the shape with the
    first. R_i is the camera nearest to the block of the frame's first atom, ``c_il =
    <P_il G_l, R_i> / 2`` and ``X_l = G_l^-1 D_l``.
    """
    active = np.asarray(blocks.any(axis=(2, 3)))
    n_frames, n_atoms = active.shape
    cameras, has_camera = np.zeros((n_frames, 2, 3)), np.zeros(n_frames, dtype=bool)
    coefficients, shapes = np.zeros((n_frames, n_atoms)), np.zeros_like(atoms)
    n_users = active.sum(axis=0)
    remaining = [atom for atom in np.argsort(-n_users, kind="stable") if n_users[atom]]
    first = remaining[0]
    while remaining:
        n_shared = active[has_camera].sum(axis=0)
        atom = remaining.pop(int(np.argmax(n_shared[remaining])))
        users = np.flatnonzero(active[:, atom])
        shared = has_camera[users]
        G = metric_correction(blocks[users, atom])
        if n_shared[atom] >= FEWEST_SHARED:
            motion = blocks[users[shared], atom] @ G
            G = G @ align_blocks(motion, cameras[users[shared]])
        elif atom != first:
            shape = np.linalg.pinv(G) @ atoms[atom]
            G = G @ polar(shape @ shapes[first].T)[0]
        motion = blocks[users, atom] @ G
        cameras[users[~shared]] = polar(motion[~shared])[0]
        has_camera[users] = True
        coefficients[users, atom] = np.einsum("irc,irc->i", motion, cameras[users]) / 2
        shapes[atom] = np.linalg.pinv(G) @ atoms[atom]
    return cameras, coefficients, shapes


class CompressibleNRSfM(ShapeSequenceNRSfM):
    """
    Prior-less compressible structure from motion.

    Each shape is a sum of at most `sparsity` of `n_atoms` shapes. Frames are factorised
    into 2x3 blocks and atoms by block-sparse dictionary learning; then the blocks of
    each atom are made cameras, and the atoms are brought to one orientation. Row i,
    reshaped to (n_points, 2), is modelled as::

        shapes_[i] @ motion_[i].T + translation_[i]

    Parameters
    ----------
    n_components : int, default=3
        K, the number of basis shapes without the mean shape, for `transform` and the
        related methods. K needs at least 3K + 4 points and
        ``ceil(8 (K + 2) / 5)`` frames.
    n_atoms : int, default=None
        Number of atoms, at most one for each frame. None means ``n_components + 1``,
        so that the shapes are mixtures of as many shapes as in the other methods.
    sparsity : int, default=2
        The most atoms of a frame.
    penalty : float, default=0.06
        Price of the norm of a block in the relaxed problem that gives the atoms to
        start from, relative to the root mean square norm of a frame.
    ridge : float, default=0.01
        Price of a block when frames are coded, as a share of the energy of the frame,
        up to 0.25. An atom that would explain less than four times this share is not
        used. With a small one the residual is least, but frames are split into atoms
        that nearly cancel, which yield no cameras unless the shapes are truly
        sparse.
    max_iter : int, default=20
        The most sweeps of dictionary learning.
    tol : float, default=1e-4
        Relative change of the residual in a sweep below which one more is made, the
        last.
    layout : {"interleaved", "planar"}, default="interleaved"
        Order of the columns: x0, y0, x1, y1, ... or x0, x1, ..., y0, y1, ...
    scale_frames : bool, default=False
        Whether to divide each centred frame by the root mean square of its coordinates
        before the fit; `motion_` includes the scale. False is for orthographic cameras,
        as published. Use True for photos of different resolution.
    ordered : bool, default=False
        Whether the rows are successive frames of a slowly turning camera. Images do not
        determine the sign of a frame's camera and shape. If True, the sign minimises
        the rotation of the camera from the frame before; if False, signs are chosen to
        make the shapes similar.
    random_state : int, RandomState instance or None, default=None
        Draws the first atoms and, if there are more than 1000 frames, the frames of the
        relaxed problem. The result depends on it; an int makes it reproducible.

    Attributes
    ----------
    mean_shape_ : ndarray of shape (n_points, 3)
        Mean of `shapes_`. x and y are the axes of the mean camera (so y points down
        for image coordinates), z is depth; the mirror image fits equally well.
    basis_ : ndarray of shape (n_components, n_points, 3)
        Principal components of `shapes_`, by decreasing variance; one standard
        deviation each.
    alpha_ : ndarray of shape (n_frames, n_components)
        Coefficients of the principal components for the fitted table, as returned by
        `transform`, with the cameras of `decompose`.
    motion_ : ndarray of shape (n_frames, 2, 3)
        Cameras: orthonormal rows, with `scale_frames` times the size of the frame.
    translation_ : ndarray of shape (n_frames, 2)
        Centroids of the frames, in the units of the table.
    shapes_ : ndarray of shape (n_frames, n_points, 3)
        Shapes of the frames, centred, sums of at most `sparsity` atoms. In the units of
        the table or, with `scale_frames`, of frames of size one.
    inverse_snr_ : float
        ``||W - What||_F^2 / ||W||_F^2``, a fraction, with W the centred tracks, scaled
        as in the fit, and What the image of `shapes_` in `motion_`. It may exceed one,
        as the shapes are not fitted to the images again.
    noise_variance_ : float
        Mean square error of a coordinate after projection of each shape on the model;
        for scaled frames, relative to frames of size one.
    dictionary_residual_ : float
        The same share as `inverse_snr_` of the factorisation into blocks and atoms,
        before the blocks are made cameras.
    n_users_ : ndarray of shape (n_atoms,)
        Number of frames that use each atom.
    n_iter_ : int
        Number of sweeps.
    n_features_in_ : int
        Number of columns.
    feature_names_in_ : ndarray of shape (`n_features_in_`,)
        Names of the columns, where the table is a dataframe with string names.

    See Also
    --------
    PseudoInverseNRSfM : Shapes of least norm, then of low rank.
    BlockMatrixNRSfM : Shapes of least nuclear norm.
    isa_nrsfm.AffineNRSfM : Affine cameras, missing points, independent basis shapes.

    Notes
    -----
    The steps follow the publication: a group-sparse factorisation by the
    alternating direction method of multipliers, block K-SVD with reweighted ridge
    regression as its sparse coding, one 3x3 matrix for each atom from an eigenvector,
    orthogonal Procrustes problems along a chain of atoms, and shapes from the blocks
    and the atoms. Choices of this implementation are the price of a block in the sparse
    coding, signs of coefficients as part of the Procrustes problems, bounds on matrices
    that are not positive definite, and that atoms which share fewer than ten frames
    with those before are aligned by their shapes.

    The dictionary is unique only if shapes are truly sparse and there are many points:
    `sparsity` atoms must not span the same space as others. Tables of low rank, such as
    a face with few deformations, have many codes, and the cameras then depend on
    `random_state`. Try several seeds, and compare `inverse_snr_`.

    The method factorises the given table only, without missing points. For other
    frames, `transform` and the related methods fit a linear model: the mean and the
    first `n_components` principal components of `shapes_`, with a normal prior of the
    coefficients. For the fitted table they also return the shapes of this model, which
    are close to `shapes_` but not equal.

    References
    ----------
    C. Kong, S. Lucey, "Prior-less compressible structure from motion", IEEE Conference
    on Computer Vision and Pattern Recognition, 2016.

    Examples
    --------
    >>> from isa_nrsfm.baselines import CompressibleNRSfM
    >>> from isa_nrsfm.datasets import make_nonrigid_tracks
    >>> tracks = make_nonrigid_tracks(100, camera="orthographic", random_state=0)
    >>> model = CompressibleNRSfM(n_components=3, random_state=0).fit(tracks.data)
    >>> model.shapes_.shape, model.n_users_.shape
    ((100, 68, 3), (4,))
    """

    _parameter_constraints: ClassVar[dict[str, list[Any]]] = {
        **ShapeSequenceNRSfM._parameter_constraints,
        "n_atoms": [Interval(Integral, 1, None, closed="left"), None],
        "sparsity": [Interval(Integral, 1, None, closed="left")],
        "penalty": [Interval(Real, 0, None, closed="left")],
        # A smaller price is lost in the rounding of the equations.
        "ridge": [Interval(Real, 1e-12, 0.25, closed="both")],
        "max_iter": [Interval(Integral, 1, None, closed="left")],
        "tol": [Interval(Real, 0, None, closed="left")],
        "random_state": ["random_state"],
    }

    def __init__(
        self,
        n_components: int = 3,
        *,
        n_atoms: int | None = None,
        sparsity: int = 2,
        penalty: float = 0.06,
        ridge: float = 0.01,
        max_iter: int = 20,
        tol: float = 1e-4,
        layout: Layout = "interleaved",
        scale_frames: bool = False,
        ordered: bool = False,
        random_state: int | np.random.RandomState | None = None,
    ):
        super().__init__(
            n_components, layout=layout, scale_frames=scale_frames, ordered=ordered
        )
        self.n_atoms = n_atoms
        self.sparsity = sparsity
        self.penalty = penalty
        self.ridge = ridge
        self.max_iter = max_iter
        self.tol = tol
        self.random_state = random_state

    def _factorise(self, W: NDArray) -> tuple[NDArray, NDArray]:
        """Return cameras and shapes that are sums of few atoms."""
        n_frames, n_points = len(W) // 2, W.shape[1]
        n_atoms = self.n_components + 1 if self.n_atoms is None else self.n_atoms
        if n_atoms > n_frames:
            raise ValueError(
                f"n_atoms={n_atoms} needs as many frames (rows), X has "
                f"n_samples={n_frames}"
            )
        if self.sparsity > n_atoms:
            raise ValueError(
                f"sparsity={self.sparsity} must not be larger than the number of "
                f"atoms, n_atoms={n_atoms}"
            )
        # Frames over an orthonormal basis (rank >= 3, n_points) of the rows of W
        _, values, basis = np.linalg.svd(W, full_matrices=False)
        basis = basis[: max(3, int(np.sum(values > OF_RANKS * values[0])))]
        unit = np.sqrt(2 * n_points)  # the mean square norm of a frame is 2J
        frames = (W @ basis.T).reshape(n_frames, 2, -1) / unit
        random_state = check_random_state(self.random_state)
        atoms = group_sparse_atoms(frames, n_atoms, self.penalty, random_state)
        atoms, blocks = self._block_ksvd(frames, atoms)
        self.n_users_ = blocks.any(axis=(2, 3)).sum(axis=0)
        cameras, coefficients, atoms = chain_atoms(atoms, blocks)
        shapes = np.tensordot(coefficients, unit * (atoms @ basis), 1)
        return cameras, shapes.transpose(0, 2, 1)

    def _block_ksvd(self, frames: NDArray, atoms: NDArray) -> tuple[NDArray, NDArray]:
        """Learn a dictionary by which a frame is a sum of at most `sparsity` blocks.

        A sweep codes the frames, then updates the atoms. Sweeps end one after the
        relative change of the residual falls to `tol`; in the last one no atom is
        replaced. Returns atoms and blocks.
        """
        atoms = np.linalg.svd(atoms, full_matrices=False)[2]
        energy, residual, settled = float(np.sum(frames**2)), np.inf, False
        for n_iter in range(1, self.max_iter + 1):
            last = settled or n_iter == self.max_iter
            blocks = code_frames(frames, atoms, self.sparsity, self.ridge)
            atoms, blocks, residuals = update_atoms(frames, atoms, blocks, not last)
            before, residual = residual, float(np.sum(residuals**2)) / energy
            if last:
                break
            settled = abs(before - residual) <= self.tol * residual
        self.dictionary_residual_, self.n_iter_ = residual, n_iter
        return atoms, blocks
