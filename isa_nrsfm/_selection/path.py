"""Fits of one table, and of parts of it, with more and more basis shapes.

The table is checked, centred and scaled once. The fit of all frames starts from the one
with fewer basis shapes: from its shapes, and the leading directions of what they leave.
The fit of a fold, the frames that are not held out, starts from the fit of all frames
and from that of the fold itself with fewer basis shapes. The one with the lower
objective on the fold goes on: frames that are held out may offer a start, but only
those that are fitted choose. The first fits, with the fewest basis shapes, search for
their starts as `AffineNRSfM.fit` does.
"""

import time
import warnings
from collections.abc import Callable, Iterator, Sequence
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray
from sklearn.base import clone
from sklearn.exceptions import ConvergenceWarning
from sklearn.utils.parallel import Parallel, delayed

from isa_nrsfm._compat.callbacks import NoProgress
from isa_nrsfm._compat.scikit_learn import taken_rows
from isa_nrsfm._estimator import AffineNRSfM, CheckedTable
from isa_nrsfm._fit import fit_ready_table, ready_table
from isa_nrsfm._frames.models import PosteriorFrames
from isa_nrsfm._joint.fit import Start
from isa_nrsfm._joint.starts import extended_shapes
from isa_nrsfm._prepare.checks import (
    PointReport,
    check_points,
    check_size,
)
from isa_nrsfm._prepare.scaling import ScaledTable
from isa_nrsfm._tables.ordering import spread
from isa_nrsfm._tables.visibility import seen_points

# Frames, at most, from which the directions of further basis shapes are found. They are
# only a start.
EXTENDING_FRAMES = 200

# The fits of all frames are only starts, too: their tolerance is so many times larger.
LOOSER = 4.0


class Split(NamedTuple):
    """
    A split of a table into rows that are fitted and rows that are held out.

    Attributes
    ----------
    train, test : ndarray of int
        Numbers of the rows.
    """

    train: NDArray
    test: NDArray


class Row(NamedTuple):
    """
    What the path tells of one number of basis shapes.

    Attributes
    ----------
    n_components : int
        K.
    scores : ndarray of shape (n_splits,)
        Scores of the rows that are held out.
    fit_seconds, score_seconds : ndarray of shape (n_splits,)
        Seconds of the fits of the other rows, and of the scores.
    path_seconds : float
        Seconds of the fit of all rows; zero where no fit starts from it.
    n_unconverged : int
        How many of these fits did not converge.
    """

    n_components: int
    scores: NDArray
    fit_seconds: NDArray
    score_seconds: NDArray
    path_seconds: float
    n_unconverged: int


# Scores a fitted estimator on the rows of a split that are held out.
Scorer = Callable[[AffineNRSfM, Split], float]


class Part(NamedTuple):
    """
    All of a table, or the rows of it that a split fits, ready for fits.

    Attributes
    ----------
    X : array-like of shape (n_rows, 2 * n_points)
        All of the table, as it was given.
    checked : CheckedTable
        All of the table, checked.
    scaled : ScaledTable
        The part.
    split : Split or None
        None for all of the table.
    """

    X: Any
    checked: CheckedTable
    scaled: ScaledTable
    split: Split | None = None


class _Fitted(NamedTuple):
    """A fit of a part."""

    frames: Any  # the model of a frame, from which other fits may start
    score: float
    fit_seconds: float
    score_seconds: float
    unconverged: bool


def ready_part(estimator: AffineNRSfM, X: Any, n_components: int) -> Part:
    """
    Return a table, checked and scaled once for all fits.

    Parameters
    ----------
    estimator : AffineNRSfM
        The estimator. Its own `n_components` is not used.
    X : array-like of shape (n_rows, 2 * n_points)
        The table, in memory or a memory map.
    n_components : int
        The largest number of basis shapes that is to be fitted.

    Returns
    -------
    Part
        All of the table.

    Raises
    ------
    ValueError
        If the table is not what `AffineNRSfM` takes, or not enough.
    """
    checked = CheckedTable.of(estimator, X)
    return Part(X, checked, ready_table(checked.source, n_components, checked.options))


def walk(
    whole: Part,
    candidates: Sequence[int],
    splits: Sequence[Split],
    scorer: Scorer,
    *,
    any_basis: bool = False,
    n_jobs: int | None = None,
) -> Iterator[Row]:
    """
    Yield scores of rows that are held out, for more and more basis shapes.

    Parameters
    ----------
    whole : Part
        All of the table. Without the joint refinement no fit starts from another one.
    candidates : sequence of int
        Numbers of basis shapes, ascending.
    splits : sequence of Split
        What is fitted, and what is held out.
    scorer : callable
        Scores a fitted estimator on the rows of a split that are held out.
    any_basis : bool, default=False
        Whether the score is the same for any basis of the deformations. Then no basis
        is looked for that `independence` asks for.
    n_jobs : int, default=None
        How many splits are fitted at the same time, as of joblib.

    Yields
    ------
    Row
        For each of the candidates.

    Raises
    ------
    ValueError
        If the part of the table that is fitted in a split is not enough for one of the
        candidates.
    """
    checked, table = whole.checked, whole.scaled
    if any_basis:
        checked = checked._replace(options=checked.options._replace(independence=None))
    joint = checked.options.joint
    looser = checked.options._replace(tol=LOOSER * checked.options.joint_tol)
    parts = [whole._replace(checked=checked._replace(options=looser))]
    for number, split in enumerate(splits):
        scaled = table.part(_mask(split.train, len(table.shown)))
        _check_part(scaled, f"split {number}", candidates[-1], checked)
        parts.append(Part(whole.X, checked, scaled, split))
    before: list[Any] = [None] * len(parts)
    with Parallel(n_jobs=n_jobs) as parallel:
        for k in candidates:
            # Fits of all frames are only for others to start from.
            every = _fitted(parts[0], k, scorer, before[0]) if joint else None
            folds = parallel(
                delayed(_fitted)(part, k, scorer, frames, every)
                for part, frames in zip(parts[1:], before[1:], strict=True)
            )
            yield _row(k, folds, every)
            before = [every, *folds] if joint else before


def extended(frames: PosteriorFrames, table: ScaledTable, n_components: int) -> Start:
    """
    Return the start of a fit with more basis shapes than another fit.

    Parameters
    ----------
    frames : PosteriorFrames
        The other fit.
    table : ScaledTable
        The frames that were fitted.
    n_components : int
        The number of basis shapes wanted.

    Returns
    -------
    Start
        The shapes of the other fit, and the leading directions of what they leave.
    """
    n_frames = table.rows.n_frames
    few = spread(np.arange(n_frames), min(n_frames, EXTENDING_FRAMES))
    rows = table.rows.take(few)
    fit = frames.posterior(rows.transpose(0, 2, 1))
    n_more = n_components + 1 - len(frames.shapes)
    rows = rows - fit.translation[:, :, None]
    shapes = extended_shapes(rows, frames.shapes, fit.motion, fit.alpha, n_more)
    return Start(shapes, frames.noise_variance)


def _mask(rows: NDArray, n_rows: int) -> NDArray:
    """Return which of n_rows rows are among some."""
    mask = np.zeros(n_rows, dtype=bool)
    mask[rows] = True
    return mask


def _check_part(
    part: ScaledTable, name: str, n_components: int, checked: CheckedTable
) -> None:
    """Refuse a part of a table that is not enough for so many basis shapes."""
    n_frames, options = len(part.sizes), checked.options
    report = PointReport.merged(list(part.rows.map(_point_report)))

    def refused(k: int) -> ValueError | None:
        try:
            check_size(n_frames, part.n_points, k)
            check_points(report, part.n_seen, k, options.layout, options.names)
        except ValueError as error:
            return error
        return None

    error = refused(n_components)
    if error is None:
        return
    allowed = (k for k in range(n_components - 1, 0, -1) if refused(k) is None)
    raise ValueError(
        f"{name} of cv fits {n_frames} frames, enough for n_components="
        f"{next(allowed, 0)} at most: {error}"
    ) from error


def _point_report(rows: NDArray) -> PointReport:
    """Return in which frames of some rows (n_frames, 2, n_points) points are seen."""
    return PointReport.from_seen(seen_points(rows.transpose(0, 2, 1)))


def _fitted(
    part: Part,
    n_components: int,
    scorer: Scorer,
    before: _Fitted | None,
    every: _Fitted | None = None,
) -> _Fitted:
    """
    Return the fit of a part, with its score if it is that of a split.

    Parameters
    ----------
    part : Part
        The part.
    n_components : int
        K.
    scorer : callable
        As of `walk`.
    before : _Fitted or None
        The fit of the same part with fewer basis shapes. Without it a fit searches for
        its starts.
    every : _Fitted or None, default=None
        The fit of all of the table with K basis shapes.

    Returns
    -------
    _Fitted
        The fit.
    """
    since = time.perf_counter()
    checked, split = part.checked, part.split
    with warnings.catch_warnings(record=True) as told:
        warnings.simplefilter("ignore")  # the last fit says what is wrong
        warnings.simplefilter("always", ConvergenceWarning)
        if checked.options.joint:
            starts = []
            if before is not None:
                starts.append(extended(before.frames, part.scaled, n_components))
            if every is not None:
                known = Start(every.frames.shapes, every.frames.noise_variance)
                if before is None and checked.options.camera == "affine":
                    starts.append(known)
                starts.append(known._replace(calibrated_first=True))
            fit = fit_ready_table(
                part.scaled, n_components, checked.options, NoProgress(), starts
            )
            model, frames = checked.fitted(fit, part.scaled.source), fit.model.frames
        else:
            model, frames = clone(checked.estimator), None
            rows = slice(None) if split is None else split.train
            model.set_params(n_components=n_components).fit(taken_rows(part.X, rows))
        fitted = time.perf_counter()
        score = np.nan if split is None else scorer(model, split)
    end = time.perf_counter()
    return _Fitted(frames, score, fitted - since, end - fitted, bool(told))


def _row(k: int, folds: Sequence[_Fitted], every: _Fitted | None) -> Row:
    """Return what the fits of the folds, and of all frames, tell of K."""
    fits = [*folds] if every is None else [*folds, every]
    return Row(
        k,
        np.array([fit.score for fit in folds]),
        np.array([fit.fit_seconds for fit in folds]),
        np.array([fit.score_seconds for fit in folds]),
        0.0 if every is None else every.fit_seconds,
        sum(fit.unconverged for fit in fits),
    )
