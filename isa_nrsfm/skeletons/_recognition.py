"""Which layout the points of a table have."""

import re
import tomllib
import warnings
from collections.abc import Mapping, Sequence
from pathlib import Path
from types import MappingProxyType
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.spatial.distance import pdist

from isa_nrsfm.skeletons._skeleton import Skeleton


def _tuples(value: Any) -> Any:
    """Return a value of a data file, with tuples in place of lists."""
    return tuple(map(_tuples, value)) if isinstance(value, list) else value


_FILE = Path(__file__).with_name("layouts.toml")
_TABLES: dict[str, dict[str, Any]] = tomllib.loads(_FILE.read_text(encoding="utf-8"))
SKELETONS = MappingProxyType(
    {
        name: Skeleton(name, **{part: _tuples(entry[part]) for part in entry})
        for name, entry in _TABLES["layouts"].items()
    }
)
# The layouts in which the readers of `isa_nrsfm.io` find points without names.
LAYOUTS_OF_READERS: Mapping[str, tuple[str, ...]] = {
    reader: tuple(names) for reader, names in _TABLES["readers"].items()
}

# Edges of a layout are short: so long at most is their mean, relative to the mean
# distance of all points. Faces in their own order have 0.14 to 0.25 in single images
# and 0.17 to 0.23 in the mean, hands 0.32 to 0.68 and 0.5, bodies 0.35 to 0.5; points
# in any order have about 1.
LONGEST = {"face": 0.4}
# Of two layouts of faces with short edges that one is taken whose edges are so many
# times shorter: mean faces of 68 points have edges 1.28 to 1.55 times as long in the
# wrong order as in their own. Bodies of 17 points in the order of COCO have short edges
# in that of Human3.6M and are not distinguished.
CLEARLY = {"face": 1.15}

_SIDE_LETTER = re.compile(r"^([LR])(?=[A-Z][a-z])")
_SIDE_WORDS = {"L": "left", "R": "right"}
_NUMBERED = re.compile(r"(.*?)(\d+)")


def get_skeleton(name: str) -> Skeleton:
    """
    Return a layout by its name.

    Parameters
    ----------
    name : str
        One of the names in `SKELETONS`.

    Returns
    -------
    Skeleton
        The layout.

    Raises
    ------
    ValueError
        If there is none of this name.

    Examples
    --------
    >>> from isa_nrsfm.skeletons import get_skeleton
    >>> get_skeleton("hand-21").point_names[:3]
    ('wrist', 'thumb_cmc', 'thumb_mcp')
    """
    if not isinstance(name, str) or name not in SKELETONS:
        raise ValueError(f"the skeletons are {', '.join(SKELETONS)}; got {name!r}")
    return SKELETONS[name]


def checked_skeleton(given: Any, n_points: int) -> Skeleton:
    """Return a layout that is given itself or by name, of so many points, or raise."""
    skeleton = given if isinstance(given, Skeleton) else get_skeleton(given)
    if skeleton.n_points != n_points:
        raise ValueError(
            f"the skeleton {skeleton.name!r} has {skeleton.n_points} points, the shape "
            f"{n_points}"
        )
    return skeleton


def checked_links(name: str, links: Any, n_points: int) -> NDArray[np.intp]:
    """Return pairs of points, or raise."""
    found = np.asarray(links)
    if found.ndim != 2 or found.shape[1] != 2 or found.dtype.kind not in "iu":
        raise ValueError(
            f"{name} must be integers of shape (n_pairs, 2), the numbers of points; "
            f"got shape {found.shape} and dtype {found.dtype}"
        )
    if found.size and (found.min() < 0 or found.max() >= n_points):
        raise ValueError(
            f"{name} must name points 0 to {n_points - 1}; got {found.min()} to "
            f"{found.max()}"
        )
    return found.astype(np.intp)


def find_skeleton(
    n_points: int,
    names: Sequence[Any] | None = None,
    reader: str | None = None,
    *,
    shape: ArrayLike | None = None,
) -> Skeleton | None:
    """
    Find the layout of points, where one and only one fits.

    Names of points decide first, then the program that has written them, then their
    number and order.

    Parameters
    ----------
    n_points : int
        Number of points.
    names : sequence of length n_points, default=None
        Names of the points. Only their letters and digits are compared, without regard
        to case; LShoulder is left_shoulder. Points that are numbered in turn, such as
        0, 1, ... or kp1, kp2, ..., have no names.
    reader : str, default=None
        Format of the file that the points were read from, one of `io.FORMATS`.
    shape : array-like of shape (n_points, 2) or (n_points, 3), default=None
        The points in an image, or of a mean shape in true proportions. Layouts whose
        edges would be long there do not fit; of two layouts of faces that would fit
        that one is taken whose edges are clearly shorter.

    Returns
    -------
    Skeleton or None
        The layout; with its points in the order of `names` where these are its names
        in another order. None if no layout fits or more than one.

    Raises
    ------
    ValueError
        If there are not `n_points` names or points of the shape.

    See Also
    --------
    get_skeleton : A layout by its name.

    Examples
    --------
    >>> from isa_nrsfm.skeletons import find_skeleton
    >>> find_skeleton(21).name
    'hand-21'
    >>> find_skeleton(17) is None    # COCO, or Human3.6M?
    True
    >>> find_skeleton(17, reader="coco").name
    'coco-17'
    """
    if names is not None and len(names) != n_points:
        raise ValueError(f"names must hold {n_points} names; got {len(names)}")
    points = None if shape is None else np.asarray(shape, dtype=np.float64)
    if points is not None and (len(points) != n_points or points.ndim != 2):
        raise ValueError(
            f"shape must hold {n_points} points; got an array of shape {points.shape}"
        )
    fitting = [s for s in SKELETONS.values() if s.n_points == n_points]
    if names is not None and not numbered(list(map(str, names))):
        return _named(fitting, [str(name) for name in names])
    if reader is not None and reader in LAYOUTS_OF_READERS:
        fitting = [s for s in fitting if s.name in LAYOUTS_OF_READERS[reader]]
    if points is not None:
        return _shortest(fitting, points)
    return fitting[0] if len(fitting) == 1 else None


def skeleton_in_images(tracks: NDArray, names: Sequence[str]) -> Skeleton | None:
    """Return the layout of points (n_frames, n_points, 2), by names or mean image."""
    with warnings.catch_warnings(action="ignore"):  # points that no frame shows
        images = tracks - np.nanmean(tracks, axis=1, keepdims=True)
        shape = np.nanmean(images, axis=0)
    return find_skeleton(len(names), names, shape=shape)


def edge_length(shape: NDArray, edges: NDArray) -> float:
    """Return the mean length of edges, relative to that of all pairs of points.

    Points that are not seen, NaN, do not count; infinite where nothing is known.
    """
    ends = shape[edges]
    lengths = np.linalg.norm(ends[:, 0] - ends[:, 1], axis=1)
    distances = pdist(shape[np.isfinite(shape).all(axis=1)])
    lengths = lengths[np.isfinite(lengths)]
    if not lengths.size or not distances.any():
        return np.inf
    return float(lengths.mean() / distances.mean())


def _shortest(skeletons: Sequence[Skeleton], shape: NDArray) -> Skeleton | None:
    """Return the layout whose edges are short, and clearly shorter than others'."""
    lengths = [(edge_length(shape, s.edges), s) for s in skeletons]
    lengths.sort(key=lambda found: found[0])
    short = [(size, s) for size, s in lengths if size <= LONGEST.get(s.kind, 0.7)]
    if not short:
        return None
    (best, first), *others = short
    clearly = CLEARLY.get(first.kind, np.inf) * best
    return None if others and others[0][0] < clearly else first


def _named(skeletons: Sequence[Skeleton], names: Sequence[str]) -> Skeleton | None:
    """Return the layout that has these names, in whatever order."""
    plain = [_plain(name) for name in names]
    for skeleton in skeletons:
        known = {_plain(name): name for name in skeleton.point_names or ()}
        if known.keys() == set(plain):
            return skeleton.reordered([known[name] for name in plain])
    return None


def _plain(name: str) -> str:
    """Return the letters and digits of the name of a point, sides spelled out."""
    spelled = _SIDE_LETTER.sub(lambda match: _SIDE_WORDS[match[1]], name.strip())
    return "".join(letter for letter in spelled.lower() if letter.isalnum())


def numbered(names: Sequence[str]) -> bool:
    """Return whether names are numbers in turn, after the same word or nothing."""
    matches = [_NUMBERED.fullmatch(name.strip()) for name in names]
    found = [match for match in matches if match is not None]
    if len(found) < len(names) or len({match[1] for match in found}) > 1:
        return False
    numbers = [int(match[2]) for match in found]
    return numbers == list(range(numbers[0], numbers[0] + len(numbers)))
