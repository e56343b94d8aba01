"""Fallbacks for scikit-learn's private checks of parameters.

Constraints are written as in scikit-learn's estimators. Only the kinds that this
package uses are implemented.
"""

from collections.abc import Callable, Iterable, Sequence
from functools import wraps
from inspect import signature
from numbers import Integral
from typing import Any

import numpy as np
from sklearn.utils import check_random_state


class Interval:
    """
    Numbers of a type between two bounds. A bound of None is infinite.

    True and False are no numbers.
    """

    def __init__(self, type: type, left: Any, right: Any, *, closed: str):
        self.type, self.left, self.right, self.closed = type, left, right, closed

    def is_satisfied_by(self, value: Any) -> bool:
        """Return whether a value is such a number."""
        if isinstance(value, bool) or not isinstance(value, self.type):
            return False
        number: Any = value
        left = -np.inf if self.left is None else self.left
        right = np.inf if self.right is None else self.right
        above = number >= left if self.closed in ("left", "both") else number > left
        below = number <= right if self.closed in ("right", "both") else number < right
        return bool(above and below)

    def __str__(self) -> str:
        """Return the interval in words."""
        left = "[" if self.left is not None and self.closed in ("left", "both") else "("
        ends = self.right is not None and self.closed in ("right", "both")
        lower = "-inf" if self.left is None else self.left
        upper = "inf" if self.right is None else self.right
        kind = "an int" if self.type is Integral else "a float"
        return f"{kind} in the range {left}{lower}, {upper}{']' if ends else ')'}"


class StrOptions:
    """A string that is one of the given options."""

    def __init__(self, options: Iterable[str]):
        self.options = set(options)

    def is_satisfied_by(self, value: Any) -> bool:
        """Return whether a value is one of the options."""
        return isinstance(value, str) and value in self.options

    def __str__(self) -> str:
        """Return the options in words."""
        return f"a str among {sorted(self.options)}"


class HasMethods:
    """An object with the given methods."""

    def __init__(self, methods: str | Sequence[str]):
        self.methods = [methods] if isinstance(methods, str) else list(methods)

    def is_satisfied_by(self, value: Any) -> bool:
        """Return whether a value has all of the methods."""
        return all(callable(getattr(value, name, None)) for name in self.methods)

    def __str__(self) -> str:
        """Return the names of the methods."""
        return f"an object with {', '.join(self.methods)}"


def _is_random_state(value: Any) -> bool:
    """Return whether a value is a seed or a generator."""
    try:
        check_random_state(value)
    except ValueError:
        return False
    return True


def _is_satisfied(constraint: Any, value: Any) -> bool:
    """Return whether a value is what a constraint asks for."""
    if constraint is None:
        return value is None
    if constraint == "boolean":
        return isinstance(value, bool | np.bool_)
    if constraint == "verbose":
        return isinstance(value, Integral | np.bool_) and int(value) >= 0
    if constraint == "random_state":
        return _is_random_state(value)
    if isinstance(constraint, type):
        return isinstance(value, constraint)
    return bool(constraint.is_satisfied_by(value))


def check_values(
    constraints: dict[str, list[Any]], values: dict[str, Any], where: str
) -> None:
    """
    Check parameters.

    Parameters
    ----------
    constraints : dict
        For each parameter what it may be.
    values : dict
        The parameters.
    where : str
        Whose parameters they are, for the message.

    Raises
    ------
    ValueError
        If a parameter is none of what it may be.
    """
    for name, value in values.items():
        allowed = constraints.get(name)
        if allowed is None or any(_is_satisfied(each, value) for each in allowed):
            continue
        words = [getattr(each, "__name__", str(each)) for each in allowed]
        raise ValueError(
            f"The {name!r} parameter of {where} must be {' or '.join(words)}. "
            f"Got {value!r} instead."
        )


def fit_context(
    *, prefer_skip_nested_validation: bool
) -> Callable[[Callable[..., Any]], Callable[..., Any]]:
    """Return a decorator of `fit` that checks the estimator's parameters."""

    def decorate(function: Callable[..., Any]) -> Callable[..., Any]:
        @wraps(function)
        def fit(estimator: Any, *args: Any, **kwargs: Any) -> Any:
            values = estimator.get_params(deep=False)
            name = type(estimator).__name__
            check_values(estimator._parameter_constraints, values, name)
            return function(estimator, *args, **kwargs)

        return fit

    return decorate


def validate_params(
    constraints: dict[str, list[Any]], *, prefer_skip_nested_validation: bool
) -> Callable[[Callable[..., Any]], Callable[..., Any]]:
    """Return a decorator of functions that checks their parameters."""

    def decorate(function: Callable[..., Any]) -> Callable[..., Any]:
        @wraps(function)
        def checked(*args: Any, **kwargs: Any) -> Any:
            given = signature(function).bind(*args, **kwargs).arguments
            check_values(constraints, given, function.__name__)
            return function(*args, **kwargs)

        return checked

    return decorate
