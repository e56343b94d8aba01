"""Models saved to files and loaded again."""

import io
import pickle
import zipfile

import numpy as np
import pandas as pd
import pytest
import skops.io
from sklearn.decomposition import PCA
from sklearn.exceptions import NotFittedError

from isa_nrsfm import AffineNRSfM, FastISA, PooledFastICA
from isa_nrsfm.datasets import make_face_tracks
from isa_nrsfm.io import TRUSTED_TYPES, load_model, save_model
from isa_nrsfm.isa import SqrtDensity


@pytest.fixture(scope="module")
def faces():
    """Return a table of faces as a data frame."""
    bunch = make_face_tracks(40, n_components=2, random_state=0)
    return pd.DataFrame(bunch.data, columns=bunch.feature_names)


@pytest.fixture(scope="module")
def model(faces):
    """Return a model fitted to the faces."""
    isa = PooledFastICA(n_init=2)
    return AffineNRSfM(n_components=2, isa=isa, random_state=0).fit(faces)


@pytest.fixture
def path(tmp_path):
    """Return the path of a model file."""
    return tmp_path / "model.skops"


class Stranger(AffineNRSfM):
    """A class that is not part of the package."""


@pytest.mark.parametrize(
    "parameters",
    [
        {},
        {"loss": "cauchy", "independence": "coefficients"},
        {"refinement": "alternating"},
        {"isa": PooledFastICA(n_init=2), "refinement": None},
        {"isa": FastISA(n_init=2), "layout": "interleaved", "block_recovery": "eigen"},
        {"isa": FastISA(n_init=2, density=SqrtDensity(0.2)), "scale_frames": False},
        {"random_state": np.random.RandomState(3), "isa": FastISA(n_init=2)},
        {"n_components": np.int64(1), "random_state": None},
    ],
)
@pytest.mark.filterwarnings("ignore::sklearn.exceptions.ConvergenceWarning")
def test_loaded_model_equals_the_saved_one(faces, path, parameters):
    fitted = AffineNRSfM(**({"n_components": 2, "random_state": 0} | parameters))
    fitted.fit(faces)
    save_model(fitted, path)
    loaded = load_model(path)
    assert type(loaded) is AffineNRSfM
    for name, value in fitted.get_params().items():
        if not hasattr(value, "get_params") and name != "random_state":
            assert loaded.get_params()[name] == value
    for name, value in vars(fitted).items():
        if name.endswith("_") and isinstance(value, np.ndarray | float | int):
            np.testing.assert_array_equal(getattr(loaded, name), value)
    np.testing.assert_array_equal(loaded.transform(faces), fitted.transform(faces))
    np.testing.assert_array_equal(loaded.reproject(faces), fitted.reproject(faces))
    assert loaded.score(faces) == fitted.score(faces)


def test_loaded_model_takes_missing_points(model, faces, path):
    save_model(model, path)
    holed = faces.mask(np.random.default_rng(0).random(faces.shape) < 0.2)
    holed.iloc[:, 1::2] = holed.iloc[:, 1::2].mask(holed.iloc[:, ::2].isna().to_numpy())
    holed.iloc[:, ::2] = holed.iloc[:, ::2].mask(holed.iloc[:, 1::2].isna().to_numpy())
    loaded = load_model(path)
    np.testing.assert_array_equal(loaded.transform(holed), model.transform(holed))


def test_trusted_types_are_needed_and_exist(model, path):
    save_model(model, path)
    assert set(skops.io.get_untrusted_types(file=path)) <= set(TRUSTED_TYPES)
    for name in TRUSTED_TYPES:
        module, _, name_in_module = name.rpartition(".")
        assert hasattr(__import__(module, fromlist=["_"]), name_in_module)


def test_saving_replaces_a_file(model, path):
    path.write_text("something else")
    save_model(model, path)
    assert load_model(path).n_components == 2


def test_saving_refuses_what_loading_would_refuse(faces, path):
    with pytest.raises(ValueError, match="should be an AffineNRSfM; got PCA"):
        save_model(PCA().fit(faces), path)
    with pytest.raises(NotFittedError):
        save_model(AffineNRSfM(), path)
    stranger = Stranger(2, isa=PooledFastICA(n_init=2), random_state=0).fit(faces)
    with pytest.raises(ValueError, match=r"not part of a model: .*\.Stranger"):
        save_model(stranger, path)
    assert not path.exists()


def test_files_with_other_types_are_refused_and_the_types_named(model, faces, path):
    stranger = Stranger(2, isa=PooledFastICA(n_init=2), random_state=0).fit(faces)
    skops.io.dump(stranger, path)
    with pytest.raises(ValueError, match=r"model\.skops contains .*\.Stranger"):
        load_model(path)
    skops.io.dump({"model": model, "system": print}, path)
    with pytest.raises(ValueError, match=r"not part of a model: builtins\.print"):
        load_model(path)


def test_models_of_other_classes_are_refused(faces, path):
    skops.io.dump(PCA(2).fit(faces.to_numpy()), path)
    with pytest.raises(ValueError, match=r"model\.skops should be .*; got PCA"):
        load_model(path)
    skops.io.dump(AffineNRSfM(), path)
    with pytest.raises(NotFittedError):
        load_model(path)


def test_other_files_are_refused(model, path):
    not_a_model = "is not a model file written by save_model"
    archive = io.BytesIO()
    with zipfile.ZipFile(archive, "w") as file:
        file.writestr("text", "text")
    for contents in (b"", b"x0,y0\n1,2\n", pickle.dumps([1]), archive.getvalue()):
        path.write_bytes(contents)
        with pytest.raises(ValueError, match=not_a_model):
            load_model(path)
    save_model(model, path)
    whole = path.read_bytes()
    path.write_bytes(whole[: len(whole) // 2])
    with pytest.raises(ValueError, match=not_a_model):
        load_model(path)


def test_damaged_model_is_refused(model, path):
    save_model(model, path)
    damaged = io.BytesIO()
    with zipfile.ZipFile(path) as old, zipfile.ZipFile(damaged, "w") as new:
        for name in old.namelist():
            text = old.read(name)
            new.writestr(name, text if name.endswith(".json") else text[:40])
    path.write_bytes(damaged.getvalue())
    with pytest.raises(ValueError, match="or it is damaged"):
        load_model(path)


def test_files_that_do_not_open_raise_os_errors(model, tmp_path):
    with pytest.raises(FileNotFoundError):
        load_model(tmp_path / "absent.skops")
    with pytest.raises(IsADirectoryError):
        load_model(tmp_path)
    with pytest.raises(FileNotFoundError):
        save_model(model, tmp_path / "absent" / "model.skops")
