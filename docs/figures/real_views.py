"""Draw what real photos from several cameras say of numbers of a face.

The first picture of the README. Left: labels of one camera, predictions for other
people in another one (RaFD). Right: the numbers of five photos that five cameras took
at the same time (MUCT). The tables are those of ``python -m benchmarks.real``, which
prints the figures on the left and more. From the top folder, with its data (see
docs/benchmarks/README.md): ``python -m docs.figures.real_views``.
"""

import warnings
from pathlib import Path

import matplotlib.pyplot as plt
import numpy as np
from sklearn.decomposition import PCA
from sklearn.impute import SimpleImputer
from sklearn.pipeline import make_pipeline

from benchmarks._sets import MUCT, load_arrays
from benchmarks.real import (
    MUCT_INNER,
    RAFD,
    REMOVED,
    camera_share,
    in_views,
    methods_of,
    predicted,
)
from isa_nrsfm import AffineNRSfM
from isa_nrsfm.analysis import AlignedFrames

OURS, OTHERS = ["#E8A87C", "#D55E00"], ["#B3CDE3", "#6BAED6", "#0072B2"]
# Names of `methods_of`, and their labels.
SHOWN = {
    "own fit, K = 9": "isa_nrsfm, 9 numbers",
    f"own fit, K = 9{REMOVED}": "isa_nrsfm, 9, remove_pose",
    "PCA of aligned points, 9": "PCA of aligned points, 9",
    "PCA of aligned points, 18": "PCA, 18",
    "PCA of aligned points, 30": "PCA, 30",
}
N_NUMBERS = 6
OURS_NAME, PCA_NAME = "isa_nrsfm, remove_pose", "PCA of aligned points"


def main():
    """Fit, predict, and write the picture beside this file."""
    plt.rcParams["font.size"] = 12
    figure = plt.figure(figsize=(13, 5), layout="constrained")
    left, right = figure.subfigures(1, 2, width_ratios=(1.1, 1))
    left.suptitle("Expressions of other people, in another camera")
    draw_predictions(left.subplots())
    right.suptitle("One moment, five cameras: the numbers of its five photos")
    draw_moment(right.subplots(2, 1, sharex=True))
    figure.savefig(Path(__file__).with_suffix(".png"), dpi=100)


def draw_predictions(axis):
    """Draw shares of right predictions as bars."""
    points, y, person = in_views(load_arrays(RAFD))
    methods, kinds = methods_of(points, 0), ("front, turned", "left, right")
    for k, (name, label) in enumerate(SHOWN.items()):
        scores, _ = predicted(*methods[name], y, person)
        print(label, scores)
        heights = [100 * scores[kind] for kind in kinds]
        places = np.arange(2) + 0.17 * (k - 2)
        bars = axis.bar(places, heights, 0.16, color=(OURS + OTHERS)[k], label=label)
        axis.bar_label(bars, fmt="%.0f")
    axis.axhline(12.5, color="0.5", linestyle=":")
    labels = "learnt from the front,\npredicted at 45 degrees", "learnt from one side,"
    axis.set_xticks([0, 1], [labels[0], f"{labels[1]}\npredicted from the other"])
    axis.set(ylabel="right, percent (guesses: 12)", ylim=(0, 100))
    axis.set_yticks(range(0, 81, 20))
    axis.legend(frameon=False, loc="upper right", ncols=2, fontsize=10)


def draw_moment(axes):
    """Draw the numbers of the five photos of a typical moment, of both methods."""
    arrays = load_arrays(MUCT)
    keys = ("camera", "lighting", "subjects")
    order = np.lexsort([arrays[key] for key in keys])
    X = arrays["W2d"][order][:, MUCT_INNER].reshape(len(order), -1).astype(float)
    person = arrays["subjects"][order]
    X = X[np.isin(person, np.unique(person)[::3])]
    fit = AffineNRSfM(
        N_NUMBERS, camera="weak_perspective", remove_pose=True, random_state=0
    )
    pca = make_pipeline(SimpleImputer(), AlignedFrames(), PCA(N_NUMBERS))
    with warnings.catch_warnings(action="ignore"):  # of depths
        numbers = {OURS_NAME: fit.fit_transform(X), PCA_NAME: pca.fit_transform(X)}
    distances = {}
    for name, Z in numbers.items():
        numbers[name] = Z = (Z - Z.mean(axis=0)) / Z.std(axis=0)
        views = Z.reshape(-1, 5, N_NUMBERS)
        distances[name] = np.sqrt(np.mean(views.var(axis=1), axis=1))
        print(name, "camera explains", np.round(camera_share(Z, 5), 2))
    # The moment whose spread is the median one of the moments, for both methods
    ranks = [d.argsort().argsort() / len(d) for d in distances.values()]
    typical = np.argmin(np.abs(np.array(ranks) - 0.5).sum(axis=0))
    for axis, (name, Z) in zip(axes, numbers.items(), strict=True):
        views, spread = Z.reshape(-1, 5, N_NUMBERS)[typical], np.median(distances[name])
        for camera, values in zip("abcde", views, strict=True):
            places = np.arange(1, N_NUMBERS + 1) + 0.16 * ("abcde".index(camera) - 2)
            axis.bar(places, values, 0.15, label=f"camera {camera}")
        axis.axhline(0, color="0.5", linewidth=0.8)
        axis.set_title(f"{name}: median spread {spread:.2f}", fontsize=12)
        axis.set_ylabel("deviations")
    figure = axes[0].get_figure()
    handles = axes[0].get_legend_handles_labels()
    figure.legend(
        *handles, frameon=False, ncols=5, fontsize=9, loc="outside lower center"
    )
    axes[1].set_xlabel("number")


if __name__ == "__main__":
    main()
