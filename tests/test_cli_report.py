"""The report of a fit: text, page, labels, groups, times and the choice of K."""

import contextlib
import re
from pathlib import Path

import numpy as np
import pandas as pd
import pytest
from fit_runs import Results, ran
from landmark_files import saved
from layers import slow_after
from matplotlib.figure import Figure
from numpy.testing import assert_allclose
from refusals import refusals_of
from scenes import waving_scene
from sklearn.model_selection import GroupKFold

from isa_nrsfm import AffineNRSfM, AffineNRSfMCV, FastISA
from isa_nrsfm.analysis import WithinGroups, association, between_share
from isa_nrsfm.cli import main
from isa_nrsfm.export import frame_poses

N = 60
# The name of a column.
MOOD = 'mood<script>alert("x")</script>&"{{content}}$0_$50k'
EXPECTED = Path(__file__).with_name("expected") / "report.txt"


def table_of(seed=0):
    """Return a table of a thing that waves, with other columns."""
    scene, alpha = waving_scene(N, 14, [0.3, 0.18], seed)
    tracks, rng = scene.tracks, np.random.default_rng(seed)
    tracks += 0.05 * tracks.std() * rng.normal(size=tracks.shape)
    names = [f"{c}{j}" for j in range(14) for c in "xy"]
    others = {
        MOOD: np.where(alpha[:, 0] > 0, "up", "down"),
        "age": 20.5 + alpha[:, 1] + 0.01 * rng.normal(size=N),
        "person": np.repeat(["Ann", "Bob", "Cid"], N // 3),
        "seconds": np.arange(N) / 25,
        "same": 1,
    }
    return pd.DataFrame(tracks.reshape(N, -1), columns=names).assign(**others)


def points_of(table):
    return table.filter(regex=r"^[xy]\d+$")


@contextlib.contextmanager
def drawn():
    """Keep the figures that are saved within, with few pixels."""
    figures, save = [], Figure.savefig

    def keep(self, *args, **keywords):
        figures.append(self)
        return save(self, *args, **keywords | {"dpi": 20})

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(Figure, "savefig", keep)
        yield figures


@pytest.fixture(scope="module")
def answers(tmp_path_factory):
    """Return results of a run with labels, groups and times, its table and figures."""
    folder, table = tmp_path_factory.mktemp("answers"), table_of()
    table.loc[5, MOOD] = None
    path = saved(folder / "table.csv", table)
    options = ["-k", 2, "--group", "person", "--time", "seconds", "--label", MOOD]
    with drawn() as figures:
        code, out, err = ran(
            "fit", path, "-o", folder / "out", *options, "--label", "age:number"
        )
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
    found, _, figures = answers
    report = found.report
    source = (found.folder / "report.html").read_text(encoding="utf-8")
    # Texts of the table stay text.
    assert "<script" not in source
    warnings = [warning[1:] for warning in report["warnings"]]
    for shown in ("isa-nrsfm fit", *np.ravel(report["summary"]), *warnings):
        assert shown in found.page
    assert len(re.findall('<img [^>]+ alt="[^"]+"', source)) == len(figures) == 7
    assert source.count("<img") == 7
    links = re.findall(r"(?:src|href)=\"(?!data:)[^\"]+", source)
    assert links == ['href="viewer.html']
    assert "default-src 'none'" in source
    for name in figures:
        assert (found.folder / name).read_bytes().startswith(b"\x89PNG")


def test_labels_groups_and_times_are_those_of_python(answers):
    found, table, _ = answers
    model, report = found.model, found.report
    mood, age = report["labels"]
    known = table[MOOD].notna()
    columns = (table[name][known] for name in (MOOD, "person"))
    options = {"time": table["seconds"][known], "random_state": 0}
    expected = association(model.alpha_[known], *columns, **options)
    assert_allclose(mood["values"], expected.statistic)
    assert_allclose(mood["p_values"], expected.p_value)
    assert (mood["permuted"], mood["n_without_label"]) == (expected.permuted, 1)
    assert mood["classes"] == table[MOOD].value_counts().to_dict()
    assert mood["cross_validated"] > 0.9
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
        assert_allclose(alpha[columns], values, atol=1e-9)
    yaw = frame_poses(model, smooth.decomposition).yaw
    assert_allclose(found.cameras["yaw_smooth"], yaw, atol=1e-6)
    between = between_share(model.alpha_, person).between
    assert_allclose(report["groups"]["between"], between)
    assert len(report["time"]["time_scales"]) == 2


def test_means_of_classes_are_of_significant_coefficients(answers):
    found, table, _ = answers
    mood, alpha = found.report["labels"][0], found.model.alpha_
    related = np.less(mood["p_values"], 0.05)
    assert sorted(related) == [False, True]
    standard = (alpha - alpha.mean(axis=0)) / alpha.std(axis=0)
    means = {
        name: standard[table[MOOD] == name].mean(axis=0) for name in mood["classes"]
    }
    for name, mean in means.items():
        assert_allclose(mood["class_means"][name], mean, atol=1e-9)
    for k, is_related in enumerate(related):
        order = sorted(means, key=lambda name: -abs(means[name][k]))
        shown = ", ".join(f"{name} {means[name][k]:+.1f}" for name in order)
        assert (f"alpha_{k + 1}: {shown}." in found.page) == is_related


def test_figures_have_legends_and_residuals(answers):
    found, _, figures = answers
    (legend,) = figures["label_1_shapes.png"].legends
    texts = [text.get_text() for text in legend.get_texts()]
    assert texts[:2] == ["mean of all frames", "mean of the class"]
    assert texts[2:] == ["lines: minimal spanning tree"]
    titles = [axes.get_title() for axes in figures["reprojection.png"].axes]
    errors = found.cameras["inverse_snr"]
    assert len(titles) == 6
    for title in titles:
        row, share = re.match(r"row (\d+)\ninverse SNR (.*) %", title).groups()
        assert float(share) == pytest.approx(100 * errors[int(row)], rel=0.1)


ESTIMATOR = AffineNRSfM(isa=FastISA(n_init=1), refinement=None, random_state=0)
UNREFINED = "--no-figures --refinement none --isa fast --n-init 1".split()


@pytest.mark.parametrize("groups", slow_after(1, [True, False]))
def test_the_choice_is_that_of_the_search(fits, tmp_path, groups):
    table = table_of()
    options = ["-k", "1-2", *UNREFINED, *["--group", "person"] * groups]
    found = fits(saved(tmp_path / "table.csv", table), *options)
    assert len(found.err.splitlines()) == 2
    parts = {"estimator": ESTIMATOR, "cv": GroupKFold(3) if groups else 3}
    search = AffineNRSfMCV([1, 2], **parts, select="one_standard_error")
    search.fit(points_of(table), groups=table["person"] if groups else None)
    parts = [-search.cv_results_[f"split{i}_test_score"] for i in range(3)]
    report, of_parts = found.report["choice"], np.transpose(parts)
    mean, errors = of_parts.mean(axis=1), of_parts.std(axis=1, ddof=1) / np.sqrt(3)
    expected = {"n_components": [1, 2], "held_out_error_of_parts": of_parts}
    expected |= {"held_out_error": mean, "held_out_error_standard_error": errors}
    for name, values in expected.items():
        assert_allclose(report[name], values, rtol=1e-6)
    assert report["chosen"] == search.n_components_
    numbers = zip([1, 2], 100 * mean, 100 * errors, strict=True)
    tried = ", ".join(f"{k} ({error:.3g} +- {std:.2g} %)" for k, error, std in numbers)
    out = " ".join(found.out.split())
    assert f"K = {tried}: {search.n_components_} is used" in out
    assert "pose" not in out  # not known of affine cameras


def odd_columns():
    """Return the text of a table whose other columns cannot be used."""
    table, gaps = table_of(), np.arange(N, dtype=float)
    gaps[[3, 4, 9]] = np.nan
    far = np.where(np.arange(N) == 7, np.inf, table["age"])
    return table.assign(none=None, gaps=gaps, far=far).to_csv(index=False)


test_refusals = refusals_of("cli_report", globals())
