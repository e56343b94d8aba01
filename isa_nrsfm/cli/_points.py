"""The points of a table that the option --points keeps."""

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from isa_nrsfm.skeletons import SKELETONS, Skeleton, find_skeleton, get_skeleton

INNER, WITHOUT = "inner", "without:"


def layout_of_table(
    skeleton: str | Skeleton | None, names: Sequence[str], tracks: NDArray
) -> Skeleton | None:
    """
    Return the layout of all points of a table, if it is known.

    Parameters
    ----------
    skeleton : str, Skeleton or None
        The layout or its name, if the user or the file gives it.
    names : sequence of str
        Names of the points.
    tracks : ndarray of shape (n_frames, n_points, 2)
        The points; NaN where one is missing.
    """
    if isinstance(skeleton, str):
        named = get_skeleton(skeleton)
        return named if named.n_points == len(names) else None
    if skeleton is not None:
        return skeleton
    tracks = tracks[np.isfinite(tracks).all(axis=(1, 2))]
    centred = tracks - tracks.mean(axis=1, keepdims=True)
    sizes = np.linalg.norm(centred, axis=(1, 2), keepdims=True)
    image = (centred / sizes).mean(axis=0) if len(tracks) else None
    return find_skeleton(len(names), names, shape=image)


def kept_points(text: str, names: Sequence[str], layout: Skeleton | None) -> list[int]:
    """
    Return the numbers of the points that the option names, in their order.

    Parameters
    ----------
    text : str
        "inner", or names, numbers and ranges with commas between them, after
        "without:" those that are left out.
    names : sequence of str
        Names of the points.
    layout : Skeleton or None
        Their layout.
    """
    if text == INNER:
        if layout is None or not layout.contour:
            known = ", ".join(s.name for s in SKELETONS.values() if s.contour)
            found = "in no known layout" if layout is None else f"of {layout.name}"
            raise ValueError(
                "--points inner leaves out the visible outline of a face, but the "
                f"{len(names)} points are {found}: name the points to keep, or give "
                f"--skeleton ({known})"
            )
        return [int(j) for j in layout.inner]
    numbers = {name: j for j, name in enumerate(names)}
    named: set[int] = set()
    for part in text.removeprefix(WITHOUT).split(","):
        named.update(_range(part.strip(), numbers))
    if text.startswith(WITHOUT):
        return [j for j in range(len(names)) if j not in named]
    return sorted(named)


def part_of_layout(layout: Skeleton | None, points: Sequence[int]) -> Skeleton | None:
    """Return the layout of some of its points, a known one if there is one."""
    if layout is None:
        return None
    part = layout.subset(points)
    known = (s for s in SKELETONS.values() if s.n_points == part.n_points)
    return next((s for s in known if s.curves == part.curves), part)


def _range(part: str, numbers: dict[str, int]) -> range:
    """Return the points of a name, a number, or two with a hyphen between them."""
    if (j := _number(part, numbers)) is not None:
        return range(j, j + 1)
    for place in (i for i, letter in enumerate(part) if letter == "-"):
        first = _number(part[:place].strip(), numbers)
        last = _number(part[place + 1 :].strip(), numbers)
        if first is not None and last is not None and first <= last:
            return range(first, last + 1)
    raise ValueError(
        f"--points: there are no points {part!r}; the {len(numbers)} points are "
        f"{', '.join([*numbers][:4])}, ...; write inner, or names and ranges such as "
        "17-67 or without:0-16"
    )


def _number(text: str, numbers: dict[str, int]) -> int | None:
    """Return the number of a point by its name, or else by its number from zero."""
    if text in numbers:
        return numbers[text]
    if text.isdecimal() and int(text) < len(numbers):
        return int(text)
    return None
