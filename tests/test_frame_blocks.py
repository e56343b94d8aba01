"""Blocks of frames: any way of splitting and computing them gives the same."""

import threading

import numpy as np
import pytest
from numpy.testing import assert_array_equal

from isa_nrsfm._tables.blocks import FrameBlocks

N_FRAMES = 23


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
    kept = FrameBlocks.of_array(array, 10).derive(recorded)
    kept.whole()
    assert calls == [10, 10, 3]


@pytest.mark.parametrize(("n_frames", "lengths"), [(10, [9, 9, 5]), (2, [3] * 7 + [2])])
def test_small_blocks_are_regrouped(array, n_frames, lengths):
    blocks = FrameBlocks.of_array(array, 3)
    larger = blocks.regrouped(np.concatenate, n_frames)
    assert larger.lengths == lengths
    assert_array_equal(larger.whole(), array)


@pytest.mark.parametrize(
    ("n_threads", "length", "others"), [(3, 5, True), (1, 5, False), (3, 23, False)]
)
@pytest.mark.parametrize("make", [FrameBlocks.of_array, stored])
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
