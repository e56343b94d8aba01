"""Tables of landmarks read from files and taken out of data frames."""

import numpy as np
import pandas as pd
import pytest
from refusals import refusals_of

from isa_nrsfm.io import landmark_table, read_table, write_table

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


def shuffled():
    """Return a table whose columns and rows are in another order."""
    frame = random_frame().iloc[[4, 1, 0, 2, 3]].rename(columns={"x0": " x0 "})
    return frame[["y3", "id", *(name for name in frame if name not in ("y3", "id"))]]


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
