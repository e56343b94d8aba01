"""Tables of landmarks: their forms, the visible points of frames, blocks of frames.

A *table* has one row per frame and two columns per point, shape ``(n_frames,
2 * n_points)``, in either layout of the columns. `open_table` turns it into *rows*
``(n_frames, 2, n_points)``, the form of all stages: a point that is not seen in a
frame has NaN in both. *Tracks* ``(n_frames, n_points, 2)`` are the form of public
results.

All stages of the fit are sums over frames, or go frame by frame. They are written as
functions of a block of frames: in memory, in threads, from disk or on dask. The source
of a table is an array, or an object that is read block by block.
"""

import mmap
import warnings
from collections import deque
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from functools import partial
from itertools import pairwise
from operator import getitem
from typing import Any, Literal, NamedTuple, Self, get_args

import numpy as np
from joblib import effective_n_jobs
from numpy.typing import NDArray
from sklearn import get_config
from sklearn.utils import check_array, gen_batches

from isa_nrsfm._compat import pandas as pd
from isa_nrsfm._compat.caller import warn_caller
from isa_nrsfm._compat.lazy import import_optional
from isa_nrsfm._compat.scikit_learn import one_blas_thread

# Columns are x0, y0, x1, y1, ... or x0, x1, ..., y0, y1, ...
Layout = Literal["interleaved", "planar"]
LAYOUTS: tuple[Layout, ...] = get_args(Layout)
# Least number of visible points of a frame. Each point gives two equations; an affine
# camera with its translation has eight unknowns. Coefficients need no further points:
# the prior determines them where the points do not.
FEWEST_POINTS = 4


def table_to_tracks(X: NDArray, layout: Layout = "interleaved") -> NDArray:
    """Return the tracks (n_frames, n_points, 2) of a table."""
    n_frames, n_columns = X.shape
    refuse_odd(n_columns, layout)
    if layout == "planar":
        return X.reshape(n_frames, 2, n_columns // 2).transpose(0, 2, 1)
    return X.reshape(n_frames, n_columns // 2, 2)


def refuse_odd(n_columns: int, layout: Layout) -> None:
    """Refuse a number of columns that is odd."""
    if n_columns % 2:
        three = f". If points have x, y and a third number, give {two_of(3, layout)}"
        raise ValueError(
            "X must have two columns per point (x and y), an even number; "
            f"got n_features={n_columns}{three * (n_columns % 3 == 0)}"
        )


def two_of(n_numbers: int, layout: Layout) -> str:
    """Return what makes a table X of the first two numbers of points."""
    shape, two = f"-1, {n_numbers}", "..., :2"
    if layout == "planar":
        shape, two = f"{n_numbers}, -1", ":, :2"
    return f"np.asarray(X).reshape(len(X), {shape})[{two}].reshape(len(X), -1)"


def tracks_to_table(tracks: NDArray, layout: Layout = "interleaved") -> NDArray:
    """Return tracks as a table, the inverse of `table_to_tracks`."""
    n_frames, n_points, _ = tracks.shape
    if layout == "planar":
        tracks = tracks.transpose(0, 2, 1)
    return tracks.reshape(n_frames, 2 * n_points)


def table_to_rows(X: NDArray, layout: Layout) -> NDArray:
    """Return the rows (n_frames, 2, n_points) of a table, contiguous."""
    return np.ascontiguousarray(table_to_tracks(X, layout).transpose(0, 2, 1))


def without_half_points(rows: NDArray) -> tuple[NDArray, NDArray, NDArray]:
    """Hide points with one coordinate; return rows (I, 2, J), counts, first ones."""
    x, y = np.isnan(rows).swapaxes(0, 1)
    half = x != y
    if half.any():
        rows = np.where(half[:, None], rows.dtype.type(np.nan), rows)
    return rows, half.sum(axis=1), half.argmax(axis=1)


def warn_of_half_points(
    n_half: NDArray, first: NDArray, layout: Layout, names: NDArray | None
) -> None:
    """Warn of points with one coordinate, as found by `without_half_points`."""
    if not n_half.any():
        return
    row = int((n_half > 0).argmax())
    warn_caller(
        f"in {np.count_nonzero(n_half)} of {len(n_half)} rows points have only one of "
        f"their two coordinates ({n_half.sum()} in all; first: "
        f"{describe_point(int(first[row]), layout, names)} in row {row}). They count "
        "as missing"
    )


def clean_rows(rows: NDArray, layout: Layout, names: NDArray | None) -> NDArray:
    """Return rows (I, 2, J) without points that have one coordinate; warn of them."""
    rows, n_half, first = without_half_points(rows)
    warn_of_half_points(n_half, first, layout, names)
    return rows


def describe_point(point: int, layout: Layout, names: NDArray | None) -> str:
    """Return the number of a point, with the names of its columns where known."""
    if names is None:
        return f"point {point}"
    x, y = table_to_tracks(np.asarray(names)[None], layout)[0, point]
    return f"point {point} ({x}, {y})"


class FrameReport(NamedTuple):
    """Place, size and visible points of frames.

    translation (I, 2): centroids of the visible points, NaN for frames without any.
    size (I,): RMS of the centred coordinates, zero for frames without any.
    n_seen (I,): number of visible points.
    in_one_place (I,): whether all visible points are equal, up to rounding.
    on_line (I,): whether points are missing and the others on one line.
    """

    translation: NDArray
    size: NDArray
    n_seen: NDArray
    in_one_place: NDArray
    on_line: NDArray

    @property
    def usable(self) -> NDArray:
        """Return a mask of frames (n_frames,) with enough points for a camera.

        They have four points or more, not all in one place. If some points are missing,
        the others must not be on a line. A complete frame on a line is a flat object
        seen edge on. With missing points it may be a line of the object, which can turn
        around it.
        """
        return (self.n_seen >= FEWEST_POINTS) & ~self.in_one_place & ~self.on_line


def seen_points(rows: NDArray) -> NDArray:
    """Return which points (I, J) of rows (I, 2, J) are seen."""
    return ~np.isnan(rows[:, 0])


def of_all_rows(values: NDArray, shown: NDArray) -> NDArray:
    """Expand values of shown rows to all rows, NaN for the others."""
    if shown.all():
        return values
    all_rows = np.full((len(shown), *values.shape[1:]), np.nan, values.dtype)
    all_rows[shown] = values
    return all_rows


def centred_frames(rows: NDArray) -> tuple[NDArray, FrameReport]:
    """Return rows (I, 2, J) centred over their visible points in double precision."""
    # Coordinates are equal up to four units in the last place of the largest one.
    eps = 4 * np.finfo(rows.dtype).eps
    seen = seen_points(rows)
    n_seen, hidden = seen.sum(axis=1), None if seen.all() else ~seen[:, None]
    centred = np.array(rows, dtype=float, order="C")
    if hidden is not None:
        np.copyto(centred, 0.0, where=hidden)
    translation = np.full((len(rows), 2), np.nan)
    total, visible = centred.sum(axis=2), n_seen[:, None] > 0
    np.divide(total, n_seen[:, None], where=visible, out=translation)
    centred -= translation[:, :, None]
    if hidden is not None:
        np.copyto(centred, 0.0, where=hidden)
    x, y = centred.swapaxes(0, 1)
    xx, yy = np.vecdot(x, x), np.vecdot(y, y)
    square, place = xx + yy, np.linalg.norm(translation, axis=1)
    in_one_place = (n_seen > 0) & (square <= n_seen * (eps * place) ** 2)
    on_line = np.zeros(len(rows), dtype=bool)
    if hidden is not None:
        # Twice the square of the distances from the principal axis, roughly
        scatter = square - np.hypot(xx - yy, 2.0 * np.vecdot(x, y))
        near = scatter <= 4 * n_seen * (eps * place) ** 2 + 1e-6 * square
        part = near & ~seen.all(axis=1)
        on_line[part] = _collinear(centred[part], place[part], n_seen[part], eps)
        np.copyto(centred, np.nan, where=hidden)
    size = np.sqrt(square / (2 * np.maximum(n_seen, 1)))
    return centred, FrameReport(translation, size, n_seen, in_one_place, on_line)


def _collinear(
    centred: NDArray, place: NDArray, n_seen: NDArray, eps: float
) -> NDArray:
    """Return a mask of centred rows (n, 2, J) with visible points on one line."""
    x, y = centred[:, 0], centred[:, 1]
    # Fit the angle of the principal axis. Eigenvalues of the 2x2 second moment would
    # square the distances from it, and lose half of their digits.
    angle = 0.5 * np.arctan2(2.0 * np.vecdot(x, y), np.vecdot(x, x) - np.vecdot(y, y))
    across = np.cos(angle)[:, None] * y - np.sin(angle)[:, None] * x
    rounding = eps * (place + np.abs(centred).max(axis=(1, 2)))
    thin = np.vecdot(across, across) <= n_seen * rounding**2
    return np.asarray(thin & (n_seen > 0))


def check_frames(report: FrameReport, n_points: int) -> None:
    """Raise an error if frames with points do not determine a camera."""
    n_seen, n_frames = report.n_seen, len(report.n_seen)
    failures = (n_seen > 0) & (n_seen < min(FEWEST_POINTS, n_points))
    if failures.any():
        row = failures.argmax()
        raise ValueError(
            f"fewer than {FEWEST_POINTS} points are visible in {failures.sum()} of "
            f"{n_frames} frames (first: row {row}, with {n_seen[row]}), too few to "
            "determine a camera. Leave out these rows"
        )
    line = report.on_line & ~report.in_one_place
    if line.any():
        raise ValueError(
            f"points are missing in {line.sum()} of {n_frames} frames (first: row "
            f"{line.argmax()}) and the others lie on one line, which does not "
            "determine a camera. Leave out these rows"
        )
    refuse_one_place(report, n_points)


def refuse_one_place(report: FrameReport, n_points: int) -> None:
    """Raise an error if all visible points of a frame are in one place."""
    one = report.in_one_place
    if one.any():
        which = "seen points" if (report.n_seen[one] < n_points).any() else "points"
        raise ValueError(
            f"all {which} are equal in {one.sum()} of {len(one)} frames (first: row "
            f"{one.argmax()}), so that they show no shape. Leave out these rows"
        )


def weighted_sizes(rows: NDArray, weights: NDArray) -> NDArray:
    """Return the weighted sizes (I,) of rows (I, 2, J) with weights (I, J).

    Weights of missing points are zero. If all of the weight is in one place, sizes are
    not weighted.
    """
    centred, report = centred_frames(rows)
    rows, shares = np.nan_to_num(centred), weights / weights.sum(axis=1)[:, None]
    place = np.vecdot(rows, shares[:, None])
    offsets = np.where(weights[:, None] > 0, rows - place[..., None], 0.0)
    square = np.vecdot(shares, (offsets**2).sum(axis=1)) / 2
    enough = square > (4 * np.finfo(float).eps * report.size) ** 2
    return np.where(enough, np.sqrt(square), report.size)


# Frames that are worked on at a time. Threads wait for each other between operations,
# which should thus take long: with 2**11, 2**13 and 2**14 two threads take 1.1, .88 and
# .79 of the time of one (160,000 frames of 68 points). More frames take more memory.
BLOCK_FRAMES = 2**13


class FrameBlocks:
    """Consecutive blocks of the frames of a table, in memory or read when needed.

    A block is an array with a row for each of some consecutive frames, or the result of
    a function given to `derive`. `read` returns the block of a given number, and
    `lengths` are the numbers of frames, `n_frames` their sum. Derived blocks are
    computed once if `cached` and to be kept, otherwise at each reading. `n_threads`
    threads work on blocks at the same time.
    `empty` is a block without frames of the table, known for blocks of arrays and of
    `open_table`, and those derived from them.
    """

    empty: Any = None

    def __init__(
        self,
        read: Callable[[int], Any],
        lengths: Sequence[int],
        cached: bool,
        n_threads: int = 1,
    ):
        self.read, self.cached, self.n_threads = read, cached, n_threads
        self.lengths, self.n_frames = list(lengths), sum(lengths)
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
        parts = [array[part] for part in block_slices(len(array), block_frames)]
        blocks = cls.of_blocks(parts, list(map(len, parts)), n_threads)
        blocks.empty = array[:0]
        return blocks

    @classmethod
    def read_later(
        cls, rows: Callable[[slice], Any], n_frames: int, length: int, n_threads: int
    ) -> Self:
        """Return blocks, `length` frames each, that a function of row slices reads."""
        parts = block_slices(n_frames, length)
        lengths = [part.stop - part.start for part in parts]
        return cls(lambda number: rows(parts[number]), lengths, False, n_threads)

    def map(self, function: Callable[..., Any], *by_frame: NDArray) -> Iterator[Any]:
        """Return the results of a function of each block, and of its rows of arrays."""
        result, numbers = self._results(function, by_frame), range(len(self.lengths))
        if min(self.n_threads, len(self.lengths)) < 2:
            return map(result, numbers)
        return in_threads(result, numbers, self.n_threads)

    def derive(self, function: Callable, *by_frame: NDArray, kept: bool = True) -> Self:
        """Return blocks of the results of a function of each block (see `map`)."""
        read = self._results(function, by_frame)
        if self.cached and kept:
            read = list(self.map(function, *by_frame)).__getitem__
        derived = type(self)(read, self.lengths, self.cached, self.n_threads)
        derived.empty = self.empty
        return derived

    def _results(
        self, function: Callable[..., Any], by_frame: Sequence[NDArray]
    ) -> Callable[[int], Any]:
        """Return the result of a function of a block, given by its number."""

        def result(number: int) -> Any:
            rows = (array[self.slices[number]] for array in by_frame)
            return function(self.read(number), *rows)

        return result

    def subset(self, frames: NDArray) -> Self:
        """Return blocks of some frames, by a mask (n_frames,). Blocks are arrays."""
        length = max(self.lengths[:-1] or self.lengths)
        if self.cached:
            return self.of_array(self.joined(getitem, frames), length, self.n_threads)
        chosen, ends = np.flatnonzero(frames), np.cumsum(self.lengths)

        def rows(part: slice) -> NDArray:
            wanted = chosen[part]
            first, last = np.searchsorted(ends, wanted[[0, -1]], side="right")
            blocks = [self.read(number) for number in range(first, last + 1)]
            return np.concatenate(blocks)[wanted - self.slices[first].start]

        return self.read_later(rows, len(chosen), length, self.n_threads)

    @one_blas_thread()
    def joined(self, function: Callable[..., Any], *by_frame: NDArray) -> Any:
        """Join the results of a function of each block: arrays, or tuples of them."""
        parts = list(self.map(function, *by_frame)) or [function(self.empty)]
        if isinstance(parts[0], tuple):
            joined = map(np.concatenate, zip(*parts, strict=True))
            return getattr(parts[0], "_make", tuple)(joined)
        return np.concatenate(parts)

    # On dask the result stays on the workers.
    collect = joined

    def take(self, frames: NDArray) -> NDArray:
        """Return different frames (n_chosen,) in any order. Blocks are arrays."""
        chosen = np.isin(np.arange(self.n_frames), frames)
        block: NDArray = self.joined(getitem, chosen)
        in_order = (np.diff(frames) > 0).all()
        return block if in_order else block[np.argsort(np.argsort(frames))]

    def whole(self) -> NDArray:
        """Return all frames. Blocks are arrays."""
        return self.joined(lambda block: block)

    def as_collected(self, values: NDArray) -> Any:
        """Return an array (n_frames, ...) in the form that `collect` returns."""
        return values

    def regrouped(self, join: Callable[[list[Any]], Any], n_frames: int) -> Self:
        """Join consecutive blocks in memory into blocks of at most n_frames frames."""
        if not self.cached:
            return self
        together = max(n_frames // max(self.lengths), 1)
        numbers = range(len(self.lengths))
        groups = [numbers[part] for part in gen_batches(len(numbers), together)]
        blocks = [join(list(map(self.read, group))) for group in groups]
        lengths = [sum(self.lengths[number] for number in group) for group in groups]
        return self.of_blocks(blocks, lengths, self.n_threads)


class DaskBlocks(FrameBlocks):
    """Blocks, a sequence of Delayed, on the workers of the active dask scheduler.

    Derived blocks stay on the workers, or are computed again if one is lost. Only `map`
    brings results back. Blocks without frames are left out.
    """

    def __init__(self, blocks: Sequence[Any], lengths: Sequence[int]):
        filled = np.flatnonzero(lengths).tolist()
        self.blocks = [blocks[number] for number in filled]
        super().__init__(self.blocks.__getitem__, [lengths[k] for k in filled], False)

    @classmethod
    def of_chunks(cls, table: Any) -> Self:
        """Return the chunks of a dask array (n_frames, 2 * n_points)."""
        if np.isnan(table.shape[0]):
            table = table.compute_chunk_sizes()
        table = table.rechunk({1: -1})
        return cls(table.to_delayed().ravel(), table.chunks[0])

    def map(self, function: Callable[..., Any], *by_frame: NDArray) -> Iterator[Any]:
        """Return the results of a function of each block, in order."""
        return iter(self._run("compute", self._tasks(function, *by_frame)))

    def derive(self, function: Callable, *by_frame: NDArray, kept: bool = True) -> Self:
        """Return new blocks, the results of a function of each of these."""
        tasks = self._tasks(function, *by_frame)
        derived = type(self)(self._run("persist", tasks), self.lengths)
        derived.empty = self.empty
        return derived

    def subset(self, frames: NDArray) -> Self:
        """Return blocks of some frames, by a mask (n_frames,). Blocks are arrays."""
        lengths = [int(frames[rows].sum()) for rows in self.slices]
        return type(self)(self.derive(getitem, frames).blocks, lengths)

    def collect(self, function: Callable[..., Any], *by_frame: NDArray) -> Any:
        """Return dask arrays, or a named tuple of them, that are not computed yet."""
        array = import_optional("dask.array", extra="dask")
        tasks, empty = self._tasks(function, *by_frame), function(self.empty)

        def joined(empty: NDArray, tasks: list[Any]) -> Any:
            shapes = [(length, *empty.shape[1:]) for length in self.lengths]
            parts = map(array.from_delayed, tasks, shapes, [empty.dtype] * len(tasks))
            return array.concatenate(list(parts))

        if not isinstance(empty, tuple):
            return joined(empty, tasks)
        columns = ([task[i] for task in tasks] for i in range(len(empty)))
        return getattr(empty, "_make", tuple)(map(joined, empty, columns))

    def as_collected(self, values: NDArray) -> Any:
        """Return an array (n_frames, ...) as a dask array with these blocks' chunks."""
        array = import_optional("dask.array", extra="dask")
        return array.from_array(values, (tuple(self.lengths), *values.shape[1:]))

    def _tasks(self, function: Callable[..., Any], *by_frame: NDArray) -> list[Any]:
        """Return the tasks that compute a function of each block."""
        dask = import_optional("dask", extra="dask")
        run = dask.delayed(function, pure=False, traverse=False)
        rows = [map(array.__getitem__, self.slices) for array in by_frame]
        return list(map(run, self.blocks, *rows))

    def _run(self, how: str, tasks: list[Any]) -> Any:
        """Call dask.compute or dask.persist, without a warning of the tasks' size."""
        with warnings.catch_warnings():
            # Cameras and coefficients of the frames of a block go with each task.
            warnings.filterwarnings("ignore", "Sending large graph")
            return getattr(import_optional("dask", extra="dask"), how)(*tasks)


def in_threads(
    function: Callable[[int], Any], numbers: range, n_threads: int
) -> Iterator[Any]:
    """Yield the results for all numbers in order, computed by threads.

    At most one number more than there are threads is taken ahead, so that few results
    are in memory. After an error or an interrupt no other number is begun.
    """
    pool, ahead = ThreadPoolExecutor(n_threads), deque[Future[Any]]()
    try:
        for number in numbers:
            ahead.append(pool.submit(function, number))
            if len(ahead) > n_threads:
                yield ahead.popleft().result()
        while ahead:
            yield ahead.popleft().result()
    finally:
        pool.shutdown(cancel_futures=True)


def block_slices(n_frames: int, block_frames: int) -> list[slice]:
    """Return slices of block_frames frames; the last one may have one more, or fewer.

    Products with a single frame round differently.
    """
    starts = list(range(0, max(n_frames - 1, min(n_frames, 1)), block_frames))
    return list(map(slice, starts, [*starts[1:], n_frames]))


def read_rows(table: Any, rows: slice) -> NDArray:
    """Return rows of a table; the pages of a memory map do not stay in memory."""
    block = np.array(table[rows])
    mapped = getattr(table, "_mmap", None)
    # Mode "c" is copy on write: pages that were changed are in memory only.
    if mapped is not None and hasattr(mapped, "madvise") and table.mode != "c":
        mapped.madvise(mmap.MADV_DONTNEED)
    return block


def _share_of_x(rows: NDArray) -> NDArray:
    """Return the share (n_frames,) of x in the energy of rows (n_frames, 2, n_points).

    NaN counts as zero.
    """
    x, y = np.nansum(np.square(rows, dtype=np.float64), axis=2).T
    energy = x + y
    return np.divide(x, energy, where=energy > 0, out=np.zeros_like(energy))


def spread(order: NDArray, n: int) -> NDArray:
    """Return n entries of an order at equal distances, ends included; at most all."""
    n = min(n, len(order))
    return order[np.linspace(0, len(order) - 1, n).round().astype(int)]


def point_patterns(seen: NDArray) -> tuple[NDArray, NDArray]:
    """Return the different rows of a mask (n, J), and the index (n,) of each row."""
    bits = np.packbits(seen, axis=1)
    _, first, pattern = np.unique(bits, axis=0, return_index=True, return_inverse=True)
    return seen[first], pattern.reshape(-1)


def representative_frames(rows: FrameBlocks, most: int) -> NDArray:
    """
    Return indices of about `most` frames of rows (I, 2, J), for the model of a table.

    They are spread evenly over the frames in the order of their share of x, which does
    not depend on the order of the table. For each point that few of them show, frames
    that show it are added.
    """
    if rows.n_frames <= most:
        return np.arange(rows.n_frames)
    order = np.argsort(rows.joined(_share_of_x), kind="stable")
    chosen = np.isin(np.arange(rows.n_frames), spread(order, most))
    fewest = min(200, most // 5)
    counts = sum(rows.map(lambda b, kept: (~np.isnan(b[kept, 0])).sum(axis=0), chosen))
    for point in np.flatnonzero(counts < fewest).tolist():
        shows = rows.joined(lambda block, j=point: ~np.isnan(block[:, 0, j]))
        chosen[spread(order[shows[order]], fewest)] = True
    return np.flatnonzero(chosen)


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
) -> FrameBlocks:
    """Return a table in blocks of rows (n, 2, n_points), float32 or float64.

    Points with one coordinate become missing, with a warning. With `counted`, those of
    a table that is read later stay: `scaled_table` counts them and leaves them out.

    Arrays in memory must be checked already. `n_jobs` threads share their blocks and
    those of memory maps. Chunks of dask stay on its workers. Blocks of tables that are
    read later use at most the working memory of scikit-learn's configuration.
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
        # A block needs at most eight times its own memory, copies included.
        memory = 2**20 * get_config()["working_memory"]
        limit = max(int(memory / 8 // (n_columns * np.dtype(float).itemsize)), 1)
        if isinstance(X, np.memmap):
            limit = min(limit, length)
        else:  # row groups of parquet files are read whole for each block
            n_threads = 1
        read = partial(read_rows, X)
        blocks = FrameBlocks.read_later(read, X.shape[0], limit, n_threads)
    blocks = blocks.derive(partial(_rows, layout=layout, counted=counted))
    blocks.empty = empty
    return blocks


def _rows(X: Any, layout: Layout, counted: bool) -> NDArray:
    """Return the rows (n, 2, n_points) of a block, as `open_table` describes."""
    original = table_to_rows(checked_rows(X), layout)
    rows, n_half, _ = without_half_points(original)
    if n_half.any() and not counted:
        warn_caller(
            "some points have only one of their two coordinates. They count as missing"
        )
    return original if counted else rows


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
