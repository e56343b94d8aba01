"""Weights of points: numbers of observations, such as confidences of a tracker."""

import json
from dataclasses import replace
from functools import partial
from typing import NamedTuple

import numpy as np
import pandas as pd
import pytest
import sklearn
from fit_runs import JOINT
from frame_parts import depth_deviations
from layers import slow_after, start_may_not_converge
from made_once import made_once
from numpy.testing import assert_allclose, assert_array_equal
from numpy.typing import NDArray
from refusals import refusals_of, warned
from scenes import table_of, tracks_of, with_gaps
from sklearn.base import clone
from sklearn.pipeline import make_pipeline
from sklearn.preprocessing import StandardScaler

from isa_nrsfm import AffineNRSfM
from isa_nrsfm.datasets import make_nonrigid_tracks
from isa_nrsfm.export import frame_poses
from isa_nrsfm.io import open_table, read_landmarks
from isa_nrsfm.metrics import affine_shape_error

# Of the start, which the joint refinement does not say.
pytestmark = start_may_not_converge

N_FRAMES, N_POINTS, K = 60, 20, 2


class Noisy(NamedTuple):
    """A table whose points have different noise, with the weights of the points."""

    X: NDArray
    weights: NDArray
    shapes: NDArray


@made_once
def noisy(n_points=N_POINTS):
    """Return a table with 1 percent noise, and 30 percent at two of five points."""
    scene = make_nonrigid_tracks(N_FRAMES, n_points, K, random_state=0)
    rng = np.random.default_rng(0)
    size = np.std(scene.tracks - scene.tracks.mean(axis=1, keepdims=True), axis=(1, 2))
    deviation = np.where(rng.random((N_FRAMES, n_points)) < 0.4, 0.3, 0.01)
    noise = rng.normal(size=scene.tracks.shape)
    tracks = scene.tracks + (size[:, None] * deviation)[..., None] * noise
    X = tracks.reshape(N_FRAMES, -1)
    return Noisy(X, (0.01 / deviation) ** 2, scene.shapes)


def estimator(**params):
    return AffineNRSfM(**({"n_components": K, "random_state": 0} | params))


@made_once
def fitted(camera="affine", weighted=True, n_points=N_POINTS):
    """Return the fit of `noisy`."""
    X, weights, _ = noisy(n_points)
    return estimator(camera=camera).fit(X, point_weight=weights if weighted else None)


def without_some():
    """Return weights of one or zero, and the table without the points of zero.

    No point of row 7 is left.
    """
    holed = with_gaps(noisy().X, 0.1, 1)
    holed[7] = np.nan
    return 1.0 * np.isfinite(holed[:, ::2]), holed


def assert_same_fit(found, expected):
    """Compare all numbers of two fitted models to the last bit."""
    names = [name for name in vars(expected) if name.endswith("_") and name != "isa_"]
    assert {"alpha_", "basis_", "noise_variance_", "reliability_"} <= {*names}
    for name in names:
        assert_array_equal(getattr(found, name), getattr(expected, name), name)


class TestMeaning:
    @pytest.mark.parametrize("camera", slow_after(1, ["affine", "weak_perspective"]))
    def test_weights_of_one_change_no_bit(self, camera):
        X, ones = noisy().X, np.ones((N_FRAMES, N_POINTS))
        expected = fitted(camera, weighted=False)
        assert_same_fit(estimator(camera=camera).fit(X, point_weight=ones), expected)
        for method in ("transform", "score"):
            with_ones = getattr(expected, method)(X, point_weight=ones)
            assert_array_equal(with_ones, getattr(expected, method)(X))

    @pytest.mark.parametrize(
        ("layout", "ordered"),
        [("interleaved", np.ascontiguousarray), ("planar", np.asfortranarray)],
    )
    def test_points_of_weight_zero_are_missing(self, layout, ordered):
        weights, holed = without_some()
        tables = (table_of(tracks_of(each), layout) for each in (noisy().X, holed))
        X, holed, weights = map(ordered, (*tables, weights))
        model, empty = estimator(layout=layout), "no point is visible in 1 of 60 rows"
        expected = warned(empty, clone(model).fit, holed)
        assert_same_fit(warned(empty, model.fit, X, point_weight=weights), expected)
        assert_array_equal(np.isnan(model.alpha_).any(axis=1), np.arange(60) == 7)
        assert expected.score(X, point_weight=weights) == expected.score(holed)
        alpha = expected.transform(X, point_weight=weights)
        assert_array_equal(alpha, expected.transform(holed))

    def test_weights_of_missing_points_have_no_effect(self):
        table = noisy()
        X = table.X.copy()
        X[3, 8], X[5, 10:12] = np.nan, np.nan  # a half point, a missing one
        weights = table.weights.copy()
        weights[3, 4], weights[5, 5] = 1.0, 1.0
        expected = warned("only one of", fitted().transform, X, point_weight=weights)
        weights[3, 4], weights[5, 5] = 9.0, 1e20
        with pytest.warns(UserWarning, match="only one of"):
            assert_array_equal(fitted().transform(X, point_weight=weights), expected)

    def test_single_precision_and_scale(self):
        X = noisy().X.astype(np.float32)
        model = estimator().fit(X, point_weight=noisy().weights.astype(np.float32))
        assert model.alpha_.dtype == np.float32
        assert_allclose(model.alpha_, fitted().alpha_, atol=1e-3)


class TestAccuracy:
    @pytest.mark.parametrize(
        ("camera", "n_points"),
        slow_after(2, [("affine", 20), ("affine", 320), ("weak_perspective", 20)]),
    )
    @pytest.mark.filterwarnings("ignore:the table has outliers")  # without weights
    def test_weighted_fits_have_less_error(self, camera, n_points):
        X, _, shapes = noisy(n_points)
        model, plain = (fitted(camera, each, n_points) for each in (True, False))
        found = model.mean_shape_ + np.tensordot(model.alpha_, model.basis_, 1)
        # Errors of 0.4 to 1 % with weights, and 5 to 8 % without them
        error = affine_shape_error(shapes, found)
        most = 0.3 if n_points == N_POINTS else 0.5
        assert error < most * affine_shape_error(shapes, plain.reconstruct(X))

    def test_noise_hardly_depends_on_the_unit_of_the_weights(self):
        model = estimator().fit(noisy().X, point_weight=0.5 * noisy().weights)
        expected = fitted().noise_variance_
        assert model.noise_variance_ == pytest.approx(expected, rel=0.1)
        assert (model.alpha_std_ > 1.2 * fitted().alpha_std_).all()
        assert (model.alpha_std_ < 1.8 * fitted().alpha_std_).all()


# Without weights the noise of the points is larger than that of the fit.
@pytest.mark.filterwarnings("ignore:the points of X lie")
class TestMethods:
    @pytest.mark.parametrize("camera", ["affine", "weak_perspective"])
    def test_agree_with_the_fit(self, camera):
        model, (X, weights, _) = fitted(camera), noisy()
        alpha = model.transform(X, point_weight=weights)
        assert_allclose(alpha, model.alpha_, atol=1e-9)
        found = model.decompose(X, point_weight=weights)
        assert_allclose(found.motion, model.motion_, atol=1e-9)
        assert_allclose(found.translation, model.translation_, atol=1e-9)
        assert_allclose(found.alpha_std, model.alpha_std_, rtol=1e-6)
        # In no order of time
        smooth = model.smooth(X, point_weight=weights)
        assert_allclose(smooth.alpha, alpha, atol=1e-9)
        assert_allclose(smooth.alpha_std, model.alpha_std_, rtol=1e-6)
        alone = model.transform(X[4:5], point_weight=weights[4:5])
        assert_allclose(alone[0], alpha[4], atol=1e-9)
        assert np.abs(model.transform(X) - alpha).max() > 0.1

    def test_cameras_depend_on_ratios_of_tiny_weights(self):
        few, tiny = (
            fitted().decompose(noisy().X, point_weight=scale * noisy().weights).motion
            for scale in (1e-6, 1e-10)
        )
        assert_allclose(tiny, few, atol=1e-3 * np.abs(few).max())

    def test_score_counts_points_by_weight(self, rng):
        model, (X, weights, _) = fitted(), noisy()
        # 1e-4 of the noise plus that of the predictions; 0.04 without weights
        assert -1e-3 < model.score(X, point_weight=weights) < -1e-4
        assert model.score(X) < -0.01
        assert model.score(X, point_weight=rng.permuted(weights, axis=1)) < -0.01

    def test_frames_with_weights_are_frames_with_repeated_points(self, rng):
        """For all that is computed of a frame: the linearisation, errors of depths."""
        frames = fitted("weak_perspective")._model.frames
        frames = replace(frames, certainty=fitted()._model.frames.certainty)
        counts = rng.integers(0, 4, N_POINTS)
        many = np.repeat(np.arange(N_POINTS), counts)
        shapes = frames.shapes[:, :, many]
        shapes = shapes - shapes.mean(axis=2, keepdims=True)
        repeated = replace(frames, shapes=shapes)
        tracks = noisy().X.reshape(N_FRAMES, -1, 2)[:6]
        weights = np.tile(counts.astype(float), (6, 1))
        holed = np.where(weights[..., None] > 0, tracks, np.nan)
        holed = holed - np.nanmean(holed, axis=1, keepdims=True)
        rows = holed.transpose(0, 2, 1)
        sizes = np.nanstd(rows, axis=(1, 2))
        found = frames.linearised(rows, sizes, weights)
        expected = repeated.linearised(rows[:, :, many], sizes)
        for name in ("motion", "alpha", "covariance", "precision"):
            found_here, here = getattr(found, name), getattr(expected, name)
            assert_allclose(found_here, here, rtol=1e-5, atol=1e-7 * np.abs(here).max())
        found = depth_deviations(frames, rows, sizes, weights)
        expected = depth_deviations(repeated, rows[:, :, many], sizes)
        assert_allclose(found[:, many], expected, rtol=1e-5)

    def test_all_methods_leave_out_points_of_weight_zero(self):
        model, X = fitted("weak_perspective"), noisy().X
        weights, holed = without_some()
        few = {"max_iter": 2, "tol": 0.0}
        for call in (
            model.rotation_covariance,
            model.reconstruct,
            partial(model.reconstruct, return_std=True),
            lambda *args, **options: model.smooth(*args, **few, **options).alpha_std,
            partial(frame_poses, model),
        ):
            for found, expected in zip(
                call(X, point_weight=weights), call(holed), strict=True
            ):
                assert_array_equal(found, expected)


class TestRouting:
    """Metadata routing of scikit-learn."""

    @pytest.fixture(autouse=True)
    def routing(self):
        with sklearn.config_context(enable_metadata_routing=True):
            yield

    def test_pipeline(self):
        X, weights, _ = noisy()
        model = estimator().set_fit_request(point_weight=True)
        model.set_transform_request(point_weight=True)
        pipeline = make_pipeline(model, StandardScaler())
        found = pipeline.fit_transform(X, point_weight=weights)
        assert_allclose(found, StandardScaler().fit_transform(fitted().alpha_))
        again = pipeline.transform(X, point_weight=weights)
        assert_allclose(again, found, atol=1e-9)


def with_weight(value, method="fit"):
    """Call a method with a weight of this value in row 2, point 3."""
    weights = noisy().weights.copy()
    weights[2, 3] = value
    model = estimator() if method == "fit" else fitted()
    return getattr(model, method)(noisy().X, point_weight=weights)


def few_weights(least):
    """Return weights whose sum is a little below the least number of each frame."""
    return noisy().weights * (0.99 * least * N_FRAMES / noisy().weights.sum())


def mapped(folder):
    np.save(folder / "table.npy", noisy().X)
    return np.load(folder / "table.npy", mmap_mode="r")


def in_files(folder):
    for name, part in zip("ab", np.split(noisy().X, 2), strict=True):
        np.save(folder / f"{name}.npy", part)
    return open_table(folder)


def written_table(folder, **further):
    """Return a file of points without confidences."""
    names = [f"{axis}_{j}" for j in range(N_POINTS) for axis in "xy"]
    table = pd.DataFrame(noisy().X, columns=names).assign(**further)
    table.to_csv(path := folder / "table.csv", index=False)
    return path


def keypoints(folder):
    """Return a file of keypoints with their confidences."""
    X, weights, _ = noisy()
    points = np.dstack([100 * X.reshape(N_FRAMES, -1, 2) + 300, weights])
    points[4, 3, 2] = 0.0
    rows = [
        {"image_id": i, "category_id": 1, "keypoints": row.ravel().tolist()}
        for i, row in enumerate(points)
    ]
    (path := folder / "results.json").write_text(json.dumps(rows))
    return path


@pytest.mark.slow
def test_all_results_of_some_points_are_weighted(tmp_path, succeeds):
    results = keypoints(tmp_path)
    options = ["--weights", "confidence"]
    options += ["--points", "without:3,7", "--fps", 25, "--std"]
    succeeds("fit", results, *options, "-o", tmp_path / "out", "-k", 2, *JOINT)
    left, found = np.delete(np.arange(N_POINTS), [3, 7]), read_landmarks(results)
    X = found.points.to_numpy().reshape(N_FRAMES, -1, 2)[:, left]
    X = X.reshape(N_FRAMES, -1)
    weights = {"point_weight": found.confidence.to_numpy()[:, left]}
    model = estimator(camera="weak_perspective").fit(X, **weights)
    cameras = pd.read_csv(tmp_path / "out" / "cameras.csv")
    poses = frame_poses(model, X, **weights)
    for name in ("yaw", "roll", "pitch_std"):
        assert_allclose(cameras[name], getattr(poses, name), atol=1e-6)
    table = pd.read_csv(tmp_path / "out" / "alpha.csv")
    assert_allclose(table[["alpha_1", "alpha_2"]], model.alpha_, atol=1e-6)
    report = json.loads((tmp_path / "out" / "report.json").read_text())["model"]
    expected = -model.score(X, **weights)
    assert report["held_out_error"] == pytest.approx(expected, rel=1e-4)
    smooth = model.smooth(X, time=np.arange(N_FRAMES) / 25, **weights)
    assert_allclose(table["alpha_1_smooth"], smooth.alpha[:, 0], atol=1e-6)
    saved, new = tmp_path / "out" / "model.npz", tmp_path / "new.csv"
    succeeds("transform", saved, results, *options[:2], "-o", new)
    again = pd.read_csv(new)[["alpha_1", "alpha_2"]]
    assert_allclose(again, model.alpha_, atol=1e-6)


SCORES = {f"c_{j}": "good" if j == 3 else 1.0 for j in range(N_POINTS)}
WEIGHTED = "--weights confidence --no-figures -k"
test_refusals = refusals_of("point_weights", globals())
