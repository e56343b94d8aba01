"""
MediaPipe: face mesh and pose
=============================

MediaPipe detects 478 points of a face and 33 points of a body. It writes no files;
scripts often store x and y of each point in a csv file. This example reads such a
file of face meshes, and results of the pose landmarker in memory.

The first block generates 150 face meshes and 300 bodies. All points are linear
combinations of generated landmarks, because the package contains no mesh.
"""

# sphinx_gallery_thumbnail_number = 1
import tempfile
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pandas as pd
from scipy.interpolate import interp1d

from isa_nrsfm import AffineNRSfM
from isa_nrsfm.datasets import make_body_tracks, make_face_tracks
from isa_nrsfm.io import from_mediapipe, read_landmarks
from isa_nrsfm.plotting import BasisShapeDisplay, ReprojectionDisplay
from isa_nrsfm.skeletons import get_skeleton

# The curves of the mesh, along those of the 68 points; 68 to 70 are on the forehead.
RIGHT = [(36, 41, 40, 39), (36, 37, 38, 39), range(17, 22), range(17, 22)]
LEFT = [(45, 46, 47, 42), (45, 44, 43, 42), range(26, 21, -1), range(26, 21, -1)]
HALVES = [(57, 58, 59, 48), (51, 50, 49, 48), (66, 67, 60), (62, 61, 60), (33, 32, 31)]
HALVES = [(68, 69, *range(9)), *HALVES, (68, 70, *range(16, 7, -1)), (57, 56, 55, 54)]
HALVES += [(51, 52, 53, 54), (66, 65, 64), (62, 63, 64), (33, 34, 35)]
CURVES = [*RIGHT, *LEFT, *HALVES, range(27, 31), range(36, 40), range(42, 46)]

faces = make_face_tracks(150, random_state=0).tracks
up = faces[:, 27:28] - faces[:, 33:34]
faces = np.hstack([faces, faces[:, [27, 17, 26]] + up * [[1.0], [0.6], [0.6]]])
rng = np.random.default_rng(0)
mesh = np.einsum("jk,ikd->ijd", rng.dirichlet(np.full(71, 0.05), 478), faces)
mesh_curves = get_skeleton("mediapipe-face-478").curves
for points, along in zip(mesh_curves, CURVES, strict=True):
    place = np.linspace(0, len(along) - 1, len(points))
    curve = interp1d(np.arange(len(along)), faces[:, list(along)], axis=1)
    mesh[:, list(points)] = curve(place)

mesh -= mesh.min(axis=(0, 1))  # into the image
width, height = mesh.max(axis=(0, 1))
names = [f"{axis}_{j}" for j in range(478) for axis in "xy"]
table = pd.DataFrame((mesh / [width, height]).reshape(150, -1), columns=names)
path = Path(tempfile.mkdtemp()) / "mesh.csv"
table.round(5).to_csv(path, index=False)
print(path.read_text()[:60])

# %%
# Face mesh
# ---------
#
# MediaPipe divides x by the width and y by the height of the image. The reader needs
# both, otherwise faces are stretched.

read = read_landmarks(path, "mediapipe", image_size=(width, height))
model = AffineNRSfM(4, camera="weak_perspective", random_state=0).fit(read.points)
BasisShapeDisplay.from_estimator(model, components=[0, 1, 2], n_columns=2)

# %%
# Pose
# ----
#
# `from_mediapipe` reads the objects that a landmarker returns, one for each image. It
# accepts results of faces and hands, too. The visibility of a point is its confidence.

people = make_body_tracks(300, n_people=1, camera="orthographic", random_state=0)
order = [0, 1, 1, 1, 2, 2, 2, 3, 4, 0, 0, 5, 6, 7, 8, 9, 10, 9, 10, 9, 10, 9, 10]
order += [11, 12, 13, 14, 15, 16, 15, 16, 15, 16]
pose = people.tracks[:, order] + rng.normal(0, 2, (300, 33, 2))
results = []
for body in pose / (1920, 1080):
    landmarks = [SimpleNamespace(x=x, y=y, visibility=0.9) for x, y in body]
    results.append(SimpleNamespace(pose_landmarks=[landmarks]))
people = from_mediapipe(results, image_sizes=(1920, 1080))
model = AffineNRSfM(10, camera="orthographic", random_state=0)
model.fit(people.points, point_weight=people.confidence)
ReprojectionDisplay.from_estimator(model, people.points, frames=[0, 100, 180])

# %%
# On the command line::
#
#     isa-nrsfm fit mesh.csv --image-size 1920x1080 --n-components 4 --output out
