import numpy as np
import pytest
from numpy.testing import assert_allclose
from refusals import refused
from scipy.spatial.transform import Rotation

from isa_nrsfm.calibration import view_angles

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
def test_refusals(rotations, message):
    refused(message, view_angles, rotations)
