"""Files as trackers and people have them: what is read, and advice that is followed."""

import re
import shlex
from itertools import product
from string import ascii_lowercase  # noqa: F401  in refusals.txt
from types import SimpleNamespace

import landmark_files as files
import numpy as np
import pandas as pd
import pytest
from fit_runs import QUICK, begun, told_of_fit
from landmark_files import BODYPARTS, TRACKS, table_of, warnings_of
from numpy.testing import assert_allclose, assert_array_equal
from refusals import refusals_of, refused
from sklearn.base import clone

from isa_nrsfm import AffineNRSfM, FastISA
from isa_nrsfm.datasets import make_body_tracks, make_nonrigid_tracks
from isa_nrsfm.io import (
    from_mediapipe,
    from_sleap_io,
    landmark_table,
    read_landmarks,
    read_table,
)

N = 40
POINTS = make_nonrigid_tracks(N, 8, 1, noise=0.01, random_state=0).data
POINTS = (100 * POINTS + 400).round(2).reshape(N, 8, 2)
FLAT = TRACKS.reshape(12, -1)
PLAIN_NAME = "{part}_{axis}"
UNREFINED = AffineNRSfM(1, isa=FastISA(n_init=1), refinement=None)


def comma_table(folder, suffix, sign, numbers):
    """Write a table of numbers with commas, and of other columns: path, numbers."""
    cells, path = np.resize(numbers.split(), (3, 16)), folder / f"a{suffix}"
    others = {"note, or text": ["1,2", "3,4", "a, b"], "p": ["0,5", "27,5", "3"]}
    table = table_of(PLAIN_NAME, cells).assign(**others)
    return files.saved(path, table, sep=sign), cells.ravel(), others


def commas_in(folder, suffix, sign, numbers, by=""):
    """Read a table in which commas stand for another sign: what is told."""
    path, cells, others = comma_table(folder, suffix, sign, numbers)
    text, found = warnings_of(read_landmarks, path)
    assert found.frames.to_dict("list") == others
    expected = [float(cell.replace(",", by)) for cell in cells]
    assert_array_equal(found.points.to_numpy().ravel(), expected)
    return text


@pytest.mark.filterwarnings("ignore:(the cells|numbers have)")
def test_the_ways_to_decide_commas_are_right(tmp_path):
    path, *_ = comma_table(tmp_path, ".csv", ";", "4,280 2,912 13")
    told = r"can be (.*) or (\d*), and no other number decides it"
    error = refused(told, read_landmarks, path)
    words = re.findall(r"pd.read_csv\(..., (\w+)=','\)", str(error))
    for word, number in zip(words, re.search(told, str(error)).groups(), strict=True):
        again = pd.read_csv(path, sep=";", **{word: ","})
        again.to_csv(tmp_path / "new.csv", index=False)
        found = landmark_table(read_table(tmp_path / "new.csv")).points
        assert found.iloc[0, 0] == float(number)


def individuals_asked(folder, name, who):
    """Return what asks for individuals in one row; the options that it names work."""
    own = [name.replace("{who}", each) for each in who]
    tables = [table_of(each, POINTS + 300 * i) for i, each in enumerate(own)]
    scores = [f"{each.format(part=p, axis='p')}" for each in own for p in BODYPARTS]
    path = folder / "pair.csv"
    pd.concat(tables, axis=1).assign(**dict.fromkeys(scores, 1.0)).to_csv(path)
    asked = str(refused(None, read_landmarks, path))
    rows = read_landmarks(path, individuals=re.search("individuals='(.*?)'", asked)[1])
    expected = {"frame": list(np.repeat(range(N), 2)), "individual": [*who] * N}
    assert rows.frames[[*expected]].to_dict("list") == expected
    pair = np.stack([POINTS, POINTS + 300], axis=1)
    assert_array_equal(rows.points, pair.reshape(2 * N, -1))
    assert (rows.confidence == 1).all(axis=None)
    error = str(refused(None, told_of_fit, path, " ".join([*QUICK, "1"])))
    options = re.findall(r"use (--\w+ .*?)(?:\. |$)", error)
    assert len(options) == 2
    for option in options:
        begun(path, *shlex.split(option))
    return asked


FINGERS = ("thumb", "index", "middle", "ring", "pinky")
LEGS = ("coxa", "femur", "tibia", "tarsus", "claw")


def reads_all_parts(name, first, second):
    """Return whether all points of one body are read, if need be as advised."""
    parts = [name.format(a, b) for a, b in product([*first], [*second])]
    parts += [part.replace("L", "R") for part in parts if name[0] == "L"]
    table, options = table_of(PLAIN_NAME, np.ones((2, len(parts), 2)), parts), {}
    if name[:3] != "{1}" and isinstance(second, range) and len(second) > 6:
        told = str(refused("more than one set", landmark_table, table))
        options["columns"] = told.rpartition("such as ")[2].strip("'")
    return landmark_table(table, **options).points.shape == (2, 2 * len(parts))


FEW = [f"{part}_{mouse}" for mouse in "12" for part in BODYPARTS[:5]]
FEW = table_of(PLAIN_NAME, np.ones((2, len(FEW), 2)), FEW)


def test_a_body_at_a_desk_in_shares_is_warned_of_and_sized(tmp_path):
    tracks = make_body_tracks(N, random_state=0).data.reshape(N, 17, 2)
    tracks = tracks - tracks.min((0, 1))
    shares = tracks / tracks[..., 1].max() / 0.6 * [0.53, 0.95] + [0.2, 0.02]
    table, told = table_of("LM{part}_{axis}", shares, range(17)), "fractions of the w"
    path = files.saved(tmp_path / "pose.csv", table)
    text, plain = warnings_of(read_landmarks, path)
    assert told in text
    assert "format='mediapipe'" in text
    for camera in ("affine", "weak_perspective"):
        fit = clone(UNREFINED).set_params(camera=camera).fit
        text, _ = warnings_of(fit, plain.points.to_numpy())
        assert (told in text) == (camera != "affine")
    assert told not in warnings_of(fit, plain.points)[0]  # which was told before
    for columns in ({}, {"columns": "LM#_x,LM#_y"}):
        size = {"format": "mediapipe", "image_size": (1280, 720)}
        text, found = warnings_of(read_landmarks, path, **size, **columns)
        assert not text
        assert_allclose(files.tracks_of(found), shares * [1280, 720])


def test_shares_of_annotations_are_warned_of_with_a_way_that_works(tmp_path):
    tracks = make_body_tracks(N, random_state=0).data.reshape(N, 17, 2)
    shares = (tracks - tracks.min((0, 1))) / np.ptp(tracks, axis=(0, 1)) * 0.8 + 0.1
    content = files.coco_annotations(shares, names=map(str, range(17)))
    path = files.write_json(tmp_path / "a.json", content)
    text, landmarks = warnings_of(read_landmarks, path)
    assert "If they have another unit, such as metres, ignore this" in text
    assert "mediapipe" not in text
    line = re.search("In Python: (.*?), and", text)[1]
    exec(line.replace("WIDTH, HEIGHT", "640, 480"), scope := {"landmarks": landmarks})
    assert_allclose(scope["points"], (shares * [640, 480]).reshape(N, -1))


def test_times_in_names_of_images_are_told(tmp_path, begins):
    times = pd.Series(pd.date_range("2023-05-01 12:00:30", periods=N, freq="2s"))
    names = times.dt.strftime("%Y-%m-%d_%H-%M-%S.png")
    table = table_of(PLAIN_NAME, POINTS).assign(image=names)
    path = files.saved(tmp_path / "a.csv", table)
    form = "use (--time .*) with a (--.*), such as (.*?),"
    option, *form = re.search(form, begins(path, "--fps", 25)).groups()
    begins(path, *option.split(), *form)


LISTS = "keypoints foot_kpts face_kpts lefthand_kpts righthand_kpts".split()
PARTS = {"body": (0, 17), "feet": (17, 23), "face": (23, 91)}
PARTS |= {"left_hand": (91, 112), "right_hand": (112, 133), "all": (0, 133)}
BODIES = files.scene(4, 133, 7)


def whole_bodies(folder, lists=LISTS):
    """Return results, or annotations with lists of the points of each part."""
    places = [*PARTS.values()][:5] if lists is LISTS else [PARTS["all"]]
    rows = []
    for i, points in enumerate(np.dstack([BODIES, np.ones((4, 133))])):
        values = [points[slice(*place)].ravel().tolist() for place in places]
        rows.append(dict(zip(lists, values, strict=True)) | {"image_id": i})
    images = [{"id": i} for i in range(4)]
    content = {"images": images, "annotations": rows} if lists is LISTS else rows
    return files.write_json(folder / "a.json", content)


def is_read(folder, part, *lists):
    """Return whether the points of a part of whole bodies are read."""
    found = read_landmarks(whole_bodies(folder, *lists), part=part).points.to_numpy()
    return np.array_equal(found, BODIES[:, slice(*PARTS[part])].reshape(4, -1))


def categories(folder, known=1):
    """Return annotations of which three have another category."""
    content = files.coco_annotations(TRACKS)
    for entry in content["annotations"][::5]:
        entry["category_id"] = 4
    content["categories"][0]["id"] = known
    return files.write_json(folder / "a.json", content)


@pytest.mark.parametrize("kind", ["track_id", "name", "idx", "person_id"])
def test_who_is_who_is_a_column_of_images_in_their_order(tmp_path, kind):
    who, path = [5, 6, 7] * 4, tmp_path / "a.json"
    content = files.coco_annotations(TRACKS)
    for row, each in zip(content["annotations"], who, strict=True):
        row |= {kind: each} if kind == "track_id" else {"attributes": {kind: each}}
    if kind == "idx":  # results of AlphaPose, in the order of texts
        known = [{"image_id": f"{i}.jpg", kind: [w]} for i, w in enumerate(who)]
        content = [a | b for a, b in zip(files.RESULTS, known, strict=True)]
        content.sort(key=lambda row: row["image_id"])
    if kind == "person_id":  # OpenPose
        (path := tmp_path / "people").mkdir()
        for i, (row, each) in enumerate(zip(files.SCORED, who, strict=True)):
            person = files.openpose_person(pose=row) | {kind: [each]}
            files.write_json(path / f"cam01.{i}.json", {"people": [person]})
    else:
        files.write_json(path, content)
    found = read_landmarks(path)
    assert list(found.frames[kind]) == who
    assert_array_equal(found.points, FLAT)


def of_version(name, wrap, nobody=None):
    """Return the points of a result of MediaPipe, which is followed by an empty one."""
    points = [SimpleNamespace(x=x, y=y, visibility=0.5) for x, y in TRACKS[0] / 500]
    results = [SimpleNamespace(**{name: each}) for each in (wrap(points), nobody)]
    results[0].handedness = [[SimpleNamespace(category_name="Left")]]
    found = from_mediapipe(results, (500, 500))
    assert list(found.failed) == [False, True]
    if name == "hand_landmarks":
        assert list(found.frames["handedness"].fillna("")) == ["Left", ""]
    results[0].hand_landmarks, results[0].face_landmarks = vars(results[0])[name], []
    told = refused("results have .*got part=None", from_mediapipe, results, (5, 5))
    assert re.search("part='(.*?)'", str(told))[1] in ("face", "hand", "pose")
    from_mediapipe(results, (500, 500), part="hand")
    refused("got part='body'", from_mediapipe, results, (5, 5), "body")
    return found.points.iloc[0]


NAMES = {"{part}_{axis}": ("p", "visibility"), "{part}.{axis}": ("score",)}
NAMES |= {"p{part}_{axis}": ("conf",), "{axis}{part}": ("c",)}
NAMES |= {"joint {part}.{axis}": ("Likelihood",)}
NAMES = [(name, word) for name, words in NAMES.items() for word in words]


@pytest.mark.parametrize(("name", "word"), NAMES)
def test_confidences_are_read_beside_sizes(tmp_path, begins, name, word):
    parts = BODYPARTS if name[:5] == "{part" else range(8)
    score = np.random.default_rng(0).uniform(0.2, 1.0, (N, 8))
    scores = pd.DataFrame(
        score, columns=[name.format(part=p, axis=word) for p in parts]
    )
    table = table_of(name, POINTS / 1000, parts).join(scores)
    path = files.saved(tmp_path / "a.csv", table.assign(**{"instance.score": 0.5}))
    sizes = {"format": "mediapipe", "image_size": (1000, 1000)}
    found = read_landmarks(path, min_confidence=0.5, **sizes)
    assert_array_equal(found.confidence, score)
    expected = np.where(score[..., None] < 0.5, np.nan, POINTS)
    assert_allclose(files.tracks_of(found), expected)
    assert list(found.frames) == ["instance.score"]
    if word == "p":
        options = ["--image-size", "1000x1000", "--format", "mediapipe"]
        told = re.search(r"(\S+) % of .* with (--min.*)", begins(path, *options))
        assert told[1] == f"{100 * (score < 0.6).mean():.3g}"
        assert begins(path, *options, *told[2].split()) == ""


def columns_beside(folder, word, numbers):
    """Return the path of a table with further columns of each point."""
    table = table_of("{axis}_{part}", POINTS, range(8))
    values = np.resize(np.float64(numbers.split()), (N, 8))
    columns = {f"{word}_{j}": values[:, j] for j in range(8)}
    return files.saved(folder / "a.csv", table.assign(**columns))


def labelled(xy, **known):
    """Return an instance of sleap-io; one with a score is a prediction."""

    def numpy(scores=False):
        return np.column_stack([xy, np.full(8, 0.5)]) if scores else xy

    skeleton = SimpleNamespace(node_names=BODYPARTS, edge_names=[("snout", "neck")])
    return SimpleNamespace(numpy=numpy, skeleton=skeleton, **known)


def test_labels_of_sleap_io():
    a, b = (SimpleNamespace(name=name) for name in "ab")
    seen = [labelled(TRACKS[i], track=t, score=0.9) for i, t in enumerate((a, b, a))]
    seen.append(labelled(TRACKS[3], track=None, from_predicted=seen[2]))
    frames, video = [], SimpleNamespace(filename="m.mp4")
    for at, each in ((9, seen[2:]), (2, seen[:2]), (4, [])):
        frames.append(SimpleNamespace(video=video, frame_idx=at, instances=each))
    found = from_sleap_io(frames)
    assert list(found.frames["frame"]) == [2, 2, 4, 9]
    assert list(found.frames["individual"].fillna("")) == ["a", "b", "", ""]
    assert_array_equal(found.points, [FLAT[0], FLAT[1], FLAT[0] * np.nan, FLAT[3]])
    assert list(found.confidence["snout"].fillna(-1)) == [0.5, 0.5, -1, -1]
    assert found.skeleton.edges.tolist() == [[0, 3]]
    seen[0].skeleton.node_names = ["a"]
    refused("instances of one skeleton; got ", from_sleap_io, frames)


def specimens(folder, points="LM=8"):
    """Return a file of specimens, one of which has a curve, and their points."""
    path = files.write_tps(folder / "a.tps", TRACKS)
    text = path.read_text().replace("ID=3", "CURVES=1\nPOINTS=1\n1 1\nID=3")
    path.write_text(text.replace("LM=8", points))
    return path


OTHERS = {"age": np.arange(N), "who": ["anna", "bob"] * (N // 2)}
OTHERS["day"] = [f"0{1 + i % 9}.02.20{10 + i}" for i in range(N)]
OTHERS["team"] = ["a", "b", "", "a"] * (N // 4)
PLAIN = table_of(PLAIN_NAME, POINTS).assign(**OTHERS)
VIDEOS = PLAIN.assign(image=[f"v{i // 2}.png" for i in range(N)])
SETS = PLAIN.join(table_of("{axis}_{part}", POINTS[:, :7] / 2, range(7)))


def option_named(folder, table, options, pattern, advised):
    """Return the message about options; those that it names work."""
    path, given = folder / "a.csv", options.replace("no_edges.csv", f"{folder}/no.csv")
    (folder / "no.csv").write_text("\n")
    if "--image-size" in options:
        table = table.assign(**table.filter(regex="_[xy]$") / 1000)
    table.to_csv(path, index=False)
    error = str(refused(None, told_of_fit, path, f"{' '.join(QUICK)} 1 {given}"))
    begun(path, *shlex.split(advised.format(*re.search(pattern, error).groups())))
    return error


def test_individuals_of_a_fit_are_named_to_transform(tmp_path, fits, fails, transforms):
    tables = [table_of(f"{{part}}_{who}_{{axis}}", POINTS + 9 * who) for who in (1, 2)]
    path = files.saved(tmp_path / "a.csv", pd.concat(tables, axis=1))
    model = fits(path, *QUICK, "1", "--individuals", "1,2").path
    told = fails("transform", model, path, "-o", tmp_path / "b.csv")
    option = re.search("in one row: (.*)", told)[1].split()
    assert len(transforms(model, path, *option)[0]) == 2 * N


def points_as_advised(table):
    """Return the points of a table, if need be with the columns that are advised."""
    try:
        return landmark_table(table).points.to_numpy()
    except ValueError as error:
        columns = re.search("columns(?:=|, such as )'(.*?)'", str(error))[1]
        return landmark_table(table, columns=columns).points.to_numpy()


def boxed(name, box):
    """Return a table of points and of boxes around them."""
    return table_of(name, TRACKS).assign(**dict.fromkeys(box.split(), 5.0))


def crowd(folder):
    """Return two persons in an image, and an image of nobody, of MMPose."""
    people = files.VIDEO[0]["instances"] * 2
    content = [
        {"frame_id": i, "instances": each} for i, each in enumerate([people, []])
    ]
    return files.write_json(folder / "a.json", content)


LETTERS = files.scene(2, 26)  # also w and h
test_refusals = refusals_of("tables_as_people_have_them", globals())
