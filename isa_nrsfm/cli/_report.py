"""The report of a run as data, rendered as text, JSON and HTML."""

from argparse import Namespace
from pathlib import Path
from typing import Any

import numpy as np

from isa_nrsfm._compat import pandas as pd
from isa_nrsfm._compat.caller import warn_caller
from isa_nrsfm._fitted_model import frames_of, sees_perspective
from isa_nrsfm.analysis._advice import FIT, camera_meaning, verdict
from isa_nrsfm.analysis._diagnostics import Diagnostics
from isa_nrsfm.cli._outputs import Fit
from isa_nrsfm.cli._reading import Frames
from isa_nrsfm.export._names import names_of_components
from isa_nrsfm.skeletons._column_names import names_of_points

# Rows and points that are listed, and classes whose means are shown, at most.
MOST_LISTED, MOST_CLASSES = 10, 12


def table_report(args: Namespace, frames: Frames) -> dict[str, Any]:
    """Describe the table, its rows and columns that are used, and the others."""
    X, names = frames.X, list(frames.points.columns)
    missing = X.iloc[:, ::2].isna().to_numpy()
    return {
        "path": str(Path(args.table).resolve()),
        "format": args.format,
        "n_rows": len(frames.images),
        "n_frames": len(X),
        "n_points": len(frames.columns.points),
        "missing_values": args.missing_value,
        "n_missing_points": missing.sum(),
        "n_frames_with_missing_points": missing.any(axis=1).sum(),
        "columns": frames.columns.pattern,
        "first_columns": names[:4],
        "last_columns": names[-2:],
        "coordinates_not_used": frames.not_used,
        "rows_left_out": [
            {
                "reason": reason,
                "skipped_on_request": skipped,
                "n_rows": len(rows),
                "first_rows": rows[:MOST_LISTED],
            }
            for reason, rows, skipped in frames.left_out
        ],
    }


def quality_report(error: float, square: float, weighted: bool) -> dict[str, Any]:
    """Describe how well a model explains a table, whose points may have weights.

    `error` is that of held-out points, `square` the mean of the squared errors of the
    coordinates.
    """
    return {
        "fit": verdict(error, *FIT),
        "held_out_error": error,
        "held_out_error_weighted": weighted,
        "rms_point_error": np.sqrt(2 * square),
    }


def model_report(fit: Fit, found: Diagnostics | None) -> dict[str, Any]:
    """Describe a fitted model, with the diagnostics of a joint fit, and its quality."""
    # Not needed by transform
    from isa_nrsfm.plotting._axes import SPANNING_TREE
    from isa_nrsfm.plotting._views import view_and_layout

    estimator, frames, edges = fit.estimator, fit.frames, fit.drawn["edges"]
    X, alpha = frames.X, estimator.alpha_
    square = (fit.explained - X.to_numpy()) ** 2
    errors, typical = np.sqrt(2 * np.nanmean(square, axis=1)), np.nanmean(square)
    if estimator.loss != "linear":  # of the median point
        typical = np.nanmedian(square[:, ::2] + square[:, 1::2]) / np.log(4)
    ratio = getattr(estimator, "camera_noise_ratio_", np.nan)
    _, layout, lines, _ = view_and_layout(estimator, edges)
    for message in getattr(found, "messages", ()):
        warn_caller(message)
    error = found.held_out_error if found else -estimator.score(X, **frames.weighting)
    figures = ("effective_frames", "pose_share", "pose_removed")
    coefficients = pd.DataFrame(
        {
            "name": names_of_components(None, alpha.shape[1]),
            "energy_share": estimator.energy_share_,
            "min": alpha.min(axis=0),
            "row_of_min": X.index[alpha.argmin(axis=0)],
            "max": alpha.max(axis=0),
            "row_of_max": X.index[alpha.argmax(axis=0)],
            "stability": getattr(estimator, "stability_", None),
            "stability_word": getattr(found, "stability", None),
            **{name: getattr(found, name, None) for name in figures},
        }
    )
    outliers = None
    if found is not None:
        names, worst = names_of_points(estimator), found.outliers[:MOST_LISTED]
        largest = [{"row": X.index[i], "point": names[j]} for i, j in worst]
        outliers = {"share": found.outlier_share, "largest": largest}
        outliers["n_points"] = len(found.outliers)
    return {
        "n_components": alpha.shape[1],
        "depth": getattr(found, "depth", ""),
        "inverse_snr": estimator.inverse_snr_,
        **quality_report(error, typical, bool(frames.weighting)),
        "largest_error": {"row": X.index[errors.argmax()], "rms": errors.max()},
        "noise_variance": getattr(estimator, "noise_variance_", None),
        "frames_scaled": estimator.frames_scaled_,
        "camera": estimator.camera,
        "camera_noise_ratio": ratio,
        "camera_meaning": camera_meaning(ratio),
        "depth_uncertainty": getattr(estimator, "depth_uncertainty_", None),
        "mirror_certainty": estimator.mirror_certainty_,
        "mirror_decided_by_perspective": sees_perspective(estimator),
        "focal_length": getattr(estimator, "focal_length_", None),
        "focal_length_std": getattr(estimator, "focal_length_std_", None),
        "principal_point": estimator.principal_point,
        "depth_determined": estimator.camera_ != "affine"
        and frames_of(estimator).certainty.determined,
        "skeleton": None if layout is None else layout.name,
        # Also if no lines are wanted.
        "lines_known": edges is None
        or getattr(lines, "name", SPANNING_TREE) != SPANNING_TREE,
        "outliers": outliers,
        "parameters": estimator.get_params(deep=True),
        "alpha": coefficients.to_dict("records"),
    }
