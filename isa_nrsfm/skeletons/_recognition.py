"""Layouts of landmarks: the class, those that are known, and which one a table has."""

import os
import re
import tomllib
import warnings
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import chain, groupby, pairwise
from pathlib import Path
from types import MappingProxyType
from typing import Any, Literal

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.spatial.distance import pdist

from isa_nrsfm._compat.files import reading
from isa_nrsfm._compat.lazy import import_optional

Kind = Literal["face", "hand", "body", "whole body", "other"]
KINDS: tuple[Kind, ...] = ("face", "hand", "body", "whole body", "other")
MIDDLE, LEFT, RIGHT = 0, 1, 2

Pairs = tuple[tuple[int, int], ...]


@dataclass(frozen=True)
class Skeleton:
    """
    A layout of landmarks: names, lines between points, left and right, the pose.

    Points are named by their index in the layout. Left and right are
    sides of the person or animal, not of the viewer.

    Parameters
    ----------
    name : str
        Name of the layout.
    kind : {"face", "hand", "body", "whole body", "other"}
        The object on which the points lie.
    n_points : int
        Number of points.
    curves : tuple of tuples of int
        Points along each curve, at least two a curve. A closed one ends with the point
        that it begins with.
    source : str
        Where the order and the curves are documented.
    point_names : tuple of str of length n_points or None, default=None
        Names of the points, where the layout has them.
    left, right : tuple of int, default=()
        Points of the left and of the right side, which are mirror images in turn:
        ``left[i]`` of ``right[i]``.
    up : tuple of pairs of int, default=()
        A lower point and one above it, as `calibration.canonical_pose` takes them.
    front : tuple of pairs of int, default=()
        A point and one in front of it, likewise.
    across : tuple of pairs of int, default=()
        Pairs of a right and a left point that determine the axis across. By default all
        pairs of `right` and `left`, which is wrong for points of arms and legs.
    contour : tuple of int, default=()
        Points that annotators place on the visible outline, such as the jaw of a face.
        They slide over the surface as the head turns: the pose changes their place on
        the face, and with it the coefficients.

    Raises
    ------
    ValueError
        If points do not exist, a name is not given to one point, or the sides have
        different numbers of points.

    See Also
    --------
    find_skeleton : The layout of a table.

    Examples
    --------
    >>> from isa_nrsfm.skeletons import Skeleton
    >>> mouse = Skeleton("mouse", "other", 4, curves=((1, 0, 2), (0, 3)),
    ...                  source="ours", left=(1,), right=(2,))
    >>> mouse.edges
    array([[1, 0],
           [0, 2],
           [0, 3]])
    >>> mouse.edge_sides
    array([1, 2, 0])
    """

    name: str
    kind: Kind
    n_points: int
    curves: tuple[tuple[int, ...], ...]
    source: str
    point_names: tuple[str, ...] | None = None
    left: tuple[int, ...] = ()
    right: tuple[int, ...] = ()
    up: Pairs = ()
    front: Pairs = ()
    across: Pairs = ()
    contour: tuple[int, ...] = ()

    def __post_init__(self) -> None:
        """Check that the parts fit together."""
        n, names = self.n_points, self.point_names
        if self.kind not in KINDS:
            raise ValueError(f"kind must be one of {KINDS}; got {self.kind!r}")
        parts = *self.curves, *self.up, *self.front, *self.across
        named = chain(*parts, self.left, self.right, self.contour)
        if strange := [j for j in named if not 0 <= j < n]:
            raise ValueError(
                f"the points of {self.name!r} are 0 to {n - 1}; got {strange[0]}"
            )
        if len(self.left) != len(self.right):
            raise ValueError(
                "left and right must be mirror images, point by point; got "
                f"{len(self.left)} and {len(self.right)} points"
            )
        if names is not None and len({*names}) != n:
            raise ValueError(
                f"point_names must hold {n} different names; got {len({*names})}"
            )

    @property
    def edges(self) -> NDArray[np.intp]:
        """Return pairs of neighbours on a curve, integers of shape (n_edges, 2)."""
        pairs = [pair for curve in self.curves for pair in pairwise(curve)]
        return np.array(pairs, dtype=np.intp).reshape(-1, 2)

    @property
    def left_right(self) -> NDArray[np.intp]:
        """
        Return the pairs (n_pairs, 2) that `canonical_pose` takes as `left_right`.

        The point on the right side comes first: it is on the left for somebody who is
        looked at.
        """
        pairs = self.across or tuple(zip(self.right, self.left, strict=True))
        return np.array(pairs, dtype=np.intp).reshape(-1, 2)

    @property
    def sides(self) -> NDArray[np.intp]:
        """Return the side of each point: 0 in the middle, 1 left, 2 right."""
        sides = np.full(self.n_points, MIDDLE)
        sides[list(self.left)] = LEFT
        sides[list(self.right)] = RIGHT
        return sides

    @property
    def edge_sides(self) -> NDArray[np.intp]:
        """
        Return the side of each edge: the common side of its ends, otherwise the middle.

        An edge from the middle to a side is on that side.
        """
        first, second = self.sides[self.edges].T
        one = np.where(first == MIDDLE, second, first)
        return np.where((second == MIDDLE) | (second == one), one, MIDDLE)

    @property
    def inner(self) -> NDArray[np.intp]:
        """Return the points that are not on the contour."""
        return np.setdiff1d(np.arange(self.n_points), self.contour)

    @property
    def inner_columns(self) -> NDArray[np.intp]:
        """Return the columns of the inner points in a table x0, y0, x1, y1, ...."""
        return np.add.outer(2 * self.inner, [0, 1]).ravel()

    def subset(self, points: Iterable[int]) -> "Skeleton":
        """
        Return the layout of some of the points.

        Parameters
        ----------
        points : iterable of int
            The points to keep, in their new order.

        Returns
        -------
        Skeleton
            The layout, with the parts of the curves, the sides and the pairs of points
            that are left. Points whose mirror image is left out are on no side.

        Examples
        --------
        >>> from isa_nrsfm.skeletons import get_skeleton
        >>> face = get_skeleton("wflw-98")
        >>> face.subset(face.inner).n_points
        65
        """
        new = {int(j): k for k, j in enumerate(points)}
        names = self.point_names

        def pairs(old: Iterable[tuple[int, int]]) -> Pairs:
            return tuple((new[a], new[b]) for a, b in old if {a, b} <= new.keys())

        parts = []
        for curve in self.curves:
            groups = groupby(curve, new.__contains__)
            parts += [tuple(new[j] for j in part) for inside, part in groups if inside]
        sides = pairs(zip(self.left, self.right, strict=True))
        return replace(
            self,
            name=f"{len(new)} points of {self.name}",
            n_points=len(new),
            curves=tuple(part for part in parts if len(part) > 1),
            point_names=None if names is None else tuple(names[j] for j in new),
            left=tuple(left for left, _ in sides),
            right=tuple(right for _, right in sides),
            up=pairs(self.up),
            front=pairs(self.front),
            across=pairs(self.across),
            contour=tuple(new[j] for j in self.contour if j in new),
        )

    def reordered(self, names: Sequence[str]) -> "Skeleton":
        """
        Return the same layout with its points in another order.

        Parameters
        ----------
        names : sequence of str of length n_points
            The names of the points in the new order.

        Returns
        -------
        Skeleton
            The layout, whose `point_names` are those given.

        Raises
        ------
        ValueError
            If the layout has no names, or other ones.
        """
        if self.point_names is None or sorted(names) != sorted(self.point_names):
            raise ValueError(f"these are not the names of the points of {self.name!r}")
        order = [self.point_names.index(name) for name in names]
        return replace(self.subset(order), name=self.name)


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
    left, right = (tuple(pair[side] for pair in pairs) for side in (0, 1))
    points = tuple(names)
    return Skeleton(name, "other", len(names), curves, source, points, left, right)


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


def _tuples(value: Any) -> Any:
    """Return a value of a data file, with tuples in place of lists."""
    if isinstance(value, dict):
        return {name: _tuples(each) for name, each in value.items()}
    return tuple(map(_tuples, value)) if isinstance(value, list) else value


_TEXT = Path(__file__).with_name("layouts.toml").read_text("utf-8")
_TABLES = _tuples(tomllib.loads(_TEXT))
SKELETONS: Mapping[str, Skeleton] = MappingProxyType(
    {name: Skeleton(name, **entry) for name, entry in _TABLES["layouts"].items()}
)
# The layouts in which the readers of `isa_nrsfm.io` find points without names.
LAYOUTS_OF_READERS: Mapping[str, tuple[str, ...]] = _TABLES["readers"]

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
    if (n := skeleton.n_points) != n_points:
        raise ValueError(
            f"the skeleton {skeleton.name!r} has {n} points, the shape {n_points}"
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
    lengths = np.linalg.norm(np.diff(shape[edges], axis=1), axis=2)
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
    matches = (_NUMBERED.fullmatch(name.strip()) for name in names)
    found = [match.groups() for match in matches if match is not None]
    numbers = [int(number) for _, number in found]
    first, words = min(numbers, default=0), {word for word, _ in found}
    return len(words) == 1 and numbers == list(range(first, first + len(names)))
