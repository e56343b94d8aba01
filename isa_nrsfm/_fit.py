"""The stages of a fit, in order: from a table to a fitted model.

1. The table is checked, scaled and, where points are missing, completed.
2. Factorisation of the measurement matrix, of the frames of a sample if there are many.
3. and 4. The paper's pipeline: independent subspaces, then block structure and
   refinement. With the joint refinement its result is only a start.
5. The joint refinement, with `refinement="joint"`.
6. Gauge, and camera and coefficients of every frame.

The first and the last stage use all frames. So do the last steps of the joint
refinement. All others use the frames of the sample.
"""

import warnings
from collections.abc import Callable, Sequence
from dataclasses import replace
from functools import partial
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray
from sklearn.base import clone
from sklearn.exceptions import ConvergenceWarning

from isa_nrsfm._compat.blas_threads import one_blas_thread
from isa_nrsfm._compat.callbacks import FitProgress, NoProgress
from isa_nrsfm._compat.caller import warn_caller
from isa_nrsfm._diagnostics import LEAST_RELIABILITY, reliabilities
from isa_nrsfm._fit_options import PAPER_TOL, FitOptions
from isa_nrsfm._fitted_model import TableModel
from isa_nrsfm._frames.basis_change import FrameMap
from isa_nrsfm._frames.camera import reference_camera
from isa_nrsfm._frames.camera_models import nearest_calibrated
from isa_nrsfm._frames.models import Decomposition, PosteriorFrames, RigidFrames
from isa_nrsfm._frames.posterior import spread_starts
from isa_nrsfm._frames.projection import reprojection_error
from isa_nrsfm._gauge.canonical import (
    image_energies,
    mode_covariance,
    reorder_blocks,
)
from isa_nrsfm._gauge.independent import independent_gauge
from isa_nrsfm._gauge.rigid import rigid_gauge
from isa_nrsfm._joint.fit import Start, count_components, fit_jointly
from isa_nrsfm._joint.problem import FactorisedTable, JointSettings
from isa_nrsfm._joint.sample_posterior import (
    certainty_of,
    posterior_blocks,
    posterior_moments,
    shape_uncertainty,
    shown_frames,
)
from isa_nrsfm._joint.starts import rigid_start
from isa_nrsfm._paper.factors import Factorisation, factorise
from isa_nrsfm._paper.pipeline import PaperResult, run_paper_pipeline
from isa_nrsfm._paper.sample import Sample, sample_frames
from isa_nrsfm._paper.svd import block_triplets
from isa_nrsfm._prepare.checks import largest_n_components, most_for_frames
from isa_nrsfm._prepare.completion import complete_rows
from isa_nrsfm._prepare.robust import outliers_of_table
from isa_nrsfm._prepare.scaling import ScaledTable, rows_without, scaled_table
from isa_nrsfm._tables.sources import Table

# Reported only with the joint refinement.
JOINT_STAGE = "joint refinement"
STAGES = (
    "table",
    "factorisation",
    "independent subspaces",
    "block structure and refinement",
    JOINT_STAGE,
    "gauge and coefficients",
)


class JointNumbers(NamedTuple):
    """
    Results of the joint refinement alone.

    They become public attributes of the same names with an underscore.
    """

    noise_variance: float
    camera_noise_ratio: float
    depth_uncertainty: float
    reliability: NDArray
    objective_history: NDArray
    gradient_norm: float


class Refined(NamedTuple):
    """
    The fitted model and the fit of the frames, without error and energies.

    Attributes
    ----------
    model : TableModel
        The fitted model, in the gauge.
    frames : Decomposition
        The fit of the frames of the table.
    mode_covariance : ndarray of shape (3 * n_components, 3 * n_components)
        As of `AffineNRSfM`.
    n_iter : int
        Number of steps of the last refinement.
    converged : bool
        Whether the refinement has converged.
    numbers : JointNumbers or None
        None for the paper's refinement.
    """

    model: TableModel
    frames: Decomposition
    mode_covariance: NDArray
    n_iter: int
    converged: bool
    numbers: JointNumbers | None


class Fit(NamedTuple):
    """
    Result of a fit.

    Attributes
    ----------
    model : TableModel
        The fitted model.
    unit : float
        The one size of all frames, 1 where each has its own.
    frames : Decomposition
        The fit of all rows of the table; NaN for rows that show nothing.
    frame_sizes : ndarray of shape (n_rows,)
        What the frames were divided by.
    isa : object
        The fitted strategy.
    numbers : JointNumbers or None
        What only the joint refinement tells.
    inverse_snr, rank_floor, singular_values, mode_covariance, energy_share, n_iter
        As of `AffineNRSfM`.
    reference_motion, reference_translation : ndarray of shape (2, 3) and (2,)
        As of `AffineNRSfM`.
    """

    model: TableModel
    unit: float
    frames: Decomposition
    frame_sizes: NDArray
    isa: Any
    numbers: JointNumbers | None
    inverse_snr: float
    rank_floor: float
    singular_values: NDArray
    mode_covariance: NDArray
    energy_share: NDArray
    n_iter: int
    reference_motion: NDArray
    reference_translation: NDArray

    @property
    def n_supported(self) -> int:
        """Number of reliable directions of the coefficients, after the joint fit."""
        found = () if self.numbers is None else self.numbers.reliability
        return int(np.sum(np.asarray(found) >= LEAST_RELIABILITY))


def fit_table(
    source: Table, n_components: Any, options: FitOptions, progress: FitProgress
) -> Fit:
    """
    Fit a table.

    Parameters
    ----------
    source : Table
        The table.
    n_components : int or "auto"
        K.
    options : FitOptions
        How the table is fitted.
    progress : FitProgress
        Called after each stage, and before each step of the joint refinement.

    Returns
    -------
    Fit
        The fitted model, the fit of the frames, and measures of the fit.
    """
    if n_components == "auto":
        n_components = _count_components(source, options)
    table = ready_table(source, n_components, options)
    return fit_ready_table(table, n_components, options, progress)


@one_blas_thread
def fit_ready_table(
    table: ScaledTable,
    n_components: int,
    options: FitOptions,
    progress: FitProgress | NoProgress,
    starts: Sequence[Start] = (),
) -> Fit:
    """
    Fit a table that is ready.

    Parameters
    ----------
    table : ScaledTable
        The table, checked and scaled.
    n_components : int
        K.
    options : FitOptions
        How the table is fitted.
    progress : FitProgress or NoProgress
        As of `fit_table`.
    starts : sequence of Start, default=()
        Where the fit starts, with the joint refinement. Otherwise it searches for
        starts, and the result of the paper's pipeline is one of them.

    Returns
    -------
    Fit
        The fit; with `starts` its strategy `isa` is None.
    """
    # 1. The rest of the table
    unit = 1.0 if options.scale_frames else float(table.sizes[0])
    # 2. Factorisation
    factorised = _factorised(table, n_components, options, progress)
    triplets, factors = factorised.triplets, factorised.factors
    # 3. and 4. The paper's pipeline
    isa, paper = None, None
    if not starts:
        isa, paper = _paper_result(factors, n_components, options, progress)
    # 5. Joint refinement
    if paper is None or options.joint:
        shapes = starts[0].shapes if paper is None else paper.shapes
        refined = _refined_jointly(
            table, factorised, shapes, starts, options, unit, progress
        )
    else:
        refined = _refined_by_paper(table, factors, paper, options, unit)
    if not refined.converged:
        warn_caller(
            f"the refinement did not converge in max_iter={options.max_iter} steps; "
            "increase max_iter or tol",
            ConvergenceWarning,
        )
    # 6. Measures of the fit; the gauge is taken at the end of the refinement
    cameras = refined.frames.motion / table.sizes[:, None, None]
    energy = image_energies(cameras, refined.model.basis, refined.frames.alpha)
    fit = Fit(
        model=refined.model,
        unit=unit,
        frames=Decomposition(
            *(table.of_all_rows(each.astype(table.dtype)) for each in refined.frames)
        ),
        frame_sizes=table.of_all_rows(table.sizes),
        isa=isa,
        numbers=refined.numbers,
        inverse_snr=_inverse_snr(table, refined, cameras),
        rank_floor=triplets.rest_share,
        singular_values=unit * triplets.values,
        mode_covariance=unit**2 * refined.mode_covariance,
        energy_share=energy / (energy.sum() or 1.0),
        n_iter=refined.n_iter,
        reference_motion=_reference(cameras, table, options.camera),
        reference_translation=refined.frames.translation.mean(axis=0).astype(
            table.dtype
        ),
    )
    progress("gauge and coefficients")
    return fit


@one_blas_thread
def _count_components(source: Table, options: FitOptions) -> int:
    """Return the number of basis shapes that a table supports."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # the fit itself warns again
        table = ready_table(source, 1, options)
    most = largest_n_components(table.n_points)
    most = min(options.limits.most_components, most, most_for_frames(len(table.sizes)))
    factorised = _factorised(table, most, options, NoProgress())
    _, paper = _paper_result(factorised.factors, most, options, NoProgress())
    found = count_components(factorised, paper.shapes, _joint_settings(options))
    # Outliers that count a little look like shapes: a fit with final weights decides.
    while found > 1 and options.loss != "linear":
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            fit = fit_ready_table(table, found, options, NoProgress())
        if fit.n_supported == found:
            break
        found = max(fit.n_supported, 1)
    if found == most:
        warn_caller(
            f"all {most} basis shapes that were tried are relevant: the table may "
            f"ask for more than n_components={most}"
        )
    return found


@one_blas_thread
def ready_table(source: Table, n_components: int, options: FitOptions) -> ScaledTable:
    """
    Return a table checked, centred and scaled.

    Parameters
    ----------
    source : Table
        The table.
    n_components : int
        The largest K that it has to be large enough for.
    options : FitOptions
        How the table is fitted.

    Returns
    -------
    ScaledTable
        The table, ready for `fit_ready_table`.
    """
    return scaled_table(
        source,
        n_components,
        layout=options.layout,
        names=options.names,
        scale_frames=options.scale_frames,
        robust=options.loss != "linear",
    )


def _factorised(
    table: ScaledTable,
    n_components: int,
    options: FitOptions,
    report: Callable[[str], None],
) -> FactorisedTable:
    """Return a table with outliers, completed frames, sample and factors.

    Outliers are looked for with a robust loss only. They count as missing points.
    """
    outliers, used, complete = None, table.rows, table.complete
    limits, n_points = options.limits, table.n_points
    if options.loss != "linear":
        outliers = outliers_of_table(table.rows, n_points, limits.outliers)
        used = table.rows.derive(rows_without, outliers)
        complete = complete and not outliers.any()
    if not complete:
        used = complete_rows(used, n_points, n_components, limits.completion)
    report("table")
    shape = 2 * len(table.sizes), n_points
    triplets = block_triplets(used, shape, 3 * n_components + 3, limits.dense)
    if options.joint:
        sample = sample_frames(
            used, n_points, triplets.vectors[:3], limits.sample, limits.small_table
        )
    else:
        sample = Sample(used.whole().reshape(shape), [])
    factors = factorise(sample.W, n_components, table.precision, triplets)
    report("factorisation")
    return FactorisedTable(
        table.rows, used, table.n_seen, outliers, triplets, sample, factors
    )


def _joint_settings(
    options: FitOptions, on_step: Callable[[], None] | None = None
) -> JointSettings:
    """Return how the joint refinement fits a table."""
    return JointSettings(
        options.camera,
        options.loss,
        options.max_iter,
        options.joint_tol,
        on_step,
        options.limits.joint,
    )


def _paper_result(
    factors: Factorisation,
    n_components: int,
    options: FitOptions,
    report: Callable[[str], None],
) -> tuple[Any, PaperResult]:
    """Return the fitted strategy and what the paper's pipeline finds with it."""
    # A clone: the options stay as they are, also where K is looked for first.
    isa, joint, limits = clone(options.isa), options.joint, options.limits
    tol = PAPER_TOL if options.tol is None else options.tol
    with warnings.catch_warnings():
        if joint and options.default_isa:
            # The joint refinement only starts from this result.
            warnings.filterwarnings("ignore", "FastICA did not", ConvergenceWarning)
        result = run_paper_pipeline(
            factors,
            n_components,
            isa,
            block_recovery=options.block_recovery,
            refinement="alternating" if joint else options.refinement,
            max_iter=limits.start_steps if joint else options.max_iter,
            tol=limits.start_tol if joint else tol,
            report=report,
        )
    return isa, result


def _refined_by_paper(
    table: ScaledTable,
    factors: Factorisation,
    paper: PaperResult,
    options: FitOptions,
    unit: float,
) -> Refined:
    """Return the model and the frames of the paper's pipeline."""
    shapes = paper.shapes
    if options.camera != "affine":
        scaled = options.camera == "weak_perspective"
        shapes = table.sizes[0] * rigid_start(factors, shapes, scaled)[1]
    source = table.source._replace(dtype=np.float64)

    def model(mean_shape: NDArray, basis: NDArray) -> TableModel:
        frames = RigidFrames(mean_shape, basis, options.camera)
        return _model(frames, mean_shape, basis, options, unit)

    # Frames are fitted with the stored (rounded) shapes, so that transform agrees.
    gauge = rigid_gauge(
        shapes[0].T,
        shapes[1:].transpose(0, 2, 1),
        table.sizes,
        lambda mean_shape, basis: model(mean_shape, basis).decompose(source),
        camera=options.camera,
        dtype=table.dtype,
    )
    return Refined(
        model(gauge.mean_shape, gauge.basis),
        gauge.frames,
        reorder_blocks(paper.mode_covariance, gauge.order),
        paper.n_iter,
        paper.converged,
        None,
    )


def _refined_jointly(
    table: ScaledTable,
    factorised: FactorisedTable,
    paper_shapes: NDArray,
    starts: Sequence[Start],
    options: FitOptions,
    unit: float,
    progress: FitProgress | NoProgress,
) -> Refined:
    """Return the shapes of the joint refinement, and their fit of the frames."""
    fitted, fitted_frames, alpha = fit_jointly(
        factorised, paper_shapes, _joint_settings(options, progress.step), starts
    )
    shapes, _, noise_variance = fitted.state
    progress(JOINT_STAGE)
    # Posterior of every frame
    frames = PosteriorFrames(
        shapes,
        noise_variance,
        spread_starts(alpha, options.limits.n_starts),
        options.loss,
        FrameMap.identity(len(paper_shapes) - 1),
        options.camera,
    )
    if options.camera != "affine":
        frames = replace(frames, certainty=certainty_of(frames, table.rows))
    posteriors = posterior_blocks(frames, fitted_frames, table.rows)
    motion, alpha, covariance = posterior_moments(posteriors)
    _check_determined(motion, table.shown)
    # Gauge of shapes, cameras and coefficients
    gauge = independent_gauge(
        shapes,
        motion,
        alpha,
        options.independence,
        options.camera,
        float(table.sizes[0]) if options.camera == "orthographic" else None,
        options.limits.gauge,
    )
    frames = replace(frames, gauge=gauge.frames)
    share = table.n_seen / table.n_points
    uncertainty = shape_uncertainty(motion, alpha, covariance, share, posteriors.slices)
    last_pass = partial(shown_frames, frames=frames, uncertainty=uncertainty)
    parts, *chance = zip(
        *posteriors.map(last_pass, table.sizes, table.n_seen), strict=True
    )
    shown = Decomposition(*map(np.concatenate, zip(*parts, strict=True)))
    cameras = shown.motion / table.sizes[:, None, None]
    return Refined(
        _model(
            frames,
            gauge.mean_shape.astype(table.dtype),
            gauge.basis.astype(table.dtype),
            options,
            unit,
        ),
        shown._replace(translation=shown.translation + table.translation),
        mode_covariance(cameras, shown.alpha),
        len(fitted.history) - 1,
        fitted.converged,
        JointNumbers(
            unit**2 * noise_variance,
            fitted.camera_noise_ratio,
            frames.certainty.total,
            reliabilities(alpha, covariance, *(sum(part) for part in chance)),
            fitted.history,
            fitted.gradient_norm,
        ),
    )


def _check_determined(motion: NDArray, shown: NDArray) -> None:
    """Refuse frames without a camera: motion (n_frames, 2, 3), shown (n_rows,)."""
    unknown = np.isnan(motion).any(axis=(1, 2))
    if unknown.any():
        row = np.flatnonzero(shown)[unknown.argmax()]
        raise ValueError(
            f"the points that {unknown.sum()} of {len(unknown)} frame(s) show, the "
            f"first is row {row}, do not determine a camera: they lie in a plane of "
            "the mean shape; leave such rows out"
        )


def _model(
    frames: RigidFrames | PosteriorFrames,
    mean_shape: NDArray,
    basis: NDArray,
    options: FitOptions,
    unit: float,
) -> TableModel:
    """Return the fitted model as a function of tables."""
    # With scale_frames each frame has a size of its own.
    one_unit = None if options.scale_frames else unit
    return TableModel(
        frames, mean_shape, basis, options.layout, options.names, one_unit
    )


def _inverse_snr(table: ScaledTable, refined: Refined, cameras: NDArray) -> float:
    """Return the inverse SNR of all frames, for cameras (n, 2, 3) in scaled units."""
    model, frames = refined.model, refined.frames
    position = (frames.translation - table.translation) / table.sizes[:, None]
    shapes = np.concatenate([model.mean_shape[None], model.basis]).transpose(0, 2, 1)
    return reprojection_error(table.rows, shapes, cameras, position, frames.alpha)


def _reference(cameras: NDArray, table: ScaledTable, camera: str) -> NDArray:
    """Return the mean view (2, 3) of cameras (n, 2, 3), of the same camera model."""
    reference = reference_camera(cameras, table.sizes)
    if camera != "affine":
        row, scale = nearest_calibrated(reference[None])
        reference = (scale[:, None, None] * row)[0]
    return reference.astype(table.dtype)
