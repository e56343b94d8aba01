"""
Choosing the number of basis shapes
===================================

More basis shapes always reduce the reprojection error of the fitted points, but not the
error of held-out points. `AffineNRSfM.score` measures the latter: the points are
divided into five parts, and each is predicted from the others, frame by frame. The
score is minus the error relative to the energy of the points. `AffineNRSfMCV` also
holds out frames, so shapes are evaluated on frames that they were not fitted to.
"""

import warnings
from textwrap import fill

import numpy as np
from sklearn.model_selection import GroupKFold

from isa_nrsfm import AffineNRSfM, AffineNRSfMCV
from isa_nrsfm.datasets import make_nonrigid_tracks
from isa_nrsfm.plotting import ComponentChoiceDisplay

tracks = make_nonrigid_tracks(
    n_frames=200, n_points=40, n_components=3, noise=0.02, random_state=0
)
search = AffineNRSfMCV(range(1, 6), estimator=AffineNRSfM(random_state=0))
search.fit(tracks.data)
print("chosen:", search.n_components_)

# %%
# The table was made with three. The error of the points that were fitted goes on
# falling behind that; the held-out error does not.

K = search.cv_results_["param_n_components"]
models = {k: AffineNRSfM(k, random_state=0).fit(tracks.data) for k in K.tolist()}
fitted = [model.inverse_snr_ for model in models.values()]

display = ComponentChoiceDisplay.from_estimator(search)
display.ax_.plot(K, 100 * np.array(fitted), "s--", color="0.6", label="inverse SNR")
display.ax_.legend(frameon=False)
print("held-out errors, %:", -100 * search.cv_results_["mean_test_score"].round(6))

# %%
# ``best_estimator_`` is the fit of all frames with the chosen number, the same as that
# of `AffineNRSfM` alone, and `transform`, `reconstruct` and others use it. With
# ``select="one_standard_error"`` the fewest basis shapes are taken that are not clearly
# worse than the best ones: at most by one standard error.
#
# Where rows belong to persons, and new persons are what matters, all rows of a person
# are held out together. By default blocks of a third of the rows are, for neighbours in
# a video are alike.

person = np.arange(200) // 4
by_person = AffineNRSfMCV(range(2, 5), cv=GroupKFold(5))
print(by_person.fit(tracks.data, groups=person).n_components_)

# %%
# The search follows a path. Each fit starts from earlier fits: from the fit with fewer
# basis shapes and the leading direction of its residual, and for a part of the frames
# also from the fit of all frames. All fits run to convergence, and the start with the
# best fit to the training frames is used. Held-out frames can only provide a start. If
# fits have one minimum, the errors agree with `GridSearchCV` within half a percent. If
# there are several, as for motion capture with affine cameras, both searches may find
# different ones, and errors differ by several percent in either direction.
# ``python -m benchmarks.choice`` prints costs, choices and differences.
#
# On the command line
# -------------------
#
# ``isa-nrsfm fit faces.csv -k 1-8 --output out`` does the same, and fits the table with
# the best. If this is the largest number tried, it prints the cost of the next ones.
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
# `AffineNRSfM.diagnostics` measures how well the table determines a fit, and warns if
# it does not. With five basis shapes, two directions of the coefficients may well be
# noise: their reliability, the share of their variance that is neither uncertainty nor
# noise that the shapes have followed, is zero.

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
# Faces of many people have more small deformations than a table determines. The
# held-out error then falls slowly up to a large K (:doc:`/benchmarks/held_out` has the
# curve of a table of 2500 rendered faces, where it still falls at 13), and there is no
# true number. Choose K for the purpose: few basis shapes that can be interpreted, or as
# many as improve a classifier, cross-validated with the classifier as in
# :ref:`sphx_glr_gallery_problems_plot_expressions.py`.
#
# K needs ``3 K + 4`` points and ``ceil(8 (K + 2) / 5)`` frames at least: a hand of 21
# points can have at most five. Many more frames than that are better.
