"""People who do one thing after the other before a moving camera."""

from collections.abc import Callable
from typing import Any

import numpy as np
from numpy.random import RandomState
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation
from sklearn.utils import Bunch

from isa_nrsfm.datasets._scene import (
    FRAMES_A_SECOND,
    Camera,
    centre_shapes,
    draw_motion,
    observe,
)


def perform(
    n_frames: int,
    n_people: int,
    poses: tuple[str, ...],
    build: Callable[[NDArray, NDArray, RandomState], NDArray],
    *,
    largest_angles: tuple[float, float, float],
    scales: tuple[float, float],
    camera: Camera,
    rng: RandomState,
    **options: Any,
) -> Bunch:
    """Return the table of people who take poses in turn, with all truths.

    ``build(time, weights, rng)`` returns the shapes (n, n_points, 3) of a new person, x
    to the right, y down, z away, for weights (n, n_poses) that add up to one.
    `largest_angles` are yaw, pitch and roll in degrees, `scales` the least and most
    pixels a millimetre.
    """
    if n_frames < 2 * n_people:
        raise ValueError(
            f"n_frames must be at least 2 frames for each of {n_people} people; got "
            f"{n_frames}"
        )
    parts = [len(part) for part in np.array_split(np.arange(n_frames), n_people)]
    shapes, labels, groups, times, angles, sizes, centres = ([] for _ in range(7))
    for person, length in enumerate(parts):
        time = np.arange(length) / FRAMES_A_SECOND
        weights = _take_turns(time, len(poses), rng)
        shapes.append(centre_shapes(build(time, weights, rng)))
        labels.append(np.array(poses)[weights.argmax(axis=1)])
        groups.append(np.full(length, person))
        times.append(time)
        angles.append(wander(time, 3, rng) * largest_angles)
        shortest, longest = np.log(scales)
        share = (1 + wander(time, 1, rng)[:, 0]) / 2
        sizes.append(np.exp(shortest + (longest - shortest) * share))
        centres.append((640.0, 480.0) + wander(time, 2, rng) * (160.0, 100.0))
    angle, size = np.concatenate(angles), np.concatenate(sizes)
    rotations = Rotation.from_euler("yxz", angle, degrees=True).as_matrix()
    motion = draw_motion(rotations, camera, (1.0, 1.0), rng)
    if camera == "orthographic":
        size = np.full(n_frames, np.sqrt(np.prod(scales)))
    all_shapes = np.concatenate(shapes)
    return observe(
        all_shapes,
        size[:, None, None] * motion,
        np.concatenate(centres),
        rng=rng,
        mean_shape=all_shapes.mean(axis=0),
        labels=np.concatenate(labels),
        groups=np.concatenate(groups),
        time=np.concatenate(times),
        angles=angle,
        **options,
    )


def wander(time: NDArray, n: int, rng: RandomState) -> NDArray[np.float64]:
    """Return n smooth functions of time, (len(time), n), between -1 and 1."""
    frequency = rng.uniform(0.08, 0.35, (2, n))  # waves a second
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
