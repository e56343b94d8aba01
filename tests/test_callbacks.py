"""Progress of fits: what callbacks are told, alone and inside other estimators."""

import importlib.util
import pickle
import sys

import joblib
import pytest
from numpy.testing import assert_array_equal
from refusals import warned
from sklearn.base import clone
from sklearn.decomposition import PCA
from sklearn.model_selection import GridSearchCV
from sklearn.pipeline import make_pipeline

from isa_nrsfm import AffineNRSfM
from isa_nrsfm._compat import callbacks as _callbacks
from isa_nrsfm._fit import JOINT_STAGE, stages_of
from isa_nrsfm.datasets import make_nonrigid_tracks
from isa_nrsfm.io import load_model, save_model

callback = pytest.importorskip("sklearn.callback", reason="new in scikit-learn 1.9")

pytestmark = pytest.mark.filterwarnings("ignore:PooledFastICA did not converge")

TABLE = make_nonrigid_tracks(40, 16, 1, noise=0.02, random_state=0).data


def estimator(**params):
    return AffineNRSfM(1, random_state=0, **params)


class Recorder:
    """Keeps what it is told, and goes on to the estimators inside others."""

    max_propagation_depth = None

    def __init__(self):
        self.told = []

    def setup(self, estimator, context):
        self.told.append(("setup", type(estimator).__name__, ""))

    def teardown(self, estimator, context):
        self.told.append(("teardown", type(estimator).__name__, ""))

    def on_fit_task_begin(self, estimator, context, *, X=None):
        self.told.append(("begin", type(estimator).__name__, context.task_name))

    def on_fit_task_end(self, estimator, context, *, X=None, fitted_estimator=None):
        self.told.append(("end", type(estimator).__name__, context.task_name))
        self.last = X, fitted_estimator

    def tasks(self, kind="end", of="AffineNRSfM"):
        return [task for told, name, task in self.told if (told, name) == (kind, of)]


def recorded(model, X=TABLE):
    """Fit with a recorder, and return both."""
    recorder = Recorder()
    return model.set_callbacks(recorder).fit(X), recorder


def assert_nested(recorder):
    """Assert that each task ends after those that began in it."""
    open_tasks = []
    for told, name, task in recorder.told:
        if told in ("setup", "begin"):
            open_tasks.append((name, task))
        else:
            assert open_tasks.pop() == (name, task)
    assert open_tasks == []


class TestAlone:
    def test_stages_are_told_in_order(self):
        _, recorder = recorded(estimator(max_iter=200))
        assert_nested(recorder)
        stages = [task for task in recorder.tasks() if task != "step"]
        assert stages == [*stages_of("joint"), "fit"]

    def test_the_papers_refinement_has_no_joint_stage(self):
        _, recorder = recorded(estimator(refinement="alternating"))
        assert_nested(recorder)
        expected = stages_of("alternating")
        assert recorder.tasks() == [*expected, "fit"]

    def test_steps_are_told_of_the_joint_refinement(self):
        model, recorder = recorded(estimator())
        begun = recorder.tasks("begin")
        start = begun.index(JOINT_STAGE) + 1
        steps = begun[start : begun.index("gauge and coefficients")]
        assert set(steps) == {"step"}
        assert begun.count("step") == len(steps)
        assert len(steps) >= model.n_iter_

    def test_the_end_comes_with_a_fitted_estimator(self):
        model, recorder = recorded(estimator(refinement=None))
        X, fitted = recorder.last
        assert X is TABLE
        assert_array_equal(fitted.transform(X), model.alpha_)

    def test_callbacks_make_no_difference_to_the_fit(self):
        model, _ = recorded(estimator())
        assert_array_equal(model.alpha_, estimator().fit(TABLE).alpha_)

    def test_callbacks_are_dismissed_when_a_fit_fails(self):
        recorder = Recorder()
        with pytest.raises(ValueError, match="loss='huber' needs"):
            estimator(loss="huber", refinement=None).set_callbacks(recorder).fit(TABLE)
        assert recorder.told[-1][:2] == ("teardown", "AffineNRSfM")

    def test_clones_have_the_callbacks(self):
        recorder = Recorder()
        clone(estimator(refinement=None).set_callbacks(recorder)).fit(TABLE)
        assert "table" in recorder.tasks()

    def test_files_hold_no_callbacks(self, tmp_path):
        model, recorder = recorded(estimator(refinement=None))
        loaded = pickle.loads(pickle.dumps(model))
        assert_array_equal(loaded.transform(TABLE), model.alpha_)
        save_model(model, tmp_path / "model.npz")
        loaded = load_model(tmp_path / "model.npz")
        assert_array_equal(loaded.transform(TABLE), model.alpha_)
        n_told = len(recorder.told)
        model.fit(TABLE)
        assert len(recorder.told) > n_told


class TestInside:
    def test_a_pipeline(self):
        pipeline = make_pipeline(estimator(refinement=None), PCA(1))
        _, recorder = warned("PCA does not support callbacks", recorded, pipeline)
        assert recorder.tasks().count("table") == 1
        assert recorder.told[0] == ("setup", "Pipeline", "")

    def test_a_grid_search_with_several_workers(self):
        grid = {"block_recovery": ["eigen", "generalized_eigen"]}
        search = GridSearchCV(estimator(refinement=None), grid, cv=2, n_jobs=2)
        with joblib.parallel_config("threading"):
            _, recorder = recorded(search)
        for task in ("table", "gauge and coefficients"):
            assert recorder.tasks().count(task) == 5


def test_progress_bars_of_scikit_learn(capsys):
    pytest.importorskip("rich")
    estimator(max_iter=200).set_callbacks(callback.ProgressBar()).fit(TABLE)
    fit, joint = capsys.readouterr().out.strip().splitlines()
    assert fit.startswith("AffineNRSfM - fit")
    assert joint.strip().startswith(f"AffineNRSfM - {JOINT_STAGE}")
    assert all("100%" in bar for bar in (fit, joint))


def test_before_callbacks_lines_tell_of_the_progress(monkeypatch, capsys):
    monkeypatch.setitem(sys.modules, "sklearn.callback", None)  # not to be imported
    spec = importlib.util.spec_from_file_location("before", _callbacks.__file__)
    before = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(before)

    class Estimator(before.CallbackSupportMixin):
        verbose = 1

    progress = before.FitProgress(Estimator(), ["one", "two"], stepwise="two", X=TABLE)
    progress("one")
    progress.step()
    progress("two")
    progress.end()
    lines = capsys.readouterr().out.splitlines()
    assert lines == ["[Estimator] one: 0.00 s", "[Estimator] two: 0.00 s"]
    assert not hasattr(Estimator(), "set_callbacks")
