"""
Missing points and outliers
===========================

A missing point is NaN in both columns. Rows with missing points are kept, and nothing
is filled in before the fit: missing points have weight zero.
"""

import matplotlib.pyplot as plt
import numpy as np

from isa_nrsfm import AffineNRSfM
from isa_nrsfm.datasets import make_face_tracks
from isa_nrsfm.metrics import affine_shape_error

K = 4


def error_3d(model, faces):
    """Return the error of the 3D shapes of all frames, a share of their size."""
    return affine_shape_error(faces.shapes, model.reconstruct(faces.data))


shares = [0.0, 0.2, 0.5]
for share in shares:
    faces = make_face_tracks(n_frames=200, missing=share, random_state=0)
    model = AffineNRSfM(K, random_state=0).fit(faces.data)
    filled = model.reproject(faces.data).reshape(faces.tracks.shape)
    hidden = ~faces.visible
    missed = np.linalg.norm((filled - faces.clean)[hidden], axis=-1)
    print(f"{share:4.0%} missing: error of the 3D shapes {error_3d(model, faces):.2%}")
    if share:
        print(f"     of the missing points {missed.mean():.2f} pixels")
print(f"noise: {np.sqrt(faces.noise_variance):.2f} pixels in x and in y")

# %%
# The errors grow because fewer points determine the coefficients less well;
# ``alpha_std_`` has their uncertainty. These are the rows with most and fewest points:

order = np.argsort(faces.visible.sum(axis=1))
for i in (order[-1], order[0]):
    print(faces.visible[i].sum(), "points, deviations", model.alpha_std_[i].round(3))

# %%
# What is needed
# --------------
#
# - Rows without any point, where tracking failed, are left out of the fit with a
#   warning, and have NaN in ``alpha_``.
# - Another row needs four points that are not on one line, else its camera is not
#   determined. `AffineNRSfM.fit` names rows that show less, `AffineNRSfM.transform`
#   returns NaN for them.
# - Each point has to be seen in some frames; the error names the first that is not.
# - A point with only one coordinate counts as not seen, with a warning.
# - Zeros for points that were not seen, as some programs write them, have to be made
#   NaN: ``landmark_table(frame, missing="zeros")``, or ``--zeros-missing`` on the
#   command line.
# - Points that are *always* missing together with a pose (the far ear of a profile) are
#   no problem as long as other frames show them.
#
# Outliers
# --------
#
# Detectors sometimes put points far off. ``model.diagnostics(X)`` and the report name
# rows and points that are. Squares of such errors lead a fit astray;
# ``loss="huber"`` and ``loss="cauchy"`` count points less the farther they are from the
# model, the second hardly at all. Here 2 % of the points are anywhere within the face.

faces = make_face_tracks(n_frames=200, random_state=0)
rng = np.random.RandomState(0)
wrong = rng.uniform(size=faces.visible.shape) < 0.02
size = np.sqrt(np.mean((faces.tracks - faces.tracks.mean(1, keepdims=True)) ** 2))
tracks = faces.tracks + wrong[..., None] * rng.uniform(-2, 2, faces.tracks.shape) * size
X = tracks.reshape(faces.data.shape)

results = {}
for loss in ("linear", "huber", "cauchy"):
    model = AffineNRSfM(K, loss=loss, random_state=0).fit(X)
    results[loss] = affine_shape_error(faces.shapes, model.reconstruct(X))
    print(f"loss={loss!r:9} error of the 3D shapes {results[loss]:.2%}")

# %%
# The points that do not fit stand out: the distance from the reprojection finds them.

distance = np.linalg.norm(model.reproject(X).reshape(tracks.shape) - tracks, axis=-1)
_, axis = plt.subplots(figsize=(6, 3), layout="constrained")
bins = np.geomspace(0.03, 1000, 60)
axis.hist(distance[~wrong], bins, color="0.6", label="good points")
axis.hist(distance[wrong], bins, color="tab:red", label="wrong points")
axis.set(xscale="log", yscale="log", xlabel="distance from the model, pixels")
axis.legend()

# %%
# Rows that are wrong as a whole, of another object or a failed detection, show in the
# inverse SNR of the frame, which ``cameras.csv`` of the command line has in a column.
# Leave them out and fit again.
