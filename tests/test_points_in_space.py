"""Points in space with standard deviations, and their files."""

from functools import partial

import numpy as np
import pandas as pd
import pytest
from made_once import made_once
from numpy.testing import assert_allclose, assert_array_equal
from refusals import refusals_of, refused, warned
from scenes import table_of
from scipy.io import netcdf_file

from isa_nrsfm import AffineNRSfM
from isa_nrsfm.datasets import make_body_tracks, make_face_tracks, make_nonrigid_tracks
from isa_nrsfm.export import frame_points, write_points

AS_USERS = ["error_steps"]
NEAR = {"n_components": 2, "camera": "perspective", "distance": 400}
MAKE = {
    "faces": partial(make_face_tracks, 50, n_components=3, noise=0.02),
    "bodies": partial(make_body_tracks, 150, noise=0.02),
    "clouds": partial(make_nonrigid_tracks, 150, 30, 2, noise=0.02),
    "near": partial(make_face_tracks, 80, noise=0.01, **NEAR),
}


def errors(table, points):
    """Return errors (n, J, 3) of points, up to their middle and the mirror image."""
    scales = np.linalg.norm(table.motion[:, :1], axis=2)[..., None]
    sight = np.cross(table.motion[:, 0], table.motion[:, 1])[:, None] / scales
    axes = np.concatenate([table.motion, sight], axis=1)
    truth, found = table.shapes @ axes.mT, points.position.copy()
    for each in (truth, found):
        each -= each.mean(axis=1, keepdims=True)
    found[..., 2] *= np.sign(np.sum(found[..., 2] * truth[..., 2]))
    return found - truth


@pytest.mark.filterwarnings("ignore:the depth of the shapes is doubtful")
@pytest.mark.slow
@pytest.mark.parametrize(
    ("name", "missing"),
    [("faces", 0.2), ("bodies", 0.0), ("clouds", 0.2), ("near", 0.0)],
)
def test_deviations_are_those_of_the_errors(name, missing):
    params = {"camera": "weak_perspective", "random_state": 0}
    if name == "near":
        params |= {"camera": "perspective", "principal_point": (640, 360)}
    table = MAKE[name](missing=missing, random_state=0)
    model = AffineNRSfM(3, **params).fit(table.data)
    points = frame_points(model, table.data)
    assert points.determined.all()
    ratios = errors(table, points) / points.position_std
    ratio = np.sqrt(np.mean(ratios**2, axis=(0, 1)))
    # Deviations of depths have the margins of docs/depth.md, "Accuracy".
    assert ((ratio > [0.7, 0.7, 0.4]) & (ratio < [1.2, 1.2, 1.4])).all()
    if name != "near":
        images = table_of(points.position[..., :2])
        assert_allclose(images, model.reproject(table.data), rtol=1e-9)


FACES = make_face_tracks(30, n_components=1, random_state=0, noise=0.01)
TABLE = table_of(FACES.tracks[:, ::5])


@made_once
def faces():
    """Return a model, its table, one of whose rows is empty, and its points."""
    names = [f"p{j}_{axis}" for j in range(14) for axis in "xy"]
    X = pd.DataFrame(TABLE, columns=names)
    X.iloc[3] = np.nan
    model = AffineNRSfM(1, camera="weak_perspective", random_state=0)
    warned("row", model.fit, X)
    return model, X, frame_points(model, X)


def face_model():
    return faces()[0]


def test_datasets_of_movement(tmp_path):
    model, X, points = faces()
    write_points(model, path := tmp_path / "a.nc", X, fps=25)
    with netcdf_file(path, mmap=False) as file:
        for name in ("position", "position_std"):
            variable = file.variables[name]
            assert variable.dimensions == ("time", "space", "keypoint", "individual")
            values = getattr(points, name)
            assert_array_equal(variable[..., 0].swapaxes(1, 2), values)
        assert_array_equal(file.variables["determined"][..., 0], points.determined)
        assert_allclose(file.variables["time"][:], np.arange(30) / 25)
        names = [b"".join(row).decode() for row in file.variables["keypoint"][:]]
        assert [name.strip("\0") for name in names] == [f"p{j}" for j in range(14)]
        assert (file.ds_type, file.time_unit, file.fps) == (b"poses", b"seconds", 25)
    xarray = pytest.importorskip("xarray", reason="reads the file as movement does")
    dataset = xarray.load_dataset(path)
    assert dataset.determined.dtype == bool
    assert list(dataset.space.values) == ["x", "y", "z"]


@pytest.mark.parametrize("suffix", [".csv", ".h5"])
@pytest.mark.filterwarnings("default")  # tables of HDF5 files stay open
def test_files_of_deeplabcut(suffix, tmp_path):
    model, X, points = faces()
    pytest.importorskip("tables", reason="needs the extra tables")
    write_points(model, tmp_path / f"a_3d{suffix}", X)
    read = pd.read_hdf if suffix == ".h5" else csv_of_deeplabcut
    flag = points.determined[..., None]
    std = np.concatenate([points.position_std, flag], axis=2)
    for name, values in (("a_3d", points.position), ("a_3d_std", std)):
        frame = read(tmp_path / f"{name}{suffix}")
        assert frame.columns.names == ["scorer", "bodyparts", "coords"]
        assert_allclose(frame.to_numpy().reshape(values.shape), values, rtol=1e-12)
    assert [*frame.columns.unique("coords")] == ["x", "y", "z", "determined"]


def csv_of_deeplabcut(path):
    return pd.read_csv(path, header=[0, 1, 2], index_col=0)


def test_files_of_opensim(tmp_path):
    model, X, points = faces()
    refused("fps, the frames per second, is needed", write_points, model, "a.trc", X)
    write_points(model, tmp_path / "a.trc", X, fps=25)
    for name, values in (("a", points.position), ("a_std", points.position_std)):
        lines = (tmp_path / f"{name}.trc").read_text().splitlines()
        cells = [line.split("\t") for line in lines]
        assert "p1" in cells[3]
        assert cells[2][2:4] == ["30", "14"]
        # OpenSim reads rows of as many cells, none of which is empty.
        rows = np.array(cells[6:], dtype=float)
        assert_allclose(rows[:, 2:].reshape(values.shape), values, rtol=1e-12)


def test_depths_that_are_not_determined():
    still = FACES.shapes @ FACES.motion[0].T
    noise = np.random.default_rng(0).normal(size=still.shape)
    X = table_of((still + noise)[:, ::5])
    model = AffineNRSfM(1, camera="weak_perspective", random_state=0)
    warned("depth .* not determined", model.fit, X)
    points = warned("depth .* not determined", frame_points, model, X)
    assert not points.determined.any()
    assert np.isnan([points.position[..., 2], points.position_std[..., 2]]).all()
    assert np.isfinite([points.position[..., :2], points.position_std[..., :2]]).all()


test_refusals = refusals_of("points_in_space", globals())
