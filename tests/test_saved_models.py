"""Model files of earlier versions: they load, and give what they gave."""

from pathlib import Path

import numpy as np
import pandas as pd
import pytest

from isa_nrsfm.io import load_model, save_model
from isa_nrsfm.io._model_contents import FORMAT_VERSION

FOLDER = Path(__file__).with_name("saved_models")
FILES = sorted(FOLDER.glob("*.skops"))
KINDS = ("affine", "alternating", "weak_perspective_cauchy")


def saved_results(path):
    """Return the table of a file, as it was fitted, and what the model found."""
    with np.load(path.with_suffix(".npz")) as found:
        arrays = dict(found)
    names, table = arrays.pop("names"), arrays.pop("table")
    return pd.DataFrame(table, columns=names) if len(names) else table, arrays


def results_of(model, table):
    """Return what a model finds for a table."""
    found = model.decompose(table)._asdict()
    return {**found, "reprojection": model.reproject(table)}


def assert_as_saved(model, path):
    table, expected = saved_results(path)
    found = results_of(model, table)
    assert found.keys() >= expected.keys()  # the first files lack deviations
    for name, values in expected.items():
        largest = np.nanmax(np.abs(values), initial=0.0)
        np.testing.assert_allclose(found[name], values, rtol=0, atol=1e-12 * largest)
    np.testing.assert_array_equal(model.transform(table), found["alpha"])


@pytest.mark.parametrize("path", FILES, ids=lambda path: path.stem)
def test_models_of_all_versions_give_what_they_gave(path, tmp_path):
    model = load_model(path)
    assert_as_saved(model, path)
    save_model(model, tmp_path / "again.skops")
    again = load_model(tmp_path / "again.skops")
    assert_as_saved(again, path)
    assert str(again.get_params()) == str(model.get_params())


@pytest.mark.parametrize("path", FILES, ids=lambda path: path.stem)
def test_models_of_all_versions_do_all_that_models_do(path):
    model = load_model(path)
    table = saved_results(path)[0][:2]
    assert model._repr_html_()
    assert model.inverse_transform(np.zeros((1, 2))).shape == (1, table.shape[1])
    assert np.isfinite(model.score(table))
    assert model.reconstruct(table).shape == (2, 14, 3)
    mirrored = model.transform(table), model.mirror().transform(table)
    np.testing.assert_allclose(*mirrored, rtol=1e-6, atol=1e-6)


def test_every_version_has_a_model_of_every_kind():
    names = {path.stem for path in FILES}
    versions = [str(version) for version in range(1, FORMAT_VERSION + 1)]
    expected = {f"{version}_{kind}" for version in ["0b", *versions] for kind in KINDS}
    assert names == expected | {"0a_affine", "0a_alternating"}


def test_an_older_model_does_not_know_what_was_not_measured():
    model = load_model(FOLDER / "0a_affine.skops")
    assert not hasattr(model, "camera_noise_ratio_")
    assert "not known" not in model._repr_html_()
    assert load_model(FOLDER / "0b_affine.skops").camera_noise_ratio_ >= 1
