"""Progress of a fit: lines on the terminal, and scikit-learn's callbacks.

Callbacks are new in scikit-learn 1.9, and experimental there. No other module uses
their interface. With older versions there are only the lines on the terminal.
"""

import copy
import time
from collections.abc import Sequence
from typing import Any, Self

try:
    from sklearn.callback import CallbackSupportMixin as CallbackSupportMixin
except ImportError:

    class CallbackSupportMixin:  # type: ignore[no-redef]
        """Estimators take no callbacks."""

        def _init_callback_context(self, **_: Any) -> "_NoContext":
            """Return the context of a fit."""
            return _NoContext()


class _NoContext:
    """Stands in for scikit-learn's callback context where there are no callbacks."""

    def subcontext(self, **_: Any) -> Self:
        """Return the context of a part of the task."""
        return self

    def call_on_fit_task_begin(self, **_: Any) -> Self:
        """Tell that the task begins."""
        return self

    def call_on_fit_task_end(self, **_: Any) -> bool:
        """Tell that the task has ended."""
        return False


def without_callbacks(estimator: Any) -> Any:
    """Return a shallow copy of an estimator, without its callbacks."""
    copied = copy.copy(estimator)
    vars(copied).pop("_skl_callbacks", None)
    return copied


class FitProgress:
    """
    Reports the stages of a fit, and the steps of one of them.

    For callbacks the fit is a task, its stages are subtasks, and the steps of a stage
    are subtasks of that. With `verbose`, a line is printed at the end of each stage.
    Above one, the stage and step that begin are printed, to be overwritten by the next.

    Parameters
    ----------
    estimator : object
        The estimator, with `CallbackSupportMixin`. Where its `verbose` is above zero
        lines are printed.
    stages : sequence of str
        The names of the stages, in order.
    stepwise : str
        The stage with steps; how many is not known before.
    **data : object
        X and y of the fit, for the callbacks.
    """

    def __init__(
        self, estimator: Any, stages: Sequence[str], *, stepwise: str, **data: Any
    ):
        self.about = {"estimator": estimator, **data}
        self.left = list(stages)
        self.stepwise = stepwise
        self.stage: Any = None
        self.last_step: Any = None
        self.fit = estimator._init_callback_context(max_subtasks=len(self.left))
        self.fit.call_on_fit_task_begin(**self.about)
        self._begin()

    def __call__(self, stage: str) -> None:
        """Tell that a stage has ended, and that the next one begins."""
        now = time.perf_counter()
        if self.about["estimator"].verbose:
            name = type(self.about["estimator"]).__name__
            print(f"[{name}] {stage}: {now - self.since:.2f} s", flush=True)
        self._end_step()
        self.stage.call_on_fit_task_end(**self.about)
        self.left.remove(stage)
        if self.left:
            self._begin()

    def step(self) -> None:
        """Tell that a step of the stage begins, and that the one before has ended."""
        self._end_step()
        self.n_steps += 1
        self._print_begun(f", step {self.n_steps}")
        self.last_step = self.stage.subcontext(task_name="step")
        self.last_step.call_on_fit_task_begin(**self.about)

    def end(self) -> None:
        """Tell that the fit has ended: the estimator is fitted."""
        self.fit.call_on_fit_task_end(**self.about, reconstruction_attributes={})

    def _begin(self) -> None:
        """Tell that the next stage begins."""
        n_steps = None if self.left[0] == self.stepwise else 0
        self.n_steps = 0
        self._print_begun("")
        self.since = time.perf_counter()
        self.last_step = None
        self.stage = self.fit.subcontext(task_name=self.left[0], max_subtasks=n_steps)
        self.stage.call_on_fit_task_begin(**self.about)

    def _print_begun(self, step: str) -> None:
        """Print the stage and step that begin, on a line that is overwritten."""
        estimator = self.about["estimator"]
        if estimator.verbose > 1:
            print(
                f"[{type(estimator).__name__}] {self.left[0]}{step}",
                end="\r",
                flush=True,
            )

    def _end_step(self) -> None:
        """Tell that the step has ended, if there is one."""
        if self.last_step is not None:
            self.last_step.call_on_fit_task_end(**self.about)


class NoProgress:
    """Stands in for `FitProgress` where nobody is told."""

    def __call__(self, stage: str) -> None:
        """Take note that a stage has ended."""

    def step(self) -> None:
        """Take note that a step begins."""
