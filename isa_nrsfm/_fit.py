"""The stages of a fit, in order: from a table to the attributes of an estimator.

1. The table is checked, scaled and, where points are missing, completed.
2. Factorisation of the measurement matrix, of the frames of a sample if there are many.
3. and 4. The paper's pipeline: independent subspaces, then block structure and
   refinement. With the joint refinement its result is only a start.
5. The joint refinement, and the consensus of groups of points with
   `refinement="consensus"`; or the frames of the paper.
6. Measures of the fit.

Stages 1, 5 and 6 use all frames, the other stages those of the sample.
"""

import copy
import warnings
from collections.abc import Callable, Sequence
from dataclasses import replace
from functools import partial
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from sklearn.base import clone
from sklearn.exceptions import ConvergenceWarning

from isa_nrsfm._compat.blas_threads import one_blas_thread
from isa_nrsfm._compat.callbacks import FitProgress, NoProgress
from isa_nrsfm._compat.caller import warn_caller
from isa_nrsfm._diagnostics import LEAST_RELIABILITY, reliabilities
from isa_nrsfm._fitted_model import TableModel
from isa_nrsfm._frames.camera_models import nearest_calibrated, reference_camera
from isa_nrsfm._frames.depth import leverages
from isa_nrsfm._frames.models import (
    Decomposition,
    FrameMap,
    PosteriorFrames,
    RigidFrames,
    spread_starts,
)
from isa_nrsfm._frames.projection import reprojection_error
from isa_nrsfm._gauge.canonical import (
    image_energies,
    mode_covariance,
    reorder_blocks,
    rigid_gauge,
)
from isa_nrsfm._gauge.independent import independent_gauge
from isa_nrsfm._joint.consensus import MOST_COMPONENTS, MOST_FIRST, consensus
from isa_nrsfm._joint.fit import Start, count_components, fit_jointly
from isa_nrsfm._joint.frames import JointFrames
from isa_nrsfm._joint.jackknife import depth_certainty
from isa_nrsfm._joint.problem import FactorisedTable, JointOptions, JointSettings
from isa_nrsfm._joint.sample_posterior import (
    posterior_blocks,
    posterior_moments,
    shape_uncertainty,
    shown_frames,
)
from isa_nrsfm._joint.starts import rigid_start
from isa_nrsfm._paper.factors import (
    DENSE,
    Factorisation,
    block_triplets,
    factorise,
    sample_frames,
)
from isa_nrsfm._paper.pipeline import PaperResult, run_paper_pipeline
from isa_nrsfm._parameters.choices import JOINT_REFINEMENTS
from isa_nrsfm._prepare.checks import largest_n_components, most_components
from isa_nrsfm._prepare.completion import complete_rows
from isa_nrsfm._prepare.robust import gross_outliers
from isa_nrsfm._prepare.scaling import ScaledTable, rows_without, scaled_table
from isa_nrsfm._tables.blocks import FrameBlocks
from isa_nrsfm._tables.tracks import of_all_rows
from isa_nrsfm._transformer import TableTransformer

JOINT_STAGE = "joint refinement"
CONSENSUS_STAGE = "consensus of groups of points"
# Stages that report steps.
STEPWISE = JOINT_STAGE, CONSENSUS_STAGE
# Default tolerances. JOINT_TOL: decrease of the objective of the joint refinement per
# frame. PAPER_TOL: gain of the paper's refinement, as a share of the explained energy.
JOINT_TOL, PAPER_TOL = 0.025, 1e-10


class Limits(NamedTuple):
    """Numbers that tests and benchmarks vary.

    dense: a table with more points and rows of images is not factorised as a whole.
    sample: number of frames of the first sample of a large table.
    small_table: tables with fewer coordinates are fitted without a sample.
    model_frames: most frames from which outliers and missing points are modelled.
    """

    dense: int = DENSE
    sample: int = 600
    small_table: int = 150_000
    model_frames: int = 5_000
    joint: JointOptions = JointOptions()


def stages_of(refinement: str | None) -> list[str]:
    """Return the names of the stages of a fit, in order."""
    stages = ["table", "factorisation"]
    stages += ["independent subspaces", "block structure and refinement"]
    if refinement in JOINT_REFINEMENTS:
        stages.append(JOINT_STAGE)
    if refinement == "consensus":
        stages.append(CONSENSUS_STAGE)
    return [*stages, "gauge and coefficients"]


def fit_table(
    estimator: TableTransformer,
    source: FrameBlocks,
    progress: FitProgress,
    weights: NDArray | None = None,
) -> Decomposition:
    """Fit a table, and set the attributes of an estimator.

    Its parameters are checked, and its `isa_` is the unfitted strategy. Weights are
    (n_rows, J). Returns the fit of all rows, NaN for rows without visible points.
    """
    n_components = estimator.n_components
    if n_components == "auto":
        n_components = _count_components(estimator, source, weights)
    table = ready_table(estimator, source, n_components, weights)
    return fit_ready_table(estimator, table, n_components, progress, errors=True)


@one_blas_thread
def fit_ready_table(
    estimator: TableTransformer,
    table: ScaledTable,
    n_components: int,
    progress: FitProgress | NoProgress,
    starts: Sequence[Start] = (),
    errors: bool = False,
) -> Decomposition:
    """Fit a checked and scaled table, as `fit_table`; estimate errors on demand."""
    # 1. and 2. The rest of the table, and its factorisation
    wanted = n_components
    if estimator.refinement == "consensus":
        n_components = min(n_components, MOST_FIRST)
    factorised = _factorised(estimator, table, n_components, progress)
    factors = factorised.factors
    # 3. and 4. The paper's pipeline
    if starts:
        estimator.isa_, paper = None, None
    else:
        paper = _paper_result(estimator, factors, n_components, progress)
    # 5. Refinement, gauge and frames
    if estimator._is_joint:
        shapes = starts[0].shapes if paper is None else paper.shapes
        settings = _joint_settings(estimator, progress.step)
        fitted, tracks, alpha = fit_jointly(factorised, shapes, settings, starts)
        model = _frame_model(estimator, fitted.state.shapes, fitted.state.noise, alpha)
        progress(JOINT_STAGE)
        if errors and estimator.camera != "affine":
            certainty = depth_certainty(model, table.rows, table.weights)
            model = replace(model, certainty=certainty)
            estimator.depth_uncertainty_ = model.certainty.total
        if estimator.refinement == "consensus":
            # A residual below the noise of the spectrum leaves nothing for groups.
            n_numbers, square = tracks.totals
            share = factorised.noise_level(n_components)
            if wanted > n_components or fitted.left > share * square / n_numbers:
                model = _consensus_model(estimator, table, model, settings, wanted)
                tracks = JointFrames.from_points(table.rows, table.complete)
            progress(CONSENSUS_STAGE)
        frames = _joint_frames(estimator, table, model, tracks)
        estimator.camera_noise_ratio_ = fitted.camera_noise_ratio
        estimator.objective_history_ = fitted.history
        estimator.gradient_norm_ = fitted.gradient_norm
        estimator.n_iter_ = len(fitted.history) - 1
        converged = fitted.converged
    else:
        assert paper is not None
        frames = _paper_frames(estimator, table, factors, paper)
        converged = paper.converged
    if not converged:
        warn_caller(
            f"the refinement did not converge in max_iter={estimator.max_iter} steps; "
            "increase max_iter or tol",
            ConvergenceWarning,
        )
    # 6. Measures of the fit
    unit, fit = table.unit or 1.0, estimator._model
    estimator.mean_shape_, estimator.basis_ = fit.mean_shape, fit.basis
    estimator.camera_, estimator._n_features_out = estimator.camera, len(fit.basis)
    estimator.rank_floor_ = factorised.rest_share
    estimator.singular_values_ = unit * factorised.singular_values
    estimator.mode_covariance_ *= unit**2
    cameras = frames.motion / table.sizes[:, None, None]
    energy = image_energies(cameras, fit.basis, frames.alpha)
    estimator.energy_share_ = energy / (energy.sum() or 1.0)
    estimator.inverse_snr_ = reprojection_error(
        table.rows,
        np.concatenate([fit.mean_shape[None], fit.basis]).transpose(0, 2, 1),
        cameras,
        (frames.translation - table.translation) / table.sizes[:, None],
        frames.alpha,
    )
    reference = reference_camera(cameras, table.sizes)
    if estimator.camera != "affine":
        (row,), (scale,) = nearest_calibrated(reference[None])
        reference = scale * row
    estimator.reference_motion_ = reference.astype(table.dtype)
    centre = frames.translation.mean(axis=0)
    estimator.reference_translation_ = centre.astype(table.dtype)
    if estimator.keep_frames:
        estimator._frame_sizes = of_all_rows(table.sizes, table.shown)
    progress("gauge and coefficients")
    return Decomposition(
        *(of_all_rows(each.astype(table.dtype), table.shown) for each in frames)
    )


@one_blas_thread
def _count_components(
    estimator: TableTransformer, source: FrameBlocks, weights: NDArray | None
) -> int:
    """Return the number of basis shapes that a table supports, of at most twelve."""
    with warnings.catch_warnings(action="ignore"):  # the fit itself warns again
        table = ready_table(estimator, source, 1, weights)
    possible = most_components(len(table.sizes), table.n_points, estimator.camera)
    most = min(12, possible)
    trial = copy.copy(estimator)
    trial.refinement = "joint"
    factorised = _factorised(trial, table, most, NoProgress())
    paper = _paper_result(trial, factorised.factors, most, NoProgress())
    found = count_components(factorised, paper.shapes, _joint_settings(estimator))
    # Down-weighted outliers look like basis shapes: fit again with the final weights.
    while found > 1 and estimator.loss != "linear":
        trial = copy.copy(trial)
        with warnings.catch_warnings(action="ignore"):
            fit_ready_table(trial, table, found, NoProgress())
        n_supported = int(np.sum(trial.reliability_ >= LEAST_RELIABILITY))
        if n_supported == found:
            break
        found = max(n_supported, 1)
    # A consensus has more components.
    if found == most and estimator.refinement != "consensus":
        warn_caller(
            f"all {most} basis shapes that were tried are relevant: more than "
            f"n_components={most} may be needed for this table"
        )
    return found


@one_blas_thread
def ready_table(
    estimator: TableTransformer,
    source: FrameBlocks,
    n_components: int,
    weights: NDArray | None = None,
) -> ScaledTable:
    """Return a table centred, scaled and checked for fits of at most K basis shapes."""
    return scaled_table(
        source,
        n_components,
        layout=estimator.layout,
        names=getattr(estimator, "feature_names_in_", None),
        scale_frames=estimator.frames_scaled_,
        robust=estimator.loss != "linear",
        camera=joint_camera(estimator),
        weights=weights,
    )


def joint_camera(estimator: TableTransformer) -> str | None:
    """Return the camera model of the joint refinement, None without it."""
    return estimator.camera if estimator._is_joint else None


def joint_tol(estimator: TableTransformer) -> float:
    """Return the tolerance of the joint refinement."""
    return JOINT_TOL if estimator.tol is None else estimator.tol


def _joint_settings(
    estimator: TableTransformer, on_step: Callable[[], None] | None = None
) -> JointSettings:
    """Return the settings of the joint refinement."""
    return JointSettings(
        estimator.camera,
        estimator.loss,
        estimator.max_iter,
        joint_tol(estimator),
        on_step,
        estimator._limits.joint,
    )


def _factorised(
    estimator: TableTransformer,
    table: ScaledTable,
    n_components: int,
    report: Callable[[str], None],
) -> FactorisedTable:
    """Return a table with outliers (robust loss), completed frames and factors."""
    limits, n_points = estimator._limits, table.n_points
    # Calibrated cameras can have more basis shapes than the factorisation.
    n_triplets = min(3 * n_components + 3, n_points - 1)
    n_components = min(n_components, largest_n_components(n_points))
    outliers, completed, complete = None, table.rows, table.complete
    if estimator.loss != "linear":
        outliers = gross_outliers(table.rows, limits.model_frames)
        completed = table.rows.derive(rows_without, outliers)
        complete = complete and not outliers.any()
    if not complete:
        most = limits.model_frames
        completed = complete_rows(completed, n_points, n_components, most)
    report("table")
    shape = 2 * len(table.sizes), n_points
    triplets = block_triplets(completed, shape, n_triplets, limits.dense)
    singular_values, vectors, rest = triplets
    if estimator._is_joint:
        rigid, first = vectors[:3], limits.sample
        W, parts = sample_frames(completed, n_points, rigid, first, limits.small_table)
    else:
        W, parts = completed.whole().reshape(shape), []
    factors = factorise(W, n_components, table.precision, triplets)
    report("factorisation")
    return FactorisedTable(
        table.rows,
        completed,
        table.n_seen,
        outliers,
        singular_values,
        rest,
        W,
        parts,
        factors,
        table.weights,
    )


def _paper_result(
    estimator: TableTransformer,
    factors: Factorisation,
    n_components: int,
    report: Callable[[str], None],
) -> PaperResult:
    """Return the result of the paper's pipeline, and set the fitted strategy."""
    estimator.isa_ = clone(estimator.isa_)
    max_iter = estimator.max_iter if estimator.refinement else 0
    tol = PAPER_TOL if estimator.tol is None else estimator.tol
    with warnings.catch_warnings():
        if estimator._is_joint:  # it only starts from this result
            max_iter, tol = 200, 1e-5
            if estimator.isa is None:
                message = "PooledFastICA did not"
                warnings.filterwarnings("ignore", message, ConvergenceWarning)
        return run_paper_pipeline(
            factors,
            n_components,
            estimator.isa_,
            block_recovery=estimator.block_recovery,
            max_iter=max_iter,
            tol=tol,
            report=report,
        )


def _paper_frames(
    estimator: TableTransformer,
    table: ScaledTable,
    factors: Factorisation,
    paper: PaperResult,
) -> Decomposition:
    """Return the frames of the paper's pipeline in its gauge, and set the model."""
    shapes = paper.shapes
    if estimator.camera != "affine":
        scaled = estimator.camera == "weak_perspective"
        shapes = table.sizes[0] * rigid_start(factors, shapes, scaled)[1]

    def fitted(mean_shape: NDArray, basis: NDArray) -> TableModel:
        frames = RigidFrames(mean_shape, basis, estimator.camera)
        return TableModel(frames, mean_shape, basis, estimator.layout, table.unit)

    # Frames are fitted with the stored (rounded) shapes, so that transform agrees.
    gauge, frames = rigid_gauge(
        shapes[0].T,
        shapes[1:].transpose(0, 2, 1),
        table.sizes,
        lambda mean_shape, basis: table.source.joined(
            partial(fitted(mean_shape, basis).decompose, dtype=np.float64)
        ),
        camera=estimator.camera,
        dtype=table.dtype,
    )
    estimator._model = fitted(gauge.mean_shape, gauge.basis)
    estimator.mode_covariance_ = reorder_blocks(paper.mode_covariance, gauge.order)
    estimator.n_iter_ = paper.n_iter
    return frames


def _frame_model(
    estimator: TableTransformer, shapes: NDArray, noise: float, alpha: NDArray
) -> PosteriorFrames:
    """Return the model of a frame for shapes (K + 1, 3, J), before the gauge."""
    return PosteriorFrames(
        shapes,
        noise,
        spread_starts(alpha, 8),
        estimator.loss,
        FrameMap.identity(len(shapes) - 1),
        estimator.camera,
    )


def _consensus_model(
    estimator: TableTransformer,
    table: ScaledTable,
    model: PosteriorFrames,
    settings: JointSettings,
    n_components: int,
) -> PosteriorFrames:
    """Return the consensus of groups of points, with the errors of the depths."""
    wanted = None if estimator.n_components == "auto" else n_components
    most = most_components(len(table.sizes), table.n_points, estimator.camera)
    most = min(most, MOST_COMPONENTS)
    shapes, noise, alpha, variances = consensus(
        model, table.rows, settings, wanted, most, estimator.n_jobs
    )
    # If the object hardly turns, groups share the errors of the depths.
    certainty = model.certainty
    if variances is not None and certainty.determined:
        certainty = certainty._replace(points=variances, leverage=1.0)
    model = _frame_model(estimator, shapes, noise, alpha)
    return replace(model, certainty=certainty)


def _joint_frames(
    estimator: TableTransformer,
    table: ScaledTable,
    frames: PosteriorFrames,
    tracks: JointFrames,
) -> Decomposition:
    """Return the frames of a joint fit in the independent gauge, and set the model."""
    shapes = frames.shapes
    posteriors = posterior_blocks(frames, tracks, table.rows)
    motion, alpha, covariance = posterior_moments(posteriors)
    unknown = np.isnan(motion).any(axis=(1, 2))
    if unknown.any():
        row = np.flatnonzero(table.shown)[unknown.argmax()]
        raise ValueError(
            f"the visible points of {unknown.sum()} of {len(unknown)} frames (first: "
            f"row {row}) are coplanar, which does not determine a camera. Leave out "
            "these rows"
        )
    # Gauge of shapes, cameras and coefficients
    gauge, frame_map = independent_gauge(
        shapes,
        motion,
        alpha,
        estimator.independence,
        estimator.camera,
        table.unit if estimator.camera == "orthographic" else None,
    )
    certainty = frames.certainty
    if certainty.leverage is not None:  # of coefficients from the images
        certainty = certainty._replace(leverage=float(leverages(alpha).mean()))
    frames = replace(frames, gauge=frame_map, certainty=certainty)
    weight = table.weight
    share = weight / table.n_points
    uncertainty = shape_uncertainty(motion, alpha, covariance, share, posteriors.slices)
    last_pass = partial(shown_frames, frames=frames, uncertainty=uncertainty)
    parts, *chance = zip(
        *posteriors.map(last_pass, table.sizes, table.n_seen, weight), strict=True
    )
    shown = Decomposition(*map(np.concatenate, zip(*parts, strict=True)))
    mean_shape, basis = (each.astype(table.dtype) for each in gauge[:2])
    estimator._model = TableModel(
        frames, mean_shape, basis, estimator.layout, table.unit
    )
    cameras = shown.motion / table.sizes[:, None, None]
    estimator.mode_covariance_ = mode_covariance(cameras, shown.alpha)
    estimator.noise_variance_ = (table.unit or 1.0) ** 2 * frames.noise_variance
    estimator.reliability_ = reliabilities(
        alpha, covariance, *(sum(part) for part in chance)
    )
    return shown._replace(translation=shown.translation + table.translation)
