"""Read chosen columns of large tables of numbers, and notice truncated lines."""

import csv
import re
from collections.abc import Collection, Iterator, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

from isa_nrsfm._compat.optional import import_optional
from isa_nrsfm.io._landmarks import refuse_same_names

if TYPE_CHECKING:
    import pandas as pd

SEPARATORS = {".csv": ",", ".tsv": "\t"}
# The longest header of a known format (py-feat with a mesh) has 40 000 characters.
_LONGEST_LINE = 2**20


def first_lines(path: Path, n_lines: int) -> list[str]:
    """Return the first lines of a text file, while they are UTF-8 and not too long."""
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


def header_rows(path: Path, n_rows: int) -> list[list[str]]:
    """Return the cells of the first rows of a file; fewer if it is no csv file."""
    try:
        separator = SEPARATORS.get(path.suffix.lower(), ",")
        lines = first_lines(path, n_rows)
        return list(csv.reader(lines, delimiter=separator, strict=True))
    except csv.Error:
        return []


def header_names(path: Path) -> list[str]:
    """Return the column names of a table without blanks around them."""
    if path.suffix.lower() == ".parquet":
        pyarrow = import_optional("pyarrow", extra="parquet")
        parquet = import_optional("pyarrow.parquet", extra="parquet")
        try:
            return [name.strip() for name in parquet.read_schema(path).names]
        except (OSError, pyarrow.ArrowException):
            return []
    return [name.strip() for row in header_rows(path, 1) for name in row]


def checked_rows(path: Path, separator: str = ",") -> Iterator[list[str]]:
    """Yield the non-empty rows of a text file.

    Raise if one has not as many cells as the first, if none follows it, or at a null
    character, as files in UTF-16 without a mark have. pandas would pad or cut the
    lines.
    """
    n_rows, n_columns = 0, 0
    with path.open(encoding="utf-8-sig", newline="") as file:
        rows = csv.reader(_without_nulls(file), delimiter=separator)
        for row in rows:
            if not row or (len(row) == 1 < n_columns and not row[0].strip()):
                continue
            n_columns = n_columns or len(row)
            if len(row) != n_columns:
                advice = "the file may be truncated"
                if n_rows == 1 and len(row) > n_columns:
                    advice = (
                        "delete titles and comments above the line of names, and name "
                        "each column, also that of row names (in R: col.names = NA)"
                    )
                raise ValueError(
                    f"line {rows.line_num} has {len(row)} values, but the header has "
                    f"{n_columns} names: {advice}"
                )
            n_rows += 1
            yield row
    if n_rows == 1:
        raise ValueError("it has a header but no rows")


def read_parquet(path: Path) -> "pd.DataFrame":
    """Read a parquet file."""
    pd = import_optional("pandas", extra="io")
    import_optional("pyarrow", extra="parquet")
    with path.open("rb"):  # opening errors as for text files
        pass
    frame = pd.read_parquet(path)
    if frame.empty:
        raise ValueError("it has no rows")
    unnamed = [i for i, name in enumerate(frame.index.names) if name is None]
    if len(unnamed) == frame.index.nlevels:
        return frame.reset_index(drop=True)
    index = frame.index.droplevel(unnamed)
    refuse_same_names([str(name) for name in (*index.names, *frame)])
    return frame.set_axis(index).reset_index()


def read_columns(
    path: Path,
    *,
    leave_out: re.Pattern[str] | Collection[str] = (),
    numbers: Collection[str],
    text: Collection[str] = (),
    n_header: int = 1,
    names: Sequence[str] | None = None,
) -> "pd.DataFrame":
    """Read columns of a table; lines of a text must all be of the same length.

    Columns in `leave_out`, names or an expression for them, are not read. Those in
    `numbers` must hold numbers, empty cells are NaN. Those in `text` stay text, others
    become numbers if all their cells are, none with zeros before it as in 007.
    `n_header` lines of a text come before the first row.
    """
    pd = import_optional("pandas", extra="io")
    names = header_names(path) if names is None else names
    refuse_same_names(names)
    if isinstance(leave_out, re.Pattern):
        leave_out = {name for name in names if leave_out.fullmatch(name)}
    if path.suffix.lower() == ".parquet":
        frame = read_parquet(path).rename(columns=lambda name: str(name).strip())
        frame = frame.drop(columns=[name for name in frame if name in leave_out])
        frame = pd.DataFrame(
            {n: frame[n] if n in text else _as_numbers(frame[n]) for n in frame}
        )
    else:
        separator = SEPARATORS[path.suffix.lower()]
        if sum(1 for _ in checked_rows(path, separator)) <= n_header:
            raise ValueError("it has a header but no rows")
        options: dict[str, Any] = {
            "sep": separator,
            "header": None,
            "names": names,
            "skiprows": n_header,
            "index_col": False,
            "skipinitialspace": True,
            "encoding": "utf-8-sig",
            # As C and C++ programs on Windows write a number that is none.
            "na_values": ["nan(ind)", "-nan(ind)"],
            "low_memory": False,
        }
        used = [name for name in names if name not in leave_out]
        frame = pd.read_csv(
            path, dtype=dict.fromkeys(text, str), usecols=used, **options
        )
        whole = frame.select_dtypes("integer").columns.difference(numbers)
        for name, cells in pd.read_csv(
            path, dtype=str, usecols=whole, **options
        ).items():
            if _of_codes(cells):
                frame[name] = cells
    types = pd.api.types
    found = dict(frame.dtypes)
    for name in numbers:
        if not types.is_numeric_dtype(found[name]) or types.is_bool_dtype(found[name]):
            cells = frame[name].astype("str")
            bad = pd.to_numeric(cells, errors="coerce").isna() & frame[name].notna()
            row = int(bad.to_numpy().argmax())
            raise ValueError(
                f"column {name!r} should hold numbers, but in row {row} (counted from "
                f"0) it has {cells.iloc[row]!r}"
            )
    return frame


def _as_numbers(column: "pd.Series") -> "pd.Series":
    """Return a column of texts as numbers, if all are and none is a code."""
    pd = import_optional("pandas", extra="io")
    if not pd.api.types.is_string_dtype(column):
        return column
    column = column.replace("", None)
    numbers = pd.to_numeric(column, errors="coerce")
    is_number = numbers.notna().equals(column.notna()) and not _of_codes(column)
    return numbers if is_number else column


def _of_codes(cells: "pd.Series") -> bool:
    """Return whether texts of whole numbers begin with zeros, as codes do."""
    return bool(cells.str.match(r"\s*[+-]?0\d+\s*$").any())


def _without_nulls(lines: Iterator[str]) -> Iterator[str]:
    """Yield lines, and raise at a null character."""
    for number, line in enumerate(lines, start=1):
        if "\0" in line:
            raise ValueError(
                f"its text is not in UTF-8: line {number} has a null character"
            )
        yield line
