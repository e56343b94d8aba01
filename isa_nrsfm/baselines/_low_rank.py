"""The base of the baselines, and methods of least norm and of least nuclear norm.

A method finds an orthographic camera and a 3D shape for each frame of a table. Other
frames are fitted by the mean and the principal components of these shapes.

With one shape for each frame the sign of a frame is undetermined: the camera -R_i sees
-S_i as R_i sees S_i.
"""

from abc import abstractmethod
from numbers import Integral, Real
from typing import Any, ClassVar, Self

import numpy as np
from numpy.typing import NDArray
from sklearn import base
from sklearn.exceptions import ConvergenceWarning
from sklearn.utils.validation import check_is_fitted

from isa_nrsfm import _tables
from isa_nrsfm._compat import scikit_learn
from isa_nrsfm._compat.caller import warn_caller
from isa_nrsfm._fitted_model import TableModel
from isa_nrsfm._frames.camera_models import compose
from isa_nrsfm._frames.gauge import canonical_rotation
from isa_nrsfm._frames.models import Decomposition, FrameMap, FrameModel
from isa_nrsfm._joint.consensus import principal_shapes
from isa_nrsfm._joint.settings import FitSettings
from isa_nrsfm._linalg import OF_RANKS, orientations, polar
from isa_nrsfm._prepare.scaling import scaled_table, validated_table
from isa_nrsfm.calibration import orthonormal_cameras
from isa_nrsfm.isa._pipeline import leading_triplets


@scikit_learn.with_numpy_defaults
class ShapeSequenceNRSfM(
    base.ClassNamePrefixFeaturesOutMixin, base.TransformerMixin, base.BaseEstimator
):
    """
    Base of the methods that find one shape for each frame.

    A method implements `_factorise`, where it may set attributes of its own.

    Parameters
    ----------
    n_components : int, default=3
        K, the number of basis shapes besides the mean shape.
    layout : {"interleaved", "planar"}, default="interleaved"
        Order of the columns.
    scale_frames : bool, default=False
        Whether to divide each centred frame by the root mean square of its
        coordinates before the fit.
    ordered : bool, default=False
        Whether the rows are successive frames of a slowly turning camera. If True,
        each frame has the sign that turns the camera least from the frame before.
        If False, signs are chosen to make the shapes similar.
    """

    _parameter_constraints: ClassVar[dict[str, list[Any]]] = {
        "n_components": [scikit_learn.Interval(Integral, 1, None, closed="left")],
        "layout": [scikit_learn.StrOptions(set(_tables.LAYOUTS))],
        "scale_frames": ["boolean"],
        "ordered": ["boolean"],
    }

    def __init__(
        self,
        n_components: int = 3,
        *,
        layout: _tables.Layout = "interleaved",
        scale_frames: bool = False,
        ordered: bool = False,
    ):
        self.n_components = n_components
        self.layout = layout
        self.scale_frames = scale_frames
        self.ordered = ordered

    @abstractmethod
    def _factorise(self, W: NDArray) -> tuple[NDArray, NDArray]:
        """
        Return cameras (n_frames, 2, 3) and centred shapes (n_frames, n_points, 3).

        W (2 * n_frames, n_points) is in double precision, has centred rows and mean
        square one. Space may be turned or mirrored; signs of frames are chosen later.
        """

    @scikit_learn.fit_context(nested=False)
    @scikit_learn.one_blas_thread()
    def fit(self, X: Any, y: Any = None) -> Self:
        """
        Factorise a table.

        Parameters
        ----------
        X : array-like of shape (n_frames, 2 * n_points)
            The table, one frame a row, in the order of `layout`.
        y : None
            Ignored.

        Returns
        -------
        object
            The fitted estimator.

        Raises
        ------
        ValueError
            If X has an odd number of columns, missing points, infinite values, too few
            points or frames for `n_components`, a frame whose points are all equal, or
            column names that contradict `layout`.
        """
        X = self._checked(X, reset=True)
        settings = FitSettings(
            refinement=None,
            layout=self.layout,
            names=getattr(self, "feature_names_in_", None),
            scale_frames=self.scale_frames,
        )
        rows = _tables.open_table(X, self.layout)
        table = scaled_table(rows, None, self.n_components, settings)
        W = table.rows.whole().reshape(2 * len(X), -1).astype(np.float64)

        cameras, shapes = self._factorise(W)
        signs = camera_signs(cameras) if self.ordered else shape_signs(shapes)
        cameras, shapes = signs[:, None, None] * cameras, signs[:, None, None] * shapes
        space = canonical_rotation(shapes.mean(axis=0), cameras)
        cameras, shapes = cameras @ space.T, shapes @ space.T
        components, coefficients, _ = principal_shapes(shapes, self.n_components)
        sizes = np.linalg.norm(components, axis=(1, 2))
        moving = sizes[1:] > 1e-12 * sizes[0]  # others are rounding errors
        signs = np.where(moving, orientations(coefficients.T), 0.0)
        components[1:] *= signs[:, None, None]
        model = compose(components[0], components[1:], signs * coefficients)
        rests = [W - (cameras @ each.mT).reshape(W.shape) for each in (model, shapes)]
        noise, error = np.mean(np.square(rests), axis=(1, 2))
        self.inverse_snr_ = float(error / np.mean(W**2))

        # Without the scaling of frames the shapes have the unit of the table.
        unit, dtype, K = table.unit or 1.0, X.dtype, self.n_components
        public = (unit * components).astype(dtype)
        self.mean_shape_, self.basis_ = parts = public[0], public[1:]
        self.shapes_ = (unit * shapes).astype(dtype)
        self.motion_ = (table.sizes[:, None, None] / unit * cameras).astype(dtype)
        self.translation_ = table.translation.astype(dtype)
        # At least a share of the mean square of the coordinates.
        noise = max(float(noise), 1e-12)
        self.noise_variance_ = unit**2 * noise
        gauge, starts = FrameMap(np.eye(K + 1), unit * np.eye(3)), np.empty((0, K))
        camera = "orthographic"
        frames = FrameModel(components.mT, noise, starts, "linear", gauge, camera)
        self._model = TableModel(frames, *parts, K, self.layout, table.unit)
        self.alpha_ = self._decompose(X).alpha
        self._n_features_out = self.n_components
        return self

    def transform(self, X: Any) -> NDArray:
        """
        Return the coefficients of the frames of a table.

        Parameters
        ----------
        X : array-like of shape (n_frames, 2 * n_points)
            A table with the points of the fitted one.

        Returns
        -------
        ndarray of shape (n_frames, n_components)
            Coefficients from `decompose`; for the fitted table they are `alpha_`.
        """
        return self.decompose(X).alpha

    @scikit_learn.one_blas_thread()
    def decompose(self, X: Any) -> Decomposition:
        """
        Return camera and coefficients of each frame of a table.

        Each frame is fitted separately, by the principal shapes and an orthographic
        camera. The camera M_i maximises the likelihood with the coefficients integrated
        out. The coefficients minimise ``sum_j ||m_j - M_i (b_0j + sum_k alpha_ik b_kj)
        - t_i||^2 / s_i^2 + noise_variance_ * ||alpha_i||^2``. M_i has orthonormal rows
        times the scale s_i of the frame: one, or with `scale_frames` the root mean
        square of its centred coordinates. Frames without a unique camera are NaN.

        Parameters
        ----------
        X : array-like of shape (n_frames, 2 * n_points)
            A table with the points of the fitted one.

        Returns
        -------
        Decomposition
            Named tuple of motion (n_frames, 2, 3), translation (n_frames, 2), alpha and
            alpha_std (n_frames, n_components), which is NaN. For the fitted table the
            cameras differ from `motion_`, which belong to `shapes_`.
        """
        check_is_fitted(self)
        return self._decompose(self._checked(X, reset=False))

    def reconstruct(self, X: Any) -> NDArray:
        """
        Return the 3D shape of each frame of a table.

        Parameters
        ----------
        X : array-like of shape (n_frames, 2 * n_points)
            A table with the points of the fitted one.

        Returns
        -------
        ndarray of shape (n_frames, n_points, 3)
            Shapes of the model in the space of `mean_shape_`, without camera. For the
            fitted table they differ from `shapes_`, the result of the method itself.
        """
        return compose(self.mean_shape_, self.basis_, self.decompose(X).alpha)

    def reproject(self, X: Any) -> NDArray:
        """
        Return the images of the fitted model, as a table.

        Parameters
        ----------
        X : array-like of shape (n_frames, 2 * n_points)
            A table with the points of the fitted one.

        Returns
        -------
        ndarray of shape (n_frames, 2 * n_points)
            Points of the model's shapes in their cameras, in the order of `layout`.
            `inverse_snr_` refers to `shapes_` in `motion_` instead.
        """
        return self._model.reproject(self.decompose(X))

    def __sklearn_tags__(self) -> Any:
        """Return the estimator's tags."""
        tags = super().__sklearn_tags__()
        tags.transformer_tags.preserves_dtype = ["float64", "float32"]
        return tags

    def _checked(self, X: Any, reset: bool) -> NDArray:
        """Return a valid table without missing points."""
        X = validated_table(self, X, self.layout, reset)
        rows = np.flatnonzero(np.isnan(X).any(axis=1))
        if len(rows):
            raise ValueError(
                f"{type(self).__name__} takes no missing points (NaN), which "
                f"{len(rows)} of {len(X)} rows have (first: row {rows[0]}). Remove "
                "these rows, or use AffineNRSfM"
            )
        return X

    def _decompose(self, X: NDArray) -> Decomposition:
        """Return camera and coefficients of each frame of a valid table."""
        rows = _tables.table_to_rows(X, self.layout).astype(np.float64)
        if self.scale_frames:
            _, report = _tables.centred_frames(rows)
            _tables.refuse_one_place(report, rows.shape[2])
        return self._model.decompose(rows, deviations=False, dtype=X.dtype)


def shape_signs(shapes: NDArray) -> NDArray:
    """Return signs z_i of shapes (n_frames, n_points, 3) that make them similar.

    Each z_i S_i has a non-negative inner product with ``sum_i z_i S_i``, from the first
    left singular vector.
    """
    rows = shapes.reshape(len(shapes), -1)
    signs = _sign(np.linalg.svd(rows, full_matrices=False)[0][:, 0])
    for _ in range(100):  # each round increases the sum, a few are enough
        changed = _sign(rows @ (signs @ rows))
        if (changed == signs).all():
            break
        signs = changed
    return signs


def camera_signs(cameras: NDArray) -> NDArray:
    """Return signs of cameras (n_frames, 2, 3) that turn them least between frames."""
    agreement = np.einsum("irc,irc->i", cameras[1:], cameras[:-1])
    return np.cumprod(np.concatenate([[1.0], _sign(agreement)]))


def _sign(values: NDArray) -> NDArray:
    """Return 1.0 or -1.0 for each value."""
    return np.where(values < 0, -1.0, 1.0)


def least_norm_factors(W: NDArray, rank: int) -> tuple[NDArray, NDArray]:
    """Return orthographic cameras R_i (I, 2, 3) and flat shapes that reproduce W.

    The cameras are nearest to `orthonormal_cameras` in the span of the first ``3 *
    rank`` left singular vectors. The shapes have the least norm, ``S_i = R_i^+ W_i``.
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
    cameras = polar(orthonormal_cameras(motion, noise_variance).cameras)[0]
    return cameras, W.reshape(len(cameras), 2, -1).transpose(0, 2, 1) @ cameras


def shrink(shapes: NDArray, amount: float, rank: int | None = None) -> NDArray:
    """Subtract an amount from the singular values of shapes, and keep the first ones.

    They are those of the matrix with one row for each frame.
    """
    U, S, Vt = np.linalg.svd(shapes.reshape(len(shapes), -1), full_matrices=False)
    S = np.maximum(S - amount, 0.0)[:rank]
    return ((U[:, :rank] * S) @ Vt[:rank]).reshape(shapes.shape)


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
        cameras, shapes = least_norm_factors(W, rank)
        return cameras, shrink(shapes, 0.0, rank)


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
        "max_iter": [scikit_learn.Interval(Integral, 1, None, closed="left")],
        "tol": [scikit_learn.Interval(Real, 0, None, closed="left")],
    }

    def __init__(
        self,
        n_components: int = 3,
        *,
        layout: _tables.Layout = "interleaved",
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
        cameras, shapes = least_norm_factors(W, rank)
        self.n_iter_, converged = 0, True
        for price in 4.0 ** -np.arange(18):
            shapes, settled = self._minimised(W, cameras, price, shapes)
            converged &= settled
        if not converged:
            warn_caller(
                f"the shapes did not converge in max_iter={self.max_iter} steps; "
                "increase max_iter or tol",
                ConvergenceWarning,
            )
        return cameras, shrink(shapes, 0.0, rank)

    def _minimised(
        self, W: NDArray, cameras: NDArray, price: float, shapes: NDArray
    ) -> tuple[NDArray, bool]:
        """Minimise ``mu ||S||_* + 1/2 sum_i ||W_i - R_i S_i||_F^2`` over the shapes.

        S has one row for each frame, mu is the price. Proximal gradient steps of length
        one have Nesterov's momentum, reset when it leads up (Beck, Teboulle 2009;
        O'Donoghue, Candes 2015). Returns shapes (I, J, 3), and whether the last
        relative change was at most `tol`.
        """
        images = W.reshape(len(cameras), 2, -1).transpose(0, 2, 1)
        # The curvature of the images is one, as the cameras have orthonormal rows.
        ahead, momentum = shapes, 1.0
        for _ in range(self.max_iter):
            self.n_iter_ += 1
            error = ahead @ cameras.transpose(0, 2, 1) - images
            moved = shrink(ahead - error @ cameras, price)
            change = moved - shapes
            settled = bool(np.linalg.norm(change) <= self.tol * np.linalg.norm(shapes))
            if np.vdot(ahead - moved, change) > 0:
                ahead, momentum = moved, 1.0
            else:
                larger = 0.5 + np.sqrt(0.25 + momentum**2)
                ahead = moved + (momentum - 1.0) / larger * change
                momentum = larger
            shapes = moved
            if settled:
                break
        return shapes, settled
