"""The mirror image in depth, which points decide that the object hides."""

import numpy as np
import pytest
from layers import slow_after
from numpy.testing import assert_allclose, assert_array_equal
from scipy.spatial.transform import Rotation

from isa_nrsfm import AffineNRSfM
from isa_nrsfm._fitted_model import TableModel
from isa_nrsfm._frames.models import Decomposition
from isa_nrsfm._tables import FrameBlocks
from isa_nrsfm.datasets import make_body_tracks, make_face_tracks, make_hand_tracks

KINDS = {
    "affine": {},
    "weak perspective": {"camera": "weak_perspective"},
    "paper": {"refinement": "alternating"},
}


def fits(X, **options):
    """Return the fit with the convention, and that decided by missing points."""
    model = AffineNRSfM(1, hidden_points=False, random_state=0, **options).fit(X)
    assert np.isnan(model.mirror_certainty_)
    return model, AffineNRSfM(1, random_state=0, **options).fit(X)


@pytest.mark.filterwarnings("ignore:PooledFastICA did not converge")
@pytest.mark.parametrize("kind", slow_after(2, KINDS))
@pytest.mark.parametrize("side", slow_after(1, [-1, 1]))
def test_missing_points_are_farther_away(side, kind):
    options = KINDS[kind]
    face = make_face_tracks(60, n_components=1, random_state=0)
    sight = np.cross(face.motion[:, 0], face.motion[:, 1])
    sight /= np.linalg.norm(sight, axis=1, keepdims=True)
    # Points that turn away from the viewer, or towards them in the mirror image.
    missing = side * (face.shapes[..., :2] @ sight[:, :2, None]) > 20.0
    X = np.where(missing, np.nan, face.tracks)[:, ::4].reshape(60, -1)
    convention, model = fits(X, **options)
    assert model.mirror_certainty_ > 0.995
    # The skewness of the depths is right for this face.
    expected = convention if side == 1 else convention.mirrored()
    names = "mean_shape_ basis_ motion_ reference_motion_ mode_covariance_ alpha_"
    for name in names.split():
        atol = 0 if side == 1 else 1e-12
        assert_allclose(getattr(model, name), getattr(expected, name), 0, atol)
    assert_allclose(model.decompose(X).motion, model.motion_, atol=1e-9)
    assert model.mirrored().mirror_certainty_ == 1.0 - model.mirror_certainty_
    if options.get("camera"):
        assert_allclose(np.linalg.det(model.rotations_), 1.0)


SHARES = [(make_face_tracks, 0.6), (make_hand_tracks, 0.2), (make_body_tracks, 0.3)]


@pytest.mark.parametrize(("make", "share"), slow_after(1, SHARES))
def test_points_missing_at_random_change_nothing(make, share):
    convention, model = fits(make(60, missing=share, random_state=1).data)
    assert np.isnan(model.mirror_certainty_)
    for name, value in vars(convention).items():
        if name.endswith("_") and isinstance(value, np.ndarray | float):
            assert_array_equal(getattr(model, name), value)


def profile(rng, depths, turned):
    """Return masks of frames that lose more points in profile, most of one depth."""
    return rng.random(depths.shape) < np.outer(turned, depths.mean(axis=0) > 0)


def event(rng, depths, turned):
    """Return masks of five points that are covered during a part of a video."""
    first, points = rng.integers(150), rng.permutation(25)[:5]
    time = np.arange(len(depths))[:, None] - first
    return (time >= 0) & (time < 50) & np.isin(np.arange(25), points)


@pytest.mark.parametrize("missing", slow_after(1, [profile, event]))
def test_level(missing):
    rng, decided = np.random.default_rng(0), 0
    shape = rng.normal(size=(25, 3))
    shape -= shape.mean(axis=0)
    model = TableModel(None, shape, np.empty((0, 25, 3)), 0, "interleaved", None)
    for _ in range(300):
        waves = np.arange(200)[:, None] * rng.uniform(0.02, 0.09, 2)
        angles = 0.5 * np.sin(waves + rng.uniform(0, 2 * np.pi, 2))
        R = Rotation.from_euler("yx", angles).as_matrix()
        masks = missing(rng, R[:, 2] @ shape.T, np.abs(angles).sum(axis=1))[:, None]
        rows = FrameBlocks.of_array(np.where(masks, np.nan, np.zeros((200, 2, 25))), 90)
        frames = Decomposition(R[:, :2], None, np.zeros((200, 0)), None)
        decided += np.isfinite(model.mirror_certainty(rows, frames))
    assert decided <= 9  # at most 3 %, of a level of 1 %
