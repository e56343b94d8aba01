"""Tables as people write them: CONTRIBUTING lists each way and what happens."""

import contextlib
import gzip
import re
import warnings

import landmark_files as files
import numpy as np
import pandas as pd
import pytest
from fit_runs import fit, write_landmarks
from landmark_files import saved, scene
from refusals import refusals_of, refused, warned
from scenes import table_of
from sklearn.base import clone

from isa_nrsfm import AffineNRSfM, FastISA
from isa_nrsfm.baselines import PseudoInverseNRSfM
from isa_nrsfm.cli._columns import asked_columns
from isa_nrsfm.cli._options import build_parser
from isa_nrsfm.cli._reading import image_numbers, read_frames
from isa_nrsfm.datasets import make_nonrigid_tracks
from isa_nrsfm.io import landmark_table, open_table, read_landmarks, read_table
from isa_nrsfm.skeletons import read_skeleton

N = 24
POINTS = [f"{axis}{j}" for j in range(12) for axis in "xy"]


def landmarks(n_frames=N):
    scene = make_nonrigid_tracks(n_frames, 12, 1, noise=0.01, random_state=0)
    return pd.DataFrame(scene.data, columns=POINTS)


def read_by_fit(path, *options):
    """Read a table as the command fit does, without a fit: options and frames."""
    argv = ["fit", path, "-o", "out", *options]
    args = build_parser().parse_args([str(word) for word in argv])
    return args, read_frames(args)


def asked_in(folder, columns, *options, suffix=".csv", **written):
    """Read a table with some columns as the command fit does, without a fit."""
    columns = pd.DataFrame(columns)
    table = pd.concat([landmarks(len(columns)), columns], axis=1)
    path = saved(folder / f"table{suffix}", table, **written)
    return asked_columns(*read_by_fit(path, *options))


def seconds(times):
    times = np.asarray(times)
    if times.dtype.kind == "M":
        return (times - times[0]) / np.timedelta64(1, "s")
    return times - times[0]


DAY = 86400.0


def times_in(folder, cells):
    """Return the times of some cells, in seconds.

    The time of a column is that of its rows: short ones are repeated by groups.
    """
    n_groups = -(-N // len(cells))
    columns = {"t": cells * n_groups, "g": np.repeat(range(n_groups), len(cells))}
    found = asked_in(folder, columns, "--time", "t", "--group", "g").times
    return [*np.round(seconds(found)[: len(cells)], 6)]


def steps_of(folder, cell, *options):
    """Return the times of twelve cells, in seconds from the first one."""
    cells = {"t": [cell.format(i) for i in range(1, 13)]}
    return seconds(asked_in(folder, cells, *options).times)


DAYS = [f"{i}/03/2024" for i in range(8, N + 7)]
ZONED = [f"2024-02-01T12:00:{i}Z" for i in range(10, N + 9)]
ROWS = np.arange(N)
FACES = {"face": np.where(ROWS % 2, "right", "left")}


def images_of(folder, columns, options):
    """Return the numbers of images that --fps counts."""
    columns = pd.DataFrame(columns, index=ROWS)
    times = asked_in(folder, columns, "--fps", 25, *options).times
    return np.round(25 * seconds(times), 9)


def numbers_in(names):
    """Return the numbers of frames in names of images."""
    return list(image_numbers(pd.DataFrame({"image": names.split()})))


def names_in(folder, *names):
    """Return the classes and groups of a column with these names."""
    options = "--label", "who:classes", "--group", "who"
    found = asked_in(folder, {"who": np.resize(names, N)}, *options)
    assert {*found.labels[0].values} == {*found.groups}
    return sorted({*found.groups})


def classes_in(folder, *cells):
    """Return the classes of a column, in their order."""
    found = asked_in(folder, {"who": np.resize(cells, N)}, "--label", "who")
    return [str(name) for name in found.labels[0].cat.categories]


TYPED = {"day": pd.to_datetime(["2024-02-01", "2024-02-02"] * (N // 2))}
TYPED |= {"mood": ["1", "b"] * (N // 2), "ok": [True, False] * (N // 2)}


def labels_with(folder, word, *options, suffix=".csv"):
    """Return labels of which row 4 has a word for missing."""
    mood, age = np.where(ROWS % 3, "up", "down"), (20.5 + ROWS).astype(str)
    columns = pd.DataFrame({"mood": mood, "age": age}, dtype=object)
    columns.loc[4] = word
    return asked_in(folder, columns, *options, suffix=suffix).labels


def missing_in(folder, word, suffix=".csv"):
    """Return the rows that lack a class and a number."""
    labels = "--label", "mood", "--label", "age"
    mood, age = labels_with(folder, word, *labels, suffix=suffix)
    assert set(mood.dropna()) == {"up", "down"}
    assert age.dtype == float
    return [list(np.flatnonzero(label.isna())) for label in (mood, age)]


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
    for i, name in enumerate(reversed(names)):
        points = np.full((8, 2), float(len(names) - i))
        lines = [
            "version: 1",
            "n_points: 8",
            "{",
            *(f"{x} {y}" for x, y in points),
            "}",
        ]
        files.write_text(tmp_path / "pts" / f"{name}.pts", *lines)
        for kind in ("npy", "parquet"):
            (tmp_path / kind).mkdir(exist_ok=True)
        np.save(tmp_path / "npy" / f"{name}.npy", points.reshape(1, -1))
        table = pd.DataFrame(points.reshape(1, -1), columns=POINTS[:16])
        saved(tmp_path / "parquet" / f"{name}.parquet", table)
    order = 1 + np.arange(len(names))
    found = read_landmarks(tmp_path / "pts")
    assert list(found.frames["file"]) == [f"{name}.pts" for name in names]
    np.testing.assert_array_equal(found.points["x_0"], order)
    for kind in ("npy", "parquet"):
        np.testing.assert_array_equal(open_table(tmp_path / kind)[:][:, 0], order)


def tracks_read(folder, tracks, *options):
    """Read tracks as the command fit does; return points and texts of warnings."""
    table = pd.DataFrame(tracks.reshape(len(tracks), -1), columns=POINTS)
    path = saved(folder / "table.csv", table)
    with warnings.catch_warnings(record=True, action="always") as caught:
        _, frames = read_by_fit(path, *options)
    return frames.points.to_numpy(), [str(each.message) for each in caught]


@pytest.mark.parametrize(("code", "digits"), [(-1.0, 0), (999.0, 3), (0.0, 3)])
def test_codes_of_missing_points_cause_a_warning(tmp_path, code, digits):
    tracks = landmarks(200).to_numpy().reshape(200, -1, 2)
    tracks = (500 + 40 * tracks).round(digits)
    _, texts = tracks_read(tmp_path, tracks)
    assert texts == []
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
    warned(re.escape(warning.partition(" If")[0]), PAPER.fit, points)
    expected = np.where(hidden[..., None], np.nan, tracks).reshape(200, -1)
    table = pd.DataFrame(points, columns=POINTS)
    found = landmark_table(table, missing=code).points
    np.testing.assert_array_equal(np.isnan(found), np.isnan(expected))
    number = re.search(r"with missing=(\S+)", warning)[1]
    points, texts = tracks_read(tmp_path, tracks, f"--missing-value={number}")
    np.testing.assert_array_equal(points, expected)
    assert texts == []


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
def test_files_of_other_programs_are_not_replaced(tmp_path, capsys):
    path, folder = tmp_path / "table.csv", tmp_path / "out"
    write_landmarks(path)
    files.write_text(folder / "notes.txt", "mine")
    assert fit(path, folder, 0, "--no-figures") == 0  # other names are no matter
    assert fit(path, folder, 0) == 0  # figures are new
    assert (folder / "notes.txt").read_text() == "mine\n"
    for name in ("cameras.csv", "report.html", "report.json", "basis_shapes.png"):
        capsys.readouterr()
        other = tmp_path / f"of {name}"
        files.write_text(other / name, text := '{"sha256": {}, "mine": [1]}')
        options = [] if name.endswith("png") else ["--no-figures"]
        assert fit(path, other, 0, *options) == 1
        told = f"would be replaced: .*/{name}. Choose another --output, or .* --force"
        assert re.search(told, capsys.readouterr().err)
        assert [file.name for file in other.iterdir()] == [name]
        assert (other / name).read_text() == f"{text}\n"
        assert fit(path, other, 0, *options, "--force") == 0
        assert fit(path, other, 0, *options) == 0


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


@pytest.mark.parametrize("estimator", [PAPER, BASELINE])
@pytest.mark.parametrize("layout", ["interleaved", "planar"])
def test_the_error_of_tracks_makes_them_a_table(estimator, layout):
    tracks = landmarks().to_numpy().reshape(N, 12, 2)
    estimator = clone(estimator).set_params(layout=layout)
    for X in (tracks, tracks.swapaxes(1, 2)):
        told = str(refused(r"reshape\(len\(X\), -1\)", estimator.fit, X))
        way = told.rpartition("give ")[2]
        table = eval(way, {"X": X, "np": np})
        np.testing.assert_array_equal(table, table_of(tracks, layout))
    for X in (tracks[None], np.zeros((30, 12, 5))):
        refused(r"one row per frame .* got the shape .*\)$", estimator.fit, X)


@pytest.mark.parametrize(
    ("suffix", "typed"), [(".csv", True), (".parquet", True), (".parquet", False)]
)
def test_frames_without_a_face_are_left_out_of_each_kind_of_file(
    tmp_path, suffix, typed
):
    success = np.minimum(np.arange(12) % 3, 1)
    path = files.write_openface(tmp_path / "a.csv", scene(), success=success)
    others = {"subject": "007", "age": 30, "mood": "NA"}
    table = pd.read_csv(path).copy().assign(**others)
    path = saved(path.with_suffix(suffix), table if typed else table.astype(str))
    found = read_landmarks(path)
    assert found.format == "openface"
    np.testing.assert_array_equal(found.failed, np.arange(12) % 3 == 0)
    assert set(found.frames["subject"]) == {"007"}
    assert set(found.frames["age"]) == {30}
    _, frames = read_by_fit(path)
    assert [each["reason"] for each in frames.left_out] == ["tracking failed"]
    assert len(frames.X) == 8


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
    columns, written = {"age": ROWS % 7 + 0.5, "t": 0.04 * ROWS}, {"decimal": decimal}
    options = "--label", "age", "--time", "t"
    found = asked_in(tmp_path, columns, *options, sep=";", **written)
    np.testing.assert_array_equal(found.labels[0], columns["age"])
    np.testing.assert_array_equal(found.times, columns["t"])


def test_the_way_from_several_levels_of_names_is_right():
    table = followed(landmark_table, LEVELS, table=LEVELS.copy())["table"]
    np.testing.assert_array_equal(landmark_table(table).points, WIDE)


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


HOLED = WIDE.copy()
HOLED.iloc[1, 4:6] = np.nan


def with_word(word):
    """Return the text of a table with a word for missing numbers."""
    return HOLED.to_csv(index=False, na_rep="@").replace("@", word)


def skeletons(text):
    """Return a configuration with lists of bodyparts."""
    return f"Task: a\nskeleton: {text}\n"


test_refusals = refusals_of("tables_of_people", globals())
