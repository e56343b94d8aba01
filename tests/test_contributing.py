"""The pages for contributors name files, names and folders that exist."""

import re
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[1]
TEXT = (ROOT / "CONTRIBUTING.md").read_text(encoding="utf-8")


def test_files_and_names_exist():
    named = set(re.findall(r"(?:isa_nrsfm|tests|docs)/[\w/]+\.(?:py|md|rst)", TEXT))
    named |= {f"tests/{name}" for name in re.findall(r"`(test_\w+\.py)`", TEXT)}
    named = {name for name in named if "NAME" not in name}  # of an addition
    assert len(named) > 40
    assert [name for name in sorted(named) if not (ROOT / name).is_file()] == []
    registers = re.findall(r"`(\w+)` (?:in|of)\s`?([\w/]+\.py)", TEXT)
    assert len(registers) >= 4
    for name, file in registers:
        code = (ROOT / file).read_text(encoding="utf-8")
        assert re.search(rf"\b{name}\b", code), (name, file)


def test_ways_of_writing_tables_are_those_that_are_tested():
    section = TEXT.partition("## Tables as people write them")[2].partition("\n## ")[0]
    rows = re.findall(r"^\| .+ \| .+ \| (`.+`) \|$", section, re.MULTILINE)
    listed = re.findall(r"`(\w+)`", " ".join(rows))
    file = ROOT / "tests" / "test_tables_of_people.py"
    tests = re.findall(r"^(?:def )?test_(\w+)", file.read_text("utf-8"), re.MULTILINE)
    assert {*listed} == {*tests}


def test_commands_exist():
    sessions = re.findall(r"def (\w+)\(session", (ROOT / "noxfile.py").read_text())
    listed = TEXT.partition("`nox -s lint`")[2].partition("in fresh")[0]
    assert set(re.findall(r"`(\w+)`", listed)) | {"lint"} == set(sessions)
    folder = ROOT / "benchmarks"
    listed = TEXT.partition("joint`, a part")[2].partition("are commands")[0]
    for name in re.findall(r"`(\w+)`", listed):
        assert (folder / f"{name}.py").is_file(), name


def test_the_map_has_all_folders():
    picture = TEXT.partition("```text\n")[2].partition("```")[0]
    folders = {path.parent.name for path in ROOT.glob("isa_nrsfm/*/__init__.py")}
    assert folders <= set(re.findall(r"\w+", picture))


@pytest.mark.parametrize("page", ["architecture", "method"])
def test_modules_that_a_page_names_exist(page):
    text = (ROOT / "docs" / f"{page}.md").read_text(encoding="utf-8")
    named = set(re.findall(r"`((?:_\w+|isa|cli)/\w+\.py)`", text))
    assert len(named) > 10
    package = ROOT / "isa_nrsfm"
    assert [name for name in sorted(named) if not (package / name).is_file()] == []
