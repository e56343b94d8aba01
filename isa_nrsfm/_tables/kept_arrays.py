"""Arrays of a fit in files of its own."""

import contextlib
import os
import shutil
import uuid
from collections.abc import Callable, Iterator, Mapping
from datetime import UTC, datetime
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from isa_nrsfm._compat.whole_files import folder_for_writing, whole_file

Keep = Callable[[Mapping[str, NDArray]], dict[str, NDArray]]


@contextlib.contextmanager
def kept_arrays(path: str | os.PathLike[str] | None) -> Iterator[Keep]:
    """Keep arrays in files of a folder, and remove the files if the block fails.

    Yields a function that maps arrays by name to memory maps, or to themselves if the
    path is None. Each block writes to a new folder: no other process writes to mapped
    files.
    """
    if path is None:
        yield dict
        return
    if not os.fspath(path):
        raise ValueError("frames_folder should be None or the path of a folder; got ''")
    folder = Path(path)
    name = f"fit-{datetime.now(UTC):%Y%m%dT%H%M%SZ}-{uuid.uuid4().hex[:12]}"

    def keep(arrays: Mapping[str, NDArray]) -> dict[str, NDArray]:
        """Return memory maps of arrays."""
        # Another fit that failed may have removed the empty folder.
        (folder / name).mkdir(parents=True)
        for part, array in arrays.items():
            with whole_file(folder / name / f"{part}.npy") as file:
                np.save(file, array)
        return {
            part: np.load(folder / name / f"{part}.npy", mmap_mode="r")
            for part in arrays
        }

    with folder_for_writing(folder):
        try:
            yield keep
        except BaseException:
            shutil.rmtree(folder / name, ignore_errors=True)
            raise
