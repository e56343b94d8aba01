"""The report of a fit: text, page, labels, groups, times and the choice of K."""

import json
import re
from argparse import Namespace
from html.parser import HTMLParser
from pathlib import Path

import numpy as np
import pytest

pd = pytest.importorskip("pandas")
pytest.importorskip("matplotlib")

from fit_runs import MODEL  # noqa: E402

from isa_nrsfm import AffineNRSfM, FastISA  # noqa: E402
from isa_nrsfm.analysis import WithinGroups, association, between_share  # noqa: E402
from isa_nrsfm.cli import main  # noqa: E402
from isa_nrsfm.cli._columns import Columns, Label  # noqa: E402
from isa_nrsfm.cli._figures import Fit, figures_of  # noqa: E402
from isa_nrsfm.cli._fit import choice_report, choose_n_components, extrapolated  # noqa: E402
from isa_nrsfm.cli._sections import fit_sections, fit_text, text_of  # noqa: E402
from isa_nrsfm.cli._times import read_times, time_unit  # noqa: E402
from isa_nrsfm.datasets import make_nonrigid_tracks  # noqa: E402
from isa_nrsfm.export import frame_poses  # noqa: E402
from isa_nrsfm.io import load_model  # noqa: E402
from isa_nrsfm.plotting import ComponentChoiceDisplay  # noqa: E402

N = 120
HOSTILE = '<script>alert("x")</script>&"{{content}}'
EXPECTED = Path(__file__).with_name("expected") / "report.txt"


def table_of(seed=0):
    """Return a table of a thing that waves, with other columns."""
    phase = 0.12 * np.arange(N)
    alpha = np.stack([np.sin(phase), np.cos(0.6 * phase)], axis=1)
    made = {"n_frames": N, "n_points": 14, "n_components": 2}
    scene = make_nonrigid_tracks(**made, noise=0.0, random_state=seed)
    shapes = scene.mean_shape + np.einsum("ik,kjc->ijc", alpha, scene.basis)
    tracks = shapes @ scene.motion.swapaxes(1, 2)
    rng = np.random.default_rng(seed)
    tracks += 0.05 * tracks.std() * rng.normal(size=tracks.shape)
    names = [f"{c}{j}" for j in range(14) for c in "xy"]
    table = pd.DataFrame(tracks.reshape(N, -1), columns=names)
    table["mood"] = np.where(alpha[:, 0] > 0, "up", "down")
    table["age"] = 20.5 + alpha[:, 1] + 0.01 * rng.normal(size=N)
    table["person"] = np.repeat(["Ann", "Bob", "Cid"], N // 3)
    table["seconds"] = np.arange(N) / 25
    table["same"] = 1
    table[HOSTILE] = np.where(np.arange(N) % 2, HOSTILE, "plain")
    return table


@pytest.fixture(scope="module")
def run(tmp_path_factory):
    """Return the folder of a run with labels, groups and times, and its table."""
    folder = tmp_path_factory.mktemp("answers")
    table = table_of()
    table.loc[5, "mood"] = None
    table.to_csv(folder / "table.csv", index=False)
    arguments = ["fit", str(folder / "table.csv"), "-k", "2", "--group", "person"]
    for label in ("mood", "age:number", HOSTILE):
        arguments += ["--label", label]
    assert main([*arguments, "--time", "seconds", "-o", str(folder / "out")]) == 0
    return folder / "out", table


class Page(HTMLParser):
    """Tags, texts and images of a page."""

    def __init__(self, source):
        super().__init__()
        self.tags, self.texts, self.images = [], [], []
        self.feed(source)

    def handle_starttag(self, tag, attributes):
        self.tags.append(tag)
        if tag == "img":
            self.images.append(dict(attributes))

    def handle_data(self, data):
        self.texts.append(data)


def report_of(folder):
    return json.loads((folder / "report.json").read_text())


def test_the_text_is_as_expected(run):
    """Numbers and lines are left out: they differ between machines."""
    folder, _ = run
    text = fit_text(report_of(folder), folder).replace(str(folder.parent), "")
    text = re.sub(r"\n {11}", " ", re.sub(r"[+-]?\d+(\.\d+)?(e-\d+)?", "#", text))
    expected = EXPECTED.read_text(encoding="utf-8")
    assert re.sub(" +", " ", f"{text}\n") == expected


def test_layouts_of_as_many_points_are_listed(run):
    report = report_of(run[0])
    for n_points, listed in ((14, "LAYOUT. If"), (21, r"LAYOUT \(of 21 .*: hand-21\)")):
        report["table"]["n_points"] = n_points
        assert re.search(listed, " ".join(map(str, fit_sections(report)["Fit"])))


def test_the_arguments_repeat_the_run(run, tmp_path):
    folder, _ = run
    report = report_of(folder)
    arguments = report["arguments"]
    assert arguments[:2] == ["fit", report["table"]["path"]]
    arguments[arguments.index("-o") + 1] = str(tmp_path / "again")
    assert main([*arguments, "--no-figures"]) == 0
    digests = report_of(tmp_path / "again")["sha256"]
    same = {name for name in digests if digests[name] == report["sha256"][name]}
    assert {*digests} - same == {"report.html"}


def test_the_page_has_the_text_the_figures_and_nothing_else(run):
    folder, _ = run
    report = report_of(folder)
    source = (folder / "report.html").read_text(encoding="utf-8")
    page = Page(source)
    # Texts of the table stay text.
    assert "script" not in page.tags
    text = "".join(page.texts)
    assert HOSTILE in text
    for parts in fit_sections(report).values():
        for part in parts:
            rows = [[part]] if isinstance(part, str) else [[part.title], *part.rows]
            assert all(cell in text for row in rows for cell in row)
    assert all(warning[1:] in text for warning in report["warnings"])
    assert "isa-nrsfm fit" in text
    figures = [name for name in report["files"] if name.endswith(".png")]
    assert len(page.images) == len(figures) == 9
    assert all(image["alt"] for image in page.images)
    assert not re.search(r"(src|href)=\"(?!data:)", source)
    assert "default-src 'none'" in source
    for name in figures:
        assert (folder / name).read_bytes().startswith(b"\x89PNG")


def test_labels_groups_and_times_are_those_of_python(run):
    folder, table = run
    model, report = load_model(folder / MODEL), report_of(folder)
    mood, age, _ = report["labels"]
    known = table["mood"].notna()
    columns = (table[name][known] for name in ("mood", "person"))
    options = {"time": table["seconds"][known], "random_state": 0}
    expected = association(model.alpha_[known], *columns, **options)
    np.testing.assert_allclose(mood["values"], expected.statistic)
    np.testing.assert_allclose(mood["p_values"], expected.p_value)
    assert mood["permuted"] == expected.permuted
    assert mood["n_without_label"] == 1
    assert mood["classes"] == {"down": (table["mood"] == "down").sum(), "up": 66}
    assert mood["cross_validated"] > 0.9
    standard = (model.alpha_ - model.alpha_.mean(axis=0)) / model.alpha_.std(axis=0)
    for name in ("up", "down"):
        means = standard[table["mood"] == name].mean(axis=0)
        np.testing.assert_allclose(mood["class_means"][name], means, atol=1e-9)
    assert age["statistic"] == "spearman"
    assert "class_means" not in age
    assert max(np.abs(age["values"])) > 0.9
    assert age["cross_validated"] > 0.8 > age["cross_validated_pca"]

    alpha, person = pd.read_csv(folder / "alpha.csv"), table["person"]
    within = WithinGroups().fit_transform(model.alpha_, groups=person)
    X = table[[name for name in table if re.fullmatch(r"[xy]\d+", name)]]
    smooth = model.smooth(X, time=table["seconds"], groups=person)
    for suffix, values in (("within", within), ("smooth", smooth.alpha)):
        columns = [f"alpha_1_{suffix}", f"alpha_2_{suffix}"]
        np.testing.assert_allclose(alpha[columns], values, atol=1e-9)
    cameras = pd.read_csv(folder / "cameras.csv")
    poses = frame_poses(model, smooth.decomposition)
    np.testing.assert_allclose(cameras["yaw_smooth"], poses.yaw, atol=1e-6)
    between = between_share(model.alpha_, person).between
    np.testing.assert_allclose(report["groups"]["between"], between)
    assert len(report["time"]["time_scales"]) == 2


def test_means_of_classes_are_of_significant_coefficients(run):
    report = report_of(run[0])
    mood = report["labels"][0]
    k = int(np.argmax(mood["values"]))
    assert mood["p_values"][k] < 0.05
    means = {name: mean[k] for name, mean in mood["class_means"].items()}
    order = sorted(means, key=lambda name: -abs(means[name]))
    shown = ", ".join(f"{name} {means[name]:+.1f}" for name in order)
    line = f"alpha_{k + 1}: {shown}."
    assert line in fit_sections(report)["Labels"]
    mood["p_values"][k] = 0.2
    assert line not in fit_sections(report)["Labels"]


@pytest.mark.parametrize("n_classes", [12, 13])
def test_means_of_twelve_classes_are_listed(run, n_classes):
    report = report_of(run[0])
    mood = report["labels"][0]
    mood["class_means"] = {f"class{i}": [1.0, 1.0] for i in range(n_classes)}
    mood["p_values"] = [0.01, 1.0]
    (line,) = (each for each in fit_sections(report)["Labels"] if "class0" in each)
    assert line.count("+1.0") == 12
    assert line.endswith("(all in report.json).") == (n_classes == 13)


def figure_of(run, name):
    """Draw a figure of the run."""
    folder, table = run
    X = table[[name for name in table if re.fullmatch(r"[xy]\d+", name)]]
    known = table["mood"].notna().to_numpy()
    mood = Label("mood", "classes", table["mood"][known].to_numpy(str), known)
    asked = Columns([mood], None, None, "seconds", [], None)
    drawn = {"edges": None, "origin": "auto"}
    fit = Fit(load_model(folder / MODEL), X, None, None, drawn)
    return figures_of(Namespace(n_components=[2]), asked)[name][1](fit)


def test_figures_show_twelve_basis_shapes():
    X = make_nonrigid_tracks(60, 45, 13, noise=0.01, random_state=0).data
    columns = [f"{axis}{j}" for j in range(45) for axis in "xy"]
    X = pd.DataFrame(X, columns=columns)
    model = AffineNRSfM(
        13, refinement="alternating", isa=FastISA(n_init=1), random_state=0
    ).fit(X)
    mood = Label("mood", "classes", np.resize(["a", "b"], 60), np.ones(60, bool))
    asked = Columns([mood], None, np.arange(60.0), "seconds", [], None)
    fit = Fit(model, X, None, None, {"edges": None, "origin": "auto"})
    figures = figures_of(Namespace(n_components=[13]), asked)
    shapes = figures["basis_shapes.png"][1](fit)
    np.testing.assert_array_equal(shapes.components_, np.arange(12))
    for name in ("label_1.png", "time.png"):
        assert len(figures[name][1](fit).axes_) == 12


def test_shapes_of_classes_have_a_legend(run):
    (legend,) = figure_of(run, "label_1_shapes.png").figure_.legends
    texts = [text.get_text() for text in legend.get_texts()]
    assert texts == ["mean of all frames", "mean of the class"]


def test_frames_of_median_and_largest_residual_are_drawn(run):
    folder, _ = run
    display = figure_of(run, "reprojection.png")
    order = np.argsort(pd.read_csv(folder / "cameras.csv")["inverse_snr"])
    rows = [*order[58:61], *order[:-4:-1]]
    assert list(display.frames) == rows
    for k, axes in enumerate(display.axes_):
        title = f"{'median' if k < 3 else 'largest'} residual: frame {rows[k]}\n"
        assert axes.get_title().startswith(title)


def test_a_later_run_removes_figures_of_labels(tmp_path, capsys):
    table_of().to_csv(tmp_path / "table.csv", index=False)
    arguments = ["fit", str(tmp_path / "table.csv"), "-k", "1", "-o", str(tmp_path)]
    assert main([*arguments, "--label", "mood", "--fps", "25"]) == 0
    assert "Time       seconds: " in capsys.readouterr().out
    assert (tmp_path / "label_1.png").exists()
    assert main([*arguments, "--no-figures", "--refinement", "none"]) == 0
    assert not (tmp_path / "label_1.png").exists()
    assert "labels" not in report_of(tmp_path)


@pytest.mark.parametrize(
    ("scales", "expected"),
    [
        ([np.inf, np.inf, 8.24], "within 8.24 s; changes last in 2 of 3 directions"),
        ([8.24, 3.0], "fade within 8.24, 3 s"),
        ([np.inf], "t: changes last in 1 of 1 directions"),
        ([], "no dynamics found"),
    ],
)
def test_times_of_change(run, scales, expected):
    time = {"column": "t", "time_scales": scales, "changed_by": 0.1, "unit": "s"}
    title = fit_sections(report_of(run[0]) | {"time": time})["Time"][0]
    assert expected in title


@pytest.mark.parametrize(
    ("name", "cells", "unit"),
    [
        ("frame", [1, 2], "frames"),
        ("Frame_nr", ["1", "2"], "frames"),
        ("day", [1.5, 2.0], "in the unit of the column day"),
        ("time", ["0:58.2", "1:00"], "seconds"),
        ("frame", ["2024-01-01", "2024-01-02"], "seconds"),
        ("time", pd.to_timedelta([1, 2], unit="s"), "seconds"),
    ],
)
def test_the_unit_of_times_is_that_of_the_column(name, cells, unit):
    column = pd.Series(cells, name=name)
    assert time_unit(column, read_times(column, None)) == unit


@pytest.mark.parametrize(
    ("options", "message"),
    [
        (["--label", "smile"], "--label: the table has no column 'smile'; its columns"),
        (["--label", "same"], "--label same: all 120 labels are 1: there is nothing"),
        (["--label", "seconds:classes"], "--label seconds:classes: the 120 labels are"),
        (["--label", "mood:number"], "labels must be numbers; got"),
        (["--label", "far"], "--label far must be finite; 1 of 120 .* in row 7: "),
        (["--label", "none"], "--label: no frame has a 'none'"),
        (["--group", "gaps"], "--group: 3 of 120 frames have no 'gaps'"),
        (
            ["--time", "mood"],
            "--time mood: expected numbers or dates, .*; 120 of 120 are",
        ),
        (
            ["--time", "same"],
            "--time same: times must increase .* row 1 has 1 after 1 of",
        ),
        (["--time", "gaps"], "--time gaps: time must be known .* missing in 3 of 120"),
        (["--distance", "3,99"], "--distance 3,99: there is no point '99'; the 14"),
        (["--distance", "3,3"], "--distance 3,3: expected two different points"),
        (["--unit", "3,4"], "--unit needs --distance"),
        (
            ["--distance", "3,5"],
            "--distance needs --unit: the 14 points are not the 68 .* --unit 0,1",
        ),
    ],
)
def test_columns_are_refused_before_the_fit(tmp_path, capsys, options, message):
    table = table_of()
    table["none"] = None
    table["gaps"] = np.arange(N, dtype=float)
    table.loc[[3, 4, 9], "gaps"] = np.nan
    table["far"] = np.where(np.arange(N) == 7, np.inf, table["age"])
    table.to_csv(tmp_path / "table.csv", index=False)
    arguments = ["fit", str(tmp_path / "table.csv"), "-o", str(tmp_path / "out")]
    assert main([*arguments, *options]) == 1
    error = capsys.readouterr().err
    assert re.search(message, error), error
    assert not (tmp_path / "out").exists()


def test_groups_are_held_out_together(tmp_path, capsys):
    table_of().to_csv(tmp_path / "table.csv", index=False)
    arguments = ["fit", str(tmp_path / "table.csv"), "-k", "1,2", "--no-figures"]
    arguments += ["--refinement", "none", "--isa", "fast", "--n-init", "1"]
    assert main([*arguments, "--group", "person", "-o", str(tmp_path / "out")]) == 0
    parts = report_of(tmp_path / "out")["choice"]["held_out_error_of_parts"]
    assert np.shape(parts) == (2, 3)
    assert main([*arguments, "--group", "same", "-o", str(tmp_path / "none")]) == 1
    assert "needs two groups; got 1" in capsys.readouterr().err


X = pd.DataFrame(make_nonrigid_tracks(48, 20, 2, noise=0.01, random_state=0).data)
ESTIMATOR = AffineNRSfM(isa=FastISA(n_init=6), refinement=None, random_state=0)


@pytest.mark.filterwarnings("ignore::sklearn.exceptions.ConvergenceWarning")
def test_the_choice_is_that_of_the_search(capsys):
    search = choose_n_components(ESTIMATOR, X, [1, 2, 3])
    shown = capsys.readouterr()
    assert (shown.out, len(shown.err.splitlines())) == ("", 3)
    report = choice_report(search, X)
    assert report["n_components"] == [1, 2, 3]
    parts = report["held_out_error_of_parts"]
    assert parts.shape == (3, 3)
    np.testing.assert_allclose(report["held_out_error"], parts.mean(axis=1))
    error = report["held_out_error_standard_error"]
    np.testing.assert_allclose(error, parts.std(axis=1, ddof=1) / np.sqrt(3))
    # As in the figure.
    figure = ComponentChoiceDisplay.from_estimator(search)
    (bars,) = figure.errorbar_.lines[2]
    ends = np.array([bar[:, 1] for bar in bars.get_segments()])
    np.testing.assert_allclose(np.diff(ends)[:, 0], 200 * error)
    best = 1 + int(np.argmin(parts.mean(axis=1)))
    assert report["chosen"] == search.n_components_ == best
    assert (report["seconds"] > 0).all()


@pytest.mark.slow
@pytest.mark.filterwarnings("ignore::sklearn.exceptions.ConvergenceWarning")
def test_the_next_numbers_are_those_that_the_table_allows():
    search = choose_n_components(ESTIMATOR, X, [1, 2])
    assert search.n_components_ == 2
    following = choice_report(search, X)["next"]
    assert following["n_components"] == [3, 4, 5]  # 20 points allow no more
    assert following["seconds"] > 0
    few = X.iloc[:, :28]
    search = choose_n_components(ESTIMATOR, few, [3])
    assert "next" not in choice_report(search, few)  # 14 points allow three


@pytest.mark.parametrize(
    ("errors", "chosen", "expected"),
    [
        ([1.23, 0.05], 2, "larger K may be better"),
        ([0.05, 1.23], 1, "the least\n"),
        ([1.2, 1.1], 2, "no number of basis shapes predicts held-out points"),
    ],
)
def test_the_choice_in_words(run, errors, chosen, expected):
    choice = {
        "n_components": [1, 2],
        "held_out_error": errors,
        "held_out_error_standard_error": [0.12, 0.003],
        "chosen": chosen,
        "next": {"n_components": [3, 4, 5], "seconds": 10.0},
    }
    section = fit_sections(report_of(run[0]) | {"choice": choice})["Choice"]
    text = text_of("", {"Choice": section})
    assert expected in text
    assert ("K = 3-5 would take about 10 s more" in text) == (min(errors) < 1)
    assert ("errors in frames held out of the fit" in text) == (min(errors) < 1)
    assert "%" in text
    assert ". %" not in text


def test_seconds_are_extrapolated_along_a_line():
    tried = np.array([1, 2, 3, 4])
    # The first one, which searches for starts, does not count.
    seconds = np.array([9.0, 1.0, 1.5, 2.0])
    for arguments, expected in (
        ((tried, seconds, np.array([5, 6])), [2.5, 3.0]),
        ((tried, 5.0 - tried, np.array([5])), [1.0]),  # no less for larger numbers
        ((tried[:1], seconds[:1], np.array([2, 3])), [9.0, 9.0]),
    ):
        np.testing.assert_allclose(extrapolated(*arguments), expected)
