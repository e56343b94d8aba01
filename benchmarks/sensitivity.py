"""
Halve and double what steers the stages of a fit, one by one: errors and CPU seconds.

Run ``python -m benchmarks.sensitivity [stage ...]``. Stages are "fit", for the first
numbers of `Limits`, and "joint", for those of the joint fit. The first line of each is
that of the values as they are; then a line a value follows. Errors in 3D are
`affine_shape_error` in percent, "SNR" is inverse SNR in percent, "auto" the mean number
of basis shapes that it finds.
Of missing points of real tables it is their error in percent of the size of frames.
Tables are small: every few frames of real ones, and artificial ones. "s" are the CPU
seconds of all fits.
"""

import time
import warnings
from functools import cache, partial

import numpy as np

from benchmarks._run import run_sections
from benchmarks._sets import is_present, load
from isa_nrsfm._estimator import limited
from isa_nrsfm._joint.settings import Limits
from isa_nrsfm.datasets import make_nonrigid_tracks
from isa_nrsfm.metrics import affine_shape_error

SEEDS = range(2)


@cache
def real(name, step):
    """Return a table and the true shapes of every so many frames of a set."""
    table = load(name)
    shapes = None if table.shapes is None else table.shapes[::step]
    return table.X[::step], shapes


@cache
def artificial(seed, n_frames, n_points, n_components, noise, camera):
    """Return the tracks of a seed."""
    return make_nonrigid_tracks(
        n_frames,
        n_points,
        n_components,
        noise=noise,
        camera=camera,
        amplitude=0.2,
        random_state=seed,
    )


def of_set(name, step, n_components, camera, estimator, **parameters):
    """Return the error of a set in 3D, or its inverse SNR where there is no truth."""
    X, shapes = real(name, step)
    settings = {"camera": camera, "random_state": 0, **parameters}
    model = estimator(n_components, **settings).fit(X)
    if shapes is None:
        return 100 * model.inverse_snr_
    return 100 * affine_shape_error(shapes, model.reconstruct(X))


def of_instances(
    estimator,
    n_frames=150,
    n_points=40,
    noise=0.02,
    camera="weak_perspective",
    missing=0.0,
    outliers=0.0,
    K=3,
    **parameters,
):
    """Return the mean error in 3D of artificial tables."""
    errors = []
    for seed in SEEDS:
        tracks = artificial(seed, n_frames, n_points, K, noise, camera)
        X, rng = tracks.data, np.random.default_rng(seed)
        n_rows = len(X)
        if outliers:
            far = np.repeat(rng.random((n_rows, n_points)) < outliers, 2, axis=1)
            X = X + far * rng.normal(size=X.shape) * X.std()
        if missing:
            hidden = rng.random((n_rows, n_points)) < missing
            X = np.where(np.repeat(hidden, 2, axis=1), np.nan, X)
        model = estimator(K, camera=camera, random_state=0, **parameters).fit(X)
        errors.append(affine_shape_error(tracks.shapes, model.reconstruct(X)))
    return 100 * np.mean(errors)


def counted(estimator, noise=0.02, K=3):
    """Return the mean number of basis shapes that "auto" finds."""
    found = [
        len(
            estimator("auto", random_state=0)
            .fit(artificial(seed, 150, 40, K, noise, "affine").data)
            .basis_
        )
        for seed in SEEDS
    ]
    return float(np.mean(found))


CAPTURED = {
    "yoga 3D": partial(of_set, "yoga", 3, 4, "orthographic"),
    "drink 3D": partial(of_set, "drink", 8, 3, "orthographic"),
    "faces 3D": partial(of_set, "ict_68", 8, 9, "affine"),
}
USUAL = {
    **CAPTURED,
    "noisy 3D": of_instances,
    "large 3D": partial(of_instances, n_frames=2600, n_points=30),
}
ROBUST = {
    "huber 3D": partial(of_instances, outliers=0.05, loss="huber"),
    "cauchy 3D": partial(of_instances, outliers=0.05, loss="cauchy"),
    "missing": partial(of_instances, outliers=0.05, missing=0.1, loss="cauchy"),
}
LARGE = {
    "large 3D": partial(of_instances, n_frames=6000, n_points=30),
    "noisy": partial(of_instances, n_frames=6000, n_points=30, noise=0.1),
    "faces 3D": partial(of_set, "ict_68", 1, 9, "affine"),
    "wild SNR": partial(of_set, "faces_wild", 1, 9, "affine"),
}
MATRIX = {"2000 x 1600": partial(of_instances, n_frames=1000, n_points=1600, K=2)}
JOINT = {
    **USUAL,
    "exact 3D": partial(of_instances, noise=0.0),
    "400 points": partial(of_instances, n_points=400),
    "auto, K=2": partial(counted, K=2),
    "auto, 5 %": partial(counted, noise=0.05, K=4),
}
# The limits of each stage, and the cases that show them.
FIRST = Limits._fields.index("basis_std")
STAGES = {
    "fit": (Limits._fields[:FIRST], {**LARGE, **MATRIX}),
    "joint": (Limits._fields[FIRST:], JOINT),
}


def changed(value, factor):
    """Return a value times a factor; whole numbers stay whole, and above zero."""
    if isinstance(value, tuple):
        return tuple(changed(each, factor) for each in value)
    if isinstance(value, int):
        return max(round(factor * value), 1)
    return factor * value


def measured(limits, cases):
    """Return the figures of the cases, and the CPU seconds of all together."""
    estimator, since = limited(limits), time.process_time()
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", UserWarning)
        figures = [case(estimator) for case in cases.values()]
    return figures, time.process_time() - since


def row(title, figures, seconds):
    """Print a line of the table."""
    listed = "".join(f"{figure:12.4g}" for figure in figures)
    print(f"{title:34}{listed}{seconds:8.1f}", flush=True)


def stage(fields, cases, options):
    """Vary the limits of a stage."""
    cases = {
        title: case
        for title, case in cases.items()
        if getattr(case, "func", None) is not of_set or is_present(case.args[0])
    }
    print(" " * 34 + "".join(f"{title:>12}" for title in cases) + "       s")
    measured(Limits(), cases)  # not counted: tables are made
    row("as it is", *measured(Limits(), cases))
    for field in fields:
        value = getattr(Limits(), field)
        for factor in (0.5, 2.0):
            other = changed(value, factor)
            if other == value:
                continue
            limits = Limits(**{field: other})
            shown = f"{other:g}" if np.isscalar(other) else "x".join(map(str, other))
            row(f"{field} {shown}", *measured(limits, cases))


def section(name):
    """Return the section of a stage, with its heading."""
    function = partial(stage, *STAGES[name])
    function.__doc__ = f"{name}: each value halved and doubled."
    return function


SECTIONS = {name: section(name) for name in STAGES}

if __name__ == "__main__":
    run_sections(__doc__, SECTIONS)
