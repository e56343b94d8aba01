"""The mirror image in depth, which points decide that the object hides."""

import numpy as np
import pytest
from layers import slow_after, start_may_not_converge
from numpy.testing import assert_allclose, assert_array_equal
from scipy.spatial.transform import Rotation

from isa_nrsfm import AffineNRSfM
from isa_nrsfm.datasets import make_body_tracks, make_face_tracks

pytestmark = start_may_not_converge


def fits(X, **options):
    """Return the fit with the convention, and that decided by missing points."""
    model = AffineNRSfM(1, hidden_points=False, random_state=0, **options).fit(X)
    assert np.isnan(model.mirror_certainty_)
    return model, AffineNRSfM(1, random_state=0, **options).fit(X)


@pytest.mark.parametrize(
    ("side", "options"),
    slow_after(
        1,
        [
            (-1, {}),
            (-1, {"camera": "weak_perspective"}),
            (1, {"refinement": "alternating"}),
        ],
    ),
)
def test_missing_points_are_farther_away(side, options):
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


@pytest.mark.parametrize(
    ("make", "share"),
    slow_after(1, [(make_face_tracks, 0.6), (make_body_tracks, 0.3)]),
)
def test_points_missing_at_random_change_nothing(make, share):
    convention, model = fits(make(60, missing=share, random_state=1).data)
    assert np.isnan(model.mirror_certainty_)
    for name, value in vars(convention).items():
        if name.endswith("_") and isinstance(value, np.ndarray | float):
            assert_array_equal(getattr(model, name), value)


def test_points_that_are_covered_during_a_part_of_a_video_decide_nothing(rng):
    shape, time = rng.normal(size=(25, 3)), np.arange(200)[:, None]
    for first in rng.integers(150, size=6):
        waves = time * rng.uniform(0.02, 0.09, 2) + rng.uniform(0, 2 * np.pi, 2)
        turns = Rotation.from_euler("yx", 0.5 * np.sin(waves)).as_matrix()
        covered = np.isin(np.arange(25), rng.permutation(25)[:5])
        hidden = (time >= first) & (time < first + 50) & covered
        images = (shape @ turns.mT)[..., :2]
        X = np.where(hidden[..., None], np.nan, images).reshape(200, -1)
        model = AffineNRSfM(1, refinement=None, random_state=0).fit(X)
        assert np.isnan(model.mirror_certainty_)
