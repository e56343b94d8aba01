"""Tables of landmarks read from files and taken out of data frames."""

import numpy as np
import pandas as pd
import pytest
from numpy.testing import assert_array_equal
from refusals import refusals_of, refused

from isa_nrsfm.io import LandmarkTable, landmark_table, read_table, write_table

N_POINTS = 8
NAMES = [f"{axis}{j}" for j in range(N_POINTS) for axis in "xy"]


@pytest.fixture
def write(tmp_path):
    """Return a function that writes text to a file and returns its path."""

    def write_text(text, name="table.csv", encoding="utf-8"):
        path = tmp_path / name
        path.write_bytes(text.encode(encoding))
        return path

    return write_text


def random_frame():
    """Return a table of landmarks with a column of names."""
    values = np.random.default_rng(0).uniform(1, 600, (5, 2 * N_POINTS))
    frame = pd.DataFrame(values, columns=NAMES)
    frame.insert(0, "id", [f"{i:03d}" for i in range(5)])
    return frame


@pytest.fixture
def frame():
    return random_frame()


@pytest.mark.parametrize("suffix", [".csv", ".tsv", ".parquet", ".CSV"])
def test_tables_survive_writing_and_reading(frame, tmp_path, suffix):
    frame.loc[2, ["x1", "y1"]] = np.nan
    path = tmp_path / f"table{suffix}"
    write_table(frame, path)
    exactly = {"check_dtype": False, "check_exact": True}
    pd.testing.assert_frame_equal(read_table(path), frame, **exactly)


def test_text_stays_as_it_is_written(write):
    path = write("id,AU01_r,x0,y0,nose_x\n007,0.50,1.5,2e1,NA\nNone,,1_0,,\n")
    table = read_table(path)
    assert list(table["id"]) == ["007", "None"]
    assert list(table["AU01_r"]) == ["0.50", ""]
    assert list(table["x0"]) == ["1.5", "1_0"]
    assert_array_equal(table["y0"], [20.0, np.nan])
    assert table["nose_x"].isna().all()


def test_quotation_marks_are_understood(write):
    rows = 8 * '"a ""b""\nc,\nd",1\n'
    table = read_table(write(f'\n"name, first",x0\r\n{rows}\n'))
    assert [*table] == ["name, first", "x0"]
    assert (table == ['a "b"\nc,\nd', 1.0]).all(axis=None)
    assert len(table) == 8


def test_landmarks_and_other_columns_are_separated(frame):
    shuffled = frame[["y3", "id", *(name for name in NAMES if name != "y3")]]
    table = landmark_table(shuffled)
    assert isinstance(table, LandmarkTable)
    assert list(table.points) == NAMES
    assert list(table.other) == ["id"]
    assert_array_equal(table.points, frame[NAMES])
    pd.testing.assert_frame_equal(table.other, frame[["id"]])
    assert (table.points.dtypes == np.float64).all()

    part = frame.iloc[[4, 1]].rename(columns={"x0": " x0 "})
    points, other = landmark_table(part)
    assert list(points.index) == list(other.index) == [4, 1]
    assert points.columns[0] == "x0"


def test_zeros_are_missing_only_on_request_and_only_in_pairs(frame):
    frame.loc[0, ["x1", "y1"]] = 0.0
    frame.loc[1, "x1"] = 0.0
    assert not landmark_table(frame).points.isna().any(axis=None)
    points = landmark_table(frame, missing=0.0).points
    missing = np.zeros(points.shape, dtype=bool)
    missing[0, 2:4] = True
    assert_array_equal(points.isna(), missing)
    pd.testing.assert_frame_equal(landmark_table(frame, missing=0).points, points)
    for wrong in (True, np.inf, "nan"):
        message = "None or finite numbers; got"
        refused(message, landmark_table, frame, missing=wrong)


def test_numbers_of_all_kinds_become_floats(frame):
    frame["x0"] = pd.array([1, None, 3, 4, 5], dtype="Int64")
    frame["y0"] = pd.Series(["1", " 2.5 ", "", "nan", None], dtype=object)
    frame["x1"] = frame["x1"].astype(np.float32)
    points = landmark_table(frame).points
    assert_array_equal(points["x0"], [1, np.nan, 3, 4, 5])
    assert_array_equal(points["y0"], [1, 2.5, np.nan, np.nan, np.nan])
    assert (points.dtypes == np.float64).all()


def landmarks_in(path):
    return landmark_table(read_table(path), columns="x#,y#")


def made(folder):
    folder.mkdir()
    return folder


test_refusals = refusals_of("io_tables", globals())
