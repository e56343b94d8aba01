"""All private names of scikit-learn that are used, each with a public fallback.

Parameters are checked by scikit-learn's own code, so that messages are the same as its
own. A version that lacks this code gets the fallbacks of `plain_checks`.
"""

from collections.abc import Callable
from typing import Any, TypeVar

from isa_nrsfm._compat.plain_checks import check_values

try:
    from sklearn.base import _fit_context
    from sklearn.utils._param_validation import (
        HasMethods,
        Interval as _Interval,
        StrOptions,
        validate_params,
    )
except ImportError:
    from isa_nrsfm._compat.plain_checks import (
        HasMethods,
        Interval as _Interval,
        StrOptions,
        fit_context as _fit_context,
        validate_params,
    )

try:
    from sklearn.utils._missing import is_pandas_na
except ImportError:

    def is_pandas_na(x: Any) -> bool:
        """Return whether a value is pandas' mark of a missing one."""
        return type(x).__name__ == "NAType"


try:
    from sklearn.utils import _safe_indexing as taken_rows
    from sklearn.utils.validation import _num_samples as number_of_rows
except ImportError:

    def taken_rows(X: Any, indices: Any) -> Any:
        """Return rows of an array or a dataframe."""
        return X.iloc[indices] if hasattr(X, "iloc") else X[indices]

    def number_of_rows(x: Any) -> int:
        """Return the number of rows of an array or a dataframe."""
        return len(x)


__all__ = [
    "HasMethods",
    "Interval",
    "StrOptions",
    "check_parameters",
    "checked_parameters",
    "fit_context",
    "is_pandas_na",
    "number_of_rows",
    "taken_rows",
]


class Interval(_Interval):
    """Numbers of a type between two bounds. True and False are no numbers."""

    def is_satisfied_by(self, value: Any) -> bool:
        """Return whether a value is such a number."""
        return not isinstance(value, bool) and bool(super().is_satisfied_by(value))


Function = TypeVar("Function", bound=Callable[..., Any])


def fit_context(*, nested: bool) -> Callable[[Function], Function]:
    """
    Return the decorator of `fit` methods that checks the estimator's parameters.

    Parameters
    ----------
    nested : bool
        Whether estimators that this one fits check their parameters, too.

    Returns
    -------
    callable
        The decorator.
    """
    decorate: Callable[[Function], Function] = _fit_context(
        prefer_skip_nested_validation=not nested
    )
    return decorate


def checked_parameters(
    constraints: dict[str, list[Any]],
) -> Callable[[Function], Function]:
    """
    Return a decorator of functions that checks their parameters.

    Parameters
    ----------
    constraints : dict
        For each parameter what it may be, as in scikit-learn's estimators.

    Returns
    -------
    callable
        The decorator.
    """
    decorate: Callable[[Function], Function] = validate_params(
        constraints, prefer_skip_nested_validation=True
    )
    return decorate


def check_parameters(estimator: Any) -> None:
    """
    Check the parameters of an estimator.

    Parameters
    ----------
    estimator : estimator
        The estimator. One without constraints is not checked.

    Raises
    ------
    ValueError
        If a parameter is not what it may be.
    """
    if not hasattr(estimator, "_parameter_constraints"):
        return
    if hasattr(estimator, "_validate_params"):
        estimator._validate_params()
    else:
        name = type(estimator).__name__
        constraints = estimator._parameter_constraints
        check_values(constraints, estimator.get_params(deep=False), name)
