"""Choose the number of basis shapes by points and frames that no fit has seen."""

import contextlib
import sys
from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray
from sklearn.model_selection import GroupKFold

from isa_nrsfm import AffineNRSfM, AffineNRSfMCV
from isa_nrsfm._prepare.checks import largest_n_components, most_for_frames
from isa_nrsfm._selection.choice import standard_errors

if TYPE_CHECKING:
    import pandas as pd

# Parts of the table that are held out in turn: blocks of rows, because neighbours are
# often alike.
N_PARTS = 3
# How many further numbers of basis shapes the report says the cost of.
N_MORE = 3


def choose_n_components(
    estimator: AffineNRSfM,
    X: "pd.DataFrame",
    candidates: Sequence[int],
    groups: NDArray | None = None,
) -> AffineNRSfMCV:
    """
    Fit a table with the number of basis shapes that predicts held-out frames best.

    What is known of each number is written to the terminal at once.

    Parameters
    ----------
    estimator : AffineNRSfM
        The estimator, with all its other parameters.
    X : DataFrame of shape (n_frames, 2 * n_points)
        The table.
    candidates : sequence of int
        The numbers to try.
    groups : ndarray of shape (n_frames,), optional
        People, videos or files whose frames are held out together.

    Returns
    -------
    AffineNRSfMCV
        The fitted search.

    Raises
    ------
    ValueError
        If the table is too small for one of the numbers, or no point can be held out.
    """
    splitter: Any = N_PARTS
    if groups is not None:
        n_groups = len(np.unique(groups.astype(str)))
        if n_groups < 2:
            raise ValueError(
                "--group: numbers of basis shapes are compared on groups that are held "
                f"out, which needs two groups; got {n_groups}"
            )
        splitter = GroupKFold(min(N_PARTS, n_groups))
    search = AffineNRSfMCV(candidates, estimator=estimator, cv=splitter, verbose=1)
    with contextlib.redirect_stdout(sys.stderr):
        return search.fit(X, groups=groups)


def choice_report(search: AffineNRSfMCV, X: "pd.DataFrame") -> dict[str, Any]:
    """
    Return what the report says of a choice.

    Parameters
    ----------
    search : AffineNRSfMCV
        The fitted search.
    X : DataFrame of shape (n_frames, 2 * n_points)
        The table.

    Returns
    -------
    dict
        The numbers tried; for each its held-out error in each part (minus
        `AffineNRSfM.score` of frames that were not fitted), their mean and its
        standard error, and its seconds; the number that was chosen; and, where that is
        the largest, which numbers come next and about how many seconds they take.
    """
    results, parts = search.cv_results_, range(search.n_splits_)
    seconds = seconds_of_rows(results, search.n_splits_)
    tried = results["param_n_components"]
    of_parts = np.transpose([-results[f"split{part}_test_score"] for part in parts])
    report = {
        "n_components": tried.tolist(),
        "held_out_error": -results["mean_test_score"],
        "held_out_error_standard_error": standard_errors(of_parts),
        "held_out_error_of_parts": of_parts,
        "seconds": seconds,
        "chosen": search.n_components_,
    }
    fitted = len(X) - -(-len(X) // N_PARTS)  # frames, of the smallest part
    most = min(largest_n_components(X.shape[1] // 2), most_for_frames(fitted))
    following = np.arange(tried[-1] + 1, min(tried[-1] + N_MORE, most) + 1)
    if search.n_components_ == tried[-1] and len(following):
        report["next"] = {
            "n_components": following.tolist(),
            "seconds": float(extrapolated(tried, seconds, following).sum()),
        }
    return report


def seconds_of_rows(results: dict[str, Any], n_splits: int) -> np.ndarray:
    """Return the seconds (n_candidates,) that each number of basis shapes took."""
    of_parts = results["mean_fit_time"] + results["mean_score_time"]
    return results["path_fit_time"] + n_splits * of_parts


def extrapolated(
    tried: np.ndarray, seconds: np.ndarray, following: np.ndarray
) -> np.ndarray:
    """
    Return about how many seconds further numbers of basis shapes take.

    Parameters
    ----------
    tried : ndarray of int, shape (n_candidates,)
        Numbers of basis shapes, ascending.
    seconds : ndarray of shape (n_candidates,)
        The seconds that they took.
    following : ndarray of int
        Larger numbers.

    Returns
    -------
    ndarray
        On the line of least squares through the seconds, each at least as many as the
        largest number took. The first number is left out if there are two others: it
        searches for starts.
    """
    if len(tried) > 2:
        tried, seconds = tried[1:], seconds[1:]
    degree = min(len(tried) - 1, 1)
    # The numbers as they are: one alone has no range to be scaled by.
    line = np.polynomial.Polynomial.fit(tried, seconds, degree, domain=[])
    return np.maximum(line(following), seconds[-1])
