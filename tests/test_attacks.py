"""What strangers, other programs and impatient users do: refused, or without harm."""

import json
import pickle
import threading
from contextlib import suppress
from functools import partial
from io import BytesIO
from zipfile import ZipFile

import landmark_files as files
import numpy as np
import pandas as pd
import pytest
from fit_runs import QUICK
from landmark_files import FRAME, TRACKS, XY
from layers import may_not_converge
from numpy.testing import assert_array_equal
from refusals import refusals_of, refused, warned
from scenes import with_gaps
from sklearn.base import clone

from isa_nrsfm import AffineNRSfM, AffineNRSfMCV
from isa_nrsfm.analysis import AlignedFrames, WithinGroups
from isa_nrsfm.baselines import BlockMatrixNRSfM, CompressibleNRSfM, PseudoInverseNRSfM
from isa_nrsfm.cli import main
from isa_nrsfm.datasets import make_nonrigid_tracks
from isa_nrsfm.io import read_landmarks
from isa_nrsfm.isa import FastISA, PooledFastICA

X = make_nonrigid_tracks(24, 12, 1, noise=0.01, random_state=0).data
SIGNALS = np.random.default_rng(0).laplace(size=(300, 6))
WEAK = AffineNRSfM(1, camera="weak_perspective", random_state=0)
PAPER = AffineNRSfM(1, refinement=None, isa=FastISA(n_init=1), random_state=0)
METHODS = "reconstruct reproject score diagnostics smooth rotation_covariance".split()
MODELS = {
    "holes": (WEAK, with_gaps(X, 0.1)),
    "cv": (AffineNRSfMCV([1], estimator=PAPER, cv=2), X),
    "low rank": (PseudoInverseNRSfM(1), X),
    "blocks": (BlockMatrixNRSfM(1), X),
    "compressible": (CompressibleNRSfM(1), X),
    "groups": (WithinGroups(), X),
    "aligned": (AlignedFrames(), X),
    "FastISA": (FastISA(random_state=0), SIGNALS),
    "FastICA": (PooledFastICA(random_state=0), SIGNALS),
}


@pytest.mark.parametrize("name", MODELS)
@pytest.mark.filterwarnings("ignore")
def test_a_refit_that_fails_keeps_the_fit_and_numpys_settings_do_not_matter(name):
    model, table = MODELS[name]
    with np.errstate(all="raise"):
        expected = model.fit(table).transform(table)
        for method in METHODS if isinstance(model, AffineNRSfM) else ():
            with suppress(ValueError):  # of other cameras
                getattr(model, method)(table)
    before = vars(model).copy()
    missing, stop = np.full_like(table, np.nan), Stop(table)
    for bad, error in ((missing, ValueError), (stop, Stopped)):
        refused(None, model.fit, bad, error=error)
        assert vars(model).keys() == before.keys()
        assert all(vars(model)[key] is value for key, value in before.items())
    assert_array_equal(model.transform(table), expected)


class Stopped(BaseException):
    """An interruption."""


class Stop(pd.DataFrame):
    """A table at which the user interrupts."""

    def __array__(self, *_, **__):
        raise Stopped


@may_not_converge
def test_threads_see_the_old_or_the_new_fit():
    model = clone(PAPER).fit(X)
    seen, thread = [], threading.Thread(target=lambda: [model.fit(X) for _ in range(3)])
    thread.start()
    while thread.is_alive():
        seen.append(model.transform(X))
    assert all(np.array_equal(each, seen[0]) for each in seen)


TABLE = pd.DataFrame(np.random.default_rng(0).normal(300, 50, (30, 16)), columns=XY)


@pytest.mark.parametrize(
    ("digits", "last"), [("%.3f", 3), ("%.17g", 8), ("%.6e", 3), ("%.1f", 2)]
)
def test_csv_files_that_end_in_a_number(digits, last, tmp_path):
    text = TABLE.to_csv(index=False, float_format=digits).rstrip("\n")
    (path := tmp_path / "a.csv").write_text(text)
    whole = read_landmarks(path).points
    path.write_text(text[:-last])
    refused("ends in the middle of a number", read_landmarks, path)
    path.write_text(text[:-30])
    refused("truncated|should hold numbers", read_landmarks, path)
    path.write_text(text + "\n")
    assert_array_equal(read_landmarks(path).points, whole)


# What readers call while they read.
OF_READERS = (np, "array"), (np, "reshape"), (json, "load"), (pd, "read_csv")


@pytest.mark.parametrize("name", ["table", "pts-file", "coco", "tps", "trc", "yolo"])
@pytest.mark.filterwarnings("ignore")
def test_files_that_grow_while_they_are_read(name, tmp_path, monkeypatch):
    path = files.WRITERS[name](tmp_path)
    path = next(path.iterdir()) if path.is_dir() else path

    def growing(real, *args, **options):
        with path.open("a") as file:
            file.write(" ")
        return real(*args, **options)

    for owner, name in OF_READERS:
        monkeypatch.setattr(owner, name, partial(growing, getattr(owner, name)))
    refused("was changed while|in the middle of a", read_landmarks, path)


NESTED = "l"
for _ in range(9):
    NESTED = (NESTED,) * 10


def test_control_characters_reach_neither_terminal_nor_report(tmp_path, capsys):
    text = "\x1b]0;a\x07\x1b[2J\x9b2J\x08\x7f\u202egpj.exe\u2028"
    names = [f"{axis}_{j}" for j in range(12) for axis in "xy"]
    frame = pd.DataFrame(np.round(X[:16] * 100 + 300, 2), columns=names)
    frame = frame.assign(**{f"{text}note": "a", "who": [f"{text}a", f"{text}b"] * 8})
    frame.to_csv(path := tmp_path / "a.csv", index=False)
    options = ["fit", str(path), *QUICK, "1", "--force", "-o", str(tmp_path / "b")]
    assert main([*options, "--label", "who"]) == 0
    assert main([*options, "--group", f"{text}x"]) == 1
    frame.assign(x_3=text).to_csv(path, index=False)
    assert main(options) == 1
    with pytest.raises(SystemExit):
        main([*options, f"{text}.csv"])
    shown = "".join(capsys.readouterr()) + (tmp_path / "b/report.html").read_text()
    assert not {*text} - {*"]0;a[2Jgpj.exe"} & {*shown}


def bytes_of(array, **options):
    """Return the bytes of an array in NumPy's format."""
    np.lib.format.write_array(content := BytesIO(), array, **options)
    return content.getvalue()


def archive(folder, content):
    """Write an archive of arrays, of which one has this content."""
    with ZipFile(folder / "a.npz", "w") as file:
        file.writestr("points.npy", content)
    return folder / "a.npz"


ARRAY = bytes_of(np.arange(8.0).reshape(2, 4), version=(2, 0))
OBJECTS = bytes_of(np.array([None, None]), allow_pickle=True).partition(b"\n")[0]


YOLO = "0 .5 .5 .2 .2" + " .5" * 10


def saved(folder, *shape):
    """Write an array of zeros."""
    np.save(folder / "a.npy", np.zeros(shape))
    return folder / "a.npy"


def test_files_of_another_format_in_a_folder_are_left_out(tmp_path):
    folder = files.write_yolo(tmp_path / "a", TRACKS, 2)
    files.write_text(folder / "classes.txt", "person")
    read = partial(read_landmarks, image_size=(500, 500))
    found = warned("not of yolo, and left out: cl", read, folder, "yolo")
    np.testing.assert_allclose(found.points, TRACKS.reshape(12, -1))


def joined(folder, part, change):
    """Write annotations of which one entry is there twice, with other content."""
    content = files.coco_annotations(TRACKS)
    content[part].append(content[part][0] | change)
    return files.write_json(folder / "a.json", content)


def labelled(folder, labels, protocol):
    """Write a table of DeepLabCut with other labels of its columns."""
    h5py = pytest.importorskip("h5py", reason="needs the extra h5")
    path = files.write_deeplabcut(folder / "a.h5", FRAME)
    with h5py.File(path, "a") as file:
        pickled = np.void(pickle.dumps(labels, protocol))
        file["df_with_missing/table"].attrs["values_block_0_kind"] = pickled
    return path


test_refusals = refusals_of("attacks", globals())
