"""Read the tables that pandas has stored in HDF5 files, without running code.

pandas itself reads them by PyTables, which unpickles whatever the file holds. Here only
numbers, texts, tuples and lists are. The layouts are those of `DataFrame.to_hdf` with
``format="table"`` and ``format="fixed"``.
"""

import io
import pickle
from pathlib import Path
from typing import Any, NamedTuple, NoReturn

import numpy as np
from numpy.typing import NDArray

from isa_nrsfm._compat.optional import import_optional
from isa_nrsfm.io._hdf5 import content_of


class StoredFrame(NamedTuple):
    """Numbers (n_rows, n_columns), the levels of their columns, labels of the rows."""

    values: NDArray[np.float64]
    columns: list[tuple[str, ...]]
    labels: list[Any]


def read_stored_frame(path: Path, key: str) -> StoredFrame:
    """
    Read the columns of numbers of a table that pandas has stored in an HDF5 file.

    Damaged files lead to errors of h5py and pickle.
    """
    h5py = import_optional("h5py", extra="h5")
    with h5py.File(path, "r") as file:
        if key not in file:
            raise ValueError(f"it has no group {key}")
        group = file[key]
        kind = _text(group.attrs.get("pandas_type", ""))
        if kind == "frame_table":
            return _of_blocks(*_table_blocks(group))
        if kind == "frame":
            return _of_blocks(*_fixed_blocks(group))
        raise ValueError(f"{key} is no table of pandas")


_Block = tuple[NDArray, list[tuple[str, ...]]]


def _table_blocks(group: Any) -> tuple[list[_Block], list[Any]]:
    """Return the blocks of format="table", one field of the rows each."""
    rows, table = content_of(group, "table"), group["table"]
    blocks = []
    for name in rows.dtype.names or ():
        is_number = rows.dtype[name].base.kind in "fiu"
        if name.startswith("values_block_") and is_number:
            labels = _plain(table.attrs[f"{name}_kind"])
            columns = [tuple(map(str, label)) for label in labels]
            blocks.append((rows[name].reshape(len(rows), -1), columns))
    return blocks, [_label(label) for label in rows["index"]]


def _fixed_blocks(group: Any) -> tuple[list[_Block], list[Any]]:
    """Return the blocks of format="fixed", an array each."""
    blocks = []
    for i in range(int(group.attrs["nblocks"])):
        name = f"block{i}_values"
        values = content_of(group, name)
        if values.dtype.kind in "fiu":
            if not group[name].attrs.get("transposed", False):
                values = values.T
            blocks.append((values, _levels(group, f"block{i}_items")))
    if _text(group.attrs["axis1_variety"]) == "multi":
        return blocks, ["/".join(label) for label in _levels(group, "axis1")]
    return blocks, [_label(label) for label in content_of(group, "axis1")]


def _levels(group: Any, name: str) -> list[tuple[str, ...]]:
    """Return labels of several levels."""
    if _text(group.attrs[f"{name}_variety"]) != "multi":
        return [(_text(label),) for label in content_of(group, name)]
    parts = []
    for i in range(int(group.attrs[f"{name}_nlevels"])):
        texts = [_text(text) for text in content_of(group, f"{name}_level{i}")]
        codes = content_of(group, f"{name}_label{i}")
        if np.any((codes < 0) | (codes >= len(texts))):
            raise ValueError(f"{name} has labels that are not among its texts")
        parts.append([texts[code] for code in codes])
    return list(zip(*parts, strict=True))


def _of_blocks(blocks: list[_Block], labels: list[Any]) -> StoredFrame:
    """Put blocks of columns beside each other."""
    for values, columns in blocks:
        if values.shape != (len(labels), len(columns)):
            raise ValueError(
                f"a block of {len(labels)} rows and {len(columns)} columns has the "
                f"shape {values.shape}"
            )
    arrays = [np.empty((len(labels), 0)), *(values for values, _ in blocks)]
    return StoredFrame(
        np.concatenate(arrays, axis=1).astype(np.float64),
        [column for _, columns in blocks for column in columns],
        labels,
    )


def _label(label: Any) -> Any:
    """Return the label of a row, a number or a text."""
    return _text(label) if isinstance(label, bytes) else label.item()


def _text(value: Any) -> str:
    """Return a text that HDF5 holds as bytes or as a text."""
    return value.decode("utf-8") if isinstance(value, bytes) else str(value)


class _PlainUnpickler(pickle.Unpickler):
    """Unpickles numbers, texts, tuples, lists and dictionaries, and nothing else."""

    def find_class(self, module_name: str, global_name: str, /) -> NoReturn:
        """Refuse everything that has to be imported."""
        raise pickle.UnpicklingError(f"{module_name}.{global_name} is not allowed")


def _plain(pickled: Any) -> Any:
    """Return the plain object that was pickled."""
    return _PlainUnpickler(io.BytesIO(bytes(pickled)), encoding="utf-8").load()
