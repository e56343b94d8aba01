"""Error of points that were held out of the fit of their frame."""

import numpy as np
import pytest
from layers import slow_after
from numpy.testing import assert_allclose
from sklearn.model_selection import GridSearchCV

from isa_nrsfm import AffineNRSfM
from isa_nrsfm._fitted_model import TableModel
from isa_nrsfm._frames.models import FrameMap, PosteriorFrames, RigidFrames
from isa_nrsfm._frames.projection import compose, project
from isa_nrsfm.datasets import make_nonrigid_tracks

NOISE = 0.02
N_FOLDS, FOLD_SEED = 5, 0


def scene(seed=0, n_frames=12, n_points=23):
    """Return the model of frames, its shapes, and tracks with noise."""
    rng = np.random.default_rng(seed)
    sizes = np.array([1.0, 0.3, 0.3])[:, None, None]
    shapes = rng.normal(size=(3, n_points, 3)) * sizes
    shapes -= shapes.mean(axis=1, keepdims=True)
    motion = np.eye(2, 3) + 0.3 * rng.normal(size=(n_frames, 2, 3))
    position = rng.normal(size=(n_frames, 2))
    alpha = rng.normal(size=(n_frames, 2))
    tracks = project(compose(shapes[0], shapes[1:], alpha), motion, position)
    tracks += NOISE * rng.normal(size=tracks.shape)
    others = NOISE**2, np.zeros((0, 2)), "linear", FrameMap.identity(2)
    frames = PosteriorFrames(shapes.transpose(0, 2, 1), *others)
    return frames, shapes, tracks


def energies_of(frames, mean_shape, basis, tracks, sizes):
    model = TableModel(frames, mean_shape, basis, "interleaved", None)
    return model.held_out_energies(tracks.transpose(0, 2, 1), sizes)


def error_of(*scene):
    """Return the inverse SNR of points that are held out."""
    noise, signal = energies_of(*scene)
    return noise / signal


def by_plain_loops(frames, shapes, tracks, sizes):
    """Return the documented error, frame by frame and point by point."""
    n_points = tracks.shape[1]
    folds = np.random.RandomState(FOLD_SEED).permutation(n_points) % N_FOLDS
    noise = signal = 0.0
    for points, size in zip(tracks, sizes, strict=True):
        centre = np.nanmean(points, axis=0)
        for fold in range(N_FOLDS):
            visible = np.where((folds == fold)[:, None], np.nan, points)
            if np.sum(~np.isnan(visible[:, 0])) < 4:
                continue
            fit = frames.fit(visible.T[None], np.array([size]))
            known = ~np.isnan(visible[:, 0])
            affine = np.column_stack([shapes[0], np.ones(n_points)])
            S = shapes[0] + np.tensordot(fit.alpha[0], shapes[1:], 1)
            for j in np.flatnonzero(folds == fold):
                if np.isnan(points[j, 0]):
                    continue
                weights = np.linalg.pinv(affine[known]).T @ affine[j]
                if np.isnan(points).any() and weights @ weights > 2.0:
                    continue
                model = fit.motion[0] @ S[j] + fit.translation[0]
                noise += np.sum((points[j] - model) ** 2) / size**2
                signal += np.sum((points[j] - centre) ** 2) / size**2
    return noise / signal


def hide(tracks, share):
    hidden = np.random.default_rng(1).random(tracks.shape[:2]) < share
    return np.where(hidden[..., None], np.nan, tracks)


@pytest.mark.parametrize("missing", [0.0, 0.3])
@pytest.mark.parametrize("model", ["posterior", "rigid"])
def test_by_plain_loops(model, missing):
    frames, shapes, tracks = scene()
    if model == "rigid":
        frames = RigidFrames(shapes[0], shapes[1:])
    tracks = hide(tracks, missing)
    sizes = np.linspace(1, 3, len(tracks))
    error = error_of(frames, shapes[0], shapes[1:], tracks, sizes)
    assert_allclose(error, by_plain_loops(frames, shapes, tracks, sizes), rtol=1e-8)


@pytest.mark.parametrize("seed", range(4))
def test_two_frames_of_six_points_do_not_decide(seed):
    frames, shapes, tracks = scene(seed, n_frames=120)
    sizes = np.ones(120)
    expected = error_of(frames, shapes[0], shapes[1:], tracks, sizes)
    tracks[:2, 6:] = np.nan
    error = error_of(frames, shapes[0], shapes[1:], tracks, sizes)
    assert error < 1.9 * expected  # without a limit up to fifty times


def test_nothing_that_can_be_held_out_has_no_energy():
    frames, shapes, tracks = scene()
    tracks[:, 3:] = np.nan
    ones = np.ones(len(tracks))
    energies = energies_of(frames, shapes[0], shapes[1:], tracks, ones)
    assert energies == (0.0, 0.0)


# --- score --------------------------------------------------------------------------


def table(n_components, seed, **params):
    params = {"n_frames": 70, "n_points": 34, "noise": NOISE} | params
    params |= {"n_components": n_components, "random_state": seed}
    return make_nonrigid_tracks(**params).data


@pytest.mark.parametrize("refinement", slow_after(2, ["joint", "alternating", None]))
def test_score_is_minus_the_error_and_the_same_each_time(refinement):
    X = table(2, 0, missing=0.1)
    model = AffineNRSfM(2, refinement=refinement, random_state=0).fit(X)
    score = model.score(X)
    assert type(score) is float
    assert score < 0
    assert model.score(X) == score
    assert model.score(X, y=np.zeros(len(X))) == score
    again = AffineNRSfM(2, refinement=refinement, random_state=0).fit(X)
    assert again.score(X) == score


def test_score_weights_frames_as_the_fit_does():
    X = table(2, 0)
    sizes = np.exp(np.random.default_rng(0).normal(size=(len(X), 1)))
    model = AffineNRSfM(2, random_state=0).fit(X)
    assert_allclose(model.score(sizes * X), model.score(X), rtol=1e-8)
    model = AffineNRSfM(2, scale_frames=False, random_state=0).fit(X)
    assert abs(model.score(sizes * X) / model.score(X) - 1) > 1e-3


def test_score_leaves_frames_without_camera_out():
    X = table(2, 0)
    model = AffineNRSfM(2, random_state=0).fit(X)
    expected = model.score(X[5:])
    X[:5, 4:] = np.nan
    assert_allclose(model.score(X), expected, rtol=1e-9)
    X[:, 4:] = np.nan
    assert np.isnan(model.score(X))


@pytest.mark.slow
@pytest.mark.parametrize(("n_components", "seed"), [(1, 0), (3, 2), (5, 4)])
def test_score_of_new_frames_is_best_at_the_true_number(n_components, seed):
    X = table(n_components, seed)
    # The nearest numbers, two of either side: fits far below the true one take long.
    tried = range(max(n_components - 2, 1), min(n_components + 2, 6) + 1)
    grid = {"n_components": tried}
    search = GridSearchCV(AffineNRSfM(random_state=0), grid, cv=2, refit=False)
    search.fit(X)
    assert search.best_params_["n_components"] == n_components
