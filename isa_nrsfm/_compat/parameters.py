"""scikit-learn's decorators that check parameters, with the types that they lack."""

from collections.abc import Callable
from typing import Any, TypeVar

from sklearn.base import _fit_context
from sklearn.utils._param_validation import validate_params

Function = TypeVar("Function", bound=Callable[..., Any])


def fit_context(*, nested: bool) -> Callable[[Function], Function]:
    """
    Return the decorator of methods `fit`, which checks the estimator's parameters.

    Parameters
    ----------
    nested : bool
        Whether estimators that are fitted inside check theirs, too.

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
