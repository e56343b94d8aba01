"""Time fits and iterations as ratios to an SVD in the same run, one BLAS thread.

Run ``python -m benchmarks.speed``. Each ratio is taken pair by pair, reference and
candidate in turn, so that it holds on a machine whose speed drifts.
"""

import time
import warnings

import numpy as np
from sklearn.exceptions import ConvergenceWarning
from threadpoolctl import threadpool_limits

from benchmarks._data import CASES, load_table
from isa_nrsfm import AffineNRSfM, FastISA
from isa_nrsfm._factorisation import factorise
from isa_nrsfm._tracks import (
    centred_tracks,
    measurement_matrix,
    table_to_tracks,
    weighting_sizes,
)

N_PAIRS = 7


def seconds(function, repeats=1):
    """Return the mean seconds of a call."""
    start = time.perf_counter()
    for _ in range(repeats):
        function()
    return (time.perf_counter() - start) / repeats


def paired_ratio(candidate, reference, repeats=1):
    """Return ratios candidate / reference: minimum, median, maximum; and seconds."""
    candidate(), reference()  # not counted
    pairs = [(seconds(candidate), seconds(reference, repeats)) for _ in range(N_PAIRS)]
    ratios = [a / b for a, b in pairs]
    return (*np.percentile(ratios, [0, 50, 100]), *np.median(pairs, axis=0))


def measured(X, scale_frames):
    """Return the measurement matrix of a table, as the fit sees it."""
    centred, _ = centred_tracks(table_to_tracks(X))
    sizes = weighting_sizes(centred, scale_frames)
    return measurement_matrix(centred / sizes[:, None, None])


def heading(rows, candidate, reference):
    """Print the heading of a table of ratios."""
    print(f"{rows:22}{'min':>8}{'median':>8}{'max':>8}{candidate:>10}{reference:>9}")


def fits():
    """Print whole fits relative to a thin SVD of the same W."""
    print("whole fit, relative to numpy.linalg.svd(W, full_matrices=False)")
    heading("table", "fit ms", "SVD ms")
    for case in CASES:
        X = load_table(case)
        if X is None:
            continue
        W = measured(X, case.scale_frames)
        model = AffineNRSfM(
            case.n_components,
            refinement="alternating",
            scale_frames=case.scale_frames,
            random_state=0,
        )
        least, median, most, fit, svd = paired_ratio(
            lambda model=model, X=X: model.fit(X),
            lambda W=W: np.linalg.svd(W, full_matrices=False),
        )
        print(
            f"{case.title:22}{least:8.2f}{median:8.2f}{most:8.2f}"
            f"{1e3 * fit:10.1f}{1e3 * svd:9.1f}"
        )


def fastisa_iteration():
    """Print a FastISA step of one start relative to an SVD of a 27 x 27 matrix."""
    print("\nFastISA, 68 samples, 27 signals: per start and iteration, relative to")
    print("numpy.linalg.svd of one 27 x 27 matrix")
    heading("signals", "step us", "SVD us")
    random = np.random.default_rng(0)
    matrix = random.normal(size=(27, 27))
    tables = {"Laplace, artificial": random.laplace(size=(68, 27))}
    for case in CASES:
        if case.n_components == 9 and (X := load_table(case)) is not None:
            tables[case.title] = factorise(measured(X, True), 9).signals.T
    for title, signals in tables.items():
        isa = FastISA(random_state=0)
        steps = isa.fit(signals).n_iters_.sum()
        least, median, most, fit, svd = paired_ratio(
            lambda isa=isa, signals=signals: isa.fit(signals),
            lambda: np.linalg.svd(matrix),
            repeats=2000,
        )
        print(
            f"{title:22}{least / steps:8.2f}{median / steps:8.2f}{most / steps:8.2f}"
            f"{1e6 * fit / steps:10.1f}{1e6 * svd:9.1f}"
        )


if __name__ == "__main__":
    with warnings.catch_warnings(), threadpool_limits(1):
        warnings.simplefilter("ignore", ConvergenceWarning)
        fits()
        fastisa_iteration()
