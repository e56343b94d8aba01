"""Compressible structure from motion: each shape is a sum of a few of many atoms.

Kong, Lucey, "Prior-less compressible structure from motion" (2016). A frame is
``W_i = R_i sum_l c_il X_l``, its blocks ``P_il = c_il R_i`` over a block-sparse
dictionary are known up to one 3x3 matrix for each atom.
"""

from numbers import Integral, Real
from typing import Any, ClassVar

import numpy as np
from numpy.typing import NDArray
from sklearn.utils import check_random_state

from isa_nrsfm._compat.scikit_learn import Interval
from isa_nrsfm._linalg.rounding import OF_RANKS
from isa_nrsfm._linalg.small_matrices import polar
from isa_nrsfm._tables.tracks import Layout
from isa_nrsfm.baselines._base import ShapeSequenceNRSfM
from isa_nrsfm.baselines._block_dictionary import block_ksvd, group_sparse_factors
from isa_nrsfm.calibration._metric import (
    LARGEST_STRETCH,
    conformal_equations,
    strain_basis,
)

# Fewest frames by whose cameras an atom is aligned. If few frames are shared, their
# second blocks are small, and the result is often mirrored or wrong.
FEWEST_SHARED = 10


def metric_correction(blocks: NDArray) -> NDArray:
    """
    Return G (3, 3) that makes blocks P_i (n_frames, 2, 3) scaled orthographic cameras.

    ``Q = G G^T`` is the symmetric matrix of unit norm with the least sum of squares of
    ``p1 Q p1^T - p2 Q p2^T`` and ``2 p1 Q p2^T``, an eigenvector. Of several solutions,
    with fewer than three frames, it is the nearest to the identity. If Q is not
    positive definite, its axes are kept, and stretches differ by a factor of at most
    20.
    """
    equations = conformal_equations(blocks)
    _, values, vectors = np.linalg.svd(equations, full_matrices=len(equations) < 6)
    n_determined = min(int(np.sum(values > OF_RANKS * values[0])), 5)
    solutions = vectors[n_determined:]
    basis = strain_basis("orthographic")  # the last one is the identity / sqrt(3)
    nearest = np.sqrt(3) * solutions[:, 5] @ solutions
    eigenvalues, axes = np.linalg.eigh(np.tensordot(nearest, basis, 1))
    eigenvalues = np.maximum(eigenvalues, eigenvalues[-1] / LARGEST_STRETCH**2)
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


def chain_atoms(
    atoms: NDArray, blocks: NDArray, active: NDArray
) -> tuple[NDArray, NDArray, NDArray]:
    """Make cameras of the blocks of all atoms, in one orientation of space.

    Returns cameras R_i (I, 2, 3), coefficients c_il (I, n_atoms) and corrected atoms
    X_l (n_atoms, 3, J), zero if unused. The most used atom comes first, then always the
    one that shares most frames with those before it. Blocks become ``P_il G_l``: G_l is
    the `metric_correction` times the orthogonal matrix that aligns them with the
    cameras of shared frames, or, with fewer than ten of these, the shape with the
    first. R_i is the camera nearest to the block of the frame's first atom, ``c_il =
    <P_il G_l, R_i> / 2`` and ``X_l = G_l^-1 D_l``.
    """
    n_frames, n_atoms = active.shape
    cameras, seen = np.zeros((n_frames, 2, 3)), np.zeros(n_frames, dtype=bool)
    coefficients, shapes = np.zeros((n_frames, n_atoms)), np.zeros_like(atoms)
    n_users = active.sum(axis=0)
    left = [atom for atom in np.argsort(-n_users, kind="stable") if n_users[atom]]
    first = left[0]
    while left:
        n_shared = active[seen].sum(axis=0)
        atom = left.pop(int(np.argmax(n_shared[left])))
        users = np.flatnonzero(active[:, atom])
        shared = seen[users]
        G = metric_correction(blocks[users, atom])
        if n_shared[atom] >= FEWEST_SHARED:
            motion = blocks[users[shared], atom] @ G
            G = G @ align_blocks(motion, cameras[users[shared]])
        elif atom != first:
            shape = np.linalg.pinv(G) @ atoms[atom]
            G = G @ polar(shape @ shapes[first].T)[0]
        motion = blocks[users, atom] @ G
        cameras[users[~shared]] = polar(motion[~shared])[0]
        seen[users] = True
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
        triangle = np.linalg.qr(W, mode="r") if len(W) > n_points else W
        _, values, basis = np.linalg.svd(triangle, full_matrices=False)
        basis = basis[: max(3, int(np.sum(values > OF_RANKS * values[0])))]
        unit = np.sqrt(2 * n_points)  # the mean square norm of a frame is 2J
        frames = (W @ basis.T).reshape(n_frames, 2, -1) / unit
        random_state = check_random_state(self.random_state)
        _, atoms = group_sparse_factors(frames, n_atoms, self.penalty, random_state)
        atoms, blocks, active, self.dictionary_residual_, self.n_iter_ = block_ksvd(
            frames, atoms, self.sparsity, self.ridge, self.max_iter, self.tol
        )
        self.n_users_ = active.sum(axis=0)
        cameras, coefficients, atoms = chain_atoms(atoms, blocks, active)
        shapes = np.tensordot(coefficients, unit * (atoms @ basis), 1)
        return cameras, shapes.transpose(0, 2, 1)
