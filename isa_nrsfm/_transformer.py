"""A fitted model as a transformer of tables: all methods but `fit`."""

import copy
from functools import partial
from numbers import Integral, Real
from typing import TYPE_CHECKING, Any, ClassVar, NamedTuple, Self

import numpy as np
from numpy.typing import NDArray
from sklearn.base import ClassNamePrefixFeaturesOutMixin, TransformerMixin
from sklearn.utils import check_array, check_scalar, estimator_html_repr
from sklearn.utils.validation import check_is_fitted, validate_data

from isa_nrsfm._compat.scikit_learn import ShownEstimator
from isa_nrsfm._diagnostics import Diagnostics, diagnose
from isa_nrsfm._fitted_model import TableModel
from isa_nrsfm._frames.camera_models import CAMERAS, full_rotations
from isa_nrsfm._frames.dynamics import smoothed_frames
from isa_nrsfm._frames.models import MIRROR, Decomposition, PosteriorFrames
from isa_nrsfm._frames.projection import compose, project
from isa_nrsfm._metric_upgrade.deforming import deformation_metric
from isa_nrsfm._parameters.choices import CALIBRATED_CAMERAS, JOINT_REFINEMENTS
from isa_nrsfm._prepare.checks import check_table, validated_table
from isa_nrsfm._prepare.point_weights import weighted_rows
from isa_nrsfm._summary import summary_html
from isa_nrsfm._tables.blocks import FrameBlocks
from isa_nrsfm._tables.sources import (
    CHECKS,
    checked_range,
    column_sample,
    is_read_later,
    open_table,
    unmasked,
)
from isa_nrsfm._tables.tracks import Layout, tracks_to_table

_NEEDS_CALIBRATED = (
    "needs a model with calibrated cameras; got camera='affine'. Fit with "
    "camera='weak_perspective' or camera='orthographic'"
)


class SmoothedCoefficients(NamedTuple):
    """
    Coefficients and cameras of frames, given all frames of their sequence.

    Attributes
    ----------
    alpha : ndarray of shape (n_frames, n_components)
        Posterior means. Without dynamics they are those of `AffineNRSfM.transform`.
        With dynamics, rows with too few visible points are filled in.
    alpha_std : ndarray of shape (n_frames, n_components)
        Posterior standard deviations.
    time_scales : ndarray of shape (n_components,) or (0,)
        Time scales T of directions of the coefficients, the longest first, in the units
        of `time`: the correlation after a time t is ``(1 + t / T) exp(-t / T)``.
        Infinite for 1000 steps or more. Empty if the coefficients show no dynamics.
    decomposition : Decomposition
        Smoothed cameras, positions and coefficients, for `AffineNRSfM.reconstruct` and
        exports. Cameras are filled in, positions are NaN if too few points are visible.
    """

    alpha: NDArray
    alpha_std: NDArray
    time_scales: NDArray
    decomposition: Decomposition


class CoefficientNamesMixin(ClassNamePrefixFeaturesOutMixin):
    """Names of the columns of the results of `transform`."""

    def get_feature_names_out(self, input_features: Any = None) -> NDArray:
        """
        Return the names of the coefficients.

        Parameters
        ----------
        input_features : array-like of str, default=None
            Checked against the names of the fitted columns; otherwise unused.

        Returns
        -------
        ndarray of str, shape (n_components,)
            ``alpha_1``, ``alpha_2`` and so on, as in the files of the command line.
        """
        n_components = len(super().get_feature_names_out(input_features))
        names = [f"alpha_{k + 1}" for k in range(n_components)]
        return np.array(names, dtype=object)


class TableTransformer(CoefficientNamesMixin, TransformerMixin, ShownEstimator):
    """The methods of `AffineNRSfM` that need a fit: its attributes and `_model`."""

    n_components: Any
    isa: Any
    block_recovery: str
    refinement: str | None
    camera: str
    independence: str | None
    loss: str
    layout: Layout
    scale_frames: bool
    max_iter: int
    tol: float | None
    keep_frames: bool
    working_memory: float | None
    n_jobs: int | None

    mean_shape_: NDArray
    basis_: NDArray
    alpha_: NDArray
    alpha_std_: NDArray
    motion_: NDArray
    translation_: NDArray
    rotations_: NDArray
    scales_: NDArray
    inverse_snr_: float
    rank_floor_: float
    noise_variance_: float
    camera_noise_ratio_: float
    depth_uncertainty_: float
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

    _limits: ClassVar[Any]
    _model: TableModel
    _frame_sizes: NDArray

    def __sklearn_tags__(self) -> Any:
        """Return the estimator's tags."""
        tags = super().__sklearn_tags__()
        tags.transformer_tags.preserves_dtype = ["float64", "float32"]
        tags.input_tags.allow_nan = True
        return tags

    @property
    def _is_joint(self) -> bool:
        """Whether the refinement is the joint fit, or begins with it."""
        return self.refinement in JOINT_REFINEMENTS

    def __sklearn_is_fitted__(self) -> bool:
        """Return whether a fit has ended."""
        return hasattr(self, "_model")

    if not TYPE_CHECKING:  # mypy would accept any name

        def __getattr__(self, name: str) -> Any:
            """Raise an error; it states why affine fits lack an attribute."""
            affine = vars(self).get("camera_") == "affine"
            if affine and name in ("rotations_", "scales_", "depth_uncertainty_"):
                raise AttributeError(f"{name} {_NEEDS_CALIBRATED}", name=name, obj=self)
            return super().__getattribute__(name)

    def _html_repr(self) -> str:
        """Return scikit-learn's diagram for notebooks, and a summary."""
        picture = estimator_html_repr(self)
        return picture + summary_html(self) if hasattr(self, "basis_") else picture

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
            Coefficients; `alpha_` for the fitted table. NaN for rows with too few
            visible points.
        """
        table, weights = self._weighted(X, point_weight)
        coefficients = partial(self._model.decompose, deviations=False)
        return table.collect(coefficients, *weights).alpha

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
            alpha_std (n_frames, n_components).
        """
        table, weights = self._weighted(X, point_weight)
        return table.collect(self._model.decompose, *weights)

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
        six none. The fit of the shapes does not depend on the order of the frames:
        smoothing is a step after it.

        Parameters
        ----------
        X : array-like of shape (n_frames, 2 * n_points)
            A table with the points of the fitted one. The rows of each group are in
            temporal order.
        point_weight : array-like of shape (n_frames, n_points), default=None
            Weights of the points, as in `fit`.
        time : array-like of shape (n_frames,), default=None
            Times of the frames, numbers or dates (in seconds from the first). Their
            median difference is one step. Other differences are rounded to whole steps.
            If None, consecutive frames are one step apart.
        groups : array-like of shape (n_frames,), default=None
            Person, video or scene of each frame. Smoothing does not cross groups.
            Each sequence has its own intercept, so that differences between people are
            not taken for dynamics. None for one group.
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
            Named tuple of alpha, alpha_std (n_frames, n_components), time_scales and
            decomposition.

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
        and variances maximise the likelihood. If the evidence for dynamics of the
        coefficients is weak, as for photos in any order, the result is that of
        `decompose`: the likelihood is compared with that of intercepts alone.
        """
        check_scalar(max_gap, "max_gap", Integral, min_val=1)
        check_scalar(max_iter, "max_iter", Integral, min_val=1)
        check_scalar(tol, "tol", Real, min_val=0.0)
        table, weights = self._weighted(X, point_weight)
        frames = self._jointly_fitted("smooth")
        alone = table.joined(self._model.linearised, *weights)
        found = smoothed_frames(
            alone,
            CAMERAS[self.camera_],
            time,
            groups,
            max_gap=max_gap,
            max_iter=max_iter,
            tol=tol,
        )
        given, scales = (alone, np.empty(0)) if found is None else (found, found[-1])
        motion, alpha, deviation = frames.gauge.apply(
            given.motion, given.alpha, given.covariance
        )
        fit = Decomposition(motion, given.translation, alpha, deviation)
        fit = Decomposition(*(each.astype(table.empty.dtype) for each in fit))
        return SmoothedCoefficients(fit.alpha, fit.alpha_std, scales, fit)

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
            as rotation vectors: ``R exp(hat(w))``, with w in the axes of the shapes.
            Each is the covariance of the frame plus that of the shapes, from a
            jackknife over groups of points. NaN for rows with too few visible points.

        Raises
        ------
        ValueError
            If the model has affine cameras, or was not refined jointly.
        """
        table, weights = self._weighted(X, point_weight)
        frames = self._jointly_fitted("rotation_covariance", calibrated=True)
        space, certainty = frames.gauge.space, frames.certainty
        found = table.joined(self._model.posterior, *weights)
        covariance = space @ found.turn_covariance @ space.T
        if certainty.turns is not None:
            R, _ = full_rotations(found.motion @ space.T)
            covariance = covariance + R.transpose(0, 2, 1) @ certainty.turns @ R
        return np.asarray(covariance).astype(table.empty.dtype, copy=False)

    def reconstruct(
        self,
        X: Any,
        camera: str | None = None,
        *,
        return_std: bool = False,
        point_weight: Any = None,
    ) -> Any:
        """
        Return the 3D shape of each frame of a table.

        Parameters
        ----------
        X : array-like of shape (n_frames, 2 * n_points), or Decomposition
            A table with the points of the fitted one, or the result of `decompose`,
            whose frames are not fitted again.
        camera : {"orthographic", "weak_perspective"} or None, default=None
            Calibrated camera model of the images, for a model that was fitted with
            affine cameras. None returns affine shapes, in the space of `mean_shape_`:
            their angles and proportions in depth are not those of the object. Otherwise
            shapes are Euclidean, up to one rotation and one mirror image for all
            frames. With "weak_perspective" each camera has its own scale, and the sizes
            of the shapes have no meaning. With "orthographic" all cameras have one
            scale, and shapes are in the units of the table.

        return_std : bool, default=False
            Whether to return the standard deviations of the depths, for a model with
            calibrated cameras.
        point_weight : array-like of shape (n_frames, n_points), default=None
            Weights of the points of a table, as in `fit`.

        Returns
        -------
        shapes : ndarray of shape (n_frames, n_points, 3)
            Shapes in their own axes, not in the axes of the camera. NaN for rows with
            too few visible points. If `camera` is given for an affine model, each shape
            is rotated as near as possible to the mean shape.
        depth_std : ndarray of shape (n_frames, n_points)
            Only with `return_std`. Standard deviations of the coordinates of the points
            along the viewing direction of their frame, in the units of the shapes. They
            contain the uncertainty of camera, coefficients and shapes.

        Raises
        ------
        ValueError
            If `camera` is none of these, if the cameras of the fitted table see fewer
            than three directions of space, or if the model was fitted with calibrated
            cameras other than `camera`. If `return_std` is given with a decomposition,
            or the decomposition has another number of coefficients.

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
        `motion_` and `alpha_`, the cameras and coefficients of the fitted table, for
        any X. If the model was fitted with calibrated cameras, its shapes are Euclidean
        already. They are not rotated, so that `scales_` and `rotations_` are those of
        their cameras.
        """
        if camera is not None and camera not in CALIBRATED_CAMERAS:
            raise ValueError(
                f"camera must be None or one of {CALIBRATED_CAMERAS}; got {camera!r}"
            )
        check_is_fitted(self)
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
            check_frames_kept(self, "reconstruct with a camera")
            metric = deformation_metric(self.motion_, self.alpha_)
        scaled = metric is not None and camera == "orthographic"
        if decomposed:
            return self._model.shapes(X, metric, scaled)
        table, weights = self._weighted(X, point_weight)
        if return_std:
            return tuple(table.collect(self._model.uncertain_shapes, *weights))
        shapes = partial(self._model.reconstruct, metric=metric, scaled=scaled)
        return table.collect(shapes, *weights)

    def mirrored(self) -> Self:
        """
        Return the mirror image of the model in depth, which fits equally well.

        Neither affine nor calibrated cameras distinguish an object from its mirror
        image. The fit chooses the one whose mean shape has depths of positive skewness.
        Use this method if that is the wrong one, for example a face whose nose points
        away. Coefficients, reprojection and score stay the same.

        Returns
        -------
        AffineNRSfM
            A copy with changed signs of z of the shapes and of the third column of the
            cameras. Its rotations are ``D R D`` with ``D = diag(1, 1, -1)``.

        Examples
        --------
        >>> from isa_nrsfm import AffineNRSfM
        >>> from isa_nrsfm.datasets import make_face_tracks
        >>> faces = make_face_tracks(n_frames=100, random_state=0)
        >>> model = AffineNRSfM(2, camera="weak_perspective").fit(faces.data)
        >>> bool((model.mirrored().mean_shape_[:, 2] == -model.mean_shape_[:, 2]).all())
        True
        """
        check_is_fitted(self)
        found, dtype = copy.copy(self), self.mean_shape_.dtype
        for name in ("mean_shape_", "basis_", "reference_motion_", "motion_"):
            if hasattr(self, name):
                setattr(found, name, getattr(self, name) * MIRROR.astype(dtype))
        if hasattr(self, "rotations_"):
            turned = MIRROR[:, None] * self.rotations_ * MIRROR
            found.rotations_ = turned.astype(dtype, copy=False)
        signs = np.tile(MIRROR, len(self.basis_))
        found.mode_covariance_ = signs[:, None] * self.mode_covariance_ * signs
        found._model = self._model._replace(
            frames=self._model.frames.mirrored(),
            mean_shape=found.mean_shape_,
            basis=found.basis_,
        )
        return found

    def reproject(self, X: Any) -> NDArray:
        """
        Return the images of the fitted shapes, including missing points.

        Parameters
        ----------
        X : array-like of shape (n_frames, 2 * n_points)
            A table with the points of the fitted one.

        Returns
        -------
        ndarray of shape (n_frames, 2 * n_points)
            Points of the fitted shapes in the fitted cameras. NaN for rows with too
            few visible points.
        """
        return self._opened(X).collect(self._model.reproject)

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
        alpha = unmasked(alpha)
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
        return tracks_to_table(project(shapes, motion, translation), self._model.layout)

    def score(self, X: Any, y: Any = None, *, point_weight: Any = None) -> float:
        """
        Return minus the inverse SNR of points held out of the fit of their frame.

        The points are divided into five parts, always the same. Each part is predicted
        from the others, frame by frame. Unlike the reprojection error of fitted points,
        this error rises with too many basis shapes. So the score can choose
        `n_components`.

        Parameters
        ----------
        X : array-like of shape (n_frames, 2 * n_points)
            A table with the points of the fitted one.
        y : None
            Ignored.
        point_weight : array-like of shape (n_frames, n_points), default=None
            Weights of the points, as in `fit`. They also multiply the terms of the
            sums.

        Returns
        -------
        float
            ``-sum ||m - m_hat||^2 / sum ||m - centroid_i||^2`` over all points, with
            frames scaled as in the fit. Larger is better. A point is left out if the
            other points of its frame do not determine the fit. In frames with missing
            points it is also left out if the camera of the others adds more than
            twice the noise variance to its prediction.
        """
        table, weights = self._weighted(X, point_weight)
        noise, signal = table.joined(self._model.held_out, *weights).sum(axis=0)
        return -float(noise / signal) if signal > 0 else float("nan")

    def diagnostics(self, X: Any = None) -> Diagnostics:
        """
        Return diagnostics of how well the fitted table determines its fit.

        Parameters
        ----------
        X : array-like of shape (n_frames, 2 * n_points), default=None
            The fitted table. If given, it is searched for outliers.

        Returns
        -------
        Diagnostics
            Named tuple of camera_singular_values, deformation_amplitude, reliability,
            effective_frames, weak_deviations, depth_uncertainty, camera_noise_ratio,
            camera_meaning, pose_share, outlier_share, outliers and messages. The
            messages are sentences, for example if the table supports fewer basis
            shapes, or if it has outliers.

        Raises
        ------
        ValueError
            If the model was not refined jointly: the paper's pipeline has no noise
            variance.
        """
        check_is_fitted(self)
        self._jointly_fitted("diagnostics")
        check_frames_kept(self, "diagnostics")
        distance = None
        if X is not None:
            distance = self._opened(X).joined(self._model.distances)
        rows = X.index if hasattr(X, "iloc") else range(len(self._frame_sizes))
        return diagnose(self, distance, rows)

    def _jointly_fitted(self, name: str, calibrated: bool = False) -> PosteriorFrames:
        """Return the model of a frame with noise, and calibrated cameras, or raise."""
        frames = self._model.frames
        if not isinstance(frames, PosteriorFrames):
            raise ValueError(
                f"{name} needs a model with refinement='joint', which has a noise "
                f"variance; got refinement={self.refinement!r}"
            )
        if calibrated and self.camera_ == "affine":
            raise ValueError(f"{name} {_NEEDS_CALIBRATED}")
        return frames

    def _weighted(
        self, X: Any, point_weight: Any, reset: bool = False
    ) -> tuple[FrameBlocks, tuple[NDArray, ...]]:
        """Return the rows of a table, as `_opened`, and the weights (n, J) of points.

        There are none if all visible points have weight one. Points of weight zero are
        missing.
        """
        if point_weight is None:
            return self._opened(X, reset), ()
        if not reset:
            check_is_fitted(self)
        # Parameters that are set after a fit have no effect on its model.
        frames = None if reset else self._model.frames
        if not (self._is_joint if reset else isinstance(frames, PosteriorFrames)):
            raise ValueError(
                "point_weight needs a fit with refinement='joint', because the "
                "refinement of the paper has no weights. Set refinement='joint', or "
                "set points of low weight to NaN"
            )
        loss = self.loss if reset else getattr(frames, "loss", "linear")
        if loss != "linear":
            raise ValueError(
                "point_weight needs loss='linear', because robust losses find weights "
                f"of their own; got loss={loss!r}. Set loss='linear', or set points of "
                "low weight to NaN"
            )
        if is_read_later(X):
            raise ValueError(
                "point_weight needs a table in memory, because weights are not read "
                f"block by block; got a {type(X).__name__}. Give a NumPy array or a "
                "dataframe, or no point_weight"
            )
        table = self._opened(X, reset)
        visible, weights = weighted_rows(table, point_weight)
        return visible, () if weights is None else (weights,)

    def _opened(self, X: Any, reset: bool = False) -> FrameBlocks:
        """Return checked rows of a table; unless `reset`, it must match the fit."""
        if not reset:
            check_is_fitted(self)
        layout = self.layout if reset else self._model.layout
        if is_read_later(X):
            check_table(X, layout)
            validate_data(self, column_sample(X), reset=reset, skip_check_array=True)
        else:
            least = {"ensure_min_samples": 2, "ensure_min_features": 2} if reset else {}
            X = validated_table(self, X, layout, reset=reset, **CHECKS, **least)
            checked_range(X)
        return open_table(
            X,
            layout,
            getattr(self, "feature_names_in_", None),
            counted=reset,
            n_jobs=self.n_jobs,
            working_memory=self.working_memory,
        )


def frames_of(estimator: TableTransformer) -> Any:
    """Return the fitted model of single frames."""
    return estimator._model.frames


def checked(name: str, values: Any, *allowed: tuple[int, ...]) -> NDArray:
    """Return values as a finite array of one of the allowed shapes, or raise."""
    array = check_array(
        unmasked(values),
        dtype=[np.float64, np.float32],
        input_name=name,
        ensure_2d=False,
        allow_nd=True,
    )
    if array.shape not in allowed:
        expected = " or ".join(map(str, allowed))
        raise ValueError(f"{name} must have shape {expected}; got {array.shape}")
    return array


def check_frames_kept(estimator: Any, what: str) -> None:
    """Raise an error if the frames of the fit are needed and were not kept."""
    if not hasattr(estimator, "motion_"):
        raise ValueError(
            f"{what} needs the cameras and coefficients of the fitted table, which "
            "were not kept: got keep_frames=False. Fit again with keep_frames=True"
        )
