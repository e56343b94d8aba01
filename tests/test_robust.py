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


def turned(tracks, angle):
    """Return each image turned by its angle."""
    c, s = np.cos(angle), np.sin(angle)
    return np.einsum("rci,ijc->ijr", np.array([[c, -s], [s, c]]), tracks)


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
        with pytest.raises(KeyError, match="no such loss"):
            frame_weights("no such loss", np.ones((1, 5)), 1.0, np.ones(1))

    @pytest.mark.parametrize("loss", ROBUST)
    def test_points_that_do_not_belong_to_their_frame_have_none(self, loss):
        distance = [[0.0, 3.0, 11.9, 12.1, np.inf], [0.0, 3.0, 5.9, 6.1, 1e200]]
        distance = np.array(distance)
        weights = frame_weights(loss, distance, 0.5, np.array([2.0, 1.0]))
        expected = WEIGHTS[loss](distance[:, :3] / 0.5)
        assert_array_equal(weights, np.pad(expected, ((0, 0), (0, 2))))

    @pytest.mark.parametrize("loss", ROBUST)
    def test_points_far_from_the_others_count_where_the_model_shows_them(self, loss):
        distance = np.full((1, 9), 0.1)
        assert (frame_weights(loss, distance, 1.0, np.ones(1)) > 0.9).all()


class TestMedianNoise:
    def test_of_normal_noise_is_its_deviation(self):
        noise = 0.3 * np.random.default_rng(0).normal(size=(100_000, 2))
        distance = np.linalg.norm(noise, axis=1)
        assert median_noise(distance) == pytest.approx(0.3, rel=0.01)

    def test_hardly_notices_outliers(self):
        noise = np.random.default_rng(0).normal(size=(10_000, 2))
        noise[:500] += 1e3
        assert median_noise(np.linalg.norm(noise, axis=1)) == pytest.approx(1, rel=0.1)


class TestSpatialMedian:
    def random_tracks(self):
        tracks = np.random.default_rng(0).normal(size=(20, 31, 2)) ** 3
        tracks[3, :8] = np.nan
        return tracks

    def test_has_nearly_the_least_sum_of_distances(self):
        tracks = self.random_tracks()
        for frame, middle in zip(
            tracks, spatial_median(tracks.transpose(0, 2, 1)), strict=True
        ):

            def cost(point, frame=frame):
                return np.nansum(np.linalg.norm(frame - point, axis=1))

            assert cost(middle) < 1.001 * minimize(cost, middle).fun
            assert cost(middle) < cost(np.nanmean(frame, axis=0))

    def test_moves_and_turns_with_the_image(self):
        tracks = self.random_tracks()
        angle = np.linspace(0, np.pi, len(tracks))
        expected = (
            turned(10 * spatial_median(tracks.transpose(0, 2, 1))[:, None], angle)[:, 0]
            + 3.0
        )
        got = spatial_median((turned(10 * tracks, angle) + 3.0).transpose(0, 2, 1))
        assert_allclose(got, expected, atol=1e-9)

    def test_of_points_in_one_place_is_there(self):
        assert_allclose(spatial_median(np.full((2, 2, 5), 3.0)), 3.0)

    @pytest.mark.parametrize("n_points", [5, 7, 31])
    def test_a_point_at_any_distance_costs_no_digits_of_the_others(self, n_points):
        tracks = np.random.default_rng(0).normal(size=(20, n_points, 2))
        spoilt = [tracks.copy() for _ in range(3)]
        for far, each in zip([1e9, 1e16, 1e140], spoilt, strict=True):
            each[:, 2] = far
        near = tracks[:, np.arange(n_points) != 2]
        expected = near - near.mean(axis=1, keepdims=True)
        for each in spoilt:
            centred = robustly_centred(each.transpose(0, 2, 1))[0].transpose(0, 2, 1)[
                :, np.arange(n_points) != 2
            ]
            middle = centred.mean(axis=1, keepdims=True)
            assert_allclose(centred - middle, expected, rtol=0, atol=1e-14)
            assert np.abs(middle).max() < 3

    def test_of_most_points_in_one_place_is_there(self):
        tracks = np.random.default_rng(0).normal(size=(2, 9, 2))
        tracks[:, :5] = [3.0, -2.0]
        tracks[:, 8] = 1e30
        assert_allclose(
            spatial_median(tracks.transpose(0, 2, 1)), [[3.0, -2.0]] * 2, rtol=1e-12
        )
        # Exactly, whatever the place: their size is not that of rounding errors.
        places = np.random.default_rng(1).normal(scale=500, size=(50, 2))
        tracks = np.repeat(places[:, None], 68, axis=1)
        tracks[:, 0] += [1.0, 0.0]
        assert_array_equal(spatial_median(tracks.transpose(0, 2, 1)), places)
        assert_allclose(robust_sizes(tracks.transpose(0, 2, 1)), np.sqrt(1 / 68 / 2))


class TestSizes:
    def random_tracks(self, n_frames=20, n_points=31):
        rng = np.random.default_rng(0)
        sizes = rng.uniform(0.5, 5, (n_frames, 1, 1))
        return sizes * rng.normal(size=(n_frames, n_points, 2))

    def test_by_definition(self):
        tracks = self.random_tracks()
        tracks[3, :8] = np.nan
        got = robust_sizes(tracks.transpose(0, 2, 1))
        for frame, size in zip(tracks, got, strict=True):
            points = frame[np.isfinite(frame).all(axis=1)]
            middle = spatial_median(points.T[None])
            square = np.sum((points - middle) ** 2, axis=1)
            assert size == pytest.approx(np.sqrt(np.median(square) / 2))

    def test_where_most_points_are_in_one_place(self):
        tracks = self.random_tracks()
        tracks[2, :20] = 1.0
        square = np.sum((tracks[2] - 1.0) ** 2, axis=1)
        size = robust_sizes(tracks.transpose(0, 2, 1))[2]
        assert size == pytest.approx(np.sqrt(np.mean(square) / 2))


class TestDistantPoints:
    def test_by_definition(self, rng):
        tracks = rng.normal(size=(10, 15, 2))
        tracks[3, :4] = np.nan
        tracks[5, 2] += 8 * DISTANT
        tracks[6, 3, 1] -= 8 * DISTANT
        expected = np.zeros(tracks.shape[:2], dtype=bool)
        expected[5, 2] = expected[6, 3] = True
        assert_array_equal(distant_points(tracks.transpose(0, 2, 1)), expected)
        assert_array_equal(
            distant_points((0.1 * tracks + 5.0).transpose(0, 2, 1)), expected
        )


LARGEST_SHARE = 0.4  # of the points of a frame that may be outliers


def gross_outliers(tracks, model_frames=1000):
    """Return the outliers of tracks, in blocks of seven frames."""
    rows = FrameBlocks.of_array(tracks.transpose(0, 2, 1), 7)
    return robust.gross_outliers(rows, model_frames)


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
    def test_of_clean_tables_there_are_none(self):
        assert not gross_outliers(rigid_tracks()).any()

    @pytest.mark.parametrize("distance", [0.5, 2.0, 8.0])
    def test_are_those_that_were_moved(self, distance):
        tracks, where = spoilt(rigid_tracks(), distance)
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
        tracks = rigid_tracks()
        tracks[4] = np.random.default_rng(1).normal(size=tracks.shape[1:])
        assert not gross_outliers(tracks)[4].any()

    def test_frames_with_not_so_many_do_not(self):
        tracks = rigid_tracks()
        some = int(LARGEST_SHARE * tracks.shape[1] / 2)
        tracks[9, :some] += np.random.default_rng(1).normal(size=(some, 2))
        found = gross_outliers(tracks)[9]
        assert found[:some].mean() > 0.8
        assert found[some:].mean() < 0.1

    def test_are_found_with_the_object_of_some_frames(self):
        tracks, where = spoilt(rigid_tracks(n_frames=200), 2.0)
        found = gross_outliers(tracks, model_frames=60)
        assert found[where].mean() > 0.8
        assert found[~where].mean() < 0.02

    def test_place_unit_and_order(self):
        tracks, _ = spoilt(rigid_tracks(), 2.0)
        rng = np.random.default_rng(2)
        frames, points = (rng.permutation(n) for n in tracks.shape[:2])
        expected = gross_outliers(tracks)
        moved = 10 * tracks + rng.normal(size=(len(tracks), 1, 2))
        got = gross_outliers(moved[frames][:, points])
        assert_array_equal(got, expected[frames][:, points])

    def test_of_exact_rigid_tables_there_are_none(self):
        assert not gross_outliers(rigid_tracks(noise=0.0)).any()
