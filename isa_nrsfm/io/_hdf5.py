"""Look into HDF5 files."""

from pathlib import Path
from typing import Any

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
