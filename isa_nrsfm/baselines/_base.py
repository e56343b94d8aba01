"""Common base of the baselines: from a table to a camera and a shape for each frame.

A method finds an orthographic camera and a 3D shape for each frame of a table. Other
frames are fitted by the mean and the principal components of these shapes.

With one shape for each frame the sign of a frame is undetermined: the camera -R_i sees
-S_i as R_i sees S_i.
"""

from abc import abstractmethod
from numbers import Integral
from typing import Any, ClassVar, Self

import numpy as np
from numpy.typing import NDArray
from sklearn.base import (
    BaseEstimator,
    ClassNamePrefixFeaturesOutMixin,
    TransformerMixin,
)
from sklearn.utils.validation import check_is_fitted

from isa_nrsfm._compat.scikit_learn import (
    Interval,
    StrOptions,
    fit_context,
    one_blas_thread,
    with_numpy_defaults,
)
from isa_nrsfm._frames.camera_models import CAMERAS, compose, project
from isa_nrsfm._frames.gauge import canonical_rotation
from isa_nrsfm._frames.models import Decomposition
from isa_nrsfm._frames.search import FrameSearch
from isa_nrsfm._joint.consensus import principal_shapes
from isa_nrsfm._joint.settings import FitSettings
from isa_nrsfm._linalg import orientations
from isa_nrsfm._prepare.scaling import scaled_table, validated_table
from isa_nrsfm._tables import (
    LAYOUTS,
    Layout,
    centred_frames,
    open_table,
    refuse_one_place,
    table_to_rows,
    tracks_to_table,
)


@with_numpy_defaults
class ShapeSequenceNRSfM(
    ClassNamePrefixFeaturesOutMixin, TransformerMixin, BaseEstimator
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
        "n_components": [Interval(Integral, 1, None, closed="left")],
        "layout": [StrOptions(set(LAYOUTS))],
        "scale_frames": ["boolean"],
        "ordered": ["boolean"],
    }

    def __init__(
        self,
        n_components: int = 3,
        *,
        layout: Layout = "interleaved",
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

    @fit_context(nested=False)
    @one_blas_thread
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
        rows = open_table(X, self.layout)
        table = scaled_table(rows, None, self.n_components, settings)
        W = table.rows.whole().reshape(2 * len(X), -1).astype(np.float64)

        cameras, shapes = self._factorise(W)
        signs = camera_signs(cameras) if self.ordered else shape_signs(shapes)
        cameras, shapes = signs[:, None, None] * cameras, signs[:, None, None] * shapes
        space = canonical_rotation(shapes.mean(axis=0), cameras)
        cameras, shapes = cameras @ space.T, shapes @ space.T
        components, coefficients, _ = principal_shapes(shapes, self.n_components)
        mean_shape, basis = components[0], components[1:]
        # Smaller deformations are rounding errors.
        moving = np.linalg.norm(basis, axis=(1, 2)) > 1e-12 * np.linalg.norm(mean_shape)
        signs = np.where(moving, orientations(coefficients.T), 0.0)
        basis = signs[:, None, None] * basis
        model = compose(mean_shape, basis, signs * coefficients)
        rests = [W - (cameras @ each.mT).reshape(W.shape) for each in (model, shapes)]
        noise, error = np.mean(np.square(rests), axis=(1, 2))
        self.inverse_snr_ = float(error / np.mean(W**2))

        # Without the scaling of frames the shapes have the unit of the table.
        self._unit = table.unit or 1.0
        scales = (table.sizes / self._unit)[:, None, None]
        dtype = X.dtype
        self.mean_shape_ = (self._unit * mean_shape).astype(dtype)
        self.basis_ = (self._unit * basis).astype(dtype)
        self.shapes_ = (self._unit * shapes).astype(dtype)
        self.motion_ = (scales * cameras).astype(dtype)
        self.translation_ = table.translation.astype(dtype)
        # At least a share of the mean square of the coordinates.
        self.noise_variance_ = self._unit**2 * max(float(noise), 1e-12)
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

    @one_blas_thread
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
        motion, translation, alpha, _ = self.decompose(X)
        shapes = compose(self.mean_shape_, self.basis_, alpha)
        return tracks_to_table(project(shapes, motion, translation), self.layout)

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
        rows = table_to_rows(X, self.layout).astype(np.float64)
        sizes = np.full(len(rows), self._unit)
        if self.scale_frames:
            _, report = centred_frames(rows)
            refuse_one_place(report, rows.shape[2])
            sizes = report.size
        shapes = np.concatenate([self.mean_shape_[None], self.basis_]) / self._unit
        shapes = shapes.transpose(0, 2, 1).astype(float)
        search = FrameSearch(shapes, CAMERAS["orthographic"])
        noise = self.noise_variance_ / self._unit**2
        fits = search.fit_rows(rows / sizes[:, None, None], noise, covariances=False)
        motion = (sizes / self._unit)[:, None, None] * fits.motion
        translation = sizes[:, None] * fits.translation
        found = (motion, translation, fits.alpha, np.full_like(fits.alpha, np.nan))
        return Decomposition(*(part.astype(X.dtype) for part in found))


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
