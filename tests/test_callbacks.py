"""Progress of fits: what callbacks are told, alone and inside other estimators."""

import pickle
import subprocess
import sys

import joblib
import pytest
from layers import may_not_converge
from numpy.testing import assert_array_equal
from refusals import refused, warned
from sklearn.base import clone
from sklearn.decomposition import PCA
from sklearn.model_selection import GridSearchCV
from sklearn.pipeline import make_pipeline

from isa_nrsfm import AffineNRSfM, FastISA
from isa_nrsfm.datasets import make_nonrigid_tracks
from isa_nrsfm.io import load_model, save_model

callback = pytest.importorskip("sklearn.callback", reason="new in scikit-learn 1.9")

pytestmark = may_not_converge

TABLE = make_nonrigid_tracks(20, 12, 1, noise=0.02, random_state=0).data
JOINT, LAST = "joint refinement", "gauge and coefficients"
PAPER_STAGES = ["table", "factorisation", "independent subspaces"]
PAPER_STAGES.append("block structure and refinement")


def estimator(**params):
    return AffineNRSfM(1, isa=FastISA(n_init=1), random_state=0, **params)


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

    def assert_nested(self):
        """Assert that each task ends after those that began in it."""
        open_tasks = []
        for told, name, task in self.told:
            if told in ("setup", "begin"):
                open_tasks.append((name, task))
            else:
                assert open_tasks.pop() == (name, task)
        assert open_tasks == []


def recorded(model, X=TABLE):
    """Fit with a recorder, and return both."""
    recorder = Recorder()
    return model.set_callbacks(recorder).fit(X), recorder


def test_stages_and_steps_of_the_joint_refinement():
    model, recorder = recorded(estimator(max_iter=200))
    recorder.assert_nested()
    stages = [task for task in recorder.tasks() if task != "step"]
    assert stages == [*PAPER_STAGES, JOINT, LAST, "fit"]
    begun = recorder.tasks("begin")
    steps = begun[begun.index(JOINT) + 1 : begun.index(LAST)]
    assert set(steps) == {"step"}
    assert begun.count("step") == len(steps) >= model.n_iter_
    # Callbacks make no difference to the fit.
    assert_array_equal(model.alpha_, estimator(max_iter=200).fit(TABLE).alpha_)


def test_the_papers_refinement_has_no_joint_stage_and_callbacks_are_dismissed():
    model, recorder = recorded(estimator(refinement="alternating"))
    recorder.assert_nested()
    assert recorder.tasks() == [*PAPER_STAGES, LAST, "fit"]
    # Also when a fit fails
    recorder.told.clear()
    refused("loss='huber' needs", model.set_params(loss="huber").fit, TABLE)
    assert recorder.told[-1] == ("teardown", "AffineNRSfM", "")


def test_clones_have_the_callbacks_and_files_do_not(tmp_path):
    model, recorder = recorded(estimator(refinement=None))
    # The end comes with a fitted estimator.
    X, fitted = recorder.last
    assert X is TABLE
    save_model(model, tmp_path / "model.npz")
    loaded = load_model(tmp_path / "model.npz")
    for other in (fitted, loaded, pickle.loads(pickle.dumps(model))):
        assert_array_equal(other.transform(TABLE), model.alpha_)
    for again in (model, clone(model)):
        n_told = len(recorder.told)
        again.fit(TABLE)
        assert len(recorder.told) > n_told


def test_progress_inside_other_estimators():
    pipeline = make_pipeline(estimator(refinement=None), PCA(1))
    grid = {"affinenrsfm__block_recovery": ["irls", "generalized_eigen"]}
    search = GridSearchCV(pipeline, grid, cv=2, n_jobs=2)
    with joblib.parallel_config("threading"):
        _, recorder = warned("PCA does not support callbacks", recorded, search)
    assert recorder.tasks().count("table") == recorder.tasks().count(LAST) == 5
    assert recorder.told[0] == ("setup", "GridSearchCV", "")


@pytest.mark.slow
@pytest.mark.subprocess
def test_before_callbacks_lines_tell_of_the_progress():
    code = (
        "import sys, sklearn.datasets, sklearn.decomposition, sklearn.pipeline\n"
        "sys.modules['sklearn.callback'] = None  # no more to be imported\n"
        "from isa_nrsfm import AffineNRSfM\n"
        "from isa_nrsfm.datasets import make_nonrigid_tracks\n"
        "X = make_nonrigid_tracks(40, 16, 1, noise=0.02, random_state=0).data\n"
        "AffineNRSfM(1, random_state=0, verbose=1).fit(X)\n"
        "assert not hasattr(AffineNRSfM(), 'set_callbacks')\n"
    )
    command = [sys.executable, "-W", "ignore", "-c", code]
    lines = subprocess.check_output(command, text=True).splitlines()
    stages = [line.rsplit(":", 1)[0] for line in lines]
    assert stages == [f"[AffineNRSfM] {name}" for name in (*PAPER_STAGES, JOINT, LAST)]
