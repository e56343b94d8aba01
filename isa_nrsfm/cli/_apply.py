"""The commands transform and export, of a model that fit has written."""

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
from isa_nrsfm.cli._options import EXPORTS, NONE, flag_of
from isa_nrsfm.io._tables import table_suffix
from isa_nrsfm.skeletons._column_names import names_of_points


def run_transform(args: Namespace, warned: list[str]) -> str:
    """Write the coefficients of a table's rows, and return the report."""
    output = Path(args.output)
    table_suffix(output)
    estimator = _report.read_model(args)
    with errors_of(args.model):
        check_requirements({"std": args.std, "refinement": estimator.refinement})
    if args.viewer is None and _reading.drawing_options(args):
        raise ValueError("--edges, --skeleton and --origin need --viewer")
    frames = _reading.read_frames(args, estimator)
    drawn = _reading.drawing(args, names_of_points(estimator), frames.skeleton)
    outputs = [Path(path) for path in (output, args.viewer) if path is not None]
    _report.check_outputs(args, [args.table, args.model], outputs)
    X, n_components = _reading.as_fitted(estimator, frames.X), len(estimator.basis_)
    alpha = std = np.empty((0, n_components))
    quality = ["fit", "", "no frame was fitted"]
    weights = frames.weighting
    if len(X):
        motion, translation, alpha, std = estimator.decompose(X, **weights)
        explained = estimator.inverse_transform(alpha, motion, translation)
        square = np.nanmean((explained - np.asarray(X)) ** 2)
        error, weighted = -estimator.score(X, **weights), bool(weights)
        quality = _report.quality_row(_report.quality_report(error, square, weighted))
        if args.viewer is not None:
            drawn |= _report.depth_std(args, estimator, X, weights)
        alpha = alpha - removed_part(estimator, motion)
    _report.write_alpha(output, frames, alpha, std if args.std else None)
    if args.viewer is not None:
        _write_viewer(outputs[1], estimator, X=X, **weights, **drawn)
    left_out = _report.left_out_row(_report.table_report(args, frames))
    written = f"{'  '.join(map(str, outputs))}  {len(frames.points)} rows"
    rows = [["model", "", args.model], quality, left_out, ["output", "", written]]
    return _report.text_of(f"{n_components} coefficients of {len(X)} frames", rows)


def _write_viewer(path: Path, estimator: Any, **options: Any) -> None:
    """Write the viewer, with affine shapes if the cameras do not determine others."""
    try:
        with warnings.catch_warnings(action="error", category=UserWarning):
            export.write_viewer(estimator, path, **options)
    except (ValueError, UserWarning) as error:
        warn_caller(f"{path.name} has affine shapes: {error}")
        export.write_viewer(estimator, path, camera=None, **options)


def run_export(args: Namespace, warned: list[str]) -> str:
    """Write a model for another program, and return the report."""
    output = Path(args.output)
    contents = {s: name for name, each in EXPORTS.items() for s in each["suffixes"]}
    if output.suffix.lower() not in contents:
        raise ValueError(
            "--output: expected a file with one of the suffixes "
            f"{', '.join(contents)}; got {output}"
        )
    content = contents[output.suffix.lower()]
    options = _given(args, content)
    estimator = _report.read_model(args)
    _report.check_outputs(args, [args.model], [output])
    if "edges" in EXPORTS[content]["options"]:
        options |= _reading.drawing(args, names_of_points(estimator), None)
    if args.mirrored:
        estimator = estimator.mirrored()
    if options.get("camera") == NONE:
        options["camera"] = None

    what = ""
    if content == "pdm":
        pdm = export.point_distribution_model(estimator, **options)
        export.write_pdm(pdm, output)
        what = f"{len(pdm.eigenvalues)} modes of {len(pdm.mean)} points, "
    else:
        getattr(export, f"write_{content}")(estimator, output, **options)
    text = f"{output}  {what}{output.stat().st_size} bytes"
    return _report.text_of("", [["model", "", args.model], ["output", "", text]])


def _given(args: Namespace, content: str) -> dict[str, Any]:
    """Return the options that are given; raise if the content does not have them."""
    names = dict.fromkeys(name for each in EXPORTS.values() for name in each["options"])
    given = {n: vars(args)[n] for n in names if vars(args)[n] not in (None, False)}
    for name in given:
        having = [kind for kind, each in EXPORTS.items() if name in each["options"]]
        if content not in having:
            raise ValueError(
                f"{flag_of(name)} is an option of {' and '.join(having)}; "
                f"{args.output} is {content}"
            )
    return {n: v for n, v in given.items() if n not in ("skeleton", "mirrored")}
