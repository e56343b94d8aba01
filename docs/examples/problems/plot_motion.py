"""
Smooth a motion over time
=========================

Neighbouring frames of a video are similar. The fit does not use the order of the
frames; `AffineNRSfM.smooth` uses it after the fit. Frames with few visible points are
then estimated more accurately.

A person walks, reaches and squats. The tracks are noisy, 40 % of the points are
missing, and all points are missing for more than a second.
"""

# sphinx_gallery_thumbnail_number = 1
import matplotlib.pyplot as plt
import numpy as np

from isa_nrsfm import AffineNRSfM
from isa_nrsfm.datasets import make_body_tracks
from isa_nrsfm.metrics import mean_shape_error_3d
from isa_nrsfm.plotting import CoefficientsDisplay

K = 4
body = make_body_tracks(600, n_people=1, noise=0.03, missing=0.4, random_state=0)
seen = body.visible.sum(axis=1) >= 5
seen[120:150] = False
model = AffineNRSfM(K, camera="weak_perspective", random_state=0).fit(body.data[seen])
X = np.where(seen[:, None], body.data, np.nan)
alone = model.decompose(X)
smooth = model.smooth(X, time=body.time)

_, axes = plt.subplots(K, 2, figsize=(10, 6), sharex=True, layout="constrained")
for column, (title, found) in enumerate(
    {"frames by themselves": alone, "smoothed": smooth}.items()
):
    CoefficientsDisplay(
        alpha=found.alpha, alpha_std=found.alpha_std, time=body.time
    ).plot(axes[:, column], kind="time")
    axes[0, column].set_title(title)
for left, right in axes:
    right.set_ylim(left.get_ylim())

# %%
# Bands are one standard deviation. They widen where no points are visible. The time
# scales of the motion are estimated from the table.

print("time scales, seconds:", smooth.time_scales.round(2))

# %%
# The output lists the 3D errors of the visible frames, after the best rotation and
# scale of each. The last line is for coefficients of complete frames without noise:
# approximately the lowest error that is possible with these basis shapes.

clean = model.transform(body.clean.reshape(len(X), -1))
for name, alpha in {
    "frames by themselves": alone.alpha,
    "smoothed": smooth.alpha,
    "complete, without noise": clean,
}.items():
    shapes = model.mean_shape_ + np.tensordot(alpha[seen], model.basis_, 1)
    error = mean_shape_error_3d(body.shapes[seen], shapes, convention="frame")
    print(f"{name:24} {error:.1%} of the size of the body")

# %%
# Photos in random order have no dynamics. `smooth` detects this and returns the
# coefficients unchanged.

order = np.random.RandomState(0).permutation(np.flatnonzero(seen))
shuffled = model.smooth(X[order])
print("shuffled: time scales", shuffled.time_scales, end=", ")
print(f"changed by {np.abs(shuffled.alpha - alone.alpha[order]).max():.1g}")

# %%
# ``smooth.decomposition`` contains smoothed cameras, for `AffineNRSfM.reconstruct`. On
# the command line, ``--time COLUMN`` or ``--fps 25`` smooths coefficients and angles,
# with the figure ``time.png``.
