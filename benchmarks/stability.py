"""
Compare `stability_` with the correlation of fits of two halves of real tables.

Run ``python -m benchmarks.stability [section ...] [--seeds N]``: about five minutes for
``affine``, twenty for ``calibrated`` with each seed. Halves hold different people where
these are known.
"""

import numpy as np
from scipy.optimize import linear_sum_assignment

from benchmarks._run import run_sections
from benchmarks._sets import FACES, HANDS, ICT, load_arrays, load_table
from isa_nrsfm import AffineNRSfM

TABLES = ((FACES, (3, 5, 9)), (HANDS, (3, 5)), (ICT, (3, 5, 9)))
# Largest difference of what counts as right.
NEAR = 0.1


def matched(first, second):
    """Return correlations (K,) of the coefficients of two fits, and their order."""
    K = first.shape[1]
    r = np.abs(np.corrcoef(first.T, second.T)[:K, K:])
    order = linear_sum_assignment(-r)[1]
    return r[np.arange(K), order], order


def compare(options, **parameters):
    """Print mean correlations of two halves, and those that each half expects."""
    errors = []
    for case, numbers in TABLES:
        arrays = load_arrays(case)
        if arrays is None:
            continue
        X = load_table(case)
        people = arrays.get("subjects", np.arange(len(X)))
        people = np.unique(people, return_inverse=True)[1]
        for K in numbers:
            found, expected, reference = [], [], None
            for seed in range(options.seeds):
                rng = np.random.default_rng(seed)
                own = (rng.permutation(people.max() + 1) % 2)[people] == 0
                models = [
                    AffineNRSfM(K, random_state=0, **parameters).fit(
                        X[half], groups=people[half]
                    )
                    for half in (own, ~own)
                ]
                first, second = (model.transform(X) for model in models)
                reference = first if reference is None else reference
                r, order = matched(first, second)
                place = matched(reference, first)[1]
                found.append(r[place])
                expected.append(models[0].stability_[place])
                expected.append(models[1].stability_[order[place]])
            errors.append(np.subtract(expected, np.mean(found, axis=0)))
            print(f"{case.file}, K={K}")
            print(f"  two halves {np.mean(found, axis=0).round(2)}")
            print(f"  stability_ {np.mean(expected, axis=0).round(2)}")
            apart = np.abs(np.subtract(found, np.mean(found, axis=0)))
            print(
                f"  within {NEAR} of the mean of the halves: "
                f"{100 * np.mean(np.abs(errors[-1]) < NEAR):.0f} %; single halves "
                f"{100 * np.mean(apart < NEAR):.0f} %",
                flush=True,
            )
    if errors:
        every = np.concatenate([each.ravel() for each in errors])
        near = 100 * np.mean(np.abs(every) < NEAR)
        print(f"all: {near:.0f} %, mean difference {every.mean():.3f}")


def affine(options):
    """Affine cameras, independent shapes."""
    compare(options)


def calibrated(options):
    """Weak-perspective cameras, independent shapes."""
    compare(options, camera="weak_perspective")


def principal(options):
    """Affine cameras, principal axes."""
    compare(options, independence=None)


def coefficients(options):
    """Affine cameras, independent coefficients."""
    compare(options, independence="coefficients")


if __name__ == "__main__":
    sections = affine, calibrated, principal, coefficients
    run_sections(__doc__, {each.__name__: each for each in sections}, 4)
