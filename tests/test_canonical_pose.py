"""Shapes turned upright and frontal, and the angles of rotations."""

import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal
from refusals import refused
from scipy.spatial.transform import Rotation

from isa_nrsfm.calibration import angle_deviations, canonical_pose, view_angles
from isa_nrsfm.datasets import make_face_tracks

MIRROR = np.diag([1.0, 1.0, -1.0])
ROTATIONS = Rotation.random(5, random_state=0).as_matrix()
# The directions of `face`, by points: nose, chin, brow, eyes and ears.
LEFT_RIGHT = [[36, 45], [0, 16]]
UP, FRONT = [[8, 27]], [[0, 30], [16, 30]]
POINTS = {"left_right": LEFT_RIGHT, "up": UP, "front": FRONT}


@pytest.fixture(scope="module")
def face():
    """A face that looks at the viewer: x points right, y down, z away from it."""
    return make_face_tracks(n_frames=2, random_state=0).neutral_shape


def angle_between(one, two):
    return np.rad2deg(Rotation.from_matrix(one @ two.T).magnitude())


class TestByPoints:
    @pytest.mark.parametrize("turn", ROTATIONS)
    @pytest.mark.parametrize("mirror", [np.eye(3), MIRROR], ids=["same", "mirrored"])
    def test_turned_shapes_and_mirror_images_have_one_pose(self, face, turn, mirror):
        given = face @ mirror @ turn.T
        pose = canonical_pose(given, **POINTS)
        assert_allclose(pose.shape, canonical_pose(face, **POINTS).shape, atol=1e-10)
        assert_allclose(pose.shape, given @ pose.rotation.T, atol=1e-10)
        assert np.linalg.det(pose.rotation) == pytest.approx(np.linalg.det(mirror))
        assert pose.mirrored == (mirror is MIRROR)

    def test_mirror_images_stay_what_they_are_without_front(self, face):
        pose = canonical_pose(face @ MIRROR, left_right=LEFT_RIGHT, up=UP)
        assert not pose.mirrored
        upright = canonical_pose(face, left_right=LEFT_RIGHT, up=UP)
        assert_allclose(pose.shape, upright.shape @ MIRROR, atol=1e-10)

    def test_axes_of_the_image(self, face):
        shape = canonical_pose(face, **POINTS).shape
        right_eye, left_eye, chin, root, ear, tip = shape[[36, 45, 8, 27, 0, 30]]
        assert left_eye[0] > right_eye[0]
        assert_allclose((left_eye - right_eye)[1:], 0, atol=1e-10)
        assert root[1] < chin[1]
        assert tip[2] < ear[2]
        # The face was upright but for the slope from the chin to the root of the nose.
        assert angle_between(canonical_pose(face, **POINTS).rotation, np.eye(3)) < 3

    def test_x_comes_before_y_and_y_before_z(self):
        points = np.random.default_rng(0).standard_normal((5, 3))
        right = {"left_right": [[0, 1]]}
        up, front = {"up": [1.0, 2.0, 0.5]}, {"front": [0.0, 0.1, 1.0]}
        images = {"left_right": points[1] - points[0], **up, **front}
        for given, exact, signs in (
            (right | up | front, "left_right", [1, 0, 0]),
            (right | up, "left_right", [1, 0, 0]),
            (right | front, "left_right", [1, 0, 0]),
            (up | front, "up", [0, -1, 0]),
        ):
            R = canonical_pose(points, **given).rotation
            size = np.linalg.norm(images[exact])
            assert_allclose(R @ images[exact], size * np.array(signs), atol=1e-12)
            if "up" in given:
                _, y, z = R @ images["up"]
                assert y < 0
                assert z == pytest.approx(0, abs=1e-12)
            if "front" in given:
                assert (R @ images["front"])[2] < 0

    @pytest.mark.parametrize("missing", ["left_right", "up", "front"])
    def test_two_directions_determine_a_rotation(self, face, missing):
        given = {name: pairs for name, pairs in POINTS.items() if name != missing}
        for mirror in (np.eye(3), MIRROR):
            pose = canonical_pose(face @ mirror, **given)
            assert np.linalg.det(pose.rotation) == pytest.approx(1)
            assert not pose.mirrored

    def test_directions_and_pairs_mean_the_same(self, face):
        pairs = [[8, 27], [57, 33]]
        mean = np.mean([face[27] - face[8], face[33] - face[57]], axis=0)
        one = canonical_pose(face, left_right=LEFT_RIGHT, up=pairs)
        two = canonical_pose(face, left_right=LEFT_RIGHT, up=2.5 * mean)
        assert_allclose(one.rotation, two.rotation, atol=1e-12)


class TestScheme:
    @pytest.mark.parametrize("turn", ROTATIONS)
    @pytest.mark.parametrize("mirrored", [False, True])
    def test_ibug_faces(self, face, turn, mirrored):
        given = face @ (MIRROR if mirrored else np.eye(3)) @ turn.T
        pose = canonical_pose(given, scheme="ibug-68")
        assert pose.mirrored == mirrored
        assert np.abs(pose.shape - face).max() < 0.03 * np.ptp(face[:, 1])
        # The face is symmetric.
        assert_allclose(pose.rotation[0], turn[:, 0], atol=1e-10)

    def test_true_faces_stand_upright(self, load_data):
        truth = load_data("ict_bu3dfe_like_68")["S3d"].astype(float)
        mean = (truth - truth.mean(axis=1, keepdims=True)).mean(axis=0)
        # In that data set y points up and z to the viewer.
        upright = np.diag([1.0, -1.0, -1.0])
        pose = canonical_pose(mean, scheme="ibug-68")
        assert angle_between(pose.rotation, upright) < 4
        assert not pose.mirrored
        assert canonical_pose(mean @ MIRROR, scheme="ibug-68").mirrored

    def test_what_is_given_comes_first(self, face):
        up = face[27] - face[8] + [0, 0, 30.0]
        one = canonical_pose(face, scheme="ibug-68", up=up)
        assert one.rotation[2] @ up == pytest.approx(0, abs=1e-9)
        two = canonical_pose(face, scheme="ibug-68")
        assert angle_between(one.rotation, two.rotation) > 5


class TestPrincipalAxes:
    @pytest.fixture
    def points(self):
        return np.random.default_rng(0).standard_normal((200, 3)) * [1.0, 3.0, 2.0]

    @pytest.mark.parametrize("seed", range(5))
    def test_nearest_axes(self, points, seed):
        rng = np.random.default_rng(seed)
        turn = Rotation.from_rotvec(0.2 * rng.standard_normal(3)).as_matrix()
        upright = canonical_pose(points)
        pose = canonical_pose(points @ turn.T + 4.0)
        assert_allclose(pose.rotation @ turn, upright.rotation, atol=1e-9)
        assert np.linalg.det(pose.rotation) == pytest.approx(1)
        centred = pose.shape - pose.shape.mean(axis=0)
        scatter = centred.T @ centred
        assert_allclose(scatter, np.diag(np.diag(scatter)), atol=1e-8 * scatter.max())
        assert_array_equal(np.argsort(np.diag(scatter)), [0, 2, 1])
        assert not pose.mirrored


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({"left_right": LEFT_RIGHT}, "two of left_right, up and front"),
        (
            {"up": [0, 1.0, 0], "front": [0, 2.0, 0]},
            "up and front must not be parallel",
        ),
        ({"left_right": [[0, 16]], "up": [1.0, 0, 0]}, "left_right and up must not be"),
        ({"up": np.zeros(3), "front": FRONT}, "up must be a direction other than zero"),
        ({"up": [np.nan, 0, 1], "front": FRONT}, "up must be a direction other than"),
        ({"up": [1.0, 2.0], "front": FRONT}, r"pairs of points.*got the shape \(2,\)"),
        ({"up": [[0.0, 1.0]], "front": FRONT}, "integers of shape.*dtype float64"),
        ({"up": [[0, 68]], "front": FRONT}, "points 0 to 67; got 0 to 68"),
        ({"left_right": [[-1, 2]], "up": UP}, "points 0 to 67; got -1 to 2"),
        ({"left_right": [0, 16], "up": UP}, r"shape \(n_pairs, 2\).*got shape \(2,\)"),
        ({"left_right": [[3, 3]], "up": UP}, "no direction in common"),
        ({"left_right": [[0, 16], [16, 0]], "up": UP}, "no direction in common"),
        ({"scheme": "dlib"}, r"skeletons are ibug-68, .*; got 'dlib'"),
    ],
)
def test_refuses(face, arguments, message):
    refused(message, canonical_pose, face, **arguments)


def test_refuses_shapes(face):
    message = "'ibug-68' has 68 points, the shape 60"
    refused(message, canonical_pose, face[:60], scheme="ibug-68")
    refused(r"\(n_points, 3\).*got the shape \(68, 2\)", canonical_pose, face[:, :2])
    holes = face.copy()
    holes[3] = np.nan
    refused("with 3 entries that are not", canonical_pose, holes)


NOSE, CROWN = np.array([0.0, 0.0, -1.0]), np.array([0.0, -1.0, 0.0])


def rotation(yaw, pitch, roll):
    """Return a rotation from its definition, right-handed turns about three axes."""
    turns = [("z", roll), ("x", -pitch), ("y", -yaw)]
    R = np.eye(3)
    for axis, angle in turns:
        R = R @ Rotation.from_euler(axis, angle, degrees=True).as_matrix()
    return R


def test_angles_of_their_definition(rng):
    wanted = rng.uniform([-180, -90, -180], [180, 90, 180], (50, 3))
    found = view_angles([rotation(*each) for each in wanted])
    assert_allclose(np.transpose(found), wanted, atol=1e-9)


def test_signs_are_what_a_viewer_sees():
    # The image of a point is the first two coordinates: x to the right, y down.
    assert (rotation(30, 0, 0) @ NOSE)[0] > 0.4  # to the right
    assert (rotation(0, 30, 0) @ NOSE)[1] < -0.4  # up
    assert (rotation(0, 0, 30) @ CROWN)[0] > 0.4  # clockwise
    assert_allclose(np.ravel(view_angles([np.eye(3)])), 0)


def test_frames_without_a_rotation_have_no_angles():
    R = np.stack([rotation(1, 2, 3), np.full((3, 3), np.nan)])
    found = np.transpose(view_angles(R))
    assert_allclose(found[0], [1, 2, 3])
    assert np.isnan(found[1]).all()


@pytest.mark.parametrize(
    ("rotations", "message"),
    [
        (np.eye(3), r"\(n_frames, 3, 3\); got \(3, 3\)"),
        (2 * np.eye(3)[None], "off by 3"),
        (-np.eye(3)[None], "1 are mirror images"),
    ],
)
def test_refused_rotations(rotations, message):
    refused(message, view_angles, rotations)


class TestAngleDeviations:
    def test_of_random_small_turns(self, rng):
        R = Rotation.from_euler("ZXY", [20, -35, 50], degrees=True)
        root = 0.003 * rng.normal(size=(3, 3))
        turns = Rotation.from_rotvec(rng.normal(size=(20000, 3)) @ root.T)
        expected = np.std(np.array(view_angles((R * turns).as_matrix())), axis=1)
        found = angle_deviations(view_angles([R.as_matrix()]), [root @ root.T])
        assert_allclose(np.ravel(found), expected, rtol=0.03)

    def test_refuses_another_number_of_frames(self):
        message, angles = r"\(1, 3, 3\); got \(2, 3, 3\)", view_angles([np.eye(3)])
        refused(message, angle_deviations, angles, np.zeros((2, 3, 3)))
