"""Basis shapes as morph targets of a glTF 2.0 file."""

import json
import os
import struct
from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from isa_nrsfm import __version__
from isa_nrsfm._compat.whole_files import write_whole
from isa_nrsfm.export._drawing import (
    Links,
    choose_drawing,
    frontal_triangles,
    vertex_normals,
)
from isa_nrsfm.export._names import names_of_components, suffix_of
from isa_nrsfm.export._upright import Camera, upright_basis, upright_space
from isa_nrsfm.plotting._axes import is_dense
from isa_nrsfm.plotting._views import UPSIDE_DOWN, Origin
from isa_nrsfm.skeletons._column_names import names_of_points
from isa_nrsfm.skeletons._skeleton import LEFT, MIDDLE, RIGHT, sides_of_edges

# Numbers of the specification: types of components, uses of bytes, kinds of primitives.
FLOATS, SHORTS, INTEGERS = 5126, 5123, 5125
VERTICES, INDICES = 34962, 34963
POINTS, LINES, TRIANGLES = 0, 1, 4
# Matt materials, seen from both sides: for points and edges in the middle, on the left
# and on the right, and for surfaces.
SURFACE = 3
MATT = {"metallicFactor": 0.0, "roughnessFactor": 0.8}
MATERIALS = [
    {
        "name": name,
        "doubleSided": True,
        "pbrMetallicRoughness": {"baseColorFactor": [*colour, 1.0]} | MATT,
    }
    for name, colour in (
        ("points and edges", (0.05, 0.12, 0.25)),
        ("left", (0.0, 0.342, 0.171)),
        ("right", (0.604, 0.191, 0.386)),
        ("surface", (0.80, 0.66, 0.55)),
    )
]


def write_glb(
    model: Any,
    path: str | os.PathLike[str],
    *,
    edges: Links = "auto",
    names: Sequence[str] | None = None,
    camera: Camera = "weak_perspective",
    origin: Origin = "auto",
    mirrored: bool = False,
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
        its name, with left and right as separate primitives and colours; integers of
        shape (n_edges, 2), pairs of points to be joined; or (n_triangles, 3), the
        triangles of a surface, counter-clockwise as seen from outside; or None for
        nothing. "auto" recognises the layout of hands and bodies by the names or the
        number and order of the points. Otherwise it is a surface of the Delaunay
        triangles of the front view, with the layout of a face drawn on it. More than
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
    mirrored : bool, default=False
        Whether to take the mirror image in depth, which fits the table equally well. By
        default, faces and bodies of known layouts have the right depth.

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
    names of the points and the scale factor of the shapes. Euclidean basis shapes of
    affine cameras are the least squares fit to the shapes of the frames; those of
    calibrated cameras are the model's.
    """
    suffix_of(path, [".glb"])
    space = upright_space(model, camera, origin, mirrored, edges)
    targets = names_of_components(names, len(model.basis_))
    mean, basis = upright_basis(space, model)
    mean = (mean - mean.mean(axis=0)) @ UPSIDE_DOWN
    factor = 1 / np.ptp(mean, axis=0).max()
    mean, basis = factor * mean, factor * (basis @ UPSIDE_DOWN)
    links, sides = choose_drawing(edges, space.layout, len(mean))
    surface, is_face = None, space.layout is None or space.layout.kind == "face"
    if links.shape[1] == 3:
        surface, links = links, np.empty((0, 2), np.intp)
    elif isinstance(edges, str) and edges == "auto" and is_face:
        surface = frontal_triangles(mean)
    of_links = sides_of_edges(sides, links)
    drawn_edges = [links[of_links == side] for side in (MIDDLE, LEFT, RIGHT)]

    file = Binary()
    primitives = _primitives(file, mean, basis, surface, drawn_edges)
    used = sorted({part["material"] for part in primitives})
    for part in primitives:
        part["material"] = used.index(part["material"])
    extras = {"targetNames": targets, "pointNames": list(names_of_points(model))}
    mesh = {
        "name": "mean shape",
        "primitives": primitives,
        "weights": [0.0] * len(targets),
        "extras": extras | {"factor": factor},
    }
    times, weights = _swings(len(targets))
    sampler = {"input": file.add(times, bounds=True), "interpolation": "LINEAR"}
    animation = {
        "name": "basis shapes in turn",
        "samplers": [sampler | {"output": file.add(weights.ravel())}],
        "channels": [{"sampler": 0, "target": {"node": 0, "path": "weights"}}],
    }
    document = {
        "asset": {"version": "2.0", "generator": f"isa_nrsfm {__version__}"},
        "scene": 0,
        "scenes": [{"nodes": [0]}],
        "nodes": [{"name": "shape", "mesh": 0}],
        "meshes": [mesh],
        "materials": [MATERIALS[material] for material in used],
        "animations": [animation],
    }
    write_whole(path, file.with_document(document))


class Binary:
    """The arrays of a glTF file, one after the other, and their description."""

    def __init__(self) -> None:
        self.arrays = b""
        self.views: list[dict[str, Any]] = []
        self.accessors: list[dict[str, Any]] = []

    def add(
        self, array: NDArray, use: int | None = None, *, bounds: bool = False
    ) -> int:
        """Add numbers (n,) or vectors (n, 3), integers as indices; return their number.

        The use of the bytes is VERTICES or INDICES; bounds add minimum and maximum.
        """
        kind, dtype = FLOATS, "<f4"
        if array.dtype.kind in "iu":
            # For short integers the index 65535 is reserved.
            short = array.max(initial=0) < 65535
            kind, dtype = (SHORTS, "<u2") if short else (INTEGERS, "<u4")
        array = array.astype(dtype)
        accessor = {
            "bufferView": len(self.views),
            "componentType": kind,
            "count": len(array),
            "type": "SCALAR" if array.ndim == 1 else "VEC3",
        }
        if bounds:
            rows = array.reshape(len(array), -1).astype(float)
            accessor |= {"min": rows.min(axis=0).tolist()}
            accessor |= {"max": rows.max(axis=0).tolist()}
        view = {"buffer": 0, "byteOffset": len(self.arrays), "byteLength": array.nbytes}
        self.views.append(view | ({} if use is None else {"target": use}))
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
    file: Binary,
    mean: NDArray,
    basis: NDArray,
    surface: NDArray | None,
    drawn_edges: list[NDArray],
) -> list[dict[str, Any]]:
    """Return a surface, the points, unless there are many on it, and the edges."""
    position, *drifts = (file.add(x, VERTICES, bounds=True) for x in (mean, *basis))
    bare: dict[str, Any] = {
        "attributes": {"POSITION": position},
        "targets": [{"POSITION": drift} for drift in drifts],
        "material": MIDDLE,
    }
    primitives = []
    if surface is not None:
        indices = file.add(surface.ravel(), INDICES)
        normals = vertex_normals(mean, surface)
        # Viewers add normals with the weights: store their change by one standard
        # deviation.
        turns = [vertex_normals(mean + drift, surface) - normals for drift in basis]
        numbers = [file.add(normal, VERTICES) for normal in (normals, *turns)]
        parts = zip([bare["attributes"], *bare["targets"]], numbers, strict=True)
        first, *others = (part | {"NORMAL": number} for part, number in parts)
        shaded = {"attributes": first, "targets": others, "material": SURFACE}
        primitives.append(shaded | {"mode": TRIANGLES, "indices": indices})
    if surface is None or not is_dense(mean):
        primitives.append(bare | {"mode": POINTS})
    for side, edges in enumerate(drawn_edges):
        if len(edges):
            indices = file.add(edges.ravel(), INDICES)
            lines = {"mode": LINES, "indices": indices, "material": side}
            primitives.append(bare | lines)
    return primitives


def _swings(n_components: int) -> tuple[NDArray, NDArray]:
    """Return times (n,) and weights (n, n_components) of swings one after the other."""
    phase = np.linspace(0, 1, 17)[1:]
    swing = 2.0 * np.sin(2 * np.pi * phase)  # standard deviations
    # Weights are exactly zero at the start of the next swing.
    swing[-1] = 0.0
    weights = np.kron(np.eye(n_components), swing[:, None])
    times = np.add.outer(np.arange(n_components), phase)
    # From rest on, two seconds each
    return 2.0 * np.insert(times, 0, 0.0), np.pad(weights, ((1, 0), (0, 0)))
