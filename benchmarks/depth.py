"""Measure depths of made tables, their stated deviations, and those of rotations."""

import argparse
import warnings
from functools import partial

import numpy as np
from scipy.spatial.transform import Rotation

from benchmarks._sets import ICT, Case, load_arrays
from benchmarks.accuracy import common_rotation
from isa_nrsfm import AffineNRSfM
from isa_nrsfm.datasets import make_body_tracks, make_face_tracks, make_hand_tracks
from isa_nrsfm.export import frame_poses

# Spread of pitch, yaw and roll, relative to that of yaw; of the scales of cameras.
SHARES, SCALES = (0.7, 1.0, 0.5), 0.2


def shapes_of(kind, n_frames, seed, ict):
    """Return true shapes (n_frames, n_points, 3), or None if they are not there."""
    if kind == "ICT-68 faces":
        if ict is None:
            return None
        rng = np.random.default_rng(seed)
        return ict["S3d"][rng.choice(len(ict["S3d"]), n_frames, replace=False)]
    make = make_body_tracks if kind == "bodies" else make_face_tracks
    return make(n_frames, random_state=seed).shapes


def seen(shapes, degrees, noise, seed):
    """Return a table, points in the axes of the camera, and rotations."""
    rng, n_frames = np.random.default_rng(seed), len(shapes)
    shapes = shapes - shapes.mean(axis=1, keepdims=True)
    vectors = np.radians(degrees) * rng.normal(size=(n_frames, 3)) * SHARES
    rotations = Rotation.from_rotvec(np.clip(vectors, -1.4, 1.4)).as_matrix()
    points = shapes @ rotations.transpose(0, 2, 1)
    points *= np.exp(SCALES * rng.normal(size=(n_frames, 1, 1)))
    size = np.sqrt(np.mean(points[:, :, :2] ** 2, axis=(1, 2), keepdims=True))
    tracks = points[:, :, :2] + noise * size * rng.normal(size=points[:, :, :2].shape)
    return tracks.reshape(n_frames, -1), points, rotations


def depth_error(model, X, points):
    """Compute the error of depths relative to the true and to the fitted ones."""
    z = np.einsum("ijc,ic->ij", model.reconstruct(X), model.rotations_[:, 2])
    z = model.scales_[:, None] * (z - z.mean(axis=1, keepdims=True))
    truth = points[:, :, 2] - points[:, :, 2].mean(axis=1, keepdims=True)
    off = np.sign(np.sum(z * truth)) * z - truth
    return np.sqrt(np.sum(off**2) / [np.sum(truth**2), np.sum(z**2)])


def rotation_ratio(model, X, rotations):
    """Return the error of rotations over its deviation, and its median in degrees."""
    precision = np.linalg.inv(model.rotation_covariance(X))
    found = []
    for mirror in (np.eye(3), np.diag([1.0, 1.0, -1.0])):
        turned = mirror @ model.rotations_ @ mirror
        off = (rotations @ common_rotation(rotations, turned)).transpose(
            0, 2, 1
        ) @ turned
        off = Rotation.from_matrix(off).as_rotvec() @ mirror
        ratio = np.sqrt(np.einsum("ia,iab,ib->i", off, precision, off).mean() / 3)
        found.append((np.degrees(np.median(np.linalg.norm(off, axis=1))), ratio))
    return min(found)[::-1]


def animal(n_frames, rng):
    """Return shapes (n_frames, 18, 3) of a walking animal: x ahead, y down, z aside."""
    body = [(x, y, z) for x in (-60, 0, 60) for y in (-15, 15) for z in (-12, 12)]
    points = np.tile(np.array(body[:10], dtype=float), (n_frames, 1, 1))
    phase = 2 * np.pi * np.cumsum(rng.uniform(0.6, 1.4, n_frames)) / 30
    for leg, (x, z) in enumerate((x, z) for x in (-55, 55) for z in (-15, 15)):
        swing = 0.5 * np.sin(phase + np.pi * (leg in (0, 3)))
        for length in (30.0, 60.0):
            foot = x + length * np.sin(swing), 15 + length * np.cos(swing)
            foot = np.stack([*foot, np.full(n_frames, z)], axis=1)
            points = np.append(points, foot[:, None], axis=1)
    return points


def sheet(n_frames, rng):
    """Return shapes (n_frames, 49, 3) of a sheet with two waves, across and along."""
    x, y = (axis.ravel() for axis in np.meshgrid(*2 * [np.linspace(-1, 1, 7)]))
    a, b = 0.3 * rng.normal(size=(2, n_frames, 1))
    z = a * np.sin(2 * x) + b * np.cos(2 * y)
    flat = np.broadcast_to(np.stack([x, y], axis=1), (n_frames, 49, 2))
    return np.concatenate([flat, z[:, :, None]], axis=2)


def flat_hand(n_frames, rng):
    """Return shapes (n_frames, 21, 3) of hands whose fingers move in one plane."""
    shapes = make_hand_tracks(n_frames, random_state=rng.integers(2**31)).shapes
    flat = (shapes - shapes.mean(axis=(0, 1))).reshape(-1, 3)
    axes = np.linalg.svd(flat, full_matrices=False)[2]
    return (shapes @ axes.T) * (1.0, 1.0, 0.02)


def captured(n_frames, rng, file):
    """Return shapes of a file at equal distances, or None where it is absent."""
    arrays = load_arrays(Case(file, file, 8))
    if arrays is None:
        return None
    shapes = arrays.get("S3d_world", arrays["S3d"]).astype(float)
    return shapes[np.linspace(0, len(shapes) - 1, n_frames).astype(int)]


# Objects whose depth is invented easily if they hardly turn, and numbers of shapes
OBJECTS = {
    "animals from the side": (animal, 4),
    "flat hands": (flat_hand, 4),
    "sheets": (sheet, 2),
    **{
        file: (partial(captured, file=file), 8)
        for file in ("cmu_body", "rat_23", "fly_legs_30")
    },
}


def measured(kind, n_components, degrees, noise, seed, n_frames, ict):
    """Return the figures of one table, None if its shapes are not there."""
    if kind in OBJECTS:
        shapes = OBJECTS[kind][0](n_frames, np.random.default_rng(seed))
    else:
        shapes = shapes_of(kind, n_frames, seed, ict)
    if shapes is None:
        return None
    X, points, rotations = seen(shapes, degrees, noise, seed)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        model = AffineNRSfM(n_components, camera="weak_perspective", random_state=0)
        model.fit(X)
    ratio, angle = rotation_ratio(model, X, rotations)
    error = depth_error(model, X, points)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        given = np.isfinite(frame_poses(model).yaw).all()
    return *error, model.depth_uncertainty_, ratio, angle, given


def main(argv=None):
    """Print a row for each kind of table."""
    parser = argparse.ArgumentParser(prog="python -m benchmarks.depth")
    parser.add_argument("--seeds", type=int, default=3)
    parser.add_argument("--frames", type=int, default=200)
    parser.add_argument("--noise", type=float, nargs="+", default=[0.01])
    parser.add_argument(
        "--degrees", type=float, nargs="+", default=[2, 4, 6, 10, 20, 40]
    )
    parser.add_argument("--kinds", nargs="+", default=[])
    options = parser.parse_args(argv)
    ict = load_arrays(ICT)
    cases = [("ICT-68 faces", 3), ("ICT-68 faces", 9)]
    cases += [
        ("generated faces", 3),
        ("generated faces", 9),
        ("bodies", 3),
        ("bodies", 12),
        *((kind, K) for kind, (_, K) in OBJECTS.items()),
    ]
    cases = [case for case in cases if not options.kinds or case[0] in options.kinds]
    print(
        "| shapes | K | noise | turned by | error of depths, relative to the true "
        "depths | relative to the fitted depths | estimated (`depth_uncertainty_`) | "
        "error below twice the estimate | depth determined | "
        "error of rotations, degrees | RMS of this error over its standard deviation |"
    )
    print("|---" * 11 + "|")
    for kind, n_components in cases:
        for noise in options.noise:
            for degrees in options.degrees:
                found = [
                    measured(
                        kind, n_components, degrees, noise, seed, options.frames, ict
                    )
                    for seed in range(options.seeds)
                ]
                if found[0] is None:
                    continue
                true, error, stated, ratio, angle, given = np.array(
                    found, dtype=float
                ).T
                within = int(np.sum(error < 2 * stated))
                print(
                    f"| {kind} | {n_components} | {100 * noise:g} % | {degrees:g} | "
                    f"{np.sqrt(np.mean(true**2)):.3f} | "
                    f"{np.sqrt(np.mean(error**2)):.3f} | "
                    f"{np.sqrt(np.mean(stated**2)):.3f} | {within} of {len(error)} | "
                    f"{int(given.sum())} of {len(error)} | {np.median(angle):.1f} | "
                    f"{np.sqrt(np.mean(ratio**2)):.1f} |",
                    flush=True,
                )


if __name__ == "__main__":
    main()
