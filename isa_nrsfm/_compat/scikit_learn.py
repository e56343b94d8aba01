"""The private names of scikit-learn that are used. All supported versions have them."""

import copy
import inspect
from collections.abc import Callable
from functools import wraps
from numbers import Integral
from typing import Any, TypeVar

import numpy as np
from numpy.typing import NDArray
from sklearn.base import ClassNamePrefixFeaturesOutMixin, _fit_context
from sklearn.utils import _param_validation, _safe_indexing as taken_rows
from sklearn.utils._param_validation import (
    HasMethods as HasMethods,
    StrOptions as StrOptions,
)
from sklearn.utils.parallel import _get_threadpool_controller as threadpool_controller
from sklearn.utils.validation import _num_samples as number_of_rows

__all__ = ["number_of_rows", "taken_rows", "threadpool_controller"]

Function = TypeVar("Function", bound=Callable[..., Any])
Class = TypeVar("Class", bound=type)
# NumPy's defaults: `numpy.seterr` of a user does not change results.
NUMPY_DEFAULTS = np.errstate(divide="warn", over="warn", invalid="warn", under="ignore")


class Interval(_param_validation.Interval):
    """Numbers of a type between two bounds, without True and False."""

    def is_satisfied_by(self, value: Any) -> bool:
        """Return whether a value is in the interval."""
        return not isinstance(value, bool) and bool(super().is_satisfied_by(value))


N_JOBS = [
    None,
    Interval(Integral, None, -1, closed="right"),
    Interval(Integral, 1, None, closed="left"),
]


def fit_context(*, nested: bool) -> Callable[[Function], Function]:
    """Return a decorator of `fit` that checks parameters, nested ones included.

    A fit is made in a copy: after an error or an interruption the former fit is still
    there, and other threads see the former fit or the new one.
    """

    def decorated(fit: Any) -> Any:
        """Return `fit` as a whole or not at all."""
        checked = _fit_context(prefer_skip_nested_validation=not nested)(fit)

        @wraps(checked)
        def whole(estimator: Any, *args: Any, **params: Any) -> Any:
            new = copy.copy(estimator)
            checked(new, *args, **params)
            estimator.__dict__ = vars(new)
            return estimator

        return whole

    return decorated


def with_numpy_defaults(cls: Class) -> Class:
    """Give the public methods of a class NumPy's own handling of rounding errors."""
    for name, method in vars(cls).copy().items():
        if inspect.isfunction(method) and not name.startswith("_"):
            setattr(cls, name, NUMPY_DEFAULTS(method))
    return cls


def checked_parameters(
    constraints: dict[str, list[Any]],
) -> Callable[[Function], Function]:
    """Return a decorator that checks parameters of a function against constraints."""
    return _param_validation.validate_params(
        constraints, prefer_skip_nested_validation=True
    )


class CoefficientsMixin(ClassNamePrefixFeaturesOutMixin):
    """Names and number types of coefficients; tables may have missing points."""

    def __sklearn_tags__(self) -> Any:
        """Return the estimator's tags."""
        tags = super().__sklearn_tags__()
        tags.transformer_tags.preserves_dtype = ["float64", "float32"]
        tags.input_tags.allow_nan = True
        return tags

    def get_feature_names_out(self, input_features: Any = None) -> NDArray:
        """
        Return the names of the coefficients.

        Parameters
        ----------
        input_features : array-like of str, default=None
            Checked against the names of the fitted columns; otherwise unused.

        Returns
        -------
        ndarray of str, shape (n_components,)
            ``alpha_1``, ``alpha_2`` and so on, as in the files of the command line.
        """
        n_components = len(super().get_feature_names_out(input_features))
        names = [f"alpha_{k + 1}" for k in range(n_components)]
        return np.array(names, dtype=object)
