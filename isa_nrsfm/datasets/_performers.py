"""People who do one thing after the other before a moving camera."""

from collections.abc import Callable

import numpy as np
from numpy.random import RandomState
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from isa_nrsfm.datasets._scene import (
    FRAMES_A_SECOND,
    Camera,
    centre_shapes,
    draw_motion,
)


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
    share = begun - np.append(begun[:, 1:], np.zeros((len(time), 1)), axis=1)
    weights = np.zeros((len(time), n_poses))
    np.add.at(weights.T, turns, share.T)
    return weights
