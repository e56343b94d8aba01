import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal
from sklearn.exceptions import NotFittedError

from isa_nrsfm import AffineNRSfM
from isa_nrsfm.datasets import make_nonrigid_tracks

matplotlib = pytest.importorskip("matplotlib")
matplotlib.use("Agg")
from isa_nrsfm.plotting import CoefficientsDisplay  # noqa: E402

ALPHA = np.random.default_rng(0).normal(size=(30, 2))


@pytest.fixture(autouse=True)
def close_figures():
    yield
    matplotlib.pyplot.close("all")


def test_classes_have_boxes_of_their_frames():
    y = np.array(["b", "a", "c"])[np.arange(30) % 3]
    display = CoefficientsDisplay(alpha=ALPHA, y=y, label="mood").plot()
    assert len(display.axes_) == 2
    names = [text.get_text() for text in display.axes_[-1].get_xticklabels()]
    assert names == ["a", "b", "c"]
    for k, axes in enumerate(display.axes_):
        thick = [line for line in axes.lines if line.get_linewidth() == 1.4]
        medians = [line.get_ydata()[0] for line in thick]
        assert_allclose(medians, [np.median(ALPHA[y == c, k]) for c in "abc"])
    assert display.axes_[-1].get_xlabel() == "mood"


def test_numbers_are_points():
    age = np.linspace(20.5, 60, 30)
    display = CoefficientsDisplay(alpha=ALPHA, y=age).plot()
    points = display.axes_[1].collections[0].get_offsets()
    assert_allclose(points, np.column_stack([age, ALPHA[:, 1]]))


def test_curves_have_bands_and_stop_at_gaps_and_groups():
    time = np.r_[0:10, 20:30, 0:10].astype(float)
    groups = np.repeat(["x", "y"], [20, 10])
    display = CoefficientsDisplay(
        alpha=ALPHA, alpha_std=0.1 + 0 * ALPHA, time=time, groups=groups
    ).plot()
    line = display.axes_[0].lines[0]
    drawn = np.isfinite(line.get_ydata())
    assert_array_equal(np.flatnonzero(~drawn), [10, 21])
    assert_array_equal(line.get_xdata()[drawn], time)
    assert_array_equal(line.get_ydata()[drawn], ALPHA[:, 0])
    (band,) = display.axes_[0].collections
    assert len(band.get_paths()) == 3
    assert_allclose(band.get_paths()[1].get_extents().intervalx, [20, 29])
    low, high = (
        display.axes_[0]
        .collections[0]
        .get_datalim(display.axes_[0].transData)
        .intervaly
    )
    assert low == pytest.approx(ALPHA[:, 0].min() - 0.1)
    assert high == pytest.approx(ALPHA[:, 0].max() + 0.1)


def test_of_many_groups_the_largest_are_drawn_in_one_line():
    groups = np.r_[np.repeat(np.arange(50), 3), np.arange(50, 1000)]
    alpha = np.zeros((len(groups), 2))
    alpha[:150] = 1.0
    display = CoefficientsDisplay(alpha=alpha, alpha_std=alpha, groups=groups).plot()
    (line, _), title = display.axes_[0].lines, display.axes_[0].get_title("left")
    assert title == "the 50 of 1000 groups with the most frames"
    assert_array_equal(np.unique(line.get_ydata()), [1.0, np.nan])
    assert np.sum(line.get_ydata() == 1) == 150
    names = np.char.mod("%03d", groups)
    display = CoefficientsDisplay(alpha=alpha, y=names).plot(kind="classes")
    assert display.axes_[0].get_title("left").startswith("the 50 of 1000 classes")
    labels = [text.get_text() for text in display.axes_[1].get_xticklabels()]
    assert labels == [f"{number:03d}" for number in range(50)]


def test_single_frames_of_groups_are_dots():
    display = CoefficientsDisplay(alpha=ALPHA[:3], groups=[0, 0, 1]).plot()
    dots = display.axes_[0].lines[1]
    assert dots.get_marker() == "."
    assert_array_equal(dots.get_ydata(), ALPHA[2:3, 0])


def test_from_estimator():
    scene = make_nonrigid_tracks(
        n_frames=40, n_points=15, n_components=2, random_state=0
    )
    model = AffineNRSfM(2, random_state=0).fit(scene.data)
    display = CoefficientsDisplay.from_estimator(model)
    assert_array_equal(display.alpha, model.alpha_)
    assert_array_equal(display.alpha_std, model.alpha_std_)
    assert display.axes_[-1].get_xlabel() == "frame"
    other = CoefficientsDisplay.from_estimator(model, scene.data[:5], kind="time")
    assert_allclose(other.alpha, model.alpha_[:5], atol=1e-9)


def test_missing_coefficients_are_not_drawn():
    alpha = ALPHA.copy()
    alpha[3] = np.nan
    display = CoefficientsDisplay(alpha=alpha, y=["a", "b"] * 15).plot()
    assert len(display.axes_[0].collections[0].get_offsets()) == 29


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({"alpha": ALPHA[0]}, r"got shape \(2,\)"),
        ({"alpha_std": ALPHA[:3]}, r"shape \(30, 2\) of alpha; got \(3, 2\)"),
        ({"y": ["a"]}, "y must have one entry for each of the 30"),
        ({"component_names": ["a"]}, "must hold 2 names"),
    ],
)
def test_refusals(arguments, message):
    with pytest.raises(ValueError, match=message):
        CoefficientsDisplay(**{"alpha": ALPHA, **arguments})


def test_classes_need_labels():
    with pytest.raises(ValueError, match="kind='classes' needs y"):
        CoefficientsDisplay(alpha=ALPHA).plot(kind="classes")
    with pytest.raises(ValueError, match="must hold 2 axes"):
        CoefficientsDisplay(alpha=ALPHA).plot(matplotlib.pyplot.gca())
    with pytest.raises(NotFittedError):
        CoefficientsDisplay.from_estimator(AffineNRSfM(2))
