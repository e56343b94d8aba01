"""Tables that are masked, hold pandas' NA, or are at the ends of the numbers' range."""

import warnings

import numpy as np
import pandas as pd
import pytest
from layers import slow_after
from numpy.testing import assert_allclose, assert_array_equal
from refusals import refused

from isa_nrsfm import AffineNRSfM, PooledFastICA
from isa_nrsfm.baselines import PseudoInverseNRSfM
from isa_nrsfm.datasets import make_nonrigid_tracks
from isa_nrsfm.metrics import inverse_snr

SIZES = {"n_frames": 30, "n_points": 12, "n_components": 1}
SCENE = make_nonrigid_tracks(**SIZES, noise=0.02, random_state=0)
X = SCENE.data
# Both coordinates of some points.
HIDDEN = np.repeat(np.random.default_rng(1).random((30, 12)) < 0.05, 2, axis=1)
HOLED = np.where(HIDDEN, np.nan, X)


def estimator(**params):
    return AffineNRSfM(1, random_state=0, **params)


@pytest.fixture(scope="module")
def model():
    return estimator().fit(HOLED)


def test_masked_entries_are_missing(model):
    masked = np.ma.masked_array(X, HIDDEN)
    same = estimator().fit(masked)
    assert_array_equal(same.alpha_, model.alpha_)
    assert_array_equal(model.transform(masked), model.transform(HOLED))
    assert model.score(masked) == model.score(HOLED)
    fitted = model.reproject(HOLED)
    assert inverse_snr(masked, fitted) == inverse_snr(HOLED, fitted)
    assert_array_equal(masked.mask, HIDDEN)


def test_masked_entries_of_memory_maps_are_missing(model, tmp_path):
    np.save(tmp_path / "X.npy", X)
    masked = np.ma.masked_array(np.load(tmp_path / "X.npy", mmap_mode="r"), HIDDEN)
    assert_array_equal(estimator().fit(masked).alpha_, model.alpha_)


def test_masked_whole_numbers_and_single_precision(model):
    whole = np.ma.masked_array(np.round(1000 * X).astype(np.int16), HIDDEN)
    expected = model.transform(np.where(HIDDEN, np.nan, np.round(1000 * X)))
    assert_array_equal(model.transform(whole), expected)
    single = np.ma.masked_array(X.astype(np.float32), HIDDEN)
    assert model.transform(single).dtype == np.float32


def test_masks_are_refused_where_nothing_may_be_missing(model):
    masked = np.ma.masked_array(X, HIDDEN)
    refused("takes no missing points", PseudoInverseNRSfM(1).fit, masked)
    with pytest.raises(ValueError, match="contains NaN"):
        PooledFastICA().fit(np.ma.masked_array(X[:, :9], HIDDEN[:, :9]))
    alpha = np.ma.masked_array(model.alpha_, model.alpha_ > 0)
    refused("alpha contains NaN", model.inverse_transform, alpha)


@pytest.mark.parametrize("dtype", ["Float64", "Int64"])
def test_pandas_na_is_missing(model, dtype):
    numbers = np.round(1000 * X)
    frame = pd.DataFrame(numbers).astype("Float64").mask(HIDDEN).astype(dtype)
    expected = model.transform(np.where(HIDDEN, np.nan, numbers))
    assert_array_equal(model.transform(frame), expected)


@pytest.mark.parametrize("size", slow_after(1, [2.0**-460, 2.0**460]))
@pytest.mark.parametrize(
    "params",
    [
        {},
        {"loss": "cauchy"},
        {"scale_frames": False},
        {"camera": "weak_perspective"},
        {"camera": "orthographic"},
        {"refinement": None, "scale_frames": False},
    ],
    ids=str,
)
def test_sizes_within_the_range_change_no_coefficient(params, size):
    """Powers of two: the numbers of the larger table are the same but for exponents."""
    with warnings.catch_warnings():
        warnings.filterwarnings("ignore", "the depth of the shapes is not determined")
        usual, scaled = (estimator(**params).fit(s * X) for s in (1.0, size))
    assert_allclose(scaled.alpha_, usual.alpha_, atol=1e-6)
    assert_allclose(scaled.inverse_snr_, usual.inverse_snr_, rtol=1e-6)


@pytest.mark.parametrize("size", [1e160, 1e300, 1e-160, 1e-300])
def test_coordinates_outside_the_range_are_refused(model, size, tmp_path):
    match = "between 1e-150 and 2e\\+153 .* another unit"
    refused(match, estimator().fit, size * X)
    refused(match, PseudoInverseNRSfM(1).fit, size * X)
    refused(r"in row 2\. Give", model.transform, np.concatenate([X[:2], size * X]))
    np.save(tmp_path / "X.npy", size * X)
    refused(match, estimator().fit, np.load(tmp_path / "X.npy", mmap_mode="r"))


@pytest.mark.parametrize("name", ["n_components", "max_iter", "tol"])
def test_flags_are_no_numbers(name):
    params = {"n_components": 1, name: True}
    refused(rf"'{name}' parameter .* Got True instead", AffineNRSfM(**params).fit, X)


@pytest.mark.parametrize("size", [1e-25, 1e25])
def test_rotations_and_scales_of_single_precision(size):
    table = (size * X).astype(np.float32)
    model = estimator(camera="weak_perspective").fit(table)
    rows = model.rotations_[:, :2]
    expected = np.broadcast_to(np.eye(2), (30, 2, 2))
    assert_allclose(rows @ rows.swapaxes(1, 2), expected, atol=1e-5)
    assert_allclose(model.scales_[:, None, None] * rows, model.motion_, rtol=1e-5)
