"""
The 3D motion of a body from one camera
=======================================

Markers of motion capture, seen by one camera that goes round the person. From the 2D
tracks alone `AffineNRSfM` finds the body in each frame in 3D. A body moves so much that
affine cameras would take part of its motion for their own; but this camera is far away
and has one scale, so it is orthographic, and that is said.

The table is a sequence of motion capture (Akhter et al. 2008) where it is found, see
:doc:`/gallery/index`, and otherwise artificial: a body of 42 markers that moves all of
its joints. The truth is known for both, and used for nothing but to measure the error.
"""

# sphinx_gallery_thumbnail_number = 2
import os
import tempfile
from pathlib import Path

import matplotlib.pyplot as plt
import numpy as np
from scipy.spatial.transform import Rotation

from isa_nrsfm import AffineNRSfM
from isa_nrsfm.export import write_viewer
from isa_nrsfm.metrics import mean_shape_error_3d

# Bones of a body, y down: the bone before, where it ends, and how far it swings.
LIMBS = {
    -1: [(0, (0, -0.5, 0), 0.2), (1, (0, -0.22, 0), 0.3)],  # trunk and head
    1: [(0.2, 0.05, 0.1), (0.1, 0.3, 0.9), (0.0, 0.28, 0.8)],  # shoulder and arm
    0: [(0.1, 0.05, 0.1), (0.0, 0.42, 0.5), (0.0, 0.4, 0.5)],  # hip and leg
}


def artificial_body(n_frames):
    """Return tracks and shapes of a body in motion, and the markers to be joined."""
    rng = np.random.RandomState(0)
    bones = [(0, (0, 0, 0), 0.0), *LIMBS[-1]]
    for start in (1, 0):
        for side in (-1, 1):
            before = start
            for x, y, size in LIMBS[start]:
                bones.append((before, (side * x, y, 0), size))
                before = len(bones) - 1
    time = np.arange(n_frames)[:, None]
    exercises = np.sin(time * [0.045, 0.071] + [0.0, 1.0])
    ends, turns, markers = [], [], []
    for before, offset, size in bones:
        angles = size * exercises @ rng.uniform(-0.8, 0.8, (2, 3))
        turn = Rotation.from_euler("xyz", angles)
        end = np.zeros((n_frames, 3))
        if ends:
            turn = turns[before] * turn
            end = ends[before] + turn.apply(offset)
        ends.append(end)
        turns.append(turn)
        markers += [end + turn.apply(rng.normal(0, 0.05, 3)) for _ in range(3)]
    shape = np.stack(markers, axis=1)
    edges = [(3 * k, 3 * before) for k, (before, _, _) in enumerate(bones) if k]
    edges += [
        (3 * k + a, 3 * k + b) for k in range(len(bones)) for a, b in ((0, 1), (1, 2))
    ]
    view = Rotation.from_euler("x", 15, degrees=True) * Rotation.from_euler(
        "y", 5 * time, degrees=True
    )
    tracks = shape @ view.as_matrix()[:, :2].transpose(0, 2, 1)
    return tracks + 0.003 * rng.normal(size=tracks.shape), shape, np.array(edges)


path = Path(os.environ.get("ISA_NRSFM_DATA", ""), "akhter_yoga.npz")
if path.is_file():
    print("motion capture: yoga")
    with np.load(path) as stored:
        tracks, truth = stored["W2d"], stored["S3d"]
        edges, origin = stored["skeleton_edges"], "lower"  # y points up
else:
    print("an artificial body")
    tracks, truth, edges = artificial_body(300)
    origin = "upper"
n_frames, n_points = tracks.shape[:2]
X = tracks.reshape(n_frames, 2 * n_points)
print(n_frames, "frames,", n_points, "markers")

# %%
# What the camera sees, in five frames.

shown = (n_frames * np.linspace(0.1, 0.85, 5)).astype(int)


def draw(axis, points, colour):
    """Draw a body in an image or from one side."""
    axis.scatter(*points.T, s=4, color=colour)
    axis.plot(*points[edges].transpose(2, 1, 0), color=colour, lw=0.8)
    axis.set(aspect="equal", xticks=[], yticks=[])
    axis.yaxis.set_inverted(origin == "upper")


_, axes = plt.subplots(1, 5, figsize=(9, 2.6), layout="constrained")
for i, axis in zip(shown, axes, strict=True):
    draw(axis, tracks[i], "0.3")
    axis.set_title(f"frame {i}", fontsize="small")

# %%
# How many basis shapes a body takes that bends all of its joints is hard to guess:
# "auto" takes those that the table determines. Frames of an orthographic camera have
# one scale, and shapes are in the units of the table.

model = AffineNRSfM("auto", camera="orthographic", random_state=0).fit(X)
print(f"{len(model.basis_)} basis shapes, inverse SNR {model.inverse_snr_:.4%}")
print(f"noise variance {model.camera_noise_ratio_:.2f} times that of affine cameras")

# %%
# The noise says that affine cameras would explain no more: the table does not
# contradict orthographic ones. Images do not tell an object from its mirror image in
# depth, though. Here the truth says which it is; otherwise a look at the hands does, or
# at the face. `AffineNRSfM.mirror` takes the other one.


def turned_onto(targets, shapes):
    """Return shapes turned onto others, frame by frame, without reflections."""
    left, _, right = np.linalg.svd(shapes.transpose(0, 2, 1) @ targets)
    left[:, :, 2] *= np.linalg.det(left @ right)[:, None]
    return shapes @ left @ right


bodies = truth - truth.mean(axis=1, keepdims=True)
shapes = model.reconstruct(X)
apart, mirrored_apart = (
    np.linalg.norm(turned_onto(bodies, found) - bodies)
    for found in (shapes, shapes * [1, 1, -1])
)
if mirrored_apart < apart:
    print("the mirror image is the right one")
    shapes = model.mirror().reconstruct(X)

# %%
# The same frames from the side, which the camera has not seen. Above the truth, below
# what was found.

found = shapes @ model.rotations_.transpose(0, 2, 1)  # as the camera stands
true = turned_onto(found, bodies)
size = np.abs(true[:, :, 1:]).max()
_, axes = plt.subplots(2, 5, figsize=(9, 5.4), layout="constrained")
for i, pair in zip(shown, axes.T, strict=True):
    draw(pair[0], true[i][:, [2, 1]], "0.3")
    draw(pair[1], found[i][:, [2, 1]], "tab:red")
    pair[0].set_title(f"frame {i}", fontsize="small")
    for axis in pair:
        axis.set(xlim=(-0.7 * size, 0.7 * size), ylim=np.sort(axis.get_ylim()))
        axis.yaxis.set_inverted(origin == "upper")
axes[0, 0].set_ylabel("truth")
axes[1, 0].set_ylabel("found")

# %%
# The error of each frame, after the best rotation, reflection and scale, beside that of
# affine cameras whose metric is found afterwards, and that of a body that stands still.

affine = AffineNRSfM(len(model.basis_), scale_frames=False, random_state=0).fit(X)
results = {
    "mean shape": np.broadcast_to(model.mean_shape_, shapes.shape),
    "affine cameras": affine.reconstruct(X, camera="orthographic"),
    "orthographic cameras": shapes,
}
_, axis = plt.subplots(figsize=(8, 2.8), layout="constrained")
for name, colour in zip(results, ("0.7", "tab:blue", "tab:red"), strict=True):
    errors = [
        mean_shape_error_3d(one[None], other[None], convention="frame")
        for one, other in zip(truth, results[name], strict=True)
    ]
    axis.plot(100 * np.array(errors), color=colour, label=name)
    print(f"{name:21} {np.mean(errors):.1%} of the size of the body")
axis.set(xlabel="frame", ylabel="3D error, %", yscale="log")
axis.legend(loc="center left", bbox_to_anchor=(1, 0.5))

# %%
# A page to look at the body in motion, in any browser, is one call. It plays the
# frames, also as the camera saw them.

with tempfile.TemporaryDirectory() as folder:
    page = Path(folder, "body.html")
    write_viewer(model, page, edges=edges, origin=origin)
    print(f"{page.name}: {page.stat().st_size / 1e6:.1f} MB")
