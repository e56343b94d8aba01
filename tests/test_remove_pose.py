"""Coefficients without what the yaw of the cameras predicts."""

import re

import numpy as np
import pytest
from layers import Quick
from numpy.testing import assert_allclose
from refusals import refusals_of

from isa_nrsfm import AffineNRSfM
from isa_nrsfm.datasets import make_face_tracks
from isa_nrsfm.export import point_distances
from isa_nrsfm.io import load_model, save_model

CALIBRATED = {"camera": "weak_perspective", "random_state": 0}


def faces(n_frames=60, seed=0):
    """Return a table of faces, and coefficients that its points do not follow.

    They move along the first basis shape by the coefficient, and slide by the yaw.
    """
    options = {"noise": 0.01, "camera": "weak_perspective", "random_state": seed}
    true = make_face_tracks(n_frames, n_components=2, **options)
    yaw = true.motion[:, 0, 2] / np.linalg.norm(true.motion[:, 0], axis=1)
    tracks = true.tracks + 4.0 * yaw[:, None, None] * (true.basis[0] @ true.motion.mT)
    return tracks[:, 17:].reshape(n_frames, -1), true.alpha


@pytest.fixture(scope="module")
def table():
    return faces()[0]


@pytest.fixture(scope="module")
def plain(table):
    return AffineNRSfM(2, **CALIBRATED).fit(table)


@pytest.fixture(scope="module")
def model(table):
    return AffineNRSfM(2, remove_pose=True, **CALIBRATED).fit(table)


def yaw_terms(model):
    """Return 1, sin yaw and its square for each fitted frame."""
    s = model.rotations_[:, 2, 0]
    return np.stack([np.ones_like(s), s, s**2], axis=1)


def test_what_is_left_has_no_relation_to_the_yaw(model, plain, table):
    terms = yaw_terms(model)
    left = np.linalg.lstsq(terms, model.alpha_)[0]
    assert_allclose(left, 0.0, atol=1e-6)  # also the mean
    assert_allclose(model.alpha_.std(axis=0), 1.0, atol=1e-6)
    before = model.alpha_ + terms @ model.pose_effect_
    assert_allclose(before, model.decompose(table).alpha, atol=1e-4)
    # The true coefficients, without the yaw that was added.
    true = faces()[1]
    fits = (np.corrcoef(each.alpha_.T, true.T)[:2, 2:] for each in (model, plain))
    found, without = (np.abs(fit).max(axis=0).min() for fit in fits)
    assert found > 0.95
    assert without < 0.75


def test_shapes_cameras_and_score_do_not_change(model, plain, table):
    fit = model.decompose(table)
    for name in ("mean_shape_", "motion_", "translation_"):
        assert_allclose(getattr(model, name), getattr(plain, name), atol=1e-8)
    assert_allclose(model.reconstruct(table), plain.reconstruct(table), atol=1e-4)
    assert_allclose(model.reproject(table), plain.reproject(table), atol=1e-2)
    assert model.score(table) == pytest.approx(plain.score(table), rel=1e-4)
    np.testing.assert_array_equal(model.reconstruct(fit), model.shapes(fit.alpha))
    known, alone = (
        point_distances(model, [(0, 4)], X, unit=(19, 28)) for X in (fit, None)
    )
    assert_allclose(alone, known, atol=1e-4)


def test_new_frames_lose_what_the_fit_has_found(model):
    new, _ = faces(40, seed=5)
    fit = model.decompose(new)
    rows = fit.motion / np.linalg.norm(fit.motion, axis=2, keepdims=True)
    s = np.cross(rows[:, 0], rows[:, 1])[:, 0]
    part = model.pose_effect_.T @ [np.ones_like(s), s, s**2]
    found = model.transform(new)
    assert_allclose(found, fit.alpha - part.T, atol=1e-8)
    assert_allclose(found[7:8], model.transform(new[7:8]), atol=1e-9)
    new[3] = np.nan
    assert np.isnan(model.transform(new)[3]).all()


def test_all_results_have_the_same_coefficients(model, table, tmp_path):
    alpha = model.alpha_
    assert_allclose(model.transform(table), alpha, atol=1e-5)
    save_model(model, tmp_path / "model.npz")
    loaded = load_model(tmp_path / "model.npz")
    for other in (model.mirrored(), loaded, loaded.mirrored()):
        assert_allclose(other.transform(table), model.transform(table), atol=1e-9)
    photos = table[:30]  # in any order: as they are
    smooth, fit = model.smooth(photos), model.decompose(photos)
    assert_allclose(smooth.alpha, model.transform(photos), atol=1e-9)
    assert_allclose(smooth.decomposition.alpha, fit.alpha, atol=1e-9)
    options = CALIBRATED | {"keep_frames": False, "refinement": None}
    single, X = AffineNRSfM(2, remove_pose=True, **options), table.astype("f4")
    found = single.fit_transform(X)
    assert_allclose(found, single.transform(X), atol=1e-4)
    assert np.abs(found - single.decompose(X).alpha).max() > 0.1
    assert found.dtype == single.transform(X).dtype == "f4"
    # A new fit without the option forgets it.
    assert not hasattr(single.set_params(remove_pose=False).fit(X), "pose_effect_")


@pytest.mark.slow
def test_a_prior_keeps_its_origin(plain):
    new, _ = faces(30, seed=5)
    fit = AffineNRSfM("auto", prior=plain, **CALIBRATED)
    mean = fit.fit_transform(new).mean(axis=0)
    assert np.abs(mean).max() > 0.05
    left = fit.set_params(remove_pose=True).fit_transform(new)
    assert_allclose(left.mean(axis=0), mean, atol=1e-9)


def test_what_would_not_be_removed_is_not_advised(table):
    # Yaw is pitch.
    turned = table.reshape(60, -1, 2)[:, ::4, ::-1].reshape(60, -1)
    found = Quick(2, **CALIBRATED, tol=1e3).fit(turned).diagnostics()
    assert found.pose_share.max() > 0.3
    assert found.messages[-1].endswith("compare coefficients of similar views only")


def test_diagnostics_say_what_was_removed_and_what_is_left(model, plain):
    before, after = plain.diagnostics(), model.diagnostics()
    assert before.pose_share.max() > 0.3
    assert not before.pose_removed.any()
    message = "the pose predicts .* alike in all views, use remove_pose=True"
    assert re.search(message, before.messages[-1])
    assert after.pose_share.max() < 0.3
    assert after.messages == ()
    before = model.alpha_ + yaw_terms(model) @ model.pose_effect_
    share = 1 - model.alpha_.var(axis=0) / before.var(axis=0)
    assert_allclose(after.pose_removed, share, atol=1e-9)
    assert "removed" in repr(after)
    assert "removed" not in repr(before)


test_refusals = refusals_of("remove_pose", globals())
