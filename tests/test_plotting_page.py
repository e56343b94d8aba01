import matplotlib.pyplot as plt
import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal

from isa_nrsfm.plotting._page import (
    MOST_HEIGHT,
    PAGE_WIDTH,
    block_limits,
    choose_n_columns,
    new_page,
)


@pytest.fixture(autouse=True)
def close_figures():
    yield
    plt.close("all")


def test_all_shapes_are_inside_the_limits():
    rng = np.random.default_rng(0)
    mean = rng.standard_normal((20, 3)) * [2, 1, 0.5]
    blocks = [mean[None]]
    for size in (0.1, 0.2, 0.1, 30.0):
        drift = size * rng.standard_normal((20, 3))
        blocks.append(np.stack([mean, mean + drift, mean - drift]))
    limits, reduction = block_limits(blocks)

    for block, (low, high) in zip(blocks, np.moveaxis(limits, 2, 1), strict=True):
        assert (block > low).all()
        assert (block < high).all()
    # One scale and one window, but for the basis shape out of all proportion.
    assert_array_equal(reduction[:4], 1)
    assert_array_equal(limits[1:4], limits[[0, 0, 0]])
    assert reduction[4] > 10
    extent = np.ptp(limits, axis=2)
    assert_allclose(extent[4], reduction[4] * extent[0])


def test_one_wild_basis_shape_of_two_is_drawn_smaller():
    mean = np.array([[0.0, 0.0, 0.0], [1.0, 1.0, 1.0]])
    blocks = [np.stack([s * mean]) for s in (1.0, 1.1, 30.0)]
    _, reduction = block_limits(blocks)
    assert_array_equal(reduction[:2], 1)
    assert reduction[2] == pytest.approx(30 / 1.1, rel=0.05)


def test_large_drifts_alone_are_no_reason_for_another_scale():
    rng = np.random.default_rng(1)
    mean = rng.standard_normal((20, 3))
    drifts = [5 * rng.standard_normal((20, 3)) for _ in range(3)]
    blocks = [mean[None], *(np.stack([mean + d, mean - d]) for d in drifts)]
    limits, reduction = block_limits(blocks)
    assert_array_equal(reduction, 1)
    assert_array_equal(limits, limits[:1].repeat(4, axis=0))


def test_points_that_are_all_equal_have_limits():
    limits, reduction = block_limits([np.ones((1, 5, 3)), np.ones((3, 5, 3))])
    assert (np.ptp(limits, axis=2) > 0).all()
    assert_array_equal(reduction, 1)


@pytest.mark.parametrize("aspect", [0.5, 1.6, 6.0])
@pytest.mark.parametrize("n_shapes", [2, 3, 6, 10])
def test_columns(n_shapes, aspect):
    n_columns = choose_n_columns(n_shapes, aspect)
    assert 1 <= n_columns <= n_shapes
    axes = new_page(n_shapes, np.array([aspect / 2, 1, aspect / 2]), None)
    assert len(axes) == 2 * n_shapes
    figure = axes[0].figure
    assert figure.axes == list(axes)
    assert figure.get_figwidth() == PAGE_WIDTH
    assert figure.get_figheight() <= MOST_HEIGHT
    assert axes[0].get_subplotspec().get_gridspec().ncols == 2 * n_columns


def test_given_number_of_columns():
    axes = new_page(5, np.array([1.0, 2.0, 3.0]), 2)
    grid = axes[0].get_subplotspec().get_gridspec()
    assert (grid.nrows, grid.ncols) == (3, 4)
    assert grid.get_width_ratios() == [1.0, 3.0, 1.0, 3.0]
