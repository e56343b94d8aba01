"""Block-wise execution: in memory, in threads, from disk or on dask.

All stages of the fit are sums over frames, or go frame by frame. They are written as
functions of a block of frames.
"""

import mmap
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from functools import partial
from typing import Any, Self

import numpy as np
from numpy.typing import NDArray


class FrameBlocks:
    """Consecutive blocks of the frames of a table, in memory or read when needed.

    A block is an array with a row for each of some consecutive frames, or any object
    that a function given to `derive` has returned. `read` returns a block, given its
    number; `lengths` are their numbers of frames. Derived blocks are computed at once
    and kept if `cached`, or anew at each reading; `n_threads` work on blocks at the
    same time.
    """

    def __init__(
        self,
        read: Callable[[int], Any],
        lengths: Sequence[int],
        cached: bool,
        n_threads: int = 1,
    ):
        self.read, self.cached, self.n_threads = read, cached, n_threads
        self.lengths = list(lengths)
        ends = np.cumsum(self.lengths, dtype=int).tolist()
        self.slices = list(map(slice, [0, *ends[:-1]], ends))

    @classmethod
    def of_blocks(
        cls, blocks: Sequence[Any], lengths: Sequence[int], n_threads: int = 1
    ) -> Self:
        """Return blocks in memory."""
        return cls(blocks.__getitem__, lengths, True, n_threads)

    @classmethod
    def of_array(cls, array: NDArray, block_frames: int, n_threads: int = 1) -> Self:
        """Return the blocks of an array (n_frames, ...), block_frames frames each."""
        starts = range(0, len(array), block_frames)
        blocks = [array[start : start + block_frames] for start in starts]
        return cls.of_blocks(blocks, list(map(len, blocks)), n_threads)

    @classmethod
    def of_stored(cls, table: Any, block_frames: int) -> Self:
        """Return blocks that are read from a table that can be sliced."""
        return cls._read_later(partial(read_rows, table), table.shape[0], block_frames)

    @classmethod
    def _read_later(
        cls, rows: Callable[[slice], Any], n_frames: int, block_frames: int
    ) -> Self:
        """Return blocks of rows that a function returns for a slice."""
        starts = range(0, n_frames, block_frames)
        parts = [slice(s, min(s + block_frames, n_frames)) for s in starts]
        lengths = [part.stop - part.start for part in parts]
        return cls(lambda number: rows(parts[number]), lengths, False)

    @property
    def n_frames(self) -> int:
        """The number of frames of all blocks."""
        return sum(self.lengths)

    def map(self, function: Callable[..., Any], *by_frame: NDArray) -> Iterator[Any]:
        """Yield results of a function of each block and its rows of arrays."""
        run = self._reader(function, by_frame)
        numbers = range(len(self.lengths))
        if min(self.n_threads, len(numbers)) < 2:
            yield from map(run, numbers)
            return
        with ThreadPoolExecutor(self.n_threads) as pool:
            yield from pool.map(run, numbers)

    def derive(self, function: Callable[..., Any], *by_frame: NDArray) -> Self:
        """Return new blocks, the results of a function of each of these (see `map`)."""
        if self.cached:
            blocks = list(self.map(function, *by_frame))
            return self.of_blocks(blocks, self.lengths, self.n_threads)
        read = self._reader(function, by_frame)
        return type(self)(read, self.lengths, False)

    def subset(self, frames: NDArray) -> Self:
        """Return blocks of some frames, by a mask (n_frames,). Blocks are arrays."""
        length = max(self.lengths)
        if self.cached:
            array = self.joined(chosen_rows, frames)
            return self.of_array(array, length, self.n_threads)
        chosen = self.derive(chosen_rows, frames)
        counts = [np.count_nonzero(frames[part]) for part in self.slices]
        before = np.cumsum([0, *counts])

        def rows(part: slice) -> NDArray:
            ends = [part.start, part.stop - 1]
            first, last = np.searchsorted(before, ends, side="right") - 1
            found = [chosen.read(number) for number in range(first, last + 1)]
            start = part.start - before[first]
            return np.concatenate(found)[start : start + part.stop - part.start]

        return self._read_later(rows, int(before[-1]), length)

    def joined(self, function: Callable[..., NDArray], *by_frame: NDArray) -> NDArray:
        """Return the arrays that a function makes of the blocks, concatenated."""
        return np.concatenate(list(self.map(function, *by_frame)))

    def take(self, frames: NDArray) -> NDArray:
        """Return different frames (n_chosen,) in any order. Blocks are arrays."""
        chosen = np.zeros(self.n_frames, dtype=bool)
        chosen[frames] = True
        order = np.argsort(np.argsort(frames))
        return self.joined(chosen_rows, chosen)[order]

    def whole(self) -> NDArray:
        """Return all frames. Blocks are arrays."""
        return self.joined(lambda block: block)

    def collect(
        self,
        function: Callable[..., Any],
        shapes: tuple[tuple[int, ...], ...],
        dtype: Any,
    ) -> tuple[Any, ...]:
        """Return arrays of all frames that a function makes of the blocks.

        Shapes of rows and dtype serve if there are no blocks, or none is computed yet.
        """
        parts = list(self.map(function))
        if len(parts) == 1:
            return tuple(parts[0])
        if not parts:
            return tuple(np.empty((0, *shape), dtype=dtype) for shape in shapes)
        return tuple(map(np.concatenate, zip(*parts, strict=True)))

    def as_collected(self, values: NDArray) -> Any:
        """Return an array (n_frames, ...) as one of the kind that `collect` returns."""
        return values

    def regrouped(self, join: Callable[[list[Any]], Any], n_frames: int) -> Self:
        """Join consecutive blocks in memory into blocks of at most n_frames frames."""
        if not self.cached:
            return self
        groups: list[list[int]] = [[]]
        for number, length in enumerate(self.lengths):
            size = sum(self.lengths[other] for other in groups[-1])
            if groups[-1] and size + length > n_frames:
                groups.append([])
            groups[-1].append(number)
        blocks = [join(list(map(self.read, group))) for group in groups]
        lengths = [sum(self.lengths[number] for number in group) for group in groups]
        return self.of_blocks(blocks, lengths, self.n_threads)

    def _reader(
        self, function: Callable[..., Any], by_frame: tuple[NDArray, ...]
    ) -> Callable[[int], Any]:
        """Return a function of the number of a block: the result for that block."""

        def read(number: int) -> Any:
            part = self.slices[number]
            return function(self.read(number), *(array[part] for array in by_frame))

        return read


def chosen_rows(block: NDArray, kept: NDArray) -> NDArray:
    """Return the frames of a block that are kept."""
    return block[kept]


def read_rows(table: Any, rows: slice) -> NDArray:
    """Return rows of a table; the pages of a memory map do not stay in memory."""
    found = np.array(table[rows])
    mapped = getattr(table, "_mmap", None)
    # Mode "c" is copy on write: pages that were changed are in memory only.
    if mapped is not None and hasattr(mapped, "madvise") and table.mode != "c":
        mapped.madvise(mmap.MADV_DONTNEED)
    return found
