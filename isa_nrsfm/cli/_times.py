"""Times of frames: numbers, dates and durations, each in one reading for all rows."""

import re
import warnings
from itertools import product
from typing import Any

import numpy as np
from numpy.typing import NDArray

from isa_nrsfm._compat import pandas as pd
from isa_nrsfm._compat.caller import warn_caller
from isa_nrsfm._compat.texts import FRAME, IMAGE, IMAGE_NAME, frame_numbers, have_times
from isa_nrsfm.cli._options import TIMES
from isa_nrsfm.io._tables import with_points

_MINUTES, _ALL_THREE, _HOURS = _DURATIONS = ("%M:%S", "%H:%M:%S", "%H:%M")
_DURATION = r"(?:(\d+):(?=[0-5]?\d:))?(\d+):([0-5]\d(?:\.\d+)?)"
_DATES, _OF_DAY = TIMES["dates"], TIMES["of_day"]
_DAYS = [date.format(sign) for date, sign in product(_DATES, "/-. ")]
_TIMES = [" ".join(pair) for pair in product(_DAYS, _OF_DAY)]
# The ways in which dates and durations are usually written.
_FORMATS = ("ISO8601", *_DAYS, *_TIMES, *_OF_DAY[3:], _MINUTES, _HOURS)
_ZONE = r":\d\d.*(?:Z|[+-]\d\d:?\d*)"


def read_times(column: "pd.Series", format: str | None) -> tuple[NDArray, str]:
    """Return times as numbers, dates, or durations in seconds, and their unit.

    All cells are read in one format, which is given, or the only one that reads all.
    """
    if column.dtype.kind == "m":
        return np.asarray(column.dt.total_seconds()), "seconds"
    if column.dtype.kind == "M":
        dates = pd.to_datetime(column, utc=True).dt.tz_localize(None)
        return np.asarray(dates), "seconds"
    cells = column.dropna().astype(str)
    numbers = as_numbers(cells)
    if format is None and numbers.notna().all():
        of_frames = re.fullmatch(FRAME, str(column.name).strip(), re.IGNORECASE)
        unit = "frames" if of_frames else f"in the unit of the column {column.name}"
        return np.asarray(numbers.reindex(column.index), dtype=float), unit
    zoned = cells.str.fullmatch(f".*{_ZONE}")
    if zoned.any() and not zoned.all():
        raise ValueError(
            f"{zoned.sum()} of {len(cells)} frames have a time zone, such as Z or "
            f"+01:00, and others have none (first: {_cell(cells, ~zoned)})"
        )
    readings = {
        each: _read(cells, each)
        for each in ([format] if format else _FORMATS)
        if format or _read(cells.iloc[:1], each).notna().all()
    }
    whole = {each: read for each, read in readings.items() if read.notna().all()}
    if not whole:  # the format that reads most rows before it fails
        unread = [read.isna() for read in readings.values()]
        wrong = max(unread, key=lambda each: each.argmax(), default=cells.notna())
        expected = f"times written as {format}" if format else "numbers or dates"
        raise ValueError(
            f"expected {expected}, written alike in all frames; {wrong.sum()} of "
            f"{len(column)} are not (first: {_cell(cells, wrong)}). Name how they are "
            "written with --time-format, such as %d.%m.%Y, or use numbers"
        )
    chosen, first = next(iter(whole.items()))
    if others := {name: read for name, read in whole.items() if not read.equals(first)}:
        row = (next(iter(others.values())) != first).idxmax()
        listed = [
            f"{_shown(read[row])} (--time-format '{name}')"
            for name, read in ({chosen: first} | others).items()
        ]
        raise ValueError(
            f"{cells[row]!r} in row {row} can be {' or '.join(listed)}, and no other "
            "row decides it: choose one with --time-format"
        )
    return np.asarray(first.reindex(column.index)), "seconds"


def as_numbers(cells: "pd.Series") -> "pd.Series":
    """Return the numbers in cells, also with decimal commas; NaN in other cells."""
    with warnings.catch_warnings(action="ignore"):  # of commas
        written = with_points(cells.to_frame("cells"), ["cells"])["cells"]
    return pd.to_numeric(written, errors="coerce")


def image_numbers(table: "pd.DataFrame", fps: float | None = None) -> "pd.Series":
    """Return the number of the image of each row, under the name of its column.

    It is the number of the frame, that in the name of the image, or that of the image
    among all. Otherwise rows count. Warn if times by fps leave out those in names.
    """
    for expression in (FRAME, IMAGE_NAME, IMAGE):
        for name in table.columns:
            if not re.fullmatch(expression, str(name).strip(), re.IGNORECASE):
                continue
            numbers: Any = pd.to_numeric(table[name], errors="coerce")
            if expression == IMAGE_NAME:  # not of videos with many rows each
                several = name == "file" and table[name].duplicated().any()
                is_name = numbers.isna().all() and not several
                texts = [*map(str, table[name])]
                numbers = frame_numbers(texts) if is_name else None
                if fps and is_name and have_times(texts):
                    warn_caller(
                        f"--fps: the names of images in the column {name} have times "
                        f"(first: {texts[0]}) instead of numbers of frames. Images "
                        "count as successive frames, in their order. For these times "
                        f"use --time {name} with a --time-format, such as "
                        "%Y-%m-%d_%H-%M-%S.png, or a column frame of numbers"
                    )
            elif expression == IMAGE:
                numbers = pd.factorize(table[name])[0]
            if numbers is not None and np.isfinite(numbers).all():
                return pd.Series(numbers, dtype=float, name=str(name).strip())
    return pd.Series(range(len(table)))


def video_times(numbers: "pd.Series", groups: NDArray | None) -> NDArray:
    """Return the numbers of images, which must be a sequence within each group.

    Numbers without a name are those of rows, which must follow one another.
    """
    found = pd.DataFrame({"image": numbers, "group": 0 if groups is None else groups})
    again, name = found.duplicated(), numbers.name
    if again.any():
        raise ValueError(
            f"--fps: {again.sum()} of {len(again)} frames show the same image as an "
            f"earlier row (column {name}, first: row {again.idxmax()}): the table has "
            "several faces or videos. Name the column that tells them apart with "
            "--group, or leave the others out with --skip-rows"
        )
    steps = found.groupby("group")["image"].diff()
    if name is None and steps.median() > 1:
        raise ValueError(
            "--fps counts the rows of the table, but most rows that follow one another "
            f"are {steps.median():g} rows apart: the table seems to have several rows "
            "an image. Add a column frame with the number of the frame, or use --time"
        )
    return np.asarray(numbers)


def _read(cells: "pd.Series", format: str) -> "pd.Series":
    """Return the dates or seconds of a format, missing where cells are not written so.

    Minutes and seconds may have hours before them in some rows.
    """
    if format not in _DURATIONS:
        dates = pd.to_datetime(cells, format=format, errors="coerce", utc=True)
        return dates.dt.tz_localize(None)
    parts = cells.str.extract(f"^{_DURATION}$").astype(float)
    seconds = 3600 * parts[0].fillna(0.0) + 60 * parts[1] + parts[2]
    if format == _MINUTES:
        return seconds
    if format == _ALL_THREE:
        return seconds.where(parts[0].notna())
    of_day = parts[0].isna() & (parts[1] < 24) & ~cells.str.contains(".", regex=False)
    return (60 * seconds).where(of_day)


def _shown(time: object) -> str:
    """Return a date, or seconds, as they are read by people."""
    if isinstance(time, float):
        return f"{time:g} s"
    return str(time).removesuffix(" 00:00:00")


def _cell(cells: "pd.Series", which: "pd.Series") -> str:
    """Name the first of some cells."""
    return f"row {which.idxmax()}, {cells[which].iloc[0]!r}"
