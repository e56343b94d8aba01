"""The command export."""

from argparse import Namespace
from pathlib import Path
from typing import Any

from isa_nrsfm import export
from isa_nrsfm.cli import _reading
from isa_nrsfm.cli._options import NONE, SUFFIXES, TABLE_OPTIONS, flag_of
from isa_nrsfm.cli._outputs import read_model, refuse_overwriting, refuse_replacing
from isa_nrsfm.cli._report import table_report
from isa_nrsfm.cli._sections import table_section, text_of
from isa_nrsfm.skeletons._column_names import names_of_points

# The options of each content, besides those of the table.
_POSE = ("camera", "origin", "mirrored")
_OPTIONS = {
    "viewer": ("table", "edges", "skeleton", "names", "label", "n_frames", *_POSE),
    "glb": ("edges", "skeleton", "names", *_POSE),
    "pdm": ("n_modes", *_POSE),
    "shapes": (),
}


def run(args: Namespace, warned: list[str]) -> str:
    """Write a model for another program, and return the report."""
    output = Path(args.output)
    content = _content(output)
    options = _given(args, content)
    estimator = read_model(args)
    sources = filter(None, (args.model, args.table, *_reading.drawing_files(args)))
    refuse_overwriting(sources, [output])
    if not args.force:
        refuse_replacing([output])
    sections: dict[str, Any] = {"Model": [args.model]}
    stored = None
    if args.table is not None:
        frames = _reading.read_frames(args, estimator)
        stored = frames.skeleton
        sections["Table"] = table_section(table_report(args, frames), "not shown")
        options["X"] = _reading.as_fitted(estimator, frames.X)
        if args.label is not None:
            labels = _reading.cells_of(frames.other, args.label, "--label")
            options["labels"] = labels[frames.usable]
    if "edges" in _OPTIONS[content]:
        names = names_of_points(estimator)
        options |= _reading.drawing(args, names, stored)
    if args.mirrored:
        estimator = estimator.mirrored()
    if options.get("camera") == NONE:
        options["camera"] = None

    lines = [str(output)]
    if content == "pdm":
        pdm = export.point_distribution_model(estimator, **options)
        export.write_pdm(pdm, output)
        lines.append(f"{len(pdm.eigenvalues)} modes of {len(pdm.mean)} points")
    else:
        getattr(export, f"write_{content}")(estimator, output, **options)
    lines.append(f"{output.stat().st_size} bytes")
    return text_of("", sections | {"Output": lines})


def _content(output: Path) -> str:
    """Return the content to write, by the suffix."""
    known = {each: name for name, own in SUFFIXES.items() for each in own}
    if output.suffix.lower() not in known:
        raise ValueError(
            "--output: expected a file with one of the suffixes "
            f"{', '.join(known)}; got {output}"
        )
    return known[output.suffix.lower()]


def _given(args: Namespace, content: str) -> dict[str, Any]:
    """Return the options that are given; raise if the content does not have them."""
    given = {}
    for name in [name for own in _OPTIONS.values() for name in own]:
        if getattr(args, name) in (None, False):
            continue
        having = [kind for kind, own in _OPTIONS.items() if name in own]
        if content not in having:
            raise ValueError(
                f"{flag_of(name)} is an option of {' and '.join(having)}; "
                f"{args.output} is {content}"
            )
        if name not in ("table", "label", "skeleton", "mirrored"):
            given[name] = getattr(args, name)
    if args.table is None:
        for name in (*TABLE_OPTIONS, "label"):
            if getattr(args, name) not in (None, False, [], "auto"):
                raise ValueError(f"{flag_of(name)} needs a TABLE")
    return given
