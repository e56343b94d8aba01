"""Choose the number of basis shapes by points and frames that no fit has seen."""

import sys
import warnings
from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

import numpy as np
from sklearn.model_selection import KFold, cross_val_score

from isa_nrsfm import AffineNRSfM
from isa_nrsfm._prepare.checks import check_size

if TYPE_CHECKING:
    import pandas as pd

# Parts of the table that are held out in turn: blocks of rows, because neighbours are
# often alike.
N_PARTS = 3


def choose_n_components(
    estimator: AffineNRSfM, X: "pd.DataFrame", candidates: Sequence[int]
) -> dict[str, Any]:
    """
    Score each number of basis shapes on held-out frames, and set the best.

    Parameters
    ----------
    estimator : AffineNRSfM
        The estimator, with all its other parameters. Its `n_components` is set.
    X : DataFrame of shape (n_frames, 2 * n_points)
        The table.
    candidates : sequence of int
        The numbers to try, ascending.

    Returns
    -------
    dict
        For the report: the numbers tried, for each its held-out error in each part
        (minus `AffineNRSfM.score` of frames that were not fitted) and their mean, and
        the number that was chosen.

    Raises
    ------
    ValueError
        If the table is too small for one of the numbers, or no point can be held out.
    """
    n_frames, n_points = len(X), X.shape[1] // 2
    check_size(n_frames, n_points, candidates[-1])
    try:
        check_size(n_frames - -(-n_frames // N_PARTS), n_points, candidates[-1])
        errors = [_held_out_errors(estimator, X, k) for k in candidates]
    except ValueError as error:
        raise ValueError(
            f"each number of basis shapes is tried on {N_PARTS - 1} of {N_PARTS} parts "
            f"of the frames; there, {error}"
        ) from error
    means = np.mean(errors, axis=1)
    if np.isnan(means).all():
        raise ValueError("too few points are seen to choose K by held-out points")
    best = candidates[int(np.nanargmin(means))]
    estimator.set_params(n_components=best)
    return {
        "n_components": list(candidates),
        "held_out_error": means,
        "held_out_error_of_parts": errors,
        "chosen": best,
    }


def _held_out_errors(
    estimator: AffineNRSfM, X: "pd.DataFrame", n_components: int
) -> np.ndarray:
    """Return the held-out error of each part of a table in a fit of the others."""
    estimator.set_params(n_components=n_components)
    with warnings.catch_warnings():
        # What is wrong with the table is said again in the fit of all of it.
        warnings.simplefilter("ignore")
        errors = -cross_val_score(estimator, X, cv=KFold(N_PARTS), error_score="raise")
    if sys.stderr.isatty():
        print(
            f"[isa-nrsfm] K={n_components}: held-out error {100 * errors.mean():.3g} %",
            file=sys.stderr,
            flush=True,
        )
    return errors
