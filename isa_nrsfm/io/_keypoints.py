"""Read json and texts of trackers, data sets of images and annotation programs."""

import json
import re
import tomllib
from collections.abc import Callable, Sequence
from dataclasses import replace
from itertools import chain, product
from pathlib import Path
from typing import Any
from xml.etree import ElementTree

import numpy as np
from numpy.typing import NDArray

from isa_nrsfm._compat import pandas as pd
from isa_nrsfm._compat.caller import warn_caller
from isa_nrsfm._compat.files import errors_of, reading, refuse_special
from isa_nrsfm._compat.texts import as_utf8, by_number, first_items, frame_numbers
from isa_nrsfm._parameters import OPENPOSE_PARTS, WHOLE_PARTS, named
from isa_nrsfm.io._landmarks import Landmarks, assemble, checked_sizes, stacked
from isa_nrsfm.io._tables import header_names, parse_table

# Names and numbers of the files of other programs.
_DATA = tomllib.loads(Path(__file__).with_name("keypoints.toml").read_text("utf-8"))
# A key and the beginning of its value, or another text, or a brace.
_TOKEN = re.compile(r'("(?:[^"\\]|\\.)*+")(?:\s*:\s*(?=(.)))?|([{}])')
_PTS = re.compile(
    r"\s*version\s*:\s*\S+\s+n_points\s*:\s*(?P<n_points>\d+)\s*"
    r"\{(?P<points>[^{}]*)\}\s*"
)


def json_kind(path: Path) -> str:
    """Return the program of a json file by its keys; empty for other files."""
    with path.open(encoding="utf-8-sig", errors="replace") as file:
        text = file.read(2**16).lstrip()
        found = _kind_of(text)
        if found in ("none", "other") and (remainder := file.read()):
            found = _kind_of(text + remainder)
    return found if text[:1] in ("{", "[") else ""


def _kind_of(text: str) -> str:
    """Return the program of a text by the keys of objects that are in no other."""
    keys, depth = [], 0
    for key, value, brace in _TOKEN.findall(text):
        depth += (brace == "{") - (brace == "}")
        if value and depth == 1:
            keys.append(f"{key}:{value}")
    found = [kind for kind, e in _DATA["kinds"].items() if re.search(e, " ".join(keys))]
    if keys and not found and re.search(r'[lL]andmarks"\s*:\s*\[', text):
        found = ["mediapipe"]  # of frames in an object
    return [*found, "other" if keys else "none"][0]


def json_files(path: Path, *kinds: str) -> list[Path]:
    """Return a file, or the json files of a folder, of some programs or of any."""
    files = sorted(path.glob("[!.]*"), key=by_number) if path.is_dir() else [path]
    files = [file for file in files if file.suffix.lower() == ".json"]
    return [f for f in files if not kinds or (f.is_file() and json_kind(f) in kinds)]


def is_coco(path: Path) -> bool:
    """Return whether a file begins as a json object or list, of no other format."""
    return json_kind(path) in ("coco", "other", "none")


def read_coco(path: Path, part: str | None = None) -> Landmarks:
    """Read keypoints of COCO, annotations or results of a detector.

    Annotations are an object with ``images``, ``annotations`` and ``categories``; the
    third number of a keypoint is 0 if not labelled, 1 if hidden and 2 if visible.
    Results are a list of objects with ``image_id``, ``category_id``, ``keypoints`` and
    ``score``; the third number is a confidence. Each instance has a row, and each image
    without any has one without points, in the order of the numbers in their names.
    ``part`` is a part of whole bodies.
    """
    if isinstance(content := read_json(path), list):
        return entries_as_rows(_results(content), "coco", "result", part=part)
    entries, names = _annotations(content)
    found = entries_as_rows(entries, "coco", "annotation", names, part)
    return replace(found, confidence=None)


# Instances as in results of COCO, and names of their points if they are known.
Entries = Sequence[dict[str, Any]]
Names = list[str] | None


def entries_as_rows(
    entries: Entries, format: str, what: str, names: Names = None, part: Any = None
) -> Landmarks:
    """Return landmarks of entries with ``keypoints``; of images without any, too.

    A point is missing if x and y, or its third number, are zero.
    """
    has_points = [bool(entry.get("keypoints")) for entry in entries]
    if names is None and not any(has_points):
        others = first_items(dict.fromkeys(name for each in entries for name in each))
        raise ValueError(
            f"there are no frames in it: no {what} has keypoints, but {others}"
        )
    given = [entry for entry in entries if entry.get("keypoints")]
    found, names = _keypoints(given, names, part, what)
    values = np.full((len(entries), *found.shape[1:]), np.nan)
    values[has_points] = found
    absent = (values[..., :2] == 0).all(axis=2) | (values[..., 2] == 0)
    rows = [_scalars(entry) for entry in entries]
    columns = dict.fromkeys(name for row in rows for name in row)
    tracks = np.where(absent[..., None], np.nan, values[..., :2])
    frames = {name: [row.get(name) for row in rows] for name in columns}
    return assemble(tracks, names, frames, format=format, confidence=values[..., 2])


def read_json(path: Path) -> Any:
    """Return the content of a json file, or raise a ValueError."""
    try:
        with path.open(encoding="utf-8-sig") as file:
            return json.load(file)
    except (json.JSONDecodeError, RecursionError) as error:
        raise ValueError(f"it is not json: {error}") from error


def _results(entries: list[Any]) -> list[dict[str, Any]]:
    """Return the entries of a list of results, which must be of one category."""
    _refuse_non_objects(entries, "results")
    if not all(isinstance(entry.get("image_id", 0), int | str) for entry in entries):
        raise ValueError("the image_id of a result must be a number or a text")
    categories = {json.dumps(entry.get("category_id")) for entry in entries}
    if len(categories) > 1:
        raise ValueError(
            "the results are of more than one category_id: "
            f"{', '.join(sorted(categories))}"
        )
    return sorted(entries, key=lambda entry: by_number(str(entry.get("image_id"))))


def _annotations(content: Any) -> tuple[list[dict[str, Any]], Names]:
    """Return images with their annotations, and the names of points."""
    lists = ("images", "annotations", "categories")
    contents = first_items(content) if isinstance(content, dict) else content
    content = {"categories": []} | content if isinstance(content, dict) else {}
    if not all(isinstance(content.get(part), list) for part in lists):
        raise ValueError(
            "expected an object with the lists images, annotations and categories, or "
            f"a list of results; got {contents!r:.60}"
        )
    for part in lists:
        _refuse_non_objects(content[part], part)
    chosen, names = _chosen_categories(content["categories"])
    images = _by_id(content["images"], "images")
    of_images: dict[Any, list[dict[str, Any]]] = {image: [] for image in images}
    others = []
    for entry in content["annotations"]:
        where, of = entry.get("image_id"), entry.get("category_id")
        if not isinstance(where, int | str) or where not in images:
            raise ValueError(
                f"annotation {entry.get('id')!r} is of image {where!r}, which is not "
                "among the images"
            )
        origin = {"annotation_id": entry.get("id")}
        if isinstance(of, int | str) and of in chosen:
            origin["category"] = str(chosen[of].get("name"))
        elif content["categories"] and entry.get("keypoints"):
            others.append(str(of))
            continue
        if entry.get("keypoints"):
            of_images[where].append(origin | entry)
    if others:
        listed = first_items(dict.fromkeys(others))
        text = (
            f"{len(others)} annotations are of the category {listed}, which names no "
            "keypoints in the file"
        )
        if not any(of_images.values()):
            raise ValueError(text)
        warn_caller(f"{text}. They are left out")
    entries = [
        {"image_id": image} | _scalars(images[image]) | entry
        for image, found in of_images.items()
        for entry in found or [{}]
    ]
    names_of = {image: str(each.get("file_name", "")) for image, each in images.items()}
    return sorted(entries, key=lambda e: by_number(names_of[e["image_id"]])), names


def _chosen_categories(categories: Entries) -> tuple[dict[Any, dict[str, Any]], Names]:
    """Return the categories to read by their ids, and their common keypoints.

    Where no category has names of keypoints, all are read.
    """
    used = [entry for entry in categories if entry.get("keypoints")] or categories
    names = ", ".join(str(entry.get("name")) for entry in used)
    lists = [entry.get("keypoints") or [] for entry in used] or [[]]
    for found in lists:
        if not isinstance(found, list) or not all(isinstance(p, str) for p in found):
            raise ValueError("the keypoints of a category must be a list of names")
        if found != lists[0]:
            raise ValueError(
                f"the categories {names} have different keypoints: remove the others "
                "from the categories of the file"
            )
    return _by_id(used, "categories"), lists[0] or None


def _by_id(entries: Entries, what: str) -> dict[Any, dict[str, Any]]:
    """Return entries by their identifiers, or raise."""
    if not all(isinstance(entry.get("id"), int | str) for entry in entries):
        raise ValueError(f"each of the {what} needs an id")
    found = {entry["id"]: entry for entry in entries}
    if twice := [each["id"] for each in entries if each != found[each["id"]]]:
        raise ValueError(
            f"two of the {what} have the id {twice[0]!r}, as in files that were "
            "joined: give each its own id, also in the annotations"
        )
    return found


def _keypoints(
    entries: Entries, names: Names, part: str | None, what: str
) -> tuple[NDArray[np.float64], Names]:
    """Return keypoints of instances (n_instances, n_points, 3) and names, of a part."""
    gap = {key: [0] * 3 * n for key, n in _DATA["lists"].items()} | {"keypoints": None}
    further = [key for key in gap if any(key in entry for entry in entries)][1:]
    if further and part is None:
        part = "body"
        warn_caller(
            f"the points of bodies are read, and those in {', '.join(further)} are "
            f"left out: choose with {named('part')}, one of {', '.join(WHOLE_PARTS)}"
        )
    keys = [*_DATA["lists"]] if further and part != "body" else ["keypoints"]
    n_points = len(names) if names and len(keys) == 1 else 0
    found: list[NDArray[np.float64]] = []
    for number, entry in enumerate(entries):
        of_file = f" of {entry['file']}" if "file" in entry else ""
        name = f"{what} {number} (counted from 0){of_file}"
        lists = [(entry.get(key, gap[key]), f"{key} of {name}") for key in keys]
        found.append(np.concatenate([_triples(*each, True) for each in lists]))
        n_points = n_points or len(found[0])
        if (n_given := len(found[-1])) != n_points:
            raise ValueError(f"{name} should have {n_points} keypoints; got {n_given}")
    places: dict[str, tuple[int, int]] = dict.fromkeys(("body", "all"), (0, n_points))
    places |= _DATA["places"].get(str(n_points), {})
    if part is not None and part not in places:
        raise ValueError(
            f"part={part!r} is none of {', '.join(places)}, the parts of {n_points} "
            f"points; whole bodies have {' or '.join(_DATA['places'])}"
        )
    chosen = slice(*places[part or "all"])
    names = names[chosen] if names and len(names) == n_points else None
    return np.reshape(found, (len(entries), n_points, 3))[:, chosen], names


def _triples(numbers: Any, what: str, gaps: bool) -> NDArray[np.float64]:
    """Return x, y and a third number of points, (n_points, 3), with NaN if allowed."""
    if not isinstance(numbers, list) or not all(
        type(number) in (int, float)
        and (abs(number) < 1e300 or (gaps and number != number))
        for number in numbers
    ):
        raise ValueError(
            f"{what} should be a list of finite numbers; got {numbers!r:.40}"
        )
    if len(numbers) % 3:
        raise ValueError(
            f"{what} should have x, y and a third number for each point; got "
            f"{len(numbers)} numbers"
        )
    return np.array(numbers, dtype=np.float64).reshape(-1, 3)


def _scalars(entry: dict[str, Any]) -> dict[str, Any]:
    """Return the entries of an instance or image that are one number or text.

    Those of ``attributes`` are among them, as people and videos are told apart there.
    """
    found, further = {}, entry.get("attributes")
    if isinstance(further, dict):
        entry = further | entry
    for name, value in entry.items():
        value = value[0] if isinstance(value, list) and len(value) == 1 else value
        if isinstance(value, str | int | float) and name not in _DATA["left_out"]:
            found[name] = value
    return found


def _refuse_non_objects(entries: list[Any], what: str) -> None:
    """Raise if a list has something else than objects."""
    if not all(isinstance(entry, dict) for entry in entries):
        raise ValueError(f"all {what} must be objects")


def is_openpose(path: Path) -> bool:
    """Return whether a file begins as those of OpenPose, or a folder has such files."""
    return bool(_openpose_files(path))


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
    absent = "the folder has no files with names ..._keypoints.json, or of people"
    people = _each_file(path, _openpose_files(path), absent, _people_in)
    persons = [person for found in people.values() for person in found]
    parts = [name for name in OPENPOSE_PARTS if any(name in p for p in persons)]
    listed = ", ".join(parts)
    if not parts:
        raise ValueError("it has no visible points in pose_keypoints_2d, ...")
    if len(parts) > 1 and part is None:
        raise ValueError(f"it has points of {listed}: choose one with {named('part')}")
    part = part or listed
    if part not in parts:
        raise ValueError(f"it has no points of {part}, but of {listed}")
    numbers = frame_numbers(list(people)) or []
    if len(set(numbers)) < len(people):
        numbers = list(range(len(people)))
    entries: list[dict[str, Any]] = []
    for (name, found), number in zip(people.items(), numbers, strict=True):
        of_file = {"file": as_utf8(name), "frame": number}
        rows = [
            of_file | {"person": k} | each | {"keypoints": each[part].ravel().tolist()}
            for k, each in enumerate(found)
            if part in each
        ]
        entries += rows or [of_file]
    landmarks = entries_as_rows(entries, "openpose", "person")
    # Points that are cut off can be outside of the image.
    if np.nanmedian(np.abs(landmarks.points)) <= 1:
        raise ValueError(
            "the coordinates are fractions of the image's size, which stretch the "
            "shapes. Run OpenPose with --keypoint_scale 0 for pixels"
        )
    return landmarks


def _each_file(
    path: Path, files: Sequence[Path], absent: str, read: Callable[[Path], Any]
) -> dict[str, Any]:
    """Read a file, or those found in a folder; return what they hold by their names."""
    if not (files := files if path.is_dir() else [path]):
        raise ValueError(absent)
    contents = {}
    for file in files:
        refuse_special(file)
        with errors_of(file.name):
            contents[file.name] = read(file)
    return contents


def _openpose_files(path: Path) -> list[Path]:
    """Return the files of OpenPose in a folder, by their names or entries."""
    files = json_files(path) if path.is_dir() else []
    by_name = [file for file in files if file.stem.lower().endswith("_keypoints")]
    return by_name or json_files(path, "openpose")


def _people_in(file: Path) -> list[dict[str, Any]]:
    """Return the visible parts (n_points, 3) of each person in a file, and its id."""
    content = read_json(file)
    people = content.get("people") if isinstance(content, dict) else None
    if not isinstance(people, list) or not all(isinstance(p, dict) for p in people):
        raise ValueError("expected an object with a list of objects called people")
    found = []
    for person in people:
        who = _scalars(person).get("person_id", -1)
        found.append({} if who == -1 else {"person_id": who})
        for part in OPENPOSE_PARTS:
            key = f"{part}_keypoints_2d"
            if (points := _triples(person.get(key, []), key, False))[:, 2].any():
                found[-1][part] = points
    return found


def is_mmpose(path: Path) -> bool:
    """Return whether a file, or one of a folder, begins as predictions of MMPose."""
    return bool(json_files(path, "mmpose"))


def read_mmpose(path: Path, part: str | None = None) -> Landmarks:
    """Read predictions of MMPose of a video or an image, or of a folder of images.

    A file has a list of instances, or of objects with ``frame_id`` and ``instances``,
    or such a list as ``instance_info`` or ``predictions``. An instance has
    ``keypoints``, [x, y] of each point, and ``keypoint_scores``. ``part`` chooses a
    part of whole bodies. An image without instances has one row without points.
    """
    # An image without instances has an empty list.
    files = json_files(path, "mmpose", "none")
    contents = _each_file(path, files, "no file is of MMPose", _instances_in)
    entries = list(chain(*contents.values()))
    return entries_as_rows(entries, "mmpose", "instance", part=part)


def _instances_in(file: Path) -> list[dict[str, Any]]:
    """Return the instances in a file as those of COCO; one without points if none."""
    content = read_json(file)
    if isinstance(content, dict):
        content = content.get("instance_info", content.get("predictions"))
    if not isinstance(content, list):
        raise ValueError("expected a list of instances, or of frames with instances")
    if all("keypoints" in each for each in content):
        content = [{"instances": content}]
    entries = []
    for number, frame in enumerate(content):
        if not isinstance(frame, dict):
            frame = {"frame_id": number, "instances": frame}
        origin = {"file": as_utf8(file.name)}
        if "frame_id" in frame:
            origin["frame"] = frame["frame_id"]
        for person, each in enumerate(frame["instances"]):
            if {*map(len, each["keypoints"])} - {2} or "keypoint_scores" not in each:
                raise ValueError(
                    "instances need keypoints, x and y of each point, and "
                    "keypoint_scores; keypoints x, y, z are points in space"
                )
            pairs = zip(each["keypoints"], each["keypoint_scores"], strict=True)
            values = [float(v) for (x, y), score in pairs for v in (x, y, score)]
            entries.append(origin | each | {"person": person, "keypoints": values})
        if not frame["instances"]:
            entries.append(origin)
    return entries


def read_pts(path: Path) -> Landmarks:
    """Read a .pts file, with the points of one image.

    It has ``version: 1``, ``n_points: 68`` and, between braces, a line ``x y`` for each
    point. Coordinates are as they are written; iBUG counts pixels from 1.
    """
    text = path.read_bytes().decode("utf-8-sig")
    if (match := _PTS.fullmatch(text)) is None:
        raise ValueError(
            "expected 'version: 1', 'n_points: N' and N lines 'x y' between braces; "
            f"got {text[:40]!r}"
        )
    coordinates, n_points = floats_of(match["points"].split()), int(match["n_points"])
    if len(coordinates) != 2 * n_points or n_points == 0:
        raise ValueError(
            f"n_points is {n_points}, but there are {len(coordinates)} coordinates"
        )
    frames = {"file": [as_utf8(path.name)]}
    return assemble(coordinates.reshape(1, n_points, 2), None, frames, format="pts")


def read_tps(path: Path) -> Landmarks:
    """Read a tps file of morphometrics, with a row for each specimen.

    ``LM=12`` and twelve lines ``x y`` are followed by lines such as ``IMAGE=a.jpg``,
    ``ID=1`` and ``SCALE=0.1``, the columns of the frames. y points up. Points of curves
    are left out. Missing points are NA NA or -1 -1.
    """
    text = path.read_text(encoding="utf-8-sig")
    if commas := re.findall(r"(?m)^\s*(-?\d+,\d+)\s+-?\d+(?:,\d+)?\s*$", text):
        text = re.sub(r"(?m)(?<=\d),(?=\d+(?:\s+-?[\d,]+)?\s*$)", ".", text)
        warn_caller(f"numbers have decimal commas, such as {commas[0]}")
    head, *parts = re.split(r"(?im)^\s*LM\s*=", text)
    if head.strip() or not parts:
        raise ValueError(f"expected LM= and a number of landmarks; got {text[:40]!r}")
    tracks, rows, n_left = [], [], 0
    for number, part in enumerate(parts):
        with errors_of(f"specimen {number} (counted from 0)"):
            count, *lines = filter(None, map(str.strip, part.splitlines()))
            if not count.isdigit():
                raise ValueError(f"LM= needs a number of landmarks; got {count!r:.40}")
            points = " ".join(lines[: int(count)]).replace("NA", "nan")
            tracks.append({0: floats_of(points.split()).reshape(int(count), 2)})
            entries = [line.partition("=") for line in lines[int(count) :]]
            if entries and not entries[0][1]:
                raise ValueError(f"there are more than {count} landmarks")
        n_left += sum(not equals for _, equals, _ in entries)
        found = {name.strip().lower(): value.strip() for name, _, value in entries}
        rows.append({name: found[name] for name in _DATA["tps"] if name in found})
    if n_left and not any(len(each[0]) for each in tracks):
        raise ValueError(
            f"all its {n_left} points are on curves, which are left out: append them "
            "to the landmarks, in tpsUtil with 'Append tps curve to landmarks'"
        )
    if n_left:
        warn_caller(f"{n_left} points of curves are left out")
    *_, values = stacked(tracks, [f"specimen {i}" for i in range(len(tracks))])
    values[(values == -1).all(axis=2)] = np.nan  # as tpsDig and geomorph write them
    return assemble(values, None, rows, format="tps")


def read_wflw(path: Path) -> Landmarks:
    """Read a list of WFLW, with a line for each face.

    A line has 196 coordinates, x and y in turn, the box of the face (``x_min y_min
    x_max y_max``), six attributes 0 or 1 (pose, expression, illumination, make-up,
    occlusion, blur) and the name of the image. Box and attributes may be missing.
    """
    fields = np.loadtxt(path, dtype=str, comments=None, encoding="utf-8-sig", ndmin=2)
    n = fields.shape[1]
    if n not in (197, 207):  # without and with the box and the attributes
        raise ValueError(f"the lines have {n} fields; all must have 197 or all 207")
    numbers = np.stack([floats_of(row) for row in fields[:, :-1].tolist()])
    frames: dict[str, object] = {"image": fields[:, -1]}
    points, box, attributes = np.split(numbers, [196, 200], axis=1)
    if n == 207:
        if not np.isin(attributes, (0, 1)).all():
            raise ValueError("the six attributes before the image must be 0 or 1")
        frames |= zip(_DATA["wflw_box"], box.T, strict=True)
        frames |= zip(_DATA["wflw_attributes"], attributes.T.astype(int), strict=True)
    return assemble(points.reshape(-1, 98, 2), None, frames, format="wflw")


def floats_of(fields: list[str]) -> NDArray[np.float64]:
    """Return the numbers that fields hold."""
    # Python reads 1_0 as a number.
    if bad := [field for field in fields if "_" in field]:
        raise ValueError(f"a coordinate should be a number; got {bad[0]!r}")
    numbers = np.array(fields, dtype=np.float64)
    if (infinite := np.isinf(numbers)).any():
        first = fields[int(infinite.argmax())]
        raise ValueError(f"a coordinate should be finite; got {first!r}")
    return numbers


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
    return entries_as_rows(entries, "ultralytics", "detection")


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
    frames = {"person": range(len(rows)), "class": [*map(int, values[:, 0])]}
    frames |= zip(("score", "track_id"), after.T, strict=False)
    places = (points * np.append(size, 1.0)).reshape(len(rows), -1).tolist()
    entries = pd.DataFrame(frames | {"keypoints": places}).to_dict("records")
    found = entries_as_rows(entries, "yolo", "line")
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
    if b"<!" in (content := path.read_bytes()).replace(b"<!--", b""):
        raise ValueError("it has declarations (<!...): delete them")
    rows: list[Row] = []
    for image in ElementTree.fromstring(content).iter("image"):
        for box in image.findall("box") or [ElementTree.Element("box")]:
            sides = {side: float(box.get(side, "nan")) for side in _SIDES}
            parts = [
                (p.get("name"), [p.get(a) for a in "xy"]) for p in box.iter("part")
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


def read_places(path: Path) -> Landmarks:
    """Read a text with a line x y for each point of one image (CK+, Helen).

    A first line may have the number of points or the name of the image.
    """
    lines = path.read_text(encoding="utf-8-sig").replace(",", " ").splitlines()
    rows = [line.split() for line in lines if line.strip()]
    image = " ".join(rows.pop(0)) if len(rows[0]) != 2 else ""
    wrong = image.isdigit() and image != str(len(rows))
    if wrong or any(len(row) != 2 for row in rows):
        raise ValueError("the lines are not x and y of as many points as it says")
    tracks = np.array([floats_of(row) for row in rows])[None]
    return assemble(tracks, None, pd.DataFrame({"image": [image]}), format="places")
