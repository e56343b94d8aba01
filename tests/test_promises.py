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
from fit_runs import QUICK
from landmark_files import saved
from refusals import refused

from isa_nrsfm import AffineNRSfM
from isa_nrsfm.cli import main
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
    succeeds("fit", table, *QUICK, 1, "-o", folder)
    model = folder / "model.npz"
    transform, export = ["transform", model, table], ["export", model]
    for *argv, path in (
        [*transform, "-o", folder / "alpha.csv"],
        [*transform, "-o", tmp_path / "new.csv", "--viewer", page],
        [*export, "-o", page],
        [*export, "-o", folder / "report.html"],
    ):
        path.write_text("mine")
        message = fails(*argv, path)
        assert f"would be replaced: {path}. Choose another --output, or" in message
        assert path.read_text() == "mine"
        succeeds(*argv, path, *message.split()[-1:])  # --force
        assert path.read_text() != "mine"


def test_commands_need_no_streams(table, tmp_path, monkeypatch):
    for stream in ("stdout", "stderr"):
        monkeypatch.setattr(sys, stream, None)  # closed, as in services
    assert main(["fit", str(table), *QUICK, "1", "-o", str(tmp_path / "o")]) == 0
    for stream in (sys.stdout, sys.stderr):
        stream.close()


@pytest.mark.slow
@pytest.mark.subprocess
def test_programs_need_no_space_for_their_errors(table, tmp_path):
    argv = f"fit {table} {' '.join(QUICK)} 1 -o {tmp_path}/o >&- 2>/dev/full"
    run = subprocess.run(" ".join([*PROGRAM, argv]), shell=True, check=False)
    assert (run.returncode, (tmp_path / "o" / "alpha.csv").exists()) == (0, True)


@pytest.mark.slow
@pytest.mark.subprocess
def test_a_stopped_fit_leaves_no_folder(table, tmp_path):
    folder = tmp_path / "new" / "results"
    argv = [*PROGRAM, "fit", table, "-k", "1-4", "-o", folder]
    with subprocess.Popen(argv, stderr=subprocess.PIPE, start_new_session=True) as run:
        while not folder.exists():
            time.sleep(0.01)
        run.send_signal(signal.SIGHUP)
        assert run.wait(60) == 128 + signal.SIGHUP
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
    for _ in range(6):
        if not (child := os.fork()):
            signal.alarm(20)
            model.transform(X[:3])
            os._exit(0)
        status.append(os.waitpid(child, 0)[1])
    stop.set()
    for thread in threads:
        thread.join()
    assert status == [0] * 6
