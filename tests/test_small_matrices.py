"""Small matrices, and points that determine a camera."""

import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal
from scenes import random_rotation
from scipy.spatial.transform import Rotation

from isa_nrsfm._frames.search import (
    ShapeProducts,
    determines_camera,
    frame_sums,
    frame_tracks,
    whitened,
)
from isa_nrsfm._linalg import (
    COLUMNS,
    ROWS,
    SMALL,
    centred,
    inverse3,
    invert_positive,
    pair_indices,
    procrustes,
    solve_positive,
    sweep,
    unpacked,
)

NUMBERS = [3, 98]


def positive_matrices(seed, k, n, condition=1e3):
    """Return symmetric positive definite matrices (k, k, n) of a given condition."""
    rng = np.random.default_rng(seed)
    Q = np.linalg.qr(rng.normal(size=(n, k, k)))[0]
    values = condition ** -np.linspace(0, 1, k) * rng.uniform(0.5, 2, (n, 1))
    A = np.moveaxis((Q * values[:, None]) @ Q.swapaxes(1, 2), 0, -1)
    return 0.5 * (A + A.swapaxes(0, 1))


def packed(A):
    """Return symmetric matrices (k, k, n) packed."""
    return A[pair_indices(len(A))]


def last_to_first(matrices):
    return np.moveaxis(matrices, -1, 0)


class TestThreeByThree:
    def test_inverse_is_precise_whatever_the_scales_of_coordinates(self):
        A = positive_matrices(0, 3, 50, condition=10)
        scale = np.array([1e-70, 1.0, 1e80])
        outer = scale[:, None, None] * scale[:, None]
        inverse = inverse3((A * outer)[ROWS, COLUMNS]) * outer
        assert_allclose(inverse.T, np.linalg.inv(last_to_first(A)), rtol=1e-12)
        assert_allclose(inverse, inverse3(A[ROWS, COLUMNS]), rtol=1e-13)

    @pytest.mark.parametrize(("rank", "unit"), [(0, 1.0), (1, 1e-100), (2, 1e100)])
    def test_singular_matrices_have_a_generalised_inverse(self, rank, unit):
        X = np.random.default_rng(rank).normal(size=(40, 3, rank))
        X[:10, 0] = 0  # flat along an axis
        A = unit * last_to_first((X @ X.swapaxes(1, 2)).T)
        inverse = last_to_first(inverse3(np.moveaxis(A, 0, -1)[ROWS, COLUMNS]))
        assert np.isfinite(inverse).all()
        assert_allclose(A @ inverse @ A, A, atol=1e-12 * unit)


@pytest.mark.parametrize("n", NUMBERS)
class TestPositiveDefinite:
    @pytest.mark.parametrize("k", [1, 3, 9, 15])
    def test_solution_and_inverse(self, k, n):
        A, b = positive_matrices(k, k, n), np.random.default_rng(0).normal(size=(k, n))
        x, solved = solve_positive(packed(A), b)
        inverse, inverted = invert_positive(packed(A))
        expected = np.linalg.inv(last_to_first(A))
        assert_allclose(last_to_first(unpacked(inverse)), expected, atol=1e-9)
        expected = np.linalg.solve(last_to_first(A), b.T[..., None])[..., 0].T
        assert_allclose(x, expected, rtol=1e-10, atol=1e-11 * np.abs(x).max())
        assert (solved & inverted).all()

    @pytest.mark.parametrize("k", [2, 9])
    def test_indefinite_matrices_are_told(self, k, n):
        rng = np.random.default_rng(k)
        A = positive_matrices(k, k, n) - 0.05 * rng.random(n) * np.eye(k)[..., None]
        b = rng.normal(size=(k, n))
        expected = np.linalg.eigvalsh(last_to_first(A))[:, 0] > 0
        assert not expected.all()
        x, positive = solve_positive(packed(A), b)
        inverse, definite = invert_positive(packed(A))
        assert_array_equal([positive, definite], [expected, expected])
        assert np.isfinite(x).all()
        assert np.isfinite(inverse).all()
        # The others are solved all the same.
        right = np.einsum("kln,ln->kn", A, x)
        assert_allclose(right[:, positive], b[:, positive], atol=1e-6)
        A[:, :, 1] = np.nan
        assert not solve_positive(packed(A), b)[1][1]
        assert not invert_positive(packed(A))[1][1]

    @pytest.mark.parametrize(("k", "condition"), [(4, 1e3), (SMALL + 3, 10)])
    def test_a_zero_coordinate_is_left_out(self, k, condition, n):
        A, b = positive_matrices(0, k, n, condition), np.ones((k, n))
        A[2] = A[:, 2] = 0.0
        kept = np.delete(np.arange(k), 2)
        x, positive = solve_positive(packed(A), b)
        inverse, definite = invert_positive(packed(A))
        expected = invert_positive(packed(A[kept][:, kept]))
        assert not (positive | definite).any()
        assert_array_equal(x[2], 0)
        inverse = unpacked(inverse)
        assert_array_equal(inverse[2], 0)
        assert_allclose(packed(inverse[kept][:, kept]), expected[0], rtol=1e-10)
        assert_allclose(x[kept], inverse[kept].sum(axis=1), rtol=1e-8)


@pytest.mark.parametrize("k", [5, SMALL + 3])
@pytest.mark.parametrize("first", [0, 1, 3, 5])
def test_sweep_by_its_definition(first, k):
    A = positive_matrices(0, k, 7)
    swept = packed(A)
    log_determinant, positive = sweep(swept, first)
    swept = last_to_first(unpacked(swept))
    C, G, B = A[:first, :first], A[first:, :first], A[first:, first:]
    inverse = np.linalg.inv(last_to_first(B))
    G = last_to_first(G)
    assert_allclose(swept[:, first:, first:], -inverse, rtol=1e-9)
    assert_allclose(swept[:, first:, :first], inverse @ G, rtol=1e-9, atol=1e-12)
    rest = last_to_first(C) - G.swapaxes(1, 2) @ inverse @ G
    assert_allclose(swept[:, :first, :first], rest, rtol=1e-9, atol=1e-12)
    assert_allclose(log_determinant, np.linalg.slogdet(last_to_first(B))[1])
    assert positive.all()


@pytest.mark.parametrize("k", [6, SMALL + 3])
def test_a_matrix_is_solved_alike_whatever_its_neighbours_are(k):
    """Also beside one that is not positive definite."""
    n = 258
    A = packed(positive_matrices(0, k, n))
    b = np.random.default_rng(0).normal(size=(k, n))
    A[:, 50] *= -1
    many, inverses = solve_positive(A, b)[0], invert_positive(A)[0]
    for frames in (slice(10, 26), slice(40, 56)):
        part = A[:, frames].copy()
        assert_array_equal(solve_positive(part, b[:, frames])[0], many[:, frames])
        assert_array_equal(invert_positive(part)[0], inverses[:, frames])


@pytest.mark.parametrize("mirrored", [False, True])
def test_procrustes_rotations_are_those_of_scipy(mirrored, rng):
    shapes = rng.standard_normal((20, 7, 3))
    target = shapes * [1.0, 1.0, -1.0] if mirrored else shapes[::-1]
    found = procrustes(target.transpose(0, 2, 1) @ shapes)
    pairs = zip(target, shapes, strict=True)
    expected = [Rotation.align_vectors(*pair)[0].as_matrix() for pair in pairs]
    assert_allclose(found, expected, atol=1e-10)
    assert_allclose(np.linalg.det(found), 1.0)
    assert_allclose(procrustes(target[0].T @ shapes[0]), found[0], atol=1e-12)


def random_shapes():
    """Return shapes (3, 3, 11), centred."""
    return centred(np.random.default_rng(0).normal(size=(3, 3, 11)))


class TestWhitened:
    @pytest.mark.parametrize("rank", [0, 1, 2, 3])
    def test_second_moment_is_the_identity_but_for_flat_shapes(self, rank):
        shapes = random_shapes() * (np.arange(3) < rank)[:, None]
        flat = np.random.default_rng(1).normal(size=(3, 3)) @ shapes
        white, space = whitened(flat)
        assert_allclose(white, space @ flat, atol=1e-13)
        # The axes are the principal ones of the mean shape.
        mean, second = white[0] @ white[0].T, np.sum(white @ white.mT, axis=0)
        assert_allclose(mean, np.diag(np.diag(mean)), atol=1e-13)
        order = np.argsort(-np.diag(second))
        expected = np.diag(1.0 * (np.arange(3) < rank))
        assert_allclose(second[order][:, order], expected, atol=1e-13)
        # What the white shapes are seen as is what the shapes are seen as.
        assert_allclose(np.linalg.pinv(space) @ white, flat, atol=1e-12)

    def test_flat_mean_shapes_are_exactly_flat(self):
        shapes = random_shapes()
        shapes[0, 2] = 0.0
        white, _ = whitened(random_rotation(1) @ shapes)
        assert_array_equal(white[0, 2], 0)
        assert np.abs(white[1:, 2]).max() > 0.1


def determined(shapes, weights):
    """Return which frames with these weights of their points determine a camera."""
    white, _ = whitened(shapes)
    frames = frame_tracks(np.zeros((len(weights), 2, weights.shape[1])), weights)
    return determines_camera(frame_sums(frames, ShapeProducts(white)), white[0])


@pytest.mark.parametrize("unit", [1e-8, 1.0, 1e8])
def test_points_that_determine_a_camera(unit):
    """Four, and fewer of a flat mean shape, in all units and with all weights."""
    shapes, weights = random_shapes(), np.tri(12, 11, -1)  # 0 to 11 points
    weights *= np.random.default_rng(1).uniform(0.1, 2, (12, 11))
    for n_points in (4, 3, 2):
        expected = np.arange(12) >= n_points
        for scale in (unit, np.array([[1.0], [1e3], [1e-3]])):
            assert_array_equal(determined(scale * shapes, weights), expected)
        assert_array_equal(determined(shapes, unit * weights), expected)
        shapes[0, n_points - 2] = 0.0
