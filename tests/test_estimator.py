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
from refusals import refusals_of
from scenes import measurements, table_of, tracks_of, with_gaps
from sklearn.base import BaseEstimator, clone
from sklearn.decomposition import FastICA
from sklearn.exceptions import ConvergenceWarning

from isa_nrsfm import AffineNRSfM, FastISA, PooledFastICA
from isa_nrsfm.datasets import make_face_tracks, make_nonrigid_tracks
from isa_nrsfm.metrics import affine_shape_error, mean_shape_error_3d

N_FRAMES, N_POINTS, K = 50, 30, 2
ONLY_JOINT = "alpha_std_ noise_variance_ camera_noise_ratio_ reliability_".split()
ONLY_JOINT += ["objective_history_", "gradient_norm_"]


@made_once
def scene(camera="weak_perspective"):
    """Return a scene, of which the first frames are fitted and the others are new."""
    options = {"camera": camera, "noise": 0.01, "random_state": 0}
    return make_nonrigid_tracks(80, N_POINTS, K, **options)


TRUTH = scene()
TABLE = TRUTH.data[:N_FRAMES]
WITH_NAMES = pd.DataFrame(TABLE, columns=TRUTH.feature_names)


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
    sizes = np.var(tracks, axis=1).mean(axis=1)
    return 1 / sizes if scale_frames else np.full(len(tracks), 1 / sizes.mean())


def scales_frames(model):
    """Return whether frames count alike; those of orthographic cameras never do."""
    return model.scale_frames and model.camera != "orthographic"


# Models by their parameters; those of the paper have no joint refinement.
JOINT = {
    "joint": {},
    "one shape": {"n_components": 1, "layout": "planar", "scale_frames": False},
    "coefficients": {"isa": PooledFastICA(n_init=3), "independence": "coefficients"},
    "weak_perspective": {"camera": "weak_perspective", "layout": "planar"},
    "orthographic": {"camera": "orthographic"},
}
PAPER = {
    "paper": {"refinement": "alternating", "block_recovery": "irls"},
    "six shapes": {"n_components": 6, "refinement": "alternating"},
    "no refinement": {"refinement": None, "layout": "planar", "scale_frames": False},
    "weak and no refinement": {"refinement": None, "camera": "weak_perspective"},
    "orthographic paper": {"refinement": "alternating", "camera": "orthographic"},
}
PARAMETERS = JOINT | PAPER


@made_once
def made(name):
    """Return a fitted model, to be left as it is."""
    model = estimator(**PARAMETERS[name])
    with warnings.catch_warnings(action="ignore", category=ConvergenceWarning):
        return model.fit(table_for(model))


def truth_for(model):
    seen = {"affine": "weak_perspective"}
    return scene(seen.get(model.camera, model.camera))


def tracks_for(model):
    """Return the tracks that a model is fitted to."""
    return truth_for(model).tracks[:N_FRAMES]


def table_for(model):
    return table_of(tracks_for(model), model.layout)


@pytest.fixture(params=PARAMETERS)
def model(request):
    """Return a fitted model."""
    return made(request.param)


def only(names):
    """Return a decorator for tests of some models."""
    return pytest.mark.parametrize("model", names, indirect=True)


# --- attributes ---------------------------------------------------------------------


@pytest.mark.parametrize("refinement", ["joint", "alternating"])
def test_attributes_and_results_have_the_documented_shapes_and_types(refinement):
    table, reference = TABLE.astype(np.float32), fitted(refinement)
    model = clone(reference).fit(table)
    single = {
        "mean_shape_": (N_POINTS, 3),
        "basis_": (K, N_POINTS, 3),
        "alpha_": (N_FRAMES, K),
        "motion_": (N_FRAMES, 2, 3),
        "translation_": (N_FRAMES, 2),
        "reference_motion_": (2, 3),
        "reference_translation_": (2,),
    }
    double = {
        "mode_covariance_": (3 * K, 3 * K),
        "singular_values_": (3 * K + 3,),
        "energy_share_": (K,),
    }
    numbers = ["inverse_snr_", "rank_floor_"]
    if refinement == "joint":
        single["alpha_std_"] = (N_FRAMES, K)
        double["reliability_"] = (K,)
        double["objective_history_"] = (model.n_iter_ + 1,)
        numbers += ["noise_variance_", "camera_noise_ratio_", "gradient_norm_"]
    else:
        assert not any(hasattr(model, name) for name in ONLY_JOINT)
    for shapes, dtype in ((single, np.float32), (double, np.float64)):
        found = {name: getattr(model, name) for name in shapes}
        assert {name: value.shape for name, value in found.items()} == shapes
        assert {value.dtype for value in found.values()} == {np.dtype(dtype)}
        assert all(np.isfinite(value).all() for value in found.values())
        assert all(getattr(reference, name).dtype == np.float64 for name in shapes)
    assert all(isinstance(getattr(model, name), float) for name in numbers)
    assert type(model.n_iter_) is int
    assert (model.n_components_, model.n_features_in_) == (K, 2 * N_POINTS)

    alpha, *parts = model.transform(table), *model.decompose(table)
    parts += [model.reconstruct(table), model.reproject(table)]
    parts += [model.inverse_transform(alpha), model.reconstruct(table, "orthographic")]
    assert {part.dtype for part in (alpha, *parts)} == {np.dtype(np.float32)}
    # Cameras and coefficients are computed in double precision from shapes that were
    # rounded to single precision.
    assert_array_equal(alpha, model.alpha_)
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


def test_singular_values_and_rank_floor_are_those_of_the_measurement_matrix(model):
    W = measurements(tracks_for(model), scales_frames(model))
    S = np.linalg.svd(W, compute_uv=False)
    rank = 3 * model.n_components + 3
    assert_allclose(model.rank_floor_, np.sum(S[rank:] ** 2) / np.sum(S**2), rtol=1e-9)
    # Directions that are not reported explain more than K.
    least = 0 if is_whole(model) else model.rank_floor_
    assert 0 < model.rank_floor_ < 1
    assert least < model.inverse_snr_ < 1
    # In the unit of the table or as a ratio: their proportions are the same.
    unit = 1 if scales_frames(model) else model.singular_values_[0] / S[0]
    assert_allclose(model.singular_values_, unit * S[:rank], rtol=1e-9)


def test_mode_covariance(model):
    tracks = tracks_for(model)
    C = model.mode_covariance_
    assert_allclose(C, C.T, atol=1e-12 * np.abs(C).max())
    assert np.linalg.eigvalsh(C)[0] > -1e-12 * np.trace(C)
    if is_joint(model):
        # (1 / 2I) sum_i (alpha_i alpha_i^T) (x) (M_i^T M_i), of frames of size one
        weights = (
            frame_weights(tracks, True) if scales_frames(model) else np.ones(N_FRAMES)
        )
        alpha, motion = model.alpha_, model.motion_
        parts = weights[:, None] * alpha, alpha, motion, motion
        expected = np.einsum("ik,im,irc,ird->kcmd", *parts) / (2 * N_FRAMES)
        tolerance = 1e-10 * np.abs(C).max()
        assert_allclose(C, expected.reshape(C.shape), atol=tolerance)
        return
    # Block k is (W Q)^T (W Q) / 2I, in other axes, for an orthonormal basis Q of the
    # subspace that the three coordinates of basis shape k span.
    W = measurements(tracks, scales_frames(model))
    for k, shape in enumerate(model.basis_):
        motion, rows = W @ np.linalg.qr(shape)[0], slice(3 * k, 3 * k + 3)
        expected = np.linalg.eigvalsh(motion.T @ motion / len(W))
        assert_allclose(np.linalg.eigvalsh(C[rows, rows]), expected, rtol=1e-6)


def test_shapes_are_centred_and_pure(model):
    # The joint refinement's basis shapes have no part along the mean shape (white with
    # affine cameras), tr(B_k^T B_0) = 0, where scales of cameras would absorb it, and
    # the mean of the coefficients is zero. The paper's are orthogonal: B_k B_l^T = 0
    # for k != l, the mean shape included.
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


def test_coefficients_have_unit_variance_and_energy_decreases(model):
    assert_allclose(model.alpha_.std(axis=0), 1, rtol=1e-9)
    assert np.all(np.mean(model.alpha_**3, axis=0) > 0)
    assert np.all(np.diff(model.energy_share_) < 0)
    images = np.einsum("irc,kjc->ikjr", model.motion_, model.basis_)
    of_frames = model.alpha_**2 * np.sum(images**2, axis=(2, 3))
    energy = frame_weights(tracks_for(model), scales_frames(model)) @ of_frames
    # Directions that are not reported have the rest.
    share = model.energy_share_
    assert_allclose(share / share.sum(), energy / energy.sum(), rtol=1e-9)
    assert 0.9 < share.sum() < 1 + 1e-9


@only(JOINT)
def test_objective_never_rises_and_deviations_are_below_the_prior(model):
    history = model.objective_history_
    assert np.all(np.diff(history) <= 1e-9 * np.abs(history).max())
    assert 0 <= model.gradient_norm_ < 0.1
    assert model.camera_noise_ratio_ >= 1
    assert np.all(model.alpha_std_ > 0)
    # On average nothing is known less well than its spread over the frames, which is 1.
    assert np.all(np.mean(model.alpha_std_**2, axis=0) < 1)


# --- the formula --------------------------------------------------------------------


def test_methods_follow_the_formula(model):
    for tracks in np.split(truth_for(model).tracks, [N_FRAMES]):
        table = table_of(tracks, model.layout)
        motion, translation, alpha, deviations = frames = model.decompose(table)
        assert frames._fields == ("motion", "translation", "alpha", "alpha_std")
        assert_array_equal(model.transform(table), alpha)
        shapes = model.reconstruct(table)
        expected = model.mean_shape_ + np.einsum("ik,kjc->ijc", alpha, model.basis_)
        assert_allclose(model.shapes(alpha), expected)
        if not is_whole(model):  # without directions that are not reported
            assert_allclose(shapes, expected)
        tolerance = {"atol": 1e-12 * np.abs(table).max(), "rtol": 0}
        images = model.inverse_transform(alpha, motion, translation)
        expected = model_tracks(model, motion, translation, alpha)
        assert_allclose(tracks_of(images, model.layout), expected, **tolerance)
        found = tracks_of(model.reproject(table), model.layout)
        expected = shapes @ motion.mT + translation[:, None]
        assert_allclose(found, expected, **tolerance)
        if len(tracks) == N_FRAMES:
            attributes = model.motion_, model.translation_, model.alpha_
            assert_equal(frames[:3], attributes)  # to the bit
            known = model.alpha_std_ if is_joint(model) else np.full_like(alpha, np.nan)
            assert_array_equal(deviations, known)
            weights = frame_weights(tracks, scales_frames(model))
            noise = np.sum((tracks - found) ** 2, axis=(1, 2)) @ weights
            signal = np.var(tracks, axis=1).sum(axis=1) @ weights * N_POINTS
            assert_allclose(model.inverse_snr_, noise / signal, rtol=1e-8)
            assert noise / signal < 0.03


@only(PAPER)
@pytest.mark.parametrize("missing", [0.0, 0.3])
def test_rigid_cameras_and_linear_least_squares_of_the_paper(model, missing):
    # Camera and position: the rigid fit to the mean shape. Coefficients, and their
    # position: the fit that follows.
    assert model.refinement or model.n_iter_ == 1
    tracks = with_gaps(truth_for(model).tracks[::7], missing)
    motion, translation, alpha, _ = model.decompose(table_of(tracks, model.layout))
    for i, points in enumerate(tracks):
        seen = np.isfinite(points[:, 0])
        points, mean_shape = points[seen], model.mean_shape_[seen]
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
    faces = make_face_tracks(40, n_components=K, random_state=0)
    model = estimator().fit(faces.data)
    sizes = 1 / np.sqrt(frame_weights(faces.tracks, True))
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


# --- kinds of tables ----------------------------------------------------------------


@may_not_converge
def test_results_do_not_depend_on_how_the_table_is_kept():
    before, reference = TABLE.copy(), fitted(refinement="alternating")
    arrays = TABLE[::-1].copy()[::-1], TABLE.astype(">f8")
    for table in (*arrays, WITH_NAMES, pl.DataFrame(dict(WITH_NAMES.items()))):
        model = clone(reference)
        alpha = model.fit_transform(table)
        assert_array_equal(TABLE, before)
        assert_array_equal(alpha, model.alpha_)
        assert not np.shares_memory(alpha, model.alpha_)
        assert_allclose(alpha, reference.alpha_, atol=1e-9)
        assert_allclose(model.basis_, reference.basis_, atol=1e-10)
    # New tables may be of another kind than the fitted one, in the same order.
    for table in arrays:
        assert_allclose(reference.transform(table), reference.alpha_, atol=1e-9)


# --- errors -------------------------------------------------------------------------


WITH_SCORES = WITH_NAMES.assign(likelihood_0=0.9, likelihood_1=0.8)


def with_value(value):
    table = TABLE.copy()
    table[7, 3] = value
    return table


# --- fewer basis shapes than the object has ------------------------------------------


def test_too_few_basis_shapes_are_better_than_none():
    # K is not known: shapes must not be worse for it than the mean shape alone.
    model, shapes = made("one shape"), TRUTH.shapes[:N_FRAMES]
    rigid = np.broadcast_to(shapes.mean(axis=0), shapes.shape)
    error = affine_shape_error(shapes, model.reconstruct(table_for(model)))
    assert error < 1.05 * affine_shape_error(shapes, rigid)


# --- parameters ---------------------------------------------------------------------


def test_parameters_set_after_the_fit_change_nothing():
    model = deepcopy(fitted())
    expected = model.transform(TABLE), model.reproject(TABLE), model.score(TABLE)
    model.set_params(layout="planar", scale_frames=False, camera="orthographic")
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
def test_same_seed_gives_the_same_result_to_the_bit_for_any_n_jobs():
    options, state = {"random_state": 4}, np.random.RandomState(4)
    first, second = (estimator(**options, n_jobs=n).fit(TABLE) for n in (1, 2))
    for name, value in vars(first).items():
        if isinstance(value, np.ndarray | float | int) and name != "n_jobs":
            assert_array_equal(value, getattr(second, name), err_msg=name)
    options |= {"random_state": state, "refinement": None}
    models = [estimator(**options).fit(TABLE) for _ in range(2)]
    seeds = [model.isa_.random_state for model in models]
    assert first.isa_.random_state == seeds[0] != seeds[1]


def test_strategy_keeps_what_it_says_itself_and_gets_the_rest():
    isa = FastISA(n_init=2)
    model = estimator(isa=isa, n_jobs=1, refinement=None).fit(TABLE)
    assert not hasattr(isa, "components_")  # a clone is fitted
    assert isinstance(model.isa_.random_state, int | np.integer)
    assert (model.isa_.n_jobs, model.isa_.n_init) == (1, 2)
    isa.set_params(random_state=7, n_jobs=1)
    model = estimator(isa=isa, n_jobs=2, refinement=None).fit(TABLE)
    assert (model.isa_.random_state, model.isa_.n_jobs) == (7, 1)


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
    estimator(verbose=1, refinement=None).fit(TABLE)
    lines = capsys.readouterr().out.splitlines()
    assert any("factorisation" in line for line in lines)
    assert any(line.startswith("[FastISA] 3/3 starts") for line in lines)
    assert all(line.startswith(("[AffineNRSfM]", "[FastISA]")) for line in lines)


def test_another_refinement_leaves_nothing_of_the_joint_one():
    model = deepcopy(fitted()).set_params(refinement="alternating").fit(TABLE)
    assert not any(hasattr(model, name) for name in ONLY_JOINT)


# --- calibrated cameras --------------------------------------------------------------

CALIBRATED = ["weak_perspective", "orthographic"]


@only([*CALIBRATED, "orthographic paper"])
def test_images_are_those_of_scaled_rotations(model):
    table, R, s = table_for(model), model.rotations_, model.scales_
    S = model.reconstruct(table)
    assert_allclose(R @ R.mT, np.tile(np.eye(3), (N_FRAMES, 1, 1)), atol=1e-9)
    assert_allclose(np.linalg.det(R), 1)
    assert_allclose(s[:, None, None] * R[:, :2], model.motion_, rtol=1e-9, atol=1e-12)
    images = s[:, None, None] * S @ R[:, :2].mT
    images += model.translation_[:, None]
    reprojected = tracks_of(model.reproject(table), model.layout)
    assert_allclose(images, reprojected, atol=1e-9 * np.abs(reprojected).max())
    if model.camera == "orthographic":
        assert_allclose(s, 1, rtol=1e-9)


@only(CALIBRATED)
def test_calibrated_shapes_and_rotations_are_the_true_ones(model):
    table, truth = table_for(model), truth_for(model)
    convention = "sequence" if model.camera == "orthographic" else "frame"
    errors = [
        mean_shape_error_3d(truth.shapes[:N_FRAMES], S, convention=convention)
        for S in (model.reconstruct(table), model.mirrored().reconstruct(table))
    ]
    assert model.camera_noise_ratio_ < 1.1  # as good as affine cameras
    # Both mirror images are as good, for an alignment that may reflect.
    assert errors[0] < 0.01
    assert errors[1] == pytest.approx(errors[0], rel=1e-6)
    true_rows = truth.motion[:N_FRAMES]
    true_rows = true_rows / np.linalg.norm(true_rows, axis=2, keepdims=True)
    rows = model.rotations_[:, :2]
    U, _, Vt = np.linalg.svd(np.einsum("irc,ird->cd", rows, true_rows))
    angle = np.abs(rows @ (U @ Vt) - true_rows).max()
    assert np.degrees(angle) < 2


@only(["weak_perspective", "joint"])
def test_mirror_images_fit_as_well(model):
    mirrored, X = model.mirrored(), table_for(model)
    depth = np.array([1.0, 1.0, -1.0])
    for name in ("mean_shape_", "basis_", "motion_"):
        assert_array_equal(getattr(mirrored, name), getattr(model, name) * depth)
    assert_array_equal(mirrored.transform(X), model.transform(X))
    assert_allclose(mirrored.reproject(X), model.reproject(X))
    assert mirrored.score(X) == pytest.approx(model.score(X))
    shapes = model.reconstruct(X) * depth
    assert_allclose(mirrored.reconstruct(X), shapes, atol=1e-9)
    if model.camera != "affine":
        assert_allclose(np.linalg.det(mirrored.rotations_), 1)
        assert_allclose(mirrored.rotations_, depth[:, None] * model.rotations_ * depth)
    signs = np.tile(depth, len(model.basis_))
    covariance = model.mode_covariance_ * np.outer(signs, signs)
    assert_allclose(mirrored.mode_covariance_, covariance, rtol=0, atol=1e-15)


@only(["weak_perspective", "joint"])
def test_shapes_of_fitted_frames(model):
    X = table_for(model)[:5].copy()
    X[2] = np.nan
    frames = model.decompose(X)
    reported = model.shapes(frames.alpha.tolist())
    assert_array_equal(model.reconstruct(frames), reported)
    assert np.isnan(model.inverse_transform(frames.alpha)[2]).all()
    if model.camera == "affine":
        euclidean = model.reconstruct(X, "orthographic")
        assert_array_equal(model.reconstruct(frames, "orthographic"), euclidean)
    else:
        assert_array_equal(model.reconstruct(frames, model.camera), reported)


@pytest.mark.parametrize("loss", slow_after(2, ["linear", "cauchy", "huber"]))
def test_intervals_of_coefficients_hold(loss, rng):
    truth = make_nonrigid_tracks(200, 10, 2, camera="affine", random_state=0)
    tracks = truth.clean - truth.clean.mean(axis=1, keepdims=True)
    tracks /= np.sqrt(np.mean(tracks**2, axis=(1, 2), keepdims=True))

    def noisy(deviation):
        return (tracks + deviation * rng.normal(size=tracks.shape)).reshape(200, -1)

    model = AffineNRSfM(2, loss=loss, random_state=0).fit(noisy(0.02))
    expected = model.decompose(noisy(0.0)).alpha
    found = model.decompose(np.vstack([noisy(0.02) for _ in range(3)]))
    errors = np.abs(found.alpha - np.tile(expected, (3, 1)))
    assert 0.92 < np.mean(errors < 1.96 * found.alpha_std) < 0.98


def meaning_of(ratio):
    """Return what diagnostics make of a ratio of noise variances."""
    model = deepcopy(made("weak_perspective"))
    model.camera_noise_ratio_ = ratio
    return model.diagnostics().camera_meaning


test_refusals = refusals_of("estimator", globals())
