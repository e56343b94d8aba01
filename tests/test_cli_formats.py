"""The command line on files of other programs."""

from functools import cache

import landmark_files as files
import numpy as np
import pandas as pd
import pytest
from fit_runs import MODEL, told
from refusals import refusals_of

from isa_nrsfm import AffineNRSfM
from isa_nrsfm.datasets import make_face_tracks, make_nonrigid_tracks
from isa_nrsfm.io import find_format  # noqa: F401  in refusals.txt

N_FRAMES = 20
LOST, EMPTY = 3, 7
QUICK = "-k 1 --isa fast --n-init 2 --refinement none --no-figures".split()


@cache
def tracks(n_points):
    """Return points in an image; 68 are those of faces."""
    faces = make_face_tracks(N_FRAMES, n_components=1, random_state=0)
    others = make_nonrigid_tracks(N_FRAMES, n_points, 1, random_state=0)
    data = (faces if n_points == 68 else others).data
    shares = (data - data.min()) / (data.max() - data.min())
    return (shares * 400 + 20).reshape(N_FRAMES, -1, 2)


# Each writes a file and returns its path, options, columns that are kept, and the
# frames without coefficients.
def write_openface(folder):
    success, confidence = np.ones(N_FRAMES, dtype=int), np.full(N_FRAMES, 0.9)
    success[LOST], confidence[EMPTY] = 0, 0.2
    path = folder / "faces.csv"
    files.write_openface(path, tracks(68), success=success, confidence=confidence)
    kept, empty = {"AU01_r", "success"}, [LOST + 1, EMPTY + 1]
    return path, ["--min-confidence", "0.5"], kept, empty


def write_pts(folder):
    return files.write_pts(folder / "300W", tracks(68)), [], {"file"}, []


def write_openpose(folder):
    values = np.dstack([tracks(20), np.full((N_FRAMES, 20), 0.7)])
    people = [[files.openpose_person(pose=p, face=p[:9])] for p in values]
    people[EMPTY] = []
    people[3].insert(0, files.openpose_person(pose=values[4], face=values[4]))
    options = ["--part", "pose", "--skip-rows", "person=^1"]
    path = files.write_openpose(folder / "json", people)
    return path, options, {"file", "frame", "person"}, [EMPTY]


@pytest.mark.parametrize("write", [write_openface, write_openpose])
def test_files_are_fitted_and_transformed(write, fits, transforms, tmp_path):
    path, options, kept, empty = write(tmp_path)
    found = fits(path, *options, *QUICK, folder=tmp_path / "results")
    assert found.err == ""
    assert f"{path} (" in found.page
    table, alpha = found.report["table"], found.alpha
    assert table["format"] == write.__name__.removeprefix("write_")
    assert table["n_points"] == len(found.model.mean_shape_)
    assert kept <= set(alpha)
    assert "x_0" not in alpha
    missing = alpha["alpha_1"].isna()
    assert list(alpha["frame" if "frame" in alpha else "row"][missing]) == empty
    assert "1 rows: tracking failed" in found.page
    uncertain = "1 rows: all points missing or uncertain" in found.page
    assert uncertain == (write is write_openface)
    again, _, err = transforms(found.path, path, *options)
    assert err == ""
    assert list(again) == list(alpha)
    np.testing.assert_allclose(again["alpha_1"], alpha["alpha_1"], atol=1e-3)


def write_sized_mesh(folder):
    return files.write_mesh(folder / "mesh.csv", tracks(478), sizes=True), []


def write_sized_pyfeat(folder, heights=480):
    path = files.write_pyfeat(folder / "fex.csv", tracks(68))
    table = pd.read_csv(path).copy().assign(FrameHeight=heights, FrameWidth=640)
    return files.saved(path, table), []


def write_coco(folder):
    content = files.coco_annotations(tracks(14), names=[f"p{j}" for j in range(14)])
    return files.write_json(folder / "coco.json", content), []


def axis_of(written, options=""):
    """Raise the axis of the camera and the focal length of a fit of a file."""

    def stop(model, *_, **__):
        raise ValueError(f"{model.principal_point} {model.focal_length}")

    path, own, *_ = written
    options = [*own, *options.split(), "--camera", "perspective", "--no-figures"]
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(AffineNRSfM, "fit", stop)
        told("fit", path, *options, "-o", path.parent / "out")


def test_columns_make_any_file_a_table(fits, transforms, tmp_path):
    path, *_ = write_openface(tmp_path)
    out = fits(path, "--columns", "x_#,y_#", *QUICK).page
    assert "in 20 frames" in out
    assert "x_0, y_0, x_1, y_1, ..., x_67, y_67" in out
    assert "eye_lmk_x_#,eye_lmk_y_# (56)" in out.partition("coordinates not used: ")[2]
    # Models transform files of other formats.
    alpha, *_ = transforms(tmp_path / MODEL, write_pts(tmp_path)[0])
    assert alpha["alpha_1"].notna().all()


def write_shares(folder, change=lambda shares: shares):
    """Write points of hands in normalised coordinates of 1920 x 1080 pixels."""
    shares = change(tracks(21) * [2.5 / 1920, 2.5 / 1080])
    names = [f"{axis}_{j}" for j in range(21) for axis in "xy"]
    table = pd.DataFrame(shares.reshape(N_FRAMES, -1), columns=names)
    return files.saved(folder / "hands.csv", table)


def partly_outside(shares):
    """Return shares of which a few are outside of the image."""
    shares[3, 5], shares[4, 6] = [0.5, 1.25], [-0.125, 0.5]
    return shares


MESH = ["--format", "mediapipe", "--image-size", "1920x1080"]
test_refusals = refusals_of("cli_formats", globals())
