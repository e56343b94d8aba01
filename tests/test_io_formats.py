"""Files of other programs, read back as these have written them."""

import re
from pathlib import Path
from tempfile import TemporaryDirectory
from types import SimpleNamespace

import landmark_files as files
import numpy as np
import pandas as pd
import pytest
from landmark_files import EXPECTED, FRAME, TRACKS, WFLW, WRITERS, tracks_of
from made_once import made_once
from numpy.testing import assert_allclose, assert_array_equal
from refusals import refusals_of, refused, warned

from isa_nrsfm.io import (
    FORMATS,
    find_format,
    from_mediapipe,
    from_movement,
    read_landmarks,
)
from isa_nrsfm.skeletons import get_skeleton  # noqa: F401  in refusals.txt


@pytest.mark.parametrize("name", WRITERS)
@pytest.mark.filterwarnings("ignore:the array", "ignore:.*fractions of the width")
@pytest.mark.filterwarnings("default")  # tables of HDF5 files stay open
def test_files_read_back_as_they_were_written(name, tmp_path):
    path, format = WRITERS[name](tmp_path), name.partition("-")[0]
    assert find_format(path) == format
    landmarks = read_landmarks(path)
    assert landmarks.format == format
    assert_allclose(tracks_of(landmarks), EXPECTED.get(name, TRACKS), rtol=1e-12)
    assert not landmarks.failed.any()
    if name == format and name != "table":
        again = FORMATS[format].read(path)
        pd.testing.assert_frame_equal(again.points, landmarks.points)
        if path.is_dir():
            path = min(file for file in path.iterdir() if file.suffix != ".png")
        others = sorted({*FORMATS} - {format, "mediapipe", "table"})
        refused(str(path), read_landmarks, path, others[len(name) % len(others)])


def test_every_format_is_written_here_and_described():
    assert {name.partition("-")[0] for name in WRITERS} == set(FORMATS)
    page = Path(__file__).parents[1] / "docs" / "formats.md"
    assert set(re.findall(r"^\| `(\w+)` \|", page.read_text(), re.M)) == set(FORMATS)
    assert all(name == found.name for name, found in FORMATS.items())
    with pytest.raises(TypeError):
        FORMATS["new"] = FORMATS["table"]


SUCCESS = np.array([1, 0, *[1] * 10])
CONFIDENCE = np.linspace(0, 1, 12).round(2)


@made_once
def in_folder(read, **options):
    """Return what a function returns that writes into a new folder, and reads."""
    with TemporaryDirectory() as folder:
        return read(Path(folder), **options)


@made_once
def openface_text():
    """Return a table of OpenFace."""
    with TemporaryDirectory() as folder:
        return files.write_openface(Path(folder, "a.csv"), TRACKS).read_text()


def openface(folder, **options):
    """Read a table of OpenFace with infinite numbers in the row that failed."""
    known = {"success": SUCCESS, "confidence": CONFIDENCE}
    path = files.write_openface(folder / "a.csv", TRACKS, **known)
    lines = path.read_text().splitlines()
    for number, text in ((TRACKS[1, 2, 0], "inf"), (TRACKS[1, 3, 0], "-nan(ind)")):
        assert f",{number}," in lines[2]
        lines[2] = lines[2].replace(f",{number},", f",{text},")
    return read_landmarks(files.write_text(path, *lines), **options)


# The third of twelve faces is not found.
HIDDEN = np.where(np.arange(12)[:, None, None] == 3, np.nan, TRACKS)


def pyfeat(folder, detector, **options):
    path = files.write_pyfeat(folder / "a.csv", HIDDEN, detector=detector)
    return read_landmarks(path, **options)


def lost(landmarks):
    """Return the rows that show no point."""
    return list(np.flatnonzero(np.isnan(tracks_of(landmarks)).all(axis=(1, 2))))


def mesh(folder, tracks, **given):
    return files.write_mesh(folder / "a.csv", tracks, **given)


def images(folder):
    """Read files of points beside other files."""
    files.write_pts(folder / "faces", TRACKS)
    (folder / "faces" / "image_000.pts").rename(folder / "faces" / "last.PTS")
    (folder / "faces" / "._image_001.pts").write_text("not one")
    (folder / "faces" / "inner").mkdir()
    return read_landmarks(folder / "faces")


def points_of_openpose(n_points, confidence=0.5, seed=1):
    """Return x, y and confidence of some points."""
    return np.c_[files.scene(1, n_points, seed)[0], np.full(n_points, confidence)]


FIRST, SECOND = points_of_openpose(25), points_of_openpose(25, 0.25, seed=2)
FIRST[3] = 0
PEOPLE = np.stack([FIRST, np.full((25, 3), np.nan), SECOND, FIRST, SECOND])


def people(folder, photos=False):
    """Read one person, nobody, two, and one beside another who is not visible."""
    found = [[FIRST], [], [SECOND, FIRST], [np.zeros((25, 3)), SECOND]]
    found = [[files.openpose_person(pose=p) for p in persons] for persons in found]
    folder = files.write_openpose(folder / "json", found, first=9)
    (folder / "rendered.png").write_bytes(b"")
    (folder / "._video_000000000009_keypoints.json").write_text("not one")
    if photos:  # their names count in their order
        videos = sorted(folder.glob("video*.json"))
        for video, name in zip(videos, "abcd", strict=True):
            video.rename(folder / f"{name}_keypoints.json")
    return read_landmarks(folder)


PARTS = {"pose": 25, "face": 70, "hand_left": 21}
PARTS = {part: points_of_openpose(n) for part, n in PARTS.items()}


def parts(folder):
    """Return a folder of one person with points of several parts."""
    person = files.openpose_person(**PARTS, hand_right=np.zeros((21, 3)))
    return files.write_openpose(folder / "json", [[person]])


def wflw(folder):
    return read_landmarks(files.write_wflw(folder / "list.txt", WFLW)).frames


def pair_with_gaps():
    """Return two individuals, of whom frames 4 and 6 lack some, and the rows."""
    pair = np.stack([TRACKS, TRACKS + 100], axis=1)
    pair[4] = np.nan
    pair[6, 1] = np.nan
    rows = [(i, k) for i in range(12) for k in (0, 1) if (i, k) not in ((6, 1), (4, 1))]
    return pair, *map(list, zip(*rows, strict=True))


def assert_rows(landmarks, names):
    """Assert that landmarks are those of `pair_with_gaps`."""
    pair, frame, individual = pair_with_gaps()
    assert_allclose(tracks_of(landmarks), pair[frame, individual])
    expected = [names[k] for k in individual]
    expected[frame.index(4)] = ""
    assert list(landmarks.frames["individual"].fillna("")) == expected
    assert list(landmarks.frames["frame"]) == frame
    assert list(np.flatnonzero(landmarks.failed)) == [frame.index(4)]
    assert landmarks.point_names == tuple(files.BODYPARTS)
    assert list(landmarks.points)[:2] == ["snout_x", "snout_y"]


def test_deeplabcut_finds_each_animal(tmp_path):
    pair, frame, _ = pair_with_gaps()
    names = ["mouse 1", "mouse 2"]
    likelihood = np.linspace(0, 1, 12)
    table = files.deeplabcut_frame(pair, likelihood, individuals=names)
    landmarks = read_landmarks(files.write_deeplabcut(tmp_path / "a.csv", table))
    assert_rows(landmarks, names)
    assert_allclose(landmarks.confidence["snout"], likelihood[frame])


def test_deeplabcut_labels_have_images_and_no_likelihood(tmp_path):
    frame = files.deeplabcut_frame(TRACKS, None)
    names = [f"img{i:03d}.png" for i in range(12)]
    frame.iloc[3, :2] = np.nan
    expected = TRACKS.copy()
    expected[3, 0] = np.nan
    paths = [f"labeled-data/reach/{name}" for name in names]
    levels = pd.MultiIndex.from_product([["labeled-data"], ["reach"], names])
    for index in (pd.Index(paths), levels):
        frame.index = index
        landmarks = read_landmarks(files.write_deeplabcut(tmp_path / "a.csv", frame))
        assert_allclose(tracks_of(landmarks), expected)
        assert landmarks.confidence is None
        assert list(landmarks.frames) == ["image"]
        assert landmarks.frames["image"][0] == "labeled-data/reach/img000.png"
        h5 = files.write_deeplabcut(tmp_path / "a.h5", frame, how="fixed")
        found = read_landmarks(h5).frames
        pd.testing.assert_frame_equal(found, landmarks.frames, check_dtype=False)


def test_h5_files_run_no_code(tmp_path):
    h5py = pytest.importorskip("h5py", reason="needs the extra h5")
    path = files.write_deeplabcut(tmp_path / "a.h5", FRAME)
    with h5py.File(path, "a") as file:
        call = b"cbuiltins\nexec\n(Vraise SystemExit\ntR."
        file["df_with_missing/table"].attrs["values_block_0_kind"] = np.bytes_(call)
    refused("should be texts; pickled with GLOBAL", read_landmarks, path)


def test_deeplabcut_unique_points_are_left_out_with_a_warning(tmp_path):
    mouse = files.deeplabcut_frame(TRACKS, individuals=["mouse"])
    corner = {"bodyparts": ["corner"], "individuals": ["single"]}
    both = [mouse, files.deeplabcut_frame(TRACKS[:, :1], **corner)]
    both = pd.concat(both, axis=1)
    path = files.write_deeplabcut(tmp_path / "a.csv", both)
    landmarks = warned("points corner belong to no animal", read_landmarks, path)
    assert_allclose(tracks_of(landmarks), TRACKS)
    files.write_deeplabcut(path, both.rename(columns={"single": "mouse 2"}))
    refused("'mouse' and 'mouse 2' have different", read_landmarks, path)


@pytest.mark.parametrize(
    ("order", "named"), [("ftnx", True), ("nfxt", True), ("txnf", False)], ids=str
)
def test_sleap_axes_are_those_that_the_file_tells(order, named, tmp_path):
    pair, frame, track = pair_with_gaps()
    scores = np.random.default_rng(0).uniform(0, 1, pair.shape[:3])
    given = {"order": order, "named": named, "scores": scores}
    path = files.write_sleap(tmp_path / "a.analysis.h5", pair, **given)
    landmarks = read_landmarks(path)
    assert_rows(landmarks, "ab")
    assert_array_equal(landmarks.confidence, scores[frame, track])
    of_instances = scores.mean(axis=2)[frame, track]
    of_instances[frame.index(4)] = np.nan
    assert_allclose(landmarks.frames["instance_score"], of_instances)
    sure = read_landmarks(path, min_confidence=0.5)
    lost = np.isnan(pair[frame, track][..., 0]) | (scores[frame, track] < 0.5)
    assert_array_equal(np.isnan(tracks_of(sure)[..., 0]), lost)


def annotations(folder):
    """Read persons of images in another order, and an image without anybody."""
    tracks = HIDDEN.copy()
    tracks[1, 2] = np.nan
    content = files.coco_annotations(tracks, image=[7, 3, 3, 5] + [9] * 8)
    content["images"].append({"id": 11, "file_name": "empty.jpg"})
    content["annotations"].append({"id": 1, "image_id": 7, "category_id": 1})
    return read_landmarks(files.write_json(folder / "a.json", content))


def two_kinds(folder):
    """Return annotations of persons and of a hand."""
    content = files.coco_annotations(TRACKS)
    hand = {"id": 2, "name": "hand", "keypoints": ["wrist", "thumb"]}
    content["categories"].append(hand)
    seen = {"id": 5, "image_id": 2, "category_id": 2, "keypoints": [1, 2, 2, 3, 4, 1]}
    content["annotations"].append(seen)
    return files.write_json(folder / "a.json", content)


SCORED = np.dstack([TRACKS, np.linspace(0, 1, 96).reshape(12, 8)])
SCORED[0, 0] = 0


def results(folder, category=1):
    """Read results of which one has another category."""
    content = [
        {"image_id": f"{i}.jpg", "category_id": 1, "keypoints": row, "score": 0.5}
        for i, row in enumerate(SCORED.reshape(12, -1).tolist())
    ]
    content[3]["category_id"] = category
    return read_landmarks(files.write_json(folder / "a.json", content))


def landmarker_result(part, faces, **extra):
    """Return what MediaPipe's landmarkers return."""
    return SimpleNamespace(
        **{part: [[SimpleNamespace(x=x, y=y, **extra) for x, y in f] for f in faces]}
    )


SIZES = np.array([(640, 480), (1920, 1080), (100, 200)])


def of_mediapipe(part):
    """Return landmarks of two persons, of nobody, and of one."""
    shares = TRACKS[:3] / 500
    found = (shares[:2], 0.25), ([], 0.25), (shares[2:], 0.75)
    results = [landmarker_result(part, each, visibility=v) for each, v in found]
    landmarks = from_mediapipe(iter(results), SIZES)
    pixels = shares * SIZES[[0, 0, 2], None]
    assert_allclose(tracks_of(landmarks)[[0, 1, 3]], pixels)
    assert list(landmarks.failed) == [False, False, True, False]
    assert list(landmarks.frames["frame"]) == [0, 0, 1, 2]
    assert list(landmarks.frames["individual"].isna()) == [False, False, True, False]
    return landmarks


class Variable:
    """As much of an array with named axes as from_movement uses."""

    def __init__(self, values, names):
        self.values, self.dims = np.asarray(values), tuple(names)
        known = {dim: np.asarray(each) for dim, each in names.items()}
        self.coords = {dim: SimpleNamespace(values=v) for dim, v in known.items()}

    def transpose(self, *dims):
        axes = [self.dims.index(dim) for dim in dims]
        names = {dim: self.coords[dim].values for dim in dims}
        return Variable(self.values.transpose(axes), names)


def movement_dataset(plural="", order=(0, 1, 2, 3), space="xy"):
    """Return a dataset of two mice, as movement names it now and did before."""
    names = {"time": np.arange(12) / 30, "space": [*space]}
    names[f"keypoint{plural}"] = files.BODYPARTS
    names[f"individual{plural}"] = ["id_0", "id_1"]
    pair = np.stack([TRACKS, TRACKS + 100], axis=3).transpose(0, 2, 1, 3)
    pair[3, :, :, 1] = np.nan
    of_position = {dim: names[dim] for dim in np.array([*names])[[*order]]}
    of_scores = {dim: names[dim] for dim in names if dim != "space"}
    scores = np.linspace(0, 1, 192).reshape(12, 8, 2)
    position = Variable(pair.transpose(order), of_position)
    return {"position": position, "confidence": Variable(scores, of_scores)}


@pytest.mark.parametrize("given", [("", (3, 0, 2, 1)), ("s", (0, 1, 2, 3))], ids=str)
def test_movement_datasets_are_read_by_the_names_of_their_axes(given):
    landmarks = from_movement(movement_dataset(*given))
    rows = np.stack([TRACKS, TRACKS + 100], axis=1).reshape(24, 8, 2)
    assert_allclose(tracks_of(landmarks), np.delete(rows, 7, axis=0))
    assert list(landmarks.frames["individual"][:2]) == ["id_0", "id_1"]
    assert_allclose(landmarks.frames["time"][:3], [0, 0, 1 / 30])
    assert landmarks.confidence.iloc[0, 1] == pytest.approx(2 / 191)
    found = tracks_of(from_movement(movement_dataset(*given, space="yx")))
    assert_array_equal(found[..., ::-1], tracks_of(landmarks))


def skeleton_in(path, *options):
    """Return the name of the skeleton of a file, or None."""
    return getattr(read_landmarks(path, *options).skeleton, "name", None)


def coco(folder, names, n_frames=3):
    tracks = files.scene(n_frames, len(names))
    content = files.coco_annotations(tracks, names=names)
    return files.write_json(folder / "a.json", content)


FACES = files.scene(4, 68)
WIDE = files.table_of("{axis}_{part}", FACES, range(68))
THUMB = [SimpleNamespace(x=0.1 * j, y=0.2) for j in range(21)]


def openpose(folder, content=None, points=None):
    """Return a folder of two files of OpenPose, the second with this content."""
    files.write_openpose(folder / "json", [])
    good = files.openpose_person(pose=points_of_openpose(5))
    files.write_json(folder / "json" / "a_keypoints.json", {"people": [good]})
    if points is not None:
        person = files.openpose_person()
        person["pose_keypoints_2d"] = [number for point in points for number in point]
        content = {"people": [person]}
    files.write_json(folder / "json" / "b_keypoints.json", content)
    return folder / "json"


def pts(folder, text, n_whole=0):
    """Return a folder of whole files of points, and one with this text."""
    path = files.write_pts(folder / "faces", TRACKS[:n_whole])
    for file in path.glob("*.pts"):
        file.rename(path / "a.pts")
    (path / "b.pts").write_text(text)
    return path


def sleap(folder, tracks=TRACKS[:, None], **given):
    return files.write_sleap(folder / "a.h5", tracks, **given)


EDGES = [("snout", "ear_R"), ("ear_L", "ear_R"), ("ear_R", "neck")]
# The scores of one individual, which are unknown in all frames but the first one.
SURE = np.where(np.arange(12)[:, None, None] == 0, 0.1, np.full((12, 1, 8), np.nan))
FACE, HAND = (
    landmarker_result(f"{part}_landmarks", TRACKS[:1]) for part in ("face", "hand")
)
FLAT = Variable(np.zeros((2, 3)), {"time": [0, 1], "space": [*"xyz"]})
SIDE = movement_dataset(space="xz")
BOX = {f"FaceRect{side}": 1.0 for side in ("X", "Y", "Width", "Height")}


test_refusals = refusals_of("io_formats", globals())
