"""The report of a run as data, of which text, JSON and HTML are made."""

import platform
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from typing import Any

import numpy as np

from isa_nrsfm import AffineNRSfM, Decomposition, __version__
from isa_nrsfm._compat.caller import warn_caller
from isa_nrsfm._diagnostics import (
    Diagnostics,
    camera_advice,
    camera_meaning,
    outlier_advice,
)
from isa_nrsfm._tables.column_names import names_of_points
from isa_nrsfm._transformer import frames_of
from isa_nrsfm.cli._outputs import fitted_frames, fitted_table
from isa_nrsfm.cli._reading import Frames
from isa_nrsfm.export._names import names_of_components
from isa_nrsfm.metrics import inverse_snr

# Rows and points that are listed, at most.
MOST_LISTED = 10


def table_report(path: str, format: str, frames: Frames) -> dict[str, Any]:
    """Describe the table, its rows and columns that are used, and the others."""
    return {
        "path": str(Path(path).resolve()),
        "format": format,
        "n_rows": frames.n_rows,
        "n_frames": int(np.count_nonzero(frames.usable)),
        "n_points": len(frames.columns.points),
        "n_missing_points": int(np.count_nonzero(~frames.seen)),
        "n_frames_with_missing_points": int(np.count_nonzero(~frames.seen.all(axis=1))),
        "columns": frames.columns.pattern,
        "first_columns": list(frames.points.columns[:4]),
        "last_columns": list(frames.points.columns[-2:]),
        "absent_numbers": frames.columns.gaps,
        "coordinates_not_used": frames.not_used,
        "rows_left_out": [
            {
                "reason": reason,
                "skipped_on_request": skipped,
                "n_rows": len(rows),
                "first_rows": rows[:MOST_LISTED].tolist(),
            }
            for reason, rows, skipped in frames.left_out
        ],
    }


def quality_report(
    estimator: AffineNRSfM, X: Any, fit: Decomposition
) -> dict[str, Any]:
    """Describe how well a model explains a table."""
    explained = fitted_table(estimator, fit)
    layout, scaled = estimator.layout, estimator.frames_scaled_
    return {
        "inverse_snr": inverse_snr(X, explained, layout=layout, scale_frames=scaled),
        "held_out_error": -estimator.score(X),
        "rms_point_error": np.sqrt(2 * np.nanmean((explained - np.asarray(X)) ** 2)),
    }


def model_report(
    estimator: AffineNRSfM, X: Any, frames: Frames, edges: Any = "auto"
) -> dict[str, Any]:
    """Describe a fitted model and how well it explains its table."""
    from isa_nrsfm.plotting._views import view_and_layout  # not needed by transform

    names = names_of_components(None, len(estimator.basis_))
    ratio = getattr(estimator, "camera_noise_ratio_", None)
    certainty = frames_of(estimator).certainty
    _, layout, _, _ = view_and_layout(estimator, edges)
    found = estimator.diagnostics(X) if estimator.refinement == "joint" else None
    for message in () if found is None else found.messages:
        warn_caller(message)
    report = {
        "n_components": len(names),
        **quality_report(estimator, X, fitted_frames(estimator)),
        "inverse_snr": estimator.inverse_snr_,
        # Known only if the fit has seen the table as it is.
        "rank_floor": estimator.rank_floor_
        if frames.seen.all() and estimator.loss == "linear"
        else None,
        "noise_variance": getattr(estimator, "noise_variance_", None),
        "frames_scaled": estimator.frames_scaled_,
        "camera": estimator.camera,
        "camera_noise_ratio": ratio,
        "camera_meaning": None if ratio is None else camera_meaning(ratio),
        "depth_uncertainty": getattr(estimator, "depth_uncertainty_", None),
        "depth_determined": certainty.determined and estimator.camera_ != "affine",
        "depth_advice": ""
        if certainty.determined
        else certainty.advice.replace('camera="affine"', "--camera affine"),
        "camera_advice": ""
        if ratio is None
        else camera_advice(estimator.camera_, ratio, certainty.determined),
        "skeleton": None if layout is None else layout.name,
        "outliers": None if found is None else _outliers(found, estimator, X),
        "n_iter": estimator.n_iter_,
        "parameters": estimator.get_params(deep=True),
        "alpha": [
            {
                "name": name,
                "energy_share": share,
                "mean": alpha.mean(),
                "std": alpha.std(),
                "min": alpha.min(),
                "max": alpha.max(),
                "effective_frames": None,
                "pose_share": None,
            }
            for name, share, alpha in zip(
                names, estimator.energy_share_, estimator.alpha_.T, strict=True
            )
        ],
    }
    if found is not None:
        for k, row in enumerate(report["alpha"]):
            row["effective_frames"] = found.effective_frames[k]
            row["pose_share"] = found.pose_share[k]
    return report


def _outliers(found: Diagnostics, estimator: AffineNRSfM, X: Any) -> dict[str, Any]:
    """Describe the gross residuals of a table, by its rows and names of points."""
    names = names_of_points(estimator)
    rows, points = found.outliers.T
    largest = zip(rows[:MOST_LISTED], points[:MOST_LISTED], strict=True)
    return {
        "share": found.outlier_share,
        "n_points": len(rows),
        "n_frames": len(np.unique(rows)),
        "largest": [{"row": X.index[i], "point": names[j]} for i, j in largest],
        "message": outlier_advice(found, X.index, names),
    }


def versions() -> dict[str, str]:
    """Return the versions of libraries that the results depend on."""
    found = {"isa_nrsfm": __version__, "python": platform.python_version()}
    for library in ("numpy", "scipy", "scikit-learn", "joblib", "pandas"):
        try:
            found[library] = version(library)
        except PackageNotFoundError:
            continue
    return found
