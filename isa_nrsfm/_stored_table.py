"""A table whose rows are read from files when they are needed."""

from collections.abc import Callable, Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray


class StoredTable:
    """
    A table whose rows are read from files when they are needed.

    `isa_nrsfm.io.open_table` makes one. It can be given to `AffineNRSfM.fit`,
    `transform`, `score` and the other methods that take a table, and is then read block
    by block.

    Parameters
    ----------
    parts : sequence of tuple
        For each file, in order, its number of rows and a function that returns the rows
        from one number to another (exclusive) as an array.
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
    ndim : int
        2.
    dtype : dtype
        Type of the numbers.
    columns : ndarray of shape (n_columns,) or None
        Names of the columns.
    """

    ndim = 2

    def __init__(
        self,
        parts: Sequence[tuple[int, Callable[[int, int], NDArray]]],
        n_columns: int,
        dtype: Any,
        columns: NDArray | None = None,
    ):
        self._ends = np.cumsum([n_rows for n_rows, _ in parts], dtype=int)
        self._read = [read for _, read in parts]
        self.shape = (int(self._ends[-1]), n_columns)
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
        found = []
        begins = np.concatenate([[0], self._ends[:-1]])
        for begin, end, read in zip(begins, self._ends, self._read, strict=True):
            first, last = max(start, begin), min(stop, end)
            if first < last:
                found.append(read(int(first - begin), int(last - begin)))
        if not found:
            return np.empty((0, self.shape[1]), dtype=self.dtype)
        return np.concatenate(found).astype(self.dtype, copy=False)
