"""The report of a fit: text, page, labels, groups, times and the choice of K."""

import contextlib
import re
from html import unescape
from pathlib import Path

import numpy as np
import pandas as pd
import pytest
from fit_runs import Results, ran
from landmark_files import saved, saved_scene
from layers import slow_after
from matplotlib.figure import Figure
from refusals import refusals_of
from scenes import waving_scene
from sklearn.model_selection import GroupKFold

from isa_nrsfm import AffineNRSfM, AffineNRSfMCV, FastISA
from isa_nrsfm.analysis import WithinGroups, association, between_share
from isa_nrsfm.cli import main
from isa_nrsfm.cli._reading import read_times  # noqa: F401  in refusals.txt
from isa_nrsfm.cli._report import fit_sections, summary
from isa_nrsfm.datasets import make_nonrigid_tracks
from isa_nrsfm.export import frame_poses

N = 120
HOSTILE = '<script>alert("x")</script>&"{{content}}$0_$50k'
EXPECTED = Path(__file__).with_name("expected") / "report.txt"


def table_of(seed=0):
    """Return a table of a thing that waves, with other columns."""
    scene, alpha = waving_scene(N, 14, [0.12, 0.072], seed)
    tracks, rng = scene.tracks, np.random.default_rng(seed)
    tracks += 0.05 * tracks.std() * rng.normal(size=tracks.shape)
    names = [f"{c}{j}" for j in range(14) for c in "xy"]
    others = {
        "mood": np.where(alpha[:, 0] > 0, "up", "down"),
        "age": 20.5 + alpha[:, 1] + 0.01 * rng.normal(size=N),
        "person": np.repeat(["Ann", "Bob", "Cid"], N // 3),
        "seconds": np.arange(N) / 25,
        "same": 1,
        HOSTILE: np.where(np.arange(N) % 2, HOSTILE, "plain"),
    }
    return pd.DataFrame(tracks.reshape(N, -1), columns=names).assign(**others)


def points_of(table):
    return table.filter(regex=r"^[xy]\d+$")


@contextlib.contextmanager
def drawn():
    """Keep the figures that are saved within."""
    figures, save = [], Figure.savefig

    def keep(self, *args, **keywords):
        figures.append(self)
        return save(self, *args, **keywords)

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(Figure, "savefig", keep)
        yield figures


@pytest.fixture(scope="module")
def answers(tmp_path_factory):
    """Return results of a run with labels, groups and times, its table and figures."""
    folder, table = tmp_path_factory.mktemp("answers"), table_of()
    table.loc[5, "mood"] = None
    path = saved(folder / "table.csv", table)
    options = ["-k", 2, "--group", "person", "--time", "seconds", "--label", "mood"]
    options += ["--label", "age:number", "--label", HOSTILE]
    with drawn() as figures:
        code, out, err = ran("fit", path, "-o", folder / "out", *options)
    assert code == 0, err
    results = Results(folder / "out", out)
    names = [name for name in results.report["files"] if name.endswith(".png")]
    return results, table, dict(zip(names, figures, strict=True))


def test_the_text_is_as_expected(answers):
    """Numbers and lines are left out: they differ between machines."""
    found, *_ = answers
    text = found.out.replace(str(found.folder.parent), "")
    text = re.sub(r"\n {9,}", " ", re.sub(r"[+-]?\d+(\.\d+)?(e-\d+)?", "#", text))
    text = re.sub(r"(?<=age goes with )[^(]+", "# ", text)
    assert re.sub(" +", " ", text) == EXPECTED.read_text(encoding="utf-8")


@pytest.mark.slow
def test_the_arguments_repeat_the_run(answers, tmp_path):
    report, runs = answers[0].report, []
    arguments = report["arguments"]
    assert arguments[:2] == ["fit", report["table"]["path"]]
    for name in "ab":
        arguments[arguments.index("-o") + 1] = str(tmp_path / name)
        assert main([*arguments, "--no-figures"]) == 0
        runs.append(Results(tmp_path / name).report["sha256"].items())
    assert {name for name, _ in runs[0] ^ runs[1]} == {"report.html"}


def test_the_page_has_the_text_the_figures_and_nothing_else(answers):
    found, *_ = answers
    folder, report = found.folder, found.report
    source = (folder / "report.html").read_text(encoding="utf-8")
    # Texts of the table stay text.
    assert "<script" not in source
    text = unescape(re.sub("<[^<>]+>", "", source))
    parts = [part for parts in fit_sections(report).values() for part in parts]
    rows = [[part] if isinstance(part, str) else np.ravel(part[1:]) for part in parts]
    warnings = [warning[1:] for warning in report["warnings"]]
    for shown in (HOSTILE, "isa-nrsfm fit", *np.concatenate(rows), *warnings):
        assert shown in text
    figures = [name for name in report["files"] if name.endswith(".png")]
    assert len(re.findall('<img [^>]+ alt="[^"]+"', source)) == len(figures) == 9
    assert source.count("<img") == 9
    links = re.findall(r"(?:src|href)=\"(?!data:)[^\"]+", source)
    assert links == ['href="viewer.html']
    assert "default-src 'none'" in source
    for name in figures:
        assert (folder / name).read_bytes().startswith(b"\x89PNG")


def test_labels_groups_and_times_are_those_of_python(answers):
    found, table, _ = answers
    model, report = found.model, found.report
    mood, age, _ = report["labels"]
    known = table["mood"].notna()
    columns = (table[name][known] for name in ("mood", "person"))
    options = {"time": table["seconds"][known], "random_state": 0}
    expected = association(model.alpha_[known], *columns, **options)
    np.testing.assert_allclose(mood["values"], expected.statistic)
    np.testing.assert_allclose(mood["p_values"], expected.p_value)
    assert (mood["permuted"], mood["n_without_label"]) == (expected.permuted, 1)
    assert mood["classes"] == {"down": (table["mood"] == "down").sum(), "up": 66}
    assert mood["cross_validated"] > 0.9
    standard = (model.alpha_ - model.alpha_.mean(axis=0)) / model.alpha_.std(axis=0)
    for name in ("up", "down"):
        means = standard[table["mood"] == name].mean(axis=0)
        np.testing.assert_allclose(mood["class_means"][name], means, atol=1e-9)
    assert (age["statistic"], "class_means" in age) == ("spearman", False)
    assert max(np.abs(age["values"])) > 0.9
    assert age["cross_validated"] > 0.8 > age["cross_validated_pca"]
    assert 0 < age["cross_validated_standard_error"] < 0.2
    assert age["cross_validated_pca_of_rank_n_features"] == 9

    alpha, person = found.alpha, table["person"]
    within = WithinGroups().fit_transform(model.alpha_, groups=person)
    X = points_of(table)
    smooth = model.smooth(X, time=table["seconds"], groups=person)
    for suffix, values in (("within", within), ("smooth", smooth.alpha)):
        columns = [f"alpha_1_{suffix}", f"alpha_2_{suffix}"]
        np.testing.assert_allclose(alpha[columns], values, atol=1e-9)
    yaw = frame_poses(model, smooth.decomposition).yaw
    np.testing.assert_allclose(found.cameras["yaw_smooth"], yaw, atol=1e-6)
    between = between_share(model.alpha_, person).between
    np.testing.assert_allclose(report["groups"]["between"], between)
    assert len(report["time"]["time_scales"]) == 2


def test_means_of_classes_are_of_significant_coefficients(answers):
    report = answers[0].report
    mood = report["labels"][0]
    k = int(np.argmax(mood["values"]))
    assert mood["p_values"][k] < 0.05
    related = [f"alpha_{i + 1}" for i, p in enumerate(mood["p_values"]) if p < 0.05]
    answer = f"mood goes with {', '.join(related)} (p < 0.05)."
    assert fit_sections(report)["Labels"][0] == answer
    means = {name: mean[k] for name, mean in mood["class_means"].items()}
    order = sorted(means, key=lambda name: -abs(means[name]))
    shown = ", ".join(f"{name} {means[name]:+.1f}" for name in order)
    line = f"alpha_{k + 1}: {shown}."
    assert line in fit_sections(report)["Labels"]
    mood["p_values"][k] = 0.2
    assert line not in fit_sections(report)["Labels"]
    mood |= {"untested": "one event", "p_values": [None] * len(mood["p_values"])}
    assert "mood was not tested: one event." in fit_sections(report)["Labels"]


@pytest.mark.parametrize("n_classes", [12, 13])
def test_means_of_twelve_classes_are_listed(answers, n_classes):
    report = answers[0].report
    mood = report["labels"][0]
    mood["class_means"] = {f"class{i}": [1.0, 1.0] for i in range(n_classes)}
    mood["p_values"] = [0.01, 1.0]
    (line,) = (each for each in fit_sections(report)["Labels"] if "class0" in each)
    assert line.count("+1.0") == 12
    assert line.endswith("(all in report.json).") == (n_classes == 13)


def test_numbers_that_say_nothing_are_left_out(answers):
    model = answers[0].report["model"]
    rows = [row | {"pose_share": None} for row in model["alpha"]]
    report = answers[0].report | {"model": model | {"alpha": rows}}
    assert "pose" not in str(fit_sections(report)["Alpha"])
    assert "pose" not in str(summary(report, "out"))


@pytest.mark.slow
def test_figures_show_twelve_basis_shapes(fits, tmp_path):
    scene = make_nonrigid_tracks(60, 45, 13, noise=0.01, random_state=0)
    path = saved_scene(tmp_path / "table.csv", scene, mood=["a", "b"] * 30)
    options = "-k 13 --refinement none --isa fast --n-init 1 --label mood --fps 1"
    with drawn() as figures:
        fits(path, *options.split())
    label, _, time, shapes, _, _ = figures
    text = " ".join(axes.get_title("left") for axes in shapes.axes)
    assert ("12" in text, "13" in text) == (True, False)
    assert len(label.axes) == len(time.axes) == 12


def test_shapes_of_classes_have_a_legend(answers):
    (legend,) = answers[2]["label_1_shapes.png"].legends
    texts = [text.get_text() for text in legend.get_texts()]
    assert texts[:2] == ["mean of all frames", "mean of the class"]
    assert texts[2:] == ["lines: minimal spanning tree"]


def test_frames_are_drawn_with_their_residuals(answers):
    found, _, figures = answers
    titles = [axes.get_title() for axes in figures["reprojection.png"].axes]
    errors = found.cameras["inverse_snr"]
    assert len(titles) == 6
    for title in titles:
        row, share = re.match(r"row (\d+)\ninverse SNR (.*) %", title).groups()
        assert float(share) == pytest.approx(100 * errors[int(row)], rel=0.1)


CHOICE = {"n_components": [1, 2], "held_out_error": [1.23, 0.05], "chosen": 2}
CHOICE |= {"held_out_error_standard_error": [0.12, 0.003]}
MIRRORED = "the right one of two mirror images with"


@pytest.mark.parametrize(
    ("part", "changed", "expected"),
    [
        ("time", {"time_scales": [8.24, 3.0]}, "of the deformation: 8.24, 3 s"),
        ("time", {"time_scales": []}, "no dynamics found"),
        ("time", {"time_scales": [np.inf]}, "t: changes last in 1 of 1 directions"),
        ("time", {"time_scales": [np.inf, np.inf, 8.24]}, "8.24 s; changes last in 2"),
        ("choice", CHOICE, "K = 1 (123 +- 12 %), 2 (5 +- 0.3 %): 2 is used"),
        ("model", {"mirror_certainty": 0.9979}, f"{MIRRORED} 99.7 %"),
        ("model", {"mirror_certainty": 1.0}, f"{MIRRORED} 99.9 %"),
        ("model", {"mirror_certainty": 1.0}, "missing points are farther away"),
    ],
)
def test_numbers_in_words(answers, part, changed, expected):
    report = answers[0].report
    report["time"] |= {"column": "t", "changed_by": 0.1, "unit": "s"}

    def words():
        return f"{fit_sections(report)} {summary(report, 'out')}"

    assert expected not in words()
    report[part] = report.get(part, {}) | changed
    assert expected in words()


ESTIMATOR = AffineNRSfM(isa=FastISA(n_init=1), refinement=None, random_state=0)
UNREFINED = "--no-figures --refinement none --isa fast --n-init 1".split()


@pytest.mark.parametrize("groups", slow_after(1, [True, False]))
def test_the_choice_is_that_of_the_search(fits, tmp_path, groups):
    table = table_of()[::2]
    options = ["-k", "1-3", *UNREFINED, *["--group", "person"] * groups]
    found = fits(saved(tmp_path / "table.csv", table), *options)
    assert len(found.err.splitlines()) == 3
    parts = {"estimator": ESTIMATOR, "cv": GroupKFold(3) if groups else 3}
    search = AffineNRSfMCV([1, 2, 3], **parts, select="one_standard_error")
    search.fit(points_of(table), groups=table["person"] if groups else None)
    parts = [-search.cv_results_[f"split{i}_test_score"] for i in range(3)]
    report, of_parts = found.report["choice"], np.transpose(parts)
    expected = {"n_components": [1, 2, 3], "held_out_error_of_parts": of_parts}
    errors = of_parts.std(axis=1, ddof=1) / np.sqrt(3)
    expected |= {"held_out_error": of_parts.mean(axis=1)}
    expected |= {"held_out_error_standard_error": errors}
    for name, values in expected.items():
        np.testing.assert_allclose(report[name], values, rtol=1e-6)
    assert report["chosen"] == search.n_components_


def odd_columns():
    """Return the text of a table whose other columns cannot be used."""
    table, gaps = table_of(), np.arange(N, dtype=float)
    gaps[[3, 4, 9]] = np.nan
    far = np.where(np.arange(N) == 7, np.inf, table["age"])
    return table.assign(none=None, gaps=gaps, far=far).to_csv(index=False)


test_refusals = refusals_of("cli_report", globals())
