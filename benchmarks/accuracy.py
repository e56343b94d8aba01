"""
Print what fits of real tables reach: reprojection, 3D truth, unseen points.

Run ``python -m benchmarks.accuracy [section ...] [--seeds N]``. Errors in 3D are
`affine_shape_error`; inverse SNR is in percent, of frames scaled to unit size. Errors
of Euclidean shapes are `mean_shape_error_3d`, of shapes in the axes of their cameras:
"sequence", without a scale unless cameras have unknown ones, and "frame".
"""

import warnings
from unittest import mock

import numpy as np
from scipy.spatial.transform import Rotation

from benchmarks._command import run
from benchmarks._data import (
    CASES,
    DRINK,
    FACES,
    ICT,
    MUCT,
    PICKUP,
    SHARK,
    YOGA,
    as_table,
    halves_of,
    load_arrays,
    load_table,
)
from benchmarks._methods import Found, found_by_ours
from benchmarks._sets import SETS, is_present, load, shapes_in_camera
from benchmarks.recovery import instance
from isa_nrsfm import AffineNRSfM, FastISA
from isa_nrsfm._estimator import limited
from isa_nrsfm._fit import Limits
from isa_nrsfm._frames.camera_models import full_rotations
from isa_nrsfm._joint import fit as joint_fit
from isa_nrsfm._joint.problem import JOINT_OPTIONS
from isa_nrsfm._linalg.small_matrices import procrustes
from isa_nrsfm._metric_upgrade.rigid import nearest_rotations
from isa_nrsfm._parameters.choices import BLOCK_RECOVERIES
from isa_nrsfm._tables.tracks import centred_tracks, weighting_sizes
from isa_nrsfm.datasets import make_nonrigid_tracks
from isa_nrsfm.metrics import affine_shape_error, mean_shape_error_3d

PAPER = {
    "PooledFastICA": {},
    "FastISA": {"isa": FastISA()},
    **{
        f"no refinement, {name}": {"block_recovery": name, "refinement": None}
        for name in BLOCK_RECOVERIES
    },
}
TOLERANCES = (0.5, 0.05, 1e-2, 1e-3, 1e-5, 1e-7, 1e-10)
MOST_STEPS = 20_000
# Sets, camera and K of calibrated fits, with frames that are not scaled where the
# camera is orthographic.
CALIBRATED = (
    ("yoga", "orthographic", 12),
    ("pickup", "orthographic", 12),
    ("drink", "orthographic", 12),
    ("shark", "orthographic", 1),
    ("shark", "orthographic", 2),
    ("flag", "weak_perspective", 12),
    ("ict_68", "weak_perspective", 9),
    ("yoga", "affine", 3),
    ("pickup", "affine", 3),
)
# Those with 41 points, to which noise is added and of which points are hidden.
SPOILED = CALIBRATED[:3]
# Those with outliers, and those of which true rotations are known.
OUTLYING = (("drink", "weak_perspective", 3), CALIBRATED[6])
TURNED = (CALIBRATED[6], *SPOILED)
# Rounds in which shapes are turned onto their mean.
TURNING_ROUNDS = 10
# Of the prior: deviations of the basis shapes, least noise variances.
BASIS_STDS = (0.005, 0.008, 0.01, 0.015, 0.02)
LEAST_NOISES = (1e-4, 5e-5, 3e-5)
# Sets and K that cut a full spectrum off, and factors of what is left.
CUT = {
    "yoga": (3, 6, 12),
    "pickup": (3, 6, 12),
    "drink": (3, 6, 12),
    "shark": (1, 2),
    "flag": (5, 12),
    "ict_68": (5, 9),
}
CUT_OFFS = (0.0, 1.0, 3.0, 10.0)
# Distances of perspective cameras, in radii of the object.
DISTANCES = (8.0, 4.0, 2.5)
# Sets with too few basis shapes, and one with nearly enough.
TOO_SMALL = (("yoga", 3), ("pickup", 3), ("drink", 3), ("shark", 1), ("ict_68", 9))
# A number of neighbouring points that a frame hides.
RUN = 20


def fit(case, X, seed=0, **parameters):
    """Return the fit of a table as the case says."""
    settings = {"scale_frames": case.scale_frames, "random_state": seed}
    return AffineNRSfM(case.n_components, **{**settings, **parameters}).fit(X)


def error_3d(arrays, model, X):
    """Return the error of the reconstruction in 3D, NaN where there is no truth."""
    if "S3d" not in arrays:
        return np.nan
    return affine_shape_error(arrays["S3d"], model.reconstruct(X))


def rigid_error_3d(arrays, model):
    """Return the error in 3D of the mean shape alone."""
    if "S3d" not in arrays:
        return np.nan
    truth = arrays["S3d"]
    return affine_shape_error(truth, np.broadcast_to(model.mean_shape_, truth.shape))


def held_out(model, X):
    """Return the inverse SNR of points held out of the fits of their frames."""
    return -100 * model.score(X)


def paper(options):
    """The paper's refinement: inverse SNR over the seeds, and what choices change."""
    for case in CASES:
        X = load_table(case)
        if X is None:
            continue
        print(f"\n{case.title:36}{'min':>9}{'median':>9}{'max':>9}")
        for title, parameters in PAPER.items():
            models = [
                fit(case, X, seed, **{"refinement": "alternating", **parameters})
                for seed in range(options.seeds)
            ]
            values = [100 * model.inverse_snr_ for model in models]
            least, median, most = np.percentile(values, [0, 50, 100])
            print(f"{title:36}{least:9.4f}{median:9.4f}{most:9.4f}", flush=True)
        print(f"{'rank floor':36}{100 * models[0].rank_floor_:9.4f}")


def tables(options):
    """Joint refinement, all rows: reprojection, held-out points, 3D, largest alpha."""
    print(
        f"{'':22}{'inverse SNR: min':>17}{'max':>9}{'floor':>9}{'held out':>10}"
        f"{'3D: min':>10}{'max':>8}{'paper':>8}{'rigid':>8}{'alpha':>7}{'steps':>7}"
    )
    for case in (*CASES, *SHARK[:2]):
        arrays = load_arrays(case)
        if arrays is None:
            continue
        X = as_table(arrays["W2d"])
        models = [fit(case, X, seed) for seed in range(options.seeds)]
        snr = [100 * model.inverse_snr_ for model in models]
        errors = [error_3d(arrays, model, X) for model in models]
        alternating = fit(case, X, refinement="alternating")
        model = models[-1]
        print(
            f"{case.title:22}{min(snr):17.5f}{max(snr):9.5f}"
            f"{100 * model.rank_floor_:9.5f}{held_out(model, X):10.4f}"
            f"{min(errors):10.4f}{max(errors):8.4f}"
            f"{error_3d(arrays, alternating, X):8.4f}"
            f"{rigid_error_3d(arrays, alternating):8.4f}"
            f"{np.abs(model.alpha_).max():7.1f}{model.n_iter_:7}",
            flush=True,
        )


def halves(options):
    """Trained on half of the faces: held-out points of the others, to the paper's."""
    print(f"{'':28}{'joint':>8}{'paper':>8}{'ratio':>8}")
    for case, complete in ((FACES, True), (MUCT, True), (MUCT, False)):
        X = load_table(case, complete)
        if X is None:
            continue
        for seed in range(options.seeds):
            train, test = (X[rows] for rows in halves_of(len(X), seed))
            joint = held_out(fit(case, train, seed), test)
            other = held_out(fit(case, train, seed, refinement="alternating"), test)
            title = f"{case.title}, {'complete' if complete else 'all'} rows"
            print(f"{title:28}{joint:8.4f}{other:8.4f}{joint / other:8.3f}", flush=True)


def eta_squared(values, labels):
    """Return the between-class share of the variance of each column."""
    centred = values - values.mean(axis=0)
    between = sum(
        np.sum(labels == label) * centred[labels == label].mean(axis=0) ** 2
        for label in np.unique(labels)
    )
    return between / np.sum(centred**2, axis=0)


def classes(options):
    """ICT: share of each coefficient's variance between the expressions, sorted."""
    arrays = load_arrays(ICT)
    if arrays is None:
        return
    X = as_table(arrays["W2d"])
    for independence in ("coefficients", "shapes", None):
        for seed in range(options.seeds):
            model = fit(ICT, X, seed, independence=independence)
            shares = np.sort(eta_squared(model.alpha_, arrays["labels"]))[::-1]
            print(
                f"{independence!s:14}{np.array2string(shares, precision=2)}  "
                f"{np.sum(shares >= 0.5)} at least 0.5, "
                f"{np.sum(shares <= 0.05)} at most 0.05",
                flush=True,
            )


def missing(options):
    """30 % of the points missing: 3D error relative to the complete table."""
    for case in (ICT, DRINK):
        arrays = load_arrays(case)
        if arrays is None:
            continue
        X = as_table(arrays["W2d"])
        clean = error_3d(arrays, fit(case, X), X)
        for seed in range(options.seeds):
            tracks = arrays["W2d"].astype(float)
            hidden = np.random.default_rng(seed).random(tracks.shape[:2]) < 0.3
            tracks[hidden] = np.nan
            holes = as_table(tracks)
            model = fit(case, holes, seed)
            error = error_3d(arrays, model, holes)
            filled = model.reproject(holes).reshape(tracks.shape)
            centred, _ = centred_tracks(arrays["W2d"])
            wrong = (filled - arrays["W2d"])[hidden]
            print(
                f"{case.title:18}3D {error:.4f}, complete {clean:.4f}, ratio "
                f"{error / clean:.3f}; unseen points, inverse SNR "
                f"{100 * np.sum(wrong**2) / np.sum(centred[hidden] ** 2):.4f} %",
                flush=True,
            )
    X = load_table(MUCT, complete=False)
    if X is not None:
        model = fit(MUCT, X)
        finite = np.isfinite(model.alpha_).all() and np.isfinite(model.reproject(X))
        print(
            f"{MUCT.title}, {len(X)} rows, {np.isnan(X).any(axis=1).sum()} with holes: "
            f"inverse SNR {100 * model.inverse_snr_:.4f}, held out "
            f"{held_out(model, X):.4f}, finite {bool(np.all(finite))}"
        )


def spoiled(tracks, kind, rng, share=0.05):
    """
    Return tracks with a share of the points spoiled.

    They are moved in a random direction by a number of sizes of their frame, `kind`, or
    by 0.3 to 3 sizes ("mixed"), or put anywhere within 3 sizes ("anywhere").
    """
    centred, centroids = centred_tracks(tracks)
    sizes = weighting_sizes(centred, True)[:, None, None]
    chosen = rng.random(tracks.shape[:2]) < share
    angle = rng.uniform(0, 2 * np.pi, tracks.shape[:2])
    direction = np.stack([np.cos(angle), np.sin(angle)], axis=-1)
    lengths = 0.3 * 10 ** rng.random(tracks.shape[:2])[..., None]
    anywhere = centroids[:, None] + sizes * rng.uniform(-3, 3, tracks.shape)
    if kind == "anywhere":
        return np.where(chosen[..., None], anywhere, tracks)
    if kind != "mixed":
        lengths = kind
    return np.where(chosen[..., None], tracks + lengths * sizes * direction, tracks)


def outliers(options):
    """5 % of the points moved by 0.3 to 3 sizes of the frame: 3D error."""
    kinds = (0.3, 1.0, 3.0, "mixed", "anywhere")
    print(
        f"moved by {kinds}: 3D error, and its ratio to the clean one of the same loss"
    )
    for case in (ICT, DRINK):
        arrays = load_arrays(case)
        if arrays is None:
            continue
        X = as_table(arrays["W2d"])
        for loss in ("linear", "huber", "cauchy"):
            clean = error_3d(arrays, fit(case, X, loss=loss), X)
            for seed in range(options.seeds):
                errors = []
                for kind in kinds:
                    rng = np.random.default_rng(seed)
                    Y = as_table(spoiled(arrays["W2d"], kind, rng))
                    errors.append(error_3d(arrays, fit(case, Y, seed, loss=loss), Y))
                errors = np.array(errors)
                print(
                    f"{case.title:12}{loss:>8} clean {clean:.4f}  "
                    f"{np.array2string(errors, precision=4, floatmode='fixed')} "
                    f"{np.array2string(errors / clean, precision=2)}",
                    flush=True,
                )


def tolerances(options):
    """3D error at tolerances from 0.5 to 1e-10, largest over smallest."""
    for case in (ICT, DRINK, PICKUP, YOGA):
        arrays = load_arrays(case)
        if arrays is None:
            continue
        X = as_table(arrays["W2d"])
        errors = []
        print(case.title)
        for tol in TOLERANCES:
            model = fit(case, X, tol=tol, max_iter=options.steps)
            errors.append(error_3d(arrays, model, X))
            print(
                f"  tol {tol:<8g} 3D {errors[-1]:.5f}  inverse SNR "
                f"{100 * model.inverse_snr_:.5f}  steps {model.n_iter_:6}  largest "
                f"alpha {np.abs(model.alpha_).max():.1f}",
                flush=True,
            )
        print(f"  largest over smallest {max(errors) / min(errors):.4f}", flush=True)


def fit_set(X, camera, n_components, joint=JOINT_OPTIONS, **parameters):
    """Return the fit of a table with a camera, and other options of the joint fit."""
    settings = {"camera": camera, "random_state": 0, **parameters}
    return limited(Limits(joint=joint))(n_components, **settings).fit(X)


def errors_in_camera(truth, found, scale=False):
    """
    Return the errors "sequence" and "frame" of shapes in their cameras' axes.

    For "sequence" a common scale may be fitted, where images do not have that of the
    truth.
    """
    shapes = found.scales[:, None, None] * found.euclidean
    shapes = shapes @ found.rotations.transpose(0, 2, 1)
    return np.array(
        [
            mean_shape_error_3d(truth, shapes, scale=scale),
            mean_shape_error_3d(truth, shapes, convention="frame"),
        ]
    )


def found_in(model, X):
    """Return what a calibrated model finds in a table that is new to it."""
    rotations, scales = full_rotations(model.decompose(X).motion)
    return Found(X, None, model.reconstruct(X), rotations, scales)


def present(cases):
    """Return the sets that are there, each with camera and K."""
    return [case for case in cases if is_present(case[0])]


def title_of(name, camera, n_components):
    """Return what a fit of a set is called."""
    return f"{name} K={n_components}, {camera}"


def prior(options):
    """Errors by the prior of basis shapes and the least noise.

    With orthographic cameras that of the sequence, of ICT-68 `affine_shape_error`, and
    elsewhere that of the frames.
    """
    cases = present(CALIBRATED)
    print("   std   noise" + headings_of(cases))
    for basis_std in BASIS_STDS:
        for least_noise in LEAST_NOISES:
            joint = JOINT_OPTIONS._replace(basis_std=basis_std, least_noise=least_noise)
            errors = [chosen_error(*case, joint) for case in cases]
            row = "".join(f"{error:10.4f}" for error in errors)
            print(f"{basis_std:6g}{least_noise:8g}{row}", flush=True)


def noise(options):
    """Noise without floor and prior, to that of the spectrum; errors by the cut-off.

    Models are right up to a ratio of `JointOptions.right`. The errors are those of
    `prior`.
    """
    for kind in ("weak_perspective", "affine"):
        for K, fitted in ((2, 2), (2, 4), (4, 4), (4, 6), (4, 3), (4, 2)):
            ratios = [
                noise_ratio(
                    instance(seed, 68, K, level, camera=kind).data, kind, fitted
                )
                for seed in range(options.seeds)
                for level in (0.005, 0.02)
            ]
            title = f"{kind} K={K}, fitted with {fitted}"
            print(f"{title:40}{min(ratios):8.3f} to {max(ratios):.3f}", flush=True)
    for name, numbers in CUT.items():
        if is_present(name):
            X = load(name).X
            ratios = [noise_ratio(X, "weak_perspective", K) for K in numbers]
            listed = ", ".join(
                f"K={K} {ratio:.3g}" for K, ratio in zip(numbers, ratios, strict=True)
            )
            print(f"{name:12}{listed}", flush=True)
    cases = present(
        [
            (name, "weak_perspective" if name == "flag" else "orthographic", K)
            for name, numbers in CUT.items()
            for K in numbers
            if name != "ict_68"
        ]
    )
    print("cut-off" + headings_of(cases))
    for cut_off in CUT_OFFS:
        joint = JOINT_OPTIONS._replace(cut_off=cut_off)
        row = "".join(f"{chosen_error(*case, joint):10.4f}" for case in cases)
        print(f"{cut_off:7g}{row}", flush=True)


def noise_ratio(X, camera, n_components):
    """Return the noise without floor and prior, divided by that of the spectrum."""
    ratios, original = [], joint_fit.judged

    def recorded(problem, result, start, noise_level, missing_share):
        free = joint_fit.unregularised(problem, result.state)
        known = max(noise_level, 1e-10)
        ratios.append(free.state.noise / problem.mean_square / known)
        return original(problem, result, start, noise_level, missing_share)

    with mock.patch.object(joint_fit, "judged", recorded):
        fit_set(X, camera, n_components)
    return ratios[0]


def headings_of(cases):
    """Return the headings of a table with a column a case."""
    return "".join(f"{f'{name} {K}':>10}" for name, _, K in cases)


def chosen_error(name, camera, n_components, joint=JOINT_OPTIONS):
    """Return the error of a fit of a set that suits its camera, as of `prior`."""
    table = load(name)
    found = found_by_ours(fit_set(table.X, camera, n_components, joint), table.X)
    if name == "ict_68":
        return affine_shape_error(table.shapes, found.affine)
    sequence, frame = errors_in_camera(shapes_in_camera(name), found)
    return sequence if camera == "orthographic" else frame


def perspective(tracks, distance, noise, rng):
    """
    Return the table of perspective cameras, and the shapes in their axes.

    The cameras have the rotations of the tracks, and are so many radii away, which are
    root mean square distances of the mean shape's points from its centroid.
    """
    rotations = nearest_rotations(tracks.motion)[0]
    shapes = tracks.shapes @ rotations.transpose(0, 2, 1)
    radius = np.sqrt(np.mean(np.sum(tracks.mean_shape**2, axis=1)))
    images = shapes[..., :2] / (1 + shapes[..., 2:] / (distance * radius))
    size = np.sqrt(np.mean(centred_tracks(images)[0] ** 2))
    images = images + noise * size * rng.standard_normal(images.shape)
    return as_table(images), shapes


def seen_by_cameras(seed):
    """
    Yield tables of known cameras.

    Each has a title, a table, K, shapes in the axes of the cameras, and those in the
    space of the object or None.
    """
    for camera, K, fitted in (
        ("weak_perspective", 2, 2),
        ("weak_perspective", 4, 4),
        ("weak_perspective", 4, 2),
        ("affine", 2, 2),
        ("affine", 4, 4),
    ):
        tracks = instance(seed, 68, K, 0.02, camera=camera)
        rotations = nearest_rotations(tracks.motion)[0]
        shapes = tracks.shapes @ rotations.transpose(0, 2, 1)
        title = f"{camera} K={K}, fitted with {fitted}"
        yield title, tracks.data, fitted, shapes, tracks.shapes
    tracks = instance(seed, 68, 3, 0.0, camera="weak_perspective")
    for noise in (0.02, 0.0):
        for distance in DISTANCES:
            rng = np.random.default_rng(seed)
            X, shapes = perspective(tracks, distance, noise, rng)
            title = f"{distance:g} radii, K=3, {100 * noise:g} % noise"
            yield title, X, 3, shapes, tracks.shapes
    for name, K in TOO_SMALL if seed == 0 else ():
        if is_present(name):
            shapes = load(name).shapes if SETS[name].truth == "object" else None
            title = f"{name} K={K}"
            yield title, load(name).X, K, shapes_in_camera(name), shapes


def cameras(options):
    """What the noise says of the cameras, and errors with and without calibration."""
    rows, sentences = {}, {}
    for seed in range(options.seeds):
        for title, X, K, truth, shapes in seen_by_cameras(seed):
            row = []
            for camera in ("affine", "weak_perspective"):
                model = fit_set(X, camera, K)
                found = found_by_ours(model, X)
                affine = np.nan
                if shapes is not None:
                    affine = affine_shape_error(shapes, found.affine)
                row += [
                    model.camera_noise_ratio_,
                    affine,
                    errors_in_camera(truth, found)[1],
                ]
            rows.setdefault(title, []).append(row)
            with warnings.catch_warnings():
                warnings.simplefilter("ignore", UserWarning)
                meaning = model.diagnostics().camera_meaning
            sentences.setdefault(title, []).append(meaning.partition(" (")[0])
    print(
        f"{'':36}{'affine: ratio':>14}{'3D':>9}{'frame':>9}"
        f"{'weak perspective: ratio':>25}{'range':>18}{'3D':>9}{'frame':>9}"
    )
    for title, values in rows.items():
        middle, ratios = np.median(values, axis=0), np.array(values)[:, 3]
        spread = f"{ratios.min():.3f} to {ratios.max():.3f}"
        print(
            f"{title:36}{middle[0]:14.3f}{middle[1]:9.4f}{middle[2]:9.4f}"
            f"{middle[3]:25.3f}{spread:>18}{middle[4]:9.4f}{middle[5]:9.4f}"
        )
        for sentence in dict.fromkeys(sentences[title]):
            print(f"    {sentences[title].count(sentence)} times: {sentence}")


def with_noise(tracks, rng):
    """Return tracks with 2 % noise."""
    size = np.sqrt(np.mean(centred_tracks(tracks)[0] ** 2))
    return tracks + 0.02 * size * rng.standard_normal(tracks.shape)


def hidden_at_random(share):
    """Return what hides a share of the points, drawn at random."""

    def hide(tracks, rng):
        hidden = rng.random(tracks.shape[:2]) < share
        return np.where(hidden[..., None], np.nan, tracks)

    return hide


def with_hidden_run(tracks, rng):
    """Return tracks of which each frame hides a run of points, in their order."""
    n_frames, n_points, _ = tracks.shape
    first = rng.integers(n_points, size=n_frames)
    hidden = (np.arange(n_points) - first[:, None]) % n_points < RUN
    return np.where(hidden[..., None], np.nan, tracks)


SPOILS = {
    "2 % noise": with_noise,
    "30 % missing": hidden_at_random(0.3),
    "40 % missing": hidden_at_random(0.4),
    f"runs of {RUN} missing": with_hidden_run,
}


def common_rotation(truth, rotations):
    """Return C for which the products R C of true rotations are nearest to others."""
    return procrustes(np.einsum("iba,ibc->ac", truth, rotations))


def turn_errors(truth, rotations):
    """
    Return the angles in degrees between rotations after one common rotation.

    Parameters
    ----------
    truth, rotations : ndarray of shape (n_frames, 3, 3)
        Rotations.

    Returns
    -------
    ndarray of shape (n_frames,)
        Of the better of the two mirror images, by the median.
    """
    mirror = np.diag([1.0, 1.0, -1.0])
    angles = []
    for turned in (rotations, mirror @ rotations @ mirror):
        common = common_rotation(truth, turned)
        cosine = (np.einsum("iba,ibc,ac->i", truth, turned, common) - 1) / 2
        angles.append(np.degrees(np.arccos(np.clip(cosine, -1.0, 1.0))))
    return min(angles, key=np.median)


def turned_onto_mean(shapes, rotations):
    """
    Return shapes turned onto their mean, and rotations that see them as before.

    Images do not tell a turn of the camera from one of the object. Shapes that are
    turned onto their mean (generalised Procrustes analysis) leave nothing to choose.
    """
    shapes = shapes - shapes.mean(axis=1, keepdims=True)
    for _ in range(TURNING_ROUNDS):
        mean_shape = shapes.mean(axis=0)
        turns = [Rotation.align_vectors(S, mean_shape)[0].as_matrix() for S in shapes]
        shapes, rotations = shapes @ turns, rotations @ turns
    return shapes, rotations


def calibrated(options):
    """Calibrated cameras: errors "sequence" and "frame", rotations, new frames."""
    cleanest = {}
    print(f"{'complete tables':34}{'sequence':>10}{'frame':>9}")
    for case in present(CALIBRATED):
        name, camera, n_components = case
        X = load(name).X
        found = found_by_ours(fit_set(X, camera, n_components), X)
        cleanest[case] = found
        scale = SETS[name].camera != "orthographic"
        sequence, frame = errors_in_camera(shapes_in_camera(name), found, scale)
        print(f"{title_of(*case):34}{sequence:10.4f}{frame:9.4f}", flush=True)
    print(
        f"\n{'rotations, degrees':34}{'median':>10}{'largest':>9}"
        f"{'onto the mean:':>16}{'the truth:':>11}"
    )
    for case in present(TURNED):
        table, found = load(case[0]), cleanest[case]
        truth = nearest_rotations(table.cameras[:, :2])[0]
        angles = turn_errors(truth, found.rotations)
        _, turned_truth = turned_onto_mean(table.shapes, truth)
        _, turned = turned_onto_mean(found.euclidean, found.rotations)
        print(
            f"{title_of(*case):34}{np.median(angles):10.2f}{angles.max():9.2f}"
            f"{np.median(turn_errors(turned_truth, turned)):16.2f}"
            f"{np.median(turn_errors(truth, turned_truth)):11.2f}",
            flush=True,
        )
    print(f"\n{'half of the frames':34}{'sequence':>10}{'frame':>9}{'new:':>8}")
    for case in present(TURNED):
        name, camera, n_components = case
        X, truth = load(name).X, shapes_in_camera(name)
        errors = []
        for seed in range(options.seeds):
            train, test = halves_of(len(X), seed)
            model = fit_set(X[train], camera, n_components)
            fitted = errors_in_camera(truth[train], found_by_ours(model, X[train]))
            new = errors_in_camera(truth[test], found_in(model, X[test]))
            errors.append([*fitted, *new])
        row = "".join(f"{error:9.4f}" for error in np.median(errors, axis=0))
        print(f"{title_of(*case):35}{row}", flush=True)
    print(f"\n{'':34}{'sequence: median':>18}{'max':>8}{'frame: median':>16}{'max':>8}")
    for case in present(SPOILED):
        name, camera, n_components = case
        tracks, truth = load(name).X, shapes_in_camera(name)
        tracks = tracks.reshape(len(tracks), -1, 2)
        for what, spoil in SPOILS.items():
            errors = []
            for seed in range(options.seeds):
                X = as_table(spoil(tracks, np.random.default_rng(seed)))
                found = found_by_ours(fit_set(X, camera, n_components), X)
                errors.append(errors_in_camera(truth, found))
            middle, most = np.median(errors, axis=0), np.max(errors, axis=0)
            print(
                f"{name + ', ' + what:34}{middle[0]:18.4f}{most[0]:8.4f}"
                f"{middle[1]:16.4f}{most[1]:8.4f}",
                flush=True,
            )
    print(
        f"\n{'10 % outliers, loss cauchy':34}{'ratio of frame errors to the clean one'}"
    )
    for case in present(OUTLYING):
        name, camera, n_components = case
        X, truth = load(name).X, shapes_in_camera(name)
        model = fit_set(X, camera, n_components, loss="cauchy")
        clean = errors_in_camera(truth, found_by_ours(model, X))[1]
        ratios = []
        for seed in range(options.seeds):
            rng = np.random.default_rng(seed)
            moved = spoiled(X.reshape(len(X), -1, 2), "mixed", rng, 0.1)
            Y = as_table(moved)
            model = fit_set(Y, camera, n_components, loss="cauchy")
            error = errors_in_camera(truth, found_by_ours(model, Y))[1]
            ratios.append(error / clean)
        print(
            f"{title_of(*case):34}clean {clean:.4f}, ratios "
            f"{np.array2string(np.array(ratios), precision=3)}",
            flush=True,
        )


def starts(options):
    """Other starts: 3D difference to the default fit, and the objective."""
    others = {
        **{f"seed {seed}": {"seed": seed} for seed in range(1, options.seeds + 1)},
        "FastISA": {"isa": FastISA()},
        "block recovery irls": {"block_recovery": "irls"},
        "frames in another order": {},
    }
    for case in (ICT, DRINK, FACES):
        X = load_table(case)
        if X is None:
            continue
        first = fit(case, X)
        shapes = first.reconstruct(X)
        print(f"{case.title}: objective {first.objective_history_[-1]:.2f}")
        for title, parameters in others.items():
            table = X[::-1] if title.startswith("frames") else X
            other = fit(case, table, **parameters)
            difference = affine_shape_error(shapes, other.reconstruct(X))
            print(
                f"  {title:26}3D difference {100 * difference:8.4f} %  objective "
                f"{other.objective_history_[-1]:.2f}",
                flush=True,
            )


def planar(random_state=0):
    """Return a table of a flat shape that deforms in its plane."""
    flat = make_nonrigid_tracks(n_components=2, random_state=random_state)
    shapes = flat.shapes * [1.0, 1.0, 0.0]
    images = shapes @ flat.motion.transpose(0, 2, 1)
    noise = np.random.default_rng(0).normal(size=images.shape)
    return as_table(images + 1e-3 * noise)


def degenerate_tables():
    """Return tables with something degenerate, and how they are fitted, by name."""
    tracks = make_nonrigid_tracks(noise=0.01, random_state=0)
    rigid = make_nonrigid_tracks(n_components=0, noise=0.01, random_state=0)
    exact = make_nonrigid_tracks(n_components=0, random_state=0)
    two = tracks.motion.copy()
    two[:150], two[150:] = tracks.motion[0], tracks.motion[1]
    views = tracks.shapes @ two.transpose(0, 2, 1)
    doubled = np.concatenate([tracks.tracks, tracks.tracks[:, :10]], axis=1)
    cases = {
        "planar": (planar(), 2),
        "rigid, noise": (rigid.data, 1),
        "rigid, no noise": (exact.data, 1),
        "every frame thrice": (np.tile(tracks.data, (3, 1)), 3),
        "one frame 200 times": (
            np.concatenate([tracks.data, np.tile(tracks.data[:1], (200, 1))]),
            3,
        ),
        "ten points doubled": (as_table(doubled), 3),
        "two cameras": (as_table(views), 3),
    }
    for case in SHARK:
        X = load_table(case)
        if X is not None:
            cases[case.title] = (X, case.n_components)
    return cases


def degenerate(options):
    """Degenerate tables: finite, the same twice, warnings, 3D where known."""
    print(
        f"{'':22}{'finite':>7}{'again':>7}{'inverse SNR':>13}{'held out':>10}  warnings"
    )
    for title, (X, n_components) in degenerate_tables().items():
        with warnings.catch_warnings(record=True) as caught:
            warnings.simplefilter("always")
            models = [
                AffineNRSfM(n_components, random_state=0).fit(X) for _ in range(2)
            ]
            score = held_out(models[0], X)
        finite = all(
            np.isfinite(values).all()
            for name, values in vars(models[0]).items()
            if name.endswith("_") and isinstance(values, np.ndarray | float)
        )
        again = np.array_equal(models[0].alpha_, models[1].alpha_)
        kinds = sorted(
            {f"{w.category.__name__}: {str(w.message)[:50]}" for w in caught}
        )
        print(
            f"{title:22}{finite!s:>7}{again!s:>7}{100 * models[0].inverse_snr_:13.3g}"
            f"{score:10.3g}  {'; '.join(kinds) or 'none'}",
            flush=True,
        )


SECTIONS = {
    "tables": tables,
    "halves": halves,
    "classes": classes,
    "missing": missing,
    "outliers": outliers,
    "tolerances": tolerances,
    "prior": prior,
    "noise": noise,
    "cameras": cameras,
    "calibrated": calibrated,
    "starts": starts,
    "degenerate": degenerate,
    "paper": paper,
}

if __name__ == "__main__":
    steps = {"type": int, "default": MOST_STEPS, "help": "most steps of `tolerances`"}
    run(__doc__, SECTIONS, n_seeds=1, options={"steps": steps})
