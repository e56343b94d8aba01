"""Public data sets: files that are there, downloads, and what is made of them."""

import gc
import hashlib
import io
import re
import sys
from functools import partial
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from threading import Thread
from types import SimpleNamespace

import numpy as np
import pytest
from numpy.testing import assert_array_equal
from refusals import refused
from scipy.io import savemat

from isa_nrsfm.datasets import _muct, _shark, fetch_muct, fetch_shark
from isa_nrsfm.datasets._remote import RemoteFile, fetch_file
from isa_nrsfm.io import landmark_table
from isa_nrsfm.skeletons._column_names import names_layout

CONTENT = bytes(range(256)) * 100
BY_HAND = "To put it there by hand, take it from {url}; its sha256 is {sha256}"
PHOTOS = ["i000qa-fn", "i007rb-mg", "i201ve-m1", "ir000qa-fn"]
TAGS = ["0", "22", "2", "0"]


def described(content, url, name="thing.bin"):
    return RemoteFile(name, url, hashlib.sha256(content).hexdigest())


def put(folder, remote, content):
    (folder / remote.name).write_bytes(content)
    return folder / remote.name


@pytest.fixture
def server(monkeypatch):
    """Serve bytes by their path; None is an answer that breaks off."""
    pytest.importorskip("pooch")
    monkeypatch.setenv("no_proxy", "127.0.0.1")
    answers, requests = {}, []

    class Handler(BaseHTTPRequestHandler):
        def do_GET(self):
            requests.append(self.path)
            if self.path not in answers:
                self.send_error(404)
                return
            content = answers[self.path]
            self.send_response(200)
            self.send_header("Content-Length", str(len(content or CONTENT)))
            self.end_headers()
            self.wfile.write(CONTENT[:1000] if content is None else content)

        def log_message(self, *args):
            pass

    with ThreadingHTTPServer(("127.0.0.1", 0), Handler) as http:
        thread = Thread(target=http.serve_forever, kwargs={"poll_interval": 0.01})
        thread.start()
        url = f"http://127.0.0.1:{http.server_port}"
        yield SimpleNamespace(url=url, answers=answers, requests=requests)
        http.shutdown()
        thread.join()
    gc.collect()


@pytest.fixture
def nowhere(monkeypatch):
    """Return the address of a server that does not answer any more."""
    monkeypatch.setenv("no_proxy", "127.0.0.1")
    with ThreadingHTTPServer(("127.0.0.1", 0), BaseHTTPRequestHandler) as http:
        return f"http://127.0.0.1:{http.server_port}/thing.bin"


@pytest.fixture
def without_pooch(monkeypatch):
    monkeypatch.setitem(sys.modules, "pooch", None)


def replace_file(monkeypatch, module, remote):
    """Fetch another file than the one a module describes."""
    fetch = partial(fetch_file, remote)
    monkeypatch.setattr(module, "fetch_file", lambda known, *args: fetch(*args))


@pytest.fixture
def shark_file(monkeypatch):
    """Put a file of 4 frames and 5 points in the place of the shark's."""
    coordinates = np.random.default_rng(0).standard_normal((12, 5))
    file = io.BytesIO()
    savemat(file, {"P3_gt": coordinates})
    content = file.getvalue()
    remote = described(content, "http://127.0.0.1/data/jaws.mat", "jaws.mat")
    replace_file(monkeypatch, _shark, remote)
    return SimpleNamespace(remote=remote, content=content, coordinates=coordinates)


@pytest.fixture
def muct_file(monkeypatch):
    """Put a file of 4 photos and 7 points in the place of MUCT's."""
    values = np.random.default_rng(0).integers(1, 640, (4, 14)).astype(float)
    values[0, 2:4] = 0  # not seen
    values[1, 4] = 0  # at the edge of the image
    values[2, 7] = 3.5
    header = ["name", "tag", *(f"{a}{j:02d}" for j in range(7) for a in "xy")]
    rows = zip(PHOTOS, TAGS, [[f"{v:g}" for v in row] for row in values], strict=True)
    lines = [",".join([name, tag, *row]) for name, tag, row in rows]
    content = "\n".join([",".join(header), *lines, ""]).encode()
    name = "muct76-opencv.csv"
    remote = described(content, f"http://127.0.0.1/{name}", name)
    replace_file(monkeypatch, _muct, remote)
    return SimpleNamespace(remote=remote, content=content, values=values)


class TestFilesThatAreThere:
    def test_need_no_pooch_and_no_network(self, tmp_path, without_pooch):
        remote = described(CONTENT, "http://256.0.0.0/thing.bin")
        path = put(tmp_path, remote, CONTENT)
        assert fetch_file(remote, tmp_path) == path
        assert fetch_file(remote, str(tmp_path)) == path
        assert fetch_file(remote, tmp_path, download_if_missing=False) == path

    def test_may_be_in_the_home_of_sklearn(self, tmp_path, without_pooch, monkeypatch):
        monkeypatch.setenv("SCIKIT_LEARN_DATA", str(tmp_path))
        remote = described(CONTENT, "http://256.0.0.0/thing.bin")
        (tmp_path / "isa_nrsfm").mkdir()
        path = put(tmp_path / "isa_nrsfm", remote, CONTENT)
        assert fetch_file(remote) == path

    def test_are_refused_and_kept_with_other_contents(self, tmp_path, server):
        server.answers["/thing.bin"] = CONTENT
        remote = described(CONTENT, f"{server.url}/thing.bin")
        path = put(tmp_path, remote, b"mine")
        message = "is damaged, or it is another file"
        told = str(refused(message, fetch_file, remote, tmp_path, error=OSError))
        assert str(path) in told
        assert hashlib.sha256(b"mine").hexdigest() in told
        assert BY_HAND.format(**remote._asdict()) in told
        assert path.read_bytes() == b"mine"
        assert server.requests == []


class TestDownloads:
    def test_happen_once(self, tmp_path, server):
        server.answers["/a/thing.bin?raw"] = CONTENT
        remote = described(CONTENT, f"{server.url}/a/thing.bin?raw")
        folder = tmp_path / "new" / "folder"
        path = fetch_file(remote, folder)
        assert path == folder / "thing.bin"
        assert path.read_bytes() == CONTENT
        assert fetch_file(remote, folder) == path
        assert server.requests == ["/a/thing.bin?raw"]
        assert list(folder.iterdir()) == [path]

    @pytest.mark.parametrize(
        ("answer", "reason"),
        [
            (b"other bytes", "does not match the known hash"),
            (CONTENT[:-1], "does not match the known hash"),
            (None, "IncompleteRead|Connection broken"),
            ("not found", "404"),
        ],
        ids=["corrupted", "too short", "broken off", "not found"],
    )
    # pooch leaves the connections of failed downloads to the garbage collector.
    @pytest.mark.filterwarnings("ignore:unclosed <socket:ResourceWarning")
    def test_that_fail_leave_nothing(self, tmp_path, server, answer, reason):
        if answer != "not found":
            server.answers["/thing.bin"] = answer
        remote = described(CONTENT, f"{server.url}/thing.bin")
        message = str(refused(reason, fetch_file, remote, tmp_path, error=OSError))
        start = f"thing.bin is not in the folder {tmp_path}, and it could not be down"
        assert message.startswith(start)
        assert message.endswith(BY_HAND.format(**remote._asdict()))
        assert list(tmp_path.iterdir()) == []

        # The next try may succeed.
        server.answers["/thing.bin"] = CONTENT
        assert fetch_file(remote, tmp_path).read_bytes() == CONTENT

    def test_need_pooch(self, tmp_path, nowhere, without_pooch):
        remote = described(CONTENT, nowhere)
        extra = re.escape('pip install "isa-nrsfm[datasets]"')
        message = f"pooch is needed.*{extra}"
        told = str(refused(message, fetch_file, remote, tmp_path, error=ImportError))
        assert str(tmp_path) in told
        assert BY_HAND.format(**remote._asdict()) in told

    def test_can_be_forbidden(self, tmp_path, server):
        server.answers["/thing.bin"] = CONTENT
        remote = described(CONTENT, f"{server.url}/thing.bin")
        folder = tmp_path / "folder"
        with pytest.raises(OSError, match="download_if_missing is False") as caught:
            fetch_file(remote, folder, download_if_missing=False)
        assert BY_HAND.format(**remote._asdict()) in str(caught.value)
        assert server.requests == []
        assert not folder.exists()


@pytest.mark.parametrize("remote", [_shark.JAWS, _muct.MUCT], ids=lambda r: r.name)
def test_addresses_name_one_version_of_one_file(remote):
    # A branch or an abbreviated commit may come to mean another one.
    host = re.escape("https://raw.githubusercontent.com/")
    path = rf"[\w.-]+/[\w.-]+/[0-9a-f]{{40}}/(\w+/)?{re.escape(remote.name)}"
    assert re.fullmatch(host + path, remote.url)
    assert re.fullmatch("[0-9a-f]{64}", remote.sha256)


@pytest.mark.parametrize("fetch", [fetch_shark, fetch_muct])
class TestEveryFetcher:
    def test_refuses_parameters_of_another_kind(self, fetch):
        refused("'data_home' parameter of fetch_", fetch, data_home=3)
        refused("'download_if_missing' parameter", fetch, download_if_missing="no")

    def test_describes_the_data(self, fetch, tmp_path, shark_file, muct_file):
        for file in (shark_file, muct_file):
            put(tmp_path, file.remote, file.content)
        data = fetch(data_home=tmp_path)
        assert data.filename.startswith(str(tmp_path))
        assert re.search(r"Source: .*https://raw\.", data.DESCR, re.DOTALL)
        lines = [line for line in data.DESCR.splitlines() if "http" not in line]
        assert max(map(len, lines)) <= 88


class TestShark:
    def test_order_of_the_coordinates(self, tmp_path, shark_file):
        put(tmp_path, shark_file.remote, shark_file.content)
        shark = fetch_shark(data_home=tmp_path)
        assert shark.shapes.shape == (4, 5, 3)
        for frame in range(4):
            for axis in range(3):
                row = shark_file.coordinates[4 * axis + frame]
                assert_array_equal(shark.shapes[frame, :, axis], row)
        assert_array_equal(shark.tracks, shark.shapes[:, :, :2])
        assert_array_equal(shark.data[:, 0::2], shark.shapes[:, :, 0])
        assert_array_equal(shark.data[:, 1::2], shark.shapes[:, :, 1])
        assert shark.feature_names[:3] == ["x_0", "y_0", "x_1"]
        assert len(shark.feature_names) == 10
        assert names_layout(shark.feature_names) == "interleaved"
        for name in ("data", "tracks", "shapes"):
            assert shark[name].flags.c_contiguous
            assert shark[name].flags.writeable

    def test_original(self, data_path, load_data, without_pooch):
        folder = data_path("raw/jaws.mat").parent
        shark = fetch_shark(data_home=folder, download_if_missing=False)
        known = load_data("shark_torresani")
        assert_array_equal(shark.shapes, known["S3d"])
        assert_array_equal(shark.tracks, known["W2d"])
        assert shark.data.shape == (240, 182)
        centred = shark.tracks - shark.tracks.mean(axis=1, keepdims=True)
        W = centred.transpose(0, 2, 1).reshape(480, 91)
        assert np.linalg.matrix_rank(W) == 5


class TestMuct:
    @pytest.fixture
    def folder(self, tmp_path, muct_file):
        put(tmp_path, muct_file.remote, muct_file.content)
        return tmp_path

    def test_points_at_zero_are_missing(self, folder, muct_file):
        faces = fetch_muct(data_home=folder)
        expected = muct_file.values[:3].copy()
        expected[0, 2:4] = np.nan
        assert_array_equal(faces.data, expected)
        assert_array_equal(faces.tracks, expected.reshape(3, 7, 2))
        assert_array_equal(np.argwhere(~faces.visible), [[0, 1]])
        assert faces.feature_names[:3] == ["x00", "y00", "x01"]
        assert len(faces.feature_names) == 14
        assert names_layout(faces.feature_names) == "interleaved"
        assert faces.filename == str(folder / "muct76-opencv.csv")

    def test_labels(self, folder):
        faces = fetch_muct(data_home=folder)
        assert faces.names.tolist() == PHOTOS[:3]
        assert faces.tags.tolist() == TAGS[:3]
        assert faces.subjects.tolist() == [0, 7, 201]
        assert_array_equal(faces.target, faces.subjects)
        assert faces.lighting.tolist() == ["q", "r", "v"]
        assert faces.camera.tolist() == ["a", "b", "e"]
        assert faces.sex.tolist() == ["f", "m", "m"]
        assert faces.glasses.tolist() == [False, True, True]
        assert not faces.mirrored.any()

    def test_mirror_images_can_be_kept(self, folder, muct_file):
        faces = fetch_muct(data_home=folder, mirrored=True)
        assert faces.names.tolist() == PHOTOS
        assert faces.mirrored.tolist() == [False, False, False, True]
        assert_array_equal(faces.data[3], muct_file.values[3])
        for labels in ("subjects", "lighting", "camera", "sex", "glasses"):
            assert faces[labels][3] == faces[labels][0]

    def test_frames_of_pandas(self, folder):
        pd = pytest.importorskip("pandas")
        plain = fetch_muct(data_home=folder, mirrored=True)
        faces = fetch_muct(data_home=folder, mirrored=True, as_frame=True)
        assert list(faces.data) == plain.feature_names
        assert_array_equal(faces.data.to_numpy(), plain.data)
        assert faces.target.name == "subject"
        assert_array_equal(faces.target.to_numpy(), plain.target)
        assert isinstance(faces.tracks, np.ndarray)
        assert "frame" not in plain

        # The frame splits again into points and labels.
        points, other = landmark_table(faces.frame)
        pd.testing.assert_frame_equal(points, faces.data)
        labels = "name tag subject lighting camera sex glasses mirrored".split()
        assert list(other) == labels
        keys = ["names", "tags", "subjects", *labels[3:]]
        for label, key in zip(labels, keys, strict=True):
            assert other[label].tolist() == plain[key].tolist()
        options = {"mirrored": True, "return_X_y": True, "as_frame": True}
        X, y = fetch_muct(data_home=folder, **options)
        pd.testing.assert_frame_equal(X, faces.data)
        pd.testing.assert_series_equal(y, faces.target)

    def test_pandas_is_needed_only_for_frames(self, folder, monkeypatch):
        monkeypatch.setitem(sys.modules, "pandas", None)
        assert fetch_muct(data_home=folder).data.shape == (3, 14)
        extra = re.escape('pip install "isa-nrsfm[io]"')
        with pytest.raises(ImportError, match=f"pandas is needed.*{extra}"):
            fetch_muct(data_home=folder, as_frame=True)

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
        others = np.strings.startswith(faces.names, "i201v")
        assert faces.glasses[others].all()

        # What the description says.
        assert len(set(faces.subjects)) == 276
        assert (~faces.visible).sum() == 2544
        hidden = ~faces.visible.all(axis=1)
        assert hidden.sum() == 840
        assert set(faces.camera[hidden]) == {"b", "c"}
