"""A self-contained page that shows a shape model in any browser."""

import base64
import hashlib
import json
import os
from collections.abc import Sequence
from importlib.resources import files
from numbers import Integral, Real
from typing import Any, cast

import numpy as np
from numpy.typing import ArrayLike, NDArray
from sklearn.utils import check_array

from isa_nrsfm._compat.scikit_learn import number_of_rows, taken_rows
from isa_nrsfm._compat.whole_files import write_whole
from isa_nrsfm._estimator import frames_of
from isa_nrsfm.analysis._frame_columns import checked_times, is_missing
from isa_nrsfm.export._drawing import Links, choose_drawing, edges_of
from isa_nrsfm.export._names import frames_of_table, names_of_components, suffix_of
from isa_nrsfm.export._upright import (
    Camera,
    upright_basis,
    upright_frames,
    upright_space,
)
from isa_nrsfm.plotting._views import UPSIDE_DOWN, Origin
from isa_nrsfm.skeletons._column_names import names_of_points

# The colours of more labels than this look alike.
MOST_LABELS = 30
UNLABELLED = "(no label)"
ABOUT = {
    "weak_perspective": "Proportions are estimated with weak-perspective cameras.",
    "orthographic": "Proportions are estimated with orthographic cameras.",
    None: "Affine shapes: angles and depth are not those of the object.",
    "unknown": "The depth is not determined: angles and proportions are not those of "
    "the object.",
}


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
    edges: Links = "auto",
    names: Sequence[str] | None = None,
    camera: Camera = "weak_perspective",
    origin: Origin = "auto",
    mirrored: bool = False,
) -> None:
    """
    Write a page that shows a shape model in any browser.

    The page is one file that needs no network and no other program. It shows the mean
    shape in 3D with a slider for each basis shape. It plays the frames of a table, with
    or without their cameras. In a scatter plot of two coefficients, click on a frame to
    show it.

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
        Lines to draw: a layout of `isa_nrsfm.skeletons` or its name, pairs of points
        (n_edges, 2), or triangles (n_triangles, 3), whose sides are drawn. "auto"
        recognises a known layout by the names or by the number and order of the points.
        A layout has separate colours for left and right.
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
    mirrored : bool, default=False
        Whether to take the mirror image in depth, which fits the table equally well.
        The page has a switch for it.

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
    suffix_of(path, [".html", ".htm"])
    if not isinstance(cast(Any, n_frames), Integral) or n_frames < 0:
        raise ValueError(
            f"n_frames must be a whole number of at least 0; got {n_frames!r}"
        )
    space = upright_space(model, camera, origin, mirrored, edges)
    components = names_of_components(names, len(model.basis_))
    n_rows = len(model.alpha_) if X is None else number_of_rows(X)
    codes, categories = _codes(labels, n_rows)
    deviations = _deviations(depth_std, n_rows, model)
    # The first and the last row are among those shown.
    rows = np.linspace(0, max(n_rows - 1, 0), min(n_rows, n_frames)).astype(np.intp)
    if X is None or not len(rows):
        motion, alpha = model.motion_[rows], model.alpha_[rows]
    else:
        weights = None if point_weight is None else taken_rows(point_weight, rows)
        motion, alpha = frames_of_table(model, taken_rows(X, rows), weights)
    motion, alpha = np.asarray(motion), np.asarray(alpha)
    seen = np.isfinite(alpha).all(axis=1)
    rows, motion, alpha = rows[seen], motion[seen], alpha[seen]
    seconds = np.empty(0) if times is None else _seconds(times, n_rows)[rows]

    mean, basis = upright_basis(space, model)
    links, sides = choose_drawing(edges, space.layout, len(mean))
    shapes = np.stack([mean - mean.mean(axis=0), *basis]) @ UPSIDE_DOWN
    size = np.linalg.norm(shapes[0], axis=1).max()
    rotations = np.empty((0, 3, 3))
    if space.camera is not None and len(motion):
        rotations = upright_frames(space, model, motion, alpha).rotations
        rotations = UPSIDE_DOWN @ rotations @ UPSIDE_DOWN
    labelled = hasattr(X, "iloc")  # pandas: rows have names
    known = space.camera if frames_of(model).certainty.determined else "unknown"
    content = {
        "about": ABOUT[known] + " The mirror image in depth fits the images as well.",
        "points": list(names_of_points(model)),
        "components": components,
        "categories": categories,
        "rows": [str(name) for name in (X.index[rows] if labelled else rows)],
        "labels": codes[rows].tolist() if categories else [],
        "count": _count(n_rows, len(seen), len(rows)),
        "shapes": _encoded(shapes / size, "<f4"),
        "edges": _encoded(edges_of(links), "<u4"),
        "sides": sides.tolist() if sides.any() else [],
        "alpha": _encoded(alpha, "<f4"),
        "rotations": _encoded(rotations, "<f4"),
        "deviations": _encoded(deviations[rows] / size, "<f4"),
        "times": _encoded(seconds - seconds[:1], "<f8"),
    }
    write_whole(path, _page(content).encode("utf-8"))


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


def _page(content: dict[str, Any]) -> str:
    """Return the page with a content."""
    page, script = (
        (files("isa_nrsfm.export") / name).read_text(encoding="utf-8")
        for name in ("viewer.html", "viewer.js")
    )
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
    texts, order = [], {}
    for value in values.tolist():
        missing = is_missing(value)
        text = UNLABELLED if missing else str(value)
        number = isinstance(value, Real)
        order[text] = (missing, not number, value if number else 0, text)
        texts.append(text)
    categories = sorted(order, key=order.__getitem__)
    if len(categories) > MOST_LABELS:
        raise ValueError(
            f"labels must have at most {MOST_LABELS} different values; got "
            f"{len(categories)}"
        )
    return np.array([*map(categories.index, texts)], dtype=np.intp), categories
