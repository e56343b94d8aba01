"""Tables, tracks and the measurement matrix."""

import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal
from refusals import refused
from scenes import measurements, with_missing

from isa_nrsfm._tables.tracks import (
    FEWEST_POINTS,
    LAYOUTS,
    centred_frames,
    centred_tracks,
    check_frames,
    clean_tracks,
    measurement_matrix,
    seen_points,
    table_to_tracks,
    weighting_sizes,
)

UNITS = [1e-9, 1.0, 1e9]


class TestLayouts:
    def test_columns_by_hand(self):
        tracks = [[[1, 2], [3, 4]], [[5, 6], [7, 8]]]
        for layout, rows in (
            ("interleaved", [[1.0, 2.0, 3.0, 4.0], [5.0, 6.0, 7.0, 8.0]]),
            ("planar", [[1.0, 3.0, 2.0, 4.0], [5.0, 7.0, 6.0, 8.0]]),
        ):
            assert_array_equal(table_to_tracks(np.array(rows), layout), tracks)

    @pytest.mark.parametrize("layout", ["interleaved", "planar"])
    def test_odd_number_of_columns(self, layout):
        message = r"two columns per point .* even number; got n_features=5"
        refused(message, table_to_tracks, np.zeros((3, 5)), layout)


def report_frames(tracks):
    return centred_frames(tracks.transpose(0, 2, 1))[1]


class TestCentring:
    def test_identity(self, rng):
        tracks = rng.normal(size=(5, 9, 2)) + 100 * rng.normal(size=(5, 1, 2))
        before = tracks.copy()
        centred, translation = centred_tracks(tracks)
        assert_array_equal(tracks, before)
        assert_allclose(centred + translation[:, None], tracks, rtol=1e-15)
        assert_allclose(centred.mean(axis=1), 0, atol=1e-13)
        assert_allclose(translation, tracks.mean(axis=1))

    @pytest.mark.parametrize("unit", UNITS)
    @pytest.mark.parametrize("dtype", [np.float32, np.float64])
    @pytest.mark.parametrize("place", [(0.0, 0.0), (0.1, -0.7), (1234.567, 0.3)])
    def test_a_frame_of_equal_points(self, rng, unit, dtype, place):
        tracks = unit * rng.normal(size=(6, 9, 2))
        tracks[[2, 5]] = unit * np.array(place)
        message = r"all points are equal in 2 of 6 frames \(first: row 2\)"
        refused(message, centred_tracks, tracks.astype(dtype))

    @pytest.mark.parametrize("unit", UNITS)
    def test_one_different_point_is_enough(self, unit):
        tracks = np.full((3, 9, 2), 300.0 * unit)
        tracks[:, 4, 1] += 1e-3 * unit
        centred, _ = centred_tracks(tracks)
        assert_allclose(centred[:, 4, 1], 8e-3 / 9 * unit)


class TestMissingPoints:
    @pytest.mark.parametrize("dtype", [np.float32, np.float64])
    def test_each_frame_equals_that_of_its_seen_points(self, rng, dtype):
        points = (5 + rng.normal(size=(30, 9, 2))).astype(dtype)
        tracks, seen = with_missing(points, 0.4)
        centred, translation = centred_tracks(tracks)
        sizes = weighting_sizes(centred, scale_frames=True)
        assert_array_equal(seen_points(centred.transpose(0, 2, 1)), seen)
        assert centred.dtype == translation.dtype == np.float64
        for i, mask in enumerate(seen):
            part, place = centred_tracks(tracks[i : i + 1, mask])
            size = weighting_sizes(part, scale_frames=True)
            assert_allclose(centred[i, mask], part[0], atol=1e-14)
            assert_allclose(translation[i], place[0], atol=1e-14)
            assert_allclose(sizes[i], size[0])

    @pytest.mark.parametrize("order", ["C", "F"])
    @pytest.mark.parametrize("layout", LAYOUTS)
    @pytest.mark.parametrize("dtype", [np.float32, np.float64])
    def test_complete_tables_have_the_plain_values(self, rng, dtype, layout, order):
        X = np.asarray(7 + rng.normal(size=(50, 40)), dtype=dtype, order=order)
        tracks = table_to_tracks(X, layout)
        assert_array_equal(clean_tracks(tracks), tracks)
        plain = np.ascontiguousarray(tracks, dtype=np.float64)
        centroid = plain.view(complex).sum(axis=1).view(float) / 20
        centred, translation = centred_tracks(tracks)
        assert_array_equal(translation, centroid)
        assert_array_equal(centred, plain - centroid[:, None])
        square = np.einsum("ijc,ijc->i", centred, centred) / 40
        assert_allclose(weighting_sizes(centred, True), np.sqrt(square))
        assert_allclose(weighting_sizes(centred, False)[0], np.sqrt(square.mean()))

    def test_frames_without_any_point(self, rng):
        tracks = rng.normal(size=(4, 9, 2))
        tracks[[1, 3]] = np.nan
        centred, translation = centred_tracks(tracks)
        assert_array_equal(report_frames(tracks).usable, [True, False, True, False])
        assert not report_frames(tracks).in_one_place.any()
        assert_array_equal(np.isnan(centred).all(axis=(1, 2)), [0, 1, 0, 1])
        assert_array_equal(np.isnan(translation).all(axis=1), [0, 1, 0, 1])


class TestFrames:
    def test_equal_seen_points(self, rng):
        tracks, seen = with_missing(100 * rng.normal(size=(30, 9, 2)), 0.3)
        tracks[[3, 8]] = np.where(seen[[3, 8], :, None], 0.1, np.nan)
        assert_array_equal(np.flatnonzero(report_frames(tracks).in_one_place), [3, 8])
        assert not report_frames(tracks).usable[[3, 8]].any()
        message = r"all seen points are equal in 2 of 30 frames \(first: row 3\)"
        refused(message, centred_tracks, tracks)

    @pytest.mark.parametrize("unit", UNITS)
    @pytest.mark.parametrize("dtype", [np.float32, np.float64])
    def test_one_place_is_a_matter_of_rounding(self, rng, unit, dtype):
        place = unit * rng.normal(size=(50, 1, 2))
        noise = rng.normal(size=(50, 9, 2)) * np.linalg.norm(place, axis=2)[..., None]
        eps = np.finfo(dtype).eps
        many = ((place + size * eps * noise).astype(dtype) for size in (0.5, 40))
        near, far = (report_frames(frames).in_one_place for frames in many)
        assert near.all()
        assert not far.any()

    def test_fewest_points(self, rng):
        tracks = np.full((9, 8, 2), np.nan)
        for n in range(9):
            tracks[n, :n] = rng.normal(size=(n, 2))
        assert_array_equal(report_frames(tracks).usable, np.arange(9) >= FEWEST_POINTS)
        check_frames(report_frames(tracks[FEWEST_POINTS:]), tracks.shape[1])
        message = r"fewer than 4 points are visible in 3 of 8 frames \(first: row 0, "
        refused(message + r"with 1\)", check_frames, report_frames(tracks[1:]), 8)

    @pytest.mark.parametrize("unit", UNITS)
    @pytest.mark.parametrize("dtype", [np.float32, np.float64])
    def test_points_on_a_line(self, rng, unit, dtype):
        along = rng.normal(size=(40, 9, 1))
        angle = rng.uniform(0, 2 * np.pi, size=(40, 1, 1))
        line = along * np.concatenate([np.cos(angle), np.sin(angle)], axis=2)
        tracks = (unit * (line + 5 * rng.normal(size=(40, 1, 2)))).astype(dtype)
        assert report_frames(tracks).usable.all()  # a flat object seen edge on
        check_frames(report_frames(tracks), tracks.shape[1])
        tracks[::2, 3] = np.nan
        assert_array_equal(report_frames(tracks).usable, np.arange(40) % 2 == 1)
        message = r"missing in 20 of 40 frames \(first: row 0\) and the others lie on "
        refused(message + "one line", check_frames, report_frames(tracks), 9)

    def test_points_nearly_on_a_line(self, rng):
        line = rng.normal(size=(40, 9, 1)) * rng.normal(size=(40, 1, 2))
        tracks, _ = with_missing(line + 1e-12 * rng.normal(size=line.shape), 0.2)
        assert report_frames(tracks).usable.all()


class TestMeasurementMatrix:
    @pytest.mark.parametrize("scale_frames", [True, False])
    def test_equals_plain_loops(self, rng, scale_frames):
        tracks = rng.normal(size=(5, 9, 2)) * rng.exponential(size=(5, 1, 1)) + 3
        centred, _ = centred_tracks(tracks)
        sizes = weighting_sizes(centred, scale_frames)
        W = measurement_matrix(centred / sizes[:, None, None])
        expected = measurements(tracks, scale_frames)
        assert_allclose(W / np.linalg.norm(W), expected / np.linalg.norm(expected))
        assert W.flags.c_contiguous
