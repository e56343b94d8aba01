"""The page of a model, as a browser shows it."""

import numpy as np
import pytest
from browser import Browser, find_browser
from export_models import (
    HOSTILE,
    LABELS,
    N_FRAMES,
    blob_model,
    calibrated_model,
    face_model,
    faces,
)
from numpy.testing import assert_allclose

from isa_nrsfm.export import write_viewer

pytestmark = pytest.mark.browser

FRAME = "new Promise((done) => requestAnimationFrame("
DRAWN = FRAME + "() => requestAnimationFrame(done)))"


# The frames of the page that shows 60.
SHOWN = np.linspace(0, N_FRAMES - 1, 60).astype(int)


def show(browser, frame):
    """Move the slider of frames."""
    browser.run(
        "(() => { const slider = document.getElementById('frame'); slider.value ="
        f" {frame}; slider.dispatchEvent(new Event('input')); }})()"
    )


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


def opened(browser, folder, model, **options):
    """Write the page of a model, and open it."""
    write_viewer(model, path := folder / "viewer.html", **options)
    browser.open(path.as_uri())


def test_sliders_move_the_points(browser, page):
    browser.open(page)
    before = browser.array("viewer.points()")
    browser.run("document.getElementById('weight-0').focus()")
    for _ in range(5):
        browser.press("PageUp", 33)
    weight = browser.run("viewer.state().weights[0]")
    assert weight > 1
    after = browser.array("viewer.points()")
    moved = np.linalg.norm(after - before, axis=1)
    assert moved[8] > 0.05  # the chin, as the jaw opens
    assert moved[27] < moved[8] / 2
    assert browser.run("document.querySelector('output').textContent") == ""
    shown = browser.run("document.querySelector('.weight output').value")
    assert shown == f"{weight:.2f}"
    browser.click("reset")
    assert_allclose(browser.array("viewer.points()"), before)


def test_a_page_asks_for_nothing_and_has_no_errors(browser, page):
    browser.open(page)
    for name in ("play", "ghost", "mirror", "over", "pose", "front"):
        browser.click(name)
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
    # At first the shape is turned by 20 degrees.
    assert browser.run("viewer.state().turn[0]") == pytest.approx(np.cos(np.pi / 9))
    browser.click("front")
    before = browser.array("viewer.projected()")
    browser.drag((x, y), (x + 60, y))
    after = browser.array("viewer.projected()")
    assert after[30, 0] > before[30, 0] + 20  # the nose goes with the mouse
    assert browser.run("viewer.points()") == points
    assert browser.run("viewer.state().turn[0]") == pytest.approx(np.cos(0.6))

    wheel = {"type": "mouseWheel", "x": x, "y": y, "deltaX": 0, "deltaY": -300}
    browser.call("Input.dispatchMouseEvent", **wheel)
    browser.wait("viewer.state().zoom > 1.2")
    browser.click("front")
    assert_allclose(browser.array("viewer.projected()"), before, atol=1e-3)


def test_keys_turn_and_zoom_the_shape(browser, page):
    browser.open(page)
    browser.run("document.getElementById('scene').focus()")
    browser.press("0", 48)
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
    browser.click("play")
    browser.wait("viewer.state().frame >= 3")
    assert browser.run("document.getElementById('play').textContent") == "Pause"
    browser.click("play")
    state = browser.run("viewer.state()")
    assert not state["playing"]
    model = face_model()
    row = SHOWN[state["frame"]]
    assert_allclose(state["weights"], model.alpha_[row], atol=1e-5)
    browser.run(DRAWN)
    seen = browser.run("document.getElementById('seen').textContent")
    assert seen == f"row {row}: {LABELS[row]}"


def test_a_frame_is_seen_as_by_its_camera(browser, page):
    browser.open(page)
    show(browser, 7)
    before = browser.array("viewer.projected()")[:, :2]
    browser.click("pose")
    seen = browser.array("viewer.projected()")[:, :2]
    image = faces().clean[SHOWN[7]]

    def distance(points):
        points, target = points - points.mean(axis=0), image - image.mean(axis=0)
        scale = np.sum(points * target) / np.sum(points**2)
        return np.linalg.norm(scale * points - target) / np.linalg.norm(target)

    # The page has perspective, the camera has not.
    assert distance(seen) < 0.06 < distance(before)


def test_a_click_in_the_plane_of_coefficients_shows_the_nearest_frame(browser, page):
    browser.open(page)
    browser.run("document.getElementById('plane').scrollIntoView()")
    where = "document.getElementById('plane').getBoundingClientRect().toJSON()"
    box = browser.run(where)
    # The frame with the largest first coefficient is farthest to the right.
    alpha = face_model().alpha_[SHOWN]
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
    seen = browser.array("viewer.projected()")
    assert seen[:, 0].min() >= 0
    assert seen[:, 0].max() <= width


def test_one_basis_shape_and_no_face(browser, tmp_path):
    opened(browser, tmp_path, blob_model(), n_frames=0, edges=[[0, 1], [1, 2]])
    browser.run(DRAWN)
    assert browser.complaints() == []
    assert browser.run("document.getElementById('frames').hidden")
    opened(browser, tmp_path, blob_model(), camera=None)
    browser.click("play")
    browser.wait("viewer.state().frame >= 1")
    assert browser.complaints() == []
    assert browser.run("document.getElementById('posed').hidden")


def test_error_bars_are_along_the_viewing_direction(browser, tmp_path):
    given = {"depth_std": (deviations := np.linspace(0.0, 1.0, 68)), "n_frames": 10}
    opened(browser, tmp_path, calibrated_model(), **given)
    assert browser.run("viewer.state().frame") == 0
    assert not browser.run("document.getElementById('barred').hidden")
    for frame in (0, 7):
        show(browser, frame)
        browser.run("document.getElementById('pose').checked = true")
        browser.click("front")
        # In the view of its camera a bar is a point, but for the perspective.
        size = np.ptp(browser.array("viewer.projected()")[:, :2])
        lengths = []
        for _ in range(2):
            far, near = browser.array("viewer.bars()").reshape(2, 68, 3)[..., :2]
            lengths.append(np.linalg.norm(near - far, axis=1))
            browser.run("document.getElementById('scene').focus()")
            for _ in range(16):  # to the side
                browser.press("ArrowRight", 39)
        assert lengths[0].max() < 0.3 * lengths[1].max()
        assert_allclose(lengths[1], deviations * lengths[1][-1], atol=0.1 * size)
        assert np.corrcoef(lengths[1], deviations)[0, 1] > 0.99
    browser.run(DRAWN)
    assert browser.complaints() == []
    opened(browser, tmp_path, calibrated_model(), n_frames=10)
    assert browser.run("document.getElementById('barred').hidden")


INK = """
(() => {
  const scene = document.getElementById("scene");
  const { data } = scene.getContext("2d").getImageData(0, 0, scene.width, scene.height);
  const sums = {};
  for (let i = 0; i < data.length; i += 4) {
    if (data[i + 3] < 128) continue;
    const [red, green, blue] = data.subarray(i, i + 3);
    const kind = green > red + 30 && green > blue ? "left"
      : red > green + 30 && blue > green + 10 ? "right" : "other";
    const [n, x] = sums[kind] || [0, 0];
    sums[kind] = [n + 1, x + (i / 4) % scene.width];
  }
  return Object.fromEntries(Object.entries(sums).map(([k, [n, x]]) => [k, x / n]));
})()
"""


@pytest.mark.parametrize("scheme", ["light", "dark"])
def test_left_and_right_have_colours_of_their_own(browser, tmp_path, scheme):
    media = [{"name": "prefers-color-scheme", "value": scheme}]
    browser.call("Emulation.setEmulatedMedia", features=media)
    opened(browser, tmp_path, face_model())
    browser.run(DRAWN)
    found = browser.run(INK)
    browser.call("Emulation.setEmulatedMedia", features=[])
    # The left side of a face that looks at us is on the right.
    assert found["right"] < found["other"] < found["left"]
    assert not browser.run("document.getElementById('sides').hidden")


def test_videos_play_at_true_speed(browser, tmp_path):
    seconds = np.arange(N_FRAMES) * 0.05
    opened(browser, tmp_path, face_model(), times=seconds, n_frames=N_FRAMES)
    assert browser.run("document.getElementById('pace').value") == "true"
    begun = browser.run("performance.now()")
    browser.click("play")
    browser.wait("viewer.state().frame >= 5")
    passed = browser.run("performance.now()") - begun
    assert passed >= 5 * 50
