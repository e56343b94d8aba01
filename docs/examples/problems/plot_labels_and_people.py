"""
Relate coefficients to gestures and people
==========================================

Several people open a hand, close it and point. The coefficients of a fit depend on the
gesture and on the person, because fingers have different lengths. `isa_nrsfm.analysis`
measures this dependence; :doc:`/questions` explains the statistics.
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
# Statistics
# ----------
#
# Eta squared is the share of the variance of a coefficient that lies between the
# gestures. For the p-values, labels are permuted between people; within people the
# frequencies of the coefficients are tested, because the frames of a video are similar.
# `between_share` is the share of the variance between people.

found = association(model.alpha_, hands.labels, people, random_state=0)
share = between_share(model.alpha_, people)
print("alpha   gesture (p)      person")
for k in range(5):
    gesture = f"{found.statistic[k]:.2f} ({found.p_value[k]:.3f})"
    print(f"{k + 1:5}   {gesture:16} {share.between[k]:.2f}")

# %%
# With many frames, small effects are significant, so consider the effect sizes. The
# first two coefficients describe gestures; the others depend on the person only. The
# basis shapes:

BasisShapeDisplay.from_estimator(model, n_columns=3)

# %%
# All coefficients together
# -------------------------
#
# How well do all coefficients predict the gestures of new people? The baselines are PCA
# of the aligned frames with the same number of components, and with 3 K + 3, the rank
# of the model. `WithinGroups` subtracts the mean coefficients of each person. Three
# gestures are easy to predict with any of these features. For seven expressions of
# faces, coefficients are better than PCA with as many components, and those relative to
# the person are better than PCA with 3 K + 3, too (:doc:`/questions`).

aligned = PCA(18).fit_transform(AlignedFrames().fit_transform(hands.data))
features = {
    "alpha": model.alpha_,
    "alpha, relative to the person": WithinGroups().fit_transform(
        model.alpha_, groups=people
    ),
    "PCA, 5 components": aligned[:, :5],
    "PCA, 18 components": aligned,
}
for name, values in features.items():
    scores = predictability(values, hands.labels, people, random_state=0)
    error = scores.std(ddof=1) / np.sqrt(len(scores))
    print(f"{name:30} accuracy {scores.mean():.1%} +- {error:.1%}")
