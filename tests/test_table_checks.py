"""Checks of tables: layout, names, what is too little, masks, NA, ends of the range."""

import warnings
from functools import cache

import numpy as np
import pandas as pd
import pytest
from layers import slow_after
from numpy.testing import assert_allclose, assert_array_equal
from refusals import refusals_of, refused, warned
from scenes import table_of, with_gaps
from sklearn.exceptions import ConvergenceWarning

from isa_nrsfm import AffineNRSfM, FastISA
from isa_nrsfm.datasets import make_face_tracks, make_nonrigid_tracks
from isa_nrsfm.metrics import inverse_snr

FACES = make_nonrigid_tracks(40, 30, 2, amplitude=0.2, random_state=0).tracks

# Of a table in the wrong layout, of which points are missing
pytestmark = pytest.mark.filterwarnings("ignore:in 60 of 60 rows points have only one")


def fit(X, n_components=1, **params):
    """Fit the paper's pipeline in one step."""
    params = {"refinement": None, "isa": FastISA(n_init=1), "random_state": 0} | params
    with warnings.catch_warnings(action="ignore", category=ConvergenceWarning):
        return AffineNRSfM(n_components, **params).fit(X)


@pytest.mark.parametrize("layout", ["interleaved", "planar"])
def test_half_points_are_named_by_their_columns(layout):
    X = pd.DataFrame(table_of(FACES, layout)).add_prefix("c")
    x, y = {"interleaved": (14, 15), "planar": (7, 37)}[layout]
    half, whole = X.copy(), X.copy()
    half.iloc[3, y] = whole.iloc[3, [x, y]] = np.nan
    message = r"in 1 of 40 rows points have only one of their two coordinates \(1 "
    message += rf"in all; first: point 7 \(c{x}, c{y}\) in row 3\). They count as "
    found = warned(message + "missing$", fit, half, layout=layout)
    assert_array_equal(found.alpha_, fit(whole, layout=layout).alpha_)


@pytest.mark.parametrize("K", [1, 5])
def test_count_of_all_equations(K, rng):
    # The smallest complete table has hardly more equations than unknowns: those of
    # cameras, coefficients and shapes, but for the gauge.
    n_points, n_frames = 3 * K + 4, -(-8 * (K + 2) // 5)
    unknowns = (8 + K) * n_frames + 3 * n_points * (K + 1)
    gauge = (K + 1) ** 2 + 8 + 3 * (K + 1)
    n_hidden = (2 * n_points * n_frames - unknowns + gauge) // 2 + 1
    tracks = rng.normal(size=(n_frames, n_points, 2))
    assert fit(table_of(tracks), K).basis_.shape == (K, n_points, 3)
    tracks[np.arange(n_hidden) % n_frames, np.arange(n_hidden) % n_points] = np.nan
    message = rf"too few points are visible for n_components={K}: they determine "
    message += r"\d+ numbers of the shapes, which have \d+\."
    refused(message, fit, table_of(tracks), K)


def test_frames_of_points_on_a_line(rng):
    tracks = FACES.copy()
    tracks[::2] = rng.normal(size=(20, 30, 1)) * rng.normal(size=(20, 1, 2))
    fit(table_of(tracks))  # a flat object seen edge on
    tracks[::2, 3] = np.nan
    message = r"missing in 20 of 40 frames \(first: row 0\) and the others lie on "
    refused(message + "one line", fit, table_of(tracks))
    tracks[::2] += 1e-9 * rng.normal(size=(20, 30, 2))
    fit(table_of(tracks))


@pytest.mark.parametrize(("unit", "dtype"), [(1e-9, np.float32), (1e9, float)])
def test_one_place_is_a_matter_of_rounding(rng, unit, dtype):
    noise = np.finfo(dtype).eps * rng.normal(size=(30, 2))
    equal, apart = FACES.copy(), FACES.copy()
    equal[[7, 9]], apart[[7, 9]] = 3.0 + noise, 3.0 + 80 * noise
    message = r"all points are equal in 2 of 40 frames \(first: row 7\)"
    refused(message, fit, table_of((unit * equal).astype(dtype)))
    fit(table_of((unit * apart).astype(dtype)))


def names_of(layout, axes):
    """Return the table of both layouts under names with these letters of the axes."""
    pairs = [[f"{axis}{j}" for axis in axes] for j in range(30)]
    names = np.array(pairs).T if layout == "planar" else np.array(pairs)
    return pd.DataFrame(table_of(FACES, layout), columns=names.ravel())


# The object has size 1 and may be far away from the corner of the image.
FAR = 300.0 * np.array([1.0, 0.0])
# Long tables are sampled evenly.
LONG = np.tile(FACES, (100, 1, 1))
HALF = make_face_tracks(60, missing=0.3, random_state=0).data


# --- tables that are masked, hold NA, or are at the ends of the numbers' range --------

SIZES = {"n_frames": 30, "n_points": 12, "n_components": 1}
X = make_nonrigid_tracks(**SIZES, noise=0.02, random_state=0).data
# Both coordinates of some points.
HIDDEN = np.repeat(np.random.default_rng(1).random((30, 12)) < 0.05, 2, axis=1)
HOLED = np.where(HIDDEN, np.nan, X)
# Whole numbers, and a table of pandas with NA
WHOLE = np.round(1000 * X)
WITH_NA = pd.DataFrame(WHOLE).astype("Float64").mask(HIDDEN)
MASKED = np.ma.masked_array(WHOLE.astype(np.int16), HIDDEN)


def estimator(**params):
    return AffineNRSfM(1, isa=FastISA(n_init=1), random_state=0, **params)


@cache
def model():
    return estimator().fit(HOLED)


def test_masked_entries_are_missing():
    masked = np.ma.masked_array(X, HIDDEN)
    assert_array_equal(estimator().fit(masked).alpha_, model().alpha_)
    assert model().score(masked) == model().score(HOLED)
    fitted = model().reproject(HOLED)
    assert inverse_snr(masked, fitted) == inverse_snr(HOLED, fitted)
    assert_array_equal(masked.mask, HIDDEN)
    assert model().transform(masked.astype(np.float32)).dtype == np.float32
    # Masked coefficients have no images.
    alpha = np.ma.masked_array(model().alpha_, model().alpha_ > 0)
    images = model().inverse_transform(alpha)
    assert_array_equal(np.isnan(images).all(axis=1), alpha.mask.any(axis=1))


KINDS_OF_FITS = [{"loss": "cauchy"}, {"refinement": None, "scale_frames": False}]
KINDS_OF_FITS += [{"camera": name} for name in ("weak_perspective", "orthographic")]


@pytest.mark.parametrize("size", [2.0**-460, 2.0**460])
@pytest.mark.parametrize("params", slow_after(2, KINDS_OF_FITS), ids=str)
@pytest.mark.filterwarnings("ignore:the depth of the shapes is not determined")
def test_sizes_within_the_range_change_no_coefficient(params, size):
    """Powers of two: the numbers of the larger table are the same but for exponents."""
    usual, scaled = (estimator(**params).fit(s * X) for s in (1.0, size))
    assert_allclose(scaled.alpha_, usual.alpha_, atol=1e-6)
    assert_allclose(scaled.inverse_snr_, usual.inverse_snr_, rtol=1e-6)


def test_rotations_and_scales_of_single_precision():
    table = (1e25 * X).astype(np.float32)
    model = estimator(camera="weak_perspective", refinement=None).fit(table)
    rows = model.rotations_[:, :2]
    expected = np.broadcast_to(np.eye(2), (30, 2, 2))
    assert_allclose(rows @ rows.swapaxes(1, 2), expected, atol=1e-5)
    assert_allclose(model.scales_[:, None, None] * rows, model.motion_, rtol=1e-5)


def named(layout, names):
    """Return a table with these names of columns."""
    return pd.DataFrame(table_of(FACES[:, :3], layout), columns=names.split())


def mapped(folder, table):
    np.save(folder / "X.npy", table)
    return np.load(folder / "X.npy", mmap_mode="r")


def in_two_parts():
    """Return tracks of two groups of points that are never seen together."""
    tracks = np.random.default_rng(0).normal(size=(100, 20, 2))
    tracks[:50, 12:] = tracks[50:, :12] = np.nan
    return tracks


def noise(n_frames, n_points):
    return np.random.default_rng(0).normal(size=(n_frames, 2 * n_points))


GAPS = with_gaps(noise(60, 30))


def coplanar():
    """Return tracks of which frame 3 shows points of a plane of the object."""
    rng = np.random.default_rng(2)
    shapes = rng.normal(size=(2, 12, 3)) * np.array([1.0, 0.3])[:, None, None]
    shapes[:, :5, 2] = 0.0
    alpha, motion = rng.normal(size=(60, 1, 1)), rng.normal(size=(60, 2, 3))
    tracks = (shapes[0] + alpha * shapes[1]) @ motion.mT
    tracks[3, 5:] = np.nan
    return tracks


test_refusals = refusals_of("table_checks", globals())
