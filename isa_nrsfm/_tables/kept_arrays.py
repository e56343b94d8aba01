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
    """
    Make ready to keep arrays in files, and remove the files if the block fails.

    Each block writes to a new folder within the given one, named by the time and at
    random, so that no other fit, process or clone writes to files that are mapped.

    Parameters
    ----------
    path : str, path-like or None
        The path of the folder. It is made if it does not exist. None keeps arrays where
        they are.

    Yields
    ------
    callable
        Takes arrays by name, and returns them by name: memory maps of files that are
        named like them.

    Raises
    ------
    ValueError
        If the path is empty.
    OSError
        If the folder cannot be made or written to, or a file cannot be written.
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
