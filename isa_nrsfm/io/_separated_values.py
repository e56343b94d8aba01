"""Read chosen columns of large csv files of numbers, and notice truncated lines."""

import csv
import re
from collections.abc import Collection, Iterable, Iterator, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any, TypeVar

from isa_nrsfm._compat.optional import import_optional

if TYPE_CHECKING:
    import pandas as pd

Line = TypeVar("Line", str, bytes)
# As C and C++ programs on Windows write a number that is none.
_NOT_NUMBERS = ["nan(ind)", "-nan(ind)"]
# The longest header of a known format (py-feat with a mesh) has 40 000 characters.
_LONGEST_LINE = 2**20


def first_lines(path: Path, n_lines: int) -> list[str]:
    """
    Return the first lines of a text file without their ends, for a look at its format.

    Parameters
    ----------
    path : Path
        The file.
    n_lines : int
        Number of lines. There are fewer if the file is shorter.

    Returns
    -------
    list of str
        The lines, as far as they are UTF-8 and not longer than a megabyte.
    """
    lines: list[str] = []
    with path.open("rb") as file:
        for _ in range(n_lines):
            line = file.readline(_LONGEST_LINE)
            try:
                text = line.decode("utf-8" if lines else "utf-8-sig")
            except UnicodeDecodeError:
                break
            if not text or (not text.endswith(("\n", "\r")) and len(line) > 2**19):
                break
            lines.append(text.rstrip("\r\n"))
    return lines


def header_names(path: Path) -> list[str]:
    """Return the column names of a csv file as they are written, or no names."""
    rows = header_rows(path, 1)
    return rows[0] if rows else []


def header_rows(path: Path, n_rows: int) -> list[list[str]]:
    """Return the cells of the first rows of a csv file; fewer if it is none."""
    try:
        return list(csv.reader(first_lines(path, n_rows), strict=True))
    except csv.Error:
        return []


def without_nulls(lines: Iterable[Line], null: Line) -> Iterator[Line]:
    """
    Yield lines, and raise at a null character, at which some readers end a cell.

    Files in UTF-16 without a mark hold many.
    """
    for number, line in enumerate(lines, start=1):
        if null in line:
            raise ValueError(
                f"its text is not in UTF-8: line {number} has a null character"
            )
        yield line


def read_columns(
    path: Path,
    *,
    leave_out: re.Pattern[str] | Collection[str] = (),
    numbers: Collection[str],
    text: Collection[str] = (),
    n_header: int = 1,
    names: Sequence[str] | None = None,
) -> "pd.DataFrame":
    """
    Read columns of a csv file whose lines must all be of the same length.

    Parameters
    ----------
    path : Path
        The file.
    leave_out : re.Pattern or collection of str, optional
        Columns that are not read, by an expression for their names or by the names.
    numbers : collection of str
        Columns that must hold numbers only. Empty cells are NaN.
    text : collection of str, optional
        Columns that stay as they are written. All others become numbers where all
        their cells are.
    n_header : int, default=1
        Number of lines before the first row.
    names : sequence of str, optional
        Names of the columns. By default those of the first line, without blanks.

    Returns
    -------
    DataFrame
        The columns, in the order of the file.

    Raises
    ------
    ValueError
        If there is no row, if lines are not of the same length, if a cell that should
        be a number is none, or if there is a null character.
    """
    pd = import_optional("pandas", extra="io")
    if names is None:
        names = [name.strip() for name in header_names(path)]
    if len(set(names)) < len(names):
        twice = next(name for name in names if names.count(name) > 1)
        raise ValueError(f"two columns are called {twice!r}")
    _check_widths(path, n_header, len(names))
    if isinstance(leave_out, re.Pattern):
        leave_out = {name for name in names if leave_out.fullmatch(name)}
    options: dict[str, Any] = {
        "header": None,
        "names": names,
        "skiprows": n_header,
        "usecols": [name for name in names if name not in leave_out],
        "index_col": False,
        "skipinitialspace": True,
        "encoding": "utf-8-sig",
        "na_values": _NOT_NUMBERS,
        "low_memory": False,
    }
    frame = pd.read_csv(path, dtype=dict.fromkeys(text, "str"), **options)
    types = pd.api.types
    found = dict(frame.dtypes)
    for name in numbers:
        if not types.is_numeric_dtype(found[name]) or types.is_bool_dtype(found[name]):
            raise ValueError(_first_bad_cell(frame[name]))
    return frame


def _check_widths(path: Path, n_header: int, n_columns: int) -> None:
    """
    Raise if a line does not have as many values as there are columns, or has nulls.

    pandas fills short lines up and cuts long ones where only some columns are read.
    """
    n_rows = 0
    with path.open("rb") as file:
        for number, line in enumerate(without_nulls(file, b"\0"), start=1):
            if number <= n_header or not line.strip():
                continue
            n_rows += 1
            n_values = line.count(b",") + 1
            if b'"' in line:
                try:
                    cells = next(csv.reader([line.decode("utf-8")], strict=True))
                except (UnicodeDecodeError, csv.Error) as error:
                    raise ValueError(
                        f"line {number} cannot be read: {error}"
                    ) from error
                n_values = len(cells)
            if n_values != n_columns:
                raise ValueError(
                    f"line {number} has {n_values} values, but the header has "
                    f"{n_columns} names: the file may be truncated"
                )
    if n_rows == 0:
        raise ValueError("it has a header but no rows")


def _first_bad_cell(column: "pd.Series") -> str:
    """Say which cell should be a number and is none."""
    pd = import_optional("pandas", extra="io")
    text = column.astype("str")
    bad = pd.to_numeric(text, errors="coerce").isna() & column.notna()
    row = int(bad.to_numpy().argmax())
    return (
        f"column {column.name!r} should hold numbers, but in row {row} (counted from "
        f"0) it has {text.iloc[row]!r}"
    )
