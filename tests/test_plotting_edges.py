"""What figures join, and which way is up in them."""

import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal

from isa_nrsfm.datasets import make_body_tracks, make_face_tracks, make_hand_tracks
from isa_nrsfm.plotting._edges import (
    choose_layout,
    choose_origin,
    choose_skeleton,
    upright_turn,
)
from isa_nrsfm.skeletons import get_skeleton

FACE = make_face_tracks(n_frames=2, random_state=0).mean_shape
HAND = make_hand_tracks(n_frames=60, random_state=0).mean_shape
BODY = make_body_tracks(n_frames=60, random_state=0).mean_shape
IBUG, COCO = get_skeleton("ibug-68"), get_skeleton("coco-17")


def test_layouts_are_recognised_or_named():
    assert choose_skeleton("auto", FACE) is IBUG
    assert choose_skeleton("auto", HAND) is get_skeleton("hand-21")
    assert choose_skeleton("auto", BODY) is None
    assert choose_skeleton("auto", BODY, COCO.point_names) == COCO
    assert choose_skeleton("coco-17", BODY) is COCO
    assert choose_skeleton(COCO, BODY) is COCO


def test_given_edges():
    shape = np.zeros((5, 3))
    assert choose_skeleton(None, shape) is None
    found = choose_skeleton([(0, 1), (4, 2)], shape)
    assert_array_equal(found.edges, [[0, 1], [4, 2]])
    assert not found.sides.any()


def test_the_layout_is_known_whatever_is_drawn():
    assert choose_layout(None, FACE, None) is IBUG
    assert choose_layout([[0, 1]], FACE, None) is IBUG
    assert choose_layout(COCO, BODY, None) is COCO
    assert choose_layout(None, BODY, None) is None


@pytest.mark.parametrize(
    ("edges", "message"),
    [
        ("tree", "edges must be .* Skeleton or the name of one .*; got 'tree'"),
        ("hand-21", "'hand-21' has 21 points, the shape 5"),
        ([0, 1], r"shape \(n_edges, 2\).* got shape \(2,\)"),
        ([[0.0, 1.0]], "must be integers"),
        ([[0, 1, 2]], "got shape"),
        ([[0, 5]], "points 0 to 4; got 0 to 5"),
        ([[-1, 0]], "points 0 to 4; got -1 to 0"),
    ],
)
def test_bad_edges(edges, message):
    with pytest.raises(ValueError, match=message):
        choose_skeleton(edges, np.zeros((5, 3)))


@pytest.mark.parametrize(("shape", "layout"), [(FACE, IBUG), (BODY, COCO)])
def test_faces_and_bodies_tell_which_way_y_points(shape, layout):
    assert choose_origin("auto", shape, layout) == "upper"
    assert choose_origin("auto", shape * [1, -1, 1], layout) == "lower"
    assert choose_origin("auto", shape * [1, -1, 1], None) == "upper"
    assert choose_origin("lower", shape, layout) == "lower"
    assert choose_origin("upper", shape * [1, -1, 1], layout) == "upper"
    with pytest.raises(ValueError, match="got 'top'"):
        choose_origin("top", shape, layout)


def test_hands_do_not_tell_which_way_y_points():
    hand = get_skeleton("hand-21")
    assert choose_origin("auto", HAND * [1, -1, -1], hand) == "upper"


@pytest.mark.parametrize("origin", ["upper", "lower"])
@pytest.mark.parametrize(
    ("shape", "layout"), [(FACE, IBUG), (BODY, COCO), (HAND, get_skeleton("hand-21"))]
)
def test_shapes_are_turned_upright(shape, layout, origin):
    seen = shape if origin == "upper" else shape * [1, -1, -1]
    tilt = np.array([[0.8, -0.6, 0], [0.6, 0.8, 0], [0, 0, 1]])
    turned = seen @ tilt.T @ upright_turn(seen @ tilt.T, layout, origin).T
    expected = seen @ upright_turn(seen, layout, origin).T
    assert_allclose(turned, expected, atol=1e-9 * np.abs(shape).max())
    below, above = turned[np.array(layout.up), 1].mean(axis=0)
    assert (above < below) == (origin == "upper")


def test_what_has_no_layout_stays():
    assert_array_equal(upright_turn(BODY, None, "upper"), np.eye(3))
    pairs = choose_skeleton([[0, 1]], BODY)
    assert_array_equal(upright_turn(BODY, pairs, "upper"), np.eye(3))
