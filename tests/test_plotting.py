"""The contract of all displays: axes, refusals, styles, and what all have in common."""

import subprocess
import sys

import matplotlib.pyplot as plt
import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal
from refusals import refused
from sklearn.exceptions import NotFittedError

from isa_nrsfm import AffineNRSfM, AffineNRSfMCV, plotting
from isa_nrsfm.datasets import make_body_tracks, make_face_tracks, make_hand_tracks
from isa_nrsfm.plotting import (
    BasisShapeDisplay,
    CoefficientsDisplay,
    ComponentChoiceDisplay,
    ModeCovarianceDisplay,
    ReprojectionDisplay,
)
from isa_nrsfm.skeletons import get_skeleton

RNG = np.random.default_rng(0)
POINTS = RNG.standard_normal((6, 10, 2))
SCORES = np.array([[-0.020, -0.030, -0.025], [-0.002, -0.003, -0.004]])
# Of each display: arguments, the number of its axes, and arguments of styles.
DISPLAYS = {
    BasisShapeDisplay: (
        {
            "mean_shape": RNG.standard_normal((20, 3)),
            "basis": 0.1 * RNG.standard_normal((3, 20, 3)),
            "edges": [[0, 1], [1, 2]],
            "component_names": ["a name of some length " * 3] * 3,
            "energy_share": [0.5, 0.3, 0.2],
        },
        8,
        {
            "point_kw": {"s": 11},
            "edge_kw": {"linewidths": 3},
            "arrow_kw": {"zorder": 9},
        },
    ),
    CoefficientsDisplay: ({"alpha": RNG.standard_normal((30, 2))}, 2, {}),
    ComponentChoiceDisplay: (
        {"n_components": [2, 4], "scores": SCORES, "chosen": 4},
        1,
        {"errorbar_kw": {"color": "red"}},
    ),
    ModeCovarianceDisplay: (
        {"mode_covariance": np.eye(6)},
        1,
        {"im_kw": {"cmap": "PuOr"}},
    ),
    ReprojectionDisplay: (
        {"observed": POINTS, "reprojected": 1.1 * POINTS, "edges": [[0, 1]]},
        6,
        {
            "observed_kw": {"s": 21},
            "reprojected_kw": {"s": 22},
            "edge_kw": {"linewidths": 4},
        },
    ),
}
EACH = pytest.mark.parametrize("kind", DISPLAYS)


@pytest.fixture(autouse=True)
def close_figures():
    yield
    plt.close("all")


@pytest.mark.subprocess
def test_matplotlib_is_imported_only_to_draw():
    assert [kind.__name__ for kind in DISPLAYS] == plotting.__all__
    code = "import sys, isa_nrsfm.plotting; sys.exit('matplotlib' in sys.modules)"
    assert subprocess.run([sys.executable, "-c", code], check=False).returncode == 0


@EACH
def test_without_matplotlib_the_extra_is_named(monkeypatch, kind):
    display = kind(**DISPLAYS[kind][0])
    for name in [name for name in sys.modules if name.split(".")[0] == "matplotlib"]:
        monkeypatch.setitem(sys.modules, name, None)
    refused(r"isa-nrsfm\[plot\]", display.plot, error=ImportError)


@EACH
def test_displays_draw_on_a_new_figure_or_given_axes(kind):
    arguments, n_axes, styles = DISPLAYS[kind]
    display = kind(**arguments)
    assert display.plot(**styles) is display
    assert plt.get_fignums() == [display.figure_.number]
    # Titles, labels and legends are on the page, and do not cover each other.
    figure = display.figure_
    figure.canvas.draw()
    boxes = [legend.get_window_extent() for legend in figure.legends]
    for ax in figure.axes:
        titles = (title for title in (ax.title, ax._left_title) if title.get_text())
        boxes += [title.get_window_extent() for title in titles]
    for i, box in enumerate(boxes):
        assert figure.bbox.x0 <= box.x0 <= box.x1 <= figure.bbox.x1
        assert figure.bbox.y0 <= box.y0 <= box.y1 <= figure.bbox.y1
        assert not any(box.overlaps(other) for other in boxes[i + 1 :])
    figure, axes = plt.subplots(n_axes)
    display.plot(axes)
    assert display.figure_ is figure
    assert not figure.legends
    refused(f"ax must hold {n_axes} axes, .*; got 9", display.plot, plt.subplots(9)[1])


@EACH
def test_displays_take_keywords_and_fitted_estimators(kind):
    arguments = DISPLAYS[kind][0]
    refused(None, kind, *list(arguments.values())[:2], error=TypeError)
    choice = kind is ComponentChoiceDisplay
    table = [np.zeros((3, 4))] if kind is ReprojectionDisplay else []
    with pytest.raises(NotFittedError):
        kind.from_estimator(AffineNRSfMCV() if choice else AffineNRSfM(), *table)
    assert plt.get_fignums() == []


def test_styles_can_be_changed():
    kinds = DISPLAYS.items()
    drawn = [kind(**given).plot(**styles) for kind, (given, _, styles) in kinds]
    shapes, _, choice, covariance, frames = drawn
    assert shapes.plus_[0].get_sizes() == [11]
    assert shapes.axes_[1, 0].collections[0].get_linewidths() == [3]
    assert shapes.arrows_[0].get_zorder() == 9
    assert choice.errorbar_.lines[0].get_color() == "red"
    assert covariance.im_.get_cmap().name == "PuOr"
    assert frames.observed_[0].get_sizes() == [21]
    assert frames.reprojected_[0].get_sizes() == [22]
    assert frames.edges_[0].get_linewidths() == [4]


@pytest.mark.parametrize(
    ("kind", "changed", "message"),
    [
        (BasisShapeDisplay, {"mean_shape": np.zeros((4, 2))}, r"got \(4, 2\) and"),
        (BasisShapeDisplay, {"basis": np.zeros((2, 5, 3))}, r"and \(2, 5, 3\)"),
        (BasisShapeDisplay, {"energy_share": [1.0]}, r"3 numbers.*got shape \(1,\)"),
        (BasisShapeDisplay, {"component_names": ["a"]}, "must hold 3 names.*got 1"),
        (BasisShapeDisplay, {"edges": [[0, 20]]}, "points 0 to 19; got 0 to 20"),
        (BasisShapeDisplay, {"origin": "left"}, "got 'left'"),
        (CoefficientsDisplay, {"alpha": [1.0, 2.0]}, r"got shape \(2,\)"),
        (CoefficientsDisplay, {"alpha_std": np.eye(3)}, r"of alpha; got \(3, 3\)"),
        (CoefficientsDisplay, {"y": ["a"]}, "y must have one entry for each of the 30"),
        (CoefficientsDisplay, {"component_names": ["a"]}, "must hold 2 names"),
        (ComponentChoiceDisplay, {"scores": SCORES[0]}, "one row for each"),
        (ComponentChoiceDisplay, {"n_components": [1, 2, 3]}, "one row for each"),
        (ComponentChoiceDisplay, {"chosen": 3}, "chosen must be one of n_components"),
        *(
            (ModeCovarianceDisplay, {"mode_covariance": np.zeros(shape)}, "a square")
            for shape in ((4, 4), (3, 6), (0, 0), (3,))
        ),
        (ModeCovarianceDisplay, {"component_names": ["one"]}, "must hold 2 names"),
        (ReprojectionDisplay, {"reprojected": POINTS[:, 1:]}, r"\(6, 9, 2\)"),
        (ReprojectionDisplay, {"observed": np.zeros((2, 9))}, r"got \(2, 9\) and"),
        (ReprojectionDisplay, {"frames": [1]}, r"the 6 frames; got shape \(1,\)"),
        (ReprojectionDisplay, {"frame_names": ["a"]}, "must hold 6 names"),
        (ReprojectionDisplay, {"edges": [[0, 10]]}, "points 0 to 9"),
        (ReprojectionDisplay, {"origin": "down"}, "got 'down'"),
        (ReprojectionDisplay, {"observed": 0 * POINTS}, "seen points are in one place"),
    ],
)
def test_bad_arguments_are_refused(kind, changed, message):
    refused(message, kind, **DISPLAYS[kind][0] | changed)


@pytest.mark.parametrize(
    ("kind", "arguments", "message"),
    [
        (BasisShapeDisplay, {"n_std": [1, 2]}, "one for each basis shape.*got shape"),
        *(
            (BasisShapeDisplay, {"components": each}, "basis shapes, from 0 to 2")
            for each in ([3], [-1], [], 0, [0.0])
        ),
        (CoefficientsDisplay, {"kind": "classes"}, "kind='classes' needs y"),
        (ModeCovarianceDisplay, {"scale": "log"}, "got 'log'"),
    ],
)
def test_bad_arguments_of_plot_are_refused(kind, arguments, message):
    refused(message, kind(**DISPLAYS[kind][0]).plot, **arguments)


def drawn_shapes(mean_shape, basis=None, **options):
    """Return a display of shapes, by default of one that does not move."""
    basis = np.zeros((1, *np.shape(mean_shape))) if basis is None else basis
    return BasisShapeDisplay(mean_shape=mean_shape, basis=basis, **options)


def test_shares_are_percent_of_two_digits():
    shown = {
        **{0.0: "0", 1.0: "100", 0.434: "43", 0.0996: "10", 0.996: "100"},
        **{1.234: "123", 0.000996: "0.10", 3.2e-5: "0.0032", 4.1e-32: "4.1e-30"},
    }
    basis, share = np.zeros((9, 4, 3)), [*shown]
    axes = drawn_shapes(np.eye(4, 3), basis, energy_share=share).plot().axes_
    titles = [ax.get_title(loc="left").replace("\n", " ") for ax in axes[1:, 0]]
    numbers = enumerate(shown.values(), 1)
    assert titles == [f"Basis shape {k} ({text} % of energy)" for k, text in numbers]


def test_shapes_are_inside_limits_of_one_scale(rng):
    mean = rng.standard_normal((20, 3)) * [2, 1, 0.5]
    sizes = np.array([0.1, 0.2, 0.1, 30.0])
    basis = sizes[:, None, None] * rng.standard_normal((4, 20, 3))
    display = drawn_shapes(mean, basis).plot(n_std=1)
    limits = np.array([[ax.get_xlim(), ax.get_ylim()] for ax in display.axes_.ravel()])
    limits = np.sort(limits.reshape(5, 2, 2, 2))
    for drift, (front, side) in zip([0 * mean, *basis], limits, strict=True):
        points = np.concatenate([mean - drift, mean + drift])
        for (low, high), xy in ((front.T, points[:, :2]), (side.T, points[:, [2, 1]])):
            assert (low < xy).all()
            assert (xy < high).all()
    # One scale and one window, but for the basis shape out of all proportion.
    assert_array_equal(limits[1:4], limits[[0, 0, 0]])
    ratio = np.ptp(limits[4], axis=-1) / np.ptp(limits[0], axis=-1)
    assert_allclose(ratio, ratio[0, 0])
    assert ratio[0, 0] > 10
    title = display.axes_[4, 0].get_title(loc="left")
    assert title == f"Basis shape 4 (drawn 1:{ratio[0, 0]:.2g})"
    # Large drifts alone are no reason for another scale.
    display.plot(n_std=50 / sizes)
    assert len({ax.get_xlim() for ax in display.axes_[1:, 0]}) == 1
    display = drawn_shapes(np.ones((5, 3))).plot()
    assert all(np.ptp(ax.get_xlim()) > 0 for ax in display.axes_.ravel())


@pytest.mark.parametrize("n_shapes", [2, 3, 10])
def test_shapes_fit_on_a_page(n_shapes, rng):
    for aspect in (0.25, 0.8, 3.0):
        mean = rng.uniform(size=(20, 3)) * [aspect, 1, aspect]
        display = drawn_shapes(mean, np.zeros((n_shapes - 1, 20, 3))).plot()
        figure = display.figure_
        assert figure.axes == list(display.axes_.ravel())
        assert display.axes_.shape == (n_shapes, 2)
        assert figure.get_figwidth() == 7.2
        assert figure.get_figheight() <= 7.6
    mean = np.array([[0, 0, 0], [1.0, 2.0, 3.0]])
    display = drawn_shapes(mean, np.zeros((4, 2, 3))).plot(n_columns=2)
    grid = display.axes_[0, 0].get_subplotspec().get_gridspec()
    assert (grid.nrows, grid.ncols) == (3, 4)
    ratios = np.array(grid.get_width_ratios())
    assert_allclose(ratios / ratios[0], [1, 3, 1, 3], rtol=0.1)


FACE = make_face_tracks(n_frames=2, random_state=0).mean_shape
HAND = make_hand_tracks(n_frames=60, random_state=0).mean_shape
BODY = make_body_tracks(n_frames=60, random_state=0).mean_shape
IBUG, COCO, HAND_21 = map(get_skeleton, ("ibug-68", "coco-17", "hand-21"))


def test_layouts_are_recognised_named_or_given():
    def lines_of(edges, shape):
        return drawn_shapes(shape, edges=edges).skeleton

    assert lines_of("auto", FACE) is IBUG
    assert lines_of("auto", HAND) is HAND_21
    assert lines_of("auto", BODY) is None
    assert lines_of("coco-17", BODY) is COCO
    assert lines_of(COCO, BODY) is COCO
    assert lines_of(None, FACE) is None
    found = lines_of([(0, 1), (4, 2)], BODY)
    assert_array_equal(found.edges, [[0, 1], [4, 2]])
    assert not found.sides.any()


@pytest.mark.parametrize(
    ("edges", "message"),
    [
        ("tree", "the skeletons are ibug-68, .*; got 'tree'"),
        ("hand-21", "'hand-21' has 21 points, the shape 5"),
        ([0, 1], r"shape \(n_pairs, 2\).* got shape \(2,\)"),
        ([[0.0, 1.0]], "must be integers"),
        ([[0, 1, 2]], "got shape"),
        ([[0, 5]], "points 0 to 4; got 0 to 5"),
        ([[-1, 0]], "points 0 to 4; got -1 to 0"),
    ],
)
def test_bad_edges(edges, message):
    refused(message, drawn_shapes, np.zeros((5, 3)), edges=edges)


# The layout is known whatever is drawn. Hands are in any direction.
@pytest.mark.parametrize(
    ("shape", "edges", "flipped"),
    [
        (FACE, "auto", "lower"),
        (FACE, None, "lower"),
        (FACE, [[0, 1]], "lower"),
        (BODY, "coco-17", "lower"),
        (BODY, "auto", "upper"),
        (HAND, "auto", "upper"),
    ],
)
def test_layouts_determine_which_way_is_up(shape, edges, flipped):
    for given, origin in ((shape, "upper"), (shape * [1, -1, 1], flipped)):
        display = drawn_shapes(given, edges=edges).plot()
        assert display.origin == origin
        assert display.axes_[0, 0].yaxis_inverted() == (origin == "upper")
        assert drawn_shapes(given, edges=edges, origin="lower").origin == "lower"
