"""Draw cameras and look through them at deforming shapes."""

from typing import Any, Literal

import numpy as np
from numpy.random import RandomState
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation
from sklearn.utils import Bunch

from isa_nrsfm._tables.layout import Layout, tracks_to_table

Camera = Literal["weak_perspective", "affine", "orthographic"]
CAMERAS: tuple[Camera, ...] = ("weak_perspective", "affine", "orthographic")

# Of the videos that the tables are said to be from.
FRAMES_A_SECOND = 25.0
# The smaller singular value of an affine camera is at least this share of the larger.
SMALLEST_RATIO = 0.5


def uniform_rotations(n_frames: int, rng: RandomState) -> NDArray[np.float64]:
    """Return rotations (n_frames, 3, 3) spread uniformly over all orientations."""
    return Rotation.from_quat(rng.standard_normal((n_frames, 4))).as_matrix()


def draw_motion(
    rotations: NDArray, camera: Camera, scales: tuple[float, float], rng: RandomState
) -> NDArray[np.float64]:
    """Return cameras (n_frames, 2, 3) that look along the z axis of the rotations.

    The scales are drawn log-uniformly between the two given; orthographic cameras all
    have their geometric mean. Affine cameras moreover stretch the image along a random
    axis, by a ratio between `SMALLEST_RATIO` and 1 at constant area.
    """
    n_frames = len(rotations)
    shortest, longest = np.log(scales)
    # All numbers are drawn whatever the camera, so that the rest of the scene is equal.
    log_scales = rng.uniform(shortest, longest, n_frames)
    ratios = rng.uniform(SMALLEST_RATIO, 1.0, n_frames)
    axes = rng.uniform(0.0, np.pi, n_frames)
    if camera == "orthographic":
        log_scales = np.full(n_frames, (shortest + longest) / 2)
    motion = np.exp(log_scales)[:, None, None] * rotations[:, :2]
    if camera == "affine":
        motion = _stretches(ratios, axes) @ motion
    return motion


def _stretches(ratios: NDArray, axes: NDArray) -> NDArray[np.float64]:
    """Return symmetric matrices (n, 2, 2) of determinant 1 and given singular ratio."""
    along = np.stack([np.cos(axes), np.sin(axes)], axis=1)[:, :, None]
    across = np.stack([-np.sin(axes), np.cos(axes)], axis=1)[:, :, None]
    longer, shorter = ratios[:, None, None] ** -0.5, ratios[:, None, None] ** 0.5
    return longer * along * along.mT + shorter * across * across.mT


def standardise(coefficients: NDArray) -> NDArray[np.float64]:
    """Return coefficients with zero mean and unit variance over the frames."""
    centred = coefficients - coefficients.mean(axis=0)
    return centred / np.sqrt(np.mean(centred**2, axis=0))


def centre_shapes(shapes: NDArray) -> NDArray[np.float64]:
    """Return shapes (..., n_points, 3) centred over the points."""
    return shapes - shapes.mean(axis=-2, keepdims=True)


def observe(
    mean_shape: NDArray,
    basis: NDArray,
    alpha: NDArray,
    motion: NDArray,
    translation: NDArray,
    **options: Any,
) -> Bunch:
    """Return the table seen by the cameras together with all truths.

    The options are those of `observe_shapes`.
    """
    return observe_shapes(
        mean_shape + np.tensordot(alpha, basis, 1),
        motion,
        translation,
        mean_shape=mean_shape,
        basis=basis,
        alpha=alpha,
        **options,
    )


def observe_shapes(
    shapes: NDArray,
    motion: NDArray,
    translation: NDArray,
    *,
    noise: float,
    missing: float,
    layout: Layout,
    rng: RandomState,
    **more: Any,
) -> Bunch:
    """Return the table of given shapes seen by the cameras, and the truth."""
    clean = shapes @ motion.transpose(0, 2, 1) + translation[:, None]
    centred = clean - clean.mean(axis=1, keepdims=True)
    noise_variance = noise**2 * np.mean(centred**2)

    # Drawn also where not needed, so that noise and missing change nothing else.
    tracks = clean + np.sqrt(noise_variance) * rng.standard_normal(clean.shape)
    order = rng.permutation(clean[..., 0].size).reshape(clean.shape[:2])
    visible = order >= round(missing * order.size)
    tracks[~visible] = np.nan

    return Bunch(
        data=tracks_to_table(tracks, layout),
        tracks=tracks,
        clean=clean,
        visible=visible,
        motion=motion,
        translation=translation,
        shapes=shapes,
        noise_variance=float(noise_variance),
        feature_names=_feature_names(clean.shape[1], layout),
        **more,
    )


def _feature_names(n_points: int, layout: Layout) -> list[str]:
    """Return the names of the columns, x_0, y_0, ... in the order of the layout."""
    names = np.array([[f"{axis}_{j}" for axis in "xy"] for j in range(n_points)])
    return tracks_to_table(names[None], layout)[0].tolist()
