"""Sources of a table: an array, or an object that is read block by block."""

from collections.abc import Callable, Sequence
from functools import partial
from itertools import pairwise
from typing import Any

import numpy as np
from joblib import effective_n_jobs
from numpy.typing import NDArray
from sklearn import get_config
from sklearn.utils import check_array

from isa_nrsfm._compat import pandas as pd
from isa_nrsfm._compat.caller import warn_caller
from isa_nrsfm._tables.blocks import BLOCK_FRAMES, DaskBlocks, FrameBlocks, read_rows
from isa_nrsfm._tables.tracks import (
    Layout,
    clean_rows,
    refuse_odd,
    table_to_rows,
    table_to_tracks,
    without_half_points,
)

# Range of the coordinates of a frame: squares beyond it leave the range of double
# precision. Fits at both ends agree with fits of sizes about one.
LARGEST, SMALLEST = 2e153, 1e-150
# What `check_array` checks in a table.
CHECKS: dict[str, Any] = {
    "dtype": [np.float64, np.float32],
    "ensure_all_finite": "allow-nan",
}


def open_table(
    X: Any,
    layout: Layout,
    names: NDArray | None = None,
    *,
    counted: bool = True,
    n_jobs: int | None = 1,
    working_memory: float | None = None,
) -> FrameBlocks:
    """Return a table in blocks of rows (n, 2, n_points), float32 or float64.

    Points with one coordinate become missing, with a warning. With `counted`, those of
    a table that is read later stay: `scaled_table` counts them and leaves them out.

    Arrays in memory must be checked already. `n_jobs` threads share their blocks and
    those of memory maps. Chunks of dask stay on its workers. Blocks of tables that are
    read later use at most `working_memory` megabytes.
    """
    if X.ndim != 2:
        raise ValueError(
            f"Expected 2D array, got {X.ndim}D array instead: a table has one row "
            "per frame and two columns per point"
        )
    refuse_odd(X.shape[1], layout)
    n_columns = max(X.shape[1], 1)
    # Blocks large enough that products of matrices are fast
    length, n_threads = max(2**21 // n_columns, 1), effective_n_jobs(n_jobs)
    dtype = np.float32 if X.dtype == np.float32 else np.float64
    empty = np.empty((0, 2, X.shape[1] // 2), dtype)
    if not is_read_later(X):
        # Views of the table: each block is copied when it is read.
        rows = clean_rows(table_to_tracks(X, layout).transpose(0, 2, 1), layout, names)
        blocks = FrameBlocks.of_array(rows, min(length, BLOCK_FRAMES), n_threads)
        return blocks.derive(np.ascontiguousarray, kept=False)
    if is_on_dask(X):
        blocks = DaskBlocks.of_chunks(X)
    else:
        if working_memory is None:
            working_memory = get_config()["working_memory"]
        # A block needs at most eight times its own memory, copies included.
        numbers = 2**20 * working_memory / (8 * np.dtype(float).itemsize)
        most = max(int(numbers // n_columns), 1)
        if isinstance(X, np.memmap):
            most = min(most, length)
        else:  # row groups of parquet files are read whole for each block
            n_threads = 1
        read = partial(read_rows, X)
        blocks = FrameBlocks.read_later(read, X.shape[0], most, n_threads)
    blocks = blocks.derive(partial(_rows, layout=layout, counted=counted))
    blocks.empty = empty
    return blocks


def _rows(X: Any, layout: Layout, counted: bool) -> NDArray:
    """Return the rows (n, 2, n_points) of a block, as `open_table` describes."""
    given = table_to_rows(checked_rows(X), layout)
    rows, n_half, _ = without_half_points(given)
    if n_half.any() and not counted:
        warn_caller(
            "some points have only one of their two coordinates. They count as missing"
        )
    return given if counted else rows


def is_read_later(X: Any) -> bool:
    """Return whether a table is read block by block, from disk or on dask."""
    return is_on_dask(X) or isinstance(X, np.memmap | StoredTable)


def is_on_dask(X: Any) -> bool:
    """Return whether a table is a dask array."""
    return type(X).__module__.startswith("dask.array")


def refuse_stored(X: Any, what: str) -> None:
    """Raise if a table is not in memory, nor a memory map."""
    if is_on_dask(X) or isinstance(X, StoredTable):
        raise ValueError(
            f"{what} needs a table in memory or a memory map; got a "
            f"{type(X).__name__}: take some thousand of its frames"
        )


def checked_rows(rows: Any) -> NDArray:
    """Return rows of a table as float32 or float64, without infinite values."""
    X = check_array(unmasked(rows), input_name="X", ensure_min_features=0, **CHECKS)
    return checked_range(X)


def unmasked(X: Any) -> Any:
    """Return a masked array with NaN for masked entries, others unchanged."""
    if not isinstance(X, np.ma.MaskedArray):
        return X
    dtype = X.dtype if X.dtype.kind == "f" else np.float64
    return np.ma.filled(X.astype(dtype), np.nan)


def checked_range(X: NDArray) -> NDArray:
    """Raise an error if squares of a row leave the range of double precision."""
    highest = np.fmax.reduce(X, axis=1, initial=0.0)
    lowest = np.fmin.reduce(X, axis=1, initial=0.0)
    largest = np.maximum(highest, -lowest).astype(np.float64)
    outside = (largest > LARGEST) | ((largest < SMALLEST) & (largest > 0))
    if outside.any():
        row = int(outside.argmax())
        raise ValueError(
            f"the largest coordinate of each frame of X must be between {SMALLEST:g} "
            f"and {LARGEST:g} in magnitude, or all must be zero; got "
            f"{largest[row]:.3g} in row {row}. Give the table in another unit"
        )
    return X


def column_sample(X: Any) -> Any:
    """Return an empty table (0, n_columns) with the column names of X, if any."""
    empty = np.empty((0, X.shape[1] if X.ndim == 2 else 0))
    if getattr(X, "columns", None) is None:
        return empty
    return pd.DataFrame(empty, columns=X.columns)


class StoredTable:
    """A table whose rows are read from files when they are needed.

    `isa_nrsfm.io.open_table` makes one. `AffineNRSfM.fit`, `transform`, `score` and the
    other methods that take a table read it block by block.

    Parameters
    ----------
    parts : sequence of tuple
        For each file, in order, its number of rows and a function ``read(start, stop)``
        that returns these rows as an array (`stop` excluded).
    n_columns : int
        Number of columns.
    dtype : dtype
        Type of the numbers.
    columns : ndarray of shape (n_columns,), optional
        Names of the columns.

    Attributes
    ----------
    shape : tuple of int
        Numbers of rows and columns.
    """

    ndim = 2

    def __init__(
        self,
        parts: Sequence[tuple[int, Callable[[int, int], NDArray]]],
        n_columns: int,
        dtype: Any,
        columns: NDArray | None = None,
    ):
        lengths, self._read = zip(*parts, strict=True)
        self._ends = np.cumsum([0, *lengths]).tolist()
        self.shape = (self._ends[-1], n_columns)
        self.dtype = np.dtype(dtype)
        self.columns = columns

    def __len__(self) -> int:
        """Return the number of rows."""
        return self.shape[0]

    def __getitem__(self, rows: slice) -> NDArray:
        """Return consecutive rows."""
        if not isinstance(rows, slice) or rows.step not in (None, 1):
            raise TypeError(f"rows must be a slice without steps; got {rows!r}")
        start, stop, _ = rows.indices(len(self))
        parts = [np.empty((0, self.shape[1]), dtype=self.dtype)]
        for (begin, end), read in zip(pairwise(self._ends), self._read, strict=True):
            first, last = max(start, begin), min(stop, end)
            if first < last:
                parts.append(read(first - begin, last - begin))
        return np.concatenate(parts[1:] or parts).astype(self.dtype, copy=False)
