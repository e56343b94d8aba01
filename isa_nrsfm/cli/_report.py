"""What a run reports, as data for the JSON file and as text for people."""

import math
import platform
import textwrap
from collections.abc import Mapping, Sequence
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from typing import Any

import numpy as np

from isa_nrsfm import AffineNRSfM, Decomposition, __version__
from isa_nrsfm._diagnostics import (
    Diagnostics,
    camera_advice,
    camera_meaning,
    outlier_advice,
)
from isa_nrsfm._selection.choice import NO_SHAPE
from isa_nrsfm._tables.landmark_columns import names_of_points
from isa_nrsfm._transformer import frames_of
from isa_nrsfm.cli._answer_text import answer_lines
from isa_nrsfm.cli._frames import Frames
from isa_nrsfm.cli._outputs import component_names, fitted_frames, fitted_table
from isa_nrsfm.cli._parser import AUTO
from isa_nrsfm.io import FORMATS
from isa_nrsfm.metrics import inverse_snr

_LIBRARIES = ("numpy", "scipy", "scikit-learn", "joblib", "pandas")
_LABEL_WIDTH = 11
_MOST_ROWS = 10
_TEXT_WIDTH = 90
CAMERA_TITLES = {
    "affine": "affine: shapes are known up to an affinity of space",
    "weak_perspective": "weak-perspective: shapes have true proportions, up to a "
    "mirror image",
    "orthographic": "orthographic: shapes have true proportions, up to a mirror "
    "image, in the units of the table",
}


def table_report(path: str, format: str, frames: Frames) -> dict[str, Any]:
    """Describe the table and which of its rows and columns are used."""
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
                "reason": out.reason,
                "skipped_on_request": out.skipped,
                "n_rows": len(out.rows),
                "first_rows": out.rows[:_MOST_ROWS].tolist(),
            }
            for out in frames.left_out
        ],
    }


def quality_report(
    estimator: AffineNRSfM, X: Any, fit: Decomposition
) -> dict[str, Any]:
    """Describe how well a model explains a table."""
    explained = fitted_table(estimator, fit)
    off = explained - np.asarray(X)
    return {
        "inverse_snr": inverse_snr(
            X,
            explained,
            layout=estimator.layout,
            scale_frames=estimator.frames_scaled_,
        ),
        "held_out_error": -estimator.score(X),
        "rms_point_error": np.sqrt(2 * np.nanmean(off**2)),
    }


def quality_lines(quality: dict[str, Any], remark: str = "") -> list[str]:
    """Say how well a model explains a table, with a remark on its inverse SNR."""
    return [
        f"inverse SNR {_percent(quality['inverse_snr'])}{remark}",
        f"held-out error {_percent(quality['held_out_error'])}, the same for points "
        "predicted from the others of their frame",
        f"reprojected points are off by {quality['rms_point_error']:.3g}, root mean "
        "square, in the units of the table",
    ]


def model_report(
    estimator: AffineNRSfM, X: Any, frames: Frames, edges: Any = "auto"
) -> dict[str, Any]:
    """Describe a fitted model and how well it explains its table."""
    from isa_nrsfm.plotting._views import layout_of  # not needed by transform

    names = component_names(len(estimator.basis_))
    # Known only where the fit has seen the table as it is.
    floor = frames.seen.all() and estimator.loss == "linear"
    ratio = getattr(estimator, "camera_noise_ratio_", None)
    layout = layout_of(estimator, edges)
    K = len(names)
    found = estimator.diagnostics(X) if estimator.refinement == "joint" else None
    return {
        "n_components": len(estimator.basis_),
        **quality_report(estimator, X, fitted_frames(estimator)),
        "inverse_snr": estimator.inverse_snr_,
        "rank_floor": estimator.rank_floor_ if floor else None,
        "noise_variance": getattr(estimator, "noise_variance_", None),
        "frames_scaled": estimator.frames_scaled_,
        "camera": estimator.camera,
        "camera_noise_ratio": ratio,
        "camera_meaning": None if ratio is None else camera_meaning(ratio),
        **_depth_report(estimator, ratio),
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
                "effective_frames": frames_of,
                "pose_share": pose,
            }
            for name, share, alpha, frames_of, pose in zip(
                names,
                estimator.energy_share_,
                estimator.alpha_.T,
                [None] * K if found is None else found.effective_frames,
                [None] * K if found is None else found.pose_share,
                strict=True,
            )
        ],
    }


def _outliers(found: Diagnostics, estimator: AffineNRSfM, X: Any) -> dict[str, Any]:
    """Describe the gross residuals of a table, by its rows and names of points."""
    names = names_of_points(estimator)
    rows, points = found.outliers.T
    return {
        "share": found.outlier_share,
        "n_points": len(rows),
        "n_frames": len(np.unique(rows)),
        "largest": [
            {"row": X.index[i], "point": names[j]}
            for i, j in zip(rows[:_MOST_ROWS], points[:_MOST_ROWS], strict=True)
        ],
        "message": outlier_advice(found, X.index, names),
    }


def _depth_report(estimator: AffineNRSfM, ratio: float | None) -> dict[str, Any]:
    """Describe how certain the depth is, and which camera to take next."""
    certainty = frames_of(estimator).certainty
    determined = certainty.determined
    advice = ""
    if ratio is not None:
        advice = camera_advice(estimator.camera_, ratio, determined)
    return {
        "depth_uncertainty": getattr(estimator, "depth_uncertainty_", None),
        "depth_determined": determined and estimator.camera_ != "affine",
        "depth_advice": ""
        if determined
        else certainty.advice.replace('camera="affine"', "--camera affine"),
        "camera_advice": advice,
    }


def versions() -> dict[str, str]:
    """Return the versions of what the results depend on."""
    found = {"isa_nrsfm": __version__, "python": platform.python_version()}
    for library in _LIBRARIES:
        try:
            found[library] = version(library)
        except PackageNotFoundError:
            continue
    return found


def fit_text(report: dict[str, Any], folder: Path) -> str:
    """Lay the report of a fit out for people."""
    width = max(map(len, report["files"]))
    files = [f"in {folder}"]
    files += [
        f"  {name:{width}}  {content.partition(';')[0].partition(': the image')[0]}"
        for name, content in report["files"].items()
    ]
    sections = fit_sections(report) | {"Files": files}
    return f"{fit_title(report)}\n\n{lay_out(sections)}"


def fit_title(report: dict[str, Any]) -> str:
    """Say what was fitted to what."""
    table = report["table"]
    return (
        f"{_shapes(report['model'])} fitted to {table['n_frames']} frames of "
        f"{table['n_points']} points"
    )


def _shapes(model: dict[str, Any]) -> str:
    """Say how many basis shapes a model has."""
    n_components = model["n_components"]
    return f"{n_components} basis shape{'s' * (n_components != 1)}"


def fit_sections(report: dict[str, Any]) -> dict[str, list[str]]:
    """Return the lines of each section of the text, but for the files."""
    table, model = report["table"], report["model"]
    n_components, shapes = model["n_components"], _shapes(model)
    remark = ""
    if model["parameters"]["loss"] != "linear":
        remark = " (outliers count in full)"
    elif model["rank_floor"] is not None:
        floor = _percent(model["rank_floor"])
        remark = f" (no model with {shapes} is below {floor})"
    fit = quality_lines(model, remark)
    if model["noise_variance"] is not None:
        noise = math.sqrt(model["noise_variance"])
        unit = (
            f"{_percent(noise)} of the frame's size"
            if model["frames_scaled"]
            else f"{noise:.3g} in the units of the table"
        )
        fit.append(f"noise {unit}, standard deviation of a coordinate")
    if model["outliers"] is not None and model["outliers"]["message"]:
        fit += textwrap.wrap(model["outliers"]["message"], _TEXT_WIDTH)
    fit.append(_seconds(report["seconds"]))
    if model["skeleton"] is not None:
        fit.append(f"points recognised as {model['skeleton']}")
    head = f"{'':10} {'energy':>8} {'mean':>7} {'std':>6} {'min':>7} {'max':>7}"
    alpha = [f"{head} {'pose':>6}"]
    alpha += [
        f"{row['name']:10} {100 * row['energy_share']:6.1f} % {row['mean']:z7.2f} "
        f"{row['std']:6.2f} {row['min']:7.2f} {row['max']:7.2f} {pose_cell(row):>6}"
        for row in model["alpha"]
    ]
    if any(map(pose_cell, model["alpha"])):
        alpha.append("pose: variance that yaw, pitch and roll predict, cross-validated")
    choice = {}
    if "choice" in report:
        choice["Choice"] = _choice_lines(report["choice"])
    elif model["parameters"]["n_components"] == AUTO:
        choice["Choice"] = [f"K = {n_components}: what the table determines"]
    return {
        "Table": table_lines(table),
        **choice,
        "Fit": fit,
        "Cameras": _camera_lines(model),
        "Alpha": alpha,
        **answer_lines(report),
    }


def pose_cell(row: dict[str, Any]) -> str:
    """Return the share of a coefficient that the pose predicts, in percent."""
    share = row["pose_share"]
    return "" if share is None or math.isnan(share) else f"{100 * max(share, 0):.0f} %"


def _seconds(of_stages: dict[str, float]) -> str:
    """Say how long a run took, and its fit."""
    fit = of_stages["fit"] + of_stages.get("choose", 0.0)
    return f"{sum(of_stages.values()):.1f} seconds, {fit:.1f} of them for the fit"


def table_lines(table: dict[str, Any], unusable: str = "left out") -> list[str]:
    """Say which rows and columns of a table are used, and what becomes of the rest."""
    first, last = table["first_columns"], table["last_columns"]
    format = table["format"]
    lines = [
        table["path"] + ("" if format == "table" else f" ({FORMATS[format].title})"),
        f"{table['n_points']} points in the columns {', '.join(first)}, ..., "
        + ", ".join(last),
    ]
    if table["absent_numbers"]:
        absent = ", ".join(map(str, table["absent_numbers"][:_MOST_ROWS]))
        more = ", ..." if len(table["absent_numbers"]) > _MOST_ROWS else ""
        lines.append(f"no points of the numbers {absent}{more} are in the table")
    if table["coordinates_not_used"]:
        listed = [
            f"{pattern} ({n_points})"
            for pattern, n_points in table["coordinates_not_used"].items()
        ]
        lines.append(f"coordinates not used: {'; '.join(listed)}")
    counts = [(table["n_rows"], "rows")]
    counts += [
        (
            out["n_rows"],
            f"{'left out' if out['skipped_on_request'] else unusable}: {out['reason']}",
        )
        for out in table["rows_left_out"]
    ]
    counts.append((table["n_frames"], "used"))
    width = len(str(table["n_rows"]))
    lines += [f"{count:{width}} {what}" for count, what in counts]
    n_missing = table["n_missing_points"]
    if n_missing:
        share = n_missing / (table["n_frames"] * table["n_points"])
        lines.append(
            f"{n_missing} points ({_percent(share)}) are missing in "
            f"{table['n_frames_with_missing_points']} of these rows"
        )
    return lines


def _choice_lines(choice: dict[str, Any]) -> list[str]:
    """Show the held-out error of each number of basis shapes."""
    lines = ["  K   held-out error of frames that were not fitted, +- standard error"]
    lines += [
        f"{k:3}   {_digits(100 * error, 3)} +- {_digits(100 * standard_error, 2)} %"
        f"{', the least' * (k == choice['chosen'])}"
        for k, error, standard_error in zip(
            choice["n_components"],
            choice["held_out_error"],
            choice["held_out_error_standard_error"],
            strict=True,
        )
    ]
    if min(choice["held_out_error"]) >= 1:
        return lines + textwrap.wrap(NO_SHAPE, _TEXT_WIDTH)
    if choice["chosen"] == choice["n_components"][-1]:
        lines.append("larger K may be better: this is the largest that was tried")
    if "next" in choice:
        following, seconds = choice["next"]["n_components"], choice["next"]["seconds"]
        numbers = "-".join(map(str, sorted({following[0], following[-1]})))
        lines.append(f"to try K = {numbers}, too, would take about {seconds:.0f} s")
    return lines


def _digits(number: float, n_digits: int) -> str:
    """Write a number with so many digits, zeros at the end included."""
    return f"{number:#.{n_digits}g}".removesuffix(".")


def _camera_lines(model: dict[str, Any]) -> list[str]:
    """Say what cameras the model has, and what the noise says of them."""
    title = CAMERA_TITLES[model["camera"]]
    uncertainty = model["depth_uncertainty"]
    if model["depth_advice"]:
        title = (
            f"{title.partition(':')[0]}: {model['depth_advice']}. cameras.csv has no "
            "angles, and viewer.html claims no proportions"
        )
    lines = textwrap.wrap(title, _TEXT_WIDTH)
    if model["depth_determined"] and uncertainty and math.isfinite(uncertainty):
        lines.append(f"depths are known to {100 * uncertainty:.2g} %, root mean square")
    return lines + textwrap.wrap(camera_text(model), _TEXT_WIDTH)


def camera_text(model: dict[str, Any]) -> str:
    """Say how far the noise agrees with the cameras, and which ones to try next."""
    # Where the depth is not determined, the same noise means nothing.
    meaning = "" if model["depth_advice"] else model["camera_meaning"]
    return "; ".join(filter(None, (meaning, model["camera_advice"])))


def lay_out(sections: Mapping[str, Sequence[str]]) -> str:
    """Write each section's lines beside its name."""
    blocks = []
    for name, lines in sections.items():
        labels = [name.ljust(_LABEL_WIDTH)]
        labels += [" " * _LABEL_WIDTH] * (len(lines) - 1)
        blocks.append(
            "\n".join(
                (label + line).rstrip()
                for label, line in zip(labels, lines, strict=True)
            )
        )
    return "\n\n".join(blocks)


def _percent(fraction: float) -> str:
    """Write a fraction in percent."""
    return f"{100 * fraction:.3g} %"
