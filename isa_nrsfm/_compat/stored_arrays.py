"""Arrays in NumPy's format: in one file, in bytes, and each in its own file."""

import contextlib
import io
import math
import os
import shutil
import uuid
from collections.abc import Callable, Iterator, Mapping
from datetime import UTC, datetime
from pathlib import Path
from typing import IO
from zipfile import ZIP_STORED, ZipFile

import numpy as np
from numpy.typing import NDArray

from isa_nrsfm._compat.files import folder_for_writing, whole_file

Keep = Callable[[Mapping[str, NDArray]], dict[str, NDArray]]


def write_arrays(file: IO[bytes], arrays: Mapping[str, NDArray]) -> None:
    """Write arrays as `numpy.savez`, which in numpy 2.0 leaves a broken file open."""
    with ZipFile(file, "w") as archive:
        for name, array in arrays.items():
            with archive.open(f"{name}.npy", "w", force_zip64=True) as entry:
                np.lib.format.write_array(entry, array, allow_pickle=False)


def read_arrays(path: str | os.PathLike[str]) -> dict[str, NDArray]:
    """Return the arrays of a file that `write_arrays` or `numpy.savez` has written.

    Compressed arrays are refused: a small file can hold very large ones.
    """
    with ZipFile(path) as archive:
        found = archive.infolist()
        if any(member.compress_type != ZIP_STORED for member in found):
            raise ValueError(
                "its contents are compressed. Load them, and save them with numpy.savez"
            )
        size = Path(path).stat().st_size
        if sum(member.file_size for member in found) > size:
            raise ValueError(f"its contents need more than the {size} bytes it has")
        return {
            member.filename.removesuffix(".npy"): array_in(archive.read(member))
            for member in found
        }


def array_in(content: bytes) -> NDArray:
    """Return the array of numbers in bytes of NumPy's format.

    NumPy allocates any shape that the header has. Raise an error if the bytes hold
    objects, or if the number of entries differs from the header.
    """
    stored = io.BytesIO(content)
    if np.lib.format.read_magic(stored) == (1, 0):
        shape, _, dtype = np.lib.format.read_array_header_1_0(stored)
    else:
        shape, _, dtype = np.lib.format.read_array_header_2_0(stored)
    if dtype.hasobject:
        raise ValueError(
            f"an array of shape {shape} holds Python objects, which are not read: save "
            "it with a type of numbers, such as array.astype(float)"
        )
    n_bytes, expected = len(content) - stored.tell(), math.prod(shape) * dtype.itemsize
    if n_bytes != expected:
        raise ValueError(
            f"an array of shape {shape} and type {dtype} should have {expected} bytes; "
            f"got {n_bytes}"
        )
    stored.seek(0)
    return np.lib.format.read_array(stored, allow_pickle=False)


@contextlib.contextmanager
def kept_arrays(path: bool | str | os.PathLike[str]) -> Iterator[Keep]:
    """Keep arrays in files of a folder, and remove the files if the block fails.

    Yields a function that maps arrays by name to memory maps, or to themselves if the
    path is True or False. Each block writes to a new folder: no other process writes
    to mapped files.
    """
    if isinstance(path, bool | np.bool):
        yield dict
        return
    if not os.fspath(path):
        raise ValueError(
            "keep_frames should be True, False or the path of a folder; got ''"
        )
    folder = Path(path)
    name = f"fit-{datetime.now(UTC):%Y%m%dT%H%M%SZ}-{uuid.uuid4().hex[:12]}"

    def keep(arrays: Mapping[str, NDArray]) -> dict[str, NDArray]:
        """Return memory maps of arrays."""
        # Another fit that failed may have removed the empty folder.
        (folder / name).mkdir(parents=True)
        maps = {}
        for part, array in arrays.items():
            file = folder / name / f"{part}.npy"
            with whole_file(file) as stream:
                np.save(stream, array)
            maps[part] = np.load(file, mmap_mode="r")
        return maps

    with folder_for_writing(folder):
        try:
            yield keep
        except BaseException:
            shutil.rmtree(folder / name, ignore_errors=True)
            raise
