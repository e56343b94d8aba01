"""Tables of landmarks: files, data frames, and columns recognised by their names."""

import landmark_files as files
import numpy as np
import pandas as pd
import pytest
from refusals import refusals_of, refused

from isa_nrsfm import AffineNRSfM
from isa_nrsfm.io import (
    landmark_table,
    read_landmarks,  # noqa: F401  in refusals.txt
    read_table,
    write_table,
)

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
    assert list(points) == NAMES
    assert (points.dtypes == np.float64).all()
    return points[name].to_numpy()


def landmarks_in(path):
    return landmark_table(read_table(path), columns="x#,y#")


def made(folder):
    folder.mkdir()
    return folder


# --- names ---------------------------------------------------------------------------


def named(template, points=range(9)):
    """Return interleaved names from a template with {a} and {p}."""
    return [template.format(a=axis, p=point) for point in points for axis in "xy"]


def columns_in(names, columns=None):
    """Return the columns that are points, of a table with these names."""
    table = pd.DataFrame(np.ones((2, len(names))), columns=names)
    return list(landmark_table(table, columns=columns).points)


def mixed(template):
    """Return the names of twelve points and others in any order."""
    names = named(template, range(12))
    return ["id", *np.random.default_rng(0).permutation(names), "confidence"]


def table_with(folder, names):
    """Return the path of a table with these names."""
    table = pd.DataFrame(np.ones((2, len(names))), columns=names)
    return files.saved(folder / "a.csv", table)


def refused_as(names):
    """Return the layouts that a fit does not believe of columns with these names."""
    table = pd.DataFrame(np.ones((1, len(names))), columns=names)
    fits = {word: AffineNRSfM(layout=word).fit for word in ("interleaved", "planar")}
    told = {word: str(refused(None, fit, table)) for word, fit in fits.items()}
    words = "contradicts the column names", "are not named as the x or y"
    return [word for word, text in told.items() if any(w in text for w in words)]


PARTS = ["nose", "chin", "left eye", "brow_1", "brow_2", "mouth-l", "mouth-r"]
FEW = named("{p}_{a}", ["hat", *"abcde"])
CLASHING = ["x_1", "y_1", "1_x", "1_y"]
OPENFACE = [f" {name}" for name in files.openface_names()]

test_refusals = refusals_of("io_tables", globals())
