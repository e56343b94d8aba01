import matplotlib.pyplot as plt
import numpy as np
import pytest
from layers import slow_after
from matplotlib.colors import to_rgba
from numpy.testing import assert_allclose, assert_array_equal
from sklearn.exceptions import NotFittedError

from isa_nrsfm import AffineNRSfM
from isa_nrsfm.calibration import canonical_pose
from isa_nrsfm.datasets import make_face_tracks
from isa_nrsfm.plotting import BasisShapeDisplay
from isa_nrsfm.plotting._axes import (
    MINUS_COLOUR,
    MOST_SPARSE_POINTS,
    PLUS_COLOUR,
    percent,
)
from isa_nrsfm.plotting._views import viewing_transform
from isa_nrsfm.skeletons import get_skeleton

# The figures do not depend on how far the iterations of the fit got.
pytestmark = pytest.mark.filterwarnings("ignore::sklearn.exceptions.ConvergenceWarning")


@pytest.fixture(autouse=True)
def close_figures():
    yield
    plt.close("all")


@pytest.fixture(scope="module")
def faces():
    return make_face_tracks(n_frames=120, n_components=2, noise=0.0, random_state=0)


@pytest.fixture(scope="module")
def estimator(faces):
    return AffineNRSfM(2, random_state=0).fit(faces.data)


def random_display(n_points=20, n_components=3, **kw):
    rng = np.random.default_rng(0)
    return BasisShapeDisplay(
        mean_shape=rng.standard_normal((n_points, 3)),
        basis=0.1 * rng.standard_normal((n_components, n_points, 3)),
        **kw,
    )


def texts(display):
    return [ax.get_title(loc="left") for ax in display.axes_[:, 0]]


def test_the_estimator_in_the_viewing_frame(estimator):
    display = BasisShapeDisplay.from_estimator(estimator)
    T = viewing_transform(estimator.motion_, estimator.reference_motion_)
    # Faces of known layouts are turned upright there.
    seen = estimator.mean_shape_ @ T.T
    T = canonical_pose(seen, scheme="ibug-68").rotation @ T
    assert_allclose(display.mean_shape, estimator.mean_shape_ @ T.T)
    # alpha has unit variance: a basis shape is the drift by a standard deviation.
    scale = np.abs(display.basis).max()
    assert_allclose(display.basis, estimator.basis_ @ T.T, atol=1e-6 * scale)


def test_natural_proportions(faces, estimator):
    # Up to a rotation and its mirror image the mean shape is the true face. Rigid
    # cameras of a deforming face are only nearly right.
    seen = BasisShapeDisplay.from_estimator(estimator).mean_shape
    truth = faces.mean_shape
    assert_allclose(
        np.linalg.svd(seen, compute_uv=False) / np.linalg.norm(seen),
        np.linalg.svd(truth, compute_uv=False) / np.linalg.norm(truth),
        atol=0.02,
    )
    # Not turned in the front view, and not in depth but for the mirror image.
    assert np.corrcoef(seen[:, 0], truth[:, 0])[0, 1] > 0.99
    assert np.corrcoef(seen[:, 1], truth[:, 1])[0, 1] > 0.99
    assert abs(np.corrcoef(seen[:, 2], truth[:, 2])[0, 1]) > 0.97


def test_another_affinity_of_space_changes_nothing(faces):
    # The true cameras are weak-perspective ones, whatever the coordinates.
    class Truth(AffineNRSfM):
        def set(self, A):
            self.mean_shape_ = faces.mean_shape @ A.T
            self.basis_ = faces.basis @ A.T
            self.alpha_ = faces.alpha
            self.energy_share_ = np.full(len(faces.basis), 1 / len(faces.basis))
            self.motion_ = faces.motion @ np.linalg.inv(A)
            self.reference_motion_ = self.motion_.mean(axis=0)
            return self

    A = np.array([[1.0, 0.3, 0.0], [0.1, 2.0, 0.5], [0.2, 0.0, 0.7]])
    one, other = (
        BasisShapeDisplay.from_estimator(Truth().set(space)) for space in (np.eye(3), A)
    )
    assert_allclose(other.mean_shape, one.mean_shape, atol=1e-6)
    assert_allclose(other.basis, one.basis, atol=1e-6)
    scale = np.median(np.linalg.norm(faces.motion, axis=(1, 2))) / np.sqrt(2)
    assert_allclose(one.mean_shape @ one.mean_shape.T / scale**2,
                    faces.mean_shape @ faces.mean_shape.T, atol=1e-6)  # fmt: skip


@pytest.mark.parametrize("camera", slow_after(1, ["weak_perspective", "orthographic"]))
def test_shapes_of_calibrated_cameras_are_only_turned(camera):
    faces = make_face_tracks(
        n_frames=120, n_components=2, camera=camera, random_state=0
    )
    model = AffineNRSfM(2, camera=camera, random_state=0).fit(faces.data)
    display = BasisShapeDisplay.from_estimator(model)
    scale = np.median(model.scales_)
    for drawn, shape in zip(
        [display.mean_shape, *display.basis],
        [model.mean_shape_, *model.basis_],
        strict=True,
    ):
        size = scale * np.linalg.norm(shape)
        assert_allclose(drawn @ drawn.T / size**2,
                        scale**2 * shape @ shape.T / size**2, atol=1e-6)  # fmt: skip
    # Points in no known order are seen as the mean camera does.
    order = np.random.RandomState(0).permutation(68)
    model.fit(faces.tracks[:, order].reshape(120, -1))
    scale = np.median(model.scales_)
    seen = model.reference_motion_ @ model.mean_shape_.T
    front = BasisShapeDisplay.from_estimator(model).mean_shape[:, :2].T
    unit = np.linalg.norm(model.reference_motion_[0]) / scale
    assert_allclose(unit * front, seen, atol=1e-6 * np.abs(seen).max())


def test_artists_are_the_numbers(estimator):
    display = BasisShapeDisplay.from_estimator(estimator, n_std=1.5)
    assert display.axes_.shape == (3, 2)
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
            plus, minus, arrows = (
                artists[2 * k + view]
                for artists in (display.plus_, display.minus_, display.arrows_)
            )
            assert plus.axes is display.axes_[k + 1, view]
            assert_allclose(plus.get_offsets(), mean + drift)
            assert_allclose(minus.get_offsets(), mean - drift)
            assert_allclose(arrows.get_offsets(), mean)
            assert_allclose(np.column_stack([arrows.U, arrows.V]), drift)
            assert (arrows.angles, arrows.scale_units, arrows.scale) == ("xy", "xy", 1)
            assert_array_equal(plus.get_facecolor(), [to_rgba(PLUS_COLOUR)])
            assert_array_equal(minus.get_facecolor(), [to_rgba(MINUS_COLOUR)])


def test_the_face_is_joined_and_upright(estimator):
    display = BasisShapeDisplay.from_estimator(estimator)
    assert_array_equal(display.edges, get_skeleton("ibug-68").edges)
    (lines,) = display.axes_[0, 1].collections[:1]
    edges = get_skeleton("ibug-68").edges
    expected = display.mean_shape[:, [2, 1]][edges]
    assert_allclose(lines.get_segments(), expected, atol=1e-12)
    for ax in display.axes_.ravel():
        assert ax.yaxis_inverted()
        assert not ax.xaxis_inverted()
        assert ax.get_aspect() == 1
    # On the page the brows are above the chin, and the nose is at one side.
    for ax in display.axes_[0]:
        columns = [0, 1] if ax is display.axes_[0, 0] else [2, 1]
        height = ax.transData.transform(display.mean_shape[:, columns])[:, 1]
        assert height[17:27].min() > height[27:36].max() > height[8]
    depth = display.mean_shape[:, 2]
    assert depth[30] in (depth.min(), depth.max())


def test_a_face_with_y_up_is_upright_as_well(faces):
    X = faces.data * np.tile([1.0, -1.0], 68)
    estimator = AffineNRSfM(2, random_state=0).fit(X)
    display = BasisShapeDisplay.from_estimator(estimator)
    assert display.origin == "lower"
    assert not display.axes_[0, 0].yaxis_inverted()
    display = BasisShapeDisplay.from_estimator(estimator, origin="upper")
    assert display.axes_[0, 0].yaxis_inverted()


def test_titles(estimator):
    display = BasisShapeDisplay.from_estimator(estimator)
    assert texts(display)[0] == "Mean shape, front and side"
    assert display.energy_share.sum() == pytest.approx(1)
    # The order of the estimator is that of the energy.
    assert display.energy_share[0] > display.energy_share[1]
    share = percent(display.energy_share[0])
    assert texts(display)[1] == f"Basis shape 1 ({share} of energy)"

    named = BasisShapeDisplay.from_estimator(estimator, component_names=["jaw", "lip"])
    assert texts(named)[1] == f"jaw ({share} of energy)"
    assert texts(random_display().plot())[1:] == [
        "Basis shape 1",
        "Basis shape 2",
        "Basis shape 3",
    ]


def test_legend_only_in_figures_of_our_own():
    display = random_display().plot(n_std=3)
    (legend,) = display.figure_.legends
    assert [text.get_text() for text in legend.get_texts()] == [
        "mean shape",
        "\N{MINUS SIGN}3 standard deviations",
        "+3 standard deviations",
    ]
    figure, axes = plt.subplots(4, 2)
    again = random_display().plot(axes)
    assert not figure.legends
    assert again.figure_ is figure
    assert_array_equal(again.axes_, axes)


def test_plot_returns_itself_and_opens_one_figure():
    display = random_display()
    before = plt.get_fignums()
    assert display.plot() is display
    assert len(plt.get_fignums()) == len(before) + 1
    _, axes = plt.subplots(4, 2)
    display.plot(ax=list(axes.ravel()))
    assert len(plt.get_fignums()) == len(before) + 2


def test_some_of_the_basis_shapes():
    display = random_display().plot(components=[2, 0])
    assert_array_equal(display.components_, [2, 0])
    assert texts(display)[1:] == ["Basis shape 3", "Basis shape 1"]
    drift = display.plus_[0].get_offsets() - display.mean_[0].get_offsets()
    assert_allclose(drift, 2 * display.basis[2][:, :2], atol=1e-12)


def test_a_drift_for_each_basis_shape():
    display = random_display().plot(n_std=[1, 2, 30])
    assert texts(display)[1:3] == ["Basis shape 1 (±1 s.d.)", "Basis shape 2 (±2 s.d.)"]
    # The last one is out of all proportion.
    assert texts(display)[3].startswith("Basis shape 3 (±30 s.d., drawn 1:")
    for k, n_std in enumerate([1, 2, 30]):
        drift = display.plus_[2 * k].get_offsets() - display.mean_[0].get_offsets()
        assert_allclose(drift, n_std * display.basis[k][:, :2], atol=1e-12)
    widths = [np.ptp(ax.get_xlim()) for ax in display.axes_[:, 0]]
    assert widths[0] == widths[1] == widths[2] < widths[3] / 2


def test_all_that_is_drawn_is_inside_the_axes():
    display = random_display().plot()
    for artists in (display.mean_, display.plus_, display.minus_):
        for points in artists:
            x, y = np.asarray(points.get_offsets()).T
            low, high = sorted(points.axes.get_xlim())
            assert low < x.min() <= x.max() < high
            low, high = sorted(points.axes.get_ylim())
            assert low < y.min() <= y.max() < high


def test_titles_and_legend_do_not_overlap():
    display = random_display(
        component_names=["a name of some length " * 3] * 3, energy_share=[0.5, 0.3, 0.2]
    ).plot()
    display.figure_.canvas.draw()
    boxes = [
        text.get_window_extent()
        for ax in display.axes_[:, 0]
        for text in [ax._left_title]
    ]
    boxes.append(display.figure_.legends[0].get_window_extent())
    page = display.figure_.bbox
    for i, box in enumerate(boxes):
        assert page.x0 <= box.x0
        assert box.x1 <= page.x1
        assert page.y0 <= box.y0
        assert box.y1 <= page.y1
        assert not any(box.overlaps(other) for other in boxes[i + 1 :])


def test_dense_shapes_are_clouds():
    display = random_display(n_points=MOST_SPARSE_POINTS + 1).plot()
    assert display.arrows_ == []
    assert len(display.plus_) == len(display.minus_) == 6
    assert display.plus_[0].get_rasterized()
    sparse = random_display(n_points=MOST_SPARSE_POINTS).plot()
    assert len(sparse.arrows_) == 6


def test_styles_can_be_changed():
    display = random_display(edges=[[0, 1], [1, 2]]).plot(
        point_kw={"marker": "s", "s": 11},
        edge_kw={"linewidths": 3},
        arrow_kw={"color": "red"},
    )
    assert display.plus_[0].get_sizes() == [11]
    assert display.axes_[1, 0].collections[0].get_linewidths() == [3]
    assert_array_equal(display.arrows_[0].get_facecolor(), [to_rgba("red")])


def test_no_deformation():
    display = BasisShapeDisplay(
        mean_shape=np.eye(3), basis=np.zeros((1, 3, 3)), energy_share=[0.0]
    ).plot()
    display.figure_.canvas.draw()
    assert texts(display)[1] == "Basis shape 1 (0 % of energy)"


@pytest.mark.parametrize(
    ("kw", "message"),
    [
        ({"mean_shape": np.zeros((4, 2))}, r"got \(4, 2\) and \(2, 4, 3\)"),
        ({"basis": np.zeros((2, 5, 3))}, r"got \(4, 3\) and \(2, 5, 3\)"),
        ({"energy_share": [1.0]}, r"must hold 2 numbers.*got shape \(1,\)"),
        ({"component_names": ["a"]}, "must hold 2 names.*got 1"),
        ({"edges": [[0, 4]]}, "points 0 to 3; got 0 to 4"),
        ({"origin": "left"}, "got 'left'"),
    ],
)
def test_bad_data(kw, message):
    good = {"mean_shape": np.zeros((4, 3)), "basis": np.zeros((2, 4, 3))}
    with pytest.raises(ValueError, match=message):
        BasisShapeDisplay(**(good | kw))


def test_bad_arguments_of_plot():
    display = random_display()
    _, axes = plt.subplots(2, 2)
    with pytest.raises(ValueError, match="must hold 8 axes, two views a shape; got 4"):
        display.plot(axes)
    with pytest.raises(ValueError, match=r"one for each basis shape.*got shape"):
        display.plot(n_std=[1, 2])
    for components in ([3], [-1], [], 0, [0.0]):
        with pytest.raises(ValueError, match="numbers of basis shapes, from 0 to 2"):
            display.plot(components=components)


def test_unfitted():
    with pytest.raises(NotFittedError):
        BasisShapeDisplay.from_estimator(AffineNRSfM())
    assert plt.get_fignums() == []


def test_arguments_are_keywords():
    with pytest.raises(TypeError):
        BasisShapeDisplay(np.zeros((4, 3)), np.zeros((2, 4, 3)))


@pytest.mark.parametrize(
    ("name", "n_components", "order", "origin"),
    [
        ("shark_torresani", 1, None, "upper"),
        *slow_after(
            0,
            [
                ("ict_bu3dfe_like_68", 3, "ibug-68", "lower"),
                ("muct_68", 3, "xm2vts-68", "upper"),
                ("shark_torresani", 2, None, "upper"),
            ],
            together=True,
        ),
    ],
)
@pytest.mark.filterwarnings("ignore::sklearn.exceptions.ConvergenceWarning")
def test_real_tables(load_data, name, n_components, order, origin):
    W = load_data(name)["W2d"]
    W = W[np.isfinite(W).all(axis=(1, 2))][:600]
    estimator = AffineNRSfM(n_components, max_iter=20, random_state=0)
    display = BasisShapeDisplay.from_estimator(estimator.fit(W.reshape(len(W), -1)))
    assert display.origin == origin
    if order is None:
        assert display.edges is None
    else:
        assert display.skeleton is get_skeleton(order)
        assert_array_equal(display.edges, display.skeleton.edges)
    assert display.axes_.shape == (n_components + 1, 2)
    display.figure_.canvas.draw()
