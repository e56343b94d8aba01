"""Checks of tables."""

import numpy as np
import pytest
from numpy.testing import assert_array_equal
from refusals import refused, warned
from scenes import with_missing

from isa_nrsfm._prepare import checks
from isa_nrsfm._prepare.checks import (
    check_names,
    check_points,
    check_table,
    largest_n_components,
    most_components,
    smallest_n_frames,
    visible_points,
)
from isa_nrsfm._tables.blocks import FrameBlocks
from isa_nrsfm._tables.sources import LARGEST, SMALLEST, checked_range
from isa_nrsfm._tables.tracks import (
    LAYOUTS,
    clean_tracks,
    table_to_rows,
    tracks_to_table,
    without_half_points,
)
from isa_nrsfm.datasets import make_face_tracks, make_nonrigid_tracks


class TestHalfPoints:
    def half(self, rng):
        tracks = rng.normal(size=(6, 9, 2))
        tracks[4, 2, 0] = tracks[1, 7, 1] = tracks[1, 8, 0] = np.nan
        tracks[2, 3] = np.nan
        return tracks

    def test_the_other_coordinate_is_dropped_with_a_warning(self, rng):
        tracks = self.half(rng)
        before = tracks.copy()
        message = r"in 2 of 6 rows points have only one of their two coordinates \(3 "
        message += r"in all; first: point 7 in row 1\). They count as missing$"
        clean = warned(message, clean_tracks, tracks)
        assert_array_equal(tracks, before)
        seen = ~np.isnan(tracks).any(axis=2)
        assert_array_equal(clean[seen], tracks[seen])
        assert np.isnan(clean[~seen]).all()
        assert clean.dtype == tracks.dtype

    @pytest.mark.parametrize(
        ("layout", "columns"), [("interleaved", "c14, c15"), ("planar", "c7, c16")]
    )
    def test_columns_are_named(self, rng, layout, columns):
        names = np.array([f"c{i}" for i in range(18)], dtype=object)
        with pytest.warns(UserWarning, match=rf"point 7 \({columns}\) in row 1"):
            clean_tracks(self.half(rng), layout, names)

    def test_pairs_of_missing_coordinates_are_no_matter(self, rng):
        tracks, _ = with_missing(rng.normal(size=(6, 9, 2)), 0.5)
        assert_array_equal(clean_tracks(tracks), tracks)


class TestRange:
    @pytest.mark.parametrize("sign", [-1.0, 1.0])
    @pytest.mark.parametrize("size", [2 * LARGEST, SMALLEST / 2])
    def test_squares_stay_finite_and_above_zero(self, size, sign):
        X = np.ones((5, 4))
        X[3] = 0.0
        X[3, 1:3] = sign * size, np.nan
        refused(r"in row 3\. Give", checked_range, X)

    def test_ends_and_rows_of_zeros(self):
        X = np.diag([LARGEST, SMALLEST, -LARGEST, -SMALLEST, 0.0, np.nan])
        assert checked_range(X) is X


def checked(tracks, *options):
    """Check the points of tracks."""
    check_points(visible_points(tracks.transpose(0, 2, 1)), tracks.shape[1], *options)


class TestPoints:
    def test_point_seen_in_too_few_frames(self, rng):
        tracks = rng.normal(size=(50, 16, 2))
        tracks[5:, 4] = np.nan
        tracks[4:, 9] = np.nan
        checked(tracks[:, :9], 2)
        names = np.array([f"{axis}_{j}" for axis in "xy" for j in range(16)])
        message = r"n_components=3 needs every point in at least 6 frames; fewer show "
        message += r"2 of 16 points \(first: point 4 \(x_4, y_4\), in 5 of 50 frames\)"
        refused(message, checked, tracks, 3, "planar", names)

    @pytest.mark.parametrize("K", range(1, 21))
    def test_least_number_of_frames_of_a_point(self, K):
        least = -(-3 * (K + 1) // 2)
        assert 2 * least >= 3 * (K + 1) > 2 * (least - 1)
        # Complete tables that are large enough have it.
        assert least <= smallest_n_frames(K, 3 * K + 4)

    @pytest.mark.parametrize("K", range(1, 6))
    def test_count_of_all_equations(self, K):
        # The smallest complete table has hardly more equations than unknowns.
        n_points = 3 * K + 4
        n_frames = smallest_n_frames(K, n_points)
        surplus = n_equations_minus_unknowns(n_frames, n_points, K)
        tracks = np.random.default_rng(0).normal(size=(n_frames, n_points, 2))
        checked(tracks, K)
        n_hidden = surplus // 2 + 1
        tracks[np.arange(n_hidden) % n_frames, np.arange(n_hidden) % n_points] = np.nan
        assert np.isnan(tracks).any(axis=2).sum() == n_hidden
        message = rf"too few points are visible for n_components={K}: they determine "
        message += r"\d+ numbers of the shapes, which have \d+\."
        refused(message, checked, tracks, K)

    def test_groups_of_points_that_are_never_seen_together(self, rng):
        tracks = rng.normal(size=(100, 20, 2))
        tracks[:50, 12:] = np.nan
        tracks[50:, :12] = np.nan
        message = r"2 groups that no frame shows together, .* \(first: point 12 is "
        message += r"never visible with point 0 and its group\)"
        refused(message, checked, tracks, 1)
        tracks[7] = 0.0
        checked(tracks, 1)


def n_equations_minus_unknowns(n_frames, n_points, K, calibrated=False):
    """Count: numbers in the table against cameras, coefficients, shapes and gauge."""
    cameras, coefficients, shapes = 8 * n_frames, K * n_frames, 3 * n_points * (K + 1)
    gauge = (K + 1) ** 2 + 8 + 3 * (K + 1)  # the last: the origin of each shape
    if calibrated:  # rotation and scale of a frame; rotation of space
        cameras, gauge = 6 * n_frames, K * (K + 1) + 3 + 3 * (K + 1)
    return 2 * n_points * n_frames - (cameras + coefficients + shapes - gauge)


class TestSize:
    @pytest.mark.parametrize("K", range(1, 21))
    def test_counts_of_equations_and_unknowns(self, K):
        fewest_points = 3 * K + 4
        smallest = smallest_n_frames(K, fewest_points)
        assert n_equations_minus_unknowns(smallest, fewest_points, K) >= 0
        assert n_equations_minus_unknowns(smallest - 1, fewest_points, K) < 0
        assert n_equations_minus_unknowns(smallest, 10 * fewest_points, K) >= 0

    @pytest.mark.parametrize("n_points", range(4, 60))
    def test_largest_number_of_basis_shapes(self, n_points):
        # Centred points span n_points - 1 directions, the model needs 3K + 3.
        K = largest_n_components(n_points)
        assert 3 * K + 3 <= n_points - 1 < 3 * (K + 1) + 3

    @pytest.mark.parametrize("n_points", [7, 15, 17])
    def test_calibrated_cameras(self, n_points):
        affine = largest_n_components(n_points)
        largest = largest_n_components(n_points, "orthographic")
        assert largest > affine
        frames = []
        for K in range(affine + 1, largest + 1):
            frames.append(smallest_n_frames(K, n_points))
            surplus = n_equations_minus_unknowns(frames[-1], n_points, K, True)
            assert surplus >= 0
            few = frames[-1] - 1
            if few >= -(-8 * (K + 2) // 5):  # the bound of affine cameras
                assert n_equations_minus_unknowns(few, n_points, K, True) < 0
            if few >= smallest_n_frames(affine, n_points):
                assert most_components(few, n_points, "orthographic") < K
            assert most_components(frames[-1], n_points, "orthographic") >= K
        # With one basis shape more, no coordinate of a frame is left for the noise.
        assert 2 * n_points - 6 - (largest + 1) == 0
        assert frames == sorted(frames)
        assert most_components(10**6, n_points) == affine
        assert most_components(3, n_points, "orthographic") == 0


class TestNames:
    @pytest.mark.parametrize("layout", ["interleaved", "planar"])
    def test_names_that_do_not_contradict(self, layout):
        check_table(np.zeros((3, 4)), layout)
        check_names(np.array(["a", "b", "c", "d"]), layout)
        right = "x0 y0 x1 y1" if layout == "interleaved" else "x0 x1 y0 y1"
        check_names(np.array(right.split()), layout)

    @pytest.mark.parametrize(
        ("layout", "names", "order"),
        [
            ("planar", ["x0", "y0", "x1", "y1", "x2", "y2"], "interleaved"),
            ("interleaved", ["x0", "x1", "x2", "y0", "y1", "y2"], "planar"),
            (
                "interleaved",
                ["y0", "x0", "y1", "x1", "y2", "x2"],
                "neither interleaved nor planar; .*landmark_table.*",
            ),
        ],
    )
    def test_contradicting_names(self, layout, names, order):
        shown = ", ".join(names[:4])
        message = rf"layout='{layout}' contradicts the column names \({shown}, ...\), "
        message += rf"whose order is {order}$"
        refused(message, check_names, np.array(names), layout)

    @pytest.mark.parametrize("layout", ["interleaved", "planar"])
    @pytest.mark.parametrize(
        ("names", "n_others", "first"),
        [
            ("x_0 y_0 likelihood_0 x_1 y_1 likelihood_1", 2, "likelihood_0"),
            ("frame person x_0 y_0 x_1 y_1", 2, "frame"),
            ("nose_x nose_y nose_z chin_x chin_y chin_z", 2, "nose_z"),
        ],
    )
    def test_columns_beside_those_of_points(self, names, n_others, first, layout):
        message = rf"^{n_others} of the 6 columns are not named as the x or y of a "
        message += rf"point \(first: '{first}'\)\. .*isa_nrsfm\.io\.landmark_table"
        refused(message, check_names, np.array(names.split()), layout)


@pytest.fixture(scope="module")
def faces():
    tracks = make_nonrigid_tracks(40, 30, 2, amplitude=0.2, random_state=0)
    return tracks.data.reshape(40, 30, 2)


def warn_if_other_layout(X, layout, scale_frames):
    rows = without_half_points(table_to_rows(X, layout))[0]
    blocks = FrameBlocks.of_array(rows, 17)
    checks.warn_if_other_layout(blocks, X.shape[1] // 2, layout, scale_frames)


class TestOtherLayout:
    @pytest.mark.parametrize("scale_frames", [True, False])
    @pytest.mark.parametrize(
        ("true", "given"), [("interleaved", "planar"), ("planar", "interleaved")]
    )
    def test_the_other_layout_is_warned_of(self, faces, true, given, scale_frames):
        X = tracks_to_table(faces, true)
        message = rf"layout='{true}' explains the table much better than "
        message += rf"layout='{given}': its non-rigid part has 0\.\d+ times the energy"
        warned(message, warn_if_other_layout, X, given, scale_frames)

    # The object has size 1 and may be far away from the corner of the image.
    @pytest.mark.parametrize("scale_frames", [True, False])
    @pytest.mark.parametrize("layout", ["interleaved", "planar"])
    @pytest.mark.parametrize(
        ("unit", "offset"), [(1e-9, 0), (1.0, 0), (1e9, 0), (1, 3), (1, 30), (1, 300.0)]
    )
    def test_the_right_layout_is_quiet(self, faces, layout, scale_frames, unit, offset):
        X = tracks_to_table(unit * (faces + np.array([offset, 0.0])), layout)
        warn_if_other_layout(X, layout, scale_frames)

    @pytest.mark.parametrize("kind", ["long", *range(5)])
    def test_long_tables_and_those_with_missing_points(self, faces, kind):
        # Long ones are sampled evenly.
        if kind == "long":
            X = tracks_to_table(np.tile(faces, (100, 1, 1)))
        else:
            X = make_face_tracks(60, missing=0.3, random_state=kind).data
        warn_if_other_layout(X, "interleaved", True)
        warned("layout='interleaved' explains", warn_if_other_layout, X, "planar", True)

    def test_a_rigid_object_seen_in_the_right_layout(self, rng):
        tracks = rng.normal(size=(12, 3)) @ rng.normal(size=(20, 3, 2))
        warn_if_other_layout(tracks_to_table(tracks), "interleaved", True)

    @pytest.mark.parametrize("seed", range(10))
    def test_tables_that_both_layouts_explain(self, seed):
        # Four points are rigid in any layout: the residuals are rounding errors.
        X = np.random.default_rng(seed).normal(size=(20, 8))
        warn_if_other_layout(X, "interleaved", True)
        warn_if_other_layout(X, "planar", True)

    @pytest.mark.parametrize("scale_frames", [True, False])
    def test_points_that_coincide_in_the_other_layout(self, scale_frames):
        # Points (0, 0) and (1, 1): by the other layout all points would be equal.
        X = np.repeat([[0.0] * 8 + [1.0] * 8], 12, axis=0)
        warn_if_other_layout(X, "interleaved", scale_frames)

    @pytest.mark.parametrize("layout", LAYOUTS)
    @pytest.mark.parametrize("missing", [0.3, 0.8, 0.99])
    def test_tables_that_hardly_show_anything(self, rng, missing, layout):
        # No warning of arithmetic, whatever is left.
        for seed in range(5):
            X = with_missing(rng.normal(size=(30, 20, 2)), missing, seed)[0]
            warn_if_other_layout(tracks_to_table(X), layout, True)
