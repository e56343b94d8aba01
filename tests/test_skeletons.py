"""Layouts of landmarks: their tables, and which one points have."""

import dataclasses
import re

import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal
from refusals import refusals_of, refused
from scipy.spatial.transform import Rotation

from isa_nrsfm.calibration import canonical_pose
from isa_nrsfm.cli import main
from isa_nrsfm.datasets import make_body_tracks, make_face_tracks, make_hand_tracks
from isa_nrsfm.skeletons import (
    SKELETONS,
    Skeleton,
    find_skeleton,
    get_skeleton,
    read_skeleton,  # noqa: F401  in refusals.txt
    skeleton_of_names,
)

# The mirror image of a ring of the irises is not documented.
RINGS = {*range(469, 473), *range(474, 478)}


def undirected(edges):
    return {frozenset(map(int, edge)) for edge in edges}


def test_the_layouts(capsys):
    assert len(SKELETONS) == 16
    for name, skeleton in SKELETONS.items():
        assert skeleton.name == name == f"{name.rpartition('-')[0]}-{skeleton.n_points}"
    refused(None, main, ["fit", "--help"], error=SystemExit)
    text = " ".join(capsys.readouterr().out.split())
    assert f"determine it: {', '.join(SKELETONS)}, or the config.yaml" in text


# Points that no edge joins
ALONE = dict.fromkeys(("xm2vts-68", "muct-76"), (31, 36, 46, 47, 66, 67))
ALONE |= dict.fromkeys(("xm2vts-53", "muct-61"), (16, 21, 31, 32, 51, 52))
ALONE |= {"wflw-98": (96, 97), "wflw-65": (63, 64)}


@pytest.mark.parametrize("name", SKELETONS)
def test_each_joins_its_points_and_is_its_own_mirror_image(name):
    skeleton = SKELETONS[name]
    assert re.search("20|1999", skeleton.source)
    if not name.startswith("mediapipe-face"):
        joined = set(skeleton.edges.ravel().tolist())
        assert set(range(skeleton.n_points)) - joined == {*ALONE.get(name, ())}
    mirror, points = np.arange(skeleton.n_points), skeleton.point_names or ()
    for left, right in zip(skeleton.left, skeleton.right, strict=True):
        mirror[[left, right]] = right, left
        if points and "left" in points[left]:
            assert points[right] == points[left].replace("left", "right")
    edges = np.array([e for e in skeleton.edges if not RINGS & set(e.tolist())])
    assert undirected(mirror[edges]) == undirected(edges)
    assert len(undirected(edges)) == len(edges)
    for side in ("left", "right"):
        named = {j for j, point in enumerate(points) if side in point}
        assert named <= {*getattr(skeleton, side)}


@pytest.mark.parametrize("name", ["coco-17", "h36m-17"])
def test_bodies_are_turned_upright_and_mirrored_back(name):
    body = make_body_tracks(200, scheme=name, random_state=0).mean_shape
    upright = canonical_pose(body, scheme=name)
    assert not upright.mirrored
    # Bodies of the generator stand upright, but for how far they lean.
    assert np.rad2deg(Rotation.from_matrix(upright.rotation).magnitude()) < 15
    turned = Rotation.random(random_state=0).apply(body)
    assert_allclose(canonical_pose(turned, scheme=name).shape, upright.shape, atol=1e-6)
    mirrored = canonical_pose(turned * [1, 1, -1], scheme=name)
    assert mirrored.mirrored
    assert_allclose(mirrored.shape, upright.shape, atol=1e-6)


def test_hands_are_turned_upright_and_keep_the_side_that_is_seen():
    hand = make_hand_tracks(200, random_state=0).mean_shape
    upright = canonical_pose(hand, scheme="hand-21").shape
    palm = upright[9] - upright[0]
    assert_allclose(palm[[0, 2]], 0, atol=1e-9)
    assert palm[1] < 0
    for angle in (-100, 80):
        turned = Rotation.from_euler("z", angle, degrees=True).apply(hand)
        again = canonical_pose(turned, scheme=get_skeleton("hand-21"))
        assert_allclose(again.shape, upright, atol=1e-9)
    back = canonical_pose(hand * [-1, 1, -1], scheme="hand-21").shape
    assert_allclose(back, upright * [-1, 1, -1], atol=1e-9)


REAL = ("ict_bu3dfe_like_68", "faces_wild_68_combined", "expressions_dlib_68")
REAL = dict.fromkeys(REAL, "ibug-68")
REAL |= {"muct_68": "xm2vts-68", "hands_kazuhito_21": "hand-21"}


@pytest.mark.parametrize(("name", "layout"), REAL.items())
def test_real_tables_are_recognised(load_data, name, layout):
    tracks = load_data(name)["W2d"]
    tracks = tracks[np.isfinite(tracks).all(axis=(1, 2))]
    tracks = tracks - tracks.mean(axis=1, keepdims=True)
    shape = np.mean(tracks / np.linalg.norm(tracks, axis=(1, 2), keepdims=True), axis=0)
    found = find_skeleton(len(shape), shape=shape)
    assert found is SKELETONS[layout]
    if found.left:
        right, left = shape[found.left_right.T]
        assert (left[:, 0] > right[:, 0]).all()


def name_of(shape):
    """Return the layout of a shape of any size, or None."""
    found = find_skeleton(len(shape), shape=shape)
    assert find_skeleton(len(shape), shape=7 * shape + 3) is found
    return found and found.name


FACE = make_face_tracks(100, random_state=0).mean_shape
HAND = make_hand_tracks(100, random_state=0).mean_shape
H36M = make_body_tracks(100, scheme="h36m-17", random_state=0).mean_shape
RNG = np.random.default_rng(0)


OPENPOSE = """Nose Neck RShoulder RElbow RWrist LShoulder LElbow LWrist MidHip RHip
RKnee RAnkle LHip LKnee LAnkle REye LEye REar LEar LBigToe LSmallToe LHeel RBigToe
RSmallToe RHeel""".split()


def test_names_in_another_order_are_the_layout_in_that_order():
    coco = get_skeleton("coco-17")
    order = np.random.default_rng(0).permutation(17)
    names = [coco.point_names[j] for j in order]
    found = find_skeleton(17, names)
    assert found.point_names == tuple(names)
    for part in ("edges", "up", "front", "across", "left", "right"):
        places, expected = (np.array(getattr(each, part)) for each in (found, coco))
        assert order[places].tolist() == expected.tolist()
    shape = make_body_tracks(100, random_state=0).mean_shape
    pose = canonical_pose(shape[order], scheme=found)
    assert_allclose(pose.rotation, canonical_pose(shape, scheme=coco).rotation)


NAMES = ["snout", "LeftEar", "RightEar", "tail", "left"]
EDGES = [("snout", "LeftEar"), ("RightEar", "snout")]
MOUSE = skeleton_of_names(EDGES, NAMES, name="mouse", source="me")
CONFIG, GREEK = "skeleton:\n- [a, b]\n- [b, c, a]\n", "skeleton:\n- [né, Ω]\n"
WITH_CONTOUR = {
    **{"ibug-68": "ibug-51", "xm2vts-68": "xm2vts-53", "muct-76": "muct-61"},
    "wflw-98": "wflw-65",
}


@pytest.mark.parametrize(("name", "rest"), WITH_CONTOUR.items())
def test_inner_points_are_a_layout(name, rest):
    whole, inner = get_skeleton(name), get_skeleton(rest)
    assert whole.contour == whole.curves[0]  # the jaw
    others = SKELETONS.keys() - WITH_CONTOUR.keys() - {BODY.name}
    assert not any(SKELETONS[other].contour for other in others)
    assert BODY.contour == tuple(range(23, 40))  # where its face begins
    pose = {"name": rest, "up": inner.up, "front": inner.front}
    assert dataclasses.replace(whole.subset(whole.inner), **pose) == inner
    edges = [edge for edge in whole.edges.tolist() if not {*edge} & {*whole.contour}]
    assert whole.inner[inner.edges].tolist() == edges
    columns = np.stack([2 * whole.inner, 2 * whole.inner + 1], axis=1).ravel()
    assert_array_equal(np.arange(2 * whole.n_points)[whole.inner_columns], columns)


def sides_and_contour(skeleton):
    return skeleton.left, skeleton.right, skeleton.contour


MADE = Skeleton(
    **{"name": "made", "kind": "other", "n_points": 7, "source": "a test, 2024"},
    curves=((0, 1, 2, 3, 4), (5, 6)),
    point_names=tuple("abcdefg"),
    left=(0, 5),
    right=(1, 6),
    up=((0, 4), (2, 3)),
    contour=(2, 4),
)
PART = MADE.subset([6, 0, 1, 3, 4])
WHOLE = "muct-76", "mediapipe-face-478", "coco-wholebody-133"
MUCT, MESH, BODY = map(get_skeleton, WHOLE)


def skeleton(**change):
    given = {"name": "x", "kind": "other", "n_points": 4, "curves": ()} | change
    return Skeleton(source="mine", **given)


test_refusals = refusals_of("skeletons", globals())
