"""Read tables of 2D landmarks from files, and take the landmarks out of them."""

import contextlib
import csv
import os
import re
import warnings
from collections.abc import Collection, Iterable, Iterator, Sequence
from functools import partial
from itertools import chain
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from isa_nrsfm._compat import pandas as pd
from isa_nrsfm._compat.caller import warn_caller
from isa_nrsfm._compat.files import reading, whole_file
from isa_nrsfm._compat.lazy import import_optional
from isa_nrsfm._compat.texts import FRAME, IMAGE_NAME
from isa_nrsfm.io import _landmark_columns
from isa_nrsfm.io._landmark_columns import Given
from isa_nrsfm.io._landmarks import Landmarks, assemble, refuse_same_names
from isa_nrsfm.skeletons import _column_names
from isa_nrsfm.skeletons._column_names import parse_coordinate

SEPARATORS = {".csv": ",", ".tsv": "\t", ".txt": "\t"}
# How pandas reads texts.
_CSV: Any = {"index_col": False, "encoding": "utf-8-sig", "low_memory": False}
# The longest header of a known format (py-feat with a mesh) has 40 000 characters.
_LONGEST_LINE = 2**20
# Bytes at the end of a file that show how its numbers are written.
_TAIL = 2**16
# Numbers with a decimal comma, and with commas between thousands.
_DECIMAL_COMMA = re.compile(r"\s*[+-]?\d*,\d+(?:[eE][+-]?\d+)?\s*")
_THOUSANDS = re.compile(r"\s*[+-]?[1-9]\d{0,2}(?:,\d{3})+(?:\.\d*)?\s*")
# Whether points are visible, as pandas and spreadsheets write it.
_SEEN = dict.fromkeys((True, "True", "TRUE", "true"), 1.0)
_SEEN |= dict.fromkeys((False, "False", "FALSE", "false"), 0.0)
TABLE_SUFFIXES = (*SEPARATORS, ".parquet")
_MISSING = _column_names.WORDS["missing"].split("|")


Missing = float | Sequence[float] | None


class LandmarkTable(NamedTuple):
    """
    A table split into its landmarks and its other columns.

    Parameters
    ----------
    points : DataFrame of shape (n_frames, 2 * n_points)
        The landmarks, float64, one row per frame, columns x0, y0, x1, y1, ... under
        their names in the table. NaN marks a missing point.
    other : DataFrame of shape (n_frames, n_other)
        All other columns as they were.
    """

    points: "pd.DataFrame"
    other: "pd.DataFrame"


def read_table(path: str | os.PathLike[str]) -> "pd.DataFrame":
    r"""
    Read a table from a csv, tsv or parquet file.

    In csv and tsv files the first line names the columns. Columns that are named like
    landmark coordinates become numbers where all their cells are numbers or
    empty. All other columns stay text, exactly as it is written, so that
    identifiers such as ``007`` survive.

    Parameters
    ----------
    path : str or path-like
        The file. Its suffix (``.csv``, ``.tsv``, ``.parquet``) determines the format.

    Returns
    -------
    DataFrame of shape (n_rows, n_columns)
        The table. Its rows are numbered from 0; a named index of a parquet file is
        among the first columns.

    Raises
    ------
    ValueError
        If the suffix is unknown, or if the file is empty, has columns of the same
        name, has lines of different length, or has another format than its suffix.
    OSError
        If the file cannot be opened.

    See Also
    --------
    landmark_table : Take the landmark columns out of the table.

    Examples
    --------
    >>> from pathlib import Path
    >>> from tempfile import TemporaryDirectory
    >>> from isa_nrsfm.io import read_table
    >>> with TemporaryDirectory() as folder:
    ...     path = Path(folder, "faces.csv")
    ...     _ = path.write_text("id,nose_x,nose_y\n007,1.5,2\n008,,")
    ...     table = read_table(path)
    >>> table
        id  nose_x  nose_y
    0  007     1.5     2.0
    1  008     NaN     NaN
    """
    table_suffix(path)
    with reading(path, "a table"):
        return parse_table(Path(path))


def parse_table(path: Path) -> "pd.DataFrame":
    """Read a table as `read_table` does; errors do not name the file."""
    if (suffix := table_suffix(path)) == ".parquet":
        return read_parquet(path)
    with path.open("rb") as file:
        if file.read(2) in (b"PK", b"\x1f\x8b"):
            raise ValueError(
                "it is a spreadsheet or a compressed file, in spite of its name: save "
                f"it as {suffix}, or unpack it"
            )
    return _read_text(path, separator_of(path))


def write_table(frame: "pd.DataFrame", path: str | os.PathLike[str]) -> None:
    """
    Write a table to a csv, tsv or parquet file, without its index.

    Numbers are written with all their digits.

    Parameters
    ----------
    frame : DataFrame
        The table.
    path : str or path-like
        The file. Its suffix (``.csv``, ``.tsv``, ``.parquet``) determines the format.

    Raises
    ------
    ValueError
        If the suffix is unknown.
    OSError
        If the file cannot be written.
    """
    suffix = table_suffix(path)
    if suffix == ".parquet":
        import_optional("pyarrow", extra="parquet")
    with whole_file(path) as file:
        if suffix == ".parquet":
            frame.to_parquet(file, index=False)
        else:
            frame.to_csv(file, sep=SEPARATORS[suffix], index=False)


def landmark_table(
    frame: "pd.DataFrame",
    *,
    columns: str | Sequence[str] | None = None,
    missing: Missing = None,
    individuals: str | Sequence[str] | None = None,
    row_per_point: str | Sequence[str] | None = None,
) -> LandmarkTable:
    """
    Take the landmark columns out of a table, in the order x0, y0, x1, y1, ....

    Columns are recognised and ordered by their names, such as ``x00, y00``,
    ``x_0, y_0``, ``0_x, 0_y``, ``nose_x, nose_y`` or ``nose.x, nose.y``, in whatever
    order they are in the table. A third coordinate is left aside.

    Parameters
    ----------
    frame : DataFrame
        The table.
    columns : str or sequence of str, optional
        The landmark columns, if their names are ambiguous: patterns of x and
        y columns in turn, such as ``"x_#,y_#"``, with ``#`` for a number and ``*`` for
        any text. A pattern after ``-``, as in ``"*_x,*_y,-gaze_*"``, leaves columns
        out, one after ``+`` all others. Of a table with a row for each point, also the
        names of x and y.
    missing : float or sequence of float, optional
        The x and y of missing points, such as 0 or -1, exactly; they become NaN. Of
        several numbers, a point has one.
    individuals : str or sequence of str, optional
        The individuals in one row, such as ``"1,2"`` for nose_1_x and nose_2_x: the
        parts by which their columns differ. Each has its own row, and the other
        columns have ``frame``, the number of the row, and ``individual``.
    row_per_point : str or sequence of str, optional
        Of a table with a row for each point, the columns that tell frames apart and,
        last, that of the points, such as ``"video,frame,landmark"``; several of points
        with ``+``. One that is not in the table is counted. By default they are found.

    Returns
    -------
    LandmarkTable
        The landmarks, and the other columns.

    Raises
    ------
    ValueError
        If there is no set of landmark columns or more than one, if the points are
        probably of several individuals, if a point has only one of two coordinates, or
        if a cell is neither a finite number nor empty.

    Examples
    --------
    >>> import pandas as pd
    >>> from isa_nrsfm.io import landmark_table
    >>> frame = pd.DataFrame({"id": ["a", "b"], "x1": [1, 0], "x2": [3, 0],
    ...                       "y2": [4, 5], "y1": [2, 0]})
    >>> points, other = landmark_table(frame, columns="x#,y#", missing=0)
    >>> points
        x1   y1   x2   y2
    0  1.0  2.0  3.0  4.0
    1  NaN  NaN  0.0  5.0
    >>> list(other)
    ['id']
    """
    if not isinstance(frame, pd.DataFrame):
        raise ValueError(
            f"a pandas DataFrame is needed; got {type(frame).__name__} "
            "(polars tables have a method to_pandas)"
        )
    frame = individuals_as_rows(frame, individuals)
    frame, columns = _landmark_columns.frames_of(frame, columns, row_per_point)
    names = _landmark_columns.find_landmark_columns(frame.columns, columns).interleaved
    refuse_same_names([str(name) for name in frame.columns])
    values = tracks_in(frame, names, missing).reshape(len(frame), len(names))
    points = pd.DataFrame(values, frame.index, [name.strip() for name in names])
    return LandmarkTable(points, frame.drop(columns=names))


def individuals_as_rows(frame: "pd.DataFrame", individuals: Given) -> "pd.DataFrame":
    """Return a table with a row for each individual of each row, if there are any."""
    if individuals is None:
        return frame
    columns_of = _column_names.columns_of_individuals(frame.columns, individuals)
    frame = frame.reset_index(drop=True)
    common = frame.drop(columns=[*chain(*columns_of.values())])
    if "individual" in common:
        raise ValueError(
            "the table has a column 'individual' already, which individuals would "
            "replace: rename it"
        )
    if others := [name for name in common if parse_coordinate(name) is not None]:
        warn_caller(
            f"{len(others)} columns of coordinates are not those of all individuals "
            f"(first: {others[0]!r}): they are left out"
        )
        common = common.drop(columns=others)
    # Other numbers or names of images say more than those of rows.
    image = re.compile(rf"\s*(?:{FRAME}|{IMAGE_NAME})\s*", re.IGNORECASE)
    if not any(image.fullmatch(str(name)) for name in common):
        common.insert(0, "frame", common.index)
    parts = [
        common.assign(individual=name).join(frame[[*columns]].rename(columns=columns))
        for name, columns in columns_of.items()
    ]
    return pd.concat(parts).sort_index(kind="stable").reset_index(drop=True)


def tracks_in(
    frame: "pd.DataFrame", names: Sequence[str], missing: Missing = None
) -> NDArray[np.float64]:
    """Return the points (n_frames, n_points, 2) in columns x0, y0, x1, y1, ....

    Those with one of the numbers in `missing` as x and y become NaN.
    """
    frame = with_points(frame, names)
    values = np.stack([_as_numbers(frame[name]) for name in names], axis=1)
    tracks = values.reshape(len(frame), len(names) // 2, 2)
    codes = np.atleast_1d([] if missing is None else missing)
    if codes.dtype.kind not in "iuf" or not np.isfinite(codes).all():
        raise ValueError(f"missing must be None or finite numbers; got {missing!r}")
    for code in codes.astype(float):
        tracks[(tracks == code).all(axis=2)] = np.nan
    return tracks


def read_named_columns(
    path: Path, columns: str | None = None, missing: Missing = None, **shape: Given
) -> Landmarks:
    """Read a table whose landmark columns are recognised by their names."""
    table = parse_table(path)
    points, other = landmark_table(table, columns=columns, missing=missing, **shape)
    tracks, titles = points.to_numpy().reshape(len(points), -1, 2), list(points)
    names = _column_names.point_names(titles[::2])
    return with_confidences(tracks, names, titles, other, "table")


def with_confidences(
    tracks: NDArray, names: Sequence[str], columns: list[str], other: Any, format: str
) -> Landmarks:
    """Return the landmarks of a table with the confidences among its other columns."""
    sure = confidences_in(other, columns[::2], columns[1::2])
    known: dict[str, Any] = {"columns": columns, "format": format}
    known["confidence"] = None if sure.empty else sure
    return assemble(tracks, names, other.drop(columns=sure.columns), **known)


def confidences_in(
    frame: "pd.DataFrame", x: Sequence[str], y: Sequence[str], strict: bool = False
) -> "pd.DataFrame":
    """Return the confidences (n_frames, n_points) of points of x and y columns, if any.

    No columns if there are none, or, unless strict, if they are no confidences.
    """
    names = _landmark_columns.confidence_columns(frame, x, y)
    passed_over = () if strict else (ValueError,)
    with contextlib.suppress(*passed_over):
        with warnings.catch_warnings(action="ignore"):  # of commas, as in coordinates
            frame = with_points(frame, names)
        texts = [name for name in names if frame[name].dtype.kind not in "iuf"]
        flags = {n: frame[n].map(lambda cell: _SEEN.get(cell, cell)) for n in texts}
        found = {name: _as_numbers(flags.get(name, frame[name])) for name in names}
        values = pd.DataFrame(found, frame.index)
        # p may be a pressure, and v a velocity; in COCO it is 0, 1 or 2.
        is_letter = bool(names) and len(names[0].strip()) == len(x[0].strip())
        numbers = values.to_numpy()[values.notna()]
        if is_letter and not ((numbers == numbers.clip(0, 1)) | (numbers == 2)).all():
            raise ValueError(
                f"{names[0]}, ... are no confidences: they are not all from 0 to 1"
            )
        # MediaPipe writes zeros for faces and hands.
        if names and not numbers.any():
            empty = "0" if len(numbers) else "empty"
            raise ValueError(f"{names[0]}, ... are no confidences: all are {empty}")
        return values
    return frame[[]]


def table_suffix(path: str | os.PathLike[str]) -> str:
    """Return the suffix of a file, or raise if it is not that of a table."""
    suffix = Path(path).suffix
    if suffix.lower() not in TABLE_SUFFIXES:
        raise ValueError(
            f"{path}: a table is a .csv, .tsv, .txt or .parquet file; got {suffix!r}"
        )
    return suffix.lower()


def first_lines(path: Path, n_lines: int) -> list[str]:
    """Return the first lines of a text file, while they are UTF-8 and not too long."""
    lines: list[str] = []
    with contextlib.suppress(UnicodeDecodeError), path.open("rb") as file:
        for _ in range(n_lines):
            line = file.readline(_LONGEST_LINE)
            text = line.decode("utf-8" if lines else "utf-8-sig")
            if not text or (not text.endswith(("\n", "\r")) and len(line) > 2**19):
                break
            lines.append(text.rstrip("\r\n"))
    return lines


def separator_of(path: Path) -> str:
    """Return what separates the cells of a text: the usual sign, or a better one.

    The header and the first row have as many cells, and the most; numbers and names may
    have a comma each.
    """
    suffix, lines = path.suffix.lower(), first_lines(path, 2)
    usual = SEPARATORS.get(suffix, ",")

    def better(sign: str) -> tuple[bool, float]:
        """Return whether rows have as many cells, and separators, fewer for commas."""
        lengths = [len(row) for row in csv.reader(lines, delimiter=sign) if row]
        weight = {",": 2, " ": 4}.get(sign, 1)
        return 1 < min(lengths) == max(lengths), (lengths[0] - 1) / weight

    with contextlib.suppress(csv.Error, ValueError):
        return max((usual, *";\t,|", *" " * (suffix == ".txt")), key=better)
    return usual


def header_rows(path: Path, n_rows: int) -> list[list[str]]:
    """Return the cells of the first rows of a file; fewer if it is no csv file."""
    with contextlib.suppress(csv.Error):
        lines = first_lines(path, n_rows)
        return list(csv.reader(lines, delimiter=separator_of(path), strict=True))
    return []


def header_names(path: Path) -> list[str]:
    """Return the column names of a table without blanks around them."""
    if path.suffix.lower() == ".parquet":
        pyarrow = import_optional("pyarrow", extra="parquet")
        parquet = import_optional("pyarrow.parquet", extra="parquet")
        with contextlib.suppress(OSError, pyarrow.ArrowException):
            return [name.strip() for name in parquet.read_schema(path).names]
        return []
    return [name.strip() for row in header_rows(path, 1) for name in row]


def checked_rows(path: Path, separator: str, n_header: int = 1) -> Iterator[list[str]]:
    """Yield the first five non-empty rows of a text file, and a few others.

    Raise if one has not as many cells as the first, if none follows the header, or at a
    null character, as files in UTF-16 without a mark have. pandas would pad or cut the
    lines.
    """
    n_lines, n_rows, n_columns = 0, 0, 0
    if separator != SEPARATORS.get(path.suffix.lower()) and path.suffix != ".txt":
        warn_caller(f"the cells of {path.name} end with {separator!r}")
    with path.open(encoding="utf-8-sig", newline="") as file:

        def unusual(line: str) -> bool:
            """Count a line; return whether cells have to be counted one by one."""
            nonlocal n_lines
            n_lines += 1
            full = line.count(separator) + 1 == n_columns
            # Headers of DeepLabCut have four rows.
            return n_rows < 5 or not full or '"' in line or "\0" in line

        for row in csv.reader(filter(unusual, file), delimiter=separator):
            if "\0" in "".join(row):
                line = f"line {n_lines} has a null character"
                raise ValueError(f"its text is not in UTF-8: {line}")
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
                    f"line {n_lines} has {len(row)} values, but the header has "
                    f"{n_columns} names: {advice}"
                )
            n_rows += 1
            yield row
    if 0 < n_rows <= n_header:
        raise ValueError("it has a header but no rows")
    _refuse_cut_number(path, separator)


def _refuse_cut_number(path: Path, separator: str) -> None:
    """Raise if the last number of a text was cut off: it ends before all others do.

    Numbers of a program have as many digits after the point or exponent, or nearly so.
    """
    with path.open("rb") as file:
        file.seek(max(path.stat().st_size - _TAIL, 0))
        lines = file.read().decode("utf-8", "replace").splitlines(True)[4:]  # header
    if len(lines) < 11 or lines[-1].endswith(("\n", "\r")):
        return
    cells = [line.strip().rpartition(separator)[2] for line in lines]
    parts = [re.split(r"[.eE][+-]?", cell) for cell in cells]
    *others, last = [100 * len(p) + len(p[-1]) * (len(p) > 1) for p in parts]
    fewest = min(others)
    equal = len(others) > 19 and fewest == max(others)
    if last < fewest - (not equal):
        raise ValueError(
            f"it ends in the middle of a number, {cells[-1]!r} in its last line: the "
            "file is truncated, or is still being written. If it is complete, end the "
            "line with a line break"
        )


def read_parquet(path: Path) -> "pd.DataFrame":
    """Read a parquet file."""
    import_optional("pyarrow", extra="parquet")
    path.open("rb").close()  # opening errors as for text files
    if (frame := pd.read_parquet(path)).empty:
        raise ValueError("it has no rows")
    return frame.reset_index(drop=not any(frame.index.names))


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
    names = header_names(path) if names is None else names
    refuse_same_names(names)
    if isinstance(leave_out, re.Pattern):
        leave_out = {name for name in names if leave_out.fullmatch(name)}
    if path.suffix.lower() == ".parquet":
        frame = read_parquet(path).rename(columns=lambda name: str(name).strip())
        frame = frame.drop(columns=[name for name in frame if name in leave_out])
    else:
        separator = separator_of(path)
        for _ in checked_rows(path, separator, n_header):
            pass
        lines: dict[str, Any] = {"sep": separator, "names": names, "header": None}
        lines |= {"skiprows": n_header, "skipinitialspace": True}
        kept = [name for name in names if name not in leave_out]
        types = {name: str for name in names if name not in numbers}
        frame = pd.read_csv(path, usecols=kept, dtype=types, **lines, **_CSV)
    others = [name for name in frame if name not in {*numbers, *text}]
    frame = with_points(frame, numbers, others)
    found: dict[str, Any] = {name: _numbers_if_all(frame[name]) for name in others}
    texts = [name for name in numbers if frame[name].dtype.kind not in "iuf"]
    return frame.assign(**found, **{name: _as_numbers(frame[name]) for name in texts})


def _numbers_if_all(column: "pd.Series") -> "pd.Series":
    """Return a column of texts as numbers, if all are and none is a code."""
    if pd.api.types.infer_dtype(column) not in ("string", "empty"):
        return column
    column = column.replace("", None)
    numbers = pd.to_numeric(column, errors="coerce")
    is_number = numbers.notna().equals(column.notna())
    whole = is_number and (numbers.dropna() % 1 == 0).all()
    # Codes are whole numbers with zeros before them.
    if whole and column.str.match(r"\s*[+-]?0\d+\s*$").any():
        return column
    return numbers if is_number else column


def with_points(
    frame: "pd.DataFrame", names: Collection[str], others: Iterable[str] = ()
) -> "pd.DataFrame":
    """Return a table with the numbers in some columns written without commas.

    Either all commas are decimal, or all are between thousands; raise if both can be.
    Other columns are written so where all their cells are such numbers.
    """
    texts = frame[[*names]].select_dtypes(["object", "string"])
    cells = {*map(str, texts.to_numpy(object).ravel())}
    commas = [cell for cell in cells if "," in cell]
    decimal = {*filter(_DECIMAL_COMMA.fullmatch, commas)}
    thousands = {*filter(_THOUSANDS.fullmatch, commas)}
    if not (decimal or thousands):
        return frame
    fractions = frame[[*names]].select_dtypes("float") % 1
    has_points = fractions.any(axis=None) or any("." in c for c in cells - thousands)
    is_decimal = decimal >= thousands and not has_points
    is_thousands = thousands >= decimal
    first = max(decimal | thousands).strip()
    if is_decimal and is_thousands:
        raise ValueError(
            f"{first!r} can be {first.replace(',', '.')} or {first.replace(',', '')}, "
            "and no other number decides it: write numbers like 1234.5. In pandas, "
            "read the file with pd.read_csv(..., decimal=',') if the commas are "
            "decimal, otherwise with pd.read_csv(..., thousands=','), and save it with "
            "to_csv"
        )
    if not (is_decimal or is_thousands):
        return frame
    expression, sign = (_DECIMAL_COMMA, ".") if is_decimal else (_THOUSANDS, "")
    warn_caller(
        f"numbers have {'decimal commas' if sign else 'commas between thousands'}: "
        f"{first} is read as {first.replace(',', sign)}"
    )

    def written(cell: Any) -> Any:
        """Return a cell without its comma."""
        is_number = isinstance(cell, str) and expression.fullmatch(cell)
        return cell.replace(",", sign) if is_number else cell

    found = {name: frame[name].map(written) for name in texts}
    for name in others:
        column = frame[name].map(written)
        if pd.to_numeric(column, errors="coerce").notna().equals(column.notna()):
            found[name] = column
    return frame.assign(**found)


def _read_text(path: Path, separator: str) -> "pd.DataFrame":
    """Read a file of separated values."""
    rows = checked_rows(path, separator)
    if (header := next(rows, None)) is None:
        raise ValueError("it is empty; a first line with column names is needed")
    if len(header) == 1:
        _refuse_one_column(path, separator, header[0])
    second = [cell.strip().lower() for cell in next(rows)]
    n_header, n_second = (
        pd.to_numeric(pd.Series(row).replace("", 0), errors="coerce").notna().sum()
        for row in (header, second)
    )
    # Numbers may be names, of columns whose cells hold points, or beside coordinates.
    has_numbers = 2 * n_header > len(header) and not any(map(parse_coordinate, header))
    if n_second and (n_header == len(header) or (n_header >= 14 and has_numbers)):
        raise ValueError(
            "its first line has numbers; a first line with column names is needed, "
            "such as x0, y0, x1, y1"
        )
    if second.count("x") == second.count("y") > 1:
        index = "" if second[0] in ("x", "y") else ", index_col=0"
        decimal = ", decimal=','" * any("," in cell for cell in next(rows, []))
        way = (
            f". In pandas: table = pd.read_csv({path.name!r}, header=[0, 1]{index}, "
            f"sep={separator!r}{decimal}), "
            "and table.columns = ['_'.join(name) for name in table.columns]"
        )
        raise ValueError(
            "its header has two lines; one line of names such as nose_x, nose_y is "
            "needed" + way * ("" not in header[1:])
        )
    for _ in rows:  # checks them
        pass
    refuse_same_names(header)
    header[0] = header[0].removeprefix("# ")  # of numpy.savetxt
    coordinates = [name for name in header if parse_coordinate(name) is not None]
    read = partial(pd.read_csv, path, sep=separator, keep_default_na=False, **_CSV)
    with contextlib.suppress(ValueError):  # without texts, if all cells are numbers
        missing = {name: [*_MISSING, "NaN", "NA"] for name in coordinates}
        types = {name: float if name in missing else str for name in header}
        frame = read(names=header, header=0, dtype=types, na_values=missing)
        if not np.isinf(frame[coordinates]).any(axis=None):
            return frame
    frame = read(dtype=str).set_axis(header, axis=1)
    frame = with_points(frame, coordinates)
    for name in coordinates:
        with contextlib.suppress(ValueError):
            frame[name] = _as_numbers(frame[name])
    return frame


def _refuse_one_column(path: Path, separator: str, line: str) -> None:
    """Raise if the first line of a file is one cell, but has other separators."""
    if separator in line:
        raise ValueError("each line is in quotation marks: remove them")
    if 0 < line.count(" ") == first_lines(path, 2)[-1].count(" "):
        raise ValueError(
            f"its columns are separated by ' '; {separator!r} is needed. In pandas: "
            f"table = pd.read_csv({path.name!r}, sep=r'\\s+', header=None, dtype=str), "
            "and table.to_csv('new.csv', header=False, index=False)"
        )


def _as_numbers(column: "pd.Series") -> NDArray[np.float64]:
    """Return a landmark column as finite numbers and NaN."""
    types, name = pd.api.types, column.name
    if types.is_bool_dtype(column) or types.is_complex_dtype(column):
        raise ValueError(f"column {name!r} should hold numbers; got {column.dtype}")
    numbers = column
    if not types.is_numeric_dtype(column):
        text = column
        if not types.is_string_dtype(column):
            text = column.astype(object).where(column.notna(), "").astype(str)
        numbers = pd.to_numeric(text, errors="coerce")
        bad = text[numbers.isna()].dropna()
        bad = bad[~bad.str.strip().str.lower().isin(_MISSING)]
        if len(bad):
            raise ValueError(
                f"column {name!r} should hold numbers, but in row {bad.index[0]} "
                f"(counted from 0) it has {bad.iloc[0]!r}. Write numbers like 1234.5, "
                "leave the cells of missing points empty, and delete rows of units, "
                "means or repeated names"
            )
    values = numbers.to_numpy(dtype=np.float64, na_value=np.nan)
    if (infinite := np.isinf(values)).any():
        row = column.index[infinite.argmax()]
        raise ValueError(f"column {name!r} is infinite in row {row} (counted from 0)")
    return values
