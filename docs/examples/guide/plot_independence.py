"""
Which basis shapes: independence
================================

Images determine only the span of the basis shapes: for example, they do not distinguish
a smile and an open mouth from their sum and difference. The parameter `independence` of
`AffineNRSfM` selects a basis of the span:

- ``"shapes"``, the default: the basis shapes are independent over the points, as the
  paper assumes.
- ``"coefficients"``: the coefficients are independent over the frames. Use it if the
  deformations occur independently of each other.
- ``None``: the principal axes of the deformation.

The faces are artificial, and their expressions are drawn independently of each other.
"""

# sphinx_gallery_thumbnail_number = 1
import matplotlib.pyplot as plt
import numpy as np

from isa_nrsfm import AffineNRSfM
from isa_nrsfm.datasets import make_face_tracks
from isa_nrsfm.plotting import BasisShapeDisplay

K = 6
faces = make_face_tracks(n_frames=400, n_components=K, random_state=0)
print(f"{'':13}", faces.component_names)
for independence in (None, "shapes", "coefficients"):
    model = AffineNRSfM(K, independence=independence, random_state=0).fit(faces.data)
    correlation = np.corrcoef(faces.alpha.T, model.alpha_.T)[:K, K:]
    print(f"{independence!s:13}", np.abs(correlation).max(axis=1).round(2))

names = [faces.component_names[np.abs(c).argmax()] for c in correlation.T]
BasisShapeDisplay.from_estimator(model, component_names=names, n_columns=3)

# %%
# The output lists the largest correlation of each true expression with a coefficient.
# With independent coefficients, each expression corresponds to one coefficient. The
# figure shows their basis shapes from the front and from the side. Affine cameras
# determine shapes up to an affinity of space; for the figure, weak-perspective cameras
# are assumed.
#
# Each coefficient measures the strength of one expression:

_, axes = plt.subplots(2, 3, figsize=(9, 5), layout="constrained")
for k, axis in enumerate(axes.flat):
    found = np.abs(correlation[k]).argmax()
    axis.scatter(faces.strength[:, k], model.alpha_[:, found], s=5, color="0.2")
    axis.set(xlabel=f"true {faces.component_names[k]}", ylabel=f"alpha_[:, {found}]")

# %%
# In real faces nothing is completely independent. :doc:`/questions` compares both
# choices by means of labels and people.
