"""The baselines as estimators: one contract over all, and what each recovers."""

import pickle
from functools import cache, partial

import numpy as np
import pandas as pd
import pytest
from estimator_contract import (
    EXTRA_CHECKS,
    NARROW_TABLE_CHECKS,
    assert_only_narrow_tables_fail,
)
from layers import slow_after
from numpy.testing import assert_allclose, assert_array_equal
from refusals import refused, warned
from scenes import random_cameras, with_gaps
from scipy.spatial.transform import Rotation
from sklearn.base import clone
from sklearn.exceptions import ConvergenceWarning
from sklearn.linear_model import LogisticRegression
from sklearn.pipeline import make_pipeline
from sklearn.utils import estimator_checks
from sklearn.utils._param_validation import InvalidParameterError
from sklearn.utils.estimator_checks import parametrize_with_checks

from isa_nrsfm._tables.tracks import table_to_tracks, tracks_to_table
from isa_nrsfm.baselines import BlockMatrixNRSfM, CompressibleNRSfM, PseudoInverseNRSfM
from isa_nrsfm.datasets import make_nonrigid_tracks
from isa_nrsfm.metrics import inverse_snr, mean_shape_error_3d

METHODS = {
    "pseudo-inverse": PseudoInverseNRSfM,
    "block matrix": BlockMatrixNRSfM,
    "compressible": partial(CompressibleNRSfM, max_iter=3, random_state=0),
}
ARRAYS = "mean_shape_", "basis_", "alpha_", "motion_", "translation_", "shapes_"
each = pytest.mark.parametrize("method", METHODS)
# The compressible method draws its first atoms, in axes of the table.
deterministic = pytest.mark.parametrize("method", list(METHODS)[:2])


@cache
def table(seed=0, noise=0.01, n_frames=60, n_points=30, n_components=2, **parameters):
    """Return a table of orthographic cameras with its truth, to be left as it is."""
    sizes = n_frames, n_points, n_components
    parameters |= {"camera": "orthographic", "noise": noise, "random_state": seed}
    return make_nonrigid_tracks(*sizes, **parameters)


@cache
def fitted(method, **parameters):
    """Return a model of the table, to be left as it is."""
    return METHODS[method](2, **parameters).fit(table().data)


def rotations(motion):
    """Return the rotation of each camera with orthonormal rows, up to their scale."""
    unit = motion / np.linalg.norm(motion, axis=2, keepdims=True)
    return np.concatenate([unit, np.cross(unit[:, 0], unit[:, 1])[:, None]], axis=1)


def error_in_cameras(truth, motion, model):
    """Return the 3D error of shapes in the axes of the cameras."""
    shapes = model.shapes_ @ rotations(model.motion_).swapaxes(1, 2)
    return mean_shape_error_3d(truth @ rotations(motion).swapaxes(1, 2), shapes)


class TestContract:
    @pytest.mark.slow
    @pytest.mark.filterwarnings(
        "ignore:layout=:UserWarning", "ignore::sklearn.exceptions.ConvergenceWarning"
    )
    @parametrize_with_checks(
        [BlockMatrixNRSfM(1), CompressibleNRSfM(1, max_iter=2)],
        expected_failed_checks=lambda estimator: {
            "check_estimators_nan_inf": "feeds tables that are not widened"
        },
    )
    def test_on_landmark_tables(self, estimator, check, landmark_tables):
        check(estimator)

    @deterministic
    def test_raw(self, method):
        # The pseudo-inverse method has no steps to count.
        skipped = {"check_transformer_n_iter"} if method == "pseudo-inverse" else set()
        expected = {k: v for k, v in NARROW_TABLE_CHECKS.items() if k not in skipped}
        assert_only_narrow_tables_fail(METHODS[method](1), expected)

    @pytest.mark.filterwarnings(
        "ignore:layout=:UserWarning", "ignore:X does not have valid feature names"
    )
    @pytest.mark.filterwarnings("ignore:X has feature names")
    @pytest.mark.parametrize(
        "name", [n for n in EXTRA_CHECKS if "global" not in n and "polars" not in n]
    )
    def test_extra_checks_on_landmark_tables(self, name, landmark_tables):
        model = PseudoInverseNRSfM(1)
        getattr(estimator_checks, name)(type(model).__name__, model)

    @pytest.mark.parametrize(
        ("method", "parameters"),
        [
            *((method, {"ordered": "yes"}) for method in METHODS),
            *(("block matrix", {k: -1}) for k in ("max_iter", "tol")),
            ("block matrix", {"accelerated": 2}),
            *(("compressible", {k: 0}) for k in ("n_atoms", "sparsity", "max_iter")),
            *(("compressible", {k: -0.1}) for k in ("penalty", "tol", "ridge")),
            ("compressible", {"ridge": 0.3}),
            ("compressible", {"random_state": "seed"}),
        ],
    )
    def test_parameters(self, method, parameters):
        (name,) = parameters
        with pytest.raises(InvalidParameterError, match=f"'{name}' parameter"):
            METHODS[method](2, **parameters).fit(table().data)

    @each
    def test_in_a_pipeline_and_pickled(self, method):
        truth = table(n_frames=80)
        labels = truth.alpha[:, 0] > 0
        model = make_pipeline(METHODS[method](2), LogisticRegression())
        model = clone(model).fit(truth.data, labels)
        assert_array_equal(model[:-1].transform(truth.data), model[0].alpha_)
        if method == "block matrix":
            assert model.score(truth.data, labels) > 0.9
        again = pickle.loads(pickle.dumps(fitted(method)))
        assert_array_equal(again.transform(table().data), fitted(method).alpha_)

    @each
    def test_names(self, method):
        names = [f"{axis}{j}" for j in range(30) for axis in "xy"]
        frame = pd.DataFrame(table().data, columns=names)
        model = METHODS[method](2).set_output(transform="pandas").fit(frame)
        shown = model.transform(frame)
        prefix = type(model).__name__.lower()
        assert list(shown.columns) == [f"{prefix}0", f"{prefix}1"]
        assert_allclose(shown, fitted(method).alpha_)
        with pytest.raises(ValueError, match="contradicts the column names"):
            METHODS[method](2).fit(frame[sorted(names)])

    @each
    def test_refused_tables(self, method):
        X, make = table().data, METHODS[method]
        model = fitted(method)
        message = (
            rf"{type(model).__name__} takes no missing points \(NaN\), which \d+ of 60 "
            r"rows have \(first: row \d+\). Remove these rows, or use AffineNRSfM"
        )
        for refusing in (make(2).fit, model.transform):
            refused(message, refusing, with_gaps(X, 0.05))
            refused("contains infinity", refusing, np.where(X == X[0, 0], np.inf, X))
        for wrong, K, message in (
            (X[:, 1:], 2, r"per point.*n_features=59"),
            (X, 9, "with 30 points the largest possible"),
            (X[:6], 2, "needs at least 7 frames"),
            (
                np.where(np.arange(60)[:, None] == 2, 1.0, X),
                2,
                "equal in 1 of 60 frames",
            ),
        ):
            refused(message, make(K).fit, wrong)
        planar = tracks_to_table(table_to_tracks(X), "planar")
        warned("layout='planar' explains the table", make(2).fit, planar)


class TestFitted:
    @each
    @pytest.mark.parametrize("scale_frames", [False, True])
    def test_definitions(self, method, scale_frames):
        truth, model = table(), fitted(method, scale_frames=scale_frames)
        X = truth.data
        images = model.shapes_ @ model.motion_.swapaxes(1, 2)
        images += model.translation_[:, None]
        measured = inverse_snr(X, tracks_to_table(images), scale_frames=scale_frames)
        assert model.inverse_snr_ == pytest.approx(measured)
        centroids = truth.tracks.mean(axis=1)
        assert_allclose(model.translation_, centroids)
        tracks = truth.tracks - centroids[:, None]
        size = np.sqrt(np.mean(tracks**2, axis=(1, 2))) if scale_frames else np.ones(60)
        gram = model.motion_ @ model.motion_.swapaxes(1, 2)
        assert_allclose(gram, size[:, None, None] ** 2 * np.eye(2), atol=1e-9)
        assert_allclose(model.mean_shape_, model.shapes_.mean(axis=0), atol=1e-12)
        assert_allclose(model.shapes_.mean(axis=1), 0, atol=1e-12)
        rows = model.shapes_.reshape(60, -1)
        assert np.linalg.matrix_rank(rows, tol=1e-9 * np.linalg.norm(rows)) == 3
        rest = rows - rows.mean(axis=0)
        values = np.linalg.svd(rest, compute_uv=False)[:2] / np.sqrt(60)
        basis = model.basis_.reshape(2, -1)
        assert_allclose(np.linalg.norm(basis, axis=1), values)
        # The noise is the error of the shapes that the basis gives.
        nearest = (rest @ np.linalg.pinv(basis) @ basis).reshape(model.shapes_.shape)
        images = (model.mean_shape_ + nearest) @ model.motion_.swapaxes(1, 2)
        error = np.mean(((tracks - images) / size[:, None, None]) ** 2)
        assert model.noise_variance_ == pytest.approx(error)

    @each
    @pytest.mark.parametrize("scale_frames", [False, True])
    def test_transform_gives_the_coefficients_again(self, method, scale_frames):
        X, model = table().data, fitted(method, scale_frames=scale_frames)
        assert_array_equal(model.transform(X), model.alpha_)
        assert_array_equal(clone(model).fit_transform(X), model.alpha_)
        assert_allclose(model.transform(X[7:9]), model.alpha_[7:9], atol=1e-7)

    @each
    def test_signs_of_frames(self, method):
        ordered, other = fitted(method, ordered=True), fitted(method)
        steps = np.einsum("irc,irc->i", ordered.motion_[1:], ordered.motion_[:-1])
        assert (steps >= 0).all()
        assert ordered.inverse_snr_ == pytest.approx(other.inverse_snr_)
        alike = np.tensordot(other.shapes_, other.mean_shape_, 2)
        if method != "compressible":
            assert (alike > 0).all()

    @deterministic
    def test_signs_agree_for_a_camera_that_turns_slowly(self, method):
        turns = np.outer(np.radians(8.0) * np.arange(60), [0.1, 0.9, 0.3])
        cameras = Rotation.from_rotvec(turns).as_matrix()[:, :2]
        X = tracks_to_table(table().shapes @ cameras.swapaxes(1, 2))
        ordered, other = (METHODS[method](2, ordered=o).fit(X) for o in (True, False))
        assert_allclose(ordered.shapes_, other.shapes_)
        assert_allclose(ordered.motion_, other.motion_)


class TestInvariances:
    @each
    @pytest.mark.parametrize("scale_frames", [False, True])
    def test_units_and_places_of_frames(self, method, scale_frames, rng):
        X, model = table().data, fitted(method, scale_frames=scale_frames)
        scales = np.full((len(X), 1), 1e3)
        if scale_frames:
            scales = 10.0 ** rng.uniform(-2, 2, (len(X), 1))
        places = np.tile(rng.normal(size=(len(X), 2)), 30)
        other = METHODS[method](2, scale_frames=scale_frames)
        other.fit(scales * (X + places))
        assert other.inverse_snr_ == pytest.approx(model.inverse_snr_, rel=1e-5)
        assert_allclose(other.alpha_, model.alpha_, atol=1e-4)
        unit = 1.0 if scale_frames else 1e3
        assert_allclose(other.shapes_, unit * model.shapes_, atol=1e-4 * unit)
        expected = scales[..., None] / unit * model.motion_
        assert_allclose(other.motion_, expected, atol=1e-4 * np.abs(expected).max())

    @deterministic
    def test_order_of_frames_and_points(self, method, rng):
        frames, points = rng.permutation(60), rng.permutation(30)
        tracks = table_to_tracks(table().data)[frames][:, points]
        model, other = fitted(method), METHODS[method](2).fit(tracks_to_table(tracks))
        expected = model.shapes_[frames][:, points]
        assert_allclose(other.shapes_, expected, atol=1e-4)
        assert_allclose(other.motion_, model.motion_[frames], atol=1e-4)
        assert_allclose(other.alpha_, model.alpha_[frames], atol=1e-4)

    @each
    def test_layouts_and_memory_order(self, method):
        X, model = table().data, fitted(method)
        planar = np.asfortranarray(tracks_to_table(table_to_tracks(X), "planar"))
        other = METHODS[method](2, layout="planar").fit(planar)
        assert_allclose(other.shapes_, model.shapes_, atol=1e-6)
        images = table_to_tracks(other.reproject(planar), "planar")
        assert_allclose(images, table_to_tracks(model.reproject(X)), atol=1e-6)

    @each
    def test_single_precision(self, method):
        X = table().data.astype(np.float32)
        model, single = fitted(method), METHODS[method](2).fit(X)
        for name in ARRAYS:
            found = getattr(single, name)
            assert found.dtype == np.float32
            if method != "compressible":
                assert_allclose(found, getattr(model, name), atol=2e-3)
        for found in (single.reconstruct, single.reproject, single.transform):
            assert found(X).dtype == np.float32


class TestDegenerate:
    @each
    @pytest.mark.parametrize("kind", ["rigid", "flat", "line", "repeated", "a line"])
    def test_tables(self, method, kind, rng):
        shape, cameras = rng.normal(size=(30, 3)), random_cameras(rng, 60)
        shape[:, {"flat": [2], "line": [1, 2]}.get(kind, [])] = 0.0
        if kind == "repeated":
            cameras[:] = cameras[0]
        X = tracks_to_table(shape @ cameras.swapaxes(1, 2))
        if kind == "a line":  # one frame of an ordinary table
            X = table().data.copy()
            X[3, 1::2] = 5.0
        model = METHODS[method](2)
        if kind in ("flat", "line", "repeated") and method != "compressible":
            refused(r"rank three or more.*has rank", model.fit, X)
            return
        model.fit(X)
        for name in ARRAYS:
            assert np.isfinite(getattr(model, name)).all(), name
        if kind == "rigid" and method != "pseudo-inverse":
            assert model.inverse_snr_ < 1e-3
            size = np.linalg.norm(model.mean_shape_)
            assert np.linalg.norm(model.basis_) < 0.1 * size


class TestBlockMatrix:
    def test_exact_shapes_are_found(self):
        truth = table(0, 0.0, n_frames=150)
        model = BlockMatrixNRSfM(2, tol=1e-6).fit(truth.data)
        assert model.inverse_snr_ < 1e-6
        assert error_in_cameras(truth.shapes, truth.motion, model) < 2e-3
        # The shapes are right without any coordinate system of the cameras, too.
        assert mean_shape_error_3d(truth.shapes, model.shapes_) < 2e-3

    def test_new_frames(self):
        truth = table(n_frames=200)
        model = BlockMatrixNRSfM(2).fit(truth.data[:150])
        rest = np.linalg.norm(model.reconstruct(truth.data[:150]) - model.shapes_)
        assert rest < 0.02 * np.linalg.norm(model.shapes_)
        new = truth.data[150:]
        assert inverse_snr(new, model.reproject(new)) < 2 * 0.01**2
        # The coefficients are those of the truth, mixed.
        alpha, expected = model.transform(new), truth.alpha[150:]
        rest = np.linalg.lstsq(np.column_stack([alpha, np.ones(50)]), expected)[1]
        assert (rest / np.sum(expected**2, axis=0) < 0.02).all()

    @pytest.mark.parametrize("accelerated", [True, False])
    def test_too_few_steps(self, accelerated):
        model = BlockMatrixNRSfM(2, accelerated=accelerated, max_iter=2)
        with pytest.warns(ConvergenceWarning, match="converge in max_iter=2 steps"):
            model.fit(table().data)
        assert 18 <= model.n_iter_ <= 36


class TestCompressible:
    def test_seeds_and_atoms(self):
        X = table().data
        first, second, other, named, many = (
            CompressibleNRSfM(2, max_iter=2, **parameters).fit(X)
            for parameters in (
                {"random_state": 0},
                {"random_state": 0},
                {"random_state": 1},
                {"random_state": 0, "n_atoms": 3},
                {"random_state": 0, "n_atoms": 8},
            )
        )
        for same in (second, named):
            assert_array_equal(first.shapes_, same.shapes_)
        assert first.dictionary_residual_ != other.dictionary_residual_
        assert many.n_users_.shape == (8,)
        assert many.basis_.shape == (2, 30, 3)
        assert 60 <= many.n_users_.sum() <= 120
        assert many.n_iter_ <= 2

    @pytest.mark.parametrize(
        ("parameters", "message"),
        [
            ({"n_atoms": 2, "sparsity": 3}, "sparsity=3 must not be .* n_atoms=2"),
            ({"sparsity": 4}, "sparsity=4 must not be .* n_atoms=3"),
            ({"n_atoms": 61}, "n_atoms=61 needs as many frames .* n_samples=60"),
        ],
    )
    def test_impossible_sizes(self, parameters, message):
        refused(message, CompressibleNRSfM(2, **parameters).fit, table().data)


@pytest.mark.parametrize(
    ("name", "method", "n_components", "inverse_snr", "error"),
    [
        ("shark_torresani", "block matrix", 1, 0.00258, 0.244),
        ("shark_torresani", "pseudo-inverse", 1, 0.03714, 0.901),
        ("akhter_yoga", "block matrix", 9, 5.32e-5, 0.0342),
        ("akhter_yoga", "pseudo-inverse", 9, 5.04e-4, 0.611),
        *slow_after(
            0,
            [
                ("akhter_drink", "block matrix", 11, 1.32e-5, 0.0227),
                ("akhter_pickup", "block matrix", 11, 4.09e-5, 0.0479),
                ("akhter_drink", "pseudo-inverse", 11, 6.90e-5, 0.446),
                ("akhter_pickup", "pseudo-inverse", 11, 2.67e-4, 0.547),
            ],
            together=True,
        ),
    ],
)
def test_public_sequences(load_data, name, method, n_components, inverse_snr, error):
    data = load_data(name)
    model = METHODS[method](n_components).fit(data["W2d"].reshape(len(data["W2d"]), -1))
    assert model.inverse_snr_ < 1.05 * inverse_snr
    # The shark is in the axes of the cameras already.
    motion = data["R"] if "R" in data else np.broadcast_to(np.eye(2, 3), (240, 2, 3))
    found = error_in_cameras(data["S3d"], motion, model)
    assert found == pytest.approx(error, rel=0.02)


class TestSharkOfFewAtoms:
    """Shapes of rank two (480 x 91, rank five): no sparse dictionary is unique."""

    @pytest.fixture
    def errors(self, load_data):
        """Return a function from parameters to a model and its 3D error."""
        data = load_data("shark_torresani")
        identity = np.broadcast_to(np.eye(2, 3), (240, 2, 3))

        def fit(**parameters):
            model = CompressibleNRSfM(1, **parameters)
            model.fit(data["W2d"].reshape(240, -1))
            return model, error_in_cameras(data["S3d"], identity, model)

        return fit

    # The bounds are the errors of the released code of the publication.
    @pytest.mark.parametrize(
        ("parameters", "inverse_snr", "error"),
        [
            ({"n_atoms": 1, "sparsity": 1, "random_state": 0}, 0.0118, 0.25),
            ({"n_atoms": 3, "random_state": 0}, 0.27, 1.3),
            *slow_after(
                0,
                [
                    ({"n_atoms": 3, "random_state": 1}, 0.27, 1.3),
                    ({"n_atoms": 3, "random_state": 2}, 0.27, 1.3),
                    ({"n_atoms": 20, "random_state": 0}, 1.0, 2.6),
                ],
                together=True,
            ),
        ],
    )
    def test_errors(self, errors, parameters, inverse_snr, error):
        model, found = errors(**parameters)
        assert model.inverse_snr_ < inverse_snr
        assert found < error
