"""The command export, from options to the text of its report."""

from argparse import Namespace
from pathlib import Path
from typing import Any

from isa_nrsfm import AffineNRSfM
from isa_nrsfm._tables.landmark_columns import names_of_points
from isa_nrsfm.cli._drawing import chosen_edges
from isa_nrsfm.cli._drawing_options import drawing_files
from isa_nrsfm.cli._export_options import SUFFIXES
from isa_nrsfm.cli._outputs import refuse_overwriting
from isa_nrsfm.cli._reading import as_fitted, read_frames
from isa_nrsfm.cli._report import lay_out, table_lines, table_report
from isa_nrsfm.cli._runs import warn_of_mixed_runs
from isa_nrsfm.export import (
    point_distribution_model,
    write_glb,
    write_pdm,
    write_shapes,
    write_viewer,
)
from isa_nrsfm.io import load_model
from isa_nrsfm.skeletons import Skeleton

# The options that each content has.
_POSE = ("camera", "origin", "mirrored")
_OPTIONS = {
    "viewer": ("edges", "skeleton", "names", "label", "n_frames", "table", *_POSE),
    "glb": ("edges", "skeleton", "names", *_POSE),
    "pdm": ("n_modes", *_POSE),
    "shapes": (),
}
_TABLE_OPTIONS = (
    "format",
    "columns",
    "skip_rows",
    "zeros_missing",
    "min_confidence",
    "image_size",
    "label",
)


def run_export(args: Namespace) -> str:
    """Write what is asked for, and return the report."""
    output = Path(args.output)
    content = _content(output, args.content)
    options = _options(args, content)
    estimator = load_model(args.model)
    warn_of_mixed_runs(args.model)
    for source in filter(None, (args.model, args.table, *drawing_files(args))):
        refuse_overwriting(source, [output])
    sections = {"Model": [args.model]}
    stored = None
    if args.table is not None:
        of_table, stored = _table_options(args, estimator, sections)
        options |= of_table
    options.pop("skeleton", None)
    if "edges" in _OPTIONS[content]:
        names, surfaces = names_of_points(estimator), content == "glb"
        options["edges"] = chosen_edges(args, names, stored, surfaces=surfaces)
    if options.get("camera") == "none":
        options["camera"] = None

    lines = [str(output)]
    if content == "viewer":
        write_viewer(estimator, output, **options)
    elif content == "glb":
        write_glb(estimator, output, **options)
    elif content == "pdm":
        pdm = point_distribution_model(estimator, **options)
        write_pdm(pdm, output)
        lines.append(f"{len(pdm.eigenvalues)} modes of {len(pdm.mean)} points")
    else:
        write_shapes(estimator, output)
    lines.append(f"{output.stat().st_size} bytes")
    return lay_out(sections | {"Output": lines})


def _content(output: Path, content: str | None) -> str:
    """Return what is to be written, and check that the suffix fits."""
    suffix = output.suffix.lower()
    if content is None:
        found = [name for name, suffixes in SUFFIXES.items() if suffix in suffixes]
        if not found:
            known = ", ".join(s for suffixes in SUFFIXES.values() for s in suffixes)
            raise ValueError(
                f"--output: expected a file with one of the suffixes {known}; got "
                f"{output}"
            )
        return found[0]
    suffixes = SUFFIXES[content]
    if content == "pdm":
        suffixes += SUFFIXES["shapes"]
    if suffix not in suffixes:
        raise ValueError(
            f"--content {content} is written to files {', '.join(suffixes)}; got "
            f"{output}"
        )
    return content


def _options(args: Namespace, content: str) -> dict[str, Any]:
    """Return the options that are given, all of which the content must have."""
    names = {name for own in _OPTIONS.values() for name in own}
    given = {name: value for name, value in vars(args).items() if name in names}
    given = {name: value for name, value in given.items() if value is not None}
    for name in given:
        if name not in _OPTIONS[content]:
            having = [kind for kind, own in _OPTIONS.items() if name in own]
            option = "TABLE" if name == "table" else f"--{name.replace('_', '-')}"
            raise ValueError(
                f"{option} is for {' and '.join(having)}; {args.output} is {content}"
            )
    if args.table is None:
        for name in _TABLE_OPTIONS:
            if getattr(args, name) not in (None, [], False, "auto"):
                raise ValueError(f"--{name.replace('_', '-')} needs a TABLE")
    return {name: given[name] for name in given if name not in ("table", "label")}


def _table_options(
    args: Namespace, estimator: AffineNRSfM, sections: dict[str, list[str]]
) -> tuple[dict[str, Any], Skeleton | None]:
    """Read the table that the viewer shows, its labels and its skeleton."""
    frames = read_frames(args, estimator)
    report = table_report(args.table, args.format, frames)
    sections["Table"] = table_lines(report, unusable="not shown")
    options = {"X": as_fitted(estimator, frames.points[frames.usable])}
    if args.label is not None:
        other = {str(name).strip(): name for name in frames.other.columns}
        if args.label not in other:
            raise ValueError(
                f"--label: the table has no column {args.label!r} beside its "
                f"landmarks; it has {', '.join(other) or 'none'}"
            )
        options["labels"] = frames.other.loc[frames.usable, other[args.label]]
    return options, frames.skeleton
