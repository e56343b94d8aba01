"""The pages for contributors name files, names and folders that exist."""

import re

from project import ROOT, text
from refusals import refusals_of

TEXT = text("CONTRIBUTING.md")


def between(start, end):
    """Return the text after a start, up to an end."""
    return TEXT.partition(start)[2].partition(end)[0]


NAMED = set(re.findall(r"(?:isa_nrsfm|tests|docs)/[\w/]+\.(?:py|md|rst)", TEXT))
NAMED |= {f"tests/{name}" for name in re.findall(r"`(test_\w+\.py)`", TEXT)}
REGISTERS = re.findall(r"`(\w+)` (?:in|of)\s`?([\w/]+\.py)", TEXT)
FOLDERS = {path.parent.name for path in ROOT.glob("isa_nrsfm/*/__init__.py")}
BENCHMARKS = re.findall(r"`(\w+)`", between("joint`, a part", "are commands"))
ROWS = re.findall(
    r"^\| .+ \| .+ \| (`.+`) \|$",
    between("## Tables as people write them", "\n## "),
    re.MULTILINE,
)


def absent(folder, names):
    """Return names of files that a folder does not have, except of an addition."""
    return [name for name in names if not (folder / name).is_file() | ("NAME" in name)]


def modules_of(page):
    """Return the modules that a page names."""
    return re.findall(r"`((?:_\w+|isa|cli)/\w+\.py)`", text(f"docs/{page}.md"))


test_refusals = refusals_of("contributing", globals())
