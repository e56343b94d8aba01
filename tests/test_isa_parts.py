"""Parts of independent subspace analysis: steps, gains of swaps, shared mixing."""

from functools import cache

import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal
from scenes import random_rotation, spherical_sources
from scipy.integrate import quad
from scipy.linalg import polar
from scipy.optimize import linear_sum_assignment, minimize_scalar

from isa_nrsfm._frames import gauge
from isa_nrsfm._frames.gauge import (
    LIGHT,
    TAILS,
    independent_coefficients,
    shared_mixing,
)
from isa_nrsfm.datasets import make_nonrigid_tracks
from isa_nrsfm.isa._strategies import (
    fixed_point_step,
    iterate,
    orthogonalise,
    subspace_change,
    whiten,
)


def white_signals(seed, n_samples=400, n_subspaces=2, size=3):
    sources = spherical_sources(seed, n_samples, n_subspaces, size)
    return whiten(sources - sources.mean(axis=0))[0]


def starts(seed, n_batch, n_signals):
    rng = np.random.default_rng(seed)
    return orthogonalise(rng.normal(size=(n_batch, n_signals, n_signals)))


def published_step(W, Z, size):
    """Return one step of FastISA, row by row."""
    new = np.empty_like(W)
    for i, w in enumerate(W):
        block = slice(i // size * size, i // size * size + size)
        u, y = np.sum((W[block] @ Z) ** 2, axis=0), w @ Z
        g, dg = -0.5 * (u + 0.1) ** -0.5, 0.25 * (u + 0.1) ** -1.5
        new[i] = (Z * (y * g)).mean(axis=1) - np.mean(g + 2 * y**2 * dg) * w
    return polar(new)[0]


@pytest.mark.parametrize("smallest", [1e-1, 1e-5, 1e-12])
def test_orthogonalise_gives_the_nearest_orthogonal_matrix(smallest):
    U, V = random_rotation(0, 6), random_rotation(1, 6)
    W = (U * [3.0, 2.0, 1.0, 1.0, 0.5, smallest]) @ V
    singular = np.diag([1.0, 1.0, 0.0, 1.0, 1.0, 1.0])
    Q = orthogonalise(np.array([W, np.eye(6), singular, np.zeros((6, 6))]))
    # The error of the last direction grows with the condition number.
    assert_allclose(Q[0], U @ V, atol=1e-14 / smallest)
    assert_allclose(Q @ Q.mT, [np.eye(6)] * 4, atol=1e-13)
    assert_allclose(Q[1], np.eye(6), atol=1e-14)


@pytest.mark.parametrize("size", [1, 2, 3])
def test_steps_by_plain_loops(size):
    Z, W = white_signals(0), starts(0, 4, 6)
    new = fixed_point_step(W, Z, size)
    for w, step in zip(W, new, strict=True):
        assert_allclose(step, published_step(w, Z, size), atol=1e-11)


def test_shorter_steps_have_the_same_fixed_points():
    Z = white_signals(0)
    W, _, converged = iterate(starts(0, 1, 6), Z, 3, max_iter=2000, tol=1e-14)
    assert converged.all()
    for length in (1.0, 0.5, 1 / 16):
        new = fixed_point_step(W, Z, 3, length)
        assert subspace_change(W, new, 3).max() < 1e-13


# Samples of a kind, from normal ones
KINDS = {
    "gaussian": lambda y, rng: y,
    "product": lambda y, rng: y * rng.normal(size=(len(y), 1)),
    "student": lambda y, rng: y / np.sqrt(rng.chisquare(3, size=(len(y), 1))),
    "laplace": lambda y, rng: y * np.sqrt(rng.exponential(size=(len(y), 1))),
    "uniform": lambda y, rng: rng.uniform(-1.0, 1.0, y.shape),
}


def sources(kinds, seed, n_samples, size):
    """Return centred sources of mean square 1, one of each kind."""
    rng = np.random.default_rng(seed)
    drawn = [KINDS[kind](rng.normal(size=(n_samples, size)), rng) for kind in kinds]
    return standardise(np.stack(drawn))


def standardise(signals):
    """Return signals centred over the samples, of mean square 1."""
    centred = signals - signals.mean(axis=1, keepdims=True)
    return centred / np.sqrt(np.mean(centred**2, axis=(1, 2), keepdims=True))


def random_mixing(seed, n, condition=30.0):
    """Return a matrix of given condition number."""
    scale = np.geomspace(1.0, condition, n)
    return random_rotation(seed, n) * scale @ random_rotation(seed + 1, n)


def unmix(signals):
    """Return the independent signals."""
    return np.tensordot(shared_mixing(signals), signals, 1)


def matched(truth, recovered):
    """Return the recovered signals in the order and with the signs of the truth."""
    products = np.tensordot(truth, recovered, ([1, 2], [1, 2]))
    row, column = linear_sum_assignment(-np.abs(products))
    sign = np.where(products[row, column] < 0, -1.0, 1.0)
    return sign[:, None, None] * recovered[column]


def cosines(truth, recovered):
    """Return the cosine of each true signal with the recovered one."""
    found = matched(truth, recovered)
    sizes = (np.linalg.norm(each, axis=(1, 2)) for each in (truth, found))
    return np.sum(truth * found, axis=(1, 2)) / np.prod([*sizes], axis=0)


class TestRecovery:
    @pytest.mark.parametrize(
        ("n_components", "n_points", "least"), [(5, 68, 0.95), (9, 500, 0.99)]
    )
    def test_basis_shapes(self, n_components, n_points, least):
        sizes = {"n_points": n_points, "n_components": n_components}
        truth = make_nonrigid_tracks(10, **sizes, random_state=0).basis
        mixed = np.tensordot(random_mixing(0, n_components), truth, 1)
        assert cosines(truth, unmix(mixed)).min() > least

    def test_coefficients(self):
        options = {"coefficients": "heavy_tailed", "random_state": 0}
        truth = make_nonrigid_tracks(1500, n_components=5, **options).alpha
        mixed = truth @ random_mixing(0, 5).T
        found = mixed @ independent_coefficients(mixed).T
        assert cosines(truth.T[..., None], found.T[..., None]).min() > 0.99

    @pytest.mark.parametrize(("size", "seed"), [(1, 0), (3, 2)])
    def test_heavy_light_and_gaussian_tails_together(self, size, seed):
        kinds = ["product", "gaussian", "uniform", "student", "laplace", "uniform"]
        truth = sources(kinds, seed, 1500, size)
        found = unmix(np.tensordot(random_mixing(seed, len(kinds)), truth, 1))
        assert cosines(truth, found).min() > 0.97
        # The least Gaussian signals come first, with mean square and skewness.
        assert abs(np.mean(found[-1] * truth[1])) > 0.97
        assert_allclose(np.mean(found**2, axis=(1, 2)), 1.0, rtol=1e-12)
        assert np.all(np.sum(found**3, axis=(1, 2)) >= 0.0)

    def test_mirrored_halves(self):
        # The left and the right side move on their own. Their sums and differences are
        # uncorrelated too, and a stationary point of the likelihood.
        flip = np.array([-1.0, 1.0, 1.0])
        side = sources(["product"] * 3, 0, 34, 3)
        left = np.concatenate([side, 0.02 * side * flip], axis=1)
        right = np.roll(left, 34, axis=1) * flip
        truth = standardise(np.concatenate([left, right]))
        mixed = np.concatenate([truth[:3] + truth[3:], truth[:3] - truth[3:]])
        assert cosines(truth, unmix(mixed)).min() > 0.99


@pytest.mark.parametrize("size", [1, 3])
@pytest.mark.parametrize(
    "kinds",
    [["student", "product", "gaussian", "uniform"], ["gaussian"] * 4],
    ids=["mixed", "gaussian"],
)
def test_invariance_to_basis_order_of_samples_and_rotations(kinds, size, rng):
    signals = sources(kinds, 0, 200 if size == 1 else 68, size)
    found = unmix(signals)
    mixed = np.tensordot(random_mixing(7, len(kinds)), signals, 1)
    order = rng.permutation(signals.shape[1])
    R = -random_rotation(0, size)  # or reflections
    for changed, expected in (
        (1e-6 * mixed, found),
        (signals[:, order], found[:, order]),
        (signals @ R, found @ R),
    ):
        assert_allclose(matched(expected, unmix(changed)), expected, atol=1e-7)


@cache
def log_integral(tail, size):
    """Return the logarithm of the integral of a density over all vectors."""

    def radial(r):
        return r ** (size - 1) * np.exp(log_density(r * r, tail, size))

    ends = (0, 5), (5, 50), (50, 400)
    sphere = {1: 2.0, 3: 4 * np.pi}[size]
    return np.log(sphere * sum(quad(radial, *each)[0] for each in ends))


def log_density(u, tail, size):
    """Return that of Student's t, or of light tails, at squared norms."""
    F = -0.5 * u**2 / (size + 2)
    if tail != LIGHT:
        F = -0.5 * (tail + size) * np.log1p(u / tail)
    return F - 0.5e-3 * u


def log_likelihood(W, Z):
    """Return the likelihood of signals, each with its likeliest density and scale."""
    size, total = Z.shape[2], Z.shape[2] * np.linalg.slogdet(W)[1]
    for y in np.tensordot(W, Z, 1):
        u = np.sum(y**2, axis=1)

        def cost(log_variance, tail, u=u):
            F = log_density(u / np.exp(log_variance), tail, size).mean()
            return log_integral(tail, size) + size / 2 * log_variance - F

        total -= min(minimize_scalar(cost, args=(tail,)).fun for tail in TAILS)
    return total


class TestOptimality:
    @pytest.mark.parametrize(("size", "unit"), [(1, 30.0), (3, 1.0)])
    def test_no_mixing_near_by_is_likelier(self, size, unit, rng):
        kinds = ["product", "uniform", "student", "laplace"]
        Z = unit * sources(kinds, 0, 200, size)
        W = shared_mixing(Z)
        most = log_likelihood(W, Z)
        found = gauge._fit_densities(W, Z)[0]
        assert found == pytest.approx(most, rel=1e-7)
        for _ in range(10):
            step = 1e-3 * rng.normal(size=W.shape) @ W
            below, above = (most - log_likelihood(W + s * step, Z) for s in (-1, 1))
            assert min(below, above) > 0
            assert below == pytest.approx(above, rel=0.2)

    def test_more_starts_find_likelier_signals(self):
        gains = []
        for seed in range(4):
            Z = sources(["gaussian"] * 5, seed, 68, 3)
            mixings = (shared_mixing(Z, n_starts=n) for n in (1, 8))
            few, many = (gauge._fit_densities(W, Z)[0] for W in mixings)
            gains.append(many - few)
        assert np.max(gains) > 1e-3
        assert np.mean(gains) > 0.0


def test_derivatives_of_the_likelihood_by_differences(rng):
    Y, tail = rng.normal(size=(3, 40, 3)), np.array([[2.0], [LIGHT], [8.0]])

    def likelihood(E):
        u = np.sum(np.tensordot(np.eye(3) + E, Y, 1) ** 2, axis=2)
        F = gauge._log_density(u, tail, 3).mean(axis=1).sum()
        return F + 3 * np.linalg.slogdet(np.eye(3) + E)[1]

    slopes = gauge._slopes(np.sum(Y**2, axis=2), tail, 3)
    gradient, blocks = gauge._relative_derivatives(Y, *slopes)
    h = 1e-4
    for E in rng.normal(size=(5, 3, 3)):
        up, here, down = (likelihood(s * h * E) for s in (1, 0, -1))
        first, second = (up - down) / (2 * h), (up - 2 * here + down) / h**2
        assert_allclose(np.sum(gradient * E), first, rtol=1e-6, atol=1e-6)
        curvature = np.einsum("ka,kab,kb->", E, blocks, E) - 3 * np.sum(E * E.T)
        assert_allclose(curvature, second, rtol=1e-4)


def test_ascent_maximises_the_quadratic_model_or_there_is_none(rng):
    root, gradient = rng.normal(size=(5, 5, 5)), rng.normal(size=(5, 5))
    blocks = -(root @ root.mT) - 4.0 * np.eye(5)
    E = gauge._ascent(gradient, blocks, 0.5, 3)
    slope = np.einsum("kab,kb->ka", blocks, E) - 3 * E.T - 0.5 * E
    assert_allclose(gradient + slope, 0, atol=1e-4 * np.linalg.norm(gradient))
    # Weaker blocks than the coupling, blocks without a maximum at all, and a direction
    # that the diagonals of the blocks do not show
    for of_ones, of_unit, shift in ((0, -1, 0.5), (0, 4, 0.5), (10, -16, 0)):
        blocks = np.tile(of_ones * np.ones((5, 5)) + of_unit * np.eye(5), (5, 1, 1))
        assert gauge._ascent(np.ones((5, 5)), blocks, shift, 3) is None


class TestDegenerate:
    @pytest.mark.parametrize("size", [1, 3])
    def test_dependent_signals(self, size):
        truth = sources(["product"] * 3, 0, 300, size)
        signals = np.tensordot(np.random.default_rng(0).normal(size=(5, 3)), truth, 1)
        W = shared_mixing(signals)
        assert np.linalg.cond(W) < 1e3
        assert np.linalg.cond(shared_mixing(1e-9 * signals)) < 1e3
        Y = np.tensordot(W, signals, 1)
        assert_allclose(Y[3:], 0.0, atol=1e-12)
        assert_allclose(matched(unmix(truth), Y[:3]), unmix(truth), atol=1e-9)

    def test_one_signal_and_all_zero(self):
        signals = 5.0 * sources(["product"], 0, 30, 3)
        assert_allclose(np.abs(shared_mixing(signals)), [[0.2]], rtol=1e-12)
        assert_array_equal(shared_mixing(np.zeros((3, 10, 3))), np.eye(3))
        assert_array_equal(independent_coefficients(np.ones((10, 2))), np.eye(2))

    @pytest.mark.parametrize(("n_samples", "size"), [(1, 3), (2, 1), (3, 3), (8, 1)])
    def test_few_samples(self, n_samples, size):
        signals = np.random.default_rng(0).normal(size=(6, n_samples, size))
        rank = min(6, n_samples * size)
        W = shared_mixing(signals)
        assert np.linalg.cond(W) < 1e4
        Y = np.tensordot(W, signals, 1)
        assert_allclose(np.mean(Y**2, axis=(1, 2)), np.arange(6) < rank, atol=1e-9)

    @pytest.mark.parametrize(("n_moving", "shift"), [(1, 0.0), (8, 1.0), (20, 0.0)])
    def test_most_points_rest(self, n_moving, shift, rng):
        # Signals that vanish at most samples: the likelihood must have a bound.
        signals = np.zeros((5, 68, 3)) + shift * rng.normal(size=(5, 1, 3))
        signals[:, :n_moving] += sources(["product"] * 5, 0, 68, 3)[:, :n_moving]
        signals -= signals.mean(axis=1, keepdims=True)
        rank = min(5, 3 * n_moving)
        W = shared_mixing(signals)
        assert np.linalg.cond(W) < 1e4
        found = np.tensordot(W, signals, 1)
        mixed = np.tensordot(random_mixing(3, 5), signals, 1)
        again = matched(found[:rank], unmix(mixed)[:rank])
        if n_moving > 1:
            assert_allclose(again, found[:rank], atol=1e-7)
