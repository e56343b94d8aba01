"""Functions that the tests of the benchmarks run in processes of their own."""

import os
import time

import numpy as np

MEGABYTE = 1_000_000


def use_memory(measured, n_before, n_inside):
    """Use megabytes before and inside of what is measured, and give them back.

    Return the seconds of what is measured, by clocks just inside and just outside.
    """
    before = np.ones(n_before * MEGABYTE // 8)
    del before
    clock = time.perf_counter
    seconds = {"inside": 0.0, "outside": 0.0}
    outside = clock()
    with measured():
        inside = clock()
        array = np.ones(n_inside * MEGABYTE // 8)
        total = array.sum()
        seconds["inside"] += clock() - inside
    seconds["outside"] += clock() - outside
    outside = clock()
    with measured():
        inside = clock()
        time.sleep(0.1)
        seconds["inside"] += clock() - inside
    seconds["outside"] += clock() - outside
    return {"total": total, **seconds}


def misbehave(measured, how):
    """Do what a method should not."""
    with measured():
        if how == "raise":
            raise ValueError("expected this;\n  got that")
        if how == "die":
            os._exit(3)
        if how == "hang":
            time.sleep(60)
