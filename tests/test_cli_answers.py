import json
import re

import numpy as np
import pytest

pd = pytest.importorskip("pandas")
pytest.importorskip("matplotlib")

from isa_nrsfm.analysis import WithinGroups, association, between_share  # noqa: E402
from isa_nrsfm.cli import main  # noqa: E402
from isa_nrsfm.cli._answer_text import answer_lines  # noqa: E402
from isa_nrsfm.datasets import make_nonrigid_tracks  # noqa: E402
from isa_nrsfm.io import load_model  # noqa: E402

N = 120


def table_of(seed=0):
    """Return a table of a thing that waves, with columns to ask about."""
    phase = 0.12 * np.arange(N)
    alpha = np.stack([np.sin(phase), np.cos(0.6 * phase)], axis=1)
    scene = make_nonrigid_tracks(
        n_frames=N, n_points=14, n_components=2, noise=0.0, random_state=seed
    )
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
    return table


@pytest.fixture(scope="module")
def run(tmp_path_factory):
    """Return the folder of a run with all questions, and its table."""
    folder = tmp_path_factory.mktemp("answers")
    table = table_of()
    table.loc[5, "mood"] = None
    table.to_csv(folder / "table.csv", index=False)
    options = ["--label", "mood", "--label", "age:number", "--group", "person"]
    arguments = ["fit", str(folder / "table.csv"), "-k", "2", *options]
    assert main([*arguments, "--time", "seconds", "-o", str(folder / "out")]) == 0
    return folder / "out", table


def report_of(folder):
    return json.loads((folder / "report.json").read_text())


def test_labels_are_answered_as_in_python(run):
    folder, table = run
    model, (mood, age) = load_model(folder / "model.npz"), report_of(folder)["labels"]
    known = table["mood"].notna()
    expected = association(
        model.alpha_[known],
        table["mood"][known],
        table["person"][known],
        time=table["seconds"][known],
        random_state=0,
    )
    np.testing.assert_allclose(mood["values"], expected.statistic)
    np.testing.assert_allclose(mood["p_values"], expected.p_value)
    assert mood["permuted"] == expected.permuted
    assert (
        f"permutations of {expected.permuted}" in (folder / "report.html").read_text()
    )
    assert mood["n_without_label"] == 1
    assert mood["classes"] == {"down": (table["mood"] == "down").sum(), "up": 66}
    assert mood["cross_validated"] > 0.9
    assert age["statistic"] == "spearman"
    assert max(np.abs(age["values"])) > 0.9
    assert age["cross_validated"] > 0.8 > age["cross_validated_pca"]


def test_means_of_classes_are_said_in_words(run):
    folder, table = run
    model = load_model(folder / "model.npz")
    report = report_of(folder)
    mood, age = report["labels"]
    standard = (model.alpha_ - model.alpha_.mean(axis=0)) / model.alpha_.std(axis=0)
    for name in ("up", "down"):
        expected = standard[table["mood"] == name].mean(axis=0)
        np.testing.assert_allclose(mood["class_means"][name], expected, atol=1e-9)
    assert "class_means" not in age
    k = int(np.argmax(mood["values"]))
    means = {name: f"{mean[k]:+.1f}" for name, mean in mood["class_means"].items()}
    first, second = sorted(means, key=lambda name: -abs(mood["class_means"][name][k]))
    line = f"alpha_{k + 1}: {first} {means[first]}, {second} {means[second]}"
    assert mood["p_values"][k] < 0.05
    assert line in answer_lines(report)["Labels"]
    assert line in (folder / "report.html").read_text(encoding="utf-8")
    # Coefficients that have nothing to do with the label have no line.
    report["labels"][0]["p_values"][k] = 0.2
    assert line not in answer_lines(report)["Labels"]


def test_groups_and_coefficients_within_them(run):
    folder, table = run
    model, alpha = load_model(folder / "model.npz"), pd.read_csv(folder / "alpha.csv")
    within = WithinGroups().fit_transform(model.alpha_, groups=table["person"])
    columns = ["alpha_1_within", "alpha_2_within"]
    np.testing.assert_allclose(alpha[columns], within, atol=1e-9)
    expected = between_share(model.alpha_, table["person"])
    found = report_of(folder)["groups"]
    np.testing.assert_allclose(found["between"], expected.between)
    assert found["n_groups"] == 3


def test_time_smooths(run):
    folder, table = run
    model, alpha = load_model(folder / "model.npz"), pd.read_csv(folder / "alpha.csv")
    X = table[[name for name in table if name[0] in "xy"]]
    expected = model.smooth(X, time=table["seconds"], groups=table["person"])
    columns = ["alpha_1_smooth", "alpha_2_smooth"]
    np.testing.assert_allclose(alpha[columns], expected.alpha, atol=1e-9)
    time = report_of(folder)["time"]
    assert time["column"] == "seconds"
    assert len(time["time_scales"]) == 2


def test_figures_are_listed_and_drawn(run):
    folder, _ = run
    files = report_of(folder)["files"]
    for name in ("label_1.png", "label_1_shapes.png", "label_2.png", "time.png"):
        assert name in files
        assert (folder / name).read_bytes().startswith(b"\x89PNG")


def test_a_later_run_without_questions_takes_the_figures_away(run, tmp_path, capsys):
    _, table = run
    table.to_csv(tmp_path / "table.csv", index=False)
    arguments = ["fit", str(tmp_path / "table.csv"), "-k", "1", "-o", str(tmp_path)]
    assert main([*arguments, "--label", "mood", "--fps", "25"]) == 0
    text = capsys.readouterr().out
    assert "Labels     mood: 119 frames of 2 classes; 1 without it are left out" in text
    assert "Time       seconds: " in text
    assert (tmp_path / "label_1.png").exists()
    assert main([*arguments, "--no-figures"]) == 0
    assert not (tmp_path / "label_1.png").exists()
    assert "labels" not in report_of(tmp_path)


@pytest.mark.parametrize(
    ("scales", "said"),
    [
        (
            [np.inf, np.inf, 8.24],
            "fades within 8.24; in 2 of 3 directions of change it",
        ),
        ([8.24, 3.0], "a change of the shape fades within 8.24, 3"),
        ([np.inf], "time: in 1 of 1 directions of change it lasts"),
        ([], "the frames show no dynamics"),
    ],
)
def test_times_are_said_in_words(scales, said):
    time = {"column": "time", "time_scales": scales, "changed_by": 0.1}
    (title, *_) = answer_lines({"time": time})["Time"]
    assert said in title
    assert "never" not in title


@pytest.mark.parametrize(
    ("options", "message"),
    [
        (["--label", "smile"], "--label: the table has no column 'smile'; its columns"),
        (["--label", "same"], "--label same: all 120 labels are 1: there is nothing"),
        (["--label", "seconds:classes"], "--label seconds:classes: the 120 labels are"),
        (["--label", "mood:number"], "labels that are numbers are expected; got"),
        (["--label", "far"], "--label far must be finite; 1 of 120 .* in row 7: "),
        (["--label", "none"], "--label: no frame has a 'none'"),
        (["--group", "gaps"], "--group: 3 of 120 frames have no 'gaps'"),
        (["--time", "mood"], "--time: expected numbers or dates; 120 of 120 frames"),
        (["--time", "same"], "--time same: times must rise .* row 1 has 1 after 1 of"),
        (["--time", "gaps"], "--time gaps: time must be known .* missing in 3 of 120"),
        (["--fps", "0"], "expected a number above zero; got '0'"),
        (["--fps", "5", "--time", "seconds"], "not allowed with"),
        (["--distance", "3"], "expected two points with a comma between them"),
        (["--distance", "3,99"], "--distance 3,99: there is no point '99'; the 14"),
        (["--distance", "3,3"], "--distance 3,3: expected two different points"),
        (["--unit", "3,4"], "--unit is for --distance"),
    ],
)
def test_refused_before_the_fit(tmp_path, capsys, options, message):
    table = table_of()
    table["none"] = None
    table["gaps"] = np.arange(N, dtype=float)
    table.loc[[3, 4, 9], "gaps"] = np.nan
    table["far"] = np.where(np.arange(N) == 7, np.inf, table["age"])
    table.to_csv(tmp_path / "table.csv", index=False)
    arguments = ["fit", str(tmp_path / "table.csv"), "-o", str(tmp_path / "out")]
    try:
        code = main([*arguments, *options])
    except SystemExit as error:  # argparse
        code = error.code
    assert code in (1, 2)
    error = capsys.readouterr().err
    assert re.search(message, error), error
    assert not (tmp_path / "out").exists()


def test_groups_are_held_out_together(tmp_path, capsys):
    table_of().to_csv(tmp_path / "table.csv", index=False)
    arguments = ["fit", str(tmp_path / "table.csv"), "-k", "1,2", "--no-figures"]
    assert main([*arguments, "--group", "person", "-o", str(tmp_path / "out")]) == 0
    parts = report_of(tmp_path / "out")["choice"]["held_out_error_of_parts"]
    assert np.shape(parts) == (2, 3)
    assert main([*arguments, "--group", "same", "-o", str(tmp_path / "none")]) == 1
    assert "needs two groups; got 1" in capsys.readouterr().err
