"""
The 3D motion of a body from one camera
=======================================

Markers of motion capture, seen by one camera that goes round the person. From the 2D
tracks alone `AffineNRSfM` finds the body in each frame in 3D.

The table is a sequence of motion capture (Akhter et al. 2008) where it is found, see
:doc:`/gallery/index`, and otherwise artificial: a body of 39 markers that swings its
arms and legs. The truth is known for both, and used for nothing but to measure the
error.
"""

import os
import warnings
from pathlib import Path

import matplotlib.pyplot as plt
import numpy as np
from scipy.spatial.transform import Rotation

from isa_nrsfm import AffineNRSfM
from isa_nrsfm.metrics import mean_shape_error_3d


def artificial_body(n_frames):
    """Return tracks and shapes of a body that dances, and the markers to be joined."""
    rng = np.random.RandomState(0)
    phase = 2 * np.pi * np.arange(n_frames) / 50
    torso = rng.uniform(-1, 1, (15, 3)) * [0.22, 0.35, 0.15] - [0, 0.25, 0]
    shapes, edges = [np.broadcast_to(torso, (n_frames, 15, 3))], []
    for x, y, length, amplitude in ((0.25, -0.5, 0.55, 0.35), (0.1, 0.1, 0.8, 0.25)):
        for side in (-1, 1):
            swing = amplitude * np.sin(phase if y > 0 else 0.7 * phase) * side
            limb = rng.uniform(-0.05, 0.05, (6, 3)) + [0, length, 0] * rng.uniform(
                0, 1, (6, 1)
            )
            limb = limb[np.argsort(limb[:, 1])]
            moved = Rotation.from_euler("x", swing[:, None]).as_matrix()
            first = sum(part.shape[1] for part in shapes)
            edges += [(first + k, first + k + 1) for k in range(5)]
            shapes.append([side * x, y, 0] + limb @ moved.transpose(0, 2, 1))
    shape = np.concatenate(shapes, axis=1)
    turn = Rotation.from_euler("y", 5 * np.arange(n_frames)[:, None], degrees=True)
    turn = (Rotation.from_euler("x", 15, degrees=True) * turn).as_matrix()
    tracks = shape @ turn[:, :2].transpose(0, 2, 1)
    return tracks + 0.003 * rng.normal(size=tracks.shape), shape, np.array(edges)


path = Path(os.environ.get("ISA_NRSFM_DATA", ""), "akhter_drink.npz")
if path.is_file():
    print("motion capture: a person drinks, every second frame")
    with np.load(path) as stored:
        tracks, truth = stored["W2d"][::2], stored["S3d"][::2]
        edges = stored["skeleton_edges"]
    n_components, axes_of_view = 3, (0, 2)
else:
    print("an artificial body")
    tracks, truth, edges = artificial_body(200)
    n_components, axes_of_view = 2, (0, 1)
n_frames, n_points = tracks.shape[:2]
X = tracks.reshape(n_frames, 2 * n_points)
print(n_frames, "frames,", n_points, "markers")

# %%
# All frames have the same scale here, so they count by their size.

model = AffineNRSfM(n_components, scale_frames=False, random_state=0).fit(X)
print(f"inverse SNR {model.inverse_snr_:.4%}, stiffness {model.stiffness_:g}")

# %%
# `stiffness_` above zero says that the deformation is so large that free affine cameras
# would take it for their own motion. It was chosen by what it does to the cameras.
#
# The cameras were orthographic, so the shapes can be had in true proportions and in the
# units of the table, up to one rotation and the mirror image in depth.

shapes = model.reconstruct(X, camera="orthographic")
rigid = np.broadcast_to(shapes.mean(axis=0), shapes.shape)
for name, found in {"the mean shape": rigid, "shapes": shapes}.items():
    error = mean_shape_error_3d(truth, found, convention="frame")
    print(f"error of {name:15} {error:.1%} of the size of the body")

# %%
# Three frames from the front and from the side, turned onto the truth (grey).


def turned_onto(target, shape):
    """Return a shape after the best orthogonal transformation and scaling."""
    target = target - target.mean(axis=0)
    shape = shape - shape.mean(axis=0)
    U, S, Vt = np.linalg.svd(shape.T @ target)
    return shape @ U @ Vt * S.sum() / np.sum(shape**2)


across, up = axes_of_view
depth = 3 - across - up
_, axes = plt.subplots(2, 3, figsize=(7, 6.5), layout="constrained")
for i, pair in zip(n_frames * np.array([6, 18, 43]) // 100, axes.T, strict=True):
    body = truth[i] - truth[i].mean(axis=0)
    for shape, colour in ((body, "0.75"), (turned_onto(body, shapes[i]), "tab:red")):
        for axis, horizontal in zip(pair, (across, depth), strict=True):
            points = shape[:, [horizontal, up]]
            axis.scatter(*points.T, s=5, color=colour)
            for edge in edges:
                axis.plot(*points[edge].T, color=colour, lw=1)
            axis.set(aspect="equal", xticks=[], yticks=[])
    pair[0].set_title(f"frame {i}")
if axes_of_view == (0, 1):  # y points down
    for axis in axes.flat:
        axis.invert_yaxis()

# %%
# The coefficients tell what the body does, whatever the camera does. The order of the
# frames was not used to find them.

_, axis = plt.subplots(figsize=(8, 2.6), layout="constrained")
axis.plot(model.alpha_)
axis.set(xlabel="frame", ylabel="coefficient")
axis.legend([f"alpha {k + 1}" for k in range(n_components)], loc="right")

# %%
# Where the limits are
# --------------------
#
# Limbs that move more than the body's own size, as in yoga, are beyond what affine
# cameras without calibration tell (:doc:`/benchmarks/truth` has the errors of several
# motions and methods). `AffineNRSfM.diagnostics` shows it in the deformation amplitude,
# and warns where the table hardly determines what cameras can absorb.

with warnings.catch_warnings(record=True) as told:
    warnings.simplefilter("always")
    diagnostics = model.diagnostics()
print(f"deformation amplitude {diagnostics.deformation_amplitude:.2f}")
print(f"largest deviation of a weak direction {diagnostics.weak_deviations[-1]:.2f}")
for warning in told:
    print(warning.message)
