"""Two methods of shapes of low rank: those of least norm, and of least nuclear norm."""

from numbers import Integral, Real
from typing import Any, ClassVar

import numpy as np
from numpy.typing import NDArray
from sklearn.exceptions import ConvergenceWarning

from isa_nrsfm._compat.caller import warn_caller
from isa_nrsfm._compat.scikit_learn import Interval
from isa_nrsfm._linalg import OF_RANKS, polar
from isa_nrsfm._tables import Layout
from isa_nrsfm.baselines._base import ShapeSequenceNRSfM
from isa_nrsfm.calibration import orthonormal_cameras
from isa_nrsfm.isa._pipeline import leading_triplets


def orthographic_cameras(W: NDArray, rank: int) -> NDArray:
    """Return the orthographic cameras (I, 2, 3) nearest to `orthonormal_cameras` of W.

    The latter are in the span of the first ``3 * rank`` left singular vectors.
    """
    S, Vt, residual = leading_triplets(W, 3 * rank)
    n_columns = int(np.sum(S > OF_RANKS * S[0]))
    if n_columns < 3:
        raise ValueError(
            "orthographic cameras need a table of rank three or more, once frames are "
            f"centred; X has rank {n_columns}, as of a flat object that does not deform"
        )
    n_left = (len(W) - 3 * rank) * (W.shape[1] - 1 - 3 * rank)
    noise_variance = residual / n_left if n_left > 0 else 0.0
    motion = W @ Vt[:n_columns].T
    return polar(orthonormal_cameras(motion, noise_variance).cameras)[0]


def least_norm_shapes(W: NDArray, cameras: NDArray) -> NDArray:
    """Return the flat shapes of least norm ``S_i = R_i^+ W_i`` that reproduce W."""
    return W.reshape(len(cameras), 2, -1).transpose(0, 2, 1) @ cameras


def truncate_rank(shapes: NDArray, rank: int) -> NDArray:
    """Return the nearest shapes whose matrix, one row per frame, has this rank."""
    U, S, Vt = np.linalg.svd(shapes.reshape(len(shapes), -1), full_matrices=False)
    return ((U[:, :rank] * S[:rank]) @ Vt[:rank]).reshape(shapes.shape)


class PseudoInverseNRSfM(ShapeSequenceNRSfM):
    """
    Pseudo-inverse method of non-rigid structure from motion.

    The method finds orthographic cameras R_i, then for each frame the shape of least
    norm that reproduces the image exactly, ``S_i = R_i^+ W_i``. The result are the
    nearest mixtures of ``n_components + 1`` shapes. Depth results from the low rank
    alone and is too small. Row i, reshaped to (n_points, 2), is modelled as::

        shapes_[i] @ motion_[i].T + translation_[i]

    Parameters
    ----------
    n_components : int, default=3
        K, the number of basis shapes without the mean shape; the literature counts the
        mean shape as well. K needs at least 3K + 4 points and ``ceil(8 (K + 2) / 5)``
        frames.
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
        Shapes of the frames, centred, of rank ``n_components + 1`` as a matrix with
        one row per frame. In the units of the table or, with `scale_frames`, of frames
        of size one.
    inverse_snr_ : float
        ``||W - What||_F^2 / ||W||_F^2``, a fraction, with W the centred tracks, scaled
        as in the fit, and What the image of `shapes_` in `motion_`.
    noise_variance_ : float
        Mean square error of a coordinate after projection of each shape on the model;
        for scaled frames, relative to frames of size one.
    n_features_in_ : int
        Number of columns.
    feature_names_in_ : ndarray of shape (`n_features_in_`,)
        Names of the columns, where the table is a dataframe with string names.

    See Also
    --------
    BlockMatrixNRSfM : Shapes of least nuclear norm.
    isa_nrsfm.AffineNRSfM : Affine cameras, missing points, independent basis shapes.

    Notes
    -----
    The method factorises the given table only. For other frames, `transform` and the
    related methods fit a linear model: the mean and the first `n_components` principal
    components of `shapes_`, with a normal prior of the coefficients. For the fitted
    table they also return the shapes of this model, not `shapes_`. The difference is
    small if `shapes_` are those of a deforming mean shape in orthographic cameras, as
    for `BlockMatrixNRSfM`; it is larger for shapes that lack depth.

    The singular values of the matrix of shapes and their images do not depend on the
    signs of frames, so `inverse_snr_` does not depend on `ordered`.

    Cameras are found by `isa_nrsfm.calibration.orthonormal_cameras` among the mixtures
    of the first ``3 (n_components + 1)`` left singular vectors of W, and made exactly
    orthonormal. A flat object that does not deform does not determine them, and `fit`
    raises a ValueError, as for missing points.

    References
    ----------
    Y. Dai, H. Li, M. He, "A simple prior-free method for non-rigid
    structure-from-motion factorization", International Journal of Computer Vision 107,
    2014.

    Examples
    --------
    >>> from isa_nrsfm.baselines import PseudoInverseNRSfM
    >>> from isa_nrsfm.datasets import make_nonrigid_tracks
    >>> tracks = make_nonrigid_tracks(100, camera="orthographic", random_state=0)
    >>> model = PseudoInverseNRSfM(n_components=3).fit(tracks.data)
    >>> model.shapes_.shape, model.alpha_.shape
    ((100, 68, 3), (100, 3))
    """

    def _factorise(self, W: NDArray) -> tuple[NDArray, NDArray]:
        """Return cameras and the shapes of least norm, of rank K + 1."""
        rank = self.n_components + 1
        cameras = orthographic_cameras(W, rank)
        return cameras, truncate_rank(least_norm_shapes(W, cameras), rank)


def shrink(shapes: NDArray, amount: float) -> NDArray:
    """
    Subtract an amount from the singular values of shapes (n_frames, n_points, 3).

    The matrix has one row for each frame. Singular values below 1e-8 of the largest
    are inexact, as they are roots of eigenvalues of the smaller Gram matrix.
    """
    rows = shapes.reshape(len(shapes), -1)
    tall = len(rows) > rows.shape[1]
    eigenvalues, vectors = np.linalg.eigh(rows.T @ rows if tall else rows @ rows.T)
    kept = eigenvalues > amount**2
    vectors, values = vectors[:, kept], np.sqrt(eigenvalues[kept])
    shrunk = vectors * (1.0 - amount / values)
    rows = (rows @ shrunk) @ vectors.T if tall else shrunk @ (vectors.T @ rows)
    return rows.reshape(shapes.shape)


class BlockMatrixNRSfM(ShapeSequenceNRSfM):
    """
    Block matrix method of non-rigid structure from motion.

    The method finds orthographic cameras R_i, then shapes S_i that reproduce the images
    and are mixtures of few shapes: their matrix S, one row per frame, has the least
    nuclear norm ``||S||_*``. Row i, reshaped to (n_points, 2), is modelled as::

        shapes_[i] @ motion_[i].T + translation_[i]

    Parameters
    ----------
    n_components : int, default=3
        K, the number of basis shapes without the mean shape; the literature counts the
        mean shape as well. K needs at least 3K + 4 points and ``ceil(8 (K + 2) / 5)``
        frames.
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
    max_iter : int, default=10000
        The most steps for each price of the nuclear norm.
    tol : float, default=1e-4
        Relative change of the shapes in a step that ends the steps, for each price.
        Smaller values need more steps and reduce the reprojection error, but do not
        improve the 3D shapes.

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
        Shapes of the frames, centred, of rank ``n_components + 1`` as a matrix with
        one row per frame. In the units of the table or, with `scale_frames`, of frames
        of size one.
    inverse_snr_ : float
        ``||W - What||_F^2 / ||W||_F^2``, a fraction, with W the centred tracks, scaled
        as in the fit, and What the image of `shapes_` in `motion_`.
    noise_variance_ : float
        Mean square error of a coordinate after projection of each shape on the model;
        for scaled frames, relative to frames of size one.
    n_iter_ : int
        Steps for all prices together.
    n_features_in_ : int
        Number of columns.
    feature_names_in_ : ndarray of shape (`n_features_in_`,)
        Names of the columns, where the table is a dataframe with string names.

    Warns
    -----
    ConvergenceWarning
        If `max_iter` steps did not suffice for one of the prices.

    See Also
    --------
    PseudoInverseNRSfM : Shapes of least norm, where this method starts.
    isa_nrsfm.AffineNRSfM : Affine cameras, missing points, independent basis shapes.

    Notes
    -----
    ``mu ||S||_* + 1/2 sum_i ||W_i - R_i S_i||_F^2`` is minimised by proximal gradient
    steps for prices mu from 1 to 6e-11, each a quarter of the last and started from its
    shapes, where W has unit mean square (fixed-point continuation). Steps have length
    one and Nesterov's momentum (Beck and Teboulle 2009, O'Donoghue and Candes 2015);
    the published ones, of length 0.2 without momentum, need far more. The shapes that
    are returned are the nearest mixtures of ``n_components + 1`` shapes.

    The method factorises the given table only. See `PseudoInverseNRSfM` for
    `transform`, the related methods, and the signs of frames.

    Cameras are found by `isa_nrsfm.calibration.orthonormal_cameras` among the mixtures
    of the first ``3 (n_components + 1)`` left singular vectors of W, and made exactly
    orthonormal. A flat object that does not deform does not determine them, and `fit`
    raises a ValueError, as for missing points.

    References
    ----------
    Y. Dai, H. Li, M. He, "A simple prior-free method for non-rigid
    structure-from-motion factorization", International Journal of Computer Vision 107,
    2014.

    A. Beck, M. Teboulle, "A fast iterative shrinkage-thresholding algorithm for linear
    inverse problems", SIAM Journal on Imaging Sciences 2, 2009.

    B. O'Donoghue, E. Candes, "Adaptive restart for accelerated gradient schemes",
    Foundations of Computational Mathematics 15, 2015.

    Examples
    --------
    >>> from isa_nrsfm.baselines import BlockMatrixNRSfM
    >>> from isa_nrsfm.datasets import make_nonrigid_tracks
    >>> tracks = make_nonrigid_tracks(100, camera="orthographic", random_state=0)
    >>> model = BlockMatrixNRSfM(n_components=3).fit(tracks.data)
    >>> model.shapes_.shape, model.alpha_.shape
    ((100, 68, 3), (100, 3))
    """

    _parameter_constraints: ClassVar[dict[str, list[Any]]] = {
        **ShapeSequenceNRSfM._parameter_constraints,
        "max_iter": [Interval(Integral, 1, None, closed="left")],
        "tol": [Interval(Real, 0, None, closed="left")],
    }

    def __init__(
        self,
        n_components: int = 3,
        *,
        layout: Layout = "interleaved",
        scale_frames: bool = False,
        ordered: bool = False,
        max_iter: int = 10_000,
        tol: float = 1e-4,
    ):
        super().__init__(
            n_components, layout=layout, scale_frames=scale_frames, ordered=ordered
        )
        self.max_iter = max_iter
        self.tol = tol

    def _factorise(self, W: NDArray) -> tuple[NDArray, NDArray]:
        """Return cameras and the shapes of least nuclear norm, of rank K + 1."""
        rank = self.n_components + 1
        cameras = orthographic_cameras(W, rank)
        shapes = least_norm_shapes(W, cameras)
        self.n_iter_, converged = 0, True
        for price in 4.0 ** -np.arange(18):
            shapes, n_iter, settled = self._minimised(W, cameras, price, shapes)
            self.n_iter_ += n_iter
            converged &= settled
        if not converged:
            warn_caller(
                f"the shapes did not converge in max_iter={self.max_iter} steps; "
                "increase max_iter or tol",
                ConvergenceWarning,
            )
        return cameras, truncate_rank(shapes, rank)

    def _minimised(
        self, W: NDArray, cameras: NDArray, price: float, shapes: NDArray
    ) -> tuple[NDArray, int, bool]:
        """Minimise ``mu ||S||_* + 1/2 sum_i ||W_i - R_i S_i||_F^2`` over the shapes.

        S has one row for each frame, mu is the price. Proximal gradient steps of length
        one have Nesterov's momentum, reset when it leads up (Beck, Teboulle 2009;
        O'Donoghue, Candes 2015). Returns shapes (I, J, 3), the number of steps, and
        whether the last relative change was at most `tol`.
        """
        images = W.reshape(len(cameras), 2, -1).transpose(0, 2, 1)
        # The curvature of the images is one, as the cameras have orthonormal rows.
        ahead, momentum = shapes, 1.0
        for n_iter in range(1, self.max_iter + 1):
            error = ahead @ cameras.transpose(0, 2, 1) - images
            moved = shrink(ahead - error @ cameras, price)
            change = moved - shapes
            size = np.linalg.norm(shapes)
            if np.vdot(ahead - moved, change) > 0:
                ahead, momentum = moved, 1.0
            else:
                larger = 0.5 + np.sqrt(0.25 + momentum**2)
                ahead = moved + (momentum - 1.0) / larger * change
                momentum = larger
            shapes = moved
            if np.linalg.norm(change) <= self.tol * size:
                return shapes, n_iter, True
        return shapes, self.max_iter, False
