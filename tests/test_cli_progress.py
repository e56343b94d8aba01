"""Progress of commands: a line every few seconds, and nothing on the output."""

import io
import re
import time

import pytest

from isa_nrsfm import AffineNRSfM
from isa_nrsfm.cli._progress import show_stage, shown_progress
from isa_nrsfm.datasets import make_nonrigid_tracks


@pytest.mark.parametrize("terminal", [True, False])
def test_the_latest_line_is_repeated(terminal, capsys, monkeypatch):
    monkeypatch.setattr("sys.stderr", stream := io.StringIO())
    monkeypatch.setattr(stream, "isatty", lambda: terminal)
    with shown_progress(time.perf_counter(), shortest=0.02):
        print("a stage: 1 s")
        assert stream.getvalue().count("a stage: 1 s\n") >= terminal
        show_stage("smoothing")
        time.sleep(0.5)
    lines = stream.getvalue().splitlines()
    assert ("a stage: 1 s" in lines) == terminal
    assert 2 <= lines.count("isa-nrsfm: 0 s: smoothing") <= 25
    time.sleep(0.1)
    assert stream.getvalue().splitlines() == lines
    assert capsys.readouterr().out == ""


def test_lines_become_rarer(monkeypatch):
    monkeypatch.setattr("sys.stderr", stream := io.StringIO())
    with shown_progress(time.perf_counter() - 3600, shortest=0.02):
        time.sleep(0.2)
    assert stream.getvalue() == ""


def test_fits_say_their_stage_and_step(capsys):
    table = make_nonrigid_tracks(30, 12, 1, noise=0.01, random_state=0).data
    AffineNRSfM(1, random_state=0, verbose=2).fit(table)
    begun = re.split("[\r\n]", capsys.readouterr().out)
    begun = [line.removeprefix("[AffineNRSfM] ") for line in begun]
    steps = [int(line.split(" step ")[1]) for line in begun if " step " in line]
    assert steps == [*range(1, len(steps) + 1)]
    assert steps
    assert begun.index("factorisation") < begun.index("joint refinement, step 1")
