"""What a table may come as: an array, or something that is read block by block."""

from typing import Any, NamedTuple

import numpy as np
from joblib import effective_n_jobs
from numpy.typing import NDArray
from sklearn import get_config
from sklearn.utils import check_array

from isa_nrsfm._dask_blocks import DaskBlocks
from isa_nrsfm._frame_blocks import FrameBlocks, MemoryBlocks, StoredBlocks
from isa_nrsfm._optional import import_optional
from isa_nrsfm._stored_table import StoredTable

# Numbers and frames of a block of a table in memory: products of large blocks are fast.
BLOCK_NUMBERS = 2**21
BLOCK_FRAMES = 2048
# Numbers that are in memory, at most, for each number of a block that is read.
COPIES = 8
MEGABYTE = 2**20
# What a table has to be, besides that its numbers are float32 or float64.
CHECKS: dict[str, Any] = {
    "dtype": [np.float64, np.float32],
    "ensure_all_finite": "allow-nan",
}


class Table(NamedTuple):
    """
    A table in blocks of its rows.

    Attributes
    ----------
    blocks : FrameBlocks
        Blocks (n_frames, 2 * n_points) of float32 or float64.
    n_columns : int
        Number of columns.
    dtype : dtype
        Type of the numbers.
    """

    blocks: FrameBlocks
    n_columns: int
    dtype: Any

    @classmethod
    def in_memory(
        cls, X: NDArray, n_jobs: int | None = 1, whole: bool = False
    ) -> "Table":
        """Return an array, as one block or as many that threads may work on."""
        length = min(max(BLOCK_NUMBERS // max(X.shape[1], 1), 1), BLOCK_FRAMES)
        length = max(len(X), 1) if whole else length
        blocks = MemoryBlocks.of(X, length, effective_n_jobs(n_jobs))
        return cls(blocks, X.shape[1], X.dtype)

    @classmethod
    def stored(cls, X: Any, working_memory: float | None) -> "Table":
        """Return a table that is read in blocks, with so many megabytes at a time."""
        _check_dimensions(X)
        if working_memory is None:
            working_memory = get_config()["working_memory"]
        numbers = MEGABYTE * working_memory / (np.dtype(float).itemsize * COPIES)
        length = max(int(numbers // max(X.shape[1], 1)), 1)
        blocks = StoredBlocks.of(X, length).derive(checked_rows)
        return cls(blocks, X.shape[1], _floating(X.dtype))

    @classmethod
    def on_dask(cls, X: Any) -> "Table":
        """Return a dask array, computed where dask does it."""
        _check_dimensions(X)
        blocks = DaskBlocks.of(X).derive(checked_rows)
        return cls(blocks, X.shape[1], _floating(X.dtype))


def _check_dimensions(X: Any) -> None:
    """Refuse what is not a table."""
    if X.ndim != 2:
        raise ValueError(
            f"Expected 2D array, got {X.ndim}D array instead: a table has one row "
            "a frame and two columns a point"
        )


def _floating(dtype: Any) -> np.dtype:
    """Return the type of numbers that a table of a type is read as."""
    single = np.dtype(dtype) == np.float32
    return np.dtype(np.float32 if single else np.float64)


def is_stored(X: Any) -> bool:
    """Tell whether a table is to be read block by block."""
    return isinstance(X, np.memmap | StoredTable)


def is_on_dask(X: Any) -> bool:
    """Tell whether a table is a dask array."""
    return type(X).__module__.startswith("dask.array")


def checked_rows(rows: Any) -> NDArray:
    """Return rows of a table as float32 or float64, without infinite values."""
    return check_array(rows, input_name="X", ensure_min_features=0, **CHECKS)


def column_sample(X: Any) -> Any:
    """Return a table without rows that has the columns, and their names, of another."""
    empty = np.empty((0, X.shape[1] if X.ndim == 2 else 0))
    if getattr(X, "columns", None) is None:
        return empty
    return import_optional("pandas", extra="io").DataFrame(empty, columns=X.columns)
