"""Tables in files that are read block by block, as they are needed."""

import os
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from isa_nrsfm._compat.files import reading
from isa_nrsfm._compat.lazy import import_optional
from isa_nrsfm._compat.texts import by_number, first_items
from isa_nrsfm._tables import StoredTable, read_rows

SUFFIXES = (".npy", ".parquet")
PARQUET = "a parquet file"


def open_table(path: str | os.PathLike[str]) -> "StoredTable | NDArray":
    """
    Open a table that need not fit into memory.

    Parameters
    ----------
    path : str or path-like
        A ``.npy`` file with an array (n_frames, 2 * n_points), a ``.parquet`` file with
        these columns and no others, or a folder of files of one of these kinds, which
        are put below each other in the order of their names, numbers by size (part2
        before part10). Other files in the folder are refused, but for hidden ones.

    Returns
    -------
    StoredTable or memmap
        The table; the memory map of a single ``.npy`` file.

    Raises
    ------
    FileNotFoundError
        If there is no such file, or none in the folder.
    ValueError
        If files are of another kind, are damaged, do not fit together, or do not hold a
        table of numbers. The file is named, also where the damage shows only when the
        table is used.

    Examples
    --------
    >>> from pathlib import Path
    >>> from tempfile import TemporaryDirectory
    >>> import numpy as np
    >>> from isa_nrsfm.io import open_table
    >>> with TemporaryDirectory() as folder:
    ...     np.save(Path(folder, "part0.npy"), np.zeros((30, 136)))
    ...     np.save(Path(folder, "part1.npy"), np.zeros((20, 136)))
    ...     open_table(folder).shape
    (50, 136)
    """
    path = Path(path)
    files = [path]
    if path.is_dir():
        visible = (p for p in path.iterdir() if not p.name.startswith((".", "_")))
        files = sorted(visible, key=by_number)
    if not files:
        raise FileNotFoundError(f"{path} has no {' or '.join(SUFFIXES)} files")
    kinds = {file.suffix for file in files}
    if len(kinds) > 1 or not kinds <= set(SUFFIXES):
        raise ValueError(
            f"{path} must be or hold files of one kind, {' or '.join(SUFFIXES)}; got "
            f"{first_items(file.name for file in files)}"
        )
    if kinds == {".parquet"}:
        return _open_parquet(files)
    arrays = [_mapped(file) for file in files]
    _same_shape(files, [array.shape[1] for array in arrays], "columns")
    if len(files) == 1:
        return arrays[0]
    _same_shape(files, [array.dtype for array in arrays], "numbers of type")
    parts = [
        (len(each), lambda first, last, each=each: read_rows(each, slice(first, last)))
        for each in arrays
    ]
    return StoredTable(parts, arrays[0].shape[1], arrays[0].dtype)


def _mapped(file: Path) -> NDArray:
    """Return the memory map of an array."""
    with reading(file, "an array of numbers in NumPy's format"):
        array = np.lib.format.open_memmap(file, mode="r")
    if array.ndim != 2 or array.dtype.kind not in "fiu":
        raise ValueError(
            f"{file} must hold a table of real numbers, (n_frames, 2 * n_points); got "
            f"an array of shape {array.shape} and type {array.dtype}"
        )
    return array


def _same_shape(files: list[Path], values: list[Any], what: str) -> None:
    """Refuse files that do not fit together."""
    for file, value in zip(files, values, strict=True):
        if value != values[0]:
            raise ValueError(
                f"all files must have the same {what}: {files[0].name} has "
                f"{values[0]}, {file.name} {value}"
            )


def _open_parquet(files: list[Path]) -> StoredTable:
    """Return the table that parquet files hold."""
    parquet = import_optional("pyarrow.parquet", extra="parquet")
    types = import_optional("pyarrow.types", extra="parquet")
    opened, schemas, kinds = [], [], set()
    for file in files:
        with reading(file, PARQUET):
            opened.append(parquet.ParquetFile(file))
            schemas.append(opened[-1].schema_arrow)
        for field in schemas[-1]:
            if not (types.is_floating(field.type) or types.is_integer(field.type)):
                raise ValueError(
                    f"{file} must hold columns of numbers only; column {field.name!r} "
                    f"is of type {field.type}"
                )
            kinds.add(str(field.type))
    names = [schema.names for schema in schemas]
    _same_shape(files, names, "columns")
    dtype = np.dtype(np.float32 if kinds == {"float"} else np.float64)
    parts = [
        (table.metadata.num_rows, _row_groups(file, table, dtype))
        for file, table in zip(files, opened, strict=True)
    ]
    return StoredTable(parts, len(names[0]), dtype, np.array(names[0], dtype=object))


def _row_groups(file: Path, table: Any, dtype: Any) -> Callable[[int, int], NDArray]:
    """Return a function that reads rows of a parquet file, by groups of rows."""
    groups = map(table.metadata.row_group, range(table.metadata.num_row_groups))
    sizes = [group.num_rows for group in groups]
    ends = np.cumsum(sizes, dtype=int)

    def read(first: int, last: int) -> NDArray:
        groups = np.flatnonzero((ends > first) & (ends - sizes < last))
        begin = ends[groups[0]] - sizes[groups[0]]
        with reading(file, PARQUET):
            read = table.read_row_groups(groups.tolist())
        found = read.slice(first - begin, last - first)
        columns = [np.asarray(column, dtype=dtype) for column in found.columns]
        return np.stack(columns, axis=1)

    return read
