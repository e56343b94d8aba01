import numpy as np
import pandas as pd
import pytest
from export_models import N_COMPONENTS, face_model, faces
from numpy.testing import assert_array_equal
from scipy.io import loadmat

from isa_nrsfm import AffineNRSfM, FastISA
from isa_nrsfm.export import ShapeArrays, shape_arrays, write_shapes

QUICK = {"isa": FastISA(n_init=1), "refinement": None, "random_state": 0}
pytestmark = pytest.mark.filterwarnings("ignore::sklearn.exceptions.ConvergenceWarning")


def test_arrays_are_the_attributes_of_the_model():
    model = face_model()
    arrays = shape_arrays(model)
    for name, array in arrays._asdict().items():
        if not name.endswith("names"):
            assert_array_equal(array, getattr(model, f"{name}_"))
    assert list(arrays.component_names) == ["alpha_1", "alpha_2", "alpha_3"]
    assert list(arrays.point_names[:3]) == ["0", "1", "2"]


@pytest.mark.parametrize("layout", ["interleaved", "planar"])
def test_points_are_named_as_the_columns(layout):
    names = [f"{axis}_p{j}" for j in range(68) for axis in "xy"]
    table = pd.DataFrame(faces().data, columns=names)
    if layout == "planar":
        table = table[names[::2] + names[1::2]]
    model = AffineNRSfM(1, layout=layout, **QUICK).fit(table)
    named = [str(name) for name in shape_arrays(model).point_names]
    assert named == [f"p{j}" for j in range(68)]


def test_columns_that_are_no_coordinates_name_points_in_full():
    table = pd.DataFrame(faces().data, columns=[f"column {i}" for i in range(136)])
    model = AffineNRSfM(1, **QUICK).fit(table)
    assert shape_arrays(model).point_names[1] == "column 2"


def test_models_without_frames_have_arrays_of_no_frames():
    model = AffineNRSfM(2, keep_frames=False, **QUICK).fit(faces().data[:40])
    arrays = shape_arrays(model)
    shapes = arrays.alpha.shape, arrays.motion.shape, arrays.translation.shape
    assert shapes == ((0, 2), (0, 2, 3), (0, 2))


@pytest.mark.parametrize("suffix", [".npz", ".mat"])
def test_files_have_all_arrays(tmp_path, suffix):
    path = tmp_path / f"shapes{suffix}"
    write_shapes(face_model(), str(path))
    expected = shape_arrays(face_model())._asdict()
    if suffix == ".npz":
        with np.load(path, allow_pickle=False) as arrays:
            read = dict(arrays)
    else:
        read = loadmat(path, squeeze_me=True, chars_as_strings=True)
        read = {name: read[name] for name in ShapeArrays._fields}
    assert set(read) == set(expected)
    for name, array in expected.items():
        assert_array_equal(read[name], array)


def test_names_are_cell_arrays_in_matlab(tmp_path):
    path = tmp_path / "shapes.mat"
    write_shapes(face_model(), path)
    names = loadmat(path)["component_names"]
    assert names.dtype == object
    assert names.shape == (N_COMPONENTS, 1)
