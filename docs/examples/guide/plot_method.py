"""
The method in pictures
======================

From a table of 2D landmarks to basis shapes, stage by stage, on artificial faces of
which everything is known. :doc:`/method` says the same in words and formulas.

The table
---------

One row a frame, two columns a point. The frames have no order, the heads are turned,
and photos differ in size. Nothing else goes into the method: no calibration, no 3D
shapes, no labels.
"""

# sphinx_gallery_thumbnail_number = 6
import matplotlib.pyplot as plt
import numpy as np

from isa_nrsfm import AffineNRSfM
from isa_nrsfm.datasets import make_face_tracks
from isa_nrsfm.isa import PooledFastICA
from isa_nrsfm.metrics import affine_shape_error, basis_similarity
from isa_nrsfm.plotting import (
    BasisShapeDisplay,
    ModeCovarianceDisplay,
    ReprojectionDisplay,
)

K = 3
faces = make_face_tracks(n_frames=300, n_components=K, random_state=0)
X, (n_frames, n_points) = faces.data, faces.visible.shape
print(X.shape, faces.component_names)

_, axes = plt.subplots(1, 6, figsize=(9, 2.2), layout="constrained")
for i, axis in enumerate(axes):
    axis.scatter(*faces.tracks[i].T, s=3, color="0.2")
    axis.set(aspect="equal", xticks=[], yticks=[], title=f"row {i}")
    axis.invert_yaxis()

# %%
# The measurement matrix, and what is rigid in it
# -----------------------------------------------
#
# Centred over the points, each frame gives two rows of the measurement matrix W, one
# of x and one of y. Images of a rigid object in affine cameras have rank three (Tomasi
# and Kanade, 1992), and each basis shape adds three more. Here are the singular values:
# three large ones, 3 K of the deformation, then noise.

tracks = faces.tracks - faces.tracks.mean(axis=1, keepdims=True)
tracks /= np.sqrt(np.mean(tracks**2, axis=(1, 2), keepdims=True))
W = tracks.transpose(0, 2, 1).reshape(-1, n_points)
U, S, Vt = np.linalg.svd(W, full_matrices=False)

_, axis = plt.subplots(figsize=(6, 3), layout="constrained")
parts = {"rigid": (0, 3), "deformation": (3, 3 + 3 * K), "noise": (3 + 3 * K, 30)}
for (name, (first, last)), colour in zip(
    parts.items(), ["0.2", "tab:red", "0.7"], strict=True
):
    axis.bar(np.arange(first, last) + 1, S[first:last], color=colour, label=name)
axis.set(yscale="log", xlabel="number", ylabel="singular value of W")
axis.legend()

# %%
# The first three are the *rigid part*: a shape, and a camera for each frame. It
# explains most, but the mouths below do not open.

rigid_motion = U[:, :3] * S[:3] / np.sqrt(n_points)
rigid_shape = np.sqrt(n_points) * Vt[:3]
rigid = (rigid_motion @ rigid_shape).reshape(n_frames, 2, n_points)
print(f"not explained: {1 - np.sum(S[:3] ** 2) / np.sum(S**2):.2%} of the energy")

open_mouths = np.argsort(faces.strength[:, 0])[-4:]
display = ReprojectionDisplay(
    observed=tracks[open_mouths],
    reprojected=rigid.transpose(0, 2, 1)[open_mouths],
    frames=open_mouths,
    edges="auto",
)
display.plot(n_columns=4)

# %%
# Independent subspaces
# ---------------------
#
# What is left, the next 3 K singular triplets, mixes all deformations. Its 3 K rows
# over the points are taken for signals. The paper assumes that the basis shapes are
# independent of each other; the three coordinates of one are not. So the signals fall
# into K groups of three, *independent subspaces*.
#
# `PooledFastICA` finds independent components and pools them into groups, by how they
# move together in the images: their covariance over the images, the *mode covariance
# matrix*, shall be block-diagonal, as nearly as it can be.

motion = U[:, 3 : 3 + 3 * K] * S[3 : 3 + 3 * K] / np.sqrt(n_points)
signals = np.sqrt(n_points) * Vt[3 : 3 + 3 * K]
covariance = motion.T @ motion * n_points / len(W)
isa = PooledFastICA(random_state=0).fit(signals.T, covariance=covariance)
pooled = isa.components_ @ covariance @ isa.components_.T
mixed = np.random.RandomState(0).permutation(3 * K)

_, axes = plt.subplots(1, 2, figsize=(9, 4), layout="constrained")
for axis, matrix, what in zip(
    axes,
    (pooled[np.ix_(mixed, mixed)], pooled),
    ("components in any order", "pooled into subspaces"),
    strict=True,
):
    display = ModeCovarianceDisplay(mode_covariance=matrix).plot(axis)
    axis.set_title(what, fontsize="medium")
    print(f"{what}: {display.off_block_share:.1%} of the squares outside the blocks")

# %%
# Refinement
# ----------
#
# In a subspace, a camera and a coefficient have to be told apart: the motion of
# subspace k is that of the rigid part times a coefficient, after the right 3x3
# transformation. The paper finds it, and refines the basis shapes with the rigid
# cameras held. But faces that deform do so along their rigid shape, too, so the rigid
# cameras are not the true ones: the basis shapes are off.
#
# The *joint refinement*, the default, moves cameras, shapes and noise together, with
# the coefficients integrated out. Its objective never rises. Free cameras can hide part
# of a deformation; those that are known to be weak-perspective ones cannot.

models = {
    "none": AffineNRSfM(K, refinement=None, random_state=0),
    "alternating (the paper's)": AffineNRSfM(
        K, refinement="alternating", random_state=0
    ),
    "joint": AffineNRSfM(K, random_state=0),
    "joint, weak perspective": AffineNRSfM(
        K, camera="weak_perspective", random_state=0
    ),
}
print(f"{'refinement':27} inverse SNR  3D error  similarity of the basis shapes")
for name, model in models.items():
    model.fit(X)
    similarity = basis_similarity(
        faces.basis,
        model.basis_,
        mean_shape_true=faces.mean_shape,
        mean_shape=model.mean_shape_,
        modulo_mean_shape=True,
    )
    error = affine_shape_error(faces.shapes, model.reconstruct(X))
    print(f"{name:27} {model.inverse_snr_:10.4%} {error:9.2%}  {similarity.round(3)}")

model = models["joint"]
_, axis = plt.subplots(figsize=(6, 2.6), layout="constrained")
axis.plot(model.objective_history_ - model.objective_history_[-1] + 1, ".-")
axis.set(yscale="log", xlabel="step", ylabel="minus twice the log posterior")
axis.set_title("above its minimum, plus one", fontsize="medium")

# %%
# The noise alone, of the same table:

clean = faces.clean - faces.clean.mean(axis=1, keepdims=True)
noise = faces.tracks - faces.tracks.mean(axis=1, keepdims=True) - clean
share = np.sum(noise**2, axis=(1, 2)) / np.sum((clean + noise) ** 2, axis=(1, 2))
print(f"inverse SNR of the truth {share.mean():.4%}")

# %%
# The gauge
# ---------
#
# The joint fit finds what the basis shapes span. Any mixing of them fits as well, and
# something has to choose: that the basis shapes are independent over the points (the
# paper's assumption, the default), that the coefficients are independent over the
# frames, or, with None, the principal axes of the deformation. How far is each true
# expression a coefficient of its own?

for independence in (None, "shapes", "coefficients"):
    chosen = AffineNRSfM(K, independence=independence, random_state=0).fit(X)
    correlation = np.corrcoef(faces.alpha.T, chosen.alpha_.T)[:K, K:]
    best = np.abs(correlation).max(axis=1)
    print(f"{independence!s:13} {best.round(3)} for {faces.component_names}")

# %%
# The basis shapes, from the front and from the side. Affine cameras leave one affinity
# of space open; for figures, and for :func:`~isa_nrsfm.calibration.euclidean_frames`,
# the cameras are taken for photos from afar, which chooses it.

names = [faces.component_names[np.abs(c).argmax()] for c in correlation.T]
BasisShapeDisplay.from_estimator(chosen, component_names=names, n_columns=2)

# %%
# The coefficients do not depend on the viewpoint. Each is the strength of an
# expression.

_, axes = plt.subplots(1, K, figsize=(9, 3), layout="constrained")
for k, axis in enumerate(axes):
    found = np.abs(correlation[k]).argmax()
    axis.scatter(faces.strength[:, k], chosen.alpha_[:, found], s=5, color="0.2")
    axis.set(
        xlabel=f"true strength: {faces.component_names[k]}",
        ylabel=f"alpha_[:, {found}]",
    )

# %%
# And the mouths open.

ReprojectionDisplay.from_estimator(model, X, frames=open_mouths, n_columns=4)
