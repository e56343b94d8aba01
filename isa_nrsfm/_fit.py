"""The stages of a fit, in order: from a table to all that an estimator shows.

    FrameBlocks -> ScaledTable -> FactorisedTable -> PaperResult -> JointFit
    checks, size   outliers,       SVD, ISA,          maximum      gauge, measures
                   completion      blocks             likelihood   -> TableModel

1. The table is checked, scaled and, where points are missing, completed.
2. Factorisation of the measurement matrix, of the frames of a sample if there are many.
3. and 4. The paper's pipeline: independent subspaces, then block structure and
   refinement. With the joint refinement its result is only a start.
5. The joint refinement, and the consensus of groups of points with
   `refinement="consensus"`; or the frames of the paper.
6. Measures of the fit.

Stages 1, 5 and 6 use all frames, the other stages those of the sample. No function here
has an estimator: `AffineNRSfM.fit` sets the attributes that `fit_table` returns.

The fit of perspective images repeats fits of weak-perspective ones, with the equations
of `_frames.camera_models`. Each repeat corrects the images for the depths of the fit
before, and starts from its shapes, until depths and fit agree. Weak-perspective images
determine depths up to their sign, so both mirror images are continued.

Let E be the mean squared distance of points from their images, in sizes of frames. As a
function of g = 1/f it is least for the focal length f. g = 0 is the weak-perspective
fit, and -g the mirror image of the fit for g. For an unknown f, steps up and down lead
to the best fit: f is the minimum of the parabola through the best three. Without one of
several groups of points it moves, which gives its deviation (jackknife).
"""

import warnings
from dataclasses import replace
from functools import partial
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.special import expit, logit, stdtr
from sklearn.base import clone

from isa_nrsfm._compat.caller import warn_caller
from isa_nrsfm._compat.scikit_learn import NoProgress, Progress, one_blas_thread
from isa_nrsfm._fitted_model import TableModel, prior_start
from isa_nrsfm._frames import camera_models, gauge
from isa_nrsfm._frames.camera_models import Pinhole, pinhole_of
from isa_nrsfm._frames.models import Decomposition, FrameMap, FrameModel, spread_starts
from isa_nrsfm._joint import fit as joint_fit, uncertainty
from isa_nrsfm._joint.bagging import bagged
from isa_nrsfm._joint.consensus import MOST_FIRST, consensus
from isa_nrsfm._joint.likelihood import JointFrames
from isa_nrsfm._joint.problem import FactorisedTable, JointState, Widths
from isa_nrsfm._joint.settings import JOINT_TOL, FitSettings
from isa_nrsfm._joint.starts import calibrated_start, extended_shapes, lifted_shapes
from isa_nrsfm._parameters import JOINT_REFINEMENTS
from isa_nrsfm._prepare import scaling
from isa_nrsfm._prepare.completion import complete_rows
from isa_nrsfm._prepare.robust import TUNING, gross_outliers
from isa_nrsfm._prepare.scaling import ScaledTable
from isa_nrsfm._tables import FrameBlocks, of_all_rows, spread
from isa_nrsfm.isa import _pipeline as pipeline

JOINT_STAGE = "joint refinement"
CONSENSUS_STAGE = "consensus of groups of points"
PERSPECTIVE_STAGE = "perspective"
# Stages that report steps.
STEPWISE = JOINT_STAGE, CONSENSUS_STAGE, PERSPECTIVE_STAGE

# Effects of these constants: docs/benchmarks/README.md, "Thresholds".
# Depths and fit agree if a repeat changes depths by less than SETTLED, with the default
# tolerance. If MOST_REPEATS end with larger changes than UNSETTLED, they never will.
SETTLED, UNSETTLED, MOST_REPEATS = 2e-3, 0.05, 8
# The same for the last fits, which have all directions, and number of these at most:
# docs/benchmarks/README.md, "Thresholds".
LAST_CHANGE, MOST_LAST = 0.01, 4
# Factor of the tolerance of all fits but the last one, and of SETTLED for focal lengths
# that are only compared.
ROUGH, COMPARED = 4.0, 5.0
# A mirror image is given up if E is larger than this multiple of the other one's.
WORSE = 1.3
# Focal lengths of the weak-perspective fit and of the first perspective one, in largest
# distances from the principal point, and how much longer the next one is if that fails.
ENDLESS, FIRST, LONGER = 1e7, 2.0, 8.0
# Factors of the steps of the search for the minimum, from the best fit up and down; its
# error, as a share of 1/f; and the largest number of fits.
STEPS, NEAR, MOST_FITS = (1.5, 1.1), 0.01, 16

# Why perspective is not taken.
UNSTEADY = (
    "the fit of perspective has not settled: depths and fit do not agree. The focal "
    "length may be wrong, or the objects may turn too little"
)
NOT_BETTER = (
    "perspective predicts held-out points no better than weak perspective. The focal "
    "length or the principal point may be wrong, or the objects too far away"
)
NO_PERSPECTIVE = (
    "no perspective was found: the focal length is very long, or there are too few "
    "basis shapes to estimate it. If it is known, give focal_length"
)


class TableFit(NamedTuple):
    """
    A fit: model of new tables, frames of all rows, convergence, other attributes.

    Of perspective images with a known focal length they are those of weak-perspective
    images in virtual cameras. changes: shares by which repeats have changed the depths.
    energies (J,): contributions of the points to E.
    """

    model: TableModel
    frames: Decomposition
    converged: bool
    attributes: dict[str, Any]
    changes: tuple[float, ...] = ()
    energies: NDArray = np.zeros(0)

    @property
    def energy(self) -> float:
        """Mean squared distance E of the points from their images."""
        return float(self.energies.sum())

    @property
    def pinhole(self) -> Pinhole:
        """The perspective camera."""
        assert self.model.pinhole is not None
        return self.model.pinhole

    def depths(self, part: slice) -> NDArray:
        """Return depths (n, J) of the points of some frames."""
        return self.model.depths(self.frames.motion[part], self.frames.alpha[part])

    def change(self, other: "TableFit", parts: list[slice]) -> float:
        """Return the distance of depths from others, relative to these.

        It is negative if the mirror image is nearer.
        """
        pairs = (np.nan_to_num([fit.depths(p) for fit in (self, other)]) for p in parts)
        products = sum(np.einsum("aij,bij->ab", pair, pair) for pair in pairs)
        (power, common), (_, other_power) = np.asarray(products)
        square = max(power - 2.0 * abs(common) + other_power, 0.0) / (power or 1.0)
        return float(np.copysign(np.sqrt(square), common))

    def ends(self, tol: float, best: float) -> bool:
        """Return whether further repeats would not help: for the best E of others."""
        n_repeats, change = len(self.changes), self.changes[-1]
        n_max = MOST_REPEATS if change > UNSETTLED else 2 * MOST_REPEATS
        n_max = 2 if self.energy > WORSE * best else n_max
        return change < tol or n_repeats >= n_max

    def mirrored(self) -> "TableFit":
        """Return the mirror image in depth."""
        attributes = self.attributes | {"motion_": self.frames.motion}
        attributes |= self.model.mirrored_attributes(attributes)
        model, motion = attributes.pop("_model"), attributes.pop("motion_")
        frames = self.frames._replace(motion=motion)
        return self._replace(model=model, frames=frames, attributes=attributes)


def stages_of(estimator: Any) -> list[str]:
    """Return the names of the stages of a fit, in order."""
    stages = ["table", "factorisation"]
    if estimator.prior is None and "start" not in (estimator._continued or ()):
        if estimator.n_components == "auto" and estimator.camera == "affine":
            stages.insert(0, "number of basis shapes")
        stages += ["independent subspaces", "block structure and refinement"]
    if estimator.refinement in JOINT_REFINEMENTS:
        stages.append(JOINT_STAGE)
    if estimator.refinement == "consensus" and estimator.camera != "perspective":
        stages.append(CONSENSUS_STAGE)
    stages.append("gauge and coefficients")
    return stages + [PERSPECTIVE_STAGE] * (estimator.camera == "perspective")


@one_blas_thread()
def fit_table(
    table: ScaledTable,
    n_components: int,
    isa: Any,
    settings: FitSettings,
    progress: Progress,
) -> TableFit:
    """Fit a table, report K coefficients, and fit a clone of the strategy `isa`.

    Frames are NaN for rows without visible points. The attributes are the others of
    `AffineNRSfM`.
    """
    wanted, first = n_components, settings
    # Calibrated cameras: the fit does not depend on the number of coefficients.
    if settings.all_directions:
        n_components = possible_components(table, settings)
    # 1. and 2. The rest of the table, and its factorisation
    factorised = _factorised(table, n_components, settings, progress)
    # 3. and 4. The paper's pipeline
    start = None
    if settings.prior is not None:
        # Perspective images are right for the last fit, which has errors.
        start, settings = prior_start(table, settings, checked=settings.errors)
    if settings.start is not None:
        start = _started(table, settings, n_components)
    if start is None:
        isa, factors = clone(isa), factorised.factors
        shapes, covariance, n_iter, converged = pipeline.run_paper_pipeline(
            factors.leading(3 * wanted), wanted, isa, settings, progress
        )
        if settings.all_directions:  # the start has a fixed number of basis shapes
            images = factorised.W.reshape(len(factors.cameras), 2, -1)
            shapes = lifted_shapes(images, factors.cameras, n_components)
    else:
        isa, shapes = None, start.shapes
    # 5. Refinement, gauge and frames
    if settings.joint:
        fit = _joint_fit(factorised, shapes, start, settings, wanted, progress)
        # Down-weighted outliers, for example, look like basis shapes at first.
        supported = max(uncertainty.n_reliable(fit.attributes["reliability_"]), 1)
        if settings.free and not settings.all_directions and supported < n_components:
            progress("gauge and coefficients")
            first = first._replace(known=None)
            return fit_table(table, supported, isa, first, NoProgress())
    else:
        fit = _paper_fit(factorised, shapes, covariance, settings)
        fit.attributes["n_iter_"] = n_iter
        fit = fit._replace(converged=converged)
    # The mirror image in depth
    probability = settings.mirror_certainty
    if settings.hidden_points and not table.complete and settings.prior is None:
        probability = fit.model.mirror_certainty(table.rows, fit.frames)
        if probability < 0.5:
            probability, fit = 1.0 - probability, fit.mirrored()
    # 6. Measures of the fit
    attributes = fit.attributes | _measures(factorised, fit, settings.camera)
    progress("gauge and coefficients")
    rows = (of_all_rows(part.astype(table.dtype), table.shown) for part in fit.frames)
    sizes = of_all_rows(table.sizes, table.shown)
    attributes |= {"mirror_certainty_": probability, "isa_": isa, "_frame_sizes": sizes}
    return fit._replace(frames=Decomposition(*rows), attributes=attributes)


def _joint_fit(
    factorised: FactorisedTable,
    shapes: NDArray,
    start: JointState | None,
    settings: FitSettings,
    n_components: int,
    progress: Progress,
) -> TableFit:
    """Return the joint fit from shapes, or a given state, or the consensus of groups.

    K coefficients are reported, or the relevant ones if they are free. Frames are those
    that are shown, some attributes are lacking.
    """
    table, settings = factorised.scaled, settings._replace(on_step=progress.step)
    cache = {} if settings.known is None else settings.known
    if "joint" not in cache:
        cache["joint"] = joint_fit.fit_jointly(factorised, shapes, start, settings)
    fit, tracks, alpha = cache["joint"]
    settings = settings._replace(shape_prior=fit.prior)
    progress(JOINT_STAGE)
    state, starts, widths = fit.state, spread_starts(alpha), fit.widths
    n_directions = len(state.shapes) - 1
    kind = settings.loss, FrameMap.identity(n_directions), settings.camera
    model = FrameModel(state.shapes, state.noise, starts, *kind)
    errors, calibrated = settings.errors, settings.camera != "affine"
    if settings.free and widths is not None:
        n_components = min(widths.n_relevant, MOST_FIRST)
    grouped = settings.refinement == "consensus"
    if grouped:
        # A residual below the noise of the spectrum leaves nothing for groups.
        n_numbers, square = tracks.totals
        noise = factorised.noise_level(n_directions) * square / n_numbers
        if widths is not None:  # whose noise is that of the other coordinates
            n_unknowns = widths.n_unknowns(len(table.sizes), settings.camera)
            noise *= n_numbers / (n_numbers - n_unknowns)
        grouped = fit.misfit > noise
    if errors and calibrated and not grouped and "certainty" not in cache:
        cache["certainty"] = uncertainty.depth_certainty(model, table, fit, settings)
    if errors and calibrated and "certainty" in cache:
        model = replace(model, certainty=cache["certainty"])
    if errors and widths is not None and not grouped:
        mean = bagged(model, table, settings, widths)
        if mean is not None:
            model, widths = mean
            tracks = JointFrames.from_points(table.rows, table.complete, table.weights)
    if grouped:
        alternatives = partial(joint_fit.other_fits, factorised, shapes, settings, fit)
        model, widths = consensus(model, table, settings, fit, alternatives), None
        tracks = JointFrames.from_points(table.rows, table.complete)
    if settings.refinement == "consensus":
        progress(CONSENSUS_STAGE)
    attributes: dict[str, Any] = {
        "camera_noise_ratio_": fit.camera_noise_ratio,
        "objective_history_": fit.history,
        "gradient_norm_": fit.gradient_norm,
        "n_iter_": len(fit.history) - 1,
    }
    if errors and settings.loss == "linear" and table.weights is None:
        sample = spread(np.arange(len(table.sizes)), 100)
        distance = joint_fit.left_out_distances(model, table.rows.take(sample))
        attributes["_left_out"] = distance, np.flatnonzero(table.shown)[sample]
    if (n_more := n_components + 1 - len(model.shapes)) > 0:
        # Coefficients beyond the directions that a table supports are zero.
        shapes = np.pad(model.shapes, ((0, n_more), (0, 0), (0, 0)))
        starts = np.pad(model.starts, ((0, 0), (0, n_more)))
        model = replace(model, shapes=shapes, starts=starts)
        widths = None if widths is None else widths.padded(n_more)
    fits = uncertainty.fitted_frames(model, tracks, table.rows)
    del tracks  # as much memory as the table
    result = _joint_frames(table, model, fits, settings, n_components, widths)
    if fit.prior is not None:
        attributes["prior_std_"] = np.array([fit.prior.distance, 0.0])
    if errors and calibrated:
        attributes["depth_uncertainty_"] = result.model.frames.certainty.total
    attributes |= result.attributes
    return result._replace(converged=fit.converged, attributes=attributes)


@one_blas_thread()
def supported_components(
    table: ScaledTable, isa: Any, settings: FitSettings, progress: Progress
) -> int:
    """Return the number of relevant basis shapes, at most twelve."""
    K, quiet = possible_components(table, settings), NoProgress()
    factorised = _factorised(table, K, settings, quiet)
    factors = factorised.factors
    shapes, *_ = pipeline.run_paper_pipeline(factors, K, clone(isa), settings, quiet)
    progress("number of basis shapes")
    return joint_fit.count_components(factorised, shapes, settings)


def possible_components(table: ScaledTable, settings: FitSettings) -> int:
    """Return the largest number of basis shapes of first fits of a table."""
    size = len(table.sizes), table.n_points
    return min(MOST_FIRST, scaling.most_components(*size, settings.camera))


def _factorised(
    table: ScaledTable, n_components: int, settings: FitSettings, report: Progress
) -> FactorisedTable:
    """Return a table with outliers (robust loss), completed frames and factors."""
    limits, n_points = settings.limits, table.n_points
    # Calibrated cameras can have more basis shapes than the factorisation.
    n_triplets = min(3 * n_components + 3, n_points - 1)
    n_components = min(n_components, scaling.largest_n_components(n_points))
    outliers, completed, complete = None, table.rows, table.complete
    if settings.loss != "linear":
        outliers = gross_outliers(table.rows, limits.model_frames)
        completed = table.rows.derive(scaling.rows_without, outliers)
        complete = complete and not outliers.any()
    if complete:  # kept, because the factorisation reads it up to ten times
        completed = completed.derive(np.asarray)
    else:
        size = n_points, n_components, limits.model_frames
        completed = complete_rows(completed, *size)
    report("table")
    shape = 2 * len(table.sizes), n_points
    triplets = pipeline.block_triplets(completed, shape, n_triplets, limits.dense)
    values, vectors, rest = triplets
    # With a prior there may be few frames.
    values = np.pad(values, (0, n_triplets - len(values)))
    if settings.joint:
        sizes = limits.sample, limits.small_table
        W, parts = pipeline.sample_frames(completed, n_points, vectors[:3], *sizes)
    else:
        W, parts = completed.whole().reshape(shape), []
    factors = pipeline.factorise(W, n_components, table.precision, triplets)
    compressed = None
    threshold = max(24 * (n_components + 1), limits.many_points)
    if settings.joint and settings.prior is None and n_points > threshold:
        directions = np.concatenate([factors.rigid_shape, factors.signals])
        directions = directions[directions.any(axis=1)] / np.sqrt(n_points)
        compressed = JointFrames.from_directions(completed, directions)
    report("factorisation")
    return FactorisedTable(table, compressed, outliers, values, rest, W, parts, factors)


def _started(
    table: ScaledTable, settings: FitSettings, n_components: int
) -> JointState:
    """Return a start of K basis shapes from a model, in units of a table.

    It has the cameras of frames that are placed, otherwise none. Basis shapes that the
    model lacks are directions of the residuals of at most 200 frames.
    """
    model, placed = settings.start, settings.placed
    frames = model.frames
    # Frames have size one, unless all have one scale.
    unit = model.unit / table.unit if model.unit and table.unit else 1.0
    n_more = max(n_components + 1 - len(frames.shapes), 0)
    shapes, noise = unit * frames.shapes, unit**2 * frames.noise_variance
    if n_more:
        rows = table.rows.take(spread(np.arange(table.rows.n_frames), 200))
        frames = replace(frames, shapes=shapes, noise_variance=noise)
        fit = frames.posterior(rows)
        rows = rows - fit.translation[:, :, None]
        shapes = extended_shapes(rows, shapes, fit.motion, fit.alpha, n_more)
    motion = np.empty((0, 2, 3))
    if placed is not None:
        back, sizes = np.linalg.pinv(frames.gauge.mixing), table.sizes[:, None, None]
        motion, _, alpha, _ = (part[table.shown] for part in placed)
        scales = back[0, 0] + alpha @ back[0, 1:]
        motion = scales[:, None, None] * motion @ frames.gauge.space / sizes
    return JointState(shapes, motion, noise)


def _paper_fit(
    factorised: FactorisedTable, shapes: NDArray, covariance: NDArray, s: FitSettings
) -> TableFit:
    """Return the fit of the paper's pipeline in its gauge."""
    table = factorised.scaled
    if s.camera != "affine":
        scaled = s.camera == "weak_perspective"
        _, shapes = calibrated_start(factorised.factors.cameras, shapes, scaled)
        shapes = table.sizes[0] * shapes

    def fitted() -> tuple[TableModel, Decomposition]:
        frames, K = FrameModel.rigid(mean_shape, basis, s.camera), len(basis)
        model = TableModel(frames, mean_shape, basis, K, s.layout, table.unit)
        return model, table.source.joined(partial(model.decompose, dtype=np.float64))

    # The gauge is that of a fit to visible points, not to completed frames. One scaling
    # is enough, unless frames have fewer points than coefficients need.
    mean_shape, basis, order = shapes[0].T, shapes[1:].mT, np.arange(len(shapes) - 1)
    model, frames = fitted()
    for _ in range(50):
        motion = frames.motion / table.sizes[:, None, None]
        if s.camera == "affine":
            space = gauge.canonical_space(mean_shape, motion)
        else:
            size = 1.0 if s.camera == "orthographic" else None
            space = gauge.euclidean_space(mean_shape, motion, size)
        mean_shape, basis, new_order, _ = gauge.canonical_gauge(
            mean_shape, basis, motion, frames.alpha, space
        )
        order = order[new_order]
        # Frames are fitted with the stored (rounded) shapes, so that transform agrees.
        mean_shape, basis = mean_shape.astype(table.dtype), basis.astype(table.dtype)
        model, frames = fitted()
        # Coefficients scale with the basis shapes. If a frame does not determine its
        # coefficients, their solution of minimum norm changes.
        deviations = gauge.coefficient_sizes(frames.alpha)[basis.any(axis=(1, 2))] - 1
        if np.abs(deviations).max(initial=0.0) <= 1e-6:
            break
    index = (3 * order[:, None] + np.arange(3)).ravel()
    covariance = (table.unit or 1.0) ** 2 * covariance[np.ix_(index, index)]
    return TableFit(model, frames, True, {"mode_covariance_": covariance})


def _joint_frames(
    table: ScaledTable,
    model: FrameModel,
    fits: uncertainty.FrameFits,
    s: FitSettings,
    n_components: int,
    widths: Widths | None,
) -> TableFit:
    """Return fits in the independent gauge.

    n_components: number of coefficients that are reported. widths: of a fit of all
    directions.
    """
    posteriors, motion, alpha, covariance, _ = fits
    unknown = np.isnan(motion).any(axis=(1, 2))
    if unknown.any():
        row = np.flatnonzero(table.shown)[unknown.argmax()]
        raise ValueError(
            f"the visible points of {unknown.sum()} of {len(unknown)} frames (first: "
            f"row {row}) are coplanar, which does not determine a camera. Leave out "
            "these rows"
        )
    # Gauge of shapes, cameras and coefficients
    prior, noise = s.shape_prior, model.noise_variance
    unit = table.unit if s.camera == "orthographic" else None
    attributes: dict[str, Any] = {}
    if prior is None:
        kind = s.independence, s.camera, unit, n_components, s.remove_pose
        chosen = gauge.independent_gauge(model.shapes, motion, alpha, *kind)
        mean_shape, basis, frame_map = chosen
    else:
        frame_map = prior.gauge
        mean_shape, basis = frame_map.public(model.shapes)
    weight = table.n_seen if table.weights is None else table.weights.sum(axis=1)
    share, slices = weight / table.n_points, posteriors.slices
    information = uncertainty.shape_information(
        motion, alpha, covariance, share, slices
    )
    if widths is not None:  # as in `MarginalLikelihood`
        ridge = np.append(0.0, model.noise_variance / widths.variances)
        information += np.diag(np.repeat(ridge, 3))
    if prior is None:
        inverse = np.linalg.pinv(information, hermitian=True)
        attributes["_halves"] = uncertainty.half_tables(
            table, model, motion, alpha, inverse, s.groups, kind
        )
    else:
        inverse = prior.inverse(information[None], noise)[0]
    penalty = prior or widths
    unknowns = float(model.shapes.size) if penalty is None else penalty.n_determined
    certainty = uncertainty.frame_certainty(model, fits, table.n_seen, weight, unknowns)
    certainty = certainty._replace(weighted=table.weights is not None)
    model = replace(model, gauge=frame_map, certainty=certainty)
    last_pass = partial(uncertainty.shown_frames, frames=model, inverse=inverse)
    passes = posteriors.map(last_pass, table.sizes, table.n_seen, weight)
    parts, moments, noises = zip(*passes, strict=True)
    frames = Decomposition(*map(np.concatenate, zip(*parts, strict=True)))
    mean_shape, basis = mean_shape.astype(table.dtype), basis.astype(table.dtype)
    cameras = frames.motion / table.sizes[:, None, None]
    if prior is not None:
        sight = camera_models.line_of_sight(cameras)
        errors = prior.depth_errors(information, noise, sight, frames.alpha)
        points = camera_models.compose(mean_shape, basis, frames.alpha)
        depths = np.vecdot(points, sight[:, None])
        model = replace(model, certainty=certainty.of_prior(errors, depths))
    square = (table.unit or 1.0) ** 2
    modes = gauge.mode_covariance(cameras, frames.alpha[:, :n_components])
    shares = uncertainty.reliabilities(alpha, covariance, sum(moments), sum(noises))
    attributes |= {
        "mode_covariance_": square * modes,
        "noise_variance_": square * noise,
        "reliability_": shares[:n_components],
    }
    frames = frames._replace(translation=frames.translation + table.translation)
    fitted = TableModel(model, mean_shape, basis, n_components, s.layout, table.unit)
    return TableFit(fitted, frames, True, attributes)


def _measures(
    factorised: FactorisedTable, fit: TableFit, camera: str
) -> dict[str, Any]:
    """Return the attributes that describe any fit, by name."""
    table, (model, frames, *_) = factorised.scaled, fit
    mean_shape, basis, K = model.mean_shape, model.basis, model.n_components
    values = factorised.singular_values
    cameras = frames.motion / table.sizes[:, None, None]
    energy = gauge.image_energies(cameras, basis, frames.alpha)
    position = (frames.translation - table.translation) / table.sizes[:, None]
    shapes = np.concatenate([mean_shape[None], basis]).mT

    def energies(rows: NDArray, *fit: NDArray) -> tuple[float, float]:
        """Return the energies of residuals over visible points, and of frames."""
        noise = np.nansum(camera_models.distances(rows, shapes, *fit) ** 2)
        middle = np.nanmean(rows, axis=2, keepdims=True, dtype=np.float64)
        return float(noise), float(np.nansum((rows - middle) ** 2))

    passes = table.rows.map(energies, cameras, position, frames.alpha)
    noise, signal = np.sum(list(passes), axis=0)
    return {
        "mean_shape_": mean_shape,
        "basis_": basis[:K],
        "rank_floor_": factorised.rest_share(3 * K + 3),
        "singular_values_": (table.unit or 1.0) * values[: 3 * K + 3],
        "energy_share_": energy[:K] / (energy.sum() or 1.0),
        "inverse_snr_": float(noise / signal),
    } | mean_camera(frames, table.sizes, camera, table.dtype)


def mean_camera(
    frames: Decomposition, sizes: NDArray, camera: str, dtype: Any
) -> dict[str, NDArray]:
    """Return the attributes of the mean view of frames of some sizes (n,).

    That of cameras over the sizes of their frames, times the RMS size. If they have no
    common view, it is the view along the third axis, each axis scaled by its RMS length
    in the cameras.
    """
    motion = frames.motion / sizes[:, None, None]
    reference = camera_models.mean_view(motion)
    if reference is None:
        lengths = np.sqrt(np.mean(np.sum(motion**2, axis=1), axis=0))
        reference = lengths * np.eye(2, 3)
    reference = reference * np.sqrt(np.mean(sizes**2))
    if camera != "affine":
        (row,), (scale,) = camera_models.nearest_calibrated(reference[None])
        reference = scale * row
    return {
        "reference_motion_": reference.astype(dtype),
        "reference_translation_": frames.translation.mean(axis=0).astype(dtype),
    }


class Images(NamedTuple):
    """A table of images, and what all its fits have in common."""

    source: FrameBlocks
    weights: NDArray | None
    isa: Any
    settings: FitSettings
    principal_point: Any
    progress: Progress

    def pinhole(self, focal_length: float, near: bool = True) -> Pinhole:
        """Return the camera with a focal length."""
        robust = self.settings.loss != "linear"
        return pinhole_of(focal_length, self.principal_point, robust, near)

    def straight(
        self,
        n_components: int = 1,
        pinhole: Pinhole | None = None,
        fit: TableFit | None = None,
    ) -> ScaledTable:
        """Return weak-perspective images, for the depths of a fit, or equal ones.

        Without a camera they are those of the table.
        """
        rows = self.source
        if pinhole is not None:
            rows = rows.derive(pinhole.virtual, kept=fit is None)
            if fit is not None:
                depths, arrays = fit.model.depths, (fit.frames.motion, fit.frames.alpha)
                straight = pinhole.straight
                rows = rows.derive(lambda r, *f: straight(r, depths(*f)), *arrays)
        return scaling.scaled_table(rows, self.weights, n_components, self.settings)

    def fit(
        self,
        pinhole: Pinhole | None,
        n_components: int | None,
        before: TableFit | None = None,
        *,
        last: bool = False,
        progress: Progress | None = None,
        **changes: Any,
    ) -> TableFit:
        """Return the fit of images that are corrected for the depths of another fit.

        It has the mirror image with those depths. None stands for as many basis shapes
        as are relevant. Fits before the last one are joint fits with principal axes and
        a larger tolerance, from the other fit and its cameras. `changes` are those of
        the settings.
        """
        isa, quiet = self.isa, NoProgress()
        settings = self.settings._replace(start=None, known=None)
        if not last:
            settings = settings._replace(
                independence=None,
                tol=ROUGH * settings.tol,
                whole=False,  # all directions of a shape would explain the perspective
                refinement="joint",
                remove_pose=False,
                errors=False,
            )
            if before is not None:
                settings = settings._replace(start=before.model, placed=before.frames)
        settings = settings._replace(**{"free": n_components is None} | changes)
        if n_components is None:
            table = self.straight(1, pinhole, before)
            n_components = supported_components(table, isa, settings, quiet)
            if before is not None and n_components == before.model.n_components:
                return before
        table = self.straight(n_components, pinhole, before)
        fit = fit_table(table, n_components, isa, settings, progress or quiet)
        fit = fit._replace(model=fit.model._replace(pinhole=pinhole))
        if before is not None:
            change = fit.change(before, self.source.slices)
            fit = fit.mirrored() if change < 0 else fit
            fit.attributes["isa_"] = fit.attributes["isa_"] or before.attributes["isa_"]
            fit = fit._replace(changes=(*before.changes, abs(change)))
        squares = self.source.map(partial(_squares, model=fit.model), *fit.frames)
        square, counts = np.sum(list(squares), axis=0)
        return fit._replace(energies=square / counts.sum())

    def settled(
        self, pinhole: Pinhole, n_components: int, *fits: TableFit, tol: float = SETTLED
    ) -> list[TableFit]:
        """Repeat fits until depths and fits agree; return them, the best first.

        A fit also ends if it is clearly worse than the best one.
        """
        tol *= self.settings.tol / JOINT_TOL
        running = [fit._replace(changes=()) for fit in fits]
        ended: list[TableFit] = []
        while running:
            self.progress.step()
            running = [self.fit(pinhole, n_components, fit) for fit in running]
            best = min(fit.energy for fit in [*running, *ended])
            ended += [fit for fit in running if fit.ends(tol, best)]
            running = [fit for fit in running if not fit.ends(tol, best)]
        return sorted(ended, key=lambda fit: fit.energy)

    def images(self, first: TableFit, f: float) -> dict[float, TableFit]:
        """Return the fits for 1/f and -1/f from a first fit."""
        images, pinhole = (first, first.mirrored()), self.pinhole(f)
        better, worse = self.settled(pinhole, first.model.n_components, *images)
        if self.log_odds(better, worse) < 0:
            better, worse = worse, better
        return {1.0 / f: better, -1.0 / f: worse}

    def log_odds(self, fit: TableFit, image: TableFit) -> float:
        """Return the log odds of a fit against its mirror image.

        The evidence is a test of E over groups of points, and the prior, if any.
        """
        gain = image.energies - fit.energies
        gain = np.bincount(uncertainty.neighbours(fit.model.mean_shape.T), gain)
        t = gain.mean() / gain.std(ddof=1) * np.sqrt(len(gain))
        odds = float(logit(stdtr(len(gain) - 1, t)))
        if np.isnan(self.settings.mirror_certainty):
            return odds
        prior = self.settings.prior.mean_shape
        sign = np.sign(np.vdot(fit.model.mean_shape[:, 2], prior[:, 2]))
        return odds + float(sign * logit(self.settings.mirror_certainty))

    def started(self, model: TableModel, n_components: Any) -> TableFit:
        """Return the fit from the model of a similar table, with its focal length."""
        weak = model._replace(pinhole=None)  # its frames are those of virtual cameras
        virtual = partial(weak.decompose, deviations=False, dtype=np.float64)
        frames = self.source.derive(model.straightened, kept=False).joined(virtual)
        fit = TableFit(model, frames, True, {"isa_": None})
        return self.settled(fit.pinhole, n_components, fit)[0]

    def near(self, fits: dict[float, TableFit], place: float) -> TableFit:
        """Return the fit for g, from that with the nearest one."""
        fit = fits[min((g for g in fits if g > 0), key=lambda g: abs(g - place))]
        rough, pinhole = COMPARED * SETTLED, self.pinhole(1.0 / place)
        return self.settled(pinhole, fit.model.n_components, fit, tol=rough)[0]

    def searched(self, n_components: int | None) -> dict[float, TableFit]:
        """Return fits around the minimum of E; 0 is the weak-perspective fit."""
        f = FIRST * max(self.source.map(self._reach))
        virtual = self.pinhole(f, near=False)
        first = self.fit(virtual, n_components, progress=self.progress)
        far = self.fit(self.pinhole(ENDLESS * f, near=False), first.model.n_components)
        fits = {0.0: far, **self.images(first, f)}
        if far.energy < fits[1.0 / f].energy:  # a long focal length, or none
            fits |= self.images(far, LONGER * f)
        for step in STEPS:
            while len(fits) < MOST_FITS and (lowest := best_of(fits)) > 0:
                places = lowest * step, lowest / step
                new = [p for p in places if min(abs(g / p - 1) for g in fits) > NEAR]
                if not new:
                    break
                fits[new[0]] = self.near(fits, new[0])
        return fits

    def _reach(self, rows: NDArray) -> float:
        """Return the largest coordinate of points and image, from its middle."""
        centre = self.pinhole(1.0).centre
        largest = np.fmax.reduce(np.abs(rows - centre), axis=None, initial=0.0)
        return float(max(largest, *np.abs(centre[:, 0])))


def fit_images(
    table: Images, n_components: Any, given: Any, perspective: bool
) -> TableFit:
    """Fit images as `fit_table` fits a scaled table, with a given focal length, if any.

    "auto" stands for as many coefficients as the table determines.
    """
    auto, point = n_components == "auto", table.principal_point
    args = table.isa, table.settings, table.progress
    if perspective:
        fit = fit_perspective(table, None if auto else n_components, given)
    else:
        if auto and table.settings.camera == "affine":
            with warnings.catch_warnings(action="ignore"):  # the fit warns again
                scaled = table.straight()
            n_components = supported_components(scaled, *args)
        number = 1 if n_components == "auto" else n_components
        fit = fit_table(table.straight(n_components=number), number, *args)
    if point is not None and fit.model.pinhole is None:
        f = np.array(np.inf if given is None else given, dtype=float)[()]
        fit = fit._replace(model=fit.model._replace(axes=pinhole_of(f, point)))
        fit.attributes.update(focal_length_=f, focal_length_std_=0.0)
    return fit


def best_of(fits: dict[float, TableFit]) -> float:
    """Return the g of the fit with the least E."""
    return min(fits, key=lambda g: fits[g].energy)


def minimum(fits: dict[float, TableFit]) -> tuple[float, float]:
    """Return the minimum of a parabola through the three best fits, its deviation."""
    g = sorted(fits, key=lambda g: fits[g].energy)[:3]
    energies = np.array([fits[place].energies for place in g])
    groups = uncertainty.neighbours(fits[g[0]].model.mean_shape.T)

    def vertex(kept: NDArray) -> float:
        """Return the minimum for some of the points, or infinity if there is none."""
        square, slope, _ = np.polyfit(g, energies[:, kept].sum(axis=1), 2)
        return float(-0.5 * slope / square) if square > 0 else np.inf

    every = vertex(groups >= 0)
    parts = np.array([vertex(groups != group) for group in range(uncertainty.N_GROUPS)])
    if not np.isfinite(parts).all():
        return every, np.inf
    # Few groups: the error has a t distribution, whose deviation is larger.
    n_free = uncertainty.N_GROUPS - 1
    return every, float(parts.std() * np.sqrt(n_free * n_free / (n_free - 2)))


def fit_perspective(table: Images, n_components: int | None, given: Any) -> TableFit:
    """Fit perspective images as `fit_table` fits weak-perspective ones.

    `n_components` and the given focal length are estimated if they are None; the table
    has the mean of several. A fit from the model of a similar table has that of it.
    If perspective is not found, its fit does not settle, or points of new frames do not
    prefer it, the fit is that of weak-perspective cameras, with a warning. The model of
    that fit may be known, as "weak".
    """
    settings, errors = table.settings, table.settings.errors
    fits: dict[float, TableFit] = {}
    deviation, why, prior = 0.0, "", settings.prior
    # Like all fits with calibrated cameras, it does not depend on the number reported.
    number = None if settings.all_directions else n_components
    with warnings.catch_warnings(action="ignore"):  # the last fit warns
        if settings.start is not None:
            best = table.started(settings.start, n_components)
        elif given is not None:
            f = camera_models.common(given)
            virtual = table.pinhole(f, near=False)
            first = table.fit(virtual, number, progress=table.progress)
            fits = {0.0: first, **table.images(first, f)}
            best = fits[1.0 / f]
            if best.changes[-1] > UNSETTLED and prior is None:
                why = UNSTEADY
            elif errors:  # neighbours tell how far a focal length contradicts the table
                fits |= {g: table.near(fits, g) for g in (0.8 / f, 1.25 / f)}
        else:
            fits, number = table.searched(n_components), n_components
            place, deviation = minimum(fits)
            deviation = float(np.hypot(deviation, 0.5 * NEAR * place))  # of the search
            if best_of(fits) > 0 and place > 2.0 * deviation:
                best = table.near(fits, place)
            else:
                why = NO_PERSPECTIVE
        if number is None and not why:
            best = table.fit(best.pinhole, None, best)
            best = table.settled(best.pinhole, best.model.n_components, best)[0]
    # The last fits, with warnings and errors of depths
    last = partial(table.fit, last=True)
    if not why:
        n_last = n_components or best.model.n_components
        fit, largest = best, LAST_CHANGE * settings.tol / JOINT_TOL
        for _ in range(MOST_LAST):  # all directions show more than a few
            with warnings.catch_warnings(record=True, action="always") as caught:
                fit = last(best.pinhole, n_last, fit)
            if fit.changes[-1] < largest:
                break
    plain = partial(last, None, n_components or 1, free=n_components is None)
    weights = () if table.weights is None else (table.weights,)
    if not why and settings.start is None:
        with warnings.catch_warnings(action="ignore"):
            weak = (settings.known or {}).get("weak") or plain(errors=False).model
        models = fit.model, weak
        parts = table.source, *weights
        error, of_weak = (m.optimism(*parts) * m.held_out_error(*parts) for m in models)
        why = "" if error < of_weak else NOT_BETTER
    table.progress(PERSPECTIVE_STAGE)
    if why:
        warn_caller(f"{why}. The fit is that of weak-perspective cameras")
        return plain()
    for each in caught:
        warn_caller(str(each.message), each.category)
    model, attributes, f = fit.model, fit.attributes, best.pinhole.focal_length
    if errors:
        certainty = model.frames.certainty
        error = focal_error(fits, 1.0 / f, deviation, table.source.slices)
        total = float(np.hypot(certainty.total, error))
        certainty = certainty._replace(total=total)
        model = model._replace(frames=replace(model.frames, certainty=certainty))
        place = min(abs(g) for g in fits if g < 0)
        probability = float(expit(table.log_odds(fits[place], fits[-place])))
        attributes |= {"depth_uncertainty_": total, "mirror_certainty_": probability}
        if prior is not None and deviation:  # images show depths over f
            deviation = float(np.hypot(deviation, total / f))
    # Frames as new tables have them
    decompose = partial(model.decompose, dtype=np.float64)
    frames: Decomposition = table.source.joined(decompose, *weights)
    dtype = table.source.empty.dtype
    sizes, has_depth = attributes["_frame_sizes"], model.frames.certainty.determined
    mask = np.isfinite(sizes)
    seen = Decomposition(*(values[mask] for values in frames))
    attributes |= mean_camera(seen, sizes[mask], "perspective", dtype)
    attributes |= {
        "isa_": best.attributes["isa_"],
        "focal_length_": f if given is None else np.array(given, dtype=float)[()],
        "focal_length_std_": deviation * f**2 if has_depth or not deviation else np.inf,
    }
    frames = Decomposition(*(part.astype(dtype) for part in frames))
    return fit._replace(model=model, frames=frames)


def focal_error(
    fits: dict[float, TableFit], g: float, deviation: float, parts: list[slice]
) -> float:
    """Return the relative error of the depths due to that of the focal length.

    The error of 1/f is its deviation. For a given f it is the distance of the minimum
    of E, as far as the deviation of the minimum does not explain it.
    """
    if not deviation:
        place, other = minimum(fits)
        deviation = np.sqrt(np.fmax((place - g) ** 2 - other**2, 0.0))
    first, second = sorted((o for o in fits if o >= 0), key=lambda o: abs(o - g))[:2]
    change = abs(fits[first].change(fits[second], parts))
    return float(change * deviation / abs(second - first))


def _squares(rows: NDArray, *fit: NDArray, model: TableModel) -> NDArray:
    """Return sums (J,) of squared distances, in sizes of frames, and counts."""
    square = model.distances(rows, *model.in_table_cameras(rows, *fit)[:3]) ** 2
    if model.frames.loss != "linear":
        # As the loss "cauchy" has them
        limit = model.frames.noise_variance * TUNING["cauchy"] ** 2
        square = limit * np.log1p(square / limit)
    return np.array([np.nansum(square, axis=0), np.isfinite(square).sum(axis=0)])
