"""Read the csv tables of OpenFace, py-feat and MediaPipe's face mesh."""

import re
from collections.abc import Iterable
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from isa_nrsfm.io._landmark_columns import (
    LandmarkColumns,
    find_landmark_columns,
    landmark_sets,
)
from isa_nrsfm.io._landmarks import Landmarks, assemble
from isa_nrsfm.io._separated_values import header_names, read_columns

if TYPE_CHECKING:
    import pandas as pd

# Points of MediaPipe's face mesh, without and with those of the irises.
_MESH_SIZES = (468, 478)
# OpenFace names what lies in space, in millimetres, by capital letters.
_OPENFACE_NOT_READ = re.compile(r"eye_lmk_[xyXYZ]_\d+|[XYZ]_\d+")
_OPENFACE_GROUPS = ("x_0", "pose_Rx", "gaze_0_x", "AU01_r")
# The vector that tells faces apart, and the mesh beside the 68 points.
_PYFEAT_NOT_READ = re.compile(r"Identity_\d+|mesh_[xyz]_\d+|z_\d+")
_PYFEAT_BOX = ("FaceRectX", "FaceRectY", "FaceRectWidth", "FaceRectHeight")
_IMAGE_SIZE_COLUMNS = ("image_width", "image_height")
# Pixels of a face reach beyond this, and shares of the image's size do not.
_LARGEST_SHARE = 2.0


def is_openface(path: Path) -> bool:
    """Tell whether the header is one of OpenFace."""
    names = _stripped_header(path)
    of_video = {"frame", "timestamp", "confidence", "success"}.issubset(names)
    of_images = names[:2] == ["face", "confidence"]
    return (of_video or of_images) and not set(_OPENFACE_GROUPS).isdisjoint(names)


def read_openface(path: Path) -> Landmarks:
    """
    Read a csv file of OpenFace 1 or 2, of a video or an image.

    The columns are those of ``RecorderCSV.cpp``: ``frame, face_id, timestamp,
    confidence, success`` (``face, confidence`` for images) and, as far as they were
    asked for, gaze, eyes, pose, ``x_0 ... x_67, y_0 ... y_67`` and more. OpenFace 1 has
    no ``face_id``, and blanks before the names. Rows in which ``success`` is 0 hold
    numbers, too, but not of a face.
    """
    names = _stripped_header(path)
    if "x_0" not in names:
        raise ValueError(
            "it has no 2D landmarks x_0, ..., y_0, ...: run OpenFace with -2Dfp"
        )
    of_image = names[:1] == ["face"]
    scores = ["confidence"] if of_image else ["confidence", "success"]
    _need(names, scores)
    found = find_landmark_columns(names, "x_#,y_#")
    table = read_columns(
        path,
        leave_out=_OPENFACE_NOT_READ,
        numbers=[*found.interleaved, *scores],
    )
    failed = None
    if not of_image:
        success = table["success"].to_numpy()
        if not np.isin(success, (0, 1)).all():
            raise ValueError("the column success must hold 0 and 1 only")
        failed = success == 0
        table["success"] = table["success"].astype(int)
    return _with_other_columns(
        _tracks(table, found),
        table,
        found,
        format="openface",
        confidence=_of_all_points(table["confidence"], found),
        failed=failed,
    )


def is_pyfeat(path: Path) -> bool:
    """Tell whether the header is one of py-feat."""
    names = _stripped_header(path)
    return set(_PYFEAT_BOX).issubset(names) and "x_0" in names


def read_pyfeat(path: Path) -> Landmarks:
    """
    Read a csv file of py-feat, of any of its detectors.

    ``Detector`` writes 68 points, ``x_0 ... x_67, y_0 ... y_67``, newer ones with a
    mesh of 478 points beside them; ``MPDetector`` writes 478 points ``x_0, y_0, z_0,
    x_1, ...``. ``FaceScore`` is the confidence of the face detector.
    """
    names = _stripped_header(path)
    _need(names, _PYFEAT_BOX)
    found = find_landmark_columns(names, "x_#,y_#")
    scored = ["FaceScore"] if "FaceScore" in names else []
    table = read_columns(
        path,
        leave_out=_PYFEAT_NOT_READ,
        numbers=[*found.interleaved, *scored],
        text=("input",),
    )
    return _with_other_columns(
        _tracks(table, found),
        table,
        found,
        format="pyfeat",
        confidence=_of_all_points(table["FaceScore"], found) if scored else None,
    )


def is_mesh_table(path: Path) -> bool:
    """Tell whether the header has as many points as MediaPipe's face mesh."""
    names = _stripped_header(path)
    sizes = [size for size in landmark_sets(names).values() if size in _MESH_SIZES]
    return len(sizes) > 0 and not is_pyfeat(path)


def read_mesh_table(
    path: Path, image_size: tuple[float, float] | None = None
) -> Landmarks:
    """
    Read a csv file with the points that MediaPipe finds.

    MediaPipe divides x by the width of the image and y by its height. Coordinates of
    this kind are multiplied with ``image_size`` (width, height), or else with the
    columns ``image_width`` and ``image_height``. Coordinates in pixels are taken as
    they are.
    """
    if image_size is not None:
        image_size = _checked_size(image_size)
    names = _stripped_header(path)
    found = find_landmark_columns(names)
    sizes = [name for name in _IMAGE_SIZE_COLUMNS if name in names]
    landmarks = {*found.interleaved, *found.z, *sizes}
    table = read_columns(
        path,
        leave_out=set(found.z),
        numbers=[*found.interleaved, *sizes],
        text=[name for name in names if name not in landmarks],
    )
    tracks = _tracks(table, found)
    of_table = len(sizes) == 2
    known = np.abs(tracks[~np.isnan(tracks)])
    if known.size and np.median(known) <= _LARGEST_SHARE:
        if image_size is None and not of_table:
            raise ValueError(
                "its coordinates are shares of the image's width and height: give "
                "image_size=(width, height) in pixels (command line: --image-size "
                "1920x1080), or columns image_width and image_height"
            )
        scale = (
            table[sizes].to_numpy(float) if image_size is None else np.array(image_size)
        )
        with np.errstate(over="ignore"):  # what is infinite is refused below
            tracks = tracks * scale.reshape(-1, 1, 2)
    elif image_size is not None:
        raise ValueError(
            "image_size is for coordinates that are shares of the image's width and "
            f"height; these are in pixels (median {np.median(known):.3g})"
            if known.size
            else "image_size is given, but there are no points"
        )
    return _with_other_columns(tracks, table, found, format="mediapipe")


def _checked_size(image_size: tuple[float, float]) -> tuple[float, float]:
    """Return the width and the height of an image, or raise."""
    try:
        width, height = (float(length) for length in image_size)
    except (TypeError, ValueError):
        width = height = np.nan
    if not (0 < width < np.inf and 0 < height < np.inf):
        raise ValueError(
            "image_size must be a width and a height in pixels, such as (1920, 1080); "
            f"got {image_size!r}"
        )
    return width, height


def _need(names: list[str], needed: Iterable[str]) -> None:
    """Raise if one of the columns that are needed is not there."""
    absent = [name for name in needed if name not in names]
    if absent:
        raise ValueError(f"it has no column {', '.join(absent)}")


def _stripped_header(path: Path) -> list[str]:
    """Return the names of the columns without blanks around them."""
    return [name.strip() for name in header_names(path)]


def _tracks(table: "pd.DataFrame", found: LandmarkColumns) -> NDArray[np.float64]:
    """Return the points (n_frames, n_points, 2) of a table."""
    return (
        table[found.interleaved].to_numpy(dtype=np.float64).reshape(len(table), -1, 2)
    )


def _with_other_columns(
    tracks: NDArray[np.float64],
    table: "pd.DataFrame",
    found: LandmarkColumns,
    **known: Any,
) -> Landmarks:
    """Return points under the names of their columns, and the columns beside them."""
    return assemble(
        tracks,
        found.points,
        table.drop(columns=found.interleaved),
        columns=found.interleaved,
        **known,
    )


def _of_all_points(
    of_frames: "pd.Series", found: LandmarkColumns
) -> NDArray[np.float64]:
    """Give each point the confidence of its frame."""
    shape = len(of_frames), len(found.points)
    return np.broadcast_to(of_frames.to_numpy(dtype=np.float64)[:, None], shape)
