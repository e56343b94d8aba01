"""Error of points that were held out of the fit of their frame."""

import numpy as np
import pytest
from layers import may_not_converge, slow_after
from numpy.testing import assert_allclose

from isa_nrsfm import AffineNRSfM
from isa_nrsfm.datasets import make_nonrigid_tracks


def by_plain_loops(model, X):
    """Return the documented score, frame by frame and point by point."""
    tracks = X.reshape(len(X), -1, 2)
    n_points = tracks.shape[1]
    folds = np.random.RandomState(0).permutation(n_points) % 5
    affine = np.column_stack([model.mean_shape_, np.ones(n_points)])
    noise = signal = 0.0
    for fold in range(5):
        visible = np.where((folds == fold)[:, None], np.nan, tracks)
        motion, translation, alpha, _ = model.decompose(visible.reshape(len(X), -1))
        found = model.inverse_transform(alpha, motion, translation)
        for points, fit in zip(tracks, found.reshape(tracks.shape), strict=True):
            centre = np.nanmean(points, axis=0)
            size = np.sqrt(np.nanmean((points - centre) ** 2))
            size = size if model.scale_frames else 1.0
            known = ~np.isnan(points[:, 0]) & (folds != fold)
            for j in np.flatnonzero((folds == fold) & ~np.isnan(points[:, 0])):
                weights = np.linalg.pinv(affine[known]).T @ affine[j]
                if np.isnan(points).any() and weights @ weights > 2.0:
                    continue
                noise += np.sum((points[j] - fit[j]) ** 2) / size**2
                signal += np.sum((points[j] - centre) ** 2) / size**2
    return -noise / signal


# --- score --------------------------------------------------------------------------


def table(n_components, seed, **params):
    params = {"n_frames": 40, "n_points": 24, "noise": 0.02} | params
    params |= {"n_components": n_components, "random_state": seed}
    return make_nonrigid_tracks(**params).data


@may_not_converge
@pytest.mark.parametrize("refinement", slow_after(1, ["joint", "alternating"]))
def test_score_is_minus_the_error_of_held_out_points(refinement):
    X = table(2, 0, missing=0.1)
    # The fit of a part of the points has the size of the whole frame.
    params = {"refinement": refinement, "scale_frames": refinement != "joint"}
    model = AffineNRSfM(2, **params, random_state=0).fit(X)
    score = model.score(X)
    assert type(score) is float
    for few in (X[:6], table(2, 0)[:6], table(2, 0, missing=0.3)[:6]):
        assert_allclose(model.score(few), by_plain_loops(model, few), rtol=1e-6)
    assert model.score(X, y=np.zeros(len(X))) == score


def test_score_weights_frames_as_the_fit_does():
    X = table(2, 0)
    sizes = np.exp(np.random.default_rng(0).normal(size=(len(X), 1)))
    model = AffineNRSfM(2, random_state=0).fit(X)
    assert_allclose(model.score(sizes * X), model.score(X), rtol=1e-8)
    model = AffineNRSfM(2, scale_frames=False, random_state=0).fit(X)
    assert abs(model.score(sizes * X) / model.score(X) - 1) > 1e-3


def test_frames_of_few_points_do_not_decide():
    X = table(2, 1, n_points=23)
    model = AffineNRSfM(2, random_state=0).fit(X)
    expected = model.score(X)
    X[:2, 12:] = np.nan
    assert model.score(X) > 1.9 * expected  # without a limit up to fifty times
    # Without a camera they are left out.
    expected = model.score(X[2:])
    X[:2, 8:] = np.nan
    assert_allclose(model.score(X), expected, rtol=1e-9)
    X[:, 8:] = np.nan
    assert np.isnan(model.score(X))
