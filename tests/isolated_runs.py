"""Functions that the tests of the benchmarks run in processes of their own."""

import os
import time

import numpy as np

MEGABYTE = 1_000_000


def use_memory(measured, n_before, n_inside):
    """Use megabytes before and inside of what is measured, and give them back."""
    before = np.ones(n_before * MEGABYTE // 8)
    del before
    with measured():
        inside = np.ones(n_inside * MEGABYTE // 8)
        total = inside.sum()
        time.sleep(0.2)
    with measured():
        time.sleep(0.1)
    return {"total": total}


def misbehave(measured, how):
    """Do what a method should not."""
    with measured():
        if how == "raise":
            raise ValueError("expected this;\n  got that")
        if how == "die":
            os._exit(3)
        if how == "hang":
            time.sleep(60)


def sleep(measured, seconds):
    """Take some seconds."""
    with measured():
        time.sleep(seconds)
    return {"seconds": seconds}, {"array": np.arange(3)}
