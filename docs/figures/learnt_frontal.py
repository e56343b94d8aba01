"""Draw what is learnt from the front and predicted from the side.

The first picture of the README and of the documentation. Faces are rendered, of 100
people (ICT-FaceKit). The table is that of ``python -m benchmarks.questions turned``,
which prints the same figures and more. From the top folder, with its data (see
docs/benchmarks/README.md): ``python -m docs.figures.learnt_frontal``.
"""

import warnings
from pathlib import Path

import matplotlib.pyplot as plt
import numpy as np
from sklearn.discriminant_analysis import LinearDiscriminantAnalysis
from sklearn.pipeline import make_pipeline

from benchmarks._sets import ICT, load_arrays
from benchmarks.questions import features_of, scores_of, seen_faces, views_of
from isa_nrsfm.skeletons import SKELETONS

ALPHA, PCA = "alpha, K=9", "PCA of aligned points, 18"
COLOURS = {ALPHA: "#D55E00", PCA: "#0072B2"}
TITLES = {ALPHA: "isa_nrsfm, 9 numbers", PCA: "PCA of aligned points, 18"}
# People whose turned faces are drawn; the others are learnt.
DRAWN = np.arange(80, 100)


def main():
    """Learn, predict, and write the picture beside this file."""
    names = load_arrays(ICT)["label_names"]
    _, X, y, people, rotations = next(
        each for each in seen_faces(0) if each[0] == "ICT-68"
    )
    y, views = names[y], views_of(rotations)
    steps = {name: features_of("ibug-68", [9])[name] for name in TITLES}
    plt.rcParams["font.size"] = 12
    figure = plt.figure(figsize=(12, 5.4), layout="constrained")
    learnt, predicted, right = figure.subfigures(1, 3, width_ratios=(1, 1.75, 1.2))
    new = np.isin(people, np.unique(people)[DRAWN])
    rows = views["frontal"] & ~new
    shown = [np.flatnonzero(rows & (y == name))[3] for name in names[1:]]
    learnt.suptitle("Learnt: faces from the front")
    for axis, i in zip(learnt.subplots(3, 2).ravel(), shown, strict=True):
        draw_face(axis, X[i], y[i])
    told = {}
    for name, features in steps.items():
        model = make_pipeline(features, LinearDiscriminantAnalysis())
        with warnings.catch_warnings(action="ignore"):
            told[name] = model.fit(X[rows], y[rows]).predict(X)
    side = np.abs(np.arctan2(rotations[:, 0, 2], rotations[:, 2, 2])) > np.radians(30)
    draw_predictions(predicted, X, y, told, np.flatnonzero(new & side))
    scores = {name: scores_of(s, X, y, people, views) for name, s in steps.items()}
    draw_scores(right.subplots(), scores)
    figure.savefig(Path(__file__).with_suffix(".png"), dpi=100)


def draw_face(axis, row, title):
    """Draw a face whose y axis points up, with its expression."""
    points, edges = row.reshape(-1, 2), SKELETONS["ibug-68"].edges
    axis.plot(*points[edges].transpose(2, 1, 0), color="0.25", linewidth=1)
    axis.set_title(title, fontsize=11, pad=2)
    axis.set_aspect("equal")
    axis.set_axis_off()


def draw_predictions(figure, X, y, told, rows):
    """Draw turned faces at random, with what each method tells of them."""
    figure.suptitle("Predicted: other people, turned")
    rows = np.random.default_rng(0).choice(rows, 9, replace=False)
    for axis, i in zip(figure.subplots(3, 3).ravel(), rows, strict=True):
        draw_face(axis, X[i], y[i])
        for place, (name, predictions) in enumerate(told.items()):
            mark = "\N{CHECK MARK}" if predictions[i] == y[i] else "\N{BALLOT X}"
            at, text = (0.5, -0.02 - 0.13 * place), f"{mark} {predictions[i]}"
            style = {"color": COLOURS[name], "fontsize": 10, "ha": "center"}
            axis.text(*at, text, transform=axis.transAxes, va="top", **style)


def draw_scores(axis, scores):
    """Draw the shares of right predictions."""
    kinds = {
        ("frontal", "frontal"): "front:\nfront",
        ("frontal", "turned"): "front:\nturned",
        ("left", "right"): "left:\nright",
    }
    for place, (name, title) in enumerate(TITLES.items()):
        values = [100 * scores[name][kind] for kind in kinds]
        at = np.arange(len(kinds)) + 0.4 * place - 0.2
        bars = axis.bar(at, values, 0.38, color=COLOURS[name], label=title)
        axis.bar_label(bars, fmt="%.0f", padding=2)
    axis.axhline(16, color="0.4", linestyle=":", linewidth=1)
    axis.set_xticks(range(len(kinds)), kinds.values())
    axis.set(ylim=(0, 108), title="Expressions that are right, %")
    axis.set_xlabel("learnt: predicted (dotted: guesses)", fontsize=10)
    axis.spines[["top", "right"]].set_visible(False)
    axis.legend(loc="upper center", frameon=False, fontsize=11)


if __name__ == "__main__":
    main()
