"""What the methods of this folder have in common: tables in, shapes and cameras out.

A method finds an orthographic camera and a 3D shape for each frame of a table. It says
nothing about other frames. The estimators make a model of its shapes, their mean and
principal components, and fit that to the frames of any table.
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
from sklearn.utils.validation import check_is_fitted, validate_data

from isa_nrsfm._compat.blas_threads import one_blas_thread
from isa_nrsfm._compat.scikit_learn import Interval, StrOptions, fit_context
from isa_nrsfm._frames.projection import compose, project
from isa_nrsfm._gauge.canonical import canonical_rotation
from isa_nrsfm._prepare.checks import check_names, check_size
from isa_nrsfm._prepare.layout_check import warn_if_other_layout
from isa_nrsfm._tables.layout import (
    LAYOUTS,
    Layout,
    centred_tracks,
    measurement_matrix,
    table_to_tracks,
    tracks_to_table,
    weighting_sizes,
)
from isa_nrsfm._tables.sources import checked_range, unmasked
from isa_nrsfm._transformer import Decomposition
from isa_nrsfm.baselines._orthographic_frames import OrthographicFrames
from isa_nrsfm.baselines._shape_sequence import (
    ShapeSequence,
    camera_signs,
    principal_shapes,
    shape_signs,
)

# Least variance of the noise, relative to the mean square of the coordinates.
LEAST_NOISE = 1e-12


class ShapeSequenceNRSfM(
    ClassNamePrefixFeaturesOutMixin, TransformerMixin, BaseEstimator
):
    """
    Base of the methods that find a shape for each frame of a table.

    A method implements `_factorise`, where it may set attributes of its own, and adds
    its parameters to these.

    Parameters
    ----------
    n_components : int
        K, the number of basis shapes besides the mean shape.
    layout : {"interleaved", "planar"}
        Order of the columns.
    scale_frames : bool
        Whether each centred frame is divided by the root mean square of its
        coordinates before the fit.
    ordered : bool
        Whether the rows are successive frames of a camera that turns little from one
        to the next, which tells the sign of each frame's camera and shape. Otherwise
        the signs are those with which the shapes resemble each other.
    """

    mean_shape_: NDArray
    basis_: NDArray
    shapes_: NDArray
    alpha_: NDArray
    motion_: NDArray
    translation_: NDArray
    inverse_snr_: float
    noise_variance_: float
    n_features_in_: int
    feature_names_in_: NDArray

    _parameter_constraints: ClassVar[dict[str, list[Any]]] = {
        "n_components": [Interval(Integral, 1, None, closed="left")],
        "layout": [StrOptions(set(LAYOUTS))],
        "scale_frames": ["boolean"],
        "ordered": ["boolean"],
    }

    def __init__(
        self, n_components: int, *, layout: Layout, scale_frames: bool, ordered: bool
    ):
        self.n_components = n_components
        self.layout = layout
        self.scale_frames = scale_frames
        self.ordered = ordered

    @abstractmethod
    def _factorise(self, W: NDArray) -> ShapeSequence:
        """
        Return cameras and shapes of a measurement matrix.

        Parameters
        ----------
        W : ndarray of shape (2 * n_frames, n_points)
            For each frame the row of x, then of y, in double precision, rows centred;
            the mean square of the entries is one, with `scale_frames` in each frame.

        Returns
        -------
        ShapeSequence
            In any orientation of space, mirrored or not; the signs of frames are
            chosen afterwards.
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
        tracks = self._tracks(X, reset=True)
        names = getattr(self, "feature_names_in_", None)
        check_names(names, self.layout)
        check_size(len(tracks), tracks.shape[1], self.n_components)
        centred, translation = centred_tracks(tracks)
        warn_if_other_layout(
            tracks_to_table(tracks, self.layout), self.layout, self.scale_frames
        )
        sizes = weighting_sizes(centred, self.scale_frames)
        W = measurement_matrix(centred / sizes[:, None, None])

        cameras, shapes = self._factorise(W)
        signs = camera_signs(cameras) if self.ordered else shape_signs(shapes)
        cameras, shapes = signs[:, None, None] * cameras, signs[:, None, None] * shapes
        space = canonical_rotation(shapes.mean(axis=0), cameras)
        cameras, shapes = cameras @ space.T, shapes @ space.T
        mean_shape, basis, coefficients = principal_shapes(shapes, self.n_components)
        model = compose(mean_shape, basis, coefficients)
        noise = np.mean((W - _images(cameras, model)) ** 2)
        error = np.mean((W - _images(cameras, shapes)) ** 2)
        self.inverse_snr_ = float(error / np.mean(W**2))

        # Without the scaling of frames the shapes have the unit of the table.
        self._unit = 1.0 if self.scale_frames else float(sizes[0])
        scales = (sizes / self._unit)[:, None, None]
        dtype = tracks.dtype
        self.mean_shape_ = (self._unit * mean_shape).astype(dtype)
        self.basis_ = (self._unit * basis).astype(dtype)
        self.shapes_ = (self._unit * shapes).astype(dtype)
        self.motion_ = (scales * cameras).astype(dtype)
        self.translation_ = translation.astype(dtype)
        self.noise_variance_ = self._unit**2 * max(float(noise), LEAST_NOISE)
        self.alpha_ = self._decompose(tracks).alpha
        self._n_features_out = self.n_components
        return self

    def fit_transform(self, X: Any, y: Any = None) -> NDArray:
        """
        Factorise a table and return the coefficients of its frames.

        Parameters
        ----------
        X : array-like of shape (n_frames, 2 * n_points)
            The table, one frame a row, in the order of `layout`.
        y : None
            Ignored.

        Returns
        -------
        ndarray of shape (n_frames, n_components)
            `alpha_`.
        """
        return self.fit(X).alpha_.copy()

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
            Coefficients, as of `decompose`; those of the fitted table are `alpha_`.
        """
        return self.decompose(X).alpha

    @one_blas_thread
    def decompose(self, X: Any) -> Decomposition:
        """
        Return camera and coefficients of each frame of a table.

        Each frame is fitted by itself, with a camera as in the fit and the principal
        shapes: ``sum_j ||m_j - M_i (b_0j + sum_k alpha_ik b_kj) - t_i||^2 / s_i^2 +
        noise_variance_ * ||alpha_i||^2`` is least, where M_i has orthonormal rows
        times the scale s_i of the frame. It is one without `scale_frames`, and with it
        the root mean square of the centred coordinates of the frame.

        Parameters
        ----------
        X : array-like of shape (n_frames, 2 * n_points)
            A table with the points of the fitted one.

        Returns
        -------
        Decomposition
            Named tuple of motion (n_frames, 2, 3), translation (n_frames, 2), alpha and
            alpha_std (n_frames, n_components), which is NaN. For the fitted table the
            cameras are not `motion_`, which belong to `shapes_`.
        """
        check_is_fitted(self)
        return self._decompose(self._tracks(X, reset=False))

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
            Shapes of the model in the space of `mean_shape_`, without camera. Those of
            the fitted table are not `shapes_`, which is what the method itself finds.
        """
        return compose(self.mean_shape_, self.basis_, self.decompose(X).alpha)

    def reproject(self, X: Any) -> NDArray:
        """
        Return a table as the model sees it.

        Parameters
        ----------
        X : array-like of shape (n_frames, 2 * n_points)
            A table with the points of the fitted one.

        Returns
        -------
        ndarray of shape (n_frames, 2 * n_points)
            Points of the model's shapes in their cameras, in the order of `layout`.
            `inverse_snr_` is not of these, but of `shapes_` in `motion_`.
        """
        motion, translation, alpha, _ = self.decompose(X)
        shapes = compose(self.mean_shape_, self.basis_, alpha)
        return tracks_to_table(project(shapes, motion, translation), self.layout)

    def __sklearn_tags__(self) -> Any:
        """Return the estimator's tags."""
        tags = super().__sklearn_tags__()
        tags.transformer_tags.preserves_dtype = ["float64", "float32"]
        return tags

    def _tracks(self, X: Any, reset: bool) -> NDArray:
        """Return the tracks of a valid table without missing points."""
        X = validate_data(
            self,
            unmasked(X),
            dtype=[np.float64, np.float32],
            ensure_all_finite="allow-nan",
            ensure_min_samples=2 if reset else 1,
            ensure_min_features=2 if reset else 1,
            reset=reset,
        )
        checked_range(X)
        missing = np.isnan(X)
        if missing.any():
            rows = np.flatnonzero(missing.any(axis=1))
            raise ValueError(
                f"{type(self).__name__} takes no missing points (NaN); X has "
                f"{missing.sum()} missing value(s) in {len(rows)} of {len(X)} row(s), "
                f"the first is row {rows[0]}: leave such rows out, or use AffineNRSfM"
            )
        return table_to_tracks(X, self.layout)

    def _decompose(self, tracks: NDArray) -> Decomposition:
        """Return camera and coefficients of each frame of valid tracks."""
        centred, translation = centred_tracks(tracks)
        sizes = np.full(len(tracks), self._unit)
        if self.scale_frames:
            sizes = weighting_sizes(centred, True)
        frames = OrthographicFrames(
            self.mean_shape_.astype(np.float64) / self._unit,
            self.basis_.astype(np.float64) / self._unit,
            self.noise_variance_ / self._unit**2,
        )
        cameras, alpha = frames.fit(centred / sizes[:, None, None])
        motion = (sizes / self._unit)[:, None, None] * cameras
        found = (motion, translation, alpha, np.full_like(alpha, np.nan))
        return Decomposition(*(part.astype(tracks.dtype) for part in found))


def _images(cameras: NDArray, shapes: NDArray) -> NDArray:
    """Return the measurement matrix of shapes in cameras."""
    return measurement_matrix(shapes @ cameras.transpose(0, 2, 1))
