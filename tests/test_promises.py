"""What is promised of files, outputs and tables that others bring or forge."""

import bz2
import os
import signal
import subprocess
import sys
import threading
import time
import zipfile

import numpy as np
import pandas as pd
import pytest
from fit_runs import JOINT, QUICK
from landmark_files import saved
from layers import slow_after
from refusals import refused, warned

from isa_nrsfm import AffineNRSfM, association
from isa_nrsfm.datasets import make_nonrigid_tracks
from isa_nrsfm.io import load_model, open_table, read_landmarks, read_table

N, J = 40, 12
X = make_nonrigid_tracks(N, J, 1, noise=0.01, random_state=0).data
NAMES = [f"{axis}_{j}" for j in range(J) for axis in "xy"]
PROGRAM = [sys.executable, "-m", "isa_nrsfm"]


@pytest.fixture
def table(tmp_path):
    return saved(tmp_path / "a.csv", pd.DataFrame(X, columns=NAMES))


def test_commands_replace_files_only_by_force(table, succeeds, fails, tmp_path):
    folder, page = tmp_path / "o", tmp_path / "thesis.html"
    succeeds("fit", table, "-k", 1, *JOINT, "-o", folder)
    model = folder / "model.npz"
    transform, export = ["transform", model, table], ["export", model]
    for *argv, path in (
        [*transform, "--std", "-o", folder / "alpha.csv"],
        [*transform, "-o", tmp_path / "new.csv", "--viewer", page],
        [*export, "-o", page],
        [*export, "-o", folder / "report.html"],
    ):
        page.write_text("mine")
        before = path.read_bytes()
        message = fails(*argv, path)
        assert f"would be replaced: {path}. Choose another --output, or" in message
        assert path.read_bytes() == before
        succeeds(*argv, path, *message.split()[-1:])  # --force
        assert path.read_bytes() != before


@pytest.mark.subprocess
@pytest.mark.parametrize("streams", slow_after(1, ["2>&- <&-", "2>/dev/full"]))
def test_commands_need_no_standard_error(streams, table, tmp_path):
    argv = f"fit {table} {' '.join(QUICK)} 1 -o {tmp_path}/o {streams} >&-"
    run = subprocess.run(" ".join([*PROGRAM, argv]), shell=True, check=False)
    assert (run.returncode, (tmp_path / "o" / "alpha.csv").exists()) == (0, True)


@pytest.mark.subprocess
@pytest.mark.parametrize("name", slow_after(1, ["SIGTERM", "SIGHUP"]))
def test_a_stopped_fit_leaves_no_folder(name, table, tmp_path):
    folder = tmp_path / "new" / "results"
    argv = [*PROGRAM, "fit", table, "-k", "1-4", "-o", folder]
    with subprocess.Popen(argv, stderr=subprocess.PIPE, start_new_session=True) as run:
        while not folder.exists():
            time.sleep(0.01)
        run.send_signal(number := getattr(signal, name))
        assert run.wait(60) == 128 + number
    assert not folder.parent.exists()


@pytest.mark.subprocess
def test_a_stopped_command_that_loses_the_exception_says_that_it_was_stopped():
    code = """
import os, signal, sys
from isa_nrsfm.cli import _entry, _main
def run(argv):
    try:
        os.kill(os.getpid(), signal.SIGTERM)
    except SystemExit:
        return 1
_main.run = run
sys.exit(_entry.main())
"""
    assert subprocess.run([sys.executable, "-c", code], check=False).returncode == 143


@pytest.mark.parametrize("read", [read_landmarks, read_table, load_model, open_table])
def test_pipes_and_devices_are_refused_at_once(read, tmp_path):
    pipe, link, name = tmp_path / "a.parquet", tmp_path / "b.parquet", "a.pts"
    os.mkfifo(pipe)
    link.symlink_to("/dev/zero")
    for path in (pipe, link):
        refused("is a pipe or a device. Save its content", read, path, error=OSError)
    os.mkfifo(tmp_path / name)
    refused("is a pipe", read_landmarks, tmp_path, "pts", error=OSError)


def test_contents_of_other_files_are_refused(tmp_path):
    h5py = pytest.importorskip("h5py")
    other, path, shape = tmp_path / "other.h5", tmp_path / "a.h5", (1, 2, 2, 5)
    names = {"node_names": np.array([b"a", b"b"]), "track_names": np.array([b"t"])}
    with h5py.File(other, "w") as file:
        file["tracks"] = np.ones(shape)
    layout = h5py.VirtualLayout(shape, float)
    layout[:] = h5py.VirtualSource(other, "tracks", shape)
    for way in ("a link", "stored in another file", "stored"):
        with h5py.File(path, "w") as file:
            file.update(names)
            if way == "a link":
                file["tracks"] = h5py.ExternalLink(other, "/tracks")
            elif way == "stored":
                file.create_virtual_dataset("tracks", layout)
            else:
                file.create_dataset("tracks", shape, float, external=[(other, 0, 160)])
        refused(f"tracks is {way}", read_landmarks, path)


def test_an_entry_that_lies_about_its_size_is_not_unpacked(tmp_path):
    path = tmp_path / "model.npz"
    with zipfile.ZipFile(path, "w") as archive:
        archive.writestr("header.npy", bz2.compress(bytes(10**7)))
    for at in (8, path.read_bytes().rfind(b"PK\x01\x02") + 10):  # the method
        content = bytearray(path.read_bytes())
        content[at : at + 2] = b"\x0c\x00"
        path.write_bytes(content)
    refused("its contents are compressed", load_model, path)


@pytest.mark.skipif(not hasattr(os, "fork"), reason="no fork")
@pytest.mark.filterwarnings("ignore:.*fork:DeprecationWarning")
def test_forks_while_other_threads_transform_do_not_hang():
    model, stop = AffineNRSfM(1, random_state=0).fit(X), threading.Event()

    def work():
        while not stop.is_set():
            model.transform(X[:3])

    threads = [threading.Thread(target=work) for _ in range(2)]
    for thread in threads:
        thread.start()
    status = []
    for _ in range(10):
        if not (child := os.fork()):
            signal.alarm(20)
            model.transform(X[:3])
            os._exit(0)
        status.append(os.waitpid(child, 0)[1])
    stop.set()
    for thread in threads:
        thread.join()
    assert status == [0] * 10


@pytest.mark.parametrize(
    ("camera", "weight"), slow_after(1, [("weak_perspective", 1e-8), ("affine", 1e-20)])
)
def test_points_of_any_weight_converge(camera, weight):
    table = make_nonrigid_tracks(60, 20, 1, noise=0.02, random_state=0).data
    weights = np.where(np.arange(20) < 5, weight, 1.0) * np.ones((60, 1))
    model = AffineNRSfM(1, camera=camera, random_state=0)
    model.fit(table, point_weight=weights)
    rest = model.reproject(table, point_weight=weights) - table
    tiny, others = np.square(rest[:, :10]).mean(), np.square(rest[:, 10:]).mean()
    assert tiny < 4 * others


@pytest.mark.parametrize(
    ("camera", "kind"), [("orthographic", "shifted"), ("weak_perspective", "line")]
)
def test_tables_without_turning_warn_of_the_depth(camera, kind, rng):
    table = np.repeat(X[:1], N, axis=0).reshape(N, J, 2)
    table = table + rng.normal(size=(N, 1, 2))
    if kind == "line":
        table = table[:, :, :1] * [1.0, 0.5]
    model = AffineNRSfM(1, camera=camera, random_state=0)
    warned("depth of the shapes is not determined", model.fit, table.reshape(N, -1))
    assert np.isfinite(model.basis_).all()


def test_copies_of_a_frame_count_once_in_any_group(rng):
    copies = rng.permutation(np.repeat(np.arange(60), 6))
    alpha, y = rng.normal(size=(60, 2)), rng.integers(0, 2, 60)
    alpha = alpha[copies] + 1e-6 * rng.normal(size=(360, 2))
    found = association(alpha, y[copies], rng.integers(0, 3, 360), random_state=0)
    assert 60 <= found.n_frames <= 62
