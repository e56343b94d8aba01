"""Print errors of the consensus of groups of points beside those of the joint fit.

Run ``python -m benchmarks.consensus [section ...] [--seeds N] [--jobs N]``. Errors are
those of `mean_shape_error_3d`, of shapes in the axes of their cameras, in the
conventions "sequence" (Akhter, Dai), "camera" (Lee) and "frame". "error / std" is the
RMS of the errors of the depths over the standard deviations of
``reconstruct(X, return_std=True)``, "rank" their rank correlation over the points.
"fits" is the CPU time of a fit, in joint fits with twelve basis shapes.
"""

import time

import numpy as np
from scipy.linalg import orthogonal_procrustes
from scipy.spatial.transform import Rotation
from scipy.stats import spearmanr

from benchmarks._run import run_sections
from benchmarks._sets import (
    SETS,
    Case,
    as_table,
    is_present,
    load,
    load_arrays,
    rotations_and_scales,
    shapes_in_camera,
    spoiled as spoiled_table,
)
from isa_nrsfm import AffineNRSfM
from isa_nrsfm.metrics import mean_shape_error_3d

CAPTURED = ("yoga", "pickup", "drink")
# Markers near 15 joints of the body, of the 41 of the motion capture.
JOINTS = (0, 4, 7, 10, 15, 17, 19, 22, 24, 25, 28, 29, 33, 35, 40)
CONVENTIONS = ("sequence", "camera", "frame")


def fitted(X, refinement, n_components, camera, n_jobs=None, seed=0):
    """Return a fit of a table, and its CPU seconds."""
    model = AffineNRSfM(
        n_components,
        camera=camera,
        refinement=refinement,
        random_state=seed,
        n_jobs=n_jobs,
    )
    start = time.process_time()
    return model.fit(X), time.process_time() - start


def in_camera(model, X):
    """Return shapes of frames, and deviations of depths, in the axes of cameras."""
    shapes, deviations = model.reconstruct(X, return_std=True)
    fit = model.decompose(X)
    return turned(shapes, fit), rotations_and_scales(fit.motion)[1][
        :, None
    ] * deviations


def turned(shapes, fit):
    """Return shapes of frames in the axes of the cameras of a fit."""
    rotations, scales = rotations_and_scales(fit.motion)
    return scales[:, None, None] * shapes @ rotations.transpose(0, 2, 1)


def standardised(shapes, deviations, truth, scale=False):
    """Return errors over deviations, and rank correlations over points and frames.

    The truth may have another scale.
    """
    z, d = (S[:, :, 2] - S[:, :, 2].mean(1)[:, None] for S in (truth, shapes))
    size = np.sum(np.abs(z * d)) / np.sum(d * d) if scale else 1.0
    off, std = size * np.sign(np.sum(z * d)) * d - z, size * deviations
    ranks = [
        spearmanr(*(np.mean(each**2, axis=axis) for each in (off, std)))[0]
        for axis in (0, 1)
    ]
    return np.sqrt(np.mean((off / std) ** 2)), *ranks


def errors_3d(truth, shapes, scale=False):
    """Return the errors of shapes in each convention."""
    return [
        mean_shape_error_3d(truth, shapes, convention=convention, **scaled)
        for convention in CONVENTIONS
        for scaled in [{"scale": scale} if convention == "sequence" else {}]
    ]


def report(title, X, truth, cases, scale=False, n_jobs=None):
    """Print a row for each case (refinement, K, camera) of a table of known shapes."""
    _, unit = fitted(X, "joint", min(12, X.shape[1] // 2 - 4), cases[0][2])
    for refinement, n_components, camera in cases:
        model, seconds = fitted(X, refinement, n_components, camera, n_jobs)
        shapes, deviations = in_camera(model, X)
        known = np.isfinite(shapes).all(axis=(1, 2))
        errors = errors_3d(truth[known], shapes[known], scale)
        ratio, rank, _ = standardised(
            shapes[known], deviations[known], truth[known], scale
        )
        name = f"{title}, {refinement} {n_components}, {camera}"
        print(
            f"{name:52}{len(model.basis_):4}"
            + "".join(f"{error:9.4f}" for error in errors)
            + f"{ratio:8.2f}{rank:6.2f}{seconds / unit:7.1f}",
            flush=True,
        )


def heading():
    """Print the names of the columns of `report`."""
    columns = "".join(f"{name:>9}" for name in CONVENTIONS)
    print(f"{'table, refinement, K, camera':52}{'K':>4}{columns}   e/std  rank   fits")


def both(n_components, camera="orthographic"):
    """Return the joint fit and the consensus with automatic numbers of shapes."""
    return [("joint", n_components, camera), ("consensus", "auto", camera)]


def complete(options):
    """Complete tables; the refined model with the numbers of components it finds."""
    heading()
    for name in filter(is_present, CAPTURED):
        X, truth = load(name).X, shapes_in_camera(name)
        cases = [
            *both(12),
            ("consensus", 40, "orthographic"),
            *both(12, "weak_perspective"),
        ]
        report(name, X, truth, cases, n_jobs=options.jobs)
    others = [
        ("shark", both("auto")),
        ("flag", both(12, "weak_perspective")),
        ("flag", [("consensus", 12, "weak_perspective")]),
        ("ict_68", both(9, "weak_perspective")),
        ("ict_68", [("consensus", 9, "weak_perspective")]),
    ]
    for name, cases in others:
        if is_present(name):
            scale = SETS[name].camera != "orthographic"
            X, truth = load(name).X, shapes_in_camera(name)
            report(name, X, truth, cases, scale, options.jobs)


def poor_tables(X, seed):
    """Return a table with 40 % of the points missing, and with noise of 2 %."""
    poor = {"40 % missing": {"missing": 0.4}, "2 % noise": {"noise": 0.02}}
    return {
        title: spoiled_table(X, np.random.default_rng(seed), **how)
        for title, how in poor.items()
    }


def spoiled(options):
    """Missing points (40 %), noise (2 % of the size), and 15 points of a body."""
    heading()
    for name in filter(is_present, CAPTURED[:2]):
        X, truth = load(name).X, shapes_in_camera(name)
        for seed in range(options.seeds):
            for title, table in poor_tables(X, seed).items():
                report(f"{name} {title}", table, truth, both(12), n_jobs=options.jobs)
        few = X.reshape(len(X), -1, 2)[:, JOINTS].reshape(len(X), -1)
        cases = [("joint", 3, "orthographic"), *both("auto")]
        report(f"{name} 15 joints", few, truth[:, JOINTS], cases, n_jobs=options.jobs)


def smoothed(options):
    """Errors of frames by themselves, and of frames smoothed in time.

    The cameras turn by 5 degrees a frame; shaken ones also by 3 degrees at random.
    """
    columns = "".join(f"{name:>18}" for name in CONVENTIONS)
    print(f"{'table':28}{columns}")
    for name in filter(is_present, CAPTURED):
        X, truth = load(name).X, shapes_in_camera(name)
        for seed in range(options.seeds):
            shaken = shaken_shapes(truth, seed)
            noisy = poor_tables(shaken[:, :, :2].reshape(X.shape), seed)["2 % noise"]
            cases = [("", X, truth)]
            cases += [(*each, truth) for each in poor_tables(X, seed).items()]
            for title, table, true in [*cases, ("2 % noise, shaken", noisy, shaken)]:
                arguments = "consensus", "auto", "orthographic", options.jobs
                model, _ = fitted(table, *arguments)
                alone, smooth = (
                    errors_3d(true, turned(model.reconstruct(fit), fit))
                    for fit in (
                        model.decompose(table),
                        model.smooth(table).decomposition,
                    )
                )
                pairs = zip(alone, smooth, strict=True)
                print(
                    f"{f'{name} {title}':28}"
                    + "".join(f"{a:9.4f}{b:9.4f}" for a, b in pairs),
                    flush=True,
                )


def shaken_shapes(truth, seed):
    """Return shapes turned by 3 degrees, differently in each frame."""
    turns = np.random.default_rng(seed).normal(size=(len(truth), 3))
    R = Rotation.from_rotvec(np.radians(3.0) * turns).as_matrix()
    return (truth - truth.mean(axis=1, keepdims=True)) @ R.transpose(0, 2, 1)


def new_frames(options):
    """Deviations of depths of frames that are not in the fit: a random half."""
    print(f"{'table':20}   e/std  points  frames")
    for name in filter(is_present, CAPTURED):
        tracks, truth = load(name).X, shapes_in_camera(name)
        n_frames, half = len(tracks), len(tracks) // 2
        order = np.random.default_rng(0).permutation(n_frames)
        old, new = np.sort(order[:half]), np.sort(order[half:])
        # Successive frames are similar: at most 300 are enough.
        old = old[:: -(-half // 300)]
        for points in (range(truth.shape[1]), JOINTS):
            X = tracks.reshape(n_frames, -1, 2)[:, points].reshape(n_frames, -1)
            model, _ = fitted(X[old], "consensus", "auto", "orthographic", options.jobs)
            found = standardised(*in_camera(model, X[new]), truth[new][:, points])
            title = f"{name}, {len(points)} points"
            print(f"{title:20}" + "".join(f"{each:8.2f}" for each in found), flush=True)


def bodies(options):
    """CMU, 28 joints in mm: hip on hip, and after a similarity of each frame, mirrored.

    The hip is the first joint.
    """
    arrays = load_arrays(Case("CMU", "cmu_body", 12))
    if arrays is None:
        return
    truth, X = arrays["S3d"].astype(float), as_table(arrays["W2d"].astype(float))
    columns = "".join(f"{name:>9}" for name in (*CONVENTIONS, "hip, mm", "turned"))
    print(f"{'refinement, K':24}{columns}")
    cases = [("joint", K) for K in (8, 12, 24)] + [("consensus", "auto")]
    for refinement, K in cases:
        model, _ = fitted(X, refinement, K, "orthographic", options.jobs)
        shapes, true = in_camera(model, X)[0], truth - truth[:, :1]
        shapes = shapes - shapes[:, :1]
        shapes *= (1, 1, np.sign(np.sum(shapes[:, :, 2] * true[:, :, 2])))
        hip = np.linalg.norm(shapes - true, axis=2).mean()
        shapes, true = (S - S.mean(axis=1, keepdims=True) for S in (shapes, true))
        distances = []
        for S, T in zip(shapes, true, strict=True):
            turn, scale = orthogonal_procrustes(S, T)
            moved = scale / np.sum(S**2) * S @ turn
            distances.append(np.linalg.norm(moved - T, axis=1).mean())
        print(
            f"{f'{refinement}, {len(model.basis_)}':24}"
            + "".join(f"{error:9.4f}" for error in errors_3d(truth, shapes))
            + f"{hip:9.1f}{np.mean(distances):9.1f}",
            flush=True,
        )


SECTIONS = {
    "complete": complete,
    "spoiled": spoiled,
    "smoothed": smoothed,
    "new": new_frames,
    "bodies": bodies,
}

if __name__ == "__main__":
    jobs = {"type": int, "default": None, "help": "processes of the groups"}
    run_sections(__doc__, SECTIONS, jobs=jobs)
