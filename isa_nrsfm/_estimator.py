"""AffineNRSfM: the scikit-learn transformer on top of the stages."""

import copy
import os
from functools import partial
from numbers import Integral, Real
from typing import TYPE_CHECKING, Any, ClassVar, Self

import numpy as np
from numpy.typing import NDArray
from sklearn.base import BaseEstimator
from sklearn.exceptions import ConvergenceWarning
from sklearn.utils import check_array, check_scalar
from sklearn.utils.validation import check_is_fitted, validate_data

from isa_nrsfm import (
    _fitted_model as fitted_model,
    _parameters as choices,
    _tables as tables,
)
from isa_nrsfm._compat import scikit_learn
from isa_nrsfm._compat.caller import warn_caller
from isa_nrsfm._compat.scikit_learn import FitProgress, HasMethods, Interval, StrOptions
from isa_nrsfm._compat.stored_arrays import Keep, kept_arrays
from isa_nrsfm._fit import STEPWISE, Images, fit_images, stages_of
from isa_nrsfm._frames import camera_models
from isa_nrsfm._frames.models import Decomposition, FrameModel, leading
from isa_nrsfm._joint.settings import JOINT_TOL, LIMITS, PAPER_TOL, FitSettings, Limits
from isa_nrsfm._prepare import scaling
from isa_nrsfm._prepare.coordinates import warn_of_rows
from isa_nrsfm.analysis._advice import warn_after_fit
from isa_nrsfm.analysis._diagnostics import DiagnosedMixin, Diagnostics, diagnose
from isa_nrsfm.analysis._frame_columns import group_numbers
from isa_nrsfm.analysis._smoothing import SmoothedCoefficients, smooth
from isa_nrsfm.calibration import deformation_metric
from isa_nrsfm.isa._strategies import ready_strategy

_NEEDS_CALIBRATED = (
    "needs a model with calibrated cameras; got camera='affine'. Fit with "
    "camera='weak_perspective' or camera='orthographic'"
)
# What has other names in scikit-learn's decompositions.
_OTHER_NAMES = {
    "components_": "has the name basis_: basis shapes (n_components, n_points, 3)",
    "explained_variance_ratio_": "has the name energy_share_: shares of the deformation"
    " in the images",
    "mean_": "has the name mean_shape_: the mean shape (n_points, 3)",
}


@scikit_learn.with_numpy_defaults
class AffineNRSfM(scikit_learn.CallbackSupportMixin, DiagnosedMixin, BaseEstimator):
    """
    Affine non-rigid structure from motion by independent subspace analysis.

    Factorises a table of 2D landmarks, with one row per frame. The result is a mean 3D
    shape, basis shapes, and a camera and coefficients for each frame. The coefficients
    do not depend on the viewpoint if the points are fixed on the surface. No
    calibration, training data or order of the frames is needed. Row i, reshaped to
    (n_points, 2), is modelled as::

        (mean_shape_ + tensordot(alpha_[i], basis_, 1)) @ motion_[i].T + translation_[i]

    and with calibrated cameras by further directions that are not reported.

    Parameters
    ----------
    n_components : int or "auto", default=3
        K, the number of coefficients that are reported. With affine cameras the fit has
        K basis shapes, which needs at least 3K + 4 points and ``ceil(8 (K + 2) / 5)``
        frames. With calibrated cameras and the joint refinement the fit has all
        directions of deformation that the table supports, and K does not change
        cameras, depths, `reconstruct`, `reproject` and `score`; K is at most 2J - 7 for
        J points. "auto" reports the directions that the table determines, at most
        twelve (joint refinement and consensus only).
    isa : object, default=None
        Strategy of independent subspace analysis, such as `FastISA` or `PooledFastICA`,
        with subspaces of size three. None is ``PooledFastICA()``, with two runs if its
        result is only the start of the joint refinement. A clone is fitted. Its
        `random_state`, `n_jobs` and `verbose` are those of this estimator unless set.
    block_recovery : {"generalized_eigen", "irls"}, default="generalized_eigen"
        Method for the 3x3 matrix of each subspace that brings its motion to the rigid
        motion. "generalized_eigen" maximises the explained share of the motion. "irls"
        is the published iteration for the least squared difference; it depends on the
        first frame and explains less. With a refinement both lead to nearly the same
        result.
    refinement : {"joint", "consensus", "alternating", None}, default="joint"
        "joint" finds the cameras, shapes and noise variance of greatest marginal
        likelihood, with normally distributed coefficients. It starts from the paper's
        result and recovers the true shapes as far as the images determine them.
        "consensus" continues from there, with calibrated cameras: it fits overlapping
        groups of neighbouring points, with rotations of their own, and finds the
        depths that they have in common. Bodies and hands become more accurate, and a
        fit takes 2 to 7 times as long.
        "alternating" is the paper's alternating least squares for basis shapes and
        coefficients, with fixed rigid cameras.
    camera : {"affine", "weak_perspective", "orthographic", "perspective"}, \
default="affine"
        Camera model. "affine" assumes nothing: shapes are known up to an affinity of
        space, and cameras absorb part of large deformations, such as those of bodies.
        "weak_perspective" cameras are rotations with a scale for each frame, a good
        model of photos of objects that are far away for their size. "orthographic" ones
        have the same scale in all frames. With these two, shapes, lengths and angles
        are true, up to one mirror image (`mirrored`). "perspective" cameras are pinhole
        cameras, for objects nearer than ten times their size or at the side of images.
    focal_length : float, array-like of shape (n_frames,) or None, default=None
        Focal length of the camera, in units of the table, or one a row. None estimates
        one of perspective cameras. That of others only turns axes (`rotations_`).
    principal_point : tuple of float (x, y), default=None
        Point of the image on the axis of the camera, which perspective cameras and
        `focal_length` need. It is half of the image's size, if nothing else is known.
    prior : AffineNRSfM, default=None
        A fitted model of the same points, with calibrated cameras, for frontal photos
        and few frames, which alone do not determine depths. The fit has its basis
        shapes, and the mean shape of the table, in the pose and size of the model's.
        `isa_nrsfm.datasets.load_face_prior` is one of faces. `n_components` is its K,
        or "auto". `isa` and `independence` have no effect.
    independence : {"shapes", "coefficients", None}, default="shapes"
        Criterion for the basis of the joint refinement. The likelihood does not depend
        on the mixing of the basis shapes. "shapes" makes them independent of each other
        over the points, as the paper assumes. "coefficients" makes their coefficients
        independent over the frames; it needs the joint refinement. None takes the
        principal axes of the deformation. Shapes of frames, reprojection and score do
        not depend on this parameter.
    loss : {"linear", "huber", "cauchy"}, default="linear"
        Loss of points far from the model. "huber" reduces the weight of points beyond
        1.5 standard deviations of the noise. "cauchy" reduces it gradually, to one half
        at 2.5 standard deviations. With both, points beyond six sizes of their frame
        have weight zero, and both need the joint refinement.
    remove_pose : bool, default=False
        Whether `alpha_`, `transform` and `smooth` return the directions of what s and
        s^2 do not predict, with s the sine of the yaw of calibrated cameras. It removes
        what points that slide over the surface add in turned views, if objects move
        alike in all views. Coefficients of `decompose` are still those of the shapes.
    layout : {"interleaved", "planar"}, default="interleaved"
        Whether the columns are x0, y0, x1, y1, ... or x0, x1, ..., y0, y1, ...
    scale_frames : bool, default=True
        Whether each centred frame is divided by the RMS of its coordinates before the
        fit, so that photos of any resolution have the same weight. `motion_` is in the
        units of the table in any case. If False, frames are weighted by their size.
        With orthographic cameras, which have one scale, frames are not scaled.
    hidden_points : bool, default=True
        Whether points may be missing because the object hides them, which decides
        between the two mirror images in depth (`mirror_certainty_`). Set False if
        points are missing for other reasons that depend on the view.
    max_iter : int, default=1000
        Largest number of steps of the refinement.
    tol : float or None, default=None
        Convergence tolerance. The joint refinement has converged when two successive
        steps each decrease minus twice the log likelihood by less than tol per frame
        (default 0.025; its first steps, on a sample of a large table, end earlier). The
        alternating refinement has converged when a step gains less than this share of
        the explained energy (default 1e-10).
    random_state : int, RandomState instance or None, default=None
        Seeds the strategy; an int makes the result reproducible.
    keep_frames : bool, str or path-like, default=True
        Whether `alpha_`, `alpha_std_`, `motion_` and `translation_` are kept: True
        keeps them in memory, False not at all. A path is that of a folder for them.
        Each fit makes a new folder within it, with files ``alpha.npy`` and so on, and
        never removes others. The attributes are memory maps of these files;
        ``alpha_.filename`` is the path.
    n_jobs : int or None, default=None
        Number of threads for the frames, in `fit` and in the methods for tables, and of
        joblib workers for strategies that use them and for the groups of the consensus.
        The result does not depend on it.
    verbose : int, default=0
        Above zero, print a line for each stage, above one also the current step. With
        scikit-learn 1.9 and later the stages and steps are reported to the callbacks of
        ``set_callbacks(ProgressBar())``.

    Attributes
    ----------
    n_components_ : int
        K, the number of coefficients.
    mean_shape_ : ndarray of shape (n_points, 3)
        Mean shape B_0, centred and white: the mean of ``b b^T`` over the points is the
        identity (of rank two for flat objects). With weak-perspective cameras only the
        mean square of its coordinates is one. With orthographic ones it is in the units
        of the table. x and y are the axes of the mean camera (so y points down for
        image coordinates), z is depth, away from the viewer if `mirror_certainty_` is
        known.
    basis_ : ndarray of shape (n_components, n_points, 3)
        Basis shapes B_k, centred, sorted by decreasing energy in the images, each for
        one standard deviation of `alpha_`; zero without motion in the table.
    alpha_ : ndarray of shape (n_frames, n_components)
        Coefficients of the frames, scaled to unit variance; signs chosen so that the
        skewness is non-negative. Their mean is zero after the joint refinement. Their
        rows are no points of a space with distances, as columns depend on each other.
        With ``independence=None`` they are: all directions have the prior N(0, I).
    pose_effect_ : ndarray of shape (3, n_components)
        With `remove_pose`: factors of 1, s and s^2 in what is subtracted, of mean zero.
    alpha_std_ : ndarray of shape (n_frames, n_components)
        Posterior standard deviations of `alpha_`, with the errors of the shapes (joint
        refinement only). They assume independent noise: they are too small where basis
        shapes do not model the deformation, and for coefficients without
        `reliability_`.
    motion_ : ndarray of shape (n_frames, 2, 3)
        Affine cameras, in the units of the table. With perspective, those of
        weak-perspective cameras with the same rotations and positions.
    translation_ : ndarray of shape (n_frames, 2)
        Images of the shapes' origin in the table: the centroids of complete frames.
    depth_uncertainty_ : float
        Expected RMS error of the depths of the frames, relative to their RMS
        (calibrated cameras with the joint refinement only). Above 0.4 they are
        doubtful without a prior, above 0.6 depths and angles are withheld. It contains
        what deformation explains as well as turning.
    mirror_certainty_ : float
        Probability that the depth has the right sign, if perspective, the prior or
        missing points decide it: a test of whether these are farther away is
        significant at 1 %. Otherwise NaN, and the sign is a convention; see `mirrored`.
    rotations_ : ndarray of shape (n_frames, 3, 3)
        Rotations of calibrated cameras, with determinant one, from the shapes to the
        axes x, y and z of the camera, if its focal length is known. Otherwise z is the
        line of sight to the object. Like `scales_`, only with such cameras.
    scales_ : ndarray of shape (n_frames,)
        Scales of calibrated cameras, in units of the table per unit of the shapes; one
        for orthographic cameras. Without `focal_length` the image of ``S_i =
        reconstruct(X)[i]`` is ``scales_[i] * S_i @ rotations_[i, :2].T +
        translation_[i]``.
    positions_ : ndarray of shape (n_frames, 3)
        Origins of the shapes in the axes of a camera of known focal length, in units of
        the shapes. NaN if the table shows no perspective.
    focal_length_ : float or ndarray of shape (n_frames,)
        Focal length of the camera. Infinite if the table shows no perspective.
    focal_length_std_ : float
        Its standard deviation, from a jackknife over groups of points, and with a prior
        from the error of the depths; zero if it was given, infinite if the depth is not
        determined.
    prior_std_ : ndarray of shape (2,)
        Standard deviations of mean shape and basis shapes from those of the prior, in
        sizes of frames. The basis is stretched at most in depth: the second is zero.
    inverse_snr_ : float
        ``||W - What||_F^2 / ||W||_F^2``, a fraction, with W the centred tracks of the
        visible points, scaled as in the fit.
    rank_floor_ : float
        Lowest inverse SNR of any model of rank 3K + 3, with missing points filled in;
        zero where K exceeds the bound of affine cameras.
    noise_variance_ : float
        Noise variance of a coordinate. If frames are scaled, it is that of frames of
        size one (joint refinement only, as are the next four).
    camera_noise_ratio_ : float
        Noise variance of the fit with calibrated cameras, divided by that of the fit
        with affine ones, from the frames of the first steps; see `diagnostics`.
    reliability_ : ndarray of shape (n_components,)
        Shares of the variance of the coefficients that are signal, not uncertainty of
        coefficients or shapes, along uncorrelated directions, decreasing.
    stability_ : ndarray of shape (n_components,)
        Expected correlation of each coefficient with that of a fit of as many other
        people (`groups`), otherwise rows; NaN with fewer than four. Not with a prior.
    stable_sets_ : ndarray of bool, shape (n_components, n_components)
        Row k: k and up to two other coefficients of such a fit that together have a
        multiple correlation of .85 with it; none if none have.
    objective_history_ : ndarray of shape (`n_iter_` + 1,)
        Minus twice the log posterior, up to a constant, before the last refinement and
        after each of its steps; it never rises.
    gradient_norm_ : float
        Norm of the gradient of this objective at the end, in the metric of its
        curvature, divided by the root of the number of coordinates.
    energy_share_ : ndarray of shape (n_components,)
        Share of each basis shape in the energy of all deformations in the images,
        ``sum_i ||alpha_ik M_i B_k||_F^2``, frames scaled as in the fit. Directions that
        are not reported have the rest.
    mode_covariance_ : ndarray of shape (3 * n_components, 3 * n_components)
        Covariance over the images of the 3K independent directions, 3x3 blocks in
        the order of `basis_`; after the joint refinement ``(1 / 2I) sum_i (alpha_i
        alpha_i^T) (x) (M_i^T M_i)``. Of frames of size one where frames are scaled.
    singular_values_ : ndarray of shape (min(3 * n_components + 3, n_points - 1),)
        Largest singular values of W, decreasing.
    reference_motion_ : ndarray of shape (2, 3)
        Default camera of `inverse_transform`: the mean view of the table.
    reference_translation_ : ndarray of shape (2,)
        Default translation of `inverse_transform`: the mean centroid.
    isa_ : object
        The fitted strategy, of the paper's pipeline. None with a prior.
    camera_ : str
        The camera model of the fit.
    frames_scaled_ : bool
        Whether each frame was divided by its own size.
    n_iter_ : int
        Number of steps of the refinement; for a large table, of those with all frames.
    n_features_in_ : int
        Number of columns.
    feature_names_in_ : ndarray of shape (`n_features_in_`,)
        Names of the columns, where the table is a dataframe with string names.

    See Also
    --------
    isa_nrsfm.isa.FastISA : Strategy with subspaces of its own (ISA1).
    isa_nrsfm.isa.PooledFastICA : FastICA with pooled components (ISA2).

    Notes
    -----
    `fit` and the methods for new tables accept tables that are not in memory: memory
    maps and tables of `isa_nrsfm.io.open_table`. They are read in blocks, whose largest
    memory is scikit-learn's setting ``sklearn.set_config(working_memory=...)``, in
    MiB. Each thread has a block of a memory map, of at most 128 MiB. The result does
    not depend on it. In addition, about 1 kB per frame is always in memory. For a dask
    array, `alpha_`, `alpha_std_`, `motion_` and `translation_` are dask arrays,
    like the results of `transform`, `decompose`, `reconstruct` and `reproject`.

    Missing points are NaN, in `fit` and everywhere else. A point with one missing
    coordinate counts as missing, with a warning. Rows without any point are left out of
    the fit, with a warning. They have NaN in `alpha_` and the other attributes of
    frames. If a row has too few points to determine a camera, `fit` raises an error and
    the other methods return NaN.

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
    >>> faces = make_face_tracks(n_frames=100, n_components=2, random_state=0)
    >>> model = AffineNRSfM(n_components=2, random_state=0).fit(faces.data)
    >>> model.mean_shape_.shape, model.basis_.shape, model.alpha_.shape
    ((68, 3), (2, 68, 3), (100, 2))
    >>> model.transform(faces.data[:5]).shape
    (5, 2)
    """

    n_components_: int
    mean_shape_: NDArray
    basis_: NDArray
    alpha_: NDArray
    pose_effect_: NDArray
    alpha_std_: NDArray
    prior_std_: NDArray
    motion_: NDArray
    translation_: NDArray
    rotations_: NDArray
    scales_: NDArray
    inverse_snr_: float
    rank_floor_: float
    noise_variance_: float
    camera_noise_ratio_: float
    depth_uncertainty_: float
    positions_: NDArray
    focal_length_: float | NDArray
    focal_length_std_: float
    mirror_certainty_: float
    reliability_: NDArray
    objective_history_: NDArray
    gradient_norm_: float
    energy_share_: NDArray
    mode_covariance_: NDArray
    singular_values_: NDArray
    reference_motion_: NDArray
    reference_translation_: NDArray
    isa_: Any
    n_iter_: int
    camera_: str
    frames_scaled_: bool
    n_features_in_: int
    feature_names_in_: NDArray

    _model: fitted_model.TableModel
    _frame_sizes: NDArray
    _limits: ClassVar[Limits] = LIMITS  # others: `limited`
    # Settings of a fit that continues another one: whole, errors, start, known
    _continued: dict[str, Any] | None = None
    _held: tuple[Any, Any, Any] | None = None  # a fitted table, weights, both opened
    _parameter_constraints: ClassVar[dict[str, list[Any]]] = {
        "n_components": [scikit_learn.AT_LEAST_ONE, StrOptions({"auto"})],
        "isa": [None, HasMethods(["fit", "get_params", "set_params"])],
        "block_recovery": [StrOptions(set(choices.BLOCK_RECOVERIES))],
        "refinement": [StrOptions(set(choices.REFINEMENTS)), None],
        "camera": [StrOptions(set(choices.CAMERA_NAMES))],
        "focal_length": [None, Interval(Real, 0, None, closed="neither"), "array-like"],
        "principal_point": [None, "array-like"],
        "prior": [None, HasMethods(["fit", "get_params"])],
        "independence": [StrOptions(set(choices.INDEPENDENCE)), None],
        "loss": [StrOptions(set(choices.LOSSES))],
        "remove_pose": ["boolean"],
        "layout": [StrOptions(set(tables.LAYOUTS))],
        "scale_frames": ["boolean"],
        "hidden_points": ["boolean"],
        "max_iter": [scikit_learn.AT_LEAST_ONE],
        "tol": [None, Interval(Real, 0, None, closed="left")],
        "random_state": ["random_state"],
        "keep_frames": ["boolean", str, HasMethods("__fspath__")],
        "n_jobs": scikit_learn.N_JOBS,
        "verbose": ["verbose"],
    }

    def __init__(
        self,
        n_components: Any = 3,
        *,
        isa: Any = None,
        block_recovery: choices.BlockRecovery = "generalized_eigen",
        refinement: choices.Refinement | None = "joint",
        camera: choices.Camera = "affine",
        focal_length: Any = None,
        principal_point: Any = None,
        prior: Any = None,
        independence: choices.Independence | None = "shapes",
        loss: choices.Loss = "linear",
        remove_pose: bool = False,
        layout: tables.Layout = "interleaved",
        scale_frames: bool = True,
        hidden_points: bool = True,
        max_iter: int = 1000,
        tol: float | None = None,
        random_state: Any = None,
        keep_frames: bool | str | os.PathLike[str] = True,
        n_jobs: int | None = None,
        verbose: int = 0,
    ):
        self.n_components = n_components
        self.isa = isa
        self.block_recovery = block_recovery
        self.refinement = refinement
        self.camera = camera
        self.focal_length = focal_length
        self.principal_point = principal_point
        self.prior = prior
        self.independence = independence
        self.loss = loss
        self.remove_pose = remove_pose
        self.layout = layout
        self.scale_frames = scale_frames
        self.hidden_points = hidden_points
        self.max_iter = max_iter
        self.tol = tol
        self.random_state = random_state
        self.keep_frames = keep_frames
        self.n_jobs = n_jobs
        self.verbose = verbose

    @scikit_learn.fit_context(nested=True)
    def fit(
        self, X: Any, y: Any = None, *, point_weight: Any = None, groups: Any = None
    ) -> Self:
        """
        Factorise a table.

        Parameters
        ----------
        X : array-like of shape (n_frames, 2 * n_points)
            The table, one frame a row, in the order of `layout`. A memory map or a
            `StoredTable` of `isa_nrsfm.io.open_table` is read block by block, a dask
            array stays where it is.
        y : None
            Ignored.
        point_weight : array-like of shape (n_frames, n_points), default=None
            Weights of the points, such as the confidences of a tracker, for the joint
            refinement with ``loss="linear"`` and tables in memory. A point of weight w
            counts as w observations. A point of weight zero is missing; weights of
            missing points have no effect. None for weights of one.
        groups : array-like of shape (n_frames,), default=None
            People or videos of the rows, for `stability_` only.

        Returns
        -------
        AffineNRSfM
            The fitted estimator.

        Raises
        ------
        ValueError
            If X has an odd number of columns, infinite values, too few points or frames
            for `n_components`, or column names that contradict `layout`; if a frame
            shows one to three points, or points on one line only; if a point is visible
            in too few frames; if parameters or tables need the joint refinement; if
            `keep_frames` is an empty text; or if weights are negative, not finite, of
            another shape, or not supported by parameters or table.
        OSError
            If the folder `keep_frames` cannot be made or written to, before the fit; if
            the disk is full, after it.

        Warns
        -----
        UserWarning
            If calibrated cameras do not determine the depth, points are at codes of
            missing ones, in shares of an image's size, of the other layout or lack a
            coordinate, rows are left out or mirror images, outliers bend the shapes, a
            prior does not suit, or a fit has not converged.
        """
        self._forget()
        with kept_arrays(self.keep_frames) as keep, scaling.undetermined(self.camera):
            progress = FitProgress(self, stages_of(self), stepwise=STEPWISE, X=X, y=y)
            self._fit(X, point_weight, progress, keep=keep, groups=groups)
        progress.end()
        return self

    def fit_transform(
        self, X: Any, y: Any = None, *, point_weight: Any = None, groups: Any = None
    ) -> NDArray:
        """
        Factorise a table and return the coefficients of its frames.

        Parameters
        ----------
        X : array-like of shape (n_frames, 2 * n_points)
            The table, one frame a row, in the order of `layout`.
        y : None
            Ignored.
        point_weight, groups : array-like, default=None
            As in `fit`.

        Returns
        -------
        ndarray of shape (n_frames, n_components)
            `alpha_`.
        """
        self.fit(X, point_weight=point_weight, groups=groups)
        if self.keep_frames:
            return self.alpha_.copy()
        return self.transform(X, point_weight=point_weight)

    def _fit(
        self,
        X: Any,
        point_weight: Any,
        progress: scikit_learn.Progress,
        *,
        keep: Keep = dict,
        groups: Any = None,
    ) -> None:
        """Fit a table."""
        source, weights, settings = self._ready(X, point_weight)
        if groups is not None:
            settings = settings._replace(groups=group_numbers(groups, source.n_frames))
        warn_of_rows(source, self, getattr(X, "attrs", {}))
        isa = ready_strategy(
            self.isa, settings.joint, self.random_state, self.n_jobs, self.verbose
        )
        prior, n_components = settings.prior, self.n_components
        n_components = n_components if prior is None else prior.n_components
        images = Images(source, weights, isa, settings, self.principal_point, progress)
        model, frames, converged, fitted, *_ = fit_images(
            images, n_components, self.focal_length, self.camera == "perspective"
        )
        if not converged:
            warn_caller(
                f"the refinement did not converge in max_iter={self.max_iter} steps; "
                "increase max_iter or tol",
                ConvergenceWarning,
            )
        left_out = fitted.pop("_left_out", None)
        number = int(model.n_components)  # that of users may be one of numpy
        attributes: dict[str, Any] = fitted | {
            "_model": model,
            "_n_features_out": number,
            "n_components_": number,
            "camera_": self.camera if model.pinhole is not None else settings.camera,
            "frames_scaled_": bool(settings.scale_frames),
        }
        reported = leading(frames, model.n_components)
        if self.remove_pose:
            self.pose_effect_ = camera_models.pose_effect(frames.motion, reported.alpha)
            left = reported.alpha - fitted_model.removed_part(self, frames.motion)
            reported = reported._replace(alpha=left)
        if self.keep_frames:
            kept = {f"{name}_": part for name, part in keep(reported._asdict()).items()}
            if not settings.joint:
                del kept["alpha_std_"]
            if self.camera != "affine":
                kept |= model.cameras(frames)
            attributes |= {name: source.as_collected(kept[name]) for name in kept}
        else:
            del attributes["_frame_sizes"]
        self.__dict__.update(attributes)
        if settings.errors and settings.joint:
            of_prior = fitted_model.fitted_prior(self.prior)
            warn_after_fit(self, of_prior, frames.motion, left_out)

    def _ready(
        self, X: Any, point_weight: Any = None
    ) -> tuple[tables.FrameBlocks, NDArray | None, FitSettings]:
        """Return the checked table of a fit, its weights and settings; set names."""
        joint = self.refinement in choices.JOINT_REFINEMENTS
        params = self.get_params(deep=False)
        choices.check_requirements(params | {"point_weight": point_weight})
        if not joint:
            what = f"refinement={self.refinement!r}, unlike refinement='joint',"
            tables.refuse_stored(X, what)
            if isinstance(X, np.memmap):
                X = np.asarray(X)
        scaling.check_camera(self)
        source, weights = self._opened(X, point_weight, reset=True)
        params |= fitted_model.checked_prior(self, source.empty.shape[2])
        if self.tol is None:
            params["tol"] = JOINT_TOL if joint else PAPER_TOL
        if self.camera == "orthographic":  # one scale
            params["scale_frames"] = False
        elif self.camera == "perspective":  # fits of images without perspective
            params["camera"] = "weak_perspective"
        settings = FitSettings(
            **{name: params[name] for name in FitSettings._fields if name in params},
            names=getattr(self, "feature_names_in_", None),
            silent_isa=joint and self.isa is None,
            free=self.n_components == "auto" and self.prior is None,
            limits=self._limits,
            **(self._continued or {}),
        )
        return source, weights[0] if weights else None, settings

    def _focal_shares(self, table: tables.FrameBlocks) -> tuple[NDArray, ...]:
        """Return the mean focal length over those of frames (n, 1), if they differ."""
        focal_lengths = getattr(self, "focal_length_", self.focal_length)
        return camera_models.focal_shares(focal_lengths, table.n_frames)

    def _forget(self) -> None:
        """Remove all results of an earlier fit at once."""
        prefix = "_model", "_frame_s", "_halves", "_stability", "_trials", "_n_feature"
        names = [n for n in vars(self) if not (n.startswith(prefix) or n.endswith("_"))]
        self.__dict__ = {name: vars(self)[name] for name in names}

    def __sklearn_clone__(self) -> Any:
        """Return an unfitted copy, whose prior is still fitted."""
        plain = copy.copy(self)
        plain.prior = None
        plain = super(AffineNRSfM, plain).__sklearn_clone__()
        plain.prior = copy.copy(self.prior)  # for `set_params`
        return plain

    if not TYPE_CHECKING:  # mypy would accept any name

        def __getattr__(self, name: str) -> Any:
            """Raise an error; it states why an attribute is lacking, or its name."""
            reason = _OTHER_NAMES.get(name)
            affine = vars(self).get("camera_") == "affine"
            if affine and name in ("rotations_", "scales_", "depth_uncertainty_"):
                reason = _NEEDS_CALIBRATED
            if reason is not None:
                raise AttributeError(f"{name} {reason}", name=name, obj=self)
            return super().__getattribute__(name)

    def transform(self, X: Any, *, point_weight: Any = None) -> NDArray:
        """
        Return the coefficients of the frames of a table.

        Each frame is fitted by itself: its result does not depend on the others.

        Parameters
        ----------
        X : array-like of shape (n_frames, 2 * n_points)
            A table with the points of the fitted one.
        point_weight : array-like of shape (n_frames, n_points), default=None
            Weights of the points, as in `fit`.

        Returns
        -------
        ndarray of shape (n_frames, n_components)
            Coefficients; `alpha_` for the fitted table. NaN for rows of too few points.
        """

        def coefficients(fit: Decomposition, *_: NDArray) -> NDArray:
            alpha = leading(fit, self._model.n_components).alpha
            return alpha - fitted_model.removed_part(self, fit.motion)

        return fitted_model.of_fits(self, coefficients, X, point_weight)

    def decompose(self, X: Any, *, point_weight: Any = None) -> Decomposition:
        """
        Return camera and coefficients of each frame of a table.

        Parameters
        ----------
        X : array-like of shape (n_frames, 2 * n_points)
            A table with the points of the fitted one.
        point_weight : array-like of shape (n_frames, n_points), default=None
            Weights of the points, as in `fit`.

        Returns
        -------
        Decomposition
            Named tuple of motion (n_frames, 2, 3), translation (n_frames, 2), alpha and
            alpha_std (n_frames, n_components), also with `remove_pose` of the shapes.
        """

        def reported(fit: Decomposition, *_: NDArray) -> Decomposition:
            return leading(fit, self._model.n_components)

        return fitted_model.of_fits(self, reported, X, point_weight, deviations=True)

    def smooth(
        self,
        X: Any,
        *,
        point_weight: Any = None,
        time: Any = None,
        groups: Any = None,
        max_gap: int = 30,
        max_iter: int = 100,
        tol: float = 1.0,
    ) -> SmoothedCoefficients:
        """
        Return coefficients and cameras of the frames of a video, smoothed in time.

        Coefficients are Gaussian processes in time, cameras are integrated random
        walks, both estimated from the table. Each frame has the weight of its
        likelihood: frames with few visible points have little weight, with less than
        six none. The shapes are those of `fit`.

        Parameters
        ----------
        X : array-like of shape (n_frames, 2 * n_points)
            A table with the points of the fitted one, each group in temporal order.
        point_weight : array-like of shape (n_frames, n_points), default=None
            Weights of the points, as in `fit`.
        time : array-like of shape (n_frames,), default=None
            Times of the frames, numbers or dates (in seconds from the first). Their
            median difference is one step. Other differences are rounded to whole steps.
            If None, consecutive frames are one step apart.
        groups : array-like of shape (n_frames,), default=None
            Person, video or scene of each frame. Smoothing does not cross groups, which
            have intercepts of their own. None for one group.
        max_gap : int, default=30
            Largest gap, in steps, across which coefficients are smoothed.
        max_iter : int, default=100
            Largest number of iterations of the search for time scales.
        tol : float, default=1.0
            The search ends when no derivative of the log-likelihood, by the logarithm
            of a time scale or variance, is larger.

        Returns
        -------
        SmoothedCoefficients
            Named tuple of alpha, alpha_std, time_scales and decomposition.

        Raises
        ------
        ValueError
            If times are missing or do not rise within a group, if no group has two
            rows, or if the model was not refined jointly.

        Notes
        -----
        The processes have the Matern covariance of order 3/2 (Hartikainen, Sarkka,
        2010). Coefficients and camera of a frame are observed through its likelihood,
        linearised at the fit of `transform` (Rauch, Tung, Striebel, 1965). Time scales
        and variances maximise the likelihood. If it is hardly larger than that of
        intercepts alone, as for photos in any order, the result is that of `decompose`.
        """
        check_scalar(max_gap, "max_gap", Integral, min_val=1)
        check_scalar(max_iter, "max_iter", Integral, min_val=1)
        check_scalar(tol, "tol", Real, min_val=0.0)
        table, weights = self._opened(X, point_weight)
        frames = self._jointly_fitted("smooth")
        alone = table.joined(self._model.linearised, *weights)
        camera, dtype = camera_models.CAMERAS[frames.camera], table.empty.dtype
        search = time, groups, max_gap, max_iter, tol
        result = smooth(alone, frames.gauge, camera, *search, dtype)
        fit = result.decomposition
        if self._model.pinhole is not None:
            fit = table.joined(self._model.in_table_cameras, *fit)
        fit = leading(fit, self._model.n_components)
        left = fit.alpha - fitted_model.removed_part(self, fit.motion)
        return result._replace(alpha=left, alpha_std=fit.alpha_std, decomposition=fit)

    def rotation_covariance(self, X: Any, *, point_weight: Any = None) -> NDArray:
        """
        Return the posterior covariances of the rotations of calibrated cameras.

        Parameters
        ----------
        X : array-like of shape (n_frames, 2 * n_points)
            A table with the points of the fitted one.
        point_weight : array-like of shape (n_frames, n_points), default=None
            Weights of the points, as in `fit`.

        Returns
        -------
        ndarray of shape (n_frames, 3, 3)
            Posterior covariances, in radians squared, of the errors w of the rotations,
            as rotation vectors: ``R exp(hat(w))``, with w in the axes of the shapes,
            and with errors of the shapes. NaN for rows with too few visible points.

        Raises
        ------
        ValueError
            If the model has affine cameras, or was not refined jointly.
        """
        table, weights = self._opened(X, point_weight)
        frames = self._jointly_fitted("rotation_covariance", calibrated=True)
        space, certainty = frames.gauge.rotation, frames.certainty
        posterior = table.joined(self._model.posterior, *weights)
        covariance = space @ posterior.turn_covariance @ space.T
        if certainty.turns is not None:
            R, _ = camera_models.full_rotations(posterior.motion @ space.T)
            covariance = covariance + R.mT @ certainty.turns @ R
        return np.asarray(covariance).astype(table.empty.dtype, copy=False)

    def reconstruct(
        self,
        X: Any,
        camera: choices.CalibratedCamera | None = None,
        *,
        axes: choices.Axes = "object",
        return_std: bool = False,
        point_weight: Any = None,
    ) -> Any:
        """
        Return the 3D shape of each frame of a table.

        Parameters
        ----------
        X : array-like of shape (n_frames, 2 * n_points), or Decomposition
            A table with the points of the fitted one: with calibrated cameras, shapes
            have all directions of deformation that the fit has. Or the result of
            `decompose`, whose frames are not fitted again: its shapes have the K
            directions of `basis_`.
        camera : {"orthographic", "weak_perspective"} or None, default=None
            Calibrated camera model of the images, for a model that was fitted with
            affine cameras. None returns shapes in the space of `mean_shape_`. Otherwise
            they are Euclidean, up to one rotation and one mirror image for all frames.
            With "weak_perspective" each camera has its own scale, and the sizes of the
            shapes have no meaning. With "orthographic" all cameras have one scale, and
            shapes are in the units of the table.
        axes : {"object", "camera"}, default="object"
            Axes of the shapes, for a model with calibrated cameras: those of
            `mean_shape_`, or of the camera of each frame, by `rotations_`.
        return_std : bool, default=False
            Whether to return the standard deviations of the depths, for a model with
            calibrated cameras.
        point_weight : array-like of shape (n_frames, n_points), default=None
            Weights of the points of a table, as in `fit`.

        Returns
        -------
        shapes : ndarray of shape (n_frames, n_points, 3)
            In the units of `mean_shape_`; NaN for rows with too few visible points. If
            `camera` is given for an affine model, each is turned to the mean shape.
        depth_std : ndarray of shape (n_frames, n_points)
            Only with `return_std`. Standard deviations of the points, in these units,
            along the third of `rotations_`, from camera, coefficients and shapes.

        Raises
        ------
        ValueError
            If the cameras of the fitted table see fewer than three directions of
            space, if the model was fitted with calibrated cameras other than `camera`,
            or if the decomposition, `axes` or `return_std` do not fit the model.

        Warns
        -----
        UserWarning
            If the cameras of the fitted table rotate too little to determine the metric
            of space.

        See Also
        --------
        isa_nrsfm.calibration.euclidean_frames : Shapes, rotations and scales.

        Notes
        -----
        The Euclidean space is that of `isa_nrsfm.calibration.deformation_metric` for
        the fitted table. Calibrated cameras have Euclidean shapes already, which are
        not rotated: `scales_` and `rotations_` are those of their cameras.
        """
        check_is_fitted(self)
        cameras = (None, self.camera_, *choices.CALIBRATED_CAMERAS)
        if camera == "affine" or camera not in cameras:
            raise ValueError(
                f"camera must be None or one of {choices.CALIBRATED_CAMERAS}; got "
                f"{camera!r}"
            )
        if axes not in choices.AXES:
            raise ValueError(f"axes must be one of {choices.AXES}; got {axes!r}")
        if (turned := axes == "camera") and self.camera_ == "affine":
            raise ValueError(f"axes='camera' {_NEEDS_CALIBRATED}")
        decomposed, n_components = isinstance(X, Decomposition), len(self.basis_)
        if decomposed and point_weight is not None:
            raise ValueError(
                "point_weight needs the table; give it to decompose, not its result"
            )
        if decomposed and X.alpha.shape[1:] != (n_components,):
            raise ValueError(
                f"the decomposition must be that of a model with {n_components} basis "
                f"shapes; got alpha of shape {X.alpha.shape}"
            )
        if return_std:
            self._jointly_fitted("return_std", calibrated=True)
            if decomposed:
                raise ValueError(
                    "return_std needs the table, not the result of decompose, which "
                    "has no covariances"
                )
        fitted, metric = self.camera_, None
        if fitted != "affine" and camera not in (None, fitted):
            raise ValueError(
                f"the model was fitted with camera={fitted!r}, whose shapes are "
                f"Euclidean as they are; got camera={camera!r}"
            )
        if camera is not None and fitted == "affine":
            scaling.check_frames_kept(self, "reconstruct with a camera")
            metric = deformation_metric(self.motion_, self.alpha_)
        scaled, model = metric is not None and camera == "orthographic", self._model

        def shapes_of(fit: Decomposition, *_: NDArray) -> NDArray:
            shapes = model.shapes(fit, metric, scaled)
            return model.turned(shapes, fit) if turned else shapes

        if decomposed:
            return shapes_of(X)
        if not return_std:
            return fitted_model.of_fits(self, shapes_of, X, point_weight)
        table, weights = self._opened(X, point_weight)
        return table.collect(partial(model.uncertain_shapes, turned=turned), *weights)

    def shapes(self, alpha: Any) -> NDArray:
        """
        Return the 3D shapes with given coefficients.

        Parameters
        ----------
        alpha : array-like of shape (n_shapes, n_components)
            Coefficients, of frames or chosen ones: their standard deviation is one.

        Returns
        -------
        ndarray of shape (n_shapes, n_points, 3)
            ``S_i = mean_shape_ + sum_k alpha_ik basis_[k]``, NaN for rows with NaN, as
            `reconstruct` returns for the result of `decompose`.

        Raises
        ------
        ValueError
            If there is not one column for each basis shape.
        """
        check_is_fitted(self)
        alpha = check_array(tables.unmasked(alpha), input_name="alpha", **tables.CHECKS)
        if alpha.shape[1] != len(self.basis_):
            expected = len(alpha), len(self.basis_)
            raise ValueError(f"alpha must have shape {expected}; got {alpha.shape}")
        return camera_models.compose(self.mean_shape_, self.basis_, alpha)

    def mirrored(self) -> Self:
        """
        Return the mirror image of the model in depth, which fits equally well.

        If missing points do not decide between the two (`mirror_certainty_`), the fit
        chooses the one whose mean shape has depths of positive skewness. Use this
        method if that is the wrong one, for example a face whose nose points away.
        Coefficients, reprojection and score stay the same.

        Returns
        -------
        AffineNRSfM
            A copy with changed signs of z of the shapes and of the third column of the
            cameras. Its rotations are those mirrored along the line of sight.
        """
        check_is_fitted(self)
        if fitted_model.sees_perspective(self):
            raise ValueError(
                "perspective decides between the two mirror images: the other one does "
                "not fit. mirror_certainty_ is the probability of the right one"
            )
        mirror = copy.copy(self)
        mirror.__dict__.update(self._model.mirrored_attributes(self.__dict__))
        return mirror

    def reproject(self, X: Any, *, point_weight: Any = None) -> NDArray:
        """
        Return the images of the fitted shapes, including missing points.

        Parameters
        ----------
        X : array-like of shape (n_frames, 2 * n_points)
            A table with the points of the fitted one.
        point_weight : array-like of shape (n_frames, n_points), default=None
            Weights of the points, as in `fit`.

        Returns
        -------
        ndarray of shape (n_frames, 2 * n_points)
            Points of the fitted shapes in the fitted cameras. NaN for rows with too
            few visible points.
        """
        check_is_fitted(self)
        return fitted_model.of_fits(self, self._model.reproject, X, point_weight)

    def inverse_transform(
        self, alpha: Any, motion: Any = None, translation: Any = None
    ) -> NDArray:
        """
        Return images of coefficients in one mean view; `reproject` has those of rows.

        Parameters
        ----------
        alpha : array-like of shape (n_frames, n_components)
            Coefficients.
        motion : array-like of shape (n_frames, 2, 3) or (2, 3), default=None
            Cameras; None is `reference_motion_`, the mean view of the fitted table.
        translation : array-like of shape (n_frames, 2) or (2,), default=None
            Positions; None is `reference_translation_`, the mean centroid of the fit.

        Returns
        -------
        ndarray of shape (n_frames, 2 * n_points)
            The table, in the order of `layout`. NaN for rows with NaN in `alpha`.

        Raises
        ------
        ValueError
            If the shapes do not fit the model or each other.
        """
        shapes = self.shapes(alpha)
        motion = self.reference_motion_ if motion is None else motion
        if translation is None:
            translation = self.reference_translation_
        motion = scaling.checked("motion", motion, (len(shapes), 2, 3), (2, 3))
        translation = scaling.checked(
            "translation", translation, (len(shapes), 2), (2,)
        )
        images = self._model.images(shapes, motion, translation)
        return tables.tracks_to_table(images, self._model.layout)

    def score(self, X: Any, y: Any = None, *, point_weight: Any = None) -> float:
        """
        Return minus the inverse SNR of points held out of the fit of their frame.

        The points are divided into five fixed parts, each predicted from the others.
        With affine cameras this error rises with too many basis shapes: it can choose
        `n_components`. With others it is the same for all: take `AffineNRSfMCV`.

        Parameters
        ----------
        X : array-like of shape (n_frames, 2 * n_points)
            A table with the points of the fitted one.
        y : None
            Ignored.
        point_weight : array-like of shape (n_frames, n_points), default=None
            Weights of the points, as in `fit`, and of the terms of the sums.

        Returns
        -------
        float
            ``-sum ||m - m_hat||^2 / sum ||m - centroid_i||^2`` over all points, with
            frames scaled as in the fit. Larger is better. Points are left out whose
            place the others of their frame do not determine.
        """
        table, weights = self._opened(X, point_weight, judged=False)
        noise, signal = table.joined(self._model.held_out_sums, *weights).sum(axis=0)
        return -float(noise / signal) if signal > 0 else float("nan")

    def diagnostics(self, X: Any = None, *, point_weight: Any = None) -> Diagnostics:
        """
        Return diagnostics of how well the fitted table determines its fit.

        Parameters
        ----------
        X : array-like of shape (n_frames, 2 * n_points), default=None
            The fitted table. If given, it is searched for outliers.
        point_weight : array-like of shape (n_frames, n_points), default=None
            Weights of the points, as in `fit`.

        Returns
        -------
        Diagnostics
            Named tuple of figures, and messages on what to do about them.

        Raises
        ------
        ValueError
            If the model was not refined jointly: the paper's pipeline has no noise
            variance; or if X has not the rows of the fitted table.
        """
        check_is_fitted(self)
        self._jointly_fitted("diagnostics")
        scaling.check_frames_kept(self, "diagnostics")
        rows = X.index if hasattr(X, "iloc") else range(len(self._frame_sizes))
        table, weights = (None, ()) if X is None else self._opened(X, point_weight)
        return diagnose(self, table, weights, rows)

    def _jointly_fitted(self, name: str, calibrated: bool = False) -> FrameModel:
        """Return the model of a frame with noise, and calibrated cameras, or raise."""
        frames = self._model.frames
        if not frames.joint:
            raise ValueError(
                f"{name} needs a model with refinement='joint', which has a noise "
                f"variance; got refinement={self.refinement!r}"
            )
        if calibrated and self.camera_ == "affine":
            raise ValueError(f"{name} {_NEEDS_CALIBRATED}")
        return frames

    def _opened(
        self, X: Any, point_weight: Any = None, reset: bool = False, judged: bool = True
    ) -> tuple[tables.FrameBlocks, tuple[NDArray, ...]]:
        """Return the rows (n, 2, J) of a table, and the weights (n, J) of their points.

        There are no weights if all visible points have weight one. Unless `reset`, the
        table must match the fit: parameters that are set after it have no effect.
        `judged`: warn if it does not fit the model.
        """
        layout = self.layout
        if not reset:
            if self._held and self._held[0] is X and self._held[1] is point_weight:
                return self._held[2]
            check_is_fitted(self)
            layout, frames = self._model.layout, self._model.frames
            refinement = "joint" if frames.joint else None
            parameters = {"point_weight": point_weight, "refinement": refinement}
            choices.check_requirements(parameters | {"loss": frames.loss})
        if tables.is_read_later(X):
            scaling.check_table(X, layout)
            empty = tables.column_sample(X)
            validate_data(self, empty, reset=reset, skip_check_array=True)
        else:
            X = scaling.validated_table(self, X, layout, reset)
        names = getattr(self, "feature_names_in_", None)
        table = tables.open_table(X, layout, names, counted=reset, n_jobs=self.n_jobs)
        for share in self._focal_shares(table):
            # As cameras with the mean focal length would show the rows
            centre = np.reshape(self.principal_point, (2, 1))
            moved = partial(camera_models.zoomed, centre=centre)
            table = table.derive(moved, share[..., None])
        weights: tuple[NDArray, ...] = ()
        if point_weight is not None:
            table, weights = scaling.weighted_rows(table, point_weight)
        if judged and not (reset or tables.is_on_dask(X)):
            fitted_model.warn_if_foreign(self, table, None, *weights)
        return table, weights


def limited(limits: Limits) -> type[AffineNRSfM]:
    """Return a subclass of `AffineNRSfM` with other limits, for tests."""
    return type("LimitedNRSfM", (AffineNRSfM,), {"_limits": limits})


def check_class(estimator: object, where: str) -> None:
    """Raise if an object is not the estimator of this package."""
    if not isinstance(estimator, AffineNRSfM):
        raise ValueError(
            f"{where} should be an AffineNRSfM; got {type(estimator).__name__}"
        )
