"""The parser of the command line; `options.toml` has its commands and their help.

``--help`` must not wait for imports of the estimator or a reader. `tests/test_cli.py`
compares the defaults with those of `AffineNRSfM` and its strategies.
"""

import argparse
import math
import re
import tomllib
from collections.abc import Callable, Sequence
from contextlib import suppress
from pathlib import Path
from typing import Any, NoReturn

from isa_nrsfm import __version__, _parameters as choices
from isa_nrsfm._compat.texts import printable
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


def _reader(
    expected: str,
    read: Callable[[str], Any],
    is_allowed: Callable[[Any], bool] = lambda value: True,
) -> Callable[[str], Any]:
    """Return a function that reads allowed values, and names others in its error."""

    def reader(text: str) -> Any:
        with suppress(ValueError):
            value = read(text)
            if value is not None and is_allowed(value):
                return value
        raise _wrong(expected, repr(text))

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
    expected = "a range of at most 100 numbers, the smaller one first, such as 1-8"
    for part in text.split(","):
        bounds = re.fullmatch(r"(\d+)\s*-\s*(\d+)", part.strip())
        low, high = map(_whole_number(1), bounds.groups() if bounds else (part, part))
        if not low <= high < low + 100:
            raise _wrong(expected, repr(part))
        numbers.update(range(low, high + 1))
    return tuple(sorted(numbers))


def _share_or_number(text: str) -> float | None:
    """Read a share between 0 and 1, or a whole number as int."""
    number = float(text)
    if number >= 1 and number.is_integer():
        return int(number)
    return number if 0 < number < 1 else None


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


def _pair(text: str) -> tuple[str, ...] | None:
    """Read two names."""
    names = tuple(_names(text))
    return names if len(names) == 2 and all(names) else None


def _is_layout(text: str) -> bool:
    """Return whether a text is the name of a layout, or of a configuration."""
    return text in choices.SKELETON_NAMES or text.lower().endswith(CONFIGURATIONS)


# The commands with their options, and the help of each option by its name and value.
_DATA = tomllib.loads(Path(__file__).with_name("options.toml").read_text("utf-8"))
POSITIONAL = _DATA["positional"]
_LISTS = ("OPENPOSE_PARTS", "WHOLE_PARTS", "SKELETON_NAMES", "FACE_PRIORS")
_WORDS = {name: ", ".join(getattr(choices, name)) for name in _LISTS}
_WORDS["FORMATS"] = ", ".join(name for name in FORMATS if name != TABLE)
HELP = {option: text.format(**_WORDS) for option, text in _DATA["help"].items()}
_EXPECTED = {name: text.format(**_WORDS) for name, text in _DATA["expected"].items()}
# How the values of options are read, by their names in the help; others are texts.
TYPES: dict[str, Callable[[str], Any]] = {
    **dict.fromkeys(("FILE", "DIR", "TABLE", "MODEL"), _path),
    "COLUMN=REGEX": _reader(_EXPECTED["COLUMN=REGEX"], _row_rule),
    "CONFIDENCE": float,
    "K": _numbers_of_shapes,
    "LAYOUT": _reader(_EXPECTED["LAYOUT"], str, _is_layout),
    "MODES": _reader(_EXPECTED["MODES"], _share_or_number),
    "N": int,
    "NAMES": _names,
    "NUMBER": _reader(_EXPECTED["NUMBER"], float, lambda n: 0 < n < math.inf),
    "POINT,POINT": _reader(_EXPECTED["POINT,POINT"], _pair),
    "SEED": _whole_number(0, 2**32 - 1),
    "STARTS": _whole_number(1),
    "VALUE": _reader(_EXPECTED["VALUE"], float, math.isfinite),
    "WIDTHxHEIGHT": _reader(_EXPECTED["WIDTHxHEIGHT"], _image_size),
    "X Y": _reader(_EXPECTED["VALUE"], float, math.isfinite),
}
# What export writes: suffixes of the files, and options.
EXPORTS = _DATA["exports"]
TIMES = _DATA["times"]
# The values of options that have few.
CHOICES: dict[str, Sequence[str]] = _DATA["choices"] | {
    "format": ("auto", *FORMATS),
    "part": tuple(dict.fromkeys((*choices.OPENPOSE_PARTS, *choices.WHOLE_PARTS))),
    "camera": choices.CAMERA_NAMES,
    "block_recovery": choices.BLOCK_RECOVERIES,
    "refinement": (*choices.REFINEMENTS, NONE),
    "independence": (*choices.INDEPENDENCE, NONE),
    "loss": choices.LOSSES,
}
FIRST = _DATA["first"]
DEFAULTS = _DATA["defaults"] | {n: CHOICES[n][0] for n in ("format", *FIRST)}


class Parser(argparse.ArgumentParser):
    """A parser whose errors are one line."""

    def error(self, message: str) -> NoReturn:
        """End with the message of an error."""
        text = printable(f"{self.prog}: error: {message} (see {self.prog} --help)")
        self.exit(2, f"{text}\n")


def build_parser() -> Parser:
    """Return the parser of the command line."""
    top = Parser(PROGRAM, **_manners(_DATA))
    top.add_argument("--version", action="version", version=f"{PROGRAM} {__version__}")
    commands = top.add_subparsers(dest="command", required=True)
    for command, entry in _DATA["commands"].items():
        parser = commands.add_parser(command, help=entry["line"], **_manners(entry))
        # For commands without these
        absent = dict.fromkeys(("weights", "points", "principal_point"))
        parser.set_defaults(**absent, missing_value=())
        for title, options in entry["groups"].items():
            group = parser.add_argument_group(title)
            for option in options:
                is_one = isinstance(option, str)
                place = group if is_one else group.add_mutually_exclusive_group()
                for name in [option] if is_one else option:
                    flags = [name if name in POSITIONAL else flag_of(name)]
                    flags = _DATA["short"].get(name, []) + flags
                    place.add_argument(*flags, **_settings(command, name))
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
    settings |= {"metavar": metavar or None, "type": TYPES.get(metavar)}
    if metavar == "X Y":
        settings |= {"metavar": ("X", "Y"), "nargs": 2}
    if name == "output":
        settings["required"] = default is None
    if key in FIRST:
        help += f" (default: {default})"
    if key in _DATA["repeated"]:
        help += "; may be repeated"
        settings |= {"action": "append", "default": []}
    return settings | {"help": help}


def flag_of(name: str) -> str:
    """Return how an argument is written in the command line."""
    return name.upper() if name in POSITIONAL else f"--{name.replace('_', '-')}"


def _manners(entry: dict[str, Any]) -> dict[str, Any]:
    """Return the settings of all parsers: help as it is written, exact options."""
    return {
        "description": entry["description"],
        "epilog": entry["examples"],
        "formatter_class": argparse.RawDescriptionHelpFormatter,
        "allow_abbrev": False,
    }
