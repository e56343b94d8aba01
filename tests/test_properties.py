"""AffineNRSfM on random small tables: the formula, finite numbers."""

import warnings

import numpy as np
from hypothesis import given, strategies as st
from numpy.testing import assert_allclose
from sklearn.base import BaseEstimator
from sklearn.exceptions import ConvergenceWarning

from isa_nrsfm import AffineNRSfM

seeds = st.integers(0, 2**32 - 1)
scaled = st.booleans()


class AsTheyCome(BaseEstimator):
    """A strategy that leaves the signals as they are.

    The iterations of the others amplify rounding errors on tables of noise, and the
    refinement of subspaces that are no deformations ends at nearly singular blocks;
    without both the results are as exact as the rest of the method is.
    """

    def fit(self, signals):
        self.components_ = np.eye(signals.shape[1])
        return self


def fit(tracks, n_components, isa=None, **params):
    """Return the model of tracks; warnings of convergence and layout do not count."""
    isa = AsTheyCome() if isa is None else isa
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", ConvergenceWarning)
        # Tables of noise look alike in both layouts.
        warnings.filterwarnings("ignore", message="layout=", category=UserWarning)
        params = {"refinement": None} | params
        model = AffineNRSfM(n_components, isa=isa, random_state=0, **params)
        return model.fit(tracks.reshape(len(tracks), -1))


@st.composite
def tables(draw):
    """Return tracks of a deforming object with noise, and K."""
    rng = np.random.default_rng(draw(seeds))
    n_components = draw(st.integers(1, 2))
    n_points = draw(st.integers(3 * n_components + 6, 22))
    n_frames = draw(st.integers(4 * n_components + 12, 40))
    shape, *basis = rng.normal(size=(n_components + 1, n_points, 3))
    alpha = 0.4 * rng.normal(size=(n_frames, n_components)) ** 3
    shapes = shape + np.tensordot(alpha, basis, axes=1)
    motion = np.eye(2, 3) + 0.3 * rng.normal(size=(n_frames, 2, 3))
    position = 3 * rng.normal(size=(n_frames, 1, 2))
    noise = 0.02 * rng.normal(size=(n_frames, n_points, 2))
    return shapes @ motion.transpose(0, 2, 1) + position + noise, n_components


# --- formula ------------------------------------------------------------------------


@given(tables(), seeds, scaled)
def test_tables_that_the_model_makes_are_taken_apart_again(table, seed, scale_frames):
    tracks, n_components = table
    model = fit(tracks, n_components, scale_frames=scale_frames)
    rng = np.random.default_rng(seed)
    alpha = rng.normal(size=(7, n_components))
    motion = np.eye(2, 3) + 0.3 * rng.normal(size=(7, 2, 3))
    translation = 10 * rng.normal(size=(7, 2))
    made = model.inverse_transform(alpha, motion, translation)
    shapes = model.mean_shape_ + np.einsum("ik,kjc->ijc", alpha, model.basis_)
    expected = np.einsum("ijc,irc->ijr", shapes, motion) + translation[:, None]
    assert_allclose(made.reshape(7, -1, 2), expected, atol=1e-12 * np.abs(made).max())
    found = model.decompose(made)
    assert_allclose(found.motion, motion, atol=1e-8)
    assert_allclose(found.translation, translation, atol=1e-8)
    assert_allclose(found.alpha, alpha, atol=1e-7)
    assert_allclose(model.reproject(made), made, atol=1e-7 * np.abs(made).max())


# --- degenerate tables --------------------------------------------------------------


@given(seeds, st.integers(0, 4), st.integers(1, 3))
def test_tables_of_low_rank_give_finite_numbers(seed, rank, n_components):
    rng = np.random.default_rng(seed)
    W = rng.normal(size=(40, rank + 1)) @ rng.normal(size=(rank + 1, 16))
    tracks = W.reshape(20, 2, 16).transpose(0, 2, 1)
    model = fit(tracks, n_components)
    assert np.isfinite(model.alpha_).all()
    assert np.isfinite(model.basis_).all()
    used = max(rank + 1 - 3, 0)
    n_empty = max(n_components - -(-used // 3), 0)
    assert np.all(model.alpha_[:, n_components - n_empty :] == 0)
    assert np.all(model.basis_[n_components - n_empty :] == 0)
