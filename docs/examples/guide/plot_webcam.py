"""
A face in front of a webcam
===========================

The nose of a face that is 45 cm away is a fifth nearer to the camera than the ears, so
its image is larger. Weak-perspective cameras cannot show this. Their fits explain it
by deformation: the coefficients follow the pose of the head. Pinhole cameras,
``camera="perspective"``, can show it. :doc:`/perspective` says when they matter.

Here a generated face turns by up to 25 degrees, everywhere in the image of a webcam.
"""

import matplotlib.pyplot as plt
import numpy as np
from sklearn.linear_model import LinearRegression

from isa_nrsfm import AffineNRSfM
from isa_nrsfm.datasets import make_face_tracks

faces = make_face_tracks(600, camera="perspective", distance=450, random_state=0)
shown = np.abs(faces.angles[:, 0]) < 25
X, truth, (_, pitch, _) = faces.data[shown], faces.alpha[shown], faces.angles[shown].T
print(f"{len(X)} frames; true focal length {faces.focal_length:.0f} pixels")

# %%
# Perspective cameras need the point of the image on their axis: half of its width and
# height, here (640, 360). The focal length is estimated.

far = AffineNRSfM(4, camera="weak_perspective", random_state=0).fit(X)
near = AffineNRSfM(
    4, camera="perspective", principal_point=(640, 360), random_state=0
).fit(X)
print(f"estimated {near.focal_length_:.1f} +- {near.focal_length_std_:.1f} pixels")

# %%
# The upper row compares estimated and true coefficients. Basis shapes may be mixed, so
# a linear regression expresses each true coefficient by the four estimated ones. The
# lower row shows the coefficient that the pitch predicts best.

_, axes = plt.subplots(2, 2, figsize=(8, 7), layout="constrained", sharey="row")
for name, model, (above, below) in zip(
    ("weak_perspective", "perspective"), (far, near), axes.T, strict=True
):
    found = LinearRegression().fit(model.alpha_, truth).predict(model.alpha_)
    explained = 1 - np.mean((found - truth) ** 2, axis=0)  # true variances are one
    for k, component in enumerate(faces.component_names):
        label = f"{component}, $R^2$ = {explained[k]:.2f}"
        above.scatter(truth[:, k], found[:, k], s=5, label=label)
    above.axline((0, 0), slope=1, color="0.7", zorder=0)
    above.set(title=f'camera="{name}"', xlabel="true coefficient")
    above.legend(fontsize="small", loc="upper left")
    r = [np.corrcoef(pitch, alpha)[0, 1] for alpha in model.alpha_.T]
    k = np.argmax(np.abs(r))
    below.scatter(pitch, model.alpha_[:, k], s=5, color="0.3")
    title = f"alpha {k + 1}, correlation with the pitch {r[k]:.2f}"
    below.set(title=title, xlabel="pitch of the head, degrees")
axes[0, 0].set_ylabel("estimated coefficient")
axes[1, 0].set_ylabel("coefficient")

# %%
# With weak-perspective cameras two of the four expressions are lost, and coefficients
# are poses. With perspective cameras all four expressions are found.
#
# The positions of the face are those in front of the camera. Their unit is that of the
# shapes; one known length, such as the distance of the outer eye corners, determines
# it.

known = np.linalg.norm(faces.mean_shape[36] - faces.mean_shape[45])
unit = known / np.linalg.norm(near.mean_shape_[36] - near.mean_shape_[45])
print("x, y, z in millimetres:", (unit * near.positions_[0]).round(1))
print("in truth:              ", faces.positions[shown][0].round(1))

# %%
# The same on the command line::
#
#     isa-nrsfm fit faces.csv --n-components 4 --camera perspective \
#         --image-size 1280x720 --output out
