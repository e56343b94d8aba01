import base64
import hashlib
import json
import re

import numpy as np
import pandas as pd
import pytest
from browser import Browser, find_browser
from export_models import (
    N_COMPONENTS,
    N_FRAMES,
    blob_model,
    calibrated_model,
    face_model,
    faces,
)
from numpy.testing import assert_allclose, assert_array_equal

from isa_nrsfm.export import write_viewer

HOSTILE = "</script><script>document.title = 'taken'</script><b>&amp;'\"\u2028"
LABELS = [["neutral", HOSTILE, "smile"][i % 3] for i in range(N_FRAMES)]
DRAWN = (
    "new Promise((done) => requestAnimationFrame(() => requestAnimationFrame(done)))"
)


def content_of(path):
    """Return the data on a page."""
    text = path.read_text(encoding="utf-8")
    pattern = r'<script type="application/json" id="model">(.*?)</script>'
    return json.loads(re.search(pattern, text, re.DOTALL)[1])


def numbers(text, dtype="<f4"):
    return np.frombuffer(base64.b64decode(text), dtype)


@pytest.fixture
def written(tmp_path):
    """Return a function that writes a page and returns its data."""

    def write(model, **options):
        path = tmp_path / "viewer.html"
        write_viewer(model, path, **options)
        return content_of(path)

    return write


@pytest.fixture(scope="module")
def browser(tmp_path_factory):
    """Return a browser, or skip."""
    program = find_browser()
    if program is None:
        pytest.skip("no chromium or chrome is installed")
    browser = Browser(program, tmp_path_factory.mktemp("profile"))
    yield browser
    browser.close()


@pytest.fixture(scope="module")
def page(tmp_path_factory):
    """Return the address of a page with labels and names that need care."""
    path = tmp_path_factory.mktemp("page") / "viewer.html"
    names = ["jaw", HOSTILE, "brows"]
    write_viewer(face_model(), path, labels=LABELS, names=names, n_frames=60)
    return path.as_uri()


def test_a_page_is_one_file_that_asks_for_nothing(tmp_path):
    path = tmp_path / "viewer.html"
    write_viewer(face_model(), path)
    text = path.read_text(encoding="utf-8")
    assert "http" not in text.replace('http-equiv="Content-Security-Policy"', "")
    assert not re.search(r"\b(src|srcset|action)=|@import|url\(", text)
    script = re.search(r"<script>(.*?)</script>", text, re.DOTALL)[1]
    digest = base64.b64encode(hashlib.sha256(script.encode()).digest()).decode()
    assert f"script-src 'sha256-{digest}';" in text
    assert "default-src 'none';" in text
    assert "{{" not in text.replace(script, "")


def test_shapes_have_y_up_and_size_one(written):
    data = written(face_model())
    shapes = numbers(data["shapes"]).reshape(1 + N_COMPONENTS, 68, 3)
    assert np.linalg.norm(shapes[0], axis=1).max() == pytest.approx(1)
    assert_allclose(shapes[0].mean(axis=0), 0, atol=1e-6)
    assert shapes[0, 8, 1] < shapes[0, 27, 1]
    assert shapes[0, 30, 2] > shapes[0, 0, 2]
    assert len(numbers(data["edges"], "<u4")) > 100
    assert data["points"] == [str(j) for j in range(68)]


def test_frames_are_those_of_the_fit(written):
    model = face_model()
    data = written(model)
    alpha = numbers(data["alpha"]).reshape(-1, N_COMPONENTS)
    assert_array_equal(alpha, model.alpha_.astype("f4"))
    assert data["rows"] == [str(i) for i in range(N_FRAMES)]
    assert data["count"] == f"{N_FRAMES} rows."
    assert data["labels"] == data["categories"] == []


@pytest.mark.parametrize("camera", ["affine", "weak_perspective", "orthographic"])
def test_rotations_show_the_shapes_as_the_images_do(written, camera):
    truth, model = faces(noise=0.0), face_model(noise=0.0)
    if camera != "affine":
        truth, model = faces(camera=camera), calibrated_model(camera)
    data = written(model)
    told = "weak_perspective" if camera == "affine" else camera
    assert f"{told.replace('_', '-')} cameras" in data["about"]
    shapes = numbers(data["shapes"]).reshape(1 + N_COMPONENTS, -1).astype(float)
    alpha = numbers(data["alpha"]).reshape(-1, N_COMPONENTS)
    rotations = numbers(data["rotations"]).reshape(-1, 3, 3)
    frames = (shapes[0] + alpha @ shapes[1:]).reshape(-1, 68, 3)
    seen = (frames @ rotations.transpose(0, 2, 1))[:, :, :2] * [1, -1]
    images = truth.clean
    images = images - images.mean(axis=1, keepdims=True)
    seen = seen - seen.mean(axis=1, keepdims=True)
    scale = np.sum(seen * images, axis=(1, 2)) / np.sum(seen**2, axis=(1, 2))
    error = images - scale[:, None, None] * seen
    assert np.sum(error**2) < 1e-3 * np.sum(images**2)


def test_few_frames_are_spread_over_the_rows(written):
    data = written(face_model(), n_frames=4)
    assert data["rows"] == ["0", "49", "99", "149"]
    assert data["count"] == f"4 of {N_FRAMES} rows, evenly spread."
    assert written(face_model(), n_frames=0)["rows"] == []


def test_other_tables_are_shown_by_their_index(written):
    model = face_model()
    table = pd.DataFrame(faces().data[:6].copy(), index=list("abcdef"))
    table.iloc[2] = np.nan
    data = written(model, X=table.to_numpy(), n_frames=5)
    assert data["rows"] == ["0", "1", "3", "5"]
    assert data["count"] == (
        "5 of 6 rows, evenly spread; 1 of them show too few points."
    )
    alpha = numbers(data["alpha"]).reshape(-1, N_COMPONENTS)
    assert_allclose(alpha, model.alpha_[[0, 1, 3, 5]], atol=1e-5)
    data = written(model, X=table, labels=list("uvwxyz"))
    assert data["rows"] == list("abdef")
    assert data["labels"] == [0, 1, 3, 4, 5]
    assert written(model, X=table, n_frames=0)["rows"] == []


def test_labels_are_sorted_numbers_first_and_none_last(written):
    model = blob_model()
    labels = np.array([10, 9.5, "b", None, "a", np.nan, 9.5, 10] * 5, dtype=object)
    data = written(model, labels=labels)
    assert data["categories"] == ["9.5", "10", "a", "b", "(no label)"]
    assert data["labels"][:8] == [1, 0, 3, 4, 2, 4, 0, 1]
    pd = pytest.importorskip("pandas", reason="needs the extra io")
    labels = pd.array(["b", None, "a", "b"] * 10, dtype="string")
    data = written(model, labels=labels)
    assert data["categories"] == ["a", "b", "(no label)"]
    assert data["labels"][:4] == [1, 2, 0, 1]


def test_affine_shapes_have_no_poses_and_say_so(written):
    data = written(face_model(), camera=None)
    assert data["rotations"] == ""
    assert data["about"].startswith("Affine shapes: angles and depth are not")


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"labels": ["a", "b"]}, "labels must hold 150 labels, one a row; got"),
        ({"labels": range(N_FRAMES)}, "at most 30 different values; got 150"),
        ({"n_frames": -1}, "n_frames must be a whole number, not negative; got -1"),
        ({"n_frames": 2.5}, "n_frames must be a whole number, not negative; got 2.5"),
        ({"names": ["jaw"]}, "names must hold 3 names"),
        ({"edges": [[0, 99]]}, "edges must name points 0 to 67"),
    ],
    ids=["few", "many", "negative", "fraction", "names", "edges"],
)
def test_bad_options_are_refused(tmp_path, options, message):
    path = tmp_path / "viewer.html"
    with pytest.raises(ValueError, match=message):
        write_viewer(face_model(), path, **options)
    assert not path.exists()


def test_other_suffixes_are_refused(tmp_path):
    with pytest.raises(ValueError, match=r"must end in \.html; got .*viewer\.txt"):
        write_viewer(face_model(), tmp_path / "viewer.txt")


def test_sliders_move_the_points(browser, page):
    browser.open(page)
    before = np.reshape(browser.run("viewer.points()"), (-1, 3))
    browser.run("document.getElementById('weight-0').focus()")
    for _ in range(5):
        browser.press("PageUp", 33)
    weight = browser.run("viewer.state().weights[0]")
    assert weight > 1
    after = np.reshape(browser.run("viewer.points()"), (-1, 3))
    moved = np.linalg.norm(after - before, axis=1)
    assert moved[8] > 0.05  # the chin, as the jaw opens
    assert moved[27] < moved[8] / 2
    assert browser.run("document.querySelector('output').textContent") == ""
    assert browser.run("document.querySelector('.weight output').value") == (
        f"{weight:.2f}"
    )
    browser.run("document.getElementById('reset').click()")
    assert_allclose(np.reshape(browser.run("viewer.points()"), (-1, 3)), before)


def test_a_page_asks_for_nothing_and_has_no_errors(browser, page):
    browser.open(page)
    for name in ("play", "ghost", "mirror", "over", "pose", "front"):
        browser.run(f"document.getElementById('{name}').click()")
        browser.run(DRAWN)
    browser.run("document.querySelector('.weight button').click()")
    browser.run(DRAWN)
    assert browser.complaints() == []
    assert browser.requests() == [page]
    # What the page forbids is noticed here, too.
    code = "fetch('https://example.org').catch((error) => error.name)"
    assert browser.run(code) == "TypeError"
    assert "Content Security Policy" in str(browser.complaints())
    browser.run("console.error('this')")
    assert len(browser.complaints()) >= 2


def test_names_and_labels_are_shown_as_they_are(browser, page):
    browser.open(page)
    assert browser.run("document.title") == "3D shape model"
    labels = "[...document.querySelectorAll('.weight label')].map((e) => e.textContent)"
    assert browser.run(labels) == ["jaw", HOSTILE, "brows"]
    legend = "[...document.querySelectorAll('#legend li')].map((e) => e.textContent)"
    assert browser.run(legend) == sorted(set(LABELS))
    assert browser.run("document.querySelectorAll('b').length") == 0


def test_the_mouse_turns_and_zooms_the_shape(browser, page):
    browser.open(page)
    places = "document.getElementById('scene').getBoundingClientRect().toJSON()"
    box = browser.run(places)
    x, y = box["x"] + box["width"] / 2, box["y"] + box["height"] / 2
    points = browser.run("viewer.points()")
    before = np.reshape(browser.run("viewer.projected()"), (-1, 3))
    browser.drag((x, y), (x + 60, y))
    after = np.reshape(browser.run("viewer.projected()"), (-1, 3))
    assert after[30, 0] > before[30, 0] + 20  # the nose goes with the mouse
    assert browser.run("viewer.points()") == points
    assert browser.run("viewer.state().turn[0]") == pytest.approx(np.cos(0.6))

    browser.call(
        "Input.dispatchMouseEvent", type="mouseWheel", x=x, y=y, deltaX=0, deltaY=-300
    )
    browser.wait("viewer.state().zoom > 1.2")
    browser.run("document.getElementById('front').click()")
    again = np.reshape(browser.run("viewer.projected()"), (-1, 3))
    assert_allclose(again, before, atol=1e-3)


def test_keys_turn_and_zoom_the_shape(browser, page):
    browser.open(page)
    browser.run("document.getElementById('scene').focus()")
    for key, code in (("ArrowRight", 39), ("ArrowUp", 38), ("+", 187)):
        browser.press(key, code)
    state = browser.run("viewer.state()")
    assert state["zoom"] == pytest.approx(1.2)
    assert state["turn"][0] == pytest.approx(np.cos(0.1))
    browser.press("0", 48)
    assert browser.run("viewer.state().turn") == list(np.eye(3).ravel())


def test_fingers_turn_and_pinch_the_shape(browser, page):
    browser.open(page, width=390, height=844, mobile=True)

    def touch(kind, *places):
        points = [{"x": x, "y": y, "id": i} for i, (x, y) in enumerate(places)]
        browser.call("Input.dispatchTouchEvent", type=kind, touchPoints=points)

    touch("touchStart", (150, 350))
    touch("touchMove", (200, 350))
    touch("touchEnd")
    assert browser.run("viewer.state().turn[0]") < 0.99
    touch("touchStart", (150, 350), (200, 350))
    touch("touchMove", (100, 350), (250, 350))
    touch("touchEnd")
    assert browser.run("viewer.state().zoom") > 1.5


def test_frames_play_and_stop(browser, page):
    browser.open(page)
    browser.run("document.getElementById('pace').value = '30'")
    browser.run("document.getElementById('play').click()")
    browser.wait("viewer.state().frame >= 3")
    assert browser.run("document.getElementById('play').textContent") == "Pause"
    browser.run("document.getElementById('play').click()")
    state = browser.run("viewer.state()")
    assert not state["playing"]
    model = face_model()
    row = int(np.linspace(0, N_FRAMES - 1, 60)[state["frame"]])
    assert_allclose(state["weights"], model.alpha_[row], atol=1e-5)
    browser.run(DRAWN)
    seen = browser.run("document.getElementById('seen').textContent")
    assert seen == f"frame {row}: {LABELS[row]}"


def test_a_frame_is_seen_as_by_its_camera(browser, page):
    browser.open(page)
    browser.run(
        "(() => { const slider = document.getElementById('frame'); slider.value = 7;"
        " slider.dispatchEvent(new Event('input')); })()"
    )
    before = np.reshape(browser.run("viewer.projected()"), (-1, 3))[:, :2]
    browser.run("document.getElementById('pose').click()")
    seen = np.reshape(browser.run("viewer.projected()"), (-1, 3))[:, :2]
    row = int(np.linspace(0, N_FRAMES - 1, 60)[7])
    image = faces().clean[row]

    def distance(points):
        points, target = points - points.mean(axis=0), image - image.mean(axis=0)
        scale = np.sum(points * target) / np.sum(points**2)
        return np.linalg.norm(scale * points - target) / np.linalg.norm(target)

    # The page has perspective, the camera has not.
    assert distance(seen) < 0.06 < distance(before)


def test_a_click_in_the_plane_of_coefficients_shows_the_nearest_frame(browser, page):
    browser.open(page)
    browser.run("document.getElementById('plane').scrollIntoView()")
    box = browser.run(
        "document.getElementById('plane').getBoundingClientRect().toJSON()"
    )
    # The frame with the largest first coefficient is farthest to the right.
    alpha = face_model().alpha_[np.linspace(0, N_FRAMES - 1, 60).astype(int)]
    right = int(np.argmax(alpha[:, 0]))
    share = (alpha[right, 1] - alpha[:, 1].min()) / np.ptp(alpha[:, 1])
    x = box["x"] + box["width"] - 10
    y = box["y"] + box["height"] - 10 - share * (box["height"] - 20)
    browser.drag((x, y), (x, y))
    browser.wait(f"viewer.state().frame === {right}")


def test_a_basis_shape_swings(browser, page):
    browser.open(page)
    browser.run("document.querySelectorAll('.weight button')[2].click()")
    browser.wait("viewer.state().weights[2] > 1")
    assert browser.run("viewer.state().weights.slice(0, 2)") == [0, 0]
    browser.run("document.querySelectorAll('.weight button')[2].click()")
    assert browser.run("viewer.state().swinging") == -1


@pytest.mark.parametrize(("width", "mobile"), [(320, True), (390, True), (1200, False)])
def test_pages_fit_the_width_of_the_window(browser, page, width, mobile):
    browser.open(page, width=width, height=700, mobile=mobile)
    assert browser.run("document.documentElement.scrollWidth") == width
    boxes = browser.run(
        "[...document.querySelectorAll('canvas, input, button, select')]"
        ".map((e) => e.getBoundingClientRect()).map((r) => [r.left, r.right])"
    )
    assert np.min(boxes) >= 0
    assert np.max(boxes) <= width
    seen = np.reshape(browser.run("viewer.projected()"), (-1, 3))
    assert seen[:, 0].min() >= 0
    assert seen[:, 0].max() <= width


def test_one_basis_shape_and_no_face(browser, tmp_path):
    path = tmp_path / "viewer.html"
    write_viewer(blob_model(), path, n_frames=0, edges=[[0, 1, 2]])
    browser.open(path.as_uri())
    browser.run(DRAWN)
    assert browser.complaints() == []
    assert browser.run("document.getElementById('frames').hidden")
    write_viewer(blob_model(), path, camera=None)
    browser.open(path.as_uri())
    browser.run("document.getElementById('play').click()")
    browser.wait("viewer.state().frame >= 1")
    assert browser.complaints() == []
    assert browser.run("document.getElementById('posed').hidden")
