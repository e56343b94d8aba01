import matplotlib.pyplot as plt
import numpy as np
import pandas as pd
import pytest
from numpy.testing import assert_allclose, assert_array_equal
from sklearn.base import clone
from sklearn.exceptions import NotFittedError

from isa_nrsfm import AffineNRSfM
from isa_nrsfm.datasets import make_face_tracks
from isa_nrsfm.metrics import inverse_snr
from isa_nrsfm.plotting import ReprojectionDisplay
from isa_nrsfm.plotting._axes import percent
from isa_nrsfm.plotting._reprojection import choose_frames
from isa_nrsfm.skeletons import get_skeleton

# The figures do not depend on how far the iterations of the fit got.
pytestmark = pytest.mark.filterwarnings("ignore::sklearn.exceptions.ConvergenceWarning")


@pytest.fixture(autouse=True)
def close_figures():
    yield
    plt.close("all")


@pytest.fixture(scope="module")
def faces():
    return make_face_tracks(n_frames=60, n_components=2, noise=0.02, random_state=0)


@pytest.fixture(scope="module")
def estimator(faces):
    return AffineNRSfM(2, random_state=0).fit(faces.data)


def random_display(n_points=10, n_frames=4, **kw):
    rng = np.random.default_rng(0)
    observed = rng.standard_normal((n_frames, n_points, 2))
    noise = 0.1 * rng.standard_normal(observed.shape)
    return ReprojectionDisplay(observed=observed, reprojected=observed + noise, **kw)


def test_artists_are_the_numbers(faces, estimator):
    display = ReprojectionDisplay.from_estimator(
        estimator, faces.data, frames=[7, 3, 50]
    )
    assert_array_equal(display.frames, [7, 3, 50])
    table = estimator.reproject(faces.data).reshape(-1, 68, 2)
    for i, row in enumerate([7, 3, 50]):
        seen, fitted = faces.tracks[row], table[row]
        assert_allclose(display.observed_[i].get_offsets(), seen)
        assert_allclose(display.reprojected_[i].get_offsets(), fitted)
        assert_allclose(
            display.errors_[i].get_segments(), np.stack([seen, fitted], axis=1)
        )
        edges = get_skeleton("ibug-68").edges
        assert_allclose(display.edges_[i].get_segments(), fitted[edges])
        assert display.observed_[i].axes is display.axes_[i]
        error = inverse_snr(faces.data[[row]], table[row].reshape(1, -1))
        assert display.inverse_snr[i] == pytest.approx(error)
        title = f"frame {row}\ninverse SNR {percent(error)}"
        assert display.axes_[i].get_title() == title


def test_planar_tables_show_the_same(faces, estimator):
    planar = faces.tracks.transpose(0, 2, 1).reshape(60, -1)
    other = clone(estimator).set_params(layout="planar").fit(planar)
    one = ReprojectionDisplay.from_estimator(estimator, faces.data, random_state=0)
    two = ReprojectionDisplay.from_estimator(other, planar, random_state=0)
    assert_array_equal(one.observed, two.observed)
    assert_allclose(one.reprojected, two.reprojected)


def test_random_frames(faces, estimator):
    one, same, other = (
        ReprojectionDisplay.from_estimator(estimator, faces.data, random_state=seed)
        for seed in (0, 0, 1)
    )
    assert len(one.frames) == 6
    assert_array_equal(one.frames, np.unique(one.frames))
    assert_array_equal(one.frames, same.frames)
    assert set(one.frames) != set(other.frames)
    # Each row is as likely as the others.
    counts = np.zeros(5)
    rng = np.random.RandomState(0)
    for _ in range(300):
        counts[choose_frames(5, 2, None, rng)] += 1
    assert_allclose(counts, 120, atol=40)


def test_short_tables_are_shown_whole(faces, estimator):
    display = ReprojectionDisplay.from_estimator(estimator, faces.data[:4])
    assert_array_equal(display.frames, range(4))
    with pytest.raises(ValueError, match="between 1 and the 4 rows of X; got 6"):
        ReprojectionDisplay.from_estimator(estimator, faces.data[:4], n_frames=6)
    with pytest.raises(ValueError, match="got 0"):
        ReprojectionDisplay.from_estimator(estimator, faces.data, n_frames=0)


@pytest.mark.parametrize("frames", [[60], [-1], 3, [], [0.5]])
def test_bad_frames(faces, estimator, frames):
    with pytest.raises(ValueError, match="frames must be"):
        ReprojectionDisplay.from_estimator(estimator, faces.data, frames=frames)


def test_rows_of_dataframes_have_names(faces):
    names = [f"photo{i}.jpg" for i in range(60)]
    X = pd.DataFrame(faces.data, columns=faces.feature_names, index=names)
    estimator = AffineNRSfM(2, random_state=0).fit(X)
    display = ReprojectionDisplay.from_estimator(estimator, X, frames=[5, 2])
    assert display.frame_names == ["photo5.jpg", "photo2.jpg"]
    assert display.axes_[1].get_title().startswith("frame photo2.jpg\n")
    assert_array_equal(display.observed, faces.tracks[[5, 2]])


def test_polars_tables(faces, estimator):
    pl = pytest.importorskip("polars")
    X = pl.DataFrame(faces.data, schema=faces.feature_names)
    estimator = AffineNRSfM(2, random_state=0).fit(X)
    display = ReprojectionDisplay.from_estimator(estimator, X, frames=[5, 2])
    assert display.frame_names == ["5", "2"]
    assert_array_equal(display.observed, faces.tracks[[5, 2]])


def test_faces_are_upright(faces, estimator):
    display = ReprojectionDisplay.from_estimator(estimator, faces.data, random_state=0)
    display.figure_.canvas.draw()
    for ax, points in zip(display.axes_, display.observed, strict=True):
        height = ax.transData.transform(points)[:, 1]
        assert height[17:27].mean() > height[8]
        assert ax.get_aspect() == 1

    flipped = faces.data * np.tile([1.0, -1.0], 68)
    other = AffineNRSfM(2, random_state=0).fit(flipped)
    display = ReprojectionDisplay.from_estimator(other, flipped, random_state=0)
    assert display.origin == "lower"
    for ax, points in zip(display.axes_, display.observed, strict=True):
        height = ax.transData.transform(points)[:, 1]
        assert height[17:27].mean() > height[8]


def test_points_have_equal_units_in_both_directions():
    display = random_display().plot()
    display.figure_.canvas.draw()
    sizes = [ax.bbox.size for ax in display.axes_]
    assert_allclose(sizes, sizes[:1] * 4)
    for ax, points in zip(display.axes_, display.observed, strict=True):
        pixels = ax.transData.transform(points)
        ratio = np.ptp(pixels, axis=0) / np.ptp(points, axis=0)
        assert ratio[0] == pytest.approx(ratio[1])
        assert (ax.bbox.get_points()[0] <= pixels.min(axis=0)).all()
        assert (pixels.max(axis=0) <= ax.bbox.get_points()[1]).all()


def test_missing_points_are_left_out():
    display = random_display()
    observed = display.observed.copy()
    observed[0, 3] = np.nan
    hidden = ReprojectionDisplay(observed=observed, reprojected=display.reprojected)
    others = np.arange(10) != 3
    alone = ReprojectionDisplay(
        observed=observed[:1, others], reprojected=display.reprojected[:1, others]
    )
    assert hidden.inverse_snr[0] == pytest.approx(alone.inverse_snr[0])
    hidden.plot().figure_.canvas.draw()
    assert np.isfinite(hidden.axes_[0].get_xlim()).all()
    assert len(hidden.reprojected_[0].get_offsets()) == 10


def test_one_legend_in_figures_of_our_own():
    display = random_display().plot()
    (legend,) = display.figure_.legends
    assert [text.get_text() for text in legend.get_texts()] == [
        "observed",
        "reprojected",
    ]
    assert all(ax.get_legend() is None for ax in display.axes_)
    figure, axes = plt.subplots(2, 2)
    assert display.plot(axes) is display
    assert display.figure_ is figure
    assert_array_equal(display.axes_, axes.ravel())
    assert not figure.legends


def test_the_grid():
    assert len(random_display(n_frames=4).plot().figure_.axes) == 4
    display = random_display(n_frames=4).plot(n_columns=2)
    assert display.axes_[0].get_subplotspec().get_gridspec().get_geometry() == (2, 2)
    assert random_display(n_frames=1).plot().axes_.shape == (1,)


def test_titles_do_not_overlap():
    display = random_display(n_frames=6).plot()
    display.figure_.canvas.draw()
    boxes = [ax.title.get_window_extent() for ax in display.axes_]
    boxes.append(display.figure_.legends[0].get_window_extent())
    page = display.figure_.bbox
    for i, box in enumerate(boxes):
        assert not any(box.overlaps(other) for other in boxes[i + 1 :])
        assert page.y0 <= box.y0
        assert box.y1 <= page.y1


def test_dense_shapes_are_clouds():
    display = random_display(n_points=500).plot()
    assert display.errors_ == []
    assert display.observed_[0].get_rasterized()


def test_styles_can_be_changed():
    display = random_display(edges=[[0, 1]]).plot(
        observed_kw={"s": 21}, reprojected_kw={"s": 22}, edge_kw={"linewidths": 4}
    )
    assert display.observed_[0].get_sizes() == [21]
    assert display.reprojected_[0].get_sizes() == [22]
    assert display.edges_[0].get_linewidths() == [4]


@pytest.mark.parametrize(
    ("kw", "message"),
    [
        ({"reprojected": np.zeros((2, 4, 2))}, r"got \(2, 5, 2\) and \(2, 4, 2\)"),
        ({"observed": np.zeros((2, 10))}, r"got \(2, 10\) and"),
        ({"frames": [1]}, r"must name the 2 frames; got shape \(1,\)"),
        ({"frame_names": ["a"]}, "must hold 2 names, one a frame; got 1"),
        ({"edges": [[0, 5]]}, "points 0 to 4"),
        ({"origin": "down"}, "got 'down'"),
        ({"observed": np.zeros((2, 5, 2))}, "X has no energy"),
    ],
)
def test_bad_data(kw, message):
    points = np.arange(20.0).reshape(2, 5, 2)
    with pytest.raises(ValueError, match=message):
        ReprojectionDisplay(**({"observed": points, "reprojected": points} | kw))


def test_wrong_number_of_axes(faces, estimator):
    _, axes = plt.subplots(1, 3)
    with pytest.raises(ValueError, match="must hold 2 axes, one a frame; got 3"):
        ReprojectionDisplay.from_estimator(
            estimator, faces.data, frames=[0, 1], ax=axes
        )


def test_unfitted(faces):
    with pytest.raises(NotFittedError):
        ReprojectionDisplay.from_estimator(AffineNRSfM(), faces.data)
    with pytest.raises(TypeError):
        ReprojectionDisplay(faces.tracks, faces.tracks)
