"""Parameters, strategies and states of random numbers as plain values, and back.

What is no number, text or array is a dict with the entry "class": one of `CLASSES` with
its public parameters and fitted attributes, a state of random numbers or a path.
"""

from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np

from isa_nrsfm._compat.scikit_learn import check_parameters
from isa_nrsfm.io._skops_values import NUMPY_TYPES, PLAIN_TYPES
from isa_nrsfm.io._value_checks import (
    check_array,
    check_choice,
    check_entries,
    check_names,
    check_number,
    check_whole,
    kind_of,
)
from isa_nrsfm.isa import FastISA, PooledFastICA, SqrtDensity

# The fitted attributes of the public classes that a model may have parts of.
OF_STRATEGIES = ("components_", "mean_", "n_iter_", "n_features_in_")
CLASSES: dict[str, tuple[type, tuple[str, ...]]] = {
    "FastISA": (
        FastISA,
        (
            *OF_STRATEGIES,
            "feature_names_in_",
            "log_likelihood_",
            "log_likelihoods_",
            "n_iters_",
        ),
    ),
    "PooledFastICA": (
        PooledFastICA,
        (*OF_STRATEGIES, "feature_names_in_", "criteria_"),
    ),
    "SqrtDensity": (SqrtDensity, ()),
}
PUBLIC_PARTS = ("parameters", "attributes", "set_output")
# What scikit-learn's transformers hold besides, and what stands for it in a file.
N_OUT, SET_OUTPUT = "_n_features_out", "_sklearn_output_config"
N_FEATURES = "n_features_in_"
OUTPUTS = (None, "default", "pandas", "polars")
GENERATOR = "MT19937"


def plain_value(value: Any, where: str) -> Any:
    """
    Return the plain value that stands for a parameter or a fitted attribute.

    Parameters
    ----------
    value : object
        The parameter or attribute.
    where : str
        What it is called in errors.

    Returns
    -------
    object
        None, a number, a text, an array in memory, a list of texts, or a dict of these.

    Raises
    ------
    ValueError
        If a model file cannot hold it.
    """
    if value is None or type(value) in (*PLAIN_TYPES, *NUMPY_TYPES):
        return value
    if type(value) in (np.ndarray, np.memmap):
        if value.dtype.kind in "iuf":
            return np.asarray(value)
        if value.ndim == 1 and all(isinstance(item, str) for item in value.tolist()):
            return value.tolist()
    if type(value) is np.random.RandomState:
        return _plain_state(value, where)
    if isinstance(value, Path):
        return {"class": "Path", "path": str(value)}
    for name, (kind, attributes) in CLASSES.items():
        if type(value) is kind:
            parts = plain_parts(value, attributes, (), vars(value), where)
            return {"class": name, **parts}
    raise ValueError(
        f"{where} is of type {kind_of(value)}, which is not part of a model: a model "
        "file holds numbers, texts, arrays in memory, random states, paths and "
        f"{', '.join(CLASSES)}"
    )


def plain_parts(
    estimator: Any,
    attributes: tuple[str, ...],
    private: tuple[str, ...],
    held: dict[str, Any],
    where: str,
) -> dict[str, Any]:
    """
    Return the public parts of an estimator as plain values.

    Parameters
    ----------
    estimator : estimator
        The estimator.
    attributes : tuple of str
        The names of its fitted attributes; those that it has not are None.
    private : tuple of str
        The names of what it may hold besides.
    held : dict
        All that it holds.
    where : str
        What it is called in errors.

    Returns
    -------
    dict
        Its parameters, attributes (None for an estimator that is not fitted) and
        output.

    Raises
    ------
    ValueError
        If it holds anything else, or what a model file cannot hold.
    """
    parameters = estimator.get_params(deep=False)
    known = {*parameters, *attributes, *private, N_OUT, SET_OUTPUT}
    if unknown := sorted(held.keys() - known):
        raise ValueError(
            f"{where} has {', '.join(unknown)}, which is not part of a model"
        )
    fitted = {name: held[name] for name in attributes if name in held}
    return {
        "parameters": {
            name: plain_value(value, f"{where}.{name}")
            for name, value in parameters.items()
        },
        "attributes": {
            name: plain_value(fitted.get(name), f"{where}.{name}")
            for name in attributes
        }
        if fitted
        else None,
        "set_output": held.get(SET_OUTPUT, {}).get("transform"),
    }


def with_parameters(create: Callable[..., Any], parts: dict[str, Any]) -> Any:
    """
    Return an estimator with the parameters and the output of its parts.

    Parameters
    ----------
    create : class
        Its class.
    parts : dict
        The parts of `plain_parts`.

    Returns
    -------
    estimator
        The estimator, not fitted.

    Raises
    ------
    ValueError
        If the parameters or the output are not those of such an estimator.
    """
    name = getattr(create, "__name__", "estimator")
    parameters = check_entries(
        parts["parameters"], f"parameters of {name}", create().get_params(deep=False)
    )
    estimator = create(
        **{
            key: _restored(value, f"parameter {key} of {name}")
            for key, value in parameters.items()
        }
    )
    check_parameters(estimator)
    output = check_choice(parts["set_output"], f"set_output of {name}", OUTPUTS)
    if output is not None:
        estimator.set_output(transform=output)
    return estimator


def restored_strategy(value: Any, where: str) -> Any:
    """
    Return a strategy from the plain value that stands for it.

    Parameters
    ----------
    value : object
        The value.
    where : str
        What it is called in errors.

    Returns
    -------
    FastISA, PooledFastICA or SqrtDensity
        The strategy, fitted if it was, or the density.

    Raises
    ------
    ValueError
        If it is no such value.
    """
    record = check_entries(value, where, ("class", *PUBLIC_PARTS))
    name = check_choice(record["class"], f"class of {where}", CLASSES)
    kind, attributes = CLASSES[name]
    if kind is SqrtDensity:
        check_choice(record["set_output"], f"set_output of {where}", (None,))
    strategy = with_parameters(kind, record)
    if kind is SqrtDensity:
        check_number(strategy.eps, f"parameter eps of {name}", positive=True)
    if record["attributes"] is None:
        return strategy
    fitted = check_entries(record["attributes"], f"attributes of {where}", attributes)
    for key, attribute in _checked_fit(fitted, where).items():
        setattr(strategy, key, attribute)
    if N_FEATURES in fitted:
        setattr(strategy, N_OUT, fitted[N_FEATURES])
    return strategy


def _checked_fit(fitted: dict[str, Any], where: str) -> dict[str, Any]:
    """Return the attributes that a fitted strategy has."""
    checks: dict[str, Callable[[Any, str], Any]] = {}
    if fitted:
        n = check_whole(fitted[N_FEATURES], f"{where}.{N_FEATURES}", least=1)
        checks = {
            N_FEATURES: check_whole,
            "components_": lambda a, w: check_array(a, w, (n, n), kind="finite"),
            "mean_": lambda a, w: check_array(a, w, (n,), kind="finite"),
            "n_iter_": check_whole,
            "feature_names_in_": lambda a, w: check_names(a, w, n),
            "criteria_": lambda a, w: check_array(a, w, (None,)),
            "log_likelihood_": check_number,
            "log_likelihoods_": lambda a, w: check_array(a, w, (None,)),
            "n_iters_": lambda a, w: check_array(a, w, (None,), kind="whole"),
        }
    if unchecked := sorted(fitted.keys() - checks.keys()):
        raise ValueError(f"{where} has {', '.join(unchecked)}, which nothing checks")
    return {
        name: checks[name](value, f"{where}.{name}")
        for name, value in fitted.items()
        if value is not None or name != "feature_names_in_"
    }


def _restored(value: Any, where: str) -> Any:
    """Return the parameter that a plain value stands for."""
    if value is None or type(value) in (*PLAIN_TYPES, *NUMPY_TYPES):
        return value
    kind = value.get("class") if type(value) is dict else None
    if kind == "RandomState":
        return _restored_state(value, where)
    if kind == "Path":
        path = check_entries(value, where, ("class", "path"))["path"]
        if type(path) is not str:
            raise ValueError(f"path of {where} should be text; got {kind_of(path)}")
        return Path(path)
    if isinstance(kind, str):
        return restored_strategy(value, where)
    raise ValueError(f"{where} is of type {kind_of(value)}, which it cannot be")


def _plain_state(random: np.random.RandomState, where: str) -> dict[str, Any]:
    """Return a state of random numbers as a dict."""
    state: Any = random.get_state(legacy=False)
    if state["bit_generator"] != GENERATOR:
        raise ValueError(
            f"{where} should be a RandomState of {GENERATOR}; "
            f"got one of {state['bit_generator']}"
        )
    return {"class": "RandomState", "state": state}


def _restored_state(value: dict[str, Any], where: str) -> np.random.RandomState:
    """Return a state of random numbers, of which numpy does not check the position."""
    state = check_entries(value, where, ("class", "state"))["state"]
    names = ("bit_generator", "state", "has_gauss", "gauss")
    check_entries(state, f"state of {where}", names)
    check_choice(state["bit_generator"], f"bit_generator of {where}", (GENERATOR,))
    twister = check_entries(state["state"], f"state of {where}", ("key", "pos"))
    key = twister["key"]
    if type(key) is not np.ndarray or (key.dtype, key.shape) != (np.uint32, (624,)):
        raise ValueError(f"key of {where} should be 624 whole numbers of 32 bits")
    check_whole(twister["pos"], f"pos of {where}", most=624)
    check_whole(state["has_gauss"], f"has_gauss of {where}", most=1)
    if type(state["gauss"]) is not float:
        raise ValueError(f"gauss of {where} should be a number with a point")
    random = np.random.RandomState()
    random.set_state(state)
    return random
