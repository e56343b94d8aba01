"""
Hand gestures from any side
===========================

Hand trackers detect 21 points: the wrist, and four points of each finger. A classifier
of the points depends on the orientation of the hands in the training set. The
coefficients of `AffineNRSfM` do not depend on it.

Six people open their hands, close them and point. The classifier is tested on two
people who are not in the training set.
"""

# sphinx_gallery_thumbnail_number = 1
import matplotlib.pyplot as plt
import numpy as np
from sklearn.linear_model import LogisticRegression
from sklearn.pipeline import make_pipeline
from sklearn.preprocessing import StandardScaler

from isa_nrsfm import AffineNRSfM
from isa_nrsfm.datasets import make_hand_tracks
from isa_nrsfm.plotting import BasisShapeDisplay, ReprojectionDisplay

hands = make_hand_tracks(n_frames=900, n_people=6, random_state=0)
train, test = hands.groups < 4, hands.groups >= 4
model = AffineNRSfM(4, random_state=0).fit(hands.data[train])
names = np.unique(hands.labels)
shown = [np.flatnonzero(hands.labels == name)[k] for k in (20, 200) for name in names]
display = ReprojectionDisplay.from_estimator(model, hands.data, frames=shown)
for axis, i in zip(display.axes_, shown, strict=True):
    axis.set_title(f"{hands.labels[i]}, person {hands.groups[i]}", fontsize="small")

# %%
# The number and the order of the points identify hands
# (`isa_nrsfm.skeletons.find_skeleton`). The basis shapes, turned upright:

BasisShapeDisplay.from_estimator(model, n_columns=3)

# %%
# The hands of the other two people are tested twice: as they are, and rotated in the
# image by random angles.

angle = np.random.RandomState(1).uniform(-np.pi, np.pi, test.sum())
turns = np.array([[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]])
turned = hands.tracks[test] @ turns.transpose(2, 1, 0)
sets = {"as in training": hands.data[test], "turned": turned.reshape(len(turned), -1)}
classifier = LogisticRegression(max_iter=1000)
for what, steps in {"landmarks": [], "alpha": [AffineNRSfM(4, random_state=0)]}.items():
    pipeline = make_pipeline(*steps, StandardScaler(), classifier)
    pipeline.fit(hands.data[train], hands.labels[train])
    for how, table in sets.items():
        accuracy = pipeline.score(table, hands.labels[test])
        print(f"{what:10} hands {how:15} accuracy {accuracy:.1%}")

# %%
# The gestures of the two people in the space of the coefficients.

alpha = model.transform(hands.data[test])
_, axis = plt.subplots(figsize=(5, 4), layout="constrained")
for name in names:
    axis.scatter(*alpha[hands.labels[test] == name, :2].T, s=8, label=name)
axis.set(xlabel="alpha 1", ylabel="alpha 2")
axis.legend()
