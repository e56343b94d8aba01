"""Read the analysis files of SLEAP, h5 and csv."""

import json
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from isa_nrsfm._compat.optional import import_optional
from isa_nrsfm.io._hdf5 import content_of, is_hdf5, numbers_of, root_groups
from isa_nrsfm.io._landmark_columns import find_landmark_columns
from isa_nrsfm.io._landmarks import Landmarks, assemble, assemble_individuals
from isa_nrsfm.io._tables import header_names, read_columns, tracks_in
from isa_nrsfm.skeletons import Skeleton, skeleton_of_names

_DIMS = ("frame", "track", "node", "xy")
# Without the attribute: SLEAP's own order, and that of its older files
# for Python. They differ where there are more than two points.
_ORDERS = (("track", "xy", "node", "frame"), ("frame", "node", "xy", "track"))
_CSV_COLUMNS = ["track", "frame_idx", "instance.score"]
_NEEDED = frozenset({"tracks", "node_names", "track_names"})


def is_sleap(path: Path) -> bool:
    """Return whether a file has the datasets (h5) or the header of SLEAP."""
    if is_hdf5(path):
        return _NEEDED <= root_groups(path)
    return header_names(path)[: len(_CSV_COLUMNS)] == _CSV_COLUMNS


def read_sleap(path: Path) -> Landmarks:
    """Read an analysis h5 file or table of SLEAP, or of sleap-io and movement.

    In an h5 file, ``tracks`` has the points, in the order of axes of its attribute
    ``dims``, by default (track, xy, node, frame). ``point_scores`` and
    ``instance_scores`` have confidences, ``edge_names`` the pairs of nodes that the
    skeleton joins. A table has a row for each instance, ``track, frame_idx,
    instance.score`` and ``x``, ``y`` and ``score`` of each node. Frames are counted
    from 0.
    """
    is_h5 = path.suffix.lower() in (".h5", ".hdf5")
    return _read_h5(path) if is_h5 else _read_table(path)


def _read_table(path: Path) -> Landmarks:
    """Read a table, which has no rows for frames without instances."""
    if not is_sleap(path):
        raise ValueError(f"its first columns are not {', '.join(_CSV_COLUMNS)}")
    names = header_names(path)
    found = find_landmark_columns(names, "*.x,*.y")
    nodes = [name.removesuffix(".x") for name in found.x]
    scores = [f"{node}.score" for node in nodes]
    if not set(scores).issubset(names):
        raise ValueError("not all of its points have a score")
    table = read_columns(
        path,
        numbers=[*found.interleaved, *scores, "frame_idx", "instance.score"],
        text=("track",),
    )
    return assemble(
        tracks_in(table, found.interleaved),
        nodes,
        table[_CSV_COLUMNS].set_axis(["individual", "frame", "instance_score"], axis=1),
        format="sleap",
        confidence=table[scores].to_numpy(np.float64),
    )


def _read_h5(path: Path) -> Landmarks:
    """Read an h5 file."""
    h5py = import_optional("h5py", extra="h5")
    with h5py.File(path, "r") as file:
        absent = _NEEDED.difference(file)
        if absent:
            raise ValueError(f"it has no dataset {', '.join(sorted(absent))}")
        nodes = _texts(content_of(file, "node_names"))
        names = _texts(content_of(file, "track_names"))
        tracks, dims = _array(file, "tracks", {"xy": 2, "node": len(nodes)}, _ORDERS)
        lengths = dict(zip(_DIMS, tracks.shape, strict=True))
        scores = {}
        for name, n_dims in (("point_scores", 3), ("instance_scores", 2)):
            if name in file:
                order = [dim for dim in dims if dim in _DIMS[:n_dims]]
                scores[name], _ = _array(file, name, lengths, [order])
        skeleton = _skeleton(file, nodes)
    n_tracks = tracks.shape[1]
    if names and len(names) != n_tracks:
        raise ValueError(f"tracks holds {n_tracks} tracks, track_names {len(names)}")
    of_instances = scores.pop("instance_scores", np.array(np.nan))
    scored = {} if np.isnan(of_instances).all() else {"instance_score": of_instances}
    return assemble_individuals(
        tracks,
        names or (range(n_tracks) if n_tracks > 1 else None),
        nodes,
        {"frame": range(len(tracks))},
        of_instances=scored,
        format="sleap",
        confidence=scores.get("point_scores"),
        skeleton=skeleton,
    )


def _array(
    file: Any, name: str, lengths: dict[str, int], orders: Sequence[Sequence[str]]
) -> tuple[NDArray[np.float64], Sequence[str]]:
    """Return numbers with the axes in the order of `_DIMS`, and in the order stored.

    Without the attribute ``dims`` this is one of `orders`.
    """
    stored, named = numbers_of(file, name), _named_dims(file[name])
    wanted = [dim for dim in _DIMS if dim in orders[0]]
    known = {dim: length for dim, length in lengths.items() if dim in wanted}
    for dims in orders if named is None else [named]:
        sizes = dict(zip(dims, stored.shape, strict=False))
        fits = all(sizes.get(dim) == length for dim, length in known.items())
        if sorted(dims) == sorted(wanted) and stored.ndim == len(dims) and fits:
            return stored.transpose([dims.index(dim) for dim in wanted]), dims
    raise ValueError(
        f"{name} should have the axes {', '.join(named or orders[0])}, with "
        f"{' and '.join(map(str, known.values()))} for {' and '.join(known)}; got the "
        f"shape {stored.shape}"
    )


def _named_dims(dataset: Any) -> list[str] | None:
    """Return the names of the axes in the attributes of a dataset, or None."""
    if "dims" not in dataset.attrs:
        return None
    named = json.loads(dataset.attrs["dims"])
    if not isinstance(named, list) or not all(isinstance(dim, str) for dim in named):
        raise ValueError(f"its attribute dims should be a list of names; got {named}")
    return named


def _skeleton(file: Any, nodes: list[str]) -> Skeleton | None:
    """Return the skeleton of the dataset of edges; None if it is empty or absent."""
    if "edge_names" not in file or not file["edge_names"].size:
        return None
    content = content_of(file, "edge_names")
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
