"""
Hold AffineNRSfMCV against a plain search: cost, choice and held-out errors.

Run ``python -m benchmarks.choice [section ...] [--pairs N]``; one BLAS thread. Both
searches hold the same three blocks of rows out. Costs are seconds of CPU, relative to
the fit of the largest K alone, which is timed next to each search.
"""

import time
import warnings
from functools import partial
from typing import NamedTuple

import numpy as np
from sklearn.model_selection import KFold, cross_val_score

from benchmarks._command import run
from benchmarks._data import Case, load_table
from isa_nrsfm import AffineNRSfM, AffineNRSfMCV

N_BLOCKS = 3


class Table(NamedTuple):
    """A table, thinned out, and the largest number of basis shapes that is tried."""

    case: Case
    stride: int
    largest: int


def table(title, file, stride, largest):
    """Return a table; its own number of basis shapes is the largest that is tried."""
    return Table(Case(title, file, largest, True), stride, largest)


TABLES = (
    table("expressions", "expressions_dlib_68", 1, 8),
    table("faces_wild", "faces_wild_68_combined", 16, 8),
    table("muct", "muct_68", 8, 8),
    table("ict_68", "ict_bu3dfe_like_68", 5, 8),
    table("hands", "hands_kazuhito_21", 12, 5),
    table("drink", "akhter_drink", 4, 8),
    table("pickup", "akhter_pickup", 1, 8),
    table("yoga", "akhter_yoga", 1, 8),
    table("flag", "flag_mocap_30x250", 1, 6),
)


def cpu_seconds(function):
    """Return the seconds of CPU of a call."""
    start = time.process_time()
    function()
    return time.process_time() - start


def against_plain_search(options, camera):
    """Print a line for each table: costs, choices and differences of the errors."""
    print(
        f"{'':14}{'fit s':>8}{'least':>7}{'median':>8}{'plain':>7}{'choice':>8}"
        f"{'plain':>7}{'differences of the held-out error, %, by K':>46}"
    )
    for known in TABLES:
        X = load_table(known.case, complete=False)
        if X is None:
            continue
        X, tried = X[:: known.stride], range(1, known.largest + 1)
        single = AffineNRSfM(known.largest, camera=camera, random_state=0)
        search = AffineNRSfMCV(tried, estimator=single, cv=N_BLOCKS)
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            pairs = [
                [cpu_seconds(partial(each.fit, X)) for each in (search, single)]
                for _ in range(options.pairs)
            ]
            plain, seconds = plain_search(single, X, tried)
        ratios = [path / fit for path, fit in pairs]
        fit = np.median([fit for _, fit in pairs])
        errors = -search.cv_results_["mean_test_score"]
        differences = 100 * (errors / plain - 1)
        print(
            f"{known.case.title:14}{fit:8.2f}{min(ratios):7.2f}"
            f"{np.median(ratios):8.2f}{seconds / fit + 1:7.1f}"
            f"{search.n_components_:8}{tried[int(np.argmin(plain))]:7}"
            f"   {' '.join(f'{difference:6.2f}' for difference in differences)}",
            flush=True,
        )


def plain_search(estimator, X, tried):
    """Return the mean held-out errors of `cross_val_score`, and seconds of CPU."""
    errors, start = [], time.process_time()
    for k in tried:
        estimator.set_params(n_components=k)
        errors.append(-cross_val_score(estimator, X, cv=KFold(N_BLOCKS)).mean())
    seconds = time.process_time() - start
    estimator.set_params(n_components=tried[-1])
    return np.array(errors), seconds


def affine(options):
    """Affine cameras: AffineNRSfMCV against a plain search."""
    against_plain_search(options, "affine")


def weak_perspective(options):
    """Weak-perspective cameras: AffineNRSfMCV against a plain search."""
    against_plain_search(options, "weak_perspective")


SECTIONS = {"affine": affine, "weak_perspective": weak_perspective}

if __name__ == "__main__":
    pairs = {"type": int, "default": 3, "help": "pairs that are timed (default 3)"}
    run(__doc__, SECTIONS, n_seeds=1, options={"pairs": pairs})
