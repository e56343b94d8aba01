"""
COCO-17: how far do people squat?
=================================

Most body detectors write the 17 keypoints of COCO, as json results with a score for
each point. This example measures the distance from hip to ankle in 3D.

The first block writes results for 300 images. The scores of a tenth of the points are
low, and their positions are inaccurate.
"""

# sphinx_gallery_thumbnail_number = 2
import json
import tempfile
from pathlib import Path

import matplotlib.pyplot as plt
import numpy as np

from isa_nrsfm import AffineNRSfM
from isa_nrsfm.datasets import make_body_tracks
from isa_nrsfm.export import point_distances
from isa_nrsfm.io import read_landmarks
from isa_nrsfm.plotting import ReprojectionDisplay

truth = make_body_tracks(300, n_people=1, camera="orthographic", random_state=0)
rng = np.random.default_rng(0)
score = np.where(rng.random((300, 17)) < 0.1, 0.1, 0.9)
noise = rng.normal(0, 5, (300, 17, 2)) * (score < 0.5)[..., None]
keypoints = np.dstack([truth.tracks + noise, score]).round(2).reshape(300, -1)
results = [
    {"image_id": i, "category_id": 1, "keypoints": row.tolist(), "score": 0.9}
    for i, row in enumerate(keypoints)
]
path = Path(tempfile.mkdtemp()) / "results.json"
path.write_text(json.dumps(results))
print(path.read_text()[:75])

# %%
# The scores are weights of the points in the fit: an uncertain point counts less. The
# camera stays at the same distance, so that orthographic cameras are suitable.

people = read_landmarks(path)
model = AffineNRSfM(10, camera="orthographic", random_state=0)
model.fit(people.points, point_weight=people.confidence)
ReprojectionDisplay.from_estimator(
    model, people.points, frames=[0, 100, 180], edges="coco-17"
)

# %%
# Distances of the left hip (11) and ankle (15), in lengths of the trunk (5 to 11):

leg = point_distances(model, [(11, 15)], people.points, unit=(5, 11))[:, 0]
true = np.linalg.norm(truth.shapes[:, 11] - truth.shapes[:, 15], axis=1)
_, axis = plt.subplots(figsize=(6, 3), layout="constrained")
for action in np.unique(truth.labels):
    of_action = truth.labels == action
    axis.scatter(true[of_action], leg[of_action], s=8, label=action)
axis.set(xlabel="true distance, mm", ylabel="found, in lengths of the trunk")
axis.legend()

# %%
# The same on the command line::
#
#     isa-nrsfm fit results.json --weights confidence --n-components 10 \
#         --camera orthographic --distance 11,15 --unit 5,11 --output out
