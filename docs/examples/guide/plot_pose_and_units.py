"""
Units, true proportions and head pose
=====================================

What are the units of the shapes? Where is the metric size? How is the head turned?
Images do not determine the size of an object. With affine cameras, they do not
determine its angles and proportions in depth either: see :doc:`/conventions`. This page
shows how to obtain them; :doc:`plot_cameras` compares the cameras.

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
from isa_nrsfm.calibration import canonical_pose, view_angles
from isa_nrsfm.datasets import make_face_tracks
from isa_nrsfm.export import frame_poses, point_distances
from isa_nrsfm.metrics import mean_shape_error_3d

faces = make_face_tracks(n_frames=300, random_state=0)
affine = AffineNRSfM(4, random_state=0).fit(faces.data)
model = AffineNRSfM(4, camera="weak_perspective", random_state=0).fit(faces.data)
print(f"noise variance {model.camera_noise_ratio_:.2f} times that of affine cameras")

# %%
# True proportions
# ----------------
#
# A fit with weak-perspective cameras has them, and rotations and scales. A model with
# affine cameras gets them afterwards: `AffineNRSfM.reconstruct` with
# ``camera="weak_perspective"`` finds the metric of space in which its cameras are
# scaled rotations.

for name, each in (("weak perspective", model), ("affine", affine)):
    shapes = each.reconstruct(faces.data, camera="weak_perspective")
    error = mean_shape_error_3d(faces.shapes, shapes, convention="frame")
    print(f"{name:17} error of the 3D shapes {error:.2%} of their size")

# %%
# Upright and frontal
# -------------------
#
# `canonical_pose` turns a shape upright. For :doc:`known layouts </skeletons>` set the
# scheme; for others give pairs of points, such as ``left_right=[(right_eye, left_eye)],
# up=[(chin, nose)], front=[(ears, nose)]``. The mean shape of affine cameras is white;
# the Euclidean one is a face.

upright = canonical_pose(model.mean_shape_, scheme="ibug-68").shape
_, axes = plt.subplots(1, 4, figsize=(9, 3), layout="constrained")
for k, (shape, what) in enumerate(
    ((affine.mean_shape_, "white"), (upright, "upright"))
):
    for axis, column, side in ((axes[2 * k], 0, "front"), (axes[2 * k + 1], 2, "side")):
        axis.scatter(shape[:, column], shape[:, 1], s=6, color="0.2")
        axis.set(aspect="equal", xticks=[], yticks=[], title=f"{what}, {side}")
        axis.invert_yaxis()

# %%
# Head pose
# ---------
#
# `frame_poses` has yaw, pitch and roll in degrees, all zero for a frontal, upright
# face. Yaw is positive where the face is turned to the viewer's right, pitch where it
# looks up, roll where it is turned clockwise in the image (:doc:`/conventions`). The
# true angles are those of the true face, upright by the same definition.
#
# Bars, which are hardly visible, are two standard deviations. They come from the
# posterior of the rotation of a frame, for the given shapes; only calibrated cameras
# have them. :doc:`/questions` has their accuracy on other faces.

poses = frame_poses(model, faces.data)
turn = canonical_pose(faces.mean_shape, scheme="ibug-68").rotation
true = Rotation.from_euler("yxz", faces.angles, degrees=True).as_matrix() @ turn.T
_, axes = plt.subplots(1, 3, figsize=(9, 3), layout="constrained")
for axis, name in zip(axes, ("yaw", "pitch", "roll"), strict=True):
    true_angle = getattr(view_angles(true), name)
    found, deviation = getattr(poses, name), getattr(poses, f"{name}_std")
    axis.errorbar(true_angle, found, 2 * deviation, fmt=".", ms=3, lw=1, color="0.2")
    axis.axline((0, 0), slope=1, color="tab:blue", zorder=0)
    axis.set(xlabel=f"true {name}, degrees", ylabel=f"found {name}")
    print(f"{name:5} off by {np.median(abs(found - true_angle)):.2f} degrees", end=", ")
    print(f"deviation {np.median(deviation):.2f}")

# %%
# Millimetres
# -----------
#
# One known length is enough. `point_distances` measures the shape of each frame, in
# units of that length: here the outer corners of the eyes, 36 and 45, have their true
# distance in the mean face, and the opening of the mouth, 62 to 66, is wanted.

known = np.linalg.norm(faces.mean_shape[36] - faces.mean_shape[45])
found = point_distances(model, [(62, 66)], unit=(36, 45), length=known)[:, 0]
true = np.linalg.norm(faces.shapes[:, 62] - faces.shapes[:, 66], axis=1)
print("mouth open by, mm:", found[:5].round(1))
print("in truth:         ", true[:5].round(1))

# %%
# How large each frame is in the image, ``poses.scale``, over the unit in millimetres is
# pixels a millimetre. If the focal length is known, it gives the distance of the
# camera.
