"""Look into HDF5 files, and read the tables that pandas has stored in them.

pandas itself reads them by PyTables, which unpickles whatever the file holds. Here only
numbers, texts, tuples and lists are. The layouts are those of `DataFrame.to_hdf` with
``format="table"`` and ``format="fixed"``.
"""

import io
import pickle
from pathlib import Path
from typing import Any, NoReturn

import numpy as np
from numpy.typing import NDArray

from isa_nrsfm._compat.damaged_files import reading
from isa_nrsfm._compat.optional import import_optional

_SIGNATURE = b"\x89HDF\r\n\x1a\n"
# zlib packs at most so many bytes into one (zlib.net, zlib technical details).
LARGEST_RATIO = 1032


def is_hdf5(path: Path) -> bool:
    """Return whether a file begins as HDF5 files do."""
    with path.open("rb") as file:
        return file.read(len(_SIGNATURE)) == _SIGNATURE


def root_groups(path: Path) -> set[str]:
    """Return the names at the root of an HDF5 file, or raise where it is damaged."""
    h5py = import_optional("h5py", extra="h5")
    with reading(path, "HDF5"), h5py.File(path, "r") as file:
        return set(file)


def content_of(group: Any, name: str) -> Any:
    """Return the content of a dataset: an array, a number or a text.

    Raise if there is none, or if it claims to hold more than the file can: HDF5 has no
    data of the parts of an array that nobody wrote.
    """
    dataset = group.get(name)
    if dataset is None or not hasattr(dataset, "nbytes"):
        raise ValueError(f"it has no dataset {name}")
    stored = dataset.id.get_storage_size()
    if dataset.nbytes > LARGEST_RATIO * stored:
        raise ValueError(
            f"the dataset {name} of shape {dataset.shape} would need {dataset.nbytes} "
            f"bytes; the file has {stored}"
        )
    return dataset[()]


def numbers_of(group: Any, name: str) -> NDArray[np.float64]:
    """Return the real numbers that a dataset holds, or raise a ValueError."""
    content = content_of(group, name)
    if not isinstance(content, np.ndarray) or content.dtype.kind not in "fiu":
        got = getattr(content, "dtype", type(content).__name__)
        raise ValueError(f"the dataset {name} should have real numbers; got {got}")
    return content.astype(np.float64, copy=False)


Columns = list[tuple[str, ...]]


def read_stored_frame(path: Path, key: str) -> tuple[NDArray, Columns, list[Any]]:
    """Read the columns of numbers of a table that pandas has stored in an HDF5 file.

    Returns numbers (n_rows, n_columns), levels of the columns, and labels of the rows.
    Damaged files lead to errors of h5py and pickle.
    """
    h5py = import_optional("h5py", extra="h5")
    with h5py.File(path, "r") as file:
        if key not in file:
            raise ValueError(f"it has no group {key}")
        group = file[key]
        kind = _text(group.attrs.get("pandas_type", ""))
        if kind not in ("frame_table", "frame"):
            raise ValueError(f"{key} is no table of pandas")
        read = _table_blocks if kind == "frame_table" else _fixed_blocks
        blocks, labels = read(group)
    for values, columns in blocks:
        if values.shape != (len(labels), len(columns)):
            raise ValueError(
                f"a block of {len(labels)} rows and {len(columns)} columns has the "
                f"shape {values.shape}"
            )
    arrays = [np.empty((len(labels), 0)), *(values for values, _ in blocks)]
    columns = [column for _, columns in blocks for column in columns]
    return np.concatenate(arrays, axis=1).astype(np.float64), columns, labels


def _table_blocks(group: Any) -> tuple[list[tuple[NDArray, Columns]], list[Any]]:
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


def _fixed_blocks(group: Any) -> tuple[list[tuple[NDArray, Columns]], list[Any]]:
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


def _levels(group: Any, name: str) -> Columns:
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
