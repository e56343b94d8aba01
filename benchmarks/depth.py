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

# Spread of pitch, yaw and roll, relative to that of yaw; of the scales of cameras;
# noise, a share of the size of a frame.
SHARES, SCALES, NOISE = (0.7, 1.0, 0.5), 0.2, 0.01


def made(n_frames, seed, make):
    """Return shapes (n_frames, n_points, 3) of a generator of tracks."""
    return make(n_frames, random_state=seed).shapes


def rendered(n_frames, seed):
    """Return shapes (n_frames, 68, 3) of ICT-68, or None where it is absent."""
    arrays = load_arrays(ICT)
    if arrays is None:
        return None
    rng = np.random.default_rng(seed)
    return arrays["S3d"][rng.choice(len(arrays["S3d"]), n_frames, replace=False)]


def seen(shapes, degrees, seed):
    """Return a table, points in the axes of the camera, and rotations."""
    rng, n_frames = np.random.default_rng(seed), len(shapes)
    shapes = shapes - shapes.mean(axis=1, keepdims=True)
    vectors = np.radians(degrees) * rng.normal(size=(n_frames, 3)) * SHARES
    rotations = Rotation.from_rotvec(np.clip(vectors, -1.4, 1.4)).as_matrix()
    points = shapes @ rotations.transpose(0, 2, 1)
    points *= np.exp(SCALES * rng.normal(size=(n_frames, 1, 1)))
    size = np.sqrt(np.mean(points[:, :, :2] ** 2, axis=(1, 2), keepdims=True))
    tracks = points[:, :, :2] + NOISE * size * rng.normal(size=points[:, :, :2].shape)
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


def animal(n_frames, seed):
    """Return shapes (n_frames, 18, 3) of a walking animal: x ahead, y down, z aside."""
    rng = np.random.default_rng(seed)
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


def sheet(n_frames, seed):
    """Return shapes (n_frames, 49, 3) of a sheet with two waves, across and along."""
    rng = np.random.default_rng(seed)
    x, y = (axis.ravel() for axis in np.meshgrid(*2 * [np.linspace(-1, 1, 7)]))
    a, b = 0.3 * rng.normal(size=(2, n_frames, 1))
    z = a * np.sin(2 * x) + b * np.cos(2 * y)
    flat = np.broadcast_to(np.stack([x, y], axis=1), (n_frames, 49, 2))
    return np.concatenate([flat, z[:, :, None]], axis=2)


def bird(n_frames, seed):
    """Return shapes (n_frames, 12, 3) of a bird: x ahead, y down, z aside."""
    rng = np.random.default_rng(seed)
    phase = np.cumsum(rng.uniform(0.3, 0.8, n_frames))
    trunk = np.zeros((n_frames, 4, 3))
    trunk[:, :, 0] = -1.2, -0.4, 0.4, 1.2
    parts = [trunk]
    for side in (-1, 1):
        wing = np.zeros((n_frames, 4, 3))
        for point, span in enumerate((0.5, 1.0, 1.6, 2.2)):
            angle = 0.9 * np.sin(phase - 0.5 * (span >= 1))
            wing[:, point, 0] = 0.1 * span * np.sin(phase)
            wing[:, point, 1] = -span * np.sin(angle)
            wing[:, point, 2] = side * span * np.cos(angle)
        parts.append(wing)
    return np.concatenate(parts, axis=1)


def fish(n_frames, seed):
    """Return shapes (n_frames, 22, 3) of a fish from above, along which a wave runs."""
    rng = np.random.default_rng(seed)
    phase = np.cumsum(rng.uniform(0.2, 0.6, n_frames))[:, None]
    along = np.linspace(0, 1, 12)
    wave = 0.25 * along**1.5 * np.sin(2 * np.pi * along - phase)
    middle = np.stack([np.broadcast_to(1 - 2 * along, wave.shape), wave, 0 * wave], 2)
    fins = [middle[:, 3:8] + (0.0, 0.0, height) for height in (0.35, -0.3)]
    return np.concatenate([middle, *fins], axis=1)


def flat_hand(n_frames, seed):
    """Return shapes (n_frames, 21, 3) of hands whose fingers move in one plane."""
    hands = np.random.default_rng(seed).integers(2**31)
    shapes = made(n_frames, hands, make_hand_tracks)
    flat = (shapes - shapes.mean(axis=(0, 1))).reshape(-1, 3)
    axes = np.linalg.svd(flat, full_matrices=False)[2]
    return (shapes @ axes.T) * (1.0, 1.0, 0.02)


def captured(n_frames, seed, file):
    """Return shapes of a file at equal distances, or None where it is absent."""
    arrays = load_arrays(Case(file, file, 8))
    if arrays is None:
        return None
    shapes = arrays.get("S3d_world", arrays["S3d"]).astype(float)
    return shapes[np.linspace(0, len(shapes) - 1, n_frames).astype(int)]


# Shapes and numbers of basis shapes; in the second half depths are invented easily if
# the objects hardly turn.
OBJECTS = {
    "ICT-68 faces": (rendered, 3),
    "generated faces": (partial(made, make=make_face_tracks), 3),
    "bodies": (partial(made, make=make_body_tracks), 3),
    "animals from the side": (animal, 4),
    "flat hands": (flat_hand, 4),
    "sheets": (sheet, 2),
    "birds from above": (bird, 3),
    "fish from above": (fish, 3),
    **{
        file: (partial(captured, file=file), 8)
        for file in ("cmu_body", "rat_23", "fly_legs_30")
    },
}


def measured(kind, n_components, degrees, seed, options):
    """Return the figures of one table, None if its shapes are not there."""
    shapes = OBJECTS[kind][0](options.frames, seed)
    if shapes is None:
        return None
    X, points, rotations = seen(shapes, degrees, seed)
    with warnings.catch_warnings(action="ignore"):
        model = AffineNRSfM(n_components, camera="weak_perspective", random_state=0)
        model.fit(X)
        given = np.isfinite(frame_poses(model).yaw).all()
    ratio, angle = rotation_ratio(model, X, rotations)
    error = depth_error(model, X, points)
    return *error, model.depth_uncertainty_, ratio, angle, given


def main(argv=None):
    """Print a row for each kind of table."""
    parser = argparse.ArgumentParser(prog="python -m benchmarks.depth")
    parser.add_argument("--seeds", type=int, default=3)
    parser.add_argument("--frames", type=int, default=200)
    every = [2, 4, 6, 10, 20, 40]
    parser.add_argument("--degrees", type=float, nargs="+", default=every)
    parser.add_argument("--kinds", nargs="+", default=[])
    options = parser.parse_args(argv)
    print(f"{'shapes':22} K turned  of true  of fitted  stated  given  degrees  e/std")
    for kind, (_, K) in OBJECTS.items():
        for degrees in options.degrees if kind in (options.kinds or [kind]) else ():
            seeds = range(options.seeds)
            found = [measured(kind, K, degrees, seed, options) for seed in seeds]
            if None not in found:
                true, error, stated, ratio, angle, given = np.array(found, float).T
                root = [np.sqrt(np.mean(x**2)) for x in (true, error, stated, ratio)]
                print(
                    f"{kind:22}{K:2}{degrees:7g}{root[0]:9.3f}{root[1]:11.3f}"
                    f"{root[2]:8.3f}{given.sum():7.0f}{np.median(angle):9.1f}"
                    f"{root[3]:7.1f}",
                    flush=True,
                )


if __name__ == "__main__":
    main()
