"""Arrays in NumPy's format: many in a file, and one of the size of its file."""

import io
import math
from collections.abc import Mapping
from typing import IO
from zipfile import ZipFile

import numpy as np
from numpy.typing import NDArray


def write_arrays(file: IO[bytes], arrays: Mapping[str, NDArray]) -> None:
    """Write arrays as `numpy.savez`, which in numpy 2.0 leaves a broken file open."""
    with ZipFile(file, "w") as archive:
        for name, array in arrays.items():
            with archive.open(f"{name}.npy", "w", force_zip64=True) as entry:
                np.lib.format.write_array(entry, array, allow_pickle=False)


def array_in(content: bytes) -> NDArray:
    """Return the array of numbers in bytes of NumPy's format.

    NumPy allocates any shape that the header has. Raise an error if the bytes hold
    objects, or if the number of entries differs from the header.
    """
    stored = io.BytesIO(content)
    version = np.lib.format.read_magic(stored)
    if version == (1, 0):
        shape, _, dtype = np.lib.format.read_array_header_1_0(stored)
    else:
        shape, _, dtype = np.lib.format.read_array_header_2_0(stored)
    found, expected = len(content) - stored.tell(), math.prod(shape) * dtype.itemsize
    if dtype.hasobject or found != expected:
        raise ValueError(
            f"an array of shape {shape} and type {dtype} should have {expected} bytes; "
            f"got {found}"
        )
    stored.seek(0)
    return np.lib.format.read_array(stored, allow_pickle=False)
