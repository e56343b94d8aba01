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


# The frames of the page that shows 40.
SHOWN = np.linspace(0, N_FRAMES - 1, 40).astype(int)


def show(browser, frame):
    """Move the slider of frames."""
    browser.at("frame", f"value = {frame}")
    browser.at("frame", "dispatchEvent(new Event('input'))")


def texts_of(browser, selector):
    return browser.run(
        f"[...document.querySelectorAll('{selector}')].map((e) => e.textContent)"
    )


@pytest.fixture(scope="module")
def program(tmp_path_factory):
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
    write_viewer(face_model(), path, labels=LABELS, names=names, n_frames=40)
    return path.as_uri()


@pytest.fixture
def browser(program, page):
    """Return a browser that shows this page."""
    program.open(page)
    return program


def opened(browser, folder, model, **options):
    """Write the page of a model, and open it."""
    write_viewer(model, path := folder / "viewer.html", **options)
    browser.open(path.as_uri())


def test_sliders_move_the_points(browser):
    before = browser.array("viewer.points()")
    browser.at("weight-0", "focus()")
    for _ in range(5):
        browser.press("PageUp", 33)
    weight = browser.run("viewer.state().weights[0]")
    assert weight > 1
    moved = np.linalg.norm(browser.array("viewer.points()") - before, axis=1)
    assert moved[8] > 0.05  # the chin, as the jaw opens
    assert moved[27] < moved[8] / 2
    assert browser.run("document.querySelector('output').textContent") == ""
    shown = browser.run("document.querySelector('.weight output').value")
    assert shown == f"{weight:.2f}"
    browser.click("reset")
    assert_allclose(browser.array("viewer.points()"), before)


def test_a_page_asks_for_nothing_and_has_no_errors(browser, page):
    # Names and labels are shown as they are.
    assert browser.run("document.title") == "3D shape model"
    assert texts_of(browser, ".weight label") == ["jaw", HOSTILE, "brows"]
    assert texts_of(browser, "#legend li") == sorted(set(LABELS))
    assert texts_of(browser, "b") == []
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


def test_the_mouse_turns_and_zooms_the_shape(browser):
    x, y, width, height = browser.box("scene")
    x, y = x + width / 2, y + height / 2
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


def test_keys_and_fingers_turn_and_zoom_the_shape(program, page):
    program.open(page, width=390, height=844, mobile=True)
    program.touch([(150, 350)], [(200, 350)])
    assert program.run("viewer.state().turn[0]") < 0.99
    program.touch([(150, 350), (200, 350)], [(100, 350), (250, 350)])
    assert program.run("viewer.state().zoom") > 1.5
    program.at("scene", "focus()")
    program.press("0", 48)
    for key, code in (("ArrowRight", 39), ("ArrowUp", 38), ("+", 187)):
        program.press(key, code)
    state = program.run("viewer.state()")
    assert state["zoom"] == pytest.approx(1.2)
    assert state["turn"][0] == pytest.approx(np.cos(0.1))
    program.press("0", 48)
    assert program.run("viewer.state().turn") == list(np.eye(3).ravel())


def test_frames_play_and_stop(browser):
    browser.at("pace", "value = '30'")
    browser.click("play")
    browser.wait("viewer.state().frame >= 3")
    assert browser.at("play", "textContent") == "Pause"
    browser.click("play")
    state = browser.run("viewer.state()")
    assert not state["playing"]
    row = SHOWN[state["frame"]]
    assert_allclose(state["weights"], face_model().alpha_[row], atol=1e-5)
    browser.run(DRAWN)
    assert browser.at("seen", "textContent") == f"row {row}: {LABELS[row]}"


def test_a_frame_is_seen_as_by_its_camera(browser):
    show(browser, 7)
    before = browser.array("viewer.projected()")[:, :2]
    browser.click("pose")
    seen = browser.array("viewer.projected()")[:, :2]
    image = faces().clean[SHOWN[7]]

    def distance(points):
        found, expected = (each - each.mean(axis=0) for each in (points, image))
        scale = np.sum(found * expected) / np.sum(found**2)
        return np.linalg.norm(scale * found - expected) / np.linalg.norm(expected)

    # The page has perspective, the camera has not.
    assert distance(seen) < 0.06 < distance(before)


def test_a_click_in_the_plane_of_coefficients_shows_the_nearest_frame(browser):
    browser.at("plane", "scrollIntoView()")
    x, y, width, height = browser.box("plane")
    # The frame with the largest first coefficient is farthest to the right.
    alpha = face_model().alpha_[SHOWN]
    right = int(np.argmax(alpha[:, 0]))
    share = (alpha[right, 1] - alpha[:, 1].min()) / np.ptp(alpha[:, 1])
    place = x + width - 10, y + height - 10 - share * (height - 20)
    browser.drag(place, place)
    browser.wait(f"viewer.state().frame === {right}")


def test_a_basis_shape_swings(browser):
    browser.run("document.querySelectorAll('.weight button')[2].click()")
    browser.wait("viewer.state().weights[2] > 1")
    assert browser.run("viewer.state().weights.slice(0, 2)") == [0, 0]
    browser.run("document.querySelectorAll('.weight button')[2].click()")
    assert browser.run("viewer.state().swinging") == -1


@pytest.mark.parametrize(("width", "mobile"), [(320, True), (1200, False)])
def test_pages_fit_the_width_of_the_window(program, page, width, mobile):
    program.open(page, width=width, height=700, mobile=mobile)
    assert program.run("document.documentElement.scrollWidth") == width
    boxes = program.run(
        "[...document.querySelectorAll('canvas, input, button, select')]"
        ".map((e) => e.getBoundingClientRect()).map((r) => [r.left, r.right])"
    )
    across = program.array("viewer.projected()")[:, 0]
    assert 0 <= min(np.min(boxes), across.min())
    assert max(np.max(boxes), across.max()) <= width


def test_one_basis_shape_and_no_face(program, tmp_path):
    opened(program, tmp_path, blob_model(), n_frames=0, edges=[[0, 1], [1, 2]])
    program.run(DRAWN)
    assert program.complaints() == []
    assert program.at("frames", "hidden")
    opened(program, tmp_path, blob_model(), camera=None)
    program.click("play")
    program.wait("viewer.state().frame >= 1")
    assert program.complaints() == []
    assert program.at("posed", "hidden")
    assert program.at("barred", "hidden")


def test_error_bars_are_along_the_viewing_direction(program, tmp_path):
    deviations = np.linspace(0.0, 1.0, 68)
    model = calibrated_model()
    opened(program, tmp_path, model, depth_std=deviations, n_frames=10)
    assert not program.at("barred", "hidden")
    show(program, 7)
    program.at("pose", "checked = true")
    program.click("front")
    # In the view of its camera a bar is a point, but for the perspective.
    size, lengths = np.ptp(program.array("viewer.projected()")[:, :2]), []
    program.at("scene", "focus()")
    for _ in range(2):
        far, near = program.array("viewer.bars()").reshape(2, 68, 3)[..., :2]
        lengths.append(np.linalg.norm(near - far, axis=1))
        for _ in range(16):  # to the side
            program.press("ArrowRight", 39)
    assert lengths[0].max() < 0.3 * lengths[1].max()
    assert_allclose(lengths[1], deviations * lengths[1][-1], atol=0.1 * size)
    assert np.corrcoef(lengths[1], deviations)[0, 1] > 0.99
    program.run(DRAWN)
    assert program.complaints() == []


def test_videos_play_at_true_speed(program, tmp_path):
    seconds = np.arange(N_FRAMES) * 0.05
    opened(program, tmp_path, face_model(), times=seconds, n_frames=N_FRAMES)
    assert program.at("pace", "value") == "true"
    begun = program.run("performance.now()")
    program.click("play")
    program.wait("viewer.state().frame >= 5")
    assert program.run("performance.now()") - begun >= 5 * 50
