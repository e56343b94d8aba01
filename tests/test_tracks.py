"""Tables, tracks and the measurement matrix."""

import warnings

import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal
from scenes import measurements

from isa_nrsfm._tracks import (
    LAYOUT_SAMPLE,
    centred_tracks,
    check_names,
    check_size,
    largest_n_components,
    measurement_matrix,
    smallest_n_frames,
    table_to_tracks,
    tracks_to_table,
    warn_if_other_layout,
    weighting_sizes,
)
from isa_nrsfm.datasets import make_nonrigid_tracks

UNITS = [1e-9, 1.0, 1e9]


@pytest.fixture
def rng():
    return np.random.default_rng(0)


class TestLayouts:
    def test_interleaved_columns_by_hand(self):
        X = np.array([[1.0, 2.0, 3.0, 4.0], [5.0, 6.0, 7.0, 8.0]])
        tracks = [[[1, 2], [3, 4]], [[5, 6], [7, 8]]]
        assert_array_equal(table_to_tracks(X), tracks)

    def test_planar_columns_by_hand(self):
        X = np.array([[1.0, 3.0, 2.0, 4.0]])
        assert_array_equal(table_to_tracks(X, "planar"), [[[1, 2], [3, 4]]])

    @pytest.mark.parametrize("layout", ["interleaved", "planar"])
    @pytest.mark.parametrize("dtype", [np.float32, np.float64])
    def test_round_trip_keeps_bits_and_type(self, rng, layout, dtype):
        tracks = rng.normal(size=(4, 7, 2)).astype(dtype)
        X = tracks_to_table(tracks, layout)
        assert X.shape == (4, 14)
        assert X.dtype == dtype
        assert_array_equal(table_to_tracks(X, layout), tracks)

    def test_layouts_hold_the_same_numbers(self, rng):
        tracks = rng.normal(size=(4, 7, 2))
        interleaved = tracks_to_table(tracks)
        planar = tracks_to_table(tracks, "planar")
        assert_array_equal(planar[:, :7], interleaved[:, 0::2])
        assert_array_equal(planar[:, 7:], interleaved[:, 1::2])

    @pytest.mark.parametrize("layout", ["interleaved", "planar"])
    def test_odd_number_of_columns(self, layout):
        with pytest.raises(
            ValueError, match=r"two columns per point .* even number; got n_features=5"
        ):
            table_to_tracks(np.zeros((3, 5)), layout)


class TestCentring:
    def test_identity(self, rng):
        tracks = rng.normal(size=(5, 9, 2)) + 100 * rng.normal(size=(5, 1, 2))
        before = tracks.copy()
        centred, translation = centred_tracks(tracks)
        assert_array_equal(tracks, before)
        assert_allclose(centred + translation[:, None], tracks, rtol=1e-15)
        assert_allclose(centred.mean(axis=1), 0, atol=1e-13)
        assert_allclose(translation, tracks.mean(axis=1))

    def test_single_precision_is_centred_in_double(self, rng):
        tracks = (1000 + rng.normal(size=(5, 9, 2))).astype(np.float32)
        centred, translation = centred_tracks(tracks)
        assert centred.dtype == translation.dtype == np.float64
        assert_allclose(centred.mean(axis=1), 0, atol=1e-12)

    @pytest.mark.parametrize("unit", UNITS)
    def test_translation_moves_only_the_centroid(self, rng, unit):
        tracks = unit * rng.normal(size=(5, 9, 2))
        shift = unit * rng.normal(size=(5, 2))
        centred, translation = centred_tracks(tracks)
        moved, moved_translation = centred_tracks(tracks + shift[:, None])
        assert_allclose(moved, centred, atol=1e-14 * unit)
        assert_allclose(moved_translation, translation + shift, atol=1e-14 * unit)

    @pytest.mark.parametrize("unit", UNITS)
    @pytest.mark.parametrize("dtype", [np.float32, np.float64])
    @pytest.mark.parametrize("place", [(0.0, 0.0), (0.1, -0.7), (1234.567, 0.3)])
    def test_a_frame_of_equal_points(self, rng, unit, dtype, place):
        tracks = unit * rng.normal(size=(6, 9, 2))
        tracks[[2, 5]] = unit * np.array(place)
        with pytest.raises(
            ValueError,
            match=r"at least two different points; all points are equal in "
            r"2 frame\(s\), the first is row 2",
        ):
            centred_tracks(tracks.astype(dtype))

    @pytest.mark.parametrize("unit", UNITS)
    def test_one_different_point_is_enough(self, unit):
        tracks = np.full((3, 9, 2), 300.0 * unit)
        tracks[:, 4, 1] += 1e-3 * unit
        centred, _ = centred_tracks(tracks)
        assert_allclose(centred[:, 4, 1], 8e-3 / 9 * unit)


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

    @pytest.mark.parametrize("unit", UNITS)
    def test_scaled_frames_have_unit_root_mean_square(self, rng, unit):
        centred, _ = centred_tracks(unit * rng.normal(size=(5, 9, 2)))
        sizes = weighting_sizes(centred, scale_frames=True)
        scaled = centred / sizes[:, None, None]
        assert_allclose(np.mean(scaled**2, axis=(1, 2)), 1)

    @pytest.mark.parametrize("unit", UNITS)
    def test_unscaled_frames_share_one_size(self, rng, unit):
        centred, _ = centred_tracks(unit * rng.normal(size=(5, 9, 2)))
        sizes = weighting_sizes(centred, scale_frames=False)
        assert_array_equal(sizes, sizes[0])
        assert_allclose(np.mean((centred / sizes[0]) ** 2), 1)


def n_equations_minus_unknowns(n_frames, n_points, K):
    """Count: numbers in the table against cameras, coefficients, shapes and gauge."""
    cameras, coefficients, shapes = 8 * n_frames, K * n_frames, 3 * n_points * (K + 1)
    gauge = (K + 1) ** 2 + 8 + 3 * (K + 1)  # the last: the origin of each shape
    return 2 * n_points * n_frames - (cameras + coefficients + shapes - gauge)


class TestSize:
    @pytest.mark.parametrize("K", range(1, 21))
    def test_counts_of_equations_and_unknowns(self, K):
        smallest = smallest_n_frames(K)
        fewest_points = 3 * K + 4
        assert n_equations_minus_unknowns(smallest, fewest_points, K) >= 0
        assert n_equations_minus_unknowns(smallest - 1, fewest_points, K) < 0
        assert n_equations_minus_unknowns(smallest, 10 * fewest_points, K) >= 0

    @pytest.mark.parametrize("n_points", range(4, 60))
    def test_largest_number_of_basis_shapes(self, n_points):
        # Centred points span n_points - 1 directions, the model needs 3K + 3.
        K = largest_n_components(n_points)
        assert 3 * K + 3 <= n_points - 1 < 3 * (K + 1) + 3

    def test_the_smallest_table_passes(self):
        for K in range(1, 10):
            check_size(smallest_n_frames(K), 3 * K + 4, K)

    def test_too_few_points(self):
        with pytest.raises(
            ValueError,
            match=r"n_components=3 needs at least 13 points, X has 12; with 12 points "
            r"the largest possible n_components is 2",
        ):
            check_size(100, 12, 3)

    def test_too_few_points_for_any_number(self):
        with pytest.raises(
            ValueError,
            match=r"n_components=2 needs at least 10 points, X has 6; at least 7 "
            r"points are needed for n_components=1",
        ):
            check_size(100, 6, 2)

    def test_too_few_frames(self):
        with pytest.raises(
            ValueError,
            match=r"n_components=3 needs at least 8 frames \(rows\), X has n_samples=7",
        ):
            check_size(7, 68, 3)


class TestNames:
    @pytest.mark.parametrize("layout", ["interleaved", "planar"])
    def test_no_names_and_names_that_say_nothing(self, layout):
        check_names(None, layout)
        check_names(np.array(["a", "b", "c", "d"]), layout)

    def test_matching_names(self):
        check_names(np.array(["x0", "y0", "x1", "y1"]), "interleaved")
        check_names(np.array(["x0", "x1", "y0", "y1"]), "planar")

    @pytest.mark.parametrize(
        ("layout", "names", "order"),
        [
            ("planar", ["x0", "y0", "x1", "y1", "x2", "y2"], "interleaved"),
            ("interleaved", ["x0", "x1", "x2", "y0", "y1", "y2"], "planar"),
            (
                "interleaved",
                ["y0", "x0", "y1", "x1", "y2", "x2"],
                "neither interleaved nor planar",
            ),
        ],
    )
    def test_contradicting_names(self, layout, names, order):
        shown = ", ".join(names[:4])
        with pytest.raises(
            ValueError,
            match=rf"layout='{layout}' contradicts the column names \({shown}, ...\), "
            rf"whose order is {order}$",
        ):
            check_names(np.array(names), layout)


@pytest.fixture(scope="module")
def faces():
    tracks = make_nonrigid_tracks(40, 30, 2, amplitude=0.2, random_state=0)
    return tracks.data.reshape(40, 30, 2)


class TestOtherLayout:
    @pytest.mark.parametrize("scale_frames", [True, False])
    @pytest.mark.parametrize(
        ("true", "given"), [("interleaved", "planar"), ("planar", "interleaved")]
    )
    def test_the_other_layout_is_warned_of(self, faces, true, given, scale_frames):
        X = tracks_to_table(faces, true)
        with pytest.warns(
            UserWarning,
            match=rf"layout='{true}' explains the table much better than "
            rf"layout='{given}': what is not rigid has 0\.\d+ times the energy",
        ):
            warn_if_other_layout(X, given, scale_frames)

    @pytest.mark.parametrize("scale_frames", [True, False])
    @pytest.mark.parametrize("layout", ["interleaved", "planar"])
    @pytest.mark.parametrize("unit", UNITS)
    def test_the_right_layout_is_quiet(self, faces, layout, scale_frames, unit):
        warn_if_other_layout(
            unit * tracks_to_table(faces, layout), layout, scale_frames
        )

    def test_single_precision(self, faces):
        X = tracks_to_table(faces).astype(np.float32)
        warn_if_other_layout(X, "interleaved", True)
        with pytest.warns(UserWarning, match="layout='interleaved' explains"):
            warn_if_other_layout(X, "planar", True)

    def test_long_tables_are_sampled_evenly(self, faces):
        X = tracks_to_table(np.tile(faces, (LAYOUT_SAMPLE // 10, 1, 1)))
        warn_if_other_layout(X, "interleaved", True)
        with pytest.warns(UserWarning, match="layout='interleaved' explains"):
            warn_if_other_layout(X, "planar", True)

    def test_a_rigid_object_seen_in_the_right_layout(self, rng):
        tracks = rng.normal(size=(12, 3)) @ rng.normal(size=(20, 3, 2))
        warn_if_other_layout(tracks_to_table(tracks), "interleaved", True)

    @pytest.mark.parametrize("seed", range(10))
    def test_tables_that_both_layouts_explain(self, seed):
        # Four points are rigid in any layout: the residuals are rounding errors.
        X = np.random.default_rng(seed).normal(size=(20, 8))
        warn_if_other_layout(X, "interleaved", True)
        warn_if_other_layout(X, "planar", True)

    @pytest.mark.parametrize("offset", [3.0, 30.0, 300.0])
    @pytest.mark.parametrize("scale_frames", [True, False])
    @pytest.mark.parametrize("layout", ["interleaved", "planar"])
    def test_where_the_object_is_in_the_image_is_irrelevant(
        self, faces, offset, scale_frames, layout
    ):
        # The object has size 1 and is moved far away from the corner of the image.
        X = tracks_to_table(faces + np.array([offset, 0.0]), layout)
        warn_if_other_layout(X, layout, scale_frames)

    @pytest.mark.parametrize("scale_frames", [True, False])
    def test_points_that_coincide_in_the_other_layout(self, scale_frames):
        # Points (0, 0) and (1, 1): by the other layout all points would be equal.
        X = np.repeat([[0.0] * 8 + [1.0] * 8], 12, axis=0)
        with warnings.catch_warnings():
            warnings.simplefilter("error")
            warn_if_other_layout(X, "interleaved", scale_frames)

    @pytest.mark.parametrize(
        "name",
        [
            "akhter_drink",
            "akhter_yoga",
            "faces_wild_68_combined",
            "ict_bu3dfe_like_68",
            "shark_torresani",
        ],
    )
    def test_real_tables(self, load_data, name):
        X = tracks_to_table(load_data(name)["W2d"])
        warn_if_other_layout(X, "interleaved", True)
        with pytest.warns(UserWarning, match="layout='interleaved' explains"):
            warn_if_other_layout(X, "planar", True)
