"""
Choosing the number of basis shapes
===================================

More basis shapes always reduce the reprojection error of the fitted points, but not the
error of held-out points. `AffineNRSfM.score` measures the latter. The points are
divided into five parts, and each part of a frame is predicted from the other four. The
score is minus the energy of the error relative to that of the points. `AffineNRSfMCV`
also holds out frames, so that shapes are evaluated on frames to which they were not
fitted.
"""

from textwrap import fill

import matplotlib.pyplot as plt
import numpy as np
from sklearn.model_selection import GroupKFold

from isa_nrsfm import AffineNRSfM, AffineNRSfMCV
from isa_nrsfm.datasets import make_nonrigid_tracks

tracks = make_nonrigid_tracks(
    n_frames=200, n_points=40, n_components=3, noise=0.02, random_state=0
)
search = AffineNRSfMCV(range(1, 6), estimator=AffineNRSfM(random_state=0))
search.fit(tracks.data)
print("chosen:", search.n_components_)

# %%
# The true number is three. The error of the fitted points (inverse SNR) decreases
# further with more basis shapes; the held-out error does not.

K = search.cv_results_["param_n_components"]
models = {k: AffineNRSfM(k, random_state=0).fit(tracks.data) for k in K.tolist()}
fitted = [model.inverse_snr_ for model in models.values()]

held_out = -search.cv_results_["mean_test_score"]
deviation = search.cv_results_["std_test_score"]

_, axis = plt.subplots()
axis.errorbar(K, 100 * held_out, 100 * deviation, capsize=3, label="held-out error")
axis.plot(K, 100 * np.array(fitted), "s--", color="0.6", label="inverse SNR")
axis.set(xlabel="number of basis shapes", ylabel="%", yscale="log", xticks=K)
axis.legend(frameon=False)
print("held-out errors, %:", 100 * held_out.round(6))

# %%
# ``best_estimator_`` is `AffineNRSfM` with the selected number, fitted to all frames.
# `transform`, `inverse_transform` and `score` use it. ``select="one_standard_error"``
# selects the fewest basis shapes whose error is within one standard error of the
# lowest.
#
# By default the rows are held out in three blocks, because neighbouring frames of a
# video are similar. If the model is to be used for new people, hold out all rows of a
# person together:

person = np.arange(200) // 4
by_person = AffineNRSfMCV(range(2, 5), cv=GroupKFold(3))
print(by_person.fit(tracks.data, groups=person).n_components_)

# %%
# The search follows a path. Each fit starts from earlier fits: from the fit with fewer
# basis shapes and the leading direction of its residual, and for a part of the frames
# also from the fit of all frames. All fits run to convergence, and the start with the
# best fit to the training frames is used. Held-out frames therefore affect only the
# start of a fit. With affine cameras and one minimum of the objective, the errors agree
# with those of `GridSearchCV` within half a percent. If it has several, as for motion
# capture, both searches may find different minima, and errors differ by several percent
# in either direction. ``python -m benchmarks.choice`` prints costs, selected numbers
# and differences.
#
# With calibrated cameras `AffineNRSfM` has all directions of a shape, and its score is
# the same for each number of basis shapes: `GridSearchCV` has no choice. The fits of
# `AffineNRSfMCV` have only as many directions as basis shapes.
#
# On the command line
# -------------------
#
# ``isa-nrsfm fit faces.csv -k 1-8 --output out`` selects K in the same way. If this is
# the largest number tried, it says that a larger one may be better.
#
# Without a search
# ----------------
#
# ``n_components="auto"`` fits twelve basis shapes, or as many as the table allows, and
# uses the number that the table determines. It requires fewer fits, and no frames are
# held out.

auto = AffineNRSfM("auto", random_state=0).fit(tracks.data)
print('"auto" finds', len(auto.basis_))

# %%
# Diagnostics
# -----------
#
# `AffineNRSfM.diagnostics` measures how well the table determines a fit; `messages`
# describe problems. Reliability is the squared correlation of estimated and true
# coefficients, along uncorrelated directions. With five basis shapes, two directions of
# the coefficients are noise, with a reliability of zero.

for k in (3, 5):
    diagnostics = models[k].diagnostics()
    print(f"K={k}: reliability {diagnostics.reliability.round(2)}")
    for message in diagnostics.messages:
        print(fill(message, 80))

# %%
# Other fields of the named tuple:
#
# - ``camera_singular_values``: RMS of the cameras along the principal directions of
#   space. If the last value is near zero, all frames show the object from the same
#   side, and the depth is hardly determined.
# - ``deformation_amplitude``: RMS of the deformation relative to the mean shape. The
#   larger it is, the more of the deformation affine cameras can absorb.
# - ``effective_frames``: effective number of frames that determine each basis shape. If
#   it is small, the basis shape may model outliers, such as a wrong detection.
# - ``weak_deviations``: standard deviations of those parts of the basis shapes that
#   cameras can absorb.
# - ``camera_noise_ratio`` and ``camera_meaning``: agreement of the table with
#   calibrated cameras (:doc:`plot_cameras`).

for name, figures in models[3].diagnostics()._asdict().items():
    shown = figures if isinstance(figures, str) else np.round(figures, 4)
    print(f"{name:22}", shown)

# %%
# Real faces
# ----------
#
# Faces of many people have more small deformations than a table determines. There is no
# true number, and the held-out error decreases slowly up to a large K. For 2500
# rendered faces it still decreases at 13 (:doc:`/benchmarks/held_out`). Choose K for
# the purpose. To interpret the basis shapes, use few. For a classifier, select K
# together with it, as in :ref:`sphx_glr_gallery_problems_plot_expressions.py`.
#
# K basis shapes need at least ``3 K + 4`` points and ``ceil(8 (K + 2) / 5)`` frames:
# for a hand of 21 points, K is at most five. With calibrated cameras, ``2 J - 7`` basis
# shapes of J points are possible: 35 of a hand. Many more frames are better.
