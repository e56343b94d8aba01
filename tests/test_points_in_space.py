"""Points in space with standard deviations, and their files."""

from itertools import product

import numpy as np
import pandas as pd
import pytest
from layers import Quick, slow_after
from made_once import made_once
from numpy.testing import assert_allclose, assert_array_equal
from refusals import refusals_of, refused, warned
from scipy.io import netcdf_file

from isa_nrsfm import AffineNRSfM
from isa_nrsfm.datasets import make_body_tracks, make_face_tracks, make_nonrigid_tracks
from isa_nrsfm.export import frame_points, write_points

AS_USERS = ["error_steps"]
MAKE = {
    "faces": lambda **k: make_face_tracks(50, n_components=3, noise=0.02, **k),
    "bodies": lambda **k: make_body_tracks(150, noise=0.02, **k),
    "clouds": lambda **k: make_nonrigid_tracks(150, 30, 2, noise=0.02, **k),
    "near": lambda **k: make_face_tracks(
        80, n_components=2, noise=0.01, camera="perspective", distance=400, **k
    ),
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


@pytest.mark.parametrize(("name", "missing"), slow_after(1, product(MAKE, [0.0, 0.2])))
def test_deviations_are_those_of_the_errors(name, missing):
    camera = "perspective" if name == "near" else "weak_perspective"
    for seed in (0, 1) if name == "clouds" else (0,):
        table = MAKE[name](missing=missing, random_state=seed)
        model = AffineNRSfM(3, camera=camera, random_state=0)
        if name == "near":
            model.set_params(principal_point=(640, 360))
        points = frame_points(model.fit(table.data), table.data)
        assert points.determined.all()
        ratio = np.sqrt(
            np.mean((errors(table, points) / points.position_std) ** 2, (0, 1))
        )
        # Deviations of depths have the margins of docs/depth.md, "Accuracy".
        assert ((ratio > [0.7, 0.7, 0.4]) & (ratio < [1.2, 1.2, 1.4])).all()
        if name != "near":
            assert_allclose(
                points.position[..., :2].reshape(len(table.data), -1),
                model.reproject(table.data),
                rtol=1e-9,
            )
            _, std = model.reconstruct(table.data, return_std=True)
            depth = std * model.scales_[:, None]
            assert_allclose(points.position_std[..., 2], depth, rtol=1e-6)


@pytest.fixture(scope="module")
def face():
    table = make_face_tracks(40, n_components=1, random_state=0, noise=0.01).data
    X = pd.DataFrame(
        table[:, :60], columns=[f"p{j}_{a}" for j in range(30) for a in "xy"]
    )
    X.iloc[3] = np.nan
    options = {"camera": "weak_perspective", "random_state": 0}
    with pytest.warns(UserWarning, match="row"):
        model = AffineNRSfM(1, **options).fit(X)
    return model, X, frame_points(model, X)


def test_datasets_of_movement(face, tmp_path):
    model, X, points = face
    write_points(model, path := tmp_path / "a.nc", X, fps=25)
    with netcdf_file(path, mmap=False) as file:
        for name in ("position", "position_std"):
            variable = file.variables[name]
            assert variable.dimensions == ("time", "space", "keypoint", "individual")
            values = getattr(points, name)
            assert_array_equal(variable[..., 0].swapaxes(1, 2), values)
        assert_array_equal(file.variables["determined"][..., 0], points.determined)
        assert_allclose(file.variables["time"][:], np.arange(40) / 25)
        names = [b"".join(row).decode() for row in file.variables["keypoint"][:]]
        assert [name.strip("\0") for name in names] == [f"p{j}" for j in range(30)]
        assert (file.ds_type, file.time_unit, file.fps) == (b"poses", b"seconds", 25)
    xarray = pytest.importorskip("xarray", reason="reads the file as movement does")
    dataset = xarray.load_dataset(path)
    assert dataset.determined.dtype == bool
    assert list(dataset.space.values) == ["x", "y", "z"]


@pytest.mark.parametrize("suffix", [".csv", ".h5"])
@pytest.mark.filterwarnings("default")  # tables of HDF5 files stay open
def test_files_of_deeplabcut(face, suffix, tmp_path):
    model, X, points = face
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


def test_files_of_opensim(face, tmp_path):
    model, X, points = face
    refused("fps, the frames per second, is needed", write_points, model, "a.trc", X)
    write_points(model, tmp_path / "a.trc", X, fps=25)
    for name, values in (("a", points.position), ("a_std", points.position_std)):
        head, table = read_trc(tmp_path / f"{name}.trc")
        assert head[3].split("\t")[::3][1:3] == ["p1", "p2"] or "p1" in head[3]
        assert head[2].split("\t")[2:4] == ["40", "30"]
        # OpenSim reads rows of as many cells, none of which is empty at the end.
        rows = (tmp_path / f"{name}.trc").read_text().splitlines()[6:]
        assert {len(row.split("\t")) for row in rows} == {2 + 3 * 30}
        assert "" not in "\t".join(rows).split("\t")
        assert_allclose(table[:, 2:].reshape(values.shape), values, rtol=1e-12)


def read_trc(path):
    """Return the lines of the header, and the numbers, as OpenSim reads them."""
    lines = path.read_text().split("\n")
    rows = [[float(cell or "nan") for cell in line.split("\t")] for line in lines[6:-1]]
    return lines[:6], np.array(rows)


def test_depths_that_are_not_determined(face, tmp_path):
    table = make_face_tracks(40, n_components=1, random_state=0, noise=0.01)
    still = (
        table.mean_shape @ table.motion[0].T
        + table.alpha[:, :1, None] * table.basis[0] @ table.motion[0].T
    )
    noise = np.random.default_rng(0).normal(size=still.shape)
    X = (still + noise)[:, ::3].reshape(40, -1)
    model = AffineNRSfM(1, camera="weak_perspective", random_state=0)
    warned("depth .* not determined", model.fit, X)
    points = warned("depth .* not determined", frame_points, model, X)
    assert not points.determined.any()
    assert np.isnan([points.position[..., 2], points.position_std[..., 2]]).all()
    assert np.isfinite([points.position[..., :2], points.position_std[..., :2]]).all()


TABLE = make_face_tracks(40, n_components=1, random_state=0, noise=0.01).data


@made_once
def plain_model(**params):
    return Quick(1, random_state=0, **params).fit(TABLE)


test_refusals = refusals_of("points_in_space", globals())
