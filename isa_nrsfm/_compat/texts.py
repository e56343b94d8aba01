"""Texts of messages, and names of files."""

import html
import re
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any

# Columns with the number of a frame, with an image, and with the name of one.
FRAME = r"(?:video|image)?[ _.]?frame(?:[ _.]?(?:id|idx|index|no|nr|num|number))?"
IMAGE = r"(?:image|img|photo|frame)(?:[ _.]?(?:id|name|path|file))?"
IMAGE_NAME = rf"{IMAGE}|file[ _.]?(?:name|path)?"
# Times in names of images: dates, also with times of day; times of day alone; seconds
# with decimals, and since 1970.
_TIME = re.compile(
    r"(?<!\d)(?:19|20)\d\d[-_.]?[01]\d[-_.]?[0-3]\d(?:(?=\.\D)|[-_. T]*[0-2]\d"
    r"(?:[-_.:h]?[0-5]\d[-_.:m]?[0-5]\d(?:\.\d+)?|[-.:h][0-5]\d))(?!\d)"
    r"|(?<![^/\\])[0-2]\d[-_.:h][0-5]\d[-_.:m][0-5]\d(?=s?\.\D)"
    r"|(?:(?<![a-z\d])|(?<=frame)|(?<=image)|(?<=img)|(?<=time))\d+\.\d{1,3}(?=s?\.\D)"
    r"|(?<!\d)[1-9]\d{9,}(?!\d)",
    re.IGNORECASE,
)

# Characters that a terminal obeys, but line breaks and tabs, and those that turn the
# direction of writing.
_CONTROL = re.compile(
    "[\x00-\x08\x0b-\x1f\x7f-\x9f\u2028\u2029\u202a-\u202e\u2066-\u2069]"
)


def printable(text: str) -> str:
    r"""
    Return a text of a stranger's file with control characters written out.

    >>> from isa_nrsfm._compat.texts import printable
    >>> print(printable("nose\x1b[2J"))
    nose\x1b[2J
    """
    return _CONTROL.sub(lambda found: ascii(found[0])[1:-1], text)


def escape(text: str) -> str:
    """Return a text for a page of HTML."""
    return html.escape(printable(text))


def first_items(items: Iterable[Any], most: int = 4) -> str:
    """Return the first items with commas between them, and dots if there are more."""
    texts = [printable(str(item)) for item in items]
    return ", ".join(texts[:most]) + ", ..." * (len(texts) > most)


def percent(share: float) -> str:
    """Return a share in percent, with three digits."""
    return f"{100 * share:.3g} %"


def aligned(columns: Mapping[str, Iterable[str]]) -> str:
    """Return a table as lines, with columns of one width, by their titles."""
    cells = [(title, *column) for title, column in columns.items()]
    widths = [max(map(len, column)) for column in cells]
    lines = zip(*cells, strict=True)
    return "\n".join("  ".join(map(str.rjust, line, widths)) for line in lines)


def by_number(path: Path | str) -> tuple[list[str | int], str]:
    """
    Return a key that sorts files by name, and numbers in names by size.

    >>> from pathlib import Path
    >>> from isa_nrsfm._compat.texts import by_number
    >>> [file.name for file in sorted(map(Path, ["f10", "f9", "f1"]), key=by_number)]
    ['f1', 'f9', 'f10']
    """
    name = path if isinstance(path, str) else path.name
    parts = re.split("([0-9]+)", name)
    return [int(each) if i % 2 else each for i, each in enumerate(parts)], name


def have_times(names: Sequence[str]) -> bool:
    """
    Return whether names of images tell them apart by times instead of numbers.

    >>> from isa_nrsfm._compat.texts import have_times
    >>> have_times(["2023-05-01_12-00-30.png", "2023-05-01_12-00-31.png"])
    True
    """
    stems = {_TIME.sub("", name) for name in names}
    return all(map(_TIME.search, names)) and len(stems) < len({*names})


def frame_numbers(names: Sequence[str]) -> list[int] | None:
    """
    Return the numbers that names of images have; None if these are no numbers of them.

    It is the number without which the fewest names differ, those of videos.

    >>> from isa_nrsfm._compat.texts import frame_numbers
    >>> frame_numbers(["v1/img0_x2.png", "v1/img10_x2.png", "v1/img20_x2.png"])
    [0, 10, 20]
    """
    if have_times(names):
        return None
    parts = [re.split("([0-9]+)", name) for name in names]
    minimum, found = max(len(set(names)) // 2, 1), None
    for place in range(-2, -min(map(len, parts)), -2):
        videos = {(*each[:place], *each[place + 1 :]) for each in parts}
        if len(videos) <= minimum:
            minimum, found = len(videos) - 1, [int(each[place]) for each in parts]
    return found


def as_utf8(text: str) -> str:
    r"""
    Return a text that can be written as UTF-8.

    Python marks each byte of a file's name that is not UTF-8 by a lone surrogate, which
    cannot be encoded (PEP 383). It becomes six characters:

    >>> import os
    >>> from isa_nrsfm._compat.texts import as_utf8
    >>> print(as_utf8("café " + os.fsdecode(b"caf\xe9")))
    café caf\udce9
    """
    return text.encode("utf-8", "backslashreplace").decode()
