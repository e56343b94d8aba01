"""The commands of the command line, and the parser of their options."""

import argparse
from typing import Any

from isa_nrsfm import __version__
from isa_nrsfm.cli._options import (
    DIFFERENT,
    DRAWING,
    OPTIONS,
    POSITIONAL,
    SHORT,
    TABLE_OPTIONS,
)

PROGRAM = "isa-nrsfm"

_OVERVIEW = """\
Factorise a table of 2D landmarks (one row per frame) into a mean 3D shape, basis shapes
and, for every frame, coefficients that do not depend on the viewpoint."""

_EXAMPLES = """\
examples:
  isa-nrsfm demo
      fit an artificial table of faces
  isa-nrsfm fit faces.csv --n-components 9 --output results
      fit a table and write coefficients, shapes, cameras, figures and the model
  isa-nrsfm transform results/model.npz new.csv --output new-alpha.csv
      coefficients of new frames
  isa-nrsfm export results/model.npz --output faces.glb
      the shapes for other programs

Tables are .csv, .tsv or .parquet files. Landmark columns are recognised by their names,
such as x0, y0 or nose_x, nose_y; all other columns are copied to the results. Files of
OpenFace, py-feat, MediaPipe, DeepLabCut, SLEAP, COCO and WFLW, and folders of .pts
files, are recognised automatically."""

# Of each command: its line in the overview, description, examples, and the options of
# each group. Of the options in a pair only one may be given.
_COMMANDS: dict[str, tuple[str, str, str, dict[str, tuple]]] = {
    "fit": (
        "fit a table",
        "Fit basis shapes and coefficients to a table of landmarks.",
        """\
examples:
  isa-nrsfm fit faces.csv --n-components 9 --output results
  isa-nrsfm fit faces.csv --n-components 1-12 --output results
  isa-nrsfm fit body.csv --camera weak_perspective -k auto --output results
  isa-nrsfm fit muct76-opencv.csv --skip-rows 'name=^ir' --zeros-missing \\
      --n-components 9 --output muct
  isa-nrsfm fit openface.csv --min-confidence 0.8 --n-components 5 --output results
  isa-nrsfm fit 300W/01_Indoor --points inner --n-components 5 --output results

Cells of missing points are empty. Rows with too few points are counted and have empty
coefficients. The results replace those of an earlier run in the output folder.""",
        {
            "table": ("table", *TABLE_OPTIONS, "points"),
            "output": ("output", "no_figures", "std", *DRAWING),
            "other columns": (
                *("label", "group", "distance", "unit", "length", ("time", "fps")),
            ),
            "method": (
                *("n_components", "camera", "isa", "n_init", "block_recovery"),
                *("refinement", "independence", "loss", "no_scale_frames"),
                *("random_state", "n_jobs"),
            ),
        },
    ),
    "transform": (
        "coefficients of new frames",
        "Compute the coefficients of new frames with a fitted model.",
        """\
example:
  isa-nrsfm transform results/model.npz new.csv --output new-alpha.csv

The table must have the landmark columns of the fitted table. The output has a row for
every row of the table; rows with too few points have empty coefficients.""",
        {
            "model": ("model",),
            "table": ("table", *TABLE_OPTIONS),
            "output": ("output", "std", "viewer", *DRAWING),
        },
    ),
    "export": (
        "shape models, animated 3D, a viewer",
        """\
Write a fitted model for other programs. The suffix of the output determines the format:
  .html        a page that shows the shapes and frames in 3D, for any browser
  .glb         glTF 2.0: the mean shape with the basis shapes as morph targets
  .txt         a point distribution model for OpenFace and the CLM framework
  .npz, .mat   the arrays of the model for NumPy, MATLAB and Octave""",
        """\
examples:
  isa-nrsfm export results/model.npz --output faces.glb
  isa-nrsfm export results/model.npz --output pdm.txt --n-modes 0.98
  isa-nrsfm export results/model.npz --output pdm.mat --content pdm
  isa-nrsfm export results/model.npz faces.csv --label expression --output faces.html

Shapes are upright and frontal, with the proportions that weak-perspective cameras
determine; .npz and .mat have the arrays of the model unchanged. Models of
'fit --camera weak_perspective' or 'orthographic' have true proportions already.""",
        {
            "model": ("model",),
            "output": (
                *("output", "content", "n_modes", *DRAWING, "names", "label"),
                *("n_frames", "camera", "mirrored"),
            ),
            "table": ("table", *TABLE_OPTIONS),
        },
    ),
    "demo": (
        "fit an artificial table of faces",
        "Fit an artificial table of faces and compare the result with the truth.",
        """\
example:
  isa-nrsfm demo --output faces

The folder has the files of 'isa-nrsfm fit', and the table as tracks.csv.""",
        {"output": ("output", "no_figures", *DRAWING)},
    ),
}


def build_parser() -> argparse.ArgumentParser:
    """Return the parser of the command line."""
    parser = argparse.ArgumentParser(PROGRAM, **_manners(_OVERVIEW, _EXAMPLES))
    parser.add_argument(
        "--version", action="version", version=f"{PROGRAM} {__version__}"
    )
    commands = parser.add_subparsers(dest="command", metavar="COMMAND", required=True)
    for command, (line, description, examples, groups) in _COMMANDS.items():
        own = commands.add_parser(command, help=line, **_manners(description, examples))
        for title, entries in groups.items():
            group = own.add_argument_group(title)
            for entry in entries:
                if isinstance(entry, str):
                    _add(group, command, entry)
                    continue
                either = group.add_mutually_exclusive_group()
                for name in entry:
                    _add(either, command, name)
    return parser


def _add(group: argparse._ActionsContainer, command: str, name: str) -> None:
    """Add an option of a command."""
    flags = [f"--{name.replace('_', '-')}"]
    if name in POSITIONAL:
        flags = [name]
    elif name in SHORT:
        flags = [SHORT[name], *flags]
    group.add_argument(*flags, **OPTIONS[name] | DIFFERENT.get((command, name), {}))


def _manners(description: str, epilog: str) -> dict[str, Any]:
    """Return the settings of all parsers: help as it is written, exact options."""
    return {
        "description": description,
        "epilog": epilog,
        "formatter_class": argparse.RawDescriptionHelpFormatter,
        "allow_abbrev": False,
    }
