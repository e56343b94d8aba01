"""Displays: the contract of all, and that each draws the numbers of its estimator."""

import sys
from copy import copy
from dataclasses import replace
from itertools import pairwise

import matplotlib.pyplot as plt
import numpy as np
import pandas as pd
import pytest
from cameras import lorentz_cameras
from layers import may_not_converge
from made_once import made_once
from numpy.testing import assert_allclose, assert_array_equal
from refusals import refusals_of, refused
from scenes import table_of
from scipy.spatial.transform import Rotation
from sklearn.exceptions import NotFittedError

from isa_nrsfm import AffineNRSfM, plotting
from isa_nrsfm.calibration import canonical_pose
from isa_nrsfm.datasets import (
    make_body_tracks,
    make_face_tracks,
    make_hand_tracks,
    make_nonrigid_tracks,
)
from isa_nrsfm.metrics import inverse_snr
from isa_nrsfm.plotting import (
    BasisShapeDisplay,
    CoefficientsDisplay,
    ModeCovarianceDisplay,
    ReprojectionDisplay,
)
from isa_nrsfm.skeletons import get_skeleton

# The figures do not depend on how far the iterations of the fit got.
pytestmark = may_not_converge
RNG = np.random.default_rng(0)
POINTS = RNG.standard_normal((6, 10, 2))
# Of each display: arguments, and the number of its axes.
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
    ),
    CoefficientsDisplay: ({"alpha": RNG.standard_normal((30, 2))}, 2),
    ModeCovarianceDisplay: ({"mode_covariance": np.eye(6)}, 1),
    ReprojectionDisplay: (
        {"observed": POINTS, "reprojected": 1.1 * POINTS, "edges": [[0, 1]]},
        6,
    ),
}


def given(kind, **changed):
    """Return a display with changed arguments."""
    return kind(**DISPLAYS[kind][0] | changed)


EACH = pytest.mark.parametrize("kind", DISPLAYS)
assert [kind.__name__ for kind in DISPLAYS] == plotting.__all__


@pytest.fixture(autouse=True)
def close_figures():
    plt.close("all")


@EACH
def test_without_matplotlib_the_extra_is_named(monkeypatch, kind):
    display = kind(**DISPLAYS[kind][0])
    for name in [name for name in sys.modules if name.split(".")[0] == "matplotlib"]:
        monkeypatch.setitem(sys.modules, name, None)
    refused(r"isa-nrsfm\[plot\]", display.plot, error=ImportError)


@EACH
def test_displays_draw_on_a_new_figure_or_given_axes(kind):
    arguments, n_axes = DISPLAYS[kind]
    display = kind(**arguments)
    assert display.plot() is display
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
    refused(None, kind, *list(DISPLAYS[kind][0].values())[:2], error=TypeError)
    table = [np.zeros((3, 4))] if kind is ReprojectionDisplay else []
    fresh = AffineNRSfM(), *table
    refused(None, kind.from_estimator, *fresh, error=NotFittedError)
    assert plt.get_fignums() == []


def drawn_shapes(mean_shape, basis=None, **options):
    """Return a display of shapes, by default of one that does not move."""
    basis = np.zeros((1, *np.shape(mean_shape))) if basis is None else basis
    return BasisShapeDisplay(mean_shape=mean_shape, basis=basis, **options)


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
    display = drawn_shapes(mean, 50 * basis / sizes[:, None, None]).plot()
    assert len({ax.get_xlim() for ax in display.axes_[1:, 0]}) == 1
    display = drawn_shapes(np.ones((5, 3))).plot()
    assert all(np.ptp(ax.get_xlim()) > 0 for ax in display.axes_.ravel())


def test_shapes_fit_on_a_page(rng):
    for aspect in (0.25, 3.0):
        mean = rng.uniform(size=(20, 3)) * [aspect, 1, aspect]
        display = drawn_shapes(mean, np.zeros((4, 20, 3))).plot()
        figure = display.figure_
        assert figure.axes == list(display.axes_.ravel())
        assert display.axes_.shape == (5, 2)
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


def lines_of(edges, shape):
    return drawn_shapes(shape, edges=edges).skeleton


# Points of an unknown layout, of which two are in one place
LINE = np.array([[0.0, 0, 0], [5, 0, 0], [2, 0, 0], [2, 0, 0], [3, 1, 0]])


@made_once
def calibrated():
    """Return a model of calibrated cameras, of points in no known layout."""
    scene = make_nonrigid_tracks(40, 12, 1, camera="weak_perspective", random_state=0)
    return AffineNRSfM(1, camera="weak_perspective", tol=1e3).fit(scene.data)


def test_points_that_are_near_in_the_images_are_joined():
    model = copy(calibrated())
    # Seen from the front only, with depths that no image shows
    model.motion_ = np.tile(np.eye(2, 3), (40, 1, 1))
    model.reference_motion_ = np.eye(2, 3)
    model.mean_shape_ = np.outer(np.arange(12.0), [1, 0, 0])
    model.mean_shape_[::2, 2] = 100.0
    chain = np.add.outer(np.arange(11), [0, 1])
    assert_array_equal(BasisShapeDisplay.from_estimator(model).edges, chain)


def origins_of(shape, edges):
    """Return where the origin of a shape is drawn, and of it upside down."""
    origins = []
    for points in (shape, shape * [1, -1, 1]):
        display = drawn_shapes(points, edges=edges).plot()
        assert display.axes_[0, 0].yaxis_inverted() == (display.origin == "upper")
        origins.append(display.origin)
    return origins


ALPHA = np.random.default_rng(0).normal(size=(30, 2))


@pytest.fixture(scope="module")
def faces():
    return make_face_tracks(n_frames=40, n_components=2, noise=0.0, random_state=0)


@pytest.fixture(scope="module")
def estimator(faces):
    return AffineNRSfM(2, random_state=0).fit(faces.data)


def random_shapes(n_points=20):
    mean_shape, *basis = np.random.default_rng(0).standard_normal((4, n_points, 3))
    return drawn_shapes(mean_shape, 0.1 * np.array(basis))


def random_frames(n_points=10):
    observed, noise = np.random.default_rng(0).standard_normal((2, 4, n_points, 2))
    return ReprojectionDisplay(observed=observed, reprojected=observed + 0.1 * noise)


def view_of(estimator, display):
    """Return the transform from the space of a model to that of a display."""
    return np.linalg.lstsq(estimator.mean_shape_, display.mean_shape)[0].T


def percent(fraction):
    """Return a share between 0.1 and 100 % with two digits."""
    return f"{100 * fraction:#.2g}".rstrip(".") + " %"


def texts(display):
    return [ax.get_title(loc="left") for ax in display.axes_[:, 0]]


def legend_of(display):
    (legend,) = display.figure_.legends
    return [text.get_text() for text in legend.get_texts()]


def test_shapes_are_those_of_the_estimator_in_natural_proportions(faces, estimator):
    display = BasisShapeDisplay.from_estimator(estimator)
    T = view_of(estimator, display)
    assert_allclose(display.mean_shape, estimator.mean_shape_ @ T.T)
    # alpha has unit variance: a basis shape is the drift by a standard deviation.
    scale = np.abs(display.basis).max()
    assert_allclose(display.basis, estimator.basis_ @ T.T, atol=1e-6 * scale)
    # Faces of known layouts are turned upright.
    pose = canonical_pose(display.mean_shape, scheme="ibug-68")
    assert_allclose(pose.rotation, np.eye(3), atol=1e-9)
    # The median of the cameras has rows of length one.
    sizes = np.linalg.norm(estimator.motion_ @ np.linalg.inv(T), axis=(1, 2))
    assert np.median(sizes) == pytest.approx(np.sqrt(2))
    # Up to a rotation and its mirror image the mean shape is the true face. Rigid
    # cameras of a deforming face are only nearly right.
    seen, truth = display.mean_shape, faces.mean_shape
    values = (np.linalg.svd(s, compute_uv=False) for s in (seen, truth))
    sizes = (each / np.linalg.norm(each) for each in values)
    assert_allclose(*sizes, atol=0.02)
    # Not turned in the front view, and not in depth but for the mirror image.
    for axis, least in enumerate((0.99, 0.99, 0.97)):
        alike = np.corrcoef(seen[:, axis], truth[:, axis])[0, 1]
        assert (alike if axis < 2 else abs(alike)) > least


def test_shapes_of_calibrated_cameras_are_only_turned():
    model = calibrated()
    display = BasisShapeDisplay.from_estimator(model)
    error = f"depth error {100 * model.depth_uncertainty_:.2g} %"
    assert [side.get_xlabel() for side in display.axes_[:, 1]] == 2 * [error]
    shown = [display.mean_shape, *display.basis]
    scale = np.median(model.scales_)
    for drawn, shape in zip(shown, [model.mean_shape_, *model.basis_], strict=True):
        gram = scale**2 * shape @ shape.T
        assert_allclose(drawn @ drawn.T, gram, atol=1e-6 * np.trace(gram))
    # Points in no known order are seen as the mean camera does.
    seen = model.reference_motion_ @ model.mean_shape_.T
    unit = np.linalg.norm(model.reference_motion_[0]) / scale
    front = unit * display.mean_shape[:, :2].T
    assert_allclose(front, seen, atol=1e-6 * np.abs(seen).max())


def rigid_view(motion, shape):
    """Return a model of a rigid table, and its display."""
    tracks = shape @ motion.swapaxes(1, 2)
    model = AffineNRSfM(1, refinement=None, scale_frames=False, random_state=0)
    model.fit(tracks.reshape(len(tracks), -1))
    return model, BasisShapeDisplay.from_estimator(model)


def test_a_turntable_is_seen_upright_from_its_broad_side(rng):
    turns = Rotation.from_euler("y", 2 * np.pi * np.arange(40)[:, None] / 40)
    # Points with y down, broad along a direction between x and z.
    points = rng.standard_normal((50, 3)) * [3, 5, 1]
    points = (points - points.mean(axis=0)) @ Rotation.from_euler("y", 1).as_matrix()
    seen = rigid_view(turns.as_matrix()[:, :2], points)[1].mean_shape
    assert_allclose(seen[:, 1], points[:, 1], atol=1e-6)
    assert seen[:, 0].std() > 2 * seen[:, 2].std()
    assert_allclose(seen @ seen.T, points @ points.T, atol=1e-5)


def test_without_a_metric_the_mean_camera_is_made_isotropic(rng):
    model, display = rigid_view(lorentz_cameras(rng), rng.standard_normal((30, 3)))
    unit = model.motion_ / np.linalg.norm(model.motion_, axis=(1, 2), keepdims=True)
    rows = (unit @ np.linalg.inv(view_of(model, display))).reshape(-1, 3)
    second = rows.T @ rows
    assert_allclose(second / second[0, 0], np.eye(3), atol=1e-6)


def test_points_and_arrows_are_the_shapes(estimator):
    display = BasisShapeDisplay.from_estimator(estimator, n_std=1.5)
    assert display.axes_.shape == (3, 2)
    for side in display.axes_[:, 1]:
        assert side.get_xlabel() == "depth up to an affinity"
    assert len(display.mean_) == 6
    assert len(display.plus_) == len(display.minus_) == len(display.arrows_) == 4
    for view, columns in enumerate(([0, 1], [2, 1])):
        mean = display.mean_shape[:, columns]
        for block in range(3):
            drawn = display.mean_[2 * block + view]
            assert drawn.axes is display.axes_[block, view]
            assert_allclose(drawn.get_offsets(), mean)
        for k in range(2):
            drift = 1.5 * display.basis[k][:, columns]
            drawn = display.plus_, display.minus_, display.arrows_
            plus, minus, arrows = (artists[2 * k + view] for artists in drawn)
            assert plus.axes is display.axes_[k + 1, view]
            assert_allclose(plus.get_offsets(), mean + drift)
            assert_allclose(minus.get_offsets(), mean - drift)
            assert_allclose(arrows.get_offsets(), mean)
            assert_allclose(np.column_stack([arrows.U, arrows.V]), drift)
            assert (arrows.angles, arrows.scale_units, arrows.scale) == ("xy", "xy", 1)


def test_faces_are_joined_and_upright(estimator):
    display = BasisShapeDisplay.from_estimator(estimator)
    edges = get_skeleton("ibug-68").edges
    assert_array_equal(display.edges, edges)
    for ax, columns in zip(display.axes_[0], ([0, 1], [2, 1]), strict=True):
        points = display.mean_shape[:, columns]
        lines = ax.collections[0].get_segments()
        assert_allclose(lines, points[edges], atol=1e-12)
        # On the page the brows are above the chin, and the nose is at one side.
        height = ax.transData.transform(points)[:, 1]
        assert height[17:27].min() > height[27:36].max() > height[8]
    for ax in display.axes_.ravel():
        assert ax.yaxis_inverted()
        assert not ax.xaxis_inverted()
        assert ax.get_aspect() == 1
    depth = display.mean_shape[:, 2]
    assert depth[30] in (depth.min(), depth.max())


def test_titles_have_names_energies_and_drifts(estimator):
    show = BasisShapeDisplay.from_estimator
    display, named = show(estimator), show(estimator, component_names=["jaw", "lip"])
    assert texts(display)[0] == "Mean shape, front and side"
    assert display.energy_share.sum() == pytest.approx(1)
    assert display.energy_share[0] > display.energy_share[1]
    share = percent(display.energy_share[0])
    assert texts(display)[1] == f"Basis shape 1 ({share} of energy)"
    assert texts(named)[1] == f"jaw ({share} of energy)"
    display = random_shapes().plot(components=[2, 0])
    drift = display.plus_[0].get_offsets() - display.mean_[0].get_offsets()
    assert_allclose(drift, 2 * display.basis[2][:, :2], atol=1e-12)


def test_undetermined_depth_has_no_side_view(rng):
    model, note = copy(calibrated()), "depth not determined"
    frames = model._model.frames
    frames = replace(frames, certainty=frames.certainty._replace(total=0.9))
    model._model = model._model._replace(frames=frames)
    narrow = rng.normal(size=(5, 20, 3)) * [0.2, 1.0, 0.0]
    of_note = drawn_shapes(narrow[0], 0.1 * narrow[1:], depth_note=note).plot()
    for display in (BasisShapeDisplay.from_estimator(model), of_note):
        display.figure_.canvas.draw()
        assert display.axes_[0, 0].get_title(loc="left") == "Mean shape"
        for front, side in display.axes_:
            assert front.collections
            assert not side.collections
            assert side.get_xlabel() == note
            # It ends within the figure.
            end = side.xaxis.label.get_window_extent().x1
            assert end <= display.figure_.bbox.x1


MOODS = np.array(["b", "a", "c"])[np.arange(30) % 3]
MISSING = np.where(np.arange(30)[:, None] == 3, np.nan, ALPHA)
NAMED = pd.DataFrame(ALPHA, columns=["jaw $", 2])  # names are no mathematics


def drawn_classes(**changed):
    """Return the axes of coefficients of three classes."""
    options = {"alpha": ALPHA, "y": MOODS, "label": "mood"} | changed
    return CoefficientsDisplay(**options).plot().axes_


def ticks(axes):
    return [label.get_text() for label in axes.get_xticklabels()]


def test_classes_have_boxes_of_their_frames_and_numbers_points():
    for k, axes in enumerate(drawn_classes()):
        thick = [line for line in axes.lines if line.get_linewidth() == 1.4]
        medians = [line.get_ydata()[0] for line in thick]
        assert_allclose(medians, [np.median(ALPHA[MOODS == c, k]) for c in "abc"])
    age = np.linspace(20.5, 60, 30)
    points = drawn_classes(y=age)[1].collections[0].get_offsets()
    assert_allclose(points, np.column_stack([age, ALPHA[:, 1]]))


def test_curves_have_bands_and_stop_at_gaps_and_groups():
    time = np.r_[0:10, 20:30, 0:10].astype(float)
    groups = np.repeat(["x", "y"], [20, 10])
    given = {"alpha": ALPHA, "alpha_std": 0.1 + 0 * ALPHA}
    display = CoefficientsDisplay(**given, time=time, groups=groups).plot()
    axes = display.axes_[0]
    line, (band,) = axes.lines[0], axes.collections
    drawn = np.isfinite(line.get_ydata())
    assert_array_equal(np.flatnonzero(~drawn), [10, 21])
    assert_array_equal(line.get_xdata()[drawn], time)
    assert_array_equal(line.get_ydata()[drawn], ALPHA[:, 0])
    assert len(band.get_paths()) == 3
    assert_allclose(band.get_paths()[1].get_extents().intervalx, [20, 29])
    title = axes.get_title("right")
    assert title == "band: one standard deviation, 0.1 (median)"
    low, high = band.get_datalim(axes.transData).intervaly
    assert low == pytest.approx(ALPHA[:, 0].min() - 0.1)
    assert high == pytest.approx(ALPHA[:, 0].max() + 0.1)
    # Single frames of groups are dots.
    display = CoefficientsDisplay(alpha=ALPHA[:3], groups=[0, 0, 1]).plot()
    dots = display.axes_[0].lines[1]
    assert dots.get_marker() == "."
    assert_array_equal(dots.get_ydata(), ALPHA[2:3, 0])


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
    assert ticks(display.axes_[1]) == [f"{number:03d}" for number in range(50)]


def test_coefficients_are_those_of_the_estimator(faces, estimator):
    display = CoefficientsDisplay.from_estimator(estimator)
    assert_array_equal(display.alpha, estimator.alpha_)
    assert_array_equal(display.alpha_std, estimator.alpha_std_)
    assert display.axes_[-1].get_xlabel() == "frame"
    other = CoefficientsDisplay.from_estimator(estimator, faces.data[:5], kind="time")
    assert_allclose(other.alpha, estimator.alpha_[:5], atol=1e-9)


def covariance(n_components=2):
    rows = np.random.default_rng(0).standard_normal((50, 3 * n_components))
    return rows.T @ rows * np.outer(*2 * [np.repeat(np.arange(n_components) + 1, 3)])


def drawn_matrix(n_components):
    """Return the matrix of some basis shapes."""
    return ModeCovarianceDisplay(mode_covariance=covariance(n_components)).plot()


# The boundaries of three blocks
LINES = [[[c, -0.5], [c, 8.5]] for c in (2.5, 5.5)]
LINES += [[[-0.5, c], [8.5, c]] for c in (2.5, 5.5)]
SMALL = ModeCovarianceDisplay(mode_covariance=np.diag([1.0, 1, 1, 0.05, 1, 1]))


def test_the_matrix_is_that_of_the_estimator(estimator):
    display = ModeCovarianceDisplay.from_estimator(estimator)
    assert_array_equal(display.mode_covariance, estimator.mode_covariance_)
    share = f"{percent(display.off_block_share)} outside the diagonal blocks"
    assert display.ax_.get_title() == f"{share}\n(0 % if uncorrelated)"


def test_labels_of_the_matrix_do_not_touch():
    display = drawn_matrix(99)
    display.figure_.canvas.draw()
    for axis in (display.ax_.xaxis, display.ax_.yaxis):
        labels = [each for each in axis.get_ticklabels() if each.get_text()]
        assert labels[0].get_text() == "1"
        assert len(labels) >= 7
        boxes = [label.get_window_extent() for label in labels]
        assert not any(a.overlaps(b) for a, b in pairwise(boxes))
        place = int(labels[-1].get_text()) * 3 - 2
        assert axis.get_ticklocs()[-1] == place


def share_outside(matrix):
    """Return the share outside of the blocks, of a matrix that is drawn."""
    display = ModeCovarianceDisplay(mode_covariance=matrix).plot()
    display.figure_.canvas.draw()
    return display.off_block_share


def test_points_of_frames_are_the_numbers(faces):
    show, rows = ReprojectionDisplay.from_estimator, [7, 3, 30]
    names = [f"photo{i}.jpg" for i in range(40)]
    table = pd.DataFrame(faces.data, columns=faces.feature_names, index=names)
    model = AffineNRSfM(2, refinement=None, random_state=0)
    display = show(model.fit(table), table, frames=rows)
    assert_array_equal(display.frames, rows)
    assert display.frame_names == [names[row] for row in rows]
    reprojected = model.reproject(table).reshape(-1, 68, 2)
    for i, row in enumerate(rows):
        seen, fitted = faces.tracks[row], reprojected[row]
        assert_allclose(display.observed_[i].get_offsets(), seen)
        assert_allclose(display.reprojected_[i].get_offsets(), fitted)
        errors = np.stack([seen, fitted], axis=1)
        assert_allclose(display.errors_[i].get_segments(), errors)
        edges = get_skeleton("ibug-68").edges
        assert_allclose(display.edges_[i].get_segments(), fitted[edges])
        assert display.observed_[i].axes is display.axes_[i]
        assert display.axes_[i].yaxis_inverted()
        error = inverse_snr(faces.data[[row]], fitted.reshape(1, -1))
        assert display.inverse_snr[i] == pytest.approx(error)
        title = f"row {names[row]}\ninverse SNR {percent(error)}"
        assert display.axes_[i].get_title() == title
    # Planar tables show the same, here upside down, and without names numbers.
    planar = table_of(faces.tracks * [1, -1], "planar")
    other = show(model.set_params(layout="planar").fit(planar), planar, frames=rows)
    assert (display.origin, other.origin) == ("upper", "lower")
    assert_array_equal(display.observed, other.observed * [1, -1])
    assert_allclose(display.reprojected, other.reprojected * [1, -1])
    assert other.axes_[0].get_title().startswith("row 7\n")


def test_frames_are_random_and_can_be_fitted(faces, estimator):
    show = ReprojectionDisplay.from_estimator
    one, same, other = (
        show(estimator, faces.data, random_state=seed).frames for seed in (0, 0, 1)
    )
    assert len(one) == 6
    assert_array_equal(one, np.unique(one))
    assert_array_equal(one, same)
    assert set(one) != set(other)
    for frames in ([40], [-1], 3, [], [0.5]):
        refused("frames must be", show, estimator, faces.data, frames=frames)
    X = faces.data[:6].copy()
    X[1] = np.nan
    X[4, 2:] = np.nan
    assert_array_equal(show(estimator, X).frames, [0, 2, 3, 5])
    message = "between 1 and the 4 rows of X with at least 4 points; got 5"
    refused(message, show, estimator, X, n_frames=5)


def test_frames_have_equal_units_in_both_directions():
    display = random_frames().plot()
    display.figure_.canvas.draw()
    sizes = [ax.bbox.size for ax in display.axes_]
    assert_allclose(sizes, sizes[:1] * 4)
    for ax, points in zip(display.axes_, display.observed, strict=True):
        pixels = ax.transData.transform(points)
        ratio = np.ptp(pixels, axis=0) / np.ptp(points, axis=0)
        assert ratio[0] == pytest.approx(ratio[1])
        assert (ax.bbox.get_points()[0] <= pixels.min(axis=0)).all()
        assert (pixels.max(axis=0) <= ax.bbox.get_points()[1]).all()
    assert legend_of(display) == ["observed", "reprojected"]
    assert len(display.figure_.axes) == 4
    grid = random_frames().plot(n_columns=2).axes_[0].get_subplotspec().get_gridspec()
    assert grid.get_geometry() == (2, 2)


def test_missing_points_are_left_out():
    display = random_frames()
    observed = display.observed.copy()
    observed[0, 3] = np.nan
    hidden = ReprojectionDisplay(observed=observed, reprojected=display.reprojected)
    tables = (each.reshape(4, -1)[:1] for each in (observed, display.reprojected))
    assert hidden.inverse_snr[0] == pytest.approx(inverse_snr(*tables))
    hidden.plot().figure_.canvas.draw()
    assert np.isfinite(hidden.axes_[0].get_xlim()).all()
    assert len(hidden.reprojected_[0].get_offsets()) == 10


test_refusals = refusals_of("plotting", globals())
