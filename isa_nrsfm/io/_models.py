"""Save and load fitted models: NumPy arrays and a JSON header in one ``.npz`` file.

The array ``header`` holds the header as UTF-8 text: number of the format, version of
the package, parameters, fitted attributes, model of a frame, names of all other arrays,
and a digest of all of these. Numbers of Python, texts, True, False and None are as in
JSON. All else is an object with one entry that names its kind, such as ``{"array":
name}`` for an array.
"""

import hashlib
import json
import os
import tomllib
from collections.abc import Iterable
from pathlib import Path
from typing import Any, NoReturn

import numpy as np
from numpy.typing import NDArray
from sklearn.base import BaseEstimator
from sklearn.utils.validation import check_is_fitted

from isa_nrsfm import __version__, isa
from isa_nrsfm._compat.files import reading, whole_file
from isa_nrsfm._compat.stored_arrays import read_arrays, write_arrays
from isa_nrsfm._estimator import AffineNRSfM
from isa_nrsfm._fitted_model import TableModel, fitted_prior
from isa_nrsfm._frames.camera_models import CAMERAS, Pinhole
from isa_nrsfm._frames.models import DepthCertainty, FrameMap, FrameModel
from isa_nrsfm._parameters import LOSSES
from isa_nrsfm._tables import LAYOUTS, SMALLEST

FORMAT, FORMAT_VERSION = "isa_nrsfm model", 1
HEADER = "header"
PARTS = tomllib.loads(Path(__file__).with_name("model_file.toml").read_text("utf-8"))
Arrays = dict[str, NDArray]


class NamedStrategy(BaseEstimator):
    """Placeholder for an ISA strategy that a model file only names."""

    def __init__(self, name: str = ""):
        self.name = name

    def fit(self, *_args: Any, **_params: Any) -> NoReturn:
        """Raise an error: the class is not in the file."""
        raise ValueError(
            f"the model was fitted with {self.name}. A model file holds only its name "
            "and its fitted arrays: set the parameter to such an object for a new fit"
        )

    transform = fit


# Strategies of which parameters and fitted attributes are stored.
STORED: dict[str, Any] = {
    "NamedStrategy": NamedStrategy,
    **{name: getattr(isa, name) for name in vars(isa)["__all__"]},
}


def save_model(estimator: AffineNRSfM, path: str | os.PathLike[str]) -> None:
    """
    Save a fitted model to a file that is safe to share.

    The file holds numbers, texts and arrays, and no code: opening it runs nothing.
    Later versions of the package read it.

    Parameters
    ----------
    estimator : AffineNRSfM
        A fitted estimator. Memory maps (with a path as `keep_frames`) are copied into
        the file. Callbacks are left out. Of strategies that are not part of
        `isa_nrsfm.isa` the file holds the name and the fitted arrays.
    path : str or path-like
        The file to write, by custom with the suffix ``.npz``. An existing file is
        replaced, as a whole or not at all.

    Raises
    ------
    ValueError
        If the estimator is no AffineNRSfM, is not fitted, or has a part that a model
        file cannot hold.
    OSError
        If the file cannot be written.

    See Also
    --------
    load_model : Load the model again.

    Examples
    --------
    >>> from pathlib import Path
    >>> from tempfile import TemporaryDirectory
    >>> from isa_nrsfm import AffineNRSfM
    >>> from isa_nrsfm.datasets import make_face_tracks
    >>> from isa_nrsfm.io import load_model, save_model
    >>> table = make_face_tracks(n_frames=40, n_components=1, random_state=0).data
    >>> model = AffineNRSfM(n_components=1, random_state=0).fit(table)
    >>> with TemporaryDirectory() as folder:
    ...     save_model(model, Path(folder, "faces.npz"))
    ...     loaded = load_model(Path(folder, "faces.npz"))
    >>> bool((loaded.transform(table) == model.transform(table)).all())
    True
    """
    if type(estimator) is not AffineNRSfM:
        raise ValueError(
            f"only an AffineNRSfM can be saved; got {full_name(type(estimator))}. Save "
            "the AffineNRSfM in it, such as pipeline[0] or search.best_estimator_, or "
            "all of it with joblib.dump"
        )
    check_is_fitted(estimator)
    arrays: Arrays = {}
    header = {
        "format": FORMAT,
        "format_version": FORMAT_VERSION,
        "package_version": __version__,
        **packed_model(estimator, "", arrays),
        "arrays": sorted(arrays),
    }
    header["digest"] = _digest(header, arrays)
    text = np.frombuffer(json.dumps(header).encode(), dtype=np.uint8)
    with whole_file(path) as file:
        write_arrays(file, {HEADER: text, **arrays})


def load_model(path: str | os.PathLike[str]) -> AffineNRSfM:
    """
    Load a model that `save_model` has saved.

    Numbers, texts and arrays are read, and nothing else: files of unknown origin do no
    harm.

    Parameters
    ----------
    path : str or path-like
        The file.

    Returns
    -------
    AffineNRSfM
        The fitted estimator. In place of a strategy that the file only names it has an
        object with the fitted arrays, which cannot be fitted again. A `random_state`
        that is no number is None.

    Raises
    ------
    ValueError
        If the file is no model file, is damaged or was written by a newer version; if
        arrays are missing, are not known or have wrong shapes; or if its contents need
        more memory than the file is large.
    OSError
        If the file cannot be opened.

    See Also
    --------
    save_model : Save a model.
    """
    with reading(path, "a model of isa_nrsfm"):
        return _restored(*_read(Path(path)))


def _read(path: Path) -> tuple[dict[str, Any], Arrays]:
    """Return the header and the arrays of a file whose digest is right."""
    arrays = read_arrays(path)
    if HEADER not in arrays or arrays[HEADER].dtype != np.uint8:
        raise ValueError("it has no header")
    header = json.loads(arrays.pop(HEADER).tobytes())
    if type(header) is not dict or header.get("format") != FORMAT:
        raise ValueError("its header is not that of a model")
    if (version := header.get("format_version")) != FORMAT_VERSION:
        raise ValueError(
            f"it was written by a newer isa_nrsfm (format {version}); this one reads "
            f"format {FORMAT_VERSION}"
        )
    check_names(header, PARTS["entries"], "entries")
    check_names(arrays, header["arrays"], "arrays")
    if _digest(header, arrays) != header["digest"]:
        raise ValueError("its digest is wrong: it is damaged or was changed")
    return header, arrays


def _digest(header: dict[str, Any], arrays: Arrays) -> str:
    """Return the SHA-256 digest of a header, but for its digest, and of all arrays."""
    text = {name: value for name, value in header.items() if name != "digest"}
    digest = hashlib.sha256(json.dumps(text, sort_keys=True).encode())
    for name, array in sorted(arrays.items()):
        digest.update(f"{name} {array.dtype.str} {array.shape}".encode())
        digest.update(array.tobytes())
    return digest.hexdigest()


def _restored(header: dict[str, Any], arrays: Arrays) -> AffineNRSfM:
    """Return the fitted estimator of a model file."""
    estimator = with_parts(AffineNRSfM, header, arrays)
    stored = header["frames"].items()
    entries = {name: unpacked(value, arrays) for name, value in stored}
    for name, choices in (("camera", CAMERAS), ("layout", LAYOUTS), ("loss", LOSSES)):
        if name in entries and entries[name] not in choices:
            raise ValueError(f"its {name} is not known: {entries[name]}")
    values = {**vars(estimator), **entries}
    if "focal_length_" in values:
        values["focal_length_"] = np.ravel(values["focal_length_"])
    _check_shapes(values)
    K = estimator.n_components_ = estimator._n_features_out = len(estimator.basis_)
    basis = np.concatenate([estimator.basis_, entries["further_basis"]])
    parts = _frame_model(entries), estimator.mean_shape_, basis, K
    pinhole, axes = (_pinhole(entries.get(name)) for name in ("pinhole", "axes"))
    kinds = entries["layout"], entries["unit"]
    estimator._model = TableModel(*parts, *kinds, pinhole, axes)
    estimator.camera_ = entries["camera"] if pinhole is None else "perspective"
    estimator.frames_scaled_ = entries["unit"] is None
    if entries["sizes"] is not None:
        estimator._frame_sizes = entries["sizes"]
    if (output := header["set_output"]) not in (None, "default", "pandas", "polars"):
        raise ValueError(f"its set_output is not known: {output}")
    return estimator.set_output(transform=output)


def _check_shapes(values: dict[str, Any]) -> None:
    """Raise if numbers of a model do not have the right shapes, or are missing."""
    if missing := [name for name in PARTS["needed"] if values.get(name) is None]:
        raise ValueError(f"it lacks attributes: {', '.join(missing)}")
    K, P = (*np.shape(values["basis_"]), 0, 0)[:2]
    D = K + len(values["further_basis"])
    N = (*np.shape(values.get("sizes", ())), 0)[0]
    sizes = {"K": K, "P": P, "D": D, "N": N, "D+1": D + 1, "D-K": D - K}
    sizes |= {"2P": 2 * P, "3K": 3 * K, "*": None}
    for text, names in PARTS["shapes"].items():
        shape = tuple(sizes[n] if n in sizes else int(n) for n in text.split())
        for name in names:
            if (value := values.get(name)) is not None:
                _check_numbers(name, value, shape)
            elif name in values and name in PARTS["finite"]:
                raise ValueError(f"{name} is missing")
    if not K or values["n_features_in_"] != 2 * P:
        raise ValueError(f"it has {K} basis shapes of {P} points")
    if "space" in values and np.linalg.matrix_rank(values["space"]) < 3:
        raise ValueError("space has no inverse")
    small = values["unit"] is not None and values["unit"] < SMALLEST
    for name in ("pinhole", "axes"):
        focal, *centre = values.get(name, (1.0,))[:3]
        if small or not (focal > 0 and np.isfinite(centre).all()):
            raise ValueError("its unit, or its pinhole camera, is not possible")


def _check_numbers(name: str, value: Any, shape: tuple[int | None, ...]) -> None:
    """Raise if numbers have another shape or type, or values that are not possible."""
    numbers, kinds = np.asarray(value), "f" if shape else "iuf"
    kinds = {"feature_names_in_": "O", "stable_sets_": "b"}.get(name, kinds)
    pairs = zip(shape, numbers.shape, strict=False)
    fits = numbers.ndim == len(shape) and all(n in (None, m) for n, m in pairs)
    if not fits or numbers.dtype.kind not in kinds:
        raise ValueError(f"{name} should be of shape {shape}; it has {numbers.shape}")
    if numbers.dtype.kind == "f" and numbers.dtype.itemsize not in (4, 8):
        raise ValueError(f"{name} is of type {numbers.dtype}")
    positive = name in PARTS["positive"]
    if (positive or name in PARTS["finite"]) and not np.isfinite(numbers).all():
        raise ValueError(f"{name} is not finite")
    if positive and (numbers < 0).any():
        raise ValueError(f"{name} is negative")


def _frame_entries(estimator: AffineNRSfM) -> dict[str, Any]:
    """Return the model of a frame and the sizes of frames, by the names in a file."""
    model, frames = estimator._model, estimator._model.frames
    entries = {
        "camera": frames.camera,
        "layout": model.layout,
        "unit": model.unit,
        "sizes": vars(estimator).get("_frame_sizes"),
        "further_basis": model.basis[model.n_components :],
    }
    for name in ("pinhole", "axes"):
        if (pinhole := getattr(model, name)) is not None:
            f, (x, y), *kinds = pinhole
            entries[name] = np.array([f, x, y, *kinds], dtype=float)
    if not frames.joint:
        mean_shape, *basis = frames.shapes.mT
        return {**entries, "mean_shape": mean_shape, "basis": np.array(basis)}
    images = np.array(frames.certainty.images)
    certainty = frames.certainty._asdict() | {"images": images}
    return {
        **entries,
        "loss": frames.loss,
        "shapes": frames.shapes,
        "noise_variance": frames.noise_variance,
        "coefficient_starts": frames.starts,
        "mixing": frames.gauge.mixing,
        "space": frames.gauge.space,
        **dict(zip(PARTS["certainty"], certainty.values(), strict=True)),
    }


def _pinhole(entry: NDArray | None) -> Pinhole | None:
    """Return a camera of `_frame_entries`, if any."""
    if entry is None:
        return None
    f, x, y, robust, near = entry.tolist()
    return Pinhole(f, (x, y), bool(robust), bool(near))


def _frame_model(entries: dict[str, Any]) -> FrameModel:
    """Return the model of a frame of `_frame_entries`."""
    if "loss" not in entries:
        rigid = entries["mean_shape"], entries["basis"], entries["camera"]
        return FrameModel.rigid(*rigid)
    certainty = [entries[name] for name in PARTS["certainty"]]
    total, deformation, *further, residual, images, weighted = certainty
    certainty = [float(total), float(deformation), *further, float(residual)]
    certainty += [tuple(images), weighted is True]
    names = "shapes", "noise_variance", "coefficient_starts", "loss"
    shapes, noise, starts, loss = (entries[name] for name in names)
    gauge = FrameMap(entries["mixing"], entries["space"])
    errors = DepthCertainty(*certainty)
    return FrameModel(shapes, noise, starts, loss, gauge, entries["camera"], errors)


def packed(value: Any, name: str, arrays: Arrays) -> Any:
    """Return the JSON value of a parameter or attribute; add its arrays to `arrays`."""
    if value is None or type(value) in (bool, int, float, str):
        return value
    if isinstance(value, np.ndarray | np.generic):
        if (array := np.asarray(value)).dtype.kind in "biufU":
            arrays[name] = array
            return {"array": name}
        if array.ndim == 1 and all(isinstance(item, str) for item in array.tolist()):
            return {"names": array.tolist()}
    elif isinstance(value, np.random.RandomState):
        return None  # a new fit draws other numbers
    elif isinstance(value, Path):
        return {"path": str(value)}
    elif type(value) in (tuple, list):
        if (numbers := np.array(value)).ndim == 1 and numbers.dtype.kind in "iuf":
            return {type(value).__name__: numbers.tolist()}
    elif type(value) in STORED.values():
        parts = packed_parts(value, f"{name}.", arrays)
        return {"object": {"class": type(value).__name__, **parts}}
    elif type(model := fitted_prior(value)) is AffineNRSfM:
        return {"model": packed_model(model, f"{name}.", arrays)}
    elif name.rpartition(".")[2] in ("isa", "isa_"):
        named = NamedStrategy(full_name(type(value)))
        for key, item in fitted_attributes(value).items():
            if np.asarray(item).dtype.kind in "biuf" and not isinstance(item, list):
                setattr(named, key, item)
        return packed(named, name, arrays)
    raise ValueError(
        f"{name} is of type {full_name(type(value))}, which a model file cannot hold"
    )


def packed_model(estimator: AffineNRSfM, prefix: str, arrays: Arrays) -> dict[str, Any]:
    """Return the parts of a fitted estimator as JSON values."""
    config = vars(estimator).get("_sklearn_output_config", {})
    for name in ("stability_", "stable_sets_"):  # a file has no halves
        getattr(estimator, name, None)
    return {
        **packed_parts(estimator, prefix, arrays),
        "set_output": config.get("transform"),
        "frames": packed_all(_frame_entries(estimator), f"{prefix}frames.", arrays),
    }


def packed_parts(held: Any, prefix: str, arrays: Arrays) -> dict[str, Any]:
    """Return parameters and fitted attributes of an object as JSON values."""
    return {
        "parameters": packed_all(held.get_params(deep=False), prefix, arrays),
        "attributes": packed_all(fitted_attributes(held), prefix, arrays),
    }


def packed_all(values: dict[str, Any], prefix: str, arrays: Arrays) -> dict[str, Any]:
    """Return the JSON values of parameters or attributes by their names."""
    return {name: packed(values[name], prefix + name, arrays) for name in values}


def unpacked(value: Any, arrays: Arrays) -> Any:
    """Return the parameter or attribute of a JSON value of `packed`."""
    match value:
        case None | bool() | int() | float() | str():
            return value
        case {"array": str(name)} if name in arrays:
            return arrays[name] if arrays[name].ndim else arrays[name][()]
        case {"names": [*names]} if all(type(item) is str for item in names):
            return np.array(names, dtype=object)
        case {"path": str(path)}:
            return Path(path)
        case {"tuple": [*numbers]} if all(type(n) in (int, float) for n in numbers):
            return tuple(numbers)
        case {"list": [*numbers]} if all(type(n) in (int, float) for n in numbers):
            return numbers
        case {"object": {"class": str(name), **parts}} if name in STORED:
            return with_parts(STORED[name], parts, arrays)
        case {"model": model}:
            return _restored(model, arrays)
    raise ValueError(f"its header has a value that is not known: {str(value)[:60]}")


def with_parts(kind: type, parts: Any, arrays: Arrays) -> Any:
    """Return an object with the parameters and attributes of `packed_parts`."""
    stored = parts["parameters"].items()
    parameters = {name: unpacked(value, arrays) for name, value in stored}
    check_names(parameters, kind().get_params(deep=False), "parameters")
    created = kind(**parameters)
    if hasattr(kind, "_parameter_constraints"):
        try:
            created._validate_params()
        except ValueError as error:
            name = str(error).split("'")[1]
            raise ValueError(f"its {name} is not valid") from error
    for name, value in parts["attributes"].items():
        if name.startswith("_") or not name.endswith("_"):
            raise ValueError(f"it has an unknown attribute: {name}")
        setattr(created, name, unpacked(value, arrays))
    if hasattr(created, "n_features_in_"):
        created._n_features_out = created.n_features_in_
    return created


def fitted_attributes(held: Any) -> dict[str, Any]:
    """Return the attributes of an object whose names end with one underscore."""
    known = getattr(held, "__dict__", {})
    names = {name for name in known if name.endswith("_") and name[0] != "_"}
    return {name: known[name] for name in known if name in names - {*PARTS["implied"]}}


def check_names(found: Iterable[str], expected: Iterable[str], kind: str) -> None:
    """Raise if names are missing or not known."""
    found, expected = set(found), set(expected)
    if missing := sorted(expected - found):
        raise ValueError(f"it lacks {kind}: {', '.join(missing)}")
    if unknown := sorted(found - expected):
        raise ValueError(f"it has unknown {kind}: {', '.join(unknown)}")


def full_name(kind: type) -> str:
    """Return the name of a class with that of its module."""
    return f"{kind.__module__}.{kind.__qualname__}"
