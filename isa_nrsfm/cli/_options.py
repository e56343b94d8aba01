"""The options of all commands, each written once.

``--help`` must not wait for imports of the estimator or a reader. `tests/test_cli.py`
compares the defaults with those of `AffineNRSfM` and its strategies.
"""

import re
from argparse import ArgumentTypeError
from collections.abc import Callable
from pathlib import Path
from typing import Any

from isa_nrsfm._parameters.choices import (
    BLOCK_RECOVERIES,
    CAMERA_NAMES,
    INDEPENDENCE,
    LOSSES,
    REFINEMENTS,
    SKELETON_NAMES,
)
from isa_nrsfm.io._formats import FORMATS, TABLE

# The number of basis shapes that the table determines.
AUTO = "auto"
# The value of an option that switches something off.
NONE = "none"
# Configuration files of DeepLabCut.
CONFIGURATIONS = (".yaml", ".yml")
# What export writes, and the suffixes of the files.
SUFFIXES = {
    "viewer": (".html", ".htm"),
    "glb": (".glb",),
    "pdm": (".txt",),
    "shapes": (".npz", ".mat"),
}


def a_path(text: str) -> str:
    """Read the path of a file or a folder."""
    if not text.strip():
        raise ArgumentTypeError("expected a path; got an empty text")
    return text


def whole_number(smallest: int, largest: int = 2**31 - 1) -> Callable[[str], int]:
    """Return a function that reads a whole number in a range."""

    def read(text: str) -> int:
        try:
            number = int(text)
        except ValueError:
            number = smallest - 1
        if not smallest <= number <= largest:
            raise ArgumentTypeError(
                f"expected a whole number from {smallest} to {largest}; got {text!r}"
            )
        return number

    return read


def numbers_of_shapes(text: str) -> tuple[int | str, ...]:
    """Read numbers of basis shapes, such as 9, 1-8 or 3,6,9, ascending; or auto."""
    if text.strip() == AUTO:
        return (AUTO,)
    numbers: set[int] = set()
    for part in text.split(","):
        bounds = re.fullmatch(r"(\d+)\s*-\s*(\d+)", part.strip())
        ends = bounds.groups() if bounds else (part, part)
        low, high = map(whole_number(1), ends)
        if not low <= high < low + 100:
            raise ArgumentTypeError(
                "expected a range of at most 100 numbers, the smaller one first, such "
                f"as 1-8; got {part!r}"
            )
        numbers.update(range(low, high + 1))
    return tuple(sorted(numbers))


def number_of_modes(text: str) -> float:
    """Read a whole number of at least 1, or a share between 0 and 1."""
    number = _float(text)
    if 0 < number < 1:
        return number
    if number < 1 or not number.is_integer():
        raise ArgumentTypeError(
            f"expected a whole number or a share between 0 and 1; got {text!r}"
        )
    return int(number)


def positive_number(text: str) -> float:
    """Read a finite number above zero."""
    number = _float(text)
    if not 0 < number < float("inf"):
        raise ArgumentTypeError(f"expected a number above zero; got {text!r}")
    return number


def _float(text: str) -> float:
    """Read a number; zero where it is none."""
    try:
        return float(text)
    except ValueError:
        return 0.0


def image_size(text: str) -> tuple[int, int]:
    """Read WIDTHxHEIGHT."""
    match = re.fullmatch(r"([1-9]\d*)[xX]([1-9]\d*)", text.strip())
    if match is None:
        raise ArgumentTypeError(
            f"expected WIDTHxHEIGHT, such as 1920x1080; got {text!r}"
        )
    return int(match[1]), int(match[2])


def row_rule(text: str) -> tuple[str, re.Pattern[str]]:
    """Read COLUMN=REGEX."""
    column, equals, expression = text.partition("=")
    if not (column.strip() and equals and expression):
        raise ArgumentTypeError(
            f"expected COLUMN=REGEX, such as 'name=^ir'; got {text!r}"
        )
    try:
        return column.strip(), re.compile(expression)
    except re.error as error:
        raise ArgumentTypeError(
            f"{expression!r} is not a regular expression: {error}"
        ) from error


def point_pair(text: str) -> tuple[str, ...]:
    """Read two points with a comma between them."""
    points = tuple(each.strip() for each in text.split(","))
    if len(points) != 2 or not all(points):
        raise ArgumentTypeError(
            "expected two points with a comma between them, such as 48,54; "
            f"got {text!r}"
        )
    return points


def skeleton_name(text: str) -> str:
    """Read the name of a layout, or the path of a configuration of DeepLabCut."""
    if text in SKELETON_NAMES or Path(text).suffix.lower() in CONFIGURATIONS:
        return text
    raise ArgumentTypeError(
        f"expected one of {', '.join(SKELETON_NAMES)}, or a .yaml file; got {text!r}"
    )


def listed_names(text: str) -> list[str]:
    """Read names with commas between them."""
    return [name.strip() for name in text.split(",")]


# How the values of options are read, by their names in the help; others are texts.
TYPES: dict[str, Callable[[str], Any]] = {
    **dict.fromkeys(("FILE", "DIR", "TABLE", "MODEL"), a_path),
    "COLUMN=REGEX": row_rule,
    "CONFIDENCE": float,
    "K": numbers_of_shapes,
    "LAYOUT": skeleton_name,
    "MODES": number_of_modes,
    "N": int,
    "NAMES": listed_names,
    "NUMBER": positive_number,
    "POINT,POINT": point_pair,
    "SEED": whole_number(0, 2**32 - 1),
    "STARTS": whole_number(1),
    "WIDTHxHEIGHT": image_size,
}


def _option(help: str, metavar: str, **settings: Any) -> dict[str, Any]:
    """Return the arguments of `add_argument` for an option with a value."""
    return {"help": help, "metavar": metavar, "type": TYPES.get(metavar)} | settings


def _flag(help: str) -> dict[str, Any]:
    """Return the arguments of `add_argument` for an option without a value."""
    return {"help": help, "action": "store_true"}


def _list(help: str, metavar: str, **settings: Any) -> dict[str, Any]:
    """Return the arguments of `add_argument` for an option that may be repeated."""
    settings |= {"action": "append", "default": []}
    return _option(f"{help}; may be repeated", metavar, **settings)


def _choice(help: str, choices: tuple[str, ...]) -> dict[str, Any]:
    """Return the arguments of `add_argument` for a choice, whose first one is taken."""
    help = f"{help} (default: {choices[0]})"
    return {"help": help, "choices": choices, "default": choices[0]}


# Arguments without a leading -- in the command line.
POSITIONAL = ("table", "model")
SHORT = {"output": "-o", "n_components": "-k"}
OPTIONS: dict[str, dict[str, Any]] = {
    "model": _option("model.npz, written by fit", "MODEL"),
    # The table.
    "table": _option(
        "a .csv, .tsv or .parquet file, or a file or folder of another format", "TABLE"
    ),
    "format": _option(
        "the program that wrote the table: "
        f"{', '.join(name for name in FORMATS if name != TABLE)}, or {TABLE} for "
        "any table with named columns (default: auto, recognised by the beginning of "
        "the file)",
        "FORMAT",
        choices=["auto", *FORMATS],
        default="auto",
    ),
    "columns": _option(
        "patterns of the x and y columns, if their names are ambiguous: # for a "
        "number, * for any text, such as 'x_#,y_#' or '*.px,*.py'",
        "PATTERN",
    ),
    "skip_rows": _list(
        "leave out rows whose column matches the expression, such as 'name=^ir'",
        "COLUMN=REGEX",
    ),
    "zeros_missing": _flag("treat points at exactly (0, 0) as missing"),
    "min_confidence": _option(
        "treat points with a lower confidence as missing",
        "CONFIDENCE",
    ),
    "image_size": _option(
        "size of the images for MediaPipe, in pixels, such as 1920x1080",
        "WIDTHxHEIGHT",
    ),
    "points": _option(
        "fit some of the points: inner (without the visible outline of a face, which "
        "slides over the surface as the head turns), or names, numbers and ranges such "
        "as nose,36-47 or without:0-16",
        "POINTS",
    ),
    # What is written.
    "output": _option(
        "folder for the results, created if absent", "DIR", required=True
    ),
    "no_figures": _flag("write no figures (png), and remove those of an earlier run"),
    "std": _flag(
        "add the standard deviation of each coefficient, in columns such as alpha_1_std"
    ),
    "viewer": _option("write a page that shows the new frames in 3D (.html)", "FILE"),
    "edges": _option(
        "lines to draw between points: a .csv file with the names of two points per "
        "line, or of three for a surface; 'none' draws only points",
        "FILE",
    ),
    "skeleton": _option(
        "the layout of the points, if names, number and order of the points do not "
        f"determine it: {', '.join(SKELETON_NAMES)}, or the config.yaml of DeepLabCut",
        "LAYOUT",
    ),
    "origin": {
        "help": "where y is zero: upper in images, whose y points down, lower if y "
        "points up (default: auto, lower for faces that would be upside down)",
        "choices": ["auto", "upper", "lower"],
    },
    # Other columns.
    "label": _list(
        "a class or a number for each frame, such as an expression or an age: reports "
        "the dependence of the coefficients on it. Whole numbers are classes unless "
        "given as COLUMN:number",
        "COLUMN",
    ),
    "group": _option(
        "people, videos or files: reports the variance between and within groups. "
        "Held-out frames come from other groups; smoothing stops at their borders",
        "COLUMN",
    ),
    "distance": _list(
        "add the distance of two points of the 3D shapes to alpha.csv, in units of the "
        "distance between the outer corners of the eyes",
        "POINT,POINT",
    ),
    "unit": _option(
        "two points whose distance in the mean shape is the unit of --distance",
        "POINT,POINT",
    ),
    "length": _option(
        "the length of that unit, such as 90 for millimetres (default: 1)",
        "NUMBER",
        default=1.0,
    ),
    "time": _option(
        "times of the frames, numbers or dates: adds smoothed coefficients",
        "COLUMN",
    ),
    "fps": _option(
        "instead of --time, the frames per second of a video",
        "NUMBER",
    ),
    # The method.
    "n_components": _option(
        "number of basis shapes (default: 3). Of several, such as 1-8 or 3,6,9, the "
        "best in cross-validation is used; auto uses as many as the table determines, "
        "at most twelve",
        "K",
        default="3",
    ),
    "camera": _choice(
        "camera model: affine (no assumption), weak_perspective (a rotation and a "
        "scale per frame), or orthographic (one scale). With the last two, shapes have "
        "true proportions",
        CAMERA_NAMES,
    ),
    "isa": _choice(
        "independent subspace analysis: FastICA with pooled components, or FastISA",
        ("pooled", "fast"),
    ),
    "n_init": _option(
        "number of random starts (default: 16 of pooled, 30 of fast)",
        "STARTS",
    ),
    "block_recovery": _choice(
        "algorithm that finds the block structure", BLOCK_RECOVERIES
    ),
    "refinement": _choice(
        "joint: cameras, coefficients and basis shapes together; alternating: the "
        "refinement of the paper, with cameras of the rigid part",
        (*REFINEMENTS, NONE),
    ),
    "independence": _choice(
        "joint refinement: independent basis shapes, or independent coefficients",
        (*INDEPENDENCE, NONE),
    ),
    "loss": _choice(
        "joint refinement: huber and cauchy limit the influence of outliers", LOSSES
    ),
    "no_scale_frames": _flag(
        "weight frames by their size in the image, as orthographic cameras always do"
    ),
    "random_state": _option(
        "seed of the random starts (default: 0)",
        "SEED",
        default=0,
    ),
    "n_jobs": _option(
        "processes for the random starts, -1 for all processors (default: 1)",
        "N",
    ),
    # Export.
    "content": {
        "help": "contents of the file, if the suffix leaves it open: pdm for a point "
        "distribution model as .mat (M, V and E) or .npz",
        "choices": list(SUFFIXES),
    },
    "n_modes": _option(
        "for a point distribution model, the number of modes, or the share of the "
        "variance that they explain, such as 0.98 (default: number of basis shapes)",
        "MODES",
    ),
    "names": _option(
        "for .html and .glb, names of the basis shapes with commas", "NAMES"
    ),
    "n_frames": _option("for .html, the largest number of frames (default: 1000)", "N"),
    "mirrored": _flag("take the mirror image in depth, which has the same images"),
}
# Where an option of one command differs from that of the others.
DIFFERENT: dict[tuple[str, str], dict[str, Any]] = {
    ("transform", "output"): {
        "metavar": "FILE",
        "help": "the .csv, .tsv or .parquet file to write",
    },
    ("export", "output"): {"metavar": "FILE", "help": "the file to write"},
    ("demo", "output"): {
        "required": False,
        "default": "isa-nrsfm-demo",
        "help": "folder for the results (default: ./isa-nrsfm-demo)",
    },
    ("export", "table"): {
        "nargs": "?",
        "help": "for .html, the table whose frames are shown",
    },
    ("export", "label"): {
        "action": "store",
        "default": None,
        "help": "for .html, the column of TABLE that determines the colours of frames",
    },
    ("export", "camera"): {
        "choices": ["weak_perspective", NONE],
        "default": None,
        "help": "camera model for a model with affine cameras; none exports affine "
        "shapes, whose angles and depth are not true (default: weak_perspective)",
    },
}
TABLE_OPTIONS = (
    *("format", "columns", "skip_rows", "zeros_missing", "min_confidence"),
    "image_size",
)
DRAWING = (("edges", "skeleton"), "origin")
