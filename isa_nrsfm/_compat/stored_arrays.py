"""Arrays in NumPy's format, checked against the size of their file."""

import io
import math

import numpy as np
from numpy.typing import NDArray


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
