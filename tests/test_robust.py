"""Robust losses: weights, scales that outliers hardly change, and gross outliers."""

import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal
from scipy.integrate import quad
from scipy.optimize import minimize

from isa_nrsfm._parameters.choices import LOSSES
from isa_nrsfm._prepare import robust
from isa_nrsfm._prepare.robust import (
    DISTANT,
    TUNING,
    WEIGHTS,
    distant_points,
    frame_weights,
    median_noise,
    robust_sizes,
    robustly_centred,
    spatial_median,
)
from isa_nrsfm._tables.blocks import FrameBlocks

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


def turned(rows, angle):
    """Return each image (2, n_points) turned by its angle."""
    c, s = np.cos(angle), np.sin(angle)
    return np.array([[c, -s], [s, c]]).transpose(2, 0, 1) @ rows


def random_rows():
    """Return rows of different sizes, one of them with missing points."""
    rng = np.random.default_rng(0)
    rows = rng.uniform(0.5, 5, (20, 1, 1)) * rng.normal(size=(20, 2, 31)) ** 3
    rows[3, :, :8] = np.nan
    return rows


class TestWeights:
    @pytest.mark.parametrize("loss", LOSSES)
    def test_fall_from_one(self, loss):
        weights = WEIGHTS[loss](np.linspace(0, 30, 400))
        assert weights[0] == 1.0
        assert (np.diff(weights) <= 0).all()
        assert (weights > 0).all()
        assert (weights[-1] < 0.1) == (loss != "linear")

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


class TestFrameWeights:
    def test_each_loss_has_weights(self):
        assert tuple(WEIGHTS) == LOSSES

    @pytest.mark.parametrize("loss", ROBUST)
    def test_points_that_do_not_belong_to_their_frame_have_none(self, loss):
        distance = [[0.0, 3.0, 11.9, 12.1, np.inf], [0.0, 3.0, 5.9, 6.1, 1e200]]
        distance = np.array(distance)
        weights = frame_weights(loss, distance, 0.5, np.array([2.0, 1.0]))
        expected = WEIGHTS[loss](distance[:, :3] / 0.5)
        assert_array_equal(weights, np.pad(expected, ((0, 0), (0, 2))))


def test_median_noise_of_normal_noise_is_its_deviation():
    noise = 0.3 * np.random.default_rng(0).normal(size=(100_000, 2))
    noise[:500] += 1e3
    distance = np.linalg.norm(noise, axis=1)
    assert median_noise(distance) == pytest.approx(0.3, rel=0.01)


class TestSpatialMedian:
    def test_has_nearly_the_least_sum_of_distances(self):
        rows = random_rows()
        for frame, middle in zip(rows, spatial_median(rows), strict=True):

            def cost(point, frame=frame):
                return np.nansum(np.linalg.norm(frame.T - point, axis=1))

            assert cost(middle) < 1.001 * minimize(cost, middle).fun
            assert cost(middle) < cost(np.nanmean(frame, axis=1))

    def test_moves_and_turns_with_the_image(self):
        rows, angle = random_rows(), np.linspace(0, np.pi, 20)
        expected = turned(10 * spatial_median(rows)[..., None], angle)[..., 0] + 3.0
        got = spatial_median(turned(10 * rows, angle) + 3.0)
        assert_allclose(got, expected, atol=1e-9)

    @pytest.mark.parametrize("n_points", [5, 7, 31])
    @pytest.mark.parametrize("far", [1e9, 1e16, 1e140])
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
        assert_array_equal(spatial_median(rows), places)
        assert_allclose(robust_sizes(rows), np.sqrt(1 / 68 / 2))


def test_sizes_by_definition():
    rows = random_rows()
    for frame, size in zip(rows, robust_sizes(rows), strict=True):
        points = frame[:, np.isfinite(frame[0])]
        square = np.sum((points - spatial_median(points[None]).T) ** 2, axis=0)
        assert size == pytest.approx(np.sqrt(np.median(square) / 2))


def test_distant_points_by_definition(rng):
    rows = rng.normal(size=(10, 2, 15))
    rows[3, :, :4] = np.nan
    expected = np.zeros((10, 15), dtype=bool)
    expected[5, 2] = expected[6, 3] = True
    rows[5, :, 2] += 8 * DISTANT
    rows[6, 1, 3] -= 8 * DISTANT
    assert_array_equal(distant_points(rows), expected)
    assert_array_equal(distant_points(0.1 * rows + 5.0), expected)


LARGEST_SHARE = 0.4  # of the points of a frame that may be outliers


def gross_outliers(tracks):
    """Return the outliers of tracks, in blocks of seven frames."""
    rows = FrameBlocks.of_array(tracks.transpose(0, 2, 1), 7)
    return robust.gross_outliers(rows, 60)


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

    @pytest.mark.parametrize(
        ("n_frames", "distance"), [(40, 0.5), (40, 2.0), (40, 8.0), (200, 2.0)]
    )
    def test_are_those_that_were_moved(self, n_frames, distance):
        # The object is that of at most 60 frames.
        tracks, where = spoilt(rigid_tracks(n_frames=n_frames), distance)
        found = gross_outliers(tracks)
        assert where.sum() > 20
        assert found[where].mean() > 0.8
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

    def test_missing_points_are_not_among_them(self):
        tracks, where = spoilt(rigid_tracks(), 2.0)
        hidden = np.random.default_rng(2).random(where.shape) < 0.1
        tracks[hidden] = np.nan
        found = gross_outliers(tracks)
        assert not found[hidden].any()
        assert found[where & ~hidden].mean() > 0.8
        assert found[~where].mean() < 0.05

    def test_frames_with_many_of_them_keep_all_points(self):
        tracks, rng = rigid_tracks(), np.random.default_rng(1)
        some = int(LARGEST_SHARE * tracks.shape[1] / 2)
        tracks[4] = rng.normal(size=tracks.shape[1:])
        tracks[9, :some] += rng.normal(size=(some, 2))
        found = gross_outliers(tracks)
        assert not found[4].any()
        assert found[9, :some].mean() > 0.8
        assert found[9, some:].mean() < 0.1

    def test_place_unit_and_order(self):
        tracks, _ = spoilt(rigid_tracks(), 2.0)
        rng = np.random.default_rng(2)
        frames, points = (rng.permutation(n) for n in tracks.shape[:2])
        expected = gross_outliers(tracks)
        moved = 10 * tracks + rng.normal(size=(len(tracks), 1, 2))
        got = gross_outliers(moved[frames][:, points])
        assert_array_equal(got, expected[frames][:, points])
