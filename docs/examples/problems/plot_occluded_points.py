"""
Fill in occluded landmarks
==========================

Landmarks are often occluded systematically: by a hand in front of the mouth, by hair,
or on the far side of a turned head. `AffineNRSfM.reproject` returns the reprojections
of all points, with which missing points can be filled in.
"""

import numpy as np

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
# The model is fitted to the incomplete table.

model = AffineNRSfM(4, random_state=0).fit(X)
completed = np.where(np.isnan(X), model.reproject(X), X)

# %%
# The baseline is the mean shape of the model in the affine camera that fits the visible
# points of the frame best.

mean_shape = np.c_[model.mean_shape_, np.ones(68)]
rigid = np.empty_like(faces.tracks)
for i, points in enumerate(seen):
    camera = np.linalg.lstsq(mean_shape[points], faces.tracks[i, points])[0]
    rigid[i] = mean_shape @ camera

print("mean error of the hidden points, pixels")
for name, found in {"AffineNRSfM": completed, "mean shape": rigid}.items():
    distance = np.linalg.norm(found.reshape(rigid.shape) - faces.clean, axis=-1)
    for group, points in groups.items():
        error = distance[np.ix_(hidden_group == group, points)].mean()
        print(f"{name:12} {group:16} {error:5.2f}")

# %%
# Uncertainty
# -----------
#
# If only the mouth is hidden, the position of the chin determines how far it is open.
# If mouth and jaw are hidden, the coefficient tends to its mean, zero, and its standard
# deviation increases towards that over all frames, one. Check `alpha_std_` before you
# use a completed point.

mouth = np.abs(np.corrcoef(faces.alpha[:, 0], model.alpha_.T)[0, 1:]).argmax()
opening = faces.component_names[0]
print(f"standard deviation of the coefficient of {opening!r}")
for group in [*groups, "nothing"]:
    deviation = model.alpha_std_[hidden_group == group, mouth]
    print(f"  {group + ' hidden':24} {deviation.mean():.2f}")

# %%
# Four frames with a hidden mouth and four with a hidden eye: observed points (rings)
# and the model.

rows = [np.flatnonzero(hidden_group == name)[:4] for name in list(groups)[:2]]
ReprojectionDisplay.from_estimator(
    model, X, frames=np.concatenate(rows), edges="ibug-68", n_columns=4
)
