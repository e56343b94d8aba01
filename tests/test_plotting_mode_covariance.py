from itertools import pairwise

import matplotlib.pyplot as plt
import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal
from sklearn.exceptions import NotFittedError

from isa_nrsfm import AffineNRSfM
from isa_nrsfm.datasets import make_face_tracks
from isa_nrsfm.plotting import ModeCovarianceDisplay
from isa_nrsfm.plotting._mode_covariance import asinh_ticks, correlations

# The figures do not depend on how far the iterations of the fit got.
pytestmark = pytest.mark.filterwarnings("ignore::sklearn.exceptions.ConvergenceWarning")


@pytest.fixture(autouse=True)
def close_figures():
    yield
    plt.close("all")


def covariance(n_components=3, seed=0):
    factor = np.random.default_rng(seed).standard_normal((50, 3 * n_components))
    return factor.T @ factor / 50


def test_the_estimators_matrix_is_shown():
    faces = make_face_tracks(n_frames=60, n_components=2, random_state=0)
    estimator = AffineNRSfM(2, random_state=0).fit(faces.data)
    display = ModeCovarianceDisplay.from_estimator(
        estimator, component_names=faces.component_names, scale="linear"
    )
    assert_array_equal(display.mode_covariance, estimator.mode_covariance_)
    assert_array_equal(display.im_.get_array(), estimator.mode_covariance_)
    labels = [label.get_text() for label in display.ax_.get_xticklabels()]
    assert labels == faces.component_names


@pytest.mark.parametrize("scale", [None, "asinh", "linear"])
def test_colours_are_symmetric_and_cover_the_matrix(scale):
    matrix = covariance()
    display = ModeCovarianceDisplay(mode_covariance=matrix).plot(scale=scale)
    low, high = display.im_.get_clim()
    assert low == -high
    assert high == np.abs(matrix).max()
    middle = display.im_.cmap(display.im_.norm([0.0]))[0, :3]
    assert_allclose(middle, middle[0], atol=0.01)  # a grey
    assert middle[0] > 0.95

    absolute = ModeCovarianceDisplay(mode_covariance=matrix).plot(
        scale=scale, absolute=True
    )
    assert_array_equal(absolute.im_.get_array(), np.abs(matrix))
    assert absolute.im_.get_clim() == (0, high)


def test_asinh_shows_small_blocks():
    matrix = np.kron(np.diag([1.0, 0.05]), np.eye(3))
    display = ModeCovarianceDisplay(mode_covariance=matrix)
    by_default, linear = display.plot(), ModeCovarianceDisplay(mode_covariance=matrix)
    linear.plot(scale="linear")
    assert by_default.im_.norm(0.05) > 0.6
    assert linear.im_.norm(0.05) == pytest.approx(0.525)


def test_boundaries_and_labels_of_the_blocks():
    display = ModeCovarianceDisplay(mode_covariance=covariance(3)).plot()
    segments = np.array(display.boundaries_.get_segments())
    assert_array_equal(
        segments,
        [[[c, -0.5], [c, 8.5]] for c in (2.5, 5.5)]
        + [[[-0.5, c], [8.5, c]] for c in (2.5, 5.5)],
    )
    for axis in (display.ax_.xaxis, display.ax_.yaxis):
        assert_array_equal(axis.get_ticklocs(), [1, 4, 7])
        assert [label.get_text() for label in axis.get_ticklabels()] == ["1", "2", "3"]
    # The first row is at the top.
    assert display.ax_.get_ylim() == (8.5, -0.5)


def test_a_single_basis_shape_has_no_boundaries():
    display = ModeCovarianceDisplay(mode_covariance=covariance(1)).plot()
    assert display.boundaries_.get_segments() == []


def test_colour_bar():
    display = ModeCovarianceDisplay(mode_covariance=covariance()).plot()
    assert display.colorbar_.mappable is display.im_
    assert display.colorbar_.ax.get_ylabel() == "covariance"
    display.plot(normalize=True, absolute=True)
    assert display.colorbar_.ax.get_ylabel() == "absolute correlation"
    assert display.plot(colorbar=False).colorbar_ is None
    assert len(display.figure_.axes) == 1


@pytest.mark.parametrize("largest", [3e-7, 0.017, 0.5, 1.0, 99.0])
def test_ticks_of_the_asinh_scale(largest):
    ticks = asinh_ticks(largest, signed=True)
    assert_array_equal(ticks, -ticks[::-1])
    assert 0 in ticks
    assert largest / 10 < ticks.max() <= largest
    assert_array_equal(asinh_ticks(largest, signed=False), ticks[ticks >= 0])
    display = ModeCovarianceDisplay(mode_covariance=largest * np.eye(6)).plot()
    display.figure_.canvas.draw()
    boxes = [t.get_window_extent() for t in display.colorbar_.ax.get_yticklabels()]
    assert len(boxes) == len(ticks)
    assert not any(a.overlaps(b) for a, b in pairwise(boxes))


def test_correlations():
    matrix = covariance()
    result = correlations(matrix)
    assert_allclose(np.diag(result), 1)
    scale = np.sqrt(np.diag(matrix))
    assert_allclose(result * np.outer(scale, scale), matrix)
    matrix[2] = matrix[:, 2] = 0
    assert_array_equal(correlations(matrix)[2], 0)
    display = ModeCovarianceDisplay(mode_covariance=matrix).plot(normalize=True)
    assert_array_equal(display.im_.get_array(), correlations(matrix))
    assert display.im_.get_clim() == (-1, 1)


def test_share_outside_of_the_blocks():
    blocks = np.kron(np.eye(2), np.ones((3, 3)))
    display = ModeCovarianceDisplay(mode_covariance=blocks)
    assert display.off_block_share == 0
    display = ModeCovarianceDisplay(mode_covariance=np.ones((6, 6)))
    assert display.off_block_share == pytest.approx(0.5)
    display = ModeCovarianceDisplay(mode_covariance=np.zeros((6, 6)))
    assert display.off_block_share == 0
    display.plot().figure_.canvas.draw()


def test_axes_given_or_not():
    display = ModeCovarianceDisplay(mode_covariance=covariance())
    assert display.plot() is display
    figure, ax = plt.subplots()
    display.plot(ax, im_kw={"cmap": "PuOr"})
    assert display.ax_ is ax
    assert display.figure_ is figure
    assert display.im_.get_cmap().name == "PuOr"
    assert len(plt.get_fignums()) == 2
    with pytest.raises(ValueError, match="must hold 1 axes, the matrix; got 2"):
        display.plot(plt.subplots(1, 2)[1])


@pytest.mark.parametrize("shape", [(4, 4), (3, 6), (0, 0), (3,)])
def test_bad_matrices(shape):
    with pytest.raises(ValueError, match="must be a square matrix"):
        ModeCovarianceDisplay(mode_covariance=np.zeros(shape))


def test_bad_arguments():
    with pytest.raises(ValueError, match="must hold 2 names"):
        ModeCovarianceDisplay(mode_covariance=np.eye(6), component_names=["one"])
    with pytest.raises(ValueError, match="got 'log'"):
        ModeCovarianceDisplay(mode_covariance=np.eye(6)).plot(scale="log")
    with pytest.raises(TypeError):
        ModeCovarianceDisplay(np.eye(6))
    with pytest.raises(NotFittedError):
        ModeCovarianceDisplay.from_estimator(AffineNRSfM())
