"""The commands of the command line, their options, and the parser.

``--help`` must not wait for imports of the estimator or a reader. `tests/test_cli.py`
compares the defaults with those of `AffineNRSfM` and its strategies.
"""

import argparse
import math
import re
from collections.abc import Callable, Sequence
from typing import Any, NoReturn

from isa_nrsfm import __version__
from isa_nrsfm._compat.texts import printable
from isa_nrsfm._parameters import choices
from isa_nrsfm.io._formats import FORMATS, TABLE

PROGRAM = "isa-nrsfm"
# The number of basis shapes that the table determines.
AUTO = "auto"
# The value of an option that switches something off.
NONE = "none"
# Configuration files of DeepLabCut.
CONFIGURATIONS = (".yaml", ".yml")
# The prior of the package, and another name of it.
FACE_PRIOR, FACE_PRIORS = "face", ("face", "face-68")
# What export writes, and the suffixes of the files.
SUFFIXES = {
    "viewer": (".html", ".htm"),
    "glb": (".glb",),
    "pdm": (".txt",),
    "shapes": (".npz", ".mat"),
}


def _reader(
    expected: str,
    read: Callable[[str], Any],
    is_allowed: Callable[[Any], bool] = lambda value: True,
) -> Callable[[str], Any]:
    """Return a function that reads allowed values, and names others in its error."""

    def reader(text: str) -> Any:
        try:
            value = read(text)
        except ValueError:
            value = None
        if value is None or not is_allowed(value):
            raise _wrong(expected, repr(text))
        return value

    return reader


def _wrong(expected: str, got: str) -> argparse.ArgumentTypeError:
    """Return the error of a value that is not as expected."""
    return argparse.ArgumentTypeError(f"expected {expected}; got {got}")


def _path(text: str) -> str:
    """Read the path of a file or a folder."""
    if not text.strip():
        raise _wrong("a path", "an empty text")
    return text


def _whole_number(smallest: int, largest: int = 2**31 - 1) -> Callable[[str], int]:
    """Return a function that reads a whole number in a range."""
    expected = f"a whole number from {smallest} to {largest}"
    return _reader(expected, int, range(smallest, largest + 1).__contains__)


def _numbers_of_shapes(text: str) -> tuple[int | str, ...]:
    """Read numbers of basis shapes, such as 9, 1-8 or 3,6,9, ascending; or auto."""
    if text.strip() == AUTO:
        return (AUTO,)
    numbers: set[int] = set()
    for part in text.split(","):
        bounds = re.fullmatch(r"(\d+)\s*-\s*(\d+)", part.strip())
        low, high = map(_whole_number(1), bounds.groups() if bounds else (part, part))
        if not low <= high < low + 100:
            raise _wrong(
                "a range of at most 100 numbers, the smaller one first, such as 1-8",
                repr(part),
            )
        numbers.update(range(low, high + 1))
    return tuple(sorted(numbers))


def _share_or_number(text: str) -> float:
    """Read a number, a whole one as int."""
    number = float(text)
    return int(number) if number.is_integer() else number


def _image_size(text: str) -> tuple[int, int] | None:
    """Read WIDTHxHEIGHT."""
    match = re.fullmatch(r"([1-9]\d{0,6})[xX]([1-9]\d{0,6})", text.strip())
    return (int(match[1]), int(match[2])) if match else None


def _row_rule(text: str) -> tuple[str, re.Pattern[str]]:
    """Read COLUMN=REGEX."""
    column, equals, expression = text.partition("=")
    if not (column.strip() and equals and expression):
        raise ValueError
    try:
        return column.strip(), re.compile(expression)
    except re.error as error:
        raise argparse.ArgumentTypeError(
            f"{expression!r} is not a regular expression: {error}"
        ) from error


def _names(text: str) -> list[str]:
    """Read names with commas between them."""
    return [name.strip() for name in text.split(",")]


# How the values of options are read, by their names in the help; others are texts.
TYPES: dict[str, Callable[[str], Any]] = {
    **dict.fromkeys(("FILE", "DIR", "TABLE", "MODEL"), _path),
    "COLUMN=REGEX": _reader("COLUMN=REGEX, such as 'name=^ir'", _row_rule),
    "CONFIDENCE": float,
    "K": _numbers_of_shapes,
    "LAYOUT": _reader(
        f"one of {', '.join(choices.SKELETON_NAMES)}, or a .yaml file",
        str,
        lambda text: (
            text in choices.SKELETON_NAMES or text.lower().endswith(CONFIGURATIONS)
        ),
    ),
    "MODES": _reader(
        "a whole number or a share between 0 and 1",
        _share_or_number,
        lambda number: 0 < number < 1 or (isinstance(number, int) and number >= 1),
    ),
    "N": int,
    "NAMES": _names,
    "NUMBER": _reader("a number above zero", float, lambda n: 0 < n < math.inf),
    "POINT,POINT": _reader(
        "two points with a comma between them, such as 48,54",
        lambda text: tuple(_names(text)),
        lambda pair: len(pair) == 2 and all(pair),
    ),
    "SEED": _whole_number(0, 2**32 - 1),
    "STARTS": _whole_number(1),
    **dict.fromkeys(
        ("VALUE", "X Y"), _reader("a number, such as -1", float, math.isfinite)
    ),
    "WIDTHxHEIGHT": _reader("WIDTHxHEIGHT, such as 1920x1080", _image_size),
}


# Arguments without a leading -- in the command line.
POSITIONAL = ("table", "model")
SHORT = {"output": ["-o"], "n_components": ["-k"]}
# The help of each option, by its name and its value if it has one. An option may have
# another help in one command.
HELP = {
    "model MODEL": "model.npz, written by fit",
    # The table.
    "table TABLE": "a .csv, .tsv, .txt or .parquet file, a file of another format, "
    "or a folder of files",
    "format FORMAT": "the program that wrote the table: "
    f"{', '.join(name for name in FORMATS if name != TABLE)}, or {TABLE} for any table "
    "with named columns (default: auto, recognised by the beginning of the file)",
    "columns PATTERN": "patterns of the x and y columns, if their names are ambiguous: "
    "# for a number, * for any text, such as 'x_#,y_#' or '*.px,*.py'; a pattern after "
    "- leaves columns out, as in '*_x,*_y,-gaze_*'",
    "individuals NAMES": "individuals in one row, such as 1,2 for nose_1_x and "
    "nose_2_x: each gets its own row, with the column individual",
    "row_per_point NAMES": "of a table with a row for each point, the columns that "
    "tell frames apart and, last, that of the points, such as video,frame,landmark",
    "skip_rows COLUMN=REGEX": "leave out rows whose column matches the expression, "
    "such as 'name=^ir'",
    "zeros_missing": "treat points at exactly (0, 0) as missing, also among others",
    "keep_zeros": "do not treat points at (0, 0) as missing, even if all others are "
    "elsewhere",
    "missing_value VALUE": "treat points whose x and y are this number, such as -1, as "
    "missing",
    "min_confidence CONFIDENCE": "treat points with a lower confidence as missing",
    "weights WEIGHTS": "weight the points of the joint refinement by their confidences "
    "in the file (confidence); points of confidence zero are missing",
    "image_size WIDTHxHEIGHT": "size of the images for MediaPipe and YOLO, in pixels, "
    "such as 1920x1080",
    "fit.image_size WIDTHxHEIGHT": "size of the images in pixels, such as 1920x1080: "
    "for MediaPipe and YOLO, and for perspective cameras, which are then compared with "
    "weak_perspective ones",
    "part PART": "the points to read, if the files have several: of OpenPose "
    f"{', '.join(choices.OPENPOSE_PARTS)}; of whole bodies of COCO and MMPose "
    f"{', '.join(choices.WHOLE_PARTS)}",
    "points POINTS": "fit some of the points: inner (without the visible outline of a "
    "face, which slides over the surface as the head turns), or names, numbers and "
    "ranges such as nose,36-47 or without:0-16",
    # What is written.
    "output DIR": "folder for the results, created if absent",
    "transform.output FILE": "the .csv, .tsv or .parquet file to write",
    "export.output FILE": "the file to write",
    "demo.output DIR": "folder for the results (default: ./isa-nrsfm-demo)",
    "force": "replace existing files (fit and demo: also those of no earlier run)",
    "no_figures": "write no figures (png), and remove those of an earlier run",
    "std": "add the standard deviation of each coefficient, in columns such as "
    "alpha_1_std; with calibrated cameras the viewer has error bars of the depths",
    "viewer FILE": "write a page that shows the new frames in 3D (.html)",
    "edges FILE": "lines to draw between points: a .csv file with the names or numbers "
    "of two points per line; 'none' draws only points",
    "skeleton LAYOUT": "the layout of the points, if names, number and order of the "
    f"points do not determine it: {', '.join(choices.SKELETON_NAMES)}, or the "
    "config.yaml of DeepLabCut",
    "origin": "where y is zero: upper in images, whose y points down, lower if y "
    "points up (default: auto, lower for faces that would be upside down)",
    # Other columns.
    "label COLUMN": "a class or a number for each frame, such as an expression or an "
    "age: reports the dependence of the coefficients on it. Whole numbers are classes "
    "unless given as COLUMN:number",
    "group COLUMN": "people, videos or files: reports the variance between and within "
    "groups. Held-out frames come from other groups; smoothing stops at their borders",
    "distance POINT,POINT": "add the distance of two points of the 3D shapes to "
    "alpha.csv, in units of the distance between the outer corners of the eyes",
    "unit POINT,POINT": "two points whose distance in the mean shape is the unit of "
    "--distance",
    "length NUMBER": "the length of that unit, such as 90 for millimetres (default: 1)",
    "time COLUMN": "times of the frames, numbers or dates: adds smoothed coefficients",
    "time_format FORMAT": "how the cells of --time are written, if that is ambiguous: "
    "%%d/%%m/%%Y (day first), %%M:%%S (minutes and seconds), or other codes of "
    "strptime",
    "fps NUMBER": "instead of --time, the frames per second of a video; frames have "
    "the numbers of the column frame, of the names of images, or of the rows",
    # The method.
    "n_components K": "number of basis shapes (default: auto, as many as the table "
    "determines, at most twelve, or those of the prior). Of several, such as 1-8 or "
    "3,6,9, the fewest within one standard error of the best in cross-validation",
    "camera": "camera model: weak_perspective (a rotation and a scale per frame), "
    "orthographic (one scale), perspective (for objects near the camera, as before a "
    "webcam), or affine (no assumption, for stretched images), which leaves depth and "
    "proportions open (default: what held-out points prefer; perspective needs the "
    "size of the images)",
    "focal_length NUMBER": "of the camera, in pixels (default: estimated with "
    "perspective). Rotations, angles and depths are then in the axes of the camera",
    "principal_point X Y": "the point of the image on the axis of the camera, in "
    "pixels (default: the middle of the images)",
    "prior MODEL": "a fitted model of a table in which the objects turn, such as "
    f"model.npz, or {FACE_PRIOR} for faces: with it frontal photos and few frames have "
    f"true depths. Its layouts are {', '.join(choices.FACE_PRIORS)} (default: that of "
    f"faces, if their table does not determine depths). {NONE}: no prior",
    "export.camera": "camera model for a model with affine cameras; none exports "
    "affine shapes, whose angles and depth are not true (default: weak_perspective)",
    "isa": "independent subspace analysis: FastICA with pooled components, or FastISA",
    "n_init STARTS": "number of random starts (default: 16 of pooled, 30 of fast)",
    "block_recovery": "algorithm that finds the block structure",
    "refinement": "joint: cameras, coefficients and basis shapes together; consensus: "
    "afterwards groups of neighbouring points, most accurate for bodies seen by "
    "calibrated cameras; alternating: the refinement of the paper, with cameras of the "
    "rigid part (default: joint, or consensus if only that determines the depth)",
    "independence": "joint refinement: independent basis shapes, or independent "
    "coefficients",
    "loss": "joint refinement: all but linear limit the influence of outliers "
    "(default: linear, or cauchy if the table has outliers)",
    "remove_pose": "calibrated cameras: coefficients minus what the yaw of the cameras "
    "predicts, if points slide over the surface and people move alike in all views",
    "no_scale_frames": "weight frames by their size in the image, as orthographic "
    "cameras always do",
    "no_hidden_points": "missing points are not hidden by the object: they do not "
    "decide between the mirror images in depth",
    "random_state SEED": "seed of the random starts (default: 0)",
    "n_jobs N": "processes for the random starts, -1 for all processors (default: 1)",
    # Export.
    "n_modes MODES": "for a point distribution model, the number of modes, or the "
    "share of the variance that they explain, such as 0.98 (default: number of basis "
    "shapes)",
    "names NAMES": "for .html and .glb, names of the basis shapes with commas",
    "mirrored": "take the mirror image in depth, which has the same images; faces and "
    "bodies of known layouts have the nose in front in any case",
}
# The values of options that have few.
CHOICES: dict[str, Sequence[str]] = {
    "format": ("auto", *FORMATS),
    "weights": ("confidence",),
    "part": tuple(dict.fromkeys((*choices.OPENPOSE_PARTS, *choices.WHOLE_PARTS))),
    "origin": ("auto", "upper", "lower"),
    "camera": choices.CAMERA_NAMES,
    "export.camera": ("weak_perspective", NONE),
    "isa": ("pooled", "fast"),
    "block_recovery": choices.BLOCK_RECOVERIES,
    "refinement": (*choices.REFINEMENTS, NONE),
    "independence": (*choices.INDEPENDENCE, NONE),
    "loss": choices.LOSSES,
}
# Options whose first choice is their value by default, which the help states.
FIRST = ("isa", "block_recovery", "independence")
DEFAULTS = {
    **{name: CHOICES[name][0] for name in ("format", *FIRST)},
    **{"length": 1.0, "random_state": 0},
    "demo.output": "isa-nrsfm-demo",
}
REPEATED = ("skip_rows", "missing_value", "label", "distance")
TABLE_OPTIONS = (
    *("format", "columns", "individuals", "row_per_point", "skip_rows"),
    *(("zeros_missing", "keep_zeros"), "missing_value", "min_confidence"),
    *("image_size", "part"),
)
DRAWING = (("edges", "skeleton"), "origin")

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
OpenFace, OpenPose, MMPose, py-feat, MediaPipe, DeepLabCut, SLEAP, COCO, WFLW and tps,
and folders of .pts files, are recognised automatically."""

# Of each command: its line in the overview, description, examples, and the options of
# each group. Of the options in a pair only one may be given.
_COMMANDS: dict[str, tuple[str, str, str, dict[str, tuple]]] = {
    "fit": (
        "fit a table",
        "Fit basis shapes and coefficients to a table of landmarks.",
        """\
examples:
  isa-nrsfm fit faces.csv --n-components 9 --output results
  isa-nrsfm fit body.csv -k auto --output results
  isa-nrsfm fit photos.csv --prior face --output results
  isa-nrsfm fit webcam.csv --image-size 1280x720 --output results

Cells of missing points are empty. Rows with too few points are counted and have empty
coefficients. The results replace those of an earlier run in the output folder.""",
        {
            "table": ("table", *TABLE_OPTIONS, "weights", "points"),
            "output": ("output", "force", "no_figures", "std", *DRAWING),
            "other columns": (
                *("label", "group", "distance", "unit", "length", ("time", "fps")),
                "time_format",
            ),
            "method": (
                *("n_components", "camera", "focal_length", "principal_point"),
                *("prior", "isa", "n_init", "block_recovery"),
                *("refinement", "independence", "loss", "remove_pose"),
                *("no_scale_frames", "no_hidden_points", "random_state", "n_jobs"),
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
            "table": ("table", *TABLE_OPTIONS, "weights"),
            "output": ("output", "force", "std", "viewer", *DRAWING),
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
  isa-nrsfm export results/model.npz --output faces.html

Shapes are upright and frontal, with the proportions that weak-perspective cameras
determine; .npz and .mat have the arrays of the model unchanged. Models that were
fitted with --camera weak_perspective, orthographic or perspective keep their
proportions.""",
        {
            "model": ("model",),
            "output": (
                *("output", "force", "n_modes", *DRAWING, "names"),
                *("camera", "mirrored"),
            ),
        },
    ),
    "demo": (
        "fit an artificial table of faces",
        "Fit an artificial table of faces and compare the result with the truth.",
        """\
example:
  isa-nrsfm demo --output faces

The folder has the files of 'isa-nrsfm fit', and the table as tracks.csv.""",
        {"output": ("output", "force", "no_figures", *DRAWING)},
    ),
}


class Parser(argparse.ArgumentParser):
    """A parser whose errors are one line."""

    def error(self, message: str) -> NoReturn:
        """End with the message of an error."""
        text = printable(f"{self.prog}: error: {message} (see {self.prog} --help)")
        self.exit(2, f"{text}\n")


def build_parser() -> Parser:
    """Return the parser of the command line."""
    top = Parser(PROGRAM, **_manners(_OVERVIEW, _EXAMPLES))
    top.add_argument("--version", action="version", version=f"{PROGRAM} {__version__}")
    commands = top.add_subparsers(dest="command", required=True)
    for command, (line, description, examples, groups) in _COMMANDS.items():
        parser = commands.add_parser(
            command, help=line, **_manners(description, examples)
        )
        # For commands without these
        absent = dict.fromkeys(("weights", "points", "principal_point"))
        parser.set_defaults(**absent, missing_value=())
        for title, entries in groups.items():
            group = parser.add_argument_group(title)
            for entry in entries:
                is_one = isinstance(entry, str)
                place = group if is_one else group.add_mutually_exclusive_group()
                for name in [entry] if is_one else entry:
                    flag = name if name in POSITIONAL else flag_of(name)
                    place.add_argument(
                        *SHORT.get(name, []), flag, **_settings(command, name)
                    )
    return top


def _settings(command: str, name: str) -> dict[str, Any]:
    """Return the settings of an option of a command for `add_argument`."""
    entries = {entry.partition(" ")[0]: entry for entry in HELP}
    key = f"{command}.{name}" if f"{command}.{name}" in entries else name
    help, metavar = HELP[entries[key]], entries[key].partition(" ")[2]
    if not metavar and key not in CHOICES:
        return {"help": help, "action": "store_true"}
    default = DEFAULTS.get(key)
    settings: dict[str, Any] = {"default": default, "choices": CHOICES.get(key)}
    if metavar:
        settings |= {"metavar": metavar, "type": TYPES.get(metavar)}
    if metavar == "X Y":
        settings |= {"metavar": ("X", "Y"), "nargs": 2}
    if name == "output":
        settings["required"] = default is None
    if key in FIRST:
        help += f" (default: {default})"
    if key in REPEATED:
        help += "; may be repeated"
        settings |= {"action": "append", "default": []}
    return settings | {"help": help}


def flag_of(name: str) -> str:
    """Return how an argument is written in the command line."""
    return name.upper() if name in POSITIONAL else f"--{name.replace('_', '-')}"


def _manners(description: str, epilog: str) -> dict[str, Any]:
    """Return the settings of all parsers: help as it is written, exact options."""
    return {
        "description": description,
        "epilog": epilog,
        "formatter_class": argparse.RawDescriptionHelpFormatter,
        "allow_abbrev": False,
    }
