"""An estimator through fits, refusals, interruptions, saving and loading, in any order.

After each step it is fitted whole, and keeps its promises, or it is not fitted at all.
A fit that is refused or interrupted leaves the former one as it was.
The fits of very small tables tell nothing of how good a model is.
"""

import contextlib
import copy
import inspect
import pickle
import tempfile
import warnings
from pathlib import Path

import numpy as np
import pandas as pd
import pytest
from hypothesis import settings, strategies as st
from hypothesis.stateful import (
    RuleBasedStateMachine,
    initialize,
    invariant,
    precondition,
    rule,
    run_state_machine_as_test,
)
from interrupts import interrupted_after
from layers import slow_after
from numpy.testing import assert_allclose, assert_array_equal
from refusals import refused
from scenes import with_gaps
from sklearn.base import clone
from sklearn.exceptions import NotFittedError

import isa_nrsfm
from isa_nrsfm import AffineNRSfM
from isa_nrsfm.datasets import make_nonrigid_tracks
from isa_nrsfm.io import load_model, save_model

PACKAGE = str(Path(isa_nrsfm.__file__).parent)
ESTIMATOR = inspect.getsourcefile(AffineNRSfM)
# Coefficients have unit variance.
ROUNDING = 1e-8


def replaced(X, place, value):
    """Return a copy of a table with a value at a place."""
    X = X.copy()
    X[place] = value
    return X


NAMES = [f"{axis}_{j}" for j in range(13) for axis in "xy"]
# What is done to tables that a fit takes as they are, and that it refuses.
KINDS = {
    "plain": lambda X, rng: X,
    "missing": lambda X, rng: with_gaps(X, 0.1, rng),
    "noise": lambda X, rng: rng.normal(size=X.shape),
    "integers": lambda X, rng: rng.integers(0, 3, X.shape),
    "rigid": lambda X, rng: X[0] + 0.01 * rng.normal(size=X.shape),
    "named": lambda X, rng: pd.DataFrame(X, columns=NAMES[: X.shape[1]]),
    "single precision": lambda X, rng: X.astype(np.float32),
    "far": lambda X, rng: X + 1e6,
    "large": lambda X, rng: X * 1e100,
    "small": lambda X, rng: X * 1e-100,
    "empty row": lambda X, rng: replaced(X, rng.integers(len(X)), np.nan),
    "equal frames": lambda X, rng: np.repeat(X[:1], len(X), axis=0),
    "low rank": lambda X, rng: X,  # without noise
    "one line": lambda X, rng: np.repeat(X[:, ::2], 2, axis=1),
    "same points": lambda X, rng: replaced(X, np.s_[:, 2:4], X[:, :2]),
    "one far point": lambda X, rng: replaced(
        X, np.s_[0, :2], 10.0 ** rng.integers(2, 141)
    ),
    "infinite": lambda X, rng: replaced(X, (rng.integers(len(X)), 3), np.inf),
    "odd": lambda X, rng: X[:, 1:],
    "text": lambda X, rng: replaced(X.astype(str).astype(object), (0, 0), "nose"),
    "constant frame": lambda X, rng: replaced(X, rng.integers(len(X)), 1.0),
    "few frames": lambda X, rng: X,
    "one point missing": lambda X, rng: replaced(X, np.s_[:, :2], np.nan),
}
tables = st.tuples(st.sampled_from([*KINDS]), st.integers(0, 2**16))
PARAMETERS = {
    "n_components": [1, 2, 0, "auto", True],
    "refinement": ["joint", "alternating", None],
    "camera": ["affine", "weak_perspective", "orthographic"],
    "loss": ["linear", "huber", "cauchy"],
    "independence": ["shapes", "coefficients", None],
    "layout": ["interleaved", "planar"],
    "scale_frames": [True, False],
    "keep_frames": [True, False],
    "max_iter": [3, 30],
    "random_state": [0, 1, None],
    "tol": [None, 1e-3],
}


def table(kind, seed):
    """Return a table of few frames and points."""
    rng = np.random.default_rng(seed)
    n_frames = 4 if kind == "few frames" else int(rng.integers(5, 17))
    n_points = int(rng.integers(7, 14))
    noise = 0.0 if kind == "low rank" else 0.02
    seed = int(rng.integers(2**16))
    tracks = make_nonrigid_tracks(n_frames, n_points, 1, noise=noise, random_state=seed)
    return KINDS[kind](tracks.data, rng)


@contextlib.contextmanager
def only_own_warnings():
    """Take warnings of the package as they come, and all others as errors."""
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        warnings.simplefilter("ignore", UserWarning)
        yield


def assert_not_fitted(model, X, folder):
    """Assert that an estimator does nothing that needs a fit, and says so."""
    tables = ("transform", "decompose", "reconstruct", "reproject", "score")
    calls = dict.fromkeys(tables, (X,)) | {"inverse_transform": (np.zeros((1, 1)),)}
    calls |= dict.fromkeys(("diagnostics", "mirrored", "get_feature_names_out"), ())
    for name, given in calls.items():
        refused(None, getattr(model, name), *given, error=NotFittedError)
    refused(None, save_model, model, folder / "none.npz", error=NotFittedError)
    assert not any(folder.iterdir())
    assert [name for name in vars(model) if name.endswith("_")] == []


def pickled(model):
    return pickle.loads(pickle.dumps(model))


class Estimator(RuleBasedStateMachine):
    """One estimator, and what it should be."""

    def __init__(self):
        super().__init__()
        self.folder = tempfile.TemporaryDirectory()
        self.path = Path(self.folder.name)
        self.model = AffineNRSfM(1, max_iter=3, random_state=0)
        self.X = make_nonrigid_tracks(12, 8, 1, noise=0.02, random_state=0).data
        self.fitted = False

    def teardown(self):
        self.folder.cleanup()

    @initialize(
        changes=st.sampled_from([{}, {"refinement": None}]), kind_and_seed=tables
    )
    def begin(self, changes, kind_and_seed):
        assert_not_fitted(self.model, self.X, self.path)
        self.model.set_params(**changes)
        self.fit(kind_and_seed)

    def note_fit(self, X):
        """Note what the fitted model finds, which must not change any more."""
        self.fitted, self.X = True, X
        with only_own_warnings():
            self.alpha = self.model.transform(X)
        self.attributes = set(vars(self.model))

    def fit_of(self, X, interruption):
        """Fit a table, and note what is found if the fit ends."""
        before = vars(self.model).get("_model")
        try:
            with only_own_warnings(), interruption:
                self.model.fit(X)
        except np.linalg.LinAlgError:  # a ValueError, but of NumPy
            raise
        except (ValueError, TypeError):  # the former fit is still there
            return
        except KeyboardInterrupt:
            # Before its results are set, what was found earlier stays as it was.
            # After that, it is whole.
            if vars(self.model).get("_model") is before:
                return
        self.note_fit(X)

    @rule(kind_and_seed=tables)
    def fit(self, kind_and_seed):
        self.fit_of(table(*kind_and_seed), contextlib.nullcontext())

    @rule(
        kind_and_seed=tables,
        lines=st.one_of(
            st.tuples(st.integers(1, 150), st.just(ESTIMATOR)),
            st.tuples(st.integers(1, 20_000), st.just(PACKAGE)),
        ),
    )
    def interrupt(self, kind_and_seed, lines):
        self.fit_of(table(*kind_and_seed), interrupted_after(*lines))

    @rule(data=st.data())
    def set_params(self, data):
        name = data.draw(st.sampled_from([*PARAMETERS]))
        self.model.set_params(**{name: data.draw(st.sampled_from(PARAMETERS[name]))})

    @rule()
    def clone(self):
        assert_not_fitted(clone(self.model), self.X, self.path)

    @rule(copied=st.sampled_from([copy.deepcopy, pickled]))
    def copy(self, copied):
        self.model = copied(self.model)

    @precondition(lambda self: self.fitted)
    @rule()
    def save_and_load(self):
        path = self.path / "model.npz"
        save_model(self.model, path)
        assert [*self.path.iterdir()] == [path]
        loaded = load_model(path)
        path.unlink()
        assert str(loaded.get_params()) == str(self.model.get_params())
        for name, value in vars(self.model).items():
            if isinstance(value, np.ndarray):
                assert_array_equal(getattr(loaded, name), value)
        # A file has the stability in place of the fits of halves that it follows from.
        self.attributes = set(vars(self.model)) - {"_halves", "_stability"}
        self.model = loaded

    @precondition(lambda self: self.fitted)
    @rule(row=st.integers(0, 9))
    def rows_by_themselves(self, row):
        row %= len(self.X)
        for n_rows in (1, 3):
            rows = slice(row, row + n_rows)
            with only_own_warnings():
                alpha = self.model.transform(self.X[rows])  # also of a DataFrame
            assert_allclose(alpha, self.alpha[rows], rtol=0, atol=ROUNDING)

    @invariant()
    def whole_or_not_at_all(self):
        if not self.fitted:
            assert_not_fitted(self.model, self.X, self.path)
            return
        model = self.model
        assert set(vars(model)) == self.attributes
        with only_own_warnings():
            alpha = model.transform(self.X)
        assert_array_equal(alpha, self.alpha)
        shown = ~np.isnan(np.asarray(self.X, dtype=float)).all(axis=1)
        assert np.isfinite(alpha[shown]).all()
        assert np.isnan(alpha[~shown]).all()
        if hasattr(model, "alpha_"):
            assert_allclose(model.alpha_, alpha, rtol=0, atol=ROUNDING)
        for name, value in vars(model).items():
            numbers = name.endswith("_") and np.asarray(value).dtype.kind == "f"
            if numbers and name != "mirror_certainty_":
                per_frame = np.shape(value)[:1] == shown.shape
                assert np.isfinite(value[shown] if per_frame else value).all(), name


FEW = settings(max_examples=3, stateful_step_count=4)
MANY = settings(max_examples=40, stateful_step_count=10)


@pytest.mark.parametrize("examples", slow_after(1, [FEW, MANY]), ids=["few", "many"])
def test_an_estimator_is_fitted_whole_or_not_at_all(examples):
    run_state_machine_as_test(Estimator, settings=examples)
