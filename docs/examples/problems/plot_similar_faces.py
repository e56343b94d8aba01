"""
Find similar faces in any pose
==============================

The nearest neighbour of a face by its landmarks is a face in the same *pose*. The
nearest neighbour by its coefficients is a face of the same *shape*, because the
coefficients do not depend on the viewpoint.

Here 200 artificial faces are each seen by two cameras. For each image of the first
camera, the same face is searched among the images of the second.
"""

import numpy as np
from sklearn.neighbors import NearestNeighbors

from isa_nrsfm import AffineNRSfM
from isa_nrsfm.datasets import make_face_tracks
from isa_nrsfm.plotting import ReprojectionDisplay

n_faces, K = 200, 6
first = make_face_tracks(n_frames=n_faces, n_components=K, random_state=0)
views = make_face_tracks(n_frames=n_faces, n_components=K, random_state=1)
rng = np.random.RandomState(2)
again = first.shapes @ views.motion.transpose(0, 2, 1) + views.translation[:, None]
again += rng.normal(scale=np.sqrt(views.noise_variance), size=again.shape)
tracks = np.concatenate([first.tracks, again])
X = tracks.reshape(len(tracks), -1)

# %%
# All coefficients have unit variance. In the distance, coefficients with larger
# standard deviations should have less weight. They are therefore divided by the RMS of
# `alpha_std_`.

model = AffineNRSfM(K, random_state=0).fit(X)
alpha = model.alpha_ / np.sqrt(np.mean(model.alpha_std_**2, axis=0))

# %%
# The baseline is the distance of the landmarks after the best similarity transform,
# computed with complex numbers.

z = tracks @ [1, 1j]
z = z - z.mean(axis=1, keepdims=True)
z = z / np.linalg.norm(z, axis=1, keepdims=True)
likeness = {
    "landmarks, aligned": np.abs(z[:n_faces] @ z[n_faces:].conj().T),
    "alpha": -np.linalg.norm(alpha[:n_faces, None] - alpha[None, n_faces:], axis=2),
}
for name, values in likeness.items():
    better = (values > np.diag(values)[:, None]).sum(axis=1)
    first_one, five = np.mean(better == 0), np.mean(better < 5)
    print(f"{name}: same face nearest {first_one:.0%}, among nearest five {five:.0%}")

# %%
# Nearly neutral faces differ by less than the noise. The nearest face may therefore be
# another one, but it should have the same expression.

strong = np.argsort(first.strength[:, :3].max(axis=1))[-4:]
nearest = {name: n_faces + values.argmax(axis=1) for name, values in likeness.items()}
chosen = np.concatenate([strong, *(rows[strong] for rows in nearest.values())])
shapes = tracks[chosen] - tracks[chosen].mean(axis=1, keepdims=True)
display = ReprojectionDisplay(
    observed=shapes, reprojected=shapes, edges="ibug-68"
).plot(n_columns=4)
titles = [
    f"{name}: {'the same' if row == n_faces + i else 'another'}"
    for name, rows in nearest.items()
    for i, row in zip(strong, rows[strong], strict=True)
]
for axis, title in zip(display.axes_, ["query"] * 4 + titles, strict=True):
    axis.set_title(title, fontsize="x-small")

# %%
# With scikit-learn's neighbours
# ------------------------------
#
# For a large table, use an index of the coefficients. New photos are transformed, and
# their neighbours are queried.

index = NearestNeighbors(n_neighbors=3).fit(alpha[n_faces:])
query = model.transform(X[:1]) / np.sqrt(np.mean(model.alpha_std_**2, axis=0))
print(index.kneighbors(query))
