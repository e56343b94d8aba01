"""AffineNRSfM: the scikit-learn transformer on top of the stages."""

import copy
import os
from numbers import Integral, Real
from typing import Any, ClassVar, Self

import numpy as np
from numpy.typing import NDArray
from sklearn.base import clone
from sklearn.utils import check_random_state

from isa_nrsfm._compat.callbacks import CallbackSupportMixin, FitProgress
from isa_nrsfm._compat.caller import warn_caller
from isa_nrsfm._compat.scikit_learn import HasMethods, Interval, StrOptions, fit_context
from isa_nrsfm._fit import STEPWISE, Limits, fit_table, stages_of
from isa_nrsfm._frames.camera_models import full_rotations
from isa_nrsfm._parameters.choices import (
    BLOCK_RECOVERIES,
    CAMERA_NAMES,
    INDEPENDENCE,
    LOSSES,
    REFINEMENTS,
)
from isa_nrsfm._tables.blocks import FrameBlocks
from isa_nrsfm._tables.kept_arrays import kept_arrays
from isa_nrsfm._tables.sources import StoredTable, is_on_dask
from isa_nrsfm._tables.tracks import LAYOUTS, Layout
from isa_nrsfm._transformer import TableTransformer
from isa_nrsfm.isa import PooledFastICA


class AffineNRSfM(CallbackSupportMixin, TableTransformer):
    """
    Affine non-rigid structure from motion by independent subspace analysis.

    Factorises a table of 2D landmarks, with one row per frame. The result is a mean 3D
    shape, basis shapes, and a camera and coefficients for each frame. The coefficients
    do not depend on the viewpoint if the points are fixed on the surface. No
    calibration, training data or order of the frames is needed. Row i, reshaped to
    (n_points, 2), is modelled as::

        (mean_shape_ + tensordot(alpha_[i], basis_, 1)) @ motion_[i].T + translation_[i]

    Parameters
    ----------
    n_components : int or "auto", default=3
        K, the number of basis shapes. K needs at least 3K + 4 points and
        ``ceil(8 (K + 2) / 5)`` frames. Calibrated cameras allow up to 2J - 7 basis
        shapes of J points, if there are enough frames (joint refinement only): for 17
        points 27 instead of 4. "auto" takes the relevant ones of twelve, or of
        as many as the table allows (joint refinement only); ``len(basis_)`` is the
        number found. With ``refinement="consensus"`` the joint fit has at most twelve,
        and the result has K principal components of the merged shapes; "auto" keeps up
        to 60, all that exceed the noise.
    isa : object, default=None
        Strategy of independent subspace analysis, such as `FastISA` or `PooledFastICA`,
        with subspaces of size three. None is ``PooledFastICA()``, with two runs if its
        result is only the start of the joint refinement. A clone is fitted. Its
        `random_state`, `n_jobs` and `verbose` are inherited from this estimator unless
        set.
    block_recovery : {"generalized_eigen", "eigen", "irls"}, default=\
"generalized_eigen"
        Method for the 3x3 matrix of each subspace that brings its motion to the rigid
        motion. "eigen" is the exact minimiser under a norm constraint, "irls" the
        published iteration for the same cost. "generalized_eigen" maximises the
        explained share of the motion. "eigen" and "irls" can collapse onto a direction
        in which the subspace hardly moves, and "irls" depends on the first frame. The
        default has neither problem. With a refinement all three lead to nearly the same
        result, because it starts from more places.
    refinement : {"joint", "consensus", "alternating", None}, default="joint"
        "joint" finds the cameras, shapes and noise variance of greatest marginal
        likelihood, with normally distributed coefficients. It starts from the paper's
        result and recovers the true shapes as far as the images determine them.
        "consensus" continues from there, with calibrated cameras: it fits overlapping
        groups of neighbouring points, with rotations of their own, and finds the
        depths that they have in common. Bodies become more accurate by a third to two
        thirds, and a fit takes 5 to 30 times as long. Set ``n_components="auto"`` or
        about 60 with it.
        "alternating" is the paper's alternating least squares for basis shapes and
        coefficients, with fixed rigid cameras.
    camera : {"affine", "weak_perspective", "orthographic"}, default="affine"
        Camera model. "affine" assumes nothing: shapes are known up to an affinity of
        space, and cameras absorb part of large deformations, such as those of bodies.
        "weak_perspective" cameras are rotations with a scale for each frame, a good
        model of photos of objects that are far away for their size. "orthographic" ones
        have the same scale in all frames. With these two, shapes, lengths and angles
        are true, up to one mirror image (`mirrored`).
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
    layout : {"interleaved", "planar"}, default="interleaved"
        Whether the columns are x0, y0, x1, y1, ... or x0, x1, ..., y0, y1, ...
    scale_frames : bool, default=True
        Whether each centred frame is divided by the RMS of its coordinates before the
        fit, so that photos of any resolution have the same weight. `motion_` is in the
        units of the table in any case. If False, frames are weighted by their size.
        With orthographic cameras, which have one scale, frames are not scaled.
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
    keep_frames : bool, default=True
        Whether `alpha_`, `alpha_std_`, `motion_` and `translation_` are kept.
    frames_folder : str, path-like or None, default=None
        Folder for the kept arrays. Each fit makes a new folder within it, with files
        ``alpha.npy`` and so on. The attributes are memory maps of these files;
        ``alpha_.filename`` is the path. A fit that fails leaves no files. Fits never
        remove the files of earlier fits, because other models may use them. None keeps
        the arrays in memory.
    working_memory : float or None, default=None
        Largest memory of a block, in megabytes, of a table that is not in memory (a
        memory map or a table of `isa_nrsfm.io.open_table`). None is scikit-learn's
        setting `working_memory`. Each thread has a block of a memory map, of at most
        128 megabytes. The result does not depend on it. In addition, about 1 kB per
        frame is always in memory.
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
    mean_shape_ : ndarray of shape (n_points, 3)
        Mean shape B_0, centred and white: the mean of ``b b^T`` over the points is the
        identity (of rank two for flat objects). With weak-perspective cameras only the
        mean square of its coordinates is one. With orthographic ones it is in the units
        of the table. x and y are the axes of the mean camera (so y points down for
        image coordinates), z is depth. The mirror image in depth fits equally well.
    basis_ : ndarray of shape (n_components, n_points, 3)
        Basis shapes B_k, centred, sorted by decreasing energy in the images, each for
        one standard deviation of `alpha_`. Basis shapes without motion in the table are
        zero.
    alpha_ : ndarray of shape (n_frames, n_components)
        Coefficients of the frames, scaled to unit variance; signs chosen so that the
        skewness is non-negative. Their mean is zero after the joint refinement.
    alpha_std_ : ndarray of shape (n_frames, n_components)
        Posterior standard deviations of `alpha_` for known shapes and noise (joint
        refinement only).
    motion_ : ndarray of shape (n_frames, 2, 3)
        Affine cameras, in the units of the table.
    translation_ : ndarray of shape (n_frames, 2)
        Images of the origin of the shapes, in the units of the table: the centroids of
        complete frames.
    depth_uncertainty_ : float
        Expected RMS error of the depths of the frames, relative to their RMS
        (calibrated cameras with the joint refinement only). After a consensus it is
        that of the joint fit, an upper bound.
    rotations_ : ndarray of shape (n_frames, 3, 3)
        Rotations of calibrated cameras, with determinant one. The rows are the axes of
        the image, x, y and z. Like `scales_`, only with such cameras.
    scales_ : ndarray of shape (n_frames,)
        Scales of calibrated cameras, in units of the table per unit of the shapes; one
        for orthographic cameras. The image of frame i is ``scales_[i] * S_i @
        rotations_[i, :2].T + translation_[i]`` with ``S_i = reconstruct(X)[i]``.
    inverse_snr_ : float
        ``||W - What||_F^2 / ||W||_F^2``, a fraction, with W the centred tracks of the
        visible points, scaled as in the fit.
    rank_floor_ : float
        Lowest inverse SNR of any model of rank 3K + 3, with missing points filled in;
        zero where K exceeds the bound of affine cameras. K is that of the joint fit.
    noise_variance_ : float
        Noise variance of a coordinate. If frames are scaled, it is that of frames of
        size one (joint refinement only, as are the next four).
    camera_noise_ratio_ : float
        Noise variance of the fit with calibrated cameras, divided by that of the fit
        with affine ones, from the frames of the first steps; see `diagnostics`.
    reliability_ : ndarray of shape (n_components,)
        Shares of the variance of the coefficients that are signal, not uncertainty of
        coefficients or shapes, along uncorrelated directions, decreasing. Zero for
        noise.
    objective_history_ : ndarray of shape (`n_iter_` + 1,)
        Minus twice the log posterior, up to a constant, before the last refinement and
        after each of its steps; it never rises.
    gradient_norm_ : float
        Norm of the gradient of this objective at the end, in the metric of its
        curvature, divided by the root of the number of coordinates.
    energy_share_ : ndarray of shape (n_components,)
        Share of each basis shape in the energy of the deformations in the images,
        ``sum_i ||alpha_ik M_i B_k||_F^2``, frames scaled as in the fit.
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
        The fitted strategy, of the paper's pipeline.
    camera_ : str
        The camera model of the fit.
    frames_scaled_ : bool
        Whether each frame was divided by its own size; never with orthographic cameras.
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
    Affine cameras determine the shapes up to one affinity of space and one scale a
    frame. The affinity is fixed as described for `mean_shape_`; angles and proportions
    in depth are not those of the object.

    `fit` and the methods for new tables accept tables that are not in memory. For a
    dask array, `alpha_`, `alpha_std_`, `motion_` and `translation_` are dask arrays,
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
    >>> faces = make_face_tracks(n_frames=200, random_state=0)
    >>> model = AffineNRSfM(n_components=4, random_state=0).fit(faces.data)
    >>> model.mean_shape_.shape, model.basis_.shape, model.alpha_.shape
    ((68, 3), (4, 68, 3), (200, 4))
    >>> model.transform(faces.data[:5]).shape
    (5, 4)
    """

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
        "keep_frames": ["boolean"],
        "frames_folder": [None, str, HasMethods("__fspath__")],
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
        keep_frames: bool = True,
        frames_folder: str | os.PathLike[str] | None = None,
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
        self.frames_folder = frames_folder
        self.working_memory = working_memory
        self.n_jobs = n_jobs
        self.verbose = verbose

    @fit_context(nested=True)
    def fit(self, X: Any, y: Any = None, *, point_weight: Any = None) -> Self:
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
            in too few frames; if parameters or tables need the joint refinement; or if
            `frames_folder` is an empty text. If weights are negative or not finite,
            have another shape, or are not supported by parameters or table.
        OSError
            If `frames_folder` cannot be made or written to, before the fit; if the disk
            is full, after it.

        Warns
        -----
        UserWarning
            If calibrated cameras do not determine the depth, if rows without points are
            left out, if points lack one coordinate, if the other layout explains the
            table much better, or if a refinement has not converged.
        """
        self._forget()
        stages = stages_of(self.refinement)
        with kept_arrays(self.frames_folder) as keep:
            progress = FitProgress(self, stages, stepwise=STEPWISE, X=X, y=y)
            fitted = copy.copy(self)
            source, weights = fitted._checked(X, point_weight)
            frames = fit_table(fitted, source, progress, *weights)
            if self.keep_frames:
                kept = keep(frames._asdict())
                fitted._set_frames(*map(source.as_collected, kept.values()))
            certainty = fitted._model.frames.certainty
            if not certainty.determined:
                warn_caller(certainty.advice)
        self.__dict__.update(vars(fitted))  # all at once
        progress.end()
        return self

    def fit_transform(
        self, X: Any, y: Any = None, *, point_weight: Any = None
    ) -> NDArray:
        """
        Factorise a table and return the coefficients of its frames.

        Parameters
        ----------
        X : array-like of shape (n_frames, 2 * n_points)
            The table, one frame a row, in the order of `layout`.
        y : None
            Ignored.
        point_weight : array-like of shape (n_frames, n_points), default=None
            Weights of the points, as in `fit`.

        Returns
        -------
        ndarray of shape (n_frames, n_components)
            `alpha_`.
        """
        self.fit(X, point_weight=point_weight)
        if self.keep_frames:
            return self.alpha_.copy()
        return self.transform(X, point_weight=point_weight)

    def _checked(
        self, X: Any, point_weight: Any = None
    ) -> tuple[FrameBlocks, tuple[NDArray, ...]]:
        """Check parameters and a table, and set the attributes that a fit needs.

        Returns the table in blocks, and the weights of its points, if any.
        """
        only_joint = {
            "n_components": self.n_components == "auto",
            "loss": self.loss != "linear",
            "independence": self.independence == "coefficients",
        }
        if not self._is_joint:
            got = f"needs refinement='joint'; got refinement={self.refinement!r}"
            for name, asked_for in only_joint.items():
                if asked_for:
                    raise ValueError(f"{name}={getattr(self, name)!r} {got}")
            if is_on_dask(X) or isinstance(X, StoredTable):
                raise ValueError(f"a table that is not in memory {got}")
            if isinstance(X, np.memmap):
                X = np.asarray(X)
        if self.refinement == "consensus" and self.camera == "affine":
            raise ValueError(
                "refinement='consensus' needs calibrated cameras, because depths of "
                "groups of points with affine cameras have no common unit. Set "
                "camera='weak_perspective' or camera='orthographic'"
            )
        if self.refinement == "consensus" and point_weight is not None:
            raise ValueError(
                "point_weight is not supported by the fit with refinement='consensus', "
                "whose groups of points are fitted without weights. Set "
                "refinement='joint', or give no point_weight"
            )
        source, weights = self._weighted(X, point_weight, reset=True)
        self.isa_ = self._strategy()
        self.frames_scaled_ = self.scale_frames and self.camera != "orthographic"
        return source, weights

    def _strategy(self) -> Any:
        """Return the unfitted strategy, with parameters inherited where not set."""
        if self.isa is not None:
            isa = clone(self.isa)
        else:
            isa = PooledFastICA(n_init=2 if self._is_joint else 16)
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
        """Remove all results of an earlier fit at once."""
        found = ("_model", "_frame_sizes", "_n_features_out")
        left = [name for name in vars(self) if not name.endswith("_")]
        self.__dict__ = {name: vars(self)[name] for name in left if name not in found}

    def _set_frames(self, *frames: NDArray) -> None:
        """Set the attributes of the frames, in the order of `Decomposition`."""
        self.motion_, self.translation_, self.alpha_, alpha_std = frames
        if self._is_joint:
            self.alpha_std_ = alpha_std
        if self.camera != "affine":
            self.rotations_, self.scales_ = full_rotations(self.motion_)


def limited(limits: Limits) -> type[AffineNRSfM]:
    """Return a subclass of `AffineNRSfM` with other limits, for tests."""
    return type("LimitedNRSfM", (AffineNRSfM,), {"_limits": limits})


def check_class(estimator: object, where: str) -> None:
    """Raise if an object is not the estimator of this package."""
    if not isinstance(estimator, AffineNRSfM):
        raise ValueError(
            f"{where} should be an AffineNRSfM; got {type(estimator).__name__}"
        )
