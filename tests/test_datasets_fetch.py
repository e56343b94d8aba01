"""Public data sets: files that are there, downloads, and what is made of them."""

import gc
import hashlib
import io
import re
import sys
from functools import partial
from http.server import SimpleHTTPRequestHandler, ThreadingHTTPServer
from threading import Thread

import numpy as np
import pandas as pd
import pytest
from numpy.testing import assert_array_equal
from refusals import refused
from scipy.io import savemat

from isa_nrsfm.datasets import _muct, _shark, fetch_muct, fetch_shark
from isa_nrsfm.datasets._remote import fetch_file

CONTENT = bytes(range(256)) * 100
PHOTOS = ["i000qa-fn", "i007rb-mg", "i201ve-m1", "ir000qa-fn"]
TAGS = ["0", "22", "2", "0"]
MUCT_POINTS = [f"{axis}{j:02d}" for j in range(7) for axis in "xy"]


def described(content=CONTENT, url="http://256.0.0.0/thing.bin"):
    return url, hashlib.sha256(content).hexdigest()


def by_hand(remote):
    url, sha256 = remote
    return f"To put it there by hand, take it from {url}; its sha256 is {sha256}"


@pytest.fixture
def served(tmp_path_factory, monkeypatch):
    """Return a folder, and the address of a server of its files."""
    pytest.importorskip("pooch")
    monkeypatch.setenv("no_proxy", "127.0.0.1")
    monkeypatch.setattr(SimpleHTTPRequestHandler, "log_message", lambda *_: None)
    folder = tmp_path_factory.mktemp("served")
    handler = partial(SimpleHTTPRequestHandler, directory=folder)
    with ThreadingHTTPServer(("127.0.0.1", 0), handler) as http:
        thread = Thread(target=http.serve_forever, kwargs={"poll_interval": 0.01})
        thread.start()
        yield folder, f"http://127.0.0.1:{http.server_port}/thing.bin"
        http.shutdown()
        thread.join()
    gc.collect()


@pytest.fixture
def without_pooch(monkeypatch):
    monkeypatch.setitem(sys.modules, "pooch", None)


@pytest.fixture
def put(tmp_path, monkeypatch):
    """Return a function that puts a file in the place of the one of a module."""

    def put_file(module, content, url):
        (tmp_path / url.split("/")[-1]).write_bytes(content)
        fetch = partial(fetch_file, *described(content, url))
        monkeypatch.setattr(module, "fetch_file", lambda *args: fetch(*args[2:]))

    return put_file


@pytest.fixture
def shark_file(put):
    """Return the coordinates of 4 frames and 5 points in the place of the shark's."""
    coordinates = np.random.default_rng(0).standard_normal((12, 5))
    file = io.BytesIO()
    savemat(file, {"P3_gt": coordinates})
    put(_shark, file.getvalue(), "http://127.0.0.1/data/jaws.mat")
    return coordinates


@pytest.fixture
def muct_file(put):
    """Return the coordinates of 4 photos and 7 points in the place of MUCT's."""
    values = np.random.default_rng(0).integers(1, 640, (4, 14)).astype(float)
    values[0, 2:4] = 0  # not seen
    values[1, 4] = 0  # at the edge of the image
    values[2, 7] = 3.5
    table = pd.DataFrame(values, columns=MUCT_POINTS)
    table = pd.concat([pd.DataFrame({"name": PHOTOS, "tag": TAGS}), table], axis=1)
    content = table.to_csv(index=False, float_format="%g").encode()
    put(_muct, content, "http://127.0.0.1/muct76-opencv.csv")
    return values


def test_files_that_are_there_need_no_pooch_and_no_network(
    tmp_path, without_pooch, monkeypatch
):
    remote, path = described(), tmp_path / "isa_nrsfm" / "thing.bin"
    path.parent.mkdir()
    path.write_bytes(CONTENT)
    assert fetch_file(*remote, path.parent) == path
    assert fetch_file(*remote, str(path.parent), download_if_missing=False) == path
    monkeypatch.setenv("SCIKIT_LEARN_DATA", str(tmp_path))
    assert fetch_file(*remote) == path


def test_other_contents_are_refused_and_kept(tmp_path):
    remote, path = described(), tmp_path / "thing.bin"
    path.write_bytes(b"mine")
    message = "is damaged, or it is another file"
    told = str(refused(message, fetch_file, *remote, tmp_path, error=OSError))
    for part in (str(path), hashlib.sha256(b"mine").hexdigest(), by_hand(remote)):
        assert part in told
    assert path.read_bytes() == b"mine"


class TestDownloads:
    def test_happen_once(self, tmp_path, served):
        (served[0] / "thing.bin").write_bytes(CONTENT)
        remote, folder = described(url=served[1]), tmp_path / "new" / "folder"
        message, options = "download_if_missing is False", {"error": OSError}
        error = refused(message, fetch_file, *remote, folder, False, **options)
        assert by_hand(remote) in str(error)
        assert not folder.exists()
        path = fetch_file(*remote, folder)
        assert path == folder / "thing.bin"
        assert path.read_bytes() == CONTENT
        (served[0] / "thing.bin").unlink()
        assert fetch_file(*remote, folder) == path
        assert list(folder.iterdir()) == [path]

    @pytest.mark.parametrize("answer", [b"other bytes", CONTENT[:-1], None])
    # pooch leaves the connections of failed downloads to the garbage collector.
    @pytest.mark.filterwarnings("ignore:unclosed <socket:ResourceWarning")
    def test_that_fail_leave_nothing(self, tmp_path, served, answer):
        (folder, url), reason = served, "404"
        if answer is not None:
            reason = "does not match the known hash"
            (folder / "thing.bin").write_bytes(answer)
        remote = described(url=url)
        message = str(refused(reason, fetch_file, *remote, tmp_path, error=OSError))
        start = f"thing.bin is not in the folder {tmp_path}, and it could not be down"
        assert message.startswith(start)
        assert message.endswith(by_hand(remote))
        assert list(tmp_path.iterdir()) == []

    def test_need_pooch(self, tmp_path, without_pooch):
        remote = described()
        message = r'pooch is needed.*pip install "isa-nrsfm\[datasets\]"'
        told = str(refused(message, fetch_file, *remote, tmp_path, error=ImportError))
        assert str(tmp_path) in told
        assert by_hand(remote) in told


@pytest.mark.parametrize(
    ("module", "name"), [(_shark, "jaws.mat"), (_muct, "muct76-opencv.csv")]
)
def test_addresses_name_one_version_of_one_file(module, name):
    # A branch or an abbreviated commit may come to mean another one.
    host = re.escape("https://raw.githubusercontent.com/")
    path = rf"[\w.-]+/[\w.-]+/[0-9a-f]{{40}}/(\w+/)?{re.escape(name)}"
    assert re.fullmatch(host + path, module.URL)
    assert re.fullmatch("[0-9a-f]{64}", module.SHA256)


def test_order_of_the_coordinates_of_the_shark(tmp_path, shark_file):
    shark = fetch_shark(data_home=tmp_path)
    assert_array_equal(shark.shapes, np.moveaxis(shark_file.reshape(3, 4, 5), 0, 2))
    assert_array_equal(shark.tracks, shark.shapes[:, :, :2])
    assert_array_equal(shark.data, shark.tracks.reshape(4, 10))
    assert shark.feature_names == [f"{axis}_{j}" for j in range(5) for axis in "xy"]
    for name in ("data", "tracks", "shapes"):
        assert shark[name].flags.c_contiguous
        assert shark[name].flags.writeable
    assert shark.filename == str(tmp_path / "jaws.mat")
    assert re.search(r"Source: .*https://raw\.", shark.DESCR, re.DOTALL)


class TestMuct:
    def test_points_at_zero_are_missing_and_names_are_labels(self, tmp_path, muct_file):
        faces = fetch_muct(data_home=tmp_path)
        expected = muct_file[:3].copy()
        expected[0, 2:4] = np.nan
        assert_array_equal(faces.data, expected)
        assert_array_equal(faces.tracks, expected.reshape(3, 7, 2))
        assert_array_equal(np.argwhere(~faces.visible), [[0, 1]])
        assert faces.feature_names == MUCT_POINTS
        assert faces.filename == str(tmp_path / "muct76-opencv.csv")
        assert re.search(r"Source: .*https://raw\.", faces.DESCR, re.DOTALL)
        labels = {"names": PHOTOS[:3], "tags": TAGS[:3], "subjects": [0, 7, 201]}
        labels |= {"lighting": [*"qrv"], "camera": [*"abe"], "sex": [*"fmm"]}
        labels |= {"glasses": [False, True, True], "target": [0, 7, 201]}
        for name, values in labels.items():
            assert faces[name].tolist() == values

    def test_original(self, data_path, load_data, without_pooch):
        folder = data_path("raw/muct76-opencv.csv").parent
        faces = fetch_muct(data_home=folder, download_if_missing=False)
        known = load_data("muct_68")
        assert_array_equal(faces.tracks, known["W2d"])
        for name in ("names", "visible", "subjects", "lighting", "camera", "sex"):
            assert_array_equal(faces[name], known[name])
        assert [int(tag) for tag in faces.tags] == known["tag"].tolist()
        # One name lacks the letter for glasses; four photos of that moment have it.
        differ = faces.names[faces.glasses != known["glasses"]]
        assert differ.tolist() == ["i201ve-m1"]
        assert faces.glasses[np.strings.startswith(faces.names, "i201v")].all()
