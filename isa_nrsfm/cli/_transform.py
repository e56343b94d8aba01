"""The command transform."""

import warnings
from argparse import Namespace
from pathlib import Path
from typing import Any

import numpy as np

from isa_nrsfm import export
from isa_nrsfm._compat.caller import warn_caller
from isa_nrsfm._compat.files import errors_of
from isa_nrsfm._fitted_model import removed_part
from isa_nrsfm._parameters import check_requirements
from isa_nrsfm.cli import _reading, _report
from isa_nrsfm.cli._outputs import check_outputs, read_model, write_alpha
from isa_nrsfm.io._tables import table_suffix
from isa_nrsfm.skeletons._column_names import names_of_points


def run(args: Namespace, warned: list[str]) -> str:
    """Write the coefficients of a table's rows, and return the report."""
    output = Path(args.output)
    table_suffix(output)
    estimator = read_model(args)
    with errors_of(args.model):
        check_requirements({"std": args.std, "refinement": estimator.refinement})
    if args.viewer is None and _reading.drawing_options(args):
        raise ValueError("--edges, --skeleton and --origin need --viewer")
    frames = _reading.read_frames(args, estimator)
    drawn = _reading.drawing(args, names_of_points(estimator), frames.skeleton)
    outputs = [Path(path) for path in (output, args.viewer) if path is not None]
    check_outputs(args, [args.table, args.model], outputs)
    X, n_components = _reading.as_fitted(estimator, frames.X), len(estimator.basis_)
    alpha = std = np.empty((0, n_components))
    quality = ["fit", "", "no frame was fitted"]
    if len(X):
        motion, translation, alpha, std = estimator.decompose(X, **frames.weighting)
        explained = estimator.inverse_transform(alpha, motion, translation)
        square = np.nanmean((explained - np.asarray(X)) ** 2)
        error = -estimator.score(X, **frames.weighting)
        quality = _report.quality_row(
            _report.quality_report(error, square, bool(frames.weighting))
        )
        if args.std and args.viewer is not None and estimator.camera_ != "affine":
            drawn["depth_std"] = estimator.reconstruct(
                X, return_std=True, **frames.weighting
            )[1]
        alpha = alpha - removed_part(estimator, motion)
    write_alpha(output, frames, alpha, std if args.std else None)
    if args.viewer is not None:
        _write_viewer(outputs[1], estimator, X=X, **frames.weighting, **drawn)
    files = "  ".join(map(str, outputs))
    rows = [
        ["model", "", args.model],
        quality,
        _report.left_out_row(_report.table_report(args, frames)),
        ["output", "", f"{files}  {len(frames.points)} rows"],
    ]
    return _report.text_of(f"{n_components} coefficients of {len(X)} frames", rows)


def _write_viewer(path: Path, estimator: Any, **options: Any) -> None:
    """Write the viewer, with affine shapes if the cameras do not determine others."""
    try:
        with warnings.catch_warnings(action="error", category=UserWarning):
            export.write_viewer(estimator, path, **options)
    except (ValueError, UserWarning) as error:
        warn_caller(f"{path.name} has affine shapes: {error}")
        export.write_viewer(estimator, path, camera=None, **options)
