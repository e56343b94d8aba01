"""What a notebook shows of a model."""

import re
from copy import copy

import numpy as np
import pytest
from refusals import warned
from sklearn.base import clone
from sklearn.pipeline import make_pipeline

from isa_nrsfm import AffineNRSfM
from isa_nrsfm.datasets import make_nonrigid_tracks

pytestmark = pytest.mark.filterwarnings("ignore:PooledFastICA did not converge")

TABLE = make_nonrigid_tracks(60, 16, 2, noise=0.02, random_state=0).data


def estimator(**params):
    return AffineNRSfM(2, random_state=0, **params)


def summary(model):
    """Return the rows of the summary, without tags."""
    shown = model._repr_html_()
    assert model._repr_mimebundle_()["text/html"].count("isa-nrsfm-summary") == 1
    rows = re.findall(r"<tr><th[^>]*>(.*?)</th><td[^>]*>(.*?)</td></tr>", shown)
    return dict(rows)


@pytest.fixture(scope="module")
def model():
    return estimator().fit(TABLE)


def test_unfitted_models_have_no_summary():
    assert "isa-nrsfm-summary" not in estimator()._repr_html_()


def test_summary_of_the_joint_refinement(model):
    shown = summary(model)
    assert shown["Shapes"] == "2 basis shapes of 16 points"
    assert shown["Frames"] == "60"
    percent = 100 * np.array([model.inverse_snr_, model.rank_floor_])
    expected = "{:.3g} %, rank floor {:.3g} %".format(*percent)
    assert shown["Inverse SNR"] == expected
    assert shown["Noise"].endswith(" of a frame&#x27;s size")
    assert shown["Energy of each"].count(" %") == 2
    assert shown["Diagnostics"] == "no warning"
    assert shown["Cameras"].startswith("affine; calibrated cameras explain the table")


@pytest.mark.parametrize("camera", ["weak_perspective", "orthographic"])
def test_summary_of_calibrated_cameras(camera):
    options = {"camera": camera, "noise": 0.02, "random_state": 0}
    table = make_nonrigid_tracks(60, 16, 2, **options).data
    shown = summary(estimator(camera=camera).fit(table))
    assert shown["Cameras"].startswith(f"{camera.replace('_', ' ')}; ")
    unit = "in the units of the table" if camera == "orthographic" else "s size"
    assert shown["Noise"].endswith(unit)
    shown = summary(estimator(camera=camera, refinement=None).fit(table))
    assert shown["Cameras"] == camera.replace("_", " ")


def test_rows_without_points_are_told():
    table = TABLE.copy()
    table[[3, 8]] = np.nan
    shown = summary(warned("2 of 60", estimator(scale_frames=False).fit, table))
    assert shown["Frames"] == "58, 2 rows without points"
    assert shown["Noise"].endswith("in the units of the table")


def test_warnings_of_the_diagnostics_are_shown(model):
    model = copy(model)
    model.reliability_ = np.array([0.3, 0.0])
    assert "does not support" in model.diagnostics().messages[0]
    assert "at most n_components=1" in summary(model)["Diagnostics"]


@pytest.mark.parametrize(
    "params", [{"refinement": "alternating"}, {"keep_frames": False}], ids=str
)
def test_what_is_not_known_is_left_out(params):
    shown = summary(estimator(**params).fit(TABLE))
    assert "Diagnostics" not in shown
    assert "Inverse SNR" in shown


def test_names_of_columns_are_escaped(model):
    pandas = pytest.importorskip("pandas")
    names = [f"<marked>{column}" for column in range(32)]
    named = clone(model).set_params(refinement=None)
    named.fit(pandas.DataFrame(TABLE, columns=names))
    shown = make_pipeline(named)._repr_html_() + named._repr_html_()
    assert "<marked>" not in shown
    assert "isa-nrsfm-summary" in shown


@pytest.mark.parametrize(("n_components", "more"), [(12, ""), (13, ", ...")])
def test_energies_of_the_first_twelve_basis_shapes_are_shown(model, n_components, more):
    model = copy(model)
    model.energy_share_ = np.full(n_components, 0.05)
    assert summary(model)["Energy of each"] == ", ".join(["5 %"] * 12) + more
