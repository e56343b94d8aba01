"""A fitted model as the prior of another table, and tables that do not fit a model."""

import copy
import pickle
import warnings
from dataclasses import replace
from itertools import product
from types import SimpleNamespace

import numpy as np
import pytest
from frame_parts import depth_errors
from layers import slow_after, with_limits
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
from isa_nrsfm._fitted_model import far_points, hold_open, prior_start
from isa_nrsfm._frames.camera_models import full_rotations
from isa_nrsfm._joint.fit import widened
from isa_nrsfm._joint.likelihood import JointFrames
from isa_nrsfm._joint.problem import JointProblem
from isa_nrsfm._parameters import FACE_PRIORS
from isa_nrsfm._prepare.scaling import scaled_table
from isa_nrsfm.datasets import load_face_prior
from isa_nrsfm.io import load_model, save_model
from isa_nrsfm.metrics import mean_shape_error_3d
from isa_nrsfm.skeletons import find_skeleton, get_skeleton

# For errors of depths
Thorough = with_limits(few_frames=0, widths=())
N_POINTS = 16
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


def faces(n_frames=30, degrees=10, depth=1, layout="ibug-68"):
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
    return fitted(study(0, 40, 30).X, **params)


@pytest.fixture(scope="module")
def turned():
    """A table that determines its shapes, and its fit."""
    table = study(0, 40, 30)
    table.model = prior_of()
    return table


@pytest.fixture(scope="module")
def frontal(turned):
    """A table of other objects, nearly frontal, and its fit with the prior."""
    table = study(1, 40, 4, change=0.04)
    table.prior = turned.model
    table.model = fitted(table.X, turned.model)
    table.error = error(table.model, table.S, table.X)
    return table


# --- objective ------------------------------------------------------------------------


def problem_of(table):
    """Return the problem of a fit with the prior of a table, and its start."""
    source, _, settings = clone(table.model)._ready(table.X)
    scaled = scaled_table(source, None, 2, settings)
    start, settings = prior_start(scaled, settings, checked=True)
    frames = JointFrames.from_points(scaled.rows, True)
    problem = JointProblem(frames, settings._replace(tol=1e-4), True)
    return problem, problem.aligned(start)


def test_a_width_of_zero_gives_the_shapes_of_the_prior(frontal):
    problem, start = problem_of(frontal)
    # Also in float64 the mean shape moves by the square of the width.
    prior = problem.settings.shape_prior._replace(width=1e-5)
    problem = problem.with_prior(prior)
    shapes = problem.unreversed(start).state.shapes
    assert_allclose(shapes, prior.shapes, atol=1e-6)


def test_the_first_width_makes_no_difference(frontal):
    ends = []
    for width in (0.01, 0.2):
        problem, start = problem_of(frontal)
        prior = problem.settings.shape_prior._replace(width=width)
        problem = problem.with_prior(prior)
        fit = widened(problem, problem.unreversed(start))
        ends.append((fit.prior.width, fit.state.shapes))
    (few, some), (many, other) = ends
    assert few == pytest.approx(many, rel=0.02)
    assert_allclose(some, other, atol=0.005)


# --- shapes ---------------------------------------------------------------------------


@pytest.mark.parametrize("degrees", slow_after(1, [3, 20]))
def test_accuracy(degrees):
    table, prior = study(2, 40, degrees, change=0.04, noise=0.6), prior_of()
    with warnings.catch_warnings(action="ignore"):  # of depth, and of other objects
        without = error(fitted(table.X), table.S, table.X)
        of_prior = error(prior, table.S, table.X)
    model = fitted(table.X, prior, Thorough)
    reached = error(model, table.S, table.X)
    assert reached < 0.6 * of_prior
    assert reached < (0.8 if degrees == 3 else 1.2) * without
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


def test_cameras_of_few_views(load_data):
    """Photos of other annotators from three cameras, 45 degrees apart."""
    photos = load_data("rafd_106")
    points = photos["W2d"][::5, [*range(0, 33, 2), *range(33, 64), *range(84, 104)]]
    prior = load_face_prior(9)
    model = fitted(points.reshape(len(points), -1), prior, n_components=9)
    yaws = np.degrees(np.arctan2(*model.rotations_[:, 2, [0, 2]].T))
    right, front, left = (
        np.median(yaws[photos["camera"][::5] == view]) for view in (-45, 0, 45)
    )
    assert abs(front) < 5
    assert right == pytest.approx(-left, abs=5)
    assert 25 < right < 50


def test_invariances(frontal):
    X, model, prior = frontal.X, frontal.model, frontal.prior
    order = np.random.default_rng(0).permutation(len(X))
    planar = table_of(tracks_of(X), "planar")
    same = {
        "order": (fitted(X[order], prior), order),
        "units": (fitted(1000 * X, prior), slice(None)),
        "mirrored": (fitted(X, prior.mirrored()).mirrored(), slice(None)),
        "planar": (fitted(planar, prior, layout="planar"), slice(None)),
        "threads": (fitted(X, prior, n_jobs=2), slice(None)),
        "float32": (fitted(X.astype(np.float32), prior), slice(None)),
    }
    for name, (other, rows) in same.items():
        tol = {"order": 1e-10, "units": 1e-10, "float32": 1e-5}.get(name, 0.0)
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

    unseen = X.copy()
    unseen[:, 10:12] = np.nan
    weights = np.random.default_rng(0).uniform(0.3, 2, (len(X), N_POINTS))
    assert reached(with_gaps(X, 0.2)) < 1.5
    assert reached(X, weights) < 1.3
    assert reached(unseen) < 1.6
    assert reached(X[:20]) < 1.7
    assert reached(X[:3]) < 2.5


def test_deviations_have_the_width_of_the_prior_without_a_jackknife(turned, tmp_path):
    table = study(1, 10, 4, change=0.04)
    X = table.X.reshape(10, -1, 2).copy()
    hidden = np.random.default_rng(0).permuted(
        np.tile(range(N_POINTS), (10, 1)), axis=1
    )
    X[hidden >= 4] = np.nan  # each part of the points is too few
    model = fitted(X.reshape(10, -1), turned.model)
    assert np.isnan(model.depth_uncertainty_)
    save_model(model, tmp_path / "model.npz")
    frames = load_model(tmp_path / "model.npz")._model.frames
    assert frames.certainty.turns is None
    assert (np.sqrt(frames.certainty.points) > 0.2 * model.prior_std_[0]).all()


@pytest.mark.slow
@pytest.mark.parametrize("loss", ["cauchy", "huber"])
def test_outliers(frontal, loss):
    X = with_outliers(frontal.X, 100, seed=3)
    X[:, 10:12] = np.nan
    model = fitted(X, frontal.prior, loss=loss)
    assert error(model, frontal.S, frontal.X) < 1.5 * frontal.error
    assert model.prior_std_ == pytest.approx(frontal.model.prior_std_, rel=0.2)


def test_orthographic_cameras():
    prior = fitted(study(0, 40, 30, spread=0).X / 50, camera="orthographic")
    refused("prior was fitted with camera='orthographic'", fitted, prior.alpha_, prior)
    table = study(1, 40, 4, change=0.04, spread=0)
    model = fitted(table.X, prior, camera="orthographic")
    assert error(model, table.S, table.X) < 0.05
    size = np.sqrt(np.mean((100 * table.S) ** 2))
    assert np.sqrt(np.mean(model.reconstruct(table.X) ** 2)) == pytest.approx(size, 0.1)


@pytest.mark.slow
@pytest.mark.parametrize("focal_length", [800.0, None])
def test_perspective_cameras(turned, focal_length):
    """The prior may be the mirror image of the objects."""
    table = study(1, 20, 4, change=0.04, focal=800)
    model = fitted(table.X, turned.model, focal_length=focal_length, **PERSPECTIVE)
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


@pytest.mark.parametrize("layout", FACE_PRIORS)
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
    X, _, angles = faces(40, 20, layout=layout)
    R, _ = full_rotations(prior.decompose(X.reshape(40, -1)).motion)
    yaw = np.degrees(np.arctan2(-R[:, 2, 0], R[:, 2, 2]))
    assert_allclose(yaw, angles[:, 0], atol=4)


# --- other objects and images ---------------------------------------------------------


@pytest.mark.parametrize(("degrees", "factor"), slow_after(1, [(4, 0.7), (4, 1.4)]))
def test_objects_of_other_depth(turned, degrees, factor):
    table = study(1, 40, degrees, change=0.04, depth=factor)
    model = fitted(table.X, turned.model, Thorough)
    stated = model.scales_[:, None] * model.reconstruct(table.X, return_std=True)[1]
    off = depth_errors(model, table.X, table.depths)
    assert 0.4 < np.sqrt(np.mean((off / stated) ** 2)) < 2.5


def test_a_table_that_determines_its_depth_overrules_the_prior():
    X, S, _ = faces(90, 15, 0.6)
    model = fitted(X, load_face_prior(9), n_components=9)
    assert error(model, S, X.reshape(90, -1)) < 0.06


# How rows are wrong, and what is said of them
WAYS = {
    "left is right": (lambda X: X * (-1, 1), "{} are mirror images"),
    "y is up": (lambda X: X * (1, -1), "y points up in.*{}"),
    "y is x": (lambda X: X[..., ::-1], "x and y are exchanged in.*{}"),
}


QUICK_WAYS = [("left is right", "all"), ("y is up", "some"), ("y is x", "all")]


@pytest.mark.parametrize(
    ("way", "kind"), slow_after(3, [*QUICK_WAYS, *product(WAYS, ["some"])])
)
def test_mirrored_rows_are_named(way, kind):
    X, *_ = faces()
    turned, message = WAYS[way]
    wrong = slice(None) if kind == "all" else [3, 7, 8]
    X[wrong] = turned(X[wrong])
    which = "all 30 rows" if kind == "all" else r"3 of 30 rows \(3, 7, 8\)"
    given = fitted, X, load_face_prior(9)
    model = warned(message.format(which), *given, n_components="auto")
    assert model.mirror_certainty_ == (kind == "some")


def test_rows_as_those_of_the_prior_are_fitted_silently():
    model = fitted(faces()[0], load_face_prior(9), n_components="auto")
    assert model.mirror_certainty_ == 1


@pytest.mark.parametrize("camera", slow_after(1, ["affine", "weak_perspective"]))
def test_mirrored_rows_are_named_without_a_prior(camera):
    X, *_ = faces(degrees=30)
    mirrored = X * (-1, 1)
    fitted(mirrored, camera=camera)  # consistent
    X[::2] = mirrored[::2]
    warned(r"15 of 30 rows \(.*\) are mirror", fitted, X, camera=camera)


def test_squeezed_images_are_named():
    X, message = (
        faces(20)[0] * (9 / 16, 1),
        "sizes of the object from that of the prior",
    )
    model = warned(message, fitted, X, load_face_prior(9), n_components=9)
    assert model.prior_std_[0] > 0.2


def test_objects_of_which_a_prior_has_no_frame_from_behind(turned):
    table = study(1, 40, 4)
    X = table.X.reshape(40, -1, 2)
    X[5:9, :, 0] *= -1
    message = r"4 of 40 rows \(5, 6, 7, 8\) are mirror images"
    warned(message, fitted, X.reshape(40, -1), turned.model)
    around = fitted(study(0, 30, 180).X)
    fitted(X.reshape(40, -1), around)  # any view is possible


# --- refusals -------------------------------------------------------------------------


def test_other_points_are_refused(turned, frontal):
    X = frontal.X
    order = np.random.default_rng(0).permutation(N_POINTS)
    other = X.reshape(len(X), -1, 2)[:, order].reshape(X.shape)
    refused("the same points in the same order", fitted, other, turned.model)
    message = "depth of the shapes is not determined"
    hardly = study(1, 30, 1).X
    undetermined = warned(message, fitted, hardly)
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
    for n_frames in (40, 3):
        turned.model.transform(turned.X[:n_frames])


@pytest.mark.slow
def test_new_frames_fit_their_model_also_with_very_different_weights():
    rng, table = np.random.default_rng(0), study(0, 30, 30, noise=0)
    weights = np.exp(3 * rng.normal(size=(30, N_POINTS)))
    noise = 0.5 * rng.normal(size=(30, N_POINTS, 2)) / np.sqrt(weights)[..., None]
    X, given = table.X + noise.reshape(30, -1), {"point_weight": 0.05 * weights}
    model = AffineNRSfM(2, camera="weak_perspective", random_state=0).fit(X, **given)
    model.transform(X)
    for other in (X, table.X):
        model.transform(other, **given)
    assert not model.diagnostics(X, **given).outlier_share
    warned("as far from", model.transform, np.roll(X, 2, axis=1), **given)


@pytest.mark.parametrize(
    ("params", "other"),
    slow_after(
        2,
        [
            ({}, "order"),
            ({"camera": "affine"}, "object"),
            ({}, "object"),
            ({"layout": "planar"}, "object"),
            (PERSPECTIVE | {"focal_length": 800}, "object"),
        ],
    ),
)
def test_foreign_tables_are_warned_of_once(turned, params, other):
    focal = params.get("focal_length", np.inf)
    X = study(3, 40, 30, change=0.04 * (other == "object"), focal=focal).X
    if other == "order":
        X = np.roll(X, 2, axis=1)
    own = study(0, 40, 30, focal=focal).X
    if "layout" in params:
        X, own = (table_of(tracks_of(table), "planar") for table in (X, own))
    model = fitted(own, **params) if params else turned.model
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


def test_distances_that_noise_and_errors_of_shapes_cause_are_no_misfit(turned):
    rng, model = np.random.default_rng(0), turned.model._model
    certainty = model.frames.certainty._replace(images=(1.2, 0.3))
    frames = replace(model.frames, certainty=certainty)
    c = np.insert(rng.normal(size=(10_000, len(frames.shapes) - 1)), 0, 1, axis=1)
    variance = (1.2 + 0.3 * np.mean(np.sum(c**2, axis=1))) * frames.noise_variance
    distance = np.linalg.norm(rng.normal(0, np.sqrt(variance), (2, 10_000)), axis=0)
    assert_allclose(model._replace(frames=frames).misfit(distance), 1, rtol=0.03)


def test_a_few_frames_do_not_make_points_others():
    distance, frames = np.full((9, 5), 0.1), SimpleNamespace(loss="linear")
    frames.noise_variance, distance[:3, 0], distance[3] = 0.0, np.nan, np.nan
    distance[:2] = 9.0
    assert far_points(distance, frames) == 0
    assert_allclose(far_points(3 * distance, frames), 0.3)


def test_a_table_that_is_held_is_opened_once(turned):
    model, X = copy.copy(turned.model), turned.X.copy()
    expected, other = model.reproject(X), np.roll(X, 2, axis=1)
    hold_open(model, X)
    opened = model._opened(X)
    assert model._opened(X) is opened
    assert_array_equal(model.reproject(X), expected)
    warned("as far from", model.reproject, other)
    assert model._opened(X, np.ones((len(X), N_POINTS))) is not opened


test_refusals = refusals_of("prior", globals())
