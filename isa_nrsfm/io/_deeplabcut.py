"""Read the csv and h5 files of DeepLabCut and Lightning Pose."""

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from isa_nrsfm._compat.caller import warn_caller
from isa_nrsfm.io._hdf5 import Columns, is_hdf5, read_stored_frame, root_groups
from isa_nrsfm.io._landmarks import Landmarks, assemble_individuals
from isa_nrsfm.io._tables import SEPARATORS, header_rows, read_columns

_LEVELS = ["scorer", "bodyparts", "coords"]
_LEVELS_OF_MANY = ["scorer", "individuals", "bodyparts", "coords"]
# Lightning Pose adds columns of other names, such as set.
_COORDS = ("x", "y", "z", "likelihood")
_VALUES = ("x", "y", "likelihood")
_KEY = "df_with_missing"
# The individual to which points belong that are not of an animal.
_UNIQUE = "single"


def is_deeplabcut(path: Path) -> bool:
    """Return whether the header, or the group of an h5 file, is DeepLabCut's."""
    if path.suffix.lower() in SEPARATORS:
        return _levels_of(header_rows(path, 4)) is not None
    return is_hdf5(path) and _KEY in root_groups(path)


def read_deeplabcut(path: Path) -> Landmarks:
    """Read a csv, tsv or h5 file of DeepLabCut or Lightning Pose.

    The columns have the levels ``scorer``, ``individuals`` (only with several animals),
    ``bodyparts`` and ``coords``: ``x``, ``y`` and, but for labels made by hand,
    ``likelihood``. The index has the number of the frame or the path of the image. The
    individual "single", for points of no animal, is left out where there are others.
    """
    read = _read_text if path.suffix.lower() in SEPARATORS else _read_h5
    table, columns, labels = read(path)
    scorers = {column[0] for column in columns}
    if len(scorers) > 1:
        raise ValueError(f"it has labels of {len(scorers)} scorers; one is needed")
    places = _places(columns)
    first = next(iter(places.values()))
    points = [parts[name] for parts in places.values() for name in first]
    where = np.array([[each.get(coord, -1) for coord in _VALUES] for each in points])
    where = where.reshape(len(places), len(first), len(_VALUES))
    # A column of NaN stands for likelihoods that are not there.
    found = np.column_stack([table, np.full(len(table), np.nan)])[:, where]
    try:
        frames: dict[str, list[Any]] = {"frame": [int(label) for label in labels]}
    except (TypeError, ValueError):
        frames = {"image": [str(label) for label in labels]}
    return assemble_individuals(
        found[..., :2],
        list(places) if len(columns[0]) == len(_LEVELS_OF_MANY) else None,
        list(first),
        frames,
        format="deeplabcut",
        confidence=found[..., 2] if (where[..., 2] >= 0).any() else None,
    )


def _read_text(path: Path) -> tuple[NDArray, Columns, list[Any]]:
    """Read a csv or tsv file, whose first lines are the levels of the columns."""
    header = header_rows(path, 4)
    levels = _levels_of(header)
    if levels is None:
        raise ValueError(
            "its first lines do not begin with scorer, bodyparts, coords or with "
            "scorer, individuals, bodyparts, coords"
        )
    header = header[: len(levels)]
    if len({len(row) for row in header}) > 1:
        raise ValueError("its first lines are not of the same length")
    # Labels made by hand have the path of the image in up to three columns.
    n_index = next(i for i, name in enumerate([*header[-1][1:], "x"], 1) if name)
    columns = list(zip(*header, strict=True))
    numbers = [i for i in range(n_index, len(columns)) if columns[i][-1] in _COORDS]
    names = [str(i) for i in range(len(columns))]
    coordinates = [names[i] for i in numbers]
    frame = read_columns(
        path,
        leave_out=set(names[n_index:]).difference(coordinates),
        numbers=coordinates,
        text=names[:n_index],
        n_header=len(levels),
        names=names,
    )
    cells = frame.iloc[:, :n_index].fillna("").to_numpy()
    labels = ["/".join(row) for row in cells]
    values = frame.iloc[:, n_index:].to_numpy(dtype=np.float64)
    return values, [columns[i] for i in numbers], labels


def _read_h5(path: Path) -> tuple[NDArray, Columns, list[Any]]:
    """Read the table that pandas has stored in an h5 file."""
    values, columns, labels = read_stored_frame(path, _KEY)
    numbers = [i for i, column in enumerate(columns) if column[-1] in _COORDS]
    columns = [columns[i] for i in numbers]
    for column in columns:
        if len(column) not in (len(_LEVELS), len(_LEVELS_OF_MANY)):
            raise ValueError(f"its columns have {len(column)} levels")
    return values[:, numbers], columns, labels


def _levels_of(header: Sequence[Sequence[str]]) -> list[str] | None:
    """Return the levels that the first lines of a csv file name, or None."""
    first = [row[0].strip().lower() if row else "" for row in header]
    for levels in (_LEVELS, _LEVELS_OF_MANY):
        if first[: len(levels)] == levels:
            return levels
    return None


def _places(columns: Sequence[tuple[str, ...]]) -> dict[str, dict[str, dict[str, int]]]:
    """Return the places of coordinates by individual, bodypart and name.

    All individuals have the same bodyparts; one of others, for points of no animal, is
    left out.
    """
    places: dict[str, dict[str, dict[str, int]]] = {}
    for number, (_, *individual, bodypart, coord) in enumerate(columns):
        parts = places.setdefault("".join(individual), {})
        if coord == "z":
            raise ValueError(
                f"{bodypart!r} has a z: these are points in space, not in an image"
            )
        if coord in parts.setdefault(bodypart, {}):
            raise ValueError(f"there is more than one column {coord!r} of {bodypart!r}")
        parts[bodypart][coord] = number
    if not places:
        raise ValueError("it has no columns x and y")
    for parts in places.values():
        for bodypart, of_point in parts.items():
            if not {"x", "y"}.issubset(of_point):
                raise ValueError(f"{bodypart!r} has no x or no y")
    others = [name for name in places if name != _UNIQUE]
    if others and _UNIQUE in places and {*places[_UNIQUE]} != {*places[others[0]]}:
        warn_caller(
            f"the points {', '.join(places.pop(_UNIQUE))} belong to no animal "
            f"(individual {_UNIQUE!r}) and are left out"
        )
    first, *rest = places
    for name in rest:
        if {*places[name]} != {*places[first]}:
            raise ValueError(
                f"the individuals {first!r} and {name!r} have different bodyparts"
            )
    return places
