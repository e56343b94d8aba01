"""Blocks of frames that a dask scheduler computes, on a cluster for instance."""

import warnings
from collections.abc import Callable, Iterator, Sequence
from typing import Any, Self

import numpy as np
from numpy.typing import NDArray

from isa_nrsfm._compat.optional import import_optional
from isa_nrsfm._tables.blocks import FrameBlocks, chosen_rows


class DaskBlocks(FrameBlocks):
    """Blocks, a sequence of Delayed, on the workers of the active dask scheduler.

    Derived blocks stay on the workers, or are computed again if one is lost. Only `map`
    brings results back. Blocks without frames are left out.
    """

    def __init__(self, blocks: Sequence[Any], lengths: Sequence[int]):
        filled = np.flatnonzero(lengths).tolist()
        self.blocks = [blocks[number] for number in filled]
        super().__init__(
            self.blocks.__getitem__, [lengths[k] for k in filled], cached=False
        )

    @classmethod
    def of_chunks(cls, table: Any) -> Self:
        """Return the chunks of a dask array (n_frames, 2 * n_points)."""
        if np.isnan(table.shape[0]):
            table = table.compute_chunk_sizes()
        table = table.rechunk({1: -1})
        return cls(table.to_delayed().ravel(), table.chunks[0])

    def map(self, function: Callable[..., Any], *by_frame: NDArray) -> Iterator[Any]:
        """Yield the results of a function of each block, in order."""
        dask = import_optional("dask", extra="dask")
        yield from _run_quietly(dask.compute, self._tasks(function, by_frame))

    def derive(self, function: Callable[..., Any], *by_frame: NDArray) -> Self:
        """Return new blocks, the results of a function of each of these."""
        dask = import_optional("dask", extra="dask")
        tasks = self._tasks(function, by_frame)
        return type(self)(_run_quietly(dask.persist, tasks), self.lengths)

    def subset(self, frames: NDArray) -> Self:
        """Return blocks of some frames, by a mask (n_frames,). Blocks are arrays."""
        lengths = [int(frames[rows].sum()) for rows in self.slices]
        return type(self)(self.derive(chosen_rows, frames).blocks, lengths)

    def collect(
        self,
        function: Callable[..., Any],
        shapes: tuple[tuple[int, ...], ...],
        dtype: Any,
    ) -> tuple[Any, ...]:
        """Return dask arrays, not computed yet, with rows for all frames."""
        array = import_optional("dask.array", extra="dask")
        tasks = list(zip(self._tasks(function, ()), self.lengths, strict=True))

        def joined(part: int, shape: tuple[int, ...]) -> Any:
            return array.concatenate(
                [
                    array.from_delayed(task[part], (length, *shape), dtype)
                    for task, length in tasks
                ]
            )

        return tuple(joined(part, shape) for part, shape in enumerate(shapes))

    def as_collected(self, values: NDArray) -> Any:
        """Return an array (n_frames, ...) as a dask array with these blocks' chunks."""
        array = import_optional("dask.array", extra="dask")
        return array.from_array(values, (tuple(self.lengths), *values.shape[1:]))

    def _tasks(self, function: Callable[..., Any], by_frame: Sequence[NDArray]) -> Any:
        """Return the tasks that compute a function of each block."""
        dask = import_optional("dask", extra="dask")
        run = dask.delayed(function, pure=False, traverse=False)
        return [
            run(block, *(array[part] for array in by_frame))
            for block, part in zip(self.blocks, self.slices, strict=True)
        ]


def _run_quietly(run: Callable[..., Any], tasks: list[Any]) -> Any:
    """Run dask.compute or dask.persist on tasks, without a warning of their size."""
    with warnings.catch_warnings():
        # Cameras and coefficients of the frames of a block go with each task.
        warnings.filterwarnings("ignore", "Sending large graph")
        return run(*tasks)
