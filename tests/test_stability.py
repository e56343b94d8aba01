"""Stability of coefficients: halves of a table, and what is said of them."""

import numpy as np
import pytest
from layers import slow_after
from made_once import made_once
from numpy.testing import assert_array_equal
from refusals import refused

from isa_nrsfm import AffineNRSfM
from isa_nrsfm.datasets import make_face_tracks
from isa_nrsfm.io import load_model, save_model


def faces(noise=0.01, n_frames=120):
    return make_face_tracks(n_frames, n_components=3, noise=noise, random_state=0).data


@made_once
def fitted(camera="affine", independence="shapes"):
    params = {"camera": camera, "independence": independence, "random_state": 0}
    return AffineNRSfM(3, **params).fit(faces())


FITS = [("affine", "shapes"), ("affine", None), ("weak_perspective", "shapes")]


@pytest.mark.parametrize(("camera", "independence"), slow_after(2, FITS))
def test_clear_coefficients_are_stable(camera, independence):
    model = fitted(camera, independence)
    assert model.stability_.shape == (3,)
    assert (model.stability_ <= 1 + 1e-12).all()
    if independence:
        assert (model.stability_ > 0.9).all()
        assert model.diagnostics().stability == ("stable",) * 3
        assert_array_equal(model.stable_sets_, np.eye(3, dtype=bool))


def test_what_noise_decides_is_less_stable():
    noisy = AffineNRSfM(3, random_state=0).fit(faces(0.08, 60))
    assert noisy.stability_.min() < fitted().stability_.min() - 0.02


@pytest.mark.slow
def test_groups_jobs_and_files(tmp_path):
    table, groups = faces(), np.repeat(np.arange(40), 3)
    model = AffineNRSfM(3, random_state=0).fit(table, groups=groups)
    again = AffineNRSfM(3, random_state=0, n_jobs=2).fit(table, groups=groups)
    assert_array_equal(model.stability_, again.stability_)
    rows = fitted()
    assert (rows.stability_ != model.stability_).any()
    save_model(rows, tmp_path / "model.npz")
    loaded = load_model(tmp_path / "model.npz")
    for name in ("stability_", "stable_sets_"):
        assert_array_equal(getattr(loaded, name), getattr(rows, name))
    few = AffineNRSfM(3, random_state=0).fit(table, groups=groups // 20)
    assert np.isnan(few.stability_).all()
    assert few.diagnostics().stability == ("",) * 3
    refused("groups must have one entry", model.fit, table, groups=groups[1:])


def test_only_joint_fits_have_it():
    assert not hasattr(AffineNRSfM(), "stability_")
    model = AffineNRSfM(2, refinement="alternating", random_state=0).fit(faces())
    with pytest.raises(AttributeError, match="need a joint fit without a prior"):
        _ = model.stability_
