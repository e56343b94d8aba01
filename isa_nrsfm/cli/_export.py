"""The command export."""

from argparse import Namespace
from pathlib import Path
from typing import Any

from isa_nrsfm import export
from isa_nrsfm.cli import _reading
from isa_nrsfm.cli._options import EXPORTS, NONE, flag_of
from isa_nrsfm.cli._outputs import check_outputs, read_model
from isa_nrsfm.cli._report import text_of
from isa_nrsfm.skeletons._column_names import names_of_points


def run(args: Namespace, warned: list[str]) -> str:
    """Write a model for another program, and return the report."""
    output = Path(args.output)
    content = _content(output)
    options = _given(args, content)
    estimator = read_model(args)
    check_outputs(args, [args.model], [output])
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
    return text_of("", [["model", "", args.model], ["output", "", text]])


def _content(output: Path) -> str:
    """Return the content to write, by the suffix."""
    contents = {s: name for name, each in EXPORTS.items() for s in each["suffixes"]}
    if output.suffix.lower() not in contents:
        raise ValueError(
            "--output: expected a file with one of the suffixes "
            f"{', '.join(contents)}; got {output}"
        )
    return contents[output.suffix.lower()]


def _given(args: Namespace, content: str) -> dict[str, Any]:
    """Return the options that are given; raise if the content does not have them."""
    given = {}
    for name in [name for each in EXPORTS.values() for name in each["options"]]:
        if getattr(args, name) in (None, False):
            continue
        having = [kind for kind, each in EXPORTS.items() if name in each["options"]]
        if content not in having:
            raise ValueError(
                f"{flag_of(name)} is an option of {' and '.join(having)}; "
                f"{args.output} is {content}"
            )
        if name not in ("skeleton", "mirrored"):
            given[name] = getattr(args, name)
    return given
