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


def choose_n_components(
    estimator: AffineNRSfM,
    X: "pd.DataFrame",
    candidates: Sequence[int],
    groups: NDArray | None = None,
) -> AffineNRSfMCV:
    """Return the fitted search for the number that best predicts held-out frames.

    Frames of one group are held out together. Results are printed at once.
    """
    splitter: Any = N_PARTS
    if groups is not None:
        n_groups = len(np.unique(groups.astype(str)))
        if n_groups < 2:
            raise ValueError(
                "--group: numbers of basis shapes are compared on held-out groups, "
                f"which needs two groups; got {n_groups}"
            )
        splitter = GroupKFold(min(N_PARTS, n_groups))
    search = AffineNRSfMCV(candidates, estimator=estimator, cv=splitter, verbose=1)
    with contextlib.redirect_stdout(sys.stderr):
        return search.fit(X, groups=groups)


def choice_report(search: AffineNRSfMCV, X: "pd.DataFrame") -> dict[str, Any]:
    """Return the numbers tried, their held-out errors, seconds, and the one chosen.

    If that is the largest, also the next numbers with their expected seconds.
    """
    results, n_parts = search.cv_results_, search.n_splits_
    seconds = results["path_fit_time"] + n_parts * (
        results["mean_fit_time"] + results["mean_score_time"]
    )
    tried = results["param_n_components"]
    scores = [results[f"split{part}_test_score"] for part in range(n_parts)]
    of_parts = -np.transpose(scores)
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
    following = np.arange(tried[-1] + 1, min(tried[-1] + 3, most) + 1)
    if search.n_components_ == tried[-1] and len(following):
        report["next"] = {
            "n_components": following.tolist(),
            "seconds": float(extrapolated(tried, seconds, following).sum()),
        }
    return report


def extrapolated(tried: NDArray, seconds: NDArray, following: NDArray) -> NDArray:
    """Return the expected seconds of further numbers of basis shapes.

    The least squares line, and at least the seconds of the largest number. The first of
    three or more numbers is left out: it includes the search for starts.
    """
    if len(tried) > 2:
        tried, seconds = tried[1:], seconds[1:]
    degree = min(len(tried) - 1, 1)
    # The numbers as they are: one alone has no range to be scaled by.
    line = np.polynomial.Polynomial.fit(tried, seconds, degree, domain=[])
    return np.maximum(line(following), seconds[-1])
