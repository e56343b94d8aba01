"""Scenes: people who do one thing after the other, cameras, and what these see."""

from collections.abc import Callable
from numbers import Integral, Real
from typing import Any, Literal

import numpy as np
from numpy.random import RandomState
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from isa_nrsfm._compat.scikit_learn import Interval, StrOptions
from isa_nrsfm._tables.tracks import LAYOUTS, Layout, tracks_to_table

Camera = Literal["weak_perspective", "affine", "orthographic"]
CAMERAS: tuple[Camera, ...] = ("weak_perspective", "affine", "orthographic")

# Constraints of the parameters that all generated tables have in common.
PARAMETERS: dict[str, list[Any]] = {
    "n_frames": [Interval(Integral, 2, None, closed="left")],
    "camera": [StrOptions(set(CAMERAS))],
    "noise": [Interval(Real, 0, None, closed="left")],
    "missing": [Interval(Real, 0, 1, closed="left")],
    "layout": [StrOptions(set(LAYOUTS))],
    "random_state": ["random_state"],
}
# Frame rate of the videos.
FRAMES_A_SECOND = 25.0


def draw_motion(
    rotations: NDArray, camera: Camera, scales: tuple[float, float], rng: RandomState
) -> NDArray[np.float64]:
    """Return cameras (n_frames, 2, 3) that look along the z axis of the rotations.

    Scales are log-uniform, orthographic ones the geometric mean. Affine cameras stretch
    the image along a random axis, by 0.5 to 1 at constant area.
    """
    n_frames = len(rotations)
    shortest, longest = np.log(scales)
    # Drawn for each kind of camera, so that the rest of the scene is the same.
    log_scales = rng.uniform(shortest, longest, n_frames)
    ratios = rng.uniform(0.5, 1.0, n_frames)
    axes = rng.uniform(0.0, np.pi, n_frames)
    if camera == "orthographic":
        log_scales = np.full(n_frames, (shortest + longest) / 2)
    motion = np.exp(log_scales)[:, None, None] * rotations[:, :2]
    if camera == "affine":
        # Symmetric matrices of determinant 1 and the given singular ratios
        along = np.stack([np.cos(axes), np.sin(axes)], axis=1)[:, :, None]
        across = along[:, ::-1] * [[-1.0], [1.0]]
        longer, shorter = ratios[:, None, None] ** -0.5, ratios[:, None, None] ** 0.5
        motion = (longer * along * along.mT + shorter * across * across.mT) @ motion
    return motion


def standardise(coefficients: NDArray) -> NDArray[np.float64]:
    """Return coefficients with zero mean and unit variance over the frames."""
    centred = coefficients - coefficients.mean(axis=0)
    return centred / np.sqrt(np.mean(centred**2, axis=0))


def centre_shapes(shapes: NDArray) -> NDArray[np.float64]:
    """Return shapes (..., n_points, 3) centred over the points."""
    return shapes - shapes.mean(axis=-2, keepdims=True)


def observe(
    shapes: NDArray,
    motion: NDArray,
    translation: NDArray,
    rng: RandomState,
    noise: float,
    missing: float,
    layout: Layout,
) -> dict[str, Any]:
    """Return the table of shapes seen by cameras, and its ground truth."""
    clean = shapes @ motion.transpose(0, 2, 1) + translation[:, None]
    centred = clean - clean.mean(axis=1, keepdims=True)
    noise_variance = noise**2 * np.mean(centred**2)

    # Always drawn, so that noise and missing change nothing else.
    tracks = clean + np.sqrt(noise_variance) * rng.standard_normal(clean.shape)
    order = rng.permutation(clean[..., 0].size).reshape(clean.shape[:2])
    visible = order >= round(missing * order.size)
    tracks[~visible] = np.nan

    names = np.array([[f"{axis}_{j}" for axis in "xy"] for j in range(clean.shape[1])])
    return {
        "data": tracks_to_table(tracks, layout),
        "tracks": tracks,
        "clean": clean,
        "visible": visible,
        "motion": motion,
        "translation": translation,
        "shapes": shapes,
        "noise_variance": float(noise_variance),
        "feature_names": tracks_to_table(names[None], layout)[0].tolist(),
    }


def perform(
    n_frames: int,
    n_people: int,
    poses: tuple[str, ...],
    build: Callable[[NDArray, NDArray, RandomState], NDArray],
    rng: RandomState,
) -> tuple[NDArray, NDArray, dict[str, NDArray]]:
    """Return shapes of people who take poses in turn, a path (n, 6), and the truths.

    ``build(time, weights, rng)`` returns the shapes (n, n_points, 3) of a new person, x
    to the right, y down, z away, for weights (n, n_poses) that add up to one.
    """
    if n_frames < 2 * n_people:
        raise ValueError(
            f"n_frames must be at least 2 frames for each of {n_people} people; got "
            f"{n_frames}"
        )
    people = []
    for person, rows in enumerate(np.array_split(np.arange(n_frames), n_people)):
        time = np.arange(len(rows)) / FRAMES_A_SECOND
        weights = _take_turns(time, len(poses), rng)
        shapes = centre_shapes(build(time, weights, rng))
        path = np.hstack([wander(time, n, rng) for n in (3, 1, 2)])
        labels = np.array(poses)[weights.argmax(axis=1)]
        people.append((shapes, path, labels, np.full(len(rows), person), time))
    shapes, path, labels, groups, time = map(np.concatenate, zip(*people, strict=True))
    truths = {"labels": labels, "groups": groups, "time": time}
    return shapes, path, truths | {"mean_shape": shapes.mean(axis=0)}


def film(
    path: NDArray,
    largest_angles: tuple[float, float, float],
    scales: tuple[float, float],
    camera: Camera,
    rng: RandomState,
) -> tuple[NDArray, NDArray, NDArray]:
    """Return yaw, pitch and roll in degrees, the motion and translation of a path.

    The path (n, 6) is between -1 and 1. `scales` are the smallest and the largest
    number of pixels per unit.
    """
    angles = path[:, :3] * largest_angles
    shortest, longest = np.log(scales)
    sizes = np.exp(shortest + (longest - shortest) * ((1 + path[:, 3]) / 2))
    if camera == "orthographic":
        sizes = np.full(len(path), np.sqrt(np.prod(scales)))
    rotations = Rotation.from_euler("yxz", angles, degrees=True).as_matrix()
    motion = draw_motion(rotations, camera, (1.0, 1.0), rng)
    translation = (640.0, 480.0) + path[:, 4:] * (160.0, 100.0)
    return angles, sizes[:, None, None] * motion, translation


def wander(time: NDArray, n: int, rng: RandomState) -> NDArray[np.float64]:
    """Return n smooth functions of time, (len(time), n), between -1 and 1."""
    frequency = rng.uniform(0.08, 0.35, (2, n))  # waves per second
    phase = rng.uniform(0, 2 * np.pi, (2, n))
    waves = np.sin(2 * np.pi * frequency * time[:, None, None] + phase)
    return 0.6 * waves[:, 0] + 0.4 * waves[:, 1]


def _take_turns(time: NDArray, n_poses: int, rng: RandomState) -> NDArray[np.float64]:
    """Return the weights (len(time), n_poses) of poses that are taken in turn."""
    duration = len(time) / FRAMES_A_SECOND
    # A pose lasts 1.6 seconds, with a transition of 0.6 seconds to the next one.
    n_turns = max(n_poses, round(duration / 1.6))
    rounds = [rng.permutation(n_poses) for _ in range(-(-n_turns // n_poses))]
    turns = np.concatenate(rounds)[:n_turns]
    length = duration / n_turns
    change = min(0.6, length)
    # From 0 to 1 round the beginning of each turn but the first.
    begins = length * np.arange(1, n_turns)
    passed = np.clip((time[:, None] - begins) / change + 0.5, 0.0, 1.0)
    begun = np.insert((1 - np.cos(np.pi * passed)) / 2, 0, 1.0, axis=1)
    share = -np.diff(begun, axis=1, append=0.0)
    weights = np.zeros((len(time), n_poses))
    np.add.at(weights.T, turns, share.T)
    return weights
