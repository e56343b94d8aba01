"""The options that say what joins the points, and what they mean for a table."""

import argparse
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from isa_nrsfm.skeletons import (
    SKELETONS,
    Skeleton,
    get_skeleton,
    read_skeleton,
)

NONE = "none"
_CONFIGURATIONS = (".yaml", ".yml")


def add_drawing_options(
    group: argparse._ActionsContainer,
    path: Callable[[str], str],
    where: str = "in viewer and figures",
    default: str = "those of a layout that is known",
) -> None:
    """Add the options --edges and --skeleton, of which one may be given."""
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
        f"{', '.join(SKELETONS)}, or the config.yaml of DeepLabCut",
    )


def chosen_edges(
    args: argparse.Namespace,
    names: Sequence[str],
    stored: Skeleton | None = None,
    *,
    surfaces: bool = False,
) -> Any:
    """
    Return what is to be drawn, as figures and exporters take it.

    Parameters
    ----------
    args : Namespace
        The options.
    names : sequence of str
        The names of the points, in the order of the model.
    stored : Skeleton, default=None
        What the file of the table says, or the program that has written it.
    surfaces : bool, default=False
        Whether triangles are to stay what they are; otherwise their sides are drawn.
    """
    if args.edges == NONE:
        return None
    if args.edges is not None:
        links = _read_edges(args.edges, names)
        if surfaces or links.shape[1] == 2:
            return links
        sides = links[:, [[0, 1], [1, 2], [2, 0]]].reshape(-1, 2)
        return np.unique(np.sort(sides, axis=1), axis=0)
    if args.skeleton is not None:
        if Path(args.skeleton).suffix.lower() in _CONFIGURATIONS:
            return read_skeleton(args.skeleton, names)
        skeleton = get_skeleton(args.skeleton)
        if skeleton.n_points != len(names):
            raise ValueError(
                f"--skeleton {args.skeleton} has {skeleton.n_points} points, the table "
                f"{len(names)}"
            )
        return skeleton
    if stored is None:
        return "auto"
    if stored.point_names is None or stored.n_points != len(names):
        return stored
    return stored.reordered(names) if set(names) == set(stored.point_names) else stored


def drawing_options(args: argparse.Namespace) -> list[str]:
    """Return the options that are given, as words of a command line."""
    words = (("--edges", args.edges), ("--skeleton", args.skeleton))
    return [word for pair in words if pair[1] is not None for word in pair]


def drawing_files(args: argparse.Namespace) -> list[str]:
    """Return the files that the options name."""
    files = [args.edges] if args.edges not in (None, NONE) else []
    if args.skeleton is not None and args.skeleton not in SKELETONS:
        files.append(args.skeleton)
    return files


def _skeleton(text: str) -> str:
    """Read the name of a layout or of a configuration of DeepLabCut."""
    configuration = Path(text).suffix.lower() in _CONFIGURATIONS
    if text not in SKELETONS and not configuration:
        raise argparse.ArgumentTypeError(
            f"expected one of {', '.join(SKELETONS)}, or a file .yaml; got {text!r}"
        )
    return text


def _read_edges(path: str, point_names: Sequence[str]) -> NDArray[np.intp]:
    """Read which points are joined."""
    numbers = {name: j for j, name in enumerate(point_names)}
    edges: list[list[int]] = []
    for number, line in enumerate(Path(path).read_text(encoding="utf-8").splitlines()):
        names = [name.strip() for name in line.split(",")]
        if not line.strip():
            continue
        unknown = [name for name in names if name not in numbers]
        size = len(edges[0]) if edges else len(names)
        if unknown or len(names) != size or size not in (2, 3):
            raise ValueError(
                f"{path}, line {number + 1}: expected the names of two or three points "
                f"with commas between them, such as {', '.join([*numbers][:2])}; got "
                f"{line!r}"
            )
        edges.append([numbers[name] for name in names])
    if not edges:
        raise ValueError(f"{path} has no edges; for points alone say --edges none")
    return np.array(edges)
