"""The options of the command line.

Neither the estimator nor a reader of tables is imported here: ``--help`` does not wait
for them. Defaults of `AffineNRSfM` and its strategies are written once more, and
`tests/test_cli.py` holds them against each other.
"""

import argparse
import re
from typing import Any, NamedTuple

from isa_nrsfm import __version__
from isa_nrsfm._parameters.choices import (
    BLOCK_RECOVERIES,
    CAMERA_NAMES,
    INDEPENDENCE,
    LOSSES,
    REFINEMENTS,
)
from isa_nrsfm.cli._drawing_options import add_drawing_options
from isa_nrsfm.cli._export_options import EXPORT_HELP, add_export_options
from isa_nrsfm.io._format_names import FORMAT_NAMES, TABLE

PROGRAM = "isa-nrsfm"
# What stands for the number of basis shapes where the table is to tell it.
AUTO = "auto"
# A range of more numbers of basis shapes is a mistake.
_MOST_CHOICES = 100

_OVERVIEW = """\
Factorise a table of 2D landmarks (one row a frame) into a mean 3D shape, basis shapes
and, for every frame, coefficients that are freed of the viewpoint."""

_EXAMPLES = """\
examples:
  isa-nrsfm demo
      fit an artificial table of faces, and see what a table looks like
  isa-nrsfm fit faces.csv --n-components 9 --output results
      fit a table and write coefficients, shapes, cameras, figures and the model
  isa-nrsfm transform results/model.npz new.csv --output new-alpha.csv
      coefficients of new frames
  isa-nrsfm export results/model.npz --output faces.glb
      the shapes for other programs

Tables are .csv, .tsv or .parquet files. Landmark columns are recognised by their names,
such as x0, y0 or nose_x, nose_y; all other columns are kept beside the results. Files
of OpenFace, py-feat, MediaPipe, DeepLabCut, SLEAP, COCO, WFLW, and folders of .pts
files, are recognised, too."""

_FIT_EXAMPLES = """\
examples:
  isa-nrsfm fit faces.csv --n-components 9 --output results
  isa-nrsfm fit faces.csv --n-components 1-12 --output results
  isa-nrsfm fit body.csv --camera weak_perspective -k auto --output results
  isa-nrsfm fit muct76-opencv.csv --skip-rows 'name=^ir' --zeros-missing \\
      --n-components 9 --output muct
  isa-nrsfm fit openface.csv --min-confidence 0.8 --n-components 5 --output results
  isa-nrsfm fit 300W/01_Indoor --points inner --n-components 5 --output results

Cells of missing points are empty. Rows that show too few points for a fit are counted
and get empty coefficients. Files of an earlier run in the output folder are
replaced, all together, before the figures are drawn."""

_TRANSFORM_EXAMPLES = """\
example:
  isa-nrsfm transform results/model.npz new.csv --output new-alpha.csv

The table must have the landmark columns that the model was fitted to. Every row has its
row in the output; where too few points are seen, the coefficients are empty."""

_DEMO_EXAMPLES = """\
example:
  isa-nrsfm demo --output faces

Beside the files of 'isa-nrsfm fit', the folder then has the table, tracks.csv."""


class RowRule(NamedTuple):
    """Rows to leave out: those in which a column matches an expression."""

    column: str
    expression: re.Pattern[str]


def build_parser() -> argparse.ArgumentParser:
    """Return the parser of the command line."""
    parser = argparse.ArgumentParser(PROGRAM, **_manners(_OVERVIEW, _EXAMPLES))
    parser.add_argument(
        "--version", action="version", version=f"{PROGRAM} {__version__}"
    )
    commands = parser.add_subparsers(dest="command", metavar="COMMAND", required=True)

    fit = commands.add_parser(
        "fit",
        help="fit a table",
        **_manners(
            "Fit basis shapes and coefficients to a table of landmarks.", _FIT_EXAMPLES
        ),
    )
    _add_points_option(_add_table_options(fit))
    output = _add_folder_options(fit, required=True)
    _add_std_option(output)
    add_drawing_options(output, _path)
    _add_question_options(fit)
    _add_method_options(fit)

    transform = commands.add_parser(
        "transform",
        help="coefficients of new frames",
        **_manners(
            "Compute the coefficients of new frames with a fitted model.",
            _TRANSFORM_EXAMPLES,
        ),
    )
    transform.add_argument(
        "model", metavar="MODEL", type=_path, help="model.npz, written by fit"
    )
    _add_table_options(transform)
    transform.add_argument(
        "-o",
        "--output",
        metavar="FILE",
        type=_path,
        required=True,
        help="the .csv, .tsv or .parquet file to write",
    )
    _add_std_option(transform)
    transform.add_argument(
        "--viewer",
        metavar="FILE",
        type=_path,
        help="write a page to look at the new frames in 3D, too (.html)",
    )
    add_drawing_options(transform, _path, "in the page of --viewer")

    export = commands.add_parser(
        "export", help="shape models, animated 3D, a viewer", **_manners(*EXPORT_HELP)
    )
    export.add_argument(
        "model", metavar="MODEL", type=_path, help="model.npz, written by fit"
    )
    add_export_options(export, _path)
    _add_table_options(export, required=False)

    demo = commands.add_parser(
        "demo",
        help="fit an artificial table of faces",
        **_manners(
            "Fit an artificial table of faces and compare the result with the truth.",
            _DEMO_EXAMPLES,
        ),
    )
    add_drawing_options(_add_folder_options(demo, required=False), _path)
    return parser


def _manners(description: str, epilog: str) -> dict[str, Any]:
    """Return the settings of all parsers: help as it is written, exact options."""
    return {
        "description": description,
        "epilog": epilog,
        "formatter_class": argparse.RawDescriptionHelpFormatter,
        "allow_abbrev": False,
    }


def _add_table_options(
    parser: argparse.ArgumentParser, *, required: bool = True
) -> argparse._ActionsContainer:
    """Add the options that say what a table's rows and columns mean."""
    group = parser.add_argument_group("table")
    group.add_argument(
        "table",
        metavar="TABLE",
        type=_path,
        nargs=None if required else "?",
        help="a .csv, .tsv or .parquet file, or a file or folder of another format"
        + ("" if required else ", with the frames that the viewer shows"),
    )
    group.add_argument(
        "--format",
        choices=["auto", *FORMAT_NAMES],
        default="auto",
        metavar="FORMAT",
        help="what has written the table: "
        f"{', '.join(name for name in FORMAT_NAMES if name != TABLE)}, or "
        f"{TABLE} for any with named columns (default: auto, the one whose files begin "
        "like this one)",
    )
    group.add_argument(
        "--columns",
        metavar="PATTERN",
        help="the landmark columns where their names are ambiguous: patterns of x and "
        "y columns in turn, # for a number, * for any text, such as 'x_#,y_#' or "
        "'*.px,*.py'",
    )
    group.add_argument(
        "--skip-rows",
        metavar="COLUMN=REGEX",
        type=_row_rule,
        action="append",
        default=[],
        help="leave out the rows in which the regular expression is found in the "
        "column, such as 'name=^ir' for names that begin with ir; may be repeated",
    )
    group.add_argument(
        "--zeros-missing",
        action="store_true",
        help="points at exactly (0, 0) are missing",
    )
    group.add_argument(
        "--min-confidence",
        metavar="NUMBER",
        type=float,
        help="points with a lower confidence are missing, in the scale of the program "
        "that has written the table",
    )
    group.add_argument(
        "--image-size",
        metavar="WIDTHxHEIGHT",
        type=_image_size,
        help="size of the images in pixels, such as 1920x1080, for the coordinates of "
        "MediaPipe, which are shares of it",
    )
    return group


def _add_points_option(group: argparse._ActionsContainer) -> None:
    """Add the option that keeps some of the points."""
    group.add_argument(
        "--points",
        metavar="POINTS",
        help="fit some of the points: inner leaves out the visible outline of a face, "
        "which slides over the surface as the head turns; otherwise names, numbers and "
        "ranges such as nose,36-47, or without:0-16 for those to leave out",
    )


def _add_question_options(parser: argparse.ArgumentParser) -> None:
    """Add the options that name other columns of the table to ask about."""
    group = parser.add_argument_group("what other columns say")
    group.add_argument(
        "--label",
        metavar="COLUMN",
        action="append",
        default=[],
        help="a class or a number for each frame, such as an expression or an age: how "
        "each coefficient goes with it, and how well all tell it; may be repeated. "
        "Whole numbers are classes; COLUMN:number says otherwise",
    )
    group.add_argument(
        "--group",
        metavar="COLUMN",
        help="people, videos or files: how much coefficients differ between and within "
        "them; held-out frames are of others, and time does not go from one to another",
    )
    group.add_argument(
        "--distance",
        metavar="POINT,POINT",
        type=_point_pair,
        action="append",
        default=[],
        help="write the distance of two points in the 3D shape of each frame to "
        "alpha.csv, in units of that of the outer corners of the eyes; may be repeated",
    )
    group.add_argument(
        "--unit",
        metavar="POINT,POINT",
        type=_point_pair,
        help="two points whose distance in the mean shape is the unit of --distance",
    )
    group.add_argument(
        "--length",
        metavar="NUMBER",
        type=_above_zero,
        default=1.0,
        help="the length of that unit, such as 90 for millimetres (default: 1)",
    )
    time = group.add_mutually_exclusive_group()
    time.add_argument(
        "--time",
        metavar="COLUMN",
        help="times of the frames, numbers or dates that rise within each group: "
        "coefficients are smoothed, too",
    )
    time.add_argument(
        "--fps",
        metavar="NUMBER",
        type=_above_zero,
        help="rows are the frames of a video, so many a second, instead of --time",
    )


def _point_pair(text: str) -> tuple[str, str]:
    """Read two points with a comma between them."""
    points = [each.strip() for each in text.split(",")]
    if len(points) != 2 or not all(points):
        raise argparse.ArgumentTypeError(
            "expected two points with a comma between them, such as 48,54; "
            f"got {text!r}"
        )
    return points[0], points[1]


def _above_zero(text: str) -> float:
    """Read a number above zero."""
    try:
        number = float(text)
    except ValueError:
        number = 0.0
    if not 0 < number < float("inf"):
        raise argparse.ArgumentTypeError(f"expected a number above zero; got {text!r}")
    return number


def _add_method_options(parser: argparse.ArgumentParser) -> None:
    """Add the parameters of the factorisation."""
    group = parser.add_argument_group("method")
    group.add_argument(
        "-k",
        "--n-components",
        metavar="K",
        type=_numbers_of_shapes,
        default="3",
        help="number of basis shapes (default: %(default)s). Of several, such as 1-8 "
        "or 3,6,9, that is taken which best predicts held-out points of held-out "
        "frames; auto takes those of twelve that the table determines",
    )
    group.add_argument(
        "--camera",
        choices=CAMERA_NAMES,
        default=CAMERA_NAMES[0],
        help="what is known of the cameras: affine assumes nothing, weak_perspective "
        "ones are rotations with a scale for each frame, orthographic ones have one "
        "scale for all frames; with the last two shapes have true proportions "
        "(default: %(default)s)",
    )
    group.add_argument(
        "--isa",
        choices=["pooled", "fast"],
        default="pooled",
        help="independent subspace analysis: FastICA whose components are pooled into "
        "triples (default), or FastISA from several starts",
    )
    group.add_argument(
        "--n-init",
        metavar="N",
        type=_positive,
        help="number of random starts (default: 16 of pooled, 30 of fast)",
    )
    group.add_argument(
        "--block-recovery",
        choices=BLOCK_RECOVERIES,
        default=BLOCK_RECOVERIES[0],
        help="how the block structure is found (default: %(default)s)",
    )
    group.add_argument(
        "--refinement",
        choices=[*REFINEMENTS, "none"],
        default=REFINEMENTS[0],
        help="joint: cameras, coefficients and basis shapes together; alternating: the "
        "paper's, with the cameras of the rigid part held (default: %(default)s)",
    )
    group.add_argument(
        "--independence",
        choices=[*INDEPENDENCE, "none"],
        default=INDEPENDENCE[0],
        help="what is made independent in the joint refinement, the basis shapes over "
        "the points or their coefficients over the frames (default: %(default)s)",
    )
    group.add_argument(
        "--loss",
        choices=LOSSES,
        default=LOSSES[0],
        help="how far-off points count in the joint refinement: huber and cauchy "
        "bound the influence of outliers (default: %(default)s)",
    )
    group.add_argument(
        "--no-scale-frames",
        action="store_true",
        help="let frames count by their size in the image, as orthographic cameras "
        "always do; otherwise all count alike",
    )
    group.add_argument(
        "--random-state",
        metavar="SEED",
        type=_seed,
        default=0,
        help="seed of the random starts (default: %(default)s)",
    )
    group.add_argument(
        "--n-jobs",
        metavar="N",
        type=int,
        help="processes for the random starts, -1 for all processors (default: 1)",
    )


def _add_folder_options(
    parser: argparse.ArgumentParser, *, required: bool
) -> argparse._ActionsContainer:
    """Add the options that say what is written where."""
    group = parser.add_argument_group("output")
    group.add_argument(
        "-o",
        "--output",
        metavar="DIR",
        type=_path,
        required=required,
        default=f"{PROGRAM}-demo",
        help="folder for the results, created if absent"
        + ("" if required else " (default: ./%(default)s)"),
    )
    group.add_argument(
        "--no-figures",
        action="store_true",
        help="write no figures (png), and remove those of the run before",
    )
    return group


def _add_std_option(group: argparse._ActionsContainer) -> None:
    """Add the option for standard deviations."""
    group.add_argument(
        "--std",
        action="store_true",
        help="write the standard deviation of each coefficient, too, in columns such "
        "as alpha_1_std",
    )


def _path(text: str) -> str:
    """Read the path of a file or a folder."""
    if not text.strip():
        raise argparse.ArgumentTypeError("expected a path; got an empty text")
    return text


def _image_size(text: str) -> tuple[int, int]:
    """Read WIDTHxHEIGHT."""
    match = re.fullmatch(r"([1-9]\d*)[xX]([1-9]\d*)", text.strip())
    if match is None:
        raise argparse.ArgumentTypeError(
            f"expected WIDTHxHEIGHT, such as 1920x1080; got {text!r}"
        )
    return int(match[1]), int(match[2])


def _row_rule(text: str) -> RowRule:
    """Read COLUMN=REGEX."""
    column, equals, expression = text.partition("=")
    if not (column.strip() and equals and expression):
        raise argparse.ArgumentTypeError(
            f"expected COLUMN=REGEX, such as 'name=^ir'; got {text!r}"
        )
    try:
        return RowRule(column.strip(), re.compile(expression))
    except re.error as error:
        raise argparse.ArgumentTypeError(
            f"{expression!r} is not a regular expression: {error}"
        ) from error


def _positive(text: str) -> int:
    """Read a whole number of at least 1."""
    return _whole_number(text, 1, 2**31 - 1)


def _numbers_of_shapes(text: str) -> tuple[int, ...] | tuple[str]:
    """Read numbers of basis shapes, such as 9, 1-8 or 3,6,9, ascending; or auto."""
    if text.strip() == AUTO:
        return (AUTO,)
    numbers: set[int] = set()
    for part in text.split(","):
        bounds = re.fullmatch(r"(\d+)\s*-\s*(\d+)", part.strip())
        low, high = map(_positive, bounds.groups() if bounds else (part, part))
        if high < low or high - low >= _MOST_CHOICES:
            raise argparse.ArgumentTypeError(
                f"expected a range of at most {_MOST_CHOICES} numbers, the smaller one "
                f"first, such as 1-8; got {part!r}"
            )
        numbers.update(range(low, high + 1))
    return tuple(sorted(numbers))


def _seed(text: str) -> int:
    """Read a seed of a random number generator."""
    return _whole_number(text, 0, 2**32 - 1)


def _whole_number(text: str, smallest: int, largest: int) -> int:
    """Read a whole number in a range."""
    try:
        number = int(text)
    except ValueError:
        number = smallest - 1
    if not smallest <= number <= largest:
        raise argparse.ArgumentTypeError(
            f"expected a whole number from {smallest} to {largest}; got {text!r}"
        )
    return number
