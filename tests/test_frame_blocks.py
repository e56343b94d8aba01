"""Blocks of frames: any way of splitting and computing them gives the same."""

import threading

import numpy as np
import pytest
from numpy.testing import assert_array_equal

from isa_nrsfm._tables.blocks import FrameBlocks

N_FRAMES = 23


@pytest.fixture
def array():
    return np.random.default_rng(0).normal(size=(N_FRAMES, 4))


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
