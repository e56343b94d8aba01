"""
Choosing the number of basis shapes
===================================

More basis shapes always reproject the points better that they were fitted to. They do
not predict better what they have not seen. `AffineNRSfM.score` measures that: the
points are divided into five parts, each is predicted from the others, frame by frame,
and the score is minus the error relative to the energy of the points. Cross-validation
over frames besides, as of `GridSearchCV`, makes sure that shapes are judged on frames
that they were not fitted to.
"""

import warnings
from textwrap import fill

import matplotlib.pyplot as plt
import numpy as np
from sklearn.model_selection import GridSearchCV

from isa_nrsfm import AffineNRSfM
from isa_nrsfm.datasets import make_nonrigid_tracks

tracks = make_nonrigid_tracks(
    n_frames=200, n_points=40, n_components=3, noise=0.02, random_state=0
)
search = GridSearchCV(
    AffineNRSfM(random_state=0), {"n_components": [1, 2, 3, 4, 5]}, cv=3
)
search.fit(tracks.data)
print(search.best_params_)

# %%
# The table was made with three. The error of the points that were fitted goes on
# falling behind that; the held-out error does not.

K = search.param_grid["n_components"]
models = {k: AffineNRSfM(k, random_state=0).fit(tracks.data) for k in K}
fitted = [models[k].inverse_snr_ for k in K]

_, axis = plt.subplots(figsize=(6, 3.2), layout="constrained")
axis.plot(K, -100 * search.cv_results_["mean_test_score"], "o-", label="held out")
axis.plot(K, 100 * np.array(fitted), "s--", color="0.6", label="fitted (inverse SNR)")
axis.set(xlabel="n_components", ylabel="error, %", yscale="log", xticks=K)
axis.legend()
print("held-out errors, %:", -100 * search.cv_results_["mean_test_score"].round(6))

# %%
# On the command line
# -------------------
#
# ``isa-nrsfm fit faces.csv -k 1-8 --output out`` does the same with contiguous blocks
# of rows, for neighbours in a video are alike, and fits the table with the best. Where
# rows belong to persons, and new persons are what matters, hold persons out:
# ``GridSearchCV(..., cv=GroupKFold()).fit(X, groups=person)``.
#
# Without a search
# ----------------
#
# ``n_components="auto"`` fits twelve basis shapes, or as many as the table allows, and
# takes those that the table determines: a few fits less, and it does not need frames to
# be held out.

auto = AffineNRSfM("auto", random_state=0).fit(tracks.data)
print('"auto" finds', len(auto.basis_))

# %%
# Diagnostics
# -----------
#
# `AffineNRSfM.diagnostics` tells how far the table determines a fit, and warns where it
# does not. With five basis shapes, two directions of the coefficients may well be
# noise: their reliability, the share of their variance that is not uncertainty, is
# below 0.8.

for k in (3, 5):
    with warnings.catch_warnings(record=True) as told:
        warnings.simplefilter("always")
        diagnostics = models[k].diagnostics()
    print(f"K={k}: reliability {diagnostics.reliability.round(2)}")
    for warning in told:
        print(fill(str(warning.message), 80))

# %%
# The other figures of the named tuple:
#
# - ``camera_singular_values``: how much the images show of each direction of space. A
#   last value near zero says that all frames see the object from one side: depth is
#   hardly determined.
# - ``deformation_amplitude``: deformation relative to the mean shape. The larger it is,
#   the more of it affine cameras can take for motion of their own.
# - ``effective_frames``: how many frames speak for each basis shape. One of a few
#   frames may be an outlier, such as a single bad detection.
# - ``weak_deviations``: standard deviations of those parts of the basis shapes that
#   cameras can absorb.
# - ``camera_noise_ratio`` and ``camera_meaning``: whether the table agrees with
#   calibrated cameras (:doc:`plot_cameras`).

for name, figures in models[3].diagnostics()._asdict().items():
    shown = figures if isinstance(figures, str) else np.round(figures, 4)
    print(f"{name:22}", shown)

# %%
# Real faces
# ----------
#
# Faces of many people have more small deformations than a table tells apart. The
# held-out error then falls slowly up to a large K (:doc:`/benchmarks/held_out` has the
# curve of a table of 2500 rendered faces, where it still falls at 13), and there is no
# true number. Take the K that the purpose wants: few basis shapes that can be named, or
# as many as a classifier gains from, with the classifier in the loop as in
# :ref:`sphx_glr_gallery_problems_plot_expressions.py`.
#
# K needs ``3 K + 4`` points and ``ceil(8 (K + 2) / 5)`` frames at least: a hand of 21
# points can have at most five. Many more frames than that are better.
