"""A disk that fails and a process that is stopped leave the old files, or the new."""

import contextlib
import itertools
import os
import shutil
import subprocess
import sys
from pathlib import Path

import numpy as np
import pandas as pd
import pytest
from disk_faults import STRIKES, disk_faults, leftovers, readable
from export_models import face_model
from fit_runs import FIGURES, FILES, fit, whole_run, write_landmarks
from layers import slow_after
from numpy.testing import assert_array_equal
from scipy.io import loadmat
from sklearn.exceptions import NotFittedError

from isa_nrsfm import AffineNRSfM, FastISA
from isa_nrsfm._compat.whole_files import ASIDE, whole_file
from isa_nrsfm.cli import main
from isa_nrsfm.datasets import make_nonrigid_tracks
from isa_nrsfm.export import (
    point_distribution_model,
    read_pdm,
    write_glb,
    write_pdm,
    write_shapes,
    write_viewer,
)
from isa_nrsfm.io import load_model, read_table, save_model, write_table

HERE = Path(__file__).parent
RAISED = [name for name in STRIKES if name != "killed"]
OLD = b"what was there before"
TABLE = pd.DataFrame({"x0": np.linspace(0, 1, 9) / 3, "y0": np.arange(9.0)})
# More than what a file buffers.
LONG_TABLE = pd.DataFrame(
    np.random.default_rng(0).normal(size=(2000, 2)), columns=["x0", "y0"]
)


def model():
    return face_model()


def pdm():
    return point_distribution_model(model())


def is_table(path, table=TABLE):
    pd.testing.assert_frame_equal(read_table(path), table)


def is_model(path):
    assert_array_equal(load_model(path).alpha_, model().alpha_)


def is_pdm(path):
    for got, expected in zip(read_pdm(path), pdm(), strict=True):
        assert_array_equal(got, expected)


def are_arrays(path):
    read = np.load if path.suffix == ".npz" else loadmat
    assert_array_equal(read(path)["alpha"], model().alpha_)


def is_the_same_as_by(write):
    """Return a check of files that are the same each time."""

    def check(path):
        again = path.with_stem("again")
        write(path=again)
        assert path.read_bytes() == again.read_bytes()
        again.unlink()

    return check


def viewer(path):
    write_viewer(model(), path)


def glb(path):
    write_glb(model(), path)


# What writes a file, and what raises if the file is not whole.
WRITERS = {
    "a.csv": (lambda path: write_table(TABLE, path), is_table),
    "long.tsv": (
        lambda path: write_table(LONG_TABLE, path),
        lambda path: is_table(path, LONG_TABLE),
    ),
    "a.parquet": (lambda path: write_table(TABLE, path), is_table),
    "a.npz": (lambda path: save_model(model(), path), is_model),
    "pdm.txt": (lambda path: write_pdm(pdm(), path), is_pdm),
    "pdm.npz": (lambda path: write_pdm(pdm(), path), is_pdm),
    "pdm.mat": (lambda path: write_pdm(pdm(), path), is_pdm),
    "shapes.npz": (lambda path: write_shapes(model(), path), are_arrays),
    "shapes.mat": (lambda path: write_shapes(model(), path), are_arrays),
    "a.html": (viewer, is_the_same_as_by(viewer)),
    "a.glb": (glb, is_the_same_as_by(glb)),
}


def every_fault(folder, strike, prepare, act, stride=1):
    """Let each operation of an act fail in turn, until there is none more.

    With a stride it is each so many-th, and others of them for the next strike. Yield
    what was raised, what the folder held before, and the operations.
    """
    first = 1 + list(STRIKES).index(strike) % stride
    for at in itertools.count(first, stride):
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
        if not faults.struck:
            assert raised is None
            assert at > first
            return
        yield raised, before, faults.operations


@pytest.mark.parametrize("exists", slow_after(1, [True, False]))
@pytest.mark.parametrize("strike", slow_after(1, RAISED))
@pytest.mark.parametrize("name", WRITERS)
def test_a_file_is_written_whole_or_stays(tmp_path, name, strike, exists):
    write, check = WRITERS[name]
    path = tmp_path / "folder" / name
    prepare = (lambda: path.write_bytes(OLD)) if exists else (lambda: None)
    n_failed = 0
    for raised, before, operations in every_fault(
        path.parent, strike, prepare, lambda: write(path)
    ):
        assert leftovers(path.parent) == [], operations
        if isinstance(raised, OSError):
            assert raised.filename == str(path)
            assert raised.strerror in {os.strerror(code) for code in (5, 13, 28)}
        if raised is None or readable(path.parent) != before:
            check(path)
        else:
            n_failed += 1
            assert readable(path.parent) == before
    assert n_failed >= 4  # opened, written, on the disk, closed


def test_files_that_others_write_are_left_alone(tmp_path):
    with whole_file(tmp_path / "slow.txt") as file:
        file.write(OLD)
        write_table(TABLE, tmp_path / "a.csv")
        assert len(leftovers(tmp_path)) == 1
    assert (tmp_path / "slow.txt").read_bytes() == OLD
    assert sorted(os.listdir(tmp_path)) == ["a.csv", "slow.txt"]


def test_leftovers_of_killed_processes_are_removed(tmp_path):
    (tmp_path / f"{ASIDE}0").write_bytes(OLD)
    stage = tmp_path / f"{ASIDE}1"
    (stage / "new").mkdir(parents=True)
    (stage / "current").symlink_to("new")
    (stage / "new" / "b.csv").write_bytes(OLD)
    for name in ("b.csv", "absent.csv"):
        (tmp_path / name).symlink_to(Path(stage.name, "current", name))
    (tmp_path / ".mine").write_bytes(OLD)
    write_table(TABLE, tmp_path / "a.csv")
    assert sorted(os.listdir(tmp_path)) == [".mine", "a.csv", "b.csv"]
    assert not (tmp_path / "b.csv").is_symlink()
    assert (tmp_path / "b.csv").read_bytes() == OLD


def test_what_is_no_file_is_written_to(tmp_path):
    pipe = tmp_path / "pipe.csv"
    os.mkfifo(pipe)
    reading = os.open(pipe, os.O_RDONLY | os.O_NONBLOCK)
    write_table(TABLE, pipe)
    assert os.read(reading, 1000).startswith(b"x0,y0\n")
    os.close(reading)
    link = tmp_path / "link.csv"
    link.symlink_to("a.csv")
    write_table(TABLE, link)
    is_table(tmp_path / "a.csv")
    assert link.is_symlink()


@pytest.mark.skipif(
    not hasattr(os, "getuid") or os.getuid() == 0, reason="needs a user"
)
def test_files_that_are_protected_stay(tmp_path):
    path = tmp_path / "a.csv"
    path.write_bytes(OLD)
    path.chmod(0o440)
    with pytest.raises(PermissionError) as error:
        write_table(TABLE, path)
    assert error.value.filename == str(path)
    assert path.read_bytes() == OLD


def test_a_file_keeps_its_permissions(tmp_path):
    path = tmp_path / "a.csv"
    path.write_bytes(OLD)
    path.chmod(0o640)
    write_table(TABLE, path)
    assert path.stat().st_mode & 0o777 == 0o640


@pytest.fixture(name="table", scope="module")
def small_table():
    return make_nonrigid_tracks(40, 12, 1, noise=0.01, random_state=0).data


class TestKeepFrames:
    @staticmethod
    def estimator(folder, **params):
        quick = {"isa": FastISA(n_init=1), "refinement": None, "random_state": 0}
        return AffineNRSfM(1, keep_frames=folder, **quick, **params)

    def test_a_full_disk_is_no_fit(self, tmp_path, table):
        folder = tmp_path / "kept"
        with disk_faults(folder, "disk full", 0) as faults:
            self.estimator(folder).fit(table)
        names = [name for name, *_ in faults.operations]
        before = readable(folder)
        failed = self.estimator(folder)
        with (
            disk_faults(folder, "disk full", names.index("write") + 1),
            pytest.raises(OSError, match="No space left on device") as error,
        ):
            failed.fit(table)
        assert Path(error.value.filename).name == "motion.npy"
        assert readable(folder) == before
        assert leftovers(folder) == []
        with pytest.raises(NotFittedError):
            failed.transform(table)

    @pytest.mark.slow
    @pytest.mark.parametrize("strike", RAISED)
    def test_a_fit_that_fails_leaves_nothing(self, tmp_path, table, strike):
        folder = tmp_path / "kept"
        first = self.estimator(folder)
        second = self.estimator(folder)
        for raised, before, operations in every_fault(
            folder,
            strike,
            lambda: first.fit(table),
            lambda: second.fit(table[:30]),
            stride=2,
        ):
            assert leftovers(folder) == [], operations
            after = readable(folder)
            assert before.items() <= after.items()
            assert len(first.alpha_) == 40
            if raised is None:
                assert len(after) == 2 * len(before) == 8
                assert len(second.alpha_) == 30
            else:
                assert after == before
                assert len(list(folder.iterdir())) == 1
                with pytest.raises(NotFittedError):
                    second.transform(table)

    def test_fits_never_meet(self, tmp_path, table):
        first = self.estimator(tmp_path / "kept").fit(table)
        alpha = first.alpha_.copy()
        first_again = self.estimator(tmp_path / "kept").fit(table)
        second = self.estimator(tmp_path / "kept").fit(table[:20])
        names = {m.alpha_.filename for m in (first, first_again, second)}
        assert len(names) == 3
        assert_array_equal(first.alpha_, alpha)
        assert len(second.alpha_) == 20
        kept = first.alpha_
        first.fit(table[:20])
        assert_array_equal(kept, alpha)

    def test_a_saved_model_has_its_frames(self, tmp_path, table):
        fitted = self.estimator(tmp_path / "kept").fit(table)
        save_model(fitted, tmp_path / "a.npz")
        shutil.rmtree(tmp_path / "kept")
        loaded = load_model(tmp_path / "a.npz")
        assert_array_equal(loaded.alpha_, fitted.alpha_)
        assert_array_equal(loaded.motion_, fitted.motion_)

    def test_bad_folders_are_refused_before_the_fit(self, tmp_path, table, monkeypatch):
        def never(*_args):
            raise AssertionError("the fit has begun")

        monkeypatch.setattr(AffineNRSfM, "_fit", never)
        with pytest.raises(ValueError, match=r"keep_frames should be .* got ''"):
            self.estimator("").fit(table)
        (tmp_path / "file").write_bytes(OLD)
        for bad in (tmp_path / "file", tmp_path / "file" / "folder"):
            with pytest.raises(OSError) as error:  # noqa: PT011
                self.estimator(bad).fit(table)
            assert error.value.filename == str(bad)
        with (
            disk_faults(tmp_path / "no", "disk full", 2) as faults,
            pytest.raises(OSError) as error,  # noqa: PT011
        ):
            self.estimator(tmp_path / "no").fit(table)
        assert error.value.filename == str(tmp_path / "no")
        assert not (tmp_path / "no").exists(), faults.operations

    def test_folders_of_a_fit_that_fails_are_removed(self, tmp_path, table):
        with pytest.raises(ValueError, match="points"):
            self.estimator(tmp_path / "new" / "kept").fit(table[:, :6])
        assert list(tmp_path.iterdir()) == []


@pytest.fixture
def landmarks(tmp_path):
    path = tmp_path / "landmarks.csv"
    write_landmarks(path)
    return path


@pytest.fixture(scope="module")
def old_run(tmp_path_factory):
    """Return the folder of a run with figures."""
    folder = tmp_path_factory.mktemp("old")
    write_landmarks(folder / "landmarks.csv")
    assert fit(folder / "landmarks.csv", folder / "out", 1) == 0
    return folder / "out"


def copied(old_run, folder):
    """Put a copy of a run into an empty folder."""
    for file in old_run.iterdir():
        shutil.copy(file, folder)


@contextlib.contextmanager
def without_links():
    """Take symbolic links away, as memory cards and Windows do."""

    def refuse(*_args, **_keywords):
        raise OSError(1, "Operation not permitted")

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(os, "symlink", refuse)
        patch.setattr(os, "link", refuse)
        yield


class TestFit:
    """Runs of seed 2 into a folder that has one of seed 1, or nothing."""

    def check(self, capsys, landmarks, folder, strike, prepare, stride, *options):
        codes = []

        def run():
            codes.append(fit(landmarks, folder, 2, *options))

        found = set()
        for raised, before, operations in every_fault(
            folder, strike, prepare, run, stride
        ):
            err = capsys.readouterr().err
            assert raised is None
            assert leftovers(folder) == [], operations[-3:]
            seed = whole_run(readable(folder))
            found.add((codes[-1], seed))
            assert (
                codes[-1] == 0
                or err.endswith("interrupted\n")
                or (str(folder) in err and ".isa-nrsfm-" not in err)
            ), err
            assert codes[-1] != 0 or seed == 2
            if seed != 2:
                assert readable(folder) == before
        return found

    @pytest.mark.slow
    @pytest.mark.parametrize("strike", RAISED)
    def test_the_old_run_or_the_new_one(
        self, capsys, landmarks, old_run, tmp_path, strike
    ):
        folder = tmp_path / "out"
        found = self.check(
            capsys,
            landmarks,
            folder,
            strike,
            lambda: copied(old_run, folder),
            4,
            "--no-figures",
        )
        code = 130 if "interrupted" in strike else 1
        assert (code, 1) in found
        assert found <= {(code, 1), (code, 2), (0, 2)}

    @pytest.mark.slow
    def test_without_symbolic_links(self, capsys, landmarks, old_run, tmp_path):
        folder = tmp_path / "out"
        with without_links():
            found = self.check(
                capsys,
                landmarks,
                folder,
                "disk broken",
                lambda: copied(old_run, folder),
                4,
                "--no-figures",
            )
        assert found == {(1, 1), (0, 2)}

    @pytest.mark.slow
    def test_with_figures_into_an_empty_folder(self, capsys, landmarks, tmp_path):
        folder = tmp_path / "out"
        found = self.check(capsys, landmarks, folder, "disk full", lambda: None, 10)
        assert (1, None) in found
        # Results are in place before the figures.
        assert found <= {(1, None), (1, 2), (0, 2)}

    @pytest.mark.parametrize("links", [True, False])
    def test_figures_of_the_old_run_go(self, landmarks, old_run, tmp_path, links):
        folder = tmp_path / "out"
        folder.mkdir()
        copied(old_run, folder)
        assert whole_run(readable(folder)) == 1
        assert FIGURES <= set(os.listdir(folder))
        with contextlib.nullcontext() if links else without_links():
            assert fit(landmarks, folder, 2, "--no-figures") == 0
        assert set(os.listdir(folder)) == FILES
        assert whole_run(readable(folder)) == 2

    @pytest.mark.parametrize("strike", ["disk full", "interrupted after"])
    def test_a_few_faults(self, capsys, landmarks, old_run, tmp_path, strike):
        folder = tmp_path / "out"
        folder.mkdir()
        copied(old_run, folder)
        with disk_faults(folder, strike, 0) as faults:
            assert fit(landmarks, folder, 2, "--no-figures") == 0
        links = [
            at for at, (name, *_) in enumerate(faults.operations) if name == "symlink"
        ]
        for at in (len(faults.operations) // 4, links[-1] + 4):
            shutil.rmtree(folder)
            folder.mkdir()
            copied(old_run, folder)
            with disk_faults(folder, strike, at) as faults:
                assert fit(landmarks, folder, 2, "--no-figures") in (0, 1, 130)
            assert faults.struck
            assert leftovers(folder) == []
            assert whole_run(readable(folder)) in (1, 2)
        capsys.readouterr()

    def test_other_files_are_left_alone(self, landmarks, tmp_path):
        folder = tmp_path / "out"
        folder.mkdir()
        (folder / "mine.txt").write_bytes(OLD)
        (folder / "link").symlink_to("mine.txt")
        assert fit(landmarks, folder, 2, "--no-figures") == 0
        assert (folder / "mine.txt").read_bytes() == OLD
        assert os.readlink(folder / "link") == "mine.txt"

    def test_what_is_no_plain_file_is_not_replaced(self, run, landmarks, tmp_path):
        folder = tmp_path / "out"
        folder.mkdir()
        (folder / "alpha.csv").symlink_to(landmarks)
        code, _, err = run("fit", landmarks, "-o", folder, "-k", 1, "--no-figures")
        assert code == 1
        assert "alpha.csv would be overwritten" in err or "overwritten by" in err
        (folder / "alpha.csv").unlink()
        (folder / "alpha.csv").mkdir()
        code, _, err = run("fit", landmarks, "-o", folder, "-k", 1, "--no-figures")
        assert code == 1
        assert f"{folder / 'alpha.csv'}: is no plain file" in err
        assert os.listdir(folder) == ["alpha.csv"]


@pytest.mark.slow
@pytest.mark.parametrize("strike", RAISED)
@pytest.mark.parametrize("command", ["transform", "export"])
def test_transform_and_export(capsys, landmarks, old_run, tmp_path, strike, command):
    name = {"transform": "a.csv", "export": "a.html"}[command]
    output = tmp_path / "folder" / name
    table = [str(landmarks)] * (command == "transform")
    argv = [command, str(old_run / "model.npz"), *table, "-o", str(output)]
    assert main([*argv[:-1], str(tmp_path / name)]) == 0
    codes = []
    for raised, before, operations in every_fault(
        output.parent,
        strike,
        lambda: output.write_bytes(OLD),
        lambda: codes.append(main(argv)),
    ):
        assert raised is None
        assert leftovers(output.parent) == [], operations
        err = capsys.readouterr().err
        if codes[-1] == 1:
            assert err.startswith(f"isa-nrsfm: error: {output}: ")
        if codes[-1] == 0 or readable(output.parent) != before:
            assert output.read_bytes() == (tmp_path / name).read_bytes()
    assert set(codes) == {0, 130 if "interrupted" in strike else 1}


class TestRunsThatAreMixed:
    @pytest.fixture
    def folder(self, old_run, tmp_path):
        folder = tmp_path / "out"
        folder.mkdir()
        copied(old_run, folder)
        return folder

    def warned(self, run, folder, landmarks, model="model.npz"):
        errors = []
        for argv in (
            ("transform", folder / model, landmarks, "-o", folder / "new.csv"),
            ("export", folder / model, "-o", folder / "new.npz"),
        ):
            code, _, err = run(*argv)
            assert code == 0
            errors.append(err)
        assert errors[0] == errors[1]
        return errors[0]

    def test_files_of_one_run(self, run, folder, landmarks):
        assert self.warned(run, folder, landmarks) == ""

    def test_some_files_are_absent(self, run, folder, landmarks):
        (folder / "alpha.csv").unlink()
        assert self.warned(run, folder, landmarks) == ""
        (folder / "report.json").unlink()
        assert self.warned(run, folder, landmarks) == ""

    def test_files_of_two_runs(self, run, folder, landmarks, tmp_path):
        assert fit(landmarks, tmp_path / "other", 2, "--no-figures") == 0
        for name in ("alpha.csv", "model.npz"):
            shutil.copy(tmp_path / "other" / name, folder)
        said = self.warned(run, folder, landmarks)
        assert f"{folder / 'report.json'} is of another run than model.npz" in said

    def test_a_model_elsewhere(self, run, folder, landmarks):
        shutil.copy(folder / "model.npz", folder / "copy.npz")
        (folder / "model.npz").write_bytes(OLD)
        assert self.warned(run, folder, landmarks, "copy.npz") == ""

    @pytest.mark.parametrize(
        "text", ["", "[]", "{", '{"sha256": 3}', '{"sha256": {"../a": "b"}}']
    )
    def test_reports_of_something_else(self, run, folder, landmarks, text):
        (folder / "report.json").write_text(text)
        assert self.warned(run, folder, landmarks) == ""


@pytest.mark.slow
@pytest.mark.subprocess
@pytest.mark.parametrize("what", ["fit", "fit with figures", "write_table", "kept"])
def test_processes_that_are_killed(tmp_path, what):
    # Forks of one process, which has no threads, are killed at operations on files.
    done = subprocess.run(
        [sys.executable, HERE / "killed_runs.py", tmp_path, what],
        capture_output=True,
        text=True,
    )
    assert done.returncode == 0, done.stdout + done.stderr
    n_killed = int(done.stdout.splitlines()[-1])
    assert n_killed > 5
