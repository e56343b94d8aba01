"""Settings that held-out points prefer, and advice that ends."""

import pickle
import re
import warnings

import numpy as np
import pandas as pd
import pytest
from fit_runs import QUICK
from landmark_files import deeplabcut_frame, saved, write_deeplabcut
from layers import may_not_converge
from refusals import refusals_of
from scenes import table_of, with_outliers
from sklearn.base import clone
from sklearn.pipeline import make_pipeline
from sklearn.preprocessing import FunctionTransformer

from isa_nrsfm import AffineNRSfM, AutoNRSfM, FastISA
from isa_nrsfm.analysis import association
from isa_nrsfm.datasets import (
    make_body_tracks,
    make_face_tracks,
    make_nonrigid_tracks,
)
from isa_nrsfm.export import write_viewer

pytestmark = may_not_converge


def frontal():
    """Return faces that do not turn."""
    faces = make_face_tracks(60, n_components=3, random_state=0)
    return faces.shapes[..., :2].reshape(60, -1)


GIVEN = {"n_components": 2, "random_state": 0}


def points(*size, **options):
    """Return a table of points, by default of two basis shapes."""
    return make_nonrigid_tracks(*size, **GIVEN | options).data


ORTHOGRAPHIC, WEAK = {"camera": "orthographic"}, {"camera": "weak_perspective"}
TABLES = {
    "one scale": lambda: points(40, 16, noise=0.02, **ORTHOGRAPHIC),
    "stretched": lambda: points(60, 16, noise=0.005, **WEAK) * np.tile([1, 0.5], 16),
    "few frames": lambda: points(14, 24, noise=0.02),
    "outliers": lambda: with_outliers(points(40, 14), points(40, 14).std(), 0.02),
    "bodies": lambda: make_body_tracks(80, random_state=0).data,
    "few shapes": lambda: points(60, 14, n_components=1, noise=0.05, **WEAK),
}


def fitted(estimator, X):
    """Return a fitted estimator, its messages and its error of held-out points."""
    with warnings.catch_warnings(record=True, action="always") as caught:
        estimator.fit(X)
    model = getattr(estimator, "best_estimator_", estimator)
    found = model.diagnostics(X)
    texts = [str(each.message) for each in caught]
    return model, [*found.messages, *texts], found


@pytest.mark.slow
@pytest.mark.parametrize("name", TABLES)
def test_advice_ends_after_one_more_fit_which_is_not_worse(name):
    X = TABLES[name]()
    model, messages, before = fitted(AffineNRSfM(random_state=0), X)
    text = " | ".join(messages)
    if "AutoNRSfM" in text:
        start = AffineNRSfM(random_state=0, remove_pose="remove_pose" in text)
        model, messages, after = fitted(AutoNRSfM(start), X)
    elif "remove_pose=True" in text:
        model, messages, after = fitted(clone(model).set_params(remove_pose=True), X)
    else:
        return
    text = " | ".join(messages)
    assert "AutoNRSfM().fit(X) compares" not in text
    assert not re.search("(camera|loss|refinement|prior|n_components|pose)=", text)
    if model.loss == before.fit == "linear" and model.prior is None:
        assert after.held_out_error <= 1.001 * before.held_out_error


def tried(X, **options):
    """Return the trials by their settings, and the fit."""
    auto = AutoNRSfM(AffineNRSfM(random_state=0), **options)
    with warnings.catch_warnings(action="ignore"):
        auto.fit(X)
    return {each.setting: each for each in auto.trials_}, auto.best_estimator_


def test_one_scale_is_found():
    found, model = tried(TABLES["one scale"]())
    results = {name: trial.result for name, trial in found.items()}
    assert results == {
        "weak perspective cameras": "less good",
        "affine": "not stretched",
        "consensus": "the depth is known",
        "perspective": "image size not known",
        "face prior": "no layout of faces",
        "robust loss": "no outliers",
        "orthographic": "used",
    }
    assert (model.camera, model.loss) == ("orthographic", "linear")
    errors = {name: trial.held_out_error for name, trial in found.items()}
    assert errors["orthographic"] < errors["weak perspective cameras"]


def test_faces_that_do_not_turn_have_the_prior():
    found, model = tried(frontal()[::3], loss="linear")
    assert found["face prior"].result == "used"
    assert (model.n_components, len(model.prior.basis_)) == (9, 9)
    # Without a first fit, which takes ten times as long
    first = found["weak perspective cameras"]
    assert first.result == "a rough fit does not determine the depth"
    assert first.seconds == 0


SETTINGS = {"camera": "affine", "refinement": "joint", "n_components": 2}


@pytest.mark.slow
@pytest.mark.parametrize(
    ("name", "given", "setting", "found"),
    [
        ("outliers", SETTINGS, "robust loss", {"loss": "cauchy"}),
        ("stretched", {"loss": "linear"}, "affine", {"camera": "affine"}),
    ],
)
def test_other_settings_are_used_where_needed(name, given, setting, found):
    trials, model = tried(TABLES[name](), **given)
    assert trials[setting].result == "used"
    assert {name: getattr(model, name) for name in found} == found


@pytest.mark.slow
def test_faces_that_turn_have_no_prior_and_perspective_needs_the_size_of_images():
    faces = make_face_tracks(60, camera="perspective", **GIVEN)
    found, model = tried(faces.data, image_size=2 * np.array(faces.principal_point))
    assert (found["perspective"].result, model.camera) == ("used", "perspective")
    assert found["face prior"].result == "the depth is known"
    assert model.prior is None


def test_given_settings_are_kept():
    given = {"camera": "affine", "loss": "huber", "n_components": 1}
    X = points(24, 12, noise=0.01)
    found, model = tried(X, **given, refinement="joint", prior=None)
    assert len(found) == 1
    assert {name: getattr(model, name) for name in given} == given


def test_is_an_estimator_of_scikit_learn_without_comparisons_if_nothing_is_refined():
    X = points(24, 16, noise=0.01)
    auto = AutoNRSfM(AffineNRSfM(random_state=0), refinement=None)
    pipeline = make_pipeline(FunctionTransformer(), clone(auto))
    alpha = pipeline.fit_transform(X)
    again = pickle.loads(pickle.dumps(pipeline))[-1]
    np.testing.assert_array_equal(again.transform(X), alpha)
    assert alpha.shape == (24, again.n_components_) == (24, 3)
    assert again.get_feature_names_out()[0] == "alpha_1"
    assert again.score(X) == again.best_estimator_.score(X)
    assert (again.best_estimator_.camera, len(again.trials_)) == ("affine", 1)


def arena(n_still, jitter=0.7):
    """Return tracks (150, 15 + n_still, 2) of a body that walks between points."""
    rng = np.random.default_rng(0)
    body = make_nonrigid_tracks(150, 15, noise=0.01, **GIVEN).data.reshape(150, 15, 2)
    body = 40 * body + 300 + 12 * rng.normal(size=(150, 1, 2)).cumsum(axis=0)
    places, moves = (
        rng.uniform(50, 600, (n_still, 2)),
        rng.normal(size=(150, n_still, 2)),
    )
    return np.concatenate([body, places + jitter * moves], axis=1)


def in_place():
    """Return tracks of an object that stays in place, of which three points do."""
    tracks = arena(0) - arena(0).mean(axis=1, keepdims=True)
    tracks[:, :3] = tracks[:1, :3]
    return tracks


def fit(tracks):
    """Fit tracks in one step."""
    options = {"isa": FastISA(n_init=1), "refinement": None, "random_state": 0}
    return AffineNRSfM(1, **options).fit(table_of(tracks))


def associated(time, groups=None):
    """Return the association of a walk with another one, in time."""
    alpha, y = np.random.default_rng(0).normal(size=(2, 100)).cumsum(axis=1)
    options = {"n_permutations": 99, "random_state": 0}
    return association(alpha[:, None], y, groups, time=time, **options)


ONE_RUN = np.zeros(100)
IRREGULAR = np.random.default_rng(0).random(100).cumsum() ** 3
# Of frames in another order
GAPS, RUNS = np.r_[80.0:100.0, 0.0:30.0, 50.0:100.0], np.repeat([1, 0, 1], [20, 30, 50])
GAPS[50:] += 50.0

ROUGH = [*QUICK, "1"]


def named(X):
    """Return a table whose columns have names."""
    names = [f"{axis}_{j}" for j in range(len(X.T) // 2) for axis in "xy"]
    return pd.DataFrame(X, columns=names)


def two_views(folder):
    """Write a table of a tracker with two views in a row."""
    parts = [f"{part}_{view}" for view in ("top", "side") for part in "abcdefgh"]
    tracks = make_nonrigid_tracks(20, 16, **GIVEN).tracks
    table = deeplabcut_frame(tracks, 1.0, bodyparts=parts)
    return write_deeplabcut(folder / "mouse.csv", table)


def test_the_command_line_leaves_them_out(fits, begins, tmp_path):
    scores = {f"likelihood_{j}": 0.5 if j < 2 else 1 for j in range(19)}
    table = named(arena(4).reshape(150, -1)).assign(**scores)
    path = saved(tmp_path / "maze.csv", table)
    told = "points stand still while the others move through the image"
    assert told not in begins(path, "--points", "0-18")
    found = fits(path, *ROUGH)
    assert f"4 {told}" in found.err
    assert found.err.count("have a confidence below 0.6") == 1
    assert len(found.model.mean_shape_) == 15


@pytest.mark.parametrize(("options", "expected"), [([], 3), (["--keep-zeros"], 0)])
def test_zeros_to_one_side_of_all_points_are_missing(fits, tmp_path, options, expected):
    X = points(40, 16, noise=0.01)
    X += 0.1 - X.min()  # nearer to (0, 0) than points are spread
    X[[3, 8, 20], 4:6] = 0.0
    found = fits(saved(tmp_path / "a.csv", named(X)), *ROUGH, *options)
    assert found.report["table"]["n_missing_points"] == expected


def test_pages_are_shown_in_notebooks(tmp_path):
    model = fit(points(20, 12).reshape(20, 12, 2))
    page = write_viewer(model, tmp_path / "a.html")
    assert page == (tmp_path / "a.html").read_text(encoding="utf-8")
    assert page._repr_html_().startswith("<iframe srcdoc=")
    assert "<script" not in page._repr_html_()
    assert len(repr(page)) < 50


test_refusals = refusals_of("decision", globals())
