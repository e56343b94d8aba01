"""Read the csv tables of OpenFace, py-feat and MediaPipe's face mesh."""

import re
from collections.abc import Iterable
from dataclasses import replace
from itertools import chain
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from isa_nrsfm._compat import pandas as pd
from isa_nrsfm._compat.texts import first_items
from isa_nrsfm._parameters import named
from isa_nrsfm._prepare.coordinates import are_shares
from isa_nrsfm.io import _landmark_columns, _tables
from isa_nrsfm.io._keypoints import entries_as_rows, json_kind, read_json
from isa_nrsfm.io._landmark_columns import LandmarkColumns, find_landmark_columns
from isa_nrsfm.io._landmarks import Landmarks, assemble, checked_sizes
from isa_nrsfm.io._tables import header_names, read_columns, tracks_in

# OpenFace names points in space, in millimetres, by capital letters.
_NOT_OPENFACE = re.compile(r"eye_lmk_[xyXYZ]_\d+|[XYZ]_\d+")
# The vector that identifies faces, and the mesh beside the 68 points.
_NOT_PYFEAT = re.compile(r"Identity_\d+|mesh_[xyz]_\d+|z_\d+")
_PYFEAT_BOX = ("FaceRectX", "FaceRectY", "FaceRectWidth", "FaceRectHeight")


def is_openface(path: Path) -> bool:
    """Return whether the header is one of OpenFace."""
    names = header_names(path)
    of_video = {"frame", "timestamp", "confidence", "success"}.issubset(names)
    groups = {"x_0", "x0", "pose_Rx", "gaze_0_x", "AU01_r"}.intersection(names)
    cut = [{"success", f"x{_}67", f"y{_}67"}.issubset(names) for _ in ("", "_")]
    of_video |= any(cut)  # without some columns
    return (of_video or names[:2] == ["face", "confidence"]) and bool(groups)


def read_openface(path: Path) -> Landmarks:
    """Read a csv file of OpenFace 1 or 2, of a video or an image.

    The columns are those of ``RecorderCSV.cpp``: ``frame, face_id, timestamp,
    confidence, success`` (``face, confidence`` for images) and optional gaze, eyes,
    pose, ``x_0 ... x_67, y_0 ... y_67`` and more. OpenFace 1 has no ``face_id``, and
    blanks before the names; the first versions have ``x0 ... x67``. Rows in which
    ``success`` is 0 hold numbers that are not of a face.
    """
    names = header_names(path)
    if not (first := {"x_0", "x0"}.intersection(names)):
        raise ValueError(
            "it has no 2D landmarks x_0, ..., y_0, ...: run OpenFace with -2Dfp"
        )
    of_video = names[:1] != ["face"]
    _need(names, ["success"] if of_video else ["confidence"])
    found = find_landmark_columns(names, "x_#,y_#" if "x_0" in first else "x#,y#")
    scores = [name for name in ("confidence", "success") if name in names]
    numbers = [*found.interleaved, *scores]
    table = read_columns(path, leave_out=_NOT_OPENFACE, numbers=numbers)
    if of_video:
        if not table["success"].isin((0, 1)).all():
            raise ValueError("the column success must hold 0 and 1 only")
        table["success"] = table["success"].astype(int)
        table.loc[table["success"] == 0, found.interleaved] = np.nan
    return _of_faces(table, found, "openface", "confidence")


def is_pyfeat(path: Path) -> bool:
    """Return whether the header is one of py-feat."""
    return {*_PYFEAT_BOX, "x_0"}.issubset(header_names(path))


def read_pyfeat(path: Path) -> Landmarks:
    """
    Read a csv file of py-feat, of any of its detectors.

    ``Detector`` writes 68 points, ``x_0 ... x_67, y_0 ... y_67``, newer ones with a
    mesh of 478 points beside them; ``MPDetector`` writes 478 points ``x_0, y_0, z_0,
    x_1, ...``. ``FaceScore`` is the confidence of the face detector.
    """
    names = header_names(path)
    _need(names, _PYFEAT_BOX)
    found = find_landmark_columns(names, "x_#,y_#")
    numbers = [*found.interleaved, *{"FaceScore"}.intersection(names)]
    table = read_columns(path, leave_out=_NOT_PYFEAT, numbers=numbers, text=["input"])
    return _of_faces(table, found, "pyfeat", "FaceScore")


def is_mediapipe(path: Path) -> bool:
    """Return whether the header has as many points as MediaPipe's face mesh."""
    # Without and with the points of the irises
    sets = _landmark_columns.landmark_sets(header_names(path))
    return bool({468, 478}.intersection(sets.values())) and not is_pyfeat(path)


def read_mediapipe(
    path: Path,
    image_size: tuple[float, float] | None = None,
    columns: str | None = None,
    missing: _tables.Missing = None,
) -> Landmarks:
    """Read a csv file with the points of MediaPipe.

    Coordinates divided by the width and height of the image are multiplied by
    ``image_size``, or the columns ``image_width`` and ``image_height``.
    """
    names = header_names(path)
    found = find_landmark_columns(names, columns)
    sizes = [name for name in ("image_width", "image_height") if name in names]
    numbers = [*found.interleaved, *sizes]
    text = {*names}.difference(numbers, found.z)
    table = read_columns(path, leave_out={*found.z}, numbers=numbers, text=text)
    tracks = tracks_in(table, found.interleaved, missing)
    scale = table[sizes].to_numpy(float) if len(sizes) == 2 else None
    tracks = _in_pixels(tracks, image_size, scale)
    titles, frames = found.interleaved, table.drop(columns=found.interleaved)
    return _tables.with_confidences(tracks, found.points, titles, frames, "mediapipe")


def is_mediapipe_json(path: Path) -> bool:
    """Return whether json has objects with x and y, or lists called landmarks."""
    return json_kind(path) == "mediapipe"


def read_mediapipe_json(
    path: Path, image_size: tuple[float, float] | None = None, part: str | None = None
) -> Landmarks:
    """Read json of results: lists of objects with x and y, of frames and persons.

    Their names, such as ``pose_landmarks`` or ``poseLandmarks``, are told apart by
    ``part``; points in space (``world``) are left out.
    """
    frames, entries = _frames_in(read_json(path)), []
    names: dict[str, str] = {}
    for number, frame in enumerate(frames):
        found = {n: p for n, value in frame.items() if (p := _persons(value))}
        found = {n: p for n, p in found.items() if "world" not in n.lower()}
        names |= {n: re.sub("([A-Z])", r"_\1", n).lower() for n in found}
        numbered = {"frame": number} if len(frames) > 1 else {}
        entries.append((numbered | frame, found))
    chosen = [n for n, plain in names.items() if part is None or part in plain]
    if not names:
        raise ValueError("it has no lists of objects with x and y")
    if len(chosen) != 1:
        raise ValueError(
            f"it has {first_items(names)}: choose one with {named('part')}, such as "
            "'pose'"
        )
    every = [p for _, found in entries for each in found.values() for p in each]
    seen = any(point.get("visibility") for points in every for point in points)
    rows = []
    for known, found in entries:
        for k, points in enumerate(found.get(chosen[0]) or [[]]):
            sure = (p.get("visibility", 1.0) if seen else 1.0 for p in points)
            xyv = ((p["x"], p["y"], v) for p, v in zip(points, sure, strict=True))
            values = [*map(float, chain.from_iterable(xyv))]
            rows.append(known | {"person": k, "keypoints": values})
    read = entries_as_rows(rows, "mediapipe_json", "result")
    tracks = _in_pixels(read.points.to_numpy().reshape(len(rows), -1, 2), image_size)
    moved = pd.DataFrame(tracks.reshape(len(rows), -1), columns=read.points.columns)
    return replace(read, points=moved, confidence=read.confidence if seen else None)


def _frames_in(content: Any) -> list[dict[str, Any]]:
    """Return the frames in a list, or in an object with a list; or the only one."""
    if isinstance(content, dict):
        values = (v for v in content.values() if isinstance(v, list) and v)
        lists = [v for v in values if isinstance(v[0], dict) and not _persons(v)]
        content = lists[0] if lists else [content]
    elif isinstance(content[0], dict) and _persons(content):
        content = [content]
    return [f if isinstance(f, dict) else {"landmarks": f} for f in content]


def _persons(value: Any) -> list[list[dict[str, Any]]]:
    """Return the points of each person in a list of points, or a list of such."""
    if not isinstance(value, list) or not value:
        return []
    if all(isinstance(p, dict) and {"x", "y"} <= p.keys() for p in value):
        return [value]
    inner = [_persons(each) for each in value]
    return [each[0] for each in inner] if all(len(i) == 1 for i in inner) else []


def _in_pixels(tracks: NDArray, image_size: Any, sizes: Any = None) -> NDArray:
    """Return tracks (n_frames, n_points, 2) in pixels, by the size of the images."""
    n_known = np.count_nonzero(~np.isnan(tracks))
    # Pixels of a face reach beyond this, and fractions of the image's size do not.
    if 2 * np.count_nonzero((tracks >= -2) & (tracks <= 2)) > n_known:
        if image_size is None and sizes is None:
            raise ValueError(
                "its coordinates are fractions of the image's width and height: give "
                f"{named('image_size', (1920, 1080))} in pixels, or columns "
                "image_width and image_height"
            )
        beyond = np.maximum(-tracks, tracks - 1).max(axis=2)
        n_outside, n_shown = np.sum(beyond > 0), np.sum(~np.isnan(beyond))
        if 2 * n_outside > n_shown and not are_shares(tracks):
            raise ValueError(
                f"{n_outside} of {n_shown} points are outside the image: the "
                "coordinates are no fractions of the width and height of an image. "
                "Read them without image_size, in the format table"
            )
        if image_size is not None:
            sizes = checked_sizes("image_size", image_size, 1)
        with np.errstate(over="ignore"):  # `assemble` refuses infinite numbers
            return np.asarray(tracks * sizes.reshape(-1, 1, 2))
    if image_size is not None:
        raise ValueError(
            "image_size is for coordinates that are fractions of the image's width and "
            "height; these are in pixels (median "
            f"{np.nanmedian(np.abs(tracks)):.3g}), for the format table"
            if n_known
            else "image_size is given, but there are no points"
        )
    return tracks


def _of_faces(
    table: "pd.DataFrame", found: LandmarkColumns, format: str, score: str
) -> Landmarks:
    """Return points under the names of their columns.

    The score of a face, if there is one, is that of its points, and among its columns.
    """
    n_points, names = len(found.points), found.interleaved
    sure = table[[score] * n_points].to_numpy(np.float64) if score in table else None
    known: dict[str, Any] = {"columns": names, "confidence": sure, "format": format}
    frames = table.drop(columns=names)
    return assemble(tracks_in(table, names), found.points, frames, **known)


def _need(names: list[str], needed: Iterable[str]) -> None:
    """Raise if a column is missing."""
    if absent := [name for name in needed if name not in names]:
        raise ValueError(f"it has no column {', '.join(absent)}")
