"""Read landmarks in files of arrays: NumPy, MATLAB and TRC."""

from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from isa_nrsfm._compat.caller import warn_caller
from isa_nrsfm._compat.optional import import_optional
from isa_nrsfm._compat.stored_arrays import array_in, read_arrays
from isa_nrsfm.io._animals import content_of, is_hdf5, own_member
from isa_nrsfm.io._keypoints import floats_of
from isa_nrsfm.io._landmarks import Landmarks, assemble


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
    h5py = import_optional("h5py", extra="h5")
    with h5py.File(path, "r") as file:  # MATLAB 7.3, whose axes are turned round
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
