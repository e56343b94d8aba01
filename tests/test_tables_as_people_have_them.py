"""Files as trackers and people have them: what is read, and advice that is followed."""

import re
import shlex
import warnings
from types import SimpleNamespace

import landmark_files as files
import numpy as np
import pandas as pd
import pytest
from fit_runs import QUICK
from landmark_files import BODYPARTS, FRAME, TRACKS
from numpy.testing import assert_allclose, assert_array_equal
from refusals import refused, warned

from isa_nrsfm import AffineNRSfM
from isa_nrsfm.cli._times import image_numbers
from isa_nrsfm.datasets import make_body_tracks, make_nonrigid_tracks
from isa_nrsfm.io import from_mediapipe, from_sleap_io, landmark_table, read_landmarks

N = 40
SCENE = make_nonrigid_tracks(N, 8, 1, noise=0.01, random_state=0).data
POINTS = (100 * SCENE + 400).round(2).reshape(N, 8, 2)


def table_of(name, tracks, parts=BODYPARTS, **further):
    """Return a table of points under names such as "{part}_{axis}"."""
    pairs = [
        (j, part, k, a) for j, part in enumerate(parts) for k, a in enumerate("xy")
    ]
    columns = {name.format(part=p, axis=a): tracks[:, j, k] for j, p, k, a in pairs}
    return pd.DataFrame(columns | further)


def pair_of(name, who):
    """Return a table of two animals in each row, with confidences."""
    tables = []
    for i, each in enumerate(who):
        own = name.replace("{who}", each)
        score = table_of(
            own.replace("{axis}", "p"), POINTS[..., :1].repeat(2, 2) * 0 + 1
        )
        tables += [table_of(own, POINTS + 300 * i), score]
    return pd.concat(tables, axis=1)


@pytest.mark.parametrize(
    ("name", "who"),
    [
        ("{part}_{who}_{axis}", "12"),  # SimBA
        ("{who}.{part}.{axis}", ("inst0", "inst1")),  # sleap-io
        ("net_{who}_{part}_{axis}", ("resident", "intruder")),  # levels of DeepLabCut
        ("{part}_{who}_{axis}", ("cam1", "cam2")),  # DLTdv
        ("{who}{part} {axis}", "12"),
    ],
)
def test_individuals_in_one_row_are_a_question_with_both_answers(
    tmp_path, fits, name, who
):
    path = tmp_path / "pair.csv"
    pair_of(name, who).to_csv(path, index=False)
    told = str(refused("several individuals in one row", read_landmarks, path))
    rows = read_landmarks(path, individuals=re.search("individuals='(.*?)'", told)[1])
    assert list(rows.frames["individual"]) == [*who] * N
    assert list(rows.frames["frame"]) == list(np.repeat(range(N), 2))
    assert_array_equal(rows.points[0::2], POINTS.reshape(N, -1))
    assert_array_equal(rows.points[1::2], POINTS.reshape(N, -1) + 300)
    assert (rows.confidence == 1).all(axis=None)
    one = read_landmarks(path, columns=re.search("columns='(.*?)'", told)[1])
    assert len(one.point_names) == 16
    options = re.findall(r"command line: (--\w+ .*?)\)", told)
    for option, n_frames in zip(options, (2 * N, N), strict=True):
        out = fits(path, *QUICK, "1", *shlex.split(option)).out
        assert f"fitted to {n_frames} frames" in out


def test_parts_of_one_body_are_no_individuals():
    hand = ["wrist", *(f"{f}_{j}" for f in ("thumb", "index", "ring") for j in "1234")]
    sides = [f"{side}_{part}" for side in ("left", "right") for part in BODYPARTS]
    legs = [f"leg{i}_{part}" for i in range(6) for part in ("hip", "knee", "foot")]
    for parts in (hand, sides, legs):
        table = table_of("{part}_{axis}", np.ones((2, len(parts), 2)), parts)
        assert landmark_table(table).points.shape == (2, 2 * len(parts))
    few = [f"{part}_{mouse}" for mouse in "12" for part in BODYPARTS[:5]]
    table = table_of("{part}_{axis}", np.ones((2, 10, 2)), few)
    told = str(refused("Their 5 points are too few", landmark_table, table))
    pattern = re.search("columns='(.*?)'", told)[1]
    assert landmark_table(table, columns=pattern).points.shape == (2, 20)
    refused("same names but for 1, 3", landmark_table, table, individuals="1,3")


def warnings_of(call, *args, **kwargs):
    """Return the texts of the warnings of a call, and its result."""
    with warnings.catch_warnings(record=True, action="always") as caught:
        found = call(*args, **kwargs)
    return " ".join(str(each.message) for each in caught), found


@pytest.mark.parametrize("seen", [1.0, 0.6, 0.3])
def test_a_body_at_a_desk_in_shares_is_warned_of_and_sized(tmp_path, seen):
    tracks = make_body_tracks(N, random_state=0).data.reshape(N, 17, 2)
    tracks = tracks - tracks.min((0, 1))
    shares = tracks / tracks[..., 1].max() / seen * [0.53, 0.95] + [0.2, 0.02]
    path, told = tmp_path / "pose.csv", "like shares of the width and height"
    table_of("LM{part}_{axis}", shares, range(17)).to_csv(path, index=False)
    text, plain = warnings_of(read_landmarks, path)
    assert told in text
    for camera in ("affine", "weak_perspective"):
        text, _ = warnings_of(AffineNRSfM(1, camera=camera).fit, plain.points)
        assert (told in text) == (camera != "affine")
    for columns in ({}, {"columns": "LM#_x,LM#_y"}):
        size = {"format": "mediapipe", "image_size": (1280, 720)}
        text, found = warnings_of(read_landmarks, path, **size, **columns)
        outside = (shares > 1).any(axis=2).sum()
        assert (f"{outside} of {17 * N} points are outside" in text) == (outside > 0)
        points = found.points.to_numpy().reshape(shares.shape)
        assert_allclose(points, shares * [1280, 720])


@pytest.mark.parametrize("code", [(0, 0), (-1, -1), (-1280, -720), (-310, -205)])
def test_codes_of_missing_points_in_python(tmp_path, code):
    tracks, hidden = POINTS.copy(), np.random.default_rng(1).random((N, 8)) < 0.1
    tracks[hidden] = code
    table = table_of("{part}_{axis}", tracks)
    table.to_csv(tmp_path / "a.csv", index=False)
    told = f"exactly ({code[0]}, {code[1]}) ({hidden.sum()} in all)"
    for call, X in (
        (read_landmarks, tmp_path / "a.csv"),
        (AffineNRSfM(1, refinement=None).fit, table.to_numpy()),
    ):
        text, _ = warnings_of(call, X)
        assert told in text
    assert ("make them NaN before coordinates are shifted" in text) == (code[0] < -1)
    tracks[hidden] = np.nan  # as advised
    text, _ = warnings_of(AffineNRSfM(1, refinement=None).fit, tracks.reshape(N, -1))
    assert "exactly" not in text


@pytest.mark.parametrize(
    ("names", "numbers"),
    [
        (["labeled-data/v/img0010.png", "labeled-data/v/img0030.png"], [10, 30]),
        (["0.jpg", "10.jpg", "2.jpg"], [0, 10, 2]),
        (["v1_7_x2.png", "v1_9_x2.png", "v1_30_x2.png"], [7, 9, 30]),
        (["a/1.png", "a/5.png", "b/1.png", "b/5.png"], [1, 5, 1, 5]),
        (["e3a1.png", "77b0.png", "0c9d.png"], [0, 1, 2]),  # no numbers of frames
        (["anna.png", "bob.png", "anna.png"], [0, 1, 0]),
    ],
)
@pytest.mark.parametrize("column", ["image", "file_name", "Image Path"])
def test_numbers_in_names_are_those_of_frames(names, numbers, column):
    if (column == "file_name" and "e3a1.png" in names) or "bob.png" in names:
        column = "image"  # others count rows
    assert list(image_numbers(pd.DataFrame({column: names}))) == numbers


def annotations(**further):
    """Return annotations of two people in ten images, with other entries."""
    content = files.coco_annotations(TRACKS[:10], image=[*range(5)] * 2)
    for i, entry in enumerate(content["annotations"]):
        entry |= {name: values[i] for name, values in further.items()}
    return content


WHO = [5, 6] * 5
SIZES = {
    "body": 17,
    "feet": 6,
    "face": 68,
    "left_hand": 21,
    "right_hand": 21,
    "all": 133,
}
LISTS = ("keypoints", "foot_kpts", "face_kpts", "lefthand_kpts", "righthand_kpts")
BODIES = files.scene(4, 133, 7)


def whole_bodies(lists):
    """Return annotations or results of whole bodies, in one list or several."""
    borders = [0, 17, 23, 91, 112, 133] if lists else [0, 133]
    rows = []
    for i, points in enumerate(np.dstack([BODIES, np.ones((4, 133))])):
        each = {"image_id": i, "category_id": 1}
        for name, first, last in zip(LISTS, borders, borders[1:], strict=False):
            each[name] = points[first:last].ravel().tolist()
        rows.append(each)
    images = [{"id": i} for i in range(4)]
    return {"images": images, "annotations": rows} if lists else rows


@pytest.mark.parametrize("lists", [True, False])
@pytest.mark.parametrize("part", SIZES)
def test_parts_of_whole_bodies(tmp_path, lists, part):
    path = files.write_json(tmp_path / "a.json", whole_bodies(lists))
    found = read_landmarks(path, part=part)
    first = {"feet": 17, "face": 23, "left_hand": 91, "right_hand": 112}.get(part, 0)
    expected = BODIES[:, first : first + SIZES[part]]
    assert_array_equal(found.points.to_numpy().reshape(expected.shape), expected)
    if lists:
        told = (
            "those in foot_kpts, face_kpts, .* choose with part, one of body, .*--part"
        )
        assert len(warned(told, read_landmarks, path).point_names) == 17
    refused("'nose' is none of body, ", read_landmarks, path, part="nose")


@pytest.mark.parametrize("category", [{"keypoints": []}, {}, None])
def test_keypoints_without_names_and_of_other_categories(tmp_path, category):
    content = files.coco_annotations(TRACKS)
    content["categories"] = [] if category is None else [{"id": 1} | category]
    path = files.write_json(tmp_path / "a.json", content)
    found = read_landmarks(path)
    assert_array_equal(found.points, TRACKS.reshape(12, -1))
    assert list(found.points)[:2] == ["x_0", "y_0"]
    content = files.coco_annotations(TRACKS)
    for entry in content["annotations"][::5]:
        entry["category_id"] = 4
    files.write_json(path, content)
    told = "3 annotations are of the category 4, which names no keypoints"
    assert warned(told, read_landmarks, path).failed.sum() == 3
    content["categories"][0]["id"] = 7
    refused(
        "12 annotations are of the category 4, 1",
        read_landmarks,
        files.write_json(path, content),
    )


def openpose_people(folder):
    people = [[files.openpose_person(pose=row)] for row in files.SCORED]
    for persons, who in zip(people, [*WHO, 5, 6], strict=True):
        persons[0]["person_id"] = [who]
    files.write_openpose(folder / "a", people)
    for i, path in enumerate(sorted((folder / "a").iterdir())):
        path.rename(folder / "a" / f"cam01.{i:04d}.json")
    return folder / "a"


@pytest.mark.parametrize(
    ("write", "column", "expected"),
    [
        (
            lambda d: files.write_json(d / "a.json", annotations(track_id=WHO)),
            "track_id",
            5,
        ),
        (
            lambda d: files.write_json(
                d / "a.json", annotations(attributes=[{"track_id": i} for i in WHO])
            ),
            "track_id",
            5,
        ),
        (
            lambda d: files.write_json(
                d / "a.json",
                [
                    r | {"idx": [float(w)]}
                    for r, w in zip(files.RESULTS, WHO, strict=False)
                ],
            ),
            "idx",
            5,
        ),
        (openpose_people, "person_id", 6),
    ],
)
def test_who_is_who_is_a_column(tmp_path, write, column, expected):
    found = read_landmarks(write(tmp_path))
    assert list(found.frames[column]).count(5) == expected
    assert set(found.frames[column]) == {5, 6}
    assert list(found.points.iloc[0]) == list(TRACKS[0].ravel())


def test_images_are_in_the_order_of_their_numbers(tmp_path):
    rows = [r | {"image_id": f"{i}.jpg"} for i, r in enumerate(files.RESULTS)]
    rows.sort(key=lambda row: row["image_id"])
    found = read_landmarks(files.write_json(tmp_path / "a.json", rows))
    assert_array_equal(found.points, TRACKS.reshape(12, -1))


def result_of(shape, *parts):
    """Return a result of MediaPipe, of points as lists or as messages."""
    points = [SimpleNamespace(x=x, y=y, visibility=0.5) for x, y in TRACKS[0] / 500]
    made = {"list": points, "lists": [points], "none": None, "empty": []}
    made["message"] = SimpleNamespace(landmark=points)
    made["messages"] = [made["message"]]
    return SimpleNamespace(**dict.fromkeys(parts, made[shape]))


@pytest.mark.parametrize(
    ("name", "shape"),
    [
        ("pose_landmarks", "message"),  # mp.solutions.pose
        ("multi_face_landmarks", "messages"),  # mp.solutions.face_mesh
        ("left_hand_landmarks", "list"),  # HolisticLandmarker
        ("hand_landmarks", "lists"),
    ],
)
def test_results_of_all_versions_of_mediapipe(name, shape):
    nobody = "none" if shape.startswith("message") else "empty"
    results = [result_of(shape, name), result_of(nobody, name)]
    for side in ("Left", "Right"):
        results[0].handedness = [[SimpleNamespace(category_name=side)]]
        found = from_mediapipe(results, (500, 500))
        assert_allclose(found.points.iloc[0], TRACKS[0].ravel())
        assert list(found.failed) == [False, True]
        if name == "hand_landmarks":
            assert list(found.frames["handedness"].fillna("")) == [side, ""]
    results[0].hand_landmarks, results[0].face_landmarks = results[0].__dict__[name], []
    told = str(refused("results have ", from_mediapipe, results, (500, 500)))
    assert re.search("such as part='(.*?)'", told)[1] in ("face", "hand", "pose")
    from_mediapipe(results, (500, 500), part="hand")
    refused("got part='body'", from_mediapipe, results, (5, 5), "body")


@pytest.mark.parametrize("word", ["p", "prob", "Likelihood", "v", "visibility"])
@pytest.mark.parametrize("format", ["table", "mediapipe"])
def test_confidences_are_read_beside_sizes(tmp_path, fits, word, format):
    score = np.random.default_rng(0).uniform(0.2, 1.0, (N, 8))
    scores = {f"{part}_{word}": score[:, j] for j, part in enumerate(BODYPARTS)}
    size = {"image_size": (1000, 1000)} if format == "mediapipe" else {}
    scale = 1000 if size else 1
    table = table_of("{part}_{axis}", POINTS / scale).assign(**scores)
    path = tmp_path / "a.csv"
    table.to_csv(path, index=False)
    found = read_landmarks(path, format, min_confidence=0.5, **size)
    assert_allclose(found.confidence, score)
    lost = found.points.isna().to_numpy()[:, ::2]
    assert_array_equal(lost, score < 0.5)
    assert not {*scores} & {*found.frames}
    if word == "p":
        options = ["--format", format, *(["--image-size", "1000x1000"] if size else [])]
        err = fits(path, *QUICK, "1", *options).err
        told, option = re.search(
            r"(\d+) % of the points .* with (--min.*)", err
        ).groups()
        assert int(told) == round(100 * (score < 0.6).mean())
        assert fits(path, *QUICK, "1", *options, *option.split()).err == ""


@pytest.mark.parametrize("index", [True, False])
@pytest.mark.parametrize("levels", ["one line", "no scorer", "of many"])
def test_deeplabcut_saved_again(tmp_path, levels, index):
    path = files.write_deeplabcut(tmp_path / "a.csv", FRAME)
    if levels == "one line":
        pd.read_csv(path).to_csv(path, index=index)
    else:
        names = {"scorer": "individuals"} if levels == "of many" else {}
        frame = FRAME.rename_axis(columns=names)
        frame = frame if names else frame.droplevel("scorer", axis=1)
        files.write_deeplabcut(path, frame)
    found = read_landmarks(path)
    assert found.format == "deeplabcut"
    assert_allclose(found.points, TRACKS.reshape(12, -1))
    assert list(found.frames["frame"]) == list(range(12))


class Labelled(SimpleNamespace):
    """An instance of sleap-io: points, and scores if it is a prediction."""

    def numpy(self, scores=False):
        return np.column_stack([self.xy, *[self.xy[:, 0] * 0 + 0.5] * scores])


def test_labels_of_sleap_io():
    skeleton = SimpleNamespace(node_names=BODYPARTS, edge_names=[("snout", "neck")])
    video = SimpleNamespace(filename="mice.mp4")
    frames = []
    for t in (9, 2):
        tracks = [SimpleNamespace(name=name) for name in "ab"]
        made = [
            Labelled(xy=TRACKS[t] + k, track=track, score=0.9, skeleton=skeleton)
            for k, track in enumerate(tracks)
        ]
        hand = {"xy": TRACKS[t] + 5, "track": None, "skeleton": skeleton}
        made += [Labelled(from_predicted=made[0], **hand)] if t == 9 else []
        frames.append(SimpleNamespace(video=video, frame_idx=t, instances=made))
    frames.append(SimpleNamespace(video=video, frame_idx=4, instances=[]))
    found = from_sleap_io(frames)
    assert list(found.frames["frame"]) == [2, 2, 4, 9, 9]
    assert list(found.frames["individual"].fillna("")) == ["a", "b", "", "b", ""]
    expected = [
        TRACKS[2],
        TRACKS[2] + 1,
        TRACKS[2] * np.nan,
        TRACKS[9] + 1,
        TRACKS[9] + 5,
    ]
    assert_array_equal(found.points, np.reshape(expected, (5, -1)))
    assert list(found.confidence["snout"].fillna(-1)) == [0.5, 0.5, -1, 0.5, -1]
    assert found.skeleton.edges.tolist() == [[0, 3]]
    other = SimpleNamespace(node_names=["a"], edge_names=[])
    frames[1].instances[0].skeleton = other
    for labels in (frames, [], [3], 3):
        refused("instances of one skeleton; got ", from_sleap_io, labels)


@pytest.mark.parametrize(
    ("content", "frames", "n_rows"),
    [
        ({"instance_info": files.VIDEO, "meta_info": {}}, range(12), 12),
        ({"predictions": [[files.mmpose(files.SCORED[0])], []]}, [0, 1], 2),
        (
            [{"frame_id": 5, "instances": [files.mmpose(files.SCORED[0])] * 3}],
            [5] * 3,
            3,
        ),
    ],
)
def test_predictions_of_mmpose(tmp_path, content, frames, n_rows):
    found = read_landmarks(files.write_json(tmp_path / "a.json", content), "mmpose")
    assert list(found.frames["frame"]) == list(frames)
    assert_array_equal(found.points.iloc[0], TRACKS[0].ravel())
    assert list(found.failed) == [False, *[len(frames) == 2] * (n_rows - 1)]
    assert (found.confidence.dropna() == 0.7).all(axis=None)


def test_specimens_of_tps(tmp_path):
    path = files.write_tps(tmp_path / "a.tps", TRACKS)
    text = path.read_text().replace(
        "IMAGE=skull 3", "CURVES=1\nPOINTS=1\n1 1\nIMAGE=skull 3"
    )
    path.write_text(text)
    found = warned("1 points of curves are left out", read_landmarks, path)
    assert list(found.frames["image"][:2]) == ["skull 0.jpg", "skull 1.jpg"]
    assert set(found.frames["scale"]) == {"0.05"}
    for wrong, message in (("LM3=8", "expected LM="), ("LM=9", "specimen 0 .*'IMAGE")):
        path.write_text(text.replace("LM=8", wrong))
        refused(message, read_landmarks, path, "tps")
    path.write_text(text.replace("LM=8", "LM=7"))
    refused("there are more than 7 landmarks", read_landmarks, path)


@pytest.mark.parametrize(
    ("point", "keys"),
    [
        ("landmark_index", ["frame"]),
        ("bodypart", ["video", "t"]),
        ("id", ["hand", "Frame"]),
    ],
)
def test_the_recipe_for_a_row_a_point_has_the_columns_of_the_table(point, keys):
    rows = [(i, j, *TRACKS[i, j]) for i in range(12) for j in range(8)]
    table = pd.DataFrame(rows, columns=[keys[-1], point, "x", "y"]).assign(score=0.5)
    if len(keys) > 1:
        both = [table.assign(**{keys[0]: name}) for name in "ab"]
        table = pd.concat(both, ignore_index=True)
    told = str(refused("one row for each point", landmark_table, table))
    scope = {"table": table}
    for line in told.partition("In pandas: ")[2].split(", and "):
        exec(line, scope)
    points, other = landmark_table(scope["wide"])
    assert_array_equal(points.iloc[:: len(keys)], TRACKS.reshape(12, -1))
    assert {*other} == {*keys}


@pytest.mark.parametrize("box", ["x y w h", "bbox_x bbox_y bbox_w bbox_h"])
def test_corners_of_boxes_are_no_points(box):
    corner = dict.fromkeys(box.split(), 5.0)
    for name in ("{part}_{axis}", "{part}{axis}"):
        table = table_of(name, TRACKS).assign(**corner)
        options = {}
        if name == "{part}{axis}":
            told = str(refused("--columns", landmark_table, table))
            options = {"columns": told.rpartition("such as ")[2].strip("'")}
        found = landmark_table(table, **options)
        assert_array_equal(found.points, TRACKS.reshape(12, -1))
