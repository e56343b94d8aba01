"""The mean of joint fits of parts of the points."""

import pytest

from isa_nrsfm import AffineNRSfM
from isa_nrsfm.datasets import make_body_tracks, make_hand_tracks
from isa_nrsfm.metrics import mean_shape_error_3d
from tests.layers import slow_after

MAKE = {"hands": make_hand_tracks, "bodies": make_body_tracks}

pytestmark = pytest.mark.filterwarnings("ignore:the depth of the shapes")


def shape_error(tracks, **settings):
    """Return the error of the shapes of the fit of tracks."""
    model = AffineNRSfM(3, camera="weak_perspective", random_state=0)
    model._continued = settings
    model.fit(tracks.data)
    shapes = model.reconstruct(tracks.data)
    return mean_shape_error_3d(tracks.shapes, shapes, convention="frame")


# Bodies of seeds 1 and 3 may deform instead of turning: no mean is taken.
TABLES = [("hands", 0, 40), ("hands", 1, 200), ("bodies", 2, 200)]


@pytest.mark.parametrize(("kind", "seed", "n_frames"), slow_after(1, TABLES))
def test_the_mean_is_nearer_to_the_truth_than_the_joint_fit(kind, seed, n_frames):
    tracks = MAKE[kind](n_frames, random_state=seed)
    assert shape_error(tracks) < shape_error(tracks, errors=False)


def test_few_points_have_the_joint_fit_itself():
    tracks = make_hand_tracks(30, random_state=0)
    tracks.data, tracks.shapes = tracks.data[:, :16], tracks.shapes[:, :8]
    assert shape_error(tracks) == shape_error(tracks, errors=False)
