"""Tables of landmarks read from files and taken out of data frames."""

import numpy as np
import pandas as pd
import pytest
from numpy.testing import assert_array_equal
from refusals import refusals_of

from isa_nrsfm.io import LandmarkTable, landmark_table, read_table, write_table

N_POINTS = 8
NAMES = [f"{axis}{j}" for j in range(N_POINTS) for axis in "xy"]


def random_frame():
    """Return a table of landmarks with a column of names."""
    values = np.random.default_rng(0).uniform(1, 600, (5, 2 * N_POINTS))
    frame = pd.DataFrame(values, columns=NAMES)
    frame.insert(0, "id", [f"{i:03d}" for i in range(5)])
    return frame


@pytest.mark.parametrize("suffix", [".csv", ".tsv", ".parquet", ".CSV"])
def test_tables_survive_writing_and_reading(tmp_path, suffix):
    frame = random_frame()
    frame.loc[2, ["x1", "y1"]] = np.nan
    path = tmp_path / f"table{suffix}"
    write_table(frame, path)
    exactly = {"check_dtype": False, "check_exact": True}
    pd.testing.assert_frame_equal(read_table(path), frame, **exactly)


def cells(path):
    """Return the cells of a table by column."""
    return read_table(path).to_dict("list")


def test_landmarks_and_other_columns_are_separated():
    frame = random_frame()
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


def points_of(name, values):
    """Return the landmarks of a column with other values, which are real numbers."""
    points = landmark_table(random_frame().assign(**{name: values})).points
    assert (points.dtypes == np.float64).all()
    return points[name].to_numpy()


def landmarks_in(path):
    return landmark_table(read_table(path), columns="x#,y#")


def made(folder):
    folder.mkdir()
    return folder


test_refusals = refusals_of("io_tables", globals())
