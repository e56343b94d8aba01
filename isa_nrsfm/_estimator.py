"""AffineNRSfM: the scikit-learn transformer on top of the stages."""

import time
import warnings
from numbers import Integral, Real
from typing import Any, ClassVar, NamedTuple, Self

import numpy as np
from numpy.typing import NDArray
from sklearn.base import (
    BaseEstimator,
    ClassNamePrefixFeaturesOutMixin,
    TransformerMixin,
    _fit_context,
    clone,
)
from sklearn.exceptions import ConvergenceWarning
from sklearn.utils import check_array, check_random_state
from sklearn.utils._param_validation import HasMethods, Interval, StrOptions
from sklearn.utils.validation import check_is_fitted, validate_data

from isa_nrsfm._block_structure import BLOCK_RECOVERIES
from isa_nrsfm._camera import reference_camera
from isa_nrsfm._frame_fit import FrameFit, compose, fit_frames, project
from isa_nrsfm._gauge import canonical_gauge, image_energies, reorder_blocks
from isa_nrsfm._paper import run_paper_pipeline
from isa_nrsfm._tracks import (
    LAYOUTS,
    Layout,
    centred_tracks,
    check_complete,
    check_names,
    check_size,
    measurement_matrix,
    relative_precision,
    table_to_tracks,
    tracks_to_table,
    warn_if_other_layout,
    weighting_sizes,
)
from isa_nrsfm.isa import PooledFastICA


class Decomposition(NamedTuple):
    """
    Camera and coefficients of each frame of a table.

    Attributes
    ----------
    motion : ndarray of shape (n_frames, 2, 3)
        Affine cameras.
    translation : ndarray of shape (n_frames, 2)
        Images of the shapes' centroid.
    alpha : ndarray of shape (n_frames, n_components)
        Coefficients of the basis shapes.
    """

    motion: NDArray
    translation: NDArray
    alpha: NDArray


class AffineNRSfM(ClassNamePrefixFeaturesOutMixin, TransformerMixin, BaseEstimator):
    """
    Affine non-rigid structure from motion by independent subspace analysis.

    Factorises a table of 2D landmarks, one frame a row, into a mean 3D shape, basis
    shapes, and for each frame a camera and coefficients that do not depend on the
    viewpoint. No calibration, training data or order of the frames is needed. Row i,
    reshaped to (n_points, 2), is modelled as::

        (mean_shape_ + tensordot(alpha_[i], basis_, 1)) @ motion_[i].T + translation_[i]

    Parameters
    ----------
    n_components : int, default=3
        K, the number of basis shapes. K needs at least 3K + 4 points and
        ``ceil(8 (K + 2) / 5)`` frames.
    isa : object, default=None
        Strategy of independent subspace analysis, such as `FastISA` or
        `PooledFastICA`, with subspaces of size three; None is ``PooledFastICA()``. A
        clone is fitted; where its `random_state`, `n_jobs` or `verbose` is None or 0
        it gets that of this estimator (a seed drawn from it).
    block_recovery : {"generalized_eigen", "eigen", "irls"}, default=\
"generalized_eigen"
        How the 3x3 matrix of each subspace is found that brings its motion to the
        rigid motion: "eigen" is the exact minimiser under a norm constraint, "irls"
        the published iteration for the same cost, "generalized_eigen" maximises the
        share of the motion that is explained. The first two can collapse onto a
        direction in which the subspace hardly moves, and "irls" depends on which
        frame comes first; the default does neither. With `refinement` all three
        lead to nearly the same result, because it starts from more places.
    refinement : {"alternating", None}, default="alternating"
        "alternating" is the paper's alternating least squares for basis shapes and
        coefficients, with the rigid cameras held.
    layout : {"interleaved", "planar"}, default="interleaved"
        Whether the columns are x0, y0, x1, y1, ... or x0, x1, ..., y0, y1, ...
    scale_frames : bool, default=True
        Whether each centred frame is divided by the root mean square of its
        coordinates before the fit, so that photos of any resolution count alike;
        the scale is given back to `motion_`. With False frames count by their size.
    max_iter : int, default=200
        The most steps of the refinement.
    tol : float, default=1e-10
        The refinement has converged when a step would gain less than this share of
        the energy it explains.
    random_state : int, RandomState instance or None, default=None
        Seeds the strategy; an int makes the result reproducible.
    n_jobs : int or None, default=None
        Number of joblib workers for strategies that use them.
    verbose : int, default=0
        Above zero, print a line for each stage.

    Attributes
    ----------
    mean_shape_ : ndarray of shape (n_points, 3)
        Mean shape B_0, centred and white: the mean of ``b b^T`` over the points is
        the identity (of rank two for flat objects). x and y are the axes of the mean
        camera (so y points down for image coordinates), z is depth; its mirror image
        fits as well.
    basis_ : ndarray of shape (n_components, n_points, 3)
        Basis shapes B_k, centred, by decreasing energy in the images; one standard
        deviation of `alpha_` each. Those the table has no motion for are zero.
    alpha_ : ndarray of shape (n_frames, n_components)
        Coefficients of the frames, with unit variance over the frames and a third
        moment that is not negative.
    motion_ : ndarray of shape (n_frames, 2, 3)
        Affine cameras, in the units of the table.
    translation_ : ndarray of shape (n_frames, 2)
        Centroids of the frames, in the units of the table.
    inverse_snr_ : float
        ``||W - What||_F^2 / ||W||_F^2``, a fraction, with W the centred tracks, scaled
        as in the fit.
    rank_floor_ : float
        The least inverse SNR that any model of rank 3K + 3 reaches.
    energy_share_ : ndarray of shape (n_components,)
        Share of each basis shape in the energy of the deformations in the images,
        ``sum_i ||alpha_ik M_i B_k||_F^2``, frames scaled as in the fit.
    mode_covariance_ : ndarray of shape (3 * n_components, 3 * n_components)
        Covariance over the images of the 3K independent directions, 3x3 blocks in
        the order of `basis_`.
    singular_values_ : ndarray of shape (3 * n_components + 3,)
        Largest singular values of W, decreasing.
    reference_motion_ : ndarray of shape (2, 3)
        The camera that `inverse_transform` takes by default: the mean view of the
        table.
    reference_translation_ : ndarray of shape (2,)
        Its translation, the mean centroid.
    isa_ : object
        The fitted strategy.
    n_iter_ : int
        Steps of the refinement.
    n_features_in_ : int
        Number of columns.
    feature_names_in_ : ndarray of shape (n_features_in_,)
        Names of the columns, where the table is a dataframe with string names.

    See Also
    --------
    isa_nrsfm.isa.FastISA : Strategy with subspaces of its own (ISA1).
    isa_nrsfm.isa.PooledFastICA : FastICA with pooled components (ISA2).

    Notes
    -----
    Affine cameras determine the shapes up to one affinity of space and one scale a
    frame. The affinity is fixed as said above; angles and proportions in depth are
    not those of the object.

    References
    ----------
    S. Brandt, H. Ackermann, S. Grasshof, "Uncalibrated Non-Rigid Factorisation by
    Independent Subspace Analysis", 2018.

    C. Tomasi, T. Kanade, "Shape and motion from image streams under orthography: a
    factorization method", International Journal of Computer Vision 9, 1992.

    Examples
    --------
    >>> from isa_nrsfm import AffineNRSfM
    >>> from isa_nrsfm.datasets import make_face_tracks
    >>> faces = make_face_tracks(n_frames=200, random_state=0)
    >>> model = AffineNRSfM(n_components=4, random_state=0).fit(faces.data)
    >>> model.mean_shape_.shape, model.basis_.shape, model.alpha_.shape
    ((68, 3), (4, 68, 3), (200, 4))
    >>> model.transform(faces.data[:5]).shape
    (5, 4)
    """

    _parameter_constraints: ClassVar[dict[str, list[Any]]] = {
        "n_components": [Interval(Integral, 1, None, closed="left")],
        "isa": [None, HasMethods(["fit", "get_params", "set_params"])],
        "block_recovery": [StrOptions(set(BLOCK_RECOVERIES))],
        "refinement": [StrOptions({"alternating"}), None],
        "layout": [StrOptions(set(LAYOUTS))],
        "scale_frames": ["boolean"],
        "max_iter": [Interval(Integral, 1, None, closed="left")],
        "tol": [Interval(Real, 0, None, closed="left")],
        "random_state": ["random_state"],
        "n_jobs": [None, Integral],
        "verbose": ["verbose"],
    }

    def __init__(
        self,
        n_components: int = 3,
        *,
        isa: Any = None,
        block_recovery: str = "generalized_eigen",
        refinement: str | None = "alternating",
        layout: Layout = "interleaved",
        scale_frames: bool = True,
        max_iter: int = 200,
        tol: float = 1e-10,
        random_state: Any = None,
        n_jobs: int | None = None,
        verbose: int = 0,
    ):
        self.n_components = n_components
        self.isa = isa
        self.block_recovery = block_recovery
        self.refinement = refinement
        self.layout = layout
        self.scale_frames = scale_frames
        self.max_iter = max_iter
        self.tol = tol
        self.random_state = random_state
        self.n_jobs = n_jobs
        self.verbose = verbose

    @_fit_context(prefer_skip_nested_validation=False)
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
        AffineNRSfM
            The fitted estimator.

        Raises
        ------
        ValueError
            If X has an odd number of columns, missing or infinite values, too few
            points or frames for `n_components`, a frame whose points are all equal,
            or column names that contradict `layout`.
        """
        report = StageReport(self.verbose)
        X = validate_data(
            self,
            X,
            dtype=[np.float64, np.float32],
            ensure_all_finite="allow-nan",
            ensure_min_samples=2,
            ensure_min_features=2,
        )
        check_complete(X)
        check_names(getattr(self, "feature_names_in_", None), self.layout)
        tracks = table_to_tracks(X, self.layout)
        check_size(len(tracks), tracks.shape[1], self.n_components)
        centred, translation = centred_tracks(tracks)
        warn_if_other_layout(X, self.layout, self.scale_frames)
        sizes = weighting_sizes(centred, self.scale_frames)
        report("table")

        self.isa_ = self._strategy()
        result = run_paper_pipeline(
            measurement_matrix(centred / sizes[:, None, None]),
            self.n_components,
            self.isa_,
            precision=relative_precision(tracks, sizes),
            block_recovery=self.block_recovery,
            refinement=self.refinement,
            max_iter=self.max_iter,
            tol=self.tol,
            report=report,
        )
        if not result.converged:
            warnings.warn(
                f"the refinement did not converge in max_iter={self.max_iter} steps; "
                "increase max_iter or tol",
                ConvergenceWarning,
                stacklevel=3,
            )
        paper = fit_frames(centred, translation, result.mean_shape, result.basis)
        gauge = canonical_gauge(
            result.mean_shape,
            result.basis,
            paper.motion / sizes[:, None, None],
            paper.alpha,
        )
        self.mean_shape_ = gauge.mean_shape.astype(X.dtype)
        self.basis_ = gauge.basis.astype(X.dtype)
        unit = 1.0 if self.scale_frames else sizes[0]
        covariance = reorder_blocks(result.mode_covariance, gauge.order)
        self.mode_covariance_ = unit**2 * covariance
        self.singular_values_ = unit * result.singular_values
        self.rank_floor_ = result.rank_floor
        self.n_iter_ = result.n_iter
        self._n_features_out = self.n_components

        # The coefficients are those that transform gives, from the stored shapes.
        frames = fit_frames(centred, translation, self.mean_shape_, self.basis_)
        self.inverse_snr_ = self._inverse_snr(centred, frames)
        cameras = frames.motion / sizes[:, None, None]
        energy = image_energies(cameras, self.basis_, frames.alpha)
        self.energy_share_ = energy / (energy.sum() or 1.0)
        self.reference_motion_ = reference_camera(cameras, sizes).astype(X.dtype)
        self.reference_translation_ = translation.mean(axis=0).astype(X.dtype)
        self.motion_, self.translation_, self.alpha_ = as_type(frames, X.dtype)
        report("gauge, cameras and coefficients")
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

        Each frame is fitted by itself: its result does not depend on the others.

        Parameters
        ----------
        X : array-like of shape (n_frames, 2 * n_points)
            A table with the points of the fitted one.

        Returns
        -------
        ndarray of shape (n_frames, n_components)
            Coefficients; those of the fitted table are `alpha_`.
        """
        return self.decompose(X).alpha

    def decompose(self, X: Any) -> Decomposition:
        """
        Return camera and coefficients of each frame of a table.

        Parameters
        ----------
        X : array-like of shape (n_frames, 2 * n_points)
            A table with the points of the fitted one.

        Returns
        -------
        Decomposition
            Named tuple of motion (n_frames, 2, 3), translation (n_frames, 2) and
            alpha (n_frames, n_components).
        """
        X = self._validated(X)
        return Decomposition(*as_type(self._fit_frames(X)[1], X.dtype))

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
            Shapes in the space of `mean_shape_`, without camera.
        """
        alpha = self.decompose(X).alpha
        return compose(self.mean_shape_, self.basis_, alpha)

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
            Points of the fitted shapes in the fitted cameras.
        """
        motion, translation, alpha = self.decompose(X)
        return self.inverse_transform(alpha, motion, translation)

    def inverse_transform(
        self, alpha: Any, motion: Any = None, translation: Any = None
    ) -> NDArray:
        """
        Return the table of shapes with given coefficients.

        Parameters
        ----------
        alpha : array-like of shape (n_frames, n_components)
            Coefficients.
        motion : array-like of shape (n_frames, 2, 3) or (2, 3), default=None
            Cameras; None is `reference_motion_`, the mean view of the fitted table.
        translation : array-like of shape (n_frames, 2) or (2,), default=None
            Positions; None is `reference_translation_`, the mean centroid of the
            fitted table.

        Returns
        -------
        ndarray of shape (n_frames, 2 * n_points)
            The table, in the order of `layout`.

        Raises
        ------
        ValueError
            If the shapes do not fit the model or each other.
        """
        check_is_fitted(self)
        alpha = check_array(alpha, dtype=[np.float64, np.float32], input_name="alpha")
        if motion is None:
            motion = self.reference_motion_
        if translation is None:
            translation = self.reference_translation_
        n_frames, n_components = len(alpha), len(self.basis_)
        alpha = checked("alpha", alpha, (n_frames, n_components))
        motion = checked("motion", motion, (n_frames, 2, 3), (2, 3))
        translation = checked("translation", translation, (n_frames, 2), (2,))
        shapes = compose(self.mean_shape_, self.basis_, alpha)
        return tracks_to_table(project(shapes, motion, translation), self.layout)

    def score(self, X: Any, y: Any = None) -> float:
        """
        Return minus the inverse SNR of the reprojection of a table.

        The reprojection improves with every basis shape: to choose `n_components`,
        score tables that were not fitted and look where it stops improving.

        Parameters
        ----------
        X : array-like of shape (n_frames, 2 * n_points)
            A table with the points of the fitted one.
        y : None
            Ignored.

        Returns
        -------
        float
            ``-||W - What||_F^2 / ||W||_F^2``, with W the centred tracks, scaled as in
            the fit; larger is better.
        """
        return -self._inverse_snr(*self._fit_frames(self._validated(X)))

    def __sklearn_tags__(self) -> Any:
        """Return the estimator's tags."""
        tags = super().__sklearn_tags__()
        tags.transformer_tags.preserves_dtype = ["float64", "float32"]
        return tags

    def _strategy(self) -> Any:
        """Return the unfitted strategy, with what it leaves open filled in."""
        isa = PooledFastICA() if self.isa is None else clone(self.isa)
        params = isa.get_params(deep=False)
        if params.get("subspace_size", 3) != 3:
            raise ValueError(
                "isa must have subspace_size=3, a dimension of space each; got "
                f"subspace_size={params['subspace_size']}"
            )
        if params.get("random_state", 0) is None:
            random_state = check_random_state(self.random_state)
            isa.set_params(random_state=random_state.randint(np.iinfo(np.int32).max))
        if params.get("n_jobs", 0) is None:
            isa.set_params(n_jobs=self.n_jobs)
        if params.get("verbose", 1) == 0:
            isa.set_params(verbose=self.verbose)
        return isa

    def _validated(self, X: Any) -> NDArray:
        """Return a table for the fitted model as an array."""
        check_is_fitted(self)
        return validate_data(self, X, dtype=[np.float64, np.float32], reset=False)

    def _fit_frames(self, X: NDArray) -> tuple[NDArray, FrameFit]:
        """Return the centred tracks of a valid table and the fit of its frames."""
        centred, translation = centred_tracks(table_to_tracks(X, self.layout))
        return centred, fit_frames(centred, translation, self.mean_shape_, self.basis_)

    def _inverse_snr(self, centred: NDArray, frames: FrameFit) -> float:
        """Return the inverse SNR of fitted frames, weighted as in the fit."""
        shapes = compose(self.mean_shape_, self.basis_, frames.alpha)
        residual = centred - project(shapes, frames.motion, np.zeros(2))
        weights = weighting_sizes(centred, self.scale_frames) ** -2.0
        noise = np.einsum("ijc,ijc,i->", residual, residual, weights, optimize=True)
        signal = np.einsum("ijc,ijc,i->", centred, centred, weights, optimize=True)
        return float(noise / signal)


def as_type(frames: FrameFit, dtype: Any) -> tuple[NDArray, NDArray, NDArray]:
    """Return motion, translation and alpha in the type of the table."""
    motion, translation, alpha = (part.astype(dtype, copy=False) for part in frames)
    return motion, translation, alpha


def checked(name: str, values: Any, *allowed: tuple[int, ...]) -> NDArray:
    """Return a finite array of one of the allowed shapes, or say what came."""
    array = check_array(
        values,
        dtype=[np.float64, np.float32],
        input_name=name,
        ensure_2d=False,
        allow_nd=True,
    )
    if array.shape not in allowed:
        expected = " or ".join(map(str, allowed))
        raise ValueError(f"{name} must have shape {expected}; got {array.shape}")
    return array


class StageReport:
    """Prints a line with the seconds of each stage, where it is wanted."""

    def __init__(self, verbose: int):
        self.verbose = verbose
        self.since = time.perf_counter()

    def __call__(self, stage: str) -> None:
        """Report that a stage has ended."""
        now = time.perf_counter()
        if self.verbose:
            print(f"[AffineNRSfM] {stage}: {now - self.since:.2f} s", flush=True)
        self.since = now
