"""
A moving body, with error bars
==============================

The limbs of a body move by themselves. A few basis shapes for all points describe such
a body poorly: each arm needs its own. ``refinement="consensus"`` continues from the
joint fit. It fits overlapping groups of neighbouring points by themselves, and merges
their depths. `AffineNRSfM.reconstruct` returns standard deviations of these depths.
:doc:`/method` describes the steps. The consensus needs calibrated cameras
(:doc:`plot_cameras`).
"""

# sphinx_gallery_thumbnail_number = 2
import html
from pathlib import Path
from tempfile import TemporaryDirectory

import matplotlib.pyplot as plt
import numpy as np
from scipy.spatial.transform import Rotation

from isa_nrsfm import AffineNRSfM
from isa_nrsfm.export import write_viewer
from isa_nrsfm.metrics import mean_shape_error_3d

# %%
# The body is a chain of four limbs. Each limb is a rigid prism with six points. It
# turns at random in each frame, independently of the others, and starts at the end of
# the limb before. Orthographic cameras show the body from random directions.

rng = np.random.default_rng(0)
n_frames, n_limbs = 80, 4
corners = np.exp(2j * np.pi * np.arange(6) / 3)
prism = np.c_[np.repeat([0.1, 0.9], 3), 0.25 * corners.real, 0.25 * corners.imag]
joint, limbs = np.zeros((n_frames, 1, 3)), []
for _ in range(n_limbs):
    turns = Rotation.from_rotvec(0.3 * rng.normal(size=(n_frames, 3))).as_matrix()
    limbs.append(joint + prism @ turns.transpose(0, 2, 1))
    joint = joint + [[1, 0, 0]] @ turns.transpose(0, 2, 1)
views = Rotation.from_rotvec(0.6 * rng.normal(size=(n_frames, 3))).as_matrix()
truth = np.concatenate(limbs, axis=1) @ views.transpose(0, 2, 1)
truth -= truth.mean(axis=1, keepdims=True)
tracks = truth[..., :2] + 0.002 * rng.normal(size=(n_frames, 6 * n_limbs, 2))
X = tracks.reshape(n_frames, -1)

# %%
# Four images of the body, one colour for each limb:

sides = [(0, 1), (1, 2), (2, 0), (3, 4), (4, 5), (5, 3), (0, 3), (1, 4), (2, 5)]


def draw(axis, points, color=None, **style):
    """Draw a body (n_points, 2), its limbs in their colours if none is given."""
    for i in range(n_limbs):
        for ends in sides:
            line = points[6 * i + np.array(ends)].T
            axis.plot(*line, color=color or f"C{i}", **style)
    axis.set_aspect("equal")


_, axes = plt.subplots(1, 4, figsize=(9, 2.6), sharey=True, layout="constrained")
for frame, axis in zip([0, 20, 40, 60], axes, strict=True):
    draw(axis, tracks[frame])
    axis.set_title(f"frame {frame}", fontsize="small")

# %%
# The joint fit and the consensus
# -------------------------------
#
# The first fit has twelve basis shapes. The consensus starts from the same fit. Its 20
# basis shapes are the principal components of the merged shapes. Shapes turn into the
# axes of the cameras by ``rotations_``. The error is compared there, where the images
# determine x and y.

settings = {"camera": "orthographic", "random_state": 0}
models = {
    "first fit": AffineNRSfM(12, **settings).fit(X),
    "consensus": AffineNRSfM(20, refinement="consensus", **settings).fit(X),
}
found, deviations = {}, {}
for name, model in models.items():
    shapes, deviations[name] = model.reconstruct(X, return_std=True)
    turned = shapes @ model.rotations_.transpose(0, 2, 1)
    mirror = np.sign(np.sum(truth[..., 2] * turned[..., 2]))
    found[name] = turned * [1, 1, mirror]
    error = mean_shape_error_3d(truth, turned, convention="camera")
    print(f"{name}: {error:.1%} of the size of the body")

# %%
# Error bars
# ----------
#
# Images do not determine depths as well as x and y. Turn a frame to the side to see
# them: depth is horizontal. The bars are two standard deviations to either side. The
# errors of this frame are about those of the whole table.

frame = 53
_, axes = plt.subplots(
    1, 2, figsize=(9, 4.5), sharex=True, sharey=True, layout="constrained"
)
for axis, (name, shapes) in zip(axes, found.items(), strict=True):
    draw(axis, truth[frame][:, [2, 1]], color="0.7")
    draw(axis, shapes[frame][:, [2, 1]], lw=1)
    y, depth = shapes[frame, :, 1:].T
    bars = 2 * deviations[name][frame]
    axis.errorbar(depth, y, xerr=bars, fmt="k.", ms=4, lw=0.7)
    axis.set(title=f"{name} (truth grey)", xlabel="depth")
axes[0].set_ylabel("y")

# %%
# Not every frame gains. Compare the depths of all frames with the truth:

off = {name: shapes[..., 2] - truth[..., 2] for name, shapes in found.items()}
by_frame = {name: np.sqrt(np.mean(z**2, axis=1)) for name, z in off.items()}
nearer = by_frame["consensus"] < by_frame["first fit"]
print(f"the consensus is nearer to the truth in {nearer.sum()} of {n_frames} frames")
for name, z in off.items():
    stated = np.sqrt(np.mean(deviations[name] ** 2))
    within = np.mean(np.abs(z) < 2 * deviations[name])
    print(f"{name}: stated {stated:.3f}, true error {np.std(z):.3f}", end=", ")
    print(f"{within:.0%} within two deviations")

# %%
# After a consensus, the variance of a point contains the mean square change of its
# depth by the last step, in which all groups are fitted together. Frames with large
# coefficients have larger variances. The deviations distinguish uncertain points well,
# uncertain frames less clearly.
#
# Each mark is a point of the body, with root mean squares over all frames. Marks above
# the line have larger errors than stated.

_, axis = plt.subplots(figsize=(4.5, 4), layout="constrained")
for name, z in off.items():
    stated = np.sqrt(np.mean(deviations[name] ** 2, axis=0))
    axis.scatter(stated, np.sqrt(np.mean(z**2, axis=0)), label=name)
axis.axline((0, 0), slope=1, color="0.7", zorder=0)
axis.set(xlabel="stated deviation", ylabel="true error", xlim=0, ylim=0)
axis.set_aspect("equal")
axis.legend()

# %%
# The least certain points are those at the two ends of the chain. Set
# ``n_components="auto"`` to keep all principal components that exceed the noise.
#
# The body in 3D
# --------------
#
# `write_viewer` writes a page of the shapes. With ``depth_std`` uncertain points have
# long bars. Drag to turn the body, and select or play frames. If your table has y
# pointing up, as most motion capture, add ``origin="lower"``.

edges = [(6 * i + a, 6 * i + b) for i in range(n_limbs) for a, b in sides]
with TemporaryDirectory() as folder:
    path, std = Path(folder, "body.html"), deviations["consensus"]
    write_viewer(models["consensus"], path, X=X, depth_std=std, edges=edges)
    page = path.read_text(encoding="utf-8")


class Framed:
    """A page in a frame of a notebook or of this documentation."""

    def _repr_html_(self):
        style = "width: 100%; height: 44rem; border: 1px solid #8888"
        return f'<iframe style="{style}" srcdoc="{html.escape(page)}"></iframe>'


Framed()
