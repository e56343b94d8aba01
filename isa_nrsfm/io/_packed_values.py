"""Parameters and fitted attributes as JSON values beside arrays, and back.

Numbers of Python, texts, True, False and None are as in JSON. All else is an object
with one entry that names its kind, such as ``{"array": name}`` for an array.
"""

from collections.abc import Iterable
from pathlib import Path
from typing import Any, NoReturn

import numpy as np
from numpy.typing import NDArray
from sklearn.base import BaseEstimator

from isa_nrsfm import isa

Arrays = dict[str, NDArray]
# Attributes that the model of a frame implies.
IMPLIED = ("camera_", "frames_scaled_")


class NamedStrategy(BaseEstimator):
    """Placeholder for an ISA strategy or density that a model file only names."""

    def __init__(self, name: str = ""):
        self.name = name

    def fit(self, *_args: Any, **_params: Any) -> NoReturn:
        """Raise an error: the class is not in the file."""
        raise ValueError(
            f"the model was fitted with {self.name}. A model file holds only its name "
            "and its fitted arrays: set the parameter to such an object for a new fit"
        )

    transform = log_density = derivatives = fit


# Strategies and densities of which parameters and fitted attributes are stored.
STORED: dict[str, Any] = {
    "NamedStrategy": NamedStrategy,
    **{name: getattr(isa, name) for name in vars(isa)["__all__"]},
}


def packed(value: Any, name: str, arrays: Arrays) -> Any:
    """Return the JSON value of a parameter or attribute; add its arrays to `arrays`."""
    if value is None or type(value) in (bool, int, float, str):
        return value
    if isinstance(value, np.ndarray | np.generic):
        array = np.asarray(value)
        if array.dtype.kind in "biufU":
            arrays[name] = array
            return {"array": name}
        if array.ndim == 1 and all(isinstance(item, str) for item in array.tolist()):
            return {"names": array.tolist()}
    elif isinstance(value, np.random.RandomState):
        if value.get_state(legacy=False)["bit_generator"] == "MT19937":
            _, key, *rest = value.get_state()
            return {"random_state": [packed(key, name, arrays), *rest]}
    elif isinstance(value, Path):
        return {"path": str(value)}
    elif type(value) in STORED.values():
        parts = packed_parts(value, f"{name}.", arrays)
        return {"object": {"class": type(value).__name__, **parts}}
    elif name.rpartition(".")[2] in ("isa", "isa_", "density"):
        named = NamedStrategy(full_name(type(value)))
        for key, item in fitted_attributes(value).items():
            if np.asarray(item).dtype.kind in "biuf" and not isinstance(item, list):
                setattr(named, key, item)
        return packed(named, name, arrays)
    raise ValueError(
        f"{name} is of type {full_name(type(value))}, which a model file cannot hold"
    )


def packed_parts(held: Any, prefix: str, arrays: Arrays) -> dict[str, Any]:
    """Return parameters and fitted attributes of an object as JSON values."""
    parts = {
        "parameters": held.get_params(deep=False),
        "attributes": fitted_attributes(held),
    }
    return {
        part: {
            name: packed(value, f"{prefix}{name}", arrays)
            for name, value in values.items()
        }
        for part, values in parts.items()
    }


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
        case {"random_state": [key, int(position), int(has_gauss), float(gauss)]}:
            key = unpacked(key, arrays)
            # NumPy does not check the position, and reads there.
            if np.shape(key) == (624,) and 0 <= position <= 624:
                random = np.random.RandomState()
                random.set_state(("MT19937", key, position, has_gauss, gauss))
                return random
        case {"object": {"class": str(name), **parts}} if name in STORED:
            return with_parts(STORED[name], parts, arrays)
    raise ValueError(f"its header has a value that is not known: {str(value)[:60]}")


def with_parts(kind: type, parts: Any, arrays: Arrays) -> Any:
    """Return an object with the parameters and attributes of `packed_parts`."""
    stored = parts["parameters"].items()
    parameters = {name: unpacked(value, arrays) for name, value in stored}
    # Parameters that are newer than the file have their defaults.
    defaults = kind().get_params(deep=False)
    check_names({**defaults, **parameters}, defaults, "parameters")
    created = kind(**parameters)
    for name, value in parts["attributes"].items():
        if name.startswith("_") or not name.endswith("_"):
            raise ValueError(f"it has an unknown attribute: {name}")
        setattr(created, name, unpacked(value, arrays))
    if hasattr(created, "n_features_in_"):
        created._n_features_out = created.n_features_in_
    return created


def fitted_attributes(held: Any) -> dict[str, Any]:
    """Return the attributes of an object whose names end with one underscore."""
    return {
        name: value
        for name, value in getattr(held, "__dict__", {}).items()
        if name.endswith("_") and not name.startswith("_") and name not in IMPLIED
    }


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
