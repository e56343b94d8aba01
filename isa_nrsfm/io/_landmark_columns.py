"""Find the landmark columns of a table by their names, or by patterns.

In patterns ``#`` is a number and ``*`` is any text. Tables of other shapes, with a row
for each point or coordinate, or a point in each cell, become tables with a row for each
frame, and two columns for each point.
"""

import re
from collections import Counter
from collections.abc import Hashable, Iterable, Sequence
from fnmatch import fnmatchcase
from itertools import chain
from typing import Any, NamedTuple, NoReturn

import numpy as np
from numpy.typing import NDArray

from isa_nrsfm._compat import pandas as pd
from isa_nrsfm._compat.caller import warn_caller
from isa_nrsfm._compat.texts import FRAME, IMAGE_NAME, first_items
from isa_nrsfm._parameters import named
from isa_nrsfm.skeletons import _column_names
from isa_nrsfm.skeletons._column_names import WORDS, parse_coordinate, without_boxes

CONFIDENCES = tuple(WORDS["confidences"].split("|"))
# One basis shape needs 3 K + 3 = 6 dimensions, and J centred points have J - 1.
MIN_POINTS = 7

_NO_POINT = re.compile(
    rf"(?i)(?<![a-z])(?:{WORDS['no_points']})(?![a-z])"
    "|^(?:mouse|target|origin|head_?pose)$"
)
_COPY = re.compile(rf"(?i){WORDS['copies']}")


# Names of the columns of a table; names or patterns of columns, as users give them.
Columns = Sequence[Hashable]
Given = str | Sequence[str] | None


class LandmarkColumns(NamedTuple):
    """The columns of one set of landmarks, each (n_points,), named as in the table.

    pattern: the set, such as ``"x_#,y_#"``.
    points: names of the points, without the axis letter if that is unambiguous.
    z: columns with a third coordinate of these points. They are not used.
    """

    pattern: str
    points: tuple[str, ...]
    x: tuple[str, ...]
    y: tuple[str, ...]
    z: tuple[str, ...] = ()

    @property
    def interleaved(self) -> list[str]:
        """The columns in the order x0, y0, x1, y1, ...."""
        return list(chain.from_iterable(zip(self.x, self.y, strict=True)))


def find_landmark_columns(names: Columns, columns: Given = None) -> LandmarkColumns:
    """
    Find the landmark columns among the columns of a table.

    `columns` are patterns of the x and the y columns in turn, such as ``"x_#,y_#"``.
    Several pairs are put one after the other; a pattern after ``-`` leaves columns
    out, one after ``+`` all others. Without it, the table must have exactly one set of
    landmarks of at least `MIN_POINTS` points. Numbered points are in the order of their
    numbers, others in that of their x columns.

    >>> from isa_nrsfm.io._landmark_columns import find_landmark_columns
    >>> names = ["file"] + [f"{a}_{j}" for a in "xy" for j in range(8)]
    >>> find_landmark_columns(names).interleaved[:4]
    ['x_0', 'y_0', 'x_1', 'y_1']
    """
    names = list(names)
    if columns is not None:
        listed = split_patterns(columns)
        patterns = [pattern for pattern in listed if pattern[:1] not in ("-", "+")]
        if not patterns or len(patterns) % 2 or not all(patterns):
            raise ValueError(
                "columns must name x and y columns in turn, such as 'x_#,y_#'; "
                f"got {columns!r}"
            )
        names = _chosen(names, [part for part in listed if part not in patterns])
        given = not all({"#", "*"}.intersection(pattern) for pattern in patterns)
        return _select(names if given else without_boxes(names), patterns)
    all_names, names = without_boxes(names), only_points(names)
    sets = landmark_sets(names)
    candidates = {pattern: n for pattern, n in sets.items() if n >= MIN_POINTS}
    _refuse_copies(all_names)
    _refuse_individuals(names, candidates or sets)
    if not candidates:
        if any(isinstance(name, tuple) for name in names):
            raise ValueError(
                "the names of the columns have several levels: join them to names such "
                "as nose_x, nose_y. In pandas: table.columns = ['_'.join(name) for "
                "name in table.columns]"
            )
        small = "; ".join(f"{pattern!r} ({n})" for pattern, n in sets.items())
        small = f" (fewer than {MIN_POINTS} points: {small})" if small else ""
        raise ValueError(
            "no landmark columns such as x0, y0, x1, y1 or nose_x, nose_y were found"
            f"{small}; {_first_columns(names)}. If there is a row for each point, give "
            f"{named('row_per_point')}, such as 'frame,point'. If they have other "
            f"names, give {named('columns')}, such as {_likely_pattern(names)!r}"
        )
    if len(candidates) > 1:
        raise ValueError(_several_found(names, candidates))
    (pattern,) = candidates
    axis = pattern[0]
    if pattern.startswith(f"{axis}.#") and axis in names:  # as pandas reads x, y, x, y
        raise ValueError(
            f"the columns '{axis}', '{axis}.1', ... come from a header that repeats "
            "the same names: give each point its own name, such as x0, y0, x1, y1"
        )
    patterns, others = pattern.split(","), {*all_names}.difference(names)
    if of_set := [n for n in others if any(matches(n, each) for each in patterns)]:
        warn_caller(
            f"the columns {first_items(sorted(of_set))} are no points by their names, "
            f"and are left out. If they are, give {named('columns', pattern)}"
        )
    return _select(names, patterns)


def split_patterns(columns: Given) -> list[str]:
    """Return the patterns or names of columns that are given."""
    listed = columns.split(",") if isinstance(columns, str) else columns or []
    return [pattern.strip() for pattern in listed]


def only_points(names: Iterable[Hashable]) -> list[Hashable]:
    """Leave out corners of boxes, and columns with x and y that are no points.

    These are so called, and most others are not.
    """
    names = without_boxes(list(names))
    of_points = {n: c[1] for n in names if (c := parse_coordinate(n)) is not None}
    others = {name for name, point in of_points.items() if _NO_POINT.search(point)}
    few = 2 * len(others) < len(of_points)
    return [name for name in names if name not in others] if few else names


def _refuse_copies(names: Columns) -> None:
    """Raise if most points are there once more, with a further word in their names."""
    texts = [name.strip() for name, axis, _ in _coordinates(names) if axis == 0]
    parts = {t: re.findall(r"[A-Z]?[a-z]+|[A-Z]+(?![a-z])|\d+", t) for t in texts}
    keys = {" ".join(each).lower(): text for text, each in parts.items()}
    pairs: dict[str, list[tuple[str, str]]] = {}
    for text, each in parts.items():
        for i, word in enumerate(each):
            other = keys.get(" ".join([*each[:i], *each[i + 1 :]]).lower())
            if other is not None and not word.isdigit():
                pairs.setdefault(word.lower(), []).append((other, text))
    minimum = max(MIN_POINTS, 0.8 * (len(texts) - sum(map(len, pairs.values()))))
    copies = [found[0] for found in pairs.values() if len(found) >= minimum]
    words = []
    for point, copy in copies:
        same = [a == b for a, b in zip(f"{point}\n", copy, strict=False)].index(False)
        words.append(copy[same : same + len(copy) - len(point)])
    if copies:
        _ask_which(names, " and ".join(copies[0]), words, [f"-*{w}*" for w in words])


def _ask_which(
    names: Columns, which: str, words: list[str], without: Sequence[str] = ()
) -> NoReturn:
    """Raise the question which of points that are there twice are to be read."""
    copies = [name for word in words for name in _chosen(names, [f"+*{word}*"])]
    points = {*only_points(names), *copies}
    others = [f"-{n}" for n, axis, _ in _coordinates(names) if n not in points]
    names = [name for name in names if name in points]
    ways = [*([without] if without else []), *([f"+*{word}*"] for word in words)]
    every = [",".join([_all_sets(_chosen(names, w)), *w, *others]) for w in ways]
    raise ValueError(
        f"the points are probably there more than once, such as {which}, in another "
        f"unit or filtered. Choose with {named('columns')}: "
        f"{', '.join(map(repr, every))}; or {_all_sets(names)!r} if all are points of "
        "one body"
    )


def _chosen(names: Columns, patterns: Iterable[str]) -> list[Hashable]:
    """Return names without those of patterns after -, only those of ones after +."""
    chosen = list(names)
    for sign, pattern in ((each[0], each[1:]) for each in patterns):
        found = {name for name in chosen if fnmatchcase(str(name).strip(), pattern)}
        chosen = [name for name in chosen if (name in found) == (sign == "+")]
    return chosen


def _all_sets(names: Iterable[Hashable]) -> str:
    """Return patterns of all coordinates, each in one of them."""
    x = {pattern.partition(",")[0]: pattern for pattern in landmark_sets(names)}
    whole = [regular_expression(one) for one in x if "*" in one]
    return ",".join(
        pattern
        for one, pattern in x.items()
        if "*" in one or not any(each.fullmatch(one) for each in whole)
    )


def axis_pairs(names: Iterable[Hashable]) -> list[tuple[str, str, int]]:
    """Return pairs of names that differ in one letter, x and y, and its place.

    >>> from isa_nrsfm.io._landmark_columns import axis_pairs
    >>> axis_pairs(["frame", "pos_x", "pos_y", "X [px]", "Y [px]"])
    [('pos_x', 'pos_y', 4), ('X [px]', 'Y [px]', 0)]
    """
    texts = [str(name).strip() for name in names]
    places = ((t, i) for t in texts for i, letter in enumerate(t) if letter in "xX")
    pairs = [(t, t[:i] + chr(ord(t[i]) + 1) + t[i + 1 :], i) for t, i in places]
    known = {*texts}
    return [pair for pair in pairs if pair[1] in known]


def _likely_pattern(names: Iterable[Hashable]) -> str:
    """Return the pattern of most names that differ in the letters x and y alone."""
    found: Counter[str] = Counter()
    for x, y, i in axis_pairs(names):
        before, after = x[:i], x[i + 1 :]
        numbered = [re.sub(r"\d+", "#", part) for part in (before, after)]
        for one, other in (numbered, ("*" if before else "", after), (before, "*")):
            found[f"{one}{x[i]}{other},{one}{y[i]}{other}"] += 1
    likely = [pattern for pattern, n in found.most_common() if n >= MIN_POINTS]
    return next((each for each in likely if each.count(",") == 1), "px_#,py_#")


def landmark_sets(names: Iterable[Hashable]) -> dict[str, int]:
    """Count the points of every set of landmarks by pattern, in table order.

    Sets have an x and a y column or more (``x0, x1, x2`` are those of any table).
    """
    members: dict[tuple[str, str, str], list[set[int | str]]] = {}
    for axis, _, memberships in filter(None, map(parse_coordinate, names)):
        for columns, key in memberships:
            members.setdefault(columns, [set(), set(), set()])[axis].add(key)
    sizes = {
        (before + axes[0] + after, before + axes[1] + after): len(x | y)
        for (before, axes, after), (x, y, _) in members.items()
        if x and y
    }
    numbered = [(one, size) for (one, _), size in sizes.items() if "#" in one]

    def is_same(pattern: str, size: int) -> bool:
        """Return whether a "*" set has no more points than a "#" set inside it."""
        inside = [one for one, n in numbered if n == size]
        return "*" in pattern and any(matches(one, pattern) for one in inside)

    kept = {each: size for each, size in sizes.items() if not is_same(each[0], size)}
    return {",".join(patterns): size for patterns, size in kept.items()}


def confidence_columns(
    names: Iterable[Hashable], x: Iterable[str], y: Iterable[str]
) -> list[Any]:
    """Return the columns with the confidences of points of x and y columns, if any.

    They are named alike with one of the words `CONFIDENCES` for the axis letter.

    >>> from isa_nrsfm.io._landmark_columns import confidence_columns
    >>> confidence_columns(["nose_x", "nose_y", "nose_conf"], ["nose_x"], ["nose_y"])
    ['nose_conf']
    """
    by_name = {str(name).strip(): name for name in names}
    parts = []
    for pair in zip(map(str.strip, x), map(str.strip, y), strict=True):
        same = [a == b for a, b in zip(*pair, strict=False)]
        place = [*same, False].index(False)  # of the axis letter
        parts.append((pair[0][:place], pair[0][place + 1 :]))
    for word in (w for c in CONFIDENCES for w in (c, c.capitalize(), c.upper())):
        found = [f"{before}{word}{after}" for before, after in parts]
        if by_name.keys() >= {*found}:
            return [by_name[name] for name in found]
    return []


def _refuse_individuals(names: Columns, sets: dict[str, int]) -> None:
    """Raise if points have the names of several individuals in one row."""
    found = (_columns_matching(names, pattern.split(",")[0]) for pattern in sets)
    x = list(dict.fromkeys(name for each in found for name in each.values()))
    if not (who := _column_names.individuals_in(x, MIN_POINTS)):
        return
    if any(map(_COPY.fullmatch, who)):
        text, ends = " ".join(x), r"[ _.\-]*"
        matched = [re.search(f"{ends}{re.escape(w)}{ends}", text) for w in who]
        words = [match[0].strip(" ") for match in matched if match]
        _ask_which(names, " and ".join(who), words)
    largest = max(sets, key=sets.__getitem__)
    whole = largest if sets[largest] == len(x) else ",".join(sets)
    listed, n_points = ",".join(who), len(x) // len(who)
    way = (
        f"For a row for each, use {named('individuals', listed)}"
        if n_points >= MIN_POINTS
        else f"Their {n_points} points are too few to fit them; {MIN_POINTS} are needed"
    )
    raise ValueError(
        f"{same_but_for(who, len(x))}. {way}. If all are points of one body, use "
        f"{named('columns', whole)}"
    )


def same_but_for(who: Sequence[str], n_points: int) -> str:
    """Describe points whose names differ by those of individuals or views."""
    return (
        f"the {n_points} points have the same names but for {', '.join(who)}, as those "
        "of several individuals in one row, or in views of several cameras"
    )


def _select(names: Columns, patterns: Sequence[str]) -> LandmarkColumns:
    """Return the columns that match pairs of patterns of x and y columns."""
    x, y = [], []
    for x_pattern, y_pattern in zip(patterns[::2], patterns[1::2], strict=True):
        x_by_key = _columns_matching(names, x_pattern)
        y_by_key = _columns_matching(names, y_pattern)
        sides = (x_by_key, y_by_key, y_pattern), (y_by_key, x_by_key, x_pattern)
        for one, other, pattern in sides:
            if alone := [name for key, name in one.items() if key not in other]:
                more = f" (nor have {len(alone) - 1} more)" if len(alone) > 1 else ""
                raise ValueError(
                    f"column {alone[0]!r} has no partner among the columns "
                    f"{pattern!r}{more}: every point needs an x and a y"
                )
        keys = list(x_by_key) if "*" in x_pattern else sorted(x_by_key)
        x += [x_by_key[key] for key in keys]
        y += [y_by_key[key] for key in keys]
    chosen, joined = x + y, ",".join(patterns)
    if twice := [name for name, n in Counter(chosen).items() if n > 1]:
        raise ValueError(f"the patterns {joined} match {twice[0]!r} twice")
    if not {"#", "*"}.isdisjoint(joined):
        _warn_of_left_out(names, chosen, joined)
    points, z = _column_names.point_names(x), _z_of(names, x)
    return LandmarkColumns(joined, points, tuple(x), tuple(y), z)


def _columns_matching(names: Columns, pattern: str) -> dict[tuple, str]:
    """Return the columns that match a pattern, with keys from its wildcards.

    A key is a tuple with one entry a wildcard: an int for ``#``, a text for ``*``. A
    column whose name is the pattern itself is the only match, with the key ``()``.
    """
    texts = [name for name in names if isinstance(name, str)]
    exact = [name for name in texts if name.strip() == pattern]
    if len(exact) == 1:
        return {(): exact[0]}
    expression = regular_expression(pattern)
    kinds = [int if sign == "#" else str for sign in re.findall("[#*]", pattern)]
    found: dict[tuple, str] = {}
    for name in texts:
        if match := expression.fullmatch(name.strip()):
            parts = zip(kinds, match.groups(), strict=True)
            key = tuple(kind(text) for kind, text in parts)
            if key in found:
                raise ValueError(
                    f"the columns {found[key]!r} and {name!r} name the same coordinate"
                )
            found[key] = str(name)
    if not found:
        raise ValueError(f"no column matches {pattern!r}; {_first_columns(names)}")
    return found


def matches(name: Hashable, pattern: str) -> bool:
    """Return whether a name has the form of a pattern."""
    return regular_expression(pattern).fullmatch(str(name).strip()) is not None


def regular_expression(pattern: str) -> re.Pattern[str]:
    """Translate a pattern into a regular expression with a group for each wildcard."""
    wildcards = {"#": r"(\d+)", "*": "(.+)"}
    parts = re.split(r"([#*])", pattern)
    expression = "".join(wildcards.get(part, re.escape(part)) for part in parts)
    return re.compile(expression, re.DOTALL)  # names may hold line breaks


def _warn_of_left_out(names: Columns, chosen: Sequence[str], pattern: str) -> None:
    """Warn if patterns match only a part of a set of x and y columns."""
    sets, used = {point[0] for _, _, point in _coordinates(chosen)}, {*chosen}
    others = (each for each in _coordinates(names) if each[0] not in used)
    if omitted := [name for name, axis, (of, _) in others if axis < 2 and of in sets]:
        warn_caller(
            f"the patterns {pattern!r} match {len(chosen)} columns and leave out "
            f"{len(omitted)} that are named alike; the first is {omitted[0]!r}"
        )


def _z_of(names: Columns, x_columns: Iterable[str]) -> tuple[str, ...]:
    """Return the columns with the third coordinate of the points of x columns."""
    points = {point for _, _, point in _coordinates(x_columns)}
    found = _coordinates(names)
    return tuple(name for name, axis, point in found if axis == 2 and point in points)


def _coordinates(names: Iterable[Hashable]) -> list[tuple[str, int, tuple]]:
    """Return the coordinates among columns: name, axis, set and key of the point."""
    found = [(str(name), parse_coordinate(name)) for name in names]
    return [(name, c[0], c[2][0]) for name, c in found if c is not None]


def _several_found(names: Columns, candidates: dict[str, int]) -> str:
    """List the sets of landmarks of a table, and how to choose one."""
    listed, example = [], max(candidates, key=lambda pattern: candidates[pattern])
    whole = regular_expression(example.split(",")[0])
    inside = [p for p in candidates if "#" in p and whole.fullmatch(p.split(",")[0])]
    # Numbered points beside few others, such as their centroid
    beside = candidates[example] - sum(candidates[pattern] for pattern in inside)
    if inside and 0 < beside < MIN_POINTS:
        example = max(inside, key=lambda pattern: candidates[pattern])
    for pattern, n_points in candidates.items():
        x = list(_columns_matching(names, pattern.split(",")[0]).values())
        count = f"{n_points} points" + (", with a z each" if _z_of(names, x) else "")
        listed.append(f"{pattern!r} ({count}: {x[0].strip()} to {x[-1].strip()})")
    return (
        "the table has more than one set of landmark columns: "
        f"{'; '.join(listed)}. Choose with {named('columns')}, such as {example!r}"
    )


def _first_columns(names: Columns) -> str:
    """List the first columns of a table."""
    return f"the table's {len(names)} columns are {first_items(map(repr, names))}"


# Columns that name points, and frames or who is shown.
_POINT = re.compile(r"(?i)point|landmark|joint|marker|node|part(?!ic)")
_FRAME = re.compile(rf"(?i){WORDS['frames']}")
_IMAGE = re.compile(rf"(?i)\s*(?:{FRAME}|{IMAGE_NAME}|slice)\s*")
_VALUE = re.compile("(?i)value|position|coord|pos$")
_NUMBER = re.compile(r"[-+]?(?:\d+\.?\d*|\.\d+)(?:[eE][-+]?\d+)?|nan")
# Cells of numbers, with brackets and separators, and cells of missing points.
_NUMBERS = re.compile(r"[\d\s.,;:|()\[\]{}=+\-eEnax]+")
_MISSING = re.compile(r"(?i)[\s,()\[\]{}]*(?:n/?a|nan|null|none)?[\s()\[\]{}]*")
# In cells with brackets: missing numbers; keys and quotation marks; words but for nan
# and exponents, such as in np.float64(1.5); and what then is in brackets by itself.
_WRITTEN = (
    (r"\b(?:None|null)\b", "nan"),
    (r"""(["'])[^"']*\1\s*:|\b\d+\s*:(?=\s*[\[({])|["']""", " "),
    (r"(?<![\w.])(?!nan\b)[A-Za-z_][\w.]*", " "),
    (r"\(\s*([^\s,()]+)\s*\)", r"\1"),
)
_INNERMOST = re.compile(r"[\[({]([^\[\](){}]*)[\])}]")
# A table, and the names of its columns that tell frames and points apart.
Keys = tuple["pd.DataFrame", list[str], list[str]]
# A table, and the names of the columns of points if they are known; None for others.
Apart = tuple["pd.DataFrame", list[str] | None] | None


def frames_of(
    frame: "pd.DataFrame", columns: Given = None, row_per_point: Given = None
) -> tuple["pd.DataFrame", Given]:
    """Return a table with a row for each frame, and what chooses the columns of points.

    Tables that have one are returned as they are.
    """
    names, patterns = list(frame.columns), split_patterns(columns)
    if not all(isinstance(name, str) for name in names):
        return frame, columns
    pair = patterns if len(patterns) == 2 and {*patterns} <= {*names} else None
    found: Apart = None
    if row_per_point is None and pair is None:
        sets = landmark_sets(only_points(names))
        if patterns:
            sets = {name: MIN_POINTS for name in names if matches(name, patterns[0])}
        if max(sets.values(), default=0) >= MIN_POINTS:
            return frame, columns
    if pair is None and (row_per_point is None or not axis_pairs(names)):
        found = _cells_apart(frame)
    if found is None or found[1] is None:
        frame = _axes_apart(frame) if found is None else found[0]
        found = _points_apart(frame, pair, row_per_point)
    if found is None:
        return frame, columns
    return found[0], columns if patterns and not pair else found[1]


def _cells_apart(frame: "pd.DataFrame") -> Apart:
    """Return a table whose cells hold points with a column for each coordinate.

    Also the names of these columns; None if they are x and y of one point a row.
    """
    found: dict[str, NDArray] = {}
    for name in frame.select_dtypes(["object", "string"]):
        cells = frame[name].dropna().astype(str)
        cells = cells[cells.map(_MISSING.fullmatch).isna()]
        if not cells.empty and re.search(r"[\[({=]", cells.iloc[0]):
            for pattern, other in _WRITTEN:
                cells = cells.str.replace(pattern, other, regex=True)
        several = not cells.empty and len(_NUMBER.findall(cells.iloc[0])) > 1
        if not several or cells.map(_NUMBERS.fullmatch).isna().any():
            continue
        if cells.str.contains("...", regex=False).any():
            raise ValueError(
                f"the cells of the column {name!r} hold arrays of which '...' leaves "
                "out numbers: write all, such as with str(array.tolist())"
            )
        numbers, inner = cells.map(_NUMBER.findall), _INNERMOST.search(cells.iloc[0])
        n_all = len(numbers.iloc[0])
        n_each = len(_NUMBER.findall(inner[1])) if inner else n_all
        n_each = n_each if 1 < n_each < 7 and n_all % n_each == 0 else 1
        if (numbers.map(len) == n_all).all():
            values = pd.DataFrame(numbers.tolist(), cells.index).reindex(frame.index)
            values = values.to_numpy(float).reshape(len(frame), -1, n_each)
            found[name] = values[..., :2].reshape(len(frame), -1)
        elif n_all >= 2 * MIN_POINTS:
            raise ValueError(
                f"the cells of the column {name!r} hold several numbers, but not the "
                f"same number of them: the first has {n_all}"
            )
    points = [name for name, values in found.items() if values.shape[1] == 2]
    lists = [name for name, values in found.items() if values.shape[1] >= MIN_POINTS]
    pairs = [[x, y] for x, y, _ in axis_pairs(lists)]
    if len(points) >= MIN_POINTS:
        used, tracks = points, np.stack([found[name] for name in points], axis=1)
    elif len(pairs) == 1:
        used, tracks = pairs[0], np.stack([found[name] for name in pairs[0]], axis=2)
    elif len(lists) == 1 and found[lists[0]].shape[1] % 2 == 0:
        used, tracks = lists, found[lists[0]].reshape(len(frame), -1, 2)
    elif len(points) == 1:
        x, y = found[points[0]].T
        brackets = frame[points[0]].astype(str).str.contains(r"[\[({]").all()
        return (frame.drop(columns=points).assign(x=x, y=y), None) if brackets else None
    else:
        return None
    warn_caller(
        f"the cells of {first_items(map(repr, used))} hold several numbers: they are "
        f"read as x and y of {tracks.shape[1]} points"
    )
    names = _names(points if used is points else range(tracks.shape[1]), "xy")
    values = pd.DataFrame(tracks.reshape(len(frame), -1), frame.index, names)
    return pd.concat([frame.drop(columns=used), values], axis=1), names


def _axes_apart(frame: "pd.DataFrame") -> "pd.DataFrame":
    """Return a table with a row for each coordinate with columns x and y instead."""
    for name in frame.select_dtypes(["object", "string"]):
        if frame[name].nunique() > len(frame) / 2:
            continue
        texts = frame[name].astype(str).str.strip()
        axes, known = texts.str.lower(), {}
        coordinates = {text: parse_coordinate(text) for text in texts.unique()}
        if all(coordinates.values()) and len(coordinates) >= 2 * MIN_POINTS:
            known = {name: texts.map({t: c[1] for t, c in coordinates.items() if c})}
            axes = texts.map({t: "xyz"[c[0]] for t, c in coordinates.items() if c})
        if not {"x", "y"} <= {*axes} <= {"x", "y", "z", *CONFIDENCES}:
            continue
        columns = frame.drop(columns=name).assign(**known)
        counts, few = columns.nunique(), len(columns) / 2
        keys = [n for n in columns if 1 < counts[n] < few or n in known]
        others = [n for n in columns if n not in keys and n not in CONFIDENCES]
        value = ([n for n in columns if _VALUE.search(str(n))] or others)[-1]
        keys = [n for n in keys if n not in (value, *CONFIDENCES)]
        table = columns[axes == "x"].rename(columns={value: "x"})
        for axis in {*axes} - {"x"}:
            part = columns[axes == axis][[*keys, value]].rename(columns={value: axis})
            table = table.merge(part, how="left", on=keys, validate="one_to_one")
        return table
    return frame


def _points_apart(frame: "pd.DataFrame", pair: Given, given: Given) -> Apart:
    """Return a table with a row for each frame in place of one for each point."""
    frame = frame.rename(columns=lambda name: str(name).strip())
    names = list(frame)
    pairs = axis_pairs(only_points(names)) or axis_pairs(names)  # beside width, height
    if pair:
        pairs = [(pair[0], pair[1], -1)]
    plain = [each for each in pairs if "".join(each[:2]).lower() == "xy"]
    if given is not None and not pairs:
        raise ValueError(
            f"with {named('row_per_point')}, columns named x and y are needed, or "
            f"their names in {named('columns')}, such as 'u,v'"
        )
    if not 0 < len(pairs) < MIN_POINTS:
        return None
    x, y, place = (plain or pairs)[0]
    z = f"{x[:place]}{'z' if x[place] == 'x' else 'Z'}{x[place + 1 :]}"
    values = {"x": x, "y": y} | ({"z": z} if z in names else {})
    words = {name.lower(): name for name in names if len(name) > 1}
    values |= {word: words[word] for word in CONFIDENCES if word in words}
    keys = [n for n in names if n not in values.values() and frame[n].nunique() > 1]
    found = _keys_of(frame, keys) if given is None else _keys_as_given(frame, given)
    if found is None:
        return None
    if len(pairs) > 1 and not plain:
        listed = " or ".join(repr(f"{x},{y}") for x, y, _ in pairs)
        raise ValueError(
            "the table has a row for each point, and several pairs of coordinates. "
            f"Choose with {named('columns')}, {listed}"
        )
    frame, by_frame, by_point = found
    groups = frame.groupby(by_frame or np.zeros(len(frame)), sort=False, dropna=False)
    row = groups.ngroup().to_numpy()
    texts = frame[by_point].astype(str).apply(lambda column: column.str.strip())
    texts = texts.agg("_".join, axis=1) if len(by_point) > 1 else texts[by_point[0]]
    point, labels = pd.factorize(texts)
    numbers = pd.to_numeric(pd.Series(labels), errors="coerce")
    if (numbers % 1 == 0).all():
        order = np.argsort(numbers.to_numpy(), kind="stable")
        point, labels = np.argsort(order)[point], numbers.astype(int)[order].tolist()
    if (twice := pd.DataFrame({"row": row, "point": point}).duplicated()).any():
        raise ValueError(
            f"a frame has several rows for the point {texts[twice].iloc[0]!r}: name "
            f"all columns that tell frames apart in {named('row_per_point')}"
        )
    wide = frame.set_index([row, point])[[*values.values()]].unstack()
    wide = wide.set_axis([n for a in values for n in _names(labels, [a])], axis=1)
    first = np.unique(row, return_index=True)[1]
    others = [name for name in frame if name not in {*values.values(), *by_point}]
    codes = {name: pd.factorize(frame[name])[0] for name in others}
    of_frame = [n for n, code in codes.items() if (code[first][row] == code).all()]
    unassigned = [name for name in others if name not in of_frame]
    told = f"; left out, as they differ between its points: {first_items(unassigned)}"
    if given is None or unassigned:
        option = ",".join([*by_frame, "+".join(by_point)])
        warn_caller(
            f"the table has a row for each point: {', '.join(by_frame) or 'nothing'} "
            f"tells {len(first)} frames apart, {', '.join(by_point)} {len(labels)} "
            f"points ({named('row_per_point', option)}){told * bool(unassigned)}"
        )
    kept = frame[of_frame].iloc[first].reset_index(drop=True)
    points = _names(labels, "xy") if len(by_point) < 2 else None
    return pd.concat([kept, wide], axis=1), points


def _names(labels: Iterable[Any], axes: Iterable[str]) -> list[str]:
    """Return the names of columns of points, such as x_0, or nose_x."""
    pairs = [(str(label).strip(), axis) for label in labels for axis in axes]
    return [f"{a}_{j}" if j.isdigit() else f"{j}_{a}" for j, a in pairs]


def _keys_as_given(frame: "pd.DataFrame", given: str | Sequence[str]) -> Keys:
    """Return a table, and the columns that tell its frames and points apart, as given.

    One that is not there is counted among the rows that the others do not tell apart.
    """
    *by_frame, point = split_patterns(given)
    keys = [*by_frame, *point.split("+")]
    present = [name for name in keys if name in frame]
    absent = [name for name in keys if name not in frame]
    if len(absent) > 1:
        raise ValueError(
            "row_per_point must name the columns that tell frames apart, and then that "
            f"of the points, such as 'frame,landmark'; the table has no {absent}"
        )
    groups = frame.groupby(present or np.zeros(len(frame)), dropna=False)
    counts = {name: groups.cumcount() for name in absent}
    return frame.assign(**counts), by_frame, point.split("+")


def _keys_of(frame: "pd.DataFrame", keys: list[str]) -> Keys | None:
    """Return a table, and the fewest columns that tell its frames and points apart.

    None if it has no row for each point.
    """
    codes = pd.DataFrame({name: pd.factorize(frame[name])[0] for name in keys})
    sizes, is_frame = codes.nunique(), {n: bool(_FRAME.search(n)) for n in keys}
    # Points have names or whole numbers.
    no_point = (frame[keys].apply(pd.to_numeric, errors="coerce") % 1 > 0).any()

    def count(names: list[str]) -> int:
        return len(codes[names].drop_duplicates()) if names else 1

    of_points = [name for name in keys if _POINT.search(name)]
    image = next(filter(_IMAGE.fullmatch, keys), None)
    others = [n for n in keys[::-1] if not (is_frame[n] or no_point[n])]
    for point in dict.fromkeys([*of_points, *others]):
        by_frame, by_point = [name for name in keys if name != point], [point]
        if count(keys) < len(frame):
            break
        by_size = sorted(by_frame, key=lambda n: (is_frame[n], -sizes[n], n == image))
        for name in by_size:
            fewer = [other for other in by_frame if other != name]
            if count([*fewer, point]) == len(frame):
                by_frame = fewer
        if not by_frame and any(is_frame.values()):
            continue  # the points of all frames have numbers of their own
        # Parts, such as hands and face, have other points; people have the same.
        for name in sorted(by_frame, key=lambda n: -sizes[n])[1:]:
            few = sizes[point] < MIN_POINTS
            other = few or count([name, point]) < 0.75 * sizes[name] * sizes[point]
            if other and not is_frame[name]:
                by_frame.remove(name)
                by_point.insert(0, name)
        for name in by_point[::-1]:
            fewer = [other for other in by_point if other != name]
            if fewer and count([*by_frame, *fewer]) == len(frame):
                by_point = fewer
        n_points = count(by_point)
        if n_points >= MIN_POINTS and len(frame) > 0.4 * n_points * count(by_frame):
            return frame, by_frame, by_point
    # What no column tells apart is counted, if there is the same number of each.
    by = [name for name in keys if sizes[name] <= len(frame) / 2]
    counted = "point" if not of_points else "individual" if len(by) > 1 else "frame"
    alike = codes.groupby(by).size() if by else pd.Series([1])
    minimum = 2 if of_points else MIN_POINTS if image in by else np.inf
    if alike.nunique() > 1 or alike.iloc[0] < minimum:
        return None
    by = [name for name in by if name not in of_points[:1]]
    return _keys_as_given(frame, [*by, counted, *of_points[:1]])
