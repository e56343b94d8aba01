"""
Hold AffineNRSfMCV against a plain search: cost, choice and held-out errors.

Run ``python -m benchmarks.choice [section ...] [--pairs N]``; one BLAS thread. Both
searches hold the same three blocks of rows out. Costs are seconds of CPU, relative to
the fit of the largest K alone, which is timed next to each search. A table of several
minima is fitted differently by each search, and by the plain search itself with another
random state.
"""

import time
import warnings
from functools import partial
from typing import NamedTuple

import numpy as np
from sklearn.model_selection import KFold, cross_val_score

from benchmarks._run import run_sections
from benchmarks._sets import Case, load_table
from benchmarks.speed import processor_seconds
from isa_nrsfm import AffineNRSfM, AffineNRSfMCV
from isa_nrsfm._selection import StartedNRSfM
from isa_nrsfm.datasets import make_nonrigid_tracks

N_BLOCKS = 3


class Table(NamedTuple):
    """A table, thinned out, and the largest number of basis shapes that is tried."""

    case: Case
    stride: int
    largest: int

    def rows(self):
        """Return the rows that are fitted, or None where the table is absent."""
        if not self.case.file:
            return make_nonrigid_tracks(300, 68, 4, noise=0.02, random_state=0).data
        X = load_table(self.case, complete=False)
        return None if X is None else X[:: self.stride]


def table(title, file, stride, largest):
    """Return a table; its own number of basis shapes is the largest that is tried."""
    return Table(Case(title, file, largest, True), stride, largest)


DRINK = table("drink", "akhter_drink", 4, 8)
FACES = (
    table("synthetic", "", 1, 8),  # of four basis shapes
    table("expressions", "expressions_dlib_68", 1, 8),
    table("faces_wild", "faces_wild_68_combined", 16, 8),
    table("muct", "muct_68", 8, 8),
    table("ict_68", "ict_bu3dfe_like_68", 5, 8),
)
HANDS = table("hands", "hands_kazuhito_21", 12, 5)


def against_plain_search(options, camera, tables):
    """Print a line for each table: costs, choices and differences of the errors."""
    print(
        f"{'':12}{'fit':>6}{'search / fit':>15}{'plain':>7}{'choice, plain':>15}"
        f"{'errors: above':>16}{'below':>8}{'by seed':>9}\n"
        f"{'':12}{'s':>6}{'least median':>15}{'/ fit':>7}{'':15}{'%':>16}{'%':>8}"
        f"{'%':>9}   difference by K, %"
    )
    for known in tables:
        X = known.rows()
        if X is None:
            continue
        tried = range(1, known.largest + 1)
        single = AffineNRSfM(known.largest, camera=camera, random_state=0)
        search = AffineNRSfMCV(tried, estimator=single, cv=N_BLOCKS)
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            pairs = [
                [processor_seconds(partial(each.fit, X)) for each in (search, single)]
                for _ in range(options.pairs)
            ]
            plain, seconds = plain_search(single, X, tried)
            other, _ = plain_search(single.set_params(random_state=1), X, tried)
        ratios = [path / fit for path, fit in pairs]
        fit = np.median([fit for _, fit in pairs])
        errors = -search.cv_results_["mean_test_score"]
        differences, by_seed = 100 * (errors / plain - 1), 100 * (other / plain - 1)
        choices = f"{search.n_components_}, {tried[int(np.argmin(plain))]}"
        print(
            f"{known.case.title:12}{fit:6.2f}{min(ratios):8.1f}"
            f"{np.median(ratios):7.1f}{seconds / fit + 1:7.1f}{choices:>15}"
            f"{max(differences.max(), 0):16.2f}{max(-differences.min(), 0):8.2f}"
            f"{np.abs(by_seed).max():9.2f}   "
            f"{' '.join(f'{difference:.2f}' for difference in differences)}",
            flush=True,
        )


def plain_search(estimator, X, tried):
    """Return the mean held-out errors of `cross_val_score`, and seconds of CPU."""
    # Without a start, and with K directions also of calibrated cameras
    fit = StartedNRSfM(**estimator.get_params(deep=False))
    errors, start = [], time.process_time()
    for k in tried:
        fit.set_params(n_components=k)
        errors.append(-cross_val_score(fit, X, cv=KFold(N_BLOCKS)).mean())
    return np.array(errors), time.process_time() - start


def affine(options):
    """Affine cameras: AffineNRSfMCV against a plain search."""
    against_plain_search(options, "affine", (*FACES, HANDS, DRINK))


def weak_perspective(options):
    """Weak-perspective cameras: AffineNRSfMCV against a plain search."""
    against_plain_search(options, "weak_perspective", (*FACES[:2], HANDS))


SECTIONS = {"affine": affine, "weak_perspective": weak_perspective}

if __name__ == "__main__":
    pairs = {"type": int, "default": 2, "help": "pairs that are timed (default 2)"}
    run_sections(__doc__, SECTIONS, pairs=pairs)
