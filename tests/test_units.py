"""Units of the fitted attributes: a table times ten changes each by 1, 10 or 100."""

import inspect
import re
from functools import cache
from pathlib import Path

import numpy as np
import pytest
from layers import slow_after
from numpy.testing import assert_allclose

from isa_nrsfm import AffineNRSfM
from isa_nrsfm.datasets import make_nonrigid_tracks

PAGE = Path(__file__).resolve().parents[1] / "docs" / "conventions.md"
TIMES = 10.0
# What the words of the page's table are worth for a table that is ten times as large.
FACTORS = {"1": 1.0, "unit": TIMES, "unit^2": TIMES**2}
# The settings that have a column of the page's table, in its order.
SCALED = [{"scale_frames": True}, {"scale_frames": False}]
COLUMNS = [{"camera": "affine"} | each for each in SCALED]
COLUMNS += [{"camera": "weak_perspective"} | each for each in SCALED]
COLUMNS.append({"camera": "orthographic"})
OF_JOINT_FIT = {
    *("alpha_std_", "noise_variance_", "camera_noise_ratio_", "depth_uncertainty_"),
    *("reliability_", "objective_history_", "gradient_norm_"),
}
# What is different with orthographic cameras where there is no joint refinement: it is
# the covariance of what multiplies white signals, not shapes in the units of the table.
OF_WHITE_SIGNALS = {"mode_covariance_": "unit^2"}
NO_NUMBERS = {"isa_", "feature_names_in_", "camera_", "frames_scaled_"}


def units():
    """Return the rows of the page's table: a word for each column, by attribute."""
    section = PAGE.read_text(encoding="utf-8").partition("## Units of the attributes")
    rows = {}
    for line in section[2].partition("\n## ")[0].splitlines():
        if line.startswith("| `"):
            names, *words = [cell.strip() for cell in line.split("|")[1:-1]]
            rows |= dict.fromkeys(re.findall(r"`(\w+_)`", names), words)
    return rows


def table(camera):
    """Return a table that such cameras see, away from the origin."""
    camera = camera if camera == "orthographic" else "weak_perspective"
    scene = make_nonrigid_tracks(60, 30, 2, noise=0.01, camera=camera, random_state=0)
    return scene.data + 5.0


@cache
def fit_of(times, **settings):
    """Return a model of a table in other units, to be left as it is."""
    model = AffineNRSfM(2, random_state=0, **settings)
    return model.fit(times * table(settings["camera"]))


def assert_times(got, expected, factor, name):
    """Check that all numbers are so many times the expected ones."""
    expected = factor * np.asarray(expected)
    size = np.abs(expected).max()
    assert size > 0, name
    assert_allclose(got, expected, rtol=0, atol=1e-8 * size, err_msg=name)


def documented():
    """Return the attributes that the docstring of the estimator lists."""
    doc = inspect.getdoc(AffineNRSfM).partition("\nAttributes\n")[2]
    return set(re.findall(r"^(\w+_) : ", doc.partition("\nSee Also\n")[0], re.M))


def test_the_page_has_all_attributes():
    assert set(units()) == documented() - NO_NUMBERS
    assert all(len(words) == len(COLUMNS) for words in units().values())


# The paper's pipeline says so of tables with as few points as this one.
@pytest.mark.filterwarnings("ignore:PooledFastICA did not converge")
@pytest.mark.parametrize("refinement", slow_after(1, ["joint", "alternating", None]))
@pytest.mark.parametrize("column", range(len(COLUMNS)))
def test_attributes_have_the_units_of_the_page(column, refinement):
    settings = COLUMNS[column] | {"refinement": refinement}
    one, ten = fit_of(1.0, **settings), fit_of(TIMES, **settings)
    for name, words in units().items():
        word = words[column]
        if refinement != "joint" and name in OF_JOINT_FIT:
            word = ""
        if refinement != "joint" and settings["camera"] == "orthographic":
            word = OF_WHITE_SIGNALS.get(name, word)
        if not word:
            assert not hasattr(one, name)
            continue
        assert_times(getattr(ten, name), getattr(one, name), FACTORS[word], name)


@pytest.mark.parametrize("column", slow_after(2, range(len(COLUMNS))))
def test_methods_have_the_units_of_the_attributes(column):
    settings = COLUMNS[column] | {"refinement": "joint"}
    X = table(settings["camera"])[:20]
    one, ten = fit_of(1.0, **settings), fit_of(TIMES, **settings)
    factors = {name: FACTORS[words[column] or "1"] for name, words in units().items()}
    shapes = one.reconstruct(X)
    assert_times(ten.reconstruct(TIMES * X), shapes, factors["mean_shape_"], "shapes")
    again = ten.decompose(TIMES * X)._asdict()
    for name, value in one.decompose(X)._asdict().items():
        assert_times(again[name], value, factors[f"{name}_"], name)
    assert_times(ten.score(TIMES * X), one.score(X), 1.0, "score")
    assert_times(ten.reproject(TIMES * X), one.reproject(X), TIMES, "images")


def test_orthographic_cameras_do_not_scale_frames():
    # So that one column of the page is enough.
    settings = {"camera": "orthographic", "refinement": "joint"}
    models = [fit_of(1.0, **settings), fit_of(1.0, **settings, scale_frames=False)]
    for name in units():
        values = [getattr(model, name) for model in models]
        np.testing.assert_array_equal(*values, err_msg=name)
