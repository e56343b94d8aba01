"""Fits of one table, and of parts of it, with more and more basis shapes.

The table is checked, centred and scaled once. The fit of all frames starts from the one
with fewer basis shapes and the leading directions of its residuals. The fit of a fold
starts from the fit of all frames and from that of the fold itself with fewer basis
shapes. The one with the lower objective on the fold continues. So held-out frames can
contribute a start, but never select one. The first fits search for their starts as
`AffineNRSfM.fit` does.
"""

import copy
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
from isa_nrsfm._estimator import AffineNRSfM
from isa_nrsfm._fit import fit_ready_table, joint_camera, joint_tol, ready_table
from isa_nrsfm._frames.models import PosteriorFrames
from isa_nrsfm._joint.fit import Start
from isa_nrsfm._joint.starts import extended_shapes
from isa_nrsfm._prepare.checks import check_points, check_size, visible_points
from isa_nrsfm._prepare.scaling import ScaledTable
from isa_nrsfm._tables.ordering import spread

# Rows that are fitted, and rows that are held out.
Split = tuple[NDArray, NDArray]
# Scores a fitted estimator on the rows of a split that are held out.
Scorer = Callable[[AffineNRSfM, NDArray], float]


class Row(NamedTuple):
    """Scores, seconds and counts of failed convergence of one number of shapes."""

    n_components: int
    scores: NDArray
    fit_seconds: NDArray
    score_seconds: NDArray
    path_seconds: float
    n_unconverged: int


class Part(NamedTuple):
    """A table X, or its rows that a split fits, with parameters checked for it."""

    estimator: AffineNRSfM
    X: Any
    table: ScaledTable
    split: Split | None = None


class Fitted(NamedTuple):
    """The fit of a part: model of a frame, score, seconds, whether it converged."""

    frames: Any
    score: float
    fit_seconds: float
    score_seconds: float
    converged: bool


def ready_part(estimator: AffineNRSfM, X: Any, n_components: int) -> Part:
    """Return a table checked for fits of at most K basis shapes, and scaled."""
    estimator = clone(estimator)
    if estimator.refinement == "consensus":  # only of the chosen K
        estimator.refinement = "joint"
    source, _ = estimator._checked(X)
    return Part(estimator, X, ready_table(estimator, source, n_components))


def walk(
    whole: Part,
    candidates: Sequence[int],
    splits: Sequence[Split],
    scorer: Scorer,
    *,
    any_basis: bool = False,
    n_jobs: int | None = None,
) -> Iterator[Row]:
    """Yield scores of held-out rows, for ascending numbers of basis shapes.

    Each split is a pair of fitted and held-out rows. With `any_basis` the score does
    not depend on the basis, and no independent one is searched for. `n_jobs` splits are
    fitted at a time. Without the joint refinement no fit starts from another one.
    """
    estimator, _, table, _ = whole
    joint = estimator.refinement == "joint"
    if any_basis and joint:
        estimator.independence = None
    # Fits of all frames are only starts: their tolerance is larger.
    loose = copy.copy(estimator)
    loose.tol = 4.0 * joint_tol(estimator)
    parts = [whole._replace(estimator=loose)]
    for number, (train, held_out) in enumerate(splits):
        rows = np.zeros(len(table.shown), dtype=bool)
        rows[train] = True
        fitted = table.part(rows)
        _check_part(fitted, f"split {number}", candidates[-1], estimator)
        parts.append(whole._replace(table=fitted, split=(train, held_out)))
    before: list[Fitted | None] = [None] * len(parts)
    with Parallel(n_jobs=n_jobs) as parallel:
        for k in candidates:
            every = _fitted(parts[0], k, scorer, before[0]) if joint else None
            folds = parallel(
                delayed(_fitted)(part, k, scorer, earlier, every)
                for part, earlier in zip(parts[1:], before[1:], strict=True)
            )
            fits = [*folds] if every is None else [*folds, every]
            yield Row(
                k,
                np.array([fit.score for fit in folds]),
                np.array([fit.fit_seconds for fit in folds]),
                np.array([fit.score_seconds for fit in folds]),
                0.0 if every is None else every.fit_seconds,
                sum(not fit.converged for fit in fits),
            )
            before = [every, *folds] if joint else before


def extended(frames: PosteriorFrames, table: ScaledTable, n_components: int) -> Start:
    """Extend the shapes of a fit to K basis shapes by directions of its residuals.

    At most 200 frames of the table are used: the result is only a start.
    """
    n_frames = table.rows.n_frames
    few = spread(np.arange(n_frames), min(n_frames, 200))
    rows = table.rows.take(few)
    fit = frames.posterior(rows)
    n_more = n_components + 1 - len(frames.shapes)
    rows = rows - fit.translation[:, :, None]
    shapes = extended_shapes(rows, frames.shapes, fit.motion, fit.alpha, n_more)
    return Start(shapes, frames.noise_variance)


def _check_part(
    part: ScaledTable, name: str, n_components: int, estimator: AffineNRSfM
) -> None:
    """Refuse a part of a table that is not enough for so many basis shapes."""
    n_frames, names = len(part.sizes), getattr(estimator, "feature_names_in_", None)
    visible = part.rows.joined(visible_points)

    def refused(k: int) -> ValueError | None:
        try:
            check_size(n_frames, part.n_points, k, joint_camera(estimator))
            check_points(visible, part.n_points, k, estimator.layout, names)
        except ValueError as error:
            return error
        return None

    if error := refused(n_components):
        allowed = (k for k in range(n_components - 1, 0, -1) if refused(k) is None)
        raise ValueError(
            f"{name} of cv fits {n_frames} frames, enough for n_components="
            f"{next(allowed, 0)} at most: {error}"
        ) from error


def _fitted(
    part: Part,
    n_components: int,
    scorer: Scorer,
    before: Fitted | None,
    every: Fitted | None = None,
) -> Fitted:
    """Return the fit of a part with K basis shapes, and its score if it is a split.

    It starts from `before`, the fit of this part with fewer basis shapes, and from
    `every`, the fit of all frames.
    """
    since = time.perf_counter()
    estimator, X, table, split = part
    # The last fit warns.
    with warnings.catch_warnings(record=True, action="ignore") as unconverged:
        warnings.simplefilter("always", ConvergenceWarning)
        if estimator.refinement == "joint":
            starts = []
            if before is not None:
                starts.append(extended(before.frames, table, n_components))
            if every is not None:
                known = Start(every.frames.shapes, every.frames.noise_variance)
                if before is None and estimator.camera == "affine":
                    starts.append(known)
                starts.append(known._replace(calibrated_first=True))
            model = copy.copy(estimator).set_params(n_components=n_components)
            found = fit_ready_table(model, table, n_components, NoProgress(), starts)
            model._set_frames(*found)
        else:
            rows = slice(None) if split is None else split[0]
            model = clone(estimator).set_params(n_components=n_components)
            model.fit(taken_rows(X, rows))
        fitted = time.perf_counter()
        score = np.nan if split is None else scorer(model, split[1])
    seconds = fitted - since, time.perf_counter() - fitted
    return Fitted(model._model.frames, score, *seconds, not unconverged)
