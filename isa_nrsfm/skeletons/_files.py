"""Skeletons that other programs keep beside their points."""

import os
import re
from collections.abc import Sequence
from itertools import pairwise
from pathlib import Path

from isa_nrsfm._compat.damaged_files import reading
from isa_nrsfm._compat.optional import import_optional
from isa_nrsfm.skeletons._skeleton import Skeleton

_RIGHT_OF = {"left": "right", "Left": "Right", "LEFT": "RIGHT"}


def skeleton_of_names(
    edges: Sequence[Sequence[str]],
    point_names: Sequence[str],
    *,
    name: str,
    source: str,
) -> Skeleton:
    """
    Make a skeleton of edges between points that have names.

    Parameters
    ----------
    edges : sequence of pairs of str
        The names of the two points of each edge.
    point_names : sequence of str
        The names of all points, in their order.
    name : str
        What to call the skeleton.
    source : str
        Where it is from.

    Returns
    -------
    Skeleton
        Points whose names differ by the words left and right only are on the sides.

    Raises
    ------
    ValueError
        If an edge is not between two of the points, or two points have one name.

    Examples
    --------
    >>> from isa_nrsfm.skeletons import skeleton_of_names
    >>> mouse = skeleton_of_names([("snout", "leftear"), ("snout", "rightear")],
    ...                           ["snout", "leftear", "rightear"],
    ...                           name="mouse", source="config.yaml")
    >>> mouse.left, mouse.right
    ((1,), (2,))
    """
    names = [str(point) for point in point_names]
    place = {point: j for j, point in enumerate(names)}
    for edge in edges:
        if isinstance(edge, str) or len(edge) != 2 or not {*edge} <= place.keys():
            raise ValueError(
                f"an edge of {name!r} should be a pair of the points "
                f"{', '.join(names[:6])}{', ...' if len(names) > 6 else ''}; got "
                f"{edge!r}"
            )
    curves = tuple((place[a], place[b]) for a, b in edges)
    swapped = (re.sub("left|Left|LEFT", lambda m: _RIGHT_OF[m[0]], n) for n in names)
    mirror = [place.get(point) for point in swapped]
    pairs = [(j, k) for j, k in enumerate(mirror) if k is not None and k != j]
    return Skeleton(
        name,
        "other",
        len(names),
        curves,
        source,
        tuple(names),
        left=tuple(left for left, _ in pairs),
        right=tuple(right for _, right in pairs),
    )


def read_skeleton(path: str | os.PathLike[str], point_names: Sequence[str]) -> Skeleton:
    """
    Read the skeleton of a project of DeepLabCut.

    Parameters
    ----------
    path : str or path-like
        The file ``config.yaml`` of the project, whose list ``skeleton`` has pairs of
        bodyparts.
    point_names : sequence of str
        The names of the points of the table, in their order.

    Returns
    -------
    Skeleton
        The skeleton of these points.

    Raises
    ------
    ValueError
        If the file has no such list, or it has points that are not in the table.
    OSError
        If the file cannot be opened.
    ImportError
        If PyYAML is not installed.

    See Also
    --------
    find_skeleton : A layout that is known.
    """
    yaml = import_optional("yaml", extra="yaml")
    with reading(path, "a configuration of DeepLabCut"):
        # YAML tells UTF-8 and UTF-16 apart itself. All values stay texts, also NO and
        # 1, and merge keys, which can take exponential time, are names as others.
        content = yaml.load(Path(path).read_bytes(), Loader=yaml.BaseLoader)
        edges = content.get("skeleton") if isinstance(content, dict) else None
        if not isinstance(edges, list) or not all(
            isinstance(edge, list) and all(isinstance(part, str) for part in edge)
            for edge in edges
        ):
            raise ValueError(
                "it has no list of pairs of bodyparts called skeleton, such as [[nose, "
                "chin], [chin, neck]]"
            )
        # A curve may be written as more than two bodyparts in turn.
        pairs = [pair for edge in edges for pair in pairwise(edge)]
        name = Path(path).name
        source = f"DeepLabCut, {name}"
        return skeleton_of_names(pairs, point_names, name=name, source=source)
