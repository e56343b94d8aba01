"""
Print what fits of real tables reach: reprojection, 3D truth, unseen points.

Run ``python -m benchmarks.accuracy [section ...] [--seeds N]``. Errors in 3D are
`affine_shape_error`; inverse SNR is in percent, of frames scaled to unit size. Errors
of Euclidean shapes are `mean_shape_error_3d`, of shapes in the axes of their cameras:
"sequence", without a scale unless cameras have unknown ones, and "frame".
"""

import warnings

import numpy as np
from scipy.spatial.transform import Rotation
from sklearn.linear_model import LinearRegression
from sklearn.metrics import r2_score
from sklearn.model_selection import cross_val_predict

from benchmarks._methods import found_by_ours
from benchmarks._run import run_sections
from benchmarks._sets import (
    CASES,
    SETS,
    as_table,
    centred_tracks,
    instance,
    is_present,
    load,
    load_arrays,
    rotations_and_scales,
    shapes_in_camera,
)
from isa_nrsfm import AffineNRSfM
from isa_nrsfm._estimator import limited
from isa_nrsfm._joint.settings import Limits
from isa_nrsfm.datasets import make_face_tracks
from isa_nrsfm.metrics import affine_shape_error, mean_shape_error_3d

# Sets, camera and K of calibrated fits, with frames that are not scaled where the
# camera is orthographic. True rotations of the first four are known.
CALIBRATED = (
    ("ict_68", "weak_perspective", 9),
    ("yoga", "orthographic", 12),
    ("pickup", "orthographic", 12),
    ("drink", "orthographic", 12),
    ("shark", "orthographic", 1),
    ("shark", "orthographic", 2),
    ("flag", "weak_perspective", 12),
    ("yoga", "affine", 3),
    ("pickup", "affine", 3),
)
TURNED = CALIBRATED[:4]
# Rounds in which shapes are turned onto their mean.
TURNING_ROUNDS = 10
# Distances of perspective cameras, in radii of the object.
DISTANCES = (8.0, 4.0, 2.5)
# Faces before a webcam: millimetres and degrees, pixels, wrong factors and pixels
NEAR_AND_FAR = ((400, 20), (400, 5), (400, 40), (5000, 5), (5000, 40))
FOCAL_LENGTH, FACTORS, OFF_CENTRE = 1000.0, (0.5, 0.7, 0.85, 1.2, 1.4), (50, 100, 200)
# Sets with too few basis shapes, and one with nearly enough; more of them.
TOO_SMALL = (("yoga", 3), ("pickup", 3), ("drink", 3), ("shark", 1), ("ict_68", 9))
LARGER = (("yoga", 12), ("pickup", 12), ("drink", 12), ("shark", 2), ("flag", 5))
# Unknowns of a frame: position and camera.
N_POSE = {"affine": 8, "weak_perspective": 6}


def fit(case, X, seed=0, **parameters):
    """Return the fit of a table as the case says."""
    settings = {"scale_frames": case.scale_frames, "random_state": seed, **parameters}
    return AffineNRSfM(case.n_components, **settings).fit(X)


def tables(options):
    """Joint refinement, all rows: reprojection, held-out points, 3D, largest alpha."""
    print(
        f"{'':22}{'inverse SNR: min':>17}{'max':>9}{'floor':>9}{'held out':>10}"
        f"{'3D: min':>10}{'max':>8}{'paper':>8}{'rigid':>8}{'alpha':>7}{'steps':>7}"
    )
    for case in CASES:
        arrays = load_arrays(case)
        if arrays is None:
            continue
        X, truth = as_table(arrays["W2d"]), arrays.get("S3d")
        models = [fit(case, X, seed) for seed in range(options.seeds)]
        paper = fit(case, X, refinement="alternating")
        shapes = [model.reconstruct(X) for model in (*models, paper)]
        shapes.append(np.broadcast_to(paper.mean_shape_, shapes[0].shape))
        *errors, papers, rigid = [
            np.nan if truth is None else affine_shape_error(truth, S) for S in shapes
        ]
        snr, model = [100 * model.inverse_snr_ for model in models], models[-1]
        print(
            f"{case.title:22}{min(snr):17.5f}{max(snr):9.5f}"
            f"{100 * model.rank_floor_:9.5f}{-100 * model.score(X):10.4f}"
            f"{min(errors):10.4f}{max(errors):8.4f}{papers:8.4f}{rigid:8.4f}"
            f"{np.abs(model.alpha_).max():7.1f}{model.n_iter_:7}",
            flush=True,
        )


def fit_set(X, camera, n_components, limits=None, **parameters):
    """Return the fit of a table with a camera, and other limits of the fit."""
    settings = {"camera": camera, "random_state": 0, **parameters}
    return limited(limits or Limits())(n_components, **settings).fit(X)


def errors_in_camera(truth, found, scale=False):
    """
    Return the errors "sequence" and "frame" of shapes in their cameras' axes.

    For "sequence" a common scale may be fitted, where images do not have that of the
    truth.
    """
    shapes = found.in_camera()
    sequence = mean_shape_error_3d(truth, shapes, scale=scale)
    return sequence, mean_shape_error_3d(truth, shapes, convention="frame")


def noise(options):
    """Noise without floor and prior, to that of the spectrum.

    Models are right up to a ratio of `Limits.right`.
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
    for name, K in sorted(TOO_SMALL + LARGER):
        if is_present(name):
            ratio = noise_ratio(load(name).X, "weak_perspective", K)
            print(f"{f'{name} K={K}':40}{ratio:8.3g}", flush=True)


def noise_ratio(X, camera, n_components):
    """Return the noise without floor and prior, divided by that of the spectrum.

    Neither is corrected for the unknowns of the fit.
    """
    model = fit_set(X, camera, n_components, Limits(right=np.inf))
    n_frames, n_others, n_shapes = len(X), X.shape[1] // 2 - 1, n_components + 1
    spectrum = model.rank_floor_ * n_others / (n_others - 3 * n_shapes)
    unknowns = N_POSE[camera] * n_frames + n_shapes * (3 * n_others - n_shapes) - 8
    residual = model.noise_variance_ * (1 - unknowns / X.size)
    return residual / max(spectrum, 1e-10)


def perspective(tracks, distance, noise, rng):
    """
    Return the table of perspective cameras, and the shapes in their axes.

    The cameras have the rotations of the tracks, and are so many radii away, which are
    root mean square distances of the mean shape's points from its centroid.
    """
    rotations, _ = rotations_and_scales(tracks.motion)
    shapes = tracks.shapes @ rotations.transpose(0, 2, 1)
    radius = np.sqrt(np.mean(np.sum(tracks.mean_shape**2, axis=1)))
    images = shapes[..., :2] / (1 + shapes[..., 2:] / (distance * radius))
    size = np.sqrt(np.mean(centred_tracks(images) ** 2))
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
        rotations = rotations_and_scales(tracks.motion)[0]
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


def common_rotation(truth, rotations):
    """Return C for which the products R C of true rotations are nearest to others."""
    return Rotation.from_matrix(truth.transpose(0, 2, 1) @ rotations).mean().as_matrix()


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
        off = (truth @ common_rotation(truth, turned)).transpose(0, 2, 1) @ turned
        angles.append(np.degrees(Rotation.from_matrix(off).magnitude()))
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
    """Calibrated cameras: errors "sequence" and "frame", degrees between rotations.

    The last columns are angles after shapes are turned onto their mean, and how far
    that turns the truth.
    """
    print(
        f"{'':34}{'sequence':>10}{'frame':>9}{'median angle':>15}{'largest':>9}"
        f"{'onto the mean:':>16}{'the truth:':>11}"
    )
    for case in CALIBRATED:
        name, camera, n_components = case
        if not is_present(name):
            continue
        table, scale = load(name), SETS[name].camera != "orthographic"
        found = found_by_ours(fit_set(table.X, camera, n_components), table.X)
        errors = errors_in_camera(shapes_in_camera(name), found, scale)
        line = f"{f'{name} K={n_components}, {camera}':34}" + "".join(
            f"{error:{width}.4f}" for error, width in zip(errors, (10, 9), strict=True)
        )
        if case in TURNED:
            truth, _ = rotations_and_scales(table.cameras[:, :2])
            angles = turn_errors(truth, found.rotations)
            _, turned_truth = turned_onto_mean(table.shapes, truth)
            _, turned = turned_onto_mean(found.euclidean, found.rotations)
            line += (
                f"{np.median(angles):15.2f}{angles.max():9.2f}"
                f"{np.median(turn_errors(turned_truth, turned)):16.2f}"
                f"{np.median(turn_errors(truth, turned_truth)):11.2f}"
            )
        print(line, flush=True)


def before_a_webcam(distance, degrees, seed):
    """
    Return images of a face, and the truth: shapes, coefficients, rotations, positions.

    The face is everywhere in images of 1280 x 720 pixels, up to 15 % nearer or farther
    than the distance. It turns to either side by so many degrees (yaw), and by 60 and
    50 % of them (pitch, roll).
    """
    faces, rng = make_face_tracks(300, random_state=seed), np.random.default_rng(seed)
    angles = rng.uniform(-1, 1, (300, 3)) * degrees * (1.0, 0.6, 0.5)
    rotations = Rotation.from_euler("yxz", angles, degrees=True).as_matrix()
    rays = rng.uniform(-1, 1, (300, 3)) * (0.25, 0.15, 0) + (0, 0, 1)
    places = distance * rng.uniform(0.85, 1.15, (300, 1)) * rays
    points = faces.shapes @ rotations.mT + places[:, None]
    images = FOCAL_LENGTH * points[..., :2] / points[..., 2:] + (640, 360)
    size = np.sqrt(np.mean(centred_tracks(images) ** 2, axis=(1, 2), keepdims=True))
    images += 0.005 * size * rng.normal(size=images.shape)
    return as_table(images), faces.shapes, faces.alpha, rotations, places


def webcam(options):
    """Faces before a webcam: errors of shapes, poses, distances; R^2 of coefficients.

    Errors are "frame", the median angle and the standard deviation of log distances.
    Focal lengths are given or estimated, principal points are off to the right.
    """
    print(f"{'':43}    frame      R^2    angle distance        f      std")
    for distance, degrees in NEAR_AND_FAR:
        fits = {
            "weak perspective": ("weak_perspective", None, 0),
            "f estimated": ("perspective", None, 0),
            "f given": ("perspective", 1.0, 0),
        }
        if (distance, degrees) in NEAR_AND_FAR[:2]:
            fits |= {f"f times {x:g}": ("perspective", x, 0) for x in FACTORS}
            fits |= {f"centre off by {x}": ("perspective", 1.0, x) for x in OFF_CENTRE}
        for title, (camera, factor, off) in fits.items():
            rows = []
            for seed in range(options.seeds):
                X, shapes, *truth = before_a_webcam(distance, degrees, seed)
                alpha, rotations, places = truth
                lens = {"focal_length": factor and factor * FOCAL_LENGTH}
                lens |= {"principal_point": (640 + off, 360)}
                model = fit_set(X, camera, 4, **lens)
                found = found_by_ours(model, X).euclidean
                told = cross_val_predict(LinearRegression(), model.alpha_, alpha)
                row = [
                    mean_shape_error_3d(shapes, found, convention="frame"),
                    r2_score(alpha, told),
                    np.median(turn_errors(rotations, model.rotations_)),
                ]
                if camera == "perspective":
                    ratios = model.positions_[:, 2] / places[:, 2]
                    focal = model.focal_length_, model.focal_length_std_
                    row += [np.std(np.log(ratios)), *focal]
                rows.append(row)
            title = f"{distance / 1000:g} m, +-{degrees} degrees, {title}"
            figures = [f"{value:9.4g}" for value in np.median(rows, axis=0)]
            print(f"{title:43}", *figures, sep="", flush=True)


SECTIONS = {
    "tables": tables,
    "noise": noise,
    "cameras": cameras,
    "calibrated": calibrated,
    "webcam": webcam,
}

if __name__ == "__main__":
    run_sections(__doc__, SECTIONS)
