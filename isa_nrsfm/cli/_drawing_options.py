"""The options that say how points are drawn. No library is imported here."""

import argparse
from collections.abc import Callable
from pathlib import Path

from isa_nrsfm._parameters.choices import SKELETON_NAMES

NONE = "none"
_NAMES = ("edges", "skeleton", "origin")
CONFIGURATIONS = (".yaml", ".yml")


def add_drawing_options(
    group: argparse._ActionsContainer,
    path: Callable[[str], str],
    where: str = "in viewer and figures",
    default: str = "those of a layout that is known",
) -> None:
    """Add the options --edges or --skeleton, and --origin."""
    options = group.add_mutually_exclusive_group()
    options.add_argument(
        "--edges",
        metavar="FILE",
        type=path,
        help=f"what joins the points {where}: a .csv file without header that has the "
        "names of two points a line, or of three for a surface; 'none' for points "
        f"alone (default: {default})",
    )
    options.add_argument(
        "--skeleton",
        metavar="NAME",
        type=_skeleton,
        help="the layout of the points, where neither the program that has written the "
        f"table nor names, number and order of the points tell it: "
        f"{', '.join(SKELETON_NAMES)}, or the config.yaml of DeepLabCut",
    )
    group.add_argument(
        "--origin",
        choices=["auto", "upper", "lower"],
        help="where y is zero: upper in images, whose y points down, lower where it "
        "points up (default: auto, lower for faces that would be upside down)",
    )


def drawing_options(args: argparse.Namespace) -> list[str]:
    """Return the options that are given, as words of a command line."""
    words = [(f"--{name}", getattr(args, name)) for name in _NAMES]
    return [word for pair in words if pair[1] is not None for word in pair]


def drawing_files(args: argparse.Namespace) -> list[str]:
    """Return the files that the options name."""
    files = [args.edges] if args.edges not in (None, NONE) else []
    if args.skeleton is not None and args.skeleton not in SKELETON_NAMES:
        files.append(args.skeleton)
    return files


def _skeleton(text: str) -> str:
    """Read the name of a layout or of a configuration of DeepLabCut."""
    configuration = Path(text).suffix.lower() in CONFIGURATIONS
    if text not in SKELETON_NAMES and not configuration:
        raise argparse.ArgumentTypeError(
            f"expected one of {', '.join(SKELETON_NAMES)}, or a file .yaml; "
            f"got {text!r}"
        )
    return text
