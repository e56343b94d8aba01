"""What the baselines have in common: scikit-learn's contract, invariances, errors."""

import pickle
from functools import cache

import numpy as np
import pandas as pd
import pytest
from baseline_scenes import camera_frame, exact_table
from estimator_contract import (
    EXTRA_CHECKS,
    NARROW_TABLE_CHECKS,
    assert_only_narrow_tables_fail,
)
from numpy.testing import assert_allclose, assert_array_equal
from scipy.spatial.transform import Rotation
from sklearn.base import clone
from sklearn.linear_model import LogisticRegression
from sklearn.pipeline import make_pipeline
from sklearn.utils import estimator_checks
from sklearn.utils.estimator_checks import parametrize_with_checks

from isa_nrsfm._tables.layout import table_to_tracks, tracks_to_table
from isa_nrsfm.baselines import BlockMatrixNRSfM, PseudoInverseNRSfM
from isa_nrsfm.metrics import inverse_snr

METHODS = [PseudoInverseNRSfM, BlockMatrixNRSfM]
both_methods = pytest.mark.parametrize("method", METHODS)


def table(seed=0, noise=0.01, **parameters):
    return exact_table(seed, noise=noise, **parameters)


@cache
def fitted(method, scale_frames=False, ordered=False):
    """Return a model of the table that has no special parameters, to be left alone."""
    return method(2, scale_frames=scale_frames, ordered=ordered).fit(table().data)


def turned(X, angle):
    c, s = np.cos(angle), np.sin(angle)
    tracks = table_to_tracks(X) @ np.array([[c, -s], [s, c]]).T
    return tracks_to_table(tracks)


# The tables of the checks have no layout, and some of them have names, some not; one
# check allows too few steps.
no_warnings = pytest.mark.filterwarnings(
    "ignore:layout=:UserWarning",
    "ignore:X does not have valid feature names:UserWarning",
    "ignore:X has feature names:UserWarning",
    "ignore::sklearn.exceptions.ConvergenceWarning",
)


class TestContract:
    # Their base class does what the checks look at; the raw ones are for both.
    @pytest.mark.slow
    @no_warnings
    @parametrize_with_checks(
        [BlockMatrixNRSfM(n_components=1)],
        expected_failed_checks=lambda estimator: {
            "check_estimators_nan_inf": "feeds tables that are not widened"
        },
        xfail_strict=True,
    )
    def test_on_landmark_tables(self, estimator, check, landmark_tables):
        check(estimator)

    @both_methods
    def test_raw(self, method):
        # The pseudo-inverse method has no steps to count.
        expected = {
            name: reason
            for name, reason in NARROW_TABLE_CHECKS.items()
            if name != "check_transformer_n_iter" or method is BlockMatrixNRSfM
        }
        assert_only_narrow_tables_fail(method(n_components=1), expected)

    @no_warnings
    @pytest.mark.parametrize(
        ("method", "name"),
        [
            # What is set for all estimators goes the way of what is set for one, and
            # polars that of pandas.
            *(
                (PseudoInverseNRSfM, name)
                for name in EXTRA_CHECKS
                if "global" not in name and "polars" not in name
            ),
            (BlockMatrixNRSfM, "check_param_validation"),
        ],
    )
    def test_extra_checks_on_landmark_tables(self, method, name, landmark_tables):
        getattr(estimator_checks, name)(method.__name__, method(n_components=1))

    @both_methods
    def test_in_a_pipeline(self, method):
        truth = table(n_frames=80)
        labels = truth.alpha[:, 0] > 0
        model = make_pipeline(method(2), LogisticRegression())
        model = clone(model).fit(truth.data, labels)
        assert_array_equal(model[:-1].transform(truth.data), model[0].alpha_)
        if method is BlockMatrixNRSfM:
            assert model.score(truth.data, labels) > 0.9

    @both_methods
    def test_names(self, method):
        X = table().data
        names = [f"{axis}{j}" for j in range(30) for axis in "xy"]
        frame = pd.DataFrame(X, columns=names)
        model = method(2).set_output(transform="pandas").fit(frame)
        prefix = method.__name__.lower()
        shown = model.transform(frame)
        assert list(shown.columns) == [f"{prefix}0", f"{prefix}1"]
        assert_allclose(shown, fitted(method).alpha_)
        planar = frame[sorted(names)]
        with pytest.raises(ValueError, match="contradicts the column names"):
            method(2).fit(planar)

    @both_methods
    def test_pickles(self, method):
        model = fitted(method)
        again = pickle.loads(pickle.dumps(model))
        assert_array_equal(again.transform(table().data), model.alpha_)


class TestFitted:
    @both_methods
    @pytest.mark.parametrize("scale_frames", [False, True])
    def test_definitions(self, method, scale_frames):
        truth = table(noise=0.02)
        X = truth.data
        model = method(2, scale_frames=scale_frames).fit(X)
        images = model.shapes_ @ model.motion_.swapaxes(1, 2)
        images += model.translation_[:, None]
        measured = inverse_snr(X, tracks_to_table(images), scale_frames=scale_frames)
        assert model.inverse_snr_ == pytest.approx(measured)
        centroids = truth.tracks.mean(axis=1)
        assert_allclose(model.translation_, centroids)
        tracks = truth.tracks - centroids[:, None]
        size = np.sqrt(np.mean(tracks**2, axis=(1, 2))) if scale_frames else 1.0
        gram = model.motion_ @ model.motion_.swapaxes(1, 2)
        identity = np.broadcast_to(np.eye(2), gram.shape)
        assert_allclose(gram / np.reshape(size**2, (-1, 1, 1)), identity, atol=1e-12)
        assert_allclose(model.mean_shape_, model.shapes_.mean(axis=0), atol=1e-12)
        rows = model.shapes_.reshape(len(X), -1)
        assert np.linalg.matrix_rank(rows, tol=1e-9 * np.linalg.norm(rows)) == 3
        deformation = rows - rows.mean(axis=0)
        values = np.linalg.svd(deformation, compute_uv=False)[:2] / np.sqrt(len(X))
        sizes = np.linalg.norm(model.basis_, axis=(1, 2))
        assert_allclose(sizes, values)

    @both_methods
    def test_noise_variance(self, method):
        truth = table(noise=0.02)
        model = method(2).fit(truth.data)
        basis = model.basis_.reshape(2, -1)
        rest = (model.shapes_ - model.mean_shape_).reshape(len(truth.data), -1)
        nearest = rest @ np.linalg.pinv(basis) @ basis
        shapes = model.mean_shape_ + nearest.reshape(model.shapes_.shape)
        images = shapes @ model.motion_.swapaxes(1, 2) + model.translation_[:, None]
        error = np.mean((truth.tracks - images) ** 2)
        assert model.noise_variance_ == pytest.approx(error)

    @both_methods
    @pytest.mark.parametrize("scale_frames", [False, True])
    def test_transform_gives_the_coefficients_again(self, method, scale_frames):
        X = table().data
        model = fitted(method, scale_frames)
        assert_array_equal(model.transform(X), model.alpha_)
        assert_array_equal(clone(model).fit_transform(X), model.alpha_)
        assert_allclose(model.transform(X[7:9]), model.alpha_[7:9], atol=1e-7)

    def test_model_is_near_to_the_shapes(self):
        truth = table(n_frames=150)
        model = BlockMatrixNRSfM(2).fit(truth.data)
        size = np.linalg.norm(model.shapes_)
        rest = np.linalg.norm(model.reconstruct(truth.data) - model.shapes_)
        assert rest < 0.02 * size
        error = inverse_snr(truth.data, model.reproject(truth.data))
        assert error < 2 * 0.01**2
        motion, translation, alpha, _ = model.decompose(truth.data)
        assert_allclose(motion, model.motion_, atol=0.05)
        assert_allclose(translation, model.translation_)
        assert_array_equal(alpha, model.alpha_)

    def test_new_frames(self):
        truth = table(n_frames=200)
        model = BlockMatrixNRSfM(2).fit(truth.data[:150])
        new = truth.data[150:]
        assert inverse_snr(new, model.reproject(new)) < 2 * 0.01**2
        # The coefficients are those of the truth, mixed.
        alpha, expected = model.transform(new), truth.alpha[150:]
        rest = np.linalg.lstsq(np.column_stack([alpha, np.ones(50)]), expected)[1]
        assert (rest / np.sum(expected**2, axis=0) < 0.02).all()


class TestInvariances:
    @both_methods
    def test_turning_the_images_turns_the_shapes(self, method):
        X = table().data
        model, other = fitted(method), method(2).fit(turned(X, 0.7))
        assert other.inverse_snr_ == pytest.approx(model.inverse_snr_, rel=1e-4)
        assert_allclose(np.abs(other.alpha_), np.abs(model.alpha_), atol=1e-3)
        shapes = camera_frame(model)
        found = camera_frame(other) @ Rotation.from_rotvec([0.0, 0.0, 0.7]).as_matrix()
        depth = np.sign(np.sum(found[..., 2] * shapes[..., 2]))
        assert_allclose(found * [1.0, 1.0, depth], shapes, atol=1e-3)

    @both_methods
    @pytest.mark.parametrize("scale_frames", [False, True])
    def test_units_and_places_of_frames(self, method, scale_frames):
        X = table().data
        model = fitted(method, scale_frames)
        rng = np.random.default_rng(0)
        scales = np.full((len(X), 1), 1e3)
        if scale_frames:
            scales = 10.0 ** rng.uniform(-2, 2, (len(X), 1))
        places = np.tile(rng.normal(size=(len(X), 2)), 30)
        other = method(2, scale_frames=scale_frames).fit(scales * (X + places))
        assert other.inverse_snr_ == pytest.approx(model.inverse_snr_, rel=1e-6)
        assert_allclose(other.alpha_, model.alpha_, atol=1e-5)
        unit = 1.0 if scale_frames else 1e3
        assert_allclose(other.shapes_, unit * model.shapes_, atol=1e-5 * unit)
        assert_allclose(
            other.motion_, scales[..., None] / unit * model.motion_, rtol=1e-4
        )

    @both_methods
    def test_order_of_frames(self, method):
        X = table().data
        order = np.random.default_rng(0).permutation(len(X))
        model, other = fitted(method), method(2).fit(X[order])
        assert_allclose(other.shapes_, model.shapes_[order], atol=1e-4)
        assert_allclose(other.motion_, model.motion_[order], atol=1e-4)
        assert_allclose(other.alpha_, model.alpha_[order], atol=1e-4)

    @both_methods
    def test_order_of_points(self, method):
        X = table().data
        order = np.random.default_rng(0).permutation(30)
        tracks = table_to_tracks(X)[:, order]
        model, other = fitted(method), method(2).fit(tracks_to_table(tracks))
        assert_allclose(other.shapes_, model.shapes_[:, order], atol=1e-4)
        assert_allclose(other.alpha_, model.alpha_, atol=1e-4)

    @both_methods
    def test_layouts(self, method):
        X = table().data
        planar = tracks_to_table(table_to_tracks(X), "planar")
        model, other = fitted(method), method(2, layout="planar").fit(planar)
        assert_allclose(other.shapes_, model.shapes_, atol=1e-6)
        assert_allclose(
            table_to_tracks(other.reproject(planar), "planar"),
            table_to_tracks(model.reproject(X)),
            atol=1e-6,
        )

    @both_methods
    def test_single_precision(self, method):
        X = table().data
        model, single = fitted(method), method(2).fit(X.astype(np.float32))
        names = "mean_shape_", "basis_", "alpha_", "motion_", "translation_", "shapes_"
        for name in names:
            assert getattr(single, name).dtype == np.float32
            assert_allclose(getattr(single, name), getattr(model, name), atol=2e-3)
        for found in (single.reconstruct, single.reproject, single.transform):
            assert found(X.astype(np.float32)).dtype == np.float32


class TestSigns:
    @both_methods
    def test_make_the_camera_turn_little_or_the_shapes_similar(self, method):
        ordered, other = fitted(method, ordered=True), fitted(method)
        steps = np.einsum("irc,irc->i", ordered.motion_[1:], ordered.motion_[:-1])
        assert (steps >= 0).all()
        assert (np.tensordot(other.shapes_, other.mean_shape_, 2) > 0).all()
        # The frames are in no order: the two do not agree.
        assert not (np.tensordot(ordered.shapes_, ordered.mean_shape_, 2) > 0).all()

    @both_methods
    def test_agree_for_a_camera_that_turns_slowly(self, method):
        truth = table()
        turns = np.outer(np.radians(8.0) * np.arange(60), [0.1, 0.9, 0.3])
        cameras = Rotation.from_rotvec(turns).as_matrix()[:, :2]
        X = tracks_to_table(truth.shapes @ cameras.swapaxes(1, 2))
        ordered, other = method(2, ordered=True).fit(X), method(2).fit(X)
        assert_allclose(ordered.shapes_, other.shapes_)
        assert_allclose(ordered.motion_, other.motion_)

    @both_methods
    def test_do_not_matter_for_the_images(self, method):
        expected = fitted(method).inverse_snr_
        assert fitted(method, ordered=True).inverse_snr_ == pytest.approx(expected)


class TestDegenerate:
    @both_methods
    def test_rigid_object(self, method):
        truth = table(noise=0.0, n_components=0, amplitude=0.0)
        model = method(1).fit(truth.data)
        for name in ("mean_shape_", "basis_", "alpha_", "motion_", "shapes_"):
            assert np.isfinite(getattr(model, name)).all()
        if method is BlockMatrixNRSfM:
            assert model.inverse_snr_ < 1e-8
            assert np.linalg.norm(model.basis_) < 1e-3 * np.linalg.norm(
                model.mean_shape_
            )

    @both_methods
    def test_flat_object_has_no_cameras(self, method):
        truth = table(noise=0.0)
        rng = np.random.default_rng(0)
        shape = rng.normal(size=(30, 3)) * [1.0, 1.0, 0.0]
        X = tracks_to_table(shape @ truth.motion.swapaxes(1, 2))
        with pytest.raises(ValueError, match=r"rank three or more.*has rank 2"):
            method(2).fit(X)

    @both_methods
    def test_a_frame_on_a_line(self, method):
        X = table().data.copy()
        X[3, 1::2] = 5.0
        model = method(2).fit(X)
        assert np.isfinite(model.shapes_).all()
        assert np.isfinite(model.transform(X)).all()


class TestErrors:
    @both_methods
    def test_missing_points(self, method):
        X = table().data.copy()
        X[4, 6:8] = np.nan
        X[9, 3] = np.nan
        message = (
            rf"{method.__name__} takes no missing points \(NaN\); X has 3 missing "
            r"value\(s\) in 2 of 60 row\(s\), the first is row 4: leave such rows out, "
            "or use AffineNRSfM"
        )
        with pytest.raises(ValueError, match=message):
            method(2).fit(X)
        model = fitted(method)
        with pytest.raises(ValueError, match="takes no missing points"):
            model.transform(X)
        with pytest.raises(ValueError, match="contains infinity"):
            model.transform(np.full_like(X, np.inf))

    @both_methods
    def test_tables(self, method):
        X = table().data
        with pytest.raises(ValueError, match=r"per point.*n_features=59"):
            method(2).fit(X[:, 1:])
        with pytest.raises(ValueError, match="with 30 points the largest possible"):
            method(9).fit(X)
        with pytest.raises(ValueError, match="needs at least 7 frames"):
            method(2).fit(X[:6])
        with pytest.raises(ValueError, match=r"equal in 1 frame\(s\), the first"):
            method(2).fit(np.where(np.arange(60)[:, None] == 2, 1.0, X))
        with pytest.raises(ValueError, match="contains infinity"):
            method(2).fit(np.where(X == X[0, 0], np.inf, X))
        planar = tracks_to_table(table_to_tracks(X), "planar")
        with pytest.warns(UserWarning, match="layout='planar' explains the table"):
            method(2).fit(planar)
