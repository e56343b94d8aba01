"""Measures that ignore what the images cannot determine, and nothing else."""

from functools import partial
from itertools import permutations

import numpy as np
import pytest
from made_once import made_once
from numpy.testing import assert_allclose, assert_array_equal
from refusals import refusals_of
from scenes import random_rotation
from scipy.optimize import minimize
from scipy.spatial.transform import Rotation
from scipy.stats import ortho_group

from isa_nrsfm.datasets import make_nonrigid_tracks
from isa_nrsfm.metrics import (
    affine_shape_error,
    basis_similarity,
    inverse_snr,
    mean_shape_error_3d,
    subspace_distance,
)

AFFINITIES = [
    np.diag([1.0, -1.0, 1.0]),
    np.array([[1.0, 0.5, 0.2], [0.0, 2.0, -0.3], [0.3, 0.0, 0.4]]),
    np.diag([1.0, 1e3, 1e-3]),
]
FLAT = np.array([[0.0, 0.0, 2.0, 0.0], [1.0, 1.0, 1.0, 1.0]])
# Centred: (-1, 0), (1, 0) and (0, -1), (0, 1), energy 4; the second frame is
# reprojected at half its size, error 2 * 0.25.
SEEN = np.array([[0.0, 0.0, 2.0, 0.0], [5.0, 5.0, 5.0, 7.0]])
FITTED = np.array([[3.0, 1.0, 5.0, 1.0], [0.0, 0.0, 0.0, 1.0]])
LARGE = np.array([[0.0, 0.0, 2.0, 0.0], [0.0, 0.0, 0.0, 200.0]])
# Pairs of points on the axes: frames weigh alike, so that A = diag(1, 1, c).
AXES = np.tile(np.vstack([np.eye(3), -np.eye(3)]), (2, 1, 1))


@made_once
def deforming():
    return make_nonrigid_tracks(60, 30, 3, amplitude=0.3, random_state=0)


def similarity(of_truth, of_estimate, with_mean=False, **options):
    """Return similarities of bases of `deforming`, whose shapes are changed."""
    mean = deforming().mean_shape if with_mean else None
    bases = [deforming().basis.copy() for _ in range(2)]
    for basis, changed in zip(bases, (of_truth, of_estimate), strict=True):
        for k, shape in changed.items():
            basis[k] = shape
    means = {"mean_shape_true": mean, "mean_shape": mean}
    return basis_similarity(*bases, **means, **options)


def noisy_tracks(rng):
    tracks = rng.standard_normal((6, 5, 2))
    return tracks, tracks + 0.1 * rng.standard_normal((6, 5, 2))


@pytest.mark.parametrize("scale_frames", [False, True])
class TestInverseSNR:
    def test_invariances(self, rng, scale_frames):
        tracks, fitted = noisy_tracks(rng)

        def value(a, b, **more):
            tables = a.reshape(6, -1), b.reshape(6, -1)
            return inverse_snr(*tables, scale_frames=scale_frames, **more)

        expected = value(tracks, fitted)
        assert 0.001 < expected < 0.1
        shift = 100 * rng.standard_normal((2, 6, 1, 2))
        order, scales = rng.permutation(5), rng.uniform(1, 9, (6, 1, 1))
        for changed in (
            (tracks + shift[0], fitted + shift[1]),
            (7 * tracks, 7 * fitted),
            (tracks[:, order], fitted[:, order]),
        ):
            assert_allclose(value(*changed), expected)
        assert_allclose(value(tracks.mT, fitted.mT, layout="planar"), expected)
        assert not np.isclose(value(tracks.mT, fitted.mT), expected)
        rescaled = value(scales * tracks, scales * fitted)
        assert np.isclose(rescaled, expected) == scale_frames

    def test_missing_points_are_left_out(self, rng, scale_frames):
        tracks, fitted = noisy_tracks(rng)
        seen = [each[:5, :3].reshape(5, -1) for each in (tracks, fitted)]
        expected = inverse_snr(*seen, scale_frames=scale_frames)
        # One coordinate is enough; a frame without points does not count.
        tracks[:, 3], tracks[:, 4, 0], tracks[5] = np.nan, np.nan, np.nan
        fitted[:, 3], fitted[:, 4] = 1e6, np.nan
        tables = tracks.reshape(6, -1), fitted.reshape(6, -1)
        assert_allclose(inverse_snr(*tables, scale_frames=scale_frames), expected)


def test_affine_errors_of_planar_and_zero_estimates():
    shapes = deforming().shapes
    lost = np.linalg.norm(shapes[..., 2], axis=1) / np.linalg.norm(shapes, axis=(1, 2))
    assert 0 < affine_shape_error(shapes, shapes * (1, 1, 0)) <= lost.mean() + 1e-9
    assert affine_shape_error(shapes, np.zeros_like(shapes)) == 1
    # A frame without an estimate counts as lost and does not disturb the others.
    X = shapes.copy()
    X[7] = 5.0
    assert_allclose(affine_shape_error(shapes, X), 1 / 60, atol=1e-12)


def unit_shapes(shapes):
    shapes = shapes - shapes.mean(axis=1, keepdims=True)
    return shapes / np.linalg.norm(shapes, axis=(1, 2), keepdims=True)


class TestBasisSimilarity:
    @pytest.mark.parametrize("affinity", AFFINITIES)
    @pytest.mark.parametrize("means", ["unknown", "known", "modulo"])
    def test_one_for_equivalent_bases(self, affinity, means):
        scene, given = deforming(), {}
        factors, multiples = np.reshape([[-2, 0.1, 5], [0.1, -0.2, 0.05]], (2, 3, 1, 1))
        estimate = factors * scene.basis[[2, 0, 1]]
        if means != "unknown":
            given["mean_shape_true"] = scene.mean_shape
            given["mean_shape"] = 3 * scene.mean_shape @ affinity.T + 4.0
        if means == "modulo":
            estimate = estimate + multiples * scene.mean_shape
            mixed = basis_similarity(scene.basis, estimate @ affinity.T, **given)
            assert mixed.min() < 0.97
            given["modulo_mean_shape"] = True
        bases = scene.basis, estimate @ affinity.T + [1.0, 2.0, 3.0]
        similarity, matching = basis_similarity(*bases, return_matching=True, **given)
        assert_allclose(similarity, 1, atol=1e-10)
        assert_array_equal(matching, [1, 2, 0])
        assert_array_equal(basis_similarity(*bases, **given), similarity)

    def test_matching_is_the_best_of_all(self, rng):
        scene = deforming()
        estimate = rng.standard_normal(scene.basis.shape)
        means = {"mean_shape_true": scene.mean_shape, "mean_shape": scene.mean_shape}
        similarity = basis_similarity(scene.basis, estimate, **means)
        truth, other = unit_shapes(scene.basis), unit_shapes(estimate)
        cosines = np.einsum("kjc,ljc->kl", truth, other)
        best = max(np.sum(cosines[range(3), p] ** 2) for p in permutations(range(3)))
        assert_allclose(np.sum(similarity**2), best)

    def test_free_affinity_is_optimal(self, rng):
        truth = unit_shapes(rng.standard_normal((3, 10, 3)))
        noise = 0.5 * rng.standard_normal(truth.shape)
        other = unit_shapes(0.3 * truth + noise)[::-1]
        quality = np.sum(basis_similarity(truth, other) ** 2)

        def cost(a):
            images = unit_shapes(other[::-1] @ a.reshape(3, 3))
            return -np.sum(np.sum(truth * images, axis=(1, 2)) ** 2)

        for start in (np.eye(3), *rng.standard_normal((2, 3, 3))):
            assert quality >= -minimize(cost, start.ravel()).fun - 1e-7


class TestSubspaceDistance:
    def test_invariances(self, rng):
        a = rng.standard_normal((4, 3, 14))
        b = a + 0.3 * rng.standard_normal(a.shape)

        def value(x, y):
            return subspace_distance(x.reshape(12, 14), y.reshape(12, 14), 3)

        expected = value(a, b)
        assert 0.05 < expected < 1
        rotation = ortho_group.rvs(14, random_state=rng)
        mixing, other = rng.standard_normal((2, 4, 3, 3))
        for pair in (
            (b, a),
            (a, mixing @ b),
            (a, rng.permutation(b)),
            (a @ rotation, b @ rotation),
        ):
            assert_allclose(value(*pair), expected, atol=1e-10)
        assert value(a, other @ a) < 1e-11

    def test_matching_is_the_best_of_all(self, rng):
        for _ in range(5):
            a, b = rng.standard_normal((2, 4, 2, 5))
            pairs = [[subspace_distance(x, y, 2) for y in b] for x in a]
            orders = permutations(range(4))
            expected = min(max(pairs[k][p[k]] for k in range(4)) for p in orders)
            distance = subspace_distance(a.reshape(8, 5), b.reshape(8, 5), 2)
            assert_allclose(distance, expected)


def centred(shapes):
    return shapes - shapes.mean(axis=1, keepdims=True)


class TestErrorsIn3D:
    def test_as_written_in_the_docstring(self):
        truth, shapes = centred(TRUTH), centred(SHAPES)

        def turned(S, X):
            return Rotation.align_vectors(S, X)[0].apply(X)

        S, X = np.concatenate(truth), np.concatenate(shapes)
        distance = np.linalg.norm(S - turned(S, X), axis=1)
        expected = np.mean(distance) / np.mean([S.std(axis=0) for S in truth])
        assert mean_shape_error_3d(TRUTH, SHAPES) == pytest.approx(expected, rel=1e-9)
        errors = []
        for S, X in zip(truth, map(turned, truth, shapes), strict=True):
            rest = S - np.vdot(S, X) / np.vdot(X, X) * X
            errors.append(np.linalg.norm(rest) / np.linalg.norm(S))
        found = mean_shape_error_3d(TRUTH, SHAPES, convention="frame")
        assert found == pytest.approx(np.mean(errors), rel=1e-9)


# A square in the plane, of standard deviations 1, 1, 0, and its corners moved along z,
# which no rotation undoes. One mirror image is for both frames: the first frame alone
# would not choose it.
SQUARE = np.array([[1.0, 1, 0], [1, -1, 0], [-1, 1, 0], [-1, -1, 0]])
TWIST = np.array([[0.0, 0, 1], [0, 0, -1], [0, 0, -1], [0, 0, 1]])
TWO = np.stack([SQUARE, SQUARE + TWIST])
TWISTED = TWO + 0.1 * TWIST
# Their least squares scale, and the lengths of what it leaves
SCALE = np.vdot(TWO, TWISTED) / np.vdot(TWISTED, TWISTED)
LEFT = np.linalg.norm(TWO - SCALE * TWISTED, axis=(1, 2)) / np.sqrt([8, 12])
by_camera = partial(mean_shape_error_3d, convention="camera")


def test_of_a_published_estimate(load_data):
    # The trajectory-space estimate of Akhter et al. that comes with their data.
    data = load_data("akhter_drink")
    error = mean_shape_error_3d(data["S3d"], data["S3d_akhter_estimate"])
    assert error == pytest.approx(0.0249, abs=1e-4)


MEASURES = {
    "affine": affine_shape_error,
    "sequence": mean_shape_error_3d,
    "frame": partial(mean_shape_error_3d, convention="frame"),
    "scaled sequence": partial(mean_shape_error_3d, scale=True),
    "frame, no scale": partial(mean_shape_error_3d, convention="frame", scale=False),
    "camera": partial(mean_shape_error_3d, convention="camera"),
    "scaled camera": partial(mean_shape_error_3d, convention="camera", scale=True),
}
ALL = set(MEASURES)
N, J = 6, 15
RNG = np.random.default_rng(0)
TRUTH = RNG.standard_normal((N, J, 3)) + 4.0
SHAPES = TRUTH + 0.3 * RNG.standard_normal((N, J, 3))
FRAMES, POINTS = RNG.permutation(N), RNG.permutation(J)
SCALES = RNG.uniform(0.2, 3.0, (N, 1, 1))
SIGNS = np.resize([1.0, -1.0], (N, 1, 1))
TURNS = np.stack([random_rotation(i) for i in range(N)])
MIRROR = np.diag([1.0, 1.0, -1.0])
# What is done to truth and shapes, and which measures do not change by it.
CHANGES = {
    "places": (lambda S, X: (S + TURNS[:, :1], X + 9 * TURNS[:, 1:2]), ALL),
    "order": (lambda S, X: (S[FRAMES][:, POINTS], X[FRAMES][:, POINTS]), ALL),
    "common rotation": (
        lambda S, X: (S, X @ TURNS[1]),
        ALL - {"camera", "scaled camera"},
    ),
    "common mirror image": (lambda S, X: (S, X @ MIRROR), ALL),
    "small unit": (lambda S, X: (1e-80 * S, 1e-80 * X), ALL),
    "large unit": (lambda S, X: (1e75 * S, 1e75 * X), ALL),
    "common scale": (
        lambda S, X: (S, 3 * X),
        {"affine", "frame", "scaled sequence", "scaled camera"},
    ),
    "scales of frames": (lambda S, X: (S, SCALES * X), {"affine", "frame"}),
    "points reflected in frames": (
        lambda S, X: (S, SIGNS * X),
        {"affine", "frame", "frame, no scale"},
    ),
    "rotations of frames": (lambda S, X: (S, X @ TURNS), {"frame", "frame, no scale"}),
    "affinity": (lambda S, X: (S, X @ AFFINITIES[1]), {"affine"}),
    "singular affinity": (lambda S, X: (S, X @ AFFINITIES[2]), {"affine"}),
}


@pytest.mark.parametrize("measure", MEASURES)
@pytest.mark.parametrize("change", CHANGES)
def test_invariance(measure, change):
    changed, invariant = CHANGES[change]
    error = MEASURES[measure]
    expected, found = error(TRUTH, SHAPES), error(*changed(TRUTH, SHAPES))
    assert 0.01 < expected < 1
    assert (found == pytest.approx(expected, rel=1e-7)) == (measure in invariant)
    # Equal shapes have no error, and changed ones none if the measure ignores it.
    assert error(TRUTH, TRUTH) < 1e-12
    assert (error(*changed(TRUTH, TRUTH)) < 1e-11) == (measure in invariant)


test_refusals = refusals_of("metrics", globals())
