"""
What a coefficient says: gestures and people
============================================

Several people open a hand, close it and point. The coefficients of a fit change from
gesture to gesture, and from person to person: hands have fingers of different lengths.
Which coefficient says what? `isa_nrsfm.analysis` tells it in numbers.
:doc:`/questions` says what they mean.
"""

# sphinx_gallery_thumbnail_number = 1
import matplotlib.pyplot as plt
import numpy as np
from sklearn.decomposition import PCA

from isa_nrsfm import AffineNRSfM
from isa_nrsfm.analysis import (
    AlignedFrames,
    WithinGroups,
    association,
    between_share,
    predictability,
)
from isa_nrsfm.datasets import make_hand_tracks
from isa_nrsfm.plotting import BasisShapeDisplay, CoefficientsDisplay

hands = make_hand_tracks(n_frames=600, n_people=6, random_state=0)
people = np.array(["Ada", "Ben", "Cyd", "Dan", "Eve", "Fay"])[hands.groups]
model = AffineNRSfM(5, independence="coefficients", random_state=0).fit(hands.data)

_, axes = plt.subplots(5, 2, figsize=(9, 8), sharex="col", layout="constrained")
for label, y, column in (("gesture", hands.labels, 0), ("person", people, 1)):
    CoefficientsDisplay.from_estimator(model, y=y, label=label, ax=axes[:, column])

# %%
# In numbers
# ----------
#
# Eta squared is the share of the variance of a coefficient that lies between the
# gestures. For the p-values labels are permuted among people, and in blocks of frames
# within them: the frames of a video are alike. `between_share` says the same of people:
# about zero where they do not differ.

found = association(model.alpha_, hands.labels, people, random_state=0)
share = between_share(model.alpha_, people)
print("alpha   gesture (p)      person")
for k in range(5):
    gesture = f"{found.statistic[k]:.2f} ({found.p_value[k]:.3f})"
    print(f"{k + 1:5}   {gesture:16} {share.between[k]:.2f}")

# %%
# Small p-values alone say little: with many frames, small effects are certain, too. The
# sizes tell that the first two are gestures, and the others mostly people. So they
# look:

BasisShapeDisplay.from_estimator(model, n_columns=3)

# %%
# All coefficients together
# -------------------------
#
# How well do they tell the gestures of people who were not trained on? As many
# components of PCA of the aligned frames see the same table. Relative to the mean of
# their person, coefficients have lost what the person looks like. Three gestures are
# easily told, by all of them; of seven expressions of faces the first two tell more
# than PCA does (:doc:`/questions`).

features = {
    "alpha": model.alpha_,
    "alpha, relative to the person": WithinGroups().fit_transform(
        model.alpha_, groups=people
    ),
    "PCA of aligned frames": PCA(5).fit_transform(
        AlignedFrames().fit_transform(hands.data)
    ),
}
for name, values in features.items():
    scores = predictability(values, hands.labels, people, random_state=0)
    print(f"{name:30} accuracy {scores.mean():.1%}")
