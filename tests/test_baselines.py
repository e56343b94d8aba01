"""The baselines as estimators: one contract over all, and what each recovers."""

import pickle
from functools import partial

import numpy as np
import pytest
from layers import may_not_converge, slow_after
from made_once import made_once
from numpy.testing import assert_allclose, assert_array_equal
from refusals import refusals_of, refused
from scenes import random_cameras, table_of, with_gaps  # noqa: F401  in refusals.txt
from sklearn.base import clone
from sklearn.linear_model import LogisticRegression
from sklearn.pipeline import make_pipeline
from sklearn.utils import estimator_checks
from sklearn.utils.estimator_checks import parametrize_with_checks

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
NOT_WIDENED = {"check_estimators_nan_inf": "feeds tables that are not widened"}
scaled_or_not = pytest.mark.parametrize("scale_frames", [False, True])


@made_once
def table(seed=0, noise=0.01, n_frames=60, **parameters):
    """Return a table of orthographic cameras with its truth, to be left as it is."""
    parameters |= {"camera": "orthographic", "noise": noise, "random_state": seed}
    return make_nonrigid_tracks(n_frames, 30, 2, **parameters)


@made_once
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
    @pytest.mark.filterwarnings("ignore:layout=:UserWarning")
    @may_not_converge
    @parametrize_with_checks(
        [BlockMatrixNRSfM(1), CompressibleNRSfM(1, max_iter=2)],
        expected_failed_checks=lambda estimator: NOT_WIDENED,
    )
    def test_on_landmark_tables(self, estimator, check, landmark_tables):
        check(estimator)

    @each
    def test_parameters(self, method, landmark_tables):
        model = METHODS[method](1)
        estimator_checks.check_param_validation(type(model).__name__, model)

    @each
    def test_in_a_pipeline_and_pickled(self, method):
        X, labels = table().data, table().alpha[:, 0] > 0
        model = make_pipeline(METHODS[method](2), LogisticRegression())
        model = clone(model).fit(X, labels)
        assert_array_equal(model[:-1].transform(X), model[0].alpha_)
        if method == "block matrix":
            assert model.score(X, labels) > 0.9
        again = pickle.loads(pickle.dumps(fitted(method)))
        assert_array_equal(again.transform(X), fitted(method).alpha_)


def spoilt(number=1.0):
    """Return the table with one number in all points of a frame."""
    return np.where(np.arange(60)[:, None] == 2, number, table().data)


class TestFitted:
    @each
    @scaled_or_not
    def test_definitions_and_transform(self, method, scale_frames):
        truth, model = table(), fitted(method, scale_frames=scale_frames)
        X = truth.data
        images = model.shapes_ @ model.motion_.swapaxes(1, 2)
        images += model.translation_[:, None]
        measured = inverse_snr(X, table_of(images), scale_frames=scale_frames)
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
        assert_array_equal(model.transform(X), model.alpha_)
        assert_allclose(model.transform(X[7:9]), model.alpha_[7:9], atol=1e-7)

    @each
    def test_signs_of_frames(self, method):
        ordered, other = METHODS[method](2, ordered=True), fitted(method)
        assert_array_equal(ordered.fit_transform(table().data), ordered.alpha_)
        steps = np.einsum("irc,irc->i", ordered.motion_[1:], ordered.motion_[:-1])
        assert (steps >= 0).all()
        assert ordered.inverse_snr_ == pytest.approx(other.inverse_snr_)
        # Each shape agrees with the sum of all.
        assert (np.tensordot(other.shapes_, other.mean_shape_, 2) >= 0).all()


class TestInvariances:
    @each
    @scaled_or_not
    def test_units_and_places_of_frames(self, method, scale_frames, rng):
        X, model = table().data, fitted(method, scale_frames=scale_frames)
        powers = rng.uniform(-2, 2, (60, 1)) if scale_frames else np.full((60, 1), 3.0)
        scales, places = 10.0**powers, np.tile(rng.normal(size=(60, 2)), 30)
        other = METHODS[method](2, scale_frames=scale_frames)
        other.fit(scales * (X + places))
        assert other.inverse_snr_ == pytest.approx(model.inverse_snr_, rel=1e-5)
        assert_allclose(other.alpha_, model.alpha_, atol=1e-4)
        unit = 1.0 if scale_frames else 1e3
        assert_allclose(other.shapes_, unit * model.shapes_, atol=1e-4 * unit)
        expected = scales[..., None] / unit * model.motion_
        assert_allclose(other.motion_, expected, atol=1e-4 * np.abs(expected).max())

    @each
    def test_orders_of_frames_points_columns_and_memory(self, method, rng):
        frames, points = rng.permutation(60), rng.permutation(30)
        if method == "compressible":  # draws its first atoms, in axes of the table
            frames, points = np.arange(60), np.arange(30)
        planar = table_of(table().tracks[frames][:, points], "planar")
        model, other = fitted(method), METHODS[method](2, layout="planar")
        found = other.fit(np.asfortranarray(planar)).reproject(planar)
        expected = model.shapes_[frames][:, points]
        assert_allclose(other.shapes_, expected, atol=1e-6)
        assert_allclose(other.motion_, model.motion_[frames], atol=1e-6)
        assert_allclose(other.alpha_, model.alpha_[frames], atol=1e-6)
        images = model.reproject(table().data).reshape(60, 30, 2)[frames][:, points]
        assert_allclose(found, table_of(images, "planar"), atol=1e-6)

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


@each
@pytest.mark.parametrize("kind", ["rigid", "flat", "repeated", "a line"])
def test_degenerate_tables(method, kind, rng):
    shape, cameras = rng.normal(size=(30, 3)), random_cameras(rng, 60)
    shape[:, [2] * (kind == "flat")] = 0.0
    if kind == "repeated":
        cameras[:] = cameras[0]
    X = table_of(shape @ cameras.swapaxes(1, 2))
    if kind == "a line":  # one frame of an ordinary table
        X = table().data.copy()
        X[3, 1::2] = 5.0
    model = METHODS[method](2)
    if kind in ("flat", "repeated") and method != "compressible":
        refused(r"rank three or more.*has rank", model.fit, X)
        return
    model.fit(X)
    for name in ARRAYS:
        assert np.isfinite(getattr(model, name)).all(), name
    if kind == "rigid" and method != "pseudo-inverse":
        assert model.inverse_snr_ < 1e-3
        size = np.linalg.norm(model.mean_shape_)
        assert np.linalg.norm(model.basis_) < 0.1 * size


class TestLowRank:
    """The pseudo-inverse and the block matrix method."""

    def test_shapes_of_least_norm_and_then_of_low_rank(self):
        truth, model = table(), fitted("pseudo-inverse")
        # Flat in the cameras, with the images of the table.
        rows = truth.tracks - truth.tracks.mean(axis=1, keepdims=True)
        U, S, Vt = np.linalg.svd(table_of(rows @ model.motion_))
        nearest = (U[:, :3] * S[:3]) @ Vt[:3]
        assert_allclose(model.shapes_.reshape(60, -1), nearest, atol=1e-9)

    def test_exact_shapes_are_found(self):
        truth = table(0, 0.0, n_frames=100)
        model = BlockMatrixNRSfM(2, tol=1e-6).fit(truth.data)
        assert model.inverse_snr_ < 1e-6
        assert error_in_cameras(truth.shapes, truth.motion, model) < 2e-3
        # The shapes are right without any coordinate system of the cameras, too.
        assert mean_shape_error_3d(truth.shapes, model.shapes_) < 2e-3


def sparse_scene(n_frames, n_points, n_atoms, sparsity=2):
    """Return a table of sums of so many random atoms, its cameras and its shapes."""
    rng = np.random.default_rng(0)
    atoms = rng.normal(size=(n_atoms, n_points, 3))
    atoms -= atoms.mean(axis=1, keepdims=True)
    cameras = random_cameras(rng, n_frames)
    coefficients = np.zeros((n_frames, n_atoms))
    for row in coefficients:
        used = rng.choice(n_atoms, sparsity, replace=False)
        row[used] = rng.uniform(0.5, 1.5, sparsity) * rng.choice([-1, 1], sparsity)
    shapes = np.tensordot(coefficients, atoms, 1)
    return table_of(shapes @ cameras.swapaxes(1, 2)), cameras, shapes


def error_of_frames(shapes, motion, model):
    """Return the relative error of shapes, up to a common turn and signs of frames."""
    products = np.einsum("irc,ird->icd", model.motion_, motion)
    # Signs of frames cancel in products of two turns.
    first = products.reshape(-1, 9)
    turn = np.linalg.eigh(first.T @ first)[1][:, -1].reshape(3, 3)
    left, _, right = np.linalg.svd(turn)
    turn = left @ right
    signs = np.sign(np.tensordot(products, turn, 2))[:, None, None]
    rest = signs * (model.shapes_ @ turn) - shapes
    return np.linalg.norm(rest) / np.linalg.norm(shapes)


class TestCompressible:
    def test_exact_table(self):
        # In pixels and away from the origin
        X, cameras, shapes = sparse_scene(150, 30, 5)
        X = 100 * X + np.tile([300.0, 200.0], 30)
        model = CompressibleNRSfM(4, max_iter=60, tol=1e-8, random_state=0).fit(X)
        assert model.dictionary_residual_ < 1e-3
        assert model.inverse_snr_ < 2e-3
        assert (model.n_users_ > 30).all()
        assert error_of_frames(100 * shapes, cameras, model) < 0.05

    # A rigid shape, and more frames than the relaxed problem has.
    @pytest.mark.parametrize("size", slow_after(1, [((50, 20, 1),), ((1100, 12, 3),)]))
    def test_one_atom_a_frame(self, size):
        X, cameras, shapes = sparse_scene(*size, sparsity=1)
        model = CompressibleNRSfM(2, n_atoms=size[2], sparsity=1, random_state=0)
        model.fit(X)
        assert model.dictionary_residual_ < 1e-12
        assert model.inverse_snr_ < 1e-12
        assert model.n_users_.sum() == size[0]
        if size[2] == 1:
            assert error_of_frames(shapes, cameras, model) < 1e-6

    def test_atoms_that_few_frames_use_are_replaced(self):
        # Twice as many atoms as the shapes have: without it one has no frames.
        X, *_ = sparse_scene(60, 20, 3, sparsity=1)
        options = {"n_atoms": 6, "sparsity": 1, "penalty": 0.3, "random_state": 0}
        model = CompressibleNRSfM(2, **options).fit(X)
        assert model.n_users_.min() > 0
        assert model.dictionary_residual_ < 1e-12


SHARK, YOGA, DRINK = "shark_torresani", "akhter_yoga", "akhter_drink"
sparse = partial(CompressibleNRSfM, 1)


# Of the shark, shapes of rank two: no sparse dictionary is unique, and the bounds are
# the errors of the released code of the publication.
SEQUENCES = [
    (YOGA, PseudoInverseNRSfM(9), 5.04e-4, 0.611),
    (SHARK, sparse(n_atoms=1, sparsity=1, random_state=0), 0.0118, 0.25),
    (SHARK, BlockMatrixNRSfM(1), 0.00258, 0.244),
    (DRINK, BlockMatrixNRSfM(11), 1.32e-5, 0.0227),
    (SHARK, sparse(n_atoms=3, random_state=0), 0.27, 1.3),
]
OF_SEQUENCES = ("name", "model", "inverse_snr", "error")


@pytest.mark.parametrize(OF_SEQUENCES, slow_after(2, SEQUENCES))
def test_public_sequences(load_data, name, model, inverse_snr, error):
    data = load_data(name)
    model.fit(table_of(data["W2d"]))
    assert model.inverse_snr_ < 1.05 * inverse_snr
    # The shark is in the axes of the cameras already.
    motion = data["R"] if "R" in data else np.broadcast_to(np.eye(2, 3), (240, 2, 3))
    found = error_in_cameras(data["S3d"], motion, model)
    if isinstance(model, CompressibleNRSfM):
        assert found < error
    else:
        assert found == pytest.approx(error, rel=0.02)


test_refusals = refusals_of("baselines", globals())
