"""
The method in pictures
======================

This page shows the stages from a table of 2D landmarks to basis shapes, on artificial
faces with known truth. :doc:`/method` describes them in detail.

The table
---------

The table has one row per frame and two columns per point. Frames are in any order, with
heads in different poses and sizes. The method uses no other data.
"""

# sphinx_gallery_thumbnail_number = 3
import matplotlib.pyplot as plt
import numpy as np

from isa_nrsfm import AffineNRSfM
from isa_nrsfm.datasets import make_face_tracks
from isa_nrsfm.isa import PooledFastICA
from isa_nrsfm.metrics import affine_shape_error
from isa_nrsfm.plotting import ModeCovarianceDisplay

K = 3
faces = make_face_tracks(n_frames=300, n_components=K, random_state=0)
_, axes = plt.subplots(1, 6, figsize=(9, 2.2), layout="constrained")
for i, axis in enumerate(axes):
    axis.scatter(*faces.tracks[i].T, s=3, color="0.2")
    axis.set(aspect="equal", xticks=[], yticks=[], title=f"row {i}")
    axis.invert_yaxis()

# %%
# Measurement matrix and rigid part
# ---------------------------------
#
# Each frame, centred over its points, provides two rows of the measurement matrix W,
# one of x and one of y. For images of a rigid object in affine cameras, W has rank
# three (Tomasi and Kanade, 1992). Each basis shape increases the rank by three. The
# figure shows the singular values: three large ones, 3 K of the deformation, then
# noise.
#
# The first three are the *rigid part*: a shape, and a camera for each frame. It
# explains most of the energy, but none of the deformation.

tracks = faces.tracks - faces.tracks.mean(axis=1, keepdims=True)
tracks /= np.sqrt(np.mean(tracks**2, axis=(1, 2), keepdims=True))
W = tracks.transpose(0, 2, 1).reshape(-1, 68)
U, S, Vt = np.linalg.svd(W, full_matrices=False)
print(f"not rigid: {1 - np.sum(S[:3] ** 2) / np.sum(S**2):.2%} of the energy")

_, axis = plt.subplots(figsize=(6, 3), layout="constrained")
for name, first, last in (("rigid", 0, 3), ("deformation", 3, 12), ("noise", 12, 30)):
    axis.bar(np.arange(first, last) + 1, S[first:last], label=name)
axis.set(yscale="log", xlabel="number", ylabel="singular value of W")
axis.legend()

# %%
# Independent subspaces
# ---------------------
#
# The next 3 K singular triplets contain all deformations. Their right singular vectors
# are signals with the points as samples. The paper assumes that the basis shapes are
# independent of each other, but the three coordinates of a basis shape are not. The
# signals are therefore transformed into K groups of three, the *independent subspaces*.
#
# `PooledFastICA` estimates independent components and pools them into groups. The
# groups are chosen such that the covariance of the components over the images, the
# *mode covariance matrix*, is as block-diagonal as possible.

motion = U[:, 3:12] * S[3:12] / np.sqrt(68)
covariance = motion.T @ motion * 68 / len(W)
isa = PooledFastICA(random_state=0).fit(np.sqrt(68) * Vt[3:12].T, covariance=covariance)
pooled = isa.components_ @ covariance @ isa.components_.T

_, axes = plt.subplots(1, 2, figsize=(9, 4), layout="constrained")
mixed = np.random.RandomState(0).permutation(9)
ModeCovarianceDisplay(mode_covariance=pooled[np.ix_(mixed, mixed)]).plot(axes[0])
display = ModeCovarianceDisplay(mode_covariance=pooled).plot(axes[1])
axes[0].set_title("components in any order")
axes[1].set_title("pooled into subspaces")
print(f"{display.off_block_share:.1%} of the squares outside the blocks")

# %%
# Refinement
# ----------
#
# In each subspace, camera and coefficient must be separated. After a suitable 3x3
# transformation, the motion of subspace k is that of the rigid part times a
# coefficient. The paper estimates this transformation, and refines the basis shapes
# with the rigid cameras. But faces also deform along their rigid shape. Therefore the
# rigid cameras are not the true cameras, and the basis shapes are biased.
#
# The *joint refinement*, the default, optimises cameras, shapes and noise together,
# with the coefficients integrated out. Its objective never increases. Affine cameras
# can absorb part of a deformation; weak-perspective cameras cannot.

cases = {
    "none": {"refinement": None},
    "alternating (the paper's)": {"refinement": "alternating"},
    "joint": {},
    "joint, weak perspective": {"camera": "weak_perspective"},
}
print(f"{'refinement':27} inverse SNR  3D error")
for name, options in cases.items():
    model = AffineNRSfM(K, random_state=0, **options).fit(faces.data)
    error = affine_shape_error(faces.shapes, model.reconstruct(faces.data))
    print(f"{name:27} {model.inverse_snr_:10.4%} {error:9.2%}")

# %%
# The fit determines only the span of the basis shapes; :doc:`plot_independence` shows
# how a basis is selected.
