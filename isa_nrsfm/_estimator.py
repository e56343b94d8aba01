"""AffineNRSfM: the scikit-learn transformer on top of the stages."""

import os
import warnings
from collections.abc import Callable
from functools import partial
from numbers import Integral, Real
from typing import Any, ClassVar, NamedTuple, Self

import numpy as np
from numpy.typing import NDArray
from sklearn.base import (
    BaseEstimator,
    ClassNamePrefixFeaturesOutMixin,
    TransformerMixin,
    clone,
)
from sklearn.exceptions import ConvergenceWarning
from sklearn.utils import check_array, check_random_state, estimator_html_repr
from sklearn.utils._param_validation import HasMethods, Interval, StrOptions
from sklearn.utils.validation import check_is_fitted, validate_data

from isa_nrsfm._compat.callbacks import CallbackSupportMixin, FitProgress
from isa_nrsfm._compat.parameters import fit_context
from isa_nrsfm._diagnostics import Diagnostics, diagnose, reliabilities
from isa_nrsfm._fitted_model import TableModel
from isa_nrsfm._frames.basis_change import FrameMap
from isa_nrsfm._frames.camera import reference_camera
from isa_nrsfm._frames.camera_models import (
    CAMERAS,
    full_rotations,
    nearest_calibrated,
)
from isa_nrsfm._frames.models import FrameFit, PosteriorFrames, RigidFrames
from isa_nrsfm._frames.posterior import spread_starts
from isa_nrsfm._frames.projection import compose, project, reprojection_error
from isa_nrsfm._gauge.canonical import (
    canonical_gauge,
    canonical_space,
    euclidean_space,
    image_energies,
    mode_covariance,
    reorder_blocks,
)
from isa_nrsfm._gauge.independent import INDEPENDENCE, independent_gauge
from isa_nrsfm._joint.fit import Spectrum, count_components, fit_jointly
from isa_nrsfm._joint.sample_posterior import posterior_blocks, posterior_moments
from isa_nrsfm._joint.starts import rigid_start
from isa_nrsfm._metric_upgrade.deforming import deformation_metric
from isa_nrsfm._metric_upgrade.residuals import CAMERA_MODELS
from isa_nrsfm._paper.block_structure import BLOCK_RECOVERIES
from isa_nrsfm._paper.factors import Factorisation, factorise
from isa_nrsfm._paper.pipeline import PaperResult, run_paper_pipeline
from isa_nrsfm._paper.sample import Sample, sample_frames
from isa_nrsfm._paper.svd import Triplets, block_triplets
from isa_nrsfm._prepare.checks import check_names, largest_n_components, most_for_frames
from isa_nrsfm._prepare.completion import complete_rows
from isa_nrsfm._prepare.robust import LOSSES, gross_outliers
from isa_nrsfm._prepare.scaling import ScaledTable, rows_without, scaled_table
from isa_nrsfm._summary import summary_html
from isa_nrsfm._tables.blocks import FrameBlocks
from isa_nrsfm._tables.layout import LAYOUTS, Layout, tracks_to_table
from isa_nrsfm._tables.sources import (
    CHECKS,
    StoredTable,
    Table,
    column_sample,
    is_on_dask,
    is_stored,
)
from isa_nrsfm.isa import PooledFastICA

# Tolerances where none is given: for each frame, of minus twice the log likelihood, and
# for the paper's refinement, of the energy that it explains.
JOINT_TOL, PAPER_TOL = 0.025, 1e-10
# Runs of FastICA, and steps and tolerance of the paper's refinement, where the result
# is only a start.
START_RUNS, START_STEPS, START_TOL = 2, 200, 1e-5
# Basis shapes of which "auto" takes the relevant ones.
MOST_COMPONENTS = 12
# Coefficients of frames from which the fit of a frame starts besides zero.
N_STARTS = 8
# What a fit may keep of the frames, what of calibrated cameras, and what only the joint
# refinement tells.
OF_FRAMES = ("motion_", "translation_", "alpha_", "alpha_std_")
OF_CALIBRATED = ("rotations_", "scales_")
OF_JOINT_FIT = (
    "noise_variance_",
    "camera_noise_ratio_",
    "reliability_",
    "objective_history_",
    "gradient_norm_",
)
# Stages of a fit, the joint refinement only where it is wanted.
JOINT_STAGE = "joint refinement"
STAGES = (
    "table",
    "factorisation",
    "independent subspaces",
    "block structure and refinement",
    JOINT_STAGE,
    "gauge and coefficients",
)


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


class AffineNRSfM(
    CallbackSupportMixin,
    ClassNamePrefixFeaturesOutMixin,
    TransformerMixin,
    BaseEstimator,
):
    """
    Affine non-rigid structure from motion by independent subspace analysis.

    Factorises a table of 2D landmarks, one frame a row, into a mean 3D shape, basis
    shapes, and for each frame a camera and coefficients that do not depend on the
    viewpoint. No calibration, training data or order of the frames is needed. Row i,
    reshaped to (n_points, 2), is modelled as::

        (mean_shape_ + tensordot(alpha_[i], basis_, 1)) @ motion_[i].T + translation_[i]

    Parameters
    ----------
    n_components : int or "auto", default=3
        K, the number of basis shapes. K needs at least 3K + 4 points and
        ``ceil(8 (K + 2) / 5)`` frames. "auto" takes those of twelve, or of as many as
        the table allows, that are relevant (joint refinement only); ``len(basis_)`` is
        what was found.
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
    camera : {"affine", "weak_perspective", "orthographic"}, default="affine"
        What is known of the cameras. "affine" assumes nothing: shapes are known up to
        an affinity of space, and where an object moves much, as bodies do, cameras
        absorb part of the deformation. "weak_perspective" are rotations with a scale
        for each frame, a good model of most photos of objects that are far away for
        their size; "orthographic" ones have the same scale in all frames. With these
        shapes, lengths and angles are true, up to one mirror image (`mirror`).
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
    layout : {"interleaved", "planar"}, default="interleaved"
        Whether the columns are x0, y0, x1, y1, ... or x0, x1, ..., y0, y1, ...
    scale_frames : bool, default=True
        Whether each centred frame is divided by the root mean square of its
        coordinates before the fit, so that photos of any resolution count alike;
        the scale is given back to `motion_`. With False frames count by their size.
        With orthographic cameras, which have one scale, frames are not scaled.
    max_iter : int, default=1000
        The most steps of the refinement.
    tol : float or None, default=None
        The joint refinement has converged when two successive steps each lower minus
        twice the log likelihood by less than tol for each frame (0.025 by default; its
        first steps, on a sample of a large table, end before that), and
        the alternating one when a step would gain less than this share of the energy
        it explains (1e-10 by default).
    random_state : int, RandomState instance or None, default=None
        Seeds the strategy; an int makes the result reproducible.
    keep_frames : bool, str or path-like, default=True
        Whether `alpha_`, `alpha_std_`, `motion_` and `translation_` are kept. A path is
        that of a folder for files of these names, ``alpha.npy`` and so on, of which
        they are memory maps.
    working_memory : float or None, default=None
        Megabytes that a block of a table takes that is not in memory (a memory map or a
        table of `isa_nrsfm.io.open_table`); None is scikit-learn's setting
        `working_memory`. The result does not depend on it. A few numbers for each frame
        are in memory besides, about 1 kB.
    n_jobs : int or None, default=None
        Number of threads that work on the frames, and of joblib workers for strategies
        that use them. The result does not depend on it.
    verbose : int, default=0
        Above zero, print a line for each stage. With scikit-learn 1.9 and later the fit
        tells its callbacks of stages and steps, too: ``set_callbacks(ProgressBar())``.

    Attributes
    ----------
    mean_shape_ : ndarray of shape (n_points, 3)
        Mean shape B_0, centred and white: the mean of ``b b^T`` over the points is
        the identity (of rank two for flat objects). With weak-perspective cameras only
        the mean square of its coordinates is one, with orthographic ones it is in the
        units of the table. x and y are the axes of the mean
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
    rotations_ : ndarray of shape (n_frames, 3, 3)
        Rotations of calibrated cameras, of determinant one: the rows are the axes of
        the image, x, y and z (only with such cameras, as `scales_`).
    scales_ : ndarray of shape (n_frames,)
        Their scales, in units of the table per unit of the shapes; one where they are
        orthographic. The image of frame i is ``scales_[i] * S_i @ rotations_[i, :2].T +
        translation_[i]`` with ``S_i = reconstruct(X)[i]``.
    inverse_snr_ : float
        ``||W - What||_F^2 / ||W||_F^2``, a fraction, with W the centred tracks, scaled
        as in the fit; of the points that are seen.
    rank_floor_ : float
        The least inverse SNR that any model of rank 3K + 3 reaches, missing points
        being filled in.
    noise_variance_ : float
        Variance of the noise of a coordinate; of frames of size one where frames are
        scaled (joint refinement only, as are the next four).
    camera_noise_ratio_ : float
        Noise variance of the fit with calibrated cameras, divided by that of the fit
        with affine ones, from the frames that the first steps are made on; see
        `diagnostics`.
    reliability_ : ndarray of shape (n_components,)
        Shares of the variance of the coefficients that are not uncertainty, along
        uncorrelated directions, decreasing.
    objective_history_ : ndarray of shape (`n_iter_` + 1,)
        Minus twice the log posterior, up to a constant, before the last refinement and
        after each of its steps; it never rises.
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
    feature_names_in_ : ndarray of shape (`n_features_in_`,)
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

    `fit` and the methods for new tables take tables that are not in memory, too. Of a
    dask array `alpha_`, `alpha_std_`, `motion_` and `translation_` are dask arrays, and
    so is what `transform`, `decompose`, `reconstruct` and `reproject` return.

    Points that are missing are NaN, in `fit` and everywhere else. A point of which only
    one coordinate is missing counts as missing, with a warning. Rows that show no point
    at all are left out of the fit, with a warning, and have NaN in `alpha_` and the
    other attributes of frames. Rows of which something is seen, but too little to
    determine a camera, are refused by `fit` and have NaN elsewhere.

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

    mean_shape_: NDArray
    basis_: NDArray
    alpha_: NDArray
    alpha_std_: NDArray
    motion_: NDArray
    translation_: NDArray
    inverse_snr_: float
    rank_floor_: float
    noise_variance_: float
    camera_noise_ratio_: float
    rotations_: NDArray
    scales_: NDArray
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
    _frames: RigidFrames | PosteriorFrames
    n_features_in_: int
    feature_names_in_: NDArray

    _parameter_constraints: ClassVar[dict[str, list[Any]]] = {
        "n_components": [
            Interval(Integral, 1, None, closed="left"),
            StrOptions({"auto"}),
        ],
        "isa": [None, HasMethods(["fit", "get_params", "set_params"])],
        "block_recovery": [StrOptions(set(BLOCK_RECOVERIES))],
        "refinement": [StrOptions({"joint", "alternating"}), None],
        "camera": [StrOptions(set(CAMERAS))],
        "independence": [StrOptions(set(INDEPENDENCE)), None],
        "loss": [StrOptions(set(LOSSES))],
        "layout": [StrOptions(set(LAYOUTS))],
        "scale_frames": ["boolean"],
        "max_iter": [Interval(Integral, 1, None, closed="left")],
        "tol": [None, Interval(Real, 0, None, closed="left")],
        "random_state": ["random_state"],
        "keep_frames": ["boolean", str, HasMethods("__fspath__")],
        "working_memory": [None, Interval(Real, 0, None, closed="neither")],
        "n_jobs": [None, Integral],
        "verbose": ["verbose"],
    }

    def __init__(
        self,
        n_components: Any = 3,
        *,
        isa: Any = None,
        block_recovery: str = "generalized_eigen",
        refinement: str | None = "joint",
        camera: str = "affine",
        independence: str | None = "shapes",
        loss: str = "linear",
        layout: Layout = "interleaved",
        scale_frames: bool = True,
        max_iter: int = 1000,
        tol: float | None = None,
        random_state: Any = None,
        keep_frames: Any = True,
        working_memory: float | None = None,
        n_jobs: int | None = None,
        verbose: int = 0,
    ):
        self.n_components = n_components
        self.isa = isa
        self.block_recovery = block_recovery
        self.refinement = refinement
        self.camera = camera
        self.independence = independence
        self.loss = loss
        self.layout = layout
        self.scale_frames = scale_frames
        self.max_iter = max_iter
        self.tol = tol
        self.random_state = random_state
        self.keep_frames = keep_frames
        self.working_memory = working_memory
        self.n_jobs = n_jobs
        self.verbose = verbose

    @fit_context(nested=True)
    def fit(self, X: Any, y: Any = None) -> Self:
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

        Returns
        -------
        AffineNRSfM
            The fitted estimator.

        Raises
        ------
        ValueError
            If X has an odd number of columns, infinite values, too few points or
            frames for `n_components`, a frame whose points are all equal, that shows
            one to three points or some on one line only, a point that is seen in too
            few frames, or column names that contradict `layout`; or if `loss` is not
            linear without the joint refinement, or either is not the default for a
            `StoredTable` or a dask array.

        Warns
        -----
        UserWarning
            If rows show no point and are left out, if points lack one coordinate, if
            the other layout explains the table much better, or if a refinement has not
            converged.
        """
        joint = self.refinement == "joint"
        stages = [stage for stage in STAGES if joint or stage != JOINT_STAGE]
        progress = FitProgress(self, stages, stepwise=JOINT_STAGE, X=X, y=y)
        for name in (*OF_FRAMES, *OF_CALIBRATED, *OF_JOINT_FIT):
            self.__dict__.pop(name, None)
        if not joint and self.loss != "linear":
            raise ValueError(
                f"loss={self.loss!r} needs refinement='joint'; "
                f"got refinement={self.refinement!r}"
            )
        if not joint or self.loss != "linear":
            if is_on_dask(X) or isinstance(X, StoredTable):
                raise ValueError(
                    "tables that are not in memory need refinement='joint' and "
                    f"loss='linear'; got refinement={self.refinement!r} and "
                    f"loss={self.loss!r}"
                )
            X = np.asarray(X) if isinstance(X, np.memmap) else X
        source = self._opened(X, reset=True)
        names = getattr(self, "feature_names_in_", None)
        check_names(names, self.layout)
        ready = partial(
            scaled_table,
            layout=self.layout,
            names=names,
            scale_frames=self._scales_frames,
            robust=self.loss != "linear",
        )
        n_components = self.n_components
        if n_components == "auto":
            n_components = self._count_components(ready, source)
        table = ready(source, n_components)
        self._unit = 1.0 if self._scales_frames else float(table.sizes[0])
        outliers, used = self._completed(table, n_components)
        progress("table")
        triplets, sample, factors = self._factors(table, used, n_components)
        progress("factorisation")
        self.isa_, result = self._paper_result(factors, n_components, progress)
        self.singular_values_ = self._unit * triplets.values
        self.rank_floor_ = triplets.rest_share
        self._n_features_out = n_components
        if joint:
            spectrum = Spectrum.from_singular_values(
                triplets.values,
                triplets.rest_share,
                n_components,
                table.n_points,
                table.n_seen,
            )
            frames = self._refine_jointly(
                table, outliers, sample, factors, result, spectrum, progress
            )
        else:
            frames = self._keep(table, sample.W, factors, result)
        self._describe(table, frames)
        self._keep_frames(source, table, frames)
        progress("gauge and coefficients")
        progress.end()
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
        self.fit(X)
        return self.alpha_.copy() if self.keep_frames else self.transform(X)

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
        table = self._opened(X)
        return Decomposition(*self._model.decompose(table)[:3])

    def reconstruct(self, X: Any, camera: str | None = None) -> NDArray:
        """
        Return the 3D shape of each frame of a table.

        Parameters
        ----------
        X : array-like of shape (n_frames, 2 * n_points)
            A table with the points of the fitted one.
        camera : {"orthographic", "weak_perspective"} or None, default=None
            What is known of the cameras, for a model with affine ones. None returns the
            affine shapes, in the space of `mean_shape_`: angles and proportions in
            depth are not those of the object. Otherwise shapes are Euclidean, up to
            rotation and mirror image, which are the same for all frames.
            "weak_perspective" lets each camera have a scale of its own, so that the
            sizes of the shapes mean nothing; "orthographic" has one scale for all, so
            that shapes are in the units of the table.

        Returns
        -------
        ndarray of shape (n_frames, n_points, 3)
            Shapes, without camera; NaN for rows of which too little is seen. Euclidean
            ones are turned to be as near as possible to the mean shape.

        Raises
        ------
        ValueError
            If `camera` is something else, if the cameras of the fitted table see less
            than three directions of space, or if the model has other calibrated cameras
            than those that are asked for.

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
        `motion_` and `alpha_`, the cameras of the fitted table, whatever X is. Models
        that were fitted with calibrated cameras have Euclidean shapes as they are: no
        shape is turned, and `scales_` and `rotations_` belong to them.
        """
        if camera is not None and camera not in CAMERA_MODELS:
            raise ValueError(
                f"camera must be None or one of {CAMERA_MODELS}; got {camera!r}"
            )
        table = self._opened(X)
        fitted, metric = self._frames.camera, None
        if fitted != "affine" and camera not in (None, fitted):
            raise ValueError(
                f"the model was fitted with camera={fitted!r}, whose shapes are "
                f"Euclidean as they are; got camera={camera!r}"
            )
        if camera is not None and fitted == "affine":
            self._need_frames("reconstruct with a camera")
            metric = deformation_metric(self.motion_, self.alpha_)
        scaled = metric is not None and camera == "orthographic"
        return self._model.reconstruct(table, metric, scaled)

    def mirror(self) -> Self:
        """
        Turn the model into its mirror image in depth, which fits as well.

        Neither affine nor calibrated cameras tell an object from its mirror image: the
        fit takes the one of which the mean shape has a depth of positive third moment.
        Where it is the wrong one, for instance a face whose nose points away, this
        takes the other one. Coefficients, reprojection and score stay as they are.

        Returns
        -------
        AffineNRSfM
            The same estimator: the signs of z of its shapes and of the third column of
            its cameras are changed, and rotations are ``D R D`` with ``D = diag(1, 1,
            -1)``.

        Examples
        --------
        >>> from isa_nrsfm import AffineNRSfM
        >>> from isa_nrsfm.datasets import make_face_tracks
        >>> faces = make_face_tracks(n_frames=100, random_state=0)
        >>> model = AffineNRSfM(2, camera="weak_perspective").fit(faces.data)
        >>> depth = model.mean_shape_[:, 2].copy()
        >>> bool((model.mirror().mean_shape_[:, 2] == -depth).all())
        True
        """
        check_is_fitted(self)
        depth = np.array([1.0, 1.0, -1.0])
        dtype = self.mean_shape_.dtype
        for name in ("mean_shape_", "basis_", "reference_motion_", "motion_"):
            if hasattr(self, name):
                setattr(self, name, getattr(self, name) * depth.astype(dtype))
        if hasattr(self, "rotations_"):
            turned = depth[:, None] * self.rotations_ * depth
            self.rotations_ = turned.astype(dtype, copy=False)
        signs = np.tile(depth, len(self.basis_))
        self.mode_covariance_ = signs[:, None] * self.mode_covariance_ * signs
        self._frames = self._frames.mirrored()
        return self

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
        table = self._opened(X)
        return self._model.reproject(table)

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
        table = self._opened(X)
        return -self._model.held_out_error(table)

    def diagnostics(self) -> Diagnostics:
        """
        Tell how far the fitted table determines the answer.

        Returns
        -------
        Diagnostics
            Named tuple of camera_singular_values, deformation_amplitude, reliability,
            effective_frames, weak_deviations, camera_noise_ratio and camera_meaning.

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
        self._need_frames("diagnostics")
        fitted = np.isfinite(self._frame_sizes)
        motion = np.asarray(self.motion_)[fitted]
        return diagnose(
            self.mean_shape_.astype(np.float64),
            self.basis_.astype(np.float64),
            motion / self._frame_sizes[fitted, None, None],
            np.asarray(self.alpha_, dtype=np.float64)[fitted],
            self.noise_variance_ / self._unit**2,
            self.reliability_,
            getattr(self, "camera_noise_ratio_", np.nan),
        )

    def __sklearn_tags__(self) -> Any:
        """Return the estimator's tags."""
        tags = super().__sklearn_tags__()
        tags.transformer_tags.preserves_dtype = ["float64", "float32"]
        tags.input_tags.allow_nan = True
        return tags

    def _html_repr(self) -> str:
        """Return what a notebook shows: scikit-learn's picture, and a summary."""
        picture = estimator_html_repr(self)
        return picture + summary_html(self) if hasattr(self, "basis_") else picture

    def _count_components(
        self, ready: Callable[[Table, int], ScaledTable], source: Table
    ) -> int:
        """Return the number of basis shapes that a table supports."""
        if self.refinement != "joint":
            raise ValueError(
                "n_components='auto' needs refinement='joint'; "
                f"got refinement={self.refinement!r}"
            )
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # the fit will say the same
            table = ready(source, 1)
        most = largest_n_components(table.n_points)
        most = min(MOST_COMPONENTS, most, most_for_frames(len(table.sizes)))
        outliers, used = self._completed(table, most)
        _, sample, factors = self._factors(table, used, most)
        _, result = self._paper_result(factors, most, lambda stage: None)
        found = count_components(
            table.rows,
            table.n_seen,
            sample,
            factors,
            _stacked_shapes(result),
            camera=self.camera,
            outliers=outliers,
            loss=self.loss,
            max_iter=self.max_iter,
            tol=JOINT_TOL if self.tol is None else self.tol,
        )
        if found == most:
            warnings.warn(
                f"all {most} basis shapes that were tried are relevant: the table may "
                f"ask for more than n_components={most}",
                stacklevel=4,
            )
        return found

    def _completed(
        self, table: ScaledTable, n_components: int
    ) -> tuple[NDArray | None, FrameBlocks]:
        """Return gross outliers, with a robust loss, and frames without gaps."""
        outliers, used, complete = None, table.rows, table.complete
        if self.loss != "linear":
            outliers = gross_outliers(table.rows.whole().transpose(0, 2, 1))
            used = table.rows.derive(rows_without, outliers)
            complete = complete and not outliers.any()
        if not complete:
            used = complete_rows(used, table.n_points, n_components)
        return outliers, used

    def _factors(
        self, table: ScaledTable, used: FrameBlocks, n_components: int
    ) -> tuple[Triplets, Sample, Factorisation]:
        """Return the singular triplets of a table, and the factors of a sample."""
        shape = 2 * len(table.sizes), table.n_points
        triplets = block_triplets(used, shape, 3 * n_components + 3)
        if self.refinement == "joint":
            sample = sample_frames(used, table.n_points, triplets.vectors[:3])
        else:
            sample = Sample(used.whole().reshape(shape), [])
        factors = factorise(sample.W, n_components, table.precision, triplets)
        return triplets, sample, factors

    def _paper_result(
        self,
        factors: Factorisation,
        n_components: int,
        report: Callable[[str], None],
    ) -> tuple[Any, PaperResult]:
        """Return the fitted strategy and what the paper's pipeline finds with it."""
        joint, isa = self.refinement == "joint", self._strategy()
        with warnings.catch_warnings():
            if joint and self.isa is None:
                # It makes no difference to the joint refinement, which starts there.
                warnings.filterwarnings("ignore", "FastICA did not", ConvergenceWarning)
            result = run_paper_pipeline(
                factors,
                n_components,
                isa,
                block_recovery=self.block_recovery,
                refinement="alternating" if joint else self.refinement,
                max_iter=START_STEPS if joint else self.max_iter,
                tol=START_TOL if joint else PAPER_TOL if self.tol is None else self.tol,
                report=report,
            )
        return isa, result

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

    def _keep(
        self,
        table: ScaledTable,
        W: NDArray,
        factors: Factorisation,
        result: PaperResult,
    ) -> FrameFit:
        """Set the shapes of the paper's pipeline and return the fit of the frames."""
        dtype, sizes = table.dtype, table.sizes[:, None, None]
        completed = W.reshape(len(sizes), 2, -1).transpose(0, 2, 1) * sizes
        mean_shape, basis = result.mean_shape, result.basis
        if self.camera != "affine":
            mean_shape, basis = self._upgraded(table, factors, result)
        paper = RigidFrames(mean_shape, basis, self.camera)
        rigid = paper.fit(completed, table.sizes)
        motion = rigid.motion / sizes
        space = self._space(mean_shape, motion)
        gauge = canonical_gauge(mean_shape, basis, motion, rigid.alpha, space)
        self.mean_shape_ = gauge.mean_shape.astype(dtype)
        self.basis_ = gauge.basis.astype(dtype)
        covariance = reorder_blocks(result.mode_covariance, gauge.order)
        self.mode_covariance_ = self._unit**2 * covariance
        self._converged(result.converged, result.n_iter)
        # The coefficients are those that transform gives, from the stored shapes.
        self._frames = RigidFrames(self.mean_shape_, self.basis_, self.camera)
        return self._model.decompose(table.source)

    def _upgraded(
        self, table: ScaledTable, factors: Factorisation, result: PaperResult
    ) -> tuple[NDArray, NDArray]:
        """Return the paper's shapes in the metric of the rigid cameras."""
        scaled = self.camera == "weak_perspective"
        _, shapes = rigid_start(factors, _stacked_shapes(result), scaled)
        shapes = table.sizes[0] * shapes.transpose(0, 2, 1)
        return shapes[0], shapes[1:]

    def _space(self, mean_shape: NDArray, motion: NDArray) -> NDArray:
        """Return the affinity of space, or with calibrated cameras the rotation."""
        if self.camera == "affine":
            return canonical_space(mean_shape, motion)
        unit = 1.0 if self.camera == "orthographic" else None
        return euclidean_space(mean_shape, motion, unit)

    def _refine_jointly(
        self,
        table: ScaledTable,
        outliers: NDArray | None,
        sample: Sample,
        factors: Factorisation,
        result: PaperResult,
        spectrum: Spectrum,
        progress: FitProgress,
    ) -> FrameFit:
        """Set the shapes of the joint refinement and return the fit of the frames."""
        fitted = fit_jointly(
            table.rows,
            table.n_seen,
            sample,
            factors,
            _stacked_shapes(result),
            spectrum=spectrum,
            camera=self.camera,
            outliers=outliers,
            loss=self.loss,
            max_iter=self.max_iter,
            tol=JOINT_TOL if self.tol is None else self.tol,
            on_step=progress.step,
        )
        progress(JOINT_STAGE)
        frames = PosteriorFrames(
            fitted.shapes,
            fitted.noise_variance,
            spread_starts(fitted.alpha, N_STARTS),
            self.loss,
            FrameMap.identity(len(result.basis)),
            self.camera,
        )
        posteriors = posterior_blocks(frames, fitted.frames, table.rows)
        motion, alpha, covariance = posterior_moments(posteriors)
        self.reliability_ = reliabilities(alpha, covariance)
        gauge = independent_gauge(
            fitted.shapes,
            motion,
            alpha,
            self.independence,
            self.camera,
            float(table.sizes[0]) if self.camera == "orthographic" else None,
        )
        frames = frames._replace(gauge=gauge.frames)
        self.mean_shape_ = gauge.mean_shape.astype(table.dtype)
        self.basis_ = gauge.basis.astype(table.dtype)
        self._frames = frames
        self.noise_variance_ = self._unit**2 * fitted.noise_variance
        self.camera_noise_ratio_ = fitted.camera_noise_ratio
        self.objective_history_ = fitted.history
        self.gradient_norm_ = fitted.gradient_norm
        self._converged(fitted.converged, len(fitted.history) - 1)
        shown = FrameFit.of_blocks(posteriors.map(frames.shown, table.sizes))
        cameras = shown.motion / table.sizes[:, None, None]
        covariance = mode_covariance(cameras, shown.alpha)
        self.mode_covariance_ = self._unit**2 * covariance
        return shown._replace(translation=shown.translation + table.translation)

    @property
    def _model(self) -> TableModel:
        """The model of tables that was fitted."""
        return TableModel(
            self._frames,
            self.mean_shape_,
            self.basis_,
            self.layout,
            getattr(self, "feature_names_in_", None),
            None if self._scales_frames else self._unit,
        )

    @property
    def _scales_frames(self) -> bool:
        """Whether each frame gets size one."""
        return self.scale_frames and self.camera != "orthographic"

    def _describe(self, table: ScaledTable, frames: FrameFit) -> None:
        """Set what is said of the fit of all frames."""
        sizes, dtype = table.sizes, table.dtype
        cameras = frames.motion / sizes[:, None, None]
        position = (frames.translation - table.translation) / sizes[:, None]
        shapes = np.concatenate([self.mean_shape_[None], self.basis_])
        self.inverse_snr_ = reprojection_error(
            table.rows, shapes.transpose(0, 2, 1), cameras, position, frames.alpha
        )
        energy = image_energies(cameras, self.basis_, frames.alpha)
        self.energy_share_ = energy / (energy.sum() or 1.0)
        reference = reference_camera(cameras, sizes)
        if self.camera != "affine":
            row, scale = nearest_calibrated(reference[None])
            reference = (scale[:, None, None] * row)[0]
        self.reference_motion_ = reference.astype(dtype)
        self.reference_translation_ = frames.translation.mean(axis=0).astype(dtype)

    def _keep_frames(self, source: Table, table: ScaledTable, frames: FrameFit) -> None:
        """Set what was found for each frame, in memory or in files, if it is wanted."""
        kept = FrameFit(*map(table.of_all_rows, frames.astype(table.dtype)))
        if isinstance(self.keep_frames, str | os.PathLike):
            kept = kept.in_files(self.keep_frames)
        if self.keep_frames:
            self._frame_sizes = table.of_all_rows(table.sizes)
            kept = FrameFit(*map(source.blocks.spread, kept))
            self.motion_, self.translation_, self.alpha_, deviation = kept
            if self.camera != "affine":
                self.rotations_, self.scales_ = full_rotations(self.motion_)
            if self.refinement == "joint":
                self.alpha_std_ = deviation

    def _need_frames(self, what: str) -> None:
        """Refuse what depends on the frames of the fit where they were not kept."""
        if not hasattr(self, "motion_"):
            raise ValueError(
                f"{what} needs the cameras and coefficients of the fitted table; fit "
                f"with keep_frames=True, got keep_frames={self.keep_frames!r}"
            )

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

    def _opened(self, X: Any, reset: bool = False) -> Table:
        """Return a table, for the fit or for the fitted model, in blocks."""
        if not reset:
            check_is_fitted(self)
        if is_stored(X) or is_on_dask(X):
            validate_data(self, column_sample(X), reset=reset, skip_check_array=True)
            if is_on_dask(X):
                return Table.on_dask(X)
            return Table.stored(X, self.working_memory)
        least = {"ensure_min_samples": 2, "ensure_min_features": 2} if reset else {}
        X = validate_data(self, X, reset=reset, **CHECKS, **least)
        return Table.in_memory(X, self.n_jobs if reset else 1, whole=not reset)


def _stacked_shapes(result: PaperResult) -> NDArray:
    """Return mean shape and basis shapes (n_components + 1, 3, n_points)."""
    shapes = np.concatenate([result.mean_shape[None], result.basis])
    return shapes.transpose(0, 2, 1)


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


def check_class(estimator: object, where: str) -> None:
    """Raise if an object is not the estimator of this package."""
    if not isinstance(estimator, AffineNRSfM):
        raise ValueError(
            f"{where} should be an AffineNRSfM; got {type(estimator).__name__}"
        )
