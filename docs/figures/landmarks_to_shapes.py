"""Draw what goes into a fit and what comes out: ``python docs/figures/NAME.py``.

The picture of the page of the method and of the paper. The face is generated; its table
is that of ``isa-nrsfm demo``.
"""

from pathlib import Path

import matplotlib.pyplot as plt
import numpy as np

from isa_nrsfm import AffineNRSfM
from isa_nrsfm.datasets import make_face_tracks
from isa_nrsfm.plotting import BasisShapeDisplay
from isa_nrsfm.skeletons import SKELETONS

N_SHOWN = 6


def main():
    """Fit the faces and write the picture beside this file."""
    faces = make_face_tracks(
        400, n_components=3, camera="weak_perspective", random_state=0
    )
    model = AffineNRSfM(3, camera="weak_perspective", random_state=0).fit(faces.data)
    plt.rcParams["font.size"] = 12
    figure = plt.figure(figsize=(11, 5.2), layout="constrained")
    left, right = figure.subfigures(1, 2, width_ratios=(1, 2.2), wspace=0.03)
    draw_frames(left, faces)
    draw_shapes(right, model, faces)
    figure.savefig(Path(__file__).with_suffix(".png"), dpi=100)


def draw_frames(figure, faces):
    """Draw frames that are turned far, and to different sides."""
    yaw = faces.angles[:, 0]
    wanted = np.quantile(yaw, np.linspace(0.02, 0.98, N_SHOWN))
    shown = [int(np.argmin(abs(yaw - angle))) for angle in wanted]
    edges = SKELETONS["ibug-68"].edges
    figure.suptitle("In: 2D landmarks of 400 frames")
    for axis, i in zip(figure.subplots(3, 2).ravel(), shown, strict=True):
        points = faces.tracks[i]
        axis.plot(*points[edges].transpose(2, 1, 0), color="0.7", linewidth=1)
        axis.scatter(*points.T, s=5, color="black", zorder=2)
        axis.set_aspect("equal")
        axis.invert_yaxis()
        axis.set_axis_off()


def draw_shapes(figure, model, faces):
    """Draw the mean shape and the basis shapes, from the front and from the side."""
    figure.suptitle("Out: mean 3D shape and basis shapes, front and side")
    grid = figure.subplots(2, 4, width_ratios=(3, 2, 3, 2))
    BasisShapeDisplay.from_estimator(model, ax=grid.reshape(4, 2))
    shared = np.corrcoef(model.alpha_, faces.alpha, rowvar=False)[:3, 3:]
    truth = [faces.component_names[k] for k in abs(shared).argmax(axis=1)]
    titles = ["Mean shape", *(f"Basis shape {k + 1}: {truth[k]}" for k in range(3))]
    for axis, title in zip(grid[:, ::2].ravel(), titles, strict=True):
        axis.set_title(title, loc="left")


if __name__ == "__main__":
    main()
