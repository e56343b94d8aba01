"""
Fill in occluded landmarks
==========================

A hand in front of the mouth, hair over a brow, the far side of a turned head: some
landmarks were not seen, and not at random. `AffineNRSfM.reproject` returns the table
with all points as the model has them. Filled in are those that were missing.
"""

import matplotlib.pyplot as plt
import numpy as np
from sklearn.impute import KNNImputer

from isa_nrsfm import AffineNRSfM
from isa_nrsfm.datasets import make_face_tracks
from isa_nrsfm.plotting import ReprojectionDisplay

faces = make_face_tracks(n_frames=300, random_state=0)
groups = {
    "mouth": np.arange(48, 68),
    "an eye and brow": np.r_[17:22, 36:42],
    "mouth and jaw": np.r_[0:17, 48:68],
}
rng = np.random.RandomState(0)
seen = np.ones(faces.visible.shape, dtype=bool)
hidden_group = rng.choice([*groups, "nothing"], size=len(seen))
for name, points in groups.items():
    seen[np.ix_(hidden_group == name, points)] = False
X = np.where(seen[..., None], faces.tracks, np.nan).reshape(faces.data.shape)
print(f"{np.isnan(X).mean():.0%} of the table is missing")

# %%
# The model is fitted to the table as it is, with its holes.

model = AffineNRSfM(4, random_state=0).fit(X)
completed = np.where(np.isnan(X), model.reproject(X), X)

# %%
# Against it two other fillings: the mean shape of the model in the affine camera that
# fits the points of the frame best, and the mean of the five rows whose points are
# nearest (frames moved and scaled to be comparable).

mean_shape = np.c_[model.mean_shape_, np.ones(68)]
rigid = np.empty_like(faces.tracks)
for i, points in enumerate(seen):
    camera = np.linalg.lstsq(mean_shape[points], faces.tracks[i, points])[0]
    rigid[i] = mean_shape @ camera

tracks = X.reshape(faces.tracks.shape)
centre = np.nanmean(tracks, axis=1, keepdims=True)
size = np.sqrt(np.nanmean((tracks - centre) ** 2, axis=(1, 2), keepdims=True))
scaled = ((tracks - centre) / size).reshape(X.shape)
neighbours = KNNImputer(n_neighbors=5).fit_transform(scaled)
neighbours = neighbours.reshape(tracks.shape) * size + centre

filled = {
    "AffineNRSfM": completed.reshape(tracks.shape),
    "mean shape": rigid,
    "five nearest rows": neighbours,
}
print("mean error of the points that were hidden, in pixels")
for name, found in filled.items():
    distance = np.linalg.norm(found - faces.clean, axis=-1)
    errors = {
        group: distance[np.ix_(hidden_group == group, points)].mean().round(2).item()
        for group, points in groups.items()
    }
    print(f"{name:18}", errors)

# %%
# How sure is it?
# ---------------
#
# With only the mouth hidden the chin still tells how far it is open. With the jaw
# hidden as well little does: the coefficient goes towards its mean, zero, and its
# standard deviation towards that over all frames, one. So `alpha_std_` is the thing to
# look at before a filled point is believed.

mouth = np.abs(np.corrcoef(faces.alpha[:, 0], model.alpha_.T)[0, 1:]).argmax()
print(f"deviation of the coefficient of {faces.component_names[0]!r}")
for group in [*groups, "nothing"]:
    deviation = model.alpha_std_[hidden_group == group, mouth]
    print(f"  {group + ' hidden':24} {deviation.mean():.2f}")

# %%
# Four frames with the mouth and four with an eye hidden: what was seen, and the model.

rows = [np.flatnonzero(hidden_group == name)[:4] for name in list(groups)[:2]]
shown = np.concatenate(rows)
ReprojectionDisplay.from_estimator(model, X, frames=shown, n_columns=4)

# %%
# A closer look at one: the filled points in red, the truth as rings.

i = rows[0][np.argmax(faces.strength[rows[0], 1])]
_, axis = plt.subplots(figsize=(4, 4), layout="constrained")
axis.scatter(*tracks[i, seen[i]].T, s=10, color="0.2", label="seen")
hidden = ~seen[i]
found, true = filled["AffineNRSfM"][i, hidden], faces.clean[i, hidden]
axis.scatter(*found.T, s=10, color="tab:red", label="filled")
axis.scatter(*true.T, s=40, facecolor="none", edgecolor="0.5", label="truth")
axis.set(aspect="equal", xticks=[], yticks=[])
axis.invert_yaxis()
axis.legend(fontsize="small")
