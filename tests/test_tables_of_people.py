"""Tables as people write them: CONTRIBUTING lists each way and what happens."""

import contextlib
import gzip
import re
import warnings
from functools import partial

import landmark_files as files
import numpy as np
import pandas as pd
import pytest
from fit_runs import QUICK, ran, told_of_fit
from landmark_files import saved, scene
from made_once import made_once
from refusals import refusals_of, refused, warned

from isa_nrsfm import AffineNRSfM, FastISA, analysis
from isa_nrsfm.baselines import PseudoInverseNRSfM
from isa_nrsfm.datasets import make_nonrigid_tracks
from isa_nrsfm.io import landmark_table, open_table, read_landmarks, read_table
from isa_nrsfm.skeletons import read_skeleton

N = 24
POINTS = [f"{axis}{j}" for j in range(12) for axis in "xy"]


@made_once
def landmarks(n_frames=N):
    scene = make_nonrigid_tracks(n_frames, 12, 1, noise=0.01, random_state=0)
    return pd.DataFrame(scene.data, columns=POINTS)


def table_beside(folder, columns, suffix=".csv", **written):
    """Return the path of a table with further columns."""
    columns = pd.DataFrame(columns)
    table = pd.concat([landmarks(len(columns)), columns], axis=1)
    return saved(folder / f"table{suffix}", table, **written)


def handed(owner, name, path, *options):
    """Run the command fit up to a call of a function: its arguments, what is told."""
    calls = []

    def stop(*args, **kwargs):
        calls.append((args, kwargs))
        raise ValueError("here it is called")

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(owner, name, stop)
        _, _, told = ran("fit", path, "-o", path.parent / "o", *QUICK, "1", *options)
    told, last = told[:-1].rpartition("\n")[::2]
    assert last == "isa-nrsfm: error: here it is called"
    return *calls[0], told


def times_of(folder, columns, *options, suffix=".csv"):
    """Return the seconds since the first frame, as frames with a label have them."""
    columns = pd.DataFrame(columns).assign(mood=ROWS % 3)
    path = table_beside(folder, columns, suffix)
    found = handed(analysis, "association", path, "--label", "mood", *options)[1]
    times = found["time"] - found["time"][0]
    unit = np.timedelta64(1, "s") if times.dtype.kind == "m" else 1
    return np.round(times / unit, 6)


DAY = 86400.0


def times_in(folder, cells, *options):
    """Return the times of some cells, which are repeated by groups."""
    columns = {"t": np.resize(cells, N), "g": ROWS // len(cells)}
    options = "--time", "t", "--group", "g", *options
    return times_of(folder, columns, *options)[: len(cells)]


def labels_in(folder, columns, name):
    """Return the labels of a table with typed columns."""
    path = table_beside(folder, columns, ".parquet")
    return handed(analysis, "association", path, "--label", name)[1]["y"]


def refused_beside(folder, columns, options):
    """Raise what is told of further columns, as a fit with these options does."""
    told_of_fit(table_beside(folder, columns), " ".join([*QUICK, "1", options]))


def cells_of(cell):
    return {"t": [cell.format(i) for i in range(1, 13)]}


DAYS = [f"{i}/03/2024" for i in range(8, N + 7)]
ZONED = [f"2024-02-01T12:00:{i}Z" for i in range(10, N + 9)]
ROWS = np.arange(N)
FACES = {"face": np.where(ROWS % 2, "right", "left")}


def images_of(folder, columns, options=""):
    """Return the numbers of images that --fps counts, from 0 on."""
    columns = pd.DataFrame(columns, index=ROWS)
    times = times_of(folder, columns, "--fps", 25, *options.split())
    return np.round(25 * times, 6)


def numbers_in(folder, names, n_groups=1):
    """Return the numbers of frames in names of images, from 0 on."""
    names = names.split()
    columns = {"image": np.resize(names, N), "g": ROWS * n_groups // len(names)}
    return list(images_of(folder, columns, "--group g")[: len(names)])


# Names of classes in their order, and words for missing cells
CLASSES = [("007", "7"), ("100000", "1e5"), ("1.1", "1.10"), ("none", "round")]
CLASSES += [("8", "9", "10"), ("123456789012345678901", "123456789012345678902")]
MISSING = ["NULL", "n/a", "", " ", "<NA>", "NA"]


def refuse(*args, **kwargs):
    raise ValueError("too few frames")


def test_labels_are_as_they_are_written(tmp_path, fits, monkeypatch):
    quickly = partial(analysis.association, n_permutations=9)
    monkeypatch.setattr(analysis, "association", quickly)
    monkeypatch.setattr(analysis, "predictability", refuse)
    columns = {f"with {names[0]}": np.resize(names, N) for names in CLASSES}
    options = [f"{name}:classes" if "." in name else name for name in columns]
    expected = [("classes", [*names], 0) for names in CLASSES]
    mood, age = np.resize(["down", "up"], N), 20.5 + ROWS
    columns |= {"mood": [*MISSING, *mood[6:]], "age": [*MISSING, *age[6:]]}
    options += ["mood", "age"]
    expected += [("classes", ["down", "up"], 6), ("number", [], 6)]
    path = table_beside(tmp_path, columns)
    options = [word for name in options for word in ("--label", name)]
    labels = fits(path, *QUICK, "1", *options).report["labels"]
    found = [(e["kind"], [*e.get("classes", ())], e["n_without_label"]) for e in labels]
    assert found == expected


def test_texts_of_tables_are_no_mathematics():
    plt = pytest.importorskip("matplotlib.pyplot")
    from isa_nrsfm.plotting import CoefficientsDisplay

    alpha, y = np.arange(8.0).reshape(4, 2), ["$a_$b", "$a_$b", "c", "c"]
    shown = CoefficientsDisplay(alpha=alpha, y=y).plot()
    shown.figure_.canvas.draw()
    ticks = shown.axes_[-1].get_xticklabels()
    found = [(tick.get_text(), tick.get_parse_math()) for tick in ticks]
    assert found == [("$a_$b", False), ("c", False)]
    plt.close(shown.figure_)


def test_files_of_a_folder_are_in_the_order_of_their_numbers(tmp_path):
    names = [f"frame{i}" for i in (0, 1, 2, 9, 10, 11, 100)] + ["frame100b2", "g"]
    (tmp_path / "parquet").mkdir()
    for i, name in reversed([*enumerate(names, 1)]):
        lines = ["version: 1", "n_points: 8", "{", *[f"{i} {i}"] * 8, "}"]
        files.write_text(tmp_path / "pts" / f"{name}.pts", *lines)
        row = pd.DataFrame(np.full((1, 16), i), columns=POINTS[:16])
        saved(tmp_path / "parquet" / f"{name}.parquet", row)
    found = read_landmarks(tmp_path / "pts")
    assert list(found.frames["file"]) == [f"{name}.pts" for name in names]
    for points in (found.points.to_numpy(), open_table(tmp_path / "parquet")[:]):
        np.testing.assert_array_equal(points[:, 0], 1 + np.arange(len(names)))


def tracks_read(folder, tracks, *options):
    """Read tracks as the command fit does; return points, and what is told."""
    table = pd.DataFrame(tracks.reshape(len(tracks), -1), columns=POINTS)
    path = saved(folder / "table.csv", table)
    (_, X), _, told = handed(AffineNRSfM, "fit", path, *options)
    told = [line.removeprefix("isa-nrsfm: warning: ") for line in told.splitlines()]
    return X.to_numpy(), told


@pytest.mark.parametrize(("code", "digits"), [(-1.0, 0), (0.0, 3)])
def test_codes_of_missing_points_cause_a_warning(tmp_path, code, digits):
    tracks = landmarks(200).to_numpy().reshape(200, -1, 2)
    tracks = (500 + 40 * tracks).round(digits)
    assert tracks_read(tmp_path, tracks)[1] == []
    hidden = np.random.default_rng(0).random(tracks.shape[:2]) < 0.1
    hidden[:, :8] = False  # these are seen in all rows
    tracks[hidden] = code
    n_rows, n_points = hidden.any(axis=1).sum(), hidden.sum()
    points, (warning,) = tracks_read(tmp_path, tracks)
    if not code:  # far from all other points, which are not
        told = f"{n_points:,} points at (0, 0), in {n_rows} rows, are missing: "
        assert warning.startswith(told)
        np.testing.assert_array_equal(np.isnan(points[:, ::2]), hidden)
        nearer = tracks - [480, 0] * ~hidden[..., None]
        assert len(tracks_read(tmp_path, nearer)[1]) == 1
        return
    np.testing.assert_array_equal(points.reshape(tracks.shape), tracks)
    shown = f"in {n_rows} of 200 rows points are at exactly ({code:g}, {code:g})"
    assert warning.startswith(f"{shown} ({n_points} in all)")
    expected = np.where(hidden[..., None], np.nan, tracks).reshape(200, -1)
    option = re.search(r"with (--missing-value)[ =](\S+)", warning).groups()
    points, told = tracks_read(tmp_path, tracks, "=".join(option))
    np.testing.assert_array_equal(points, expected)
    assert told == []


def test_pixels_of_a_face_that_hardly_moves_are_no_code(tmp_path):
    """Whole pixels repeat in many rows, also those with equal coordinates."""
    shape = np.stack([np.arange(300, 324, 2)] * 2, axis=1) + [[0, 0], [9, 0]] * 6
    noise = np.random.default_rng(0).normal(size=(600, 12, 2))
    tracks = np.round(shape + noise)
    assert (tracks[:, 0] == 300).all(axis=1).mean() > 0.1
    assert tracks_read(tmp_path, tracks)[1] == []


def test_several_codes_are_missing_together(tmp_path):
    tracks = landmarks().to_numpy().reshape(N, -1, 2) + 50
    tracks[3, 2], tracks[4, 5], tracks[5, 1] = -1, 999, [-1, 3]
    options = "--missing-value -1 --missing-value 999".split()
    points, _ = tracks_read(tmp_path, tracks, *options)
    tracks[3, 2] = tracks[4, 5] = np.nan
    np.testing.assert_array_equal(points.reshape(tracks.shape), tracks)
    table = pd.DataFrame([[-1, -1, -1, 4.0] * 4], columns=POINTS[:16])
    found = landmark_table(table, missing=-1)
    assert found.points.isna().to_numpy().tolist() == [[True, True, False, False] * 4]


@pytest.mark.slow
@pytest.mark.parametrize("name", ["cameras.csv", "report.json", "basis_shapes.png"])
def test_files_of_other_programs_are_not_replaced(tmp_path, succeeds, fails, name):
    path, text = saved(tmp_path / "a.csv", landmarks()), '{"sha256": {}, "mine": [1]}'
    notes = files.write_text(tmp_path / "o" / "notes.txt", "mine")
    theirs = files.write_text(tmp_path / "o" / name, text)
    argv = ["fit", path, "-o", tmp_path / "o", *QUICK, "1"]
    if name.endswith("png"):
        argv.remove("--no-figures")
    told = f"would be replaced: .*/{name}. Choose another --output, or .* --force"
    assert re.search(told, fails(*argv))
    assert {*notes.parent.iterdir()} == {notes, theirs}
    assert theirs.read_text() == f"{text}\n"
    for options in (["--force"], []):
        succeeds(*argv, *options)
        assert theirs.read_text(errors="replace") != f"{text}\n"
    assert notes.read_text() == "mine\n"


def named_as_others(estimator, **further):
    """Return what is told of a table with columns that are no points."""
    table = pd.concat([pd.DataFrame(further, index=ROWS), landmarks()], axis=1)
    told = str(refused(".*landmark_table", estimator.fit, table))
    columns = [tuple(f"DLC {name}".split()) for name in table]
    levels = table.set_axis(pd.MultiIndex.from_tuples(columns), axis=1)
    first = next(iter(further))
    refused(f"DLC_{first}'.* Give only the columns of points: ", estimator.fit, levels)
    refused(re.escape(told), estimator.fit(landmarks().to_numpy()).transform, table)
    return told


LIKELIHOODS = {f"likelihood{j}": 1.0 for j in range(12)}
DEPTHS = {f"z{j}": 1.0 for j in range(12)}
TEXTS = landmarks().set_axis([f"c{j}" for j in range(24)], axis=1)
TEXTS = TEXTS.assign(c24="Ann", c25="Bob")
QUICKLY = {"n_components": 1, "isa": FastISA(n_init=1), "random_state": 0}
PAPER, BASELINE = AffineNRSfM(**QUICKLY, refinement=None), PseudoInverseNRSfM(1)


def test_frames_without_a_face_are_left_out_of_tables_of_texts(tmp_path):
    success = np.minimum(np.arange(12) % 3, 1)
    path = files.write_openface(tmp_path / "a.csv", scene(), success=success)
    others = {"subject": "007", "age": 30, "mood": "NA"}
    table = pd.read_csv(path).copy().assign(**others).astype(str)
    path = saved(path.with_suffix(".parquet"), table)
    found = read_landmarks(path)
    assert found.format == "openface"
    np.testing.assert_array_equal(found.failed, np.arange(12) % 3 == 0)
    assert set(found.frames["subject"]) == {"007"}
    assert set(found.frames["age"]) == {30}


def test_skeletons_are_read_in_bounded_time(tmp_path):
    """Each key is merged nine times into the next one: 9^12 in all."""
    lines = ["a0: &a0 {x: 1}"]
    for i in range(1, 13):
        lines.append(f"a{i}: &a{i} {{<<: [{', '.join([f'*a{i - 1}'] * 9)}]}}")
    lines += ["skeleton:", "- - NO", "  - 1", "- [1, x, NO]"]
    path = files.write_text(tmp_path / "config.yaml", *lines)
    found = read_skeleton(path, ["NO", "1", "x"])
    assert found.name == "config.yaml"
    assert found.edges.tolist() == [[0, 1], [1, 2], [2, 0]]


WIDE = landmarks(2).round(1)
TEXT = WIDE.to_csv(index=False)
PACKED = gzip.compress(TEXT.encode())


def followed(call, given, /, **scope):
    """Do what an error advises in pandas; return the names that are set."""
    told = str(refused("In pandas: ", call, given))
    for line in told.partition("In pandas: ")[2].split(", and "):
        exec(line, scope)
    return scope


PAIRS = pd.MultiIndex.from_product([[f"p{j}" for j in range(12)], ["x", "y"]])
LEVELS = WIDE.set_axis(PAIRS, axis=1)


def read_as_advised(folder, text):
    """Return the points of a table, after what an error advises in pandas."""
    (path := folder / "a.csv").write_text(text)
    new = folder / "new.csv"
    with contextlib.chdir(folder), warnings.catch_warnings(action="ignore"):
        scope = followed(read_table, path.name, pd=pd)  # also of semicolons
    if not new.exists():
        scope["table"].to_csv(new, index=False)
    return read_landmarks(new).points.to_numpy()


@pytest.mark.filterwarnings("ignore:the cells of")
def test_tables_with_other_separators_are_read(tmp_path):
    path = tmp_path / "a.csv"
    files.write_deeplabcut(path, files.deeplabcut_frame(scene()))
    expected = read_landmarks(path).points
    path.write_text(path.read_text().replace(",", ";").replace(".", ","))
    found = warned("numbers have decimal commas", read_landmarks, path).points
    np.testing.assert_array_equal(found, expected)
    names = [f"{name[0]}, {name[1:]}" for name in WIDE]
    WIDE.set_axis(names, axis=1).to_csv(path, sep=";", decimal=",", index=False)
    assert list(read_table(path)) == names
    for name, sign in (("a.csv", "\t"), ("a.csv", "|"), ("a.csv", ";"), ("a.tsv", ",")):
        WIDE.to_csv(tmp_path / name, sep=sign, index=False)
        told = re.escape(f"{name} end with {sign!r}")
        found = warned(told, read_landmarks, tmp_path / name)
        np.testing.assert_array_equal(found.points, WIDE)


@pytest.mark.parametrize("decimal", [",", "."])
@pytest.mark.filterwarnings("ignore:(the cells of|numbers have)")
def test_other_columns_of_tables_with_other_separators(tmp_path, decimal):
    columns = {"age": ROWS % 7 + 0.5, "t": 0.04 * ROWS}
    path = table_beside(tmp_path, columns, sep=";", decimal=decimal)
    options = "--label", "age", "--time", "t"
    (_,), found, _ = handed(analysis, "association", path, *options)
    np.testing.assert_array_equal(found["y"], columns["age"])
    np.testing.assert_array_equal(found["time"], columns["t"])


def pattern_told(name):
    """Return the pattern that an error tells, which is right."""
    points = enumerate("abcdefghijkl")
    names = [name.format(a=a, j=j, letter=letter) for j, letter in points for a in "xy"]
    table = WIDE.set_axis(names, axis=1)
    told = str(refused("give columns, such as", landmark_table, table))
    pattern = told.rpartition("such as ")[2].strip('"' if told[-1] == '"' else "'")
    found = landmark_table(table, columns=pattern).points
    np.testing.assert_array_equal(found, WIDE)
    return pattern


WORDS = ["NaN", "NAN", "Na", "#N/A", "<NA>", "-nan", "-nan(ind)", "None", '""']
HOLED = WIDE.copy()
HOLED.iloc[1, : len(WORDS)] = np.nan
HOLES = HOLED.to_csv(index=False, na_rep="{}").format(*WORDS)


def skeletons(text):
    """Return a configuration with lists of bodyparts."""
    return f"Task: a\nskeleton: {text}\n"


test_refusals = refusals_of("tables_of_people", globals())
