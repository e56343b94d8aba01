"""AffineNRSfM: attributes, the model's formula, methods, input and parameters."""

import inspect
import warnings
from copy import deepcopy
from itertools import product

import numpy as np
import pandas as pd
import polars as pl
import pytest
from layers import may_not_converge, slow_after
from made_once import made_once
from numpy.testing import assert_allclose, assert_array_equal, assert_equal
from refusals import refusals_of, refused
from scenes import measurements, table_of, tracks_of, with_gaps
from sklearn.base import BaseEstimator, clone
from sklearn.decomposition import FastICA
from sklearn.exceptions import ConvergenceWarning

from isa_nrsfm import AffineNRSfM, AffineNRSfMCV, Decomposition, FastISA, PooledFastICA
from isa_nrsfm.baselines import PseudoInverseNRSfM
from isa_nrsfm.datasets import make_face_tracks, make_nonrigid_tracks
from isa_nrsfm.io import landmark_table
from isa_nrsfm.metrics import affine_shape_error, mean_shape_error_3d

N_FRAMES, N_POINTS, K = 90, 68, 3
FACES = make_face_tracks(N_FRAMES, n_components=K, random_state=0)
TABLE = FACES.data
ONLY_JOINT = "alpha_std_ noise_variance_ camera_noise_ratio_ reliability_".split()
ONLY_JOINT += ["objective_history_", "gradient_norm_"]
TABLE_METHODS = ("transform", "decompose", "reconstruct", "reproject")


def estimator(n_components=K, **params):
    """Return an estimator with few starts."""
    params = {"isa": FastISA(n_init=3), "random_state": 0} | params
    return AffineNRSfM(n_components, **params)


@made_once
def fitted(refinement="joint"):
    """Return a model of the table, to be left as it is."""
    return estimator(refinement=refinement).fit(TABLE)


def model_tracks(model, motion, translation, alpha):
    """Return the tracks that the documented formula gives."""
    shapes = model.mean_shape_ + np.tensordot(alpha, model.basis_, 1)
    return shapes @ np.swapaxes(motion, 1, 2) + np.asarray(translation)[:, None]


def frame_weights(tracks, scale_frames):
    """Return the documented weight of each frame in the inverse SNR."""
    centred = tracks - tracks.mean(axis=1, keepdims=True)
    sizes = np.mean(centred**2, axis=(1, 2))
    return 1 / sizes if scale_frames else np.ones(len(tracks))


def scales_frames(model):
    """Return whether frames count alike; those of orthographic cameras never do."""
    return model.scale_frames and model.camera != "orthographic"


def size_weights(model, table):
    """Return one over the square of the sizes of frames, those of the linear loss."""
    weights = frame_weights(tracks_of(table, model.layout), True)
    if scales_frames(model):
        return weights
    return np.full_like(weights, 1 / np.mean(1 / weights))


VARIANTS = [
    {},
    {"scale_frames": False},
    {"layout": "planar"},
    {"isa": PooledFastICA(n_init=3), "independence": "coefficients"},
    {"camera": "weak_perspective"},
    {"camera": "orthographic"},
    {"camera": "weak_perspective", "refinement": None},
    {"n_components": 1},
    {"refinement": "alternating"},
    {"refinement": "alternating", "block_recovery": "irls", "n_components": 6},
    {"refinement": None, "layout": "planar", "scale_frames": False},
    {"refinement": None, "isa": PooledFastICA(n_init=3), "n_components": 1},
]
SLOW_VARIANTS = [
    {"loss": "huber"},
    {"n_components": 6},
    {"refinement": "alternating", "scale_frames": False},
    {"refinement": None, "block_recovery": "irls"},
    {"loss": "cauchy", "independence": None},
    {"camera": "weak_perspective", "loss": "cauchy", "layout": "planar"},
]


def variants(**required):
    """Return the variants that have some values of parameters, for a test."""
    return [
        pytest.param(i, id=str(params), marks=[pytest.mark.slow] * (i >= len(VARIANTS)))
        for i, params in enumerate(VARIANTS + SLOW_VARIANTS)
        if all(
            getattr(estimator(**params), name) in values
            for name, values in required.items()
        )
    ]


def only(**required):
    """Return a decorator for tests of the variants with some values of parameters."""
    return pytest.mark.parametrize("variant", variants(**required), indirect=True)


@made_once
def fitted_variant(number):
    """Return a fitted model, its training table and another table."""
    fitted = estimator(**(VARIANTS + SLOW_VARIANTS)[number])
    table, new = TABLE, make_face_tracks(30, n_components=K, random_state=1).data
    if fitted.layout == "planar":
        table, new = (table_of(tracks_of(X), "planar") for X in (table, new))
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", ConvergenceWarning)
        return fitted.fit(table), table, new


@pytest.fixture(params=variants())
def variant(request):
    """Return a fitted model, its training table and another table."""
    return fitted_variant(request.param)


# --- attributes ---------------------------------------------------------------------


@pytest.mark.parametrize("refinement", ["joint", "alternating"])
def test_attributes_and_results_have_the_documented_shapes_and_types(refinement):
    table = TABLE.astype(np.float32)
    model = estimator(refinement=refinement).fit(table)
    reference = fitted(refinement)
    in_single_precision = {
        "mean_shape_": (N_POINTS, 3),
        "basis_": (K, N_POINTS, 3),
        "alpha_": (N_FRAMES, K),
        "motion_": (N_FRAMES, 2, 3),
        "translation_": (N_FRAMES, 2),
        "reference_motion_": (2, 3),
        "reference_translation_": (2,),
    }
    in_double_precision = {
        "mode_covariance_": (3 * K, 3 * K),
        "singular_values_": (3 * K + 3,),
        "energy_share_": (K,),
    }
    numbers = ["inverse_snr_", "rank_floor_"]
    if refinement == "joint":
        in_single_precision["alpha_std_"] = (N_FRAMES, K)
        in_double_precision["reliability_"] = (K,)
        in_double_precision["objective_history_"] = (model.n_iter_ + 1,)
        numbers += ["noise_variance_", "camera_noise_ratio_", "gradient_norm_"]
    else:
        assert not any(hasattr(model, name) for name in ONLY_JOINT)
    for name, shape in (in_single_precision | in_double_precision).items():
        found = getattr(model, name)
        single = name in in_single_precision
        assert found.shape == shape, name
        assert found.dtype == (np.float32 if single else np.float64), name
        assert getattr(reference, name).dtype == np.float64, name
        assert np.isfinite(found).all(), name
    assert all(isinstance(getattr(model, name), float) for name in numbers)
    assert type(model.n_iter_) is int
    assert (model.n_components_, model.n_features_in_) == (K, 2 * N_POINTS)
    assert_allclose(model.energy_share_.sum(), 1)
    assert isinstance(model.isa_, FastISA)
    assert not hasattr(model, "feature_names_in_")

    found = {name: getattr(model, name)(table) for name in TABLE_METHODS}
    found["images"] = model.inverse_transform(model.alpha_)
    found["euclidean"] = model.reconstruct(table, camera="orthographic")
    for name, results in found.items():
        for each in results if isinstance(results, tuple) else (results,):
            assert each.dtype == np.float32, name
    # Cameras and coefficients are computed in double precision from shapes that were
    # rounded to single precision.
    assert_array_equal(found["transform"], model.alpha_)
    assert_allclose(model.alpha_, reference.alpha_, atol=1e-4)
    assert_allclose(model.inverse_snr_, reference.inverse_snr_, rtol=1e-3)


def test_every_attribute_is_documented():
    model = fitted()
    found = {name for name in vars(model) if name.endswith("_")}
    found |= {"stability_", "stable_sets_"}  # computed when they are asked for
    text = inspect.getdoc(type(model))
    documented = {name for name in dir(model) if f"\n{name} : " in text}
    assert found == {name for name in documented if name.endswith("_")}


def is_joint(model):
    return model.refinement == "joint"


def is_whole(model):
    """Return whether a fit has directions that are not reported."""
    return is_joint(model) and model.camera != "affine"


@only(loss=["linear"])  # of others outliers have been filled in
def test_singular_values_and_rank_floor_are_those_of_the_measurement_matrix(variant):
    model, table, _ = variant
    W = measurements(tracks_of(table, model.layout), scales_frames(model))
    S = np.linalg.svd(W, compute_uv=False)
    rank = 3 * model.n_components + 3
    assert_allclose(model.rank_floor_, np.sum(S[rank:] ** 2) / np.sum(S**2), rtol=1e-9)
    # Directions that are not reported explain more than K.
    least = 0 if is_whole(model) else model.rank_floor_
    assert 0 < model.rank_floor_ < 1
    assert least < model.inverse_snr_ < 1
    if scales_frames(model):
        assert_allclose(model.singular_values_, S[:rank], rtol=1e-9)
    else:  # in the unit of the table or as a ratio: their proportions are the same
        ratio = model.singular_values_ / S[:rank]
        assert_allclose(ratio, ratio[0], rtol=1e-9)


@only(loss=["linear"])  # robust sizes are tested by themselves
def test_mode_covariance(variant):
    model, table, _ = variant
    C = model.mode_covariance_
    assert_allclose(C, C.T, atol=1e-12 * np.abs(C).max())
    assert np.linalg.eigvalsh(C)[0] > -1e-12 * np.trace(C)
    if is_joint(model):
        # (1 / 2I) sum_i (alpha_i alpha_i^T) (x) (M_i^T M_i), of frames of size one
        weights = frame_weights(tracks_of(table, model.layout), scales_frames(model))
        alpha, motion = model.alpha_, model.motion_
        parts = weights[:, None] * alpha, alpha, motion, motion
        expected = np.einsum("ik,im,irc,ird->kcmd", *parts) / (2 * N_FRAMES)
        tolerance = 1e-10 * np.abs(C).max()
        assert_allclose(C, expected.reshape(C.shape), atol=tolerance)
        return
    # Block k is (W Q)^T (W Q) / 2I, in other axes, for an orthonormal basis Q of the
    # subspace that the three coordinates of basis shape k span.
    W = measurements(tracks_of(table, model.layout), scales_frames(model))
    for k, shape in enumerate(model.basis_):
        motion, rows = W @ np.linalg.qr(shape)[0], slice(3 * k, 3 * k + 3)
        expected = np.linalg.eigvalsh(motion.T @ motion / len(W))
        assert_allclose(np.linalg.eigvalsh(C[rows, rows]), expected, rtol=1e-6)


def test_shapes_are_centred_and_pure(variant):
    # The joint refinement's basis shapes have no part along the mean shape (white with
    # affine cameras), tr(B_k^T B_0) = 0, where scales of cameras would absorb it, and
    # the mean of the coefficients is zero. The paper's are orthogonal: B_k B_l^T = 0
    # for k != l, the mean shape included.
    model, *_ = variant
    shapes = np.concatenate([model.mean_shape_[None], model.basis_])
    assert_allclose(shapes.mean(axis=1), 0, atol=1e-12)
    if is_joint(model):
        if model.camera != "orthographic":
            along = np.sum(model.basis_ * model.mean_shape_, axis=(1, 2))
            assert_allclose(along, 0, atol=1e-9)
        assert_allclose(model.alpha_.mean(axis=0), 0, atol=1e-10)
        return
    for k, one in enumerate(shapes):
        for other in shapes[:k]:
            size = np.linalg.norm(one) * np.linalg.norm(other)
            assert np.abs(one.T @ other).max() < 1e-10 * size


def test_coefficients_have_unit_variance_and_energy_decreases(variant):
    model, table, _ = variant
    assert_allclose(model.alpha_.std(axis=0), 1, rtol=1e-9)
    assert np.all(np.mean(model.alpha_**3, axis=0) > 0)
    assert np.all(np.diff(model.energy_share_) < 0)
    if model.loss != "linear":
        return
    images = np.einsum("irc,kjc->ikjr", model.motion_, model.basis_)
    of_frames = model.alpha_**2 * np.sum(images**2, axis=(2, 3))
    energy = size_weights(model, table) @ of_frames
    # Directions that are not reported have the rest.
    share = model.energy_share_
    assert_allclose(share / share.sum(), energy / energy.sum(), rtol=1e-9)
    assert 0.9 < share.sum() < 1 + 1e-9


@only(refinement=["joint"])
def test_objective_never_rises_and_deviations_are_below_the_prior(variant):
    model, *_ = variant
    history = model.objective_history_
    assert np.all(np.diff(history) <= 1e-9 * np.abs(history).max())
    assert 0 <= model.gradient_norm_ < 0.1
    assert model.camera_noise_ratio_ >= 1
    assert np.all(model.alpha_std_ > 0)
    # On average nothing is known less well than its spread over the frames, which is 1.
    assert np.all(np.mean(model.alpha_std_**2, axis=0) < 1)


# --- the formula --------------------------------------------------------------------


def test_decompose_of_the_fitted_table_gives_the_attributes_to_the_bit(variant):
    model, table, _ = variant
    frames = model.decompose(table)
    assert isinstance(frames, Decomposition)
    assert frames._fields == ("motion", "translation", "alpha", "alpha_std")
    assert_array_equal(frames.motion, model.motion_)
    assert_array_equal(frames.translation, model.translation_)
    assert_array_equal(frames.alpha, model.alpha_)
    if is_joint(model):
        assert_array_equal(frames.alpha_std, model.alpha_std_)
    else:
        assert np.isnan(frames.alpha_std).all()
    assert_array_equal(model.transform(table), model.alpha_)


@pytest.mark.parametrize("which", ["fitted", "new"])
def test_methods_follow_the_formula(variant, which):
    model, table, new = variant
    table = table if which == "fitted" else new
    motion, translation, alpha, _ = model.decompose(table)
    assert_array_equal(model.transform(table), alpha)

    shapes = model.reconstruct(table)
    assert shapes.shape == (len(table), N_POINTS, 3)
    expected = model.mean_shape_ + np.einsum("ik,kjc->ijc", alpha, model.basis_)
    assert_allclose(model.shapes(alpha), expected)
    if is_whole(model):  # with the directions that are not reported
        expected = shapes
    assert_allclose(shapes, expected)
    scale = np.abs(table).max()
    made = tracks_of(model.inverse_transform(alpha, motion, translation), model.layout)
    reported = model_tracks(model, motion, translation, alpha)
    assert_allclose(made, reported, atol=1e-12 * scale, rtol=0)
    expected = shapes @ motion.mT + translation[:, None]
    result = model.reproject(table)
    assert result.shape == table.shape
    found = tracks_of(result, model.layout)
    assert_allclose(found, expected, atol=1e-12 * scale, rtol=0)

    if which == "fitted" and model.loss == "linear":
        tracks = tracks_of(table, model.layout)
        weights = size_weights(model, table)
        centred = tracks - tracks.mean(axis=1, keepdims=True)
        noise = np.sum((tracks - expected) ** 2, axis=(1, 2)) @ weights
        signal = np.sum(centred**2, axis=(1, 2)) @ weights
        assert_allclose(model.inverse_snr_, noise / signal, rtol=1e-8)
        assert noise / signal < 0.01


@only(refinement=["alternating", None])
@pytest.mark.parametrize("which", ["fitted", "new", "missing"])
def test_rigid_cameras_and_linear_least_squares_of_the_paper(variant, which):
    # Camera and position: the rigid fit to the mean shape. Coefficients, and their
    # position: the fit that follows.
    model, table, new = variant
    assert model.refinement or model.n_iter_ == 1
    table = table if which == "fitted" else new.copy()
    tracks = tracks_of(table, model.layout)
    if which == "missing":
        tracks = with_gaps(tracks)
        table = table_of(tracks, model.layout)
    motion, translation, alpha, _ = model.decompose(table)
    for i in range(0, len(table), 7):
        seen = np.isfinite(tracks[i, :, 0])
        points, mean_shape = tracks[i, seen], model.mean_shape_[seen]
        with_position = np.column_stack([mean_shape, np.ones(len(points))])
        M = np.linalg.lstsq(with_position, points)[0][:3].T
        if model.camera != "affine":  # the nearest scaled rotation
            U, values, Vt = np.linalg.svd(M, full_matrices=False)
            scale = 1.0 if model.camera == "orthographic" else values.mean()
            M = scale * U @ Vt
        assert_allclose(motion[i], M, atol=1e-10 * np.abs(M).max())
        of_basis = (model.basis_[:, seen] @ M.T).reshape(len(model.basis_), -1).T
        design = np.hstack([of_basis, np.tile(np.eye(2), (len(points), 1))])
        best = np.linalg.lstsq(design, (points - mean_shape @ M.T).ravel())[0]
        assert_allclose(alpha[i], best[:-2], atol=1e-8 * np.abs(best[:-2]).max())
        assert_allclose(translation[i], best[-2:], rtol=1e-9)


def test_inverse_transform_takes_the_mean_view_by_default():
    model = fitted()
    sizes = 1 / np.sqrt(frame_weights(tracks_of(TABLE), True))
    mean_view = np.mean(model.motion_ / sizes[:, None, None], axis=0)
    expected = mean_view * np.sqrt(np.mean(sizes**2))
    assert_allclose(model.reference_motion_, expected, atol=1e-10)
    assert_allclose(model.reference_translation_, model.translation_.mean(axis=0))

    alpha = model.alpha_[:4]
    table = model.inverse_transform(alpha)
    mean_view = model.reference_motion_, model.reference_translation_
    camera, position = ([each] * 4 for each in mean_view)
    expected = model_tracks(model, camera, position, alpha)
    assert_allclose(tracks_of(table), expected, rtol=1e-12)
    for motion, translation in product((None, mean_view[0], camera), (None, position)):
        found = model.inverse_transform(alpha, motion, translation)
        assert_allclose(found, table, rtol=1e-12)
    # The same coefficients come out again: the table is made by the model.
    # The prior draws them a little to zero.
    assert_allclose(model.transform(table), alpha, atol=model.alpha_std_.max())


def test_large_tables_in_single_precision_have_the_same_noise():
    tracks = make_nonrigid_tracks(700, 210, 1, noise=0.001, random_state=0)
    table = tracks.data.astype(np.float32)
    single, double = (estimator(1).fit(X) for X in (table, table.astype(float)))
    assert_allclose(single.noise_variance_, double.noise_variance_, rtol=1e-3)
    assert_allclose(single.alpha_std_, double.alpha_std_, rtol=1e-3)
    assert_allclose(single.rank_floor_, double.rank_floor_, rtol=1e-4)


@pytest.mark.parametrize("refinement", ["joint", None])
def test_fit_transform_returns_a_copy_of_alpha(refinement):
    model = estimator(refinement=refinement)
    alpha = model.fit_transform(TABLE)
    assert_array_equal(alpha, model.alpha_)
    assert not np.shares_memory(alpha, model.alpha_)


# --- kinds of tables ----------------------------------------------------------------


TABLE_KINDS = {
    "backwards": TABLE[::-1].copy()[::-1],
    "big endian": TABLE.astype(">f8"),
    "pandas": pd.DataFrame(TABLE, columns=FACES.feature_names),
    "polars": pl.DataFrame(TABLE, schema=FACES.feature_names),
}


@pytest.mark.parametrize("kind", TABLE_KINDS)
@may_not_converge
def test_results_do_not_depend_on_how_the_table_is_kept(kind):
    before, table = TABLE.copy(), TABLE_KINDS[kind]
    reference = fitted(refinement="alternating")
    model = clone(reference).fit(table)
    assert_array_equal(TABLE, before)
    assert_allclose(model.alpha_, reference.alpha_, atol=1e-9)
    assert_allclose(model.basis_, reference.basis_, atol=1e-10)
    # New tables may be of another kind than the fitted one, in the same order.
    if kind not in ("pandas", "polars"):
        assert_allclose(model.transform(TABLE), reference.alpha_, atol=1e-9)
        assert_allclose(reference.transform(table), reference.alpha_, atol=1e-9)


# --- errors -------------------------------------------------------------------------


def with_value(value):
    table = TABLE.copy()
    table[7, 3] = value
    return table


def test_columns_that_are_no_points_are_refused():
    table = pd.DataFrame(TABLE, columns=FACES.feature_names)
    for j in range(68):
        table.insert(3 * j + 2, f"likelihood_{j}", 0.9)
    tables = table, pl.DataFrame(dict(table.items()))
    planar, search = estimator(layout="planar"), AffineNRSfMCV([1, 2])
    models = estimator(), planar, search, PseudoInverseNRSfM()
    for model, given in product(models, tables):
        refused(r"not named as the x or y of a point .*landmark", model.fit, given)
    points = landmark_table(table).points
    alphas = [estimator(refinement=None).fit(X).alpha_ for X in (points, TABLE)]
    assert_array_equal(*alphas)


# --- fewer basis shapes than the object has ------------------------------------------


@only(n_components=[1], refinement=["joint"])
def test_too_few_basis_shapes_are_better_than_none(variant):
    # K is not known: shapes must not be worse for it than the mean shape alone.
    model, *_ = variant
    rigid = np.repeat(FACES.shapes.mean(axis=0)[None], N_FRAMES, axis=0)
    error = affine_shape_error(FACES.shapes, model.reconstruct(TABLE))
    assert error < 1.05 * affine_shape_error(FACES.shapes, rigid)


# --- parameters ---------------------------------------------------------------------


@pytest.mark.parametrize(
    "changed",
    [{"layout": "planar"}, {"scale_frames": False}, {"camera": "orthographic"}],
)
def test_parameters_set_after_the_fit_change_nothing(changed):
    model = deepcopy(fitted())
    expected = model.transform(TABLE), model.reproject(TABLE), model.score(TABLE)
    model.set_params(**changed)
    found = model.transform(TABLE), model.reproject(TABLE), model.score(TABLE)
    assert_equal(found, expected)


@pytest.mark.parametrize("refinement", ["joint", "alternating"])
def test_refinement_that_is_cut_short_says_so(refinement):
    model = estimator(4, max_iter=1, tol=0, refinement=refinement)
    with pytest.warns(ConvergenceWarning, match="converge in max_iter=1 st") as caught:
        model.fit(TABLE)
    assert model.n_iter_ == 1
    assert np.isfinite(model.inverse_snr_)
    assert {warning.filename for warning in caught} == {__file__}


@may_not_converge
@pytest.mark.parametrize("isa", slow_after(1, [None, FastISA(n_init=18)]))
def test_same_seed_gives_the_same_result_to_the_bit_for_any_n_jobs(isa):
    options = {"isa": isa, "random_state": 4}
    first, second = (estimator(**options, n_jobs=n).fit(TABLE) for n in (1, 2))
    other = estimator(isa=isa, random_state=5, refinement=None).fit(TABLE)
    for name, value in vars(first).items():
        if isinstance(value, np.ndarray | float | int) and name != "n_jobs":
            assert_array_equal(value, getattr(second, name), err_msg=name)
    assert first.isa_.random_state != other.isa_.random_state
    options["random_state"] = np.random.RandomState(4)
    assert_array_equal(estimator(**options).fit(TABLE).alpha_, first.alpha_)


def test_strategy_keeps_what_it_says_itself_and_gets_the_rest():
    isa = FastISA(n_init=2)
    model = estimator(isa=isa, n_jobs=1, refinement=None).fit(TABLE)
    assert isa.random_state is None  # a clone is fitted
    assert not hasattr(isa, "components_")
    assert isinstance(model.isa_.random_state, int | np.integer)
    assert (model.isa_.n_jobs, model.isa_.n_init) == (1, 2)

    options = {"isa": isa.set_params(random_state=7, n_jobs=1), "n_jobs": 2}
    options["refinement"] = None
    models = [estimator(random_state=i, **options).fit(TABLE) for i in (0, 1, None)]
    for model in models:
        assert (model.isa_.random_state, model.isa_.n_jobs) == (7, 1)
        assert_array_equal(model.alpha_, models[0].alpha_)


class Given(BaseEstimator):
    """A strategy of its own that takes the signals as they are."""

    def __init__(self, rows=None):
        self.rows = rows

    def fit(self, signals):
        n_signals = signals.shape[1]
        self.components_ = np.eye(self.rows or n_signals, n_signals)
        return self


def test_strategies_of_others_can_be_used():
    for isa in (Given(), FastICA(max_iter=2000)):
        model = estimator(2, isa=isa).fit(TABLE)
        assert type(model.isa_) is type(isa)
        assert model.inverse_snr_ < 0.01


def test_verbose_prints_a_line_for_each_stage(capsys):
    estimator(refinement=None).fit(TABLE)
    assert capsys.readouterr().out == ""
    estimator(verbose=1).fit(TABLE)
    lines = capsys.readouterr().out.splitlines()
    assert any("factorisation" in line for line in lines)
    assert any(line.startswith("[FastISA] 3/3 starts") for line in lines)
    assert all(line.startswith(("[AffineNRSfM]", "[FastISA]")) for line in lines)


# --- scikit-learn -------------------------------------------------------------------


def test_another_refinement_leaves_nothing_of_the_joint_one():
    model = AffineNRSfM(1, random_state=0).fit(TABLE)
    assert model.noise_variance_ > 0
    model.set_params(refinement="alternating").fit(TABLE)
    assert not hasattr(model, "noise_variance_")
    refused("joint", model.diagnostics)


# --- calibrated cameras --------------------------------------------------------------

CALIBRATED = ("weak_perspective", "orthographic")


@made_once
def calibrated(camera, refinement="joint"):
    """Return a model with calibrated cameras, to be left as it is, and its table."""
    options = {"camera": camera, "noise": 0.01, "missing": 0.05}
    truth = make_nonrigid_tracks(80, 24, 2, **options, random_state=0)
    model = AffineNRSfM(2, camera=camera, refinement=refinement, random_state=0)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", ConvergenceWarning)
        return model.fit(truth.data), truth


@pytest.mark.parametrize(
    ("camera", "refinement"),
    slow_after(3, product(CALIBRATED, ["joint", "alternating"])),
)
def test_images_are_those_of_scaled_rotations(camera, refinement):
    model, truth = calibrated(camera, refinement)
    S, R, s = model.reconstruct(truth.data), model.rotations_, model.scales_
    assert_allclose(R @ R.mT, np.tile(np.eye(3), (80, 1, 1)), atol=1e-9)
    assert_allclose(np.linalg.det(R), 1)
    assert_allclose(s[:, None, None] * R[:, :2], model.motion_, rtol=1e-9, atol=1e-12)
    images = s[:, None, None] * S @ R[:, :2].mT
    images += model.translation_[:, None]
    reprojected = tracks_of(model.reproject(truth.data))
    assert_allclose(images, reprojected, atol=1e-9 * np.abs(reprojected).max())
    if camera == "orthographic":
        assert_allclose(s, 1, rtol=1e-9)
    decomposed = model.decompose(truth.data)
    assert_allclose(decomposed.motion, model.motion_, rtol=1e-9, atol=1e-12)


@pytest.mark.parametrize("camera", CALIBRATED)
def test_calibrated_shapes_and_rotations_are_the_true_ones(camera):
    model, truth = calibrated(camera)
    convention = "sequence" if camera == "orthographic" else "frame"
    both = (each.reconstruct(truth.data) for each in (model, model.mirrored()))
    errors = [mean_shape_error_3d(truth.shapes, S, convention=convention) for S in both]
    # Both mirror images are as good, for an alignment that may reflect.
    assert errors[0] < 0.01
    assert errors[1] == pytest.approx(errors[0], rel=1e-6)
    true_rows = truth.motion / np.linalg.norm(truth.motion, axis=2, keepdims=True)
    rows = model.rotations_[:, :2]
    U, _, Vt = np.linalg.svd(np.einsum("irc,ird->cd", rows, true_rows))
    angle = np.abs(rows @ (U @ Vt) - true_rows).max()
    assert np.degrees(angle) < 2


@pytest.mark.parametrize(
    ("camera", "refinement"),
    slow_after(
        3, [*product([*CALIBRATED, "affine"], ["joint"]), ("affine", "alternating")]
    ),
)
def test_mirror_images_fit_as_well(camera, refinement):
    model, truth = calibrated(camera, refinement)
    mirrored, X = model.mirrored(), truth.data
    depth = np.array([1.0, 1.0, -1.0])
    for name in ("mean_shape_", "motion_"):
        assert_array_equal(getattr(mirrored, name), getattr(model, name) * depth)
    assert_array_equal(mirrored.transform(X), model.transform(X))
    assert_allclose(mirrored.reproject(X), model.reproject(X))
    assert mirrored.score(X) == pytest.approx(model.score(X))
    shapes = model.reconstruct(X) * depth
    assert_allclose(mirrored.reconstruct(X), shapes, atol=1e-9)
    if camera != "affine":
        assert_allclose(np.linalg.det(mirrored.rotations_), 1)
        assert_allclose(mirrored.rotations_, depth[:, None] * model.rotations_ * depth)
    signs = np.tile(depth, len(model.basis_))
    covariance = model.mode_covariance_ * np.outer(signs, signs)
    assert_allclose(mirrored.mode_covariance_, covariance, rtol=0, atol=1e-15)
    for name in ("basis_", "mode_covariance_"):
        again = getattr(mirrored.mirrored(), name)
        assert_array_equal(again, getattr(model, name))


@pytest.mark.parametrize("camera", ["weak_perspective", "affine"])
def test_shapes_of_fitted_frames(camera):
    model, truth = calibrated(camera)
    X = truth.data[:5].copy()
    X[2] = np.nan
    frames = model.decompose(X)
    reported = model.shapes(frames.alpha.tolist())
    assert_array_equal(model.reconstruct(frames), reported)
    assert np.isnan(model.inverse_transform(frames.alpha)[2]).all()
    if camera != "affine":
        assert_array_equal(model.reconstruct(frames, camera), reported)
        return
    for wanted in (None, "orthographic"):
        shapes = model.reconstruct(frames, wanted)
        assert_array_equal(shapes, model.reconstruct(X, wanted))


@pytest.mark.slow
@pytest.mark.parametrize("camera", [*CALIBRATED, "affine"])
def test_the_number_of_components_is_found(camera):
    truth = make_nonrigid_tracks(150, 40, 2, camera=camera, noise=0.02, random_state=1)
    model = AffineNRSfM("auto", camera=camera, random_state=0).fit(truth.data)
    assert len(model.basis_) == 2
    assert model.get_feature_names_out().tolist() == ["alpha_1", "alpha_2"]
    given = AffineNRSfM(2, camera=camera, random_state=0).fit(truth.data)
    assert_array_equal(model.alpha_, given.alpha_)


@pytest.mark.parametrize("camera", slow_after(1, ["affine", "weak_perspective"]))
@pytest.mark.parametrize("loss", slow_after(2, ["linear", "cauchy", "huber"]))
def test_intervals_of_coefficients_hold(loss, camera, rng):
    truth = make_nonrigid_tracks(200, 10, 2, camera=camera, random_state=0)
    tracks = truth.clean - truth.clean.mean(axis=1, keepdims=True)
    tracks /= np.sqrt(np.mean(tracks**2, axis=(1, 2), keepdims=True))

    def noisy(deviation):
        return (tracks + deviation * rng.normal(size=tracks.shape)).reshape(200, -1)

    model = AffineNRSfM(2, camera=camera, loss=loss, random_state=0).fit(noisy(0.02))
    expected = model.decompose(noisy(0.0)).alpha
    found = model.decompose(np.vstack([noisy(0.02) for _ in range(3)]))
    errors = np.abs(found.alpha - np.tile(expected, (3, 1)))
    assert 0.92 < np.mean(errors < 1.96 * found.alpha_std) < 0.98


@pytest.mark.parametrize(
    ("camera", "truth", "least", "most", "meaning"),
    [
        ("affine", "weak_perspective", 1.0, 1.1, "as well as affine ones"),
        ("weak_perspective", "affine", 10.0, np.inf, "probably not calibrated"),
    ],
)
def test_diagnostics_say_what_the_cameras_are(camera, truth, least, most, meaning):
    made = make_nonrigid_tracks(40, 24, 2, camera=truth, noise=0.02, random_state=0)
    # Affine images have no end in calibrated cameras.
    model = AffineNRSfM(2, camera=camera, tol=1.0, random_state=0).fit(made.data)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", UserWarning)
        found = model.diagnostics()
    assert found.camera_noise_ratio == model.camera_noise_ratio_
    assert least <= found.camera_noise_ratio < most
    assert meaning in found.camera_meaning


test_refusals = refusals_of("estimator", globals())
