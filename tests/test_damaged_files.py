"""Files of every format, damaged in many ways: they are read, or refused in words.

The damages of `damage.py` have fixed seeds. What is read has finite numbers and what
the documentation promises; a refusal is an error of a usual kind that names the file.
"""

import contextlib
import csv
import functools
import gc
import json
import os
import signal
import warnings
import zlib
from itertools import compress
from pathlib import Path

import damage
import landmark_files as files
import numpy as np
import pytest
from layers import slow_after
from sklearn.exceptions import NotFittedError

from isa_nrsfm import AffineNRSfM, io
from isa_nrsfm.datasets import make_face_tracks
from isa_nrsfm.export import PointDistributionModel, read_pdm, write_pdm

resource = pytest.importorskip("resource", reason="limits the memory of a process")
for library in ("h5py", "tables", "pyarrow"):
    pytest.importorskip(library, reason="needs the extra cli, and tables")

REFUSALS = (ValueError, TypeError, OSError, NotFittedError)
# What the reading of a small file may take: seconds, and bytes besides what is used.
SECONDS, MEMORY = 60, 2**31

FACES = make_face_tracks(20, n_components=1, random_state=0).data[:, :28]
MEAN = files.scene(7, 3)[..., 0][:, :3].copy()
PDM = PointDistributionModel(MEAN, np.ones((2, 7, 3)), np.array([2.0, 1.0]))


# --- damages ------------------------------------------------------------------------


def of_tree(content, rng):
    return damage.as_json(damage.damaged_tree(json.loads(content), rng))


def text(separator):
    return lambda content, rng: damage.damaged_text(content.decode(), rng, separator)


# By suffix; other files are text. Of each four damages one is of bytes.
DAMAGES = {
    ".csv": text(","),
    ".tsv": text("\t"),
    ".json": of_tree,
    ".mat": damage.damaged_bytes,
    ".npy": damage.damaged_npy,
    ".npz": damage.damaged_archive,
    ".parquet": damage.damaged_bytes,
}


def change(path, rng):
    """Damage a file."""
    if rng.integers(4) == 0:
        path.write_bytes(damage.damaged_bytes(path.read_bytes(), rng))
    elif path.suffix == ".h5":
        damage.damage_hdf5(path, rng)
    else:
        damaged = DAMAGES.get(path.suffix, text(" "))
        path.write_bytes(damaged(path.read_bytes(), rng))


# --- promises -----------------------------------------------------------------------


def check_landmarks(found):
    """Assert what is promised of all landmarks, and that other frames show points."""
    points = files.tracks_of(found)[~found.failed]
    assert not np.isnan(points).all(axis=(1, 2)).any()


def check_cells(found, path, separator):
    """Assert that points have the numbers that Python's reader finds in the cells."""
    with path.open(encoding="utf-8-sig", newline="") as file:
        rows = [*csv.reader(file, delimiter=separator)]
    rows = [row for row in rows if "".join(row).strip() or len(row) > 1]
    header = [name.strip() for name in rows.pop(0)]
    assert len(rows) == len(found.points)
    for name, values in found.points[~found.failed].items():
        (place,) = (i for i, each in enumerate(header) if each == name)
        texts = [row[place].strip().lower() for row in compress(rows, ~found.failed)]
        expected = [np.nan if text in MISSING else float(text) for text in texts]
        np.testing.assert_array_equal(values, expected)


MISSING = {"", "na", "nan", "n/a", "null", "none", "<na>", "#n/a"}
MISSING |= {"nan(ind)", "-nan(ind)"}
# Warnings of some formats: how an array is read, shares, and what is left out.
SAID = "the array|.*fractions of the width|not of \\w+, and left|shapes that are no"


def read_format(name):
    format = name.partition("-")[0]

    def read(path):
        with contextlib.suppress(ValueError):
            io.find_format(path)
        with warnings.catch_warnings():
            warnings.filterwarnings("ignore", SAID)
            found = io.read_landmarks(path, format)
        check_landmarks(found)
        separator = {".csv": ",", ".tsv": "\t"}.get(path.suffix)
        if format in ("openface", "pyfeat", "table") and separator is not None:
            check_cells(found, path, separator)

    return read


def read_stored(path):
    table = io.open_table(path)
    rows = np.asarray(table[0 : len(table)])
    assert rows.shape == table.shape
    assert rows.dtype.kind in "fiu"


def read_model(path):
    model = io.load_model(path)
    alpha = model.transform(FACES[:2, : model.n_features_in_])
    assert alpha.shape == (2, len(model.basis_))
    assert np.isfinite(alpha).all()


def read_shape_model(path):
    mean, modes, eigenvalues = read_pdm(path)
    assert mean.shape[1:] == (3,)
    assert modes.shape == (len(eigenvalues), *mean.shape)
    assert all(np.isfinite(part).all() for part in (mean, modes, eigenvalues))


# --- formats ------------------------------------------------------------------------


def save_row(path, _, points):
    np.save(path, points.reshape(1, -1))


def written(path, write, content):
    write(content, path)
    return path


@functools.cache
def model():
    return AffineNRSfM(1, random_state=0, camera="weak_perspective").fit(FACES[:, :20])


# Writes a valid file or folder and returns its path; reads it and asserts the promises.
FORMATS = {
    "model": (lambda d: written(d / "a.npz", io.save_model, model()), read_model),
    "pdm txt": (lambda d: written(d / "a.txt", write_pdm, PDM), read_shape_model),
    "npy folder": (files.to("a", files.write_each, ".npy", save_row), read_stored),
    "parquet folder": (
        files.to("a", files.write_each, ".parquet", files.write_row),
        read_stored,
    ),
    **{name: (write, read_format(name)) for name, write in files.WRITERS.items()},
}


# --- the corpus ---------------------------------------------------------------------


class TooLong(Exception):
    """The reading of a small file takes long."""


@contextlib.contextmanager
def limits():
    """Bound what may be used within: time, and memory besides what is in use."""

    def stop(signum, frame):
        raise TooLong

    before = resource.getrlimit(resource.RLIMIT_AS)
    pages = int(Path("/proc/self/statm").read_text().split()[0])
    most = pages * resource.getpagesize() + MEMORY
    handler = signal.signal(signal.SIGALRM, stop)
    resource.setrlimit(resource.RLIMIT_AS, (most, before[1]))
    signal.alarm(SECONDS)
    try:
        yield
    finally:
        signal.alarm(0)
        signal.signal(signal.SIGALRM, handler)
        resource.setrlimit(resource.RLIMIT_AS, before)


def contents(folder):
    """Return the files in a folder, with what they hold."""
    return {path: path.read_bytes() for path in folder.rglob("*") if not path.is_dir()}


def outcome(read, path, damaged):
    """Return whether a damaged file is read, or refused; raise if it is neither."""
    refusal = None
    with warnings.catch_warnings(record=True) as warned, limits():
        warnings.simplefilter("always")
        try:
            read(path)
        except REFUSALS as error:
            refusal = error
    others = [w for w in warned if w.category is not UserWarning]
    assert not others, f"warns: {others[0].message}"
    if refusal is None:
        return "read"
    assert damaged.name in str(refusal), f"not named in: {refusal}"
    return "refused"


def tried(format, path, numbers):
    """Return outcomes of damages by their numbers, and what is wrong with some."""
    targets = sorted(path.iterdir()) if path.is_dir() else [path]
    targets = [target for target in targets if target.suffix != ".png"]
    outcomes, broken = [], {}
    for number in numbers:
        rng = np.random.default_rng([number, zlib.crc32(format.encode())])
        target = damage.pick(rng, targets)
        whole = target.read_bytes()
        change(target, rng)
        before = contents(path.parent)
        try:
            outcomes.append(outcome(FORMATS[format][1], path, target))
        except Exception as error:
            broken[number] = f"{type(error).__name__}: {error}"
        if contents(path.parent) != before:
            broken[number] = "files are left, or changed"
        target.write_bytes(whole)
    return outcomes, broken


# One damage of a variant of each format is quick. Files of many columns have fewer
# others, because the variants of few columns have the same reader.
QUICK = [n for n in FORMATS if "-" not in n] + ["deeplabcut-table"]
WIDE = ["openface", "mediapipe-pixels", "mediapipe-sizes", "pyfeat-mp", "pyfeat-v2"]
OTHERS = [(n, range(6)) for n in FORMATS if n not in QUICK]
OTHERS += [(n, range(1, 80 if n in WIDE else 250)) for n in FORMATS]


@pytest.mark.parametrize(
    ("format", "numbers"),
    slow_after(len(QUICK), [(n, range(1)) for n in QUICK] + OTHERS),
)
def test_damaged_files_are_read_or_refused(format, numbers, tmp_path):
    write, read = FORMATS[format]
    path = write(tmp_path)
    read(path)  # what is imported stays open
    opened = len(os.listdir("/proc/self/fd"))
    outcomes, broken = tried(format, path, numbers)
    assert broken == {}
    assert "refused" in outcomes or len(numbers) < 6
    gc.collect()
    assert len(os.listdir("/proc/self/fd")) <= opened
