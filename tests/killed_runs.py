"""Kill forks of this process at each operation on a file, and look at the folder."""

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

from isa_nrsfm import AffineNRSfM
from isa_nrsfm.io import write_table


def in_a_fork(act):
    """Run an act in a fork; return the signal that ended it."""
    child = os.fork()
    if child:
        return os.WTERMSIG(os.waitpid(child, 0)[1])
    with contextlib.redirect_stdout(io.StringIO()):
        act()
    os._exit(0)


def every_kill(folder, prepare, act, check):
    """Kill an act at each operation on files of a folder; return how often."""

    def killed(at):
        with disk_faults(folder, "killed", at) as faults:
            act()
        assert not faults.struck

    for at in itertools.count(1):
        shutil.rmtree(folder, ignore_errors=True)
        folder.mkdir()
        prepare()
        before = readable(folder)
        if in_a_fork(lambda at=at: killed(at)) != signal.SIGKILL:
            return at - 1
        check(before, readable(folder))
        if at % 5 == 0:  # the next run removes what is left
            assert in_a_fork(act) == 0
            assert leftovers(folder) == [], at


def kill_fits(folder, *options):
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
        folder, lambda: shutil.copytree(old, folder, dirs_exist_ok=True), act, check
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
            AffineNRSfM(1, random_state=0, max_iter=3, keep_frames=folder).fit(X)

    def check(before, after):
        assert before.items() <= after.items()
        assert len(after) in (len(before), len(before) + 4)

    return every_kill(folder, act, act, check)


if __name__ == "__main__":
    matplotlib.use("Agg")
    place, what = Path(sys.argv[1], "out"), sys.argv[2]
    kills = {
        "fit": lambda: kill_fits(place, "--no-figures"),
        "fit with figures": lambda: kill_fits(place),
        "write_table": lambda: kill_writes(place),
        "kept": lambda: kill_kept(place),
    }
    print(kills[what]())
