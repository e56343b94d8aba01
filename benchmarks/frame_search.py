"""
Halve and double what steers the fit of single frames, one by one.

Run ``python -m benchmarks.frame_search [section ...]``. The sections of the camera
models print how many frames, complete and with 30 % of their points missing, have a fit
that is worse than the best one known by 0.1 %, and how many have not converged. The
best one is that of all rows and of 20 random starts. "robust" prints how far the
coefficients are from those of many rounds, in standard deviations, largest of all
frames. "cameras" prints how far rough cameras are from those of the fit, the error of
one in ten being larger, and the share of cameras in a minimum that is reversed in depth
that is left there. "ms" is the CPU time.
"""

import time
from dataclasses import replace

import numpy as np

from benchmarks._command import run
from benchmarks._data import FACES, MUCT, YOGA, load_table
from benchmarks.speed import with_holes
from isa_nrsfm import AffineNRSfM
from isa_nrsfm._frames.calibrated_newton import CalibratedSearch, calibrated_problem
from isa_nrsfm._frames.camera_models import CAMERAS
from isa_nrsfm._frames.damped_newton import descend
from isa_nrsfm._frames.options import FRAME_OPTIONS
from isa_nrsfm._frames.point_sums import frame_sums, frame_tracks
from isa_nrsfm._frames.posterior import (
    approximate_cameras,
    fit_posterior,
)
from isa_nrsfm._linalg.vectors import frames_first, frames_last
from isa_nrsfm._tables.layout import centred_tracks, weighting_sizes
from isa_nrsfm._transformer import frames_of
from isa_nrsfm.datasets import make_nonrigid_tracks

# Frames of each table, evenly spread.
N_FRAMES = 300
# Takes cameras, in the axes of the mean shape, to those reversed in depth.
MIRROR = np.diag([1.0, 1.0, -1.0])
# Random starts, and how far they are spread, in standard deviations.
N_STARTS, SPREAD = 20, 1.5
# A fit is worse if its objective is larger by this share.
WORSE = 1e-3
# What steers only one of the two searches, robust fits, and only rough cameras and
# reversed ones.
OF_AFFINE = ("first_steps", "saddle", "affine")
OF_CALIBRATED = ("largest_turn", "promised", "calibrated")
OF_ROBUST = ("reweightings", "settled")
OF_CAMERAS = ("rough_steps", "reversed_steps")


def variants(left_out=(), only=None):
    """Yield titles and options: as they are, then one value halved, then doubled."""
    yield "as it is", FRAME_OPTIONS
    for name, value in FRAME_OPTIONS._asdict().items():
        if name in left_out or (only is not None and name not in only):
            continue
        parts = value._asdict() if hasattr(value, "_fields") else {None: value}
        for part, number in parts.items():
            for factor in (0.5, 2):
                other = type(number)(number * factor)
                if part is None:
                    title, new = f"{name} {other:g}", other
                else:
                    title = f"{name}.{part} {other:g}"
                    new = value._replace(**{part: other})
                yield title, FRAME_OPTIONS._replace(**{name: new})


def unit_tracks(X):
    """Return the tracks of a table, frames centred and of size one."""
    centred, _ = centred_tracks(X.reshape(len(X), -1, 2).astype(float))
    return centred / weighting_sizes(centred, True)[:, None, None]


def tables(camera):
    """Yield titles, tracks and models of frames, fitted with cameras of a model."""
    for case in (YOGA, MUCT, FACES):
        X = load_table(case)
        if X is None:
            continue
        X = X[np.linspace(0, len(X) - 1, min(N_FRAMES, len(X))).astype(int)]
        model = AffineNRSfM(case.n_components, camera=camera, random_state=0).fit(X)
        yield case.title, unit_tracks(X), frames_of(model)
    made = make_nonrigid_tracks(
        N_FRAMES, 30, 3, amplitude=0.6, noise=0.05, random_state=0
    )
    model = AffineNRSfM(3, camera=camera, random_state=0).fit(made.data)
    yield "artificial K=3", unit_tracks(made.data), frames_of(model)


def found_by_search(frames, tracks):
    """Return the least objectives from random starts."""
    shape = (N_STARTS, len(frames.shapes) - 1)
    starts = SPREAD * np.random.default_rng(0).normal(size=shape)
    every = FRAME_OPTIONS._replace(suspicious=0.0)
    settings = {"camera": frames.camera, "starts": starts, "options": every}
    return fit_posterior(
        tracks, frames.shapes, frames.noise_variance, **settings
    ).objective


def timed(function, *given):
    """Return what a function returns, and its CPU milliseconds."""
    since = time.process_time()
    result = function(*given)
    return result, 1e3 * (time.process_time() - since)


def searches(camera, left_out):
    """Vary what steers the fit of frames with cameras of a model."""
    for title, tracks, frames in tables(camera):
        holed = with_holes(tracks.reshape(len(tracks), -1), 0.3).reshape(tracks.shape)
        given = (tracks, holed)
        rows = [
            (name, [timed(frames.posterior, x, o) for x in given])
            for name, o in variants((*left_out, *OF_ROBUST, *OF_CAMERAS))
        ]
        least = [found_by_search(frames, x) for x in given]
        for _, fits in rows:
            least = [
                np.fmin(best, fit.objective)
                for best, (fit, _) in zip(least, fits, strict=True)
            ]
        print(f"{title:28}{'worse %':>10}{'holed %':>10}{'left %':>10}{'ms':>8}")
        for name, fits in rows:
            worse = [
                100 * np.mean(fit.objective > (1 + WORSE) * best)
                for best, (fit, _) in zip(least, fits, strict=True)
            ]
            left = 100 * np.mean([~fit.converged for fit, _ in fits])
            spent = sum(each for _, each in fits)
            print(f"{name:28}{worse[0]:10.2f}{worse[1]:10.2f}{left:10.2f}{spent:8.0f}")


def affine(options):
    """Affine cameras: frames in a worse minimum."""
    searches("affine", OF_CALIBRATED)


def weak_perspective(options):
    """Weak-perspective cameras: frames in a worse minimum."""
    searches("weak_perspective", OF_AFFINE)


def orthographic(options):
    """Orthographic cameras: frames in a worse minimum."""
    searches("orthographic", OF_AFFINE)


def robust(options):
    """Robust losses: coefficients, compared with those of many rounds."""
    many = FRAME_OPTIONS._replace(reweightings=1000, settled=1e-10)
    for title, tracks, frames in tables("affine"):
        rng = np.random.default_rng(0)
        far = rng.random(tracks.shape[:2]) < 0.05
        spoiled = tracks + far[..., None] * rng.normal(size=tracks.shape)
        print(f"{title:28}{'huber':>10}{'cauchy':>10}{'ms':>8}")
        losses = ("huber", "cauchy")
        models = [replace(frames, loss=loss, options=many) for loss in losses]
        expected = [model.posterior(spoiled).alpha for model in models]
        for name, changed in variants(only=OF_ROBUST):
            fits = [
                timed(replace(model, options=changed).posterior, spoiled)
                for model in models
            ]
            errors = [
                np.abs(fit.alpha - alpha).max()
                for (fit, _), alpha in zip(fits, expected, strict=True)
            ]
            spent = sum(each for _, each in fits)
            print(f"{name:28}{errors[0]:10.2g}{errors[1]:10.2g}{spent:8.0f}")


def reversed_minima(frames, block):
    """Return cameras at minima that reversed cameras reach, and the sums for them."""
    search = CalibratedSearch(frames.shapes, True)
    sums = frame_sums(block, search.shared)
    variance = np.full(len(block.weight), frames.noise_variance)
    problem = calibrated_problem(sums, variance, CAMERAS[frames.camera])
    best = frames.prepared_posterior(block)
    axes = search.cameras(np.eye(3)[None])[0].T
    M = frames_last(best.motion @ axes @ MIRROR)
    M, _ = descend(problem, problem.evaluate(M), FRAME_OPTIONS.max_steps)
    return search.cameras(frames_first(M)), best.motion, sums


def cameras(options):
    """Rough cameras, and cameras in a minimum that is reversed in depth."""
    for title, tracks, frames in tables("weak_perspective"):
        shapes, noise, camera = frames.shapes, frames.noise_variance, frames.camera
        block = frame_tracks(tracks)
        turned, best, sums = reversed_minima(frames, block)
        size = np.linalg.norm(best, axis=(1, 2))
        wrong = np.linalg.norm(turned - best, axis=(1, 2)) > 0.01 * size
        print(
            f"{title}, {100 * wrong.mean():.0f} % reversed".ljust(36)
            + f"{'rough':>10}{'left %':>10}{'ms':>8}"
        )
        for name, o in variants(only=(*OF_CAMERAS, "promised", "equal")):
            since = time.process_time()
            rough = approximate_cameras(block, shapes, noise, camera=camera, options=o)
            search = CalibratedSearch(shapes, True, o)
            back, _ = search.reversed_cameras(sums, noise, turned)
            spent = 1e3 * (time.process_time() - since)
            off = np.linalg.norm(rough - best, axis=(1, 2)) / size
            left = np.linalg.norm(back - best, axis=(1, 2)) > 0.01 * size
            share = 100 * left.sum() / max(wrong.sum(), 1)
            print(f"{name:36}{np.quantile(off, 0.9):10.2g}{share:10.2f}{spent:8.0f}")


SECTIONS = {
    each.__name__: each
    for each in (affine, weak_perspective, orthographic, robust, cameras)
}

if __name__ == "__main__":
    run(__doc__, SECTIONS, n_seeds=1)
