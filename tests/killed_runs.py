"""Kill forks of this process at operations on files, and look at the folder."""

import contextlib
import io
import itertools
import os
import shutil
import signal
import sys
import warnings
from pathlib import Path

import matplotlib
import numpy as np
import pandas as pd
from disk_faults import disk_faults, leftovers, readable
from fit_runs import fit, whole_run, write_landmarks

from isa_nrsfm import AffineNRSfM, FastISA
from isa_nrsfm.io import write_table


def in_a_fork(act):
    """Run an act in a fork; return the signal that ended it."""
    child = os.fork()
    if child:
        return os.WTERMSIG(os.waitpid(child, 0)[1])
    with contextlib.redirect_stdout(io.StringIO()):
        act()
    os._exit(0)


def every_kill(folder, prepare, act, check, stride=1):
    """Kill an act at every so many-th operation on files; return how often."""

    def killed(at):
        with disk_faults(folder, "killed", at) as faults:
            act()
        assert not faults.struck

    for n_killed, at in enumerate(itertools.count(1, stride)):
        shutil.rmtree(folder, ignore_errors=True)
        folder.mkdir()
        prepare()
        before = readable(folder)
        if in_a_fork(lambda at=at: killed(at)) != signal.SIGKILL:
            return n_killed
        check(before, readable(folder))
        if n_killed % 5 == 0:  # the next run removes what is left
            assert in_a_fork(act) == 0
            assert leftovers(folder) == [], at


def kill_fits(folder, stride, *options):
    """Kill runs of seed 2 into a folder with one of seed 1."""
    landmarks, old = folder.with_name("t.csv"), folder.with_name("old")
    write_landmarks(landmarks)
    with contextlib.redirect_stdout(io.StringIO()):
        assert fit(landmarks, old, 1) == 0

    def check(before, after):
        seed = whole_run(after)
        assert seed == 2 or after == before
        seeds.append(seed)

    def act():
        assert fit(landmarks, folder, 2, *options) == 0

    seeds = []
    n_killed = every_kill(
        folder,
        lambda: shutil.copytree(old, folder, dirs_exist_ok=True),
        act,
        check,
        stride,
    )
    assert set(seeds) == {1, 2}
    return n_killed


def kill_writes(folder):
    """Kill `write_table`."""
    table = pd.DataFrame({"x": np.arange(3.0)})
    path = folder / "a.csv"

    def check(before, after):
        assert after == before or pd.read_csv(path).equals(table)

    return every_kill(
        folder,
        lambda: path.write_text("old"),
        lambda: write_table(table, path),
        check,
    )


def kill_kept(folder):
    """Kill fits that keep their frames in a folder."""
    X = np.random.default_rng(0).normal(size=(20, 30))

    def act():
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            quick = {"isa": FastISA(n_init=1), "refinement": None, "random_state": 0}
            AffineNRSfM(1, keep_frames=folder, **quick).fit(X)

    def check(before, after):
        assert before.items() <= after.items()
        assert len(after) in (len(before), len(before) + 4)

    return every_kill(folder, act, act, check, stride=3)


if __name__ == "__main__":
    matplotlib.use("Agg")
    place, what = Path(sys.argv[1], "out"), sys.argv[2]
    kills = {
        "fit": lambda: kill_fits(place, 7, "--no-figures"),
        "fit with figures": lambda: kill_fits(place, 16),
        "write_table": lambda: kill_writes(place),
        "kept": lambda: kill_kept(place),
    }
    print(kills[what]())
