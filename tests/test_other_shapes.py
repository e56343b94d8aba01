"""Tables as programs write them that are no table of one landmark set: one table."""

import json
import warnings

import landmark_files as files
import numpy as np
import pandas as pd
import pytest
from landmark_files import BODYPARTS, TRACKS
from numpy.testing import assert_array_equal

from isa_nrsfm.io import landmark_table, read_landmarks

N, J = TRACKS.shape[:2]
FLAT, FRAMES = TRACKS.reshape(N, -1), np.repeat(range(N), J)
POINTS = np.tile(range(J), N)
LONG = pd.DataFrame({"frame": FRAMES, "point": POINTS, **dict(zip("xy", TRACKS.T.reshape(2, -1, order="F") if 0 else TRACKS.reshape(-1, 2).T))})
PARTS = np.tile(BODYPARTS, N)


def wide(name="{part}_{axis}", tracks=TRACKS, parts=BODYPARTS):
    """Return a table of points under names such as "{part}_{axis}"."""
    names = [name.format(part=part, axis=axis) for part in parts for axis in "xy"]
    return pd.DataFrame(tracks.reshape(len(tracks), -1), columns=names)


def both(name, other=TRACKS / 640):
    """Return points, and the same once more under other names."""
    return wide().join(wide(name, other))


def tidy(values="position", **names):
    """Return a table with a row for each coordinate, as movement and tidyr write it."""
    long = LONG.assign(keypoint=PARTS).drop(columns="point")
    long = long.melt(["frame", "keypoint"], ["x", "y"], "space", values)
    return long.rename(columns=names)


def cells(write, names=BODYPARTS):
    """Return a table with a point in each cell."""
    return pd.DataFrame({p: [write(*xy) for xy in TRACKS[:, j]] for j, p in enumerate(names)})


def faces(write):
    """Return a table with all points of an image in one cell."""
    return pd.DataFrame({"image": [f"{i}.jpg" for i in range(N)], "landmarks": [*map(write, TRACKS)]})


PEOPLE = pd.concat([LONG.assign(person=who) for who in "ab"]).sort_values(["frame", "person"])
ROW_IDS = [f"{i}-{j}" for i, j in zip(FRAMES, POINTS)]
# What is read, or the message.
TABLES = {
    # A row for each point.
    "R": (LONG.rename(columns={"frame": "Image", "point": "Landmark"}), FLAT),
    "TrackMate": (LONG.rename(columns={"x": "POSITION_X", "y": "POSITION_Y", "point": "SPOT", "frame": "FRAME"}).assign(ID=range(N * J)), FLAT),
    "MediaPipe": (LONG.assign(z=0.1, visibility=0.9, point=PARTS), FLAT),
    "Kaggle": (LONG.assign(row_id=ROW_IDS, type="hand", z=0.0), FLAT),
    "image size": (LONG.assign(width=640, height=480), FLAT),
    "pixels": (LONG.rename(columns={"x": "X [px]", "y": "Y [px]"}), FLAT),
    "shuffled, gaps": (LONG.sample(frac=1, random_state=0).sort_values("frame", kind="stable")[:-1], None),
    "time of frames": (LONG.assign(time=FRAMES / 25, score=np.linspace(0, 1, N * J)), FLAT),
    "video, frame": (LONG.assign(video=FRAMES // 6, frame=FRAMES % 6), FLAT),
    "people": (PEOPLE, FLAT.repeat(2, axis=0)),
    "no names of points": (LONG.drop(columns="point"), FLAT),
    "no frames": (LONG.drop(columns="frame"), FLAT),
    "DeepLabCut stacked": (LONG.assign(point=PARTS, scorer="DLC").rename(columns={"point": "bodyparts"}), FLAT),
    "movement": (tidy().assign(individual="mouse", confidence=0.5), FLAT),
    "tidyr": (wide().assign(frame=range(N)).melt("frame", var_name="name"), FLAT),
    "DeepLabCut tidy": (tidy("value", space="coords", keypoint="bodyparts").assign(scorer="net"), FLAT),
    "two pairs": (LONG.rename(columns={"x": "px_x", "y": "px_y"}).assign(mm_x=LONG.x / 9, mm_y=LONG.y / 9), "more than one pair of coordinates.* 'px_x,px_y' or 'mm_x,mm_y'"),
    "gaze": (LONG.drop(columns="point").assign(frame=range(N * J)), "row_per_point"),
    # Several numbers in a cell.
    "lists": (cells("[{}, {}]".format), FLAT),
    "tuples under numbers": (cells("({}, {})".format, map(str, range(J))), FLAT),
    "json": (cells(lambda x, y: json.dumps({"x": x, "y": y})), FLAT),
    "numpy": (cells(lambda x, y: f"[{x} {y}]"), FLAT),
    "MediaPipe cells": (cells("({}, {}, -0.1)".format), FLAT),
    "AffectNet": (faces(lambda face: ";".join(map(str, face.ravel()))), FLAT),
    "nested": (faces(lambda face: str(face.tolist())), FLAT),
    "nested, x y z": (faces(lambda face: str(np.c_[face, face[:, :1]].tolist())), FLAT),
    "x and y": (pd.DataFrame({f"{a}s": [str(v) for v in TRACKS[..., k].tolist()] for k, a in enumerate("xy")}), FLAT),
    "numpy, lines": (faces(str), FLAT),
    "other numbers": (faces(lambda face: str(face[: int(face[0, 0]) % 2 + 7].tolist())), "'landmarks' hold several numbers"),
    # The same points twice.
    "MediaPipe world": (both("{part}_world_{axis}"), "'no world_'"),
    "before": (both("world_{part}_{axis}"), "'no world_'"),
    "pixels and shares": (wide("{part}_px_{axis}").join(wide("{part}_norm_{axis}")), "more than once, such as px and norm"),
    "filtered": (both("{part}_filtered_{axis}"), "'no filtered_'"),
    "velocity": (both("{part}_vel_{axis}").join(wide("{part}_acc_{axis}")), "'no vel_'"),
    "camel": (both("{part}World_{axis}"), "'no World'"),
    "numbered": (wide("pose_landmarks_{part}_{axis}", parts=range(J)).join(wide("pose_world_landmarks_{part}_{axis}", parts=range(J))), "'no world_'"),
    "before axis": (wide("{axis}_{part}").join(wide("{axis}_{part}_smooth")), "'no _smooth'"),
    # Columns with x and y that are no points.
    "gyroscope": (wide().assign(gyro_x=1.0, gyro_y=2.0, gyro_z=1), FLAT),
    "gaze angle": (wide().assign(gaze_angle_x=1.0, gaze_angle_y=2.0), FLAT),
    "head": (wide().assign(head_rotation_x=1.0, head_rotation_y=2.0), FLAT),
    "box": (wide().assign(bbox_center_x=1.0, bbox_center_y=2.0), FLAT),
    "cursor": (wide().assign(cursor_x=1.0, cursor_y=2.0, mouse_x=1.0, mouse_y=3.0), FLAT),
    "centroid": (wide("{part}_{axis}", parts=range(J)).assign(centroid_x=1.0, centroid_y=2.0), FLAT),
    "targets": (wide("target_{part}_{axis}", parts="abcdefgh"), FLAT),
}


def read(tmp_path, table):
    path = tmp_path / "a.csv"
    table.to_csv(path, index=False)
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        try:
            found = read_landmarks(path)
        except ValueError as error:
            return str(error), None, caught
    return "", found, caught


@pytest.mark.parametrize("name", TABLES)
def test_tables_of_other_shapes(tmp_path, name):
    table, expected = TABLES[name]
    told, found, caught = read(tmp_path, table)
    print(name, "|", told, "|", found, "|", [str(w.message)[:300] for w in caught])
    if isinstance(expected, str):
        assert pytest.raises and __import__("re").search(expected, told), told
    elif expected is not None:
        assert not told
        assert_array_equal(found.points, expected)
