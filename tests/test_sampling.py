"""Which frames of a large table the first stages work on."""

import numpy as np
from numpy.testing import assert_array_equal
from scenes import measurements, permute_frames

from isa_nrsfm._paper.factors import factorise
from isa_nrsfm._paper.sample import rigid_energy, sample_frames
from isa_nrsfm._tables.blocks import FrameBlocks
from isa_nrsfm._tables.ordering import representative_frames, spread
from isa_nrsfm.datasets import make_nonrigid_tracks

FEW = {"small_table": 1000, "first": 40}


def matrix(n_frames, n_points=20):
    tracks = make_nonrigid_tracks(n_frames, n_points, 2, noise=0.02, random_state=0)
    return measurements(tracks.data.reshape(n_frames, n_points, 2))


def sample(W, block_frames=64, **options):
    rows = FrameBlocks.of_array(W.reshape(len(W) // 2, 2, -1), block_frames)
    shape = factorise(W, 2).rigid_shape
    return sample_frames(rows, W.shape[1], shape, **{**FEW, **options})


def test_parts_grow_to_half_of_the_frames():
    for n_frames, sizes in ((40, []), (41, [40]), (321, [40, 160]), (700, [40, 160])):
        found = sample(matrix(n_frames))
        assert [len(part) for part in found.parts] == sizes
        assert all((np.diff(part) > 0).all() for part in found.parts)


def test_measurement_matrix_is_that_of_the_first_part():
    W = matrix(100)
    found = sample(W)
    rows = W.reshape(100, 2, -1)[found.parts[0]]
    assert_array_equal(found.W, rows.reshape(80, -1))
    assert_array_equal(sample(matrix(40)).W, matrix(40))


def test_small_tables_are_taken_whole():
    W = matrix(700)
    found = sample(W, small_table=150_000)
    assert found.parts == []
    assert_array_equal(found.W, W)


def test_frames_are_spread_from_the_most_to_the_least_rigid_one():
    W = matrix(100)
    factors = factorise(W, 2)
    rest = W - factors.rigid_motion @ factors.rigid_shape
    energy = np.sum(rest.reshape(100, -1) ** 2, axis=1)
    found = rigid_energy(W.reshape(100, 2, -1), factors.rigid_shape)
    np.testing.assert_allclose(found, energy)
    chosen = spread(np.argsort(energy), 21)
    assert len(set(chosen)) == 21
    assert (np.diff(energy[chosen]) > 0).all()
    assert energy[chosen[0]] == energy.min()
    assert energy[chosen[-1]] == energy.max()
    assert_array_equal(sample(W).parts[0], np.sort(spread(np.argsort(energy), 40)))


def test_the_same_frames_in_any_order_and_blocks():
    W = matrix(100)
    permuted, order = permute_frames(W, 1)
    expected = sample(W).parts[0]
    assert_array_equal(np.sort(order[sample(permuted, 7).parts[0]]), expected)


class TestRepresentativeFrames:
    def rows(self):
        """Return frames of known shares of x, in no order, and that order."""
        order = np.random.default_rng(0).permutation(300)
        rows = np.ones((300, 2, 4))
        rows[order, 0] = np.linspace(0.1, 2.0, 300)[:, None]
        return rows, order

    def test_are_spread_over_the_shares_of_x(self):
        rows, order = self.rows()
        found = representative_frames(FrameBlocks.of_array(rows, 64), 50)
        assert_array_equal(found, np.sort(spread(order, 50)))

    def test_show_rare_points_as_often_as_they_can(self):
        rows, order = self.rows()
        rows[:, :, 1:3] = np.nan
        rows[order[::7], :, 1] = 1.0  # in 43 frames, and in 5 of those that are spread
        rows[order[3:6], :, 2] = 1.0  # in three frames
        blocks = FrameBlocks.of_array(rows, 64)
        # The order of the shares has changed little: compare by it.
        halves = np.nansum(rows[:, 0] ** 2, axis=1) / np.nansum(rows**2, axis=(1, 2))
        order = np.argsort(halves, kind="stable")
        chosen = set(spread(order, 50).tolist())
        for point, n in ((1, 10), (2, 3)):
            seen = ~np.isnan(rows[order, 0, point])
            assert sum(not np.isnan(rows[i, 0, point]) for i in chosen) < n
            chosen |= set(spread(order[seen], n).tolist())
        assert_array_equal(representative_frames(blocks, 50), sorted(chosen))

    def test_of_few_frames_are_all(self):
        rows = FrameBlocks.of_array(self.rows()[0], 64)
        assert_array_equal(representative_frames(rows, 300), np.arange(300))
