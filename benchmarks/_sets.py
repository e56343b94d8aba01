"""The sets on which methods are compared: tables, their truth, what suits them."""

from typing import Literal, NamedTuple

import numpy as np

from benchmarks._data import (
    DENSE,
    DRINK,
    EXPRESSIONS,
    FACES,
    FLAG,
    ICT,
    MUCT,
    PICKUP,
    SHARK_UNSCALED,
    YOGA,
    Case,
    as_table,
    data_path,
    dense_shapes,
    dense_tracks,
    load_arrays,
)
from benchmarks.recovery import instance
from isa_nrsfm._metric_upgrade.rigid import nearest_rotations


class Set(NamedTuple):
    """
    A data set of the comparison.

    Attributes
    ----------
    title : str
        With the number of basis shapes.
    case : Case
        File, number of basis shapes, whether frames are scaled.
    truth : {None, "object", "camera"}
        Whether true shapes are known, in the space of the object or of the camera.
    camera : {"orthographic", "weak_perspective", "affine"}
        Whether images have the scale of the true shapes, a scale in each frame, or do
        not show true angles.
    ordered : bool
        Whether rows are successive frames of a camera that turns little.
    redrawn : bool
        Whether each seed has a table of its own.
    most_repeats : int or None
        The most seeds, where a run takes long.
    origin : {"auto", "upper", "lower"}
        Where y is zero in pictures, as of `ReprojectionDisplay`.
    """

    title: str
    case: Case
    truth: Literal[None, "object", "camera"] = None
    camera: Literal["orthographic", "weak_perspective", "affine"] = "orthographic"
    ordered: bool = False
    redrawn: bool = False
    most_repeats: int | None = None
    origin: Literal["auto", "upper", "lower"] = "auto"


class Table(NamedTuple):
    """
    The table of a set.

    Attributes
    ----------
    X : ndarray of shape (n_frames, 2 * n_points)
        Rows without missing points.
    labels, subjects : ndarray of shape (n_frames,) or None
        Expression and person of each row.
    shapes : ndarray of shape (n_frames, n_points, 3) or None
        True shapes; those of dense faces are computed by `true_shapes`.
    cameras : ndarray of shape (n_frames, 2 or 3, 3) or None
        True cameras, where shapes are in the space of the object.
    """

    X: np.ndarray
    labels: np.ndarray | None = None
    subjects: np.ndarray | None = None
    shapes: np.ndarray | None = None
    cameras: np.ndarray | None = None


SYNTHETIC = Case("synthetic", "", 3, True)
# 300 to 500 frames of so many points, so much noise.
SYNTHETIC_POINTS, SYNTHETIC_NOISE = 68, 0.02


def motion_capture(title, case, n_components):
    """Return a set of motion capture, unscaled as in the literature."""
    case = case._replace(n_components=n_components, scale_frames=False)
    return Set(f"{title}, K={n_components}", case, "object", ordered=True)


SETS = {
    "shark": Set("Shark, K=1", SHARK_UNSCALED, "camera", ordered=True),
    "flag": Set("flag, K=5", FLAG, "camera", "weak_perspective", ordered=True),
    "faces_wild": Set("faces in the wild, K=9", FACES),
    "ict_dense": Set("ICT dense, K=8", DENSE, "object", most_repeats=1, origin="lower"),
    "ict_68": Set("ICT-68, K=9", ICT, "object"),
    "drink": motion_capture("drink", DRINK, 3),
    "pickup": motion_capture("pickup", PICKUP, 3),
    "yoga": motion_capture("yoga", YOGA, 4),
    "synthetic": Set(
        "synthetic, K=3", SYNTHETIC, "object", "weak_perspective", redrawn=True
    ),
    "synthetic_affine": Set(
        "synthetic affine, K=3", SYNTHETIC, "object", "affine", redrawn=True
    ),
    # As many basis shapes as the literature takes.
    "drink_k11": motion_capture("drink", DRINK, 11),
    "pickup_k11": motion_capture("pickup", PICKUP, 11),
    "yoga_k9": motion_capture("yoga", YOGA, 9),
    "muct_68": Set("MUCT-68, K=9", MUCT),
    "expressions": Set("expressions, K=9", EXPRESSIONS),
}
SET_TITLES = {name: chosen.title for name, chosen in SETS.items()}


def is_present(name):
    """Return whether the table of a set can be had."""
    case = SETS[name].case
    return not case.file or data_path(case).is_file()


def load(name, seed=0):
    """Return the table of a set; the seed is that of synthetic ones."""
    chosen = SETS[name]
    if not chosen.case.file:
        tracks = instance(
            seed,
            SYNTHETIC_POINTS,
            chosen.case.n_components,
            SYNTHETIC_NOISE,
            camera=chosen.camera,
        )
        return Table(tracks.data, shapes=tracks.shapes, cameras=tracks.motion)
    arrays = load_arrays(chosen.case)
    if chosen.case is DENSE:
        return Table(as_table(dense_tracks(arrays)))
    tracks = arrays["W2d"]
    rest = (arrays.get(k) for k in ("labels", "subjects", "S3d", "R"))
    complete = ~np.isnan(tracks).any(axis=(1, 2))
    rest = (None if array is None else array[complete] for array in rest)
    return Table(as_table(tracks[complete].astype(float)), *rest)


def true_shapes(name, seed=0):
    """Return the true shapes (n_frames, n_points, 3) of a set, None if not known."""
    chosen = SETS[name]
    if chosen.case is DENSE:
        return dense_shapes(load_arrays(chosen.case), slice(None))
    return load(name, seed).shapes if chosen.truth else None


def shapes_in_camera(name, seed=0):
    """Return the true shapes in the axes of each frame's camera, z is depth."""
    shapes = true_shapes(name, seed)
    if SETS[name].truth == "camera":
        return shapes
    dense = SETS[name].case is DENSE
    cameras = load_arrays(DENSE)["R"] if dense else load(name, seed).cameras
    rotations, _ = nearest_rotations(cameras[:, :2])
    return shapes @ rotations.transpose(0, 2, 1)
