"""The tables that are measured: files, their truth, what suits them."""

import os
from pathlib import Path
from typing import Literal, NamedTuple

import numpy as np

from isa_nrsfm.datasets import make_nonrigid_tracks


class Case(NamedTuple):
    """A file and how it is factorised."""

    title: str
    file: str
    n_components: int
    scale_frames: bool = True


CASES = (
    Case("shark K=1, unscaled", "shark_torresani", 1, False),
    Case("drink K=3", "akhter_drink", 3),
    Case("pickup K=3", "akhter_pickup", 3),
    Case("yoga K=4", "akhter_yoga", 4),
    Case("hands K=3", "hands_kazuhito_21", 3),
    Case("ICT-68 K=9", "ict_bu3dfe_like_68", 9),
    Case("MUCT-68 K=9", "muct_68", 9),
    Case("faces_wild K=9", "faces_wild_68_combined", 9),
)
SHARK, DRINK, PICKUP, YOGA, HANDS, ICT, MUCT, FACES = CASES
EXPRESSIONS = Case("expressions K=9", "expressions_dlib_68", 9)


def data_folder():
    """Return the folder named by ISA_NRSFM_DATA, else the one beside the checkout."""
    checkout = Path(__file__).resolve().parents[1]
    return Path(os.environ.get("ISA_NRSFM_DATA") or checkout.parent / "shared" / "data")


def data_path(case):
    """Return the path of a file, whether it is there or not."""
    return data_folder() / f"{case.file}.npz"


def load_arrays(case):
    """Return the arrays of a file by name, or None where it is absent."""
    path = data_path(case)
    if not path.is_file():
        print(f"{case.title}: skipped, no {path.name} in the folder ISA_NRSFM_DATA")
        return None
    with np.load(path, allow_pickle=False) as data:
        return dict(data)


def load_table(case, complete=True):
    """Return the rows of a file as a table, or None where it is absent."""
    arrays = load_arrays(case)
    if arrays is None:
        return None
    tracks = arrays["W2d"]
    if complete:
        tracks = tracks[~np.isnan(tracks).any(axis=(1, 2))]
    return as_table(tracks)


def as_table(tracks):
    """Return tracks (n_frames, n_points, 2) as an interleaved table."""
    return tracks.reshape(len(tracks), -1)


def centred_tracks(X):
    """Return the tracks (n_frames, n_points, 2) of a complete table, centred."""
    tracks = X.reshape(len(X), -1, 2)
    return tracks - tracks.mean(axis=1, keepdims=True)


def measurement_matrix(X, scale_frames=True):
    """Return W (2 n_frames, n_points) of a complete table, and the frames' sizes."""
    tracks = centred_tracks(X)
    sizes = np.sqrt(np.mean(tracks**2, axis=(1, 2), keepdims=True))
    if not scale_frames:
        sizes[:] = np.sqrt(np.mean(sizes**2))
    return (tracks / sizes).transpose(0, 2, 1).reshape(2 * len(X), -1), sizes


def spoiled(X, rng, noise=0.0, missing=0.0):
    """Return a table with noise, a share of the size, and missing points, a share."""
    tracks = X.reshape(len(X), -1, 2)
    size = np.sqrt(np.mean(centred_tracks(X) ** 2))
    noisy = tracks + noise * size * rng.standard_normal(tracks.shape)
    hidden = rng.random(tracks.shape[:2])[..., None] < missing
    return as_table(np.where(hidden, np.nan, noisy))


def rotations_and_scales(motion):
    """Return the rotations (n, 3, 3) and scales (n,) nearest to cameras (n, 2, 3)."""
    U, _, Vt = np.linalg.svd(np.nan_to_num(motion), full_matrices=False)
    rows = U @ Vt
    depth = np.cross(rows[:, 0], rows[:, 1])
    rotations = np.concatenate([rows, depth[:, None]], axis=1)
    return rotations, np.linalg.norm(motion, axis=(1, 2)) / np.sqrt(2)


def halves_of(n_rows, seed):
    """Return the row numbers of two random halves of a table."""
    order = np.random.default_rng(seed).permutation(n_rows)
    return order[: n_rows // 2], order[n_rows // 2 :]


CAMERAS = ("weak_perspective", "affine")
FRAMES = (300, 400, 500)
AMPLITUDES = (0.15, 0.175, 0.2)


def instance(seed, n_points, n_components, noise, **options):
    """Return the tracks of a seed: the same truth and noise pattern for each noise."""
    settings = {
        "camera": CAMERAS[seed % 2],
        "n_frames": FRAMES[seed % 3],
        "amplitude": AMPLITUDES[(seed // 2) % 3],
        "random_state": seed,
    }
    return make_nonrigid_tracks(
        n_points=n_points,
        n_components=n_components,
        noise=noise,
        **settings | options,
    )


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
        True shapes.
    cameras : ndarray of shape (n_frames, 2 or 3, 3) or None
        True cameras, where shapes are in the space of the object.
    """

    X: np.ndarray
    labels: np.ndarray | None = None
    subjects: np.ndarray | None = None
    shapes: np.ndarray | None = None
    cameras: np.ndarray | None = None


SYNTHETIC = Case("synthetic", "", 3)
# 300 to 500 frames of so many points, so much noise.
SYNTHETIC_POINTS, SYNTHETIC_NOISE = 68, 0.02


def motion_capture(title, case, n_components):
    """Return a set of motion capture, unscaled as in the literature."""
    case = case._replace(n_components=n_components, scale_frames=False)
    return Set(f"{title}, K={n_components}", case, "object", ordered=True)


SETS = {
    "shark": Set("Shark, K=1", SHARK, "camera", ordered=True),
    "flag": Set(
        "flag, K=5",
        Case("flag K=5, unscaled", "flag_mocap_30x250", 5, False),
        "camera",
        "weak_perspective",
        ordered=True,
    ),
    "faces_wild": Set("faces in the wild, K=9", FACES),
    "ict_dense": Set(
        "ICT dense, K=8",
        Case("ICT dense K=8", "ict_bu3dfe_like_basis", 8),
        "object",
        most_repeats=1,
        origin="lower",
    ),
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
    case, camera = SETS[name].case, SETS[name].camera
    if not case.file:
        size = SYNTHETIC_POINTS, case.n_components, SYNTHETIC_NOISE
        tracks = instance(seed, *size, camera=camera)
        return Table(tracks.data, shapes=tracks.shapes, cameras=tracks.motion)
    arrays = load_arrays(case)
    if name == "ict_dense":
        arrays |= dense_tracks(arrays)
    tracks = arrays["W2d"]
    complete = ~np.isnan(tracks).any(axis=(1, 2))
    rest = (arrays.get(k) for k in ("labels", "subjects", "S3d", "R"))
    rest = (None if array is None else array[complete] for array in rest)
    return Table(as_table(tracks[complete].astype(float)), *rest)


def dense_tracks(arrays):
    """Return the orthographic tracks of a model of dense shapes, and the shapes."""
    shapes = arrays["mean"].astype(float)
    for name in ("identity", "expression"):
        weights = arrays[f"{name}_coeffs"].astype(float)
        shapes = shapes + np.tensordot(weights, arrays[name].astype(float), 1)
    cameras = arrays["R"][:, :2].astype(float)
    return {"W2d": shapes @ cameras.transpose(0, 2, 1), "S3d": shapes}


def shapes_in_camera(name, seed=0):
    """Return the true shapes in the axes of each frame's camera, z is depth."""
    table = load(name, seed)
    if SETS[name].truth == "camera":
        return table.shapes
    rotations, _ = rotations_and_scales(table.cameras[:, :2])
    return table.shapes @ rotations.transpose(0, 2, 1)
