"""The lines between points that --edges and --skeleton ask for."""

from argparse import Namespace
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from isa_nrsfm._compat.damaged_files import reading
from isa_nrsfm._parameters.choices import SKELETON_NAMES
from isa_nrsfm.cli._options import CONFIGURATIONS, NONE
from isa_nrsfm.skeletons import Skeleton, get_skeleton, read_skeleton


def is_configuration(skeleton: str | None) -> bool:
    """Return whether --skeleton is a configuration of DeepLabCut."""
    return skeleton is not None and Path(skeleton).suffix.lower() in CONFIGURATIONS


def drawing_options(args: Namespace) -> list[str]:
    """Return the options of drawing that are given, as words of a command line."""
    words = [
        (f"--{name}", vars(args)[name]) for name in ("edges", "skeleton", "origin")
    ]
    return [word for pair in words if pair[1] is not None for word in pair]


def drawing_files(args: Namespace) -> list[str]:
    """Return the files that the options of drawing name."""
    named = [args.edges, args.skeleton]
    return [each for each in named if each not in (None, NONE, *SKELETON_NAMES)]


def chosen_edges(
    args: Namespace,
    names: Sequence[str],
    stored: Skeleton | None = None,
    *,
    surfaces: bool = False,
) -> Any:
    """Return the lines to draw: an option, or the skeleton stored in the table.

    Triangles become lines unless surfaces are drawn.
    """
    if args.edges == NONE:
        return None
    if args.edges is not None:
        links = _read_edges(args.edges, names)
        if surfaces or links.shape[1] == 2:
            return links
        sides = links[:, [[0, 1], [1, 2], [2, 0]]].reshape(-1, 2)
        return np.unique(np.sort(sides, axis=1), axis=0)
    # With --points, --skeleton is the layout of all points, and `stored` of the rest.
    some_points = stored is not None and getattr(args, "points", None) is not None
    if args.skeleton is not None and not some_points:
        if is_configuration(args.skeleton):
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
    named = stored.point_names is not None and sorted(stored.point_names)
    return stored.reordered(names) if named == sorted(names) else stored


def _read_edges(path: str, names: Sequence[str]) -> NDArray[np.intp]:
    """Read pairs or triples of points (n_edges, 2 or 3)."""
    with reading(path, "a list of edges"):
        lines = Path(path).read_text(encoding="utf-8-sig").splitlines()
    edges: list[list[str]] = []
    for number, line in enumerate(lines):
        if not line.strip():
            continue
        edges.append([name.strip() for name in line.split(",")])
        sizes = {len(edge) for edge in edges}
        if sizes not in ({2}, {3}) or not {*edges[-1]} <= {*names}:
            raise ValueError(
                f"{path}, line {number + 1}: expected the names of two or three points "
                f"with commas between them, such as {', '.join(names[:2])}; got "
                f"{line!r}"
            )
    if not edges:
        raise ValueError(f"{path} has no edges; use --edges none to draw only points")
    numbers = {name: j for j, name in enumerate(names)}
    return np.array([[numbers[name] for name in edge] for edge in edges])
