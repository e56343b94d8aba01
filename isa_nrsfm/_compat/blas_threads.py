"""One BLAS thread, in all functions of small matrices."""

import os
from functools import wraps
from operator import attrgetter
from threading import RLock, get_ident
from typing import Any, ClassVar, cast
from weakref import WeakSet

from isa_nrsfm._compat.scikit_learn import Function, threadpool_controller


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


def one_blas_thread(function: Function) -> Function:
    """Return a function that runs with one BLAS thread."""

    @wraps(function)
    def limited(*args: Any, **kwargs: Any) -> Any:
        with OneBlasThread():
            return function(*args, **kwargs)

    return cast(Function, limited)


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
