"""Tables made ready for a fit: blocks, robust scales, gross outliers, completion."""

import threading

import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal
from scipy.integrate import quad
from scipy.optimize import minimize
from scipy.spatial.transform import Rotation

from isa_nrsfm._parameters import LOSSES
from isa_nrsfm._prepare import robust
from isa_nrsfm._prepare.completion import completion_model, filled_in
from isa_nrsfm._prepare.robust import (
    TUNING,
    WEIGHTS,
    median_noise,
    robust_sizes,
    robustly_centred,
    spatial_median,
)
from isa_nrsfm._tables import FrameBlocks, centred_frames
from isa_nrsfm.datasets import make_nonrigid_tracks

N_FRAMES = 23


# --- blocks: any way of splitting and computing them gives the same ------------------


def stored(array, length, n_threads=1):
    """Return blocks of an array that are read when they are needed."""
    return FrameBlocks.read_later(array.__getitem__, len(array), length, n_threads)


@pytest.fixture
def array():
    return np.random.default_rng(0).normal(size=(N_FRAMES, 4))


def test_stored_blocks_are_computed_when_they_are_needed(array):
    calls = []

    def recorded(block):
        calls.append(len(block))
        return block

    later = stored(array, 10).derive(recorded)
    assert calls == []
    list(later.map(len))
    later.whole()
    assert calls == [10, 10, 3] * 2
    frames = np.isin(np.arange(N_FRAMES), [0, 22])
    assert_array_equal(later.subset(frames).whole(), array[frames])
    assert max(calls) == 10
    calls.clear()
    kept = FrameBlocks.of_array(array, 10).derive(recorded, kept=True)
    assert_array_equal(kept.whole(), kept.whole())
    assert calls == [10, 10, 3]


def test_threads_have_few_results_ahead_and_raise_their_errors(array):
    threads = []

    def recorded(block):
        threads.append(threading.get_ident())
        if len(threads) == 8:
            raise ValueError("no good")

    found = FrameBlocks.of_array(array, 2, n_threads=2).map(recorded)
    for number in range(1, 6):
        next(found)
        assert len(threads) <= number + 2
    with pytest.raises(ValueError, match="no good"):
        list(found)
    assert len(threads) <= 10
    assert threading.get_ident() not in threads


# --- robust losses: weights, scales that outliers hardly change, gross outliers -------


ROBUST = LOSSES[1:]


def normal_mean(function):
    """Return the mean over the distance of normal noise in the plane."""

    def integrand(r):
        return function(r) * r * np.exp(-(r**2) / 2)

    # Beyond 12 the density is below 1e-30.
    return quad(integrand, 0.0, 12.0, epsabs=1e-9)[0]


def efficiency(weight):
    """Return the efficiency of a weight(distance) relative to least squares.

    For a location in the plane it is ``(E div psi / 2)^2 / (E |psi|^2 / 2)`` with psi =
    w x. For normal noise ``E div psi = E psi^T x`` (Stein's lemma). The constant of a
    loss follows with SciPy's brentq, here that of Cauchy's ::

        brentq(lambda c: efficiency(lambda r: 1 / (1 + (r / c) ** 2)) - 0.95, 1, 9)
    """
    slope = normal_mean(lambda r: weight(r) * r**2) / 2
    return slope**2 / (normal_mean(lambda r: (weight(r) * r) ** 2) / 2)


class TestWeights:
    def test_are_the_slope_of_the_loss_over_the_distance(self):
        # rho'(r) / r for rho = r^2 / 2, then c r - c^2 / 2; and c^2/2 log(1 + (r/c)^2).
        c = TUNING["huber"]
        r = np.array([0.1, 0.999 * c, 1.001 * c, 5.0, 1e3])
        assert_allclose(WEIGHTS["huber"](r), [1, 1, c / r[2], c / 5, c / 1e3])
        c, step = TUNING["cauchy"], 1e-5
        above, below = (c**2 / 2 * np.log1p(((r + d) / c) ** 2) for d in (step, -step))
        slope = (above - below) / (2 * step)
        assert_allclose(WEIGHTS["cauchy"](r), slope / r, rtol=1e-6)

    @pytest.mark.parametrize("loss", ROBUST)
    def test_have_95_percent_of_the_efficiency_of_least_squares(self, loss):
        assert efficiency(WEIGHTS[loss]) == pytest.approx(0.95, abs=1e-4)


def test_median_noise_of_normal_noise_is_its_deviation():
    noise = 0.3 * np.random.default_rng(0).normal(size=(100_000, 2))
    noise[:500] += 1e3
    distance = np.linalg.norm(noise, axis=1)
    assert median_noise(distance) == pytest.approx(0.3, rel=0.01)


class TestSpatialMedian:
    def test_has_nearly_the_least_sum_of_distances(self, rng):
        # Rows of different sizes, one of them with missing points
        rows = rng.uniform(0.5, 5, (20, 1, 1)) * rng.normal(size=(20, 2, 31)) ** 3
        rows[3, :, :8] = np.nan
        for frame, middle in zip(rows, spatial_median(rows), strict=True):

            def cost(point, frame=frame):
                return np.nansum(np.linalg.norm(frame.T - point, axis=1))

            assert cost(middle) < 1.001 * minimize(cost, middle).fun
            assert cost(middle) < cost(np.nanmean(frame, axis=1))

    @pytest.mark.parametrize(("n_points", "far"), [(5, 2e153), (31, 1e9)])
    def test_a_point_at_any_distance_costs_no_digits_of_the_others(self, n_points, far):
        rows = np.random.default_rng(0).normal(size=(20, 2, n_points))
        near = np.delete(rows, 2, axis=2)
        rows[:, :, 2] = far
        centred = np.delete(robustly_centred(rows)[0], 2, axis=2)
        middle = centred.mean(axis=2, keepdims=True)
        expected = near - near.mean(axis=2, keepdims=True)
        assert_allclose(centred - middle, expected, rtol=0, atol=1e-14)
        assert np.abs(middle).max() < 3

    def test_of_most_points_in_one_place_is_there(self):
        rows = np.random.default_rng(0).normal(size=(2, 2, 9))
        rows[:, :, :5] = [[3.0], [-2.0]]
        rows[:, :, 8] = 1e30
        assert_allclose(spatial_median(rows), [[3.0, -2.0]] * 2, rtol=1e-12)
        # Exactly, whatever the place: their size is not that of rounding errors.
        places = np.random.default_rng(1).normal(scale=500, size=(50, 2))
        rows = np.repeat(places[..., None], 68, axis=2)
        assert_array_equal(spatial_median(rows), places)
        rows[:, 0, 0] += 1.0
        centred, middle = robustly_centred(rows)
        assert_array_equal(middle, places)
        assert_allclose(robust_sizes(centred), np.sqrt(1 / 68 / 2))


LARGEST_SHARE = 0.4  # of the points of a frame that may be outliers


def gross_outliers(tracks):
    """Return the outliers of tracks, in blocks of seven frames."""
    rows, _ = robustly_centred(tracks.transpose(0, 2, 1))
    return robust.gross_outliers(FrameBlocks.of_array(rows, 7), 60)


def rigid_tracks(noise=0.02, n_frames=40, n_points=30):
    """Return tracks of a rigid object, frames of size about one, at any place."""
    rng = np.random.default_rng(0)
    shape = rng.normal(size=(3, n_points))
    shape -= shape.mean(axis=1, keepdims=True)
    motion = rng.normal(size=(n_frames, 2, 3)) / np.sqrt(3)
    tracks = (motion @ shape).transpose(0, 2, 1)
    tracks += noise * rng.normal(size=tracks.shape)
    return tracks + rng.normal(size=(n_frames, 1, 2))


def spoilt(tracks, distance, share=0.03):
    """Move some points by a distance in any direction; return which, too."""
    rng = np.random.default_rng(1)
    where = rng.random(tracks.shape[:2]) < share
    angle = rng.uniform(0, 2 * np.pi, where.sum())
    moved = tracks.copy()
    moved[where] += distance * np.stack([np.cos(angle), np.sin(angle)], axis=1)
    return moved, where


class TestGrossOutliers:
    @pytest.mark.parametrize("noise", [0.0, 0.02])
    def test_of_clean_tables_there_are_none(self, noise):
        assert not gross_outliers(rigid_tracks(noise)).any()

    @pytest.mark.parametrize(("distance", "missing"), [(0.5, 0), (2, 0.1)])
    def test_are_those_that_were_moved(self, distance, missing):
        # The object is that of at most 60 frames.
        tracks, where = spoilt(rigid_tracks(n_frames=80), distance)
        hidden = np.random.default_rng(2).random(where.shape) < missing
        tracks[hidden] = np.nan
        found = gross_outliers(tracks)
        assert where.sum() > 20
        assert not found[hidden].any()
        assert found[where & ~hidden].mean() > 0.8
        assert found[~where].mean() < 0.02

    def test_a_point_that_is_anywhere_belongs_there(self):
        tracks = rigid_tracks()
        tracks[:, 7] += 8 * np.random.default_rng(1).normal(size=(len(tracks), 2))
        found = gross_outliers(tracks)
        assert not found[:, 7].any()
        assert found.mean() < 0.05

    def test_a_point_that_is_off_in_some_frames_does_not(self):
        tracks = rigid_tracks()
        some = int(LARGEST_SHARE * len(tracks) / 2)
        tracks[:some, 7] += np.random.default_rng(1).choice([-1, 1], size=(some, 2))
        found = gross_outliers(tracks)
        assert found[:some, 7].mean() > 0.8
        assert not found[some:].any()

    def test_frames_with_many_of_them_keep_all_points(self):
        tracks, rng = rigid_tracks(), np.random.default_rng(1)
        some = int(LARGEST_SHARE * tracks.shape[1] / 2)
        tracks[4] = rng.normal(size=tracks.shape[1:])
        tracks[9, :some] += rng.normal(size=(some, 2))
        found = gross_outliers(tracks)
        assert not found[4].any()
        assert found[9, :some].mean() > 0.8
        assert found[9, some:].mean() < 0.1


# --- completion by a low-rank model --------------------------------------------------


def hide(tracks, seen):
    """Return tracks with NaN where points are not seen."""
    return np.where(seen[..., None], tracks, np.nan)


def random_mask(shape, missing, seed, least=4):
    """Return a mask of seen points, at least some in every frame."""
    order = np.random.default_rng(seed).random(shape)
    rank = order.argsort(axis=1).argsort(axis=1)
    return (order >= missing) | (rank >= shape[1] - least)


def unit_rows(tracks):
    """Return tracks as rows of size one, their centroids and sizes."""
    rows, report = centred_frames(tracks.transpose(0, 2, 1))
    return rows / report.size[:, None, None], report.translation, report.size


def completed(tracks, n_components):
    """Return tracks in place of those with missing points, centred and of size one."""
    rows, _, _ = unit_rows(tracks)
    filled = filled_in(rows, completion_model(rows, 3 * n_components + 3))
    assert_allclose(filled.mean(axis=2), 0, atol=1e-12)
    # Seen points are the given ones minus a shift.
    filled += np.nanmean(rows - filled, axis=2, keepdims=True)
    assert_allclose(np.where(np.isnan(rows), filled, rows), filled, rtol=0, atol=1e-12)
    return filled.transpose(0, 2, 1)


def held_out_error(tracks, seen, n_components):
    """Return the root of the inverse SNR of the hidden points."""
    hidden = hide(tracks, seen)
    _, translation, sizes = unit_rows(hidden)
    truth = (tracks - translation[:, None]) / sizes[:, None, None]
    error = completed(hidden, n_components) - truth
    return np.linalg.norm(error[~seen]) / np.linalg.norm(truth[~seen])


# --- the model ----------------------------------------------------------------------


@pytest.fixture(scope="module")
def small():
    """Return rows of a small noisy table, with a complete and a repeated pattern."""
    scene = make_nonrigid_tracks(24, 9, 1, noise=0.1, random_state=0)
    seen = random_mask((24, 9), 0.3, 0)
    seen[5:8] = True
    seen[10:13] = seen[10]
    return unit_rows(hide(scene.tracks, seen))[0]


def log_likelihood(B, noise, rows):
    """Return that of all rows, as said by normal densities without translation."""
    total = 0.0
    for frame in rows:
        mask = ~np.isnan(frame[0])
        n = mask.sum()
        # Contrasts of the seen points: an orthonormal basis of what sums to zero.
        contrasts = np.linalg.svd(np.ones((1, n)))[2][1:]
        covariance = contrasts @ (B[:, mask].T @ B[:, mask]) @ contrasts.T
        covariance += noise * np.eye(n - 1)
        for row in frame[:, mask] @ contrasts.T:
            total -= 0.5 * row @ np.linalg.solve(covariance, row)
            total -= 0.5 * np.linalg.slogdet(covariance)[1]
    return total


def test_missing_points_are_conditional_expectations(small):
    B, noise = model = completion_model(small, 6)
    filled = filled_in(small, model)
    filled += np.nanmean(small - filled, axis=2, keepdims=True)
    far = 1e7  # variance of the translation, which may be anything
    covariance = B.T @ B + noise * np.eye(9) + far
    for frame, result in zip(small, filled, strict=True):
        mask = ~np.isnan(frame[0])
        inverse = np.linalg.inv(covariance[np.ix_(mask, mask)])
        gain = covariance[np.ix_(~mask, mask)] @ inverse
        assert_allclose(result[:, ~mask], frame[:, mask] @ gain.T, atol=1e-5)


def test_the_fit_is_a_stationary_point_of_the_likelihood(small, rng):
    B, noise = completion_model(small, 3, tol=-1.0, max_iter=500)  # never ends before
    best = log_likelihood(B, noise, small)
    steps = [1e-4 * rng.normal(size=B.shape) * np.std(B) for _ in range(10)]
    near = [[(B + step, noise), (B - step, noise)] for step in steps]
    for pair in (*near, [(B, 1.001 * noise), (B, noise / 1.001)]):
        up, down = (log_likelihood(*parameters, small) for parameters in pair)
        assert abs(up - down) < 1e-6
        assert max(up, down) < best


def test_points_that_are_never_seen_together(rng):
    # On an opaque ball
    points = rng.normal(size=(40, 3))
    points /= np.linalg.norm(points, axis=1, keepdims=True)
    image = points @ Rotation.random(200, rng).as_matrix().mT
    tracks, seen = image[..., :2], image[..., 2] > 0.3
    together = seen.T.astype(float) @ seen
    assert np.mean(together == 0) > 0.1
    assert held_out_error(tracks, seen, 0) < 1e-6


# --- degenerate tables --------------------------------------------------------------


@pytest.mark.parametrize(
    ("n_components", "dtype", "limit"),
    [(1, np.float64, 1e-5), (5, np.float32, 3e-4)],
)
def test_rigid_and_flat_objects_and_more_basis_shapes(n_components, dtype, limit, rng):
    seen = random_mask((200, 40), 0.3, 0)
    rigid = make_nonrigid_tracks(200, 40, 0, random_state=0).tracks
    flat = rng.normal(size=(40, 2)) @ rng.normal(size=(200, 2, 2)) + 5
    for tracks in (rigid, flat):
        assert held_out_error(tracks.astype(dtype), seen, n_components) < limit


def test_small_tables_and_points_and_frames_that_are_rarely_seen():
    for n_frames, n_points in ((8, 13), (100, 30)):
        tracks = make_nonrigid_tracks(n_frames, n_points, 3, random_state=0).tracks
        seen = random_mask((n_frames, n_points), 0.1, 3)
        assert np.isfinite(completed(hide(tracks, seen), 3)).all()
    seen[:] = True
    seen[6:, 3] = False
    seen[50:, 4:] = False
    assert np.isfinite(completed(hide(tracks, seen), 3)).all()
    seen[90:, 1:] = False
    rows = hide(tracks - tracks[:, :1], seen).transpose(0, 2, 1)
    assert np.isfinite(filled_in(rows, completion_model(rows, 12))).all()
