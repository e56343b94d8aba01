"""Tables of scores by the number of basis shapes, the choice, and its warnings."""

from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.stats import rankdata
from sklearn.exceptions import ConvergenceWarning

from isa_nrsfm._compat.caller import warn_caller
from isa_nrsfm._selection.path import Row

SELECTIONS = ("best", "one_standard_error")
# For held-out errors of 100 % and more.
NO_SHAPE = (
    "no number of basis shapes predicts held-out points better than the centroid of "
    "their frame does (an error of 100 %): the fitted frames share no shape with the "
    "others. Check that each column is the same point in all frames."
)


def results_of(rows: Sequence[Row]) -> dict[str, Any]:
    """Return `cv_results_` of `AffineNRSfMCV`, as in `GridSearchCV`."""
    scores = np.array([row.scores for row in rows])
    mean = scores.mean(axis=1)
    results: dict[str, Any] = {
        "param_n_components": np.array([row.n_components for row in rows]),
        "params": [{"n_components": row.n_components} for row in rows],
        **{f"split{i}_test_score": scores[:, i] for i in range(scores.shape[1])},
        "mean_test_score": mean,
        "std_test_score": scores.std(axis=1),
        # Unknown scores rank last.
        "rank_test_score": rankdata(
            -np.nan_to_num(mean, nan=-np.inf), method="min"
        ).astype(np.int32),
        "path_fit_time": np.array([row.path_seconds for row in rows]),
    }
    for name in ("fit", "score"):
        seconds = np.array([getattr(row, f"{name}_seconds") for row in rows])
        results[f"mean_{name}_time"] = seconds.mean(axis=1)
        results[f"std_{name}_time"] = seconds.std(axis=1)
    return results


def selected(scores: NDArray, select: str) -> int:
    """Return the index of the chosen number of basis shapes.

    Scores are (n_candidates, n_splits), by ascending number of basis shapes. "best"
    takes the best mean. "one_standard_error" takes the fewest basis shapes with a mean
    at most one standard error below the best (Hastie, Tibshirani, Friedman, "The
    elements of statistical learning", 2009, section 7.10).
    """
    mean = scores.mean(axis=1)
    if np.isnan(mean).all():
        raise ValueError(
            "n_components cannot be chosen by held-out points: too few points are "
            "visible. Give n_components, or take frames with more visible points"
        )
    best = int(np.nanargmax(mean))
    if select == "best":
        return best
    n_splits = scores.shape[1]
    if n_splits < 2:
        raise ValueError(
            f"select={select!r} needs the standard error over at least two splits; cv "
            "has one"
        )
    error = standard_errors(scores)[best]
    return int(np.argmax(mean >= mean[best] - error))


def standard_errors(scores: NDArray) -> NDArray:
    """Return the standard errors of mean scores (..., n_splits); NaN with one split."""
    n_splits = scores.shape[-1]
    if n_splits < 2:
        return np.full(scores.shape[:-1], np.nan)
    return np.asarray(scores.std(axis=-1, ddof=1) / np.sqrt(n_splits))


def line(row: Row, held_out: bool) -> str:
    """Return a row of a path as text; a held-out error is minus the score."""
    mean, error = row.scores.mean(), standard_errors(row.scores)
    score = f"score {mean:.4g}, standard error {error:.2g}"
    if held_out:
        score = (
            f"held-out error {-100 * mean:.3g} %, standard error {100 * error:.2g} %"
        )
    seconds = row.path_seconds + row.fit_seconds.sum() + row.score_seconds.sum()
    return f"n_components={row.n_components}: {score}, {seconds:.1f} s"


def warn_of_no_shape(scores: NDArray) -> None:
    """Warn if no mean score (n_candidates, n_splits) beats the centroids of frames."""
    if np.nanmax(scores.mean(axis=1)) <= -1:
        warn_caller(NO_SHAPE)


def warn_of_unconverged(rows: Sequence[Row]) -> None:
    """Warn if fits of a path did not converge."""
    which = [str(row.n_components) for row in rows if row.n_unconverged]
    if which:
        n_fits = sum(row.n_unconverged for row in rows)
        warn_caller(
            f"not all fits converged while n_components was chosen: {n_fits} with "
            f"n_components of {', '.join(which)} did not. Increase max_iter or tol",
            ConvergenceWarning,
        )
