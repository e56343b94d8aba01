"""Blocks of frames that a dask scheduler computes, on a cluster for instance."""

import warnings
from collections.abc import Callable, Iterator, Sequence
from typing import Any, Self

import numpy as np
from numpy.typing import NDArray

from isa_nrsfm._compat.optional import import_optional
from isa_nrsfm._tables.blocks import FrameBlocks, chosen_rows


class DaskBlocks(FrameBlocks):
    """
    Blocks on the workers of whatever dask scheduler is active.

    Derived blocks stay on the workers. Only `map` brings results back. If a worker is
    lost, the scheduler computes its blocks again, beginning with the table.

    Parameters
    ----------
    blocks : sequence of Delayed
        The blocks.
    lengths : sequence of int
        How many frames each has.
    """

    def __init__(self, blocks: Sequence[Any], lengths: Sequence[int]):
        super().__init__(lengths)
        self.blocks = blocks

    @classmethod
    def from_table(cls, table: Any) -> Self:
        """Return the chunks of a dask array (n_frames, 2 * n_points)."""
        if np.isnan(table.shape[0]):
            table = table.compute_chunk_sizes()
        table = table.rechunk({1: -1})
        return cls._filled(table.to_delayed().ravel(), table.chunks[0])

    @classmethod
    def _filled(cls, blocks: Sequence[Any], lengths: Sequence[int]) -> Self:
        """Return the blocks without those of length zero."""
        filled = [number for number, length in enumerate(lengths) if length]
        return cls([blocks[k] for k in filled], [lengths[k] for k in filled])

    def map(self, function: Callable[..., Any], *by_frame: NDArray) -> Iterator[Any]:
        """Yield what a function makes of each block, in order."""
        dask = import_optional("dask", extra="dask")
        yield from _run_quietly(dask.compute, self._tasks(function, by_frame))

    def derive(self, function: Callable[..., Any], *by_frame: NDArray) -> Self:
        """Return the blocks that a function makes of these."""
        dask = import_optional("dask", extra="dask")
        blocks = _run_quietly(dask.persist, self._tasks(function, by_frame))
        return type(self)(blocks, self.lengths)

    def subset(self, frames: NDArray) -> Self:
        """Return blocks of only some of the frames. These blocks must be arrays."""
        lengths = [int(frames[rows].sum()) for rows in self.slices]
        return self._filled(self.derive(chosen_rows, frames).blocks, lengths)

    def collect(
        self,
        function: Callable[..., Any],
        shapes: tuple[tuple[int, ...], ...],
        dtype: Any,
    ) -> tuple[Any, ...]:
        """Return dask arrays, not computed yet, with rows for all frames."""
        array = import_optional("dask.array", extra="dask")
        tasks = self._tasks(function, ())
        return tuple(
            array.concatenate(
                [
                    array.from_delayed(task[part], (length, *shape), dtype)
                    for task, length in zip(tasks, self.lengths, strict=True)
                ]
            )
            for part, shape in enumerate(shapes)
        )

    def as_collected(self, values: NDArray) -> Any:
        """Return an array (n_frames, ...) as a dask array with these blocks' chunks."""
        array = import_optional("dask.array", extra="dask")
        chunks = (tuple(self.lengths), *values.shape[1:])
        return array.from_array(values, chunks=chunks)

    def _tasks(
        self, function: Callable[..., Any], by_frame: tuple[NDArray, ...]
    ) -> Any:
        """Return the tasks that compute a function of each block."""
        dask = import_optional("dask", extra="dask")
        run = dask.delayed(function, pure=False, traverse=False)
        return [
            run(block, *self.parts(by_frame, number))
            for number, block in enumerate(self.blocks)
        ]


def _run_quietly(run: Callable[..., Any], tasks: list[Any]) -> Any:
    """Run dask.compute or dask.persist on tasks, without a warning of their size."""
    with warnings.catch_warnings():
        # Cameras and coefficients of the frames of a block go with each task.
        warnings.filterwarnings("ignore", "Sending large graph")
        return run(*tasks)
