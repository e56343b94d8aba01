"""Points of frames in space, with standard deviations, and their files."""

import io
import os
from collections.abc import Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.io import netcdf_file
from sklearn.utils.validation import check_is_fitted

from isa_nrsfm._compat import pandas as pd
from isa_nrsfm._compat.caller import warn_caller
from isa_nrsfm._compat.files import files_together
from isa_nrsfm._compat.lazy import import_optional
from isa_nrsfm._estimator import check_class
from isa_nrsfm._fitted_model import frames_of, points_in_space
from isa_nrsfm.analysis._advice import depth_advice, facts_of
from isa_nrsfm.export._names import suffix_of
from isa_nrsfm.skeletons._column_names import names_of_points

SUFFIXES = (".nc", ".h5", ".csv", ".trc")
_SCORER, _KEY = "isa_nrsfm_3d", "df_with_missing"
_TRC = "DataRate CameraRate NumFrames NumMarkers Units OrigDataRate OrigDataStartFrame"


class FramePoints(NamedTuple):
    """
    Points of frames in the axes of their camera; NaN where a frame has no camera.

    Attributes
    ----------
    position : ndarray of shape (n_frames, n_points, 3)
        x and y are places in the table, in its units, also of missing points. z is the
        depth from the origin of the shape, away from the viewer, in the same units; NaN
        where the table does not determine it.
    position_std : ndarray of shape (n_frames, n_points, 3)
        Their standard deviations, with the errors of camera, coefficients and shapes.
    determined : ndarray of bool, shape (n_frames, n_points)
        Whether the depth is determined.
    """

    position: NDArray
    position_std: NDArray
    determined: NDArray


def frame_points(model: Any, X: Any, *, point_weight: Any = None) -> FramePoints:
    """
    Return the points of frames in space, and their standard deviations.

    Parameters
    ----------
    model : AffineNRSfM
        A model with calibrated cameras and the joint refinement.
    X : array-like of shape (n_frames, 2 * n_points)
        A table with the points of the fitted one.
    point_weight : array-like of shape (n_frames, n_points), default=None
        Weights of the points, as in ``model.fit``.

    Returns
    -------
    FramePoints
        Named tuple of position, position_std and determined.

    Raises
    ------
    ValueError
        If the model has affine cameras, or was not refined jointly.

    Warns
    -----
    UserWarning
        If the fitted table does not determine the depth: z is NaN.

    Notes
    -----
    The deviations are of one frame: errors of its points depend on each other, and
    those of the shapes are common to all frames. The sign of z is a convention unless
    `mirror_certainty_` is known. Cameras of perspective have the object in true
    proportions, in units of the table at its distance.

    Examples
    --------
    >>> from isa_nrsfm import AffineNRSfM
    >>> from isa_nrsfm.datasets import make_face_tracks
    >>> from isa_nrsfm.export import frame_points
    >>> options = {"camera": "weak_perspective", "random_state": 0}
    >>> faces = make_face_tracks(40, n_components=1, **options)
    >>> model = AffineNRSfM(1, **options).fit(faces.data)
    >>> points = frame_points(model, faces.data)
    >>> points.position.shape, points.position_std.shape, points.determined.all()
    ((40, 68, 3), (40, 68, 3), np.True_)
    """
    check_class(model, "model")
    check_is_fitted(model)
    position, std = map(np.array, points_in_space(model, X, point_weight))
    if not frames_of(model).certainty.determined:
        warn_caller(depth_advice(facts_of(model)))
        position[..., 2] = std[..., 2] = np.nan
    return FramePoints(position, std, np.isfinite(position[..., 2]))


def write_points(
    model: Any,
    path: str | os.PathLike[str],
    X: Any,
    *,
    point_weight: Any = None,
    fps: float | None = None,
) -> None:
    """
    Write points in space with standard deviations for programs of movement analysis.

    Parameters
    ----------
    model : AffineNRSfM
        A model with calibrated cameras and the joint refinement.
    path : str or path-like
        The file. ``.nc`` is a dataset of movement in netCDF, ``.h5`` and ``.csv`` are
        files of DeepLabCut in 3D, ``.trc`` is one of OpenSim. Existing files are
        replaced.
    X : array-like of shape (n_frames, 2 * n_points)
        A table with the points of the fitted one, of one individual.
    point_weight : array-like of shape (n_frames, n_points), default=None
        Weights of the points, as in ``model.fit``.
    fps : float, default=None
        Frames per second, which ``.trc`` needs. None for times in frames.

    Raises
    ------
    ValueError
        If the suffix is another one, if `fps` is not positive or is needed, or for the
        reasons of `frame_points`.
    OSError
        If a file cannot be written.

    See Also
    --------
    frame_points : The points, and what their deviations mean.

    Notes
    -----
    The dataset has the variables position, position_std and determined. Its axes are
    named as in movement from version 0.17 on, keypoint and individual. The other
    formats have no place for deviations: a second file of the same layout, with
    ``_std`` at the end of its name, has them; empty cells, in ``.trc`` nan, are not
    determined.
    """
    suffix, path = suffix_of(path, SUFFIXES), Path(path)
    if fps is None and suffix == ".trc":
        raise ValueError("fps, the frames per second, is needed for .trc files")
    if fps is not None and not 0 < fps < np.inf:
        raise ValueError(f"fps must be a number above zero; got {fps!r}")
    points = frame_points(model, X, point_weight=point_weight)
    names = names_of_points(model)
    with files_together(path.parent) as folder:
        if suffix == ".nc":
            sign = np.float64(getattr(model, "mirror_certainty_", np.nan))
            (folder / path.name).write_bytes(_netcdf(points, names, fps, sign))
            return
        deviations = folder / f"{path.stem}_std{path.suffix}"
        if suffix == ".trc":
            _write_trc(folder / path.name, points.position, names, fps)
            _write_trc(deviations, points.position_std, names, fps)
            return
        flag = points.determined[..., None].astype(float)
        std = np.concatenate([points.position_std, flag], axis=2)
        _write_deeplabcut(folder / path.name, points.position, names, ("x", "y", "z"))
        _write_deeplabcut(deviations, std, names, ("x", "y", "z", "determined"))


def _netcdf(
    points: FramePoints, names: Sequence[str], fps: float | None, sign: float
) -> bytes:
    """Return a dataset of movement, as classic netCDF."""
    content, n_frames = io.BytesIO(), len(points.position)
    file = netcdf_file(content, "w", version=2)
    times = np.arange(n_frames) / (fps or 1.0)
    texts = {"space": "xyz", "keypoint": names, "individual": ["individual_0"]}
    file.createDimension("time", n_frames)
    file.createVariable("time", "f8", ("time",))[:] = times
    for name, words in texts.items():
        letters = np.array([word.encode() for word in words], dtype="S")
        size = letters.dtype.itemsize
        file.createDimension(name, len(words))
        file.createDimension(f"{name}_letters", size)
        axis = file.createVariable(name, "c", (name, f"{name}_letters"))
        axis[:] = letters.view("S1").reshape(len(words), size)
        setattr(axis, "_Encoding", "utf-8")  # noqa: B010
    axes = ("time", "space", "keypoint", "individual")
    for name in ("position", "position_std"):
        values = getattr(points, name).swapaxes(1, 2)[..., None]
        file.createVariable(name, "f8", axes)[:] = values
    for name, kind in (("confidence", "f4"), ("determined", "i1")):
        values = points.determined if kind == "i1" else np.nan * points.determined
        file.createVariable(name, kind, axes[:1] + axes[2:])[:] = values[..., None]
    file.variables["determined"].dtype = "bool"
    attributes = {"source_software": "isa_nrsfm", "ds_type": "poses", "fps": fps}
    attributes |= {
        "time_unit": "seconds" if fps else "frames",
        "mirror_certainty": sign,
    }
    for name, value in attributes.items():
        if value is not None:
            setattr(file, name, value)
    file.flush()
    written = content.getvalue()
    file.close()
    return written


def _write_deeplabcut(
    path: Path, values: NDArray, names: Sequence[str], coords: tuple[str, ...]
) -> None:
    """Write values (n_frames, n_points, n_coords) as DeepLabCut does."""
    levels = ["scorer", "bodyparts", "coords"]
    columns = pd.MultiIndex.from_product([[_SCORER], names, coords], names=levels)
    frame = pd.DataFrame(values.reshape(len(values), -1), columns=columns)
    if path.suffix.lower() == ".csv":
        frame.to_csv(path)
    else:
        import_optional("tables", extra="tables")
        frame.to_hdf(path, key=_KEY, format="table", mode="w")


def _write_trc(path: Path, values: NDArray, names: Sequence[str], fps: Any) -> None:
    """Write values (n_frames, n_points, 3) as OpenSim writes them, NaN as nan."""
    n_frames, n_points, _ = values.shape
    axes = "\t".join(f"X{j}\tY{j}\tZ{j}" for j in range(1, n_points + 1))
    numbers = map(str, (fps, fps, n_frames, n_points, "px", fps, 1, n_frames))
    head = [
        f"PathFileType\t4\t(X/Y/Z)\t{path.name}",
        f"{_TRC} OrigNumFrames".replace(" ", "\t"),
        "\t".join(numbers),
        "Frame#\tTime\t" + "\t\t\t".join(names) + "\t\t",
        f"\t\t{axes}",
        "",
    ]
    table = pd.DataFrame(values.reshape(n_frames, -1))
    table.insert(0, "time", np.arange(n_frames) / fps)
    table.index += 1
    rows = table.to_csv(sep="\t", header=False, lineterminator="\n", na_rep="nan")
    path.write_text("\n".join(head) + "\n" + rows, encoding="utf-8")
