"""Cameras of generated scenes, and what they see."""

from numbers import Integral, Real
from typing import Any, Literal

import numpy as np
from numpy.random import RandomState
from numpy.typing import NDArray

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
