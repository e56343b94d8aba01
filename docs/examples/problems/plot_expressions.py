"""
Classify expressions in any pose
================================

`AffineNRSfM` is a transformer: in a `Pipeline` with a classifier it predicts
expressions, and `GridSearchCV` selects the number of basis shapes.

The faces are artificial, in different poses. Their label is the strongest expression.
"""

# sphinx_gallery_thumbnail_number = 1
import numpy as np
from sklearn.decomposition import PCA
from sklearn.discriminant_analysis import LinearDiscriminantAnalysis
from sklearn.metrics import ConfusionMatrixDisplay
from sklearn.model_selection import GridSearchCV, cross_val_predict, cross_val_score
from sklearn.pipeline import make_pipeline
from sklearn.preprocessing import StandardScaler

from isa_nrsfm import AffineNRSfM, association
from isa_nrsfm.analysis import AlignedFrames
from isa_nrsfm.datasets import make_face_tracks
from isa_nrsfm.plotting import (
    BasisShapeDisplay,
    CoefficientsDisplay,
    ReprojectionDisplay,
)

faces = make_face_tracks(n_frames=400, n_components=5, random_state=0)
X, labels = faces.data, faces.labels
shown = [np.argmax(faces.strength[:, k]) for k in range(5)]
display = ReprojectionDisplay(
    observed=faces.tracks[shown], reprojected=faces.clean[shown], edges="ibug-68"
).plot(n_columns=5)
for axis, i in zip(display.axes_, shown, strict=True):
    axis.set_title(labels[i])

# %%
# The complete pipeline is cross-validated: the shapes are fitted within each fold, so
# the accuracy applies to new rows. These rows are independent. Where people repeat, use
# ``cv=GroupKFold(3)`` and ``search.fit(X, labels, groups=people)``.

pipeline = make_pipeline(
    AffineNRSfM(random_state=0), StandardScaler(), LinearDiscriminantAnalysis()
)
search = GridSearchCV(pipeline, {"affinenrsfm__n_components": [3, 5, 9]}, cv=3)
search.fit(X, labels)
# Standard error of the share of frames whose label is predicted
error = np.sqrt(search.best_score_ * (1 - search.best_score_) / len(X))
print(search.best_params_, f"accuracy {search.best_score_:.1%} +- {error:.1%}")

# %%
# For comparison, PCA of aligned frames, with the same number of components, and with
# the rank 3 K + 3 of the model.

K = search.best_params_["affinenrsfm__n_components"]
for n_components in (K, 3 * K + 3):
    steps = AlignedFrames(), PCA(n_components), LinearDiscriminantAnalysis()
    accuracy = cross_val_score(make_pipeline(*steps), X, labels, cv=3).mean()
    error = np.sqrt(accuracy * (1 - accuracy) / len(X))
    print(f"PCA with {n_components} components: accuracy {accuracy:.1%} +- {error:.1%}")

# %%
# With many components of PCA, the classifier can separate pose and expression within
# the range of poses of the table:
# :ref:`sphx_glr_gallery_guide_plot_pca_and_fastica.py`.
#
# The confusion matrix of the cross-validated predictions:

predicted = cross_val_predict(search.best_estimator_, X, labels, cv=3)
display = ConfusionMatrixDisplay.from_predictions(
    labels, predicted, xticks_rotation=45, colorbar=False, cmap="Greys"
)
display.figure_.set_layout_engine("constrained")

# %%
# Eta squared is the share of the variance of a coefficient that lies between the
# expressions. The figures show the basis shapes of the two coefficients with the
# largest values, and their distributions.

model = search.best_estimator_[0]
eta_squared = association(model.alpha_, labels, random_state=0).statistic
strongest = eta_squared.argsort()[:-3:-1]
print("eta squared:", eta_squared.round(2))
BasisShapeDisplay.from_estimator(model, components=strongest)

names = [f"alpha {k + 1}" for k in strongest]
CoefficientsDisplay(
    alpha=model.alpha_[:, strongest], y=labels, component_names=names
).plot()
