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
    """
    Decorate a function to run with one BLAS thread.

    Stages of a fit and fits of frames are many products of small matrices. Threads do
    not make them faster, and where other programs run on the same cores each product
    waits for the system to let the other threads run: two threads beside one other
    program take 2 to 12 times as long. Blocks of frames run in parallel instead, by
    ``n_jobs``.

    Parameters
    ----------
    function : callable
        The function.

    Returns
    -------
    callable
        The function, with BLAS limited to one thread while it runs.
    """

    @wraps(function)
    def limited(*args: Any, **kwargs: Any) -> Any:
        with _thread_pools().limit(limits=1, user_api="blas"):
            return function(*args, **kwargs)

    return limited  # type: ignore[return-value]
