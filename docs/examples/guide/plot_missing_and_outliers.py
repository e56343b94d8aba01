"""
Missing points and outliers
===========================

A missing point is NaN in both columns. Rows with missing points are used in the fit;
missing points have weight zero.
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
# The errors increase because fewer points determine the coefficients less well.
# ``alpha_std_`` contains the standard deviations of the coefficients. These are the
# rows with most and fewest points:

order = np.argsort(faces.visible.sum(axis=1))
for i in (order[-1], order[0]):
    print(faces.visible[i].sum(), "points, deviations", model.alpha_std_[i].round(3))

# %%
# Requirements
# ------------
#
# - Rows without any point are left out of the fit with a warning; their ``alpha_`` is
#   NaN.
# - Other rows need at least four visible points that determine a camera
#   (:doc:`/conventions`). Otherwise `AffineNRSfM.fit` raises an error that names the
#   first such row, and `AffineNRSfM.transform` returns NaN.
# - Each point must be visible in several frames; the error names the first point that
#   is not.
# - A point with only one coordinate counts as missing, with a warning.
# - Some programs write zeros or -1 for missing points. Convert them to NaN with
#   ``landmark_table(frame, missing=0)`` or ``missing=-1``, on the command line
#   with ``--zeros-missing`` or ``--missing-value -1``.
# - Points may be missing systematically in some poses (such as the far ear in profile
#   views) if they are visible in other frames.
#
# Weights
# -------
#
# If a tracker gives a confidence for each point, or the noise of the points is known,
# set ``point_weight`` (:doc:`/conventions`). A point of weight w counts as w
# observations, and a point of weight zero is missing. Here 30 % of the points have ten
# times the noise of the others.

faces = make_face_tracks(n_frames=200, random_state=0)
rng = np.random.RandomState(0)
unsure = rng.uniform(size=faces.visible.shape) < 0.3
size = np.sqrt(np.mean((faces.tracks - faces.tracks.mean(1, keepdims=True)) ** 2))
noise = 0.05 * size * unsure[..., None] * rng.normal(size=faces.tracks.shape)
X = (faces.tracks + noise).reshape(faces.data.shape)
weights = np.where(unsure, 0.01, 1.0)
for point_weight in (None, weights):
    model = AffineNRSfM(K, random_state=0).fit(X, point_weight=point_weight)
    shapes = model.mean_shape_ + np.tensordot(model.alpha_, model.basis_, 1)
    error = affine_shape_error(faces.shapes, shapes)
    name = "without" if point_weight is None else "with"
    print(f"{name:7} weights: error of the 3D shapes {error:.2%}")

# %%
# Outliers
# --------
#
# Detections can be grossly wrong. ``model.diagnostics(X)`` and the report name the rows
# and points. With a quadratic loss, such outliers distort the shapes. With
# ``loss="huber"`` and ``loss="cauchy"``, the weight of a point decreases with its
# residual, with the second to nearly zero. Here 2 % of the points are displaced by up
# to twice the size of the face.

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
# The distance from the reprojection separates the wrong points from the others.

distance = np.linalg.norm(model.reproject(X).reshape(tracks.shape) - tracks, axis=-1)
_, axis = plt.subplots(figsize=(6, 3), layout="constrained")
bins = np.geomspace(0.03, 1000, 60)
axis.hist(distance[~wrong], bins, color="0.6", label="good points")
axis.hist(distance[wrong], bins, color="tab:red", label="wrong points")
axis.set(xscale="log", yscale="log", xlabel="distance from the model, pixels")
axis.legend()

# %%
# If a row is completely wrong, for example because another object was detected, the
# inverse SNR of the frame is large. It is a column of ``cameras.csv``, which the
# command line writes. Leave such rows out and fit again.
