"""
Find similar faces whatever their pose
======================================

Which other row of the table shows the same face? Distances between landmarks find the
same *pose*. Distances between coefficients find the same *shape*, because the
coefficients do not depend on the viewpoint.

Here the same 200 artificial faces are seen twice, by different cameras. A query is a
face of the first half, and its like is one row of the second.
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
# Coefficients of unit variance have equal weight in the distance, but a coefficient
# that the points of a frame hardly determine should have less weight. Division by the
# mean of `alpha_std_` achieves this.

model = AffineNRSfM(K, random_state=0).fit(X)
alpha = model.alpha_ / np.sqrt(np.mean(model.alpha_std_**2, axis=0))

# %%
# The baseline is the distance of the landmarks, with frames aligned by the best
# similarity transform of the image (a single product of complex numbers).

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
    print(f"{name}: of {n_faces} faces the same one is the nearest in {first_one:.0%},")
    print(f"    and among the nearest five in {five:.0%}")

# %%
# Faces near rest are similar; their differences are below the noise. The nearest face
# need not be the same one, but it should look the same from the front.

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
# For a large table, an index of the coefficients answers at once. New photos are
# transformed and looked up.

index = NearestNeighbors(n_neighbors=3).fit(alpha[n_faces:])
query = model.transform(X[:1]) / np.sqrt(np.mean(model.alpha_std_**2, axis=0))
print(index.kneighbors(query))
