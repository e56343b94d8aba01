"""Tables of other shapes: a row for each point or coordinate, a point in each cell.

They become tables with a row for each frame, and two columns for each point.
"""

import re
from collections.abc import Iterable, Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from isa_nrsfm._compat import pandas as pd
from isa_nrsfm._compat.caller import warn_caller
from isa_nrsfm._compat.texts import FRAME, IMAGE_NAME, first_items
from isa_nrsfm._parameters import named
from isa_nrsfm.io._landmark_columns import (
    CONFIDENCES,
    MIN_POINTS,
    axis_pairs,
    landmark_sets,
    matches,
    only_points,
    split_patterns,
)
from isa_nrsfm.skeletons._column_names import parse_coordinate

# Columns that name points, and frames or who is shown.
_POINT = re.compile(r"(?i)point|landmark|joint|marker|node|part(?!ic)")
_FRAME = re.compile(
    "(?i)frame|time|image|slice|video|file|session|trial|person|people|participant|subject|"
    "patient|animal|individual|track|face|hand"
)
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


def frames_of(
    frame: "pd.DataFrame",
    columns: str | Sequence[str] | None = None,
    row_per_point: str | Sequence[str] | None = None,
) -> tuple["pd.DataFrame", str | Sequence[str] | None]:
    """Return a table with a row for each frame, and what chooses the columns of points.

    Tables that have one are returned as they are.
    """
    names, patterns = list(frame.columns), split_patterns(columns)
    if not all(isinstance(name, str) for name in names):
        return frame, columns
    pair = patterns if len(patterns) == 2 and {*patterns} <= {*names} else None
    found: tuple[pd.DataFrame, list[str] | None] | None = None
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


def _cells_apart(
    frame: "pd.DataFrame",
) -> tuple["pd.DataFrame", list[str] | None] | None:
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
        if cells.empty or len(_NUMBER.findall(cells.iloc[0])) < 2:
            continue
        if cells.map(_NUMBERS.fullmatch).isna().any():
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
    elif (
        len(points) == 1 and frame[points[0]].astype(str).str.contains(r"[\[({]").all()
    ):
        x, y = found[points[0]].T
        return frame.drop(columns=points).assign(x=x, y=y), None
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
        keys = [
            n
            for n in columns
            if 1 < columns[n].nunique() < len(columns) / 2 or n in known
        ]
        others = [n for n in columns if n not in keys and n not in CONFIDENCES]
        value = ([n for n in columns if _VALUE.search(str(n))] or others)[-1]
        keys = [n for n in keys if n not in (value, *CONFIDENCES)]
        table = columns[axes == "x"].rename(columns={value: "x"})
        for axis in {*axes} - {"x"}:
            part = columns[axes == axis][[*keys, value]].rename(columns={value: axis})
            table = table.merge(part, how="left", on=keys, validate="one_to_one")
        return table
    return frame


def _points_apart(
    frame: "pd.DataFrame", pair: Sequence[str] | None, given: str | Sequence[str] | None
) -> tuple["pd.DataFrame", list[str] | None] | None:
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
    row = np.zeros(len(frame), int)
    if by_frame:
        row += frame.groupby(by_frame, sort=False, dropna=False).ngroup().to_numpy()
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
    listed = given.split(",") if isinstance(given, str) else list(given)
    *by_frame, point = [name.strip() for name in listed]
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
        for name in sorted(
            by_frame, key=lambda n: (is_frame[n], -sizes[n], n == image)
        ):
            fewer = [other for other in by_frame if other != name]
            if count([*fewer, point]) == len(frame):
                by_frame = fewer
        if not by_frame and any(is_frame.values()):
            continue  # the points of all frames have numbers of their own
        # Parts, such as hands and face, have other points; people have the same.
        for name in sorted(by_frame, key=lambda n: -sizes[n])[1:]:
            few = sizes[point] < MIN_POINTS
            if not is_frame[name] and (
                few or count([name, point]) < 0.75 * sizes[name] * sizes[point]
            ):
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
