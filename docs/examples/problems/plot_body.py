"""
The 3D motion of a body from one camera
=======================================

Four people walk, reach and squat in front of a camera, and a tracker detects 17 joints
in each frame. `AffineNRSfM` reconstructs the 3D bodies from these 2D tracks. Affine
cameras would absorb part of the large deformation of bodies; weak-perspective cameras
do not.
"""

# sphinx_gallery_thumbnail_number = 2
import matplotlib.pyplot as plt
import numpy as np
from scipy.spatial.transform import Rotation

from isa_nrsfm import AffineNRSfM
from isa_nrsfm.calibration import canonical_pose
from isa_nrsfm.datasets import make_body_tracks
from isa_nrsfm.metrics import mean_shape_error_3d
from isa_nrsfm.plotting import BasisShapeDisplay, ReprojectionDisplay

bodies = make_body_tracks(n_frames=800, scheme="h36m-17", random_state=0)
model = AffineNRSfM(4, camera="weak_perspective", random_state=0).fit(bodies.data)
height = np.ptp(bodies.shapes[..., 1], axis=1)
shown = [np.flatnonzero(bodies.labels == "walk")[50], height.argmax(), height.argmin()]
display = ReprojectionDisplay.from_estimator(
    model, bodies.data, frames=shown, edges="h36m-17"
)
for axis, i in zip(display.axes_, shown, strict=True):
    axis.set_title(f"{bodies.labels[i]}, frame {i}", fontsize="small")

# %%
# The order of the joints is that of Human3.6M, a layout of `isa_nrsfm.skeletons`. It
# defines the edges, left and right, and the correct mirror image: noses are in front.
# `canonical_pose` turns the mean body upright. Because images do not determine
# rotations that are correlated with the deformation, each frame is rotated onto the
# truth.

pose = canonical_pose(model.mean_shape_, scheme="h36m-17")
found = model.reconstruct(bodies.data) @ pose.rotation.T
size = np.linalg.norm(bodies.shapes) / np.linalg.norm(found)
turned = [
    Rotation.align_vectors(bodies.shapes[i], found[i])[0].apply(size * found[i])
    for i in shown
]
side = [2, 1]  # depth and height: a view that no camera had
display = ReprojectionDisplay(
    observed=bodies.shapes[shown][..., side],
    reprojected=np.array(turned)[..., side],
    edges="h36m-17",
).plot()
for axis, i in zip(display.axes_, shown, strict=True):
    axis.set_title(f"{bodies.labels[i]}, from the side", fontsize="small")

# %%
# Rings are the truth, lines the estimate. The error of all frames, after the best
# rotation and scale of each, compared with the error of a rigid body:

still = np.broadcast_to(model.mean_shape_, found.shape)
for name, shapes in (("found", found), ("standing still", still)):
    error = mean_shape_error_3d(bodies.shapes, shapes, convention="frame")
    print(f"{name:15} {error:.1%} of the size of the body")

# %%
# The first coefficient over the frames, coloured by action. Each person has 200 frames.

_, axis = plt.subplots(figsize=(8, 2.8), layout="constrained")
for name in np.unique(bodies.labels):
    frames = np.flatnonzero(bodies.labels == name)
    axis.scatter(frames, model.alpha_[frames, 0], s=6, label=name)
axis.set(xlabel="frame", ylabel="alpha 1")
axis.legend(loc="center left", bbox_to_anchor=(1, 0.5))

# %%
# The basis shapes, from the front and from the side. ``write_viewer(model, "body.html",
# edges="h36m-17", labels=bodies.labels)`` writes an interactive page. The layout tells
# which way is up. For other points, such as markers of motion capture, set
# ``origin="lower"`` if figures are upside down.

BasisShapeDisplay.from_estimator(model, n_columns=3)
