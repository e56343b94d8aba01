"""Settings that held-out points prefer, and advice that ends."""

import pickle
import re
import warnings

import numpy as np
import pytest
from layers import slow_after
from sklearn.base import clone
from sklearn.pipeline import make_pipeline
from sklearn.preprocessing import FunctionTransformer

from isa_nrsfm import AffineNRSfM, AutoNRSfM
from isa_nrsfm._decision import FIRST, first_settings
from isa_nrsfm.analysis._advice import COMPARE
from isa_nrsfm.datasets import (
    load_face_prior,
    make_body_tracks,
    make_face_tracks,
    make_nonrigid_tracks,
)


def with_outliers(X):
    """Return a table with a wrong point in every tenth number."""
    rng = np.random.default_rng(0)
    wrong = rng.random((len(X), X.shape[1] // 2)) < 0.01
    return X + np.repeat(wrong, 2, axis=1) * X.std() * rng.normal(size=X.shape)


def frontal():
    """Return faces that do not turn."""
    faces = make_face_tracks(60, n_components=3, random_state=0)
    return faces.shapes[..., :2].reshape(60, -1)


def walks():
    """Return points that are no body."""
    rng = np.random.default_rng(0)
    return 300 + rng.normal(size=(80, 16, 2)).cumsum(axis=0).reshape(80, -1)


GIVEN = {"n_components": 2, "random_state": 0}
TABLES = {
    "bodies": lambda: make_body_tracks(80, random_state=0).data,
    "outliers": lambda: with_outliers(make_nonrigid_tracks(80, 20, **GIVEN).data),
    "frontal faces": frontal,
    "walks": walks,
    "one scale": lambda: (
        make_nonrigid_tracks(60, 16, noise=0.02, camera="orthographic", **GIVEN).data
    ),
    "stretched": lambda: (
        make_nonrigid_tracks(
            60, 16, noise=0.005, camera="weak_perspective", **GIVEN
        ).data
        * np.tile([1.0, 0.5], 16)
    ),
    "few frames": lambda: make_nonrigid_tracks(14, 24, noise=0.02, **GIVEN).data,
}


def fitted(estimator, X):
    """Return a fitted estimator, its messages and its error of held-out points."""
    with warnings.catch_warnings(record=True, action="always") as caught:
        estimator.fit(X)
    model = getattr(estimator, "best_estimator_", estimator)
    found = model.diagnostics(X)
    texts = [str(each.message) for each in caught]
    return model, [*found.messages, *texts], found


@pytest.mark.parametrize("name", slow_after(4, [*TABLES]))
def test_advice_ends_after_one_more_fit_which_is_not_worse(name):
    X = TABLES[name]()
    model, messages, before = fitted(AffineNRSfM(random_state=0), X)
    text = " | ".join(messages)
    if "AutoNRSfM" in text:
        start = AffineNRSfM(random_state=0, remove_pose="remove_pose" in text)
        model, messages, after = fitted(AutoNRSfM(start), X)
    elif advised := re.findall('(remove_pose=True|n_components="auto")', text):
        values = dict(each.split("=") for each in advised)
        options = {name: eval(value) for name, value in values.items()}
        model, messages, after = fitted(clone(model).set_params(**options), X)
    else:
        return
    text = " | ".join(messages)
    assert COMPARE not in text
    assert not re.search("(camera|loss|refinement|prior|n_components|pose)=", text)
    if model.loss == before.fit == "linear" and model.prior is None:
        assert after.held_out_error <= 1.001 * before.held_out_error


def tried(X, **options):
    """Return the trials by their settings, and the fit."""
    start = AffineNRSfM(random_state=0)
    auto = AutoNRSfM(start, **options)
    with warnings.catch_warnings(action="ignore"):
        auto.fit(X)
    return {each.setting: each for each in auto.trials_}, auto.best_estimator_


def test_robust_losses_are_tried_if_there_are_outliers():
    found, model = tried(TABLES["outliers"]())
    assert (found["robust loss"].result, model.loss) == ("used", "cauchy")
    found, model = tried(make_nonrigid_tracks(60, 20, **GIVEN).data)
    assert (found["robust loss"].result, model.loss) == ("no outliers", "linear")
    assert np.isnan(found["robust loss"].held_out_error)


def test_faces_that_do_not_turn_have_the_prior():
    found, model = tried(frontal())
    assert found["face prior"].result == "used"
    assert (model.n_components, len(model.prior.basis_)) == (9, 9)
    assert found["weak perspective cameras"].depth_uncertainty > 0.55
    found, model = tried(frontal(), prior=None)
    assert "face prior" not in found
    assert model.prior is None


def test_one_scale_is_found():
    found, model = tried(TABLES["one scale"]())
    one, many = found["orthographic"], found["weak perspective cameras"]
    assert one.held_out_error < many.held_out_error
    assert (model.camera, one.result, many.result) == (
        "orthographic",
        "used",
        "less good",
    )


@pytest.mark.slow
def test_perspective_needs_the_size_of_images():
    faces = make_face_tracks(60, camera="perspective", **GIVEN)
    found, model = tried(faces.data, image_size=2 * np.array(faces.principal_point))
    assert (found["perspective"].result, model.camera) == ("used", "perspective")
    found, model = tried(faces.data)
    assert found["perspective"].result == "image size not known"


def test_given_settings_are_kept():
    X = make_nonrigid_tracks(60, 20, **GIVEN).data
    given = {"camera": "affine", "loss": "huber", "n_components": 1}
    found, model = tried(X, **given, refinement="joint", prior=None)
    assert len(found) == 1
    assert {name: getattr(model, name) for name in given} == given
    params, free = first_settings({"refinement": None})
    assert (params["camera"], params["n_components"], free) == ("affine", 3, set())
    prior = load_face_prior(3)
    params, free = first_settings({"prior": prior})
    assert (params["camera"], free) == ("weak_perspective", {"loss", "n_components"})
    assert first_settings({}) == (FIRST, {*FIRST})


def test_is_an_estimator_of_scikit_learn():
    X = make_nonrigid_tracks(40, 16, noise=0.01, **GIVEN).data
    auto = AutoNRSfM(AffineNRSfM(random_state=0), loss="linear")
    pipeline = make_pipeline(FunctionTransformer(), clone(auto))
    alpha = pipeline.fit_transform(X)
    again = pickle.loads(pickle.dumps(pipeline))[-1]
    np.testing.assert_array_equal(again.transform(X), alpha)
    assert alpha.shape == (40, again.n_components_)
    assert again.get_feature_names_out()[0] == "alpha_1"
    assert again.score(X) == again.best_estimator_.score(X)
    assert again.get_params()["loss"] == "linear"
