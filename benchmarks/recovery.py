"""
Print how well known shapes, bases and numbers of basis shapes are recovered.

Run ``python -m benchmarks.recovery [section ...] [--seeds N]``. The tables are drawn by
`make_nonrigid_tracks`. From seed to seed the camera model changes (weak perspective,
affine), the number of frames (300, 400, 500) and the amplitude (15 to 20 %).
"""

import numpy as np

from benchmarks._run import run_sections
from benchmarks._sets import CAMERAS, instance
from isa_nrsfm import AffineNRSfM
from isa_nrsfm.metrics import (
    affine_shape_error,
    basis_similarity,
    mean_shape_error_3d,
)

# The error of an efficient estimator is proportional to the noise: at so little noise
# the answer is linear in it. It is run closer to convergence, which the bound means.
SMALL = 1e-3
BOUND_TOL = 1e-4


def fitted(tracks, n_components, **parameters):
    """Return the default fit of tracks, and its error in 3D."""
    model = AffineNRSfM(n_components, random_state=0, **parameters).fit(tracks.data)
    shapes = model.reconstruct(tracks.data)
    return model, affine_shape_error(tracks.shapes, shapes)


def least_similarity(tracks, model):
    """
    Return the lowest similarity of a basis shape, as it is and modulo the mean shape.

    Images do not tell ``B_k + v B_0`` from B_k: the first is below one by what the true
    basis shapes have in common with the mean shape, for any method.
    """
    plain = basis_similarity(tracks.basis, model.basis_)
    modulo = basis_similarity(
        tracks.basis,
        model.basis_,
        mean_shape_true=tracks.mean_shape,
        mean_shape=model.mean_shape_,
        modulo_mean_shape=True,
    )
    return plain.min(), modulo.min()


def exact(options):
    """No noise: largest inverse SNR (below 1e-10) and 3D error (below 1e-5).

    Calibrated cameras see tables of their own kind, and their 3D error is the larger
    one of `affine_shape_error` and `mean_shape_error_3d` with convention "frame".
    """
    print("points  K   exact     inverse SNR    3D error")
    truth = {} if options.camera == "affine" else {"camera": options.camera}
    for n_points in options.points:
        for K in options.components:
            results = []
            for seed in range(options.seeds):
                tracks = instance(seed, n_points, K, 0.0, **truth)
                model, error = fitted(tracks, K, camera=options.camera)
                if truth:
                    shapes = model.reconstruct(tracks.data)
                    turned = mean_shape_error_3d(
                        tracks.shapes, shapes, convention="frame"
                    )
                    error = max(error, turned)
                results.append((model.inverse_snr_, error))
            results = np.array(results)
            n_exact = np.sum((results[:, 0] < 1e-10) & (results[:, 1] < 1e-5))
            worst = results.max(axis=0)
            print(
                f"{n_points:6}{K:3}{n_exact:5}/{len(results):<4}{worst[0]:12.1e}"
                f"{worst[1]:12.1e}",
                flush=True,
            )


def noisy(options):
    """1 and 2 % noise: 3D error, its ratio to the Cramer-Rao bound, similarity.

    The bound is the error at a thousandth of the same noise, times a thousand. The
    similarity is the lowest of a basis shape; "modulo" leaves out the mean shape.
    """
    print(
        "points  K noise   3D error: median     max    bound     ratio: median   max"
        "   similarity: median     min  modulo"
    )
    for n_points in options.points:
        for K in options.components:
            for noise in (0.01, 0.02):
                rows = []
                for seed in range(options.seeds):
                    tracks = instance(seed, n_points, K, noise)
                    model, error = fitted(tracks, K)
                    little = instance(seed, n_points, K, SMALL * noise)
                    bound = fitted(little, K, tol=BOUND_TOL)[1] / SMALL
                    similarity = least_similarity(tracks, model)
                    rows.append((error, bound, error / bound, *similarity))
                error, bound, ratio, plain, modulo = np.array(rows).T
                print(
                    f"{n_points:6}{K:3}{noise:6.2f}{np.median(error):19.5f}"
                    f"{error.max():8.5f}{np.median(bound):9.5f}"
                    f"{np.median(ratio):18.3f}{ratio.max():6.3f}"
                    f"{np.median(plain):21.4f}{plain.min():8.4f}{modulo.min():8.4f}",
                    flush=True,
                )


def rigid(options):
    """Rigid objects at 1 % noise: the largest reliability, and what "auto" finds."""
    for camera in CAMERAS:
        for n_points in (68, 300, 478):
            for n_frames in (60, 100, 300, 1000):
                largest, counts = [], []
                for seed in range(options.seeds):
                    truth = {"camera": camera, "n_frames": n_frames}
                    X = instance(seed, n_points, 0, 0.01, **truth).data
                    for K in (1, 4, "auto"):
                        model = AffineNRSfM(K, camera=camera, random_state=0).fit(X)
                        largest.append(model.reliability_.max())
                    counts.append(len(model.basis_))
                print(
                    f"{camera}, {n_points} points, {n_frames} frames: reliability "
                    f"{max(largest):.2f} at most, K = {max(counts)} at most",
                    flush=True,
                )


def in_the_basis_of(alpha, truth):
    """
    Return true coefficients in the basis of a fit.

    Cameras absorb multiples of the mean shape, so that the bases differ by a projective
    map, ``alpha_k (1 + v a) = (U a + u)_k``; the best one by least squares is taken.
    """
    n_frames, n_components = truth.shape
    known = np.hstack([truth, np.ones((n_frames, 1))])
    linear = np.einsum("kl,ij->iklj", np.eye(n_components), known)
    scale = -alpha[:, :, None] * truth[:, None, :]
    system = np.concatenate([linear.reshape(*alpha.shape, -1), scale], axis=2)
    solution = np.linalg.lstsq(system.reshape(alpha.size, -1), alpha.ravel())[0]
    U, v = solution[:-n_components].reshape(n_components, -1), solution[-n_components:]
    return known @ U.T / (1 + truth @ v)[:, None]


def calibration(options):
    """Coverage of 95 % intervals of alpha, and the noise variance to the true one."""
    print(
        "points  K noise  coverage: mean     min     max   noise: mean     min     max"
    )
    for n_points in options.points:
        for K in options.components:
            rows = []
            for seed in range(options.seeds):
                tracks = instance(seed, n_points, K, 0.02)
                model, _ = fitted(tracks, K, scale_frames=False)
                truth = in_the_basis_of(model.alpha_, tracks.alpha)
                inside = np.abs(model.alpha_ - truth) < 1.96 * model.alpha_std_
                noise = model.noise_variance_ / tracks.noise_variance
                rows.append((inside.mean(), noise))
            coverage, noise = np.array(rows).T
            print(
                f"{n_points:6}{K:3}{0.02:6.2f}{coverage.mean():16.4f}"
                f"{coverage.min():8.4f}{coverage.max():8.4f}{noise.mean():14.4f}"
                f"{noise.min():8.4f}{noise.max():8.4f}",
                flush=True,
            )


SECTIONS = {
    "exact": exact,
    "noisy": noisy,
    "rigid": rigid,
    "calibration": calibration,
}

if __name__ == "__main__":
    numbers = {"type": int, "nargs": "+"}
    run_sections(
        __doc__,
        SECTIONS,
        n_seeds=2,
        points={**numbers, "default": [68, 500]},
        components={**numbers, "default": [2, 4, 6, 9]},
        camera={
            "choices": ["affine", "weak_perspective", "orthographic"],
            "default": "affine",
            "help": "of the fits of `exact`",
        },
    )
