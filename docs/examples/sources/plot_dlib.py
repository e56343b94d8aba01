"""
dlib: head pose in photos
=========================

dlib finds 68 points of a face. They are often stored as iBUG ``.pts`` files, one for
each photo. This example estimates the head pose in each photo.

The first block writes a folder of 150 such files.
"""

# sphinx_gallery_thumbnail_number = 1
import tempfile
from pathlib import Path

import matplotlib.pyplot as plt

from isa_nrsfm import AffineNRSfM
from isa_nrsfm.datasets import make_face_tracks
from isa_nrsfm.export import frame_poses
from isa_nrsfm.io import read_landmarks

truth = make_face_tracks(150, random_state=0)
folder = Path(tempfile.mkdtemp())
for i, face in enumerate(truth.tracks):
    rows = "\n".join(f"{x:.6f} {y:.6f}" for x, y in face)
    text = f"version: 1\nn_points: {len(face)}\n{{\n{rows}\n}}\n"
    (folder / f"photo{i}.pts").write_text(text)
print((folder / "photo0.pts").read_text()[:60])

# %%
# The reader sorts the names of the files by their numbers: ``photo2.pts`` before
# ``photo10.pts``. The angles have standard deviations.

photos = read_landmarks(folder)
model = AffineNRSfM(4, camera="weak_perspective", random_state=0).fit(photos.points)
poses = frame_poses(model, photos.points)
for i in range(3):
    name = photos.frames["file"][i]
    print(f"{name}: yaw {poses.yaw[i]:.1f}, standard deviation {poses.yaw_std[i]:.1f}")

# %%
# The generated angles have the opposite signs. The zero of the pitch is a matter of
# definition: here a face is upright if its layout is
# (`isa_nrsfm.calibration.canonical_pose`).

_, axes = plt.subplots(1, 2, figsize=(7, 3.2), layout="constrained")
angles = {"yaw": poses.yaw, "pitch": poses.pitch}
for axis, (name, found), true in zip(
    axes, angles.items(), -truth.angles.T[:2], strict=True
):
    axis.scatter(true, found, s=8)
    axis.set(title=name, xlabel="true angle, degrees")
axes[0].set_ylabel("found angle, degrees")

# %%
# The same on the command line, which writes the angles to ``cameras.csv``::
#
#     isa-nrsfm fit photos/ --n-components 4 --output out
#
# Tables with columns ``x_0, y_0, x_1, ...`` are read in the same way:
# ``read_landmarks("dlib.csv")``.
