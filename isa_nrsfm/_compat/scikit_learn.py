"""The private names of scikit-learn that are used: parameters, threads, progress.

All supported versions have them, but for callbacks: these are new and experimental in
scikit-learn 1.9.
"""

import contextlib
import copy
import inspect
import os
import time
from collections.abc import Callable, Iterator, Sequence
from functools import wraps
from numbers import Integral
from operator import attrgetter
from threading import RLock, get_ident
from typing import Any, ClassVar, Self, TypeVar
from weakref import WeakSet

import numpy as np
from numpy.typing import NDArray
from sklearn.base import ClassNamePrefixFeaturesOutMixin, _fit_context
from sklearn.utils import _param_validation, _safe_indexing as taken_rows
from sklearn.utils._param_validation import HasMethods, StrOptions
from sklearn.utils.parallel import _get_threadpool_controller as threadpool_controller
from sklearn.utils.validation import _num_samples as number_of_rows

__all__ = ["HasMethods", "StrOptions", "number_of_rows", "taken_rows"]

Function = TypeVar("Function", bound=Callable[..., Any])
Class = TypeVar("Class", bound=type)
# NumPy's defaults: `numpy.seterr` of a user does not change results.
NUMPY_DEFAULTS = np.errstate(divide="warn", over="warn", invalid="warn", under="ignore")


class Interval(_param_validation.Interval):
    """Numbers of a type between two bounds, without True and False."""

    def is_satisfied_by(self, value: Any) -> bool:
        """Return whether a value is in the interval."""
        return not isinstance(value, bool) and bool(super().is_satisfied_by(value))


AT_LEAST_ONE = Interval(Integral, 1, None, closed="left")
N_JOBS = [None, Interval(Integral, None, -1, closed="right"), AT_LEAST_ONE]


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
        return np.array([f"alpha_{k + 1}" for k in range(n_components)], dtype=object)


class OneBlasThread:
    """Limit BLAS to one thread inside of a block.

    Threads of BLAS mostly wait for each other if matrices are small. Functions take 2
    to 12 times as long with them while another program runs. Blocks of frames run in
    parallel instead.

    Most BLAS libraries have one number of threads for the whole process. So the last
    Python thread that leaves restores it. With OpenMP each Python thread has its own.

    The users are held by weak references: an interrupt while a block is entered or left
    does not leave a user behind. A process that is forked meanwhile has no other Python
    threads, and none of their blocks.
    """

    _lock = RLock()
    _users: ClassVar["WeakSet[OneBlasThread]"] = WeakSet()
    # Numbers of threads before the first user; empty if they are restored.
    _of_process: ClassVar[list[int]] = []

    def __enter__(self) -> None:
        """Remember the number of threads, and set it to one."""
        pools = _pools()
        with self._lock:
            # From Python 3.12 on, a tracer that stops a comprehension keeps the lock.
            self._before = list(map(attrgetter("num_threads"), pools))
            self._thread = get_ident()
            if not self._of_process:
                self._of_process[:] = self._before
            self._users.add(self)
            for pool in pools:
                _set_threads(pool, 1)

    def __exit__(self, *error: object) -> None:
        """Restore the number of threads, if no Python thread is inside any more."""
        pools = _pools()
        with self._lock:
            self._users.discard(self)
            last = not len(self._users)
            numbers = zip(pools, self._before, self._of_process, strict=True)
            for pool, own, first in numbers:
                if getattr(pool, "threading_layer", None) == "openmp":
                    _set_threads(pool, own)
                elif last:
                    _set_threads(pool, first)
            if last:
                self._of_process.clear()

    @classmethod
    def _forked(cls) -> None:
        """Leave the blocks of other Python threads in a forked process."""
        for user in [user for user in cls._users if user._thread != get_ident()]:
            user.__exit__()
        cls._lock.release()


if hasattr(os, "register_at_fork"):
    os.register_at_fork(
        before=OneBlasThread._lock.acquire,
        after_in_parent=OneBlasThread._lock.release,
        after_in_child=OneBlasThread._forked,
    )


@contextlib.contextmanager
def one_blas_thread() -> Iterator[None]:
    """Limit BLAS to one thread in a block, or in a function that this decorates."""
    with OneBlasThread():
        yield


def _pools() -> list[Any]:
    """Return the controllers of the loaded BLAS libraries."""
    return threadpool_controller().select(user_api="blas").lib_controllers


def _set_threads(pool: Any, number: int) -> None:
    """Set the number of threads of a library, whichever Python thread set it last."""
    # From threadpoolctl 3.8 on, other Python threads are ignored.
    clear = getattr(pool, "clear_controlling_thread", lambda force: None)
    clear(force=True)
    pool.set_num_threads(number)
    clear(force=True)


try:
    from sklearn.callback import CallbackSupportMixin as CallbackSupportMixin
except ImportError:

    class CallbackSupportMixin:  # type: ignore[no-redef]
        """Estimators without callbacks."""

        def _init_callback_context(self, **_: Any) -> "_NoContext":
            """Return the context of a fit."""
            return _NoContext()


class _NoContext:
    """Callback context for versions of scikit-learn without callbacks."""

    def _itself(self, **_: Any) -> Self:
        """Return this context."""
        return self

    subcontext = call_on_fit_task_begin = call_on_fit_task_end = _itself


class FitProgress:
    """Reports the stages of a fit, and the steps of the stages `stepwise`.

    Callbacks get tasks for the fit, its stages and their steps. `verbose` prints a line
    after each stage; above one it overwrites the current step.
    """

    def __init__(
        self, estimator: Any, stages: list[str], *, stepwise: Sequence[str], **data: Any
    ):
        self.about = {"estimator": estimator, **data}
        self.left = list(stages)
        self.stepwise = stepwise
        self.fit = estimator._init_callback_context(max_subtasks=len(self.left))
        self.fit.call_on_fit_task_begin(**self.about)
        self._begin()

    def __call__(self, stage: str) -> None:
        """End a stage, and begin the next one."""
        self._print(1, f"{stage}: {time.perf_counter() - self.since:.2f} s")
        self._end_step()
        self.stage.call_on_fit_task_end(**self.about)
        self.left.remove(stage)
        if self.left:
            self._begin()

    def step(self) -> None:
        """End the last step of the stage, and begin the next one."""
        self._end_step()
        self.n_steps += 1
        self._print(2, f"{self.left[0]}, step {self.n_steps}", end="\r")
        self.last_step = self.stage.subcontext(task_name="step")
        self.last_step.call_on_fit_task_begin(**self.about)

    def end(self) -> None:
        """End the fit: the estimator is fitted."""
        self.fit.call_on_fit_task_end(**self.about, reconstruction_attributes={})

    def _begin(self) -> None:
        """Begin the next stage."""
        name, self.n_steps, self.last_step = self.left[0], 0, None
        self._print(2, name, end="\r")
        self.since = time.perf_counter()
        n_steps = None if name in self.stepwise else 0
        self.stage: Any = self.fit.subcontext(task_name=name, max_subtasks=n_steps)
        self.stage.call_on_fit_task_begin(**self.about)

    def _end_step(self) -> None:
        """End the last step, if there is one."""
        if self.last_step is not None:
            self.last_step.call_on_fit_task_end(**self.about)

    def _print(self, least: int, text: str, end: str = "\n") -> None:
        """Print a text if the estimator is at least that verbose."""
        estimator = self.about["estimator"]
        if estimator.verbose >= least:
            print(f"[{type(estimator).__name__}] {text}", end=end, flush=True)


class NoProgress:
    """Reports nothing."""

    def __call__(self, stage: str) -> None:
        """End a stage."""

    def step(self) -> None:
        """Begin a step."""


Progress = FitProgress | NoProgress
