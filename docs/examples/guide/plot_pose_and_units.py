"""
Units, true proportions and head pose
=====================================

Images do not determine the size of an object. With affine cameras, they do not
determine its angles and proportions in depth either (:doc:`/conventions`). This page
shows how to obtain true proportions, head pose and millimetres; :doc:`plot_cameras`
compares the cameras.

Summary:

- ``motion_`` and ``translation_`` are in the units of the table, such as pixels.
- ``mean_shape_`` and ``basis_`` are dimensionless. With affine cameras the mean shape
  is white, and its proportions are not those of the object.
- With weak-perspective cameras (distant camera, square pixels), shapes have true
  proportions, and rotations are poses. The unit of length is undetermined.
- With orthographic cameras, shapes are in the units of the table.
- One known length, such as the distance of the pupils, determines the unit.
- The mirror image in depth is undetermined, unless hidden points or perspective decide.
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
# The shapes of a fit with weak-perspective cameras have true proportions. For a fit
# with affine cameras, `AffineNRSfM.reconstruct` with ``camera="weak_perspective"``
# estimates the metric in which the cameras are scaled rotations.

for name, each in (("weak perspective", model), ("affine", affine)):
    shapes = each.reconstruct(faces.data, camera="weak_perspective")
    error = mean_shape_error_3d(faces.shapes, shapes, convention="frame")
    print(f"{name:17} error of the 3D shapes {error:.2%} of their size")

# %%
# Upright and frontal
# -------------------
#
# `canonical_pose` turns a shape upright. For :doc:`known layouts </skeletons>` set
# `scheme`; for others set pairs of points, such as ``left_right=[(right_eye,
# left_eye)], up=[(chin, nose)], front=[(ears, nose)]``. The figure compares the white
# mean shape of affine cameras with the upright Euclidean mean shape.

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
# `frame_poses` returns yaw, pitch and roll in degrees; :doc:`/conventions` defines
# their signs. The true angles are those of the true face, made upright in the same way.
#
# Bars are two standard deviations. They include the uncertainty of the shapes and
# require calibrated cameras (:doc:`/depth`). :doc:`/questions` describes the accuracy
# on other faces.

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
# `point_distances` returns distances in the shape of each frame, scaled by one known
# length. Here the known length is the distance of the outer eye corners, 36 and 45, in
# the mean shape. The distance of points 62 and 66 is the opening of the mouth.

known = np.linalg.norm(faces.mean_shape[36] - faces.mean_shape[45])
found = point_distances(model, [(62, 66)], unit=(36, 45), length=known)[:, 0]
true = np.linalg.norm(faces.shapes[:, 62] - faces.shapes[:, 66], axis=1)
print("mouth open by, mm:", found[:5].round(1))
print("in truth:         ", true[:5].round(1))

# %%
# ``poses.scale`` is the scale of each frame in pixels per unit of the shapes. Divided
# by the unit in millimetres, it is in pixels per millimetre. If the focal length is
# known, it determines the distance of the camera.
