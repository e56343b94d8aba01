"""
Which camera
============

`AffineNRSfM` has three models of a camera.

- ``camera="affine"``, the default, assumes nothing: take it for images that may be
  stretched, and where coefficients matter more than proportions.
- ``camera="weak_perspective"`` takes cameras for rotations with a scale for each frame:
  take it for photos and videos with square pixels of things that are far away for their
  size, and always where a thing moves much, as bodies do.
- ``camera="orthographic"`` has one scale for all frames: take it for one camera whose
  distance and focal length do not change, and for motion capture.

With the last two shapes have true proportions. Whether a table agrees with them is
said by ``camera_noise_ratio_``: the variance of the noise that the fit with calibrated
cameras leaves, divided by that of affine ones. Any fit has it, whatever its `camera`.
"""

import warnings
from textwrap import fill

import matplotlib.pyplot as plt
import numpy as np
from scipy.spatial.transform import Rotation

from isa_nrsfm import AffineNRSfM
from isa_nrsfm.datasets import make_nonrigid_tracks
from isa_nrsfm.metrics import mean_shape_error_3d

# %%
# A table of an object of two parts, one of which turns on a hinge. It takes two basis
# shapes: the sine and the cosine of the angle. The cameras are weak-perspective ones.
# In a second table each image is stretched besides, by up to a half in any direction:
# the cameras are affine then.

rng = np.random.RandomState(0)
shapes = np.tile(rng.normal(size=(40, 3)), (200, 1, 1))
hinge = Rotation.from_rotvec(rng.uniform(-1, 1, (200, 1)) * [0.6, 0.0, 0.8])
shapes[:, 20:] = shapes[:, 20:] @ hinge.as_matrix().transpose(0, 2, 1)
tables = {}
for camera in ("weak_perspective", "affine"):
    motion = make_nonrigid_tracks(200, camera=camera, random_state=0).motion
    tracks = shapes @ motion.transpose(0, 2, 1)
    noise = (
        0.01 * tracks.std(axis=(1, 2), keepdims=True) * rng.normal(size=tracks.shape)
    )
    tables[camera] = (tracks + noise).reshape(200, -1)

# %%
# What the noise says
# -------------------
#
# - Near one (below 1.3): calibrated cameras explain the table as well. Take them.
# - Above ten: the cameras are not calibrated ones, if K is large enough.
# - Between: often too few basis shapes. What is missing of the deformation is explained
#   by cameras that are free, and wrongly so. Try a larger K before anything else.
#   Perspective, of things that are near, leads there as well, and so do stretched
#   images where basis shapes can take over a part of the stretching.
#
# `AffineNRSfM.diagnostics` says it in a sentence, and so does the report of the command
# line. The last of these has too few basis shapes.

for camera, K in [("weak_perspective", 2), ("affine", 2), ("weak_perspective", 1)]:
    model = AffineNRSfM(K, random_state=0).fit(tables[camera])
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # of other things than the cameras
        meaning = model.diagnostics().camera_meaning
    print(f"{camera} cameras, K={K}: {model.camera_noise_ratio_:.2f}")
    print(fill(meaning, 80))

# %%
# How many basis shapes
# ---------------------
#
# Too few basis shapes are worse for calibrated cameras than for affine cameras, which
# absorb the missing ones. With enough basis shapes the opposite holds. ``"auto"`` uses
# as many as the table determines.

X = tables["weak_perspective"]
numbers, errors = [1, 2, 3, 4], {"affine": [], "weak_perspective": []}
for n_components in numbers:
    for camera in errors:
        model = AffineNRSfM(n_components, camera=camera, random_state=0).fit(X)
        found = model.reconstruct(X, camera="weak_perspective")
        error = mean_shape_error_3d(shapes, found, convention="frame")
        errors[camera].append(100 * error)
auto = AffineNRSfM("auto", camera="weak_perspective", random_state=0).fit(X)
print(f'"auto" finds K={len(auto.basis_)}')

_, axis = plt.subplots(figsize=(6, 3), layout="constrained")
for camera, error in errors.items():
    axis.plot(numbers, error, "o-", label=f'camera="{camera}"')
axis.set(ylabel="3D error, %", xlabel="n_components", xticks=numbers, ylim=0)
axis.legend()

# %%
# What shapes are
# ---------------
#
# With affine cameras the shapes of a model are known up to an affinity of space;
# ``reconstruct(X, camera="weak_perspective")`` finds the metric afterwards. With
# calibrated ones they are Euclidean as they are, `reconstruct` needs no further word,
# and each frame has a rotation and a scale.

shape = auto.mean_shape_ + np.tensordot(auto.alpha_[0], auto.basis_, 1)
image = auto.scales_[0] * shape @ auto.rotations_[0, :2].T + auto.translation_[0]
off = np.std(image - X[0].reshape(-1, 2)) / auto.scales_[0]
print(f"image of frame 0: off by {off:.3f} of the size of the object")

# %%
# An object and its mirror image in depth have the same images: `AffineNRSfM.mirrored`
# selects the other one. Units and conventions are in :doc:`/conventions`.
