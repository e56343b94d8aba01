"""Public data sets: files that are there, downloads, and what is made of them."""

import hashlib
import io
import re
import sys
from functools import partial
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pandas as pd
import pytest
from numpy.testing import assert_array_equal
from refusals import refused
from scipy.io import savemat

from isa_nrsfm.datasets import fetch_muct, fetch_shark

PHOTOS = ["i000qa-fn", "i007rb-mg", "i201ve-m1", "ir000qa-fn"]
TAGS = ["0", "22", "2", "0"]
MUCT_POINTS = [f"{axis}{j:02d}" for j in range(7) for axis in "xy"]
# The coordinates of 4 frames and 5 points, and of 4 photos and 7 points
SHARK = np.random.default_rng(0).standard_normal((12, 5))
MUCT = np.random.default_rng(0).integers(1, 640, (4, 14)).astype(float)
MUCT[0, 2:4] = 0  # not seen
MUCT[1, 4] = 0  # at the edge of the image
MUCT[2, 7] = 3.5


def by_hand(error):
    """Return the address and the digest of a file that an error tells."""
    way = "To put it there by hand, take it from (.*); its sha256 is ([0-9a-f]{64})$"
    return re.search(way, str(error)).groups()


def told_of_absent(fetch, folder):
    """Return the error about a file that is not in a folder."""
    options = {"data_home": folder, "download_if_missing": False, "error": OSError}
    return refused("download_if_missing is False", fetch, **options)


@pytest.fixture
def put(tmp_path, monkeypatch):
    """Return a function that puts a file in a folder, as if it were that of a set."""

    def path_of(fetch, write, *args, **options):
        write(content := io.BytesIO(), *args, **options)
        url, digest = by_hand(told_of_absent(fetch, tmp_path))
        path = tmp_path / "isa_nrsfm" / url.rpartition("/")[2]
        path.parent.mkdir()
        path.write_bytes(content.getvalue())
        found = SimpleNamespace(hexdigest=lambda: digest)
        monkeypatch.setattr(hashlib, "file_digest", lambda *_: found)
        return path

    return path_of


@pytest.fixture
def without_pooch(monkeypatch):
    monkeypatch.setitem(sys.modules, "pooch", None)


@pytest.fixture
def answered(monkeypatch):
    """Return a function that lets pooch download a content, or fail without one."""
    pooch = pytest.importorskip("pooch")
    original = pooch.retrieve

    def answer(content, **options):
        def download(url, output_file, _):
            if content is None:
                raise OSError("404")
            Path(output_file).write_bytes(content)

        def retrieve(*args, **given):
            return original(*args, downloader=download, **given | options)

        monkeypatch.setattr(pooch, "retrieve", retrieve)

    return answer


@pytest.mark.parametrize(
    ("fetch", "name"), [(fetch_shark, "jaws.mat"), (fetch_muct, "muct76-opencv.csv")]
)
def test_absent_files_have_an_address_of_one_version(tmp_path, fetch, name):
    # A branch or an abbreviated commit may come to mean another one.
    host = re.escape("https://raw.githubusercontent.com/")
    path = rf"[\w.-]+/[\w.-]+/[0-9a-f]{{40}}/(\w+/)?{re.escape(name)}"
    error = told_of_absent(fetch, tmp_path / "new")
    assert re.fullmatch(host + path, by_hand(error)[0])
    assert not (tmp_path / "new").exists()


def test_other_contents_are_refused_and_kept(tmp_path):
    path = tmp_path / "jaws.mat"
    path.write_bytes(b"mine")
    message = f"{path} is damaged, or .* {hashlib.sha256(b'mine').hexdigest()}"
    error = refused(message, fetch_shark, data_home=tmp_path, error=OSError)
    assert by_hand(error)[0].endswith("jaws.mat")
    assert path.read_bytes() == b"mine"


def test_downloads_happen_once(tmp_path, put, answered):
    path = put(fetch_shark, savemat, {"P3_gt": SHARK})
    answered(path.read_bytes(), known_hash=None)
    folder = tmp_path / "new" / "folder"
    found = fetch_shark(data_home=folder)
    assert found.filename == str(folder / "jaws.mat")
    assert (folder / "jaws.mat").read_bytes() == path.read_bytes()
    answered(None)
    fetch_shark(data_home=folder)
    assert list(folder.iterdir()) == [folder / "jaws.mat"]


@pytest.mark.parametrize(
    ("content", "reason"), [(b"other bytes", "not match the known hash"), (None, "404")]
)
def test_downloads_that_fail_leave_nothing(tmp_path, answered, content, reason):
    answered(content)
    start = f"^jaws.mat is not in the folder {tmp_path}, and it could not be down.*"
    error = refused(start + reason, fetch_shark, data_home=tmp_path, error=OSError)
    assert by_hand(error)
    assert list(tmp_path.iterdir()) == []


def test_downloads_need_pooch(tmp_path, without_pooch):
    message = rf'{tmp_path}.*pooch is needed.*pip install "isa-nrsfm\[datasets\]"'
    error = refused(message, fetch_shark, data_home=tmp_path, error=ImportError)
    assert by_hand(error)


def test_order_of_the_coordinates_of_the_shark(tmp_path, put, monkeypatch):
    path = put(fetch_shark, savemat, {"P3_gt": SHARK})
    monkeypatch.setenv("SCIKIT_LEARN_DATA", str(tmp_path))
    shark = fetch_shark()
    assert_array_equal(shark.shapes, np.moveaxis(SHARK.reshape(3, 4, 5), 0, 2))
    assert_array_equal(shark.tracks, shark.shapes[:, :, :2])
    assert_array_equal(shark.data, shark.tracks.reshape(4, 10))
    assert shark.feature_names == [f"{axis}_{j}" for j in range(5) for axis in "xy"]
    for name in ("data", "tracks", "shapes"):
        assert shark[name].flags.c_contiguous
        assert shark[name].flags.writeable
    assert shark.filename == str(path)
    assert re.search(r"Source: .*https://raw\.", shark.DESCR, re.DOTALL)


def test_muct_has_missing_points_at_zero_and_labels_in_names(put, without_pooch):
    table = pd.DataFrame(MUCT, columns=MUCT_POINTS)
    table = pd.concat([pd.DataFrame({"name": PHOTOS, "tag": TAGS}), table], axis=1)
    path = put(fetch_muct, partial(table.to_csv, index=False, float_format="%g"))
    faces = fetch_muct(data_home=path.parent, download_if_missing=False)
    expected = MUCT[:3].copy()
    expected[0, 2:4] = np.nan
    assert_array_equal(faces.data, expected)
    assert_array_equal(faces.tracks, expected.reshape(3, 7, 2))
    assert_array_equal(np.argwhere(~faces.visible), [[0, 1]])
    assert faces.feature_names == MUCT_POINTS
    assert re.search(r"Source: .*https://raw\.", faces.DESCR, re.DOTALL)
    labels = {"names": PHOTOS[:3], "tags": TAGS[:3], "subjects": [0, 7, 201]}
    labels |= {"lighting": [*"qrv"], "camera": [*"abe"], "sex": [*"fmm"]}
    labels |= {"glasses": [False, True, True], "target": [0, 7, 201]}
    assert {name: faces[name].tolist() for name in labels} == labels


def test_the_original_of_muct(data_path, load_data, without_pooch):
    folder = data_path("raw/muct76-opencv.csv").parent
    faces = fetch_muct(data_home=str(folder))
    known = load_data("muct_68")
    assert_array_equal(faces.tracks, known["W2d"])
    for name in ("names", "visible", "subjects", "lighting", "camera", "sex"):
        assert_array_equal(faces[name], known[name])
    assert [int(tag) for tag in faces.tags] == known["tag"].tolist()
    # One name lacks the letter for glasses; four photos of that moment have it.
    differ = faces.names[faces.glasses != known["glasses"]]
    assert differ.tolist() == ["i201ve-m1"]
    assert faces.glasses[np.strings.startswith(faces.names, "i201v")].all()
