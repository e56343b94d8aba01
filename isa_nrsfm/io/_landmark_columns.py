"""Find the landmark columns of a table by their names, or by patterns.

In patterns ``#`` is a number and ``*`` is any text.
"""

import re
from collections import Counter
from collections.abc import Hashable, Iterable, Sequence
from fnmatch import fnmatchcase
from itertools import chain
from typing import Any, NamedTuple, NoReturn

from isa_nrsfm._compat.caller import warn_caller
from isa_nrsfm._compat.texts import first_items
from isa_nrsfm._parameters import named
from isa_nrsfm.skeletons._column_names import (
    individuals_in,
    parse_coordinate,
    point_names,
    without_boxes,
)

# What stands for the axis letter in the names of confidences: nose_conf, conf_0.
CONFIDENCES = (
    *("confidence", "conf", "likelihood", "score", "visibility", "c"),
    *("p", "prob", "probability", "v", "vis", "presence"),
)
# One basis shape needs 3 K + 3 = 6 dimensions, and J centred points have J - 1.
MIN_POINTS = 7

# Words of columns with x and y that are no points, and of the same points once more: in
# another unit, filtered, or their velocities.
_NO_POINT = re.compile(
    "(?i)(?<![a-z])(?:gyro|gyroscope|acc|accel|accelerometer|acceleration|mag|magnetometer"
    "|imu|gravity|force|torque|cop|touch|screen|scroll|wheel|eye_?track(?:er|ing)|"
    "(?:optical_?)?flow|offset|image_?size|resolution|"
    "gaze|fixation|cursor|joystick|rotation|head_?(?:rot|angle)|euler|angular_?velocity|"
    "quaternion|translation|velocity|speed|b?box|roi|crop|centroid|cent(?:er|re)_?of_?mass"
    "|com|cog|stimulus)(?![a-z])|^(?:mouse|target|origin|head_?pose)$"
)
_COPY = re.compile(
    "(?i)world|pixels?|px|norm|normali[sz]ed|raw|filt|filtered|filter|smooth|smoothed|"
    "interp|interpolated|vel|velocity|speed|acc|acceleration|[cm]?m|rel|relative|abs|"
    "absolute|image|img|[23]d|pred|predicted|gt|true|truth|orig|original|corrected"
)


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


def find_landmark_columns(
    names: Iterable[Hashable], columns: str | Sequence[str] | None = None
) -> LandmarkColumns:
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
    of_set = [n for n in others if any(matches(n, each) for each in patterns)]
    if of_set:
        warn_caller(
            f"the columns {first_items(sorted(of_set))} are no points by their names, "
            f"and are left out. If they are, give {named('columns', pattern)}"
        )
    return _select(names, patterns)


def split_patterns(columns: str | Sequence[str] | None) -> list[str]:
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


def _refuse_copies(names: Sequence[Hashable]) -> None:
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
    plain = len(texts) - sum(map(len, pairs.values()))
    minimum = max(MIN_POINTS, 0.8 * plain)
    copies = [found[0] for found in pairs.values() if len(found) >= minimum]
    words = []
    for point, copy in copies:
        same = [a == b for a, b in zip(f"{point}\n", copy, strict=False)].index(False)
        words.append(copy[same : same + len(copy) - len(point)])
    if copies:
        _ask_which(names, " and ".join(copies[0]), words, [f"-*{w}*" for w in words])


def _ask_which(
    names: Sequence[Hashable], which: str, words: list[str], without: Sequence[str] = ()
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


def _chosen(names: Sequence[Hashable], patterns: Iterable[str]) -> list[Hashable]:
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
    likely = ((pattern, n) for pattern, n in found.items() if pattern.count(",") == 1)
    pattern, size = max(likely, key=lambda each: each[1], default=("", 0))
    return pattern if size >= MIN_POINTS else "px_#,py_#"


def landmark_sets(names: Iterable[Hashable]) -> dict[str, int]:
    """Count the points of every set of landmarks by pattern, in table order.

    Sets have an x and a y column or more (``x0, x1, x2`` are those of any table).
    """
    members: dict[tuple[str, str, str], list[set[int | str]]] = {}
    for axis, _, memberships in filter(None, map(parse_coordinate, names)):
        for columns, key in memberships:
            keys = members.setdefault(columns, [set(), set(), set()])
            keys[axis].add(key)
    sizes = {
        (before + axes[0] + after, before + axes[1] + after): len(x | y)
        for (before, axes, after), (x, y, _) in members.items()
        if x and y
    }
    # Leave out a "*" set that has no more points than a "#" set inside it.
    return {
        ",".join(patterns): size
        for patterns, size in sizes.items()
        if "*" not in patterns[0]
        or not any(
            other_size == size
            and "#" in other[0]
            and regular_expression(patterns[0]).fullmatch(other[0])
            for other, other_size in sizes.items()
        )
    }


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
    words = ((w, w.capitalize(), w.upper()) for w in CONFIDENCES)
    for word in chain.from_iterable(words):
        found = [f"{before}{word}{after}" for before, after in parts]
        if by_name.keys() >= {*found}:
            return [by_name[name] for name in found]
    return []


def _refuse_individuals(names: Sequence[Hashable], sets: dict[str, int]) -> None:
    """Raise if points have the names of several individuals in one row."""
    patterns = [pattern.split(",")[0] for pattern in sets]
    lists = [_columns_matching(names, pattern).values() for pattern in patterns]
    x = list(dict.fromkeys(chain.from_iterable(lists)))
    if not (who := individuals_in(x, MIN_POINTS)):
        return
    if any(map(_COPY.fullmatch, who)):
        found = [
            re.search(rf"[ _.\-]*{re.escape(w)}[ _.\-]*", " ".join(x)) for w in who
        ]
        _ask_which(
            names, " and ".join(who), [each[0].strip(" ") for each in found if each]
        )
    largest = max(sets, key=sets.__getitem__)
    whole = largest if sets[largest] == len(x) else ",".join(sets)
    listed, n_points = ",".join(who), len(x) // len(who)
    way = (
        f"For a row for each, use {named('individuals', listed)}"
        if n_points >= MIN_POINTS
        else f"Their {n_points} points are too few to fit them; {MIN_POINTS} are needed"
    )
    raise ValueError(
        f"the {len(x)} points have the same names but for {', '.join(who)}, as those "
        f"of several individuals in one row, or in views of several cameras. {way}. If "
        f"all are points of one body, use {named('columns', whole)}"
    )


def _select(names: Sequence[Hashable], patterns: Sequence[str]) -> LandmarkColumns:
    """Return the columns that match pairs of patterns of x and y columns."""
    x: list[str] = []
    y: list[str] = []
    for x_pattern, y_pattern in zip(patterns[::2], patterns[1::2], strict=True):
        x_by_key = _columns_matching(names, x_pattern)
        y_by_key = _columns_matching(names, y_pattern)
        for one, other, pattern in (
            (x_by_key, y_by_key, y_pattern),
            (y_by_key, x_by_key, x_pattern),
        ):
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
    if len(set(chosen)) < len(chosen):
        twice = next(name for name in chosen if chosen.count(name) > 1)
        raise ValueError(f"the patterns {joined} match {twice!r} twice")
    if not {"#", "*"}.isdisjoint(joined):
        _warn_of_left_out(names, chosen, joined)
    points, z = point_names(x), _z_of(names, x)
    return LandmarkColumns(joined, points, tuple(x), tuple(y), z)


def _columns_matching(names: Sequence[Hashable], pattern: str) -> dict[tuple, str]:
    """Return the columns that match a pattern, with keys from its wildcards.

    A key is a tuple with one entry a wildcard: an int for ``#``, a text for ``*``. A
    column whose name is the pattern itself is the only match, with the key ``()``.
    """
    texts = [name for name in names if isinstance(name, str)]
    exact = [name for name in texts if name.strip() == pattern]
    if len(exact) == 1:
        return {(): exact[0]}
    expression = regular_expression(pattern)
    wildcards = re.findall("[#*]", pattern)
    found: dict[tuple, str] = {}
    for name in texts:
        match = expression.fullmatch(name.strip())
        if match is None:
            continue
        key = tuple(
            int(text) if wildcard == "#" else text
            for text, wildcard in zip(match.groups(), wildcards, strict=True)
        )
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


def _warn_of_left_out(
    names: Sequence[Hashable], chosen: Sequence[str], pattern: str
) -> None:
    """Warn if patterns match only a part of a set of x and y columns."""
    sets = {point[0] for _, _, point in _coordinates(chosen)}
    used = {*chosen}
    omitted = [
        name
        for name, axis, point in _coordinates(names)
        if name not in used and axis < 2 and point[0] in sets
    ]
    if omitted:
        warn_caller(
            f"the patterns {pattern!r} match {len(chosen)} columns and leave out "
            f"{len(omitted)} that are named alike; the first is {omitted[0]!r}"
        )


def _z_of(names: Sequence[Hashable], x_columns: Iterable[str]) -> tuple[str, ...]:
    """Return the columns with the third coordinate of the points of x columns."""
    points = {point for _, _, point in _coordinates(x_columns)}
    found = _coordinates(names)
    return tuple(name for name, axis, point in found if axis == 2 and point in points)


def _coordinates(names: Iterable[Hashable]) -> list[tuple[str, int, tuple]]:
    """Return the coordinates among columns: name, axis, set and key of the point."""
    found = [(str(name), parse_coordinate(name)) for name in names]
    return [(name, c[0], c[2][0]) for name, c in found if c is not None]


def _several_found(names: Sequence[Hashable], candidates: dict[str, int]) -> str:
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


def _first_columns(names: Sequence[Hashable]) -> str:
    """List the first columns of a table."""
    listed = ", ".join(map(repr, names[:4])) + ", ..." * (len(names) > 4)
    return f"the table's {len(names)} columns are {listed}"
