"""Choose columns of a table by patterns: ``#`` is a number, ``*`` is any text."""

import re
from collections.abc import Hashable, Sequence


def split_patterns(columns: str | Sequence[str]) -> list[str]:
    """Return the patterns of x and y columns in turn."""
    listed = columns.split(",") if isinstance(columns, str) else list(columns)
    patterns = [pattern.strip() for pattern in listed]
    if not patterns or len(patterns) % 2 or not all(patterns):
        raise ValueError(
            "columns must name x and y columns in turn, such as 'x_#,y_#'; "
            f"got {columns!r}"
        )
    return patterns


def columns_matching(names: Sequence[Hashable], pattern: str) -> dict[tuple, str]:
    """Return the columns that match a pattern, with keys from its wildcards.

    A key is a tuple with one entry a wildcard: an int for ``#``, a text for ``*``. A
    column whose name is the pattern itself is the only match, with the key ``()``.
    """
    exact = [
        name for name in names if isinstance(name, str) and name.strip() == pattern
    ]
    if len(exact) == 1:
        return {(): exact[0]}
    expression = _regular_expression(pattern)
    wildcards = re.findall("[#*]", pattern)
    found: dict[tuple, str] = {}
    for name in names:
        match = expression.fullmatch(name.strip()) if isinstance(name, str) else None
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
        raise ValueError(f"no column matches {pattern!r}; {first_columns(names)}")
    return found


def covers(pattern: str, other: str) -> bool:
    """Tell whether `pattern` matches every name that `other` matches."""
    return _regular_expression(pattern).fullmatch(other) is not None


def first_columns(names: Sequence[Hashable]) -> str:
    """Say what the first columns are called."""
    listed = ", ".join(repr(name) for name in names[:4])
    return f"the table's {len(names)} columns are {listed}" + (
        ", ..." if len(names) > 4 else ""
    )


def _regular_expression(pattern: str) -> re.Pattern[str]:
    """Translate a pattern into a regular expression with a group a wildcard."""
    wildcards = {"#": r"(\d+)", "*": "(.+)"}
    parts = re.split(r"([#*])", pattern)
    expression = "".join(wildcards.get(part, re.escape(part)) for part in parts)
    return re.compile(expression, re.DOTALL)  # names may hold line breaks
