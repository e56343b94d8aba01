"""A disk that fails and a process that is stopped leave the old files, or the new."""

import os
import shutil
from functools import cache, partial
from itertools import count, product

import numpy as np
import pandas as pd
import pytest
from disk_faults import STRIKES, disk_faults, interrupt, leftovers, readable
from fit_runs import FIGURES, FILES, fit, whole_run, write_landmarks
from layers import slow_after
from matplotlib.figure import Figure
from numpy.testing import assert_array_equal
from refusals import refused
from sklearn.exceptions import NotFittedError

from isa_nrsfm import AffineNRSfM, FastISA, export
from isa_nrsfm.datasets import make_nonrigid_tracks
from isa_nrsfm.io import read_table, save_model, write_table

OLD = b"what was there before"
TABLE = pd.DataFrame({"x0": np.linspace(0, 1, 9) / 3, "y0": np.arange(9.0)})
TRACKS = make_nonrigid_tracks(40, 12, 1, noise=0.01, random_state=0).data
# More than what a file buffers.
NUMBERS = np.random.default_rng(0).normal(size=(2000, 2))
LONG_TABLE = pd.DataFrame(NUMBERS, columns=["x0", "y0"])


def keeping(folder):
    """Return an estimator that keeps the coefficients of frames in a folder."""
    quick = {"isa": FastISA(n_init=1), "refinement": None, "random_state": 0}
    return AffineNRSfM(1, keep_frames=folder, **quick)


@cache
def model():
    return keeping(True).fit(TRACKS)


PDM = export.PointDistributionModel(np.eye(9, 3), np.ones((1, 9, 3)), np.array([2.0]))
WRITERS = {
    "a.csv": lambda path: write_table(TABLE, path),
    "long.tsv": lambda path: write_table(LONG_TABLE, path),
    "a.parquet": lambda path: write_table(TABLE, path),
    "a.npz": lambda path: save_model(model(), path),
    "a.html": lambda path: export.write_viewer(model(), path),
    "a.glb": lambda path: export.write_glb(model(), path),
    **dict.fromkeys(("pdm.txt", "pdm.npz", "pdm.mat"), partial(export.write_pdm, PDM)),
    "shapes.npz": lambda path: export.write_shapes(model(), path),
    "shapes.mat": lambda path: export.write_shapes(model(), path),
}


def content(path):
    """Return the bytes of a file without the time in MATLAB's headers."""
    return path.read_bytes()[128 * (path.suffix == ".mat") :]


def every_fault(folder, strike, prepare, act, stride=1):
    """Let each operation of an act fail in turn, until there is none more.

    With a stride it is each so many-th, and others of them for the next strike. Yield
    what was raised, what the folder held before, and the operations.
    """
    first = 1 + list(STRIKES).index(strike) % stride
    for at in count(first, stride):
        shutil.rmtree(folder, ignore_errors=True)
        folder.mkdir()
        prepare()
        before = readable(folder)
        raised = None
        with disk_faults(folder, strike, at) as faults:
            try:
                act()
            except (OSError, KeyboardInterrupt) as error:
                raised = error
        if at > len(faults.operations):
            assert (raised, at > first) == (None, True)
            return
        yield raised, before, faults.operations


# What was there decides which operations there are, not what a strike does to them.
@pytest.mark.parametrize(
    ("strike", "exists"),
    slow_after(1, [*product(STRIKES, [True]), ("disk full", False), ("killed", False)]),
)
@pytest.mark.parametrize("name", WRITERS)
def test_a_file_is_written_whole_or_stays(tmp_path, name, strike, exists):
    write, whole = WRITERS[name], tmp_path / name
    write(whole)
    path = tmp_path / "folder" / name
    prepare = (lambda: path.write_bytes(OLD)) if exists else (lambda: None)
    n_failed = 0
    faults = every_fault(path.parent, strike, prepare, lambda: write(path))
    for raised, before, operations in faults:
        assert strike == "killed" or leftovers(path.parent) == [], operations
        if isinstance(raised, OSError):
            assert raised.filename == str(path)
            assert raised.strerror in {os.strerror(code) for code in (5, 13, 28)}
        if raised is None or readable(path.parent) != before:
            assert content(path) == content(whole)
        else:
            n_failed += 1
    assert n_failed >= 4  # opened, written, on the disk, closed


def test_pipes_are_written_to_and_links_and_permissions_stay(tmp_path):
    pipe, path, link = (tmp_path / f"{name}.csv" for name in ("pipe", "a", "link"))
    os.mkfifo(pipe)
    reading = os.open(pipe, os.O_RDONLY | os.O_NONBLOCK)
    write_table(TABLE, pipe)
    assert os.read(reading, 1000).startswith(b"x0,y0\n")
    os.close(reading)
    path.write_bytes(OLD)
    path.chmod(0o640)
    link.symlink_to("a.csv")
    write_table(TABLE, link)
    assert len(read_table(path)) == len(TABLE)
    assert link.is_symlink()
    assert path.stat().st_mode & 0o777 == 0o640


@pytest.mark.parametrize("strike", slow_after(1, STRIKES))
def test_a_fit_that_fails_leaves_no_frames(tmp_path, strike):
    folder = tmp_path / "kept"
    first, second = keeping(folder), keeping(folder)
    fits = lambda: first.fit(TRACKS), lambda: second.fit(TRACKS[:30])
    faults = every_fault(folder, strike, *fits, stride=4)
    for raised, before, operations in faults:
        after = readable(folder)
        assert before.items() <= after.items()
        assert len(first.alpha_) == 40
        if raised is None:
            assert len(after) == 2 * len(before) == 8
            assert len(second.alpha_) == 30
            second = keeping(folder)  # without a fit for the next fault
            continue
        if isinstance(raised, OSError):
            assert str(folder) in str(raised.filename)
        refused(None, second.transform, TRACKS, error=NotFittedError)
        if strike != "killed":
            assert (after, leftovers(folder)) == (before, []), operations


def test_frames_of_fits_never_meet(tmp_path):
    first, again, second = (keeping(tmp_path / "kept") for _ in range(3))
    kept = first.fit(TRACKS).alpha_
    alpha = kept.copy()
    again.fit(TRACKS)
    assert len(second.fit(TRACKS[:20]).alpha_) == 20
    names = {model.alpha_.filename for model in (first, again, second)}
    assert len(names) == 3
    first.fit(TRACKS[:20])
    assert_array_equal(kept, alpha)


def test_bad_folders_of_frames_are_refused_before_the_fit(tmp_path, monkeypatch):
    def never(*_args, **_keywords):
        raise AssertionError("the fit has begun")

    monkeypatch.setattr(FastISA, "fit", never)
    refused(r"keep_frames should be .* got ''", keeping("").fit, TRACKS)
    (tmp_path / "file").write_bytes(OLD)
    for bad in (tmp_path / "file", tmp_path / "file" / "folder"):
        error = refused(None, keeping(bad).fit, TRACKS, error=OSError)
        assert error.filename == str(bad)
    bad = tmp_path / "no"
    with disk_faults(bad, "disk full", 2) as faults:
        error = refused(None, keeping(bad).fit, TRACKS, error=OSError)
    assert (error.filename, bad.exists()) == (str(bad), False), faults.operations
    # Neither are there folders of fits that fail.
    refused("points", keeping(bad / "kept").fit, TRACKS[:, :6])
    assert os.listdir(tmp_path) == ["file"]


@pytest.fixture(scope="module")
def landmarks(tmp_path_factory):
    path = tmp_path_factory.mktemp("table") / "landmarks.csv"
    write_landmarks(path)
    return path


@pytest.fixture(scope="module")
def old_run(landmarks):
    """Return the folder of a run with figures, whose files hold nothing."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(Figure, "savefig", lambda *_, **__: None)
        assert fit(landmarks, landmarks.with_name("out"), 1) == 0
    return landmarks.with_name("out")


@pytest.fixture
def folder(old_run, tmp_path):
    """Return a copy of the folder of that run."""
    return shutil.copytree(old_run, tmp_path / "out")


def state_of(folder, before):
    """Return the seed of the run in a folder; "mixed" where the digests do not fit."""
    try:
        return whole_run(readable(folder))
    except (AssertionError, KeyError):
        assert readable(folder) != before
        return "mixed"


# With figures the folder was empty.
@pytest.mark.parametrize("strike", slow_after(1, [*STRIKES, "disk full, figures"]))
def test_old_run_or_new(capsys, landmarks, old_run, tmp_path, strike):
    """Run seed 2 into a folder that has a run of seed 1, or nothing."""
    folder, (strike, *figures) = tmp_path / "out", strike.split(", ")
    options = [] if figures else ["--no-figures"]
    codes, found = [], set()

    def prepare():
        if not figures:
            shutil.copytree(old_run, folder, dirs_exist_ok=True)

    def act():
        codes.append(fit(landmarks, folder, 2, *options))

    faults = every_fault(folder, strike, prepare, act, stride=31)
    for raised, before, operations in faults:
        err = capsys.readouterr().err
        assert raised is None
        assert strike == "killed" or leftovers(folder) == [], operations[-3:]
        named = str(folder) in err and ".isa-nrsfm-" not in err
        assert codes[-1] == 0 or err.endswith("interrupted\n") or named, err
        state = state_of(folder, before)
        found.add((codes[-1], state))
        assert state in (2, "mixed") or readable(folder) == before
    code = 130 if STRIKES[strike][0] is interrupt else 1
    assert (code, None if figures else 1) in found
    # Results are in place before the figures.
    assert found <= {(code, None), (code, 1), (code, "mixed"), (code, 2), (0, 2)}


def test_figures_of_the_old_run_go_and_other_files_stay(landmarks, folder):
    assert whole_run(readable(folder)) == 1
    assert FIGURES <= set(os.listdir(folder))
    mine, link = folder / "mine.txt", folder / "link"
    mine.write_bytes(OLD)
    link.symlink_to("mine.txt")
    assert fit(landmarks, folder, 2, "--no-figures") == 0
    assert (mine.read_bytes(), os.readlink(link)) == (OLD, "mine.txt")
    assert set(os.listdir(folder)) == FILES | {"mine.txt", "link"}
    mine.unlink()
    link.unlink()
    assert whole_run(readable(folder)) == 2


def test_what_is_no_plain_file_is_not_replaced(fails, landmarks, tmp_path):
    alpha = tmp_path / "out" / "alpha.csv"
    alpha.parent.mkdir()
    alpha.symlink_to(landmarks)
    argv = ["fit", landmarks, "-o", alpha.parent, "-k", 1, "--no-figures"]
    assert "would be overwritten" in fails(*argv)
    alpha.unlink()
    alpha.mkdir()
    assert f"{alpha}: is no plain file" in fails(*argv)
    assert os.listdir(alpha.parent) == ["alpha.csv"]


def test_models_beside_reports_of_another_run_are_told(
    succeeds, folder, landmarks, tmp_path
):
    def told(model="model.npz"):
        new = tmp_path / "new.npz"
        return succeeds("export", folder / model, "-o", new, "--force")[1]

    shutil.copy(folder / "model.npz", folder / "copy.npz")
    assert told() == ""
    (folder / "alpha.csv").unlink()
    assert told() == ""
    assert fit(landmarks, tmp_path / "other", 2, "--no-figures") == 0
    for name in ("alpha.csv", "model.npz"):
        shutil.copy(tmp_path / "other" / name, folder)
    assert f"{folder / 'report.json'} is of another run than model.npz" in told()
    transform = ["transform", folder / "model.npz", landmarks]
    assert succeeds(*transform, "-o", tmp_path / "new.csv")[1] == told()
    assert told("copy.npz") == ""
    # Reports of something else
    for text in ("", "[]", '{"sha256": 3}', '{"sha256": {"../a": "b"}}'):
        (folder / "report.json").write_text(text)
        assert told() == ""
