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
# The measurement matrix, and what is rigid in it
# -----------------------------------------------
#
# Centred over the points, each frame gives two rows of the measurement matrix W, one
# of x and one of y. Images of a rigid object in affine cameras have rank three (Tomasi
# and Kanade, 1992), and each basis shape adds three more. Here are the singular values:
# three large ones, 3 K of the deformation, then noise.
#
# The first three are the *rigid part*: a shape, and a camera for each frame. It
# explains most, but its mouth does not open.

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
# What is left, the next 3 K singular triplets, mixes all deformations. Its 3 K rows
# over the points are taken for signals. The paper assumes that the basis shapes are
# independent of each other; the three coordinates of one are not. So the signals fall
# into K groups of three, *independent subspaces*.
#
# `PooledFastICA` finds independent components and pools them into groups, by how they
# move together in the images: their covariance over the images, the *mode covariance
# matrix*, shall be block-diagonal, as nearly as it can be.

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
# In a subspace, camera and coefficient have to be separated: the motion of subspace k
# is that of the rigid part times a coefficient, after the right 3x3 transformation. The
# paper finds it, and refines the basis shapes with the rigid cameras held. But faces
# also deform along their rigid shape, so the rigid cameras are not the true cameras,
# and the basis shapes are biased.
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
# The joint fit finds the span of the basis shapes. Any mixing of them fits equally
# well; :doc:`plot_independence` shows how it is selected.
