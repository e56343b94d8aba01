"""Read the json files of OpenPose, one for each frame."""

import re
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from isa_nrsfm._compat.damaged_files import errors_of
from isa_nrsfm._compat.texts import as_utf8, by_number
from isa_nrsfm._parameters.choices import OPENPOSE_PARTS
from isa_nrsfm.io._coco import begins_as_openpose, read_json
from isa_nrsfm.io._landmarks import Landmarks, assemble, stacked

_NAME = re.compile(r"(?!\.).*?(\d*)_keypoints\.json", re.IGNORECASE)


def is_openpose(path: Path) -> bool:
    """Return whether a file begins as those of OpenPose, or a folder has such names."""
    if path.is_dir():
        return any(_NAME.fullmatch(file.name) for file in path.iterdir())
    return begins_as_openpose(path)


def read_openpose(path: Path, part: str | None = None) -> Landmarks:
    """Read a file, or all of a folder in the order of their names and numbers.

    A file has the list ``people``, and each person ``pose_keypoints_2d``: x, y and
    confidence of each point in turn. The confidence of missing points is 0. ``part``
    chooses between body, face and hands. Each person with points of this part has a
    row. A file without such people has one row without points.
    """
    if part is not None and part not in OPENPOSE_PARTS:
        raise ValueError(
            f"part must be one of {', '.join(OPENPOSE_PARTS)}; got {part!r}"
        )
    files = [path]
    if path.is_dir():
        names = filter(lambda file: _NAME.fullmatch(file.name), path.iterdir())
        files = sorted(names, key=by_number)
        if not files:
            raise ValueError("the folder has no files with names ..._keypoints.json")
    people = []
    for file in files:
        with errors_of(file.name):
            people.append(_people_in(read_json(file)))
    known = {name for persons in people for person in persons for name in person}
    found = ", ".join(name for name in OPENPOSE_PARTS if name in known)
    if not known:
        raise ValueError(
            "it has no visible points in the lists pose_keypoints_2d, "
            "face_keypoints_2d, ... of people"
        )
    if len(known) > 1 and part is None:
        raise ValueError(
            f"it has points of {found}: choose one with part (command line: --part)"
        )
    part = part or found
    if part not in known:
        raise ValueError(f"it has no points of {part}, but of {found}")
    chosen = [
        {k: person[part] for k, person in enumerate(persons) if part in person}
        for persons in people
    ]
    image, numbers, values = stacked(chosen, [file.name for file in files])
    tracks, confidence = np.split(values, [2], axis=2)
    tracks = np.where(confidence == 0, np.nan, tracks)
    # Points that are cut off can be outside of the image.
    if np.nanmedian(np.abs(tracks)) <= 1:
        raise ValueError(
            "the coordinates are shares of the image's size, which stretch the shapes. "
            "Run OpenPose with --keypoint_scale 0 for pixels"
        )
    of_files = _numbers(files)
    frames = {
        "file": [as_utf8(files[i].name) for i in image],
        "frame": [of_files[i] for i in image],
        "person": numbers,
    }
    return assemble(
        tracks, None, frames, format="openpose", confidence=confidence[..., 0]
    )


def _people_in(content: Any) -> list[dict[str, NDArray[np.float64]]]:
    """Return the visible parts of each person in a file, (n_points, 3) each."""
    people = content.get("people") if isinstance(content, dict) else None
    if not isinstance(people, list) or not all(isinstance(p, dict) for p in people):
        raise ValueError("expected an object with a list of objects called people")
    found = []
    for person in people:
        parts = {
            part: _values_of(f"{part}_keypoints_2d", person) for part in OPENPOSE_PARTS
        }
        found.append({name: each for name, each in parts.items() if each[:, 2].any()})
    return found


def _values_of(key: str, person: dict[str, Any]) -> NDArray[np.float64]:
    """Return x, y and confidence of the points of a person, (n_points, 3)."""
    numbers = person.get(key, [])
    if not isinstance(numbers, list) or not all(
        type(value) in (int, float) and abs(value) < 1e300 for value in numbers
    ):
        raise ValueError(
            f"{key} should be a list of finite numbers; got {numbers!r:.40}"
        )
    if len(numbers) % 3:
        raise ValueError(
            f"{key} should have x, y and confidence of each point; got {len(numbers)} "
            "numbers"
        )
    return np.array(numbers, dtype=np.float64).reshape(-1, 3)


def _numbers(files: list[Path]) -> list[int]:
    """Return the numbers at the end of the names of files, or else of their order."""
    found = [_NAME.fullmatch(file.name) for file in files]
    numbers = [int(match[1]) for match in found if match and match[1]]
    return numbers if len(set(numbers)) == len(files) else list(range(len(files)))
