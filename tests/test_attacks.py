"""What strangers, other programs and impatient users do: refused, or without harm."""

import json
import pickle
import re
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
from layers import slow_after
from numpy.testing import assert_array_equal
from refusals import refusals_of, refused, warned

from isa_nrsfm import AffineNRSfM, AffineNRSfMCV
from isa_nrsfm.analysis import AlignedFrames, WithinGroups
from isa_nrsfm.baselines import BlockMatrixNRSfM, CompressibleNRSfM, PseudoInverseNRSfM
from isa_nrsfm.cli import main
from isa_nrsfm.datasets import make_nonrigid_tracks
from isa_nrsfm.io import read_landmarks
from isa_nrsfm.isa import FastISA, PooledFastICA

X = make_nonrigid_tracks(40, 12, 1, noise=0.01, random_state=0).data
HOLES = np.where(np.random.default_rng(0).random((40, 12, 1)) < 0.1, np.nan, 1.0)
SIGNALS = np.random.default_rng(0).laplace(size=(300, 6))
WEAK = {"camera": "weak_perspective", "random_state": 0}
METHODS = "reconstruct reproject score diagnostics smooth rotation_covariance".split()
MODELS = {
    "holes": (AffineNRSfM(1, **WEAK), (HOLES * X.reshape(40, 12, 2)).reshape(40, -1)),
    "paper": (AffineNRSfM(1, refinement=None, random_state=0), X),
    "cv": (AffineNRSfMCV([1], cv=2), X),
    "low rank": (PseudoInverseNRSfM(1), X),
    "blocks": (BlockMatrixNRSfM(1), X),
    "compressible": (CompressibleNRSfM(1), X),
    "groups": (WithinGroups(), X),
    "aligned": (AlignedFrames(), X),
    "FastISA": (FastISA(random_state=0), SIGNALS),
    "FastICA": (PooledFastICA(random_state=0), SIGNALS),
    "cauchy": (AffineNRSfM(1, loss="cauchy", **WEAK), X[:20]),
}


@pytest.mark.parametrize("name", slow_after(len(MODELS) - 1, MODELS))
@pytest.mark.filterwarnings("ignore")
def test_a_refit_that_fails_keeps_the_fit_and_numpys_settings_do_not_matter(name):
    model, table = MODELS[name]
    with np.errstate(all="raise"):
        expected = model.fit(table).transform(table)
        for method in METHODS if isinstance(model, AffineNRSfM) else ():
            with suppress(ValueError):  # of other cameras
                getattr(model, method)(table)
    before = vars(model).copy()
    refits = (np.full_like(table, np.nan), ValueError), (Stop(table), Stopped)
    for bad, error in refits:
        with pytest.raises(error):
            model.fit(bad)
        assert vars(model).keys() == before.keys()
        assert all(vars(model)[key] is value for key, value in before.items())
    assert_array_equal(model.transform(table), expected)


class Stopped(BaseException):
    """An interruption."""


class Stop(pd.DataFrame):
    """A table at which the user interrupts."""

    def __array__(self, *_, **__):
        raise Stopped


def test_threads_see_the_old_or_the_new_fit():
    model = AffineNRSfM(1, refinement=None, random_state=0).fit(X)
    seen, thread = [], threading.Thread(target=lambda: [model.fit(X) for _ in range(3)])
    thread.start()
    while thread.is_alive():
        seen.append(model.transform(X))
    assert all(np.array_equal(each, seen[0]) for each in seen)


TABLE = pd.DataFrame(np.random.default_rng(0).normal(300, 50, (30, 16)), columns=XY)


@pytest.mark.parametrize("digits", ["%.3f", "%.17g", "%.6e", "%.1f", "%.10f"])
@pytest.mark.parametrize("format", ["table", "deeplabcut"])
def test_csv_files_that_end_in_a_number(digits, format, tmp_path):
    frame = pd.concat([FRAME] * 3) * 1.23456789 if format == "deeplabcut" else TABLE
    text = frame.to_csv(index=format != "table", float_format=digits).rstrip("\n")
    if format == "deeplabcut":  # ends with y
        text = "\n".join(line.rpartition(",")[0] for line in text.split("\n"))
    (path := tmp_path / "a.csv").write_text(text)
    whole = read_landmarks(path).points
    path.write_text(text[: -{"%.1f": 2, "%.17g": 8}.get(digits, 3)])
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
    frame = pd.DataFrame(np.round(X[:16] * 100 + 300, 2))
    frame.columns = [f"{axis}_{j}" for j in range(12) for axis in "xy"]
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
    content = BytesIO()
    np.lib.format.write_array(content, array, **options)
    return content.getvalue()


def archive(folder, content):
    """Write an archive of arrays, of which one has this content."""
    with ZipFile(folder / "a.npz", "w") as file:
        file.writestr("points.npy", content)
    return folder / "a.npz"


ARRAY = bytes_of(np.arange(8.0).reshape(2, 4), version=(2, 0))
OBJECTS = bytes_of(np.array([None, None]), allow_pickle=True).partition(b"\n")[0]


YOLO = "0 .5 .5 .2 .2" + " .5" * 10


@pytest.mark.parametrize(
    ("shape", "way"),
    [
        ((12, 8, 3), r"array\[\.\.\., :2\]"),
        ((2, 12, 8), r"array\.transpose\(1, 2, 0\)"),
        ((12, 7), r"array\.reshape\(-1, 2, 7\)"),
        ((12,), r"array \(12,\) of float64"),
    ],
)
def test_arrays_of_other_orders_are_told_the_way(shape, way, tmp_path):
    np.save(path := tmp_path / "a.npy", array := np.zeros(shape))
    told = str(refused(way, read_landmarks, path))
    if len(shape) > 1:
        advised = eval(re.search(r", (array.*?)\)\. E", told)[1], {"array": array})
        np.save(path, advised[:, None])
        warned("is read as", read_landmarks, path)


def test_folders_of_several_kinds(tmp_path):
    folder = files.write_yolo(tmp_path / "a", TRACKS, 2)
    files.write_text(folder / "classes.txt", "person")
    read = partial(read_landmarks, image_size=(500, 500))
    found = warned("not of yolo, and left out: cl", read, folder, "yolo")
    np.testing.assert_allclose(found.points, TRACKS.reshape(12, -1))
    files.write_trc(folder / "a.trc", TRACKS)
    refused("more than one format: trc, yolo", read_landmarks, folder)
    depths = np.arange(12.0)[:, None, None]
    path = files.write_trc(tmp_path / "b.trc", TRACKS, depths)
    refused("different z", read_landmarks, path)


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
