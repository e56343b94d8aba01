"""Settings that held-out points prefer, and advice that ends."""

import pickle
import re
import warnings
from types import SimpleNamespace

import numpy as np
import pandas as pd
import pytest
from fit_runs import QUICK
from landmark_files import deeplabcut_frame, saved, write_deeplabcut
from layers import with_limits
from refusals import refusals_of
from scenes import with_outliers
from sklearn.base import clone
from sklearn.pipeline import make_pipeline
from sklearn.preprocessing import FunctionTransformer

from isa_nrsfm import AffineNRSfM, AutoNRSfM
from isa_nrsfm._frames.models import DepthCertainty
from isa_nrsfm._prepare.coordinates import still_points  # noqa: F401
from isa_nrsfm._selection import FIRST, PROPOSALS, first_settings  # noqa: F401
from isa_nrsfm.analysis._advice import COMPARE
from isa_nrsfm.analysis._frame_columns import runs_between_gaps  # noqa: F401
from isa_nrsfm.datasets import (
    load_face_prior,  # noqa: F401
    make_body_tracks,
    make_face_tracks,
    make_nonrigid_tracks,
)
from isa_nrsfm.export import write_viewer


def frontal():
    """Return faces that do not turn."""
    faces = make_face_tracks(60, n_components=3, random_state=0)
    return faces.shapes[..., :2].reshape(60, -1)


def walks():
    """Return points that are no body."""
    rng = np.random.default_rng(0)
    return 300 + rng.normal(size=(80, 16, 2)).cumsum(axis=0).reshape(80, -1)


GIVEN = {"n_components": 2, "random_state": 0}


def points(*size, **options):
    """Return a table of points, by default of two basis shapes."""
    return make_nonrigid_tracks(*size, **GIVEN | options).data


ORTHOGRAPHIC, WEAK = {"camera": "orthographic"}, {"camera": "weak_perspective"}
TABLES = {
    "one scale": lambda: points(60, 16, noise=0.02, **ORTHOGRAPHIC),
    "walks": walks,
    "stretched": lambda: points(60, 16, noise=0.005, **WEAK) * np.tile([1, 0.5], 16),
    "few frames": lambda: points(14, 24, noise=0.02),
    "outliers": lambda: with_outliers(points(40, 14), points(40, 14).std(), 0.02),
    "bodies": lambda: make_body_tracks(80, random_state=0).data,
    "frontal faces": frontal,
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


@pytest.mark.slow
def test_robust_losses_are_tried_if_there_are_outliers():
    given = {"camera": "affine", "refinement": "joint", "n_components": 2}
    found, model = tried(TABLES["outliers"](), **given)
    assert (found["robust loss"].result, model.loss) == ("used", "cauchy")


def test_faces_that_do_not_turn_have_the_prior():
    found, model = tried(frontal()[::2], loss="linear")
    assert found["face prior"].result == "used"
    assert (model.n_components, len(model.prior.basis_)) == (9, 9)
    # Without a first fit, which takes ten times as long
    first = found["weak perspective cameras"]
    assert first.result == "a rough fit does not determine the depth"
    assert first.seconds == 0


@pytest.mark.slow
def test_the_mean_image_of_a_face_does_not_make_a_table_one_of_faces():
    rng, face = np.random.default_rng(0), frontal().mean(axis=0)
    X = face + 0.6 * face.std() * rng.normal(size=(60, len(face)))
    found, model = tried(X, loss="linear")
    assert found["weak perspective cameras"].held_out_error > 0
    told = "the table does not show the points of the prior"
    assert told in found["face prior"].result
    assert model.prior is None


def test_faces_that_turn_have_no_prior():
    faces = make_face_tracks(40, n_components=1, random_state=0)
    found, model = tried(faces.data, loss="linear", refinement="joint")
    assert found["face prior"].result == "the depth is known"
    assert model.prior is None


def test_one_scale_is_found():
    found, model = tried(TABLES["one scale"]())
    one, many = found["orthographic"], found["weak perspective cameras"]
    assert one.held_out_error < many.held_out_error
    results = model.camera, one.result, many.result
    assert results == ("orthographic", "used", "less good")
    no_outliers = found["robust loss"]
    assert (no_outliers.result, model.loss) == ("no outliers", "linear")
    assert np.isnan(no_outliers.held_out_error)


@pytest.mark.slow
def test_one_scale_is_found_from_a_sample():
    X = points(80, 16, noise=0.02, **ORTHOGRAPHIC)
    sampled = with_limits(sample=40, small_table=1000)
    auto = AutoNRSfM(sampled(random_state=0), loss="linear").fit(X)
    assert auto.best_estimator_.camera == "orthographic"
    assert auto.best_estimator_._continued is None


@pytest.mark.slow
def test_perspective_needs_the_size_of_images():
    faces = make_face_tracks(60, camera="perspective", **GIVEN)
    found, model = tried(faces.data, image_size=2 * np.array(faces.principal_point))
    assert (found["perspective"].result, model.camera) == ("used", "perspective")
    found, model = tried(faces.data)
    assert found["perspective"].result == "image size not known"


def proposed(words, model, rows=None):
    """Return what a proposal, in its words, makes of a fit."""
    (proposal,) = (each for _, name, each in PROPOSALS if name == words)
    return proposal(SimpleNamespace(model=model), rows)


def test_perspective_is_tried_with_a_longer_lens_than_most():
    """The focal length of a rough fit is 2.5 times the longer side of the images."""
    model = AffineNRSfM(3, refinement="consensus")
    model.basis_, point = np.ones((3, 9, 3)), np.array([640, 360])

    def rough(params):
        sees = AffineNRSfM(**params).focal_length == 2.5 * 1280
        return SimpleNamespace(camera_="perspective" if sees else "weak_perspective")

    rows = SimpleNamespace(principal_point=point, rough=rough)
    expected = {"camera": "perspective", "principal_point": (640.0, 360.0)}
    assert proposed("perspective", model, rows) == expected


@pytest.mark.parametrize(("error", "prior"), [(0.3, None), (0.5, None), (0.5, "any")])
def test_doubtful_depths_have_groups_tried(error, prior):
    model = AffineNRSfM(camera="weak_perspective", prior=prior)
    certainty, model.camera_ = DepthCertainty(total=error), model.camera
    model._model = SimpleNamespace(frames=SimpleNamespace(certainty=certainty))
    rows = SimpleNamespace(weights=None, own_rotations=lambda model: 0.0)
    found = proposed("consensus", model, rows)
    known = error < 0.4 or prior is not None
    assert found == ("the depth is known" if known else {"refinement": "consensus"})


def test_given_settings_are_kept():
    X = points(60, 20)
    given = {"camera": "affine", "loss": "huber", "n_components": 1}
    found, model = tried(X, **given, refinement="joint", prior=None)
    assert len(found) == 1
    assert {name: getattr(model, name) for name in given} == given


def test_is_an_estimator_of_scikit_learn():
    X = points(40, 16, noise=0.01)
    auto = AutoNRSfM(AffineNRSfM(random_state=0), loss="linear")
    pipeline = make_pipeline(FunctionTransformer(), clone(auto))
    alpha = pipeline.fit_transform(X)
    again = pickle.loads(pickle.dumps(pipeline))[-1]
    np.testing.assert_array_equal(again.transform(X), alpha)
    assert alpha.shape == (40, again.n_components_)
    assert again.get_feature_names_out()[0] == "alpha_1"
    assert again.score(X) == again.best_estimator_.score(X)
    assert again.get_params()["loss"] == "linear"


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


ROUGH = [*QUICK, "1"]


def named(X):
    """Return a table whose columns have names."""
    return pd.DataFrame(
        X, columns=[f"{a}_{j}" for j in range(len(X.T) // 2) for a in "xy"]
    )


def test_the_command_line_leaves_them_out(fits, tmp_path):
    scores = {f"likelihood_{j}": 0.5 if j < 2 else 1 for j in range(19)}
    table = named(arena(4).reshape(150, -1)).assign(**scores)
    path = saved(tmp_path / "maze.csv", table)
    found = fits(path, *ROUGH)
    assert "4 points stand still while the others move through the image" in found.err
    assert found.err.count("have a confidence below 0.6") == 1
    assert len(found.model.mean_shape_) == 15
    found = fits(path, *ROUGH, "--points", "0-18", "--force")
    assert len(found.model.mean_shape_) == 19


def test_two_views_in_a_row_of_a_tracker_are_asked_about(fits, fails, tmp_path):
    parts = [f"{part}_{view}" for view in ("top", "side") for part in "abcdefgh"]
    tracks = make_nonrigid_tracks(40, 16, **GIVEN).tracks
    table = deeplabcut_frame(tracks, 1.0, bodyparts=parts)
    path = write_deeplabcut(tmp_path / "mouse.csv", table)
    message = fails("fit", path, "-o", tmp_path / "out", *ROUGH)
    assert "the 16 points have the same names but for top, side, as those" in message
    one, both = re.findall("use --points ([0-9-]+)|with --points ([a-z_,]+)", message)
    for text, n_points in ((one[1], 8), (both[0], 16)):
        found = fits(path, *ROUGH, "--points", text, "--force")
        assert len(found.model.mean_shape_) == n_points


@pytest.mark.parametrize(("options", "expected"), [([], 3), (["--keep-zeros"], 0)])
def test_zeros_to_one_side_of_all_points_are_missing(fits, tmp_path, options, expected):
    X = points(40, 16, noise=0.01)
    X += 0.1 - X.min()  # nearer to (0, 0) than points are spread
    X[[3, 8, 20], 4:6] = 0.0
    found = fits(saved(tmp_path / "a.csv", named(X)), *ROUGH, *options)
    assert found.report["table"]["n_missing_points"] == expected


def test_pages_are_shown_in_notebooks(tmp_path):
    X = points(30, 16, noise=0.01)
    model = AffineNRSfM(2, camera="weak_perspective", random_state=0).fit(X)
    page = write_viewer(model, tmp_path / "a.html")
    assert page == (tmp_path / "a.html").read_text(encoding="utf-8")
    assert page._repr_html_().startswith("<iframe srcdoc=")
    assert "<script" not in page._repr_html_()
    assert len(repr(page)) < 50


test_refusals = refusals_of("decision", globals())
