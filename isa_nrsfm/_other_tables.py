"""A fitted model and other tables: as their prior, and whether they fit it."""

import warnings
from collections.abc import Callable
from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import NDArray
from sklearn.base import clone

from isa_nrsfm._compat.caller import warn_caller
from isa_nrsfm._fitted_model import TableModel
from isa_nrsfm._frames.camera_models import distances, full_rotations
from isa_nrsfm._frames.models import Decomposition
from isa_nrsfm._joint.prior import LEAST_NOISE, TOL_SHARE, ShapePrior
from isa_nrsfm._joint.problem import JointState
from isa_nrsfm._joint.settings import FitSettings
from isa_nrsfm._parameters.naming import named
from isa_nrsfm._prepare.checks import FEWEST_COMPARED
from isa_nrsfm._prepare.robust import median_noise
from isa_nrsfm._prepare.scaling import ScaledTable
from isa_nrsfm._tables.blocks import FrameBlocks, spread
from isa_nrsfm._tables.sources import is_read_later
from isa_nrsfm._tables.tracks import tracks_to_table

# Distance of points from the shapes of a prior, in sizes of frames, beyond its noise,
# from which they are other points; misfit of frames, with calibrated and with affine
# cameras, that noise and other people do not reach: docs/benchmarks/README.md,
# "Thresholds".
OTHER_POINTS, LARGEST_MISFIT, OF_AFFINE = 0.15, 1.8, 5.0


def of_fits(
    estimator: Any,
    result: Callable[..., Any],
    X: Any,
    point_weight: Any = None,
    *,
    deviations: bool = False,
) -> Any:
    """Return a result of the fits of a table's rows, and of their focal shares.

    Warn if the table does not fit the model. Fits of tables that are read later are not
    kept.
    """
    later = is_read_later(X)
    table, weights = estimator._opened(X, point_weight, judged=later)
    shares, n = estimator._focal_shares(table), len(weights)

    def fits(rows: NDArray, *weights: NDArray) -> Decomposition:
        return estimator._model.decompose(rows, *weights, deviations=deviations)

    def results(rows: NDArray, *by_frame: NDArray) -> Any:
        return result(fits(rows, *by_frame[:n]), *by_frame[n:])

    if later:
        return table.collect(results, *weights, *shares)
    fit = table.collect(fits, *weights)
    warn_if_foreign(estimator, table, fit, *weights)
    return result(fit, *shares)


def hold_open(estimator: Any, X: Any, point_weight: Any = None) -> None:
    """Open a fitted table once for all methods that it is given to."""
    opened = estimator._opened(X, point_weight, judged=False)
    estimator._held = X, point_weight, opened


def warn_if_foreign(
    estimator: Any, table: FrameBlocks, fit: Decomposition | None, *weights: NDArray
) -> None:
    """Warn if frames lie farther from the shapes of a model than its noise explains.

    Without fits of all frames, some are fitted.
    The noise of a weighted fit is not comparable to unweighted residuals.
    """
    model, held = estimator._model, estimator._held
    if not model.frames.joint or (held and held[2][0] is table):
        return
    certainty, camera = model.frames.certainty, model.frames.camera
    if table.n_frames < FEWEST_COMPARED or (certainty.weighted and not weights):
        return
    some = spread(np.arange(table.n_frames), 100)
    rows, own = table.take(some), [w[some] for w in weights]
    if fit is None:
        fit = model.decompose(rows, *own, deviations=False, dtype=np.float64)
    else:
        fit = Decomposition(*(part[some] for part in fit))
    distance = model.distances(rows, *fit[:3], *own)
    misfit = model.misfit(distance)
    if misfit > (OF_AFFINE if camera == "affine" else LARGEST_MISFIT):
        way = "Fit X separately"
        if far_points(distance, model.frames):
            way = (
                "Check whether X has the same points in the same order as the fitted "
                "table, or fit X separately"
            )
        elif camera != "affine" and certainty.determined:
            before, after = adapting_errors(estimator, rows, *own)
            if after < before:
                way = (
                    "Adapt the model to X: AutoNRSfM(model, prior=model).fit(X). Held-"
                    "out points of some rows then have an inverse SNR of "
                    f"{after:.2g}, now {before:.2g} (isa-nrsfm fit TABLE --prior "
                    "model.npz)"
                )
        warn_caller(
            f"the points of X lie {misfit:.2g} times as far from the shapes of the "
            "model as its noise explains: they come from another annotator or tracker, "
            "show other objects or people (a model of one person does not generalise "
            "to others), or move as the fitted table does not show. Shapes, depths and "
            f"coefficients may be wrong. {way}"
        )


def adapting_errors(
    estimator: Any, rows: NDArray, *weights: NDArray
) -> tuple[float, ...]:
    """Return the inverse SNR of held-out points of every other row (n, 2, J).

    Without and with adapting the model to the rows between them.
    """
    layout, pinhole = estimator._model.layout, estimator._model.pinhole
    given = {"layout": layout, "focal_length": pinhole and pinhole.focal_length}
    given |= {"n_components": "auto", "refinement": "joint", "prior": estimator}
    adapted = clone(estimator).set_params(**given, frames_folder=None)
    of_points = weights[0][::2] if weights else None
    with warnings.catch_warnings(action="ignore"):
        adapted.fit(tracks_to_table(rows[::2].mT, layout), point_weight=of_points)
    others = [each[1::2] for each in (rows, *weights)]
    parts = [each._model.held_out_sums(*others)[0] for each in (estimator, adapted)]
    return tuple(float(noise / signal) for noise, signal in parts)


def far_points(distance: NDArray, frames: Any) -> float:
    """Return how far points (n, J) lie from shapes; zero if they are these points."""
    if frames.loss == "linear":
        shown = distance[np.isfinite(distance).any(axis=1)]
        square = np.median(np.nanmean(shown**2, axis=1))
    else:  # without outliers
        square = 2.0 * median_noise(distance[np.isfinite(distance)]) ** 2
    others = square > OTHER_POINTS**2 + 2.0 * frames.noise_variance
    return float(np.sqrt(square)) if others else 0.0


def fitted_prior(prior: Any) -> Any:
    """Return the estimator in a search or in a FrozenEstimator."""
    return getattr(prior, "best_estimator_", getattr(prior, "estimator", prior))


def checked_prior(estimator: Any, n_points: int) -> dict[str, Any]:
    """Return the settings of the prior of a table's fit, or raise."""
    if estimator.prior is None:
        return {}
    prior, n_components = fitted_prior(estimator.prior), estimator.n_components
    model = getattr(prior, "_model", None)
    if not isinstance(model, TableModel):
        raise ValueError(
            f"prior must be a fitted AffineNRSfM; got {prior!r}. A search over several "
            "priors clones them: give sklearn.frozen.FrozenEstimator(prior)"
        )
    if not model.frames.joint or prior.camera_ == "affine":
        raise ValueError(
            "prior must be fitted with calibrated cameras and the joint refinement; "
            f"got {named('camera', prior.camera_)}, "
            f"{named('refinement', prior.refinement)}. Fit it with "
            f"{named('camera', 'weak_perspective')}"
        )
    if not model.frames.certainty.determined:
        raise ValueError(
            "the depth of the prior is not determined: its depth_uncertainty_ is "
            f"{model.frames.certainty.total:.2g}. Fit it to a table in which the "
            "objects turn"
        )
    if (prior.camera_ == "orthographic") != (estimator.camera == "orthographic"):
        raise ValueError(
            f"the prior was fitted with {named('camera', prior.camera_)}; got "
            f"{named('camera', estimator.camera)}. Set the same camera"
        )
    if len(model.mean_shape) != n_points:
        raise ValueError(
            f"the prior has {len(model.mean_shape)} points, the table {n_points}. Give "
            "the table the points of the prior, in the same order"
        )
    if n_components not in ("auto", K := model.n_components):
        raise ValueError(
            f"{named('n_components')} must be that of the prior, {K}, or auto, which "
            f"takes it; got {n_components}"
        )
    return {"prior": model, "mirror_certainty": prior.mirror_certainty_}


def prior_start(
    table: ScaledTable, settings: FitSettings, checked: bool
) -> tuple[JointState, FitSettings]:
    """Return a start from the shapes of a prior, and settings of its fit.

    `checked`: raise if the table does not show the points of the prior.
    """
    model = settings.prior
    frames = model.frames
    some = spread(np.arange(table.rows.n_frames), 200)
    rows = table.rows.take(some)
    weights = None if table.weights is None else table.weights[some]
    frames = replace(frames, camera="weak_perspective", loss=settings.loss)
    fit = frames.posterior(rows, False, weights)
    far = far_points(distances(rows, frames.shapes, *fit[:3]), frames)
    if checked and far:
        raise ValueError(
            f"the table does not show the points of the prior: they lie {far:.0%} of "
            "the size of the object from its shapes. Check whether the columns have "
            "the same points in the same order"
        )
    gauge, scale, scaled = frames.gauge, 1.0, settings.camera != "orthographic"
    if not scaled:
        scale = float(np.nanmedian(full_rotations(fit.motion)[1]))
        gauge = gauge._replace(space=table.unit / model.unit * gauge.space)
    noise = max(frames.noise_variance, LEAST_NOISE)
    start = JointState(scale * frames.shapes, np.empty((0, 2, 3)), noise)
    settings = settings._replace(
        shape_prior=ShapePrior.of_model(frames, scale, gauge, scaled),
        limits=settings.limits._replace(least_noise=LEAST_NOISE),
        tol=TOL_SHARE * settings.tol,
    )
    return start, settings
