import matplotlib.pyplot as plt
import numpy as np
import pytest

from isa_nrsfm.plotting._axes import (
    MOST_SPARSE_POINTS,
    check_axes,
    check_names,
    draw_points,
    percent,
    row_width,
    wrap_title,
)


@pytest.fixture(autouse=True)
def close_figures():
    yield
    plt.close("all")


def test_axes_are_counted():
    _, axes = plt.subplots(2, 3)
    assert check_axes(axes, 6, "six").shape == (6,)
    assert check_axes(axes[0, 0], 1, "one").shape == (1,)
    with pytest.raises(ValueError, match="ax must hold 4 axes, two a shape; got 6"):
        check_axes(axes, 4, "two a shape")


def test_names_are_counted():
    assert check_names(None, 2) == ["1", "2"]
    assert check_names(("a", "b"), 2) == ["a", "b"]
    with pytest.raises(ValueError, match=r"must hold 3 names, .*; got 2"):
        check_names(["a", "b"], 3)


@pytest.mark.parametrize(
    ("fraction", "text"),
    [
        (0.0, "0 %"),
        (1.0, "100 %"),
        (0.434, "43 %"),
        (0.0521, "5.2 %"),
        (0.0996, "10 %"),
        (0.996, "100 %"),
        (1.234, "123 %"),
        (0.000996, "0.10 %"),
        (0.00123, "0.12 %"),
        (3.2e-5, "0.0032 %"),
        (4.1e-32, "4.1e-30 %"),
    ],
)
def test_percent(fraction, text):
    assert percent(fraction) == text


def test_many_points_are_small_and_rasterized():
    _, ax = plt.subplots()
    few = draw_points(ax, np.zeros((MOST_SPARSE_POINTS, 2)))
    many = draw_points(ax, np.zeros((MOST_SPARSE_POINTS + 1, 2)))
    assert not few.get_rasterized()
    assert many.get_rasterized()
    assert many.get_sizes()[0] < few.get_sizes()[0]


@pytest.mark.parametrize("layout", [None, "constrained"])
def test_the_width_of_a_row(layout):
    figure, axes = plt.subplots(2, 4, width_ratios=[1, 3, 1, 3], layout=layout)
    figure.set_size_inches(8, 3)
    for ax in figure.axes:
        ax.set(xticks=[], yticks=[])
    pair = row_width(axes[0, :2])
    alone = row_width(axes[0, 1:2])
    assert alone < pair <= 4.0
    figure.canvas.draw()
    boxes = [ax.get_position() for ax in axes[0, :2]]
    assert pair == pytest.approx(8 * (boxes[1].x1 - boxes[0].x0), rel=0.1)
    # One above the other: the width of the first.
    assert row_width(axes[::-1, 0]) == pytest.approx(row_width(axes[:1, 0]), rel=0.2)


def test_long_titles_are_broken():
    figure, axes = plt.subplots(1, 2)
    figure.set_size_inches(2, 2)
    title = wrap_title("Basis shape 12 (43 % of energy)", axes)
    assert title == "Basis shape 12\n(43 % of energy)"
    figure.set_size_inches(7, 2)
    assert wrap_title("Basis shape 12 (43 %)", axes) == "Basis shape 12 (43 %)"
