"""
DeepLabCut: motion of a hand over time
======================================

DeepLabCut writes a csv or h5 file with the position and likelihood of each body part.
This example follows the gestures of a hand over time.

The first block writes a file of 300 frames. A tenth of the points are occluded. Their
positions are wrong, and their likelihood is low.
"""

# sphinx_gallery_thumbnail_number = 1
import tempfile
from pathlib import Path

import numpy as np
import pandas as pd

from isa_nrsfm import AffineNRSfM
from isa_nrsfm.datasets import make_hand_tracks
from isa_nrsfm.io import read_landmarks
from isa_nrsfm.plotting import CoefficientsDisplay, ReprojectionDisplay
from isa_nrsfm.skeletons import get_skeleton

truth = make_hand_tracks(300, n_people=1, random_state=0)
rng = np.random.default_rng(0)
hidden = rng.random((300, 21)) < 0.1
tracks = np.where(hidden[..., None], rng.uniform(0, 400, (300, 21, 2)), truth.tracks)
values = np.dstack([tracks, np.where(hidden, 0.05, 0.98)])
parts = get_skeleton("hand-21").point_names
columns = pd.MultiIndex.from_product(
    [["DLC_resnet50_hand"], parts, ["x", "y", "likelihood"]],
    names=["scorer", "bodyparts", "coords"],
)
path = Path(tempfile.mkdtemp()) / "handDLC.csv"
pd.DataFrame(values.reshape(300, -1).round(2), columns=columns).to_csv(path)
print("\n".join(line[:60] for line in path.read_text().splitlines()[:4]))

# %%
# Points with a likelihood below 0.6 are treated as missing. Missing points need no
# interpolation.

hand = read_landmarks(path, min_confidence=0.6)
print(f"{hand.points.isna().mean().mean():.1%} of the points are missing")
model = AffineNRSfM(3, random_state=0).fit(hand.points)
smooth = model.smooth(hand.points, time=hand.frames["frame"] / 25)

# %%
# The coefficients over time, with bands of one standard deviation:

CoefficientsDisplay(
    alpha=smooth.alpha, alpha_std=smooth.alpha_std, time=hand.frames["frame"] / 25
).plot(kind="time")

# %%
# Three frames: rings are observed points, dots the points of the model. The model also
# has the points that are missing.

ReprojectionDisplay.from_estimator(model, hand.points, frames=[50, 90, 160])

# %%
# The same on the command line. ``--skeleton config.yaml`` adds the edges between body
# parts from a project::
#
#     isa-nrsfm fit handDLC.csv --min-confidence 0.6 --n-components 3 --fps 25 \
#         --output out
