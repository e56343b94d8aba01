"""A fitted model as the prior of another table, and tables that do not fit a model."""

import copy
import pickle
import warnings
from types import SimpleNamespace

import numpy as np
import pytest
from frame_parts import depth_errors
from layers import slow_after
from made_once import made_once
from numpy.testing import assert_allclose, assert_array_equal
from refusals import refusals_of, refused, warned
from scenes import table_of, tracks_of, with_gaps, with_outliers
from scipy.spatial.transform import Rotation
from sklearn.base import clone
from sklearn.frozen import FrozenEstimator
from sklearn.model_selection import GridSearchCV
from sklearn.pipeline import make_pipeline
from sklearn.preprocessing import FunctionTransformer

from isa_nrsfm import AffineNRSfM, AffineNRSfMCV, AutoNRSfM
from isa_nrsfm.datasets import load_face_prior
from isa_nrsfm.io import load_model, save_model
from isa_nrsfm.metrics import mean_shape_error_3d
from isa_nrsfm.skeletons import find_skeleton, get_skeleton

N_POINTS = 16
LAYOUTS = "ibug-68 ibug-51 xm2vts-68 xm2vts-53 muct-76 muct-61".split()
PERSPECTIVE = {"camera": "perspective", "principal_point": (0, 0)}


def study(
    seed, n_frames, degrees, *, change=0.0, noise=0.3, focal=np.inf, spread=0.3, depth=1
):
    """Return a table of objects within some degrees of frontal, and its truth.

    change: RMS difference of its mean shape from that of other tables, whose
    coordinates are about 0.6. depth: factor of the depths.
    """
    rng = np.random.default_rng(7)
    mean_shape = rng.normal(size=(N_POINTS, 3)) * (0.6, 0.7, 0.5)
    basis = 0.1 * rng.normal(size=(2, N_POINTS, 3))
    rng = np.random.default_rng(seed)
    mean_shape = mean_shape + change * rng.normal(size=mean_shape.shape)
    S = mean_shape + np.tensordot(rng.normal(size=(n_frames, 2)), basis, 1)
    S = (S - S.mean(axis=1, keepdims=True)) * (1, 1, depth)
    angles = degrees * rng.uniform(-1, 1, (n_frames, 3))
    R = Rotation.from_euler("yxz", angles, degrees=True).as_matrix()
    scales = 100 * np.exp(spread * rng.uniform(-1, 1, (n_frames, 1, 1)))
    points = scales * S @ R.mT
    X = points[..., :2] + rng.uniform(-80, 80, (n_frames, 1, 2))
    X = X / (1 + points[..., 2:] / focal) + noise * rng.normal(size=X.shape)
    return SimpleNamespace(X=X.reshape(n_frames, -1), S=S, depths=points[..., 2])


def faces(n_frames=20, degrees=10, depth=1, layout="ibug-68"):
    """Return a table (n_frames, n_points, 2) of faces of a prior, their shapes, angles.

    They turn about x, y and z by up to some degrees.
    """
    rng, prior = np.random.default_rng(0), load_face_prior(9, layout=layout)
    S = prior.shapes(rng.normal(size=(n_frames, 9))) * (1, 1, depth)
    angles = degrees * rng.uniform(-1, 1, (n_frames, 3))
    R = Rotation.from_euler("yxz", angles, degrees=True).as_matrix()
    X = 100 * (S @ R.mT)[..., :2]
    return X + rng.normal(size=X.shape), S, angles


def fitted(X, prior=None, kind=AffineNRSfM, **params):
    """Return a weak-perspective fit, by default with a prior."""
    given = {"camera": "weak_perspective", "random_state": 0}
    given |= {"n_components": 2, "prior": prior}
    return kind(**given | params).fit(X.reshape(len(X), -1))


def error(model, S, X):
    """Return the relative error of shapes, after a rotation and scale of each frame."""
    return mean_shape_error_3d(S, model.reconstruct(X), convention="frame")


@made_once
def prior_of(**params):
    """Return a fit of a table that determines its shapes."""
    return fitted(study(0, 30, 30).X, **params)


@pytest.fixture(scope="module")
def turned():
    """A table that determines its shapes, and its fit."""
    table = study(0, 30, 30)
    table.model = prior_of()
    return table


@pytest.fixture(scope="module")
def frontal(turned):
    """A table of other objects, nearly frontal, and its fit with the prior."""
    table = study(1, 20, 4, change=0.04)
    table.prior = turned.model
    table.model = fitted(table.X, turned.model)
    table.error = error(table.model, table.S, table.X)
    return table


# --- shapes ---------------------------------------------------------------------------


def test_accuracy():
    table, prior = study(2, 30, 3, change=0.04, noise=0.6), prior_of()
    with warnings.catch_warnings(action="ignore"):  # of depth, and of other objects
        without = error(fitted(table.X), table.S, table.X)
        of_prior = error(prior, table.S, table.X)
    model = fitted(table.X, prior)
    reached = error(model, table.S, table.X)
    assert reached < 0.6 * of_prior
    assert reached < 0.8 * without
    errors = depth_errors(model, table.X, table.depths)
    off = np.linalg.norm(errors) / np.linalg.norm(table.depths)
    assert off / 3 < model.depth_uncertainty_ < 3 * off
    assert 0.03 < model.prior_std_[0] < 0.1
    assert_allclose(model.basis_, prior.basis_, atol=1e-12)
    # The mean shape keeps its pose and size.
    before, after = prior.mean_shape_, model.mean_shape_
    moments = before.T @ after
    assert_allclose(moments, moments.T, atol=1e-6)
    assert np.trace(moments) == pytest.approx(np.sum(before**2), rel=1e-6)
    assert np.sqrt(np.mean((after - before) ** 2)) > 0.02


def test_invariances(frontal):
    X, model, prior = frontal.X, frontal.model, frontal.prior
    order = np.random.default_rng(0).permutation(len(X))
    planar = 1000 * table_of(tracks_of(X[order]), "planar")
    same = {
        "order, units, layout": (fitted(planar, prior, layout="planar"), order, 1e-10),
        "mirrored": (fitted(X, prior.mirrored()).mirrored(), slice(None), 0.0),
        "float32": (fitted(X.astype(np.float32), prior), slice(None), 1e-5),
    }
    for name, (other, rows, tol) in same.items():
        for found, expected in (
            (other.mean_shape_, model.mean_shape_),
            (other.alpha_, model.alpha_[rows]),
            (other.prior_std_, model.prior_std_),
        ):
            assert_allclose(found, expected, rtol=0, atol=tol, err_msg=name)
    assert_array_equal(model.transform(X), model.alpha_)


def test_missing_points_weights_and_few_frames(frontal):
    X, S, prior = frontal.X, frontal.S, frontal.prior

    def reached(table, point_weight=None):
        model = AffineNRSfM("auto", camera="weak_perspective", prior=prior)
        model.fit(table, point_weight=point_weight)
        assert np.isfinite(model.alpha_).all()
        return error(model, S[: len(table)], table) / frontal.error

    weights = np.random.default_rng(0).uniform(0.3, 2, (len(X), N_POINTS))
    assert reached(X, weights) < 1.3
    gaps = with_gaps(X, 0.2)
    gaps[:, 10:12] = np.nan
    assert reached(gaps) < 1.6
    assert reached(X[:3]) < 2.5


def test_deviations_have_the_width_of_the_prior_without_a_jackknife(turned, tmp_path):
    table = study(1, 10, 4, change=0.04)
    X = table.X.reshape(10, -1, 2).copy()
    hidden = np.random.default_rng(0).permuted(
        np.tile(range(N_POINTS), (10, 1)), axis=1
    )
    X[hidden >= 4] = np.nan  # each part of the points is too few
    X = X.reshape(10, -1)
    model = fitted(X, turned.model)
    assert np.isnan(model.depth_uncertainty_)
    save_model(model, tmp_path / "model.npz")
    certainty = load_model(tmp_path / "model.npz")._model.frames.certainty
    assert (np.sqrt(certainty.points) > 0.2 * model.prior_std_[0]).all()


@pytest.mark.slow
def test_outliers(frontal):
    X = with_outliers(frontal.X, 100, seed=3)
    X[:, 10:12] = np.nan
    model = fitted(X, frontal.prior, loss="cauchy")
    assert error(model, frontal.S, frontal.X) < 1.5 * frontal.error
    assert model.prior_std_ == pytest.approx(frontal.model.prior_std_, rel=0.2)


def test_orthographic_cameras():
    prior = fitted(study(0, 30, 30, spread=0).X / 50, camera="orthographic")
    refused("prior was fitted with camera='orthographic'", fitted, prior.alpha_, prior)
    table = study(1, 20, 4, change=0.04, spread=0)
    model = fitted(table.X, prior, camera="orthographic")
    assert error(model, table.S, table.X) < 0.05
    size = np.sqrt(np.mean((100 * table.S) ** 2))
    assert np.sqrt(np.mean(model.reconstruct(table.X) ** 2)) == pytest.approx(size, 0.1)


@pytest.mark.slow
def test_perspective_cameras(turned):
    """The prior may be the mirror image of the objects."""
    table = study(1, 20, 4, change=0.04, focal=800)
    model = fitted(table.X, turned.model, **PERSPECTIVE)
    assert error(model, table.S, table.X) < 0.04
    assert abs(model.focal_length_ - 800) <= 2 * model.focal_length_std_
    assert model.focal_length_std_ < 0.2 * 800
    assert model.mirror_certainty_ > 0.9
    sign = np.sign(np.sum(model.basis_ * turned.model.basis_, axis=(0, 1)))
    assert_allclose(model.basis_ * sign, turned.model.basis_, atol=1e-12)


@pytest.mark.slow
@pytest.mark.parametrize("certainty", [0.5, 1.0])
def test_prior_and_perspective_decide_the_mirror_image(turned, certainty):
    table, same, told = study(1, 20, 10, focal=4000), [], []
    for prior in (copy.copy(turned.model), turned.model.mirrored()):
        prior.mirror_certainty_ = certainty
        with warnings.catch_warnings(record=True, action="always") as caught:
            model = fitted(table.X, prior, focal_length=4000, **PERSPECTIVE)
        told += [str(each.message) for each in caught]
        assert model.camera_ == ("weak_perspective" if caught else "perspective")
        same.append(np.vdot(model.mean_shape_[:, 2], prior.mean_shape_[:, 2]) > 0)
        assert model.mirror_certainty_ > 0.9
    assert sum(same) == (2 if certainty == 1 else 1)
    # Only a certain prior is believed if perspective shows the other image.
    assert len(told) == (1 if certainty == 1 else 0)
    assert all("perspective predicts held-out points no better" in t for t in told)
    weak = fitted(table.X, prior)
    assert weak.mirror_certainty_ == certainty


@pytest.mark.parametrize("layout", LAYOUTS)
def test_face_priors_of_all_layouts(layout):
    prior, skeleton = load_face_prior(9, layout=layout), get_skeleton(layout)
    shape = prior.mean_shape_
    assert prior.mirror_certainty_ == 1
    assert find_skeleton(len(shape), shape=shape[:, :2]) == skeleton
    mirrored = shape[[*skeleton.right]] * (-1, 1, 1) - shape[[*skeleton.left]]
    assert np.sqrt(np.mean(mirrored**2)) < 0.06
    assert np.sqrt(np.mean(shape**2)) == pytest.approx(1)
    if layout == "ibug-68":
        chin, nose, eyes = (shape[i] for i in (8, 30, slice(36, 48)))
        assert eyes[:, 1].max() < nose[1] < chin[1]  # y down
        assert nose[2] < eyes[:, 2].min()  # depths away from the viewer
    X, _, angles = faces(degrees=20, layout=layout)
    motion = prior.decompose(X.reshape(len(X), -1)).motion
    x, _, z = np.cross(motion[:, 0], motion[:, 1]).T
    assert_allclose(np.degrees(np.arctan2(-x, z)), angles[:, 0], atol=4)


# --- other objects and images ---------------------------------------------------------


def test_deviations_are_those_of_errors_of_flatter_objects(turned):
    table = study(1, 30, 4, change=0.04, depth=0.7)
    model = fitted(table.X, turned.model)
    stated = model.scales_[:, None] * model.reconstruct(table.X, return_std=True)[1]
    off = depth_errors(model, table.X, table.depths)
    assert 0.4 < np.sqrt(np.mean((off / stated) ** 2)) < 2.5


def test_a_table_that_determines_its_depth_overrules_the_prior(turned):
    table = study(1, 40, 20, depth=0.6)
    model = fitted(table.X, turned.model)
    assert error(model, table.S, table.X) < 0.06


@pytest.mark.parametrize(
    ("change", "wrong", "message"),
    [
        (lambda X: X * (-1, 1), slice(None), "all 20 rows are mirror images"),
        (lambda X: X * (1, -1), [3, 7, 8], r"y points up in.*3 of 20 rows \(3, 7, 8\)"),
        (lambda X: X[..., ::-1], slice(None), "x and y are exchanged in.*all 20 rows"),
    ],
)
def test_rows_that_are_mirrored_or_turned_are_named(change, wrong, message):
    X, *_ = faces()
    X[wrong] = change(X[wrong])
    model = warned(message, fitted, X, load_face_prior(9), n_components="auto")
    assert model.mirror_certainty_ == (wrong != slice(None))


def test_mirrored_rows_are_named_without_a_prior():
    X, *_ = faces(30, degrees=30)
    mirrored = X * (-1, 1)
    fitted(mirrored, camera="affine")  # consistent
    X[::2] = mirrored[::2]
    warned(r"15 of 30 rows \(.*\) are mirror", fitted, X, camera="affine")


FAR = "sizes of the object from that of the prior"


def test_squeezed_images_are_named():
    X = faces()[0] * (9 / 16, 1)
    model = warned(FAR, fitted, X, load_face_prior(9), n_components="auto")
    assert model.prior_std_[0] > 0.2


# --- refusals -------------------------------------------------------------------------


def test_other_points_are_refused(turned, frontal):
    X = frontal.X
    other = np.roll(X, 2, axis=1)
    refused("the same points in the same order", fitted, other, turned.model)
    hardly = study(1, 30, 1).X
    undetermined = warned(
        "depth of the shapes is not determined", fitted, hardly, tol=1e3
    )
    refused("depth of the prior is not determined", fitted, X, undetermined)


# --- as an estimator ------------------------------------------------------------------


def test_pipelines_and_copies(turned, frontal):
    X, model, prior = frontal.X, frontal.model, turned.model
    cloned = clone(model).set_params(prior__verbose=1)
    assert (cloned.prior.verbose, prior.verbose) == (1, 0)
    copied = pickle.loads(pickle.dumps(model))
    assert_array_equal(copied.transform(X), model.alpha_)
    piped = make_pipeline(FunctionTransformer(), clone(model))
    assert_array_equal(piped.fit_transform(X), model.alpha_)
    refused("prior", AffineNRSfMCV((1, 2), estimator=clone(model)).fit, X)


@pytest.mark.slow
def test_searches(turned, tmp_path):
    X, prior = study(1, 20, 4, change=0.04).X, turned.model
    priors = [FrozenEstimator(prior), FrozenEstimator(prior.mirrored())]
    search = GridSearchCV(fitted(X, prior), {"prior": priors}, cv=2).fit(X)
    assert np.isfinite(search.cv_results_["mean_test_score"]).all()
    assert search.best_estimator_.prior_std_[0] > 0
    searched = AffineNRSfMCV([2], estimator=clone(prior), cv=2).fit(turned.X)
    model, best = fitted(X, searched), searched.best_estimator_
    assert_array_equal(model.alpha_, fitted(X, best).alpha_)
    save_model(model, tmp_path / "model.npz")
    stored = load_model(tmp_path / "model.npz").prior
    assert_array_equal(stored.basis_, best.basis_)


# --- tables that do not fit a model ---------------------------------------------------


def test_new_frames_fit_their_model(turned):
    for noise in (0.3, 0.0):  # a warning would be an error
        turned.model.transform(study(3, 40, 30, noise=noise).X)
    for n_frames in (30, 3):
        turned.model.transform(turned.X[:n_frames])


@pytest.mark.parametrize(
    ("params", "other"),
    slow_after(
        2,
        [
            ({}, "order"),
            ({"camera": "affine"}, "object"),
            ({"layout": "planar"}, "object"),
        ],
    ),
)
def test_foreign_tables_are_warned_of_once(params, other):
    X = study(3, 40, 30, change=0.04 * (other == "object")).X
    X, own = (np.roll(X, 2, axis=1) if other == "order" else X), study(0, 40, 30).X
    if "layout" in params:
        X, own = (table_of(tracks_of(table), "planar") for table in (X, own))
    model = fitted(own, **params) if params else prior_of()
    for method in (model.transform, model.decompose):
        with warnings.catch_warnings(record=True, action="always") as messages:
            method(X)
        (message,) = [str(w.message) for w in messages if "as far" in str(w.message)]
        assert "does not generalise" in message
    assert np.isfinite(model.score(X))  # which says it: no warning
    model.transform(X[:9])  # too few frames to tell
    way = message.partition("may be wrong. ")[2]
    if other == "order":
        assert way.startswith("Check whether X has the same points")
    elif params.get("camera") == "affine":
        assert way == "Fit X separately"
    else:  # the way works
        code, _, told = way.removeprefix("Adapt the model to X: ").partition(". H")
        assert told.startswith("eld-out points of some rows")
        names = {"AutoNRSfM": AutoNRSfM, "model": model, "X": X}
        assert eval(code, names).best_estimator_.prior_std_[0] > 0.01


test_refusals = refusals_of("prior", globals())
