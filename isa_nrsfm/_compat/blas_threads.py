"""One BLAS thread, in all functions of small matrices."""

from collections.abc import Callable
from contextlib import ContextDecorator
from threading import Lock, local
from typing import Any, TypeVar

from isa_nrsfm._compat.scikit_learn import threadpool_controller

Function = TypeVar("Function", bound=Callable[..., Any])


class OneBlasThread(ContextDecorator):
    """Limit BLAS to one thread inside of a function or block.

    Threads of BLAS mostly wait for each other if matrices are small. Functions take 2
    to 12 times as long with them while another program runs. Blocks of frames run in
    parallel instead.

    Most BLAS libraries have one number of threads for the whole process. So the last
    Python thread that leaves restores it. With OpenMP each Python thread has its own.
    """

    def __init__(self) -> None:
        self._lock, self._inside = Lock(), 0
        self._of_process: list[int] = []
        self._of_thread = local()

    def __enter__(self) -> None:
        """Remember the number of threads, and set it to one."""
        pools = _pools()
        with self._lock:
            numbers = [pool.num_threads for pool in pools]
            if not self._inside:
                self._of_process = numbers
            self._inside += 1
            self._of_thread.entered = [*self._entered(), numbers]
            for pool in pools:
                _set_threads(pool, 1)

    def __exit__(self, *error: object) -> None:
        """Restore the number of threads, if no Python thread is inside any more."""
        pools = _pools()
        with self._lock:
            *self._of_thread.entered, numbers = self._entered()
            self._inside -= 1
            for pool, own, first in zip(pools, numbers, self._of_process, strict=True):
                if getattr(pool, "threading_layer", None) == "openmp":
                    _set_threads(pool, own)
                elif not self._inside:
                    _set_threads(pool, first)

    def _entered(self) -> list[list[int]]:
        """Return the numbers of threads before each block that this thread is in."""
        return getattr(self._of_thread, "entered", [])


# The number of threads is a state of the process, so this count of its users is one.
LIMIT = OneBlasThread()


def one_blas_thread(function: Function) -> Function:
    """Return a function that runs with one BLAS thread."""
    return LIMIT(function)


def _pools() -> list[Any]:
    """Return the controllers of the loaded BLAS libraries."""
    controllers: list[Any] = threadpool_controller().lib_controllers
    return [pool for pool in controllers if pool.user_api == "blas"]


def _set_threads(pool: Any, number: int) -> None:
    """Set the number of threads of a library, whichever Python thread set it last."""
    # From threadpoolctl 3.8 on, other Python threads are ignored.
    clear = getattr(pool, "clear_controlling_thread", lambda force: None)
    clear(force=True)
    pool.set_num_threads(number)
    clear(force=True)
