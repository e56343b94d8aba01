"""Models saved to files and loaded again."""

import functools
import inspect
import io
import json
import pickle
import tracemalloc
import warnings
import zipfile
from pathlib import Path

import numpy as np
import pandas as pd
import pytest
import skops.io
from layers import slow_after
from sklearn.base import clone
from sklearn.decomposition import PCA
from sklearn.exceptions import ConvergenceWarning, NotFittedError

from isa_nrsfm import AffineNRSfM, FastISA, PooledFastICA
from isa_nrsfm.datasets import make_face_tracks
from isa_nrsfm.io import TRUSTED_TYPES, load_model, save_model
from isa_nrsfm.io._model_contents import (
    ATTRIBUTES,
    model_contents,
    model_from_contents,
)
from isa_nrsfm.io._skops_values import read_values
from isa_nrsfm.isa import SqrtDensity

FACES = make_face_tracks(20, n_components=2, random_state=0)
TABLE = FACES.data[:, :28]
NAMES = FACES.feature_names[:28]
# The first frames suffice to tell whether a model transforms as before.
FEW = TABLE[:3]
OLD_MODEL = Path(__file__).with_name("saved_models") / "0b_alternating.skops"
HOLED = TABLE.copy()
HOLED[3] = np.nan
HOLED[[5, 8], 2:4] = np.nan
STRATEGY = FastISA(n_init=2, density=SqrtDensity(0.2), random_state=5)
# Parameters and tables of fits; the parameter `folder` stands for a folder.
CASES = {
    "default": ({}, TABLE),
    "names": ({}, pd.DataFrame(TABLE, columns=NAMES)),
    "huber": ({"loss": "huber", "independence": "coefficients"}, TABLE),
    "planar": (
        {"layout": "planar", "independence": None, "scale_frames": False},
        np.concatenate([TABLE[:, ::2], TABLE[:, 1::2]], axis=1),
    ),
    "weak perspective": ({"camera": "weak_perspective", "loss": "cauchy"}, TABLE),
    "orthographic": ({"camera": "orthographic", "keep_frames": False}, TABLE),
    "alternating": ({"refinement": "alternating", "isa": STRATEGY}, TABLE),
    "alternating, calibrated": (
        {"refinement": "alternating", "camera": "weak_perspective"},
        TABLE,
    ),
    "not refined": (
        {"refinement": None, "isa": PooledFastICA(n_init=2), "keep_frames": False},
        TABLE,
    ),
    "single precision": ({}, TABLE.astype(np.float32)),
    "single precision, alternating": (
        {"refinement": "alternating", "block_recovery": "eigen"},
        TABLE.astype(np.float32),
    ),
    "missing points": ({}, HOLED),
    "folder": ({"keep_frames": "folder"}, TABLE),
    "path of a folder": ({"keep_frames": Path("folder")}, TABLE),
    "mirrored": ({"camera": "weak_perspective", "mirror": True}, TABLE),
    "numbers of numpy": (
        {
            "n_components": np.int64(2),
            "tol": np.float32(0.05),
            "scale_frames": np.bool_(True),
            "loss": np.str_("linear"),
        },
        TABLE,
    ),
}


@pytest.fixture(scope="module")
def fitted(tmp_path_factory):
    """Return a function from the name of a case to its model and table."""

    @functools.cache
    def fit(case):
        parameters, table = CASES[case]
        parameters = {"n_components": 2, "random_state": 0, "max_iter": 3} | parameters
        mirror = parameters.pop("mirror", False)
        if str(parameters.get("keep_frames")) == "folder":
            kind = type(parameters["keep_frames"])
            folder = tmp_path_factory.mktemp("frames")
            parameters["keep_frames"] = folder if kind is not str else str(folder)
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", ConvergenceWarning)
            warnings.filterwarnings("ignore", "1 of 20 row.* show no point")
            model = AffineNRSfM(**parameters).fit(table)
        return (model.mirror() if mirror else model), table

    return fit


@pytest.fixture
def model(fitted):
    """Return a fitted model."""
    return fitted("default")[0]


@pytest.fixture
def path(tmp_path):
    """Return the path of a model file."""
    return tmp_path / "model.skops"


class Stranger(AffineNRSfM):
    """A class that is not part of the package."""


class StrangeISA(PooledFastICA):
    """A strategy that is not part of the package."""


def public(estimator):
    """Return the public attributes of an estimator, of strategies their classes."""
    return {
        name: repr(type(value)) if hasattr(value, "get_params") else value
        for name, value in vars(estimator).items()
        if not name.startswith("_")
    }


def assert_same(loaded, saved):
    assert type(loaded) is type(saved)
    found, expected = public(loaded), public(saved)
    assert found.keys() == expected.keys()
    for name, value in expected.items():
        if isinstance(value, np.random.RandomState):
            found[name], value = found[name].get_state(), value.get_state()
        np.testing.assert_equal(found[name], value)
        if isinstance(value, np.ndarray):
            assert type(found[name]) is np.ndarray
            assert found[name].dtype == value.dtype
        else:
            assert type(found[name]) is type(value)
    for name in {"isa", "isa_", "density"} & vars(saved).keys():
        part = getattr(saved, name)
        if hasattr(part, "get_params"):
            assert_same(getattr(loaded, name), part)


@pytest.mark.parametrize("case", slow_after(8, CASES))
def test_loaded_model_equals_the_saved_one(case, fitted, path):
    model, table = fitted(case)
    save_model(model, path)
    loaded = load_model(path)
    assert_same(loaded, model)
    few = table[:6]
    for method in ("decompose", "reproject", "score"):
        found, expected = getattr(loaded, method)(few), getattr(model, method)(few)
        np.testing.assert_equal(found, expected)
        assert str(getattr(found, "dtype", "")) == str(getattr(expected, "dtype", ""))
    np.testing.assert_array_equal(loaded.transform(few), model.transform(few))
    names = model.get_feature_names_out().tolist()
    assert loaded.get_feature_names_out().tolist() == names
    assert loaded._repr_html_().count("basis shapes of") == 1
    if hasattr(model, "alpha_std_"):
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", UserWarning)
            np.testing.assert_equal(loaded.diagnostics(), model.diagnostics())


@pytest.mark.parametrize("case", ["names", "alternating", "orthographic"])
@pytest.mark.filterwarnings("ignore::sklearn.exceptions.ConvergenceWarning")
def test_loaded_models_can_be_cloned_and_fitted_again(case, fitted, path):
    model, table = fitted(case)
    save_model(model, path)
    loaded = load_model(path)
    assert str(clone(loaded).get_params()) == str(clone(model).get_params())
    basis = model.basis_
    np.testing.assert_array_equal(clone(loaded).fit(table).basis_, basis)
    np.testing.assert_array_equal(loaded.fit(table).basis_, basis)
    mirrored = load_model(path).mirror()
    np.testing.assert_array_equal(mirrored.basis_, basis * [1, 1, -1])


@pytest.mark.filterwarnings("ignore::sklearn.exceptions.ConvergenceWarning")
def test_a_state_of_random_numbers_goes_on_where_it_was(path):
    random = np.random.RandomState(3)
    random.standard_normal(5)
    isa = FastISA(n_init=1, random_state=np.random.RandomState(4))
    model = AffineNRSfM(2, refinement=None, random_state=random, isa=isa).fit(TABLE)
    save_model(model, path)
    loaded = load_model(path)
    assert_same(loaded, model)
    draws = random.standard_normal(9)
    np.testing.assert_array_equal(loaded.random_state.standard_normal(9), draws)
    other = np.random.RandomState(np.random.PCG64(0))
    with pytest.raises(ValueError, match="RandomState of MT19937; got one of PCG64"):
        save_model(model.set_params(random_state=other), path)


def test_output_in_dataframes_is_kept(fitted, path):
    model = pickle.loads(pickle.dumps(fitted("default")[0]))
    save_model(model.set_output(transform="pandas"), path)
    expected = model.transform(TABLE)
    pd.testing.assert_frame_equal(load_model(path).transform(TABLE), expected)


def test_loaded_model_takes_missing_points(model, path):
    save_model(model, path)
    loaded = load_model(path)
    np.testing.assert_array_equal(loaded.transform(HOLED), model.transform(HOLED))


@pytest.mark.parametrize("case", slow_after(8, CASES))
def test_files_hold_plain_values_under_public_names(case, fitted, path):
    save_model(fitted(case)[0], path)
    assert skops.io.get_untrusted_types(file=path) == []
    schema = zipfile.ZipFile(path).read("schema.json").decode()
    assert "isa_nrsfm." not in schema
    contents = skops.io.load(path)
    assert list(contents) == [
        "format", "format_version", "package_version", "parameters", "attributes",
        "set_output", "frames",
    ]  # fmt: skip

    def check(value):
        plain = (bool, int, float, str, np.ndarray, np.number, np.bool_, type(None))
        if type(value) is dict:
            assert not [name for name in value if name.startswith("_")]
        if type(value) in (dict, list):
            for item in value.values() if type(value) is dict else value:
                check(item)
        else:
            assert isinstance(value, plain)
            assert type(value) is np.ndarray or not isinstance(value, np.ndarray)

    check(contents)
    np.testing.assert_equal(read_values(path.read_bytes()), contents)


def test_no_type_needs_trust():
    assert TRUSTED_TYPES == ()


def test_saving_replaces_a_file_as_a_whole(model, path, monkeypatch):
    path.write_text("something else")
    path.chmod(0o640)
    link = path.with_name("link.skops")
    link.symlink_to(path)
    save_model(model, link)
    assert load_model(path).n_components == 2
    assert link.is_symlink()
    assert path.stat().st_mode & 0o777 == 0o640
    before = path.read_bytes()

    def full(*paths):
        raise OSError(28, "No space left on device", *map(str, paths))

    monkeypatch.setattr("os.replace", full)
    with pytest.raises(OSError, match=r"No space left .*model\.skops"):
        save_model(model, path)
    assert path.read_bytes() == before
    assert sorted(path.parent.iterdir()) == [link, path]


def test_saving_refuses_what_loading_would_refuse(model, path):
    with pytest.raises(ValueError, match=r"should be an AffineNRSfM; got .*PCA"):
        save_model(PCA().fit(TABLE), path)
    with pytest.raises(NotFittedError):
        save_model(AffineNRSfM(), path)
    quick = {"n_components": 2, "refinement": None, "random_state": 0}
    stranger = Stranger(**quick).fit(TABLE)
    with pytest.raises(ValueError, match=r"\.Stranger, which is not part of a model"):
        save_model(stranger, path)
    strange = AffineNRSfM(isa=StrangeISA(n_init=1), **quick).fit(TABLE)
    with pytest.raises(ValueError, match=r"estimator\.isa is of type .*\.StrangeISA"):
        save_model(strange, path)
    copied = pickle.loads(pickle.dumps(model))
    copied.comment = "mine"
    with pytest.raises(ValueError, match="has comment, which is not part of a model"):
        save_model(copied, path)
    copied = pickle.loads(pickle.dumps(model)).set_params(max_iter=-1)
    with pytest.raises(ValueError, match=r"cannot be saved: The 'max_iter' parameter"):
        save_model(copied, path)
    copied = pickle.loads(pickle.dumps(model)).set_params(tol=print)
    with pytest.raises(ValueError, match=r"estimator\.tol is of type builtin_function"):
        save_model(copied, path)
    assert not list(path.parent.iterdir())


@pytest.mark.filterwarnings("ignore::sklearn.exceptions.ConvergenceWarning")
def test_frames_of_dask_arrays_are_not_saved(path):
    dask = pytest.importorskip("dask.array")
    parameters = {"n_components": 2, "random_state": 0, "max_iter": 3}
    table = dask.from_array(TABLE, chunks=(10, 28))
    model = AffineNRSfM(**parameters).fit(table)
    with pytest.raises(ValueError, match=r"motion_ is of type dask.*arrays in memory"):
        save_model(model, path)
    model = AffineNRSfM(**parameters, keep_frames=False).fit(table)
    save_model(model, path)
    found = load_model(path).transform(TABLE)
    np.testing.assert_array_equal(found, model.transform(TABLE))


# Files that are none, and damaged ones


def written(contents, path):
    """Write contents as save_model does, but any."""
    path.write_bytes(skops.io.dumps(contents))
    return path


def test_files_that_unpack_to_more_than_they_have_are_refused(model, path):
    contents = model_contents(model)
    contents["attributes"]["objective_history_"] = np.zeros(2_000_000)
    large = skops.io.dumps(contents)
    with zipfile.ZipFile(io.BytesIO(large)) as whole, zipfile.ZipFile(path, "w") as zip:
        for name in whole.namelist():
            zip.writestr(name, whole.read(name), zipfile.ZIP_DEFLATED)
    assert path.stat().st_size < 100_000
    tracemalloc.start()
    with pytest.raises(ValueError, match=r"need more than the \d+ bytes that it has"):
        load_model(path)
    assert tracemalloc.get_traced_memory()[1] < 4_000_000
    tracemalloc.stop()


def test_an_array_in_many_places_is_read_once(path):
    array = np.zeros(100_000)
    written([array] * 50, path)
    tracemalloc.start()
    found = read_values(path.read_bytes())
    assert tracemalloc.get_traced_memory()[1] < 10 * array.nbytes
    tracemalloc.stop()
    assert len(found) == 50


@pytest.mark.parametrize(
    ("case", "one", "other", "message"),
    [
        ("default", "alpha_", "alpha_std_", "alpha_ should have mean zero and unit"),
        ("default", "reliability_", "energy_share_", "energy_share_ should be shares"),
        ("weak perspective", "alpha_", "alpha_std_", "alpha_ should have mean zero"),
    ],
)
def test_arrays_that_changed_places_are_refused(
    case, one, other, message, fitted, path
):
    contents = model_contents(fitted(case)[0])
    attributes = contents["attributes"]
    attributes[one], attributes[other] = attributes[other], attributes[one]
    with pytest.raises(ValueError, match=message):
        load_model(written(contents, path))


@pytest.mark.parametrize(
    ("case", "name", "change", "message"),
    [
        ("default", "mean_shape_", lambda a: a[::-1], "the shapes of frames"),
        ("default", "basis_", lambda a: a[::-1], "the shapes of frames"),
        ("default", "basis_", lambda a: a * [1, 1, -1], "the shapes of frames"),
        ("orthographic", "basis_", lambda a: 2 * a, "the shapes of frames"),
        ("alternating", "basis_", lambda a: a[::-1], "the shapes of frames"),
        ("not refined", "mean_shape_", lambda a: -a, "the shapes of frames"),
        ("default", "singular_values_", lambda a: a[::-1], "should decrease"),
        ("huber", "objective_history_", lambda a: a[1:], r"n_iter_ \+ 1 numbers"),
        ("default", "alpha_", lambda a: 2 * a, "unit variance"),
        ("planar", "alpha_", lambda a: a + 1, "mean zero"),
        ("default", "alpha_std_", lambda a: -a, "should not be negative"),
        ("default", "motion_", lambda a: a * np.nan, "frames that have a size"),
        ("missing points", "alpha_", np.nan_to_num, "frames that have a size"),
        ("weak perspective", "scales_", lambda a: a[::-1], "two rows of the rota"),
        ("weak perspective", "motion_", lambda a: a[::-1], "two rows of the rota"),
        ("mirrored", "rotations_", lambda a: 2 * a, "should be orthonormal"),
    ],
)
def test_broken_promises_are_refused(case, name, change, message, fitted, path):
    contents = model_contents(fitted(case)[0])
    array = contents["attributes"][name]
    contents["attributes"][name] = change(array).astype(array.dtype)
    with pytest.raises(ValueError, match=message):
        load_model(written(contents, path))


def test_files_with_other_types_are_refused_and_the_types_named(model, path):
    strangers = {
        r"builtins\.print": {"model": model, "system": print},
        r"sklearn\.decomposition\._pca\.PCA": PCA(2).fit(TABLE),
        r"numpy\.sin|sin": [np.sin],
        r"pathlib": [Path("folder")],
        r"numpy\.random": {"random": np.random.default_rng(0)},
        r"builtins\.set": {1, 2},
    }
    for name, stranger in strangers.items():
        message = rf"model\.skops is not a model .*not part of a model: .*({name})"
        with pytest.raises(ValueError, match=message):
            load_model(written(stranger, path))
    contents = model_contents(model)
    for part in (PooledFastICA(), np.random.RandomState(0), (1, 2)):
        contents["parameters"]["isa"] = part
        with pytest.raises(ValueError, match=r"parameter isa .*which it cannot be"):
            load_model(written(contents, path))


def test_objects_that_are_no_fitted_models_are_refused(model, path):
    with pytest.raises(ValueError, match="should hold an AffineNRSfM; got PooledFast"):
        load_model(written(PooledFastICA(), path))
    with pytest.raises(ValueError, match="should hold a fitted estimator"):
        load_model(written(AffineNRSfM(), path))
    for contents in ({}, [], "text", 3, None, {"format": "glTF"}):
        with pytest.raises(ValueError, match=r"model\.skops: it should hold a dict"):
            load_model(written(contents, path))


def test_other_files_are_refused(model, path):
    not_a_model = "is not a model file written by save_model"
    archive = io.BytesIO()
    with zipfile.ZipFile(archive, "w") as file:
        file.writestr("text", "text")
    for contents in (b"", b"x0,y0\n1,2\n", pickle.dumps([1]), archive.getvalue()):
        path.write_bytes(contents)
        with pytest.raises(ValueError, match=not_a_model):
            load_model(path)


def test_newer_versions_are_told(model, path):
    contents = {**model_contents(model), "format_version": 2, "more": "text"}
    message = r"newer isa_nrsfm \(format 2\); this one reads up to 1"
    with pytest.raises(ValueError, match=rf"model\.skops: written by a {message}"):
        load_model(written(contents, path))


def test_files_that_do_not_open_raise_os_errors(model, tmp_path):
    with pytest.raises(FileNotFoundError):
        load_model(tmp_path / "absent.skops")
    with pytest.raises(IsADirectoryError):
        load_model(tmp_path)
    with pytest.raises(FileNotFoundError, match=r"absent/model\.skops"):
        save_model(model, tmp_path / "absent" / "model.skops")
    with pytest.raises(IsADirectoryError):
        save_model(model, tmp_path)


def refused_or_same(load, expected):
    """Tell whether something is refused; otherwise it transforms as expected."""
    try:
        loaded = load()
    except (ValueError, OSError):
        return True
    np.testing.assert_array_equal(loaded.transform(FEW), expected)
    return False


@pytest.mark.parametrize("old", [False, True])
def test_damaged_bytes_are_found(old, fitted, path):
    if old:
        path.write_bytes(OLD_MODEL.read_bytes())
    else:
        save_model(fitted("default")[0], path)
    rng = np.random.default_rng(0)
    whole, expected = path.read_bytes(), load_model(path).transform(FEW)
    refused = []
    for position in rng.integers(len(whole), size=80):
        damaged = bytearray(whole)
        damaged[position] ^= 1 << rng.integers(8)
        path.write_bytes(damaged)
        refused.append(refused_or_same(lambda: load_model(path), expected))
    assert sum(refused) > 50
    for length in rng.integers(len(whole), size=40):
        path.write_bytes(whole[:length])
        assert refused_or_same(lambda: load_model(path), expected)


def entries(contents):
    """Return the dicts inside a dict, itself included, with each of their keys."""
    for key, value in contents.items():
        yield contents, key
        if type(value) is dict:
            yield from entries(value)


def of_other_types(value):
    """Return values that have other types, or arrays of other shapes."""
    others = [None, "text", [], {}, [1.0], {"class": "FastISA"}, np.zeros((2, 3, 5))]
    others += [np.zeros(()), np.array([1 + 2j]), np.array(["text"]), {"class": []}]
    if not isinstance(value, int | float | np.number):
        others += [3, -1.5, 10**400, np.nan, np.float32(2)]
    if isinstance(value, np.ndarray):
        others += [value[:-1], value[..., None], value.astype(str), np.array(None)]
        others += [np.zeros(value.shape, np.float16), value != 0, value.tolist()]
    return [other for other in others if value is not None or other is not None]


def mutants(contents, step=1):
    """Return names of changes of contents, and the contents while they have them."""
    for inside, key in list(entries(contents))[::step]:
        before = dict(inside)
        changes = {
            "removed": {name: v for name, v in before.items() if name != key},
            "renamed": {name + "_" * (name == key): v for name, v in before.items()},
        }
        if key == next(iter(before)):
            changes["added"] = before | {"more": 1}
        for other in of_other_types(before[key]):
            changes[f"{other!r:.30}"] = before | {key: other}
        for change, after in changes.items():
            inside.clear()
            inside.update(after)
            yield f"{key}: {change}"
        inside.clear()
        inside.update(before)


@pytest.mark.parametrize("case", slow_after(1, ["alternating", "weak perspective"]))
def test_altered_entries_are_found(case, fitted, path):
    model = pickle.loads(pickle.dumps(fitted(case)[0]))
    random = np.random.RandomState(0)
    contents = model_contents(model.set_params(random_state=random))
    expected = model.transform(FEW)
    refused = {}
    for name in mutants(contents):
        load = functools.partial(model_from_contents, contents)
        refused[name] = refused_or_same(load, expected)
    assert len(refused) > 500
    # Parameters that take other types, what may be missing, and lists of any length.
    passed = {name for name, found in refused.items() if not found}
    assert {name.partition(":")[0] for name in passed} <= {
        "tol", "working_memory", "n_jobs", "random_state", "isa", "density",
        "refinement", "independence", "keep_frames", "package_version",
        "depth_uncertainty_", "certainty", "turns",
        "camera_noise_ratio_", "coefficient_starts", "objective_history_",
        "criteria_", "log_likelihoods_", "n_iters_",
    }  # fmt: skip
    assert not refused_or_same(lambda: model_from_contents(contents), expected)


def test_altered_entries_of_files_are_found(model, path):
    expected = model.transform(FEW)
    contents = model_contents(model)
    refused = []
    for number, _ in enumerate(mutants(contents, step=3)):
        if number % 7 == 0:
            written(contents, path)
            refused.append(refused_or_same(lambda: load_model(path), expected))
    assert len(refused) > 50
    assert sum(refused) > 0.8 * len(refused)


def nodes(schema):
    """Return the dicts of a schema of skops with each of their keys."""
    if isinstance(schema, dict):
        yield from ((schema, key) for key in schema)
    if isinstance(schema, dict | list):
        for item in schema.values() if isinstance(schema, dict) else schema:
            yield from nodes(item)


@pytest.mark.parametrize("old", [False, True])
def test_altered_nodes_of_files_are_found(old, model, path):
    if old:
        path.write_bytes(OLD_MODEL.read_bytes())
    else:
        save_model(model, path)
    expected = load_model(path).transform(FEW)
    with zipfile.ZipFile(path) as file:
        files = {name: file.read(name) for name in file.namelist()}
    schema = json.loads(files["schema.json"])
    places = [place for place in nodes(schema) if place[1] != "__id__"]
    rng = np.random.default_rng(0)
    refused = []
    for number in rng.permutation(len(places))[:150]:
        node, key = places[number]
        before = dict(node)
        change = rng.integers(4)
        if change:
            node[key] = [None, "text", ["1"], {"content": 3}][rng.integers(4)]
        else:
            del node[key]
        altered = io.BytesIO()
        with zipfile.ZipFile(altered, "w") as file:
            for name, stored in (files | {"schema.json": json.dumps(schema)}).items():
                file.writestr(name, stored)
        path.write_bytes(altered.getvalue())
        refused.append(refused_or_same(lambda: load_model(path), expected))
        node.clear()
        node.update(before)
    assert sum(refused) > 100


def test_damaged_arrays_are_found(model, path):
    save_model(model, path)
    damaged = io.BytesIO()
    with zipfile.ZipFile(path) as old, zipfile.ZipFile(damaged, "w") as new:
        for name in old.namelist():
            text = old.read(name)
            new.writestr(name, text if name.endswith(".json") else text[:40])
    path.write_bytes(damaged.getvalue())
    with pytest.raises(ValueError, match="or it is damaged"):
        load_model(path)


# Files of format 0: objects


def with_attributes(**attributes):
    """Return an old model with other attributes, as a file."""
    with zipfile.ZipFile(OLD_MODEL) as file:
        files = {name: file.read(name) for name in file.namelist()}
    schema = json.loads(files["schema.json"])
    held = schema["content"]
    for name, value in attributes.items():
        held["content"][name] = held["content"]["max_iter"] | {
            "content": json.dumps(value)
        }
        held["key_types"]["content"].append(held["key_types"]["content"][0])
    stored = io.BytesIO()
    with zipfile.ZipFile(stored, "w") as file:
        for name, part in (files | {"schema.json": json.dumps(schema)}).items():
            file.writestr(name, part)
    return stored.getvalue()


def test_a_parameter_that_is_no_more_is_told_where_it_counts(path):
    path.write_bytes(with_attributes(stiffness=None, stiffness_=0.0))
    load_model(path)
    path.write_bytes(with_attributes(stiffness=None, stiffness_=300.0))
    with pytest.warns(UserWarning, match=r"stiffness=300\.0") as caught:
        load_model(path)
    assert caught[0].filename == __file__


def test_what_an_older_fit_did_not_measure_is_not_known(fitted):
    contents = model_contents(fitted("default")[0])
    contents["attributes"]["camera_noise_ratio_"] = None
    loaded = model_from_contents(contents)
    assert not hasattr(loaded, "camera_noise_ratio_")
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", UserWarning)
        found = loaded.diagnostics()
    assert np.isnan(found.camera_noise_ratio)
    assert found.camera_meaning.startswith("not known")


def test_attributes_that_older_files_never_had_are_refused(path):
    path.write_bytes(with_attributes(elasticity=1))
    with pytest.raises(ValueError, match=r"not known: \['elasticity'\]"):
        load_model(path)
    path.write_bytes(with_attributes(elasticity_=1))
    with pytest.raises(ValueError, match=r"not known: \['elasticity_'\]"):
        load_model(path)


def test_the_attributes_of_files_are_those_that_are_documented():
    documented = [
        line.split(" : ")[0].strip()
        for line in inspect.getdoc(AffineNRSfM).partition("Attributes\n")[2].split("\n")
        if line[:1].isalpha() and "_ : " in line
    ]
    # Two follow from the model of a table.
    assert set(documented) == {*ATTRIBUTES, "camera_", "frames_scaled_"}
