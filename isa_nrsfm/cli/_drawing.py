"""What the options --edges and --skeleton mean for the points of a table."""

import argparse
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from isa_nrsfm._compat.damaged_files import reading
from isa_nrsfm.cli._drawing_options import CONFIGURATIONS, NONE
from isa_nrsfm.skeletons import Skeleton, get_skeleton, read_skeleton


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
    # With --points the option is of all points, and the layout of the rest is stored.
    some_points = stored is not None and getattr(args, "points", None) is not None
    if args.skeleton is not None and not some_points:
        if Path(args.skeleton).suffix.lower() in CONFIGURATIONS:
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


def _read_edges(path: str, point_names: Sequence[str]) -> NDArray[np.intp]:
    """Read which points are joined."""
    numbers = {name: j for j, name in enumerate(point_names)}
    edges: list[list[int]] = []
    with reading(path, "a list of edges"):
        lines = Path(path).read_text(encoding="utf-8-sig").splitlines()
    for number, line in enumerate(lines):
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
