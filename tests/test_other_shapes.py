"""Tables as programs write them that are not two columns for each point of one body."""

import re

import landmark_files as files
import numpy as np
import pandas as pd
import pytest
from fit_runs import QUICK, begun, told_of_fit
from landmark_files import BODYPARTS, TRACKS, warnings_of
from numpy.testing import assert_array_equal
from refusals import refusals_of, refused
from scenes import table_of

from isa_nrsfm import AffineNRSfM, FastISA
from isa_nrsfm.datasets import make_face_tracks
from isa_nrsfm.io import landmark_table, read_landmarks

N, J = TRACKS.shape[:2]
FLAT, FRAMES, POINTS = TRACKS.reshape(N, -1), np.repeat(range(N), J), [*range(J)] * N
LONG = pd.DataFrame({"frame": FRAMES, "point": POINTS})
LONG[["x", "y"]] = TRACKS.reshape(-1, 2)
NAMED = LONG.assign(bodyparts=BODYPARTS * N).drop(columns="point")
BESIDE = LONG.rename(columns={"x": "px_x", "y": "px_y"}).assign(mm_x=LONG.x, mm_y=1.0)
PEOPLE = pd.concat([LONG.assign(person=who) for who in "ab"]).sort_values(
    ["frame", "person"], kind="stable"
)
KAGGLE = pd.concat([LONG.assign(type=part, z=0.1) for part in ("pose", "hand")])
KAGGLE["point"] += 4 * (KAGGLE.type == "hand")
KAGGLE["row_id"] = [
    f"{f}-{t}-{p}" for f, t, p in KAGGLE[["frame", "type", "point"]].values
]


def wide(name="{part}_{axis}", tracks=TRACKS, parts=BODYPARTS):
    return files.table_of(name, tracks, parts)


def tidy(**names):
    """Return a table with a row for each coordinate."""
    table = NAMED.melt(["frame", "bodyparts"], ["x", "y"], "coords")
    return table.rename(columns=names)


def cells(write, names=BODYPARTS):
    """Return a table with a point in each cell."""
    columns = zip(names, TRACKS.swapaxes(0, 1).tolist(), strict=True)
    return pd.DataFrame({name: [write(*xy) for xy in track] for name, track in columns})


def faces(write):
    """Return a table with all points of an image in one cell."""
    return pd.DataFrame({"image": map(str, range(N)), "points": map(write, TRACKS)})


def moved(**names):
    """Return named points, with columns that are no points."""
    return wide().assign(**{name: np.arange(N) + k for name, k in names.items()})


TWICE = "the points are probably there more than once"
SHOWN = np.arange(N * J).reshape(N, J) % 5 > 0
GAPS = np.where(SHOWN, 1, np.nan).repeat(2, axis=1)


def read(path, **options):
    """Read a file; return texts of warnings and the error, and landmarks or None."""

    def found_or_error():
        try:
            return "", read_landmarks(path, **options)
        except ValueError as error:
            return str(error), None

    told, (error, found) = warnings_of(found_or_error)
    return f"{told} {error}".strip(), found


def advice_on(folder, table):
    """Return what is told of a table; columns to choose are right."""
    told, _ = read(path := files.saved(folder / "a.csv", table))
    advised = re.findall(r"'([^' ]*,[-+][^']*)'", told)
    assert bool(advised) == (TWICE in told)
    for columns in advised:
        assert len(read_landmarks(path, columns=columns).point_names) == J
    return told


def quietly_read(folder, table):
    """Return points that are read without any advice."""
    told, found = read(files.saved(folder / "a.csv", table))
    assert told == ""
    return found.points.to_numpy()


def points_in(folder, table, suffix=".csv"):
    """Return the points of a table; the options that are told give the same."""
    told, found = read(path := files.saved(folder / f"a{suffix}", table))
    assert told
    if option := re.search("row_per_point='(.*?)'", told):
        again = read(path, row_per_point=option[1])[1]
        pd.testing.assert_frame_equal(again.points, found.points)
        pd.testing.assert_frame_equal(again.frames, found.frames)
    if left := re.search("the columns (.*) are no points", told):
        every = re.search("columns='(.*)'", told)[1]
        more = len(read_landmarks(path, columns=every).point_names) - J
        assert 2 * more == len([n for n in left[1].split(", ") if n[-1] != "z"])
    return found.points.to_numpy()


def test_other_columns_of_a_row_for_each_point():
    table = LONG.assign(row=range(N * J), age=FRAMES % 3, score=0.25 + 0.01 * FRAMES)
    with pytest.warns(match="left out, as they differ between its points: row$"):
        points, other = landmark_table(table[3:].sample(frac=1, random_state=0))
    assert np.isnan(points.to_numpy()).sum() == 6
    assert list(other.columns[:2]) == ["frame", "age"]
    assert_array_equal(other.age, other.frame % 3)
    assert_array_equal(other.score_7, 0.25 + 0.01 * other.frame)
    many = {"row_per_point": "frame,type+point", "columns": "hand_#_x,hand_#_y"}
    with pytest.warns(match="row_id"):
        found = landmark_table(KAGGLE, **many).points
    assert_array_equal(found, FLAT)
    with pytest.warns(match="row_per_point='frame,type[+]point'"):
        refused("more than one set", landmark_table, KAGGLE)


def test_a_fit_of_a_row_for_each_point(tmp_path, fits, transforms):
    tracks = make_face_tracks(40, random_state=0).data.reshape(40, 68, 2)[:, ::5]
    rows = [(i, j, *tracks[i, j]) for i in range(40) for j in range(14)]
    table = pd.DataFrame(rows, columns=["photo", "lm", "x", "y"])
    path = files.saved(tmp_path / "a.csv", table)
    option = ["--row-per-point", "photo,lm"]
    found, *_ = transforms(fits(path, *QUICK, "1", *option).path, path, *option)
    assert list(found["photo"]) == [*range(40)]


ARRAY = make_face_tracks(60, random_state=0)
FACES = ARRAY.data.reshape(60, 68, 2)
PIXELS = 300 + 400 * FACES
THIRD = np.sin(np.arange(60 * 68)).reshape(60, 68, 1) * FACES.std()
SEEN = 0.95 + 0.05 * np.cos(np.arange(60 * 68)).reshape(60, 68, 1)
COLUMNS = FACES[:, ::2].reshape(60, -1)
CENTRED = COLUMNS - COLUMNS.mean(axis=0)
RANGE = (COLUMNS - COLUMNS.min(axis=0)) / np.ptp(COLUMNS, axis=0)
LOW, HIGH = np.percentile(COLUMNS, [25, 75], axis=0)


def told_of_fit_to(table):
    """Return what a fit warns of."""
    model = AffineNRSfM(1, isa=FastISA(n_init=1), refinement=None, random_state=0)
    return warnings_of(model.fit, table)[0]


def told_of_columns(folder, table):
    """Return whether fit and reader tell that columns were scaled separately."""
    path = files.saved(folder / "a.csv", wide("{axis}{part}", table, range(34)))
    texts = told_of_fit_to(table), read(path)[0]
    return ["Each column was scaled separately" in text for text in texts]


FURTHER = [[], [THIRD], [SEEN], [0 * SEEN], [THIRD, SEEN], [THIRD, 0 * SEEN]]


@pytest.mark.parametrize("further", FURTHER)
@pytest.mark.parametrize("tracks", [FACES, PIXELS])
@pytest.mark.filterwarnings("ignore:(in 1 of|68 of 136)")
def test_points_of_two_to_four_numbers(tracks, further):
    n = 2 + len(further)
    X = np.concatenate([tracks, *further], axis=2)
    for layout in ("interleaved", "planar"):
        fit = AffineNRSfM(1, layout=layout, refinement=None).fit
        cases = {r"the shape \(60, 68": X, rf"the shape \(60, {n}": X.swapaxes(1, 2)}
        if n > 2:
            cases[f"{n} numbers for each point"] = pd.DataFrame(table_of(X, layout))
        if n == 3:
            cases["an even number"] = pd.DataFrame(table_of(X[:, :21], layout))
        for told, given in cases.items():
            way = re.split("[gG]ive ", str(refused(told, fit, given)))[-1]
            found = eval(way, {"X": given, "np": np})
            points = tracks[:, : found.shape[1] // 2]
            assert_array_equal(found, table_of(points, layout))


@pytest.mark.parametrize("still", [2, 30])
def test_points_that_stand_still(still):
    walk = 30 * np.cumsum(np.random.default_rng(0).normal(size=(60, 1, 2)), axis=0)
    X = FACES + walk
    X[:, -still:] = FACES[:1, -still:] + 0.01 * FACES[:, -still:]
    assert re.search(rf"\b{still} [\w ]*stand still", told_of_fit_to(table_of(X)))


SCORES = np.linspace(0.02, 0.4, N * J).reshape(N, J)


def told_of_scores(folder, scores):
    """Return what the command tells of confidences, which are used as they should."""
    scores, tracks = np.tile(scores, (2, 1)), make_face_tracks(24, random_state=1).data
    tracks = tracks.reshape(24, 68, 2)[:, ::9] * 100 + 300
    names = [f"{part}_score" for part in BODYPARTS]
    table = wide("{part}_{axis}", tracks).join(pd.DataFrame(scores, columns=names))
    table.to_csv(path := folder / "a.csv", index=False)
    of_command = begun(path)
    if scores.min() == scores.max():
        options = " ".join([*QUICK, "1", "--weights", "confidence"])
        assert "left out" not in str(refused(None, told_of_fit, path, options))
    told = read(path, min_confidence=0.6)[0]
    assert ("no point has" in told) == (0 < scores.max() < 0.6)
    assert ("no probabilities: a threshold" in told) == (scores.max() > 2)
    table[names] = np.where(scores >= np.median(scores), "True", "FALSE")
    table.to_csv(path, index=False)
    assert_array_equal(read_landmarks(path).confidence, table[names] == "True")
    return of_command


OBJECTS = [{"x": x, "y": y, "z": 0.5, "visibility": 0.9} for x, y in TRACKS[0].tolist()]
PERSON = {"pose_keypoints_2d": files.SCORED[0].ravel().tolist()}
INSTANCE = dict(sorted(files.mmpose(files.SCORED[0]).items()))


def json_format(folder, content):
    """Return the format of a file with the points of one frame, or the error."""
    told, found = read(files.write_json(folder / "a.json", content))
    if found is None:
        return told
    assert_array_equal(found.points, FLAT[:1])
    return found.format


def test_codes_and_commas_of_tps(tmp_path):
    path = files.write_tps(tmp_path / "a.tps", TRACKS)
    text = path.read_text()
    path.write_text(re.sub("(?m)^[0-9.]+ [0-9.]+$", "-1.00000 -1.0", text, count=1))
    assert read(path)[1].points.isna().to_numpy().sum() == 2
    path.write_text(text.replace(".", ",").replace(",jpg", ".jpg"))
    told, found = read(path)
    assert "decimal commas" in told
    assert_array_equal(found.points, FLAT)
    path.write_text(text.replace("LM=8", "LM=0\nCURVES=1\nPOINTS=8"))
    assert "append them to the landmarks" in read(path)[0]


def test_failed_frames_of_the_first_openface(tmp_path):
    table = wide("{axis}{part}", parts=range(J)).add_prefix(" ")
    table.insert(0, "frame", range(N))
    table = table.assign(timestamp=0.1, confidence=0.9, success=1 - (table.frame == 3))
    for name in ("a.csv", "a.txt"):
        found = read_landmarks(files.saved(tmp_path / name, table))
        assert found.format == "openface"
        assert list(np.flatnonzero(found.failed)) == [3]
    table = wide("{axis}_{part}", files.scene(N, 68), range(68))  # parts of a table
    path = files.saved(tmp_path / name, table.assign(success=np.arange(N) % 2))
    assert list(read_landmarks(path).failed) == [True, False] * (N // 2)


test_refusals = refusals_of("other_shapes", globals())
