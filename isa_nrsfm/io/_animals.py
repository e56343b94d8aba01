"""Read landmarks of animals, and in files of arrays: NumPy, MATLAB, HDF5 and TRC."""

import json
import pickle
import pickletools
import re
from collections.abc import Sequence
from itertools import product
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from isa_nrsfm._compat.caller import warn_caller
from isa_nrsfm._compat.files import reading
from isa_nrsfm._compat.lazy import import_optional
from isa_nrsfm._compat.stored_arrays import array_in, read_arrays
from isa_nrsfm.io._keypoints import floats_of
from isa_nrsfm.io._landmarks import Landmarks, assemble, assemble_individuals
from isa_nrsfm.io._tables import SEPARATORS, header_rows, read_columns
from isa_nrsfm.skeletons import Skeleton, skeleton_of_names

_SIGNATURE = b"\x89HDF\r\n\x1a\n"
# zlib packs at most so many bytes into one (zlib.net, zlib technical details).
LARGEST_RATIO = 1032
# DeepLabCut: levels of the columns
_LEVELS = ["scorer", "bodyparts", "coords"]
_LEVELS_OF_MANY = ["scorer", "individuals", "bodyparts", "coords"]
# Programs that save them again may leave out the first.
_SAVED = (_LEVELS, _LEVELS_OF_MANY, _LEVELS[1:], _LEVELS_OF_MANY[1:])
# Lightning Pose adds columns of other names, such as set.
_COORDS = ("x", "y", "z", "likelihood")
_VALUES = ("x", "y", "likelihood")
_KEY = "df_with_missing"
# The individual to which points belong that are not of an animal.
_UNIQUE = "single"
# SLEAP: axes of the points, also of older files
_DIMS = ("frame", "track", "node", "xy")
# Without the attribute: SLEAP's own order, and that of its older files
# for Python. They differ where there are more than two points.
_ORDERS = (("track", "xy", "node", "frame"), ("frame", "node", "xy", "track"))
_NEEDED = frozenset({"tracks", "node_names", "track_names"})

# What pickled labels may hold, and the instructions of pickle that move it.
_PLAIN = ("list", "tuple", "str", "bytes_or_str", "int", "int_or_bool", "float", "mark")
_PICKLED = re.compile("PROTO|FRAME|STOP|MEMOIZE|(LONG_)?(BIN)?(GET|PUT)")

Columns = list[tuple[str, ...]]


def is_hdf5(path: Path) -> bool:
    """Return whether a file begins as HDF5 files do."""
    with path.open("rb") as file:
        return file.read(len(_SIGNATURE)) == _SIGNATURE


def opened(path: Path) -> Any:
    """Return an HDF5 file, open for reading."""
    return import_optional("h5py", extra="h5").File(path, "r")


def root_groups(path: Path) -> set[str]:
    """Return the names at the root of an HDF5 file, or raise where it is damaged."""
    with reading(path, "HDF5"), opened(path) as file:
        return set(file)


def own_member(group: Any, name: str) -> Any:
    """Return a member of a group, or None; raise for links, also to other files."""
    link = group.get(name, getlink=True)
    if link is not None and type(link).__name__ != "HardLink":
        raise ValueError(f"{name} is a link; copy what it links to into the file")
    return group.get(name)


def content_of(group: Any, name: str) -> Any:
    """Return the content of a dataset: an array, a number or a text.

    Raise if there is none, if other files hold it, or if it claims to hold more than
    the file can: HDF5 has no data of the parts of an array that nobody wrote.
    """
    dataset = own_member(group, name)
    if dataset is None or not hasattr(dataset, "nbytes"):
        raise ValueError(f"it has no dataset {name}")
    if dataset.external or dataset.is_virtual:
        raise ValueError(f"the dataset {name} is stored in another file")
    stored = dataset.id.get_storage_size()
    if dataset.nbytes > LARGEST_RATIO * stored:
        raise ValueError(
            f"the dataset {name} of shape {dataset.shape} would need {dataset.nbytes} "
            f"bytes; the file has {stored}"
        )
    return dataset[()]


def numbers_of(group: Any, name: str) -> NDArray[np.float64]:
    """Return the real numbers that a dataset holds, or raise a ValueError."""
    content = content_of(group, name)
    if not isinstance(content, np.ndarray) or content.dtype.kind not in "fiu":
        got = getattr(content, "dtype", type(content).__name__)
        raise ValueError(f"the dataset {name} should have real numbers; got {got}")
    return content.astype(np.float64, copy=False)


def is_deeplabcut(path: Path) -> bool:
    """Return whether the header, or the group of an h5 file, is DeepLabCut's."""
    if path.suffix.lower() in SEPARATORS:
        return _levels_of(header_rows(path, 4))[0] is not None
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
    # pandas makes names of a line different: net, net.1, ...
    scorers = {re.sub(r"\.\d+$", "", column[0]) for column in columns}
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
        frames = {"image": [*map(_text, labels)]}
    sure = found[..., 2] if (where[..., 2] >= 0).any() else None
    names = list(places) if len(columns[0]) == len(_LEVELS_OF_MANY) else None
    known: dict[str, Any] = {"format": "deeplabcut", "confidence": sure}
    return assemble_individuals(found[..., :2], names, list(first), frames, **known)


def _read_text(path: Path) -> tuple[NDArray, Columns, list[Any]]:
    """Read a csv or tsv file, whose first lines are the levels of the columns."""
    header = header_rows(path, 4)
    levels, n_before = _levels_of(header)
    if levels is None:
        raise ValueError(
            "its first lines do not begin with scorer, bodyparts, coords or with "
            "scorer, individuals, bodyparts, coords"
        )
    header = header[: len(levels)]
    if len({len(row) for row in header}) > 1:
        raise ValueError("its first lines are not of the same length")
    # Labels made by hand have the path of the image in up to three columns.
    first = n_before + 1
    n_index = next(i for i, n in enumerate([*header[-1][first:], "x"], first) if n)
    if levels[0] != "scorer":
        header.insert(0, [""] * len(header[0]))
    columns = {str(i): each for i, each in enumerate(zip(*header, strict=True))}
    names = list(columns)
    index = names[n_before:n_index]
    coordinates = [name for name in names[n_index:] if columns[name][-1] in _COORDS]
    left_out = {*names}.difference(index, coordinates)
    known: dict[str, Any] = {"text": index, "n_header": len(levels), "names": names}
    frame = read_columns(path, leave_out=left_out, numbers=coordinates, **known)
    labels = ["/".join(row) for row in frame[index].fillna("").to_numpy()]
    values = frame[coordinates].to_numpy(dtype=np.float64)
    return values, [columns[name] for name in coordinates], labels


def _levels_of(header: Sequence[Sequence[str]]) -> tuple[list[str] | None, int]:
    """Return the levels that the first lines of a csv file name, or None.

    Also the number of columns before them: one if pandas has saved it again.
    """
    for place, levels in product((0, 1), _SAVED):
        first = [row[place].strip().lower() for row in header if len(row) > place]
        if first[: len(levels)] == levels:
            return levels, place
    return None, 0


def _places(columns: Sequence[tuple[str, ...]]) -> dict[str, dict[str, dict[str, int]]]:
    """Return the places of coordinates by individual, bodypart and name.

    All individuals have the same bodyparts; one of others, for points of no animal, is
    left out.
    """
    places: dict[str, dict[str, dict[str, int]]] = {}
    for number, (_, *individual, bodypart, coord) in enumerate(columns):
        if coord == "z":
            raise ValueError(
                f"{bodypart!r} has a z: these are points in space, not in an image"
            )
        of_point = places.setdefault("".join(individual), {}).setdefault(bodypart, {})
        if of_point.setdefault(coord, number) != number:
            raise ValueError(f"there is more than one column {coord!r} of {bodypart!r}")
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
    first = next(iter(places))
    for name in places:
        if {*places[name]} != {*places[first]}:
            raise ValueError(
                f"the individuals {first!r} and {name!r} have different bodyparts"
            )
    return places


def _read_h5(path: Path) -> tuple[NDArray, Columns, list[Any]]:
    """Read the table that pandas has stored in an h5 file.

    Returns numbers (n_rows, n_columns), levels of the columns, and labels of the rows.
    Damaged files lead to errors of h5py and pickle.
    """
    with opened(path) as file:
        group = own_member(file, _KEY)
        if not hasattr(group, "attrs"):
            raise ValueError(f"it has no group {_KEY}")
        kind = _text(group.attrs.get("pandas_type", ""))
        if kind not in ("frame_table", "frame"):
            raise ValueError(f"{_KEY} is no table of pandas")
        read = _table_blocks if kind == "frame_table" else _fixed_blocks
        blocks, labels = read(group)
    arrays, columns = [np.empty((len(labels), 0))], []
    for values, names in blocks:
        if values.shape != (len(labels), len(names)):
            raise ValueError(
                f"a block of {len(labels)} rows and {len(names)} columns has the shape "
                f"{values.shape}"
            )
        arrays.append(values[:, [name[-1] in _COORDS for name in names]])
        columns += [name for name in names if name[-1] in _COORDS]
    for column in columns:
        if len(column) not in (len(_LEVELS), len(_LEVELS_OF_MANY)):
            raise ValueError(f"its columns have {len(column)} levels")
    return np.concatenate(arrays, axis=1).astype(np.float64), columns, labels


def _table_blocks(group: Any) -> tuple[list[tuple[NDArray, Columns]], list[Any]]:
    """Return the blocks of format="table", one field of the rows each."""
    rows, table = content_of(group, "table"), group["table"]
    blocks = []
    for name in rows.dtype.names or ():
        if name.startswith("values_block_") and rows.dtype[name].base.kind in "fiu":
            columns = _labels(table.attrs[f"{name}_kind"])
            blocks.append((rows[name].reshape(len(rows), -1), columns))
    return blocks, rows["index"].tolist()


def _fixed_blocks(group: Any) -> tuple[list[tuple[NDArray, Columns]], list[Any]]:
    """Return the blocks of format="fixed", an array each."""
    blocks = []
    for i in range(int(group.attrs["nblocks"])):
        name = f"block{i}_values"
        if (values := content_of(group, name)).dtype.kind in "fiu":
            if not group[name].attrs.get("transposed", False):
                values = values.T
            blocks.append((values, _levels(group, f"block{i}_items")))
    if _text(group.attrs["axis1_variety"]) == "multi":
        return blocks, ["/".join(label) for label in _levels(group, "axis1")]
    return blocks, content_of(group, "axis1").tolist()


def _levels(group: Any, name: str) -> Columns:
    """Return labels of several levels."""
    if _text(group.attrs[f"{name}_variety"]) != "multi":
        return [(_text(label),) for label in content_of(group, name)]
    parts = []
    for i in range(int(group.attrs[f"{name}_nlevels"])):
        texts = [_text(text) for text in content_of(group, f"{name}_level{i}")]
        codes = content_of(group, f"{name}_label{i}")
        if np.any((codes < 0) | (codes >= len(texts))):
            raise ValueError(f"{name} has labels that are not among its texts")
        parts.append([texts[code] for code in codes])
    return list(zip(*parts, strict=True))


def _text(value: Any) -> str:
    """Return a text that HDF5 holds as bytes or as a text."""
    return value.decode("utf-8") if isinstance(value, bytes) else str(value)


def _labels(pickled: Any) -> Columns:
    """Return pickled labels of columns, tuples of texts or numbers.

    Nothing else is unpickled: objects, and containers that grow when they are compared
    or written.
    """
    content = bytes(pickled)
    for code, *_ in pickletools.genops(content):
        made = [each.name for each in code.stack_after]
        if not _PICKLED.fullmatch(code.name) and (not made or made[0] not in _PLAIN):
            raise ValueError(f"its labels should be texts; pickled with {code.name}")
    labels = pickle.loads(content, encoding="utf-8")
    for label in labels:
        if not all(isinstance(part, str | int | float) for part in label):
            raise ValueError("its labels should be texts; got nested labels")
    return [tuple(map(str, label)) for label in labels]


def is_sleap(path: Path) -> bool:
    """Return whether a file has the datasets of SLEAP."""
    return is_hdf5(path) and _NEEDED <= root_groups(path)


def read_sleap(path: Path) -> Landmarks:
    """Read an analysis h5 file of SLEAP, or of sleap-io and movement.

    ``tracks`` has the points, in the order of axes of its attribute ``dims``, by
    default (track, xy, node, frame). ``point_scores`` and ``instance_scores`` have
    confidences, ``edge_names`` the pairs of nodes that the skeleton joins. Frames are
    counted from 0.
    """
    with opened(path) as file:
        if absent := _NEEDED.difference(file):
            raise ValueError(f"it has no dataset {', '.join(sorted(absent))}")
        nodes = _texts(content_of(file, "node_names"))
        names = _texts(content_of(file, "track_names"))
        tracks, dims = _array(file, "tracks", {"xy": 2, "node": len(nodes)}, _ORDERS)
        lengths = dict(zip(_DIMS, tracks.shape, strict=True))
        known: dict[str, Any] = {"format": "sleap", "skeleton": _skeleton(file, nodes)}
        for name, n_dims in (("point_scores", 3), ("instance_scores", 2)):
            if name in file:
                order = [dim for dim in dims if dim in _DIMS[:n_dims]]
                known[name], _ = _array(file, name, lengths, [order])
    n_tracks = tracks.shape[1]
    if names and len(names) != n_tracks:
        raise ValueError(f"tracks holds {n_tracks} tracks, track_names {len(names)}")
    who = names or (range(n_tracks) if n_tracks > 1 else None)
    frames, sure = {"frame": range(len(tracks))}, known.pop("point_scores", None)
    return assemble_individuals(tracks, who, nodes, frames, confidence=sure, **known)


def is_facemap(path: Path) -> bool:
    """Return whether a file has the group of Facemap."""
    return is_hdf5(path) and "Facemap" in root_groups(path)


def read_facemap(path: Path) -> Landmarks:
    """Read an h5 file of Facemap: x, y and likelihood of each body part in a group.

    Body parts are in the order of their names, frames are counted from 0.
    """
    with opened(path) as file:
        group = own_member(file, "Facemap")
        parts = [own_member(group, name) for name in group]
        values = [[numbers_of(part, name) for name in _VALUES] for part in parts]
        names = list(group)
    points = np.moveaxis(np.array(values), 2, 0)
    frames, sure = {"frame": range(len(points))}, points[..., 2]
    return assemble(points[..., :2], names, frames, format="facemap", confidence=sure)


def _array(
    file: Any, name: str, lengths: dict[str, int], orders: Sequence[Sequence[str]]
) -> tuple[NDArray[np.float64], Sequence[str]]:
    """Return numbers with the axes in the order of `_DIMS`, and in the order stored.

    Without the attribute ``dims`` this is one of `orders`.
    """
    stored, attributes = numbers_of(file, name), file[name].attrs
    wanted = [dim for dim in _DIMS if dim in orders[0]]
    known = {dim: length for dim, length in lengths.items() if dim in wanted}
    if "dims" in attributes:
        dims = json.loads(attributes["dims"])
        if not isinstance(dims, list) or not all(isinstance(dim, str) for dim in dims):
            raise ValueError(
                f"its attribute dims should be a list of names; got {dims}"
            )
        orders = [dims]
    for dims in orders:
        sizes = dict(zip(dims, stored.shape, strict=False))
        fits = known.items() <= sizes.items() and stored.ndim == len(dims)
        if fits and sorted(dims) == sorted(wanted):
            return stored.transpose([dims.index(dim) for dim in wanted]), dims
    raise ValueError(
        f"{name} should have the axes {', '.join(orders[0])}, with "
        f"{' and '.join(map(str, known.values()))} for {' and '.join(known)}; got the "
        f"shape {stored.shape}"
    )


def _skeleton(file: Any, nodes: list[str]) -> Skeleton | None:
    """Return the skeleton of the dataset of edges; None if it is empty or absent."""
    content = content_of(file, "edge_names") if "edge_names" in file else ()
    if not np.size(content):
        return None
    size = np.shape(content)
    if len(size) != 2 or 2 not in size:
        raise ValueError(f"edge_names should hold pairs of names; got the shape {size}")
    names = np.reshape(_texts(content), size)
    # SLEAP writes a row for each edge; all other arrays of MATLAB's order are turned.
    edges = (names if size[1] == 2 else names.T).tolist()
    return skeleton_of_names(edges, nodes, name="SLEAP", source="its analysis file")


def _texts(content: Any) -> list[str]:
    """Return the texts that a dataset holds; an empty one may be of numbers."""
    texts = np.ravel(content).tolist() if np.size(content) else []
    if not all(isinstance(text, bytes | str) for text in texts):
        raise ValueError(f"the names of nodes and tracks should be texts; got {texts}")
    return [text.decode() if isinstance(text, bytes) else text for text in texts]


def read_array(path: Path) -> Landmarks:
    """Read the one array of points that a npy, npz or mat file has.

    It is (n_frames, n_points, 2), (n_frames, 2, n_points), or a table (n_frames,
    2 * n_points) of x and y in turn. A warning says how it is read.
    """
    arrays = _arrays_in(path)
    # (n_frames, 1, n_points, 2) of one individual
    found = {n: a.squeeze() if a.ndim > 3 else a for n, a in arrays.items()}
    found = {n: a for n, a in found.items() if a.ndim in (2, 3) and a.size > 2}
    found = {n: a for n, a in found.items() if a.dtype.kind in "fiu"}
    if len(found) > 1:
        found = {name: array for name, array in found.items() if array.ndim == 3}
    if len(found) != 1:
        shapes = (f"{n} {a.shape} of {a.dtype}" for n, a in (found or arrays).items())
        raise ValueError(
            f"one array of points is needed; got {', '.join(shapes) or 'none'}. Save "
            "that of the points with np.save('new.npy', array)"
        )
    ((_, array),) = found.items()
    if array.ndim == 2 and array.shape[1] % 2 == 0:
        order, tracks = "columns x0, y0, x1, y1, ...", array.reshape(len(array), -1, 2)
    elif array.shape[1:].count(2) == 1:
        last = array.shape[2] == 2
        order = "(frames, points, xy)" if last else "(frames, xy, points)"
        tracks = array if last else array.mT
    else:
        way = "array[..., :2]" if array.shape[-1] in (3, 4) else "array.transpose(...)"
        if array.ndim == 2:  # x and y of frames in turn
            way = f"array.reshape(-1, 2, {array.shape[1]})"
        elif len(array) == 2:
            way = "array.transpose(1, 2, 0)"
        raise ValueError(
            "the array should be (n_frames, n_points, 2); got the shape "
            f"{array.shape}: np.save('new.npy', {way})"
        )
    warn_caller(
        f"the array {array.shape} of {path.name} is read as {order}: {len(tracks)} "
        f"frames of {tracks.shape[1]} points. If its order is another one, save it "
        "as (frames, points, xy) with np.save('new.npy', array.transpose(...))"
    )
    return assemble(tracks.astype(np.float64), None, {}, format="array")


def _arrays_in(path: Path) -> dict[str, NDArray]:
    """Return the arrays of a file by their names."""
    if path.suffix.lower() == ".npy":
        return {"array": array_in(path.read_bytes())}
    if path.suffix.lower() == ".npz":
        return read_arrays(path)
    if not is_hdf5(path):
        from scipy.io import loadmat  # takes a while

        return {n: a for n, a in loadmat(path).items() if isinstance(a, np.ndarray)}
    with opened(path) as file:  # MATLAB 7.3, whose axes are turned round
        names = [name for name in file if hasattr(own_member(file, name), "dtype")]
        return {name: np.asarray(content_of(file, name)).T for name in names}


def read_trc(path: Path) -> Landmarks:
    """Read a TRC file of points in an image, such as those of Sports2D in pixels.

    The fourth line names the points, from the third column on, and data follow after
    the fifth. All z must be equal or empty.
    """
    lines = path.read_text(encoding="utf-8-sig").splitlines()
    if len(lines) < 6:
        raise ValueError(f"it has {len(lines)} lines, and no rows of points")
    names = [name.strip() for name in lines[3].split("\t")[2:] if name.strip()]
    rows = [line.split("\t") for line in lines[5:] if line.strip()]
    cells = [[c.strip() or "nan" for c in row[: 2 + 3 * len(names)]] for row in rows]
    values = np.reshape([floats_of(row) for row in cells], (len(rows), -1))
    points = values[:, 2:].reshape(len(rows), -1, 3)
    z = points[..., 2][~np.isnan(points[..., 2])]
    if len(z) and np.ptp(z) > 1e-9:
        raise ValueError("its points have different z: they are in space, not an image")
    frames = {"frame": values[:, 0].astype(int), "time": values[:, 1]}
    return assemble(points[..., :2], names, frames, format="trc")
