"""Checks of values that were read from a file; errors say where in the file."""

import sys
from collections.abc import Iterable
from numbers import Integral, Real
from typing import Any

import numpy as np
from numpy.typing import NDArray


def check_entries(values: Any, where: str, names: Iterable[str]) -> dict[str, Any]:
    """
    Return a dict that has the given entries and no others.

    Parameters
    ----------
    values : object
        What should be the dict.
    where : str
        What it is called in errors.
    names : iterable of str
        The names of its entries.

    Returns
    -------
    dict
        The same.

    Raises
    ------
    ValueError
        If it is no dict, or lacks entries, or has others.
    """
    if type(values) is not dict:
        raise ValueError(f"{where} should be a dict; got {kind_of(values)}")
    names = set(names)
    if missing := sorted(names - values.keys()):
        raise ValueError(f"{where} should have {', '.join(missing)}; got none")
    if unknown := sorted(map(str, values.keys() - names)):
        raise ValueError(f"{where} has entries that are not known: {unknown}")
    return values


def check_array(
    value: Any, where: str, shape: tuple[int | None, ...], *, kind: str = "float"
) -> NDArray:
    """
    Return an array of the given shape.

    Parameters
    ----------
    value : object
        What should be the array.
    where : str
        What it is called in errors.
    shape : tuple of int or None
        Its shape; None is any length.
    kind : {"float", "finite", "whole"}, default="float"
        Its numbers: single or double precision, with NaN or without, or whole ones.

    Returns
    -------
    ndarray
        The same, in the byte order of the machine.

    Raises
    ------
    ValueError
        If it is no such array.
    """
    if type(value) is not np.ndarray:
        raise ValueError(f"{where} should be an array; got {kind_of(value)}")
    is_float = value.dtype.kind == "f" and value.dtype.itemsize in (4, 8)
    if not (value.dtype.kind == "i" if kind == "whole" else is_float):
        wanted = "whole" if kind == "whole" else "single or double precision"
        raise ValueError(f"{where} should have {wanted} numbers; got {value.dtype}")
    if len(shape) != value.ndim or any(
        length not in (None, got)
        for length, got in zip(shape, value.shape, strict=True)
    ):
        lengths = ", ".join(
            "any" if length is None else str(length) for length in shape
        )
        raise ValueError(f"{where} should have shape ({lengths}); got {value.shape}")
    if kind == "finite" and not np.isfinite(value).all():
        raise ValueError(f"{where} should be finite; got NaN or infinity")
    return value.astype(value.dtype.newbyteorder("="), copy=False)


def check_number(value: Any, where: str, *, positive: bool = False) -> Any:
    """
    Return a number.

    Parameters
    ----------
    value : object
        What should be the number.
    where : str
        What it is called in errors.
    positive : bool, default=False
        Whether it is finite and above zero.

    Returns
    -------
    float or number of numpy
        The same.

    Raises
    ------
    ValueError
        If it is no such number.
    """
    if isinstance(value, bool) or not isinstance(value, Real):
        raise ValueError(f"{where} should be a number; got {kind_of(value)}")
    if positive and not 0 < value <= sys.float_info.max:  # type: ignore[operator]
        raise ValueError(f"{where} should be finite and above zero; got {value}")
    return value


def check_whole(value: Any, where: str, *, least: int = 0, most: Any = None) -> Any:
    """
    Return a whole number.

    Parameters
    ----------
    value : object
        What should be the number.
    where : str
        What it is called in errors.
    least : int, default=0
        The least that it may be.
    most : int, default=None
        The most that it may be.

    Returns
    -------
    int or whole number of numpy
        The same.

    Raises
    ------
    ValueError
        If it is no such number.
    """
    if isinstance(value, bool) or not isinstance(value, Integral):
        raise ValueError(f"{where} should be a whole number; got {kind_of(value)}")
    if value < least or (most is not None and value > most):
        wanted = f"from {least}" if most is None else f"from {least} to {most}"
        raise ValueError(f"{where} should be {wanted}; got {value}")
    return value


def check_choice(value: Any, where: str, choices: Iterable[str | None]) -> Any:
    """
    Return one of several texts.

    Parameters
    ----------
    value : object
        What should be the text.
    where : str
        What it is called in errors.
    choices : iterable of str or None
        What it may be.

    Returns
    -------
    str or None
        The same.

    Raises
    ------
    ValueError
        If it is none of them.
    """
    choices = list(choices)
    if not (value is None or isinstance(value, str)) or value not in choices:
        named = " or ".join(map(repr, choices))
        got = repr(value) if isinstance(value, str) else kind_of(value)
        raise ValueError(f"{where} should be {named}; got {got}")
    return value


def check_flag(value: Any, where: str) -> bool:
    """
    Return True or False.

    Parameters
    ----------
    value : object
        What should be one of them.
    where : str
        What it is called in errors.

    Returns
    -------
    bool
        The same.

    Raises
    ------
    ValueError
        If it is neither.
    """
    if not isinstance(value, bool):
        raise ValueError(f"{where} should be True or False; got {kind_of(value)}")
    return value


def check_names(value: Any, where: str, n_names: int) -> NDArray:
    """
    Return the names of columns.

    Parameters
    ----------
    value : object
        What should be a list of them.
    where : str
        What it is called in errors.
    n_names : int
        Their number.

    Returns
    -------
    ndarray of shape (n_names,)
        The names, of type object.

    Raises
    ------
    ValueError
        If it is no list of so many texts.
    """
    if type(value) is not list or not all(isinstance(name, str) for name in value):
        raise ValueError(f"{where} should be a list of names; got {kind_of(value)}")
    if len(value) != n_names:
        raise ValueError(f"{where} should have {n_names} names; got {len(value)}")
    names = np.empty(n_names, dtype=object)
    names[:] = value
    return names


def kind_of(value: Any) -> str:
    """Return the type of a value, in words that errors use."""
    kind = type(value)
    if value is None or kind.__module__ == "builtins":
        return "None" if value is None else kind.__name__
    return f"{kind.__module__}.{kind.__qualname__}"
