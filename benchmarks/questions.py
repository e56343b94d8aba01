"""
Print what fits say of labels, people, time and head pose.

Run ``python -m benchmarks.questions [section ...] [--seeds N]``: about two minutes. The
figures of docs/questions.md are those of the first seed.
"""

import numpy as np
from scipy.spatial.transform import Rotation
from sklearn.decomposition import PCA

from benchmarks._run import run_sections
from benchmarks._sets import (
    DRINK,
    EXPRESSIONS,
    ICT,
    PICKUP,
    YOGA,
    as_table,
    centred_tracks,
    load_arrays,
    load_table,
    rotations_and_scales,
    spoiled,
)
from benchmarks.accuracy import common_rotation
from isa_nrsfm import AffineNRSfM
from isa_nrsfm.analysis import (
    AlignedFrames,
    WithinGroups,
    association,
    between_share,
    predictability,
)
from isa_nrsfm.calibration import view_angles
from isa_nrsfm.datasets import make_face_tracks
from isa_nrsfm.export import frame_poses

# Numbers of basis shapes of motion capture.
K_OF_BODIES = (6, 12)
# Noise and share of the points that are missing there.
NOISE, MISSING = 0.02, 0.3
# The y axis of ICT-68 points up and its z axis to the viewer; angles are told of images
# whose y axis points down.
Y_DOWN = np.diag([1.0, -1.0, -1.0])


def told(features, labels, groups, seed):
    """Return the cross-validated accuracy with which features tell labels, percent."""
    scores = predictability(features, labels, groups, random_state=seed)
    return 100 * scores.mean()


def labels(options):
    """Expressions: eta squared, p-values, and accuracy, of PCA of aligned frames, too.

    Folds hold different people where these are known.
    """
    for case, K in ((ICT, 9), (EXPRESSIONS, 8)):
        arrays = load_arrays(case)
        if arrays is None:
            continue
        X, names, people = load_table(case), arrays["labels"], arrays.get("subjects")
        for seed in range(options.seeds):
            alpha = AffineNRSfM(K, random_state=seed).fit_transform(X)
            found = association(alpha, names, people, random_state=seed)
            aligned = PCA(K, random_state=seed).fit_transform(
                AlignedFrames().fit_transform(X)
            )
            print(f"{case.file}, K={K}")
            print(f"  eta squared {found.statistic.round(2)}")
            print(f"  p-values    {found.p_value.round(3)}")
            print(
                f"  accuracy {told(alpha, names, people, seed):.1f} %, "
                f"PCA of aligned frames {told(aligned, names, people, seed):.1f} %",
                flush=True,
            )
            if people is not None:
                own = WithinGroups().fit_transform(alpha, groups=people)
                accuracy = told(own, names, people, seed)
                print(f"  relative to the person's mean {accuracy:.1f} %", flush=True)


def people(options):
    """ICT-68: share of the variance of each coefficient that lies between people."""
    arrays = load_arrays(ICT)
    if arrays is None:
        return
    X = load_table(ICT)
    for independence in ("coefficients", "shapes"):
        for seed in range(options.seeds):
            model = AffineNRSfM(9, independence=independence, random_state=seed).fit(X)
            share = between_share(model.alpha_, arrays["subjects"])
            print(f"{independence:14}{share.between.round(2)}", flush=True)


def turned_error(shapes, truth):
    """
    Return the mean error of shapes, each after the best rotation, relative to its size.

    Parameters
    ----------
    shapes, truth : ndarray of shape (n_frames, n_points, 3)
        Shapes; of the two mirror images the better one counts.

    Returns
    -------
    float
        The mean of ``||S_i R_i - T_i|| / ||T_i||`` over the frames.
    """
    S, T = (each - each.mean(axis=1, keepdims=True) for each in (shapes, truth))
    errors = []
    for mirror in (1.0, -1.0):
        own = S * [1.0, 1.0, mirror]
        turns = [Rotation.align_vectors(b, a)[0] for a, b in zip(own, T, strict=True)]
        off = own @ Rotation.concatenate(turns).as_matrix().transpose(0, 2, 1) - T
        size = np.linalg.norm(T, axis=(1, 2))
        errors.append(np.mean(np.linalg.norm(off, axis=(1, 2)) / size))
    return min(errors)


def smoothing(options):
    """Motion capture, 2 % noise, 30 % missing: 3D error after smoothing over before.

    "complete" is the ratio of the coefficients of complete frames without noise, for
    the same basis shapes; "shuffled" how much smoothing changes frames in any order,
    relative to the coefficients.
    """
    print(f"{'':22}{'before':>9}{'smooth':>9}{'complete':>10}{'shuffled':>10}")
    for case in (YOGA, PICKUP, DRINK):
        arrays = load_arrays(case)
        if arrays is None:
            continue
        clean, truth = centred_tracks(arrays["W2d"].astype(float)), arrays["S3d"]
        for K in K_OF_BODIES:
            for seed in range(options.seeds):
                rng = np.random.default_rng(seed)
                X = spoiled(clean, rng, NOISE, MISSING)
                model = AffineNRSfM(K, camera="orthographic", random_state=seed).fit(X)
                before, smooth, complete = (
                    turned_error(
                        model.mean_shape_ + np.tensordot(alpha, model.basis_, 1), truth
                    )
                    for alpha in (
                        model.alpha_,
                        model.smooth(X).alpha,
                        model.transform(as_table(clean)),
                    )
                )
                order = rng.permutation(len(X))
                change = model.smooth(X[order]).alpha - model.transform(X[order])
                change = np.linalg.norm(change) / np.linalg.norm(model.alpha_)
                print(
                    f"{f'{case.file} K={K}':22}{before:9.4f}{smooth / before:9.2f}"
                    f"{complete / before:10.2f}{change:10.1g}",
                    flush=True,
                )


def poses(options):
    """Head pose: degrees off after one common rotation, errors over deviations.

    The last column is the root mean square of the errors of yaw, each divided by its
    posterior standard deviation; calibrated cameras have one.
    """
    tables = []
    arrays = load_arrays(ICT)
    if arrays is not None:
        tables.append(("ICT-68, K=9", load_table(ICT), Y_DOWN @ arrays["R"], 9))
    for seed in range(options.seeds):
        faces = make_face_tracks(300, noise=0.01, random_state=seed)
        true = rotations_and_scales(faces.motion)[0]
        tables.append((f"synthetic faces {seed}, K=4", faces.data, true, 4))
    print(f"{'':26}{'camera':18}{'median':>8}{'yaw: errors / deviations':>26}")
    for title, X, truth, K in tables:
        for camera in ("weak_perspective", "affine"):
            model = AffineNRSfM(K, camera=camera, random_state=0).fit(X)
            pose = frame_poses(model, X)
            angles = np.stack([pose.roll, -pose.pitch, -pose.yaw], axis=1)
            found = Rotation.from_euler("ZXY", angles, degrees=True).as_matrix()
            true = truth @ common_rotation(truth, found)
            apart = Rotation.from_matrix(true.transpose(0, 2, 1) @ found).magnitude()
            off = (pose.yaw - view_angles(true).yaw + 180) % 360 - 180
            ratio = np.sqrt(np.mean((off / pose.yaw_std) ** 2))
            print(
                f"{title:26}{camera:18}{np.degrees(np.median(apart)):8.2f}{ratio:26.2f}",
                flush=True,
            )


SECTIONS = {each.__name__: each for each in (labels, people, smoothing, poses)}

if __name__ == "__main__":
    run_sections(__doc__, SECTIONS)
