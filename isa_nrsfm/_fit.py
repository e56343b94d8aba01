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
"""

from collections.abc import Callable
from dataclasses import replace
from functools import partial
from typing import Any

import numpy as np
from numpy.typing import NDArray
from sklearn.base import clone

from isa_nrsfm._compat.scikit_learn import FitProgress, NoProgress, one_blas_thread
from isa_nrsfm._fitted_model import TableModel, prior_start
from isa_nrsfm._frames.camera_models import (
    compose,
    line_of_sight,
    nearest_calibrated,
    reference_camera,
    reprojection_error,
)
from isa_nrsfm._frames.gauge import (
    image_energies,
    independent_gauge,
    mode_covariance,
    reorder_blocks,
    rigid_gauge,
)
from isa_nrsfm._frames.models import (
    MIRROR,
    Decomposition,
    FrameMap,
    FrameModel,
    spread_starts,
)
from isa_nrsfm._joint.bagging import bagged
from isa_nrsfm._joint.consensus import MOST_FIRST, consensus
from isa_nrsfm._joint.fit import count_components, fit_jointly, left_out_distances
from isa_nrsfm._joint.likelihood import JointFrames
from isa_nrsfm._joint.problem import FactorisedTable, JointState, Widths
from isa_nrsfm._joint.settings import FitSettings
from isa_nrsfm._joint.starts import extended_shapes, lifted_shapes, rigid_start
from isa_nrsfm._joint.uncertainty import (
    FrameFits,
    depth_certainty,
    fitted_frames,
    frame_certainty,
    half_tables,
    n_reliable,
    reliabilities,
    shape_information,
    shown_frames,
)
from isa_nrsfm._parameters import JOINT_REFINEMENTS
from isa_nrsfm._prepare.completion import complete_rows
from isa_nrsfm._prepare.robust import gross_outliers
from isa_nrsfm._prepare.scaling import (
    ScaledTable,
    largest_n_components,
    most_components,
    rows_without,
)
from isa_nrsfm._tables.blocks import spread
from isa_nrsfm._tables.tracks import of_all_rows
from isa_nrsfm.isa._pipeline import (
    Factorisation,
    block_triplets,
    factorise,
    run_paper_pipeline,
    sample_frames,
)

JOINT_STAGE = "joint refinement"
CONSENSUS_STAGE = "consensus of groups of points"
PERSPECTIVE_STAGE = "perspective"
# Stages that report steps.
STEPWISE = JOINT_STAGE, CONSENSUS_STAGE, PERSPECTIVE_STAGE

# Model, frames, convergence and other attributes of a fit
TableFit = tuple[TableModel, Decomposition, bool, dict[str, Any]]


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


@one_blas_thread
def fit_table(
    table: ScaledTable,
    n_components: int,
    isa: Any,
    settings: FitSettings,
    progress: FitProgress | NoProgress,
) -> TableFit:
    """Fit a table, report K coefficients, and fit a clone of the strategy `isa`.

    Returns the model of new tables; cameras and coefficients of all rows, NaN for rows
    without visible points; convergence; and the other attributes of `AffineNRSfM`.
    """
    wanted, first = n_components, settings
    # Calibrated cameras: the fit does not depend on the number of coefficients.
    if settings.all_directions:
        possible = most_components(len(table.sizes), table.n_points, settings.camera)
        n_components = min(MOST_FIRST, possible)
    # 1. and 2. The rest of the table, and its factorisation
    factorised = _factorised(table, n_components, settings, progress)
    # 3. and 4. The paper's pipeline
    given = None
    if settings.prior is not None:
        # Perspective images are right for the last fit, which has errors.
        given, settings = prior_start(table, settings, checked=settings.errors)
    if settings.start is not None:
        given = _started(table, settings, n_components)
    if given is None:
        isa, factors = clone(isa), factorised.factors
        shapes, covariance, n_iter, converged = run_paper_pipeline(
            factors.leading(3 * wanted), wanted, isa, settings, progress
        )
        if settings.all_directions:  # the start has a fixed number of basis shapes
            rigid = factors.rigid_motion.reshape(-1, 2, 3)
            images = factorised.W.reshape(len(rigid), 2, -1)
            shapes = lifted_shapes(images, rigid, n_components)
    else:
        isa, shapes = None, given.shapes
    # 5. Refinement, gauge and frames
    if settings.joint:
        fitted, frames, converged, attributes = _joint_fit(
            factorised, shapes, given, settings, wanted, progress
        )
        # Down-weighted outliers, for example, look like basis shapes at first.
        supported = max(n_reliable(attributes["reliability_"]), 1)
        falls = settings.free and not settings.all_directions
        if falls and supported < n_components:
            progress("gauge and coefficients")
            first = first._replace(known=None)
            return fit_table(table, supported, isa, first, NoProgress())
    else:
        fitted, frames, attributes = _paper_frames(
            table, factorised.factors, shapes, covariance, settings
        )
        attributes["n_iter_"] = n_iter
    # The mirror image in depth
    probability = settings.mirror_certainty
    if settings.hidden_points and not table.complete and settings.prior is None:
        probability = fitted.mirror_certainty(table.rows, frames)
        if probability < 0.5:
            probability = 1.0 - probability
            fitted, frames, attributes = mirror_image(fitted, frames, attributes)
    # 6. Measures of the fit
    attributes |= _measures(table, factorised, fitted, frames, settings)
    progress("gauge and coefficients")
    rows = (of_all_rows(part.astype(table.dtype), table.shown) for part in frames)
    sizes = of_all_rows(table.sizes, table.shown)
    attributes |= {"mirror_certainty_": probability, "isa_": isa, "_frame_sizes": sizes}
    return fitted, Decomposition(*rows), converged, attributes


def _joint_fit(
    factorised: FactorisedTable,
    shapes: NDArray,
    given: JointState | None,
    settings: FitSettings,
    n_components: int,
    progress: FitProgress | NoProgress,
) -> TableFit:
    """Return the joint fit from shapes, or a given state, or the consensus of groups.

    K coefficients are reported, or the relevant ones if they are free. Frames are those
    that are shown, some attributes are lacking.
    """
    table, settings = factorised.scaled, settings._replace(on_step=progress.step)
    args = factorised, shapes, given
    fit, tracks, alpha = settings.remembered("joint", fit_jointly, *args)
    settings = settings._replace(shape_prior=fit.prior)
    progress(JOINT_STAGE)
    (shapes, _, noise), starts, widths = fit.state, spread_starts(alpha, 8), fit.widths
    kind = settings.loss, FrameMap.identity(len(shapes) - 1), settings.camera
    model = FrameModel(shapes, noise, starts, *kind)
    errors, calibrated = settings.errors, settings.camera != "affine"
    if settings.free and widths is not None:
        n_components = min(widths.n_relevant, MOST_FIRST)
    grouped = settings.refinement == "consensus"
    if grouped:
        # A residual below the noise of the spectrum leaves nothing for groups.
        n_numbers, square = tracks.totals
        noise = factorised.noise_level(len(shapes) - 1) * square / n_numbers
        if widths is not None:  # whose noise is that of the other coordinates
            n_unknowns = widths.n_unknowns(len(table.sizes), settings.camera)
            noise *= n_numbers / (n_numbers - n_unknowns)
        grouped = fit.misfit > noise
    if (needed := errors and calibrated) and (
        not grouped or "certainty" in (settings.known or ())
    ):
        of = model, table.rows, table.weights, widths, fit.rivals
        certainty = settings.remembered("certainty", depth_certainty, *of)
        model, needed = replace(model, certainty=certainty), False
    if errors and widths is not None and not grouped:
        model, widths = bagged(model, table, settings, widths)
        tracks = JointFrames.from_points(table.rows, table.complete, table.weights)
    if grouped:
        model, widths = consensus(model, table, settings, needed, fit), None
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
        some = spread(np.arange(len(table.sizes)), 100)
        distance = left_out_distances(model, table.rows.take(some))
        attributes["_left_out"] = distance, np.flatnonzero(table.shown)[some]
    if (n_more := n_components + 1 - len(model.shapes)) > 0:
        # Coefficients beyond the directions that a table supports are zero.
        shapes = np.pad(model.shapes, ((0, n_more), (0, 0), (0, 0)))
        starts = np.pad(model.starts, ((0, 0), (0, n_more)))
        model = replace(model, shapes=shapes, starts=starts)
        widths = None if widths is None else widths.padded(n_more)
    fits = fitted_frames(model, tracks, table.rows)
    del tracks  # as much memory as the table
    fitted, frames, measures = _joint_frames(
        table, model, fits, settings, n_components, widths
    )
    if fit.prior is not None:
        attributes["prior_std_"] = np.array([fit.prior.distance, 0.0])
    if errors and calibrated:
        attributes["depth_uncertainty_"] = fitted.frames.certainty.total
    return fitted, frames, fit.converged, attributes | measures


@one_blas_thread
def supported_components(
    table: ScaledTable,
    isa: Any,
    settings: FitSettings,
    progress: FitProgress | NoProgress,
) -> int:
    """Return the number of relevant basis shapes of affine cameras, at most twelve."""
    possible = most_components(len(table.sizes), table.n_points, settings.camera)
    most = min(MOST_FIRST, possible)
    quiet = NoProgress()
    factorised = _factorised(table, most, settings, quiet)
    factors = factorised.factors
    shapes, *_ = run_paper_pipeline(factors, most, clone(isa), settings, quiet)
    progress("number of basis shapes")
    return count_components(factorised, shapes, settings)


def _factorised(
    table: ScaledTable,
    n_components: int,
    settings: FitSettings,
    report: Callable[[str], None],
) -> FactorisedTable:
    """Return a table with outliers (robust loss), completed frames and factors."""
    limits, n_points = settings.limits, table.n_points
    # Calibrated cameras can have more basis shapes than the factorisation.
    n_triplets = min(3 * n_components + 3, n_points - 1)
    n_components = min(n_components, largest_n_components(n_points))
    outliers, completed, complete = None, table.rows, table.complete
    if settings.loss != "linear":
        outliers = gross_outliers(table.rows, limits.model_frames)
        completed = table.rows.derive(rows_without, outliers)
        complete = complete and not outliers.any()
    if complete:  # kept, because the factorisation reads it up to ten times
        completed = completed.derive(np.asarray)
    else:
        most = limits.model_frames
        completed = complete_rows(completed, n_points, n_components, most)
    report("table")
    shape = 2 * len(table.sizes), n_points
    triplets = block_triplets(completed, shape, n_triplets, limits.dense)
    values, vectors, rest = triplets
    # With a prior there may be few frames.
    values = np.pad(values, (0, n_triplets - len(values)))
    if settings.joint:
        rigid, first = vectors[:3], limits.sample
        W, parts = sample_frames(completed, n_points, rigid, first, limits.small_table)
    else:
        W, parts = completed.whole().reshape(shape), []
    factors = factorise(W, n_components, table.precision, triplets)
    compressed = None
    few = max(24 * (n_components + 1), limits.many_points)
    if settings.joint and settings.prior is None and n_points > few:
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
    frames, (own, other) = model.frames, (model.unit, table.unit)
    # Frames have size one, unless all have one scale.
    unit = own / other if own and other else 1.0
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


def _paper_frames(
    table: ScaledTable,
    factors: Factorisation,
    shapes: NDArray,
    covariance: NDArray,
    s: FitSettings,
) -> tuple[TableModel, Decomposition, dict[str, Any]]:
    """Return model, frames and attributes of the paper's pipeline in its gauge."""
    if s.camera != "affine":
        scaled = s.camera == "weak_perspective"
        shapes = table.sizes[0] * rigid_start(factors, shapes, scaled)[1]

    def fitted(mean_shape: NDArray, basis: NDArray) -> TableModel:
        frames = FrameModel.rigid(mean_shape, basis, s.camera)
        K = len(basis)
        return TableModel(frames, mean_shape, basis, K, s.layout, table.unit)

    # Frames are fitted with the stored (rounded) shapes, so that transform agrees.
    def frames_for(mean_shape: NDArray, basis: NDArray) -> Any:
        decompose = partial(fitted(mean_shape, basis).decompose, dtype=np.float64)
        return table.source.joined(decompose)

    mean_shape, basis, order, frames = rigid_gauge(
        shapes[0].T, shapes[1:].mT, table.sizes, frames_for, s.camera, table.dtype
    )
    covariance = reorder_blocks(covariance, order)
    attributes = {"mode_covariance_": (table.unit or 1.0) ** 2 * covariance}
    return fitted(mean_shape, basis), frames, attributes


def _joint_frames(
    table: ScaledTable,
    model: FrameModel,
    fits: FrameFits,
    s: FitSettings,
    n_components: int,
    widths: Widths | None,
) -> tuple[TableModel, Decomposition, dict[str, Any]]:
    """Return model, frames and attributes of fits in the independent gauge.

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
        mean_shape, basis, gauge = independent_gauge(model.shapes, motion, alpha, *kind)
    else:
        gauge = prior.gauge
        mean_shape, basis = gauge.public(model.shapes)
    weight = table.n_seen if table.weights is None else table.weights.sum(axis=1)
    share, slices = weight / table.n_points, posteriors.slices
    prior_moments = covariance
    if widths is not None:  # as in `MarginalLikelihood`
        penalty = model.noise_variance / (widths.variances * len(motion))
        prior_moments = covariance + np.diag(penalty)
    information = shape_information(motion, alpha, prior_moments, share, slices)
    if prior is None:
        uncertainty = np.linalg.pinv(information, hermitian=True)
        attributes["_halves"] = half_tables(
            table, model, motion, alpha, uncertainty, s.groups, kind
        )
    else:
        uncertainty = prior.inverse(information[None], noise)[0]
    known = prior or widths
    unknowns = float(model.shapes.size) if known is None else known.n_determined
    certainty = frame_certainty(model, fits, table.n_seen, weight, unknowns)
    certainty = certainty._replace(weighted=table.weights is not None)
    model = replace(model, gauge=gauge, certainty=certainty)
    last_pass = partial(shown_frames, frames=model, uncertainty=uncertainty)
    passes = posteriors.map(last_pass, table.sizes, table.n_seen, weight)
    parts, moments, noises = zip(*passes, strict=True)
    frames = Decomposition(*map(np.concatenate, zip(*parts, strict=True)))
    mean_shape, basis = mean_shape.astype(table.dtype), basis.astype(table.dtype)
    cameras = frames.motion / table.sizes[:, None, None]
    if prior is not None:
        sight = line_of_sight(cameras)
        errors = prior.depth_errors(information, noise, sight, frames.alpha)
        depths = np.vecdot(compose(mean_shape, basis, frames.alpha), sight[:, None])
        model = replace(model, certainty=certainty.of_prior(errors, depths))
    square = (table.unit or 1.0) ** 2
    attributes |= {
        "mode_covariance_": square
        * mode_covariance(cameras, frames.alpha[:, :n_components]),
        "noise_variance_": square * noise,
        "reliability_": reliabilities(alpha, covariance, sum(moments), sum(noises))[
            :n_components
        ],
    }
    frames = frames._replace(translation=frames.translation + table.translation)
    fitted = TableModel(model, mean_shape, basis, n_components, s.layout, table.unit)
    return fitted, frames, attributes


def _measures(
    table: ScaledTable,
    factorised: FactorisedTable,
    model: TableModel,
    frames: Decomposition,
    settings: FitSettings,
) -> dict[str, Any]:
    """Return the attributes that describe any fit, by name."""
    mean_shape, basis, K = model.mean_shape, model.basis, model.n_components
    values = factorised.singular_values
    cameras = frames.motion / table.sizes[:, None, None]
    energy = image_energies(cameras, basis, frames.alpha)
    position = (frames.translation - table.translation) / table.sizes[:, None]
    shapes = np.concatenate([mean_shape[None], basis]).mT
    error = reprojection_error(table.rows, shapes, cameras, position, frames.alpha)
    reference = mean_camera(frames, table.sizes, settings.camera)
    return {
        "mean_shape_": mean_shape,
        "basis_": basis[:K],
        "rank_floor_": factorised.rest_share(3 * K + 3),
        "singular_values_": (table.unit or 1.0) * values[: 3 * K + 3],
        "energy_share_": energy[:K] / (energy.sum() or 1.0),
        "inverse_snr_": error,
    } | {name: value.astype(table.dtype) for name, value in reference.items()}


def mean_camera(frames: Decomposition, sizes: NDArray, camera: str) -> dict[str, Any]:
    """Return the attributes of the mean view of frames of some sizes (n,)."""
    reference = reference_camera(frames.motion / sizes[:, None, None], sizes)
    if camera != "affine":
        (row,), (scale,) = nearest_calibrated(reference[None])
        reference = scale * row
    centre = frames.translation.mean(axis=0)
    return {"reference_motion_": reference, "reference_translation_": centre}


def mirror_image(
    model: TableModel, frames: Decomposition, attributes: dict[str, Any]
) -> tuple[TableModel, Decomposition, dict[str, Any]]:
    """Return the mirror image in depth of a fit."""
    attributes = attributes | model.mirrored_attributes(attributes)
    frames = frames._replace(motion=frames.motion * MIRROR)
    return attributes.pop("_model"), frames, attributes
