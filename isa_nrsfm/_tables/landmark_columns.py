"""Recognise the landmark columns of a table by their names.

A landmark coordinate is named by an axis letter (``x``, ``y``, ``z``) and a point,
which is a number or a word: ``x00``, ``x_0``, ``x-0``, ``0_x``, ``0x``, ``nose_x``,
``nose.x``, ``x_nose``, ``eye_lmk_x_3``. Lower and upper case are different columns.
Blanks around a name do not count.

Names of the same form are a *set* of landmarks, written as a pattern in which ``#``
stands for a number and ``*`` for any text: ``x_#,y_#``, ``eye_lmk_x_#,eye_lmk_y_#``,
``*_x,*_y``. Coordinates with a numbered point and a word (``thumb_1_x``) belong to two
sets, ``thumb_#_x`` and ``*_x``.
"""

import re
from collections.abc import Hashable, Iterable, Sequence
from itertools import chain
from typing import Any, Literal, NamedTuple

from isa_nrsfm._compat.caller import warn_caller
from isa_nrsfm._tables.column_patterns import (
    columns_matching,
    covers,
    first_columns,
    split_patterns,
)

# One basis shape needs 3 K + 3 = 6 dimensions, and J centred points have J - 1.
MIN_POINTS = 7

_Membership = tuple[tuple[str, str, str], int | str]

_AXES = "xyz"
_PATTERN_SYNTAX = frozenset(",#*")
_SEPARATORS = r"[ _.\-]"
# x0, x_0, eye_lmk_x_0. Words may hold line breaks, which a dot matches with DOTALL.
_AXIS_NUMBER = re.compile(
    rf"(?P<prefix>(?:.*{_SEPARATORS})?)(?P<axis>[xyzXYZ])"
    rf"(?P<separator>{_SEPARATORS}?)(?P<digits>\d+)",
    re.DOTALL,
)
# 0x
_NUMBER_AXIS = re.compile(r"(?P<label>\d+)(?P<separator>)(?P<axis>[xyzXYZ])")
# 0_x, nose_x, thumb_1_x
_LABEL_AXIS = re.compile(
    rf"(?P<label>.*[^ _.\-])(?P<separator>{_SEPARATORS})(?P<axis>[xyzXYZ])", re.DOTALL
)
# x_nose
_AXIS_LABEL = re.compile(
    rf"(?P<axis>[xyzXYZ])(?P<separator>{_SEPARATORS})(?P<label>[^ _.\-].*)", re.DOTALL
)
_TRAILING_NUMBER = re.compile(r"(?P<prefix>.*?)(?P<digits>\d+)", re.DOTALL)


class Coordinate(NamedTuple):
    """
    What the name of one landmark column says.

    ``axis`` is 0, 1 or 2 for x, y or z; ``point`` is the name without its axis letter
    (``"3"``, ``"nose"``, ``"eye_lmk_3"``). ``memberships`` are the sets that the column
    belongs to, the narrowest first: the patterns of the set's x, y and z columns, and
    the point's key in the set.
    """

    axis: int
    point: str
    memberships: tuple[_Membership, ...]


class LandmarkColumns(NamedTuple):
    """
    The columns of one set of landmarks.

    Attributes
    ----------
    pattern : str
        The set, such as ``"x_#,y_#"``.
    points : tuple of str, length n_points
        Names of the points, without the axis letter where that is unambiguous.
    x, y : tuple of str, length n_points
        The column of each point's coordinate, named as in the table (with blanks).
    z : tuple of str
        Columns with a third coordinate of these points. They are not used.
    gaps : tuple of int
        Numbers that are absent between the first and the last numbered point.
    """

    pattern: str
    points: tuple[str, ...]
    x: tuple[str, ...]
    y: tuple[str, ...]
    z: tuple[str, ...]
    gaps: tuple[int, ...]

    @property
    def interleaved(self) -> list[str]:
        """The columns in the order x0, y0, x1, y1, ...."""
        return list(chain.from_iterable(zip(self.x, self.y, strict=True)))


def parse_coordinate(name: Hashable) -> Coordinate | None:
    """Read the name of a landmark coordinate; None where it is something else."""
    if not isinstance(name, str) or not _PATTERN_SYNTAX.isdisjoint(name):
        return None
    name = name.strip()
    if match := _AXIS_NUMBER.fullmatch(name):
        prefix, axis, separator, digits = match.group(
            "prefix", "axis", "separator", "digits"
        )
        memberships: list[_Membership] = [
            (_patterns(prefix, axis, f"{separator}#"), int(digits))
        ]
        if separator and not prefix:
            memberships.append((_patterns("", axis, f"{separator}*"), digits))
        return Coordinate(_axis(axis), prefix + digits, tuple(memberships))
    if match := _NUMBER_AXIS.fullmatch(name) or _LABEL_AXIS.fullmatch(name):
        label, separator, axis = match.group("label", "separator", "axis")
        memberships = []
        if numbered := _TRAILING_NUMBER.fullmatch(label):
            prefix, digits = numbered.group("prefix", "digits")
            memberships.append(
                (_patterns(f"{prefix}#{separator}", axis, ""), int(digits))
            )
        if separator:
            memberships.append((_patterns(f"*{separator}", axis, ""), label))
        return Coordinate(_axis(axis), label, tuple(memberships))
    if match := _AXIS_LABEL.fullmatch(name):
        axis, separator, label = match.group("axis", "separator", "label")
        patterns = _patterns("", axis, f"{separator}*")
        return Coordinate(_axis(axis), label, ((patterns, label),))
    return None


def find_landmark_columns(
    names: Iterable[Hashable], columns: str | Sequence[str] | None = None
) -> LandmarkColumns:
    """
    Find the landmark columns among the columns of a table.

    Parameters
    ----------
    names : iterable of str
        All column names of the table.
    columns : str or sequence of str, optional
        The columns to take, where the names alone do not say it: patterns of the x and
        the y columns in turn, such as ``"x_#,y_#"``, with ``#`` for a number and
        ``*`` for any text. Several pairs are put one after the other.
        Without it, the table must have exactly one set of landmarks. A set of fewer
        than seven points does not count: it cannot hold a single basis shape.

    Returns
    -------
    LandmarkColumns
        The points in the order of their numbers, or where they are named, in the order
        of their x columns in the table.

    Raises
    ------
    ValueError
        If there is no set of landmarks or more than one, if a point has only one of
        the two coordinates, or if two columns are named as the same coordinate.

    Warns
    -----
    UserWarning
        If patterns with wildcards match only a part of a set of landmarks.

    Examples
    --------
    >>> from isa_nrsfm._tables.landmark_columns import find_landmark_columns
    >>> names = ["file"] + [f"{a}_{j}" for a in "xy" for j in range(8)]
    >>> find_landmark_columns(names).interleaved[:4]
    ['x_0', 'y_0', 'x_1', 'y_1']
    >>> find_landmark_columns(names, columns="x_#,y_#").pattern
    'x_#,y_#'
    """
    names = list(names)
    if columns is not None:
        return _select(names, split_patterns(columns))
    candidates = {
        patterns: n_points
        for patterns, n_points in landmark_sets(names).items()
        if n_points >= MIN_POINTS
    }
    if not candidates:
        raise ValueError(_none_found(names))
    if len(candidates) > 1:
        raise ValueError(_several_found(names, candidates))
    (pattern,) = candidates
    _refuse_repeated_header(names, pattern)
    return _select(names, split_patterns(pattern))


def landmark_sets(names: Iterable[Hashable]) -> dict[str, int]:
    """
    Count the points of every set of landmarks by pattern, in table order.

    A set needs at least one x and one y column (names such as ``x0, x1, x2`` alone are
    those of any table). Sets too small for a basis shape are counted, too.
    """
    members: dict[tuple[str, str, str], list[set[int | str]]] = {}
    for name in names:
        coordinate = parse_coordinate(name)
        if coordinate is None:
            continue
        for patterns, key in coordinate.memberships:
            keys = members.setdefault(patterns, [set(), set(), set()])
            keys[coordinate.axis].add(key)
    sizes = {patterns: len(x | y) for patterns, (x, y, _) in members.items() if x and y}
    # Leave out a "*" set that has no more points than a "#" set inside it.
    return {
        ",".join(patterns[:2]): size
        for patterns, size in sizes.items()
        if "*" not in patterns[0]
        or not any(
            other_size == size and "#" in other[0] and covers(patterns[0], other[0])
            for other, other_size in sizes.items()
        )
    }


def names_layout(
    names: Iterable[Hashable],
) -> Literal["interleaved", "planar", "other"] | None:
    """
    Tell in which arrangement a table's landmark columns are.

    Parameters
    ----------
    names : iterable of str
        The names of all columns.

    Returns
    -------
    {"interleaved", "planar", "other"} or None
        "interleaved" for x0, y0, x1, y1, ..., "planar" for x0, x1, ..., y0, y1, ...,
        "other" for landmark columns in another order, incomplete ones, and ones with a
        third coordinate or other columns beside them. None where no names are those of
        landmark coordinates, or of only one axis. None, too, where the other columns
        are pairs that differ in the letters x and y alone, such as lx1, ly1.

    Examples
    --------
    >>> from isa_nrsfm._tables.landmark_columns import names_layout
    >>> names_layout(["nose_x", "nose_y", "chin_x", "chin_y"])
    'interleaved'
    >>> names_layout(["x1", "x2", "y1", "y2"])
    'planar'
    >>> names_layout(["x1", "y2", "y1", "x2"])
    'other'
    >>> names_layout(["frame", "person", "x1", "y1"])
    'other'
    >>> names_layout(["x1", "x2", "x3", "x4"]) is None
    True
    """
    coordinates, rest = [], []
    for name in names:
        coordinate = parse_coordinate(name)
        if coordinate is None:
            rest.append(str(name).lower().replace("x", "y"))
            continue
        (x, y, _), key = coordinate.memberships[0]
        # What x and y of a point share: the key, and the pattern without its axis
        # letter (at the first place where the patterns of x and y differ).
        letter = next(i for i, (a, b) in enumerate(zip(x, y, strict=True)) if a != b)
        coordinates.append((coordinate.axis, (x[:letter], x[letter + 1 :], key)))
    axes = [axis for axis, _ in coordinates]
    points = [point for _, point in coordinates]
    if 0 not in axes or 1 not in axes:
        return None
    if rest:
        return None if rest[0::2] == rest[1::2] else "other"
    n_points = len(set(points))
    if axes == [0, 1] * n_points and points[0::2] == points[1::2]:
        return "interleaved"
    if axes == [0] * n_points + [1] * n_points and (
        points[:n_points] == points[n_points:]
    ):
        return "planar"
    return "other"


def point_names(x_columns: Iterable[str]) -> tuple[str, ...]:
    """Name points after their x columns, without the axis where that stays unique."""
    x_columns = [name.strip() for name in x_columns]
    coordinates = [parse_coordinate(name) for name in x_columns]
    points = tuple(point.point for point in coordinates if point is not None)
    if len(set(points)) == len(x_columns):
        return points
    return tuple(x_columns)


def names_of_points(model: Any) -> tuple[str, ...]:
    """Return the names of a model's points, or their numbers."""
    n_points = len(model.mean_shape_)
    columns = getattr(model, "feature_names_in_", None)
    if columns is None:
        return tuple(map(str, range(n_points)))
    names = [str(name).strip() for name in columns]
    x_columns = names[:n_points] if model.layout == "planar" else names[::2]
    return point_names(x_columns)


def _axis(letter: str) -> int:
    """Return the number of an axis."""
    return _AXES.index(letter.lower())


def _patterns(before: str, axis: str, after: str) -> tuple[str, str, str]:
    """Return the patterns of the x, y and z columns, in the case of ``axis``."""
    axes = _AXES.upper() if axis.isupper() else _AXES
    x, y, z = (before + letter + after for letter in axes)
    return x, y, z


def _select(names: Sequence[Hashable], patterns: Sequence[str]) -> LandmarkColumns:
    """Return the columns that match pairs of patterns of x and y columns."""
    x: list[str] = []
    y: list[str] = []
    gaps: list[int] = []
    for x_pattern, y_pattern in zip(patterns[::2], patterns[1::2], strict=True):
        x_by_key = columns_matching(names, x_pattern)
        y_by_key = columns_matching(names, y_pattern)
        _refuse_unpaired(x_by_key, y_by_key, x_pattern, y_pattern)
        keys = list(x_by_key)
        if "*" not in x_pattern:
            keys.sort()
        x += [x_by_key[key] for key in keys]
        y += [y_by_key[key] for key in keys]
        if x_pattern.count("#") == 1 and "*" not in x_pattern:
            numbers = {number for key in keys for number in key}
            gaps += sorted(set(range(min(numbers), max(numbers))) - numbers)
    chosen = x + y
    if len(set(chosen)) < len(chosen):
        twice = next(name for name in chosen if chosen.count(name) > 1)
        raise ValueError(f"the patterns {','.join(patterns)} match {twice!r} twice")
    if any(not _PATTERN_SYNTAX.isdisjoint(pattern) for pattern in patterns):
        _warn_of_left_out(names, chosen, ",".join(patterns))
    return LandmarkColumns(
        ",".join(patterns),
        point_names(x),
        tuple(x),
        tuple(y),
        _z_of(names, x),
        (*gaps,),
    )


def _refuse_unpaired(
    x_by_key: dict[tuple, str],
    y_by_key: dict[tuple, str],
    x_pattern: str,
    y_pattern: str,
) -> None:
    """Raise if a point has only one of its two coordinates."""
    without_y = [name for key, name in x_by_key.items() if key not in y_by_key]
    without_x = [name for key, name in y_by_key.items() if key not in x_by_key]
    for columns, pattern in ((without_y, y_pattern), (without_x, x_pattern)):
        if columns:
            more = f" (nor have {len(columns) - 1} more)" if len(columns) > 1 else ""
            raise ValueError(
                f"column {columns[0]!r} has no partner among the columns "
                f"{pattern!r}{more}: every point needs an x and a y"
            )


def _warn_of_left_out(
    names: Sequence[Hashable], chosen: Sequence[str], pattern: str
) -> None:
    """Warn if patterns match only a part of a set of x and y columns."""
    taken = set(chosen)
    sets = {
        coordinate.memberships[0][0]
        for name in chosen
        if (coordinate := parse_coordinate(name)) is not None
    }
    left = [
        name
        for name in names
        if (coordinate := parse_coordinate(name)) is not None
        and coordinate.axis < 2
        and coordinate.memberships[0][0] in sets
        and name not in taken
    ]
    if left:
        warn_caller(
            f"the patterns {pattern!r} match {len(chosen)} columns and leave out "
            f"{len(left)} that are named alike; the first is {left[0]!r}"
        )


def _refuse_repeated_header(names: Sequence[Hashable], pattern: str) -> None:
    """Raise for x, y, x.1, y.1, ..., which is how pandas reads x, y, x, y, ...."""
    axis = pattern[0]
    if pattern.startswith(f"{axis}.#") and axis in names:
        raise ValueError(
            f"the columns '{axis}', '{axis}.1', ... come from a header that repeats "
            "the same names: give every point a name of its own, such as x0, y0, x1, y1"
        )


def _z_of(names: Sequence[Hashable], x_columns: Iterable[str]) -> tuple[str, ...]:
    """Return the columns with the third coordinate of the points of x columns."""
    points = set()
    for name in x_columns:
        coordinate = parse_coordinate(name)
        if coordinate is not None:
            points.add(coordinate.memberships[0])
    return tuple(
        str(name)
        for name in names
        if (coordinate := parse_coordinate(name)) is not None
        and coordinate.axis == 2
        and coordinate.memberships[0] in points
    )


def _none_found(names: Sequence[Hashable]) -> str:
    """Say that no set of landmarks is in the table."""
    small = "; ".join(
        f"{pattern!r} ({n_points})"
        for pattern, n_points in landmark_sets(names).items()
    )
    small = f" (fewer than {MIN_POINTS} points: {small})" if small else ""
    return (
        "no landmark columns such as x0, y0, x1, y1 or nose_x, nose_y were found"
        f"{small}; {first_columns(names)}. If they have other names, give columns "
        "(command line: --columns), such as 'px_#,py_#'"
    )


def _several_found(names: Sequence[Hashable], candidates: dict[str, int]) -> str:
    """Say which sets of landmarks are in the table, and how to choose one."""
    listed = []
    for pattern, n_points in candidates.items():
        x = list(columns_matching(names, split_patterns(pattern)[0]).values())
        count = f"{n_points} points" + (", with a z each" if _z_of(names, x) else "")
        listed.append(f"{pattern!r} ({count}: {x[0].strip()} to {x[-1].strip()})")
    return (
        "the table has more than one set of landmark columns: "
        f"{'; '.join(listed)}. Choose with columns (command line: --columns), "
        f"such as {max(candidates, key=lambda pattern: candidates[pattern])!r}"
    )
