import json
import re
from html.parser import HTMLParser

import numpy as np
import pytest

pd = pytest.importorskip("pandas")
pytest.importorskip("matplotlib")

from isa_nrsfm.cli import main  # noqa: E402
from isa_nrsfm.datasets import make_nonrigid_tracks  # noqa: E402

HOSTILE = '<script>alert("x")</script>&"{{content}}'


class Page(HTMLParser):
    """Tags and text of a page."""

    def __init__(self, source):
        super().__init__()
        self.tags, self.texts, self.images = [], [], []
        self.feed(source)

    def handle_starttag(self, tag, attributes):
        self.tags.append(tag)
        if tag == "img":
            self.images.append(dict(attributes))

    def handle_data(self, data):
        self.texts.append(data)


@pytest.fixture(scope="module")
def run(tmp_path_factory):
    """Return the page and the report of a fit whose table has hostile texts."""
    folder = tmp_path_factory.mktemp("page")
    scene = make_nonrigid_tracks(
        n_frames=40, n_points=12, n_components=1, noise=0.01, random_state=0
    )
    names = [f"{c}{j}" for j in range(12) for c in "xy"]
    table = pd.DataFrame(scene.data, columns=names)
    table[HOSTILE] = np.where(np.arange(40) % 2, HOSTILE, "plain")
    table.to_csv(folder / "table.csv", index=False)
    arguments = ["fit", str(folder / "table.csv"), "-k", "1", "-o", str(folder / "out")]
    assert main([*arguments, "--label", HOSTILE]) == 0
    source = (folder / "out" / "report.html").read_text(encoding="utf-8")
    report = json.loads((folder / "out" / "report.json").read_text(encoding="utf-8"))
    return source, report


def test_texts_of_the_table_stay_text(run):
    source, _ = run
    page = Page(source)
    assert "script" not in page.tags
    assert HOSTILE in "".join(page.texts)


def test_it_needs_nothing_else(run):
    source, report = run
    page = Page(source)
    figures = [name for name in report["files"] if name.endswith(".png")]
    assert len(page.images) == len(figures) == 5
    for image in page.images:
        assert image["src"].startswith("data:image/png;base64,")
        assert image["alt"]
    assert not re.search(r"(src|href)=\"(?!data:)", source)
    assert "default-src 'none'" in source


def test_it_says_what_the_report_says(run):
    source, report = run
    text = "".join(Page(source).texts)
    assert "1 basis shape fitted to 40 frames of 12 points" in text
    held_out = 100 * report["model"]["held_out_error"]
    assert f"from the other points of their frame are off by {held_out:.3g} %" in text
    assert "not seen" not in text
    for warning in report["warnings"]:
        assert warning[1:] in text
    assert "isa-nrsfm fit" in text
    assert "alpha_1" in text
    for name in report["files"]:
        assert f"{name}: " in text


def test_it_is_in_the_report_of_files(run):
    _, report = run
    assert report["files"]["report.html"]
    assert report["arguments"][:1] == ["fit"]
