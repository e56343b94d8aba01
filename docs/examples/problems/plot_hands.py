"""
Hand gestures from any side
===========================

Hand trackers give 21 points: the wrist, and four joints of each finger. A classifier of
the points learns the hands as they were held when it was trained. The coefficients of
`AffineNRSfM` do not depend on how the hand is held.

The table is that of hands with three gestures where it is found, see
:doc:`/gallery/index`, and otherwise artificial: hands of 21 joints whose fingers bend,
seen by different cameras.
"""

# sphinx_gallery_thumbnail_number = 2
import os
from pathlib import Path
from timeit import timeit

import matplotlib.pyplot as plt
import numpy as np
from scipy.spatial.transform import Rotation
from sklearn.linear_model import LogisticRegression
from sklearn.model_selection import train_test_split
from sklearn.pipeline import make_pipeline
from sklearn.preprocessing import StandardScaler

from isa_nrsfm import AffineNRSfM
from isa_nrsfm.plotting import BasisShapeDisplay


def artificial_hands(n_frames, rng):
    """Return tracks (n_frames, 21, 2) of hands, and their gestures."""
    gestures = {"open": np.zeros(5), "pointing": [1, 0, 1, 1, 1], "fist": np.ones(5)}
    labels = rng.choice(list(gestures), n_frames)
    tracks = np.zeros((n_frames, 21, 2))
    for i, label in enumerate(labels):
        shape = np.zeros((21, 3))  # y points down, the wrist is at the origin
        for finger in range(5):
            side = (finger - 2) * 0.22
            bend = np.array(gestures[label])[finger] * 0.9 + 0.12 * rng.normal()
            length = 0.6 if finger else 0.4
            joint = length * np.array([np.sin(side), -np.cos(side), 0])
            for k in range(4):
                shape[1 + 4 * finger + k] = joint
                turn = Rotation.from_euler("xz", [-(k + 0.5) * bend, side])
                joint = joint + turn.apply([0, -0.28 + 0.05 * k, 0])
        angles = rng.uniform(-1, 1, 3) * [40, 30, 30]
        camera = Rotation.from_euler("yxz", angles, degrees=True).as_matrix()[:2]
        tracks[i] = shape @ camera.T + 0.005 * rng.normal(size=(21, 2))
    return tracks, labels


path = Path(os.environ.get("ISA_NRSFM_DATA", ""), "hands_kazuhito_21.npz")
if path.is_file():
    print("hands of a tracker, every tenth row")
    with np.load(path) as stored:
        tracks = stored["W2d"][::10]
        labels = stored["label_names"][stored["labels"]][::10]
else:
    print("artificial hands")
    tracks, labels = artificial_hands(400, np.random.RandomState(0))
X = tracks.reshape(len(tracks), 42)
train, test = train_test_split(np.arange(len(X)), stratify=labels, random_state=0)

# Each finger from the wrist, joint by joint.
edges = [(0 if k == 0 else f + k, f + k + 1) for f in range(0, 20, 4) for k in range(4)]
_, axes = plt.subplots(1, 6, figsize=(9, 2.3), layout="constrained")
for axis, i in zip(axes, range(0, len(X), len(X) // 6), strict=False):
    for edge in edges:
        axis.plot(*tracks[i, edge].T, color="0.4", lw=1)
    axis.set(aspect="equal", xticks=[], yticks=[], title=labels[i])
    axis.invert_yaxis()

# %%
# Three basis shapes and the mean shape of a hand, from the front and from the side.
# With 21 points five would be the most.

model = AffineNRSfM(3, random_state=0).fit(X[train])
BasisShapeDisplay.from_estimator(model, edges=edges, n_columns=2)

# %%
# Train on the hands as they were held, test on other hands, held likewise and then
# turned in the image by any angle.

rng = np.random.RandomState(1)
angle = np.deg2rad(rng.uniform(-180, 180, len(test)))
turns = np.array([[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]])
turned = tracks[test] @ turns.transpose(2, 1, 0)
sets = {"as in training": X[test], "turned": turned.reshape(len(test), 42)}

classifiers = {
    "landmarks": make_pipeline(StandardScaler(), LogisticRegression(max_iter=1000)),
    "alpha": make_pipeline(
        AffineNRSfM(3, random_state=0), StandardScaler(), LogisticRegression()
    ),
}
for name, classifier in classifiers.items():
    classifier.fit(X[train], labels[train])
    for how, table in sets.items():
        accuracy = classifier.score(table, labels[test])
        print(f"{name:10} hands {how:15} accuracy {accuracy:.1%}")

# %%
# The gestures in the space of the coefficients.

alpha = model.transform(X[test])
_, axis = plt.subplots(figsize=(5, 4), layout="constrained")
for name in np.unique(labels):
    axis.scatter(*alpha[labels[test] == name, :2].T, s=8, label=name)
axis.set(xlabel="alpha 1", ylabel="alpha 2")
axis.legend()

# %%
# A video needs one frame at a time: how long does one row take?

print(f"{timeit(lambda: model.transform(X[:1]), number=20) / 20:.4f} s a row")
print(f"{timeit(lambda: model.transform(X), number=3) / 3 / len(X):.6f} s in a table")
