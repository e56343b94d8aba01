"""AffineNRSfM: the scikit-learn transformer on top of the stages."""

import copy
from numbers import Integral, Real
from typing import Any, ClassVar, NamedTuple, Self

import numpy as np
from numpy.typing import NDArray
from sklearn.base import (
    clone,
)
from sklearn.utils import check_random_state

from isa_nrsfm._compat.callbacks import CallbackSupportMixin, FitProgress
from isa_nrsfm._compat.caller import warn_caller
from isa_nrsfm._compat.scikit_learn import HasMethods, Interval, StrOptions, fit_context
from isa_nrsfm._fit import JOINT_STAGE, STAGES, Fit, fit_table
from isa_nrsfm._fit_options import FitOptions, Limits
from isa_nrsfm._fitted_model import TableModel
from isa_nrsfm._frames.camera_models import (
    full_rotations,
)
from isa_nrsfm._frames.models import Decomposition
from isa_nrsfm._parameters.choices import (
    BLOCK_RECOVERIES,
    CAMERA_NAMES,
    INDEPENDENCE,
    LOSSES,
    REFINEMENTS,
)
from isa_nrsfm._prepare.checks import check_names
from isa_nrsfm._tables.kept_arrays import Keep, kept_arrays
from isa_nrsfm._tables.layout import LAYOUTS, Layout
from isa_nrsfm._tables.sources import (
    StoredTable,
    Table,
    is_on_dask,
)
from isa_nrsfm._transformer import TableTransformer
from isa_nrsfm.isa import PooledFastICA

# Runs of FastICA where the result of the paper's pipeline is only a start.
START_RUNS = 2


class AffineNRSfM(CallbackSupportMixin, TableTransformer):
    """
    Affine non-rigid structure from motion by independent subspace analysis.

    Factorises a table of 2D landmarks, one frame a row, into a mean 3D shape, basis
    shapes, and for each frame a camera and coefficients, which are free of the
    viewpoint where points are fixed on the surface. No calibration, training data or
    order of the frames is needed. Row i, reshaped to (n_points, 2), is modelled as::

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
        deformation. Shapes of frames, reprojection and score do not depend on it. Only
        for the joint refinement, without which "coefficients" is refused.
    loss : {"linear", "huber", "cauchy"}, default="linear"
        How points count that are far from the model: less than by their square with
        "huber" from 1.5, with "cauchy" from 2.5 standard deviations of the noise; not
        at all beyond six sizes of their frame. Only for the joint refinement.
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
        Whether `alpha_`, `alpha_std_`, `motion_` and `translation_` are kept. With the
        path of a folder they are memory maps of files of these names, ``alpha.npy`` and
        so on, in a new folder within that one, which each fit makes for itself;
        ``alpha_.filename`` says where. A fit that fails leaves none. Fits never remove
        the files of earlier ones, which other models may use.
    working_memory : float or None, default=None
        Megabytes that a block of a table takes that is not in memory (a memory map or a
        table of `isa_nrsfm.io.open_table`); None is scikit-learn's setting
        `working_memory`. The result does not depend on it. A few numbers for each frame
        are in memory besides, about 1 kB.
    n_jobs : int or None, default=None
        Number of threads that work on the frames, in `fit` and in the methods for
        tables, and of joblib workers for strategies that use them. The result does not
        depend on it.
    verbose : int, default=0
        Above zero, print a line for each stage, above one also the current step. With
        scikit-learn 1.9 and later the fit tells its callbacks of stages and steps, too:
        ``set_callbacks(ProgressBar())``.

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
    depth_uncertainty_ : float
        Root mean square error of the depths of the frames that is to be expected,
        relative to their root mean square. Set with calibrated cameras and the joint
        refinement.
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
        Shares of the variance of the coefficients that are not uncertainty, of their
        own or of the shapes, along uncorrelated directions, decreasing; zero for noise.
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
    camera_ : str
        The camera model of the fit.
    frames_scaled_ : bool
        Whether each frame was divided by a size of its own; never with orthographic
        cameras.
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
    depth_uncertainty_: float
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
    camera_: str
    frames_scaled_: bool
    _model: TableModel
    n_features_in_: int
    feature_names_in_: NDArray

    _limits: ClassVar[Limits] = Limits()  # others: `limited`
    _parameter_constraints: ClassVar[dict[str, list[Any]]] = {
        "n_components": [
            Interval(Integral, 1, None, closed="left"),
            StrOptions({"auto"}),
        ],
        "isa": [None, HasMethods(["fit", "get_params", "set_params"])],
        "block_recovery": [StrOptions(set(BLOCK_RECOVERIES))],
        "refinement": [StrOptions(set(REFINEMENTS)), None],
        "camera": [StrOptions(set(CAMERA_NAMES))],
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
            few frames, or column names that contradict `layout`; if `loss` is not
            linear, or X a `StoredTable` or a dask array, without the joint refinement;
            or if `keep_frames` is an empty text.
        OSError
            If the folder of `keep_frames` cannot be made or written to, before the fit;
            if the disk is full, after it.

        Warns
        -----
        UserWarning
            If calibrated cameras do not determine the depth, if rows show no point and
            are left out, if points lack one coordinate, if
            the other layout explains the table much better, or if a refinement has not
            converged.
        """
        try:
            self._forget()
            with kept_arrays(self.keep_frames) as keep:
                self._fit(X, y, keep)
        except BaseException:
            self._forget()
            raise
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

    def _fit(self, X: Any, y: Any, keep: Keep) -> None:
        """Check a table and its options, fit it, and set what was found."""
        joint = self.refinement == "joint"
        stages = [stage for stage in STAGES if joint or stage != JOINT_STAGE]
        progress = FitProgress(self, stages, stepwise=JOINT_STAGE, X=X, y=y)
        fitted = copy.copy(self)
        source, options = fitted._checked(X)
        fit = fit_table(source, self.n_components, options, progress)
        fitted._set(fit, source, keep)
        certainty = fit.model.frames.certainty
        if not certainty.determined:
            warn_caller(certainty.advice)
        self.__dict__.update(vars(fitted))  # all at once
        progress.end()

    def _checked(self, X: Any) -> tuple[Table, FitOptions]:
        """Check a table and the options of its fit, and return both."""
        self._check_options(X)
        if isinstance(X, np.memmap) and self.refinement != "joint":
            X = np.asarray(X)
        source = self._opened(X, reset=True)
        names = getattr(self, "feature_names_in_", None)
        check_names(names, self.layout)
        options = FitOptions(
            self._strategy(),
            self.isa is None,
            self.block_recovery,
            self.refinement,
            self.camera,
            self.independence,
            self.loss,
            self.layout,
            self.scale_frames and self.camera != "orthographic",
            self.max_iter,
            self.tol,
            names,
            self._limits,
        )
        return source, options

    def _check_options(self, X: Any) -> None:
        """Refuse options that do not go together, or not with a table."""
        only_joint = {
            "n_components": self.n_components == "auto",
            "loss": self.loss != "linear",
            "independence": self.independence == "coefficients",
        }
        for name, asked_for in only_joint.items():
            if asked_for and self.refinement != "joint":
                raise ValueError(
                    f"{name}={getattr(self, name)!r} needs refinement='joint'; "
                    f"got refinement={self.refinement!r}"
                )
        stored = is_on_dask(X) or isinstance(X, StoredTable)
        if stored and self.refinement != "joint":
            raise ValueError(
                "tables that are not in memory need refinement='joint'; "
                f"got refinement={self.refinement!r}"
            )

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

    def _forget(self) -> None:
        """Remove what an earlier fit has found, all of it at once."""
        found = ("_model", "_unit", "_frame_sizes", "_n_features_out")
        left = [name for name in vars(self) if not name.endswith("_")]
        self.__dict__ = {name: vars(self)[name] for name in left if name not in found}

    def __sklearn_is_fitted__(self) -> bool:
        """Return whether a fit has ended."""
        return hasattr(self, "_model")

    def _set(self, fit: Fit, source: Table, keep: Keep) -> None:
        """Set all that a fit has found."""
        found: dict[str, Any] = {
            "mean_shape": fit.model.mean_shape,
            "basis": fit.model.basis,
            "isa": fit.isa,
            "inverse_snr": fit.inverse_snr,
            "rank_floor": fit.rank_floor,
            "singular_values": fit.singular_values,
            "mode_covariance": fit.mode_covariance,
            "energy_share": fit.energy_share,
            "n_iter": fit.n_iter,
            "camera": fit.model.frames.camera,
            "frames_scaled": fit.model.unit is None,
            "reference_motion": fit.reference_motion,
            "reference_translation": fit.reference_translation,
        }
        if fit.numbers is not None:
            found |= fit.numbers._asdict()
            if self.camera == "affine":
                del found["depth_uncertainty"]
        if self.keep_frames:
            kept = Decomposition(**keep(fit.frames._asdict()))
            kept = Decomposition(*map(source.blocks.as_collected, kept))
            found |= kept._asdict()
            if fit.numbers is None:
                del found["alpha_std"]
            if self.camera != "affine":
                found["rotations"], found["scales"] = full_rotations(kept.motion)
            self._frame_sizes = fit.frame_sizes
        for name, value in found.items():
            setattr(self, f"{name}_", value)
        self._unit, self._n_features_out = fit.unit, len(fit.model.basis)
        self._model = fit.model


def limited(limits: Limits) -> type[AffineNRSfM]:
    """
    Return the estimator with other limits.

    Tests and benchmarks show with it what the limits do.

    Parameters
    ----------
    limits : Limits
        What steers the stages of its fits.

    Returns
    -------
    type
        A subclass of `AffineNRSfM`.
    """
    return type("LimitedNRSfM", (AffineNRSfM,), {"_limits": limits})


def check_class(estimator: object, where: str) -> None:
    """Raise if an object is not the estimator of this package."""
    if not isinstance(estimator, AffineNRSfM):
        raise ValueError(
            f"{where} should be an AffineNRSfM; got {type(estimator).__name__}"
        )


class CheckedTable(NamedTuple):
    """
    A table that was checked for the fits of an estimator.

    Attributes
    ----------
    source : Table
        The table.
    options : FitOptions
        How it is fitted.
    estimator : AffineNRSfM
        The estimator, unfitted, that knows the columns of the table.
    """

    source: Table
    options: FitOptions
    estimator: AffineNRSfM

    @classmethod
    def of(cls, estimator: AffineNRSfM, X: Any) -> Self:
        """Return a table X that was checked for a clone of an estimator."""
        estimator = clone(estimator)
        source, options = estimator._checked(X)
        return cls(source, options, estimator)

    def fitted(self, fit: Fit, source: Table) -> AffineNRSfM:
        """Return the estimator with a fit of a part of the table, given as source."""
        model = copy.copy(self.estimator)
        model.set_params(n_components=len(fit.model.basis))
        with kept_arrays(model.keep_frames) as keep:
            model._set(fit, source, keep)
        return model
