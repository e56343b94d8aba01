"""Shapes to look at: a self-contained page for any browser, and a glTF 2.0 file."""

import base64
import hashlib
import json
import os
import struct
from collections.abc import Sequence
from html import escape
from importlib.resources import files
from numbers import Integral, Real
from typing import Any, cast

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.spatial import Delaunay, QhullError
from sklearn.utils import check_array

from isa_nrsfm import __version__
from isa_nrsfm._compat.files import write_whole
from isa_nrsfm._compat.scikit_learn import number_of_rows, taken_rows
from isa_nrsfm._fitted_model import frames_of, sees_perspective
from isa_nrsfm.analysis._frame_columns import checked_times, is_missing
from isa_nrsfm.export import _upright
from isa_nrsfm.plotting import _views
from isa_nrsfm.plotting._views import SPANNING_TREE, UPSIDE_DOWN, Edges, Origin
from isa_nrsfm.skeletons import Skeleton
from isa_nrsfm.skeletons._column_names import names_of_components, names_of_points

# The colours of more labels than this look alike.
MOST_LABELS = 30
ABOUT = {
    None: "Affine shapes: angles and depth are not those of the object.",
    "unknown": "The depth is not determined: angles and proportions are not those of "
    "the object.",
}
ESTIMATED = "Proportions are estimated with {} cameras."
MIRRORED = " The mirror image in depth fits the images as well."
# Numbers of the specification: types of components, uses of bytes, kinds of primitives.
FLOATS, INTEGERS = 5126, 5125
VERTICES, INDICES = 34962, 34963
POINTS, LINES, TRIANGLES = 0, 1, 4


class ViewerPage(str):
    """The page that was written, which a notebook shows."""

    __slots__ = ()

    def __repr__(self) -> str:
        """Return that this is a page, and its size."""
        return f"<page of {len(self):,} characters>"

    def _repr_html_(self) -> str:
        """Return the page in a frame."""
        frame = 'width="100%" height="520" style="border: 0"'
        return f'<iframe srcdoc="{escape(self)}" {frame}></iframe>'


def write_viewer(
    model: Any,
    path: str | os.PathLike[str],
    *,
    X: Any = None,
    point_weight: ArrayLike | None = None,
    labels: ArrayLike | None = None,
    times: ArrayLike | None = None,
    depth_std: ArrayLike | None = None,
    n_frames: int = 1000,
    edges: Edges = "auto",
    names: Sequence[str] | None = None,
    camera: _upright.Camera = "weak_perspective",
    origin: Origin = "auto",
) -> ViewerPage:
    """
    Write a page that shows a shape model in any browser, and in a notebook.

    The page is one file that needs no network and no other program. It shows the mean
    shape in 3D, turned by 20 degrees at first, with a slider for each basis shape. It
    plays the frames of a table, with or without their cameras. In a scatter plot of two
    coefficients, click on a frame to show it.

    Parameters
    ----------
    model : AffineNRSfM
        A fitted model that has kept its frames.
    path : str or path-like
        The file, with the suffix ``.html``. An existing file is replaced.
    X : array-like of shape (n_rows, 2 * n_points), default=None
        The table whose frames are shown; by default the fitted table. Frames are named
        by their number, from 0, or by the index of a pandas DataFrame.
    point_weight : array-like of shape (n_rows, n_points), default=None
        Weights of the points of `X`, as in ``model.fit``.
    labels : array-like of shape (n_rows,), default=None
        Labels of the rows of the table, text or numbers, at most 30 different ones.
        They determine the colours of frames. Rows with None or NaN have no label.
    times : array-like of shape (n_rows,), default=None
        Seconds at which the rows were taken, or dates. The page plays them at true
        speed; a row that is not later than the one before follows after the median
        time between rows.
    depth_std : array-like of shape (n_rows, n_points) or (n_points,), default=None
        Standard deviations of the depths, for a model with calibrated cameras, as of
        ``reconstruct(X, return_std=True)``. Points get error bars along the viewing
        direction of their frame. NaN is no bar. Deviations (n_points,) are those of all
        rows.
    n_frames : int, default=1000
        Maximum number of frames of the page, spread evenly over the table.
    edges : "auto", Skeleton, str, None or array-like, default="auto"
        Lines to draw: a layout of `isa_nrsfm.skeletons` or its name, or pairs of
        points (n_edges, 2). "auto" recognises a known layout by the names or by the
        number and order of the points. A layout has separate colours for left and
        right. Up to 400 points without a known one are joined by a minimal spanning
        tree: of all trees the one with the shortest lines, by the distances in the
        images.
    names : sequence of str of length n_components, default=None
        Names of the basis shapes; by default alpha_1, alpha_2, ...
    camera : {"weak_perspective", None}, default="weak_perspective"
        Camera model for a model with affine cameras. "weak_perspective"
        shows Euclidean shapes, None affine ones, which look like those of figures. A
        model with calibrated cameras has Euclidean shapes. If their depth is not
        determined, the page has a note, and None avoids the warning.
    origin : {"auto", "upper", "lower"}, default="auto"
        Where y is zero in the table: "upper" for images, whose y points down, "lower"
        for a y that points up. "auto" is "lower" if a face or a body would otherwise be
        upside down.

    Returns
    -------
    ViewerPage
        The page as text. A notebook shows it.

    Raises
    ------
    ValueError
        If the model has kept no frames, if the cameras see fewer than three directions
        of space, if there is not one label per row, if deviations are negative or
        those of affine cameras, or if a parameter is not of the kind given above.
    OSError
        If the file cannot be written.

    Warns
    -----
    UserWarning
        If the cameras turn too little to determine the metric.

    See Also
    --------
    write_glb : A file for programs that show and animate 3D shapes.

    Notes
    -----
    Euclidean basis shapes of affine cameras are the least squares fit to the shapes of
    the frames; those of calibrated cameras are the model's. Rows with too few visible
    points are not shown; the page gives their number.
    """
    _upright.suffix_of(path, [".html", ".htm"])
    if not isinstance(cast(Any, n_frames), Integral) or n_frames < 0:
        raise ValueError(
            f"n_frames must be a whole number of at least 0; got {n_frames!r}"
        )
    space = _upright.upright_space(model, camera, origin, edges)
    components = names_of_components(names, len(model.basis_))
    n_rows = len(model.alpha_) if X is None else number_of_rows(X)
    codes, categories = _codes(labels, n_rows)
    deviations = _deviations(depth_std, n_rows, model)
    # The first and the last row are among those shown.
    rows = np.linspace(0, max(n_rows - 1, 0), min(n_rows, n_frames)).astype(np.intp)
    if X is None or not len(rows):
        motion, alpha = (part[rows] for part in space.decompose(None))
    else:
        weights = None if point_weight is None else taken_rows(point_weight, rows)
        motion, alpha = space.decompose(taken_rows(X, rows), weights)
    motion, alpha = np.asarray(motion), np.asarray(alpha)
    finite = np.isfinite(alpha).all(axis=1)
    rows, motion, alpha = rows[finite], motion[finite], alpha[finite]
    seconds = np.empty(0) if times is None else _seconds(times, n_rows)[rows]

    shapes = space.viewed_shapes()
    lines = space.lines
    size = np.linalg.norm(shapes[0], axis=1).max()
    rotations = np.empty((0, 3, 3))
    if space.camera is not None and len(motion):
        rotations = space.frames(motion, alpha).rotations
        rotations = UPSIDE_DOWN @ rotations @ UPSIDE_DOWN
    labelled = hasattr(X, "iloc")  # pandas: rows have names
    kind = space.camera if frames_of(model).certainty.determined else "unknown"
    about = ABOUT.get(kind, ESTIMATED.format(str(kind).replace("_", "-")))
    about += MIRRORED * (not sees_perspective(model))
    if lines is not None and lines.name == SPANNING_TREE:
        about += f" Points without a known layout are joined by a {SPANNING_TREE}."
    content = {
        "about": about,
        "points": list(names_of_points(model)),
        "components": components,
        "categories": categories,
        "rows": [str(name) for name in (X.index[rows] if labelled else rows)],
        "labels": codes[rows].tolist() if categories else [],
        "count": _count(n_rows, len(finite), len(rows)),
        "shapes": _encoded(shapes / size, "<f4"),
        "edges": _encoded(np.empty(0) if lines is None else lines.edges, "<u4"),
        "sides": lines.sides.tolist() if lines is not None and lines.left else [],
        "alpha": _encoded(alpha, "<f4"),
        "rotations": _encoded(rotations, "<f4"),
        "deviations": _encoded(deviations[rows] / size, "<f4"),
        "times": _encoded(seconds - seconds[:1], "<f8"),
    }
    page = ViewerPage(_page(content))
    write_whole(path, page.encode("utf-8"))
    return page


def _seconds(times: ArrayLike, n_rows: int) -> NDArray:
    """Return increasing seconds of rows (n_rows,)."""
    steps = np.diff(checked_times(times, n_rows))
    later = steps > 0
    typical = np.median(steps[later]) if later.any() else 1.0
    return np.cumsum(np.insert(np.where(later, steps, typical), 0, 0.0))


def _deviations(values: Any, n_rows: int, model: Any) -> NDArray:
    """Return deviations of depths (n_rows, n_points), or (n_rows, 0) for None."""
    if values is None:
        return np.empty((n_rows, 0))
    if model.camera_ == "affine":
        raise ValueError(
            "depth_std needs a model with calibrated cameras; this one was fitted with "
            'camera="affine"'
        )
    checks = {"ensure_2d": False, "ensure_all_finite": "allow-nan"}
    found = check_array(values, dtype=np.float64, input_name="depth_std", **checks)
    shape = (n_rows, len(model.mean_shape_))
    if found.shape not in (shape, shape[1:]):
        raise ValueError(
            f"depth_std must have shape {shape} or {shape[1:]}; got {found.shape}"
        )
    if (found < 0).any():
        raise ValueError(
            f"depth_std must not be negative; its least value is {np.nanmin(found):.3g}"
        )
    return np.broadcast_to(found, shape)


def _resource(name: str) -> str:
    """Return the text of a file beside this module."""
    return (files("isa_nrsfm.export") / name).read_text(encoding="utf-8")


def _page(content: dict[str, Any]) -> str:
    """Return the page with a content."""
    page, script = map(_resource, ("viewer.html", "viewer.js"))
    digest = base64.b64encode(hashlib.sha256(script.encode()).digest()).decode()
    # Escape data that would end its HTML element.
    data = json.dumps(content, separators=(",", ":"), allow_nan=False)
    data = data.replace("<", "\\u003c")
    page = page.replace("{{script-hash}}", f"sha256-{digest}", 1)
    page = page.replace("{{script}}", script, 1)
    return page.replace("{{model}}", data, 1)


def _encoded(array: NDArray, dtype: str) -> str:
    """Return the numbers of an array as text."""
    return base64.b64encode(array.astype(dtype).tobytes()).decode()


def _count(n_rows: int, n_chosen: int, n_shown: int) -> str:
    """Return a text with the number of frames on the page."""
    text = f"{n_chosen} of {n_rows} rows, evenly spread"
    if n_chosen == n_rows:
        text = f"{n_rows} rows"
    if n_shown < n_chosen:
        text += f"; {n_chosen - n_shown} of them show too few points"
    return text + "."


def _codes(labels: Any, n_rows: int) -> tuple[NDArray[np.intp], list[str]]:
    """Return the number of the label of each row, and the labels."""
    if labels is None:
        return np.zeros(n_rows, dtype=np.intp), []
    values = np.asarray(labels)
    if values.shape != (n_rows,):
        raise ValueError(
            f"labels must hold {n_rows} labels, one per row; got shape {values.shape}"
        )
    keys: list[tuple[Any, ...]] = []  # numbers first, those without a label last
    for value in values.tolist():
        kind = 2 if is_missing(value) else int(not isinstance(value, Real))
        text = "(no label)" if kind == 2 else str(value)
        keys.append((kind, 0 if kind else value, text))
    found = sorted(set(keys))
    if len(found) > MOST_LABELS:
        raise ValueError(
            f"labels must have at most {MOST_LABELS} different values; got {len(found)}"
        )
    return np.array([*map(found.index, keys)], dtype=np.intp), [k[-1] for k in found]


def write_glb(
    model: Any,
    path: str | os.PathLike[str],
    *,
    edges: Edges = "auto",
    names: Sequence[str] | None = None,
    camera: _upright.Camera = "weak_perspective",
    origin: Origin = "auto",
) -> None:
    """
    Write the mean shape with the basis shapes as morph targets to a glTF 2.0 file.

    The weight of a morph target is the coefficient: with the weights ``alpha_[i]`` the
    shape is that of frame i. An animation plays the morph targets one after the other.

    Parameters
    ----------
    model : AffineNRSfM
        A fitted model that has kept its frames.
    path : str or path-like
        The file, with the suffix ``.glb``. An existing file is replaced.
    edges : "auto", Skeleton, str, None or array-like, default="auto"
        Parts to draw in addition to the points: a layout of `isa_nrsfm.skeletons` or
        its name; pairs of points (n_edges, 2); or None for nothing. "auto" recognises
        the layout of hands and bodies by the names or the number and order of the
        points. Otherwise it is a surface of the Delaunay triangles of the front view,
        with the layout of a face drawn on it, or the tree of `write_viewer`. More than
        400 points of a surface are not drawn as points.
    names : sequence of str of length n_components, default=None
        Names of the morph targets; by default alpha_1, alpha_2, ...
    camera : {"weak_perspective", None}, default="weak_perspective"
        Camera model for a model with affine cameras. "weak_perspective"
        writes Euclidean shapes, None affine ones, which look like those of figures. A
        model with calibrated cameras has Euclidean shapes.
    origin : {"auto", "upper", "lower"}, default="auto"
        Where y is zero in the table: "upper" for images, whose y points down, "lower"
        for a y that points up. "auto" is "lower" if a face or a body would otherwise be
        upside down.

    Raises
    ------
    ValueError
        If the model has kept no frames, if the cameras see fewer than three directions
        of space, if a parameter is not of the kind given above, or the points have no
        triangles in the front view.
    OSError
        If the file cannot be written.

    Warns
    -----
    UserWarning
        If the cameras turn too little to determine the metric.

    See Also
    --------
    write_viewer : A page for a browser.

    Notes
    -----
    As required by glTF, y points up and z to the viewer. The true size is unknown, so
    the largest extent of the mean shape is one unit. ``extras`` of the mesh has the
    names of the points and of the lines, and the scale factor of the shapes. Euclidean
    basis shapes of affine cameras are the least squares fit to the shapes of the
    frames; those of calibrated cameras are the model's.
    """
    _upright.suffix_of(path, [".glb"])
    space = _upright.upright_space(model, camera, origin, edges)
    targets = names_of_components(names, len(model.basis_))
    shapes = space.viewed_shapes()
    factor = 1 / np.ptp(shapes[0], axis=0).max()
    shapes = factor * shapes
    lines, surface = space.lines, None
    if isinstance(edges, str) and edges == "auto":
        if lines is None or lines.kind in ("face", "other"):
            surface = frontal_triangles(shapes[0])

    # One node and mesh, matt materials that are seen from both sides, one animation
    document, file = json.loads(_resource("scene.gltf")), Binary()
    document["asset"]["generator"] = f"isa_nrsfm {__version__}"
    (mesh,), (animation,) = document["meshes"], document["animations"]
    mesh["primitives"] = _primitives(file, shapes, surface, lines)
    mesh["weights"] = [0.0] * len(targets)
    mesh["extras"] = {
        "targetNames": targets,
        "pointNames": list(names_of_points(model)),
        "lines": None if lines is None else lines.name,
        "factor": factor,
    }
    times, weights = map(file.add, _swings(len(targets)))
    animation["samplers"][0] |= {"input": times, "output": weights}
    write_whole(path, file.with_document(document))


class Binary:
    """The arrays of a glTF file, one after the other, and their description."""

    def __init__(self) -> None:
        self.arrays = b""
        self.views: list[dict[str, Any]] = []
        self.accessors: list[dict[str, Any]] = []

    def add(self, array: NDArray) -> int:
        """Add numbers (n,), vectors (n, 3) or indices (n,); return their number."""
        is_index, is_vertex = array.dtype.kind in "iu", array.ndim == 2
        array = array.astype("<u4" if is_index else "<f4")
        rows = array.reshape(len(array), -1)
        accessor = {
            "bufferView": len(self.views),
            "componentType": INTEGERS if is_index else FLOATS,
            "count": len(array),
            "type": "VEC3" if is_vertex else "SCALAR",
            "min": rows.min(axis=0).tolist(),
            "max": rows.max(axis=0).tolist(),
        }
        view = {"buffer": 0, "byteOffset": len(self.arrays), "byteLength": array.nbytes}
        if is_index or is_vertex:
            view["target"] = INDICES if is_index else VERTICES
        self.views.append(view)
        self.accessors.append(accessor)
        self.arrays += _padded(array.tobytes(), b"\0")
        return len(self.accessors) - 1

    def with_document(self, document: dict[str, Any]) -> bytes:
        """Return the file: header, the document that refers to the arrays, arrays."""
        document = document | {
            "accessors": self.accessors,
            "bufferViews": self.views,
            "buffers": [{"byteLength": len(self.arrays)}],
        }
        text = json.dumps(document, separators=(",", ":"), allow_nan=False)
        chunks = b""
        for kind, content in ((b"JSON", text.encode()), (b"BIN\0", self.arrays)):
            content = _padded(content, b" ")
            chunks += struct.pack("<I4s", len(content), kind) + content
        return struct.pack("<4sII", b"glTF", 2, 12 + len(chunks)) + chunks


def _padded(content: bytes, filler: bytes) -> bytes:
    """Return bytes whose number is a multiple of four."""
    return content + filler * (-len(content) % 4)


def _primitives(
    file: Binary, shapes: NDArray, surface: NDArray | None, lines: Skeleton | None
) -> list[dict[str, Any]]:
    """Return a surface, the points, unless there are many on it, and the edges."""
    position, *drifts = map(file.add, shapes)
    bare: dict[str, Any] = {
        "attributes": {"POSITION": position},
        "targets": [{"POSITION": drift} for drift in drifts],
        "material": 0,
    }
    primitives = []
    if surface is None or not _views.is_dense(shapes[0]):
        primitives.append(bare | {"mode": POINTS})
    if surface is not None:
        indices = file.add(surface.ravel())
        primitives.append(bare | {"mode": TRIANGLES, "indices": indices, "material": 1})
    if lines is not None and len(lines.edges):
        indices = file.add(lines.edges.ravel())
        primitives.append(bare | {"mode": LINES, "indices": indices})
    return primitives


def _swings(n_components: int) -> tuple[NDArray, NDArray]:
    """Return times (n,) and weights (n * n_components,) of swings one after another."""
    phase = np.linspace(0, 1, 17)[1:]
    swing = 2.0 * np.sin(2 * np.pi * phase)  # standard deviations
    # Weights are exactly zero at the start of the next swing.
    swing[-1] = 0.0
    weights = np.kron(np.eye(n_components), swing[:, None])
    times = np.add.outer(np.arange(n_components), phase)
    # From rest on, two seconds each
    return 2.0 * np.insert(times, 0, 0.0), np.pad(weights, ((1, 0), (0, 0))).ravel()


def frontal_triangles(shape: NDArray) -> NDArray[np.intp]:
    """Return the Delaunay triangles (n, 3) of the front view of a shape (J, 3)."""
    try:
        return Delaunay(shape[:, :2]).simplices.astype(np.intp)
    except QhullError as error:
        raise ValueError(
            "the points are on one line in the front view and have no triangles there; "
            "set edges, or edges=None to draw only points"
        ) from error
