"""Blocks of frames: any way of splitting and computing them gives the same."""

import threading
from typing import NamedTuple

import numpy as np
import pytest
from numpy.testing import assert_array_equal

from isa_nrsfm._tables.blocks import FrameBlocks
from isa_nrsfm._tables.sources import open_table

N_FRAMES = 23


class Pair(NamedTuple):
    first: np.ndarray
    second: np.ndarray


def blocks_of(kind, array, length):
    if kind == "stored":
        return FrameBlocks.of_stored(array, length)
    return FrameBlocks.of_array(array, length, n_threads=3 if kind == "threads" else 1)


@pytest.fixture(params=["memory", "threads", "stored"])
def kind(request):
    return request.param


@pytest.fixture
def array():
    return np.random.default_rng(0).normal(size=(N_FRAMES, 4))


def scaled(block, factors):
    return block * factors[:, None]


@pytest.mark.parametrize("length", [1, 5, 23, 100])
class TestBlocks:
    def test_map_yields_blocks_with_their_rows_in_order(self, kind, array, length):
        blocks = blocks_of(kind, array, length)
        factors = np.arange(N_FRAMES)
        got = list(blocks.map(scaled, factors))
        assert [len(block) for block in got] == blocks.lengths
        assert blocks.n_frames == N_FRAMES
        assert_array_equal(np.concatenate(got), array * factors[:, None])

    def test_derived_blocks_can_be_derived_from(self, kind, array, length):
        factors = np.arange(N_FRAMES)
        blocks = blocks_of(kind, array, length).derive(scaled, factors)
        blocks = blocks.derive(scaled, 2.0 * factors)
        assert_array_equal(
            blocks.whole(), array * factors[:, None] * 2 * factors[:, None]
        )

    def test_take_returns_frames_in_the_order_asked_for(self, kind, array, length):
        order = np.random.default_rng(1).permutation(N_FRAMES)[:9]
        assert_array_equal(blocks_of(kind, array, length).take(order), array[order])

    def test_kept_frames_are_in_the_blocks_of_a_table_of_them(
        self, kind, array, length
    ):
        frames = np.isin(np.arange(N_FRAMES), [0, 1, 6, 7, 8, 18, 19, 22])
        kept = blocks_of(kind, array, length).subset(frames)
        alone = blocks_of(kind, array[frames], length)
        assert kept.lengths == alone.lengths
        assert_array_equal(kept.whole(), array[frames])
        factors = np.arange(8)
        derived = kept.derive(scaled, factors)
        assert_array_equal(derived.whole(), array[frames] * factors[:, None])

    def test_gather_concatenates_each_of_several_results(self, kind, array, length):
        blocks = blocks_of(kind, array, length)
        found = blocks.collect(lambda b: Pair(b, b[:, 0]))
        assert isinstance(found, Pair)
        assert_array_equal(found.first, array)
        assert_array_equal(found.second, array[:, 0])


def test_stored_blocks_are_computed_when_they_are_needed(array):
    calls = []

    def recorded(block):
        calls.append(len(block))
        return block

    stored = FrameBlocks.of_stored(array, 10).derive(recorded)
    assert calls == []
    list(stored.map(len))
    stored.whole()
    assert calls == [10, 10, 3] * 2
    calls.clear()
    kept = FrameBlocks.of_array(array, 10).derive(recorded)
    kept.whole()
    assert calls == [10, 10, 3]


def test_kept_frames_far_apart_are_read_a_block_at_a_time(array):
    calls = []

    def recorded(block):
        calls.append(len(block))
        return block

    stored = FrameBlocks.of_stored(array, 4).derive(recorded)
    frames = np.isin(np.arange(N_FRAMES), [0, 22])
    assert_array_equal(stored.subset(frames).whole(), array[frames])
    assert max(calls) == 4


@pytest.mark.parametrize(("n_frames", "lengths"), [(10, [9, 9, 5]), (2, [3] * 7 + [2])])
def test_small_blocks_are_regrouped(array, n_frames, lengths):
    blocks = FrameBlocks.of_array(array, 3)
    larger = blocks.regrouped(np.concatenate, n_frames)
    assert larger.lengths == lengths
    assert_array_equal(larger.whole(), array)


@pytest.mark.parametrize(
    ("n_threads", "length", "others"), [(3, 5, True), (1, 5, False), (3, 23, False)]
)
@pytest.mark.parametrize("make", [FrameBlocks.of_array, FrameBlocks.of_stored])
def test_threads_are_used_for_several_blocks(array, make, n_threads, length, others):
    blocks = make(array, length, n_threads=n_threads).derive(lambda block: block)
    for each in (blocks, blocks.subset(np.full(N_FRAMES, True))):
        threads = set(each.map(lambda block: threading.get_ident()))
        assert (threading.get_ident() not in threads) == others


def test_an_error_in_a_thread_is_raised_and_no_further_block_is_begun(array):
    begun = []

    def fail(block):
        begun.append(block)
        raise ValueError("no good")

    with pytest.raises(ValueError, match="no good"):
        list(FrameBlocks.of_array(array, 2, n_threads=2).map(fail))
    assert len(begun) <= 3


def test_threads_have_few_results_ahead(array):
    begun = []
    found = FrameBlocks.of_array(array, 2, n_threads=2).map(begun.append)
    for number in range(1, 6):
        next(found)
        assert len(begun) <= number + 2
    found.close()


def test_no_frames():
    blocks = open_table(np.empty((0, 4), np.float32), "interleaved")
    got = blocks.collect(lambda block: 2 * block)
    assert got.shape == (0, 2, 2)
    assert got.dtype == np.float32
