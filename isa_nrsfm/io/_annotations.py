"""Read landmarks of annotation programs and of YOLO: json, txt, csv and xml."""

import json
import re
from collections.abc import Sequence
from dataclasses import replace
from itertools import product
from pathlib import Path
from typing import Any
from xml.etree import ElementTree

import numpy as np
from numpy.typing import NDArray

from isa_nrsfm._compat import pandas as pd
from isa_nrsfm._compat.caller import warn_caller
from isa_nrsfm._compat.files import reading
from isa_nrsfm._compat.texts import as_utf8, first_items
from isa_nrsfm.io._keypoints import (
    entries_as_rows,
    floats_of,
    json_files,
    json_kind,
    read_json,
)
from isa_nrsfm.io._landmarks import (
    Landmarks,
    assemble,
    checked_sizes,
)
from isa_nrsfm.io._tables import first_lines, header_names, parse_table

_PLACE = re.compile(r"\s*[-+.\deE]+\s*[\s,]\s*[-+.\deE]+\s*")
# Fields of a line of YOLO before its points: class and box.
_N_BOX = 5
_XYV = ("x", "y", "visible")
_SIDES = ("left", "top", "width", "height")

# Columns of a row, and its points by name.
Row = tuple[dict[str, Any], dict[str, NDArray]]


def is_ultralytics(path: Path) -> bool:
    """Return whether keypoints are objects, or a column beside the box."""
    if path.suffix.lower() == ".json":
        return json_kind(path) == "ultralytics"
    return {"class", "box", "keypoints"}.issubset(header_names(path))


def read_ultralytics(path: Path) -> Landmarks:
    """Read results of Ultralytics, ``to_json`` or ``to_csv`` of one image or a list.

    A detection has ``keypoints`` with the lists x, y and, for most models, visible. A
    list of such lists has the detections of an image each. A csv has Python's text.
    """
    if path.suffix.lower() == ".json":
        images = read_json(path)
        images = images if all(isinstance(i, list) for i in images) else [images]
    else:
        table = parse_table(path)
        texts = table["keypoints"].str.replace("'", '"')
        images = [table.assign(keypoints=texts.map(json.loads)).to_dict("records")]
    entries: list[dict[str, Any]] = []
    for frame, found in enumerate(images):
        for person, each in enumerate(found or [{}]):
            x, y, visible = (each.get("keypoints", {}).get(n) or [] for n in _XYV)
            places = zip(x, y, visible or [1.0] * len(x), strict=True)
            known = {"frame": frame, "person": person} | each
            entries.append(known | {"keypoints": [v for p in places for v in p]})
    return entries_as_rows(entries, None, None, "ultralytics", "detection")


def is_yolo(path: Path) -> bool:
    """Return whether the first line has a class, a box in shares, and points."""
    fields = "".join(first_lines(path, 1)).split()
    try:
        box = floats_of(fields)[1:_N_BOX]
    except ValueError:
        return False
    shares = len(fields) > 2 * _N_BOX and bool(np.all((box >= 0) & (box <= 1)))
    return shares and fields[0].isdigit()


def read_yolo(path: Path, image_size: Sequence[float] | None = None) -> Landmarks:
    """Read poses in YOLO's format, labels or predictions of one image.

    A line has the class, the box (middle, width, height) and x, y and mostly a third
    number of each point; predictions may have the score and the number of a track
    after them. The third number is 0, 1 or 2 in labels, a confidence in predictions.
    All are fractions of the image's width and height, multiplied by ``image_size``.
    """
    lines = path.read_text(encoding="utf-8-sig").splitlines()
    rows = [floats_of(line.split()) for line in lines if line.strip()]
    if len(lengths := sorted({*map(len, rows)})) > 1:
        raise ValueError(
            f"its lines have {first_items(lengths)} numbers: all must have as many"
        )
    values = np.array(rows)
    size = [1, 1] if image_size is None else checked_sizes("image_size", image_size, 1)
    parts = product(range(3), (3, 2))  # numbers after all points, and of a point
    fits = [(n, k) for k, n in parts if (values.shape[1] - _N_BOX - k) % n == 0]
    n, k = max(fits, key=lambda part: _share_inside(values, *part))
    points, after = _points_of_yolo(values, n, k), values[:, values.shape[1] - k :]
    numbers = dict(zip(("score", "track_id"), after.T.tolist(), strict=False))
    entries = [
        {"person": person, "class": int(values[person, 0])}
        | {name: of_all[person] for name, of_all in numbers.items()}
        | {"keypoints": (each * np.append(size, 1.0)).ravel().tolist()}
        for person, each in enumerate(points)
    ]
    found = entries_as_rows(entries, None, None, "yolo", "line")
    of_labels = np.isin(points[..., 2], (0, 1, 2)).all()
    return replace(found, confidence=None) if of_labels else found


def _points_of_yolo(values: NDArray, n: int, k: int) -> NDArray:
    """Return x, y and a third number (n_lines, n_points, 3), one if there is none."""
    points = values[:, _N_BOX : values.shape[1] - k].reshape(len(values), -1, n)
    return np.pad(points, ((0, 0), (0, 0), (0, 3 - n)), constant_values=1.0)


def _share_inside(values: NDArray, n: int, k: int) -> float:
    """Return which share of points is in or near its box, if lines are split so."""
    points, box = _points_of_yolo(values, n, k)[..., :2], values[:, None, 1:_N_BOX]
    inside = (np.abs(points - box[..., :2]) <= 0.6 * box[..., 2:]).all(axis=2)
    return float(np.mean(inside[points.any(axis=2)])) if points.any() else 0.0


def is_labelme(path: Path) -> bool:
    """Return whether a json file, or one of a folder, has shapes."""
    return bool(json_files(path, "labelme"))


def read_labelme(path: Path) -> Landmarks:
    """Read points of labelme (also X-AnyLabeling): a file, or a folder of images.

    A shape of the type ``point`` is a landmark, its ``label`` the name, its
    ``group_id`` the individual. A point without a shape is missing.
    """
    rows: list[Row] = []
    for file in json_files(path):
        with reading(file, "labelme"):
            content = read_json(file)
            if not isinstance(shapes := dict(content).get("shapes"), list):
                raise ValueError("it has no list of shapes")
            points = [s for s in shapes if s.get("shape_type", "point") == "point"]
            if len(points) < len(shapes):
                warn_caller("shapes that are no points, such as boxes, are left out")
            image = as_utf8(str(content.get("imagePath") or file.name))
            for group in dict.fromkeys(s.get("group_id") for s in points) or [None]:
                group_shapes = [s for s in points if s.get("group_id") == group]
                places = [(str(s["label"]), s["points"][0]) for s in group_shapes]
                rows.append(({"image": image, "individual": group}, _named(places)))
    return _rows_of_names(rows, "labelme")


def read_imglab(path: Path) -> Landmarks:
    """Read an xml file of dlib's imglab: boxes of images, with parts.

    An image without a box has one row without points.
    """
    content = path.read_bytes()
    if b"<!" in content.replace(b"<!--", b""):
        raise ValueError("it has declarations (<!...): delete them")
    rows: list[Row] = []
    for image in ElementTree.fromstring(content).iter("image"):
        for box in image.findall("box") or [ElementTree.Element("box")]:
            sides = {side: float(box.get(side, "nan")) for side in _SIDES}
            parts = [
                (p.get("name"), (p.get("x"), p.get("y"))) for p in box.iter("part")
            ]
            rows.append(({"image": image.get("file"), **sides}, _named(parts)))
    return _rows_of_names(rows, "imglab")


def _named(places: Sequence[tuple[Any, Any]]) -> dict[str, NDArray]:
    """Return points by name, or raise if two have the same."""
    names = [name for name, _ in places]
    if twice := [name for name in names if names.count(name) > 1]:
        raise ValueError(
            f"more than one point is called {twice[0]!r}: each needs its own name"
        )
    found = {name: floats_of([str(v) for v in place]) for name, place in places}
    if any(len(place) != 2 for place in found.values()):
        raise ValueError("each point should have two numbers, x and y")
    return found


def _rows_of_names(rows: Sequence[Row], format: str) -> Landmarks:
    """Return landmarks of rows; names that are numbers are sorted by size."""
    names = list(dict.fromkeys(name for _, points in rows for name in points))
    if all(map(str.isdigit, names)):
        names.sort(key=int)
    gap = np.full(2, np.nan)
    tracks = [[points.get(name, gap) for name in names] for _, points in rows]
    frames = pd.DataFrame([known for known, _ in rows]).dropna(axis=1, how="all")
    places = np.reshape(tracks, (len(rows), len(names), 2))
    return assemble(places, names, frames, format=format)


def is_places(path: Path) -> bool:
    """Return whether a text has lines x y, perhaps after their number or the image."""
    lines = first_lines(path, 3)
    return len(lines) == 3 and all(map(_PLACE.fullmatch, lines[1:]))


def read_places(path: Path) -> Landmarks:
    """Read a text with a line x y for each point of one image (CK+, Helen).

    A first line may have the number of points or the name of the image.
    """
    lines = path.read_text(encoding="utf-8-sig").replace(",", " ").splitlines()
    rows = [line.split() for line in lines if line.strip()]
    image = " ".join(rows.pop(0)) if len(rows[0]) != 2 else ""
    if any(len(row) != 2 for row in rows) or image.isdigit() > (
        image == str(len(rows))
    ):
        raise ValueError("the lines are not x and y of as many points as it says")
    tracks = np.array([floats_of(row) for row in rows])[None]
    return assemble(tracks, None, pd.DataFrame({"image": [image]}), format="places")
