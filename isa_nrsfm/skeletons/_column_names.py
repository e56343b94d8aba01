"""Names of the columns of landmarks.

A landmark coordinate is named by an axis letter (``x``, ``y``, ``z``) and a point, a
number or a word: ``x00``, ``x_0``, ``x-0``, ``0_x``, ``0x``, ``nose_x``, ``nose.x``,
``x_nose``, ``eye_lmk_x_3``. Case matters, blanks around a name do not.

Names of the same form are a *set* of landmarks, written as a pattern in which ``#``
stands for a number and ``*`` for any text: ``x_#,y_#``, ``eye_lmk_x_#,eye_lmk_y_#``,
``*_x,*_y``. Coordinates with a numbered point and a word (``thumb_1_x``) belong to two
sets, ``thumb_#_x`` and ``*_x``.
"""

import re
import tomllib
from collections.abc import Hashable, Iterable, Iterator, Sequence
from itertools import pairwise, zip_longest
from pathlib import Path
from typing import Any, Literal

_SEPARATORS = r"[ _.\-]"
# x0, x_0, eye_lmk_x_0. Words may hold line breaks, which a dot matches with DOTALL.
_AXIS_NUMBER = re.compile(rf"(?s)((?:.*{_SEPARATORS})?)([xyzXYZ])({_SEPARATORS}?)(\d+)")
# 0x
_NUMBER_AXIS = re.compile(r"(\d+)()([xyzXYZ])")
# 0_x, nose_x, thumb_1_x
_LABEL_AXIS = re.compile(rf"(?s)(.*[^ _.\-])({_SEPARATORS})([xyzXYZ])")
# x_nose
_AXIS_LABEL = re.compile(rf"(?s)([xyzXYZ])({_SEPARATORS})([^ _.\-].*)")
_TRAILING_NUMBER = re.compile(r"(?s)(.*?)(\d+)")
# The sizes of boxes, named like the x of their corner.
_HEIGHTS = {"w": "h", "W": "H", "width": "height", "Width": "Height"}
# Not of points that are called w and h.
_WIDTH = re.compile(r"(?<!\b[xyzXYZ])[wW](?:idth)?(?![xyzXYZ]\b)")
# Parts of names, with the separator after them: words, or numbers in words.
_PARTS = (r"[^ _.\-]+[ _.\-]*", r"\d+|\D+")
_LISTS = tomllib.loads(Path(__file__).with_name("words.toml").read_text("utf-8"))
WORDS = {kind: "|".join(words) for kind, words in _LISTS.items()}
_SIDE, _ANIMAL = re.compile(WORDS["sides"]), re.compile(WORDS["individuals"])
_SERIES = re.compile(rf"(?<![a-z])({WORDS['series']})(?:finger|tip|s)?(?![a-z])")
# The axis, 0, 1 or 2 for x, y or z; the point, the name without its axis letter ("3",
# "nose", "eye_lmk_3"); and the sets, the narrowest first: the text before the axis
# letter, the three letters and the text after it, each with the key of the point.
Coordinate = tuple[int, str, list[tuple[tuple[str, str, str], int | str]]]


def parse_coordinate(name: Hashable) -> Coordinate | None:
    """Return axis, point and sets of a landmark coordinate; None for other names."""
    if not isinstance(name, str) or not {",", "#", "*"}.isdisjoint(name):
        return None
    name = name.strip()
    sets: list[tuple[str, str, int | str]] = []  # text before and after, key
    if match := _AXIS_NUMBER.fullmatch(name):
        prefix, axis, separator, digits = match.groups()
        point = prefix + digits
        sets.append((prefix, f"{separator}#", int(digits)))
        if separator and not prefix:
            sets.append(("", f"{separator}*", digits))
    elif match := _NUMBER_AXIS.fullmatch(name) or _LABEL_AXIS.fullmatch(name):
        point, separator, axis = match.groups()
        if numbered := _TRAILING_NUMBER.fullmatch(point):
            prefix, digits = numbered.groups()
            sets.append((f"{prefix}#{separator}", "", int(digits)))
        if separator:
            sets.append((f"*{separator}", "", point))
    elif match := _AXIS_LABEL.fullmatch(name):
        axis, separator, point = match.groups()
        sets.append(("", f"{separator}*", point))
    else:
        return None
    axes = "XYZ" if axis.isupper() else "xyz"
    memberships = [((before, axes, after), key) for before, after, key in sets]
    return axes.index(axis), point, memberships


Arrangement = Literal["interleaved", "planar", "other"]


def names_layout(names: Iterable[Hashable]) -> Arrangement | None:
    """Return the arrangement of a table's landmark columns.

    "interleaved" is x0, y0, x1, y1, ..., "planar" x0, x1, ..., y0, y1, ..., "other" any
    other order, incomplete points, or further columns. None if x or y is missing, or if
    the other columns are pairs that differ in these letters alone, such as lx1, ly1.
    """
    axes, points, stems = [], [], []
    for name in names:
        if coordinate := parse_coordinate(name):
            axis, _, [((before, _, after), key), *_] = coordinate
            axes.append(axis)
            points.append((before, after, key))
        else:
            stems.append(str(name).lower().replace("x", "y"))
    pairs = [a == b for a, b in zip_longest(stems[0::2], stems[1::2])]
    if 0 not in axes or 1 not in axes:
        # lx1, ly1 beside columns that are no pairs
        alike = any(a == b for a, b in pairwise(stems))
        return "other" if not axes and alike and not all(pairs) else None
    if stems:
        return None if all(pairs) else "other"
    n = len(set(points))
    if axes == [0, 1] * n and points[0::2] == points[1::2]:
        return "interleaved"
    if axes == [0] * n + [1] * n and points[:n] == points[n:]:
        return "planar"
    return "other"


def point_names(x_columns: Iterable[str]) -> tuple[str, ...]:
    """Name points after their x columns, without the axis if this stays unique."""
    x_columns = [name.strip() for name in x_columns]
    points = tuple(found[1] for found in map(parse_coordinate, x_columns) if found)
    return points if len(set(points)) == len(x_columns) else tuple(x_columns)


def names_of_points(model: Any, n_points: int | None = None) -> tuple[str, ...]:
    """Return the names of a model's points, or their numbers."""
    n_points = len(model.mean_shape_) if n_points is None else n_points
    if (columns := getattr(model, "feature_names_in_", None)) is None:
        return tuple(map(str, range(n_points)))
    names = [str(name).strip() for name in columns]
    return point_names(names[:n_points] if model.layout == "planar" else names[::2])


def checked_names(name: str, names: Any, default: Any) -> list[str]:
    """Return names as text, by default the given ones; their number must agree."""
    names = [*map(str, default if names is None else names)]
    if len(names) != len(default):
        raise ValueError(f"{name} must hold {len(default)} names; got {len(names)}")
    return names


def without_boxes(names: Sequence[Hashable]) -> list[Hashable]:
    """Leave out columns with the corner of a box: x beside w and h, x_min and x_max."""
    texts = {str(name).strip() for name in names}
    others = [name for name in texts if parse_coordinate(name) is None]
    found = ((name, size) for name in others for size in _WIDTH.finditer(name))
    corners = {
        f"{name[: size.start()]}{axis}{name[size.end() :]}"
        for name, size in found
        if f"{name[: size.start()]}{_HEIGHTS[size[0]]}{name[size.end() :]}" in texts
        for axis in "xyXY"
    }
    ends = [{name, name.replace("min", "max")} for name in texts if "min" in name]
    corners.update(*(pair for pair in ends if texts.issuperset(pair)))
    return [name for name in names if str(name).strip() not in corners]


def _divisions(names: Iterable[Hashable]) -> Iterator[dict[str, dict[str, Hashable]]]:
    """Yield names by one of their parts, and by the rest: {"1": {"nose_x": name}}."""
    for expression in _PARTS:
        split = [(re.findall(expression, str(name).strip()), name) for name in names]
        for place in (0, 1, 2, -1, -2, -3):
            found: dict[str, dict[str, Hashable]] = {}
            for parts, name in split:
                if len(parts) > max(place, -place - 1, 1):
                    others = [*parts]
                    key = others.pop(place).strip(" _.-")
                    stem = "".join(others).rstrip(" _.-")
                    found.setdefault(key, {})[stem] = name
            yield found


def individuals_in(names: Sequence[Hashable], least: int) -> list[str]:
    """
    Return what tells individuals apart in the names of x columns, if anything does.

    They have points of the same names, at least so many, and together nearly all; of
    two or three with numbers, four. Points of one body differ by its sides, fingers or
    legs.

    >>> from isa_nrsfm.skeletons._column_names import individuals_in
    >>> names = [f"p{point}_{mouse}_x" for point in range(8) for mouse in "ab"]
    >>> individuals_in(names, least=7)
    ['a', 'b']
    """
    found: list[tuple[frozenset, list[str]]] = []
    of_one_body = set()
    for division in _divisions(names):
        keys = [key for key, each in division.items() if len(each) > 1]
        rests = [frozenset(division[key]) for key in keys] or [frozenset()]
        common = frozenset.intersection(*rests)
        whole = len(rests) * len(common) >= 0.8 * len(names)
        whole &= max(map(len, rests)) <= 1.1 * len(common) + 1  # others are sets
        few = len(rests) < 4 and all(key[-1:].isdigit() for key in keys)
        if whole and len(rests) > 1 and len(common) >= (4 if few else least):
            groups = frozenset(frozenset(division[key].values()) for key in keys)
            found.append((groups, keys))
            if _are_parts(keys, common):
                of_one_body.add(groups)
    apart = [keys for groups, keys in found if groups not in of_one_body]
    return min(apart, key=len, default=[])


def _are_parts(keys: Iterable[str], points: Iterable[str]) -> bool:
    """Return whether names are of sides, or of parts that a body has several times."""
    keys, points = [key.lower() for key in keys], [point.lower() for point in points]
    without_sides = {_SIDE.sub("", point).strip(" _.-") for point in points}
    found = [_SERIES.search(p) or _SERIES.search(_SIDE.sub("", p)) for p in points]
    words = {part[0] if part else "" for part in found}
    several = len(words) == 1 and all(key.isdigit() for key in keys)
    of_points = "" not in words and (several or len(words) == len(without_sides))
    if of_points or all(map(_SERIES.search, keys)):
        return True
    are_sides = len({_SIDE.sub("", key) for key in keys}) < 2
    return are_sides and not any(map(_ANIMAL.search, [*keys, *points]))


def individuals_with(names: Sequence[Hashable], own: Iterable[str]) -> list[str]:
    """Return individuals in one row that have columns of such names each, if any."""
    for division in _divisions(names):
        if who := [key for key, each in division.items() if each.keys() >= {*own}]:
            return who
    return []


def columns_of_individuals(
    names: Iterable[Hashable], individuals: str | Sequence[str]
) -> dict[str, dict[Hashable, str]]:
    """Return the columns of each individual, with their names without it."""
    listed = individuals.split(",") if isinstance(individuals, str) else individuals
    who, names = [str(name).strip() for name in listed], list(names)
    best: dict[str, dict[Hashable, str]] = {}
    for division in _divisions(names):
        divisions = [division.get(name, {}) for name in who]
        common = [stem for stem in divisions[0] if all(stem in d for d in divisions)]
        if len(common) > max(map(len, best.values()), default=0):
            found = [{each[stem]: stem for stem in common} for each in divisions]
            best = dict(zip(who, found, strict=True))
    if not best or len({*who}) < len(who):
        raise ValueError(
            f"no columns have the same names but for {', '.join(who)} (individuals)"
        )
    return best


def point_places(names: Sequence[str]) -> dict[str, int]:
    """Return the numbers of points by their names, or by their numbers."""
    named = {name: j for j, name in enumerate(names)}
    return {str(j): j for j in range(len(names))} | named


def names_of_components(names: Any, n_components: int) -> list[str]:
    """Return the names of the coefficients, by default alpha_1, alpha_2, ..."""
    default = [f"alpha_{k + 1}" for k in range(n_components)]
    return checked_names("names", names, default)
