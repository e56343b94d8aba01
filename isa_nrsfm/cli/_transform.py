"""The command transform, from options to the text of its report."""

from argparse import Namespace
from pathlib import Path

import numpy as np

from isa_nrsfm import Decomposition
from isa_nrsfm._tables.landmark_columns import names_of_points
from isa_nrsfm.cli._drawing import chosen_edges
from isa_nrsfm.cli._drawing_options import drawing_files, drawing_options
from isa_nrsfm.cli._outputs import (
    alpha_table,
    beside_other_columns,
    refuse_overwriting,
    write_page,
)
from isa_nrsfm.cli._reading import as_fitted, read_frames
from isa_nrsfm.cli._report import (
    lay_out,
    quality_lines,
    quality_report,
    table_lines,
    table_report,
)
from isa_nrsfm.cli._runs import warn_of_mixed_runs
from isa_nrsfm.io import load_model, write_table
from isa_nrsfm.io._tables import table_suffix


def run_transform(args: Namespace) -> str:
    """Write the coefficients of a table's rows, and return the report."""
    output = Path(args.output)
    table_suffix(output)
    estimator = load_model(args.model)
    warn_of_mixed_runs(args.model)
    if args.std and not hasattr(estimator, "noise_variance_"):
        raise ValueError(
            f"--std: {args.model} was fitted with refinement="
            f"{estimator.refinement!r}, which does not know the standard deviations "
            "of its coefficients"
        )
    frames = read_frames(args, estimator)
    edges = chosen_edges(args, names_of_points(estimator), frames.skeleton)
    if args.viewer is None and drawing_options(args):
        raise ValueError("--edges, --skeleton and --origin are for --viewer")
    outputs = [output, *([] if args.viewer is None else [Path(args.viewer)])]
    for source in (args.table, args.model, *drawing_files(args)):
        refuse_overwriting(source, outputs)
    X = as_fitted(estimator, frames.points[frames.usable])
    n_frames, n_components = len(X), len(estimator.basis_)
    none = np.empty((0, n_components))
    fit = Decomposition(np.empty((0, 2, 3)), np.empty((0, 2)), none, none)
    quality = ["no frame was fitted"]
    if n_frames:
        fit = estimator.decompose(X)
        quality = quality_lines(quality_report(estimator, X, fit))
    results = alpha_table(fit, frames, std=args.std)
    write_table(beside_other_columns(results, frames.other), output)
    if args.viewer is not None:
        drawn = {"edges": edges, "origin": args.origin or "auto"}
        write_page(outputs[1], estimator, X, **drawn)

    table = table_report(args.table, args.format, frames)
    title = f"{n_components} coefficients of {n_frames} frames"
    sections = {
        "Table": table_lines(table, unusable="without coefficients"),
        "Model": [args.model],
        "Quality": quality,
        "Output": [*map(str, outputs), f"{len(results)} rows"],
    }
    return f"{title}\n\n{lay_out(sections)}"
