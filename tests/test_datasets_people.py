"""Generated hands and bodies of several people, with labels, groups and time."""

import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal

from isa_nrsfm.datasets import make_body_tracks, make_face_tracks, make_hand_tracks
from isa_nrsfm.skeletons import get_skeleton

MAKERS = pytest.mark.parametrize(
    ("make", "layout", "labels"),
    [
        (make_hand_tracks, "hand-21", ["fist", "open", "point"]),
        (make_body_tracks, "coco-17", ["reach", "squat", "walk"]),
    ],
)


def lengths(shapes, edges):
    """Return the lengths of edges (n_frames, n_edges)."""
    ends = shapes[:, edges]
    return np.linalg.norm(ends[:, :, 0] - ends[:, :, 1], axis=2)


@MAKERS
@pytest.mark.parametrize("camera", ["weak_perspective", "orthographic", "affine"])
def test_tables_are_images_of_the_shapes(make, layout, labels, camera):
    scene = make(90, n_people=3, camera=camera, missing=0.1, random_state=0)
    n_points = get_skeleton(layout).n_points
    images = scene.shapes @ scene.motion.mT + scene.translation[:, None]
    assert_allclose(scene.clean, images)
    assert scene.data.shape == (90, 2 * n_points)
    assert np.isnan(scene.tracks).any(axis=2).mean() == pytest.approx(0.1, abs=1e-3)
    off = (scene.tracks - scene.clean)[scene.visible]
    assert np.mean(off**2) == pytest.approx(scene.noise_variance, rel=0.1)
    rows = np.linalg.norm(scene.motion, axis=2)
    if camera != "affine":
        assert_allclose(rows[:, 0], rows[:, 1])
    assert (np.ptp(rows) < 1e-12) == (camera == "orthographic")
    assert scene.point_names == list(get_skeleton(layout).point_names)


@MAKERS
def test_each_person_takes_all_poses_in_time(make, layout, labels):
    scene = make(400, n_people=3, random_state=1)
    assert_array_equal(np.unique(scene.groups), range(3))
    assert (np.diff(scene.groups) >= 0).all()
    for person in range(3):
        own = scene.groups == person
        assert sorted(set(scene.labels[own].tolist())) == labels
        assert_allclose(scene.time[own], np.arange(own.sum()) / 25)
    # Smooth within a person: a frame is near the one before, relative to the size.
    steps = np.linalg.norm(np.diff(scene.shapes, axis=0), axis=(1, 2))
    size = np.linalg.norm(scene.shapes[0])
    same = np.diff(scene.groups) == 0
    assert steps[same].max() < 0.3 * size
    assert np.abs(np.diff(scene.angles, axis=0))[same].max() < 10


@MAKERS
def test_bones_are_rigid_and_everybody_has_their_own(make, layout, labels):
    scene = make(300, n_people=3, random_state=2)
    edges = get_skeleton(layout).edges
    if layout == "coco-17":
        # Arms and legs; shoulders and hips keep their width, the trunk bends.
        edges = np.array([[5, 7], [7, 9], [6, 8], [11, 13], [13, 15], [5, 6], [11, 12]])
    else:
        edges = edges[: 4 * 4]
    of_people = []
    for person in range(3):
        found = lengths(scene.shapes[scene.groups == person], edges)
        assert_allclose(found, found[:1].repeat(len(found), axis=0), rtol=1e-6)
        of_people.append(found[0])
    assert np.ptp(of_people, axis=0).min() > 1e-3 * np.mean(of_people)


@MAKERS
def test_seeds(make, layout, labels):
    one, same = (make(60, random_state=3, noise=noise) for noise in (0.01, 0.02))
    assert_array_equal(one.shapes, same.shapes)
    assert_array_equal(one.labels, same.labels)
    assert np.abs(make(60, random_state=4).shapes - one.shapes).max() > 1


@MAKERS
@pytest.mark.parametrize(
    "options", [{"n_frames": 1}, {"n_people": 0}, {"camera": "fisheye"}, {"noise": -1}]
)
def test_bad_parameters(make, layout, labels, options):
    with pytest.raises(ValueError, match=next(iter(options))):
        make(**options)


@MAKERS
def test_too_few_frames_for_the_people(make, layout, labels):
    with pytest.raises(ValueError, match="at least 2 frames for each of 5 people"):
        make(9, n_people=5)


def test_the_two_orders_of_bodies_are_of_the_same_bodies():
    coco = make_body_tracks(50, random_state=0)
    human = make_body_tracks(50, scheme="h36m-17", random_state=0)
    assert_array_equal(coco.labels, human.labels)
    both = ["left_knee", "right_elbow", "left_wrist"]
    one, other = (
        scene.shapes[:, [scene.point_names.index(name) for name in both]]
        for scene in (coco, human)
    )
    assert_allclose(np.diff(one, axis=1), np.diff(other, axis=1), atol=1e-9)
    with pytest.raises(ValueError, match="scheme"):
        make_body_tracks(scheme="body-25")


def test_poses_are_what_they_are_called():
    hands = make_hand_tracks(400, random_state=0)
    tips = np.linalg.norm(hands.shapes[:, [8, 12]] - hands.shapes[:, [0]], axis=2)
    far = {
        name: np.median(tips[hands.labels == name], axis=0)
        for name in ("open", "fist", "point")
    }
    assert (far["fist"] < 0.7 * far["open"]).all()
    assert far["point"][0] > 0.9 * far["open"][0]  # the index finger
    assert far["point"][1] < 0.7 * far["open"][1]
    bodies = make_body_tracks(400, random_state=0)
    y = {name: bodies.shapes[:, j, 1] for j, name in enumerate(bodies.point_names)}
    height = np.ptp(bodies.shapes[:, :, 1], axis=1)
    assert bodies.labels[height.argmin()] == "squat"
    raised = y["right_wrist"] < y["nose"]
    assert set(bodies.labels[raised].tolist()) <= {"reach"}
    assert raised.any()


def test_faces_have_labels_groups_and_time():
    faces = make_face_tracks(50, n_components=8, random_state=0)
    strongest = faces.strength[:, :7].argmax(axis=1)  # the width is no expression
    assert_array_equal(faces.labels, np.array(faces.component_names)[strongest])
    assert not faces.groups.any()
    assert_allclose(faces.time, np.arange(50) / 25)
    assert set(make_face_tracks(5, n_components=0).labels.tolist()) == {"rest"}
