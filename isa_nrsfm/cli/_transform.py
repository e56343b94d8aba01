"""The command transform."""

import warnings
from argparse import Namespace
from pathlib import Path
from typing import Any

from isa_nrsfm import export
from isa_nrsfm._compat.caller import warn_caller
from isa_nrsfm._tables.column_names import names_of_points
from isa_nrsfm.cli._drawing import chosen_edges, drawing_files, drawing_options
from isa_nrsfm.cli._outputs import (
    alpha_table,
    beside_other_columns,
    fitted_frames,
    refuse_overwriting,
)
from isa_nrsfm.cli._reading import as_fitted, read_frames
from isa_nrsfm.cli._report import quality_report, table_report
from isa_nrsfm.cli._runs import warn_of_mixed_runs
from isa_nrsfm.cli._sections import quality_section, table_section, text_of
from isa_nrsfm.io import load_model, write_table
from isa_nrsfm.io._tables import table_suffix


def run(args: Namespace, warned: list[str]) -> str:
    """Write the coefficients of a table's rows, and return the report."""
    output = Path(args.output)
    table_suffix(output)
    estimator = load_model(args.model)
    warn_of_mixed_runs(args.model)
    if args.std and not hasattr(estimator, "noise_variance_"):
        raise ValueError(
            f"--std: {args.model} was fitted with refinement={estimator.refinement!r}, "
            "which gives no standard deviations"
        )
    if args.viewer is None and drawing_options(args):
        raise ValueError("--edges, --skeleton and --origin need --viewer")
    frames = read_frames(args, estimator)
    edges = chosen_edges(args, names_of_points(estimator), frames.skeleton)
    outputs = [output, *([] if args.viewer is None else [Path(args.viewer)])]
    refuse_overwriting([args.table, args.model, *drawing_files(args)], outputs)
    X = as_fitted(estimator, frames.X)
    if len(X):
        fit = estimator.decompose(X)
        quality = quality_section(quality_report(estimator, X, fit))
    else:
        fit = type(fitted_frames(estimator))(*(x[:0] for x in fitted_frames(estimator)))
        quality = ["no frame was fitted"]
    results = alpha_table(fit, frames, std=args.std)
    write_table(beside_other_columns(results, frames.other), output)
    if args.viewer is not None:
        _write_viewer(
            outputs[1], estimator, X=X, edges=edges, origin=args.origin or "auto"
        )
    table = table_report(args.table, args.format, frames)
    sections = {
        "Table": table_section(table, unusable="without coefficients"),
        "Model": [args.model],
        "Quality": quality,
        "Output": [*map(str, outputs), f"{len(results)} rows"],
    }
    title = f"{len(estimator.basis_)} coefficients of {len(X)} frames"
    return text_of(title, sections)


def _write_viewer(path: Path, estimator: Any, **options: Any) -> None:
    """Write the viewer, with affine shapes if the cameras do not determine others."""
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("error", UserWarning)
            export.write_viewer(estimator, path, **options)
    except (ValueError, UserWarning) as error:
        warn_caller(f"{path.name} has affine shapes: {error}")
        export.write_viewer(estimator, path, camera=None, **options)
