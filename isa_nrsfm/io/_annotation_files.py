"""Read annotations of face images: iBUG .pts files and the lists of WFLW."""

import re
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from isa_nrsfm._compat.damaged_files import errors_of
from isa_nrsfm._compat.texts import as_utf8, by_number
from isa_nrsfm.io._landmarks import Landmarks, assemble, stacked
from isa_nrsfm.io._tables import first_lines

_PTS = re.compile(
    r"\s*version\s*:\s*\S+\s+n_points\s*:\s*(?P<n_points>\d+)\s*"
    r"\{(?P<points>[^{}]*)\}\s*"
)
_N_WFLW = 98
_WFLW_BOX = ("x_min", "y_min", "x_max", "y_max")
_WFLW_ATTRIBUTES = "pose expression illumination make_up occlusion blur".split()
# Fields of a line: points and image, without and with the box and the attributes.
_WFLW_LENGTHS = (197, 207)


def is_pts(path: Path) -> bool:
    """Return whether a file begins as .pts files do, or a folder has such files."""
    if path.is_dir():
        return any(_is_pts_name(file) for file in path.iterdir())
    return "".join(first_lines(path, 1)).lstrip().startswith("version")


def read_pts(path: Path) -> Landmarks:
    """Read a .pts file, or all of a folder in the order of their names and numbers.

    A file has the points of one image: ``version: 1``, ``n_points: 68`` and, between
    braces, a line ``x y`` for each point. Other files of the folder are ignored.
    Coordinates are as they are written; iBUG counts pixels from 1.
    """
    files = [path]
    if path.is_dir():
        files = sorted(filter(_is_pts_name, path.iterdir()), key=by_number)
        if not files:
            raise ValueError("there are no .pts files in the folder")
    points = []
    for file in files:
        with errors_of(file.name):
            points.append({0: _points_of(file.read_bytes().decode("utf-8-sig"))})
    *_, tracks = stacked(points, [file.name for file in files])
    names = {"file": [as_utf8(file.name) for file in files]}
    return assemble(tracks, None, names, format="pts")


def is_wflw(path: Path) -> bool:
    """Return whether the first line has the fields of a WFLW list."""
    fields = "".join(first_lines(path, 1)).split()
    try:
        _floats(fields[: 2 * _N_WFLW])
    except ValueError:
        return False
    return len(fields) in _WFLW_LENGTHS


def read_wflw(path: Path) -> Landmarks:
    """Read a list of WFLW, with a line for each face.

    A line has 196 coordinates, x and y in turn, the box of the face (``x_min y_min
    x_max y_max``), six attributes 0 or 1 (pose, expression, illumination, make-up,
    occlusion, blur) and the name of the image. Box and attributes may be missing.
    """
    rows: list[NDArray[np.float64]] = []
    images: list[str] = []
    n_fields = 0
    with path.open(encoding="utf-8-sig") as file:
        for number, line in enumerate(file, start=1):
            fields = line.split()
            if not fields:
                continue
            n_fields = n_fields or len(fields)
            if len(fields) not in _WFLW_LENGTHS or len(fields) != n_fields:
                raise ValueError(
                    f"line {number} has {len(fields)} fields; all must have "
                    f"{' or all '.join(map(str, _WFLW_LENGTHS))}"
                )
            with errors_of(f"line {number}"):
                rows.append(_floats(fields[:-1]))
            images.append(fields[-1])
    if not rows:
        raise ValueError("there are no lines in it")
    frames: dict[str, object] = {"image": images}
    points, box, attributes = np.split(np.stack(rows), [196, 200], axis=1)
    if n_fields == _WFLW_LENGTHS[1]:
        if not np.isin(attributes, (0, 1)).all():
            raise ValueError("the six attributes before the image must be 0 or 1")
        frames |= zip(_WFLW_BOX, box.T, strict=True)
        frames |= zip(_WFLW_ATTRIBUTES, attributes.T.astype(int), strict=True)
    return assemble(points.reshape(-1, _N_WFLW, 2), None, frames, format="wflw")


def _is_pts_name(file: Path) -> bool:
    """Return whether a file in a folder is a .pts file that is not hidden."""
    return file.suffix.lower() == ".pts" and not file.name.startswith(".")


def _points_of(text: str) -> NDArray[np.float64]:
    """Return the points (n_points, 2) that a .pts file holds."""
    match = _PTS.fullmatch(text)
    if match is None:
        raise ValueError(
            "expected 'version: 1', 'n_points: N' and N lines 'x y' between braces; "
            f"got {text[:40]!r}"
        )
    coordinates = _floats(match["points"].split())
    n_points = int(match["n_points"])
    if len(coordinates) != 2 * n_points or n_points == 0:
        raise ValueError(
            f"n_points is {n_points}, but there are {len(coordinates)} coordinates"
        )
    return coordinates.reshape(n_points, 2)


def _floats(fields: list[str]) -> NDArray[np.float64]:
    """Return the numbers that fields hold."""
    # Python reads 1_0 as a number.
    bad = next((field for field in fields if "_" in field), None)
    if bad is not None:
        raise ValueError(f"a coordinate should be a number; got {bad!r}")
    numbers = np.array(fields, dtype=np.float64)
    if np.isinf(numbers).any():
        infinite = fields[int(np.isinf(numbers).argmax())]
        raise ValueError(f"a coordinate should be finite; got {infinite!r}")
    return numbers
