import numpy as np
import pytest
from numpy.testing import assert_array_equal

from isa_nrsfm.datasets import make_face_tracks
from isa_nrsfm.plotting._edges import (
    FACE_ORDERS,
    IBUG,
    XM2VTS,
    choose_edges,
    choose_origin,
    mean_edge_length,
    recognise_face,
)


def mean_image(load_data, name):
    """The mean of the complete frames, each centred and of unit size."""
    W = load_data(name)["W2d"]
    W = W[np.isfinite(W).all(axis=(1, 2))]
    W = W - W.mean(axis=1, keepdims=True)
    return (W / np.linalg.norm(W, axis=(1, 2), keepdims=True)).mean(axis=0)


def test_curves_name_each_point_at_most_once_but_for_closed_ends_and_corners():
    assert set(IBUG.edges.ravel()) == set(range(68))
    # Pupils, nostrils, middle of the mouth and tip of the nose stand alone.
    alone = {31, 36, 46, 47, 66, 67}
    assert set(XM2VTS.edges.ravel()) == set(range(68)) - alone
    for order in FACE_ORDERS:
        pairs = {tuple(sorted(pair)) for pair in order.edges.tolist()}
        assert len(pairs) == len(order.edges)
    assert len(IBUG.edges) == 16 + 4 + 4 + 3 + 4 + 6 + 6 + 12 + 8
    for closing in ((36, 41), (42, 47), (48, 59), (60, 67)):
        assert closing[::-1] in map(tuple, IBUG.edges.tolist())

    # The inner edges of both lips end in the corners of the mouth.
    for corner in ((48, 60), (62, 54), (54, 63), (65, 48)):
        assert corner in map(tuple, XM2VTS.edges.tolist())


@pytest.mark.parametrize(
    ("name", "order"),
    [
        ("ict_bu3dfe_like_68", IBUG),
        ("faces_wild_68_combined", IBUG),
        ("expressions_dlib_68", IBUG),
        ("muct_68", XM2VTS),
    ],
)
def test_faces_are_recognised(load_data, name, order):
    shape = mean_image(load_data, name)
    assert recognise_face(shape) is order
    assert_array_equal(choose_edges("auto", shape), order.edges)


def test_the_order_with_the_shorter_edges_is_taken():
    face = make_face_tracks(n_frames=2, random_state=0).mean_shape
    assert recognise_face(face) is IBUG
    lengths = [mean_edge_length(face, order.edges) for order in FACE_ORDERS]
    assert lengths[0] < lengths[1]
    # The size and place of the shape do not matter.
    assert mean_edge_length(7 * face + 3, IBUG.edges) == pytest.approx(lengths[0])


@pytest.mark.parametrize("seed", range(10))
def test_68_points_that_are_no_face_are_not_joined(seed):
    rng = np.random.default_rng(seed)
    face = make_face_tracks(n_frames=2, random_state=0).mean_shape
    for shape in (
        rng.standard_normal((68, 3)),
        rng.uniform(size=(68, 2)),
        rng.permutation(face),
    ):
        assert recognise_face(shape) is None
        assert choose_edges("auto", shape) is None
        assert choose_origin("auto", shape) == "upper"


def test_degenerate_and_other_shapes_are_not_joined():
    assert recognise_face(np.zeros((68, 3))) is None
    face = make_face_tracks(n_frames=2, random_state=0).mean_shape
    assert recognise_face(face[:67]) is None
    assert recognise_face(np.concatenate([face, face[:8]])) is None


def test_given_edges():
    shape = np.zeros((5, 3))
    assert choose_edges(None, shape) is None
    assert_array_equal(choose_edges([(0, 1), (4, 2)], shape), [[0, 1], [4, 2]])


@pytest.mark.parametrize(
    ("edges", "message"),
    [
        ("face", "got 'face'"),
        ([0, 1, 2], r"got shape \(3,\)"),
        ([[0, 1, 2]], r"got shape \(1, 3\)"),
        ([[0.0, 1.0]], "dtype float64"),
        ([[0, 5]], "points 0 to 4; got 0 to 5"),
        ([[-1, 2]], "points 0 to 4; got -1 to 2"),
    ],
)
def test_bad_edges(edges, message):
    with pytest.raises(ValueError, match=message):
        choose_edges(edges, np.zeros((5, 3)))


def test_faces_stand_upright():
    face = make_face_tracks(n_frames=2, random_state=0).mean_shape
    assert choose_origin("auto", face) == "upper"
    assert choose_origin("auto", face * [1, -1, 1]) == "lower"
    assert choose_origin("lower", face) == "lower"
    assert choose_origin("upper", face * [1, -1, 1]) == "upper"
    with pytest.raises(ValueError, match="got 'top'"):
        choose_origin("top", face)


def test_the_y_axis_of_real_tables(load_data):
    assert choose_origin("auto", mean_image(load_data, "muct_68")) == "upper"
    assert choose_origin("auto", mean_image(load_data, "ict_bu3dfe_like_68")) == "lower"
