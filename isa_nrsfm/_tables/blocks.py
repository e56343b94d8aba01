"""Frames in blocks: the one place that knows who computes a block, and where.

All stages of the fit are sums over frames, or go frame by frame. They are written as
functions of a block of frames, and run here: on arrays in memory, in threads, on tables
that are read from disk block by block, or on a dask cluster.
"""

import mmap
from abc import ABC, abstractmethod
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from functools import partial
from typing import Any, Self

import numpy as np
from numpy.typing import NDArray


class FrameBlocks(ABC):
    """
    Consecutive blocks of the frames of a table.

    A block holds what belongs to some consecutive frames: an array with a row for each
    of them, or any object that a function given to `derive` has returned.

    Parameters
    ----------
    lengths : sequence of int
        How many frames each block has.
    """

    def __init__(self, lengths: Sequence[int]):
        self.lengths = list(lengths)
        ends = np.cumsum(self.lengths, dtype=int)
        self.slices = [
            slice(int(end) - length, int(end))
            for end, length in zip(ends, self.lengths, strict=True)
        ]

    @property
    def n_frames(self) -> int:
        """The number of frames of all blocks."""
        return sum(self.lengths)

    @abstractmethod
    def map(self, function: Callable[..., Any], *by_frame: NDArray) -> Iterator[Any]:
        """
        Yield what a function makes of each block, in order.

        Parameters
        ----------
        function : callable
            Called with a block and the rows of the arrays that belong to its frames.
        *by_frame : ndarray of shape (n_frames, ...)
            Arrays with a row for each frame.

        Yields
        ------
        object
            What the function returns.
        """

    @abstractmethod
    def derive(self, function: Callable[..., Any], *by_frame: NDArray) -> Self:
        """
        Return new blocks, the results of a function of each of these blocks.

        They stay where these blocks are. In memory they are computed at once and kept.
        Blocks from disk are computed anew each time they are read.
        """

    @abstractmethod
    def subset(self, frames: NDArray) -> Self:
        """
        Return blocks of only some of the frames. These blocks must be arrays.

        Parameters
        ----------
        frames : ndarray of bool, shape (n_frames,)
            Which frames are kept, at least one.

        Returns
        -------
        FrameBlocks
            The kept frames, in the order of the table.
        """

    def joined(self, function: Callable[..., NDArray], *by_frame: NDArray) -> NDArray:
        """Return the arrays that a function makes of the blocks, concatenated."""
        return np.concatenate(list(self.map(function, *by_frame)))

    def take(self, frames: NDArray) -> NDArray:
        """
        Return some of the frames as one array. The blocks must be arrays.

        Parameters
        ----------
        frames : ndarray of int, shape (n_chosen,)
            Which frames, each at most once, in any order.

        Returns
        -------
        ndarray of shape (n_chosen, ...)
            The frames in this order.
        """
        chosen = np.zeros(self.n_frames, dtype=bool)
        chosen[frames] = True
        found = self.joined(chosen_rows, chosen)
        # Here the frames increase. The order that was asked for is that of their ranks.
        order = np.empty(len(frames), dtype=int)
        order[np.argsort(frames)] = np.arange(len(frames))
        return found[order]

    def collect(
        self,
        function: Callable[..., Any],
        shapes: tuple[tuple[int, ...], ...],
        dtype: Any,
    ) -> tuple[Any, ...]:
        """
        Return the arrays that a function makes of the blocks, each for all frames.

        Parameters
        ----------
        function : callable
            Returns a tuple of arrays with a row for each frame of a block.
        shapes : tuple of tuple of int
            For each of these arrays, the shape of one row. It is needed where there are
            no blocks, or where the arrays are not computed yet.
        dtype : dtype
            Type of the numbers of the arrays.

        Returns
        -------
        tuple of ndarray
            The arrays for all frames.
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

    def whole(self) -> NDArray:
        """Return all frames, of blocks that are arrays."""
        return self.joined(_same)

    def regrouped(self, join: Callable[[list[Any]], Any], n_frames: int) -> Self:
        """
        Return fewer and larger blocks. Blocks that are not in memory stay as they are.

        Parameters
        ----------
        join : callable
            Makes one block of a list of consecutive ones.
        n_frames : int
            The most frames of a block.

        Returns
        -------
        FrameBlocks
            The same frames.
        """
        return self

    def parts(self, arrays: tuple[NDArray, ...], block: int) -> tuple[NDArray, ...]:
        """Return the rows of arrays that belong to the frames of a block."""
        return tuple(array[self.slices[block]] for array in arrays)


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


def _same(block: Any) -> Any:
    """Return a block as it is."""
    return block


class MemoryBlocks(FrameBlocks):
    """
    Blocks in memory.

    Parameters
    ----------
    blocks : sequence
        The blocks.
    lengths : sequence of int
        How many frames each has.
    n_threads : int, default=1
        Threads that work on blocks at the same time.
    """

    def __init__(
        self, blocks: Sequence[Any], lengths: Sequence[int], n_threads: int = 1
    ):
        super().__init__(lengths)
        self.blocks = blocks
        self.n_threads = n_threads

    @classmethod
    def from_array(cls, array: NDArray, block_frames: int, n_threads: int = 1) -> Self:
        """Return the blocks of an array (n_frames, ...), block_frames frames each."""
        starts = range(0, len(array), block_frames)
        blocks = [array[start : start + block_frames] for start in starts]
        return cls(blocks, [len(block) for block in blocks], n_threads)

    def map(self, function: Callable[..., Any], *by_frame: NDArray) -> Iterator[Any]:
        """Yield what a function makes of each block, in order."""

        def run(number: int) -> Any:
            return function(self.blocks[number], *self.parts(by_frame, number))

        numbers = range(len(self.blocks))
        if min(self.n_threads, len(self.blocks)) < 2:
            yield from map(run, numbers)
            return
        with ThreadPoolExecutor(self.n_threads) as pool:
            yield from pool.map(run, numbers)

    def derive(self, function: Callable[..., Any], *by_frame: NDArray) -> Self:
        """Return the blocks that a function makes of these."""
        blocks = list(self.map(function, *by_frame))
        return type(self)(blocks, self.lengths, self.n_threads)

    def subset(self, frames: NDArray) -> Self:
        """Return blocks of only some of the frames. These blocks must be arrays."""
        array = self.joined(chosen_rows, frames)
        return self.from_array(array, max(self.lengths), self.n_threads)

    def regrouped(self, join: Callable[[list[Any]], Any], n_frames: int) -> Self:
        """Return blocks of at most n_frames frames, each joined from as many as fit."""
        groups: list[list[int]] = []
        size = 0
        for number, length in enumerate(self.lengths):
            if not groups or size + length > n_frames:
                groups.append([])
                size = 0
            groups[-1].append(number)
            size += length
        blocks = [join([self.blocks[number] for number in group]) for group in groups]
        lengths = [sum(self.lengths[number] for number in group) for group in groups]
        return type(self)(blocks, lengths, self.n_threads)


class StoredBlocks(FrameBlocks):
    """
    Blocks that are read, and computed, whenever they are needed.

    Parameters
    ----------
    read : callable
        Returns a block, given the slice of its frames.
    lengths : sequence of int
        How many frames each block has.
    """

    def __init__(self, read: Callable[[slice], Any], lengths: Sequence[int]):
        super().__init__(lengths)
        self.read = read

    @classmethod
    def from_table(cls, table: Any, block_frames: int) -> Self:
        """Return the blocks of a table that can be sliced, block_frames frames each."""
        read = partial(read_rows, table)
        return cls(read, _block_lengths(table.shape[0], block_frames))

    def map(self, function: Callable[..., Any], *by_frame: NDArray) -> Iterator[Any]:
        """Yield what a function makes of each block, in order."""
        for number, rows in enumerate(self.slices):
            yield function(self.read(rows), *self.parts(by_frame, number))

    def derive(self, function: Callable[..., Any], *by_frame: NDArray) -> Self:
        """Return the blocks that a function makes of these when they are read."""

        def read(rows: slice) -> Any:
            return function(self.read(rows), *(array[rows] for array in by_frame))

        return type(self)(read, self.lengths)

    def subset(self, frames: NDArray) -> Self:
        """Return blocks of only some of the frames. These blocks must be arrays."""
        numbers, length = np.flatnonzero(frames), max(self.lengths)

        def read(rows: slice) -> NDArray:
            first, last = numbers[rows][[0, -1]]
            # Few kept frames may be far apart: read one block's length at a time.
            starts = range(int(first), int(last) + 1, length)
            parts = [slice(s, min(s + length, int(last) + 1)) for s in starts]
            return np.concatenate([self.read(part)[frames[part]] for part in parts])

        return type(self)(read, _block_lengths(len(numbers), length))


def _block_lengths(n_frames: int, block_frames: int) -> list[int]:
    """Return the lengths of blocks of block_frames frames. The last may be shorter."""
    starts = range(0, n_frames, block_frames)
    return [min(block_frames, n_frames - start) for start in starts]
