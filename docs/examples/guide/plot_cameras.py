"""
Which camera
============

`AffineNRSfM` has four camera models:

- ``camera="affine"``, the default, makes no assumption. Use it for stretched images, or
  if coefficients matter more than proportions.
- ``camera="weak_perspective"`` has a rotation and a scale for each frame. Use it for
  photos and videos with square pixels whose distance is large compared with the object,
  and for objects that deform much, such as bodies.
- ``camera="orthographic"`` has one scale for all frames. Use it for motion capture, or
  for one camera with constant distance and focal length.
- ``camera="perspective"`` is a pinhole camera. Use it for objects that are nearer than
  ten times their size, or at the side of the image: :doc:`/perspective`.

The last three are called *calibrated*; their shapes have true proportions.
``camera_noise_ratio_`` measures whether a table agrees with calibrated cameras. It is
the noise variance of the fit with calibrated cameras divided by that of the fit with
affine cameras. Every joint fit computes it.
"""

from textwrap import fill

import matplotlib.pyplot as plt
import numpy as np
from scipy.spatial.transform import Rotation

from isa_nrsfm import AffineNRSfM
from isa_nrsfm.datasets import make_nonrigid_tracks
from isa_nrsfm.metrics import mean_shape_error_3d

# %%
# The object has two parts that are joined by a hinge. Its shape depends linearly on the
# sine and the cosine of the angle, so it has two basis shapes. In the first table the
# cameras are weak-perspective. In the second table they are affine: each image is
# stretched by up to a half in any direction.

rng = np.random.RandomState(0)
shapes = np.tile(rng.normal(size=(40, 3)), (100, 1, 1))
hinge = Rotation.from_rotvec(rng.uniform(-1, 1, (100, 1)) * [0.6, 0.0, 0.8])
shapes[:, 20:] = shapes[:, 20:] @ hinge.as_matrix().transpose(0, 2, 1)
tables = {}
for camera in ("weak_perspective", "affine"):
    motion = make_nonrigid_tracks(100, camera=camera, random_state=0).motion
    tracks = shapes @ motion.transpose(0, 2, 1)
    noise = (
        0.01 * tracks.std(axis=(1, 2), keepdims=True) * rng.normal(size=tracks.shape)
    )
    tables[camera] = (tracks + noise).reshape(100, -1)

# %%
# Interpretation of the ratio
# ---------------------------
#
# - Near one (below 1.3): calibrated cameras explain the table as well as affine
#   cameras. Use calibrated cameras.
# - Above ten: the cameras are not calibrated.
# - Between: often the deformation is large, and affine cameras explain a part of it.
#   Other reasons are near objects in perspective, or slightly stretched images.
#
# `AffineNRSfM.diagnostics` and the report of the command line describe the ratio in a
# sentence. It is that of fits with three basis shapes.

for camera, K in [("weak_perspective", 2), ("affine", 2)]:
    model = AffineNRSfM(K, random_state=0).fit(tables[camera])
    print(f"{camera} cameras, K={K}: {model.camera_noise_ratio_:.2f}")
    print(fill(model.diagnostics().camera_meaning, 80))

# %%
# How many basis shapes
# ---------------------
#
# Affine cameras absorb part of the deformation that K basis shapes lack. With
# calibrated cameras the fit has all directions of deformation: K is the number of
# coefficients that are reported, and the error does not depend on it. ``"auto"``
# reports those that the table determines.

X = tables["weak_perspective"]
numbers, errors = [1, 2, 3], {"affine": [], "weak_perspective": []}
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
# Euclidean shapes
# ----------------
#
# With affine cameras the shapes are determined up to an affinity of space;
# ``reconstruct(X, camera="weak_perspective")`` estimates the Euclidean metric
# afterwards. With calibrated cameras the shapes are Euclidean, and each frame has a
# rotation and a scale.

shape = auto.reconstruct(X[:1])[0]
image = auto.scales_[0] * shape @ auto.rotations_[0, :2].T + auto.translation_[0]
off = np.std(image - X[0].reshape(-1, 2)) / auto.scales_[0]
print(f"image of frame 0: off by {off:.3f} of the size of the object")

# %%
# An object and its mirror image in depth have the same images; `AffineNRSfM.mirrored`
# returns the other one. See :doc:`/conventions` for units and ambiguities.
