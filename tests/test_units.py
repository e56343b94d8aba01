"""Results for a table in another unit, turned in the image plane and moved.

Attributes and methods are those of the page of conventions and of the docstring.
"""

import inspect
import re
from functools import cache

import numpy as np
import pytest
from layers import Quick, slow_after, start_may_not_converge
from numpy.testing import assert_allclose
from project import text
from scipy.spatial.transform import Rotation
from sklearn.base import BaseEstimator, TransformerMixin

from isa_nrsfm import AffineNRSfM
from isa_nrsfm.datasets import make_face_tracks

# The second table is the first one times ten, turned, and moved.
TIMES, PLACE = 10.0, np.array([300.0, -200.0])
TURN = Rotation.from_rotvec([0.0, 0.0, 0.4]).as_matrix()
# What the words of the page's table are worth for the second table.
FACTORS = {"1": 1.0, "unit": TIMES, "unit^2": TIMES**2, "1 / unit": 1 / TIMES}
# The settings that have a column of the page's table, in its order.
SCALED = [{"scale_frames": True}, {"scale_frames": False}]
COLUMNS = [{"camera": "affine"} | each for each in SCALED]
COLUMNS += [{"camera": "weak_perspective"} | each for each in SCALED]
COLUMNS.append({"camera": "orthographic"})
OF_JOINT_FIT = {
    *("alpha_std_", "noise_variance_", "camera_noise_ratio_", "depth_uncertainty_"),
    *("reliability_", "objective_history_", "gradient_norm_", "stability_"),
}
# What is different with orthographic cameras where there is no joint refinement: it is
# the covariance of what multiplies white signals, not shapes in the units of the table.
OF_WHITE_SIGNALS = {"mode_covariance_": "unit^2"}
NO_NUMBERS = {"isa_", "feature_names_in_", "camera_", "frames_scaled_", "stable_sets_"}
# In words below the table
OF_PERSPECTIVE = {"positions_", "focal_length_", "focal_length_std_", "prior_std_"}
OF_PERSPECTIVE |= {"pose_effect_"}
FIGURES = ("camera_singular_values", "deformation_amplitude", "effective_frames")
FIGURES += ("weak_deviations", "pose_share")
# Results that turn with the images.
POSITIONS = {"translation", "reference_translation", "images"}
SHAPES = {"mean_shape", "basis", "shapes", "euclidean_shapes"}
MATRICES = {"motion", "reference_motion", "rotations", "rotation_covariance"}


def units():
    """Return the rows of the page's table: a word for each column, by attribute."""
    section = text("docs/conventions.md").partition("## Units of the attributes")
    rows = {}
    for line in section[2].partition("\n## ")[0].splitlines():
        if line.startswith("| `"):
            names, *words = [cell.strip() for cell in line.split("|")[1:-1]]
            rows |= dict.fromkeys(re.findall(r"`(\w+_)`", names), words)
    return rows


def table(camera):
    """Return a table that such cameras see."""
    camera = camera if camera == "orthographic" else "weak_perspective"
    options = {"n_components": 2, "noise": 0.01, "camera": camera, "random_state": 0}
    return make_face_tracks(24, **options).tracks[:, ::5].reshape(24, -1)


def changed(name, value, factor):
    """Return a result for the second table, from that for the first one."""
    value = factor * np.asarray(value)
    if name in POSITIONS:
        return value @ TURN[:2, :2].T + PLACE
    if name in SHAPES:
        return value @ TURN.T
    if name in MATRICES:
        n_rows = value.shape[-2]
        return TURN[:n_rows, :n_rows] @ value @ TURN.T
    if name == "mode_covariance":
        turns = np.kron(np.eye(len(value) // 3), TURN)
        return turns @ value @ turns.T
    return value


def second_table(X):
    return changed("images", X.reshape(len(X), -1, 2), TIMES).reshape(X.shape)


@cache
def fitted(second=False, **settings):
    """Return a model of one of the two tables, to be left as it is."""
    X = table(settings["camera"])
    # More steps amplify rounding errors.
    model = Quick(2, random_state=0, **settings)
    return model.fit(second_table(X) if second else X)


def assert_changed(second, first, name, word, tolerance=1e-7):
    """Check that a result for the second table is that of the first one, changed."""
    expected = changed(name, first, FACTORS[word])
    size = np.abs(expected).max()
    assert size > 0, name
    assert_allclose(second, expected, rtol=0, atol=tolerance * size, err_msg=name)


def documented():
    """Return the attributes that the docstring of the estimator lists."""
    doc = inspect.getdoc(AffineNRSfM).partition("\nAttributes\n")[2]
    return set(re.findall(r"^(\w+_) : ", doc.partition("\nSee Also\n")[0], re.M))


def test_the_page_has_all_attributes():
    assert set(units()) == documented() - NO_NUMBERS - OF_PERSPECTIVE
    assert all(len(words) == len(COLUMNS) for words in units().values())


# The paper's pipeline says so of tables with as few points as this one.
@start_may_not_converge
@pytest.mark.parametrize("refinement", slow_after(1, ["joint", "alternating"]))
@pytest.mark.parametrize("column", slow_after(1, [2, 4, 0, 1, 3]))
def test_attributes(column, refinement):
    settings = COLUMNS[column] | {"refinement": refinement}
    first, second = fitted(**settings), fitted(True, **settings)
    for name, words in units().items():
        word = words[column]
        if refinement != "joint" and name in OF_JOINT_FIT:
            word = ""
        if refinement != "joint" and settings["camera"] == "orthographic":
            word = OF_WHITE_SIGNALS.get(name, word)
        if not word:
            assert not hasattr(first, name)
            continue
        values = [getattr(model, name) for model in (second, first)]
        if np.isnan(values[0]).all():  # no point is missing
            assert name == "mirror_certainty_"
            continue
        if refinement != "joint" and name == "mode_covariance_":  # in other axes
            values, name = [np.linalg.eigvalsh(value) for value in values], "energies"
        # A gradient near zero has the rounding errors of the terms that cancel.
        tolerance = 1e-5 if name == "gradient_norm_" else 1e-7
        assert_changed(*values, name.removesuffix("_"), word, tolerance)


def results(model, X):
    """Return the results of methods for a table, by method and name."""
    decomposition, smoothed = model.decompose(X), model.smooth(X)
    diagnostics = model.diagnostics(X)
    images = model.reproject(X), model.inverse_transform(decomposition.alpha)
    images = [{"images": each.reshape(len(X), -1, 2)} for each in images]
    found = {
        "transform": {"alpha": model.transform(X)},
        "decompose": decomposition._asdict(),
        "smooth": smoothed.decomposition._asdict() | {"times": smoothed.time_scales},
        "reconstruct": {"shapes": model.reconstruct(X)},
        "shapes": {"shapes": model.shapes(decomposition.alpha)},
        "reproject": images[0],
        "inverse_transform": images[1],
        "score": {"score": model.score(X)},
        "diagnostics": {name: getattr(diagnostics, name) for name in FIGURES},
        "mirrored": {"basis": model.mirrored().basis_ * [1.0, 1.0, -1.0]},
    }
    if model.camera == "affine":
        shapes = model.reconstruct(X, camera="orthographic")
        found["reconstruct"]["euclidean_shapes"] = shapes
    else:
        found["reconstruct"]["depth_std"] = model.reconstruct(X, return_std=True)[1]
        covariance = model.rotation_covariance(X)
        found["rotation_covariance"] = {"rotation_covariance": covariance}
    return found


@pytest.mark.parametrize("column", slow_after(1, [0, 2, 4, 1, 3]))
def test_methods(column):
    settings = COLUMNS[column] | {"refinement": "joint"}
    first, second = fitted(**settings), fitted(True, **settings)
    X = table(settings["camera"])
    X = X[np.argsort(first.alpha_[:, 0])]  # slow changes, which `smooth` needs
    words = {name.removesuffix("_"): words[column] for name, words in units().items()}
    words |= {"images": "unit", "euclidean_shapes": "unit"}
    words |= dict.fromkeys(["shapes", "depth_std"], words["mean_shape"])
    if settings["camera"] == "orthographic":  # the cameras of frames of size one
        words["camera_singular_values"] = "1 / unit"
    other = results(second, second_table(X))
    for method, found in results(first, X).items():
        for name, value in found.items():
            word = words.get(name) or "1"
            # The noise of random walks has the axes of the image.
            tolerance = 0.05 if method == "smooth" else 1e-7
            assert_changed(other[method][name], value, name, word, tolerance)
    if settings["camera"] != "affine":
        assert set(other) == public_methods()


def public_methods():
    """Return the methods that have results of their own."""
    inherited = {*dir(BaseEstimator), *dir(TransformerMixin)}
    names = {*dir(AffineNRSfM)} - inherited - {"fit", "set_callbacks"}
    return {
        name for name in names if not re.search("^_|_$|_request$|_names_out$", name)
    }


@start_may_not_converge
def test_orthographic_cameras_do_not_scale_frames():
    # So that one column of the page is enough.
    settings = {"camera": "orthographic", "refinement": None}
    scaled, other = (fitted(**settings, **each) for each in SCALED)
    for name in units():
        values = (getattr(model, name, None) for model in (scaled, other))
        np.testing.assert_equal(*values, err_msg=name)
