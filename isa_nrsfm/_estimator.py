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
from isa_nrsfm._completion import complete_tracks
from isa_nrsfm._deformation_metric import deformation_metric, euclidean_frames
from isa_nrsfm._diagnostics import Diagnostics, diagnose, reliabilities
from isa_nrsfm._frame_fit import (
    FrameFit,
    PosteriorFrames,
    RigidFrames,
    compose,
    project,
)
from isa_nrsfm._frame_posterior import spread_starts
from isa_nrsfm._gauge import (
    canonical_gauge,
    image_energies,
    mode_covariance,
    reorder_blocks,
)
from isa_nrsfm._held_out import held_out_error
from isa_nrsfm._independent_gauge import (
    INDEPENDENCE,
    FrameMap,
    independent_gauge,
)
from isa_nrsfm._joint_fit import fit_jointly
from isa_nrsfm._metric_refinement import CAMERA_MODELS
from isa_nrsfm._paper import PaperResult, run_paper_pipeline
from isa_nrsfm._robust import LOSSES, gross_outliers, robust_sizes
from isa_nrsfm._table_checks import (
    check_names,
    check_points,
    check_size,
    clean_tracks,
    warn_if_other_layout,
)
from isa_nrsfm._tracks import (
    LAYOUTS,
    Layout,
    centred_tracks,
    check_frames,
    measurement_matrix,
    relative_precision,
    table_to_tracks,
    tracks_to_table,
    usable_frames,
    weighting_sizes,
)
from isa_nrsfm.isa import PooledFastICA

# Tolerances where none is given: for each frame, of minus twice the log likelihood, and
# for the paper's refinement, of the energy that it explains.
JOINT_TOL, PAPER_TOL = 0.05, 1e-10
# Runs of FastICA, and steps and tolerance of the paper's refinement, where the result
# is only a start.
START_RUNS, START_STEPS, START_TOL = 2, 200, 1e-5
# Coefficients of frames from which the fit of a frame starts besides zero.
N_STARTS = 8


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
        `PooledFastICA`, with subspaces of size three; None is ``PooledFastICA()``, with
        two runs where the joint refinement only starts from it. A clone is fitted;
        where its `random_state`, `n_jobs` or `verbose` is None or 0 it gets that of
        this estimator (a seed drawn from it).
    block_recovery : {"generalized_eigen", "eigen", "irls"}, default=\
"generalized_eigen"
        How the 3x3 matrix of each subspace is found that brings its motion to the
        rigid motion: "eigen" is the exact minimiser under a norm constraint, "irls"
        the published iteration for the same cost, "generalized_eigen" maximises the
        share of the motion that is explained. The first two can collapse onto a
        direction in which the subspace hardly moves, and "irls" depends on which
        frame comes first; the default does neither. With `refinement` all three
        lead to nearly the same result, because it starts from more places.
    refinement : {"joint", "alternating", None}, default="joint"
        "joint" finds the cameras, shapes and noise variance of greatest marginal
        likelihood, the coefficients being drawn from a normal distribution; it starts
        from the paper's result and recovers the true shapes as far as the images
        determine them. "alternating" is the paper's alternating least squares for
        basis shapes and coefficients, with the rigid cameras held.
    independence : {"shapes", "coefficients", None}, default="shapes"
        What fixes the basis of the joint refinement, which any mixing of its basis
        shapes leaves as likely: "shapes" makes these independent of each other over the
        points, as the paper assumes, "coefficients" makes their coefficients
        independent over the frames, and None takes the principal axes of the
        deformation. Shapes of frames, reprojection and score do not depend on it.
    loss : {"linear", "huber", "cauchy"}, default="linear"
        How points count that are far from the model: with "huber" from 1.5 and with
        "cauchy" from 2.5 standard deviations of the noise, which is estimated from the
        median, less than by their square. Only for the joint refinement.
    stiffness : float or None, default=None
        Price of what the basis shapes move in the images, added to minus twice the log
        likelihood: ``stiffness * sum_ik ||M_i B_k||_F^2`` for frames of size one. With
        free affine cameras large deformations, as in motion capture, can hardly be told
        from camera motion and drift away without it; on faces it is not needed. None
        chooses between 0 and 300 by what it does to the cameras, which should be close
        to scaled orthographic ones.
    layout : {"interleaved", "planar"}, default="interleaved"
        Whether the columns are x0, y0, x1, y1, ... or x0, x1, ..., y0, y1, ...
    scale_frames : bool, default=True
        Whether each centred frame is divided by the root mean square of its
        coordinates before the fit, so that photos of any resolution count alike;
        the scale is given back to `motion_`. With False frames count by their size.
    max_iter : int, default=1000
        The most steps of the refinement.
    tol : float or None, default=None
        The joint refinement has converged when two successive steps each lower minus
        twice the log likelihood by less than tol for each frame (0.05 by default), and
        the alternating one when a step would gain less than this share of the energy
        it explains (1e-10 by default).
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
        moment that is not negative; after the joint refinement with mean zero.
    alpha_std_ : ndarray of shape (n_frames, n_components)
        Their posterior standard deviations, shapes and noise being known (joint
        refinement only).
    motion_ : ndarray of shape (n_frames, 2, 3)
        Affine cameras, in the units of the table.
    translation_ : ndarray of shape (n_frames, 2)
        Images of the origin of the shapes, in the units of the table: the centroids of
        complete frames.
    inverse_snr_ : float
        ``||W - What||_F^2 / ||W||_F^2``, a fraction, with W the centred tracks, scaled
        as in the fit; of the points that are seen.
    rank_floor_ : float
        The least inverse SNR that any model of rank 3K + 3 reaches, missing points
        being filled in.
    noise_variance_ : float
        Variance of the noise of a coordinate; of frames of size one where frames are
        scaled (joint refinement only, as are the next four).
    stiffness_ : float
        The stiffness that was used.
    reliability_ : ndarray of shape (n_components,)
        Shares of the variance of the coefficients that are not uncertainty, along
        uncorrelated directions, decreasing.
    objective_history_ : ndarray of shape (n_iter_ + 1,)
        Minus twice the log marginal likelihood plus the price of the stiffness, before
        the refinement and after each of its steps; it never rises.
    gradient_norm_ : float
        Norm of its gradient at the end, in the metric of its curvature and relative to
        the root of the number of coordinates.
    energy_share_ : ndarray of shape (n_components,)
        Share of each basis shape in the energy of the deformations in the images,
        ``sum_i ||alpha_ik M_i B_k||_F^2``, frames scaled as in the fit.
    mode_covariance_ : ndarray of shape (3 * n_components, 3 * n_components)
        Covariance over the images of the 3K independent directions, 3x3 blocks in
        the order of `basis_`; after the joint refinement ``(1 / 2I) sum_i (alpha_i
        alpha_i^T) (x) (M_i^T M_i)``. Of frames of size one where frames are scaled.
    singular_values_ : ndarray of shape (3 * n_components + 3,)
        Largest singular values of W, decreasing.
    reference_motion_ : ndarray of shape (2, 3)
        The camera that `inverse_transform` takes by default: the mean view of the
        table.
    reference_translation_ : ndarray of shape (2,)
        Its translation, the mean centroid.
    isa_ : object
        The fitted strategy, of the paper's pipeline.
    n_iter_ : int
        Steps of the refinement; of a large table those with all of its frames.
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

    Points that are missing are NaN, in `fit` and everywhere else. A point of which only
    one coordinate is missing counts as missing, with a warning. Rows of which too
    little is seen to determine a camera are refused by `fit` and have NaN elsewhere.

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
        "refinement": [StrOptions({"joint", "alternating"}), None],
        "independence": [StrOptions(set(INDEPENDENCE)), None],
        "loss": [StrOptions(set(LOSSES))],
        "stiffness": [None, Interval(Real, 0, None, closed="left")],
        "layout": [StrOptions(set(LAYOUTS))],
        "scale_frames": ["boolean"],
        "max_iter": [Interval(Integral, 1, None, closed="left")],
        "tol": [None, Interval(Real, 0, None, closed="left")],
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
        refinement: str | None = "joint",
        independence: str | None = "shapes",
        loss: str = "linear",
        stiffness: float | None = None,
        layout: Layout = "interleaved",
        scale_frames: bool = True,
        max_iter: int = 1000,
        tol: float | None = None,
        random_state: Any = None,
        n_jobs: int | None = None,
        verbose: int = 0,
    ):
        self.n_components = n_components
        self.isa = isa
        self.block_recovery = block_recovery
        self.refinement = refinement
        self.independence = independence
        self.loss = loss
        self.stiffness = stiffness
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
            If X has an odd number of columns, infinite values, too few points or
            frames for `n_components`, a frame whose points are all equal, that shows
            fewer than four points or some on one line only, a point that is seen in too
            few frames, or column names that contradict `layout`; or if `loss` is not
            linear without the joint refinement.
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
        if self.refinement != "joint" and self.loss != "linear":
            raise ValueError(
                f"loss={self.loss!r} needs refinement='joint'; "
                f"got refinement={self.refinement!r}"
            )
        names = getattr(self, "feature_names_in_", None)
        check_names(names, self.layout)
        tracks = clean_tracks(table_to_tracks(X, self.layout), self.layout, names)
        check_size(len(tracks), tracks.shape[1], self.n_components)
        check_frames(tracks)
        check_points(tracks, self.n_components, self.layout, names)
        centred, translation = centred_tracks(tracks)
        warn_if_other_layout(X, self.layout, self.scale_frames)
        sizes = self._sizes(centred)
        unit = centred / sizes[:, None, None]
        self._frame_sizes = sizes
        self._unit = 1.0 if self.scale_frames else float(sizes[0])
        outliers = np.zeros(unit.shape[:2], dtype=bool)
        if self.loss != "linear":
            outliers = gross_outliers(unit)
        used, _ = centred_tracks(np.where(outliers[..., None], np.nan, unit))
        completion = complete_tracks(used, np.ones(len(unit)), self.n_components)
        W = measurement_matrix(completion.centred)
        report("table")

        self.isa_ = self._strategy()
        joint = self.refinement == "joint"
        with warnings.catch_warnings():
            if joint and self.isa is None:
                # It makes no difference to the joint refinement, which starts there.
                warnings.filterwarnings("ignore", "FastICA did not", ConvergenceWarning)
            result = run_paper_pipeline(
                W,
                self.n_components,
                self.isa_,
                precision=relative_precision(tracks, sizes),
                block_recovery=self.block_recovery,
                refinement="alternating" if joint else self.refinement,
                max_iter=START_STEPS if joint else self.max_iter,
                tol=START_TOL if joint else PAPER_TOL if self.tol is None else self.tol,
                report=report,
            )
        self.singular_values_ = self._unit * result.singular_values
        self.rank_floor_ = result.rank_floor
        self._n_features_out = self.n_components
        if joint:
            frames = self._refine_jointly(unit, sizes, outliers, W, result, X.dtype)
            report("joint refinement, gauge and coefficients")
        else:
            frames = self._keep(centred, sizes, completion.centred, result, X.dtype)
            report("gauge and coefficients")
        frames = frames._replace(translation=frames.translation + translation)
        self.inverse_snr_ = self._inverse_snr(tracks, sizes, frames)
        cameras = frames.motion / sizes[:, None, None]
        energy = image_energies(cameras, self.basis_, frames.alpha)
        self.energy_share_ = energy / (energy.sum() or 1.0)
        self.reference_motion_ = reference_camera(cameras, sizes).astype(X.dtype)
        self.reference_translation_ = frames.translation.mean(axis=0).astype(X.dtype)
        self.motion_, self.translation_, self.alpha_, deviation = as_type(
            frames, X.dtype
        )
        if joint:
            self.alpha_std_ = deviation
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
            Coefficients; those of the fitted table are `alpha_`. NaN for rows of which
            too little is seen.
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
        return Decomposition(*as_type(self._fit_frames(X), X.dtype)[:3])

    def reconstruct(self, X: Any, camera: str | None = None) -> NDArray:
        """
        Return the 3D shape of each frame of a table.

        Parameters
        ----------
        X : array-like of shape (n_frames, 2 * n_points)
            A table with the points of the fitted one.
        camera : {"orthographic", "weak_perspective"} or None, default=None
            What is known of the cameras. None returns the affine shapes, in the space
            of `mean_shape_`: angles and proportions in depth are not those of the
            object. Otherwise shapes are Euclidean, up to rotation and mirror image,
            which are the same for all frames. "weak_perspective" lets each camera have
            a scale of its own, so that the sizes of the shapes mean nothing;
            "orthographic" has one scale for all, so that shapes are in the units of the
            table.

        Returns
        -------
        ndarray of shape (n_frames, n_points, 3)
            Shapes, without camera; NaN for rows of which too little is seen. Euclidean
            ones are turned to be as near as possible to the mean shape.

        Raises
        ------
        ValueError
            If `camera` is something else, or if the cameras of the fitted table see
            less than three directions of space.

        Warns
        -----
        UserWarning
            If the cameras of the fitted table turn too little to tell its metric.

        See Also
        --------
        isa_nrsfm.calibration.euclidean_frames : Rotations and scales, too.

        Notes
        -----
        The Euclidean space is that of `isa_nrsfm.calibration.deformation_metric` for
        `motion_` and `alpha_`, the cameras of the fitted table, whatever X is.
        """
        if camera is not None and camera not in CAMERA_MODELS:
            raise ValueError(
                f"camera must be None or one of {CAMERA_MODELS}; got {camera!r}"
            )
        motion, _, alpha = self.decompose(X)
        if camera is None:
            return compose(self.mean_shape_, self.basis_, alpha)
        metric = deformation_metric(self.motion_, self.alpha_)
        frames = euclidean_frames(metric, motion, alpha, self.mean_shape_, self.basis_)
        shapes = frames.shapes
        if camera == "orthographic":
            shapes = frames.scales[:, None, None] * shapes
        return shapes.astype(motion.dtype, copy=False)

    def reproject(self, X: Any) -> NDArray:
        """
        Return a table as the model sees it, missing points filled in.

        Parameters
        ----------
        X : array-like of shape (n_frames, 2 * n_points)
            A table with the points of the fitted one.

        Returns
        -------
        ndarray of shape (n_frames, 2 * n_points)
            Points of the fitted shapes in the fitted cameras. NaN for rows of which too
            little is seen.
        """
        motion, translation, alpha = self.decompose(X)
        shapes = compose(self.mean_shape_, self.basis_, alpha)
        return tracks_to_table(project(shapes, motion, translation), self.layout)

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
        Return minus the inverse SNR of points held out of the fit of their frame.

        The points are divided into five parts, always the same. Each is predicted from
        the others, frame by frame. Unlike the reprojection of the points that are
        fitted, this gets worse with too many basis shapes, and so it serves to choose
        `n_components`.

        Parameters
        ----------
        X : array-like of shape (n_frames, 2 * n_points)
            A table with the points of the fitted one.
        y : None
            Ignored.

        Returns
        -------
        float
            ``-sum ||m - mhat||^2 / sum ||m - centroid_i||^2`` over all points, frames
            scaled as in the fit; larger is better. Points whose frame the others do not
            determine are left out.
        """
        tracks, usable = self._usable(self._validated(X))
        tracks = tracks[usable]
        sizes = self._sizes_like_fit(centred_tracks(tracks)[0])
        error = held_out_error(
            self._frames, self.mean_shape_, self.basis_, tracks, sizes
        )
        return -error

    def diagnostics(self) -> Diagnostics:
        """
        Tell how far the fitted table determines the answer.

        Returns
        -------
        Diagnostics
            Named tuple of camera_singular_values, deformation_amplitude, reliability,
            effective_frames and weak_deviations.

        Raises
        ------
        ValueError
            If the model was not refined jointly: the paper's pipeline knows no noise.

        Warns
        -----
        UserWarning
            If the table does not support so many basis shapes, or hardly determines
            the part of them that cameras absorb.
        """
        check_is_fitted(self)
        if not hasattr(self, "noise_variance_"):
            raise ValueError(
                "diagnostics needs a model with refinement='joint'; "
                f"got refinement={self.refinement!r}"
            )
        return diagnose(
            self.mean_shape_.astype(np.float64),
            self.basis_.astype(np.float64),
            self.motion_ / self._frame_sizes[:, None, None],
            self.alpha_.astype(np.float64),
            self.noise_variance_ / self._unit**2,
            self.reliability_,
        )

    def __sklearn_tags__(self) -> Any:
        """Return the estimator's tags."""
        tags = super().__sklearn_tags__()
        tags.transformer_tags.preserves_dtype = ["float64", "float32"]
        tags.input_tags.allow_nan = True
        return tags

    def _strategy(self) -> Any:
        """Return the unfitted strategy, with what it leaves open filled in."""
        if self.isa is not None:
            isa = clone(self.isa)
        elif self.refinement == "joint":
            isa = PooledFastICA(n_init=START_RUNS)
        else:
            isa = PooledFastICA()
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

    def _random_state(self) -> np.random.RandomState:
        """Return the generator of the joint refinement's starts."""
        seed = check_random_state(self.random_state).randint(np.iinfo(np.int32).max)
        return np.random.RandomState(seed)

    def _keep(
        self,
        centred: NDArray,
        sizes: NDArray,
        completed: NDArray,
        result: PaperResult,
        dtype: Any,
    ) -> FrameFit:
        """Set the shapes of the paper's pipeline and return the fit of the frames."""
        paper = RigidFrames(result.mean_shape, result.basis)
        rigid = paper.fit(completed, np.ones(len(completed)))
        gauge = canonical_gauge(
            result.mean_shape, result.basis, rigid.motion, rigid.alpha
        )
        self.mean_shape_ = gauge.mean_shape.astype(dtype)
        self.basis_ = gauge.basis.astype(dtype)
        covariance = reorder_blocks(result.mode_covariance, gauge.order)
        self.mode_covariance_ = self._unit**2 * covariance
        self._converged(result.converged, result.n_iter)
        # The coefficients are those that transform gives, from the stored shapes.
        frames = RigidFrames(self.mean_shape_, self.basis_)
        self._frames: RigidFrames | PosteriorFrames = frames
        return frames.fit(centred, sizes)

    def _refine_jointly(
        self,
        unit: NDArray,
        sizes: NDArray,
        outliers: NDArray,
        W: NDArray,
        result: PaperResult,
        dtype: Any,
    ) -> FrameFit:
        """Set the shapes of the joint refinement and return the fit of the frames."""
        shapes = np.concatenate([result.mean_shape[None], result.basis])
        fitted = fit_jointly(
            unit,
            outliers,
            W,
            result.factors,
            shapes.transpose(0, 2, 1),
            loss=self.loss,
            stiffness=self.stiffness,
            random_state=self._random_state(),
            max_iter=self.max_iter,
            tol=JOINT_TOL if self.tol is None else self.tol,
        )
        frames = PosteriorFrames(
            fitted.shapes,
            fitted.noise_variance,
            spread_starts(fitted.alpha, N_STARTS),
            self.loss,
            FrameMap.identity(self.n_components),
        )
        posterior = frames.posterior(unit)
        self.reliability_ = reliabilities(posterior.alpha, posterior.covariance)
        gauge = independent_gauge(
            fitted.shapes, posterior.motion, posterior.alpha, self.independence
        )
        frames = frames._replace(gauge=gauge.frames)
        self._frames = frames
        self.mean_shape_ = gauge.mean_shape.astype(dtype)
        self.basis_ = gauge.basis.astype(dtype)
        self.noise_variance_ = self._unit**2 * fitted.noise_variance
        self.stiffness_ = fitted.stiffness
        self.objective_history_ = fitted.history
        self.gradient_norm_ = fitted.gradient_norm
        self._converged(fitted.converged, len(fitted.history) - 1)
        shown = frames.shown(posterior, sizes)
        covariance = mode_covariance(shown.motion / sizes[:, None, None], shown.alpha)
        self.mode_covariance_ = self._unit**2 * covariance
        return shown

    def _converged(self, converged: bool, n_iter: int) -> None:
        """Set the number of steps, and warn where they were too few."""
        self.n_iter_ = n_iter
        if not converged:
            warnings.warn(
                f"the refinement did not converge in max_iter={self.max_iter} steps; "
                "increase max_iter or tol",
                ConvergenceWarning,
                stacklevel=5,
            )

    def _validated(self, X: Any) -> NDArray:
        """Return a table for the fitted model as an array."""
        check_is_fitted(self)
        return validate_data(
            self,
            X,
            dtype=[np.float64, np.float32],
            ensure_all_finite="allow-nan",
            reset=False,
        )

    def _sizes(self, centred: NDArray) -> NDArray:
        """Return what frames are divided by before they are compared."""
        if self.loss == "linear":
            return weighting_sizes(centred, self.scale_frames)
        sizes = robust_sizes(centred)
        return (
            sizes
            if self.scale_frames
            else np.full_like(sizes, np.sqrt(np.mean(sizes**2)))
        )

    def _usable(self, X: NDArray) -> tuple[NDArray, NDArray]:
        """Return the tracks of a valid table, and which of its frames are usable."""
        names = getattr(self, "feature_names_in_", None)
        tracks = clean_tracks(table_to_tracks(X, self.layout), self.layout, names)
        return tracks, usable_frames(tracks)

    def _sizes_like_fit(self, centred: NDArray) -> NDArray:
        """Return the sizes of frames, or the one size of the fit for all."""
        if self.scale_frames and len(centred):
            return self._sizes(centred)
        return np.full(len(centred), self._unit)

    def _fit_frames(self, X: NDArray) -> FrameFit:
        """Return the fit of the frames of a valid table."""
        tracks, usable = self._usable(X)
        frames = FrameFit.unknown(len(tracks), self.n_components)
        if usable.any():
            centred, translation = centred_tracks(tracks[usable])
            fit = self._frames.fit(centred, self._sizes_like_fit(centred))
            fit = fit._replace(translation=fit.translation + translation)
            for whole, part in zip(frames, fit, strict=True):
                whole[usable] = part
        return frames

    def _inverse_snr(self, tracks: NDArray, sizes: NDArray, frames: FrameFit) -> float:
        """Return the inverse SNR of fitted frames, weighted as in the fit."""
        shapes = compose(self.mean_shape_, self.basis_, frames.alpha)
        model = project(shapes, frames.motion, frames.translation)
        centred, _ = centred_tracks(tracks)
        scale = sizes[:, None, None]
        noise = np.nansum(((tracks - model) / scale) ** 2)
        return float(noise / np.nansum((centred / scale) ** 2))


def as_type(frames: FrameFit, dtype: Any) -> FrameFit:
    """Return a fit in the type of the table."""
    return FrameFit(*(part.astype(dtype, copy=False) for part in frames))


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
