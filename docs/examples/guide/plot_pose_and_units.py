"""
Units, true proportions and head pose
=====================================

What are the units of the shapes? Where is the metric size? How is the head turned?
Images alone do not say how large a thing is, nor, in affine cameras, what its angles
and proportions in depth are: see :doc:`/conventions`. This page shows what can be had,
and what for; :doc:`plot_cameras` says which camera to choose.

In short:

- ``motion_`` and ``translation_`` are in the units of the table, pixels for instance.
- ``mean_shape_`` and ``basis_`` have no unit. With affine cameras the mean shape is
  white, and only together with the cameras they are images.
- With cameras taken for weak-perspective ones (photos from afar, square pixels) shapes
  have true proportions, rotations are poses, and only the unit of length is free.
- With orthographic cameras, which have one scale, shapes are in the units of the table.
- One known length, such as the distance of the pupils, gives the unit.
- What remains is the mirror image in depth.
"""

# sphinx_gallery_thumbnail_number = 2
import matplotlib.pyplot as plt
import numpy as np
from scipy.spatial.transform import Rotation

from isa_nrsfm import AffineNRSfM
from isa_nrsfm.calibration import canonical_pose, deformation_metric, euclidean_frames
from isa_nrsfm.datasets import make_face_tracks
from isa_nrsfm.metrics import mean_shape_error_3d

faces = make_face_tracks(n_frames=300, random_state=0)
affine = AffineNRSfM(4, random_state=0).fit(faces.data)
M = affine.mean_shape_
print("mean of b b^T over the points of the mean shape:")
print((M.T @ M / len(M)).round(6))

# %%
# True proportions
# ----------------
#
# A fit with weak-perspective cameras has them, and rotations and scales.

model = AffineNRSfM(4, camera="weak_perspective", random_state=0).fit(faces.data)
shapes = model.reconstruct(faces.data)
error = mean_shape_error_3d(faces.shapes, shapes, convention="frame")
print(f"error of the 3D shapes {error:.2%} of their size")
print(f"noise variance {model.camera_noise_ratio_:.2f} times that of affine cameras")

# %%
# A model with affine cameras gets them afterwards: `AffineNRSfM.reconstruct` with
# ``camera="weak_perspective"`` finds the metric of space in which its cameras are
# scaled rotations. The functions that it uses give rotations and scales.

metric = deformation_metric(affine.motion_, affine.alpha_)
frames = euclidean_frames(
    metric, affine.motion_, affine.alpha_, affine.mean_shape_, affine.basis_
)
error = mean_shape_error_3d(faces.shapes, frames.shapes, convention="frame")
print(f"error of the 3D shapes of affine cameras {error:.2%} of their size")

# %%
# Upright and frontal
# -------------------
#
# `canonical_pose` turns a shape by what is known of its points. For 68 points in the
# order of iBUG the scheme says it; else give pairs of points, such as
# ``left_right=[(right_eye, left_eye)], up=[(chin, nose)], front=[(ears, nose)]``.

pose = canonical_pose(shapes.mean(axis=0), scheme="ibug-68")
before = M - M.mean(axis=0)
_, axes = plt.subplots(1, 4, figsize=(9, 3), layout="constrained")
for shape, (front, side), what in (
    (before, axes[:2], "affine (white)"),
    (pose.shape, axes[2:], "Euclidean, upright"),
):
    front.scatter(shape[:, 0], shape[:, 1], s=6, color="0.2")
    side.scatter(shape[:, 2], shape[:, 1], s=6, color="0.2")
    front.set_title(f"{what}: front", fontsize="small")
    side.set_title("side", fontsize="small")
for axis in axes:
    axis.set(aspect="equal", xticks=[], yticks=[])
    axis.invert_yaxis()

# %%
# Head pose
# ---------
#
# The rotation of a frame, in the axes of the upright face, is the head pose. Turning
# the shape by ``pose.rotation`` turns the rotations by its inverse. A mirror image
# changes the sign of z on both sides, so that rotations stay rotations.

turn = pose.rotation
mirror = np.diag([1.0, 1.0, np.linalg.det(turn)])
found = Rotation.from_matrix(mirror @ model.rotations_ @ turn.T)

# The true rotations, of the true face in the same upright position.
upright = canonical_pose(faces.mean_shape, scheme="ibug-68").rotation
true = Rotation.from_euler("yxz", faces.angles, degrees=True)
true = true * Rotation.from_matrix(upright).inv()
apart = np.rad2deg((found * true.inv()).magnitude())
print(f"head pose: off by {apart.mean():.2f} degrees in the mean of the frames")

_, axes = plt.subplots(1, 3, figsize=(9, 3), layout="constrained")
for found_angle, true_angle, axis, name in zip(
    found.as_euler("yxz", degrees=True).T,
    true.as_euler("yxz", degrees=True).T,
    axes,
    ("yaw", "pitch", "roll"),
    strict=True,
):
    axis.scatter(true_angle, found_angle, s=5, color="0.2")
    axis.set(xlabel=f"true {name}, degrees", ylabel=f"found {name}")

# %%
# Millimetres
# -----------
#
# One known length is enough. Say that the outer corners of the eyes are this far apart:

known = np.linalg.norm(faces.neutral_shape[36] - faces.neutral_shape[45])
corners = pose.shape[36] - pose.shape[45]
millimetres = known / np.linalg.norm(corners)
width = np.ptp(pose.shape[:, 0]) * millimetres
true_width = np.ptp(faces.mean_shape[:, 0])
print(f"width of the face: {width:.1f} mm, in truth {true_width:.1f} mm")

# %%
# How large each frame is in the image, the scale of its camera, is ``scales_`` over
# that: pixels a millimetre. It says how far the camera was, if its focal length
# is known.

scales = model.scales_ / millimetres
print("pixels a millimetre:", scales[:4].round(3))
print("in truth:           ", np.linalg.norm(faces.motion[:4, 0], axis=1).round(3))
