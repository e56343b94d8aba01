"""The command line: names not in UTF-8, encodings, interruptions, progress."""

import io
import os
import re
import subprocess
import sys
import threading
import time

import pandas as pd
import pytest
from fit_runs import MODEL
from landmark_files import saved, scene, write_pts
from layers import slow_after

from isa_nrsfm import AffineNRSfM
from isa_nrsfm.cli import main
from isa_nrsfm.datasets import make_face_tracks, make_nonrigid_tracks
from isa_nrsfm.io import load_model, read_landmarks

QUICK = "-k 2 --isa fast --n-init 2 --refinement none --no-figures".split()
# What a spreadsheet takes for formulas stays as it is: SECURITY.md says so.
CELLS = ["=1+1", "+1", "-x", "@SUM(A1)", "'=1", '=HYPERLINK("x")', "a\nb", "Ω"] * 5
# Names of files in Latin-1 and of no encoding at all.
NOT_UTF8 = os.fsdecode(b"caf\xe9 \xff")


@pytest.fixture(scope="module")
def faces():
    """Return a table of faces with a column of other texts."""
    bunch = make_face_tracks(n_frames=40, n_components=2, random_state=0)
    frame = pd.DataFrame(bunch.data, columns=bunch.feature_names)
    return frame.assign(ομάδα=CELLS)


@pytest.fixture
def path(faces, tmp_path):
    """Return the path of that table."""
    return saved(tmp_path / "faces.csv", faces)


def test_paths_that_are_not_utf8(fits, succeeds, faces, tmp_path):
    folder = tmp_path / NOT_UTF8
    folder.mkdir()
    table = saved(folder / f"{NOT_UTF8}.csv", faces)
    found = fits(table, *QUICK, folder=folder / "results")
    assert found.err == ""
    assert "caf\\udce9 \\udcff" in " ".join(found.out.split())
    assert found.report["table"]["path"].endswith("caf\\udce9 \\udcff.csv")
    alpha, page = (folder / f"{NOT_UTF8}.{suffix}" for suffix in ("tsv", "html"))
    succeeds("transform", found.path, table, "-o", alpha)
    assert list(pd.read_csv(alpha, sep="\t")["ομάδα"]) == CELLS
    succeeds("export", found.path, "-o", page)
    assert page.stat().st_size > 0


def test_files_of_points_whose_names_are_not_utf8(fits, tmp_path):
    folder, points = tmp_path / os.fsdecode(b"pts \xfe"), scene(40, 12)
    for file in write_pts(folder, points).glob("*.pts"):
        file.rename(folder / f"{file.stem} {NOT_UTF8}.pts")
    files = list(read_landmarks(folder).frames["file"])
    assert files[3] == "image_003 caf\\udce9 \\udcff.pts"
    assert list(fits(folder, *QUICK).alpha["file"]) == files


def test_output_in_any_encoding(path, tmp_path, monkeypatch):
    shown = io.BytesIO()
    monkeypatch.setattr(sys, "stdout", io.TextIOWrapper(shown, encoding="cp1252"))
    argv = ["fit", str(path), "-o", str(tmp_path / "out"), "--skip-rows", "ομάδα=Ψ"]
    assert main([*argv, *QUICK]) == 0
    assert shown.getvalue().decode("cp1252").startswith("2 movements in 40 frames")
    assert load_model(tmp_path / "out" / MODEL).basis_.shape[0] == 2


INTERRUPTED = """
import os, signal, sys

class Interrupt:
    def find_spec(self, name, path=None, target=None):
        if name == sys.argv[1]:
            sys.meta_path.remove(self)
            os.kill(os.getpid(), signal.SIGINT)

sys.meta_path.insert(0, Interrupt())
from isa_nrsfm.cli import main
sys.exit(main(sys.argv[2:]))
"""


@pytest.mark.usefixtures("interruptible")
@pytest.mark.subprocess
@pytest.mark.parametrize("module", slow_after(1, ["argparse", "isa_nrsfm._estimator"]))
def test_interruption_while_modules_are_imported(path, tmp_path, module):
    argv = ["fit", str(path), "-o", str(tmp_path / "out"), *QUICK]
    command = [sys.executable, "-c", INTERRUPTED, module, *argv]
    done = subprocess.run(command, capture_output=True, text=True)
    assert (done.returncode, done.stdout) == (130, "")
    # On a busy machine the progress is shown while modules are imported.
    progress = r"(isa-nrsfm: \d+ s: \w+\n)*"
    assert re.fullmatch(rf"{progress}isa-nrsfm: interrupted\n", done.stderr)
    assert not (tmp_path / "out").exists()


# --- progress: a line every few seconds, and nothing on the output --------------------


@pytest.mark.parametrize("terminal", [True, False])
def test_the_latest_line_is_repeated(terminal, path, tmp_path, capsys, monkeypatch):
    fit, wait = AffineNRSfM.fit, threading.Event.wait

    def say_and_fit(self, X, y=None, groups=None):
        print("a stage: 1 s")
        print("smoothing", end="\r")
        time.sleep(0.4)
        return fit(self, X)

    def wait_less(self, seconds=None):
        return wait(self, seconds and seconds / 100)

    monkeypatch.setattr(AffineNRSfM, "fit", say_and_fit)
    monkeypatch.setattr(threading.Event, "wait", wait_less)
    monkeypatch.setattr(sys.stderr, "isatty", lambda: terminal)
    assert main(["fit", str(path), "-o", str(tmp_path / "out"), *QUICK]) == 0
    out, err = capsys.readouterr()
    # On a terminal, whole lines are shown at once.
    assert ("a stage: 1 s" in err.splitlines()) == terminal
    assert 2 <= len(re.findall(r"isa-nrsfm: \d+ s: smoothing\n", err)) <= 25
    assert out.startswith("2 movements in 40 frames")
    time.sleep(0.1)
    assert capsys.readouterr() == ("", "")


def test_fits_say_their_stage_and_step(capsys):
    table = make_nonrigid_tracks(30, 12, 1, noise=0.01, random_state=0).data
    AffineNRSfM(1, random_state=0, verbose=2).fit(table)
    begun = re.split(r"[\r\n]+(?:\[AffineNRSfM\] )?", "\n" + capsys.readouterr().out)
    steps = [int(line.split(" step ")[1]) for line in begun if " step " in line]
    assert steps == [*range(1, len(steps) + 1)]
    assert steps
    assert begun.index("factorisation") < begun.index("joint refinement, step 1")
