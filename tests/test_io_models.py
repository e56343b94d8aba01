"""Models saved to files and loaded again."""

import contextlib
import functools
import hashlib
import io
import json
import pickle
import tracemalloc
import warnings
import zipfile

import numpy as np
import pandas as pd
import pytest
from damage import as_json, damaged_array, damaged_tree, pick
from layers import may_not_converge, slow_after
from numpy.testing import assert_array_equal, assert_equal
from refusals import refusals_of, refused
from sklearn.base import clone
from sklearn.decomposition import PCA  # noqa: F401  in refusals.txt

from isa_nrsfm import AffineNRSfM, FastISA, PooledFastICA
from isa_nrsfm.datasets import make_face_tracks
from isa_nrsfm.io import load_model, save_model

FACES = make_face_tracks(20, n_components=2, random_state=0)
TABLE = FACES.data[:, :28]
NAMES = FACES.feature_names[:28]
HOLED = TABLE.copy()
HOLED[3] = np.nan
HOLED[[5, 8], 2:4] = np.nan


class OwnISA(PooledFastICA):
    """A strategy that is not part of the package."""


# Parameters of fits
CALIBRATED = {"camera": "weak_perspective"}
CASES = {
    "default": {},
    "planar": {"layout": "planar", "independence": None, "scale_frames": False},
    "not refined": {"refinement": None, "keep_frames": False},
    "missing points": {},
    "alternating": {"refinement": "alternating", "isa": FastISA(n_init=2)},
    "single precision": {},
    "huber": {"loss": "huber", "independence": "coefficients"},
    "weak perspective": CALIBRATED | {"loss": "cauchy"},
    "folder": {},
    "mirrored": CALIBRATED | {"mirror": True},
    "prior": CALIBRATED | {"n_components": "auto", "prior": "a model"},
    "numbers of numpy": {"n_components": np.int64(2), "tol": np.float32(0.05)}
    | {"scale_frames": np.bool_(True), "loss": np.str_("linear")},
    "own strategy": {"refinement": None, "isa": OwnISA(n_init=2)},
}
# Their tables; those of others are `TABLE`.
TABLES = {
    "default": pd.DataFrame(TABLE, columns=NAMES),
    "planar": np.concatenate([TABLE[:, ::2], TABLE[:, 1::2]], axis=1),
    "single precision": TABLE.astype(np.float32),
    "missing points": HOLED,
}
pytestmark = [
    may_not_converge,
    pytest.mark.filterwarnings("ignore:the depth of the shapes is not determined"),
    pytest.mark.filterwarnings("ignore:no point is visible in 1 of 20"),
]


@pytest.fixture(scope="module")
def fitted(tmp_path_factory):
    """Return a function from the name of a case to its model and table."""

    @functools.cache
    def fit(case):
        table = TABLES.get(case, TABLE)
        parameters = {"n_components": 2, "random_state": 0, "max_iter": 3} | CASES[case]
        mirror = parameters.pop("mirror", False)
        if case == "folder":
            parameters["keep_frames"] = tmp_path_factory.mktemp("frames")
        if "prior" in parameters:
            faces = make_face_tracks(60, n_components=2, random_state=1)
            prior = AffineNRSfM(2, camera="weak_perspective", random_state=0)
            parameters["prior"] = prior.fit(faces.data[:, :28])
        model = AffineNRSfM(**parameters).fit(table)
        return (model.mirrored() if mirror else model), table

    return fit


@pytest.fixture
def path(tmp_path):
    """Return the path of a model file."""
    return tmp_path / "model.npz"


def rewritten(folder, change, model=None):
    """Return a file of a model with changes that the digest includes."""
    path = folder / "model.npz"
    save_model(simple_model() if model is None else model, path)
    with np.load(path, allow_pickle=False) as found:
        arrays = dict(found)
    header = json.loads(arrays.pop("header").tobytes())
    header, arrays = change(header, arrays) or (header, arrays)
    if isinstance(header, dict) and "digest" in header:
        with contextlib.suppress(RecursionError):
            header["digest"] = digest_of(header, arrays)
    np.savez(path, header=np.frombuffer(as_json(header), np.uint8), **arrays)
    return path


@functools.cache
def simple_model():
    with warnings.catch_warnings(action="ignore"):
        return AffineNRSfM(2, random_state=0, max_iter=3).fit(TABLE)


def digest_of(header, arrays):
    """Return the digest of a header and arrays, as all files of format 1 have it."""
    text = {name: value for name, value in header.items() if name != "digest"}
    digest = hashlib.sha256(json.dumps(text, sort_keys=True).encode())
    for name, array in sorted(arrays.items()):
        digest.update(f"{name} {array.dtype.str} {array.shape}".encode())
        digest.update(array.tobytes())
    return digest.hexdigest()


def assert_same(loaded, saved):
    """Assert that two estimators have the same attributes, of the same types."""
    assert type(loaded) is type(saved)
    found, expected = (
        {name: value for name, value in vars(each).items() if name[0] != "_"}
        for each in (loaded, saved)
    )
    assert found.keys() == expected.keys()
    for name, value in expected.items():
        if hasattr(value, "get_params"):  # strategies of users are not stored
            if not type(value).__name__.startswith("Own"):
                assert_same(found[name], value)
            continue
        assert_equal(found[name], value)
        kind = np.ndarray if isinstance(value, np.ndarray) else type(value)
        assert type(found[name]) is kind
        assert getattr(found[name], "dtype", None) == getattr(value, "dtype", None)


@pytest.mark.parametrize("case", slow_after(4, CASES))
def test_loaded_model_equals_the_saved_one(case, fitted, path):
    model, table = fitted(case)
    save_model(model, path)
    loaded = load_model(path)
    assert_same(loaded, model)
    few = table[:6]
    for method in ("decompose", "reproject", "score", "transform"):
        found, expected = getattr(loaded, method)(few), getattr(model, method)(few)
        assert_equal(found, expected)
        assert str(getattr(found, "dtype", "")) == str(getattr(expected, "dtype", ""))
    names = model.get_feature_names_out().tolist()
    assert loaded.get_feature_names_out().tolist() == names
    assert loaded._html_repr().count("basis shapes of") == 1
    if hasattr(model, "alpha_std_"):
        with warnings.catch_warnings(action="ignore", category=UserWarning):
            assert_equal(loaded.diagnostics(), model.diagnostics())
    with np.load(path, allow_pickle=False) as file:
        header = json.loads(file["header"].tobytes())
        assert sorted(["header", *header["arrays"]]) == sorted(file)


@pytest.mark.parametrize(
    "case", slow_after(1, ["not refined", "prior", "default", "alternating"])
)
def test_loaded_models_can_be_cloned_and_fitted_again(case, fitted, path):
    model, table = fitted(case)
    save_model(model, path)
    loaded = load_model(path)
    assert str(clone(loaded).get_params()) == str(clone(model).get_params())
    # Fits of this test have the limits of slow tests, shared ones perhaps others.
    basis = clone(model).fit(table).basis_
    assert_array_equal(loaded.fit(table).basis_, basis)


def test_strategies_of_users_are_named_and_not_stored(fitted, path):
    model, _ = fitted("own strategy")
    save_model(model, path)
    save_model(load_model(path), path)
    loaded = load_model(path)
    assert_array_equal(loaded.isa_.components_, model.isa_.components_)
    refused(r"test_io_models\.OwnISA\. .* only its name", loaded.fit, TABLE)
    loaded.set_params(isa=PooledFastICA(n_init=1)).fit(TABLE)


def test_a_state_of_random_numbers_is_not_stored(path):
    random = np.random.RandomState(3)
    save_model(AffineNRSfM(2, refinement=None, random_state=random).fit(TABLE), path)
    assert load_model(path).random_state is None


@pytest.mark.parametrize("table", [TABLE[[0] * 8], 1e140 * TABLE])
def test_models_without_motion_and_of_large_units_are_loaded(table, path):
    model = AffineNRSfM(1, scale_frames=False, random_state=0, max_iter=3).fit(table)
    save_model(model, path)
    assert_same(load_model(path), model)


def test_output_in_dataframes_is_kept(fitted, path):
    model, table = fitted("default")
    model = pickle.loads(pickle.dumps(model)).set_output(transform="pandas")
    save_model(model, path)
    expected = model.transform(table)
    pd.testing.assert_frame_equal(load_model(path).transform(table), expected)


class Stranger(AffineNRSfM):
    """A class that is not part of the package."""


def with_comment(model):
    """Return a model with an attribute of its own."""
    copied = pickle.loads(pickle.dumps(model))
    copied.comment_ = object()
    return copied


def changed(name, function):
    """Return a change of an array of a file, by a function of what there is."""
    return lambda header, arrays: (header, arrays | {name: function(arrays.get(name))})


def with_array(name, value):
    """Return a change that replaces or adds an array of a file."""
    return changed(name, lambda _: np.asarray(value))


def with_entry(value, *place):
    """Return a change that replaces or adds an entry of a header."""

    def change(header, arrays):
        inner = functools.reduce(dict.get, place[:-1], header)
        inner[place[-1]] = value

    return change


def test_any_change_is_found_by_the_digest(path):
    save_model(simple_model(), path)
    with np.load(path) as found:
        arrays = dict(found)
    for name in ("alpha_", "header"):
        other = arrays[name].copy()
        other.flat[-20] += 1
        np.savez(path, **arrays | {name: other})
        refused(r"model\.npz cannot be read", load_model, path)
    swapped = {"alpha_": arrays["alpha_std_"], "alpha_std_": arrays["alpha_"]}
    np.savez(path, **arrays | swapped)
    refused("digest is wrong: it is damaged or was chan", load_model, path)


def test_files_that_unpack_to_more_than_they_have_are_refused(tmp_path):
    path = rewritten(tmp_path, with_array("objective_history_", np.zeros(2_000_000)))
    whole = zipfile.ZipFile(io.BytesIO(path.read_bytes()))
    with zipfile.ZipFile(path, "w") as file:
        for name in whole.namelist():
            file.writestr(name, whole.read(name), zipfile.ZIP_DEFLATED)
    assert path.stat().st_size < 100_000
    tracemalloc.start()
    told = "are compressed. Load them, and save them with numpy.savez"
    refused(told, load_model, path)
    assert tracemalloc.get_traced_memory()[1] < 4_000_000
    tracemalloc.stop()
    np.savez(path, **np.load(path))
    assert len(load_model(path).objective_history_) == 2_000_000


@pytest.mark.parametrize(
    "case", slow_after(1, ["alternating", "prior", "weak perspective"])
)
def test_damaged_contents_with_a_right_digest_are_refused(case, fitted, tmp_path):
    model, _ = fitted(case)
    rng = np.random.default_rng(0)

    def change(header, arrays):
        if rng.integers(2):
            return damaged_tree(header, rng), arrays
        name = pick(rng, [*arrays])
        return header, arrays | {name: damaged_array(arrays[name], rng)}

    refused = 0
    for _ in range(20):
        try:
            load_model(rewritten(tmp_path, change, model))
        except ValueError as error:
            assert "model.npz cannot be read as a model" in str(error)  # noqa: PT017
            refused += 1
    assert refused > 10


test_refusals = refusals_of("io_models", globals())
