"""Runs of the command fit that tests let fail, and what a folder then holds."""

import hashlib
import io
import json
import re
from contextlib import redirect_stderr, redirect_stdout
from html import unescape
from pathlib import Path

import pandas as pd
import pytest

from isa_nrsfm import AffineNRSfM
from isa_nrsfm.cli import main
from isa_nrsfm.datasets import make_nonrigid_tracks
from isa_nrsfm.io import load_model

MODEL = "model.npz"
FIGURES = {"basis_shapes.png", "mode_covariance.png", "reprojection.png"}
FILES = {"alpha.csv", "cameras.csv", "shapes.csv", "shapes.npz", MODEL}
FILES |= {"report.html", "report.json", "viewer.html"}


# Options of fits that take no time.
QUICK = "--isa fast --n-init 2 --refinement none --no-figures -k".split()
# Options of joint fits that try no other settings.
JOINT = "--camera weak_perspective --refinement joint --loss linear".split()
JOINT.append("--no-figures")


class Results:
    """What a fit has written to its folder and to the terminal."""

    def __init__(self, folder, out="", err=""):
        self.folder, self.out, self.err = folder, out, err
        self.path = folder / MODEL

    @property
    def report(self):
        return json.loads((self.folder / "report.json").read_text(encoding="utf-8"))

    @property
    def page(self):
        """Text of the report."""
        page = (self.folder / "report.html").read_text(encoding="utf-8")
        return unescape(re.sub("<[^<>]+>", " ", page))

    @property
    def alpha(self):
        return pd.read_csv(self.folder / "alpha.csv", dtype={"code": str})

    @property
    def cameras(self):
        return pd.read_csv(self.folder / "cameras.csv")

    @property
    def model(self):
        return load_model(self.path)


def write_landmarks(path):
    """Write a table for fits that take no time."""
    tracks = make_nonrigid_tracks(30, 12, 1, noise=0.01, random_state=0)
    names = [f"{axis}{j}" for j in range(12) for axis in "xy"]
    pd.DataFrame(tracks.data, columns=names).to_csv(path, index=False)


def fit(table, folder, seed, *options):
    """Run the command fit, with the quickest of models; return its exit code."""
    quick = ["--isa", "fast", "--n-init", 1, "--refinement", "none", "-k", 1]
    argv = ["fit", table, "-o", folder, "--random-state", seed, *quick, *options]
    return main([str(word) for word in argv])


def ran(*argv):
    """Run a command; return exit code, output and errors.

    Errors are without the progress of slow runs. Both are UTF-8, as on a terminal.
    """
    options = {"encoding": "utf-8", "newline": ""}
    out, err = (io.TextIOWrapper(io.BytesIO(), **options) for _ in range(2))
    with redirect_stdout(out), redirect_stderr(err):
        code = main([str(word) for word in argv])
    for stream in (out, err):
        stream.seek(0)
    progress = re.compile(r"^isa-nrsfm: \d+ s: .*\n", re.MULTILINE)
    return code, out.read(), progress.sub("", err.read())


def told(*argv):
    """Raise the message of a command that fails, which is the last line it shows."""
    code, out, err = ran(*argv)
    assert (code, out) == (1, ""), err
    assert "Traceback" not in err
    raise ValueError(err.splitlines()[-1].partition("isa-nrsfm: error: ")[2])


def told_of_fit(table, options):
    """Raise the message of a fit that fails, and writes nothing beside its table."""
    try:
        told("fit", table, "-o", table.parent / "results", *options.split())
    finally:
        assert not (table.parent / "results").exists()


def begun(table, *options):
    """Read a table up to its fit; return what is told until then."""
    argv = ["fit", table, "-o", Path(table).parent / "no results", "-k", 1, *options]
    argv += ["--refinement", "none", "--no-figures"]

    def stop(*_, **__):
        raise ValueError("here the fit begins")

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(AffineNRSfM, "fit", stop)
        code, out, err = ran(*argv)
    before, last = err[:-1].rpartition("\n")[::2]
    assert (code, out) == (1, ""), err
    assert last == "isa-nrsfm: error: here the fit begins"
    return before


def usage(words):
    """Raise the message of wrong usage, which has one line, and ends with code 2."""
    with redirect_stderr(io.StringIO()) as err, pytest.raises(SystemExit) as end:
        main(words.split(" ") if words else [])
    message = err.getvalue()
    assert (end.value.code, message.count("\n"), message[:9]) == (2, 1, "isa-nrsfm")
    raise ValueError(message)


def whole_run(files):
    """Return the seed of the run that files are of, by the digests in its report.

    None are of no run. Files of two runs, or of a part of one, are an error.
    """
    if not files:
        return None
    report = json.loads(files["report.json"])
    for name, digest in report["sha256"].items():
        assert hashlib.sha256(files[name]).hexdigest() == digest, name
    listed = {*report["sha256"], "report.json"}
    assert files.keys() == listed == {*report["files"], "report.json"}
    assert FILES <= listed
    return report["model"]["parameters"]["random_state"]
