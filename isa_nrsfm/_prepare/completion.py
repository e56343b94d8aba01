"""Completion of tracks with missing points by a low-rank model of the table.

Each row of the measurement matrix is modelled as ``w = B^T z + t 1 + noise`` over its
seen points. The coefficients have the prior z ~ N(0, I), the translation t has none,
and the noise has one variance everywhere. This is probabilistic principal component
analysis (Tipping and Bishop 1999) with missing values (Ilin and Raiko 2010). B has the
rank of the factorisation, 3K + 3.

EM finds B. The rank is raised step by step from 3, that of a rigid object. The
posterior covariance of z depends on a row only through its *pattern*, the set of its
seen points. It is computed once for each distinct pattern; the two rows of a frame
share one.
"""

from collections.abc import Iterator
from functools import partial
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import eigh

from isa_nrsfm._linalg.rounding import OF_DIFFERENCES, OF_STEPS
from isa_nrsfm._prepare.options import COMPLETION_OPTIONS, CompletionOptions
from isa_nrsfm._tables.blocks import FrameBlocks
from isa_nrsfm._tables.ordering import representative_frames, spread

RIGID_RANK = 3


class Completion(NamedTuple):
    """
    Complete tracks.

    Attributes
    ----------
    centred : ndarray of shape (n_frames, n_points, 2)
        Tracks without missing points, each frame centred over all of its points. Seen
        points are the given ones minus the shift.
    shift : ndarray of shape (n_frames, 2)
        Centroid of all points of a frame relative to that of its seen points.
    """

    centred: NDArray
    shift: NDArray


class _Frames(NamedTuple):
    """Frames sorted by their patterns, the distinct sets of seen points.

    ``rows`` (n_frames, 2, n_points) are centred over the seen points, and zero where
    not seen. ``pattern`` (n_frames,) is the index of each frame's pattern, increasing.
    ``patterns`` (n_patterns, n_points) are 1.0 where seen and 0.0 elsewhere.
    """

    rows: NDArray
    pattern: NDArray
    patterns: NDArray

    def of_points(self, points: NDArray) -> "tuple[_Frames, NDArray, NDArray]":
        """Return frames with only some points, which frames these are, and a shift.

        Frames that see none of the points are left out of them. The shift (n_kept, 2)
        is the centroid of the points that are left.
        """
        patterns = self.patterns[:, points]
        kept = np.flatnonzero(patterns.sum(axis=1)[self.pattern])
        pattern = self.pattern[kept]
        rows, seen = self.rows[kept][:, :, points], patterns[pattern]
        shift = rows.sum(axis=2) / seen.sum(axis=1)[:, None]
        rows = (rows - shift[:, :, None]) * seen[:, None]
        return _Frames(rows, pattern, patterns), kept, shift


class _Posterior(NamedTuple):
    """Posterior of the coefficients and translations of a block of frames.

    ``z`` (n_frames, 2, rank) and ``t`` (n_frames, 2, 1) are the posterior means. For
    each pattern of the block, ``covariance`` (n_patterns, rank, rank) is the posterior
    covariance of z, and ``cross`` (n_patterns, rank) that of z with -t. Both are
    divided by the noise variance.
    """

    z: NDArray
    t: NDArray
    covariance: NDArray
    cross: NDArray


class CompletionModel(NamedTuple):
    """
    Low-rank model of the rows of a measurement matrix.

    Attributes
    ----------
    B : ndarray of shape (rank, n_points)
        Directions, rows centred.
    noise : float
        Noise variance of a coordinate.
    """

    B: NDArray
    noise: float

    @property
    def ridge(self) -> float:
        """The noise variance, bounded below so that matrices can be inverted."""
        return max(self.noise, OF_STEPS)


def complete_tracks(
    centred: NDArray,
    sizes: NDArray,
    n_components: int,
    options: CompletionOptions = COMPLETION_OPTIONS,
) -> Completion:
    """
    Return tracks with their missing points filled in, as a start for the factorisation.

    Missing points get their posterior means, given the seen points of their frame, in a
    model of rank 3K + 3. They are exact where the table has that rank and no noise, and
    each frame sees at least 3K + 4 points. With fewer points the prior of the model
    fills what they leave open.

    Parameters
    ----------
    centred : ndarray of shape (n_frames, n_points, 2)
        Tracks, centred over the seen points of each frame, NaN where not seen. Each
        frame must see at least one point and each point must be seen in some frame.
    sizes : ndarray of shape (n_frames,)
        What each frame is divided by before frames are compared.
    n_components : int
        K, the number of basis shapes.
    options : CompletionOptions
        Steps and limits of EM.

    Returns
    -------
    Completion
        Complete tracks. Tracks without missing points are returned as they are.
    """
    if not np.isnan(centred).any():
        return Completion(centred, np.zeros((len(centred), 2)))
    rows = _unit_rows(centred, sizes)
    filled, shift = filled_in(
        rows, completion_model(rows, n_components, options), options
    )
    scale = sizes[:, None, None]
    return Completion(scale * filled.transpose(0, 2, 1), sizes[:, None] * shift)


def _unit_rows(centred: NDArray, sizes: NDArray) -> NDArray:
    """Return tracks (n_frames, n_points, 2) as frames (n_frames, 2, n_points)."""
    return np.ascontiguousarray((centred / sizes[:, None, None]).transpose(0, 2, 1))


def complete_rows(
    rows: FrameBlocks,
    n_points: int,
    n_components: int,
    options: CompletionOptions = COMPLETION_OPTIONS,
) -> FrameBlocks:
    """
    Return the frames of a table with their missing points filled in.

    Parameters
    ----------
    rows : FrameBlocks
        Blocks of frames (n_frames, 2, n_points) of size one, centred over the points
        that are seen; NaN where a point is not seen.
    n_points : int
        Number of points.
    n_components : int
        K, the number of basis shapes.
    options : CompletionOptions
        Steps and limits of EM.

    Returns
    -------
    FrameBlocks
        The frames, centred over all points, as of `complete_tracks`. The model of a
        table with many frames is that of some of them.
    """
    # Of many points fewer frames are enough, for as many numbers.
    most = options.model_frames * options.model_points // n_points
    most = np.clip(most, options.fewest_shown, options.model_frames)
    frames = representative_frames(rows, n_points, int(most), options.fewest_shown)
    model = completion_model(rows.take(frames), n_components, options)
    return rows.derive(partial(_filled_rows, model=model, options=options))


def _filled_rows(
    rows: NDArray, model: CompletionModel, options: CompletionOptions
) -> NDArray:
    """Return frames (n_frames, 2, n_points) with their missing points filled in."""
    return filled_in(rows, model, options)[0]


def completion_model(
    rows: NDArray,
    n_components: int,
    options: CompletionOptions = COMPLETION_OPTIONS,
) -> CompletionModel:
    """
    Return the low-rank model that missing points are filled in with.

    Parameters
    ----------
    rows : ndarray of shape (n_frames, 2, n_points)
        Frames of size one, centred over the seen points, NaN where not seen.
    n_components, options
        As of `complete_rows`.

    Returns
    -------
    CompletionModel
        The model.
    """
    rank = _possible_rank(3 * n_components + 3, rows.shape[2])
    frames, _ = _by_pattern(rows)
    points = _model_points(frames, options.model_points)
    if points is None:
        return _fit(frames, rank, options)
    part, kept, shift = frames.of_points(points)
    model = _fit(part, _possible_rank(rank, len(points)), options)
    model = _of_all_points(model, part, frames, kept, shift, options)
    return _converged(model, frames, options.max_iter, options, is_fitted=True)[0]


def filled_in(
    rows: NDArray,
    model: CompletionModel,
    options: CompletionOptions = COMPLETION_OPTIONS,
) -> tuple[NDArray, NDArray]:
    """
    Return frames with the posterior means of a low-rank model as missing points.

    Parameters
    ----------
    rows : ndarray of shape (n_frames, 2, n_points)
        Frames of size one, centred over the seen points, NaN where not seen.
    model : CompletionModel
        The model.
    options : CompletionOptions
        The size of blocks.

    Returns
    -------
    filled : ndarray of shape (n_frames, 2, n_points)
        The frames, centred over all points.
    shift : ndarray of shape (n_frames, 2)
        The centroids of all points that were subtracted.
    """
    frames, order = _by_pattern(rows)
    filled = np.empty(rows.shape)
    for block, posterior, seen in _posteriors(frames, model, options.block_numbers):
        expected = posterior.z @ model.B + posterior.t
        filled[order[block]] = np.where(seen[:, None] > 0, frames.rows[block], expected)
    shift = filled.mean(axis=2)
    filled -= shift[:, :, None]
    return filled, shift


def rigid_noise(centred: NDArray, sizes: NDArray) -> float:
    """
    Return the mean square residual of tracks after the fit of a rigid object.

    Parameters
    ----------
    centred : ndarray of shape (n_frames, n_points, 2)
        Tracks, centred over the seen points of each frame, NaN where not seen.
    sizes : ndarray of shape (n_frames,)
        What each frame is divided by.

    Returns
    -------
    float
        Noise variance of one coordinate in the model of rank 3, relative to the
        squared sizes.
    """
    frames, _ = _by_pattern(_unit_rows(centred, sizes))
    points = _model_points(frames, COMPLETION_OPTIONS.model_points)
    if points is not None:
        frames, _, _ = frames.of_points(points)
    rank = _possible_rank(RIGID_RANK, frames.rows.shape[2])
    return _fit(frames, rank, COMPLETION_OPTIONS).noise


def _possible_rank(rank: int, n_points: int) -> int:
    """Return the rank, limited to n_points - 2.

    Centred points have n_points - 1 directions, of which the noise needs one.
    """
    return max(1, min(rank, n_points - 2))


def _by_pattern(rows: NDArray) -> tuple[_Frames, NDArray]:
    """Return frames sorted by pattern, and the order (n_frames,) that sorts them.

    Rows are (n_frames, 2, n_points), NaN where not seen.
    """
    seen = ~np.isnan(rows).any(axis=1)
    _, first, pattern = np.unique(
        np.packbits(seen, axis=1), axis=0, return_index=True, return_inverse=True
    )
    pattern = pattern.reshape(-1)
    order = np.argsort(pattern, kind="stable")
    filled = np.where(seen[:, None], rows, 0.0)
    return _Frames(filled[order], pattern[order], seen[first].astype(float)), order


def _model_points(frames: _Frames, most: int) -> NDArray | None:
    """Return the points from which the model of many points is found first.

    They are spread evenly over the points in the order of their mean energy, so that
    they do not depend on the order of the points. None stands for all points.
    """
    if frames.rows.shape[2] <= most:
        return None
    n_shown = np.bincount(frames.pattern) @ frames.patterns
    energy = np.einsum("icj,icj->j", frames.rows, frames.rows) / n_shown
    return np.sort(spread(np.argsort(energy, kind="stable"), most))


def _fit(frames: _Frames, rank: int, options: CompletionOptions) -> CompletionModel:
    """Return the model of frames by EM, the rank raised from that of a rigid object."""
    # The rank at most doubles from one to the next.
    ranks = [rank]
    while ranks[0] > RIGID_RANK:
        ranks.insert(0, max(RIGID_RANK, (ranks[0] + 1) // 2))
    residual = frames.rows
    model = CompletionModel(np.zeros((0, residual.shape[2])), np.inf)
    for wanted in ranks:
        model = _grown(model, wanted, residual, frames, options.least_weight)
        last = wanted == rank
        most = options.max_iter if last else options.steps_while_growing
        model, residual = _converged(model, frames, most, options)
    return model


def _converged(
    model: CompletionModel,
    frames: _Frames,
    most_steps: int,
    options: CompletionOptions,
    is_fitted: bool = False,
) -> tuple[CompletionModel, NDArray]:
    """Return the model after steps of EM, and the residual (n_frames, 2, n_points).

    The noise of a model that is not fitted yet is only a guess.
    """
    for step in range(most_steps):
        before = model.noise
        model, residual, mean_square = _em_step(model, frames, options)
        falls = model.noise <= (1.0 - options.tol) * before
        stands_still = (is_fitted or step > 0) and not falls
        if stands_still or mean_square < options.exact:
            break
    return model, residual


def _grown(
    model: CompletionModel,
    rank: int,
    residual: NDArray,
    frames: _Frames,
    least_weight: float,
) -> CompletionModel:
    """Return the model with further rows of B, the principal axes of its residual.

    The residual is (n_frames, 2, n_points). The first model is that of the rows.
    """
    is_first = not len(model.B)
    moment = _second_moment(residual, frames, is_first)
    n_points = len(moment)
    n_new = rank - len(model.B)
    values, axes = eigh(moment, subset_by_index=[n_points - n_new, n_points - 1])
    weights = np.maximum(values, least_weight * max(values[-1], OF_STEPS))
    noise = model.noise
    if is_first:
        rest = (np.trace(moment) - values.sum()) / n_points
        noise = max(rest, least_weight**2 * values[-1], OF_STEPS)
    return CompletionModel(np.vstack([model.B, (axes * np.sqrt(weights)).T]), noise)


def _second_moment(rows: NDArray, frames: _Frames, is_object: bool) -> NDArray:
    """
    Return the second moment (n_points, n_points) of rows (n_frames, 2, n_points).

    The difference of two points in a row does not depend on the row's translation. Its
    mean square is taken over all rows that see both points. Double centring turns these
    mean squares into the second moment (classical scaling, Torgerson 1952).

    Where no frame sees both points the mean square is guessed. For rows of an object it
    is the largest one, because such points are likely to be far apart. Residuals are
    taken as uncorrelated: it is the sum of their two mean squares.
    """
    seen = frames.patterns[frames.pattern]
    counts = 2.0 * seen.T @ seen
    flat = rows.reshape(-1, rows.shape[2])
    square = np.einsum("icj,icj->ij", rows, rows).T @ seen
    distances = square + square.T - 2.0 * flat.T @ flat
    together = counts > 0
    distances = np.divide(distances, counts, where=together, out=np.zeros_like(counts))
    if is_object:
        distances[~together] = distances.max()
    else:
        energy = np.diag(square) / np.maximum(np.diag(counts), 1.0)
        distances[~together] = np.add.outer(energy, energy)[~together]
    distances -= distances.mean(axis=0)
    distances -= distances.mean(axis=1, keepdims=True)
    return -0.5 * distances


def _posteriors(
    frames: _Frames, model: CompletionModel, block_numbers: int
) -> Iterator[tuple[slice, _Posterior, NDArray]]:
    """
    Yield blocks of frames, their posteriors, and their seen points (n, n_points).

    With B_c the seen columns of B, its rows centred over them, ``C = (B_c B_c^T +
    ridge I)^-1`` is the posterior covariance over the noise variance, and ``z = w B^T
    C``, ``t = -z . mean(B)`` are the posterior means.
    """
    B, ridge = model.B, model.ridge
    rank = len(B)
    upper = np.triu_indices(rank)
    products = (B[upper[0]] * B[upper[1]]).T
    n_frames = len(frames.rows)
    length = max(1, block_numbers // max(rank**2, 2 * B.shape[1]))
    for start in range(0, n_frames, length):
        block = slice(start, min(start + length, n_frames))
        pattern = frames.pattern[block]
        seen = frames.patterns[pattern[0] : pattern[-1] + 1]
        pattern = pattern - pattern[0]
        n_seen = seen.sum(axis=1)
        # B_c B_c^T for each pattern. Centring integrates the translation out.
        sums = seen @ B.T
        means = sums / n_seen[:, None]
        gram = _symmetric(seen @ products, rank, upper)
        gram -= sums[:, :, None] * means[:, None]
        gram[:, range(rank), range(rank)] += ridge
        covariance = np.linalg.inv(gram)
        cross = (covariance @ means[:, :, None])[:, :, 0]
        z = (frames.rows[block] @ B.T) @ covariance[pattern]
        t = -(z @ means[pattern][:, :, None])
        yield block, _Posterior(z, t, covariance, cross), seen[pattern]


def _em_step(
    model: CompletionModel, frames: _Frames, options: CompletionOptions
) -> tuple[CompletionModel, NDArray, float]:
    """
    Return the model after one step of EM, and the residual before it.

    The residual (n_frames, 2, n_points) is followed by its mean square.
    """
    rows, ridge = frames.rows, model.ridge
    rank, n_points = model.B.shape
    upper = np.triu_indices(rank)
    residual = np.empty_like(rows)
    moments = np.zeros((n_points, len(upper[0])))
    products = np.zeros((n_points, rank))
    moment = np.zeros(len(upper[0]))
    energy = n_fitted = 0.0
    # E step: sufficient statistics. `squares` are sums of E[z z^T] over the rows of a
    # pattern, packed; `moments` their sums over the patterns that show each point;
    # `products` sums of E[(w - t) z] for each point.
    blocks = _posteriors(frames, model, options.block_numbers)
    for block, (z, t, covariance, cross), seen in blocks:
        moved = (rows[block] - t) * seen[:, None]
        residual[block] = moved - (z @ model.B) * seen[:, None]
        energy += float(np.vdot(residual[block], residual[block]))
        pattern = frames.pattern[block]
        first = np.flatnonzero(np.diff(pattern, prepend=-1))
        n_rows = 2.0 * np.diff(first, append=len(pattern))
        # Effective number of parameters of a row: the coefficients that its points
        # rather than the prior determine, and the translation.
        n_determined = rank - ridge * np.trace(covariance, axis1=1, axis2=2)
        n_fitted += float(n_rows @ (n_determined + 1.0))

        noise = ridge * n_rows[:, None]
        squares = (z.swapaxes(1, 2) @ z)[:, upper[0], upper[1]]
        squares = np.add.reduceat(squares, first)
        squares += noise * covariance[:, upper[0], upper[1]]
        moment += squares.sum(axis=0)
        of_pattern = seen[first]
        moments += of_pattern.T @ squares
        products += moved.reshape(-1, n_points).T @ z.reshape(-1, rank)
        products += of_pattern.T @ (noise * cross)
    n_numbers = 2.0 * np.bincount(frames.pattern) @ frames.patterns.sum(axis=1)

    # M step
    B = _columns(moments, products, len(rows))
    # Rescale so that the mean of E[z z^T] is I, as in the prior: parameter expansion,
    # which makes EM faster (Liu, Rubin and Wu 1998).
    mean_moment = _symmetric(moment[None], rank, upper)[0] / (2 * len(rows))
    B = np.linalg.cholesky(mean_moment).T @ B
    # Noise variance: residual energy over degrees of freedom. This is the fixed point
    # of EM's own step for the variance (MacKay 1992).
    freedom = max(n_numbers - n_fitted, options.least_freedom * n_numbers)
    return CompletionModel(B, energy / freedom), residual, energy / n_numbers


def _columns(moments: NDArray, products: NDArray, n_frames: int) -> NDArray:
    """Return B (rank, n_points), the least squares for each point.

    The arguments are, for each point, sums over the rows that see it: packed
    ``E[z z^T]`` (n_points, n_pairs) and ``E[(w - t) z]`` (n_points, rank).
    """
    rank = products.shape[1]
    per_point = _symmetric(moments, rank, np.triu_indices(rank))
    # A point seen in fewer rows than the rank needs the ridge.
    per_point[:, range(rank), range(rank)] += OF_DIFFERENCES * n_frames
    B: NDArray = np.linalg.solve(per_point, products[..., None])[..., 0].T
    return B - B.mean(axis=1, keepdims=True)  # the translation takes what is common


def _of_all_points(
    model: CompletionModel,
    part: _Frames,
    frames: _Frames,
    kept: NDArray,
    shift: NDArray,
    options: CompletionOptions,
) -> CompletionModel:
    """Return the model of some points, `part`, for all points: one M step.

    The part has only the kept frames (n_kept,), moved by the shift (n_kept, 2).
    """
    rank, n_points = len(model.B), frames.rows.shape[2]
    upper = np.triu_indices(rank)
    moments, products = np.zeros((n_points, len(upper[0]))), np.zeros((n_points, rank))
    for block, (z, t, _, _), _ in _posteriors(part, model, options.block_numbers):
        seen = frames.patterns[frames.pattern[kept[block]]]
        position = t + shift[block][:, :, None]
        moved = (frames.rows[kept[block]] - position) * seen[:, None]
        moments += seen.T @ (z.swapaxes(1, 2) @ z)[:, upper[0], upper[1]]
        products += moved.reshape(-1, n_points).T @ z.reshape(-1, rank)
    return CompletionModel(_columns(moments, products, len(part.rows)), model.noise)


def _symmetric(packed: NDArray, size: int, upper: tuple[NDArray, ...]) -> NDArray:
    """Return symmetric matrices (n, size, size) from upper triangles (n, n_pairs)."""
    full = np.empty((len(packed), size, size))
    full[:, upper[0], upper[1]] = packed
    full[:, upper[1], upper[0]] = packed
    return full
