"""One BLAS thread, where matrices are so small that threads wait for each other."""

from collections.abc import Callable
from functools import cache, wraps
from typing import Any, TypeVar

from threadpoolctl import ThreadpoolController

Function = TypeVar("Function", bound=Callable[..., Any])


@cache
def _thread_pools() -> ThreadpoolController:
    """Return the loaded libraries with threads. The search is slow, so it is cached."""
    return ThreadpoolController()


def one_blas_thread(function: Function) -> Function:
    """Decorate a function to run with one BLAS thread.

    Small products gain nothing from threads; beside another program they take 2 to 12
    times as long. Blocks of frames run in parallel instead.
    """

    @wraps(function)
    def limited(*args: Any, **kwargs: Any) -> Any:
        with _thread_pools().limit(limits=1, user_api="blas"):
            return function(*args, **kwargs)

    return limited  # type: ignore[return-value]
