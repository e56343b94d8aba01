"""
Classify expressions in any pose
================================

A table of landmarks, a column of labels: which expression is it? `AffineNRSfM` is a
transformer, so it goes into a `Pipeline`, and `GridSearchCV` chooses the number of
basis shapes together with the classifier.

The table is that of photos with five expressions where it is found, see
:doc:`/gallery/index`, and otherwise artificial: faces in any pose, labelled by the
strongest of their expressions.
"""

# sphinx_gallery_thumbnail_number = 2
import os
from pathlib import Path

import matplotlib.pyplot as plt
import numpy as np
from sklearn.decomposition import PCA
from sklearn.discriminant_analysis import LinearDiscriminantAnalysis
from sklearn.feature_selection import f_classif
from sklearn.metrics import ConfusionMatrixDisplay
from sklearn.model_selection import (
    GridSearchCV,
    cross_val_predict,
    cross_val_score,
)
from sklearn.pipeline import make_pipeline
from sklearn.preprocessing import FunctionTransformer, StandardScaler

from isa_nrsfm import AffineNRSfM
from isa_nrsfm.datasets import make_face_tracks
from isa_nrsfm.plotting import BasisShapeDisplay

path = Path(os.environ.get("ISA_NRSFM_DATA", ""), "expressions_dlib_68.npz")
if path.is_file():
    print("photos with five expressions, landmarks by a detector")
    with np.load(path) as stored:
        X, labels = stored["W2d"].reshape(-1, 136), stored["labels"]
else:
    print("artificial faces, the strongest of their expressions being the label")
    faces = make_face_tracks(n_frames=400, n_components=5, random_state=0)
    X = faces.data
    labels = np.array(faces.component_names)[faces.strength.argmax(axis=1)]
for name, count in zip(*np.unique(labels, return_counts=True), strict=True):
    print(f"{name:12} {count}")

# %%
# The whole pipeline is searched: the shapes are fitted inside of each fold, so that the
# accuracy is that for new rows.

pipeline = make_pipeline(
    AffineNRSfM(random_state=0), StandardScaler(), LinearDiscriminantAnalysis()
)
search = GridSearchCV(pipeline, {"affinenrsfm__n_components": [3, 5, 9]}, cv=3)
search.fit(X, labels)
print(search.best_params_, f"accuracy {search.best_score_:.1%}")

# %%
# PCA of the table, with as many components and with as many as the model has, for
# comparison. Frames are centred and scaled first, which `AffineNRSfM` does by itself.


def normalised(table):
    """Return a table with each frame centred and of size one."""
    points = table.reshape(len(table), -1, 2)
    points = points - points.mean(axis=1, keepdims=True)
    size = np.linalg.norm(points, axis=(1, 2), keepdims=True)
    return (points / size).reshape(table.shape)


K = search.best_params_["affinenrsfm__n_components"]
for n_components in (K, 3 * K + 3):
    accuracy = cross_val_score(
        make_pipeline(
            FunctionTransformer(normalised),
            PCA(n_components),
            StandardScaler(),
            LinearDiscriminantAnalysis(),
        ),
        X,
        labels,
        cv=3,
    )
    print(f"PCA with {n_components} components: accuracy {accuracy.mean():.1%}")

# %%
# Many components of PCA let the classifier undo the mixing of pose and expression, as
# far as the poses of the table go:
# :ref:`sphx_glr_gallery_guide_plot_pca_and_fastica.py`.
#
# Which are confused? Rows that no fit has seen, fold by fold.

predicted = cross_val_predict(search.best_estimator_, X, labels, cv=3)
display = ConfusionMatrixDisplay.from_predictions(
    labels, predicted, xticks_rotation=45, colorbar=False, cmap="Greys"
)
display.figure_.set_layout_engine("constrained")

# %%
# New rows get their label from the fitted search, with one row or with many: the
# result for a row never depends on the others.

print(search.predict(X[:3]), labels[:3])

# %%
# What tells the expressions apart are coefficients, and each is a basis shape that can
# be looked at. This one differs most between the classes (F statistic).

model = search.best_estimator_[0]
strongest = f_classif(model.alpha_, labels)[0].argmax()
BasisShapeDisplay.from_estimator(model, components=[strongest])

# %%
# Its coefficient in each class:

_, axis = plt.subplots(figsize=(6, 3), layout="constrained")
names = np.unique(labels)
axis.boxplot([model.alpha_[labels == name, strongest] for name in names])
axis.set(ylabel=f"alpha_[:, {strongest}]")
axis.set_xticks(np.arange(len(names)) + 1, names)
