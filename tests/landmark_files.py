"""Write landmark files as the programs do to which their formats belong."""

import json
import warnings

import numpy as np
import pandas as pd
import pytest
from scipy.io import savemat

from isa_nrsfm.io import Landmarks

IMAGE_SIZE = (640, 480)
BODYPARTS = ["snout", "ear_L", "ear_R", "neck", "hip", "tail_1", "tail_2", "tail_3"]


def scene(n_frames=12, n_points=8, seed=0):
    """Return points (n_frames, n_points, 2) in an image, with one decimal."""
    rng = np.random.default_rng(seed)
    return rng.uniform(5, 470, (n_frames, n_points, 2)).round(1)


def tracks_of(landmarks):
    """Return the points (n_frames, n_points, 2), after a look at the whole object."""
    assert isinstance(landmarks, Landmarks)
    points, frames, failed = landmarks.points, landmarks.frames, landmarks.failed
    names, values = [*points.columns, *frames.columns], points.to_numpy()
    assert values.shape == (len(failed), 2 * len(landmarks.point_names))
    assert min(values.shape) > 0
    assert (points.dtypes == np.float64).all()
    assert not np.isinf(values).any()
    for unique in (names, landmarks.point_names):
        assert len({*unique}) == len(unique)
    confidence = frames if landmarks.confidence is None else landmarks.confidence
    for table in (points, frames, confidence):
        rows = pd.RangeIndex(len(values))
        pd.testing.assert_index_equal(table.index, rows, exact=True)
    assert confidence is frames or tuple(confidence) == landmarks.point_names
    assert failed.dtype == bool
    assert np.isnan(values[failed]).all()
    return values.reshape(len(values), -1, 2)


def table_of(name, tracks, parts=BODYPARTS):
    """Return a table of points under names such as "{part}_{axis}"."""
    names = [name.format(part=part, axis=axis) for part in parts for axis in "xy"]
    return pd.DataFrame(tracks.reshape(len(tracks), -1), columns=names)


def warnings_of(call, *args, **kwargs):
    """Return the texts of the warnings of a call, and its result."""
    with warnings.catch_warnings(record=True, action="always") as caught:
        found = call(*args, **kwargs)
    return " ".join(str(each.message) for each in caught), found


def planar(tracks):
    """Return the table with all x before all y."""
    return tracks.swapaxes(1, 2).reshape(len(tracks), -1)


def openface_names(n_points=68, *, video=True, face_id=True):
    """Return the columns that OpenFace 2 writes when asked for all of them."""
    names = ["frame", "face_id", "timestamp", "confidence", "success"]
    names = names if video else ["face", "confidence"]
    names = names if face_id else [n for n in names if n != "face_id"]
    names += [f"gaze_{eye}_{axis}" for eye in (0, 1) for axis in "xyz"]
    names += ["gaze_angle_x", "gaze_angle_y"]
    names += [f"eye_lmk_{axis}_{j}" for axis in "xyXYZ" for j in range(56)]
    names += [f"pose_{kind}{axis}" for kind in "TR" for axis in "xyz"]
    names += [f"{axis}_{j}" for axis in "xyXYZ" for j in range(n_points)]
    names += [
        f"p_{word}" for word in ("scale", "rx", "ry", "rz", "tx", "ty", *range(34))
    ]
    units = (1, 2, 4, 5, 6, 7, 9, 10, 12, 14, 15, 17, 20, 23, 25, 26, 45)
    names += [f"AU{unit:02d}_r" for unit in units]
    return names + [f"AU{unit:02d}_c" for unit in sorted((*units, 28))]


def write_openface(
    path, tracks, *, success=1, confidence=0.98, video=True, separator=","
):
    """Write the csv file of FeatureExtraction, or of FaceLandmarkImg."""
    names = openface_names(tracks.shape[1], video=video, face_id=separator == ",")
    frame = pd.DataFrame(-7.5, index=range(len(tracks)), columns=names)
    numbers, i = frame.index, names.index("x_0")
    own = {"face": numbers, "frame": numbers + 1, "face_id": 0, "success": success}
    own |= {"timestamp": (numbers / 30).round(3), "confidence": confidence}
    frame = frame.assign(**{name: own[name] for name in own if name in names})
    frame.iloc[:, i : i + tracks[0].size] = planar(tracks)
    header, _, rows = frame.to_csv(index=False).partition("\n")
    path.write_text(header.replace(",", separator) + f"\n{rows}")
    return path


def saved(path, frame, index=False, **options):
    """Save a table with pandas, with options of texts."""
    if path.suffix == ".parquet":
        frame.to_parquet(path)
    else:
        frame.to_csv(path, index=index, **options)
    return path


def saved_scene(path, scene, **others):
    """Save the table of a scene with other columns."""
    table = pd.DataFrame(scene.data, columns=scene.feature_names)
    return saved(path, table.assign(**others))


def write_pyfeat(path, tracks, *, detector="Detector"):
    """Write a table as Fex.to_csv does."""
    n, n_points, _ = tracks.shape
    seen = np.where(np.isnan(tracks).all(axis=(1, 2)), np.nan, 1.0)
    columns = {"frame": np.arange(n)} if detector != "Detectorv2" else {}
    boxes = [f"FaceRect{side}" for side in ("X", "Y", "Width", "Height")]
    columns |= dict.fromkeys(boxes, 100.25 * seen)
    columns |= {"FaceScore": seen * np.linspace(0.5, 1, n)}
    points = table_of("{axis}_{part}", tracks, range(n_points))
    if detector == "MPDetector":
        points = {**points} | {f"z_{j}": -3.5 * seen for j in range(n_points)}
    else:
        points = points[sorted(points, key=lambda name: name[0])]
    columns |= {**points, "AU01": np.linspace(0, 1, n)}
    if detector == "Detectorv2":
        columns |= {f"Identity_{j}": np.zeros(n) for j in range(1, 513)}
        columns |= {f"mesh_{a}_{j}": np.full(n, 9.0) for a in "xyz" for j in range(478)}
    return saved(path, pd.DataFrame(columns | {"input": "video, first.mp4"}))


def write_mesh(path, tracks, *, shares=True, sizes=False):
    """Write the points of MediaPipe's face mesh with names such as x_0, y_0, z_0."""
    parts, size = range(tracks.shape[1]), IMAGE_SIZE
    table = table_of("{axis}_{part}", tracks / size if shares else tracks, parts)
    columns = {"code": [f"{i:03d}" for i in range(len(tracks))]}
    columns |= {"image_width": size[0], "image_height": size[1]} if sizes else {}
    columns |= dict(table) | dict.fromkeys((f"z_{j}" for j in parts), -0.01)
    return saved(path, pd.DataFrame(columns))


def write_pts(folder, tracks):
    """Write a .pts file for each image, with the images beside them."""
    folder.mkdir(exist_ok=True)
    for i, points in enumerate(tracks):
        lines = [f"{x:.6f} {y:.6f}" for x, y in points]
        head = ["version: 1", f"n_points:  {len(points)}", "{"]
        write_text(folder / f"image_{i:03d}.pts", *head, *lines, "}")
        (folder / f"image_{i:03d}.png").write_bytes(b"\x89PNG")
    return folder


def write_wflw(path, tracks, *, rest=True):
    """Write a list of WFLW; it has 98 points."""
    others = "10 20 210 220 0 1 0 0 1 0 " if rest else ""
    lines = []
    for i, points in enumerate(tracks):
        numbers = " ".join(f"{v:.6f}" for v in points.ravel())
        lines.append(f"{numbers} {others}37--Soccer/37_Soccer_{i}.jpg")
    return write_text(path, *lines)


def deeplabcut_frame(tracks, likelihood=0.9, *, bodyparts=BODYPARTS, individuals=()):
    """Return a table as DeepLabCut has it; tracks may have an axis of individuals."""
    values = tracks.reshape(len(tracks), -1, len(bodyparts), 2)
    coords = ["x", "y"]
    if likelihood is not None:
        coords += ["likelihood"]
        scores = np.broadcast_to(
            np.reshape(likelihood, (-1, 1, 1, 1)), (*values.shape[:3], 1)
        )
        values = np.concatenate([values, scores], axis=3)
    levels = {"scorer": ["DLC_resnet50_mice"], "individuals": list(individuals)}
    levels |= {"bodyparts": list(bodyparts), "coords": coords}
    levels = {name: words for name, words in levels.items() if words}
    columns = pd.MultiIndex.from_product(levels.values(), names=levels)
    return pd.DataFrame(values.reshape(len(tracks), -1), columns=columns)


def write_deeplabcut(path, frame, *, how="table"):
    """Write what deeplabcut_frame has returned, as csv or h5."""
    if path.suffix in (".csv", ".tsv"):
        frame.to_csv(path, sep={".csv": ",", ".tsv": "\t"}[path.suffix])
    else:
        pytest.importorskip("tables", reason="needs the extra h5")
        frame.to_hdf(path, key="df_with_missing", format=how, mode="w")
    return path


def write_sleap(
    path, tracks, *, order="txnf", named=True, scores=None, names=("a", "b"), edges=None
):
    """Write an analysis file; tracks (frame, track, node, xy), order of the axes.

    The letters of the order are f, t, n and x; named tells whether the file says it.
    """
    h5py = pytest.importorskip("h5py", reason="needs the extra h5")
    words = {"f": "frame", "t": "track", "n": "node", "x": "xy"}
    scores = np.full(tracks.shape[:3], 0.5) if scores is None else scores
    arrays = {"ftnx": ("tracks", tracks), "ftn": ("point_scores", scores)}
    arrays["ft"] = "instance_scores", scores.mean(axis=2)
    with h5py.File(path, "w") as file:
        for own_order, (name, values) in arrays.items():
            wanted = "".join(letter for letter in order if letter in own_order)
            file[name] = np.einsum(f"{own_order}->{wanted}", values)
            if named:
                dims = [words[letter] for letter in wanted]
                file[name].attrs["dims"] = json.dumps(dims)
        file["track_occupancy"] = (~np.isnan(tracks).all(axis=(2, 3))).astype(np.uint8)
        for kind, texts in (("node", BODYPARTS), ("track", names), ("edge", edges)):
            if texts is not None:
                file[f"{kind}_names"] = np.array(texts, dtype="S")
        file["provenance"] = "{}"
    return path


def coco_annotations(tracks, *, names=BODYPARTS, image=None):
    """Return annotations of one person an image; missing points have zeros."""
    seen = ~np.isnan(tracks).any(axis=2)
    values = np.concatenate([np.nan_to_num(tracks), 2 * seen[..., None]], axis=2)
    image = range(1, len(tracks) + 1) if image is None else image
    known = {"category_id": 1, "iscrowd": 0, "area": 1.5}
    rows = [
        {"id": 100 + i, "image_id": of, "keypoints": row.ravel().tolist()}
        | {"num_keypoints": int(seen[i].sum()), **known}
        for i, (of, row) in enumerate(zip(image, values, strict=True))
    ]
    size = {"width": 640, "height": 480}
    images = [{"id": i, "file_name": f"{i:012d}.jpg"} | size for i in sorted({*image})]
    person = {"id": 1, "name": "person", "keypoints": list(names)}
    content = {"info": {"description": "people"}, "images": images}
    return content | {"annotations": rows, "categories": [person]}


def write_json(path, content):
    """Write json."""
    path.write_text(json.dumps(content))
    return path


def openpose_person(**parts):
    """Return a person as OpenPose does, whose other parts are empty."""
    person = {"person_id": [-1]}
    for part in ("pose", "face", "hand_left", "hand_right"):
        person[f"{part}_keypoints_2d"] = np.ravel(parts.get(part, ())).tolist()
        person[f"{part}_keypoints_3d"] = []
    return person


def write_openpose(folder, people, first=0):
    """Write what --write_json does: a file with the people of each frame."""
    folder.mkdir(exist_ok=True)
    for number, persons in enumerate(people, start=first):
        text = json.dumps({"version": 1.3, "people": persons}, separators=(",", ":"))
        (folder / f"video_{number:012d}_keypoints.json").write_text(text)
    return folder


def mmpose(row):
    """Return an instance as the inferencers of MMPose write it."""
    points, scores = row[:, :2].tolist(), row[:, 2].tolist()
    return {"keypoints": points, "keypoint_scores": scores, "bbox_score": 0.75}


def write_tps(path, tracks):
    """Write specimens as tpsDig does."""
    lines = []
    for i, points in enumerate(tracks):
        places = [f"{x} {y}" for x, y in points]
        head, known = f"LM={len(points)}", [f"IMAGE=skull {i}.jpg", f"ID={i}"]
        lines += [head, *places, *known, "SCALE=0.05"]
    return write_text(path, *lines)


def write_text(path, *lines):
    """Write lines of a text."""
    path.parent.mkdir(exist_ok=True)
    path.write_text("".join(f"{line}\n" for line in lines))
    return path


def detection(points, **further):
    """Return a person as Ultralytics' `Results.summary` does."""
    x, y = points.T.tolist()
    box = dict(zip(("x1", "y1", "x2", "y2"), (1.0, 2.0, 3.0, 4.0), strict=True))
    known = {"name": "person", "class": 0, "confidence": 0.9, "box": box}
    return known | further | {"keypoints": {"x": x, "y": y, "visible": [0.7] * len(x)}}


def write_yolo(folder, tracks, *thirds, after=()):
    """Write labels as Ultralytics does, with the third number of a point, if any."""
    for i, points in enumerate(tracks / 500):
        middle, width = (points.max(0) + points.min(0)) / 2, np.ptp(points, axis=0)
        points = [n for point in points for n in (*point, *thirds)]
        numbers = [*middle, *width, *points, *after]
        write_text(folder / f"video_{i}.txt", " ".join(map(str, [0, *numbers])))
    return folder


def write_labelme(path, i, points):
    """Write a file of labelme for one image."""
    named = zip(BODYPARTS, points.tolist(), strict=True)
    known = {"group_id": None, "shape_type": "point"}
    shapes = [{"label": name, "points": [point], **known} for name, point in named]
    known = {"version": "5.4.1", "flags": {}, "shapes": shapes, "imageData": None}
    known |= {"imagePath": f"{i}.jpg", "imageHeight": 480, "imageWidth": 640}
    write_json(path, known)


def write_imglab(path, tracks):
    """Write parts of boxes as dlib's imglab does."""
    lines = ["<?xml version='1.0' encoding='ISO-8859-1'?>", "<dataset><images>"]
    for i, points in enumerate(tracks):
        lines += [f"<image file='{i}.jpg'><box top='1' left='2' width='3' height='4'>"]
        for j, (x, y) in enumerate(points):
            lines.append(f"<part name='{j:02}' x='{x}' y='{y}'/>")
        lines.append("</box></image>")
    return write_text(path, *lines, "</images></dataset>")


def write_trc(path, tracks, z=0.0):
    """Write points in pixels as Sports2D does."""
    n, J, _ = tracks.shape
    names = "DataRate CameraRate NumFrames NumMarkers Units OrigDataRate".split()
    rows = [["PathFileType", 4, "(X/Y/Z)", path.name]]
    rows += [[*names, "OrigDataStartFrame", "OrigNumFrames"]]
    rows += [[30, 30, n, J, "px", 30, 0, n]]
    rows += [["Frame#", "Time", "\t\t\t".join(BODYPARTS), "", ""]]
    rows += [["", "", *(f"{axis}{j}" for j in range(1, J + 1) for axis in "XYZ")]]
    spatial = np.concatenate([tracks, np.broadcast_to(z, (n, J, 1))], axis=2)
    rows += [[i, i / 30, *each.ravel().tolist()] for i, each in enumerate(spatial)]
    return write_text(path, *("\t".join(map(str, row)) for row in rows))


def write_facemap(path, tracks):
    """Write key points as Facemap does."""
    h5py = pytest.importorskip("h5py", reason="needs the extra h5")
    with h5py.File(path, "w") as file:
        for name, points in zip(BODYPARTS, tracks.swapaxes(0, 1), strict=True):
            file[f"Facemap/{name}/x"], file[f"Facemap/{name}/y"] = points.T
            file[f"Facemap/{name}/likelihood"] = np.full(len(points), 0.9)
    return path


def write_array(path, **arrays):
    """Write arrays for NumPy or MATLAB."""
    if path.suffix == ".mat":
        savemat(path, arrays)
    elif path.suffix == ".npz":
        np.savez(path, **arrays)
    else:
        np.save(path, *arrays.values())
    return path


def write_each(folder, suffix, write):
    """Write a file for each frame of `TRACKS`."""
    folder.mkdir()
    for i, points in enumerate(TRACKS):
        write(folder / f"image_{i}{suffix}", i, points)
    return folder


def write_detection(path, _, points):
    write_json(path, [detection(points)])


def write_places(path, _, points):
    write_text(path, *(f"  {x} {y}" for x, y in points))


def write_helen(path, i, points):
    write_text(path, f"{i}_1", *(f"{x} , {y}" for x, y in points))


def write_row(path, _, points):
    saved(path, pd.DataFrame(points.reshape(1, -1), columns=XY))


def to(name, write, *args, **options):
    """Return what writes a file of this name into a folder."""
    return lambda folder: write(folder / name, *args, **options)


def saved_by_pandas(folder):
    """Return a file of DeepLabCut that was read and saved again by pandas."""
    path = write_deeplabcut(folder / "a.csv", FRAME)
    return saved(path, pd.read_csv(path))


TRACKS, MESH, WFLW = scene(), scene(4, 478), scene(4, 98)
XY = [f"{axis}{j}" for j in range(8) for axis in "xy"]
FRAME = deeplabcut_frame(TRACKS)
UNSCORED = FRAME.droplevel("scorer", axis=1)
INDIVIDUAL = FRAME.rename_axis(columns={"scorer": "individuals"})
SCORED = np.dstack([TRACKS, np.full((12, 8), 0.7)])
RESULTS = [
    {"image_id": i, "category_id": 1, "keypoints": row.ravel().tolist()}
    for i, row in enumerate(SCORED)
]
VIDEO = [{"frame_id": i, "instances": [mmpose(row)]} for i, row in enumerate(SCORED)]
PREDICTIONS = [frame["instances"] for frame in VIDEO]
POSES = [[openpose_person(pose=row)] for row in SCORED]
POINTS = [[dict(zip("xy", p, strict=True)) for p in row] for row in TRACKS.tolist()]
FOUND = [[detection(points)] for points in TRACKS]
DETECTIONS = pd.DataFrame([detection(p, track_id=i) for i, p in enumerate(TRACKS)])
COCO, TABLE = coco_annotations(TRACKS), table_of("{axis}{part}", TRACKS, range(8))
# Of each format, files of one individual: what writes them into a folder and returns
# their path. A further word tells variants of a format apart.
WRITERS = {
    "openface": to("a.csv", write_openface, TRACKS),
    "openface-1": to("a.csv", write_openface, TRACKS, separator=", "),
    "openface-image": to("a.csv", write_openface, TRACKS, video=False),
    "pyfeat": to("a.csv", write_pyfeat, TRACKS),
    "pyfeat-v2": to("a.csv", write_pyfeat, TRACKS, detector="Detectorv2"),
    "pyfeat-mp": to("a.csv", write_pyfeat, MESH, detector="MPDetector"),
    "mediapipe-pixels": to("a.csv", write_mesh, MESH, shares=False),
    "mediapipe-sizes": to("a.csv", write_mesh, MESH, sizes=True),
    "pts": to("a", write_pts, TRACKS),
    "pts-file": lambda d: write_pts(d / "a", TRACKS[:1]) / "image_000.pts",
    "wflw": to("a.txt", write_wflw, WFLW),
    "wflw-test": to("a.txt", write_wflw, WFLW, rest=False),
    "deeplabcut": to("a.csv", write_deeplabcut, FRAME),
    "deeplabcut-tsv": to("a.tsv", write_deeplabcut, FRAME),
    "deeplabcut-table": to("a.h5", write_deeplabcut, FRAME),
    "deeplabcut-fixed": to("a.h5", write_deeplabcut, FRAME, how="fixed"),
    "deeplabcut-lines": to("a.csv", write_deeplabcut, UNSCORED),
    "deeplabcut-individuals": to("a.csv", write_deeplabcut, INDIVIDUAL),
    "deeplabcut-pandas": saved_by_pandas,
    "sleap": to("a.h5", write_sleap, TRACKS[:, None], names=["a"]),
    "coco": to("a.json", write_json, COCO),
    "coco-unnamed": to("a.json", write_json, COCO | {"categories": [{"id": 1}]}),
    "coco-without": to("a.json", write_json, COCO | {"categories": []}),
    "coco-results": to("a.json", write_json, RESULTS),
    "openpose": to("a", write_openpose, POSES),
    "openpose-file": lambda d: next(write_openpose(d / "a", POSES[:1]).iterdir()),
    "mediapipe_json": to("a.json", write_json, POINTS),
    "mmpose": to("a.json", write_json, VIDEO),
    "mmpose-image": to("a.json", write_json, PREDICTIONS[0]),
    "mmpose-demo": to("a.json", write_json, {"meta_info": {}, "instance_info": VIDEO}),
    "mmpose-results": to("a.json", write_json, {"predictions": PREDICTIONS}),
    "tps": to("a.tps", write_tps, TRACKS),
    "ultralytics": to("a.json", write_json, FOUND),
    "ultralytics-csv": to("a.csv", saved, DETECTIONS),
    "ultralytics-folder": to("a", write_each, ".json", write_detection),
    "yolo": to("a", write_yolo, TRACKS, 2),
    "yolo-two": to("a", write_yolo, TRACKS),
    "yolo-score": to("a", write_yolo, TRACKS, 0.7, after=[0.9]),
    "yolo-track": to("a", write_yolo, TRACKS, 0.7, after=[0.9, 3]),
    "labelme": to("a", write_each, ".json", write_labelme),
    "imglab": to("a.xml", write_imglab, TRACKS),
    "places": to("a", write_each, ".txt", write_places),
    "places-helen": to("a", write_each, ".txt", write_helen),
    "facemap": to("a.h5", write_facemap, TRACKS),
    "trc": to("a.trc", write_trc, TRACKS),
    "array": to("a.npy", write_array, xy=TRACKS),
    "array-columns": to("a.npz", write_array, xy=TRACKS.reshape(12, -1)),
    "array-planar": to("a.mat", write_array, xy=TRACKS.mT, fps=30.0),
    "table-txt": to("a.txt", saved, TABLE, sep="\t"),
    "table-blanks": to("a.txt", saved, TABLE, sep=" "),
    "table-parquet": to("a.parquet", saved, TABLE),
    "table-folder": to("a", write_each, ".csv", write_row),
    "table": to("a.csv", write_mesh, TRACKS, shares=False),
}
# The points that are not `TRACKS`.
EXPECTED = dict.fromkeys(["mediapipe-pixels", "mediapipe-sizes", "pyfeat-mp"], MESH)
EXPECTED |= dict.fromkeys(["pts-file", "openpose-file", "mmpose-image"], TRACKS[:1])
EXPECTED |= {n: TRACKS / 500 for n in WRITERS if n.startswith("yolo")}
EXPECTED |= {"facemap": TRACKS[:, np.argsort(BODYPARTS)]}
EXPECTED |= {"wflw": WFLW, "wflw-test": WFLW}
