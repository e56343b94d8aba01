"""The page for contributors names files that exist, and its recipes work."""

import re
import textwrap
from pathlib import Path

import landmark_files as files
import numpy as np
import pytest
from export_models import face_model

from isa_nrsfm import AffineNRSfM
from isa_nrsfm._parameters.choices import LOSSES
from isa_nrsfm.datasets import make_nonrigid_tracks

ROOT = Path(__file__).resolve().parents[1]
TEXT = (ROOT / "CONTRIBUTING.md").read_text(encoding="utf-8")
BLOCK = re.compile(r"^   ```python\n(.*?)^   ```$", re.DOTALL | re.MULTILINE)
FOLDERS = "isa_nrsfm|tests|docs|benchmarks"


def names_of(word):
    """Run the one block of code that has a word; return its names."""
    (code,) = [found for found in BLOCK.findall(TEXT) if word in found]
    names = {}
    exec(compile(textwrap.dedent(code), "CONTRIBUTING.md", "exec"), names)
    return names


def test_files_that_are_named_exist():
    named = set(re.findall(rf"(?:{FOLDERS})/[\w/]+\.(?:py|md|rst|png)", TEXT))
    # What is called new is for the reader to write.
    named -= set(re.findall(r"\bnew\s+(?:module )?`([^`]*)`", TEXT))
    assert len(named) > 30
    assert [name for name in sorted(named) if not (ROOT / name).is_file()] == []


@pytest.mark.parametrize("page", ["architecture", "method"])
def test_modules_that_a_page_names_exist(page):
    text = (ROOT / "docs" / f"{page}.md").read_text(encoding="utf-8")
    named = set(re.findall(r"`((?:_\w+|isa)/\w+\.py)`", text))
    assert len(named) > 10
    package = ROOT / "isa_nrsfm"
    assert [name for name in sorted(named) if not (package / name).is_file()] == []


def test_the_map_has_all_folders():
    picture = TEXT.partition("```text\n")[2].partition("```")[0]
    folders = {path.parent.name for path in ROOT.glob("isa_nrsfm/*/__init__.py")}
    assert folders <= set(re.findall(r"\w+", picture))


def test_the_strategy_is_one():
    isa = names_of("class KurtosisISA")["KurtosisISA"]()
    table = make_nonrigid_tracks(100, 60, 2, noise=0.001, random_state=0).data
    model = AffineNRSfM(2, isa=isa, refinement="alternating").fit(table)
    assert model.inverse_snr_ < 0.02


def test_the_loss_has_the_constant_that_is_computed(capsys):
    assert f"LOSSES = {LOSSES}".replace("'", '"')[:-1] in TEXT
    names_of("def efficiency")
    computed = float(capsys.readouterr().out)
    given = re.search(r'TUNING = \{.*"soft_l1": ([\d.]+)\}', TEXT)[1]
    assert float(given) == pytest.approx(computed, abs=1e-4)


def test_the_reader_reads(tmp_path):
    tracks = files.scene()
    path = names_of("def write_long")["write_long"](tmp_path / "a.csv", tracks)
    reader = names_of("def read_long_table")
    assert reader["is_long_table"](path)
    landmarks = reader["read_long_table"](path)
    np.testing.assert_array_equal(landmarks.points, tracks.reshape(12, -1))
    path.write_text("frame,point\n0,a\n")
    with pytest.raises(ValueError, match="its columns are not frame, point, x, y"):
        reader["read_long_table"](path)


def test_the_writer_writes(tmp_path):
    path = tmp_path / "mean.obj"
    names_of("def write_obj")["write_obj"](face_model(), path)
    lines = path.read_text().splitlines()
    assert len(lines) == 68
    assert all(line.startswith("v ") for line in lines)
