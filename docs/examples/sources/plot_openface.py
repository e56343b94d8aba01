"""
OpenFace: opening of the mouth
==============================

OpenFace writes a csv file with 68 points per frame of a video. This example measures
the opening of the mouth in 3D, where it does not depend on the head pose.

The first block writes a file of 200 frames, as ``FeatureExtraction -2Dfp`` does.
OpenFace lost the face in two of the frames (``success`` is 0).
"""

# sphinx_gallery_thumbnail_number = 1
import tempfile
from pathlib import Path

import matplotlib.pyplot as plt
import numpy as np
import pandas as pd

from isa_nrsfm import AffineNRSfM
from isa_nrsfm.datasets import make_face_tracks
from isa_nrsfm.export import point_distances
from isa_nrsfm.io import read_landmarks

truth = make_face_tracks(200, random_state=0)
points = truth.tracks.transpose(0, 2, 1).reshape(200, 136).round(1)
names = [f"{axis}_{j}" for axis in "xy" for j in range(68)]
table = pd.DataFrame(points, columns=names)
table.insert(0, "frame", np.arange(1, 201))
table.insert(1, "face_id", 0)
table.insert(2, "timestamp", (np.arange(200) / 30).round(3))
table.insert(3, "confidence", np.where(np.isin(np.arange(200), [50, 51]), 0.02, 0.98))
table.insert(4, "success", (table["confidence"] > 0.5).astype(int))
path = Path(tempfile.mkdtemp()) / "openface.csv"
table.to_csv(path, index=False)
print(path.read_text()[:75])

# %%
# The reader recognises the format. The two frames without a face have no points, and
# their results are NaN.

faces = read_landmarks(path)
seen = ~faces.failed
model = AffineNRSfM(4, camera="weak_perspective", random_state=0)
model.fit(faces.points[seen])
opening = point_distances(model, [(62, 66)], faces.points)[:, 0]
print(f"{faces.failed.sum()} frames without a face, {np.isnan(opening).sum()} NaN")

# %%
# The distance of the lips in the image depends on the pose, even relative to the
# distance of the eyes. The distance in 3D does not: it follows the true opening.

lips = np.linalg.norm(truth.tracks[:, 62] - truth.tracks[:, 66], axis=1)
eyes = np.linalg.norm(truth.tracks[:, 36] - truth.tracks[:, 45], axis=1)
figure, axes = plt.subplots(1, 2, figsize=(7, 3.2), layout="constrained", sharey=True)
for axis, name, found in zip(
    axes, ["in the image", "in 3D"], [lips / eyes, opening], strict=True
):
    r = np.corrcoef(found[seen], truth.alpha[seen, 0])[0, 1]
    axis.scatter(truth.alpha[:, 0], found, s=8)
    axis.set(title=f"{name}, correlation {r:.3f}", xlabel="true opening of the jaw")
axes[0].set_ylabel("lips, in distances of the eyes")

# %%
# The same on the command line::
#
#     isa-nrsfm fit openface.csv --n-components 4 --distance 62,66 --output out
