"""Progress of a fit: lines on the terminal, and scikit-learn's callbacks.

Callbacks are new and experimental in scikit-learn 1.9. Only this module uses them.
"""

import time
from collections.abc import Sequence
from typing import Any, Self

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
