"""
Real hands before a webcam
==========================

445 hands that MediaPipe found in images of a webcam: open, closed, or pointing. The
wrist is the origin, and the largest coordinate of each hand is one. The table is that
of `hand-gesture-recognition-using-mediapipe
<https://github.com/Kazuhito00/hand-gesture-recognition-using-mediapipe>`_ by Kazuhito
Takahashi (Apache-2.0), every tenth row.

``isa-nrsfm fit hands.csv -o out`` decides on the settings by held-out points. So does
`AutoNRSfM`. No setting is named here.
"""

import matplotlib.pyplot as plt
import numpy as np
from sklearn.decomposition import PCA
from sklearn.discriminant_analysis import LinearDiscriminantAnalysis
from sklearn.model_selection import KFold, cross_val_score

from isa_nrsfm import AffineNRSfM, AutoNRSfM
from isa_nrsfm.plotting import BasisShapeDisplay, ReprojectionDisplay

data = np.load("../../../tests/data/hands_kazuhito_21.npz")
X = data["W2d"].reshape(len(data["W2d"]), -1).astype(float)
gesture = data["label_names"][data["labels"]]
auto = AutoNRSfM(AffineNRSfM(random_state=0)).fit(X)
model = auto.best_estimator_
print(*auto.trials_, sep="\n")

# %%
# The verdicts, from points that the fit of their frame has not seen:

print(model.diagnostics(X))

# %%
# Hands and their fits, and the movements that explain most:

ReprojectionDisplay.from_estimator(model, X, random_state=0)
BasisShapeDisplay.from_estimator(model, components=range(3), n_columns=3)

# %%
# Gestures of left-out rows, predicted from the coefficients, and from as many
# principal components of the points:

K = auto.n_components_
for name, features in (("alpha", model.alpha_), ("PCA", PCA(K).fit_transform(X))):
    folds = KFold(5, shuffle=True, random_state=0)
    scores = cross_val_score(LinearDiscriminantAnalysis(), features, gesture, cv=folds)
    print(f"{name:6} accuracy {scores.mean():.1%}")

# %%
# The first two coefficients:

_, axis = plt.subplots(figsize=(5, 4), layout="constrained")
for name in data["label_names"]:
    axis.scatter(*model.alpha_[gesture == name, :2].T, s=8, label=name)
axis.set(xlabel="alpha_1", ylabel="alpha_2")
axis.legend()
plt.show()
