"""
Comparison with PCA and FastICA of the table
============================================

PCA and FastICA of a table of landmarks are two lines of scikit-learn. They model the
*images*, linearly. A head that turns moves its points more than a mouth that opens, and
not linearly, so that their first components are pose, and expressions are spread over
many. Aligning the frames (removing position, size and rotation in the image) takes out
what can be taken out in the plane, not yaw and pitch.

`AffineNRSfM` has a camera for each frame. Its coefficients do not depend on where the
camera is. All of it is measured here on artificial faces of which pose and expression
are known.
"""

import matplotlib.pyplot as plt
import numpy as np
from sklearn.decomposition import PCA, FastICA
from sklearn.linear_model import LinearRegression
from sklearn.model_selection import cross_val_score

from isa_nrsfm import AffineNRSfM
from isa_nrsfm.datasets import make_face_tracks

K = 4
faces = make_face_tracks(n_frames=400, n_components=K, random_state=0)


def aligned(tracks):
    """Return tracks, each turned, moved and scaled to the mean as near as it can be."""
    z = tracks[..., 0] + 1j * tracks[..., 1]
    z = z - z.mean(axis=1, keepdims=True)
    z = z / np.linalg.norm(z, axis=1, keepdims=True)
    mean = z[0]
    for _ in range(10):
        z = z * np.exp(-1j * np.angle(z @ mean.conj()))[:, None]
        mean = z.mean(axis=0)
    return np.concatenate([z.real, z.imag], axis=1)


images = aligned(faces.tracks)
model = AffineNRSfM(K, random_state=0)
features = {
    "PCA of the table": PCA(K).fit_transform(faces.data),
    "PCA of aligned frames": PCA(K).fit_transform(images),
    "PCA of aligned frames, 15": PCA(3 * K + 3).fit_transform(images),
    "FastICA of aligned frames": FastICA(K, random_state=0).fit_transform(images),
    "alpha of AffineNRSfM": model.fit_transform(faces.data),
}

# %%
# How much of the head pose is in the coefficients?
# -------------------------------------------------
#
# The share of the variance (R squared, cross-validated) that a linear regression
# predicts from the coefficients: of yaw and pitch, of which nothing should be there,
# and of the expressions, of which everything should. Where the first is near zero or
# below, the coefficients do not tell the pose.


def explained(found, truth):
    """Return the cross-validated R squared of each column of the truth."""
    regression = LinearRegression()
    return np.array([cross_val_score(regression, found, y).mean() for y in truth.T])


pose = {name: explained(found, faces.angles[:, :2]) for name, found in features.items()}
meant = {name: explained(found, faces.strength) for name, found in features.items()}
print(f"{'':27}   yaw  pitch |", "  ".join(faces.component_names))
for name in features:
    shares = "  ".join(
        f"{share:{len(what)}.2f}"
        for share, what in zip(meant[name], faces.component_names, strict=True)
    )
    print(f"{name:27} {pose[name][0]:5.2f}  {pose[name][1]:5.2f} |  {shares}")

_, axis = plt.subplots(figsize=(7.5, 3), layout="constrained")
at = np.arange(len(features))
axis.barh(at - 0.2, [p.mean() for p in pose.values()], 0.38, label="yaw and pitch")
axis.barh(at + 0.2, [m.mean() for m in meant.values()], 0.38, label="expressions")
axis.set(yticks=at, yticklabels=features, xlabel="mean R squared", xlim=(-0.05, 1.02))
axis.invert_yaxis()
axis.legend(loc="upper center", bbox_to_anchor=(0.4, 1.2), ncols=2, frameon=False)

# %%
# Does a coefficient mean something?
# ----------------------------------
#
# A linear regression may gather what is spread. Of a basis with a meaning, each
# expression is a coefficient of its own: here is the largest correlation of each
# expression with a single one.

print(f"{'':27}", faces.component_names)
for name, found in features.items():
    correlation = np.corrcoef(faces.strength.T, found.T)[:K, K:]
    best = np.abs(correlation).max(axis=1)
    print(f"{name:27}", best.round(2))

# %%
# What the components show
# ------------------------
#
# The same in pictures: how the first four components of PCA, and the four basis shapes
# seen by the mean camera, move the points. Those of PCA turn the head.

pca = PCA(K).fit(images)
patterns = pca.components_.reshape(K, 2, -1).transpose(0, 2, 1)
mean_image = pca.mean_.reshape(2, -1).T
camera = model.reference_motion_
_, axes = plt.subplots(2, K, figsize=(9, 5.2), layout="constrained")
for k in range(K):
    for axis, start, move in (
        (axes[0, k], mean_image, patterns[k] * np.sqrt(pca.explained_variance_[k])),
        (axes[1, k], model.mean_shape_ @ camera.T, model.basis_[k] @ camera.T),
    ):
        largest = np.linalg.norm(move, axis=1).max() / np.ptp(start[:, 0])
        move = 0.2 * move / largest
        axis.quiver(*start.T, *move.T, angles="xy", scale_units="xy", scale=1)
        axis.scatter(*(start + move).T, s=0)
        axis.set(aspect="equal", xticks=[], yticks=[])
        axis.margins(0.12)
        axis.invert_yaxis()
    axes[0, k].set_title(f"PCA {k + 1}", fontsize="medium")
    axes[1, k].set_title(f"basis shape {k + 1}", fontsize="medium")

# %%
# When PCA is enough
# ------------------
#
# Where all images are frontal there is no pose to be mixed with. And with many
# components a classifier can undo the mixing: with 3 K + 3 = 30 components of PCA,
# expressions are classified as well as with 9 coefficients or better
# (:doc:`/benchmarks/classification`: 82 against 81 % on rendered faces in any pose, 87
# against 80 % on photos). What PCA does not give are 3D shapes, cameras, coefficients
# with a meaning of their own, and coefficients that stay the same in another view.
